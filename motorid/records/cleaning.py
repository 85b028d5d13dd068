"""From columns as they were logged to a valid run: order in time, gaps, missing cells; each loss is noted."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from motorid.display.numbers import counted
from motorid.errors import DataError, otherwise
from motorid.numerics.signals import Array, fresh_means, going_on, repeats, unrounded
from motorid.records.experiment import INPUTS, MIN_SAMPLES, PARTS, Experiment, pauses
from motorid.records.headers import Layout, Place
from motorid.records.preprocessing import unwrapped

Texts = Mapping[str, Sequence[object]]

_RUNS = ("run", "run_id", "trial", "test", "experiment", "motor_id", "messung", "versuch", "essai")
_NINES = [10.0**k - 1 for k in range(3, 8)]
_MARKS = [sign * n for sign in (-1, 1) for n in (*_NINES, *(2.0**k - m for k in (15, 16, 31, 32) for m in (0, 1)))]
_LATE = 2  # this many rows in a row may come late before it counts as a new start of time


def run_from_columns(columns: Mapping[str, Array], texts: Texts, layout: Layout, *, name: str, hold: str,
                     sigma: Mapping[str, float], meta: Mapping[str, Any], notes: Sequence[str]) -> Experiment:
    """Make a valid run of the columns of a file: numbers with NaN where missing, and `texts`, which may be dates.
    `notes` and those made here end up in ``meta["notes"]``; a recording was resumed at ``meta["parts"]``, s."""
    said = [*notes, *layout.notes]
    places = dict(layout.places)
    columns = _without_marks(columns, {p.column for c, p in places.items() if c not in ("t", "v")} - {*texts}, said)
    t = _time(columns, texts, places.pop("t"), said)
    values = {c: _channel(columns, texts, place, c) for c, place in places.items()}
    rows, t, begun = _rows_in_order(t, layout.places["t"].column, said)
    first = _first_input(values["v"][rows], places["v"].column, said)
    rows, t = rows[first:], t[first:]
    values = {c: a[rows] for c, a in values.items()}
    empty = [c for c, a in values.items() if np.isnan(a).all()]
    said += [f"left out '{places[c].column}' ({c}): every sample is missing." for c in empty]
    inputs = {c: _filled(t, values[c], places[c].column, said) for c in INPUTS if c in values and c not in empty}
    outputs = {c: a for c, a in values.items() if c not in (*INPUTS, *empty)}
    said += [f"'{places[c].column}' ({c}) is missing in {np.count_nonzero(np.isnan(a))} of {len(a)} rows."
             for c, a in outputs.items() if np.isnan(a).any()]
    used = {p.column for p in layout.places.values()}
    if not outputs:
        raise DataError(f"every sample of {', '.join(repr(places[c].column) for c in values if c not in INPUTS)} is "
                        "missing; there is nothing measured to fit.")
    for part in np.split(np.arange(len(t)), np.searchsorted(t, begun)):
        t[part] = _unrounded(t[part], layout.places["t"].column, said)
        _note_gaps(t[part], said)
        if "theta" in outputs and places["theta"].unit.symbol == "rad":
            measured = {c: y[part] for c, y in outputs.items()}
            outputs["theta"][part] = _going_on(measured, t[part], places["theta"].column, said)
    outputs = {c: _measured_once(t, y, inputs["v"], f"'{places[c].column}' ({c})", said) for c, y in outputs.items()}
    extra = {c: a[rows] for c, a in columns.items() if c not in used}
    if set(texts) - used:
        said.append(f"left out columns of text: {', '.join(sorted(set(texts) - used))}.")
    parts = [*meta.get("parts", ()), *_runs_by_column({**texts, **{c: columns[c] for c in extra}}, rows, t, said)]
    begins = {PARTS[0]: begun, PARTS[1]: np.subtract(parts, np.median(np.diff(t)) / 2)}
    extra |= {c: np.searchsorted(times, t, "right") for c, times in begins.items() if len(times)}
    facts = {**meta, "notes": said, "extra": extra, "columns": {c: p.column for c, p in layout.places.items()},
             "original_units": {c: p.unit.label for c, p in layout.places.items()},
             "assumed_units": [c for c, p in layout.places.items() if not p.stated]}
    units = {c: places[c].unit.symbol for c in (*inputs, *outputs)}
    try:
        return Experiment(t, inputs, outputs, sigma, cast(Any, hold), units, name, facts)
    except DataError as error:
        raise DataError(str(error).removeprefix(f"{name}: ")) from None


def _measured_once(t: Array, y: Array, v: Array, what: str, said: list[str]) -> Array:
    """Return an output without samples that only repeat the one before, as they are or behind noise."""
    if (again := repeats(y)).any():
        said.append(f"{what} was read more often than it was measured: of {len(y)} samples {np.count_nonzero(again)} "
                    "repeat the one before and do not count.")
        return np.where(again, np.nan, y)
    if (fresh := fresh_means(t, y, v)) is not y:
        said.append(f"{what} was read more often than it was measured, behind noise: of {len(y)} samples "
                    f"{np.count_nonzero(np.isfinite(fresh))} count, each the mean of those that repeat it.")
    return fresh


def _without_marks(columns: Mapping[str, Array], measured: Iterable[str], said: list[str]) -> dict[str, Array]:
    """Count as missing what loggers write where nothing was measured: a number of `_MARKS`, far from all others. A
    command may be any number: a duty cycle of 16 bits is 0 or 65535."""
    columns = {n: np.where(np.isnan(c), np.nan, c) for n, c in columns.items()}  # one of a damaged file may signal
    for name in sorted(measured):
        marked = np.isin(y := columns[name], _MARKS)
        rest = y[~marked & np.isfinite(y)]
        for mark in np.unique(y[marked]) if rest.size else ():
            if 0 < np.ptp(rest) < np.abs(rest - mark).min():
                y[y == mark] = np.nan
                said.append(f"'{name}' holds {mark:g}, far from all other values: taken for a missing sample.")
    return columns


def _going_on(measured: Mapping[str, Array], t: Array, column: str, said: list[str]) -> Array:
    """Return the angle without the jumps of a counter or at a turn."""
    theta, turn, jumps = unwrapped(measured["theta"], t, measured.get("omega"))
    if jumps:
        by = "a turn" if turn == 2 * np.pi else f"{turn:.4g} rad, as a counter does,"
        said.append(f"the angle '{column}' jumps by {by} {jumps} times; here it goes on.")
    return theta


def _channel(columns: Mapping[str, Array], texts: Texts, place: Place, channel: str) -> Array:
    for column in filter(None, (place.column, place.times)):
        if column in texts:
            sample = next((str(c) for c in texts[column] if str(c).lower() != "nan"), "")
            raise DataError(f"column '{column}' should be the channel {channel} but holds "
                            + (f"text, e.g. '{sample[:40]}'." if sample else "nothing."))
    array = columns[place.column] * place.unit.factor + place.unit.offset
    return array * columns[place.times] if place.times else array


def _time(columns: Mapping[str, Array], texts: Texts, place: Place, said: list[str]) -> Array:
    if place.column in texts:
        said.append(f"'{place.column}' holds dates or clock times; counted in seconds from the first.")
        return _dates(texts[place.column], place.column)
    raw, factor = columns[place.column], place.unit.factor
    start = raw[np.isfinite(raw)][:1]
    if start.size and abs(start[0] * factor) > 1e8:  # seconds since 1970 leave no digits for microseconds
        said.append(f"time starts at {start[0] * factor:.6f} s; counted from there.")
        raw = raw - start[0]
    return raw * factor + 0.0  # no negative zero


def _dates(cells: Sequence[object], column: str) -> Array:
    import pandas as pd

    series = pd.Series(cells, dtype=object).astype(str).str.strip()
    series = series.str.replace(r"(:\d\d)[,:](\d+)$", r"\1.\2", regex=True)  # 12:00:00,001
    # Bare numbers would be nanoseconds; a spreadsheet may leave out the hours.
    clock = series.where(series.str.contains("[:a-zA-Z]")).str.replace(r"^(\d+:\d\d\.\d)", r"00:\1", regex=True)
    ways = (partial(pd.to_datetime, series, format="ISO8601", utc=True), partial(pd.to_timedelta, clock),
            partial(pd.to_datetime, clock, format="mixed", utc=True, dayfirst="." in str(cells[0])[:3]))
    with warnings.catch_warnings(action="ignore"):
        for way in ways:
            spans: Any = otherwise(None, (ValueError, TypeError, OverflowError), lambda way=way: way(errors="coerce"))
            if spans is not None and spans.notna().mean() > 0.5:
                seconds = (spans - spans.dropna().iloc[0]).dt.total_seconds().to_numpy(dtype=float)
                return np.unwrap(seconds, period=86400.0) if np.isfinite(seconds).all() else seconds  # past midnight
    raise DataError(f"the time column '{column}' holds neither numbers nor dates, e.g. '{str(cells[0])[:40]}'; "
                    "expected seconds, or another unit that is stated. Samples a fixed time apart: dt=0.001.")


def _unrounded(t: Array, column: str, said: list[str]) -> Array:
    """Return time stamps that are even but for their rounding as they were before it."""
    found, step = unrounded(t)
    said += [f"the stamps of '{column}' are rounded to {1e3 * step:.3g} ms; their samples are as even as that allows, "
             f"{1e3 * np.median(np.diff(found)):.4g} ms apart, and are taken to be."] * bool(step)
    return found


def _rows_in_order(t: Array, column: str, said: list[str]) -> tuple[NDArray[np.intp], Array, list[float]]:
    """Return the rows whose time moves on, without repeats, their times, and when it began again; long parts go on."""
    rows = np.flatnonzero(np.isfinite(t))
    if len(rows) < len(t):
        said.append(f"left out {counted(len(t) - len(rows), 'row')} of {len(t)}: no time is given.")
    if len(rows) < MIN_SAMPLES:
        raise DataError(f"a run needs at least {MIN_SAMPLES} samples; here {counted(len(rows), 'row')} of "
                        f"{len(t)} hold a time in '{column}'.")
    if np.ptp(t[rows]) == 0:
        raise DataError(f"time does not move: '{column}' is {t[rows[0]]:g} s in every row. Is it the right column?")
    total = len(rows)
    now = t[rows]
    ahead = (now[1:-1] > now[2:]) & (now[2:] > now[:-2])  # a stamp that jumps ahead and is not followed
    rows = rows[np.r_[True, ~ahead, True]]
    stretches = _stretches(t[rows])
    again = counted(len(stretches) - 1, "time")
    if len(stretches) > 1 and total < MIN_SAMPLES * len(stretches):  # in disorder, not begun anew
        raise DataError(f"time does not increase: '{column}' goes back {again} in {total} rows. Is it "
                        "the right column? Expected rows in order of time.")
    long = [rows[s] for s in stretches if len(s) >= MIN_SAMPLES] or [rows[max(stretches, key=len)]]
    if len(stretches) > 1:
        used = sum(map(len, long))
        what = f"kept the longest stretch, {used}" if len(long) == 1 else f"a run each time, {used}"
        said.append(f"time starts again {again}; {what} of {total} rows.")
        total = used
    moving = [s[np.r_[True, t[s][1:] > np.maximum.accumulate(t[s])[:-1]]] for s in long]
    moving = [s for s in moving if len(s) >= MIN_SAMPLES] or moving[:1]
    if (kept := sum(map(len, moving))) < max(total / 2, MIN_SAMPLES):
        raise DataError(f"time stands still or goes back in {total - kept} of {total} rows of "
                        f"'{column}'. Is it the right column? If its clock is too coarse, leave "
                        "it out, and say the time between samples: dt=0.0002.")
    if kept < total:
        said.append(f"left out {counted(total - kept, 'row')} of {total}: the time stamp repeats "
                    "an earlier one, goes back, or jumps ahead.")
    times, begun = [t[moving[0]]], []
    for rows in moving[1:]:
        begun.append(float(times[-1][-1] + np.median(np.diff(t[rows]))))
        times.append(t[rows] - t[rows[0]] + begun[-1])
    return np.concatenate(moving), np.concatenate(times), begun


def _stretches(t: Array) -> list[NDArray[np.intp]]:
    """Cut where time goes back and stays behind; a few late rows are no new start."""
    cuts, done, high = [], 0, -np.inf
    for k in np.flatnonzero(np.diff(t) < 0) + 1:
        high = max(high, float(t[done:k].max())) if k > done else high
        done = k
        next_rows = t[k:k + _LATE + 1]
        if len(next_rows) > _LATE and not (next_rows > high).any():
            cuts.append(k)
            high = -np.inf
    return np.split(np.arange(len(t)), cuts)


def _runs_by_column(columns: Mapping[str, Any], rows: NDArray[np.intp], t: Array, said: list[str]) -> list[float]:
    """Return the times at which a column that numbers or names runs changes; none where it does so all the time."""
    if (name := next((c for c in columns if c.strip().lower() in _RUNS), None)) is None:
        return []
    every = np.asarray(columns[name], dtype=str)
    often, changes = (np.flatnonzero(cells[1:] != cells[:-1]) + 1 for cells in (every, every[rows]))
    seldom = len(often) <= len(every) / MIN_SAMPLES
    said += [f"a new run begins {counted(len(changes), 'time')}, where '{name}' changes." if seldom else
             f"'{name}' changes in {len(often)} rows: several at once? Split the file by it."] * bool(len(often))
    return list(map(float, t[changes])) if seldom else []


def _first_input(v: Array, column: str, said: list[str]) -> int:
    if not (known := np.flatnonzero(np.isfinite(v))).size:
        raise DataError(f"every sample of the input '{column}' is missing; no simulation can do without it.")
    if known[0]:
        said.append(f"left out the first {counted(int(known[0]), 'row')}: the input '{column}' is not known there.")
    return int(known[0])


def _filled(t: Array, v: Array, column: str, said: list[str]) -> Array:
    if not (missing := ~np.isfinite(v)).any():
        return v
    said.append(f"the input '{column}' is missing in {np.count_nonzero(missing)} of {len(v)} rows; "
                "it was held from the last known value, or goes on evenly where a few are missing from what does.")
    first = int(np.argmin(missing))  # before it only what is measured beside the voltage may be missing
    known, last = np.flatnonzero(~missing), np.maximum.accumulate(np.where(missing, first, np.arange(len(v))))
    even = np.append(going_on(t[known], v[known]) > 0, False)[np.searchsorted(known, last)]
    return np.where(even, np.interp(t, t[known], v[known]), v[last])


def _note_gaps(t: Array, said: list[str]) -> None:
    steps = np.diff(t)
    if len(steps) < MIN_SAMPLES - 1:
        return
    long = pauses(t)
    gaps = np.setdiff1d(np.flatnonzero(steps > 5 * np.median(steps)), long)
    for found, what in ((long, "what follows is fitted as a run of its own"), (gaps, "the input is assumed to go on")):
        if found.size:
            worst = found[np.argmax(steps[found])]
            how_many = "a gap in time," if found.size == 1 else f"{found.size} gaps in time, the longest"
            said.append(f"{how_many} {steps[worst]:.4g} s after t = {t[worst]:.6g} s; {what}.")

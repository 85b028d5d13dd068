"""Which column is which channel, in which unit: as the user says, then as the header says; every guess is noted."""

import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace

from motorid.channels import CHANNELS, DIMENSIONS, MEASURED_INPUTS, NAMES, SI
from motorid.errors import DataError, UsageError, one_of
from motorid.numerics.signals import Array
from motorid.records import headers
from motorid.records.headers import Unit

_PERCENT = re.compile(r"%|pct|per_?cent|prozent")
_DATES = ("date", "datum", "fecha", "x_value")
_DRIVES = re.compile("input|output|control|command|drive")  # words of a column that may well be the drive voltage
STEADY = 0.2  # of its largest value: a voltage that ranges less beside a duty cycle that ranges more is the supply's
_WHOLE = 1, 100, 255, 1023, 4095, 65535  # of a duty cycle: its share, per cent, counts of a timer of 8 to 16 bits
_MEANING = {c: f"the {name}" for c, name in NAMES.items()} | {"v": "the drive voltage"}
Units = Mapping[str, Unit | None]


@dataclass(frozen=True)
class Place:
    """Where a channel is: its column, its unit, whether that unit was stated; `times` is a factor column."""

    column: str
    unit: Unit
    stated: bool
    score: float = 9.0
    times: str | None = None


@dataclass(frozen=True)
class Layout:
    """Channel to place, and what the user should know about it."""

    places: Mapping[str, Place]
    notes: Sequence[str]


def assign(labels: Sequence[str], *, columns: Mapping[str, object] | None = None,
           units: Mapping[str, object] | None = None, unit_row: Mapping[str, str] | None = None,
           values: Mapping[str, Array] | None = None) -> Layout:
    """Decide which column of `labels`, without a header "1", "2", ..., holds which channel. `columns` and `units` are
    those of `read_runs`, `unit_row` is what the row below the header says; `values` tell how far a duty cycle goes."""
    if not labels:
        raise DataError("it has no columns.")
    row = {label: headers.parse_unit((unit_row or {}).get(label, "")) for label in labels}
    units = units or {}
    places = _named_by_user(labels, columns or {}, units, row)
    notes: list[str] = []
    free = [c for c in labels if c not in {p.column for p in places.values()}]
    _named_by_header(places, free, row, notes, [c for c, column in (columns or {}).items() if column is None])
    _last_resorts(places, row, values or {}, notes, {*(columns or {}), *units})
    _apply_units(places, labels, units, notes)
    if (v := places.get("v")) and v.unit.offset:
        notes.append(f"'{v.column}' is read as a servo's pulses: {-v.unit.offset / v.unit.factor:g} {v.unit.label[:2]} "
                     "is 0, 500 µs more is 1 (say where it rests: units={'v': 'us:1500'}).")
    # An angle in counts of unknown size is left out, unless it is all there is.
    for channel in (unscaled := [c for c in ("theta", "omega") if c in places and math.isnan(places[c].unit.factor)]):
        if {"i", "omega", "theta"} & set(places) == {channel}:
            headers.require_unit(places[channel].unit.label, channel)
        notes.append(f"left out '{places.pop(channel).column}': it is in encoder counts, and how many make one turn is "
                     f"not known; to use it, say units={{'{channel}': 'counts:2048'}}.")
    _require(places, labels, values or {})
    free = [c for c in labels if c not in {x for p in places.values() for x in (p.column, p.times)}]
    wrong = _in_wrong_units(free, row, {*places, *(columns or {})}, notes)
    others = [c for c in free if c in (values or labels) and not headers.is_reference(c) and c not in wrong]
    if others and not {"omega", "theta"} & {*places, *(columns or {}), *unscaled}:
        notes.append(f"not used: {', '.join(others[:20])}; if one of them is the speed or the angle, name it with "
                     f"columns={{'omega': '{'y' if 'y' in others else others[0]}'}}.")
    notes += [f"'{c}' looks like the reference of a controller: what drives the model is '{places['v'].column}'; "
              f"'{c}' is not used." for c in free if headers.is_reference(c)]
    guesses = [f"'{p.column}' as {_MEANING[c]}" for c, p in places.items() if p.score <= 1]
    plain = [f"{c} ('{p.column}') in {p.unit.symbol}" for c, p in places.items()
             if not p.stated and p.column in (values or labels)]
    notes += [f"took {', '.join(guesses)}, a guess from the headers; override with columns."] if guesses else []
    notes += [f"no unit stated, assuming {', '.join(plain)}; override with units."] if plain else []
    return Layout({c: places[c] for c in DIMENSIONS if c in places}, notes)


def _in_wrong_units(free: Sequence[str], row: Units, known: Container[str], notes: list[str]) -> list[str]:
    """Note and return the columns named like a channel that is not `known`, in a unit that it cannot have."""
    found = []
    for label in free:
        name, unit, sure = headers.unit_in(label)
        hit = headers.classify(name) if (unit := row[label] or (unit if sure else None)) else None
        if hit and unit and hit.score >= 3 and hit.channel not in known and not any(f"'{label}'" in n for n in notes):
            found.append(label)
            c, one = hit.channel, f"0.001 {SI[DIMENSIONS[hit.channel][0]]}"
            notes.append(f"not used: '{label}'; it is named like {_MEANING[c]}, and {unit.label} is no unit of that. "
                         f"Say how much one is: columns={{'{c}': '{label}'}}, units={{'{c}': '{one}'}}.")
    return found


def _named_by_user(labels: Sequence[str], columns: Mapping[str, object], units: Mapping[str, object],
                   row: Units) -> dict[str, Place]:
    places = {}
    for channel, column in columns.items():
        if channel not in DIMENSIONS:
            raise DataError(f"columns: {one_of(str(channel), DIMENSIONS, 'channel')} "
                            "Write channel=column, e.g. v=u_volt.")
        if column is None:
            continue
        label = _find(labels, column)
        if (unit := row[label] or headers.unit_in(label)[1]) and unit.dimension not in DIMENSIONS[channel]:
            named = headers.classify(label, row[label])  # u_a is in no ampere, current_A is
            sure = (named and named.unit) or headers.unit_in(label)[2]
            unit = None if {channel, label} & set(units) or not sure else headers.require_unit(
                unit.label, channel, pulses=named is None or named.channel != "t")
        places[channel] = Place(label, unit or _default(channel), unit is not None)
    taken = [p.column for p in places.values()]
    if twice := [label for label in taken if taken.count(label) > 1]:
        raise DataError(f"columns: '{twice[0]}' is given for {len(twice)} channels; each needs its own.")
    return places


def _find(labels: Sequence[str], column: object) -> str:
    text = str(column).strip()
    for same in (str.strip, lambda s: s.strip().lower()):
        hits = [c for c in labels if same(c) == same(text)]
        if len(hits) == 1:
            return hits[0]
    if text.isdigit() and 1 <= int(text) <= len(labels):
        return labels[int(text) - 1]
    raise DataError(f"columns: {one_of(text, labels, 'column')} A column can also be given by its position, "
                    "counted from 1.")


def _named_by_header(places: dict[str, Place], labels: Sequence[str], row: Units, notes: list[str],
                     without: Sequence[str]) -> None:
    """Add the channels that the header names, where the user has not named them, or wants to do `without`."""
    found, named = dict[str, list[Place]](), {*CHANNELS} & {*places}  # who names one need not want another
    measured = named - {"v"}
    for label in labels:
        if hit := headers.classify(first_of_its_name(label, labels), row[label]):
            place = Place(label, hit.unit or _default(hit.channel), hit.unit is not None, hit.score)
            found.setdefault(hit.channel, []).append(place)
    for channel, hits in found.items():
        best = [p for p in hits if p.score == max(h.score for h in hits)]
        best = [p for p in best if p.unit.factor == 1.0] or best
        # Of several measured inputs nobody knows which one acts on the motor.
        spare = channel in MEASURED_INPUTS or ((best[0].score <= 1 or measured) and channel not in ("t", "v"))
        names = " and ".join(f"'{p.column}'" for p in best)
        if len(best) > 1 and measured and channel in CHANNELS and channel not in (*places, *without):
            notes.append(f"not used: {names}, which look equally like {_MEANING[channel]} ({channel}).")
            continue
        if channel in places or channel in without or (len(best) > 1 and spare):
            notes += [f"'{p.column}' is not used, '{places['t'].column}' is." for p in best if channel == "t" in places]
            continue
        if len(best) > 1:
            speed = " If 'v' is the speed: columns={'v': 'u', 'omega': 'v'}." * (names.lower() == "'u' and 'v'")
            raise DataError(f"{names} look equally like {_MEANING[channel]} ({channel}); say which one "
                            f"is meant, e.g. columns={{'{channel}': '{best[0].column}'}}.{speed}")
        places[channel] = best[0]
        more = f"also took '{best[0].column}' as {_MEANING[channel]} ({channel}); --ignore {channel} leaves it out."
        notes += [more] * bool(named and channel in CHANNELS)
        notes += [f"'{p.column}' looks like {_MEANING[channel]}, too; '{best[0].column}' is used."
                  for p in hits if p is not best[0] and p.score == best[0].score]


def first_of_its_name(label: str, labels: Sequence[str]) -> str:
    """Return the label without the number that tells it from others of the same name."""
    name = label.rpartition(" (")[0]
    return name if label.endswith(")") and label[len(name) + 2:-1].isdigit() and name in labels else label


def _last_resorts(places: dict[str, Place], labels: Units, values: Mapping[str, Array], notes: list[str],
                  asked: set[str]) -> None:
    timed = [c for c, unit in labels.items() if c.lower() in _DATES or (unit and unit.dimension == "time")]
    if "t" not in places and timed:
        places["t"] = Place(timed[0], labels[timed[0]] or _default("t"), labels[timed[0]] is not None, 1.0)
    if not {"i", "omega", "theta"} & set(places) and "y" in labels:
        places["omega"] = Place("y", _default("omega"), False)
        notes.append("took column 'y' as the speed; if it is not, say which channel it is with columns.")
    duty, supply = [c for c in labels if headers.is_duty(c)], [c for c in labels if headers.is_supply(c)]
    if len(duty) == 1 and not supply and "v" in places and not {"v", places["v"].column} & asked and (
            _range(places["v"].column, values) < STEADY < _range(duty[0], values)):  # it is the supply's
        supply = [places.pop("v").column]
    if "v" not in places and len(duty) == len(supply) == 1:
        unit, (top, whole) = headers.unit_in(duty[0])[1], _reach(duty[0], values)
        ratio = unit if unit and unit.dimension == "ratio" else Unit("ratio", 1 / whole, "1", f"1/{whole:.4g}")
        scale = headers.unit_in(supply[0])[1] or _default("v")
        product = Unit("voltage", ratio.factor * scale.factor, "V", f"{ratio.label}·{scale.label}")
        places["v"] = Place(duty[0], product, True, times=supply[0])
        whole_is = "" if ratio is unit else f" (reaches {top:.4g}, of {whole:.4g})"
        notes.append(f"took '{duty[0]}'{whole_is} times '{supply[0]}' as the drive voltage.")


def _range(column: str, values: Mapping[str, Array]) -> float:
    """Return how far a column ranges, over its largest size."""
    known = [y for y in values.get(column, ()) if math.isfinite(y)] or [0.0]
    return (max(known) - min(known)) / (max(map(abs, known)) or 1)


def _reach(duty: str, values: Mapping[str, Array]) -> tuple[float, float]:
    """Return how far a duty cycle goes, and which number stands for all of the supply."""
    top = max((abs(y) for y in values.get(duty, ()) if math.isfinite(y)), default=0.0)
    return top, 100 if _PERCENT.search(duty.lower()) else next((n for n in _WHOLE if top <= n), top)


def _apply_units(places: dict[str, Place], labels: Sequence[str], units: Mapping[str, object],
                 notes: list[str]) -> None:
    for key, text in units.items():
        channel = key if key in places else next((c for c, p in places.items() if p.column == key), None)
        if channel is None:
            why = ("no column was recognised as this channel; name it with columns" if key in DIMENSIONS else
                   "this column is not used as a channel" if key in labels else
                   one_of(str(key), [*places, *(p.column for p in places.values())], "channel or column"))
            raise DataError(f"units for '{key}': {why}")
        was, unit = places[channel], headers.require_unit(text, channel)
        if was.stated and not math.isclose(abs(was.unit.factor), abs(unit.factor)):
            notes.append(f"'{was.column}' says {was.unit.label}, and is read as {unit.label}: units asks for it.")
        times = was.times if unit.dimension == "ratio" else None  # volts of a duty cycle are said for one supply
        scale = times and (headers.unit_in(times)[1] or _default("v"))
        unit = replace(unit, factor=unit.factor * scale.factor, symbol="V") if scale else unit
        places[channel] = replace(was, unit=unit, stated=True, times=times)
    theta, omega = places.get("theta"), places.get("omega")
    if theta and omega and theta.unit.dimension == "length" and not omega.stated:
        places["omega"] = replace(omega, unit=Unit("linear speed", 1.0, "m/s", "m/s"))


def _require(places: Mapping[str, Place], labels: Sequence[str], values: Mapping[str, Array]) -> None:
    missing = {c: f"{_MEANING[c]} ({c})" for c in ("t", "v") if c not in places}
    if not {"i", "omega", "theta"} & set(places):
        missing["omega"] = "a measured current (i), speed (omega) or angle (theta)"
    if not missing:
        return
    duty = [c for c in labels if headers.is_duty(c)] if "v" in missing else []
    top, whole = _reach(duty[0], values) if duty else (0.0, 1)
    more = (f" '{duty[0]}' is a duty cycle; with a constant supply of, say, 12 V ('12 V' for 0 to 1, '0.12 V' for per "
            f"cent, '0.047 V' for 0 to 255; it reaches {top:.4g} here): columns={{'v': '{duty[0]}'}}, "
            f"units={{'v': '{12 / whole:.2g} V'}}.") if duty else ""
    if "v" in missing and (i := places.get("i", places.get("tau_load"))):
        more += (f" If '{i.column}' is what commands a drive with a current loop of its own: "
                 f"columns={{'v': '{i.column}'}}, with mi.torque_driven() (--drive torque).")
    used = {*duty, *(p.column for p in places.values())}
    untimed = " Samples a fixed time apart need no column of time: dt=0.001 says how far, s." * ("t" in missing)
    stated = {c: unit for c in labels for _, unit, sure in [headers.unit_in(c)] if unit and sure}
    free = [c for c in labels if c not in used and not headers.is_reference(c) and c in (values or labels)
            and (c not in stated or stated[c].dimension in DIMENSIONS["v"])]
    free.sort(key=lambda c: not _DRIVES.search(c.lower()))
    asked = [c for c in missing if c != "v" or not more or (free and not duty)]
    raise DataError(f"no column looks like {', nor like '.join(missing.values())}. "
                    f"{_say_which(labels, asked, free)}{more}{untimed}")


def _say_which(labels: Sequence[str], channels: Sequence[str], free: Sequence[str]) -> str:
    if list(labels) == [str(k + 1) for k in range(len(labels))]:
        return (f"The file has no header, so name its {len(labels)} columns by position, counted from 1: "
                "columns={'t': 1, 'v': 2, 'omega': 3}.")
    listed = ", ".join(f"'{c}'" for c in labels[:20]) + (" ..." if len(labels) > 20 else "")
    example = ", ".join(f"'{c}': '{column}'" for c, column in zip(channels, [*free, "...", "...", "..."], strict=False))
    return f"Columns here: {listed}." + (f" Say which is which, e.g. columns={{{example}}}." if channels else "")


def _default(channel: str) -> Unit:
    dimension = DIMENSIONS[channel][0]
    return Unit(dimension, 1.0, SI[dimension], SI[dimension])


def parse_pairs(text: str, what: str) -> dict[str, str]:
    """Read ``t=time,v=u_volt,omega=speed`` as it is written on a command line."""
    pairs: dict[str, str] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, value = (s.strip() for s in part.partition("="))
        if not (equals and name and value):
            raise UsageError(f"{what}: expected name=value pairs with commas between, like t=time,v=u_volt; "
                             f"cannot read '{part}'.")
        if name in pairs:
            raise UsageError(f"{what}: '{name}' is given twice, as '{pairs[name]}' and as '{value}'.")
        pairs[name] = value
    if not pairs:
        raise UsageError(f"{what}: expected name=value pairs like t=time,v=u_volt; got nothing.")
    return pairs

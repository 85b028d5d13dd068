"""One run of a motor: time, inputs, measured channels; validated once, then frozen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from numbers import Real
from types import MappingProxyType
from typing import Any, Literal
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorid.channels import CHANNELS, MEASURED_INPUTS, NAMES, UNITS
from motorid.display.cards import Card, Flag, Shown, Table
from motorid.display.numbers import duration, number, quantity
from motorid.errors import DataError, UsageError, among, printable
from motorid.numerics.signals import Array, bridged, integral
from motorid.records import preprocessing

INPUTS = ("v", *MEASURED_INPUTS)
MIN_SAMPLES = 8
ROUNDING = 1e-12  # of a channel, or of its SI unit: what sums of doubles leave of a motion that is none
PARTS = ("motorid record", "motorid part")  # extra columns that change where the clock starts again, a part begins


@dataclass(frozen=True, eq=False)
class Experiment(Shown):
    """One run: what went in and what was measured, on one time axis.

    All is validated here, and nowhere else; arrays (copied, float64) and mappings are read-only, to be shared safely.

    Parameters
    ----------
    t : (N,) array
        Time in s, finite and strictly increasing; steps may be uneven.
    inputs : mapping of str to (N,) array
        ``{"v": ...}``, the drive voltage in V (or the command of a torque-controlled drive). Finite. Beside it, where
        measured, ``"v_supply"`` (V), ``"tau_load"`` (N·m), ``"temp"`` (°C), for effects that read them.
    outputs : mapping of str to (N,) array
        Some of ``"i"`` (A), ``"omega"`` (rad/s or m/s), ``"theta"`` (rad or m). NaN marks a missing sample.
    sigma : mapping of str to float, optional
        Standard deviation of the measurement noise per output channel, where it is known.
    hold : {"zoh", "linear"}
        What the input does between samples: held, going on evenly over a few left out, or joined by lines.
    units : mapping of str to str, optional
        SI unit per channel, by default V, A, rad/s, rad; m and m/s make a linear axis.
    name : str
        Short name, used in tables and plots.
    meta : mapping, optional
        Whatever should travel with the run: source, fingerprint, notes, extra columns.

    Raises
    ------
    DataError
        If anything above does not hold; the message says what was expected and what came.

    Examples
    --------
    >>> t = np.arange(0, 1, 1e-3)
    >>> run = mi.Experiment(t, {"v": np.full(1000, 6.0)}, {"omega": 100 * (1 - np.exp(-t / 0.05))}, name="step")
    >>> run
    <Experiment 'step': v → omega; 1000 samples, 0.999 s>
    """

    t: Array
    inputs: Mapping[str, Array]
    outputs: Mapping[str, Array]
    sigma: Mapping[str, float] = field(default_factory=dict)
    hold: Literal["zoh", "linear"] = "zoh"
    units: Mapping[str, str] = field(default_factory=dict)
    name: str = "run"
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze = partial(object.__setattr__, self)
        freeze("name", printable(str(self.name)))
        for optional in ("sigma", "units", "meta"):
            given = getattr(self, optional)
            if not isinstance(given, Mapping | None):
                raise DataError(f"{self.name}: '{optional}' must be a mapping from names to values; got {given!r}.")
            freeze(optional, MappingProxyType(dict(given or {})))
        t = _frozen_array(self.t, "t", self.name)
        _check_time(t, self.name)
        freeze("t", t)
        freeze("inputs", _channels(self.inputs, INPUTS, "input", t, self.name))
        freeze("outputs", _channels(self.outputs, CHANNELS, "output", t, self.name))
        _check_values(self)
        freeze("sigma", _sigmas(self))
        freeze("units", _units(self))
        among(self.hold, ("zoh", "linear"), "hold", DataError, f"{self.name}: ")

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.t)

    @cached_property
    def dt(self) -> float:
        """Median time between samples, in s."""
        return float(np.median(np.diff(self.t)))

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, in s."""
        return float(self.t[-1] - self.t[0])

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the measured output channels, in the order i, omega, theta."""
        return tuple(name for name in CHANNELS if name in self.outputs)

    @property
    def run_in(self) -> int:
        """Number of first samples by which no model is judged: of a part of a record, what fades from before it."""
        return int(np.searchsorted(self.t, self.meta.get("judged from", -np.inf)))

    def moved(self, channel: str) -> Array:
        """Return what errors of a channel are measured against, (N,): an angle from where its record begins, since its
        zero may be anywhere; the others as they are. Where nothing but rounding moves it is zero."""
        y = self.outputs[channel]
        known = y[np.isfinite(y)]
        moved = y - self.meta.get("origin", known[:1].sum()) if channel == "theta" else y
        return np.where(np.abs(moved) < ROUNDING * max(np.abs(known).max(initial=0.0), 1.0), 0.0, moved)

    def with_(self, **changes: Any) -> Experiment:
        """Return a copy with some fields replaced, validated again."""
        for key in changes:
            among(key, (f.name for f in dataclasses.fields(self)), "field", where="with_(): ")
        return dataclasses.replace(self, **changes)

    def select(self, keep: slice | ArrayLike) -> Experiment:
        """Return the samples picked by a slice, a boolean mask (N,) or increasing indices."""
        which = keep if isinstance(keep, slice) else np.asarray(keep)
        if isinstance(which, np.ndarray) and which.dtype == bool and which.shape != self.t.shape:
            raise UsageError(f"{self.name}: a mask needs {self.n} entries, one per sample; got {which.size}.")

        def picked(arrays: Mapping[str, Any]) -> dict[str, Array]:
            return {k: np.asarray(a)[which] for k, a in arrays.items()}

        try:
            return self.with_(t=self.t[which], inputs=picked(self.inputs), outputs=picked(self.outputs),
                              meta={**self.meta, "extra": picked(self.meta.get("extra", {}))})
        except IndexError as error:
            raise UsageError(f"{self.name}: select() takes a slice, a mask or indices: {error}.") from None

    def without(self, *channels: str) -> Experiment:
        """Return a copy that lacks these output channels (as a model sees it that may not use them)."""
        for channel in channels:
            among(channel, self.channels, "output channel", where=f"{self.name}: ")
        return self.with_(outputs={k: a for k, a in self.outputs.items() if k not in channels})

    def decimate(self, k: int) -> Experiment:
        """Return every k-th sample, of each part between pauses by itself.

        Outputs are picked, not filtered: a filter would add a lag that looks like physics. A held voltage is
        averaged over each longer step, which keeps its integral; a linear one is picked, and other inputs are."""
        if int(k) != k or k < 1:
            raise UsageError(f"decimate() takes a whole number of at least 1; got {k!r}.")
        parts = parts_of(self) if k > 1 else [slice(0, self.n)]
        starts = np.concatenate([np.arange(s.start, s.stop, int(k)) for s in parts])
        cuts = [s.start for s in parts[1:]]  # which a longer step may no longer show
        told = {PARTS[1]: np.searchsorted(cuts, np.arange(self.n), "right")} if cuts else {}
        coarse = self.with_(meta={**self.meta, "extra": {**self.meta.get("extra", {}), **told}}).select(starts)
        if self.hold == "linear" or k == 1:
            return coarse
        width = self._by_parts(np.zeros(self.n), lambda s: np.diff(self.t[s], append=2 * self.t[s][-1] - self.t[s][-2]))
        mean = np.add.reduceat(self.inputs["v"] * width, starts) / np.add.reduceat(width, starts)
        return coarse.with_(inputs={**coarse.inputs, "v": mean})

    def running_median(self, samples: int) -> Experiment:
        """Return the run with its voltage, noisy as it was measured, replaced by the median over `samples` (odd)."""
        return self.with_(inputs={**self.inputs, "v": preprocessing.running_median(self.inputs["v"], samples)})

    def levelled(self) -> Experiment:
        """Return the run with a voltage that is constant between its steps, but was measured with noise, made so."""
        return self.with_(inputs={**self.inputs, "v": preprocessing.levelled(self.inputs["v"])})

    def delayed(self, seconds: float) -> Experiment:
        """Return the run with a voltage that acts later than its column says, earlier if `seconds` is negative.

        Before the record it is none at rest, else as at its beginning; held, it is averaged over parts of a sample."""
        if not np.isfinite(seconds) or abs(seconds) >= self.duration:
            raise UsageError(f"{self.name}: a voltage can be delayed by less than the {self.duration:.4g} s of the "
                             f"run; got {seconds!r}.")

        def later(s: slice) -> Array:
            v, rates = self.inputs["v"][s], [np.diff(y[s]) if c == "theta" else y[s] for c, y in self.outputs.items()]
            rest = all(abs(r[0]) < 0.05 * np.abs(r).max(initial=0.0, where=np.isfinite(r)) for r in rates)
            return preprocessing.delayed(self.t[s], v, self.hold, seconds, 0.0 if rest else float(v[0]))

        return self.with_(inputs={**self.inputs, "v": self._by_parts(self.inputs["v"], later)})

    def without_spikes(self) -> Experiment:
        """Return the run with single samples that stand far from both neighbours marked as missing.

        Not next to jumps of the voltage, where the motor is quick; at least three, at most 5 % of a channel. Of speed
        and angle, two or three in a row that jump there and back are left out too, what jumps beyond all else and
        fades, and zeros, up to a fifth, amid what stays far from them: a mass cannot. Of a part, those of the whole."""
        free, known = "tau_load" not in self.inputs, self.meta.get("spikes")  # a blow of the load may be as short
        outputs = {c: preprocessing.without_spikes(self.t, y, self.inputs["v"], inert=free and c != "i")
                   if known is None else np.where(np.isin(self.t, known.get(c, ())), np.nan, y)
                   for c, y in self.outputs.items()}
        lost = any(np.isnan(outputs[c]).sum() > np.isnan(y).sum() for c, y in self.outputs.items())
        return self.with_(outputs=outputs) if lost else self

    def _by_parts(self, y: Array, read: Callable[[slice], Array]) -> Array:
        """Return `y` read anew, each part between pauses by itself: nothing of one goes into the next."""
        y = y.copy()
        for s in parts_of(self):
            y[s] = read(s)
        return y

    def __reduce__(self) -> tuple[Any, ...]:
        # A mappingproxy cannot be pickled, so hand plain dicts to the constructor of the other process.
        values = (getattr(self, f.name) for f in dataclasses.fields(self))
        return Experiment, tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)

    def card(self) -> Card:
        """Return the channels with their ranges and missing samples."""
        rows = []
        for name, y in (*self.inputs.items(), *self.outputs.items()):
            good = y[np.isfinite(y)]
            limits = f"{number(good.min(), 3)} … {quantity(good.max(), self.units[name], 3)}" if len(good) else "–"
            missing = Flag(f"{len(y) - len(good)} of {len(y)}", "note") if len(good) < len(y) else "none"
            rows.append([f"{NAMES[name]} {name}", limits, missing])
        head = (f"{self.n} samples in {duration(self.duration)}, {number(1e3 * self.dt, 3)} ms apart; "
                f"input {'constant' if self.hold == 'zoh' else 'linear'} between samples.")
        return Card(f"Run {self.name}", text=(head, *(str(n) for n in self.meta.get("notes", ()))),
                    tables=(Table(["channel", "range", "missing samples"], rows),),
                    after=(("mi.plot_runs(run)", "see it"), ("mi.fit(mi.dc_motor(), [run])", "fit a model")))

    def __repr__(self) -> str:
        shown = ", ".join((*self.inputs, "→", *self.channels)).replace(", →,", " →")
        return f"<Experiment {self.name!r}: {shown}; {self.n} samples, {self.duration:.4g} s>"


def units_of(runs: Iterable[Experiment]) -> dict[str, str]:
    """Return the SI unit of each channel in `runs`."""
    return {c: unit for run in runs for c, unit in run.units.items()}


def split(experiment: Experiment, n: int = 2) -> list[Experiment]:
    """Cut a run into `n` contiguous blocks of about equal length: neighbours of single samples tell nearly the same."""
    if int(n) != n or n < 1:
        raise UsageError(f"split() takes a whole number of blocks of at least 1; got {n!r}.")
    edges = np.linspace(0, experiment.n, int(n) + 1).round().astype(int)
    return [experiment.select(slice(a, b)).with_(name=f"{experiment.name}[{j}/{n}]")
            for j, (a, b) in enumerate(pairwise(edges), 1)]


def windows(experiment: Experiment, seconds: float) -> list[Experiment]:
    """Cut a run into windows of about `seconds`, each to be simulated from its own state; what is cut stays so."""
    if "window" in experiment.meta:
        return [experiment]
    if not 0 < seconds < np.inf:
        raise UsageError(f"a window takes a time in seconds; got {seconds!r}.")
    if seconds < 8 * experiment.dt:
        raise UsageError(f"a window of {seconds:g} s holds fewer than 8 samples, {experiment.dt:.3g} s apart.")
    return [p.with_(meta={**part_meta(r, p), "window": seconds, "judged from": p.t[0]})
            for r in between_pauses(experiment)
            for p in split(r, max(min(round(r.duration / seconds), r.n // MIN_SAMPLES), 1))]


def part_meta(run: Experiment, part: Experiment) -> dict[str, Any]:
    """Return what a part of a run, simulated from its own state, keeps: its record, where that began, how far it is."""
    begun = dict[str, float]()
    if "theta" in run.outputs:
        begun["origin"] = float(run.outputs["theta"][0] - run.moved("theta")[0])
    elif "omega" in run.outputs:
        angle = np.interp(part.t[0], run.t, integral(run.t, bridged(run.t, run.outputs["omega"])))
        begun["travelled"] = run.meta.get("travelled", 0.0) + float(angle)
    return {**run.meta, **part.meta, "record": record_of(run), **begun}


def record_of(run: Experiment) -> str:
    """Return which record a run is a part of, itself if it is whole: what restarts with a record has not there."""
    samples = b"".join(y.tobytes() for y in (*run.inputs.values(), *run.outputs.values()))
    return run.meta.get("record") or f"{run.name}/{crc32(samples):08x}"


def pauses(t: Array) -> NDArray[np.intp]:
    """Return the indices of the samples before a pause in `t` (N,): more than five usual steps, and more than 0.1 s (or
    1 % of a short record). With more than ten gaps the usual step is the eleventh longest: a lossy logger."""
    steps = np.diff(t)
    usual = max(float(np.median(steps)), float(np.sort(steps)[-11]) if len(steps) > 20 else 0.0)
    return np.flatnonzero(steps > max(5 * usual, min(0.1, (t[-1] - t[0]) / 100)))


def parts_of(run: Experiment) -> list[slice]:
    """Return the parts of a run between pauses: gaps in time, see `pauses`, or changes in its extra columns `PARTS`.
    Those of fewer than 8 samples, or without a value, are left out, where others are left."""
    extra = dict(run.meta["extra"]) if isinstance(run.meta.get("extra"), Mapping) else {}
    told = (a for c in PARTS if (a := np.asarray(extra.get(c))).shape == run.t.shape)
    marks = [np.flatnonzero(np.nan_to_num(np.diff(a))) for a in told if a.dtype.kind in "biuf"]
    cuts = np.unique(np.concatenate([pauses(run.t), *marks])) if run.meta.get("parts", ()) is not None else np.empty(0)
    parts = [slice(a, b) for a, b in pairwise([0, *(cuts + 1).tolist(), run.n]) if b - a >= MIN_SAMPLES]
    return [s for s in parts if any(np.isfinite(y[s]).any() for y in run.outputs.values())] or [slice(0, run.n)]


def between_pauses(run: Experiment) -> list[Experiment]:
    """Return the parts of a run as runs of their own; where the clock starts again so does a record."""
    if (parts := parts_of(run)) == [slice(0, run.n)]:
        return [run]
    whole, notes = record_of(run), [run.meta.get("notes", ()), *[()] * len(parts)]  # told once
    return [p.with_(name=f"{run.name}[{k + 1}]", meta={**p.meta, "parts": None, "notes": notes[k], "record":
            f"{whole}/{p.meta.get('extra', {}).get(PARTS[0], '0')[0]}"}) for k, p in enumerate(map(run.select, parts))]


def _frozen_array(values: ArrayLike, what: str, run: str) -> Array:
    try:
        raw = np.ma.filled(values, np.nan) if np.ma.isMaskedArray(values) else np.asarray(values)
        if raw.dtype.kind not in "fiubO":
            raise TypeError(f"dtype {raw.dtype}")
        array = np.array(raw, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{run}: '{what}' must be a row of real numbers ({error}).") from None
    if array.ndim != 1:
        raise DataError(f"{run}: '{what}' must have one dimension; its shape is {array.shape}.")
    array.flags.writeable = False
    return array


def _check_time(t: Array, run: str) -> None:
    if len(t) < MIN_SAMPLES:
        raise DataError(f"{run}: a run needs at least {MIN_SAMPLES} samples; this one has {len(t)}.")
    if not np.isfinite(t).all():
        raise DataError(f"{run}: the time of sample {int(np.argmin(np.isfinite(t)))} is not a finite number.")
    if (back := np.flatnonzero(np.diff(t) <= 0)).size:
        j = int(back[0])
        raise DataError(f"{run}: time must increase strictly, but sample {j + 1} (t = {t[j + 1]:.9g} s) does "
                        f"not come after sample {j} (t = {t[j]:.9g} s); {back.size} such steps. "
                        "Remove or re-stamp these samples.")


def _channels(given: object, known: tuple[str, ...], kind: str, t: Array, run: str) -> Mapping[str, Array]:
    if not isinstance(given, Mapping) or not given:
        raise DataError(f"{run}: {kind}s must be a mapping with at least one of {', '.join(known)}.")
    arrays = {}
    for name, values in given.items():
        among(name, known, f"{kind} channel", DataError, f"{run}: ")
        arrays[name] = _frozen_array(values, str(name), run)
        if len(arrays[name]) != len(t):
            raise DataError(f"{run}: '{name}' has {len(arrays[name])} samples but time has {len(t)}.")
    return MappingProxyType(arrays)


def _check_values(run: Experiment) -> None:
    if "v" not in run.inputs:
        raise DataError(f"{run.name}: the input 'v' (drive voltage or command) is missing; a simulation needs it.")
    for name, array in run.inputs.items():
        if bad := int(np.count_nonzero(~np.isfinite(array))):
            raise DataError(f"{run.name}: the input '{name}' is missing or infinite in {bad} of {run.n} "
                            "samples; a simulation needs it everywhere. Fill it or cut these samples out.")
    for name, array in run.outputs.items():
        if np.isinf(array).any():
            raise DataError(f"{run.name}: '{name}' holds infinite values; mark missing samples by NaN.")
    if not any(np.isfinite(a).any() for a in run.outputs.values()):
        raise DataError(f"{run.name}: no output channel has a single value; all samples of "
                        f"{', '.join(run.outputs)} are missing.")


def _sigmas(run: Experiment) -> Mapping[str, float]:
    for name, value in run.sigma.items():
        among(name, CHANNELS, "channel in sigma", DataError, f"{run.name}: ")
        if not (isinstance(value, Real) and np.isfinite(value) and value > 0):
            raise DataError(f"{run.name}: sigma of '{name}' must be a positive number; got {value!r}.")
    return MappingProxyType({k: float(s) for k, s in run.sigma.items() if k in run.outputs})


def _units(run: Experiment) -> Mapping[str, str]:
    for name, unit in run.units.items():
        among(name, UNITS, "channel in units", DataError, f"{run.name}: ")
        if unit not in UNITS[name]:
            raise DataError(f"{run.name}: '{name}' is kept in {' or '.join(UNITS[name])}, not in {unit!r}; "
                            "convert it first (read_csv does).")
    present = (*run.inputs, *run.channels)
    given = {k: u for k, u in run.units.items() if k in present}
    linear = {u in ("m", "m/s") for k, u in given.items() if k in ("omega", "theta")}
    if len(linear) > 1:
        raise DataError(f"{run.name}: omega in {given['omega']} does not go with theta in {given['theta']}.")
    return MappingProxyType({c: UNITS[c][-1 if True in linear and c in ("omega", "theta") else 0]
                             for c in present} | given)


def repeated(runs: Sequence[Experiment], held_out: Sequence[Experiment]) -> str:
    """Say which held-out runs are among the fitted ones; empty if none is."""
    def mark(run: Experiment) -> Any:  # not the file's: parts of one may well be fitted and held out
        return run.n, *(y[np.isfinite(y)].sum() for y in run.outputs.values())

    fitted = {mark(run) for run in runs}
    moving = [run for run in held_out if any(len(np.unique(y[np.isfinite(y)])) > 1 for y in run.outputs.values())]
    same = [run.name for run in moving if mark(run) in fitted]  # a rest is no record
    return f"{', '.join(same)} is both fitted and held out: its held-out error means nothing." if same else ""

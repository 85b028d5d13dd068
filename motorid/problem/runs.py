"""Records made ready for estimation: `prepare_run` gives a record its noise, its grid and its initial state."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from motorid.channels import CHANNELS, COMPUTED_INPUTS, NAMES
from motorid.errors import ModelError, among
from motorid.integrate.engine import Grid
from motorid.model.definition import Parameter
from motorid.numerics.signals import Array, bridged, going_on, integral, left_out, noise_level, window_slopes
from motorid.records.experiment import Experiment

INITIAL = ("auto", "rest", "measured", "estimate")
FIRST = 5  # samples that tell it
LONGEST = 256  # samples that tell how fast an angle is at the first
REACH = 8.0  # standard deviations that an estimated initial state may lie away from its first samples
SGN_WIDTH_SHARE = 1e-3  # of the highest speed: wider smoothing looks like one more missing effect
CREEP_SHARE = 0.2  # of the angle's noise that a stuck motor may creep
NARROWEST = 1e-5  # of the highest speed
FINEST = 256  # sub-steps per sample
OFF, SAME = 0.02, 1e-6  # of the largest voltage: as good as none; what averaging may change

# A record is frozen, and so are its noise and its size.
_levels: WeakKeyDictionary[Experiment, dict[str, float]] = WeakKeyDictionary()
_sizes: "WeakKeyDictionary[Experiment, _Sizes]" = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Run:
    """One record as the solver sees it."""

    experiment: Experiment
    grid: Grid
    sigma: Mapping[str, float]  # noise per channel, SI
    start: Array  # (3,) (i, omega, theta) at the first sample: known, measured or the first guess
    limits: Mapping[str, tuple[float, float]]  # which of them are unknowns of the fit, and between which values
    # values of this run's own of parameters that are others in every run
    apart: Mapping[str, float] = field(default_factory=dict)
    unseen: Sequence[int] = ()  # samples after which a few are left out, one of which a step of the voltage may be


def prepare_run(run: Experiment, channels: Sequence[str], noise: Mapping[str, float], inputs: Sequence[str],
                initial: str) -> Run:
    """Return `run` ready for a system with `inputs`."""
    sigma = {c: float(run.sigma.get(c, noise[c])) for c in channels if c in run.outputs}
    start, limits = initial_state(run, sigma, initial)
    v, more = run.inputs["v"], left_out(run.t) * (run.hold == "zoh")
    unseen = np.flatnonzero((more > 0) & (np.abs(np.diff(v)) > OFF * np.abs(v).max()) & (going_on(run.t, v) == 0))
    return Run(run, _grid(run, inputs), sigma, start, limits, unseen=tuple(map(int, unseen)))


def with_inputs(run: Run, inputs: Sequence[str]) -> Run:
    """Return the run with the grid of other inputs and the same sub-steps."""
    return replace(run, grid=_grid(run.experiment, inputs).with_substeps(run.grid.substeps))


def _grid(run: Experiment, inputs: Sequence[str]) -> Grid:
    for name in inputs:
        if name not in ("theta_in", *COMPUTED_INPUTS, *run.inputs):
            raise ModelError(f"{run.name}: the model needs the input '{name}' ({NAMES[name]}), which the record lacks. "
                             "Name its column with columns, or leave the effect out.")
    columns = [angle_signal(run) if n == "theta_in" else time_since(run, n) if n in COMPUTED_INPUTS else run.inputs[n]
               for n in inputs]
    return Grid.of(run.t, np.column_stack(columns), np.array(zoh_inputs(inputs, run.hold)))


def zoh_inputs(inputs: Sequence[str], hold: str) -> list[bool]:
    """Tell which inputs stay constant between samples: what is measured goes on, and so may the voltage."""
    return [n in COMPUTED_INPUTS or (n == "v" and hold == "zoh") for n in inputs]


def time_since(run: Experiment, name: str) -> Array:
    """Return one of the times since the voltage did something, in the middle of each sample, (N,), s. A voltage that
    begins at zero is taken to have been there for as long as the run lasts, any other to begin."""
    t, v = run.t, run.inputs["v"]
    off = np.abs(v) <= OFF * np.abs(v).max()
    if name == "since_change":  # by more than noise, which a second difference has, a ramp hardly
        moved = np.abs(np.diff(v)) > 3.4 * np.median(np.abs(np.diff(v, 2))) + SAME * np.abs(v).max()
    elif name == "since_switch":
        moved = off[1:] != off[:-1]
    else:
        known = np.maximum.accumulate(np.where(off, 0, np.arange(len(v))))
        moved = v[known][1:] * v[known][:-1] < 0
    first = t[0] - (t[-1] - t[0]) * (off[0] or name == "since_reversal")
    since = t - np.concatenate([[first], np.maximum.accumulate(np.where(moved, t[1:], first))]) + 0.5 * run.dt
    return np.where(off, -since, since) if name == "since_switch" else since


def angle_signal(run: Experiment) -> Array:
    """Return the angle from the measurements, (N,): the measured one, bridged over gaps, or ∫ω dt."""
    if "theta" in run.outputs:
        return bridged(run.t, run.outputs["theta"])
    moved = integral(run.t, bridged(run.t, run.outputs["omega"])) if "omega" in run.outputs else np.zeros(len(run.t))
    return moved + run.meta.get("travelled", 0.0)


def noise_of(runs: Sequence[Experiment], channels: Sequence[str]) -> dict[str, float]:
    """Noise per channel where none states it: the quadratic mean over the samples of all runs in which it moves."""
    levels = {}
    for c in channels:
        each = [r.sigma.get(c) or _level(r, c) for r in runs if c in r.outputs]
        known = [(r, y[np.isfinite(y)]) for r in runs if (y := r.outputs.get(c)) is not None]
        counts = [y.size if c in r.sigma or (y.size and np.ptp(y)) else 0 for r, y in known]
        levels[c] = float(np.sqrt(np.average(np.square(each), weights=counts if any(counts) else None)))
        if not levels[c] > 0:
            raise FloatingPointError(f"the square of the noise of {c}, {max(each):.3g}, is zero")
    return levels


def _level(run: Experiment, channel: str) -> float:
    known = _levels.setdefault(run, {})
    if channel not in known:
        known[channel] = noise_level(run.outputs[channel], run.t)
    return known[channel]


def initial_state(run: Experiment, sigma: Mapping[str, float],
                  initial: str) -> tuple[Array, dict[str, tuple[float, float]]]:
    """Return i, omega, theta (3,) at the first sample, and between which limits some of them are to be estimated.

    ``auto``: known zeros where nothing moves yet, otherwise estimated; a measured angle is estimated too: its first
    sample is as noisy as any, and half a count of the finest encoder shows over a long run. Estimates stay within what
    the first samples allow, so that no model hides what it lacks in them. ``estimate``: everything, without limits."""
    among(initial, INITIAL, "initial state")
    rest, lead = at_rest(run, sigma)
    known = rest if initial == "auto" else initial == "rest"
    start, reach = np.array([0.0, 0.0, run.meta.get("travelled", 0.0)]), {}
    for k, c in enumerate(CHANNELS):
        if c not in sigma:  # not measured, or not shown by the model
            continue
        y = run.outputs[c]
        if c == "theta":
            lull = y[:lead][np.isfinite(y[:lead])]  # before the first voltage; the first samples where it creeps there
            still = known and lull.size and np.ptp(lull) < REACH * sigma[c]
            start[k] = lull.mean() if still else _first(y[:lead] if known else y)
            reach[c] = _reach(y, sigma[c])
        elif not known:
            start[k] = _first(y)
            reach[c] = _reach(y, sigma[c])
    if "theta" in run.outputs and not known:
        speed, far = _first_speed(run.outputs["theta"], run.t, sigma["theta"])
        if "omega" not in run.outputs:  # an angle of few counts tells late that a motor begins at rest
            start[1], reach["omega"] = speed, max(far, abs(speed)) if _may_rest(run, sigma, _lead(run)) else far
        elif (apart := abs(speed - start[1])) > far:  # the sensors may disagree, by an offset
            reach["omega"] = max(reach["omega"], apart + far)
    if not known:  # to assume none would be a measurement that was never made
        reach |= {c: np.inf for c, shown in (("i", {"i"}), ("omega", {"omega", "theta"})) if not shown & {*run.outputs}}
    if initial in ("rest", "measured"):
        return start, {}
    if initial == "estimate":
        return start, dict.fromkeys(reach, (-np.inf, np.inf))
    return start, {c: (start[CHANNELS.index(c)] - r, start[CHANNELS.index(c)] + r) for c, r in reach.items()}


def at_rest(run: Experiment, sigma: Mapping[str, float]) -> tuple[bool, int]:
    """Tell whether the run begins at rest, and how many samples that lasts."""
    lead = _lead(run)
    if not _may_rest(run, sigma, lead) or not (lead or {"omega", "theta"} & {*sigma}):  # which a current does not tell
        return False, 1
    if "omega" not in run.outputs and "theta" in run.outputs:
        y, t = run.outputs["theta"], run.t
        speed, _ = _first_speed(y, t, sigma["theta"])
        early, late = (part[np.isfinite(part)] for part in (y[:lead][:FIRST], y[lead - lead // 3:lead]))
        if early.size and late.size and abs(np.median(late) - np.median(early)) > REACH * sigma["theta"]:
            return False, 1  # it moves before the first voltage, however slowly
        moving = abs(speed) > 0.05 * np.max(np.abs(window_slopes(t, y)), initial=0.0)
        if (moving and not _starts_from_rest(y, t, sigma["theta"], speed)) or (
                _creeps(y[max(lead - 1, 0):], t[max(lead - 1, 0):], sigma["theta"])):
            return False, 1
    return True, max(lead, 1)


def _lead(run: Experiment) -> int:
    """Return the number of samples before the first voltage."""
    v = run.inputs["v"]
    quiet = np.abs(v) <= 1e-3 * max(np.abs(v).max(), 1e-300)
    return int(np.argmin(quiet)) if not quiet.all() else len(v)


def _may_rest(run: Experiment, sigma: Mapping[str, float], lead: int) -> bool:
    """Tell whether neither current nor speed speak against rest at the first samples."""
    # With the voltage on from the first sample, a motor at rest moves at the second: there both tell at the first.
    checked = min(max(lead, 1 if {"i", "omega"} <= sigma.keys() else 2), FIRST)  # later it may have come to rest
    for c in ("i", "omega"):
        if c in sigma:
            y = run.outputs[c][:checked]
            y = y[np.isfinite(y)]
            top = np.nanmax(np.abs(run.outputs[c]))
            # A wild first sample or an offset of the sensor is no motion; a median above the noise, or half the top is.
            if y.size and abs(np.median(y)) > min(max(5 * sigma[c], 0.02 * top), 0.5 * top):
                return False
    return True


def _starts_from_rest(theta: Array, t: Array, sigma: float, speed: float) -> bool:
    """Tell whether the first samples of an angle speak for rest and against `speed`, which later ones suggest."""
    moved, after, noise = theta[1:FIRST] - theta[0], t[1:FIRST] - t[0], 4 * np.sqrt(2) * sigma
    return bool(np.all(np.abs(moved[:2]) <= noise) and np.any(np.abs(moved - speed * after) > noise))


def _creeps(theta: Array, t: Array, sigma: float) -> bool:
    """Tell whether an angle has a first speed that its noise does not explain, however slow.

    A cubic over half of the longest window in which one describes the angle: there what it leaves out of a motion that
    begins at rest is far below its slope's noise. It does in a window twice as long if no more is left than by chance.
    """
    good = np.flatnonzero(np.isfinite(theta))[:LONGEST]
    y, x, n = theta[good], t[good] - t[0], 8
    if len(y) < n:
        return False
    speed, left = 0.0, _cubic(x[:n], y[:n])[1]
    while 2 * n <= len(y):
        free = np.array([n - 4, 2 * n - 4])
        longer = _cubic(x[:2 * n], y[:2 * n])[1]
        if longer > min(sigma**2, max(left, sigma**2 / 4)) * (1 + 3 * np.sqrt(np.sum(2 / free))):
            break
        speed, left, n = _cubic(x[:n], y[:n])[0], longer, 2 * n
    return abs(speed) > 4 * sigma


def _cubic(x: Array, y: Array) -> tuple[float, float]:
    """Return the first slope of the cubic through (x, y) over its deviation at a noise of 1, and the variance left."""
    columns = np.vander(x / x[-1], 4, increasing=True)
    inverse = np.linalg.pinv(columns)
    weights = inverse @ y
    return (float(weights[1] / np.linalg.norm(inverse[1])), float(np.sum((y - columns @ weights) ** 2) / (len(y) - 4)))


def _first(y: Array) -> float:
    good = y[np.isfinite(y)][:3]
    return float(np.median(good)) if good.size else 0.0


def _reach(y: Array, sigma: float) -> float:
    good = y[np.isfinite(y)][:FIRST]
    return REACH * sigma + (float(np.ptp(good)) if good.size else 0.0)


def _first_speed(theta: Array, t: Array, sigma: float) -> tuple[float, float]:
    """Return the first speed and its reach, over the shortest window that noise leaves useful; one that contradicts a
    shorter one has a turn in it (Lepski, Theory Probab. Appl. 36(4), 1991)."""
    good = np.isfinite(theta)
    y, s = theta[good], t[good]
    if len(y) < 4:
        return 0.0, np.inf
    top = float(np.max(np.abs(window_slopes(t, theta)), initial=0.0))
    found = list[tuple[float, float, float]]()
    for w in 2 ** np.arange(max(len(y) // 50 - 1, 0).bit_length() + 1):
        noise, ends = REACH * np.sqrt(2) * sigma / (s[w] - s[0]), [0, w, min(2 * w, len(y) - 1)]
        first, then = (np.diff(y[ends]) / np.diff(s[ends])).tolist()
        speed = first - (then - first) / 2
        if any(abs(speed - other) > noise + more for other, more, _ in found):
            break
        found.append((speed, noise, noise + abs(then - first)))
        if noise <= 0.01 * REACH * top:
            break
    return found[-1][0], float(found[-1][2])


def natural_sizes(runs: Sequence[Experiment], values: Mapping[str, float]) -> dict[str, float]:
    """Return the natural size of each unit in these records: torque is that at the highest current, time the sample
    time, heat what the winding loses in the longest run for 30 K; ``lowest``, ``highest``: ends of the angle."""
    seen = [_sizes_of(r) for r in runs]
    volt = max(s.volt for s in seen) or 1.0
    speed = max(s.speed for s in seen) or volt / max(values.get("K", 1.0), 1e-9)
    resistance = values.get("R", 1.0)
    ampere = max(s.ampere or 0.0 for s in seen) or volt / resistance
    torque = values["g"] * volt if "g" in values else values.get("K", 1.0) * ampere
    second = float(np.median([r.dt for r in runs]))
    # A current that was not measured is taken for about what the voltage would make.
    squares = (s.squared_volt / max(resistance, 1e-9) ** 2 / 4 if s.squared_ampere is None else s.squared_ampere
               for s in seen)
    heats = [(r.duration, resistance * square) for r, square in zip(runs, squares, strict=True)]
    duration, power = max(heats, key=lambda h: h[0] * h[1])
    low, high = min(s.ends[0] for s in seen), max(s.ends[1] for s in seen)
    sizes = {"V": volt, "A": ampere, "rad/s": speed, "m/s": speed, "N·m": torque, "N": torque, "s": second,
             "Ω": volt / ampere, "1/s": 1 / second, "m": 0.01 * (high - low), "K/W": 30 / max(power, 1e-9),
             "J/K": max(power * duration, 1e-9) / 30, **dict.fromkeys(("s/rad", "s/m"), 1 / speed),
             **dict.fromkeys(("N·m·s/rad", "N·s/m"), torque / speed),
             **dict.fromkeys(("N·m·s²/rad²", "N·s²/m²"), torque / speed**2),
             **dict.fromkeys(("N·m/rad", "N/m"), torque / max(high - low, 1e-9))}
    return {k: v if np.isfinite(v) and v > 0 else 1.0 for k, v in sizes.items()} | {"lowest": low, "highest": high}


def shapes_of(parameter: Parameter, sizes: Mapping[str, float]) -> list[float]:
    """Return the values in the grid of a shape parameter, in its unit, where these are the natural sizes."""
    ends = (sizes["lowest"], sizes["highest"]) if parameter.place else (0.0, sizes.get(parameter.unit, 1.0))
    return [ends[0] + share * (ends[1] - ends[0]) for share in parameter.grid]


def combined(axes: Mapping[str, Iterable[float]]) -> list[dict[str, float]]:
    """Return all combinations of values by name; of no axis the one of nothing."""
    return [dict(zip(axes, point, strict=True)) for point in product(*axes.values())]


def spread_of(run: Experiment, channel: str) -> float:
    """Return the standard deviation of a channel; 1 where it was not measured."""
    return _sizes_of(run).spread.get(channel, 1.0)


def top_speed(runs: Sequence[Experiment]) -> float:
    """Highest speed in the runs (99.5th percentile), from speed or angle; 0 where neither is there."""
    return max((_sizes_of(r).speed for r in runs), default=0.0)


def top_acceleration(runs: Sequence[Experiment]) -> float:
    """Largest acceleration over about 200 windows of a run, rad/s², from speed or angle; 0 for next to no samples."""
    seen = [(r.t, r.outputs["omega"]) if "omega" in r.outputs else
            (np.linspace(r.t[0], r.t[-1], len(speeds := window_slopes(r.t, r.outputs["theta"]))), speeds)
            for r in runs if {"omega", "theta"} & r.outputs.keys()]
    return max((float(np.abs(window_slopes(*known)).max(initial=0.0)) for known in seen), default=0.0)


def suited(parameter: Parameter, sizes: Mapping[str, float]) -> Parameter:
    """Return a parameter of an effect with a starting value that suits the data, unless the user gave one."""
    if parameter.given or parameter.name == "sgn_width":
        return parameter
    size, value = sizes.get(parameter.unit), parameter.value
    if parameter.null == 0 and size is not None and not parameter.positive:
        value = 0.02 * size
    elif parameter.grid and (size is not None or parameter.null is None):
        value = shapes_of(parameter, sizes)[len(parameter.grid) // 2]
    return replace(parameter, value=float(np.clip(value, parameter.lower, parameter.upper)))


class _Sizes(NamedTuple):
    """How large the signals of a record are; None where a channel was not measured."""

    volt: float
    speed: float
    ampere: float | None
    squared_volt: float
    squared_ampere: float | None
    spread: Mapping[str, float]
    ends: tuple[float, float]


def _sizes_of(run: Experiment) -> _Sizes:
    if run not in _sizes:
        v = run.inputs.get("v", np.zeros(1))
        i, omega, theta = (None if (y := run.outputs.get(c)) is None else y[np.isfinite(y)] for c in CHANNELS)
        slopes = np.zeros(1) if theta is None else window_slopes(run.t, run.outputs["theta"])
        speeds = slopes if omega is None else omega
        _sizes[run] = _Sizes(float(np.abs(v).max()),
                             float(np.percentile(np.abs(speeds), 99.5)) if speeds.size else 0.0,
                             None if i is None else float(np.percentile(np.abs(i), 99.5)),
                             float(np.mean(v**2)), None if i is None else float(np.mean(i**2)),
                             {c: float(np.std(y[np.isfinite(y)])) for c, y in run.outputs.items()},
                             (float(np.min(angle := angle_signal(run))), float(np.max(angle))))
    return _sizes[run]


def first_width(runs: tuple[Experiment, ...], parameters: Mapping[str, Parameter]) -> float | None:
    """Return the width of sgn to begin with, None if given or unused; the voltage narrows it where no speed does."""
    if (p := parameters.get("sgn_width")) is None or p.given:
        return None
    values = {n: q.value for n, q in parameters.items()}
    return suited_width(runs, 1.0) or min(p.value, SGN_WIDTH_SHARE * natural_sizes(runs, values)["rad/s"])


@lru_cache(maxsize=64)
def suited_width(runs: tuple[Experiment, ...], noise: float) -> float | None:
    """Return the width of sgn that suits the speeds in the data, `noise` times as noisy as they seem."""
    if (speed := top_speed(runs)) <= 0:
        return None
    # A smooth sgn lets a loaded, stuck motor creep; over the longest standstill that must stay below the noise of
    # the angle, or the creep looks like an effect of its own.
    allowed = CREEP_SHARE * noise
    creep = min((allowed * noise_level(r.outputs["theta"], r.t) / still for r in runs if "theta" in r.outputs
                 and (still := _longest_standstill(r, speed)) > 0), default=np.inf)
    return float(np.clip(creep, narrowest_width(runs), SGN_WIDTH_SHARE * speed))


def narrowest_width(runs: Sequence[Experiment]) -> float:
    """Return the least width of sgn: what the finest sub-step changes the speed by, or it jumps over it."""
    return max(NARROWEST * top_speed(runs), max(_speed_gained(r) for r in runs) / FINEST)


def _speed_gained(run: Experiment) -> float:
    """Change of speed per sample where the angle is accelerated most, rad/s; 0 without an angle."""
    speeds = window_slopes(run.t, run.outputs["theta"]) if "theta" in run.outputs else ()
    return 0.0 if len(speeds) < 3 else float(np.percentile(np.abs(np.diff(speeds)), 95)) * len(speeds) / run.n


def _longest_standstill(run: Experiment, speed: float) -> float:
    """Longest time without motion, s, from the angle."""
    s = np.abs(window_slopes(run.t, run.outputs["theta"])) < 0.01 * speed
    edges = np.flatnonzero(np.diff(s.astype(int), prepend=0, append=0))
    return float(np.max(edges[1::2] - edges[::2], initial=0)) * run.duration / max(len(s), 1)

"""Steady parts of a record: where the input is held and no measured channel moves any more."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motorid.numerics.signals import Array, bridged, integral, slope, window_slopes
from motorid.records.experiment import Experiment

LEAST = 16  # samples
INPUT_SHARE = 0.02  # of the largest input: how far a held input may wander, and below which it counts as off
DRIFT_SHARE = 1e-3  # of a channel's largest value: a smaller change between the halves is no drift
FAR, DEPARTED = 4.0, 0.65  # standard deviations, and share of the farthest: a motor on its way
DRIVE_SHARE = 0.05  # of what drives a motor: as much may still accelerate it, hidden by noise
MOVING_SHARE = 0.01  # of the top speed: slower than this is standstill


@dataclass(frozen=True)
class SteadySegment:
    """One steady part of a run."""

    run: int  # its index
    first: int  # sample
    last: int
    begin: float  # s
    end: float
    v: float  # mean input
    means: Mapping[str, float]  # i (A), omega (rad/s) where measured; without a speed omega is the slope of the angle
    moving: bool  # False at standstill, where dry friction makes the torque balance undetermined

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.last - self.first + 1

    def __str__(self) -> str:
        shown = ", ".join(f"{c} = {x:.4g}" for c, x in self.means.items())
        return f"run {self.run}, {self.begin:.4g} to {self.end:.4g} s: v = {self.v:.4g}, {shown}"


def find_segments(runs: Sequence[Experiment], sigma: Sequence[Mapping[str, float]]) -> tuple[SteadySegment, ...]:
    """Return the steady parts of `runs`, at most one per stretch of held input, the longest that ends it. It counts
    where the two halves of the stretch's tail agree in every channel within four standard errors or 0.1 % of its
    largest value, and at most 5 % of the drive still accelerate. Parts without input and motion do not."""
    return tuple(tail for k, run in enumerate(runs) for first, last in _constant_stretches(run.inputs["v"])
                 if (tail := _steady_tail(k, run, sigma[k], first, last)))


def segment_between(k: int, run: Experiment, begin: float, end: float) -> SteadySegment | None:
    """Return the segment of run `k` between two times the user names; None if it has too few samples."""
    inside = np.flatnonzero((run.t >= begin) & (run.t <= end))
    return _segment(k, run, int(inside[0]), int(inside[-1])) if inside.size >= 2 else None


def _constant_stretches(v: Array) -> list[tuple[int, int]]:
    """Longest stretches (first, last) in which the input stays within a band around its running mean."""
    band = INPUT_SHARE * max(float(np.abs(v).max()), 1e-300)
    stretches, first = [], 0
    low = high = v[0]
    for k, value in enumerate(v):
        low, high = min(low, value), max(high, value)
        if high - low > band:
            stretches.append((first, k - 1))
            first, low, high = k, value, value
    return [(a, b) for a, b in [*stretches, (first, len(v) - 1)] if b - a + 1 >= LEAST]


def _steady_tail(k: int, run: Experiment, sigma: Mapping[str, float], first: int, last: int) -> SteadySegment | None:
    for share in (0.75, 0.5, 0.25, 0.125):
        begin = last - int(share * (last - first + 1)) + 1
        if last - begin + 1 < LEAST:
            return None
        if all(_level(run, c, sigma, begin, last) for c in run.outputs):
            s = _segment(k, run, begin, last)
            idle = abs(s.v) <= INPUT_SHARE * float(np.abs(run.inputs["v"]).max()) and not s.moving
            if not s.moving or "omega" not in s.means or _accelerating(run, first, s) <= DRIVE_SHARE:
                return None if idle else s
    return None


def _accelerating(run: Experiment, first: int, s: SteadySegment) -> float:
    """Return the share of the drive that still accelerates in a part, by the way there from sample `first` on; 0 if
    none: it takes J/K Δω = ∫(i − ī)dt, and falls with ∫(ω̄ − ω)dt/Δω; without a current friction is viscous."""
    seen, level = run.outputs["omega" if "omega" in run.outputs else "theta"], s.means.get("i", s.means["omega"]) or 1.0
    y = bridged(run.t, seen)
    short = s.means["omega"] - (y if "omega" in run.outputs else slope(run.t, y, 4))
    far = np.abs(short[first:s.first + 1]) * np.isfinite(seen[first:s.first + 1])
    if far.max() <= FAR * short[s.first:s.last + 1].std():
        return 0.0
    way = slice(begin := first + int(np.flatnonzero(far > DEPARTED * far.max())[-1]), s.first + 1)
    drive = bridged(run.t, run.outputs["i"]) - s.means["i"] if "i" in s.means else short
    lag = integral(run.t[way], short[way])[-1] / (short[begin:begin + 3].mean() or 1.0)
    left = np.exp(-(s.begin - run.t[begin]) / max(lag, run.dt)) / (s.end - s.begin)
    return float(abs(integral(run.t[way], drive[way])[-1] / level) * left)


def _level(run: Experiment, channel: str, sigma: Mapping[str, float], first: int, last: int) -> bool:
    y = run.outputs[channel]
    if channel == "theta":
        if "omega" in run.outputs:
            return True
        halves = [_slope(run, first, (first + last) // 2), _slope(run, (first + last) // 2, last)]
        allowed = max(4 * 2 * sigma[channel] / ((run.t[last] - run.t[first]) / 2), DRIFT_SHARE * _top_slope(run))
        return bool(np.isfinite(halves).all() and abs(halves[1] - halves[0]) <= allowed)
    middle = (first + last + 1) // 2
    a, b = (part[np.isfinite(part)] for part in (y[first:middle], y[middle:last + 1]))
    if min(a.size, b.size) < LEAST // 4:
        return False
    error = sigma[channel] * np.sqrt(1 / a.size + 1 / b.size)
    return bool(abs(a.mean() - b.mean()) <= max(4 * error, DRIFT_SHARE * float(np.nanmax(np.abs(y)))))


def _segment(k: int, run: Experiment, first: int, last: int) -> SteadySegment:
    part = slice(first, last + 1)
    means = {c: float(np.nanmean(run.outputs[c][part])) for c in ("i", "omega")
             if c in run.outputs and np.isfinite(run.outputs[c][part]).any()}
    if "omega" not in run.outputs and "theta" in run.outputs and np.isfinite(slope := _slope(run, first, last)):
        means["omega"] = slope
    top = float(np.nanmax(np.abs(run.outputs["omega"]))) if "omega" in run.outputs else _top_slope(run)
    moving = abs(means["omega"]) > MOVING_SHARE * top if "omega" in means else True
    return SteadySegment(k, first, last, float(run.t[first]), float(run.t[last]),
                         float(np.mean(run.inputs["v"][part])), means, bool(moving))


def _slope(run: Experiment, first: int, last: int) -> float:
    t, y = run.t[first:last + 1], run.outputs["theta"][first:last + 1]
    good = np.isfinite(y)
    return float(np.polyfit(t[good] - t[0], y[good], 1)[0]) if good.sum() > 2 else float("nan")


def _top_slope(run: Experiment) -> float:
    y = run.outputs.get("theta")
    return 0.0 if y is None else float(np.abs(window_slopes(run.t, y)).max(initial=0.0))

"""Preprocessing of signals: unwrap an angle, filter or delay the voltage, mark the spikes of a sensor as missing."""

from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from motorid.errors import UsageError
from motorid.numerics.signals import Array, integral, noise_level, quantum, robust_std

CLEAR = np.pi / 2  # rad: a step of the angle this far from what is expected may be a turn or none
BESIDE = 3  # samples on either side of a jump of the angle that show whether the shaft goes on
JUMP = 7.0  # times the noise of the voltage: a step
SHORTEST = 6  # samples that have a level
PEAK = 6  # samples after a jump of the voltage, where the current has a peak
FEWEST = 20  # finite samples among which one can stand out
LEAST, MOST = 3, 0.05  # spikes of a channel: fewer may be chance, a larger share is no accident
MOST_LOST = 0.2  # share of readings that failed
AROUND = 25  # samples before and after a reading that failed, which it stands out of
BEYOND = 1.5  # times the largest value else, which no blow gives a mass
LONGEST = 3  # samples of a burst: a logger's line or two that are lost; longer ones may be a blow


def unwrapped(theta: Array, t: Array, omega: Array | None = None) -> tuple[Array, float, int]:
    """Return an angle (N,) that was taken modulo a turn, or a counter's range, as it went on; the jump, and how many.
    With a measured speed `omega`, rad/s, it may turn by more than half a turn from sample to sample."""
    seen = np.flatnonzero(np.isfinite(theta))
    turn, y = 2 * np.pi, theta[seen]
    steps = np.diff(y)
    if len(seen) < FEWEST:
        return theta, turn, 0
    modulus = _modulus(steps, float(np.ptp(y)))
    if abs(modulus - turn) > 0.02 * turn and modulus:
        jumps, turn = -np.sign(steps) * (np.abs(steps) > np.ptp(y) / 2), modulus
    elif np.pi < np.ptp(y) < 1.01 * turn:
        expected = np.zeros_like(steps)
        if omega is not None and np.isfinite(omega[seen]).all():
            expected = (omega[seen][1:] + omega[seen][:-1]) / 2 * np.diff(t[seen])
        jumps = np.round((expected - steps) / turn)
        left = np.abs(steps + jumps * turn - expected)
        if not jumps.any() or max(np.quantile(left, 0.99), left[jumps != 0].max()) > CLEAR:
            return theta, turn, 0
    else:
        return theta, turn, 0
    on = theta.copy()
    on[seen[1:]] += turn * np.cumsum(jumps)
    return on, turn, int(np.count_nonzero(jumps))


def _modulus(steps: Array, reach: float) -> float:
    """Return by how much an angle jumps back, always alike, while the shaft goes on: a counter's range; else 0."""
    large = np.abs(steps) > reach / 2
    at = np.flatnonzero(large)
    usual = float(np.abs(steps[~large]).max(initial=0.0))
    beside = at[(at >= BESIDE) & (at < len(steps) - BESIDE)]
    if not len(beside) or usual > reach / 3:
        return 0.0
    calm = np.where(large, 0.0, steps)
    before, after = (np.array([calm[k + a:k + b].mean() for k in beside]) for a, b in ((-BESIDE, 0), (1, BESIDE + 1)))
    sizes = np.abs(steps[beside] - (before + after) / 2)[(before * steps[beside] < 0) & (after * steps[beside] < 0)]
    modulus = float(np.median(sizes)) if len(sizes) else 0.0
    alike = np.abs(sizes - modulus).max(initial=0.0) < 0.02 * modulus
    return modulus if alike and np.abs(np.abs(steps[at]) - modulus).max() < 1.5 * usual else 0.0


def running_median(v: Array, samples: int) -> Array:
    """Return the running median of an input over an odd number of samples."""
    if int(samples) != samples or samples < 1 or samples % 2 == 0:
        raise UsageError(f"running_median() takes an odd number of samples, 1 or more; got {samples!r}.")
    if samples > len(v):
        raise UsageError(f"a running median over {samples} samples is longer than the record of {len(v)}.")
    return scipy.ndimage.median_filter(v, int(samples), mode="nearest")


def levelled(v: Array) -> Array:
    """Return an input as its means between jumps, where what lies between two jumps is no more than noise."""
    changes = np.diff(v)
    noise = robust_std(changes) / np.sqrt(2)
    ends = np.concatenate([[0], np.flatnonzero(np.abs(changes) > JUMP * noise) + 1, [len(v)]])
    level = v.copy()
    for a, b in pairwise(ends.tolist()):
        part, half = v[a:b], (b - a) // 2
        if b - a >= SHORTEST and np.std(part) < 1.5 * noise and abs(part[:half].mean() - part[half:].mean()) < noise:
            level[a:b] = part.mean()
    return level


def delayed(t: Array, v: Array, hold: str, seconds: float, before: float) -> Array:
    """Return an input that acts `seconds` later, and was `before` before; a held one is averaged over each step."""
    at = t - seconds
    if hold == "linear":
        return np.interp(at, t, v, left=before)
    ends = np.concatenate([[min(at[0], t[0])], t, [max(at[-1], t[-1])]])
    sums = integral(ends, np.concatenate([[before], v, v[-1:]]), hold=True)
    return np.append(np.diff(np.interp(at, ends, sums)) / np.diff(at),
                     np.append(before, v)[np.searchsorted(t, at[-1], side="right")])


def without_spikes(t: Array, y: Array, v: Array, inert: bool = False) -> Array:
    """Return an output with samples that no motor makes marked as missing, the same array for none: single ones, of
    which a few may be chance; of what is `inert`, bursts, what fades and zeros too. A large share is no accident."""
    if np.isfinite(y).sum() < FEWEST:
        return y
    at = at if len(at := spikes(t, y, v)) >= LEAST else at[:0]
    if inert and np.ptp(v) > 0:  # a step shows how fast the motor is
        at = np.union1d(np.union1d(at, bursts(t, y, v)), fading(t, y, v))
    at = at if len(at) <= MOST * len(t) else at[:0]
    lost = dropouts(y) if inert else at[:0]
    at = np.union1d(at, lost) if LEAST <= len(lost) <= MOST_LOST * len(t) else at
    if not len(at):
        return y
    y = y.copy()
    y[at] = np.nan
    return y


def bursts(t: Array, y: Array, v: Array) -> NDArray[np.intp]:
    """Return which samples, two to `LONGEST` in a row, jump away and back at one voltage, twice as far as ever else:
    what has a mass cannot. From rest and back it slips; what rings swings back by less than half, or again."""
    seen = np.flatnonzero(np.isfinite(y))
    changes, level = np.diff(y[seen]), np.append(0, np.cumsum(np.abs(np.diff(v)) > 0.02 * np.ptp(v)))  # of the voltage
    sizes, least = np.abs(changes), 12 * noise_level(y, t)
    found = [(a, b) for a, b in pairwise(np.flatnonzero(sizes > max(8 * np.quantile(sizes, 0.9), least)).tolist())
             if 2 <= b - a <= LONGEST and -2 < changes[a] / changes[b] < -0.5
             and level[seen[b]] == level[seen[a + 1]] < level[max(seen[a] - PEAK, 0)] + 2]
    usual = np.delete(sizes, np.array(found, int).ravel()).max(initial=0.0)
    far = [seen[a + 1:b + 1] for a, b in found
           if min(sizes[a], sizes[b]) > 2 * usual and max(np.abs(y[seen[[a, b + 1]]])) > least]
    return np.concatenate([np.empty(0, int), *far])


def fading(t: Array, y: Array, v: Array) -> NDArray[np.intp]:
    """Return which samples jump far beyond all else at one voltage, and fade: a filter's answer to a wrapped angle."""
    seen = np.flatnonzero(np.isfinite(y))
    here, level = y[seen], np.cumsum(np.abs(np.diff(v, prepend=v[0])) > 0.02 * np.ptp(v))[seen]
    sizes, found = np.abs(np.diff(here)), [np.empty(0, int)]
    near = 3 * max(float(np.quantile(sizes, 0.9)), noise_level(y, t))
    for a in np.flatnonzero((sizes > 4 * near) & (np.abs(here[1:]) > BEYOND * np.quantile(np.abs(here), 1 - MOST))):
        away = np.abs(here[a + 1:a + 1 + int(MOST * len(here))] - here[a])
        back = int(np.argmax(away < max(near, 0.02 * away[0])))  # 0: never
        if back > 1 and level[a + 1 + back] == level[a] and np.all(np.diff(away[:back]) < near):
            found.append(np.arange(a + 1, a + 1 + back))
    usual = np.abs(np.delete(here, np.concatenate(found))).max(initial=0.0)
    return seen[np.concatenate([k for k in found if not len(k) or np.abs(here[k[0]]) > BEYOND * usual])]


def dropouts(y: Array) -> NDArray[np.intp]:
    """Return which samples read exactly nothing, few in a row, amid others of one sign that all stay far from it:
    readings that failed. A coarse counter reads nothing where it turns slowly."""
    seen = np.flatnonzero(np.isfinite(y))
    zero, size = y[seen] == 0, 2 * AROUND + 1
    least = scipy.ndimage.minimum_filter1d(np.where(zero, np.inf, y[seen]), size)
    most = scipy.ndimage.maximum_filter1d(np.where(zero, -np.inf, y[seen]), size)
    low, high = np.where(least > 0, least, -most), np.where(least > 0, most, -least)  # in the direction of motion
    edges = np.flatnonzero(np.diff(zero, prepend=False, append=False)).reshape(-1, 2)
    few = np.repeat(np.diff(edges)[:, 0] <= LONGEST, np.diff(edges)[:, 0])
    return seen[zero][few & ((low > 0.2 * high) & (high > 10 * quantum(y)) & np.isfinite(high))[zero]]


def spikes(t: Array, y: Array, v: Array) -> NDArray[np.intp]:
    """Return which samples of an output stand far from neighbours that agree, not where the voltage jumps."""
    seen = np.flatnonzero(np.isfinite(y))
    noise, step = noise_level(y, t), float(np.diff(np.unique(y[seen])).min(initial=np.inf))  # one count is no spike
    before, here, after = y[seen[:-2]], y[seen[1:-1]], y[seen[2:]]
    off, apart = here - (before + after) / 2, np.abs(after - before)
    jumps = np.flatnonzero(np.abs(np.diff(v)) > 0.02 * np.ptp(v))
    calm = ~np.isin(seen[1:-1], jumps[:, None] + np.arange(PEAK + 1))
    alone = calm & (apart < 0.3 * np.abs(off))
    # Smooth or not, a channel bends everywhere alike; nine in ten tell how much. A spike bends three samples.
    beside = np.convolve(alone & (np.abs(off) > max(12 * noise, 1.5 * step)), np.ones(3), "same") > 0
    usual = float(np.quantile(np.abs(off[calm & ~beside]), 0.9)) if (calm & ~beside).any() else np.inf
    return seen[1:-1][alone & (np.abs(off) > max(12 * noise, 8 * usual, 1.5 * step))]

"""How a record begins: at rest or in motion, the state at its first sample, and how far that is known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from motorid.errors import UsageError, one_of
from motorid.integrate.engine import Array
from motorid.model.equations import CHANNELS
from motorid.records.experiment import Experiment

INITIAL = ("auto", "rest", "measured", "estimate")
REACH = 8.0  # standard deviations that an estimated initial state may lie away from its first samples
FIRST = 5  # samples that tell it
FREE_OF_NOISE = 2e-5  # of an angle's variation: what `noise_level` gives a simulation is half of it


class Beginning(NamedTuple):
    """`start` (3,): i, omega, theta at the first sample; `limits`: those to estimate, and how far they go."""

    start: Array
    limits: dict[str, tuple[float, float]]


def beginning(run: Experiment, sigma: Mapping[str, float], initial: str) -> Beginning:
    """Return the state at the first sample, and which parts of it are to be estimated.

    ``auto``: known zeros where nothing moves yet, otherwise estimated; a measured angle is estimated too (its
    first sample is as noisy as any), unless it is free of noise. Estimates stay within what the first samples
    allow, so that a model which lacks something cannot hide it in an initial state that never was.
    ``estimate``: everything, without limits.

    Raises
    ------
    UsageError
        If `initial` is none of ``auto``, ``rest``, ``measured``, ``estimate``.
    """
    if initial not in INITIAL:
        raise UsageError(one_of(initial, INITIAL, "initial state"))
    rest, lead = at_rest(run, sigma)
    known = rest if initial == "auto" else initial == "rest"
    start, reach = np.zeros(3), {}
    for k, c in enumerate(CHANNELS):
        if c not in run.outputs:
            continue
        y = run.outputs[c]
        if c == "theta":
            start[k] = _resting(y[:lead], sigma[c]) if known else _first(y)
            noisy = sigma[c] > FREE_OF_NOISE * np.nanstd(y)
            if initial == "estimate" or (initial == "auto" and (noisy or not rest)):
                reach[c] = _reach(y, sigma[c])
        elif not known:
            start[k] = _first(y)
            reach[c] = _reach(y, sigma[c])
    if "omega" not in run.outputs and "theta" in run.outputs and not known:
        start[1], reach["omega"] = _first_speed(run.outputs["theta"], run.t, sigma["theta"])
    if "i" not in run.outputs and not known:
        reach["i"] = np.inf  # to assume none would be a measurement that was never made
    if initial in ("rest", "measured"):
        reach = {}
    free = initial == "estimate"
    places = {c: start[CHANNELS.index(c)] for c in reach}
    return Beginning(start, {c: (-np.inf, np.inf) if free else (x - reach[c], x + reach[c])
                             for c, x in places.items()})


def at_rest(run: Experiment, sigma: Mapping[str, float]) -> tuple[bool, int]:
    """Tell whether the run begins at rest, and how many samples that lasts."""
    v = run.inputs["v"]
    quiet = np.abs(v) <= 1e-3 * max(np.abs(v).max(), 1e-300)
    lead = int(np.argmin(quiet)) if not quiet.all() else len(v)
    checked = max(lead, 2)
    for c in ("i", "omega"):
        if c in run.outputs:
            y = run.outputs[c][:checked]
            y = y[np.isfinite(y)]
            top = np.nanmax(np.abs(run.outputs[c]))
            # A wild first sample or an offset of the sensor is not motion; a median above the noise is.
            if y.size and abs(np.median(y)) > max(5 * sigma[c], 0.02 * top):
                return False, 1
    if "omega" not in run.outputs and "theta" in run.outputs:
        y, t = run.outputs["theta"], run.t
        speed, _ = _first_speed(y, t, sigma["theta"])
        moving = abs(speed) > 0.05 * np.max(np.abs(slopes(y, t)), initial=0.0)
        if moving and not _starts_from_rest(y, t, sigma["theta"], speed):
            return False, 1
    return True, max(lead, 1)


def _starts_from_rest(theta: Array, t: Array, sigma: float, speed: float) -> bool:
    """Tell whether the first samples of an angle speak for rest and against `speed`, which later ones suggest."""
    moved, after = theta[1:FIRST] - theta[0], t[1:FIRST] - t[0]
    first = moved[:2]
    noise = 4 * np.sqrt(2) * sigma
    return bool(np.all(np.abs(first) <= noise) and np.any(np.abs(moved - speed * after) > noise))


def slopes(theta: Array, t: Array, parts: int = 200) -> Array:
    """Mean speeds over `parts` windows of the record, from the angle."""
    good = np.isfinite(theta)
    y, s = theta[good], t[good]
    if len(y) < 4:
        return np.zeros(0)
    step = max(len(y) // parts, 1)
    return np.diff(y[::step]) / np.diff(s[::step])


def _first(y: Array) -> float:
    good = y[np.isfinite(y)][:3]
    return float(np.median(good)) if good.size else 0.0


def _resting(y: Array, sigma: float) -> float:
    """Return the mean of an angle before the first voltage; the first samples where it creeps meanwhile."""
    good = y[np.isfinite(y)]
    return float(good.mean()) if good.size and np.ptp(good) < REACH * sigma else _first(y)


def _reach(y: Array, sigma: float) -> float:
    good = y[np.isfinite(y)][:FIRST]
    return REACH * sigma + (float(np.ptp(good)) if good.size else 0.0)


def _first_speed(theta: Array, t: Array, sigma: float) -> tuple[float, float]:
    """Return the first speed and its reach, over the shortest window that noise leaves useful.

    The mean speed of a window is that of its middle; a motor started at the first sample is still at rest there.
    """
    good = np.isfinite(theta)
    y, s = theta[good], t[good]
    if len(y) < 4:
        return 0.0, np.inf
    top = float(np.max(np.abs(slopes(theta, t)), initial=0.0))
    w, longest = 1, max(len(y) // 50, 1)
    while w < longest and np.sqrt(2) * sigma > 0.01 * top * (s[w] - s[0]):
        w *= 2
    noise = np.sqrt(2) * sigma / (s[w] - s[0])
    pair = np.diff(y[[0, w, min(2 * w, len(y) - 1)]]) / np.diff(s[[0, w, min(2 * w, len(y) - 1)]])
    gained = pair[1] - pair[0]
    return float(pair[0] - gained / 2), float(REACH * noise + abs(gained))

"""Can these samples show a shape as fine as this at all?

Bristle friction differs from Coulomb's only within a few presliding angles after each turning point, Stribeck's only
below its speed. Where no sample falls there, or the sensor cannot see so small a motion, the parameter describes
something else, and the simpler relative is the answer.
"""

from __future__ import annotations

import numpy as np

from motorid.estimation.fit import Fit
from motorid.integrate.engine import Array
from motorid.model.model import Effect
from motorid.numerics.noise import noise_level, quantum
from motorid.problem.runs import angle_signal, slopes

PASSAGE = 10  # samples that a motion through the shape must give
FINEST = 4.0  # steps or standard deviations of the angle that it must be wide
OFTEN = 0.75  # of the passages may be faster
STARTED = 0.1  # of the width that counts as having left the turning point


def unresolved(fit: Fit, effect: Effect) -> str:
    """Say which shape of a friction that takes a simpler one's place these samples cannot show; empty if none."""
    if not effect.includes or effect.balance != "torque":
        return ""  # a gap shows in how its far side strikes, however quickly the near side passes through it
    for p in (fit.problem.model.parameters[q.name] for q in effect.parameters):
        if not (p.positive and p.vary and p.null is None):
            continue
        value = fit.values[p.name]
        if p.unit in ("rad", "m"):
            why = _too_fine(fit, value) or _too_quick(fit, value)
        elif p.unit in ("rad/s", "m/s"):
            why = _too_slow(fit, value)
        else:
            continue
        if why:
            return f"{p.name} = {value:.3g} {p.unit} cannot be seen in these samples: {why}"
    return ""


def _too_fine(fit: Fit, width: float) -> str:
    seen = [r for r in fit.problem.experiments if "theta" in r.outputs]
    steps = [max(quantum(r.outputs["theta"]), noise_level(r.outputs["theta"], r.t)) for r in seen]
    return "the angle is not measured so finely" if steps and width < FINEST * min(steps) else ""


def _too_quick(fit: Fit, width: float) -> str:
    passages = [n for r in fit.problem.experiments for n in samples_within(angle_signal(r), 2 * width)]
    usual = float(np.quantile(passages, OFTEN)) if passages else 0.0
    return f"the motion passes through it within {usual:.0f} samples" if usual < PASSAGE else ""


def _too_slow(fit: Fit, speed: float) -> str:
    below = sum(int((_moving(abs(_speed(r))) < 2 * speed).sum()) for r in fit.problem.experiments)
    return f"only {below} samples in motion are so slow" if below < PASSAGE else ""


def _moving(speed: Array) -> Array:
    return speed[speed > 1e-6 * speed.max(initial=0.0)]


def _speed(run) -> Array:
    y = run.outputs.get("omega")
    return y[np.isfinite(y)] if y is not None else slopes(angle_signal(run), run.t)


def samples_within(angle: Array, width: float) -> list[int]:
    """Count, for each turning point of `angle` (N,), the samples on the way from it to a distance of `width`."""
    turns, found = _turning_points(angle, width), []
    for a, b in zip(turns, [*turns[1:], len(angle)], strict=True):
        away = np.abs(angle[a:b] - angle[a]) / width
        left = np.flatnonzero(away > 1)
        found.append(int((away[: left[0] if len(left) else b - a] > STARTED).sum()))
    return found


def _turning_points(y: Array, least: float) -> list[int]:
    """Indices at which `y` turns by more than `least`, the first sample among them."""
    turns, far, way = [0], 0, 0.0
    for k, value in enumerate(y):
        if way == 0:
            if abs(value - y[0]) > least:
                way, far = float(np.sign(value - y[0])), k
        elif (value - y[far]) * way > 0:
            far = k
        elif (y[far] - value) * way > least:
            turns.append(far)
            way, far = -way, k
    return turns

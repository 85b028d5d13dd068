"""Orders of angle-periodic effects (cogging, torque ripple) from the model's response to every order.

The answer of the outputs to sin(Nθ) and cos(Nθ) torques along the measured angle, for all N at once, projected off
the tangent space of the fit like any other score; no signal is differentiated.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from motorid.diagnosis.response import Response, responses
from motorid.integrate.grid import Array
from motorid.model import Effect
from motorid.prepared import angle_signal

if TYPE_CHECKING:
    from motorid.diagnosis.rank import Tangent

CHUNK = 40
HIGHEST = 240
PERIODS = 3  # within the travel
SLOW_PART = 0.2  # of the motion that must be slow enough to show an order


def highest_order(tangent: Tangent) -> int:
    """Highest order that the samples can show: less than a period per sample for a part of the motion.

    Beyond half a period the samples alias, but along a measured angle each order still has its own pattern.
    """
    steps = np.concatenate([np.abs(np.diff(angle_signal(r))) for r in tangent.fit.problem.experiments])
    moving = steps[steps > 1e-6 * max(steps.max(initial=0.0), 1e-300)]
    if not moving.size:
        return 0
    return int(np.clip(1.8 * np.pi / np.quantile(moving, SLOW_PART), 0, HIGHEST))


def likely_orders(tangent: Tangent, effect: Effect, most: int) -> list[float]:
    """Return the orders that explain most of the misfit, best first.

    `effect` tells what is modulated: the torque itself (an amplitude in N·m), or the torque made by the current
    (a relative amplitude).
    """
    relative = any(p.null == 0 and p.unit == "" for p in effect.parameters)
    return list(_ranked(tangent, relative)[:most])


@lru_cache(maxsize=4)
def _ranked(tangent: Tangent, relative: bool) -> tuple[float, ...]:
    fit, top = tangent.fit, highest_order(tangent)
    if relative and "i" not in fit.problem.system.states:
        return ()
    answers, found = responses(fit), []
    # A torque that repeats once per turn is gravity's, and what is to repeat must do so within the travel.
    lowest = max(1 if relative else 2, int(np.ceil(PERIODS * 2 * np.pi / max(_travel(fit), 1e-9))))
    for first in range(lowest, top + 1, CHUNK):
        orders = np.arange(float(first), min(first + CHUNK, top + 1))
        columns = np.vstack([_columns(fit, k, answer, orders, relative) for k, answer in enumerate(answers)])
        inside = tangent.basis.T @ columns
        slope = columns.T @ tangent.residual
        m = len(orders)
        for j, n in enumerate(orders):
            pair = [j, j + m]
            gram = columns[:, pair].T @ columns[:, pair] - inside[:, pair].T @ inside[:, pair]
            found.append((_explained(gram, slope[pair]), float(n)))
    found.sort(reverse=True)
    return tuple(n for _, n in found)


def _columns(fit, k: int, answer: Response, orders: Array, relative: bool) -> Array:
    """Whitened outputs of run `k` to unit sine and cosine torques of all `orders`, (n, 2 len(orders))."""
    run = fit.problem.runs[k]
    angle = angle_signal(run.experiment)
    middle = (angle[1:] + angle[:-1]) / 2
    # Averaged over the sample, so that orders too fast for the sampling fade instead of posing as slower ones.
    fade = np.sinc(np.outer(np.diff(angle), orders) / (2 * np.pi))
    drive = np.concatenate([np.sin(np.outer(middle, orders)) * fade, np.cos(np.outer(middle, orders)) * fade], axis=1)
    if relative:
        drive *= (fit.values["K"] * answer.states["i"][:-1])[:, None]
    _, weights, index = fit.problem._weights[k]
    n, ny, nx = answer.c.shape
    s, out = np.zeros((nx, drive.shape[1])), np.empty((n, ny, drive.shape[1]))
    a, b, c = answer.a, answer.b[:, :, 1], answer.c * weights[None, :, None]
    out[0] = 0.0
    for i in range(n - 1):
        s = a[i] @ s
        s += b[i][:, None] * drive[i]
        out[i + 1] = c[i + 1] @ s
    flat = out.reshape(n * ny, -1)
    return flat if index is None else flat[index]


def _travel(fit) -> float:
    return max(float(np.ptp(angle_signal(r))) for r in fit.problem.experiments)


def _explained(gram: Array, slope: Array) -> float:
    """Squared residual that a pair of columns takes away, from its Gram matrix."""
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    if not np.all(size > 0):
        return 0.0
    scaled = gram / np.outer(size, size)
    if np.linalg.det(scaled) < 1e-8:
        return 0.0
    return float(slope / size @ np.linalg.solve(scaled, slope / size))

"""A controller around the plant, and the exact linear motor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .motion import Plant
from .motors import Motor


def closed_loop(
    plant: Plant, reference: np.ndarray, gains: Mapping[str, float], dt: float = 1e-3
) -> dict[str, np.ndarray]:
    """Follow a reference (N,) in closed loop, the voltage limited to the motor's v_max.

    Gains {"kp", "ki"} make a PI controller of the speed (rad/s), {"kp", "kd"} a PD controller
    of the angle (rad).
    Returns arrays (N,): t, reference, v (the voltage really applied), and the sensed i, omega, theta.
    """
    if set(gains) not in ({"kp", "ki"}, {"kp", "kd"}):
        raise ValueError(f"gains are kp, ki (speed) or kp, kd (angle), not {sorted(gains)}")
    limit, total, rows = plant.motor.v_max, 0.0, []
    for target in np.asarray(reference, float):
        seen = plant.measured()
        if "ki" in gains:
            error = target - seen["omega"]
            v = gains["kp"] * error + gains["ki"] * (total + error * dt)
            if abs(v) <= limit or v * error < 0:  # anti-windup: stop integrating while saturated
                total += error * dt
        else:
            v = gains["kp"] * (target - seen["theta"]) - gains["kd"] * seen["omega"]
        v = float(min(limit, max(-limit, v)))
        rows.append((plant.t, target, v, seen["i"], seen["omega"], seen["theta"]))
        plant.step(v, dt)
    return dict(zip(("t", "reference", "v", "i", "omega", "theta"), np.array(rows).T, strict=True))


def simulate_linear(motor: Motor, t: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
    """The plain motor from rest, voltage held, constant step, exact to rounding: i, omega, theta, t, v.

    By the matrix exponential, in plain arithmetic only, so that the digits are the same on every machine.
    """
    h = float(t[1] - t[0])
    m = motor
    E = _expm([
        [-m.R / m.L * h, -m.K / m.L * h, 0.0, h / m.L],
        [m.K / m.J * h, -m.b / m.J * h, 0.0, 0.0],
        [0.0, h, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0],
    ])
    x, rows = [0.0, 0.0, 0.0], []
    for volts in v:
        rows.append(x)
        x = [sum([E[r][c] * z for c, z in enumerate((*x, float(volts)))]) for r in range(3)]
    return dict(zip(("i", "omega", "theta"), np.array(rows).T, strict=True)) | {"t": t, "v": v}


def _expm(A: list[list[float]]) -> list[list[float]]:
    """Matrix exponential by Taylor's series of A/2**k and squaring."""
    n = len(A)
    k = 0
    while max(sum(map(abs, row)) for row in A) / 2**k > 0.25:
        k += 1
    A = [[a / 2**k for a in row] for row in A]
    E = [[float(r == c) for c in range(n)] for r in range(n)]
    for order in range(18, 0, -1):  # Horner: 1 + A/1 (1 + A/2 (1 + …))
        AE = _product(A, E)
        E = [[float(r == c) + AE[r][c] / order for c in range(n)] for r in range(n)]
    for _ in range(k):
        E = _product(E, E)
    return E


def _product(A: list[list[float]], B: list[list[float]]) -> list[list[float]]:
    columns = list(zip(*B, strict=True))
    return [[sum([a * b for a, b in zip(row, col, strict=True)]) for col in columns] for row in A]

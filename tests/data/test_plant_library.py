"""The library's smooth effects against the same effects in the independent plant, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from plant_truth import NUMBERS, in_library_words
from scipy.integrate import solve_ivp

from motorid.effects import LIBRARY
from motorid.model.model import dc_motor

# Root mean square of the difference over that of the signal. What is not exact in the library, and why:
# sgn is smoothed; delay and mean are Padé approximations; in a smoothed gap the damping can pull for a moment;
# current dies exponentially in an open bridge, and leaks through it against a command; a limiter leads it to the
# limit within L/(5 R).
INEXACT = {"coulomb": 5e-4, "coulomb_asymmetric": 5e-4, "stribeck": 5e-4, "load_friction": 2e-4,
           "viscous_asymmetric": 1e-5, "current_lag": 2e-5, "speed_delay": 0.01, "backlash": 0.04,
           "angular_friction": 5e-4, "gear_efficiency": 2e-4, "driver_coast": 2e-3, "driver_current_limit": 1e-2,
           "driver_one_quadrant": 3e-3, "speed_average": 2e-3, "current_average": 5e-3,
           "slip_clutch": 1e-2, "driver_slew": 1e-5}


def by_library(model, t, v, channels=("i", "omega")):
    """Sensed channels of a motorid model from rest, by SciPy's LSODA."""
    system = model.system(channels)
    p = np.array([model.values[name] for name in system.parameters])
    x, rows = np.array(system.initial([0, 0, 0], p)).ravel(), []
    for volts, dt in zip(v, np.diff(t, append=2 * t[-1] - t[-2]), strict=True):
        rows.append(np.array(system.out(x, volts, p)).ravel())

        def rhs(_, x, u=volts):
            return np.array(system.rhs(x, u, p)).ravel()

        x = solve_ivp(rhs, (0, dt), x, method="LSODA", rtol=1e-7, atol=1e-10).y[:, -1]
    return np.array(rows).T


@pytest.mark.parametrize("name", list(LIBRARY))
def test_library_effect_does_what_the_plant_does(plant, name):
    motor = plant.MOTORS["lab"]
    numbers, J = in_library_words(name, NUMBERS[name], motor)
    model = dc_motor(R=motor.R, L=motor.L, K=motor.K, b=motor.b, J=J) + LIBRARY[name]
    t, v = plant.staircase([2, -1, 0.6, 0], 0.05)
    r = plant.simulate(motor, {name: NUMBERS[name]}, t, v)
    channels = ("i", "omega", "theta") if name in ("angle_lag", "compliance_load_side") else ("i", "omega")
    for channel, y in zip(channels, by_library(model.replace(**numbers), t, v, channels), strict=True):
        error = np.sqrt(np.mean((y - r[channel]) ** 2) / np.mean(r[channel] ** 2))
        assert error < INEXACT.get(name, 1e-6), channel


def test_the_library_and_the_plant_know_the_same_effects_by_the_same_words(plant):
    assert set(plant.LIBRARY) == set(LIBRARY)
    assert set(NUMBERS) == set(plant.LIBRARY) | set(plant.BEYOND)
    assert len(plant.BEYOND) >= 3
    # a stiffness there, a frequency here
    shaped_otherwise = {"lugre", "compliance", "compliance_load_side", "backlash", "slip_clutch", "freewheel",
                        "driver_coast", "driver_one_quadrant"}
    for name in set(LIBRARY) - shaped_otherwise:
        assert set(NUMBERS[name]) <= {p.name for p in LIBRARY[name].parameters}, name


def test_corners_of_a_wide_gap_are_as_sharp_as_an_elastic_shaft_asks(plant):
    """A third of a turn of play, against the same law with hard corners."""
    m, gap, r, w_c, zeta = plant.MOTORS["lab"], 2.0, 0.45, 750.0, 0.3
    t, v = plant.staircase([3, -2, 2], 0.06)

    def rhs(_, x, u):
        i, w, _, twist, load = x
        elastic = np.sign(twist) * max(abs(twist) - gap / 2, 0.0)
        push = (1 - r) * (w_c**2 * elastic + 2 * zeta * w_c * (w - load)) if elastic else 0.0
        dw = (m.K * i - m.b * w - m.J * r * push) / (m.J * (1 - r))
        return (u - m.R * i - m.K * w) / m.L, dw, w, w - load, push

    x, hard = np.zeros(5), []
    for u, dt in zip(v, np.diff(t, append=2 * t[-1] - t[-2]), strict=True):
        hard.append(x[:2])
        x = solve_ivp(rhs, (0, dt), x, args=(u,), method="LSODA", rtol=1e-7, atol=1e-10, max_step=2e-5).y[:, -1]
    model = dc_motor(R=m.R, L=m.L, K=m.K, b=m.b, J=m.J) + LIBRARY["backlash"]
    smooth = by_library(model.replace(gap=gap, r_gap=r, omega_c=w_c, zeta_c=zeta), t, v)
    for a, b in zip(smooth, np.array(hard).T, strict=True):
        assert np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)) < 0.01

"""The independent plant against independent truth, and the shipped records against their seeds."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import linalg, signal

from motorid import datasets
from motorid.errors import DataError

DATA = datasets.data_path()
NUMBERS = {  # one plausible size of every effect on the lab motor
    "brush_drop": {"V_b": 0.6, "i_b": 0.1},
    "winding_heating": {"R_th": 5.0, "C_th": 8.0},
    "inductance_saturation": {"i_L": 3.0},
    "magnetic_saturation": {"i_K": 6.0},
    "driver_dead_band": {"V_d": 0.3},
    "voltage_offset": {"V_0": 0.1},
    "coulomb": {"tau_c": 5e-3},
    "coulomb_asymmetric": {"tau_cp": 4e-3, "tau_cn": 7e-3},
    "stribeck": {"tau_c": 4e-3, "tau_s": 7e-3, "omega_s": 4.0},
    "quadratic_drag": {"c_2": 2e-6},
    "constant_load": {"tau_0": 3e-3},
    "gravity": {"mgl": 2e-2, "phi_g": 0.3},
    "cogging": {"A": 4e-3, "N": 12, "phi": 0.5},
    "torque_ripple": {"a_r": 0.1, "N_r": 12, "phi_r": 0.2},
    "load_friction": {"mu": 0.15},
    "viscous_asymmetric": {"b_a": 2e-5},
    "lugre": {"sigma_0": 0.5, "sigma_1": 1e-3, "tau_c": 4e-3, "tau_s": 6e-3, "omega_s": 4.0},
    "compliance": {"k_s": 2.0, "c_s": 1e-3, "J_l": 2e-5},
    "backlash": {"gap": 0.03, "k_s": 5.0, "c_s": 2e-3, "J_l": 2e-5},
    "speed_lag": {"T_w": 5e-3},
    "current_lag": {"T_i": 2e-3},
    "speed_delay": {"T_d": 8e-3},
    "current_offset": {"i_0": 0.03},
    "speed_gain": {"k_w": 0.05},
    "angle_friction": {"tau_c": 5e-3, "c": 0.6},
    "cam": {"A": 2e-2},
    "grease_warm_up": {"tau_c": 4e-3, "extra": 1.0, "t_g": 1.0},
    "supply_sag": {"s": 0.2},
    "root_drag": {"c_r": 5e-4},
    "belt_splice": {"tau": 4e-3, "width": 1.5, "ratio": 0.4},
}


@pytest.fixture
def lab(plant):
    return plant.MOTORS["lab"]


@pytest.fixture
def dead(lab):
    """A rotor that feels neither current nor viscous friction: mechanics alone."""
    return replace(lab, K=1e-12, b=0.0, v_max=250e-12)


def state_space(m):
    A = np.array([[-m.R / m.L, -m.K / m.L, 0], [m.K / m.J, -m.b / m.J, 0], [0, 1, 0]])
    return A, np.array([[1 / m.L], [0], [0]])


def by_expm(m, t, v):
    A, B = state_space(m)
    E = linalg.expm(np.block([[A, B], [np.zeros((1, 4))]]) * (t[1] - t[0]))
    x = np.zeros((len(t), 3))
    for k in range(len(t) - 1):
        x[k + 1] = E[:3, :3] @ x[k] + E[:3, 3] * v[k]
    return x


def largest(error, reference):
    return np.max(np.abs(error)) / np.max(np.abs(reference))


# ---------------------------------------------------------------- the motor


@pytest.mark.parametrize("name", ["micro", "lab", "servo", "wheel", "big"])
def test_plain_motor_agrees_with_the_matrix_exponential(plant, name):
    m = plant.MOTORS[name]
    t, v = plant.staircase([m.v_max, -m.v_max / 2, 0], 0.05, dt=1e-3)
    r, exact, x = plant.simulate(m, {}, t, v), plant.simulate_linear(m, t, v), by_expm(m, t, v)
    for k, channel in enumerate(("i", "omega", "theta")):
        assert largest(r[channel] - x[:, k], x[:, k]) < 3e-6
        assert largest(exact[channel] - x[:, k], x[:, k]) < 1e-12


def test_motors_differ_clearly_in_size(plant):
    R, J, K = (sorted(getattr(m, k) for m in plant.MOTORS.values()) for k in ("R", "J", "K"))
    assert len(plant.MOTORS) >= 4
    assert R[-1] / R[0] > 10
    assert J[-1] / J[0] > 1000
    assert K[-1] / K[0] > 10
    assert all(name == m.name == name.lower() for name, m in plant.MOTORS.items())


def test_linear_hold_agrees_with_lsim(plant, lab):
    t, v = plant.multisine(6.0, 0.3, [3.0, 11.0, 37.0], np.random.default_rng(1))
    r = plant.simulate(lab, {}, t, v, hold="linear")
    A, B = state_space(lab)
    _, y, _ = signal.lsim((A, B, np.eye(3), np.zeros((3, 1))), v, t, interp=True)
    assert largest(r["i"] - y[:, 0], y[:, 0]) < 1e-8
    assert largest(r["omega"] - y[:, 1], y[:, 1]) < 1e-8


@pytest.mark.parametrize("name", list(NUMBERS))
def test_every_effect_acts_and_does_not_depend_on_the_integration_step(plant, lab, name):
    t, v = plant.staircase([2, -1, 0.6, 0], 0.05)
    effects = {name: NUMBERS[name]}
    coarse, fine = (plant.simulate(lab, effects, t, v, substep=h) for h in (50e-6, 10e-6))
    plain = plant.simulate(lab, {}, t, v)
    tolerance = 4e-4 if name == "backlash" else 1e-4  # backlash: contact is not searched for
    moved = max(largest(fine[c] - plain[c], plain[c]) for c in ("i", "omega"))
    assert moved > (1e-6 if name in ("winding_heating", "supply_sag") else 1e-3)
    for channel in ("i", "omega", "theta"):
        assert largest(coarse[channel] - fine[channel], fine[channel]) < min(tolerance, moved / 50)


def test_the_library_and_the_plant_know_the_same_effects_by_the_same_words(plant):
    from motorid.effects import LIBRARY

    assert set(plant.LIBRARY) == set(LIBRARY)
    assert set(NUMBERS) == set(plant.LIBRARY) | set(plant.BEYOND)
    assert len(plant.BEYOND) >= 3
    shaped_otherwise = {"lugre", "compliance", "backlash"}  # a stiffness there, a frequency here
    for name in set(LIBRARY) - shaped_otherwise:
        assert set(NUMBERS[name]) <= {p.name for p in LIBRARY[name].parameters}, name


def test_unknown_effect_and_unknown_number_are_named(plant, lab):
    with pytest.raises(ValueError, match="unknown effect 'colomb'"):
        plant.Plant(lab, {"colomb": {"tau_c": 1e-3}})
    with pytest.raises(ValueError, match=r"effect 'coulomb'.*tau_s"):
        plant.Plant(lab, {"coulomb": {"tau_s": 1e-3}})
    with pytest.raises(ValueError, match="t must increase"):
        plant.simulate(lab, {}, np.array([0.0, 0.0]), np.zeros(2))
    with pytest.raises(ValueError, match="hold is"):
        plant.simulate(lab, {}, np.arange(2.0), np.zeros(2), hold="cubic")


def test_one_step_at_5_khz_keeps_up_with_real_time(plant, lab):
    p = plant.Plant(lab, {"coulomb": NUMBERS["coulomb"], "cogging": NUMBERS["cogging"]})
    best = np.inf
    for _ in range(8):  # the best of several: other work on the machine is not the plant's fault
        start = time.perf_counter()
        for _ in range(200):
            p.step(2.0, 2e-4)
        best = min(best, (time.perf_counter() - start) / 200)
    assert best < 100e-6


# ---------------------------------------------------------------- dry friction


def test_stuck_shaft_stays_at_exactly_zero_and_breaks_away_at_its_level(plant, lab):
    tau_s = 8e-3
    p = plant.Plant(lab, {"stribeck": {"tau_c": 5e-3, "tau_s": tau_s, "omega_s": 3.0}}, theta0=0.7)
    breakaway = lab.R * tau_s / lab.K
    for _ in range(300):
        p.step(0.98 * breakaway, 1e-3)
        assert p.stuck
        assert p.omega == 0.0
        assert p.theta == 0.7
    volts = 0.98 * breakaway
    while p.stuck:  # ramp so slow that the current follows
        volts += 1e-4 * breakaway
        p.step(volts, 2e-2)
    assert volts == pytest.approx(breakaway, rel=5e-4)
    assert p.omega > 0


def test_sliding_shaft_stops_at_the_analytic_instant_and_does_not_turn_back(plant, dead):
    m, tau_c, omega0 = replace(dead, b=2e-4), 6e-3, 37.0
    stop = m.J / m.b * np.log1p(m.b * omega0 / tau_c)
    turned = m.J / m.b * (omega0 - tau_c * stop / m.J)
    p = plant.Plant(m, {"coulomb": {"tau_c": tau_c}}, omega0=omega0)
    n = int(stop / 1e-3)
    for _ in range(n):
        p.step(0.0, 1e-3)
    assert p.omega > 0
    p.step(0.0, stop - p.t - 1e-7)
    assert p.omega == pytest.approx(tau_c / m.J * 1e-7, rel=1e-3)
    for _ in range(50):
        p.step(0.0, 1e-3)
        assert p.omega == 0.0
    assert p.theta == pytest.approx(turned, rel=1e-9)


def test_friction_on_reversal_acts_against_the_new_direction_at_once(plant, lab):
    """From −ω through zero to +ω: each half is a linear motor with a constant load of its own sign."""
    tau_c, volts, x0 = 4e-3, 6.0, -30.0
    p = plant.Plant(lab, {"coulomb": {"tau_c": tau_c}}, omega0=x0)
    A, _ = state_space(lab)
    A = A[:2, :2]

    def exact(x, s, t):
        rest = -np.linalg.solve(A, [volts / lab.L, -s * tau_c / lab.J])
        return rest + linalg.expm(A * t) @ (x - rest)

    from scipy.optimize import brentq

    x = np.array([0.0, x0])
    crossing = brentq(lambda t: exact(x, -1, t)[1], 1e-4, 0.02, xtol=1e-14)
    end = exact(exact(x, -1, crossing), +1, 0.03 - crossing)
    for _ in range(30):
        p.step(volts, 1e-3)
    assert p.i == pytest.approx(end[0], rel=1e-7)
    assert p.omega == pytest.approx(end[1], rel=1e-7)


def test_slow_positioning_with_static_friction_sticks_and_slips(plant):
    servo = plant.MOTORS["servo"]
    p = plant.Plant(servo, {"stribeck": {"tau_c": 0.02, "tau_s": 0.08, "omega_s": 0.2}})
    stuck, speed = [], []
    for k in range(3000):
        p.step(6.0 * (0.3 * k * 1e-3 - p.theta), 1e-3)
        stuck.append(p.stuck)
        speed.append(p.omega)
    stuck, speed = np.array(stuck), np.array(speed)
    slips = np.count_nonzero(np.diff(stuck.astype(int)) == -1)
    assert slips >= 3
    assert 0.2 < stuck.mean() < 0.95
    assert np.all(speed[stuck] == 0.0)
    assert speed.max() > 0.6  # the slips are faster than the reference's 0.3 rad/s


DISSIPATIVE = ["coulomb", "coulomb_asymmetric", "stribeck", "quadratic_drag", "load_friction",
               "angle_friction", "grease_warm_up", "root_drag", "belt_splice"]  # fmt: skip


@pytest.mark.parametrize("omega0", [60.0, -60.0])
@pytest.mark.parametrize("name", DISSIPATIVE)
def test_friction_never_drives(plant, lab, name, omega0):
    """With the terminals shorted the stored energy only falls, and falls faster than without the effect."""

    def energy(effects):
        t, v = plant.step(0.0, duration=0.1)
        r = plant.simulate(lab, effects, t, v, omega0=omega0)
        return 0.5 * lab.J * r["omega"] ** 2 + 0.5 * lab.L * r["i"] ** 2

    with_it, without = energy({name: NUMBERS[name]}), energy({})
    assert np.all(np.diff(with_it) <= 1e-15 * with_it[0])
    assert with_it[20] < without[20]


# ---------------------------------------------------------------- conservation


POTENTIALS = {
    "gravity": lambda th: -2e-2 * np.cos(th + 0.3),
    "cogging": lambda th: -4e-3 / 12 * np.cos(12 * th + 0.5),
    "cam": lambda th: -2e-2 / 6.0 * np.exp(6.0 * (np.cos(th) - 1)),
}


@pytest.mark.parametrize("name", list(POTENTIALS))
def test_angle_torques_conserve_energy(plant, dead, name):
    t, v = plant.step(0.0, duration=0.6)
    r = plant.simulate(dead, {name: NUMBERS[name]}, t, v, omega0=20.0, theta0=0.2)
    total = 0.5 * dead.J * r["omega"] ** 2 + POTENTIALS[name](r["theta"])
    swing = np.ptp(0.5 * dead.J * r["omega"] ** 2)
    assert swing > 1e-4
    assert np.ptp(total) < 1e-7 * swing


@pytest.mark.parametrize("name", ["compliance", "backlash"])
def test_two_inertias_conserve_momentum_and_lose_energy_only_by_damping(plant, dead, name):
    numbers = NUMBERS[name]
    p = plant.Plant(dead, {name: numbers}, omega0=10.0, substep=10e-6)
    p._y[4] = -5.0  # the load's speed
    lost, last, momentum = [], None, dead.J * 10 - numbers["J_l"] * 5
    for _ in range(300):
        p.step(0.0, 1e-3)
        load, angle = p._y[4], p._y[5]
        assert dead.J * p.omega + numbers["J_l"] * load == pytest.approx(momentum, rel=1e-9)
        free = numbers.get("gap", 0.0) / 2
        spring = 0.5 * numbers["k_s"] * max(0.0, abs(p.theta - angle) - free) ** 2
        energy = 0.5 * dead.J * p.omega**2 + 0.5 * numbers["J_l"] * load**2 + spring
        lost.append(0.0 if last is None else last - energy)
        last = energy
    assert min(lost) > -1e-9 * last
    assert sum(lost) > 1e-5


def test_load_behind_a_gap_does_not_feel_the_motor_until_the_play_is_used_up(plant, dead):
    gap = 0.04
    p = plant.Plant(dead, {"backlash": NUMBERS["backlash"] | {"gap": gap}}, omega0=10.0)
    p._y[4] = 0.0  # the load at rest
    contact = gap / 2 / 10.0
    p.step(0.0, 0.95 * contact)
    assert p._y[4] == 0.0
    assert p.omega == 10.0
    p.step(0.0, 0.2 * contact)
    assert p._y[4] > 0
    assert p.omega < 10.0


@pytest.mark.parametrize("side", [1, -1])
def test_load_in_contact_is_pushed_and_never_pulled(plant, lab, side):
    (hooks,) = plant.effects.build(lab, {"backlash": {"gap": 0.03, "k_s": 5.0, "c_s": 2e-3, "J_l": 2e-5}})
    touching = side * 0.016  # 1 mrad into the load
    assert hooks["part"](0.0, 0.0, touching, [0.0, 0.0])[0] == pytest.approx(-side * 5e-3)
    assert hooks["part"](0.0, -side * 50.0, touching, [0.0, 0.0])[0] == 0.0  # leaving


def test_elastic_shaft_rings_at_its_resonance(plant, dead):
    k_s, J_l = 2.0, 3e-5
    p = plant.Plant(dead, {"compliance": {"k_s": k_s, "c_s": 0.0, "J_l": J_l}}, omega0=10.0)
    p._y[4] = 0.0
    dt, mean = 5e-5, dead.J * 10 / (dead.J + J_l)
    w = np.array([p.step(0.0, dt)["omega"] for _ in range(4000)]) - mean
    up = np.flatnonzero((w[:-1] < 0) & (w[1:] >= 0))
    crossings = (up + w[up] / (w[up] - w[up + 1])) * dt
    measured = 2 * np.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    assert len(crossings) > 5
    assert measured == pytest.approx(np.sqrt(k_s / dead.J + k_s / J_l), rel=1e-5)


# ---------------------------------------------------------------- electrical, thermal, sensor


def test_heated_winding_settles_where_copper_loss_meets_cooling(plant, lab):
    R_th, C_th, alpha, volts = 2.0, 0.5, 0.00393, 6.0
    effects = {"winding_heating": {"R_th": R_th, "C_th": C_th}, "coulomb": {"tau_c": 10.0}}
    p = plant.Plant(lab, effects, substep=2e-4)
    p.step(volts, 8.0)  # held by friction: a locked rotor, eight thermal time constants
    hot = lab.R * (1 + alpha * p.dT)
    assert p.stuck
    assert p.dT > 20
    assert p.i == pytest.approx(volts / hot, rel=1e-4)
    assert p.dT == pytest.approx(hot * p.i**2 * R_th, rel=1e-3)


def test_driver_dead_band_has_hard_corners(plant, lab):
    for commanded, applied in ((0.29, 0.0), (-0.29, 0.0), (1.3, 1.0), (-1.3, -1.0)):
        t, v = plant.step(commanded, duration=0.05)
        r = plant.simulate(lab, {"driver_dead_band": {"V_d": 0.3}}, t, v)
        expected = plant.simulate(lab, {}, *plant.step(applied, duration=0.05))
        assert r["i"] == pytest.approx(expected["i"], abs=1e-12)


@pytest.mark.parametrize("T_d", [8e-3, 8.37e-3])
def test_speed_delay_is_pure(plant, lab, T_d):
    t, v = plant.staircase([4, -4], 0.06)
    late, true = (plant.simulate(lab, e, t, v) for e in ({"speed_delay": {"T_d": T_d}}, {}))
    fine = np.arange(0, t[-1], 1e-5)
    reference = plant.simulate(lab, {}, fine, v[np.floor(fine / 1e-3 + 1e-9).astype(int)])["omega"]
    expected = np.where(t > T_d, np.interp(t - T_d, fine, reference), 0.0)
    assert largest(late["omega"] - expected, expected) < 1e-5  # straight lines over 20 µs
    assert late["true_omega"] == pytest.approx(true["omega"], abs=0)
    if T_d == 8e-3:
        assert late["omega"][8:] == pytest.approx(true["omega"][:-8], abs=1e-12)


def test_lag_of_a_sensor_is_first_order(plant, lab):
    t, v = plant.step(6.0, duration=0.1)
    r = plant.simulate(lab, {"speed_lag": {"T_w": 7e-3}, "current_lag": {"T_i": 3e-3}}, t, v)
    A, B = state_space(lab)
    A5 = np.zeros((5, 5))
    A5[:3, :3] = A
    A5[3, [0, 3]] = 1 / 3e-3, -1 / 3e-3
    A5[4, [1, 4]] = 1 / 7e-3, -1 / 7e-3
    E = linalg.expm(np.block([[A5, np.vstack([B, [[0], [0]]])], [np.zeros((1, 6))]]) * 1e-3)
    x = np.zeros((len(t), 5))
    for k in range(len(t) - 1):
        x[k + 1] = E[:5, :5] @ x[k] + E[:5, 5] * v[k]
    assert largest(r["i"] - x[:, 3], x[:, 3]) < 1e-4
    assert largest(r["omega"] - x[:, 4], x[:, 4]) < 1e-4


def test_sensor_errors_leave_the_motor_alone(plant, lab):
    t, v = plant.step(6.0, duration=0.1)
    plain = plant.simulate(lab, {}, t, v)
    r = plant.simulate(lab, {"speed_gain": {"k_w": 0.05}, "current_offset": {"i_0": 0.03}}, t, v)
    assert r["omega"] == pytest.approx(1.05 * plain["omega"], rel=1e-12)
    assert r["i"] == pytest.approx(plain["i"] + 0.03, rel=1e-12)
    for c in ("i", "omega", "theta"):
        assert np.array_equal(r[f"true_{c}"], plain[c])


# ---------------------------------------------------------------- loops, loggers, excitations


@pytest.mark.parametrize("gains", [{"kp": 0.08, "ki": 3.0}, {"kp": 6.0, "kd": 0.1}])
def test_closed_loop_reaches_its_reference_with_the_voltage_it_reports(plant, lab, gains):
    target, effects = (60.0, {"coulomb": {"tau_c": 3e-3}}) if "ki" in gains else (3.0, {})
    loop = plant.closed_loop(plant.Plant(lab, effects), np.full(800, target), gains)
    reached = loop["omega" if "ki" in gains else "theta"]
    assert reached[-100:] == pytest.approx(target, rel=1e-3)
    assert np.max(np.abs(loop["v"])) <= lab.v_max
    replay = plant.simulate(lab, effects, loop["t"], loop["v"], substep=None)
    assert replay["omega"] == pytest.approx(loop["omega"], abs=1e-9)
    with pytest.raises(ValueError, match="gains are"):
        plant.closed_loop(plant.Plant(lab), np.zeros(3), {"kp": 1.0})


def test_noise_has_its_standard_deviation_and_colour(plant, rng):
    zero = np.zeros(20000)
    w, c = plant.white(zero, 0.3, rng), plant.coloured(zero, 0.3, 0.8, rng)
    assert np.std(w) == pytest.approx(0.3, rel=0.03)
    assert np.std(c) == pytest.approx(0.3, rel=0.06)
    assert abs(np.corrcoef(w[1:], w[:-1])[0, 1]) < 0.03
    assert np.corrcoef(c[1:], c[:-1])[0, 1] == pytest.approx(0.8, abs=0.03)
    once, again = (plant.white(zero, 1.0, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(once, again)


def test_converter_and_encoder_quantise(plant):
    x = np.linspace(-12, 12, 5001)
    y, lsb = plant.adc(x, 10.0), 20 / 4096
    assert y / lsb == pytest.approx(np.round(y / lsb), abs=1e-9)
    assert y.max() == pytest.approx(10.0 - lsb)
    assert y.min() == -10.0
    assert np.max(np.abs(y - x)[np.abs(x) < 9.9]) <= lsb / 2 + 1e-12
    t = np.arange(2000) * 1e-3
    theta = 30.0 * t
    assert np.max(theta - plant.encoder(theta, 500)) < 2 * np.pi / 500 + 1e-9
    raw, smooth = plant.encoder_speed(theta, t, 500), plant.encoder_speed(theta, t, 500, average=20)
    assert raw.shape == smooth.shape == t.shape
    assert np.unique(np.round(raw, 6)).size <= 3  # nothing between the counts
    assert smooth[100:] == pytest.approx(30.0, abs=2 * np.pi / 500 / 20e-3)
    assert np.std(smooth[100:]) < np.std(raw[100:]) / 5


def test_dirt_comes_in_the_share_asked_for(plant, rng):
    x = np.sin(np.arange(20000) / 50)
    assert np.mean(plant.outliers(x, 0.02, 5.0, rng) != x) == pytest.approx(0.02, abs=0.005)
    gaps = np.isnan(plant.dropouts(x, 0.05, rng, length=5))
    assert gaps.mean() == pytest.approx(0.05, abs=0.015)
    assert not np.isnan(x).any()
    t = np.arange(1000) * 1e-3
    moved = plant.uneven(t, 0.4, rng)
    assert np.all(np.diff(moved) > 0)
    assert np.std(np.diff(moved)) > 1e-4
    assert plant.resample(moved, t, 2 * t) == pytest.approx(2 * np.clip(moved, 0, t[-1]))
    with pytest.raises(ValueError, match=r"below 0\.5"):
        plant.uneven(t, 0.6, rng)


def test_excitations_keep_their_limit_and_do_what_they_say(plant, rng):
    made = {
        "step": plant.step(3.0),
        "staircase": plant.staircase([3, -2, 1, 0], 0.2),
        "triangle": plant.triangle(3.0, 2.0, 1.0),
        "chirp": plant.chirp(3.0, 2.0, 0.5, 20.0),
        "prbs": plant.prbs(3.0, 2.0, 0.05, rng),
        "random_steps": plant.random_steps(3.0, 2.0, 0.05, rng),
        "multisine": plant.multisine(3.0, 2.0, [1.0, 3.0, 7.0], rng),
        "coast_down": plant.coast_down(3.0, 0.5, 1.0),
        "warm_up": plant.warm_up(3.0, 30.0),
    }
    for name, (t, v) in made.items():
        assert t.shape == v.shape, name
        assert np.all(np.diff(t) > 0), name
        assert 2.0 < np.max(np.abs(v)) <= 3.0, name
        assert np.array_equal(v, np.round(v, 4)), name
    both = ("staircase", "triangle", "chirp", "prbs", "random_steps", "multisine", "warm_up")
    assert all(made[name][1].min() < -1.5 for name in both)
    t, v = made["step"]
    assert np.array_equal(v, np.where(np.arange(1200) < 20, 0.0, 3.0))
    assert set(made["prbs"][1]) == {3.0, -3.0}
    assert made["triangle"][1][[0, 250, 500, 750]] == pytest.approx([0, 3, 0, -3], abs=1e-9)
    early, late = made["chirp"][1][:1000], made["chirp"][1][1000:]
    assert np.sum(np.diff(np.sign(late)) != 0) > 3 * np.sum(np.diff(np.sign(early)) != 0)


# ---------------------------------------------------------------- shipped records


def test_two_step_is_exact(plant):
    p = plant.Motor("truth", **datasets.truth("two_step")["parameters"], v_max=12, i_max=8)
    for level in (6, 8):
        d = pd.read_csv(datasets.data_path(f"two_step/step_{level}V.csv"))
        assert list(d) == ["t_s", "voltage_V", "current_A", "speed_rad_s"]
        assert len(d) == 1200
        x = by_expm(p, d["t_s"].to_numpy(), d["voltage_V"].to_numpy())
        assert d["current_A"].to_numpy() == pytest.approx(x[:, 0], abs=1e-10 * x[:, 0].max())
        assert d["speed_rad_s"].to_numpy() == pytest.approx(x[:, 1], abs=1e-10 * x[:, 1].max())
        assert np.array_equal(d["voltage_V"], np.where(np.arange(1200) < 20, 0, level))


@pytest.mark.parametrize("run", ["run1", "run2", "check1"])
def test_hidden_friction_is_what_truth_says_and_not_a_plain_motor(plant, run):
    d = pd.read_csv(datasets.data_path(f"hidden_friction/{run}.csv"))
    known = datasets.truth("hidden_friction")
    motor = plant.Motor("truth", **known["parameters"], v_max=12, i_max=8)
    for effects, fits in ((known["effects"], True), ({}, False)):
        r = plant.simulate(motor, effects, d["time_s"].to_numpy(), d["voltage_V"].to_numpy())
        rms_i, rms_w = np.std(d["current_A"] - r["i"]), np.std(d["speed_rad_s"] - r["omega"])
        if fits:
            assert rms_i == pytest.approx(known["sigma"]["i"], rel=0.1)
            assert rms_w == pytest.approx(known["sigma"]["omega"], rel=0.1)
        else:
            assert rms_i > 10 * known["sigma"]["i"]
            assert rms_w > 10 * known["sigma"]["omega"]


def make_data(*words, cwd=DATA.parent):
    command = [sys.executable, str(DATA / "make_data.py"), *words]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


def test_shipped_records_are_what_their_seeds_give_bit_for_bit():
    done = make_data("--check", "--only", "two_step", "two_step_noisy", "two_step_small", "hidden_friction")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_all_shipped_records_are_what_their_seeds_give_bit_for_bit():
    done = make_data("--check")
    assert done.returncode == 0, done.stdout + done.stderr


def test_one_digit_changed_in_a_shipped_record_is_found(tmp_path):
    made = make_data("--out", str(tmp_path), "--only", "two_step")
    assert made.returncode == 0, made.stderr
    assert json.loads((tmp_path / "truth.json").read_text(encoding="utf-8")).keys() == {"two_step"}
    file = tmp_path / "two_step" / "step_6V.csv"
    assert file.read_bytes() == datasets.data_path("two_step/step_6V.csv").read_bytes()
    file.write_bytes(file.read_bytes().replace(b"0.021,6,2.3", b"0.021,6,2.4", 1))
    done = make_data("--check", "--out", str(tmp_path), "--only", "two_step")
    assert done.returncode == 1
    assert "step_6V.csv: differs at line 23" in done.stdout
    file.unlink()
    assert "step_6V.csv: missing" in make_data("--check", "--out", str(tmp_path), "--only", "two_step").stdout


def test_data_folder_is_small_and_lists_every_record():
    shipped = {f.relative_to(DATA).as_posix() for f in DATA.glob("*/*.csv")}
    told = {f for name in datasets.datasets() for f in datasets.truth(name)["files"]}
    assert shipped == told
    assert sum((DATA / f).stat().st_size for f in shipped) < 2e6
    for name in datasets.datasets():
        if not name.startswith("two_step"):
            assert {f"{name}/run1.csv", f"{name}/run2.csv", f"{name}/check1.csv"} <= told


def test_the_plant_shares_no_code_with_the_models():
    sources = [*DATA.glob("*.py"), *DATA.glob("plant/*.py")]
    assert len(sources) >= 8
    for source in sources:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(n.split(".")[0] in ("motorid", "casadi", "scipy") for n in names), source.name


# ---------------------------------------------------------------- motorid.datasets


def test_shipped_sets_are_found_by_name():
    hidden = {"hidden_friction", "hidden_heating", "hidden_cogging", "hidden_brush", "hidden_two"}
    assert hidden | {"two_step", "two_step_noisy", "clean"} <= set(datasets.datasets())
    assert (datasets.data_path() / "truth.json").is_file()
    assert datasets.data_path("two_step/step_6V.csv").is_file()
    assert datasets.truth("hidden_friction")["effects"] == {"coulomb": {"tau_c": 8e-3}}
    assert datasets.truth("clean")["effects"] == {}


def test_a_wrong_name_is_answered_with_the_near_one():
    with pytest.raises(DataError, match="Did you mean 'hidden_friction'"):
        datasets.data_path("hiden_friction")
    with pytest.raises(DataError, match=r"Did you mean 'two_step/step_6V.csv'"):
        datasets.data_path("two_step/step_6v.csv")
    with pytest.raises(DataError, match="Did you mean 'clean'"):
        datasets.truth("claen")


def test_an_installed_wheel_finds_the_data_inside_the_package(tmp_path, monkeypatch):
    package = tmp_path / "site" / "motorid"
    (package / "data").mkdir(parents=True)
    monkeypatch.setattr(datasets, "__file__", str(package / "datasets.py"))
    with pytest.raises(DataError, match=r"looked for truth\.json in"):
        datasets.datasets()
    (package / "data" / "truth.json").write_text("{}", encoding="utf-8")
    assert datasets.data_path() == package / "data"
    monkeypatch.delitem(sys.modules, "motorid_plant", raising=False)
    with pytest.raises(DataError, match="motor plant was expected at"):
        datasets.load_plant()


def test_the_plant_is_loaded_once():
    assert datasets.load_plant() is datasets.load_plant()
    assert Path(datasets.load_plant().__file__).parent == DATA / "plant"

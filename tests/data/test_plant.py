"""The independent plant against independent truth: plain motor, friction, conservation laws, heat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plant_truth import NUMBERS, by_expm, largest, state_space
from scipy import linalg, signal
from scipy.optimize import brentq


@pytest.fixture
def dead(lab):
    """A rotor that feels neither current nor viscous friction: mechanics alone."""
    return replace(lab, K=1e-12, b=0.0, v_max=250e-12)


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
    # Contact, the end of a current are not searched for, or only within the steps of RK4.
    tolerance = {"backlash": 5e-4, "driver_coast": 5e-4, "driver_one_quadrant": 1e-3}.get(name, 1e-4)
    moved = max(largest(fine[c] - plain[c], plain[c]) for c in (("theta",) if name == "angle_lag" else ("i", "omega")))
    assert moved > (1e-6 if name in ("winding_heating", "magnet_heating", "bridge_loss") else 1e-3)
    for channel in ("i", "omega", "theta"):
        assert largest(coarse[channel] - fine[channel], fine[channel]) < min(tolerance, moved / 50)


def test_unknown_effect_and_unknown_number_are_named(plant, lab):
    with pytest.raises(ValueError, match="unknown effect 'colomb'"):
        plant.Plant(lab, {"colomb": {"tau_c": 1e-3}})
    with pytest.raises(ValueError, match=r"effect 'coulomb'.*tau_s"):
        plant.Plant(lab, {"coulomb": {"tau_s": 1e-3}})
    with pytest.raises(ValueError, match="t must increase"):
        plant.simulate(lab, {}, np.array([0.0, 0.0]), np.zeros(2))
    with pytest.raises(ValueError, match="hold is"):
        plant.simulate(lab, {}, np.arange(2.0), np.zeros(2), hold="cubic")


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
               "angular_friction", "eddy_brake",
               "gear_efficiency", "tight_spot", "grease_warm_up", "root_drag", "belt_splice"]  # fmt: skip


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

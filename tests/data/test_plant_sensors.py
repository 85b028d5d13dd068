"""What stands around the plant: electrical and thermal effects, sensors, loops, loggers, excitations."""

from __future__ import annotations

import numpy as np
import pytest
from plant_truth import largest, state_space
from scipy import linalg

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
    lags = {"current_lag": {"T_i": 3e-3}, "speed_lag": {"T_w": 7e-3}, "angle_lag": {"T_pos": 5e-3}}
    r = plant.simulate(lab, lags, t, v)
    A, B = state_space(lab)
    A6 = np.zeros((6, 6))
    A6[:3, :3] = A
    for k, T in enumerate((3e-3, 7e-3, 5e-3)):
        A6[3 + k, [k, 3 + k]] = 1 / T, -1 / T
    E = linalg.expm(np.block([[A6, np.vstack([B, np.zeros((3, 1))])], [np.zeros((1, 7))]]) * 1e-3)
    x = np.zeros((len(t), 6))
    for k in range(len(t) - 1):
        x[k + 1] = E[:6, :6] @ x[k] + E[:6, 6] * v[k]
    for k, channel in enumerate(("i", "omega", "theta"), 3):
        assert largest(r[channel] - x[:, k], x[:, k]) < 1e-4, channel


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

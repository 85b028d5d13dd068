"""The first guess: near the truth from the records alone, loads on the shaft included."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from lab_records import VALUES, noisy, simulated
from scipy.optimize import lsq_linear

import motorid as mi
from motorid.diagnosis import refit as trial
from motorid.diagnosis.refit import refit
from motorid.estimation import start_values
from motorid.estimation.start_values import _nonnegative, first_guess
from motorid.problem.problem import Problem

TRUTH = {"R": 2.0, "L": 1e-3, "K": 0.05, "b": 1e-5, "J": 2e-5}
T = np.arange(0, 4, 2e-3)


def record(model: mi.Model, channels: str, v: np.ndarray, seed: int = 0) -> mi.Experiment:
    """Simulated, with 0.5 % noise."""
    bare = mi.Experiment(T, {"v": v}, {c: np.zeros(len(T)) for c in channels.split()})
    rng = np.random.default_rng(seed)
    outputs = mi.simulate(model, bare, initial="rest")[0].outputs
    noisy = {c: y + 5e-3 * np.abs(y).max() * rng.standard_normal(len(T)) for c, y in outputs.items()}
    return mi.Experiment(T, {"v": v}, noisy)


def swinging() -> np.ndarray:
    return 3.0 * np.sin(2 * np.pi * 0.5 * T) + 2.0 * np.sign(np.sin(2 * np.pi * 1.3 * T))


def arm(*effects: mi.Effect) -> mi.Model:
    model = mi.dc_motor() + mi.effects.gravity
    for e in effects:
        model = model + e
    return model


@pytest.mark.parametrize("channels", ["i omega theta", "i theta", "theta"])
def test_weight_on_the_shaft_is_part_of_the_guess(channels):
    """An arm that never turns over moves by its weight: without it inertia and friction come out as nothing."""
    truth = arm().replace(**TRUTH, mgl=0.12, phi_g=0.2)
    run = record(truth, channels, swinging())
    guess = first_guess(arm() if "i" in run.outputs else arm().fix(R=TRUTH["R"], K=TRUTH["K"]), [run], loaded=True)
    assert guess["mgl"] == pytest.approx(0.12, rel=0.15)
    assert guess["phi_g"] == pytest.approx(0.2, abs=0.1)
    assert 0.3 < guess["J"] / TRUTH["J"] < 3


def test_friction_drag_and_offset_are_part_of_the_guess():
    truth = mi.dc_motor() + mi.effects.coulomb + mi.effects.constant_load + mi.effects.quadratic_drag
    values = {"tau_c": 0.01, "tau_0": -0.004, "c_2": 2e-7}
    v = 12 * np.sin(2 * np.pi * 0.4 * T) + 4 * np.sign(np.sin(2 * np.pi * 1.7 * T))
    run = record(truth.replace(**TRUTH, **values), "i omega", v)
    guess = first_guess(truth, [run], loaded=True)
    for name, value in values.items():
        assert guess[name] == pytest.approx(value, rel=0.3), name


@mi.effect(balance="torque")
def spring(m, k_s=mi.P(1e-3, "N·m/rad", null=0.0, lower=0.0)):
    """A torsion spring on the shaft."""
    m.torque -= k_s * m.theta


def test_effect_of_the_user_takes_part_in_the_guess():
    truth = (mi.dc_motor() + spring).replace(**TRUTH, k_s=0.03)
    guess = first_guess(mi.dc_motor() + spring, [record(truth, "i theta", swinging())], loaded=True)
    assert guess["k_s"] == pytest.approx(0.03, rel=0.15)


def test_given_sizes_and_orders_without_a_number_are_left_alone():
    model = arm(mi.effects.cogging).replace(mgl=0.5)
    guess = first_guess(model, [record(arm().replace(**TRUTH, mgl=0.12), "i theta", swinging())], loaded=True)
    assert not {"mgl", "phi_g", "A", "N", "phi"} & set(guess)


def test_arm_is_fitted_from_the_angle_alone():
    truth = arm(mi.effects.coulomb).replace(**TRUTH, mgl=0.12, phi_g=0.2, tau_c=0.01)
    run = record(truth, "theta", swinging())
    fit = mi.fit(arm(mi.effects.coulomb).fix(R=TRUTH["R"], K=TRUTH["K"], L=TRUTH["L"]), run)
    assert fit.values["mgl"] == pytest.approx(0.12, rel=0.02)
    assert fit.values["tau_c"] == pytest.approx(0.01, rel=0.05)


GEARED = {"R": 2.1, "L": 1.6e-3, "K": 0.045, "b": 4e-5, "J": 2e-5}


@mi.effect(balance="torque")
def crank(m, r_J=mi.P(0.3, "1", null=0.0)):
    """An inertia that changes over a turn; a unit of it, 1 + sin θ, leaves none at one angle."""
    m.torque -= 0.5 * m.J * r_J * ca.cos(m.theta) / (1 + r_J * ca.sin(m.theta)) * m.omega**2
    m.scale("J", 1 + r_J * ca.sin(m.theta))


def test_a_size_whose_unit_is_no_motor_is_left_where_it_is(rng):
    t = np.arange(600) * 1e-3
    v = 6 * np.sign(np.sin(14 * t + 0.1))
    run = noisy(simulated(t, v, ("i", "omega", "theta"), mi.dc_motor(**VALUES) + crank), rng)
    runs = [run.with_(outputs={**run.outputs, "theta": np.round(run.outputs["theta"] / (np.pi / 2)) * np.pi / 2})]
    guess = first_guess(mi.dc_motor() + crank, runs, loaded=True)
    assert np.isfinite(list(guess.values())).all()
    assert mi.fit(mi.dc_motor() + crank, run).values["r_J"] == pytest.approx(0.3, rel=0.01)


@pytest.mark.parametrize("seed", [0, 1])
def test_bristles_begin_where_coulomb_friction_leads(seed):
    """From the first guess of such a gear alone, bristles end at some hundred times the cost."""
    truth = {**GEARED, "tau_c": 0.05, "s_b": 1.5, "omega_s": 8.0, "theta_s": 0.08}
    v = np.repeat([0.0, 3.0, -3.2, 4.0, -2.8, 3.5, -4.0, 3.0, 0.0, -3.0], len(T) // 10)
    model = mi.dc_motor() + mi.effects.lugre
    run = record(model.replace(**truth), "i theta", v, seed)
    found = mi.fit(model, run)
    assert found.cost < 20 * mi.fit(model.replace(**truth), run).cost
    assert found.values["tau_c"] == pytest.approx(0.05, rel=0.1)


def test_cogging_begins_along_the_integral_of_the_speed():
    truth = {"R": 0.6, "L": 9e-4, "K": 0.032, "b": 2e-4, "J": 1.2e-4, "A": 0.025, "N": 5.0, "phi": 0.5}
    v = np.repeat([0.0, 1.2, 2.2, 0.9, -1.1, -2.4, 0.7, 3.0, -0.9, 1.6], len(T) // 10)
    model = mi.dc_motor() + mi.effects.cogging
    run = record(model.replace(**truth), "i omega", v)
    found = mi.fit(model, run)
    assert found.values["N"] == 5
    assert found.values["A"] == pytest.approx(0.025, rel=0.03)
    assert found.cost < 1.1 * mi.fit(model.replace(**truth), run).cost


def test_where_the_integral_leads_astray_the_model_s_own_angle_decides():
    truth = {"R": 0.6, "L": 9e-4, "K": 0.032, "b": 2e-4, "J": 1.2e-4, "A": 0.02, "N": 12.0, "phi": 0.5}
    model = mi.dc_motor() + mi.effects.cogging
    found = mi.fit(model, record(model.replace(**truth), "i omega", 3 * np.sin(2 * np.pi * 0.4 * T)))
    assert found.values["A"] == pytest.approx(0.02, rel=0.03)


def test_a_current_that_is_not_the_motor_s_is_no_first_guess(rng):
    """The supply's current without its sign says nothing of R by itself; whether it has one is found."""
    t = np.arange(1500) * 1e-3
    v = np.random.default_rng(2).uniform(-10, 10, 60)[np.minimum((t / 0.03).astype(int), 59)]
    reads = mi.dc_motor() + mi.effects.supply_side_current(V_dc=10.0)
    run = noisy(simulated(t, v, ("i", "omega"), reads.replace(**VALUES, u_i=1.0)), rng)
    fit = mi.fit(reads, run)
    assert fit.values["u_i"] == 1.0
    assert {n: fit.values[n] for n in VALUES} == pytest.approx(VALUES, rel=0.02)
    assert fit.fits == "noise"
    rivals = ("supply_side_current", "current_gain", "current_offset", "coulomb", "winding_heating", "driver_dead_band")
    assert mi.diagnose(mi.fit(mi.dc_motor(), run), effects=rivals).effects == ("supply_side_current",)


def test_an_inductance_is_led_out_of_the_valley_below_the_samples():
    """Friction that the plain motor lacks makes the integral's inductance negative: begun near zero it stayed there."""
    motor = mi.dc_motor(R=1.2, L=1e-3, K=0.05, b=2e-5, J=5e-5) + mi.effects.coulomb(tau_c=8e-3)
    t, draws = np.arange(1000) * 1e-3, [np.random.default_rng(k) for k in (1, 2)]
    runs = [noisy(simulated(t, rng.uniform(-6, 6, 12)[np.arange(1000) * 12 // 1000], ("i",), motor), rng, {"i": 0.02})
            for rng in draws]
    assert mi.fit(mi.dc_motor(), runs).values["L"] == pytest.approx(1e-3, rel=0.1)


@pytest.mark.parametrize("seed", range(20))
def test_the_guess_solves_least_squares_with_signs_as_scipy_does(seed):
    rng = np.random.default_rng(seed)
    a, b, signed = rng.normal(size=(12, 5)), rng.normal(size=12), rng.random(5) < 0.3
    reference = lsq_linear(a, b, (np.where(signed, -np.inf, 0.0), np.inf), method="bvls").x
    assert _nonnegative(a, b, signed) == pytest.approx(reference, abs=1e-7)


def test_frictions_whose_simpler_relatives_exclude_each_other_are_fitted():
    """Coulomb friction stands in for the asymmetric one at the start, but not beside friction over the angle."""
    model = mi.dc_motor() + mi.effects.coulomb_asymmetric + mi.effects.angular_friction
    truth = (mi.dc_motor() + mi.effects.coulomb_asymmetric).replace(**GEARED, tau_cp=0.004, tau_cn=0.006)
    run = record(truth, "i theta", swinging())
    assert mi.fit(model, run).values["tau_cn"] == pytest.approx(0.006, rel=0.2)


def test_where_a_race_ends_only_by_steps_too_coarse_to_see_it_diverge_nothing_begins(monkeypatch):
    """A hoist's friction could not be fitted: "the model cannot be simulated at the start"."""
    problem = Problem(mi.dc_motor(), (record(mi.dc_motor().replace(**TRUTH), "omega", swinging()),))
    end = SimpleNamespace(values=problem.model.values | {"R": 3.0})
    assert start_values._led(problem, None) is problem
    assert start_values._led(problem, end).model.values["R"] == 3.0
    monkeypatch.setattr(start_values, "cost_at", lambda problem: np.inf)
    assert start_values._led(problem, end) is problem


@pytest.fixture(scope="module")
def slow_driver():
    """A winding of 0.35 ms, rubbing, behind a driver of 7 ms."""
    t = 1e-3 * np.arange(2500)
    v = np.where(t > 1.2, 1.5, 4.0) * np.sign(np.sin(6.2 * np.pi * t)) * (t > 0.05) * (np.sin(3.1 * np.pi * t) > -0.7)
    truth = mi.dc_motor(R=0.2, L=7e-5, K=0.25, b=3e-3, J=0.018) + mi.effects.coulomb(tau_c=0.3)
    blank = mi.Experiment(t, {"v": v}, {c: np.zeros(len(t)) for c in ("i", "omega")}, sigma={"i": 0.05, "omega": 0.05})
    clean = mi.simulate(truth + mi.effects.driver_lag(T_v=7e-3), blank, initial="rest")[0].outputs
    rng = np.random.default_rng(0)
    return blank.with_(outputs={c: y + 0.05 * rng.standard_normal(len(t)) for c, y in clean.items()})


def test_a_lag_that_changed_places_with_the_winding_s_is_found(slow_driver):
    """The other way round, 0.35 ms in the driver and 6 ms in the winding, is a valley of its own: R 12 % too large."""
    lag = mi.effects.driver_lag
    whole = mi.fit(mi.dc_motor() + mi.effects.coulomb + lag, slow_driver)
    rubbing = mi.fit(mi.dc_motor() + mi.effects.coulomb, slow_driver)
    for found in (whole, refit(rubbing, rubbing.model + lag, [{"T_v": 4e-4}, {"T_v": 1.6e-3}])):
        assert found is not None
        assert max(found.misfit.values()) < 1.05
        assert found.values["T_v"] == pytest.approx(7e-3, rel=0.02)
        assert found.values["R"] == pytest.approx(0.2, rel=0.01)


def test_a_lag_of_a_sensor_that_changed_places_with_the_motor_is_found(rng):
    """1.3 ms of it, and the motor as slow as both, is a valley of its own, in which a dead band helps."""
    t, lag = np.arange(1500) * 1e-3, mi.effects.speed_lag
    truth = mi.dc_motor(R=0.67, L=1e-3, K=0.058, b=5e-5, J=8.8e-5) + mi.effects.coulomb(tau_c=0.104) + lag(T_w=0.014)
    run = mi.Experiment(t, {"v": np.repeat([0, 12, -8, 5, -12, 3.0], 250)}, {"omega": 0 * t})
    speed = mi.simulate(truth, run, initial="rest")[0].outputs["omega"]
    run = run.with_(outputs={"omega": speed + rng.standard_normal(len(t))})
    rubbing = mi.fit(mi.dc_motor() + mi.effects.coulomb, run)
    found = refit(rubbing, rubbing.model + lag, [{"T_w": k * 1e-3} for k in (1, 4, 16)])
    assert found is not None
    assert found.misfit["omega"] < 1.05
    assert found.values["T_w"] == pytest.approx(0.014, rel=0.03)


@pytest.mark.parametrize(("known", "places"), [({}, "LJ"), ({"L": 7e-5}, "J"), ({"J": 1e-4}, "L"), ({"T_v": 4e-4}, "")])
def test_what_the_user_gave_changes_no_places(known, places):
    model = (mi.dc_motor() + mi.effects.driver_lag).replace(**known)
    at, starts = model.values, start_values.exchanged_poles(model, model.effects[0])
    whole = {"L": at["L"] / at["R"], "J": at["J"] / (at["K"] ** 2 / at["R"] + at["b"])}
    assert [name for start in starts for name in start if name != "T_v"] == list(places)
    for start, name in zip(starts, places, strict=True):
        assert start["T_v"] + start[name] / at[name] * whole[name] == pytest.approx(whole[name])


def test_where_neither_place_can_be_simulated_a_race_has_no_winner(slow_driver, monkeypatch):
    rubbing = mi.fit(mi.dc_motor() + mi.effects.coulomb, slow_driver)
    monkeypatch.setattr(trial, "_race", lambda problem, effort: None)
    assert refit(rubbing, rubbing.model + mi.effects.driver_lag, [{"T_v": 4e-4}]) is None

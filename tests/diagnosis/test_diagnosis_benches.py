"""What benches add, in a diagnosis: what hides in the motor, readings that an effect asked for, offsets of sensors."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from battery.cases import ANGLE, Case
from battery.excite import P, driven, level, record
from battery.wide import SIZES, WIDE

import motorid as mi
from motorid.diagnosis.candidates import Search, Stages, library


def test_the_wide_battery_has_every_effect_of_benches_in_three_motors_under_three_drives():
    singles = [c for c in WIDE.values() if c.kind == "single"]
    assert len(SIZES) == 22
    assert len(singles) == 198
    assert {tuple(c.effects) for c in singles} == {(e,) for e in SIZES}
    assert sum(c.kind == "none" for c in WIDE.values()) == 54


def test_a_gear_that_another_inertia_hides_is_told_with_what_to_fix():
    case = Case("gear", "single", "lab", {"gear_efficiency": {"mu_d": 0.1, "mu_b": 0.35}}, n=700)
    runs, check = case.records()
    tried = ["load_friction", "gear_efficiency", "coulomb"]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=tried)
    assert found.effects == ("load_friction",)
    assert "'gear_efficiency' with other values of b and J does the same as 'load_friction'" in found.text
    known = mi.diagnose(mi.fit(mi.dc_motor().fix(J=2.35e-5), runs), check, effects=tried)
    assert known.effects == ("gear_efficiency",)
    assert "does the same" not in known.text


@pytest.mark.parametrize(("effect", "motor", "size"), [
    ("coulomb", "lab", {"tau_c": 8e-3}), ("speed_delay", "lab", {"T_d": 6e-3}),
    ("speed_filter", "lab", {"T_f": 6e-3, "zeta_f": 0.5}), ("speed_lag", "lab", {"T_w": 6e-3}),
    ("driver_lag", "lab", {"T_v": 6e-3}), ("inductance_saturation", "big", {"i_L": 35.0}),
])
def test_one_record_switched_on_and_off_tells_what_is_missing(effect, motor, size):
    """All that happens does so within a tenth of the record; blocks of equal length told one of these six."""
    runs, _ = Case("once", "single", motor, {effect: size}, ("coast",)).records()
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs))
    assert found.effects == (effect,)
    assert found.remaining.adequate


def test_of_an_angle_that_went_one_way_no_friction_of_two_directions_is_kept():
    """One was left over from a pruning; its other direction, which no sample shows, was any (held out 291 %)."""
    motor, n, dt, rng = P.MOTORS["servo"], 1000, 2e-3, np.random.default_rng(0)
    t = np.arange(n) * dt
    v = np.where((t >= 0.1 * n * dt) & (t < 0.6 * n * dt), 0.9 * level(motor), 0.0)
    moved = P.simulate(motor, {"coulomb": {"tau_c": 0.03}}, t, v, substep=None)
    run = record(moved, "logger", ("theta",), motor, rng, "once")
    found = mi.diagnose(mi.fit(mi.dc_motor(), [run]))
    assert found.effects == ("coulomb",)
    assert found.remaining.adequate


@pytest.mark.parametrize(("name", "factor"), [("R", 0.7), ("R", 1000.0), ("L", 1000.0), ("K", 0.1), ("J", 1000.0),
                                              ("J", 1e-3), ("b", 5.0)])
def test_a_value_that_was_fixed_wrong_is_told_before_a_sensor_is_blamed(lab, name, factor):
    """By a data sheet of another motor, a meter, or a unit: a current sensor 30 % off was "missing", or a filter."""
    runs, check = Case("plain", "none", "lab", {}, n=700).records()
    true = getattr(lab, name)
    found = mi.diagnose(mi.fit(mi.dc_motor().fix(**{name: factor * true}), runs), check)
    assert f"other_{name}" in {*found.effects, *(n for group in found.groups for n in group)}, found.text
    assert f"{name}, fixed at" in found.text
    assert f"model.free('{name}') estimates it." in found.text
    assert "measure the" not in found.text
    assert found.remaining.adequate
    freed = next(f for f in found.rivals if f"other_{name}" in f.model.effect_names)
    assert freed.values[name] * np.exp(freed.values[f"d_{name}"]) == pytest.approx(true, rel=0.05)


def test_a_value_that_was_fixed_right_is_not_doubted_and_another_can_be_asked_for(lab, tmp_path):
    runs, check = Case("rubs", "single", "lab", {"coulomb": {"tau_c": 8e-3}}, n=700).records()
    found = mi.diagnose(mi.fit(mi.dc_motor().fix(R=lab.R, J=lab.J), runs), check)
    assert found.effects == ("coulomb",)
    assert "fixed at" not in found.text
    fit = mi.fit(mi.dc_motor().fix(R=0.8 * lab.R) + mi.effects.coulomb + mi.effects.other_R, runs)
    assert np.exp(fit.values["d_R"]) == pytest.approx(1.25, rel=0.02)
    fit.save(tmp_path / "fit.json")
    assert mi.load(tmp_path / "fit.json").values == fit.values
    pickle.loads(pickle.dumps(fit)).save(tmp_path / "again.json")  # as it comes from another process
    assert mi.load(tmp_path / "again.json").values == fit.values
    assert "other_R" not in {c.effect for c in mi.diagnose(mi.fit(mi.dc_motor(), runs), check, max_effects=0).ranking}


LIKE_STOPS = ("end_stop", "spring", "gravity", "constant_load", "coulomb", "lugre", "backlash", "compliance", "cogging")


@pytest.mark.parametrize("theta_lo", [-1.0, -5.0])
def test_end_stops_are_found_where_they_were_reached(theta_lo):
    hidden = {"k_stop": 5.0, "theta_lo": theta_lo, "theta_hi": 2.0, "d_stop": 0.05}
    runs, _ = Case("stops", "single", "servo", {"end_stop": hidden}, ("stairs", "chirp"), channels=ANGLE).records()
    assert min(np.nanmin(r.outputs["theta"]) for r in runs) == pytest.approx(-1.1, abs=0.1)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=LIKE_STOPS)
    assert found.effects == ("end_stop",)
    assert found.remaining.adequate
    reached = hidden if theta_lo > -1.1 else {n: v for n, v in hidden.items() if n != "theta_lo"}
    for n, value in reached.items():
        assert found.after.values[n] == pytest.approx(value, rel=0.01), n
    assert (found.after.std["theta_lo"] is None) == (theta_lo < -1.1)


def test_a_gain_of_the_current_hides_and_identifiability_says_in_what():
    case = Case("gain", "single", "lab", {"current_gain": {"k_i": 0.08}}, n=700)
    runs, _ = case.records()
    text = mi.identifiability(mi.fit(mi.dc_motor() + mi.effects.current_gain, runs)).text
    assert "R by" in text
    assert "Fix k_i (or R) where known" in text


def test_a_group_that_no_voltage_distinguishes_is_told_with_what_to_measure():
    case = Case("offset", "single", "lab", {"speed_offset": {"w_0": 6.0}}, ("forward", "waves"), "forward 0.9",
                channels=("omega",), n=700)
    runs, check = case.records()
    tried = ["speed_offset", "voltage_offset", "constant_load"]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=tried)
    assert sorted(found.groups[0]) == sorted(tried), found.text
    assert found.suggestion is not None
    assert found.suggestion.endswith("; measure the current or angle too.")


def test_a_reading_that_only_the_missing_effect_asked_for_is_taken_back():
    runs, check = WIDE["current_gain.lab.b"].records()
    fit = mi.fit(WIDE["current_gain.lab.b"].base(), runs)
    found = mi.diagnose(fit, check, effects=["current_gain", "coulomb"])
    assert found.effects == ("current_gain",)
    assert "--hold" not in found.text
    assert abs(found.after.values["k_i"] - 0.08) < 3 * found.after.std["k_i"]


def test_a_motor_at_rest_is_among_the_first_speeds_of_a_sensor_with_an_offset():
    case = WIDE["speed_offset.lab.b"]
    fit = mi.fit(mi.dc_motor() + mi.effects.speed_offset, case.records()[0])
    assert fit.initial["omega_0[0]"] == pytest.approx(0.0, abs=0.3)  # the sensor shows 6 rad/s
    assert max(fit.misfit.values()) < 1.1


def test_two_frictions_that_contain_the_same_one_are_not_both_added():
    numbers = {"tau_m": 8e-3, "a_f": 0.5, "phi_f": 1.0}
    runs, _ = Case("turn", "single", "lab", {"angular_friction": numbers}, n=600, channels=ANGLE).records()
    fit = mi.fit(mi.dc_motor() + mi.effects.angular_friction, runs[:1])
    search = Search(fit, None, library(["stribeck", "coulomb_asymmetric", "quadratic_drag"]), Stages())
    assert [s.effect.name for s in search.scores(search.root)] == ["quadratic_drag"]
    wider = Search(mi.fit(mi.dc_motor() + mi.effects.coulomb, runs[:1]), None, library(["stribeck"]), Stages())
    assert [c.effect for c in wider.expand(wider.root)[1]] == ["stribeck"]  # in the place of the one that it contains


@pytest.mark.parametrize(("motor", "hidden", "channels"), [
    ("lab", {"a_w": 0.05, "N_w": 4, "phi_w": 0.5}, ("i", "omega", "theta")),
    ("servo", {"a_w": 0.1, "N_w": 1, "phi_w": 0.7, "e_w": 1.0}, ("i", "omega", "theta")),  # turns less than once
    ("servo", {"a_w": 0.1, "N_w": 1, "phi_w": 0.7, "e_w": 1.0}, ("theta",)),
], ids=["tacho", "encoder", "angle alone"])
def test_a_ripple_of_the_sensor_over_the_turn_is_found_with_its_order(motor, hidden, channels):
    case = Case("ripple", "single", motor, {"speed_ripple": hidden}, ("stairs", "chirp"), "prbs 0.6", channels=channels)
    runs, check = case.records()
    tried = ["speed_ripple", "cogging", "torque_ripple", "gravity", "coulomb", "speed_gain"]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=tried)
    assert found.effects == ("speed_ripple",)
    assert found.remaining.adequate
    values, std = found.best.values, found.best.std
    assert (values["N_w"], values["e_w"]) == (hidden["N_w"], hidden.get("e_w", 0.0))
    for name in ("a_w", "phi_w"):
        assert abs(values[name] - hidden[name]) < 4 * std[name]


def test_held_out_runs_may_show_a_channel_more_than_the_fitted_ones(lab):
    rng = np.random.default_rng(3)
    clean = [driven(lab, {"coulomb": {"tau_c": 8e-3}}, w, 600, 1e-3, rng) for w in ("stairs", "waves", "stairs")]
    channels = ("i", "omega"), ("i", "omega"), ("i", "omega", "theta")
    runs = [record(c, "logger", each, lab, rng, "run") for c, each in zip(clean, channels, strict=True)]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb",))
    assert found.effects == ("coulomb",)

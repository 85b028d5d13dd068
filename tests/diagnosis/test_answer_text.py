"""The answer in words: short, what fell first, a reason for what rises; torques as voltages."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from battery.excite import driven, record
from lab_records import VALUES, noisy, pair, simulated

import motorid as mi
from motorid.channels import worded
from motorid.diagnosis import diagnose
from motorid.diagnosis.misspecification import Grade
from motorid.diagnosis.results import Candidate, Rung
from motorid.diagnosis.verdict import (
    adequate_text,
    curve_text,
    errors_text,
    missing_text,
    own_in_every_run_remark,
    rises_text,
    unexplained_text,
    unseen_remark,
)


def rungs_of(*errors, held_out=None, misfit=1.0, speed=8.0):
    """Rungs with the errors (current, speed) given; `misfit` is of the current, `speed` that of the speed."""
    problem = SimpleNamespace(experiments=[], outputs=["i", "omega"])
    fit = SimpleNamespace(misfit={"i": misfit, "omega": speed}, problem=problem)
    named = [dict(zip(("i", "omega"), e, strict=True)) for e in errors]
    there = [dict(zip(("i", "omega"), e, strict=True)) for e in held_out] if held_out else [None] * len(errors)
    names = [None, "coulomb", "cogging"]
    return [Rung(a, fit, e, v) for a, e, v in zip(names, named, there, strict=False)]


def test_a_rise_of_a_noisy_channel_is_said_once_and_with_its_reason():
    rungs = rungs_of((0.724, 0.030), (0.724, 0.029), (0.726, 0.016),
                     held_out=((0.756, 0.0335), (0.757, 0.0318), (0.761, 0.0224)))
    answer = errors_text(rungs)
    assert answer == "Held-out error: speed 3.35 → 2.24 %, current rises 75.6 → 76.1 % (mostly noise)."
    assert rises_text(rungs) == "Other rises are below 1 % of the error: current."


def test_an_error_that_is_printed_alike_stays():
    rungs = rungs_of((0.01991, 0.214), (0.01992, 0.0197))
    assert errors_text(rungs).startswith("Error: speed 21.4 → 1.97 %, current stays 1.99 %.")


@pytest.mark.parametrize(("elsewhere", "said"), [
    (False, "What remains is noise."), (True, "What remains is noise on the fitted runs, not on the held-out ones.")])
def test_noise_that_remains_is_where_it_remains(elsewhere, said):
    errors = {"held_out": ((0.02, 0.2), (0.02, 0.19))}
    noise = SimpleNamespace(adequate=True, text="", hum="")
    small = missing_text(rungs_of((0.02, 0.2), (0.02, 0.02), **errors, speed=1.0), noise, (), (), elsewhere)
    assert small.endswith(said)
    stopped = missing_text(rungs_of((0.02, 0.2), (0.02, 0.02), **errors), noise, (), (), stopped="the time is up")
    assert stopped.startswith("Missing so far (the time is up): ")
    larger = missing_text(rungs_of((0.02, 0.2), (0.02, 0.02), **errors, speed=9.4), noise, (), (), elsewhere)
    assert "remains is noise" not in larger
    assert larger.endswith("What remains is larger than the noise (speed 9.4 times), but nothing tried predicts it.")
    fine = missing_text(rungs_of((0.02, 0.2), (0.02, 0.02), **errors, speed=8700), noise, (), (), elsewhere)
    assert "(speed over 1000 times)" in fine
    noise.hum = "a hum of 50 Hz"
    hums = missing_text(rungs_of((0.02, 0.2), (0.02, 0.02), **errors, speed=9.4), noise, (), (), elsewhere)
    assert hums.endswith("What remains is larger than the noise (speed 9.4 times), for a hum of 50 Hz.")


@pytest.mark.parametrize(("adequate", "lead", "left"), [
    (True, "Something is missing, and these records do not show what.", "What remains is noise."),
    (False, "Unexplained: something is missing, and no effect of the library explains it.",
     "Not everything is explained: the errors (speed 3 times the noise) are not noise.")])
def test_where_nothing_can_be_named_what_is_left_is_that_of_the_last_model(adequate, lead, left):
    text = "Something is missing: the errors (speed 3 times the noise) are not noise."
    remaining = SimpleNamespace(adequate=adequate, hum="", text=text)
    grades = [Grade("lugre", "approximates", "theta_s cannot be seen")]
    answer = unexplained_text((), rungs_of((0.02, 0.2), (0.02, 0.02), speed=1.0), grades, "", remaining)
    assert answer.startswith(f"{lead} 'lugre' helps, but only approximates it: theta_s cannot be seen. Error: ")
    assert answer.endswith(left)


@pytest.mark.parametrize(("errors", "nearest", "share"), [
    ((0.0955, 0.0448, 0.0372), "coulomb", "60 %"), ((0.0955, 0.09, 0.0372), "quadratic_drag", "81 %")])
def test_nearest_is_what_removes_most_of_the_squared_error_by_the_measure_of_the_table(errors, nearest, share):
    """Held out where there are such runs; a curve may be in the place of another effect."""
    t = np.arange(600) * 2e-3
    v = 6 * np.sign(np.sin(9 * t + 0.1))
    both = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5) + mi.effects.coulomb(tau_c=5e-3)
    both += mi.effects.quadratic_drag(c_2=1e-6)
    blank = mi.Experiment(t, {"v": v}, {"omega": 0 * t})
    fit = mi.fit(both, blank.with_(outputs={"omega": mi.simulate(both, blank, initial="rest")[0].outputs["omega"]}))
    there = {0.0448: (0.0813, 0.0512, 0.0361), 0.09: (0.0813, 0.0813, 0.0356)}[errors[1]]
    rungs = [Rung(added, fit, {"omega": e}, {"omega": h}) for added, e, h in
             zip((None, "coulomb", "quadratic_drag"), errors, there, strict=True)]
    form = SimpleNamespace(text="an inertia that changes with the time")
    little = share if nearest == "coulomb" else "5 %"
    grades = [Grade("coulomb", "approximates", f"it removes {little} of the squared error, and the rest is not noise"),
              Grade("quadratic_drag", "approximates", "a free curve predicts better", form)]
    remaining = SimpleNamespace(adequate=False, hum="", text="Something is missing.")
    answer = unexplained_text((), rungs, grades, form.text, remaining)
    assert answer.startswith("Unexplained, but close to ")  # what does most first
    said, better = answer.split("; better still is ")
    assert f"[{nearest}]" in said
    assert better.startswith(f"{form.text}, which no effect of the library describes.")
    assert answer.count(f"removes {share} of the squared error") == 1  # not once more beside what only approximates
    bare = [Grade(g.effect, g.grade, g.why) for g in grades]
    assert f"[{nearest}]" in unexplained_text((), rungs, bare, "", remaining)  # most of it needs no curve
    assert "Nearest" not in unexplained_text((), rungs[:2], bare[1:], "", remaining)


def test_what_is_as_near_is_told_beside_the_nearest(rng):
    """Steps of one direction: a constant load was the nearest, though dry friction or a dead band do the same."""
    loaded = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5) + mi.effects.constant_load(tau_0=5e-3)
    t = np.arange(600)
    fit = mi.fit(loaded, noisy(simulated(2e-3 * t, 6.0 + np.sign(np.sin(0.02 * t)), model=loaded), rng))
    rungs = [Rung(added, fit, {"omega": e}, None) for added, e in ((None, 0.1), ("constant_load", 0.0179))]
    grades = [Grade("constant_load", "approximates", "a curve is better", SimpleNamespace(text="a torque"))]
    ranking = [Candidate(name, 0.5, refit_drop=drop, reason=why) for name, drop, why in (
        ("stribeck", 0.993, "lowers the error, but tau_s < tau_c"), ("constant_load", 0.968, ""), ("gravity", 0.31, ""),
        ("driver_dead_band", 0.966, "far behind"), ("coulomb", 0.9675, "far behind"), ("lugre", None, ""))]
    remaining = SimpleNamespace(adequate=False, hum="", text="Something is missing.")
    answer = unexplained_text(ranking, rungs, grades, "a torque", remaining)
    assert "(as near: coulomb or driver_dead_band), which removes 97 % of" in answer
    assert "as near" not in unexplained_text(ranking[:3], rungs, grades, "a torque", remaining)


@pytest.mark.parametrize(("like", "better"), [
    ("", "."), ("a torque", "; better still is a torque, which no effect of the library describes.")])
def test_what_together_does_nearly_all_leads_though_each_is_open(rng, like, better):
    """Of a robot that coasts two effects took an error of 14.5 to 1.9 %, and "no effect explains it" was said first."""
    rubs = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5) + mi.effects.coulomb(tau_c=5e-3)
    rubs += mi.effects.speed_lag(T_w=3e-3)
    t = np.arange(600) * 2e-3
    fit = mi.fit(rubs, noisy(simulated(t, 6 * np.sign(np.sin(9 * t + 0.1)), model=rubs), rng))
    rungs = [Rung(added, fit, {"omega": e}, None) for added, e in ((None, 0.1), ("coulomb", 0.06), ("speed_lag", 0.02))]
    grades = [Grade("coulomb", "approximates", "a curve is better", SimpleNamespace(text="a torque")),
              Grade("speed_lag", "approximates", "T_w is not determined, and the rest is not noise")]
    remaining = SimpleNamespace(adequate=False, hum="", text="Something is missing.")
    answer = unexplained_text((), rungs, grades, like, remaining)
    names = "dry (Coulomb) friction [coulomb] and first-order lag of the speed measurement [speed_lag]"
    assert answer.startswith(
        f"Unexplained, but close to {names}, which together remove 96 % of the squared error{better}")
    assert "together" not in unexplained_text((), [rungs[0], rungs[1]], grades[:1], like, remaining)
    if like:  # of a fan whose air thins three effects led, although a curve left a hundredth of what these did
        led = unexplained_text((), rungs, grades, like, remaining, "As a curve: little.", errors={"omega": 0.004})
        assert led.startswith("Unexplained: a torque, which no effect of the library describes. As a curve: little. 'c")
        assert "together" not in led
        assert unexplained_text((), rungs, grades, like, remaining, errors={"omega": 0.01}).startswith(answer[:60])


def test_nearest_is_a_pair_by_what_both_removed_and_what_is_determined(rng):
    """What took an earlier effect's place removed what both do; sizes that are open are no headline beside known ones.
    (EV3: a speed filter for dry friction that differs by direction; a cart: a winding 90 +- 100 K colder for a limit.)
    """
    plain, t = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5), np.arange(600) * 2e-3
    known = plain + mi.effects.coulomb(tau_c=5e-3) + mi.effects.viscous_asymmetric(b_a=1e-5)
    run = noisy(simulated(t, 6 * np.sign(np.sin(9 * t + 0.1)), model=known), rng)
    filtered = mi.fit(known + mi.effects.speed_filter, run)
    known = mi.fit(known, run)
    rungs = [Rung(added, known, {"omega": e}, None, removed) for added, e, removed in (
        (None, 0.040, ()), ("coulomb_asymmetric", 0.027, ()),
        ("coulomb + viscous_asymmetric", 0.024, ("coulomb_asymmetric",)), ("speed_filter", 0.018, ()))]
    grades = [Grade(n, "approximates", "a curve is better", SimpleNamespace(text="a torque"))
              for n in ("coulomb", "viscous_asymmetric", "speed_filter")]
    remaining = SimpleNamespace(adequate=False, hum="", text="Something is missing.")
    answer = unexplained_text((), rungs, grades, "a torque", remaining)
    assert "[coulomb]" in answer.split(" with ")[0]
    assert "[viscous_asymmetric]" in answer
    assert "which remove 64 % of the squared error" in answer
    largest = [*grades[:1], Grade("viscous_asymmetric", "approximates"), Grade("speed_filter", "named")]
    answer = missing_text([*rungs[:3], replace(rungs[3], fit=filtered)], remaining, (), largest)
    assert answer.startswith("Missing: something close to dry (Coulomb) friction [coulomb], ")
    assert "of the squared error; second-order filter of the speed [speed_filter]" in answer
    named = [Grade("coulomb", "named"), *largest[1:]]
    assert "something close to" not in missing_text([*rungs[:3], replace(rungs[3], fit=filtered)], remaining, (), named)
    between = [replace(rungs[0], nrmse={"omega": e}, added=n, removed=r) for n, e, r in (
        (None, 0.10, ()), ("coulomb_asymmetric", 0.09, ()), ("coulomb", 0.02, ()),
        ("viscous_asymmetric", 0.019, ("coulomb_asymmetric",)))]  # what came between is not its own
    assert "[coulomb]" in unexplained_text((), between, grades[:2], "", remaining).split(", which removes 95 %")[0]
    open_ = [Grade("coulomb", "approximates", "R_th and C_th are not determined, and the rest is not noise")]
    rungs = [rungs[0], Rung("coulomb", known, {"omega": 0.004}, None)]
    rubs = Candidate("coulomb", 0.3, fit=mi.fit(plain + mi.effects.coulomb, run), refit_drop=0.97)
    rivals = (replace(rubs, effect="viscous_asymmetric", fit=known), replace(rubs, refit_drop=0.99, reason="a, but b"))
    answer = unexplained_text(rivals, rungs, open_, "", remaining)
    assert "[viscous_asymmetric]" in answer
    assert "which alone removes 97 % of the squared error" in answer
    assert "[coulomb]" in unexplained_text(rivals[1:], rungs, open_, "", remaining)


def test_of_what_alone_leaves_hardly_more_the_commonest_is_the_nearest(rng):
    """A micromouse hardly ran backwards: friction of another size there removed 88.6 %, the same friction 88.3 %."""
    plain, t = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5), np.arange(600) * 2e-3
    run = noisy(simulated(t, 6 * np.sign(np.sin(9 * t + 0.1)), model=plain + mi.effects.coulomb(tau_c=5e-3)), rng)
    fits = {n: mi.fit(plain + mi.effects.get(n), run) for n in ("coulomb", "coulomb_asymmetric", "speed_filter")}
    filtered = fits["speed_filter"]
    rungs = [Rung(None, filtered, {"omega": 0.1}, None), Rung("speed_filter", filtered, {"omega": 0.02}, None)]
    grades = [Grade("speed_filter", "approximates", "T_f is not determined, and the rest is not noise")]
    remaining = SimpleNamespace(adequate=False, hum="", text="Something is missing.")
    for both, nearest in ((0.97, "coulomb_asymmetric"), (0.976, "coulomb")):
        drops = {"coulomb_asymmetric": 0.978, "coulomb": both}
        tried = [Candidate(n, 0.3, fit=fits[n], refit_drop=drop) for n, drop in drops.items()]
        answer = unexplained_text(tried, rungs, grades, "", remaining)
        assert f"[{nearest}]" in answer
        assert f"alone removes {100 * drops[nearest]:.0f} %" in answer


@pytest.mark.parametrize(("missed", "said"), [
    (0.02, " The nearest closed form, its cube, at most 4 N·m, misses 2 % of it."),
    (3e-9, " The nearest closed form, its cube, at most 4 N·m, misses less than 0.1 % of it."), (0.2, "")])
def test_the_closed_form_that_a_curve_is_but_for_a_trifle_is_told(missed, said):
    forms = [("its cube, at most 4 N·m", missed), ("a straight line, at most 3 N·m", 0.9)]
    rungs = rungs_of((0.1, 0.2), held_out=[(0.2, 0.3)])
    assert curve_text(rungs, {"omega": 0.01}, forms) == f"With that as a curve on held-out runs: speed 30 → 1 %.{said}"
    assert curve_text(rungs, {}, forms) == ""


def test_errors_beyond_the_noise_are_in_the_answer_where_nothing_is_missing():
    judged = SimpleNamespace(text="The errors (speed 4 times the noise) do not depend on the motion.", p_value=0.5,
                             false_alarm=0.02, hum="")
    quiet, loud = (SimpleNamespace(problem=SimpleNamespace(outputs=["omega"]), misfit={"omega": m},
                                   nrmse={"omega": 0.1}, mostly_noise=False) for m in (1.0, 4.0))
    small, large = (adequate_text(judged, (), last)[0] for last in (quiet, loud))
    quiet.mostly_noise = True
    assert adequate_text(judged, (), quiet)[0].startswith("These records are mostly noise")
    assert small == "Nothing is missing: the errors do not depend on the motion."
    assert "larger than the noise" in large


def test_a_rise_that_matters_is_beside_the_fall_of_all_and_its_rung_is_named():
    rungs = rungs_of((0.02, 0.5), (0.03, 0.2), (0.03, 0.1), misfit=8.0)
    assert errors_text(rungs) == ("Error: speed 50 → 10 %, current rises 2 → 3 %. "
                                  "Over all channels it falls by 45 %.")
    assert rises_text(rungs) == "With 'coulomb' current rises 2 → 3 % on the fitted runs."
    assert not rises_text(rungs[:2]), "said in the answer already"


def test_where_the_held_out_error_does_not_fall_what_decided_is_said():
    rungs = rungs_of((0.02, 0.5), (0.02, 0.2), held_out=((0.02, 0.5), (0.05, 0.5)), misfit=8.0)
    assert "does not fall over all channels; blocks left out of the fitted runs decided" in errors_text(rungs)
    lost = rungs_of((0.02, 0.5), (0.02, 0.2), held_out=((0.02, 2.5), (0.02, 1.5)), misfit=8.0)
    assert "Both models lose omega there" in errors_text(lost)


@pytest.mark.parametrize(("hidden", "said"), [
    ({"gravity": {"mgl": 1e-2, "phi_g": 0.3}}, "R·mgl/K = 0.29"),
    ({"quadratic_drag": {"c_2": 2e-6}}, "R·c_2/K = "),
])  # fmt: skip
def test_without_a_current_a_size_is_a_voltage_in_answer_card_and_table(lab, rng, hidden, said):
    runs = [record(driven(lab, hidden, drive, 800, 1e-3, rng), "logger", ("theta",), lab, rng, drive)
            for drive in ("stairs", "steps")]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=list(hidden), max_effects=1)
    assert found.after.std[next(iter(next(iter(hidden.values()))))] is None, "the torque itself is open"
    assert said in found.answer
    assert "not determined" not in found.answer
    assert said in str(found)
    name = said.partition(" ")[0]
    assert any(name in row[0] and " V" in row[2] for row in found.card().tables[1].rows)


def test_what_one_step_cannot_show_is_said(rng):
    """Friction that grows with the load, or in one direction only, is R, K and b to one step; two directions tell."""
    t = np.arange(600) * 1e-3
    hidden = mi.dc_motor(**VALUES) + mi.effects.coulomb(tau_c=5e-3)
    step = noisy(simulated(t, np.where(t < 0.02, 0.0, 6.0), ("omega",), model=hidden), rng)
    found = mi.diagnose(mi.fit(mi.dc_motor(), step))
    assert found.effects == ()
    said = next(d for d in found.details if d.startswith("These records cannot show "))
    assert "load_friction" in said
    assert "viscous_asymmetric" in said
    assert "speed_gain" not in said
    both = mi.diagnose(mi.fit(mi.dc_motor(), pair(rng, model=hidden)))
    assert both.effects == ("coulomb",)
    assert not any(d.startswith("These records cannot show ") for d in both.details)


def test_what_is_another_in_every_run_is_said_to_be_estimated_in_the_held_out_runs():
    one = own_in_every_run_remark(SimpleNamespace(per_run={"g_v": {}}))
    assert one.startswith("g_v is another in every run, and so estimated in the held-out runs too")
    assert "z_0 and g_v are others" in own_in_every_run_remark(SimpleNamespace(per_run={"z_0": {}, "g_v": {}}))
    assert own_in_every_run_remark(SimpleNamespace(per_run={})) == ""


def test_what_only_a_model_on_the_way_does_as_well_is_not_said_of_the_last_one():
    """`constant_load` was told to be like two frictions that a simpler one had replaced."""
    model = mi.dc_motor() + mi.effects.coulomb + mi.effects.spring
    same = {"constant_load": ("tau_cp", "tau_cn"), "gravity": ("k_s",), "spring": ("tau_c",)}
    found = SimpleNamespace(path=(None, "node"), search=SimpleNamespace(inseparable=lambda node: same))
    assert diagnose._inseparable(found, model) == {"gravity": ("k_s",)}


@pytest.mark.parametrize(("unit", "word"), [("N·m", "torque"), ("A", "current")])
def test_of_a_drive_no_voltage_is_spoken_of(unit, word, rng, tmp_path):
    """A torque was "as a voltage", its gain of 1 in N·m/V, and the next experiment "at full voltage"."""
    t = np.arange(1500) * 2e-3
    model = mi.torque_driven(b=2e-3, J=1e-3) + mi.effects.coulomb(tau_c=0.3) + mi.effects.constant_load(tau_0=0.1)
    runs = [mi.planned(model, t, v, channels=("omega",)) for v in (
        np.sign(np.sin(9 * t)), 1.2 * np.sin(5 * t), np.repeat([0.0, 0.5, 1.0, -0.5, -1.0], 300))]
    runs = [r.with_(outputs={"omega": r.outputs["omega"] + 0.3 * rng.normal(size=r.n)}, sigma={},
                    units={**r.units, "v": unit}) for r in runs]
    fit = mi.fit(mi.torque_driven() + mi.effects.coulomb, runs[:2])
    assert fit.determined["gain"].text == f"speed per {word}, steady"
    assert fit.determined["tau_c_voltage"].text.endswith(f"as a {word}, tau_c/g")
    assert fit.problem.model.parameters["g"].unit == ("" if unit == "N·m" else "N·m/A")
    assert "voltage" not in fit.card().to_html()
    found = mi.diagnose(mi.fit(mi.torque_driven(), runs[:2]), runs[2], effects=["coulomb", "stribeck", "lugre"],
                        max_effects=2)
    told = " ".join([found.text, mi.report(found, tmp_path / "found.html").read_text(encoding="utf-8")])
    assert "voltage" not in told, [told[m.start() - 60:m.start() + 30] for m in re.finditer("voltage", told)]


def test_what_would_show_an_effect_is_asked_of_channels_that_the_model_has():
    same = {"constant_load": ("tau_cp", "tau_cn")}
    assert "with current and speed measured, are" in unseen_remark(same, "dc_motor")
    assert "with speed measured, are" in unseen_remark(same, "torque_driven")


def test_a_suggestion_names_what_drives():
    assert worded("No voltage record; reversals at full voltage (up to 1 A). 'voltage_offset'; two voltages.",
                  {"v": "A"}) == (
        "No current record; reversals at full current (up to 1 A). 'voltage_offset'; two currents.")
    assert worded("a loss of voltage.", {"v": "V"}) == "a loss of voltage."


def test_the_angle_of_a_linear_axis_is_a_position():
    told = "The errors (angle 32 times the noise) follow a load that changes with the angle; phase angles."
    assert worded(told, {"v": "V", "theta": "rad"}) == told
    assert worded(told, {"v": "V", "theta": "m"}) == (
        "The errors (position 32 times the noise) follow a load that changes with the position; phase angles.")


@mi.effect(balance="torque")
def ramp(m, slope=mi.P(0.0, "N/m", null=0.0)):
    """A rail that rises on one side."""
    m.torque -= slope * ca.fmax(m.theta, 0)


def on_a_ramp(rng, names):
    """Records of a carriage, driven by forces, on a rail that rises on one side."""
    t, found = np.arange(500) * 8e-3, []
    model = mi.torque_driven(axis="linear", b=0.5, J=0.4, g=1.0) + ramp(slope=0.5)
    for name, f in zip(names, (2.0, 3.1, 1.3), strict=True):
        drive, still = 2 * np.sin(f * t) + 0.8 * np.sin(5.3 * f * t), dict.fromkeys(("omega", "theta"), 0 * t)
        bare = mi.Experiment(t, {"v": drive}, still, units={"v": "N", "omega": "m/s", "theta": "m"}, name=name)
        shown = mi.simulate(model, bare, initial="rest")[0].outputs
        found.append(bare.with_(outputs={c: y + 1e-3 * np.ptp(y) * rng.normal(size=500) for c, y in shown.items()}))
    return found


def test_all_that_a_diagnosis_says_of_a_linear_axis_calls_its_angle_a_position(rng, tmp_path):
    """Its answer did; the judgements, the grades and the place of what is missing, in JSON, did not."""
    runs = on_a_ramp(rng, ("one", "other", "check"))
    found = mi.diagnose(mi.fit(mi.torque_driven(axis="linear"), runs[:2], window=None), runs[2],
                        effects=["coulomb", "spring"])
    assert found.remainder.follows == found.missing.acts_like == "a load that changes with the position"
    assert "position" in found.adequacy.text
    assert "changes with the position, which the library lacks" in found.ladder.rungs[-1].why
    assert "They follow a load that changes with the position." in found.remaining.text
    assert [w for w in re.findall(r"\w* ?angle\b", json.dumps(found.to_dict())) if "phase" not in w] == []
    page = mi.report(found, tmp_path / "found.html").read_text(encoding="utf-8")
    assert "acts like a load that changes with the position" in page
    assert "Error of the position, held out" in page
    assert {*mi.plot_ladder(found).get_legend_handles_labels()[1]} >= {"position x, fitted", "speed v, held out"}
    assert "rad" not in mi.plot_answer(found).get_xlabel()
    plan = mi.suggest_experiment([found.best, found.before]).experiment
    assert plan.units == {"v": "N", "omega": "m/s", "theta": "m"}

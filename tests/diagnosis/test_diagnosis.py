"""What a diagnosis rests on: evidence, adequacy, ranking, orders, location, the loop, the next experiment."""

from __future__ import annotations

import json
import re
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from battery.cases import CASES
from battery.excite import driven, record

import motorid as mi
from motorid.diagnosis.adequacy import adequacy
from motorid.diagnosis.candidates import library
from motorid.diagnosis.design_criteria import Rival
from motorid.diagnosis.locate import accounted, binned
from motorid.diagnosis.record_versions import _fall, delay_of
from motorid.diagnosis.score_test import rank, score
from motorid.diagnosis.verdict import _described, moves
from motorid.display.numbers import with_error
from motorid.effects import LIBRARY
from motorid.errors import FitError, ModelError, UsageError
from motorid.estimation.angle_orders import highest_order, likely_lines
from motorid.estimation.linearisation import Tangent
from motorid.numerics.autoregression import autocorrelation, effective_samples
from motorid.records.datasets import data_path
from motorid.records.experiment import Experiment

FEW = ("coulomb", "brush_drop", "constant_load", "quadratic_drag", "speed_lag")
ANGLE = ("i", "omega", "theta")
PURE_TWINS = ("coulomb", "speed_lag", "voltage_offset", "brush_drop")


def runs_of(motor, effects, drives, channels=("i", "omega"), n=700, seed=1, **how) -> list[Experiment]:
    rng = np.random.default_rng(seed)
    return [
        record(
            driven(motor, effects, words, n, how.get("dt", 1e-3), rng),
            how.get("chain", "logger"),
            channels,
            motor,
            rng,
            f"run{k + 1}",
            how.get("noise", 0.01),
        )
        for k, words in enumerate(drives)
    ]


@pytest.fixture(scope="module")
def rubbing(lab):
    """Two training runs and a held-out one of a motor with Coulomb friction."""
    runs = runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("stairs", "ramps", "steps"))
    return runs[:2], runs[2:]


@pytest.fixture(scope="module")
def plain(rubbing):
    return mi.fit(mi.dc_motor(), rubbing[0])


@pytest.fixture(scope="module")
def found(rubbing, plain):
    words: list[str] = []
    return mi.diagnose(plain, rubbing[1], effects=FEW, progress=words.append), words


# -- evidence ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_coloured_samples_count_for_fewer(plant, rng, rho):
    worth = np.mean([effective_samples(plant.coloured(np.zeros(4000), 1.0, rho, rng)) for _ in range(5)])
    assert worth == pytest.approx(4000 * (1 - rho) / (1 + rho), rel=0.2)


def test_missing_samples_count_for_nothing(rng):
    r = rng.normal(size=1000)
    r[500:] = np.nan
    assert effective_samples(r) == pytest.approx(500, rel=0.15)
    assert autocorrelation(r, 3) == pytest.approx([1, 0, 0, 0], abs=0.15)


# -- adequacy ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.85])
def test_noise_alone_raises_few_alarms(plant, lab, rng, rho):
    t, v = plant.staircase([3, -3, 1, 4, -2, 0.5], 0.08)
    clean = plant.simulate_linear(lab, t, v)
    alarms = 0
    for _ in range(30):
        noisy = {c: plant.coloured(clean[c], s, rho, rng) for c, s in (("i", 0.03), ("omega", 0.8))}
        fit = mi.fit(mi.dc_motor(), Experiment(t, {"v": v}, noisy))
        judged = adequacy(fit)
        alarms += not judged.adequate
        assert judged.false_alarm == 0.02
    assert alarms <= 3


def test_the_colour_of_the_noise_is_told(plant, lab, rng):
    t, v = plant.staircase([3, -3, 1, 4, -2, 0.5], 0.1)
    clean = plant.simulate_linear(lab, t, v)
    noisy = {"i": plant.white(clean["i"], 0.03, rng), "omega": plant.coloured(clean["omega"], 0.8, 0.85, rng)}
    judged = adequacy(mi.fit(mi.dc_motor(), Experiment(t, {"v": v}, noisy)))
    assert judged.adequate, judged.text
    assert judged.channels["omega"]["autocorrelation"] == pytest.approx(0.85, abs=0.1)
    assert judged.channels["i"]["autocorrelation"] == pytest.approx(0.0, abs=0.15)
    assert "noise of speed is coloured" in judged.text


def test_a_model_that_lacks_friction_is_not_adequate(plain):
    judged = adequacy(plain, rank(plain, [LIBRARY[n] for n in FEW]))
    assert not judged.adequate
    assert judged.p_value < judged.false_alarm
    assert "not noise" in judged.text


def test_errors_below_the_noise_that_follow_the_motion_are_not_called_too_large(plain):
    """The noise of fast records is estimated too large; stated too large here."""
    runs = [r.with_(sigma={"i": 1.0, "omega": 30.0}) for r in plain.problem.experiments]
    fit = mi.fit(mi.dc_motor(), runs)
    judged = adequacy(fit, rank(fit, [LIBRARY[n] for n in FEW]))
    assert not judged.adequate
    assert max(f["ratio"] for f in judged.channels.values()) < 1
    assert re.search(r"the errors are small \(.*\), but they depend on the motion: .* explains? \d+ %", judged.text)


def test_errors_that_drift_far_beyond_the_noise_are_not_called_noise(plant):
    runs = runs_of(plant.MOTORS["servo"], {"coulomb": {"tau_c": 0.03}}, ("stairs", "ramps"), ("theta",), dt=2e-3)
    judged = adequacy(mi.fit(mi.dc_motor(), runs))
    assert judged.channels["theta"]["ratio"] > 20
    assert not judged.adequate, judged.text


# -- ranking -----------------------------------------------------------------------------------------------


def test_the_predicted_drop_is_what_a_refit_gives(found):
    best = found[0].ranking[0]
    assert best.effect == "coulomb"
    assert best.predicted_drop == pytest.approx(best.refit_drop, abs=0.08)
    assert best.predicted_drop > 0.5


def test_what_the_fitted_parameters_absorb_scores_nothing(plain):
    @mi.effect(balance="torque")
    def more_viscous(m, b_x=mi.P(1e-6, "N·m·s/rad", null=0.0)):
        """More of what b already is."""
        m.torque -= b_x * m.omega

    scores = {s.effect.name: s.drop for s in rank(plain, [more_viscous, LIBRARY["coulomb"]])}
    assert scores["more_viscous"] < 1e-3 < scores["coulomb"]


def test_the_predicted_size_is_near_the_truth_where_nothing_absorbs_it(lab):
    runs = runs_of(lab, {"constant_load": {"tau_0": 5e-3}}, ("stairs", "ramps"))
    fit = mi.fit(mi.dc_motor(), runs)
    s = score(Tangent.of(fit), LIBRARY["constant_load"])
    assert s.starts[0]["tau_0"] == pytest.approx(5e-3, rel=0.1)
    assert s.drop > 0.5


def test_effects_that_the_channels_cannot_see_are_left_out(plant):
    runs = runs_of(plant.MOTORS["wheel"], {}, ("stairs",), ("omega",), dt=2e-3, n=400)
    names = {s.effect.name for s in rank(mi.fit(mi.dc_motor(), runs), list(LIBRARY.values()))}
    assert "current_lag" not in names
    assert "current_offset" not in names
    assert "speed_lag" in names


def test_the_order_of_cogging_is_found_from_the_misfit(lab):
    hidden = {"cogging": {"A": 8e-3, "N": 16, "phi": 0.7}}
    runs = runs_of(lab, hidden, ("stairs 0.3", "ramps 0.3"), ANGLE)
    tangent = Tangent.of(mi.fit(mi.dc_motor(), runs))
    assert likely_lines(tangent, LIBRARY["cogging"], 3)[0].order == 16
    assert 16 <= highest_order(tangent) < 2 * np.pi / (1e-3 * 20)


# -- location ----------------------------------------------------------------------------------------------


def _known(motor, **given):
    """The motor with its true numbers; only L is fitted."""
    values = {n: getattr(motor, n) for n in ("R", "L", "K", "b", "J")} | given
    return mi.dc_motor().fix(**{n: v for n, v in values.items() if n != "L"})


def test_the_missing_torque_is_the_friction_that_was_hidden(rubbing, lab):
    missing = mi.locate(mi.fit(_known(lab), rubbing[0]))
    assert missing.where == "mechanical"
    torque, omega = np.concatenate(missing.torque), np.concatenate([s["omega"] for s in missing.signals])
    for side in (1, -1):
        assert np.median(torque[side * omega > 20]) == pytest.approx(-side * 8e-3, rel=0.15)
    assert missing.bins["torque"][0].against == "omega"
    assert sum(missing.regions.values()) == pytest.approx(1)
    assert sum(missing.shares.values()) == pytest.approx(1)
    assert "The speed explains" in missing.text


def test_a_missing_torque_is_no_missing_voltage_beside_a_precise_angle(lab):
    """Were the model's own steps to hold only roughly, the angle would need no torque and the current a voltage."""
    runs = runs_of(lab, {"cogging": {"A": 8e-3, "N": 16, "phi": 0.7}}, ("stairs 0.5", "steps 0.6"), ("i", "theta"))
    missing = mi.locate(mi.fit(mi.dc_motor(), runs))
    assert missing.where == "mechanical"
    assert missing.shares["mechanical"] > 0.8


def test_the_missing_voltage_is_the_drop_that_was_hidden(plant):
    micro = plant.MOTORS["micro"]
    runs = runs_of(micro, {"brush_drop": {"V_b": 0.5, "i_b": 0.01}}, ("stairs", "ramps"))
    missing = mi.locate(mi.fit(_known(micro), runs))
    assert missing.where == "electrical"
    voltage, current = np.concatenate(missing.voltage), np.concatenate([s["i"] for s in missing.signals])
    assert np.median(voltage[current > 0.08]) == pytest.approx(-0.5, rel=0.15)
    assert missing.bins["voltage"][0].against == "i"


def test_a_torque_of_the_angle_is_located_over_the_angle(lab):
    runs = runs_of(lab, {"cam": {"A": 2.5e-2}}, ("stairs 0.5", "ramps 0.6"), ANGLE)
    missing = mi.locate(mi.fit(mi.dc_motor(), runs))
    best = missing.bins["torque"][0]
    assert best.against == "theta"
    assert best.explained > 0.4
    assert np.all(best.low <= best.mean)
    assert np.all(best.mean <= best.high)


def test_without_a_current_voltage_and_torque_look_the_same(plant):
    wheel = plant.MOTORS["wheel"]
    runs = runs_of(wheel, {"coulomb": {"tau_c": 0.05}}, ("stairs", "ramps"), ("omega",), dt=2e-3)
    missing = mi.locate(mi.fit(mi.dc_motor(), runs))
    assert missing.where is None
    assert "look the same" in missing.text
    assert all("i" not in s and "heat" not in s for s in missing.signals)  # nobody measured it


def test_the_time_that_something_follows_is_that_of_each_run(plain):
    later = [r.with_(t=r.t + 1000 * k) for k, r in enumerate(plain.problem.experiments)]
    missing = mi.locate(replace(plain, problem=plain.problem.with_(experiments=later, model=plain.model)))
    assert max(s["t"].max() for s in missing.signals) < 100


def test_what_was_added_has_the_size_of_what_was_missing_without_a_current(plant):
    """The current and its scale are each model's own there, and the torque stands for both balances."""
    wheel = plant.MOTORS["wheel"]
    runs = runs_of(wheel, {"coulomb": {"tau_c": 0.05}}, ("stairs", "ramps"), ("omega",), dt=2e-3)
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=("coulomb",), max_effects=1)
    voltages, torques = (np.concatenate(parts) for parts in accounted(found.before, found.after))
    speed = np.concatenate([s["omega"] for s in found.missing.signals])
    missing, added = (binned("omega", speed, y).mean for y in (np.concatenate(found.missing.torque), torques))
    assert not voltages.any()
    assert np.corrcoef(missing, added)[0, 1] > 0.85
    assert np.std(added) == pytest.approx(np.std(missing), rel=0.5)


# -- the whole answer --------------------------------------------------------------------------------------


def test_friction_is_found_sized_and_said(found):
    diagnosis, _ = found
    assert (diagnosis.verdict, diagnosis.effects, diagnosis.where) == ("missing", ("coulomb",), "mechanical")
    assert diagnosis.after.values["tau_c"] == pytest.approx(8e-3, rel=0.05)
    assert diagnosis.remaining.adequate
    assert "tau_c = " in diagnosis.text
    assert "b from" in diagnosis.text  # what had compensated for it
    first, last = diagnosis.ladder.rungs[0], diagnosis.ladder.rungs[-1]
    assert last.validation_nrmse["omega"] < 0.5 * first.validation_nrmse["omega"]


def test_every_candidate_has_a_reason(found):
    for c in found[0].ranking:
        assert c.accepted == (c.effect == "coulomb")
        assert c.reason


def test_what_was_judged_on_held_out_runs_says_by_how_much(found):
    judged = [c for c in found[0].ranking if c.held_out_gain is not None]
    assert "coulomb" in [c.effect for c in judged]
    assert all((c.held_out_gain is None) == (c.validation_nrmse is None) for c in found[0].ranking)
    best = next(c for c in judged if c.effect == "coulomb")
    plain = found[0].ladder.rungs[0].validation_nrmse
    ratio = np.sqrt(np.prod([best.validation_nrmse[c] / plain[c] for c in plain]))
    assert best.held_out_gain == pytest.approx(1 - ratio, abs=0.02)
    assert found[0].to_dict()["ranking"][0]["held_out_gain"] is not None


def test_a_parameter_that_is_held_does_not_move(rubbing):
    before = mi.fit(mi.dc_motor().fix(L=0), rubbing[0])
    after = mi.fit(before.model + mi.effects.coulomb, rubbing[0])
    said = moves(before, after)
    assert "b from" in said
    assert "L from" not in said


def test_the_progress_is_told(found):
    words = found[1]
    assert words[0].startswith("ranked 5")
    assert any(w.startswith("refitted") for w in words)
    assert "accepted coulomb" in words


def test_the_json_is_plain_and_as_agreed(found):
    whole = json.loads(json.dumps(found[0].to_dict()))
    assert {
        "verdict",
        "text",
        "where",
        "location",
        "ranking",
        "effects",
        "ladder",
        "parameters_before",
        "parameters_after",
        "suggestion",
    } <= set(whole)
    assert {"effect", "predicted_drop", "refit_drop", "validation_nrmse", "group", "parameters", "accepted"} <= set(
        whole["ranking"][0]
    )
    first, last = whole["ladder"]
    assert (first["added"], first["grade"], first["gain"]) == (None, None, None)
    assert (last["added"], last["grade"], last["why"]) == ("coulomb", "named", "")
    assert last["gain"] > 2 * last["gain_se"] > 0
    assert whole["remaining"]["kind"] == "noise"
    assert whole["remaining"]["follows"] is None
    assert whole["remaining"]["text"] == found[0].remaining.text


def same(one, other):
    """Whether two JSON values are the same but for rounding, which compiling on the way changes."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(v, other[k]) for k, v in one.items())
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return one == pytest.approx(other, rel=1e-5, abs=1e-9)
    return one == other


def test_what_one_model_alone_would_let_an_experiment_see_is_not_fitted_for_its_json(found, monkeypatch):
    """It took 26 s after the time was up; there is no other model to distinguish it from."""
    monkeypatch.setattr(Rival, "as_allowed", None)
    alone = replace(found[0], groups=())
    assert len(alone.rivals) == len(alone.to_dict()["rivals"]) == 1


def test_the_same_records_give_the_same_answer(rubbing, plain, found):
    again = mi.diagnose(plain, rubbing[1], effects=FEW)
    assert same(again.to_dict(), found[0].to_dict())
    assert not same({**again.to_dict(), "where": "sensor"}, found[0].to_dict())


@pytest.mark.slow
def test_a_process_pool_gives_the_same_answer(rubbing, plain, found):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        apart = mi.diagnose(plain, rubbing[1], effects=FEW, map=pool.map)
    assert apart.effects == found[0].effects
    assert apart.after.values == pytest.approx(found[0].after.values, rel=1e-9)


def test_without_held_out_runs_blocks_of_the_records_judge(rubbing, plain):
    ladder = mi.improve(plain, effects=("coulomb", "brush_drop"))
    assert [r.added for r in ladder.rungs] == [None, "coulomb"]
    assert all(r.validation_nrmse is None for r in ladder.rungs)
    on = mi.fit(ladder.best.model + mi.effects.brush_drop, rubbing[0])  # each rung is a fit to go on from
    assert on.chi2 <= ladder.best.chi2 * 1.001


def test_nothing_is_added_beyond_the_limit(rubbing, plain):
    found = mi.diagnose(plain, rubbing[1], effects=("coulomb",), max_effects=0)
    assert found.effects == ()
    assert len(found.ladder.rungs) == 1


def test_an_effect_that_is_not_known_is_named_with_the_nearest(plain):
    with pytest.raises(ModelError, match="coulomb"):
        mi.diagnose(plain, effects=("coulom",))
    with pytest.raises(ModelError, match="unknown effect 'coulom'"):
        mi.diagnose(plain, effects="coulom")
    assert [e.name for e in library("coulomb", ["gravity"])] == ["coulomb", "gravity"]


def test_no_delay_longer_than_the_record_is_tried():
    t = np.arange(8) * 1e-3
    run = mi.Experiment(t, {"v": np.where(t < 2e-3, 0.0, 4.0)}, {"i": np.array([0, 0, 0, 1, 1.6, 2, 2.1, 1.8])})
    fit = mi.fit(mi.dc_motor(), run)
    assert _fall(fit, delay_of(8e-3)) == -np.inf
    assert mi.diagnose(fit).effects == ()


def test_the_users_own_effect_wins_where_it_is_the_truth(lab):
    @mi.effect(balance="torque")
    def seal_drag(m, c_r=mi.P(1e-4, "N·m·s½/rad½", null=0.0, lower=0.0)):
        """A drag that grows as the square root of the speed."""
        m.torque -= c_r * m.omega / (m.omega**2 + 1e-2) ** 0.25

    runs = runs_of(lab, {"root_drag": {"c_r": 1.5e-3}}, ("stairs", "ramps", "steps"))
    fit = mi.fit(mi.dc_motor(), runs[:2])
    found = mi.diagnose(fit, runs[2:], effects=("coulomb", "quadratic_drag", "constant_load"), also=[seal_drag])
    assert found.effects == mi.diagnose(fit, runs[2:], effects=("coulomb", seal_drag)).effects == ("seal_drag",)
    assert found.after.values["c_r"] == pytest.approx(1.5e-3, rel=0.05)
    assert found.where == "mechanical"


# -- what is not distinguished -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [c.name for c in CASES.values() if c.kind == "twins"])
def test_twins_are_said_as_a_group_with_an_experiment_that_parts_them(name):
    case = CASES[name]
    runs, check = case.records()
    alike = (*case.effects, *(t for t in case.twins if t in PURE_TWINS))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), check, effects=alike, max_effects=1)
    assert found.verdict == "missing"
    assert set(found.groups[0]) == set(alike)
    assert found.effects == found.groups[0][:1]
    assert found.ladder.rungs[1].grade == "group"
    assert "These records do not distinguish" in found.text
    assert found.suggestion.startswith("To distinguish")
    assert found.suggestion in found.text


# -- the next experiment -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rivals(plant):
    """Coulomb friction and a constant load, both fitted to forward runs that cannot tell them apart."""
    servo = plant.MOTORS["servo"]
    runs = runs_of(servo, {"constant_load": {"tau_0": 0.04}}, ("forward", "waves"), dt=2e-3)
    return [mi.fit(mi.dc_motor() + e, runs) for e in (mi.effects.coulomb, mi.effects.constant_load)]


def test_the_next_experiment_reverses_where_that_separates(rivals):
    best = mi.suggest_experiment(rivals)
    v = best.experiment.inputs["v"]
    assert v.min() < 0 < v.max()
    assert np.abs(v).max() <= np.abs(rivals[0].problem.experiments[0].inputs["v"]).max() * (1 + 1e-9)
    assert best.discrimination[best.name] == max(best.discrimination.values())
    assert best.discrimination[best.name] > 100 * min(best.discrimination.values())


def test_the_next_experiment_keeps_to_the_limits(rivals):
    best = mi.suggest_experiment(rivals, v_max=1.0, duration=0.5)
    assert np.abs(best.experiment.inputs["v"]).max() <= 1.0
    assert best.experiment.duration <= 0.5
    with pytest.raises(FitError, match="i_max"):
        mi.suggest_experiment(rivals, i_max=1e-3)
    with pytest.raises(UsageError, match="two"):
        mi.suggest_experiment(rivals[:1])


# -- one number, said once ---------------------------------------------------------------------------------


def test_text_tables_and_fit_give_the_same_errors_and_deviations(lab):
    """Over runs of unequal length, too; deviations are those of residuals as coloured as they are."""
    runs = runs_of(lab, {"coulomb": {"tau_c": 8e-3}}, ("stairs", "steps", "prbs"), ("i", "omega"))
    runs[1] = runs[1].select(slice(0, runs[1].n // 3))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2:], effects=("coulomb", "brush_drop"))
    for rung in found.ladder.rungs:
        assert rung.nrmse == pytest.approx(dict(rung.fit.nrmse), rel=1e-9)
        assert rung.validation_nrmse == pytest.approx(dict(mi.evaluate(rung.fit, runs[2:]).nrmse), rel=1e-4)
    std = found.before.std["b"]
    assert std is not None
    white = dict(zip(mi.covariance(found.before).names, found.before.certainty("white").std, strict=True))
    assert std > 2 * white["b"]  # the bait
    assert f"b from {with_error(found.before.values['b'], std)} to" in found.text
    assert with_error(found.before.values["b"], std, "N·m·s/rad") in found._repr_html_()


def test_without_a_current_a_torque_is_said_as_the_voltage_that_the_records_determine():
    runs = [r.without("i") for r in mi.read_runs(data_path("hidden_friction") / "run*.csv")]
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs), effects=["coulomb"])
    values = found.best.values
    volts = float(re.search(r"R·tau_c/K = ([\d.]+) ±", found.text).group(1))
    assert volts == pytest.approx(values["R"] * values["tau_c"] / values["K"], rel=1e-3)
    assert "tau_c not determined" not in found.text


@pytest.mark.parametrize("share", [0.45, 0.8])
def test_a_size_within_two_deviations_from_zero_is_no_answer(share):
    """As of a stalled fit without a current, "tau_c = 1.9 ± 1.5 N·m": its voltage is known to 7 %."""
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb,
                 [r.without("i") for r in mi.read_runs(data_path("hidden_friction") / "run*.csv")])
    fit.__dict__["std"] = {**fit.std, "tau_c": share * fit.values["tau_c"]}
    told = _described(fit, "coulomb")
    assert ("R·tau_c/K = " in told, "tau_c = " in told) == (share > 0.5, share < 0.5)
    fit.__dict__["determined"] = {}
    assert ("tau_c not determined" in _described(fit, "coulomb")) == (share > 0.5)

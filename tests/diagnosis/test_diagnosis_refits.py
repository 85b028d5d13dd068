"""Refits are judged only when they are finished, where they mean something, and on parts that show what is there."""

import tracemalloc
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.signal
from battery.excite import driven, record
from lab_records import VALUES, noisy, simulated

import motorid as mi
from motorid.diagnosis import candidates as search
from motorid.diagnosis import misspecification as grades
from motorid.diagnosis import predictive_score as held
from motorid.diagnosis import record_versions as parts
from motorid.diagnosis import refit as trial
from motorid.diagnosis import score_test as ranking
from motorid.diagnosis import stepwise
from motorid.diagnosis.admissibility import objections
from motorid.diagnosis.model_comparison import node_of
from motorid.diagnosis.results import Candidate
from motorid.diagnosis.verdict import measured_angle_remark
from motorid.effects import LIBRARY
from motorid.errors import OutOfTime
from motorid.estimation.continuation import MATTERS, by_continuation, collapsed_again, restored
from motorid.estimation.fit import solve
from motorid.estimation.least_squares import Estimate, least_squares
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.numerics.parallel import budget, one_thread
from motorid.problem.problem import Problem
from motorid.problem.simulate import simulate
from motorid.records.datasets import data_path
from motorid.records.experiment import windows

TRUE = {"R": 1.2, "L": 2e-3, "K": 0.05, "b": 2e-5, "J": 3e-5}


def _run(model, seed=0, n=600, dt=1e-3):
    t, rng = dt * np.arange(n), np.random.default_rng(seed)
    blank = mi.Experiment(t, {"v": 6 * np.sign(np.sin(14 * t + 0.1))}, {"i": np.zeros(n), "omega": np.zeros(n)},
                          sigma={"i": 0.01, "omega": 0.1})
    clean = simulate(model, blank, initial="rest", estimate_initial=False)[0].outputs
    return blank.with_(outputs={c: clean[c] + s * rng.normal(size=n) for c, s in blank.sigma.items()})


def test_a_model_that_copies_the_measured_angle_predicts_none():
    """Next to no inertia: the current balances the weight, and its voltage is the measured angle's rate."""
    copying = {"R": 1e-6, "L": 1.0, "K": 1.0, "b": 1e-3, "J": 1e-6}
    t = np.arange(600) * 2e-3
    theta = 0.1 * np.sin(7 * t) + 0.05 * np.sin(17 * t)
    run = mi.Experiment(t, {"v": 0.3 * np.cos(7 * t)}, {"theta": theta})
    for model, copies in ((mi.dc_motor(**copying) + mi.effects.gravity(mgl=1.0, phi_g=np.pi), True),
                          (mi.dc_motor(**TRUE) + mi.effects.gravity(mgl=0.01, phi_g=0.0), False),
                          (mi.dc_motor(**TRUE) + mi.effects.cogging(A=5e-3, N=12, phi=0.0), False)):
        problem = mi.Problem(model.with_(angle_input=True), [run])
        problem = problem.refined(problem.start)
        assert trial.copies_the_angle(problem, problem.start) == copies


def test_where_no_start_can_be_simulated_a_refit_begins_where_the_smaller_model_ended(monkeypatch):
    race = trial._race
    monkeypatch.setattr(trial, "_race",
                        lambda p, effort: None if p.model.parameters["tau_c"].value > 1 else race(p, effort))
    friction = mi.effects.coulomb(tau_c=8e-3)
    fit = mi.fit(mi.dc_motor(**TRUE), _run(mi.dc_motor(**TRUE) + friction))
    found = trial.refit(fit, fit.model + mi.effects.coulomb, [{"tau_c": 100.0}])
    assert found is not None
    assert found.values["tau_c"] == pytest.approx(8e-3, rel=0.05)


def test_a_pool_that_breaks_costs_no_refit_and_the_budget_holds_beside_one():
    def breaking(function, tasks):
        yield function(tasks[0])
        raise BrokenProcessPool("a process was killed")

    stages = search.Stages(map_=breaking)
    assert list(stages.map(abs, [-1, -2, -3])) == [1, 2, 3]
    with pytest.raises(OutOfTime), budget(0.0):
        list(stages.map(abs, [-1]))


def test_what_was_accepted_stays_where_the_time_ends_before_it_is_looked_at_again(monkeypatch):
    fit = mi.fit(mi.dc_motor(), [_run(mi.dc_motor(**TRUE) + mi.effects.coulomb(tau_c=8e-3), k) for k in range(2)])

    def out_of_time(self, *given):
        raise OutOfTime

    monkeypatch.setattr(search.Search, "exchanged", out_of_time)
    found, _ = stepwise.explored(fit, None, [mi.effects.coulomb], search.Stages(), 3)
    assert found.path[-1].key == {"coulomb"}
    assert found.stopped == trial.OUT_OF_TIME


@one_thread
def test_a_phase_may_turn_either_way_in_a_refit(lab):
    """Its places to start from are quarters of a turn, which are no limits."""
    hidden = {"angular_friction": {"tau_m": 6e-3, "a_f": 0.6, "N_f": 1, "phi_f": -1.3}}
    rng, angle = np.random.default_rng(3), ("i", "omega", "theta")
    runs = [record(driven(lab, hidden, w, 600, 2e-3, rng), "logger", angle, lab, rng, w) for w in ("stairs", "ramps")]
    fit = mi.fit(mi.dc_motor(), runs)
    found = trial.refit(fit, fit.model + mi.effects.angular_friction, [{"tau_m": 5e-3, "phi_f": -0.3}])
    assert found.values["phi_f"] == pytest.approx(-1.3, abs=0.1)
    assert found.values["a_f"] == pytest.approx(0.6, abs=0.05)


def test_a_refit_goes_on_beyond_its_limit_of_iterations(monkeypatch):
    run = _run(mi.dc_motor(**TRUE))
    monkeypatch.setattr(trial, "POLISH", replace(trial.POLISH, max_iterations=2))
    far = Problem(mi.dc_motor(R=3.0, L=5e-3, K=0.08, b=1e-4, J=8e-5), (run,))
    once = by_continuation(far, trial.POLISH, wide=False)
    on = trial._converged(far, trial.POLISH)
    assert once.solution.status == "limit"
    assert on.history[-1] < 0.5 * once.history[-1]


def test_what_does_not_matter_collapses_again_and_what_matters_is_kept(monkeypatch):
    run = _run(mi.dc_motor(**TRUE))
    fit = mi.fit(mi.dc_motor(), run)
    dead = replace(fit, jacobian=fit.jacobian * np.where([p.name == "L" for p in fit.problem.unknown], 1e-9, 1.0))
    assert restored(fit, fit.model).values["L"] == fit.values["L"]
    assert restored(dead, fit.model).values["L"] > 10 * MATTERS * fit.values["L"]
    # Where the fit had a dead inductance, but the records now want one, that is kept.
    had = replace(dead, values={**fit.values, "L": 1e-8},
                  problem=fit.problem.for_model(fit.model.start_at({"L": 1e-8})))
    assert collapsed_again(fit.problem.for_model(fit.model), had).model.values["L"] == fit.values["L"]
    # And where it makes no difference, it goes back.
    same = replace(dead, values={**fit.values, "L": fit.values["L"] * 1.0001},
                   problem=fit.problem.for_model(fit.model.start_at({"L": fit.values["L"] * 1.0001})))
    assert collapsed_again(fit.problem.for_model(fit.model), same).model.values["L"] == same.values["L"]
    # But not where its simulation takes more steps than the samples are worth: one such took half a minute.
    monkeypatch.setattr(Problem, "_most_steps", 10)
    assert collapsed_again(fit.problem.for_model(fit.model), same).model.values["L"] == fit.values["L"]


def test_memory_grows_with_the_samples_not_with_their_square():
    model = mi.dc_motor(**TRUE) + mi.effects.coulomb(tau_c=5e-3)
    fit = mi.fit(model, _run(model, n=3000))
    tracemalloc.start()
    try:
        assert trial.hidden_in(fit, LIBRARY["coulomb_asymmetric"]) == ()
        assert tracemalloc.get_traced_memory()[1] < 50 * fit.jacobian.nbytes
    finally:
        tracemalloc.stop()


def test_a_gap_at_its_limit_is_refused():
    run = _run(mi.dc_motor(**TRUE))
    fit = mi.fit(mi.dc_motor(), run)
    model = (fit.model + mi.effects.backlash).start_at({"r_gap": 0.5, "gap": 0.02})
    problem = trial._bounded(fit, model)
    low = problem.parameters["gap"].lower
    values = {**problem.values, "gap": low}
    at_limit = replace(fit, problem=fit.problem.for_model(problem), values=values)
    assert "gap runs to its limit" in objections(at_limit, LIBRARY["backlash"])
    inside = replace(at_limit, values={**values, "gap": 3 * low})
    assert "gap" not in objections(inside, LIBRARY["backlash"])
    shaft = replace(inside, values={**inside.values, "omega_c": problem.parameters["omega_c"].upper})
    assert "omega_c runs to its limit" in objections(shaft, LIBRARY["backlash"])


def test_a_small_play_in_an_elastic_shaft_is_sought_from_that_shaft():
    """A twentieth of a degree, on a motor that turns slowly; an elastic shaft alone explains four fifths of it."""
    motor = {"R": 2.07, "L": 8.7e-4, "K": 0.875, "b": 5.7e-3, "J": 0.0167}
    play = {"r_gap": 0.6, "gap": 1e-3, "omega_c": 500.0, "zeta_c": 0.2}
    model = mi.dc_motor(**motor) + mi.effects.backlash(**play)
    t, rng = 5e-4 * np.arange(3000), np.random.default_rng(1)
    waves = [sum(rng.normal() * np.sin(w * t + rng.uniform(0, 6)) for w in (9, 23, 57, 131)) for _ in range(2)]
    runs = []
    for v in waves:
        clean = simulate(model, mi.Experiment(t, {"v": v}, {"i": 0 * t, "omega": 0 * t}), initial="rest")[0].outputs
        runs.append(mi.Experiment(t, {"v": v}, {c: y + 0.003 * np.std(y) * rng.normal(size=len(t))
                                                for c, y in clean.items()}))
    shaft = mi.fit(mi.dc_motor() + mi.effects.compliance, runs[0])
    task = trial.widened(shaft, LIBRARY["backlash"])
    assert {start["omega_c"] for start in task.starts} == {shaft.values["omega_r"]}
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[0]), runs[1:], effects=("compliance", "backlash"))
    assert found.effects == ("backlash",)
    assert found.best.values["gap"] == pytest.approx(1e-3, rel=0.05)


def test_a_sensor_that_empties_a_known_parameter_is_refused():
    run = _run(mi.dc_motor(**TRUE))
    before = mi.fit(mi.dc_motor(), run)
    after = trial.refit(before, before.model + mi.effects.current_lag, ({"T_i": 5e-4},))
    assert after is not None
    assert "goes to zero" not in objections(after, LIBRARY["current_lag"], before)
    emptied = replace(after, values={**after.values, "L": 1e-9})
    assert "L goes to zero" in objections(emptied, LIBRARY["current_lag"], before)
    before = replace(before, values={**before.values, "L": 200 * after.values["L"]})  # which made up for a slew rate
    assert "goes to zero" not in objections(after, LIBRARY["current_lag"], before)


def test_a_refit_that_ends_where_nothing_can_be_simulated_is_none(monkeypatch):
    """Of a whisk's record on the world's bench the derivatives were finite there, and the diagnosis ended."""
    before = mi.fit(mi.dc_motor(**TRUE), _run(mi.dc_motor(**TRUE)))

    def lost(fit):
        raise mi.SimulationError("left the finite numbers")

    monkeypatch.setattr(trial.Fit, "simulations", property(lost))
    assert trial.finished(before, trial.Raced(before.problem, 1.0, 1.0, False), trial.POLISH) is None


def test_parts_show_both_directions_and_what_is_rare():
    n, dt = 12000, 1e-3
    t = dt * np.arange(n)
    omega = np.where(t < 9.0, 50.0, -50.0) * (1 + 0.02 * np.sin(7 * t))
    run = mi.Experiment(t, {"v": omega / 10}, {"omega": omega})
    chosen = parts.parts_of([run], 2000 / n)
    assert chosen is not None
    assert len(chosen) == 2
    speeds = np.concatenate([p.outputs["omega"] for p in chosen])
    assert speeds.min() < -40
    assert speeds.max() > 40
    assert all(p.n - p.run_in == parts.PART for p in chosen)


def test_parts_run_in_before_they_are_judged_so_that_what_was_before_leaves_nothing(rng):
    """Of a speed that lags by 25 samples nobody knows where it is as a part begins; windows are judged from there."""
    t, v = 1e-3 * np.arange(12000), np.repeat(rng.uniform(-12, 12, 200), 60)
    model = mi.dc_motor(**TRUE) + mi.effects.speed_lag(T_w=0.025)
    clean = mi.simulate(model, mi.Experiment(t, {"v": v}, {"i": 0 * t, "omega": 0 * t}), initial="rest")[0].outputs
    run = mi.Experiment(t, {"v": v}, {c: y + 5e-3 * y.std() * rng.standard_normal(len(t)) for c, y in clean.items()})
    chosen = parts.parts_of([run], 0.4)
    assert chosen is not None
    assert {p.run_in for p in chosen[1:]} == {parts.RUN_IN}
    fit = mi.fit(mi.dc_motor() + mi.effects.speed_lag, chosen)
    assert max(fit.misfit.values()) < 1.05
    assert fit.nrmse["omega"] < 6e-3
    assert all(np.isnan(s.residual("omega")[:s.experiment.run_in]).all() for s in fit.simulations)
    assert fit.problem.n_outputs == 2 * sum(p.n - p.run_in for p in chosen)
    assert {w.run_in for p in chosen for w in windows(p, 0.2)} == {0}


def test_what_stands_behind_all_that_could_explain_one_misfit_is_tried_beside_the_first():
    """A load of a hoist came seventh, after six ways of a current's lag, and was not refitted: neither was found."""
    model = mi.dc_motor(R=0.94, L=1.6e-3, K=0.048, b=3e-5, J=8.5e-5)
    model = model + mi.effects.current_lag(T_i=3e-3) + mi.effects.constant_load(tau_0=5e-3)
    runs = []
    for seed in (1, 2):
        rng, t = np.random.default_rng(seed), 1e-3 * np.arange(1500)
        blank = mi.Experiment(t, {"v": np.repeat(rng.uniform(-10, 10, 15), 100)}, {"i": 0 * t, "omega": 0 * t})
        clean = mi.simulate(model, blank, initial="rest")[0].outputs
        runs.append(blank.with_(outputs={c: y + 0.01 * y.std() * rng.standard_normal(1500) for c, y in clean.items()}))
    tried = search.Search(mi.fit(mi.dc_motor(), runs), None, search.library(None), search.Stages())
    ranked = [s.effect.name for s in tried.scores(tried.root)]
    assert ranked.index("constant_load") >= search.SHORTLIST
    assert ranked[0] == "current_lag"
    assert "constant_load" in [s.effect.name for s in tried._shortlist(tried.root)]


def test_what_leaves_noise_on_whole_records_is_not_looked_at_in_windows(monkeypatch):
    """A spring and friction, right and at the noise, were given up for "backlash" of windows: 129 → 1.67 % before."""
    rests = mi.dc_motor(**TRUE) + mi.effects.spring(k_s=0.02)
    model = rests + mi.effects.coulomb(tau_c=0.02)
    t, rng = 1e-3 * np.arange(3000), np.random.default_rng(1)
    blank = mi.Experiment(t, {"v": np.repeat(rng.uniform(-6, 6, 12), 250)}, {"theta": 0 * t})
    clean = mi.simulate(model, blank, initial="rest")[0].outputs["theta"]
    run = blank.with_(outputs={"theta": clean + 0.01 * clean.std() * rng.standard_normal(3000)})
    kept = held.HeldOut.of(root := mi.fit(mi.dc_motor(), run), run)
    for last, looked in ((mi.fit(model, run, start="model"), False),
                         (mi.fit(rests, run, start="model"), True)):
        monkeypatch.setattr(stepwise, "in_windows", Mock(return_value=None))
        path = [node_of(root, kept), node_of(last, kept)]
        assert stepwise._in_windows(SimpleNamespace(path=path, rounds=())) is None
        assert stepwise.in_windows.called is looked


def test_where_a_larger_model_only_led_out_of_a_valley_the_smaller_one_goes_on():
    """End stops whose descent had stopped at eight times the noise took a "cogging" of a thousandth of the torque."""
    model = mi.dc_motor(**TRUE) + mi.effects.coulomb(tau_c=4e-3)
    run = _run(model)
    whole, larger = mi.fit(model, run), mi.fit(model + mi.effects.quadratic_drag, run)
    problem = whole.problem.start_at({"K": 0.02, "tau_c": 1e-4, "J": 1e-5})
    stuck = trial._fit_of(least_squares(problem, LevenbergMarquardt(max_iterations=1, looks=0)))
    assert stuck.cost > 2 * whole.cost
    kept = held.HeldOut.of(root := mi.fit(mi.dc_motor(), run), run)
    tried = search.Search(root, run, search.library(["coulomb", "quadratic_drag"]), search.Stages())
    small, large, right = (node_of(fit, kept, parent=tried.root) for fit in (stuck, larger, whole))
    onward = tried.led_out(small, large)
    assert onward.fit.cost < 1.001 * whole.cost
    assert tried.nodes[small.key] is onward
    assert tried.led_out(right, large) is right
    assert tried.led_out(tried.root, small) is tried.root  # the fit that the user gave


def test_what_a_sensor_invents_is_told_by_the_whole_record_also_in_its_parts(rng):
    """A speed from an angle that wraps, behind a filter: no part of one voltage told that no motor jumps so."""
    t, k = 1e-3 * np.arange(24000), np.arange(24000)
    v = np.where(k // 4000 % 2, -6.0, 6.0)
    speed = 6 * scipy.signal.lfilter([0.02], [1, -0.98], v) + 0.3 * rng.standard_normal(len(t))
    for at in range(400, 24000, 800):
        speed[at:at + 20] += 250 * np.exp(-np.arange(20) / 5)
    whole = mi.Experiment(t, {"v": v}, {"omega": speed}, name="plant")
    gone = t[np.isnan(whole.without_spikes().outputs["omega"])]
    chosen = parts.parts_of([whole], 0.25)
    assert chosen is not None
    calm = [p for p in chosen if np.ptp(p.inputs["v"]) == 0]
    assert calm
    for part in (*calm, *windows(calm[0], 0.5)):
        told = np.isin(part.t, gone)
        assert told.any() or part.n < 700
        assert list(np.isnan(part.without_spikes().outputs["omega"])) == list(told)
    fit = mi.fit(mi.dc_motor(), chosen)
    reading = parts.without_spikes(fit)
    assert reading is not None
    assert f"{sum(int(np.isin(p.t, gone).sum()) for p in chosen)} samples" in reading.says
    assert reading.fitted(fit).nrmse["omega"] < 0.02 < fit.nrmse["omega"]


def test_an_axis_whose_effects_need_its_measured_angle_is_looked_at_in_windows(monkeypatch):
    """A servo's dead band was "gravity" along the measured angle, for whose lack the first model lost it."""
    run = _run(mi.dc_motor(**TRUE))
    own = mi.fit(mi.dc_motor(), run)
    led = mi.fit(replace((own.model + mi.effects.gravity(mgl=1e-4)), angle_input=True, _systems={}), run, start="model")
    monkeypatch.setattr(stepwise, "in_windows", Mock(return_value=None))
    for last, found, looked in ((led, 0.2, True), (own, 0.2, False), (own, 0.9, True)):
        errors = [SimpleNamespace(held_out={"omega": SimpleNamespace(nrmse=e, misfit=30.0)}) for e in (0.9, found)]
        path = [SimpleNamespace(fit=fit, key=frozenset(fit.model.effect_names), predictions=error)
                for fit, error in zip((own, last), errors, strict=True)]
        stepwise.in_windows.reset_mock()
        assert stepwise._in_windows(SimpleNamespace(path=path, rounds=())) is None
        calls = stepwise.in_windows.call_args_list
        assert any(call.args[0] is own and call.kwargs == {"drifts": True} for call in calls) == looked


def test_parts_that_are_nearly_all_are_not_taken():
    t = 1e-3 * np.arange(2500)
    run = mi.Experiment(t, {"v": np.sin(t)}, {"omega": np.sin(t)})
    assert parts.parts_of([run], 0.9) is None


def test_a_parameter_that_was_open_before_may_be_emptied():
    run = _run(mi.dc_motor(**TRUE))
    before = mi.fit(mi.dc_motor(), run)
    names = [p.name for p in before.problem.unknown]
    open_ = replace(before, jacobian=before.jacobian * np.where(np.array(names) == "L", 0.0, 1.0))
    assert open_.std["L"] is None
    after = trial.refit(before, before.model + mi.effects.current_lag, ({"T_i": 5e-4},))
    assert after is not None
    emptied = replace(after, values={**after.values, "L": 1e-9})
    assert "goes to zero" not in objections(emptied, LIBRARY["current_lag"], open_)


def test_what_a_model_far_from_its_data_determined_may_be_emptied_by_what_leaves_noise():
    """A lag of the current that no sample resolves, 12 times as long for the lack of a speed averaged over 22 ms: the
    average was refused, and a first-order lag beside a shorter average "approximated" it."""
    motor = mi.dc_motor(R=9.3, L=9e-4, K=0.0111, b=3e-7, J=5.2e-7)
    t, rng = 1e-3 * np.arange(2000), np.random.default_rng(2)
    run = mi.Experiment(t, {"v": np.repeat(rng.uniform(-6, 6, 20), 100)}, {"i": 0 * t, "omega": 0 * t})
    clean = simulate(motor + mi.effects.speed_average(T_a=0.022), run, initial="rest")[0].outputs
    run = run.with_(outputs={c: y + 0.01 * np.std(y) * rng.normal(size=2000) for c, y in clean.items()})
    before = mi.fit(mi.dc_motor(), run)
    after = trial.refit(before, before.model + mi.effects.speed_average, ({"T_a": 0.02},))
    assert after is not None
    assert max(after.misfit.values()) < 1.1 < 5 < max(before.misfit.values())
    emptied = replace(after, values={**after.values, "L": 1e-9})
    assert "goes to zero" not in objections(emptied, LIBRARY["speed_average"], before)


def test_a_late_sensor_leaves_the_motor_its_own_lag():
    """Behind a bent drive curve a motor without inertia, whose speed is 48 ms late, and a brake left noise."""
    run = _run(mi.dc_motor(**TRUE))
    run = run.with_(outputs={"omega": run.outputs["omega"]})
    before = mi.fit(mi.dc_motor(), run)
    after = trial.refit(before, before.model + mi.effects.speed_lag, ({"T_w": 2e-4},))
    assert after is not None
    assert before.std["J"] is None
    assert "own lag" not in objections(after, LIBRARY["speed_lag"], before)
    shown = np.array([p.name != "J" for p in after.problem.unknown])
    emptied = replace(after, values={**after.values, "J": 1e-4 * before.values["J"]}, jacobian=after.jacobian * shown)
    assert "the motor's own lag goes to zero with it" in objections(emptied, LIBRARY["speed_lag"], before)


def test_a_model_that_rests_on_the_measured_angle_says_so():
    run = _run(mi.dc_motor(**TRUE))
    own = mi.fit(mi.dc_motor() + mi.effects.cogging(N=12), run)
    led = mi.fit(replace(own.model, angle_input=True, _systems={}), run, start="model")
    assert measured_angle_remark(own) == ""
    assert "use the measured angle" in measured_angle_remark(led)


def test_refits_that_cannot_win_are_given_up(lab):
    """Coulomb leaves only noise: what contains it gains nothing, and the others are far behind."""
    rng = np.random.default_rng(8)
    moves = [driven(lab, {"coulomb": {"tau_c": 8e-3}}, words, 800, 1e-3, rng) for words in ("stairs", "steps")]
    runs = [record(m, "logger", ("i", "omega"), lab, rng, f"run{k}") for k, m in enumerate(moves)]
    names = ("coulomb", "stribeck", "coulomb_asymmetric", "speed_lag", "brush_drop")
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:1]), runs[1:], effects=names)
    assert found.effects == ("coulomb",)
    why = {c.effect: c for c in found.ranking}
    assert "no better than coulomb" in why["stribeck"].reason
    assert why["speed_lag"].reason == "not refitted: no gain that matters is predicted"
    assert why["stribeck"].predicted_drop > 0.9 > 0.5 > why["speed_lag"].predicted_drop
    assert why["speed_lag"].refit_drop is None  # it was not refitted


def test_beside_an_effect_that_leaves_noise_what_promises_little_is_not_even_begun(lab, monkeypatch):
    """The favourite is finished first."""
    rng = np.random.default_rng(8)
    moves = driven(lab, {"coulomb": {"tau_c": 8e-3}}, "stairs", 800, 1e-3, rng)
    fit = mi.fit(mi.dc_motor(), record(moves, "logger", ("i", "omega"), lab, rng, "run"))
    promises = {"coulomb_asymmetric": 0.97, "coulomb": 0.95, "speed_lag": 0.01, "brush_drop": 0.6}
    tasks = [trial.Task(fit, fit.model + LIBRARY[n], LIBRARY[n], ({},), p) for n, p in promises.items()]
    begun, race = [], trial.raced

    def seen(fit, model, *starts):
        begun.append(model.effect_names)
        return race(fit, model, *starts)

    monkeypatch.setattr(trial, "raced", seen)
    asymmetric, coulomb, lag, drop = trial.refits(tasks, map)
    assert begun == [("coulomb",), ("coulomb_asymmetric",), ("brush_drop",)]
    assert isinstance(coulomb, mi.Fit)
    assert asymmetric.why == "no better than coulomb, its simpler special case"
    assert lag.why == drop.why == trial.FAR_BEHIND.format("coulomb")
    assert lag.drop is None  # it was not refitted, and no table may say so
    assert 0 < drop.drop < asymmetric.drop < 1


def test_what_an_unfinished_fit_would_reach_by_itself_is_no_effect_s_gain(lab):
    moves = driven(lab, {"coulomb": {"tau_c": 8e-3}}, "stairs", 400, 1e-3, np.random.default_rng(8))
    record_ = record(moves, "logger", ("i", "omega"), lab, np.random.default_rng(8), "run")
    fit = mi.solve(mi.Problem(mi.dc_motor(), [record_]), mi.LevenbergMarquardt(max_iterations=1), start="model")
    own = trial._undamped(fit.residuals, fit.jacobian * fit.problem.scaling.slope(fit.q))
    assert own < 0.9 * fit.cost
    names = ("gravity", "coulomb", "spring")
    tasks = [trial.Task(fit, fit.model + LIBRARY[n], LIBRARY[n], ({},)) for n in names]
    ends = ((fit.cost, own), (fit.cost, 0.5 * own), (0.9 * fit.cost, own))
    races = {k: trial.Raced(fit.problem, *end, False) for k, end in enumerate(ends)}
    assert {k: g.why for k, g in trial._outdone(tasks, races, {}).items()} == {0: trial.NOTHING}


def test_what_contains_the_leader_is_tried_where_one_step_promises_more():
    names = [p.name for p in LIBRARY["coulomb_asymmetric"].parameters]
    values = dict(zip(names, (8e-3, 7.7e-3), strict=True))
    run = _run((mi.dc_motor() + LIBRARY["coulomb_asymmetric"]).replace(**TRUE, **values), seed=9)
    fit = mi.fit(mi.dc_motor(), run)
    assert not trial.far(mi.fit(mi.dc_motor() + LIBRARY["coulomb"], run))  # so it is quiet
    pair = ("coulomb_asymmetric", "coulomb")
    tasks = [trial.Task(fit, fit.model + LIBRARY[n], LIBRARY[n], ({},), 0.9) for n in pair]
    wider, _ = trial.refits(tasks, map)
    assert isinstance(wider, mi.Fit)
    assert wider.values[names[1]] == pytest.approx(7.7e-3, rel=0.02)


def test_what_added_nothing_to_a_smaller_model_is_not_looked_at_again(lab, monkeypatch):
    """What a smaller model's ranking knows spares the look, and never hides an effect that is there."""
    rng = np.random.default_rng(3)
    hidden = {"coulomb": {"tau_c": 8e-3}, "quadratic_drag": {"c_2": 6e-8}}
    moves = {words: driven(lab, hidden, words, 900, 1e-3, rng) for words in ("stairs", "steps")}
    runs = [record(m, "logger", ("i", "omega"), lab, rng, words) for words, m in moves.items()]
    plain, larger = mi.fit(mi.dc_motor(), runs), mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    known = ranking.rank(plain, list(LIBRARY.values()))
    fresh = [e for e in LIBRARY.values() if "coulomb" not in (e.name, *e.includes)]
    exact = {s.effect.name: s for s in ranking.rank(larger, fresh)}
    looked, score = [], ranking.score
    monkeypatch.setattr(ranking, "score", lambda tangent, effect: looked.append(effect.name) or score(tangent, effect))
    quick = {s.effect.name: s for s in ranking.rank(larger, fresh, known)}
    assert "quadratic_drag" in looked
    assert len(looked) < len(fresh)
    chi2 = larger.chi2
    for name, s in quick.items():
        if name in looked:  # the same sum twice, but threads of the linear algebra may add it up in another order
            assert s.drop == pytest.approx(exact[name].drop, rel=1e-6, abs=1e-9), name
        else:
            assert s.drop * chi2 < ranking.NOTHING, name
        assert name in looked or exact[name].drop * chi2 < 3 * ranking.NOTHING, name


def test_an_effect_that_a_smaller_model_in_another_valley_does_without_is_dropped():
    """Of an open bridge and a friction with breakaway the few steps of a race had found no good sizes: an eddy-current
    brake was named beside both, and the fit of both alone leaves noise."""
    both = mi.dc_motor(**TRUE) + mi.effects.coulomb(tau_c=8e-3) + mi.effects.brush_drop(V_b=0.6, i_b=0.1)
    runs, few = [_run(both, seed) for seed in (1, 2)], mi.LevenbergMarquardt(max_iterations=1, looks=0)
    tried = search.Search(mi.fit(mi.dc_motor(), runs), None, search.library(("coulomb",)), search.Stages())
    far_off = mi.dc_motor(**{**TRUE, "R": 3.0}) + mi.effects.coulomb(tau_c=1e-5) + mi.effects.brush_drop(V_b=2.0)
    begun = by_continuation(tried.root.fit.problem.for_model(far_off), few, wide=False, narrow=False)
    lost = node_of(trial._fit_of(begun), tried.held, "coulomb", tried.root)
    more = mi.fit(both + mi.effects.quadratic_drag, runs)
    large = node_of(more, tried.held, "coulomb", tried.root)
    tried.nodes |= {lost.key: lost, large.key: large}
    assert min(lost.fit.misfit.values()) > 2
    kept = tried.pruned(large, tried.root)
    assert kept.key == lost.key
    assert max(kept.fit.misfit.values()) < 1.2


@pytest.mark.parametrize("whole", [True, False])
def test_a_model_with_all_effects_goes_along_its_own_angle_again(whole):
    """Two stops were found along the measured angle before the drop of the brushes, whose own angle drifts without it:
    with both it stayed measured, its noise was more than that of the sensors, and a third effect was sought for it."""
    full = mi.dc_motor(R=1.2, L=1e-3, K=0.05, b=2e-4, J=2e-5) + mi.effects.gravity(mgl=0.02) + mi.effects.brush_drop(
        V_b=1.5, i_b=0.05)
    rng, t = np.random.default_rng(1), np.arange(1500) * 2e-3
    levels = {"v": np.repeat(rng.uniform(-9, 9, 15), 100)}
    still = mi.Experiment(t, levels, dict.fromkeys(("i", "omega", "theta"), 0 * t))
    shown = mi.simulate(full, still, initial="rest")[0].outputs
    noise = {"i": 0.02, "omega": 0.3, "theta": 0.02}
    run = still.with_(outputs={c: shown[c] + s * rng.standard_normal(len(t)) for c, s in noise.items()})
    model = full if whole else full.without("brush_drop")
    led = mi.fit(replace(model, angle_input=True, _systems={}), run, start="model")
    freed = trial.led_on(led) or led
    assert led.model.angle_input
    assert freed.model.angle_input is not whole
    assert freed.cost < 1.02 * led.cost


def test_two_effects_that_only_together_help_are_tried_together(lab, monkeypatch):
    """As cogging alone slips against the measured angle as long as the ripple is missing, and the other way round."""
    hidden = {"coulomb": {"tau_c": 8e-3}, "brush_drop": {"V_b": 0.5, "i_b": 0.1}}
    rng = np.random.default_rng(4)
    moves = [driven(lab, hidden, words, 900, 1e-3, rng) for words in ("stairs", "steps", "prbs")]
    runs = [record(m, "logger", ("i", "omega"), lab, rng, f"run{k}") for k, m in enumerate(moves)]
    fit, tried = mi.fit(mi.dc_motor(), runs[:2]), ("coulomb", "brush_drop", "quadratic_drag", "gravity")
    judge = search.Search._judge
    monkeypatch.setattr(
        search.Search,
        "_judge",
        lambda self, node, effects, found: judge(self, node, effects, found if len(effects) > 1 else None),
    )
    found = mi.diagnose(fit, runs[2:], effects=tried)
    assert set(found.effects) == {"coulomb", "brush_drop"}
    assert [r.added for r in found.ladder.rungs] == [None, " + ".join(found.effects)]
    marked = {c.effect: c.reason for c in found.ranking if c.accepted}
    assert set(marked) == {"coulomb", "brush_drop"}
    assert all("together with" in why for why in marked.values())
    assert mi.diagnose(fit, runs[2:], effects=tried, max_effects=1).effects == ()  # there is no room for two


def limited(limit, seed, volts, n=1500, dt=1e-3):
    """A motor whose driver holds the current below `limit`, by an integrator of its own."""
    R, L, K, b, J, fine = 0.4, 1e-3, 0.08, 1e-4, 2e-3, 50
    i = w = 0.0
    rows, h = [], dt / fine
    for v in np.repeat(volts, n // len(volts)):
        rows.append((i, w))
        for _ in range(fine):
            e = v - R * i - K * w
            e = min(e, 0.0) if i >= limit else max(e, 0.0) if i <= -limit else e
            i, w = i + h * e / L, w + h * (K * i - b * w) / J
    y, rng = np.array(rows), np.random.default_rng(seed)
    noisy = {"i": y[:, 0] + 0.05 * rng.normal(size=len(y)), "omega": y[:, 1] + 0.1 * rng.normal(size=len(y))}
    return mi.Experiment(dt * np.arange(len(y)), {"v": np.repeat(volts, n // len(volts))}, noisy, name=f"run{seed}")


def test_a_driver_that_limits_the_current_is_no_effect_of_the_motor(monkeypatch):
    drives = ([0, 20, 8, -16, 4], [0, 12, 24, -6, 10], [0, -18, 6, 22, 2])
    runs = [limited(25.0, k, volts) for k, volts in enumerate(drives)]
    fit, tried = mi.fit(mi.dc_motor(), runs[:2]), ("magnetic_saturation", "coulomb")
    found = mi.diagnose(fit, runs[2:], effects=tried)
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert "a current limit of the driver?" in found.text
    assert all(r.grade == "approximates" for r in found.ladder.rungs[1:])
    assert "the driver's current limit" in found.ladder.rungs[1].why
    # Were it not for the limit and for free forms, what then helps would have its name.
    monkeypatch.setattr(grades, "current_limit", lambda run: None)
    monkeypatch.setattr(grades, "better_forms", lambda fit, rival: [])
    monkeypatch.setattr(stepwise, "better_forms", lambda fit, rival: [])
    assert mi.diagnose(fit, runs[2:], effects=tried).effects  # the bait
    free = [limited(1e9, k, volts) for k, volts in enumerate(drives[:2])]
    assert "current limit" not in mi.diagnose(mi.fit(mi.dc_motor(), free), effects=tried).text


@pytest.mark.parametrize("left", [[], [0]])
def test_refits_are_given_up_for_good_only_where_the_best_leaves_noise(lab, left, monkeypatch):
    """Elsewhere what a few steps leave far behind is only put off: held-out runs may refuse what led."""
    rng = np.random.default_rng(8)
    moves = driven(lab, {"coulomb": {"tau_c": 8e-3}}, "stairs", 800, 1e-3, rng)
    fit = mi.fit(mi.dc_motor(), record(moves, "logger", ("i", "omega"), lab, rng, "run"))
    effects = (mi.effects.coulomb, mi.effects.coulomb_asymmetric, mi.effects.speed_lag)
    monkeypatch.setattr(trial, "far", lambda fit: left)
    found = trial.refits([trial.Task(fit, fit.model + e, e, ({},)) for e in effects], map)
    assert [isinstance(f, mi.Fit) for f in found] == [True, bool(left), False]
    later = trial.completed([f for f in found if isinstance(f, trial.GivenUp)], map)
    assert [isinstance(f, mi.Fit) for f in later] == ([True] if left else [False, False])


def test_what_was_put_off_is_refitted_where_what_led_is_refused(lab, monkeypatch):
    rng = np.random.default_rng(8)
    moves = driven(lab, {"coulomb": {"tau_c": 8e-3}}, "stairs", 800, 1e-3, rng)
    run = record(moves, "logger", ("i", "omega"), lab, rng, "run")
    fit = mi.fit(mi.dc_motor(), run)
    looked = search.Search(fit, None, [mi.effects.coulomb, mi.effects.speed_lag], search.Stages())
    monkeypatch.setattr(trial, "far", lambda fit: [0])
    monkeypatch.setattr(search, "LITTLE", -1.0)  # all is begun
    _, listed = looked.expand(looked.root)
    assert next(c for c in listed if c.effect == "speed_lag").fit is None
    monkeypatch.setattr(search, "objections", lambda *fits: "refused")
    _, listed = looked.expand(looked.root)
    assert next(c for c in listed if c.effect == "speed_lag").fit is not None


def test_what_takes_too_many_steps_is_polished_roughly(monkeypatch):
    fit = mi.fit(mi.dc_motor(), _run(mi.dc_motor(**TRUE)))
    problem = fit.problem.for_model(fit.model)
    assert trial._polished(fit, problem, trial.POLISH).problem.accuracy is None
    monkeypatch.setattr(type(problem), "worth_its_steps", False)
    rough = trial._polished(fit, problem, trial.POLISH)
    assert rough.problem.accuracy == held.ROUGH
    assert rough.values["K"] == pytest.approx(fit.values["K"], rel=1e-3)


def test_where_a_fit_is_lost_a_guess_of_its_own_starts_along_either_angle(monkeypatch, rng):
    """The score's start needs the measured angle; along it a heavy arm without motion can win the race, and not after.

    A guess from the records themselves is where the model's own angle leads on.
    """
    t = np.arange(0, 40, 0.04)
    goal = np.interp(t, np.arange(0, 41, 4), rng.uniform(-1.5, 1.5, 11))
    run = mi.Experiment(t, {"v": 8 * np.sin(goal) + 0.1 * rng.normal(size=len(t))},
                        {"theta": goal + 1e-3 * rng.normal(size=len(t))})
    fit = mi.fit(mi.torque_driven(), run)
    assert trial.lost(fit)
    entered, race = [], trial._race

    def seen(problem, effort):
        if effort is trial.BEGIN:
            entered.append((problem.model.angle_input, problem.model.values["mgl"] > 4))
        return race(problem, effort)

    monkeypatch.setattr(trial, "_race", seen)
    best = trial.raced(fit, fit.model + mi.effects.gravity, ({"mgl": 1.0},))
    assert entered == [(True, False), (False, True), (True, True)]
    assert best is not None
    assert best.problem.model.values["mgl"] == pytest.approx(8, rel=0.05)


def test_what_the_slopes_of_a_lost_fit_do_not_promise_is_found(rng):
    """Those of a motor that hardly moves say nothing of a weight."""
    t = np.arange(1500) * 4e-3
    arm = (mi.dc_motor(R=2.0, L=1e-3, K=0.02, b=1e-5, J=1e-4) + mi.effects.gravity).replace(mgl=0.03)
    run = noisy(simulated(t, 2 * np.sin(np.pi * t**2 / t[-1]), ["theta"], arm), rng)
    fit = mi.fit(mi.dc_motor(), run)
    assert trial.lost(fit)
    found = mi.diagnose(fit, effects=("coulomb", "quadratic_drag", "gravity", "brush_drop"))
    assert found.effects == ("gravity",)
    v = found.after.values  # of an angle alone, the weight as a voltage
    assert v["R"] * v["mgl"] / v["K"] == pytest.approx(2.0 * 0.03 / 0.02, rel=0.05)


def test_a_current_alone_that_is_lost_asks_for_one_guess_more():
    """Where no model comes near it (a driver's ripple), every start of every effect would go its way twice."""
    run = _run(mi.dc_motor(**TRUE))
    noise = np.random.default_rng(1).standard_normal(run.n)
    rippled = run.with_(outputs={**run.outputs, "i": run.outputs["i"] + 2 * np.std(run.outputs["i"]) * noise})
    fit, starts = mi.fit(mi.dc_motor(), rippled), [{"tau_c": 1e-3}, {"tau_c": 2e-3}]
    assert fit.nrmse["i"] > trial.LOST > fit.nrmse["omega"]
    assert not trial.lost(fit)
    larger = fit.model + mi.effects.coulomb
    assert len(trial._own_starts(fit, larger, starts)) == 1
    alone = mi.fit(mi.dc_motor(), rippled.without("omega"))
    assert trial.lost(alone)  # nothing else tells
    assert len(trial._own_starts(alone, larger, starts)) == 2
    assert trial._own_starts(mi.fit(mi.dc_motor(), run), larger, starts) == []


def test_a_refit_ends_where_a_step_tells_no_two_models_apart_and_is_led_on_where_it_is_chosen(monkeypatch, rng):
    """What a residual is worth tells: a thousand white samples a hundred times as much as ten."""
    fit = mi.fit(mi.dc_motor(), _run(mi.dc_motor(**TRUE), n=1500))
    n = fit.problem.n_outputs

    def tolerances(residual):
        used, solution = [], SimpleNamespace(residual=residual, status="converged", q=fit.q)

        def descended(problem, effort, **_):
            used.append(effort.ftol)
            return Estimate(fit.problem, solution, ())

        monkeypatch.setattr(trial, "by_continuation", descended)
        trial._converged(fit.problem, trial.POLISH)
        return used

    assert tolerances(np.sin(np.arange(n) / 300)) == [trial.POLISH.ftol]
    assert tolerances(rng.standard_normal(n)) == [trial.POLISH.ftol, pytest.approx(trial.TOLD / n, rel=0.3)]
    monkeypatch.undo()
    off = fit.problem.begun_at(fit.q + 0.01)
    before = replace(fit, problem=off, q=off.start, residuals=off.residual(off.start))
    after = trial.led_on(before)
    assert after is not None
    assert after.cost == pytest.approx(fit.cost, rel=1e-6)
    assert trial.led_on(replace(fit, residuals=0.5 * fit.residuals)) is None  # what is no lower is no better


def test_a_winding_hotter_than_any_stands_is_refused():
    t = np.arange(3000) * 1e-2
    v = np.where(t % 6 < 4, 12.0, 6.0)
    model = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-3, J=1e-4) + mi.effects.winding_heating(R_th=4.0, C_th=1.0)
    shown = mi.simulate(model, mi.Experiment(t, {"v": v}, {"i": v, "omega": v}), initial="rest")[0].outputs
    fit = mi.fit(model, mi.Experiment(t, {"v": v}, dict(shown)), start="model")
    assert not objections(fit, LIBRARY["winding_heating"])
    hot = mi.fit(model.replace(alpha=3e-4), mi.Experiment(t, {"v": v}, dict(shown)))
    assert max(s.states["dT"].max() for s in hot.simulations) > 300
    assert "K warmer, which none stands" in objections(hot, LIBRARY["winding_heating"])


@pytest.mark.parametrize(("alpha_m", "why"), [(0.002, ""), (3e-4, "the magnets would be")])
def test_magnets_hotter_than_any_are_refused(alpha_m, why):
    t = np.arange(3000) * 1e-2
    v = np.where(t % 6 < 4, 12.0, 6.0)
    model = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-3, J=1e-4) + mi.effects.magnet_heating(R_thm=4.0, C_thm=1.0)
    shown = mi.simulate(model, mi.Experiment(t, {"v": v}, {"i": v, "omega": v}), initial="rest")[0].outputs
    fit = mi.fit(model.replace(alpha_m=alpha_m), mi.Experiment(t, {"v": v}, dict(shown)))
    assert objections(fit, LIBRARY["magnet_heating"]).startswith(why)
    assert bool(objections(fit, LIBRARY["magnet_heating"])) == bool(why)


def test_a_winding_that_would_melt_is_no_step_of_a_ladder(rng):
    t = np.arange(1500) * 2e-3
    v = np.repeat(rng.uniform(-6, 6, 15), 100)
    motor = mi.dc_motor(R=2.0, L=2e-3, K=0.05, b=4e-5, J=3e-5) + mi.effects.coulomb(tau_c=5e-3)
    blank = mi.Experiment(t, {"v": v}, {"i": 0 * t, "omega": 0 * t})
    shown = mi.simulate(motor, blank, initial="rest")[0].outputs
    run = blank.with_(outputs={c: y + 1e-3 * np.abs(y).max() * rng.standard_normal(len(t)) for c, y in shown.items()})
    heating = LIBRARY["winding_heating"]
    climb = search.Search(mi.fit(mi.dc_motor(), run), None, [heating], search.Stages(1))
    warm = mi.fit(motor + mi.effects.winding_heating(R_th=4.0, C_th=1.0), run, start="model")
    node, tried = climb._judge(climb.root, [heating], warm)
    assert node is not None
    assert tried.fit is warm
    hot = replace(warm)
    vars(hot)["simulations"] = tuple(replace(s, states={**s.states, "dT": np.full(s.experiment.n, 7.7e52)})
                                     for s in warm.simulations)
    assert objections(hot, heating) == "the winding would be over 1060 K warmer, which none stands"
    node, tried = climb._judge(climb.root, [heating], hot)
    assert (node, tried.fit) == (None, None)
    assert "over 1060 K" in tried.reason


def test_a_parameter_of_every_run_keeps_within_what_is_physical():
    warm = mi.effects.winding_warm_start
    assert (warm.parameters[0].lower, warm.parameters[0].upper) == (-200, 200)
    t, rng = np.arange(600) * 5e-3, np.random.default_rng(0)
    supply = mi.dc_motor(R=1.2, L=2e-3, K=0.05, b=1e-5, J=3e-5)
    runs = []
    for k, share in enumerate((1.0, 0.05)):
        v = 6 * np.sign(np.sin(2 * np.pi * (0.4 + 0.2 * k) * t))
        shown = mi.simulate(supply, mi.Experiment(t, {"v": share * v}, {"i": v, "omega": v}), initial="rest")[0].outputs
        noisy_ = {"i": shown["i"] + 0.01 * rng.standard_normal(600), "omega": shown["omega"] + rng.standard_normal(600)}
        runs.append(mi.Experiment(t, {"v": v}, noisy_, name=f"run{k}"))
    fit = mi.fit(mi.dc_motor() + mi.effects.supply_per_run, runs)
    assert "g_v runs to -0.9, the limit of what is physical" in objections(fit, mi.effects.supply_per_run)


def test_a_cogging_that_no_current_of_the_motor_overcomes_is_refused():
    model = mi.dc_motor(**TRUE) + mi.effects.cogging(A=2e-3, N=7.0, phi=0.3)
    fit = mi.fit(model.fix("R", "L"), _run(model), start="model")
    made = fit.values["K"] * max(np.abs(s.states["i"]).max() for s in fit.simulations)
    assert fit.values["A"] < made
    assert not objections(fit, LIBRARY["cogging"])
    absurd = replace(fit, values={**fit.values, "A": 2.5 * made})
    assert "A is 2.5 times the largest torque of the motor" in objections(absurd, LIBRARY["cogging"])
    free = mi.fit(mi.torque_driven(g=1e-3) + mi.effects.cogging(A=1e-3, N=7.0), _run(model).without("i"), start="model")
    assert "times the largest torque" in objections(replace(free, values={**free.values, "A": 1.0}), LIBRARY["cogging"])


def test_what_the_ladder_left_again_is_not_called_accepted():
    first = Candidate("supply_sag", 0.9, accepted=True, reason="lowers the held-out error")
    last, none = frozenset({"pwm_coast", "coulomb"}), frozenset()
    left = stepwise._as_it_ended(first, last, last, none)
    assert not left.accepted
    assert "a model without it predicts better" in left.reason
    pair = replace(first, effect="pwm_coast + coulomb")
    assert stepwise._as_it_ended(pair, last, last, none).accepted
    replaced = stepwise._as_it_ended(first, last, last | {"supply_sag"}, none)
    assert replaced.accepted, "its rung is there, whatever came in its place"
    later = stepwise._as_it_ended(replace(first, effect="coulomb", accepted=False), last, last, none)
    assert later.reason == "added in a later step"


def test_the_second_best_race_is_finished_however_far_it_is_behind(monkeypatch):
    """The next round grows two models; what gains nothing, and all others far behind, stay given up."""
    problem, costs = SimpleNamespace(scaling=SimpleNamespace(slope=lambda q: 1.0)), (1.0, 2.5, 3.0, 99.9)
    fit = SimpleNamespace(cost=100.0, residuals=None, jacobian=1.0, q=None, problem=problem)
    monkeypatch.setattr(trial, "_undamped", lambda r, jac: fit.cost)  # it is at its optimum
    tasks = [SimpleNamespace(fit=fit) for _ in costs]
    races = {k: SimpleNamespace(cost=c, reach=c) for k, c in enumerate(costs)}
    given_up = trial._outdone(tasks, races, {0: None})
    assert {k: g.why for k, g in given_up.items()} == {2: trial.LESS, 3: trial.NOTHING}
    assert set(trial._outdone(tasks[:1] + tasks[3:], {0: races[0], 1: races[3]}, {})) == {1}


def test_what_was_found_on_whole_records_is_kept_where_it_explains_windows_of_them_better(monkeypatch):
    model = (mi.dc_motor() + mi.effects.coulomb).replace(**TRUE, tau_c=0.01)
    runs = [_run(model, seed) for seed in (0, 1)]
    plain, climb, most = mi.fit(mi.dc_motor(), runs[0]), stepwise.climb, []

    def next_climb(search, max_effects, seconds=None, early=False):
        return climb(search, most.pop(), seconds, early)

    def window():
        return mi.diagnose(plain, runs[1], effects=["coulomb"]).best.window

    monkeypatch.setattr(stepwise, "_in_windows", lambda found: mi.fit(mi.dc_motor(), runs[0], window=0.1))
    monkeypatch.setattr(stepwise, "climb", next_climb)
    most += [0, 3]  # the second climb finds nothing
    assert window() is None
    most += [3, 3]  # it finds the same: windows carry no error far
    assert window() == pytest.approx(0.1, rel=0.05)
    monkeypatch.setattr(stepwise, "follows", lambda fit: False)
    most += [0, 3]  # a model that lost the whole records explains nothing
    assert window() == pytest.approx(0.1, rel=0.05)


def test_a_bridge_that_opens_is_found_beside_a_motor_that_no_first_current_leads_astray():
    """The plain motor was kicked at its start by megavolts; of a real one refits from there ended above it, and
    backlash was named."""
    t = np.arange(900) * 0.03
    true = mi.dc_motor(R=1.0, L=1e-2, K=0.5, b=0.02, J=0.35) + mi.effects.pwm_coast(s_c=0.8, V_s=10.9)
    whole = simulated(t, np.repeat([6.5, 9.0, 7.5, 10.9, 6.5, 8.2], 150), ("omega",), true)
    noise = 0.05 * np.random.default_rng(1).normal(size=900)
    run = whole.with_(outputs={"omega": whole.outputs["omega"] + noise}).select(slice(100, 900))
    plain = mi.fit(mi.dc_motor(), run)
    assert abs(plain.values["R"] * plain.simulations[0].states["i"][0]) < 2 * 10.9  # V; it was 4e8
    done = trial.refit(plain, plain.model + mi.effects.pwm_coast, [{"V_s": 10.9, "s_c": 3.5}])
    assert max(done.misfit.values()) < 1.1
    found = mi.diagnose(plain, effects=["pwm_coast", "backlash", "coulomb", "eddy_brake", "supply_sag"])
    assert (found.effects, found.remaining.adequate) == (("pwm_coast",), True)


def test_what_stopped_far_from_the_noise_goes_on_as_a_whole_fit(monkeypatch):
    """Rebounds in a gear's play stopped the few steps of a refit at eight times the noise."""
    runs = mi.read_runs(data_path("hidden_friction") / "run*.csv")
    tried = search.Search(mi.fit(mi.dc_motor(), runs), None, search.library(("coulomb",)), search.Stages())
    problem = tried.root.fit.problem.with_(model=tried.root.fit.model + mi.effects.coulomb, noise_factors={})
    begun = solve(problem.start_at({"tau_c": 1e-4, "R": 5.0, "J": 1e-3}), LevenbergMarquardt(max_iterations=1, looks=0),
                  start="model")
    node = node_of(begun, tried.held, "coulomb", tried.root)
    assert begun.status != "converged"
    monkeypatch.setattr(search, "led_on", lambda fit: None)
    found = tried.brought_to_its_end(node).fit
    assert max(found.misfit.values()) < 1.5 < max(begun.misfit.values()) / 2, found.misfit


def test_an_average_takes_the_place_of_a_filter_of_two_numbers_once_all_is_found(rng):
    """The filter did better while a wrong scale of the current was missing, and stayed at twice the noise."""
    t = np.arange(1200) * 2e-3
    hidden = mi.dc_motor(**VALUES) + mi.effects.speed_average(T_a=0.026) + mi.effects.current_gain(k_i=0.15)
    runs = [noisy(simulated(t, a * np.sign(np.sin(w * t + 0.1)) * (1 + 0.5 * (t > 1.2)), model=hidden), rng)
            for a, w in ((6, 14), (4, 9), (5, 11))]
    fit = mi.fit(mi.dc_motor(R=VALUES["R"]).fix(R=VALUES["R"]), runs[:2])
    names = ("speed_average", "current_gain")
    found = mi.diagnose(fit, runs[2:], effects=("speed_filter", "speed_lag", *names))
    assert set(found.effects) == set(names)
    assert found.after.values["T_a"] == pytest.approx(0.026, rel=0.01)


@pytest.mark.parametrize("earlier", [True, False])
@pytest.mark.parametrize("every", [1, 2])
def test_a_voltage_acts_no_more_than_a_sample_earlier(monkeypatch, earlier, every):
    """A row may hold a command and what that led to; a housing that swings was "4.7 ms earlier" at 2 ms, a ramp of the
    driver "5.4 ms earlier" at 3, of which the diagnosis looked at every second sample."""
    runs = [SimpleNamespace(t=0.002 * every * np.arange(9), meta={"every": every})]
    fit = SimpleNamespace(problem=SimpleNamespace(experiments=runs))
    monkeypatch.setattr(parts, "_fall", lambda fit, reading: -100 * reading.delay)
    assert [r.delay for r in parts._best_delay(fit, earlier)] == [-0.002]


def test_a_voltage_that_acts_earlier_and_then_later_is_one_delay(lab, monkeypatch):
    """Of the same records "11.8 ms earlier" and "5.75 ms later" was said; with a third between them all stay."""
    rng = np.random.default_rng(3)
    run = record(driven(lab, {}, "steps", 800, 1e-3, rng), "logger", ("i", "omega"), lab, rng, "steps")
    fit = mi.fit(mi.dc_motor(), run)
    as_it_was = stepwise.Records(fit, None)
    once = as_it_was.read(parts.delay_of(-0.012))
    monkeypatch.setattr(stepwise, "_late_reading", lambda path: parts.delay_of(0.005))
    twice = once.read(parts.delay_of(0.001))
    back = as_it_was.read(parts.delay_of(-0.005))
    for records, remarks in ((once, ["7 ms earlier"]), (twice, ["12 ms earlier", "1 ms later", "5 ms later"]),
                             (back, ["5 ms earlier", "5 ms later"])):
        found = stepwise.Climb(None, (node_of(records.fit, held.HeldOut.of(fit, None)),), (), (), "", None, None)
        climbed = Mock(return_value=found)
        stepwise._read_late(found, records, as_it_was, climbed, lambda at, *given: at(*given))
        told = climbed.call_args.args[0].remarks
        assert len(told) == len(remarks)
        assert all(said in remark for said, remark in zip(remarks, told, strict=True))


def test_what_leads_and_is_refused_gives_its_values_to_a_simpler_one_that_lost_the_race(monkeypatch):
    """Bristles as stiff as they may be are a breakaway without any, which a poor start had left behind."""
    rng, t, runs = np.random.default_rng(0), np.arange(600) * 2e-3, []
    motor = mi.dc_motor(R=2.2, L=1.4e-3, K=0.3, b=5e-3, J=2e-3) + mi.effects.stribeck(tau_c=0.1, tau_s=0.18, omega_s=3)
    for _ in range(2):
        still = mi.Experiment(t, {"v": np.repeat(rng.uniform(-10, 10, 20), 30)}, {"i": 0 * t, "omega": 0 * t})
        shown = mi.simulate(motor, still, initial="rest")[0].outputs
        runs.append(still.with_(outputs={"i": shown["i"] + 0.01 * rng.normal(size=600),
                                         "omega": shown["omega"] + 0.1 * rng.normal(size=600)}))
    asked = []

    def lost_at_first(tasks, map_):
        others = tasks[1:] if not asked else tasks
        asked.extend(tasks)
        return [trial.GivenUp(trial.LESS)] * (len(tasks) - len(others)) + trial.refits(others, map_)

    monkeypatch.setattr(search, "refits", lost_at_first)
    monkeypatch.setattr(search, "_in_doubt", lambda *_: False)
    effects = search.library(("stribeck", "lugre"))
    tried = search.Search(mi.fit(mi.dc_motor(), runs), None, effects, search.Stages())
    children, _ = tried.expand(tried.root)
    assert [task.name for task in asked][::2] == ["stribeck", "stribeck"]
    refused = next(c for c in children if c.added == "lugre")
    assert "theta_s runs to its limit" in refused.objection
    assert asked[-1].starts[0]["tau_c"] == refused.fit.values["tau_c"]
    found = next(c for c in children if c.added == "stribeck")
    assert not found.objection
    assert found.fit.values["tau_s"] == pytest.approx(0.18, rel=0.03)


@pytest.mark.parametrize(("window", "effects"), [(0.12, ("speed_average",)), (0.0, ())])
def test_an_average_is_found_with_the_speed_alone_though_the_winding_took_it_up(window, effects):
    """Its refit was left after a few steps, L/R being 40 ms still, and a lag beside an elastic shaft were named."""
    rng, t, runs = np.random.default_rng(1), 4e-3 * np.arange(2500), []
    motor = mi.dc_motor(R=0.87, L=4.4e-4, K=0.0168, b=6.8e-6, J=1.73e-5)
    for _ in range(3):
        v = np.repeat(rng.uniform(-9, 9, 25), 100) * (t > 0.02)
        mean = np.convolve(v, np.ones(n := round(window / 4e-3) or 1) / n)[: len(v)]
        clean = mi.simulate(motor, mi.Experiment(t, {"v": mean}, {"omega": 0 * t}), initial="rest")[0]
        noise = 3 * rng.standard_normal(len(t))
        runs.append(mi.Experiment(t, {"v": v}, {"omega": clean.outputs["omega"] + noise}))
    found = mi.diagnose(mi.fit(mi.dc_motor(), runs[:2]), runs[2])
    assert found.effects == effects
    assert found.after.misfit["omega"] < 1.1

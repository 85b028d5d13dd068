"""Constraints: steady parts found in the data, penalties with exact derivatives, words refused."""

from __future__ import annotations

import numpy as np
import pytest

import motorid as mi
from motorid.errors import ModelError, UsageError
from motorid.estimation.shooting.outcome import violations
from motorid.problem.constraints import Constraint, CurrentLimit, SteadyState
from motorid.problem.problem import as_problem


def runs_of(name: str) -> list[mi.Experiment]:
    return mi.read_runs(sorted(str(p) for p in mi.data_path(name).glob("*.csv") if not p.name.startswith("check")))


@pytest.fixture(scope="module")
def noisy() -> list[mi.Experiment]:
    return runs_of("two_step_noisy")


def problem_of(runs, model=None, weights="noise"):
    truth = {"R": 1.38, "L": 1.72e-3, "K": 0.0462, "b": 6.5e-5, "J": 2.35e-5}
    return as_problem((model or mi.dc_motor()).replace(**truth), runs, weights=weights)


def evaluated(relation, problem, q):
    trajs = [problem.simulate(q, k) for k in range(len(problem.runs))]
    return relation.evaluate(problem, q, trajs)


@pytest.mark.parametrize("relation", [
    SteadyState(), CurrentLimit(2.0), Constraint(lambda m: m.K * m.omega + m.R, upper=3.0),
    Constraint(lambda m: m.K * m.R, lower=0.1, size=0.05)])
@pytest.mark.parametrize("effects", [(), ("coulomb", "current_offset", "speed_gain"), ("winding_heating", "speed_lag")])
def test_derivatives_of_penalties_are_exact(noisy, relation, effects):
    model = mi.dc_motor()
    for name in effects:
        model = model + mi.effects.get(name)
    if "coulomb" in effects:
        model = model.replace(sgn_width=20.0)  # so that differences see the same smooth function
    problem = problem_of(noisy, model)
    q = problem.start + 0.01
    r, jac = evaluated(relation, problem, q)
    step = 1e-6
    differences = np.column_stack([(evaluated(relation, problem, q + step * e)[0]
                                    - evaluated(relation, problem, q - step * e)[0]) / (2 * step)
                                   for e in np.eye(len(q))])
    assert np.abs(r).max() > 0  # it has something to say here
    assert np.abs(jac - differences).max() <= 1e-5 * max(np.abs(differences).max(), 1.0)


def test_what_a_run_has_for_itself_counts_in_relations(noisy):
    """The second run's supply gave a sixth more than was recorded."""
    runs = [noisy[0], noisy[1].with_(inputs={"v": noisy[1].inputs["v"] / 1.15})]
    plain, penalty = (mi.fit(mi.dc_motor() + mi.effects.supply_per_run, runs, **asked) for asked in (
        {}, {"formulation": "penalty", "constraints": [SteadyState()]}))
    for fit in (plain, penalty):
        assert fit.per_run["g_v"][runs[1].name]["value"] == pytest.approx(0.15, abs=0.01)
        assert violations(fit.problem, fit.q, [SteadyState()])["SteadyState(), V"] < 0.05
    assert penalty.nrmse["omega"] == pytest.approx(plain.nrmse["omega"], rel=0.05)


def test_named_steady_parts_are_those_of_the_record_whatever_it_is_cut_into(noisy):
    end = noisy[1].t[-1]
    for window in (None, end / 2, end / 4):
        fit = mi.fit(mi.dc_motor(), noisy, formulation="penalty", window=window,
                     constraints=[SteadyState(at=[(1, 0.8 * end, 0.95 * end)])])
        found = fit.problem.penalties[0].segments(fit.problem)
        assert {fit.problem.experiments[s.run].name.split("[")[0] for s in found} == {noisy[1].name}
        assert [s.v for s in found] == pytest.approx([8.0] * len(found), rel=0.01)


def test_steady_parts_are_found_where_nothing_moves_any_more(noisy):
    found = SteadyState().segments(problem_of(noisy))
    assert [s.run for s in found] == [0, 1]
    for s, v in zip(found, (6.0, 8.0), strict=True):
        assert s.begin > 0.15  # ten mechanical time constants after the step
        assert s.v == pytest.approx(v, rel=0.01)
        assert s.moving
        assert s.v == pytest.approx(1.38 * s.means["i"] + 0.0462 * s.means["omega"], rel=2e-3)
        assert "run" in str(s)


def test_no_steady_part_in_a_sweep_is_said(rng):
    t = np.arange(0, 1, 1e-3)
    v = 6 * np.sin(2 * np.pi * (1 + 10 * t) * t)
    run = mi.Experiment(t, {"v": v}, {"omega": 20 * v + rng.normal(0, 0.1, len(t))}, hold="linear")
    with pytest.warns(UserWarning, match="no steady part"):
        assert SteadyState().parts(problem_of([run])) == ()


@pytest.mark.parametrize("channel", ["omega", "theta"])
@pytest.mark.parametrize(("samples", "kept"), [(83, 0), (250, 4)])
def test_where_noise_hides_that_the_drive_still_accelerates_is_no_steady_part(channel, samples, kept):
    """83 ms into a step a motor of 24 ms puts as much into its inertia as into its friction; 250 ms into it nothing."""
    rng, t = np.random.default_rng(1), np.arange(1000) * 1e-3
    model = mi.dc_motor(R=1.2, L=1e-3, K=0.05, b=2e-5, J=5e-5)
    plan = mi.planned(model, t, rng.uniform(-6, 6, 13)[np.arange(1000) // samples], channels=["i", channel])
    noise = {"i": 0.02, channel: {"omega": 0.3, "theta": 1e-3}[channel]}
    run = plan.with_(outputs={c: y + s * rng.normal(size=1000) for (c, y), s in zip(
        plan.outputs.items(), noise.values(), strict=True)}, sigma=noise)
    found, exact = SteadyState().segments(as_problem(model, run)), as_problem(model, plan)
    assert len(found) == kept
    for s in found:
        omega = exact.simulate(exact.start, 0).x[s.first:s.last + 1, 1]
        assert 5e-5 * abs(omega[-1] - omega[0]) / (s.end - s.begin) < 0.1 * 2e-5 * abs(s.means["omega"])


@pytest.mark.parametrize("case", ["held until late", "speed missing at first", "from the start", "without any noise"])
def test_what_came_to_its_speed_at_last_is_steady(case):
    """The way there begins where the motor last set off, not with the voltage; where it was never far there is none."""
    rng, t = np.random.default_rng(1), np.arange(2000) * 2e-3
    model = mi.dc_motor(R=1.0, L=1e-3, K=0.05, b=3e-5, J=5e-5)
    moved = np.maximum(t - 1.5 * (case == "held until late"), 0)
    moved = moved if case in ("held until late", "speed missing at first") else np.inf
    omega = 118.0 * (1 - np.exp(-moved / 0.02)) + 0 * t
    i = 6.0 - 0.05 * omega
    shown = {"i": i, "omega": omega}
    if case != "without any noise":
        shown = {c: y + s * rng.normal(size=2000) for (c, y), s in zip(shown.items(), (0.01, 0.2), strict=True)}
    if case == "speed missing at first":
        shown["omega"][:700] = np.nan
    run = mi.Experiment(t, {"v": np.full(2000, 6.0)}, shown, sigma={"i": 0.01, "omega": 0.2})
    (found,) = SteadyState().segments(as_problem(model, run))
    assert found.begin == pytest.approx(2.0 if case == "held until late" else 1.0, abs=0.01)
    assert found.means["omega"] == pytest.approx(118.0, abs=0.1)


def test_the_relation_at_the_steady_state_is_that_of_the_textbook(noisy):
    problem = problem_of(noisy)
    r, _ = evaluated(SteadyState(), problem, problem.start)
    s = SteadyState().segments(problem)[0]
    part = SteadyState().parts(problem)[0]
    voltage = (s.v - 1.38 * s.means["i"] - 0.0462 * s.means["omega"]) / s.v
    torque = (0.0462 * s.means["i"] - 6.5e-5 * s.means["omega"]) / (0.0462 * s.means["i"])
    assert r[:2] == pytest.approx(part.weight * [voltage, torque], rel=1e-8)


def test_friction_enters_the_steady_state_with_the_effect():
    runs = runs_of("hidden_friction")
    found = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    rows = [np.abs(part.rows(found.problem.simulate(found.q, part.run).x[part.samples],
                             *_p(found))[0]) for part in SteadyState().parts(found.problem)]
    assert max(np.max(r) for r in rows) < 0.01
    bare = found.values["tau_c"]
    torque = found.values["K"] * SteadyState().segments(found.problem)[0].means["i"]
    assert bare > 0.3 * torque  # without it the same rows would be far off


def _p(fit):
    return fit.problem.unknowns.point(fit.q).p, None, None


def test_sensor_effects_are_undone_before_the_balances(noisy):
    shifted = [r.with_(outputs={**r.outputs, "i": r.outputs["i"] + 0.05}) for r in noisy]
    model = mi.dc_motor() + mi.effects.current_offset(i_0=0.05)
    plain, _ = evaluated(SteadyState(), problem_of(noisy), problem_of(noisy).start)
    problem = problem_of(shifted, model)
    moved, _ = evaluated(SteadyState(), problem, problem.start)
    # The torque row is relative to K·i as measured, which the offset changes.
    assert np.abs(moved).max() < 1.5 * np.abs(plain).max()


def test_at_standstill_only_the_voltage_balance_counts():
    t = np.arange(0, 1, 1e-3)
    i = np.where(t < 0.1, 0.0, 2.0 * (1 - np.exp(-(t - 0.1) / 1e-3)))
    locked = mi.Experiment(t, {"v": np.where(t < 0.1, 0.0, 2.76)}, {"i": i, "omega": np.zeros_like(t)},
                           sigma={"i": 1e-3, "omega": 1e-3})
    labels = [x for part in SteadyState().parts(problem_of([locked])) for x in part.labels]
    assert labels
    assert all("voltage" in x for x in labels)


def test_penalty_formulation_lowers_the_steady_residual(noisy):
    problem = problem_of(noisy)
    worst = {}
    for name, weight in (("light", 0.0), ("heavy", 30.0)):
        found = mi.fit(mi.dc_motor(), noisy, formulation="penalty", constraints=[SteadyState(weight=weight)])
        r, _ = evaluated(SteadyState(), problem, problem.scaling.scaled([found.values[n] for n in "RLKbJ"]))
        worst[name] = np.abs(r).max()
    assert worst["heavy"] < 0.8 * worst["light"]


def test_penalty_on_the_current_pulls_the_peak_down(noisy):
    peaks = []
    for weight in (0.0, 10.0, 1000.0):
        found = mi.fit(mi.dc_motor(), noisy, formulation="penalty", constraints=[CurrentLimit(4.0, weight=weight)])
        peaks.append(max(np.abs(s.states["i"]).max() for s in found.simulations))
    assert peaks[0] > 4.8
    assert peaks[0] > peaks[1] > peaks[2]
    assert peaks[2] < 4.01


@pytest.mark.parametrize(("make", "word"), [
    (lambda: CurrentLimit(-1.0), "positive"), (lambda: CurrentLimit(float("nan")), "positive"),
    (lambda: CurrentLimit(1.0, weight=-1), "weight"), (lambda: SteadyState(tolerance=-0.1), "tolerance"),
    (lambda: Constraint(lambda m: m.R), "finite"), (lambda: Constraint(lambda m: m.R, lower=2, upper=1), "lower"),
    (lambda: Constraint(lambda m: m.R, lower=0, size=0.0), "size")])
def test_senseless_constraints_are_refused(make, word):
    with pytest.raises(UsageError, match=word):
        make()


def test_constraints_that_do_not_go_with_the_model_say_why(noisy):
    drive = as_problem(mi.torque_driven(), [r.without("i") for r in noisy])
    with pytest.raises(UsageError, match="no current"):
        CurrentLimit(2.0).parts(drive)
    with pytest.raises(ModelError, match="known are"):
        Constraint(lambda m: m.tau_x, lower=0).parts(problem_of(noisy))
    with pytest.raises(UsageError, match="no run 7"):
        SteadyState(at=[(7, 0.0, 1.0)]).segments(problem_of(noisy))
    with pytest.raises(UsageError, match="no samples"):
        SteadyState(at=[(0, 50.0, 51.0)]).segments(problem_of(noisy))

"""Multiple shooting: agrees with least squares, keeps constraints, comes from anywhere, shows what is missing."""

from __future__ import annotations

import os
import warnings

import numpy as np
import pytest

import motorid as mi
from motorid.errors import FitError, UsageError
from motorid.estimation.shooting.multiple_shooting import MultipleShooting
from motorid.estimation.shooting.nlp import Mesh, ShootingNlp, nodes_from_data, nodes_from_simulation
from motorid.estimation.shooting.outcome import steady_residual
from motorid.problem.constraints import Constraint, CurrentLimit, SteadyState
from motorid.records.datasets import truth

SHIPPED = ("two_step_noisy", "two_step_small")
STARTS = int(os.environ.get("MOTORID_TEST_STARTS", "12"))  # per motor; the full count is in the benchmark


def runs_of(name: str) -> list[mi.Experiment]:
    return mi.read_runs(sorted(str(p) for p in mi.data_path(name).glob("*.csv") if not p.name.startswith("check")))


@pytest.fixture(scope="module")
def plain() -> dict[str, mi.Fit]:
    tight = mi.LevenbergMarquardt(ftol=1e-14)
    return {n: mi.fit(mi.dc_motor(), runs_of(n), solver=tight) for n in SHIPPED}


def apart(a: mi.Fit, b: mi.Fit) -> float:
    return max(abs(a.values[n] / b.values[n] - 1) for n in a.model.free_names)


def peak(fit: mi.Fit) -> float:
    return max(float(np.abs(s.states["i"]).max()) for s in fit.simulations)


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("constraints", [[], [CurrentLimit(50.0), SteadyState(0.1)]])
def test_inactive_constraints_change_nothing(plain, name, constraints):
    hard = mi.fit(mi.dc_motor(), runs_of(name), solver=MultipleShooting(), constraints=constraints)
    assert hard.status == "converged"
    assert apart(hard, plain[name]) < 1e-6
    assert hard.extra["largest_gap"] < 1e-8
    for m in hard.extra.get("multipliers", ()):
        assert not m.active
        assert "would be the same" in m.text


@pytest.mark.parametrize(("name", "limit"), [("two_step_noisy", 4.0), ("two_step_noisy", 2.5), ("two_step_small", 0.4)])
def test_current_limit_holds_at_every_sample(plain, name, limit):
    assert peak(plain[name]) > 1.1 * limit
    steady = SteadyState()
    hard = mi.fit(mi.dc_motor(), runs_of(name), solver=MultipleShooting(), constraints=[CurrentLimit(limit), steady])
    assert hard.status == "converged"
    assert peak(hard) <= limit + 1e-6
    bound = max(part.upper.max() for part in steady.parts(hard.problem))
    assert steady_residual(hard.problem, hard.q) <= bound + 1e-6
    assert max(hard.extra["violations"].values()) < 1e-6


def test_multiplier_is_the_slope_of_the_cost():
    runs, costs = runs_of("two_step_noisy"), []
    for limit in (3.99, 4.0, 4.01):
        found = mi.fit(mi.dc_motor(), runs, solver=MultipleShooting(), constraints=[CurrentLimit(limit)])
        costs.append(found.cost)
        if limit == 4.0:
            (multiplier,), rows = found.extra["multipliers"], found.extra["active"]
    assert multiplier.value == pytest.approx((costs[0] - costs[2]) / 0.02, rel=0.02)
    assert multiplier.unit == "A"
    assert sum(row.value for row in rows) == pytest.approx(multiplier.value)
    assert all("t = " in row.label for row in rows)
    assert "1 A would lower the cost by" in multiplier.text


def test_standard_deviations_respect_active_constraints(plain):
    free = plain["two_step_noisy"]
    product = free.values["K"] * free.values["R"]
    tied = Constraint(lambda m: m.K * m.R, lower=1.02 * product, size=product, title="K R")
    hard = mi.fit(mi.dc_motor(), runs_of("two_step_noisy"), solver=MultipleShooting(), constraints=[tied])
    assert hard.values["K"] * hard.values["R"] == pytest.approx(1.02 * product, rel=1e-6)
    c, names = hard.covariance, [p.name for p in hard.problem.unknown]
    slope = np.zeros(len(names))
    slope[names.index("K")], slope[names.index("R")] = hard.values["R"], hard.values["K"]
    assert slope @ c @ slope < 1e-10 * (slope**2 @ np.diag(c))  # no uncertainty across an active constraint
    assert hard.std["J"] > 0


def test_derivatives_of_the_nonlinear_program():
    import casadi as ca

    fit = mi.fit(mi.dc_motor(), runs_of("two_step_noisy"))
    problem = fit.problem.with_(constraints=(CurrentLimit(3.0), SteadyState()), priors={"R": (1.3, 0.1)},
                                penalties=(CurrentLimit(2.0),))
    mesh = Mesh(problem, 100)
    z = mesh.joined(fit.q + 0.1, nodes_from_simulation(mesh, fit.q))
    nlp = ShootingNlp(mesh, z)
    gradient = nlp.gradient(z)[1]
    jac = np.asarray(ca.DM(nlp.jac_pattern, nlp.jacobian(z)[1]))
    step = 1e-6
    for j in [*range(mesh.nq), mesh.nq, len(z) - 1]:
        d = step * np.eye(len(z))[j]
        (f1, g1), (f2, g2) = nlp.values(z + d), nlp.values(z - d)
        assert (f1 - f2) / (2 * step) == pytest.approx(gradient[j], rel=1e-4, abs=1e-4 * np.abs(gradient).max())
        assert np.abs((g1 - g2) / (2 * step) - jac[:, j]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_poor_starts_end_in_the_same_place(plain, name, rng):
    true, wrong = truth(name)["parameters"], []
    for _ in range(STARTS):
        start = {n: v * 10 ** rng.uniform(-1, 1) for n, v in true.items()}
        found = mi.fit(mi.dc_motor().replace(**start), runs_of(name), solver=MultipleShooting(), start="model")
        # Sub-steps chosen elsewhere move an inductance that is known to 27 % by a thousandth.
        off = max(abs(found.values[n] - plain[name].values[n]) / plain[name].std[n] for n in true)
        if found.status != "converged" or off > 0.02:
            wrong.append((start, found.status, off))
    assert len(wrong) <= 0.01 * STARTS, wrong


@pytest.mark.parametrize(("constraints", "names"), [
    ([CurrentLimit(0.1), SteadyState()], ["CurrentLimit(0.1 A)", "SteadyState()"]),
    ([CurrentLimit(0.1)], ["CurrentLimit(0.1 A)", "0.2335 A"]),
    ([Constraint(lambda m: m.K, lower=0.06, size=0.05, title="K high"), CurrentLimit(20.0),
      Constraint(lambda m: m.K, upper=0.04, size=0.05, title="K low")], ["K high", "K low"])])
def test_contradictions_are_named(constraints, names):
    with pytest.raises(FitError) as said:
        mi.fit(mi.dc_motor(), runs_of("two_step_noisy"), solver=MultipleShooting(), constraints=constraints)
    assert all(n in str(said.value) for n in names)
    assert "CurrentLimit(20 A)" not in str(said.value)  # which has no part in it


def test_limits_of_parameters_can_be_in_conflict():
    model = mi.dc_motor().replace(K=0.09).bounded(K=(0.08, 0.1))
    with pytest.raises(FitError, match=r"limits of the parameters .* best compromise: SteadyState\(\), V: 5\."):
        mi.fit(model, runs_of("two_step_noisy"), solver=MultipleShooting(), constraints=[SteadyState()])


def test_gaps_show_when_a_torque_is_missing(rng):
    """A push that the model does not know appears in the gaps of the speed, at its time and with its size."""
    t, h = np.arange(0, 2, 1e-3), 1e-3
    v = np.where(t < 0.05, 0.0, 6.0)
    push = np.where((t > 1.2) & (t < 1.3), -5e-3, 0.0)
    i, omega = np.zeros_like(t), np.zeros_like(t)
    x = np.zeros(2)
    for k in range(1, len(t)):
        for _ in range(20):
            x = x + h / 20 * np.array([(v[k - 1] - 1.38 * x[0] - 0.0462 * x[1]) / 1.72e-3,
                                       (0.0462 * x[0] - 6.5e-5 * x[1] + push[k - 1]) / 2.35e-5])
        i[k], omega[k] = x
    measured = {"i": i + rng.normal(0, 0.01, len(t)), "omega": omega + rng.normal(0, 0.2, len(t))}
    run = mi.Experiment(t, {"v": v}, measured, sigma={"i": 0.01, "omega": 0.2})
    # Intervals short beside the mechanical time constant of 15 ms, so that a gap is torque times time over inertia.
    found = mi.fit(mi.dc_motor(), run, solver=MultipleShooting(every=5, process_noise={"omega": 30.0}))
    gaps = found.extra["gaps"]
    torque = found.values["J"] * gaps.values[:, gaps.states.index("omega")] / gaps.span
    pushed = (gaps.t > 1.215) & (gaps.t < 1.295)
    calm = (gaps.t < 1.15) | (gaps.t > 1.4)
    assert torque[pushed].mean() == pytest.approx(-5e-3, rel=0.2)
    assert np.sqrt(np.mean(torque[calm] ** 2)) < 0.2 * 5e-3  # what the noise of the speed alone makes of a gap


def test_nodes_from_data_carry_states_that_are_not_measured():
    runs = [r.without("omega") for r in runs_of("two_step_noisy")]
    fit = mi.fit(mi.dc_motor(K=0.0462).fix("K"), runs)
    mesh = Mesh(fit.problem)
    near = nodes_from_data(mesh, fit.q)[:, 1]
    assert np.abs(near - nodes_from_simulation(mesh, fit.q)[:, 1]).max() < 0.02 * np.abs(near).max()


def test_missing_samples_stay_missing():
    runs = []
    for r in runs_of("two_step_noisy"):
        i = r.outputs["i"].copy()
        i[300:400], i[7::11] = np.nan, np.nan
        runs.append(r.with_(outputs={**r.outputs, "i": i}))
    hard = mi.fit(mi.dc_motor(), runs, solver=MultipleShooting())
    assert apart(hard, mi.fit(mi.dc_motor(), runs, solver=mi.LevenbergMarquardt(ftol=1e-14))) < 1e-6


@pytest.mark.parametrize(("make", "word"), [
    (lambda: MultipleShooting(warm="cold"), "warm start"), (lambda: MultipleShooting(every=1), "at least 2"),
    (lambda: MultipleShooting(process_noise="much"), "process noise")])
def test_senseless_options_are_refused(make, word):
    with pytest.raises(UsageError, match=word):
        make()


def test_unknown_states_and_foreign_constraints_are_refused():
    runs = runs_of("two_step_noisy")
    with pytest.raises(UsageError, match="state"):
        mi.fit(mi.dc_motor(), runs, solver=MultipleShooting(process_noise={"torque": 1.0}))
    with pytest.raises(UsageError, match="penalties and constraints are like"):
        mi.fit(mi.dc_motor(), runs, solver=MultipleShooting(), constraints=["i < 3"])


# -- EMPS: drifts in open loop, published inverse-model values -----------------------------------------------
PUBLISHED = {"J": 95.1089, "b": 203.5034, "tau_c": 20.3935}


@pytest.mark.slow
@pytest.mark.parametrize("asymmetric", [False, True])
def test_emps_with_process_noise_agrees_with_the_inverse_model(real, asymmetric):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        (run,) = mi.read_runs(str(real / "emps" / "run.csv"))
    names = ("coulomb_asymmetric", "viscous_asymmetric") if asymmetric else ("coulomb", "constant_load")
    model = mi.torque_driven("linear", g=35.15065)
    for n in names:
        model = model + mi.effects.get(n)
    v = mi.fit(model, run, solver=MultipleShooting(process_noise="auto")).values
    assert v["J"] == pytest.approx(PUBLISHED["J"], rel=0.01)
    if asymmetric:
        assert 0.1 * (v["b"] + v["b_a"]) + v["tau_cp"] == pytest.approx(0.1 * 166.706 + 20.144, rel=0.03)
        assert 0.1 * (v["b"] - v["b_a"]) + v["tau_cn"] == pytest.approx(0.1 * 240.424 + 20.628, rel=0.03)
    else:
        assert 0.1 * v["b"] + v["tau_c"] == pytest.approx(0.1 * PUBLISHED["b"] + PUBLISHED["tau_c"], rel=0.03)

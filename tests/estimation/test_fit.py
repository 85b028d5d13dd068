"""Fits: from records to values with their uncertainty; data missing, bad, bounded or unwilling."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
import pytest
from lab_records import NOISE, VALUES, drive, noisy, pair, simulated

import motorid as mi
from motorid.effects import LIBRARY
from motorid.errors import FitError, SimulationError, UsageError
from motorid.estimation import least_squares
from motorid.estimation.continuation import by_continuation
from motorid.estimation.fit import no_worse_than_smaller
from motorid.exporters.json_file import remarks
from motorid.integrate import Rosenbrock
from motorid.integrate.rosenbrock import Stepper
from motorid.problem import problem as problem_module
from motorid.records.datasets import truth
from motorid.records.experiment import windows

NAMES = tuple(VALUES)


@pytest.fixture
def runs(rng):
    return pair(rng)


def off(fit, truth=VALUES):
    """Distance from the truth in standard deviations, per parameter."""
    distances = {}
    for n, v in truth.items():
        std = fit.std[n]
        assert std is not None, n
        distances[n] = abs(fit.values[n] - v) / std
    return distances


# -- numbers -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["two_step_noisy", "two_step_small"])
def test_shipped_noisy_steps_give_the_motor_within_its_uncertainty(name):
    fit = mi.fit(mi.dc_motor(), mi.read_runs(sorted(mi.data_path(name).glob("*.csv"))))
    assert fit.status == "converged"
    assert max(off(fit, truth(name)["parameters"]).values()) < 4
    assert fit.chi2 / fit.dof == pytest.approx(1.0, abs=0.15)
    assert fit.integration_error < 0.1


@pytest.mark.parametrize("name", ["b", "L"])
def test_a_start_where_a_parameter_has_no_say_is_no_minimum(runs, name):
    """On a logarithmic scale nothing leads back from nothing, until it is put where it matters."""
    nothing = 1e-6 * VALUES[name]
    for weights in ("noise", "rms"):
        best = mi.fit(mi.dc_motor(), runs, weights=weights)
        fit = mi.fit(mi.dc_motor(**{**best.values, name: nothing}), runs, start="model", weights=weights)
        assert fit.cost == pytest.approx(best.cost, rel=1e-5 if weights == "noise" else 1e-4)
        assert fit.values == pytest.approx(best.values, rel=1e-2)
        assert weights == "rms" or max(off(fit).values()) < 4


def test_the_numbers_of_a_plain_fit_hang_together(runs):
    fit = mi.fit(mi.dc_motor(), runs)
    assert fit.chi2 == pytest.approx(2 * fit.cost, rel=1e-9)
    assert fit.cost == pytest.approx(fit.history[-1], rel=1e-12)
    assert list(fit.history) == sorted(fit.history, reverse=True)
    assert fit.iterations == len(fit.history) - 1
    assert fit.dof == 2 * 2 * 500 - 5
    assert fit.residuals == pytest.approx(fit.problem.residual(fit.q), abs=1e-9)
    slope = fit.problem.scaling.slope(fit.q)
    assert fit.jacobian * slope == pytest.approx(fit.problem.jacobian(fit.q), rel=1e-3, abs=1e-3)
    assert fit.values == pytest.approx(fit.problem.values(fit.q))
    assert fit.model.values["R"] == fit.values["R"]
    v = fit.values
    assert fit.tau_e == pytest.approx(v["L"] / v["R"])
    assert fit.tau_m == pytest.approx(v["R"] * v["J"] / (v["K"] ** 2 + v["R"] * v["b"]))
    poles = np.linalg.eigvals([[-v["R"] / v["L"], -v["K"] / v["L"]], [v["K"] / v["J"], -v["b"] / v["J"]]])
    assert fit.damping == pytest.approx(-poles.real.sum() / 2 / np.sqrt(np.prod(poles).real))
    assert 0 < fit.seconds < 60


def test_nrmse_is_rmse_over_the_rms_of_what_was_measured_where_it_was(runs, rng):
    y = np.array(runs[0].outputs["i"])
    y[100:300] = np.nan
    runs = [runs[0].with_(outputs={**runs[0].outputs, "i": y}), runs[1].without("omega")]
    fit = mi.fit(mi.dc_motor(), runs)
    sims = [mi.simulate(fit.model, r)[0] for r in runs]
    for c, which in (("i", (0, 1)), ("omega", (0,))):
        e = np.concatenate([runs[k].outputs[c] - sims[k].outputs[c] for k in which])
        y = np.concatenate([runs[k].outputs[c] for k in which])
        ok = np.isfinite(e)
        assert fit.rmse[c] == pytest.approx(np.sqrt(np.mean(e[ok] ** 2)), rel=1e-3)
        assert fit.nrmse[c] == pytest.approx(np.sqrt(np.mean(e[ok] ** 2) / np.mean(y[ok] ** 2)), rel=1e-3)
    assert [set(b) for b in fit.evaluation.by_run] == [{"i", "omega"}, {"i"}]
    assert fit.evaluation.total == pytest.approx(np.sqrt(np.mean([x**2 for x in fit.nrmse.values()])))


def test_nrmse_of_an_angle_does_not_depend_on_where_its_zero_is(rng):
    """Nor in windows, which begin where the motor then is: theirs is the travel since the record began."""
    (run, _) = pair(rng, 600, channels=("omega", "theta"))
    away = run.with_(outputs={**run.outputs, "theta": run.outputs["theta"] - 1170})
    other = mi.dc_motor(**VALUES | {"b": 1e-4})
    whole, there = (dict(mi.evaluate(other, r).nrmse) for r in (run, away))
    assert there == pytest.approx(whole, rel=0.02)
    parts, there = (mi.evaluate(other, windows(r, 0.2)).by_run for r in (run, away))
    assert [e["theta"] for e in there] == pytest.approx([e["theta"] for e in parts], rel=0.05)


def test_nrmse_and_uncertainty_do_not_depend_on_the_units_of_the_file(runs, tmp_path):
    run = runs[0]
    columns = {"t": run.t, "v": run.inputs["v"], "i": run.outputs["i"], "w": run.outputs["omega"]}
    rpm = 60 / (2 * np.pi)
    files = {
        "si": ("t_s,voltage_V,current_A,speed_rad/s", (1, 1, 1, 1)),
        "shop": ("t_ms,voltage_mV,current_mA,speed_rpm", (1e3, 1e3, 1e3, rpm)),
    }
    fits = {}
    for name, (header, factors) in files.items():
        rows = np.column_stack([x * f for x, f in zip(columns.values(), factors, strict=True)])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=header, comments="", fmt="%.17g")
        fits[name] = mi.fit(mi.dc_motor(), mi.read_runs([tmp_path / f"{name}.csv"]))
    a, b = fits.values()
    assert a.values == pytest.approx(b.values, rel=1e-6)
    assert a.std == pytest.approx(b.std, rel=1e-5)
    assert a.nrmse == pytest.approx(b.nrmse, rel=1e-6)
    assert a.covariance == pytest.approx(b.covariance, rel=1e-5)


@pytest.mark.slow
def test_the_standard_deviation_is_the_scatter_of_repeated_experiments(rng):
    t = np.arange(300) * 1e-3
    clean = simulated(t, drive(t, 6.0))
    fits = [
        mi.fit(mi.dc_motor(), noisy(clean, rng).with_(sigma={"i": 0.02, "omega": 0.4})) for _ in range(150)
    ]
    assert all(f.status == "converged" for f in fits)
    for n, v in VALUES.items():
        found = np.array([f.values[n] for f in fits])
        said = np.array([f.std[n] for f in fits], float)
        assert np.std(found) == pytest.approx(
            np.mean(said), rel=0.25
        )  # 150 repeats: 6 % on one standard deviation
        assert abs(np.mean(found) - v) < 4 * np.std(found) / np.sqrt(150)
        inside = np.mean(np.abs(found - v) < 1.96 * said)
        assert 0.88 <= inside <= 0.995


def test_a_model_that_misses_the_noise_is_less_certain_by_that_much(runs):
    stated = [r.with_(sigma={"i": 0.002, "omega": 0.04}) for r in runs]  # ten times too small
    fit, over = mi.fit(mi.dc_motor(), runs), mi.fit(mi.dc_motor(), stated)
    assert over.chi2 / over.dof == pytest.approx(100, rel=0.2)
    for n in NAMES:
        assert over.std[n] == pytest.approx(fit.std[n], rel=0.15)


# -- what is asked of the parameters -------------------------------------------------------------------------
def test_held_parameters_stay_and_have_no_uncertainty(runs):
    fit = mi.fit(mi.dc_motor().fix(R=1.5, L=2e-3), runs)
    assert (fit.values["R"], fit.values["L"]) == (1.5, 2e-3)
    assert (fit.std["R"], fit.std["L"]) == (0.0, 0.0)
    assert fit.chi2 > 1.3 * mi.fit(mi.dc_motor(), runs).chi2


def test_limits_are_kept_and_a_value_at_its_limit_has_no_uncertainty(runs):
    fit = mi.fit(mi.dc_motor(R=2.0).bounded(R=(1.6, 5.0)), runs)
    assert fit.values["R"] == pytest.approx(1.6, rel=1e-12)
    assert fit.std["R"] is None
    assert fit.status == "converged"
    card = " ".join(str(fit.card()).split())
    assert "R 1.6 Ω (at its limit)" in card
    assert "not determined" not in card
    (said,) = remarks(fit)
    assert said == "R ended at its limit, 1.6 Ω: these records show no sign of it, or ask for what lies beyond."
    held = mi.fit(mi.dc_motor().fix(R=1.6), runs)
    for n in ("L", "K", "b", "J"):
        assert fit.values[n] == pytest.approx(held.values[n], rel=1e-4)


def test_a_value_that_rounds_to_beyond_its_limit_stays_inside(runs):
    """The logarithms in which a fit moves do not give every number back."""
    for limit in np.linspace(0.02, 0.045, 40):
        assert mi.fit(mi.dc_motor(K=0.9 * limit).bounded(K=(1e-3, limit)), runs).model.parameters["K"].value <= limit


def test_a_channel_that_is_zero_in_one_run_weighs_no_more_than_its_noise(runs):
    """The speed of a motor that a small voltage does not move."""
    stuck = runs[0].with_(inputs={"v": np.full(runs[0].n, 0.1)}, outputs={"i": 0.07 + 0 * runs[0].t,
                                                                        "omega": 0 * runs[0].t})
    model = mi.dc_motor() + mi.effects.coulomb
    by_noise, by_rms = (mi.fit(model, [*runs, stuck], weights=w, window=None) for w in ("noise", "rms"))
    assert by_rms.values["K"] == pytest.approx(by_noise.values["K"], rel=0.02)


def test_a_prior_on_what_is_another_in_every_run_is_refused(runs):
    with pytest.raises(UsageError, match="'g_v' is another in every run"):
        mi.fit(mi.dc_motor() + mi.effects.supply_per_run, runs, priors={"g_v": (0.5, 0.1)})


def test_a_prior_pulls_as_its_width_says(runs):
    plain = mi.fit(mi.dc_motor(), runs)
    std = plain.std["R"]
    target = plain.values["R"] + 4 * std
    tight = mi.fit(mi.dc_motor(), runs, priors={"R": (target, 0.01 * std)})
    alike = mi.fit(mi.dc_motor(), runs, priors={"R": (target, std)})
    loose = mi.fit(mi.dc_motor(), runs, priors={"R": (target, 100 * std)})
    moved = [(f.values["R"] - plain.values["R"]) / (4 * std) for f in (tight, alike, loose)]
    assert moved == pytest.approx([1.0, 0.5, 0.0], abs=0.05)
    assert alike.std["R"] == pytest.approx(std / np.sqrt(2), rel=0.1)
    assert alike.chi2 < 2 * alike.cost  # the prior is part of the cost and not of chi2
    far = re.search(r"The records contradict the prior of R by (\S+) standard deviations", tight.verdict)
    assert far is not None
    assert float(far[1]) == pytest.approx(4, rel=0.05)
    assert not any("prior" in fit.verdict for fit in (plain, alike, loose))  # as wide: 2.8


def test_a_prior_supplies_what_the_record_cannot_tell(rng):
    runs = [r.without("i") for r in pair(rng)]
    blind = mi.fit(mi.dc_motor(), runs)
    assert blind.nrmse["omega"] < 0.01  # the speed is explained
    assert blind.std["R"] is None  # and R, K, b, J stay undetermined, said so
    assert blind.std["J"] is None
    told = mi.fit(mi.dc_motor(), runs, priors={"R": (1.38, 0.01), "K": (0.0462, 0.0003)})
    for n in ("R", "K", "J"):
        assert told.std[n] is not None
        assert told.values[n] == pytest.approx(VALUES[n], rel=0.1)


def test_outliers_hardly_move_a_robust_fit(runs, rng):
    spoilt = []
    for r in runs:
        out = {}
        for c, y in r.outputs.items():
            wild = rng.random(r.n) < 0.03
            out[c] = np.where(wild, y + 30 * NOISE[c] * rng.uniform(0.5, 2, r.n), y)
        spoilt.append(r.with_(outputs=out, sigma=NOISE))
    plain, robust = (mi.fit(mi.dc_motor(), spoilt, loss=loss) for loss in (None, mi.Huber()))
    clean = mi.fit(mi.dc_motor(), runs)
    shift = {
        f: max(abs(f.values[n] - clean.values[n]) / clean.std[n] for n in NAMES) for f in (plain, robust)
    }
    assert shift[plain] > 5
    assert shift[robust] < 1
    assert robust.chi2 > 2 * robust.cost  # chi2 counts outliers in full, the cost does not


# -- difficult records ---------------------------------------------------------------------------------------
def test_missing_samples_and_channels(rng):
    runs = pair(rng, channels=("i", "omega", "theta"))
    gaps = []
    for k, r in enumerate(runs):
        out = {c: np.where(rng.random(r.n) < 0.4, np.nan, y) for c, y in r.outputs.items()}
        gaps.append(r.with_(outputs=out).without("omega" if k else "theta"))
    fit = mi.fit(mi.dc_motor(), gaps)
    assert fit.status == "converged"
    assert max(off(fit).values()) < 4
    assert fit.chi2 / fit.dof == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("hold", ["zoh", "linear"])
def test_uneven_samples(rng, hold):
    t = np.cumsum(rng.uniform(0.2e-3, 2e-3, 900))
    v = drive(t, 6.0) if hold == "zoh" else 6 * np.sin(15 * t)
    fit = mi.fit(mi.dc_motor(), noisy(simulated(t, v, hold=hold), rng))
    assert fit.status == "converged"
    assert max(off(fit).values()) < 4
    assert fit.chi2 / fit.dof == pytest.approx(1, abs=0.15)


def test_the_hold_of_the_input_matters(rng):
    t = np.arange(400) * 2e-3
    linear = noisy(simulated(t, 6 * np.sin(40 * t), hold="linear"), rng, {"i": 2e-3, "omega": 0.04})
    right, wrong = mi.fit(mi.dc_motor(), linear), mi.fit(mi.dc_motor(), linear.with_(hold="zoh"))
    assert wrong.chi2 > 10 * right.chi2
    assert max(off(right).values()) < 4


@pytest.mark.parametrize("channels", [("i", "omega"), ("i", "omega", "theta"), ("i", "theta")])
def test_records_that_begin_in_motion(rng, channels):
    t = np.arange(1000) * 1e-3
    whole = simulated(t, drive(t, 8.0), channels)
    part = noisy(whole, rng).select(slice(450, None))
    fit = mi.fit(mi.dc_motor(), part)
    assert fit.status == "converged"
    assert max(off(fit).values()) < 4.5
    assert fit.chi2 / fit.dof == pytest.approx(1, abs=0.2)
    for c in channels:
        assert fit.initial[f"{c}_0[0]"] == pytest.approx(whole.outputs[c][450], abs=2 * NOISE[c])
    if "omega" not in channels:
        speed = simulated(t, drive(t, 8.0)).outputs["omega"][450]
        assert fit.initial["omega_0[0]"] == pytest.approx(speed, rel=0.02)


def test_one_sensor_is_enough_where_the_rest_is_known(rng):
    for channel in ("i", "omega", "theta"):
        runs = pair(rng, channels=(channel,))
        fit = mi.fit(mi.dc_motor().fix(R=1.38, K=0.0462), runs)
        assert fit.chi2 / fit.dof == pytest.approx(1, abs=0.2), channel
        assert fit.values["J"] == pytest.approx(VALUES["J"], rel=0.05)


def test_other_motors_by_orders_of_magnitude(rng):
    for scale in (1e-3, 1e3):  # a motor a thousand times weaker, one a thousand times stronger
        values = {
            "R": 1.38 / scale,
            "L": 1.72e-3 / scale,
            "K": 0.0462,
            "b": 6.5e-5 * scale,
            "J": 2.35e-5 * scale,
        }
        t = np.arange(500) * 1e-3
        run = noisy(
            simulated(t, drive(t, 6.0), model=mi.dc_motor(**values)), rng, {"i": 0.02 * scale, "omega": 0.4}
        )
        fit = mi.fit(mi.dc_motor(), run)
        assert max(off(fit, values).values()) < 4


# -- unwilling simulations -----------------------------------------------------------------------------------
@dataclass(frozen=True)
class Fragile(Rosenbrock):
    """Fails where friction exceeds a limit, and counts its refusals."""

    limit: float = np.inf
    refused: list = field(default_factory=list)

    def run(self, system, grid, x0, p, dx0=None, dp=None, local_error=False):
        if p[system.parameters.index("b")] > self.limit:
            self.refused.append(p)
            raise SimulationError("too much friction for this engine.")
        return super().run(system, grid, x0, p, dx0, dp, local_error)


def test_a_simulation_that_fails_on_the_way_shortens_the_step(runs):
    start = mi.dc_motor(**{**VALUES, "J": 2e-4})
    free = mi.fit(start, runs, start="model", solver=mi.LevenbergMarquardt(damping=1e-6))
    engine = Fragile(limit=2e-4)
    fit = mi.fit(start, runs, start="model", engine=engine, solver=mi.LevenbergMarquardt(damping=1e-6))
    assert engine.refused, "the descent must have met the region for this test to mean anything"
    assert fit.status == "converged"
    assert fit.values == pytest.approx(free.values, rel=1e-4)


def test_integration_errors_move_no_estimate_by_more_than_a_share_of_its_deviation(runs, monkeypatch):
    from motorid.estimation import fit as stages
    from motorid.problem import problem as accuracy

    def shift() -> float:
        """Against the estimate with eight times as many steps, over the deviations."""
        fit = mi.fit(mi.dc_motor(**VALUES), runs, start="model")
        finer = fit.problem.with_finer_steps(8)
        exact = least_squares.least_squares(finer, least_squares.FINISH, q=fit.q, refine=False)
        return max(abs(fit.values[n] - exact.values[n]) / s for n, s in fit.std.items() if s)

    limit = stages.BIAS
    monkeypatch.setattr(accuracy, "LOOSEST", 5e-3)
    monkeypatch.setattr(accuracy, "NOISE_SHARE", 1.0)
    monkeypatch.setattr(stages, "ERROR_SHARE", np.inf)
    assert shift() < limit
    monkeypatch.setattr(stages, "BIAS", np.inf)
    assert shift() > limit


@pytest.fixture
def steps(monkeypatch):
    """Lengths of all integrations, in sub-steps."""
    found, run = [], Stepper.run

    def counted(self, grid, *rest):
        found.append(int(grid.substeps.sum()))
        return run(self, grid, *rest)

    monkeypatch.setattr(Stepper, "run", counted)
    return found


def test_an_arm_without_its_weight_begins_with_a_motor_that_hardly_moves(rng, steps):
    t = np.arange(2000) * 4e-3
    arm = (mi.dc_motor(R=2.0, L=1e-3, K=0.02, b=1e-5, J=1e-4) + mi.effects.gravity).replace(mgl=0.03)
    run = simulated(t, 2 * np.sin(np.pi * t**2 / t[-1]), ["omega"], arm)
    fit = mi.fit(mi.dc_motor(), noisy(run, rng, {"omega": 0.1}))
    assert fit.nrmse["omega"] < 1.01  # as good as standing still
    assert sum(steps) < 2000 * run.n  # 5300 by way of one that rings


def test_a_current_that_is_not_the_motors_leads_to_no_motor_that_rings(rng, steps):
    t = np.arange(1000) * 1e-3
    v = np.where(t < 0.05, 0.0, 12 * np.sin(8 * np.pi * t**2))
    run = simulated(t, v)
    run = noisy(run.with_(outputs={**run.outputs, "i": run.outputs["i"] * v / 12}), rng)  # that of the supply
    fit = mi.fit(mi.dc_motor(), run)
    assert fit.nrmse["omega"] < 0.01
    assert sum(steps) < 4000 * run.n  # 115,000 by way of one that rings


def test_a_start_that_cannot_be_simulated_is_an_error_that_says_what_to_do(runs):
    with pytest.raises(FitError, match=r"cannot be simulated at the start.*model\.replace"):
        mi.fit(mi.dc_motor(**VALUES), runs, start="model", engine=Fragile(limit=1e-5))


def test_integration_errors_that_add_up_are_mended_by_finer_steps(runs, monkeypatch):
    from motorid.estimation import fit as fitting
    from motorid.problem import problem as accuracy

    monkeypatch.setattr(accuracy, "LOOSEST", 2e-2)
    monkeypatch.setattr(accuracy, "NOISE_SHARE", 1.0)
    coarse = mi.Problem(mi.dc_motor(**VALUES), tuple(runs))
    coarse = coarse.refined(coarse.start)
    assert mi.fit(mi.dc_motor(**VALUES), runs, start="model").integration_error < 0.2
    r = [p.residual(p.start) for p in (coarse, coarse.with_finer_steps(4))]
    assert np.abs(r[0] - r[1]).max() > 0.3  # what there was to mend
    monkeypatch.setattr(fitting, "MOST_FINER", 1)
    left = mi.fit(mi.dc_motor(**VALUES), runs, start="model").integration_error
    monkeypatch.setattr(fitting, "MOST_FINER", 2)  # too few for all of it are better than none
    assert mi.fit(mi.dc_motor(**VALUES), runs, start="model").integration_error < 0.5 * left


# -- afterwards ----------------------------------------------------------------------------------------------
def test_evaluate_judges_unseen_runs_and_estimates_no_parameter(runs, rng):
    fit = mi.fit(mi.dc_motor(), runs)
    t = np.arange(900) * 1e-3
    unseen = noisy(simulated(t, 5 * np.sin(25 * t)), rng)
    found = mi.evaluate(fit, unseen)
    level = {c: NOISE[c] / np.sqrt(np.mean(unseen.outputs[c] ** 2)) for c in ("i", "omega")}
    for c in level:
        assert found.nrmse[c] == pytest.approx(level[c], rel=0.1)
    wrong = mi.evaluate(fit.model.replace(K=0.06), unseen)
    assert wrong.nrmse["omega"] > 5 * found.nrmse["omega"]
    moving = mi.evaluate(fit, unseen.select(slice(400, None)))  # begins in motion: that is estimated
    assert moving.nrmse["omega"] == pytest.approx(
        NOISE["omega"] / np.sqrt(np.mean(unseen.outputs["omega"][400:] ** 2)), rel=0.15
    )
    again = mi.evaluate(fit, runs)
    assert again.nrmse == pytest.approx(fit.nrmse, rel=1e-3)


TURNING = {"A": 3e-3, "N": 9.0, "phi": 0.5}


@pytest.mark.parametrize(("effects", "hidden", "most"), [
    ((), {}, 1),
    (("coulomb",), {"tau_c": 4e-3}, 3),
    (("cogging",), TURNING, 3 + 1),  # the last once more: its sub-steps did not suit the end
    (("coulomb", "cogging"), {"tau_c": 4e-3, **TURNING}, 9 + 1),
])
def test_a_fit_takes_no_more_least_squares_runs_than_its_docstring_says(effects, hidden, most, rng, monkeypatch):
    model = mi.dc_motor()
    for name in effects:
        model = model + LIBRARY[name]
    t = np.arange(0, 3, 1e-3)
    truth = model.replace(R=2.0, L=1e-3, K=0.05, b=1e-5, J=2e-5, **hidden)
    records = []
    for v in (6 * np.sin(np.pi * t) + np.sign(np.sin(2.2 * np.pi * t)), 4 * np.sign(np.sin(1.6 * np.pi * t + 0.3))):
        blank = mi.Experiment(t, {"v": v}, {c: np.zeros(len(t)) for c in ("i", "omega", "theta")})
        clean = mi.simulate(truth, blank, initial="rest")[0].outputs
        noise = {c: 2e-3 * np.abs(y).max() * rng.standard_normal(len(t)) for c, y in clean.items()}
        records.append(blank.with_(outputs={c: clean[c] + noise[c] for c in clean}))
    solve, ends = least_squares.levenberg_marquardt, []

    def counted(*arguments):
        ends.append(solve(*arguments))
        return ends[-1]

    monkeypatch.setattr(least_squares, "levenberg_marquardt", counted)
    fit = mi.fit(model, records)
    assert {n: fit.values[n] for n in hidden} == pytest.approx(hidden, rel=0.1)
    assert len(ends) == most
    assert len(fit.history) <= sum(len(end.history) for end in ends)


@pytest.fixture
def side_valley(rng):
    """A problem, and an estimate of it that ended far from where even a smaller model leads."""
    hidden = mi.dc_motor(**VALUES) + mi.effects.quadratic_drag(c_2=3e-6) + mi.effects.voltage_offset(V_0=0.4)
    t = np.arange(500) * 1e-3
    record = noisy(simulated(t, drive(t, 6.0), model=hidden), rng)
    asked = mi.Problem(mi.dc_motor() + mi.effects.coulomb + mi.effects.speed_delay, [record])
    begin = asked.start_at({"R": 300.0, "J": 1.0})
    return asked, least_squares.least_squares(begin, mi.LevenbergMarquardt(max_iterations=1))


def test_a_model_that_misses_the_noise_fits_no_worse_than_without_one_of_its_effects(side_valley):
    """From a side valley it begins again where the smaller model ends."""
    asked, astray = side_valley
    mended = no_worse_than_smaller(astray, asked, least_squares.FINISH)
    smaller = [asked.for_model(asked.model.without(e.name)) for e in asked.model.effects]
    least = min(by_continuation(each, least_squares.FINISH).cost for each in smaller)
    assert mended.cost < 1.001 * least < 0.1 * astray.cost
    assert mended.problem.engine == asked.engine  # without the limit on the smaller model's steps


def test_a_smaller_model_is_given_up_where_it_takes_more_steps_than_the_record_is_worth(side_valley, monkeypatch):
    asked, astray = side_valley
    monkeypatch.setattr(problem_module, "SUBSTEPS", 0)
    monkeypatch.setattr(problem_module, "CHEAP", int(astray.problem.runs[0].grid.substeps.sum()))
    assert no_worse_than_smaller(astray, asked, least_squares.FINISH) is astray


def test_a_fit_can_go_on_from_a_fit(runs):
    first = mi.fit(mi.dc_motor(), runs)
    again = mi.fit(first.model, runs)
    assert again.values == pytest.approx(first.values, rel=1e-4)
    assert again.iterations <= first.iterations


def test_a_limit_on_iterations_is_said(runs):
    fit = mi.fit(
        mi.dc_motor(**{n: 3 * v for n, v in VALUES.items()}),
        runs,
        start="model",
        solver=mi.LevenbergMarquardt(max_iterations=2, looks=0),
    )
    assert fit.status == "limit"
    assert "2 iterations" in fit.message


def test_the_callback_sees_every_step(runs):
    seen = []
    fit = mi.fit(mi.dc_motor(), runs, callback=lambda k, cost, q: seen.append((k, cost, len(q))))
    assert len(seen) >= fit.iterations > 0
    assert seen[-1][1] == pytest.approx(fit.cost)
    assert {n for _, _, n in seen} == {5}


def test_values_given_by_the_user_are_a_start_and_nothing_more(runs):
    far = mi.fit(mi.dc_motor(R=5.0, J=1e-4), runs)
    assert far.values == pytest.approx(mi.fit(mi.dc_motor(), runs).values, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"start": "zero"}, UsageError, "unknown start 'zero'"),
        ({"formulation": "soft"}, UsageError, "unknown formulation.*MultipleShooting"),
        ({"engine": "euler"}, UsageError, "unknown engine"),
        ({"constraints": [object()]}, UsageError, "MultipleShooting"),
        ({"weights": "none"}, UsageError, "unknown weights"),
        ({"priors": {"Q": (0, 1)}}, UsageError, "prior: unknown parameter"),
    ],
)
def test_wrong_words_are_answered_with_the_right_ones(runs, options, error, words):
    with pytest.raises(error, match=words):
        mi.fit(mi.dc_motor(), runs, **options)


def test_nothing_free_is_nothing_to_fit(runs):
    with pytest.raises(UsageError, match=r"model\.free\(.*mi\.evaluate"):
        mi.fit(mi.dc_motor(**VALUES).fix(*NAMES), runs)
    assert mi.evaluate(mi.dc_motor(**VALUES).fix(*NAMES), runs).nrmse["omega"] < 0.01

"""Covariance, bootstrap and profile: honest for coloured noise, for limits, for what cannot be determined."""

import json

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

import motorid as mi
from motorid.errors import UsageError
from motorid.numerics.autoregression import Colour, colour_of, weighed
from motorid.records.datasets import truth
from motorid.uncertainty.bootstrap import bootstrap
from motorid.uncertainty.covariance import covariance
from motorid.uncertainty.profile import intervals, profile, profiles

MOTOR, NOISE = truth("two_step_noisy")["parameters"], {"i": 0.02, "omega": 0.4}


@pytest.fixture(scope="module")
def runs():
    return mi.read_runs(f"{mi.data_path('two_step_noisy')}/run*.csv")


@pytest.fixture(scope="module")
def fit(runs):
    return mi.fit(mi.dc_motor(), runs)


@pytest.fixture(scope="module")
def clean(runs):
    return mi.simulate(mi.dc_motor(**MOTOR), runs, initial="rest")


@pytest.fixture(scope="module")
def speed_only(runs):
    return mi.fit(mi.dc_motor(), [r.without("i") for r in runs])


def noise(rng, n, rho):
    """Unit variance; first-order with a correlation of rho between neighbours."""
    e = rng.standard_normal(n + 300)
    return lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], e)[300:]


def measured(clean, rng, rho):
    return [s.experiment.with_(outputs={c: y + NOISE[c] * noise(rng, len(y), rho) for c, y in s.outputs.items()})
            for s in clean]


def coverage(clean, rho, sets, method, level=0.95):
    """Share of data sets whose interval holds the truth, per parameter. `sets` are the seeds."""
    hits = dict.fromkeys(MOTOR, 0)
    for seed in sets:
        found = covariance(mi.fit(mi.dc_motor(), measured(clean, np.random.default_rng([7, seed]), rho)),
                           method=method)
        for name, value in MOTOR.items():
            low, high = found.interval(name, level)
            hits[name] += low <= value <= high
    return {n: h / len(sets) for n, h in hits.items()}


# The full study, 400 data sets each, by hand: 94.5-96.5 % (white) and 93.5-95.5 % (AR(1), 0.9).
@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.9], ids=["white", "coloured"])
def test_intervals_cover_the_truth(clean, rho):
    for name, share in coverage(clean, rho, range(100), "coloured").items():
        assert 0.885 <= share <= 1.0, (name, share)  # 95 % ± 3 standard deviations of 100 tosses


@pytest.mark.slow
def test_taking_coloured_noise_for_white_would_cover_far_too_little(clean):
    assert np.mean(list(coverage(clean, 0.9, range(30), "white").values())) < 0.7


@pytest.mark.slow
def test_block_bootstrap_covers_the_truth_under_coloured_noise(clean):
    hits = []
    for seed in range(20):
        fit = mi.fit(mi.dc_motor(), measured(clean, np.random.default_rng([7, seed]), 0.9))
        refits = bootstrap(fit, n=60, seed=seed, quiet=True)
        hits += [refits.interval(n)[0] <= v <= refits.interval(n)[1] for n, v in MOTOR.items()]
    assert np.mean(hits) >= 0.84  # 100 correlated tosses, 60 refits each


def test_covariance_does_not_depend_on_the_unit_of_the_record(runs, fit, tmp_path):
    paths = []
    for k, run in enumerate(runs):
        paths.append(tmp_path / f"run{k}.csv")
        table = np.column_stack([run.t * 1e3, run.inputs["v"], run.outputs["i"] * 1e3,
                                 run.outputs["omega"] * 60 / (2 * np.pi)])
        np.savetxt(paths[-1], table, delimiter=",", header="t_ms,voltage_V,current_mA,speed_rpm", comments="",
                   fmt="%.12g")
    other = covariance(mi.fit(mi.dc_motor(), mi.read_runs(paths)))
    for name, sd in covariance(fit).std.items():
        assert other.std[name] == pytest.approx(sd, rel=1e-3)


def test_covariance_does_not_depend_on_where_the_fit_started(runs, fit):
    other = mi.fit(mi.dc_motor(R=5.0, J=1e-4), runs)
    np.testing.assert_allclose(covariance(other).matrix, covariance(fit).matrix, rtol=0.02,
                               atol=1e-3 * np.abs(covariance(fit).matrix).min())


def test_covariance_of_white_noise_is_gauss_newtons(fit):
    for name, sd in covariance(fit, method="white").std.items():
        assert sd == pytest.approx(fit.std[name], rel=0.05)


def test_wrong_noise_level_does_not_change_the_covariance(runs, fit):
    # The variance is taken from the residuals, not from what the record says about its noise.
    louder = [r.with_(sigma={"i": 0.2, "omega": 4.0}) for r in runs]
    for name, sd in covariance(mi.fit(mi.dc_motor(), louder)).std.items():
        assert sd == pytest.approx(covariance(fit).std[name], rel=0.05)


def test_missing_samples_cost_as_much_as_they_carried(runs, fit, rng):
    holes = [r.with_(outputs={c: np.where(rng.random(r.n) < 0.5, np.nan, y) for c, y in r.outputs.items()})
             for r in runs]
    for name, sd in covariance(mi.fit(mi.dc_motor(), holes)).std.items():
        # L lives on the few samples after a step, so it matters which of them are lost.
        assert sd == pytest.approx(np.sqrt(2) * covariance(fit).std[name], rel=0.4 if name == "L" else 0.15)


def test_parameter_at_its_limit_has_no_standard_deviation(runs):
    # There is no dry friction in this motor; in these records the estimate ends at zero.
    found = covariance(mi.fit(mi.dc_motor() + mi.effects.coulomb, runs))
    assert [n for n, s in found.status.items() if s == "at its lower limit"] == ["tau_c"]
    assert found.std["tau_c"] is None
    assert found.interval("tau_c") is None
    assert found.to_dict()["std"]["tau_c"] is None
    assert found.std["R"] > 0
    assert "at its lower limit" in str(found)


def test_what_the_data_do_not_determine_is_said_and_not_a_small_number(speed_only):
    found = covariance(speed_only)
    assert set(found.status.values()) == {"not determined"}
    assert all(sd is None for sd in found.std.values())
    assert all(limits is None for limits in found.to_dict()["intervals"].values())
    refits = bootstrap(speed_only, n=4, quiet=True)
    for of in (lambda: refits.interval("R", 95), lambda: mi.intervals(speed_only, level=95)):
        with pytest.raises(UsageError, match="between 0 and 1"):
            of()
    assert refits.interval("R") is None
    assert refits.std["R"] is None
    assert "not determined" in str(refits)
    assert json.dumps(refits.to_dict())


def test_prior_enters_as_an_observation(runs):
    held = mi.fit(mi.dc_motor(), [r.without("i") for r in runs],
                  priors={"R": (MOTOR["R"], 0.05), "b": (MOTOR["b"], 1e-5)})
    found = covariance(held)
    assert found.std["R"] == pytest.approx(0.05, rel=0.05)
    assert found.status["K"] == "determined"


def test_intervals_widen_with_the_level_and_refuse_nonsense(fit):
    found = covariance(fit)
    narrow, wide = found.interval("R", 0.68), found.interval("R", 0.99)
    assert wide[0] < narrow[0] < fit.values["R"] < narrow[1] < wide[1]
    with pytest.raises(UsageError, match="between 0 and 1"):
        found.interval("R", 95)
    with pytest.raises(UsageError, match="Known: R, L, K, b, J"):
        found.interval("Q")
    with pytest.raises(UsageError, match="method"):
        covariance(fit, method="hac")


def test_interval_of_a_positive_parameter_stays_positive(runs):
    short = [r.select(slice(0, 90)) for r in runs]
    found = covariance(mi.fit(mi.dc_motor(), short))
    for n, status in found.status.items():
        if status == "determined":
            assert found.interval(n)[0] > 0


# -- colour ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rho", [0.0, 0.5, 0.95])
def test_colour_of_first_order_noise_is_recognised(rng, rho):
    colour = colour_of([noise(rng, 4000, rho), noise(rng, 4000, rho)])
    gamma = colour.autocovariance(20)
    np.testing.assert_allclose(gamma / gamma[0], rho ** np.arange(20), atol=0.08)
    assert colour.effective_share == pytest.approx((1 - rho) / (1 + rho), abs=0.12)


def test_colour_ignores_missing_samples(rng):
    r = noise(rng, 6000, 0.8)
    r[rng.random(6000) < 0.1] = np.nan
    assert colour_of([r]).variance == pytest.approx(1.0, abs=0.15)


def test_noise_drawn_from_a_colour_has_that_colour(rng):
    colour = Colour(np.array([1.2, -0.4]), 5.0, 5.0 * 0.168 / 1.4)
    again = colour_of([colour.draw(20000, rng)])
    np.testing.assert_allclose(again.autocovariance(10), colour.autocovariance(10) / colour.autocovariance(1)
                               * again.variance, rtol=0.25, atol=0.1 * again.variance)


def test_weighing_is_the_quadratic_form_of_the_toeplitz_matrix(rng):
    jac, gamma = rng.normal(size=(50, 3)), 0.7 ** np.arange(50)
    np.testing.assert_allclose(weighed(jac, gamma), jac.T @ toeplitz(gamma) @ jac, rtol=1e-10)


# -- bootstrap ---------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blocks", "parametric"])
def test_bootstrap_agrees_with_the_covariance(fit, kind):
    refits = bootstrap(fit, kind=kind, n=120, seed=3, quiet=True)
    for name, sd in covariance(fit).std.items():
        assert refits.std[name] == pytest.approx(sd, rel=0.25)


@pytest.mark.slow
def test_bootstrap_of_runs_sees_what_differs_from_run_to_run(clean):
    rng, records = np.random.default_rng(5), []
    for k in range(8):  # the supply's scale is off by 1 % from run to run
        run = measured(clean, rng, 0.0)[k % 2]
        records.append(run.with_(inputs={"v": run.inputs["v"] * (1 + 0.01 * rng.standard_normal())}))
    fit = mi.fit(mi.dc_motor(), records)
    assert bootstrap(fit, kind="runs", n=40, quiet=True).std["K"] > 3 * covariance(fit, method="white").std["K"]


def test_bootstrap_depends_on_its_seed_alone(fit):
    first, again, other = (bootstrap(fit, n=6, seed=s, quiet=True).samples for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_bootstrap_over_chunks_gives_the_same_samples(fit):
    def pool(function, tasks):  # not the built-in map, so that tasks are cut into chunks
        return [function(t) for t in tasks]

    np.testing.assert_array_equal(bootstrap(fit, n=70, seed=1, quiet=True, map=pool).samples[:6],
                                  bootstrap(fit, n=6, seed=1, quiet=True).samples)


def test_interrupted_bootstrap_keeps_what_is_done(fit):
    def stopped(function, tasks):
        for k, task in enumerate(tasks):
            if k == 5:
                raise KeyboardInterrupt
            yield function(task)

    refits = bootstrap(fit, n=5 * 64, map=stopped, quiet=True)
    assert len(refits.samples) == 25
    assert "Interrupted after 25 of 320" in str(refits)


def test_bootstrap_knows_that_a_prior_is_not_certain(speed_only):
    priors = {"R": (MOTOR["R"], 0.1), "L": (MOTOR["L"], 1e-4), "K": (MOTOR["K"], 2e-3)}
    held = mi.fit(mi.dc_motor(), speed_only.problem.experiments, priors=priors)
    found = bootstrap(held, n=60, quiet=True)
    for name in ("R", "K"):
        assert 0.6 < found.std[name] / held.std[name] < 1.5


def test_bootstrap_of_a_slower_sensor_agrees_with_the_covariance(runs):
    slower = [r.with_(outputs={**r.outputs, "omega": np.where(np.arange(r.n) % 10, np.nan, r.outputs["omega"])})
              for r in runs]
    fit = mi.fit(mi.dc_motor(), slower)
    found = bootstrap(fit, n=60, quiet=True)
    for name in ("K", "b", "J"):
        assert 0.75 < found.std[name] / fit.std[name] < 1.35


def test_bootstrap_keeps_white_noise_white_where_samples_are_missing_at_random(clean):
    rng = np.random.default_rng(3)
    holes = [r.with_(outputs={c: np.where(rng.random(r.n) < 0.4, np.nan, y) for c, y in r.outputs.items()})
             for r in measured(clean, rng, 0.0)]
    fit = mi.fit(mi.dc_motor(), holes)
    found = bootstrap(fit, n=100, quiet=True)
    assert np.mean([found.std[n] / fit.std[n] for n in MOTOR]) == pytest.approx(1.0, abs=0.1)


def per_run():
    """Three runs of a commanded axis whose supplies differ."""
    rng, t, axis = np.random.default_rng(4), np.arange(600) * 1e-3, mi.torque_driven(g=0.05, b=1e-4, J=5e-5)
    runs = []
    for k, gain in enumerate((1.0, 1.1, 0.9, 1.05)):
        v = np.repeat(rng.uniform(-1, 1, 12), 50)
        omega = mi.planned(axis, t, v * gain, channels=("omega",)).outputs["omega"]
        runs.append(mi.Experiment(t, {"v": v}, {"omega": omega + 0.3 * rng.normal(size=600)}, name=f"r{k}"))
    return axis, runs


def test_where_a_profile_fixes_what_all_runs_share_the_first_run_s_own_value_stands():
    axis, runs = per_run()
    fit = mi.fit(axis.fix("b", "J").free("g") + mi.effects.supply_per_run, runs)
    assert profile(fit, "g", quiet=True).interval() == pytest.approx(covariance(fit).interval("g"), rel=1e-3)


def test_bootstrap_says_what_it_cannot_do(fit):
    axis, runs = per_run()
    with pytest.raises(UsageError, match="parameters per run"):
        bootstrap(mi.fit(axis + mi.effects.supply_per_run, runs), kind="runs")
    with pytest.raises(UsageError, match="at least 4"):
        bootstrap(fit, kind="runs")
    with pytest.raises(UsageError, match="Did you mean 'blocks'"):
        bootstrap(fit, kind="block")
    with pytest.raises(UsageError, match="n must be at least 2; got 1"):
        bootstrap(fit, n=1)


# -- profile -----------------------------------------------------------------------------------------------
def test_profile_of_a_well_determined_parameter_is_the_covariances_interval(fit):
    found = covariance(fit)
    for name, p in profiles(fit, ["R", "J"], quiet=True).items():
        width = found.interval(name)[1] - found.interval(name)[0]
        np.testing.assert_allclose(p.interval(), found.interval(name), atol=0.05 * width)
        assert p.best > -0.1


def test_profile_allows_for_coloured_noise(clean):
    fit = mi.fit(mi.dc_motor(), measured(clean, np.random.default_rng(3), 0.9))
    width = np.ptp(covariance(fit).interval("R"))
    assert width > 2 * np.ptp(covariance(fit, method="white").interval("R"))
    assert np.ptp(profile(fit, "R", quiet=True).interval()) == pytest.approx(width, rel=0.1)


def test_profile_says_when_a_side_is_open(speed_only):
    # Friction and K trade off: K is largest where there is no friction at all, and nothing limits it below.
    k = profile(speed_only, "K", quiet=True)
    assert k.interval()[0] == 0
    assert np.isfinite(k.interval()[1])
    assert "no lower limit" in str(k)
    r = profile(speed_only, "R", quiet=True)
    assert r.interval() == (0, np.inf)
    assert "not limited on either side" in str(r)
    assert r.to_dict()["interval"] == [None, None]


def test_profile_follows_the_other_parameters(fit):
    p = profile(fit, "R", quiet=True)
    correlation = np.corrcoef(p.values, p.others["J"])[0, 1]
    assert correlation == pytest.approx(-1, abs=0.01)  # J falls as R is held higher


def test_profile_of_something_held_or_unknown_is_refused(runs, fit):
    with pytest.raises(UsageError, match="free parameter"):
        profile(fit, "Q")
    with pytest.raises(UsageError, match="free parameter"):
        profile(mi.fit(mi.dc_motor().fix(L=0), runs), "L")


def test_three_intervals_stand_side_by_side(fit):
    found = intervals(fit, n=30, quiet=True)
    table = found.to_dict()["parameters"]
    for name, entry in table.items():
        widths = [entry[k][1] - entry[k][0] for k in ("covariance", "bootstrap", "profile")]
        assert max(widths) < 1.8 * min(widths), name
    assert json.dumps(found.to_dict())
    assert all(word in str(found) for word in ("covariance", "bootstrap (blocks)", "profile"))


def test_channel_without_a_single_sample_is_as_good_as_absent(runs):
    empty = [r.with_(outputs={**r.outputs, "omega": np.full(r.n, np.nan)}) for r in runs]
    absent = covariance(mi.fit(mi.dc_motor(), [r.without("omega") for r in runs]))
    found = covariance(mi.fit(mi.dc_motor(), empty))
    assert dict(found.std) == {n: s and pytest.approx(s, rel=1e-6) for n, s in absent.std.items()}
    mixed = mi.fit(mi.dc_motor(), [empty[0], runs[1]])
    assert covariance(mixed).std["K"] > 0

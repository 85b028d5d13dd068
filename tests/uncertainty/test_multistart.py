"""Every start arrives; what does not is told; the answer does not depend on the pool."""

import json
import re
import subprocess
import sys
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

import motorid as mi
from motorid.errors import UsageError
from motorid.estimation.result import Failure
from motorid.numerics.least_squares import LevenbergMarquardt, levenberg_marquardt
from motorid.uncertainty.multistart import Multistart, StartResult, multistart

BOTH = ("two_step_noisy", "two_step_small")


def records(name):
    return mi.read_runs(f"{mi.data_path(name)}/run*.csv")


@pytest.fixture(scope="module")
def fits():
    return {name: mi.fit(mi.dc_motor(), records(name)) for name in BOTH}


# tests/benchmarks/bench_starts.py runs a thousand of each: all good, within 60 s.
@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
def test_every_start_within_a_factor_of_ten_arrives_without_a_guess(fits, name):
    found = multistart(fits[name], starts=150, spread=10.0, quiet=True)
    assert (found.good, found.poor, found.failed) == (150, 0, 0)
    for entry in found.statistics().values():
        assert entry["std"] < 1e-3 * entry["reference"]


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
def test_every_start_within_a_factor_of_hundred_arrives_with_the_guess(fits, name):
    assert multistart(fits[name], starts=40, spread=100.0, guess=True, quiet=True).good == 40


@pytest.mark.parametrize(("name", "factors"), [
    ("two_step_noisy", (0.26, 9.62, 2.84, 5.45, 0.13)),  # time constants swapped: speed right, current wrong
    ("two_step_small", (0.14, 7.36, 8.01, 0.94, 0.13)),  # hardly any resistance: inductance and inertia ring
    ("two_step_small", (0.12, 0.57, 5.42, 0.19, 0.10)),
    ("two_step_noisy", (0.58, 2.25, 0.26, 0.51, 1.22)),  # the inductance runs to zero on the way
    ("two_step_noisy", (0.53, 5.82, 0.26, 1.33, 3.59)),
])
def test_starts_that_led_astray_arrive(fits, name, factors):
    best = fits[name]
    start = {n: best.values[n] * f for n, f in zip(best.model.free_names, factors, strict=True)}
    found = mi.solve(best.problem.for_model(best.model.start_at(start)), start="model")
    for n, sd in best.std.items():
        assert found.values[n] == pytest.approx(best.values[n], abs=0.1 * sd)


def test_damping_keeps_parameters_without_influence_in_place():
    # The second unknown matters only once the first is right: the misfit must not throw it away before.
    def both(q):
        a, b = np.exp(q)
        x = np.linspace(0, 1, 30)
        r = 1e3 * (a - 1) + 1e-2 * np.exp(-5 * (a - 1) ** 2) * (np.exp(-b * x) - np.exp(-x)) * np.ones(30)
        da = 1e3 - 0.1 * (a - 1) * np.exp(-5 * (a - 1) ** 2) * (np.exp(-b * x) - np.exp(-x))
        db = -1e-2 * np.exp(-5 * (a - 1) ** 2) * x * np.exp(-b * x)
        return r, np.column_stack([a * da, b * db])

    start = np.log([8.0, 3.0])
    found = levenberg_marquardt(lambda q: both(q)[0], both, start, log=np.array([True, True]),
                                options=LevenbergMarquardt(ftol=1e-14))
    np.testing.assert_allclose(np.exp(found.q), [1.0, 1.0], rtol=1e-3)


def test_gauss_newton_is_the_undamped_case():
    x = np.linspace(0, 1, 20)
    jac = np.column_stack([np.ones(20), x])
    y = 2 + 3 * x
    found = levenberg_marquardt(lambda q: jac @ q - y, lambda q: (jac @ q - y, jac), np.zeros(2),
                                options=LevenbergMarquardt(damping=0.0, longest_step=100.0))
    np.testing.assert_allclose(found.q, [2, 3], rtol=1e-10)
    assert len(found.history) <= 3


def test_bounds_are_kept_and_said_by_the_values():
    x = np.linspace(0, 1, 20)
    jac = np.column_stack([np.ones(20), x])
    y = 2 - 3 * x
    found = levenberg_marquardt(lambda q: jac @ q - y, lambda q: (jac @ q - y, jac), np.ones(2),
                                (np.array([-np.inf, 0.0]), np.full(2, np.inf)))
    assert found.status == "converged"
    np.testing.assert_allclose(found.q, [0.5, 0.0], atol=1e-9)  # the mean of y


# -- the study's report -------------------------------------------------------------------------------------
def ending(reference, cost, **changes):
    values = {**reference.values, **changes}
    start = {n: reference.values[n] for n in reference.model.free_names}
    return StartResult(start, values, cost, dict(reference.nrmse), "converged", "", 5, 0.01)


@pytest.fixture
def mixed(fits):
    """Three good, two in one other place, one failure."""
    best = fits["two_step_noisy"]
    ends = [ending(best, best.cost)] * 3 + [ending(best, 8 * best.cost, L=1e-6)] * 2
    return Multistart(best, (*ends, Failure({"R": 1.0}, "failed", "left the finite numbers")), 10.0, False, 1.0)


def test_fits_are_told_apart_by_cost_and_by_place(mixed, fits):
    assert mixed.kinds == ("good",) * 3 + ("poor",) * 2 + ("failed",)
    best = fits["two_step_noisy"]
    elsewhere = ending(best, best.cost, R=best.values["R"] + best.std["R"])
    assert Multistart(best, (elsewhere,), 10.0, False, 1.0).kinds == ("poor",)


def test_places_where_fits_end_are_told(mixed):
    assert "3 of 6 starts" in str(mixed)
    assert "2 end elsewhere, 1 failed" in str(mixed)
    assert re.search(r"Elsewhere: 2 at .*\(8 times the squared error\)", str(mixed))


def test_better_place_than_the_reference_becomes_the_measure(fits):
    best = fits["two_step_noisy"]
    found = Multistart(best, (ending(best, best.cost), ending(best, 0.5 * best.cost, R=1.0)), 10.0, False, 1.0)
    assert found.kinds == ("poor", "good")
    assert "better fit" in str(found)


def test_dictionary_keeps_the_contract_and_is_json(mixed):
    found = mixed.to_dict()
    assert {"starts", "spread", "good", "poor", "failed", "seconds", "parameters", "nrmse"} <= set(found)
    assert (found["starts"], found["good"], found["poor"], found["failed"]) == (6, 3, 2, 1)
    assert set(found["parameters"]["R"]) == {"reference", "mean", "std"}
    assert json.loads(json.dumps(found))["nrmse"]["i"] > 0


def test_table_has_one_row_per_start_failures_included(mixed):
    table = mixed.table
    assert table["kind"].tolist() == ["good"] * 3 + ["poor"] * 2 + ["failed"]
    assert table["message"].iloc[-1] == "left the finite numbers"


# -- pools ---------------------------------------------------------------------------------------------------
def same(a, b):
    return [e.values for e in a.results] == [e.values for e in b.results]


@pytest.mark.slow
def test_process_pool_gives_the_same_answer(fits):
    best = fits["two_step_small"]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert same(multistart(best, starts=6, map=pool.map, quiet=True), multistart(best, starts=6, quiet=True))


OWN = """
import multiprocessing, numpy as np, motorid as mi
from concurrent.futures import ProcessPoolExecutor

@mi.effect(balance="torque")
def syrup(m, k_s=mi.P(1e-4, "N·m", null=0)):
    m.torque -= k_s * m.omega / (10.0 + m.omega**2) ** 0.5

if __name__ == "__main__":
    runs = mi.read_runs(str(mi.data_path("two_step_noisy")) + "/run*.csv")
    fit = mi.fit(mi.dc_motor() + syrup, runs)
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    far = mi.multistart(fit, starts=2, spread=1.2, map=pool.map)
    near = mi.multistart(fit, starts=2, spread=1.2)
    many = mi.fit_many(mi.dc_motor() + syrup, {"a": runs}, map=pool.map)
    pool.shutdown()
    for a, b in zip(far.results, near.results):  # to rounding: the one ran compiled, the other perhaps not yet
        np.testing.assert_allclose([*a.values.values()], [*b.values.values()], rtol=1e-6)
    assert many.failed == {}, many.failed
    assert abs(many.rows[0]["k_s"] / fit.values["k_s"] - 1) < 1e-3
    print("same")
"""


@pytest.mark.slow
def test_effect_written_in_a_notebook_travels_to_a_spawned_pool():
    # With -c the worker cannot import the module in which the law stands, just as from a notebook.
    done = subprocess.run([sys.executable, "-c", OWN], capture_output=True, text=True, timeout=200)
    assert done.stdout == "same\n", done.stderr[-2000:]


def test_interruption_keeps_what_is_done(fits):
    def stopped(function, tasks):
        for k, task in enumerate(tasks):
            if k == 3:
                raise KeyboardInterrupt
            yield function(task)

    found = multistart(fits["two_step_small"], starts=9, map=stopped, quiet=True)
    assert len(found.results) == 3
    assert "Interrupted after 3 of 9 starts" in str(found)
    assert same(found, multistart(fits["two_step_small"], starts=3, quiet=True))


def test_broken_pool_costs_time_and_not_results(fits, capsys):
    def broken(function, tasks):
        for k, task in enumerate(tasks):
            if k == 2:
                raise BrokenExecutor("a process in the pool was terminated abruptly")
            yield function(task)

    best = fits["two_step_small"]
    found = multistart(best, starts=5, map=broken, quiet=True)
    assert same(found, multistart(best, starts=5, quiet=True))
    assert "the pool failed" in capsys.readouterr().err


def test_starts_depend_on_the_seed_alone(fits):
    best = fits["two_step_small"]
    a, b, c = (multistart(best, starts=2, seed=s, quiet=True) for s in (4, 4, 5))
    assert [e.start for e in a.results] == [e.start for e in b.results] != [e.start for e in c.results]
    logs = np.log([list(e.start.values()) for e in a.results]) - np.log([best.values[n] for n in best.model.free_names])
    assert np.abs(logs).max() <= np.log(10)


def test_problem_is_solved_first(fits):
    found = multistart(fits["two_step_small"].problem, starts=1, spread=1.0, quiet=True)
    assert found.good == 1


def test_nonsense_is_refused(fits):
    best = fits["two_step_small"]
    with pytest.raises(UsageError, match="starts must be at least 1"):
        multistart(best, starts=0)
    with pytest.raises(UsageError, match="spread must be at least 1"):
        multistart(best, spread=0.5)


def test_it_says_where_the_other_starts_ended_with_units(fits):
    fit = fits["two_step_noisy"]

    def ended(cost, **changed):
        return StartResult(fit.values, {**fit.values, **changed}, fit.cost * cost, fit.nrmse, "converged", "", 3, 0.1)

    ends = (*[ended(1.0)] * 6, ended(9.0, b=1e-3), ended(9.0, b=1e-3), ended(2.0, R=5.0))
    found = Multistart(fit, ends, 10.0, False, 1.0)
    assert (found.good, found.poor) == (6, 3)
    assert found.elsewhere == ("2 at b = 0.001 N·m·s/rad (9 times the squared error); "
                               "1 at R = 5 Ω (2 times the squared error)")
    assert f"Elsewhere: {found.elsewhere}." in found.text
    assert Multistart(fit, (ended(1.0),), 10.0, False, 1.0).elsewhere == ""
    assert Multistart(fit, (ended(1.0, R=5.0),), 10.0, False, 1.0).elsewhere == "1 at R = 5 Ω (0 % more squared error)"
    title = mi.plot_waterfall(found)[0].get_title(loc="left").replace("\n", " ").replace("\N{NO-BREAK SPACE}", " ")
    assert title == f"6 of 9 agree; 3 elsewhere: {found.elsewhere}"

"""Plain, penalty and hard side by side; the penalty solution walks to the hard one."""

from __future__ import annotations

from itertools import pairwise

import pytest

import motorid as mi
from motorid.estimation.result import Failure
from motorid.estimation.shooting.formulations import compare_formulations
from motorid.problem.constraints import CurrentLimit, SteadyState


def runs_of(name: str) -> list[mi.Experiment]:
    return mi.read_runs(sorted(str(p) for p in mi.data_path(name).glob("*.csv") if not p.name.startswith("check")))


@pytest.fixture(scope="module")
def compared():
    fit = mi.fit(mi.dc_motor(), runs_of("two_step_noisy"))
    return compare_formulations(fit, [CurrentLimit(4.0), SteadyState()])


def test_hard_keeps_what_the_others_violate(compared):
    key = "CurrentLimit(4 A), A"
    assert compared.plain.violations[key] > compared.penalty.violations[key] > 0.1
    assert compared.hard.violations[key] < 1e-6
    assert compared.hard.fit.status == "converged"
    (limit,) = [m for m in compared.hard.multipliers if m.unit == "A"]
    assert limit.active
    assert limit.value > 0


def test_penalty_walks_to_the_hard_solution(compared):
    distances = [p.distance for p in compared.path]
    assert [p.weight for p in compared.path] == sorted(p.weight for p in compared.path)
    assert distances[0] > 0.1
    assert all(later <= earlier for earlier, later in pairwise(distances))
    assert distances[-1] < 1e-5


def test_table_shows_everything(compared):
    text = str(compared)
    for word in ("plain", "penalty", "hard", "R", "NRMSE current", "steady-state residual", "CurrentLimit(4 A)",
                 "multiplier", "iterations", "time", "would lower the cost"):
        assert word in text, word


def test_means_that_are_taken_as_exact_are_said():
    runs = runs_of("two_step_noisy")
    weighed, plain = (mi.fit(mi.dc_motor(), runs, penalties=p) for p in ([SteadyState()], [CurrentLimit(50.0)]))
    said = "every ± takes the measured means as exact"
    assert (said in str(weighed.card()), said in str(plain.card())) == (True, False)


def test_a_formulation_that_fails_is_a_value():
    compared = compare_formulations(mi.fit(mi.dc_motor(), runs_of("two_step_noisy")), [CurrentLimit(0.1)])
    assert isinstance(compared.hard.result, Failure)
    assert "CurrentLimit(0.1 A)" in compared.hard.result.message
    assert compared.path == ()
    assert "contradicts the records" in str(compared)


def test_without_constraints_the_steady_state_is_compared():
    compared = compare_formulations(mi.fit(mi.dc_motor(), runs_of("two_step_noisy")), weights=())
    assert compared.plain.steady_residual < 0.01
    assert list(compared.hard.violations) == ["SteadyState(), V", "SteadyState(), N·m"]

"""A race keeps the best of several starts, and a start that fails does not end it."""

from __future__ import annotations

import numpy as np
import pytest

import motorid as mi
from motorid.errors import FitError
from motorid.estimation.least_squares import FINISH, LOOK, RACE, least_squares, race
from motorid.problem.problem import Problem

TRUE = {"R": 2.0, "L": 1e-3, "K": 0.05, "b": 1e-5, "J": 2e-5}


@pytest.fixture(scope="module")
def problem() -> Problem:
    t = np.arange(0, 0.5, 1e-3)
    blank = mi.Experiment(t, {"v": 6 * np.sign(np.sin(20 * t))}, {"i": np.zeros(len(t)), "omega": np.zeros(len(t))})
    clean, rng = mi.simulate(mi.dc_motor(**TRUE), blank, initial="rest")[0].outputs, np.random.default_rng(1)
    noisy = {c: y + 0.01 * np.abs(y).max() * rng.standard_normal(len(t)) for c, y in clean.items()}
    return Problem(mi.dc_motor(**TRUE), (blank.with_(outputs=noisy),))


def test_the_nearest_start_wins_and_a_failure_does_not_end_the_race(problem):
    def solve(start: Problem, effort):
        if start.model.values["J"] > 1e-3:
            raise FitError("too heavy.")
        return least_squares(start, effort)

    starts = [problem.start_at({n: f * v for n, v in TRUE.items()}) for f in (8.0, 100.0, 1.1)]
    best = race(starts, LOOK, solve=solve)
    assert best.cost == solve(starts[2], LOOK).cost < solve(starts[0], LOOK).cost
    assert race(starts[1:2], LOOK, solve=solve) is None


def test_three_efforts_go_ever_further(problem):
    far = problem.start_at({n: 3 * v for n, v in TRUE.items()})
    look, raced, finished = (least_squares(far, effort) for effort in (LOOK, RACE, FINISH))
    assert look.cost > raced.cost >= finished.cost
    assert raced.cost < 1.001 * finished.cost
    assert len(look.history) <= LOOK.max_iterations + 1


def test_a_start_is_kept_inside_the_limits(problem):
    tight = problem.for_model(problem.model.bounded(R=(1.0, 3.0)))
    assert tight.start_at({"R": 10.0, "unknown": 1.0}).model.values["R"] == 3.0


def test_weights_by_the_rms_do_not_make_a_parameter_that_matters_look_collapsed(problem, monkeypatch):
    monkeypatch.setattr("motorid.estimation.continuation.race", lambda *_: pytest.fail("put back without need"))
    fit = mi.fit(mi.dc_motor(), problem.experiments, weights="rms", initial="rest")
    assert fit.values["K"] == pytest.approx(TRUE["K"], rel=0.02)

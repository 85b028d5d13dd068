"""Friction makes the misfit rugged; a fit gets through it by a wide sgn that becomes narrow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import motorid as mi
from motorid.estimation.continuation import by_continuation, past_ripples
from motorid.estimation.least_squares import FINISH, cost_at, least_squares
from motorid.problem.problem import Problem, as_problem
from motorid.problem.runs import SGN_WIDTH_SHARE, top_speed
from motorid.records.experiment import Experiment

TRUE = {"b": 0.3, "J": 0.1, "tau_c": 0.5, "tau_0": 0.1}


@pytest.fixture(scope="module")
def stuck() -> Experiment:
    """A drive that sticks at every reversal, its angle alone measured, with drag that the model will not have."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 6, 2e-3)
    u = np.sin(1.2 * np.pi * t) + 0.7 * np.sin(3.4 * np.pi * t + 1) + 0.3 * np.repeat(rng.normal(size=60), 50)
    plain = mi.torque_driven(g=1.0, b=TRUE["b"], J=TRUE["J"])
    friction = mi.effects.coulomb(tau_c=TRUE["tau_c"]), mi.effects.constant_load(tau_0=TRUE["tau_0"])
    model = plain + friction[0] + friction[1] + mi.effects.quadratic_drag(c_2=0.01)
    still = Experiment(t, {"v": u}, {"theta": np.zeros_like(t)})
    angle = mi.simulate(model.replace(sgn_width=1e-3), still, initial="rest")[0].outputs["theta"]
    return still.with_(outputs={"theta": angle + rng.normal(0, 1e-4, len(t))})


def problem(run: Experiment, seed: int) -> Problem:
    """The model without the drag, its start off by up to a factor of three in every parameter."""
    off = 3.0 ** np.random.default_rng(seed).uniform(-1, 1, len(TRUE))
    start = {n: v * f for (n, v), f in zip(TRUE.items(), off, strict=True)}
    model = mi.torque_driven(g=1.0) + mi.effects.coulomb + mi.effects.constant_load
    return as_problem(model.start_at(start), run, initial="rest")


def ends(run: Experiment, *, wide: bool) -> list[float]:
    """RMS of the whitened residual at the end, from three starts."""
    solutions = [by_continuation(problem(run, k), FINISH, wide=wide).solution for k in (0, 2, 4)]
    return [float(np.sqrt(np.mean(s.residual**2))) for s in solutions]


def test_continuation_leads_every_start_to_one_place_where_the_narrow_sgn_alone_does_not(stuck):
    staged, alone = ends(stuck, wide=True), ends(stuck, wide=False)
    assert np.ptp(staged) < 1e-3 * staged[0]
    assert max(alone) > 5 * staged[0]


def test_the_slopes_of_a_wider_sgn_lead_on_from_where_those_of_a_narrow_one_stall(stuck):
    ends = [least_squares(problem(stuck, k), FINISH) for k in range(6)]
    pairs = [(end, past_ripples(end, FINISH)) for end in ends]
    assert all(led is end for end, led in pairs if end.solution.status == "converged")
    shares = [led.cost / end.cost for end, led in pairs if end.solution.status != "converged"]
    assert max(shares) <= 1
    assert min(shares) < 0.5


def test_a_width_that_was_given_is_kept(stuck):
    begin = problem(stuck, 0)
    given = begin.for_model(begin.model.replace(sgn_width=0.05))
    done = by_continuation(given, mi.LevenbergMarquardt(max_iterations=1, looks=0))
    assert done.problem.model.values["sgn_width"] == 0.05
    assert len(done.history) == 2  # the start and one step


def test_what_a_wide_sgn_likes_is_left_where_a_narrow_one_refuses_it(stuck):
    """Under a wide sgn a breakaway torque without limits may fit; a narrow one would stand still with it."""
    good = problem(stuck, 0)
    good = good.for_model(good.model.start_at(TRUE))
    bad = good.for_model(good.model.start_at({"tau_c": 50.0}))
    assert cost_at(good) < 0.1 * cost_at(bad)
    assert by_continuation(bad, FINISH).cost == pytest.approx(by_continuation(good, FINISH).cost, rel=1e-3)


def test_an_overestimated_noise_hides_no_creep(stuck):
    """Below that noise nothing seems left to mend; the slopes say that a narrower sgn lowers the cost all the same."""
    run = stuck.with_(sigma={"theta": 20e-4})
    model = mi.torque_driven(g=1.0) + mi.effects.coulomb + mi.effects.constant_load + mi.effects.quadratic_drag
    begin = as_problem(model.start_at({**TRUE, "c_2": 0.01}), run, initial="rest")
    done, wider = by_continuation(begin, FINISH), by_continuation(begin, FINISH, narrow=False)
    assert done.problem.width < 0.5 * wider.problem.width
    assert done.cost < 0.8 * wider.cost


def test_a_motor_that_sticks_on_an_elastic_shaft_sticks_without_an_angle_too():
    """The load swings on against a motor that creeps; only a narrower sgn lowers the error of current and speed."""
    own = mi.effects.compliance(r_load=0.49, omega_r=75.0, zeta_r=0.04)
    truth = mi.dc_motor(R=1.0, L=1e-3, K=0.0635, b=1.9e-4, J=1.9e-4) + mi.effects.coulomb(tau_c=0.12) + own
    t, rng = np.arange(2000) * 1e-3, np.random.default_rng(1)
    v = np.repeat(rng.choice([0.0, 3.0, 12.0, -3.0, -12.0], 20), 100)
    wanted = mi.Experiment(t, {"v": v}, {"i": v, "omega": v})
    shown = mi.simulate(truth.replace(sgn_width=1e-4), wanted, initial="rest")[0].outputs
    run = wanted.with_(outputs={"i": shown["i"] + 5e-3 * rng.standard_normal(2000),
                                "omega": shown["omega"] + 0.1 * rng.standard_normal(2000)})
    fit = mi.fit(mi.dc_motor() + mi.effects.coulomb + mi.effects.compliance, run)
    assert fit.values["sgn_width"] < 0.5 * SGN_WIDTH_SHARE * top_speed([run])
    wide = by_continuation(fit.problem.tuned(width=SGN_WIDTH_SHARE * top_speed([run])), FINISH, narrow=False)
    assert fit.cost < 0.9 * wide.cost


def test_sub_steps_follow_the_solution(stuck):
    """The grid at the end is the one that the end asks for, not the one that the start asked for."""
    done = by_continuation(problem(stuck, 2), FINISH)
    again = done.problem.refined(done.solution.q)
    r = again.residual(done.solution.q)
    assert float(r @ r) == pytest.approx(float(done.solution.residual @ done.solution.residual), rel=0.02)


def test_an_initial_state_cannot_hide_what_the_model_lacks(stuck):
    """Left to itself the fit would begin far from where the record begins, to make up for missing friction."""
    model = mi.torque_driven(g=1.0)
    run = replace(stuck, inputs={"v": stuck.inputs["v"] + 0.01})  # so that it does not count as beginning at rest
    held, free = mi.fit(model, run), mi.fit(model, run, initial="estimate")
    first = float(np.median(run.outputs["theta"][:3]))
    assert abs(held.initial["theta_0[0]"] - first) < 20e-4
    assert abs(free.initial["theta_0[0]"] - first) > 0.05
    assert free.rmse["theta"] < held.rmse["theta"]


def test_where_a_narrow_sgn_cannot_be_followed_it_stays_wide(stuck, monkeypatch):
    """The slopes of an arm that stands nearly upright grow beyond all bounds under a narrow sgn."""
    from motorid.estimation import continuation

    def brittle(begun, *args, **options):
        if begun.width < narrowest:
            raise mi.FitError("the simulation grows without bound")
        return least_squares(begun, *args, **options)

    begin = problem(stuck, 0)
    wide, narrow = continuation._widths(begin)[0], continuation._widths(begin)[-1]
    narrowest = 0.5 * (wide + narrow)
    monkeypatch.setattr(continuation, "least_squares", brittle)
    done = by_continuation(begin, FINISH)
    assert done.problem.width == wide
    assert done.solution.status == "converged"
    narrowest = 2 * wide
    with pytest.raises(mi.FitError, match="without bound"):
        by_continuation(begin, FINISH)
    narrowest = narrow  # the last that can be followed
    assert by_continuation(begin, FINISH).problem.width == narrow

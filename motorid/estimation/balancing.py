"""Weights of the channels where the model fails: by their misfit, not by their noise."""

from __future__ import annotations

from dataclasses import replace

from motorid.estimation.continuation import Callback, Descent, descend, descend_surely
from motorid.estimation.restarts import off_plateaus
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.misfit import misfit_over_noise
from motorid.problem.problem import Problem

IMBALANCE = 3.0  # between channels, in misfit over noise, above which the misfit decides the weights


def descend_balanced(problem: Problem, options: LevenbergMarquardt, callback: Callback = None, *,
                     stages: bool = True) -> Descent:
    """Like `descend`, and where the model fails, weigh channels by their misfit instead of their noise.

    A model that cannot reach the noise would otherwise spend itself on the channel with the smallest noise
    (an encoder), at any price in the others. Noise and misfit together give the maximum of the likelihood
    with the channels' variances as unknowns, ``Σ n·ln(SSR)`` (Seber & Wild, Nonlinear Regression, 1989, ch.
    11); a model that reaches the noise keeps the weights of the noise.
    """
    done = off_plateaus(descend_surely(problem, options, callback, stages=stages), options, callback)
    if problem.weights != "noise" or problem.loss is not None or len(problem.outputs) < 2:
        return done
    begin = problem
    for k in range(3):
        factors = misfit_over_noise(done.problem, done.solution.q)
        relative = [factors[c] / done.problem.balance.get(c, 1.0) for c in factors]
        if max(relative) < IMBALANCE * min(relative):
            break
        again = descend(begin.tuned(balance=factors), options, callback, stages=stages and k == 0)
        done = off_plateaus(replace(again, history=done.history + again.history), options, callback)
        begin = done.problem.for_model(done.problem.model.start_at(done.problem.values(done.solution.q)))
    return done


__all__ = ["descend_balanced"]

"""Parameters that a fit has driven to nothing: on a logarithmic scale the cost is flat there, minimum or not.

A descent that overshoots lands on such a plateau and calls it converged. Put back to where it would matter, a
parameter comes to its value, or goes away again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from motorid.errors import FitError, SimulationError
from motorid.estimation.continuation import Callback, Descent, descend, descend_surely
from motorid.estimation.result import Fit
from motorid.model.definition import Parameter
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.problem import Problem
from motorid.problem.simulate import misfit_over_noise

ALIVE = 10.0  # standard deviations that a change by a factor of e makes
FURTHEST = 1e12  # times its value, that a parameter is put back
GAIN = 2.0  # of the cost, half of chi²: two standard deviations
MOST = 3  # parameters that are put back one by one


def put_back(parameters: Iterable[Parameter], says: Mapping[str, float]) -> dict[str, float]:
    """Return the values at which parameters without a say would have one.

    Parameters
    ----------
    parameters : iterable of Parameter
        Where the fit has them.
    says : mapping of str to float
        Change of the whitened residual with the logarithm of each parameter.
    """
    back = {}
    for p in parameters:
        if p.positive and p.vary and 0 < says.get(p.name, 0.0) < ALIVE:
            where = 3 * ALIVE / says[p.name] * p.value
            back[p.name] = float(np.clip(where, p.lower, min(p.upper, FURTHEST * p.value)))
    return back


def off_plateaus(done: Descent, options: LevenbergMarquardt, callback: Callback = None) -> Descent:
    """Return a descent that parameters put back have led lower, or the same one.

    All are put back together first, then one by one.
    """
    jac, log = done.solution.jac, done.problem.scaling.log
    size = np.sqrt(np.einsum("ij,ij->j", jac, jac))
    if not (size[log] < ALIVE).any():
        return done
    values = done.problem.values(done.solution.q)
    parameters = [replace(p, value=values[p.name]) for p in done.problem.model.parameters.values() if p.vary]
    says = dict(zip((p.name for p in done.problem.unknown), size, strict=True))
    back = {n: v for n, v in put_back(parameters, says).items() if v != values[n]}
    each = [{n: v} for n, v in back.items()][:MOST] if len(back) > 1 else []
    for start in [back, *each] if back else []:
        try:
            model = done.problem.model.start_at({**{p.name: p.value for p in parameters}, **start})
            again = descend(done.problem.for_model(model), options, callback, stages=False)
        except (FitError, SimulationError):
            continue
        if _cost(again) < _cost(done) - GAIN:
            return replace(again, history=done.history + again.history)
    return done


def _cost(done: Descent) -> float:
    return 0.5 * float(done.solution.residual @ done.solution.residual)


NO_LOSS = 2.0  # of the cost, half of chi²: two standard deviations


def revived(fit: Fit, model: Model) -> Model:
    """Return the model with collapsed parameters put back to where they matter."""
    names = [p.name for p in fit.problem.unknown]
    slopes = dict(zip(names, np.linalg.norm(fit.jacobian, axis=0), strict=True))
    known = [p for p in model.parameters.values() if p.name in slopes]
    back = put_back(known, {p.name: p.value * slopes[p.name] for p in known})
    return model.start_at(back) if back else model


def let_go(problem: Problem, fit: Fit) -> Problem:
    """Return the problem with what `revived` put back where `fit` had it, each if that costs nothing."""
    model = revived(fit, fit.model)
    for name in (n for n, p in model.parameters.items() if p.value != fit.model.parameters[n].value):
        other = problem.for_model(problem.model.start_at({name: fit.values[name]}))
        if _cost_revival(other) < _cost_revival(problem) + NO_LOSS:
            problem = other
    return problem


def _cost_revival(problem: Problem) -> float:
    try:
        r = problem.refined(problem.start).residual(problem.start)
    except SimulationError:
        return float("inf")
    return 0.5 * float(r @ r) if np.isfinite(r).all() else float("inf")


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

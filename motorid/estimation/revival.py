"""Parameters that a fit has driven to nothing: put back for a refit, and let go where they stay without a say.

A plain fit may drive a logarithmic parameter (friction, inductance) to nothing; there its gradient vanishes, and no
refit would ever bring it back. What samples show even then no more is better left where it was: an inductance
between nothing and the sample time costs the most sub-steps.
"""

from __future__ import annotations

import numpy as np

from motorid.errors import SimulationError
from motorid.estimation.fit import Fit
from motorid.estimation.restarts import put_back
from motorid.model.model import Model
from motorid.problem.problem import Problem

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
        if _cost(other) < _cost(problem) + NO_LOSS:
            problem = other
    return problem


def _cost(problem: Problem) -> float:
    try:
        r = problem.refined(problem.start).residual(problem.start)
    except SimulationError:
        return float("inf")
    return 0.5 * float(r @ r) if np.isfinite(r).all() else float("inf")

"""Parameters that a fit has driven to nothing: on a logarithmic scale the cost is flat there, minimum or not.

A descent that overshoots lands on such a plateau and calls it converged. Put back to where it would matter, a
parameter comes to its value, or goes away again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from motorid.errors import FitError, SimulationError
from motorid.estimation.continuation import Callback, Descent, descend
from motorid.model.definition import Parameter
from motorid.numerics.least_squares import LevenbergMarquardt

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


__all__ = ["off_plateaus", "put_back"]

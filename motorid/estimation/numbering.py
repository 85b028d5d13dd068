"""How often per turn? The orders of cogging and torque ripple, where the user gave none, from the misfit."""

from __future__ import annotations

from collections.abc import Callable

from motorid.errors import FitError
from motorid.estimation.angle_orders import Line, likely_lines
from motorid.estimation.result import Fit
from motorid.estimation.tangent import Tangent
from motorid.model.model import Effect, Model
from motorid.problem.problem import Problem


def numbered(problem: Problem, solve: Callable[[Problem], Fit]) -> Problem:
    """Return the problem with the orders that the records show, started at them.

    The model is solved without the effects of unknown order; the strongest line of what is left over the angle
    gives the order, size and phase of one of them, and so on with the next.

    Parameters
    ----------
    problem : Problem
    solve : callable
        How to fit a smaller problem.
    """
    model = problem.model
    waiting = [e for e in model.effects if _open(model, e)]
    if not waiting:
        return problem
    present = model
    for e in waiting:
        present = present.without(e.name)
    while waiting:
        smaller = problem.for_model(present).tuned(constraints=())  # an order shows without them
        if not smaller.unknown:
            break
        try:
            fit = solve(smaller)
        except FitError:
            break
        tangent = Tangent.of(fit)
        lines = [(e, line) for e in waiting for line in likely_lines(tangent, e, 1)]
        if not lines:
            break
        effect, line = max(lines, key=lambda pair: pair[1].share)
        found = _values(effect, line)
        model, present = model.start_at({**fit.values, **found}), (fit.model + effect).start_at(found)
        waiting.remove(effect)
    return problem.for_model(model)


def _open(model: Model, effect: Effect) -> bool:
    """Tell whether the effect has an order that nobody has set."""
    pairs = ((p, model.parameters[p.name]) for p in effect.parameters)
    return any(p.order and not now.given and now.value == p.value for p, now in pairs)


def _values(effect: Effect, line: Line) -> dict[str, float]:
    found = {}
    for p in effect.parameters:
        if p.order:
            found[p.name] = line.order
        elif p.periodic:
            found[p.name] = line.phase
        elif p.null == 0:
            found[p.name] = line.amplitude
    return found


__all__ = ["numbered"]

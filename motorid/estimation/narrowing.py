"""The width of the smooth sgn: wide at first, then as narrow as speeds, noise and misfit ask for."""

from __future__ import annotations

from motorid.integrate.engine import Array
from motorid.problem.misfit import misfit_over_noise
from motorid.problem.problem import Problem
from motorid.problem.runs import SGN_WIDTH_SHARE, top_speed

WIDEST = 0.03  # first width of sgn over the highest speed
NARROWER = 6.0  # at most, from one stage to the next
NOISE = 1.1  # misfit over noise of an angle that has no creep left in it
CLEARLY = 1.5  # factor between widths that is worth another descent


def smooths(problem: Problem) -> bool:
    """Tell whether the model has a sgn whose width was left to the records."""
    width = problem.model.parameters.get("sgn_width")
    return width is not None and not width.given and not width.vary


def narrowest(problem: Problem) -> float:
    """Return the width of sgn that the noise of the records asks for."""
    return problem.tuned(width=None).model.values["sgn_width"]


def narrow_enough(problem: Problem) -> float:
    """Return the width of sgn that the speeds of the records ask for, whatever their noise."""
    return max(SGN_WIDTH_SHARE * top_speed(problem.experiments), narrowest(problem))


def narrower(problem: Problem, q: Array) -> Problem | None:
    """Return the problem with a narrower sgn, where a loaded, stuck motor's creep may show in the angle.

    None where the angle's misfit is noise already, or the width is what that noise asks for.
    """
    if problem.width is None or not smooths(problem) or problem.width > 1.01 * narrow_enough(problem):
        return None
    width = max(narrowest(problem), problem.width / NARROWER)
    if width > problem.width / CLEARLY or misfit_over_noise(problem, q).get("theta", 0.0) < NOISE:
        return None
    return problem.for_model(problem.model.start_at(without_width(problem, q))).tuned(width=width)


def without_width(problem: Problem, q: Array) -> dict[str, float]:
    """Return the parameter values at `q`, but for the width of sgn."""
    return {n: v for n, v in problem.values(q).items() if n != "sgn_width"}


__all__ = ["NARROWER", "WIDEST", "narrow_enough", "narrower", "narrowest", "smooths", "without_width"]

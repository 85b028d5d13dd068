"""A race: several starts, the same effort for each, keep the best."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from motorid.errors import FAILURES
from motorid.estimation.least_squares import Estimate, least_squares
from motorid.estimation.result import Failure
from motorid.numerics.least_squares import LevenbergMarquardt
from motorid.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Race:
    """What came of each start, in their order; one that failed is a value too."""

    ends: tuple[Estimate | Failure, ...]

    @property
    def best(self) -> Estimate | None:
        """The end of lowest cost, the first of equals; None if every start failed."""
        return min((e for e in self.ends if isinstance(e, Estimate)), key=lambda e: e.cost, default=None)


def race(problems: Iterable[Problem], effort: LevenbergMarquardt, *,
         solve: Callable[[Problem, LevenbergMarquardt], Estimate] = least_squares) -> Race:
    """Minimise the cost of each problem from the values of its model.

    Parameters
    ----------
    problems : iterable of Problem
        Costs are compared: on the same records, with the same weights.
    effort : LevenbergMarquardt
        `LOOK` for a few steps, `RACE` for nearly the whole way, `FINISH`.
    solve : callable
        How to minimise, e.g. `by_continuation`.
    """
    return Race(tuple(_attempt(problem, effort, solve) for problem in problems))


def _attempt(problem: Problem, effort: LevenbergMarquardt, solve: Callable[..., Estimate]) -> Estimate | Failure:
    try:
        return solve(problem, effort)
    except FAILURES as error:
        return Failure(problem.model.values, "failed", str(error))

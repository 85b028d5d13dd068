"""One least-squares run on a problem, and a race of several: every stage of a fit is one of these two calls."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from motorid.errors import FitError, ModelError, SimulationError, otherwise
from motorid.numerics.least_squares import LevenbergMarquardt, Solution, levenberg_marquardt
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem

LOOK = LevenbergMarquardt(max_iterations=6, ftol=1e-3, xtol=1e-4, looks=0)  # which starts are worth more?
RACE = LevenbergMarquardt(max_iterations=60, ftol=1e-7, looks=0)  # which start leads lowest?
FINISH = LevenbergMarquardt()  # to the optimum, restarted where that is in doubt

ROUNDS = 4  # of a run, the sub-steps chosen again at its end
FAR = 1.0  # on the logarithmic scale: how far a run goes before its sub-steps are chosen again
NEAR = 0.05  # and how far they suit without a look
MOVED = 1e-3  # less than this is no other place
WILD = 1e7  # times the whole residual: more than any change by a factor of e does to one sample

# What may go wrong with one of many models without stopping the others.
FAILURES = (FitError, SimulationError, ModelError, np.linalg.LinAlgError, ArithmeticError)
Callback = Callable[[int, float, Array], object] | None


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where least squares ended: the problem with its last sub-steps, the solution, all costs on the way."""

    problem: Problem
    solution: Solution
    history: tuple[float, ...]

    @property
    def q(self) -> Array:
        """Solver coordinates of the end."""
        return self.solution.q

    @property
    def onward(self) -> Problem:
        """The problem begun at the end."""
        return self.problem.begun_at(self.q)

    @property
    def cost(self) -> float:
        """½ rᵀr at the end."""
        return self.solution.history[-1]

    @property
    def values(self) -> dict[str, float]:
        """Parameter values at the end, SI."""
        return self.problem.values(self.q)


def least_squares(problem: Problem, effort: LevenbergMarquardt, callback: Callback = None, *,
                  q: Array | None = None, refine: bool = True, rounds: int = ROUNDS) -> Estimate:
    """Minimise the cost of `problem` from the values of its model, or from `q`.

    `refine` chooses the sub-steps anew where the solution goes: those chosen far off hide what rings between samples.
    The run is repeated at most `rounds` times while they do not suit. `FitError`: the start cannot be simulated."""
    q, history = problem.start if q is None else q, ()
    for _ in range(rounds):
        here = _Refining(problem) if refine else problem
        found = levenberg_marquardt(here.residual, here.residual_and_jacobian, q, problem.scaling.bounds, effort,
                                    callback, problem.scaling.log)
        history += found.history
        moved = np.max(np.abs(found.q - q), initial=0.0) > MOVED
        q = found.q
        if not isinstance(here, _Refining):
            break
        problem = here.problem
        if found.status == "limit" or here.suits(q) or not (moved or found.status == "stalled"):
            break
    return Estimate(problem, found, history)


def cost_at(problem: Problem, q: Array | None = None, *, refine: bool = True) -> float:
    """Return the cost at `q`, by default at the model's values; infinite where it fails. `refine`: the sub-steps."""
    q = problem.start if q is None else q
    r = otherwise(np.array([np.inf]), SimulationError, lambda: (problem.refined(q) if refine else problem).residual(q))
    return 0.5 * float(r @ r) if np.isfinite(r).all() else np.inf


def race(problems: Iterable[Problem], effort: LevenbergMarquardt, *,
         solve: Callable[[Problem, LevenbergMarquardt], Estimate] = least_squares) -> Estimate | None:
    """Minimise the cost of each problem, of the same records and weights, from the values of its model; return the
    lowest end, of equals the first, None if all failed. `solve` minimises, e.g. `by_continuation`."""
    ends = []
    for problem in problems:
        with suppress(*FAILURES):
            ends.append(solve(problem, effort))
    return min(ends, key=lambda e: e.cost, default=None)


class _Refining:
    """A problem whose sub-steps follow the solution."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self._first, self._chosen_at = problem, problem, np.full(len(problem.start), np.inf)

    def _follow(self, q: Array) -> None:
        before, self.problem, self._chosen_at = self.problem, self.problem.refined(q), q
        if before is not self._first:  # it holds its trajectories, and the next
            before.forget()

    def residual(self, q: Array) -> Array:
        return self.problem.residual(q)

    def residual_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        if np.max(np.abs(q - self._chosen_at), initial=0.0) > FAR:
            self._follow(q)
        r, jac = self.problem.residual_and_jacobian(q)
        # A sgn that the steps jump over makes slopes of nothing.
        if np.max(np.abs(jac), initial=0.0) > WILD * np.linalg.norm(r) and not np.array_equal(q, self._chosen_at):
            self._follow(q)
            r, jac = self.problem.residual_and_jacobian(q)
        return r, jac

    def suits(self, q: Array) -> bool:
        """Tell whether the sub-steps are right at `q` too: chosen nearby, or still fine enough."""
        return bool(np.max(np.abs(q - self._chosen_at), initial=0.0) < NEAR) or self.problem.fine_enough(q)

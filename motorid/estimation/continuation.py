"""Least squares in stages: sgn from wide to narrow, sub-steps refined where the solution goes.

Friction makes the misfit rugged: a parameter moves the instant at which a speed passes through zero. A wide
sgn smooths this over, and its minimum leads to the right one (numerical continuation, Allgower & Georg,
1990). On the EMPS record five starts within a factor of three ended at 2.61-3.01 mm with the final width
alone, and all at 2.551 mm in stages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from motorid.errors import FitError, SimulationError
from motorid.numerics.least_squares import LevenbergMarquardt, Solution, levenberg_marquardt
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.runs import SGN_WIDTH_SHARE, top_speed
from motorid.problem.simulate import misfit_over_noise, poorly_explained

ON_THE_WAY = ((1e-7, 60), (1e-6, 60))  # ftol and iterations of the first stage, and of those between
LOWER = 0.98  # of the cost with a wider sgn, or the narrower one is not worth it
ROUNDS = 4  # of refining the sub-steps

# Looks again from the start: by the other weights first?, first damping, start moved by e to this power.
LOOKS = ((True, 0.1, 0.0), (False, 10.0, 0.0), (True, 10.0, 0.0), (False, 1.0, 1.5), (True, 1.0, 1.5))
WILD = 1e7  # times the whole residual: more than any change by a factor of e does to one sample
FAR = 1.0  # on the logarithmic scale: how far a descent goes before its sub-steps are chosen again
NEAR = 0.05  # and how far they suit without a look
FLAT = 0.03  # of the misfit: what a change by a factor of e does at least, if the data have a say in it

Callback = Callable[[int, float, Array], object] | None


@dataclass(frozen=True, eq=False)
class Descent:
    """Where a descent ended: the problem with its last grids, the solution, all costs on the way."""

    problem: Problem
    solution: Solution
    history: tuple[float, ...]


def descend(problem: Problem, options: LevenbergMarquardt, callback: Callback = None, *,
            stages: bool = True, surely: bool = False) -> Descent:
    """Solve `problem` from the values of its model.

    Parameters
    ----------
    problem : Problem
    options : LevenbergMarquardt
    callback : callable, optional
    stages : bool
        Begin with a wide sgn, where the model has one whose width was not given.
    surely : bool
        Look again where the first of these stages ends in doubt.

    Raises
    ------
    FitError
        If the model cannot be simulated at the start.
    """
    history: list[float] = []
    if stages:
        problem = _narrowing(problem, options, callback, history, surely)
    done = _settled(problem, options, callback)
    history += done.history
    while (other := narrower(done.problem, done.solution.q)) is not None:
        again = _settled(other, options, callback)
        history += again.history
        if again.solution.history[-1] > LOWER * done.solution.history[-1]:
            break  # the creep did not matter, and a sgn so narrow only makes the model stiff and its slopes wild
        done = again
    return replace(done, history=tuple(history))


def _settled(problem: Problem, options: LevenbergMarquardt, callback: Callback) -> Descent:
    """Solve, and again with other sub-steps, until they suit the end."""
    history: list[float] = []
    q = problem.start
    for _ in range(ROUNDS):
        following, found = _solve(problem, q, options, callback)
        problem = following.problem
        history += found.history
        moved = np.max(np.abs(found.q - q), initial=0.0) > 1e-3
        q = found.q
        if found.status == "limit" or following.suits(q) or not (moved or found.status == "stalled"):
            break
    return Descent(problem, found, tuple(history))


def _solve(problem: Problem, q: Array, options: LevenbergMarquardt,
           callback: Callback) -> tuple[_Following, Solution]:
    following = _Following(problem)
    found = levenberg_marquardt(following.residual, following.both, q, problem.scaling.bounds, options,
                                callback, problem.scaling.log)
    return following, found


class _Following:
    """A problem whose sub-steps follow the descent: steps chosen far away hide what rings between samples."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self._chosen_at = problem, np.full(len(problem.start), np.inf)

    def residual(self, q: Array) -> Array:
        return self.problem.residual(q)

    def both(self, q: Array) -> tuple[Array, Array]:
        if np.max(np.abs(q - self._chosen_at), initial=0.0) > FAR:
            self._choose(q)
        r, jac = self.problem.residual_and_jacobian(q)
        if np.max(np.abs(jac), initial=0.0) > WILD * np.linalg.norm(r) and not np.array_equal(q, self._chosen_at):
            self._choose(q)  # a sgn that these steps jump over makes slopes of nothing
            r, jac = self.problem.residual_and_jacobian(q)
        return r, jac

    def suits(self, q: Array) -> bool:
        """Tell whether the sub-steps are right at `q` too: chosen nearby, or still fine enough."""
        return bool(np.max(np.abs(q - self._chosen_at), initial=0.0) < NEAR) or self.problem.fine_enough(q)

    def _choose(self, q: Array) -> None:
        self.problem, self._chosen_at = self.problem.refined(q), q


def descend_surely(problem: Problem, options: LevenbergMarquardt, callback: Callback = None, *,
                   stages: bool = True) -> Descent:
    """Like `descend`, and take a second look from the start where the end is doubtful.

    Two valleys lead far starts astray. With the electrical and the mechanical time constant swapped the
    speed comes out right and the current not at all; with hardly any resistance inductance and inertia
    ring. The first is left by letting every channel count alike at first (errors over the RMS), the second
    by smaller first steps; what resists both is begun from a place nearby. With this, three series of 1000
    starts within a factor of ten of each shipped motor with noise all ended in its optimum; within a factor
    of a hundred 979 and 967 of 1000 did, and all with the automatic first guess (bench_starts.py).
    """
    if stages and smooths(problem):
        return descend(problem, options, callback, surely=True)
    done = descend(problem, options, callback, stages=stages)
    for k, (other, damping, shift) in enumerate(LOOKS[:options.looks]):
        if not doubtful(problem, done):
            break
        careful = replace(options, damping=damping)
        try:
            begin = _shifted(problem, shift, k) if shift else problem
            begin = _by_other_weights(begin, careful) if other else begin
            again = descend(begin, careful, callback, stages=stages)
        except (FitError, SimulationError):
            continue
        best = min(done, again, key=lambda d: float(d.solution.residual @ d.solution.residual))
        done = replace(best, history=done.history + again.history)
    return done


def doubtful(problem: Problem, done: Descent) -> bool:
    """Tell whether a descent went far and ended where it should not.

    That is: without convergence, with a channel hardly explained, or in a direction that the data do not
    ask for.
    """
    log, found = problem.scaling.log, done.problem.scaling.physical(done.solution.q)
    moved = np.log(found[log] / problem.scaling.physical(problem.start)[log])
    if np.max(np.abs(moved), initial=0.0) < 1.0:
        return False
    if done.solution.status != "converged" or poorly_explained(done.problem, done.solution.q):
        return True
    jac = done.solution.jac[:, log]
    s, directions = np.linalg.svd(np.linalg.qr(jac, mode="r"))[1:]
    flat = directions[:len(s)][s < FLAT * np.linalg.norm(done.solution.residual)]
    return bool(np.max(np.abs(flat.T @ (flat @ moved)), initial=0.0) > 1.0)


def _shifted(problem: Problem, shift: float, seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    names = [p.name for p in problem.unknown if p.positive and p.vary and p.name in problem.model.parameters]
    moved = {n: problem.model.values[n] * float(np.exp(shift * rng.uniform(-1, 1))) for n in names}
    limits = problem.model.parameters
    return problem.for_model(problem.model.start_at(
        {n: float(np.clip(v, limits[n].lower, limits[n].upper)) for n, v in moved.items()}))


def _by_other_weights(problem: Problem, options: LevenbergMarquardt) -> Problem:
    weights = "noise" if problem.weights == "rms" else "rms"
    other = replace(problem, weights=weights, balance={}, _runs=problem.runs)
    found = descend(other, replace(options, ftol=1e-2), stages=False)
    return problem.for_model(problem.model.start_at(problem.values(found.solution.q)))


def _narrowing(problem: Problem, options: LevenbergMarquardt, callback: Callback, history: list[float],
               surely: bool) -> Problem:
    """Return the problem with the values that a wide sgn leads to, made narrower step by step."""
    if not smooths(problem):
        return problem
    width = narrow_enough(problem)
    problem = begin = problem.tuned(width=width)
    ratio = max(WIDEST * top_speed(problem.experiments) / width, 1.0)
    steps = int(np.ceil(np.log(ratio) / np.log(NARROWER)))
    for k, factor in enumerate(np.geomspace(ratio, 1.0, steps + 1)[:-1]):
        wide = _cheaper(*(p.tuned(width=factor * width) for p in dict.fromkeys((problem, begin))))
        try:
            if k == 0 and surely:
                done = descend_surely(wide, _sooner(options, ON_THE_WAY[0]), callback, stages=False)
                wide, found, costs = done.problem, done.solution, done.history
            else:
                following, found = _solve(wide, wide.start, _sooner(options, ON_THE_WAY[min(k, 1)]), callback)
                wide, costs = following.problem, found.history
        except (FitError, SimulationError):
            continue
        history += costs
        problem = begin.for_model(begin.model.start_at(without_width(wide, found.q)))
    return _cheaper(*dict.fromkeys((problem, begin)))


def _sooner(options: LevenbergMarquardt, ends: tuple[float, int]) -> LevenbergMarquardt:
    ftol, most = ends
    return replace(options, ftol=max(options.ftol, ftol), max_iterations=min(options.max_iterations, most))


def _cheaper(first: Problem, *others: Problem) -> Problem:
    """Return the problem that starts nearest to its data: what one sgn likes a narrower one may refuse."""
    costs = []
    for p in (first, *others) if others else ():
        try:
            r = p.refined(p.start).residual(p.start)  # at steps that fit each, or the coarse ones decide
        except SimulationError:
            r = np.array([np.inf])
        costs.append(float(r @ r) if np.isfinite(r).all() else np.inf)
    return (first, *others)[int(np.argmin(costs))] if costs else first


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

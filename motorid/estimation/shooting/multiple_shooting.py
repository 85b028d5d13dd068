"""Multiple shooting: the fit as a nonlinear program, with true constraints, or with process noise.

States at nodes are unknowns, so a poor start or a drifting record does no harm: each short interval begins near the
data. At the solution the intervals join, unless process noise is allowed: then their gaps show where the model fails.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from motorid.errors import FitError, SimulationError, UsageError, among, at_least, otherwise, positive
from motorid.estimation.fit import minimise
from motorid.estimation.least_squares import FINISH, least_squares
from motorid.estimation.result import Fit
from motorid.estimation.shooting.nlp import (
    Mesh,
    NlpResult,
    ShootingNlp,
    first_noise,
    ipopt,
    nodes_from_data,
    nodes_from_simulation,
    noise_of_gaps,
)
from motorid.estimation.shooting.outcome import KEPT, Solved, below_steady, fit_of, violations
from motorid.numerics.signals import Array
from motorid.problem.constraints import Relation, Weighed
from motorid.problem.problem import Problem
from motorid.problem.simulate import at, judge, misfit_over_noise

ROUNDS = 4  # of refining the sub-steps
TIGHT = 1e-13  # share of the cost at which the least-squares fit on the way stops
FARTHEST = 14.0  # largest change of a logarithm; a parameter at 1e-6 of where it was has no effect any more
HEAVIER = (1.0, 10.0, 100.0)  # times the penalties' own weights, on the way to true constraints
VALLEY = 1.5  # on the logarithmic scale: to the other valley of the inductance
POOR = 0.5  # NRMSE at the start above which the intervals are first joined loosely
NOISY = 25  # samples per interval with process noise
NOISE_ROUNDS = 4  # of finding how much
NOISE_KNOWN = 0.2  # change of its logarithm that is small enough
LOOSE = 10, 0.05  # then: samples per interval, and gaps in sizes of the states
ROUGH_ITERATIONS = 40  # iterations of a fit that only shows where to go on
LEAST_NOISE = 0.01  # of the RMS of a channel: the least noise that counts in the loose fit
AWAY = 3.5  # largest change of a logarithm in one such fit
FAR_OFF = 3.0  # change of a logarithm that may mean that a parameter got lost


@dataclass(frozen=True)
class MultipleShooting:
    """Options of the multiple-shooting solver.

    Attributes
    ----------
    every : int, optional
        Samples per interval. By default 50, more on long runs so that there are at most 200 intervals.
    warm : {"auto", "data", "model"}
        Initial states at the nodes: ``"data"`` from the measured channels, ``"model"`` from a least-squares fit,
        ``"auto"`` the latter, from poor values after a fit with loose continuity.
    process_noise : mapping of str to float, or "auto", optional
        Standard deviation per state and √s (``{"omega": 3.0}``: rad/s per √s); gaps at the nodes are penalised
        by it instead of forbidden; other states get almost none. ``"auto"``: of current and speed, as large as
        their gaps are. Intervals then have 25 samples.
    tol : float
        IPOPT's tolerance on the scaled problem.
    verbose : bool
        Show IPOPT's log.

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor(), runs, solver=mi.MultipleShooting(every=100))
    """

    every: int | None = None
    warm: str = "auto"
    process_noise: Mapping[str, float] | str | None = None
    max_iterations: int = 150
    tol: float = 1e-9
    verbose: bool = False

    def __post_init__(self) -> None:
        among(self.warm, ("auto", "data", "model"), "warm start")
        if isinstance(self.process_noise, str):
            among(self.process_noise, ("auto",), "process noise")
        at_least(2, every=self.every)
        at_least(1, max_iterations=self.max_iterations)
        positive(tol=self.tol)
        noises = self.process_noise if isinstance(self.process_noise, Mapping) else {}
        positive(**{f"process_noise of {name}": value for name, value in noises.items()})

    def solve(self, problem: Problem) -> Fit:
        """Return the fit of `problem` from the values of its model.

        First without the constraints, by least squares, which settles sub-steps and weights; from poor values
        by way of a fit whose intervals need not join. Then all together, from there.

        Raises
        ------
        UsageError, FitError
            A constraint does not go with the model; those that it names contradict one another or the records, or the
            start cannot be simulated.
        """
        began = time.perf_counter()
        for c in (*problem.constraints, *problem.penalties):
            if not isinstance(c, Relation):
                raise UsageError(f"MultipleShooting takes CurrentLimit, SteadyState and Constraint, not "
                                 f"{type(c).__name__}.")
            c.parts(problem)
        if contradiction := below_steady(problem):
            raise FitError(contradiction)
        near, q = self._unconstrained(replace(problem, constraints=()))
        bound = replace(near, constraints=problem.constraints)
        if self.process_noise is not None:
            return fit_of(self._with_process_noise(bound, q), time.perf_counter() - began)
        return fit_of(self._with_refinement(bound, _under_heavier_penalties(bound, q)), time.perf_counter() - began)

    def _unconstrained(self, problem: Problem) -> tuple[Problem, Array]:
        """Return the problem with weights settled, and values near its solution without constraints."""
        if self.process_noise is not None:
            return problem, problem.start
        if self.warm == "data":
            return problem, self._from_poor_values(problem) if _poor(problem, problem.start) else problem.start
        if self.warm == "model" or not _poor(problem, problem.start):
            return _least_squares(problem, True)
        near = _least_squares(problem.start_at(problem.values(self._from_poor_values(problem))), False)
        return min(near, _least_squares(problem, True), key=lambda found: _misfit(*found)) if _poor(*near) else near

    def _from_poor_values(self, problem: Problem) -> Array:
        """Return values that a fit finds whose intervals join loosely, then tightly, from poor ones."""
        every, size = LOOSE
        mesh = Mesh(problem.tuned(noise_factors=_least_noise(problem)), every)
        step = float(np.median([run.experiment.dt for run in problem.runs]))
        mesh = replace(mesh, noise=size * mesh.scale / np.sqrt(every * step))
        loose = self._solve(mesh, mesh.joined(problem.start, nodes_from_data(mesh, problem.start)), rough=True)
        best = _lowest([self._roughly(problem, q) for q in _with_resets(problem, loose.q)])
        # Once the others are right, a parameter that ran off to where nothing depends on it finds its way back.
        return _lowest([best, *(self._roughly(problem, q) for q in _with_resets(problem, best.q)[1:])]).q

    def _roughly(self, problem: Problem, q: Array) -> Solved:
        """Solve from `q` not very far, with one step per sample: a lost parameter may ask for very many."""
        mesh = Mesh(problem, self.every)
        nodes = nodes_from_data if _poor(problem, q) else nodes_from_simulation
        return self._solve(mesh, mesh.joined(q, nodes(mesh, q)), rough=True)

    def _with_refinement(self, problem: Problem, q: Array) -> Solved:
        """Solve, refine the sub-steps at the solution, and again while they do not suffice."""
        mesh = Mesh(problem if problem.fine_enough(q) else problem.refined(q), self.every)
        try:
            z = mesh.joined(q, (nodes_from_data if self.warm == "data" else nodes_from_simulation)(mesh, q))
        except SimulationError:
            z = mesh.joined(q, nodes_from_data(mesh, q))
        done = self._solve(mesh, z)
        if not problem.constraints and done.worse_than(z):
            return replace(done, result=done.result._replace(z=z, status=KEPT))
        for _ in range(ROUNDS - 1):
            if done.problem.fine_enough(done.q):
                break
            finer = replace(done.mesh, problem=done.problem.refined(done.q))
            done = self._solve(finer, done.result.z, done.result, done.history)
        return done

    def _with_process_noise(self, problem: Problem, q: Array) -> Solved:
        """Solve with process noise; with ``"auto"`` again until the gaps are as large as was taken."""
        mesh = Mesh(problem.refined(q), self.every or NOISY)
        noise = first_noise(self.process_noise, mesh)
        mesh = replace(mesh, noise=noise)
        done = self._solve(mesh, mesh.joined(q, nodes_from_data(mesh, q)), rough=self.process_noise == "auto")
        for _ in range(NOISE_ROUNDS if self.process_noise == "auto" else 0):
            before, noise = noise, noise_of_gaps(done.mesh, done.result.z)
            done = self._solve(replace(done.mesh, noise=noise), done.result.z, history=done.history)
            if (np.abs(np.log(noise / before)) < NOISE_KNOWN).all():
                break
        return done

    def _solve(self, mesh: Mesh, z: Array, warm: NlpResult | None = None, history: tuple[float, ...] = (),
               rough: bool = False) -> Solved:
        low, high = mesh.problem.scaling.bounds
        far = np.where(mesh.problem.scaling.log, AWAY if rough else FARTHEST, np.inf)
        low, high = np.maximum(low, z[:mesh.nq] - far), np.minimum(high, z[:mesh.nq] + far)
        free = np.full(len(z) - mesh.nq, np.inf)
        try:
            nlp = ShootingNlp(mesh, z)
        except SimulationError as error:
            raise FitError(f"the model cannot be simulated at the start: {error} Give other starting values with "
                           "model.replace(…), or leave them out.") from None
        most, tol = (min(ROUGH_ITERATIONS, self.max_iterations), 1e-6) if rough else (self.max_iterations, self.tol)
        result = ipopt(nlp, z, (np.concatenate([low, -free]), np.concatenate([high, free])),
                       {"max_iter": most, "tol": tol, "print_level": 5 if self.verbose else 0}, warm,
                       near=not rough and self.warm != "data")
        return Solved(mesh, nlp, result, history + result.history)


def _least_noise(problem: Problem) -> dict[str, float]:
    """Return factors for the noise of each channel, so that a nearly noise-free one does not rule the loose fit."""
    least = [(c, LEAST_NOISE * float(np.sqrt(np.nanmean(run.experiment.outputs[c] ** 2))) / sigma)
             for run in problem.runs for c, sigma in run.sigma.items()]
    return {c: max(1.0, *(factor for of, factor in least if of == c)) for c, _ in least}


def _least_squares(problem: Problem, stages: bool) -> tuple[Problem, Array]:
    """Return the problem with weights settled and its solution without constraints, in one piece."""
    done = otherwise(None, FitError, lambda: minimise(problem, replace(FINISH, ftol=TIGHT), wide=stages))
    return (done.problem, done.q) if done else (problem, problem.start)  # the intervals will have to find it


def _under_heavier_penalties(problem: Problem, q: Array) -> Array:
    """Return values near the constrained solution: penalties on what is violated at `q`, heavier and heavier."""
    if not any(otherwise({}, SimulationError, lambda: violations(problem, q)).values()):
        return q
    names = [p.name for p in problem.unknown]
    starts = [q, q + VALLEY * np.array([n == "L" for n in names])] if "L" in names else [q]
    return min((_under_penalties(problem, start) for start in starts), key=lambda f: f[0])[1]


def _under_penalties(problem: Problem, q: Array) -> tuple[float, Array]:
    """Return the cost and the solution under the heaviest penalties, each reached from the one before."""
    cost = np.inf
    for factor in HEAVIER:
        step = replace(problem, penalties=(*problem.penalties, *(Weighed(c, factor) for c in problem.constraints)))
        try:
            found = least_squares(step, replace(FINISH, max_iterations=60), q=q, refine=False)
        except (FitError, SimulationError):
            return np.inf, q
        q, cost = found.q, found.cost
    return cost, q


def _misfit(problem: Problem, q: Array) -> float:
    """Return the misfit over all channels, on a scale that does not depend on their weights."""
    errors = otherwise({"": np.inf}, SimulationError, lambda: misfit_over_noise(problem, q))
    return float(np.sum(np.log(list(errors.values()))))


def _with_resets(problem: Problem, q: Array) -> list[Array]:
    """Return `q`, and `q` with the parameters that went very far put back to their start."""
    lost = problem.scaling.log & (np.abs(q - problem.start) > FAR_OFF)
    return [q, np.where(lost, problem.start, q)] if lost.any() else [q]


def _lowest(found: list[Solved]) -> Solved:
    return min([d for d in found if d.verdict[0] == "converged"] or found, key=lambda d: d.cost)


def _poor(problem: Problem, q: Array) -> bool:
    """Tell whether the model explains less than half of some channel at `q`."""
    errors = otherwise(({"": np.inf},), SimulationError, lambda: judge(at(problem, q)).by_run)
    return not all(e < POOR for run in errors for e in run.values())

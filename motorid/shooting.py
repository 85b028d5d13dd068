"""Multiple shooting: the fit as a nonlinear program, with true constraints, or with process noise.

The same discrete step as in the least-squares fit. States at nodes are unknowns, so a poor start or a drifting
record does no harm: each short interval begins near the data. At the solution the intervals join, unless
process noise is allowed; then the gaps at the nodes show where the model fails.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from motorid.descent import misfit_over_noise
from motorid.errors import FitError, SimulationError, UsageError, one_of
from motorid.fit import Fit
from motorid.integrate.grid import Array
from motorid.mesh import Mesh
from motorid.nlp import Ipopt, NlpResult, ShootingNlp
from motorid.nodes import nodes_from_data, nodes_from_simulation
from motorid.outcome import Solved, fit_of
from motorid.problem import Problem
from motorid.relations import Relation

ROUNDS = 4  # of refining the sub-steps
IMBALANCE = 3.0  # as in the least-squares fit
FARTHEST = 25.0  # change of a logarithm beyond which no physical parameter lies
POOR = 0.5  # NRMSE at the start above which the intervals are first joined loosely
LOOSE = 10, 0.05  # then: samples per interval, and gaps in sizes of the states
QUICK = 60  # iterations of a fit that only shows where to go on
BLUNT = 0.01  # of the RMS of a channel: the least noise that counts in the loose fit
AWAY = 3.5  # largest change of a logarithm in one such fit
LOST = 3.0  # change of a logarithm that may mean that a parameter got lost


@dataclass(frozen=True)
class MultipleShooting:
    """Options of the multiple-shooting solver.

    Attributes
    ----------
    every : int, optional
        Samples per interval. By default 50, more on long runs so that there are at most 200 intervals.
    warm : {"data", "model"}
        States at the nodes at the start: from the measured channels, or from a simulation with the starting
        values (after a least-squares fit).
    process_noise : mapping of str to float, optional
        Standard deviation per state and √s (``{"omega": 3.0}``: rad/s per √s); gaps at the nodes are weighed by
        it instead of forbidden. States not named get next to none.
    max_iterations : int
    tol : float
        IPOPT's tolerance on the scaled problem.
    verbose : bool
        Show IPOPT's log.
    """

    every: int | None = None
    warm: str = "data"
    process_noise: Mapping[str, float] | None = None
    max_iterations: int = 300
    tol: float = 1e-9
    verbose: bool = False

    def __post_init__(self) -> None:
        if self.warm not in ("data", "model"):
            raise UsageError(one_of(str(self.warm), ("data", "model"), "warm start"))
        if self.every is not None and (int(self.every) != self.every or self.every < 2):
            raise UsageError(f"MultipleShooting(every=…) takes a whole number of at least 2; got {self.every!r}.")

    def solve(self, problem: Problem) -> Fit:
        """Return the fit of `problem` from the values of its model.

        Without the constraints first, which settles sub-steps and weights; then with them from there.

        Raises
        ------
        UsageError
            A constraint does not go with the model.
        FitError
            The constraints contradict one another or the records; the message names them. Or the model cannot
            be simulated at the start.
        """
        began = time.perf_counter()
        _check(problem)
        done = self._balanced(replace(problem, constraints=()))
        if problem.constraints:
            done = self._refining(replace(done.problem, constraints=problem.constraints), done)
        return fit_of(done, time.perf_counter() - began)

    # -- stages ----------------------------------------------------------------------------------------
    def _balanced(self, problem: Problem) -> Solved:
        """Weigh channels by their misfit where the model fails, as the least-squares fit does."""
        done = self._from_anywhere(problem)
        if problem.balance or problem.weights != "noise" or problem.loss is not None or len(problem.outputs) < 2:
            return done
        for _ in range(3):
            try:
                factors = misfit_over_noise(done.problem, done.q)
            except SimulationError:
                break
            relative = [f / done.problem.balance.get(c, 1.0) for c, f in factors.items()]
            if max(relative) < IMBALANCE * min(relative):
                break
            done = self._refining(done.problem.balanced(factors), done)
        return done

    def _from_anywhere(self, problem: Problem) -> Solved:
        """Solve from the values of the model; from poor ones by way of a fit whose intervals join loosely."""
        if self.process_noise is not None or self.warm == "model" or not _poor(problem):
            return self._refining(problem)
        done = self._loose(problem)
        found = [self._quick(problem, q) for q in _put_back(problem, done.q)]
        best = _cheapest(found)
        # Once the others are right, a parameter that ran off to where nothing depends on it finds its way back.
        best = _cheapest([best, *(self._quick(problem, q) for q in _put_back(problem, best.q)[1:])])
        return self._refining(best.problem, best)

    def _loose(self, problem: Problem) -> Solved:
        """Solve with short intervals that need not join."""
        every, size = LOOSE
        mesh = Mesh(problem.balanced(_blunted(problem)), every)
        step = float(np.median([run.experiment.dt for run in problem.runs]))
        mesh = replace(mesh, noise=size * mesh.scale / np.sqrt(every * step))
        return self._solve(mesh, mesh.joined(problem.start, nodes_from_data(mesh, problem.start)), quick=True)

    def _quick(self, problem: Problem, q: Array) -> Solved:
        """Solve from `q` not very far, with one step per sample: a lost parameter may ask for very many."""
        mesh = Mesh(problem, self.every)
        return self._solve(mesh, mesh.joined(q, self._nodes(mesh, q)), quick=True)

    def _refining(self, problem: Problem, before: Solved | None = None) -> Solved:
        """Solve, refine the sub-steps at the solution, and again while they change."""
        q = problem.start if before is None else before.q
        mesh = Mesh(problem.refined(q), self.every, self._noise(problem))
        z = mesh.joined(q, self._nodes(mesh, q)) if before is None else before.result.z
        done = self._solve(mesh, z, history=() if before is None else before.history)
        for _ in range(ROUNDS - 1):
            finer = done.problem.refined(done.q)
            if all(np.array_equal(a.grid.substeps, b.grid.substeps)
                   for a, b in zip(finer.runs, done.problem.runs, strict=True)):
                break
            done = self._solve(replace(done.mesh, problem=finer), done.result.z, done.result, done.history)
        return done

    def _nodes(self, mesh: Mesh, q: Array) -> Array:
        if self.warm == "data":
            return nodes_from_data(mesh, q)
        try:
            return nodes_from_simulation(mesh, q)
        except SimulationError as error:
            raise FitError(f"the model cannot be simulated at the start: {error} Take warm='data'.") from None

    def _noise(self, problem: Problem) -> Array | None:
        if self.process_noise is None:
            return None
        states = problem.system.states
        for name, value in self.process_noise.items():
            if name not in states:
                raise UsageError(f"process_noise: {one_of(name, states, 'state')}")
            if not value > 0:
                raise UsageError(f"process_noise: '{name}' must be positive, got {value!r}.")
        return np.array([self.process_noise.get(n, 1e-6 * s) for n, s in zip(states, Mesh(problem).scale, strict=True)])

    def _solve(self, mesh: Mesh, z: Array, warm: NlpResult | None = None, history: tuple[float, ...] = (),
               quick: bool = False) -> Solved:
        low, high = mesh.problem.scaling.bounds
        far = np.where(mesh.problem.scaling.log, AWAY if quick else FARTHEST, np.inf)
        low, high = np.maximum(low, z[:mesh.nq] - far), np.minimum(high, z[:mesh.nq] + far)
        free = np.full(len(z) - mesh.nq, np.inf)
        try:
            nlp = ShootingNlp(mesh, z)
        except SimulationError as error:
            raise FitError(f"the model cannot be simulated at the start: {error} Give other starting values with "
                           "model.replace(…), or leave them out.") from None
        most, tol = (min(QUICK, self.max_iterations), 1e-6) if quick else (self.max_iterations, self.tol)
        ipopt = Ipopt(most, tol, self.verbose)
        result = ipopt.solve(nlp, z, (np.concatenate([low, -free]), np.concatenate([high, free])), warm)
        return Solved(mesh, nlp, result, history + result.history)


def _check(problem: Problem) -> None:
    for c in (*problem.constraints, *problem.penalties):
        if not isinstance(c, Relation):
            raise UsageError(f"MultipleShooting takes CurrentLimit, SteadyState and Constraint, not "
                             f"{type(c).__name__}.")
        c.parts(problem)


def _blunted(problem: Problem) -> dict[str, float]:
    """Return factors for the noise of each channel, so that a nearly noise-free one does not rule the loose fit."""
    found: dict[str, float] = {}
    for run in problem.runs:
        for c, sigma in run.sigma.items():
            rms = float(np.sqrt(np.nanmean(run.experiment.outputs[c] ** 2)))
            found[c] = max(found.get(c, 1.0), BLUNT * rms / sigma)
    return found


def _put_back(problem: Problem, q: Array) -> list[Array]:
    """Return `q`, and `q` with the parameters that went very far put back to their start."""
    lost = problem.scaling.log & (np.abs(q - problem.start) > LOST)
    return [q, np.where(lost, problem.start, q)] if lost.any() else [q]


def _cheapest(found: list[Solved]) -> Solved:
    return min([d for d in found if d.status == "converged"] or found, key=lambda d: d.cost)


def _poor(problem: Problem) -> bool:
    """Tell whether the starting values explain less than half of some channel."""
    for k, run in enumerate(problem.runs):
        try:
            y = problem.simulate(problem.start, k, derivatives=False).y
        except SimulationError:
            return True
        for j, c in enumerate(problem.outputs):
            shown = run.experiment.outputs.get(c)
            if shown is not None and not np.nanmean((y[:, j] - shown) ** 2) < POOR**2 * np.nanmean(shown**2):
                return True
    return False


__all__ = ["MultipleShooting"]

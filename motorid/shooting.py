"""Multiple shooting: the fit as a nonlinear program, with true constraints, or with process noise.

The same discrete step as in the least-squares fit. States at nodes are unknowns, so a poor start or a drifting
record does no harm: each short interval begins near the data. At the solution the intervals join, unless process
noise is allowed; then the gaps at the nodes show where the model fails.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from motorid.conflict import conflict
from motorid.descent import integration_error, misfit_over_noise
from motorid.errors import FitError, SimulationError, UsageError, one_of
from motorid.fit import Fit
from motorid.integrate.grid import Array
from motorid.mesh import Mesh
from motorid.multipliers import free_directions, rows_at, summed
from motorid.nlp import Ipopt, NlpResult, ShootingNlp
from motorid.nodes import nodes_from_data, nodes_from_simulation
from motorid.problem import Problem
from motorid.relations import Relation

ROUNDS = 4  # of refining the sub-steps
IMBALANCE = 3.0  # as in the least-squares fit
FARTHEST = 25.0  # change of a logarithm beyond which no physical parameter lies
GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
SAID = {
    "Maximum_Iterations_Exceeded": ("limit", "stopped at the largest number of iterations; raise max_iterations, or "
                                             "start nearer with warm='model' after a least-squares fit"),
    "Infeasible_Problem_Detected": ("failed", "no point keeps all constraints"),
    "Restoration_Failed": ("failed", "the solver could not get back to a point that keeps the constraints; loosen "
                                     "them, or start from a least-squares fit with warm='model'"),
    "Invalid_Number_Detected": ("failed", "the model could not be simulated on the way; bound the parameters with "
                                          "model.bounded(…), or shorten the intervals with every=…"),
}


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
        Standard deviation per state and √s (``{"omega": 3.0}`` rad/s/√s); the states' gaps at the nodes are
        weighed by it instead of forbidden. States not named get next to none.
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
        done = self._staged(problem)
        return _fit_of(done, self, time.perf_counter() - began)

    def _staged(self, problem: Problem) -> _Done:
        """Solve without the constraints, which settles grids and weights, then with them from there."""
        done = self._balanced(replace(problem, constraints=()))
        if not problem.constraints:
            return done
        bound = replace(done.mesh.problem, constraints=problem.constraints)
        return self._refining(bound, done)

    def _balanced(self, problem: Problem) -> _Done:
        """Weigh channels by their misfit where the model fails, as the least-squares fit does."""
        done = self._refining(problem)
        if problem.balance or problem.weights != "noise" or problem.loss is not None or len(problem.outputs) < 2:
            return done
        begin = problem
        for _ in range(3):
            try:
                factors = misfit_over_noise(done.mesh.problem, done.q)
            except SimulationError:
                return done
            relative = [f / done.mesh.problem.balance.get(c, 1.0) for c, f in factors.items()]
            if max(relative) < IMBALANCE * min(relative):
                return done
            done = self._refining(begin.balanced(factors), done)
            begin = done.mesh.problem
        return done

    def _refining(self, problem: Problem, before: _Done | None = None) -> _Done:
        """Solve, refine the sub-steps at the solution, and again while they change."""
        q = problem.start if before is None else before.q
        mesh = Mesh(problem.refined(q), self.every, self._noise(problem))
        z = mesh.joined(q, self._nodes(mesh, q)) if before is None else before.result.z
        done = self._solve(mesh, z)
        for _ in range(ROUNDS - 1):
            finer = done.mesh.problem.refined(done.q)
            if all(np.array_equal(a.grid.substeps, b.grid.substeps)
                   for a, b in zip(finer.runs, done.mesh.problem.runs, strict=True)):
                break
            done = self._solve(replace(done.mesh, problem=finer), done.result.z, done.result, done.history)
        return done

    def _nodes(self, mesh: Mesh, q: Array) -> Array:
        if self.warm == "model":
            try:
                return nodes_from_simulation(mesh, q)
            except SimulationError as error:
                raise FitError(f"the model cannot be simulated at the start: {error} Take warm='data'.") from None
        return nodes_from_data(mesh, q)

    def _noise(self, problem: Problem) -> Array | None:
        if self.process_noise is None:
            return None
        states = problem.system.states
        for name, value in self.process_noise.items():
            if name not in states:
                raise UsageError(f"process_noise: {one_of(name, states, 'state')}")
            if not value > 0:
                raise UsageError(f"process_noise: '{name}' must be positive, got {value!r}.")
        size = Mesh(problem).scale
        return np.array([self.process_noise.get(n, 1e-6 * s) for n, s in zip(states, size, strict=True)])

    def _solve(self, mesh: Mesh, z: Array, warm: NlpResult | None = None, history: tuple[float, ...] = ()) -> _Done:
        low, high = mesh.problem.scaling.bounds
        far = np.where(mesh.problem.scaling.log, FARTHEST, np.inf)
        low, high = np.maximum(low, z[:mesh.nq] - far), np.minimum(high, z[:mesh.nq] + far)
        free = np.full(len(z) - mesh.nq, np.inf)
        try:
            nlp = ShootingNlp(mesh, z)
        except SimulationError as error:
            raise FitError(f"the model cannot be simulated at the start: {error} Give other starting values with "
                           "model.replace(…), or leave them out.") from None
        result = Ipopt(self.max_iterations, self.tol, self.verbose).solve(
            nlp, z, (np.concatenate([low, -free]), np.concatenate([high, free])), warm)
        return _Done(mesh, nlp, result, history + result.history)


@dataclass(frozen=True, eq=False)
class _Done:
    """A solved mesh."""

    mesh: Mesh
    nlp: ShootingNlp
    result: NlpResult
    history: tuple[float, ...] = field(default=())

    @property
    def q(self) -> Array:
        return self.result.z[:self.mesh.nq]


def _check(problem: Problem) -> None:
    for c in (*problem.constraints, *problem.penalties):
        if not isinstance(c, Relation):
            raise UsageError(f"MultipleShooting takes CurrentLimit, SteadyState and Constraint, not "
                             f"{type(c).__name__}.")
        c.parts(problem)


def _fit_of(done: _Done, options: MultipleShooting, seconds: float) -> Fit:
    """Return the `Fit`, or say which constraints are in conflict."""
    problem, q = done.mesh.problem, done.q
    status, message = _verdict(done)
    if status == "failed" and problem.constraints:
        found = conflict(problem, q)
        if found:
            raise FitError(found)
    extra = _extra(done)
    residuals, jac = problem.residual_and_jacobian(q)
    return Fit(problem, problem.values(q), residuals, jac / problem.scaling.slope(q), q, status, message,
               done.history, seconds, integration_error(problem, q), "hard" if problem.constraints else "plain", extra)


def _verdict(done: _Done) -> tuple[str, str]:
    status = done.result.status
    if status in GOOD:
        return "converged", "converged: IPOPT's optimality conditions hold."
    worst = float(np.max(np.maximum(done.nlp.lower - done.nlp.values(done.result.z)[1], 
                                    done.nlp.values(done.result.z)[1] - done.nlp.upper), initial=0.0))
    if status in SAID:
        return SAID[status][0], SAID[status][1] + "."
    if worst < 1e-8:
        return "stalled", (f"stalled ({status}): no step lowers the cost; look at identifiability(), or start "
                           "elsewhere.")
    return "failed", f"IPOPT ended with {status}; the intervals do not join (largest gap {worst:.2g})."


def _extra(done: _Done) -> dict[str, Any]:
    problem, mesh = done.mesh.problem, done.mesh
    walk = mesh.walk(done.result.z, False)
    lam = done.result.lam_g[0 if mesh.noise is not None else mesh.n_nodes * mesh.nx:]
    found, first = [], 0
    collected: dict[int, tuple[Any, Array, Array]] = {}
    for (block, part, rows) in mesh.constraints(walk):
        n = len(rows)
        if id(part) not in collected:
            collected[id(part)] = (part, np.zeros(len(part.lower)), np.zeros(len(part.lower)))
        collected[id(part)][1][rows], collected[id(part)][2][rows] = block.values, lam[first:first + n]
        first += n
    for c in problem.constraints:
        found += [(c.name, *collected[id(part)]) for part in c.parts(problem)]
    totals, rows = summed(found)
    gaps = mesh.gaps(done.result.z, walk, weighed=False)
    extra: dict[str, Any] = {
        "multipliers": totals, "active": rows, "ipopt": done.result.status,
        "largest_gap": max((float(np.abs(b.values).max()) for b in gaps), default=0.0),
    }
    if problem.constraints:
        active = [jac[part.at_limit(values)] for _, part, values, jac in rows_at(problem, done.q)]
        extra["free"] = free_directions(np.concatenate(active), problem.scaling.slope(done.q))
    return extra


__all__ = ["MultipleShooting"]

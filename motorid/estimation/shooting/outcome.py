"""What multiple shooting found, as a `Fit`: status in words, multipliers, gaps, directions left free."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from motorid.errors import FitError
from motorid.estimation.fit import Fit
from motorid.estimation.shooting.conflict import conflict
from motorid.estimation.shooting.gaps import gaps_of, reduced
from motorid.estimation.shooting.mesh import Mesh
from motorid.estimation.shooting.multipliers import free_directions, rows_at, summed, violations
from motorid.estimation.shooting.nlp import NlpResult, ShootingNlp
from motorid.integrate.engine import Array
from motorid.problem.misfit import integration_error
from motorid.problem.problem import Problem
from motorid.problem.relations import Part

GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
JOINED = 1e-8  # violation of a row that counts as kept
SAME = 1e-8  # difference of the scaled cost below which two points are as good
KEPT = "Start_Kept"
SAID = {
    KEPT: ("stalled", "stalled: the interior-point solver found nothing better than the least-squares fit that it "
                      "started from, which is kept; identifiability() shows which parameters cannot be told apart"),

    "Maximum_Iterations_Exceeded": (
        "limit", "stopped at the largest number of iterations; raise max_iterations, or start from a least-squares "
                 "fit: mi.fit(fit.model, …, solver=mi.MultipleShooting(warm='model'))"),
    "Infeasible_Problem_Detected": ("failed", "no point nearby keeps all constraints"),
    "Restoration_Failed": (
        "failed", "the solver could not get back to a point that keeps the constraints; loosen them, or start from "
                  "a least-squares fit with warm='model'"),
    "Invalid_Number_Detected": (
        "failed", "the model could not be simulated on the way; bound the parameters with model.bounded(…), or "
                  "shorten the intervals with every=…"),
}


@dataclass(frozen=True, eq=False)
class Solved:
    """A mesh and where the solver ended on it; `history` holds the costs of all rounds."""

    mesh: Mesh
    nlp: ShootingNlp
    result: NlpResult
    history: tuple[float, ...]

    @property
    def problem(self) -> Problem:
        """The problem, with the sub-steps used."""
        return self.mesh.problem

    @property
    def q(self) -> Array:
        """Solver coordinates."""
        return self.result.z[:self.mesh.nq]

    @property
    def cost(self) -> float:
        """½rᵀr on the mesh."""
        return float(self.nlp.values(self.result.z)[0]) / self.nlp.scale

    def worse_than(self, z: Array) -> bool:
        """Tell whether a point `z` that the intervals join at is better than the end."""
        start = self.nlp.at(z, False)
        if start is None or np.abs(start.g).max(initial=0.0) > JOINED:
            return False
        return self.status != "converged" or (self.cost - start.f) * self.nlp.scale > SAME * max(1, start.f)

    def kept(self, z: Array) -> Solved:
        """Return the start instead of the end."""
        return replace(self, result=self.result._replace(z=z, status=KEPT))

    @property
    def violation(self) -> float:
        """Largest row outside its limits."""
        g = self.nlp.values(self.result.z)[1]
        return float(np.max(np.maximum(self.nlp.lower - g, g - self.nlp.upper), initial=0.0))

    @property
    def status(self) -> str:
        """``"converged"``, ``"stalled"``, ``"limit"`` or ``"failed"``."""
        return self._verdict[0]

    @property
    def message(self) -> str:
        """Why it ended, and what to try."""
        return self._verdict[1] + "."

    @property
    def _verdict(self) -> tuple[str, str]:
        status = self.result.status
        if status in GOOD:
            return "converged", "converged: the optimality conditions hold"
        if status in SAID:
            return SAID[status]
        if self.violation < JOINED:
            return "stalled", f"stalled ({status}): no step lowers the cost; look at identifiability()"
        return "failed", f"failed ({status}): some rows are still off by {self.violation:.2g} of their size"


def fit_of(done: Solved, seconds: float) -> Fit:
    """Return the `Fit`.

    Raises
    ------
    FitError
        If the constraints cannot be kept; the message names those in conflict.
    """
    problem, q = done.problem, done.q
    if done.status == "failed" and problem.constraints:
        found = conflict(problem, q)
        if found:
            raise FitError(found)
    noisy = done.mesh.noise is not None
    residuals, jac = reduced(done.mesh, done.result.z) if noisy else problem.residual_and_jacobian(q)
    name = "process noise" if noisy else "hard" if problem.constraints else "plain"
    return Fit(problem, problem.values(q), residuals, jac / problem.scaling.slope(q), q, done.status, done.message,
               done.history, seconds, integration_error(problem, q), name, _extra(done))


def _extra(done: Solved) -> dict[str, Any]:
    problem, mesh = done.problem, done.mesh
    gaps = gaps_of(mesh, done.result.z)
    extra: dict[str, Any] = {"solver_status": done.result.status, "intervals": len(mesh.intervals),
                             "largest_gap": float(np.max(np.abs(gaps.values / mesh.scale), initial=0.0))}
    if mesh.noise is not None:
        extra |= {"gaps": gaps, "process_noise": dict(zip(problem.system.states, mesh.noise.tolist(), strict=True))}
    if problem.constraints:
        totals, rows = summed(_with_multipliers(done))
        active = [jac[part.at_limit(values)] for _, part, values, jac in rows_at(problem, done.q)]
        extra |= {"multipliers": totals, "active": rows, "violations": violations(problem, done.q),
                  "free": free_directions(np.concatenate(active), problem.scaling.slope(done.q))}
    return extra


def _with_multipliers(done: Solved) -> list[tuple[str, Part, Array, Array]]:
    """Return (constraint, part, rows, multipliers), the NLP's rows put in the order of the parts."""
    mesh, problem = done.mesh, done.problem
    found = mesh.constraints(mesh.walk(done.result.z, False))
    lam = done.result.lam_g[len(done.result.lam_g) - sum(len(rows) for *_, rows in found):]
    collected: dict[int, tuple[Array, Array]] = {}
    first = 0
    for block, part, rows in found:
        values, multipliers = collected.setdefault(id(part), (np.zeros(len(part.lower)), np.zeros(len(part.lower))))
        values[rows], multipliers[rows] = block.values, lam[first:first + len(rows)]
        first += len(rows)
    return [(c.name, part, *collected[id(part)]) for c in problem.constraints for part in c.parts(problem)]


__all__ = ["Solved", "fit_of"]

"""The solution of multiple shooting as a `Fit`: status in words, multipliers, gaps, constraints that cannot be kept."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from motorid.display.numbers import counted
from motorid.errors import FitError, SimulationError
from motorid.estimation.result import Fit
from motorid.estimation.shooting.nlp import Mesh, NlpResult, ShootingNlp, gaps_of, reduced
from motorid.numerics.least_squares import LevenbergMarquardt, levenberg_marquardt
from motorid.numerics.signals import Array
from motorid.problem.constraints import CurrentLimit, Part, SteadyState
from motorid.problem.problem import Problem
from motorid.problem.simulate import integration_error

GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
JOINED = 1e-8  # violation of a row that counts as kept
SAME = 1e-8  # difference of the scaled cost below which two points are as good
WEAK = 1e-6  # share of the largest multiplier below which a row only touches its limit
MISSED = 1e-5  # violation, in sizes of the rows, from which a constraint cannot be kept
AT_LIMIT = 1e-9  # distance of a solver coordinate from a limit of its parameter that is rounding
KEPT = "Start_Kept"
SAID = {
    KEPT: ("stalled", "stalled: the interior-point solver found nothing better than the least-squares fit that it "
                      "started from, which is kept; identifiability() shows which parameters are not determined"),
    "Maximum_Iterations_Exceeded": ("limit", "stopped at the largest number of iterations; raise max_iterations, or "
                                    "start from a least-squares fit: warm='model'"),
    "Infeasible_Problem_Detected": ("failed", "no nearby point satisfies all constraints"),
    "Restoration_Failed": ("failed", "the solver could not return to a point that satisfies the constraints; loosen "
                           "them, or start from a least-squares fit: warm='model'"),
    "Invalid_Number_Detected": ("failed", "the model could not be simulated on the way; bound the parameters with "
                                "model.bounded(…), or shorten the intervals with every=…")}


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
        if np.abs(start.g).max(initial=0.0) > JOINED:
            return False
        return self.verdict[0] != "converged" or (self.cost - start.f) * self.nlp.scale > SAME * max(1, start.f)

    @property
    def verdict(self) -> tuple[str, str]:
        """``"converged"``, ``"stalled"``, ``"limit"`` or ``"failed"``; why it ended, and what to try."""
        if (status := self.result.status) in GOOD:
            return "converged", "converged: the optimality conditions hold"
        if status in SAID:
            return SAID[status]
        g = self.nlp.values(self.result.z)[1]
        off = float(np.max(np.maximum(self.nlp.lower - g, g - self.nlp.upper), initial=0.0))  # at most
        if off < JOINED:
            return "stalled", f"stalled ({status}): no step lowers the cost; look at identifiability()"
        return "failed", f"failed ({status}): some rows are still off by {off:.2g} of their size"


def fit_of(done: Solved, seconds: float) -> Fit:
    """Return the `Fit`; FitError if the constraints cannot be kept, its message names those in conflict."""
    (status, why), problem, q = done.verdict, done.problem, done.q
    if status == "failed" and problem.constraints and (found := contradiction(problem, q)):
        raise FitError(found)
    noisy = done.mesh.noise is not None
    residuals, jac = reduced(done.mesh, done.result.z) if noisy else problem.residual_and_jacobian(q)
    name = "process noise" if noisy else "hard" if problem.constraints else "plain"
    return Fit(problem, problem.values(q), residuals, jac / problem.scaling.slope(q), q, status, f"{why}.",
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
        active = np.concatenate([np.zeros((1, len(done.q))),
                                 *(jac[part.at_limit(c)] for _, part, c, jac in rows_at(problem, done.q))])
        active /= np.maximum(np.linalg.norm(active, axis=1, keepdims=True), 1e-300)
        free = scipy.linalg.null_space(np.linalg.qr(active, mode="r"), rcond=1e-8)  # changes that keep them as they are
        extra |= {"multipliers": totals, "active": rows, "violations": violations(problem, done.q),
                  "free": problem.scaling.slope(done.q)[:, None] * free}
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


@dataclass(frozen=True)
class Multiplier:
    """One constraint at the solution, or one row of it."""

    name: str  # the constraint's
    label: str  # which row, where and when; of a sum over rows: how many are active
    value: float  # −d cost/d limit, cost = ½rᵀr: by how much the cost falls when the limit gives way by one `unit`
    unit: str
    active: int  # rows that stand at their limit

    @property
    def text(self) -> str:
        """The multiplier in words."""
        if not self.active:
            return f"{self.name} is not active: without it the fit would be the same."
        unit = "one unit" if self.unit in ("", "1") else f"1 {self.unit}"
        return (f"{self.name}: {self.label}; relaxing it by {unit} would lower the cost by {self.value:.4g} "
                "(to first order).")


def rows_at(problem: Problem, q: Array, relations: Sequence[Any] | None = None, *,
            derivatives: bool = True) -> list[tuple[str, Part, Array, Array]]:
    """Return (name, part, rows, d rows/dq) of `relations`, by default the problem's constraints, simulated at `q`; no
    columns without `derivatives`. SimulationError if the model cannot be simulated there."""
    point = problem.unknowns.point(q)
    trajs = [problem.simulate(q, k, derivatives=derivatives) for k in range(len(problem.runs))]
    found = []
    for c in problem.constraints if relations is None else relations:
        for part in c.parts(problem):
            x, dx, at = trajs[part.run].x, trajs[part.run].dx, problem.unknowns.of_run(point, part.run)
            rows = part.rows(x[part.samples], at.p, None if dx is None else dx[part.samples], at.dp)
            found.append((c.name, part, *rows))
    return found


def violations(problem: Problem, q: Array, relations: Sequence[Any] | None = None) -> dict[str, float]:
    """Return the largest violation of each relation, beyond its limits, one for each unit that its rows have."""
    found: dict[str, float] = {}
    for name, part, values, _ in rows_at(problem, q, relations):
        beyond = np.abs(part.violation(values)) * part.size
        several = len(set(part.units)) > 1
        for unit in dict.fromkeys(part.units):
            key = f"{name}, {unit}" if several or unit else name
            found[key] = max(found.get(key, 0.0), float(beyond[np.array(part.units) == unit].max(initial=0.0)))
    return found


def steady_residual(problem: Problem, q: Array, relations: Sequence[Any] | None = None) -> float | None:
    """Return the largest balance left over at the measured steady state, relative; None without such a part."""
    rows = [np.abs(values) for name, _, values, _ in rows_at(problem, q, relations) if name == "SteadyState()"]
    return float(np.max(np.concatenate(rows), initial=0.0)) if rows else None


def summed(found: Sequence[tuple[str, Part, Array, Array]]) -> tuple[tuple[Multiplier, ...], tuple[Multiplier, ...]]:
    """Return multipliers per constraint and unit, and per active row, from (name, part, rows, multipliers)."""
    rows: list[Multiplier] = []
    sums: dict[tuple[str, str], tuple[float, int]] = {}
    largest = max((float(np.abs(lam).max(initial=0.0)) for *_, lam in found), default=0.0)
    for name, part, values, lam in found:
        on = part.at_limit(values) & (np.abs(lam) > WEAK * largest)
        rows += [Multiplier(name, part.labels[j], float(abs(lam[j]) / part.size[j]), part.units[j], 1)
                 for j in np.flatnonzero(on)]
        for unit in dict.fromkeys(part.units):
            mine = on & (np.array(part.units) == unit)
            value, active = sums.get((name, unit), (0.0, 0))
            sums[name, unit] = value + float(np.sum(np.abs(lam / part.size)[mine])), active + int(mine.sum())
    labels = {n: f"{counted(n, 'row')} at the limit" if n else "not active" for _, n in sums.values()}
    totals = tuple(Multiplier(name, labels[active], value, unit, active)
                   for (name, unit), (value, active) in sums.items())
    return totals, tuple(sorted(rows, key=lambda m: -m.value))


def below_steady(problem: Problem) -> str | None:
    """Return a sentence if a current limit lies below a current that the records hold steadily, else None."""
    limits = (c for c in problem.constraints if isinstance(c, CurrentLimit))
    if (lowest := min(limits, key=lambda c: c.limit, default=None)) is None:
        return None
    steady = [c for c in problem.constraints if isinstance(c, SteadyState)]
    segments = (steady[0] if steady else SteadyState()).segments(problem)
    for s in sorted(segments, key=lambda s: -abs(s.means.get("i", 0.0))):
        if abs(s.means.get("i", 0.0)) > lowest.limit + 3 * problem.runs[s.run].sigma.get("i", 0.0) / np.sqrt(s.n):
            names = " and ".join(c.name for c in (lowest, *steady[:1]))
            return (f"{names} {'contradict one another' if steady else 'contradicts the records'}: run {s.run} holds "
                    f"{abs(s.means['i']):.4g} A from {s.begin:.4g} to {s.end:.4g} s. Raise the limit above that, or "
                    "leave the run out.")
    return None


def contradiction(problem: Problem, q: Array) -> str | None:
    """Return a sentence naming the constraints that no values near keep together, and by how much; None if all can be.

    At the least sum of squared violations those left push against one another, or against limits; others do not."""
    found = [_least_violations(problem, start) for start in (q, problem.start)]
    if (at := min((f for f in found if f is not None), key=lambda f: f[0], default=None)) is None or at[0] < MISSED:
        return None
    left = [c for c in problem.constraints if np.abs(_violation_rows(problem, [c], at[1], False)[0]).max() >= MISSED]
    beyond = "; ".join(f"{n}: {v:.3g}" for n, v in violations(problem, at[1], left).items() if v)
    low, high = problem.scaling.bounds
    limits = ["the limits of the parameters"] if (np.minimum(at[1] - low, high - at[1]) < AT_LIMIT).any() else []
    names = " and ".join([*(c.name for c in left), *limits])
    why = "contradict one another" if len(left) + len(limits) > 1 else "cannot be kept by any values of the parameters"
    return f"{names} {why}. Beyond its limits at the best compromise: {beyond}. Loosen one, or leave it out."


def _least_violations(problem: Problem, q: Array) -> tuple[float, Array] | None:
    """Return the largest violation and the point at the least sum of squares that is reached from `q`."""
    try:
        found = levenberg_marquardt(lambda z: _violation_rows(problem, problem.constraints, z, False)[0],
                                    lambda z: _violation_rows(problem, problem.constraints, z, True),
                                    q, problem.scaling.bounds, LevenbergMarquardt(max_iterations=60, damping=1e-2))
    except (FitError, SimulationError):
        return None
    return float(np.abs(found.residual).max(initial=0.0)), found.q


def _violation_rows(problem: Problem, relations: Sequence[Any], q: Array, derivatives: bool) -> tuple[Array, Array]:
    """Return violations of all rows, in their sizes, and their Jacobian."""
    found = rows_at(problem, q, relations, derivatives=derivatives)
    beyond = [(part.violation(values), jac) for _, part, values, jac in found]
    return (np.concatenate([np.zeros(1), *(out for out, _ in beyond)]),
            np.concatenate([np.zeros((1, len(q))), *(jac * (out != 0)[:, None] for out, jac in beyond if jac.size)]))

"""What constraints cost: multipliers in physical units, which rows are active, what is left free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from motorid.integrate.engine import Array
from motorid.problem.problem import Problem
from motorid.problem.relations import Part

WEAK = 1e-6  # share of the largest multiplier below which a row only touches its limit


@dataclass(frozen=True)
class Multiplier:
    """One constraint at the solution, or one row of it.

    Attributes
    ----------
    name : str
        The constraint's.
    label : str
        Which row, where and when; of a sum over rows: how many are active.
    value : float
        −d cost/d limit, cost = ½rᵀr, per `unit`: by how much the cost falls when the limit gives way by one unit.
    unit : str
    active : int
        Rows that stand at their limit.
    """

    name: str
    label: str
    value: float
    unit: str
    active: int

    @property
    def text(self) -> str:
        """The multiplier in words."""
        if not self.active:
            return f"{self.name} is not active: without it the fit would be the same."
        unit = "one unit" if self.unit in ("", "1") else f"1 {self.unit}"
        return (f"{self.name}: {self.label}; giving way by {unit} would lower the cost by {self.value:.4g} "
                "(to first order).")


def rows_at(problem: Problem, q: Array,
            relations: Sequence[Any] | None = None) -> list[tuple[str, Part, Array, Array]]:
    """Return (name, part, rows, d rows/dq) of `relations` on the simulated trajectories at `q`.

    `relations` are the problem's constraints unless given.

    Raises
    ------
    SimulationError
    """
    at = problem.unknowns.point(q)
    trajs = [problem.simulate(q, k) for k in range(len(problem.runs))]
    found = []
    for c in problem.constraints if relations is None else relations:
        for part in c.parts(problem):
            traj = trajs[part.run]
            assert traj.dx is not None
            values, jac = part.rows(traj.x[part.samples], at.p, traj.dx[part.samples], at.dp)
            assert jac is not None
            found.append((c.name, part, values, jac))
    return found


def violations(problem: Problem, q: Array, relations: Sequence[Any] | None = None) -> dict[str, float]:
    """Return the largest violation of each relation, beyond its limits, in the unit of its rows.

    Where a relation has rows in several units (voltage and torque), there is one entry for each.
    """
    found: dict[str, float] = {}
    for name, part, values, _ in rows_at(problem, q, relations):
        beyond = np.abs(part.violation(values)) * part.size
        several = len(set(part.units)) > 1
        for unit in dict.fromkeys(part.units):
            key = f"{name}, {unit}" if several or unit else name
            mine = np.array([u == unit for u in part.units])
            found[key] = max(found.get(key, 0.0), float(beyond[mine].max(initial=0.0)))
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
        for j in np.flatnonzero(on):
            rows.append(Multiplier(name, part.labels[j], float(abs(lam[j]) / part.size[j]), part.units[j], 1))
        for unit in dict.fromkeys(part.units):
            mine = on & np.array([u == unit for u in part.units])
            value, active = sums.get((name, unit), (0.0, 0))
            sums[name, unit] = value + float(np.sum(np.abs(lam / part.size)[mine])), active + int(mine.sum())
    totals = tuple(Multiplier(name, _count(active), value, unit, active)
                   for (name, unit), (value, active) in sums.items())
    return totals, tuple(sorted(rows, key=lambda m: -m.value))


def free_directions(jac: Array, slope: Array) -> Array:
    """Return a basis (nq, n) of the physical unknowns' changes that keep active rows (m, nq in q) as they are."""
    if not len(jac):
        return np.diag(slope)
    size = np.maximum(np.linalg.norm(jac, axis=1, keepdims=True), 1e-300)
    _, s, vt = np.linalg.svd(jac / size, full_matrices=True)
    rank = int(np.sum(s > 1e-8))
    return slope[:, None] * vt[rank:].T


def _count(active: int) -> str:
    return "not active" if not active else f"{active} row{'s' if active > 1 else ''} at the limit"


__all__ = ["Multiplier", "free_directions", "rows_at", "steady_residual", "summed", "violations"]

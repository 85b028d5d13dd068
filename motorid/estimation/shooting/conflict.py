"""Which constraints contradict one another: the smallest set that no values of the parameters keep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from motorid.errors import FitError, SimulationError
from motorid.integrate.engine import Array
from motorid.numerics.least_squares import LevenbergMarquardt, levenberg_marquardt
from motorid.problem.constraints import CurrentLimit, SteadyState
from motorid.problem.problem import Problem

KEPT = 1e-5  # largest violation, in sizes of the rows, that counts as kept
LIMITS = "the limits of the parameters"


def conflict(problem: Problem, q: Array) -> str | None:
    """Return a sentence naming the constraints in conflict; None if all can be kept together.

    Each is left out in turn, and stays out when the others still contradict one another (deletion filter,
    Chinneck & Dravnieks, ORSA Journal on Computing 3(2), 1991).
    """
    members: list[Any] = [*problem.constraints]
    low, high = problem.scaling.bounds
    if np.isfinite(low).any() or np.isfinite(high).any():
        members.append(LIMITS)
    starts = (q, problem.start)
    if _possible(problem, members, starts):
        return None
    for member in list(members):
        rest = [m for m in members if m is not member]
        if not _possible(problem, rest, starts):
            members = rest
    names = " and ".join(m if isinstance(m, str) else m.name for m in members)
    if len(members) == 1:
        return f"{names} cannot be kept by any values of the parameters; loosen it or leave it out."
    return (f"{names} contradict one another: each can be kept, not all together. Loosen or leave out one of them.")


def below_steady(problem: Problem) -> str | None:
    """Return a sentence if a current limit lies below a current that the records hold steadily; else None.

    Values that keep such a limit exist, but they describe another motor.
    """
    limits = [c for c in problem.constraints if isinstance(c, CurrentLimit)]
    if not limits:
        return None
    lowest = min(limits, key=lambda c: c.limit)
    steady = [c for c in problem.constraints if isinstance(c, SteadyState)]
    segments = (steady[0] if steady else SteadyState()).segments(problem)
    for s in sorted(segments, key=lambda s: -abs(s.means.get("i", 0.0))):
        noise = 3 * problem.runs[s.run].sigma.get("i", 0.0) / np.sqrt(s.n)
        if abs(s.means.get("i", 0.0)) > lowest.limit + noise:
            names = " and ".join(c.name for c in (lowest, *steady[:1]))
            return (f"{names} {'contradict one another' if steady else 'contradicts the records'}: run {s.run} holds "
                    f"{abs(s.means['i']):.4g} A from {s.begin:.4g} to {s.end:.4g} s. Raise the limit above that, or "
                    "leave the run out.")
    return None


def _possible(problem: Problem, members: Sequence[Any], starts: Sequence[Array]) -> bool:
    return any(_violation(problem, members, q) < KEPT for q in starts)


def _violation(problem: Problem, members: Sequence[Any], q: Array) -> float:
    """Return the smallest reachable violation of `members`, by least squares from `q`."""
    relations = [m for m in members if not isinstance(m, str)]
    bounds = problem.scaling.bounds if LIMITS in members else None
    if not relations:
        return 0.0

    def residual(z: Array) -> Array:
        return _rows(problem, relations, z, False)[0]

    def both(z: Array) -> tuple[Array, Array]:
        return _rows(problem, relations, z, True)

    try:
        found = levenberg_marquardt(residual, both, q, bounds, LevenbergMarquardt(max_iterations=60, damping=1e-2))
    except (FitError, SimulationError):
        return np.inf
    return float(np.abs(found.residual).max(initial=0.0))


def _rows(problem: Problem, relations: Sequence[Any], q: Array, derivatives: bool) -> tuple[Array, Array]:
    trajs = [problem.simulate(q, k, derivatives=derivatives) for k in range(len(problem.runs))]
    at = problem.unknowns.point(q)
    rs, jacs = [np.zeros(1)], [np.zeros((1, len(q)))]
    for part in (part for c in relations for part in c.parts(problem)):
        t, s = trajs[part.run], part.samples
        c, jac = part.rows(t.x[s], at.p, None if t.dx is None else t.dx[s], at.dp)
        out = part.violation(c)
        rs.append(out)
        if jac is not None:
            jacs.append(jac * (out != 0)[:, None])
    return np.concatenate(rs), np.concatenate(jacs)


__all__ = ["below_steady", "conflict"]

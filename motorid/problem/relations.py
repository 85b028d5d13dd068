"""Rows that a fit must respect: functions of state, input and parameters at samples, or their means.

Each relation is used in two ways. As a *penalty* it adds rows to the least-squares residual (`evaluate`); as a
*true constraint* of `MultipleShooting` it keeps rows between limits (`parts`).
"""

import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from motorid.errors import UsageError
from motorid.integrate.engine import Trajectory
from motorid.numerics.signals import Array

NEAR = 1e-6  # of a row's size: so near it stands at its limit


@dataclass(frozen=True, eq=False)
class Part:
    """Rows of one constraint on one run: ``lower ≤ local(x, u, p) ≤ upper`` at each sample, or of their mean."""

    run: int
    local: ca.Function  # ``(x, u, p) -> (c, dc/dx, dc/dp)``, c of shape (nc,), dimensionless
    samples: np.ndarray  # (m,) in ascending order
    averaged: bool  # one row block, the mean over the samples, not one at each
    u: Array  # (m, nu)
    keep: np.ndarray  # (nc,) or (m·nc,) which rows are used
    lower: Array  # (n,) of the rows kept
    upper: Array
    size: Array  # (n,) what one unit of a row is, in `unit`
    weight: Array  # (n,) of the rows as a penalty
    labels: tuple[str, ...]
    units: tuple[str, ...]
    gradient: Array | None = None  # (nx,) dc/dx where the row is this times x and nothing else, which is much faster

    def rows(self, x: Array, p: Array, dx: Array | None, dp: Array) -> tuple[Array, Array]:
        """Return the rows (n,) and d rows/dz (n, nz) at states (m, nx); dx (m, nx, nz) or none, dp (np, nz)."""
        if self.gradient is not None:
            dx = np.zeros((*x.shape, 0)) if dx is None else dx
            return x @ self.gradient, np.einsum("mxz,x->mz", dx, self.gradient)
        m, nc = len(self.samples), self.local.size1_out(0)
        found = self._mapped(x.T, self.u.T, np.tile(np.asarray(p, float)[:, None], (1, m)))
        mean = self._mean(np.asarray(found[0]).T).ravel()[self.keep]
        if dx is None:
            return mean, np.zeros((len(mean), 0))
        cx, cp = (np.asarray(a).reshape(nc, m, -1).transpose(1, 0, 2) for a in found[1:])
        return mean, self._mean(cx @ dx + cp @ dp).reshape(-1, dx.shape[2])[self.keep]

    @cached_property
    def _mapped(self) -> ca.Function:
        return self.local.map(len(self.samples))

    def at_limit(self, c: Array) -> np.ndarray:
        """Tell which rows (n,) stand at one of their limits."""
        return (c >= self.upper - NEAR) | (c <= self.lower + NEAR)

    def violation(self, c: Array) -> Array:
        """Return how far rows lie outside their limits, (n,), dimensionless, with its sign."""
        return np.where(c > self.upper, c - self.upper, np.where(c < self.lower, c - self.lower, 0.0))

    def _mean(self, values: Array) -> Array:
        return np.add.reduceat(values, [0], axis=0) / len(values) if self.averaged else values


class Relation(ABC):
    """What all constraints share: parts once per problem, and their use as penalties."""

    name = ""  # what messages call it

    @abstractmethod
    def _parts(self, problem: Any) -> tuple[Part, ...]:
        """Return the rows on each run of `problem`."""

    def parts(self, problem: Any) -> tuple[Part, ...]:
        """Return the rows on each run of `problem`, made once."""
        made = _made.setdefault(problem, {})
        if id(self) not in made:
            made[id(self)] = (self, self._parts(problem))
        return made[id(self)][1]

    def penalty(self, c: Array, part: Part) -> tuple[Array, Array]:
        """Return residual and slope of rows used as a penalty: what lies outside the limits."""
        out = part.violation(c)
        return part.weight * out, part.weight * (out != 0)

    def evaluate(self, problem: Any, q: Array, trajs: Sequence[Trajectory]) -> tuple[Array, Array | None]:
        """Return the residual (n,) as a penalty and its Jacobian (n, nq), None if the trajectories have none."""
        rs, jacs = [np.zeros(0)], [np.zeros((0, len(q)))]
        derivatives, point = all(t.dx is not None for t in trajs), problem.unknowns.point(q)
        for part in self.parts(problem):
            t, s, at = trajs[part.run], part.samples, problem.unknowns.of_run(point, part.run)
            c, jac = part.rows(t.x[s], at.p, t.dx[s] if derivatives and t.dx is not None else None, at.dp)
            r, slope = self.penalty(c, part)
            rs.append(r)
            jacs.append(slope[:, None] * jac)
        return np.concatenate(rs), np.concatenate(jacs) if derivatives else None


@dataclass(frozen=True, eq=False)
class Weighed(Relation):
    """What lies beyond the limits of another relation, as a penalty of that relation's weight times `factor`."""

    relation: Relation
    factor: float

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        return tuple(replace(part, weight=self.factor * part.weight) for part in self.relation.parts(problem))


_made: weakref.WeakKeyDictionary[Any, dict[int, tuple[Any, tuple[Part, ...]]]] = weakref.WeakKeyDictionary()


def local(system: Any, rows: Callable[..., Any]) -> ca.Function:
    """Return ``(x, u, p) -> (c, dc/dx, dc/dp)`` of the expression `rows`."""
    x, u, p = system.rhs.sx_in()
    c = ca.SX(rows(x, u, p))
    return ca.Function("rows", [x, u, p], [ca.densify(a) for a in (c, ca.jacobian(c, x), ca.jacobian(c, p))])


def share(problem: Any, k: int) -> float:
    """RMS of the measured channels in units of their weights: one where the fit is weighted by the RMS."""
    if problem.weights == "rms":
        return 1.0
    run = problem.runs[k]
    ratios = [float(np.nanmean(run.experiment.outputs[c] ** 2)) / run.sigma[c] ** 2 for c in run.sigma]
    return float(np.sqrt(np.mean(ratios))) if ratios else 1.0


def check_weight(weight: float, what: str) -> None:
    """Refuse a weight that is negative or not finite."""
    if not (np.isfinite(weight) and weight >= 0):
        raise UsageError(f"{what}: the weight must be at least 0; got {weight!r}.")

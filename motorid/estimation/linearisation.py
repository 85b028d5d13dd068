"""How the fitted model answers to an unknown voltage and an unknown torque, sample by sample.

Along the model's own trajectory, ``δx⁺ = A δx + B d`` and ``δy = C δx`` with d = (voltage, torque) held over a sample.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy

from motorid.estimation.result import Fit
from motorid.integrate.engine import Grid
from motorid.integrate.rodas3 import rosenbrock_step
from motorid.model.equations import System
from motorid.numerics.signals import Array
from motorid.problem.runs import natural_sizes


@dataclass(frozen=True, eq=False)
class Response:
    """Linear response of one run."""

    a: Array  # (N-1, nx, nx)
    b: Array  # (N-1, nx, 2), to a voltage (V) and a torque (N·m) held over the sample
    c: Array  # (N, ny, nx)
    states: dict[str, Array]

    def driven(self, pushes: Array) -> Array:
        """Return the outputs (N, ny, m) to m histories of `pushes` (m, N-1, nx) on the states at each sample's end."""
        m, n, nx = pushes.shape
        right = np.zeros((m, n + 1, nx))
        right[:, 1:] = pushes
        solved = self._solved(right.reshape(m, -1).T).T.reshape(m, n + 1, nx)
        return np.einsum("nyx,mnx->nym", self.c, solved, optimize=True)

    def pulled(self, weights: Array) -> Array:
        """Return by how much a push on each state at each sample's end (N-1, nx) moves outputs of `weights` (N, ny)."""
        right = np.einsum("nyx,ny->nx", self.c, weights)
        return self._solved(right.reshape(-1, 1), trans="T").reshape(right.shape)[1:]

    def _solved(self, right: Array, **options: str) -> Array:
        solve = scipy.linalg.get_lapack_funcs("tbtrs")  # triangular, banded: SciPy has no other name for it
        return np.asarray(solve(self._band, right, uplo="L", diag="U", overwrite_b=True, **options)[0])

    @cached_property
    def _band(self) -> Array:
        """The matrix of x⁺ − A x = pushes over all samples, lower bands (2 nx, N nx), its diagonal left out."""
        n, nx, _ = self.a.shape
        band = np.zeros((2 * nx, (n + 1) * nx), order="F")
        for r, c in np.ndindex(nx, nx):
            band[nx + r - c, c : n * nx : nx] = -self.a[:, r, c]
        return band


@lru_cache(maxsize=64)
def _disturbed(system: System) -> tuple[ca.Function, ca.Function]:
    nx, nu, np_, _ = system.sizes
    x, u0, u1 = ca.SX.sym("x", nx), ca.SX.sym("u0", nu), ca.SX.sym("u1", nu)
    h, p, d = ca.SX.sym("h"), ca.SX.sym("p", np_), ca.SX.sym("d", 2)
    wider = replace(system, rhs=ca.Function("rhs", [x, ca.vertcat(u0, d), p], [system.forces(x, u0, p, d)]))
    x_next, _ = rosenbrock_step(wider, x, ca.vertcat(u0, d), ca.vertcat(u1, d), h, p)
    results = [x_next, ca.jacobian(x_next, x), ca.jacobian(x_next, d)]
    step = ca.Function("disturbed", [x, u0, u1, h, p, d], ca.cse([ca.densify(r) for r in results]))
    y = system.out(x, u0, p)
    return step, ca.Function("shown", [x, u0, p], [ca.densify(y), ca.densify(ca.jacobian(y, x))])


@lru_cache(maxsize=64)
def _mapped(system: System, n: int) -> tuple[ca.Function, ca.Function]:
    """Return step and outputs for `n` samples at once."""
    step, out = _disturbed(system)
    return step.map(n), out.map(n)


def linear_steps(system: System, grid: Grid, x: Array, p: Array, d: Array) -> tuple[Array, Array, Array]:
    """Return what one sample makes of the next, (x⁺, A, B), in the grid's sub-steps; `d` (N-1, 2), `x` (N, nx)."""
    n, nx, m = len(grid.dt), len(system.states), grid.substeps
    end, a, b = x[:-1].copy(), np.tile(np.eye(nx), (n, 1, 1)), np.zeros((n, nx, 2))
    for j in range(int(m.max())):
        rows = np.flatnonzero(m > j)
        slope = (grid.u1[rows] - grid.u0[rows]) / m[rows, None]
        u, h = grid.u0[rows] + j * slope, grid.dt[rows] / m[rows]
        end[rows], aj, bj = _steps(system, end[rows], u, u + slope, h, p, d[rows])
        a[rows], b[rows] = aj @ a[rows], aj @ b[rows] + bj
    return end, a, b


def _steps(system: System, x: Array, u0: Array, u1: Array, h: Array, p: Array, d: Array) -> tuple[Array, Array, Array]:
    """Return one step from every row, (x⁺, A, B)."""
    n, nx = x.shape
    size = 1 << (n - 1).bit_length()  # few sizes, so few functions
    rows = np.minimum(np.arange(size), n - 1)
    ps = np.tile(p[:, None], (1, size))
    x_next, a, b = _mapped(system, size)[0](x[rows].T, u0[rows].T, u1[rows].T, h[None, rows], ps, d[rows].T)
    return (np.asarray(x_next).T[:n], np.asarray(a).reshape(nx, size, nx).transpose(1, 0, 2)[:n],
            np.asarray(b).reshape(nx, size, 2).transpose(1, 0, 2)[:n])


@lru_cache(maxsize=64)
def _plain_outputs(system: System) -> bool:
    """Tell whether the outputs are a constant mixture of the states: no need to ask at every sample."""
    _, out = _disturbed(system)
    x, u, p = out.sx_in()
    y, c = out(x, u, p)
    return not (ca.depends_on(c, ca.vertcat(x, u)) or ca.depends_on(y, u))


def shown(system: System, grid, x: Array, p: Array) -> tuple[Array, Array]:
    """Return (y, C) at every sample."""
    n, (nx, _, _, ny) = len(x), system.sizes
    if _plain_outputs(system):
        y0, c0 = (np.asarray(a) for a in _disturbed(system)[1](np.zeros(nx), grid.u[0], p))
        return x @ c0.T + y0.ravel(), np.tile(c0, (n, 1, 1))
    y, c = _mapped(system, n)[1](x.T, grid.u.T, np.tile(p[:, None], (1, n)))
    return np.asarray(y).T, np.asarray(c).reshape(ny, n, nx).transpose(1, 0, 2)


def parameter_vector(fit: Fit, k: int) -> Array:
    """Return the system's p of a fit on its run `k`."""
    unknowns = fit.problem.unknowns
    return unknowns.of_run(unknowns.point(fit.q), k).p


@lru_cache(maxsize=4)
def responses(fit: Fit) -> list[Response]:
    """Return the linear response of every run of `fit`."""
    problem, found = fit.problem, []
    for k, (run, sim) in enumerate(zip(problem.runs, fit.simulations, strict=True)):
        x, p = np.column_stack([sim.states[s] for s in problem.system.states]), parameter_vector(fit, k)
        _, a, b = linear_steps(problem.system, run.grid, x, p, np.zeros((len(x) - 1, 2)))
        _, c = shown(problem.system, run.grid, x, p)
        found.append(Response(a, b, c, dict(sim.states)))
    return found


SHARED = 0.1  # of the largest share in a combination that is worth a name
INSEPARABLE = 1e-3  # share of an effect's answer that the fitted parameters do not make up together


def column_space(columns: Array) -> Array:
    """Return an orthonormal basis (n, r) of what `columns` (n, k) span, singular directions left out."""
    q, triangle = np.linalg.qr(columns)
    u, s, _ = np.linalg.svd(triangle)
    return q @ u[:, s > 1e-7 * max(s.max(initial=0.0), 1e-300)]


class Explained(NamedTuple):
    """Share of chi² explained, the coefficients (k,), and what is left of the residual (n,)."""

    share: float
    coefficients: Array
    left: Array


@dataclass(frozen=True, eq=False)
class Tangent:
    """Residual of a fit off the tangent space of its unknowns."""

    fit: Fit
    basis: Array
    residual: Array
    sizes: Mapping[str, float]

    @staticmethod
    @lru_cache(maxsize=4)  # what is cached by a tangent, as the spectrum of orders, is found again
    def of(fit: Fit) -> "Tangent":
        """Return the tangent space of `fit`, singular directions left out."""
        jac, r = (a[: fit.problem.n_outputs] for a in (fit.jacobian, fit.residuals))
        norms = np.linalg.norm(jac, axis=0)
        basis = column_space(jac / np.where(norms > 0, norms, 1.0))
        return Tangent(fit, basis, r - basis @ (basis.T @ r), natural_sizes(fit.problem.experiments, fit.values))

    @property
    def chi2(self) -> float:
        """Sum of squares of the residuals of the outputs."""
        r = self.fit.residuals[: len(self.residual)]
        return float(r @ r)

    def off(self, columns: Array) -> Array:
        """Return `columns` (n, k) projected off the tangent space."""
        return columns - self.basis @ (self.basis.T @ columns)

    def explained(self, columns: Array, nonnegative: Sequence[bool]) -> Explained:
        """Return what `columns` (n, k) explain of the residual, those coefficients not negative that must not be."""
        c = self.off(columns)
        norms = np.linalg.norm(c, axis=0)
        usable = norms > 1e-6 * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        scale = np.where(usable, norms, 1.0)
        c = np.where(usable, c / scale, 0.0)
        signed = [j for j, positive in enumerate(nonnegative) if not positive]
        triangle = np.linalg.qr(np.column_stack([c, -c[:, signed], -self.residual]), mode="r")
        z, rest = scipy.optimize.nnls(np.asarray(triangle)[:, :-1], np.asarray(triangle)[:, -1])
        coefficients = z[: c.shape[1]].copy()
        coefficients[signed] -= z[c.shape[1] :]
        inside = float(self.residual @ self.residual)
        left = self.residual + c @ coefficients
        return Explained(max(inside - rest**2, 0.0) / max(self.chi2, 1e-300), coefficients / scale, left)

    def same_as(self, columns: Array, but_for: float = INSEPARABLE) -> tuple[str, ...]:
        """Return the parameters that together make up `columns` (n, k) but for a share; none if more is left."""
        size = np.linalg.norm(columns, axis=0)
        if np.any(np.linalg.norm(self.off(columns), axis=0) > but_for * size) or not size.all():
            return ()
        names = [p.name for p in self.fit.problem.unknown]
        jac = self.fit.jacobian[: len(columns)]
        norms = np.linalg.norm(jac, axis=0)
        parts = np.linalg.lstsq(jac / np.where(norms > 0, norms, 1.0), columns / size, rcond=1e-7)[0]
        part = {n: float(np.abs(a).max()) for n, a in zip(names, parts, strict=True) if n in self.fit.values}
        return tuple(n for n, a in part.items() if a > SHARED * max(part.values()))

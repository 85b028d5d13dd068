"""The discrete model walked over a record by CasADi's virtual machine: the same numbers as compiled, slower.

Steps are taken in chunks by one function, on buffers laid out so that nothing is copied between chunks.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from motorid.integrate.engine import Array, Grid, Trajectory
from motorid.integrate.rodas3 import StepFunctions

CHUNK = 256


class Machine:
    """Walks and observations of one system, over `CHUNK` steps at a time, made when first needed."""

    def __init__(self, functions: StepFunctions) -> None:
        self.functions = functions
        self.nx, self.nu, self.np = (functions.full.size1_in(k) for k in (0, 1, 4))
        self.ny = functions.out.size1_out(0)
        self.walk_of = lru_cache(maxsize=32)(self._walk)
        self.observation_of = lru_cache(maxsize=2)(self._observation)

    def _walk(self, nq: int) -> ca.Function:
        """Return CHUNK steps in a row; sensitivities go transposed, so that time comes first in memory."""
        x, s = ca.SX.sym("x", self.nx), ca.SX.sym("S", nq, self.nx)
        u0, u1, h = ca.SX.sym("u0", self.nu), ca.SX.sym("u1", self.nu), ca.SX.sym("h")
        p, dp = ca.SX.sym("p", self.np), ca.SX.sym("dp", nq, self.np)
        if nq:
            x_next, e, a, b = self.functions.full(x, u0, u1, h, p)
            one = ca.Function("one", [x, s, u0, u1, h, p, dp], [x_next, ca.densify(s @ a.T + dp @ b.T), e])
            return one.mapaccum("walk", CHUNK, 2, {})
        one = ca.Function("one", [x, u0, u1, h, p], list(self.functions.light(x, u0, u1, h, p)))
        return one.mapaccum("walk", CHUNK, 1, {})

    def _observation(self, derivatives: bool) -> ca.Function:
        x, u, p = ca.SX.sym("x", self.nx), ca.SX.sym("u", self.nu), ca.SX.sym("p", self.np)
        y, c, d = self.functions.out(x, u, p)
        return ca.Function("seen", [x, u, p], [y, c.T, d.T] if derivatives else [y]).map(CHUNK)

    def run(self, grid: Grid, x0: Array, p: Array, dx0: Array | None, dp: Array | None,
            local_error: bool) -> Trajectory:
        """Return the trajectory; see `Engine.run`."""
        nq = 0 if dp is None or dx0 is None else dp.shape[1]
        ua, ub, h, ends = _laid_out(grid)
        n = len(h)
        x, s, e = np.empty((n + 1, self.nx)), np.empty((n + 1, self.nx, nq)), np.empty((n, self.nx))
        x[0] = x0
        steady = [_repeated(p)]
        if dp is not None:
            s[0] = dx0
            steady.append(_repeated(dp))  # column-major (nq, np) is dp itself
        walk, trigger = _buffer(self.walk_of(nq))
        for k, a in enumerate(steady):
            walk.set_arg(k + (5 if nq else 4), _view(a))
        for a in range(0, n, CHUNK):
            here, there = slice(a, a + CHUNK), slice(a + 1, a + 1 + CHUNK)
            gone = [x[a], s[a], ua[here], ub[here], h[here]] if nq else [x[a], ua[here], ub[here], h[here]]
            for k, part in enumerate(gone):
                walk.set_arg(k, _view(part))
            for k, part in enumerate([x[there], s[there], e[here]] if nq else [x[there], e[here]]):
                walk.set_res(k, _view(part))
            trigger()
        error = np.maximum.reduceat(np.abs(e), ends[:-1]) if local_error else None
        y, dy = self.observe(grid, x[ends], s[ends] if nq else None, p, dp)
        return Trajectory(y, dy, x[ends], s[ends] if nq else None, error)

    def observe(self, grid: Grid, x: Array, dx: Array | None, p: Array,
                dp: Array | None) -> tuple[Array, Array | None]:
        """Return what the sensors show along a state trajectory, y (N, ny) and dy/dq (N, ny, nq)."""
        n = len(x)
        full = -(-n // CHUNK) * CHUNK
        x_all, u_all, p_all = _padded(x, full), _padded(grid.u, full), _repeated(p)
        shapes = [(self.ny,), (self.ny, self.nx), (self.ny, self.np)][:1 if dx is None else 3]
        results = [np.empty((full, *shape)) for shape in shapes]
        seen, trigger = _buffer(self.observation_of(dx is not None))
        seen.set_arg(2, _view(p_all))
        for a in range(0, full, CHUNK):
            here = slice(a, a + CHUNK)
            seen.set_arg(0, _view(x_all[here]))
            seen.set_arg(1, _view(u_all[here]))
            for k, r in enumerate(results):
                seen.set_res(k, _view(r[here]))
            trigger()
        if dx is None or dp is None:
            return results[0][:n], None
        y, c, d = (r[:n] for r in results)
        dy = (d.reshape(-1, self.np) @ dp).reshape(n, self.ny, -1)
        with np.errstate(all="ignore"):  # a run that left the finite numbers is reported by its states
            for j in range(self.nx):  # NumPy's product of many small matrices is slower by far
                dy += c[:, :, j, None] * dx[:, None, j, :]
        return y, dy


def _laid_out(grid: Grid) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Return the input at both ends and the length of each sub-step, in whole chunks; and samples' places."""
    m = grid.substeps
    ends = np.concatenate([[0], np.cumsum(m)])
    steps = int(ends[-1])
    part, share = np.arange(steps) - np.repeat(ends[:-1], m), 1.0 / np.repeat(m, m)
    slope = np.repeat(grid.u1 - grid.u0, m, axis=0) * share[:, None]
    ua = np.repeat(grid.u0, m, axis=0) + slope * part[:, None]
    full = -(-steps // CHUNK) * CHUNK
    h = np.repeat(grid.dt, m) * share
    return _padded(ua, full), _padded(ua + slope, full), _padded(h, full), ends


def _padded(a: Array, n: int) -> Array:
    """Return `a` with its last row repeated up to `n` rows; results for those are not used."""
    return np.ascontiguousarray(np.concatenate([a, np.repeat(a[-1:], n - len(a), axis=0)]))


def _buffer(f: ca.Function) -> Any:
    return f.buffer()


def _view(a: Array) -> Any:
    """Return the memory of the contiguous array `a`, for CasADi."""
    flat: Any = a.reshape(-1)
    return memoryview(flat)


def _repeated(a: Array) -> Array:
    return np.tile(a.reshape(-1), CHUNK)

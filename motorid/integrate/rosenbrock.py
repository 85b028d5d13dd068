"""The default engine: fixed Rosenbrock sub-steps per sample, compiled where a C compiler is there."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from motorid.errors import SimulationError
from motorid.integrate import compile as cc
from motorid.integrate.grid import Array, Grid, Trajectory
from motorid.integrate.step import ERROR_ORDER, StepFunctions, step_functions
from motorid.system import System

CHUNK = 256
PATIENCE = 0.15  # s in the virtual machine before a step is worth compiling
MOST_SUBSTEPS = 256


@dataclass(frozen=True)
class Rosenbrock:
    """RODAS3 with sub-steps chosen by its error estimate, the exact derivative of the discrete step carried along.

    Attributes
    ----------
    compiled : bool or None
        None: compile once a model has used the virtual machine for a moment; True: at once; False: never.
    """

    compiled: bool | None = None
    name: str = "rosenbrock"

    def run(self, system: System, grid: Grid, x0: Array, p: Array, dx0: Array | None = None, dp: Array | None = None,
            xscale: Array | None = None) -> Trajectory:
        """See `Engine.run`; with `xscale` (nx,) the local error relative to it is returned too."""
        return stepper(system).run(grid, x0, p, dx0, dp, xscale, self.compiled)

    def prepare(self, system: System, grid: Grid, x0: Array, p: Array, tolerance: float) -> Grid:
        """See `Engine.prepare`. The scale of each state is its largest size on the record."""
        scale = None
        for _ in range(6):
            if scale is None:
                x = self.run(system, grid, x0, p).x
                scale = np.maximum(np.abs(x).max(axis=0), 1e-12)
            error = self.run(system, grid, x0, p, xscale=scale).error
            assert error is not None
            if not np.all(np.isfinite(error)) or np.max(error, initial=0.0) <= 2 * tolerance:
                break
            factor = np.ceil(1.1 * (np.maximum(error, 1e-300) / tolerance) ** (1 / ERROR_ORDER))
            finer = np.clip(grid.substeps * np.clip(factor, 1, 16), 1, MOST_SUBSTEPS).astype(np.int64)
            if np.array_equal(finer, grid.substeps):
                break
            grid = grid.with_substeps(finer)
        return grid


class Stepper:
    """One system's step, in the virtual machine first and compiled when it pays."""

    def __init__(self, system: System, key: str) -> None:
        self.key = key
        self.functions: StepFunctions = step_functions(system)
        self.nx, self.nu, self.np, self.ny = system.sizes
        self._library: Any = None
        self._refused = False
        self._spent = 0.0
        self._machines: dict[int, ca.Function] = {}

    def run(self, grid: Grid, x0: Array, p: Array, dx0: Array | None, dp: Array | None, xscale: Array | None,
            compiled: bool | None) -> Trajectory:
        """Walk over the record; see `Engine.run`."""
        library = self._load(compiled)
        walk = self._run_compiled if library is not None else self._run_machine
        began = time.perf_counter()
        nq = 0 if dp is None else dp.shape[1]
        traj, bad = walk(grid, np.ascontiguousarray(x0, float), np.ascontiguousarray(p, float), nq,
                         None if dx0 is None else np.ascontiguousarray(dx0, float),
                         None if dp is None else np.ascontiguousarray(dp, float), xscale)
        if library is None:
            self._spent += time.perf_counter() - began
        if bad >= 0:
            raise SimulationError(f"the simulation left the finite numbers at t = {grid.t[bad]:.6g} s; the parameters "
                                  "make the model unstable or stiff beyond the step.")
        return traj

    def _load(self, compiled: bool | None) -> Any:
        if compiled is False or self._refused:
            return None
        if self._library is None:
            path = cc.library_path(self.key)
            if path is None:
                self._refused = True
                cc.say_once("motorid: no C compiler found; using CasADi's virtual machine, same results, slower.")
                return None
            if path.exists() or compiled or self._spent > PATIENCE:
                if not path.exists() and not cc.build(self.functions, path):
                    self._refused = True
                    return None
                self._library = cc.load(path)
        return self._library

    def _run_compiled(self, grid, x0, p, nq, dx0, dp, xscale) -> tuple[Trajectory, int]:
        n = len(grid.t)
        dt = grid.dt
        y, x = np.empty((n, self.ny)), np.empty((n, self.nx))
        dy, dx = (np.empty((n, self.ny, nq)), np.empty((n, self.nx, nq))) if nq else (None, None)
        error = np.zeros(n - 1) if xscale is not None else None
        arrays = (grid.substeps, dt, grid.u0, grid.u1, grid.u, x0, xscale, p)
        bad = self._library(n, *(_address(a) for a in arrays), nq,
                            *(_address(a) for a in (dx0, dp, y, dy, x, dx, error)))
        return Trajectory(y, dy, x, dx, error), int(bad)

    def _machine(self, nq: int) -> ca.Function:
        """Return CHUNK steps in a row as one function of the virtual machine."""
        if nq not in self._machines:
            f = self.functions
            x, s = ca.SX.sym("x", self.nx), ca.SX.sym("S", self.nx, nq)
            u0, u1, h = ca.SX.sym("u0", self.nu), ca.SX.sym("u1", self.nu), ca.SX.sym("h")
            p, dp = ca.SX.sym("p", self.np), ca.SX.sym("Pq", self.np, nq)
            if nq:
                x_next, e, a, b = f.full(x, u0, u1, h, p)
                args, results = [x, s, u0, u1, h, p, dp], [x_next, a @ s + b @ dp, e]
            else:
                args, results = [x, u0, u1, h, p], list(f.light(x, u0, u1, h, p))
            one = ca.Function("one", args, results)
            self._machines[nq] = one.mapaccum("walk", CHUNK, 2 if nq else 1, {})
        return self._machines[nq]

    def _run_machine(self, grid, x0, p, nq, dx0, dp, xscale) -> tuple[Trajectory, int]:
        m = grid.substeps
        ends = np.concatenate([[0], np.cumsum(m)])
        steps = int(ends[-1])
        part = np.arange(steps) - np.repeat(ends[:-1], m)
        slope = np.repeat(grid.u1 - grid.u0, m, axis=0)
        share = 1.0 / np.repeat(m, m)
        ua = np.repeat(grid.u0, m, axis=0) + slope * (part * share)[:, None]
        ub = ua + slope * share[:, None]
        h = np.repeat(grid.dt, m) * share
        xs, ss, es = np.empty((steps + 1, self.nx)), np.empty((steps + 1, self.nx, nq)), np.empty((steps, self.nx))
        xs[0] = x0
        if nq:
            ss[0] = dx0
        walk = self._machine(nq)
        p_all, dp_all = np.tile(p[:, None], (1, CHUNK)), np.tile(dp, (1, CHUNK)) if nq else None
        for a in range(0, steps, CHUNK):
            b = min(a + CHUNK, steps)
            pick = np.minimum(np.arange(a, a + CHUNK), steps - 1)  # the tail repeats the last step, unused
            drive = (ua[pick].T, ub[pick].T, h[pick][None, :], p_all)
            if nq:
                xn, sn, e = walk(xs[a], ss[a], *drive, dp_all)
                ss[a + 1:b + 1] = np.asarray(sn).T.reshape(CHUNK, nq, self.nx).transpose(0, 2, 1)[:b - a]
            else:
                xn, e = walk(xs[a], *drive)
            xs[a + 1:b + 1], es[a:b] = np.asarray(xn).T[:b - a], np.asarray(e).T[:b - a]
        return self.observe(grid, xs[ends], ss[ends] if nq else None, p, dp, es, xscale, ends)

    def observe(self, grid, x, dx, p, dp, es, xscale, ends) -> tuple[Trajectory, int]:
        n = len(x)
        finite = np.isfinite(x).all(axis=1)
        bad = -1 if finite.all() else int(np.argmin(finite))
        y, c, d = (np.asarray(a) for a in self.functions.out.map(n)(x.T, grid.u.T, np.tile(p[:, None], (1, n))))
        dy = None
        if dx is not None:
            c = c.reshape(self.ny, n, self.nx).transpose(1, 0, 2)
            d = d.reshape(self.ny, n, self.np).transpose(1, 0, 2)
            dy = c @ dx + d @ dp
        error = None
        if xscale is not None:
            error = np.maximum.reduceat(np.abs(es / xscale).max(axis=1), ends[:-1])
        return Trajectory(y.T.copy(), dy, x, dx, error), bad


def _address(a: np.ndarray | None) -> int | None:
    return None if a is None else a.ctypes.data


def content_key(system: System) -> str:
    """Return a hash of the equations of `system`."""
    text = "\0".join([system.rhs.serialize(), system.out.serialize(), str(system.stored)])
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


_steppers: dict[int, tuple[System, Stepper]] = {}


@lru_cache(maxsize=512)
def _stepper_of_content(key: str) -> list[Stepper]:
    return []


def stepper(system: System) -> Stepper:
    """Return the stepper of `system`, one per content in this process."""
    known = _steppers.get(id(system))
    if known is None or known[0] is not system:
        key = content_key(system)
        slot = _stepper_of_content(key)
        if not slot:
            slot.append(Stepper(system, key))
        if len(_steppers) > 1024:
            _steppers.clear()
        known = _steppers[id(system)] = (system, slot[0])
    return known[1]

"""CVODES and IDAS through CasADi: the reference engines, with forward sensitivities.

A call never spans a jump of the input (CVODES stops there): the record is cut where the input changes. Parts of evenly
spaced samples under one constant input are walked in one go over scaled time, by the next larger of a few integrators
(2, 3, 4, 6, 8, 12 … samples), which serve every record. Derivatives are taken in forward mode, over scaled states;
without `quad_err_con` CasADi's CVODES interface can return wrong ones silently (casadi issue 4383)."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from motorid.errors import ModelError, SimulationError, otherwise, positive
from motorid.integrate.engine import Engine, Grid, Trajectory
from motorid.integrate.rosenbrock import Rosenbrock, Stepper, stepper
from motorid.model.equations import System
from motorid.numerics.signals import Array

NOT_FINITE = "numbers no longer finite"
REASONS = ("CV_ERR_FAILURE", "CV_CONV_FAILURE", "CV_TOO_MUCH_WORK", "IDA_ERR_FAIL", "IDA_CONV_FAIL",
           "IDA_TOO_MUCH_WORK", NOT_FINITE)
LENGTHS = sorted([1 << k for k in range(12)] + [3 << k for k in range(10)])  # samples per call


@dataclass(frozen=True)
class _Sundials(Engine):
    rtol: float = 1e-8
    atol: float = 1e-10

    name = "sundials"

    def __post_init__(self) -> None:
        positive(rtol=self.rtol, atol=self.atol)

    def run(self, system: System, grid: Grid, x0: Array, p: Array, dx0: Array | None = None,
            dp: Array | None = None) -> Trajectory:
        """See `Engine.run`."""
        nx, nq = len(system.states), 0 if dp is None else dp.shape[1]
        rough = Rosenbrock()  # tolerances are relative to the sizes of states
        size = otherwise(np.abs(x0), SimulationError, lambda: np.abs(
            rough.run(system, rough.prepare(system, grid, x0, p, 1e-2), x0, p).x).max(axis=0))
        scale = np.where((size > 1e-12) & np.isfinite(size), size, 1.0)
        x, dx = np.empty((len(grid.t), nx)), np.empty((len(grid.t), nx, nq))
        x[0] = x0
        if nq:
            dx[0] = dx0
        integrators = _integrators(self.name, self.rtol, self.atol, stepper(system), nq)
        for first, count in _pieces(grid):
            self._walk(integrators, grid, first, count, x, dx, p, dp, scale)
        y, dy = stepper(system).machine.observe(grid, x, dx if nq else None, p, dp)
        return Trajectory(y, dy, x, dx if nq else None, None)

    def _walk(self, integrators: "_Integrators", grid: Grid, first: int, count: int, *rest: Any) -> None:
        x = rest[0]
        try:
            integrators.walk(grid, first, count, *rest)
            if not np.isfinite(x[first + 1:first + count + 1]).all():
                raise RuntimeError(NOT_FINITE)
        except RuntimeError as error:
            if count not in LENGTHS:  # it may have stopped beyond the end of the piece
                part = max(n for n in LENGTHS if n < count)
                self._walk(integrators, grid, first, part, *rest)
                self._walk(integrators, grid, first + part, count - part, *rest)
                return
            reason = next((w for w in REASONS if w in str(error)), "no convergence")
            raise SimulationError(f"{self.name} stopped after t = {grid.t[first]:.6g} s ({reason}). Try "
                                  "engine='rosenbrock', or parameters nearer to the motor's.") from None


@dataclass(frozen=True)
class Cvodes(_Sundials):
    """SUNDIALS CVODES (Hindmarsh et al., ACM TOMS 31(3), 2005): stiff ODEs, variable-order BDF.

    Examples
    --------
    >>> sharp = mi.simulate(fit.model, runs[0].select(slice(100)), engine=mi.Cvodes(rtol=1e-10))
    """

    name = "cvodes"


@dataclass(frozen=True)
class Idas(_Sundials):
    """SUNDIALS IDAS: differential-algebraic systems, variable-order BDF.

    Examples
    --------
    >>> sharp = mi.simulate(fit.model, runs[0].select(slice(100)), engine=mi.Idas())
    """

    name = "idas"


class _Integrators:
    """Integrators of one system over 2^k steps of length h, made when first needed."""

    def __init__(self, plugin: str, rtol: float, atol: float, step: Stepper, nq: int) -> None:
        system = step.system
        if plugin == "cvodes" and not all(system.stored):
            raise ModelError("cvodes integrates differential equations only, and this model has an algebraic "
                             "balance (no inductance). Use engine='idas' or engine='rosenbrock'.")
        self.system, self.plugin, self.nq = system, plugin, nq
        # Without second-order correction Newton's matrix is one block for all sensitivities: exact too, faster;
        # CasADi cannot do so with algebraic states.
        self.options = {"reltol": rtol, "abstol": atol, "quad_err_con": True, "max_num_steps": 100000,
                        "second_order_correction": not all(system.stored)}
        self.stored = np.array(system.stored)
        self.integrator_of = lru_cache(maxsize=None)(self._integrator)

    def _integrator(self, count: int) -> tuple[ca.Function, ca.Function | None]:
        nx, nu, np_, _ = self.system.sizes
        z, theta = ca.SX.sym("z", nx), ca.SX.sym("theta", np_ + 2 * nu + 1 + nx)
        p, u0, u1, h, scale = ca.vertsplit(theta, np.cumsum([0, np_, nu, nu, 1, nx]).tolist())
        tau = ca.SX.sym("tau")
        f = self.system.rhs(z * scale, u0 + tau * (u1 - u0), p)
        differential, algebraic = (np.flatnonzero(kind).tolist() for kind in (self.stored, ~self.stored))
        dae = {"x": z[differential], "ode": (f * h / scale)[differential], "p": theta, "t": tau}
        dae |= {"z": z[algebraic], "alg": f[algebraic]} if algebraic else {}
        # Times are in steps; the slope of a linear input is only used with count = 1.
        walk = ca.integrator(f"walk{count}", self.plugin, dae, 0.0, list(np.arange(1.0, count + 1)), self.options)
        return walk, walk.forward(self.nq) if self.nq else None

    def walk(self, grid: Grid, first: int, count: int, x: Array, dx: Array, p: Array, dp: Array | None,
             scale: Array) -> None:
        """Fill x and dx for `count` intervals from sample `first`."""
        length = next(n for n in LENGTHS if n >= count)
        main, forward = self.integrator_of(length)
        h = (grid.t[first + count] - grid.t[first]) / count
        theta = np.concatenate([p, grid.u0[first], grid.u1[first], [h], scale])
        kinds = {name: which for name, which in (("x", self.stored), ("z", ~self.stored)) if which.any()}
        ks = slice(first + 1, first + count + 1)
        given = {f"{name}0": x[first, which] / scale[which] for name, which in kinds.items()} | {"p": theta}
        res = main(**given)
        for name, which in kinds.items():
            x[ks][:, which] = np.asarray(res[f"{name}f"]).T[:count] * scale[which]
        if forward is None or dp is None:
            return
        seeds = np.zeros((theta.size, self.nq))
        seeds[:len(p)] = dp
        given |= {f"out_{k}": res[k] for k in ("xf", "zf")}
        given |= {"fwd_x0": dx[first][self.stored] / scale[self.stored][:, None], "fwd_p": seeds}
        sens = forward(**given)
        for name, which in kinds.items():
            raw = np.asarray(sens[f"fwd_{name}f"]).reshape(which.sum(), self.nq, length)[:, :, :count]
            dx[ks][:, which, :] = raw.transpose(2, 0, 1) * scale[which][None, :, None]


_integrators = lru_cache(maxsize=64)(_Integrators)


def _pieces(grid: Grid) -> Iterator[tuple[int, int]]:
    """Yield (first sample, number of intervals) of stretches under one constant input and sample time."""
    dt = grid.dt
    flat = (grid.u0 == grid.u1).all(axis=1)
    same = np.zeros(len(dt), bool)  # interval k continues interval k-1
    same[1:] = flat[1:] & flat[:-1] & (grid.u0[1:] == grid.u0[:-1]).all(axis=1) & (np.abs(np.diff(dt)) < 1e-6 * dt[1:])
    for a, b in pairwise([*np.flatnonzero(~same).tolist(), len(dt)]):
        for first in range(a, b, LENGTHS[-1]):
            yield first, min(b - first, LENGTHS[-1])


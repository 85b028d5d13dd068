"""One L-stable linearly implicit (Rosenbrock) step and its exact derivatives, as CasADi functions.

RODAS3 of Sandu et al., "Benchmarking stiff ODE solvers for atmospheric chemistry problems II: Rosenbrock
solvers", Atmospheric Environment 31(20), 1997: four stages, three right-hand sides, order 3 with an embedded
order 2, stiffly accurate, so that it also carries algebraic balances (a motor without inductance)."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from motorid.model.equations import System, reciprocal

GAMMA = 0.5
A = ((), (0.0,), (2.0, 0.0), (2.0, 0.0, 1.0))
C = ((), (4.0,), (1.0, -1.0), (1.0, -1.0, -8.0 / 3.0))
ALPHA = (0.0, 0.0, 1.0, 1.0)
GAMMA_T = (0.5, 1.5, 0.0, 0.0)
WEIGHTS = (2.0, 0.0, 1.0, 1.0)
ORDER = 3  # the error at the end of an interval falls with the third power of its sub-steps


@dataclass(frozen=True, eq=False)
class StepFunctions:
    """The discrete model of a system. Each function is made when first needed: a step compiled before needs none."""

    system: System

    @cached_property
    def light(self) -> ca.Function:
        """``(x, u0, u1, h, p) -> (x⁺, e)``, the input going from u0 to u1 over h, e the local error."""
        x_next, error = self._step
        return _dense("motorid_light", self._args, {"x_next": x_next, "error": error})

    @cached_property
    def full(self) -> ca.Function:
        """``(x, u0, u1, h, p) -> (x⁺, A, B)`` with A = dx⁺/dx and B = dx⁺/dp, exact for the discrete step itself."""
        x_next, nx = self._step[0], self._step[0].numel()
        # In adjoint form: one sweep per state costs less than one per state and parameter.
        slopes = ca.jtimes(x_next, ca.vertcat(self._args["x"], self._args["p"]), ca.DM.eye(nx), True).T
        return _dense("motorid_full", self._args, {"x_next": x_next, "A": slopes[:, :nx], "B": slopes[:, nx:]})

    @cached_property
    def out(self) -> ca.Function:
        """``(x, u, p) -> (y, C, D)`` with C = dy/dx and D = dy/dp."""
        x, u, p = (self._args[n] for n in ("x", "u0", "p"))
        y = self.system.out(x, u, p)
        return _dense("motorid_out", {"x": x, "u": u, "p": p}, {"y": y, "C": ca.jacobian(y, x), "D": ca.jacobian(y, p)})

    @cached_property
    def _args(self) -> dict[str, ca.SX]:
        nx, nu, np_, _ = self.system.sizes
        return {n: ca.SX.sym(n, size) for n, size in (("x", nx), ("u0", nu), ("u1", nu), ("h", 1), ("p", np_))}

    @cached_property
    def _step(self) -> tuple[ca.SX, ca.SX]:
        return rosenbrock_step(self.system, *self._args.values())


def _dense(name: str, args: dict[str, ca.SX], results: dict[str, ca.SX]) -> ca.Function:
    return ca.Function(name, [*args.values()], ca.cse([ca.densify(r) for r in results.values()]), [*args], [*results])


def rosenbrock_step(system: System, x, u0, u1, h, p):
    """Return (x⁺, local error) of one step, symbolically."""
    f = system.rhs(x, u0, p)
    slope_x, slope_u = ca.jacobian(f, x), ca.jacobian(f, u0)
    drift = ca.mtimes(slope_u, u1 - u0)  # h·df/dt
    mass = ca.diag(ca.DM([float(s) for s in system.stored]))
    w = mass / GAMMA - h * slope_x
    order = _elimination_order(w)
    back, factors = [order.index(k) for k in range(len(order))], _lu(w[order, order])
    stages: list[ca.SX] = []
    for s in range(4):
        at = x + sum((a * k for a, k in zip(A[s], stages, strict=True) if a), ca.SX.zeros(x.numel()))
        rhs = h * (system.rhs(at, u0 + ALPHA[s] * (u1 - u0), p) if s > 1 else f) + h * GAMMA_T[s] * drift
        before = sum((c * k for c, k in zip(C[s], stages, strict=True)), ca.SX.zeros(x.numel()))
        stages.append(_solve(factors, (rhs + ca.mtimes(mass, before))[order])[back])
    return x + sum(w * k for w, k in zip(WEIGHTS, stages, strict=True) if w), stages[3]


def _elimination_order(w: ca.SX) -> list[int]:
    """Return the order of states that fills W least (Markowitz, Management Science 3(3), 1957); on a tie their own."""
    pattern, orders = np.array(ca.DM(w.sparsity(), 1)) != 0, []
    for freely in (False, True):
        filled, left, order = pattern.copy(), list(range(len(pattern))), list[int]()
        while left:
            fill = {k: (filled[left, k].sum() - 1) * (filled[k, left].sum() - 1) for k in left if filled[k, k]}
            k = min(fill, key=fill.__getitem__, default=left[0]) if freely else left[0]
            order.append(k)
            left.remove(k)
            filled[np.ix_(left, left)] |= np.outer(filled[left, k], filled[k, left])
        orders.append((filled.sum(), order))
    return min(orders, key=lambda entry: entry[0])[1]


def _lu(w: ca.SX) -> list[list[ca.SX]]:
    """LU factors without pivoting, reciprocals on the diagonal: W has positive storage or resistance there."""
    n = w.shape[0]
    m = [[w[i, j] for j in range(n)] for i in range(n)]
    for k in range(n):
        m[k][k] = reciprocal(m[k][k])
        for i in range(k + 1, n):
            m[i][k] = m[i][k] * m[k][k]
            for j in range(k + 1, n):
                m[i][j] = m[i][j] - m[i][k] * m[k][j]
    return m


def _solve(m: list[list[ca.SX]], rhs: ca.SX) -> ca.SX:
    n = len(m)
    z = [rhs[i] for i in range(n)]
    for i in range(n):
        for j in range(i):
            z[i] = z[i] - m[i][j] * z[j]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            z[i] = z[i] - m[i][j] * z[j]
        z[i] = z[i] * m[i][i]
    return ca.vertcat(*z)

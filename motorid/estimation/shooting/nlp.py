"""A mesh as a sparse nonlinear program for IPOPT: exact first derivatives, Gauss-Newton Hessian.

Wächter & Biegler, "On the implementation of an interior-point filter line-search algorithm for large-scale nonlinear
programming", Mathematical Programming 106, 2006. The functions are callbacks, which take the compiled step."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from motorid.errors import SimulationError
from motorid.estimation.shooting.mesh import Block, Mesh, places
from motorid.numerics.signals import Array

D = ca.Sparsity.dense
STEEPEST = 1e4  # largest diagonal entry of the scaled Hessian at the start; IPOPT's tolerances are absolute


class NlpResult(NamedTuple):
    """Where the NLP solver ended: z, multipliers of the rows (of ½rᵀr) and of z's bounds, status, costs on the way."""

    z: Array
    lam_g: Array
    lam_x: Array
    status: str
    history: tuple[float, ...]


class _Point(NamedTuple):
    f: float
    g: Array
    residual: list[Block]
    rows: list[Block]


class ShootingNlp:
    """Values and derivatives of one mesh at z, the last point kept; the first, to be simulated, shows sparsity."""

    def __init__(self, mesh: Mesh, z: Array) -> None:
        self.mesh = mesh
        self._kept: dict[bool, tuple[bytes, _Point]] = {}
        at = self._evaluate(z, True)
        self.n, self.m = len(z), len(at.g)
        diagonal = np.zeros(self.n)  # of JᵀJ
        for b in at.residual:
            diagonal[b.columns] += np.einsum("ij,ij->j", b.jac, b.jac)
        self.scale = STEEPEST / max(float(diagonal.max(initial=0.0)), 1e-300)
        rows, columns = places(at.rows)
        self._jac_order = np.lexsort((rows, columns))  # the blocks' entries fill it column by column
        self.jac_pattern = _ccs(rows[self._jac_order], columns[self._jac_order], self.m, self.n)
        # The upper triangle of the Hessian: which entries of the blocks lie in it, and where they go.
        rows = np.concatenate([np.repeat(b.columns, len(b.columns)) for b in at.residual])
        columns = np.concatenate([np.tile(b.columns, len(b.columns)) for b in at.residual])
        self._hess_mask = rows <= columns
        keys, self._hess_place = np.unique((columns * self.n + rows)[self._hess_mask], return_inverse=True)
        self.hess_pattern = _ccs(keys % self.n, keys // self.n, self.n, self.n)
        zero = np.zeros(0 if mesh.noise is not None else mesh.n_nodes * mesh.nx)
        found = mesh.constraints(mesh.walk(z, False))
        self.lower = np.concatenate([zero, *(part.lower[own] for _, part, own in found)])
        self.upper = np.concatenate([zero, *(part.upper[own] for _, part, own in found)])

    def _evaluate(self, z: Array, derivatives: bool) -> _Point:
        walk = self.mesh.walk(z, derivatives)
        residual = self.mesh.residual(z, walk)
        rows = [] if self.mesh.noise is not None else self.mesh.gaps(z, walk)
        rows += [b for b, _, _ in self.mesh.constraints(walk)]
        f = 0.5 * sum(float(b.values @ b.values) for b in residual)
        return _Point(f, np.concatenate([np.zeros(0), *(b.values for b in rows)]), residual, rows)

    def at(self, z: Array, derivatives: bool) -> _Point:
        """Return the point z; SimulationError where it cannot be simulated."""
        key = z.tobytes()
        for stronger in (True, derivatives):
            if stronger in self._kept and self._kept[stronger][0] == key:
                return self._kept[stronger][1]
        found = self._evaluate(z, derivatives)
        self._kept[derivatives] = key, found
        return found

    def values(self, z: Array) -> list[Any]:
        """Return f and g."""
        point = self.at(z, False)
        return [point.f * self.scale, point.g]

    def gradient(self, z: Array) -> list[Any]:
        """Return f and its gradient."""
        point = self.at(z, True)
        found = np.zeros(self.n)
        for b in point.residual:
            found[b.columns] += b.values @ b.jac
        return [point.f * self.scale, found * self.scale]

    def jacobian(self, z: Array) -> list[Any]:
        """Return g and its sparse Jacobian."""
        point = self.at(z, True)
        return [point.g, np.concatenate([np.zeros(0), *(b.jac.ravel() for b in point.rows)])[self._jac_order]]

    def hessian(self, z: Array, lam_f: float) -> list[Any]:
        """Return the entries of the Gauss-Newton Hessian's upper triangle."""
        entries = np.concatenate([(b.jac.T @ b.jac).ravel() for b in self.at(z, True).residual])[self._hess_mask]
        return [np.bincount(self._hess_place, entries, self.hess_pattern.nnz()) * (self.scale * lam_f)]

    def functions(self) -> tuple[ca.Callback, dict[str, ca.Callback]]:
        """Return the NLP and its derivatives in CasADi's naming."""
        x, f, g = D(self.n, 1), D(1, 1), D(self.m, 1)
        at = {"x": x, "p": D(0, 0)}
        return _Function("nlp", at, {"f": f, "g": g}, lambda z, _: self.values(z)), {
            "grad_f": _Function("nlp_grad_f", at, {"f": f, "grad:f:x": x}, lambda z, _: self.gradient(z)),
            "jac_g": _Function("nlp_jac_g", at, {"g": g, "jac:g:x": self.jac_pattern}, lambda z, _: self.jacobian(z)),
            "hess_lag": _Function(
                "nlp_hess_l", at | {"lam:f": f, "lam:g": g}, {"triu:hess:gamma:x:x": self.hess_pattern},
                lambda z, _, lam_f, __: self.hessian(z, float(lam_f[0])))}


class _Function(ca.Callback):
    """A Python function as a CasADi callback; results are dense arrays or the entries of a sparse one."""

    def __init__(self, name: str, given: Mapping[str, ca.Sparsity], results: Mapping[str, ca.Sparsity],
                 call: Callable[..., list[Any]]) -> None:
        ca.Callback.__init__(self)
        self._given, self._results, self._call = list(given.items()), list(results.items()), call
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._given)

    def get_n_out(self) -> int:
        return len(self._results)

    def get_name_in(self, i: int) -> str:
        return self._given[i][0]

    def get_name_out(self, i: int) -> str:
        return self._results[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._given[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._results[i][1]

    def eval(self, arg: Sequence[ca.DM]) -> list[ca.DM]:
        try:
            found = self._call(*(np.asarray(a).ravel() for a in arg))
        except SimulationError:  # not a number: IPOPT takes a shorter step
            found = [np.full(s.nnz(), np.nan) for _, s in self._results]
        return [ca.DM(s, np.atleast_1d(v)) for (_, s), v in zip(self._results, found, strict=True)]


def _ccs(rows: np.ndarray, columns: np.ndarray, m: int, n: int) -> ca.Sparsity:
    return ca.Sparsity(m, n, np.searchsorted(columns, np.arange(n + 1)).tolist(), rows.tolist())


def ipopt(nlp: ShootingNlp, z0: Array, bounds: tuple[Array, Array], options: Mapping[str, Any],
          warm: NlpResult | None = None, near: bool = False) -> NlpResult:
    """Solve `nlp` with some of IPOPT's `options`; `z0` may be `near` a solution, `warm` a result of the same size."""
    function, derivatives = nlp.functions()
    start = {"x0": z0}
    told = {"constr_viol_tol": 1e-10, "dual_inf_tol": 1e-6, "compl_inf_tol": 1e-8, "acceptable_iter": 0,
            "bound_relax_factor": 0.0, "nlp_scaling_method": "none", "sb": "yes", "mu_strategy": "adaptive", **options}
    if near:
        told |= {"mu_strategy": "monotone", "mu_init": 1e-6, "bound_push": 1e-8, "bound_frac": 1e-8,
                 "slack_bound_push": 1e-8, "slack_bound_frac": 1e-8}
    if warm is not None:
        told |= {"mu_strategy": "monotone", "mu_init": 1e-7, "warm_start_init_point": "yes",
                 "warm_start_bound_push": 1e-9, "warm_start_mult_bound_push": 1e-9, "warm_start_slack_bound_push": 1e-9}
        start |= {"lam_g0": warm.lam_g * nlp.scale, "lam_x0": warm.lam_x * nlp.scale}
    solver = ca.nlpsol("solver", "ipopt", function, {**derivatives, "no_nlp_grad": True, "calc_lam_p": False,
        "print_time": False, "show_eval_warnings": False, "error_on_fail": False, "ipopt": told})
    found = solver(**start, lbx=bounds[0], ubx=bounds[1], lbg=nlp.lower, ubg=nlp.upper)
    x, lam_g, lam_x = (np.asarray(found[name]).ravel() for name in ("x", "lam_g", "lam_x"))
    stats = solver.stats()
    costs = tuple(float(f) / nlp.scale for f in stats.get("iterations", {}).get("obj", []))
    return NlpResult(x, lam_g / nlp.scale, lam_x / nlp.scale, stats["return_status"], costs)

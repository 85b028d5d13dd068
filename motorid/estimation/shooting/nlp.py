"""A problem cut at shooting nodes, and that mesh as a sparse nonlinear program for IPOPT: exact first derivatives,
Gauss-Newton Hessian. States at the nodes are unknowns beside q, each interval is simulated by itself.

Bock & Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", IFAC World Congress,
1984; Wächter & Biegler, "On the implementation of an interior-point filter line-search algorithm for large-scale
nonlinear programming", Mathematical Programming 106, 2006. Engine and sub-steps are those of least squares: both
formulations speak of the same discrete model. Unknowns are z = (q, nodes/scale); the first state of a run is a function
of q. Nodes begin at measured channels or on a simulation. The functions are callbacks, which take the compiled step."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy

from motorid.errors import SimulationError, among
from motorid.integrate.engine import Grid, Trajectory
from motorid.numerics.signals import Array, bridged, slope
from motorid.problem.constraints import Part
from motorid.problem.problem import Problem, prior_residual
from motorid.problem.unknowns import Point
from motorid.records.experiment import Experiment

FEWEST = 50  # samples per interval, unless a run is so long that it would need more intervals than
MOST = 200
NEXT_TO_NONE = 1e-6  # of a state's size per √s: states that no unknown voltage or torque acts on
FIRST = 0.03  # of a state's size per √s
DISTURBED = ("i", "omega")  # an unknown voltage, an unknown torque
D = ca.Sparsity.dense
STEEPEST = 1e4  # largest diagonal entry of the scaled Hessian at the start; IPOPT's tolerances are absolute


class Interval(NamedTuple):
    """A stretch of a run from one node to the next."""

    run: int
    first: int  # sample
    last: int  # sample, which belongs to the next interval where there is one
    node: int  # counted over all runs; -1: none (the first state of a run is a function of q)
    next: int  # likewise
    grid: Grid


class Block(NamedTuple):
    """A few rows: values (m,), derivative (m, w) and the w columns of z that it belongs to."""

    values: Array
    jac: Array
    columns: np.ndarray


class Walk(NamedTuple):
    """All intervals simulated, and put together run by run; columns of derivatives are (own node, q), both scaled."""

    at: Point  # q in the system's terms
    runs: tuple[Trajectory, ...]
    intervals: tuple[Trajectory, ...]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Intervals of all runs and the rows they give."""

    problem: Problem
    every: int | None = None  # samples per interval; None chooses
    # (nx,) process noise per state, unit/√s: gaps at the nodes are weighed by it instead of forbidden
    noise: Array | None = None

    @cached_property
    def intervals(self) -> tuple[Interval, ...]:
        """Intervals in the order of runs and time."""
        found: list[Interval] = []
        nodes = 0
        for k, run in enumerate(self.problem.runs):
            last = len(run.grid.t) - 1
            step = self.every or max(FEWEST, -(-last // MOST))
            cuts = np.unique(np.linspace(0, last, max(round(last / step), 1) + 1).round().astype(int)).tolist()
            for a, b in pairwise(cuts):
                node = -1 if a == 0 else nodes - 1
                nodes += b < last
                found.append(Interval(k, a, b, node, nodes - 1 if b < last else -1, run.grid.part(a, b)))
        return tuple(found)

    @cached_property
    def n_nodes(self) -> int:
        """Number of nodes with a state of their own."""
        return sum(v.next >= 0 for v in self.intervals)

    @cached_property
    def nq(self) -> int:
        """Number of unknowns of the problem."""
        return len(self.problem.unknown)

    @cached_property
    def nx(self) -> int:
        """Number of states."""
        return len(self.problem.system.states)

    def columns(self, v: Interval, *, after: bool = False) -> np.ndarray:
        """Return the columns of z of (own node, q), with `after` those of the next node too; -1: absent."""
        def of(node: int) -> np.ndarray:
            return self.nq + node * self.nx + np.arange(self.nx) if node >= 0 else np.full(self.nx, -1)
        return np.concatenate([of(v.node), np.arange(self.nq), *([of(v.next)] if after else [])])

    @cached_property
    def owner(self) -> tuple[np.ndarray, ...]:
        """Per run: the interval each sample belongs to."""
        found = [np.zeros(len(run.grid.t), int) for run in self.problem.runs]
        for j, v in enumerate(self.intervals):
            found[v.run][v.first:] = j
        return tuple(found)

    @cached_property
    def scale(self) -> Array:
        """Size of each state: the largest seen in the data, 1 where it was not measured."""
        runs = self.problem.experiments
        return np.array([max([0.0, *(np.nanmax(np.abs(r.outputs[name])) for r in runs if name in r.outputs)]) or 1.0
                         for name in self.problem.system.states])

    def joined(self, q: Array, states: Array) -> Array:
        """Return z of q and the states at the nodes (n, nx), physical."""
        return np.concatenate([q, (np.asarray(states).reshape(-1, self.nx) / self.scale).ravel()])

    def walk(self, z: Array, derivatives: bool) -> Walk:
        """Simulate every interval from its node; SimulationError if that fails."""
        problem, nx = self.problem, self.nx
        at, states = problem.unknowns.point(z[:self.nq]), z[self.nq:].reshape(self.n_nodes, nx) * self.scale
        dp = np.hstack([np.zeros((len(at.p), nx)), at.dp])
        inner = np.hstack([np.diag(self.scale), np.zeros((nx, self.nq))])
        found = []
        for v in self.intervals:
            x0, dx0 = (states[v.node], inner) if v.node >= 0 else (problem.unknowns.first_state(at, v.run), None)
            if dx0 is None and derivatives:
                dx0 = np.hstack([np.zeros((nx, nx)), problem.unknowns.first_slopes(at, v.run)])
            found.append(problem.integrator.run(problem.system, v.grid, x0, at.p, *((dx0, dp) if derivatives else ())))
        runs = [[t for v, t in zip(self.intervals, found, strict=True) if v.run == k] for k in range(len(problem.runs))]
        return Walk(at, tuple(map(_joined, runs)), tuple(found))

    def residual(self, z: Array, walk: Walk) -> list[Block]:
        """Return whitened residuals: outputs, weighed gaps, priors, penalties; ½ of their squares is the cost."""
        problem = self.problem
        blocks = []
        for k in range(len(problem.runs)):
            r, jac = problem.with_loss(*problem.measured[k].residual(walk.runs[k]))
            index = problem.measured[k].index
            rows = np.arange(len(r)) if index is None else index
            blocks += self._by_interval(r, jac, self.owner[k][rows // len(problem.outputs)])
        blocks += [] if self.noise is None else self.gaps(z, walk, self.noise)
        if problem.priors:
            r, jac = prior_residual(problem.priors, problem.unknowns, walk.at)
            blocks.append(Block(r, jac, np.arange(self.nq)))
        for penalty, part in ((c, part) for c in problem.penalties for part in c.parts(problem)):
            found = self._part(part, walk)
            r, slope = penalty.penalty(np.concatenate([b.values for b, _ in found]), part)
            blocks += [Block(r[rows], slope[rows, None] * b.jac, b.columns) for b, rows in found]
        return blocks

    def gaps(self, z: Array, walk: Walk, noise: Array | None = None) -> list[Block]:
        """Return, per inner node, its state minus the end of the interval before it; over process `noise`, if given."""
        states = z[self.nq:].reshape(self.n_nodes, self.nx)
        blocks = []
        for v, traj in ((v, t) for v, t in zip(self.intervals, walk.intervals, strict=True) if v.next >= 0):
            factor = np.ones(self.nx) if noise is None else self.scale / (noise * np.sqrt(v.grid.t[-1] - v.grid.t[0]))
            values = (states[v.next] - traj.x[-1] / self.scale) * factor
            jac = np.zeros((self.nx, 0))
            if traj.dx is not None:
                jac = np.hstack([-traj.dx[-1] / self.scale[:, None], np.eye(self.nx)]) * factor[:, None]
            blocks.append(_present(Block(values, jac, self.columns(v, after=True))))
        return blocks

    def constraints(self, walk: Walk) -> list[tuple[Block, Part, np.ndarray]]:
        """Return the rows of all constraints with the part they belong to and their places in it."""
        return [(b, part, rows) for c in self.problem.constraints for part in c.parts(self.problem)
                for b, rows in self._part(part, walk)]

    def _part(self, part: Part, walk: Walk) -> list[tuple[Block, np.ndarray]]:
        traj, s = walk.runs[part.run], part.samples
        owner = self.owner[part.run][s]
        if not part.averaged:
            dp = np.hstack([np.zeros((len(walk.at.p), self.nx)), walk.at.dp])
            c, jac = part.rows(traj.x[s], walk.at.p, None if traj.dx is None else traj.dx[s], dp)
            blocks = self._by_interval(c, jac, owner)
            ends = np.cumsum([len(b.values) for b in blocks])
            return [(b, np.arange(e - len(b.values), e)) for b, e in zip(blocks, ends, strict=True)]
        nodes = [int(j) for j in np.unique(owner) if self.intervals[j].node >= 0]  # spread over all that are concerned
        columns = np.concatenate([np.arange(self.nq), *(self.columns(self.intervals[j])[:self.nx] for j in nodes)])
        dp, dx = np.hstack([walk.at.dp, np.zeros((len(walk.at.dp), len(columns) - self.nq))]), None
        if traj.dx is not None:
            dx = np.zeros((len(s), self.nx, len(columns)))
            dx[:, :, :self.nq] = traj.dx[s][:, :, self.nx:]
            for j, a in zip(nodes, range(self.nq, len(columns), self.nx), strict=True):
                mine = owner == j
                dx[mine, :, a:a + self.nx] = traj.dx[s[mine]][:, :, :self.nx]
        c, jac = part.rows(traj.x[s], walk.at.p, dx, dp)
        return [(Block(c, jac, columns), np.arange(len(c)))]

    def _by_interval(self, values: Array, jac: Array | None, owner: np.ndarray) -> list[Block]:
        """Cut rows with local derivatives (n, nx + nq) where the interval changes."""
        wide = np.zeros((len(values), 0)) if jac is None else jac
        return [_present(Block(values[a:b], wide[a:b], self.columns(self.intervals[owner[a]])))
                for a, b in pairwise([0, *(np.flatnonzero(np.diff(owner)) + 1).tolist(), len(values)]) if b > a]


def _present(b: Block) -> Block:
    """Drop absent columns."""
    there = b.columns >= 0
    return Block(b.values, b.jac[:, there] if b.jac.shape[1] else b.jac, b.columns[there])


def _joined(intervals: Sequence[Trajectory]) -> Trajectory:
    """Put the intervals of a run together; the sample that two of them share is the later one's."""
    def whole(parts: Any) -> Any:
        return None if parts[0] is None else np.concatenate([*(a[:-1] for a in parts[:-1]), parts[-1]])
    y, dy, x, dx = map(whole, zip(*(t[:4] for t in intervals), strict=True))
    return Trajectory(y, dy, x, dx, None)


def places(blocks: Sequence[Block]) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column of every entry of `blocks`, one below the other, each row by row."""
    ends = np.cumsum([len(b.values) for b in blocks])
    rows = [np.repeat(np.arange(e - len(b.values), e), len(b.columns)) for e, b in zip(ends, blocks, strict=True)]
    columns = [np.tile(b.columns, len(b.values)) for b in blocks]
    return np.concatenate([np.zeros(0, int), *rows]), np.concatenate([np.zeros(0, int), *columns])


def nodes_from_simulation(mesh: Mesh, q: Array) -> Array:
    """Return states (n_nodes, nx) on the model's own trajectory at `q`; SimulationError if that fails."""
    problem = mesh.problem
    states = [problem.simulate(q, k, derivatives=False).x for k in range(len(problem.runs))]
    return np.array([states[v.run][v.last] for v in mesh.intervals if v.next >= 0]).reshape(-1, mesh.nx)


def nodes_from_data(mesh: Mesh, q: Array) -> Array:
    """Return states (n_nodes, nx): measured ones from the data, the others carried on by the simulation."""
    problem = mesh.problem
    at = problem.unknowns.point(q)
    signals = [measured_states(run, problem.system.states) for run in problem.experiments]
    found = np.zeros((mesh.n_nodes, mesh.nx))
    x = np.zeros(mesh.nx)
    for v in mesh.intervals:
        if v.node < 0:
            x = problem.unknowns.first_state(at, v.run)
        if v.next < 0:
            continue
        with suppress(SimulationError):
            x = problem.integrator.run(problem.system, v.grid, x, at.p).x[-1]
        x = x.copy()
        for j, signal in signals[v.run].items():
            x[j] = signal[v.last]
        found[v.next] = x
    return found


def measured_states(run: Experiment, states: tuple[str, ...]) -> dict[int, Array]:
    """Return the measured states (N,) by index, gaps bridged; a speed not measured is the slope of the angle."""
    found = {}
    for j, name in enumerate(states):
        if name in run.outputs:
            found[j] = bridged(run.t, run.outputs[name])
        elif name == "omega" and "theta" in run.outputs:
            found[j] = slope(run.t, bridged(run.t, run.outputs["theta"]), half=5)
    return found


@dataclass(frozen=True, eq=False)
class Gaps:
    """What is missing at each of n nodes: the state there minus the end of the interval before. J·gap/span of the speed
    is the mean torque missing in an interval that is short beside the mechanical time constant."""

    run: np.ndarray  # (n,) of int
    t: Array  # (n,), s
    span: Array  # (n,), length of the interval before, s
    states: tuple[str, ...]
    values: Array  # (n, nx), SI


def gaps_of(mesh: Mesh, z: Array) -> Gaps:
    """Return the gaps at `z`."""
    before = [v for v in mesh.intervals if v.next >= 0]
    values = np.array([b.values * mesh.scale for b in mesh.gaps(z, mesh.walk(z, False))]).reshape(-1, mesh.nx)
    return Gaps(np.array([v.run for v in before], int), np.array([v.grid.t[-1] for v in before]),
                np.array([v.grid.t[-1] - v.grid.t[0] for v in before]), mesh.problem.system.states, values)


def first_noise(given: Any, mesh: Mesh) -> Array:
    """Return process noise to begin with, (nx,): the user's by state, or ``"auto"``; next to none in other states."""
    sizes = dict(zip(mesh.problem.system.states, mesh.scale, strict=True))
    given = {n: FIRST * s for n, s in sizes.items() if n in DISTURBED} if given == "auto" else given
    for name in given:
        among(name, sizes, "state", where="process_noise: ")
    return np.array([given.get(n, NEXT_TO_NONE * s) for n, s in sizes.items()])


def noise_of_gaps(mesh: Mesh, z: Array) -> Array:
    """Return the process noise that the gaps at a solution `z` show, (nx,); of undisturbed states as it was."""
    assert mesh.noise is not None
    gaps = gaps_of(mesh, z)
    shown = np.sqrt(np.mean(gaps.values**2 / gaps.span[:, None], axis=0))
    acted_on = np.array([n in DISTURBED for n in gaps.states])
    return np.where(acted_on, np.maximum(shown, NEXT_TO_NONE * mesh.scale), mesh.noise)


def reduced(mesh: Mesh, z: Array) -> tuple[Array, Array]:
    """Return residuals (n,) at `z` and their Jacobian (n, nq) projected off the nodes': JᵀJ is the Schur complement."""
    blocks = mesh.residual(z, mesh.walk(z, True))
    residual = np.concatenate([b.values for b in blocks])
    entries = np.concatenate([b.jac.ravel() for b in blocks])
    whole = scipy.sparse.csc_matrix((entries, places(blocks)), shape=(len(residual), len(z)))
    jac, nodes = whole[:, :mesh.nq].toarray(), whole[:, mesh.nq:]
    if not nodes.shape[1]:
        return residual, jac
    return residual, jac - nodes @ scipy.sparse.linalg.splu((nodes.T @ nodes).tocsc()).solve(nodes.T @ jac)


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

"""A problem cut at shooting nodes: states there are unknowns beside q, each interval is simulated by itself.

Bock & Plitt, "A multiple shooting algorithm for direct solution of optimal control problems", IFAC World Congress,
1984. Engine and sub-steps are those of least squares: both formulations speak of the same discrete model. Unknowns are
z = (q, nodes/scale); the first state of a run is a function of q. Nodes begin at measured channels or on a simulation.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

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

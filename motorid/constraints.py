"""What a fit must respect beside the data: a current limit, the steady state, a relation of the user's own.

Each one is used in two ways. As a *penalty* it adds rows to the least-squares residual (`evaluate`); as a *true
constraint* of `MultipleShooting` it keeps rows between limits (`parts`). A row is a function of the state, the
input and the parameters at one sample, or its mean over several samples, made dimensionless by a natural size.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from motorid.errors import ModelError, UsageError
from motorid.integrate.grid import Array, Trajectory
from motorid.steady import Segment, find_segments, segment_between

FEWEST = 64  # samples of a steady segment that are looked at; its means use all


@dataclass(frozen=True, eq=False)
class Part:
    """Rows of one constraint on one run: ``lower ≤ mean over its samples of local(x, u, p, d) ≤ upper``.

    Attributes
    ----------
    run : int
    local : casadi.Function
        ``(x, u, p, d) -> (c, dc/dx, dc/dp)``, c of shape (nc,), dimensionless.
    samples : ndarray of int, shape (m,)
        In ascending order.
    group : ndarray of int, shape (m,)
        Which row block each sample is averaged into.
    data : ndarray, shape (m, nd)
    u : ndarray, shape (m, nu)
    keep : ndarray of bool, shape (ng·nc,)
        Which rows are used.
    lower, upper : ndarray, shape (n,)
        Of the rows kept.
    size : ndarray, shape (n,)
        What one unit of a row is, in `unit`.
    weight : ndarray, shape (n,)
        Of the rows as a penalty.
    labels : tuple of str
    unit : str
    """

    run: int
    local: ca.Function
    samples: np.ndarray
    group: np.ndarray
    data: Array
    u: Array
    keep: np.ndarray
    lower: Array
    upper: Array
    size: Array
    weight: Array
    labels: tuple[str, ...]
    unit: str

    def rows(self, x: Array, p: Array, dx: Array | None, dp: Array | None) -> tuple[Array, Array | None]:
        """Return the rows (n,), and d rows/dz (n, nz) of states (m, nx) with dx (m, nx, nz) and dp (np, nz)."""
        m, nc = len(self.samples), self.local.size1_out(0)
        wide = np.tile(np.asarray(p, float)[:, None], (1, m))
        found = self.local.map(m)(x.T, self.u.T, wide, self.data.T)
        c = np.asarray(found[0]).T
        mean = self._mean(c).ravel()[self.keep]
        if dx is None:
            return mean, None
        cx = np.asarray(found[1]).reshape(nc, m, -1).transpose(1, 0, 2)
        cp = np.asarray(found[2]).reshape(nc, m, -1).transpose(1, 0, 2)
        return mean, self._mean(cx @ dx + cp @ dp).reshape(-1, dx.shape[2])[self.keep]

    def _mean(self, values: Array) -> Array:
        groups = int(self.group[-1]) + 1
        if groups == len(self.group):
            return values
        starts = np.flatnonzero(np.diff(self.group, prepend=-1))
        counts = np.diff(starts, append=len(self.group))
        return np.add.reduceat(values, starts, axis=0) / counts.reshape(-1, *[1] * (values.ndim - 1))


class _Relation:
    """What all constraints share: parts once per problem, and their use as penalties."""

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        raise NotImplementedError

    def parts(self, problem: Any) -> tuple[Part, ...]:
        """Return the rows on each run of `problem`, made once."""
        made = _made.setdefault(problem, {})
        if id(self) not in made:
            made[id(self)] = (self, self._parts(problem))
        return made[id(self)][1]

    def _penalty(self, c: Array, part: Part) -> tuple[Array, Array]:
        """Return residual and slope of rows used as a penalty: what lies outside the limits."""
        out = np.where(c > part.upper, c - part.upper, np.where(c < part.lower, c - part.lower, 0.0))
        return part.weight * out, part.weight * (out != 0)

    def evaluate(self, problem: Any, q: Array, trajs: Sequence[Trajectory]) -> tuple[Array, Array | None]:
        """Return the penalty's residual (n,) and Jacobian d/dq (n, nq), None where the trajectories have none."""
        p, dp = parameters_of(problem, q)
        rs, jacs = [np.zeros(0)], [np.zeros((0, len(q)))]
        derivatives = all(t.dx is not None for t in trajs)
        for part in self.parts(problem):
            t, s = trajs[part.run], part.samples
            c, jac = part.rows(t.x[s], p, t.dx[s] if derivatives and t.dx is not None else None, dp)
            r, slope = self._penalty(c, part)
            rs.append(r)
            if jac is not None:
                jacs.append(slope[:, None] * jac)
        return np.concatenate(rs), np.concatenate(jacs) if derivatives else None


_made: weakref.WeakKeyDictionary[Any, dict[int, tuple[Any, tuple[Part, ...]]]] = weakref.WeakKeyDictionary()


def parameters_of(problem: Any, q: Array) -> tuple[Array, Array]:
    """Return p (np,) of the system and dp/dq (np, nq)."""
    values = problem.values(q)
    names = problem.system.parameters
    select = np.zeros((len(names), len(problem.unknown)))
    for j, parameter in enumerate(problem.unknown):
        if parameter.name in names:
            select[names.index(parameter.name), j] = 1.0
    return np.array([values[n] for n in names]), select * problem.scaling.slope(q)


@dataclass(frozen=True, eq=False)
class CurrentLimit(_Relation):
    """The winding current of the model stays within ``±limit`` at every sample.

    Attributes
    ----------
    limit : float
        A.
    weight : float
        As a penalty each sample adds ``weight·max(0, |i| − limit)/limit`` to a residual in units of the RMS of
        the measured channels (in a fit weighted by the noise: times the ratio of that RMS to the noise).
    """

    limit: float
    weight: float = 10.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.limit) and self.limit > 0):
            raise UsageError(f"CurrentLimit takes a positive current in A; got {self.limit!r}.")
        _check_weight(self.weight, "CurrentLimit")

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"CurrentLimit({self.limit:g} A)"

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        system = problem.system
        if "i" not in system.states:
            raise UsageError(f"{self.name}: the base '{problem.model.base}' has no current. Leave the limit out, or "
                             "use dc_motor() with a record of the applied voltage.")
        local = _local(system, lambda x, u, p, d: x[system.states.index("i")] / self.limit, 0)
        found = []
        for k, run in enumerate(problem.runs):
            n = len(run.experiment.t)
            one, every = np.ones(n), np.arange(n)
            found.append(Part(k, local, every, every, np.zeros((n, 0)), run.grid.u, np.ones(n, bool), -one, one,
                              self.limit * one, self.weight * _share(problem, k) * one,
                              tuple(f"{self.name}, run {k}, t = {t:.6g} s" for t in run.experiment.t), "A"))
        return tuple(found)


@dataclass(frozen=True, eq=False)
class SteadyState(_Relation):
    """The model's own balances vanish at the measured steady state.

    The measured means of current and speed are put into the voltage and the torque balance; sensor effects are
    undone first, states that were not measured come from the simulation. For the plain motor that is
    ``v = R i + K ω`` and ``K i = b ω``; with effects the relation grows with the model. Steady parts are found in
    the data, see `segments`. At standstill only the voltage balance is asked for.

    Attributes
    ----------
    tolerance : float
        As a true constraint: largest balance left over, relative to v and to K i (g v where the drive makes the
        torque); three standard errors of the measured means are added.
    weight : float
        As a penalty each balance adds ``weight·√n·(relative balance)``, n being the samples of the segment, to a
        residual in units of the RMS of the measured channels (in a fit weighted by the noise: times the ratio of
        that RMS to the noise). So a balance that is off by 1 % weighs as much as one channel off by 1 % of its
        RMS all through the segment.
    at : sequence of (run, begin, end), optional
        Steady parts given by the user, times in s, instead of those found.
    """

    tolerance: float = 0.01
    weight: float = 1.0
    at: Sequence[tuple[int, float, float]] | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise UsageError(f"SteadyState takes a tolerance of at least 0; got {self.tolerance!r}.")
        _check_weight(self.weight, "SteadyState")

    @property
    def name(self) -> str:
        """What messages call it."""
        return "SteadyState()"

    def segments(self, problem: Any) -> tuple[Segment, ...]:
        """Return the steady parts of the records of `problem`: found in the data, or those given by `at`."""
        if self.at is None:
            return find_segments(problem.experiments, [run.sigma for run in problem.runs])
        found = []
        for k, begin, end in self.at:
            if not 0 <= k < len(problem.experiments):
                raise UsageError(f"SteadyState(at=…): there is no run {k}; runs are counted from 0 to "
                                 f"{len(problem.experiments) - 1}.")
            segment = segment_between(k, problem.experiments[k], begin, end)
            if segment is None:
                raise UsageError(f"SteadyState(at=…): run {k} has no two samples between {begin:g} and {end:g} s.")
            found.append(segment)
        return tuple(found)

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        segments = self.segments(problem)
        if not segments:
            warnings.warn("SteadyState: no steady part was found in these records, so it asks for nothing. Give the "
                          "parts yourself, SteadyState(at=[(run, begin, end)]), or leave it out.", stacklevel=4)
        return tuple(part for s in segments if (part := self._part(problem, s)) is not None)

    def _part(self, problem: Any, s: Segment) -> Part | None:
        run, electrical = problem.runs[s.run], "i" in problem.system.states
        wanted = [electrical and "i" in s.means, s.moving and "omega" in s.means and (not electrical or "i" in s.means)]
        wanted[0] = wanted[0] and abs(s.v) > 0
        if not any(wanted):
            return None
        pick = np.unique(np.linspace(s.first, s.last, min(FEWEST, s.n)).round().astype(int))
        known = tuple(c for c in ("i", "omega") if c in s.means)
        data = np.tile([s.v, *[s.means[c] for c in known]], (len(pick), 1))
        noise = 3 * sum(_relative_error(run, s, c) for c in known)
        rows = np.ones(sum(wanted))
        names = [n for n, w in zip(("voltage", "torque"), wanted, strict=True) if w]
        return Part(s.run, _local(problem.system, _steady_rows(problem.system, known), data.shape[1]), pick,
                    np.zeros(len(pick), int), data, run.grid.u[pick], np.array(wanted), -(self.tolerance + noise) * rows,
                    (self.tolerance + noise) * rows, rows, self.weight * np.sqrt(s.n) * _share(problem, s.run) * rows,
                    tuple(f"{self.name}, {n} balance, run {s.run}, {s.begin:.4g} to {s.end:.4g} s" for n in names), "1")

    def _penalty(self, c: Array, part: Part) -> tuple[Array, Array]:
        return part.weight * c, part.weight  # the source paper's: zero only where the balance is


def _steady_rows(system: Any, known: Sequence[str]) -> Callable[..., Any]:
    """Return the relative balances as an expression of (x, u, p, d) with d = (mean v, measured means)."""
    def rows(x: ca.SX, u: ca.SX, p: ca.SX, d: ca.SX) -> ca.SX:
        u = ca.vertcat(*[d[0] if n == "v" else u[j] for j, n in enumerate(system.inputs)])
        y = system.out(x, u, p)
        state = [x[j] for j in range(x.numel())]
        for j, channel in enumerate(known, 1):
            place, shown = system.states.index(channel), d[j]
            if channel in system.outputs:
                # One Newton step undoes gains and offsets; a sensor with a lag has settled and shows its input.
                at = system.outputs.index(channel)
                slope = ca.jacobian(y[at], x[place])
                state[place] = x[place] + (shown - y[at]) / slope if not slope.is_zero() else shown
            else:
                state[place] = shown
        balances = system.balances(ca.vertcat(*state), u, p)
        par = dict(zip(system.parameters, ca.vertsplit(p), strict=True))
        drive = par["K"] * d[1 + known.index("i")] if "i" in known and "K" in par else par.get("g", 1.0) * d[0]
        size = ca.vertcat(d[0], drive)
        return balances / ca.if_else(size == 0, 1.0, size)
    return rows


def _relative_error(run: Any, s: Segment, channel: str) -> float:
    """Standard error of a measured mean over its size."""
    size = max(abs(s.means[channel]), 1e-300)
    if channel in run.sigma:
        return run.sigma[channel] / np.sqrt(s.n) / size
    return 3.5 * run.sigma.get("theta", 0.0) / np.sqrt(s.n) / max(s.end - s.begin, 1e-300) / size


@dataclass(frozen=True, eq=False)
class Constraint(_Relation):
    """A relation of the user's own: ``lower ≤ expression ≤ upper``.

    Attributes
    ----------
    expression : callable
        Of one argument with the states, inputs and parameters as CasADi symbols, e.g. ``lambda m: m.K * m.omega``.
        Of parameters alone: one row. With states or inputs: one row at every sample of every run.
    lower, upper : float
    size : float
        Natural size of the expression, in its unit; scales the row.
    weight : float
        As a penalty: per row, on what lies outside the limits over `size`, in units as in `CurrentLimit`.
    title : str
        What messages call it.
    unit : str
    """

    expression: Callable[[Any], Any]
    lower: float = -np.inf
    upper: float = np.inf
    size: float = 1.0
    weight: float = 10.0
    title: str = "Constraint"
    unit: str = ""
    _checked: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not self.lower <= self.upper or (np.isinf(self.lower) and np.isinf(self.upper)):
            raise UsageError(f"{self.title}: needs lower ≤ upper with at least one of them finite; got "
                             f"[{self.lower:g}, {self.upper:g}].")
        if not self.size > 0:
            raise UsageError(f"{self.title}: size must be positive; got {self.size!r}.")
        _check_weight(self.weight, self.title)

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.title

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        system = problem.system

        def rows(x: ca.SX, u: ca.SX, p: ca.SX, d: ca.SX) -> ca.SX:
            symbols = {**dict(zip(system.states, ca.vertsplit(x), strict=True)),
                       **dict(zip(system.inputs, ca.vertsplit(u), strict=True)),
                       **dict(zip(system.parameters, ca.vertsplit(p), strict=True))}
            try:
                return ca.SX(self.expression(SimpleNamespace(**symbols))) / self.size
            except AttributeError as error:
                raise ModelError(f"{self.title}: {error}; known are {', '.join(symbols)}.") from None

        local = _local(system, rows, 0)
        if local.size1_out(0) != 1:
            raise ModelError(f"{self.title}: the expression must be one number, not {local.size1_out(0)}.")
        constant = local.sparsity_jac(0, 0).nnz() == 0 and local.sparsity_jac(1, 0).nnz() == 0
        found = []
        for k, run in enumerate(problem.runs[:1] if constant else problem.runs):
            samples = np.arange(1 if constant else len(run.experiment.t))
            one = np.ones(len(samples))
            labels = [self.title] if constant else [f"{self.title}, run {k}, t = {t:.6g} s" for t in run.experiment.t]
            found.append(Part(k, local, samples, samples, np.zeros((len(samples), 0)), run.grid.u[samples],
                              np.ones(len(samples), bool), self.lower / self.size * one, self.upper / self.size * one,
                              self.size * one, self.weight * _share(problem, k) * one, tuple(labels), self.unit))
        return tuple(found)


def _local(system: Any, rows: Callable[..., Any], nd: int) -> ca.Function:
    """Return ``(x, u, p, d) -> (c, dc/dx, dc/dp)`` of the expression `rows`."""
    nx, nu, np_, _ = system.sizes
    x, u, p, d = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", np_), ca.SX.sym("d", nd)
    c = ca.SX(rows(x, u, p, d))
    return ca.Function("rows", [x, u, p, d],
                       [ca.densify(c), ca.densify(ca.jacobian(c, x)), ca.densify(ca.jacobian(c, p))])


def _share(problem: Any, k: int) -> float:
    """RMS of the measured channels in units of their weights: one where the fit is weighted by the RMS."""
    if problem.weights == "rms":
        return 1.0
    run = problem.runs[k]
    ratios = [float(np.nanmean(run.experiment.outputs[c] ** 2)) / run.sigma[c] ** 2 for c in run.sigma]
    return float(np.sqrt(np.mean(ratios))) if ratios else 1.0


def _check_weight(weight: float, what: str) -> None:
    if not (np.isfinite(weight) and weight >= 0):
        raise UsageError(f"{what}: the weight must be at least 0; got {weight!r}.")


__all__ = ["Constraint", "CurrentLimit", "Part", "Segment", "SteadyState", "parameters_of"]

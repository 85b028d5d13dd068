"""What a fit must respect beside the data: a current limit, the steady state, a relation of the user's own.

As a *penalty* its rows add to the residual (`Relation.evaluate`), as a *true constraint* they keep limits (`parts`)."""

import warnings
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from numbers import Real
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from motorid.errors import ModelError, UsageError, positive
from motorid.integrate.engine import Trajectory
from motorid.numerics.signals import Array
from motorid.records.steady_state import SteadySegment, find_segments, segment_between

FEWEST = 64  # samples of a steady segment that are looked at; its means use all
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


@dataclass(frozen=True, eq=False)
class CurrentLimit(Relation):
    """The winding current of the model stays within ``±limit`` at every sample.

    Attributes
    ----------
    limit : float
        A.
    weight : float
        As a penalty each sample adds ``weight·max(0, |i| − limit)/limit`` to a residual in units of the RMS
        of the measured channels (in a fit weighted by the noise: times the ratio of that RMS to the noise).

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor(), runs, formulation="penalty", constraints=[mi.CurrentLimit(8.0)])
    """

    limit: float
    weight: float = 10.0

    def __post_init__(self) -> None:
        if not 1e-9 < self.limit < 1e9:
            raise UsageError(f"CurrentLimit takes a positive current, 1e-9 to 1e9 A; got {self.limit!r}.")
        check_weight(self.weight, "CurrentLimit")

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"CurrentLimit({self.limit:g} A)"

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        system = problem.system
        if "i" not in system.states:
            raise UsageError(f"{self.name}: the base '{problem.model.base}' has no current. Leave the limit out, "
                             "or use dc_motor() with a record of the applied voltage.")
        gradient = np.eye(len(system.states))[system.states.index("i")] / self.limit
        between = Constraint(lambda m: m.i, -self.limit, self.limit, self.limit, self.weight, self.name, "A")
        return tuple(replace(part, gradient=gradient) for part in between.parts(problem))


@dataclass(frozen=True, eq=False)
class SteadyState(Relation):
    """The model's own balances vanish at the measured steady state.

    The measured means of current and speed are put into the voltage and the torque balance; sensor effects are undone
    first, states that were not measured come from the simulation. For the plain motor that is ``v = R i + K ω`` and
    ``K i = b ω``; with effects the relation grows with the model. Steady parts are found in the data, see
    `segments`. At standstill only the voltage balance is used. Standard deviations take the means as exact: too small.

    Attributes
    ----------
    tolerance : float
        As a true constraint: largest balance left over, relative to v and K i (or g v), and three standard errors of
        the measured means.
    weight : float
        As a penalty each balance adds ``weight·√n·(relative balance)``, n being the samples of the segment, to a
        residual in units of the RMS of the measured channels (in a fit weighted by the noise: times its ratio to the
        noise): one off by 1 % weighs as much as a channel off by 1 % of its RMS all through the segment.
    at : sequence of (run, begin, end), optional
        Steady parts given by the user, times in s, instead of those found.

    Examples
    --------
    >>> hard = mi.fit(better.model, runs, solver=mi.MultipleShooting(), constraints=[mi.SteadyState()])
    >>> hard.formulation
    'hard'
    """

    tolerance: float = 0.01
    weight: float = 1.0
    at: Sequence[tuple[int, float, float]] | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise UsageError(f"SteadyState takes a tolerance of at least 0; got {self.tolerance!r}.")
        check_weight(self.weight, "SteadyState")
        for part in self.at or ():
            if not (isinstance(part, Sequence) and len(part) == 3 and all(isinstance(x, Real) for x in part)):
                raise UsageError("SteadyState(at=…) takes (run, begin, end), runs counted from 0 and times in s; "
                                 f"got {part!r}.")

    name = "SteadyState()"

    def segments(self, problem: Any) -> tuple[SteadySegment, ...]:
        """Return the steady parts of the records of `problem`: found in the data, or those given by `at`."""
        if self.at is None:
            return find_segments(problem.experiments, [run.sigma for run in problem.runs])
        found, firsts = [], problem.unknowns.firsts
        records = sorted(set(firsts))  # of which a window, or what lies between pauses, is a part
        for k, begin, end in self.at:
            if not 0 <= k < len(records):
                raise UsageError(f"SteadyState(at=…): there is no run {k}; runs are counted from 0 to "
                                 f"{len(records) - 1}.")
            parts = [segment_between(j, problem.experiments[j], begin, end)
                     for j, first in enumerate(firsts) if first == records[k]]
            if not any(parts):
                raise UsageError(f"SteadyState(at=…): run {k} has no samples between {begin:g} and {end:g} s.")
            found += filter(None, parts)
        return tuple(found)

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        if not (segments := self.segments(problem)):
            warnings.warn("SteadyState: no steady part was found in these records, so it asks for nothing. Name "
                          "the parts, SteadyState(at=[(run, begin, end)]), or leave it out.", stacklevel=4)
        return tuple(part for s in segments if (part := self._part(problem, s)) is not None)

    def _part(self, problem: Any, s: SteadySegment) -> Part | None:
        system, run = problem.system, problem.runs[s.run]
        # The voltage and the torque balance need what was measured; at standstill friction is anything.
        electrical, current = "i" in system.states, "i" in s.means
        wanted = (electrical and current and s.v != 0, s.moving and "omega" in s.means and (current or not electrical))
        if not (names := [n for n, w in zip(("voltage", "torque"), wanted, strict=True) if w]):
            return None
        pick = np.unique(np.linspace(s.first, s.last, min(FEWEST, s.n)).round().astype(int))
        one = np.ones(len(names))
        own = problem.model.values
        torque = abs(own["K"] * s.means["i"] if "K" in own else own["g"] * s.v) or 1.0
        size = np.array([abs(s.v) if n == "voltage" else torque for n in names])
        allowed = (self.tolerance + 3 * sum(_relative_error(run, s, c) for c in s.means)) * one
        weight = self.weight * np.sqrt(s.n) * share(problem, s.run) * one
        unit = "N" if problem.model.axis == "linear" else "N·m"
        labels = tuple(f"{self.name}, {n} balance, run {s.run}, {s.begin:.4g} to {s.end:.4g} s" for n in names)
        rows_of = local(system, partial(_steady_rows, system, s.v, s.means))
        return Part(s.run, rows_of, pick, True, run.grid.u[pick], np.array(wanted), -allowed, allowed, size, weight,
                    labels, tuple({"voltage": "V", "torque": unit}[n] for n in names))

    def penalty(self, c: Array, part: Part) -> tuple[Array, Array]:
        """Return residual and slope as a penalty, the source paper's: zero only where the balance is."""
        return part.weight * c, part.weight


def _steady_rows(system: Any, v: float, means: Mapping[str, float], x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
    """Return the relative balances as an expression of (x, u, p) at the measured means of voltage and channels."""
    u = ca.vertcat(*[v if n == "v" else u[j] for j, n in enumerate(system.inputs)])
    y = system.out(x, u, p)
    state: list[Any] = ca.vertsplit(x)
    for channel, shown in means.items():
        place = system.states.index(channel)
        state[place] = shown
        if channel in system.outputs:
            # One Newton step undoes gains and offsets; a sensor with a lag has settled, it shows its input.
            at = system.outputs.index(channel)
            slope = ca.jacobian(y[at], x[place])
            state[place] = shown if slope.is_zero() else x[place] + (shown - y[at]) / slope
    balances = system.balances(ca.vertcat(*state), u, p)
    par = dict(zip(system.parameters, ca.vertsplit(p), strict=True))
    size = ca.vertcat(v, par["K"] * means["i"] if "K" in par and "i" in means else par.get("g", 1.0) * v)
    return balances / ca.if_else(size == 0, 1.0, size)


def _relative_error(run: Any, s: SteadySegment, channel: str) -> float:
    """Standard error of a measured mean over its size."""
    size = max(abs(s.means[channel]), 1e-300)
    if channel in run.sigma:
        return run.sigma[channel] / np.sqrt(s.n) / size
    return 3.5 * run.sigma.get("theta", 0.0) / np.sqrt(s.n) / max(s.end - s.begin, 1e-300) / size


@dataclass(frozen=True, eq=False)
class Constraint(Relation):
    """A relation of the user's own: ``lower ≤ expression ≤ upper``.

    Attributes
    ----------
    expression : callable
        Of one argument with the states, inputs and parameters as CasADi symbols, e.g. ``lambda m: m.K * m.omega``. Of
        parameters alone: one row. With states or inputs: one row at every sample of every run.
    size : float
        Natural size of the expression, in its unit; scales the row.
    weight : float
        As a penalty: per row, on what lies outside the limits over `size`, in units as in `CurrentLimit`.
    title : str
        What messages call it.

    Examples
    --------
    >>> known = mi.Constraint(lambda m: m.K / m.R, lower=0.03, upper=0.05, title="stall torque per volt")
    >>> fit = mi.fit(mi.dc_motor(), runs, penalties=[known])
    """

    expression: Callable[[Any], Any]
    lower: float = -np.inf
    upper: float = np.inf
    size: float = 1.0
    weight: float = 10.0
    title: str = "Constraint"
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.lower <= self.upper or (np.isinf(self.lower) and np.isinf(self.upper)):
            raise UsageError(f"{self.title}: needs lower ≤ upper with at least one of them finite; got "
                             f"[{self.lower:g}, {self.upper:g}].")
        positive(size=self.size)
        check_weight(self.weight, self.title)

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.title

    def _parts(self, problem: Any) -> tuple[Part, ...]:
        system = problem.system

        def rows(x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
            named = (system.states, x), (system.inputs, u), (system.parameters, p)
            symbols = {n: s for names, v in named for n, s in zip(names, ca.vertsplit(v), strict=True)}
            try:
                return ca.SX(self.expression(SimpleNamespace(**symbols))) / self.size
            except AttributeError as error:
                raise ModelError(f"{self.title}: {error}; known are {', '.join(symbols)}.") from None
            except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:
                raise ModelError(f"{self.title}: its expression is no formula of {', '.join(symbols)} "
                                 f"({type(error).__name__}: {str(error).partition(chr(10))[0]}).") from None

        if (rows_of := local(system, rows)).size1_out(0) != 1:
            raise ModelError(f"{self.title}: the expression must be one number, not {rows_of.size1_out(0)}.")
        constant = not rows_of.jac_sparsity(0, 0).nnz() and not rows_of.jac_sparsity(0, 1).nnz()
        found = []
        for k, run in enumerate(problem.runs[:1] if constant else problem.runs):
            t = run.experiment.t[:1] if constant else run.experiment.t
            n, one = len(t), np.ones(len(t))
            labels = [self.title if constant else f"{self.title}, run {k}, t = {at:.6g} s" for at in t]
            found.append(Part(k, rows_of, np.arange(n), False, run.grid.u[:n], np.ones(n, bool),
                              self.lower / self.size * one, self.upper / self.size * one, self.size * one,
                              self.weight * share(problem, k) * one, tuple(labels), (self.unit,) * n))
        return tuple(found)

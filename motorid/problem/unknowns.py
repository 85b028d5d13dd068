"""The unknowns q of a problem: free parameters of the model, then estimated initial states, run by run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorid.channels import CHANNELS, UNITS
from motorid.model.definition import Parameter
from motorid.model.equations import System
from motorid.numerics.signals import Array
from motorid.problem.runs import Run, natural_sizes, spread_of, top_acceleration
from motorid.records.experiment import record_of


class Point(NamedTuple):
    """One q in the system's terms: physical values and slopes (nq,), p (np,) and dp/dq (np, nq)."""

    q: Array
    physical: Array
    slope: Array
    p: Array
    dp: Array


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Which unknowns there are, and how they enter the system."""

    system: System
    parameters: Mapping[str, Parameter]  # all of the model, fixed ones too
    runs: tuple[Run, ...]
    first_stands: bool = False  # the first run's own parameters are none, whatever else is free

    @cached_property
    def free(self) -> tuple[Parameter, ...]:
        """Free parameters of the model that all runs share."""
        return tuple(p for p in self.parameters.values() if p.vary and not p.per_run)

    @cached_property
    def apart(self) -> tuple[tuple[str, int, Parameter], ...]:
        """(name, run, unknown) of each parameter that is another in every run; parts of one record share theirs. The
        first's value stands, since phases or resistances take it up; unless nothing else is free, as on other runs."""
        own = [p for p in self.parameters.values() if p.vary and p.per_run]
        return tuple((p.name, k, replace(p, name=f"{p.name}[{k}]", value=self.runs[k].apart.get(p.name, p.value)))
                     for p in own for k in sorted(set(self.firsts))[1 if self.free or self.first_stands else 0:])

    @cached_property
    def firsts(self) -> tuple[int, ...]:
        """Per run, the first one of the same record."""
        records = [record_of(run.experiment) for run in self.runs]
        return tuple(records.index(r) for r in records)

    @cached_property
    def initial(self) -> tuple[tuple[str, int, Parameter], ...]:
        """(channel, run, parameter) of each estimated initial state; of a current that was not measured by how it
        accelerates the motor, whatever R and K: it is no kick at the start beyond what the records show."""
        found = []
        free = {c for c, stored in zip(self.system.states, self.system.stored, strict=True) if stored}
        held = sum(abs(p.value) for p in self.parameters.values() if p.null == 0 and p.unit in ("N·m", "N"))
        alone = [run.experiment for run in self.runs if "i" in run.limits and "i" not in run.experiment.outputs]
        quickest = (top_acceleration([run.experiment for run in self.runs]) if alone else 0.0) or np.inf
        quickest += held / self.parameters["J"].value  # what a load takes accelerates nothing
        for k, run in enumerate(self.runs):
            for c, (low, high) in run.limits.items():
                if c in free:  # an algebraic current follows from the rest
                    unit, begin = run.experiment.units.get(c, UNITS[c][0]), float(run.start[CHANNELS.index(c)])
                    if c == "i" and c not in run.experiment.outputs:
                        unit, low, high = "rad/s²", min(-quickest, begin), max(quickest, begin)
                    if any(p.null == 0 and p.unit == unit for p in self.parameters.values()):
                        low, high = min(low, 0.0), max(high, 0.0)  # what was measured there may be the sensor's offset
                    found.append((c, k, Parameter(f"{c}_0[{k}]", begin, unit, low, high)))
        return tuple(found)

    @cached_property
    def all(self) -> tuple[Parameter, ...]:
        """Every unknown, in the order of q."""
        return (*self.free, *(p for _, _, p in self.initial), *(p for _, _, p in self.apart))

    @cached_property
    def scaling(self) -> "Scaling":
        """Solver coordinates: logarithmic for positive parameters, else in natural sizes of the records."""
        sizes, natural = [abs(p.value) for p in self.free], dict[str, float]()
        if self.apart or not all(p.positive for p in self.free):
            natural = natural_sizes([r.experiment for r in self.runs], {n: p.value for n, p in self.parameters.items()})
            sizes = [s if p.positive else max(s, natural.get(p.unit, 0.0))
                     for p, s in zip(self.free, sizes, strict=True)]
        spreads = [p.upper if c == "i" and self._accelerated(k) and np.isfinite(p.upper) else
                   spread_of(self.runs[k].experiment, c) for c, k, p in self.initial]
        return Scaling.of(self.all, [*sizes, *spreads, *(natural.get(p.unit, 1.0) for *_, p in self.apart)])

    @cached_property
    def start(self) -> Array:
        """Solver coordinates of the present values."""
        return self.scaling.scaled([p.value for p in self.all])

    def values(self, physical: Array) -> dict[str, float]:
        """Return all parameter values of the model, SI, for `physical` values of the unknowns."""
        fitted = zip((p.name for p in self.free), physical.tolist(), strict=False)
        return {**{n: p.value for n, p in self.parameters.items()}, **dict(fitted)}

    def principal(self, q: Array) -> Array:
        """Return `q` with its phase angles, whole turns of which mean nothing, within ±π."""
        turns = np.array([p.periodic and np.isinf([p.lower, p.upper]).all() for p in self.all], bool)
        size = self.scaling.scale
        return np.where(turns, (np.remainder(q * size + np.pi, 2 * np.pi) - np.pi) / size, q)

    @cached_property
    def _places(self) -> Sequence[tuple[list[int], list[int]]]:
        """Per run: indices into (i, omega, theta) at the start, and the columns of q that they are."""
        places: list[tuple[list[int], list[int]]] = [([], []) for _ in self.runs]
        for j, (channel, k, _) in enumerate(self.initial, len(self.free)):
            places[k][0].append(CHANNELS.index(channel))
            places[k][1].append(j)
        return places

    @cached_property
    def seen_by(self) -> tuple[NDArray[np.int64], ...]:
        """Per run: the columns of q that it depends on, what all share and its own."""
        shared, initial, apart = [True] * len(self.free), [k for _, k, _ in self.initial], [k for _, k, _ in self.apart]
        return tuple(np.flatnonzero([*shared, *(j == k for j in initial), *(j == first for j in apart)])
                     for k, first in enumerate(self.firsts))

    def point(self, q: Array) -> Point:
        """Return `q` in the system's terms."""
        physical = self.scaling.physical(q)
        slope = np.where(self.scaling.log, physical, self.scaling.scale)
        names, n = self.system.parameters, len(self.free)
        p, places = np.array([self.parameters[n].value for n in names]), [names.index(f.name) for f in self.free]
        p[places] = physical[:n]
        dp = np.zeros((len(p), len(q)))
        dp[places, np.arange(n)] = slope[:n]
        return Point(q, physical, slope, p, dp)

    def of_run(self, at: Point, k: int) -> Point:
        """Return `at` with the parameters that run `k` has for itself."""
        first = len(self.free) + len(self.initial)
        if not (mine := [(n, j) for j, (n, run, _) in enumerate(self.apart, first) if run == self.firsts[k]]):
            return at
        rows, columns = [self.system.parameters.index(n) for n, _ in mine], [j for _, j in mine]
        p, dp = at.p.copy(), at.dp.copy()
        p[rows], dp[rows, columns] = at.physical[columns], at.slope[columns]
        return at._replace(p=p, dp=dp)

    def first_state(self, at: Point, k: int) -> Array:
        """Return x0 (nx,) of run `k`."""
        return self.system.first_state(self.sensed(at, k), at.p)

    def first_slopes(self, at: Point, k: int, along: Array | None = None) -> Array:
        """Return dx0/dq (nx, nq) of run `k`, or the slopes (nx, m) along other directions of p (np, m)."""
        sensed = self.sensed(at, k)
        js, jp = self.system.first_slopes(sensed, at.p)
        if self._accelerated(k):
            (i, omega, _), js, jp = sensed, js.copy(), jp.copy()
            (iJ, ib, iK), (J, b, K) = self._inertial, at.p[self._inertial]
            by_current = js[:, :1] / K
            jp[:, [iJ, ib, iK]] += by_current * np.array([(K * i - b * omega) / J, omega, -i])
            js[:, :2] = np.hstack([by_current * J, js[:, 1:2] + by_current * b])
        if along is not None:
            return jp @ along
        rows, columns = self._places[k]
        dx0 = jp @ at.dp
        dx0[:, columns] += js[:, rows] * at.slope[columns]
        return dx0

    def sensed(self, at: Point, k: int) -> Array:
        """Return (i, omega, theta) of run `k` at its start, as a sensor shows them, (3,)."""
        rows, columns = self._places[k]
        start = self.runs[k].start.copy()
        start[rows] = at.physical[columns]
        if self._accelerated(k):
            J, b, K = at.p[self._inertial]
            start[0] = (J * start[0] + b * start[1]) / K
        return start

    def _accelerated(self, k: int) -> bool:
        """Tell whether the first current of run `k` is unknown, as how it accelerates the motor."""
        return 0 in self._places[k][0] and "i" not in self.runs[k].experiment.outputs

    @cached_property
    def _inertial(self) -> list[int]:
        """Places of J, b and K in p."""
        return [self.system.parameters.index(n) for n in "JbK"]


@dataclass(frozen=True, eq=False)
class Scaling:
    """Solver coordinates q of the physical values p: ``p = s·exp(q)`` where `log`, else ``p = s·q``; all (n,)."""

    scale: NDArray[np.float64]  # positive sizes s
    log: NDArray[np.bool_]
    lower: NDArray[np.float64]  # limits of p
    upper: NDArray[np.float64]

    @staticmethod
    def of(parameters: Iterable[Parameter], sizes: ArrayLike | None = None) -> "Scaling":
        """Return the scaling of `parameters`; `sizes` (n,) replaces the size read from their values."""
        pars = list(parameters)
        scale = np.abs(np.array([p.value for p in pars] if sizes is None else sizes, float))
        scale = np.where((scale > 0) & np.isfinite(scale), scale, 1.0)
        log = np.array([p.positive for p in pars], bool)
        return Scaling(scale, log, np.array([p.lower for p in pars], float), np.array([p.upper for p in pars], float))

    def physical(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return p of q."""
        q = np.asarray(q, float)
        return self.scale * np.where(self.log, np.exp(np.where(self.log, np.clip(q, -200, 200), 0.0)), q)

    def scaled(self, p: ArrayLike) -> NDArray[np.float64]:
        """Return q of p."""
        ratio = np.asarray(p, float) / self.scale
        return np.where(self.log, np.log(np.maximum(ratio, np.finfo(float).tiny)), ratio)

    def slope(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return dp/dq at q, shape (n,)."""
        return np.where(self.log, self.physical(q), self.scale)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Limits in q."""
        with np.errstate(divide="ignore"):
            low, high = (np.where(self.log, np.log(np.maximum(p, 0.0) / self.scale), p / self.scale)
                         for p in (self.lower, self.upper))
        return low, high

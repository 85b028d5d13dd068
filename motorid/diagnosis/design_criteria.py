"""What a voltage would tell about rival models, and its gradient: a designed experiment as an NLP.

The unknowns are voltage levels. Each rival is driven by them through the discrete step of the fits, whose exact
derivatives carry the slopes with respect to levels and parameters over the record. What earlier records tell about the
parameters enters as a Gaussian prior with their information matrix (Gauss-Newton).

- Distinguishing (T-optimality: Atkinson & Fedorov, Biometrika 62, 1975): the χ² that is left between the predictions of
  two rivals after **both** have moved their parameters as far as old and new records let them. At that minimum the
  gradient needs first derivatives only (Danskin).
- Sharpening (D_s-optimality: Atkinson, Donev & Tobias, Optimum Experimental Designs, 2007, ch. 10): log det of the
  information on the asked parameters, the others estimated too. Its gradient takes differences, along few directions
  of the parameters, of the exact slopes with respect to the levels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, permutations
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from motorid.acquire.excitation import program
from motorid.errors import OutOfTime, SimulationError, UsageError
from motorid.estimation.result import Fit
from motorid.estimation.shooting.nlp import callbacks
from motorid.integrate.engine import Grid
from motorid.integrate.rosenbrock import Rosenbrock
from motorid.model.equations import System
from motorid.model.model import Model
from motorid.numerics.parallel import check_time, interruption
from motorid.numerics.signals import Array
from motorid.problem.unknowns import Scaling

STEPS = 4  # Gauss-Newton steps of the rivals' refit within one evaluation
REGION = 2.0  # standard deviations within which the truth may lie
SETTLED = 0.01  # relative fall of χ² at which it ends
ROUNDING = 1e-10  # of the information, beside which the prior of one unit would be lost
BESIDE = 1e-4  # of a unit of the solver's coordinates, for differences of slopes
DEVIATIONS = 3.0  # of the prediction that a limit keeps away
NOISES = 4.0  # standard deviations of the sensor's noise that it keeps away besides
LARGEST_MARGIN = 0.5  # of a limit; what is less certain than that is left to the check by draws
ENGINE = Rosenbrock()


@dataclass(frozen=True, eq=False)
class Rival:
    """A model at its fitted values, and how well the records know them.

    Attributes
    ----------
    name : str
        The effects by which it differs from the others.
    model : Model
    sigma : dict of str to float
        Error of one sample per measured channel, SI: noise times misfit.
    scale : ndarray, shape (k,)
        Sizes of the solver's coordinates of the free parameters: logarithms of positive ones, else in units of this.
    information : ndarray, shape (k, k)
        Of the records on these coordinates, initial states estimated too.
    seen : dict of str to float
        Largest size of each channel in the records, and their ``duration`` and ``dt``.
    """

    name: str
    model: Model
    sigma: Mapping[str, float]
    scale: Array
    information: Array
    seen: Mapping[str, float]

    @staticmethod
    def of(fit: Fit, name: str = "") -> Rival:
        """Return the rival that a fit is."""
        problem, k = fit.problem, len(fit.problem.unknowns.free)
        runs = problem.experiments
        sigma = {c: max(s, 1e-300) * max(fit.misfit[c], 1.0) for c, s in fit.noise.items() if c in problem.outputs}
        n = problem.n_outputs
        jac, r = fit.jacobian[:n] * problem.scaling.slope(fit.q), fit.residuals[:n]
        whole = jac.T @ jac / max(float(r @ r) / fit.dof, float(problem.weights == "noise"))
        # What is another in every run, initial states above all, is estimated too (Schur's complement).
        known = whole[:k, :k] - whole[:k, k:] @ np.linalg.pinv(whole[k:, k:], hermitian=True) @ whole[k:, :k]
        seen = {c: max(float(np.nanmax(np.abs({**r.inputs, **r.outputs}[c]))) for r in runs
                       if c in {**r.inputs, **r.outputs}) for c in ("v", *sigma)}
        seen |= {"duration": max(r.duration for r in runs), "dt": float(np.median([r.dt for r in runs]))}
        of_runs = [n for n, p in fit.model.parameters.items() if p.vary and p.per_run]  # as in the first run
        return Rival(name or fit.model.title, fit.model.with_(angle_input=False).fix(*of_runs), sigma,
                     problem.scaling.scale[:k], known, seen)

    @cached_property
    def scaling(self) -> Scaling:
        """The solver's coordinates of the free parameters."""
        return Scaling.of([self.model.parameters[n] for n in self.model.free_names], self.scale)

    @cached_property
    def known(self) -> Array:
        """Information before the experiment, with a prior of one unit (a factor of e) that keeps it regular."""
        return self.information + np.eye(len(self.scale)) + ROUNDING * np.diag(np.diag(self.information))

    def deviations(self, information: Array) -> dict[str, float]:
        """Return one standard deviation per free parameter, SI, of an information matrix."""
        names = self.model.free_names
        slope = self.scaling.slope(self.scaling.scaled([self.model.values[n] for n in names]))
        variances = np.maximum(np.diag(np.linalg.inv(information)), 0.0)
        return dict(zip(names, (np.sqrt(variances) * slope).tolist(), strict=True))

    def draws(self, n: int, rng: np.random.Generator) -> Array:
        """Return `n` displacements (n, k) of the parameters as uncertain as the records leave them."""
        return rng.multivariate_normal(np.zeros(len(self.scale)), np.linalg.inv(self.known), n, method="eigh")

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, the model as in ``fit --json``."""
        m = self.model
        return {"name": self.name, "model": {"base": m.base, "axis": m.axis, "effects": list(m.effect_names)},
                "parameters": {n: {"value": p.value, "unit": p.unit, "fixed": not p.vary}
                               for n, p in m.parameters.items()},
                "sigma": dict(self.sigma), "scale": self.scale.tolist(), "information": self.information.tolist(),
                "seen": dict(self.seen)}

    @staticmethod
    def from_dict(contents: Mapping[str, Any], model: Model) -> Rival:
        """Return what `to_dict` wrote, its model built already."""
        sigma, seen = ({str(k): float(v) for k, v in contents[part].items()} for part in ("sigma", "seen"))
        scale, information = (np.asarray(contents[part], float) for part in ("scale", "information"))
        sizes = np.array([*sigma.values(), *scale, *(seen[k] for k in ("v", "dt", "duration"))])
        if not (np.all(sizes > 0) and np.isfinite([*sizes, *information.ravel()]).all()):
            raise ValueError("sizes of a rival must be finite and above zero")
        return Rival(str(contents["name"]), model, sigma, scale, information, seen)


@dataclass(frozen=True, eq=False)
class Layout:
    """How unknowns become a voltage: segments of whole milliseconds, each a step or a ramp between two levels.

    On a step, a pseudo-random binary signal of its own amplitude may ride: it shows what is quick.

    Attributes
    ----------
    ms : tuple of int
        Lengths of the segments.
    dt : float
        s between samples.
    bits : tuple of int
        ms per bit on each step; empty for ramps from one level to the next.
    mixing : ndarray, shape (levels, unknowns), or None
        Levels, in units of `v_max`, of the unknowns; None: they are the unknowns.
    v_max : float
    """

    ms: tuple[int, ...]
    dt: float
    bits: tuple[int, ...]
    mixing: Array | None
    v_max: float

    @property
    def ramps(self) -> bool:
        """Whether segments are ramps."""
        return not self.bits

    @property
    def levels(self) -> int:
        """Number of levels; the amplitudes on steps count as well."""
        return len(self.ms) + (len(self.bits) or 1)

    @cached_property
    def edges(self) -> NDArray[np.int64]:
        """Sample at which each segment begins, and the end."""
        return np.concatenate([[0], np.cumsum([max(1, round(ms / 1e3 / self.dt)) for ms in self.ms])])

    @cached_property
    def inputs(self) -> Array:
        """At each sample and the end, (N+1, 2): how far its segment has come, 0 … 1, and its binary signal."""
        found = np.zeros((int(self.edges[-1]) + 1, 2))
        for j, (a, b) in enumerate(pairwise(self.edges)):
            found[a:b, 0] = np.arange(b - a) * self.dt * 1e3 / self.ms[j]
            if self.bits:
                found[a:b, 1] = program(self._riding(j, 0.0, 1.0)).volts(1 / self.dt)
        return found

    def voltage(self, levels: Array) -> Array:
        """Return the voltage at each sample and the end, (N+1,)."""
        n = len(self.ms)
        owner = np.minimum(np.searchsorted(self.edges, np.arange(self.edges[-1] + 1), "right") - 1, n - 1)
        low, high, ripple = levels[owner], levels[owner + self.ramps], levels[n + owner] if self.bits else 0.0
        return low + (high - low) * self.inputs[:, 0] + ripple * self.inputs[:, 1]

    def _riding(self, j: int, level: float, amplitude: float) -> str:
        return f"prbs:{amplitude:g}:{self.bits[j] / 1e3:g}:{self.ms[j] / 1e3:g}:{level:g}:{1 + 37 * j}"

    def of(self, c: Array) -> Array:
        """Return the levels, V, of the unknowns."""
        return self.v_max * (c if self.mixing is None else self.mixing @ c)

    def places(self, j: int) -> tuple[int, int, int]:
        """Return which levels are the voltage at both ends of segment `j`, and the amplitude on it (-1: none)."""
        return j, j + self.ramps, len(self.ms) + j if self.bits else -1

    def at(self, levels: Array, j: int) -> tuple[float, float, float]:
        """Return the voltages at both ends of segment `j`, and the amplitude on it."""
        a, b, ripple = self.places(j)
        return float(levels[a]), float(levels[b]), float(levels[ripple]) if self.bits else 0.0

    def words(self, levels: Array) -> str:
        """Return the excitation that `motorid record` plays."""
        words = []
        for j, ms in enumerate(self.ms):
            a, b, ripple = (round(x, 3) + 0.0 for x in self.at(levels, j))
            flat = f"step:{a:g}:{ms / 1e3:g}" if a else f"rest:{ms / 1e3:g}"
            words.append(self._riding(j, a, ripple) if ripple else flat if a == b else f"ramp:{a:g}:{b:g}:{ms / 1e3:g}")
        return ",".join(words)


def voltage_as_parameters(system: System) -> System:
    """Return the system with voltages as parameters.

    To its input come v_from … v_to, as a second input goes from 0 to 1, and v_on times a third.
    """
    nx, _, k, _ = system.sizes
    x, u, p, s, d = (ca.SX.sym(n, m) for n, m in (("x", nx), ("u", 3), ("p", k + 3), ("s", 3), ("d", 2)))
    v, own = u[0] + p[k] + (p[k + 1] - p[k]) * u[1] + p[k + 2] * u[2], p[:k]
    made = {n: ca.Function(n, [x, u, p, *more], [getattr(system, n)(x, v, own, *more)])
            for n, more in (("rhs", []), ("out", []), ("balances", []), ("forces", [d]))}
    return replace(system, inputs=("v", "share", "code"), parameters=(*system.parameters, "v_from", "v_to", "v_on"),
                   initial=ca.Function("initial", [s, p], [system.initial(s, own)]), **made)


class Response(NamedTuple):
    """What a rival answers: x (N, nx), y (N, ny) over its errors; their slopes by level, then by parameter."""

    x: Array
    y: Array
    dx: Array
    dy: Array


@dataclass(frozen=True, eq=False)
class Driven:
    """A rival driven by levels; `errors` (ny,) of one sample per channel are common to all rivals."""

    rival: Rival
    layout: Layout
    system: System
    errors: Array
    substeps: NDArray[np.int64]

    @staticmethod
    def of(rival: Rival, layout: Layout, errors: Mapping[str, float], angle: bool) -> Driven:
        """Return it with one integration step per sample."""
        system = rival.model.system({*errors, *(("theta",) if angle else ())})
        if system.inputs != ("v",):
            raise UsageError(f"{rival.name}: a model with measured inputs ({', '.join(system.inputs[1:])}) cannot be "
                             "used to design an experiment: nobody knows them beforehand.")
        system = voltage_as_parameters(system)
        sizes = np.array([errors.get(c, np.inf) for c in system.outputs])
        return Driven(rival, layout, system, sizes, np.ones(int(layout.edges[-1]), int))

    def grid(self, levels: Array | None) -> Grid:
        """Return samples and inputs: the voltage of `levels`, or (None) what makes a voltage of the parameters."""
        shapes = self.layout.inputs
        u = np.column_stack([0 * shapes[:, 0], shapes] if levels is None else
                            [self.layout.voltage(levels), 0 * shapes])
        t = np.linspace(0, self.layout.dt * (len(u) - 1), len(u))
        return Grid.of(t, u, np.ones(3, bool)).with_substeps(self.substeps)

    @cached_property
    def _parts(self) -> list[Grid]:
        whole = self.grid(None)
        return [whole.part(int(a), int(b)) for a, b in pairwise(self.layout.edges)]

    def parameters(self, delta: Array) -> tuple[Array, Array]:
        """Return p (np,) of the model, the voltage's places empty, and the slopes of the free ones."""
        model, scaling = self.rival.model, self.rival.scaling
        q = np.clip(scaling.scaled([model.values[n] for n in model.free_names]) + delta, *scaling.bounds)
        values = {**model.values, **dict(zip(model.free_names, scaling.physical(q).tolist(), strict=True))}
        return np.array([values.get(n, 0.0) for n in self.system.parameters]), scaling.slope(q)

    def respond(self, levels: Array, delta: Array, by_level: bool = False, by_parameter: bool = False) -> Response:
        """Simulate from rest at angle zero.

        Raises
        ------
        SimulationError
        """
        (p, slope), m = self.parameters(delta), len(levels) if by_level else 0
        place = [self.system.parameters.index(n) for n in self.rival.model.free_names]
        k = len(place) if by_parameter else 0
        dp = np.zeros((len(p), m + k))
        if k:
            dp[place, m + np.arange(k)] = slope
        x, dx = self.system.first_state(np.zeros(3), p), self.system.first_slopes(np.zeros(3), p)[1] @ dp
        parts = []
        for j, grid in enumerate(self._parts if m else [self.grid(levels)]):
            here = dp.copy()
            if m:
                p[-3:] = self.layout.at(levels, j)
                for row, column in zip((-3, -2, -1), self.layout.places(j), strict=True):
                    here[row, column] += column >= 0
            traj = ENGINE.run(self.system, grid, x, p, dx, here) if m + k else ENGINE.run(self.system, grid, x, p)
            parts.append((traj.x, traj.y, *(np.zeros((1, 1, 0)) if d is None else d for d in (traj.dx, traj.dy))))
            x, dx = parts[-1][0][-1], parts[-1][2][-1]
        # The last sample of a part is the first of the next.
        x, y, dx, dy = (np.concatenate([*(a[:-1] for a in each[:-1]), each[-1]]) for each in zip(*parts, strict=True))
        if not np.abs(y).max() < 1e100:
            raise SimulationError("a rival grows without bound under this voltage.")
        return Response(x, y / self.errors, dx, dy / self.errors[:, None])

    def refined(self, levels: Array, tolerance: float) -> Driven:
        """Return it with sub-steps that keep the integration's error under this voltage below `tolerance`."""
        p, _ = self.parameters(np.zeros(len(self.rival.scale)))
        grid = replace(self, substeps=np.ones_like(self.substeps)).grid(levels)
        fine = ENGINE.prepare(self.system, grid, self.system.first_state(np.zeros(3), p), p, tolerance)
        return replace(self, substeps=np.maximum(fine.substeps, self.substeps))

    def informs(self, response: Response) -> Array:
        """Return the information (k, k) on the parameters, old and new."""
        k = len(self.rival.scale)
        s = response.dy[:, :, -k:].reshape(-1, k)
        return self.rival.known + s.T @ s


class Value(NamedTuple):
    """A criterion and its gradient by level, empty where it was not asked for."""

    value: float
    slope: Array = np.zeros(0)


def separation(truth: Driven, rival: Driven, levels: Array, ra: Response, rb: Response, slopes: bool,
               region: float = REGION) -> Value:
    """Return the χ² that a rival leaves where another model is the truth, once fitted to old and new records.

    The truth is the least favourable one within `region` standard deviations of its values. `ra` and `rb` are the
    answers at the values of the old records, with slopes by parameter.
    """
    k, both = len(truth.rival.scale), (truth, rival)
    prior = np.zeros((2, k + len(rival.rival.scale), k + len(rival.rival.scale)))
    prior[0, :k, :k], prior[1, k:, k:] = truth.rival.known, rival.rival.known
    delta, chi2 = np.zeros(len(prior[0])), float(np.sum((ra.y - rb.y) ** 2))
    for _ in range(STEPS):
        s = np.concatenate([ra.dy[:, :, -k:], -rb.dy[:, :, k - len(delta):]], axis=2).reshape(-1, len(delta))
        error = (ra.y - rb.y).ravel()
        step = _worst_case(s.T @ s, s.T @ (s @ delta - error), prior, region) - delta
        before, after = chi2, error + s @ step
        if after @ after + (delta + step) @ prior[1] @ (delta + step) > (1 - SETTLED) * chi2:
            break
        for share in (1.0, 0.5, 0.2):
            trial = delta + share * step
            try:
                ta, tb = (f.respond(levels, d, by_parameter=True)
                          for f, d in zip(both, np.split(trial, [k]), strict=True))
            except SimulationError:
                continue
            value = float(np.sum((ta.y - tb.y) ** 2) + trial @ prior[1] @ trial)
            if value < chi2:
                delta, chi2, ra, rb = trial, value, ta, tb
                break
        if chi2 > (1 - SETTLED) * before:
            break
    if not slopes:
        return Value(chi2)
    ga, gb = (f.respond(levels, d, by_level=True).dy for f, d in zip(both, np.split(delta, [k]), strict=True))
    return Value(chi2, 2 * np.tensordot(ra.y - rb.y, ga - gb, 2))


def _worst_case(normal: Array, right: Array, prior: Array, region: float) -> Array:
    """Return δ that minimises ½δᵀ(normal + prior₁)δ − rightᵀδ where δᵀ·prior₀·δ is at most `region`², by bisection."""
    low, high = -12.0, 12.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        delta = np.linalg.solve(normal + prior[1] + 10**middle * prior[0], right)
        low, high = (middle, high) if delta @ prior[0] @ delta > region**2 else (low, middle)
    return np.linalg.solve(normal + prior[1] + 10**high * prior[0], right)


def precision(a: Driven, asked: Sequence[int], levels: Array, response: Response, slopes: bool) -> Value:
    """Return log det of the information on the asked parameters, the others estimated too."""
    information = a.informs(response)
    k = len(information)
    others = [j for j in range(k) if j not in asked]
    weight = np.linalg.inv(information)
    value = float(np.linalg.slogdet(information)[1])
    if others:
        rest = information[np.ix_(others, others)]
        value -= float(np.linalg.slogdet(rest)[1])
        weight[np.ix_(others, others)] -= np.linalg.inv(rest)
    if not slopes:
        return Value(value)
    sizes, directions = np.linalg.eigh(weight)  # of rank len(asked)
    slope = np.zeros(len(levels))
    for size, way in list(zip(sizes, directions.T, strict=True))[-len(asked):]:
        up, down = (a.respond(levels, s * BESIDE * way, by_level=True).dy for s in (1, -1))
        slope += 2 * size * np.tensordot(response.dy[:, :, -k:] @ way, (up - down) / (2 * BESIDE), 2)
    return Value(value, slope)


@dataclass(frozen=True, eq=False)
class Task:
    """What is asked: rivals, limits of their states (low, high), and what is to become as large as can be.

    Attributes
    ----------
    driven : tuple of Driven
    limits : dict of str to (float, float)
        By state: i, omega, theta, dT; SI.
    noise : dict of str to float
        Of the channels' sensors, SI.
    asked : tuple of str
        Parameters to sharpen; empty: distinguish the rivals.
    pairs : tuple of (int, int)
        (truth, rival) to distinguish.
    slew : float
        Largest change of the voltage along a ramp, V/s.
    nominal : frozenset of (int, int)
        Pairs whose truth is taken as it was fitted: within its uncertainty nothing would distinguish them.
    """

    driven: tuple[Driven, ...]
    limits: Mapping[str, tuple[float, float]]
    noise: Mapping[str, float]
    asked: tuple[str, ...]
    pairs: tuple[tuple[int, int], ...]
    slew: float
    nominal: frozenset[tuple[int, int]] = frozenset()

    @property
    def layout(self) -> Layout:
        """How levels become a voltage."""
        return self.driven[0].layout

    def refined(self, levels: Array, tolerance: float) -> Task:
        """Return the task with integration steps that suit `levels`."""
        return replace(self, driven=tuple(d.refined(levels, tolerance) for d in self.driven))

    def respond(self, levels: Array, by_level: bool = False) -> list[Response]:
        """Return the rivals' answers, at the values of the old records, with slopes by parameter."""
        return [d.respond(levels, np.zeros(len(d.rival.scale)), by_level, True) for d in self.driven]

    def criteria(self, levels: Array, answers: Sequence[Response], slopes: bool) -> list[Value]:
        """Return what the experiment is worth, in nats: per pair log(1 + χ²), or per rival and asked parameter."""
        found = []
        if self.asked:
            for d, r in zip(self.driven, answers, strict=True):
                places = [d.rival.model.free_names.index(n) for n in self.asked]
                value, slope = precision(d, places, levels, r, slopes)
                size = 2 * len(places)
                found.append(Value(value / size, slope / size))
            return found
        for i, j in self.pairs:
            value, slope = separation(self.driven[i], self.driven[j], levels, answers[i], answers[j], slopes,
                                      0.0 if (i, j) in self.nominal else REGION)
            found.append(Value(float(np.log1p(value)), slope / (1 + value)))
        return found

    def extremes(self, answers: Sequence[Response]) -> tuple[Array, Array, Array, Array]:
        """Return the extremes of each limited state in each segment: values, slopes, lower and upper limits, scaled.

        A limit is kept away from by the prediction's own deviation and the sensor's noise.
        """
        found = []
        for d, r in zip(self.driven, answers, strict=True):
            k, cov = len(d.rival.scale), np.linalg.inv(d.rival.known)
            for s in (s for s in self.limits if s in d.system.states):
                j, (low, high) = d.system.states.index(s), self.limits[s]
                x, size = r.x[:, j], min(abs(low), abs(high))
                at = [a + f(x[a:b + 1]) for a, b in pairwise(d.layout.edges) for f in (np.argmax, np.argmin)]
                slopes = r.dx[at, j]
                sd = np.sqrt(np.einsum("ij,jk,ik->i", slopes[:, -k:], cov, slopes[:, -k:]))
                margin = np.minimum(DEVIATIONS * sd + NOISES * self.noise.get(s, 0.0), LARGEST_MARGIN * size)
                upper = np.arange(len(at)) % 2 == 0
                found.append((x[at] / size, slopes[:, :-k] / size, np.where(upper, -np.inf, (low + margin) / size),
                              np.where(upper, (high - margin) / size, np.inf)))
        values, slopes, low, high = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return values, slopes, low, high


class DesignNlp:
    """Maximise the least criterion under the limits: unknowns (c, z), z below every criterion.

    Limits of the states hold at the largest and the smallest value of each segment. `best` is the best point met that
    keeps them; a budget of time or Ctrl-C ends the search there.
    """

    scale = 1.0

    def __init__(self, task: Task, c: Array) -> None:
        self.task = task
        self._kept: tuple[bytes, bool, Any] = (b"", False, None)
        self._linear, low, high = _linear_rows(task)
        self._n = len(c)
        self.stopped = False
        self.best, self.best_value = c, -np.inf
        answers = task.respond(task.layout.of(c))
        _, _, lower, upper = task.extremes(answers)
        self._count = len(task.criteria(task.layout.of(c), answers, False))
        self.lower = np.concatenate([np.zeros(self._count), lower, low])
        self.upper = np.concatenate([np.full(self._count, np.inf), upper, high])

    def start(self) -> Array:
        """Return (c, z) at the best point so far."""
        found = self._at(np.append(self.best, 0.0), False)
        return np.append(self.best, 0.0 if found is None else found[0].min())

    def _evaluate(self, c: Array, slopes: bool) -> tuple[Array, Array, Array | None]:
        """Return criteria, rows of limits, and the Jacobian of both by the unknowns."""
        task, layout = self.task, self.task.layout
        levels = layout.of(c)
        answers = task.respond(levels, slopes)
        worth, (extremes, by_level, _, _) = task.criteria(levels, answers, slopes), task.extremes(answers)
        values, limited = np.array([w.value for w in worth]), np.concatenate([extremes, self._linear @ c])
        if not slopes:
            return values, limited, None
        by_level = np.vstack([*(w.slope for w in worth), by_level])
        by_unknown = by_level @ (layout.v_max * (np.eye(layout.levels) if layout.mixing is None else layout.mixing))
        return values, limited, np.vstack([by_unknown, self._linear])

    def _at(self, z: Array, slopes: bool) -> Any:
        key, had, found = self._kept
        if key == z[:-1].tobytes() and (had or not slopes):
            return found
        try:
            check_time()
            found = None if self.stopped else self._evaluate(z[:-1], slopes)
        except (SimulationError, np.linalg.LinAlgError):
            found = None
        except (OutOfTime, KeyboardInterrupt):
            interruption.heard()
            self.stopped, found = True, None
        self._kept = z[:-1].tobytes(), slopes, found
        if found is not None:
            n, rows = self._count, found[1]
            inside = np.all(rows <= self.upper[n:] + 1e-6) and np.all(rows >= self.lower[n:] - 1e-6)
            if inside and found[0].min() > self.best_value:
                self.best, self.best_value = z[:-1].copy(), float(found[0].min())
        return found

    def values(self, z: Array) -> list[Any]:
        """Return f and g."""
        found = self._at(z, False)
        if found is None:
            return [np.nan, np.full(len(self.lower), np.nan)]
        return [-z[-1], np.concatenate([found[0] - z[-1], found[1]])]

    def gradient(self, z: Array) -> list[Any]:
        """Return f and its gradient."""
        return [-z[-1], np.append(np.zeros(self._n), -1.0)]

    def jacobian(self, z: Array) -> list[Any]:
        """Return g and its Jacobian, column by column."""
        found = self._at(z, True)
        if found is None:
            return [np.full(len(self.lower), np.nan), np.full(len(self.lower) * (self._n + 1), np.nan)]
        last = np.append(-np.ones(self._count), np.zeros(len(self.lower) - self._count))
        return [np.concatenate([found[0] - z[-1], found[1]]), np.column_stack([found[2], last]).ravel(order="F")]

    def functions(self) -> tuple[ca.Callback, dict[str, ca.Callback]]:
        """Return the NLP and its derivatives in CasADi's naming."""
        n, m = self._n + 1, len(self.lower)
        return callbacks(self, n, m, ca.Sparsity.dense(m, n))


def _linear_rows(task: Task) -> tuple[Array, Array, Array]:
    """Return the rows, and their limits, of what is linear in the unknowns: mixed levels, and the slew rate."""
    layout = task.layout
    mix = np.eye(layout.levels) if layout.mixing is None else layout.mixing
    rows, high = [np.zeros((0, mix.shape[1]))], [np.zeros(0)]
    if layout.mixing is not None or layout.bits:
        n = len(layout.ms)
        rows += [mix] if layout.ramps else [mix[:n] + mix[n:], mix[:n] - mix[n:]]
        high += [np.ones(len(r)) for r in rows[1:]]
    if np.isfinite(task.slew):
        rows.append(np.diff(np.vstack([0 * mix[:1], mix, 0 * mix[:1]]), axis=0))
        seconds = np.array([1e-3, *layout.ms, 1e-3]) / 1e3
        high.append(task.slew * seconds / layout.v_max)
    limit = np.concatenate(high)
    return np.vstack(rows), -limit, limit


def all_pairs(n: int) -> tuple[tuple[int, int], ...]:
    """Return (truth, rival) for each two of n models."""
    return tuple(permutations(range(n), 2))

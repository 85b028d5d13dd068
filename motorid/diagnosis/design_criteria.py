"""What a voltage would tell about rival models, its gradient, and the search for the best.

The unknowns are voltage levels. The exact derivatives of the discrete step of the fits carry slopes by levels and by
parameters over the record. What earlier records tell enters as a Gaussian prior with their information matrix.

- Distinguishing (T-optimality: Atkinson & Fedorov, Biometrika 62, 1975): the χ² that is left between the predictions of
  two rivals after **both** have moved their parameters as far as old and new records let them. At that minimum the
  gradient needs first derivatives only (Danskin).
- Sharpening: the product of the asked parameters' variances, the others estimated too; for one of them D_s-optimality
  (Atkinson, Donev & Tobias, Optimum Experimental Designs, 2007, ch. 10). Its gradient takes differences, along one
  direction of the parameters each, of the exact slopes with respect to the levels."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise, product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from motorid.acquire.excitation import lfsr_bits, program
from motorid.errors import OutOfTime, SimulationError, UsageError
from motorid.estimation.least_squares import LOOK, race
from motorid.estimation.result import Fit
from motorid.estimation.start_values import ABOVE
from motorid.integrate.engine import Grid
from motorid.integrate.rosenbrock import Rosenbrock
from motorid.model.definition import Parameter
from motorid.model.equations import System
from motorid.model.model import Model
from motorid.numerics.parallel import check_time, interruption
from motorid.numerics.signals import Array
from motorid.problem.runs import combined, natural_sizes, shapes_of
from motorid.problem.unknowns import Scaling

STEPS = 4  # Gauss-Newton steps of the rivals' refit within one evaluation
ENOUGH = 5.0  # log(1 + χ²) against every rival, from which more is worth nothing
REGION = 2.0  # standard deviations within which the truth may lie
AMOUNTS = tuple(np.geomspace(1e-3, 1.0, 8))  # of the natural size: of an effect that the records leave open
SETTLED = 0.01  # relative fall of χ² at which it ends
ROUNDING = 1e-10  # of the information, beside which the prior of one unit would be lost
BESIDE = 1e-4  # of a unit of the solver's coordinates, for differences of slopes
NOISES = 4.0  # standard deviations of the sensor's noise that a limit keeps away
LARGEST_MARGIN = 0.5  # of a limit
RADIUS, SMALLEST_RADIUS = 0.3, 2e-3  # of the largest voltage: of the first step of the search, and of its last
MOST_STEPS = 25
WORTHWHILE = 2e-3  # nats: a step that promises less ends the search
OVER = 1e-3  # of a limit, by which a step may pass it; the last check takes it away
ELSEWHERE = 21  # samples among which what asks for short steps may move while the voltage is optimised
PERIOD = 32767  # bits of a binary signal, after which it repeats
MOST_SEGMENTS = 200
ENGINE = Rosenbrock()


@dataclass(frozen=True, eq=False)
class Rival:
    """A model at its fitted values, and how well the records know them."""

    name: str  # the effects by which it differs from the others
    model: Model
    sigma: Mapping[str, float]  # error of one sample per measured channel, SI: noise times misfit
    scale: Array  # (k,) sizes of the solver's coordinates of the free parameters: of logarithms 1, else in this unit
    information: Array  # (k, k) of the records on these coordinates, initial states estimated too
    seen: Mapping[str, float]  # largest size of each channel in the records, and their duration and dt
    fitted: Array  # (k,) from the model's values to the fitted ones, where these are others; see `as_allowed`

    @staticmethod
    def of(fit: Fit) -> "Rival":
        """Return the rival that a fit is."""
        problem, k = fit.problem, len(fit.problem.unknowns.free)
        runs = problem.experiments
        sigma = {c: max(s, 1e-300) * max(fit.misfit[c], 1.0) for c, s in fit.noise.items() if c in problem.outputs}
        n = problem.n_outputs
        jac, r = fit.jacobian[:n] * problem.scaling.slope(fit.q), fit.residuals[:n]
        whole = jac.T @ jac / max(float(r @ r) / fit.dof, float(problem.weights == "noise"))
        # What is another in every run, initial states above all, is estimated too (Schur's complement).
        known = whole[:k, :k] - whole[:k, k:] @ np.linalg.pinv(whole[k:, k:], hermitian=True) @ whole[k:, :k]
        channels = [{**r.inputs, **r.outputs} for r in runs]
        seen = {"omega": max(float(np.abs(s.states["omega"]).max()) for s in fit.simulations)}  # if not measured
        seen |= {c: max(float(np.nanmax(np.abs(r[c]))) for r in channels if c in r) for c in ("v", *sigma)}
        seen |= {"duration": max(r.duration for r in runs), "dt": float(np.median([r.dt for r in runs]))}
        of_runs = [n for n, p in fit.model.parameters.items() if p.vary and p.per_run]  # as in the first run
        return Rival(fit.model.title, fit.model.with_(angle_input=False).fix(*of_runs), sigma,
                     problem.scaling.scale[:k], known, seen, np.zeros(k))

    @staticmethod
    def as_allowed(fit: Fit) -> "Rival":
        """Return the rival that a fit is, an effect that its records leave open as large as they allow: as fitted it
        may be nothing. Of sizes on a grid the one that, all else fitted anew, raises χ² most, by `REGION`² at most."""
        problem, names = fit.problem, [p.name for p in fit.problem.unknowns.free]
        own = ([p for p in e.parameters if p.name in names] for e in fit.model.effects)
        unseen = [p for pars in own for p in pars if all(fit.std[other.name] is None for other in pars)]
        places, found = [names.index(p.name) for p in unseen], []
        unit = max(2 * fit.cost / fit.dof, float(problem.weights == "noise"))
        for values in _grid(unseen, natural_sizes(problem.experiments, fit.values)) if unseen else ():
            trial = problem.for_model(fit.model.start_at(values).fix(*values))
            if (end := race([trial], LOOK)) is not None and end.cost - fit.cost <= 0.5 * unit * REGION**2:
                found.append((end.cost, values, trial.scaling.physical(end.q)))
        if not found:
            return Rival.of(fit)
        _, values, others = max(found, key=lambda f: f[0])
        physical = problem.scaling.physical(fit.q)
        physical[places] = [values[p.name] for p in unseen]
        physical[np.setdiff1d(np.arange(len(physical)), places)] = others
        q = problem.scaling.scaled(physical)
        r, jac = problem.residual_and_jacobian(q)
        moved = replace(fit, values=problem.values(q), q=q, residuals=r, jacobian=jac / problem.scaling.slope(q))
        return replace(Rival.of(moved), fitted=(fit.q - q)[:len(names)])

    def smoothed(self, width: float) -> "Rival":
        """Return it with sgn at least so wide (rad/s): a sharp reversal makes criteria rough in the voltage."""
        own = self.model.values.get("sgn_width", np.inf)
        return self if own >= width else replace(self, model=self.model.replace(sgn_width=width))

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
        """Return `n` displacements (n, k) of parameters as uncertain as the records leave them, none the first."""
        draws = rng.multivariate_normal(np.zeros(len(self.scale)), np.linalg.inv(self.known), n, method="eigh")
        draws[:2] = 0.0
        draws[1::2] += self.fitted
        return draws

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, the model as in ``fit --json``."""
        m = self.model
        return {"name": self.name, "model": {"base": m.base, "axis": m.axis, "effects": list(m.effect_names)},
                "parameters": {n: {"value": p.value, "unit": p.unit, "fixed": not p.vary}
                               for n, p in m.parameters.items()},
                "sigma": dict(self.sigma), "scale": self.scale.tolist(), "information": self.information.tolist(),
                "seen": dict(self.seen), "fitted": self.fitted.tolist()}

    @staticmethod
    def from_dict(contents: Mapping[str, Any], model: Model) -> "Rival":
        """Return what `to_dict` wrote, its model built already."""
        sigma, seen = ({str(k): float(v) for k, v in contents[part].items()} for part in ("sigma", "seen"))
        scale, information, fitted = (np.asarray(contents[part], float) for part in ("scale", "information", "fitted"))
        sizes = np.array([*sigma.values(), *scale, *(seen[k] for k in ("v", "dt", "duration"))])
        if not (np.all(sizes > 0) and np.isfinite([*sizes, *information.ravel(), *fitted]).all()):
            raise ValueError("sizes of a rival must be finite and above zero")
        return Rival(str(contents["name"]), model, sigma, scale, information, seen, fitted)


def _grid(parameters: Sequence[Parameter], sizes: Mapping[str, float]) -> Iterator[dict[str, float]]:
    """Yield values of an effect's parameters: amounts from little to much together, at each of its shapes."""
    shapes = combined({p.name: shapes_of(p, sizes) for p in parameters if p.grid})
    amounts = [p for p in parameters if p.null == 0 and not p.grid]
    for amount, shape in product(AMOUNTS if amounts else (0.0,), shapes):
        yield {p.name: p.value for p in parameters} | shape | {
            p.name: amount * sizes.get(p.unit, 1.0) * (ABOVE if p.at_least else 1.0) for p in amounts}


@cache
def quiet_seeds(n: int) -> list[int]:
    """Return seeds of `n` bits whose running sum, as ±1, stays small; the best first."""
    bits = lfsr_bits(1, 2 * PERIOD)
    total = np.concatenate([[0], np.cumsum(2 * bits - 1)])
    reach = np.zeros(PERIOD, int)
    for k in range(1, n + 1):
        np.maximum(reach, np.abs(total[k:k + PERIOD] - total[:PERIOD]), out=reach)
    at = np.argsort(reach, kind="stable")[:MOST_SEGMENTS]
    return (bits[at[:, None] + np.arange(15)] @ (1 << np.arange(15))).tolist()


@dataclass(frozen=True, eq=False)
class Layout:
    """How unknowns become a voltage: segments of whole milliseconds, each a step or a ramp between two levels. On a
    step, a pseudo-random binary signal of its own amplitude may ride: it shows what is quick. Its seed is the one whose
    running sum stays smallest, so that the speed moves little and the current may be large."""

    ms: tuple[int, ...]  # lengths of the segments
    dt: float  # s between samples
    bits: tuple[int, ...]  # ms per bit on each step, 0: a ramp between two levels; empty: ramps from level to level
    mixing: Array | None  # (levels, unknowns): levels, in units of v_max, of the unknowns; None: they are the unknowns
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
            if self.bits and self.bits[j]:
                found[a:b, 1] = program(self._riding(j, 0.0, 1.0)).volts(1 / self.dt)
        return found

    @cached_property
    def jumps(self) -> NDArray[np.bool_]:
        """Samples, (N,), that begin with a jump of the voltage."""
        found = np.diff(self.inputs[:, 1], prepend=0.0)[:-1] != 0
        found[self.edges[:-1]] |= not self.ramps
        return found

    def voltage(self, levels: Array) -> Array:
        """Return the voltage at each sample and the end, (N+1,)."""
        each = [self.at(levels, j) for j in range(len(self.ms))]
        low, high, ripple = np.repeat([*each, each[-1]], [*np.diff(self.edges), 1], axis=0).T
        return low + (high - low) * self.inputs[:, 0] + ripple * self.inputs[:, 1]

    def _riding(self, j: int, level: float, amplitude: float) -> str:
        seed = quiet_seeds(min(-(-self.ms[j] // self.bits[j]), PERIOD - 15))[j % MOST_SEGMENTS]
        return f"prbs:{amplitude:g}:{self.bits[j] / 1e3:g}:{self.ms[j] / 1e3:g}:{level:g}:{seed}"

    def of(self, c: Array) -> Array:
        """Return the levels, V, of the unknowns."""
        return self.v_max * (c if self.mixing is None else self.mixing @ c)

    def places(self, j: int) -> tuple[int, int, int]:
        """Return which levels are the voltage at both ends of segment `j`, and the amplitude on it (-1: none)."""
        if self.ramps:
            return j, j + 1, -1
        other = len(self.ms) + j
        return (j, j, other) if self.bits[j] else (j, other, -1)

    def at(self, levels: Array, j: int) -> tuple[float, float, float]:
        """Return the voltages at both ends of segment `j`, and the amplitude on it."""
        a, b, ripple = self.places(j)
        return float(levels[a]), float(levels[b]), float(levels[ripple]) if ripple >= 0 else 0.0

    def words(self, levels: Array) -> str:
        """Return the excitation that `motorid record` plays."""
        words = []
        for j, ms in enumerate(self.ms):
            a, b, ripple = (round(x, 3) + 0.0 for x in self.at(levels, j))
            flat = f"step:{a:g}:{ms / 1e3:g}" if a else f"rest:{ms / 1e3:g}"
            words.append(self._riding(j, a, ripple) if ripple else flat if a == b else f"ramp:{a:g}:{b:g}:{ms / 1e3:g}")
        return ",".join(words)


def voltage_as_parameters(system: System) -> System:
    """Return the system with voltages as parameters: v_from … v_to as a second input goes 0 … 1, v_on times a third."""
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
    def of(rival: Rival, layout: Layout, errors: Mapping[str, float], angle: bool) -> "Driven":
        """Return it with one integration step per sample."""
        if (system := rival.model.system({*errors, *(("theta",) if angle else ())})).inputs != ("v",):
            raise UsageError(f"{rival.name}: a model with measured inputs ({', '.join(system.inputs[1:])}) cannot be "
                             "used to design an experiment: they are not known beforehand.")
        system = voltage_as_parameters(system)
        sizes = np.array([errors.get(c, np.inf) for c in system.outputs])
        return Driven(rival, layout, system, sizes, np.ones(int(layout.edges[-1]), int))

    def grid(self, levels: Array | None) -> Grid:
        """Return samples and inputs: the voltage of `levels`, or (None) what makes a voltage of the parameters."""
        shapes = self.layout.inputs
        u = np.column_stack([0 * shapes[:, 0], shapes] if levels is None else [self.layout.voltage(levels), 0 * shapes])
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
        """Simulate from rest at angle zero; SimulationError where that does not reach the end."""
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

    def refined(self, levels: Array, tolerance: float) -> "Driven":
        """Return it with sub-steps that keep the integration's error under this voltage below `tolerance`."""
        p, _ = self.parameters(np.zeros(len(self.rival.scale)))
        grid = replace(self, substeps=np.ones_like(self.substeps)).grid(levels)
        fine = ENGINE.prepare(self.system, grid, self.system.first_state(np.zeros(3), p), p, tolerance)
        moving = np.where(self.layout.jumps, 1, fine.substeps)  # while a jump of the voltage stays where it is
        around = scipy.ndimage.maximum_filter1d(moving, ELSEWHERE)
        return replace(self, substeps=np.max([fine.substeps, around, self.substeps], 0))

    def informs(self, response: Response) -> Array:
        """Return the information (k, k) on the parameters, old and new."""
        k = len(self.rival.scale)
        s = response.dy[:, :, -k:].reshape(-1, k)
        return self.rival.known + s.T @ s


class Rows(NamedTuple):
    """Values, their slopes, lower and upper limits: rows of a linear program."""

    values: Array
    slopes: Array
    low: Array
    high: Array


class Value(NamedTuple):
    """A criterion and its gradient by level, empty where it was not asked for."""

    value: float
    slope: Array = np.zeros(0)


def separation(truth: Driven, rival: Driven, levels: Array, ra: Response, rb: Response, slopes: bool,
               region: float = REGION) -> Value:
    """Return the χ² that a rival leaves, once fitted to old and new records, where another model is the truth: the
    worst within `region` deviations. `ra`, `rb`: the answers at the old records' values, with slopes by parameter."""
    k, both = len(truth.rival.scale), (truth, rival)
    prior = np.zeros((2, k + len(rival.rival.scale), k + len(rival.rival.scale)))
    prior[0, :k, :k], prior[1, k:, k:] = truth.rival.known, rival.rival.known
    delta, chi2 = np.zeros(len(prior[0])), float(np.sum((ra.y - rb.y) ** 2))
    for _ in range(STEPS):
        s = np.concatenate([ra.dy[:, :, -k:], -rb.dy[:, :, k - len(delta):]], axis=2).reshape(-1, len(delta))
        error = (ra.y - rb.y).ravel()
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                step = _worst_case(s.T @ s, s.T @ (s @ delta - error), prior, region) - delta
            except np.linalg.LinAlgError:
                break
        if not np.isfinite(step).all():  # slopes that overflow lead nowhere
            break
        before, after = chi2, error + s @ step
        if after @ after + (delta + step) @ prior[1] @ (delta + step) > (1 - SETTLED) * chi2:
            break
        for share in (1.0, 0.5, 0.2):
            trial = delta + share * step
            with contextlib.suppress(SimulationError):
                ta, tb = (f.respond(levels, d, by_parameter=True)
                          for f, d in zip(both, np.split(trial, [k]), strict=True))
                if (value := float(np.sum((ta.y - tb.y) ** 2) + trial @ prior[1] @ trial)) < chi2:
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
    """Return minus the sum of the logarithms of the asked parameters' variances, the others estimated too."""
    covariance = np.linalg.inv(a.informs(response))
    k, variances = len(covariance), np.diag(covariance)[list(asked)]
    value = -float(np.sum(np.log(variances)))
    if not slopes:
        return Value(value)
    slope = np.zeros(len(levels))
    for way in (covariance[:, list(asked)] / np.sqrt(variances)).T:
        up, down = (a.respond(levels, s * BESIDE * way, by_level=True).dy for s in (1, -1))
        slope += 2 * np.tensordot(response.dy[:, :, -k:] @ way, (up - down) / (2 * BESIDE), 2)
    return Value(value, slope)


@dataclass(frozen=True, eq=False)
class Task:
    """What is asked: rivals, limits of their states, and what is to become as large as can be."""

    driven: tuple[Driven, ...]
    limits: Mapping[str, tuple[float, float]]  # by state: i, omega, theta, dT; SI
    noise: Mapping[str, float]  # of the channels' sensors, SI
    asked: tuple[str, ...]  # parameters to sharpen; empty: distinguish the rivals
    pairs: tuple[tuple[int, int], ...]  # (truth, rival) to distinguish
    slew: float  # largest change of the voltage along a ramp, V/s
    nominal: frozenset[tuple[int, int]] = frozenset()  # pairs whose truth is as fitted: else nothing distinguishes them

    @property
    def layout(self) -> Layout:
        """How levels become a voltage."""
        return self.driven[0].layout

    def laid(self, layout: Layout) -> "Task":
        """Return the task with another layout, one integration step per sample."""
        ones = np.ones(int(layout.edges[-1]), int)
        return replace(self, driven=tuple(replace(d, layout=layout, substeps=ones) for d in self.driven))

    def refined(self, levels: Array, tolerance: float) -> "Task":
        """Return the task with integration steps that suit `levels`."""
        return replace(self, driven=tuple(d.refined(levels, tolerance) for d in self.driven))

    def respond(self, levels: Array, by_level: bool = False) -> list[Response]:
        """Return the rivals' answers, at the values of the old records, with slopes by parameter."""
        return [d.respond(levels, np.zeros(len(d.rival.scale)), by_level, True) for d in self.driven]

    def criteria(self, levels: Array, answers: Sequence[Response], slopes: bool) -> list[Value]:
        """Return what the experiment is worth, in nats: per pair log(1 + χ²), or per rival and asked parameter."""
        found = []
        for d, r in zip(self.driven if self.asked else (), answers, strict=False):
            value, slope = precision(d, [d.rival.model.free_names.index(n) for n in self.asked], levels, r, slopes)
            found.append(Value(value / (2 * len(self.asked)), slope / (2 * len(self.asked))))
        for i, j in self.pairs:
            value, slope = separation(self.driven[i], self.driven[j], levels, answers[i], answers[j], slopes,
                                      0.0 if (i, j) in self.nominal else REGION)
            found.append(Value(float(np.log1p(value)), slope / (1 + value)))
        return found

    @cached_property
    def truths(self) -> list[list[int]]:
        """Places of the criteria that speak of the same truth."""
        if self.asked:
            return [[k] for k in range(len(self.driven))]
        return [[k for k, (i, _) in enumerate(self.pairs) if i == truth] for truth in dict(self.pairs)]

    def worth(self, values: Array) -> float:
        """Return the mean over the truths of the least of their criteria, `ENOUGH` for each at most."""
        return float(np.mean([min(float(values[each].min()), self.enough) for each in self.truths]))

    @property
    def enough(self) -> float:
        """Criterion from which more is worth nothing."""
        return np.inf if self.asked else ENOUGH

    def room(self, state: str) -> tuple[float, float]:
        """Return a state's limits less the sensor's noise."""
        low, high = self.limits[state]
        margin = min(NOISES * self.noise.get(state, 0.0), LARGEST_MARGIN * min(-low, high))
        return low + margin, high - margin

    def extremes(self, answers: Sequence[Response]) -> Rows:
        """Return the extremes of each limited state in each segment, over its largest size allowed."""
        found = []
        for d, r in zip(self.driven, answers, strict=True):
            k = len(d.rival.scale)
            for s in (s for s in self.limits if s in d.system.states):
                j, (low, high) = d.system.states.index(s), self.room(s)
                x, size = r.x[:, j], max(-low, high)
                at = [a + f(x[a:b + 1]) for a, b in pairwise(d.layout.edges) for f in (np.argmax, np.argmin)]
                upper = np.arange(len(at)) % 2 == 0
                found.append((x[at] / size, r.dx[at, j, :r.dx.shape[2] - k] / size,
                              np.where(upper, -np.inf, low / size), np.where(upper, high / size, np.inf)))
        return Rows(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def reach(self, levels: Array, displaced: Sequence[Array]) -> dict[str, tuple[float, float]]:
        """Return the smallest and largest value of each limited state; `displaced` (n, k): parameters, by rival."""
        found = dict.fromkeys(self.limits, (0.0, 0.0))
        for d, deltas in zip(self.driven, displaced, strict=True):
            for delta in deltas:
                try:
                    x = d.respond(levels, delta).x
                except SimulationError:
                    if delta.any():  # parameters that no motor has
                        continue
                    return dict.fromkeys(self.limits, (-np.inf, np.inf))
                for s in (s for s in self.limits if s in d.system.states):
                    y, (low, high) = x[:, d.system.states.index(s)], found[s]
                    found[s] = min(low, float(y.min())), max(high, float(y.max()))
        return found


@dataclass(frozen=True, eq=False)
class Found:
    """Where a search stands: the task with its integration steps, the unknowns, `Task.worth` there."""

    task: Task
    c: Array
    value: float
    stopped: bool = False


def climb(task: Task, c: Array) -> Found:
    """Maximise `Task.worth` under the limits, from unknowns that keep them, by sequential linear programming.

    The information is convex in a linear motor's voltage, so that its maxima lie where limits are active, and a linear
    program goes there at once (Fletcher & Sainz de la Maza, Mathematical Programming 43, 1989); the trust region
    shrinks where the step does not keep its promise. Limits of the states hold at the largest and the smallest value
    of each segment. A budget of time or Ctrl-C ends the search at the best point so far."""
    linear, radius, best = linear_rows(task), RADIUS, Found(task, c, -np.inf)
    try:
        values, slopes, states = _linearised(task, c, True)
        best = Found(task, c, task.worth(values))
        for _ in range(MOST_STEPS):
            check_time()
            along = linear._replace(values=linear.slopes @ best.c)
            step, promise = _linear_step(task, best.c, values, slopes, [states, along], radius)
            if promise < WORTHWHILE:
                break
            try:
                there, _, y = _linearised(task, best.c + step, False)
                kept = bool(np.all((y.values <= y.high + OVER) & (y.values >= y.low - OVER)))
                good = kept and task.worth(there) - best.value > 0.1 * promise
            except (SimulationError, np.linalg.LinAlgError):
                good = False
            radius *= 1.5 if good else 0.4
            if good:
                best = Found(task, best.c + step, task.worth(there))
                values, slopes, states = _linearised(task, best.c, True)
            elif radius < SMALLEST_RADIUS:
                break
    except (SimulationError, np.linalg.LinAlgError):
        return best
    except (OutOfTime, KeyboardInterrupt):
        interruption.heard()
        return replace(best, stopped=True)
    return best


def _linearised(task: Task, c: Array, slopes: bool) -> tuple[Array, Array, Rows]:
    """Return the criteria, their slopes by the unknowns (none if not asked for), and the limited states."""
    layout = task.layout
    levels, mix = layout.of(c), layout.v_max * (np.eye(layout.levels) if layout.mixing is None else layout.mixing)
    answers = task.respond(levels, slopes)
    worth, rows = task.criteria(levels, answers, slopes), task.extremes(answers)
    values, by = np.array([w.value for w in worth]), np.array([w.slope for w in worth])
    return (values, by @ mix, rows._replace(slopes=rows.slopes @ mix)) if slopes else (values, by, rows)


def _linear_step(task: Task, c: Array, values: Array, slopes: Array, rows: Sequence[Rows],
                 radius: float) -> tuple[Array, float]:
    """Return the step within `radius` that raises the linearised worth most, and by how much."""
    n, truths = len(c), len(task.truths)
    owner = np.array([[k in each for each in task.truths] for k in range(len(values))], float)
    a, b = [np.hstack([-slopes, owner])], [values]
    for y, dy, low, high in rows:
        for sign, limit in ((1.0, high), (-1.0, -low)):
            at = np.isfinite(limit)
            a.append(np.hstack([sign * dy[at], np.zeros((at.sum(), truths))]))
            b.append(np.maximum(limit[at] - sign * y[at], 0.0))
    bounds = [(max(-1 - x, -radius), min(1 - x, radius)) for x in c] + [(None, task.enough)] * truths
    aim = np.append(np.zeros(n), np.full(truths, -1 / truths))
    done = scipy.optimize.linprog(aim, np.vstack(a), np.concatenate(b), bounds=bounds, method="highs")
    return (np.zeros(n), 0.0) if done.x is None else (done.x[:n], float(-done.fun - task.worth(values)))


def nearest(task: Task, c: Array) -> Array:
    """Return the unknowns nearest to `c`, by the largest change, that keep the linear limits (a slew rate)."""
    _, slopes, _, high = linear_rows(task)
    if (np.abs(slopes @ c) <= high).all():
        return c
    one, away = np.ones((len(c), 1)), np.eye(len(c))
    a = np.block([[s * slopes, np.zeros((len(high), 1))] for s in (1, -1)] + [[s * away, -one] for s in (1, -1)])
    b = np.concatenate([high, high, c, -c])
    return scipy.optimize.linprog(np.append(0 * c, 1.0), a, b, bounds=[(-1, 1)] * len(c) + [(0, None)]).x[:-1]


def linear_rows(task: Task) -> Rows:
    """Return the rows (their values empty) of what is linear in the unknowns: mixed levels, and the slew rate."""
    layout = task.layout
    mix = np.eye(layout.levels) if layout.mixing is None else layout.mixing
    rows, high = [np.zeros((0, mix.shape[1]))], [np.zeros(0)]
    if layout.mixing is not None or layout.bits:
        n, on = len(layout.ms), np.array(layout.bits, bool)
        rows += [mix] if layout.ramps else [(mix[:n] + mix[n:])[on], (mix[:n] - mix[n:])[on]]
        high += [np.ones(len(r)) for r in rows[1:]]
    if layout.ramps and np.isfinite(task.slew):
        rows.append(np.diff(np.vstack([0 * mix[:1], mix, 0 * mix[:1]]), axis=0))
        high.append(task.slew * (np.array([1e-3, *layout.ms, 1e-3]) / 1e3) / layout.v_max)
    limit = np.concatenate(high)
    return Rows(np.zeros(0), np.vstack(rows), -limit, limit)

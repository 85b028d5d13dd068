"""A fitting problem: model, records and what is asked of them, as residual(q) and jacobian(q)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motorid.channels import CHANNELS
from motorid.errors import ModelError, SimulationError, UsageError, among, name_of, otherwise
from motorid.integrate import engine_of, limited
from motorid.integrate.engine import Engine, Grid, Tolerance, Trajectory
from motorid.model.definition import Parameter
from motorid.model.equations import System
from motorid.model.model import SHOWN, Model
from motorid.numerics.autoregression import effective_samples
from motorid.numerics.least_squares import Huber
from motorid.numerics.signals import Array, left_out
from motorid.problem.runs import Run, first_width, noise_of, prepare_run, with_inputs
from motorid.problem.unknowns import Point, Scaling, Unknowns
from motorid.records.experiment import Experiment, between_pauses

SUBSTEPS = 10  # per sample: what needs more cannot be seen in these samples, unless it is cheap
CHEAP = 60_000  # steps of integration
BESIDE = 8  # samples on either side that tell when a step of the voltage came
SURELY = 16.0  # of χ² between two times: four standard deviations
LARGEST_SLOPE = 1e100  # of an output; beyond it the numbers mean nothing
NOISE_SHARE = 0.01  # error of an interval over the noise
MISFIT_SHARE = 0.1  # of the misfit, where it is what the noise would be
TIGHTEST, LOOSEST = 1e-7, 3e-5  # and over the largest state
UNTOUCHED = {"width": ("integrator", "measured"), "engine": ("outputs", "system", "unknowns", "measured")}


@dataclass(frozen=True, eq=False)
class Problem:
    """A model, the records it should explain, and what else is asked.

    Examples
    --------
    >>> problem = mi.Problem(mi.dc_motor(), runs, priors={"R": (1.3, 0.1)})
    >>> fit = mi.solve(problem)
    """

    model: Model
    experiments: tuple[Experiment, ...]
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # (mean, std) of a parameter, in its unit
    penalties: tuple[Any, ...] = ()  # see `motorid.problem.constraints`: these enter the residual, and
    constraints: tuple[Any, ...] = ()  # these are for `MultipleShooting`
    loss: Huber | None = None  # least squares
    weights: str = "noise"  # of each channel, or "rms": that of the measured channel (the source paper's)
    initial: str = "auto"  # or "rest", "measured", "estimate": what is known of the state at the first sample
    engine: str | Engine = "rosenbrock"
    noise_factors: Mapping[str, float] = field(default_factory=dict)  # where the misfit, not the noise, decides
    accuracy: float | None = None  # local error over the largest state; by default a small part of the noise
    width: float | None = None  # of sgn, rad/s, in place of the one that suits the records (continuation)
    first_stands: bool = False  # the first run has no parameters of its own (where one is fixed for its profile)
    _runs: tuple[Run, ...] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        runs = (self.experiments,) if isinstance(self.experiments, Experiment) else tuple(self.experiments)
        if not runs or not all(isinstance(r, Experiment) for r in runs):
            raise UsageError("a problem needs at least one Experiment: runs = mi.read_runs('run*.csv').")
        measured = ([c for c, y in r.outputs.items() if np.isfinite(y[0]) or np.isfinite(y).any()] for r in runs)
        object.__setattr__(self, "experiments", tuple(map(_with_only, runs, measured)))
        among(self.weights, ("noise", "rms"), "weights")
        if not self.outputs:
            raise ModelError("none of the channels that the model shows was measured; a fit needs at least "
                             "one of i, omega, theta (torque_driven: omega or theta).")
        object.__setattr__(self, "experiments", tuple(_with_only(r, self.outputs) for r in self.experiments))
        for name in self.priors:
            among(name, self.model.parameters, "parameter", where="prior: ")
            if self.model.parameters[name].per_run and self.model.parameters[name].vary:
                raise UsageError(f"'{name}' is another in every run, and takes no prior; fix it, or leave that out.")
            if not (np.isfinite(self.priors[name]).all() and self.priors[name][1] > 0):
                raise UsageError(f"the prior of '{name}' takes (mean, std), finite, std above zero; got "
                                 f"{self.priors[name]}.")
        if self.loss is not None and (not hasattr(self.loss, "pseudo") or isinstance(self.loss, type)):
            raise UsageError(f"loss takes mi.Huber() or None; got {name_of(self.loss)}.")
        if self.model.base == "torque_driven" and self.model.axis == "rotary" and self.linear:
            raise ModelError("the records are in metres, and the model is one that turns: write "
                             "mi.torque_driven(axis='linear'), or state the units of the records.")
        driven = next((r.units["v"] for r in self.experiments if r.units["v"] in ("A", "N·m", "N")), "")
        if self.model.base == "dc_motor" and driven:
            raise ModelError(f"v is in {driven}, and the model is driven by a voltage: a commanded current or torque "
                             "drives mi.torque_driven() (--drive torque). If it is a voltage, state its unit.")
        if driven and (g := self.model.parameters["g"]):
            g = replace(g, unit="" if g.unit == f"{driven}/V" else g.unit.replace("V", driven))
            object.__setattr__(self, "model", self.model.with_(parameters={**self.model.parameters, "g": g}))
        if self.model.axis == "rotary" and self.linear:
            object.__setattr__(self, "model", self.model.on_linear_axis())
        self.model.check_visible(self.outputs)
        if (width := self.width or first_width(self.experiments, self.model.parameters)) is not None:
            object.__setattr__(self, "model", self.model.start_at({"sgn_width": width}))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Measured channels that the model can show."""
        return tuple(c for c in SHOWN[self.model.base] if any(c in r.outputs for r in self.experiments))

    @cached_property
    def system(self) -> System:
        """The model's functions for the measured channels."""
        return self.model.system(self.outputs)

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """The records made ready, one per experiment."""
        if self._runs is not None:
            return self._runs
        noise = noise_of(self.experiments, self.outputs)
        return tuple(prepare_run(r, self.outputs, noise, self.system.inputs, self.initial) for r in self.experiments)

    @cached_property
    def unknowns(self) -> Unknowns:
        """The unknowns and how they enter the system."""
        return Unknowns(self.system, self.model.parameters, self.runs, self.first_stands)

    @property
    def unknown(self) -> tuple[Parameter, ...]:
        """Free parameters of the model, then the estimated initial states, run by run."""
        return self.unknowns.all

    @property
    def scaling(self) -> Scaling:
        """Solver coordinates of the unknowns."""
        return self.unknowns.scaling

    @property
    def start(self) -> Array:
        """Solver coordinates of the model's present values."""
        return self.unknowns.start

    def values(self, q: Array) -> dict[str, float]:
        """Return all parameter values of the model at `q`, SI."""
        return self.unknowns.values(self.scaling.physical(q))

    @cached_property
    def integrator(self) -> Engine:
        """The engine itself."""
        return engine_of(self.engine)

    def simulate(self, q: Array, k: int, *, derivatives: bool = True) -> Trajectory:
        """Return the trajectory of run `k` at `q`, with derivatives by q; SimulationError if that fails."""
        return self._simulate(self.unknowns.point(np.asarray(q, float)), k, derivatives)

    def _simulate(self, at: Point, k: int, derivatives: bool) -> Trajectory:
        known, seen, count = self._latest.get(k), self.unknowns.seen_by[k], len(at.q)
        if known is None or not np.array_equal(known[0], at.q[seen]) or (known[1].dy is None and derivatives):
            at = self.unknowns.of_run(at, k)
            x0, grid = self.unknowns.first_state(at, k), self.runs[k].grid
            slopes = (self.unknowns.first_slopes(at, k)[:, seen], at.dp[:, seen]) if derivatives and len(seen) else ()
            known = self._latest[k] = at.q[seen], self.integrator.run(self.system, grid, x0, at.p, *slopes)
        traj = known[1]
        if derivatives and len(seen) < count:  # what is another run's changes nothing here, and takes no memory
            dy, dx = np.zeros((*traj.y.shape, count)), np.zeros((*traj.x.shape, count))
            dy[..., seen], dx[..., seen] = (0.0, 0.0) if traj.dy is None else (traj.dy, traj.dx)
            traj = traj._replace(dy=dy, dx=dx)
        return traj

    @cached_property
    def _latest(self) -> dict[Any, tuple[Array, Any]]:
        """The latest trajectory of each run, and refined problem, and where: results are looked at in several ways."""
        return {}

    def forget(self) -> None:
        """Let go of the latest trajectories."""
        self._latest.clear()

    def __getstate__(self) -> dict[str, Any]:
        return {n: v for n, v in self.__dict__.items() if n != "_latest"}

    def refined(self, q: Array) -> "Problem":
        """Return the problem with sub-steps that keep the integration error below noise and misfit at `q`."""
        at = self.unknowns.point(np.asarray(q, float))
        if (known := self._latest.get("refined")) is None or not np.array_equal(known[0], at.q):
            known = at.q.copy(), self.with_runs(tuple(self._refined_run(k, at) for k in range(len(self.runs))))
            self._latest["refined"] = known
        return known[1]

    def fine_enough(self, q: Array) -> bool:
        """Tell whether the present sub-steps keep, within a factor of two, what `refined` asks for at `q`."""
        at = self.unknowns.point(np.asarray(q, float))
        return all(self._suits(k, self.unknowns.of_run(at, k)) for k in range(len(self.runs)))

    def _suits(self, k: int, at: Point) -> bool:
        grid, x0 = self.runs[k].grid, self.unknowns.first_state(at, k)
        engine = limited(self.integrator, int(grid.substeps.sum()))  # the first that is finer tells
        finer = partial(engine.prepare, self.system, grid, x0, at.p, self._tolerance(k, 2.0))
        return otherwise(None, SimulationError, finer) is grid

    def _refined_run(self, k: int, at: Point) -> Run:
        # From one step per sample on, so that the grid depends on q alone and not on the way there.
        at = self.unknowns.of_run(at, k)
        run, x0 = self.runs[k], self.unknowns.first_state(at, k)
        grid = with_inputs(run, self.system.inputs).grid if run.unseen else run.grid
        coarse = grid.with_substeps(np.ones_like(grid.substeps))
        grid = self.integrator.prepare(self.system, coarse, x0, at.p, self._tolerance(k))
        grid = self._with_steps_placed(k, grid, x0, at.p) if run.unseen else grid
        same = np.array_equal(grid.substeps, run.grid.substeps) and np.array_equal(grid.u1, run.grid.u1)
        return run if same else replace(run, grid=grid)

    @np.errstate(over="ignore", invalid="ignore")  # of a model that runs away no step is placed
    def _with_steps_placed(self, k: int, grid: Grid, x0: Array, p: Array) -> Grid:
        """Return a grid where a step of the voltage comes, as a ramp of the same mean, with that of the samples left
        out before it is seen for which the outputs beside it surely ask: an angle keeps for ever what it did."""
        j, n = self.system.inputs.index("v"), len(grid.t)
        m, more, way = self.measured[k], left_out(grid.t), grid.way[:, j].copy()
        traj = self.integrator.run(self.system, grid, x0, p)
        for i in self.runs[k].unseen:
            a, b = max(i - BESIDE, 0), min(i + BESIDE, n - 1)
            part, whole = grid.part(i, b), np.append(1.0, np.zeros(b - i - 1))
            held, moved = (self.integrator.run(self.system, g, traj.x[i], p).y for g in (part, part.with_way(j, whole)))
            pushed = np.vstack([np.zeros((i - a, m.y.shape[1])), (moved - held) * m.weights])
            left = np.where(m.weights > 0, (m.y - traj.y)[a:b + 1] * m.weights, 0.0)
            known = np.isfinite(left).all(axis=1)
            drift = np.linalg.qr(np.column_stack([np.ones(known.sum()), grid.t[a:b + 1][known]]))[0]
            left, pushed = (z[known] - drift @ (drift.T @ z[known]) for z in (left, pushed))
            ways = 2 * np.arange(more[i] + 1) / (more[i] + 1)
            squares = np.array([np.sum((left - w * pushed) ** 2) for w in ways])
            best = int(squares.argmin())
            if left.size * np.log((squares[0] + 1e-300) / (squares[best] + 1e-300)) > SURELY:
                way[i] = ways[best]
        return grid.with_way(j, way)

    def with_finer_steps(self, factor: int) -> "Problem":
        """Return the problem with `factor` times as many sub-steps everywhere."""
        return self.with_runs(tuple(replace(r, grid=r.grid.with_substeps(factor * r.grid.substeps)) for r in self.runs))

    @property
    def worth_its_steps(self) -> bool:
        """Tell whether it takes no more sub-steps than its samples are worth."""
        return sum(int(run.grid.substeps.sum()) for run in self.runs) <= self._most_steps

    def within_worth(self) -> "Problem":
        """Return the problem with an engine that gives up where one record takes more sub-steps than that."""
        return self.tuned(engine=limited(self.integrator, self._most_steps))

    @property
    def _most_steps(self) -> int:
        return max(SUBSTEPS * sum(r.n for r in self.experiments), CHEAP)

    def with_runs(self, runs: tuple[Run, ...]) -> "Problem":
        """Return a copy with other grids that keeps everything else already made."""
        return self._lending(replace(self, _runs=runs), ("outputs", "system", "unknowns", "integrator", "measured"))

    def _lending(self, other: "Problem", made: Sequence[str]) -> "Problem":
        other.__dict__.update({n: self.__dict__[n] for n in made if n in self.__dict__})
        return other

    def _tolerance(self, k: int, slack: float = 1.0) -> Tolerance:
        """Local error relative to the largest state."""
        return self.accuracy if self.accuracy is not None else partial(self.measured[k].tolerance, slack=slack)

    @cached_property
    def measured(self) -> "tuple[Measured, ...]":
        """The records as residuals see them, one per run."""
        return tuple(Measured.of(run, self.outputs, self.weights, self.noise_factors) for run in self.runs)

    def unstack(self, rows: Array, missing: float = np.nan) -> list[Array]:
        """Return stacked rows (n, …) of the outputs as (N, ny, …) per run, `missing` where there was no sample."""
        ends = np.cumsum([m.size for m in self.measured])
        parts = np.split(rows[:ends[-1]], ends[:-1])
        return [m.unstack(part, missing) for m, part in zip(self.measured, parts, strict=True)]

    def worth(self, residual: Array) -> float:
        """Return how many independent samples a residual (n, …) is worth, priors and penalties left aside."""
        return sum(effective_samples(column) for part in self.unstack(residual[: self.n_outputs]) for column in part.T)

    def residual(self, q: Array) -> Array:
        """Return the whitened residual: outputs run by run, then priors, then penalties; or raise `SimulationError`."""
        return self._evaluate(q, False)[0]

    def jacobian(self, q: Array) -> Array:
        """Return d residual/dq, exact, shape (n, nq)."""
        return self.residual_and_jacobian(q)[1]

    def residual_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Return both from one integration."""
        r, jac = self._evaluate(q, True)
        assert jac is not None
        return r, jac

    def _evaluate(self, q: Array, derivatives: bool) -> tuple[Array, Array | None]:
        q = np.asarray(q, float)
        at = self.unknowns.point(q)
        trajs = [self._simulate(at, k, derivatives) for k in range(len(self.runs))]
        each = zip(self.measured, trajs, strict=True)
        parts: list[tuple[Array, Any]] = [self.with_loss(*m.residual(traj)) for m, traj in each]
        parts += [prior_residual(self.priors, self.unknowns, at)] if self.priors else []
        parts += [penalty.evaluate(self, q, trajs) for penalty in self.penalties]
        if len(parts) == 1:
            return parts[0]
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]) if derivatives else None

    def with_loss(self, r: Array, jac: Array | None) -> tuple[Array, Array | None]:
        """Return residual and Jacobian with the robust loss, if there is one."""
        if self.loss is None:
            return r, jac
        pseudo, slope = self.loss.pseudo(r)
        return pseudo, None if jac is None else jac * slope[:, None]

    @property
    def linear(self) -> bool:
        """Tell whether the angle is a position in metres: nothing comes back with a turn."""
        return self.model.axis == "linear" or any({"m", "m/s"} & {*r.units.values()} for r in self.experiments)

    @property
    def n_outputs(self) -> int:
        """Number of output residuals (finite measured samples)."""
        return sum(m.size for m in self.measured)

    def for_model(self, model: Model) -> "Problem":
        """Return the problem for another model on the same records; noise, grids, initial states stay."""
        other = replace(self, model=model, _runs=self.runs)
        if (inputs := other.system.inputs) != self.system.inputs:
            other = replace(other, _runs=tuple(with_inputs(run, inputs) for run in self.runs))
        return self._lending(other, ("integrator", "measured")) if other.outputs == self.outputs else other

    def start_at(self, values: Mapping[str, float]) -> "Problem":
        """Return the problem with `values` as its start, each inside the limits of its parameter."""
        return self.for_model(self.model.start_at(values))

    def begun_at(self, q: Array) -> "Problem":
        """Return the problem with the values at `q` as its start, those of each run and initial states too."""
        physical = dict(zip([p.name for p in self.unknown], self.scaling.physical(q), strict=True))
        starts, own = [run.start.copy() for run in self.runs], [dict(run.apart) for run in self.runs]
        for c, k, p in self.unknowns.initial:  # rounding must not put it outside its limits
            starts[k][CHANNELS.index(c)] = np.clip(physical[p.name], *self.runs[k].limits[c])
        for n, k, p in self.unknowns.apart:
            own[k][n] = physical[p.name]
        runs = tuple(replace(run, start=s, apart=a) for run, s, a in zip(self.runs, starts, own, strict=True))
        return replace(self, model=self.model.start_at(self.values(q)), _runs=runs)

    def tuned(self, **fields: Any) -> "Problem":
        """Return the problem with other `noise_factors`, another `width` …; the records stay as prepared."""
        return self._lending(replace(self, **{"_runs": self.runs, **fields}), UNTOUCHED.get("".join(fields), ()))

    def with_(self, **fields: Any) -> "Problem":
        """Return a copy with some fields changed, e.g. ``with_(model=…)``."""
        return replace(self, **{"_runs": None, **fields})


def _with_only(run: Experiment, channels: Sequence[str]) -> Experiment:
    """Return a run with these channels alone, if it has any of them."""
    gone = [c for c in run.channels if c not in channels]
    return run.without(*gone) if gone and len(gone) < len(run.channels) else run


def as_problem(model: Model, runs: Sequence[Experiment] | Experiment, **fields: Any) -> Problem:
    """Return a `Problem` of a model and one or several runs; what follows a pause is a run of its own."""
    if not isinstance(model, Model):
        swapped = isinstance(model, Experiment | list | tuple)
        raise UsageError("the model comes first, then the runs: mi.fit(mi.dc_motor(), runs)." if swapped else
                         f"expected a model such as mi.dc_motor(), with brackets; got {name_of(model)}.")
    if isinstance(runs, str | Model) or not isinstance(runs, Iterable | Experiment):
        raise UsageError(f"expected runs, mi.read_runs('run*.csv'); got {name_of(runs)}.")
    experiments = (runs,) if isinstance(runs, Experiment) else tuple(runs)
    parts = [p for r in experiments for p in (between_pauses(r) if isinstance(r, Experiment) else [r])]
    return Problem(model, tuple(parts), **fields)


class Measured(NamedTuple):
    """One record as residuals see it, in standard deviations, and how exact an integration it asks for."""

    y: Array  # (N, ny), NaN where missing or not judged
    weights: Array  # (ny,), 0 for channels not measured
    index: NDArray[np.int64] | None  # of the finite samples in the flattened y, None for all
    noise: Array  # (ny,), infinite for channels not measured
    top: Array  # (ny,), largest size
    angle: NDArray[np.bool_]  # (ny,), which one sums up the motion
    name: str

    @staticmethod
    def of(run: Run, outputs: Sequence[str], weights: str, factors: Mapping[str, float]) -> "Measured":
        """Return `run` with `weights` ``"noise"``, times the factor of each channel, or ``"rms"``."""
        out = run.experiment.outputs
        y = np.column_stack([out.get(c, np.full(run.experiment.n, np.nan)) for c in outputs])
        y[: run.experiment.run_in] = np.nan
        noise = np.array([run.sigma.get(c, np.inf) for c in outputs])
        if weights == "noise":
            size = noise * [factors.get(c, 1.0) for c in outputs]
        else:
            squares = [float(np.nanmean(out[c] ** 2)) if c in out else np.inf for c in outputs]
            size = np.maximum(np.sqrt(squares), noise)  # of a stuck motor's speed
        finite = np.isfinite(y)
        index = None if finite.all() else np.flatnonzero(finite.ravel())
        top = np.maximum(np.abs(np.where(finite, y, 0.0)).max(axis=0), 1e-300)
        angle = np.array([c == "theta" for c in outputs])
        return Measured(y, 1.0 / size, index, noise, top, angle, run.experiment.name)

    @property
    def size(self) -> int:
        """Number of residuals."""
        return self.y.size if self.index is None else len(self.index)

    def residual(self, traj: Trajectory) -> tuple[Array, Array | None]:
        """Return the whitened residual (n,) and its Jacobian (n, nq), if the trajectory has one."""
        for numbers in (traj.y, traj.dy):
            if numbers is not None and not np.abs(numbers).max(initial=0.0) < LARGEST_SLOPE:
                raise SimulationError(f"{self.name}: the simulation grows without bound; the model is unstable with "
                                      "these parameters.")
        jac = None if traj.dy is None else self.stack(traj.dy * self.weights[:, None])
        return self.stack((traj.y - self.y) * self.weights), jac

    def stack(self, values: Array) -> Array:
        """Return (N, ny, …) as rows (n, …), without the missing samples."""
        rows = values.reshape(-1, *values.shape[2:])
        return rows if self.index is None else rows[self.index]

    def unstack(self, rows: Array, missing: float = np.nan) -> Array:
        """Return rows (n, …) as (N, ny, …), with `missing` where there was no sample."""
        full = np.full((self.y.size, *rows.shape[1:]), missing)
        full[slice(None) if self.index is None else self.index] = rows
        return full.reshape(*self.y.shape, *rows.shape[1:])

    def tolerance(self, traj: Trajectory, slack: float) -> tuple[float, float, Array | None]:
        """Return the error of an interval allowed, relative to the largest state: of an angle errors of all add up."""
        loosest = slack * LOOSEST
        if NOISE_SHARE * (self.noise / self.top).min() >= LOOSEST:
            return loosest, loosest, None
        e = np.where(finite := np.isfinite(self.y), traj.y - self.y, 0.0)
        rms = np.sqrt(np.einsum("ij,ij->j", e, e) / (count := np.maximum(finite.sum(axis=0), 1)))
        asked = slack * NOISE_SHARE * np.maximum(self.noise, MISFIT_SHARE * rms)
        least, beside = (np.clip((asked / self.top)[some].min(initial=loosest), slack * TIGHTEST, loosest)
                         for some in (slice(None), ~self.angle))
        return least, beside, np.where(self.angle, asked / np.sqrt(count), np.inf)


def prior_residual(priors: Mapping[str, tuple[float, float]], unknowns: Unknowns, at: Point) -> tuple[Array, Array]:
    """Return (value − mean)/std of each free parameter with a prior, and the derivatives with respect to q."""
    names = [p.name for p in unknowns.all]
    columns = [names.index(n) for n in priors if n in names]
    mean, std = np.array([priors[names[j]] for j in columns]).reshape(-1, 2).T
    jac = np.zeros((len(columns), len(names)))
    jac[np.arange(len(columns)), columns] = at.slope[columns] / std
    return (at.physical[columns] - mean) / std, jac

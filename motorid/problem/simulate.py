"""Simulating a model on records: `simulate`; judging it there: `evaluate`; and how far a problem is from its noise."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from motorid.channels import CHANNELS, UNITS, channel_name
from motorid.display.cards import Card, Shown, Table
from motorid.display.numbers import counted, percent, quantity
from motorid.errors import DataError, FitError, SimulationError, UsageError, name_of, positive
from motorid.integrate.engine import Engine
from motorid.model.model import Model
from motorid.numerics.least_squares import LevenbergMarquardt, levenberg_marquardt
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem, as_problem
from motorid.records.experiment import Experiment, units_of, windows

TURN = np.arange(-60, 60) * np.pi / 60  # where the zero of an encoder may be
ALIKE = 1.1  # times the least cost
ASSUMED_NOISE = 0.01  # of a channel's RMS, where a plan does not say
MOST_RUNS = 12  # shown one by one
SETTLES = 4  # times that unknown initial states are sought, each with the sub-steps of where the last ended


@dataclass(frozen=True, eq=False)
class Simulation:
    """A model's answer to one record."""

    experiment: Experiment
    outputs: Mapping[str, Array]  # at the samples, SI
    states: Mapping[str, Array]

    def residual(self, channel: str) -> Array:
        """Return measured minus model, (N,), NaN where missing, or where a part of a record runs in."""
        left = self.experiment.outputs[channel] - self.outputs[channel]
        left[: self.experiment.run_in] = np.nan
        return left


@dataclass(frozen=True, eq=False)
class Evaluation(Shown):
    """How well values explain records: NRMSE and RMSE per channel, over all runs and run by run.

    NRMSE is RMSE over the RMS of the channel on the same samples, of an angle from where it begins; NaN if still."""

    simulations: tuple[Simulation, ...]
    nrmse: Mapping[str, float]
    rmse: Mapping[str, float]
    by_run: tuple[Mapping[str, float], ...]

    @property
    def total(self) -> float:
        """Quadratic mean of the channels' NRMSE."""
        return float(np.sqrt(np.mean(np.square(list(self.nrmse.values())))))

    @property
    def words(self) -> str:
        """The NRMSE of each channel: ``current 1.68 %, speed 0.82 %``."""
        units = units_of(s.experiment for s in self.simulations)
        return ", ".join(f"{channel_name(c, units.get(c, ''))} {percent(e)}" for c, e in self.nrmse.items())

    def card(self) -> Card:
        """Return the errors over all runs and run by run."""
        return Card(f"Evaluation on {counted(len(self.simulations), 'run')}",
                    tables=(error_table({"": self}), run_table(self)), after=(("mi.plot_fit(evaluation)", "see it"),))

    def __repr__(self) -> str:
        errors = ", ".join(f"{c} {100 * e:.2f} %" for c, e in moving(self.nrmse).items())
        return f"<evaluation of {len(self.simulations)} runs: NRMSE {errors}>"


def error_table(evaluations: Mapping[str, Evaluation | None], noise: Mapping[str, float] = MappingProxyType({})
                ) -> Table:
    """Return RMSE and NRMSE per channel of evaluations, by name, side by side, with the `noise` of sensors, SI."""
    shown = {name: e for name, e in evaluations.items() if e is not None}
    units = units_of(s.experiment for e in shown.values() for s in e.simulations)
    header = ["channel", *(f"{name} {what}".strip() for name in shown for what in ("RMSE", "NRMSE"))]
    rows = []
    for c in dict.fromkeys(c for e in shown.values() for c in e.nrmse):
        unit = units.get(c, UNITS[c][0])
        row = [f"{channel_name(c, unit)} {c}"]
        for e in shown.values():
            row += [quantity(e.rmse.get(c), unit, 3), percent(e.nrmse.get(c))]
        rows.append([*row, quantity(noise.get(c), unit, 2)] if noise else row)
    return Table([*header, "noise"] if noise else header, rows, "Errors", NRMSE)


def run_table(evaluation: Evaluation, title: str = "Errors run by run") -> Table:
    """Return the NRMSE of each run per channel; of many runs the first ones."""
    shown = list(zip(evaluation.simulations, evaluation.by_run, strict=True))
    units = units_of(s.experiment for s, _ in shown)
    rows = [[s.experiment.name, *(percent(e.get(c)) for c in evaluation.nrmse)] for s, e in shown[:MOST_RUNS]]
    note = f"and {counted(len(shown) - MOST_RUNS, 'more run')}" if len(shown) > MOST_RUNS else ""
    return Table(["run", *(f"NRMSE {channel_name(c, units.get(c, ''))}" for c in evaluation.nrmse)], rows, title, note)


@one_thread
def simulate(model: Model, runs: Sequence[Experiment] | Experiment, *, engine: str | Engine = "rosenbrock",
             initial: str = "auto", estimate_initial: bool = True) -> list[Simulation]:
    """Simulate `model`, at its present values, on the inputs of `runs`.

    Parameters
    ----------
    model : Model
    runs : Experiment or sequence of Experiment
    engine : str or Engine
    initial : {"auto", "rest", "measured", "estimate"}
        What is known of the state at the first sample.
    estimate_initial : bool
        Unknown initial states are fitted to the record (only they); otherwise the first samples are taken.

    Raises
    ------
    SimulationError
        If the integration fails.

    Examples
    --------
    >>> predicted = mi.simulate(better.model, check)
    >>> predicted[0].outputs["omega"].shape == check[0].t.shape
    True
    """
    return list(at(*settled(as_problem(model, runs, engine=engine, initial=initial), estimate_initial)))


@one_thread
def planned(model: Model, t: Sequence[float] | Array, v: Sequence[float] | Array, *,
            channels: Sequence[str] = ("i", "omega"), sigma: Mapping[str, float] | None = None,
            hold: Any = "zoh", name: str = "plan") -> Experiment:
    """Return an experiment that was not made: what `model`, at its values, would show.

    Parameters
    ----------
    model : Model
    t, v : array (N,)
        Time (s) and voltage (V) as they would be applied, from rest.
    channels : sequence of str
        What would be measured.
    sigma : mapping of str to float, optional
        Noise per channel, SI; default one per cent of the channel's RMS.
    hold : {"zoh", "linear"}
    name : str

    Examples
    --------
    >>> t = np.arange(0, 1, 1e-3)
    >>> plan = mi.planned(better.model, t, np.where(t < 0.5, 6.0, -6.0), channels=["omega"])
    >>> mi.identifiability(mi.Problem(better.model, [plan])).rank
    4
    """
    positive(**{f"sigma of {c}": s for c, s in (sigma or {}).items()})
    try:
        t, v = np.asarray(t, float), np.asarray(v, float)
    except (TypeError, ValueError) as error:
        raise DataError(f"planned: t and v are numbers, one per sample ({error}).") from error
    blank = Experiment(t, {"v": v}, {c: np.zeros(len(t)) for c in channels}, hold=hold, name=name)
    return with_channels(model, blank, channels, sigma)


def with_channels(model: Model, run: Experiment, channels: Sequence[str],
                  sigma: Mapping[str, float] | None = None) -> Experiment:
    """Return the run with `channels` filled in from the model, with their noise (default 1 % of the RMS)."""
    shown, noise = {c: np.zeros(run.n) for c in channels}, dict.fromkeys(channels, 1.0)
    for _ in range(2):  # first as exactly as the voltage asks, then as this noise does; the speed says how wide sgn is
        full = run.with_(outputs={**run.outputs, **shown}, sigma={**run.sigma, **noise})
        outputs = at(*settled(Problem(model, (full,), initial="rest"), estimate_initial=False))[0].outputs
        shown = {c: outputs[c] for c in channels}
        noise = {c: (sigma or {}).get(c) or ASSUMED_NOISE * float(np.sqrt(np.mean(y ** 2))) or 1.0
                 for c, y in shown.items()}
    return run.with_(outputs={**run.outputs, **shown}, sigma={**run.sigma, **noise})


def settled(problem: Problem, estimate_initial: bool = True) -> tuple[Problem, Array]:
    """Return a problem with all that runs share fixed at the model's values, and where the rest fits the records."""
    held = problem.with_(model=problem.model.fix(*problem.model.shared_names), priors={}, penalties=())
    held = with_angles_apart(held) if estimate_initial else held
    q, held = held.start, held.refined(held.start)
    for _ in range(SETTLES if len(q) and estimate_initial else 0):  # friction turns elsewhere: other sub-steps there
        try:
            found = levenberg_marquardt(held.residual, held.residual_and_jacobian, q, held.scaling.bounds,
                                        LevenbergMarquardt(max_iterations=20))
        except FitError:  # slopes that cannot be followed (a stick that hangs by a hair): the last states stand
            held.residual(q)
            held = held.refined(q)
            break
        q, held = found.q, held.refined(found.q)
        if found.status == "converged":
            break
    return held, q


def with_angles_apart(problem: Problem) -> Problem:
    """Return the problem with an angle that is another in every run at the best of many, one run after another."""
    q, first = problem.start.copy(), len(problem.unknown) - len(problem.unknowns.apart)
    for j, (_, k, parameter) in enumerate(problem.unknowns.apart, first):
        costs = {}
        for value in TURN.tolist() if parameter.unit == "rad" else ():
            q[j] = value / problem.scaling.scale[j]
            with contextlib.suppress(SimulationError):
                r, _ = problem.measured[k].residual(problem.simulate(q, k, derivatives=False))
                costs[value] = float(r @ r)
        # of those a period apart the nearest
        near = [z for z, cost in costs.items() if cost < ALIKE * min(costs.values())]
        q[j] = min(near, key=abs) / problem.scaling.scale[j] if near else problem.start[j]
    return problem.begun_at(q)


def at(problem: Problem, q: Array) -> tuple[Simulation, ...]:
    """Return the simulations of a problem at solver coordinates `q`."""
    trajs = (problem.simulate(q, k, derivatives=False) for k in range(len(problem.runs)))
    return tuple(Simulation(run.experiment, dict(zip(problem.outputs, traj.y.T, strict=True)),
                            dict(zip(problem.system.states, traj.x.T, strict=True)))
                 for run, traj in zip(problem.runs, trajs, strict=True))


def judge(simulations: Sequence[Simulation]) -> Evaluation:
    """Return the errors of `simulations` against what was measured."""
    channels = [c for c in CHANNELS if any(c in s.experiment.outputs and c in s.outputs for s in simulations)]
    sums, by_run = {c: np.zeros(3) for c in channels}, []
    for s in simulations:
        errors = {}
        for c in (c for c in channels if c in s.experiment.outputs):
            y = s.experiment.moved(c)
            ok = np.isfinite(e := s.residual(c))
            e = e[ok]
            sums[c] += e @ e, y[ok] @ y[ok], ok.sum()
            errors[c] = normalised(float(np.linalg.norm(e)), float(np.linalg.norm(y[ok])))
        by_run.append(errors)
    return Evaluation(tuple(simulations), {c: normalised(*np.sqrt(s[:2])) for c, s in sums.items()},
                      {c: float(np.sqrt(s[0] / max(s[2], 1))) for c, s in sums.items()}, tuple(by_run))


def normalised(error: float, size: float) -> float:
    """Return an error over the size of what was measured; NaN where that does not move: no share tells anything."""
    return float(error / size) if size > 0 else float("nan")


def moving(shares: Mapping[str, float]) -> dict[str, float]:
    """Return the NRMSE of the channels that move."""
    return {c: e for c, e in shares.items() if not np.isnan(e)}


def largest(shares: Mapping[str, float]) -> float:
    """Return the largest NRMSE of the channels that move; NaN, neither large nor small, without any."""
    return max(moving(shares).values(), default=float("nan"))


def cut_alike(fitted: Sequence[Experiment], runs: Sequence[Experiment] | Experiment) -> list[Experiment]:
    """Return `runs` in windows, if the `fitted` ones are."""
    runs = [runs] if isinstance(runs, Experiment) else list(runs)
    seconds = fitted[0].meta.get("window")
    return runs if seconds is None else [part for run in runs for part in windows(run, seconds)]


@one_thread
def evaluate(fit_or_model: Any, runs: Sequence[Experiment] | Experiment, **options: Any) -> Evaluation:
    """Judge a fit (or a model at its values) on `runs` that it may never have seen.

    Unknown initial states of these runs are estimated from them; no parameter is, but one that is another in every run
    (a zero of the encoder): its error here is no proof of it. A fit in windows is judged by what it predicts one ahead.

    Parameters
    ----------
    fit_or_model : Fit or Model
    runs : Experiment or sequence of Experiment
    **options
        `engine` and `initial` as in `simulate`.

    Examples
    --------
    >>> mi.evaluate(better, check)
    <evaluation of 1 runs: NRMSE i 1.38 %, omega 1.02 %>
    """
    model = fit_or_model if isinstance(fit_or_model, Model) else getattr(fit_or_model, "model", None)
    if model is None:
        raise UsageError(f"evaluate takes a fit or a model first, then the records; got {name_of(fit_or_model)}.")
    if not isinstance(fit_or_model, Model):
        options = {"engine": fit_or_model.problem.engine, "initial": fit_or_model.problem.initial, **options}
        if "sgn_width" in model.parameters:  # it was chosen for the fitted runs; it is part of what is judged
            model = model.replace(sgn_width=model.values["sgn_width"])
        runs = cut_alike(fit_or_model.problem.experiments, runs)
    return judge(simulate(model, runs, **options))


NRMSE = "NRMSE: RMS of the error over RMS of the measured channel (of an angle: of its travel)."
LEAST_FACTOR = 0.02  # a quick channel with few samples per time constant passes for noisy
EXPLAINED = 0.25  # NRMSE above which a channel counts as poorly explained


def misfit_over_noise(problem: Problem, q: Array) -> dict[str, float]:
    """Return the RMS of the residual over the noise per channel; far below 1 where the noise was overestimated."""
    trajs = (problem.simulate(q, k, derivatives=False) for k in range(len(problem.runs)))
    errors = np.concatenate([(m.y - traj.y) / m.noise for m, traj in zip(problem.measured, trajs, strict=True)])
    found = {c: e[np.isfinite(e)] for c, e in zip(problem.outputs, errors.T, strict=True)}
    return {c: max(float(np.sqrt(e @ e / max(e.size, 1))), LEAST_FACTOR) for c, e in found.items()}


def poorly_explained(problem: Problem, q: Array) -> bool:
    """Tell whether some channel is far above its noise and not followed at all."""
    for c, factor in misfit_over_noise(problem, q).items():
        runs = [r for r in problem.runs if c in r.sigma]
        rms = np.sqrt(np.mean([np.nanmean((r.experiment.outputs[c] / r.sigma[c]) ** 2) for r in runs]))
        if factor > max(3.0, EXPLAINED * rms):
            return True
    return False


def integration_error(problem: Problem, q: Array) -> float:
    """Return the largest change of an output when every step is halved, in units of the noise."""
    return _halved_steps(problem, q)[0]


def integration_bias(problem: Problem, q: Array, jac: Array) -> tuple[float, float]:
    """Return the integration error, and by how many deviations it moves the estimate at most. Half the steps change the
    residual by Δr, the estimate by −(JᵀJ)⁻¹JᵀΔr: as long, in the covariance's metric, as what of Δr J can express."""
    error, change = _halved_steps(problem, q)
    jac = jac[:len(change)]
    pull = jac.T @ change
    return error, float(np.sqrt(np.abs(pull @ np.linalg.pinv(jac.T @ jac, hermitian=True) @ pull)))


def _halved_steps(problem: Problem, q: Array) -> tuple[float, Array]:
    """Return by how much steps half as long change the outputs: at most, over the noise; and the stacked residual."""
    if not hasattr(problem.integrator, "compiled"):  # chooses its steps itself
        return 0.0, np.zeros(0)
    both, seen = (problem.with_finer_steps(2), problem), problem.measured
    try:
        ys = [[p.simulate(q, k, derivatives=False).y for p in both] for k in range(len(seen))]
    except SimulationError:
        return float("inf"), np.zeros(0)
    changes = [fine - coarse for fine, coarse in ys]
    worst = max(float(np.max(np.abs(c) / m.noise)) for c, m in zip(changes, seen, strict=True))
    return worst, np.concatenate([m.stack(c * m.weights) for c, m in zip(changes, seen, strict=True)])

"""What an estimation found: `Fit`, `Failure` where it did not come through, and fits side by side: `compare`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from motorid.channels import channel_name
from motorid.display.cards import Card, Shown
from motorid.display.numbers import Std, counted, duration, number, percent, quantity, sentence
from motorid.display.tables import Cell, Flag, Table, value_cell
from motorid.errors import UsageError
from motorid.model.model import Model
from motorid.numerics.least_squares import gauss_newton_covariance
from motorid.numerics.noise import despiked
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.problem.simulate import Evaluation, Simulation, at, error_table, evaluate, judge, steady_errors
from motorid.records.experiment import Experiment, units_of

STATUS_MOODS = {"converged": "good", "stalled": "note", "limit": "note", "failed": "bad"}
UNDETERMINED = 1.0  # relative standard deviation above which a value is not shown as determined


@dataclass(frozen=True, eq=False)
class Fit(Shown):
    """What an estimation found.

    Attributes
    ----------
    problem : Problem
        As solved; its model holds the starting values.
    values : dict of str to float
        All parameters of the model, SI.
    residuals : ndarray, shape (n,)
        Whitened: outputs run by run, then priors and penalties.
    jacobian : ndarray, shape (n, k)
        d residuals / d unknowns in physical units; unknowns are the free parameters, then initial states.
    q : ndarray, shape (k,)
        Solver coordinates of the solution.
    status : str
        ``"converged"``, ``"stalled"``, ``"limit"`` or ``"failed"``.
    message : str
        Why it ended, and what to try where it did not go well.
    history : tuple of float
        Cost after each iteration, cost = ½ rᵀr.
    seconds : float
    integration_error : float
        Largest error of the integration, in units of the noise.
    extra : dict
        What a particular solver adds (multipliers, continuity gaps).
    """

    problem: Problem
    values: Mapping[str, float]
    residuals: Array
    jacobian: Array
    q: Array
    status: str
    message: str
    history: tuple[float, ...]
    seconds: float = 0.0
    integration_error: float = float("nan")
    formulation: str = "plain"
    extra: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def model(self) -> Model:
        """The model with the fitted values: to add an effect to, to simulate, to export."""
        return self.problem.model.start_at(self.values)

    @property
    def cost(self) -> float:
        """½ rᵀr, with priors, penalties and the robust loss."""
        return 0.5 * float(self.residuals @ self.residuals)

    @property
    def chi2(self) -> float:
        """Σ of the squared output residuals over the noise."""
        return float(sum(np.nansum((s.residual(c) / run.sigma[c]) ** 2)
                         for s, run in zip(self.simulations, self.problem.runs, strict=True) for c in run.sigma))

    @property
    def dof(self) -> int:
        """Number of output samples minus number of unknowns."""
        return max(self.problem.n_outputs - len(self.problem.unknown), 1)

    @property
    def iterations(self) -> int:
        """Accepted steps."""
        return len(self.history) - 1

    @cached_property
    def _covariance(self) -> tuple[Array, np.ndarray]:
        # The noise was estimated beforehand; a model that does not reach it is less certain by that much.
        r = self.residuals[:self.problem.n_outputs]
        variance = float(r @ r) / self.dof
        variance = max(variance, 1.0) if self.problem.weights == "noise" else variance
        free = self.extra.get("free")  # directions that active constraints leave, (k, m)
        if free is None:
            return gauss_newton_covariance(self.jacobian, variance)
        covariance, determined = gauss_newton_covariance(self.jacobian @ free, variance)
        return free @ covariance @ free.T, ~np.any(np.abs(free[:, ~determined]) > 0, axis=1)

    @property
    def covariance(self) -> Array:
        """Gauss-Newton covariance of the unknowns, physical units, white residuals assumed; see `covariance()`."""
        return self._covariance[0]

    @cached_property
    def std(self) -> dict[str, float | None]:
        """One standard deviation per parameter, in its unit: 0 where held, None where the data do not determine it."""
        covariance, determined = self._covariance
        found: dict[str, float | None] = dict.fromkeys(self.values, 0.0)
        at_bound = self.at_bound
        for j, p in enumerate(self.problem.unknown):
            if p.name in found:
                sd = float(np.sqrt(max(covariance[j, j], 0.0)))
                vague = p.positive and sd > UNDETERMINED * abs(self.values[p.name])
                found[p.name] = None if not determined[j] or vague or p.name in at_bound else sd
        return found

    @cached_property
    def at_bound(self) -> set[str]:
        """Names of the parameters that ended at a limit: their slopes say nothing of what would be beyond."""
        names = set()
        for p in self.problem.unknown:
            value = self.values.get(p.name)
            if value is not None and (value <= p.lower or value >= p.upper) and np.isfinite(value):
                names.add(p.name)
        return names

    @property
    def initial(self) -> dict[str, float]:
        """Estimated initial states, as ``omega_0[run]``."""
        physical = self.problem.scaling.physical(self.q)
        return {p.name: float(physical[j]) for j, p in enumerate(self.problem.unknown) if p.name not in self.values}

    @cached_property
    def simulations(self) -> tuple[Simulation, ...]:
        """The fitted model on the records of the fit."""
        return at(self.problem, self.q)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Errors on the records of the fit, over all runs and run by run."""
        return judge(self.simulations)

    @cached_property
    def steady_state_error(self) -> dict[str, float]:
        """RMS difference of measured and simulated means over the steady parts of the records, SI, per channel."""
        return steady_errors(self.simulations, [run.sigma for run in self.problem.runs])

    @cached_property
    def misfit(self) -> Mapping[str, float]:
        """RMS of the residual over the noise of the sensor, per channel, samples that stand alone left aside."""
        found = {}
        for c in self.problem.outputs:
            pairs = zip(self.simulations, self.problem.runs, strict=True)
            r = np.concatenate([despiked(s.residual(c)) / run.sigma[c] for s, run in pairs if c in run.sigma])
            found[c] = float(np.sqrt(np.mean(r**2)))
        return found

    @property
    def nrmse(self) -> Mapping[str, float]:
        """RMSE over RMS of the measured channel, per channel."""
        return self.evaluation.nrmse

    @property
    def rmse(self) -> Mapping[str, float]:
        """Root mean square error per channel, SI."""
        return self.evaluation.rmse

    @property
    def tau_e(self) -> float | None:
        """Electrical time constant L/R, s."""
        v = self.values
        return v["L"] / v["R"] if "L" in v else None

    @property
    def tau_m(self) -> float | None:
        """Mechanical time constant R·J/(K² + R·b), s; J/b for a torque-driven model."""
        v = self.values
        if "K" in v:
            return v["R"] * v["J"] / (v["K"] ** 2 + v["R"] * v["b"])
        return v["J"] / v["b"] if v["b"] > 0 else None

    @property
    def damping(self) -> float | None:
        """Damping ratio of the linear motor's two poles."""
        v = self.values
        if "K" not in v or v["L"] <= 0:
            return None
        natural = np.sqrt((v["K"] ** 2 + v["R"] * v["b"]) / (v["L"] * v["J"]))
        return float((v["R"] / v["L"] + v["b"] / v["J"]) / (2 * natural))

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of the sensor's noise per channel, SI; of several runs the smallest."""
        sigmas = [run.sigma for run in self.problem.runs]
        return {c: min(s[c] for s in sigmas if c in s) for c in self.nrmse}

    def card(self) -> Card:
        """Return how it ended, parameters, errors, and what constraints cost."""
        runs = self.problem.experiments
        vague = [n for n, s in self.std.items() if s is None]
        flags = [Flag(self.status, STATUS_MOODS.get(self.status, "plain"))]
        flags += [Flag(self.formulation)] if self.formulation != "plain" else []
        flags += [Flag(f"{len(vague)} not determined", "note")] if vague else []
        times = [f"{what} {duration(t)}" for what, t in (("τ_e", self.tau_e), ("τ_m", self.tau_m)) if t]
        times += [f"damping {number(self.damping, 3)}"] if self.damping else []
        steps = counted(self.iterations, "iteration")
        head = f"{counted(len(runs), 'run')}, {self.problem.n_outputs} samples, {steps} in {duration(self.seconds)}. "
        text = (head + ", ".join(times), "" if self.status == "converged" else sentence(self.message))
        after = [("mi.plot_fit(fit)", "see it"), ("mi.diagnose(fit)", "what is missing")]
        after += [("mi.identifiability(fit)", f"why {', '.join(vague)} cannot be determined")] if vague else []
        tables = (parameter_table(self), error_table({"": self.evaluation}, self.noise), constraint_table(self))
        return Card(f"Fit of {self.model.title}", flags, text, [t for t in tables if t], after)

    def __repr__(self) -> str:
        errors = ", ".join(f"{c} {100 * e:.2f} %" for c, e in self.nrmse.items())
        name = " + ".join([self.problem.model.base, *self.problem.model.effect_names])
        return f"<fit {self.status}: {name}, NRMSE {errors}>"


@dataclass(frozen=True, repr=False)
class Failure(Shown):
    """A run that failed, kept as a value: where it started, its status and why."""

    start: Mapping[str, float]
    status: str
    message: str

    def card(self) -> Card:
        """Return why it failed, and where it started."""
        start = ", ".join(f"{n} = {number(v)}" for n, v in self.start.items())
        text = (self.message, f"It started from {start}." if start else "")
        return Card("Failed run", (Flag(self.status, "bad"),), text)


def own_std(fit: Fit) -> Std:
    """Return a fit's own standard deviations, which take the residuals as white."""
    return fit.std


def parameter_table(fit: Fit, before: Fit | None = None, std: Callable[[Fit], Std] = own_std) -> Table:
    """Return the parameters as value ± standard deviation, beside those of another fit where one is given.

    Held or not determined is said in words. `std` gives other standard deviations than the fits' own.
    """
    fits = [f for f in (before, fit) if f is not None]
    known = [std(f) for f in fits]
    rows = [[name, *(parameter_cell(f, name, s) for f, s in zip(fits, known, strict=True)), p.doc]
            for name, p in fit.model.parameters.items()]
    heads = ["value ± std"] if before is None else ["before", "after"]
    return Table(["parameter", *heads, "meaning"], rows, "Parameters", left=tuple(range(len(heads) + 2)))


def parameter_cell(fit: Fit, name: str, std: Std) -> Cell:
    """Return one parameter as ``1.302 ± 0.004 Ω``, or with ``(held)``, ``(chosen …)``, ``(not determined)``."""
    if name not in fit.values:
        return "–"
    p = fit.model.parameters[name]
    if name == "sgn_width" and not p.given:
        return f"{quantity(fit.values[name], p.unit, 2)} (chosen from the data)"
    return value_cell(fit.values[name], std[name] if p.vary else 0.0, p.unit)


def derived_table(fit: Fit) -> Table | None:
    """Return time constants, damping ratio and the error at the steady state, as far as there are any."""
    units = units_of(fit.problem.experiments)
    times = (("electrical time constant", fit.tau_e), ("mechanical time constant", fit.tau_m))
    rows = [(name, duration(t)) for name, t in times if t is not None]
    if fit.damping is not None:
        rows.append(("damping ratio", number(fit.damping, 3)))
    rows += [(f"steady-state error of the {channel_name(c, units[c])}", quantity(error, units[c], 3))
             for c, error in fit.steady_state_error.items()]
    return Table(("derived", "value"), rows, left=(0, 1)) if rows else None


def constraint_table(fit: Fit, violations: Mapping[str, float] = MappingProxyType({})) -> Table | None:
    """Return what each true constraint costs to keep, and how far each is violated where that is given.

    `violations` is by name and unit, ``"CurrentLimit(8 A), A"``; relations that are only weighed stand there too.
    """
    multipliers = {f"{m.name}, {m.unit}": m for m in fit.extra.get("multipliers", ())}
    rows = []
    for name in dict.fromkeys([*violations, *multipliers]):
        label, _, unit = name.rpartition(", ")
        m = multipliers.get(name)
        beyond = [quantity(violations.get(name), unit, 3)] if violations else []
        place = "weighed, not enforced" if m is None else Flag(m.label, "note") if m.active else m.label
        cost = "–" if m is None else f"{number(m.value, 3)} per {m.unit or 'unit'}"
        rows.append([label or name, *beyond, place, cost])
    header = ["constraint", *(["largest violation"] if violations else []), "at the solution",
              "multiplier (fall of the cost if it gave way)"]
    return Table(header, rows, "Constraints", left=(0, len(header) - 2)) if rows else None


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Fits side by side: errors on their records, held-out errors, how the parameters moved.

    Attributes
    ----------
    fits : tuple of Fit
    names : tuple of str
        ``base + effects`` of each.
    nrmse : tuple of dict of str to float
    validation_nrmse : tuple of (dict of str to float or None)
    parameters : dict of str to tuple of (value, std) or None
        Per parameter, one entry per fit; None where a model lacks it.
    """

    fits: tuple[Fit, ...]
    names: tuple[str, ...]
    nrmse: tuple[Mapping[str, float], ...]
    validation_nrmse: tuple[Mapping[str, float] | None, ...]
    parameters: Mapping[str, tuple[tuple[float, float | None] | None, ...]]

    def card(self) -> Card:
        """Return errors and parameters side by side."""
        return Card(f"Comparison of {counted(len(self.fits), 'fit')}",
                    tables=(comparison_table([(f.model.title, f) for f in self.fits], self.validation_nrmse),),
                    after=(("mi.plot_parameters(*comparison.fits)", "how the parameters moved"),))


def compare(fits: Sequence[Fit], validate: Sequence[Experiment] | Experiment | None = None) -> Comparison:
    """Put fits side by side.

    Parameters
    ----------
    fits : sequence of Fit
    validate : Experiment or sequence of Experiment, optional
        Held-out runs to judge each fit on.

    Raises
    ------
    UsageError
        If no fit is given.
    """
    if not fits:
        raise UsageError("compare() takes a list of fits: mi.compare([fit, better]).")
    held = tuple(None if validate is None else dict(evaluate(f, validate).nrmse) for f in fits)
    names = list(dict.fromkeys(n for f in fits for n in f.values if n != "sgn_width"))
    parameters = {n: tuple((f.values[n], f.std[n]) if n in f.values else None for f in fits) for n in names}
    titles = tuple(" + ".join([f.problem.model.base, *f.problem.model.effect_names]) for f in fits)
    return Comparison(tuple(fits), titles, tuple(dict(f.nrmse) for f in fits), held, parameters)


def comparison_table(fits: Sequence[tuple[str, Fit]], held_out: Sequence[Mapping[str, float] | None] = (),
                     std: Callable[[Fit], Std] = own_std) -> Table:
    """Return fits side by side under their titles: NRMSE as fitted and `held_out`, parameters with their `std`."""
    units = units_of(run for _, f in fits for run in f.problem.experiments)
    channels = {c: channel_name(c, units.get(c, "")) for _, f in fits for c in f.nrmse}
    rows: list[Sequence[Cell]] = [[f"NRMSE {name}", *(percent(f.nrmse.get(c)) for _, f in fits)]
                                  for c, name in channels.items()]
    if any(held_out):
        rows += [[f"held-out {name}", *(percent((e or {}).get(c)) for e in held_out)] for c, name in channels.items()]
    known = [std(f) for _, f in fits]
    names = dict.fromkeys(n for _, f in fits for n in f.values if n != "sgn_width")
    rows += [[n, *(parameter_cell(f, n, s) for (_, f), s in zip(fits, known, strict=True))] for n in names]
    return Table(["quantity", *(title for title, _ in fits)], rows)

"""What an estimation found: `Fit`, `Failure` where it did not come through, and fits side by side: `compare`."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from motorid.channels import CHANNELS, channel_name
from motorid.display.cards import Card, Cell, Flag, Printed, Shown, Table
from motorid.display.numbers import counted, duration, factor, listed, number, percent, quantity, sentence, with_error
from motorid.errors import UsageError, name_of
from motorid.estimation.covariance import Certainty, Quantity, certainty, combinations
from motorid.model.model import Model
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array, despiked
from motorid.problem import simulate
from motorid.problem.plain_data import model_dict, problem_dict
from motorid.problem.problem import Problem
from motorid.problem.simulate import NRMSE, Evaluation, Simulation, error_table, evaluate, judge, largest, moving
from motorid.records.experiment import Experiment, record_of, units_of
from motorid.records.files import json_text, write_files
from motorid.records.steady_state import find_segments

LOST = 1.0  # NRMSE at which zero is as near to what was measured
PLAIN = 1.5  # times the noise: up to here errors are said to be at its level
COLOURED = 3.0  # times the noise from fast changes: what a correlation of 0.9 between neighbours makes of it
SAVED = ("q", "status", "message", "history", "seconds", "integration_error", "formulation")  # plain fields
FLAGS = {"noise": Flag("fits", "good"), "open": Flag("no optimum", "note"), "poor": Flag("fits poorly", "bad"),
         "lost": Flag("does not fit", "bad")}


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
    integration_error : float
        Largest error of the integration, in units of the noise.
    extra : dict
        What a particular solver adds (multipliers, continuity gaps).

    Examples
    --------
    >>> fit = mi.fit(mi.dc_motor() + mi.effects.coulomb, runs)
    >>> fit.fits
    'noise'
    >>> print(f"R = {fit.values['R']:.2f} Ω, one standard deviation {fit.std['R']:.1g} Ω")
    R = 1.38 Ω, one standard deviation 0.0006 Ω
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

    @one_thread
    def certainty(self, method: str = "coloured") -> Certainty:
        """Return what the data say of the unknowns; ``"white"`` takes the residuals of samples as independent."""
        return certainty(self.problem, self.q, self.residuals, self.jacobian, self.extra.get("free"), method)

    @cached_property
    def _certainty(self) -> Certainty:
        return self.certainty()

    @property
    def covariance(self) -> Array:
        """Covariance of the unknowns, physical units, along what the data determine; see `motorid.covariance`."""
        return self._certainty.matrix

    @cached_property
    def std(self) -> dict[str, float | None]:
        """One standard deviation per parameter, in its unit: 0 where fixed, None where the data do not determine it.

        For coloured residuals: taken as white noise, those of a model that lacks something make it far too certain."""
        known = dict(zip((p.name for p in self.problem.unknown), self._certainty.std, strict=True))
        return {n: known.get(n, 0.0) for n in self.values}

    @cached_property
    def per_run(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Value, std and unit of what is another in every run, by run (of one name ``run (2)``); the first's stands."""
        known = dict(zip((p.name for p in self.problem.unknown), self._certainty.std, strict=True))
        names, found = [r.name for r in self.problem.experiments], dict[str, dict[str, dict[str, Any]]]()
        for name, k, p in self.problem.unknowns.apart:
            run = names[k] if names.count(names[k]) == 1 else f"{names[k]} ({k + 1})"
            found.setdefault(name, {})[run] = {"value": self.initial[p.name], "std": known[p.name], "unit": p.unit}
        return found

    @cached_property
    def determined(self) -> dict[str, Quantity]:
        """Gain, time constants, friction as a voltage …: what the data determine even where parameters stay open."""
        return combinations(self.problem, self.q, self._certainty)

    @property
    def fits(self) -> str:
        """Whether the model explains the records.

        ``"noise"``: no error is more than three times the noise, which colour can do; ``"poor"``: some is;
        ``"lost"``: a channel is not followed at all, or there is no result."""
        if self.status == "failed" or not largest(self.nrmse) < LOST:
            return "lost"
        return "poor" if max(self.misfit.values(), default=0.0) > COLOURED else "noise"

    @property
    def mostly_noise(self) -> bool:
        """Whether a model that fits explains less of every channel that moves than it leaves, by the squared error."""
        return self.fits == "noise" and min(moving(self.nrmse).values(), default=0.0) ** 2 > 0.5

    @property
    def verdict(self) -> str:
        """Whether it fits, in a sentence: by the size of the errors, which is no answer before an optimum."""
        times, lead = max(self.misfit.values(), default=0.0), "Fits: errors" if self.status == "converged" else "Errors"
        said = {"noise": f"{lead} at the level of the noise" if times < PLAIN else
                f"{lead} up to {number(times, 2)} times the noise, which correlated noise can explain; whether it "
                "does, a diagnosis tells",
                "poor": f"Fits poorly: errors {factor(times, 'up to ')} times the noise",
                "lost": "Does not fit: predicting zero would be closer"}[self.fits]
        if self.mostly_noise:
            said = "Fits records that are mostly noise: errors" + said[len(lead):]
        known = not self.problem.unknown or any([*self.std.values(), *self.determined])
        if self.status != "failed" and (not moving(self.nrmse) or (self.fits == "noise" and not known)):
            said = "Nothing is determined: the records do not show what the motor does, and any values fit them"
        if self.window:
            said += f", a window of {number(self.window, 2)} s ahead"
            said += f"; {listed(anew)} begin{'s' * (len(anew) == 1)} anew in each" if (anew := self.memories) else ""
        end = "" if self.status == "converged" else f" Not converged ({self.status}): the values are not an optimum."
        off = {n: abs(self.values[n] - mean) / np.sqrt(sd**2 - own**2)  # as far as both alone would be apart
               for n, (mean, sd) in self.problem.priors.items() if (own := self.std.get(n) or sd) < sd}
        end += "".join(f" The records contradict the prior of {n} by {number(far, 2)} standard deviations."
                       for n, far in off.items() if far > 3)
        return f"{said} (NRMSE {self.evaluation.words}).{end}"

    @property
    def memories(self) -> list[str]:
        """States that no channel shows: they begin anew in every window or part of a record."""
        return [s for s in self.problem.system.states if s not in (*CHANNELS, "clock", "distance")]

    @property
    def window(self) -> float | None:
        """Length of the windows that the records are simulated in, s; None where they are simulated as a whole."""
        return self.problem.experiments[0].meta.get("window")

    @cached_property
    def at_bound(self) -> set[str]:
        """Names of the parameters that ended at a limit: their slopes say nothing of what would be beyond."""
        ends = {p.name: (p, self.values[p.name]) for p in self.problem.unknown if p.name in self.values}
        return {n for n, (p, value) in ends.items() if np.isfinite(value) and not p.lower < value < p.upper}

    @property
    def initial(self) -> dict[str, float]:
        """Estimated initial states, as ``omega_0[run]``; ``i_0[run]`` is in rad/s² where no current was measured."""
        physical = self.problem.scaling.physical(self.q)
        return {p.name: float(physical[j]) for j, p in enumerate(self.problem.unknown) if p.name not in self.values}

    @cached_property
    def simulations(self) -> tuple[Simulation, ...]:
        """The fitted model on the records of the fit."""
        return simulate.at(self.problem, self.q)

    @cached_property
    def evaluation(self) -> Evaluation:
        """Errors on the records of the fit, over all runs and run by run."""
        return judge(self.simulations)

    @cached_property
    def steady_state_error(self) -> dict[str, float]:
        """RMS difference of measured and simulated means over the steady parts of the records, SI, per channel."""
        errors: dict[str, list[float]] = {}
        for part in find_segments([s.experiment for s in self.simulations], [run.sigma for run in self.problem.runs]):
            s = self.simulations[part.run]
            for c in part.means if part.first >= s.experiment.run_in else ():
                if c in s.experiment.outputs and c in s.outputs:
                    errors.setdefault(c, []).append(float(np.nanmean(s.residual(c)[part.first:part.last + 1])))
        return {c: float(np.sqrt(np.mean(np.square(e)))) for c, e in errors.items()}

    @cached_property
    def misfit(self) -> Mapping[str, float]:
        """RMS of the residual over the noise of the sensor, per channel, samples that stand alone left aside."""
        pairs = list(zip(self.simulations, self.problem.runs, strict=True))
        left = {c: np.concatenate([despiked(s.residual(c)) / run.sigma[c] for s, run in pairs if c in run.sigma])
                for c in self.problem.outputs}
        return {c: float(np.sqrt(np.mean(r**2))) for c, r in left.items()}

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
        return self.values["L"] / self.values["R"] if "L" in self.values else None

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
        return {c: min(run.sigma[c] for run in self.problem.runs if c in run.sigma) for c in self.nrmse}

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the fit with its records as JSON; `motorid.load` gives it back without fitting again.

        Parameters
        ----------
        path : path
        force : bool
            Also over a file that motorid did not write.

        Raises
        ------
        UsageError, OutputError
            If the file must not or cannot be written there, or the fit holds code of your own: a `Constraint`, an
            engine, or multiple shooting with process noise.
        """
        if self.formulation == "process noise":
            raise UsageError("a fit with process noise cannot be saved; its model can, mi.export(fit, 'motor.json').")
        head = {"model": model_dict(self.model), "parameters": {n: {"value": self.values[n], "std": self.std[n],
            "unit": p.unit, "fixed": not p.vary} for n, p in self.model.parameters.items()}, "verdict": self.verdict}
        end = {f: getattr(self, f) for f in SAVED} | {"cost": self.cost, "extra": {
            k: [asdict(m) for m in v] if k in ("multipliers", "active") else v for k, v in self.extra.items()}}
        text = json_text(head, {"fit": {"problem": problem_dict(self.problem), **end}})
        return write_files({Path(os.path.expanduser(path)): text}, force)[0]

    def to_frame(self) -> Any:
        """Return the parameters as a pandas.DataFrame: value, std, unit, fixed, meaning."""
        import pandas as pd

        rows = {n: [self.values[n], self.std[n], p.unit, not p.vary, p.doc] for n, p in self.model.parameters.items()}
        return pd.DataFrame.from_dict(rows, "index", columns=["value", "std", "unit", "fixed", "meaning"])

    def card(self) -> Card:
        """Return how it ended, parameters, errors, and what constraints cost."""
        vague = [n for n, s in self.std.items() if s is None and n not in self.at_bound]
        flags = [flag_of(self), *([] if self.status == "converged" else [Flag(self.status, "bad")])]
        flags += [Flag(self.formulation)] if self.formulation != "plain" else []
        flags += [Flag(f"{len(vague)} not determined", "note")] if vague else []
        amount = f"{counted(len(self.problem.experiments), 'run')}, {self.problem.n_outputs} measured values."
        steady = any(hasattr(c, "segments") for c in (*self.problem.penalties, *self.problem.constraints))
        text = (self.verdict, NRMSE, f"{amount} {ended(self)}", steady * (
            "SteadyState(): every ± takes the measured means as exact, and is too small; fit without it for them."))
        after = [("mi.plot_fit(fit)", "see it"), ("mi.diagnose(fit)", "what is missing")]
        after = after if self.fits == "noise" else after[::-1]
        after += [("mi.identifiability(fit)", f"why {', '.join(vague)} cannot be determined")] if vague else []
        errors = replace(error_table({"": self.evaluation}, self.noise), note="")
        tables = (*value_tables(self), errors, constraint_table(self))
        return Card(f"Fit of {self.model.title}", flags, text, [t for t in tables if t], after)

    def __repr__(self) -> str:
        errors = ", ".join(f"{c} {100 * e:.2f} %" for c, e in moving(self.nrmse).items()) or "–"
        end = "" if self.status == "converged" else f", {self.status}"
        return f"<fit of {self.problem.model.name}: {flag_of(self)}{end}, NRMSE {errors}>"


def checked(fit: Any, caller: str) -> Fit:
    """Return `fit` if it is one; else `UsageError`: `caller` takes nothing else."""
    if not isinstance(fit, Fit):
        raise UsageError(f"{caller} takes a fit, mi.{caller}(mi.fit(mi.dc_motor(), runs)); got {name_of(fit)}.")
    return fit


def flag_of(fit: Fit) -> Flag:
    """Return in a word whether a model fits: errors like noise are no fit before an optimum."""
    return FLAGS["open" if fit.fits == "noise" and fit.status != "converged" else fit.fits]


def ended(fit: Fit) -> str:
    """Say how the estimation ended: ``Converged in 5 iterations (97 ms).``, or why it did not."""
    if fit.status == "converged":
        took = f" ({duration(fit.seconds)})" if fit.seconds else ""
        return f"Converged in {counted(fit.iterations, 'iteration')}{took}."
    return sentence(fit.message)


@dataclass(frozen=True, repr=False)
class Failure(Shown):
    """A run that failed, kept as a value: where it started, its status and why.

    Examples
    --------
    >>> many = mi.multistart(fit, starts=2, quiet=True)
    >>> [end.message for end in many.results if isinstance(end, mi.Failure)]
    []
    """

    start: Mapping[str, float]
    status: str
    message: str

    def card(self) -> Card:
        """Return why it failed, and where it started."""
        start = ", ".join(f"{n} = {number(v)}" for n, v in self.start.items())
        text = (self.message, f"It started from {start}." if start else "")
        return Card("Failed run", (Flag(self.status, "bad"),), text)


def parameter_table(fit: Fit, before: Fit | None = None) -> Table:
    """Return the parameters as value ± standard deviation, beside those of another fit where one is given. Those that
    no fit determines share a row; beside another fit what is determined instead follows."""
    fits = [f for f in (before, fit) if f is not None]
    pars = [p for p in fit.model.parameters.values() if before is None or p.name != "sgn_width"]
    open_ = [p for p in pars if p.vary and all(f.std.get(p.name) is None and p.name not in f.at_bound for f in fits)]
    rows = [[p.name, *(parameter_cell(f, p.name) for f in fits), *([p.doc] if before is None else [])]
            for p in pars if p not in open_]
    if open_:
        meaning = [open_[0].doc if len(open_) == 1 else ""] if before is None else []
        rows.append([", ".join(p.name for p in open_), *(Flag("not determined", "note") for _ in fits), *meaning])
    if before is not None and any(p.vary and fit.std.get(p.name) is None for p in pars):
        rows += [[d.text, *(with_error(q.value, q.std, q.unit) if (q := f.determined.get(n)) else "–" for f in fits)]
                 for n, d in fit.determined.items()]
    heads = ["value ± std", "meaning"] if before is None else ["before", "after"]
    return Table(["parameter", *heads], rows, "Parameters", left=(0, 1, 2))


def parameter_cell(fit: Fit, name: str) -> Cell:
    """Return one parameter as ``1.302 ± 0.004 Ω``, or with ``(fixed)``, ``(chosen …)``, ``(not determined)``."""
    if name not in fit.values:
        return "–"
    p = fit.model.parameters[name]
    if runs := fit.per_run.get(name):
        if len(runs) == 1:
            return "".join(f"{with_error(**own)} in {run}" for run, own in runs.items())
        values = [own["value"] for own in runs.values()]
        return f"{number(min(values), 3)} to {number(max(values), 3)} {p.unit}".rstrip() + ", by run"
    if name == "sgn_width" and not p.given:
        return f"{quantity(fit.values[name], p.unit, 2)} (chosen from the data)"
    if p.vary and fit.std[name] is None:
        at = with_error(fit.values[name], None, p.unit, "at its limit")
        return Flag(at if name in fit.at_bound else "not determined", "note")
    return with_error(fit.values[name], fit.std[name], p.unit)


def value_tables(fit: Fit) -> list[Table]:
    """Return the parameters and what follows from them; what is determined goes first."""
    # Gain, time constants, damping, torques as voltages, as far as the records determine them.
    known = [(d.text, with_error(d.value, d.std, d.unit)) for d in fit.determined.values()]
    if (top := fit.determined.get("no_load_speed")) and top.unit == "rad/s":
        known += [("no-load speed in rpm", quantity(top.value * 30 / np.pi, "rpm", 3))]
    tables = parameter_table(fit), Table(("what the records determine", "value ± std"), known, left=(0, 1))
    rows = [(name, run, with_error(**own)) for name, runs in fit.per_run.items() for run, own in runs.items()]
    own = Table(("parameter", "run", "value ± std"), rows, "Parameters per run", left=(0, 1, 2))
    return [t for t in (*(tables[::-1] if None in fit.std.values() else tables), own) if t.rows]


def steady_table(fit: Fit) -> Table | None:
    """Return the error at the steady state, where the records have one."""
    units = units_of(fit.problem.experiments)
    rows = [(channel_name(c, units[c]), quantity(error, units[c], 3)) for c, error in fit.steady_state_error.items()]
    return Table(("channel", "error at the steady state"), rows) if rows else None


def constraint_table(fit: Fit, violations: Mapping[str, float] = MappingProxyType({})) -> Table | None:
    """Return what each true constraint costs to keep, and how far each is violated where that is given. `violations` is
    by name and unit, ``"CurrentLimit(8 A), A"``; relations that are only weighed stand there too."""
    multipliers = {f"{m.name}, {m.unit}": m for m in fit.extra.get("multipliers", ())}
    rows = []
    for name in dict.fromkeys([*violations, *multipliers]):
        label, _, unit = name.rpartition(", ")
        m = multipliers.get(name)
        place = "weighted, not enforced" if m is None else Flag(m.label, "note") if m.active else m.label
        cost = "–" if m is None else f"{number(m.value, 3)} per {m.unit or 'unit'}"
        rows.append([label or name, *([quantity(violations.get(name), unit, 3)] if violations else []), place, cost])
    header = ["constraint", *(["largest violation"] if violations else []), "at the solution",
              "multiplier (fall of the cost if relaxed)"]
    return Table(header, rows, "Constraints", left=(0, len(header) - 2)) if rows else None


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Printed):
    """Fits side by side: errors on their records, held-out errors, how the parameters moved."""

    fits: tuple[Fit, ...]
    names: tuple[str, ...]  # base + effects of each
    nrmse: tuple[Mapping[str, float], ...]
    validation_nrmse: tuple[Mapping[str, float] | None, ...]
    parameters: Mapping[str, tuple[tuple[float, float | None] | None, ...]]  # (value, std) per fit that has it

    def card(self) -> Card:
        """Return errors and parameters side by side."""
        records = {frozenset(map(record_of, f.problem.experiments)) for f in self.fits}
        apart = ("Not all were fitted to the same records (or to these as read): only held-out errors compare, "
                 "validate=runs." if len(records) > 1 else "")
        return Card(f"Comparison of {counted(len(self.fits), 'fit')}", text=(apart,),
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

    Examples
    --------
    >>> table = mi.compare([fit, better], validate=check)
    >>> table.names
    ('dc_motor', 'dc_motor + coulomb')
    """
    if not fits:
        raise UsageError("compare() takes a list of fits: mi.compare([fit, better]).")
    held = tuple(None if validate is None else dict(evaluate(f, validate).nrmse) for f in fits)
    names = dict.fromkeys(n for f in fits for n in f.values if n != "sgn_width")
    return Comparison(tuple(fits), tuple(f.problem.model.name for f in fits), tuple(dict(f.nrmse) for f in fits), held,
                      {n: tuple((f.values[n], f.std[n]) if n in f.values else None for f in fits) for n in names})


def comparison_table(fits: Sequence[tuple[str, Fit]], held_out: Sequence[Mapping[str, float] | None] = ()) -> Table:
    """Return fits side by side under their titles: NRMSE as fitted and `held_out`, parameters."""
    units = units_of(run for _, f in fits for run in f.problem.experiments)
    channels = {c: channel_name(c, units.get(c, "")) for _, f in fits for c in f.nrmse}
    rows: list[Sequence[Cell]] = [[f"NRMSE {name}", *(percent(f.nrmse.get(c)) for _, f in fits)]
                                  for c, name in channels.items()]
    if any(held_out):
        rows += [[f"held-out {name}", *(percent((e or {}).get(c)) for e in held_out)] for c, name in channels.items()]
    names = dict.fromkeys(n for _, f in fits for n in f.values if n != "sgn_width")
    rows += [[n, *(parameter_cell(f, n) for _, f in fits)] for n in names]
    return Table(["quantity", *(title for title, _ in fits)], rows, note=NRMSE)

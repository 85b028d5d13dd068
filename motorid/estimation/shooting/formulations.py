"""The same fit in three formulations: plain, constraints as penalties, constraints kept exactly."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from motorid.channels import channel_name
from motorid.display.cards import Card, Cell, Flag, Shown, Table, value_cell
from motorid.display.numbers import duration, number, percent
from motorid.errors import FitError, MotoridError, SimulationError, positive
from motorid.estimation.fit import solve
from motorid.estimation.least_squares import FINISH, least_squares
from motorid.estimation.result import Failure, Fit
from motorid.estimation.shooting.multiple_shooting import MultipleShooting
from motorid.estimation.shooting.outcome import Multiplier, steady_residual, violations
from motorid.numerics.parallel import one_thread
from motorid.problem.constraints import Relation, SteadyState, Weighed
from motorid.problem.problem import Problem
from motorid.problem.simulate import NRMSE
from motorid.records.experiment import units_of

WEIGHTS = tuple(10.0 ** np.arange(-2, 5))
NONE = "–"


@dataclass(frozen=True, eq=False)
class Formulation:
    """One column of the comparison."""

    name: str  # "plain", "penalty" or "hard"
    result: Fit | Failure
    violations: Mapping[str, float]  # largest of each constraint, in the unit that its name ends with
    steady_residual: float | None  # largest balance left over at the measured steady state, relative
    multipliers: tuple[Multiplier, ...]  # of the hard formulation

    @property
    def fit(self) -> Fit | None:
        """The fit, None where it failed."""
        return self.result if isinstance(self.result, Fit) else None


@dataclass(frozen=True)
class PathPoint:
    """A penalty solution on the way to the hard one."""

    weight: float
    values: Mapping[str, float]
    violations: Mapping[str, float]
    distance: float  # largest relative difference from the hard solution, of the parameters determined there


@dataclass(frozen=True, eq=False, repr=False)
class Formulations(Shown):
    """Plain, penalty and hard side by side, and the walk of the penalty solution."""

    plain: Formulation
    penalty: Formulation
    hard: Formulation
    path: tuple[PathPoint, ...]  # penalties on what lies beyond the limits, weights as in the plain fit, light to heavy

    @property
    def all(self) -> tuple[Formulation, ...]:
        """The three of them."""
        return self.plain, self.penalty, self.hard

    @property
    def table(self) -> Table:
        """Everything side by side."""
        note = " ".join([NRMSE, *(m.text for m in self.hard.multipliers if m.active),
                         *(f.result.message for f in self.all if isinstance(f.result, Failure))])
        return Table(["quantity", *(f.name for f in self.all)], self._rows(), "Formulations", note)

    def _rows(self) -> list[Sequence[Cell]]:
        fits = [f.fit for f in self.all]
        if (first := next((f for f in fits if f is not None), None)) is None:
            return []
        model, units = first.problem.model, units_of(first.problem.experiments)
        rows: list[Sequence[Cell]] = [[n, *(value_cell(f.values[n], f.std[n], model.parameters[n].unit) if f else NONE
                                            for f in fits)] for n in model.free_names]
        rows += [[f"NRMSE {channel_name(c, units.get(c, ''))}", *(percent(f.nrmse[c]) if f else NONE for f in fits)]
                 for c in first.nrmse]
        rows.append(["steady-state residual", *(percent(f.steady_residual) for f in self.all)])
        rows += [[f"beyond {name}", *(number(f.violations.get(name), 3) for f in self.all)]
                 for name in dict.fromkeys(n for f in self.all for n in f.violations)]
        rows += [[f"multiplier {m.name}, 1/{m.unit or 'unit'}", NONE, NONE, number(m.value, 3)]
                 for m in self.hard.multipliers]
        return [*rows, ["iterations", *(str(f.iterations) if f else NONE for f in fits)],
                ["time", *(duration(f.seconds) if f else NONE for f in fits)],
                ["status", *(f.result.status for f in self.all)]]

    def card(self) -> Card:
        """Return the three side by side."""
        after = [("mi.plot_formulations(three)", "see it")]
        if any(name.startswith("CurrentLimit") for f in self.all for name in f.violations):
            after.append(("mi.plot_current_limit(three)", "the current and its limit"))
        failed = [Flag(f"{f.name} failed", "bad") for f in self.all if f.fit is None]
        return Card("Plain, penalties, hard constraints", failed, (), (self.table,), after, "plot_formulations")

    def __str__(self) -> str:
        return str(self.table)


@one_thread
def compare_formulations(problem: Problem | Fit, constraints: Sequence[Relation] | None = None, *,
                         weights: Sequence[float] = WEIGHTS) -> Formulations:
    """Fit the same data three times: plain, with penalties, with true constraints.

    *Plain* leaves the constraints out. *Penalty* is the source paper's: errors over the RMS of each channel, penalties
    with their own weights. *Hard* is multiple shooting with true constraints and the weights of the plain fit. Along
    the path penalties on what lies beyond the limits grow heavier: their solution walks from the plain to the hard one.

    Parameters
    ----------
    problem : Problem or Fit
    constraints : sequence of CurrentLimit, SteadyState, Constraint, optional
        Default: those of the problem, else the steady state.
    weights : sequence of float
        Factors on the penalties' own weights along the path; none for no path.

    Returns
    -------
    Formulations
        A formulation that fails is in it as a `Failure` that says why.

    Raises
    ------
    FitError
        If not even the plain fit can be carried out.

    Examples
    --------
    >>> three = mi.compare_formulations(better, [mi.SteadyState()], weights=[1.0])
    """
    positive(**{f"weights[{k}]": w for k, w in enumerate(weights)})
    given = problem.problem if isinstance(problem, Fit) else problem
    relations = tuple(constraints if constraints is not None else given.constraints) or (SteadyState(),)
    bare = replace(given, constraints=(), noise_factors={})
    plain = solve(bare)
    penalty = _tried(lambda: solve(bare.with_(penalties=(*bare.penalties, *relations), weights="rms"),
                                   formulation="penalty"), plain)
    near = plain.problem.for_model(plain.model)
    hard = _tried(lambda: MultipleShooting(warm="model").solve(replace(near, constraints=relations)), plain)
    path = _path(near, relations, weights, hard) if isinstance(hard, Fit) else ()
    return Formulations(_column("plain", plain, relations), _column("penalty", penalty, relations),
                        _column("hard", hard, relations), path)


def _tried(attempt: Any, plain: Fit) -> Fit | Failure:
    try:
        return attempt()
    except MotoridError as error:
        return Failure(plain.values, "failed", str(error))


def _column(name: str, result: Fit | Failure, relations: Sequence[Relation]) -> Formulation:
    if isinstance(result, Failure):
        return Formulation(name, result, {}, None, ())
    problem, q = result.problem, result.q
    return Formulation(name, result, violations(problem, q, relations), steady_residual(problem, q, relations),
                       tuple(result.extra.get("multipliers", ())))


def _path(problem: Problem, relations: Sequence[Relation], weights: Sequence[float],
          hard: Fit) -> tuple[PathPoint, ...]:
    """Follow the penalty solution back from the hard one as the penalties grow lighter: the same valley."""
    found, q = [], hard.q
    free = [n for n in problem.model.free_names if hard.std[n] is not None and hard.values[n] != 0]
    for weight in sorted(weights, reverse=True):
        step = replace(problem, _runs=hard.problem.runs,
                       penalties=(*problem.penalties, *(Weighed(c, float(weight)) for c in relations)))
        try:
            q = least_squares(step, replace(FINISH, ftol=1e-12), q=q, refine=False).q
        except (FitError, SimulationError):
            break
        values = step.values(q)
        distance = max((abs(values[n] / hard.values[n] - 1) for n in free), default=np.nan)
        found.append(PathPoint(float(weight), values, violations(step, q, relations), float(distance)))
    return tuple(reversed(found))

"""Fits from many random starts, the study of the source paper: do they all lead to the same place?"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from motorid.display.cards import Card, Flag, Printed, Table
from motorid.display.numbers import duration, number, percent, quantity, sentence
from motorid.errors import MotoridError, UsageError, at_least, positive
from motorid.estimation.fit import check_solver, minimise, solve
from motorid.estimation.least_squares import FINISH, Estimate, cost_at
from motorid.estimation.result import Failure, Fit
from motorid.estimation.start_values import with_start_values
from motorid.numerics.parallel import Map, map_items, one_thread
from motorid.problem.problem import Problem
from motorid.problem.simulate import at, judge

COST_SHARE = 1e-3  # a good fit's cost is at most this much above the best
# A good fit's parameters are within this many standard deviations of the best: the integration, accurate to a
# part of the noise, already moves them by some tenths.
DISTANCE = 0.5
PLACES, FARTHEST = 2, 3  # places told of those where other fits ended, and parameters of each


@one_thread
def multistart(problem_or_fit: Problem | Fit, *, starts: int = 100, spread: float = 10.0, seed: int = 0,
               guess: bool = False, solver: Any = None, map: Map | None = None, quiet: bool = False) -> "Multistart":
    """Fit from many random starts and count how many reach the best fit.

    Parameters
    ----------
    problem_or_fit : Problem or Fit
        The reference; a problem is solved first. UsageError for anything else.
    starts : int
    spread : float
        Starts are log-uniform within this factor, at least 1, on either side of the reference, in every free parameter;
        one that may be negative is moved by the same factors, its sign kept; a phase is drawn from the whole circle.
    seed : int
        The starts depend on it alone, not on the pool.
    guess : bool
        Let the automatic first guess compete with the start, as in `fit`. By default it does not.
    solver : optional
        As in `fit`; default `LevenbergMarquardt`.
    map : callable, optional
        Anything with the signature of `map`; see `motorid.numerics.parallel`.
    quiet : bool
        No progress bar.

    Examples
    --------
    >>> many = mi.multistart(fit, starts=2, quiet=True)
    >>> axes = mi.plot_waterfall(many)
    """
    check_solver(solver)
    at_least(0, seed=seed)
    at_least(1, starts=starts, spread=spread)
    positive(spread=spread)
    began = time.perf_counter()
    reference = problem_or_fit if isinstance(problem_or_fit, Fit) else solve(problem_or_fit, solver)
    if not (names := reference.problem.model.free_names):
        raise UsageError("the model has no free parameter to start from; free some with model.free(…).")
    drawn = _draw(reference, names, starts, spread, seed)
    task = (reference.problem, dict(reference.values), solver, guess)
    done = map_items(_from_start, task, drawn, map, "Fitting from random starts", quiet=quiet)
    said = f"{done.interrupted} starts" if done.interrupted else ""
    return Multistart(reference, tuple(done.results), float(spread), guess, time.perf_counter() - began, said)


def _draw(reference: Fit, names: Sequence[str], starts: int, spread: float, seed: int) -> list[dict[str, float]]:
    factors = spread ** np.random.default_rng(seed).uniform(-1, 1, (starts, len(names)))
    pars = reference.problem.model.parameters
    scale = reference.problem.scaling.scale
    sizes = np.array([reference.values[n] or 1e-3 * s for n, s in zip(names, scale, strict=False)])
    phases = sizes + np.pi * np.log(factors) / max(np.log(spread), 1e-300)  # anywhere on the circle
    drawn = np.where([pars[n].periodic and spread > 1 for n in names], phases, factors * sizes)
    drawn = np.clip(drawn, [pars[n].lower for n in names], [pars[n].upper for n in names])
    return [dict(zip(names, row, strict=True)) for row in drawn.tolist()]


def _from_start(task: tuple[Problem, dict[str, float], Any, bool], start: dict[str, float]) -> "StartResult | Failure":
    (problem, values, solver, guess), began = task, time.perf_counter()
    here = problem.for_model(problem.model.start_at(values | start))
    try:
        here = replace(with_start_values(here), _runs=here.runs) if guess else here
        end: Fit | Estimate = solver.solve(here) if hasattr(solver, "solve") else minimise(here, solver or FINISH)
    except (MotoridError, np.linalg.LinAlgError) as error:
        return Failure(start, "failed", str(error))
    said = end if isinstance(end, Fit) else end.solution
    # With the weights and steps of the reference, so that the results of all starts can be compared.
    cost = cost_at(problem, problem.scaling.scaled(end.problem.scaling.physical(end.q)), refine=False)
    return StartResult(start, end.values, cost, judge(at(end.problem, end.q)).nrmse, said.status, said.message,
                       len(end.history) - 1, time.perf_counter() - began)


@dataclass(frozen=True, eq=False)
class StartResult:
    """Where one start led: values and errors there, cost ½ rᵀr judged like the reference, solver's status."""

    start: Mapping[str, float]
    values: Mapping[str, float]
    cost: float
    nrmse: Mapping[str, float]
    status: str
    message: str
    iterations: int
    seconds: float


@dataclass(frozen=True, eq=False, repr=False)
class Multistart(Printed):
    """Many fits of one problem from random starts."""

    reference: Fit  # around which the starts were drawn
    results: tuple[StartResult | Failure, ...]  # in the order of drawing
    spread: float  # every start is off by up to this factor in each free parameter
    guess: bool  # whether the automatic first guess was allowed to take the start's place
    seconds: float
    interrupted: str = ""  # or how far it came

    @cached_property
    def best(self) -> StartResult | None:
        """The result with the lowest cost, if it is lower than the reference's by more than the tolerance."""
        best = min((e for e in self.results if isinstance(e, StartResult)), key=lambda e: e.cost, default=None)
        return best if best is not None and best.cost < self.reference.cost * (1 - COST_SHARE) else None

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Per start: ``"good"`` (the cost is at most 0.1 % above the best, every parameter that the data determine
        within half its standard deviation of the best), ``"poor"``, or ``"failed"`` (without a finite cost)."""
        return tuple(self._kind(e) for e in self.results)

    def _kind(self, end: StartResult | Failure) -> str:
        if isinstance(end, Failure) or not np.isfinite(end.cost):
            return "failed"
        best = self._lowest
        far = any(abs(self.difference(n, end.values[n], best.values[n])) > DISTANCE * sd
                  for n, sd in self.reference.std.items() if sd)
        return "poor" if end.cost > best.cost * (1 + COST_SHARE) or far else "good"

    def difference(self, name: str, a: float, b: float) -> float:
        """Difference of two values; phases are compared on the circle."""
        periodic = self.reference.problem.model.parameters[name].periodic
        return (a - b + np.pi) % (2 * np.pi) - np.pi if periodic else a - b

    def _ends(self, kind: str) -> list[StartResult]:
        return [e for e, k in zip(self.results, self.kinds, strict=True) if k == kind and isinstance(e, StartResult)]

    good = property(lambda self: self.kinds.count("good"), doc="Number of good fits.")
    poor = property(lambda self: self.kinds.count("poor"), doc="Number of fits that ended elsewhere.")
    failed = property(lambda self: self.kinds.count("failed"), doc="Number of starts without a result.")

    @cached_property
    def table(self) -> Any:
        """One row per start (`pandas.DataFrame`): start, end, NRMSE per channel, cost, kind, message."""
        import pandas as pd

        rows = []
        for end, kind in zip(self.results, self.kinds, strict=True):
            row: dict[str, Any] = {"kind": kind, "status": end.status, "message": end.message}
            row |= {f"start_{n}": v for n, v in end.start.items()}
            if isinstance(end, StartResult):
                row |= {n: end.values[n] for n in end.start} | {f"nrmse_{c}": e for c, e in end.nrmse.items()}
                row |= {"cost": end.cost, "iterations": end.iterations, "seconds": end.seconds}
            rows.append(row)
        return pd.DataFrame(rows)

    @property
    def _lowest(self) -> StartResult | Fit:
        return self.best or self.reference

    @property
    def elsewhere(self) -> str:
        """Where most others ended: ``2 at b = 1.3·10⁻³ N·m·s/rad (3.1 times the squared error)``; else empty."""
        best, pars = self._lowest.values, self.reference.model.parameters
        places: list[list[StartResult]] = []  # each with its ends, the lowest cost first
        for e in sorted(self._ends("poor"), key=lambda e: e.cost):
            home = next((p for p in places if self._same_place(p[0], e)), None)
            places.append([e]) if home is None else home.append(e)
        places.sort(key=len, reverse=True)
        told = []
        for place in places[:PLACES]:
            end = place[0].values
            off = {n: abs(self.difference(n, end[n], best[n])) / max(abs(end[n]), abs(best[n]), 1e-300)
                   for n in self.reference.problem.model.free_names}
            most = [n for n in sorted(off, key=lambda n: -off[n])[:FARTHEST] if off[n] > 0.1 * max(off.values())]
            where = ", ".join(f"{n} = {quantity(end[n], pars[n].unit, 3)}" for n in most)
            ratio = place[0].cost / self._lowest.cost
            more = f"{number(ratio, 3)} times the" if ratio > 1.1 else f"{percent(ratio - 1, 1)} more"
            told.append(f"{len(place)} at {where} ({more} squared error)")
        more = sum(map(len, places[PLACES:]))
        return "; ".join([*told, *([f"{more} at other places"] if more else [])])

    def _same_place(self, a: StartResult, b: StartResult) -> bool:
        """Tell whether two fits ended in the same place: cost within 1 %, values within 5 %."""
        if abs(a.cost - b.cost) > 10 * COST_SHARE * a.cost:
            return False
        pairs = ((n, a.values[n], b.values[n]) for n in a.start)
        return all(abs(self.difference(n, x, y)) < 0.05 * max(abs(x), abs(y), 1e-300) for n, x, y in pairs)

    def statistics(self) -> dict[str, dict[str, float | None]]:
        """Return per free parameter the reference and mean and standard deviation over the good fits."""
        found, good = {}, self._ends("good")
        for n in self.reference.problem.model.free_names:
            middle = self.reference.values[n]
            v = np.array([middle + self.difference(n, e.values[n], middle) for e in good])
            mean, std = (float(v.mean()), float(v.std())) if good else (None, None)
            found[n] = {"reference": middle, "mean": mean, "std": std}
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``robustness --json``."""
        good = self._ends("good")
        nrmse = {c: float(np.mean([e.nrmse[c] for e in good])) if good else None for c in self.reference.nrmse}
        return {"starts": len(self.results), "spread": self.spread, "guess": self.guess, "good": self.good,
                "poor": self.poor, "failed": self.failed, "seconds": self.seconds, "parameters": self.statistics(),
                "nrmse": nrmse, "thresholds": {"cost_share": COST_SHARE, "standard_deviations": DISTANCE},
                "interrupted": self.interrupted or None}

    @property
    def text(self) -> str:
        """The verdict in words."""
        said = [f"{self.good} of {len(self.results)} starts, up to {self.spread:g} times off, reach the best fit "
                f"(cost within {percent(COST_SHARE)}, parameters within {DISTANCE:g} standard deviations); "
                f"{self.poor} end elsewhere, {self.failed} failed; {duration(self.seconds)}."]
        if self.best is not None:
            lower = percent(1 - self.best.cost / self.reference.cost)
            said.append(f"One start found a better fit than the one given: its cost is {lower} lower.")
        if self.poor:
            said.append(f"Elsewhere: {self.elsewhere}.")
        return " ".join([*said, sentence(self.interrupted)]).strip()

    def card(self) -> Card:
        """Return how many starts ended where, and the spread of the good fits."""
        flags = [Flag(f"{self.good} good", "good"), *([Flag(f"{self.poor} poor", "note")] if self.poor else [])]
        flags += [Flag(f"{self.failed} failed", "bad")] if self.failed else []
        units = {n: p.unit for n, p in self.reference.model.parameters.items()}
        rows = [[n, *(quantity(s[k], units[n], 5) for k in ("reference", "mean")), quantity(s["std"], units[n], 2)]
                for n, s in self.statistics().items()]
        return Card("Fits from random starts", flags, (self.text,),
                    (Table(["parameter", "reference", "mean of the good fits", "spread"], rows),),
                    (("mi.plot_waterfall(study)", "see it"),), "plot_waterfall")

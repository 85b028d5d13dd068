"""Profile likelihood: how much worse does the best fit become when one parameter is fixed elsewhere?

The only interval that can say "no upper end": where the cost stays low however far the parameter moves, the data do not
limit it on that side (Raue et al., Bioinformatics 25, 2009). The rise of the cost is divided by the factor by which
coloured residuals enlarge the parameter's variance (Kent, Biometrika 69, 1982). `intervals`: beside other methods."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from motorid.display.cards import Card, Flag, Printed, Table
from motorid.display.numbers import interval_text, percent, quantity
from motorid.errors import MotoridError, chosen
from motorid.estimation.least_squares import least_squares
from motorid.estimation.result import Fit
from motorid.numerics.least_squares import LevenbergMarquardt, seen_directions
from motorid.numerics.parallel import Map, map_items, one_thread
from motorid.numerics.signals import Array
from motorid.problem.problem import Problem
from motorid.uncertainty.bootstrap import Bootstrap, bootstrap
from motorid.uncertainty.covariance import Covariance, check_level, covariance

FARTHEST = np.log(1e4)  # on the logarithmic scale; beyond it a parameter counts as not limited
MOST = 30  # points per side
Point = tuple[float, float, dict[str, float]]  # fixed value, rise, all values
SOLVER = LevenbergMarquardt(max_iterations=60, ftol=1e-8, xtol=1e-8)


@dataclass(frozen=True, eq=False, repr=False)
class Profile(Printed):
    """The profile of one parameter."""

    name: str
    unit: str
    value: float  # the fit's
    values: Array  # (m,), where it was fixed, increasing
    rise: Array  # (m,), of twice the cost over that of the fit, in units of the variance; compared with t²
    others: dict[str, Array]  # (m,) each, how the other parameters followed
    dof: float  # effective degrees of freedom
    positive: bool

    @property
    def best(self) -> float:
        """Lowest `rise`; clearly below zero means that the fit was not at the optimum."""
        return float(self.rise.min())

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return where the profile crosses the level; an open end is infinite (0 below for positive ones)."""
        check_level(level)
        reach = float(scipy.special.stdtrit(self.dof, 0.5 + level / 2))
        start = int(np.argmin(np.abs(self.values - self.value)))
        x = np.log(self.values) if self.positive else self.values
        low = _crossing(x[start::-1], self.rise[start::-1], reach, -np.inf)
        high = _crossing(x[start:], self.rise[start:], reach, np.inf)
        return (float(np.exp(low)), float(np.exp(high))) if self.positive else (low, high)

    def to_dict(self, level: float = 0.95) -> dict[str, Any]:
        """Return plain data; an open end is null."""
        low, high = self.interval(level)
        return {"name": self.name, "value": self.value, "level": level, "values": self.values.tolist(),
                "rise": self.rise.tolist(), "interval": [low if np.isfinite(low) and low != 0 else None,
                                                         high if np.isfinite(high) else None]}

    @property
    def text(self) -> str:
        """Value and interval in words."""
        low, high = self.interval()
        open_ends = (low == 0 if self.positive else not np.isfinite(low)), not np.isfinite(high)
        said = {(True, True): "not limited on either side",
                (True, False): f"below {quantity(high, self.unit)} (95 %), no lower limit",
                (False, True): f"above {quantity(low, self.unit)} (95 %), no upper limit",
                (False, False): f"{interval_text((low, high))} {self.unit} (95 %)"}[open_ends]
        return f"{self.name} = {quantity(self.value, self.unit, 5)}: {said}."

    def card(self) -> Card:
        """Return the interval in words, and whether the fit was at the optimum."""
        flags = [Flag("the profile found a better fit than the one given", "bad")] if self.best < -1.0 else []
        after = (("mi.plot_profile(profile)", "see it"),)
        return Card(f"Profile of {self.name}", flags, (self.text,), (), after, "plot_profile")


def _crossing(x: Array, rise: Array, reach: float, never: float) -> float:
    """Where sqrt(rise), interpolated, first exceeds `reach` going outward; `never` if it does not."""
    root = np.sqrt(np.maximum(rise, 0.0))
    above = np.flatnonzero(root > reach)
    if not above.size:
        return never
    near = slice(max(above[0] - 1, 0), above[0] + 1)
    return float(np.interp(reach, root[near], x[near]))


@one_thread
def profile(fit: Fit, name: str, *, level: float = 0.95, map: Map | None = None, quiet: bool = False) -> Profile:
    """Return the profile likelihood of one parameter, far enough out for intervals at `level`.

    Parameters
    ----------
    fit : Fit
    name : str
        A free parameter; UsageError for any other.
    level : float
    map, quiet
        As in `multistart`; the two sides are two tasks.

    Examples
    --------
    >>> flat = mi.profile(better, "b", quiet=True)
    """
    return profiles(fit, [name], level=level, map=map, quiet=quiet)[name]


@one_thread
def profiles(fit: Fit, names: Sequence[str] | None = None, *, level: float = 0.95, map: Map | None = None,
             quiet: bool = False) -> dict[str, Profile]:
    """Return the profiles of several parameters, by default of all free ones; see `profile`.

    Examples
    --------
    >>> each = mi.profiles(better, ["R", "b"], quiet=True)
    >>> axes = mi.plot_profile(each)
    """
    names = chosen(names, fit.problem.model.free_names, "free parameter")
    check_level(level)
    plans = {n: _plan(fit, n, level) for n in names}
    tasks = [(n, side, *plans[n][:3]) for n in names for side in (-1.0, 1.0)]
    done = map_items(_side, (fit.problem, dict(fit.values), fit.cost), tasks, map, "Profiling", quiet=quiet)
    sides = done.results + [[]] * (len(tasks) - len(done.results))
    return {n: _joined(fit, n, sides[2 * k], sides[2 * k + 1], plans[n][3]) for k, n in enumerate(names)}


def _plan(fit: Fit, name: str, level: float) -> tuple[float, float, float, float]:
    """Return first step in q, variance factor, height to reach, degrees of freedom."""
    found = covariance(fit)
    j = found.names.index(name)
    slope = fit.problem.scaling.slope(fit.q)[j]
    half, *_ = seen_directions(fit.jacobian)
    step, factor = 0.25, float(np.median([c.variance for c in found.colours.values()]))
    if sd := found.std[name]:
        step, factor = float(np.clip(0.7 * sd / abs(slope), 1e-6, 0.5)), float(sd**2 / (half[j] @ half[j]))
    return step, factor, 1.3 * float(scipy.special.stdtrit(found.dof, 0.5 + level / 2)) ** 2, found.dof


def _side(reference: tuple[Problem, dict[str, float], float],
          task: tuple[str, float, float, float, float]) -> list[Point]:
    """Walk outward from the fit until the cost has risen enough, the limit is reached, or nothing changes."""
    (problem, values, cost), (name, side, step, factor, height) = reference, task
    j = [p.name for p in problem.unknown].index(name)
    parameter, scale = problem.model.parameters[name], problem.scaling
    q0 = float(scale.scaled([values.get(p.name, p.value) for p in problem.unknown])[j])
    low, high = scale.bounds[0][j], scale.bounds[1][j]
    farthest = FARTHEST if parameter.positive else max(1e3 * step, 10 * abs(q0))
    points: list[Point] = []
    at, before = q0, 0.0
    while len(points) < MOST and abs(at - q0) < farthest:
        at = float(np.clip(at + side * step, low, high))
        p = float(scale.scale[j] * np.exp(at) if scale.log[j] else scale.scale[j] * at)
        here = problem.for_model(problem.model.start_at(values).fix(**{name: p})).tuned(first_stands=True)
        try:
            found = least_squares(here, SOLVER)
        except (MotoridError, np.linalg.LinAlgError):
            break
        rise, values = 2 * (found.cost - cost) / factor, found.values
        points.append((p, rise, values))
        if rise > height or at in (low, high):
            break
        # Twice as far where little happens, so that an open end is seen soon.
        step *= 2.0 if np.sqrt(max(rise, 0.0)) - np.sqrt(max(before, 0.0)) < 0.35 else 1.0
        before = rise
    return points


def _joined(fit: Fit, name: str, left: list[Point], right: list[Point], dof: float) -> Profile:
    points = [*reversed(left), (fit.values[name], 0.0, dict(fit.values)), *right]
    p = fit.problem.model.parameters[name]
    others = {n: np.array([v[n] for _, _, v in points]) for n in fit.problem.model.free_names if n != name}
    return Profile(name, p.unit, fit.values[name], np.array([v for v, _, _ in points]),
                   np.array([r for _, r, _ in points]), others, dof, p.positive)


@dataclass(frozen=True, eq=False, repr=False)
class Intervals(Printed):
    """Three answers to one question. Where they agree, any will do; where not, believe the profile."""

    covariance: Covariance
    bootstrap: Bootstrap
    profiles: Mapping[str, Profile]
    level: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain data: per parameter value, status and the three intervals."""
        return {"level": self.level, "parameters": {
            n: {"value": p.value, "unit": p.unit, "status": self.covariance.status[n], **{
                k: getattr(self, k).interval(n, self.level) for k in ("covariance", "bootstrap")},
                "profile": p.to_dict(self.level)["interval"]} for n, p in self.profiles.items()}}

    def card(self) -> Card:
        """Return the three intervals of each parameter side by side."""
        rows = []
        for n, p in self.profiles.items():
            known = self.covariance.interval(n, self.level)
            first = interval_text(known) if known else Flag(self.covariance.status[n], "note")
            others = (self.bootstrap.interval(n, self.level), p.interval(self.level))
            rows.append([n, quantity(p.value, p.unit), first, *(interval_text(x) for x in others)])
        header = ["parameter", "value", "covariance", f"bootstrap ({self.bootstrap.kind})", "profile"]
        return Card(f"Intervals of {percent(self.level)}",
                    text=("Where the three agree, any will do; where they do not, believe the profile.",),
                    tables=(Table(header, rows, left=(0, 1, 2, 3, 4)),),
                    after=(("mi.plot_profile(intervals)", "see them"),), figure="plot_profile")


@one_thread
def intervals(fit: Fit, *, level: float = 0.95, kind: str = "blocks", n: int = 200, seed: int = 0,
              map: Map | None = None, quiet: bool = False) -> Intervals:
    """Return the intervals of the free parameters from covariance, bootstrap and profile, in one table.

    Parameters
    ----------
    fit : Fit
    level : float
    kind, n, seed, map, quiet
        As in `bootstrap`.

    Examples
    --------
    >>> three = mi.intervals(fit, n=10, quiet=True)
    """
    refits = bootstrap(fit, kind=kind, n=n, seed=seed, map=map, quiet=quiet)
    check_level(level)
    return Intervals(covariance(fit), refits, profiles(fit, level=level, map=map, quiet=quiet), level)

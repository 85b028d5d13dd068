"""What became of many fits from random starts: good, poor, failed, and the places where they ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from motorid.display.display import Shown
from motorid.display.numbers import duration, number, percent
from motorid.display.tables import Table
from motorid.estimation.fit import Failure, Fit

COST_SHARE = 1e-3  # a good fit's cost is at most this much above the best
# A good fit's parameters are within this many standard deviations of the best: the integration, accurate to a
# part of the noise, already moves them by some tenths.
DISTANCE = 0.5


@dataclass(frozen=True, eq=False)
class Ending:
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
class Multistart(Shown):
    """Many fits of one problem from random starts.

    Attributes
    ----------
    reference : Fit
        The fit around which the starts were drawn.
    endings : tuple of Ending or Failure
        In the order of drawing.
    spread : float
        Every start is off by up to this factor in each free parameter.
    guess : bool
        Whether the automatic first guess was allowed to take the start's place.
    seconds : float
    interrupted : str
        Empty, or how far it came.
    """

    reference: Fit
    endings: tuple[Ending | Failure, ...]
    spread: float
    guess: bool
    seconds: float
    interrupted: str = ""

    @cached_property
    def best(self) -> Ending | None:
        """The ending with the lowest cost, if it is lower than the reference's by more than the tolerance."""
        ends = [e for e in self.endings if isinstance(e, Ending)]
        best = min(ends, key=lambda e: e.cost, default=None)
        return best if best is not None and best.cost < self.reference.cost * (1 - COST_SHARE) else None

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Per start: ``"good"``, ``"poor"`` or ``"failed"``.

        Good: the cost is at most 0.1 % above the best, and every parameter that the data determine is
        within half its standard deviation of the best. Failed: no result, or a solver that gave up.
        """
        return tuple(self._kind(e) for e in self.endings)

    def _kind(self, end: Ending | Failure) -> str:
        if isinstance(end, Failure) or not np.isfinite(end.cost):
            return "failed"
        best = self.best or self.reference
        far = any(abs(self._apart(n, end.values[n], best.values[n])) > DISTANCE * sd
                  for n, sd in self._determined.items())
        return "poor" if end.cost > best.cost * (1 + COST_SHARE) or far else "good"

    def _apart(self, name: str, a: float, b: float) -> float:
        """Difference of two values; phases are compared on the circle."""
        periodic = self.reference.problem.model.parameters[name].periodic
        return (a - b + np.pi) % (2 * np.pi) - np.pi if periodic else a - b

    @property
    def _determined(self) -> dict[str, float]:
        return {n: sd for n, sd in self.reference.std.items() if sd}

    @property
    def _good(self) -> list[Ending]:
        return [e for e, k in zip(self.endings, self.kinds, strict=True)
                if k == "good" and isinstance(e, Ending)]

    @property
    def good(self) -> int:
        """Number of good fits."""
        return self.kinds.count("good")

    @property
    def poor(self) -> int:
        """Number of fits that ended elsewhere."""
        return self.kinds.count("poor")

    @property
    def failed(self) -> int:
        """Number of starts without a result."""
        return self.kinds.count("failed")

    @cached_property
    def table(self) -> Any:
        """One row per start (`pandas.DataFrame`): start, end, NRMSE per channel, cost, kind, message."""
        import pandas as pd

        rows = []
        for end, kind in zip(self.endings, self.kinds, strict=True):
            row: dict[str, Any] = {"kind": kind, "status": end.status, "message": end.message}
            row |= {f"start_{n}": v for n, v in end.start.items()}
            if isinstance(end, Ending):
                row |= {n: end.values[n] for n in end.start} | {f"nrmse_{c}": e for c, e in end.nrmse.items()}
                row |= {"cost": end.cost, "iterations": end.iterations, "seconds": end.seconds}
            rows.append(row)
        return pd.DataFrame(rows)

    @cached_property
    def basins(self) -> Any:
        """One row per place where fits ended (`pandas.DataFrame`), best first: fits, cost ratio, values."""
        import pandas as pd

        ends = sorted((e for e in self.endings if isinstance(e, Ending) and np.isfinite(e.cost)),
                      key=lambda e: e.cost)
        places: list[list[Ending]] = []
        for end in ends:
            home = next((p for p in places if self._together(p[0], end)), None)
            places.append([end]) if home is None else home.append(end)
        lowest = min([self.reference.cost, *(e.cost for e in ends)])
        return pd.DataFrame([{"fits": len(p), "cost_ratio": p[0].cost / lowest, **dict(p[0].nrmse),
                              **{n: p[0].values[n] for n in p[0].start}} for p in places])

    def _together(self, a: Ending, b: Ending) -> bool:
        """Tell whether two fits ended in the same place: cost within 1 %, values within 5 %."""
        if abs(a.cost - b.cost) > 10 * COST_SHARE * a.cost:
            return False
        sizes = [max(abs(a.values[n]), abs(b.values[n]), 1e-300) for n in a.start]
        return all(abs(self._apart(n, a.values[n], b.values[n])) < 0.05 * s
                   for n, s in zip(a.start, sizes, strict=True))

    def statistics(self) -> dict[str, dict[str, float | None]]:
        """Return per free parameter the reference and mean and standard deviation over the good fits."""
        found = {}
        for n in self.reference.problem.model.free_names:
            middle = self.reference.values[n]
            v = np.array([middle + self._apart(n, e.values[n], middle) for e in self._good])
            found[n] = {"reference": self.reference.values[n], "mean": float(v.mean()) if v.size else None,
                        "std": float(v.std()) if v.size else None}
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``robustness --json``."""
        return {
            "starts": len(self.endings), "spread": self.spread, "guess": self.guess,
            "good": self.good, "poor": self.poor, "failed": self.failed, "seconds": self.seconds,
            "parameters": self.statistics(),
            "nrmse": {c: float(np.mean([e.nrmse[c] for e in self._good])) if self._good else None
                      for c in self.reference.nrmse},
            "thresholds": {"cost_share": COST_SHARE, "standard_deviations": DISTANCE},
            "interrupted": self.interrupted or None,
        }

    def __str__(self) -> str:
        rows = [(n, number(s["reference"]), number(s["mean"]), number(s["std"], 2))
                for n, s in self.statistics().items()]
        said = [f"{self.good} of {len(self.endings)} starts within a factor of {self.spread:g} end in the "
                f"best fit (cost within {percent(COST_SHARE)}, parameters within {DISTANCE:g} standard "
                f"deviations); {self.poor} elsewhere, {self.failed} failed; {duration(self.seconds)}."]
        if self.best is not None:
            lower = percent(1 - self.best.cost / self.reference.cost)
            said.append(f"One start found a better place than the fit: its cost is {lower} lower.")
        if self.poor and len(self.basins) > 1:
            said.append(f"The fits end in {len(self.basins)} places; the cost of the second is "
                        f"{self.basins['cost_ratio'].iloc[1]:.4g} times the best.")
        if self.interrupted:
            said.append(f"{self.interrupted[0].upper()}{self.interrupted[1:]}.")
        table = Table("Good fits", ("", "reference", "mean", "std"), tuple(rows))
        return "\n".join([" ".join(said), "", str(table)])

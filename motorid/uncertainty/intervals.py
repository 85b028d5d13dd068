"""Covariance, bootstrap and profile likelihood side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from motorid.display.display import Shown
from motorid.display.numbers import number
from motorid.display.tables import Table
from motorid.estimation.fit import Fit
from motorid.numerics.parallel import Map
from motorid.uncertainty.bootstrap import Bootstrap, bootstrap
from motorid.uncertainty.covariance import Covariance, covariance, interval_text
from motorid.uncertainty.profile import Profile, profiles


@dataclass(frozen=True, eq=False, repr=False)
class Intervals(Shown):
    """Three answers to one question. Where they agree, any will do; where not, believe the profile.

    Attributes
    ----------
    covariance : Covariance
    bootstrap : Bootstrap
    profiles : mapping of str to Profile
    level : float
    """

    covariance: Covariance
    bootstrap: Bootstrap
    profiles: Mapping[str, Profile]
    level: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain data: per parameter value, status and the three intervals."""
        return {"level": self.level, "parameters": {
            n: {"value": p.value, "unit": p.unit, "status": self.covariance.status[n],
                "covariance": self.covariance.interval(n, self.level),
                "bootstrap": self.bootstrap.interval(n, self.level),
                "profile": p.to_dict(self.level)["interval"]} for n, p in self.profiles.items()}}

    def __str__(self) -> str:
        rows = []
        for n, p in self.profiles.items():
            known = self.covariance.interval(n, self.level)
            rows.append((n, f"{number(p.value)} {p.unit}",
                         interval_text(known) if known else self.covariance.status[n],
                         interval_text(self.bootstrap.interval(n, self.level)),
                         interval_text(p.interval(self.level))))
        heads = ("", "value", "covariance", f"bootstrap ({self.bootstrap.kind})", "profile")
        return str(Table(f"Intervals of {self.level:.0%}", heads, tuple(rows), left=(0, 1, 2, 3, 4)))


def intervals(fit: Fit, *, level: float = 0.95, kind: str = "blocks", n: int = 200, seed: int = 0,
              map: Map | None = None, quiet: bool = False) -> Intervals:
    """Return the intervals of the free parameters from covariance, bootstrap and profile, in one table.

    Parameters
    ----------
    fit : Fit
    level : float
    kind, n, seed
        As in `bootstrap`.
    map : callable, optional
        Anything with the signature of `map`.
    quiet : bool
        No progress bars.
    """
    refits = bootstrap(fit, kind=kind, n=n, seed=seed, map=map, quiet=quiet)
    return Intervals(covariance(fit), refits, profiles(fit, level=level, map=map, quiet=quiet), level)

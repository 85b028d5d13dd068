"""Which members of a batch differ from the others by more than scatter and their own uncertainty explain?

Median and median absolute deviation are not moved by the outliers that are looked for (Iglewicz & Hoaglin,
How to Detect and Handle Outliers, 1993). The uncertainty of each value is taken out of the scatter and put
back per motor; the level is divided by the number of comparisons (Bonferroni), so a batch of equal motors
seldom raises an alarm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motorid.integrate.engine import Array

FEWEST = 5  # motors that make a batch
LEVEL = 0.01  # chance of any false alarm in the whole batch


@dataclass(frozen=True)
class Outlier:
    """One parameter of one motor that stands out: value, the batch's median, z, and a sentence."""

    motor: str
    parameter: str
    value: float
    median: float
    z: float
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {"motor": self.motor, "parameter": self.parameter, "value": self.value, "median": self.median,
                "z": self.z}


def outliers(rows: Sequence[Mapping[str, Any]], names: Sequence[str], positive: frozenset[str],
             level: float = LEVEL) -> tuple[Outlier, ...]:
    """Return the outliers of a batch, the most extreme first.

    Parameters
    ----------
    rows : sequence of mapping
        With ``motor`` and per parameter its value and ``<name>_std``.
    names : sequence of str
    positive : set of str
        Parameters compared on the logarithmic scale.
    level : float
        Chance of a false alarm anywhere in a batch of equal scatter.
    """
    found = []
    for n in names:
        known = [r for r in rows if r.get(f"{n}_std") is not None]
        if len(known) < FEWEST:
            continue
        value = np.array([r[n] for r in known], float)
        std = np.array([r[f"{n}_std"] for r in known], float)
        x, sd = (np.log(value), std / value) if n in positive else (value, std)
        z = scores(x, sd)
        limit = float(stdtrit(max(len(known) - 2, 1), 1 - level / (2 * len(known) * len(names))))
        for j in np.flatnonzero(np.abs(z) > limit):
            middle = float(np.median(value))
            side = "above" if z[j] > 0 else "below"
            share = f"{abs(value[j] / middle - 1):.1%} {side}" if middle else side
            found.append(Outlier(known[j]["motor"], n, float(value[j]), middle, float(z[j]),
                                 f"{known[j]['motor']}: {n} = {value[j]:.4g} is {share} the batch's median "
                                 f"{middle:.4g} (z = {z[j]:.1f})."))
    return tuple(sorted(found, key=lambda o: -abs(o.z)))


def scores(x: Array, std: Array) -> Array:
    """Return robust z of values (n,): distance from the median over scatter and own uncertainty together."""
    middle = np.median(x)
    scatter = 1.4826 * np.median(np.abs(x - middle))
    own = np.median(std)
    between = np.sqrt(max(scatter**2 - own**2, 0.0))
    return (x - middle) / np.maximum(np.hypot(between, std), 1e-12 * max(abs(middle), 1e-300))



"""How certain are the values? Covariance, correlations and intervals, for coloured residuals too."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from motorid.channels import channel_name
from motorid.display.cards import Card, Cell, Flag, Printed, Table, value_cell
from motorid.display.numbers import interval_text, percent
from motorid.errors import UsageError, among
from motorid.estimation.result import Fit, checked
from motorid.numerics.autoregression import Colour
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array

WIDE = 0.8  # of the value: an interval that reaches farther down is made on the logarithmic scale


def check_level(level: float) -> None:
    """Raise `UsageError` unless `level` is one of confidence."""
    if not 0 < level < 1:
        raise UsageError(f"a confidence level lies between 0 and 1; got {level!r}.")


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(Printed):
    """What the data say about the unknowns of a fit, free parameters, then initial states."""

    names: tuple[str, ...]
    values: Array  # (k,)
    matrix: Array  # (k, k), in physical units; NaN in the rows of what is not determined
    status: Mapping[str, str]  # "determined", "not determined", "at its lower limit" or "at its upper limit"
    positive: tuple[bool, ...]  # which cannot be zero or negative
    method: str
    dof: float  # effective degrees of freedom of the residuals
    colours: Mapping[str, Colour]  # per channel, of the whitened residuals
    units: tuple[str, ...]

    @cached_property
    def std(self) -> dict[str, float | None]:
        """One standard deviation per unknown, in its unit; None where it is not determined or at a limit."""
        return {n: float(np.sqrt(v)) if self.status[n] == "determined" else None
                for n, v in zip(self.names, np.diag(self.matrix), strict=True)}

    @cached_property
    def correlation(self) -> Array:
        """Correlations, shape (k, k); NaN where not determined."""
        sd = np.sqrt(np.diag(self.matrix))
        return self.matrix / np.outer(sd, sd)

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float] | None:
        """Return the two-sided confidence interval of one unknown; None where the data do not determine it.

        Student's t on the effective degrees of freedom; on the logarithmic scale where a positive one comes near zero.
        """
        among(name, self.names, "parameter")
        check_level(level)
        sd, j = self.std[name], self.names.index(name)
        if sd is None:
            return None
        reach = float(scipy.special.stdtrit(self.dof, 0.5 + level / 2)) * sd
        value = float(self.values[j])
        if self.positive[j] and reach > WIDE * value:
            return value * float(np.exp(-reach / value)), value * float(np.exp(reach / value))
        return value - reach, value + reach

    def to_dict(self, level: float = 0.95) -> dict[str, Any]:
        """Return plain data: std, intervals, status, correlations."""
        correlation = [[float(c) if np.isfinite(c) else None for c in row] for row in self.correlation]
        return {"method": self.method, "dof": self.dof, "names": list(self.names), "std": dict(self.std),
                "status": dict(self.status), "level": level,
                "intervals": {n: self.interval(n, level) for n in self.names}, "correlation": correlation,
                "effective_share": {c: k.effective_share for c, k in self.colours.items()}}

    def card(self) -> Card:
        """Return values, intervals and correlations."""
        rows = [[n, value_cell(float(value), self.std[n], unit, self.status[n]), interval_text(self.interval(n)),
                 *(_correlation_cell(x) for x in line)]
                for n, value, unit, line in zip(self.names, self.values, self.units, self.correlation, strict=True)]
        header = ["unknown", "value ± std", "95 %", *(f"ρ {n}" for n in self.names)]
        share = ", ".join(f"{channel_name(c)} {percent(v.effective_share, 2)}" for c, v in self.colours.items())
        return Card("Uncertainty", (Flag(f"{self.method} residuals"),),
                    (f"Effective number of samples, of all: {share}.",) if share else (),
                    (Table(header, rows, left=(0, 1, 2)),), (("mi.bootstrap(fit)", "check it"),))


def _correlation_cell(value: float) -> Cell:
    if not np.isfinite(value):
        return "–"
    text = f"{value:+.2f}".replace("-", "−")
    return Flag(text, "note") if 0.95 < abs(value) < 0.9999 else text


@one_thread
def covariance(fit: Fit, *, method: str = "coloured") -> Covariance:
    """Return the covariance of the unknowns of a fit, in physical units.

    How it comes about is told in `motorid.estimation.covariance`; `Fit.std` is the square root of its diagonal.

    Parameters
    ----------
    fit : Fit
    method : {"coloured", "white"}
        ``"white"``: M without correlation between samples.

    Examples
    --------
    >>> sure = mi.covariance(better)
    >>> axes = mi.plot_parameters(fit, better)
    """
    known, unknown = checked(fit, "covariance").certainty(method), fit.problem.unknown
    lost = np.array([s != "determined" for s in known.status], bool)
    matrix = np.where(lost | lost[:, None], np.nan, known.matrix)
    names = tuple(p.name for p in unknown)
    return Covariance(names, fit.problem.scaling.physical(fit.q), matrix, dict(zip(names, known.status, strict=True)),
                      tuple(p.positive for p in unknown), method, known.dof, known.colours,
                      tuple(p.unit for p in unknown))

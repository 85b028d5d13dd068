"""How certain are the values? Covariance, correlations and intervals, for coloured residuals too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import stdtrit

from motorid.channels import channel_name
from motorid.display.cards import Card, Printed
from motorid.display.numbers import interval_text, percent
from motorid.display.tables import Cell, Flag, Table, value_cell
from motorid.errors import UsageError, one_of
from motorid.estimation.result import UNDETERMINED, Fit
from motorid.numerics.autoregression import Colour, colour_of, weighed
from motorid.numerics.least_squares import gauss_newton_covariance
from motorid.numerics.parallel import one_thread
from motorid.numerics.signals import Array

WIDE = 0.8  # of the value: an interval that reaches farther down is made on the logarithmic scale
METHODS = ("coloured", "white")
Blocks = Mapping[str, Sequence[tuple[Array, Array]]]


@dataclass(frozen=True, eq=False, repr=False)
class Covariance(Printed):
    """What the data say about the unknowns of a fit.

    Attributes
    ----------
    names : tuple of str
        Unknowns: free parameters, then initial states.
    values : ndarray, shape (k,)
    matrix : ndarray, shape (k, k)
        Covariance in physical units; NaN in the rows of what is not determined.
    status : mapping of str to str
        ``"determined"``, ``"not determined"``, ``"at its lower limit"`` or ``"at its upper limit"``.
    positive : tuple of bool
        Which unknowns cannot be zero or negative.
    method : str
    dof : float
        Effective degrees of freedom of the residuals.
    colours : mapping of str to Colour
        Per channel, of the whitened residuals.
    units : tuple of str
    """

    names: tuple[str, ...]
    values: Array
    matrix: Array
    status: Mapping[str, str]
    positive: tuple[bool, ...]
    method: str
    dof: float
    colours: Mapping[str, Colour]
    units: tuple[str, ...]

    @cached_property
    def std(self) -> dict[str, float | None]:
        """One standard deviation per unknown, in its unit; None where it is not determined or at a limit."""
        variances = np.diag(self.matrix)
        return {n: float(np.sqrt(v)) if self.status[n] == "determined" else None
                for n, v in zip(self.names, variances, strict=True)}

    @cached_property
    def correlation(self) -> Array:
        """Correlations, shape (k, k); NaN where not determined."""
        sd = np.sqrt(np.diag(self.matrix))
        return self.matrix / np.outer(sd, sd)

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float] | None:
        """Return the two-sided confidence interval of one unknown; None where the data do not determine it.

        Student's t on the effective degrees of freedom; on the logarithmic scale where a positive parameter's
        interval would come near zero.
        """
        if name not in self.names:
            raise UsageError(one_of(name, self.names, "parameter"))
        if not 0 < level < 1:
            raise UsageError(f"a confidence level lies between 0 and 1; got {level!r}.")
        sd, j = self.std[name], self.names.index(name)
        if sd is None:
            return None
        reach = float(stdtrit(self.dof, 0.5 + level / 2)) * sd
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
                 *(_correlation_cell(x) for x in correlations)]
                for n, value, unit, correlations in zip(
                    self.names, self.values, self.units, self.correlation, strict=True)]
        header = ["unknown", "value ± std", "95 %", *(f"ρ {n}" for n in self.names)]
        share = ", ".join(f"{channel_name(c)} {percent(v.effective_share, 2)}" for c, v in self.colours.items())
        return Card("Uncertainty", (Flag(f"{self.method} residuals"),),
                    (f"Effective samples per sample: {share}.",) if share else (),
                    (Table(header, rows, left=(0, 1, 2)),), (("mi.bootstrap(fit)", "check it"),))


def _correlation_cell(value: float) -> Cell:
    if not np.isfinite(value):
        return "–"
    text = f"{value:+.2f}".replace("-", "−")
    return Flag(text, "note") if 0.95 < abs(value) < 0.9999 else text


@one_thread
def covariance(fit: Fit, *, method: str = "coloured") -> Covariance:
    """Return the covariance of the unknowns of a fit, in physical units.

    ``H⁻¹ M H⁻¹`` with ``H = JᵀJ`` (Gauss-Newton) and ``M`` the covariance of ``Jᵀr``: the residuals of each channel
    are taken as stationary, with the variance they have and the autocovariance of an autoregression fitted to them,
    so neither the assumed noise level nor its whiteness matters (sandwich: White, Econometrica 50, 1982; Newey &
    West, Econometrica 55, 1987; here with a parametric Γ, since transients leave few samples to average over).
    Residuals that depend on the motion, of a model that lacks something, are not noise; then it is an indication.

    Parameters
    ----------
    fit : Fit
    method : {"coloured", "white"}
        ``"white"``: M without correlation between samples.

    Raises
    ------
    UsageError
        If the method is unknown.
    """
    if method not in METHODS:
        raise UsageError(one_of(method, METHODS, "method"))
    problem = fit.problem
    unknown = problem.unknown
    physical = problem.scaling.physical(fit.q)
    status = [_limit(p.lower, p.upper, v) for p, v in zip(unknown, physical, strict=True)]
    loose = np.array([s == "" for s in status], bool)
    blocks = channel_blocks(fit)
    colours = _colours(blocks, int(loose.sum()), method)
    bread, determined = gauss_newton_covariance(fit.jacobian[:, loose])
    meat = _meat(fit, blocks, colours)[np.ix_(loose, loose)]
    inner = bread @ meat @ bread
    sd = np.sqrt(np.maximum(np.diag(inner), 0.0))
    positive = np.array([p.positive for p in unknown], bool)
    vague = np.logical_and(positive[loose], sd > UNDETERMINED * np.abs(physical[loose]))
    known = determined & ~vague
    inner[~known], inner[:, ~known] = np.nan, np.nan
    matrix = np.full((len(unknown), len(unknown)), np.nan)
    matrix[np.ix_(loose, loose)] = inner
    settled = iter("determined" if k else "not determined" for k in known)
    said = {p.name: s or next(settled) for p, s in zip(unknown, status, strict=True)}
    effective = sum(_samples(parts) * colours[c].effective_share for c, parts in blocks.items())
    dof = max(float(effective) - int(loose.sum()), 1.0)
    return Covariance(tuple(p.name for p in unknown), physical, matrix, said, tuple(positive.tolist()),
                      method, dof, colours, tuple(p.unit for p in unknown))


def _limit(lower: float, upper: float, value: float) -> str:
    if value <= lower:
        return "at its lower limit"
    return "at its upper limit" if value >= upper else ""


def channel_blocks(fit: Fit) -> dict[str, list[tuple[Array, Array]]]:
    """Return per channel and run the whitened residual (N,), NaN where missing, and its Jacobian (N, k)."""
    problem, start = fit.problem, 0
    blocks: dict[str, list[tuple[Array, Array]]] = {c: [] for c in problem.outputs}
    ny = len(problem.outputs)
    for run in problem.runs:
        present = np.column_stack([np.isfinite(run.experiment.outputs[c]) if c in run.experiment.outputs
                                   else np.zeros(len(run.grid.t), bool) for c in problem.outputs])
        rows, n = np.flatnonzero(present.ravel()), present.size
        r, jac = np.full(n, np.nan), np.zeros((n, fit.jacobian.shape[1]))
        r[rows] = fit.residuals[start:start + len(rows)]
        jac[rows] = fit.jacobian[start:start + len(rows)]
        start += len(rows)
        for j, c in enumerate(problem.outputs):
            if c in run.sigma:
                blocks[c].append((r[j::ny], jac[j::ny]))
    return blocks


def _colours(blocks: Blocks, unknowns: int, method: str) -> dict[str, Colour]:
    found = {}
    for c, parts in blocks.items():
        colour = colour_of([r for r, _ in parts], unknowns / len(blocks))
        found[c] = colour if method == "coloured" else Colour(np.zeros(0), colour.variance, colour.variance)
    return found


def _meat(fit: Fit, blocks: Blocks, colours: Mapping[str, Colour]) -> Array:
    """Covariance of Jᵀr: outputs with their colour, priors as observations of variance 1, penalties fixed."""
    k = fit.jacobian.shape[1]
    total = np.zeros((k, k))
    for c, parts in blocks.items():
        for _, jac in parts:
            total += weighed(jac, colours[c].autocovariance(len(jac)))
    n, unknown = fit.problem.n_outputs, {p.name for p in fit.problem.unknown}
    prior = fit.jacobian[n:n + len(unknown & set(fit.problem.priors))]
    return total + prior.T @ prior


def _samples(parts: Sequence[tuple[Array, Array]]) -> int:
    return int(sum(np.isfinite(r).sum() for r, _ in parts))


def deviations(fit: Fit) -> dict[str, float | None]:
    """Return one standard deviation per parameter, the residuals taken as coloured as they are.

    A model that lacks something leaves residuals that go with the motion; as white noise they would make its
    parameters far too certain. True constraints carry information of their own: then it is the fit's.
    """
    if fit.problem.constraints or not fit.problem.unknown:
        return dict(fit.std)
    found = covariance(fit).std
    return {n: None if std is None else found.get(n, std) for n, std in fit.std.items()}

"""Parameters with units and limits, and the one place where physical values become solver coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motorid.errors import ModelError


@dataclass(frozen=True)
class Parameter:
    """One physical parameter.

    Attributes
    ----------
    name : str
    value : float
        Present value, in `unit`.
    unit : str
        SI unit, e.g. ``"N·m"``; it also tells the natural size of the parameter in a record.
    lower, upper : float
        Physical limits, enforced by the solvers.
    positive : bool
        Lives on a logarithmic scale (R, L, K, b, J, time constants).
    vary : bool
        False: held at `value` in a fit.
    null : float or None
        Value at which the effect vanishes; None for shape parameters (a Stribeck speed, an angle).
    grid : tuple of float
        For shape parameters: where to start, as multiples of the natural size of `unit` in the data
        (or absolute values for dimensionless parameters).
    periodic : bool
        A phase angle: starts are found from its sine and cosine part together.
    order : bool
        A number of periods per turn, found from the spectrum of the misfit over the angle.
    given : bool
        Set by the user; then no first guess replaces it.
    at_least : str
        Name of a parameter that this one cannot physically fall below (breakaway friction, Coulomb friction);
        checked after a fit, by `diagnose`.
    doc : str
    """

    name: str
    value: float
    unit: str = ""
    lower: float = -np.inf
    upper: float = np.inf
    positive: bool = False
    vary: bool = True
    null: float | None = None
    grid: tuple[float, ...] = ()
    periodic: bool = False
    order: bool = False
    given: bool = False
    at_least: str = ""
    doc: str = ""

    def __post_init__(self) -> None:
        if not np.isfinite(self.value):
            raise ModelError(f"parameter '{self.name}' needs a finite value, got {self.value}.")
        if self.positive and self.vary and self.value <= 0:
            raise ModelError(
                f"parameter '{self.name}' must be positive, got {self.value:g}. "
                f"To leave it out of the model, set it to zero and fix it: model.fix({self.name}=0)."
            )
        if self.lower > self.upper:
            raise ModelError(f"parameter '{self.name}': lower limit {self.lower:g} above upper "
                             f"{self.upper:g}.")
        if not self.lower <= self.value <= self.upper:
            raise ModelError(
                f"parameter '{self.name}' = {self.value:g} {self.unit} lies outside its limits "
                f"[{self.lower:g}, {self.upper:g}]."
            )


@dataclass(frozen=True)
class Declared:
    """A parameter of an effect without its name, which is that of the argument; see `P`."""

    fields: Mapping[str, Any]

    def named(self, name: str) -> Parameter:
        """Return the `Parameter` called `name`."""
        return Parameter(name, **self.fields)


def P(
    value: float,
    unit: str = "",
    null: float | None = None,
    *,
    lower: float = -np.inf,
    upper: float = np.inf,
    positive: bool = False,
    vary: bool = True,
    grid: Iterable[float] = (),
    periodic: bool = False,
    order: bool = False,
    at_least: str = "",
    doc: str = "",
) -> Any:
    """Declare a parameter of an effect as a default argument: ``tau_c=P(2e-3, "N·m", null=0)``.

    The name comes from the argument; what the others mean is told at `Parameter`.
    """
    return Declared({"value": value, "unit": unit, "null": null, "lower": lower, "upper": upper,
                     "positive": positive, "vary": vary, "grid": tuple(grid), "periodic": periodic,
                     "order": order, "at_least": at_least, "doc": doc})


@dataclass(frozen=True, eq=False)
class Scaling:
    """Solver coordinates q of the physical values p: ``p = s·exp(q)`` where `log`, else ``p = s·q``.

    Attributes
    ----------
    scale : ndarray, shape (n,)
        Positive sizes s.
    log : ndarray of bool, shape (n,)
    lower, upper : ndarray, shape (n,)
        Limits of p.
    """

    scale: NDArray[np.float64]
    log: NDArray[np.bool_]
    lower: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    upper: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @staticmethod
    def of(parameters: Iterable[Parameter], sizes: ArrayLike | None = None) -> Scaling:
        """Return the scaling of `parameters`; `sizes` (n,) replaces the size read from their values."""
        pars = list(parameters)
        values = np.array([p.value for p in pars], float)
        scale = np.abs(values if sizes is None else np.asarray(sizes, float))
        scale = np.where((scale > 0) & np.isfinite(scale), scale, 1.0)
        log = np.array([p.positive for p in pars], bool)
        lower, upper = ([getattr(p, side) for p in pars] for side in ("lower", "upper"))
        return Scaling(scale, log, np.array(lower, float), np.array(upper, float))

    def physical(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return p of q."""
        q = np.asarray(q, float)
        return self.scale * np.where(self.log, np.exp(np.where(self.log, np.clip(q, -200, 200), 0.0)), q)

    def scaled(self, p: ArrayLike) -> NDArray[np.float64]:
        """Return q of p."""
        ratio = np.asarray(p, float) / self.scale
        tiny = np.finfo(float).tiny
        return np.where(self.log, np.log(np.maximum(ratio, tiny)), ratio)

    def slope(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return dp/dq at q, shape (n,)."""
        return np.where(self.log, self.physical(q), self.scale)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Limits in q."""
        with np.errstate(divide="ignore"):
            low, high = (np.where(self.log, np.log(np.maximum(p, 0.0) / self.scale), p / self.scale)
                         for p in (self.lower, self.upper))
        return low, high

"""What a user declares: parameters with units and limits, and effects, whose laws write on the sheet of equations."""

import importlib
import inspect
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from motorid.display.cards import Card, Flag, Shown, Table
from motorid.display.numbers import quantity
from motorid.errors import ModelError, among


@dataclass(frozen=True)
class Parameter:
    """One physical parameter.

    Attributes
    ----------
    value, unit : float, str
        Present value, in an SI unit, e.g. ``"N·m"``, which also tells the natural size of the parameter in a record.
    lower, upper, positive : float, float, bool
        Physical limits, enforced by the solvers; on a logarithmic scale (R, L, K, b, J, time constants).
    vary, given : bool
        Estimated, not fixed at `value`; set by the user, so that no first guess replaces it.
    null, grid : float or None, tuple of float
        Value at which the effect vanishes; None for shape parameters (a Stribeck speed, an angle), which start from
        `grid`, in natural sizes of `unit` in the data (dimensionless: absolute).
    periodic, order : bool
        A phase angle, whose starts are found from its sine and cosine part together; a number of periods per turn,
        found from the spectrum of the misfit over the angle.
    per_run : bool
        Another in every run (an encoder's zero): `value` is that of the first run, the others are estimated apart.
    place, pole : bool
        A place on the way of the angle, its `grid` in shares of the travel, 0 the lowest and 1 the highest angle; a lag
        in series with the winding's own, L/R, for which a fit may take it: it starts from both places.
    at_least : str
        Name of the parameter that this one cannot fall below (breakaway friction, Coulomb's); `diagnose` checks it.

    Examples
    --------
    >>> p = mi.dc_motor(R=1.2).parameters["R"]
    >>> p.value, p.unit, p.vary
    (1.2, 'Ω', True)
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
    per_run: bool = False
    place: bool = False
    pole: bool = False
    given: bool = False
    at_least: str = ""
    doc: str = ""

    def __post_init__(self) -> None:
        if not np.isfinite(self.value):
            raise ModelError(f"parameter '{self.name}' needs a finite value, got {self.value}.")
        if self.given and self.value and not 1e-20 < abs(self.value) < 1e20:
            raise ModelError(f"parameter '{self.name}' = {self.value:g} is not plausible; give it in SI units.")
        if self.positive and (self.value < 0 or (self.value == 0 and (self.vary or self.name in ("R", "J")))):
            hint = (f"To leave it out of the model, set it to zero and fix it: model.fix({self.name}=0)."
                    if self.name in ("L", "b") else "Say what it is, in SI units, or leave it to the fit.")
            raise ModelError(f"parameter '{self.name}' must be positive, got {self.value:g}. {hint}")
        if self.lower > self.upper:
            raise ModelError(f"parameter '{self.name}': lower limit {self.lower:g} above upper {self.upper:g}.")
        if not self.lower <= self.value <= self.upper:
            raise ModelError(f"parameter '{self.name}' = {self.value:g} {self.unit} lies outside its limits "
                             f"[{self.lower:g}, {self.upper:g}].")


def P(value: float, unit: str = "", null: float | None = None, *, lower: float = -np.inf, upper: float = np.inf,
      positive: bool = False, vary: bool = True, grid: Iterable[float] = (), periodic: bool = False,
      order: bool = False, per_run: bool = False, place: bool = False, pole: bool = False, given: bool = False,
      at_least: str = "", doc: str = "") -> Any:
    """Declare a parameter of an effect as a default argument: ``tau_c=P(2e-3, "N·m", null=0)``.

    The name comes from the argument; what the others mean is told at `Parameter`.

    Examples
    --------
    >>> @mi.effect(balance="torque")
    ... def fan(m, c_2=mi.P(1e-8, "N·m·s²/rad²", null=0, lower=0, doc="drag")):
    ...     m.torque -= c_2 * m.omega * abs(m.omega)
    """
    return partial(Parameter, **{**locals(), "grid": tuple(grid)})


BALANCES = ("voltage", "torque", "transmission", "sensor")


@dataclass(frozen=True, eq=False)
class Effect(Shown):
    """One physical effect: a law that writes on the `Equations` sheet.

    Examples
    --------
    >>> mi.effects.cogging
    <effect cogging (torque): A, N, phi>
    >>> model = mi.dc_motor() + mi.effects.cogging(N=12)
    """

    name: str
    law: Callable[..., None] | None  # law(m, **symbols)
    parameters: tuple[Parameter, ...]
    balance: str  # one of `BALANCES`
    doc: str = ""  # what it is, with its source
    includes: tuple[str, ...] = ()  # effects that this one contains as a special case (Stribeck friction Coulomb's)

    @property
    def title(self) -> str:
        """What people call it: the first words of its `doc`, else its name."""
        words = re.split(r"[,.:;] ?|\n", re.sub(r" \([^)\s]* [^)]*\)", "", self.doc), maxsplit=1)[0].strip()
        first = words[:1] if words[:2].isupper() else words[:1].lower()  # PWM
        return first + words[1:] if 0 < len(words) <= 60 else self.name.replace("_", " ")

    @property
    def size(self) -> Parameter | None:
        """The first parameter that makes the effect vanish at its null value, if there is one."""
        return next((p for p in self.parameters if p.null is not None), None)

    def __call__(self, **values: float) -> "Effect":
        """Return the effect with some parameters given, e.g. ``cogging(N=12)`` (fixed if it is an order)."""
        known = {p.name: p for p in self.parameters}
        for name in values:
            among(name, known, "parameter", ModelError, f"effect '{self.name}': ")
        pars = tuple(replace(p, value=float(values[p.name]), given=True, vary=p.vary and not p.order)
                     if p.name in values else p for p in self.parameters)
        return replace(self, parameters=pars)

    def card(self) -> Card:
        """Return what the effect acts on, where it comes from, and its parameters."""
        rows = [[p.name, quantity(p.value, p.unit), "–" if p.null is None else quantity(p.null, p.unit), p.doc]
                for p in self.parameters]
        text = tuple(" ".join(paragraph.split()) for paragraph in self.doc.split("\n\n"))
        return Card(f"Effect: {self.name}", (Flag(self.balance),), text,
                    (Table(["parameter", "start", "vanishes at", "meaning"], rows),), (("model + effect", "use it"),))

    def __repr__(self) -> str:
        return f"<effect {self.name} ({self.balance}): {', '.join(p.name for p in self.parameters)}>"

    def __reduce__(self) -> tuple[Any, ...]:
        # Only plain data crosses a process boundary: the law goes by the name of its module, if it has one, or as it
        # is if it is an object that carries its own source.
        rest, law = (self.parameters, self.balance, self.doc, self.includes), cast(Any, self.law)
        if not hasattr(law, "__qualname__"):
            return Effect, (self.name, law, *rest)
        importable = getattr(law, "__module__", None) not in (None, "__main__") and "<locals>" not in law.__qualname__
        return _restore_effect, ((law.__module__, law.__qualname__) if importable else None, self.name, *rest)


def _restore_effect(place: tuple[str, str] | None, name: str, *rest: Any) -> Effect:
    law = None
    if place is not None:
        with suppress(ImportError, AttributeError):
            law = getattr(importlib.import_module(place[0]), place[1]).law
    return Effect(name, law, *rest)


def effect(*, balance: str, name: str | None = None,
           includes: tuple[str, ...] = ()) -> Callable[[Callable[..., None]], Effect]:
    """Make an `Effect` of a function ``law(m, size=P(...), shape=P(...))``.

    Parameters
    ----------
    balance : {"voltage", "torque", "transmission", "sensor"}
        The balance (or the sensor) that the effect acts on.
    name : str, optional
        Default: the function's name.
    includes : tuple of str, optional
        Effects that this one contains as a special case; it cannot be combined with them.

    Raises
    ------
    ModelError
        If an argument has no `P` default or the balance is unknown.

    Examples
    --------
    >>> @mi.effect(balance="torque")
    ... def dry_friction(m, tau_c=mi.P(2e-3, "N·m", null=0)):
    ...     m.torque -= tau_c * m.sign(m.omega)
    >>> fit = mi.fit(mi.dc_motor() + dry_friction, runs)
    """
    among(balance, BALANCES, "balance", ModelError)

    def make(law: Callable[..., None]) -> Effect:
        if not callable(law):
            raise ModelError(f"an effect is a function, def my_effect(m, c=mi.P(…)): …; got {law!r}.")
        title = name or law.__name__
        pars = []
        for arg in list(inspect.signature(law).parameters.values())[1:]:
            if not isinstance(arg.default, partial):
                raise ModelError(f"effect '{title}': argument '{arg.name}' needs a default P(value, unit, null=…).")
            pars.append(arg.default(name=arg.name))
        names = [p.name for p in pars]
        for p in (p for p in pars if p.at_least):
            among(p.at_least, names, "parameter", ModelError, f"effect '{title}', at_least of '{p.name}': ")
        return Effect(title, law, tuple(pars), balance, inspect.cleandoc(law.__doc__ or ""), includes)

    return make

"""What is left beside all effects of a model: noise, fluctuation, or structure that an effect of its own takes up.

Structure comes as a curve over one quantity, in one balance: an effect like any other, to add, fit, look at and export,
and as source to edit and to name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from motorid.diagnosis.free_forms import (
    STATES,
    Form,
    basis_of,
    form_coefficients,
    linearised,
    orders_of,
    pushes_of,
    ranges_of,
    signals_of,
)
from motorid.display.numbers import number, percent
from motorid.errors import UsageError
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, P
from motorid.model.equations import Equations
from motorid.numerics.signals import Array

WHERE = {"torque": "mechanical", "voltage": "electrical", "both": "electrical", "sensor": "sensor"}
ORDERS = 8  # of a turn, the strongest, that the curve keeps
COSINES = 9  # over the range of a time or an angle
INSEPARABLE = 0.02  # of a function: what the model's own parameters and the curve's others must not be able to do
SOFT = 0.01  # of the largest current or voltage: the width of a jump at zero
QUANTITIES = {"turn": "m.theta", "theta": "m.theta", "omega": "m.omega", "i": "m.i", "v": "m.v"}
UNITS = {"turn": "rad", "theta": "rad", "omega": "rad/s", "i": "A", "v": "V", "t": "s"}


@dataclass(frozen=True)
class Curve:
    """A law given by its source: functions of one quantity with a coefficient each. Plain data, so it travels."""

    source: str

    def __call__(self, m: Equations, **coefficients: Any) -> None:
        """Write the law on the sheet `m`."""
        exec(self.source, {"ca": ca, "m": m, **coefficients})


@dataclass(frozen=True, eq=False)
class Remainder:
    """What a model leaves.

    Attributes
    ----------
    kind : {"noise", "fluctuation", "structure"}
        ``fluctuation``: larger than the noise of the sensors, and nothing predicts it; ``structure``: predictable.
    fit : Fit
        Of the model that leaves it.
    form : Form or None
        The free form that predicts most of it.
    """

    kind: str
    fit: Fit
    form: Form | None = None

    @property
    def where(self) -> str | None:
        """The balance that it is in: electrical, mechanical or sensor."""
        return None if self.form is None else WHERE[self.form.balance]

    @property
    def follows(self) -> str | None:
        """What it follows, in words."""
        return None if self.form is None else self.form.text

    def as_effect(self, name: str = "remainder") -> Effect:
        """Return what is left as an effect: a curve to add to the model, ``fit.model + found.remainder.as_effect()``.

        Raises
        ------
        UsageError
            If nothing is left that a curve could describe.
        """
        unit = self._unit
        parameters = tuple(
            P(float(c), unit, null=0.0, doc="coefficient of the curve").named(n)
            for n, c in zip(self._names(name), self._coefficients, strict=True)
        )
        form = self._needed
        balance = "voltage" if form.balance == "both" else form.balance
        return Effect(name, Curve(self._law(self._names(name))), parameters, balance, f"What is left: {form.text}.")

    def code(self, name: str = "remainder") -> str:
        """Return the effect as Python source, for ``--effects-from FILE.py`` or a notebook: to edit and to name.

        Raises
        ------
        UsageError
            If nothing is left that a curve could describe.
        """
        form, names = self._needed, self._names(name)
        balance = "voltage" if form.balance == "both" else form.balance
        pars = [f'    {n}=mi.P({float(c):.6g}, "{self._unit}", null=0.0),'
                for n, c in zip(names, self._coefficients, strict=True)]
        body = ["    " + line if line else "" for line in self._law(names).splitlines()]
        known = [f"    Nearest closed form: {text} (misses {percent(miss, 2)} of the curve)."
                 for text, miss in self.nearest()[:1]]
        return "\n".join(["import casadi as ca", "", "import motorid as mi", "", "", f'@mi.effect(balance="{balance}")',
                          f"def {name}(", "    m,", *pars, "):",
                          f'    """What is left of the misfit: {form.text}.', *(["", *known, ""] if known else []),
                          '    """', *body, ""])

    def nearest(self) -> list[tuple[str, float]]:
        """Return closed forms beside the curve, the nearest first: in words with its size, and the share missed."""
        z, value = self.curve
        found = [_closed(text, columns, value, self._unit) for text, columns in _closed_forms(self._needed.on, z)]
        return sorted(found, key=lambda f: f[1])

    @cached_property
    def curve(self) -> tuple[Array, Array]:
        """The quantity at the samples of all runs, and the missing torque, voltage or error there, SI."""
        form, basis = self._needed, []
        bare = replace(form, carrier="")
        for signal in self._signals:
            basis.append(basis_of(bare, signal, self._ranges, self._orders))
        z = np.concatenate([s[form.on] for s in self._signals])
        return z, np.concatenate(basis) @ self._free

    @property
    def _needed(self) -> Form:
        if self.form is None:
            raise UsageError(f"the remainder is {self.kind}: nothing is left that a curve over a quantity predicts.")
        if self.form.on == "run" or self.form.carrier == "acceleration":
            raise UsageError(f"what is left is {self.form.text}: no curve, but another motor in every run. "
                             "Fit the runs apart.")
        return self.form

    @cached_property
    def _signals(self) -> list[Mapping[str, Array]]:
        return [signals_of(self.fit, self.fit.problem, s, k) for k, s in enumerate(self.fit.simulations)]

    @cached_property
    def _ranges(self) -> dict[str, tuple[float, float]]:
        return ranges_of(self._signals)

    @cached_property
    def _orders(self) -> list[float]:
        return orders_of(self.fit)

    @cached_property
    def _free(self) -> Array:
        """Coefficients of the free form."""
        return form_coefficients(self.fit, linearised(self.fit, None)[0], self._needed)

    @cached_property
    def _terms(self) -> list[str]:
        """The functions of the curve, as source in z, without what the model can do by itself."""
        known = self._own
        chosen: list[str] = []
        for term in self._candidates:
            column = self._columns(self.curve[0], [term])[:, 0] * self._carrier
            columns = np.column_stack([*known, column])
            size = np.linalg.norm(columns, axis=0)
            columns = columns / np.where(size > 0, size, 1.0)
            left = columns[:, -1] - columns[:, :-1] @ np.linalg.lstsq(columns[:, :-1], columns[:, -1], rcond=1e-9)[0]
            if not known or np.linalg.norm(left) > INSEPARABLE:
                chosen.append(term)
                known = [*known, column]
        return chosen

    @cached_property
    def _own(self) -> list[Array]:
        """What each free parameter of the model puts into the balance of the form, along all runs."""
        state, problem = STATES.get(self._needed.balance), self.fit.problem
        if state not in problem.system.states:
            return []
        at = problem.system.states.index(state)
        return [pushes_of(self.fit, n)[:, at] for n in problem.model.free_names if n in problem.system.parameters]

    @cached_property
    def _carrier(self) -> Array:
        """What the curve is multiplied by, along all runs."""
        carrier = self._needed.carrier
        if not carrier:
            return np.ones_like(self.curve[0])
        if carrier == "direction":
            return np.concatenate([np.sign(s["omega"]) for s in self._signals])
        return np.concatenate([s[carrier] for s in self._signals])

    @cached_property
    def _candidates(self) -> list[str]:
        """The functions that a curve may be made of, as source in z."""
        form = self._needed
        low, high = self._ranges[form.on]
        if form.on == "turn":
            waves = self._free[1:].reshape(-1, 2)
            strong = sorted(np.argsort(-np.linalg.norm(waves, axis=1))[:ORDERS])
            chosen = [self._orders[k] for k in strong]
            return ["1.0", *(f"ca.{f}({number_of(k)} * z)" for k in chosen for f in ("sin", "cos"))]
        if form.on in ("theta", "t"):
            scale = f"{np.pi / (high - low):.9g} * (z - {low:.9g})"
            return ["1.0", *(f"ca.cos({k} * {scale})" for k in range(1, COSINES))]
        top = max(abs(low), abs(high))
        side = "m.sign(z)" if form.on == "omega" else f"ca.tanh(z / {SOFT * top:.6g})"
        s = f"(z / {top:.6g})"
        odd = [side, s, f"{s} * ca.fabs{s}", f"{s}**3"]
        even = ["1.0", f"ca.fabs{s}", f"{s}**2"]
        return [*odd, *even] if low < 0 < high else ["1.0", s, f"{s}**2", f"{s}**3"]

    @cached_property
    def _coefficients(self) -> Array:
        """Coefficients of the terms, fitted to the curve."""
        z, value = self.curve
        return np.asarray(np.linalg.lstsq(self._columns(z, self._terms), value, rcond=1e-8)[0], float)

    def _columns(self, z: Array, terms: Sequence[str]) -> Array:
        names = {"ca": np, "z": z, "m": _Sign(1e-3 * float(np.abs(z).max(initial=0.0)) + 1e-300)}
        found = [np.broadcast_to(np.asarray(eval(t, names), float), z.shape) for t in terms]
        return np.column_stack(found)

    def _names(self, name: str) -> list[str]:
        return [f"{name}_{k}" for k in range(len(self._terms))]

    @property
    def _unit(self) -> str:
        form = self._needed
        torque = "N" if self.fit.model.axis == "linear" else "N·m"
        over = {"": "", "direction": "", "omega": "·s/rad", "i": "/A"}[form.carrier]
        base = {"torque": torque, "voltage": "V", "both": f"{torque}/A", "sensor": "rad/s"}[form.balance]
        return f"{base}{over}"

    def _law(self, names: Sequence[str]) -> str:
        """Return the law as source."""
        form = self._needed
        carrier = {"": "", "direction": "m.sign(m.omega) * ", "omega": "m.omega * ", "i": "m.i * "}[form.carrier]
        lines = ["z = m.state('clock')", "m.rate(z, 1.0)"] if form.on == "t" else [f"z = {QUANTITIES[form.on]}"]
        lines += ["curve = (", *(f"    + {n} * {t}" for n, t in zip(names, self._terms, strict=True)), ")"]
        if form.balance == "both":
            return "\n".join([*lines, "m.torque -= curve * m.i", "m.voltage += curve * m.omega"])
        if form.balance == "sensor":
            return "\n".join([*lines, f"m.measure('{form.channel}', m.measured('{form.channel}') - {carrier}curve)"])
        return "\n".join([*lines, f"m.{form.balance} -= {carrier}curve"])


class _Sign:
    """The sheet's `sign` for arrays."""

    def __init__(self, width: float) -> None:
        self.width = width

    def sign(self, z: Array) -> Array:
        return np.tanh(z / self.width)


def number_of(order: float) -> str:
    """Return an order of a turn as source."""
    return f"{order:.6g}"


def _closed_forms(on: str, z: Array) -> list[tuple[str, Array]]:
    """Return closed forms of a quantity: what they are called, and their functions, (n, m)."""
    one, side = np.ones_like(z), np.sign(z)
    top = float(np.abs(z).max(initial=0.0)) or 1.0
    if on == "turn":
        return [(f"one wave, {k} to the turn", np.column_stack([np.sin(k * z), np.cos(k * z)])) for k in range(1, 13)]
    if on in ("theta", "t"):
        return [("a constant", one[:, None]), ("a straight line", np.column_stack([one, z]))]
    found = [("a constant", one[:, None]), ("proportional to it", z[:, None]), ("its sign alone", side[:, None]),
             ("its square, with its sign", (z * np.abs(z))[:, None]),
             ("its sign and proportional to it", np.column_stack([side, z]))]
    if on == "omega":
        found += [(f"an eddy-current brake, strongest at {number(w, 2)} rad/s", (z / (1 + (z / w) ** 2))[:, None])
                  for w in np.geomspace(0.03 * top, top, 12)]
    return found


def _closed(text: str, columns: Array, value: Array, unit: str) -> tuple[str, float]:
    """Return a closed form with its size, and the share of the curve that it misses."""
    size = np.linalg.lstsq(columns, value, rcond=None)[0]
    missed = value - columns @ size
    share = float(np.sqrt(missed @ missed / max(float(value @ value), 1e-300)))
    largest = float(np.abs(columns @ size).max(initial=0.0))
    return f"{text}, at most {number(largest, 2)} {unit}", share

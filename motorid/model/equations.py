"""The sheet on which the base motor and its effects write their physics."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import casadi as ca

from motorid.errors import ModelError, one_of

CHANNELS = ("i", "omega", "theta")


class Equations:
    """Balances, quantities, states and sensors of one model while it is being written.

    An effect reads ``m.i, m.omega, m.theta, m.v, m.R, m.K, …`` and writes ``m.voltage``, ``m.torque``,
    `scale`, `replace`, `state`/`rate` and `measure`. A quantity that is read is a placeholder, filled when
    the model closes, so the order of effects does not matter.

    Parameters
    ----------
    states : tuple of str
        The states of the base, among ``i, omega``.
    angle_input : bool
        The angle seen by the effects is a given signal instead of the model's own state.
    """

    def __init__(self, states: tuple[str, ...], angle_input: bool = False) -> None:
        self.states: dict[str, ca.SX] = {name: ca.SX.sym(name) for name in states}
        self.initial: dict[str, ca.SX] = {}
        self.rates: dict[str, ca.SX] = {}
        self.command = ca.SX.sym("v_cmd")
        self.inputs: dict[str, ca.SX] = {"v": self.command}
        if angle_input:
            self.inputs["theta_in"] = ca.SX.sym("theta_in")
        self.start = {name: ca.SX.sym(f"{name}_0") for name in CHANNELS}
        self.placeholders: dict[str, ca.SX] = {}
        self.definitions: dict[str, ca.SX] = {}
        self._replaced: dict[str, str] = {}
        self.voltage = ca.SX(0)
        self.torque = ca.SX(0)
        self.sensors: dict[str, ca.SX] = {}
        self.sgn_width: ca.SX | None = None
        self.symbols: dict[str, ca.SX] = {}
        self.writer = "the base model"

    # -- reading ---------------------------------------------------------------------------------------
    def define(self, name: str, expression: Any) -> None:
        """Add the quantity `name` with its base definition (used by base models)."""
        self.placeholders[name] = ca.SX.sym(f"@{name}")  # "@": no parameter or state has such a name
        self.definitions[name] = ca.SX(expression)

    def __getattr__(self, name: str) -> ca.SX:
        states, placeholders = self.__dict__.get("states", {}), self.__dict__.get("placeholders", {})
        if name in states:
            return states[name]
        if name in placeholders:
            return placeholders[name]
        if name == "theta":
            return self._angle()
        if name.startswith("__"):
            raise AttributeError(name)
        raise self._unknown(name, [*states, "theta", *placeholders, "voltage", "torque"])

    def _unknown(self, name: str, known: Iterable[str]) -> ModelError:
        if name in ("i", "R", "L", "K", "K_t", "K_e"):
            return ModelError(f"'{self.writer}' needs '{name}', which a torque-driven base lacks: leave "
                              "it out, or use dc_motor() with a record of the applied voltage.")
        return ModelError(f"{self.writer}: {one_of(name, known, 'quantity')}")

    def _angle(self) -> ca.SX:
        if "theta_in" in self.inputs:
            return self.inputs["theta_in"]
        return self.angle_state()

    def angle_state(self) -> ca.SX:
        """Return the model's own angle, adding ``dθ/dt = ω`` where it is first used."""
        if "theta" not in self.states:
            self.states["theta"] = ca.SX.sym("theta")
            self.rates["theta"] = self.states["omega"]
            self.initial["theta"] = self.start["theta"]
        return self.states["theta"]

    def sign(self, x: ca.SX) -> ca.SX:
        """Return a smooth sgn(x); the width (rad/s) is chosen from the data, well below the slowest speed."""
        if self.sgn_width is None:
            self.sgn_width = ca.SX.sym("sgn_width")
        return ca.tanh(x / self.sgn_width)

    def measured(self, channel: str) -> ca.SX:
        """Return what the sensor of `channel` shows so far (several sensor effects follow one another)."""
        if channel not in CHANNELS:
            raise ModelError(f"{self.writer}: {one_of(channel, CHANNELS, 'channel')}")
        if channel in self.sensors:
            return self.sensors[channel]
        return self.angle_state() if channel == "theta" else self.__getattr__(channel)

    # -- writing ---------------------------------------------------------------------------------------
    def scale(self, name: str, factor: Any) -> None:
        """Multiply the quantity `name` (e.g. ``"R"``) by `factor`; factors of several effects multiply."""
        self._known(name)
        self.definitions[name] = self.definitions[name] * factor

    def replace(self, name: str, expression: Any) -> None:
        """Define the quantity `name` anew; only one effect may do so."""
        self._known(name)
        if name in self._replaced:
            raise ModelError(
                f"'{self.writer}' and '{self._replaced[name]}' both replace '{name}'. "
                f"Keep one of them: model.without('{self._replaced[name]}')."
            )
        self._replaced[name] = self.writer
        self.definitions[name] = ca.SX(expression)

    def state(self, name: str, initial: Any = 0.0) -> ca.SX:
        """Add a state; `initial` may use ``m.start["omega"]`` and the like. Its `rate` must follow."""
        if name in self.states:
            raise ModelError(f"'{self.writer}' adds a state '{name}' that the model already has; rename it.")
        self.states[name] = ca.SX.sym(name)
        self.initial[name] = ca.SX(initial)
        return self.states[name]

    def rate(self, state: ca.SX, expression: Any) -> None:
        """Set the time derivative of a state that was added with `state`."""
        name = state.name()
        if name not in self.states or name in ("i", "omega", "theta"):
            raise ModelError(f"{self.writer}: rate() takes a state made with m.state(), got '{name}'.")
        self.rates[name] = ca.SX(expression)

    def measure(self, channel: str, expression: Any) -> None:
        """Set what the sensor of `channel` shows; build it on `measured` so that effects can follow."""
        self.measured(channel)
        self.sensors[channel] = ca.SX(expression)

    def _known(self, name: str) -> None:
        if name not in self.placeholders:
            raise self._unknown(name, self.placeholders)

    # -- closing ---------------------------------------------------------------------------------------
    def fill(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Return `expressions` with every placeholder replaced by its definition.

        Raises
        ------
        ModelError
            If definitions go in a circle.
        """
        names = list(self.placeholders)
        symbols = [self.placeholders[n] for n in names]
        marks = {s.name() for s in symbols}
        used: set[str] = set()
        for _ in range(len(names) + 1):
            used = set()
            for e in expressions:
                used |= {s.name() for s in ca.symvar(e)}
            if not used & marks:
                return expressions
            definitions = ca.vertcat(*[self.definitions[n] for n in names])
            expressions = [ca.substitute(e, ca.vertcat(*symbols), definitions) for e in expressions]
        circle = ", ".join(sorted(s[1:] for s in used & marks))
        raise ModelError(f"the definitions of {circle} go in a circle: an effect scales or replaces a "
                         "quantity by an expression that needs that same quantity.")

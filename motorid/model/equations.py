"""The sheet on which the base motor and its effects write their physics."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from motorid.channels import CHANNELS, COMPUTED_INPUTS, MEASURED_INPUTS
from motorid.errors import ModelError, among, one_of
from motorid.numerics.signals import Array


def reciprocal(x: ca.SX) -> ca.SX:
    """Return 1/x as a factor that is computed once; CasADi would make a division of every product with 1/x itself."""
    return 2 / (2 * x)


class Equations:
    """Balances, quantities, states and sensors of one model while it is being written.

    An effect reads ``m.i, m.omega, m.theta, m.v, m.R, m.K, …`` and writes ``m.voltage``, ``m.torque``, `scale`,
    `replace`, `state`/`rate`, `push` and `measure`. A quantity that is read is a placeholder, filled when the model
    closes, so the order does not matter. `states` are those of the base, among ``i, omega``; with `angle_input` the
    angle seen by the effects is a given signal instead of the model's own state."""

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
        self._limits: dict[str, ca.SX] = {}
        self.define("smoothing", 1)  # factor on the width of sgn, which suits the speed as it is measured
        self.define("zero", 0)  # of the measured angle
        self.voltage, self.torque = ca.SX(0), ca.SX(0)
        self.sensors: dict[str, ca.SX] = {}
        self.symbols: dict[str, ca.SX] = {}
        self.writer = "the base model"

    def define(self, name: str, expression: Any) -> None:
        """Add the quantity `name` with its base definition (used by base models)."""
        self.placeholders[name] = ca.SX.sym(f"@{name}")  # "@": no parameter or state has such a name
        self.definitions[name] = ca.SX(expression)

    def __getattr__(self, name: str) -> ca.SX:
        states, placeholders = self.__dict__.get("states", {}), self.__dict__.get("placeholders", {})
        if name == "theta":
            return self.inputs["theta_in"] + self.zero if "theta_in" in self.inputs else self.angle_state()
        if name in (known := placeholders | states):
            return known[name]
        if name.startswith("__"):
            raise AttributeError(name)
        raise self._unknown(name, [*states, "theta", *placeholders, "voltage", "torque"])

    def _unknown(self, name: str, known: Iterable[str]) -> ModelError:
        if name in ("i", "R", "L", "K", "K_t", "K_e"):
            return ModelError(f"'{self.writer}' needs '{name}', which a torque-driven base lacks: leave "
                              "it out, or use dc_motor() with a record of the applied voltage.")
        return ModelError(f"{self.writer}: {one_of(name, known, 'quantity')}")

    def base(self, name: str) -> ca.SX:
        """Return a parameter of the motor alone, whatever effects make of it: for initial states."""
        if name not in self.symbols:
            raise self._unknown(name, self.symbols)
        return self.symbols[name]

    def angle_state(self) -> ca.SX:
        """Return the model's own angle, adding ``dθ/dt = ω`` where it is first used."""
        if "theta" not in self.states:
            self.state("theta", self.start["theta"])
            self.rates["theta"] = self.states["omega"]
        return self.states["theta"]

    def sign(self, x: ca.SX) -> ca.SX:
        """Return a smooth sgn(x); the width (rad/s) is chosen from the data, well below the slowest speed."""
        return ca.tanh(x * reciprocal(self.symbols.setdefault("sgn_width", ca.SX.sym("sgn_width")) * self.smoothing))

    def measured(self, channel: str) -> ca.SX:
        """Return what the sensor of `channel` shows so far (several sensor effects follow one another)."""
        among(channel, CHANNELS, "channel", ModelError, f"{self.writer}: ")
        if channel in self.sensors:
            return self.sensors[channel]
        return self.angle_state() if channel == "theta" else self.__getattr__(channel)

    def input(self, name: str) -> ca.SX:
        """Return what was measured beside the voltage, e.g. ``"tau_load"``; the model's records must have it.

        Of the voltage, in s: the time ``"since_change"``, ``"since_reversal"``, ``"since_switch"`` (negative: off)."""
        among(name, (*MEASURED_INPUTS, *COMPUTED_INPUTS), "input", ModelError, f"{self.writer}: ")
        return self.inputs.setdefault(name, ca.SX.sym(name))

    def scale(self, name: str, factor: Any) -> None:
        """Multiply the quantity `name` (e.g. ``"R"``) by `factor`; factors of several effects multiply."""
        self._known(name)
        self.definitions[name] = self.definitions[name] * factor

    def replace(self, name: str, expression: Any) -> None:
        """Define the quantity `name` anew; only one effect may do so."""
        self._known(name)
        if name in self._replaced:
            raise ModelError(f"'{self.writer}' and '{self._replaced[name]}' both replace '{name}'. "
                             f"Keep one of them: model.without('{self._replaced[name]}').")
        self._replaced[name] = self.writer
        self.definitions[name] = ca.SX(expression)

    def limit(self, name: str, size: Any) -> None:
        """Keep the quantity `name`, whatever else scales or replaces it, within ± `size`."""
        self._known(name)
        self._limits[name] = size

    def state(self, name: str, initial: Any = 0.0) -> ca.SX:
        """Add a state; `initial` may use ``m.start["omega"]`` and the like. Its `rate` must follow."""
        if name in self.states:
            raise ModelError(f"'{self.writer}' adds a state '{name}' that the model already has; rename it.")
        self.states[name] = ca.SX.sym(name)
        self.initial[name] = ca.SX(initial)
        return self.states[name]

    def rate(self, state: ca.SX, expression: Any) -> None:
        """Set the time derivative of a state that was added with `state`."""
        name = state.name() if isinstance(state, ca.SX) else str(state)
        if name not in self.states or name in CHANNELS:
            raise ModelError(f"{self.writer}: rate() takes a state made with m.state(), got '{name}'.")
        if name in self.rates:
            raise ModelError(f"{self.writer}: the state '{name}' has a rate already; give it once, as one sum.")
        self.rates[name] = ca.SX(expression)

    def push(self, state: str, expression: Any) -> None:
        """Add to the rate of a state that an effect given before has added: a torque on the load, over its inertia."""
        if state not in self.rates:
            raise self._unknown(state, self.rates)
        self.rates[state] += expression

    def measure(self, channel: str, expression: Any) -> None:
        """Set what the sensor of `channel` shows; build it on `measured` so that effects can follow."""
        self.measured(channel)
        self.sensors[channel] = ca.SX(expression)
        if channel == "theta" and "theta_in" in self.inputs:  # what was measured must not predict itself
            own = self.angle_state() - self.zero
            self.sensors[channel] = ca.substitute(self.sensors[channel], self.inputs["theta_in"], own)

    def _known(self, name: str) -> None:
        if name not in self.placeholders:
            raise self._unknown(name, self.placeholders)

    def fill(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Return `expressions` with placeholders replaced by definitions; ModelError where these go in a circle."""
        names = list(self.placeholders)
        symbols, limits = [self.placeholders[n] for n in names], self._limits
        marks = {s.name() for s in symbols}
        before, used = set[str](), set[str]()
        for _ in range(len(names) + 1):
            before, used = used, {s.name() for s in ca.symvar(ca.vertcat(*expressions))}
            if not used & marks:
                return expressions
            defined = (ca.fmax(-limits[n], ca.fmin(limits[n], self.definitions[n])) if n in limits
                       else self.definitions[n] for n in names)
            expressions = ca.substitute(expressions, [ca.vertcat(*symbols)], [ca.vertcat(*defined)])
        circle = ", ".join(sorted(s[1:] for s in (before | used) & marks))
        raise ModelError(f"the definitions of {circle} go in a circle: an effect scales or replaces a "
                         "quantity by an expression that needs that same quantity.")


@dataclass(frozen=True, eq=False)
class System:
    """Functions of one model for one choice of outputs; holds no Python code and can be pickled."""

    # Names, in the order of the vectors x, u, y, p.
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    stored: tuple[bool, ...]  # per state: a differential equation, or an algebraic balance (zero storage)
    rhs: ca.Function  # (x, u, p) -> f: dx/dt of differential states, the balance itself of algebraic ones
    out: ca.Function  # (x, u, p) -> y: what the sensors show
    initial: ca.Function  # (s, p) -> x0 with s = (i, omega, theta) at the first sample
    balances: ca.Function  # (x, u, p) -> (voltage, torque) left over, V and N·m, at zero rates
    forces: ca.Function  # (x, u, p, d) -> f with d = (voltage, torque) added to the balances, unknown inputs

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Numbers of states, inputs, parameters, outputs."""
        return len(self.states), len(self.inputs), len(self.parameters), len(self.outputs)

    @cached_property
    def visible(self) -> frozenset[str]:
        """Parameters that can be seen in the outputs, by the structure of the equations."""
        (x, u, p), s = self.rhs.sx_in(), ca.SX.sym("s", 3)
        f, y, x0 = self.rhs(x, u, p), self.out(x, u, p), self.initial(s, p)
        f_x, f_p, y_x, y_p, x0_p = (np.asarray(ca.DM(ca.jacobian_sparsity(a, b), 1).full(), bool)
                                    for a, b in ((f, x), (f, p), (y, x), (y, p), (x0, p)))
        seen = y_x.any(axis=0)  # states that act on an output, directly or through other states
        for _ in self.states:
            seen = seen | f_x[seen].any(axis=0)
        shown = np.vstack([y_p, f_p[seen], x0_p[seen]]).any(axis=0)
        return frozenset(self.parameters[k] for k in np.flatnonzero(shown))

    def first_state(self, s: Array, p: Array) -> Array:
        """Return x0 (nx,) from s = (i, omega, theta) at the first sample and p."""
        if self._affine is None:
            return np.asarray(self.initial(s, p)).ravel()
        constant, by_s, by_p = self._affine
        return constant + by_s @ s + by_p @ p

    def first_slopes(self, s: Array, p: Array) -> tuple[Array, Array]:
        """Return dx0/ds (nx, 3) and dx0/dp (nx, np)."""
        if self._affine is not None:
            return self._affine[1], self._affine[2]
        by_s, by_p = self.initial.jacobian()(s, p, np.zeros(len(self.states)))
        return np.asarray(by_s), np.asarray(by_p)

    @cached_property
    def _affine(self) -> tuple[Array, Array, Array] | None:
        """x0 = c + S s + P p, where it is so (as in the whole library): then no CasADi call is needed."""
        z = ca.SX.sym("z", 3 + len(self.parameters))
        slopes = ca.jacobian(self.initial(z[:3], z[3:]), z)
        if ca.symvar(slopes):
            return None
        matrix = np.asarray(ca.DM(ca.evalf(slopes)))
        constant = np.asarray(self.initial(np.zeros(3), np.zeros(z.numel() - 3))).ravel()
        return constant, np.ascontiguousarray(matrix[:, :3]), np.ascontiguousarray(matrix[:, 3:])

    def __getstate__(self) -> dict[str, Any]:
        return {f: getattr(self, f) for f in self.__dataclass_fields__}


def build_system(m: Equations, parameters: tuple[str, ...], outputs: tuple[str, ...],
                 stored: tuple[str, ...]) -> System:
    """Close the sheet `m` and return its `System`."""
    if electrical := "i" in m.states:
        voltage = m.v - m.R * m.i - m.K_e * m.omega + m.voltage
        torque = m.K_t * m.i - m.b * m.omega + m.torque
    else:
        voltage = ca.SX(0)
        torque = m.g * m.v - m.b * m.omega + m.torque
        if not m.voltage.is_zero():
            raise ModelError("a torque-driven model has no voltage balance: leave the electrical effects "
                             "out, or use dc_motor() with a record of the applied voltage.")
    if "omega" not in outputs:
        m.definitions["smoothing"] = ca.SX(1)
    shown = [m.measured(c) for c in outputs]
    for name in m.states:
        if name not in ("i", "omega") and name not in m.rates:
            raise ModelError(f"the state '{name}' has no rate: call m.rate({name}, …) in the effect that adds it.")
    d = ca.SX.sym("d", 2)
    rates: dict[str, Any] = dict(m.rates)
    rates["omega"] = (torque + d[1]) * reciprocal(m.J)
    if electrical:
        rates["i"] = (voltage + d[0]) * reciprocal(m.L) if "i" in stored else voltage + d[0]
    names = tuple(m.states)
    initial = {"i": m.start["i"], "omega": m.start["omega"], **m.initial}
    f, y, x0, balances = m.fill([ca.vertcat(*[rates[n] for n in names]), ca.vertcat(*shown),
                                 ca.vertcat(*[initial[n] for n in names]), ca.vertcat(voltage, torque)])
    x, u = ca.vertcat(*m.states.values()), ca.vertcat(*m.inputs.values())
    p, s = ca.vertcat(*[m.symbols[n] for n in parameters]), ca.vertcat(*m.start.values())
    quiet = ca.substitute(f, d, ca.DM.zeros(2))
    used, defined = ({s.name() for s in ca.symvar(ca.vertcat(*e))} for e in ((quiet, y, balances), (x, u, p)))
    if stray := sorted(used - defined):
        raise ModelError(f"the model uses {', '.join(stray)}, which nothing defines. Effects may use only the sheet m "
                         "and their own parameters.")
    return System(names, tuple(m.inputs), outputs, parameters,
                  tuple(k in stored or k not in ("i", "omega") for k in names),
                  ca.Function("rhs", [x, u, p], [ca.densify(quiet)], ["x", "u", "p"], ["f"]),
                  ca.Function("out", [x, u, p], [ca.densify(y)], ["x", "u", "p"], ["y"]),
                  ca.Function("initial", [s, p], [ca.densify(x0)], ["s", "p"], ["x0"]),
                  ca.Function("balances", [x, u, p], [ca.densify(balances)], ["x", "u", "p"], ["balance"]),
                  ca.Function("forces", [x, u, p, d], [ca.densify(f)], ["x", "u", "p", "d"], ["f"]))

"""A closed model as CasADi functions: right-hand side, outputs, initial state, balances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from motorid.equations import Equations
from motorid.errors import ModelError


@dataclass(frozen=True, eq=False)
class System:
    """Functions of one model for one choice of outputs; holds no Python code and can be pickled.

    Attributes
    ----------
    states, inputs, outputs, parameters : tuple of str
        Names, in the order of the vectors x, u, y, p.
    stored : tuple of bool
        Per state: True for a differential equation, False for an algebraic balance (zero storage).
    rhs : casadi.Function
        ``(x, u, p) -> f``: dx/dt of differential states, the balance itself of algebraic ones.
    out : casadi.Function
        ``(x, u, p) -> y``: what the sensors show.
    initial : casadi.Function
        ``(s, p) -> x0`` with s = (i, omega, theta) at the first sample.
    balances : casadi.Function
        ``(x, u, p) -> (voltage, torque)`` left over, V and N·m, at zero rates.
    forces : casadi.Function
        ``(x, u, p, d) -> f`` with d = (voltage, torque) added to the balances: the unknown inputs of `diagnose`.
    """

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    stored: tuple[bool, ...]
    rhs: ca.Function
    out: ca.Function
    initial: ca.Function
    balances: ca.Function
    forces: ca.Function

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Numbers of states, inputs, parameters, outputs."""
        return len(self.states), len(self.inputs), len(self.parameters), len(self.outputs)


def build_system(m: Equations, parameters: tuple[str, ...], outputs: tuple[str, ...],
                 stored: tuple[str, ...]) -> System:
    """Close the sheet `m` and return its `System`."""
    electrical = "i" in m.states
    if electrical:
        voltage = m.v - m.R * m.i - m.K_e * m.omega + m.voltage
        torque = m.K_t * m.i - m.b * m.omega + m.torque
    else:
        voltage = ca.SX(0)
        torque = m.g * m.v - m.b * m.omega + m.torque
        if not m.voltage.is_zero():
            raise ModelError("a torque-driven model has no voltage balance: leave the electrical effects out, "
                             "or use dc_motor() with a record of the applied voltage.")
    shown = [m.measured(c) for c in outputs]
    for name in m.states:
        if name not in ("i", "omega") and name not in m.rates:
            raise ModelError(f"the state '{name}' has no rate: call m.rate({name}, …) in the effect that adds it.")
    d = ca.SX.sym("d", 2)
    rates: dict[str, Any] = dict(m.rates)
    rates["omega"] = (torque + d[1]) / m.J
    if electrical:
        rates["i"] = (voltage + d[0]) / m.L if "i" in stored else voltage + d[0]
    names = tuple(m.states)
    initial = {"i": m.start["i"], "omega": m.start["omega"], **m.initial}
    filled = m.fill([*[ca.SX(rates[n]) for n in names], *shown, *[ca.SX(initial[n]) for n in names], voltage, torque])
    n = len(names)
    f, y = ca.vertcat(*filled[:n]), ca.vertcat(*filled[n:n + len(shown)])
    x0, balances = ca.vertcat(*filled[n + len(shown):-2]), ca.vertcat(*filled[-2:])
    x, u = ca.vertcat(*m.states.values()), ca.vertcat(*m.inputs.values())
    p = ca.vertcat(*_symbols(m, parameters))
    s = ca.vertcat(*m.start.values())
    quiet = ca.substitute(f, d, ca.DM.zeros(2))
    _check_closed(ca.vertcat(quiet, y, balances), ca.vertcat(x, u, p))
    return System(
        names, tuple(m.inputs), outputs, parameters,
        tuple(k in stored or k not in ("i", "omega") for k in names),
        ca.Function("rhs", [x, u, p], [ca.densify(quiet)], ["x", "u", "p"], ["f"]),
        ca.Function("out", [x, u, p], [ca.densify(y)], ["x", "u", "p"], ["y"]),
        ca.Function("initial", [s, p], [ca.densify(x0)], ["s", "p"], ["x0"]),
        ca.Function("balances", [x, u, p], [ca.densify(balances)], ["x", "u", "p"], ["balance"]),
        ca.Function("forces", [x, u, p, d], [ca.densify(f)], ["x", "u", "p", "d"], ["f"]),
    )


def _symbols(m: Equations, parameters: tuple[str, ...]) -> list[ca.SX]:
    symbols = dict(m.symbols)
    if m.sgn_width is not None:
        symbols["sgn_width"] = m.sgn_width
    return [symbols.get(n, ca.SX.sym(n)) for n in parameters]


def _check_closed(expression: ca.SX, known: ca.SX) -> None:
    names = {s.name() for s in ca.symvar(known)}
    stray = sorted({s.name() for s in ca.symvar(expression)} - names)
    if stray:
        raise ModelError(f"the model uses {', '.join(stray)}, which nothing defines. Effects may use only the sheet "
                         "m and their own parameters.")

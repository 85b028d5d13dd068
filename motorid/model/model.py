"""Models as a base motor plus effects: ``model + effect``, ``without``, ``replace``, ``fix``."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import casadi as ca

from motorid.channels import CHANNELS
from motorid.display.cards import Card, Shown, Table
from motorid.display.numbers import quantity
from motorid.errors import ModelError, among
from motorid.model.definition import Effect, Parameter
from motorid.model.equations import Equations, System, build_system

SGN_WIDTH = Parameter("sgn_width", 1e-2, "rad/s", positive=True, vary=False, doc="speed over which sgn(ω) is smoothed")
LINEAR_UNITS = {"N·m": "N", "rad/s": "m/s", "rad": "m", "kg·m²": "kg", "N·m·s/rad": "N·s/m", "N·m·s²/rad²": "N·s²/m²",
                "N·m/rad": "N/m", "N·m·s²": "kg", "1/(N·m)": "1/N", "s/rad": "s/m", "N·m/V": "N/V", "N·m/A": "N/A"}
LINEAR_DOCS = {"g": "force per unit of the command; fixed", "J": "moving mass",
               "K": "force and back-EMF constant (V·s/m)"}


@dataclass(frozen=True, eq=False)
class Model(Shown):
    """A base motor and its effects; every change returns a copy.

    Examples
    --------
    >>> model = (mi.dc_motor() + mi.effects.coulomb).fix(L=1e-3).bounded(R=(0.5, 5))
    >>> model.free_names
    ('R', 'K', 'b', 'J', 'tau_c')
    >>> model.without("coulomb").effect_names
    ()
    """

    base: str  # "dc_motor" or "torque_driven"
    effects: tuple[Effect, ...] = ()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)  # also `sgn_width` where an effect uses sgn
    axis: str = "rotary"  # or "linear": the same equations read as mass and force, units shown so
    angle_input: bool = False  # effects take the angle from a given signal instead of the model's own state
    _systems: dict[Any, System] = field(default_factory=dict, repr=False)

    def __add__(self, other: Effect) -> Model:
        """Return the model with one more effect."""
        if not isinstance(other, Effect):
            raise ModelError(f"a model takes effects, got {other if isinstance(other, str) else type(other).__name__}: "
                             "model + mi.effects.coulomb, or one of your own (@mi.effect).")
        if other.name in self.effect_names:
            raise ModelError(f"the model already has '{other.name}'. Take it out first: model.without('{other.name}').")
        for e in self.effects:
            if e.name in other.includes or other.name in e.includes:
                raise ModelError(f"'{other.name}' and '{e.name}' describe the same "
                                 f"{'friction' if e.balance == 'torque' else e.balance} twice; one "
                                 f"contains the other. Take the present one out first: model.without('{e.name}').")
        for p in other.parameters:
            if p.name in self.parameters:
                raise ModelError(f"'{other.name}' brings a parameter '{p.name}' that the model already has; "
                                 "rename it in the effect, or leave one of the two effects out.")
        added = {p.name: self._in_units(p) for p in other.parameters}
        model = self.with_(effects=(*self.effects, other), parameters={**self.parameters, **added})
        if _once(model, _smooths) and "sgn_width" not in model.parameters:
            model = model.with_(parameters={**model.parameters, "sgn_width": self._in_units(SGN_WIDTH)})
        return model

    def without(self, name: str) -> Model:
        """Return the model without the effect called `name`."""
        among(name, self.effect_names, "effect in this model", ModelError)
        model = self.with_(effects=(), parameters={p.name: self.parameters[p.name] for p in BASES[self.base]})
        for e in self.effects:
            if e.name != name:
                model = model + e
        return model.with_(parameters={n: self.parameters[n] for n in model.parameters})

    def replace(self, **values: float) -> Model:
        """Return the model with parameter values set (in SI units); a fit starts from them."""
        return self._change({n: {"value": float(v), "given": True} for n, v in values.items()})

    def start_at(self, values: Mapping[str, float]) -> Model:
        """Return the model at values, within their limits; unlike after `replace`, a fit may start elsewhere."""
        return self._change({n: {"value": min(max(float(v), p.lower), p.upper)} for n, v in values.items()
                             if (p := self.parameters.get(n)) is not None})

    def fix(self, *names: str, **values: float) -> Model:
        """Return the model with parameters fixed: ``fix(R=1.2)`` there, ``fix("R")`` at the value it has."""
        return self._change({n: {"vary": False} for n in names}
                            | {n: {"value": float(v), "vary": False, "given": True} for n, v in values.items()})

    def free(self, *names: str) -> Model:
        """Return the model with the parameters `names` estimated again."""
        return self._change({n: {"vary": True} for n in names})

    def bounded(self, **limits: tuple[float, float]) -> Model:
        """Return the model with limits set, ``bounded(R=(0.5, 2))``; a value that nobody gave moves between them."""
        moved = {n: {"value": min(max(p.value, float(limits[n][0])), float(limits[n][1]))}
                 for n, p in self.parameters.items() if n in limits and not p.given}
        return self._change({n: {"lower": float(lo), "upper": float(hi)} | moved.get(n, {})
                             for n, (lo, hi) in limits.items()})

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of the effects, in the order of adding."""
        return tuple(e.name for e in self.effects)

    @property
    def name(self) -> str:
        """What outputs call it: ``dc_motor + coulomb``."""
        return " + ".join([self.base, *self.effect_names])

    @property
    def title(self) -> str:
        """What it is, for people: ``DC motor + coulomb``."""
        return " + ".join([TITLES[self.base], *self.effect_names])

    @property
    def values(self) -> dict[str, float]:
        """Present parameter values, in SI units."""
        return {n: p.value for n, p in self.parameters.items()}

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the parameters that a fit varies, those that are others in every run left out."""
        return tuple(n for n, p in self.parameters.items() if p.vary and not p.per_run)

    @property
    def without_value(self) -> tuple[str, ...]:
        """Names of the motor's parameters that were fixed at the placeholder they have before a fit."""
        started = {p.name: p.value for p in BASES[self.base] if p.vary}
        return tuple(n for n, p in self.parameters.items() if started.get(n) == p.value and not (p.vary or p.given))

    @property
    def shared_names(self) -> tuple[str, ...]:
        """Names of the parameters that are the same in every run, as they are or since the user gave them."""
        return tuple(n for n, p in self.parameters.items() if not p.per_run or p.given)

    def on_linear_axis(self) -> Model:
        """Return the model of what moves in metres: masses and forces for inertias and torques."""
        model = self.with_(axis="linear")
        return model.with_(parameters={n: model._in_units(p) for n, p in self.parameters.items()})

    def _in_units(self, p: Parameter) -> Parameter:
        linear = replace(p, unit=LINEAR_UNITS.get(p.unit, p.unit), doc=LINEAR_DOCS.get(p.name, p.doc))
        return linear if self.axis == "linear" and not p.periodic else p

    def _change(self, changes: Mapping[str, Mapping[str, Any]]) -> Model:
        pars = dict(self.parameters)
        for name, fields in changes.items():
            among(name, pars, "parameter", ModelError)
            pars[name] = replace(pars[name], **fields)
        return self.with_(parameters=pars)

    def with_(self, **fields: Any) -> Model:
        """Return a copy with some fields changed; equations already made stay where they are the same."""
        new = replace(self, **fields, _systems={})
        if new.effect_names == self.effect_names and new.angle_input == self.angle_input:
            # The equations depend on values only through "L is zero and fixed", which is part of the key.
            object.__setattr__(new, "_systems", self._systems)
        return new

    @property
    def stored(self) -> tuple[str, ...]:
        """Base states whose balance has storage; with L fixed at 0 the current is algebraic."""
        pars = self.parameters
        return tuple(s for s in STATES[self.base] if s != "i" or pars["L"].vary or pars["L"].value != 0)

    def write(self) -> Equations:
        """Return the filled sheet: the base and the effects, in an order that does not depend on adding."""
        m = Equations(STATES[self.base], self.angle_input)
        symbols = m.symbols = {n: ca.SX.sym(n) for n in self.parameters}
        for name in QUANTITIES[self.base]:
            m.define(name, symbols[name] if name in symbols else DERIVED[name](m))
        m.define("v", m.command)
        for e in sorted(self.effects, key=lambda e: e.name):
            if e.law is None:
                raise ModelError(f"the law of the effect '{e.name}' is not here: it was defined in another "
                                 "session. Define it again and build the model anew.")
            m.writer = e.name
            try:
                e.law(m, **{p.name: symbols[p.name] for p in e.parameters})
            except ModelError:
                raise
            except (Exception, SystemExit) as error:  # whatever the user's own code raises
                raise ModelError(f"the effect '{e.name}' cannot be written as equations ({type(error).__name__}: "
                                 f"{error}). Its law is traced with symbols: in place of Python's if, float and numpy "
                                 "take m.sign, ca.if_else, ca.fabs and the like.") from None
        return m

    def system(self, outputs: Collection[str]) -> System:
        """Return the CasADi functions of the model for the measured `outputs`, made once per choice.

        Raises
        ------
        ModelError
            If the model cannot show a channel, or definitions go in a circle.
        """
        for c in outputs:
            among(c, CHANNELS, "channel", ModelError)
        chosen = tuple(c for c in CHANNELS if c in outputs)
        if "i" in chosen and "i" not in STATES[self.base]:
            raise ModelError(f"the base '{self.base}' has no current: leave the channel 'i' out, or use dc_motor().")
        if (key := (chosen, self.stored)) not in self._systems:
            self._systems[key] = _once(self, _system, *key)
        return self._systems[key]

    def check_visible(self, outputs: Collection[str]) -> None:
        """Refuse, by a `ModelError`, an effect of which nothing can be seen in the measured `outputs`."""
        system = self.system(outputs)
        for e in self.effects:
            if e.parameters and not any(p.name in system.visible for p in e.parameters):
                raise ModelError(f"'{e.name}' cannot be seen in the measured channels ({', '.join(system.outputs)}). "
                                 f"Leave it out: model.without('{e.name}'), or add a record of its channel.")

    def card(self) -> Card:
        """Return the parameters, whether a fit varies them, and where they come from."""
        owner = {p.name: e.name for e in self.effects for p in e.parameters}
        rows = [[p.name, quantity(p.value, p.unit), ("fixed", "estimated")[p.vary], owner.get(p.name, "base"), p.doc]
                for p in self.parameters.values()]
        return Card(f"Model: {self.title}", tables=(Table(["parameter", "value", "in a fit", "of", "meaning"], rows),),
                    after=(("mi.fit(model, runs)", "fit it"), ("model + mi.effects.coulomb", "add an effect")))

    def __repr__(self) -> str:
        return f"<model {self.name}: {', '.join(self.free_names)}>"


@lru_cache(maxsize=512)
def _known_of(structure: Any) -> list[Any]:
    """What is known of models of one structure: filled when it is first asked for."""
    return []


def _once(model: Model, make: Callable[..., Any], *more: Any) -> Any:
    """Return ``make(model, *more)``, made once for all models whose equations are the same: values are no part."""
    laws = tuple((e.name, e.law) for e in model.effects)
    if not (slot := _known_of((make, model.base, laws, tuple(model.parameters), model.angle_input, *more))):
        slot.append(make(model, *more))
    return slot[0]


def _smooths(model: Model) -> bool:
    """Tell whether an effect uses a smooth sgn; ModelError if the effects contradict one another."""
    return "sgn_width" in model.write().symbols


def _system(model: Model, outputs: tuple[str, ...], stored: tuple[str, ...]) -> System:
    """Return the system of the model's structure, its slopes known."""
    equations, title = model.write(), model.name
    try:
        system = build_system(equations, tuple(model.parameters), outputs, stored)
        _ = system.visible  # its slopes
    except (RuntimeError, IndexError, TypeError) as error:  # CasADi's, and of shapes that are no single number
        raise ModelError(f"the equations of {title} cannot be built and differentiated: "
                         f"{str(error).splitlines()[-1]}.") from None
    f = system.rhs
    operations = [(f.instruction_id(k), k) for k in range(f.n_instructions())]
    if any(operation == ca.OP_CALL for operation, _ in operations):
        raise ModelError(f"the equations of {title} call a function that is no arithmetic, so they cannot be "
                         "differentiated: write it with CasADi's own operations.")
    if not all(math.isfinite(f.instruction_constant(k)) for operation, k in operations if operation == ca.OP_CONST):
        raise ModelError(f"the equations of {title} hold a number that is not finite: did a law turn a symbol into a "
                         "float?")
    return system


def dc_motor(**values: float) -> Model:
    """Return the brushed DC motor ``L di/dt = v − R i − K ω``, ``J dω/dt = K i − b ω``.

    Parameters
    ----------
    **values : float
        Known or assumed R (Ω), L (H), K (N·m/A), b (N·m·s/rad), J (kg·m²); none is needed for a fit.

    Examples
    --------
    >>> mi.dc_motor(R=1.3)
    <model dc_motor: R, L, K, b, J>
    """
    return Model("dc_motor", parameters={p.name: p for p in BASES["dc_motor"]}).replace(**values)


def torque_driven(axis: str = "rotary", **values: float) -> Model:
    """Return the drive that closes its own current loop: ``J dω/dt = g·u − b ω``.

    Parameters
    ----------
    axis : {"rotary", "linear"}
        Linear: J is a mass (kg), b in N·s/m, g in N per unit of the command.
    **values : float
        ``g``, ``b``, ``J``. The gain g is fixed (only ratios to it can be determined) until ``free("g")``.

    Examples
    --------
    >>> mi.torque_driven(axis="linear")
    <model torque_driven: b, J>
    """
    among(axis, ("rotary", "linear"), "axis", ModelError)
    model = Model("torque_driven", parameters={p.name: p for p in BASES["torque_driven"]})
    return (model.on_linear_axis() if axis == "linear" else model).replace(**values)


TITLES = {"dc_motor": "DC motor", "torque_driven": "torque-driven axis"}
STATES = {"dc_motor": ("i", "omega"), "torque_driven": ("omega",)}
SHOWN = {"dc_motor": CHANNELS, "torque_driven": ("omega", "theta")}  # channels
QUANTITIES = {"dc_motor": ("R", "L", "K", "K_t", "K_e", "b", "J"), "torque_driven": ("g", "b", "J")}
DERIVED = {"K_t": lambda m: m.K, "K_e": lambda m: m.K}
BASES = {
    "dc_motor": (Parameter("R", 1.0, "Ω", positive=True, doc="winding resistance"),
                 Parameter("L", 1e-3, "H", positive=True, doc="winding inductance"),
                 Parameter("K", 0.05, "N·m/A", positive=True, doc="torque and back-EMF constant (V·s/rad)"),
                 Parameter("b", 1e-5, "N·m·s/rad", positive=True, doc="viscous friction"),
                 Parameter("J", 1e-5, "kg·m²", positive=True, doc="moment of inertia")),
    "torque_driven": (Parameter("g", 1.0, "N·m/V", positive=True, vary=False, doc="torque per command; fixed"),
                      Parameter("b", 1e-3, "N·m·s/rad", positive=True, doc="viscous friction"),
                      Parameter("J", 1e-3, "kg·m²", positive=True, doc="moment of inertia"))}

"""The library of physical effects: ``print(mi.effects.cogging.card())`` shows one, `get` gives one by its name.

Every effect that a module here defines is in it: a new one is a function there, and nothing else. Those called
``measured_…`` are for records in which a supply voltage, a load torque or a temperature was measured too; a diagnosis
tries ``other_R``, ``other_L``, ``other_K``, ``other_b`` or ``other_J`` where the user fixed that parameter."""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from motorid.effects import electrical, mechanical, sensor
from motorid.effects.electrical import *  # noqa: F403  every effect is public
from motorid.effects.mechanical import *  # noqa: F403  every effect is public
from motorid.effects.sensor import *  # noqa: F403  every effect is public
from motorid.errors import ModelError, among, one_of
from motorid.model.definition import Effect, P
from motorid.model.equations import Equations


@dataclass(frozen=True)
class _Scaled:
    """The law by which a parameter has another value than the user fixed."""

    name: str

    def __call__(self, m: Equations, **d: Any) -> None:
        m.scale(self.name, ca.exp(d[f"d_{self.name}"]))


_ALL = {e.name: e for part in (electrical, mechanical, sensor) for e in vars(part).values() if isinstance(e, Effect)}
MEASURED = {n: e for n, e in _ALL.items() if n.startswith("measured_")}
# Of one parameter per run; a diagnosis tries them where there are several records.
PER_RUN = {n: e for n, e in _ALL.items() if any(p.per_run for p in e.parameters)}
LIBRARY = {n: e for n, e in _ALL.items() if n not in MEASURED and n not in PER_RUN}
OTHER = {n: Effect(f"other_{n}", _Scaled(n), (P(0.1, "", null=0.0)(f"d_{n}"),), "voltage" if n in "RLK" else "torque",
                   f"Another {n} than the model fixes, {n}·exp(d).") for n in "RLKbJ"}
EVERY = LIBRARY | MEASURED | PER_RUN | {e.name: e for e in OTHER.values()}


def get(name: str) -> Effect:
    """Return the library's effect called `name`; ModelError if there is none, its message names the nearest."""
    among(name, EVERY, "effect", ModelError)
    return EVERY[name]


def __getattr__(name: str) -> Effect:
    if name in EVERY:
        return EVERY[name]
    raise AttributeError(one_of(name, EVERY, "effect"))


def __dir__() -> list[str]:
    return sorted(__all__)


__all__ = ["EVERY", "LIBRARY", "MEASURED", "PER_RUN", "get", *EVERY]

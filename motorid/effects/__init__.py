"""The library of physical effects: ``print(mi.effects.cogging.card())`` shows one, `get` gives one by its name.

Every effect that a module here defines is in it: a new one is a function there, and nothing else. Those called
``measured_…`` are for records in which a supply voltage, a load torque or a temperature was measured too.
"""

from motorid.effects import electrical, mechanical, sensor
from motorid.effects.electrical import *  # noqa: F403  every effect is public
from motorid.effects.mechanical import *  # noqa: F403  every effect is public
from motorid.effects.sensor import *  # noqa: F403  every effect is public
from motorid.errors import ModelError, among, one_of
from motorid.model.definition import Effect

_ALL = {e.name: e for part in (electrical, mechanical, sensor) for e in vars(part).values() if isinstance(e, Effect)}
MEASURED = {n: e for n, e in _ALL.items() if n.startswith("measured_")}
# Of one parameter per run; a diagnosis tries them where there are several records.
PER_RUN = {n: e for n, e in _ALL.items() if any(p.per_run for p in e.parameters)}
LIBRARY = {n: e for n, e in _ALL.items() if n not in MEASURED and n not in PER_RUN}
EVERY = LIBRARY | MEASURED | PER_RUN


def get(name: str) -> Effect:
    """Return the library's effect called `name`; ModelError if there is none, its message names the nearest."""
    among(name, EVERY, "effect", ModelError)
    return EVERY[name]


def __getattr__(name: str) -> Effect:
    raise AttributeError(one_of(name, EVERY, "effect"))


def __dir__() -> list[str]:
    return sorted(__all__)


__all__ = ["EVERY", "LIBRARY", "MEASURED", "PER_RUN", "get", *EVERY]

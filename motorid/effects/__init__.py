"""The library of physical effects: `get` gives one by its name; a user's own effect has the same form."""

from __future__ import annotations

from motorid.effects.electrical import (
    brush_drop,
    driver_dead_band,
    inductance_saturation,
    magnetic_saturation,
    voltage_offset,
    winding_heating,
)
from motorid.effects.mechanical import (
    backlash,
    cogging,
    compliance,
    constant_load,
    coulomb,
    coulomb_asymmetric,
    gravity,
    load_friction,
    lugre,
    quadratic_drag,
    stribeck,
    torque_ripple,
    viscous_asymmetric,
)
from motorid.effects.sensor import current_lag, current_offset, speed_delay, speed_gain, speed_lag
from motorid.errors import ModelError, one_of
from motorid.model.definition import Effect

LIBRARY: dict[str, Effect] = {
    e.name: e
    for e in (brush_drop, winding_heating, inductance_saturation, magnetic_saturation, driver_dead_band, voltage_offset,
              coulomb, coulomb_asymmetric, stribeck, quadratic_drag, constant_load, gravity, cogging, torque_ripple,
              load_friction, viscous_asymmetric, lugre, compliance, backlash,
              speed_lag, current_lag, speed_delay, current_offset, speed_gain)
}


def get(name: str) -> Effect:
    """Return the library's effect called `name`.

    Raises
    ------
    ModelError
        If there is none; the message names the nearest.
    """
    if name not in LIBRARY:
        raise ModelError(one_of(name, LIBRARY, "effect"))
    return LIBRARY[name]


__all__ = ["LIBRARY", "get", *LIBRARY]

"""The library of physical effects: `get` gives one by its name; a user's own effect has the same form."""

from __future__ import annotations

from motorid.effects.electrical import (
    brush_drop,
    driver_coast,
    driver_current_limit,
    driver_dead_band,
    inductance_saturation,
    magnet_heating,
    magnetic_saturation,
    measured_supply,
    measured_temperature,
    supply_per_run,
    supply_sag,
    voltage_offset,
    winding_heating,
    winding_warm_start,
)
from motorid.effects.mechanical import (
    angular_friction,
    backlash,
    cogging,
    compliance,
    constant_load,
    coulomb,
    coulomb_asymmetric,
    eddy_brake,
    gear_efficiency,
    gravity,
    load_friction,
    lugre,
    measured_load,
    quadratic_drag,
    spring,
    stribeck,
    torque_ripple,
    viscous_asymmetric,
)
from motorid.effects.sensor import (
    current_gain,
    current_lag,
    current_offset,
    encoder_zero,
    speed_average,
    speed_delay,
    speed_gain,
    speed_lag,
    speed_offset,
    supply_side_current,
)
from motorid.errors import ModelError, one_of
from motorid.model.definition import Effect

LIBRARY: dict[str, Effect] = {
    e.name: e
    for e in (brush_drop, winding_heating, magnet_heating, inductance_saturation, magnetic_saturation, driver_dead_band,
              driver_coast, driver_current_limit, supply_sag, voltage_offset,
              coulomb, coulomb_asymmetric, stribeck, lugre, angular_friction, viscous_asymmetric, quadratic_drag,
              eddy_brake, load_friction, gear_efficiency, constant_load, gravity, spring, cogging, torque_ripple,
              compliance, backlash,
              speed_lag, speed_delay, speed_average, speed_gain, speed_offset, current_lag, current_offset,
              current_gain, supply_side_current)
}
# For records in which a supply voltage, a load torque or a temperature was measured beside the voltage.
MEASURED: dict[str, Effect] = {e.name: e for e in (measured_supply, measured_temperature, measured_load)}
# Of one parameter per run; a diagnosis tries none by itself.
PER_RUN: dict[str, Effect] = {e.name: e for e in (encoder_zero, winding_warm_start, supply_per_run)}
EVERY = LIBRARY | MEASURED | PER_RUN


def get(name: str) -> Effect:
    """Return the library's effect called `name`.

    Raises
    ------
    ModelError
        If there is none; the message names the nearest.
    """
    if name not in EVERY:
        raise ModelError(one_of(name, EVERY, "effect"))
    return EVERY[name]


def __getattr__(name: str) -> Effect:
    raise AttributeError(one_of(name, EVERY, "effect"))


__all__ = ["EVERY", "LIBRARY", "MEASURED", "PER_RUN", "get", *EVERY]

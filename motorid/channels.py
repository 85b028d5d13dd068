"""The channels of a record: their names, what people call them, their SI units, their order."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

CHANNELS = ("i", "omega", "theta")  # what can be measured, in the order of states, tables and figures
MEASURED_INPUTS = ("v_supply", "tau_load", "temp")  # what may be recorded beside the voltage, and drive the model too
NAMES = {"t": "time", "v": "voltage", "i": "current", "omega": "speed", "theta": "angle",
         "v_supply": "supply voltage", "tau_load": "load torque", "temp": "temperature"}
SYMBOLS = {"t": "t", "v": "v", "i": "i", "omega": "ω", "theta": "θ", "v_supply": "V", "tau_load": "τ", "temp": "T"}
# The first unit of each channel is its default. A linear axis is measured in m and m/s; the command of a
# current- or torque-controlled drive need not be a voltage.
UNITS: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "t": ("s",), "v": ("V", "A", "N·m", "N", "1"), "i": ("A",), "omega": ("rad/s", "m/s"), "theta": ("rad", "m"),
    "v_supply": ("V",), "tau_load": ("N·m", "N"), "temp": ("°C",),
})


def channel_name(channel: str, unit: str = "") -> str:
    """Return what people call a channel: the angle of a linear axis, in m, is its position."""
    return "position" if channel == "theta" and unit == "m" else NAMES.get(channel, channel)

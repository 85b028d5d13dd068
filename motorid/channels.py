"""The channels of a record: their names, what people call them, their SI units, their order."""

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType

CHANNELS = ("i", "omega", "theta")  # what can be measured, in the order of states, tables and figures
MEASURED_INPUTS = ("v_supply", "tau_load", "temp")  # what may be recorded beside the voltage, and drive the model too
COMPUTED_INPUTS = ("since_change", "since_switch", "since_reversal")  # times, s, that follow from the voltage
NAMES = {"t": "time", "v": "voltage", "i": "current", "omega": "speed", "theta": "angle",
         "v_supply": "supply voltage", "tau_load": "load torque", "temp": "temperature"}
SYMBOLS = {"t": "t", "v": "v", "i": "i", "omega": "ω", "theta": "θ", "v_supply": "V", "tau_load": "τ", "temp": "T"}
SI = {"time": "s", "voltage": "V", "current": "A", "speed": "rad/s", "linear speed": "m/s", "angle": "rad",
      "length": "m", "torque": "N·m", "force": "N", "ratio": "1", "temperature": "°C"}
# What a channel may be measured in, the default first. A linear axis is measured in m and m/s; the command of a
# current- or torque-controlled drive need not be a voltage.
DIMENSIONS: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "t": ("time",), "v": ("voltage", "current", "torque", "force", "ratio"), "i": ("current",),
    "omega": ("speed", "linear speed"), "theta": ("angle", "length"),
    "v_supply": ("voltage",), "tau_load": ("torque", "force"), "temp": ("temperature",)})
UNITS = MappingProxyType({c: tuple(SI[d] for d in dimensions) for c, dimensions in DIMENSIONS.items()})


def channel_name(channel: str, unit: str = "") -> str:
    """Return what people call a channel: the angle of a linear axis, in m, is its position."""
    special = {"theta": {"m": "position"}, "v": {"A": "current", "N·m": "torque", "N": "force", "1": "command"}}
    return special.get(channel, {}).get(unit, NAMES.get(channel, channel))


def worded(text: str, units: Mapping[str, str], names: Iterable[str] = ()) -> str:
    """Return a text with the names that channels have in such units; `names` of records, if of several words, stay."""
    now = {"angle": channel_name("theta", units.get("theta", "")), "voltage": channel_name("v", units["v"])}
    kept = sorted((re.escape(n) for n in names if " " in n), key=len, reverse=True)
    found = "|".join([*kept, r"(?<=[ (])angle(?=[ ,;:.?)]|$)", r"(?<= )voltage(?=s?[ ,;:.?])"])
    return re.sub(found, lambda m: now.get(m[0], m[0]), text)

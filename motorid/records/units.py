"""Units as they are written in files, and their way to SI. Nothing else in motorid converts units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from motorid.errors import DataError, one_of

__all__ = ["DIMENSIONS", "SI", "Unit", "parse_unit", "require_unit"]


@dataclass(frozen=True)
class Unit:
    """A unit: the value in `symbol` (SI) is `factor` times the value in the file, written `label` there."""

    dimension: str
    factor: float
    symbol: str
    label: str


SI = {"time": "s", "voltage": "V", "current": "A", "speed": "rad/s", "linear speed": "m/s", "angle": "rad",
      "length": "m", "torque": "N·m", "force": "N", "ratio": "1"}

# What a channel may be measured in. The input of a torque-driven model is a current, torque or force command.
DIMENSIONS: Mapping[str, tuple[str, ...]] = {
    "t": ("time",),
    "v": ("voltage", "current", "torque", "force", "ratio"),
    "i": ("current",),
    "omega": ("speed", "linear speed"),
    "theta": ("angle", "length"),
}

_TURN = 2 * math.pi
_DEGREE = math.pi / 180
_SPELLINGS = {
    "time": {1.0: "s sec secs second seconds sek sekunde sekunden",
             1e-3: "ms msec millis millisecond milliseconds",
             1e-6: "us usec micros microsecond microseconds",
             1e-9: "ns nanoseconds", 60.0: "min minute minutes", 3600.0: "h hour hours"},
    "voltage": {1.0: "v volt volts", 1e-3: "mv millivolt millivolts", 1e3: "kv"},
    "current": {1.0: "a amp amps ampere amperes", 1e-3: "ma milliamp milliamps milliampere", 1e-6: "ua",
                1e3: "ka"},
    "speed": {1.0: "rad/s rad/sec rad/second rads rads-1 radps", 1e-3: "mrad/s", 1e3: "krad/s",
              _TURN / 60: "rpm 1/min u/min upm umin tr/min min-1 rev/min r/min turns/min umdr/min",
              1e3 * _TURN / 60: "krpm", _TURN: "rev/s rps turn/s turns/s hz r/s u/s tr/s",
              _DEGREE: "deg/s deg/sec dps degps degs-1 degree/s degrees/s grad/s"},
    "linear speed": {1.0: "m/s ms-1 meter/s meters/s", 1e-2: "cm/s", 1e-3: "mm/s"},
    "angle": {1.0: "rad radian radians", 1e-3: "mrad", _DEGREE: "deg degree degrees grad",
              _TURN: "rev revs revolution revolutions turn turns tr umdrehungen"},
    "length": {1.0: "m meter meters metre metres", 1e-2: "cm", 1e-3: "mm", 1e-6: "um"},
    "torque": {1.0: "nm", 1e-3: "mnm", 1e-2: "ncm"},
    "force": {1.0: "n newton", 1e3: "kn"},
    "ratio": {1.0: "1 -", 1e-2: "% percent"},
}
_KNOWN = {word: (dimension, factor) for dimension, sizes in _SPELLINGS.items()
          for factor, words in sizes.items() for word in words.split()}
_COUNTS = re.compile(r"(?:counts?|cnts?|ticks?|inc|increments?|pulses?|steps?)(/s)?(?::(.*))?")
_SCALED = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*[*·x]?\s+(\S.*)", re.IGNORECASE)
_LETTERS = str.maketrans({"°": "deg", "º": "deg", "µ": "u", "μ": "u", "⁻": "-", "¹": "1", "−": "-"})


def parse_unit(text: str) -> Unit | None:
    """Read a unit such as ``rpm``, ``[deg/s]``, ``counts:2048``, ``0.0049 A`` or ``-1 A``; None if unknown.

    Encoder counts need the number of counts per turn after a colon. A number before the unit scales it, or
    turns a sign round.

    Raises
    ------
    DataError
        If the number of counts is not a positive number.
    """
    label = text.strip("[](){}<> \t")
    scaled = _SCALED.fullmatch(label)
    if scaled:
        unit = parse_unit(scaled[2])
        factor = float(scaled[1])
        if unit is None or not 1e-50 < abs(factor) < 1e50:
            return None
        return Unit(unit.dimension, factor * unit.factor, unit.symbol, label)
    word = label.translate(_LETTERS).lower().replace("per", "/").replace("^", "")
    word = re.sub(r"[\s·*.]", "", word)
    counts = _COUNTS.fullmatch(word)
    if counts:
        return _counts(label, counts[1], counts[2])
    if word not in _KNOWN:
        return None
    dimension, factor = _KNOWN[word]
    return Unit(dimension, factor, SI[dimension], label)


def require_unit(text: object, channel: str) -> Unit:
    """Read the unit that a user gave for a channel.

    Raises
    ------
    DataError
        If it is not a unit, or not one of this channel.
    """
    unit = parse_unit(str(text))
    allowed = DIMENSIONS[channel]
    if unit is None:
        known = [w for d in allowed for words in _SPELLINGS[d].values() for w in words.split()[:1]]
        known += ["counts:2048"] if channel == "theta" else []
        raise DataError(f"the unit of '{channel}': {one_of(str(text), known, 'unit')}")
    if unit.dimension not in allowed:
        raise DataError(f"'{channel}' cannot be in {unit.label}: that is a {unit.dimension}, expected a "
                        f"{' or '.join(allowed)}. Is it the right column?")
    if not math.isfinite(unit.factor):
        raise DataError(f"'{channel}' comes in encoder counts: say how many make one turn, "
                        f"e.g. units={{'{channel}': '{unit.label}:2048'}} (counts after quadrature).")
    return unit


def _counts(label: str, per_second: str | None, number: str | None) -> Unit:
    dimension = "speed" if per_second else "angle"
    if number is None:  # recognised, but of no size yet
        return Unit(dimension, math.nan, SI[dimension], label)
    try:
        per_turn = float(label.split(":", 1)[1])
    except ValueError:
        per_turn = math.nan
    if not (math.isfinite(per_turn) and per_turn > 0):
        raise DataError(f"counts per turn must be a positive number; got '{label}'. Example: counts:2048.")
    return Unit(dimension, _TURN / per_turn, SI[dimension], label)

"""Units and headers: what a unit means in SI, and which channel a column's name stands for (en, de, fr, es)."""

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

from motorid.channels import DIMENSIONS, SI
from motorid.errors import DataError, one_of, otherwise


@dataclass(frozen=True)
class Unit:
    """A unit: the value in `symbol` (SI) is `factor` times the value in the file, written `label` there."""

    dimension: str
    factor: float
    symbol: str
    label: str
    offset: float = 0.0  # added after the factor: kelvins


_TURN = 2 * math.pi
_DEGREE = math.pi / 180
_SPELLINGS = {
    "time": {1.0: "s sec secs second seconds sek sekunde sekunden", 1e-3: "ms msec millis millisecond milliseconds",
             1e-6: "us usec micros microsecond microseconds", 1e-9: "ns nanoseconds", 60.0: "min minute minutes",
             3600.0: "h hour hours", 86400.0: "d day days"},
    "voltage": {1.0: "v volt volts", 1e-3: "mv millivolt millivolts", 1e3: "kv"},
    "current": {1.0: "a amp amps ampere amperes", 1e-3: "ma milliamp milliamps milliampere", 1e-6: "ua", 1e3: "ka"},
    "speed": {1.0: "rad/s rad/sec rad/second rads rads-1 radps", 1e-3: "mrad/s", 1e3: "krad/s",
              _TURN / 60: "rpm 1/min u/min upm umin tr/min tr/mn min-1 rev/min r/min turns/min umdr/min",
              1e3 * _TURN / 60: "krpm", _TURN: "rev/s rps turn/s turns/s hz r/s u/s tr/s",
              _DEGREE: "deg/s deg/sec dps degps degs-1 degree/s degrees/s grad/s"},
    "linear speed": {1.0: "m/s ms-1 meter/s meters/s", 1e-2: "cm/s", 1e-3: "mm/s"},
    "angle": {1.0: "rad radian radians", 1e-3: "mrad", _DEGREE: "deg degree degrees grad",
              _TURN: "rev revs revolution revolutions turn turns tr umdrehungen"},
    "length": {1.0: "m meter meters metre metres", 1e-2: "cm", 1e-3: "mm", 1e-6: "um"},
    "torque": {1.0: "nm", 1e-3: "mnm", 1e-2: "ncm"}, "force": {1.0: "n newton", 1e3: "kn"},
    "ratio": {1.0: "1 -", 1e-2: "% percent", 1e-3: "‰"}, "temperature": {1.0: "degc celsius c k kelvin"}}
_KNOWN = {word: (dimension, factor) for dimension, sizes in _SPELLINGS.items()
          for factor, words in sizes.items() for word in words.split()}
_COUNTS = re.compile(r"(?:counts?|cnts?|ticks?|inc|in[ck]rement[es]?|pulses?|impulse|steps?)(/s)?(?::(.*))?")
_SCALED = re.compile(r"x?([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*[*·x]?\s+(\S.*)", re.IGNORECASE)
_LETTERS = str.maketrans({"°": "deg", "º": "deg", "µ": "u", "μ": "u", "⁻": "-", "¹": "1", "−": "-"})


def parse_unit(text: str) -> Unit | None:
    """Read a unit such as ``rpm``, ``[deg/s]``, ``counts:2048``, ``0.0049 A`` or ``-1 A``; None if unknown. Encoder
    counts need their number per turn after a colon. A number before the unit scales it, or turns a sign."""
    label = re.sub(r"(?i)(?<=[av])\s+(dc|ac|rms)$", "", text.strip("[](){}<> \t"))
    if scaled := _SCALED.fullmatch(label):
        unit, factor = parse_unit(scaled[2]), float(scaled[1])
        if unit is None or not 1e-50 < abs(factor) < 1e50:
            return None
        return Unit(unit.dimension, factor * unit.factor, unit.symbol, label)
    word = re.sub(r"[\s·*.^]", "", label.translate(_LETTERS).lower().replace("per", "/"))
    if counts := _COUNTS.fullmatch(word):
        return _counts(label, counts[1], counts[2])
    if word not in _KNOWN:
        return None
    dimension, factor = _KNOWN[word]
    return Unit(dimension, factor, SI[dimension], label, -273.15 if word in ("k", "kelvin") else 0.0)


def require_unit(text: object, channel: str, pulses: bool = True) -> Unit:
    """Read the unit that a user gave for a channel; a number may touch it (0.047V), which in a header is a name.
    `pulses`: a time may be the width of a servo's pulses."""
    if pulses and channel == "v" and (pulse := _pulse(str(text))) is not None:
        return pulse
    unit = parse_unit(re.sub(r"(?i)^((?>[-+]?[\d.]+(?:e[-+]?\d+)?))(?=[a-z°%µμ])", r"\1 ", str(text)))
    allowed = DIMENSIONS[channel]
    if unit is None:
        known = [w for d in allowed for words in _SPELLINGS[d].values() for w in words.split()[:1]]
        known += {"theta": ["counts:2048"], "v": ["0.047 V (a factor)"]}.get(channel, [])
        raise DataError(f"the unit of '{channel}': {one_of(str(text), known, 'unit')}")
    if unit.dimension not in allowed:
        is_, *wanted = (f"a{'n' * d.startswith('a')} {d}" for d in (unit.dimension, *allowed))
        raise DataError(f"'{channel}' cannot be in {unit.label}: that is {is_}, expected {' or '.join(wanted)}. "
                        "Is it the right column?")
    if not math.isfinite(unit.factor):
        raise DataError(f"'{channel}' comes in encoder counts: say how many make one turn, "
                        f"e.g. units={{'{channel}': '{unit.label}:2048'}} (counts after quadrature).")
    return unit


def _pulse(text: str) -> Unit | None:
    """Read the width of a servo's or speed controller's pulse as a command: 1000 to 2000 µs are −1 to 1; what is 0 may
    stand behind a colon (``us:1000``)."""
    label = text.strip("[](){}<> \t")
    if not (found := re.fullmatch(r"([um])s(?:ec)?(?::(\d+\.?\d*))?", label.translate(_LETTERS).lower())):
        return None
    size = {"u": 1e-6, "m": 1e-3}[found[1]] / 5e-4
    return Unit("ratio", size, SI["ratio"], label, -size * float(found[2]) if found[2] else -3.0)


def _counts(label: str, per_second: str | None, number: str | None) -> Unit:
    dimension = "speed" if per_second else "angle"
    if number is None:  # recognised, but of no size yet
        return Unit(dimension, math.nan, SI[dimension], label)
    per_turn = otherwise(math.nan, ValueError, lambda: float(label.split(":", 1)[1]))
    if not (math.isfinite(per_turn) and per_turn > 0):
        raise DataError(f"counts per turn must be a positive number; got '{label}'. Example: counts:2048.")
    return Unit(dimension, _TURN / per_turn, SI[dimension], label)


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_WORDS = {
    "t": "t time timestamp timestamps datetime zeit uhrzeit temps heure tiempo hora tempo clock sec seconds millis "
         "micros elapsed",
    "v": "v u volt volts voltage spannung tension voltaje uq vq ua va um vm vin uin vmot umot vmotor umotor "
         "ankerspannung motorspannung klemmenspannung",
    "i": "i current curr strom courant corriente iq ia im imot imotor amp amps ampere amperes ankerstrom motorstrom",
    "omega": "omega w speed spd velocity velo vel rpm drehzahl geschwindigkeit winkelgeschwindigkeit vitesse "
             "velocidad thetadot phidot qdot posdot dtheta dphi dq qd ω",
    "theta": "theta angle position pos phi q winkel lage drehwinkel posicion encoder enc x weg stroke "
             "travel displacement hub θ φ"}
_CHANNEL = {word: channel for channel, words in _WORDS.items() for word in words.split()}
_ONLY_LENGTHS = _set("x weg stroke travel displacement hub")
_LENGTHS = _ONLY_LENGTHS | _set("position pos posicion lage")
_WEAK = _set("encoder enc")
_NEUTRAL = _set("motor mot measured meas ist istwert actual act armature anker winding applied drive shaft "
                "rotor joint axis sensor angular the in of signal raw roh filtered a m")
# A column with one of these words is something else, whatever the other words are.
_OTHER = _set("goal target set sp desired des wanted soll sollwert consigne error err limit lim max min mean "
              "std sigma variance flag enable enabled id ud vd temp temperature temperatur torque force "
              "moment drehmoment power energy acceleration accel acc ddot estimate estimated est predicted "
              "simulated sim model pred offset gain noise feedforward ff")
_OTHER_ENDS = ("ref", "reference", "goal", "target", "setpoint", "soll")
_SUPPLY_ENDS = ("bus", "supply", "bat", "batt", "battery", "vcc", "vdd", "link", "versorgung", "batterie")
_TEMPERATURE = _set("temp temperature temperatur temperatura température")
_ELECTRONICS = _set("mcu cpu chip board bridge driver controller fet mosfet ambient room umgebung")
_LOAD = _set("load last brake external ext bremse lastmoment")
_TORQUE = _set("torque moment drehmoment couple force lastmoment")
_COMMAND = _set("command cmd commanded input eingang")
_DUTY = _set("duty pwm dutycycle tastgrad")
_DERIVATIVE = _set("dot rate dt derivative")
_BRACKETS = re.compile(r"(.*?)[\s_,:/]*[\[({<]([^\])}>]*)[\])}>]\s*")
_AMIDST = re.compile(r"^(.*?)\s*([\[(][^\])]*[\])])\s+(\w[^\[(]*)$")  # Current(mA) filtered
_IN = re.compile(r"(.*\S)(?:\s+in\s+|\s+/\s*|\s*,\s+|[\s_.-]+(?=[a-z]+(?:/s)?:\d)|:\s*(?!\d+$))(\S.*)", re.IGNORECASE)
_NUMBERED = re.compile(r"(.*\S)\s*:\s*\d+\s*")  # of the logger's channel
_SEPARATORS = re.compile(r"[\s_.\-:/]+")
_CAMEL = re.compile(r"(?<=[a-zäöü][a-zäöü])(?=[A-ZÄÖÜ])")
_BY_UNIT = {"time": "t", "voltage": "v", "current": "i", "speed": "omega", "linear speed": "omega", "angle": "theta"}


class HeaderMatch(NamedTuple):
    """The channel that a column may be; a higher `score` means that its name says so more plainly."""

    channel: str
    unit: Unit | None
    score: float


def classify(label: str, unit: Unit | None = None) -> HeaderMatch | None:
    """Tell which channel a header, as it stands in the file, names, or None if none; `unit` is that of a row of units,
    without which the header is searched for one. Scores: 4 the very name of a channel; 3 with idle words ("motor
    speed"); 2 with unknown words; 1 by the unit alone; lower: a last resort."""
    for text in (label, _CAMEL.sub(" ", label)):
        name, inner, explicit = unit_in(text)
        if hit := _by_words(_tokens(name) or _tokens(text), unit or inner, explicit or unit is not None):
            return hit._replace(score=0.5) if label.strip() == "T" else hit
    return None


def unit_in(label: str) -> tuple[str, Unit | None, bool]:
    """Split a header into its name, its unit, and whether that is surely a unit (``u_a`` is no current)."""
    if (nth := _NUMBERED.fullmatch(label)) and not _COUNTS.fullmatch(re.split(r"[\s_.-]", nth[1].lower())[-1]):
        label = nth[1]
    label = _AMIDST.sub(r"\1 \3 \2", label)
    if bracket := _BRACKETS.fullmatch(label):
        unit = parse_unit(bracket[2])
        inside = "" if unit or bracket[2].strip() == "t" else bracket[2]  # u(t)
        return f"{bracket[1]} {inside}", unit, unit is not None
    if (apart := _IN.fullmatch(label)) and (unit := parse_unit(apart[2])):
        return apart[1], unit, True
    parts = [p for p in _SEPARATORS.split(label) if p]
    for k in (3, 2, 1):
        tail = [p for p in parts[-k:] if p.lower() != "per"]
        if len(parts) < k or tail[-1:] == [] or tail[-1].isdigit() or len(label.strip()) == 1:
            continue
        if unit := parse_unit("/".join(tail)):
            return " ".join(parts[:-k]), unit, len(tail[-1]) > 1 or len(tail) > 1
    return label, None, False


def is_supply(label: str) -> bool:
    """Tell whether a header names a supply or bus voltage."""
    words = _tokens(unit_in(label)[0]) + _tokens(label)
    return any(w.endswith(_SUPPLY_ENDS) for w in words) and not any("current" in w or "strom" in w for w in words)


def is_reference(label: str) -> bool:
    """Tell whether a header names the reference of a controller."""
    return any(w.endswith(_OTHER_ENDS) for w in _tokens(label))


def is_duty(label: str) -> bool:
    """Tell whether a header names a duty cycle."""
    return bool(_DUTY & {*_tokens(label), *_tokens(_CAMEL.sub(" ", label))}) and classify(label) is None


def _tokens(name: str) -> list[str]:
    return [w for w in (p.strip("()[]{}<>\"'").lower() for p in _SEPARATORS.split(name)) if w]


def _beside(words: set[str], unit: Unit | None, explicit: bool) -> HeaderMatch | None:
    """Tell the supply's voltage, a load torque and a temperature of the motor, which may be measured as well."""
    warm = words & _TEMPERATURE or (explicit and unit is not None and unit.dimension == "temperature")
    channel = ("temp" if warm and not words & _ELECTRONICS else
               "tau_load" if words & _LOAD and words & _TORQUE | words & {"tau"} else
               "v_supply" if any(w.endswith(_SUPPLY_ENDS) for w in words) and not words & _OTHER else None)
    current = any("current" in w or "strom" in w for w in words)
    fits = channel and (unit is None or unit.dimension in DIMENSIONS[channel]) and not current
    return HeaderMatch(channel, unit, 3.0) if channel and fits else None


def _by_words(words: list[str], unit: Unit | None, explicit: bool) -> HeaderMatch | None:
    if beside := _beside(set(words), unit, explicit):
        return beside
    if any(w in _OTHER or w.endswith(_OTHER_ENDS) or w.endswith(_SUPPLY_ENDS) for w in words):
        return None
    channel, score = _channel_of(words)
    if channel is None:
        return _by_unit(words, unit, explicit)
    if unit is None or _goes_with(channel, unit, words):
        if score < 1 or (unit is None and _ONLY_LENGTHS & set(words)):
            return None
        last = next((w for w in reversed(words) if not (w in _NEUTRAL or w.isdigit())), "").rstrip("0123456789")
        counted = (_WEAK & set(words) and channel == "theta") or (len(last) > 4 and _COUNTS.fullmatch(last))  # no inc
        known = unit or (parse_unit({"theta": "counts", "omega": "counts/s"}.get(channel, "")) if counted else None)
        return HeaderMatch(channel, known, 2.0 if unit is None and known else score)
    longest = max(len(w) for w in words if _CHANNEL.get(w.rstrip("0123456789"), channel) == channel)
    if not explicit:  # u_a, theta_m: the letter is an index, not a unit; but speed_V is a tacho
        return None if score < 1 or (longest > 2 and unit.label in ("V", "A")) else HeaderMatch(channel, None, score)
    return None if longest > 2 or (channel in "iv" and math.isnan(unit.factor)) else _by_unit(words, unit, explicit)


def _channel_of(words: list[str]) -> tuple[str | None, float]:
    """Channel and score of the words without the unit; a score below one needs a unit to confirm it."""
    if (whole := "".join(words)) in _CHANNEL:
        return _CHANNEL[whole], 4.0
    hits = [stem for w in words if (stem := w.rstrip("0123456789")) in _CHANNEL]
    hits = [s for s in hits if len(s) > 2] or hits
    channels = {_CHANNEL[s] for s in hits if s not in _WEAK} or {_CHANNEL[s] for s in hits}
    if channels == {"theta", "omega"} or (channels == {"theta"} and _DERIVATIVE & set(words)):
        channels = {"omega"}
    commanded = _COMMAND & set(words)
    if not channels and commanded and not set(words) - _COMMAND - _NEUTRAL:
        return "v", 1.5
    if len(channels) != 1 or (commanded and channels != {"v"}):
        return None, 0.0
    unknown = {*words} - {*hits, *_NEUTRAL, *_WEAK, *_DERIVATIVE, *_DUTY, *_CHANNEL}
    score = 2.0 if commanded or unknown else 3.0
    channel = channels.pop()
    return channel, 0.9 if max(map(len, hits)) == 1 and (unknown or channel == "t") else score


def _goes_with(channel: str, unit: Unit, words: list[str]) -> bool:
    if unit.dimension == "length":
        return channel == "theta" and bool(_LENGTHS & set(words))
    if channel == "v" and not set(words) <= _COMMAND | _NEUTRAL:
        return unit.dimension == "voltage"
    return unit.dimension in DIMENSIONS[channel]


def _by_unit(words: list[str], unit: Unit | None, explicit: bool) -> HeaderMatch | None:
    channel = _BY_UNIT.get(unit.dimension) if unit else None
    if channel is None or not explicit or (channel in ("t", "theta") and any(len(w) > 2 for w in words)):
        return None
    return HeaderMatch(channel, unit, 1.0)

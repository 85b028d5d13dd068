"""What does a column's name say? Channel and unit from a header, in English, German, French or Spanish."""

from __future__ import annotations

import re
from dataclasses import dataclass

from motorid.records.units import DIMENSIONS, Unit, parse_unit

__all__ = ["Candidate", "classify", "is_duty", "is_supply", "unit_in"]


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


_WORDS = {
    "t": "t time timestamp timestamps zeit temps tiempo tempo clock sec seconds millis micros elapsed",
    "v": "v u volt volts voltage spannung tension voltaje uq vq ua va um vm vin uin vmot umot vmotor umotor "
         "ankerspannung motorspannung klemmenspannung",
    "i": "i current strom courant corriente iq ia im imot imotor amp amps ampere amperes ankerstrom "
         "motorstrom",
    "omega": "omega w speed velocity vel rpm drehzahl geschwindigkeit winkelgeschwindigkeit vitesse "
             "velocidad thetadot phidot qdot posdot dtheta dphi dq qd ω",
    "theta": "theta angle position pos phi q winkel lage drehwinkel posicion encoder enc x weg stroke "
             "travel displacement hub θ φ",
}
_CHANNEL = {word: channel for channel, words in _WORDS.items() for word in words.split()}
_ONLY_LENGTHS = _set("x weg stroke travel displacement hub")
_LENGTHS = _ONLY_LENGTHS | _set("position pos posicion lage")
_WEAK = _set("encoder enc")
_NEUTRAL = _set("motor mot measured meas ist istwert actual act armature anker winding applied drive shaft "
                "rotor joint axis sensor angular the in of signal raw filtered a m")
# A column with one of these words is something else, whatever the other words are.
_OTHER = _set("goal target set sp desired des wanted soll sollwert consigne error err limit lim max min mean "
              "std sigma variance flag enable enabled id ud vd temp temperature temperatur torque force "
              "moment drehmoment power energy acceleration accel acc ddot estimate estimated est predicted "
              "simulated sim model pred offset gain noise feedforward ff")
_OTHER_ENDS = ("ref", "reference", "goal", "target", "setpoint", "soll")
_SUPPLY_ENDS = ("bus", "supply", "bat", "batt", "battery", "vcc", "vdd", "link", "versorgung", "batterie")
_COMMAND = _set("command cmd commanded input eingang")
_DUTY = _set("duty pwm dutycycle tastgrad")
_DERIVATIVE = _set("dot rate dt derivative")
_BRACKETS = re.compile(r"(.*?)[\s_,:/]*[\[({<]([^\])}>]*)[\])}>]\s*")
_IN = re.compile(r"(.*\S)(?:\s+in\s+|\s+/\s*|\s*,\s+|:\s*)(\S.*)", re.IGNORECASE)
_SEPARATORS = re.compile(r"[\s_.\-:/]+")
_CAMEL = re.compile(r"(?<=[a-zäöü][a-zäöü])(?=[A-ZÄÖÜ])")
_BY_UNIT = {"time": "t", "voltage": "v", "current": "i", "speed": "omega", "linear speed": "omega",
            "angle": "theta"}


@dataclass(frozen=True)
class Candidate:
    """A column that may be a channel; a higher `score` means that its name says so more plainly."""

    channel: str
    column: str
    unit: Unit | None
    score: float


def classify(label: str, unit: Unit | None = None) -> Candidate | None:
    """Tell which channel a header names, or None if none.

    Parameters
    ----------
    label : str
        The header as it stands in the file.
    unit : Unit, optional
        The unit from a row of units; without it the header itself is searched for one.

    Returns
    -------
    Candidate or None
        Score 4: the very name of a channel; 3: with words that change nothing ("motor speed"); 2: with
        unknown words; 1: told by the unit alone; lower: a last resort.
    """
    for text in (label, _CAMEL.sub(" ", label)):
        name, inner, explicit = unit_in(text)
        hit = _by_words(_tokens(name) or _tokens(text), unit or inner, explicit or unit is not None)
        if hit:
            channel, found, score = hit
            return Candidate(channel, label, found, 0.5 if label.strip() == "T" else score)
    return None


def unit_in(label: str) -> tuple[str, Unit | None, bool]:
    """Split a header into its name, its unit, and whether that is surely a unit (``u_a`` is no current)."""
    bracket = _BRACKETS.fullmatch(label)
    if bracket:
        unit = parse_unit(bracket[2])
        inside = "" if unit or bracket[2].strip() == "t" else bracket[2]  # u(t)
        return f"{bracket[1]} {inside}", unit, unit is not None
    apart = _IN.fullmatch(label)
    if apart and (unit := parse_unit(apart[2])):
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
    current = any("current" in w or "strom" in w for w in words)
    return any(w.endswith(_SUPPLY_ENDS) for w in words) and not current


def is_duty(label: str) -> bool:
    """Tell whether a header names a duty cycle."""
    return bool(_DUTY & {*_tokens(label), *_tokens(_CAMEL.sub(" ", label))}) and classify(label) is None


def _tokens(name: str) -> list[str]:
    return [w for w in (p.strip("()[]{}<>\"'").lower() for p in _SEPARATORS.split(name)) if w]


def _by_words(words: list[str], unit: Unit | None, explicit: bool) -> tuple[str, Unit | None, float] | None:
    if any(w in _OTHER or w.endswith(_OTHER_ENDS) or w.endswith(_SUPPLY_ENDS) for w in words):
        return None
    channel, score = _channel_of(words)
    if channel is None:
        return _by_unit(words, unit, explicit)
    if unit is None or _goes_with(channel, unit, words):
        if score < 1 or (unit is None and _ONLY_LENGTHS & set(words)):
            return None
        known = unit or (parse_unit("counts") if _WEAK & set(words) and channel == "theta" else None)
        return channel, known, 2.0 if unit is None and known else score
    longest = max(len(w) for w in words if _CHANNEL.get(w.rstrip("0123456789"), channel) == channel)
    if not explicit:  # u_a, theta_m: the letter is an index, not a unit; but speed_V is a tacho
        return None if score < 1 or (longest > 2 and unit.label in ("V", "A")) else (channel, None, score)
    return _by_unit(words, unit, explicit) if longest < 3 else None


def _channel_of(words: list[str]) -> tuple[str | None, float]:
    """Channel and score of the words without the unit; a score below one needs a unit to confirm it."""
    whole = "".join(words)
    if whole in _CHANNEL:
        return _CHANNEL[whole], 4.0
    stems = [w.rstrip("0123456789") for w in words]
    hits = [s for s in stems if s in _CHANNEL]
    hits = [s for s in hits if len(s) > 2] or hits
    channels = {_CHANNEL[s] for s in hits if s not in _WEAK} or {_CHANNEL[s] for s in hits}
    if channels == {"theta", "omega"} or (channels == {"theta"} and _DERIVATIVE & set(words)):
        channels = {"omega"}
    commanded = _COMMAND & set(words)
    if not channels and commanded and not set(words) - _COMMAND - _NEUTRAL:
        return "v", 1.5
    if len(channels) != 1 or (commanded and channels != {"v"}):
        return None, 0.0
    known = {*hits, *_NEUTRAL, *_WEAK, *_DERIVATIVE, *_DUTY}
    unknown = [w for w in words if w not in known and w not in _CHANNEL]
    score = 2.0 if commanded or unknown else 3.0
    channel = channels.pop()
    letter = max(map(len, hits)) == 1
    return channel, 0.9 if letter and (unknown or channel == "t") else score


def _goes_with(channel: str, unit: Unit, words: list[str]) -> bool:
    if unit.dimension == "length":
        return channel == "theta" and bool(_LENGTHS & set(words))
    if channel == "v" and not set(words) <= _COMMAND | _NEUTRAL:
        return unit.dimension == "voltage"
    return unit.dimension in DIMENSIONS[channel]


def _by_unit(words: list[str], unit: Unit | None, explicit: bool) -> tuple[str, Unit | None, float] | None:
    channel = _BY_UNIT.get(unit.dimension) if unit else None
    if channel is None or not explicit or (channel in ("t", "theta") and any(len(w) > 2 for w in words)):
        return None
    return channel, unit, 1.0

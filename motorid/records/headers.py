"""Which column is which channel, in which unit: as the user or the header (en, de, fr, es) says; guesses are noted."""

import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from motorid.channels import CHANNELS, DIMENSIONS, MEASURED_INPUTS, NAMES, SI
from motorid.errors import DataError, UsageError, one_of, otherwise
from motorid.numerics.signals import Array


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
        return Unit(unit.dimension, factor * unit.factor, unit.symbol, label, unit.offset)
    word = re.sub(r"[\s·*.^]", "", label.translate(_LETTERS).lower().replace("per", "/"))
    if counts := _COUNTS.fullmatch(word):
        return _counts(label, counts[1], counts[2])
    if word not in _KNOWN:
        return None
    dimension, factor = _KNOWN[word]
    return Unit(dimension, factor, SI[dimension], label, -273.15 if word in ("k", "kelvin") else 0.0)


def require_unit(text: object, channel: str, pulses: bool = True) -> Unit:
    """Read the unit that a user gave: a number may touch it (0.047V), and of `pulses` a time is the servo's."""
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
    """Read the width of a servo's pulse as a command: 1000 to 2000 µs are −1 to 1; ``us:1000`` says where 0 is."""
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
_PERCENT = re.compile(r"%|pct|per_?cent|prozent")
_DATES = ("date", "datum", "fecha", "x_value")
_DRIVES = re.compile("input|output|control|command|drive")  # words of a column that may well be the drive voltage
STEADY = 0.2  # of its largest value: a voltage that ranges less beside a duty cycle that ranges more is the supply's
_WHOLE = 1, 100, 255, 1023, 4095, 65535  # of a duty cycle: its share, per cent, counts of a timer of 8 to 16 bits
_MEANING = {c: f"the {name}" for c, name in NAMES.items()} | {"v": "the drive voltage"}
Units = Mapping[str, Unit | None]


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


@dataclass(frozen=True)
class Place:
    """Where a channel is: its column, its unit, whether that unit was stated; `times` is a factor column."""

    column: str
    unit: Unit
    stated: bool
    score: float = 9.0
    times: str | None = None


@dataclass(frozen=True)
class Layout:
    """Channel to place, and what the user should know about it."""

    places: Mapping[str, Place]
    notes: Sequence[str]


def assign(labels: Sequence[str], *, columns: Mapping[str, object] | None = None,
           units: Mapping[str, object] | None = None, unit_row: Mapping[str, str] | None = None,
           values: Mapping[str, Array] | None = None) -> Layout:
    """Decide which column of `labels`, without a header "1", "2", ..., holds which channel. `columns` and `units` are
    those of `read_runs`, `unit_row` is what the row below the header says; `values` tell how far a duty cycle goes."""
    if not labels:
        raise DataError("it has no columns.")
    row = {label: parse_unit((unit_row or {}).get(label, "")) for label in labels}
    units = units or {}
    places = _named_by_user(labels, columns or {}, units, row)
    notes: list[str] = []
    free = [c for c in labels if c not in {p.column for p in places.values()}]
    _named_by_header(places, free, row, notes, [c for c, column in (columns or {}).items() if column is None])
    _last_resorts(places, row, values or {}, notes, {*(columns or {}), *units})
    _apply_units(places, labels, units, notes)
    if (v := places.get("v")) and v.unit.offset:
        notes.append(f"'{v.column}' is read as a servo's pulses: {-v.unit.offset / v.unit.factor:g} {v.unit.label[:2]} "
                     "is 0, 500 µs more is 1 (say where it rests: units={'v': 'us:1500'}).")
    # An angle in counts of unknown size is left out, unless it is all there is.
    for channel in (unscaled := [c for c in ("theta", "omega") if c in places and math.isnan(places[c].unit.factor)]):
        if {"i", "omega", "theta"} & set(places) == {channel}:
            require_unit(places[channel].unit.label, channel)
        notes.append(f"left out '{places.pop(channel).column}': it is in encoder counts, and how many make one turn is "
                     f"not known; to use it, say units={{'{channel}': 'counts:2048'}}.")
    _require(places, labels, values or {})
    free = [c for c in labels if c not in {x for p in places.values() for x in (p.column, p.times)}]
    wrong = _in_wrong_units(free, row, {*places, *(columns or {})}, notes)
    others = [c for c in free if c in (values or labels) and not is_reference(c) and c not in wrong]
    if others and not {"omega", "theta"} & {*places, *(columns or {}), *unscaled}:
        notes.append(f"not used: {', '.join(others[:20])}; if one of them is the speed or the angle, name it with "
                     f"columns={{'omega': '{'y' if 'y' in others else others[0]}'}}.")
    notes += [f"'{c}' looks like the reference of a controller: what drives the model is '{places['v'].column}'; "
              f"'{c}' is not used." for c in free if is_reference(c)]
    guesses = [f"'{p.column}' as {_MEANING[c]}" for c, p in places.items() if p.score <= 1]
    plain = [f"{c} ('{p.column}') in {p.unit.symbol}" for c, p in places.items()
             if not p.stated and p.column in (values or labels)]
    notes += [f"took {', '.join(guesses)}, a guess from the headers; override with columns."] if guesses else []
    notes += [f"no known unit stated, assuming {', '.join(plain)}; override with units."] if plain else []
    return Layout({c: places[c] for c in DIMENSIONS if c in places}, notes)


def _in_wrong_units(free: Sequence[str], row: Units, known: Container[str], notes: list[str]) -> list[str]:
    """Note and return the columns named like a channel that is not `known`, in a unit that it cannot have."""
    found = []
    for label in free:
        name, unit, sure = unit_in(label)
        hit = classify(name) if (unit := row[label] or (unit if sure else None)) else None
        if hit and unit and hit.score >= 3 and hit.channel not in known and not any(f"'{label}'" in n for n in notes):
            found.append(label)
            c, one = hit.channel, f"0.001 {SI[DIMENSIONS[hit.channel][0]]}"
            notes.append(f"not used: '{label}'; it is named like {_MEANING[c]}, and {unit.label} is no unit of that. "
                         f"Say how much one is: columns={{'{c}': '{label}'}}, units={{'{c}': '{one}'}}.")
    return found


def _named_by_user(labels: Sequence[str], columns: Mapping[str, object], units: Mapping[str, object],
                   row: Units) -> dict[str, Place]:
    places = {}
    for channel, column in columns.items():
        if channel not in DIMENSIONS:
            raise DataError(f"columns: {one_of(str(channel), DIMENSIONS, 'channel')} "
                            "Write channel=column, e.g. v=u_volt.")
        if column is None:
            continue
        label = _find(labels, column)
        if (unit := row[label] or unit_in(label)[1]) and unit.dimension not in DIMENSIONS[channel]:
            named = classify(label, row[label])  # u_a is in no ampere, current_A is
            sure = (named and named.unit) or unit_in(label)[2]
            unit = None if {channel, label} & set(units) or not sure else require_unit(
                unit.label, channel, pulses=named is None or named.channel != "t")
        places[channel] = Place(label, unit or _default(channel), unit is not None)
    taken = [p.column for p in places.values()]
    if twice := [label for label in taken if taken.count(label) > 1]:
        raise DataError(f"columns: '{twice[0]}' is given for {len(twice)} channels; each needs its own.")
    return places


def _find(labels: Sequence[str], column: object) -> str:
    text = str(column).strip()
    for same in (str.strip, lambda s: s.strip().lower()):
        hits = [c for c in labels if same(c) == same(text)]
        if len(hits) == 1:
            return hits[0]
    if text.isdigit() and 1 <= int(text) <= len(labels):
        return labels[int(text) - 1]
    raise DataError(f"columns: {one_of(text, labels, 'column')} A column can also be given by its position, "
                    "counted from 1.")


def _named_by_header(places: dict[str, Place], labels: Sequence[str], row: Units, notes: list[str],
                     without: Sequence[str]) -> None:
    """Add the channels that the header names, where the user has not named them, or wants to do `without`."""
    found, named = dict[str, list[Place]](), {*CHANNELS} & {*places}  # who names one need not want another
    measured = named - {"v"}
    for label in labels:
        if hit := classify(first_of_its_name(label, labels), row[label]):
            place = Place(label, hit.unit or _default(hit.channel), hit.unit is not None, hit.score)
            found.setdefault(hit.channel, []).append(place)
    for channel, hits in found.items():
        best = [p for p in hits if p.score == max(h.score for h in hits)]
        best = [p for p in best if p.unit.factor == 1.0] or best
        # Of several measured inputs nobody knows which one acts on the motor.
        spare = channel in MEASURED_INPUTS or ((best[0].score <= 1 or measured) and channel not in ("t", "v"))
        names = " and ".join(f"'{p.column}'" for p in best)
        if len(best) > 1 and measured and channel in CHANNELS and channel not in (*places, *without):
            notes.append(f"not used: {names}, which look equally like {_MEANING[channel]} ({channel}).")
            continue
        if channel in places or channel in without or (len(best) > 1 and spare):
            notes += [f"'{p.column}' is not used, '{places['t'].column}' is." for p in best if channel == "t" in places]
            continue
        if len(best) > 1:
            speed = " If 'v' is the speed: columns={'v': 'u', 'omega': 'v'}." * (names.lower() == "'u' and 'v'")
            raise DataError(f"{names} look equally like {_MEANING[channel]} ({channel}); say which one "
                            f"is meant, e.g. columns={{'{channel}': '{best[0].column}'}}.{speed}")
        places[channel] = best[0]
        more = f"also took '{best[0].column}' as {_MEANING[channel]} ({channel}); --ignore {channel} leaves it out."
        notes += [more] * bool(named and channel in CHANNELS)
        notes += [f"'{p.column}' looks like {_MEANING[channel]}, too; '{best[0].column}' is used."
                  for p in hits if p is not best[0] and p.score == best[0].score]


def first_of_its_name(label: str, labels: Sequence[str]) -> str:
    """Return the label without the number that tells it from others of the same name."""
    name = label.rpartition(" (")[0]
    return name if label.endswith(")") and label[len(name) + 2:-1].isdigit() and name in labels else label


def _last_resorts(places: dict[str, Place], labels: Units, values: Mapping[str, Array], notes: list[str],
                  asked: set[str]) -> None:
    timed = [c for c, unit in labels.items() if c.lower() in _DATES or (unit and unit.dimension == "time")]
    if "t" not in places and timed:
        places["t"] = Place(timed[0], labels[timed[0]] or _default("t"), labels[timed[0]] is not None, 1.0)
    if not {"i", "omega", "theta"} & set(places) and "y" in labels:
        places["omega"] = Place("y", _default("omega"), False)
        notes.append("took column 'y' as the speed; if it is not, say which channel it is with columns.")
    duty, supply = [c for c in labels if is_duty(c)], [c for c in labels if is_supply(c)]
    if len(duty) == 1 and not supply and "v" in places and not {"v", places["v"].column} & asked and (
            _range(places["v"].column, values) < STEADY < _range(duty[0], values)):  # it is the supply's
        supply = [places.pop("v").column]
    if "v" not in places and len(duty) == len(supply) == 1:
        unit, (top, whole) = unit_in(duty[0])[1], _reach(duty[0], values)
        ratio = unit if unit and unit.dimension == "ratio" else Unit("ratio", 1 / whole, "1", f"1/{whole:.4g}")
        scale = unit_in(supply[0])[1] or _default("v")
        product = Unit("voltage", ratio.factor * scale.factor, "V", f"{ratio.label}·{scale.label}")
        places["v"] = Place(duty[0], product, True, times=supply[0])
        whole_is = "" if ratio is unit else f" (reaches {top:.4g}, of {whole:.4g})"
        notes.append(f"took '{duty[0]}'{whole_is} times '{supply[0]}' as the drive voltage.")


def _range(column: str, values: Mapping[str, Array]) -> float:
    """Return how far a column ranges, over its largest size."""
    known = [y for y in values.get(column, ()) if math.isfinite(y)] or [0.0]
    return (max(known) - min(known)) / (max(map(abs, known)) or 1)


def _reach(duty: str, values: Mapping[str, Array]) -> tuple[float, float]:
    """Return how far a duty cycle goes, and which number stands for all of the supply."""
    top = max((abs(y) for y in values.get(duty, ()) if math.isfinite(y)), default=0.0)
    return top, 100 if _PERCENT.search(duty.lower()) else next((n for n in _WHOLE if top <= n), top)


def _apply_units(places: dict[str, Place], labels: Sequence[str], units: Mapping[str, object],
                 notes: list[str]) -> None:
    for key, text in units.items():
        channel = key if key in places else next((c for c, p in places.items() if p.column == key), None)
        if channel is None:
            why = ("no column was recognised as this channel; name it with columns" if key in DIMENSIONS else
                   "this column is not used as a channel" if key in labels else
                   one_of(str(key), [*places, *(p.column for p in places.values())], "channel or column"))
            raise DataError(f"units for '{key}': {why}")
        was, unit = places[channel], require_unit(text, channel)
        if was.stated and not math.isclose(abs(was.unit.factor), abs(unit.factor)):
            notes.append(f"'{was.column}' says {was.unit.label}, and is read as {unit.label}: units asks for it.")
        times = was.times if unit.dimension == "ratio" else None  # volts of a duty cycle are said for one supply
        scale = times and (unit_in(times)[1] or _default("v"))
        unit = replace(unit, factor=unit.factor * scale.factor, symbol="V") if scale else unit
        places[channel] = replace(was, unit=unit, stated=True, times=times)
    theta, omega = places.get("theta"), places.get("omega")
    if theta and omega and theta.unit.dimension == "length" and not omega.stated:
        places["omega"] = replace(omega, unit=Unit("linear speed", 1.0, "m/s", "m/s"))


def _require(places: Mapping[str, Place], labels: Sequence[str], values: Mapping[str, Array]) -> None:
    missing = {c: f"{_MEANING[c]} ({c})" for c in ("t", "v") if c not in places}
    if not {"i", "omega", "theta"} & set(places):
        missing["omega"] = "a measured current (i), speed (omega) or angle (theta)"
    if not missing:
        return
    duty = [c for c in labels if is_duty(c)] if "v" in missing else []
    top, whole = _reach(duty[0], values) if duty else (0.0, 1)
    more = (f" '{duty[0]}' is a duty cycle; with a constant supply of, say, 12 V ('12 V' for 0 to 1, '0.12 V' for per "
            f"cent, '0.047 V' for 0 to 255; it reaches {top:.4g} here): columns={{'v': '{duty[0]}'}}, "
            f"units={{'v': '{12 / whole:.2g} V'}}.") if duty else ""
    if "v" in missing and (i := places.get("i", places.get("tau_load"))):
        more += (f" If '{i.column}' is what commands a drive with a current loop of its own: "
                 f"columns={{'v': '{i.column}'}}, with mi.torque_driven() (--drive torque).")
    used = {*duty, *(p.column for p in places.values())}
    untimed = " Samples a fixed time apart need no column of time: dt=0.001 says how far, s." * ("t" in missing)
    stated = {c: unit for c in labels for _, unit, sure in [unit_in(c)] if unit and sure}
    free = [c for c in labels if c not in used and not is_reference(c) and c in (values or labels)
            and (c not in stated or stated[c].dimension in DIMENSIONS["v"])]
    free.sort(key=lambda c: not _DRIVES.search(c.lower()))
    asked = [c for c in missing if c != "v" or not more or (free and not duty)]
    raise DataError(f"no column looks like {', nor like '.join(missing.values())}. "
                    f"{_say_which(labels, asked, free)}{more}{untimed}")


def _say_which(labels: Sequence[str], channels: Sequence[str], free: Sequence[str]) -> str:
    if list(labels) == [str(k + 1) for k in range(len(labels))]:
        return (f"The file has no header, so name its {len(labels)} columns by position, counted from 1: "
                "columns={'t': 1, 'v': 2, 'omega': 3}.")
    listed = ", ".join(f"'{c}'" for c in labels[:20]) + (" ..." if len(labels) > 20 else "")
    example = ", ".join(f"'{c}': '{column}'" for c, column in zip(channels, [*free, "...", "...", "..."], strict=False))
    return f"Columns here: {listed}." + (f" Say which is which, e.g. columns={{{example}}}." if channels else "")


def _default(channel: str) -> Unit:
    dimension = DIMENSIONS[channel][0]
    return Unit(dimension, 1.0, SI[dimension], SI[dimension])


def parse_pairs(text: str, what: str) -> dict[str, str]:
    """Read ``t=time,v=u_volt,omega=speed`` as it is written on a command line."""
    pairs: dict[str, str] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, value = (s.strip() for s in part.partition("="))
        if not (equals and name and value):
            raise UsageError(f"{what}: expected name=value pairs with commas between, like t=time,v=u_volt; "
                             f"cannot read '{part}'.")
        if name in pairs:
            raise UsageError(f"{what}: '{name}' is given twice, as '{pairs[name]}' and as '{value}'.")
        pairs[name] = value
    if not pairs:
        raise UsageError(f"{what}: expected name=value pairs like t=time,v=u_volt; got nothing.")
    return pairs

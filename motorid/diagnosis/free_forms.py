"""Which free forms there are, and what functions they are made of.

Cosines over the range of a time or an angle, waves and parts of a turn or of what repeats in it, powers with jumps and
kinks at zero for what has a sign; for what remembers, first-order lags of many lengths: a sum of them comes near any
fading memory (Laguerre and Kautz models: Wahlberg, IEEE Trans. Automatic Control 36(5), 1991)."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np

from motorid.channels import COMPUTED_INPUTS
from motorid.diagnosis.score_test import by_record
from motorid.diagnosis.thresholds import CONTAINED
from motorid.effects import LIBRARY
from motorid.errors import SimulationError
from motorid.estimation.angle_orders import likely_lines, uses_angle
from motorid.estimation.linearisation import Response, Tangent, parameter_vector, responses
from motorid.estimation.result import Fit
from motorid.model.equations import System
from motorid.numerics.signals import Array, despiked
from motorid.problem.problem import Problem
from motorid.problem.runs import angle_signal, time_since
from motorid.records.experiment import Experiment

ON = 0.05  # of the largest voltage: a level by itself
KNOTS = 9  # cosines over the range of a time, twice as many over that of an angle
HARMONICS = 12  # of a turn
LINES = 2  # of the spectrum of the misfit over the angle, or the time
FINEST = 64  # parts of a turn in which lines that are no orders of it are looked for
AROUND = 31  # frequencies that such a line stands out of
PLACES = 12  # over a time or an angle at which something may set in
USUAL = 0.998  # of the samples of a channel: no lone one tells how far it reaches
SECTORS = 4  # widths of a sector of a turn, each twice the one before
LOBES = (0.15, 0.3, 0.6)  # rad: half of the width of a lobe, and of its edges
EDGE = 10.0  # how many of its edges, from one to zero, a sector is wide
SOFTEST = 100.0  # width of an edge, rad: as good as a Gaussian lobe
SUDDEN = 60.0  # how quickly a curve over the time or the angle may step, per range
FADES = (1, 3, 10, 30)  # lengths in a range of what fades over a time or a distance
SOON = (3, 10, 30, 100, 300)  # the same of what fades after each switching
STILL = 0.02  # of the highest speed: slower is standstill
SHARP = 1e-3  # of the highest speed: below it a direction is not known
SOFT = 0.01  # of the largest current or voltage: the width of a jump at zero
BENDS = (0.25, 0.08)  # of the largest speed, current or voltage: within which a curve bends
KNEES = 9  # of a speed, current or voltage of either sign, beyond which something sets in
BOTH_WAYS = 0.5  # of the larger side that the smaller one reaches at least: both are known alike
FINER = 4  # times as many places and knees in a curve that is fitted: what is narrow stands between the few
WHERE = {"torque": "mechanical", "transmission": "mechanical", "voltage": "electrical", "both": "electrical",
         "coupling": "mechanical", "load": "mechanical", "sensor": "sensor"}
LOADS = {"load": "r_load", "far": "r_far", "geared": "r_gap", "slip": "r_slip", "free": "r_free"}  # of states; share
COUPLED = ("twist", "slip", "load speed")  # what is known of the load where the model has one
CHANGES = {"t": "changes with the time", "distance": "changes with the distance run",
           "turn": "changes with the angle within a turn", "theta": "changes with the angle",
           "omega": "changes with the speed", "i": "changes with the current", "v": "changes with the voltage",
           "load": "changes with the power drawn", "twist": "changes with its twist", "slip": "changes with its slip",
           "load speed": "changes with the speed of the load", "run": "differs from run to run",
           "past i": "depends on the current before", "past omega": "depends on the speed before",
           "past v": "depends on the voltage before", "path": "depends on the distance since a reversal",
           "past speed": "depends on how fast it ran before", "past power": "depends on how fast it ran before",
           "past load": "depends on the power drawn before", "past braking": "depends on the power fed back before",
           "past heat": "depends on the heat of the current before", "past size": "depends on the voltage before",
           "most i": "depends on the largest current so far",
           "since_change": "depends on how long the voltage has not changed",
           "since_switch": "depends on how long the voltage has been on or off",
           "since_reversal": "depends on the time since the voltage was reversed"}
PAST = (*(on for on in CHANGES if on.startswith("past ")), "path")
MEMORIES = 8  # lengths of memory
SWINGS, OVERTONES, PADDED = 4, 5, 4  # periods a record (what is slower drifts); waves of a swing; times its length
TRIPS = (0.02, 0.05, 0.1, 0.2, 0.4)  # of the largest heat: where a fuse or a derating sets in
PLAY = (0.01, 0.4)  # of the largest value: half of the least and of the largest play
DAMPED = 0.1  # share of the critical damping with which what swings begins
LASTING = 10.0  # times the longest run: a memory that forgets nothing in it


@dataclass(frozen=True)
class Form:
    """A free function of the quantity `on` times `carrier`, in one balance; `words` says what that is. In the balance
    ``"sensor"`` it is added to the output `channel`; ``"both"`` is the motor constant, which makes torque of current
    and voltage of speed. A `zeroed` one is over an angle, or swings over a time, whose zero is another in every run."""

    words: str
    balance: str
    on: str
    carrier: str = ""
    channel: str = ""
    zeroed: bool = False

    @property
    def text(self) -> str:
        """What it is, in words."""
        zero = " in waves whose phase is another in every run" if self.on == "t" else ", its zero another in every run"
        return f"{self.words} that {CHANGES[self.on]}{zero * self.zeroed}"

    @property
    def swings(self) -> str:
        """Which of a span's rates its waves over the time have, whose phase is another in every run; empty for none."""
        shares = self.balance == "both" or self.carrier in ("v", "i", "omega")
        return ("beat" if shares else "swing") if self.zeroed and self.on == "t" else ""

    @property
    def local(self) -> bool:
        """Tell whether what is learnt of it on some runs says nothing of others."""
        return self.on in ("theta", "run")

    @property
    def remembers(self) -> bool:
        """Tell whether it is a function of what was before."""
        return self.on in (*PAST, *COMPUTED_INPUTS)

    @property
    def bends(self) -> bool:
        """Tell whether the square of what was before counts, too: a fluid that follows late, a thermistor."""
        fluid = self.balance == "torque" and self.carrier != "direction" and self.on in ("past omega", "past power")
        return fluid or self.on == "past heat"


_PUSHES = (  # words, balance, carrier, quantities
    ("a friction", "torque", "direction", ("turn", "theta", "t", "distance", "i", "v", "run", "past speed",
                                         "past power", "past heat", "most i", *COMPUTED_INPUTS)),
    ("a load", "torque", "", ("turn", "theta", "t", "run")),
    ("a drag", "torque", "omega", ("t", "distance", "turn", "theta", "i", "run", "past speed", "past power",
                                 "past heat")),
    ("a windage", "torque", "fan", ("t", "theta")),
    ("a torque", "torque", "", ("omega", "i")),
    ("an inertia", "torque", "acceleration", ("turn", "theta", "run", "omega", "most i")),
    ("a transient from each run's initial state, or an inertia", "torque", "acceleration", ("t",)),
    ("a loss of voltage", "voltage", "", ("omega", "v", "i", "t", "run")),
    ("a gain of the voltage", "voltage", "v", ("t", "turn", "load", "past load", "past braking",
                                                   "past heat", *COMPUTED_INPUTS)),
    ("a resistance", "voltage", "i", ("t", "turn", "theta", "omega", "load", "run", "past heat", *COMPUTED_INPUTS)),
    ("a motor constant", "both", "", ("t", "turn", "theta", "omega", "i", "run", "past i", "past size", "most i")))
FORMS = (*(Form(words, balance, on, carrier) for words, balance, carrier, quantities in _PUSHES for on in quantities),
         *(Form("a torque of the coupling to the load", "coupling", on) for on in COUPLED[:2]),
         Form("a torque behind the coupling", "load", "load speed"),
         *(Form("a gain of the speed sensor", "sensor", on, "omega", "omega") for on in ("turn", "t", "i")),
         *(Form("a gain of the current sensor", "sensor", on, "i", "i") for on in ("t", "past heat")),
         *(Form("an error of the angle sensor", "sensor", on, "", "theta")
           for on in ("path", "turn", "theta", "omega", "i")),
         *(Form("an error of the speed sensor", "sensor", on, "", "omega") for on in ("omega", "i", "t")),
         *(Form("an error of the current sensor", "sensor", on, "", "i") for on in ("i", "v", "omega", "t", "turn")),
         *(Form("a loss of voltage", "voltage", f"past {c}") for c in ("v", "i", "omega")),
         *(Form("a torque", "torque", on) for on in ("past i", "past omega", "path")),
         *(Form("an error of the current sensor", "sensor", f"past {c}", "", "i") for c in ("i", "v", "heat")),
         *(Form("an error of the speed sensor", "sensor", f"past {c}", "", "omega") for c in ("omega", "i")))


@dataclass(frozen=True)
class Span:
    """What a form reaches over: the range of every quantity, the orders of a turn, the time between samples (s); how
    many places and knees it has, for each of the few by which forms are compared; how often it repeats in a turn."""

    ranges: Mapping[str, tuple[float, float]]
    orders: tuple[float, ...]
    step: float
    finer: int = 1
    rates: Mapping[str, Sequence[float]] = field(default_factory=dict)  # of waves over the time, rad/s, or the angle
    pitches: int = 1
    unscaled: tuple[str, ...] = ()  # channels the gain of whose sensor the motor's own parameters make up
    load: str = ""  # of `LOADS`

    def rate(self, form: Form) -> float:
        """Rate of the strongest wave of what swings, rad/s; 1 of all else."""
        return next(iter(self.rates.get(form.swings, ())), 1.0)


def span_of(fit: Fit, signals: Sequence[Mapping[str, Array]]) -> Span:
    """Return the extremes of every quantity known in all runs, and orders of a turn: low, the model's, the misfit's."""
    names = set.intersection(*(set(s) for s in signals))
    step = float(np.median(np.concatenate([np.diff(s["t"]) for s in signals])))
    ranges = {n: (min(float(s[n].min()) for s in signals), max(float(s[n].max()) for s in signals)) for n in names}
    for c in ranges.keys() & {*fit.problem.outputs} - {"theta"}:  # a model that lacks something may not get so far
        seen = np.concatenate([despiked(r.outputs[c]) for r in fit.problem.experiments if c in r.outputs])
        least, most = np.quantile(seen, [0.5 - USUAL / 2, 0.5 + USUAL / 2]).tolist()
        ranges[c] = min(ranges[c][0], least), max(ranges[c][1], most)
    known = [fit.values[p.name] for e in fit.model.effects for p in e.parameters if p.order]
    lines = likely_lines(Tangent.of(fit), LIBRARY["cogging"], LINES) if "theta" in fit.problem.outputs else []
    orders = {*range(1, HARMONICS + 1), *(round(k * n) for n in known for k in range(1, 5)),
              *(round(line.order) for line in lines)}
    rates = {"t": _rates(fit, times := [s["t"] for s in signals], step),
             **{name: _rates(fit, times, step, SWINGS, name == "beat") for name in ("swing", "beat")}}
    if "theta" in ranges:  # a belt, a gear's slow shaft: whole orders of a turn are its own
        travel = float(np.ptp(ranges["theta"]))
        cell = max(2 * np.pi / FINEST, travel / max(len(s["theta"]) for s in signals))
        found = _rates(fit, [s["theta"] for s in signals], cell)
        rates["theta"] = [w for w in found if abs(w - round(w)) * travel > 2 * np.pi]
    free, moving = set(fit.problem.model.free_names), len({"omega", "theta"} & {*fit.problem.outputs})
    unscaled = tuple(c for c, own in (("i", "RLbJ"), ("omega", "KbJ")) if free >= {*own} and (c == "i" or moving == 1))
    return Span(ranges, tuple(sorted(orders)), step, rates={n: w[:LINES] for n, w in rates.items()}, unscaled=unscaled,
                load=load_of(fit.problem.system))


def load_of(system: System) -> str:
    """Return which of `LOADS` a model has, none as an empty string."""
    return next((n for n, share in LOADS.items() if f"omega_{n}" in system.states and share in system.parameters), "")


def _rates(fit: Fit, along: Sequence[Array], step: float, least: int = 0, shares: bool = False) -> list[float]:
    """Return the rates of lines over a quantity that stand out of the spectrum of the misfit, or of its shares of what
    is simulated, the strongest first; those of at `least` so many periods by less: each has to prove itself."""
    from scipy.ndimage import median_filter  # slow to import, and not needed before

    finer, chance, longest = *((PADDED, 1.0) if least else (1, 2.0)), max(float(np.ptp(z)) for z in along)
    length = finer << int(longest / step + 1).bit_length()
    power = np.zeros(length // 2 + 1)
    for run, sim, z in zip(fit.problem.runs, fit.simulations, along, strict=True):
        even = z.min() + step * np.arange(max(np.ptp(z) // step, 1))
        for c, sigma in run.sigma.items():
            known = np.flatnonzero(np.isfinite(residual := sim.residual(c)))
            rows = known[np.argsort(z[known], kind="stable")]
            each = residual * (y / float(np.std(y)) if shares and np.std(y := sim.outputs[c]) else 1.0)
            error = np.interp(even, z[rows], each[rows]) / sigma
            power += np.abs(np.fft.rfft((error - error.mean()) * np.hanning(len(even)), length)) ** 2
    around = np.log(2) * power / np.maximum(median_filter(power, AROUND * finer), 1e-300)  # of noise, 1 in the mean
    around[: round(least * length * step / longest) or KNOTS + 2] = 0.0  # cosines over the range do that
    top = (around[1:-1] >= around[:-2]) & (around[1:-1] >= around[2:]) & (around[1:-1] > chance * np.log(length))
    return [float(2 * np.pi * k / (length * step)) for k in sorted(1 + np.flatnonzero(top), key=lambda k: -power[k])]


def shown(form: Form, fit: Fit, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Tell whether the records can show a form: its quantity is known, its balance is in the model."""
    outputs = set(fit.problem.outputs)
    if form.channel and not (form.channel in outputs and len(outputs) > 1):
        return False  # one sensor needs another to be told wrong
    if form.channel == "omega" and form.carrier and not {"theta", form.on} & outputs:
        return False  # a gain is the motor constant's, unless the motion is measured twice, or that makes torque, too
    if form.on not in ranges or ranges[form.on][0] == ranges[form.on][1] or (
            form.on == "run" and own_levels(fit.problem.experiments)):
        return False
    if form.on == "path":  # both ways, by more than the creep of a smooth sgn or the ripple of a start
        low, high = ranges["omega"]
        if min(-low, high) <= STILL * max(-low, high):
            return False
    of_the_drive = form.balance == "voltage" and (
        form.on in ("v", "past v") or (form.carrier == "v" and form.on in ("t", *COMPUTED_INPUTS)))
    if "i" not in outputs and not of_the_drive and (form.balance in ("voltage", "both") or form.on in ("i", "v")):
        return False  # there a torque over the speed, or a loss of voltage, says the same
    if (form.remembers or form.on in ("distance", "run")) and fit.window is not None:
        return False  # what was before a window is not known
    return form.on != "turn" or not fit.problem.linear


def own_levels(runs: Sequence[Experiment]) -> bool:
    """Tell whether every run has one voltage, on or off, of its own: what is another in each is any law of that."""
    sizes = [np.abs(run.inputs["v"]) for run in runs]
    ends = [np.quantile(on if (on := v[v > ON * v.max()]).size else v, [ON, 1 - ON]) for v in sizes]
    return all(high - low <= ON * high for low, high in ends) and len({f"{high:.1e}" for _, high in ends}) > 1


Z = re.compile(r"\bz\b")
NUMBERS = {"ca": np, "m": SimpleNamespace(sign=np.sign)}  # for a source without a `PLACE`
# Of what bends, sets in or fades, with its limits, and its unit where that is another: a curve may move it.
PLACE = re.compile(r"<(\S+) (\S+) (\S+?)(?: (\S+))?>")


def _place(value: float, low: float, high: float, unit: str = "") -> str:
    return f"<{f'{value:.9g} {low:.9g} {high:.9g} {unit}'.rstrip()}>"


def functions_of(form: Form, span: Span) -> list[str]:
    """Return the functions of a form as source in its quantity z; where they bend, set in or fade is a `PLACE`."""
    low, high = span.ranges[form.on]
    if form.on == "run":
        return ["1.0"]
    if form.swings:
        return _swung(span.rate(form), span) if span.rates[form.swings] else ["0.0"]
    if form.on == "turn":
        waves = ["1.0", *(f"ca.{f}({k:.6g} * z)" for k in waves_of(span) for f in ("sin", "cos"))]
        plain = form.carrier == "acceleration" or span.finer == 1  # none jumps, and forms compare better by few
        load = form.balance == "torque" and not form.carrier
        return waves if plain else waves + _sectors(PLACES * span.finer, span.pitches, load)
    if form.on in PAST:
        lengths = memories_of(form, span)
        lags = [f"past(z, {_place(length, lengths[0] / 10, lengths[-1] * 10)})" for length in lengths]
        top = f"{max(abs(low), abs(high)):.6g}"
        ways = float(top) * np.asarray(lengths) if form.on == "past omega" and span.finer > 1 else []
        slips = [f"(z - drag(z, {_place(w, w / 100, w * 100, 'rad:slip')}))" for w in ways]  # water in a drum
        bent = [f"{lag} * ca.fabs({lag}) / {top}" for lag in (*lags, *slips) if form.bends]
        if form.carrier:
            trips = [f"ca.fmax({lag} / {top} - {_place(level, 0, 1, '1')}, 0)" for lag in lags if form.on == "past heat"
                     for level in TRIPS]
            return [f"{lag} / {top}" for lag in (*lags, *bent)] + trips + ["1.0"]
        return lags + bent + _sided(form, lengths, max(abs(low), abs(high))) + _swinging(form, lengths, span.finer)
    if form.on in COMPUTED_INPUTS:
        found = ["1.0"]
        for sign, reach in (("", high), ("-", -low)):
            if reach > span.step:  # what lasts for some samples, or fades
                steps = np.unique(np.round(np.geomspace(span.step, reach, PLACES * span.finer**3) / span.step))
                found += [f"({sign}z > {span.step * k:.9g})" for k in (0, *steps[:-1])]
                fades = (_place(reach / k, min(span.step, reach / k), reach) for k in SOON)
                found += [f"({sign}z > 0) * ca.exp(-ca.fabs(z) / {fade})" for fade in fades]
        return found
    found = (_along if form.on in ("theta", "t", "distance") else _of_size)(form, span, low, high)
    if form.carrier != "acceleration" and not form.channel == form.on in span.unscaled:
        return found
    middle = f"{0.5 * max(low, high, key=abs) if form.on in ('i', 'omega') else 0.5 * (low + high):.9g}"
    there = {f: at if PLACE.search(at := Z.sub(f"({middle})", f)) else f"{eval(at, NUMBERS):.9g}" for f in found}
    if form.carrier == "acceleration":  # there the motor's own J is the inertia
        return [f"({f} - {at})" for f, at in there.items()]
    return ["1.0", *(f"({f} - z / ({middle}) * {at})" for f, at in there.items() if f not in ("1.0", found[1]))]  # 1: z


def _sided(form: Form, lengths: Array, top: float) -> list[str]:
    """Return functions of what does not come back the way it went, as source: play, ramps, what feels a change."""
    z, sensor = form.on.removeprefix("past "), form.balance == "sensor"
    if z == "path":
        return [f"slew(z, {_place(r, r / 10, 10 * r, '1/rad')})" for r in 1 / lengths]
    if not (form.channel == z if sensor else (form.balance, z) == ("voltage", "v")):
        return []
    unit, rate = {"v": ("V", "V/s"), "i": ("A", ""), "omega": ("rad/s", "rad/s²")}[z]
    found = [f"(z - play(z, {_place(w, w / 10, top, unit)}))" for w in top * np.geomspace(*PLAY, len(lengths))]
    if sensor:
        places = [_place(length, lengths[0] / 10, lengths[-1] * 10) for length in lengths]
        found += [f"(z - {f}(z, {place}))" for f in ("past", "hold") for place in places]
    rates = top / np.geomspace(lengths[0], lengths[-1], 3 * len(lengths)) if rate else []  # no amplifier is so slow
    return found + [f"(z - {'slew' if sensor else 'ramp'}(z, {_place(r, r / 10, 10 * r, rate)}))" for r in rates]


def _swinging(form: Form, lengths: Array, finer: int) -> list[str]:
    """Return functions of what swings when pushed, a mass on a spring or an LC filter, and of its rate, as source."""
    z = form.on.removeprefix("past ")
    if finer == 1 or z not in ("v", "i", "omega") or form.channel == z:  # a sensor's own filter is of the library, and
        return []  # forms compare better by few
    direct = (form.balance, z) == ("voltage", "v")  # no parameter of the motor makes that up
    rates = 1 / np.geomspace(lengths[0] / 2, lengths[-1], 3 * len(lengths))
    damped = _place(DAMPED, 1e-3, 0.99, "1:damped")
    places = [f"z, {_place(w, w / 10, 10 * w, 'rad/s')}, {damped}" for w in rates]
    return [f for at in places for f in (f"(z - swing({at}))" if direct else f"swing({at})", f"sway({at})")]


def _along(form: Form, span: Span, low: float, high: float) -> list[str]:
    """Return functions of a time, an angle or a distance, as source: waves, and what sets in, grows or fades."""
    scale = f"{np.pi / (high - low):.9g} * (ca.fmin(ca.fmax(z, {low:.9g}), {high:.9g}) - {low:.9g})"
    centres = [_place(c, low, high) for c in np.linspace(low, high, PLACES * span.finer + 2)[1:-1]]
    steep = f"{SUDDEN * span.finer / (high - low):.6g}"
    sudden = [f"ca.tanh((z - {c}) * {steep})" for c in centres if form.carrier != "acceleration" or form.on == "t"]
    top = f"{max(abs(low), abs(high)):.6g}"  # a slope, a spring that hardens, a stop, a slack, a ramp
    sudden += [*(f"(z / {top})**{k}" for k in (1, 2, 3)), *(f"ca.fmax((z - {c}) / {top}, 0)" for c in centres)]
    unit, reach = "rad/s" if form.on == "t" else "1:wave", 2 * np.pi / (high - low)
    sudden += [_wave(w, reach, phase, 4, unit) for w in span.rates.get(form.on, ()) for phase in (0, np.pi / 2)]
    if form.on != "theta":  # what warms up, or runs in
        whole = high - low
        sudden += [f"ca.exp(-z / {_place(whole / k, whole / 300, whole * 10)})" for k in FADES]
    return ["1.0", *(f"ca.cos({k} * {scale})" for k in range(1, (1 + (form.on == "theta")) * KNOTS)), *sudden]


def _wave(rate: float, reach: float, phase: float, around: float, unit: str = "rad/s") -> str:
    """Return what swings, or repeats, by itself, as source; its rate and its phase may be moved by so much."""
    places = _place(rate, rate - reach, rate + reach, unit), _place(phase, phase - around, phase + around, "rad:phase")
    return f"ca.sin({places[0]} * z + {places[1]})"


def _swung(rate: float, span: Span) -> list[str]:
    """Return what swings at a rate, with overtones, and what is switched on and off at it, as source."""
    reach, quarters = 2 * np.pi / float(np.ptp(span.ranges["t"])), np.arange(8) * np.pi / 4
    waves = [_wave(k * rate, reach, phase, 4) for k in range(1, OVERTONES + 1) for phase in (0, np.pi / 2)]
    levels = [_place(level, -0.99, 0.99, "1:level") for level in (-0.7, 0.0, 0.7) if span.finer > 1]
    return waves + [f"ca.tanh({SUDDEN} * ({_wave(rate, 0.1 * rate, phase, 1)} - {level}))"
                    for phase in quarters for level in levels]


def _of_size(form: Form, span: Span, low: float, high: float) -> list[str]:
    """Return functions of a speed, a current or a voltage, as source: powers, jumps and bends."""
    top = max(abs(low), abs(high))
    if min(-low, high) > BOTH_WAYS * top:  # what one side shows of the last bit may hold on the other
        low, high = -top, top
    s = f"(ca.fmin(ca.fmax(z, {low:.9g}), {high:.9g}) / {top:.6g})"
    size = f"ca.fabs{s}"
    moved = form.carrier == "direction" or form.channel == form.on in span.unscaled
    bends = [_place(bend, SOFT, 1) if moved else bend for bend in BENDS]
    smooth = [s, f"{s}**2", f"{s}**3", *(f"ca.tanh({s} / {bend})" for bend in bends)]
    sides = [sign for sign, reach in (("", high), ("-", -low)) if reach > 0]
    knees = [_place(c, 0, 1) for c in np.linspace(0, 1, KNEES * span.finer + 2)[1:-1]]
    smooth += [f"ca.fmax({sign}{s} - {c}, 0)" for sign in sides for c in knees]
    level, wide = size if form.carrier else s, _place(SOFT, SOFT**2, 1)  # of what is switched there
    both = low < 0 and not form.carrier
    if (span.finer > 1 and form.on != "load") or form.on == "most i":  # others compare better by few
        smooth += [f"(ca.tanh(({s} - {c}) / {wide}) + ca.tanh(({s} + {c}) / {wide}))" if both else
                   f"ca.tanh(({level} - {c}) / {wide})" for c in knees]
        smooth += [f"ca.tanh(({sign}{s} - {c}) / {wide})" for sign in sides for c in knees if both]
    if form.channel == form.on:  # what is small is not read
        least = np.geomspace(SOFT, BOTH_WAYS, KNEES * span.finer)
        smooth += [f"{s} * (1 - ca.tanh(({size} - {_place(c, 0, 1)}) / {wide}))" for c in least]
    if not low < 0 < high:
        return ["1.0", *smooth]
    smooth += [f"(ca.fmax({s} - {c}, 0) - ca.fmax(-{s} - {c}, 0))" for c in knees]  # the same either way
    jumps = ["m.sign(z)" if form.on in ("omega", "load speed") else f"ca.tanh(z / {SOFT * top:.6g})"]
    if form.on == "load" and form.carrier == "i":  # braking takes small powers: the jump is far narrower than that
        jumps = [f"ca.tanh(ca.fmax({sign}{s}, 0) / {_place(SOFT, SOFT**2, 1)})" for sign in sides]
    return [*jumps, *smooth, f"{s} * {size}", "1.0", size, f"{size}**3", *(f"ca.tanh({size} / {b})" for b in bends)]


def waves_of(span: Span) -> list[float]:
    """Return the orders of a turn that repeat as often as a span does."""
    own = {span.pitches * k for k in range(1, HARMONICS + 1)} if span.pitches > 1 else set()
    return sorted(own | {k for k in span.orders if k % span.pitches == 0})


def _sectors(count: int, pitches: int, load: bool) -> list[str]:
    """Return sectors and lobes of a pitch as source: a worn segment, a tooth; of a `load` also a catch, a cam."""
    sectors = [(c, w / 2, w / EDGE) for k in range(SECTORS) if (w := 2**k * 2 * np.pi / count) < 2
               for c in np.arange(count) * 2 * np.pi / count]
    lobes = [(c, w, w) for w in LOBES for c in np.arange(0, 2 * np.pi, 1.5 * w)]
    z, found = f"{pitches} * z" if pitches > 1 else "z", []
    for c, half, edge in sectors + lobes:
        at, wide = _place(c, c - 2 * half, c + 2 * half), _place(half, half / 4, min(4 * half, 3.0), "rad:wide")
        soft = _place(edge, 2 * np.pi / count / EDGE, SOFTEST, "rad:edge")
        inside = f"0.5 * (1 + ca.tanh((ca.cos({z} - {at}) - ca.cos({wide})) / ca.sin({wide}) / {soft}))"
        found += [inside, f"ca.sin({z} - {at}) / ca.sin({wide}) * {inside}"] if load and edge == half else [inside]
    return found


def memories_of(form: Form, span: Span) -> Array:
    """Return lengths of memory, from two samples to all of the longest run: s, or rad for the way since a reversal."""
    longest = span.ranges["t"][1]
    speed = max(map(abs, span.ranges["omega"])) if form.on == "path" else 1.0
    shortest, count = 2 * span.step, MEMORIES
    if form.on == "path":  # a reversal is slow
        shortest, longest, count = 0.1 * span.step, min(longest, 100 * span.step), MEMORIES * span.finer
    elif form.carrier:  # what runs in, or warms, sums up all that was
        longest *= LASTING
    return speed * np.geomspace(shortest, max(longest, 2 * shortest), count)


def past(z: Array, along: Array, length: complex, initial: float) -> Array:
    """Return `z` (N,) behind a first-order lag over `along` (N,), a time or a way; a complex `length` swings."""
    from scipy.signal import lfilter  # slow to import, and not needed before

    even = np.linspace(along[0], along[-1], len(along))
    kept = np.exp(-(even[1] - even[0]) / length) if even[-1] > even[0] else 1.0
    driven = np.interp(even, along, z)
    driven[1:] = 0.5 * (driven[1:] + driven[:-1])
    lagged, _ = lfilter([1 - kept], [1.0, -kept], driven[1:], zi=[kept * initial])
    return np.interp(along, even, np.concatenate([[initial], lagged]))


STEPS = {  # from the last value to the next: of what plays, is ramped up and falls at once, follows only so fast, jumps
    # up and falls late, or is dragged along by the square of its slip (both sides feel the same torque)
    "play": lambda last, z, width, dt: min(max(last, z - width), z + width),
    "ramp": lambda last, z, rate, dt: np.sign(z) * min(abs(z), max(last * np.sign(z), 0.0) + rate * dt),
    "slew": lambda last, z, rate, dt: min(max(z, last - rate * dt), last + rate * dt),
    "hold": lambda last, z, length, dt: z if abs(z) > abs(last) else z + (last - z) * np.exp(-dt / length),
    "drag": lambda last, z, way, dt: z + (last - z) / (1 + abs(last - z) * dt / way)}


def swings(z: Array, along: Array, rate: float, damping: float, initial: float) -> tuple[Array, Array]:
    """Return what swings at `rate` (rad/s), driven by `z` (N,) from rest at `initial`, and its rate over that."""
    pole = rate * complex(-damping, np.sqrt(1 - damping**2))
    lagged = past(z, along, -1 / pole, initial)  # x'' = rate² (z − x) − 2 damping rate x' is the pair of its poles
    return rate**2 / pole.imag * (lagged / -pole).imag, -rate / pole.imag * lagged.imag


def _stepped(kind: str, z: Array, t: Array, place: float, last: float) -> Array:
    """Return what follows `z` (N,) from sample to sample, beginning at `last`."""
    every = zip(z.tolist(), np.diff(t, prepend=t[0]).tolist(), strict=True)
    return np.array([last := STEPS[kind](last, value, place, dt) for value, dt in every])


def values_of(functions: Sequence[str], form: Form, signal: Mapping[str, Array]) -> Array:
    """Return functions of a form, given by their source, along one run, (N, m)."""
    z, along = signal[form.on], signal["distance" if form.on == "path" else "t"]
    first = float(z[0]) if form.on in ("past i", "past omega") else 0.0
    names = {"ca": np, "z": z, "m": SimpleNamespace(sign=lambda z: np.tanh(z / signal["width"][0])),
             "past": lambda z, length: past(z, along, length, first)}
    names |= {kind: lambda z, place, kind=kind: _stepped(kind, z, along, place, first) for kind in STEPS}
    names |= {kind: lambda z, rate, damping, k=k: swings(z, along, rate, damping, first)[k]
              for k, kind in enumerate(("swing", "sway"))}
    return np.column_stack([np.broadcast_to(np.asarray(eval(_compiled(f), names), float), z.shape) for f in functions])


def basis_of(form: Form, signal: Mapping[str, Array], span: Span) -> Array:
    """Return the form's functions, times its carrier, along one run, (N, m)."""
    z = signal[form.on]
    if form.on == "run":
        functions = (z[:, None] == np.arange(int(span.ranges["run"][1]) + 1)).astype(float)
    else:
        source = functions_of(form, span)
        functions = values_of(source, form, signal)
        if form.carrier == "acceleration" and form.on in ("turn", "theta"):  # kinetic energy changes with the angle
            step = NUDGE * (span.ranges[form.on][1] - span.ranges[form.on][0])
            there = values_of(source, form, {**signal, form.on: z + step})
            return functions * signal["acceleration"][:, None] + signal["energy"][:, None] * (there - functions) / step
    return functions * signal[form.carrier][:, None] if form.carrier else functions


BALANCES = ("voltage", "torque", "load")
STATES = {"torque": "omega", "voltage": "i"}  # whose rate a balance is
NUDGE = 1e-3  # of a size
_compiled = lru_cache(4096)(lambda f: compile(PLACE.sub(r"\1", f), "<form>", "eval"))  # every run asks for it
EXACT = 1e-12  # share of a square that sums of products still tell
UNBOUNDED = 1e9  # in units of the noise, per unit of what a form puts in


@dataclass(frozen=True, eq=False)
class Linear:
    """A model on records: its whitened residual, and how that answers to everything that might change."""

    residual: Array  # (n,)
    slopes: Array  # (n, number of free parameters)
    own: Array  # (n, number of estimated initial states), to half of the range in which each may lie
    forms: Sequence[Form]
    answer: Callable[[Form], Array]  # to a form, (n, number of coefficients); of all together they fill the memory


def linearised(fit: Fit, only: Form | None = None, span: Span | None = None,
               zeros: Mapping[str, float] | None = None) -> Linear:
    """Return the model of `fit` on its records with the forms that these can show, or `only` one over a span, begun at
    these `zeros` (`zeros_of`). SimulationError where its answer to small changes grows without bound."""
    problem = fit.problem
    residual, jac = _at(problem, fit)
    signals = signals_along(fit)
    span = span or span_of(fit, signals)
    zeros = zeros_of(fit, only) if only and only.swings and zeros is None else zeros
    if only and zeros:
        firsts = problem.unknowns.firsts
        signals = [{**s, only.on: s[only.on] + zeros.get(f"z_0[{k}]", 0.0) / span.rate(only)}
                   for s, k in zip(signals, firsts, strict=True)]
    forms = [f for f in FORMS if shown(f, fit, span.ranges)] if only is None else [only]
    free, n, runs = len(problem.model.free_names), problem.n_outputs, range(len(signals))
    seen = [replace(a, b=_with_load(fit, k, a), c=a.c * m.weights[:, None])
            for k, (a, m) in enumerate(zip(responses(fit), problem.measured, strict=True))]
    own = jac[:n, free:] * [reach if np.isfinite(reach := 0.5 * (p.upper - p.lower)) else 1.0
                            for p in problem.unknown[free:]]

    def answer(form: Form) -> Array:
        return np.vstack([_answer(problem, k, seen[k], form, basis_of(form, signals[k], span)) for k in runs])

    known = answer if only is None else {only: answer(only)}.__getitem__
    return Linear(residual[:n], jac[:n, :free], own, forms, known)


def _with_load(fit: Fit, k: int, answer: Response) -> Array:
    """Return what a voltage, a torque and one on the load push each state over a sample, (N-1, nx, 2 or 3)."""
    if not (load := load_of(system := fit.problem.system)):
        return answer.b
    inertia = fit.values["J"] * max(fit.values[LOADS[load]], SHARP)
    own = (np.eye(len(system.states)) + answer.a)[:, :, system.states.index(f"omega_{load}")]
    own *= (0.5 * np.diff(fit.problem.experiments[k].t) / inertia)[:, None]
    return np.concatenate([answer.b, own[:, :, None]], axis=2)


def _at(problem: Problem, fit: Fit) -> tuple[Array, Array]:
    """Return residual and slopes (SI) of the fitted model, without loss and priors."""
    first = {f"{c}_0[{k}]": float(y[0]) for k, s in enumerate(fit.simulations) for c, y in s.states.items()}
    values = {**first, **fit.initial, **fit.values}  # an angle begins where the encoder reads so, whatever its zero
    q = problem.scaling.scaled([values.get(p.name, p.value) for p in problem.unknown])
    problem = replace(problem, loss=None, priors={}, penalties=(), _runs=problem.refined(q).runs)
    residual, jac = problem.residual_and_jacobian(q)
    return residual, jac / problem.scaling.slope(q)


def signals_along(fit: Fit) -> list[dict[str, Array]]:
    """Return what a form may be a function of, along each run, (N,) each; ``"width"`` is that of the model's sgn."""
    return [_signals(fit, k) for k in range(len(fit.simulations))]


def _signals(fit: Fit, k: int) -> dict[str, Array]:
    run, sim, firsts = fit.problem.experiments[k], fit.simulations[k], fit.problem.unknowns.firsts
    record = np.full(run.n, float(sorted(set(firsts)).index(firsts[k])))  # parts of one are one
    found = {"t": run.t - run.t[0], "v": run.inputs["v"], "run": record, "width": np.ones(run.n)}
    found |= {c: np.asarray(sim.states[c]) for c in ("i", "omega") if c in sim.states}
    if "omega" in found:
        omega = found["omega"]
        top = max(float(np.abs(s.states["omega"]).max()) for s in fit.simulations)
        width = fit.values.get("sgn_width") or SHARP * top + 1e-300
        found["width"], found["direction"] = np.full(run.n, width), np.tanh(omega / width)
        found["acceleration"] = fit.values["J"] * np.gradient(omega, run.t)  # of a relative inertia
        found["energy"] = 0.5 * fit.values["J"] * omega**2
        gone = np.cumsum(0.5 * np.abs(omega[1:] + omega[:-1]) * np.diff(run.t))  # both directions counted
        if load := load_of(fit.problem.system):
            found["load speed"] = np.asarray(sim.states[f"omega_{load}"])
            found["slip"] = omega - found["load speed"]
            if f"twist_{load}" in sim.states:
                found["twist"] = np.asarray(sim.states[f"twist_{load}"])
        found["path"], found["distance"] = found["direction"], np.concatenate([[0.0], gone])
        found["past speed"], found["past power"], found["fan"] = np.abs(omega), omega**2, omega * np.abs(omega)
    if "i" in found:
        found["load"] = found["past load"] = found["v"] * found["i"]
        found["most i"] = np.maximum.accumulate(np.abs(found["i"]))
        found["past braking"] = np.maximum(-found["load"], 0.0)
        found["past size"], found["past heat"] = np.abs(found["v"]), found["i"] ** 2
    found |= {f"past {c}": found[c] for c in ("v", "i", "omega") if c in found}
    found |= {c: time_since(run, c) for c in COMPUTED_INPUTS}
    if "theta" in run.outputs or "omega" in run.outputs:
        found["theta"] = found["turn"] = angle_signal(run) + zero_of(fit, k)
    return found


def zero_of(fit: Fit, k: int) -> float:
    """Return the angle that the encoder of run `k` calls zero."""
    parameters = fit.problem.system.parameters
    return float(parameter_vector(fit, k)[parameters.index("z_0")]) if "z_0" in parameters else 0.0


def _answer(problem: Problem, k: int, seen: Response, form: Form, basis: Array) -> Array:
    """Return the whitened outputs of run `k` to every function of a form; `seen` is its response, whitened."""
    _, weights, index = problem.measured[k][:3]
    if form.balance == "sensor":  # added to one output
        out, j = np.zeros((len(basis), len(problem.outputs), basis.shape[1])), problem.outputs.index(form.channel)
        out[:, j] = basis * weights[j]
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            out = seen.driven(_pushes(form, basis, seen))
        if not np.all(np.abs(out) < UNBOUNDED * max(1.0, float(np.abs(basis).max(initial=0.0)))):  # or not a number
            raise SimulationError("the model's answer to small changes grows without bound along these records.")
    flat = out.reshape(-1, out.shape[2])
    return flat if index is None else flat[index]


def _pushes(form: Form, basis: Array, answer: Response) -> Array:
    """Return what a form's functions push on the states over each sample, (m, N-1, nx); only the voltage jumps."""
    shares = {"torque": -basis, "load": basis} if form.balance == "coupling" else {form.balance: basis}
    if form.balance == "both":
        shares = {"voltage": -answer.states["omega"][:, None] * basis, "torque": answer.states["i"][:, None] * basis}
    held = form.on in ("v", *COMPUTED_INPUTS) or form.carrier == "v"
    over = {k: (b[:-1] if held else 0.5 * (b[:-1] + b[1:])).T for k, b in shares.items()}
    return np.sum([b[:, :, None] * answer.b[:, :, BALANCES.index(k)] for k, b in over.items()], axis=0)


def form_coefficients(fit: Fit, linear: Linear, form: Form, kept: Sequence[int] | None = None) -> Array:
    """Return the coefficients of a form's functions, of all or those `kept`, that beside `fit` explain most."""
    columns, sizes = form_columns(fit, linear, form)
    first = linear.slopes.shape[1]
    chosen = list(range(len(sizes)) if kept is None else kept)
    together = np.column_stack([columns[:, :first], columns[:, first:][:, chosen], linear.own])
    found = ridge(together.T @ together, together.T @ linear.residual, linear.residual)
    return found[first : first + len(chosen)] * sizes[chosen]


def may_be_zeroed(fit: Fit) -> bool:
    """Tell whether records show a zero of each: one goes round, others a radian; nothing is over the angle yet."""
    signals, few = signals_along(fit), len(set(fit.problem.unknowns.firsts)) < 2
    if few or any("turn" not in s for s in signals) or any(map(uses_angle, fit.model.effects)):
        return False
    return min(travels := _travels(fit, signals)) > 1 and max(travels) > 2 * np.pi


def swinging(fit: Fit, forms: Iterable[Form]) -> list[Form]:
    """Return `forms` over the time, as waves whose phase is another in every run, that stand out of whole records."""
    known = fit.problem.unknowns
    if fit.window or known.apart or not 1 < len(set(known.firsts)) == len(known.firsts):
        return []
    rates = span_of(fit, signals_along(fit)).rates
    waves = (replace(f, zeroed=True) for f in forms if f.on == "t" and f.carrier != "acceleration")
    return [f for f in waves if rates[f.swings]]


def _travels(fit: Fit, signals: Sequence[Mapping[str, Array]]) -> list[float]:
    """Return how far every record goes, rad."""
    firsts = fit.problem.unknowns.firsts
    angles = [[s["turn"] for s, f in zip(signals, firsts, strict=True) if f == first] for first in sorted(set(firsts))]
    return [float(np.ptp(np.concatenate(parts))) for parts in angles]


def zeroed(fit: Fit, linear: Linear, form: Form) -> Linear:
    """Return a form with coefficients of its own on every record."""
    return replace(linear, answer={form: np.hstack(by_record(fit.problem, linear.answer(form)))}.__getitem__)


def zeros_of(fit: Fit, form: Form) -> dict[str, float]:
    """Return the zero of the angle in every record but the first, by name, rad: where its curve is most like the
    longest; of what swings, how far its strongest wave is ahead of the first one's."""
    signals, runs = signals_along(fit), sorted(set(fit.problem.unknowns.firsts))
    span = span_of(fit, signals)
    own = form_coefficients(fit, zeroed(fit, linearised(fit), form), form).reshape(len(runs), -1)
    if form.swings:
        phases = np.angle(own[:, 0] + 1j * own[:, :2][:, -1]).tolist()
        return {f"z_0[{k}]": phase - phases[0] for k, phase in zip(runs, phases, strict=True) if k}
    most, angle = int(np.argmax(_travels(fit, signals))), np.linspace(-np.pi, np.pi, 720, endpoint=False)
    waves = values_of(functions_of(form, span), form, {"turn": angle, "t": angle})
    curves = waves[:, 1:] @ own[:, 1:].T  # without the constant
    alike = np.fft.irfft(np.conj(np.fft.rfft(curves, axis=0)) * np.fft.rfft(curves[:, [most]], axis=0), axis=0)
    best = alike.argmax(axis=0)
    return {f"z_0[{k}]": float(angle[j] % (2 * np.pi) - np.pi) for k, j in zip(runs, best - best[0], strict=True) if k}


def form_columns(fit: Fit, linear: Linear, form: Form) -> tuple[Array, Array]:
    """Return the slopes in solver coordinates with the form's answers, as large as what was measured, and how."""
    problem, n, answers = fit.problem, len(linear.residual), linear.answer(form)
    measured = [(m.y * m.weights)[:, m.weights > 0] ** 2 for m in problem.measured]
    size = np.sqrt(n) * float(np.sqrt(np.mean([np.nanmean(y2) for y2 in measured])))
    norms = np.linalg.norm(answers, axis=0)
    sizes = np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 0.0)
    free = problem.scaling.slope(fit.q)[: linear.slopes.shape[1]]
    free = free * [p.name not in fit.at_bound for p in problem.unknown[: len(free)]]
    return np.column_stack([linear.slopes * free, answers * sizes]), sizes


def ridge(normal: Array, products: Array, residual: Array) -> Array:
    """Return least-squares coefficients, by normal equations, with a prior of one unit at the scale of what is left."""
    norms = np.sqrt(np.diagonal(normal))
    norms = np.where(norms > 0, norms, 1.0)
    unit = products / norms
    square = float(residual @ residual)
    taken = float(unit @ np.linalg.lstsq(normal / np.outer(norms, norms), unit, rcond=EXACT)[0])
    scale2 = max(square - taken, EXACT * square) / len(residual)
    return np.asarray(np.linalg.solve(normal + scale2 * np.eye(len(normal)), products), float)


def contains(fit: Fit, form: Form, sizes: Sequence[str]) -> bool:
    """Tell whether a form in the place of an effect can be the effect of these `sizes`, parameters: along the model's
    trajectory, what they put into the balance or the output is compared with the form's functions."""
    signals = signals_along(fit)
    span = span_of(fit, signals)
    if not {*sizes} <= {*fit.problem.system.parameters} or not shown(form, fit, span.ranges):
        return False
    push = pushes_of(fit, *sizes)
    if (place := _column(fit, form)) is None:
        return False
    whole, own = float(np.sum(push**2)), push[:, place]
    basis = np.concatenate([basis_of(form, s, span) for s in signals])
    left = own - basis @ np.linalg.lstsq(basis, own, rcond=1e-9)[0]
    return float(left @ left) + whole - float(own @ own) < CONTAINED**2 * whole


def _column(fit: Fit, form: Form) -> int | None:
    """Return the column of `pushes_of` in which a form acts, None where it is in none or in two."""
    states = fit.problem.system.states
    if form.balance == "sensor":
        return len(states) + fit.problem.outputs.index(form.channel)
    state = STATES.get(form.balance)
    return states.index(state) if state in states else None


def pushes_of(fit: Fit, *names: str) -> Array:
    """Return what parameters that grow by a small share add to each state's rate and to each output, (N, nx + ny)."""
    system, found = fit.problem.system, []
    size = {n: fit.values[n] for n in names} if any(fit.values[n] for n in names) else dict.fromkeys(names, 1.0)
    nudge = np.array([NUDGE * size.get(n, 0.0) for n in system.parameters])
    for k, (run, sim) in enumerate(zip(fit.problem.runs, fit.simulations, strict=True)):
        values = parameter_vector(fit, k)
        x, u = np.column_stack([sim.states[s] for s in system.states]).T, run.grid.u.T
        was, now = (np.vstack([np.asarray(f.map(x.shape[1])(x, u, np.tile(p[:, None], (1, x.shape[1]))))
                               for f in (system.rhs, system.out)]) for p in (values, values + nudge))
        found.append((now - was).T)
    return np.concatenate(found)


def force_of(fit: Fit, form: Form) -> float:
    """Return what a free form that beside `fit` explains its records best amounts to, RMS along all runs."""
    signals = signals_along(fit)
    span = span_of(fit, signals)
    basis = np.concatenate([basis_of(form, s, span) for s in signals])
    return float(np.sqrt(np.mean((basis @ form_coefficients(fit, linearised(fit, form), form)) ** 2)))


def force_along(fit: Fit, form: Form, sizes: Sequence[str]) -> Array:
    """Return what the effects of these sizes put into the place of a form, SI, (N,), along all runs."""
    inertia = {"torque": "J", "voltage": "L"}.get(form.balance)
    return pushes_of(fit, *sizes)[:, _column(fit, form)] / NUDGE * (fit.values[inertia] if inertia else 1.0)

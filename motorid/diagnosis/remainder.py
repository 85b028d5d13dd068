"""What is left beside all effects of a model: noise, fluctuation, or structure that an effect of its own takes up.

Structure comes as a curve over one quantity, or as lags of one, in one balance: an effect like any other, to add, fit,
look at and export, and as source to edit and to name. Slopes propose the curves, the best are fitted with the rest of
the model, and what then predicts best is the answer. A few functions whose places are fitted, too (where a law bends
or sets in, how long it remembers: splines with free knots, Jupp, SIAM J. Numer. Anal. 15(2), 1978) are preferred to
many on a grid. Where one curve leaves what another predicts, there are several, those before chosen anew beside it."""

import contextlib
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from itertools import chain, islice, takewhile
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from motorid.channels import COMPUTED_INPUTS, worded
from motorid.diagnosis import free_forms, misspecification
from motorid.diagnosis.free_forms import COUPLED, FINER, LOADS, PAST, PLACE, WHERE, Form, Span, load_of, swinging
from motorid.diagnosis.misspecification import FormGain, better_forms, chosen_functions, pitches_of, tells_the_zero
from motorid.diagnosis.model_comparison import Node, at_noise, far
from motorid.diagnosis.predictive_score import QUICK, Evidence, HeldOut, Predictions, compare
from motorid.diagnosis.record_versions import fitted_to, whole_of
from motorid.diagnosis.refit import copies_the_angle, refit
from motorid.diagnosis.thresholds import CONTAINED, TRIFLE
from motorid.display.numbers import listed, number, percent
from motorid.effects import LIBRARY, PER_RUN
from motorid.errors import ModelError, OutOfTime, UsageError, looked_at
from motorid.estimation.fit import over_moments, solve
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, P
from motorid.model.equations import Equations
from motorid.model.model import Model
from motorid.numerics.parallel import budget, check_time, one_thread
from motorid.numerics.signals import Array
from motorid.records.experiment import Experiment, units_of

SECONDS = 120.0  # after which the best curve so far is taken
ENOUGH = 30.0  # s, for one fit of it, which need not come to an end: then the others have their turn
TRIED = 4  # curves that are fitted, those that promise most
FINE = range(1, 37)  # harmonics of a turn in a curve that is fitted
CLOSED = 300  # times that are tried as the end, or the beginning, of a constant
FURTHER = 3  # times that a form beside those of the curve is sought
FEW = 8  # functions at most whose places are fitted, too
ROUNDS = 3  # of choosing functions and fitting: near the optimum slopes show what the misfit hid before
CLEAN = 1.05  # times the noise, of which no more is known than that: what leaves less cannot be told from the law
TASTED = 2  # functions by which forms are compared, and
AHEAD = 2  # how many then go on, of those in short windows one
_known: ContextVar[dict[Any, Any]] = ContextVar("what a search for a curve found until it was stopped")
AT_ONCE = 20  # parts of a sample, in one of which follows what does so at once; more are too stiff to fit,
INPUT_AT_ONCE = 80  # but not where an input falls at once, which it does at few samples
QUANTITIES = {"run": "0.0", "turn": "m.theta",
              "theta": "m.theta", "omega": "m.omega", "i": "m.i", "v": "m.v", "past v": "m.v",
              "past i": "m.i", "past omega": "m.omega", "past speed": "ca.fabs(m.omega)", "past power": "m.omega**2",
              "twist": "m.twist_{load}", "slip": "m.omega - m.omega_{load}", "load speed": "m.omega_{load}",
              "path": "m.sign(m.omega)", "load": "m.v * m.i", "past load": "m.v * m.i",
              "past braking": "ca.fmax(-m.v * m.i, 0)", "past heat": "m.i**2", "past size": "ca.fabs(m.v)",
              **{c: f"m.input('{c}')" for c in COMPUTED_INPUTS}}
STATES = {  # quantities that are states of the curve's own: name, where it begins, rate
    "t": ("clock", "0.0", "1.0"), "distance": ("distance", "0.0", "ca.fabs(m.omega)"),
    "most i": ("most_i", "ca.fabs(m.start['i'])", "ca.fmax(ca.fabs(m.i) - most_i, 0) / {step}")}
SI = {"theta": "rad", "omega": "rad/s", "i": "A", "v": "V", "size": "V", "load": "W", "heat": "A²", "fan": "rad²/s²",
      "twist": "rad", "slip": "rad/s", "load speed": "rad/s"}
OTHER_PLACES = {"1": "where it sets in, a share of the largest", "V": "half of its play", "A": "half of its play",
                **dict.fromkeys(("V/s", "rad/s²"), "how fast it rises or follows"),
                "rad/s": "how fast it swings, or half of its play", "1/rad": "how fast it turns over",
                "1:wave": "how many to the turn", "rad:phase": "its phase", "rad:wide": "half of its width",
                "rad:edge": "how wide its edges are", "1:damped": "how much its swing is damped",
                "1:level": "how long it is on", "rad:slip": "how far it slips until what it drags along follows"}
STRAIGHT = ("omega", "i", "v", *COUPLED)
COUPLINGS = {"compliance", "compliance_load_side", "backlash", "slip_clutch", "freewheel"}
OVER = {"": "", "A": "/A", "V": "/V", "rad/s": "·s/rad", "rad²/s²": "·s²/rad²", "A²": "/A²"}
FIRST = {"past i": ", m.start['i']", "past omega": ", m.start['omega']"}  # of a memory: as if it had been so before
CLIPPED = re.compile(r"ca\.fmin\(ca\.fmax\(z, \S+\), \S+\)")
MEMORY = re.compile(r"((past|play|ramp|slew|hold|drag|swing|sway)\(z, (.*?)\))")
RATES = {  # of what follows z, with one place
    "past": "(z - {s}) / {p}", "play": "(ca.fmax(z - {p} - {s}, 0) - ca.fmax({s} - z - {p}, 0)) / {step}",
    "ramp": "ca.if_else(z < 0, -1, 1) * (ca.fmin({p}, (ca.fabs(z) - ca.if_else(z < 0, -{s}, {s})) / {step})"
            " + ca.fmax(ca.if_else(z < 0, {s}, -{s}), 0) / {step})",
    "slew": "ca.fmin(ca.fmax((z - {s}) / {step}, -{p}), {p})",
    "hold": "(z - {s}) / ca.if_else(ca.fabs(z) > ca.fabs({s}), {sample}, {p})",
    "drag": "(z - {s}) * ca.fabs(z - {s}) / {p}"}
FOLLOWS = {"play": "what a play of {} either way takes", "ramp": "what it is ahead of one that rises by at most {}",
           "slew": "what it is ahead of one that changes by at most {}",
           "hold": "what it is behind one that falls late, within {}",
           "drag": "the slip against what follows within {}",
           "past": "one lag of {}", "swing": "a swing at {}", "sway": "a swing at {}"}
POSITIVE = "ca.fmax(curve, -0.5) - 0.25 / ca.fmin(curve, -0.5) - 0.5"  # above -1, smooth; from -0.5 on as it is
CARRIERS = {"": "", "direction": "m.sign(m.omega) * ", "omega": "m.omega * ", "i": "m.i * ", "v": "m.v * ",
            "fan": "m.omega * ca.fabs(m.omega) * "}


@dataclass(frozen=True)
class Law:
    """A law given by its source: functions of one quantity with a coefficient each. Plain data, so it travels."""

    source: str

    def __call__(self, m: Equations, **coefficients: Any) -> None:
        """Write the law on the sheet `m`."""
        exec(self.source, {"ca": ca, "m": m, **coefficients})


@dataclass(frozen=True)
class Part:
    """A free form in a curve, of as few functions as its records ask for; if `moved`, their places are fitted too."""

    form: Form
    span: Span  # with as many waves, places and knees as a curve that is fitted may have
    chosen: tuple[int, ...] = ()  # functions of the form
    moved: bool = False

    @classmethod
    def of(cls, fit: Fit, form: Form, moved: bool = False) -> "Part":
        """Return a part without functions, for records as `fit` goes through them."""
        span = free_forms.span_of(fit, free_forms.signals_along(fit))
        span = replace(span, orders=tuple(sorted({*span.orders, *FINE})))
        pitches = pitches_of(fit, form, span) if form.on == "turn" else 1
        return cls(form, replace(span, pitches=pitches, finer=FINER), (), moved)

    @property
    def by_run(self) -> bool:
        """Tell whether it is one size that is another in every run."""
        return self.form.on == "run"

    @cached_property
    def functions(self) -> list[str]:
        """Those chosen, as source."""
        functions = free_forms.functions_of(self.form, self.span)
        return [functions[k] for k in self.chosen]

    @property
    def counts(self) -> list[int]:
        """How many places each function has that are fitted."""
        return [len({m[0] for m in PLACE.finditer(f)}) * self.moved for f in self.functions]

    @property
    def places(self) -> list[tuple[float, float, float, str]]:
        """Where each function bends, sets in or fades on the grid, its limits and unit; none if they stay there."""
        each = (m.groups() for f in self.functions if self.moved for m in {m[0]: m for m in PLACE.finditer(f)}.values())
        return [(float(at), float(low), float(high), unit or self.place[0]) for at, low, high, unit in each]

    def placed(self, places: Iterable[Any]) -> list[str]:
        """The functions with these names or values as their places, if they are `moved`, marked as places still."""
        given, functions = iter(places), []
        for f in self.functions:
            for old, value in {m[0]: m[1] for m in PLACE.finditer(f) if self.moved}.items():  # each once
                f = f.replace(old, old.replace(value, str(next(given)), 1))
            functions.append(f)
        return functions

    def terms(self, places: Iterable[Any]) -> list[str]:
        """The same as source. Few functions are a law, which goes on, in a balance straight."""
        terms = [PLACE.sub(r"\1", f) for f in self.placed(places)]
        straight = [CLIPPED.sub("z", f) if self.moved and self.form.on in STRAIGHT else f for f in terms]
        each = zip(terms, straight, strict=True)
        return [on if self.form.balance == "sensor" or "*" not in on else f for f, on in each]

    def unit(self, fit: Fit, bare: bool = False) -> str:
        """Unit of the coefficients, or `bare` of what the part adds to its balance or its sensor, but for a carrier."""
        form, torque = self.form, "N" if fit.model.axis == "linear" else "N·m"
        own = {"voltage": "V", "both": f"{torque}/A", "sensor": SI.get(form.channel, "")}.get(form.balance, torque)
        before = form.on.removeprefix("past ") if form.on in PAST and not form.carrier else ""
        by = [SI.get(n, "") for n in (before, form.carrier)]
        over = "".join(OVER[unit] for unit in by).replace("rad", "m" if torque == "N" else "rad")
        unit = "Ω" if self.by_run and own + over == "V/A" else own + over
        return own if bare else "1" if form.carrier == "acceleration" or own in by else unit

    @property
    def place(self) -> tuple[str, str]:
        """Unit of the places, and what they are."""
        if (on := self.form.on) in ("load", *STRAIGHT):
            return "", f"where it bends, a share of {number(max(map(abs, self.span.ranges[on])), 4)} {SI[on]}"
        unit = "rad" if on in ("theta", "turn", "distance", "path") else "s"
        return unit, "how long it remembers" if on in PAST else "where it lies, bends, sets in or fades"

    def law(self, names: Sequence[str], places: Sequence[str], known: Container[str], phase: str = "0.0") -> str:
        """Return the law as source, coefficients and places by name; states of `known` quantities are there already."""
        form, terms, own = self.form, self.terms(places), names[0]
        state, begins, rate = STATES.get(form.on, ("", "", ""))
        begun = f" + {phase} / {self.span.rate(form):.9g}" if form.swings else ""
        lines = [f"z = {state or QUANTITIES[form.on].format(load=self.span.load)}{begun}"]
        if state and form.on not in known:
            lines = [f"{state} = m.state('{own}_{state}', {begins})",
                     f"m.rate({state}, {rate.format(step=f'{self.span.step / AT_ONCE:.6g}')})", *lines]
        if form.on in PAST:
            rate = " * ca.fabs(m.omega)" if form.on == "path" else ""
            for k, (lag, kind, place) in enumerate(dict.fromkeys(MEMORY.findall(" ".join(terms)))):
                past = f"lagged_{k}"
                lines.append(f"{past} = m.state('{own}_{past}'{FIRST.get(form.on, '')})")
                if kind in RATES:
                    step = f"{self.span.step / (INPUT_AT_ONCE if kind == 'ramp' else AT_ONCE):.6g}"
                    change = RATES[kind].format(s=past, p=place, step=step, sample=self.span.step) + rate
                    lines.append(f"m.rate({past}, {change})")
                else:
                    (w, damped), sway = place.split(", "), f"{past}_rate"
                    lines += [f"{sway} = m.state('{own}_{sway}')", f"m.rate({past}, {w} * {sway})",
                              f"m.rate({sway}, {w} * (z - {past} - 2 * {damped} * {sway}))"]
                    past = sway if kind == "sway" else past
                terms = [t.replace(lag, past) for t in terms]
        lines += ["curve = (", *(f"    + {n} * {t}" for n, t in zip(names, terms, strict=True)), ")"]
        if form.carrier == "acceleration":
            lines += [f"curve = {POSITIVE}  # an inertia stays above zero"]
            if form.on in ("turn", "theta"):  # kinetic energy changes with the angle
                lines[0] = "z = ca.SX.sym('z')"
                lines += ["slope, curve = (ca.substitute(f, z, m.theta) for f in (ca.jacobian(curve, z), curve))",
                          "m.torque -= 0.5 * m.J / (1 + curve) * slope * m.omega**2"]
            return "\n".join([*lines, "m.scale('J', 1 + curve)"])
        if form.balance == "both":
            return "\n".join([*lines, "m.torque -= curve * m.i", "m.voltage += curve * m.omega"])
        if form.balance in ("coupling", "load"):
            there, inertia = self.span.load, f"(m.base('J') * m.base('{LOADS[self.span.load]}'))"
            on_load = f"m.push('omega_{there}', {'-' * (form.balance == 'load')}curve / {inertia})"
            return "\n".join([*lines, *["m.torque -= curve"] * (form.balance == "coupling"), on_load])
        carrier = CARRIERS[form.carrier]
        if form.balance == "sensor":
            return "\n".join([*lines, f"m.measure('{form.channel}', m.measured('{form.channel}') - {carrier}curve)"])
        return "\n".join([*lines, f"m.{form.balance} -= {carrier}curve"])


@dataclass(frozen=True, eq=False)
class Curve:
    """Free forms beside a model: mostly one, further ones where that leaves what another predicts."""

    fit: Fit  # of the model without the curve
    parts: tuple[Part, ...] = ()
    values: tuple[float, ...] = ()  # of the coefficients, part by part
    fitted: Fit | None = None  # of the model with the curve
    name: str = "remainder"
    begun: "Curve | None" = None  # the same as it grew in short windows, where it begins
    trial: bool = False  # in short windows, to see what is worth fitting to the records
    first: "Curve | None" = None  # the same with its first functions only

    @property
    def effect(self) -> Effect:
        """The curve as an effect."""
        parameters = []
        for part, sizes, places in self._apart(self.sizes.items()):
            unit = part.unit(self.fit)
            parameters += [P(c, unit, null=0.0, given=not part.by_run, per_run=part.by_run,
                             doc="relative to the first run" if part.by_run else "coefficient of the curve")(n)
                           for n, c in sizes]
            usual, words = part.place  # a fit rounds what is at its limit
            parameters += [P(min(max(c, low), high), unit.partition(":")[0], lower=low, upper=high, given=True,
                             doc=words if unit == usual else OTHER_PLACES[unit])(n)
                           for (n, c), (_, low, high, unit) in zip(places, part.places, strict=True)]
        if any(part.form.swings for part in self.parts):
            parameters.append(P(0.0, "rad", null=0.0, per_run=True, doc="against the first")(f"{self.name}_phase"))
        return Effect(self.name, Law(self.law), tuple(parameters), self.balance, f"What is left: {self.text}.")

    def _apart(self, what: Iterable[Any]) -> Iterator[tuple[Part, list[Any], list[Any]]]:
        """Yield the parts with what belongs to their coefficients, and to their places."""
        rest = iter(what)
        for part in self.parts:
            yield part, list(islice(rest, len(part.chosen))), list(islice(rest, len(part.places)))

    @property
    def text(self) -> str:
        """What it is, in words."""
        return listed([part.form.text for part in self.parts])

    @property
    def sizes(self) -> dict[str, float]:
        """Coefficients and places by name."""
        return {f"{self.name}_{k}": c for k, c in enumerate(self.values)}

    @property
    def balance(self) -> str:
        """The balance of the effect."""
        return {"both": "voltage", "coupling": "transmission", "load": "transmission"}.get(
            balance := self.parts[0].form.balance, balance)

    @property
    def code(self) -> str:
        """The curve as Python source of an effect."""
        pars = []
        for p in self.effect.parameters:
            rest = "null=0.0" if p.null == 0 else f'lower={p.lower:.9g}, upper={p.upper:.9g}, doc="{p.doc}"'
            rest = f"{rest}, per_run=True" if p.per_run else f"given=True, {rest}"
            pars.append(f'    {p.name}=mi.P({p.value:.9g}, "{p.unit}", {rest}),')
        known = [f"    Nearest closed form{' of the first part' * (len(self.parts) > 1)}: {text} (misses "
                 f"{'less than ' * (miss < 1e-3)}{percent(max(miss, 1e-3), 2)} of it)."
                 for text, miss in self.nearest()[:1]]
        if "encoder_zero" in self.fit.model.effect_names:
            known.append("    To add with mi.effects.encoder_zero: the angle has another zero in every run.")
        if load := next((part.span.load for part in self.parts if part.form.on in COUPLED), ""):
            name = next(e.name for e in self.fit.model.effects if LOADS[load] in {p.name for p in e.parameters})
            known.append(f"    To add with mi.effects.{name}, whose load it acts on.")
        if "T_a" in self.fit.values:
            known.append(f"    To add with mi.effects.speed_average, T_a = {self.fit.values['T_a']:.6g} s.")
        return "\n".join(["import casadi as ca", "", "import motorid as mi", "", "",
                          f'@mi.effect(balance="{self.balance}")', f"def {self.name}(", "    m,", *pars, "):",
                          f'    """What is left of the misfit: {self.text}.', *(["", *known, ""] if known else []),
                          '    """', *("    " + line if line else "" for line in self.law.splitlines()), ""])

    def nearest(self) -> list[tuple[str, float]]:
        """Return closed forms beside the first part, the nearest first: in words with its size, the share missed."""
        if (part := self.parts[0]).by_run:
            return []
        (z, value), places = self.points, next(self._apart(self.values))[2]
        forms, unit = _closed_forms(part.form.on, z), part.unit(self.fit)
        if part.form.swings:
            kinds = zip(places, part.places, strict=True)
            rates = [w for w, (*_, kind) in kinds if kind == "rad/s"] or [part.span.rate(part.form)]
            forms = [(f"a wave of {number(w / 2 / np.pi, 3)} Hz", [np.sin(w * z), np.cos(w * z)]) for w in rates]
        if part.form.on in PAST:
            functions = [*part.placed(places), *free_forms.functions_of(part.form, part.span)]
            lags = np.concatenate([free_forms.values_of(functions, part.form, s) for s in self._signals])
            base, also = ("a constant and ", [-1]) if part.form.carrier else ("", [])  # the last is a constant
            known = _remembering(functions, part.place[0])
            forms = [(base + words, [lags[:, j] for j in (k, *also)]) for k, words in known]
            unit = part.unit(self.fit, bare=True)
        on = np.concatenate([s.get(part.form.carrier, np.ones_like(s["t"])) for s in self._signals])
        forms.sort(key=lambda form: len(form[1]))  # of what misses as little, the simplest
        return sorted((_closed(*form, value, on, unit) for form in forms), key=lambda f: round(f[1], 6))

    @cached_property
    def points(self) -> tuple[Array, Array]:
        """The quantity of the first part at the samples of all runs, and what that part is there."""
        part = self.parts[0]
        z = np.concatenate([s[part.form.on] for s in self._signals])
        _, sizes, places = next(self._apart(self.values))
        values = np.concatenate([free_forms.values_of(part.terms(places), part.form, s) for s in self._signals])
        curve = values @ np.array(sizes)
        if part.by_run and self.fitted is not None:
            sizes = (self.fitted.initial.get(f"{self.name}_0[{k}]", 0.0) for k in self.fitted.problem.unknowns.firsts)
            curve = np.repeat(list(sizes), [len(s["t"]) for s in self._signals])
        return z, eval(POSITIVE, {"ca": np, "curve": curve}) if part.form.carrier == "acceleration" else curve

    @cached_property
    def _signals(self) -> list[dict[str, Array]]:
        each, (form, span) = free_forms.signals_along(self.fit), (self.parts[0].form, self.parts[0].span)
        ahead = self._zeros if form.swings else {}  # of whole runs
        return [{**s, "t": s["t"] + ahead.get(f"z_0[{k}]", 0.0) / span.rate(form)} for k, s in enumerate(each)]

    def grown(self) -> "Curve | None":
        """Return the curve with functions of its last part that predict more, fitted, or None; raises as a fit."""
        last, (*before, part) = self.fitted or self.fit, self.parts
        if part.by_run and part.chosen:
            return None
        zeros = {} if not part.form.swings else self._zeros or free_forms.zeros_of(last, part.form)
        linear = free_forms.linearised(last, part.form, part.span, zeros)
        if part.by_run:
            first, *own = free_forms.form_coefficients(last, linear, part.form).tolist()
            curve = replace(self, parts=(*before, replace(part, chosen=(0,))), values=(*self.values, 0.0))
            others = zip(sorted(set(last.problem.unknowns.firsts))[1:], own, strict=True)
            start = {f"{self.name}_{len(self.values)}[{k}]": size - first for k, size in others}
            return curve.refitted(last, curve.sizes | start, curve.sizes)
        if not (more := chosen_functions(last, linear, part.form, part.chosen, first=part.moved)):
            return None
        free = map(float, free_forms.form_coefficients(last, linear, part.form, more))
        *_, (_, sizes, places) = self._apart(self.values)
        larger = replace(part, chosen=(*part.chosen, *more))
        places += [place[0] for place in larger.places[len(places):]]
        first = self.values[: len(self.values) - len(part.chosen) - len(part.places)]
        curve, without = (replace(self, parts=(*before, larger), values=(*first, *sizes, *new, *places))
                          for new in (free, [0.0] * len(more)))
        phases = {n.replace("z_0", f"{self.name}_phase"): phase for n, phase in zeros.items()}
        return curve.refitted(last, curve.sizes | phases, without.sizes | phases)

    @property
    def _zeros(self) -> dict[str, float]:
        """How far what swings is ahead of the first run's in every other, as fitted, rad."""
        fitted, own = self.fitted.initial if self.fitted else {}, f"{self.name}_phase"
        return {n.replace(own, "z_0"): phase for n, phase in fitted.items() if n.startswith(own)}

    def without(self, k: int) -> "Curve | None":
        """Return the curve without a part, fitted anew; None where that fails."""
        kept = [[*sizes, *places] for j, (_, sizes, places) in enumerate(self._apart(self.values)) if j != k]
        curve = replace(self, parts=(*self.parts[:k], *self.parts[k + 1:]), values=tuple(chain.from_iterable(kept)))
        return curve.refitted(self.fitted or self.fit, curve.sizes)

    def slimmed(self) -> "Curve | None":
        """Return the curve without functions within two deviations of nothing, fitted anew; None for none of these."""
        parts, values, std = list[Part](), list[float](), self.fitted.std if self.fitted else {}
        for part, sizes, places in self._apart(self.sizes.items()):
            told = [(known := std.get(n, 0.0)) is not None and abs(c) > 2 * known for n, c in sizes]
            kept = [k for k, sure in enumerate(told) if sure or part.by_run or not any(told)]
            ends = np.cumsum([0, *part.counts])
            parts.append(replace(part, chosen=tuple(part.chosen[k] for k in kept)))
            values += [sizes[k][1] for k in kept] + [c for k in kept for _, c in places[ends[k] : ends[k + 1]]]
        slim = replace(self, parts=tuple(parts), values=tuple(values))
        return slim.refitted(self.fitted or self.fit, slim.sizes) if len(values) < len(self.values) else None

    def refitted(self, last: Fit, *starts: Mapping[str, float]) -> "Curve | None":
        """Return the curve fitted from `starts`, with and without the `last` values; None where it copies the angle."""
        model, every = self.fit.model + self.effect, [{**w, **s} for s in starts for w in (last.values, {})]
        key = last, self.fit, self.law, *(tuple(start.items()) for start in every)
        if (done := _once(lambda: refit(last, model, every), *key)) is None or copies_the_angle(done.problem, done.q):
            return None
        return replace(self, values=tuple(done.values[n] for n in self.sizes), fitted=done)

    @property
    def law(self) -> str:
        """The law as source."""
        return "\n".join(part.law(sizes, places, [before.form.on for before in self.parts[:k]], f"{self.name}_phase")
                         for k, (part, sizes, places) in enumerate(self._apart(self.sizes)))


@dataclass(frozen=True, eq=False)
class Remainder:
    """What a model leaves."""

    # "noise", "fluctuation": more than noise, unpredictable; "structure": predictable, or hidden by what imitates it
    kind: str
    fit: Fit  # of the model that leaves it
    forms: tuple[Form, ...] = ()  # that by slopes predict some of it, the best first; its curve may be of others
    _held: HeldOut | None = field(default=None, repr=False)
    _root: Fit | None = field(default=None, repr=False)  # of the model that the search began with
    # effects that only approximate the rest, with the form that predicts better in their place, if one does
    _approximating: Mapping[str, Form | None] = field(default_factory=dict, repr=False)
    _records: Sequence[Experiment] = field(default=(), repr=False)  # of which the fit may be of parts
    _stopped: dict[Any, Any] = field(default_factory=dict, repr=False)  # what a search found that is to go on

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_stopped": {}}  # many fits, that are found again

    @property
    def form(self) -> Form | None:
        """The free form that by its slopes predicts most of it."""
        return self.forms[0] if self.forms else None

    @property
    def where(self) -> str | None:
        """The balance that it is in: electrical, mechanical or sensor."""
        return None if self.form is None else WHERE[self.form.balance]

    @property
    def follows(self) -> str | None:
        """What it follows, in words."""
        return None if self.form is None else worded(self.form.text, units_of(self.fit.problem.experiments))

    @property
    def proposed(self) -> bool:
        """Tell whether slopes propose a curve, which need not help, or one is known."""
        curve = self.form is not None or bool(self._anew) or any(self._approximating.values())
        return self.kind == "structure" and bool(self.__dict__.get("_best", curve))

    def as_effect(self, name: str = "remainder") -> Effect:
        """Return what is left as an effect, a curve: ``found.remainder.model + found.remainder.as_effect()``.

        The first call fits the model with each of the best curves, if no diagnosis has: at most for two minutes.

        Raises
        ------
        UsageError
            If nothing is left that a curve could describe.
        """
        return replace(self._chosen, name=name).effect

    def code(self, name: str = "remainder") -> str:
        """Return the same as Python source, for ``--effects-from FILE.py`` or a notebook: to edit and to name."""
        return replace(self._chosen, name=name).code

    def nearest(self) -> list[tuple[str, float]]:
        """Return closed forms beside the curve's first part, nearest first: in words with size, the share missed."""
        return self._chosen.nearest()

    @property
    def model(self) -> Model:
        """The model to add the curve to, at its values beside that; without what only approximated it, if better so."""
        return self._chosen.fit.model.start_at(self.fitted.values)

    @property
    def fitted(self) -> Fit:
        """That model with the curve, fitted to the same records."""
        assert self._chosen.fitted is not None
        return self._chosen.fitted

    @property
    def curve(self) -> tuple[Array, Array]:
        """The first part's quantity at the samples of all runs, and the missing torque, voltage or error there, SI."""
        return self._chosen.points

    @property
    def _chosen(self) -> Curve:
        """The curve with which the model, fitted anew, predicts best."""
        if self.kind != "structure":
            raise UsageError(f"the remainder is {self.kind}: nothing is left that a curve over a quantity predicts.")
        try:
            if (best := self._best) is not None:
                self._stopped.clear()
                return best.curve
        except OutOfTime:
            raise UsageError("no curve was known to help when the time was up: allow more of it.") from None
        raise UsageError("something predictable is left, but no curve over one quantity lowers the error on data "
                         "left out; do these hold voltages or speeds that others lack?")

    @cached_property
    def _best(self) -> "Grown | None":
        """The same, with what it predicts; None where none helps. Raises OutOfTime before there is any."""
        best, token = None, _known.set(self._stopped)
        try:
            with budget(SECONDS), looked_at():
                with contextlib.suppress(OutOfTime), budget(SECONDS / 2):  # they may be many times as long
                    best = (whole := self._on_whole) and whole._grown
                if (best := best or self._grown) is None:
                    check_time()
            return best
        finally:
            _known.reset(token)

    def led_by_its_curve(self) -> "Remainder":
        """Return the same with the forms of its curve first, or none where no curve helps. Raises OutOfTime."""
        best = self._best
        zeros = best is not None and any(map(tells_the_zero, best.curve.fit.model.effects))  # another in every run
        lead = [replace(p.form, zeroed=bool(p.form.swings) or (zeros and p.form.on == "turn"))
                for p in best.curve.parts] if best else []
        found = replace(self, forms=tuple(dict.fromkeys((*lead, *self.forms))) if lead else ())
        with contextlib.suppress(OutOfTime):
            check_time()
            found.__dict__["_best"] = best  # to its end: `as_effect` may take longer than a diagnosis does
            self._stopped.clear()
        return found

    @property
    def errors(self) -> dict[str, float]:
        """NRMSE with the curve, if it is known, on held-out runs; without any on the fitted ones."""
        best = self.__dict__.get("_best")
        return {c: e.nrmse for c, e in best.predictions.held_out.items()} or dict(self.fitted.nrmse) if best else {}

    @property
    def _grown(self) -> "Grown | None":
        """The same, as far as it has grown; None where none helps. Raises OutOfTime before there is any."""
        short = (t for root in [self._root or self.fit] for t in _grown_in(_in_windows(root), root, self.forms))
        sources = self._coupled(), self._tried(), short, *map(_beyond, self._anew)
        every = _by_turns(*(islice(some, TRIED) for some in sources))
        return _predicting_most(self.fit, every, self._held or HeldOut.of(self.fit, None))

    @property
    def _on_whole(self) -> "Remainder | None":
        """The same on whole `_records`, where the fit is of parts: what was before each is not known there."""
        if not (runs := whole_of(self.fit, self._records)):
            return None
        fit, *root = (_once(partial(fitted_to, f, runs, QUICK), f, "whole") for f in (self.fit, self._root) if f)
        return replace(self, fit=fit, _root=root[0] if root else None, forms=_forms_beside(fit), _records=())

    def _coupled(self) -> Iterator[tuple[Curve, Form]]:
        """Yield a shaft (for one with play, too) or clutch, without what approximates, and forms of its load."""
        coupled = {e.name for e in self.fit.model.effects} & COUPLINGS
        base = (_without(self.fit, self._approximating.keys() - coupled) or self.fit) if coupled else None
        with contextlib.suppress(ModelError):
            if base and "backlash" in coupled:
                shaft = reduce(Model.without, coupled, base.model) + LIBRARY["compliance"]
                alike = {"r_load": "r_gap", "omega_r": "omega_c", "zeta_r": "zeta_c"}
                start = {**base.values, **{new: base.values[old] for new, old in alike.items()}}
                base = _once(partial(refit, base, shaft, [start]), base, "shaft")
        if base:
            yield from ((curve, form) for curve, form in _beyond(base) if form.on in COUPLED)

    def _tried(self) -> Iterator[tuple[Curve, Form]]:
        """Yield models and a form to fit with each, the likeliest first; what takes a fit to find only when asked for.

        Beside what only approximates a form there is no place for it; then the whole model, or without all that does.
        """
        replaced = {name: form for name, form in self._approximating.items() if form is not None}
        if (base := _without(self.fit, replaced)) is not None:
            asked = dict.fromkeys(replaced.values())
            yield from ((curve, form) for form in asked if (curve := _instead(self.fit, base, form, replaced)))
            yield from _over_zeros(base, asked)
        alone = _beyond(_without(self.fit, self._approximating) if far(self.fit) else None)
        yield from _by_turns(_over_zeros(self.fit, self.forms), alone)

    @property
    def _anew(self) -> tuple[Fit, ...]:
        """The first model, and it with the angle's zeros if these were found, where the last one is far from noise."""
        if self._root is None or self._root is self.fit or not far(self.fit):
            return ()
        added = {e.name: e for e in self.fit.model.effects if e.name not in self._root.model.effect_names}
        zeroed = _without(self.fit, added) if any(map(tells_the_zero, added.values())) else None
        return (self._root,) if zeroed is None else (zeroed, self._root)


def _once(find: Callable[[], Any], *key: Any) -> Any:
    """Return what a search that was stopped, and goes on, had found by this key, or what it finds now."""
    known = _known.get({})
    if key not in known:
        known[key] = find()
    return known[key]


def _forms_beside(fit: Fit) -> tuple[Form, ...]:
    return misspecification.in_turn(_once(lambda: better_forms(fit, fit), fit, "forms"))


def _in_windows(fit: Fit) -> Fit | None:
    """Return a model that is far off, fitted in short windows."""
    return _once(lambda: over_moments(fit, solve=partial(solve, solver=QUICK)), fit, "windows")


def _without(fit: Fit, names: Iterable[str]) -> Fit | None:
    """Return the fit without these effects, but for every run's own zero of the angle; None where there is none."""
    with contextlib.suppress(ModelError):
        zeros = {e.name for e in fit.model.effects if tells_the_zero(e)}
        model = reduce(Model.without, (n for n in names if n not in zeros), fit.model)
        values = {n: v for n, v in fit.values.items() if n in model.parameters}
        return None if model is fit.model else _once(lambda: refit(fit, model, (values,)), fit, model.effect_names)
    return None


def _by_turns(*sources: Iterator[tuple[Curve, Form]]) -> Iterator[tuple[Curve, Form]]:
    """Yield one from each source, each only when asked for, until all are at their end."""
    for source in (waiting := list(sources)):
        for found in islice(source, 1):
            waiting.append(source)  # for its next turn
            yield found


def _beyond(base: Fit | None) -> Iterator[tuple[Curve, Form]]:
    """Yield a model, without a curve yet, with each form that predicts more than it does, the best first."""
    if base is not None:
        with contextlib.suppress(*FAILURES):
            yield from _over_zeros(base, _forms_beside(base))


def _over_zeros(base: Fit, forms: Iterable[Form]) -> Iterator[tuple[Curve, Form]]:
    """Yield a model, without a curve yet, with each form, beside the zero of every run where the form has one."""
    for form in forms:
        turns = form.zeroed and not form.swings
        if (fit := _zeroed(base, free_forms.zeros_of(base, form)) if turns else base) is not None:
            yield Curve(fit, name=_name(base)), replace(form, zeroed=bool(form.swings))


def _zeroed(base: Fit, zeros: Mapping[str, float]) -> Fit | None:
    """Return a fit with the zero of the angle of every run, beginning at `zeros`; what has one is that already."""
    known = any(map(tells_the_zero, base.model.effects))
    return base if known else _once(
        lambda: refit(base, base.model + PER_RUN["encoder_zero"], [zeros]), base, *zeros.items())


def _grown_in(there: Fit | None, base: Fit, asked: Sequence[Form]) -> Iterator[tuple[Curve, Form]]:
    """Yield curves, best first, of forms that grew in short windows or are `asked`."""
    if there is not None:
        here, found = HeldOut.of(there, None), dict[Any, Grown]()
        also = ((Curve(there), f) for f in asked[:AHEAD] if not f.remembers and f.on not in ("distance", "run"))
        tried = ((replace(curve, trial=True), form) for curve, form in chain(islice(_beyond(there), TRIED), also))
        _race(found, tried, here.predictions(there), here, True)
        for key in sorted(found, key=lambda key: -found[key].gained.gain):
            begun = replace(found[key].curve, trial=False)
            if found[key].gained.worth_it and (whole := _zeroed_like(base, begun.fitted or begun.fit)) is not None:
                yield Curve(whole, name=_name(base), begun=begun), key[1]


def _zeroed_like(base: Fit, there: Fit) -> Fit | None:
    """Return a fit with the zero of the angle of every run where that in short windows of its records has one."""
    runs, windows = (sorted(set(fit.problem.unknowns.firsts))[1:] for fit in (base, there))
    before, after = (sum(map(tells_the_zero, fit.model.effects)) for fit in (base, there))
    if before == after or len(runs) != len(windows):
        return base
    return _zeroed(base, {f"z_0[{k}]": free_forms.zero_of(there, w) for k, w in zip(runs, windows, strict=True)})


class Grown(NamedTuple):
    """A curve as far as it has grown, what it predicts, and what of that is better than without its last form."""

    gained: Evidence
    predictions: Predictions
    curve: Curve

    @property
    def done(self) -> bool:
        """Tell whether it leaves no more than noise."""
        return self.gained.worth_it and self.curve.fitted is not None and (
            at_noise(Node(self.curve.fitted, None, self.predictions)))

    @property
    def clean(self) -> bool:
        """Tell whether no other curve could do better: it leaves noise, or what is larger and nothing predicts."""
        fitted = self.curve.fitted
        return self.done and fitted is not None and (
            self.curve.trial or max(fitted.misfit.values()) < CLEAN or next(_beyond(fitted), None) is None)


@one_thread
def _predicting_most(fit: Fit, tried: Iterable[tuple[Curve, Form]], held: HeldOut) -> Grown | None:
    """Return the curve, fitted with its model, that predicts most beyond `fit`; None where none does."""
    before, name = held.predictions(fit), _name(fit)
    best = _better_curve(((replace(curve, name=name), form) for curve, form in tried), before, held)
    best = best and _of_counts(best, held)
    for _ in range(FURTHER):
        if best is None or best.done or (larger := _better_curve(_further(best), best.predictions, held)) is None:
            break
        best = _revised(larger, held)
    return best and _slimmed(best, held)


def _of_counts(best: Grown, held: HeldOut) -> Grown:
    """Return a curve beside a speed that is the mean over each sample, as that of counts is, if it predicts better."""
    fit, last = best.curve.fit, best.curve.fitted
    if last and "omega" in fit.problem.outputs and not misspecification.LATENESS.keys() & {*fit.model.effect_names}:
        with contextlib.suppress(*FAILURES, ModelError, OutOfTime):
            mean = (fit.model + LIBRARY["speed_average"]).fix(T_a=misspecification.sample_of(fit))
            base = _once(lambda: refit(fit, mean, (last.values,)), fit, "counts")
            curve = base and replace(best.curve, fit=base).refitted(last, best.curve.sizes)
            if curve and curve.fitted and compare(best.predictions, known := held.predictions(curve.fitted)).worth_it:
                return Grown(best.gained, known, curve)
    return best


def _slimmed(best: Grown, held: HeldOut) -> Grown:
    """Return a curve without functions that came to nothing, if it predicts as well so."""
    with contextlib.suppress(*FAILURES, OutOfTime):
        if (slim := best.curve.slimmed()) and slim.fitted:
            predicted = held.predictions(slim.fitted)
            return best if compare(predicted, best.predictions).worth_it else Grown(best.gained, predicted, slim)
    return best


def _further(best: Grown, than: Form | None = None) -> Iterator[tuple[Curve, Form]]:
    """Yield a curve with each of a few forms that promise more than it does alone, and more `than` one, best first."""
    had = [part.form for part in best.curve.parts]
    forms = (form for _, form in _beyond(best.curve.fitted) if form not in had and form.on != "run")
    yield from ((best.curve, form) for form in islice(takewhile(lambda form: form != than, forms), TRIED))


def _revised(best: Grown, held: HeldOut, times: int = FURTHER) -> Grown:
    """Return a curve without superfluous parts, or with them chosen anew: the first may have imitated all others."""
    for k, part in enumerate(best.curve.parts[:-1] if times else ()):
        with contextlib.suppress(*FAILURES, OutOfTime):
            check_time()
            if (smaller := best.curve.without(k)) is None or smaller.fitted is None:
                continue
            less = Grown(best.gained, held.predictions(smaller.fitted), smaller)
            if not compare(less.predictions, best.predictions).worth_it:
                return _revised(less, held, times)
            for tried in ([(smaller, part.form)], _further(less, part.form)):
                other = None if best.done else _better_curve(tried, less.predictions, held)
                if other is not None and compare(best.predictions, other.predictions).worth_it:
                    return _revised(other, held, times - 1)
    return best


def _better_curve(tried: Iterable[tuple[Curve, Form]], before: Predictions, held: HeldOut) -> Grown | None:
    """Return the best of curves, each with a form more, the smallest on a tie; None where none does better."""
    found = dict[Any, Grown]()
    with contextlib.suppress(OutOfTime):  # what is tried takes fits to find, too
        for first, form in _race(found, tried, before, held):
            known = any(f.done for f in found.values()) or form.on == "run"  # a size of each run has no grid
            for grown in () if known else _growing(first, form, False, before, held):
                found[first, form, "grid"] = grown
    better = sorted((f for f in found.values() if f.gained.worth_it),
                    key=lambda f: (len(f.curve.fitted.q) if f.curve.fitted else 0, -f.gained.gain))
    return reduce(lambda a, b: b if compare(a.predictions, b.predictions).worth_it else a, better) if better else None


def _race(found: dict[Any, Grown], tried: Iterable[tuple[Curve, Form]], before: Predictions, held: HeldOut,
          trial: bool = False) -> list[tuple[Curve, Form]]:
    """Put into `found` the curves, each with a form more: the first to its end, of the others those that get furthest
    with few functions (successive halving: Karnin, Koren & Somekh, ICML 2013), until one leaves nothing but noise.

    Returns those that got furthest of all; none where one leaves nothing more. On `trial` all have few functions."""
    racing = dict[Any, Iterator[Grown]]()

    def quiet(key: Any, functions: int) -> bool:
        for k, grown in enumerate(racing[key], 1):
            found[key] = grown
            if grown.curve.trial if grown.done else k >= functions:
                break
        return key in found and found[key].clean

    for key in tried:
        alike = {(c.fit.model.effect_names, f, c.begun is None) for c, f in racing}
        if (key[0].fit.model.effect_names, key[1], key[0].begun is None) not in alike:
            racing[key] = _growing(*key, True, before, held)
            if quiet(key, TASTED if found or trial else FEW):
                return []
    ahead = sorted(found, key=lambda key: -found[key].gained.gain)
    others = ahead[:1] if trial else [key for key in ahead if key != next(iter(racing))][:AHEAD]
    return [] if any(quiet(key, FEW) for key in others) else sorted(found, key=lambda k: -found[k].gained.gain)[:AHEAD]


def alone_predicting_more(last: Node, root: Fit, held: HeldOut, forms: Sequence[Form]) -> FormGain | None:
    """Return the form that, grown in short windows, predicts better than all that `last` has and `root` has not."""
    found = dict[Any, Grown]()
    check_time()
    with contextlib.suppress(*FAILURES):
        _race(found, islice(_grown_in(_in_windows(root), root, forms), AHEAD), held.predictions(root), held, True)
    gains = (FormGain(key[1], compare(last.predictions, f.predictions), f.predictions) for key, f in found.items())
    return next((gain for gain in gains if gain.evidence.worth_it), None)


def beside_leaving_noise(last: Node, form: Form, special: Mapping[str, float], held: HeldOut) -> FormGain | None:
    """Return the form where, fitted beside all that `last` has, it leaves no more than noise; `smaller` where it does
    so with fewer unknowns in the place of `special` cases of it, given with what they miss. Raises OutOfTime."""
    check_time()
    smaller, found = _without(last.fit, special), list[tuple[int, FormGain]]()
    for curve in (smaller and _instead(last.fit, smaller, form, special), Curve(last.fit, name=_name(last.fit))):
        if curve and (curve.begun or found or max(special.values()) > TRIFLE):
            grown = islice(_growing(curve, form, True, last.predictions, held), TASTED if curve.begun else None)
            done = ((g, FormGain(form, g.gained, g.predictions, curve.fit is smaller)) for g in grown if g.done)
            found += [(len(g.curve.sizes) + len(curve.fit.q), gain) for g, gain in islice(done, 1)]
    return min(reversed(found), key=lambda entry: entry[0], default=(0, None))[1]


def _instead(fit: Fit, smaller: Fit, form: Form, names: Container[str]) -> Curve | None:
    """Return a few functions beside a `smaller` fit, begun as what effects of these names do along `fit`, or None."""
    effects = [e for e in fit.model.effects if e.name in names and not tells_the_zero(e)]
    known = [p.name for e in effects for p in e.parameters if p.null == 0]
    if not known or form.carrier == "acceleration" or not free_forms.contains(fit, form, known):
        return None
    part = Part.of(fit, form, moved=True)
    whole, had, sizes = -free_forms.force_along(fit, form, known), list[int](), np.zeros(0)
    basis = np.concatenate([free_forms.basis_of(form, s, part.span) for s in free_forms.signals_along(fit)])
    left, norms = whole, np.linalg.norm(basis, axis=0)
    while len(had) < FEW and float(left @ left) > CONTAINED**2 * float(whole @ whole):
        had.append(int(np.argmax(np.abs(left @ basis) / np.where(norms > 0, norms, np.inf))))
        left = whole - basis[:, had] @ (sizes := np.linalg.lstsq(basis[:, had], whole, rcond=None)[0])
    part = replace(part, chosen=tuple(had))
    begun = Curve(fit, (part,), (*map(float, sizes), *(place for place, *_ in part.places)))
    return Curve(smaller, name=_name(smaller), begun=begun)


def _name(fit: Fit) -> str:
    """Return a name for a curve beside those that a model has."""
    return "remainder" + "_more" * sum(n.startswith("remainder") for n in fit.model.effect_names)


def _growing(curve: Curve, form: Form, moved: bool, before: Predictions, held: HeldOut) -> Iterator[Grown]:
    """Yield a curve with a form more, of ever more functions, as long as these help."""
    best, led, last = float("-inf"), None, curve.fitted or curve.fit
    if (form.on in COUPLED and not load_of(last.problem.system)) or (form.swings and not swinging(last, [form])):
        return
    with contextlib.suppress(*FAILURES, OutOfTime):
        for begun in dict.fromkeys((curve.begun.first or curve.begun, curve.begun)) if moved and curve.begun else ():
            there = {n: v for n, v in (begun.fitted or begun.fit).values.items() if n != "sgn_width"}
            # In windows noise is not always reached, and what imitates it grows there.
            with budget(ENOUGH):
                led = replace(begun, fit=curve.fit, name=curve.name, first=None).refitted(curve.fit, there)
            if led and led.fitted and at_noise(Node(led.fitted, None, held.predictions(led.fitted))):
                break
        curve = replace(curve, parts=(*curve.parts, Part.of(last, form, moved)))
        for _ in range(FEW if moved else ROUNDS):
            check_time()
            known = curve.fitted or curve.fit, curve.fit, curve.values, curve.name, curve.trial, form, moved
            with budget(ENOUGH):
                larger, led = led or _once(curve.grown, *known), None
            if larger is None or larger.fitted is None:
                return
            predicted = held.predictions(larger.fitted)
            if (gained := compare(before, predicted)).gain < best:  # slopes led astray
                return
            curve, best = replace(larger, first=curve.first or larger), gained.gain
            yield Grown(gained, predicted, curve)
    check_time()


def _remembering(functions: Sequence[str], usual: str) -> Iterator[tuple[int, str]]:
    """Yield which functions of what was before are a closed form, and that in words; `usual` is the unit of places."""
    for k, f in enumerate(functions):
        if (m := MEMORY.search(f)) and (at := PLACE.match(m[3])) and not f.startswith("ca.fmax"):
            size, unit = float(at[1]), (at[4] or usual).partition(":")[0]
            slack = f"a slack of {number(2 / size, 2)} rad"  # turned over between a reversal and its end
            words = "what is ahead of " * ("(z - past" in f) + FOLLOWS[m[2]].format(f"{number(size, 2)} {unit}")
            yield k, slack if unit == "1/rad" else "the square of " * ("ca.fabs(" in f) + words


def _closed_forms(on: str, z: Array) -> list[tuple[str, Sequence[Array]]]:
    """Return closed forms of a quantity: what they are called, and their functions, (n,) each."""
    one, side = np.ones_like(z), np.sign(z)
    if on in COMPUTED_INPUTS:  # what lasts, or waits, for a time; below zero while the voltage is off
        known = np.unique(np.abs(z))
        between = 0.5 * (known[1:] + known[:-1])
        steps = between[np.unique(np.geomspace(1, len(between), CLOSED).astype(int)) - 1]
        return [(f"one value for the first {number(c, 3)} s{off}, another after", [one, way * z > c])
                for way, off in ((1, ""), (-1, " off")) if (way * z > 0).any() for c in steps]
    top = float(np.abs(z).max(initial=0.0)) or 1.0
    if on == "turn":
        return [(f"one wave, {k} to the turn", [np.sin(k * z), np.cos(k * z)]) for k in range(1, 13)]
    if on in ("theta", "t", "distance"):
        found = [("a constant", [one]), ("a straight line", [one, z]), ("its square", [z**2]), ("its cube", [z**3])]
        return [*found, *((f"a constant and what fades within {number(c, 2)} {'s' if on == 't' else 'rad'}",
                           [one, np.exp(-z / c)]) for c in np.geomspace(0.01, 2, CLOSED) * top if on != "theta")]
    found = [("a constant", [one]), ("proportional to it", [z]), ("proportional to its size", [np.abs(z)]),
             ("its sign alone", [side]), ("its square, with its sign", [z * np.abs(z)]),
             ("its sign and proportional to it", [side, z])]
    if z.min(initial=0.0) < 0 < z.max(initial=0.0):
        found += [(f"a constant {way} zero", [s * z > 0]) for way, s in (("above", 1), ("below", -1))]
    if on == "omega":
        found += [(f"an eddy-current brake, strongest at {number(w, 2)} rad/s", [z / (1 + (z / w) ** 2)])
                  for w in np.geomspace(0.03 * top, top, 12)]
    return found


def _closed(text: str, functions: Sequence[Array], value: Array, carrier: Array, unit: str) -> tuple[str, float]:
    """Return a closed form with its size where the `carrier` is, and the share of what the curve does it misses."""
    columns, does = np.column_stack(functions), value * carrier
    size = np.linalg.lstsq(columns * carrier[:, None], does, rcond=None)[0]
    missed = does - columns @ size * carrier
    share = float(np.sqrt(missed @ missed / max(float(does @ does), 1e-300)))
    largest = float(np.abs(columns @ size)[carrier != 0].max(initial=0.0))
    return f"{text}, at most {number(largest, 2)} {unit}".removesuffix(" 1"), share

"""Does a free form predict better than a model, in an effect's place or beside all? What may an effect then be called?

A free form is any smooth function of one quantity, in one balance or sensor (see `free_forms`), linear in its
coefficients, so slopes alone tell what a model with it would predict of blocks left out. A parametric law that a
nonparametric one outdoes is not the thing itself (Härdle & Mammen, Ann. Statist. 21(4), 1993)."""

import contextlib
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from motorid.channels import CHANNELS, channel_name
from motorid.diagnosis import free_forms, predictive_score
from motorid.diagnosis.admissibility import objections
from motorid.diagnosis.free_forms import Form, Linear, Span
from motorid.diagnosis.model_comparison import Node, evidence, far, share_of
from motorid.diagnosis.predictive_score import QUICK, Evidence, Predictions, compare
from motorid.diagnosis.thresholds import MOST, PLAIN, STANDARD_ERRORS, SUPPLANTS, TRIFLE, UNCONTESTED
from motorid.display.numbers import listed, number, percent
from motorid.effects import LIBRARY
from motorid.errors import ModelError, otherwise
from motorid.estimation.angle_orders import uses_angle
from motorid.estimation.fit import follows, solve
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.linearisation import INSEPARABLE
from motorid.estimation.result import Fit
from motorid.model.definition import Effect
from motorid.model.model import Model
from motorid.problem.runs import SGN_WIDTH_SHARE
from motorid.records.checks import current_limit

LIMITER = "driver_current_limit"
IN_ITS_PLACE = "{}, which the library lacks, predicts better in its place"
DIFFERENCED = "the speed reads half a sample late, as a difference of counts does"
LATENESS = {"speed_lag": 1.0, "speed_delay": 1.0, "speed_average": 0.5}  # mean, of the time of these effects


@dataclass(frozen=True)
class FormGain:
    """A free form, what a model with it predicts, and what of that is better than the model it is compared with."""

    form: Form
    evidence: Evidence
    predictions: Predictions
    smaller: bool = False  # it leaves noise with fewer unknowns in the place of effects of that model


def better_forms(fit: Fit, rival: Fit, channels: Container[str] = CHANNELS) -> list[FormGain]:
    """Return the forms that added to `fit` predict better than `rival`, the best first, memories last."""
    try:
        linear = free_forms.linearised(fit)
        answers = {form: Answers(fit, linear, form).predictions() for form in linear.forms}
        zeroed = [f for f in answers if f.on == "turn"] if far(fit) and free_forms.may_be_zeroed(fit) else []
        zeroed += free_forms.swinging(fit, answers) if far(fit) else []
        for form in zeroed:
            plain, own = answers[replace(form, zeroed=False)], free_forms.zeroed(fit, linear, form)
            known = Answers(fit, own, form).predictions()
            if plain and known and compare(plain, known).sure:  # one curve, shifted, is to do it, not its size alone
                shifted = free_forms.linearised(fit, form, zeros=free_forms.zeros_of(fit, form))
                one = Answers(fit, shifted, form).predictions()
                size = answers.get(replace(form, on="run", zeroed=False))
                if one and compare(plain, one).sure and not (size and not compare(size, one).sure):
                    answers[replace(form, zeroed=True)] = one
    except FAILURES:
        return []
    known, gains = predictive_score.predictions_left_out(rival, evenly=True) or {}, []
    asked = Predictions({c: e for c, e in known.items() if c in channels}, {})
    for form, predicted in answers.items():
        if predicted is not None:
            found = compare(asked, predicted)
            found = replace(found, gain=found.gain - np.log(len(linear.forms)))  # the best of many gains by chance
            both = found.worth_it and compare(Predictions(known, {}), predicted).worth_it  # not to the others' cost
            gains += [FormGain(form, found, predicted)] if both else []
    gains.sort(key=lambda g: -g.evidence.gain)
    if gains and gains[0].form.remembers:
        best = gains[0].predictions
        gains.sort(key=lambda g: g.form.remembers or compare(g.predictions, best).sure)
    return gains


def in_turn(gains: Sequence[FormGain]) -> tuple[Form, ...]:
    """Return the forms by their gain and by what all channels leave, in turn: one sensor's error may gain most."""
    both = zip(gains, sorted(gains, key=lambda g: -g.evidence.fall), strict=True)
    return tuple(dict.fromkeys(g.form for pair in both for g in pair))


def hum_of(fit: Fit, gains: Sequence[FormGain]) -> str:
    """Return in words the hum that predicts as well as any function of the time in a sensor, if none of the `gains` is
    surely better than that, and it surely better than all that follow the motion; empty for none."""
    best = next((g for g in gains if g.form.on == "t" and g.form.balance == "sensor"), None)
    if best is None or compare(best.predictions, gains[0].predictions).sure or not all(
            compare(g.predictions, best.predictions).sure for g in gains if g.form.on != "t"):
        return ""
    span = free_forms.span_of(fit, free_forms.signals_along(fit))
    waves = [k for k, f in enumerate(free_forms.functions_of(best.form, span)) if f.startswith("ca.sin(")]
    alone = Answers(fit, free_forms.linearised(fit, best.form), best.form).predictions(waves) if waves else None
    if alone is None or compare(alone, best.predictions).worth_it:
        return ""
    hertz = number(span.rates[best.form.swings or "t"][0] / 2 / np.pi, 3)
    return f"a hum of {hertz} Hz in the sensor of {channel_name(best.form.channel)}"


class Answers:
    """A model's slopes and its answers to the functions of a form, with what all sets of these functions share."""

    def __init__(self, fit: Fit, linear: Linear, form: Form) -> None:
        self.problem, self.residual, self.known = fit.problem, linear.residual, linear.slopes.shape[1]
        self.columns = np.asfortranarray(np.column_stack([free_forms.form_columns(fit, linear, form)[0], linear.own]))
        self.functions = self.columns.shape[1] - self.known - linear.own.shape[1]
        self.normal, self.products = self.columns.T @ self.columns, self.columns.T @ self.residual
        self.blocks = predictive_score.blocks_of(self.problem.experiments, evenly=True)
        self.labels = predictive_score.stacked_labels(self.problem, self.blocks)

    def predictions(self, kept: Sequence[int] | None = None) -> Predictions | None:
        """Return what the model with those functions, or all, predicts of blocks left out; None if slopes mislead."""
        functions = [self.known + k for k in (range(self.functions) if kept is None else kept)]
        both = [*range(self.known), *functions, *range(self.known + self.functions, self.columns.shape[1])]
        try:
            sizes = free_forms.ridge(self.normal[np.ix_(both, both)], self.products[both], self.residual)
            residual = self.residual - (columns := self.columns[:, both]) @ sizes
            moved = predictive_score.left_out(residual, columns[:, : self.known + len(functions)], self.labels)
        except np.linalg.LinAlgError:
            return None
        found = predictive_score.by_channel(self.problem, moved, self.blocks)
        return Predictions(found, {}) if np.isfinite(moved).all() else None


def chosen_functions(fit: Fit, linear: Linear, form: Form, chosen_before: Iterable[int] = (),
                     first: bool = False) -> list[int]:
    """Return the fewest functions of a form that beside `fit` predict blocks left out, or the `first` of them alone.

    Orthogonal matching pursuit (Pati, Rezaiifar & Krishnaprasad 1993): each time the function that takes most of what
    is left. Of the sets passed the smallest that predicts within one standard error of the best is taken (Breiman et
    al., Classification and Regression Trees, 1984, 3.4), if it is worth it. What the model's own parameters do already
    is no function of its own. The waves of a narrow dip help only together, so sets are passed as long as one function
    more takes what no noise would give to the best of so many (Donoho & Johnstone, Biometrika 81(3), 1994)."""
    answers = Answers(fit, linear, form)
    if (before := answers.predictions(())) is None:
        return []
    best = tuple[int, ...](), before
    sets, passed = [best], list(_pursued(answers, list(chosen_before)))
    if first:  # sets of twice as many as the one before, and the last, tell whether any is worth it
        passed = [some for some in passed if not len(some) & (len(some) - 1) or some is passed[-1]]
    for chosen in passed:
        if (after := answers.predictions(chosen)) is not None:
            if first and compare(before, after).worth_it:
                return [chosen[0]]
            sets.append((chosen, after))
            best = (chosen, after) if compare(best[1], after).gain > 0 else best
    chosen, after = next(s for s in sets if (e := compare(s[1], best[1])).gain <= e.se)
    return list(chosen) if not first and compare(before, after).worth_it else []


def pitches_of(fit: Fit, form: Form, span: Span) -> int:
    """Return how often to the turn a curve repeats: the most times for which waves that do predict as well as all."""
    with contextlib.suppress(*FAILURES):
        answers = Answers(fit, free_forms.linearised(fit, form, span), form)
        orders = [0, *np.repeat(free_forms.waves_of(span), 2)]
        none, whole = answers.predictions(()), answers.predictions()
        for n in range(int(max(orders)) // 2, 1, -1):
            some = answers.predictions([j for j, k in enumerate(orders) if k % n == 0])
            if none and some and whole and compare(none, some).worth_it and not compare(some, whole).worth_it:
                return n
    return 1


def _pursued(answers: Answers, had: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Yield sets of functions, each with the one more that takes most of what is left (Technion CS-2008-08)."""
    own = slice(answers.known, answers.known + answers.functions)
    known = answers.columns[:, : answers.known]
    known = np.linalg.svd(known[:, np.linalg.norm(known, axis=0) > 0], full_matrices=False)[0]
    across, along = known.T @ answers.columns[:, own], known.T @ answers.residual
    left, products = answers.normal[own, own] - across.T @ across, answers.products[own] - along @ across
    square, least = float(answers.residual @ answers.residual - along @ along), np.diagonal(answers.normal)[own]
    chosen: tuple[int, ...] = ()
    while True:
        free = np.diagonal(left) > INSEPARABLE**2 * least
        free[[*had, *chosen]] = False
        norms = np.sqrt(np.where(free, np.diagonal(left), 1.0))
        taken = np.where(free, np.abs(products) / norms, 0.0)
        best = int(np.argmax(taken))
        if not (free[best] and taken[best] ** 2 > 2 * np.log(len(taken)) * square / len(answers.residual) > 0):
            return  # nor where nothing is left, which rounding makes less than nothing
        unit, product = left[:, best] / norms[best], products[best] / norms[best]
        left, products, square = left - np.outer(unit, unit), products - product * unit, square - product**2
        yield (chosen := (*chosen, best))


@dataclass(frozen=True)
class Grade:
    """What an effect may be called: ``"named"``, ``"group"`` or ``"approximates"``, and why."""

    effect: str
    grade: str
    why: str = ""
    form: Form | None = None


def grades_of(last: Node, root: Node, groups: Sequence[Sequence[str]], beside: Sequence[FormGain], structure: bool,
              without: Callable[[str], Node | None]) -> tuple[Grade, ...]:
    """Return the grade of each effect that `last` has and `root` has not.

    A rung that predicts better stays, whatever it is. Its effect is *named* if its law is physical there and its size
    more than two of its deviations, the model with it follows the records, no rival predicts as well, no free form that
    contains it, or in its place, predicts better by more than the trifle that a free curve follows in any real motor
    and by more than a trifle of what the effect itself does, and it explains more than it leaves, on held-out runs too,
    unless that is noise (no `structure`). A form `beside` the effect that predicts surely less than the best one only
    imitates that.
    `without` gives the model without one of the effects, if there is one."""
    rivals = {g[0]: g[1:] for g in groups}
    limited = structure and LIMITER not in last.key and any(current_limit(run) for run in root.fit.problem.experiments)
    found = []
    for e in (e for e in last.fit.model.effects if e.name not in root.key):
        why, form = objections(last.fit, e, root.fit), None
        why = DIFFERENCED if _half_a_sample(last.fit, e) else why
        why = why or ("it may only stand in for the driver's current limit" if limited else "")
        why = why or ("the model does not follow the records with it" if structure and not follows(last.fit) else "")
        why = why or _insignificant(last, e, structure, root, without) or _within_smoothing(last.fit, e)
        if (smaller := without(e.name) if not why and (structure or far(last.fit)) else None) is not None:
            free = [b for b in beside if not compare(b.predictions, beside[0].predictions).sure]
            free = [b for b in free if (differs(last.fit, b.form, e) or 0.0) > TRIFLE]
            free = free or better_forms(smaller.fit, last.fit)
            did = evidence(smaller, last)
            fall, least = did.fall, did.fall if did.held_out_fall is None else min(did.fall, did.held_out_fall)
            told = [b for b in free if outdoes(fall, b.evidence.fall)]
            better = next((b for b in told if beside and b.form == beside[0].form), told[0] if told else None)
            if better is not None:
                form, why = better.form, IN_ITS_PLACE.format(better.form.text)
            elif 1 - (1 - max(least, 0.0)) ** 2 < (UNCONTESTED if e.balance == "transmission" else MOST):
                share = share_of(e.name, last, smaller)
                most = f"{percent(share, 2)} of" if share > 0 else "nothing, over all channels, of"
                why = f"it removes {most} the squared error, and the rest is not noise"
        kind = "approximates" if why else "group" if rivals.get(e.name) else "named"
        found.append(Grade(e.name, kind, why, form))
    return _no_surer_than_what_they_act_on(tuple(found), last.fit)


def _no_surer_than_what_they_act_on(grades: tuple[Grade, ...], fit: Fit) -> tuple[Grade, ...]:
    """Return grades where an encoder's zero, or a warm start, of every run is no surer than the effects it acts on."""
    found = []
    for g in grades:
        on = _acted_on(fit.model, g.effect)
        asking = [other for other in grades if other.effect in on]
        alike = len(asking) == len(on) > 0 and {other.grade for other in asking} == {"approximates"}
        found.append(replace(asking[0], effect=g.effect) if alike else g)
    return tuple(found)


def _acted_on(model: Model, name: str) -> list[str]:
    """Return the effects without which one that is another in every run says nothing, or cannot be."""
    acting, *others = sorted(model.effects, key=lambda e: e.name != name)
    if tells_the_zero(acting):
        return [e.name for e in others if uses_angle(e)]
    alone = model.without(name) if any(p.per_run for p in acting.parameters) else model
    return [e.name for e in others if _may_go(alone, e.name) and not _may_go(model, e.name)]


def _may_go(model: Model, name: str) -> bool:
    """Tell whether no other effect needs that one."""
    return otherwise(False, ModelError, lambda: model.without(name) is not model)


def tells_the_zero(effect: Effect) -> bool:
    """Tell whether an effect is a zero of the angle of every run's own."""
    return uses_angle(effect) and any(p.per_run for p in effect.parameters)


def outdoes(fall: float, further: float) -> bool:
    """Tell whether the error falls `further` by a form in an effect's place, by more than a trifle of its fall, RMS."""
    left = (1 - max(fall, 0.0)) ** 2
    return further > SUPPLANTS and np.sqrt(left * (1 - (1 - further) ** 2) / max(1 - left, 1e-12)) > TRIFLE


def _insignificant(last: Node, effect: Effect, structure: bool, root: Node,
                   without: Callable[[str], Node | None]) -> str:
    """Say so where every size of an effect is within two deviations of nothing, and without it the error hardly rises.

    One without a deviation may be any; of a law whose sizes are all open, as voltages too where no current is known,
    little is known, unless it leaves noise, as the first model does not, and the error falls plainly by its size."""
    fit, own = last.fit, [p for p in effect.parameters if last.fit.problem.model.parameters[p.name].vary]
    sizes = [p.name for p in own if p.null == 0]
    found = [(fit.values[n], fit.std[n]) for n in sizes]
    found += [(own["value"], own["std"]) for n in sizes for own in fit.per_run.get(n, {}).values()]
    torques = {} if {"i", "omega"} <= {*fit.problem.outputs} else fit.determined  # K stays open, and every torque
    found += [(q.value, q.std) for n in sizes if (q := torques.get(f"{n}_voltage")) is not None]
    if sizes and not any(std is None or STANDARD_ERRORS * std < abs(value) for value, std in found):
        smaller = without(effect.name)  # deviations are of slopes, and zero may be far from where these hold
        if smaller is None or evidence(smaller, last).fall < PLAIN:
            return f"{listed(sizes)} could as well be zero, within two standard deviations"
    free = [p.name for p in own if not sizes or p.name in sizes]
    known = any(fit.std[n] is not None or f"{n}_voltage" in torques for n in free) or any(p.per_run for p in own)
    if free and not known:
        more = structure or bool(far(fit))  # than noise
        smaller = without(effect.name) if sizes and not more and far(root.fit) else None
        if more or not far(root.fit) or (smaller is not None and evidence(smaller, last).fall < PLAIN):
            return f"{listed(free)} {'are' if free[1:] else 'is'} not determined{', and the rest is not noise' * more}"
    return ""


def sample_of(fit: Fit) -> float:
    """Return the time between samples of the records as they were read, s."""
    run = fit.problem.experiments[0]
    return float(np.median(np.diff(run.t))) / run.meta.get("every", 1)


def _half_a_sample(fit: Fit, effect: Effect) -> bool:
    """Tell whether an effect makes the speed late by half a sample of the records, or the mean over each predicts as
    well in its place, whatever lag the winding, the rotor and the noise of counts then share out among them."""
    if effect.name not in LATENESS or "speed_average" in fit.model.without(effect.name).effect_names:
        return False
    half, name, share = 0.5 * sample_of(fit), effect.parameters[0].name, LATENESS[effect.name]
    late, unsure = share * fit.values[name], STANDARD_ERRORS * share * (fit.std.get(name) or 0.0)
    if abs(late - half) < max(TRIFLE * half, min(unsure, half)):
        return True
    model = (fit.model.without(effect.name) + LIBRARY["speed_average"]).fix(T_a=2 * half)
    other = otherwise(None, FAILURES, lambda: solve(fit.problem.with_(model=model), QUICK))
    both = [f and predictive_score.predictions_left_out(f) for f in (other, fit)]
    return all(both) and not compare(*(Predictions(known or {}, {}) for known in both)).worth_it


def _within_smoothing(fit: Fit, effect: Effect) -> str:
    """Say so where an effect does less than what a smooth sgn, so wide, gets wrong of the friction beside it."""
    if effect.balance != "torque" or "sgn_width" not in fit.values:
        return ""
    at = fit.problem.system.states.index("omega")
    forces = {e.name: max((float(np.sqrt(np.mean(free_forms.pushes_of(fit, p.name)[:, at] ** 2))) for p in e.parameters
                           if p.null == 0 and p.vary), default=0.0) for e in fit.model.effects if e.balance == "torque"}
    if forces[effect.name] < SGN_WIDTH_SHARE * max(forces.values()):
        return f"it does less than {percent(SGN_WIDTH_SHARE, 1)} of what the others do, as a smooth sgn gets wrong"
    return ""


def differs(fit: Fit, form: Form, effect: Effect) -> float | None:
    """Return by what share, RMS, a form differs from an effect that is a special case of it; None if it is none."""
    sizes = [p.name for p in effect.parameters if p.null == 0]
    if not sizes or not all(free_forms.contains(fit, form, [name]) for name in sizes):
        return None
    own = max(float(np.sqrt(np.mean(free_forms.force_along(fit, form, [name]) ** 2))) for name in sizes)
    return free_forms.force_of(fit, form) / own

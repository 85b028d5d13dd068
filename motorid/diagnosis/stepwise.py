"""The loop: rank, refit the best, keep what lowers the held-out error, drop what has become superfluous, repeat.

After each addition the earlier effects are tried without, and with others in their places, so that a wrong first choice
(Coulomb where the friction grows with the load) can be overtaken."""

import contextlib
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from motorid.channels import worded
from motorid.diagnosis import misspecification
from motorid.diagnosis import record_versions as versions
from motorid.diagnosis.adequacy import following, judge_adequacy, within_noise
from motorid.diagnosis.admissibility import run_through, undetermined
from motorid.diagnosis.candidates import Search, Stages
from motorid.diagnosis.misspecification import IN_ITS_PLACE, FormGain, Grade, better_forms, differs, grades_of, outdoes
from motorid.diagnosis.model_comparison import Node, at_noise, beats, choose, evidence, far, group_of, node_of
from motorid.diagnosis.predictive_score import QUICK, HeldOut, is_sure
from motorid.diagnosis.refit import INTERRUPTED, OUT_OF_TIME
from motorid.diagnosis.remainder import alone_predicting_more, beside_leaving_noise
from motorid.diagnosis.results import Adequacy, Candidate, Ladder, Rung
from motorid.diagnosis.thresholds import ELSEWHERE, LARGER, MATERIAL, MOST, TRIFLE
from motorid.diagnosis.verdict import first_answer
from motorid.errors import OutOfTime, otherwise
from motorid.estimation.fit import TOO_FAR, UNFOLLOWED, follows, growth, in_windows, solve
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit
from motorid.model.definition import Effect
from motorid.numerics import parallel
from motorid.records.experiment import Experiment, units_of

ORDER = ("named", "group", "approximates")  # grades, the surest first
FITTED_TOO = ("The fitted runs alone leave nothing but noise, and the model that they determine fails on the held-out "
              "ones: these were fitted, too, and none are left to judge by.")
DRAWS_BACK = frozenset(("spring", "end_stop"))  # what drifts, whatever is missing


@dataclass(frozen=True, eq=False)
class Climb:
    """What the loop went through: the final path, per round the candidates, the groups of what was chosen.

    `forms` are the free forms that predict better beside all effects, the best first; `grades` are of the effects.
    `rivals` are the last model, and what it is with the others of the first group.
    `stopped` says why it ended before it was done, if it did; `misread` is the reading for which it was left."""

    search: Search
    path: tuple[Node, ...]
    rounds: tuple[tuple[Candidate, ...], ...]
    groups: tuple[tuple[str, ...], ...]
    text: str
    first: Adequacy
    remaining: Adequacy
    forms: tuple[FormGain, ...] = ()
    grades: tuple[Grade, ...] = ()
    stopped: str = ""
    rivals: tuple[Fit, ...] = ()
    misread: versions.Reading | None = None


def climb(search: Search, max_effects: int, seconds: float | None = None, early: bool = False) -> Climb:
    """Run the loop until nothing more is worth adding, until the time is up, or until it is interrupted (Ctrl-C).

    What was found by then is the answer; `stopped` says so. `early`: also until a voltage turns out to act earlier."""
    began = time.monotonic()
    scores = search.scores(search.root)
    first = judge_adequacy(search.root, scores)
    if not search.stages.again:
        search.stages.done(first_answer(search.root.fit, first, scores))
    found = Climb(search, (search.root,), (), (), "", first, first)
    steps = _rounds(found, max_effects)
    looked = time.monotonic() - began  # about as long as to look at what remains
    try:
        with parallel.budget(seconds and max(seconds - 2 * looked, 0.0)):
            while (further := next(steps, None)) is not None:
                found = further
                if early and far(fit := found.path[-1].fit) and (misread := versions.better_reading(fit, earlier=True)):
                    return replace(found, misread=misread)
        search.stages.round(max_effects + 1)
        search.stages.at("Looking at what remains")
        if not found.stopped:
            return _finished(found)
    except (OutOfTime, KeyboardInterrupt) as error:
        parallel.interruption.heard()
        found = replace(found, stopped=OUT_OF_TIME if isinstance(error, OutOfTime) else INTERRUPTED)
    return _finished(replace(found, text=f"stopped early: {found.stopped}; more may be missing",
                             rounds=found.rounds or (tuple(search.listed(scores, {}, found.stopped)),),
                             remaining=judge_adequacy(found.path[-1])))


def _rounds(found: Climb, max_effects: int) -> Iterator[Climb]:
    """Yield how far the loop is, after every step that may be the last."""
    search, best = found.search, found.path[-1]
    for k in range(2 * max_effects):  # what comes in the place of two leaves room for another
        search.stages.round(min(k + 1, max_effects))
        room = max_effects - len(best.key) + len(search.root.key)  # two effects may have come at once
        if room < 1 or (found.remaining.adequate and at_noise(best)):
            break
        (children, listed), stopped = search.expand(best), search.stopped
        chosen = _better(children, best)
        if room > 1 and not stopped and far(best.fit):
            pairs = [] if chosen else search.expand_by_two(best)
            refused = _outdoing(listed, children, best, chosen and chosen[0])
            pairs += search.expand_from(best, refused) if refused is not None and not search.stopped else []
            children = [*children, *pairs]
            chosen, stopped = _better(pairs, best) or chosen, search.stopped
        found = replace(found, rounds=(*found.rounds, tuple(listed)), stopped=stopped)
        search.nodes |= {c.key: c for c in children}
        while chosen is not None:
            new, ordered = chosen
            yield _with(found, new, new, new.parent is best, ())
            if stopped:
                return
            search.nodes[new.key] = new = search.brought_to_its_end(new)
            if _better([new], best):
                break
            chosen = _better([c for c in ordered if c.key != new.key], best)  # at its optimum it predicts no more
        else:
            yield replace(found, text="stopped: no further effect lowers the error on data left out")
            return
        if (out := search.led_out(best, new)) is not best:
            best, found = out, _with(replace(found, rounds=found.rounds[:-1]), out, out, False, ())
            found = replace(found, remaining=judge_adequacy(out, search.scores(out)))
            continue
        pruned = search.exchanged(search.pruned(new, best), best)
        pruned = pruned if pruned is new else search.brought_to_its_end(pruned)
        chosen_of = pruned if pruned.added != new.added and pruned.parent is new.parent else new
        group = group_of(chosen_of, ordered, {e.name: e.includes for e in search.effects})
        found = _with(found, pruned, chosen_of, new.parent is best, group)
        found, best = replace(found, remaining=judge_adequacy(pruned, search.scores(pruned))), pruned
        search.stages.done(f"accepted {chosen_of.added}")
        yield found
    done = found.remaining.adequate and at_noise(best)
    yield replace(found, text="stopped: what remains is noise" if done
                  else f"stopped at the limit of {max_effects} effects")


def _with(found: Climb, best: Node, chosen: Node, ranked: bool, group: tuple[str, ...]) -> Climb:
    """Return a climb that has come to `best`; the candidate that was chosen is marked where it was `ranked`."""
    rounds = (*found.rounds[:-1], _marked(found.rounds[-1], chosen, group)) if ranked else found.rounds
    groups = (*found.groups, (chosen.added or "", *group)) if group else found.groups
    return replace(found, path=_path(best), rounds=rounds, groups=groups)


def _finished(found: Climb) -> Climb:
    """Return a climb with the free forms that predict better beside all effects, and the grade of each effect."""
    search, best = found.search, found.path[-1]
    met = frozenset[str]().union(*(node.key for node in found.path))
    groups, rivals = _still_alike(found)
    alike = frozenset[str]().union(*groups)
    rounds = tuple(tuple(_as_it_ended(c, best.key, met, alike) for c in r) for r in found.rounds)
    structure = not found.remaining.adequate
    forms = better_forms(best.fit, best.fit) if structure and (best is not search.root or not found.stopped) else []
    if structure and not forms and at_noise(best) and not found.stopped:
        found, structure = replace(found, remaining=within_noise(found.remaining)), False
    grades = grades_of(best, search.root, groups, forms, structure,
                       lambda name: None if found.stopped else search.without(best, name))
    if not found.stopped and any(map(_imitates, grades)) and any(g.grade != "approximates" for g in grades):
        grades = _sure_alone(search, best, grades)
    return replace(found, rounds=rounds, groups=groups, rivals=rivals, forms=tuple(forms), grades=grades)


def _still_alike(found: Climb) -> tuple[tuple[tuple[str, ...], ...], tuple[Fit, ...]]:
    """Return the groups left beside what was found after them, and the rivals of the first."""
    search, best, groups, rivals = found.search, found.path[-1], list[tuple[str, ...]](), tuple[Fit, ...]()
    for first, *others in (g for g in found.groups if g[0] in best.key):
        swapped = {n: search.in_place(best, first, n, bool(found.stopped)) for n in others if n not in best.key}
        alike = {n: node for n, node in swapped.items() if node is None or not (node.objection or beats(best, node))}
        if alike:
            groups.append((first, *alike))
            rivals = rivals or (best.fit, *(node.fit for node in alike.values() if node is not None))
    return tuple(groups), rivals


def _beside_curves(found: Climb) -> Climb:
    """Return a climb with grades that hold beside the curve that leads, fitted beside a special case of it, or in its
    place; where the first model does not follow also in the place of all that was found: slopes lead astray there."""
    search, best, grades = found.search, found.path[-1], list(found.grades)
    if (found.remaining.adequate and at_noise(best)) or all(g.grade == "approximates" for g in grades):
        return found
    special = {e.name: share for gain in found.forms[:1] for e in best.fit.model.effects
               if e.name not in search.root.key and (share := differs(best.fit, gain.form, e)) is not None}
    curve = beside_leaving_noise(best, found.forms[0].form, special, search.held) if special else None
    if not (curve and curve.smaller) and (
            alone := alone_predicting_more(best, search.root.fit, search.held, [gain.form for gain in found.forms])):
        curve, special = alone, dict.fromkeys(best.key, np.inf)
    for k, g in enumerate(grades):
        if curve and g.grade != "approximates" and special.get(g.effect, 0.0) > (0.0 if curve.smaller else TRIFLE):
            grades[k] = Grade(g.effect, "approximates", IN_ITS_PLACE.format(curve.form.text), curve.form)
            found = replace(found, remaining=following(found.remaining, curve.form.text))
    return replace(found, grades=tuple(grades))


def _sure_to_the_end(found: Climb) -> Climb:
    """Return a climb in which stops that the motor runs through are named no more; nor, where more than noise is left,
    a law that the records do not show whole: a free parameter makes it fit what has another shape. Nor, beside what
    only approximates, one of which they show nothing: that is as likely to stand in for something else."""
    more = bool(far(fit := found.path[-1].fit)) or not found.remaining.adequate
    half = any(map(_imitates, found.grades))
    told = {e.name: run_through(fit, e) or (undetermined(fit, e, not more) if more or half else "")
            for e in fit.model.effects}
    return replace(found, grades=tuple(g if g.grade == "approximates" or not told[g.effect] else Grade(
        g.effect, "approximates", told[g.effect]) for g in found.grades))


def _imitates(grade: Grade) -> bool:
    """Tell whether an effect only stands in for something else, which may be in another's place, too."""
    return grade.grade == "approximates" and grade.why != misspecification.DIFFERENCED


def _sure_alone(search: Search, best: Node, grades: tuple[Grade, ...]) -> tuple[Grade, ...]:
    """Return grades that hold without what only imitates something else: that may be in a sure effect's place, too."""
    core = best
    for g in filter(_imitates, grades):
        core = search.without(core, g.effect) or core
    alone = grades_of(core, search.root, (), better_forms(core.fit, core.fit), True, partial(search.without, core))
    told = {g.effect: g for g in alone if g.form}
    return tuple(g if g.grade == "approximates" else told.get(g.effect, g) for g in grades)


def _as_it_ended(tried: Candidate, last: frozenset[str], met: frozenset[str], alike: frozenset[str]) -> Candidate:
    """Return a candidate as the `last` model has it; what no model on the way there `met` was not taken after all."""
    tried = replace(tried, group=tuple(n for n in tried.group if n in alike - last))  # what was found is no rival
    if tried.accepted and not met.issuperset(tried.effect.split(" + ")):
        return replace(tried, accepted=False, reason="taken at first, but a model without it predicts better")
    return tried if tried.accepted or tried.effect not in last else replace(tried, reason="added in a later step")


def _better(children: Collection[Node], best: Node) -> tuple[Node, list[Node]] | None:
    """Return the best child, if it beats the best model so far, and all in order.

    What physics speaks against is taken only where nothing else helps, held-out runs bear it out and it outdoes what it
    takes the place of: a friction that is less at rest is a dry one, rounded. So is what explains less of a channel
    than it leaves (the supply's current), as parameters then mean nothing. Where the score is sure of nothing, a plain
    fall of the error begins a ladder: at rest the density prefers what never moves."""
    better = [c for c in children if beats(c, best)]
    if (plain := [] if better else [c for c in children if evidence(best, c).plain]) and best.parent is None:
        plain.sort(key=lambda c: (bool(c.objection), -(evidence(best, c).held_out_fall or 0.0)))
        return plain[0], plain
    sound, did = [c for c in better if not c.objection], evidence(_path(best)[0], best).fall
    falls = ((c, evidence(best, c)) for c in better if not best.key - c.key or outdoes(did, evidence(best, c).fall))
    taken = sound or [c for c, e in falls if e.held_out_fall is None or e.held_out_fall > MATERIAL]
    kept = [c for c in taken if not any(e.nrmse**2 > MOST and s != "theta"  # which sums up every trifle
                                        for s, e in (c.predictions.held_out or c.predictions.blocks).items())]
    return choose(kept or taken, best)


def _outdoing(listed: Sequence[Candidate], children: Sequence[Node], best: Node,
              chosen: Node | None) -> Candidate | None:
    """Return what surely predicts more than the best child, though held-out runs, lacking more than it, refuse it."""
    known = [c for c in listed if c.fit is not None and c.gain is not None and c.gain_se is not None]
    first = max(known, key=lambda c: c.gain or 0.0, default=None)
    if first is None or any(first.effect in child.key for child in children):
        return None
    if chosen is None and (first.gain or 0.0) > 0:
        return first
    gain, se = ((than := evidence(best, chosen)).gain, than.se) if chosen is not None else (0.0, 0.0)
    return first if is_sure((first.gain or 0.0) - gain, float(np.hypot(first.gain_se or 0.0, se))) else None


@dataclass(frozen=True, eq=False)
class Records:
    """What a climb begins with: a fit to the records, held-out runs, and what was done to either."""

    fit: Fit
    held_out: Sequence[Experiment] | None
    remarks: tuple[str, ...] = ()
    reading: versions.Reading | None = None  # the last one, of which the last remark tells

    def read(self, reading: versions.Reading) -> "Records":
        """Return all records read in another way."""
        after = reading.fitted(self.fit)
        held_out = self.held_out and [reading.of(r) for r in self.held_out]
        return Records(after, held_out, (*self.remarks, reading.remark(self.fit, after)), reading)

    def suited(self, node: Node) -> tuple[Fit | None, bool]:
        """Return the model of `node` fitted to these records, and whether that predicts these better."""
        with contextlib.suppress(*FAILURES):
            if len(node.fit.model.effects) != len(self.fit.model.effects):
                problem = self.fit.problem.with_(model=node.fit.model, noise_factors={})
                own = node_of(solve(problem, start="model"), HeldOut.of(self.fit, self.held_out))
                return own.fit, evidence(node, own).gain > 0
        return None, False


def explored(fit: Fit, validate: Sequence[Experiment] | Experiment | None, effects: Sequence[Effect],
             stages: Stages, max_effects: int, seconds: float | None = None) -> tuple[Climb, str]:
    """Return the climb, as far as it came where the time is up or it is interrupted, and how the records were read."""
    began = time.monotonic()

    def left() -> float | None:
        return None if seconds is None else max(seconds - (time.monotonic() - began), 0.0)

    def climbed(records: Records, most: int = max_effects, early: bool = False, among: Collection[str] = ()) -> Climb:
        stages.climb()
        tried = [e for e in effects if not among or e.name in among]
        return climb(Search(records.fit, records.held_out, tried, stages), most, left(), early)

    looks = _looks(fit, [validate] if isinstance(validate, Experiment) else validate, climbed, left)
    found, records = next(looks)
    try:
        while not found.stopped and (further := next(looks, None)) is not None:
            found, records = further
    except (OutOfTime, KeyboardInterrupt) as error:
        parallel.interruption.heard()
        why = OUT_OF_TIME if isinstance(error, OutOfTime) else INTERRUPTED
        found = replace(found, stopped=why, text=f"stopped early: {why}; not all was looked at")
    return _sure_to_the_end(found), " ".join(records.remarks)


def _looks(fit: Fit, held_out: Sequence[Experiment] | None, climbed: Callable[..., Climb],
           left: Callable[[], float | None]) -> Iterator[tuple[Climb, Records]]:
    """Yield the climb and its records after every look that may be the last; each has the time that is `left`.

    A misfit that something missing dominates may hide a better reading of the voltage; then it is climbed again."""
    def look(at: Callable[..., Any], *given: Any) -> Any:
        with parallel.budget(left()):
            return at(*given)

    seconds = left()
    as_it_was, records, found = _read_and_climbed(versions.affordable(fit), held_out, climbed)
    yield found, records
    early = seconds is None or (left() or 0.0) > 2 * seconds / 3
    if among := early and look(_asking_for_all, found, fit, held_out):
        *whole, anew = _read_and_climbed(fit, held_out, partial(climbed, among=among))
        found = replace(found, stopped=anew.stopped) if anew.stopped else anew
        as_it_was, records = whole if found is anew else (as_it_was, records)
        yield found, records
    if (windowed := look(_in_windows, found)) is not None:
        anew = climbed(parts := replace(records, fit=windowed))
        found, records = (replace(found, stopped=anew.stopped), records) if _explains(found, anew) else (anew, parts)
        yield found, records
    found, records = _read_late(found, records, as_it_was, climbed, look)
    yield found, records
    yield (found := look(_seen_on_whole, found, fit)), records
    found, records = _with_held_out(found, records, climbed)
    yield found, records
    yield look(_beside_curves, found), records


def _read_late(found: Climb, records: Records, as_it_was: Records, climbed: Callable[..., Climb],
               look: Callable[..., Any]) -> tuple[Climb, Records]:
    """Return the climb of records as the model with its effects asks for them, where that differs and predicts more."""
    last, again, reading = found.path[-1], None, None
    reread = not last.fit.window and records.remarks != as_it_was.remarks
    own, suits = look(as_it_was.suited, last) if reread else (None, False)
    if own and records.reading:  # of the model with its effects
        records = replace(records, remarks=(*records.remarks[:-1], records.reading.remark(own, last.fit)))
    if suits:
        again = as_it_was
    elif reading := look(_late_reading, found.path):
        first = records.reading.delay if records.reading and len(records.remarks) == len(as_it_was.remarks) + 1 else 0.0
        both = first + reading.delay if first and reading.delay else 0.0  # are one, unless one takes the other back
        late = as_it_was.read(versions.delay_of(both)) if both else records.read(reading)
        again = late if len(found.path) == 1 or late.suited(last)[1] else None
    if again is not None:
        anew = climbed(again)
        if (better := evidence(last, new := anew.path[-1])).gain > 0 and better.fall > 0:
            if reading and again.reading:
                before = last.fit if again.reading is reading or own is None else own
                again = replace(again, remarks=(*again.remarks[:-1], again.reading.remark(before, new.fit)))
            records, found = again, anew
        found = replace(found, stopped=anew.stopped)
    return found, records


def _read_and_climbed(fit: Fit, held_out: Sequence[Experiment] | None,
                      climbed: Callable[..., Climb]) -> tuple[Records, Records, Climb]:
    """Return the records as they are, but for spikes, as they are better read, and a climb on those."""
    records = Records(fit, held_out and versions.thinned_alike(fit, held_out))
    as_it_was = records.read(spikes) if (spikes := versions.without_spikes(records.fit)) else records
    if sum(e / max(records.fit.nrmse[c], 1e-300) - 1 for c, e in as_it_was.fit.nrmse.items()) > 0:
        as_it_was = records  # what was left out did not belie the model
    records = as_it_was.read(reading) if (reading := versions.better_reading(as_it_was.fit)) else as_it_was
    if (found := climbed(records, early=True)).misread is not None:
        better = evidence(found.path[-1], (anew := climbed(again := records.read(found.misread))).path[-1])
        if min(better.gain, better.fall) > 0:
            records, found = again, anew
        elif anew.stopped:  # what was found by then is the answer
            last = judge_adequacy(found.path[-1])
            found = _finished(replace(found, stopped=anew.stopped, text=anew.text, remaining=last))
        else:
            found = climbed(records)
    return as_it_was, records, found


def _asking_for_all(found: Climb, whole: Fit, held_out: Sequence[Experiment] | None) -> set[str]:
    """Return the effects to try on all records, where a model leaves noise of these and more of what was looked at: all
    for one with a memory, on the way or refused, as that begins anew in every part; those refitted for the last, as a
    held voltage steps between thinned samples. Not where all would take more than `WHOLE` times as long."""
    last, every, on_way = found.path[-1].fit, [*whole.problem.experiments], [node.fit for node in found.path[1:]]
    refused = (c for tried in found.rounds[-1:] for c in tried if c.fit is not None and c.fit.memories)
    best, root = max(refused, key=lambda c: c.gain or 0.0, default=None), found.search.root.fit
    fits = on_way[:-1] if found.remaining.adequate else [*on_way, best and best.fit]
    fits, runs = [f for f in fits if f and f.memories], versions.whole_of(root, every)
    looks = [(f, runs, {e.name for e in found.search.effects}) for f in fits if runs]
    longer = versions.samples_of(every) / versions.samples_of(last.problem.experiments)
    if far(last) and not runs and 1 < longer <= versions.WHOLE:
        looks.append((last, every, {n for some in found.rounds for c in some if c.fit for n in c.effect.split(" + ")}))
    for fit, records, effects in looks:
        with contextlib.suppress(*FAILURES):
            if at_noise(node_of(versions.fitted_to(fit, records, QUICK), HeldOut.of(whole, held_out))):
                return effects
    return set()


def _seen_on_whole(found: Climb, whole: Fit) -> Climb:
    """Return a climb that knows what predicts more than noise on whole records only: a sensor's zero that drifts."""
    runs = versions.whole_of(last := found.path[-1].fit, whole.problem.experiments)
    if not (runs and found.remaining.adequate and far(last)):
        return found
    forms = better_forms(there := versions.fitted_to(last, runs, QUICK), there)
    return replace(found, forms=tuple(forms), remaining=following(found.remaining, forms[0].form.text)
                   ) if forms else found


def _with_held_out(found: Climb, records: Records, climbed: Callable[[Records], Climb]) -> tuple[Climb, Records]:
    """Return a climb with the held-out runs among the fitted ones, where the first model leaves noise alone on its own
    and fails on those: what is missing shows there, or they determine what the others do not."""
    last, fit = found.path[-1], found.path[-1].fit
    noise = len(found.path) == 1 and found.remaining.adequate and not (far(fit) or fit.window)
    if not noise or at_noise(last) or max(e.misfit for e in last.predictions.held_out.values()) <= ELSEWHERE:
        return found, records
    both = versions.fitted_to(fit, (*fit.problem.experiments, *(records.held_out or ())))
    joint = Records(both, None, (*records.remarks, FITTED_TOO))
    return (found, records) if both is fit else (climbed(joint), joint)


def _in_windows(found: Climb) -> Fit | None:
    """Return the first model's fit in windows, if one that it led to carries small errors too far over whole records.

    A pendulum upright says so only with its weight in the model; detents may be refused as the motor rested in others.
    Where the last model loses a channel, an axis drifts: no force is known so well that its sum is the motion; or where
    a spring draws back what the first one loses: in a position loop that always helps. Noise alone is no chance."""
    if at_noise(found.path[-1]):
        return None
    first, last = found.path[0].fit, found.path[-1].fit
    refused = [c for c in (found.rounds[-1] if found.rounds else ()) if c.fit is not None and not c.accepted]
    best = max(refused, key=lambda c: c.gain or 0.0, default=None)
    lost = not follows(last) or last.model.angle_input
    fit = last if lost else best.fit if best is not None and far(last) else None
    astray = [any(e.nrmse**2 > UNFOLLOWED and e.misfit > LARGER for e in node.predictions.held_out.values())
              or not follows(node.fit) for node in (found.path[0], found.path[-1])]
    part = in_windows(fit, partial(solve, solver=QUICK, start="model")) if fit and growth(fit) >= TOO_FAR else None
    held = last.model.angle_input or DRAWS_BACK & (found.path[-1].key - found.path[0].key)
    if part is None and (astray[1] or (held and astray[0])):
        part = in_windows(first, partial(solve, solver=QUICK), drifts=True)
    return otherwise(None, FAILURES, lambda: part and solve(part.problem.with_(model=first.model, noise_factors={})))


def _explains(whole: Climb, windowed: Climb) -> bool:
    """Tell whether what was found on whole records, which it follows, surely predicts more of windows of them than
    what was found there, or is all that there is; or that both are what draws back a drift."""
    last, there = whole.path[-1].fit, windowed.search
    if windowed.stopped and len(windowed.path) == 1:
        return True
    with contextlib.suppress(*FAILURES):
        if len(whole.path) > 1 and follows(last):
            if windowed.path[-1].key == whole.path[-1].key and whole.path[-1].key & DRAWS_BACK:
                return True
            problem = there.root.fit.problem.with_(model=last.model.with_(angle_input=False), noise_factors={})
            return evidence(windowed.path[-1], node_of(solve(problem, QUICK, start="model"), there.held)).sure
    return False


def _late_reading(path: Sequence[Node]) -> versions.Reading | None:
    """Return the reading that the model before any effect of a sensor asks for, since lags imitate one, or the last.
    None where neither leaves more than noise; a model that does not follow the records would ask for anything."""
    balances = [[e.balance for e in node.fit.model.effects if e.name not in path[0].key] for node in path]
    plain = max(k for k, kinds in enumerate(balances) if "sensor" not in kinds)
    fits = (path[k].fit for k in dict.fromkeys((plain, len(path) - 1)))
    asked = (versions.better_reading(fit, late=True) for fit in fits if far(fit) and follows(fit))
    return next((reading for reading in asked if reading is not None), None)


def _marked(listed: Sequence[Candidate], node: Node, group: tuple[str, ...]) -> tuple[Candidate, ...]:
    """Return the candidates with what was added marked, one effect or two that help only together."""
    names = node.key - node.parent.key if node.parent is not None else frozenset()
    if len(names) < 2 or not node.reason:
        return tuple(replace(c, accepted=True, group=group) if c.effect == node.added else c for c in listed)
    why = {n: f"together with {' and '.join(sorted(names - {n}))} {node.reason}" for n in names}
    return tuple(replace(c, accepted=True, group=group if c.effect == node.added else (), reason=why[c.effect])
                 if c.effect in names else c for c in listed)


def _path(last: Node) -> tuple[Node, ...]:
    """Return the models from the root to `last`, as they were grown."""
    return (*_path(last.parent), last) if last.parent is not None else (last,)


def ladder_of(found: Climb, validated: bool) -> Ladder:
    """Return the rungs of a climb."""
    grades = {g.effect: g for g in found.grades}
    rungs, before, units = list[Rung](), found.path[0], units_of(found.path[0].fit.problem.experiments)
    for k, node in enumerate(found.path):
        names = [n for n in node.fit.problem.model.effect_names if n not in before.key]
        rung = Rung(" + ".join(names) or None, node.fit, node.fit.nrmse,
                    {c: e.nrmse for c, e in node.predictions.held_out.items()} if validated else None,
                    tuple(sorted(before.key - node.key)), found.rounds[k] if k < len(found.rounds) else ())
        if k:
            worst = max((grades[n] for n in names if n in grades), key=lambda g: ORDER.index(g.grade), default=None)
            gained = evidence(before, node)
            rung = replace(rung, grade=worst.grade if worst else "approximates", gain=gained.gain, gain_se=gained.se,
                           why=worded(worst.why, units) if worst else "a later effect took its place")
        rungs.append(rung)
        before = node
    return Ladder(tuple(rungs), found.text)

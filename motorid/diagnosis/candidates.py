"""Growing a model by one effect, judging the children, pruning: the moves of the search.

A child must predict data that it was not fitted to better, by more than chance and by an amount that matters; see
`predictive_score`. What else speaks against its effect is kept with it, and tells what it may be called."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from functools import reduce
from itertools import combinations, product
from typing import Any

import numpy as np

from motorid.diagnosis.admissibility import MELTS, hottest, objections
from motorid.diagnosis.free_forms import FORMS, may_be_zeroed, own_levels, zeros_of
from motorid.diagnosis.misspecification import LIMITER
from motorid.diagnosis.model_comparison import COMMON, Node, beats, evidence, far, node_of, preferred, superfluous
from motorid.diagnosis.predictive_score import QUICK, Evidence, HeldOut, deciding
from motorid.diagnosis.refit import LITTLE, STOPPED, GivenUp, Task, completed, hidden_in, led_on, refit, refits, widened
from motorid.diagnosis.results import Candidate
from motorid.diagnosis.score_test import Score, pairs_of, rank, with_phase_per_run, with_warm_start
from motorid.diagnosis.thresholds import MATERIAL
from motorid.display.numbers import listed
from motorid.effects import LIBRARY, MEASURED, OTHER, PER_RUN, get
from motorid.errors import ModelError, otherwise
from motorid.estimation.angle_orders import shows_turns, uses_angle
from motorid.estimation.fit import lost, solve
from motorid.estimation.least_squares import FAILURES, RACE
from motorid.estimation.result import Fit
from motorid.model.definition import Effect, Parameter
from motorid.model.model import BASES, Model
from motorid.numerics.parallel import check_time
from motorid.numerics.signals import noise_level
from motorid.records.experiment import Experiment

SHORTLIST = 6
PAIRS = 3  # refitted where no single effect helps, and beside one that is refused
NEAR = 0.4  # of the best score: what a common effect must reach to be refitted too
ALWAYS = ("compliance", "compliance_load_side", "speed_lag", "speed_delay", "driver_coast")  # scores at null mislead
OVER_TURN = next(f for f in FORMS if (f.balance, f.carrier, f.on) == ("torque", "direction", "turn"))
SIMPLER = {"end_stop": ("spring",), **dict.fromkeys(("speed_filter", "compliance_load_side"), ("speed_average",))}
FLAT_TOP = 0.04  # of the samples: a current that is as large so often may have a limit


class Stages:
    """What a search is at: words on what was done (`say`), and one bar over all its rounds (`show`)."""

    def __init__(self, rounds: int = 0, say: Callable[[str], None] | None = None,
                 show: Callable[..., None] | None = None, map_: Callable[..., Iterable[Any]] = map) -> None:
        self.done, self._show, self._map = say or (lambda word: None), show or (lambda *_, **__: None), map_
        self._rounds, self._total, self._done, self._round, self.again = rounds, 0, 0.0, 0, 0

    def climb(self) -> None:
        """Begin a climb; a second one, with the records read otherwise, makes the whole longer."""
        self._done, self._total, self._round, self.again = self._total, self._total + self._rounds + 1, 0, self._total

    def round(self, number: int) -> None:
        """Begin a round; the one after the last looks at what remains."""
        self._round = number
        self._done = max(self._done, float(self._end - 1))

    @property
    def _end(self) -> int:
        """Rounds done when this one is."""
        return self._total - self._rounds - 1 + max(self._round, 1)

    def at(self, words: str) -> None:
        """Show what is at work."""
        last = self._round > self._rounds or not self._rounds
        self._show(0, words if last else f"Round {max(self._round, 1)}/{self._rounds}: {words}", self._done,
                   self._total)

    def map(self, function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        """Do the same as `map`, saying which effect is being fitted."""
        every, begun = list(tasks), self._done
        results = iter(self._map(function, every))
        for k, task in enumerate(every):
            name = getattr(task[0] if isinstance(task, tuple) else task, "name", "once more")
            self._done = begun + (self._end - begun) / 2 * k / len(every)
            self.at(f"fitting {name}, {k + 1} of {len(every)}")
            check_time()
            try:
                yield next(results)
            except BrokenExecutor:  # a process was killed: the rest is done in this one
                results = map(function, every[k:])
                yield next(results)
        self._done = (begun + self._end) / 2 if every else begun


def _in_doubt(node: Node, children: Sequence[Node]) -> bool:
    """Tell whether a race on the fitted runs misled: physics or held-out runs speak against what leads."""
    sound = [c for c in children if not c.objection]
    led = max(sound, key=lambda c: evidence(node, c).gain, default=None)
    return led is None or any(evidence(c, led).worse_there for c in sound if c is not led)


def library(effects: Iterable[Effect | str] | None, also: Iterable[Effect] = (),
            known: Mapping[str, Parameter] | None = None) -> list[Effect]:
    """Return the effects to try: the library and other values of what is fixed, or those named; the user's own."""
    fixed = [e for n, e in OTHER.items() if known and n in known and known[n].value > 0 and not known[n].vary]
    every = [*LIBRARY, *MEASURED, *PER_RUN, *fixed]
    named = every if effects is None else [effects] if isinstance(effects, str) else effects
    chosen, others = ([get(e) if isinstance(e, str) else e for e in some] for some in (named, also))
    own = {e.name: e for e in others}  # in the place of one of the library with the same name
    return [e for e in chosen if e.name not in own] + others


class Search:
    """One search over models; `expand` and `choose` are its two moves."""

    def __init__(self, fit: Fit, validate: Sequence[Experiment] | Experiment | None, effects: Sequence[Effect],
                 stages: Stages) -> None:
        stages.at("looking at the misfit")
        self.held = HeldOut.of(fit, validate)
        law = fit.model.base != "dc_motor" or own_levels(fit.problem.experiments)  # a torque needs no supply
        self.whole = {*LIBRARY} <= {e.name for e in effects}
        turns = shows_turns(fit)  # what passes by between samples takes thousands of steps, and none of these shows it
        self.effects = [e for e in effects if not (law and e.name in PER_RUN and e.balance == "voltage")
                        and (turns or not any(p.periodic for p in e.parameters))]
        self.stages, self.map, self.stopped = stages, stages.map, ""
        self.root = node_of(fit, self.held)
        self._scores: dict[frozenset[str], list[Score]] = {}
        self._always = (*ALWAYS, LIMITER) if any(map(_flat_topped, fit.problem.experiments)) else ALWAYS
        self.nodes: dict[frozenset[str], Node] = {self.root.key: self.root}

    def scores(self, node: Node) -> list[Score]:
        """Return the scores of all effects that `node` can take, best first; ranked once per model."""
        if node.key not in self._scores:
            fresh, _ = self._takeable(node.fit.model)
            self.stages.at(f"ranking {len(fresh)} effects")
            before = self._scores.get(node.parent.key, ()) if node.parent is not None and not far(node.fit) else ()
            self._scores[node.key] = rank(deciding(node.fit), fresh, before)
            self.stages.done(f"ranked {len(fresh)} effects")
        return self._scores[node.key]

    def inseparable(self, node: Node) -> dict[str, tuple[str, ...]]:
        """Return the effects that do no more than a combination of parameters of effects that `node`, once expanded,
        has; of one of the motor's own (the gain of a sensor) no reader would ask."""
        added = {p.name for e in node.fit.model.effects for p in e.parameters}
        return {s.effect.name: s.same_as for s in self._scores.get(node.key, ())
                if s.same_as and added >= set(s.same_as)}

    def unseen(self, node: Node) -> dict[str, tuple[str, ...]]:
        """Return the effects that other values of the motor's own parameters imitate here, scales of sensors aside."""
        return {s.effect.name: s.same_as for s in self._scores.get(node.key, ())
                if s.same_as and s.effect.balance != "sensor"}

    def hidden(self, node: Node) -> dict[tuple[str, str], tuple[str, ...]]:
        """Return the parameters that hide a wider effect (two sizes, no shape) than one of `node`, by both names."""
        found = {}
        for e in self._takeable(node.fit.model)[1]:
            inside = [n for n in node.fit.model.effect_names if n in e.includes and n not in self.root.key]
            if inside and all(p.null == 0 for p in e.parameters):
                with contextlib.suppress(*FAILURES):
                    found[inside[0], e.name] = hidden_in(node.fit, e)
        return {names: parameters for names, parameters in found.items() if parameters}

    def expand(self, node: Node) -> tuple[list[Node], list[Candidate]]:
        """Return the judged models one effect larger, and a candidate for every effect, best score first."""
        present, scores = node.fit.model, self.scores(node)
        _, wider = self._takeable(present)
        little = -np.inf if lost(node.fit) else LITTLE  # far from the records slopes say little
        short = [s for s in self._shortlist(node) if s.drop > little or not any(p.vary for p in s.effect.parameters)]
        tasks = self._freed(node)
        tasks += [Task(node.fit, present + s.effect, s.effect, s.starts, s.drop) for s in short
                  if all(s.effect is not t.added[0] for t in tasks)]
        for e in wider:
            with contextlib.suppress(ModelError):  # beside what is there it may describe the same twice
                tasks.append(widened(node.fit, e))
        tasks += self._restarting(node)
        fits = dict(zip((t.name for t in tasks), self._refits(tasks), strict=True))
        self.stages.done(f"refitted {sum(isinstance(f, Fit) for f in fits.values())} of {len(fits)}")
        found = {t.name: self._judge(node, t.added, fits[t.name]) for t in tasks}
        begun = {n: f for n, f in fits.items() if isinstance(f, GivenUp) and f.begun is not None}
        if begun and not self.stopped and _in_doubt(node, [c for c, _ in found.values() if c is not None]):
            later = dict(zip(begun, completed(list(begun.values()), self.map), strict=True))
            found |= {t.name: self._judge(node, t.added, later[t.name]) for t in tasks if t.name in later}
        gains = {c: evidence(node, c).gain for c, _ in found.values() if c is not None}
        most = max((gain for c, gain in gains.items() if not c.objection), default=-np.inf)
        inside = {name: c.fit.values for c, gain in gains.items() if c.objection for e in c.fit.model.effects
                  if e.name == c.added for name in e.includes if name not in found  # what is refused may hide a simpler
                  or (gain > most and isinstance(fits.get(name), GivenUp))}  # one; what leads, one that lost the race
        again = [Task(node.fit, present + s.effect, s.effect, [{**s.starts[0], **inside[s.effect.name]}, *s.starts],
                      s.drop) for s in scores if not self.stopped and s.effect.name in inside and s.starts]
        found |= {t.name: self._judge(node, t.added, f) for t, f in zip(again, self._refits(again), strict=True)}
        children = [child for child, _ in found.values() if child is not None]
        tried = sorted((candidate for _, candidate in found.values()), key=lambda c: c.gain or 0.0)
        return children, self.listed(scores, {c.effect: c for c in tried})

    def _freed(self, node: Node) -> list[Task]:
        """Return the other values of what the user fixed that a first fit with one free finds, however far away."""
        tasks, fit, pars = [], node.fit, node.fit.model.parameters
        for n, e in OTHER.items() if node is self.root and far(fit) else ():
            if any(e.law == own.law for own in self.effects):
                fresh = {p.name: p for p in BASES[fit.model.base] if p.name == n or pars[p.name].vary}
                with contextlib.suppress(*FAILURES):
                    problem = fit.problem.with_(model=fit.model.with_(parameters={**pars, **fresh}), noise_factors={})
                    found = solve(problem, QUICK).values
                    first = {**found, f"d_{n}": np.log(found[n] / fit.values[n]), n: fit.values[n]}
                    tasks.append(Task(fit, fit.model + e, e, [first]))
        return tasks

    def _restarting(self, node: Node) -> list[Task]:
        """Return the effects that explain more with a zero of the encoder, or a warmth, of every run, with that."""
        own, model, tasks = {e.name: e for e in self.effects if e.name in PER_RUN}, node.fit.model, []
        if not far(node.fit) or len(set(node.fit.problem.unknowns.firsts)) < 2:
            return []
        if (zero := own.get("encoder_zero")) and zero.name not in model.effect_names:
            found = with_phase_per_run(deciding(node.fit), self.scores(node), zero)
            tasks += [Task(node.fit, model + s.effect + zero, s.effect, s.starts, s.drop) for s in found]
            for e in self._takeable(model)[1] if may_be_zeroed(node.fit) else ():
                if e.balance == "torque" and uses_angle(e):  # a friction
                    task, zeros = widened(node.fit, e), zeros_of(node.fit, OVER_TURN)
                    tasks.append(replace(task, model=task.model + zero, starts=[{**s, **zeros} for s in task.starts]))
        if warm := own.get("winding_warm_start"):
            found = with_warm_start(deciding(node.fit), self.scores(node), LIBRARY["winding_heating"])
            tasks += [Task(node.fit, model + s.effect + warm, s.effect, s.starts, s.drop) for s in found]
        return tasks

    def _shortlist(self, node: Node) -> list[Score]:
        """Return what is worth a refit: the best and what explains most beside it (what has nothing to do with a misfit
        that several could explain ranks behind all of them), what is common and near the best, and what a score cannot
        show. Far from the records slopes say little, and all that is common is tried; what has no free parameter has no
        slope; a line in the spectrum over the angle is no accident, however small beside the rest of the misfit."""
        scores, astray, unmet = self.scores(node), lost(node.fit), bool(far(node.fit))
        other = [b for _, b in pairs_of(deciding(node.fit), product(scores[:1], scores[1:]), 1)]
        near = NEAR * max((s.drop for s in scores), default=0.0)
        return [s for k, s in enumerate(scores)
                if (s.drop > 0 and (k < SHORTLIST or s.stands_out or (s.effect.name in COMMON and s.drop > near)))
                or s in other or (s.effect.name in self._always and s.shapes) or (astray and s.effect.name in COMMON)
                or (unmet and not any(p.vary for p in s.effect.parameters))]

    def _takeable(self, model: Model) -> tuple[list[Effect], list[Effect]]:
        """Split the effects into those that can be added and those that would take an earlier one's place."""
        fresh, wider = [], []
        have, several = set(model.effect_names), len(set(self.root.fit.problem.unknowns.firsts)) > 1
        contained = {i for e in model.effects for i in e.includes}
        for e in self.effects:
            if e.name in have or e.name in contained:
                continue
            if self.root.fit.problem.linear and any(p.periodic for p in e.parameters):
                continue  # a phase in metres is none
            if contained & set(e.includes) and not have & set(e.includes):
                continue  # two that contain the same simpler one share its size between them
            acts = several and (not uses_angle(e) or any(map(uses_angle, model.effects)))
            if any(p.per_run for p in e.parameters) and not acts:
                continue  # it begins anew in each of several records, and needs something there to act on
            if have & set(e.includes):
                wider.append(e)
                continue
            with contextlib.suppress(ModelError):
                self.root.fit.problem.for_model(model + e)
                fresh.append(e)
        return fresh, wider

    def expand_by_two(self, node: Node) -> list[Node]:
        """Return the judged models larger by two effects that only together show: each alone was refused."""
        present, tasks = node.fit.model, []
        for a, b in pairs_of(deciding(node.fit), combinations(self._shortlist(node), 2), PAIRS):
            with contextlib.suppress(ModelError):
                best = {**a.starts[0], **b.starts[0]}  # and the next best of either
                starts = [best, *({**best, **s.starts[1]} for s in (a, b) if len(s.starts) > 1)]
                tasks.append(Task(node.fit, present + a.effect + b.effect, a.effect, starts))
        return self._together(node, tasks)

    def expand_from(self, node: Node, refused: Candidate) -> list[Node]:
        """Return the judged models with a refused effect and one more, sought from where the first leads."""
        assert refused.fit is not None
        half, model = replace(node, fit=refused.fit, added=refused.effect, parent=node), refused.fit.model
        scores = self._shortlist(half)[:PAIRS]
        found = self._together(node, [Task(half.fit, model + s.effect, s.effect, s.starts, s.drop) for s in scores])
        first = next(e for e in model.effects if e.name == refused.effect)
        simpler = [self.smaller(c, m) for c in found if c.objection and not self.stopped
                   for m in self._simpler(c.fit.model, first)]
        return found + [c for c in simpler if c is not None]

    def _together(self, node: Node, tasks: Sequence[Task]) -> list[Node]:
        fits, had = zip(tasks, self._refits(tasks), strict=True), len(node.fit.model.effects)
        judged = [self._judge(node, task.model.effects[had:], fit)[0] for task, fit in fits]
        self.stages.done(f"refitted {len(tasks)} pairs")
        return [child for child in judged if child is not None]

    def _refits(self, tasks: Sequence[Task]) -> list[Fit | GivenUp | None]:
        """Return the refit of each task; where they are `stopped`, nothing more is to begin."""
        fits = refits(tasks, self.map)
        self.stopped = next((f.why for f in fits if isinstance(f, GivenUp) and f.why in STOPPED), self.stopped)
        return fits

    def _judge(self, node: Node, effects: Sequence[Effect], fit: Fit | GivenUp | None) -> tuple[Node | None, Candidate]:
        effect = effects[0]
        candidate = Candidate(effect.name, 0.0)
        if isinstance(fit, GivenUp):
            return None, replace(candidate, refit_drop=fit.drop, reason=fit.why)
        if fit is None:
            return None, replace(candidate, reason="its refit could not be simulated")
        try:
            drop, predictions = _drop(node, fit), self.held.predictions(fit)
        except FAILURES as error:
            return None, replace(candidate, reason=f"fails on the held-out runs: {error}")
        objection = next((w for e in effects if (w := objections(fit, e, node.fit))), "")
        values = {p.name: fit.values[p.name] for e in effects for p in e.parameters}
        child = Node(fit, effect.name, predictions, node, objection=objection)
        found = evidence(node, child)
        candidate = replace(candidate, refit_drop=drop, parameters=values, fit=fit,
                            validation_nrmse={c: e.nrmse for c, e in predictions.held_out.items()} or None,
                            held_out_gain=found.fall if found.held_out_fall is None else found.held_out_fall,
                            gain=found.gain, gain_se=found.se, reason=_said(found))
        if not (found.worth_it or (found.plain and node is self.root)):
            return None, candidate
        candidate = replace(candidate, reason=f"{candidate.reason}, but {objection}") if objection else candidate
        if hottest(fit) > MELTS >= hottest(node.fit):  # nor is it one to go on from
            return None, replace(candidate, fit=None)
        return replace(child, reason=candidate.reason), candidate

    @staticmethod
    def listed(scores: Sequence[Score], judged: Mapping[str, Candidate], why: str = "") -> list[Candidate]:
        """Return a candidate for every effect, best score first; `why` those that were not judged were not refitted."""
        scored = {s.effect.name: Candidate(s.effect.name, s.drop, parameters=dict(s.starts[0]) if s.starts else {},
                                           reason=why or _unseen(s)) for s in scores}
        listed = [replace(judged.get(n, c), predicted_drop=c.predicted_drop) for n, c in scored.items()]
        return listed + [c for n, c in judged.items() if n not in scored]

    def pruned(self, node: Node, before: Node) -> Node:
        """Return `node` without superfluous effects, the simplest of each kind, and still preferred to `before`."""
        for e in node.fit.problem.model.effects:
            simpler = self._simpler(node.fit.model, e)
            alone = e.name == node.added and node.parent is not None and len(node.key - node.parent.key) == 1
            smaller = simpler if alone else [*simpler, *_without(node.fit.model, e.name)]
            for model in sorted(smaller, key=lambda m: len(m.free_names)):
                other = self.smaller(node, model)
                if other and len(other.key - self.root.key) > 1 and far(other.fit) and not far(node.fit):
                    # The larger one's values, or the few steps of a race, may have led into a valley of its own.
                    first = {p.name: p.value for e in other.fit.model.effects for p in e.parameters if p.vary}
                    other = self._fitted(other, other.fit.model.start_at(first), "auto")
                if other and not other.objection and superfluous(node, other) and preferred(other, before):
                    return self.pruned(other, before)
        return node

    def exchanged(self, node: Node, before: Node) -> Node:
        """Return a smaller model that does the same as `node` with an effect that these records cannot tell from a
        combination of its own; `node` itself for none. An offset of the voltage is one of the current and a load."""
        same = self.inseparable(node) if self.scores(node) else {}
        for grown, e in product((node.fit.model + e for e in self.effects if e.name in same), node.fit.model.effects):
            for model in (*self._simpler(grown, e), *_without(grown, e.name)):
                other = self.smaller(node, model)
                if other and not other.objection and superfluous(node, other) and (
                        (other := self.pruned(other, before)).size < node.size):
                    return other
        return node

    def _simpler(self, model: Model, effect: Effect) -> list[Model]:
        """Return the model with each simpler one of its kind in the place of an effect."""
        simpler = {*effect.includes, *SIMPLER.get(effect.name, ())}
        inside = [e for e in self.effects if e.name in simpler and e.name not in model.effect_names]
        return [m for e in inside if (m := _in_place(model, effect, e)) is not None]

    def brought_to_its_end(self, node: Node) -> Node:
        """Return a model fitted on to its optimum; a refit ends where it tells no two models apart. A rugged cost (the
        rebounds in a gear's play) stops its few steps with errors far beyond the noise: there a whole fit goes on."""
        with contextlib.suppress(*FAILURES):
            if (fit := led_on(node.fit)) is not None and hottest(fit) <= MELTS:
                node = self.nodes[node.key] = replace(node, fit=fit, predictions=self.held.predictions(fit))
        return self._fitted(node, node.fit.model) if node.fit.status != "converged" and far(node.fit) else node

    def led_out(self, node: Node, larger: Node) -> Node:
        """Return a model led by a larger one out of the valley where its descent stopped, if it predicts better so."""
        fit = None if node is self.root else led_on(node.fit, larger.fit)
        if fit is not None and beats(onward := replace(node, fit=fit, predictions=self.held.predictions(fit)), node):
            self._scores.pop(node.key, None)
            self.nodes[node.key] = node = onward
        return node

    def _fitted(self, node: Node, model: Model, start: str = "model") -> Node:
        """Return a model fitted as a whole, where that predicts better."""
        with contextlib.suppress(*FAILURES):
            fit = solve(problem := node.fit.problem.with_(model=model, noise_factors={}), QUICK, start=start)
            if fit.status == "limit":  # on its way still
                fit = solve(problem.with_(model=fit.model), RACE, start="model")
            against = (objections(fit, e, self.root.fit) for e in fit.model.effects if e.name not in self.root.key)
            why, predictions = next(filter(None, against), ""), self.held.predictions(fit)
            onward = replace(node, fit=fit, predictions=predictions, objection=why)
            if beats(onward, node) and hottest(fit) <= MELTS:
                self.nodes[node.key] = node = onward
        return node

    def without(self, node: Node, name: str) -> Node | None:
        """Return the judged model without an effect; None where that is none."""
        return next((self.smaller(node, model) for model in _without(node.fit.model, name)), None)

    def in_place(self, node: Node, old: str, new: str, known: bool = False) -> Node | None:
        """Return the judged model with an effect where another was, only if met where `known`; None for none."""
        effects = {e.name: e for e in (*self.effects, *node.fit.model.effects)}
        if (model := _in_place(node.fit.model, effects[old], effects[new])) is None or known:
            return self.nodes.get(frozenset(model.effect_names)) if model else None
        return self.smaller(node, model)

    def smaller(self, node: Node, model: Model) -> Node | None:
        """Return the judged model, one that is contained in `node`'s; None where it is no model by itself."""
        if (key := frozenset(model.effect_names)) not in self.nodes:
            values = {n: node.fit.values[n] for n in model.parameters if n in node.fit.values}
            new = [e for e in model.effects if e.name not in node.fit.model.effect_names]
            gone = [e for e in node.fit.model.effects if e.name not in model.effect_names]
            for p in (p for e in new for p in e.parameters if p.name not in values):
                # What plays the same part: a size, or a shape of the same unit.
                if alike := [node.fit.values[o.name] for e in gone for o in e.parameters if p.null == o.null == 0
                             or (p.null is None and o.null is None and p.unit == o.unit)]:
                    values[p.name] = max(alike)
            self.stages.at(f"trying {model.title}")
            with contextlib.suppress(*FAILURES):
                if (fit := refit(node.fit, model, (values,))) is not None:
                    added = node.added if node.added in model.effect_names or not new else new[0].name
                    why = next((w for e in new if (w := objections(fit, e))), "")  # what takes its place must be sound
                    self.nodes[key] = replace(node_of(fit, self.held, added, node.parent), objection=why)
        return self.nodes.get(key)


def _flat_topped(run: Experiment) -> bool:
    """Tell whether the largest current comes often, as at a limit."""
    if "i" not in run.outputs:
        return False
    size = np.abs(run.outputs["i"][np.isfinite(run.outputs["i"])])
    return bool(np.mean(size > np.quantile(size, 0.995) - 4 * noise_level(run.outputs["i"], run.t)) > FLAT_TOP)


def _without(model: Model, name: str) -> list[Model]:
    """Return the model without an effect, and without the one that needs it; none where several do."""
    for needing in ((), *((e.name,) for e in model.effects if e.name != name)):
        with contextlib.suppress(ModelError):
            left = reduce(Model.without, (*needing, name), model)
            zeros = [e.name for e in left.effects if uses_angle(e) and any(p.per_run for p in e.parameters)]
            alone = not any(uses_angle(e) for e in left.effects if e.name not in zeros)
            return [reduce(Model.without, zeros, left) if alone else left]  # no effect is left that asks for a zero
    return []


def _in_place(model: Model, old: Effect, new: Effect) -> Model | None:
    """Return the model with `new` where `old` was, in the same order; None where another effect contains `new`."""
    effects = tuple(new if e is old else e for e in model.effects)
    return otherwise(None, ModelError, lambda: (model.without(old.name) + new).with_(effects=effects))


def _unseen(score: Score) -> str:
    """Say why an effect was not refitted."""
    if score.same_as:
        return f"these records do not distinguish it from {listed(score.same_as)} together"
    return "not refitted: " + ("others ranked higher" if score.drop > LITTLE else "no gain that matters is predicted")


def _said(found: Evidence) -> str:
    """Say what an effect does for data that it was not fitted to."""
    where = "prediction error" if found.held_out_fall is None else "held-out error"
    if found.worse_there and found.held_out_fall is not None:
        rises = f"the held-out error rises by {-100 * found.held_out_fall:.1f} %"
        return rises if found.held_out_fall < 0 else "most of the held-out samples are predicted worse"
    if not found.sure and not found.plain:
        size = f" (gain {found.gain:.1f} ± {found.se:.1f})" if abs(found.gain) >= 0.05 else ""
        return f"no better than {'chance' if size else 'without it'}{size}"
    if not (found.worth_it or found.plain):
        return f"lowers the {where} by less than {100 * MATERIAL:g} %"
    there = found.held_out_fall or 0.0
    kind, fall = ("held-out", there) if there > MATERIAL else ("prediction", found.fall)
    return f"lowers the {kind} error by {100 * fall:.1f} %"


def _drop(node: Node, fit: Fit) -> float:
    """Share of chi² that vanishes, with the weights of the smaller model."""
    problem = node.fit.problem
    noise = {c: s * problem.noise_factors.get(c, 1.0) for run in problem.runs for c, s in run.sigma.items()}
    old, new = (sum(float(np.nansum((s.residual(c) / noise[c]) ** 2)) for s in f.simulations
                    for c in s.experiment.outputs if c in noise and c in s.outputs) for f in (node.fit, fit))
    return float(1 - new / max(old, 1e-300))

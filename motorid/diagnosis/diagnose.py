"""diagnose(): where does the model fail, which effect is missing, and what do the records not distinguish."""

import builtins
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from motorid.channels import channel_name, worded
from motorid.diagnosis import verdict as words
from motorid.diagnosis.adequacy import following
from motorid.diagnosis.candidates import Stages, library
from motorid.diagnosis.experiment_design import suggest_experiment
from motorid.diagnosis.free_forms import WHERE
from motorid.diagnosis.locate import acting_like, locate
from motorid.diagnosis.misspecification import DIFFERENCED, LIMITER, better_forms, in_turn
from motorid.diagnosis.model_comparison import far
from motorid.diagnosis.record_versions import parts_remark
from motorid.diagnosis.refit import with_lags_exchanged
from motorid.diagnosis.remainder import Remainder
from motorid.diagnosis.results import Adequacy, Diagnosis, Ladder
from motorid.diagnosis.stepwise import Climb, explored, ladder_of
from motorid.display.numbers import listed, number
from motorid.effects import OTHER
from motorid.errors import MotoridError, OutOfTime, at_least, numbers_told, otherwise
from motorid.estimation.result import Fit, checked
from motorid.model.definition import Effect
from motorid.model.model import SHOWN, Model
from motorid.numerics import parallel
from motorid.records.checks import as_command, contradictions, current_limit
from motorid.records.experiment import Experiment, repeated, units_of

CURVE = 30.0  # s for the curve of what is left, without a budget; `as_effect` goes on from there
SETTLED = 16.0  # of an expected χ² between two models: half of it, the gain, is two of its standard deviations, √χ²


@parallel.one_thread
@numbers_told()
def diagnose(fit: Fit, validate: Sequence[Experiment] | Experiment | None = None, *,
             effects: Iterable[Effect | str] | None = None, also: Iterable[Effect] = (), max_effects: int = 3,
             budget: float | None = None, map: Callable[..., Iterable[Any]] = builtins.map,
             progress: Callable[[str], None] | None = None) -> Diagnosis:
    """Say where a fitted model fails and which physical effect it lacks.

    Parameters
    ----------
    fit : Fit
        Of the model as it is, e.g. ``mi.fit(mi.dc_motor(), runs)``.
    validate : Experiment or sequence of Experiment, optional
        Held-out runs: no effect may raise the error there. Blocks of the fitted runs are left out in turn, too. Where
        `fit` leaves only noise and fails there, these runs are fitted as well, which `Diagnosis` says.
    effects : iterable of Effect or str, optional
        What to try; by default the whole library.
    also : iterable of Effect, optional
        Effects of your own, tried beside the library's.
    max_effects : int
    budget : float, optional
        Seconds after which the best answer so far is given; Ctrl-C gives it, too. `Diagnosis.stopped` says so.
    map : callable
        Anything with the signature of `map`, for the refits.
    progress : callable, optional
        Called with a word on what was done; ``"first answer: …"`` comes before any refit.

    Returns
    -------
    Diagnosis
        Printed, it is the verdict in words. Where nothing is named, `Diagnosis.remainder` has its curve already, but
        for records that contradict themselves.

    Examples
    --------
    >>> found = mi.diagnose(fit, validate=check, effects=["coulomb", "stribeck", "cogging"])
    >>> found.verdict, found.effects
    ('missing', ('coulomb',))
    >>> better = found.best
    """
    at_least(0, max_effects=max_effects, budget=budget)
    tried = library(effects, also, checked(fit, "diagnose").model.parameters)
    with parallel.progress("Looking for what is missing", max_effects + 1, at_most=True) as show:
        stages = Stages(max_effects, progress, show, map)
        began = time.monotonic()
        found, driven = explored(fit, validate, tried, stages, max_effects, budget)
        stages.done("located what is missing")
        twice = repeated(fit.problem.experiments, [validate] if isinstance(validate, Experiment) else validate or ())
        misread = _contradicting(found, fit.problem.experiments)
        records = () if driven else fit.problem.experiments  # as they were read
        left = 0.0 if misread else CURVE if budget is None else max(budget - (time.monotonic() - began), 0.0)
        return _told(found, misread, " ".join(w for w in (twice, driven) if w), validate is not None, records, left)


@parallel.one_thread
def improve(fit: Fit, validate: Sequence[Experiment] | Experiment | None = None, *,
            effects: Iterable[Effect | str] | None = None, also: Iterable[Effect] = (), max_effects: int = 3,
            map: Callable[..., Iterable[Any]] = builtins.map, progress: Callable[[str], None] | None = None) -> Ladder:
    """Add effects one by one, as long as the error on held-out data falls.

    Parameters
    ----------
    fit : Fit
        Of the model to begin with.
    validate, effects, also, max_effects, map, progress
        As in `diagnose`.

    Returns
    -------
    Ladder
        The models with training and held-out error; ``ladder.best`` is the last fit, to go on from.

    Examples
    --------
    >>> ladder = mi.improve(fit, validate=check, effects=["coulomb", "quadratic_drag"])
    >>> ladder.best.model.effect_names
    ('coulomb',)
    """
    return diagnose(checked(fit, "improve"), validate, effects=effects, also=also, max_effects=max_effects, map=map,
                    progress=progress).ladder


def _contradicting(found: Climb, runs: Sequence[Experiment]) -> str:
    """Say how channels contradict one another; where a model leaves noise (a hoist's current has one sign) nothing."""
    if found.remaining.adequate or not far(last := found.path[-1].fit):
        return ""
    bare = any(g.effect == "supply_side_current" and g.grade != "approximates" for g in found.grades)  # never negative
    plain = [r.without("i") if bare and len(r.outputs) > 1 and "i" in r.outputs else r for r in runs]
    said = contradictions(plain if "i" in SHOWN[last.model.base] else [as_command(r) for r in plain])
    return f"The records seem to contradict themselves; check first: {said} Taken as they are: " if said else ""


def _told(found: Climb, misread: str, driven: str, validated: bool, records: Sequence[Experiment],
          seconds: float) -> Diagnosis:
    """Return what a climb found, in words and as a result; first how the records contradict themselves, `misread`."""
    fit, ladder = found.search.root.fit, ladder_of(found, validated)
    missing, judged, last, units = locate(fit), found.first, found.path[-1], units_of(fit.problem.experiments)
    graded = [g for g in found.grades if g.why != DIFFERENCED]
    names = tuple(g.effect for g in graded if g.grade != "approximates")
    ranking, groups = found.rounds[0] if found.rounds else (), tuple(g for g in found.groups if g[0] in names)
    rivals, suggestion = found.rivals if groups[:1] == found.groups[:1] else (), None
    remaining, left = _left(found, bool(names), bool(graded), records, seconds)
    like = left.form or next((g.form for g in graded if g.form is not None and left.proposed), None)
    missing = acting_like(missing, like) if like is not None and not names else missing
    if names:
        verdict, where = "missing", WHERE[{e.name: e.balance for e in ladder.best.model.effects}[names[0]]]
        elsewhere = bool(words.held_out_remark(last))
        answer = words.missing_text(ladder.rungs, remaining, groups, graded, elsewhere, found.stopped)
        same = _inseparable(found, ladder.best.model)
        details = [words.moves(fit, ladder.best), words.rises_text(ladder.rungs), words.inseparable_remark(same),
                   words.fixed_remark(rivals or (ladder.best,)), words.hidden_remark(found.search.hidden(last)),
                   words.exchanged_remark({} if found.stopped else with_lags_exchanged(ladder.best))]
        for name, shared in same.items():  # what acts through these parameters, and that one
            inside = (e.name for e in ladder.best.model.effects if {p.name for p in e.parameters} & {*shared})
            groups = (*groups, (*inside, name))
        suggestion = _suggestion(rivals, groups)
    elif graded or not remaining.adequate:
        verdict, where = "unexplained", missing.where
        closed = left.nearest() if left.errors else ()
        answer = words.unexplained_text(ranking, ladder.rungs, graded, like.text if like else "", remaining,
                                        words.curve_text(ladder.rungs, left.errors, closed), errors=left.errors,
                                        whole=found.search.whole, done=bool(found.rounds) and not found.stopped)
        judged, known = (judged, []) if len(found.path) > 1 else (remaining, [remaining.text])
        details = [*known, missing.text, words.rises_text(ladder.rungs)]
    else:
        verdict, where, judged = "adequate", None, remaining
        answer, *details = words.adequate_text(judged, [c for c in ranking if not c.accepted], ladder.best)
    details += [] if names else [words.unseen_remark(found.search.unseen(last), fit.model.base)]
    told = partial(worded, units=units, names=[run.name for run in fit.problem.experiments])
    answer, *details = (told(t) for t in (misread + answer, *details, *_remarks(found, driven)) if t)
    missing = replace(missing, text=told(missing.text), acts_like=told(missing.acts_like))
    judged, remaining = (replace(a, text=told(a.text)) for a in (judged, remaining))
    text = " ".join(t for t in (answer, *details, suggestion) if t)
    return Diagnosis(verdict, text, where, names, judged, missing, ranking, ladder, groups, suggestion, fit,
                     ladder.best, remaining, left, found.stopped, answer, tuple(details), rivals or (ladder.best,))


def _left(found: Climb, named: bool, graded: bool, records: Sequence[Experiment],
          seconds: float) -> tuple[Adequacy, Remainder]:
    """Return what is left in words, and to go on with: led by its curve where nothing is named, as slopes mislead."""
    remaining, last, forms = found.remaining, found.path[-1].fit, in_turn(found.forms)
    remaining = following(remaining, forms[0].text) if forms else remaining
    more = "fluctuation" if named or (remaining.adequate and not graded) else "structure"  # which an imitation hides
    kind = "structure" if not remaining.adequate else more if far(last) else "noise"
    approximating = {g.effect: g.form for g in found.grades if g.grade == "approximates"}
    if remaining.hum:  # no missing physics, and a curve all the same
        kind, forms = "structure", in_turn(better_forms(last, last))
    if kind == "noise" and graded and not named and far(root := found.search.root.fit):
        kind, last, approximating = "structure", root, {}  # beside what imitates it down to the noise nothing shows
        forms = in_turn(better_forms(last, last))
    left = Remainder(kind, last, forms, found.search.held, found.search.root.fit, approximating, records)
    if not (named or found.stopped or remaining.hum) and left.proposed and seconds:
        found.search.stages.at("Growing a curve of what is left")
        try:
            with parallel.budget(seconds):
                left = left.led_by_its_curve()
            if last is found.path[-1].fit:
                remaining = following(found.remaining, left.form.text) if left.form else found.remaining
        except (OutOfTime, KeyboardInterrupt):
            parallel.interruption.heard()
    return remaining, left


def _remarks(found: Climb, driven: str) -> list[str]:
    """Return what else a reader should know: of the records, of the last fit, of the held-out runs."""
    first, last = found.path[0].fit, found.path[-1].fit
    limits = (f"In {run.name} {limit}" for run in first.problem.experiments if LIMITER not in found.path[-1].key
              and (limit := current_limit(run)))
    windows = "" if last.window is None else (
        f"The records are simulated in windows of {number(last.window, 2)} s, each from an estimated state: over whole "
        "records small errors of a model may grow. Errors are those of a window ahead.")
    late = "" if set(last.problem.outputs) != {"omega"} or "speed_delay" not in found.path[-1].key else (
        f"The speed alone cannot tell a late sensor from a voltage that acts late: --delay {last.values['T_d']:.3g}.")
    stopped = f"Stopped early: {found.stopped}; more may be missing." if found.stopped else ""
    half = (f"'{g.effect}' in the model is no effect that was missing: {g.why}." for g in found.grades
            if g.why == DIFFERENCED)
    own = words.own_in_every_run_remark(last) if found.search.held.validation is not None else ""
    return [stopped, driven, *half, windows, late, next(limits, ""), parts_remark(first),
            words.unfinished_remark(last), words.held_out_remark(found.path[-1]), own,
            words.measured_angle_remark(last), words.outliers_remark(last), words.closed_loop_remark(first)]


def _inseparable(found: Climb, model: Model) -> dict[str, tuple[str, ...]]:
    """Return the effects that `model` lacks, and parameters of its own that do the same."""
    met = {name: p for node in found.path[1:] for name, p in found.search.inseparable(node).items()}
    return {n: p for n, p in met.items() if model.parameters.keys() >= {*p} and n not in model.effect_names}


def _suggestion(fits: Sequence[Fit], groups: Sequence[Sequence[str]]) -> str | None:
    """Say which experiment would separate the rivals of the first group, if there is one."""
    if len(fits) < 2 or not groups:
        return None
    names, best = groups[0], otherwise(None, MotoridError, lambda: suggest_experiment(fits[:4]))
    if best is None:
        return None
    problem, text = fits[0].problem, f"To distinguish {listed(names)}, record {best.text}."
    if best.discrimination[best.name] * best.experiment.n < SETTLED:
        more = [channel_name(c) for c in SHOWN[problem.model.base] if c not in problem.outputs]
        fixed = any(e.name in names for e in OTHER.values())  # a meter tells that
        told = f"; measure the {' or '.join(more)} too" if more and not fixed else ""
        text = f"No voltage record of these channels within the limits would distinguish {listed(names)}{told}."
    return worded(text, units_of(problem.experiments))

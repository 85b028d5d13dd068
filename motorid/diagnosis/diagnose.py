"""diagnose(): where does the model fail, which effect is missing, and what cannot be told apart."""

from __future__ import annotations

import builtins
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from motorid.diagnosis.adequacy import following, pursued
from motorid.diagnosis.candidates import library
from motorid.diagnosis.cross_validation import parts_remark
from motorid.diagnosis.experiment_design import suggest_experiment
from motorid.diagnosis.locate import acting_like, locate
from motorid.diagnosis.results import Diagnosis
from motorid.diagnosis.stepwise import Climb, explored, ladder_of
from motorid.diagnosis.verdict import (
    adequate_text,
    averaging_remark,
    balance_of,
    closed_loop_remark,
    inseparable_remark,
    measured_angle_remark,
    missing_text,
    outliers_remark,
    unexplained_text,
)
from motorid.errors import MotoridError
from motorid.estimation.result import Fit
from motorid.model.definition import Effect
from motorid.numerics.parallel import one_thread
from motorid.records.checks import current_limit
from motorid.records.experiment import Experiment
from motorid.uncertainty.covariance import deviations


@one_thread
def diagnose(
    fit: Fit,
    validate: Sequence[Experiment] | Experiment | None = None,
    *,
    effects: Iterable[Effect | str] | None = None,
    also: Iterable[Effect] = (),
    max_effects: int = 3,
    map: Callable[..., Iterable[Any]] = builtins.map,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Say where a fitted model fails and which physical effect it lacks.

    Parameters
    ----------
    fit : Fit
        Of the model as it is, e.g. ``mi.fit(mi.dc_motor(), runs)``.
    validate : Experiment or sequence of Experiment, optional
        Held-out runs; every effect must lower the error there. Without them, blocks of the fitted runs are held
        out in turn.
    effects : iterable of Effect or str, optional
        What to try; by default the whole library.
    also : iterable of Effect, optional
        Effects of your own, tried beside the library's.
    max_effects : int
    map : callable
        Anything with the signature of `map`, for the refits.
    progress : callable, optional
        Called with a word on what was done.

    Returns
    -------
    Diagnosis
        Printed, it is the verdict in words.
    """
    say = progress or (lambda word: None)
    own = tuple(also)
    found, other, driven = explored(fit, validate, library(effects, own), map, say, max_effects)
    fit, search, judged = found.search.root.fit, found.search, found.first
    missing = locate(fit)
    say("located what is missing")
    ladder = ladder_of(found, validate is not None)
    names = tuple(n for n in ladder.best.problem.model.effect_names if n not in fit.problem.model.effect_names)
    ranking = found.rounds[0] if found.rounds else ()
    remaining, suggestion, groups = found.remaining, None, found.groups
    if other is not None:
        remaining = following(remaining, other.form.text)
        judged = following(judged, other.form.text) if judged.adequate else judged
        missing = missing if names else acting_like(missing, other.form)
    else:
        remaining = pursued(remaining, ladder.best, search.held)
        judged = judged if names else remaining
    if not names:
        verdict = "adequate" if judged.adequate else "unexplained"
        text = adequate_text(judged, ranking) if judged.adequate else unexplained_text(judged, missing, ranking)
        where, remaining = None if judged.adequate else missing.where, judged
    else:
        verdict, where = "missing", balance_of(names[0], own)
        text = missing_text(ladder.rungs, remaining, found.groups, validate is not None)
        same = {name: p for node in found.path[1:] for name, p in search.inseparable(node).items()}
        text = f"{text} {inseparable_remark(same)}".rstrip()
        groups = (*groups, *(_sharing(ladder.best, name, parameters) for name, parameters in same.items()))
        suggestion = _suggestion(found)
    last = ladder.best
    of_last = (measured_angle_remark(last), averaging_remark(last), outliers_remark(last))
    limits = (f"In {run.name} {limit}" for run in fit.problem.experiments if (limit := current_limit(run)))
    remarks = (driven, next(limits, ""), parts_remark(fit), *of_last, closed_loop_remark(fit), suggestion)
    text = " ".join(t for t in (text, *remarks) if t)
    return Diagnosis(
        verdict,
        text,
        where,
        names,
        judged,
        missing,
        ranking,
        ladder,
        groups,
        suggestion,
        fit,
        ladder.best,
        remaining,
        (deviations(fit), deviations(ladder.best)),
    )


def _sharing(fit: Fit, name: str, parameters: Sequence[str]) -> tuple[str, ...]:
    """Return the effects whose parameters together do what another effect does, and that one."""
    inside = (e.name for e in fit.model.effects if {p.name for p in e.parameters} & set(parameters))
    return (*inside, name)


def _suggestion(found: Climb) -> str | None:
    """Say which experiment would separate the first group, if there is one."""
    if not found.groups:
        return None
    names = found.groups[0]
    listed = f"{', '.join(names[:-1])} and {names[-1]}"
    fits = [c.fit for c in found.rounds[0] if c.effect in names and c.fit is not None]
    if len(fits) < 2:
        return None
    try:
        best = suggest_experiment(fits[:4])
    except MotoridError:
        return None
    if best.discrimination[best.name] < 1e-3:
        return f"No voltage record within the limits would tell {listed} apart."
    return f"To tell {listed} apart, try {best.text}."

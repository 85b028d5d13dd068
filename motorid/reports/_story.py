"""The story that a report tells: which sections, in which order, under which head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from motorid.diagnosis.results import Diagnosis, Ladder
from motorid.display._cards import card_of
from motorid.display._html_tables import NAMES
from motorid.display.cards import Flag
from motorid.display.numbers import duration, percent
from motorid.estimation.fit import Fit
from motorid.records.experiment import Experiment
from motorid.reports import sections
from motorid.reports.sections import Section


@dataclass
class Story:
    """The page: head, key facts, sections, and the records it rests on."""

    title: str
    lead: str = ""
    flags: Sequence[Flag] = ()
    facts: Sequence[tuple[str, str]] = ()
    sections: list[Section] = field(default_factory=list)
    runs: Sequence[Experiment] = ()


def tell(results: Sequence[Any], *, title: str = "", validate: Sequence[Experiment] = ()) -> Story:
    """Return the story of `results`, told from the richest of them on."""
    main = next((r for kind in (Diagnosis, Ladder, Fit) for r in results if isinstance(r, kind)), results[0])
    if isinstance(main, Diagnosis):
        story = _of_diagnosis(main, validate)
    elif isinstance(main, Ladder):
        story = _of_ladder(main)
    elif isinstance(main, Fit):
        story = _of_fit(main, validate)
    else:
        card = card_of(main)
        story = Story(card.title, " ".join(card.text[:1]), card.flags)
        story.sections.append(sections.of_card(main, 0))
    for k, r in enumerate(results):
        if r is not main:
            story.sections.append(sections.fit_again(r, k) if isinstance(r, Fit) else sections.of_card(r, k))
    story.title = title or story.title
    return story


def _of_diagnosis(d: Diagnosis, validate: Sequence[Experiment]) -> Story:
    runs = d.before.problem.experiments
    mood = {"adequate": "good", "missing": "note", "unexplained": "bad"}.get(d.verdict, "plain")
    story = Story("What is missing in the motor's model?", d.text, [Flag(d.verdict, mood)], runs=runs)
    story.facts = [*sections.error_facts(d.ladder), ("Effects added", ", ".join(d.effects) or "none")]
    story.sections += [
        sections.data(runs),
        sections.fitted(d.before, "The model it began with"),
        sections.where(d),
    ]
    if d.ranking:
        story.sections.append(sections.which(d))
    if len(d.ladder.rungs) > 1:
        story.sections += [sections.ladder(d.ladder), sections.parameters(d.before, d.after)]
        story.sections.append(sections.fitted(d.after, "The model it ended with", key="after", before=d.before))
    if validate:
        story.sections.append(sections.held_out(d.after, validate))
    story.sections.append(sections.apart(d))
    return story


def _of_ladder(ladder: Ladder) -> Story:
    first, best = ladder.rungs[0].fit, ladder.best
    story = Story("Models of growing detail", ladder.text, runs=first.problem.experiments)
    story.facts = sections.error_facts(ladder)
    story.sections += [sections.data(story.runs), sections.ladder(ladder), sections.parameters(first, best)]
    story.sections.append(sections.fitted(best, "The last model", before=first if best is not first else None))
    return story


def _of_fit(fit: Fit, validate: Sequence[Experiment]) -> Story:
    card = card_of(fit)
    story = Story(card.title, " ".join(t for t in card.text if t), card.flags, runs=fit.problem.experiments)
    story.facts = [(f"Error of the {NAMES[c]}", percent(e)) for c, e in fit.nrmse.items()]
    if fit.tau_m:
        story.facts.append(("Mechanical time constant", duration(fit.tau_m)))
    if fit.tau_e:
        story.facts.append(("Electrical time constant", duration(fit.tau_e)))
    story.sections += [sections.data(story.runs), sections.fitted(fit, "The fit"), sections.residuals(fit)]
    if validate:
        story.sections.append(sections.held_out(fit, validate))
    return story

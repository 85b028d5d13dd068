"""The commands that judge a model: `diagnose`, `identifiability`, `robustness`."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from motorid.cli.console import save_report, say_notes, show
from motorid.cli.options import (
    Choices,
    Json,
    Report,
    Runs,
    Validate,
    notes_of,
    own_effects,
    with_choices,
)
from motorid.display.tables import comparison_table, ladder_table, ranking_table
from motorid.exporters.json_file import write_json
from motorid.numerics.parallel import progress
from motorid.uncertainty.covariance import deviations

OUT = "Results"


@with_choices(Choices)
def diagnose(
    runs: Runs, choices: Choices, validate: Validate = None,
    max_effects: Annotated[int, typer.Option(min=0, metavar="N", help="Add at most so many effects.")] = 3,
    json: Json = None, report: Report = None,
) -> None:
    """Say where the model fails, which physical effect is missing, and whether adding it holds up.

    Example: motorid diagnose run*.csv --validate check*.csv --report found.html
    """
    from motorid.diagnosis.cross_validation import fit_affordably
    from motorid.diagnosis.diagnose import diagnose as look

    records = choices.read(runs)
    held_out = choices.read(validate) if validate else []
    notes = notes_of(records, held_out)
    before = fit_affordably(records, choices.fit)
    own = list(own_effects(choices.effects_from).values()) if choices.effects_from else []
    with progress("Looking for what is missing") as advance:
        found = look(before, held_out or None, also=own, max_effects=max_effects,
                     progress=lambda _: advance(1))
    if json:
        write_json(found.to_dict() | {"notes": notes}, json)
    if json != "-":
        say_notes(notes, "About the records")
        show_diagnosis(found)
    save_report(found, report, held_out)


@with_choices(Choices)
def identifiability(runs: Runs, choices: Choices, json: Json = None, report: Report = None) -> None:
    """Say which parameters, and which combinations of them, the records determine.

    Example: motorid identifiability run*.csv --effects coulomb
    """
    from motorid.uncertainty.identifiability import identifiability as study

    records = choices.read(runs)
    fitted = choices.fit(records)
    found = study(fitted)
    if json:
        write_json(found.to_dict(), json)
    if json != "-":
        show(str(found))
    save_report([fitted, found], report)


@with_choices(Choices)
def robustness(
    runs: Runs, choices: Choices,
    starts: Annotated[int, typer.Option(min=1, metavar="N", help="How many fits.",
                                        rich_help_panel=OUT)] = 100,
    spread: Annotated[float, typer.Option(min=1.0, help="Every start is off by up to this factor.",
                                          rich_help_panel=OUT)] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the drawn starts.", rich_help_panel=OUT)] = 0,
    json: Json = None, report: Report = None,
) -> None:
    """Fit from many poor starts, and say whether all end in the same place.

    Example: motorid robustness run*.csv --starts 50 --spread 10
    """
    from motorid.uncertainty.multistart import robustness as study

    records = choices.read(runs)
    fitted = choices.fit(records)
    found = study(fitted, starts=starts, spread=spread, seed=seed)
    if json:
        write_json(found.to_dict(), json)
    if json != "-":
        show(str(found))
    save_report([fitted, found], report)


def show_diagnosis(found: Any) -> None:
    """Print a diagnosis: verdict, place, ranking, ladder, how the parameters moved, what stays open."""
    show(f"{found.text}\n")
    show(f"Where: {found.missing.text}\n" if found.missing.text and found.verdict != "adequate" else None)
    show(ranking_table(found.ranking) if found.ranking else None)
    show(ladder_table(found.ladder), found.ladder.text)
    if found.after is not found.before:
        show(comparison_table([("before", found.before), ("after", found.after)], std=deviations))
    for group in found.groups:
        show(f"These records cannot tell apart: {', '.join(group)}.")
    show(found.suggestion)


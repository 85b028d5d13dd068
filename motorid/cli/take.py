"""The commands `fit-many` and `export`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from motorid.cli.console import FAILED, show
from motorid.cli.options import OUT, Choices, Json, model_of, with_choices
from motorid.errors import DataError, UsageError, one_of
from motorid.exporters.json_file import write_json
from motorid.records.experiment import Experiment
from motorid.records.layout import parse_pairs
from motorid.uncertainty.batch import fit_many as fit_all
from motorid.uncertainty.batch import motors_in

FORMS = ("casadi", "c", "json")


@with_choices(Choices)
def fit_many(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="One folder, or file, per motor.")],
    choices: Choices,
    out: Annotated[Path | None, typer.Option(
        metavar="TABLE.csv", rich_help_panel=OUT, help="Write the table: .csv, .parquet or .json.")] = None,
    journal: Annotated[Path | None, typer.Option(
        metavar="FILE", rich_help_panel=OUT, help="Results as they come, to go on from.")] = None,
    jobs: Annotated[int, typer.Option(min=1, metavar="N", rich_help_panel=OUT, help="Processes.")] = 1,
    json: Json = None,
) -> None:
    """Fit one model to the records of many motors; a motor that fails is a row that says why.

    Example: motorid fit-many motors/ --effects coulomb --out table.csv
    """
    from concurrent.futures import ProcessPoolExecutor

    motors: dict[str, Any] = dict(motors_in(directory))
    model = choices.model(_sample(choices, motors.values()))
    if choices.changes:
        motors = {name: _read(choices, files) for name, files in motors.items()}
    reading: dict[str, Any] = {k: parse_pairs(v, f"--{k}") for k in ("columns", "units")
                               if (v := getattr(choices, k))}
    reading |= {"hold": choices.hold} if choices.hold else {}
    options = {"journal": journal, "reading": reading, **choices.options()}
    if jobs == 1:
        found = fit_all(model, motors, **options)
    else:
        with ProcessPoolExecutor(jobs) as pool:
            found = fit_all(model, motors, map=pool.map, **options)
    if json:
        write_json(found.to_dict(), json)
    if json != "-":
        show(str(found))
    if out:
        show(f"Table: {found.save(out)}")
    if len(found.failed) == len(found.rows):
        raise typer.Exit(FAILED)


def export(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.json", help="What fit --json wrote.")],
    path: Annotated[Path, typer.Argument(metavar="PATH", help="What to write.")],
    to: Annotated[str | None, typer.Option(
        metavar="casadi|c|json", show_default=False, help="Form of the model; by default PATH's ending.")] = None,
    effects_from: Annotated[Path | None, typer.Option(
        metavar="FILE.py", help="Effects of your own.")] = None,
) -> None:
    """Take a fitted model along: as CasADi functions, as C source, as JSON.

    Example: motorid export fit.json --to c motor.c
    """
    from motorid.exporters.export import export as write

    if to is not None and to not in FORMS:
        raise UsageError(f"--to: {one_of(to, FORMS, 'form')}")
    show(f"Written: {write(model_of(fit_json, effects_from), path, to)}")


def _read(choices: Choices, files: list[Path]) -> list[Any]:
    """Return the records of one motor, or their names where they cannot be read: its row says why."""
    try:
        return list(choices.read([str(f) for f in files]))
    except DataError:
        return list(files)


def _sample(choices: Choices, motors: Iterable[list[Path]]) -> list[Experiment]:
    """Return the records of the first motor that can be read: they tell a rotary from a linear axis."""
    for files in motors:
        try:
            return choices.read([str(f) for f in files])
        except DataError:
            continue
    return []

"""The commands `fit-many` and `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motorid.cli_options import Choices, Json, with_choices


@with_choices(Choices)
def fit_many(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="One folder, or file, per motor.")],
    choices: Choices,
    out: Annotated[Path | None, typer.Option(metavar="TABLE.csv", help="Write the table as CSV.")] = None,
    json: Json = None,
) -> None:
    """Fit one model to the records of many motors; a motor that fails is a row that says why.

    Example: motorid fit-many motors/ --effects coulomb --out table.csv
    """
    raise NotImplementedError


def export(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.json", help="What fit --json wrote.")],
    path: Annotated[Path, typer.Argument(metavar="PATH", help="What to write.")],
    to: Annotated[str, typer.Option(metavar="casadi|c|json", help="Form of the model.")] = "casadi",
    effects_from: Annotated[Path | None, typer.Option(metavar="FILE.py", help="Effects of your own.")] = None,
) -> None:
    """Take a fitted model along: as a CasADi function, as C source, as JSON.

    Example: motorid export fit.json --to c motor.c
    """
    raise NotImplementedError

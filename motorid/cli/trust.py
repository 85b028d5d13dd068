"""The commands that say how far a fit can be trusted: `identifiability` and `robustness`."""

from __future__ import annotations

from typing import Annotated

import typer

from motorid.cli.console import save_report, show
from motorid.cli.options import OUT, FitOptions, Json, Report, Runs, with_options
from motorid.estimation.result import Fit
from motorid.exporters.json_file import write_json
from motorid.uncertainty.identifiability import Identifiability, identifiability
from motorid.uncertainty.multistart import Multistart, multistart


@with_options(FitOptions)
def identifiability_command(runs: Runs, options: FitOptions, json: Json = None, report: Report = None) -> None:
    """Say which parameters, and which combinations of them, the records determine.

    Example: motorid identifiability run*.csv --effects coulomb
    """
    fitted = options.fit(options.read(runs))
    _hand_over(fitted, identifiability(fitted), json, report)


@with_options(FitOptions)
def robustness_command(
    runs: Runs, options: FitOptions,
    starts: Annotated[int, typer.Option(min=1, metavar="N", rich_help_panel=OUT, help="How many fits.")] = 100,
    spread: Annotated[float, typer.Option(
        min=1.0, rich_help_panel=OUT, help="Every start is off by up to this factor.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, rich_help_panel=OUT, help="Of the drawn starts.")] = 0,
    json: Json = None, report: Report = None,
) -> None:
    """Fit from many poor starts, and say whether all end in the same place.

    Example: motorid robustness run*.csv --starts 50 --spread 10
    """
    fitted = options.fit(options.read(runs))
    _hand_over(fitted, multistart(fitted, starts=starts, spread=spread, seed=seed), json, report)


def _hand_over(fitted: Fit, found: Identifiability | Multistart, json: Json, report: Report) -> None:
    if json:
        write_json(found.to_dict(), json)
    if json != "-":
        show(str(found))
    save_report([fitted, found], report)

"""The command `design`: the next experiment, from what a diagnosis found."""

from __future__ import annotations

import json as reader
from pathlib import Path
from typing import Annotated

import typer

from motorid.cli.console import INTERRUPTED, show
from motorid.cli.fit import EffectsFrom
from motorid.cli.options import OUT, Force, Json, own_effects
from motorid.diagnosis.design_criteria import Rival
from motorid.diagnosis.experiment_design import LEVELS, design_experiment
from motorid.errors import DataError
from motorid.exporters.json_file import write_json
from motorid.numerics.parallel import interruption, progress
from motorid.problem.plain_data import model_from_json
from motorid.records.files import check_output, read_bytes

LIMITS = "Limits"
Found = Annotated[Path, typer.Argument(metavar="FOUND.json", help="What diagnose --json wrote.")]
Plan = Annotated[Path | None, typer.Option(
    metavar="plan.csv", rich_help_panel=OUT, help="Write time, voltage and predictions.")]
Goal = Annotated[str | None, typer.Option(
    metavar="distinguish|sharpen", help="By default to distinguish, where the diagnosis left a group of effects.")]
Parameters = Annotated[str | None, typer.Option(metavar="R,K", help="What to sharpen; by default all that are free.")]
Volts = Annotated[float | None, typer.Option(min=0, metavar="V", rich_help_panel=LIMITS)]
Amperes = Annotated[float | None, typer.Option(min=0, metavar="A", rich_help_panel=LIMITS)]
Speed = Annotated[float | None, typer.Option(min=0, metavar="RAD/S", rich_help_panel=LIMITS)]
Angle = Annotated[tuple[float, float] | None, typer.Option(
    metavar="RAD RAD", rich_help_panel=LIMITS, help="From, to; the start is at 0.")]
Kelvin = Annotated[float | None, typer.Option(
    min=0, metavar="K", rich_help_panel=LIMITS, help="Rise of the winding's temperature.")]
Seconds = Annotated[float | None, typer.Option(min=0, metavar="S", help="By default that of the longest record.")]
Shape = Annotated[str, typer.Option(metavar="steps|free|multisine", help="Steps, ramps, or ramps along sines.")]
Levels = Annotated[int, typer.Option(metavar="N", help="Segments of the voltage; a bench takes so many.")]
Slew = Annotated[float | None, typer.Option(metavar="V/S", rich_help_panel=LIMITS, help="Largest slope of ramps.")]
Budget = Annotated[float | None, typer.Option(metavar="S", help="Take the best so far after this time.")]


def design_command(found_json: Found, out: Plan = None, goal: Goal = None, parameters: Parameters = None,
                   limit_voltage: Volts = None, limit_current: Amperes = None, limit_speed: Speed = None,
                   limit_angle: Angle = None, limit_temperature: Kelvin = None, duration: Seconds = None,
                   shape: Shape = "steps", levels: Levels = LEVELS, slew: Slew = None, budget: Budget = None,
                   effects_from: EffectsFrom = None, json: Json = None, force: Force = False) -> None:
    """Design the next experiment: the voltage that best distinguishes what a diagnosis could not, or sharpens it.

    Limits are by default the largest values of the records; nothing is played.

    Example: motorid design found.json --limit-current 5 --duration 4 --out plan.csv
    """
    rivals = read_rivals(found_json, effects_from, goal)
    if out is not None:
        check_output(out, force)
    with progress("Designing") as advance:
        design = design_experiment(
            rivals, goal=goal, parameters=parameters.replace(" ", "").split(",") if parameters else None,
            v_max=limit_voltage, i_max=limit_current, omega_max=limit_speed, theta_range=limit_angle,
            temp_max=limit_temperature, duration=duration, shape=shape, levels=levels, slew=slew, budget=budget,
            progress=lambda _: advance(1))
    if json:
        write_json(design.to_dict(), json, force)
    if json != "-":
        card = design.card()
        show(card.text[0], *card.tables, "Play it with:")
        typer.echo(f'motorid record --port PORT --out next.csv --excite "{design.excite}"')  # to copy: not wrapped
    if out is not None:
        path = design.to_csv(out, force)
        show(f"Written: {path}" if json != "-" else None)
    if interruption.asked:
        raise typer.Exit(INTERRUPTED)


def read_rivals(path: Path, effects_from: Path | None, goal: str | None) -> list[Rival]:
    """Return the rivals, or the best model alone, that ``diagnose --json`` wrote.

    Raises
    ------
    DataError
        If the file cannot be read, or is no such file.
    """
    own, text = list(own_effects(effects_from).values()) if effects_from else [], read_bytes(path)
    try:
        contents = reader.loads(text)
        listed = [contents["best"]] if goal == "sharpen" else contents["rivals"]
        return [Rival.from_dict(r, model_from_json(r, own)) for r in listed]
    except (DataError, ValueError, KeyError, TypeError):
        raise DataError(f"{path} holds no rival models. Write it with: motorid diagnose RUN... --json {path}") from None

"""The commands `diagnose`, `design`, which plans what would decide, and `demo`, the story on shipped records."""

import functools
import re
from collections.abc import Sequence
from json import loads
from pathlib import Path
from typing import Annotated

import typer

from motorid.cli import options as opt
from motorid.cli.console import INTERRUPTED, next_command, save_report, say_notes, show
from motorid.diagnosis.design_criteria import Rival
from motorid.diagnosis.diagnose import diagnose
from motorid.diagnosis.experiment_design import LEVELS, design_experiment
from motorid.diagnosis.record_versions import fit_affordably
from motorid.diagnosis.refit import INTERRUPTED as STOPPED_BY_HAND
from motorid.diagnosis.results import Diagnosis, ladder_table, ranking_table
from motorid.errors import DataError
from motorid.estimation.fit import fit
from motorid.estimation.result import Fit, parameter_table
from motorid.exporters.json_file import fit_dict, write_json
from motorid.model.model import dc_motor
from motorid.numerics import parallel
from motorid.problem.plain_data import model_from_json
from motorid.problem.simulate import error_table
from motorid.records.datasets import data_path
from motorid.records.experiment import Experiment
from motorid.records.files import read_bytes, write_files
from motorid.records.reading import read_runs

DEMO_SET = "hidden_friction"

_limit = functools.partial(typer.Option, rich_help_panel="Limits")
MaxEffects = Annotated[int, opt.result(min=0, metavar="N", help="Largest number of effects to add.")]
TimeLimit = Annotated[float | None, opt.result(
    min=0, metavar="SECONDS", help="Stop after this time with the best answer so far, as Ctrl-C does; --remainder-to "
                                   "may take as long again.")]
RemainderFile = Annotated[Path | None, opt.result(
    metavar="FILE.py", help="Write what no effect explains as an effect, for --effects-from.")]
Found = Annotated[Path, typer.Argument(metavar="FOUND.json", help="File written by diagnose --json.")]
Plan = Annotated[Path | None, opt.result(metavar="plan.csv", help="Write time, voltage and predictions.")]
Goal = Annotated[str | None, typer.Option(
    metavar="distinguish|sharpen", help="By default to distinguish, where the diagnosis left a group of effects.")]
Parameters = Annotated[str | None, typer.Option(metavar="R,K", help="What to sharpen; by default all that are free.")]
Volts = Annotated[float | None, _limit(min=0, metavar="V")]
Amperes = Annotated[float | None, _limit(min=0, metavar="A")]
Speed = Annotated[float | None, _limit(min=0, metavar="RAD/S")]
Angle = Annotated[tuple[float, float] | None, _limit(metavar="RAD RAD", help="From, to; the start is at 0.")]
Kelvin = Annotated[float | None, _limit(min=0, metavar="K", help="Rise of the winding's temperature.")]
Seconds = Annotated[float | None, typer.Option(min=0, metavar="S", help="By default that of the longest record.")]
Shape = Annotated[str, typer.Option(metavar="steps|free|multisine", help="Steps, ramps, or ramps along sines.")]
Levels = Annotated[int, typer.Option(metavar="N", help="Number of segments of the voltage; a bench has a limit.")]
Slew = Annotated[float | None, _limit(metavar="V/S", help="Largest slope of ramps.")]
Budget = Annotated[float | None, typer.Option(metavar="S", help="Stop after this time with the best so far.")]

DemoFolder = Annotated[Path, typer.Option(metavar="DIR", help="Where figures and report go.")]


@opt.with_options(opt.FitOptions)
def diagnose_command(runs: opt.Runs, options: opt.FitOptions, validate: opt.Validate = None,
                     max_effects: MaxEffects = 3, budget: TimeLimit = None, remainder_to: RemainderFile = None,
                     jobs: opt.Jobs = 1, json: opt.Json = None, report: opt.Report = None) -> None:
    """Say where the model fails, which physical effect is missing, and what the error is with it.

    Example: motorid diagnose run*.csv --validate check*.csv --report found.html"""
    records = options.read(runs)
    held_out = options.read(validate) if validate else []
    notes = options.notes(records, held_out)
    before = fit_affordably(records, options.fit)
    own = list(opt.own_effects(options.effects_from).values()) if options.effects_from else []
    done: list[str] = []

    def as_it_comes(word: str) -> None:
        done.append(word)
        if word.startswith("first answer") and json != "-":
            show(f"{word[0].upper()}{word[1:]}\n")

    try:
        with parallel.processes(jobs) as over:
            found = diagnose(before, held_out or None, also=own, max_effects=max_effects, budget=budget,
                             map=over or map, progress=as_it_comes)
    except (Exception, KeyboardInterrupt) as error:
        if parallel.interruption.behind(error):
            _keep_fit(before, done, json, options.force)
        raise
    if json != "-":
        _show_diagnosis(found, notes, report, remainder_to)
    if json:
        write_json(found.to_dict() | {"notes": notes}, json, options.force)
    save_report(found, report, held_out, options.force, quiet=json == "-")
    if remainder_to:
        assert found.remainder is not None
        name = stem if (stem := remainder_to.stem).isidentifier() else "remainder"
        with parallel.budget(budget):
            law = found.remainder.code(name)
        write_files({remainder_to: law}, options.force)
        effects = ",".join((*found.remainder.model.effect_names, name))
        show(None if json == "-" else
             f"Written: {remainder_to}. Fit with it: --effects-from {remainder_to} --effects {effects}")
    if found.stopped == STOPPED_BY_HAND:
        raise typer.Exit(INTERRUPTED)


def _keep_fit(before: Fit, done: Sequence[str], json: opt.Json, force: bool) -> None:
    """Show and write what an interrupted diagnosis began with, and how far it came."""
    parallel.interruption.heard()
    if json != "-":
        show(f"Interrupted after: {', '.join(done) or 'the fit'}. The original model:", parameter_table(before))
    if json:
        write_json(fit_dict(before) | {"interrupted": list(done)}, json, force)


def _show_diagnosis(found: Diagnosis, notes: Sequence[str], report: Path | None, remainder_to: Path | None) -> None:
    """Print a diagnosis: the answer, the errors before and after, the next step; then what it rests on."""
    show(found.answer, "", ladder_table(found.ladder), _next_step(found, report, remainder_to), "")
    say_notes(notes, "About the records")
    say_notes(found.details, "Details")
    if found.after is not found.before:
        show(parameter_table(found.after, found.before))
    show(ranking_table(found.ranking, 8) if found.ranking else None)


def _next_step(found: Diagnosis, report: Path | None = None, remainder_to: Path | None = None) -> str:
    """Return what to do next: more time, the experiment that decides, what remains, or the model to go on with."""
    if found.stopped:
        return "Next: the same command with more time; not all effects were tried."
    if found.suggestion:
        made = "\nOr design one: diagnose with --json found.json, then motorid design found.json"
        return f"Next: {found.suggestion[0].lower()}{found.suggestion[1:]}{made * found.suggestion.startswith('To ')}"
    if found.remainder is not None and found.remainder.proposed and remainder_to is None:
        command = next_command("diagnose", "--remainder-to", "remainder.py")
        return f"Next: {command}\nIt writes what remains as an effect."
    read = [option.replace(" ", "=") for option in re.findall(r"with (--\S+(?: \S+)?) the error", found.text)]
    if found.effects:
        names = ",".join(found.after.model.effect_names)
        return f"Next: {next_command('fit', '--effects', names, *read, '--json', 'fit.json')}"
    if found.verdict == "unexplained":
        command = f"look at {report}." if report else next_command("diagnose", "--report", "found.html")
        return f"Next: {command}\nIt shows where the model fails."
    if found.after.mostly_noise:
        return "Next: record again, driven by larger steps or with less noise: these records tell a fit little."
    return f"Next: {next_command('fit', *read, '--json', 'fit.json')}\nThen: motorid export fit.json motor.casadi"


def design_command(found_json: Found, out: Plan = None, goal: Goal = None, parameters: Parameters = None,
                   limit_voltage: Volts = None, limit_current: Amperes = None, limit_speed: Speed = None,
                   limit_angle: Angle = None, limit_temperature: Kelvin = None, duration: Seconds = None,
                   shape: Shape = "steps", levels: Levels = LEVELS, slew: Slew = None, budget: Budget = None,
                   effects_from: opt.EffectsFrom = None, json: opt.Json = None, force: opt.Force = False) -> None:
    """Design the next experiment: the voltage that best distinguishes what a diagnosis could not, or sharpens it.

    Limits are by default the largest values of the records; nothing is played.

    Example: motorid design found.json --limit-current 5 --duration 4 --out plan.csv"""
    rivals = read_rivals(found_json, effects_from, goal)
    design = design_experiment(
        rivals, goal=goal, parameters=parameters.replace(" ", "").split(",") if parameters else None,
        v_max=limit_voltage, i_max=limit_current, omega_max=limit_speed, theta_range=limit_angle,
        temp_max=limit_temperature, duration=duration, shape=shape, levels=levels, slew=slew, budget=budget)
    if json != "-":
        card = design.card()
        show(card.text[0], *card.tables, "Play it with:")
        typer.echo(f'motorid record --port PORT --out next.csv --excite "{design.excite}"')  # to copy: not wrapped
    if json:
        write_json(design.to_dict(), json, force)
    if out is not None:
        path = design.to_csv(out, force)
        show(f"Written: {path}" if json != "-" else None)
    if parallel.interruption.asked:
        raise typer.Exit(INTERRUPTED)


def read_rivals(path: Path, effects_from: Path | None, goal: str | None) -> list[Rival]:
    """Return the rivals, or the best model alone, that ``diagnose --json`` wrote; DataError if that cannot be read."""
    own, text = list(opt.own_effects(effects_from).values()) if effects_from else [], read_bytes(path)
    try:
        contents = loads(text)
        listed = [contents["best"]] if goal == "sharpen" else contents["rivals"]
        return [Rival.from_dict(r, model_from_json(r, own)) for r in listed]
    except (DataError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise DataError(f"{path} holds no rival models. Write it with: motorid diagnose RUN... --json {path}") from None


def demo_command(out: DemoFolder = Path("motorid-demo"), json: opt.Json = None, force: opt.Force = False) -> None:
    """Show the story on shipped records: fit, see that it fails, add what is missing, see the error fall.

    Example: motorid demo --out demo"""
    opt.make_folder(out)
    runs, check = (read_runs(str(data_path(DEMO_SET) / pattern)) for pattern in ("run*.csv", "check*.csv"))
    show(f"1. Records: {len(runs)} of a motor ({data_path(DEMO_SET)}), and one held out that no fit will see.\n",
         "2. The textbook model, fitted without a first guess:")
    plain = fit(dc_motor(), runs)
    show(plain.verdict, "", parameter_table(plain), error_table({"": plain.evaluation}, plain.noise),
         "3. What is missing?")
    found = diagnose(plain, check)
    show(found.text, found.missing.text, "", ranking_table(found.ranking, 4),
         "4. Added, one line of code: fit.model + mi.effects." + (found.effects or ("…",))[0],
         ladder_table(found.ladder), parameter_table(found.after, found.before))
    with parallel.progress("Writing the figures"):
        files = _write_demo(found, check, out, force)
    show("Written: " + ", ".join(files), "Now your own: motorid diagnose RUN... --report yours.html")
    if json:
        write_json(found.to_dict() | {"files": files}, json, force)


def _write_demo(found: Diagnosis, check: Sequence[Experiment], out: Path, force: bool) -> list[str]:
    from motorid.plots import plot_fit, plot_ladder, plot_missing
    from motorid.plots.style import png_of
    from motorid.reports.report import report

    drawn = {"fit.png": plot_fit(found.after, before=found.before), "missing.png": plot_missing(found),
             "ladder.png": plot_ladder(found)}
    figures = write_files({out / name: png_of(axes) for name, axes in drawn.items()}, force)
    page = report(found, out / "report.html", command=f"motorid demo --out {out}", validate=check, force=force)
    return [str(page), *map(str, figures)]

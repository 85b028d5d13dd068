"""The commands on one model: `fit`, `fit-many`, how far to trust it, `simulate` and `export`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from motorid.cli import options as opt
from motorid.cli.console import FAILED, INTERRUPTED, next_command, save_report, say_notes, show
from motorid.display.cards import Table
from motorid.display.numbers import counted, duration, factor, number, quantity, sentence
from motorid.effects import EVERY
from motorid.errors import DataError, among, otherwise
from motorid.estimation.result import PLAIN, Fit, constraint_table, ended, steady_table, value_tables
from motorid.exporters.c_code import check
from motorid.exporters.export import FORMS, MOSTLY_NOISE, export
from motorid.exporters.json_file import constraint_violations, fit_dict, remarks, run_dict, write_json
from motorid.numerics.parallel import processes
from motorid.problem.simulate import NRMSE, Evaluation, error_table, evaluate, run_table
from motorid.records.experiment import Experiment, repeated
from motorid.records.files import read_bytes, write_files
from motorid.records.reading import csv_text
from motorid.uncertainty.batch import Batch, fit_many, motors_in
from motorid.uncertainty.identifiability import Identifiability, identifiability
from motorid.uncertainty.multistart import Multistart, multistart

MOST_SHOWN = 4  # runs of which all columns are listed
SavedModel = Annotated[Path, typer.Argument(metavar="FIT.json", help="File written by fit --json or export.")]
Motors = Annotated[list[Path], typer.Argument(metavar="DIR", help="One folder, or file, per motor inside.")]
MotorTable = Annotated[Path | None, opt.result(metavar="TABLE.csv", help="Write the table: .csv, .parquet or .json.")]
Journal = Annotated[Path | None, opt.result(metavar="FILE", help="Results as they come, to go on from.")]
EffectName = Annotated[str | None, typer.Argument(metavar="NAME", show_default=False, help="One effect.")]
ChannelFolder = Annotated[Path | None, typer.Option(metavar="DIR", help="Write the simulated channels as CSV.")]
Engine = Annotated[str, typer.Option(metavar="rosenbrock|cvodes|idas")]
Target = Annotated[Path, typer.Argument(metavar="PATH", help="File to write.")]
Form = Annotated[str | None, typer.Option(
    metavar="casadi|c|json", show_default=False, help="Format; by default that of PATH's ending.")]
Starts = Annotated[int, opt.result(min=1, metavar="N", help="Number of fits.")]
Spread = Annotated[float, opt.result(min=1.0, metavar="FACTOR", help="Every start is off by up to this factor.")]
Seed = Annotated[int, opt.result(min=0, metavar="N", help="Seed of the starts.")]


@opt.with_options(opt.FitOptions)
def fit_command(runs: opt.Runs, options: opt.FitOptions, validate: opt.Validate = None, json: opt.Json = None,
                report: opt.Report = None) -> None:
    """Fit a motor model to records, and say how far the numbers can be trusted.

    Example: motorid fit run*.csv --effects coulomb --validate check*.csv --json fit.json"""
    records = options.read(runs)
    held_out = options.read(validate) if validate else []
    notes = [*filter(None, [repeated(records, held_out)]), *options.notes(records, held_out)]
    found = options.fit(records)
    judged = evaluate(found, held_out) if held_out else None
    if json != "-":
        _show_fit(found, records, notes, judged)
    if json:
        write_json(fit_dict(found, judged) | {"notes": notes}, json, options.force)
    save_report(found, report, held_out, options.force, quiet=json == "-")
    if found.status == "failed":
        raise typer.Exit(FAILED)


def _show_fit(found: Fit, records: list[Experiment], notes: list[str], judged: Evaluation | None = None) -> None:
    fits = found.fits == "noise" and max(found.misfit.values(), default=0.0) < PLAIN and not found.mostly_noise
    plain = fits and found.status == "converged"
    show(found.verdict, _held_out(found, judged) if judged else None, NRMSE,
         f"Next: {next_command('fit', '--json', 'fit.json')}\nThen: motorid export fit.json motor.casadi" if plain
         else f"Next: {next_command('diagnose')}", f"\n{found.model.title}, {_amount(records)}. {ended(found)}\n")
    say_notes(notes, "About the records")
    show(*value_tables(found))
    say_notes(remarks(found), "What to know about these values")
    show(replace(error_table({"": found.evaluation, "held-out": judged}, found.noise), note=""),
         run_table(found.evaluation) if len(records) > 1 else None,
         run_table(judged, "Held-out errors run by run") if judged and len(judged.simulations) > 1 else None,
         steady_table(found), constraint_table(found, constraint_violations(found)))


def _held_out(found: Fit, judged: Evaluation) -> str:
    """Say how large the held-out errors are beside the noise, since another record may have smaller signals."""
    times = max((judged.rmse[c] / s for c, s in found.noise.items() if c in judged.rmse), default=0.0)
    said = "at the level of the noise" if times < PLAIN else f"{factor(times, 'up to ')} times the noise"
    return f"Held out: errors {said} (NRMSE {judged.words})."


def _amount(records: list[Experiment]) -> str:
    samples, seconds = sum(r.n for r in records), sum(r.duration for r in records)
    return f"{counted(len(records), 'run')}, {samples} samples, {duration(seconds)}"


@opt.with_options(opt.FitOptions)
def fit_many_command(directories: Motors, options: opt.FitOptions, out: MotorTable = None, journal: Journal = None,
                     jobs: opt.Jobs = 1, json: opt.Json = None) -> None:
    """Fit one model to the records of many motors; a motor that fails is a row that says why.

    Names of motors begin with their folder where several are given.

    Example: motorid fit-many motors/ --effects coulomb --out table.csv"""
    motors: dict[str, Any] = {f"{place.name}/{name}" if len(directories) > 1 else name: files
                              for place in directories for name, files in motors_in(place).items()}
    known = (records for files in motors.values() if (records := _readable(options, files)))
    model = options.model(next(known, []))  # the first that can be read tell a rotary from a linear axis
    if options.ignore or options.median or options.levels or options.delay or options.no_spikes:
        motors = {name: _readable(options, files) or files for name, files in motors.items()}
    with processes(min(jobs, len(motors))) as over:
        found = fit_many(model, motors, map=over, journal=journal, reading=options.reading, **options.keywords())
    _give(found, json, options.force)
    told = f"Table: {found.save(out, options.force)}" if out else None
    show(told if json != "-" else None)
    if found.interrupted:
        raise typer.Exit(INTERRUPTED)
    if len(found.failed) == len(found.rows):
        raise typer.Exit(FAILED)


def _readable(options: opt.FitOptions, files: list[Path]) -> list[Any]:
    """Return the records of one motor, none where they cannot be read: its row says why."""
    return otherwise([], DataError, lambda: list(options.read([str(f) for f in files])))


@opt.with_options(opt.DriveOptions)
def check_command(runs: opt.Runs, options: opt.DriveOptions, json: opt.Json = None) -> None:
    """Show how records are read, column by column, and what looks wrong with them, before any fit.

    Example: motorid check run*.csv"""
    records = options.read(runs)
    notes = options.notes(records)
    if json:
        write_json({"runs": [run_dict(r) | {"columns": r.meta.get("columns"), "units": dict(r.units)} for r in records],
                    "notes": notes}, json, options.force)
    if json != "-":
        show(f"{_amount(records)}. {counted(len(notes), 'remark') if notes else 'No problem found'}.\n")
        say_notes(notes)
        show(*(_channel_table(r) for r in records[:MOST_SHOWN]))
        torque = options.drive != "torque" and records[0].units["v"] in ("A", "N·m", "N")
        show(f"and {counted(len(records) - MOST_SHOWN, 'more run')}\n" if len(records) > MOST_SHOWN else None,
             f"Next: {next_command('fit', *(('--drive', 'torque') if torque else ()))}")


def _channel_table(run: Experiment) -> Table:
    """Return which column became which channel, with unit and range."""
    columns, units = run.meta.get("columns", {}), run.meta.get("original_units", {})
    rows = [["t", columns.get("t", "–"), units.get("t", "s"), f"0 … {number(run.duration, 4)} s", "–"]]
    for c, y in (*run.inputs.items(), *run.outputs.items()):
        good = y[np.isfinite(y)]
        limits = f"{number(good.min(), 3)} … {quantity(good.max(), run.units[c], 3)}" if good.size else "–"
        rows.append([c, columns.get(c, "–"), units.get(c, run.units[c]), limits, str(len(y) - good.size)])
    return Table(["channel", "column", "unit read", "range (SI)", "missing"], rows, f"{run.name}: {run.n} samples, "
                 f"{number(1e3 * run.dt, 3)} ms apart", left=(0, 1, 2, 3))


def effects_command(name: EffectName = None, effects_from: opt.EffectsFrom = None) -> None:
    """List the effects of the library, or show one: its law, its parameters, its source.

    Example: motorid effects stribeck"""
    own = opt.own_effects(effects_from) if effects_from else {}
    if name is not None:
        show(str(opt.named_effect(name, own).card()), f"\nAdd it: motorid fit RUN... --effects {name}")
        return
    rows = [[e.name, e.balance, e.title, ", ".join(p.name for p in e.parameters)] for e in (own | EVERY).values()]
    show(Table(["effect", "acts on", "what it is", "parameters"], rows, "Effects", left=(0, 1, 2, 3)),
         "One of them: motorid effects NAME. Add it: motorid fit RUN... --effects NAME")


@opt.with_options(opt.ReadingOptions)
def simulate_command(fit_json: SavedModel, runs: opt.Runs, options: opt.ReadingOptions, out: ChannelFolder = None,
                     engine: Engine = "rosenbrock", effects_from: opt.EffectsFrom = None,
                     json: opt.Json = None) -> None:
    """Simulate a fitted model on records, and compare where something was measured.

    Example: motorid simulate fit.json check*.csv --out simulated"""
    model = opt.saved_model(fit_json, effects_from)
    records = options.read(runs)
    judged = evaluate(model, records, engine=engine)
    files = _write_simulations(judged, out, options.force) if out else []
    if json:
        pairs = zip(records, judged.by_run, strict=True)
        write_json({"model": {"base": model.base, "axis": model.axis, "effects": list(model.effect_names)},
                    "nrmse": judged.nrmse, "rmse": judged.rmse, "files": files,
                    "runs": [run_dict(r) | {"nrmse": e} for r, e in pairs]}, json, options.force)
    if json != "-":
        show(f"{model.name}, values of {fit_json}", run_table(judged), NRMSE)
        show(*(f"Written: {f}" for f in files))


def _write_simulations(judged: Evaluation, out: Path, force: bool) -> list[str]:
    opt.make_folder(out)
    files: dict[Path, str] = {}
    for s in judged.simulations:
        name = s.experiment.name.replace("/", "_")
        paths = (out / f"{name}{k}_simulated.csv" for k in ("", *(f"_{n}" for n in range(2, 10**6))))
        kept = {c: s.outputs[c] for c in s.experiment.channels if c in s.outputs}
        files[next(p for p in paths if p not in files)] = csv_text(s.experiment.with_(outputs=kept, meta={}))
    return [str(f) for f in write_files(files, force)]


def export_command(fit_json: SavedModel, path: Target, to: Form = None, effects_from: opt.EffectsFrom = None,
                   force: opt.Force = False) -> None:
    """Take a fitted model along: as CasADi functions, as C source, as JSON.

    Example: motorid export fit.json --to c motor.c"""
    if to is not None:
        among(to, FORMS.values(), "form", where="--to: ")
    model = opt.saved_model(fit_json, effects_from)
    written, noisy = export(model, path, to, force=force), b"Fits records that are mostly noise" in read_bytes(fit_json)
    show(f"Written: {written}", sentence(MOSTLY_NOISE) if noisy else None,
         f"Sub-steps: {check(model).text}" if written.suffix == ".c" else None)


@opt.with_options(opt.FitOptions)
def identifiability_command(runs: opt.Runs, options: opt.FitOptions, json: opt.Json = None,
                            report: opt.Report = None) -> None:
    """Say which parameters, and which combinations of them, the records determine.

    Example: motorid identifiability run*.csv --effects coulomb"""
    fitted = options.fit(options.read(runs))
    found = identifiability(fitted)
    _give(found, json, options.force)
    save_report([fitted, found], report, force=options.force, quiet=json == "-")


@opt.with_options(opt.FitOptions)
def robustness_command(runs: opt.Runs, options: opt.FitOptions, starts: Starts = 100, spread: Spread = 10.0,
                       seed: Seed = 0, json: opt.Json = None, report: opt.Report = None) -> None:
    """Fit from many poor starts, and say whether all end in the same place.

    Example: motorid robustness run*.csv --starts 50 --spread 10"""
    fitted = options.fit(options.read(runs))
    found = multistart(fitted, starts=starts, spread=spread, seed=seed)
    _give(found, json, options.force)
    save_report([fitted, found], report, force=options.force, quiet=json == "-")
    if found.interrupted:
        raise typer.Exit(INTERRUPTED)


def _give(found: Batch | Identifiability | Multistart, json: opt.Json, force: bool) -> None:
    show(str(found) if json != "-" else None)
    if json:
        write_json(found.to_dict(), json, force)

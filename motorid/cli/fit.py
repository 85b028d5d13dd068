"""The commands `fit`, `simulate` and `demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motorid.cli.console import FAILED, save_report, say_notes, show
from motorid.cli.options import (
    Choices,
    Json,
    Reading,
    Report,
    Runs,
    Validate,
    describe,
    notes_of,
    with_choices,
)
from motorid.display.numbers import duration
from motorid.display.tables import constraint_table, derived_table, error_table, parameter_table, run_table
from motorid.errors import DataError
from motorid.estimation.result import Fit
from motorid.exporters.json_file import constraint_violations, fit_dict, remarks, run_dict, write_json
from motorid.problem.simulate import Evaluation, evaluate
from motorid.records.experiment import Experiment
from motorid.uncertainty.covariance import deviations

GOOD = ("converged", "limit", "stalled")


@with_choices(Choices)
def fit(
    runs: Runs, choices: Choices, validate: Validate = None, json: Json = None, report: Report = None,
) -> None:
    """Fit a motor model to records, and say how far the numbers can be trusted.

    Example: motorid fit run*.csv --effects coulomb --validate check*.csv --json fit.json
    """
    records = choices.read(runs)
    held_out = choices.read(validate) if validate else []
    model = choices.model(records)
    notes = notes_of(records, held_out)
    found = choices.fit(records, model)
    judged = evaluate(found, held_out) if held_out else None
    if json:
        write_json(fit_dict(found, judged) | {"notes": notes}, json)
    if json != "-":
        show_fit(found, records, notes, judged)
    save_report(found, report, held_out)
    if found.status == "failed":
        raise typer.Exit(FAILED)


@with_choices(Reading)
def simulate(
    fit_json: Annotated[Path, typer.Argument(metavar="FIT.json", help="What fit --json or export wrote.")],
    runs: Runs,
    choices: Reading,
    out: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Write the simulated channels as CSV.")] = None,
    engine: Annotated[str, typer.Option(metavar="rosenbrock|cvodes|idas")] = "rosenbrock",
    effects_from: Annotated[Path | None, typer.Option(metavar="FILE.py",
                                                      help="Effects of your own.")] = None,
    json: Json = None,
) -> None:
    """Simulate a fitted model on records, and compare where something was measured.

    Example: motorid simulate fit.json check*.csv --out simulated
    """
    from motorid.cli.options import model_of

    model = model_of(fit_json, effects_from)
    records = choices.read(runs)
    judged = evaluate(model, records, engine=engine)
    files = _write_simulations(judged, out) if out else []
    if json:
        pairs = zip(records, judged.by_run, strict=True)
        write_json({"model": {"base": model.base, "axis": model.axis, "effects": list(model.effect_names)},
                    "nrmse": judged.nrmse, "rmse": judged.rmse, "files": files,
                    "runs": [run_dict(r) | {"nrmse": e} for r, e in pairs]}, json)
    if json != "-":
        show(f"{describe(model)}, values of {fit_json}", run_table(judged))
        show(*(f"Written: {f}" for f in files))


def demo(
    out: Annotated[Path, typer.Option(
        metavar="DIR", help="Where figures and report go.")] = Path("motorid-demo"),
    json: Json = None,
) -> None:
    """Show the story on shipped records: fit, see that it fails, add what is missing, see the error fall.

    Example: motorid demo --out demo
    """
    from motorid.cli.cli_demo import tell

    told = tell(out)
    if json:
        write_json(told, json)


def show_fit(
    found: Fit, records: list[Experiment], notes: list[str], judged: Evaluation | None = None,
) -> None:
    """Print a fit: remarks, parameters, errors, what follows from them, and how it ended."""
    show(f"{describe(found.problem.model)}, {_amount(records)}\n")
    say_notes(notes, "About the records")
    show(parameter_table(found, deviations(found)))
    say_notes(remarks(found), "What these records cannot tell")
    several = judged is not None and len(judged.simulations) > 1
    show(error_table(found, judged), run_table(found.evaluation) if len(records) > 1 else None,
         run_table(judged, "Held-out NRMSE run by run") if judged and several else None,
         derived_table(found))
    show(constraint_table(found, constraint_violations(found)))
    engine = found.problem.engine
    message = found.message.removeprefix(f"{found.status}: ")
    show(f"{found.status}: {message}\n{found.iterations} iterations, {duration(found.seconds)}, engine "
         f"{engine if isinstance(engine, str) else engine.name}, formulation {found.formulation}")


def _amount(records: list[Experiment]) -> str:
    samples, seconds = sum(r.n for r in records), sum(r.duration for r in records)
    runs = "1 run" if len(records) == 1 else f"{len(records)} runs"
    return f"{runs}, {samples} samples, {duration(seconds)}"


def _write_simulations(judged: Evaluation, out: Path) -> list[str]:
    from motorid.records.reading import write_csv

    files = []
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot write to {out}: {error.strerror or error}.") from None
    for s in judged.simulations:
        path = out / f"{s.experiment.name.replace('/', '_')}_simulated.csv"
        kept = {c: s.outputs[c] for c in s.experiment.channels if c in s.outputs}
        files.append(str(write_csv(s.experiment.with_(outputs=kept, meta={}), path)))
    return files

"""Sections of a report, each with its text, figures and tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from motorid.channels import NAMES
from motorid.diagnosis.results import Diagnosis, Ladder, ladder_table, ranking_table, share_table
from motorid.display.cards import Shown, Table
from motorid.display.numbers import counted, duration, number, percent, sentence
from motorid.estimation.result import Fit, ended, parameter_table, value_tables
from motorid.numerics.parallel import progress
from motorid.problem.simulate import error_table, evaluate
from motorid.records.checks import check_runs, reading_notes
from motorid.records.experiment import Experiment


@dataclass(frozen=True)
class Figure:
    """An inline figure with what it shows in words; `small` ones need not fill the page."""

    svg: str
    caption: str
    small: bool = False


@dataclass
class Section:
    """One part of the page."""

    key: str
    title: str
    text: Sequence[str] = ()
    remarks: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    code: str = ""


def data(runs: Sequence[Experiment]) -> Section:
    """The records and what the checks say of them."""
    rows = [[r.name, str(r.n), duration(r.duration), f"{number(1e3 * r.dt, 3)} ms",
             ", ".join(NAMES[c] for c in r.channels)] for r in runs]
    remarks = [*check_runs(runs), *reading_notes(runs)]
    checked = "What the checks found:" if remarks else "The checks found no problem."
    figure = _figure("data", "Input and measured channels over time.",
                     f"Records {', '.join(r.name for r in runs)} over time", "plot_runs", runs)
    table = Table(["record", "samples", "duration", "interval", "measured"], rows)
    return Section("data", "The data", [f"{counted(len(runs), 'record')}. {checked}"], remarks, [figure], [table])


def fitted(fit: Fit, title: str, *, key: str = "fit", before: Fit | None = None, values: bool = True,
           told: bool = True, drawn: bool = True) -> Section:
    """A fit: its verdict (`told`), curves (`drawn`), errors, its `values`; beside it the model `before`."""
    caption = "Measured, model, and residual beside the band of the noise."
    caption += " The thin curve is the original model." if before is not None else ""
    alt = f"Measured and modelled channels of {fit.model.title}, with residuals. " + f"NRMSE: {fit.evaluation.words}."
    text = [f"{fit.model.title}. {fit.verdict} {ended(fit)}"] if told else []
    figures = [_figure(key, caption, alt, "plot_fit", fit, before=before)] if drawn else []
    tables = [*(value_tables(fit) if values else ()), error_table({"": fit.evaluation}, fit.noise)]
    return Section(key, title, text, (), figures, tables)


def residuals(fit: Fit) -> Section:
    """What the fit leaves over."""
    caption = "Noise alone would leave means of zero against every quantity and no correlation in time."
    figure = _figure("residuals", caption, "Residuals over time and against speed and current", "plot_residuals", fit)
    return Section("residuals", "Residuals", (), (), [figure])


def held_out(fit: Fit, validate: Sequence[Experiment]) -> Section:
    """The model on records that it was not fitted to."""
    judged = evaluate(fit, validate)
    figure = _figure("held-out", "Records that the fit never saw.", f"Measured and modelled. NRMSE: {judged.words}.",
                     "plot_fit", judged)
    return Section("held-out", "Held-out records", (), (), [figure], [error_table({"": judged})])


def answer(d: Diagnosis) -> Section:
    """What was found: the missing torque or voltage with what was added, errors before and after, the next step."""
    caption = ("What the model lacks (dots, mean with 95 %), and what was added: the effect with the shift of the "
               "parameters (dashed).") if d.after is not d.before else "What the model lacks: dots, mean with 95 %."
    drawn = [] if d.verdict == "adequate" or d.where == "sensor" else [
        _figure("answer", caption, d.answer or d.text, "plot_answer", d, small=True)]
    next_step = [f"Next experiment: {d.suggestion}"] if d.suggestion else []
    return Section("answer", "The answer", next_step, (), drawn, [ladder_table(d.ladder)])


def where(d: Diagnosis) -> Section:
    """Where the model fails: the missing voltage and torque."""
    m = d.missing
    best = [f"{balance}: {b.against} explains {percent(b.explained, 2)}"
            for balance, bins in m.bins.items() for b in bins[:1]]
    caption = "The voltage and torque that would make the model match, and what explains them."
    figure = _figure("missing", caption, "Missing voltage and torque. " + "; ".join(best), "plot_missing", d)
    tables = [share_table("region", m.regions)] if m.regions else []
    return Section("where", "Where it fails", [d.adequacy.text, m.text], (), [figure], tables)


def which(d: Diagnosis) -> Section:
    """The effects that may be missing, ranked."""
    alt = "Bars of the squared error that each effect would remove; best: " + ", ".join(c.effect for c in d.ranking[:3])
    caption = "Outline: predicted from sensitivities. Bar: refitted. Diamond: fall of the held-out error."
    figure = _figure("ranking", caption, alt, "plot_ranking", d, small=True)
    return Section("which", "Which effect is missing", (), (), [figure], [ranking_table(d.ranking)])


def ladder(steps: Ladder) -> Section:
    """The error of each model of a ladder."""
    caption = "Error of each model, on the records of the fit and on those it never saw."
    figure = _figure("ladder", caption, "Error of each model in turn", "plot_ladder", steps, small=True)
    return Section("ladder", "The error falls", [sentence(steps.text)], (), [figure], [ladder_table(steps)])


def parameters(before: Fit, after: Fit) -> Section:
    """The parameters before and after."""
    table = parameter_table(after, before)
    figure = _figure("parameters", "Bars: two standard deviations.", "Parameters before and after", "plot_parameters",
                     before, after, small=len(table.rows) <= 6)
    return Section("parameters", "How the parameters moved", (), (), [figure], [table])


def of_card(result: Shown, k: int) -> Section:
    """A result that has no section of its own, from its card."""
    card = result.card()
    figures = [_figure(f"result-{k + 1}", "", card.title, card.figure, result, small=True)] if card.figure else []
    return Section(f"result-{k + 1}", card.title, [t for t in card.text if t], (), figures, card.tables)


def _figure(name: str, caption: str, alt: str, draw: str, *args: Any, small: bool = False, **options: Any) -> Figure:
    """Draw with the function `draw` of `motorid.plots`, which is loaded here for the first time."""
    from motorid import plots
    from motorid.plots.style import svg_of

    with progress(f"Writing the report: figure {name}"):
        return Figure(svg_of(getattr(plots, draw), *args, name=name, alt=alt, **options), caption, small)


def error_facts(steps: Ladder) -> list[tuple[str, str]]:
    """Return how the error of each channel fell: held out where it was, else as fitted."""
    first, last = steps.rungs[0], steps.rungs[-1]
    kind, old, new = "fitted", first.nrmse, last.nrmse
    if first.validation_nrmse and last.validation_nrmse:
        kind, old, new = "held out", first.validation_nrmse, last.validation_nrmse
    arrow = [f"{percent(e)} → {percent(new[c])}" if last is not first else percent(e) for c, e in old.items()]
    return [(f"Error of the {NAMES[c]}, {kind}", text) for c, text in zip(old, arrow, strict=True)]

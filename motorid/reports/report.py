"""One self-contained page that tells the story of a result: `report`; its sections with text, figures and tables."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from motorid.channels import channel_name
from motorid.diagnosis.results import Diagnosis, Ladder, ladder_table, ranking_table, share_table
from motorid.display.cards import Flag, Shown, Table
from motorid.display.numbers import counted, duration, glued, number, percent, sentence, with_error
from motorid.errors import UsageError, printable
from motorid.estimation.least_squares import FAILURES
from motorid.estimation.result import Fit, ended, parameter_table, value_tables
from motorid.numerics.parallel import progress
from motorid.problem.simulate import error_table, evaluate
from motorid.records.checks import check_runs, reading_notes
from motorid.records.experiment import Experiment, units_of
from motorid.records.files import package_version, write_files

PACKAGES = ("motorid", "casadi", "numpy", "scipy", "pandas", "matplotlib")
LEFT_OUT = "{} is left out, because it could not be made: {}"


def report(result: Any, path: str | Path, *, title: str = "", command: str = "",
           validate: Sequence[Any] | Experiment = (), force: bool = False) -> Path:
    """Write the story of a result as one HTML page, no network, no script, figures inside; return its path.

    The answer first, with its figure, the errors before and after and the next step; then parameters, fits, held-out
    records, where the model fails, the effects tried, the data and their checks, and the provenance. A fit
    alone gives its part of the story; several results, in a list, follow one another.

    Parameters
    ----------
    result : Fit, Diagnosis, Ladder, any other result, or a sequence of them
    path : str or Path
        File to write; its folder is made where there is none.
    title : str, optional
    command : str, optional
        The command or code that made it, for the last section.
    validate : Experiment or sequence of them, optional
        Records that the fit never saw, to judge it on.
    force : bool
        Also over a file that motorid did not write.

    Raises
    ------
    UsageError, OutputError
        If there is nothing to tell, or the file must not or cannot be written there.

    Examples
    --------
    >>> path = mi.report(found, "motor.html")
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    if not (results := list(result) if isinstance(result, list | tuple) else [result]):
        raise UsageError("report needs a result: mi.report(mi.diagnose(fit), 'report.html').")
    for r in results:
        if not isinstance(r, Shown):
            raise UsageError(f"report takes results of motorid, such as a fit or a diagnosis; got {type(r).__name__}.")
    check = [validate] if isinstance(validate, Experiment) else list(validate)
    story = tell(results, title=title, validate=check)
    story.sections.append(_provenance(story, command, check))
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"a report is an HTML page: '{Path(path).name}' must end in .html (a browser prints it).")
    environment = Environment(loader=PackageLoader("motorid.reports", "templates"), autoescape=True,
                              undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["glued"] = glued
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    page = environment.get_template("report.html").render(story=story, version=package_version("motorid"), date=date)
    # Control characters in names of files are not HTML.
    return write_files({Path(path): printable(page)}, force)[0]


def _provenance(story: "Story", command: str, held_out: Sequence[Experiment]) -> "Section":
    files = [[run.name + more, Path(str(run.meta.get("source", "–"))).name, str(run.meta.get("sha256", "–"))[:16]]
             for more, runs in (("", story.runs), (" (held out)", held_out)) for run in runs]
    versions = ", ".join([f"Python {platform.python_version()}", *(f"{p} {package_version(p)}" for p in PACKAGES)])
    tables = [Table(["run", "file", "SHA-256 (first 16 digits)"], files)] if files else []
    traced = ["The files are named by the fingerprint of their contents: the page can be traced to them."] * bool(files)
    return Section("provenance", "Provenance", [*traced, f"Made with {versions}."], tables=tables, code=command)


@dataclass
class Story:
    """The page: head, key facts, sections, and the records it rests on."""

    title: str
    lead: str = ""
    flags: Sequence[Flag] = ()
    facts: Sequence[tuple[str, str]] = ()
    sections: "list[Section]" = field(default_factory=list)
    runs: Sequence[Experiment] = ()


def tell(results: Sequence[Shown], *, title: str = "", validate: Sequence[Experiment] = ()) -> Story:
    """Return the story of `results`, told from the richest of them on."""
    main = next((r for kind in (Diagnosis, Ladder, Fit) for r in results if isinstance(r, kind)), results[0])
    if isinstance(main, Diagnosis):
        story = _of_diagnosis(main, validate)
    elif isinstance(main, Ladder):
        story = _of_ladder(main)
    elif isinstance(main, Fit):
        story = _of_fit(main, validate)
    else:
        card = main.card()
        story = Story(card.title, " ".join(card.text[:1]), card.flags, sections=[_of_card(main, 0)])
    for k, r in enumerate(results):
        if r is not main:
            again = _fitted(r, r.card().title, key=f"result-{k + 1}") if isinstance(r, Fit) else None
            story.sections.append(again or _of_card(r, k))
    story.title = title or story.title
    said = story.lead
    for s in story.sections:  # a note is said where it is first needed
        s.tables = [replace(t, note="") if t.note in said else t for t in s.tables]
        said += "".join(t.note for t in s.tables)
    return story


def _of_diagnosis(d: Diagnosis, validate: Sequence[Experiment]) -> Story:
    runs = d.before.problem.experiments
    story = Story("What is missing in the motor's model?", d.answer or d.text, (), _error_facts(d.ladder),
                  [_answer(d)], runs)
    if d.details:
        story.sections.append(Section("details", "Details", (), d.details))
    if len(d.ladder.rungs) > 1:
        story.sections += [_parameters(d.before, d.after),
                           _fitted(d.after, "The improved model", key="after", before=d.before, values=False)]
    if validate:
        story.sections.append(_held_out(d.after, validate))
    same = d.after is d.before  # else the improved model's figure shows the original one, too
    story.sections += [_fitted(d.before, "The original model", values=same, drawn=same), _where(d)]
    if d.ranking:
        story.sections.append(_which(d))
    if len(d.ladder.rungs) > 2:
        story.sections.append(_steps(d.ladder))
    story.sections.append(_data(runs))
    return story


def _of_ladder(ladder: Ladder) -> Story:
    first, best = ladder.rungs[0].fit, ladder.best
    told = [_data(first.problem.experiments), _steps(ladder), _parameters(first, best),
            _fitted(best, "The last model", before=first if best is not first else None)]
    return Story("Models of growing detail", ladder.text, (), _error_facts(ladder), told, first.problem.experiments)


def _of_fit(fit: Fit, validate: Sequence[Experiment]) -> Story:
    card, runs = fit.card(), fit.problem.experiments
    facts = [(f"Error of the {channel_name(c, runs[0].units.get(c, ''))}", percent(e)) for c, e in fit.nrmse.items()]
    known = [fit.determined[n] for n in ("gain", "time_constant") if n in fit.determined]
    facts += [(q.text.capitalize(), with_error(q.value, q.std, q.unit)) for q in known]
    figure = _figure("residuals", "Noise alone would leave means of zero against every quantity and no correlation in "
                     "time.", "Residuals over time and against speed and current", "plot_residuals", fit)
    told = [_fitted(fit, "The fit", told=False), *([_held_out(fit, validate)] if validate else []),
            Section("residuals", "Residuals", (), (), [figure]), _data(runs)]
    return Story(card.title, " ".join(t for t in card.text if t), card.flags[1:], facts, told, runs)


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


def _data(runs: Sequence[Experiment]) -> Section:
    """The records and what the checks say of them."""
    rows = [[r.name, str(r.n), duration(r.duration), f"{number(1e3 * r.dt, 3)} ms",
             ", ".join(channel_name(c, r.units[c]) for c in r.channels)] for r in runs]
    remarks = [*check_runs(runs), *reading_notes(runs)]
    checked = "What the checks found:" if remarks else "The checks found no problem."
    figure = _figure("data", "Input and measured channels over time.",
                     f"Records {', '.join(r.name for r in runs)} over time", "plot_runs", runs)
    table = Table(["record", "samples", "duration", "interval", "measured"], rows)
    return Section("data", "The data", [f"{counted(len(runs), 'record')}. {checked}"], remarks, [figure], [table])


def _fitted(fit: Fit, title: str, *, key: str = "fit", before: Fit | None = None, values: bool = True,
           told: bool = True, drawn: bool = True) -> Section:
    """A fit: its verdict (`told`), curves (`drawn`), errors, its `values`; beside it the model `before`."""
    caption = "Measured, model, and residual beside the band of the noise."
    caption += " The thin curve is the original model." if before is not None else ""
    alt = f"Measured and modelled channels of {fit.model.title}, with residuals. " + f"NRMSE: {fit.evaluation.words}."
    figures = [_figure(key, caption, alt, "plot_fit", fit, before=before)] if drawn else []
    tables = [*(value_tables(fit) if values else ()), error_table({"": fit.evaluation}, fit.noise)]
    return Section(key, title, [f"{fit.model.title}. {fit.verdict} {ended(fit)}"] if told else [], (), figures, tables)


def _held_out(fit: Fit, validate: Sequence[Experiment]) -> Section:
    """The model on records that it was not fitted to."""
    try:
        judged = evaluate(fit, validate)
    except FAILURES as error:
        return Section("held-out", "Held-out records", [LEFT_OUT.format("The comparison", error)])
    figure = _figure("held-out", "Records that the fit never saw.", f"Measured and modelled. NRMSE: {judged.words}.",
                     "plot_fit", judged)
    return Section("held-out", "Held-out records", (), (), [figure], [error_table({"": judged})])


def _answer(d: Diagnosis) -> Section:
    """What was found: the missing torque or voltage with what was added, errors before and after, the next step."""
    caption = "What the model lacks: dots, mean with 95 %; dashed, if any: what was added, with the parameters' shift."
    drawn = [] if d.verdict == "adequate" or d.where == "sensor" else [
        _figure("answer", caption, d.answer or d.text, "plot_answer", d, small=True)]
    next_step = [f"Next experiment: {d.suggestion}"] if d.suggestion else []
    return Section("answer", "The answer", next_step, (), drawn, [ladder_table(d.ladder)])


def _where(d: Diagnosis) -> Section:
    """Where the model fails: the missing voltage and torque."""
    m = d.missing
    best = [f"{balance}: {b.against} explains {percent(b.explained, 2)}"
            for balance, bins in m.bins.items() for b in bins[:1]]
    caption = f"The {' and '.join(m.bins)} that would make the model match, with its explanation."
    figure = _figure("missing", caption, "What is missing. " + "; ".join(best), "plot_missing", d)
    tables = [share_table("region", m.regions)] if m.regions else []
    return Section("where", "Where it fails", (d.adequacy.text, m.text), (), [figure], tables)


def _which(d: Diagnosis) -> Section:
    """The effects that may be missing, ranked."""
    alt = "Bars of the squared error that each effect would remove; best: " + ", ".join(c.effect for c in d.ranking[:3])
    caption = "Outline: predicted from sensitivities. Bar: refitted. Diamond: fall of the held-out error."
    figure = _figure("ranking", caption, alt, "plot_ranking", d, small=True)
    return Section("which", "Which effect is missing", (), (), [figure], [ranking_table(d.ranking)])


def _steps(steps: Ladder) -> Section:
    """The error of each model of a ladder."""
    caption = "Error of each model, on the records of the fit and on those it never saw."
    figure = _figure("ladder", caption, "Error of each model in turn", "plot_ladder", steps, small=True)
    return Section("ladder", "The error falls", [sentence(steps.text)], (), [figure], [ladder_table(steps)])


def _parameters(before: Fit, after: Fit) -> Section:
    """The parameters before and after."""
    table = parameter_table(after, before)
    figure = _figure("parameters", "Bars: two standard deviations.", "Parameters before and after", "plot_parameters",
                     before, after, small=len(table.rows) <= 6)
    return Section("parameters", "How the parameters moved", (), (), [figure], [table])


def _of_card(result: Shown, k: int) -> Section:
    """A result that has no section of its own, from its card."""
    card = result.card()
    figures = [_figure(f"result-{k + 1}", "", card.title, card.figure, result, small=True)] if card.figure else []
    return Section(f"result-{k + 1}", card.title, [t for t in card.text if t], (), figures, card.tables)


def _figure(name: str, caption: str, alt: str, draw: str, *args: Any, small: bool = False, **options: Any) -> Figure:
    """Draw with the function `draw` of `motorid.plots`, which is loaded here for the first time."""
    from motorid import plots
    from motorid.plots.style import svg_of

    try:
        with progress(f"Writing the report: figure {name}"):
            return Figure(svg_of(getattr(plots, draw), *args, name=name, alt=alt, **options), caption, small)
    except FAILURES as error:
        return Figure("", LEFT_OUT.format("This figure", error), small)


def _error_facts(steps: Ladder) -> list[tuple[str, str]]:
    """Return how the error of each channel fell: held out where it was, else as fitted."""
    first, last = steps.rungs[0], steps.rungs[-1]
    kind, old, new = "fitted", first.nrmse, last.nrmse
    if first.validation_nrmse and last.validation_nrmse:
        kind, old, new = "held out", first.validation_nrmse, last.validation_nrmse
    arrow = [f"{percent(e)} → {percent(new[c])}" if last is not first else percent(e) for c, e in old.items()]
    names = [channel_name(c, units_of(last.fit.problem.experiments)[c]) for c in old]
    return [(f"Error of the {name}, {kind}", text) for name, text in zip(names, arrow, strict=True)]

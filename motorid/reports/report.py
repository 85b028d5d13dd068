"""One self-contained page that tells the story of a result: `report`."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from motorid.channels import NAMES
from motorid.diagnosis.results import Diagnosis, Ladder
from motorid.display.cards import Flag, Shown, Table
from motorid.display.numbers import glued, percent, with_error
from motorid.errors import UsageError, printable
from motorid.estimation.result import Fit
from motorid.records.experiment import Experiment
from motorid.records.files import package_version, write_files
from motorid.reports import sections
from motorid.reports.sections import Section

PACKAGES = ("motorid", "casadi", "numpy", "scipy", "pandas", "matplotlib")


def report(result: Any, path: str | Path, *, title: str = "", command: str = "",
           validate: Sequence[Any] | Experiment = (), force: bool = False) -> Path:
    """Write the story of a result as one HTML page: no network, no script, figures inside.

    The answer first, with its figure, the errors before and after and the next step; then parameters, fits, held-out
    records, where the model fails, the effects tried, the data and their checks, and the provenance. A fit
    alone gives its part of the story; several results, in a list, follow one another.

    Parameters
    ----------
    result : Fit, Diagnosis, Ladder, any other result, or a sequence of them
    path : str or Path
        File to write; its folder must exist.
    title : str, optional
    command : str, optional
        The command or code that made it, for the last section.
    validate : Experiment or sequence of them, optional
        Records that the fit never saw, to judge it on.
    force : bool
        Also over a file that motorid did not write.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    UsageError
        If there is nothing to tell, or the file must not or cannot be written there.
    OutputError
        If the disk refuses.

    Examples
    --------
    >>> path = mi.report(found, "motor.html")
    """
    results = list(result) if isinstance(result, list | tuple) else [result]
    if not results:
        raise UsageError("report needs a result: mi.report(mi.diagnose(fit), 'report.html').")
    for r in results:
        if not isinstance(r, Shown):
            raise UsageError(f"report takes results of motorid, such as a fit or a diagnosis; got {type(r).__name__}.")
    check = [validate] if isinstance(validate, Experiment) else list(validate)
    story = tell(results, title=title, validate=check)
    story.sections.append(_provenance(story, command, check))
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"a report is an HTML page: '{Path(path).name}' must end in .html (a browser prints it).")
    return write_files({Path(path): _page(story)}, force)[0]


def _page(story: Story) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("motorid.reports", "templates"), autoescape=True,
                              undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["glued"] = glued
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    page = environment.get_template("report.html").render(story=story, version=package_version("motorid"), date=date)
    return printable(page)  # control characters in names of files are not HTML


def _provenance(story: Story, command: str, held_out: Sequence[Experiment]) -> Section:
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
    sections: list[Section] = field(default_factory=list)
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
        story = Story(card.title, " ".join(card.text[:1]), card.flags, sections=[sections.of_card(main, 0)])
    for k, r in enumerate(results):
        if r is not main:
            again = sections.fitted(r, r.card().title, key=f"result-{k + 1}") if isinstance(r, Fit) else None
            story.sections.append(again or sections.of_card(r, k))
    story.title = title or story.title
    said = story.lead
    for s in story.sections:  # a note is said where it is first needed
        s.tables = [replace(t, note="") if t.note in said else t for t in s.tables]
        said += "".join(t.note for t in s.tables)
    return story


def _of_diagnosis(d: Diagnosis, validate: Sequence[Experiment]) -> Story:
    runs = d.before.problem.experiments
    story = Story("What is missing in the motor's model?", d.answer or d.text, (), sections.error_facts(d.ladder),
                  [sections.answer(d)], runs)
    if d.details:
        story.sections.append(Section("details", "Details", (), d.details))
    if len(d.ladder.rungs) > 1:
        story.sections += [sections.parameters(d.before, d.after),
                           sections.fitted(d.after, "The improved model", key="after", before=d.before, values=False)]
    if validate:
        story.sections.append(sections.held_out(d.after, validate))
    same = d.after is d.before  # else the improved model's figure shows the original one, too
    story.sections += [sections.fitted(d.before, "The original model", values=same, drawn=same), sections.where(d)]
    if d.ranking:
        story.sections.append(sections.which(d))
    if len(d.ladder.rungs) > 2:
        story.sections.append(sections.ladder(d.ladder))
    story.sections.append(sections.data(runs))
    return story


def _of_ladder(ladder: Ladder) -> Story:
    first, best = ladder.rungs[0].fit, ladder.best
    told = [sections.data(first.problem.experiments), sections.ladder(ladder), sections.parameters(first, best),
            sections.fitted(best, "The last model", before=first if best is not first else None)]
    return Story("Models of growing detail", ladder.text, (), sections.error_facts(ladder), told,
                 first.problem.experiments)


def _of_fit(fit: Fit, validate: Sequence[Experiment]) -> Story:
    card, runs = fit.card(), fit.problem.experiments
    facts = [(f"Error of the {NAMES[c]}", percent(e)) for c, e in fit.nrmse.items()]
    known = [fit.determined[n] for n in ("gain", "time_constant") if n in fit.determined]
    facts += [(q.text.capitalize(), with_error(q.value, q.std, q.unit)) for q in known]
    told = [sections.fitted(fit, "The fit", told=False), *([sections.held_out(fit, validate)] if validate else []),
            sections.residuals(fit), sections.data(runs)]
    return Story(card.title, " ".join(t for t in card.text if t), card.flags[1:], facts, told, runs)

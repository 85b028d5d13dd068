"""One self-contained page that tells the story of a result: `report`."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from datetime import datetime
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from motorid.display.cards import Table
from motorid.errors import UsageError
from motorid.reports._story import Section, Story, tell

__all__ = ["report"]

PACKAGES = ("motorid", "casadi", "numpy", "scipy", "pandas", "matplotlib")


def report(result: Any, path: str | Path, *, title: str = "", command: str = "", validate: Sequence[Any] = ()) -> Path:
    """Write the story of a result as one HTML page: no network, no script, figures inside.

    Data and their checks, the fit, where it fails, which effect is missing, the ladder, parameters before and
    after, what cannot be told apart and the next experiment, and where it all comes from. A fit alone gives
    its part of the story; several results, in a list, follow one another.

    Parameters
    ----------
    result : Fit, Diagnosis, Ladder, any other result, or a sequence of them
    path : str or Path
        File to write; its folder must exist.
    title : str, optional
    command : str, optional
        The command or code that made it, for the last section.
    validate : sequence of Experiment, optional
        Records that the fit never saw, to judge it on.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    UsageError
        If there is nothing to tell, or the file cannot be written.
    """
    results = list(result) if isinstance(result, list | tuple) else [result]
    if not results:
        raise UsageError("report needs a result: mi.report(mi.diagnose(fit), 'report.html').")
    story = tell(results, title=title, validate=list(validate))
    story.sections.append(_provenance(story, command))
    target = Path(path)
    try:
        target.write_text(_page(story), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"the report cannot be written to '{target}': {error.strerror}.") from None
    return target


def _page(story: Story) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("motorid.reports", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    date = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    return environment.get_template("report.html").render(story=story, version=_version("motorid"), date=date)


def _provenance(story: Story, command: str) -> Section:
    files = [
        [run.name, Path(str(run.meta.get("source", "–"))).name, str(run.meta.get("sha256", "–"))[:16]]
        for run in story.runs
    ]
    versions = [["Python", platform.python_version()], *([p, _version(p)] for p in PACKAGES)]
    tables = [Table(["software", "version"], versions)]
    if files:
        tables.insert(0, Table(["run", "file", "SHA-256 (first 16 digits)"], files))
    return Section(
        "provenance",
        "Where it comes from",
        ["The files are named by the fingerprint of their contents: the page can be traced to them."] * bool(files),
        tables=tables,
        code=command,
    )


def _version(package: str) -> str:
    try:
        return version_of(package)
    except PackageNotFoundError:
        return "unknown"

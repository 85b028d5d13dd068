"""The story that `motorid demo` tells on shipped records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motorid.cli.console import show
from motorid.diagnosis.diagnose import diagnose
from motorid.diagnosis.results import Diagnosis
from motorid.display.tables import comparison_table, error_table, ladder_table, parameter_table, ranking_table
from motorid.errors import UsageError
from motorid.estimation.fit import fit
from motorid.model.model import dc_motor
from motorid.numerics.parallel import progress
from motorid.records.reading import data_path, read_runs
from motorid.uncertainty.covariance import deviations

SET = "hidden_friction"


def tell(out: Path) -> dict[str, Any]:
    """Fit the plain motor, find what it lacks, add it; print it, save figures and the report.

    Returns
    -------
    dict
        The diagnosis as in ``diagnose --json``, and the files written.

    Raises
    ------
    UsageError
        If the folder cannot be written.
    """
    _make(out)
    runs, check = (read_runs(str(data_path(SET) / pattern)) for pattern in ("run*.csv", "check*.csv"))
    show(f"1. Records: {len(runs)} of a motor ({data_path(SET)}), and one held out that no fit will see.\n",
         "2. The textbook model, fitted without a first guess:")
    plain = fit(dc_motor(), runs)
    show(parameter_table(plain, deviations(plain)), error_table(plain),
         "   Its errors are far above the noise: something is missing.\n", "3. What?")
    with progress("Trying the effects of the library") as advance:
        found = diagnose(plain, check, progress=lambda _: advance(1))
    show(found.missing.text, ranking_table(found.ranking, 4), found.text, "",
         "4. Added, one line of code: fit.model + mi.effects." + (found.effects or ("…",))[0],
         ladder_table(found.ladder),
         comparison_table([("before", found.before), ("after", found.after)], std=deviations))
    files = _files(found, check, out)
    show("Written: " + ", ".join(files), "Now your own: motorid diagnose RUN... --report yours.html")
    return found.to_dict() | {"files": files}


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror or error}. Choose another folder: --out "
                         "DIR") from None


def _files(found: Diagnosis, check: Any, out: Path) -> list[str]:
    from motorid.plots import plot_fit, plot_ladder, plot_missing
    from motorid.reports.report import report

    drawn = {"fit.png": plot_fit(found.after, before=found.before).flat[0],
             "missing.png": plot_missing(found).flat[0], "ladder.png": plot_ladder(found)}
    for name, axes in drawn.items():
        axes.figure.savefig(out / name, dpi=120)
    page = report(found, out / "report.html", command=f"motorid demo --out {out}", validate=check)
    return [str(page), *(str(out / name) for name in drawn)]

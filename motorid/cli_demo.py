"""The story that `motorid demo` tells on shipped records."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from motorid import effects
from motorid.cli_common import show
from motorid.datasets import data_path
from motorid.errors import DataError
from motorid.fit import fit
from motorid.model import dc_motor
from motorid.reading import read_runs
from motorid.simulate import evaluate
from motorid.summary import fit_dict
from motorid.tables import comparison_table


def tell(out: Path) -> dict[str, Any]:
    """Fit the plain motor to `hidden_friction`, add Coulomb friction, show the error fall; return the figures."""
    runs = read_runs(str(data_path("hidden_friction") / "run*.csv"))
    check = read_runs(str(data_path("hidden_friction") / "check*.csv"))
    show(f"{len(runs)} records of a motor, and one held out. The textbook model first.\n")
    plain = fit(dc_motor(), runs)
    better = fit(plain.model + effects.coulomb, runs)
    judged = [evaluate(plain, check), evaluate(better, check)]
    show(comparison_table([("plain motor", plain), ("+ coulomb", better)], judged))
    show("The plain motor fails, on the records it was fitted to and on the one it never saw. One effect more, "
         f"Coulomb friction, and the held-out error of the speed falls from {100 * judged[0].nrmse['omega']:.1f} % "
         f"to {100 * judged[1].nrmse['omega']:.1f} %.")
    figure = _figure(plain, better, out)
    show(f"Figure: {figure}")
    return {"before": fit_dict(plain, judged[0]), "after": fit_dict(better, judged[1]), "figure": str(figure)}


def _figure(plain: Any, better: Any, out: Path) -> Path:
    from motorid.plots import plot_fit

    try:
        out.mkdir(parents=True, exist_ok=True)
        path = out / "fit.png"
        plot_fit(better, before=plain).flat[0].figure.savefig(path, dpi=120)
    except OSError as error:
        raise DataError(f"cannot write to {out}: {error.strerror or error}. Choose another folder: --out DIR") from None
    return path

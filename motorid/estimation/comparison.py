"""Several fits of the same records side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from motorid.display.display import Shown
from motorid.errors import UsageError
from motorid.estimation.fit import Fit
from motorid.problem.simulate import evaluate
from motorid.records.experiment import Experiment


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Fits side by side: errors on their records, held-out errors, how the parameters moved.

    Attributes
    ----------
    fits : tuple of Fit
    names : tuple of str
        ``base + effects`` of each.
    nrmse : tuple of dict of str to float
    validation_nrmse : tuple of (dict of str to float or None)
    parameters : dict of str to tuple of (value, std) or None
        Per parameter, one entry per fit; None where a model lacks it.
    """

    fits: tuple[Fit, ...]
    names: tuple[str, ...]
    nrmse: tuple[Mapping[str, float], ...]
    validation_nrmse: tuple[Mapping[str, float] | None, ...]
    parameters: Mapping[str, tuple[tuple[float, float | None] | None, ...]]


def compare(fits: Sequence[Fit], validate: Sequence[Experiment] | Experiment | None = None) -> Comparison:
    """Put fits side by side.

    Parameters
    ----------
    fits : sequence of Fit
    validate : Experiment or sequence of Experiment, optional
        Held-out runs to judge each fit on.

    Raises
    ------
    UsageError
        If no fit is given.
    """
    if not fits:
        raise UsageError("compare() takes a list of fits: mi.compare([fit, better]).")
    held = tuple(None if validate is None else dict(evaluate(f, validate).nrmse) for f in fits)
    names = list(dict.fromkeys(n for f in fits for n in f.values if n != "sgn_width"))
    parameters = {n: tuple((f.values[n], f.std[n]) if n in f.values else None for f in fits) for n in names}
    titles = tuple(" + ".join([f.problem.model.base, *f.problem.model.effect_names]) for f in fits)
    return Comparison(tuple(fits), titles, tuple(dict(f.nrmse) for f in fits), held, parameters)

"""Fits side by side: `compare`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from motorid.channels import channel_name
from motorid.display.cards import Card, Shown
from motorid.display.numbers import Std, counted, percent
from motorid.display.tables import Cell, Table
from motorid.errors import UsageError
from motorid.estimation.result import Fit, own_std, parameter_cell
from motorid.problem.simulate import evaluate
from motorid.records.experiment import Experiment, units_of


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

    def card(self) -> Card:
        """Return errors and parameters side by side."""
        return Card(f"Comparison of {counted(len(self.fits), 'fit')}",
                    tables=(comparison_table([(f.model.title, f) for f in self.fits], self.validation_nrmse),),
                    after=(("mi.plot_parameters(*comparison.fits)", "how the parameters moved"),))


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


def comparison_table(fits: Sequence[tuple[str, Fit]], held_out: Sequence[Mapping[str, float] | None] = (),
                     std: Callable[[Fit], Std] = own_std) -> Table:
    """Return fits side by side under their titles: NRMSE as fitted and `held_out`, parameters with their `std`."""
    units = units_of(run for _, f in fits for run in f.problem.experiments)
    channels = {c: channel_name(c, units.get(c, "")) for _, f in fits for c in f.nrmse}
    rows: list[Sequence[Cell]] = [[f"NRMSE {name}", *(percent(f.nrmse.get(c)) for _, f in fits)]
                              for c, name in channels.items()]
    if any(held_out):
        rows += [[f"held-out {name}", *(percent((e or {}).get(c)) for e in held_out)] for c, name in channels.items()]
    known = [std(f) for _, f in fits]
    names = dict.fromkeys(n for _, f in fits for n in f.values if n != "sgn_width")
    rows += [[n, *(parameter_cell(f, n, s) for (_, f), s in zip(fits, known, strict=True))] for n in names]
    return Table(["quantity", *(title for title, _ in fits)], rows)

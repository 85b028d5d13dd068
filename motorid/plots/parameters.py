"""How the parameters moved from fit to fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from motorid.errors import UsageError
from motorid.plots.style import CYCLE, MUTED, PALETTE, WIDTH, decade, grid, scaled_title, styled, tidy


@styled
def plot_parameters(
    *results: Any, truth: Mapping[str, float] | None = None, names: Sequence[str] | None = None
) -> np.ndarray:
    """Draw how the parameters moved from fit to fit, each with an interval of two standard deviations.

    Parameters
    ----------
    *results : Fit, Diagnosis or Ladder
        Fits of models with the same base; a diagnosis gives its fits before and after.
    truth : mapping of str to float, optional
        Known values, drawn as a line.
    names : sequence of str, optional
        Parameters to show; default: all that were estimated in some fit.

    Returns
    -------
    ndarray of Axes
        One per parameter.
    """
    fits = _fits(results)
    chosen = list(names or dict.fromkeys(n for f in fits for n, p in f.model.parameters.items() if p.vary))
    columns = {6: 3, 7: 4, 8: 4}.get(len(chosen), min(len(chosen), 5))
    rows = -(-len(chosen) // columns)
    axes = grid(rows, columns, row=1.75, width=WIDTH * max(columns, 3) / 5).ravel()
    for ax, name in zip(axes, chosen, strict=False):
        _one_parameter(ax, fits, name, (truth or {}).get(name))
    for ax in axes[len(chosen) :]:
        ax.set_axis_off()
    notes = [f"{k + 1}: {_added(f, fits[k - 1] if k else None)}" for k, f in enumerate(fits)]
    notes += ["dashed: true value"] * bool(truth) + ["bars: ±2σ"]
    axes[0].figure.supxlabel("   ·   ".join(notes), fontsize=8, color=MUTED)
    return axes[: len(chosen)]


def _one_parameter(ax: Axes, fits: Sequence[Any], name: str, truth: float | None) -> None:
    held = [k for k, f in enumerate(fits) if name in f.values]
    parameter = next((f.model.parameters[name] for f in reversed(fits) if name in f.values), None)
    unit = parameter.unit if parameter else ""
    if parameter is not None and parameter.periodic and truth is not None:  # the same angle, some turns further
        truth += 2 * np.pi * round((fits[held[-1]].values[name] - truth) / (2 * np.pi))
    values = np.array([fits[k].values[name] for k in held] + ([] if truth is None else [truth]))
    power = decade(float(np.max(np.abs(values))))
    if truth is not None:
        ax.axhline(truth / 10.0**power, color=PALETTE["green"], lw=1.2, ls=(0, (4, 2)))
    for k in held:
        value, std, colour = fits[k].values[name], fits[k].std.get(name), CYCLE[k % len(CYCLE)]
        ax.errorbar(
            k + 1,
            value / 10.0**power,
            yerr=2 * (std or 0.0) / 10.0**power,
            fmt="o",
            ms=5,
            capsize=3 if std else 0,
            lw=1.4,
            color=colour,
            mfc="none" if std is None else colour,
        )
        if std is None:
            ax.annotate(
                "not\ndetermined",
                (k + 1, value / 10.0**power),
                (0, 6),
                textcoords="offset points",
                ha="center",
                fontsize=7,
                color=MUTED,
            )
    ax.set_xlim(0.4, len(fits) + 0.6)
    ax.set_xticks(range(1, len(fits) + 1))
    _around(ax, values / 10.0**power)
    tidy(ax, title=scaled_title(name, unit, power))
    ax.grid(axis="x", visible=False)


def _around(ax: Axes, values: np.ndarray) -> None:
    """Keep a change of a thousandth from looking like a leap."""
    low, high = ax.get_ylim()
    least = 0.1 * float(np.max(np.abs(values))) or 1.0
    if high - low < least:
        middle = float(values.min() + values.max()) / 2
        ax.set_ylim(middle - least / 2, middle + least / 2)


def _added(fit: Any, previous: Any) -> str:
    names = fit.model.effect_names
    if previous is None:
        return " + ".join(["plain motor" if fit.model.base == "dc_motor" else "plain drive", *names])
    new = [n for n in names if n not in previous.model.effect_names]
    gone = [n for n in previous.model.effect_names if n not in names]
    changes = [f"+ {n}" for n in new] + [f"− {n}" for n in gone]
    again = {"penalty": "penalties", "hard": "hard constraints"}.get(fit.formulation, "again")
    return " ".join(changes) or again


def _fits(results: Sequence[Any]) -> list[Any]:
    fits: list[Any] = []
    for r in results:
        if isinstance(r, list | tuple):
            fits += _fits(r)
        elif hasattr(r, "before") and hasattr(r, "after"):
            fits += [r.before, r.after] if r.after is not r.before else [r.before]
        elif hasattr(r, "rungs"):
            fits += [rung.fit for rung in r.rungs]
        elif hasattr(r, "values") and hasattr(r, "std"):
            fits.append(r)
        else:
            raise UsageError(f"plot_parameters takes fits, a diagnosis or a ladder; got {type(r).__name__}.")
    if not fits:
        raise UsageError("plot_parameters needs at least one fit: mi.plot_parameters(fit, better).")
    return fits

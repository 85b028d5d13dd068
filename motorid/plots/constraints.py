"""Figures of constraints: the current against its limit, formulations side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from motorid.errors import UsageError, positive
from motorid.estimation.result import Fit
from motorid.estimation.shooting.formulations import Formulations
from motorid.plots import style
from motorid.problem.constraints import CurrentLimit
from motorid.problem.simulate import Simulation

NEAR = 0.5  # of the limit: what is worth a closer look


@style.styled
def plot_current_limit(*results: Fit | Formulations, limit: float | None = None,
                       labels: Sequence[str] | None = None) -> np.ndarray:
    """Draw the current of one or several fits against the limit, what lies above it shaded.

    Parameters
    ----------
    *results : Fit or Formulations
        Of the same records, e.g. plain, with penalties, with hard constraints.
    limit : float, optional
        In A; default: that of the first `CurrentLimit` found in the fits.
    labels : sequence of str, optional
        One per fit; default: its formulation.

    Returns
    -------
    ndarray of Axes, shape (fits, runs)
        At most three runs, each where the current comes near the limit.

    Examples
    --------
    >>> axes = mi.plot_current_limit(better, limit=8.0)
    """
    fits = [f for r in results for f in ([c.fit for c in r.all if c.fit] if isinstance(r, Formulations) else [r])]
    if not all(isinstance(f, Fit) for f in fits) or len({len(f.simulations) for f in fits}) != 1:
        raise UsageError("plot_current_limit takes fits of the same runs: mi.plot_current_limit(fit, hard, limit=8.0).")
    positive(limit=limit)
    relations = (c for f in fits for c in (*f.problem.constraints, *f.problem.penalties))
    limit = limit or next((c.limit for c in relations if isinstance(c, CurrentLimit)), None)
    if limit is None:
        raise UsageError("no CurrentLimit in these fits; say which one to draw: mi.plot_current_limit(fit, limit=8.0).")
    if not all("i" in s.outputs for f in fits for s in f.simulations):
        raise UsageError("these fits have no current: it was not measured, or the model has none.")
    words = labels or [f.formulation for f in fits]
    if len(words) != len(fits):
        raise UsageError(f"plot_current_limit takes one label per fit, {len(fits)} in all; got {len(words)}.")
    axes = style.grid(len(fits), min(len(fits[0].simulations), 3), row=1.5, sharex="col", sharey="row")
    for row, fit, word in zip(axes, fits, words, strict=True):
        for ax, s in zip(row, fit.simulations, strict=False):
            _against_limit(ax, s, limit)
        row[0].set(ylabel=f"{word}\n{style.axis_label('i')}")
    for k, (top, bottom) in enumerate(zip(axes[0], axes[-1], strict=True)):
        top.set(title=fits[0].simulations[k].experiment.name)
        bottom.set(xlabel="time (s)")
        _zoom(bottom, [f.simulations[k] for f in fits], limit)
    axes[0, 0].figure.align_ylabels(axes[:, 0])
    axes[0, 0].figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return axes


def _against_limit(ax: Axes, s: Simulation, limit: float) -> None:
    t, i = s.experiment.t, s.outputs["i"]
    if "i" in s.experiment.outputs:
        style.line(ax, t, s.experiment.outputs["i"], color=style.MEASURED, lw=3, alpha=0.5, label="measured")
    style.line(ax, t, i, color=style.MODEL, label="model")
    for side in (-limit, limit):
        if float(np.max(np.sign(side) * i)) > 0.5 * limit:
            ax.axhline(side, color=style.INK, lw=1.0, ls=(0, (4, 2)), label="limit" if side > 0 else None)
    ax.fill_between(t, np.clip(i, -limit, limit), i, color=style.PALETTE["orange"], alpha=0.6, lw=0, label="above it")
    beyond = float(np.max(np.abs(i)) - limit)
    words = f"{beyond:.2g} A above it" if beyond > 1e-6 * limit else "kept"
    ax.set_title(words, loc="right", fontsize=8, color=style.MUTED)


def _zoom(ax: Axes, simulations: Sequence[Simulation], limit: float) -> None:
    """Show the part of a record where the current comes near its limit, if that is a small part."""
    t = simulations[0].experiment.t
    near = np.max([np.abs(s.outputs["i"]) for s in simulations], axis=0) > NEAR * limit
    if not near.any():
        return
    first, last = t[near][0], t[near][-1]
    room = max(last - first, 10 * float(np.median(np.diff(t))))
    if last - first + 2 * room < 0.5 * (t[-1] - t[0]):
        ax.set_xlim(max(first - room, t[0]), min(last + 2 * room, t[-1]))


@style.styled
def plot_formulations(result: Formulations) -> np.ndarray:
    """Draw the same fit plain, with penalties and with hard constraints: parameters, errors, and the path between.

    Returns
    -------
    ndarray of Axes, shape (3,)
        Change of the parameters against the plain fit with two standard deviations; error per channel; distance
        of the penalty solution from the hard one as the penalties grow heavier.

    Examples
    --------
    >>> axes = mi.plot_formulations(mi.compare_formulations(better, [mi.SteadyState()], weights=[1.0]))
    """
    style.refuse_other(result, Formulations, "plot_formulations takes mi.compare_formulations(fit)")
    axes = style.new_figure(style.WIDTH, 3.0).subplots(1, 3, width_ratios=[1.5, 1.0, 1.0])
    shown = [(f.name, f.fit, style.CYCLE[k]) for k, f in enumerate(result.all) if f.fit is not None]
    _changes(axes[0], shown)
    _errors(axes[1], shown)
    _walk(axes[2], result)
    axes[0].figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return axes


def _changes(ax: Axes, shown: Sequence[tuple[str, Any, str]]) -> None:
    plain = shown[0][1]
    names = [n for n in plain.problem.model.free_names if plain.values[n]]
    for k, (word, fit, colour) in enumerate(shown):
        place = np.arange(len(names)) + 0.22 * (k - 1)
        change = [100 * (fit.values[n] / plain.values[n] - 1) for n in names]
        spread = [200 * (fit.std[n] or 0.0) / abs(plain.values[n]) for n in names]
        ax.errorbar(place, change, yerr=spread, fmt="o", ms=4.5, capsize=2.5, lw=1.2, color=colour, label=word)
    ax.axhline(0, color=style.MUTED, lw=0.7)
    ax.set(xticks=range(len(names)), xticklabels=names, ylabel="change against the plain fit (%)",
           title="Parameters, ±2σ")


def _errors(ax: Axes, shown: Sequence[tuple[str, Any, str]]) -> None:
    channels = list(shown[0][1].nrmse)
    for k, (_, fit, colour) in enumerate(shown):
        place = np.arange(len(channels)) + 0.26 * (k - 1)
        ax.bar(place, [100 * fit.nrmse[c] for c in channels], width=0.24, color=colour)
    ax.set(xticks=range(len(channels)), xticklabels=[style.axis_label(c).split(" (")[0] for c in channels],
           ylabel="NRMSE (%)", title="Error")
    ax.grid(axis="x", visible=False)


def _walk(ax: Axes, result: Formulations) -> None:
    ax.set(xlabel="weight of the penalties", ylabel="distance from the hard fit (%)", title="Heavier penalties")
    points = [(p.weight, 100 * p.distance) for p in result.path if p.distance > 0]
    if not points:
        ax.text(0.5, 0.5, "no path", transform=ax.transAxes, ha="center", color=style.MUTED)
        return
    ax.loglog(*zip(*points, strict=True), "o-", ms=4, color=style.CYCLE[1])
    style.plain_decades(ax)

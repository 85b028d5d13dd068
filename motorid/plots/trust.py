"""Figures of how far a fit can be trusted: what each parameter does, and which ones the data determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from motorid.errors import UsageError, one_of
from motorid.estimation.fit import Fit
from motorid.plots.style import (
    CYCLE,
    MUTED,
    PALETTE,
    WIDTH,
    axis_label,
    band,
    line,
    new_figure,
    plain_decades,
    styled,
    tidy,
)
from motorid.uncertainty.endings import Ending, Multistart

_KINDS = {"good": PALETTE["blue"], "poor": PALETTE["orange"], "failed": PALETTE["grey"]}


@styled
def plot_sensitivities(fit: Fit, *, run: int = 0, names: Sequence[str] | None = None) -> np.ndarray:
    """Draw what one per cent of each parameter does to the outputs, beside the noise.

    Curves of the same shape cannot be told apart; a curve within the band of the noise can hardly be seen by
    the fit.

    Parameters
    ----------
    fit : Fit
    run : int
        Which record.
    names : sequence of str, optional
        Parameters; default: all that were estimated.

    Returns
    -------
    ndarray of Axes, shape (channels,)
    """
    problem = fit.problem
    free = [p.name for p in problem.unknown if p.name in fit.values]
    for n in names or ():
        if n not in free:
            raise UsageError(one_of(n, free, "estimated parameter"))
    if not 0 <= run < len(problem.runs):
        raise UsageError(f"the fit has {len(problem.runs)} runs, numbered from 0; got run={run}.")
    trajectory = problem.simulate(fit.q, run)
    assert trajectory.dy is not None
    record = problem.experiments[run]
    channels = [c for c in problem.outputs if c in record.outputs]
    figure = new_figure(WIDTH, 1.9 * len(channels) + 0.3)
    axes = figure.subplots(len(channels), 1, sharex=True, squeeze=False).ravel()
    slope = problem.scaling.slope(fit.q)
    for ax, c in zip(axes, channels, strict=True):
        band(ax, problem.runs[run].sigma[c], "noise, ±σ")
        for k, name in enumerate(names or free):
            j = free.index(name)
            step = 0.01 * (abs(fit.values[name]) or problem.scaling.scale[j])
            change = trajectory.dy[:, problem.outputs.index(c), j] / slope[j] * step
            line(
                ax,
                record.t,
                change,
                color=CYCLE[k % len(CYCLE)],
                ls=("-", "--", ":")[k // len(CYCLE) % 3],
                label=name,
            )
        tidy(ax, y=f"change of {axis_label(c, record).replace(' (', chr(10) + '(')}")
    tidy(axes[0], title=f"What +1 % of each parameter does, {record.name}")
    tidy(axes[-1], x="time (s)")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.05))
    figure.align_ylabels(axes)
    return axes


@styled
def plot_waterfall(result: Multistart) -> np.ndarray:
    """Draw where fits from random starts ended: their errors in order, and how far the parameters came.

    A flat line of errors and ends at one, from starts all over the place, say that the start does not matter.

    Parameters
    ----------
    result : Multistart

    Returns
    -------
    ndarray of Axes, shape (2,)
        Misfit over the best, sorted; parameters of starts and ends over the reference.
    """
    if not isinstance(result, Multistart):
        raise UsageError(f"plot_waterfall takes mi.multistart(fit), got {type(result).__name__}.")
    axes = new_figure(WIDTH, 3.1).subplots(1, 2, width_ratios=[1.0, 1.2])
    ends = [(e, k) for e, k in zip(result.endings, result.kinds, strict=True) if isinstance(e, Ending)]
    ends = sorted(((e, k) for e, k in ends if np.isfinite(e.cost)), key=lambda p: p[0].cost)
    _sorted_costs(axes[0], result, ends)
    _starts_and_ends(axes[1], result, ends)
    return axes


def _sorted_costs(ax: Axes, result: Multistart, ends: Sequence[tuple[Ending, str]]) -> None:
    lowest = min([result.reference.cost, *(e.cost for e, _ in ends)])
    ratio = np.array([e.cost / lowest for e, _ in ends])
    for kind, colour in _KINDS.items():
        where = np.flatnonzero([k == kind for _, k in ends])
        if where.size:
            ax.plot(where + 1, ratio[where], "o", ms=4, color=colour, label=f"{kind} ({where.size})")
    ax.set_yscale("log")
    ax.set_ylim(0.9, max(2.2, float(ratio.max(initial=1.0)) * 1.5))
    plain_decades(ax)
    words = f"{len(result.endings)} starts, off by up to {result.spread:g} times"
    words += f", {result.failed} failed" if result.failed else ""
    tidy(ax, x="fits, best first", y="misfit over the best (χ² ratio)", title=words)
    ax.legend(loc="upper left")


def _starts_and_ends(ax: Axes, result: Multistart, ends: Sequence[tuple[Ending, str]]) -> None:
    names = [n for n in result.reference.problem.model.free_names if result.reference.values[n]]
    for j, name in enumerate(names):
        middle = result.reference.values[name]
        starts = np.array([e.start[name] / middle for e in result.endings if name in e.start])
        shift = np.linspace(-0.3, 0.0, max(len(starts), 1))[: len(starts)]
        ax.plot(j + shift, starts, ".", ms=3, color=PALETTE["grey"], alpha=0.7, label="start" if j == 0 else None)
        for kind, colour in _KINDS.items():
            there = [e.values[name] / middle for e, k in ends if k == kind]
            ax.plot(np.full(len(there), j + 0.2), there, "o", ms=4, color=colour, alpha=0.8)
    ax.axhline(1, color=MUTED, lw=0.7)
    if all(result.reference.values[n] > 0 for n in names):
        ax.set_yscale("log")
        plain_decades(ax)
    ax.set_xticks(range(len(names)), names)
    ax.set_xlim(-0.6, len(names) - 0.4)
    tidy(ax, y="value over the reference", title="Where they began (dots) and ended (circles)")

"""Figures of how far a fit can be trusted: what each parameter does, and which ones the data determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from motorid.errors import UsageError, one_of
from motorid.fit import Fit
from motorid.plots.style import CYCLE, WIDTH, axis_label, band, line, new_figure, styled, tidy


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

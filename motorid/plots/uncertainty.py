"""Figures of how far to trust a fit: singular values, profiles and intervals, sensitivities, multistart."""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import PchipInterpolator
from scipy.special import stdtrit

from motorid.display.numbers import glued, number, quantity
from motorid.errors import UsageError, chosen
from motorid.estimation.result import Fit
from motorid.numerics.signals import Array
from motorid.plots import style
from motorid.uncertainty.identifiability import LEVEL as SEEN
from motorid.uncertainty.identifiability import Identifiability
from motorid.uncertainty.multistart import Multistart, StartResult
from motorid.uncertainty.profile import Intervals, Profile

LEVEL = 0.95
TITLE = 52  # characters of a line above half a figure
_KINDS = {"good": ("agree", "blue"), "poor": ("elsewhere", "orange"), "failed": ("failed", "grey")}  # word, colour


@style.styled
def plot_singular_values(result: Identifiability) -> np.ndarray:
    """Draw how well each direction of the parameters is seen, and which parameters make it up.

    A direction whose singular value is below two (shaded) changes the outputs by less than twice the noise even where
    the parameters change by 100 %. Circles: share of each parameter in a direction, blue and orange for opposite signs.

    Returns
    -------
    ndarray of Axes, shape (2,)

    Examples
    --------
    >>> axes = mi.plot_singular_values(mi.identifiability(better))
    """
    style.refuse_other(result, Identifiability, "plot_singular_values takes mi.identifiability(fit)")
    k = len(result.names)
    axes = style.new_figure(min(style.WIDTH, 4.6 + 0.6 * k), 3.2).subplots(1, 2, width_ratios=[1.0, max(0.8, 0.16 * k)])
    ax, rows = axes[0], np.arange(1, k + 1)
    values = np.maximum(result.singular_values, 1e-12 * max(float(result.singular_values[0]), 1e-300))
    bottom = min(0.1, 0.5 * float(values.min()))
    colours = [style.PALETTE["blue"] if v > SEEN else style.PALETTE["orange"] for v in values]
    ax.vlines(rows, bottom, values, color=colours, lw=2)
    ax.scatter(rows, values, color=colours, s=24, zorder=3)
    ax.set(yscale="log", ylim=(bottom, 2.5 * float(values[0])), xticks=rows, xlabel="direction",
           ylabel="singular value",
           title=f"rank {result.rank} of {k}, condition number {number(result.condition_number, 3)}")
    ax.axhspan(bottom, SEEN, color=style.MUTED, alpha=0.16, lw=0, zorder=0)
    style.plain_decades(ax)
    ax.text(0.98, 0.97, "grey: not determined", transform=ax.transAxes, ha="right", va="top", fontsize=8,
            color=style.MUTED)
    for row, direction in enumerate(result.directions, 1):
        for column, weight in enumerate(direction):
            colour = style.PALETTE["blue"] if weight > 0 else style.PALETTE["orange"]
            axes[1].scatter(column, row, s=180 * abs(float(weight)) ** 1.5, color=colour, alpha=0.85, lw=0)
    axes[1].set(xlim=(-0.6, k - 0.4), ylim=(k + 0.6, 0.4), xticks=range(k), xticklabels=result.names, yticks=rows,
                ylabel="direction", title="What each direction is made of (area: weight)")
    return axes


@style.styled
def plot_profile(result: Profile | Mapping[str, Profile] | Intervals) -> np.ndarray:
    """Draw how the error rises as a parameter is fixed away from its value, all others refitted.

    The interval of 95 % ends where the curve crosses the dashed line; where it never does, the data set no limit. The
    covariance assumes an even valley. Of `Intervals` the covariance's and the bootstrap's are drawn below the curve.

    Returns
    -------
    ndarray of Axes
        One per parameter.

    Examples
    --------
    >>> axes = mi.plot_profile(mi.profile(better, "b", quiet=True))
    """
    found = result.profiles if isinstance(result, Intervals) else result
    profiles = list(found.values()) if isinstance(found, Mapping) else [found]
    if not profiles or not all(isinstance(p, Profile) for p in profiles):
        raise UsageError(f"plot_profile takes mi.profile(fit, 'R') or mi.intervals(fit), got {type(result).__name__}.")
    columns = min(len(profiles), 3)
    axes = style.panels(len(profiles), columns, row=2.2, width=style.WIDTH if columns == 3 else 4.2 * columns)
    for ax, p in zip(axes, profiles, strict=True):
        _one_profile(ax, p, result if isinstance(result, Intervals) else None)
    for ax in axes[::columns]:
        ax.set_ylabel("rise of the error (t²)")
    axes[0].figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5)
    return axes


def _one_profile(ax: Axes, p: Profile, both: Intervals | None) -> None:
    level = both.level if both is not None else LEVEL
    height = float(stdtrit(p.dof, 0.5 + level / 2)) ** 2
    scale = 10.0 ** -style.decade(abs(p.value))
    ax.plot(*_smooth(p.values * scale, p.rise, p.value * scale), "-", color=style.PALETTE["blue"], label="profile")
    ax.plot(p.values * scale, p.rise, ".", ms=4, color=style.PALETTE["blue"])
    ax.axhline(height, color=style.INK, lw=0.9, ls=(0, (4, 2)), label=f"{100 * level:g} %")
    ax.plot(p.value * scale, 0, "o", ms=6, color=style.PALETTE["blue"])
    ends = np.clip(p.interval(level), float(p.values.min()), float(p.values.max()))
    ax.axvspan(ends[0] * scale, ends[1] * scale, color=style.PALETTE["blue"], alpha=0.1, lw=0)
    if both is not None:
        for y, name, colour in ((-0.8, "covariance", "purple"), (-1.7, "bootstrap", "green")):
            if (limits := getattr(both, name).interval(p.name, level)) is not None:
                ax.plot(np.array(limits) * scale, [y, y], "|-", color=style.PALETTE[colour], lw=2, ms=6, label=name)
    ax.set_ylim(-2.4 if both is not None else -0.4, max(1.5 * height, 2.0))
    ax.set_yticks([y for y in ax.get_yticks() if 0 <= y <= ax.get_ylim()[1]])
    _reach(ax, p, height, scale)
    ax.set(xlabel=style.scaled_title(p.name, p.unit, style.decade(abs(p.value))))


def _reach(ax: Axes, p: Profile, height: float, scale: float) -> None:
    """Show the valley and some of its sides; a valley over decades on a logarithmic axis."""
    inside = p.values[p.rise <= 1.6 * height] * scale
    low, high = float(inside.min()), float(inside.max())
    if low > 0 and high > 20 * low:
        ax.set(xscale="log", xlim=(low / 1.5, high * 1.5))
        return
    room = 0.08 * (high - low) or 0.1 * abs(high)
    ax.set_xlim(low - room, high + room)
    ax.xaxis.set_major_locator(MaxNLocator(4))


def _smooth(x: Array, rise: Array, at: float) -> tuple[Array, Array]:
    """Return the curve between the points; the root of the rise is nearly straight, so that is joined."""
    root = np.sign(x - at) * np.sqrt(np.maximum(rise, 0.0))
    if len(x) < 3 or np.any(np.diff(root) <= 0) or x.max() > 20 * max(x.min(), 1e-300):
        return x, rise
    fine = np.linspace(x[0], x[-1], 200)
    return fine, PchipInterpolator(x, root)(fine) ** 2


@style.styled
def plot_sensitivities(fit: Fit, *, run: int = 0, names: Sequence[str] | None = None) -> np.ndarray:
    """Draw what one per cent of each parameter does to the outputs, one row per parameter, beside the noise.

    Rows of the same shape cannot be distinguished; where the curve stays within the grey band of the noise, these
    samples say almost nothing about the parameter. Every row has its own scale.

    Parameters
    ----------
    fit : Fit
    run : int
        Which record.
    names : sequence of str, optional
        Parameters; default: all that were estimated.

    Returns
    -------
    ndarray of Axes, shape (parameters, channels)

    Examples
    --------
    >>> axes = mi.plot_sensitivities(better)
    """
    problem = fit.problem
    free = [p.name for p in problem.unknown if p.name in fit.values]
    shown = chosen(names, free, "estimated parameter")
    style.refuse_index(run, len(problem.runs))
    trajectory, record = problem.simulate(fit.q, run), problem.experiments[run]
    assert trajectory.dy is not None
    channels = [c for c in problem.outputs if c in record.outputs]
    axes = style.grid(len(shown), len(channels), row=0.8, sharex=True)
    slope = problem.scaling.slope(fit.q)
    for row, name in zip(axes, shown, strict=True):
        j = free.index(name)
        step = 0.01 * (abs(fit.values[name]) or problem.scaling.scale[j])
        for ax, c in zip(row, channels, strict=True):
            change = trajectory.dy[:, problem.outputs.index(c), j] / slope[j] * step
            most, sigma = float(np.max(np.abs(change))) or 1.0, problem.runs[run].sigma[c]
            style.band(ax, sigma, "noise, ±σ")
            style.line(ax, record.t, change, color=style.PALETTE["blue"])
            ax.set(ylim=(-1.2 * most, 1.9 * most), yticks=[0.0], yticklabels=[""])  # room for the words
            ax.text(0.995, 0.97, f"up to {quantity(most, record.units[c], 2)} = {number(most / sigma, 2)} σ",
                    transform=ax.transAxes, ha="right", va="top", fontsize=8, color=style.INK)
        row[0].set_ylabel(name, rotation=0, ha="right", va="center")
    for top, bottom, c in zip(axes[0], axes[-1], channels, strict=True):
        top.set(title=f"{style.axis_label(c, record)}: change for +1 %")
        bottom.set(xlabel="time (s)")
    axes[0, 0].figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right")
    axes[0, 0].figure.align_ylabels(axes[:, 0])
    return axes


@style.styled
def plot_waterfall(result: Multistart) -> np.ndarray:
    """Draw where fits from random starts ended: their errors in order, and how far the parameters came.

    A flat line of errors and ends at one, from widely scattered starts, say that the start does not matter.

    Returns
    -------
    ndarray of Axes, shape (2,)
        Squared error over the best, sorted; parameters of starts and ends over the reference.

    Examples
    --------
    >>> axes = mi.plot_waterfall(mi.multistart(fit, starts=2, quiet=True))
    """
    style.refuse_other(result, Multistart, "plot_waterfall takes mi.multistart(fit)")
    axes = style.new_figure(style.WIDTH, 3.1).subplots(1, 2, width_ratios=[1.0, 1.2])
    ends = [(e, k) for e, k in zip(result.results, result.kinds, strict=True) if isinstance(e, StartResult)]
    ends = sorted(((e, k) for e, k in ends if np.isfinite(e.cost)), key=lambda p: p[0].cost)
    _sorted_costs(axes[0], result, ends)
    _starts_and_ends(axes[1], result, ends)
    return axes


def _sorted_costs(ax: Axes, result: Multistart, ends: Sequence[tuple[StartResult, str]]) -> None:
    ratio = np.array([e.cost for e, _ in ends]) / min([result.reference.cost, *(e.cost for e, _ in ends)])
    for kind, (word, colour) in _KINDS.items():
        if (where := np.flatnonzero([k == kind for _, k in ends])).size:
            ax.plot(where + 1, ratio[where], "o", ms=4, color=style.PALETTE[colour], label=word)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    words = f"{result.good} of {len(result.results)} agree"
    words += f"; {result.failed} failed" * bool(result.failed) + f"; {result.poor} elsewhere:" * bool(result.poor)
    ax.set(yscale="log", ylim=(0.9, max(2.2, float(ratio.max(initial=1.0)) * 1.5)), xlabel="fits, best first",
           ylabel="squared error over the best (ratio)",
           title="\n".join([words, *textwrap.wrap(glued(result.elsewhere), TITLE)]))
    style.plain_decades(ax)
    ax.legend(loc="upper left")


def _starts_and_ends(ax: Axes, result: Multistart, ends: Sequence[tuple[StartResult, str]]) -> None:
    names = [n for n in result.reference.problem.model.free_names if result.reference.values[n]]
    for j, name in enumerate(names):
        middle = result.reference.values[name]
        starts = np.array([e.start[name] / middle for e in result.results if name in e.start])
        shift = np.linspace(-0.3, 0.0, max(len(starts), 1))[: len(starts)]
        ax.plot(j + shift, starts, ".", ms=3, color=style.PALETTE["grey"], alpha=0.7, label="start" if j == 0 else None)
        for kind, (_, colour) in _KINDS.items():
            there = [1 + result.difference(name, e.values[name], middle) / middle for e, k in ends if k == kind]
            ax.plot(np.full(len(there), j + 0.2), there, "o", ms=4, color=style.PALETTE[colour], alpha=0.8)
    ax.axhline(1, color=style.MUTED, lw=0.7)
    if all(result.reference.values[n] > 0 for n in names):
        ax.set_yscale("log")
        style.plain_decades(ax)
    ax.set(xticks=range(len(names)), xticklabels=names, xlim=(-0.6, len(names) - 0.4),
           ylabel="value over that of the best fit",
           title=f"Starts (dots, up to {result.spread:g} times off) and ends (circles)")

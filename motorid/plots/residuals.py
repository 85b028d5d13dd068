"""Figures of what a fit leaves over."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes

from motorid.diagnosis.locate import binned
from motorid.diagnosis.results import Binned
from motorid.errors import DataError, chosen
from motorid.estimation.result import Fit
from motorid.numerics.autoregression import autocorrelation, effective_samples
from motorid.numerics.signals import Array
from motorid.plots import style
from motorid.problem.simulate import Simulation

LAGS = 60


@style.styled
def plot_residuals(fit: Fit, channels: Sequence[str] | None = None) -> np.ndarray:
    """Draw the residuals of each channel: over time, their histogram, their correlation with the input and with
    themselves, against the model's ω, i, θ.

    Noise alone is flat: a histogram under the curve of the normal distribution, correlations within
    their bands of 95 %, means of zero against every quantity.

    Parameters
    ----------
    fit : Fit
    channels : sequence of str, optional
        Default: all measured ones.

    Returns
    -------
    ndarray of Axes, shape (channels, k)
        Time, histogram, cross-correlation with the input, autocorrelation, then one per quantity known.

    Examples
    --------
    >>> axes = mi.plot_residuals(fit)
    """
    names = chosen(channels, fit.problem.outputs, "channel")
    against = [c for c in ("omega", "i", "theta") if c in fit.problem.outputs]
    figure = style.new_figure(style.WIDTH, 3.0 * len(names) + 0.2)
    rows = figure.add_gridspec(2 * len(names), 1)
    axes = np.empty((len(names), 4 + len(against)), object)
    for j, c in enumerate(names):
        axes[j, :3] = rows[2 * j].subgridspec(1, 3, width_ratios=(7, 2, 3)).subplots()
        axes[j, 1].sharey(axes[j, 0])
        axes[j, 3:] = rows[2 * j + 1].subgridspec(1, 1 + len(against)).subplots(squeeze=False)[0]
        _channel(axes[j], fit, c, against)
    figure.align_ylabels([row[k] for row in axes for k in (0, 3)])
    return axes


def _channel(axes: np.ndarray, fit: Fit, channel: str, against: Sequence[str]) -> None:
    sims = [s for s in fit.simulations if channel in s.experiment.outputs]
    run = sims[0].experiment
    unit = run.units[channel]
    sigma = float(np.mean([r.sigma[channel] for r in fit.problem.runs if channel in r.sigma]))
    _over_time(axes[0], sims, channel, sigma)
    axes[0].set(xlabel="time, runs one after the other (s)", ylabel=f"residual ({unit})",
                title=f"Residual of the {style.axis_label(channel, run)}")
    residuals = [s.residual(channel) for s in sims]
    every = np.concatenate(residuals)
    if not np.isfinite(every).any():
        raise DataError(f"nothing to draw: the residual of {channel} holds no finite number.")
    _histogram(axes[1], every[np.isfinite(every)], sigma)
    _with_input(axes[2], sims, channel)
    _autocorrelation(axes[3], residuals)
    for ax, other in zip(axes[4:], against, strict=True):
        # The model's own: the measured one shares its noise with the residual, which then seems to depend.
        x = np.concatenate([s.outputs[other] for s in sims])
        ok = np.isfinite(x) & np.isfinite(every)
        style.band(ax, 2 * sigma)
        scatter(ax, x[ok], every[ok])
        means(ax, binned(other, x[ok], every[ok]) if ok.any() else None, color=style.INK)
        ax.set(xlabel=style.axis_label(other, run), title=f"Against {style.axis_label(other, run).split(' (')[0]}")
        ax.sharey(axes[4])
    axes[4].set_ylabel(f"residual ({unit})")


def _over_time(ax: Axes, sims: Sequence[Simulation], channel: str, sigma: float) -> None:
    shift = 0.0
    style.band(ax, 2 * sigma, "noise, ±2σ")
    for k, s in enumerate(sims):
        t = s.experiment.t - s.experiment.t[0]
        style.line(ax, t + shift, s.residual(channel), color=style.RESIDUAL, lw=0.8)
        if len(sims) <= 6:
            ax.annotate(s.experiment.name, (shift, 1), (3, -2), xycoords=("data", "axes fraction"),
                        textcoords="offset points", va="top", fontsize=7, color=style.MUTED,
                        bbox={"facecolor": style.PAPER, "alpha": 0.8, "lw": 0, "pad": 1})
        shift += float(t[-1])
        if k + 1 < len(sims):
            ax.axvline(shift, color=style.MUTED, lw=0.7)
    legend = ax.legend(loc="lower right", bbox_to_anchor=(1.02, 0.97), borderpad=0.1, ncols=4, handlelength=1.6)
    legend.set_in_layout(False)  # at the right above the axes, where it covers no data: the title's line has room


def _histogram(ax: Axes, r: Array, sigma: float) -> None:
    edges = np.linspace(r.min(), r.max(), 41) if np.ptp(r) > 0 else np.linspace(-1, 1, 41)
    bars = ax.hist(r, edges.tolist(), density=True, orientation="horizontal", color=style.RESIDUAL, alpha=0.55)
    top, y = float(np.max(bars[0])), np.linspace(-4 * sigma, 4 * sigma, 121)
    bell = np.exp(-0.5 * (y / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    ax.plot(bell, y, color=style.INK, lw=1.0, label="noise")
    ax.set(xlim=(0, 1.25 * max(top, float(bell.max()) if bell.max() < 4 * top else top)), xticks=[],
           xlabel="density (line: noise)", title="Histogram")
    ax.tick_params(labelleft=False)


def _with_input(ax: Axes, sims: Sequence[Simulation], channel: str) -> None:
    """Correlate the residual with the input at lags of either sign; both share the band of coloured residuals."""
    lags = min(LAGS, min(s.experiment.n for s in sims) // 3)
    total, size, worth = np.zeros(2 * lags + 1), np.zeros(2), 0.0
    for s in sims:
        r, u = np.nan_to_num(s.residual(channel)), s.experiment.inputs["v"]
        r, u = r - r.mean(), u - u.mean()
        total += scipy.signal.correlate(r, u)[len(r) - 1 - lags:len(r) + lags]
        size += r @ r, u @ u
        worth += effective_samples(r)
    style.band(ax, 1.96 / np.sqrt(max(worth, 1.0)))
    k = np.arange(-lags, lags + 1)
    ax.vlines(k, 0, total / np.sqrt(np.prod(size) or 1.0), color=style.PALETTE["purple"], lw=0.9)
    ax.axhline(0, color=style.MUTED, lw=0.6)
    ax.set(ylim=(-0.6, 0.6), xlabel="lag (samples)", title="Input correlation")


def _autocorrelation(ax: Axes, residuals: Sequence[Array]) -> None:
    lags = min(LAGS, min(len(r) for r in residuals) // 3)
    every = np.concatenate(list(residuals))
    rho = autocorrelation([r - np.nanmean(every) for r in residuals], lags)
    style.band(ax, 1.96 / np.sqrt(np.isfinite(every).sum()))
    ax.vlines(np.arange(1, lags + 1), 0, rho[1:], color=style.PALETTE["purple"], lw=1.2)
    ax.axhline(0, color=style.MUTED, lw=0.6)
    ax.set_ylim(min(-0.25, float(rho.min()) * 1.1), max(0.4, min(1.05, float(rho[1:].max(initial=0)) * 1.25)))
    ax.set(xlabel="lag (samples)", ylabel="correlation", title="Autocorrelation")


def scatter(ax: Axes, x: Any, y: Any, most: int = 1500, color: str = style.RESIDUAL) -> None:
    """Draw points, every so many of them where there are too many, the extreme ones always."""
    order = np.argsort(y)
    keep = np.unique(np.concatenate([np.arange(0, len(x), max(1, len(x) // most)), order[:5], order[-5:]]))
    ax.plot(x[keep], y[keep], ".", ms=2, color=color, alpha=0.35, mew=0, rasterized=len(keep) > 400, zorder=1)


def means(ax: Axes, b: Binned | None, factor: float = 1.0, *, color: str) -> None:
    """Draw means with their interval of 95 %, times a factor; no curve where there are no samples."""
    if b is None or not b.centre.size:
        return
    gaps = np.diff(b.centre)
    wide = gaps > max(4 * float(np.median(gaps)) if gaps.size else 0.0, 0.15 * float(np.ptp(b.centre)))
    for part in np.split(np.arange(len(b.centre)), np.flatnonzero(wide) + 1):
        x = b.centre[part]
        ax.fill_between(x, b.low[part] * factor, b.high[part] * factor, color=color, alpha=0.3, lw=0)
        ax.plot(x, b.mean[part] * factor, "-" if len(part) > 1 else "o", ms=3, color=color, lw=1.5)

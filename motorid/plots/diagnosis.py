"""Figures of a diagnosis: where the model fails, which effect is missing, how the error falls."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from motorid.diagnosis.experiment_design import Design
from motorid.diagnosis.locate import accounted, binned
from motorid.diagnosis.results import Binned, Candidate, Diagnosis, Ladder, Missing
from motorid.display.numbers import number
from motorid.errors import DataError, UsageError, at_least, chosen
from motorid.estimation.result import Fit
from motorid.numerics.autoregression import autocorrelation, effective_samples
from motorid.numerics.signals import Array
from motorid.plots import style
from motorid.plots.fits import what_changed
from motorid.problem.simulate import Simulation, moving

FINE = 60  # bins of a mean that is drawn as a curve
LOWEST_GAIN = -0.12  # drawn; what lies below is shown by an arrow
LAGS = 60  # of a correlation
_COLOUR = {"voltage": style.PALETTE["purple"], "torque": style.PALETTE["blue"]}


@style.styled
def plot_missing(result: Missing | Diagnosis, *, show: int = 3, run: int | None = None) -> np.ndarray:
    """Draw the missing voltage and torque over time, and against what explains them best.

    Dots are samples, lines means in bins with their 95 %; titles say which share of the variance a quantity explains.

    Parameters
    ----------
    result : Missing or Diagnosis
    show : int
        Number of quantities per balance.
    run : int, optional
        Which run is drawn over time; default: the one with the largest missing part.

    Returns
    -------
    ndarray of Axes, shape (balances, 1 + show)

    Examples
    --------
    >>> axes = mi.plot_missing(mi.locate(fit))
    """
    missing = result.missing if isinstance(result, Diagnosis) else result
    style.refuse_other(missing, Missing, "plot_missing takes a diagnosis, mi.diagnose(fit)")
    at_least(1, show=show)
    style.refuse_index(run, len(missing.t))
    balances = [b for b in ("voltage", "torque") if any(np.any(np.nan_to_num(x)) for x in getattr(missing, b))]
    if missing.where == "mechanical":
        balances.reverse()
    show = min(show, max((len(missing.bins.get(b, ())) for b in balances), default=0))
    figure = style.new_figure(style.WIDTH, 2.3 * len(balances) + 0.2)
    axes = figure.subplots(len(balances), 1 + show, squeeze=False, sharey="row", width_ratios=[1.7] + [1.0] * show)
    for row, balance in zip(axes, balances, strict=True):
        _balance(row, missing, balance, run)
    figure.align_ylabels(axes[:, 0])
    return axes


def _balance(row: np.ndarray, missing: Missing, balance: str, run: int | None) -> None:
    values: Sequence[Array] = getattr(missing, balance)
    power = style.decade(float(np.nanmax([np.nanmax(np.abs(v), initial=0.0) for v in values])))
    factor = 10.0**-power
    k = run if run is not None else int(np.argmax([np.nanmean(np.square(v)) for v in values]))
    style.line(row[0], missing.t[k], values[k] * factor, color=_COLOUR[balance], lw=0.9)
    unit = "V" if balance == "voltage" else missing.torque_unit
    noun = "force" if unit == "N" else balance
    share = missing.shares.get({"voltage": "electrical", "torque": "mechanical"}[balance])
    part = "" if share is None else f": {100 * share:.0f} % of the squared error"
    title = style.scaled_title(f"missing {noun}", unit, power)
    row[0].set(xlabel="time (s)", ylabel=title, title=f"Missing {noun}{part}")
    bins = missing.bins.get(balance, ())
    for ax, b in zip(row[1:], bins, strict=False):
        _binned(ax, b, missing.signals, values, factor, _COLOUR[balance])
    for ax in row[1 + len(bins):]:
        ax.set_axis_off()


def _binned(ax: Axes, b: Binned, signals: Sequence[Mapping[str, Array]], values: Sequence[Array], factor: float,
            colour: str) -> None:
    x, y = np.concatenate([np.asarray(s[b.against]) for s in signals]), np.concatenate(list(values)) * factor
    x = np.mod(x, 2 * np.pi) if b.against == "theta" else x
    if (ok := np.isfinite(x) & np.isfinite(y) & (x >= b.centre.min()) & (x <= b.centre.max())).any():
        scatter(ax, x[ok], y[ok], most=800, color=style.MUTED)
    means(ax, b, factor, color=colour)
    ax.axhline(0, color=style.MUTED, lw=0.6)
    ax.set(xlabel=style.axis_label(b.against), title=f"explains {100 * b.explained:.0f} %")


@style.styled
def plot_answer(found: Diagnosis, ax: Axes | None = None) -> Axes:
    """Draw the missing torque or voltage with what was added drawn over it, against the quantity that it acts on.

    Dots are samples of what the first model lacks, their mean and its interval of 95 % in bins; the line is what the
    last model has instead, effects or, for none, a known curve, and shifted parameters; what repeats: over a period.

    Examples
    --------
    >>> axes = mi.plot_answer(found)
    """
    style.refuse_other(found, Diagnosis, "plot_answer takes a diagnosis, mi.diagnose(fit)")
    m = found.missing
    balance = "voltage" if found.where == "electrical" and any(map(np.any, m.voltage)) else "torque"  # also for both
    left = found.remainder if found.after is found.before and found.remainder and found.remainder.errors else None
    after = left.fitted if left else found.after
    alike = after is not found.before and len(after.problem.experiments) == len(found.before.problem.experiments)
    had = accounted(found.before, after)[balance == "torque"] if alike else None
    on = left.form.on.replace("turn", "theta") if left and left.form else ""
    against, periods = (on, 1.0) if on in m.signals[0] else _quantity(found, balance, had)
    x = np.concatenate([np.asarray(s[against]) * periods for s in m.signals])
    x = np.mod(x, 2 * np.pi) if against == "theta" else x
    values = np.concatenate(getattr(m, balance))
    power = style.decade(float(np.nanmax(np.abs(values), initial=0.0)))
    ax = style.only(ax, width=5.6, height=3.6)
    scatter(ax, x, values * 10.0**-power, most=3000, color=style.MUTED)
    b = binned(against, x, values * 10.0**-power, bins=FINE)
    ax.fill_between(b.centre, b.low, b.high, color=_COLOUR[balance], alpha=0.3, lw=0)
    ax.plot(b.centre, b.mean, color=_COLOUR[balance], lw=1.6, label="missing, mean ± 95 %")
    if had is not None:
        b = binned(against, x, np.concatenate(had) * 10.0**-power, bins=FINE)
        new = " + ".join(n for n in after.model.effect_names if n not in found.before.model.effect_names)
        label = textwrap.fill(f"{left.follows if left else new}, with the shift of the parameters", 60)
        ax.plot(b.centre, b.mean, "--", color=style.PALETTE["orange"], lw=2.0, label=label)
    ax.axhline(0, color=style.MUTED, lw=0.6)
    noun = "force" if (unit := "V" if balance == "voltage" else m.torque_unit) == "N" else balance
    run = found.before.problem.experiments[0]
    name = f"phase of {periods:g} periods per turn (rad)" if periods != 1 else style.axis_label(against, run)
    ax.set(xlabel=name, ylabel=style.scaled_title(f"missing {noun}", unit, power), title=f"The missing {noun}")
    ax.legend(loc="upper left", bbox_to_anchor=(0.0, -0.16), borderaxespad=0.0)  # below, where it covers no curve
    return ax


def _quantity(found: Diagnosis, balance: str, had: Sequence[Array] | None) -> tuple[str, float]:
    """Return the quantity to draw over: the phase of an effect with periods, else what the addition `had` follows."""
    orders = [found.after.values[p.name] for e in found.after.model.effects if e.name in found.effects
              for p in e.parameters if p.order]
    bins = found.missing.bins.get(balance, ())
    # Over time and heat any course is a curve, whatever it depends on: they pass through each value once.
    bins = [b for b in bins if b.against not in ("t", "heat")] or bins
    if orders or not bins or had is None:
        return ("theta", orders[0]) if orders else (bins[0].against if bins else "t", 1.0)
    names = [*(b.against for b in bins), *(n for n in found.missing.signals[0] if n == "v")]
    x = {n: np.concatenate([np.asarray(s[n]) for s in found.missing.signals]) for n in names}
    x |= {"theta": np.mod(x["theta"], 2 * np.pi)} if "theta" in x else {}
    told = {n: binned(n, x[n], np.concatenate(had), bins=FINE).explained for n in x}
    return max(told, key=lambda n: told[n]), 1.0


@style.styled
def plot_ranking(result: Diagnosis | Sequence[Candidate], ax: Axes | None = None, *, show: int = 10) -> Axes:
    """Draw the effects tried, best first: by how much each lowers the squared error.

    The outline is the prediction from the sensitivities, the bar what a refit gave; a diamond is the fall
    of the held-out error (an arrow: it rises, by more than the axis shows). Accepted effects are blue.

    Parameters
    ----------
    result : Diagnosis or sequence of Candidate
    ax : Axes, optional
    show : int
        Number of effects.

    Examples
    --------
    >>> axes = mi.plot_ranking(found)
    """
    every = result.ranking if isinstance(result, Diagnosis) else result
    if not (chosen := every[:show]) or not all(isinstance(c, Candidate) for c in chosen):
        raise UsageError("plot_ranking takes a diagnosis with a ranking: mi.plot_ranking(mi.diagnose(fit)).")
    ax = style.only(ax, width=6.4, height=0.6 + 0.3 * len(chosen))
    for k, c in enumerate(chosen):
        colour = style.PALETTE["blue"] if c.accepted else style.PALETTE["grey"]
        if c.refit_drop is not None:
            ax.barh(k, 100 * c.refit_drop, height=0.62, color=colour, alpha=0.85)
        ax.barh(k, 100 * c.predicted_drop, height=0.62, fill=False, edgecolor=style.INK, lw=0.9)
        if c.held_out_gain is not None:
            ax.plot(100 * max(c.held_out_gain, LOWEST_GAIN), k, "<" if c.held_out_gain < LOWEST_GAIN else "D", ms=6,
                    mew=0.7, color=style.PALETTE["orange"], mec="white", zorder=3)
    lowest = min([0.0, *(100 * max(c.held_out_gain or 0.0, LOWEST_GAIN) for c in chosen)])
    more = f" (first {len(chosen)} of {len(every)})" if len(every) > len(chosen) else ""
    ax.set(yticks=range(len(chosen)), yticklabels=[c.effect for c in chosen], ylim=(len(chosen) - 0.4, -0.6),
           xlim=(lowest - 3 if lowest < 0 else 0, 103), xlabel="fall of the squared error (%)",
           title=f"Which effect is missing?{more}")
    ax.grid(axis="y", visible=False)
    handles: list[Any] = [Patch(fill=False, edgecolor=style.INK, label="predicted")]
    for accepted, colour, label in ((True, "blue", "refitted, accepted"), (False, "grey", "refitted, not accepted")):
        if any(c.accepted == accepted and c.refit_drop is not None for c in chosen):
            handles.append(Patch(color=style.PALETTE[colour], alpha=0.85, label=label))
    if any(c.held_out_gain is not None for c in chosen):
        orange = style.PALETTE["orange"]
        handles.append(Line2D([], [], marker="D", ls="", color=orange, label="fall of the held-out error"))
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return ax


@style.styled
def plot_ladder(result: Ladder | Diagnosis, ax: Axes | None = None) -> Axes:
    """Draw how the error falls as effects are added: on the records of the fit, and on those it never saw.

    Examples
    --------
    >>> axes = mi.plot_ladder(found)
    """
    ladder = result.ladder if isinstance(result, Diagnosis) else result
    if not isinstance(ladder, Ladder) or not ladder.rungs:
        raise UsageError(f"plot_ladder takes mi.improve(fit) or mi.diagnose(fit), got {type(result).__name__}.")
    rungs = ladder.rungs
    ax = style.only(ax, width=max(5.6, 1.5 + 1.25 * len(rungs)), height=3.4)
    x = np.arange(len(rungs), dtype=float)
    for c, colour in zip(rungs[0].nrmse, style.CYCLE, strict=False):
        name = style.axis_label(c, rungs[0].fit.problem.experiments[0]).split(" (")[0]
        ax.plot(x, [100 * r.nrmse[c] for r in rungs], "o-", color=colour, ms=5.5, label=f"{name}, fitted")
        if all(r.validation_nrmse and c in r.validation_nrmse for r in rungs):
            ax.plot(x, [100 * (r.validation_nrmse or {})[c] for r in rungs], "s--", color=colour, mfc="white", ms=5.5,
                    label=f"{name}, held out")
    ax.set_yscale("log")
    style.plain_decades(ax)
    for k in sorted({0, len(rungs) - 1}):
        _error_labels(ax, k, {c: 100 * e for c, e in moving(rungs[k].nrmse).items()})
    started = what_changed(rungs[0].fit, None)
    ax.set_xticks(x, [started if r.added is None else "+ " + r.added.replace(" + ", "\n+ ") for r in rungs])
    ax.set(xlim=(-0.45, len(rungs) - 0.55), ylabel="NRMSE (%)", title="Error as effects are added")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return ax


def _error_labels(ax: Axes, k: int, errors: Mapping[str, float]) -> None:
    """Write the fitted errors beside the points of rung `k`, in their colours, apart where points lie close."""
    low, high = np.log(ax.get_ylim())
    room = 0.055 * (high - low)  # height of a line of text
    names = sorted(errors, key=lambda c: errors[c])
    at = np.log([errors[c] for c in names])
    for _ in range(len(at)):
        close = np.maximum(room - np.diff(at), 0.0)
        at[:-1], at[1:] = at[:-1] - close / 2, at[1:] + close / 2
    colours = dict(zip(errors, style.CYCLE, strict=False))
    away, side = (8, "left") if k else (-8, "right")
    for c, y in zip(names, np.exp(at), strict=True):
        ax.annotate(number(errors[c], 2), (k, float(y)), (away, 0), va="center", ha=side, textcoords="offset points",
                    fontsize=8, color=colours[c])


@style.styled
def plot_design(design: Design) -> np.ndarray:
    """Draw a designed voltage, and what each rival predicts with a band of two standard deviations.

    Returns
    -------
    ndarray of Axes, shape (channels + 1,)

    Examples
    --------
    >>> plan = mi.design_experiment(better, parameters=["b"], v_max=12, i_max=8, duration=0.5, levels=4)
    >>> axes = mi.plot_design(plan)
    """
    style.refuse_other(design, Design, "plot_design takes mi.design_experiment(...)")
    first = next(iter(design.predicted.values()))
    axes = style.grid(len(first) + 1, 1, sharex=True)[:, 0]
    style.line(axes[0], design.t, design.v, zoh=True, color=style.PALETTE["grey"])
    axes[0].set(ylabel=style.axis_label("v"), title="Designed experiment")
    for ax, channel in zip(axes[1:], first, strict=True):
        for (name, outputs), colour in zip(design.predicted.items(), style.CYCLE[:4], strict=False):
            y, half = outputs[channel], design.band[name][channel]
            ax.fill_between(design.t, y - half, y + half, color=colour, alpha=0.2, lw=0)
            style.line(ax, design.t, y, color=colour, label=name if len(design.predicted) > 1 else "predicted")
        ax.set(ylabel=style.axis_label(channel), xlabel=style.axis_label("t") if ax is axes[-1] else "")
    axes[0].figure.legend(*axes[1].get_legend_handles_labels(), loc="outside upper right", ncols=4)
    return axes


@style.styled
def plot_residuals(fit: Fit, channels: Sequence[str] | None = None) -> np.ndarray:
    """Draw the residuals of each channel: over time, histogram, correlations, and against the model's ω, i, θ.

    Noise alone is flat: a histogram under the normal curve, correlations within their bands of 95 %, means of zero.

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
            ax.annotate(style.short(s.experiment.name), (shift, 1), (3, -2), xycoords=("data", "axes fraction"),
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

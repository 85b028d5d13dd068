"""Figures of records, of a fit and its limits, and of how parameters moved from fit to fit."""

import io
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image

from motorid.channels import CHANNELS
from motorid.display.numbers import percent
from motorid.errors import UsageError, among, one_of, positive
from motorid.estimation.result import Fit
from motorid.estimation.shooting.formulations import Formulations
from motorid.numerics.signals import noise_level
from motorid.plots import style
from motorid.problem.constraints import CurrentLimit
from motorid.problem.simulate import Simulation, judge
from motorid.records.experiment import Experiment

COLUMNS = 3  # runs side by side at most: more would be unreadable
NEAR = 0.5  # of a limit of the current: what is worth a closer look


@style.styled
def plot_runs(runs: Sequence[Experiment] | Experiment, channels: Sequence[str] | None = None) -> np.ndarray:
    """Draw records: the input and every measured channel over time, one column per run.

    Parameters
    ----------
    runs : Experiment or sequence of Experiment
        At most three are drawn, and the title says so; pick others by slicing.
    channels : sequence of str, optional
        Among ``v, i, omega, theta``; default: all that are there.

    Returns
    -------
    ndarray of Axes, shape (channels, runs)

    Examples
    --------
    >>> axes = mi.plot_runs(runs)
    """
    if not (every := [runs] if isinstance(runs, Experiment) else list(runs)):
        raise UsageError("plot_runs needs at least one run: mi.plot_runs(mi.read_runs('run*.csv')).")
    shown = every[:COLUMNS]
    names = list(channels or ["v", *(c for c in CHANNELS if any(c in r.outputs for r in shown))])
    for name in names:
        if not any(name in run.inputs or name in CHANNELS for run in every):
            raise UsageError(one_of(name, ["v", *CHANNELS], "channel"))
    axes = style.grid(len(names), len(shown), row=1.35, sharex="col", sharey="row")
    for k, run in enumerate(shown):
        for j, c in enumerate(names):
            if (y := run.inputs.get(c, run.outputs.get(c))) is None:
                _absent(axes[j, k], c)
            else:
                style.line(axes[j, k], run.t, y, zoh=c == "v" and run.hold == "zoh", lw=1.0,
                           color=style.INK if c == "v" else style.MODEL)
        axes[0, k].set(title=_run_title(run, k, every))
        axes[-1, k].set(xlabel="time (s)")
    for ax, c in zip(axes[:, 0], names, strict=True):
        ax.set_ylabel(style.axis_label(c, next((r for r in shown if c in r.units), None)))
    axes[0, 0].figure.align_ylabels(axes[:, 0])
    return axes


@style.styled
def plot_fit(result: Any, *, before: Any = None) -> np.ndarray:
    """Draw measured and model over time, and below each channel the residual with the band of the noise.

    Parameters
    ----------
    result : Fit, Evaluation or sequence of Simulation
        An `Evaluation` shows records that the fit never saw.
    before : Fit or Evaluation, optional
        Of the same records; its curves are drawn thin, to see what changed.

    Returns
    -------
    ndarray of Axes, shape (2·channels, runs)
        At most three runs; the band is ±2 standard deviations of the noise.

    Examples
    --------
    >>> axes = mi.plot_fit(better, before=fit)
    """
    return _drawn(_simulations(result), before)[0]


class LiveFit:
    """The figure of `plot_fit` as a PNG that follows its model fast: only what moves is drawn again."""

    @style.styled
    def __init__(self, result: Any, *, before: Any = None) -> None:
        with style.detached():
            self.axes, self._moving = _drawn(_simulations(result), before)
        figure = self.axes[0, 0].figure
        figure.set_dpi(90)
        self._canvas = FigureCanvasAgg(figure)
        self._canvas.draw()
        figure.set_layout_engine("none")
        self._artists = [a for part in self._moving for a in (part.line, part.title) if a is not None]
        for artist in self._artists:
            artist.set_animated(True)
        self._background: Any = None

    @style.styled
    def png(self, result: Any) -> bytes:
        """Return the figure with the curves of another model on the same records."""
        found, figure = _simulations(result), self._canvas.figure
        if sum(part.moved(found[part.run]) for part in self._moving) or self._background is None:
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(figure.bbox)
        self._canvas.restore_region(self._background)
        for artist in self._artists:
            artist.draw(self._canvas.get_renderer())
        buffer = io.BytesIO()
        Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert("RGB").save(buffer, "png", compress_level=1)
        return buffer.getvalue()


class _Moving(NamedTuple):
    line: Line2D
    run: int
    channel: str
    title: Text | None = None  # with the error; None for a residual

    def moved(self, s: Simulation) -> bool:
        """Put the curve where `s` has it; tell whether its axes had to take another scale."""
        ax, y = self.line.axes, s.outputs[self.channel] if self.title else s.residual(self.channel)
        assert isinstance(ax, Axes)
        if self.title:
            _error_title(ax, s, self.channel)
        self.line.set_data(*style.envelope(s.experiment.t, y))
        low, high = ax.get_ylim()
        least, most = float(np.nanmin(y)), float(np.nanmax(y))
        if low <= least and most <= high and (self.title or most - least > 0.1 * (high - low)):
            return False
        ax.relim()
        ax.autoscale_view()
        return True


def _drawn(every: list[Simulation], before: Any) -> tuple[np.ndarray, list[_Moving]]:
    """Draw, and return which curves are the model's."""
    old = _simulations(before)[:COLUMNS] if before is not None else []
    shown, moving = every[:COLUMNS], []
    names = [c for c in CHANNELS if any(c in s.outputs and c in s.experiment.outputs for s in shown)]
    axes = style.grid(2 * len(names), len(shown), row=1.0 if len(names) < 3 else 0.75, sharex="col", sharey="row",
                      height_ratios=[1.6, 1.0] * len(names))
    for k, s in enumerate(shown):
        earlier = old[k] if k < len(old) else None
        for j, c in enumerate(names):
            upper, lower = axes[2 * j:2 * j + 2, k]
            if c in s.experiment.outputs:
                moving += [_Moving(_curves(upper, s, c, earlier), k, c, _error_title(upper, s, c)),
                           _Moving(_residual(lower, s, c, earlier), k, c)]
                axes[2 * j, 0].set_ylabel(style.axis_label(c, s.experiment))
                axes[2 * j + 1, 0].set_ylabel(f"residual\n({s.experiment.units[c]})")
            else:
                _absent(upper, c)
                lower.set_axis_off()
        axes[0, k].set(title=_run_title(s.experiment, k, [e.experiment for e in every]))
        axes[-1, k].set(xlabel="time (s)")
    axes[0, 0].figure.align_ylabels(axes[:, 0])
    entries = (a + b for a, b in zip(*(ax.get_legend_handles_labels() for ax in axes[:2, 0]), strict=True))
    axes[0, 0].figure.legend(*entries, loc="outside upper left", ncols=5)
    return axes, moving


def _curves(ax: Axes, s: Simulation, channel: str, old: Simulation | None) -> Line2D:
    y = s.experiment.outputs[channel]
    style.line(ax, s.experiment.t, y, color=style.MEASURED, lw=3.2, alpha=0.5, label="measured")
    if old is not None and channel in old.outputs:
        style.line(ax, s.experiment.t, old.outputs[channel], color=style.PALETTE["yellow"], lw=1.0, label="before")
    return style.line(ax, s.experiment.t, s.outputs[channel], color=style.MODEL, lw=1.2, label="model")


def _error_title(ax: Axes, s: Simulation, channel: str) -> Text:
    return ax.set_title(f"NRMSE {percent(judge([s]).nrmse[channel])}", loc="right", fontsize=8, color=style.MUTED)


def _residual(ax: Axes, s: Simulation, channel: str, old: Simulation | None) -> Line2D:
    sigma = s.experiment.sigma.get(channel) or noise_level(s.experiment.outputs[channel], s.experiment.t)
    style.band(ax, 2 * sigma, "noise, ±2σ")
    if old is not None and channel in old.outputs:
        style.line(ax, s.experiment.t, old.residual(channel), color=style.PALETTE["yellow"], lw=0.8)
    return style.line(ax, s.experiment.t, s.residual(channel), color=style.RESIDUAL, lw=0.9, label="residual")


def _simulations(result: Any) -> list[Simulation]:
    found = ([result] if isinstance(result, Simulation) else result if isinstance(result, list | tuple) else
             getattr(result, "simulations", None))
    if not found or not all(isinstance(s, Simulation) for s in found):
        raise UsageError("plot_fit takes a fit, mi.evaluate(fit, runs) or mi.simulate(model, runs); "
                         f"got {type(result).__name__}.")
    return list(found)


def _run_title(run: Experiment, k: int, every: Sequence[Experiment]) -> str:
    more = len(every) - COLUMNS
    return style.short(run.name) + f"   (and {more} more not shown)" * (more > 0 and k == COLUMNS - 1)


def _absent(ax: Axes, channel: str) -> None:
    ax.text(0.5, 0.5, f"{channel} not measured", transform=ax.transAxes, ha="center", va="center", color=style.MUTED)
    ax.grid(visible=False)


@style.styled
def plot_parameters(*results: Any, truth: Mapping[str, float] | None = None,
                    names: Sequence[str] | None = None) -> np.ndarray:
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

    Examples
    --------
    >>> axes = mi.plot_parameters(fit, better)
    """
    fits = _fits(results)
    chosen = list(names or dict.fromkeys(n for f in fits for n, p in f.model.parameters.items() if p.vary))
    for name in chosen:
        among(name, dict.fromkeys(n for f in fits for n in f.values), "parameter")
    columns = {6: 3, 7: 4, 8: 4}.get(len(chosen), min(len(chosen), 5) or 1)
    axes = style.panels(len(chosen), columns, row=1.75, width=style.WIDTH * max(columns, 3) / 5)
    for ax, name in zip(axes, chosen, strict=True):
        _one_parameter(ax, fits, name, (truth or {}).get(name))
    notes = [f"{k + 1}: {what_changed(f, fits[k - 1] if k else None)}" for k, f in enumerate(fits)]
    notes += ["dashed: true value"] * bool(truth) + ["bars: ±2σ"]
    axes[0].figure.supxlabel("   ·   ".join(notes), fontsize=8, color=style.MUTED)
    return axes


def _one_parameter(ax: Axes, fits: Sequence[Any], name: str, truth: float | None) -> None:
    known = [k for k, f in enumerate(fits) if name in f.values]
    parameter = fits[known[-1]].model.parameters[name]
    if parameter.periodic and truth is not None:  # the same angle, some turns further
        truth += 2 * np.pi * round((fits[known[-1]].values[name] - truth) / (2 * np.pi))
    values = np.array([fits[k].values[name] for k in known] + ([] if truth is None else [truth]))
    power = style.decade(float(np.max(np.abs(values))))
    if truth is not None:
        ax.axhline(truth / 10.0**power, color=style.PALETTE["green"], lw=1.2, ls=(0, (4, 2)))
    for k in known:
        value, std, colour = fits[k].values[name], fits[k].std.get(name), style.CYCLE[k % len(style.CYCLE)]
        ax.errorbar(k + 1, value / 10.0**power, yerr=2 * (std or 0.0) / 10.0**power, fmt="o", ms=5,
                    capsize=3 if std else 0, lw=1.4, color=colour, mfc="none" if std is None else colour)
    ax.set(xlim=(0.4, len(fits) + 0.6), xticks=range(1, len(fits) + 1))
    values = values / 10.0**power
    low, high = ax.get_ylim()
    least = 0.1 * float(np.max(np.abs(values))) or 1.0
    if high - low < least:  # a change of a thousandth must not look like a leap
        middle = float(values.min() + values.max()) / 2
        ax.set_ylim(middle - least / 2, middle + least / 2)
    for k in (k for k in known if fits[k].std.get(name) is None):
        y = fits[k].values[name] / 10.0**power
        below = y > sum(ax.get_ylim()) / 2  # above it may be the title
        ax.annotate("not\ndetermined", (k + 1, y), (0, -6 if below else 6), textcoords="offset points", ha="center",
                    va="top" if below else "bottom", fontsize=7, color=style.MUTED)
    ax.set(title=style.scaled_title(name, parameter.unit, power))
    ax.grid(axis="x", visible=False)


def what_changed(fit: Any, previous: Any) -> str:
    """Return which effects a fit has that the previous one had not, and the other way round; of the first, its own."""
    names = fit.model.effect_names
    if previous is None:
        return " + ".join(["plain motor" if fit.model.base == "dc_motor" else "plain drive", *names])
    before = previous.model.effect_names
    changes = [f"+ {n}" for n in names if n not in before] + [f"− {n}" for n in before if n not in names]
    return " ".join(changes) or {"penalty": "penalties", "hard": "hard constraints"}.get(fit.formulation, "again")


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
    if (limit := limit or next((c.limit for c in relations if isinstance(c, CurrentLimit)), None)) is None:
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
        top.set(title=style.short(fits[0].simulations[k].experiment.name))
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
    if not (near := np.max([np.abs(s.outputs["i"]) for s in simulations], axis=0) > NEAR * limit).any():
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
    if not (points := [(p.weight, 100 * p.distance) for p in result.path if p.distance > 0]):
        ax.text(0.5, 0.5, "no path", transform=ax.transAxes, ha="center", color=style.MUTED)
        return
    ax.loglog(*zip(*points, strict=True), "o-", ms=4, color=style.CYCLE[1])
    style.plain_decades(ax)

"""One restrained style for all figures: colours, labels, sizes, decimation that keeps peaks; figures as PNG and SVG."""

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from html import escape
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from motorid.channels import NAMES, SYMBOLS, UNITS, channel_name
from motorid.display.numbers import number, raised
from motorid.errors import UsageError, arguments_told
from motorid.numerics.signals import Array
from motorid.records.experiment import Experiment

_P = ParamSpec("_P")
_R = TypeVar("_R")

INK, MUTED, FAINT, PAPER = "#1f2328", "#59636e", "#d1d9e0", "#ffffff"
# Okabe & Ito, "Color universal design", 2008: distinct to all common kinds of colour vision.
PALETTE = {"blue": "#0072b2", "orange": "#d55e00", "green": "#009e73", "purple": "#a4507d", "yellow": "#b98500",
           "grey": "#7a848e"}
CYCLE = (*(PALETTE[c] for c in ("blue", "orange", "green", "purple", "yellow")), INK, PALETTE["grey"])
MEASURED, MODEL, RESIDUAL = PALETTE["grey"], PALETTE["blue"], PALETTE["orange"]
# Colours of a figure become variables of the page, so that a dark page has a dark figure.
VARIABLES = {INK: "ink", MUTED: "muted", FAINT: "line", PAPER: "paper", **{c: n for n, c in PALETTE.items()}}
WIDTH = 9.2  # inches: the text width of a notebook
POINTS = 1200  # drawn per curve at most: more than a page has pixels for it

STYLE: Mapping[Any, Any] = {
    "font.family": ["DejaVu Sans"], "font.size": 9, "figure.titlesize": 10, "axes.titlesize": 9, "axes.labelsize": 9,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "legend.fontsize": 8, "legend.frameon": False,
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7,
    "axes.grid": True, "axes.axisbelow": True, "grid.color": FAINT, "grid.linewidth": 0.6, "lines.linewidth": 1.3,
    "text.color": INK, "axes.labelcolor": INK, "axes.titlecolor": INK, "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "axes.edgecolor": MUTED, "xtick.color": MUTED, "ytick.color": MUTED, "axes.prop_cycle": cycler(color=CYCLE),
    "figure.facecolor": PAPER, "axes.facecolor": PAPER, "savefig.facecolor": PAPER, "figure.dpi": 100,
    "savefig.dpi": 150, "svg.fonttype": "none", "axes.formatter.useoffset": False, "axes.formatter.limits": (-4, 5),
    "text.parse_math": False, "axes.unicode_minus": True, "axes.xmargin": 0.02}

_detached: ContextVar[bool] = ContextVar("motorid_detached_figures", default=False)


def styled(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    """Draw in motorid's style and leave the user's own settings as they were; say which argument is wrong."""

    @wraps(draw)
    def inner(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not _detached.get():
            import matplotlib.pyplot as plt

            plt.draw_if_interactive()  # loads the backend: inside the context its set-up would be undone
        with mpl.rc_context(dict(STYLE)):
            return draw(*args, **kwargs)

    return arguments_told(inner)


@contextmanager
def detached() -> Iterator[None]:
    """Make figures that belong to no window and that nobody has to close (for files)."""
    token = _detached.set(True)
    try:
        yield
    finally:
        _detached.reset(token)


def refuse_other(result: object, kind: type, takes: str) -> None:
    """Refuse a result that is not of the `kind` that a figure draws; `takes` says which figure takes what."""
    if not isinstance(result, kind):
        raise UsageError(f"{takes}, got {type(result).__name__}.")


def refuse_index(run: int | None, runs: int) -> None:
    """Refuse the number of a run that is not there."""
    if not 0 <= (run or 0) < runs:
        raise UsageError(f"the fit has {runs} runs, numbered from 0; got run={run}.")


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, laid out so that labels do not overlap."""
    if _detached.get():
        return Figure(figsize=(width, height), layout="constrained")
    import matplotlib.pyplot as plt

    return plt.figure(figsize=(width, height), layout="constrained")


def png_of(axes: Any) -> bytes:
    """Return the figure of some axes as a PNG."""
    buffer = io.BytesIO()
    figure = np.ravel(np.asarray(axes, object))[0].figure
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": "motorid"})
    return buffer.getvalue()


def svg_of(draw: Callable[..., Any], *args: Any, name: str, alt: str, **options: Any) -> str:
    """Return what `draw`, e.g. `plot_fit`, shows as inline ``<svg>``; `name` begins names inside; `alt` says it."""
    with detached():
        figure = np.ravel(np.asarray(draw(*args, **options), object))[0].figure
    if (engine := figure.get_layout_engine()) is not None:
        for _ in range(2):  # in another size there may be other ticks; and not again while saving
            engine.execute(figure)
        figure.set_layout_engine("none")
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, dpi=120, metadata={"Date": None, "Creator": None})
    return _cleaned(buffer.getvalue(), name, alt)


def _cleaned(svg: str, name: str, alt: str) -> str:
    """Return the ``<svg>`` element alone, shortened, with colours as variables and unique names."""
    svg = svg[svg.index("<svg"):]
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", svg, flags=re.S)
    svg = re.sub(r"<defs>\s*</defs>", "", svg)
    used = set(re.findall(r'(?:url\(#|xlink:href="#)([^)"]+)', svg))
    svg = re.sub(r'\sid="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used else "", svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", svg)
    svg = re.sub(r'xlink:href="#([^"]+)"', rf'href="#{name}-\1"', svg).replace("xlink:href", "href")
    # coordinates, which stand inside tags, to a tenth of a point
    svg = re.sub(r"<[^>]+>", lambda tag: re.sub(r"(\d+\.\d)\d{2,}", r"\1", tag[0]), svg)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var(--{variable})")
    svg = svg.replace("font-family: 'DejaVu Sans'", "font-family: var(--font)")
    head, body = re.sub(r"\n\s*", "\n", svg).split(">", 1)
    view = head.partition('viewBox="')[2].partition('"')[0]
    return f'<svg viewBox="{view}" role="img" aria-label="{escape(alt)}">{body.strip()}'


def grid(rows: int, columns: int, *, row: float = 1.6, width: float = WIDTH, **options: Any) -> np.ndarray:
    """Return axes (rows, columns) on a new figure; `row` is the height of a row in inches."""
    if not rows * columns:
        raise UsageError("there is nothing to draw: every parameter is fixed; free some with model.free(…).")
    total = row * sum(options.get("height_ratios", [1.0] * rows))
    return new_figure(width, total + 0.35).subplots(rows, columns, squeeze=False, **options)


def panels(n: int, columns: int, **options: Any) -> np.ndarray:
    """Return `n` axes in rows of so many columns on a new figure, see `grid`; what is left of the last row is blank."""
    axes = grid(-(-n // columns), columns, **options).ravel()
    for ax in axes[n:]:
        ax.set_axis_off()
    return axes[:n]


def only(ax: Axes | None, *, width: float = 5.6, height: float = 3.2) -> Axes:
    """Return `ax`, or the axes of a new figure."""
    return ax if ax is not None else new_figure(width, height).subplots()


def axis_label(channel: str, run: Experiment | None = None) -> str:
    """Return a label with its unit: ``speed ω (rad/s)``."""
    if channel == "heat":
        return "heat in the winding (J)"
    if channel not in NAMES:
        return channel
    unit = UNITS[channel][0] if run is None else run.units.get(channel, UNITS[channel][0])
    symbol = {"m": "x", "m/s": "v"}.get(unit, SYMBOLS[channel])
    name = ("time" if channel == "t" else "command u" if channel == "v" and unit != "V" else
            f"{channel_name(channel, unit)} {symbol}")
    return f"{name} ({unit})" if unit != "1" else name


def envelope(x: Array, y: Array) -> tuple[Array, Array]:
    """Return fewer points whose line looks the same, lowest and highest of each stretch: peaks and gaps stay."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if len(x) <= POINTS:
        return x, y
    width = -(-2 * len(x) // POINTS)
    blocks = np.pad(y, (0, -len(y) % width), constant_values=np.nan).reshape(-1, width)
    start = width * np.arange(len(blocks))
    missing = ~np.isfinite(blocks)
    lowest = start + np.argmin(np.where(missing, np.inf, blocks), axis=1)
    highest = start + np.argmax(np.where(missing, -np.inf, blocks), axis=1)
    gaps = start[missing.any(axis=1)] + np.argmax(missing[missing.any(axis=1)], axis=1)
    index = np.unique(np.concatenate([lowest, highest, gaps, [0, len(x) - 1]]))
    index = index[index < len(x)]
    return x[index], y[index]


def line(ax: Axes, x: Array, y: Array, *, zoh: bool = False, **options: Any) -> Line2D:
    """Draw a curve, decimated without hiding its peaks; with `zoh` as a staircase."""
    a, b = envelope(x, y)
    return ax.plot(a, b, drawstyle="steps-post" if zoh and len(x) <= POINTS else "default", **options)[0]


def band(ax: Axes, half: float, label: str | None = None) -> None:
    """Shade ±half around zero."""
    ax.axhspan(-half, half, color=MUTED, alpha=0.16, lw=0, label=label, zorder=0)


def plain_decades(ax: Axes) -> None:
    """Write the ticks of a logarithmic axis as plain numbers, with some in between where there is room."""
    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 200 * low else (1,)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: number(v, 1).removeprefix("1·")))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(which="minor", visible=False)
    ax.tick_params(which="minor", color=FAINT)


def short(name: str, most: int = 28) -> str:
    """Return the name of a run with its middle left out where it would run over its neighbours."""
    return name if len(name) <= most else f"{name[:most // 2]}…{name[-(most // 2):]}"


def decade(size: float) -> int:
    """Return the power of ten to take out of numbers of this size; 0 where they read well as they are."""
    power = int(np.floor(np.log10(size))) if size > 0 and np.isfinite(size) else 0
    return 0 if -3 < power < 5 else 3 * (power // 3)


def scaled_title(name: str, unit: str, power: int = 0) -> str:
    """Return ``L (10⁻³ H)``."""
    inside = " ".join(w for w in (f"10{raised(power)}" if power else "", unit) if w)
    return f"{name} ({inside})" if inside else name

"""A figure as an inline ``<svg>`` element of a page."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from html import escape
from typing import Any

import matplotlib as mpl
import numpy as np

from motorid.plots.style import FAINT, INK, MUTED, PALETTE, PAPER, detached

# Colours of a figure become variables of the page, so that a dark page has a dark figure.
VARIABLES = {INK: "ink", MUTED: "muted", FAINT: "line", PAPER: "paper", **{c: n for n, c in PALETTE.items()}}


def svg_of(draw: Callable[..., Any], *args: Any, name: str, alt: str, **options: Any) -> str:
    """Draw with one of the plot functions and return an inline ``<svg>`` element.

    Parameters
    ----------
    draw : callable
        E.g. `plot_fit`; called with `args` and `options`.
    name : str
        Prefix of the names inside, unique on the page.
    alt : str
        What the figure shows, for those who cannot see it.
    """
    with detached():
        drawn = draw(*args, **options)
    figure = np.atleast_1d(np.asarray(drawn, object)).ravel()[0].figure
    engine = figure.get_layout_engine()
    if engine is not None:  # once, and not again while saving
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
    svg = re.sub(r"<[^>]+>", _shortened, svg)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var(--{variable})")
    svg = svg.replace("font-family: 'DejaVu Sans'", "font-family: var(--font)")
    svg = re.sub(r"\n\s*", "\n", svg)
    box = re.search(r'viewBox="([^"]+)"', svg)
    body = svg[svg.index(">") + 1:]
    view = box[1] if box else "0 0 600 400"
    return f'<svg viewBox="{view}" role="img" aria-label="{escape(alt)}">{body.strip()}'


def _shortened(tag: re.Match[str]) -> str:
    """Round coordinates, which stand inside tags, to a tenth of a point; words outside are left alone."""
    return re.sub(r"(\d+\.\d)\d{2,}", r"\1", tag[0])

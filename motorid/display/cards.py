"""Cards: what a result shows of itself. `Shown` gives every result its card in a notebook and its line anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from motorid.display.tables import Flag, Table

_STYLE = """
.motorid{font-size:13px;line-height:1.45;max-width:60rem}
.motorid table{border-collapse:collapse;margin:.5em 0 .5em 0;font-variant-numeric:tabular-nums}
.motorid caption{text-align:left;padding:.2em 0}
.motorid table th,.motorid table td{text-align:left!important;padding:.2em .9em .2em 0}
.motorid table th,.motorid table td{border-bottom:1px solid rgba(128,128,128,.35)}
.motorid thead th{border-bottom:2px solid rgba(128,128,128,.6);font-weight:600}
.motorid tbody th{font-weight:600}
.motorid .flag{border-radius:.7em;padding:.05em .6em;font-size:12px;font-weight:600;white-space:nowrap}
.motorid .muted{opacity:.75}
.motorid p{margin:.35em 0}
"""


@dataclass(frozen=True)
class Card:
    """What a result shows.

    Attributes
    ----------
    title : str
    flags : sequence of Flag
        The verdict in a word or two.
    text : sequence of str
        Sentences; empty ones are left out.
    tables : sequence of Table
    after : sequence of (str, str)
        What to do next: code, and its use.
    figure : str
        Name of the function of `motorid.plots` that draws the result, if one tells more than the tables.
    """

    title: str
    flags: Sequence[Flag] = ()
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    after: Sequence[tuple[str, str]] = ()
    figure: str = ""

    @property
    def line(self) -> str:
        """Title and flags in one line."""
        return ", ".join([self.title, *(f.text for f in self.flags)])

    def __str__(self) -> str:
        head = "\n".join([self.line, *(t for t in self.text if t)])
        return "\n\n".join([head, *(str(t) for t in self.tables)])

    def to_html(self) -> str:
        """Return HTML that stands by itself, readable on light and dark pages."""
        flags = " ".join(f.to_html() for f in self.flags)
        parts = [f'<div class="motorid">\n<style>{_STYLE}</style>',
                 f"<p><strong>{escape(self.title)}</strong> {flags}</p>"]
        parts += [f"<p>{escape(t)}</p>" for t in self.text if t]
        parts += [t.to_html() for t in self.tables]
        if self.after:
            steps = " · ".join(f"{escape(what)}: <code>{escape(code)}</code>" for code, what in self.after)
            parts.append(f'<p class="muted">Next: {steps}</p>')
        return "\n".join([*parts, "</div>"])


class Shown:
    """Base of results: each writes its own `card`, shown in a notebook, in a report and as one line anywhere.

    Nothing is computed to show a result. Dataclasses need ``repr=False`` to keep the line.
    """

    def card(self) -> Card:
        """Return what the result shows of itself."""
        return Card(type(self).__name__)

    def _repr_html_(self) -> str:
        return self.card().to_html()

    def __repr__(self) -> str:
        return f"<{self.card().line}>"


class Printed(Shown):
    """Base of results whose whole card is what `print` shows."""

    def __str__(self) -> str:
        return str(self.card())

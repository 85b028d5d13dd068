"""HTML for notebooks: one helper for every `_repr_html_`. It only writes down what a result already holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

# Words first, colour second: each pair has a contrast of 5.5 or more, on a light page and on a dark one.
_COLOURS = {
    "good": ("#0b5a26", "#d7f5df"),
    "note": ("#6b4100", "#fdf0c8"),
    "bad": ("#8f1220", "#ffe3e4"),
    "plain": ("#3a444f", "#e6eaef"),
}

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
class Flag:
    """A word with a colour: ``good``, ``note``, ``bad`` or ``plain``."""

    text: str
    mood: str = "plain"

    def __contains__(self, part: str) -> bool:
        return part in self.text


@dataclass(frozen=True)
class Table:
    """Rows under headers; the first cell of a row names it. Cells are text or flags."""

    header: Sequence[str]
    rows: Sequence[Sequence[str | Flag]]
    caption: str = ""


@dataclass(frozen=True)
class Card:
    """What a result shows: title, flags, sentences, tables, what to do next (code and its use), its plot."""

    title: str
    flags: Sequence[Flag] = ()
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    after: Sequence[tuple[str, str]] = ()
    figure: str = ""


def html_of(result: object) -> str:
    """Return the HTML of any result of motorid."""
    from motorid.display._cards import card_of

    return render(card_of(result))


def line_of(result: object) -> str:
    """Return the one line that stands for a result in plain text."""
    from motorid.display._cards import card_of

    card = card_of(result)
    return f"<{', '.join([card.title, *(f.text for f in card.flags)])}>"


def render(card: Card) -> str:
    """Return a card as HTML that stands by itself, readable on light and dark pages."""
    flags = " ".join(render_flag(f) for f in card.flags)
    parts = [
        f'<div class="motorid">\n<style>{_STYLE}</style>',
        f"<p><strong>{escape(card.title)}</strong> {flags}</p>",
    ]
    parts += [f"<p>{escape(t)}</p>" for t in card.text if t]
    parts += [render_table(t) for t in card.tables]
    if card.after:
        steps = " · ".join(f"{escape(what)}: <code>{escape(code)}</code>" for code, what in card.after)
        parts.append(f'<p class="muted">Next: {steps}</p>')
    return "\n".join([*parts, "</div>"])


def render_flag(flag: Flag) -> str:
    """Return a flag as a small pill."""
    ink, paper = _COLOURS[flag.mood]
    return f'<span class="flag" style="color:{ink};background:{paper}">{escape(flag.text)}</span>'


def render_table(table: Table) -> str:
    """Return a table with its headers marked as such."""
    head = "".join(f'<th scope="col">{escape(h)}</th>' for h in table.header)
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    rows = "\n".join(_row(r) for r in table.rows)
    return f"<table>{caption}\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody></table>"


def _row(cells: Sequence[str | Flag]) -> str:
    texts = [render_flag(c) if isinstance(c, Flag) else escape(c) for c in cells]
    rest = "".join(f"<td>{t}</td>" for t in texts[1:])
    return f'<tr><th scope="row">{texts[0]}</th>{rest}</tr>'

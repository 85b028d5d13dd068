"""One table for terminals, notebooks and reports: laid out as text by `str`, as HTML by `to_html`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from motorid.display.numbers import with_error

# Words first, colour second: each pair has a contrast of 5.5 or more, on a light page and on a dark one.
COLOURS = {
    "good": ("#0b5a26", "#d7f5df"),
    "note": ("#6b4100", "#fdf0c8"),
    "bad": ("#8f1220", "#ffe3e4"),
    "plain": ("#3a444f", "#e6eaef"),
}


@dataclass(frozen=True)
class Flag:
    """A word with a colour: ``good``, ``note``, ``bad`` or ``plain``."""

    text: str
    mood: str = "plain"

    def __contains__(self, part: str) -> bool:
        return part in self.text

    def __str__(self) -> str:
        return self.text

    def to_html(self) -> str:
        """Return the word as a small pill."""
        ink, paper = COLOURS[self.mood]
        return f'<span class="flag" style="color:{ink};background:{paper}">{escape(self.text)}</span>'


Cell = str | Flag


@dataclass(frozen=True)
class Table:
    """Rows under headers; the first cell of a row names it.

    Attributes
    ----------
    header : sequence of str
    rows : sequence of sequences of str or Flag
    title : str
        Above the text; a page has headings of its own.
    note : str
        Below the text, and the caption on a page.
    left : tuple of int
        Columns of words, flush left in the text.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    note: str = ""
    left: tuple[int, ...] = (0,)

    def __str__(self) -> str:
        lines = [tuple(self.header), *(tuple(str(cell) for cell in row) for row in self.rows)]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.header))]
        body = ["  ".join(cell.ljust(w) if k in self.left else cell.rjust(w)
                          for k, (cell, w) in enumerate(zip(line, widths, strict=True))).rstrip()
                for line in lines]
        body.insert(1, "  ".join("─" * w for w in widths))
        return "\n".join([part for part in (self.title, *body, self.note) if part])

    def to_html(self) -> str:
        """Return the table with its headers marked as such."""
        head = "".join(f'<th scope="col">{escape(h)}</th>' for h in self.header)
        caption = f"<caption>{escape(self.note)}</caption>" if self.note else ""
        rows = "\n".join(_row(r) for r in self.rows)
        return f"<table>{caption}\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody></table>"


def _row(cells: Sequence[Cell]) -> str:
    texts = [c.to_html() if isinstance(c, Flag) else escape(c) for c in cells]
    rest = "".join(f"<td>{t}</td>" for t in texts[1:])
    return f'<tr><th scope="row">{texts[0]}</th>{rest}</tr>'


def value_cell(value: float, std: float | None, unit: str = "", why: str = "not determined") -> Cell:
    """Return a value with its standard deviation, flagged with the reason where it has none."""
    text = with_error(value, std, unit, why)
    return Flag(text, "note") if std is None else text

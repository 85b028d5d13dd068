"""Tables and cards: what a result shows of itself, as text and as HTML."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

from motorid.display.numbers import with_error

STYLE = Path(__file__).with_name("templates") / "card.css"
# Words first, colour second: each pair has a contrast of 5.5 or more, on a light page and on a dark one.
COLOURS = {"good": ("#0b5a26", "#d7f5df"), "note": ("#6b4100", "#fdf0c8"), "bad": ("#8f1220", "#ffe3e4"),
           "plain": ("#3a444f", "#e6eaef")}
WIDE, SENTENCE = 5, 32  # columns that a phone has room for; characters of a cell beyond a name or a number


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
    """Rows under headers; the first cell of a row names it."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    title: str = ""  # above the text; a page has headings of its own
    note: str = ""  # below the text, and the caption on a page
    left: tuple[int, ...] = (0,)  # columns of words, flush left in the text

    def __str__(self) -> str:
        lines = [tuple(self.header), *(tuple(str(cell) for cell in row) for row in self.rows)]
        widths = [max(len(line[k]) for line in lines) for k in range(len(self.header))]
        body = ["  ".join(cell.ljust(w) if k in self.left else cell.rjust(w)
                          for k, (cell, w) in enumerate(zip(line, widths, strict=True))).rstrip() for line in lines]
        body.insert(1, "  ".join("─" * w for w in widths))
        return "\n".join([part for part in (self.title, *body, self.note) if part])

    def turned(self) -> "Table":
        """Return the table with rows and columns exchanged."""
        header, *rows = zip(self.header, *self.rows, strict=True)
        return replace(self, header=header, rows=rows, left=(0,))

    @property
    def on_page(self) -> "Table":
        """The table as a page shows it: turned where it would be wider than a phone, and has few rows."""
        return self.turned() if len(self.header) > WIDE > len(self.rows) else self

    @property
    def wordy(self) -> bool:
        """Whether the last column holds sentences: a narrow page shows it below the others."""
        return len(self.header) > 2 and any(len(str(row[-1])) > SENTENCE for row in self.rows)

    def to_html(self) -> str:
        """Return the table with its headers marked as such."""
        shown = self.on_page
        head = "".join(f'<th scope="col">{escape(str(h))}</th>' for h in shown.header)
        caption = f"<caption>{escape(self.note)}</caption>" if self.note else ""
        cells = ([c.to_html() if isinstance(c, Flag) else escape(c) for c in r] for r in shown.rows)
        rows = "\n".join(f'<tr><th scope="row">{name}</th>' + "".join(f"<td>{t}</td>" for t in rest) + "</tr>"
                         for name, *rest in cells)
        table = '<table class="wordy">' if shown.wordy else "<table>"
        return (f'<div class="scroll">{table}{caption}\n<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n'
                "</tbody></table></div>")


def value_cell(value: float, std: float | None, unit: str = "", why: str = "not determined") -> Cell:
    """Return a value with its standard deviation, flagged with the reason where it has none."""
    text = with_error(value, std, unit, why)
    return Flag(text, "note") if std is None else text


@dataclass(frozen=True)
class Card:
    """What a result shows."""

    title: str
    flags: Sequence[Flag] = ()  # the verdict in a word or two
    text: Sequence[str] = ()  # sentences; empty ones are left out
    tables: Sequence[Table] = ()
    after: Sequence[tuple[str, str]] = ()  # what to do next: code, and its use
    figure: str = ""  # name of the function of `motorid.plots` that draws the result, if one tells more than the tables

    @property
    def line(self) -> str:
        """Title and flags in one line."""
        return ", ".join([self.title, *(f.text for f in self.flags)])

    def __str__(self) -> str:
        return "\n\n".join(["\n".join([self.line, *(t for t in self.text if t)]), *(str(t) for t in self.tables)])

    def to_html(self) -> str:
        """Return HTML that stands by itself, readable on light and dark pages."""
        parts = [f'<div class="motorid">\n<style>\n{STYLE.read_text("utf-8")}</style>',
                 f"<p><strong>{escape(self.title)}</strong> {' '.join(f.to_html() for f in self.flags)}</p>"]
        parts += [*(f"<p>{escape(t)}</p>" for t in self.text if t), *(t.to_html() for t in self.tables)]
        if self.after:
            steps = " · ".join(f"{escape(what)}: <code>{escape(code)}</code>" for code, what in self.after)
            parts.append(f'<p class="muted">Next: {steps}</p>')
        return "\n".join([*parts, "</div>"])


class Shown:
    """Base of results: each writes its own `card`, shown in a notebook, in a report and as one line anywhere. Nothing
    is computed to show a result. Dataclasses need ``repr=False`` to keep the line."""

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

"""How results show themselves: one line of text anywhere, a card in a notebook."""

from __future__ import annotations


class Shown:
    """Base of results; gives them `_repr_html_` and a `repr` of one line. What is in them: `_cards`.

    Nothing is computed to show a result. Dataclasses need ``repr=False`` to keep the line.
    """

    def _repr_html_(self) -> str:
        # Showing comes last in the story, so the modules that do it are imported late.
        from motorid.display.cards import html_of

        return html_of(self)

    def __repr__(self) -> str:
        from motorid.display.cards import line_of

        return line_of(self)

"""The README's table of the library, made of its effects: ``python tests/readme_table.py`` writes it there."""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path

from motorid.effects import LIBRARY

README = Path(__file__).parents[1] / "README.md"
HEAD = "| balance | effect | what it is | parameters |\n|---|---|---|---|\n"
TABLE = re.compile(re.escape(HEAD) + r"(?:\|.*\n)+")


def library_table() -> str:
    """Return the table: what the first sentence of each effect says, and its parameters."""
    rows = []
    for balance, effects in groupby(LIBRARY.values(), key=lambda e: e.balance):
        for k, e in enumerate(effects):
            what = re.split(r"\.(?: |$)", e.doc, maxsplit=1)[0]
            rows.append(f"| {'' if k else balance} | `{e.name}` | {what} | {', '.join(p.name for p in e.parameters)} |")
    return HEAD + "\n".join(rows) + "\n"


if __name__ == "__main__":
    README.write_text(TABLE.sub(lambda _: library_table(), README.read_text(encoding="utf-8")), encoding="utf-8")

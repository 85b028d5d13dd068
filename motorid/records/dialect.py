"""The dialect of a text table: encoding, delimiter, decimal mark, and which lines are rows of numbers."""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass

from motorid.errors import DataError

__all__ = ["MISSING", "Dialect", "decode", "is_data", "sniff"]

MISSING = frozenset(["", "nan", "na", "n/a", "null", "none", "-", "--", "---", "?", "missing", "#n/a"])
_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf)", re.IGNORECASE)
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
# Delimiter (None: white space) and decimal mark, in the order in which a tie is decided.
_DIALECTS = (("\t", "."), (";", "."), (",", "."), ("\t", ","), (";", ","), (",", ","),
             (None, "."), (None, ","))
_MAGIC = {
    b"PK\x03\x04": "an Excel or zip file; export the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel file; export the sheet as CSV",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x89HDF": "an HDF5 file; export CSV, or save from MATLAB with save(..., '-v7')",
    b"MATLAB": "a MATLAB file; give it the ending .mat",
    b"PAR1": "a Parquet file; give it the ending .parquet",
    b"%PDF": "a PDF document",
    b"\x89PNG": "a picture",
}


@dataclass(frozen=True)
class Dialect:
    """Delimiter (None: white space) and decimal mark."""

    delimiter: str | None
    decimal: str

    def cells(self, line: str) -> list[str]:
        """Split a line into stripped cells."""
        if self.delimiter is None:
            return [c.strip('"') for c in line.split()]
        if '"' not in line:
            return [c.strip() for c in line.split(self.delimiter)]
        try:
            row = next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True), [])
        except csv.Error:
            return [line]
        return [c.strip() for c in row]

    def is_number(self, cell: str) -> bool:
        """Tell whether a cell is one number in this dialect."""
        if self.decimal == ",":
            if "." in cell or cell.endswith(","):
                return False
            cell = cell.replace(",", ".")
        return _NUMBER.fullmatch(cell.replace("−", "-")) is not None


def decode(data: bytes) -> tuple[str, list[str]]:
    """Turn the bytes of a file into text, with notes on what was mended.

    Raises
    ------
    DataError
        If the file is empty, of a known other kind, or binary.
    """
    if not data.strip(b"\0 \t\r\n"):
        raise DataError("the file is empty.")
    kind = next((what for magic, what in _MAGIC.items() if data.startswith(magic)), None)
    if kind:
        raise DataError(f"it is {kind}.")
    try:
        text = data.decode(_encoding(data))
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    control = len(_CONTROL.findall(text.rstrip("\0")))
    if control > 0.003 * len(text):
        raise DataError("it is a binary file, not a text table; export it as CSV.")
    if not control and not text.endswith("\0"):
        return text, []
    return _CONTROL.sub("", text), ["removed control characters; was the logger switched off while writing?"]


def _encoding(data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    start = data[:4000]
    odd, even, half = start[1::2].count(0), start[::2].count(0), max(len(start) // 2, 1)
    if odd > 0.6 * half > even:
        return "utf-16-le"
    return "utf-16-be" if even > 0.6 * half > odd else "utf-8-sig"


def sniff(body: list[str]) -> tuple[Dialect, int]:
    """Find the dialect under which most cells are numbers, and how many cells a row has."""
    sample = body[max(0, len(body) // 2 - 20):len(body) // 2 + 20]
    best, result = 0.0, (Dialect(",", "."), 1)
    for delimiter, decimal in _DIALECTS:
        dialect = Dialect(delimiter, decimal)
        rows = [dialect.cells(line) for line in sample]
        cells = [c for row in rows for c in row if c.lower() not in MISSING]
        good = sum(map(dialect.is_number, cells))
        score = good * good / max(len(cells), 1)
        # A row ends with its last filled cell; a delimiter after that means nothing.
        widths = Counter(max((k + 1 for k, c in enumerate(row) if c), default=0) for row in rows)
        width = widths.most_common(1)[0][0]
        if score > best and width > 1:
            best, result = score, (dialect, width)
    return result


def is_data(cells: list[str], dialect: Dialect, width: int) -> bool:
    """Tell whether these cells are a row of numbers and not a header or a remark."""
    good = sum(map(dialect.is_number, cells))
    wrong = sum(not dialect.is_number(c) and c.lower() not in MISSING for c in cells)
    return good > 0 and len(cells) > 1 and good > wrong and 2 * (len(cells) - wrong) >= width

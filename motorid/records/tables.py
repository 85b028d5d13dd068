"""A table of numbers from a file: text (encoding, dialect, headers, rows; pandas parses), MATLAB or Parquet."""

import csv
import io
import json
import math
import re
import struct
import warnings
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, starmap
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from motorid.display.numbers import counted
from motorid.errors import DataError, MissingDependency, otherwise
from motorid.records.experiment import MIN_SAMPLES
from motorid.records.headers import parse_unit

_COMMENT = ("#", "%", "//")
MOST_COLUMNS = 5000
_LARGEST = 1e30  # what is larger, or infinite, was not measured
MISSING = frozenset(["", "nan", "na", "n/a", "null", "none", "-", "--", "---", "?", "missing", "#n/a"])
_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|inf)", re.IGNORECASE)
_PAIR = r"([^\W\d][^:=,;\t]*?)\s*[:=,;\t]\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan|inf)(?=[,;\s]|$)"
_NAMED, _ALL_NAMED = re.compile(_PAIR), re.compile(rf"\s*+(?:{_PAIR}\s*+[,;]?\s*+)++")
_GROUPS = {".": ",", ",": "."}  # decimal mark to what may stand between thousands
_SPACES = " '’\u00a0\u2009\u202f"  # may stand there, too
_GROUPED = {mark: rf"[-+]?[1-9]\d{{0,2}}(?:[{group}{_SPACES}]\d{{3}})+(?:\{mark}\d*)?"
            for mark, group in _GROUPS.items()}
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")
_JSON = re.compile(r'\s*(\{\s*["}]|\[\s*[\[{])')  # objects, arrays of arrays or of objects
# Delimiter (None: white space) and decimal mark, in the order in which a tie is decided.
_DIALECTS = (("\t", "."), (";", "."), (",", "."), ("\t", ","), (";", ","), (",", ","), (None, "."), (None, ","))
_MAGIC = {
    b"PK\x03\x04": "an Excel or zip file; export the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel file; export the sheet as CSV", b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x89HDF": "an HDF5 file; export CSV, or save from MATLAB with save(..., '-v7')",
    b"MATLAB": "a MATLAB file; give it the ending .mat", b"PAR1": "a Parquet file; give it the ending .parquet",
    b"%PDF": "a PDF document", b"\x89PNG": "a picture"}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_CELL, _STRUCT, _CHAR, _NUMBERS = 1, 2, 4, range(6, 16)
_DEEPEST = 20
MOST_UNPACKED = 512_000_000  # bytes
Element = tuple[int, bytes]


@dataclass(frozen=True)
class TextTable:
    """A file as columns, of which no one has said yet what they mean."""

    columns: Mapping[str, NDArray[np.float64]]  # (N,) numbers, NaN where a cell is missing
    texts: Mapping[str, Sequence[object]] = field(default_factory=dict)  # columns that are no numbers
    labels: Sequence[str] = ()  # all columns in the order of the file
    unit_row: Mapping[str, str] = field(default_factory=dict)  # column to unit, from the row below the header
    comments: Sequence[str] = ()
    notes: Sequence[str] = ()


def parse_table(data: bytes) -> TextTable:
    """Read a table of numbers from the bytes of a text file. Delimiter, decimal mark, encoding, comment lines, header
    and row of units are found out. Without a header the columns are called "1", "2", ..."""
    text, notes = decode(data)
    lines = [line for line in re.split(r"\r\n|\r|\n", text) if line.strip()]
    comments = [line.strip() for line in lines if line.lstrip().startswith(_COMMENT)]
    body = [line for line in lines if not line.lstrip().startswith(_COMMENT)]
    body = [b[:-1] if (b := row.rstrip()).endswith(";") and ";" not in b[:-1] and {*b} & {*",\t "} else row
            for row in body]  # what ends a statement, and no cell
    if not (body := body and _unnamed(body, notes)):
        raise DataError("it holds no rows" + (", only comments." if comments else "; the file is empty."))
    if (cells := len(re.findall(r"[\t;, ]+", body[len(body) // 2]))) > MOST_COLUMNS:
        raise DataError(f"a row has about {cells} cells; at most {MOST_COLUMNS} columns are read. Is there one row per "
                        "sample?")
    if _JSON.match(text) and (_is_json(text) or all(map(_is_json, body[:2]))):
        raise DataError("it is JSON, not a table. Write it as CSV: a row of names, then one row per sample.")
    dialect, width = sniff(body)
    words = not dialect.is_number(dialect.cells(body[len(body) // 2])[0])  # begin a row, not one of a header
    first = next((k for k, cells in enumerate(map(dialect.cells, body)) if is_data(cells, dialect, width) and (
        words or dialect.is_number(cells[0]) or cells[0].lower() in MISSING)), None)
    if first is None:
        raise DataError(f"it has no rows of at least two numbers; it begins with '{body[0][:60]}'. Expected "
                        "one row per sample, with a comma, semicolon, tab or space between the values.")
    labels, unit_row = _header(body[:first], comments, dialect, width, notes)
    columns, texts = _parse(_rows(body[first:], dialect, len(labels), notes), dialect, labels, notes)
    return TextTable(columns, texts, labels, dict(zip(labels, unit_row, strict=False)), comments, notes)


def _unnamed(body: list[str], notes: list[str]) -> list[str]:
    """Return rows of names and numbers in turn (``t,0.1,speed,3.2`` or ``t:0.1``) as a table, others as they are."""
    sample = next((line for line in body[len(body) // 4::max(len(body) // 4, 1)] if _ALL_NAMED.fullmatch(line)), "")
    if not sample:
        return body
    names = [name.strip() for name, _ in _NAMED.findall(sample)]
    pairs = [_NAMED.findall(line) if _ALL_NAMED.fullmatch(line) else [] for line in body]
    rows = [";".join(value for _, value in row) for row in pairs if [name.strip() for name, _ in row] == names]
    if len(names) < 2 or len(rows) <= len(body) / 2:
        return body
    if len(rows) < len(body):
        notes.append(f"left out {counted(len(body) - len(rows), 'line')} without {', '.join(names)}.")
    return [";".join(unique_labels(names)), *rows]


def _is_json(text: str) -> bool:
    return otherwise(False, ValueError, lambda: isinstance(json.loads(text), dict | list))


def decode(data: bytes) -> tuple[str, list[str]]:
    """Turn the bytes of a file into text, with notes on what was mended."""
    if not data.strip(b"\0 \t\r\n"):
        raise DataError("the file is empty.")
    for magic, what in _MAGIC.items():
        if data.startswith(magic):
            raise DataError(f"it is {what}.")
    start = data[:4000]
    odd, even, half = start[1::2].count(0), start[::2].count(0), max(len(start) // 2, 1)
    encoding = ("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-16-le" if odd > 0.6 * half > even else
                "utf-16-be" if even > 0.6 * half > odd else "utf-8-sig")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if (control := len(_CONTROL.findall(text.rstrip("\0")))) > 0.003 * len(text):
        raise DataError("it is a binary file, not a text table; export it as CSV.")
    if not control and not text.endswith("\0"):
        return text, []
    return _CONTROL.sub("", text), ["removed control characters; was the logger switched off while writing?"]


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
        cells = csv.reader([line], delimiter=self.delimiter, skipinitialspace=True)
        return otherwise([line], csv.Error, lambda: [c.strip() for c in next(cells, [])])

    def is_number(self, cell: str) -> bool:
        """Tell whether a cell is one number in this dialect."""
        if self.decimal == ",":
            if "." in cell or cell.endswith(","):
                return False
            cell = cell.replace(",", ".")
        return _NUMBER.fullmatch(cell.replace("−", "-")) is not None


def sniff(body: list[str]) -> tuple[Dialect, int]:
    """Find the dialect under which most cells are numbers, and how many cells a row has."""
    sample = body[max(0, len(body) // 2 - 20):len(body) // 2 + 20]
    best, result = 0.0, (Dialect(",", "."), 1)
    for dialect in starmap(Dialect, _DIALECTS):
        rows = [dialect.cells(line) for line in sample]
        cells = [c for row in rows for c in row if c.lower() not in MISSING]
        good = sum(map(dialect.is_number, cells))
        score = good * good / max(len(cells), 1)
        # A row ends with its last filled cell; a delimiter after that means nothing.
        width = Counter(max((k + 1 for k, c in enumerate(row) if c), default=0) for row in rows).most_common(1)[0][0]
        if score > best and width > 1:
            best, result = score, (dialect, width)
    return result


def is_data(cells: list[str], dialect: Dialect, width: int) -> bool:
    """Tell whether these cells are a row of numbers and not a header or a remark."""
    good = sum(map(dialect.is_number, cells))
    wrong = sum(not dialect.is_number(c) and c.lower() not in MISSING for c in cells)
    return good > 0 and len(cells) > 1 and good > wrong and 2 * (len(cells) - wrong) >= width


def _header(above: list[str], comments: list[str], dialect: Dialect, width: int,
            notes: list[str]) -> tuple[list[str], list[str]]:
    """Column names and the row of units from the lines above the numbers, or from the last comment line."""
    if not (rows := [_names(line, dialect, width) for line in above]):
        named = [_names(c.lstrip("#%/ "), dialect, width) for c in comments]
        if fitting := [row for row in named if len(row) == width and not any(map(dialect.is_number, row))]:
            return unique_labels(fitting[-1]), []
        return [str(k + 1) for k in range(width)], []
    # Names, units; or long names, units, short names.
    def of_units(cells: list[str]) -> bool:
        words = [c for c in cells if c.strip("[]()- ")]
        return bool(words) and sum(parse_unit(c) is not None for c in words) >= 0.5 * len(words)
    at = next((k for k in (-1, -2) if len(rows) > -k and of_units(rows[k]) and len(rows[k - 1]) >= width), None)
    units, names = ([], rows[-1]) if at is None else (rows[at], rows[-2] if at == -1 else rows[-1])
    if len(names) < width:
        hint = (" If the comma is the decimal mark, too, export with a semicolon between the cells."
                if dialect.delimiter == "," else "")
        raise DataError(f"the header has {len(names)} names but the rows have {width} values: "
                        f"'{above[-1][:80]}'.{hint}")
    if ignored := len(rows) - (2 if units else 1):
        notes.append(f"ignored {counted(ignored, 'line')} above the header, from '{above[0][:60]}' on.")
    return unique_labels(names), units


def _names(line: str, dialect: Dialect, width: int) -> list[str]:
    cells = dialect.cells(line)
    if dialect.delimiter is None and len(cells) > width:  # names with blanks in them
        apart = [c for c in re.split(r"\s{2,}|\t", line.strip()) if c]
        joined = [c for c in re.split(r"\s+(?![\[(])", line.strip()) if c]
        cells = next((c for c in (apart, joined) if len(c) == width), cells)
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _rows(lines: list[str], dialect: Dialect, width: int, notes: list[str]) -> list[str]:
    """Drop the rows that do not fit under the header, and the delimiters that end a row."""
    ending = " \t" + (dialect.delimiter or "")
    kept, long, short = [], 0, 0
    for line in lines:
        bare = line.rstrip(ending)
        filled, all_cells = (len(dialect.cells(part)) if '"' in line or dialect.delimiter is None else
                             part.count(dialect.delimiter) + 1 for part in (bare, line))
        short += all_cells < width
        if filled > width:
            long += 1
        elif bare:
            kept.append(bare.lstrip() if dialect.delimiter is None else bare)
    if long:
        notes.append(f"left out {counted(long, 'row')} with more cells than the header has names.")
    if short:
        notes.append(f"{counted(short, 'row')} shorter than the header; the last cells count as missing.")
    return kept


def _parse(rows: list[str], dialect: Dialect, labels: list[str],
           notes: list[str]) -> tuple[dict[str, NDArray[np.float64]], dict[str, Sequence[object]]]:
    plain = otherwise(None, ValueError, lambda: np.loadtxt(rows, delimiter=dialect.delimiter, comments=None, ndmin=2)
                      ) if rows and dialect.decimal == "." else None
    if plain is not None and plain.shape[1] == len(labels) and (np.abs(plain) < _LARGEST).all():
        return dict(zip(labels, plain.T.copy(), strict=True)), {}  # to import pandas takes longer than a fit
    import pandas as pd

    try:
        with warnings.catch_warnings(action="error", category=pd.errors.ParserWarning):  # it would lose cells
            frame = pd.read_csv(io.StringIO("\n".join(rows)), sep=dialect.delimiter or r"\s+", decimal=dialect.decimal,
                                header=None, names=range(len(labels)), index_col=False, skipinitialspace=True,
                                low_memory=False, na_values=sorted(MISSING - {""}))
    except (pd.errors.ParserWarning, ValueError, OverflowError) as error:  # ParserError is a ValueError
        raise DataError(f"its rows cannot be read as a table ({str(error).strip()}).") from None
    columns, texts = {}, {}
    group = f"[{_GROUPS[dialect.decimal]}{_SPACES}]"
    for label, (_, column) in zip(labels, frame.items(), strict=True):
        cells, words = column, column.dtype.kind not in "fiub"
        if words:
            cells = column.astype(str).str.strip(" \"'")
            if (grouped := cells.str.fullmatch(_GROUPED[dialect.decimal])).any():
                first = cells[grouped].iloc[0]
                notes.append(f"'{label}' has '{re.findall(group, first)[0]}' between thousands, as in '{first}'.")
                cells = cells.where(~grouped, cells.str.replace(group, "", regex=True))
        array, bad = numbers(cells, dialect.decimal)
        if words and bad > 0.5 * np.count_nonzero(column.notna()):
            texts[label] = column.astype(str).tolist()
            continue
        columns[label] = array
        if bad:
            notes.append(f"{counted(bad, 'cell')} of '{label}' hold no finite number and count as missing.")
    return columns, texts


def numbers(values: object, decimal: str = ".") -> tuple[NDArray[np.float64], int]:
    """Turn a column into float64; count the cells that are neither a finite number nor marked as missing."""
    import pandas as pd

    series = pd.Series(values)
    missing = np.array(series.isna(), dtype=bool)
    if pd.api.types.is_numeric_dtype(series.dtype) and not pd.api.types.is_complex_dtype(series.dtype):
        array = series.to_numpy(dtype=float, na_value=np.nan).copy()
    else:
        text = series.astype(str).str.strip().str.strip("\"'").str.replace("−", "-", regex=False)
        text = text.str.replace(",", ".", regex=False) if decimal == "," else text
        array = np.array(pd.to_numeric(text, errors="coerce"), dtype=float)
        missing |= text.str.lower().isin(MISSING).to_numpy()
    array[np.abs(array) >= _LARGEST] = np.nan
    return array, int(np.count_nonzero(np.isnan(array) & ~missing))


def unique_labels(labels: Sequence[str]) -> list[str]:
    """Give every column a name of its own: empty ones by position, repeated ones with a number."""
    named = [label.strip().strip("\"'") or f"column {k + 1}" for k, label in enumerate(labels)]
    seen: defaultdict[str, count[int]] = defaultdict(lambda: count(1))
    result = [label if (n := next(seen[label])) == 1 else f"{label} ({n})" for label in named]
    return result if len(set(result)) == len(result) else [f"{c} [{k + 1}]" for k, c in enumerate(named)]


# Numbers of the MAT-file format, version 5.
_MATRIX, _COMPRESSED, _UINT32 = 14, 15, 6
_INT32 = (5, 6)  # some writers call it unsigned


def mat_table(data: bytes) -> TextTable:
    """Read the numeric arrays of the most frequent length from a MATLAB file; columns of matrices, too."""
    if data.startswith(b"\x89HDF") or b"MATLAB 7.3" in data[:128]:
        raise DataError("it is a MATLAB 7.3 file; save it with save(..., '-v7'), or export CSV.")
    _check_whole(data)
    with warnings.catch_warnings(action="ignore"):
        try:
            found = scipy.io.loadmat(io.BytesIO(data), simplify_cells=True)
        except Exception as error:  # a damaged file makes loadmat fail in every way there is
            raise DataError(f"it cannot be read as a MATLAB file ({_first_line(error)}).") from None
    if not (arrays := dict(_arrays("", {k: v for k, v in found.items() if not k.startswith("__")}))):
        raise DataError(f"it holds no numeric arrays of at least {MIN_SAMPLES} samples.")
    lengths = Counter(len(a) for a in arrays.values())
    length = max(lengths, key=lambda n: (lengths[n], n))
    kept = {k: a for k, a in arrays.items() if len(a) == length}
    left = [k for k in arrays if k not in kept]
    notes = [f"left out variables of another length than {length}: {', '.join(left)}."] if left else []
    short = [k.rpartition(".")[2] for k in kept]
    labels = short if len(set(short)) == len(short) and "Data" not in short else unique_labels(list(kept))
    columns = {label: numbers(a)[0] for label, a in zip(labels, kept.values(), strict=True)}
    return TextTable(columns, labels=labels, notes=notes)


def _check_whole(data: bytes) -> None:
    """See whether sizes and types of a version 5 file agree: SciPy trusts them, up to the end of the process."""
    if (order := {b"IM": "<", b"MI": ">"}.get(data[126:128])) is None:
        return  # version 4 or no MATLAB file at all: SciPy says so without harm
    left = MOST_UNPACKED
    try:
        for kind, content in _elements(data[128:], order):
            if kind == _COMPRESSED:
                unpacked = zlib.decompressobj().decompress(content, left)
                left -= len(unpacked)
                if left <= 0:
                    raise DataError(f"it unpacks to more than {MOST_UNPACKED / 1e6:.0f} MB; save less in one file.")
                [(kind, content)] = _elements(unpacked, order)
            _need(kind == _MATRIX)
            _check_matrix(content, order, 0)
    except (ValueError, zlib.error, struct.error):
        raise DataError("it is a damaged MATLAB file: its parts do not fit together. Save it again, or "
                        "export CSV.") from None


def _need(holds: bool) -> None:
    if not holds:
        raise ValueError


def _elements(data: bytes, order: str) -> Iterator[Element]:
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, end = at + 8, at + 8 + size
        if kind >> 16:  # up to four bytes are kept within the tag
            kind, size = kind & 0xFFFF, kind >> 16
            _need(size <= 4)
            start, end = at + 4, at + 4 + size
            at += 8
        else:
            at = end if kind == _COMPRESSED else end + -size % 8
        _need(end <= len(data))
        yield kind, data[start:end]


def _check_matrix(content: bytes, order: str, depth: int) -> None:
    if not content:
        return  # an empty cell
    _need(depth < _DEEPEST)
    parts = list(_elements(content, order))
    _need(len(parts) >= 3 and parts[0][0] == _UINT32 and len(parts[0][1]) == 8)
    flags = struct.unpack_from(f"{order}I", parts[0][1])[0]
    family, is_complex = flags & 0xFF, bool(flags & 0x800)
    if family not in (_CELL, _STRUCT, _CHAR, *_NUMBERS):
        return  # objects and sparse matrices hold no samples
    _need(parts[1][0] in _INT32 and len(parts[1][1]) >= 8 and len(parts[1][1]) % 4 == 0)
    shape = struct.unpack(f"{order}{len(parts[1][1]) // 4}i", parts[1][1])
    _need(min(shape) >= 0 and parts[2][0] in (1, 2, 16))
    count = math.prod(shape)
    parts = parts[3:]
    if family not in (_CELL, _STRUCT):
        _need(len(parts) == (2 if is_complex else 1))
        for kind, values in parts:
            _need(kind in _SIZES and (family == _CHAR or len(values) == count * _SIZES[kind]))
        return
    if family == _STRUCT:  # length of the names, names
        _need(len(parts) >= 2 and parts[0][0] in _INT32 and len(parts[0][1]) == 4 and parts[1][0] in (1, 2))
        width = struct.unpack(f"{order}i", parts[0][1])[0]
        _need(width > 0 and len(parts[1][1]) % width == 0)
        count *= len(parts[1][1]) // width
        parts = parts[2:]
    _need(len(parts) == count)
    for kind, inner in parts:
        _need(kind == _MATRIX)
        _check_matrix(inner, order, depth + 1)


def _arrays(name: str, value: object, depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, dict) and depth < 6:
        for key, inner in value.items():
            yield from _arrays(f"{name}.{key}" if name else str(key), inner, depth + 1)
        return
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        return
    if (array := np.squeeze(value)).ndim == 2 and min(array.shape) <= 64:
        tall = array if array.shape[0] >= array.shape[1] else array.T
        for k in range(tall.shape[1]):
            yield from _arrays(f"{name}_{k + 1}", tall[:, k], depth)
    elif array.ndim == 1 and array.size >= MIN_SAMPLES:
        yield name, array


def parquet_table(data: bytes) -> TextTable:
    """Read a table from the bytes of a Parquet file; a named index counts as a column."""
    import pandas as pd

    try:
        import pyarrow.parquet
    except ImportError:
        raise MissingDependency("Parquet files need pyarrow, which is not installed: "
                                "pip install 'motorid[parquet]', or export CSV.") from None
    try:
        about = pyarrow.parquet.read_metadata(io.BytesIO(data))
        if 8 * about.num_rows * about.num_columns > MOST_UNPACKED or about.num_columns > MOST_COLUMNS:
            raise DataError(f"its {about.num_rows} rows of {about.num_columns} columns are more than can be read at "
                            "once; save fewer.")
        frame = pd.read_parquet(io.BytesIO(data), engine="pyarrow")
    except DataError:
        raise
    except Exception as error:  # pyarrow raises whatever its C++ side throws
        raise DataError(f"it cannot be read as Parquet ({_first_line(error)}).") from None
    return frame_table(frame)


# The ending of a file to what reads its bytes; all others are read as text.
FORMATS = {".mat": mat_table, ".parquet": parquet_table, ".pq": parquet_table}


def frame_table(frame: Any) -> TextTable:
    """Return the table of a pandas.DataFrame; a named index counts as a column."""
    import pandas as pd

    frame = frame.reset_index() if frame.index.name or not isinstance(frame.index, pd.RangeIndex) else frame
    labels = unique_labels([str(c) for c in frame.columns])
    columns, texts, notes = {}, {}, []
    for label, (_, series) in zip(labels, frame.items(), strict=True):
        if pd.api.types.is_string_dtype(series.dtype):
            told = pd.Series(pd.to_numeric(series, errors="coerce"))
            series = told if told.notna().sum() == series.notna().sum() else series
        if pd.api.types.is_numeric_dtype(series.dtype) and not pd.api.types.is_complex_dtype(series.dtype):
            columns[label], bad = numbers(series)
            notes += [f"{counted(bad, 'cell')} of '{label}' infinite: counted as missing."] if bad else []
        else:
            texts[label] = series.astype(str).tolist()
    return TextTable(columns, texts, labels, notes=notes)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]

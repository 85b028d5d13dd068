"""Tables of numbers from the bytes of MATLAB and Parquet files."""

import io
import math
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy

from motorid.display.numbers import counted
from motorid.errors import DataError, MissingDependency
from motorid.records.experiment import MIN_SAMPLES
from motorid.records.text_tables import MOST_COLUMNS, TextTable, numbers, unique_labels

# Numbers of the MAT-file format, version 5.
_MATRIX, _COMPRESSED, _UINT32 = 14, 15, 6
_INT32 = (5, 6)  # some writers call it unsigned
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_CELL, _STRUCT, _CHAR, _NUMBERS = 1, 2, 4, range(6, 16)
_DEEPEST = 20
MOST_UNPACKED = 512_000_000  # bytes

Element = tuple[int, bytes]


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

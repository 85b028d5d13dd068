"""Tables from MATLAB and Parquet files."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from collections.abc import Iterator

import numpy as np

from motorid.errors import DataError, MissingDependency
from motorid.records.experiment import MIN_SAMPLES
from motorid.records.matfile import check_whole
from motorid.records.text_tables import Table, counted, numbers, unique_labels

__all__ = ["mat_table", "parquet_table"]


def mat_table(data: bytes) -> Table:
    """Read the numeric arrays of one length from the bytes of a MATLAB file (up to version 7).

    Fields of structures and columns of matrices become columns of their own; of several lengths the most
    frequent is taken.

    Raises
    ------
    DataError
        If it is no such file, or holds no numeric arrays.
    """
    if data.startswith(b"\x89HDF") or b"MATLAB 7.3" in data[:128]:
        raise DataError("it is a MATLAB 7.3 file; save it with save(..., '-v7'), or export CSV.")
    check_whole(data)
    arrays = dict(_arrays("", _load(data)))
    if not arrays:
        raise DataError(f"it holds no numeric arrays of at least {MIN_SAMPLES} samples.")
    lengths = Counter(len(a) for a in arrays.values())
    length = max(lengths, key=lambda n: (lengths[n], n))
    kept = {k: a for k, a in arrays.items() if len(a) == length}
    left = [k for k in arrays if k not in kept]
    notes = [f"left out variables of another length than {length}: {', '.join(left)}."] if left else []
    short = [k.rpartition(".")[2] for k in kept]
    labels = short if len(set(short)) == len(short) and "Data" not in short else unique_labels(list(kept))
    columns = {label: numbers(a)[0] for label, a in zip(labels, kept.values(), strict=True)}
    return Table(columns, labels=labels, notes=notes)


def parquet_table(data: bytes) -> Table:
    """Read a table from the bytes of a Parquet file; a named index counts as a column.

    Raises
    ------
    MissingDependency
        If pyarrow is not installed.
    DataError
        If it is no Parquet file.
    """
    import pandas as pd

    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise MissingDependency("Parquet files need pyarrow, which is not installed: "
                                "pip install 'motorid[parquet]', or export CSV.") from None
    try:
        frame = pd.read_parquet(io.BytesIO(data), engine="pyarrow")
    except Exception as error:  # pyarrow raises whatever its C++ side throws
        raise DataError(f"it cannot be read as Parquet ({_first_line(error)}).") from None
    frame = frame.reset_index() if frame.index.name or not isinstance(frame.index, pd.RangeIndex) else frame
    labels = unique_labels([str(c) for c in frame.columns])
    columns, texts, notes = {}, {}, []
    for label, (_, series) in zip(labels, frame.items(), strict=True):
        if pd.api.types.is_numeric_dtype(series.dtype) and not pd.api.types.is_complex_dtype(series.dtype):
            columns[label], bad = numbers(series)
            notes += [f"{counted(bad, 'cell')} of '{label}' infinite; taken as missing."] if bad else []
        else:
            texts[label] = series.astype(str).tolist()
    return Table(columns, texts, labels, notes=notes)


def _load(data: bytes) -> dict[str, object]:
    from scipy.io import loadmat

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = loadmat(io.BytesIO(data), simplify_cells=True)
        except Exception as error:  # a damaged file makes loadmat fail in every way there is
            raise DataError(f"it cannot be read as a MATLAB file ({_first_line(error)}).") from None
    return {k: v for k, v in found.items() if not k.startswith("__")}


def _arrays(name: str, value: object, depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, dict) and depth < 6:
        for key, inner in value.items():
            yield from _arrays(f"{name}.{key}" if name else str(key), inner, depth + 1)
        return
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        return
    array = np.squeeze(value)
    if array.ndim == 2 and min(array.shape) <= 64:
        tall = array if array.shape[0] >= array.shape[1] else array.T
        for k in range(tall.shape[1]):
            yield from _arrays(f"{name}_{k + 1}", tall[:, k], depth)
    elif array.ndim == 1 and array.size >= MIN_SAMPLES:
        yield name, array


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]

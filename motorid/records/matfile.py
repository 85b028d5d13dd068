"""Is a MATLAB file whole? SciPy's reader trusts it, and a damaged one can end the whole process.

Layout after "MAT-File Format", The MathWorks (version 5): a header of 128 bytes, then elements, each of a
tag (type, number of bytes) and data padded to eight bytes; a matrix is an element that holds elements.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator

from motorid.errors import DataError

__all__ = ["check_whole"]

_MATRIX, _COMPRESSED, _UINT32 = 14, 15, 6
_INT32 = (5, 6)  # some writers call it unsigned
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_CELL, _STRUCT, _CHAR, _NUMBERS = 1, 2, 4, range(6, 16)
_DEEPEST = 20

Element = tuple[int, bytes]


def check_whole(data: bytes) -> None:
    """Walk through the bytes of a version 5 file and see whether sizes and types agree.

    Raises
    ------
    DataError
        If they do not.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        return  # version 4 or no MATLAB file at all: SciPy says so without harm
    try:
        for kind, content in _elements(data[128:], order):
            if kind == _COMPRESSED:
                [(kind, content)] = _elements(zlib.decompress(content), order)
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
    if family in (_CELL, _STRUCT):
        _check_children(parts[3:], order, count, family == _STRUCT, depth)
        return
    _need(len(parts) == (5 if is_complex else 4))
    for kind, values in parts[3:]:
        _need(kind in _SIZES and (family == _CHAR or len(values) == count * _SIZES[kind]))


def _check_children(parts: list[Element], order: str, count: int, named: bool, depth: int) -> None:
    if named:
        _need(len(parts) >= 2 and parts[0][0] in _INT32 and len(parts[0][1]) == 4 and parts[1][0] in (1, 2))
        width = struct.unpack(f"{order}i", parts[0][1])[0]
        _need(width > 0 and len(parts[1][1]) % width == 0)
        count *= len(parts[1][1]) // width
        parts = parts[2:]
    _need(len(parts) == count)
    for kind, content in parts:
        _need(kind == _MATRIX)
        _check_matrix(content, order, depth + 1)

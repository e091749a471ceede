"""Check a MATLAB file of version 5 to 7 before scipy reads it, which crashes on types that there are not."""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

from excite.errors import LogError
from excite.logs.files.common import MOST_BYTES

HEADER = 128  # bytes
INT8, INT32, UINT32, MATRIX, COMPRESSED = 1, 5, 6, 14, 15  # types of elements
NUMBERS = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}  # types of numbers: bytes of each
TEXT = (*NUMBERS, 16, 17, 18)
CELL, STRUCT, OBJECT, CHAR, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17  # classes of matrices
NUMERIC = range(6, 16)
COMPLEX = 0x0800  # flag
LONGEST_NAME = 1024  # bytes of a field's name; MATLAB's most is 64
DEEPEST = 30  # matrices in matrices; chosen


class _DamagedError(ValueError):
    """The bytes are no MATLAB file."""


def refuse_damaged(path: Path) -> None:
    """Raises LogError where elements are of no type or longer than the file. Source: MathWorks, MAT-File Format."""
    raw = path.read_bytes()
    mark = raw[126:128]
    if mark not in (b"IM", b"MI") or 0 in raw[:4]:
        return  # of version 4, or no MATLAB file
    order = "<" if mark == b"IM" else ">"
    try:
        at = HEADER
        while at < len(raw):
            kind, size, begin, after = _element(raw, at, len(raw), order, False)
            if kind == COMPRESSED:
                unpack = zlib.decompressobj()
                try:
                    data = unpack.decompress(raw[begin : begin + size], MOST_BYTES)
                except zlib.error as err:
                    raise _DamagedError(str(err)) from None
                if unpack.unconsumed_tail:
                    raise _DamagedError("a variable unpacks to more than is read")
                kind, size, begin, _ = _element(data, 0, len(data), order, False)
                if kind == MATRIX:
                    _matrix(data, begin, begin + size, order, 0)
            elif kind == MATRIX:
                _matrix(raw, begin, begin + size, order, 0)
            at = after
    except (_DamagedError, struct.error) as err:
        raise LogError(f"{path}: not a MATLAB file that can be read (v5 to v7.3): {err}") from None


def _element(raw: bytes, at: int, end: int, order: str, padded: bool = True) -> tuple[int, int, int, int]:
    """Type, bytes, begin of the data and of the next element."""
    if at + 8 > end:
        raise _DamagedError(f"breaks off at byte {at}")
    kind, size = struct.unpack_from(order + "II", raw, at)
    if kind >> 16:  # small: type, size and data in eight bytes
        kind, size = kind & 0xFFFF, kind >> 16
        if size > 4:
            raise _DamagedError(f"a small element of {size} bytes at byte {at}")
        return kind, size, at + 4, at + 8
    begin = at + 8
    if begin + size > end:
        raise _DamagedError(f"an element of {size} bytes at byte {at} is longer than the file")
    return kind, size, begin, min(begin + (-(-size // 8) * 8 if padded and kind != COMPRESSED else size), end)


def _matrix(raw: bytes, at: int, end: int, order: str, depth: int) -> None:
    """Check a variable and what is in it."""
    if at == end:
        return  # an empty one
    if depth > DEEPEST:
        raise _DamagedError("variables in variables without end")
    kind, size, begin, at = _element(raw, at, end, order)
    if kind != UINT32 or size != 8:
        raise _DamagedError(f"no flags at byte {begin}")
    flags = struct.unpack_from(order + "I", raw, begin)[0]
    own = flags & 0xFF
    if own == OPAQUE:
        for _ in range(3):  # name, kind and class of an object
            kind, _, _, at = _element(raw, at, end, order)
            _allow(kind, TEXT, at)
        _nested(raw, at, end, order, depth, 1)
        return
    kind, size, begin, at = _element(raw, at, end, order)
    if kind != INT32 or size % 4 or not 8 <= size <= 128:
        raise _DamagedError(f"no sizes at byte {begin}")
    sizes = struct.unpack_from(f"{order}{size // 4}i", raw, begin)
    count = math.prod(sizes)
    if min(sizes) < 0:
        raise _DamagedError(f"a size below zero at byte {begin}")
    kind, _, _, at = _element(raw, at, end, order)
    _allow(kind, (INT8,), at)
    if own in NUMERIC:
        for _ in range(2 if flags & COMPLEX else 1):
            kind, size, begin, at = _element(raw, at, end, order)
            _allow(kind, tuple(NUMBERS), begin)
            if size != count * NUMBERS[kind]:
                raise _DamagedError(f"{size} bytes for {count} numbers at byte {begin}")
    elif own == CHAR:
        kind, size, begin, at = _element(raw, at, end, order)
        _allow(kind, TEXT, begin)
        if count > size:
            raise _DamagedError(f"{size} bytes for {count} letters at byte {begin}")
    elif own == CELL:
        _nested(raw, at, end, order, depth, count)
    elif own in (STRUCT, OBJECT):
        if own == OBJECT:
            kind, _, begin, at = _element(raw, at, end, order)
            _allow(kind, (INT8,), begin)
        kind, size, begin, at = _element(raw, at, end, order)
        _allow(kind, (INT32,), begin)
        length = struct.unpack_from(order + "i", raw, begin)[0]
        kind, size, begin, at = _element(raw, at, end, order)
        _allow(kind, (INT8,), begin)
        if length <= 0 or length > LONGEST_NAME or size % length:
            raise _DamagedError(f"no names of fields at byte {begin}")
        _nested(raw, at, end, order, depth, count * (size // length))
    elif own == SPARSE:
        wanted = [(INT32, UINT32), (INT32, UINT32), *([tuple(NUMBERS)] * (2 if flags & COMPLEX else 1))]
        for allowed in wanted:
            kind, _, begin, at = _element(raw, at, end, order)
            _allow(kind, allowed, begin)
    elif own == FUNCTION:
        _nested(raw, at, end, order, depth, 1)
    else:
        raise _DamagedError(f"a variable of unknown class {own}")


def _nested(raw: bytes, at: int, end: int, order: str, depth: int, count: int) -> None:
    """Check so many variables one behind the other."""
    if 8 * count > end - at:
        raise _DamagedError(f"{count} variables in {end - at} bytes")
    for _ in range(count):
        kind, size, begin, after = _element(raw, at, end, order, False)
        _allow(kind, (MATRIX,), begin)
        _matrix(raw, begin, begin + size, order, depth + 1)
        at = after


def _allow(kind: int, allowed: tuple[int, ...], at: int) -> None:
    if kind not in allowed:
        raise _DamagedError(f"an element of unknown type {kind} at byte {at}")

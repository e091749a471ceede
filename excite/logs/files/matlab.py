"""MATLAB files (v5 to v7.3) and HDF5: vectors, fields of structs, time series with times of their own."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy

from excite.errors import LogError
from excite.logs.files.common import MOST_ELEMENTS, refuse_huge, refuse_swollen, said
from excite.logs.files.matlab5 import refuse_damaged
from excite.logs.files.vectors import one_table

VALUES = ("data", "values")  # fields that are the value of their struct: of a timeseries, of Simulink's signals
LABELS = ("label", "name", "blockname")
OBJECTS = ("timetable", "table", "timeseries", "datetime", "duration")  # classes that only MATLAB reads
MOST_STRUCTS = 256  # elements of an array of structs that are looked into; chosen
DEEPEST = 6  # structs in structs; chosen
HDF5 = b"\x89HDF\r\n\x1a\n"
MATLAB_HEADER = 512  # bytes before the HDF5 part of a .mat file


def read_matlab(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the vectors of a MATLAB file, those in structs as name.field; columns of a matrix as name(:,1)."""
    with path.open("rb") as file:
        begin = file.read(MATLAB_HEADER + len(HDF5))
    if HDF5 in (begin[: len(HDF5)], begin[MATLAB_HEADER:]):
        return read_hdf5(path, wanted)
    refuse_damaged(path)
    try:
        raw = scipy.io.loadmat(path)
    except Exception as err:
        raise LogError(f"{path}: not a MATLAB file that can be read (v5 to v7.3): {said(err)}") from None
    found: dict[str, np.ndarray] = {}
    other: dict[str, str] = {}
    objects = [name for name, value in raw.items() if type(value).__name__ == "MatlabOpaque" or name == "None"]
    for name, value in raw.items():
        if not name.startswith("__"):
            _walk(name, value, found, other, 0)
    return one_table(path, found, other, wanted, objects)


def _walk(name: str, value: Any, found: dict[str, np.ndarray], other: dict[str, str], depth: int) -> None:
    """Collect the vectors of a variable."""
    if not isinstance(value, np.ndarray) or depth > DEEPEST:
        return
    fields = value.dtype.names
    if fields:
        for k, one in enumerate(value.ravel()[:MOST_STRUCTS]):
            own = name if value.size == 1 else f"{name}({k + 1})"
            for field in fields:
                _walk(f"{own}.{field}", one[field], found, other, depth + 1)
            label = next((_word(one[f]) for f in fields if f.lower() in LABELS), "")
            column = next((f"{own}.{f}" for f in fields if f.lower() in VALUES and f"{own}.{f}" in found), "")
            if column:
                other |= {n: column for n in (own, label) if n and n not in found and n not in other}
    elif value.dtype.kind == "O" and value.size == 1:  # a struct in a cell
        _walk(name, value.ravel()[0], found, other, depth + 1)
    elif value.dtype.kind in "fiub":
        _add(name, value, found)


def _word(value: Any) -> str:
    flat = np.ravel(value)
    return str(flat[0]) if flat.size == 1 and flat.dtype.kind == "U" else ""


def _add(name: str, value: np.ndarray, found: dict[str, np.ndarray]) -> None:
    """Keep a vector, or the columns of a matrix that is longer than wide."""
    if value.size > 1 and value.size == max(value.shape):
        found[name] = np.ravel(value)
    elif value.ndim == 2 and value.shape[1] <= MOST_ELEMENTS and value.shape[0] > 2 * value.shape[1] > 2:
        for k in range(value.shape[1]):
            found[f"{name}(:,{k + 1})"] = value[:, k]


def read_hdf5(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the vectors of an HDF5 file as group/name, of a MATLAB v7.3 file as name.field."""
    import h5py

    found: dict[str, np.ndarray] = {}
    objects: list[str] = []
    claimed = 0
    between = "." if path.suffix.lower() == ".mat" else "/"
    with h5py.File(path, "r") as file:
        stack = [(name, file, name, 0) for name in reversed(list(file))]
        seen: set[Any] = set()  # a group may hold itself
        while stack:
            name, parent, key, depth = stack.pop()
            item = None if key.startswith("#") or depth > DEEPEST else parent.get(key)
            if item is None:
                continue
            kind = item.attrs.get("MATLAB_class", b"")
            kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
            if "MATLAB_object_decode" in item.attrs or kind in OBJECTS:
                objects.append(name)
            elif isinstance(item, h5py.Group):
                address = h5py.h5o.get_info(item.id).addr
                if address not in seen:
                    seen.add(address)
                    stack += [(f"{name}{between}{child}", item, child, depth + 1) for child in reversed(list(item))]
            elif isinstance(item, h5py.Dataset) and item.shape is not None and kind not in ("char", "cell", "struct"):
                fields, size = item.dtype.names, math.prod(item.shape)
                if not (fields or item.dtype.kind in "fiub") or size < 2 or item.ndim > 2 or item.dtype.itemsize > 8192:
                    continue
                claimed += size * item.dtype.itemsize
                refuse_swollen(path, claimed)
                refuse_huge(path, size, len(fields) if fields else 1)
                value = item[()]
                for field in fields or ():
                    if value[field].dtype.kind in "fiub":
                        _add(f"{name}{between}{field}", value[field], found)
                if not fields:
                    _add(name, value.T if kind else value, found)
    ends = [(name, *name.rpartition(between)) for name in found]
    other = {own: name for name, own, dot, field in ends if dot and field.lower() in VALUES and own not in found}
    return one_table(path, found, other, wanted, objects)

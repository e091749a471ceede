"""Parquet files: index, nested and categorical columns as plain ones."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import MOST_ELEMENTS, NOTES, name_the_same, numbered, refuse_huge, said


def read_parquet(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read all columns; those of a struct as name.field, of a list as name[0], a named index as a column."""
    import pyarrow
    import pyarrow.parquet

    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            refuse_huge(path, file.metadata.num_rows, file.metadata.num_columns)
            nested = any(pyarrow.types.is_struct(field.type) for field in file.schema_arrow)
            table = _flat(file.read()) if nested else None
        frame = pd.read_parquet(path) if table is None else table.to_pandas()
    except LogError:
        raise
    except Exception as err:  # what the parsers of these formats raise on damaged bytes is anything at all
        raise LogError(f"{path}: not a Parquet file that can be read: {said(err)}") from None
    index = frame.index
    named = [name for name in index.names if name is not None]
    if named or index.dtype.kind not in "iu":
        frame = frame.reset_index(drop=bool(named) and set(named) <= set(frame.columns))
    elif not isinstance(index, pd.RangeIndex) or index.start != 0 or index.step != 1:
        frame = frame.reset_index(drop=True)
    frame.columns = [".".join(map(str, name)) if isinstance(name, tuple) else str(name) for name in frame.columns]
    notes = name_the_same(list(frame.columns), "the file")
    frame.columns = pd.Index(numbered(list(frame.columns)))
    columns: dict[str, Any] = {}
    for name in frame.columns:
        columns |= _plain(name, frame[name])
    attrs: dict[Any, Any] = {key: value for key, value in frame.attrs.items() if isinstance(key, str)}
    made = pd.DataFrame(columns, index=frame.index)
    made.attrs = attrs if all(isinstance(v, dict | list) for v in attrs.values()) else {}
    made.attrs[NOTES] = [*made.attrs.get(NOTES, []), *notes]
    return made


def _flat(table: Any) -> Any:
    """A table whose structs are columns of their own."""
    import pyarrow

    while any(pyarrow.types.is_struct(field.type) for field in table.schema):
        table = table.flatten()
    return table


def _plain(name: str, column: pd.Series) -> dict[str, Any]:
    """A column as columns of numbers, times or text, by name."""
    if isinstance(column.dtype, pd.CategoricalDtype):
        if column.cat.categories.dtype.kind in "fiub":
            return {name: column.astype(float if column.isna().any() else column.cat.categories.dtype)}
        return {name: column.astype(object)}
    if pd.api.types.is_extension_array_dtype(column.dtype) and column.dtype.kind in "fiub":
        if column.isna().any():
            return {name: column.to_numpy(dtype=float, na_value=np.nan)}
        return {name: column.to_numpy(dtype={"f": float, "i": np.int64, "u": np.uint64, "b": bool}[column.dtype.kind])}
    if column.dtype != object:
        return {name: column}
    first = next((cell for cell in column if cell is not None), None)
    if isinstance(first, Decimal):
        return {name: pd.to_numeric(column.map(lambda d: None if d is None else float(d)), errors="coerce")}
    if isinstance(first, np.ndarray | list | tuple) and 0 < len(first) <= MOST_ELEMENTS:
        wide = len(first)
        if all(cell is None or len(cell) == wide for cell in column):
            rows = [[np.nan] * wide if cell is None else list(cell) for cell in column]
            return {f"{name}[{k}]": [row[k] for row in rows] for k in range(wide)}
    return {name: column}

"""ULog files of PX4: columns as topic/field, each topic at its own times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import NOTES, merged, refuse_huge

MICROSECOND = 1e-6  # [s]
CLOCK = "timestamp"


def read_ulog(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the topics whose fields are wanted, all where none is; time in `timestamps` [s]."""
    from pyulog import ULog

    log = ULog(str(path))
    names = {w.partition("/")[0].partition(".")[0] for w in wanted}
    found = [d for d in log.data_list if d.name in names] or log.data_list
    refuse_huge(path, sum(len(v) for d in found for v in d.data.values()), 1)
    groups = []
    for data in found:
        own = data.name if data.multi_id == 0 else f"{data.name}.{data.multi_id}"
        columns = {f"{own}/{k}": v for k, v in data.data.items() if k != CLOCK and v.dtype.kind in "fiub"}
        if columns and CLOCK in data.data:
            groups.append((data.data[CLOCK], columns))
    if not groups:
        raise LogError(f"{path}: no topic with numbers")
    first = min(int(t[0]) for t, _ in groups)
    table = merged(path, [((t - np.uint64(first)).astype(np.int64) * MICROSECOND, columns) for t, columns in groups])
    lost = len(log.dropouts)
    damaged = ["the file is damaged; read as far as it can be"] if log.file_corruption else []
    table.attrs[NOTES] = [*table.attrs.get(NOTES, []), *damaged]
    table.attrs[NOTES] += [f"the logger lost data {lost} times (drop-outs)"] if lost else []
    return table

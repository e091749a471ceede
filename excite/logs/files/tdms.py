"""TDMS files of LabVIEW: channels as group/channel, at the times of their waveforms or of a channel of times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import OTHER_NAMES, UNITS_SAID, merged, refuse_huge
from excite.logs.files.vectors import one_table

INCREMENT, OFFSET, START, UNIT = "wf_increment", "wf_start_offset", "wf_start_time", "unit_string"


def read_tdms(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the channels with numbers; time in `timestamps` [s] where the file has waveforms."""
    from nptdms import TdmsFile

    timed: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
    plain: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    with TdmsFile.open(path) as file:
        channels = [c for group in file.groups() for c in group.channels() if len(c)]
        if sum(len(c) for c in channels) > path.stat().st_size:  # a value takes a byte at least
            raise LogError(f"{path}: claims more values than the file can hold; it is damaged")
        refuse_huge(path, sum(len(c) for c in channels), 1)
        starts = [c.properties[START] for c in channels if isinstance(c.properties.get(START), np.datetime64)]
        for channel in channels:
            values = np.asarray(channel[:])
            name = f"{channel.group_name}/{channel.name}"
            if values.dtype.kind not in "fiubM":
                continue
            units[name] = str(channel.properties.get(UNIT, "")).strip()
            if values.dtype.kind == "M":
                values = (values - values.min()) / np.timedelta64(1, "s")
            step = channel.properties.get(INCREMENT)
            if isinstance(step, int | float) and np.isfinite(step) and step > 0:
                timed.append(
                    (_begin(channel, min(starts, default=None)) + step * np.arange(len(values)), {name: values})
                )
            else:
                plain[name] = values
    ends = [n.partition("/")[2] for n in (*plain, *(n for _, c in timed for n in c))]
    other = {n.partition("/")[2]: n for n in units if ends.count(n.partition("/")[2]) == 1}
    for t, columns in timed:  # channels beside a waveform that share its times
        group = next(iter(columns)).partition("/")[0]
        columns |= {n: v for n, v in plain.items() if n.partition("/")[0] == group and len(v) == len(t)}
    table = merged(path, timed) if timed else one_table(path, plain, other, wanted)
    table.attrs[OTHER_NAMES] = {own: n for own, n in other.items() if n in table.columns}
    table.attrs[UNITS_SAID] = {n: u for n, u in units.items() if u and n in table.columns}
    return table


def _begin(channel: Any, first: Any) -> float:
    """Return the time [s] of a waveform's first sample, from the start of the first waveform on."""
    start, offset = channel.properties.get(START), channel.properties.get(OFFSET, 0.0)
    late = (start - first) / np.timedelta64(1, "s") if isinstance(start, np.datetime64) else 0.0
    return float(offset) + float(late)

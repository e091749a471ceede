"""MDF files (ASAM), versions 3 and 4: bus and bench logs whose groups have times of their own."""

from __future__ import annotations

import itertools
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files import common

VIRTUAL = (3, 6)  # types of channels that have no bytes
DEFLATED = (1, 2)  # types of blocks


def read_mdf(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read every channel at its own times, time in `timestamps` [s] from the first sample on.

    A cell is NaN where its channel has no sample, or one that the file marks as invalid. Units go to attrs["units"].
    """
    from asammdf import MDF

    groups: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
    units: dict[str, str] = {}
    taken = {common.TIMESTAMPS}
    with MDF(path) as mdf:
        sizes = [(int(g.channel_group.cycles_nr), getattr(g.channel_group, "samples_byte_nr", 0)) for g in mdf.groups]
        common.refuse_swollen(path, sum(rows * int(size or 0) for rows, size in sizes))
        common.refuse_huge(path, max((rows for rows, _ in sizes), default=0), 1)
        _refuse_outside(path, mdf)
        _refuse_other_sizes(path, mdf)
        for index, group in mdf.virtual_groups.items():
            entries = [(None, g, c) for g, found in mdf.included_channels(index)[index].items() for c in found]
            if group.cycles_nr == 0 or not entries:
                continue
            common.refuse_huge(path, int(group.cycles_nr), len(entries))
            for signal in mdf.select(entries, raw=True, copy_master=False, validate=False):
                if signal.conversion:
                    signal.samples = signal.conversion.convert(signal.samples, ignore_value2text_conversions=True)
                    signal.conversion = None
                name = common.unique_name(signal.name, taken)
                taken.add(name)
                valid = signal.validate(copy=False)
                columns = common.columns_of_array(name, _native(valid.samples))
                if not columns or not len(valid):
                    continue
                groups.append((_native(valid.timestamps).astype(float), columns))
                if unit := str(signal.unit or "").strip():
                    units |= dict.fromkeys(columns, unit)
    if not groups:
        raise LogError(f"{path}: no channel with numbers")
    first = min(float(t[0]) for t, _ in groups)
    table = common.merged(path, [(t - first, columns) for t, columns in groups])
    table.attrs[common.UNITS_SAID] = units
    return table


def _refuse_outside(path: Path, mdf: Any) -> None:
    """Raises LogError where a channel lies outside its record: asammdf would read there, and crash."""
    for group in mdf.groups:
        record = int(getattr(group.channel_group, "samples_byte_nr", 0) or 0)
        for channel in group.channels:
            if getattr(channel, "channel_type", 0) in VIRTUAL and hasattr(channel, "byte_offset"):
                continue
            if hasattr(channel, "byte_offset"):  # version 4
                bits = 8 * channel.byte_offset + channel.bit_offset + channel.bit_count
            else:
                bits = 8 * channel.additional_byte_offset + channel.start_offset + channel.bit_count
            if not 0 < bits <= 8 * record:
                raise LogError(f"{path}: channel {channel.name} lies outside its record; the file is damaged")


def _refuse_other_sizes(path: Path, mdf: Any) -> None:
    """Raises LogError where a packed block is not as long as it says: asammdf would read behind its end."""
    from asammdf.blocks.utils import DECOMPRESS_FUNC_MAP

    with path.open("rb") as file:
        for group in mdf.groups:
            signals = (group.get_signal_data_blocks(k) for k in range(len(group.signal_data or ())))
            for block in itertools.chain(group.get_data_blocks(), *signals):
                for part in (block, getattr(block, "invalidation_block", None)):
                    if part is None or not part.block_type or not part.original_size:
                        continue
                    common.refuse_swollen(path, part.original_size)
                    file.seek(part.address)
                    packed = file.read(part.compressed_size)
                    if part.block_type in DEFLATED:  # a bounded size: it may be a small block of a billion zeros
                        size = len(zlib.decompressobj().decompress(packed, part.original_size + 1))
                    else:
                        size = len(DECOMPRESS_FUNC_MAP[part.block_type](packed))
                    if size != part.original_size:
                        raise LogError(f"{path}: a block of data is not as long as it says; the file is damaged")


def _native(values: np.ndarray) -> np.ndarray:
    """Values in the byte order of this computer."""
    return values if values.dtype.isnative or values.dtype.names else values.astype(values.dtype.newbyteorder("="))

"""Logs of a CAN bus (BLF, ASC): columns by message and signal, as Motor.Torque, with the DBC file beside the log."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import MOST_CELLS, NOTES, UNITS_SAID, lacking, merged, refuse_huge, said
from excite.text import count

OBJECT = struct.Struct("<4sHHII")  # signature, bytes of the header, its version, bytes of the object, kind
CONTAINER = struct.Struct("<H6xL4x")  # method of compression, bytes unpacked
CONTAINER_KIND = 10
DEFLATE = 2  # method
MOST_OF_CONTAINER = 100_000_000  # bytes; loggers fill them up to 128 kB; chosen
DATABASES = (".dbc", ".kcd", ".sym", ".arxml")


def read_can(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the signals of all messages that the DBC file describes, each message at its own times."""
    try:
        import can
        import cantools
    except ImportError:
        raise lacking(path, "CAN logs need python-can and cantools", "can") from None
    database = _database(path, cantools)
    if path.suffix.lower() == ".blf":
        _refuse_stuck(path)
    used = {w.rpartition(".")[0].strip().lower() for w in wanted} & {m.name.lower() for m in database.messages}
    known = {m.frame_id: m for m in database.messages if not used or m.name.lower() in used}
    times: dict[tuple[int, Any], list[float]] = {}
    rows: dict[tuple[int, Any], list[dict[str, float]]] = {}
    undecoded: dict[str, int] = {}
    notes: list[str] = []
    cells = seen = 0
    with can.LogReader(path) as log:
        try:
            for frame in log:
                seen += 1
                if frame.is_error_frame or frame.is_remote_frame or (m := known.get(frame.arbitration_id)) is None:
                    continue
                if bool(frame.is_extended_id) != bool(m.is_extended_frame):
                    continue
                try:
                    signals = m.decode(bytes(frame.data), decode_choices=False)
                except Exception:  # a frame that is shorter than its message, say
                    undecoded[m.name] = undecoded.get(m.name, 0) + 1
                    continue
                numbers = {k: float(v) for k, v in signals.items() if isinstance(v, int | float)}
                key = frame.arbitration_id, frame.channel
                times.setdefault(key, []).append(float(frame.timestamp))
                rows.setdefault(key, []).append(numbers)
                cells += len(numbers)
                if cells > MOST_CELLS // 8:  # objects take eight times the room of numbers
                    refuse_huge(path, 8 * cells, 1)
        except LogError:
            raise
        except Exception as err:
            if not rows:
                raise
            notes.append(f"the file breaks off after frame {seen} ({said(err)}); read up to there")
    notes += [
        f"message {name}: {count(n, 'frame is', 'frames are')} not as the DBC file says, left out"
        for name, n in undecoded.items()
    ]
    if not rows:
        what = "no frame" if not seen else f"none of {seen} frames is a message of the DBC file"
        raise LogError(f"{path}: {what}{'; ' + notes[-1] if notes else ''}")
    first = min(t[0] for t in times.values())
    groups, units, taken = [], dict[str, str](), set[str]()
    for key, found in rows.items():
        message = known[key[0]]
        own = message.name if message.name not in taken else f"{message.name} (channel {key[1]})"
        taken.add(own)
        frame_ = pd.DataFrame(found)
        groups.append(
            (np.array(times[key]) - first, {f"{own}.{name}": frame_[name].to_numpy(dtype=float) for name in frame_})
        )
        units |= {f"{own}.{s.name}": s.unit for s in message.signals if s.unit}
    table = merged(path, groups)
    kept = {name: unit for name, unit in units.items() if name in table.columns}
    table.attrs |= {UNITS_SAID: kept, NOTES: [*table.attrs.get(NOTES, []), *notes]}
    return table


def _refuse_stuck(path: Path) -> None:
    """Raises LogError where an object of a BLF file has no length: python-can would read it for ever."""
    raw = path.read_bytes()
    at = int.from_bytes(raw[4:8], "little")
    rest = b""
    while at + OBJECT.size <= len(raw):
        signature, _, _, size, kind = OBJECT.unpack_from(raw, at)
        if signature != b"LOBJ" or size < OBJECT.size + CONTAINER.size:
            return  # python-can says so itself
        if kind == CONTAINER_KIND:
            method = CONTAINER.unpack_from(raw, at + OBJECT.size)[0]
            data = raw[at + OBJECT.size + CONTAINER.size : at + size]
            if method == DEFLATE:
                try:
                    data = zlib.decompressobj().decompress(data, MOST_OF_CONTAINER)
                except zlib.error:
                    return
                if len(data) == MOST_OF_CONTAINER:
                    raise LogError(f"{path}: not a CAN log that can be read: a container unpacks to {len(data)} bytes")
            data, inner = rest + data, 0
            while inner + OBJECT.size <= len(data):
                inner = data.find(b"LOBJ", inner, inner + 8)
                if inner < 0 or inner + OBJECT.size > len(data):
                    break
                length = OBJECT.unpack_from(data, inner)[3]
                if length < OBJECT.size:
                    raise LogError(f"{path}: not a CAN log that can be read: an object of {length} bytes")
                if inner + length > len(data):
                    break
                inner += length
            rest = data[max(inner, 0) :]
        at += size + size % 4


def _database(path: Path, cantools: Any) -> Any:
    """The messages of the file of the log's stem, or of all such files in its folder. Raises LogError."""
    same = [path.with_suffix(s) for s in DATABASES if path.with_suffix(s).is_file()]
    beside = sorted(p for p in path.parent.iterdir() if p.suffix.lower() in DATABASES)
    files = same[:1] or beside
    if not files:
        raise LogError(
            f"{path}: a CAN log needs the DBC file that names its messages: put it beside the log as"
            f" {path.with_suffix('.dbc').name}"
        )
    database = cantools.database.Database(strict=False)
    for file in files:
        try:
            loaded = cantools.database.load_file(file, strict=False)
        except Exception as err:
            raise LogError(f"{file}: not a DBC file that can be read: {said(err)}") from None
        if not isinstance(loaded, cantools.database.Database):
            raise LogError(f"{file}: describes no messages of a CAN bus")
        database.messages.extend(loaded.messages)
    ids = [m.frame_id for m in database.messages]
    if len(set(ids)) < len(ids) and len(files) > 1:
        raise LogError(
            f"{path}: several DBC files beside the log describe the same messages; name one"
            f" {path.with_suffix('.dbc').name}"
        )
    return database

"""Bags of ROS 1 and 2 and MCAP files: columns by topic and field, as /joint_states/position[0]."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import (
    MOST_CELLS,
    MOST_ELEMENTS,
    NOTES,
    OTHER_NAMES,
    lacking,
    merged,
    refuse_huge,
    said,
)

STAMP = "header.stamp"  # time column that stands for the stamp in each message's own header
MCAP_MAGIC = b"\x89MCAP0\r\n"
DEEPEST = 8  # messages in messages; chosen
OBJECT_ROOM = 8  # times the room of a number that a field takes while it is read; measured
NANOSECONDS = 1_000_000_000
NEED_ROSBAGS = "ROS bags need rosbags"
NEED_MCAP = "MCAP files need mcap, mcap-ros1-support and mcap-ros2-support"

Message = tuple[str, int, Any]  # topic, time of logging [ns], message


def read_bag(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read a .bag (ROS 1), a .db3 or the folder of a bag of ROS 2."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise lacking(path, NEED_ROSBAGS, "ros") from None
    bag = path.parent if path.is_file() and path.suffix != ".bag" and _in_bag(path) else path
    unknown: set[str] = set()
    with AnyReader([bag], default_typestore=get_typestore(Stores.LATEST)) as reader:
        used = _topics({c.topic for c in reader.connections}, wanted)

        def messages() -> Iterator[Message]:
            for connection, at, data in reader.messages([c for c in reader.connections if c.topic in used]):
                try:
                    message = reader.deserialize(data, connection.msgtype)
                except KeyError:  # a type that neither the bag nor the library defines
                    unknown.add(connection.topic)
                    continue
                yield connection.topic, at, message

        return _table(path, messages(), wanted, unknown, [])


def _in_bag(path: Path) -> bool:
    return (path.parent / "metadata.yaml").is_file()


def read_mcap(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read an MCAP file with messages of ROS 1 or 2, or JSON; one that breaks off up to there."""
    try:
        from mcap.exceptions import McapError
        from mcap.reader import NonSeekingReader, SeekingReader
        from mcap_ros1.decoder import DecoderFactory as Ros1
        from mcap_ros2.decoder import DecoderFactory as Ros2
    except ImportError:
        raise lacking(path, NEED_MCAP, "ros") from None
    notes: list[str] = []
    unknown: set[str] = set()
    decoders: dict[int, Any] = {}
    factories = (Ros1(), Ros2())
    with path.open("rb") as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise LogError(f"{path}: not an MCAP file")
        file.seek(-len(MCAP_MAGIC), 2)
        whole = file.read() == MCAP_MAGIC
        file.seek(0)
        size = path.stat().st_size  # no record is longer, whatever it claims
        reader = (SeekingReader if whole else NonSeekingReader)(file, record_size_limit=size)
        summary = reader.get_summary() if whole else None
        used = _topics({c.topic for c in summary.channels.values()}, wanted) if summary else None

        def messages() -> Iterator[Message]:
            try:
                for schema, channel, message in reader.iter_messages(topics=used, log_time_order=whole):
                    if channel.id not in decoders:
                        decoders[channel.id] = _decoder(factories, channel.message_encoding, schema)
                    if decoders[channel.id] is None:
                        unknown.add(channel.topic)
                    else:
                        yield channel.topic, message.log_time, decoders[channel.id](message.data)
            except (McapError, EOFError) as err:
                if whole:
                    raise
                notes.append(f"the file breaks off ({said(err)}); read up to there")

        return _table(path, messages(), wanted, unknown, notes)


def _decoder(factories: Iterable[Any], encoding: str, schema: Any) -> Any:
    """What makes messages of a channel's bytes, None where nothing does."""
    if encoding == "json":
        return json.loads
    return next((made for f in factories if (made := f.decoder_for(encoding, schema)) is not None), None)


def _topics(topics: set[str], wanted: frozenset[str]) -> set[str]:
    """The topics whose fields are wanted; all where none is."""
    names = {name.strip().lower().lstrip("/") for name in wanted}
    return {t for t in topics if any(name.startswith(t.lower().lstrip("/")) for name in names)} or topics


def _table(
    path: Path, messages: Iterator[Message], wanted: frozenset[str], unknown: set[str], notes: list[str]
) -> pd.DataFrame:
    """Make one table of all messages, at the times of logging from the first on, or at those in their headers."""
    times: dict[str, list[int]] = {}
    rows: dict[str, list[dict[str, float]]] = {}
    other: dict[str, str] = {}
    cells, first = 0, None
    for topic, at, message in messages:
        first = at if first is None else first
        row: dict[str, float] = {}
        _collect(topic, message, row, first, 0)
        if not row:
            continue
        if topic not in rows:
            other |= _joint_names(topic, message)
        times.setdefault(topic, []).append(at)
        rows.setdefault(topic, []).append(row)
        cells += len(row)
        if cells > MOST_CELLS // OBJECT_ROOM:
            refuse_huge(path, OBJECT_ROOM * cells, 1)
    if unknown:
        notes.append(f"messages of an unknown type are left out: {', '.join(sorted(unknown)[:3])}")
    if first is None or not rows:
        raise LogError(f"{path}: no message with numbers{'; ' + notes[-1] if notes else ''}")
    groups = []
    for topic, found in rows.items():
        t: np.ndarray = np.array([at - first for at in times[topic]], dtype=np.int64) / NANOSECONDS
        frame = pd.DataFrame(found)
        if STAMP in wanted:
            t = frame.get(f"{topic}/header/stamp", pd.Series(np.nan, frame.index)).to_numpy(dtype=float)
            if not np.isfinite(t).all():
                notes.append(f"{topic}: has no stamp in a header, left out")
                continue
        groups.append((t, {str(name): frame[name].to_numpy(dtype=float) for name in frame}))
    if not groups:
        raise LogError(f"{path}: no message has a stamp in a header; write another time_column")
    table = merged(path, groups)
    notes = [*table.attrs.get(NOTES, []), *notes]
    if STAMP in wanted:
        table.insert(0, STAMP, table.iloc[:, 0])
    kept = {name: column for name, column in other.items() if column in table.columns and name not in table.columns}
    table.attrs |= {NOTES: notes, OTHER_NAMES: kept}
    return table


def _fields(value: Any) -> dict[str, Any]:
    """The fields of a message."""
    if isinstance(value, dict):
        return {str(name): one for name, one in value.items()}
    names = getattr(value, "__dataclass_fields__", None) or getattr(value, "__slots__", None) or ()
    return {name: getattr(value, name, None) for name in names if not name.startswith("_")}


def _collect(name: str, value: Any, row: dict[str, float], first: int, depth: int) -> None:
    """Collect the numbers of a message by name; a stamp as seconds since the first message."""
    if isinstance(value, bool | int | float | np.number | np.bool_):
        row[name] = float(value)
    elif isinstance(value, np.ndarray | list | tuple):
        if len(value) <= MOST_ELEMENTS and depth < DEEPEST:
            for k, one in enumerate(value):
                _collect(f"{name}[{k}]", one, row, first, depth + 1)
    elif not isinstance(value, str | bytes | bytearray | memoryview) and value is not None and depth < DEEPEST:
        fields = _fields(value)
        numbers = [int(n) for n in fields.values() if isinstance(n, int | np.integer)]
        if set(fields) in ({"sec", "nanosec"}, {"secs", "nsecs"}, {"sec", "nsec"}) and len(numbers) == 2:
            since = numbers[0] * NANOSECONDS + numbers[1]
            row[name] = (since - first if since > first // 2 else since) / NANOSECONDS  # a date, or a duration
            return
        for field, one in fields.items():
            _collect(f"{name}/{field}", one, row, first, depth + 1)


def _joint_names(topic: str, message: Any) -> dict[str, str]:
    """Names of the elements of a message's arrays by the names in it: /joint_states/position[shoulder]."""
    fields = _fields(message)
    names = fields.get("name", fields.get("joint_names"))
    if not isinstance(names, list | tuple) or not all(isinstance(n, str) for n in names):
        return {}
    return {
        f"{topic}/{field}[{n}]": f"{topic}/{field}[{k}]"
        for field, values in fields.items()
        if isinstance(values, np.ndarray | list | tuple) and values is not names and len(values) == len(names)
        for k, n in enumerate(names)
    }

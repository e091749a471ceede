"""Bags of ROS 1 and 2 and MCAP files: columns by topic and field, as /joint_states/position[0]."""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files import common

STAMP = "header.stamp"  # time column that stands for the stamp in each message's own header
MCAP_MAGIC = b"\x89MCAP0\r\n"
NAMES = ("name", "names", "joint_names", "interface_names")  # fields with the names of an array's elements
DEEPEST = 8  # messages in messages; chosen
NANOSECONDS = 1_000_000_000

Message = tuple[str, int, Any]  # topic, time of logging [ns], message


def read_bag(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read a .bag (ROS 1), a .db3 or the folder of a bag of ROS 2."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

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
    from mcap.exceptions import McapError
    from mcap.reader import NonSeekingReader, SeekingReader
    from mcap_ros1.decoder import DecoderFactory as Ros1
    from mcap_ros2.decoder import DecoderFactory as Ros2

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
                notes.append(f"the file breaks off ({common.said(err)}); read up to there")

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


class _Topic:
    """What the messages of a topic hold: times [ns], a row of numbers each, and which element has which name.

    elements: a column named by a joint -> the same one by its place, in the last message; moved: names have changed
    their places along the log, or share them.
    """

    def __init__(self, path: Path) -> None:
        self.times, self.rows = array("q"), common.Rows(path)
        self.elements: dict[str, str] = {}
        self.moved = False

    def add(self, at: int, row: dict[str, float], elements: dict[str, str]) -> None:
        """Add the numbers of a message."""
        self.times.append(at)
        self.rows.add(row)
        if elements != self.elements and elements:
            known = self.elements | elements
            self.moved |= any(self.elements.get(n, k) != k for n, k in elements.items())
            self.moved |= len(set(known.values())) < len(known)
            self.elements = known

    def columns(self, topic: str, notes: list[str]) -> dict[str, np.ndarray]:
        """Return the columns of the topic: elements by place, by name where names have changed their places."""
        columns = self.rows.arrays()
        for name, place in self.elements.items():
            unnamed = columns.pop(place, None)  # of messages without names
            if not self.moved:
                named = columns.pop(name)
                columns[place] = named if unnamed is None else np.where(np.isnan(named), unnamed, named)
        if self.moved:
            notes.append(f"{topic}: names come in several orders; each message is read by its own names")
        return columns


def _table(
    path: Path, messages: Iterator[Message], wanted: frozenset[str], unknown: set[str], notes: list[str]
) -> pd.DataFrame:
    """Make one table of all messages, at the times of logging from the first on, or at those in their headers."""
    topics: dict[str, _Topic] = {}
    first: int | None = None
    for topic, at, message in messages:
        first = at if first is None else first
        row, elements = dict[str, float](), dict[str, str]()
        _collect(topic, message, row, first, 0, (), elements)
        if not row:
            continue
        topics.setdefault(topic, _Topic(path)).add(at, row, elements)
    if unknown:
        notes.append(f"messages of an unknown type are left out: {', '.join(sorted(unknown)[:3])}")
    if first is None or not topics:
        raise LogError(f"{path}: no message with numbers{'; ' + notes[-1] if notes else ''}")
    groups, other = [], dict[str, str]()
    for topic, found in topics.items():
        t: np.ndarray = (np.array(found.times) - first) / NANOSECONDS
        columns = found.columns(topic, notes)
        other |= {} if found.moved else found.elements
        if STAMP in wanted:
            t = columns.get(f"{topic}/header/stamp", np.full(len(t), np.nan))
            if not np.isfinite(t).all():
                notes.append(f"{topic}: has no stamp in a header, left out")
                continue
            if found.moved:  # publishers whose stamps are not in the order of arrival
                order = np.argsort(t, kind="stable")
                t, columns = t[order], {name: values[order] for name, values in columns.items()}
        groups.append((t, columns))
    if not groups:
        raise LogError(f"{path}: no message has a stamp in a header; write another time_column")
    table = common.merged(path, groups)
    notes = [*table.attrs.get(common.NOTES, []), *notes]
    if STAMP in wanted:
        table.insert(0, STAMP, table.iloc[:, 0])
    kept = {name: column for name, column in other.items() if column in table.columns and name not in table.columns}
    table.attrs |= {common.NOTES: notes, common.OTHER_NAMES: kept}
    return table


def _fields(value: Any) -> dict[str, Any]:
    """The fields of a message."""
    if isinstance(value, dict):
        return {str(name): one for name, one in value.items()}
    names = getattr(value, "__dataclass_fields__", None) or getattr(value, "__slots__", None) or ()
    return {name: getattr(value, name, None) for name in names if not name.startswith("_")}


def _collect(
    name: str,
    value: Any,
    row: dict[str, float],
    first: int,
    depth: int,
    names: tuple[str, ...],
    elements: dict[str, str],
) -> None:
    """Collect the numbers of a message by name; a stamp as seconds since the first message.

    names: of the elements of arrays, as the message that holds them gives them. elements: a column named by them -> the
    same one by its place in the array.
    """
    if isinstance(value, bool | int | float | np.number | np.bool_):
        row[name] = float(value)
    elif isinstance(value, np.ndarray | list | tuple):
        if len(value) <= common.MOST_ELEMENTS and depth < DEEPEST:
            for k, one in enumerate(value):
                place = own = f"{name}[{k}]"
                if len(names) == len(value):
                    own = f"{name}[{names[k]}]"
                before = len(row)
                _collect(own, one, row, first, depth + 1, (), elements)
                if own != place:
                    elements |= {n: place + n[len(own) :] for n in list(row)[before:]}
    elif not isinstance(value, str | bytes | bytearray | memoryview) and value is not None and depth < DEEPEST:
        fields = _fields(value)
        numbers = [int(n) for n in fields.values() if isinstance(n, int | np.integer)]
        if set(fields) in ({"sec", "nanosec"}, {"secs", "nsecs"}, {"sec", "nsec"}) and len(numbers) == 2:
            since = numbers[0] * NANOSECONDS + numbers[1]
            row[name] = (since - first if since > first // 2 else since) / NANOSECONDS  # a date, or a duration
            return
        names = next((n for key in NAMES if (n := _names(fields.get(key)))), names)
        for key, one in fields.items():
            _collect(f"{name}/{key}", one, row, first, depth + 1, names, elements)


def _names(value: Any) -> tuple[str, ...]:
    """Return the names of elements that a field holds, () where it holds none that differ."""
    if not isinstance(value, list | tuple) or len(value) > common.MOST_ELEMENTS:
        return ()
    names = tuple(n for n in value if isinstance(n, str) and n)
    return names if len(set(names)) == len(value) else ()

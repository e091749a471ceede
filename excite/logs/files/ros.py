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
from excite.logs.formats import BAG_FOLDER

STAMP = "header.stamp"  # time column that stands for the stamp in each message's own header
MCAP_MAGIC = b"\x89MCAP0\r\n"
NAMES = ("name", "names", "joint_names", "interface_names")  # fields with the names of an array's elements
DEEPEST = 8  # messages in messages; chosen
NANOSECONDS = 1_000_000_000
FEWEST = 20  # messages from which publishers can be told apart

Message = tuple[str, int, Any, str]  # topic, time of logging [ns], message, who sent it as far as the file says


def read_bag(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read a .bag (ROS 1), a .db3 or the folder of a bag of ROS 2."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    in_bag = path.is_file() and path.suffix != ".bag" and (path.parent / BAG_FOLDER).is_file()
    bag = path.parent if in_bag else path
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
                sender = getattr(connection.ext, "callerid", None) or f"connection {connection.id}"
                yield connection.topic, at, message, sender

        return _table(path, messages(), wanted, unknown, [])


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
                        read = decoders[channel.id](message.data)
                        yield channel.topic, message.log_time, read, f"channel {channel.id}"
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
    their places along the log, or share them. senders: number by sender; sent: that of each message.
    """

    def __init__(self, path: Path) -> None:
        self.times, self.rows = array("q"), common.Rows(path)
        self.elements: dict[str, str] = {}
        self.moved = False
        self.senders, self.sent = dict[str, int](), array("q")

    def add(self, at: int, row: dict[str, float], elements: dict[str, str], sender: str) -> None:
        """Add the numbers of a message."""
        self.sent.append(self.senders.setdefault(sender, len(self.senders)))
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
    for topic, at, message, sender in messages:
        first = at if first is None else first
        row, elements = dict[str, float](), dict[str, str]()
        _collect(topic, message, row, first, 0, (), elements)
        if not row:
            continue
        fields = _fields(message)
        said = (_fields(fields.get("header")).get("frame_id"), " ".join(_names_in(fields)))
        sender = ", ".join([sender, *(str(s)[: common.WORDS] for s in said if s)])
        topics.setdefault(topic, _Topic(path)).add(at, row, elements, sender)
    if unknown:
        notes.append(f"messages of an unknown type are left out: {', '.join(sorted(unknown)[:3])}")
    if first is None or not topics:
        raise LogError(f"{path}: no message with numbers{'; ' + notes[-1] if notes else ''}")
    groups, other, unclear = [], dict[str, str](), dict[str, str]()
    for topic, found in topics.items():
        t: np.ndarray = (np.array(found.times) - first) / NANOSECONDS
        sent = np.array(found.sent)
        columns = found.columns(topic, notes)
        other |= {} if found.moved else found.elements
        if STAMP in wanted:
            t = columns.get(f"{topic}/header/stamp", np.full(len(t), np.nan))
            if not np.isfinite(t).all():
                notes.append(f"{topic}: has no stamp in a header, left out")
                continue
            if found.moved or len(found.senders) > 1:  # publishers whose stamps are not in the order of arrival
                order = np.argsort(t, kind="stable")
                t, sent, columns = t[order], sent[order], {name: values[order] for name, values in columns.items()}
        named = {place: own for own, place in found.elements.items()}
        bad = {name: named.get(name, name) for name, x in columns.items() if _contradict(x, sent, "/position" in name)}
        unclear |= dict.fromkeys(bad, _conflict(topic, [*bad.values()], list(found.senders)))
        groups.append((t, columns))
    if not groups:
        raise LogError(f"{path}: no message has a stamp in a header; write another time_column")
    table = common.merged(path, groups)
    notes = [*table.attrs.get(common.NOTES, []), *notes]
    if STAMP in wanted:
        table.insert(0, STAMP, table.iloc[:, 0])
    kept = {name: column for name, column in other.items() if column in table.columns and name not in table.columns}
    table.attrs |= {common.NOTES: notes, common.OTHER_NAMES: kept, common.UNCLEAR: unclear}
    return table


def _contradict(x: np.ndarray, sent: np.ndarray, smooth: bool) -> bool:
    """Return whether senders of one number contradict each other. x (N,): the number; sent (N,): who sent it.

    Values that jump from one message to the next, and hardly from one to the sender's own next, which comes later,
    have several sources. Senders that the file does not tell apart are taken to send in turns of two to
    four, and looked for in what is smooth: a force may vibrate like that.
    """
    there = np.isfinite(x)
    x, sent = x[there], sent[there]
    switched = sent[1:] != sent[:-1]
    if len(x) < FEWEST:
        return False
    if (every := np.bincount(sent)).size > 1 and switched.sum() >= FEWEST:
        own = [np.abs(np.diff(x[sent == k])).mean() for k in np.flatnonzero(every > 1)]
        return bool(own and np.abs(np.diff(x)[switched]).mean() > 1.5 * np.mean(own))
    turns = min(np.abs(x[n:] - x[:-n]).mean() for n in (2, 3, 4))
    return smooth and bool(np.abs(np.diff(x)).mean() > 2 * turns)


def _conflict(topic: str, columns: list[str], senders: list[str]) -> str:
    """Say that the senders of a topic contradict each other in these columns, and what to do."""
    which = ", ".join(c.removeprefix(f"{topic}/") for c in columns[:3]) + ", ..." * (len(columns) > 3)
    told = f" ({'; '.join(senders[:3])})" if len(senders) > 1 else ""
    return (
        f"{topic}: several publishers{told} send {which}, and their values contradict each other; record one of them"
        f' alone (`ros2 topic info -v {topic}` lists them), or try time_column = "{STAMP}" if one is only late'
    )


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
        names = _names_in(fields) or names
        for key, one in fields.items():
            _collect(f"{name}/{key}", one, row, first, depth + 1, names, elements)


def _names_in(fields: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of elements that a message gives in one of its fields, () without."""
    return next((n for key in NAMES if (n := _names(fields.get(key)))), ())


def _names(value: Any) -> tuple[str, ...]:
    """Return the names of elements that a field holds, () where it holds none that differ."""
    if not isinstance(value, list | tuple) or len(value) > common.MOST_ELEMENTS:
        return ()
    names = tuple(n for n in value if isinstance(n, str) and n)
    return names if len(set(names)) == len(value) else ()

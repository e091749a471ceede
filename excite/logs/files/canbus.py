"""Logs of a CAN bus (BLF, ASC, candump): columns as Motor.Torque, by message and signal of the DBC file beside it."""

from __future__ import annotations

import itertools
import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import NOTES, UNITS_SAID, Rows, merged, said
from excite.logs.files.text import read_text
from excite.text import count

OBJECT = struct.Struct("<4sHHII")  # signature, bytes of the header, its version, bytes of the object, kind
CONTAINER = struct.Struct("<H6xL4x")  # method of compression, bytes unpacked
CONTAINER_KIND = 10
DEFLATE = 2  # method
MOST_OF_CONTAINER = 100_000_000  # bytes; loggers fill them up to 128 kB; chosen
FIRST_LINES = 100  # in which a frame is looked for
FIRST_FRAMES = 1000  # by which it is judged whether times are those since the frame before
STANDARD, EXTENDED, ERROR = 0x7FF, 0x1FFF_FFFF, 0x2000_0000  # bits of an identifier; linux/can.h
STANDARD_DIGITS = 3  # of an identifier of 11 bits
FRAME = re.compile(  # (1.5) can0 123#0011, 123##10011, 123#R and (1.5)  can0  RX - -  123   [2]  00 11
    r"\((?P<time>(?:\d{4}-\d\d-\d\d \d\d:\d\d:)?\d+\.\d+)\)\s+(?P<channel>\S+)(?:\s+[TR]X)?(?:\s+[-BE]){0,2}"
    r"\s+(?P<id>[0-9A-Fa-f]{3,8})(?:#(?:R\d?|(?:#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2}\.?)*))(?:\s+[TR])?"
    r"|\s+\[(?P<size>\d+)\]\s*(?:remote request|(?P<shown>[0-9A-Fa-f` ]*)(?:'.*|ERRORFRAME)?))$"
)
UNTIMED = re.compile(r"\w+\s+[0-9A-Fa-f]{3,8}\s+\[\d+\]\s")
DATABASES = (".dbc", ".kcd", ".sym", ".arxml")


def read_can(path: Path, wanted: frozenset[str]) -> pd.DataFrame:
    """Read the signals of all messages that the DBC file describes, each message at its own times."""
    dumped = path.suffix.lower() not in (".blf", ".asc")
    if dumped and not is_candump(path):
        return read_text(path, wanted)
    import can
    import cantools

    database = _database(path, cantools)
    if path.suffix.lower() == ".blf":
        _refuse_stuck(path)
    used = {w.rpartition(".")[0].strip().lower() for w in wanted} & {m.name.lower() for m in database.messages}
    known = {m.frame_id: m for m in database.messages if not used or m.name.lower() in used}
    times: dict[tuple[int, Any], list[float]] = {}
    rows: dict[tuple[int, Any], Rows] = {}
    undecoded: dict[str, int] = {}
    notes: list[str] = []
    seen = 0
    with _candump(path, notes) if dumped else can.LogReader(path) as log:
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
                rows.setdefault(key, Rows(path)).add(numbers)
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
        groups.append((np.array(times[key]) - first, {f"{own}.{n}": x for n, x in found.arrays().items()}))
        units |= {f"{own}.{s.name}": s.unit for s in message.signals if s.unit}
    table = merged(path, groups)
    kept = {name: unit for name, unit in units.items() if name in table.columns}
    table.attrs |= {UNITS_SAID: kept, NOTES: [*table.attrs.get(NOTES, []), *notes]}
    return table


def is_candump(path: Path) -> bool:
    """Tell if a file is what candump of can-utils writes: one of its first lines is a frame."""
    with path.open("rb") as file:
        first = [line.decode(errors="replace").strip() for line in itertools.islice(file, FIRST_LINES)]
    return any(FRAME.match(line) or UNTIMED.match(line) for line in first)


@contextmanager
def _candump(path: Path, notes: list[str]) -> Iterator[Iterator[Any]]:
    """Give the frames of candump's log file or of what it shows; what is no frame is noted. Raises LogError."""
    with path.open(encoding="utf-8", errors="replace") as file:
        frames = _frames(path, file, notes)
        first = list(itertools.islice(frames, FIRST_FRAMES))
        every: Iterator[Any] = itertools.chain(first, frames)
        if _since_frame_before([frame.timestamp for frame in first]):
            notes.append("times are those since the frame before (candump -t d), added up")
            every = _added_up(every)
        yield every


def _frames(path: Path, lines: Iterable[str], notes: list[str]) -> Iterator[Any]:
    """Yield the frames of lines at the times that these give. Raises LogError for frames without times."""
    import can

    strange = 0
    for line in map(str.strip, lines):
        found = FRAME.match(line)
        try:
            at, data = (0.0, b"") if found is None else (_seconds(found["time"]), _data(found))
        except ValueError:  # a day that no calendar has, or not as many bytes as are said
            found = None
        if found is None:
            if UNTIMED.match(line):
                raise LogError(f"{path}: frames without times: record with `candump -l`, or `candump -t a`")
            strange += bool(line)
            continue
        name = found["id"]
        extended = len(name) > STANDARD_DIGITS
        yield can.Message(
            timestamp=at,
            arbitration_id=int(name, 16) & (EXTENDED if extended else STANDARD),
            is_extended_id=extended,
            is_error_frame=bool(int(name, 16) & ERROR) and extended,
            is_remote_frame=data is None,
            data=data,
            is_fd=True,
            channel=found["channel"],
        )
    if strange:
        notes.append(f"{count(strange, 'line is', 'lines are')} no frame, left out")


def _seconds(text: str) -> float:
    """Return the time [s] that a line gives, as a number or with its date. Raises ValueError."""
    return float(text) if "-" not in text else datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()


def _data(found: re.Match[str]) -> bytes | None:
    """Return the bytes of a frame, None of a remote one; `between them: in reverse. Raises ValueError."""
    if found["shown"] is None:
        return None if found["data"] is None else bytes.fromhex(found["data"].replace(".", ""))
    cells = found["shown"].replace("`", " ").split()
    if len(cells) != int(found["size"]):
        raise ValueError(f"{len(cells)} bytes")
    bits = all(len(cell) == 8 for cell in cells)
    return bytes(int(cell, 2 if bits else 16) for cell in (reversed(cells) if "`" in found["shown"] else cells))


def _since_frame_before(times: Sequence[float]) -> bool:
    """Tell if times [s] begin at zero and do not grow: the last third is no later than the first."""
    third = len(times) // 3
    return third > 1 and times[0] == 0.0 and bool(np.median(times[-third:]) <= np.quantile(times[:third], 0.9))


def _added_up(frames: Iterable[Any]) -> Iterator[Any]:
    """Yield frames whose times are those since the frame before at the times since the first one."""
    at = 0.0
    for frame in frames:
        at += frame.timestamp
        frame.timestamp = at
        yield frame


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

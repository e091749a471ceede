"""Damaged log files: seeds changed at random, read in a process of its own that may crash, hang or want much memory.

python damage.py: read the files named on standard input, answer each with a line of JSON.
"""

from __future__ import annotations

import gzip
import importlib
import io
import json
import os
import resource
import selectors
import subprocess
import sys
import time
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from excite.errors import LogError
from excite.logs import preparation, tables
from excite.model import Model, prediction
from excite.model.machine import load_machine

LIBRARIES = ("asammdf", "can", "cantools", "h5py", "mcap.reader", "mcap_ros1.decoder", "mcap_ros2.decoder", "openpyxl")
LIBRARIES += ("nptdms", "pyarrow.parquet", "pyulog", "rosbags.highlevel", "scipy.io")
ROOM = 4 << 30  # bytes of address space, most of which libraries reserve and never use
SLOWEST = 20.0  # s for a file of 10 kB
MOST_GROWTH = 600.0  # MB that reading a file of 10 kB may take
HUGE = [
    b"\xff" * 8,
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0" * 8,
    b"9" * 12,
    b"\0\0\0\0\1\0\0\0",
    b"\0\0\0\x10",
    b"\xff\xff\xff\xff\xff\xff\xff\x7f",
    b"\0\xca\x9a\x3b\0\0\0\0",
]
ODD = [
    *("", " ", "nan", "NaN", "inf", "-inf", "1e400", "1e308", "-1e308", "1e-400", "9" * 400, "9" * 19, str(2**64)),
    *("0x10", "1_000", "1.2.3", "1,5", "1.234,5", "--1", "+", "-", "e", "1e", "1e+", "#", "%", "#N/A", "NULL", "None"),
    *('"', '""', '"a', "'", "\u00b5", "\u0663", "\u4e2d", "\U0001f600", "\u2028", "\u200b", "\ufeff", "\x85", "\x1a"),
    *("2024-05-03", "10:00:00", "3.5.2024 10:00:00", "31.02.2024 25:61:61", "2024-13-45T99:99:99", "99999-01-01"),
    *(
        "\t",
        ";",
        ",",
        "|",
        "\n",
        "\r",
        "\r\n",
        "a\nb",
        "\0",
        "sep=;",
        "=1+1",
        "1 2",
        "Infinity",
        "1d5",
        "(1)",
        "\u22121",
    ),
    *("True", "x" * 1000),
]


def damage_bytes(raw: bytes, rng: np.random.Generator) -> bytes:
    """Change bytes, cut, repeat, swap or blank blocks, or make numbers huge."""
    data = bytearray(raw)
    for _ in range(int(rng.geometric(0.5))):
        n = len(data)
        if n < 16:
            break
        at = int(rng.integers(n)) if rng.random() < 0.5 else int(rng.integers(min(n, 600)))
        if rng.random() < 0.2:
            at = n - 1 - at  # formats with a footer
        size = int(2 ** rng.uniform(0, 9))
        match int(rng.integers(10)):
            case 0 | 1:
                data[at] = int(rng.integers(256))
            case 2:
                data[at : at + size] = rng.bytes(size)
            case 3:
                del data[at : at + size]
            case 4:
                data[at:at] = data[at : at + size] * int(rng.integers(1, 20))
            case 5:
                if rng.random() < 0.4:
                    del data[at + 1 :]
            case 6 | 7:
                put = HUGE[int(rng.integers(len(HUGE)))]
                at = at // 4 * 4 if rng.random() < 0.7 else at
                data[at : at + len(put)] = put
            case 8:
                other = int(rng.integers(n))
                a, b = sorted((at, other))
                size = min(size, b - a, n - b)
                data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]
            case _:
                data[at : at + size] = bytes(size)
    return bytes(data)


def damage_text(raw: bytes, rng: np.random.Generator) -> bytes:
    """Change cells, lines and what is between them."""
    lines = raw.decode().split("\n")
    for _ in range(int(rng.geometric(0.5))):
        k = int(rng.integers(len(lines))) if rng.random() < 0.6 else int(rng.integers(min(3, len(lines))))
        between = next((s for s in "\t;, " if s in lines[k]), ",")
        cells = lines[k].split(between)
        n = int(rng.integers(len(cells)))
        odd = ODD[int(rng.integers(len(ODD)))]
        match int(rng.integers(12)):
            case 0 | 1 | 2 | 3:
                cells[n] = odd
            case 4:
                cells[n] += odd
            case 5:
                cells.insert(n, odd)
            case 6:
                del cells[n]
            case 7:
                cells = between.join(cells).split(between)
                between = "\t;, |"[int(rng.integers(5))]
            case 8:
                column = int(rng.integers(len(cells)))
                lines = [_with_cell(line, between, column, odd) if rng.random() < 0.5 else line for line in lines]
                continue
            case 9:
                other = int(rng.integers(len(lines)))
                lines[k], lines[other] = lines[other], lines[k]
                continue
            case 10:
                lines[k:k] = lines[k : k + int(rng.integers(1, 40))] * int(rng.integers(1, 4))
                continue
            case _:
                del lines[k : k + int(rng.integers(1, 4))]
                lines = lines or [""]
                continue
        lines[k] = between.join(cells)
    end = ("\n", "\r\n", "\r")[int(rng.choice(3, p=[0.8, 0.1, 0.1]))]
    text = end.join(lines)
    encoding = "utf-8" if rng.random() < 0.8 else ("utf-8-sig", "utf-16", "cp1252", "utf-16-le")[int(rng.integers(4))]
    return text.encode(encoding, errors="replace")


def _with_cell(line: str, between: str, column: int, cell: str) -> str:
    cells = line.split(between)
    if column < len(cells):
        cells[column] = cell
    return between.join(cells)


def damaged(path: Path, raw: bytes, rng: np.random.Generator) -> bytes:
    """A file changed as its format lets changes through: packed parts are changed inside as well."""
    suffix, inside = path.suffix, rng.random() < 0.6
    if suffix in (".csv", ".tsv", ".txt", ".asc", ".dbc", ".yaml", ".lvm", ".log") and inside:
        return damage_text(raw, rng)
    if suffix == ".gz" and inside:
        return gzip.compress(damage_text(gzip.decompress(raw), rng))
    if suffix == ".xlsx" and inside:
        change = _in_xml if rng.random() < 0.6 else damage_bytes
        return in_zip(raw, lambda data: change(data, rng), None if rng.random() < 0.5 else int(rng.integers(20)))
    if suffix == ".blf" and inside:
        return in_blf(raw, lambda data: damage_bytes(data, rng))
    if suffix == ".mat" and inside and raw[124:128] == b"\0\1IM" and raw[128] == 15:
        return _in_mat(raw, rng)
    return damage_bytes(raw, rng)


def in_zip(raw: bytes, change: Callable[[bytes], bytes], chosen: int | None = None) -> bytes:
    """A workbook with one of its parts changed, by default its first sheet."""
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(raw)) as old, zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        part = "xl/worksheets/sheet1.xml" if chosen is None else names[chosen % len(names)]
        for name in names:
            data = old.read(name)
            new.writestr(name, change(data) if name == part else data)
    return made.getvalue()


def _in_xml(raw: bytes, rng: np.random.Generator) -> bytes:
    """A part of a workbook with values and attributes changed."""
    parts = raw.decode().split("<")
    for _ in range(int(rng.integers(1, 8))):
        k = int(rng.integers(1, len(parts)))
        odd = ODD[int(rng.integers(len(ODD)))].replace("<", "").replace("&", "")
        match int(rng.integers(5)):
            case 0 | 1:
                parts[k] = parts[k].partition(">")[0] + ">" + odd
            case 2:
                words = parts[k].split('"')
                if len(words) > 2:
                    words[1 + 2 * int(rng.integers(len(words) // 2))] = odd
                parts[k] = '"'.join(words)
            case 3:
                other = int(rng.integers(1, len(parts)))
                parts[k], parts[other] = parts[other], parts[k]
            case _:
                parts[k] = parts[k].replace('t="n"', f't="{"dsbex"[int(rng.integers(5))]}"')
    return "<".join(parts).encode(errors="replace")


def in_blf(raw: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """A CAN log with the objects in its first container changed."""
    at = int.from_bytes(raw[4:8], "little")
    size, method = int.from_bytes(raw[at + 8 : at + 12], "little"), raw[at + 16]
    begin = at + 32
    data = raw[begin : at + size]
    data = change(zlib.decompress(data) if method == 2 else data)
    packed = zlib.compress(data)
    head = bytearray(raw[:begin])
    head[at + 8 : at + 12] = (32 + len(packed)).to_bytes(4, "little")
    head[at + 16] = 2
    head[at + 24 : at + 28] = len(data).to_bytes(4, "little")
    return bytes(head) + packed + bytes(len(packed) % 4) + raw[at + size + size % 4 :]


def _in_mat(raw: bytes, rng: np.random.Generator) -> bytes:
    """A MATLAB file with a packed variable changed."""
    size = int.from_bytes(raw[132:136], "little")
    packed = zlib.compress(damage_bytes(zlib.decompress(raw[136 : 136 + size]), rng))
    return raw[:132] + len(packed).to_bytes(4, "little") + packed + raw[136 + size :]


@dataclass(frozen=True)
class Answer:
    """What reading a file came to: "table", "refused", or a fault; seconds, and MB that it took at most."""

    kind: str
    what: str
    seconds: float
    grown: float

    @property
    def good(self) -> bool:
        return self.kind in ("table", "refused")


class Child:
    """A process that reads files."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None

    def start(self) -> subprocess.Popen[str]:
        here = Path(__file__).resolve()
        started = subprocess.Popen(
            [sys.executable, str(here)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(here.parents[2]), str(here.parents[1])])},
        )
        assert started.stdout is not None
        assert started.stdout.readline() == "ready\n"
        return started

    def read(self, path: Path, wanted: Iterable[str] = (), machine: str = "") -> Answer:
        """Read a file, with a machine prepare it as well; a child that crashes or hangs is started anew."""
        self.process = self.process or self.start()
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        begin = time.monotonic()
        self.process.stdin.write(json.dumps([str(path), list(wanted), machine]) + "\n")
        self.process.stdin.flush()
        with selectors.DefaultSelector() as ready:
            ready.register(self.process.stdout, selectors.EVENT_READ)
            answers = bool(ready.select(SLOWEST))
        line = self.process.stdout.readline() if answers else ""
        if line:
            return Answer(*json.loads(line))
        self.process.kill()
        self.end()
        return Answer("crash" if answers else "hang", "", time.monotonic() - begin, 0.0)

    def end(self) -> None:
        if self.process is not None:
            self.process.communicate()
            self.process = None


def answers(
    child: Child, seeds: dict[str, Path], count: int, seed: int, machine: str = "", wanted: Iterable[str] = ()
) -> Iterator[tuple[str, int, Answer]]:
    """Damage and read so many files, one format after the other; give format, number and answer of each."""
    raws = {name: path.read_bytes() for name, path in seeds.items()}
    for k in range(count):
        name = list(seeds)[k % len(seeds)]
        path, rng = seeds[name], np.random.default_rng([seed, k])
        path.write_bytes(damaged(path, raws[name], rng))
        target = {".dbc": path.with_suffix(".asc"), ".yaml": path.parent}.get(path.suffix, path)
        yield name, k, child.read(target, wanted if rng.random() < 0.5 else (), machine)
        path.write_bytes(raws[name])


def _read(path: str, wanted: list[str], machine: str) -> str:
    """Read a file; what is wrong with what it gave, "" if nothing. Raises LogError."""
    table = tables.with_names(tables.read_table(path, wanted), wanted)
    if table.empty or not all(isinstance(name, str) for name in table.columns):
        return "no table"
    if not machine:
        return ""
    made = preparation.prepare(_model(machine), [path])
    for one in made.logs:
        if not np.isfinite(one.t).all() or not (np.diff(one.t) > 0).all():
            return "times that do not increase"
        for name, values in one.values.items():
            if len(values) != len(one) or not np.isfinite(values).all():
                return f"{name} is not finite"
    return "" if made.logs and not any("\n" in note for note in made.notes) else "no logs, or a note of several lines"


@lru_cache
def _model(machine: str) -> Model:
    return prediction.build(load_machine(machine))


def _outcome(path: str, wanted: list[str], machine: str) -> tuple[str, str]:
    """What reading a file came to, and its message."""
    try:
        fault = _read(path, wanted, machine)
    except LogError as err:
        named = any(part in str(err) for part in (Path(path).name, Path(path).stem))
        return "refused" if named and "\n" not in str(err) else "not one line", str(err)
    except BaseException as err:
        return "error", "".join(traceback.format_exception(err)[-4:])
    return ("wrong", fault) if fault else ("table", "")


def _peak() -> float:
    """Most memory [MB] since it was last forgotten."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def main() -> None:
    out, sys.stdout = sys.stdout, io.StringIO()
    resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))
    for library in LIBRARIES:  # what loading them takes is no fault of a file
        importlib.import_module(library)
    print("ready", file=out, flush=True)
    for line in sys.stdin:
        path, wanted, machine = json.loads(line)
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak
        before, begin = _peak(), time.monotonic()
        kind, what = _outcome(path, wanted, machine)
        spent, grown = time.monotonic() - begin, _peak() - before
        if kind in ("table", "refused") and grown > MOST_GROWTH:
            kind = "memory"
        print(json.dumps([kind, what, round(spent, 3), round(grown)]), file=out, flush=True)


if __name__ == "__main__":
    main()

"""Text that LabVIEW (measurement files, .lvm) and TwinCAT Scope write: settings above, times of each channel's own."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import MOST_COLUMNS, NOTES, UNITS_SAID, merged, name_the_same, numbered
from excite.logs.files.layout import is_data, known_unit, width

END_OF_HEADER = "***End_of_Header***"
LABVIEW = "LabVIEW Measurement"
X_NAME = "X_Value"
SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": " "}
SCOPE_KEYS = ("symbolbased", "data-type", "sampletime[ms]", "variablesize", "symbolcomment")  # of TwinCAT Scope
SCOPE_LINES = 60  # in which a scope's settings begin; chosen
FILETIME_S = 1e-7  # [s] of Windows' clock, of which numbers beyond LATEST_MS are
LATEST_MS = 1e15
MILLISECOND = 1e-3  # [s] of TwinCAT's times
Group = tuple[np.ndarray, dict[str, np.ndarray]]  # times (N,) [s] and channels (N,)


def read_scope(path: Path, raw: bytes, notes: list[str]) -> pd.DataFrame | None:
    """Read an export of LabVIEW or TwinCAT Scope; None for any other text. Raises LogError."""
    head = raw[: 1 << 16].decode(errors="replace")
    if head.lstrip().startswith(LABVIEW) or END_OF_HEADER in head:
        groups, units = _labview(path, raw.decode(errors="replace").split("\n"), notes)
    elif sum(key in head.lower() for key in SCOPE_KEYS) > 1:
        lines = raw.decode(errors="replace").split("\n")
        begin = _scope_settings(lines)
        if begin is None:
            return None
        groups, units = _twincat(path, lines, begin, notes)
    else:
        return None
    if not any(len(t) for t, _ in groups):
        raise LogError(f"{path}: no rows of data below the settings")
    table = merged(path, [(t, columns) for t, columns in groups if len(t)])
    table.attrs |= {
        NOTES: [*table.attrs.get(NOTES, []), *notes],
        UNITS_SAID: {name: unit for name, unit in units.items() if name in table.columns},
    }
    return table


# ------------------------------------------------------------------------------------------------ LabVIEW


def _labview(path: Path, lines: list[str], notes: list[str]) -> tuple[list[Group], dict[str, str]]:
    """Read the segments of a LabVIEW measurement file, each with settings of its own."""
    marks = [k for k, line in enumerate(lines) if line.lstrip().startswith(END_OF_HEADER)]
    settings = {cells[0].strip(): cells[1].strip() for line in lines[: marks[0]] if len(cells := line.split("\t")) > 1}
    names_at = marks[-1] + 1 if len(marks) == 1 else marks[1] + 1
    sample = lines[names_at] if names_at < len(lines) else ""
    separator = SEPARATORS.get(settings.get("Separator", "").lower()) or max("\t;,", key=sample.count)
    if not settings:  # written with another separator than tabs
        settings = {c[0].strip(): c[1].strip() for line in lines[: marks[0]] if len(c := line.split(separator)) > 1}
    row = lines[names_at + 1] if names_at + 1 < len(lines) else ""
    unsaid = "," if separator != "," and "," in row and "." not in row else "."  # by early versions
    comma = "," if settings.get("Decimal_Separator", unsaid) == "," else "."
    every, units = list[list[Group]](), dict[str, str]()
    names: list[str] = []
    starts: list[float] = []
    heads = marks if len(marks) == 1 else marks[1:]
    for n, mark in enumerate(heads):
        begin = mark + 1
        head = _settings_above(lines, mark, separator) if len(marks) > 1 else {}
        if begin < len(lines) and not _is_data(lines[begin], separator, comma):
            first, *rest = (cell.strip() for cell in lines[begin].split(separator))
            names, begin = [first or X_NAME, *rest], begin + 1  # a file without X columns may leave its place blank
        end = next((k for k in range(begin, len(lines)) if not _is_data(lines[k], separator, comma)), len(lines))
        after = range(end, (*heads, len(lines))[n + 1])
        if any(_is_data(lines[k], separator, comma) for k in after):
            raise LogError(f"{path}: line {end + 1}: is {lines[end][:30]!r}, and rows of numbers go on below; cut it")
        if not names:
            raise LogError(f"{path}: line {mark + 2}: no line with the names of channels behind {END_OF_HEADER}")
        named = [name for name in names[: width(names)] if name != "Comment"]
        table = _numbers(path, lines[begin:end], separator, comma, len(named), begin)
        date = pd.to_datetime(f"{_of(head, 'Date', 0)} {_of(head, 'Time', 0)}".replace(",", "."), errors="coerce")
        starts.append(date.timestamp() if pd.notna(date) else np.nan)
        late = starts[n] - starts[0] if np.isfinite(starts[n] - starts[0]) else 0.0
        groups, units = _channels(named, table, head)
        if not n:
            notes += name_the_same([name for name in named if name != X_NAME], f"line {begin}")
        every.append(_after(every[-1] if every else [], groups, late))
    if len(every) > 1:
        notes.append(f"{len(every)} segments, read one after the other")
    joined = [_joined([part[k] for part in every if k < len(part)]) for k in range(max(map(len, every)))]
    # one clock keeps its name, so that a machine file may name it
    return [(t, {X_NAME: t, **c} if len(joined) == 1 else c) for t, c in joined], units


def _settings_above(lines: Sequence[str], mark: int, separator: str) -> dict[str, list[str]]:
    """Return the settings of a segment by key, a value for each channel, from the lines above the end of its header."""
    found: dict[str, list[str]] = {}
    for k in range(mark - 1, -1, -1):
        cells = lines[k].split(separator)
        if is_data(cells) or lines[k].lstrip().startswith(END_OF_HEADER):
            break
        found[cells[0].strip()] = [cell.strip() for cell in cells[1:]]
    return found


def _channels(
    named: Sequence[str], cells: np.ndarray, head: dict[str, list[str]]
) -> tuple[list[Group], dict[str, str]]:
    """Give each channel the X column to the left of it, or the even times that its settings say."""
    clocks = [k for k, name in enumerate(named) if name == X_NAME]
    channels = [k for k, name in enumerate(named) if name != X_NAME]
    called = dict(zip(channels, numbered([named[k] for k in channels]), strict=True))
    units = {name: unit for n, name in enumerate(called.values()) if (unit := _of(head, "Y_Unit_Label", n))}
    groups: dict[tuple[int, float, float], Group] = {}
    for n, k in enumerate(channels):
        clock = max((c for c in clocks if c < k), default=-1)
        there = np.isfinite(cells[:, k])
        if clock >= 0 and np.isfinite(cells[:, clock]).any():
            key, t = (clock, 0.0, 0.0), cells[:, clock]
            there = np.isfinite(t)
        else:
            start, step = _float(_of(head, "X0", n), 0.0), _float(_of(head, "Delta_X", n), 0.0)
            key, t = (-1, start, step or 1.0), start + (step or 1.0) * np.arange(len(cells))
            there = np.ones(len(cells), bool)
        group = groups.setdefault(key, (t[there], {}))
        group[1][called[k]] = cells[there, k]
    return list(groups.values()), units


def _after(before: list[Group], groups: list[Group], late: float) -> list[Group]:
    """Move a segment whose times begin anew by what its date is later than that of the first one [s]."""
    ends = [float(t[-1]) for t, _ in before if len(t)]
    starts = [float(t[0]) for t, _ in groups if len(t)]
    if not ends or not starts or min(starts) > max(ends) or min(starts) + late <= max(ends):
        return groups
    return [(t + late, columns) for t, columns in groups]


def _joined(parts: Sequence[Group]) -> Group:
    """Put the segments of channels with one clock one after the other."""
    frame = pd.concat([pd.DataFrame({X_NAME: t, **columns}) for t, columns in parts], ignore_index=True)
    return frame[X_NAME].to_numpy(), {str(n): frame[n].to_numpy(dtype=float) for n in frame if n != X_NAME}


def _of(head: dict[str, list[str]], key: str, channel: int) -> str:
    values = head.get(key, [])
    return values[channel] if channel < len(values) else ""


def _float(text: str, otherwise: float) -> float:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return otherwise
    return value if np.isfinite(value) else otherwise


# ------------------------------------------------------------------------------------------------ TwinCAT Scope


def _scope_settings(lines: Sequence[str]) -> int | None:
    """Return the line (from 0) where the channels' settings begin, None where there are none."""
    at = next((k for k, line in enumerate(lines[:SCOPE_LINES]) if _key(line) in SCOPE_KEYS), None)
    if at is None:
        return None
    while at > 0 and lines[at - 1].strip():
        at -= 1
    return at if _key(lines[at]) == "name" else None


def _key(line: str) -> str:
    return re.split(r"[\t;,]", line, maxsplit=1)[0].strip().strip('"').lower()


def _twincat(path: Path, lines: list[str], begin: int, notes: list[str]) -> tuple[list[Group], dict[str, str]]:
    """Read a column of times [ms] and one of values for each channel, below a block of settings."""
    separator = max("\t;,", key=lines[begin].count)
    comma = "," if separator != "," and any("," in line for line in lines[begin:][:SCOPE_LINES][-5:]) else "."
    start = next((k for k in range(begin, len(lines)) if _is_data(lines[k], separator, comma)), len(lines))
    settings = {_key(line): _cells(line, separator) for line in lines[begin:start] if line.strip()}
    names = settings["name"]
    paired = len(names) > 2 and all(cell.lower() == "name" for cell in names[::2])
    channels = [name for name in (names[1::2] if paired or len(names) == 2 else names[1:]) if name]
    rows = [line for line in lines[start:] if line.strip()]
    own_times = bool(rows) and len(rows[0].split(separator)) >= 2 * len(channels)
    wide = 2 * len(channels) if own_times else 1 + len(channels)
    cells = _numbers(path, rows, separator, comma, wide, start)
    called = numbered(channels)
    notes += name_the_same(channels, f"line {begin + 1}")
    groups = []
    for n, name in enumerate(called):
        clock, value = (2 * n, 2 * n + 1) if own_times else (0, n + 1)
        there = np.isfinite(cells[:, clock])
        t = cells[there, clock]
        unit = FILETIME_S if len(t) and t[0] > LATEST_MS else MILLISECOND
        groups.append(((t - (t[0] if unit == FILETIME_S else 0.0)) * unit, {name: cells[there, value]}))
    step = 2 if paired or len(names) == 2 else 1
    for key, none in (("offset", 0.0), ("scalefactor", 1.0)):
        values = settings.get(key, [])[1::step]
        odd = [f"{name} {v}" for name, v in zip(called, values, strict=False) if _float(v, none) != none]
        notes += [f"{key} of {', '.join(odd[:3])}: the scope's, taken as applied to the values"] if odd else []
    said = zip(called, settings.get("unit", [])[1::step], strict=False)
    return groups, {name: known_unit(unit) or unit for name, unit in said if unit}


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(separator)]


# ------------------------------------------------------------------------------------------------ rows


def _is_data(line: str, separator: str, comma: str) -> bool:
    return is_data(line.replace(comma, ".").split(separator))


def _numbers(path: Path, rows: Sequence[str], separator: str, comma: str, wide: int, begin: int) -> np.ndarray:
    """Return the numbers (N, wide) of rows, NaN where a cell is blank; further cells hold comments. Raises LogError."""
    if not 0 < wide <= MOST_COLUMNS:
        raise LogError(f"{path}: line {begin}: {wide} channels, 1 to {MOST_COLUMNS} are read")
    try:
        table = pd.read_csv(
            io.StringIO("\n".join(_padded(rows, separator, wide))),
            sep=separator,
            header=None,
            names=range(wide),
            usecols=range(wide),
            decimal=comma,
            skip_blank_lines=False,
            index_col=False,
            dtype=str if not rows else None,
            quoting=3,
        )
    except (ValueError, pd.errors.ParserError) as err:
        raise LogError(f"{path}: line {begin + 1}: no table of {wide} columns: {err}") from None
    for name in table:
        if table[name].dtype.kind not in "fiub":
            number = pd.to_numeric(table[name], errors="coerce")
            wrong = number.isna() & table[name].notna() & (table[name].astype(str).str.strip() != "")
            if wrong.any():
                k = int(np.argmax(wrong.to_numpy()))
                raise LogError(f"{path}: line {begin + k + 1}: {str(table[name].iloc[k])[:30]!r} is no number")
            table[name] = number
    return table.to_numpy(dtype=float)


def _padded(rows: Sequence[str], separator: str, wide: int) -> Iterator[str]:
    """Give the rows with that many cells each."""
    for row in rows:
        more = row.count(separator) + 1 - wide
        yield row if more == 0 else row + separator * -more if more < 0 else separator.join(row.split(separator)[:wide])

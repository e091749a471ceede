"""A machine's channels as its logger recorded them, each reading at its own time, and what a check finds in one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import clocks, log
from excite.logs.log import Log
from excite.logs.resampling import BRIDGED_STEPS
from excite.logs.times import date_and_time, has_time, seconds
from excite.model.machine import Machine, Sensor

WRONG_RATE = 50.0  # times the machine file's rate or a part of it: time in another unit; chosen


@dataclass(frozen=True)
class Channel:
    """A sensor's readings x (n,) [SI] at times t (n,) [s], which stand in rows (n,) of the file, from 0."""

    sensor: Sensor
    t: np.ndarray
    x: np.ndarray
    rows: np.ndarray

    @property
    def name(self) -> str:
        return f"column {' - '.join(self.sensor.columns)}"

    def row(self, k: int) -> int:
        """Number of a reading's row in the file, from 1."""
        return int(self.rows[k]) + 1


@dataclass(frozen=True)
class Finding:
    """Finding of a check in a sensor's channel. spans: first and last time [s] of each bad stretch."""

    check: str
    kind: Literal["fault", "doubt", "remark"]
    sensor: str
    text: str
    spans: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Record:
    """A machine's channels by sensor name, as recorded.

    clocks: times (N,) of clocks that nothing uses, by column, at rows with times t (N,) [s]. one_origin: those of them
    that may be shifted against the machine's.
    """

    machine: Machine
    channels: dict[str, Channel]
    t: np.ndarray = field(default_factory=lambda: np.empty(0))
    clocks: dict[str, np.ndarray] = field(default_factory=dict)
    one_origin: frozenset[str] = frozenset()

    def of(self, check: str) -> list[Channel]:
        """Channels that a check looks at."""
        return [c for c in self.channels.values() if check not in c.sensor.checks_off and len(c.x) > 1]


def record_of(table: pd.DataFrame, machine: Machine) -> tuple[Record, dict[str, str]]:
    """Read the channels of a table; what is wrong with cells of those that can't be read, by column."""
    channels: dict[str, Channel] = {}
    unread: dict[str, str] = {}
    nominal = float(machine.sampling_hz)
    try:
        t = seconds(table, machine, "") if has_time(table, machine) else None
    except LogError:
        t = None
    if t is None or not 1 / WRONG_RATE < usual_step(t) * nominal < WRONG_RATE:
        t, others = np.arange(len(table)) / nominal, {}  # times in another unit say nothing of the readings
    else:
        others = clocks.other_clocks(table, log.columns_known(machine) | set(date_and_time(table) or ()))
    for sensor in machine.sensors("full"):
        needed = log.columns_read(sensor, machine)
        if not set(needed) <= set(table.columns):
            continue
        there = np.ones(len(table), bool)
        bad = False
        for name in needed:
            try:
                there &= np.isfinite(log.cells_of(table, name, ""))
            except LogError as err:
                unread[name] = str(err).removeprefix(": ")
                bad = True
        if bad or not there.any():
            continue
        rows = np.flatnonzero(there)
        part = table if there.all() else table.iloc[rows].set_axis(range(len(rows)))
        try:
            channels[sensor.name] = Channel(sensor, t[rows], log.values_of(sensor, machine, part, ""), rows)
        except LogError as err:
            unread[sensor.column] = str(err).removeprefix(": ")
    used = {c for s in machine.sensor for c in s.columns}
    own = frozenset(c for c in others if clocks.between_channels(table, c, machine.time_column, used))
    return Record(machine, channels, t, others, own), unread


def record_of_log(machine: Machine, one: Log) -> Record:
    """Take a log's channels for what was recorded, without what is interpolated."""
    rows = np.arange(len(one))
    channels = {}
    for s in machine.sensors("full"):
        if s.name in one.values:
            there = one.read_in(s.name)
            channels[s.name] = Channel(s, one.t[there], one.values[s.name][there], rows[there])
    return Record(machine, channels)


def usual_step(t: np.ndarray) -> float:
    """Usual step [s] of times (n,) [s], 1 where they have none."""
    dt = np.diff(t)
    ahead = dt[dt > 0]
    if not len(ahead):
        return 1.0
    return float(np.mean(dt[(dt >= 0) & (dt <= BRIDGED_STEPS * np.median(ahead))]))

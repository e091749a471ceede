"""Repair of a log before it is used: spikes and drop-outs."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import LogError
from excite.logs.log import Log
from excite.logs.plausibility import doubts
from excite.model.machine import Machine, Sensor

SPIKE = 10.0  # robust deviations from the neighbours that make an outlier
STEPS = 8.0  # counts, likewise
MANY = 0.005  # share of a channel's samples that may be repaired
HELD = 8  # equal readings in a row that make a drop-out
DEAD = 100  # the same for a channel that ends so
JUMP = 3.0  # times as far, at the end of such a stretch, as the encoder moves in a sample elsewhere
NEEDED = ("angle", "torque", "wheel")  # kinds of sensor that no method does without


@dataclass(frozen=True)
class Examination:
    """A log repaired, and what was found: notes; spikes {sensor: rows}; drop-outs {sensor: [(first, last) row]}; and
    what else is doubtful about it, a line each."""

    log: Log
    notes: tuple[str, ...]
    spikes: dict[str, tuple[int, ...]]
    dropouts: dict[str, tuple[tuple[int, int], ...]]
    doubts: tuple[str, ...] = ()


def examine(machine: Machine, log: Log) -> Examination:
    """Spikes of a single sample are replaced by the mean of their neighbours, with a note; drop-outs are noted.

    Raises LogError where a channel has more spikes than repair can answer for, or a drop-out in which the machine moves
    on: cut the log there.
    """
    values = dict(log.values)
    notes: list[str] = []
    spikes: dict[str, tuple[int, ...]] = {}
    dropouts: dict[str, tuple[tuple[int, int], ...]] = {}
    for sensor in machine.sensors("full"):
        if sensor.name not in values:
            continue
        rows, there = find_spikes(sensor, values[sensor.name]), log.read_in(sensor.name)
        rows = rows[there[rows] & there[rows - 1] & there[rows + 1]]
        if len(rows) > max(3, MANY * len(log)):
            raise LogError(
                f"{log.source}: column {sensor.column}: {len(rows)} spikes of a single sample, the first in row"
                f" {rows[0] + 1}; too many to repair, check the channel"
            )
        if len(rows):
            x = values[sensor.name].copy()
            size = float(np.abs(x[rows] - (x[rows - 1] + x[rows + 1]) / 2).max())
            x[rows] = (x[rows - 1] + x[rows + 1]) / 2
            values[sensor.name] = x
            spikes[sensor.name] = tuple(int(r) for r in rows)
            shown = ", ".join(str(r + 1) for r in rows[:5]) + (", ..." if len(rows) > 5 else "")
            notes.append(
                f"{log.source}: column {sensor.column}: {len(rows)} spike{'s' if len(rows) > 1 else ''} of up to"
                f" {size:.3g} {machine.si_unit(sensor)} replaced by the mean of the neighbours (row {shown})"
            )
        held = find_dropouts(sensor, values[sensor.name])
        if held:
            dropouts[sensor.name] = held
            first, last = held[0]
            text = (
                f"{log.source}: column {sensor.column}: {len(held)} drop-out{'s' if len(held) > 1 else ''}, the reading"
                f" stands still from row {first + 1} to {last + 1} ({log.t[first]:.2f} s to {log.t[last]:.2f} s)"
            )
            if sensor.resolution is not None or last - first > 100 * HELD:
                rest = (
                    "cut the log there" if last == len(log) - 1 else "give the stretches before and after as two logs"
                )
                raise LogError(f"{text}; {rest}")
            notes.append(f"{text}: what is in between counts as measured")
    doubtful = tuple(f"{log.source}: {line}" for line in doubts(machine, values, log.interpolated))
    return Examination(replace(log, values=values), tuple(notes), spikes, dropouts, doubtful)


def find_spikes(sensor: Sensor, x: np.ndarray) -> np.ndarray:
    """Rows of a signal (N,) whose reading is far from both neighbours while these agree with each other."""
    if len(x) < 5:
        return np.zeros(0, int)
    bend = np.zeros(len(x))
    bend[1:-1] = x[1:-1] - (x[:-2] + x[2:]) / 2
    alive = np.ones(len(x), bool)  # a channel that died tells nothing of its noise
    for a, b in _held(x) if sensor.resolution is None else ():
        alive[a : b + 1] = False
    noisy = np.abs(bend[1:-1][alive[1:-1]])
    scale = 1.4826 * float(np.median(noisy)) if len(noisy) else 0.0
    least = SPIKE * scale + STEPS * (sensor.resolution or 0.0) + 1e-9 * float(np.abs(x).max())
    k = np.flatnonzero(np.abs(bend) > least)
    k = k[(k > 1) & (k < len(x) - 2)]
    # A step or a corner bends at two rows; a spike bends half as much, the other way, on both its sides, and no
    # further away, as a fast vibration would.
    alone = [
        i
        for i in k
        if max(abs(bend[i - 1] + bend[i] / 2), abs(bend[i + 1] + bend[i] / 2)) < 0.3 * abs(bend[i])
        and max(abs(bend[i - 2]), abs(bend[i + 2])) < 0.3 * abs(bend[i])
    ]
    return np.array(alone, int)


def moves(machine: Machine, log: Log) -> bool:
    """Tell if any angle goes further than a count or two; taken for granted where one isn't counted."""
    turning = [s for s in machine.sensors("full") if s.kind in ("angle", "wheel") and s.name in log.values]
    return any(s.resolution is None or np.ptp(log.values[s.name]) > 2.5 * s.resolution for s in turning)


def find_dropouts(sensor: Sensor, x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Stretches (first, last row) in which a noisy channel reads the same, or an encoder that turned fast before and
    after doesn't count, or jumps after it, or stands from one row to the next until the log ends."""
    long = _held(x)
    if sensor.resolution is None:
        changes = np.diff(x) != 0.0
        if np.count_nonzero(changes) > 0.9 * len(changes):  # a channel without noise may well stand still
            return tuple(long)
        # One with noise may be dead by the end; zero is what many say at rest.
        return tuple(
            (a, b)
            for a, b in long
            if b == len(x) - 1 and b - a > DEAD and x[b] and changes[:a][-DEAD:].sum() > 0.9 * DEAD
        )
    found, fastest = [], float(np.quantile(np.abs(np.diff(x)), 0.999)) if long else 0.0
    for a, b in long:
        if b == len(x) - 1 and b - a > DEAD and a > 0:
            # What rolls comes to rest by degrees.
            speeds = np.diff(x[: a + 1])
            usual = float(np.abs(np.diff(speeds)).max()) if len(speeds) > DEAD else np.inf
            if abs(speeds[-1]) > JUMP * (usual + sensor.resolution):
                found.append((a, b))
        before, after = x[max(a - HELD, 0) : a + 1], x[b : b + HELD + 1]
        if min(len(before), len(after)) <= HELD:
            continue
        speed = min(abs(before[-1] - before[0]), abs(after[-1] - after[0])) / HELD
        jump = abs(x[b + 1] - x[a])
        caught_up = speed > 3 * sensor.resolution and jump > 0.5 * speed * (b - a)
        if caught_up or jump > JUMP * (fastest + sensor.resolution):
            found.append((a, b))
    return tuple(found)


def _held(x: np.ndarray) -> list[tuple[int, int]]:
    """Stretches (first, last row) in which a signal (N,) reads the same HELD times and more."""
    same = np.flatnonzero(np.diff(np.concatenate([[1.0], np.diff(x) != 0.0, [1.0]])) != 0)
    runs = [(int(a), int(b)) for a, b in itertools.pairwise(same) if a + 1 < len(x) and x[a + 1] == x[a]]
    return [(a, b) for a, b in runs if b - a >= HELD]

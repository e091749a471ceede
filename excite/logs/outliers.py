"""Readings that are not the machine's: spikes, drop-outs, and those that stand at the end of a channel's range."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from excite.logs.record import Channel, Finding, Record
from excite.model.machine import Sensor
from excite.text import count

STUCK = 50  # equal extreme readings in a row that look like the end of a range; chosen
FROZEN = 8  # equal readings in a row that make a drop-out; chosen
DEAD = 100  # the same for a channel that ends so; chosen
JUMP = 3.0  # times as far, at the end of such a stretch, as the encoder moves in a sample elsewhere; chosen
LONG = 800  # rows of a drop-out that no estimate can bridge; chosen
MOVES = 1e-3  # of its range that a position must go to have moved; chosen
SPIKE = 10.0  # robust deviations from the neighbours that make an outlier; chosen
STEPS = 8.0  # counts, likewise
CHATTER = 3.0  # times the 99 % quantile of what a channel does otherwise, below which a reading is chatter; chosen
MANY = 0.005  # share of a channel's samples that may be repaired; chosen
SLOWED = 0.5  # of its highest speeds (90 % below), at which a position that comes to rest moves before; chosen
NOISY = 0.9  # share of rows in which a channel with noise reads something new; chosen


def one_count(sensor: Sensor, x: np.ndarray) -> float:
    """The step in which readings (n,) come: one count, or the smallest change of rounded ones."""
    if sensor.resolution is not None:
        return sensor.resolution
    size = np.abs(np.diff(x))
    size = size[size > 0]
    return float(size.min()) if len(size) else 0.0


def stretches(yes: np.ndarray) -> list[tuple[int, int]]:
    """Return the stretches (first, last row) in which a condition (N,) holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], yes, [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def ends_of_range(record: Record) -> Iterator[Finding]:
    """Find analogue channels that stand at their highest or lowest reading while the machine moves."""
    for c in record.of("range"):
        if c.sensor.counts_per_turn is not None or np.ptp(c.x) == 0:
            continue
        frozen = dropouts_of(c, record)
        for end, word in ((c.x.max(), "highest"), (c.x.min(), "lowest")):
            runs = [(a, b) for a, b in stretches(c.x == end) if b - a + 1 >= STUCK]
            runs = [r for r in runs if r not in frozen and _moved(record, c, *r) and not _comes_to_rest(c, *r)]
            if runs:
                rows = max(b - a + 1 for a, b in runs)
                spans = tuple((float(c.t[a]), float(c.t[b])) for a, b in runs)
                text = f"{c.name}: stands at its {word} value for {count(rows, 'row')}: the end of its range?"
                yield Finding("range", "remark", c.sensor.name, text, spans)


def spikes(record: Record) -> Iterator[Finding]:
    """Find single readings far from both neighbours; too many of them are a fault."""
    for c in record.of("spikes"):
        k = spikes_of(c)
        if not len(k):
            continue
        spans = tuple((float(c.t[i]), float(c.t[i])) for i in k)
        where = f"{'the first ' if len(k) > 1 else ''}in row {c.row(int(k[0]))}"
        if too_many(k, c):
            text = (
                f"{c.name}: {count(len(k), 'spike')} of a single sample, {where}; too many to repair, check the channel"
            )
            yield Finding("spikes", "fault", c.sensor.name, text, spans)
        else:
            text = f"{c.name}: {count(len(k), 'spike')} of a single row, {where}"
            yield Finding("spikes", "remark", c.sensor.name, text, spans)


def too_many(k: np.ndarray, c: Channel) -> bool:
    """Tell if a channel has more spikes than repair can answer for."""
    return len(k) > max(3, MANY * len(c.x))


def spikes_of(c: Channel) -> np.ndarray:
    """Readings (by number) of a position or analogue channel that are spikes, by its times and by its rows."""
    return np.zeros(0, int) if c.sensor.is_rate else find_spikes(c.sensor, c.x, c.t)


def find_spikes(sensor: Sensor, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
    """Rows of a signal (N,) whose reading is far from both neighbours while these agree with each other.

    t (N,) [s]: a reading that either its time or its row explains is none.
    """
    if len(x) < 5:
        return np.zeros(0, int)
    bend = np.zeros(len(x))
    bend[1:-1] = x[1:-1] - (x[:-2] + x[2:]) / 2
    if t is not None:
        before, after = np.diff(t)[:-1], np.diff(t)[1:]
        whole = before + after
        timed = np.where(whole > 0, x[1:-1] - (x[:-2] * after + x[2:] * before) / np.where(whole > 0, whole, 1.0), 0.0)
        closer = (whole > 0) & (np.abs(timed) < np.abs(bend[1:-1]))
        bend[1:-1] = np.where(closer, timed, bend[1:-1])
    alive = np.ones(len(x), bool)  # a channel that died tells nothing of its noise
    for a, b in _same(x) if sensor.resolution is None else ():
        alive[a : b + 1] = False
    size = np.abs(bend)
    noisy = size[1:-1][alive[1:-1]]
    scale = 1.4826 * float(np.median(noisy)) if len(noisy) else 0.0
    least = SPIKE * scale + STEPS * one_count(sensor, x) + 1e-9 * float(np.abs(x).max())
    k = np.flatnonzero(size > least)
    k = k[(k > 1) & (k < len(x) - 2)]
    # A step or a corner bends at two rows; a spike bends half as much, the other way, on both its sides, and no
    # further away, as a fast vibration would.
    beside = np.maximum(np.abs(bend[k - 1] + bend[k] / 2), np.abs(bend[k + 1] + bend[k] / 2))
    away = np.maximum(size[k - 2], size[k + 2])
    k = k[np.maximum(beside, away) < 0.3 * size[k]]
    if not len(k):
        return k
    rest = alive.copy()
    for shift in (-1, 0, 1):
        rest[k + shift] = False
    usual = float(np.quantile(size[rest], 0.99)) if rest.any() else 0.0
    return k[size[k] > CHATTER * usual]


def dropouts(record: Record) -> Iterator[Finding]:
    """Find stretches in which a channel stands still while the machine moves."""
    for c in record.of("dropouts"):
        found = dropouts_of(c, record)
        if not found:
            continue
        worst = max(found, key=lambda ends: ends[1] - ends[0])
        fatal = _counts_on(c.sensor) or worst[1] - worst[0] > LONG
        first, last = found[0] if _counts_on(c.sensor) else worst
        at = f"from row {c.row(first)} to {c.row(last)} ({c.t[first]:.2f} s to {c.t[last]:.2f} s)"
        text = f"{c.name}: {count(len(found), 'drop-out')}, the reading stands still {at}"
        if not fatal:
            text += ": what is in between counts as measured"
        elif last == len(c.x) - 1:
            text += "; cut the log there: does the channel end early?"
        elif first == 0:
            text += "; cut the log there: does the channel begin late?"
        else:
            text += "; give the stretches before and after as two logs"
        spans = tuple((float(c.t[a]), float(c.t[b])) for a, b in found)
        yield Finding("dropouts", "fault" if fatal else "remark", c.sensor.name, text, spans)


def _counts_on(sensor: Sensor) -> bool:
    """Tell if a sensor gives positions, which stand still with their joint and catch up after a drop-out."""
    return sensor.kind in ("angle", "wheel") and not sensor.is_rate


def dropouts_of(c: Channel, record: Record) -> tuple[tuple[int, int], ...]:
    """Stretches (first, last) of a channel's readings that are drop-outs."""
    found = find_dropouts(c.sensor, c.x)
    if _counts_on(c.sensor):
        return found
    return tuple((a, b) for a, b in found if _moved(record, c, a, b))


def _comes_to_rest(c: Channel, first: int, last: int) -> bool:
    """Tell a position that slows down into a stretch of equal readings, and leaves it slowly, from one that is cut."""
    if not _counts_on(c.sensor):
        return False
    steps = np.abs(np.diff(c.x))
    beside = np.concatenate([steps[max(first - 2, 0) : first], steps[last : last + 2]])
    return bool(beside.max(initial=0.0) < SLOWED * np.quantile(steps[steps > 0], 0.9))


def _moved(record: Record, c: Channel, first: int, last: int) -> bool:
    """Tell if any position but the channel's own goes on between two of its readings; taken for granted where none is
    recorded."""
    known = False
    for d in record.channels.values():
        if d is c or not _counts_on(d.sensor):
            continue
        x = d.x[np.searchsorted(d.rows, c.rows[first]) : np.searchsorted(d.rows, c.rows[last], "right")]
        known = True
        if len(x) > 1 and np.ptp(x) > max(2.5 * (d.sensor.resolution or 0.0), MOVES * np.ptp(d.x)):
            return True
    return not known


def find_dropouts(sensor: Sensor, x: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Stretches (first, last row) in which a noisy channel reads the same, or a position that turned fast before and
    after doesn't change, or jumps after it, or stands from one row to the next until the log ends."""
    long = _same(x)
    if not long:
        return ()
    if not _counts_on(sensor):
        changes = np.diff(x) != 0.0
        if np.count_nonzero(changes) > NOISY * len(changes):  # a channel without noise may well stand still
            return tuple(long)
        # One with noise may be dead at first or by the end; zero is what many say at rest.
        return tuple(
            (a, b)
            for a, b in long
            if b - a > DEAD
            and x[b]
            and (
                (b == len(x) - 1 and changes[:a][-DEAD:].sum() > NOISY * DEAD)
                or (a == 0 and changes[b:][:DEAD].sum() > NOISY * DEAD)
            )
        )
    count = one_count(sensor, x)
    found, fastest = [], float(np.quantile(np.abs(np.diff(x)), 0.999))
    for a, b in long:
        if b == len(x) - 1 and b - a > DEAD and a > 0:
            # What rolls comes to rest by degrees.
            speeds = np.diff(x[: a + 1])
            usual = float(np.abs(np.diff(speeds)).max()) if len(speeds) > DEAD else np.inf
            if abs(speeds[-1]) > JUMP * (usual + count):
                found.append((a, b))
        before, after = x[max(a - FROZEN, 0) : a + 1], x[b : b + FROZEN + 1]
        if min(len(before), len(after)) <= FROZEN:
            continue
        speed = min(abs(before[-1] - before[0]), abs(after[-1] - after[0])) / FROZEN
        jump = abs(x[b + 1] - x[a])
        caught_up = speed > 3 * count and jump > 0.5 * speed * (b - a)
        if caught_up or jump > JUMP * (fastest + count):
            found.append((a, b))
    return tuple(found)


def _same(x: np.ndarray) -> list[tuple[int, int]]:
    """Stretches (first, last row) in which a signal (N,) reads the same FROZEN times and more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[1.0], np.diff(x) != 0.0, [1.0]])) != 0)
    a, b = edges[:-1], edges[1:]
    kept = (b - a >= FROZEN) & (x[np.minimum(a + 1, len(x) - 1)] == x[a])
    return list(zip(a[kept].tolist(), b[kept].tolist(), strict=True))

"""One table of what can be wrong with a channel as its logger recorded it, each reading at its own time.

`excite log check` shows every finding; identification refuses faults in the same words and notes doubts. Checks that
need even steps and the whole machine are in `plausibility`. A sensor's `checks_off` leaves it out of a check.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import clocks, log
from excite.logs.filtered import derivative, lowpass, too_slow
from excite.logs.log import Log
from excite.logs.plausibility import RATES, against, as_speed, is_speed, own_file, rated_speed, step_of, unchanging
from excite.logs.resampling import BRIDGED_STEPS, held_every
from excite.logs.times import date_and_time, has_time, seconds
from excite.model.machine import TURN, Machine, Sensor, noise_of
from excite.text import count, format_number

SHOWN = 3  # places named of what is there many times
STUCK = 50  # equal extreme readings in a row that look like the end of a range; chosen
FASTER = 1.5  # times what a joint can move in a step, beyond which it was not the joint that moved; chosen
UNUSUAL = 10.0  # times the usual lead of a step over its neighbours; chosen
SLIPPED = 8.0  # counts by which a step leads its neighbours that can be no noise; chosen
USUAL = 0.997  # quantile of steps that is usual: a few resets are among the rest; chosen
RANGE = 0.9  # of its range that a reading which wraps jumps back by; chosen
NEAR = 0.02  # of a range by which one that is known may be missed; chosen
WORDS = (8, 10, 12, 14, 15, 16, 24, 32)  # bits of counters
COARSEST = 1.5  # steps of a channel's resolution by which one that is held changes at least; chosen
CHANGES = 40  # of a channel that say whether it is held; chosen
COPIED = 0.3  # share of rows that copy the one before, beyond which rows are there twice; chosen
STEADY = 0.9  # share of changes that are the usual number of rows apart where a channel is held; chosen
NOISY = 0.9  # share of rows in which a channel with noise reads something new; chosen
FROZEN = 8  # equal readings in a row that make a drop-out; chosen
DEAD = 100  # the same for a channel that ends so; chosen
JUMP = 3.0  # times as far, at the end of such a stretch, as the encoder moves in a sample elsewhere; chosen
LONG = 800  # rows of a drop-out that no estimate can bridge; chosen
MOVES = 1e-3  # of its range that a position must go to have moved; chosen
SPIKE = 10.0  # robust deviations from the neighbours that make an outlier; chosen
STEPS = 8.0  # counts, likewise
CHATTER = 3.0  # times the 99 % quantile of what a channel does otherwise, below which a reading is chatter; chosen
WRONG_RATE = 50.0  # times the machine file's rate or a part of it: time in another unit; chosen
MANY = 0.005  # share of a channel's samples that may be repaired; chosen
FEW = 20  # readings that do not say how fast a channel is; chosen
SLOWER = 1.5  # times the step of the fastest channel, from which one is slower; chosen
CUTOFFS = 10.0  # times the filter's cutoff at which a channel follows what the filter passes; chosen
SLOWED = 0.5  # of its highest speeds (90 % below), at which a position that comes to rest moves before; chosen
ROUNDED_FINE = 2.0  # times the machine file's noise that rounding may add; chosen
DECIMATION_PASS = 0.4  # of the rate after decimation, up to which its filter passes
COARSE_SHARE = 0.02  # of an acceleration's mean square that may be due to rounding; chosen
FILTERED = (
    "angle",
    "torque",
    "wheel",
    "forward_speed",
    "lateral_speed",
)  # kinds of sensor whose readings an estimate rests on
ORDINALS = ("", "", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")


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
    """What a check found in a sensor's channel. spans: first and last time [s] of each bad stretch."""

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


def findings(record: Record) -> list[Finding]:
    """Run every check, faults first."""
    found = [f for check in CHECKS for f in check(record)]
    misread = {f.sensor for f in found if f.check in ("limits", "speed")}  # what else is odd follows from that
    found = [f for f in found if f.sensor not in misread or f.check in ("limits", "speed")]
    return sorted(found, key=lambda f: ("fault", "doubt", "remark").index(f.kind))


def refuse(found: Sequence[Finding], source: str) -> tuple[str, ...]:
    """Raise LogError for all faults at once, return doubts."""
    faults = list(dict.fromkeys(f.text for f in found if f.kind == "fault"))
    if faults:
        more = f"; {len(faults) - SHOWN} more faults, `excite log check` lists them" if len(faults) > SHOWN else ""
        raise LogError(f"{source}: {'; '.join(faults[:SHOWN])}{more}")
    return tuple(dict.fromkeys(f"{source}: {f.text}" for f in found if f.kind == "doubt"))


def usual_step(t: np.ndarray) -> float:
    """Usual step [s] of times (n,) [s], 1 where they have none."""
    dt = np.diff(t)
    ahead = dt[dt > 0]
    if not len(ahead):
        return 1.0
    return float(np.mean(dt[(dt >= 0) & (dt <= BRIDGED_STEPS * np.median(ahead))]))


def _gaps(t: np.ndarray) -> np.ndarray:
    """Which steps (n - 1,) of times (n,) [s] are too long to bridge, or go back."""
    dt = np.diff(t)
    return (dt > BRIDGED_STEPS * usual_step(t)) | (dt < 0)


def jumps(record: Record) -> Iterator[Finding]:
    """Find positions that go further in a step than the joint can, and than the steps beside it."""
    for c in record.of("jumps"):
        s = c.sensor
        if s.kind not in ("angle", "wheel") or s.is_rate or len(c.x) < 10:
            continue
        usual = usual_step(c.t)
        size = np.diff(c.x) / np.maximum(np.diff(c.t) / usual, 1.0)
        step = np.abs(size)
        beside = np.maximum(np.append(0.0, step[:-1]), np.append(step[1:], 0.0))
        lead = np.maximum(step - beside, 0.0)
        often, own = float(np.quantile(lead, USUAL)), float(np.quantile(step, USUAL))
        rated = rated_speed(s, record.machine)
        most = max(own, 0.0 if rated is None else rated * usual)
        least = max(UNUSUAL * often + SLIPPED * _count(s, c.x), 1e-9 * float(np.abs(c.x).max()))
        k = np.flatnonzero((lead > least) & ~_gaps(c.t))
        for a, b in dropouts_of(c, record) if len(k) and "dropouts" not in s.checks_off else ():
            k = k[(k < a) | (k > b)]
        if not len(k):
            continue
        unit = record.machine.si_unit(s)
        far = k[lead[k] > FASTER * most]
        spans = tuple((float(c.t[i]), float(c.t[i + 1])) for i in (far if len(far) else k))
        if len(far):
            text = _wraps(c, size, far, record.machine)
            if not text:
                turns = "turns" if record.machine.find(s.body).joint == "revolute" else "moves"
                by = "" if turns == "turns" else "by "
                who = f"the machine {turns} {by}at most" if rated is not None else "it moves elsewhere by at most"
                i = int(far[0])
                text = (
                    f"row {c.row(i + 1)}, {c.name}: jumps by {format_number(abs(c.x[i + 1] - c.x[i]), 3)} {unit} in"
                    f" one sample, {who} {format_number(most, 2)} {unit} in it{_more(c, far[1:] + 1)}: an encoder that"
                    " was reset? cut the log there"
                )
            yield Finding("jumps", "fault", s.name, text, spans)
        else:
            i = int(k[np.argmax(lead[k])])
            text = (
                f"row {c.row(i + 1)}, {c.name}: moves by {format_number(step[i], 2)} {unit} in one sample, by"
                f" {format_number(beside[i], 2)} {unit} beside it{_more(c, k[k != i] + 1)}: an encoder that slipped,"
                " or a lost row?"
            )
            yield Finding("jumps", "doubt", s.name, text, spans)


def _count(sensor: Sensor, x: np.ndarray) -> float:
    """The step in which readings (n,) come: one count, or the smallest change of rounded ones."""
    if sensor.resolution is not None:
        return sensor.resolution
    size = np.abs(np.diff(x))
    size = size[size > 0]
    return float(size.min()) if len(size) else 0.0


def _more(c: Channel, rest: np.ndarray) -> str:
    """Further places of a finding."""
    if not len(rest):
        return ""
    shown = ", ".join(str(c.row(int(i))) for i in rest[:SHOWN]) + (", ..." if len(rest) > SHOWN else "")
    return f" (likewise in row{'s' if len(rest) > 1 else ''} {shown})"


def _wraps(c: Channel, size: np.ndarray, far: np.ndarray, machine: Machine) -> str:
    """What is said of an angle whose jumps are all about as far as its range, "" otherwise. size: (n - 1,) steps."""
    span, back = float(np.ptp(c.x)), np.abs(size[far])
    if c.sensor.wraps_at is not None or back.min() < RANGE * span:
        return ""
    one, count = abs(c.sensor.gain), c.sensor.resolution
    known = [n * TURN for n in (0.5, 1, 2)] if machine.find(c.sensor.body).joint == "revolute" else []
    known += [2.0**bits * unit for bits in WORDS for unit in (count, one) if unit is not None]
    beside = float(np.median(np.abs(size[np.clip(np.append(far - 1, far + 1), 0, len(size) - 1)])))
    period = float(np.median(back)) + beside
    near = min(known, key=lambda p: abs(p - period))
    if abs(near - period) <= NEAR * period:
        period = near
    elif len(far) < 2:
        return ""  # a single jump over any range: a reset
    unit, times = machine.si_unit(c.sensor), "" if len(far) == 1 else f", {len(far)} times"
    return (
        f"row {c.row(int(far[0]) + 1)}, {c.name}: jumps by {format_number(back[0], 3)} {unit} in one sample{times}:"
        f" counts that wrap? write wraps_at = {period / one:.7g} for it in {own_file(machine)}, or unwrap it"
    )


def limits(record: Record) -> Iterator[Finding]:
    """Find readings that the machine's limits rule out, or that are a speed where an angle should be."""
    for c in record.of("limits"):
        edges = [0, *(int(k) + 1 for k in np.flatnonzero(_gaps(c.t))), len(c.x)]
        a, b = max(itertools.pairwise(edges), key=lambda ends: ends[1] - ends[0])
        part = Channel(c.sensor, c.t[a:b], c.x[a:b], c.rows[a:b])  # across a gap an angle may jump
        if len(part.x) < 2:
            continue
        line = _beyond(part, record.machine)
        speed = _speed(part, record) if line and "speed" not in c.sensor.checks_off else ""
        if speed or line:
            yield Finding("speed" if speed else "limits", "fault", c.sensor.name, speed or line)


def _beyond(c: Channel, machine: Machine) -> str:
    """What limits say of a channel, "" where it keeps to them; jumps of single steps aside."""
    try:
        log.check_limits(c.sensor, c.x, 1 / usual_step(c.t), machine, "")
    except LogError as err:
        return str(err).removeprefix(": ")
    return ""


def _speed(c: Channel, record: Record) -> str:
    """What is said of an angle that its joint can't follow but that could be its speed, and goes with the torques as if
    it were; "" otherwise."""
    sensor, machine = c.sensor, record.machine
    body = machine.find(sensor.body)
    if sensor.kind != "angle" or sensor.is_rate or sensor.factor is not None or body.joint != "revolute":
        return ""
    if np.abs(np.diff(c.x)).max() > TURN / 2:
        return ""  # not unwrapped, say
    units = []
    for unit in RATES:
        rate = sensor.model_copy(update={"unit": unit, "counts_per_turn": None})
        if not _beyond(Channel(rate, c.t, c.x * (rate.gain / sensor.gain), c.rows), machine):
            units.append(unit)
    # What moves a roll is the torque of all of them.
    pulling = [b.index for b in machine.actuated if b.contact is not None] if body.contact else [body.index]
    torques = [d for d in record.channels.values() if d.sensor.kind == "torque" and d.sensor.body in pulling]
    known = [d.x if len(d.t) == len(c.t) else np.interp(c.t, d.t, d.x) for d in torques]
    if not units or not is_speed(c.x, known, 1 / usual_step(c.t)):
        return ""
    return (
        f"column {sensor.column}: changes faster than the joint can turn, as its speed would: is it one? then"
        f" {as_speed(units, machine)}"
    )


def held(record: Record) -> Iterator[Finding]:
    """Find channels that change in every n-th row only: slower ones, written again until the next reading."""
    for c in record.of("held"):
        x, dt = c.x, np.diff(c.t)
        copied = np.append(False, (dt == 0) & (np.diff(x) == 0))
        size = np.abs(np.diff(x[~copied] if copied.mean() > COPIED else x))  # every row may be there twice
        k = np.flatnonzero(size > 0)
        if not CHANGES <= len(k) <= 0.6 * len(size):
            continue
        apart = np.diff(k)
        n = int(np.median(apart))
        if n < 2 or np.median(size[k]) < COARSEST * _count(c.sensor, c.x):
            continue  # counts of a slow encoder, steps of a coarse channel
        near = np.abs(apart - n) <= (1 if n > 2 else 0)
        if np.mean(near | (apart % n == 0)) < STEADY or np.mean(apart == 1) > 1 - STEADY:
            continue
        rate = 1 / (float(np.mean(apart[near])) * usual_step(c.t))
        which = ORDINALS[n] if n < len(ORDINALS) else f"{n}th"
        text = f"{c.name}: changes in every {which} row only: a {format_number(rate, 3)} Hz signal that is held"
        yield Finding("held", "doubt", c.sensor.name, text)


def coarse(record: Record) -> Iterator[Finding]:
    """Find positions and speeds rounded so coarsely that it spoils their acceleration.

    Rounding to steps adds white noise of step / sqrt(12). Differentiated d times up to the frequency f that the filter
    and its decimation pass, it has the deviation step / sqrt(12) (2 pi f)^d sqrt(2 f / ((2 d + 1) rate)). Its share of
    the acceleration's mean square is missing in masses by least squares.
    """
    given = record.machine.filter
    for c in record.of("counts"):
        rate = 1 / usual_step(c.t)
        cutoff = min(float(given.cutoff_hz), DECIMATION_PASS * rate / given.decimation)
        passed = given.model_copy(update={"cutoff_hz": given.cutoff_hz.model_copy(update={"value": cutoff})})
        if c.sensor.kind not in ("angle", "wheel") or c.sensor.resolution is not None or too_slow(rate, passed):
            continue
        step, known = step_of(c.x), max(noise_of(record.machine, c.sensor), float(c.sensor.step or 0.0) / np.sqrt(12))
        if step / np.sqrt(12) <= ROUNDED_FINE * known or len(c.x) < log.SHORTEST:
            continue
        order = 1 if c.sensor.is_rate else 2
        smooth = lowpass(c.x, rate, passed)
        for _ in range(order):
            smooth = derivative(smooth, rate)
        own = step / np.sqrt(12) * (2 * np.pi * cutoff) ** order * np.sqrt(2 * cutoff / ((2 * order + 1) * rate))
        total = float(np.mean(smooth**2))
        share = own**2 / total if total > 0 else 0.0
        if share > COARSE_SHARE:
            text = (
                f"{c.name}: is rounded to steps of {format_number(step, 3)} {record.machine.si_unit(c.sensor)}, whose"
                f" noise makes about {format_number(100 * min(share, 1.0), 1)} % of its acceleration's mean square, and"
                f" masses too small: record it finer, or write a lower cutoff_hz under [filter] in"
                f" {own_file(record.machine)}"
            )
            yield Finding("counts", "doubt", c.sensor.name, text)


def slow(record: Record) -> Iterator[Finding]:
    """Find channels that are recorded slower than others, and too slow for the filter's cutoff."""
    steps = {c.sensor.name: _own_step(c) for c in record.channels.values() if len(c.x) >= FEW}
    cutoff = float(record.machine.filter.cutoff_hz)
    for c in record.of("slow"):
        if c.sensor.kind not in FILTERED or c.sensor.name not in steps:
            continue
        rate = 1 / steps[c.sensor.name]
        if steps[c.sensor.name] < SLOWER * min(steps.values()) or rate >= CUTOFFS * cutoff:
            continue
        text = (
            f"{c.name}: sampled at {format_number(rate, 3)} Hz, and the filter's cutoff_hz = {cutoff:g} needs more than"
        )
        if rate <= 2 * cutoff:
            text = (
                f"{text} {2 * cutoff:g} Hz: record it faster, or write a lower cutoff_hz under [filter] in"
                f" {own_file(record.machine)}"
            )
            yield Finding("slow", "fault", c.sensor.name, text)
        else:
            text = f"{text} {CUTOFFS * cutoff:g} Hz to be free of errors between readings"
            yield Finding("slow", "doubt", c.sensor.name, text)


def _own_step(c: Channel) -> float:
    """The usual step [s] between readings of a channel, of new ones if it is held."""
    every = held_every(c.x) if c.sensor.resolution is None else 1
    return every * usual_step(c.t)


def disagreeing_clocks(record: Record) -> Iterator[Finding]:
    """Find clocks beside the machine's that run otherwise."""
    for column, t in record.clocks.items():
        if line := clocks.disagreement(record.t, t, record.machine.time_column, column, column in record.one_origin):
            yield Finding("clocks", "doubt", "", line)


def opposed(record: Record) -> Iterator[Finding]:
    """Find contacts that turn against each other."""
    angles = [c for c in record.of("sign") if c.sensor.kind == "angle" and len(c.x) > 10]
    if angles:
        first = angles[0]
        values = {c.sensor.name: c.x if len(c.t) == len(first.t) else np.interp(first.t, c.t, c.x) for c in angles}
        for line in against(record.machine, values):
            yield Finding("sign", "fault", "", line)


def constant(record: Record) -> Iterator[Finding]:
    """Find channels that never change."""
    for c in record.of("constant"):
        if line := unchanging(c.sensor, c.x):
            yield Finding("constant", "remark", c.sensor.name, line)


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
    """Whether a channel has more spikes than repair can answer for."""
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
    least = SPIKE * scale + STEPS * _count(sensor, x) + 1e-9 * float(np.abs(x).max())
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
    """Whether a sensor gives positions, which stand still with their joint and catch up after a drop-out."""
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
    """Whether any position but the channel's own goes on between two of its readings; taken for granted where none is
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
    count = _count(sensor, x)
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


CHECKS: tuple[Callable[[Record], Iterator[Finding]], ...] = (
    limits,
    jumps,
    spikes,
    dropouts,
    held,
    coarse,
    slow,
    disagreeing_clocks,
    opposed,
    constant,
    ends_of_range,
)

"""One table of what can be wrong with a channel as its logger recorded it, each reading at its own time.

`excite log check` shows every finding; identification refuses faults in the same words and notes doubts. Checks that
need even steps and the whole machine are in `plausibility`. A sensor's `checks_off` leaves it out of a check.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from excite.errors import LogError
from excite.logs import clocks, log
from excite.logs.files.common import SHOWN
from excite.logs.filtered import derivative, lowpass, too_slow
from excite.logs.outliers import dropouts, dropouts_of, ends_of_range, one_count, spikes
from excite.logs.plausibility import RATES, against, as_speed, is_speed, own_file, rated_speed, step_of, unchanging
from excite.logs.record import Channel, Finding, Record, usual_step
from excite.logs.resampling import BRIDGED_STEPS, held_every
from excite.model.machine import TURN, Machine, noise_of
from excite.text import format_number

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
FEW = 20  # readings that do not say how fast a channel is; chosen
SLOWER = 1.5  # times the step of the fastest channel, from which one is slower; chosen
CUTOFFS = 10.0  # times the filter's cutoff at which a channel follows what the filter passes; chosen
ROUNDED_FINE = 2.0  # times the machine file's noise that rounding may add; chosen
DECIMATION_PASS = 0.4  # of the rate after decimation, up to which its filter passes
COARSE_SHARE = 0.02  # of an acceleration's mean square that may be due to rounding; chosen
# kinds of sensor whose readings an estimate rests on
FILTERED = ("angle", "torque", "wheel", "forward_speed", "lateral_speed")
ORDINALS = ("", "", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")


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
        least = max(UNUSUAL * often + SLIPPED * one_count(s, c.x), 1e-9 * float(np.abs(c.x).max()))
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
        if n < 2 or np.median(size[k]) < COARSEST * one_count(c.sensor, c.x):
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

"""Rows at their own times, brought onto an even grid.

Even rows at any rate stay as they are. Uneven ones (jitter, lost rows, channels with rates of their own) are
interpolated from each channel's own rows: angles linearly (the error is second order in the step, and between two
counts of an encoder nothing better is known), other channels from the nearest reading along its slope, so that noise
stays white. A gap longer than a few rows cuts the log into stretches. A log that is faster than asked for is averaged
over the rows of a new one (noise) or thinned (counts).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.grid import edges as encoder_edges, on_grid
from excite.logs.time_axis import Run
from excite.model.machine import Machine, Sensor
from excite.text import count, format_number

EVEN = 0.02  # relative deviation of a step from the usual one up to which rows are even; chosen
DRIFTED = 0.5  # of a step by which even rows may leave an even clock; chosen
SAME_RATE = 1e-4  # relative deviation of two rates of sampling that count as one: 0.1 deviation of a mass; chosen
BRIDGED_STEPS = 3.5  # usual steps between two readings, up to which what is lost is interpolated; chosen
BRIDGED_S = 0.1  # [s] the most of a quarter period of the filter that is bridged as well; chosen
THINNED = 1.5  # ratio of rates from which a slower one is made by averaging, not by interpolation; chosen
SHORTEST_STRETCH_S = 2.0  # [s] of a log between two gaps that is worth using; chosen
ORDINALS = {2: "second", 3: "third", 4: "fourth", 5: "fifth", 6: "sixth", 8: "eighth", 10: "tenth"}
ON_CHANGE = 'if the logger writes a cell only where it changes, write blank_means = "unchanged" in the machine file'
HELD_ROWS = 0.9  # share of changes of a channel in every n-th row, from which it is taken for held; chosen


@dataclass(frozen=True)
class Stretch:
    """Even rows: a table in the machine's columns without times, its first row's time [s], and the rate [Hz].

    doubts: why an estimate from it is doubtful.
    """

    table: pd.DataFrame
    start: float
    rate: float
    first_row: int
    interpolated: bool = False
    sampled: dict[str, np.ndarray] = field(default_factory=dict)
    edges: dict[str, np.ndarray] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()


Spans = list[tuple[float, float]]  # from, to [s]


def used_sensors(table: pd.DataFrame, machine: Machine) -> list[Sensor]:
    """The sensors of a machine whose columns a table has."""
    return [s for s in machine.sensors("full") if set(s.columns) <= set(table.columns)]


def even_stretches(
    table: pd.DataFrame, run: Run, machine: Machine, source: str, rate: float | None = None
) -> tuple[list[Stretch], list[str]]:
    """Bring one run of rows onto an even grid, cut at its gaps, with notes of what was done.

    rate [Hz]: of the grid; by default the log's own, or the machine file's where they differ by less than SAME_RATE
    or the rows are uneven about it. Raises LogError for a channel without numbers or where no stretch is long enough.
    """
    columns = list(dict.fromkeys(c for s in used_sensors(table, machine) for c in s.columns))
    columns += [c for s in machine.sensor if s.column in table.columns for c in (s.column,) if c not in columns]
    if not columns:
        raise LogError(f"{source}: none of the columns of {machine.name} is there")
    part, notes = table.iloc[run.rows].reset_index(drop=True), list[str]()
    there = {c: _readings(part[c], c, source) for c in columns}
    by_column = {c: s for s in machine.sensor for c in s.columns}
    for name in columns:
        x = pd.to_numeric(part[name], errors="coerce").to_numpy(dtype=float)
        every = held_every(x[there[name]]) if by_column[name].resolution is None else 1
        if every > 1:
            there[name] &= np.diff(x, prepend=np.nan) != 0
            notes.append(
                f"{source}: column {name}: changes in every {ordinal(every)} row only: a"
                f" {format_number(own_rate(run.t) / every, 3)} Hz signal that is held, used where it changes"
            )
    for name, rows in there.items():
        if not rows.any():
            raise LogError(f"{source}: column {name}: there is no number in it; leave the column out")
    nominal, own = float(machine.sampling_hz), _usual_rate(run.t, there)
    whole = all(rows.all() for rows in there.values())
    if whole and _is_even(run.t, own):
        own = (len(run.t) - 1) / float(run.t[-1] - run.t[0])
        own = nominal if abs(own / nominal - 1) < SAME_RATE else own
        stretch = Stretch(part, float(run.t[0]), own, int(run.rows[0]))
        if rate is None or abs(own / rate - 1) < SAME_RATE:
            return [stretch], notes
        if own > THINNED * rate:
            return [at_rate(stretch, machine, rate)], [
                f"{source}: resampled from {format_number(own, 6)} to {format_number(rate, 6)} Hz"
            ]
    grid = rate or (nominal if abs(own / nominal - 1) < EVEN else own)
    # For filters the step must be even, so a rate close to the log's is as good as any.
    longest = max(BRIDGED_STEPS / own, min(BRIDGED_S, 0.25 / float(machine.filter.cutoff_hz)))
    holes = [_holes(run.t[rows], max(longest, BRIDGED_STEPS * _usual_step(run.t[rows]))) for rows in there.values()]
    first = max(float(run.t[rows][0]) for rows in there.values())
    last = min(float(run.t[rows][-1]) for rows in there.values())
    spans = _between(first, last, sorted(itertools.chain.from_iterable(holes)))
    kept = [(a, b) for a, b in spans if b - a >= min(SHORTEST_STRETCH_S, last - first)]
    if not kept:
        raise LogError(f"{source}: no stretch between gaps lasts {SHORTEST_STRETCH_S:g} s{_sparse(there)}")
    notes += [f"{source}: {said}" for said in _notes(run.t, there, own, grid, spans, kept, last - first)]
    return [_interpolated(part, run, there, machine, a, b, grid) for a, b in kept], notes


def slower(stretch: Stretch, machine: Machine, most_hz: float) -> Stretch:
    """Thin a stretch to `most_hz` at most: noise is averaged over the rows that are left out, counts are not."""
    factor = int(np.ceil(stretch.rate / most_hz - EVEN))
    if factor < 2:
        return stretch
    return at_rate(stretch, machine, stretch.rate / factor)


def held_every(values: np.ndarray) -> int:
    """Tell in every how many rows a channel (N,) changes, if that is regular and more than one; 1 otherwise."""
    change = np.flatnonzero(np.diff(values) != 0)
    if len(change) < 20:
        return 1
    gaps, counts = np.unique(np.diff(change), return_counts=True)
    k = int(np.argmax(counts))
    return int(gaps[k]) if gaps[k] > 1 and counts[k] > HELD_ROWS * counts.sum() else 1


def ordinal(n: int) -> str:
    """A number as "fifth"."""
    return ORDINALS.get(n, f"{n}th")


def _sparse(there: dict[str, np.ndarray]) -> str:
    """Say what to do about gaps: log without them, or say what blank cells mean."""
    name, rows = min(there.items(), key=lambda one: one[1].mean())
    if rows.all():
        return "; log without gaps"
    return f": column {name} is blank in {format_number(100 * float((~rows).mean()), 2)} % of the rows; {ON_CHANGE}"


def _readings(column: pd.Series, name: str, source: str) -> np.ndarray:
    """Rows (N,) in which a column has a number. Raises LogError for a cell that is neither a number nor empty."""
    if column.dtype.kind in "biu":
        return np.ones(len(column), bool)
    number = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
    missing = column.isna().to_numpy()
    if column.dtype.kind != "f":  # a column of numbers has no blank text, and to make text of it takes long
        missing = missing | (column.astype(str).str.strip() == "").to_numpy()
    wrong = ~np.isfinite(number) & ~missing
    if wrong.any():
        k = int(np.argmax(wrong))
        raise LogError(f"{source}: row {k + 1}, column {name}: is {str(column.iloc[k])[:30]!r}, not a finite number")
    return ~missing


def own_rate(t: np.ndarray) -> float:
    """The usual rate [Hz] of times."""
    return 1 / _usual_step(t)


def _usual_step(t: np.ndarray) -> float:
    """The usual step [s] of times: of rows that are even but for lost ones that of two rows, else the mean."""
    dt = np.diff(t)
    if not len(dt):
        return 0.0
    median = float(np.median(dt))
    lost_only = median > 0 and np.quantile(np.abs(dt / median - np.round(dt / median)), 0.99) < 0.1
    return float(dt[dt <= (1.5 if lost_only else 10) * median].mean()) if median > 0 else 0.0


def _usual_rate(t: np.ndarray, there: dict[str, np.ndarray]) -> float:
    """The rate [Hz] of the fastest channel."""
    steps = [_usual_step(t[rows]) for rows in there.values() if rows.sum() > 1]
    return 1 / min(steps) if steps and min(steps) > 0 else np.nan


def _is_even(t: np.ndarray, rate: float) -> bool:
    """Tell if times (N,) [s] are even steps, which also stay along an even clock."""
    return len(t) > 1 and bool(np.abs(np.diff(t) * rate - 1).max() <= EVEN) and not _drifts(t)


def _drifts(t: np.ndarray) -> bool:
    """Tell if times (N,) [s] leave the even clock from the first to the last of them."""
    step = float(t[-1] - t[0]) / (len(t) - 1)
    return bool(np.abs(t - t[0] - step * np.arange(len(t))).max() > DRIFTED * step)


def _holes(t: np.ndarray, longest: float) -> Spans:
    """Spans between two readings that are further apart than what is bridged."""
    return [(float(t[k]), float(t[k + 1])) for k in np.flatnonzero(np.diff(t) > longest * (1 + EVEN))]


def _between(first: float, last: float, holes: Spans) -> Spans:
    """Return the spans of first..last between the holes."""
    spans, at = Spans(), first
    for a, b in holes:
        if a > at:
            spans.append((at, a))
        at = max(at, b)
    if last > at:
        spans.append((at, last))
    return spans


def at_rate(stretch: Stretch, machine: Machine, rate: float) -> Stretch:
    """A stretch at another rate."""
    n = len(stretch.table)
    t = np.arange(n) / stretch.rate
    grid = np.arange(int(np.floor(t[-1] * rate + 1e-6)) + 1) / rate
    factor = stretch.rate / rate
    columns = {}
    for sensor in machine.sensor:
        for name in (c for c in sensor.columns if c in stretch.table.columns):
            x = pd.to_numeric(stretch.table[name]).to_numpy(dtype=float)
            counted = sensor.resolution is not None
            if factor > THINNED and not counted:
                x = _block_means(x, round(factor))
            at = grid * stretch.rate
            near = np.round(at).astype(int)
            whole = counted and np.abs(at - near).max() < 1e-6
            columns[name] = x[near] if whole else np.interp(grid, t, x)
    return Stretch(
        pd.DataFrame(columns), stretch.start, rate, stretch.first_row, interpolated=True, doubts=stretch.doubts
    )


def _block_means(x: np.ndarray, width: int) -> np.ndarray:
    """Means (N,) over `width` rows about each row: white noise stays white where every width-th of them is kept."""
    weights = np.ones(width | 1)
    if width % 2 == 0:
        weights[[0, -1]] = 0.5
    half = len(weights) // 2
    if len(x) <= 2 * half:
        return x
    ends = 2 * x[0] - x[half:0:-1], 2 * x[-1] - x[-2 : -half - 2 : -1]  # a ramp goes on as it is
    return np.convolve(np.concatenate([ends[0], x, ends[1]]), weights / weights.sum(), mode="valid")


def _interpolated(
    part: pd.DataFrame, run: Run, there: dict[str, np.ndarray], machine: Machine, a: float, b: float, rate: float
) -> Stretch:
    """One stretch from a to b [s] on a grid that meets the rows of the encoders: each channel from its own readings."""
    by_column = {c: s for s in machine.sensor for c in s.columns}
    counted = [c for c in there if by_column[c].resolution is not None]
    reference = run.t[there[(counted or list(there))[0]]]
    a = float(reference[min(int(np.searchsorted(reference, a - 1e-9)), len(reference) - 1)])
    n = int(np.floor((b - a) * rate + 1e-6)) + 1
    columns, sampled, edges = {}, dict[str, np.ndarray](), dict[str, np.ndarray]()
    for name, rows in there.items():
        x = pd.to_numeric(part[name], errors="coerce").to_numpy(dtype=float)[rows]
        t, sensor = run.t[rows], by_column[name]
        placed = on_grid(t, x[:, None], a, 1 / rate, n)
        columns[name] = placed.values[:, 0]
        if placed.filled.any():
            sampled[name] = ~placed.filled
        if placed.moved and sensor.resolution is not None and len(sensor.columns) == 1:
            step = sensor.resolution / abs(sensor.gain)
            if np.abs(x / step - np.round(x / step)).max() < 0.01:
                edges[name] = encoder_edges(t, x, step, a, 1 / rate, n)
    first = int(run.rows[int(np.searchsorted(run.t, a - 1e-9))])
    return Stretch(pd.DataFrame(columns), a, rate, first, bool(sampled or edges), sampled, edges)


def _blanks(t: np.ndarray, there: dict[str, np.ndarray], steps: dict[str, float], grid: float) -> str:
    """Say of which channels cells are blank, and what to do unless each has even times of its own."""
    rates: dict[str, list[str]] = {}
    for name, usual in steps.items():
        rates.setdefault(f"{format_number(1 / usual, 3)} Hz" if usual > 0 else "one reading", []).append(name)
    blank = {name: int((~rows).sum()) for name, rows in there.items() if not rows.all()}
    missed = any(np.diff(t[there[name]]).max(initial=0.0) > 1.5 * steps[name] for name in blank)
    if len(rates) > 1 or not missed:
        listed = "; ".join(f"{', '.join(names)} at {rate}" for rate, names in rates.items())
        said = f"channels with times of their own ({listed}), each interpolated onto {format_number(grid, 4)} Hz"
    else:
        listed = ", ".join(f"{n} in {name}" for name, n in blank.items())
        said = f"{count(sum(blank.values()), 'empty cell')}, interpolated ({listed})"
    return f"{said}; {ON_CHANGE}" if missed else said


def _notes(
    t: np.ndarray, there: dict[str, np.ndarray], own: float, grid: float, spans: Spans, kept: Spans, common: float
) -> list[str]:
    """Say what was done to uneven rows; common [s]: time in which all channels have readings."""
    notes = []
    dt = np.diff(t)
    step, wide = 1 / own, dt[dt <= BRIDGED_STEPS / own]
    steps = {name: _usual_step(t[rows]) for name, rows in there.items()}
    lost = int((wide > 1.5 * step).sum())
    sparse = not all(rows.all() for rows in there.values())
    if sparse:
        notes.append(_blanks(t, there, steps, grid))
    even = np.abs(wide / step - np.round(wide / step)).max() < 5 * EVEN if len(wide) else True
    drifting = not lost and not sparse and len(spans) == 1 and _drifts(t)
    if not even or drifting:
        low, high = 1e3 * float(np.quantile(dt, 0.01)), 1e3 * float(np.quantile(dt, 0.99))
        slow = ", and the steps drift" if even else ""
        few, many = format_number(low, 3), format_number(high, 3)
        notes.append(
            f"rows are {few if few == many else f'{few} to {many}'} ms apart{slow}, interpolated at"
            f" their own times onto {format_number(1e3 / grid, 4)} ms"
        )
    elif lost and not sparse:
        notes.append(f"rows are lost in {count(lost, 'place')}, interpolated")
    if len(spans) > 1:
        used = sum(b - a for a, b in kept)
        notes.append(
            f"{count(len(spans) - 1, 'gap')}: used are {len(kept)} of {len(spans)} stretches between,"
            f" {format_number(used, 4)} of {format_number(common, 4)} s"
        )
    whole = float(t[-1] - t[0])
    if whole - common > min(0.01 * whole, BRIDGED_STEPS * max(steps.values(), default=0.0)):
        notes.append(
            f"not all channels last as long: used are {format_number(common, 4)} of {format_number(whole, 4)} s"
        )
    return notes

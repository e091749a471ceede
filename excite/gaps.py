"""A log with a few gaps is several logs: the stretches between them, each checked as a log of its own."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd

from excite import log, logcheck
from excite.log import Log, LogError
from model.machine import Machine

LONG = 5.0  # s that a stretch must last: a start and some seconds of motion
MOST = 10  # gaps: a file with more has a fault that cutting does not mend


def read(
    paths: Sequence[Path], machine: Machine, needs: Sequence[str] = (), use: str = "identified from"
) -> tuple[list[Log], list[str]]:
    """The logs in files, one stretch after another, with a note for each that was cut. use: what the stretches are
    said to be for. Raises LogError as `log.read`: also for a gap beside which too little is left, and for more than
    MOST of them."""
    parts = [split(log.table_of(path, machine), machine, needs, str(path), use) for path in paths]
    return [one for logs, _ in parts for one in logs], [note for _, notes in parts for note in notes]


def split(
    table: pd.DataFrame,
    machine: Machine,
    needs: Sequence[str] = (),
    source: str = "log",
    use: str = "identified from",
) -> tuple[list[Log], list[str]]:
    """The same of one table of columns."""
    logcheck.refuse(table, machine, needs, source)
    t = np.empty(0)
    if machine.time_column in table.columns:
        with suppress(LogError):  # `log.check` says it
            t = log.times(table, machine, source)
    cuts = log.gap_rows(t, machine)
    rate = float(machine.sampling_hz)
    rows = [0, *cuts, len(table)]
    if not cuts or len(cuts) > MOST or min(np.diff(rows)) < LONG * rate:
        return [log.check(table, machine, needs, source)], []
    stretches = [
        log.check(table.iloc[first:last].reset_index(drop=True), machine, needs, f"{source} from row {first + 1}")
        for first, last in itertools.pairwise(rows)
    ]
    where = ", ".join(f"{t[k] - t[k - 1]:.3g} s before row {k + 1}" for k in cuts)
    gaps = "a gap" if len(cuts) == 1 else f"{len(cuts)} gaps"
    return stretches, [f"{source}: {gaps} ({where}): {use} the {len(stretches)} stretches between"]

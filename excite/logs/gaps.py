"""A log with a few gaps is several logs: the stretches between them, each checked as a log of its own."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import inspection, log
from excite.logs.log import Log
from excite.model.machine import Machine

LONG = 5.0  # s that a stretch must last: a start and some seconds of motion
MOST = 10  # gaps: a file with more has a fault that cutting does not mend


def read_stretches(
    sources: Sequence[str | Path | pd.DataFrame | Log],
    machine: Machine,
    needs: Sequence[str] = (),
    use: str = "identified from",
) -> tuple[list[Log], list[str]]:
    """Read logs (files, tables in the machine's columns, or logs as they are), one stretch after another, with a note
    for each that was cut.

    use: what the notes say that the stretches are for. Raises LogError as `read_log`: also for a gap beside which too
    little is left, and for more than MOST of them.
    """
    parts = [_stretches(source, machine, needs, use) for source in sources]
    return [one for logs, _ in parts for one in logs], [note for _, notes in parts for note in notes]


def _stretches(
    source: str | Path | pd.DataFrame | Log, machine: Machine, needs: Sequence[str], use: str
) -> tuple[list[Log], list[str]]:
    if isinstance(source, Log):
        return [source], []
    if isinstance(source, pd.DataFrame):
        return split(source, machine, needs, use=use)
    return split(log.table_of(source, machine), machine, needs, str(source), use)


def split(
    table: pd.DataFrame,
    machine: Machine,
    needs: Sequence[str] = (),
    source: str = "log",
    use: str = "identified from",
) -> tuple[list[Log], list[str]]:
    """The same of one table of columns."""
    inspection.refuse(table, machine, needs, source)
    t = np.empty(0)
    if machine.time_column in table.columns:
        with suppress(LogError):  # `log.check` says it
            t = log.times(table, machine, source)
    cuts = log.gap_rows(t, machine)
    rate = float(machine.sampling_hz)
    rows = [0, *cuts, len(table)]
    if not cuts or len(cuts) > MOST or min(np.diff(rows)) < LONG * rate:
        return [log.from_table(table, machine, needs, source)], []
    stretches = [
        log.from_table(table.iloc[first:last].reset_index(drop=True), machine, needs, f"{source} from row {first + 1}")
        for first, last in itertools.pairwise(rows)
    ]
    where = ", ".join(f"{t[k] - t[k - 1]:.3g} s before row {k + 1}" for k in cuts)
    gaps = "a gap" if len(cuts) == 1 else f"{len(cuts)} gaps"
    return stretches, [f"{source}: {gaps} ({where}): {use} the {len(stretches)} stretches between"]

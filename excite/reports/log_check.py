"""The check of a log: its account, and the folder that `excite log check` writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite.logs import guess_machine, inspect, read_table, table_of
from excite.model.machine import Machine, load_machine
from excite.reports import figures
from excite.reports.results import Account


def check_log(place: Path, path: Path, machine: str | None, versions: Mapping[str, str]) -> dict[str, Any]:
    """Check a log into a folder with figure and report; return the summary. Raises LogError for an unreadable file.

    machine: a shipped name or a path, None to guess it by the columns.
    """
    table = read_table(path)
    loaded = load_machine(machine) if machine is not None else guess_machine(table)
    if loaded is not None:
        table = table_of(path, loaded)
    return log_account(table, loaded, str(path), versions).write(place)


def log_account(table: pd.DataFrame, machine: Machine | None, source: str, versions: Mapping[str, str]) -> Account:
    """Give an account of a table of measurements; its frame is the table as it is. Never raises for its content."""
    found = inspect(table, machine, source)
    summary = {
        "log": source,
        "machine": found.machine,
        "usable": found.usable and found.machine is not None,
        "rows": found.rows,
        "duration_s": found.duration_s if np.isfinite(found.duration_s) else None,
        "rate_hz": found.rate_hz if np.isfinite(found.rate_hz) else None,
        "faults": list(found.faults),
        "doubts": list(found.doubts),
        "remarks": list(found.remarks),
        "columns": [asdict(c) for c in found.columns],
        "versions": dict(versions),
    }
    drawn = {"log.png": partial(figures.log_figure, found, source)} if found.signals else {}
    return Account("log", summary, drawn, partial(log_frame, table, machine))


def log_frame(table: pd.DataFrame, machine: Machine | None) -> pd.DataFrame:
    """Return a table of measurements with the unit of each column that the machine file knows."""
    table = table.copy()
    if machine is not None:
        known: dict[str, str] = {machine.time_column: machine.time_unit}
        known |= {column: sensor.unit for sensor in machine.sensors("full") for column in sensor.columns}
        table.attrs["units"] = {str(c): known[c] for c in table.columns if c in known}
    return table

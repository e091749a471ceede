"""Lists for the person who wires the logger: what each column of a log is, and an empty log."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd

from excite.model import signal_descriptions
from excite.model.machine import Machine

WIRING, LOG_TEMPLATE = "wiring.csv", "log_template.csv"
HEADINGS = ("column", "unit", "what", "readings per second", "sign", "clock")
SIGNS = {  # of a positive reading, by the kind of sensor
    "angle": "+ as the joint's axis points (right hand)",
    "wheel": "+ rolling forward",
    "torque": "+ drives the joint in its positive direction",
    "yaw_rate": "+ turning left",
    "lateral_speed": "+ to the left",
    "forward_speed": "+ forward",
    "ground_speed": "never negative",
    "x": "+ along the lane",
    "y": "+ to the left",
}
PRESSURE = "a pressure at the motor or cylinder, not the supply's"
RATE = re.compile(r"rpm|/s$|/min$")  # units of a speed


def wiring_table(machine: Machine) -> pd.DataFrame:
    """Return a row for each column of a log: its unit, what it is, rate, sign, and the clock that it needs."""
    words, rate = signal_descriptions(machine), f"{float(machine.sampling_hz):g}"
    clock = f"same as {machine.time_column}"
    rows: list[tuple[str, ...]] = [
        (machine.time_column, machine.time_unit, "time of the row", rate, "growing", "the logger's")
    ]
    for s in machine.sensors("full"):
        own = rate if s.rate_hz is None else f"{float(s.rate_hz):g}"
        timed = clock if s.time_column is None else f"its own, in {s.time_column}"
        if s.time_column is not None:
            rows.append((s.time_column, s.time_unit or machine.time_unit, f"time of {s.column}", own, "growing", ""))
        what = words[s.name].replace("angle", "speed") if RATE.search(s.unit) else words[s.name]
        if s.return_column is None:
            rows.append((s.column, s.unit, what, own, SIGNS[s.kind], timed))
            continue
        for column, way in ((s.column, "forward"), (s.return_column, "backward")):
            rows.append((column, s.unit, f"pressure that drives {way}, of {what}", own, PRESSURE, timed))
    return pd.DataFrame(rows, columns=HEADINGS).drop_duplicates("column")


def write_wiring(machine: Machine, place: Path) -> None:
    """Write the list of columns and an empty log with these columns into a folder."""
    table = wiring_table(machine)
    table.to_csv(place / WIRING, index=False)
    pd.DataFrame(columns=list(table["column"])).to_csv(place / LOG_TEMPLATE, index=False)

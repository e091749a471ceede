"""What a logger's cells mean: blanks that stand for no change, rows that don't count, registers with a sign bit."""

from __future__ import annotations

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.model.machine import Machine
from excite.text import count

# what an enabled_column says of rows to keep, and of rows to leave out
ON = ("1", "true", "t", "y", "on", "yes", "enable", "enabled")
OFF = ("", "0", "false", "f", "n", "off", "no", "nan", "none", "disable", "disabled")


def as_meant(table: pd.DataFrame, machine: Machine, source: str) -> pd.DataFrame:
    """Return a table with cells as the machine file says that they are meant, with notes. Raises LogError.

    Columns that are absent while the drive is off are zero, blank cells hold the last value, rows that are not enabled
    are left out, registers of sign and magnitude are numbers with a sign.
    """
    attrs, notes = dict(table.attrs), list[str]()
    columns = [c for s in machine.sensor for c in s.columns if c in table.columns]
    absent = [s for s in machine.sensor if s.zero_if_absent and not set(s.columns) & set(table.columns)]
    changed = {c: pd.Series(0.0, table.index) for s in absent for c in s.columns}
    notes += [f"no column {c}: {s.name} counts as zero, its drive is off" for s in absent for c in s.columns]
    if machine.blank_means == "unchanged":
        blanks = {c: table[c].isna() | (table[c].astype(str).str.strip() == "") for c in columns}
        changed |= {c: table[c].mask(blank).ffill() for c, blank in blanks.items() if blank.any()}
        filled = sum(int(blank.sum()) for blank in blanks.values())
        notes += [f"{count(filled, 'blank cell')} hold the value before (blank_means)"] if filled else []
    for s in machine.sensor:
        if s.sign_bit is not None and s.column in table.columns:
            changed[s.column] = _with_sign(changed.get(s.column, table[s.column]), s.column, s.sign_bit, source)
    table = table.assign(**changed) if changed else table
    if machine.enabled_column is not None:
        table = _enabled(table, machine.enabled_column, source, notes)
    table.attrs = attrs | {"notes": [*attrs.get("notes", ()), *notes]} if notes else attrs
    return table


def _with_sign(column: pd.Series, name: str, bit: int, source: str) -> pd.Series:
    """Return the numbers of a register whose bit `bit` is the sign and whose lower bits are the magnitude."""
    value = pd.to_numeric(column, errors="coerce").to_numpy(dtype=float)
    if np.nanmax(value, initial=0.0) >= 2.0 ** (bit + 1):
        row = int(np.nanargmax(value)) + 1
        raise LogError(
            f"{source}: row {row}, column {name}: {np.nanmax(value):g} has bits above its sign_bit {bit}; which bit is"
            " the sign?"
        )
    if (value < 0).any():
        raise LogError(
            f"{source}: row {int(np.argmax(value < 0)) + 1}, column {name}: is negative, but a register with a sign_bit"
            " is not: log it as an unsigned number, or leave out sign_bit if its sign is read already"
        )
    signed = np.where(value >= 2.0**bit, 2.0**bit - value, value)
    return pd.Series(np.where(np.isfinite(value), signed, np.nan), column.index).where(
        column.notna() & np.isfinite(value), column
    )


def _enabled(table: pd.DataFrame, name: str, source: str, notes: list[str]) -> pd.DataFrame:
    """Return the rows in which a column is not 0, false or blank. Raises LogError without such a column or row."""
    if name not in table.columns:
        raise LogError(f"{source}: no column {name}, which the machine file names as enabled_column")
    number = pd.to_numeric(table[name], errors="coerce")
    text = table[name].astype(str).str.strip().str.lower()
    on = (number != 0) & ~text.isin(OFF)
    if (odd := on & number.isna() & ~text.isin(ON)).any():
        cell = str(table[name][odd].iloc[0])[:30]
        raise LogError(f"{source}: column {name}: {cell!r} says neither on nor off; write 1 or 0, or true or false")
    if not on.any():
        raise LogError(f"{source}: column {name}: no row is enabled")
    if on.all():
        return table
    notes.append(f"{count(int((~on).sum()), 'row is', 'rows are')} not enabled ({name}), left out")
    return table[on.to_numpy()].reset_index(drop=True)

"""Profiles: a drive as a file, torques to deliver and the motion that is expected; writing and reading."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import tables
from excite.logs.log import check_time, columns_of, numbers
from excite.model import Model
from excite.simulation import Motion


def profile_of(model: Model, motion: Motion) -> pd.DataFrame:
    """A drive as a table: the torques to deliver, then the motion that is expected (contract, section 2)."""
    columns: dict[str, np.ndarray] = {"t_s": motion.t}
    for k, name in enumerate(model.inputs):
        columns[torque_column(model, name)] = motion.u[:, k]
    names = motion_columns(model)
    columns |= {place: motion.q[:, k] for k, (place, _) in enumerate(names)}
    columns |= {rate: motion.nu[:, k] for k, (_, rate) in enumerate(names)}
    return pd.DataFrame(columns)


def torque_column(model: Model, name: str) -> str:
    """Column of an input in a profile: u1_Nm, of a prismatic joint u1_N."""
    body = model.machine.find(int(name[1:]))
    return f"{name}_{'Nm' if body.joint == 'revolute' else 'N'}"


def motion_columns(model: Model) -> list[tuple[str, str]]:
    """Columns of each coordinate and its velocity in a profile; a planar root's are along its own axes."""
    own = (
        dict(zip(model.machine.body[0].coordinates, ("v_m_s", "vy_m_s"), strict=False)) if model.machine.planar else {}
    )
    names = []
    for c in model.coordinates:
        unit = "rad" if c.startswith("theta") else "m"
        names.append((f"{c}_{unit}", own.get(c, f"d{c}_{unit}_s")))
    return names


@dataclass(frozen=True)
class PlannedDrive:
    """A profile: torques (N, n_u) [N m] to deliver, the state q0, nu0 (n_q,) that it starts from.

    q, nu (N, n_q): the motion that is expected, None if the profile has not all of its columns.
    """

    torque: np.ndarray
    q0: np.ndarray
    nu0: np.ndarray
    q: np.ndarray | None = None
    nu: np.ndarray | None = None


def is_profile(source: str | Path | pd.DataFrame, model: Model) -> bool:
    """Tell a profile from a log by its columns: all speeds of the expected motion, or torques without angles.

    Raises LogError for a file that can't be read.
    """
    machine = model.machine
    angles = {c for s in machine.sensors("full") if s.kind in ("angle", "wheel") for c in s.columns}
    wanted = [machine.time_column, *(c for s in machine.sensors("full") for c in s.columns)]
    table = source if isinstance(source, pd.DataFrame) else tables.read_table(source, wanted)
    have = set(tables.with_names(table, wanted).columns)
    torques = {torque_column(model, n) for n in model.inputs}
    return {rate for _, rate in motion_columns(model)} <= have or (torques <= have and not angles & have)


def read_profile(path: str | Path, model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Torques (N, n_u) [N m] of a profile and the state (n_q,), (n_q,) it starts from, zero where it gives none.

    Raises LogError as for a log.
    """
    drive = read_drive(path, model)
    return drive.torque, drive.q0, drive.nu0


def read_drive(source: str | Path | pd.DataFrame, model: Model) -> PlannedDrive:
    """Read a profile with the motion that is expected; its first state is zero where it gives none.

    Raises LogError as for a log.
    """
    table = source if isinstance(source, pd.DataFrame) else tables.read_table(source)
    source = str(table.attrs.get("source", "profile")) if isinstance(source, pd.DataFrame) else str(source)
    needed = ["t_s", *(torque_column(model, n) for n in model.inputs)]
    missing = [c for c in needed if c not in table.columns]
    alien = [c for c in table.columns if re.fullmatch(r"u\d+_Nm?", str(c)) and c not in needed]
    if alien and not missing:
        raise LogError(f"{source}: column {alien[0]}: {model.machine.name} has no such drive; is it another's profile?")
    if missing:
        raise LogError(
            f"{source}: no column {', '.join(missing)}, {columns_of(table)}; is this a profile of {model.machine.name}?"
        )
    t = numbers(table, "t_s", source)
    if len(t) < 2:
        raise LogError(f"{source}: only {len(t)} row, a profile needs at least 2")
    rate = float(model.machine.sampling_hz)
    check_time(t, rate, "t_s", source)
    torque = np.column_stack([numbers(table, c, source) for c in needed[1:]])
    for k, name in enumerate(model.inputs):
        limit = model.machine.find(int(name[1:])).limit.torque
        top = float(np.abs(torque[:, k]).max())
        if limit is not None and top > 10 * float(limit):
            raise LogError(
                f"{source}: column {needed[k + 1]}: up to {top:.3g}, more than ten times the drive's limit"
                f" {float(limit):g}; is the unit right?"
            )
    columns = motion_columns(model)
    given = {c: numbers(table, c, source) for pair in columns for c in pair if c in table.columns}
    start, speed = (
        np.array([given[c][0] if c in given else 0.0 for c in names]) for names in zip(*columns, strict=True)
    )
    if len(given) < 2 * len(columns):
        return PlannedDrive(torque, start, speed)
    q, nu = (np.column_stack([given[c] for c in names]) for names in zip(*columns, strict=True))
    return PlannedDrive(torque, start, speed, q, nu)

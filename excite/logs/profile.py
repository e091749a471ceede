"""Profiles: a drive as a file, torques to deliver and the motion that is expected; writing and reading."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs import tables
from excite.logs.formats import PROFILE
from excite.logs.log import OFF_RATE, check_time, columns_of, numbers
from excite.model import Model
from excite.simulation import Motion
from excite.text import count, format_number

SLOWEST_HZ = 0.5  # rate of a profile's rows below which its time is taken for wrong; chosen


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
    placed: False if the profile does not say where on the lane it begins.
    """

    torque: np.ndarray
    q0: np.ndarray
    nu0: np.ndarray
    q: np.ndarray | None = None
    nu: np.ndarray | None = None
    placed: bool = True

    @property
    def planned(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The expected motion q, nu (N, n_q), None if the profile has not all of it."""
        return None if self.q is None or self.nu is None else (self.q, self.nu)

    @property
    def start(self) -> np.ndarray | None:
        """The pose (n_q,) that it starts from, None if the drive may begin anywhere on the lane."""
        return self.q0 if self.placed else None


def drive_file(path: str | Path) -> Path:
    """Return the file of a drive: of a design's folder its profile, else the path as it is.

    Raises LogError for a folder that holds several drives.
    """
    path = Path(path)
    if (path / PROFILE).is_file():
        return path / PROFILE
    inside = sorted(p.parent for p in path.glob(f"*/{PROFILE}")) if path.is_dir() else []
    if inside:
        raise LogError(f"{path}: has no {PROFILE}, but folders with one: give one of them, such as {inside[0]}")
    return path


def is_profile(source: str | Path | pd.DataFrame, model: Model) -> bool:
    """Tell a profile from a log by its columns: all speeds of the expected motion, or torques without angles.

    Raises LogError for a file that can't be read.
    """
    machine = model.machine
    angles = {c for s in machine.sensors("full") if s.kind in ("angle", "wheel") for c in s.columns}
    wanted = [machine.time_column, *(c for s in machine.sensors("full") for c in s.columns)]
    table = source if isinstance(source, pd.DataFrame) else tables.read_table(drive_file(source), wanted)
    have = set(tables.with_names(table, wanted).columns)
    torques = {torque_column(model, n) for n in model.inputs}
    return {rate for _, rate in motion_columns(model)} <= have or (torques <= have and not angles & have)


def read_profile(path: str | Path, model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Torques (N, n_u) [N m] of a profile and the state (n_q,), (n_q,) it starts from, zero where it gives none.

    Raises LogError as for a log.
    """
    drive = read_drive(path, model)
    return drive.torque, drive.q0, drive.nu0


def read_drive(source: str | Path | pd.DataFrame, model: Model, any_rate: bool = False) -> PlannedDrive:
    """Read a profile with the motion that is expected; its first state is zero where it gives none.

    source: a file, the folder of a design, or its table.
    any_rate: take rows at another rate than the machine's as knots, between which every column is linear.
    Raises LogError as for a log.
    """
    table = source if isinstance(source, pd.DataFrame) else tables.read_table(drive_file(source))
    source = str(table.attrs.get("source", "profile")) if isinstance(source, pd.DataFrame) else str(source)
    needed = ["t_s", *(torque_column(model, n) for n in model.inputs)]
    _require_columns(table, model, needed, source)
    t, rate = numbers(table, "t_s", source), float(model.machine.sampling_hz)
    own = _own_rate(t, rate, any_rate, source)
    torque = np.column_stack([numbers(table, c, source) for c in needed[1:]])
    _require_torques(model, torque, needed[1:], source)
    columns = motion_columns(model)
    given = {c: numbers(table, c, source) for pair in columns for c in pair if c in table.columns}
    if own != rate:
        grid = t[0] + np.arange(round((t[-1] - t[0]) * rate) + 1) / rate
        torque = np.column_stack([np.interp(grid, t, x) for x in torque.T])
        given = {c: np.interp(grid, t, x) for c, x in given.items()}
    start, speed = (
        np.array([given[c][0] if c in given else 0.0 for c in names]) for names in zip(*columns, strict=True)
    )
    pose = model.machine.body[0].coordinates if model.machine.planar else ()
    placed = (
        not pose
        or start.any()
        or any(place in given for c, (place, _) in zip(model.coordinates, columns, strict=True) if c in pose)
    )
    if len(given) < 2 * len(columns):
        return PlannedDrive(torque, start, speed, placed=bool(placed))
    q, nu = (np.column_stack([given[c] for c in names]) for names in zip(*columns, strict=True))
    return PlannedDrive(torque, start, speed, q, nu)


def _require_columns(table: pd.DataFrame, model: Model, needed: Sequence[str], source: str) -> None:
    """Raise LogError for a profile without time or a torque, or with those of another machine."""
    missing = [c for c in needed if c not in table.columns]
    alien = [c for c in table.columns if re.fullmatch(r"u\d+_Nm?", str(c)) and c not in needed]
    if alien and not missing:
        raise LogError(f"{source}: column {alien[0]}: {model.machine.name} has no such drive; is it another's profile?")
    moved = [c for names in motion_columns(model) for c in names if c in table.columns]
    if missing and moved and not any(c in table.columns for c in needed[1:]):
        raise LogError(
            f"{source}: has a motion ({moved[0]}) but no torques: a drive is what the motors deliver over time, add the"
            f" columns {', '.join(needed[1:])}"
        )
    if missing:
        raise LogError(
            f"{source}: no column {', '.join(missing)}, {columns_of(table)}; is this a profile of {model.machine.name}?"
        )


def _own_rate(t: np.ndarray, rate: float, any_rate: bool, source: str) -> float:
    """Return the rate [Hz] of a profile's times t (n,) [s]: the machine's, or any. Raises LogError for others."""
    if len(t) < 2:
        raise LogError(f"{source}: only {count(len(t), 'row')}, a profile needs at least 2")
    usual = 1 / float(np.median(np.diff(t))) if (np.diff(t) > 0).all() else rate
    if usual < SLOWEST_HZ or 0 < (t[-1] - t[0]) * rate < 1:
        raise LogError(
            f"{source}: column t_s: {len(t)} rows {format_number(1 / usual, 4)} s apart; a profile lasts more than"
            f" {1 / rate:g} s, with rows at most {1 / SLOWEST_HZ:g} s apart: is the time in seconds?"
        )
    own = usual if any_rate and abs(usual / rate - 1) > OFF_RATE else rate
    check_time(t, own, "t_s", source)
    return own


def _require_torques(model: Model, torque: np.ndarray, columns: Sequence[str], source: str) -> None:
    """Raise LogError for torques (N, n_u) far above a drive's limit."""
    for k, name in enumerate(model.inputs):
        limit = model.machine.find(int(name[1:])).limit.torque
        top = float(np.abs(torque[:, k]).max())
        if limit is not None and top > 10 * float(limit):
            raise LogError(
                f"{source}: column {columns[k]}: up to {format_number(top, 3)}, more than ten times the drive's"
                f" limit {float(limit):g}; is the unit right?"
            )

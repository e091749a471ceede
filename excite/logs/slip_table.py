"""Tables of a single-wheel test: forces of a wheel or roll on soil at some slips, slip angles and loads."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd

from excite.errors import LogError
from excite.logs.files.common import UNCLEAR, UNITS_SAID, UNITS_UNKNOWN
from excite.logs.tables import read_table
from excite.model.machine import UNITS
from excite.text import count


@dataclass(frozen=True)
class Role:
    """A kind of column: its SI unit, the quantities of its units, the names it goes by, its meaning."""

    unit: str
    quantities: tuple[str, ...]
    names: tuple[str, ...]
    meaning: str


SLIP_ROLES = {
    "slip": Role(
        "-",
        ("ratio",),
        ("slip", "slip_ratio", "longitudinal_slip", "wheel_slip", "kappa", "s", "i"),
        "+ driving, divided by the larger of rim and forward speed",
    ),
    "speed": Role(
        "m/s",
        ("speed",),
        ("speed", "velocity", "v", "forward_speed", "travel_speed", "carriage_speed", "carriage_velocity"),
        "of the wheel's centre over ground",
    ),
    "rim_speed": Role(
        "m/s",
        ("speed",),
        ("rim_speed", "wheel_speed", "circumferential_speed", "peripheral_speed", "r_omega", "rw"),
        "radius times rate of turn",
    ),
    "spin": Role(
        "rad/s",
        ("angular rate",),
        ("spin", "omega", "w", "angular_velocity", "angular_speed", "wheel_rate"),
        "rate of turn; needs the radius",
    ),
    "angle": Role(
        "rad",
        ("angle",),
        ("slip_angle", "sideslip_angle", "angle", "alpha", "beta"),
        "between the wheel's plane and its motion",
    ),
    "load": Role("N", ("force",), ("load", "fz", "normal_load", "vertical_load", "normal_force"), "on the contact"),
    "traction": Role(
        "N",
        ("force",),
        ("traction", "fx", "tractive_force", "drawbar_pull", "drawbar", "dp", "pull", "longitudinal_force"),
        "net force of the soil on the wheel, + forward",
    ),
    "side": Role(
        "N",
        ("force",),
        ("side", "fy", "side_force", "lateral_force", "cornering_force"),
        "of the soil on the wheel, against its lateral motion negative",
    ),
    "level": Role("-", ("ratio",), ("level", "setting", "setpoint"), "equal for repeats of one setting"),
}
RATIOS = {"-": 1.0, "%": 0.01, "percent": 0.01, "pct": 0.01}
AVERAGED = re.compile(r"^(avg|mean|average)_")
SPREAD = re.compile(r"(^|_)(std|sd|stdev|slope|offset|min|max)(_|$)")
ROUNDING = 1e-9  # slips, slip angles and shares of the mean load that differ by less are equal; rounding of numbers
MIN_REPEATED = 0.9  # share of rows that recur exactly, from which settings are the values as they are; chosen
MIN_GAP_RATIO = 4.0  # gap between settings over the largest gap within one, where repeats are nearly equal; chosen
SAME_ANGLE = math.radians(2)  # [rad] slip angles closer than this, one to the next, are of one setting; chosen
SAME_LOAD = 0.1  # the same of loads, of their mean; chosen
SWEEP_SETTINGS = 50  # slips that differ, above which the wheel went through them continuously; chosen
SWEEP_LEVELS = 12  # stretches of slip that a continuous sweep is divided into; chosen
MIN_SLIP_RANGE = 0.02  # range of slip, below which the sign of a force is not judged; chosen
MIN_RIM_SHARE = 0.05  # rim speed over forward speed, below which slip divided by the rim speed says nothing; chosen
SLIP_PER = ("rim", "larger")  # speeds that slips may be divided by
PER_NAMES = {"rim": "rim speed", "larger": "larger speed"}


@dataclass(frozen=True)
class SlipTable:
    """Rows of a single-wheel test, in SI units and the machine file's axes.

    Vx, Vy, rim (N,) [m/s]: velocity of the centre along and across the wheel, speed of the rim.
    load (N,) [N], or None. forces: "traction", and "side" if it was measured, (N,) [N] each.
    level (N,): number of the setting, equal for repeats.
    per: what slips are divided by, "rim" as in the machine file, or the "larger" of rim and forward speed.
    notes: what was taken for what, and left out.
    """

    source: str
    Vx: np.ndarray
    Vy: np.ndarray
    rim: np.ndarray
    load: np.ndarray | None
    forces: Mapping[str, np.ndarray]
    level: np.ndarray
    per: str
    notes: tuple[str, ...] = ()

    @property
    def norm(self) -> np.ndarray:
        """Speed [m/s] that slips are divided by."""
        return np.abs(self.rim) if self.per == "rim" else np.maximum(np.abs(self.rim), np.hypot(self.Vx, self.Vy))

    @property
    def slip(self) -> np.ndarray:
        """Longitudinal slip [-], + driving (the -g_x of the machine file's laws)."""
        return (self.rim - self.Vx) / self.norm

    @property
    def angle(self) -> np.ndarray:
        """Slip angle [rad]."""
        return np.arctan2(self.Vy, np.abs(self.Vx))


def read_slip_table(
    source: str | Path | pd.DataFrame,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    per: str = "rim",
    radius: float | None = None,
) -> SlipTable:
    """Read a table of a single-wheel test.

    columns: role (a key of SLIP_ROLES) -> name of its column, "-NAME" for one of opposite sign; the others are
        recognised by name. units: role -> unit; the others come from the headers, SI where these say nothing.
    A column of slips is taken as divided by the larger of rim and forward speed.
    per: what `SlipTable.slip` is divided by, see there. radius [m]: of the wheel, for a rate of turn.
    Raises LogError: what is missing or impossible, and what to do.
    """
    name = "the table" if isinstance(source, pd.DataFrame) else str(source)
    chosen, units = dict(columns or {}), dict(units or {})
    table = source if isinstance(source, pd.DataFrame) else read_table(source, [c.lstrip("-") for c in chosen.values()])
    for role in (*chosen, *units):
        if role not in SLIP_ROLES:
            raise LogError(f"{name}: {role} is no role of a column, allowed: {', '.join(SLIP_ROLES)}")
    speeds = {role: _Column.find(name, table, role, chosen, units) for role in ("speed", "rim_speed")}
    used = [role for role in SLIP_ROLES if role != "slip" or None in speeds.values()]
    every = {role: speeds.get(role) or _Column.find(name, table, role, chosen, units) for role in used}
    found = {role: column for role, column in every.items() if column is not None}
    read = [f"{role.replace('_', ' ')} from {c.name} [{c.unit}]{c.remark}" for role, c in found.items()]
    notes = [f"columns: {'; '.join(read)}"]
    values = {role: c.values for role, c in found.items()}
    if "traction" not in values:
        raise LogError(_missing(name, table, "traction"))
    kept = np.all([np.isfinite(v) for v in values.values()], axis=0)
    if not kept.all():
        notes.append(f"{count(int((~kept).sum()), 'row')} with missing values left out")
    if not kept.any():
        raise LogError(
            f"{name}: no row has numbers in all of these columns: {', '.join(c.name for c in found.values())}"
        )
    values = {role: v[kept] for role, v in values.items()}
    if "spin" in values and "rim_speed" not in values:
        if radius is None:
            raise LogError(f"{name}: column {found['spin'].name} is a rate of turn, give the wheel's radius as well")
        values["rim_speed"] = radius * values["spin"]
    Vx, Vy, rim = _speeds(name, table, values, per, notes)
    level = _levels(rim, Vx, Vy, values)
    made = SlipTable(
        name, Vx, Vy, rim, values.get("load"), {k: values[k] for k in ("traction", "side") if k in values}, level, per
    )
    least = MIN_RIM_SHARE * np.abs(Vx) if per == "rim" else np.zeros(len(Vx))
    inside = (made.norm > least) & (made.norm > 0)
    if not inside.all():
        notes.append(
            f"{count(int((~inside).sum()), 'row')} of a wheel that hardly turns left out: slip divided by the rim speed"
            " has no bound there; slip per larger speed keeps them"
        )
    return _require_usable(_rows(made, inside, tuple(notes)))


def _rows(t: SlipTable, at: np.ndarray, notes: tuple[str, ...]) -> SlipTable:
    forces = {k: v[at] for k, v in t.forces.items()}
    _, level = np.unique(t.level[at], return_inverse=True)
    load = None if t.load is None else t.load[at]
    return replace(t, Vx=t.Vx[at], Vy=t.Vy[at], rim=t.rim[at], load=load, forces=forces, level=level, notes=notes)


def _require_usable(t: SlipTable) -> SlipTable:
    """Return the table. Raises LogError for too few settings, and forces or loads of the wrong sign."""
    levels = int(t.level.max()) + 1 if len(t.level) else 0
    if levels < 4:
        raise LogError(f"{t.source}: {count(levels, 'setting')} of slip, laws need 4 at least")
    if t.load is not None and not (t.load > 0).all():
        raise LogError(f"{t.source}: load: must be > 0 in every row; if down is negative give load=-COLUMN")
    straight = np.abs(t.angle) <= max(float(np.abs(t.angle).min()), SAME_ANGLE)
    pairs = (("traction", t.slip, straight, 1), ("side", t.Vy / t.norm, np.full(len(t.slip), True), -1))
    for role, slip, at, sign in pairs:
        force = t.forces.get(role)
        if force is None or np.ptp(slip[at]) < MIN_SLIP_RANGE or np.ptp(force[at]) == 0:
            continue
        if sign * np.corrcoef(slip[at], force[at])[0, 1] < -0.5:
            way = "grow with slip" if sign > 0 else "be against the lateral motion"
            raise LogError(
                f"{t.source}: {role}: the force must {way}, here it does the opposite; give {role}=-COLUMN,"
                f" or the right column ({role}=COLUMN)"
            )
    return t


@dataclass(frozen=True)
class _Column:
    name: str
    values: np.ndarray
    unit: str
    remark: str

    @classmethod
    def find(
        cls, source: str, table: pd.DataFrame, role: str, chosen: Mapping[str, str], units: Mapping[str, str]
    ) -> _Column | None:
        """Return the column of a role in SI units, None if there is none. Raises LogError."""
        there = [str(c) for c in table.columns]
        said: dict[str, str] = {**table.attrs.get(UNITS_UNKNOWN, {}), **table.attrs.get(UNITS_SAID, {})}
        if role in chosen:
            wanted = chosen[role]
            name = wanted if wanted in there else wanted.removeprefix("-")
            if name not in there:
                raise LogError(f"{source}: no column {name} for {role}, there are: {', '.join(there)}")
            sign = 1.0 if name == wanted else -1.0
        else:
            known = SLIP_ROLES[role].names
            taken = {c.removeprefix("-") for c in chosen.values()}
            fits = [c for c in there if c not in taken and _split(c)[0] in known]
            best = [c for c in fits if _split(c)[0] == min((_split(f)[0] for f in fits), key=known.index)]
            if len(best) > 1:
                raise LogError(f"{source}: {role} may be {' or '.join(best)}: say which ({role}=COLUMN)")
            if not best:
                return None
            name, sign = best[0], 1.0
        unit = (units.get(role) or said.get(name) or _split(name)[1] or "").strip("[]() ")
        values = sign * _numbers(source, table, name)
        return cls(
            name,
            values * _size(source, role, name, unit, values),
            unit or SLIP_ROLES[role].unit,
            "" if sign > 0 else ", sign turned",
        )


def _numbers(source: str, table: pd.DataFrame, name: str) -> np.ndarray:
    """Return the numbers of a column (N,), NaN where a cell is empty. Raises LogError for a cell that is no number."""
    if unclear := table.attrs.get(UNCLEAR, {}).get(name):
        raise LogError(f"{source}: {unclear}")
    column = table[name]
    values = pd.to_numeric(column, errors="coerce").to_numpy(float)
    wrong = np.isnan(values) & ~column.isna().to_numpy() & (column.astype(str).str.strip() != "").to_numpy()
    if wrong.any():
        k = int(np.argmax(wrong))
        more = f"; {count(int(wrong.sum()), 'such cell')} in this column" if wrong.sum() > 1 else ""
        raise LogError(
            f"{source}: row {k + 1}, column {name}: is {str(column.iloc[k])[:30]!r}, not a number{more}; correct or"
            " empty the cell, or choose another column (--column)"
        )
    return values


def _size(source: str, role: str, name: str, unit: str, values: np.ndarray) -> float:
    """Return the SI value of one of a column's unit. Raises LogError."""
    allowed = {u: size for u, (q, size) in UNITS.items() if q in SLIP_ROLES[role].quantities}
    if SLIP_ROLES[role].quantities == ("ratio",):
        allowed = RATIOS
    if role == "level":
        return 1.0
    if unit and unit not in allowed:
        raise LogError(f"{source}: {name}: {unit} is no unit of {role}, allowed: {', '.join(allowed)}")
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if not unit and role == "slip" and largest > 2:
        raise LogError(f"{source}: {name}: slips up to {largest:g} and no unit: per cent? give slip=%")
    if not unit and role == "angle" and largest > math.pi / 2:
        raise LogError(f"{source}: {name}: slip angles up to {largest:g} and no unit: degrees? give angle=deg")
    return allowed[unit] if unit else 1.0


def _split(header: str) -> tuple[str, str | None]:
    """Split a header into its plain name and its unit: "Fx (kN)", "avg_speed_mm_s", "slip [%]"."""
    bracket = re.fullmatch(r"(.*?)\s*[\[(]\s*(.+?)\s*[\])]\s*", header)
    bare, unit = (bracket[1], bracket[2]) if bracket else (header, None)
    plain = re.sub(r"[^a-z0-9%]+", "_", bare.lower()).strip("_")
    if SPREAD.search(plain):
        return "", None
    plain = AVERAGED.sub("", plain)
    if unit is None:
        for known in sorted((*UNITS, *RATIOS), key=len, reverse=True):
            end = "_" + re.sub(r"[^a-z0-9%]+", "_", known.lower()).strip("_")
            if len(end) > 1 and plain.endswith(end):
                return plain.removesuffix(end), known
    return plain, unit


def _missing(source: str, table: pd.DataFrame, role: str) -> str:
    r = SLIP_ROLES[role]
    return (
        f"{source}: no column is {role.replace('_', ' ')} ({r.meaning}); name it ({role}=COLUMN), there are:"
        f" {', '.join(map(str, table.columns))}"
    )


def _speeds(
    source: str, table: pd.DataFrame, values: Mapping[str, np.ndarray], per: str, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return velocity along and across the wheel and speed of its rim [m/s] of every row. Raises LogError."""
    angle = values.get("angle", np.zeros(len(values["traction"])))
    if "speed" in values and "rim_speed" in values:
        speed, rim = values["speed"], values["rim_speed"]
        return speed * np.cos(angle), speed * np.sin(angle), rim
    if "slip" not in values:
        raise LogError(_missing(source, table, "slip") + "; or give speed and rim_speed")
    s = values["slip"]
    if (s < 0).any():
        notes.append(
            "slip from the table is taken as divided by the larger of rim and forward speed; if its braking slips were"
            f" divided by the rim speed, give both speeds. The laws divide it by the {PER_NAMES[per]}, which their"
            " parameters depend on"
        )
    if (s < -1).any() or (s > 1).any():
        raise LogError(
            f"{source}: slip: must be from -1 to 1 (got {s.min():g} to {s.max():g}); give speed and rim_speed"
        )
    if "rim_speed" in values:
        rim = values["rim_speed"]
        Vx = np.where(s >= 0, rim * (1 - s), rim / np.maximum(1 + s, 1e-9))
    else:
        Vx = values.get("speed", np.ones(len(s))) * np.cos(angle)
        Vx = np.where(s == 1, 0.0, Vx)
        rim = np.where(s >= 0, np.where(s == 1, 1.0, Vx / np.maximum(1 - s, 1e-9)), Vx * (1 + s))
        if "speed" not in values:
            notes.append("no speed given: 1 m/s assumed, which a law of slip alone doesn't notice")
    return Vx, Vx * np.tan(angle), rim


def _levels(rim: np.ndarray, Vx: np.ndarray, Vy: np.ndarray, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Number the settings: by a column of levels, or rows whose slip, slip angle and load agree."""
    angle = np.arctan2(Vy, np.maximum(np.abs(Vx), 1e-12))
    if "level" in values:
        return _distinct(values["level"], _chained(angle, SAME_ANGLE))
    speed = np.hypot(Vx, Vy)
    slip = (rim - speed) / np.maximum(np.maximum(np.abs(rim), speed), 1e-12)
    load = values.get("load", np.ones(len(slip)))
    load = load / (np.abs(load).mean() or 1.0)
    by_slip, by_load, by_angle = _spaced(slip), _chained(load, SAME_LOAD), _chained(angle, SAME_ANGLE)
    if not 4 <= by_slip.max() + 1 <= SWEEP_SETTINGS:
        by_slip = np.digitize(slip, np.quantile(slip, np.linspace(0, 1, SWEEP_LEVELS + 1)[1:-1]))
    else:
        exact = _distinct(*(_chained(x, ROUNDING) for x in (slip, load, angle)))
        if _repeated(exact) >= MIN_REPEATED:
            return exact
    return _distinct(by_slip, by_load, by_angle)


def _spaced(x: np.ndarray) -> np.ndarray:
    """Number the settings of a value by its spacing.

    Repeats are equal, or nearly equal: then the gaps within settings are far smaller than those between them. Without
    such a break in the sizes of the gaps every value is a setting.
    """
    best, ratio = _chained(x, ROUNDING), MIN_GAP_RATIO
    if _repeated(best) >= MIN_REPEATED:
        return best
    gaps = np.sort(np.diff(np.sort(x)))
    gaps = gaps[gaps > ROUNDING]
    for small, large in pairwise(gaps):
        if large < ratio * small:
            continue
        group = _chained(x, small)
        if group.max() + 1 >= 4 and _repeated(group) >= 0.5:
            best, ratio = group, large / small
    return best


def _repeated(group: np.ndarray) -> float:
    """Return the share of rows whose group has other rows, too."""
    return float(np.mean(np.bincount(group)[group] > 1)) if len(group) else 0.0


def _distinct(*keys: np.ndarray) -> np.ndarray:
    """Number the rows by the combinations of keys that occur."""
    return np.unique(np.column_stack(keys), axis=0, return_inverse=True)[1].ravel()


def _chained(x: np.ndarray, gap: float) -> np.ndarray:
    """Number groups of values with no gap inside."""
    order = np.argsort(x)
    group = np.empty(len(x), int)
    group[order] = np.concatenate([[0], np.cumsum(np.diff(x[order]) > gap)])
    return group

"""Find the conditions under which least squares gives the table printed in 1999: simulate and identify as then.

python results/1999/study.py [--jobs 2] rebuilds summary.json, tables.md and the figures beside this file.
"""

from __future__ import annotations

# ruff: noqa: E402  (threads are set before numpy loads)
import argparse
import itertools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import joblib
import numpy as np
import scipy.linalg
from matplotlib.figure import Figure

from excite.identification import summarise_runs as verified, verify
from excite.logs import decimate, log, samples
from excite.model import Model, build
from excite.model.machine import Filter, Machine, machine as machines
from excite.reports import COLOURS, save
from excite.simulation import Motion, follow, sensors, simulate
from excite.smoothing import cramer_rao
from excite.trajectories import Manoeuvre, design, relative_std_percent

HERE = Path(__file__).parent
FORK = "multiprocessing"  # workers keep the models that this file has built
SEEDS = 4  # seeds of each cell of the grid; chosen
MANY = 6  # seeds of the table of single changes; chosen
RUNS = 50  # runs of the comparison with the recommended method; chosen
RADIUS = 0.65  # R_c [m]
SCALE = 4.79  # (ZZ1 + ZZ4 + M R_c^2 of the reference machine) / (ZZ1 + ZZ4 as printed)
PAPER = {
    "ZZ1": 556.32,
    "Fv1": 64.75,
    "Fs1": 174.74,
    "Kx1": -260.0,
    "u10": -183.14,
    "ZZ4": 671.33,
    "Fv4": 82.84,
    "Fs4": 142.73,
    "Kx4": -310.0,
    "u40": -181.94,
}
PAPER_STD = {"inertias": 0.3, "friction and offsets": 3.0, "contact": (17.0, 27.0)}  # [%]
FRICTION = ("Fv1", "Fs1", "Fv4", "Fs4")
OFFSETS = ("u10", "u40")


# ------------------------------------------------------------------------------------------------ machine and drive


@dataclass(frozen=True)
class Plant:
    """Simulated machine and sensors.

    soil: factor on Kx. counts: factor on the encoders' counts per turn, inf for exact signals without noise. wheel:
    relative excess of the measuring wheels' radius. scale: torques read too small by this factor; friction, offsets and
    noise are scaled up so that their readings equal the reference.
    """

    drive: str = "gentle"
    soil: float = 1.0
    counts: float = 1.0
    wheel: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True)
class Recipe:
    """Options of least squares. law: slip over v_n or over R_c w; cutoff [Hz]; rows: see ROWS."""

    law: str = "v_n"
    cutoff: float = 3.0
    rows: str = "all"


@dataclass(frozen=True)
class Fit:
    """Estimates by name [SI], standard deviations by (33), cond(W diag X), residual [%]."""

    value: dict[str, float]
    std: dict[str, float]
    cond: float
    error: float

    def percent(self, name: str) -> float:
        return 100 * self.std[name] / abs(self.value[name])


@lru_cache(maxsize=1)
def reference() -> Model:
    return build(machines.load_machine("va12_straight"))


@lru_cache(maxsize=64)
def true_model(plant: Plant) -> Model:
    """Build the true machine: the reference with the changes of a plant."""
    d = reference().machine.model_dump()
    for body in d["body"]:
        if body["contact"]:
            body["contact"]["Kx"]["value"] *= plant.soil
        if body["friction"]:
            for name in ("Fv", "Fs", "u0"):
                body["friction"][name]["value"] *= plant.scale
    for sensor in d["sensor"]:
        if sensor["kind"] == "torque":
            sensor["noise"]["value"] *= plant.scale
        if sensor["counts_per_turn"] and np.isfinite(plant.counts):
            sensor["counts_per_turn"]["value"] = round(sensor["counts_per_turn"]["value"] * plant.counts)
    return build(Machine.model_validate(d))


def trapezoids(duration: float, signs: Sequence[int], speed: float, ramp: float) -> np.ndarray:
    """Reference speed (N,) [m/s] at 100 Hz: one trapezoid per sign, ramps of `ramp` [s], at rest in between."""
    t = np.arange(round(duration * 100) + 1) / 100
    v, leg = np.zeros_like(t), duration / len(signs)
    for k, sign in enumerate(signs):
        s = t - k * leg - 0.5
        v += sign * speed * np.clip(np.minimum(s, leg - 1.5 - s) / ramp, 0, 1)
    return v


DRIVES = {  # reference speeds for the driver model
    "gentle": trapezoids(120, (1, -1, 1, -1), 1.0, 6.0),
    "slow": trapezoids(60, (1, -1, 1, -1), 1.0, 3.0),
    "forward only": trapezoids(60, (1, 1, 1, 1), 1.0, 3.0),
    "forward long": trapezoids(120, (1, 1, 1, 1), 1.0, 6.0),
    "brisk": trapezoids(60, (1, -1) * 4, 1.8, 1.0),
}
ROLLS_UP = 1e-9  # factor on Kx: rolls off the ground


@lru_cache(maxsize=2)
def s40(objective: str) -> Manoeuvre:
    """The designed straight-line drive."""
    model = reference()
    return design(model, model.machine.problems["S40"], objective, starts=2, seed=0).manoeuvre


def motion(plant: Plant, seed: int, designed: Manoeuvre | None = None) -> Motion:
    """Simulate a plant's drive; larger measuring wheels turn less and change nothing else."""
    if plant.drive == "S40":
        assert designed is not None
        moved = simulate(true_model(plant), designed.sample(100.0))
    else:
        moved = _motion(plant.drive, plant.soil, plant.scale, seed)
    return replace(moved, wheels=moved.wheels / (1 + plant.wheel))


@lru_cache(maxsize=16)
def _motion(drive: str, soil: float, scale: float, seed: int) -> Motion:
    model = true_model(Plant(soil=soil, scale=scale))
    return follow(model, DRIVES[drive], np.zeros((len(DRIVES[drive]), 0)), seed=seed)


def measured(plant: Plant, moved: Motion, seed: int) -> log.Log:
    """Simulate the log of the paper's sensors."""
    table = sensors.measure(true_model(plant), moved, kit="paper", seed=seed, noise=bool(np.isfinite(plant.counts)))
    for column in ("u1_Nm", "u4_Nm"):
        table[column] = table[column] / plant.scale
    return log.from_table(table, reference().machine)


# ------------------------------------------------------------------------------------------------ least squares, 1999


LAWS = ("v_n", "R_c w")


def equations(measurement: log.Log, cutoff: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Build W (3, n, 11) and Y (3, n) as `ols` does with a cut-off [Hz], by slip law."""
    model = reference()
    default = model.machine.filter
    f = Filter.model_validate(default.model_dump() | {"cutoff_hz": {"value": cutoff, "source": "assumed"}})
    s = samples(model, measurement, f)
    W = model.stacked_regressor(s.q, s.nu, s.a).transpose(1, 0, 2)
    kept = slice(f.drop[0], W.shape[1] - f.drop[1])
    Y = decimate(s.Y[:, kept], f.decimation)
    own = decimate(W[:, kept], f.decimation)
    printed = own.copy()
    for body in model.machine.contacts:
        rim = RADIUS * s.nu[model.coordinates.index(f"theta{body.index}")]
        # Below 0.02 m/s the slip is set to zero, to avoid division by zero.
        moving = np.abs(rim) > 0.02
        factor = np.where(moving, np.hypot(rim, 0.05) / np.where(moving, rim, 1.0), 0.0)
        k = model.base.names.index(f"Kx{body.index}")
        printed[:, :, k] = decimate((W[:, :, k] * factor)[:, kept], f.decimation)
    return dict(zip(LAWS, ((own, Y), (printed, Y)), strict=True))


ROWS: dict[str, tuple[float, bool]] = {  # weight of the homogeneous row 0 = M a - Kx1 g1 - Kx4 g4, M among the unknowns
    "all": (1.0, True),
    "row 1 in N m": (RADIUS, True),
    "row 1 x 0.1": (0.1, True),
    "no row 1": (0.0, False),
    "row 1, M dropped": (1.0, False),
    "row 1, M known": (1.0, False),
}


def solve(W: np.ndarray, Y: np.ndarray, rows: str) -> Fit:
    """Solve ordinary least squares with standard deviations (33), one variance for all rows."""
    names = reference().base.names
    weight, with_M = ROWS[rows]
    Y = Y.copy()
    if rows == "row 1, M known":
        Y[0] -= W[0, :, 0] * reference().nominal[0]
    use = list(range(3)) if weight > 0 else [1, 2]
    w = np.array([weight, 1.0, 1.0])[use]
    columns = list(range(len(names))) if with_M else list(range(1, len(names)))
    A = (W[use][:, :, columns] * w[:, None, None]).reshape(-1, len(columns))
    y = (Y[use] * w[:, None]).reshape(-1)
    size = np.linalg.norm(A, axis=0)
    Q, R = np.linalg.qr(A / size)
    x = scipy.linalg.solve_triangular(R, Q.T @ y) / size
    e = y - A @ x
    half = scipy.linalg.solve_triangular(R, np.eye(len(x))) / size[:, None]
    std = np.sqrt(e @ e / (len(y) - len(x)) * (half**2).sum(axis=1))
    label = [names[k] for k in columns]
    return Fit(
        dict(zip(label, x, strict=True)),
        dict(zip(label, std, strict=True)),
        float(np.linalg.cond(R * size * np.abs(x))),
        100 * float(np.linalg.norm(e) / np.linalg.norm(y)),
    )


# ------------------------------------------------------------------------------------------------ the printed pattern

Test = Callable[[Fit, Plant], bool]


def _true_K(plant: Plant) -> dict[str, float]:
    nominal = dict(zip(reference().base.names, reference().nominal, strict=True))
    return {n: nominal[n] * max(plant.soil, 1e-6) for n in ("Kx1", "Kx4")}


PATTERN: dict[str, Test] = {
    "inertias look sure: 0.1-1 %": lambda f, p: all(0.1 <= f.percent(n) <= 1 for n in ("ZZ1", "ZZ4")),
    "every friction 1-8 %": lambda f, p: all(1 <= f.percent(n) <= 8 for n in FRICTION),
    "both offsets 1-8 %": lambda f, p: all(1 <= f.percent(n) <= 8 for n in OFFSETS),
    "both K negative, 10-40 %": lambda f, p: all(f.value[n] < 0 and 10 <= f.percent(n) <= 40 for n in ("Kx1", "Kx4")),
    "both K below a tenth of the truth": lambda f, p: all(abs(f.value[n]) < 0.1 * -k for n, k in _true_K(p).items()),
    "cond(Phi) 60-150": lambda f, p: 60 <= f.cond <= 150,
    "M not found": lambda f, p: "M" not in f.value or f.value["M"] < 1100 or f.percent("M") > 10,
}
ABSOLUTE: dict[str, Test] = {
    "inertias as printed, to 20 %": lambda f, p: all(abs(f.value[n] / PAPER[n] - 1) < 0.2 for n in ("ZZ1", "ZZ4")),
    "both K as printed, to a factor of 2": lambda f, p: all(0.5 < f.value[n] / PAPER[n] < 2 for n in ("Kx1", "Kx4")),
}
EVERY = PATTERN | ABSOLUTE


def marks(fit: Fit, plant: Plant) -> np.ndarray:
    return np.array([test(fit, plant) for test in EVERY.values()])


def fits(plant: Plant, seed: int, recipes: Sequence[Recipe], designed: Manoeuvre | None) -> list[Fit]:
    """Identify one log by every recipe."""
    measurement = measured(plant, motion(plant, seed, designed), seed + 1)
    made = {c: equations(measurement, c) for c in sorted({r.cutoff for r in recipes})}
    return [solve(*made[r.cutoff][r.law], r.rows) for r in recipes]


# ------------------------------------------------------------------------------------------------ part 1: one by one

SINGLE: dict[str, tuple[Plant, Recipe]] = {
    "reference: gentle drive, all rows": (Plant(), Recipe()),
    "exact signals": (Plant(counts=np.inf), Recipe()),
    "exact signals, cut-off 10 Hz": (Plant(counts=np.inf), Recipe(cutoff=10)),
    "(a) encoders 8 times coarser": (Plant(counts=1 / 8), Recipe()),
    "(a) encoders 8 times finer": (Plant(counts=8), Recipe()),
    "(a) cut-off 1 Hz": (Plant(), Recipe(cutoff=1)),
    "(a) cut-off 10 Hz": (Plant(), Recipe(cutoff=10)),
    "(a) brisk drive": (Plant(drive="brisk"), Recipe()),
    "(b) wheel radius +0.5 %": (Plant(wheel=0.005), Recipe()),
    "(b) the same, exact signals, 10 Hz": (Plant(wheel=0.005, counts=np.inf), Recipe(cutoff=10)),
    "(c) without row 1": (Plant(), Recipe(rows="no row 1")),
    "(c) row 1 kept, M dropped": (Plant(), Recipe(rows="row 1, M dropped")),
    "(c) the same, exact signals, 10 Hz": (Plant(counts=np.inf), Recipe(cutoff=10, rows="row 1, M dropped")),
    "(c) row 1 weighted 0.1": (Plant(), Recipe(rows="row 1 x 0.1")),
    "(c) row 1 with M known": (Plant(), Recipe(rows="row 1, M known")),
    "(d) soil 10 times stiffer": (Plant(soil=10), Recipe()),
    "(d) soil 100 times stiffer": (Plant(soil=100), Recipe()),
    "(d) soil 100 times softer": (Plant(soil=0.01), Recipe()),
    "(e) torque read 4.79 times too small": (Plant(scale=SCALE), Recipe()),
    "(e) the same, without row 1": (Plant(scale=SCALE), Recipe(rows="no row 1")),
    "(f) slip over R_c w": (Plant(), Recipe(law="R_c w")),
    "(f) the same, exact signals, 10 Hz": (Plant(counts=np.inf), Recipe(law="R_c w", cutoff=10)),
    "(f) the same, exact, forward only": (
        Plant(drive="forward only", counts=np.inf),
        Recipe(law="R_c w", cutoff=10),
    ),
    "(g) rolls off the ground, without row 1": (
        Plant(drive="slow", soil=ROLLS_UP),
        Recipe(rows="no row 1"),
    ),
    "(a)+(c) forward only, without row 1": (Plant(drive="forward only"), Recipe(rows="no row 1")),
    "(a)+(c) forward long, without row 1": (Plant(drive="forward long"), Recipe(rows="no row 1")),
    "(a)+(c) forward long, without row 1, 10 Hz": (
        Plant(drive="forward long"),
        Recipe(rows="no row 1", cutoff=10),
    ),
}


def _median(found: Sequence[Fit]) -> dict[str, float]:
    """Medians over seeds of values, standard deviations [%], cond, error and conserved sum."""
    names = found[0].value
    out = {n: float(np.median([f.value[n] for f in found])) for n in names}
    out |= {f"{n} std_percent": float(np.median([f.percent(n) for f in found])) for n in names}
    out["cond_phi"] = float(np.median([f.cond for f in found]))
    out["error_percent"] = float(np.median([f.error for f in found]))
    out["inertia_sum"] = float(np.median([conserved(f) for f in found]))
    return out


def conserved(fit: Fit) -> float:
    """Sum ZZ1 + ZZ4 + R_c^2 M [kg m2], which the torques of a rolling machine determine."""
    return fit.value["ZZ1"] + fit.value["ZZ4"] + RADIUS**2 * fit.value.get("M", 0.0)


def _single(seed: int) -> dict[str, Fit]:
    """Identify every single change on one seed."""
    return {name: fits(plant, seed, [recipe], None)[0] for name, (plant, recipe) in SINGLE.items()}


def one_by_one(jobs: int) -> dict[str, dict[str, float]]:
    found = joblib.Parallel(n_jobs=jobs, backend=FORK)(joblib.delayed(_single)(s) for s in range(MANY))
    out = {}
    for name, (plant, _) in SINGLE.items():
        own = [f[name] for f in found]
        score = float(np.mean([marks(f, plant)[: len(PATTERN)].sum() for f in own]))
        out[name] = _median(own) | {"marks": score}
    return out


# ------------------------------------------------------------------------------------------------ part 2: the grid

FACTORS = {
    "drive": ("gentle", "forward long", "brisk", "S40"),
    "soil": (1.0, 10.0, 100.0),
    "counts": (1 / 8, 1.0, np.inf),
    "wheel": (0.0, 0.005),
    "rows": tuple(ROWS),
    "law": LAWS,
    "cutoff": (1.0, 3.0, 10.0),
}
RECIPES = [Recipe(*r) for r in itertools.product(FACTORS["law"], FACTORS["cutoff"], FACTORS["rows"])]


def plants() -> Iterator[Plant]:
    """List every combination, and plants with torques read too small."""
    for drive, soil, counts, wheel in itertools.product(*(FACTORS[k] for k in ("drive", "soil", "counts", "wheel"))):
        yield Plant(drive, soil, counts, wheel)
    for drive, counts in itertools.product(("gentle", "forward long", "brisk"), (0.35, 0.5, 1.0)):
        yield Plant(drive, counts=counts, scale=SCALE)


Cell = tuple[np.ndarray, list[dict[str, float]]]


def _cell(group: Sequence[Plant], designed: Manoeuvre) -> list[Cell]:
    """Of every plant: marks (recipes, seeds, tests), and medians by recipe. A group's plants share their motions."""
    found: list[list[list[Fit]]] = [[] for _ in group]
    for seed in range(SEEDS):
        for own, plant in zip(found, group, strict=True):
            own.append(fits(plant, seed, RECIPES, designed))
    out = []
    for own, plant in zip(found, group, strict=True):
        by_recipe = list(zip(*own, strict=True))
        out.append((np.array([[marks(f, plant) for f in r] for r in by_recipe]), [_median(r) for r in by_recipe]))
    return out


def grid(jobs: int, designed: Manoeuvre) -> dict[str, object]:
    todo = list(plants())
    groups = [list(g) for _, g in itertools.groupby(todo, key=lambda p: (p.drive, p.soil, p.scale))]
    work = joblib.Parallel(n_jobs=jobs, backend=FORK)(joblib.delayed(_cell)(g, designed) for g in groups)
    cells, scores = [], []
    for plant, (table, medians) in zip(todo, itertools.chain.from_iterable(work), strict=True):
        for recipe, own, median in zip(RECIPES, table, medians, strict=True):
            cells.append((asdict(plant) | asdict(recipe), median))
            scores.append(own)
    S = np.array(scores)  # cells, seeds, tests
    relative = S[:, :, : len(PATTERN)]
    whole = relative.all(axis=2).mean(axis=1)
    everything = S.all(axis=2).mean(axis=1)
    plain = np.array([c["scale"] == 1 for c, _ in cells])
    shares = {
        key: {
            str(level): float(whole[plain & np.array([c[key] == level for c, _ in cells])].mean()) for level in levels
        }
        for key, levels in FACTORS.items()
    }
    order = np.lexsort(([_distance(m) for _, m in cells], -np.round(whole, 1), ~plain))
    nearest = np.argsort([_distance(m) + _apart(m) for _, m in cells])

    def listed(k: int) -> dict[str, object]:
        cell, median = cells[k]
        return {"cell": cell, "share_pattern": float(whole[k]), "share_all": float(everything[k]), "median": median}

    scaled = ~plain
    return {
        "cells": len(cells),
        "seeds": SEEDS,
        "logs": len(todo) * SEEDS,
        "fits": int(S.shape[0] * S.shape[1]),
        "share_by_test": {
            name: {"true torques": float(S[plain, :, k].mean()), "torques too small": float(S[scaled, :, k].mean())}
            for k, name in enumerate(EVERY)
        },
        "fits_with_pattern": int(relative[plain].all(axis=2).sum()),
        "fits_with_pattern_and_printed_K": int((relative.all(axis=2) & S[:, :, -1])[plain].sum()),
        "fits_with_pattern_and_printed_inertias": int((relative.all(axis=2) & S[:, :, -2])[plain].sum()),
        "fits_with_all": int(S[plain].all(axis=2).sum()),
        "scaled_fits": int(scaled.sum() * SEEDS),
        "scaled_fits_with_pattern": int(relative[scaled].all(axis=2).sum()),
        "scaled_fits_with_printed_inertias_and_K": int((S[:, :, -2] & S[:, :, -1])[scaled].sum()),
        "scaled_fits_with_all": int(S[scaled].all(axis=2).sum()),
        "printed_inertias_cells": _count(cells, S[:, :, -2], plain),
        "share_of_pattern_by_level": shares,
        "best": [listed(int(k)) for k in order[:8]],
        "nearest_to_values": [listed(int(k)) for k in nearest if plain[k]][:3],
        "nearest_to_values_scaled": [listed(int(k)) for k in nearest if scaled[k]][:5],
    }


def _distance(median: dict[str, float]) -> float:
    """Mean absolute log ratio of stated standard deviations and cond of a cell to the printed ones."""
    printed = {"ZZ": 0.3, "Kx": 21.4}
    off = [np.log(median[f"{n} std_percent"] / printed.get(n[:2], 3.0)) for n in PAPER]
    return float(np.mean(np.abs([*off, np.log(median["cond_phi"] / 87)])))


def _apart(median: dict[str, float]) -> float:
    """Mean absolute log ratio of a cell's values to the printed ones; a wrong sign counts as a factor of 20."""
    return float(np.mean([abs(np.log(median[n] / x)) if median[n] * x > 0 else 3.0 for n, x in PAPER.items()]))


def _count(
    cells: list[tuple[dict[str, object], dict[str, float]]], hit: np.ndarray, among: np.ndarray
) -> dict[str, int]:
    """Count fits with the printed inertias by soil, encoder and drive."""
    out: dict[str, int] = {}
    for (cell, _), own, yes in zip(cells, hit, among, strict=True):
        if yes and own.any():
            key = f"soil {cell['soil']}, encoders x {cell['counts']:g}, {cell['drive']}"
            out[key] = out.get(key, 0) + int(own.sum())
    return dict(sorted(out.items(), key=lambda kv: -kv[1]))


# ------------------------------------------------------------------------------------------------ part 3: mechanism

FINER = (1 / 8, 1 / 2, 1.0, 4.0, 16.0, 64.0, 256.0, 1024.0)


def _resolution(counts: float, seed: int, designed: Manoeuvre | None) -> Fit:
    drive = "gentle" if designed is None else "S40"
    return fits(Plant(drive=drive, counts=counts), seed, [Recipe(cutoff=10)], designed)[0]


def mechanism(jobs: int, designed: Manoeuvre) -> dict[str, dict[str, list[dict[str, float]]]]:
    """Identify by OLS over encoder resolution, gentle and designed drive; cut-off 10 Hz makes filters negligible."""
    out = {}
    for name, d in (("gentle", None), ("S40", designed)):
        todo = [(c, s) for c in FINER for s in range(SEEDS)]
        found = joblib.Parallel(n_jobs=jobs, backend=FORK)(joblib.delayed(_resolution)(c, s, d) for c, s in todo)
        out[name] = {
            "counts": list(FINER),
            "fits": [_median([f for (k, _), f in zip(todo, found, strict=True) if k == c]) for c in FINER],
        }
    return out


# -------------------------------------------------------------------------------- part 4: the recommended method


def wrong_start(seed: int) -> Model:
    """Build a machine with masses, inertias, friction and soil up to 20 % off, as a starting point."""
    rng = np.random.default_rng(seed)
    d = reference().machine.model_dump()
    for body in d["body"]:
        for part, names in (("inertia", ("mass", "ZZ")), ("friction", ("Fv", "Fs", "u0")), ("contact", ("Kx",))):
            for name in names:
                if body[part] and body[part].get(name):
                    body[part][name]["value"] *= rng.uniform(0.8, 1.2)
    return build(Machine.model_validate(d))


def instead(jobs: int, designs: dict[str, Manoeuvre]) -> dict[str, object]:
    model, known = reference(), wrong_start(1)
    drives = {"gentle": motion(Plant(), 0)}
    drives |= {f"S40 {name}": simulate(model, m.sample(100.0)) for name, m in designs.items()}
    out: dict[str, object] = {}
    for name, moved in drives.items():
        for method in ("ols", "joint"):
            print(f"  {method} on {name}", flush=True)
            v = verify(model, moved, method, kit="paper", runs=RUNS, seed=5, start=known, jobs=jobs)
            out[f"{method}, {name}"] = {"failures": len(v.failures), "parameters": verified(v)}
        bound = relative_std_percent(model, cramer_rao(model, moved, "paper"))
        out[f"bound, {name}"] = dict(zip(model.base.names, map(float, bound), strict=True))
    return out


# -------------------------------------------------------------------------------- physics of the printed numbers


def physics() -> dict[str, float]:
    """Compute the physical consequences of the printed numbers."""
    names = dict(zip(reference().base.names, reference().nominal, strict=True))
    M = names["M"]
    K = -(PAPER["Kx1"] + PAPER["Kx4"])
    inertia = PAPER["ZZ1"] + PAPER["ZZ4"]
    std_Fs, std_ZZ = 0.03 * PAPER["Fs1"], 0.003 * PAPER["ZZ1"]
    return {
        "traction_at_slip_0.15_N": 0.15 * K,
        "acceleration_m_s2": 0.15 * K / M,
        "time_to_1_m_s_s": M / (0.15 * K),
        "slip_for_0.1_m_s2": 0.1 * M / K,
        "M_R2_kg_m2": M * RADIUS**2,
        "inertia_sum_true_kg_m2": names["ZZ1"] + names["ZZ4"] + M * RADIUS**2,
        "inertia_sum_printed_kg_m2": inertia,
        "ratio": (names["ZZ1"] + names["ZZ4"] + M * RADIUS**2) / inertia,
        "largest_mass_without_rolls_kg": inertia / RADIUS**2,
        "largest_radius_m": float(np.sqrt(inertia / M)),
        "gyration_ZZ1_m": float(np.sqrt(PAPER["ZZ1"] / 1900)),
        "gyration_if_2800_m": float(np.sqrt(2800 / 1900)),
        "friction_force_printed_N": (PAPER["Fs1"] + PAPER["Fs4"]) / RADIUS,
        "friction_share_of_weight_percent": 100 * (PAPER["Fs1"] + PAPER["Fs4"]) / RADIUS / (M * 9.81),
        "cond_at_least": 27 / 0.3,
        "torque_by_K_at_slip_0.02_Nm": 0.02 * RADIUS * 285,
        "std_ratio_Fs_over_ZZ_rad_s2": std_Fs / std_ZZ,
        "std_ratio_RK_over_Fs": RADIUS * 0.22 * 285 / (0.03 * 0.5 * (PAPER["Fs1"] + PAPER["Fs4"])),
    }


# ------------------------------------------------------------------------------------------------ figures and tables


def figures(result: dict[str, object]) -> None:
    _mechanism_figure(result["mechanism"])  # type: ignore[arg-type]
    _pattern_figure(result)
    _instead_figure(result["instead"])  # type: ignore[arg-type]


def _mechanism_figure(m: dict[str, dict[str, list[dict[str, float]]]]) -> None:
    names = dict(zip(reference().base.names, reference().nominal, strict=True))
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    look = {"gentle": ("gentle drive", "o", "-"), "S40": ("designed drive S40", "s", "--")}
    for k, (name, (label, marker, line)) in enumerate(look.items()):
        x = np.array(m[name]["counts"])
        for ax, p in ((left, "Kx1"), (right, "ZZ1")):
            y = np.array([f[p] for f in m[name]["fits"]])
            bar = 2 * np.array([f[p] * f[f"{p} std_percent"] / 100 for f in m[name]["fits"]])
            scale = names[p] if p == "Kx1" else 1.0
            y, bar = y / scale, np.abs(bar / scale)
            low = np.minimum(bar, 0.95 * np.abs(y)) if p == "Kx1" else bar
            ax.errorbar(
                x * (1.06 if k else 0.94),
                y,
                [low, bar],
                color=COLOURS[k],
                marker=marker,
                linestyle=line,
                capsize=3,
                label=label,
            )
    left.axhline(1, color="black", linewidth=0.8)
    left.text(0.02, 1.15, "truth", fontsize=9, transform=left.get_yaxis_transform())
    left.axhline(0.0026, color="black", linestyle=":", linewidth=1)
    left.text(
        0.98, 0.0023, "as printed, -260 N", fontsize=9, ha="right", va="top", transform=left.get_yaxis_transform()
    )
    left.set(yscale="log", ylim=(5e-4, 3), ylabel="estimate of Kx1 / true Kx1 [-]", title="Contact shrinks")
    right.axhline(names["ZZ1"], color="black", linewidth=0.8)
    right.text(
        0.98,
        names["ZZ1"] - 140,
        "truth, and as printed: 556",
        fontsize=9,
        ha="right",
        transform=right.get_yaxis_transform(),
    )
    right.axhline(names["ZZ1"] + names["M"] * RADIUS**2 / 2, color="black", linestyle="-.", linewidth=1)
    half = names["ZZ1"] + names["M"] * RADIUS**2 / 2
    right.text(
        0.98,
        half + 40,
        f"roll and half the machine: {half:.0f}",
        fontsize=9,
        ha="right",
        transform=right.get_yaxis_transform(),
    )
    right.set(
        ylim=(0, 3300),
        ylabel="estimate of ZZ1 [kg m²]",
        title="... and the machine hides in the inertias",
    )
    for ax in (left, right):
        ax.set(xscale="log", xlabel="encoder counts per turn / those of the machine file [-]")
        ax.axvline(1, color="grey", linewidth=0.6)
        ax.grid(alpha=0.3)
    left.legend(loc="lower right", bbox_to_anchor=(1, 0.22), fontsize=9)
    figure.suptitle("Least squares as in 1999 against encoder resolution; bars: two standard deviations that it states")
    save(figure, HERE / "mechanism.png")


def _pattern_figure(result: dict[str, object]) -> None:
    near = result["grid"]["best"][0], result["grid"]["nearest_to_values_scaled"][0]  # type: ignore[index]
    names = list(PAPER)
    figure = Figure(figsize=(10, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    x = np.arange(len(names))
    for k, n in enumerate(names):
        low, high = {"ZZ": (0.2, 0.4), "Kx": (17, 27)}.get(n[:2], (2, 4))
        printed = "as printed, about" if k == 0 else None
        left.fill_between([k - 0.35, k + 0.35], low, high, color=COLOURS[5], alpha=0.6, label=printed)
    labels = "torques right", "torques read 4.79 times too small"
    for k, (found, label) in enumerate(zip(near, labels, strict=True)):
        m = found["median"]
        look = {"marker": "os"[k], "color": COLOURS[k], "linestyle": "none", "markerfacecolor": (None, "none")[k]}
        text = f"{label}, cond(Phi) {m['cond_phi']:.0f} (printed 80-95)"
        left.plot(x + 0.2 * k - 0.1, [m[f"{n} std_percent"] for n in names], label=text, **look)
        right.plot(x + 0.2 * k - 0.1, [m[n] / PAPER[n] for n in names], **look)
    left.set(yscale="log", ylabel="stated standard deviation [%]", title="Deviations that least squares states")
    truth = dict(zip(reference().base.names, reference().nominal, strict=True))
    right.plot(x, [truth[n] / PAPER[n] for n in names], "_", color="black", markersize=14, label="true value")
    right.axhline(1, color="black", linewidth=0.8)
    right.set(yscale="log", ylim=(0.3, 1000), ylabel="estimate / printed value [-]", title="Values")
    for ax in (left, right):
        ax.set_xticks(x, names)
        ax.grid(alpha=0.3)
    figure.suptitle("Cells of the grid nearest to the printed table")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    save(figure, HERE / "pattern.png")


def _instead_figure(r: dict[str, dict[str, dict[str, dict[str, float]]]]) -> None:
    names = reference().base.names
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    ax = figure.subplots()
    cases = [k for k in r if not k.startswith("bound") and k != "ols, S40 D"]
    markers = dict(zip(cases, "ovsD^", strict=False))
    for k, case in enumerate(cases):
        p = r[case]["parameters"]
        x = np.arange(len(names)) + 0.15 * (k - (len(cases) - 1) / 2)
        ax.errorbar(
            x,
            [p[n]["bias_percent"] for n in names],
            [2 * p[n]["std_percent"] for n in names],
            fmt=markers[case],
            color=COLOURS[k],
            capsize=2,
            markersize=5,
            label=case,
        )
    ax.axhline(0, color="black", linewidth=0.8)
    ax.set_yscale("symlog", linthresh=10)
    ax.set_yticks(
        [-100, -30, -10, -5, 0, 5, 10, 30, 100, 300], ["-100", "-30", "-10", "-5", "0", "5", "10", "30", "100", "300"]
    )
    ax.set(xlabel="parameter", ylabel="error [%], linear up to 10", ylim=(-200, 3000))
    ax.set_xticks(range(len(names)), names)
    for k in range(1, len(names)):
        ax.axvline(k - 0.5, color="grey", linewidth=0.4)
    ax.grid(alpha=0.3, axis="y")
    ax.legend(ncols=len(cases), fontsize=9, loc="upper center")
    ax.set_title(f"Mean error and two standard deviations over {RUNS} simulated logs, the paper's sensors")
    save(figure, HERE / "instead.png")


def tables(result: dict[str, object]) -> str:
    """Write the Markdown tables of tables.md."""
    head = (
        "change|M [kg]|ZZ1 [kg m2]|ZZ4 [kg m2]|friction / offsets, median std %|Kx1 [N]|Kx4 [N]|cond(Phi)"
        "|ZZ1 + ZZ4 + R_c² M|marks of 7"
    )
    lines = [f"| {head.replace('|', ' | ')} |", "|---" * 10 + "|"]
    for name, m in result["one_by_one"].items():  # type: ignore[attr-defined]

        def cell(n: str, m: dict[str, float] = m) -> str:
            return f"{m[n]:.4g} ({m[f'{n} std_percent']:.2g})" if n in m else "-"

        friction = " / ".join(f"{np.median([m[f'{n} std_percent'] for n in ns]):.2g}" for ns in (FRICTION, OFFSETS))
        lines.append(
            f"| {name} | {cell('M')} | {cell('ZZ1')} | {cell('ZZ4')} | {friction} | {cell('Kx1')} | {cell('Kx4')} |"
            f" {m['cond_phi']:.3g} | {m['inertia_sum']:.0f} | {m['marks']:.1f} |"
        )
    r = result["instead"]
    for case, own in r.items():  # type: ignore[attr-defined]
        if case.startswith("bound"):
            continue
        lines += ["", f"**{case}**, failures {own['failures']}", ""]
        lines += ["| parameter | true | mean | bias % | dispersion % | predicted % | coverage |", "|---" * 7 + "|"]
        lines += [
            f"| {n} | {p['true']:.6g} | {p['mean']:.5g} | {p['bias_percent']:.2f} | {p['std_percent']:.2f} |"
            f" {p['predicted_std_percent']:.2f} | {100 * p['coverage95']:.0f} % |"
            for n, p in own["parameters"].items()
        ]
    return "\n".join(lines) + "\n"


def _plain(x: object) -> object:
    """Round numbers to five digits, so that files can be compared."""
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, float | np.floating):
        return float(f"{x:.5g}") if np.isfinite(x) else str(x)
    return x


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2, help="parallel processes")
    jobs = parser.parse_args().jobs
    print("designing S40", flush=True)
    designs = {"cond": s40("cond"), "D": s40("D")}
    result: dict[str, object] = {
        "printed": {"values": PAPER, "std_percent": PAPER_STD, "cond": [80, 95]},
        "physics": physics(),
    }
    print("one by one", flush=True)
    result["one_by_one"] = one_by_one(jobs)
    print("mechanism", flush=True)
    result["mechanism"] = mechanism(jobs, designs["cond"])
    print("grid", flush=True)
    result["grid"] = grid(jobs, designs["cond"])
    print("instead", flush=True)
    result["instead"] = instead(jobs, designs)
    plain = _plain(result)
    (HERE / "summary.json").write_text(json.dumps(plain, indent=1) + "\n")
    (HERE / "tables.md").write_text(tables(result))
    figures(result)


if __name__ == "__main__":
    main()

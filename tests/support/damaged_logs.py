"""Clean simulated logs, damaged at random, and what becomes of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy

from excite.errors import ExciteError
from excite.identification import identify, needed_sensors, recommend_method
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.simulation import Motion, follow_positions, inverse_dynamics, measure, simulate

SUPPORT = Path(__file__).parent
MACHINES = {
    "rig": str(SUPPORT / "rig.toml"),
    "two_joints": str(SUPPORT / "two_joints.toml"),
    "va12_straight": "va12_straight",
}
WRONG_STDS = 4.0  # total standard deviations from the truth beyond which a valid estimate is wrong

Column = np.ndarray
Damage = Callable[[Column, np.random.Generator, float], Column]


def _late(x: Column, rng: np.random.Generator, rate: float) -> Column:
    at = np.arange(len(x))
    return np.interp(at - rng.choice([-1, 1]) * rng.uniform(0.005, 0.05) * rate, at, x)


def _clipped(x: Column, rng: np.random.Generator, rate: float) -> Column:
    limit = rng.uniform(0.4, 0.95) * np.abs(x).max()
    return np.clip(x, -limit, limit)


def _sign_lost(x: Column, rng: np.random.Generator, rate: float) -> Column:
    return np.where((x < 0) & (rng.random(len(x)) < rng.uniform(0.05, 1.0)), -x, x)


def _lagged(x: Column, rng: np.random.Generator, rate: float) -> Column:
    share = 1 - np.exp(-1 / (rate * rng.uniform(0.01, 0.1)))
    return scipy.signal.lfilter([share], [1, share - 1], x, zi=[x[0] * (1 - share)])[0]


def _drifting(x: Column, rng: np.random.Generator, rate: float) -> Column:
    return x + rng.choice([-1, 1]) * rng.uniform(0.05, 0.5) * x.std() * np.linspace(0, 1, len(x))


def _hum(x: Column, rng: np.random.Generator, rate: float) -> Column:
    t = np.arange(len(x)) / rate
    return x + rng.uniform(0.05, 0.5) * x.std() * np.sin(2 * np.pi * rng.uniform(0.3, 0.45 * rate) * t)


def _stuck(x: Column, rng: np.random.Generator, rate: float) -> Column:
    y = x.copy()
    for _ in range(rng.integers(1, 4)):
        begin = rng.integers(0, len(x) - 10)
        y[begin : begin + rng.integers(10, max(11, len(x) // 10))] = y[begin]
    return y


def _scaled(x: Column, rng: np.random.Generator, rate: float) -> Column:
    return x * (1 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.3))


def _quantised(x: Column, rng: np.random.Generator, rate: float) -> Column:
    step = rng.uniform(0.05, 0.5) * x.std()
    return np.round(x / step) * step


def _outliers(x: Column, rng: np.random.Generator, rate: float) -> Column:
    hit = rng.random(len(x)) < rng.uniform(0.002, 0.03)
    return x + hit * rng.standard_normal(len(x)) * rng.uniform(1, 5) * x.std()


def _held(x: Column, rng: np.random.Generator, rate: float) -> Column:
    every = rng.integers(2, 8)
    return x[np.arange(len(x)) // every * every]


def _offset_jump(x: Column, rng: np.random.Generator, rate: float) -> Column:
    return x + (np.arange(len(x)) > rng.uniform(0.2, 0.8) * len(x)) * rng.uniform(0.1, 0.6) * x.std()


def _noisier(x: Column, rng: np.random.Generator, rate: float) -> Column:
    return x + rng.uniform(0.02, 0.2) * x.std() * rng.standard_normal(len(x))


DAMAGES: dict[str, Damage] = {
    f.__name__.strip("_"): f
    for f in (
        *(_late, _clipped, _sign_lost, _lagged, _drifting, _hum, _stuck, _scaled, _quantised, _outliers, _held),
        *(_offset_jump, _noisier),
    )
}
OF_ANGLES = ("late", "drifting", "stuck", "outliers", "lagged", "quantised")  # damages of an angle column


@lru_cache
def machine_model(name: str) -> Model:
    return build(load_machine(MACHINES[name]))


def lively(model: Model, rng: np.random.Generator) -> Motion:
    """Drive a machine at random: a roller by torques, others along a motion of five sines under position control."""
    rate = float(model.machine.sampling_hz)
    if not model.fully_driven:
        t = np.arange(round(30 * rate) + 1) / rate
        fade = np.clip(np.minimum(t, t[-1] - t) / 2, 0, 1)
        waves = [
            [np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) for f in rng.uniform(0.1, 1.0, 5)]
            for _ in model.inputs
        ]
        return simulate(model, np.column_stack([900 * np.sum(w, axis=0) * fade for w in waves]))
    t = np.arange(round(10 * rate) + 1) / rate
    x = np.clip(np.minimum(t, t[-1] - t) / 1.5, 0, 1)
    fade = 6 * x**5 - 15 * x**4 + 10 * x**3
    pace = 3.0 if model.machine.body[0].joint == "prismatic" else 1.5  # rad/s, friction turns over within samples
    reach = 0.05 if model.machine.body[0].joint == "prismatic" else 0.5
    q = np.array(
        [
            sum(reach / k * np.sin(pace * k * t + rng.uniform(0, 2 * np.pi)) for k in range(1, 5)) * fade
            for _ in model.coordinates
        ]
    )
    course = scipy.interpolate.make_interp_spline(t, q, k=7, axis=1)
    nu, a = course(t, 1), course(t, 2)
    u = inverse_dynamics(model)(q, nu, a, model.nominal).full().T
    return follow_positions(model, u, q.T, nu.T)


def damaged(table: pd.DataFrame, model: Model, rng: np.random.Generator) -> tuple[pd.DataFrame, str]:
    """Return a log with one or two damages, and say which."""
    rate, said = float(model.machine.sampling_hz), []
    table = table.copy()
    sensors = [s for s in model.machine.sensors("full") if s.kind in ("torque", "angle")]
    for _ in range(rng.integers(1, 3)):
        kind = rng.choice(["dropped", *DAMAGES])
        if kind == "dropped":
            keep = rng.random(len(table)) > rng.uniform(0.01, 0.2)
            table = table[keep | (np.arange(len(table)) == 0)].reset_index(drop=True)
            said.append("dropped rows")
            continue
        fitting = [s for s in sensors if s.kind == "torque" or kind in OF_ANGLES]
        sensor = fitting[rng.integers(len(fitting))]
        x = table[sensor.column].to_numpy(float)
        y = DAMAGES[kind](x, rng, rate)
        table[sensor.column] = y
        said.append(f"{sensor.name} {kind} ({np.std(y - x) / np.std(x):.2g})")
    return table, ", ".join(said)


def one_table(name: str, seed: int, clean: bool) -> tuple[Model, pd.DataFrame, str]:
    """Simulate one log, damage it if it is not to be clean, and say how."""
    model, rng = machine_model(name), np.random.default_rng([seed, int(clean)])
    table = measure(model, lively(model, rng), seed=seed)
    return model, *((table, "clean") if clean else damaged(table, model, rng))


def one_log(name: str, method: str | None, seed: int, clean: bool) -> dict[str, Any]:
    """Simulate, damage and identify one log; return what came of it."""
    model, table, what = one_table(name, seed, clean)
    method = method or recommend_method(model)
    row: dict[str, Any] = {"machine": name, "method": method, "seed": seed, "what": what}
    begin = time.process_time()
    try:
        ready = prepare(model, [table], needed_sensors(model, method))
        found = identify(ready.model, ready.logs, method)
    except ExciteError as err:
        return row | {"status": "refused", "doubt": str(err), "s": time.process_time() - begin}
    known = np.isfinite(found.value)
    off = np.abs(found.value - model.nominal)[known]
    low, high = found.noise_interval95[:, known]
    inside = (low <= model.nominal[known]) & (model.nominal[known] <= high)
    return row | {
        "status": found.status,
        "doubt": found.doubt,
        "worst": float((off / found.std_total[known]).max()),
        "worst_name": np.array(found.names)[known][int(np.argmax(off / found.std_total[known]))],
        "inside": int(inside.sum()),
        "of": int(known.sum()),
        "tests": {f"{t.signal} {t.what}": float(np.log10(max(t.p_value, 1e-99))) for t in found.tests},
        "s": time.process_time() - begin,
    }


def summary(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield lines that say how many logs of a machine are valid, right and wrong."""
    for name in dict.fromkeys(r["machine"] for r in rows):
        own = [r for r in rows if r["machine"] == name]
        clean = [r for r in own if r["what"] == "clean"]
        if clean:
            told = [r for r in clean if "of" in r]
            share = 100 * sum(r["inside"] for r in told) / max(sum(r["of"] for r in told), 1)
            valid = sum(r["status"] == "valid" for r in clean)
            yield f"{name}: clean: {valid} of {len(clean)} valid, {share:.1f} % inside by noise"
        hurt = [r for r in own if r["what"] != "clean"]
        if hurt:
            count = {s: sum(r["status"] == s for r in hurt) for s in ("valid", "doubtful", "invalid", "refused")}
            wrong = [r for r in hurt if r["status"] == "valid" and r["worst"] > WRONG_STDS]
            yield f"{name}: damaged: {count}, wrong {len(wrong)} of {len(hurt)}"
            for r in wrong:
                yield f"    seed {r['seed']}: {r['what']}: {r['worst_name']} off by {r['worst']:.1f}"

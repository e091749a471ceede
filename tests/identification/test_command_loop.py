"""A rig that logs commanded forces: with the drive's known loop the estimate is right, without it is biased."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy

from excite.identification import Estimate, identify, needed_sensors
from excite.logs import convert, from_table, prepare
from excite.model import Model, build
from excite.model.machine import ForceLoop, Machine, before_loop, behind_loop
from excite.simulation import measure, simulate

RIG: Any = tomllib.loads((Path(__file__).parents[1] / "support" / "rig.toml").read_text())
LAG, DEAD = 0.02, 0.013  # s
RATE, FINER = 500, 8  # Hz; steps of the true drive in a sample
LOOP = {"time_constant": {"value": LAG, "source": "data sheet"}, "dead_time": {"value": DEAD, "source": "data sheet"}}


def rig(loop: Any = LOOP, rate: float = RATE, mass: float = 95.1) -> Model:
    table = copy.deepcopy(RIG)
    table["sampling_hz"]["value"] = rate
    table["filter"]["cutoff_hz"]["value"] = 30
    table["body"][0]["inertia"]["mass"]["value"] = mass
    if loop:
        table["sensor"][1]["loop"] = loop
    return build(Machine.model_validate(table))


def log_of(seed: int, seconds: int = 6) -> tuple[pd.DataFrame, np.ndarray]:
    """A log of commands of many sines up to 6 Hz, and the true parameters.

    The drive is a state space of its own: scipy's response to a command held on a grid eight times as fine.
    """
    rng, plant = np.random.default_rng(seed), rig(None, RATE * FINER)
    fine = np.arange(seconds * RATE * FINER) / (RATE * FINER)
    waves = [(f, rng.uniform(0, 2 * np.pi)) for f in np.geomspace(0.3, 6, 14)]
    size = sum(np.sin(2 * np.pi * f * fine + p) for f, p in waves)

    def command(t: np.ndarray) -> np.ndarray:
        return np.asarray(
            120 / np.abs(size).max() * sum(np.sin(2 * np.pi * f * np.maximum(t, 0) + p) for f, p in waves)
        )

    start = command(np.zeros(1))
    _, force, _ = scipy.signal.lsim(([1.0], [LAG, 1.0]), command(fine - DEAD) - start, fine)
    motion = simulate(plant, (force + start)[:, None])
    t, noise = fine[::FINER], rng.standard_normal((2, seconds * RATE))
    offset = plant.nominal[plant.base.names.index("offset")]
    table = {"t_s": t, "q_m": motion.q[::FINER, 0] + 1e-6 * noise[0], "u_N": command(t) + offset + noise[1]}
    return pd.DataFrame(table), plant.nominal


def estimate_by(method: str, model: Model, log: pd.DataFrame) -> Estimate:
    ready = prepare(model, [log], needed_sensors(model, method))
    return identify(ready.model, ready.logs, method)


def test_response_to_a_step_is_that_of_a_lag_with_dead_time() -> None:
    step = 1e-3
    t = step * np.arange(200)
    command = np.clip((t - 0.02) / step, 0, 1)  # from 0 to 1 within a sample
    found = behind_loop(ForceLoop.model_validate(LOOP), command, step)
    since = t - 0.02 - DEAD - step / 2
    assert found == pytest.approx(np.where(since > 0, 1 - np.exp(-since / LAG), 0), abs=1e-3)
    late = behind_loop(ForceLoop.model_validate({"dead_time": LOOP["dead_time"]}), command, step)
    assert late == pytest.approx(np.interp(t - DEAD, t, command))


def test_simulated_logs_hold_the_command_that_the_motion_takes() -> None:
    """Reading the column back gives the delivered force with its offset, but for corners and both ends."""
    model = rig()
    t = np.arange(1000) / RATE
    u = 50 * np.sin(2 * np.pi * 1.3 * t)
    table = measure(model, simulate(model, u[:, None]), noise=False)
    assert np.abs(table["u_N"] - 3.16 - u).max() > 5
    back = from_table(table, model.machine).values["u1"]
    assert back[100:-100] == pytest.approx(u[100:-100] - 3.16, abs=0.05)
    loop = ForceLoop.model_validate(LOOP)
    assert before_loop(loop, np.full(50, 7.0), 0.002) == pytest.approx(7.0)


def test_the_known_loop_takes_the_bias_away() -> None:
    """Without the loop joint smoothing finds forces in its place, and doubts its values."""
    z = []
    for seed in range(3):
        log, truth = log_of(seed)
        found = estimate_by("joint", rig(mass=110.0), log)
        assert found.status == "valid", found.doubt
        assert np.abs(found.value / truth - 1).max() < 0.1
        z.append((found.value - truth) / found.std)
    assert np.abs(z).max() < 3.5
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6
    plain = estimate_by("joint", rig(None, mass=110.0), log)
    assert plain.relative_error_percent > 3 * found.relative_error_percent
    assert plain.status in ("doubtful", "invalid")
    assert np.nanmax(np.abs(plain.value / truth - 1)[:2]) > 0.05  # mass or viscous friction


def test_what_was_commanded_before_a_stretch_is_left_out() -> None:
    """A log of a motion that the drive has not begun, and one with a gap, have no wrong forces in their first rows."""
    model = rig(mass=110.0)
    t = np.arange(6 * RATE) / RATE
    u = sum(20 * np.sin(2 * np.pi * f * t + k) for k, f in enumerate(np.geomspace(0.3, 6, 5)))
    motion = simulate(rig(), u[:, None])
    log, truth = measure(rig(), motion, seed=1), rig().nominal
    found = estimate_by("joint", model, log)
    assert found.status == "valid"
    assert np.abs((found.value - truth) / found.std).max() < 3.5
    log, truth = log_of(1)
    found = estimate_by("joint", model, log.drop(index=range(1200, 1500)))
    assert found.status == "valid"
    assert np.abs((found.value - truth) / found.std).max() < 3.5


def test_noise_is_that_of_the_command() -> None:
    """Behind the loop its third differences are small, but slow noise is passed on as it is."""
    log, _ = log_of(0)
    ready = prepare(rig(), [log])
    assert ready.logs[0].white_noise("u1") == pytest.approx(1.0, rel=0.1)
    held = log.assign(u_N=log["u_N"].where(np.arange(len(log)) % 2 == 0))
    (slower,) = prepare(rig(), [held]).logs
    assert slower.white_noise("u1") == pytest.approx(1.0, rel=0.2)
    clean = log.assign(u_N=10 * np.sin(2 * np.pi * log["t_s"]))  # a command shows nothing of what its drive adds
    assert prepare(rig(), [clean]).logs[0].white_noise("u1") == 1.0


def test_converted_logs_hold_the_delivered_force(tmp_path: Path) -> None:
    """A column named as the command is would be passed through the loop once more."""
    log, _ = log_of(0)
    log.to_csv(tmp_path / "log.csv", index=False)
    tables, _, _ = convert(rig(), tmp_path / "log.csv")
    assert list(tables[0].columns) == ["t_s", "q_m", "u1 [N]"]


@pytest.mark.parametrize(
    ("sensor", "loop", "message"),
    [
        (1, {}, "give it .s., or dead_time, or both"),
        (1, {"time_constant": {"value": -0.1, "source": "data sheet"}}, "must be >= 0"),
        (0, LOOP, "is for a commanded torque, force or current"),
    ],
)
def test_impossible_loops_are_refused(sensor: int, loop: Any, message: str) -> None:
    table = copy.deepcopy(RIG)
    table["sensor"][sensor]["loop"] = loop
    with pytest.raises(ValueError, match=message):
        Machine.model_validate(table)


def test_a_command_needs_the_noise_of_its_drive() -> None:
    table = copy.deepcopy(RIG)
    del table["sensor"][1]["noise"]
    Machine.model_validate(table)
    table["sensor"][1]["loop"] = LOOP
    with pytest.raises(ValueError, match="noise: is missing beside loop"):
        Machine.model_validate(table)

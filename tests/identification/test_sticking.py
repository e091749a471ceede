"""Joints that stick: simulated exactly, by events, elsewhere than in the program."""

from __future__ import annotations

import numpy as np
import pytest
from support.sticking import TRUTH, sticking_log

from excite.identification import Estimate, identify, needed_sensors
from excite.logs import prepare
from excite.model import Model

truth = np.array(list(TRUTH.values()))
RUNS = 3


@pytest.fixture(scope="module")
def found(emps: Model) -> dict[str, list[Estimate]]:
    """Estimates of some logs by joint smoothing and by least squares on all rows."""
    made: dict[str, list[Estimate]] = {}
    for seed in range(RUNS):
        ready = prepare(emps, [sticking_log(seed, seconds=15.0)], needed_sensors(emps, "joint"))
        for method in ("ols", "joint"):
            made.setdefault(method, []).append(identify(ready.model, ready.logs, method))
    return made


@pytest.mark.slow
def test_intervals_hold_where_friction_sticks(found: dict[str, list[Estimate]]) -> None:
    inside = [(e.interval95[0] <= truth) & (truth <= e.interval95[1]) for e in found["joint"]]
    assert np.mean(inside) > 0.8  # 12 intervals
    assert all(e.status == "valid" for e in found["joint"])


@pytest.mark.slow
def test_rests_bias_nothing(found: dict[str, list[Estimate]]) -> None:
    """Least squares on all rows is off by 0.3 % of Fv and 0.2 % of Fc on these logs."""
    error = 100 * (np.mean([e.value for e in found["joint"]], axis=0) / truth - 1)
    assert np.abs(error[:3]).max() < 0.02


@pytest.mark.slow
def test_joint_smoothing_is_the_most_accurate(found: dict[str, list[Estimate]]) -> None:
    rms = {m: np.sqrt(np.mean([(e.value / truth - 1) ** 2 for e in made], axis=0)) for m, made in found.items()}
    assert (rms["joint"][:3] < rms["ols"][:3]).all()

"""Joints that stick: simulated exactly, by events, elsewhere than in the program."""

from __future__ import annotations

import numpy as np
import pytest
from support.sticking import TRUTH, sticking_log

from excite.identification import Estimate, identify, needed_sensors
from excite.logs import prepare
from excite.model import Model

truth = np.array(list(TRUTH.values()))
RUNS = 5


@pytest.fixture(scope="module")
def found(emps: Model) -> dict[str, list[Estimate]]:
    """Estimates of some logs by every method that states 95 % intervals."""
    made: dict[str, list[Estimate]] = {}
    for seed in range(RUNS):
        ready = prepare(emps, [sticking_log(seed, seconds=15.0)], needed_sensors(emps, "wls"))
        for method in ("wls", "tls", "iv", "joint"):
            made.setdefault(method, []).append(identify(ready.model, ready.logs, method))
    return made


@pytest.mark.slow
@pytest.mark.parametrize("method", ["wls", "tls", "iv", "joint"])
def test_intervals_hold_where_friction_sticks(found: dict[str, list[Estimate]], method: str) -> None:
    inside = [(e.interval95[0] <= truth) & (truth <= e.interval95[1]) for e in found[method]]
    assert np.mean(inside) > 0.85  # 20 intervals: 0.90 is expected to be reached over many
    assert all(e.status == "valid" for e in found[method])
    assert all("friction sticks" in " ".join(e.notes) for e in found[method])


@pytest.mark.slow
def test_rows_near_rest_bias_nothing(found: dict[str, list[Estimate]]) -> None:
    """Least squares on all rows is off by 0.3 % of Fv and 0.2 % of Fc on these logs."""
    for method, most in (("wls", 0.1), ("joint", 0.02)):
        error = 100 * (np.mean([e.value for e in found[method]], axis=0) / truth - 1)
        assert np.abs(error[:3]).max() < most


@pytest.mark.slow
def test_joint_smoothing_is_the_most_accurate(found: dict[str, list[Estimate]]) -> None:
    rms = {m: np.sqrt(np.mean([(e.value / truth - 1) ** 2 for e in made], axis=0)) for m, made in found.items()}
    assert (rms["joint"][:3] < rms["wls"][:3]).all()


def test_smooth_friction_is_not_said_to_stick(emps: Model, emps_data: object) -> None:
    """EMPS itself: rows near rest move its estimate by less than noise does, so the published figures stand."""
    ready = prepare(emps, [emps_data], needed_sensors(emps, "wls"))  # type: ignore[list-item]
    estimate = identify(ready.model, ready.logs, "wls")
    assert estimate.value[0] == pytest.approx(95.109, abs=0.01)
    assert "sticks" not in " ".join(estimate.notes)

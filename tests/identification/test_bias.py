"""The bias that simulated logs predict, against the bias that there is."""

from __future__ import annotations

import numpy as np
import pytest
from support.logs import make_log

from excite.identification import bias, methods
from excite.logs import Log
from excite.model import Model
from excite.simulation import Motion


@pytest.fixture(scope="module")
def logs(straight: Model, straight_motion: Motion) -> list[Log]:
    return [make_log(straight, straight_motion, seed=100 + k) for k in range(24)]


@pytest.mark.slow
def test_the_bias_is_found_from_one_log(straight: Model, logs: list[Log]) -> None:
    """Mean error over 24 logs beside what simulations of one of them say."""
    true = np.mean([methods.identify(straight, [one], "ols").value for one in logs], axis=0) - straight.nominal
    estimate = methods.add_bias(straight, logs[:1], methods.identify(straight, logs[:1], "ols"))
    assert estimate.bias is not None
    assert estimate.bias_std is not None
    for name in ("M", "ZZ1", "ZZ4", "Kx1", "Kx4"):
        k = straight.base.names.index(name)
        assert estimate.bias[k] == pytest.approx(true[k], rel=0.35)
    assert "biased on 8 simulated logs" in estimate.notes[-1]
    assert "ZZ1 +" in estimate.notes[-1]


def test_replay_stays_with_the_log(straight: Model, straight_motion: Motion, logs: list[Log]) -> None:
    """Even with a friction that is twice too large."""
    X = straight.nominal.copy()
    X[straight.base.names.index("Fv1")] *= 2
    motion = bias.simulate_along_log(straight, logs[0], X, straight.machine.filter)
    assert np.sqrt(np.mean((motion.nu - straight_motion.nu) ** 2)) < 0.1
    assert np.sqrt(np.mean(straight_motion.nu**2)) > 0.5


def test_an_impossible_machine_is_replaced_by_the_nearest(straight: Model, logs: list[Log]) -> None:
    estimate = methods.identify(straight, logs[:1], "ols")
    value = estimate.value.copy()
    value[straight.base.names.index("Fv4")] = -50
    method, filter = methods.METHODS["ols"].find, straight.machine.filter
    found = bias.add_bias(straight, logs[:1], estimate, method, filter, value, 2)
    assert found.bias is not None
    assert np.isfinite(found.bias).all()


@pytest.mark.slow
def test_a_grotesque_bias_is_not_hidden(va12: Model, va12_motion: Motion) -> None:
    """Least squares finds 3 % of the mass on this drive; at its own machine the bias would look like 1 %."""
    one = make_log(va12, va12_motion, seed=100)
    estimate = methods.add_bias(va12, [one], methods.identify(va12, [one], "ols"))
    assert estimate.bias is not None
    assert estimate.bias[0] == pytest.approx(estimate.value[0] - va12.nominal[0], rel=0.1)

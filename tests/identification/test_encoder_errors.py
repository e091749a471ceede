"""Least squares on readings without the errors that the machine file says encoders have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.logs import make_log

from excite.identification import identify
from excite.model import build
from excite.model.effects import placing
from excite.model.machine import load_machine
from excite.simulation import simulate

RIG = Path(__file__).parents[1] / "support" / "rig.toml"


@pytest.mark.parametrize("text", ["encoder_scale@carriage=0.03", "encoder_delay@carriage=0.005"])
def test_what_the_file_says_of_an_encoder_is_corrected(text: str) -> None:
    machine = load_machine(str(RIG))
    plain = build(machine)
    model = build(placing.with_effects(machine, placing.parse_effect(text, machine, 10.0)))
    t = np.arange(0, 10, 0.01)
    x = np.clip(np.minimum(t, 10 - t), 0, 1)
    force = (80 * np.sin(2.1 * t) + 50 * np.sin(5.3 * t + 1)) * (3 * x**2 - 2 * x**3)
    misread, exact = (make_log(m, simulate(m, force[:, None]), seed=1, noise=False) for m in (model, plain))
    expected = identify(plain, [exact], "ols").value
    found = identify(model, [misread], "ols")
    uncorrected = identify(plain, [misread], "ols").value
    np.testing.assert_allclose(found.value[: len(expected)], expected, rtol=0.01, atol=0.2)
    assert np.abs(uncorrected - expected).max() > 4 * np.abs(found.value[: len(expected)] - expected).max()
    (reason,) = found.unidentifiable.values()
    assert "machine file's value" in reason

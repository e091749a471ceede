"""Free decays and coast-downs, without any torque, tell what is hidden in them as far as ratios go."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy
import tomli_w
from support.commands import Excite
from support.coupled import Table, quantity
from support.files import SHARED

from excite.errors import NotIdentifiableError
from excite.identification import identify, needed_sensors
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import Machine, load_machine
from excite.simulation import Motion, measure, simulate

EXACT = {"known": True}


def pendulum(**values: float) -> Table:
    """A pendulum in the plane of gravity, of known mass and lever, released from an angle; values of what is hidden."""
    own = {"ZZ": 0.02, "Fv": 0.01, "Fs": 0.02} | values
    body = {
        "index": 1,
        "name": "arm",
        "antecedent": "ground",
        "joint": "revolute",
        "actuated": True,
        "alpha": {"value": "pi/2", "source": "definition"},
        "inertia": {
            "mass": quantity(2.0) | EXACT,
            "com": {"value": [0.1, 0, 0], "source": "measured", "known": True},
            "ZZ": quantity(own["ZZ"]),
        },
        "friction": {
            "Fv": quantity(own["Fv"]),
            "Fs": quantity(own["Fs"]),
            "u0": quantity(0) | EXACT,
            "smoothing": quantity(0.02),
        },
    }
    angle = {"name": "angle", "kind": "angle", "body": 1, "column": "a", "unit": "rad", "noise": quantity(1e-3)}
    torque = {"name": "torque", "kind": "torque", "body": 1, "column": "u", "unit": "N m", "zero_if_absent": True}
    return {
        "name": "pendulum",
        "title": "Pendulum",
        "sampling_hz": quantity(200),
        "body": [body],
        "sensor": [angle, torque | {"noise": quantity(1e-3)}],
        "filter": {"source": "assumed", "cutoff_hz": quantity(20), "decimation": 4},
        "scale": {"u10": quantity(0.02), "MY1": quantity(0.2)},
    }


def released(model: Model) -> Motion:
    return simulate(model, np.zeros((2400, 1)), q0=np.array([-0.5]))


def cart(**values: float) -> Table:
    """A weighed cart on a straight line whose speed alone is measured, in km/h; values of its friction."""
    own = {"Fv": 4.0, "Fs": 6.0} | values
    body = {
        "index": 1,
        "name": "cart",
        "antecedent": "ground",
        "joint": "prismatic",
        "actuated": True,
        "inertia": {"mass": quantity(130.0) | {"known": 1.0}},
        "friction": {
            "Fv": quantity(own["Fv"]),
            "Fs": quantity(own["Fs"]),
            "u0": quantity(0) | EXACT,
            "smoothing": quantity(0.02),
        },
    }
    speed = {"name": "speed", "kind": "angle", "body": 1, "column": "v", "unit": "km/h", "noise": quantity(0.02)}
    force = {"name": "force", "kind": "torque", "body": 1, "column": "f", "unit": "N", "zero_if_absent": True}
    return {
        "name": "cart",
        "title": "Cart",
        "sampling_hz": quantity(20),
        "gravity": [0, 0, 0],
        "body": [body],
        "sensor": [speed, force | {"noise": quantity(1.0)}],
        "filter": {"source": "assumed", "cutoff_hz": quantity(1), "decimation": 4},
        "scale": {"u10": quantity(5.0)},
    }


def rolling_out(model: Model) -> Motion:
    return simulate(model, np.zeros((800, 1)), nu0=np.array([6.0]))


RIGS: dict[str, tuple[Callable[..., Table], dict[str, float], Callable[[Model], Motion]]] = {
    "free decay": (pendulum, {"ZZ": 0.025, "Fv": 0.013, "Fs": 0.014}, released),
    "coast-down": (cart, {"Fv": 6.0, "Fs": 4.0}, rolling_out),
}


@pytest.mark.parametrize("name", RIGS)
def test_a_log_without_torque_tells_what_a_known_value_scales(name: str) -> None:
    table, off, motion = RIGS[name]
    truth, guess = (build(Machine.model_validate(table(**values))) for values in ({}, off))
    log = measure(truth, motion(truth), seed=3)
    log = log.drop(columns=[c for s in truth.machine.sensors("full") if s.kind == "torque" for c in s.columns])
    ready = prepare(guess, [log], needed_sensors(guess, "joint"))
    assert any("its drive is off" in note for note in ready.notes)
    estimate = identify(ready.model, ready.logs, "joint")
    told = np.isfinite(estimate.value)
    z = (estimate.value - truth.nominal)[told] / estimate.std[told]
    assert estimate.status == "valid"
    assert np.abs(z).max() < 3.5


def test_without_a_known_value_it_is_refused() -> None:
    machine: Any = pendulum()
    truth = build(Machine.model_validate(machine))
    log = measure(truth, released(truth), seed=3).drop(columns="u")
    inertia = machine["body"][0]["inertia"]
    del inertia["mass"]["known"], inertia["com"]["known"]
    free = build(Machine.model_validate(machine))
    ready = prepare(free, [log], needed_sensors(free, "joint"))
    with pytest.raises(NotIdentifiableError, match="ratios only"):
        identify(ready.model, ready.logs, "joint")


LIGHT_EV = SHARED / "light_ev" / "drive.csv"


@pytest.mark.skipif(not LIGHT_EV.is_file(), reason=f"the measurements are not here ({LIGHT_EV})")
def test_a_vehicle_known_by_its_motor_controller_tells_ratios() -> None:
    """The raw log agrees with least squares by numpy on it, and what it cannot tell is said: scale, dry friction."""
    model = build(load_machine(Path(__file__).parents[2] / "docs" / "examples" / "light_ev.toml"))
    raw = pd.read_csv(LIGHT_EV, sep=";")
    rate, (b, a) = 20.0, scipy.signal.butter(4, 1.0 / 10.0)
    t = np.arange(0, raw["ms_today"].iloc[-1] / 1e3, 1 / rate)
    columns = ("speed_meters_per_sec", "current_motor")
    v, current = (scipy.signal.filtfilt(b, a, np.interp(t, raw["ms_today"] / 1e3, raw[c])) for c in columns)
    W = np.column_stack([np.gradient(v, 1 / rate), v, np.tanh(v / 0.1), np.ones_like(v)])
    own = np.linalg.lstsq(W, current, rcond=None)[0]
    found = {}
    for method in ("ols", "inverse"):
        ready = prepare(model, [LIGHT_EV], needed_sensors(model, method))
        found[method] = estimate = identify(ready.model, ready.logs, method)
        assert any("divided by that constant" in note for note in estimate.notes)
        low, high = estimate.interval95
        assert (low[2:] < 0).all()  # it only goes one way: dry friction and offset stay open
        assert (high[2:] > 0).all()
    assert found["ols"].value[:2] == pytest.approx(own[:2], rel=0.03)
    apart = found["inverse"].value - found["ols"].value
    assert (np.abs(apart) < 3 * np.hypot(*(e.std_total for e in found.values()))).all()


def test_the_command_reports_a_log_without_torque(excite: Excite, tmp_path: Path) -> None:
    machine, log = tmp_path / "pendulum.toml", tmp_path / "decay.csv"
    machine.write_text(tomli_w.dumps(pendulum()))
    model = build(load_machine(machine))
    measure(model, released(model), seed=3).drop(columns="u").to_csv(log, index=False)
    code, out, _ = excite("identify", machine, log, "--method", "joint", "--out", tmp_path / "found")
    summary = json.loads((tmp_path / "found" / "summary.json").read_text())
    assert (code, summary["status"], summary["relative_error_percent"]) == (0, "valid", None)
    assert "no torque was measured" in " ".join(out.split())

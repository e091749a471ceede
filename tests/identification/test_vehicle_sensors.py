"""Machines with the speed sensors and drives that people have are identified to their hidden truth."""

from __future__ import annotations

import numpy as np
import pytest
from support.coupled import Table, chained_robot, fifth_wheel, gnss, one_pump, table_of, without_sensors

from excite.errors import MachineError
from excite.identification import identify, needed_sensors, unused_sensors
from excite.identification.methods import require_sensors
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import Machine, Tolerances
from excite.simulation import Motion, measure, simulate
from excite.smoothing import cramer_rao
from excite.trajectories import multisine


def with_sensors(machine: Table, more: list[Table]) -> Model:
    """The machine with these sensors in place of its measuring wheels and lateral speed."""
    machine = without_sensors(machine, "wheel", "lateral_speed")
    return build(Machine.model_validate(machine | {"sensor": [*machine["sensor"], *more]}))


def drive(model: Model, seconds: float = 20.0) -> Motion:
    machine = model.machine
    problem = machine.problems[machine.problem or ""]
    duration = problem.duration_s.model_copy(update={"value": seconds})
    sines = multisine(model, problem.model_copy(update={"duration_s": duration}), 0)
    t = np.arange(0, seconds, 1 / float(machine.sampling_hz))
    start = np.zeros(len(model.coordinates))
    start[:3] = 30.0, -20.0, 2.0  # GNSS does not begin at zero
    return simulate(model, np.column_stack([np.interp(t, sines.times, u) for u in sines.torque.T]), q0=start)


CASES = {
    "one pump, GNSS and gyro": lambda: with_sensors(one_pump(1.1), gnss()),
    "one pump, fifth wheel and gyro": lambda: with_sensors(one_pump(1.1), fifth_wheel()),
    "chained wheels": lambda: build(Machine.model_validate(chained_robot(1.0))),
}


@pytest.mark.parametrize("case", [pytest.param(c, marks=[pytest.mark.slow] * (k > 0)) for k, c in enumerate(CASES)])
def test_joint_finds_the_hidden_truth(case: str) -> None:
    made = CASES[case]()
    exact = Tolerances(alignment=0, length=0, radius=0, gain=0, level=0)  # as the bound of Cramer and Rao knows none
    model = build(made.machine.model_copy(update={"tolerance": exact}))
    motion = drive(model)
    ready = prepare(model, [measure(model, motion, seed=5)], needed_sensors(model, "joint"))
    estimate = identify(ready.model, ready.logs, "joint")
    assert (estimate.status, unused_sensors(model, "joint", ready.logs)) == ("valid", ())
    z = (estimate.value - model.nominal) / estimate.std
    assert np.abs(z).max() < 3.5
    assert np.sqrt(np.mean(z**2)) < 1.6
    assert estimate.std / np.sqrt(np.diag(cramer_rao(model, motion))) == pytest.approx(1.15, abs=0.45)


def test_designs_count_speed_over_ground() -> None:
    """Another sensor never makes the attainable accuracy worse, and a slower one is worth less."""
    machine = one_pump(1.1)
    more = [with_sensors(machine, []), *(with_sensors(machine, gnss(hz, 1e-3)) for hz in (1.0, 100.0))]
    motion = drive(more[0], 4.0)
    none, slow, fast = (np.diag(cramer_rao(m, motion)) for m in more)
    assert (slow <= none * (1 + 1e-6)).all()
    assert (fast <= slow * (1 + 1e-6)).all()
    assert (fast < 0.7 * none).any()


def test_readings_at_an_antenna() -> None:
    """A point on the chassis moves by the chassis' own motion: its speed is the rate of its position."""
    model = with_sensors(table_of("va12"), [*gnss(100.0), *fifth_wheel()])
    motion = drive(model, 6.0)
    log = measure(model, motion, noise=False)
    rate = float(model.machine.sampling_hz)
    moved = np.hypot(*(np.gradient(log[f"{k}_m"], 1 / rate) for k in "xy"))
    assert log["sog"].to_numpy()[2:-2] == pytest.approx(moved[2:-2], abs=3e-3)
    assert log["v_kmh"].to_numpy() / 3.6 == pytest.approx(motion.nu[:, 0] - 0.8 * motion.nu[:, 2], abs=1e-9)
    read = measure(model, motion, seed=1)["v_kmh"] / 0.02
    assert np.abs(read - read.round()).max() < 1e-6


def test_what_a_method_does_not_use_is_said() -> None:
    model = with_sensors(table_of("va12"), [*fifth_wheel(), *gnss()[:1]])
    keep = next(s for s in table_of("va12")["sensor"] if s["kind"] == "lateral_speed")
    machine = model.machine.model_dump(mode="json", exclude_none=True)
    model = build(Machine.model_validate(machine | {"sensor": [*machine["sensor"], keep]}))
    ready = prepare(model, [measure(model, drive(model, 10.0), seed=1)], needed_sensors(model, "ols"))
    assert "yaw_rate" in needed_sensors(model, "ols")  # one fifth wheel leaves the yaw rate to the gyro
    estimate = identify(ready.model, ready.logs, "ols")
    assert "ols does not use sog" in estimate.notes
    assert unused_sensors(model, "joint", ready.logs) == ()


def test_a_method_without_a_speed_over_ground_is_refused() -> None:
    model = with_sensors(table_of("va12"), gnss())
    require_sensors(model, "joint")
    with pytest.raises(MachineError, match="ols does not use GNSS, joint does"):
        require_sensors(model, "ols")
    with pytest.raises(MachineError, match="two measuring wheels apart"):
        require_sensors(with_sensors(table_of("va12"), []), "joint")

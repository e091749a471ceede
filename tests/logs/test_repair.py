"""Spikes, drop-outs, late channels, and filters chosen by the log."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.drives import designed
from support.logs import make_log

from excite.errors import LogError
from excite.identification import delays, methods
from excite.logs import Log, log, outliers, repair
from excite.model import Model
from excite.simulation import Motion


@pytest.fixture(scope="module")
def clean(straight: Model, straight_motion: Motion) -> Log:
    return make_log(straight, straight_motion, seed=100)


def changed(one: Log, name: str, values: np.ndarray) -> Log:
    return Log(one.source, one.t, one.values | {name: values})


def test_clean_logs_are_left_alone(
    straight: Model, straight_motion: Motion, va12: Model, va12_motion: Motion, emps: Model, emps_data: Path
) -> None:
    for seed in range(5):
        for model, motion in ((straight, straight_motion), (va12, va12_motion)):
            one = make_log(model, motion, seed=seed, noise=seed > 0)
            found = repair.examine(model.machine, one)
            assert (found.notes, found.spikes, found.dropouts) == ((), {}, {})
            assert all((found.log.values[k] == v).all() for k, v in one.values.items())
    assert repair.examine(emps.machine, log.read_log(emps_data, emps.machine)).notes == ()


@pytest.mark.parametrize(("name", "size"), [("u1", 900.0), ("theta1", 0.05), ("thetal", -0.02)])
def test_spikes_are_repaired_and_named(straight: Model, clean: Log, name: str, size: float) -> None:
    x = clean.values[name].copy()
    x[[700, 2100]] += size
    found = repair.examine(straight.machine, changed(clean, name, x))
    assert found.spikes == {name: (700, 2100)}
    assert "2 spikes" in found.notes[0]
    assert "row 701, 2101" in found.notes[0]
    noise = 120.0 if name == "u1" else 3e-3
    assert np.abs(found.log.values[name] - clean.values[name]).max() < noise


def test_spikes_do_not_reach_the_estimate(straight: Model, clean: Log) -> None:
    x = clean.values["thetal"].copy()
    x[[700, 2100, 3000]] += 0.3
    plain = methods.identify(straight, [clean], "ols")
    mended = methods.identify(straight, [changed(clean, "thetal", x)], "ols")
    hurt = methods.METHODS["ols"].find(straight, [changed(clean, "thetal", x)], straight.machine.filter)
    assert (np.abs(mended.value - plain.value) < 0.2 * plain.std).all()
    assert (np.abs(hurt.value - plain.value) > plain.std).any()
    assert any("3 spikes" in note for note in mended.notes)


def test_too_many_spikes_are_refused(straight: Model, clean: Log) -> None:
    x = clean.values["u4"].copy()
    x[100:3900:40] += 2000
    with pytest.raises(LogError, match=r"u4_Nm: 95 spikes.*too many to repair"):
        repair.examine(straight.machine, changed(clean, "u4", x))


def test_a_step_is_no_spike(straight: Model, clean: Log) -> None:
    x = clean.values["u1"].copy()
    x[2000:] += 3000
    assert repair.examine(straight.machine, changed(clean, "u1", x)).spikes == {}


@pytest.mark.parametrize("frequency", [12.0, 25.0, 100 / 3, 45.0])
def test_vibration_is_no_spike(straight: Model, clean: Log, frequency: float) -> None:
    x = clean.values["u1"].copy()
    x[1000:2000] += 1500 * np.sin(2 * np.pi * frequency * clean.t[1000:2000] + 0.3)
    assert len(repair.examine(straight.machine, changed(clean, "u1", x)).spikes.get("u1", ())) <= 1


def test_dropouts_are_found(straight: Model, straight_motion: Motion, clean: Log) -> None:
    x = clean.values["u1"].copy()
    x[1500:1530] = x[1500]
    found = repair.examine(straight.machine, changed(clean, "u1", x))
    assert found.dropouts == {"u1": ((1500, 1529),)}
    assert "stands still from row 1501 to 1530" in found.notes[0]
    fast = int(np.argmax(np.abs(straight_motion.nu[:, 1])))
    y = clean.values["theta1"].copy()
    y[fast : fast + 30] = y[fast]
    with pytest.raises(LogError, match=r"theta1_rad: 1 drop-out.*two logs"):
        repair.examine(straight.machine, changed(clean, "theta1", y))


def test_a_jump_after_standing_still_is_a_dropout(straight: Model, straight_motion: Motion, clean: Log) -> None:
    """A reading that freezes while the joint is slow, and is where the joint has gone to when it thaws."""
    speed = np.abs(straight_motion.nu[:, 1])
    slow = next(k for k in range(400, len(speed) - 600) if speed[k] < 0.03 and speed[k : k + 200].max() > 0.3)
    y = clean.values["theta1"].copy()
    y[slow : slow + 100] = y[slow]
    with pytest.raises(LogError, match=rf"theta1_rad: 1 drop-out.*row {slow + 1} to {slow + 100} "):
        repair.examine(straight.machine, changed(clean, "theta1", y))


@pytest.mark.parametrize(("name", "column"), [("u1", "u1_Nm"), ("theta1", "theta1_rad"), ("thetal", "thetal_rad")])
def test_a_channel_that_dies_is_told_from_then_on(
    straight: Model, straight_motion: Motion, clean: Log, name: str, column: str
) -> None:
    """While the machine moves on for more than half of the log. One that stands still with the machine is none."""
    dies = 1000 + int(np.argmax(np.abs(straight_motion.nu[1000:1500, 1])))
    x = clean.values[name].copy()
    x[dies:] = x[dies]
    with pytest.raises(LogError, match=rf"{column}: 1 drop-out.* row {dies + 1} to {len(x)} .*; cut the log there"):
        repair.examine(straight.machine, changed(clean, name, x))
    coasts, rests = np.cumsum(0.98 ** np.arange(800)), dict(clean.values)
    for sensor in straight.machine.sensors("full"):
        own, step = clean.values[sensor.name], sensor.resolution
        if step is not None:
            rests[sensor.name] = np.append(own, own[-1] + step * np.round((own[-1] - own[-11]) / 10 * coasts / step))
        else:
            rests[sensor.name] = np.append(own, own[-1] + np.random.default_rng(0).normal(0, 40, 800))
    assert repair.examine(straight.machine, Log("rests", np.arange(len(x) + 800) / 100, rests)).dropouts == {}


def test_what_stands_exactly_still_is_no_dropout(straight: Model, clean: Log) -> None:
    """A torque that is zero at rest, one that is commanded in steps, an axis that stops from one row to the next."""
    zero, steps = clean.values["u1"].copy(), np.repeat(np.arange(10.0) * 100 - 333, 401)[: len(clean)]
    zero[:1000] = zero[-1000:] = 0.0
    step = next(s.resolution for s in straight.machine.sensors("full") if s.name == "theta1")
    ramp = step * np.round(np.clip(np.arange(len(clean)) - 1500, 0, 200) * 9.3)
    for name, x in (("u1", zero), ("u1", steps), ("theta1", ramp)):
        assert outliers.find_dropouts(next(s for s in straight.machine.sensor if s.name == name), x) == (), name


def test_late_channels_are_found_to_a_millisecond(straight: Model, clean: Log) -> None:
    """No alarm on a clean log; 30 ms on one channel is 30 ms on that one, and none on the other."""
    assert delays.describe_late_channels(straight, clean) == ()
    late = np.concatenate([np.full(3, clean.values["u1"][0]), clean.values["u1"][:-3]])
    first, other = delays.estimate_delays(straight, changed(clean, "u1", late))
    assert first.name == "u1"
    assert first.value == pytest.approx(0.030, abs=0.002)
    assert first.significant
    assert abs(other.value) < 0.002
    assert not other.significant
    (note,) = delays.describe_late_channels(straight, changed(clean, "u1", late))
    assert "ms (+-" in note
    assert "late" in note


def test_early_channels_of_the_whole_machine(va12: Model, va12_motion: Motion) -> None:
    one = make_log(va12, va12_motion, seed=3)
    early = np.concatenate([one.values["u2"][4:], np.full(4, one.values["u2"][-1])])
    found = {d.name: d for d in delays.estimate_delays(va12, changed(one, "u2", early))}
    assert found["u2"].value == pytest.approx(-0.040, abs=0.003)
    assert not found["u1"].significant
    assert not found["u4"].significant


@pytest.mark.slow
def test_noise_of_slips_is_no_delay(va12: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Along R60 slips are small: what their noise leaves in the rows seems 10 ms early, in every log. It hides a part
    of 80 ms that a channel is late. How sure the 10 ms look differs from design to design, hence the lower limit."""
    one = make_log(va12, designed("R60", va12), seed=3)
    found = delays.estimate_delays(va12, one)
    assert all(d.value < -5e-3 for d in found)
    monkeypatch.setattr(delays, "SIGNIFICANT_DELAY", 3.0)
    assert any(d.significant for d in found)
    for X in (va12.nominal, None):
        assert delays.describe_late_channels(va12, one, X=X) == ()
    late = np.concatenate([np.full(8, one.values["u1"][0]), one.values["u1"][:-8]])
    (note,) = delays.describe_late_channels(va12, changed(one, "u1", late), X=va12.nominal)
    told = re.search(r"u1 is late against the motion, by ([0-9.]+) ms .* as far as noise tells", note)
    assert told is not None
    assert 40 < float(told[1]) < 85

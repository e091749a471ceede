"""Cells as loggers mean them: the keys of a machine file that say so, and the numbers that they give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from excite.errors import LogError
from excite.logs import prepare
from excite.model import Model, build
from excite.model.machine import Machine, load_machine

N = 1000
T = np.arange(N) / 100
POSITION = 0.1 * np.sin(2 * T)
FORCE = 60 * np.cos(2 * T)
RIG = Path(__file__).parents[1] / "support" / "rig.toml"


def rig(sensor: dict[str, object] | None = None, **keys: object) -> Model:
    """The rig with keys of a machine file, some at its force sensor."""
    table = load_machine(RIG).model_dump() | keys
    table["sensor"] = [s | (sensor or {}) if s["kind"] == "torque" else s for s in table["sensor"]]
    return build(Machine.model_validate(table))


def table(
    model: Model, position: object = POSITION, force: object = FORCE, t: np.ndarray = T, **more: object
) -> pd.DataFrame:
    machine = model.machine
    columns = {s.kind: s.column for s in machine.sensor}
    return pd.DataFrame({machine.time_column: t, columns["angle"]: position, columns["torque"]: force, **more})


def read(model: Model, log: pd.DataFrame) -> tuple[dict[str, np.ndarray], str]:
    """Positions, forces and times by kind of the sensor, and the notes."""
    ready = prepare(model, [log])
    (one,) = ready.logs
    return {s.kind: one.values[s.name] for s in model.machine.sensor} | {"t": one.t}, " ".join(ready.notes)


def test_a_blank_cell_may_mean_no_change() -> None:
    steps = np.round(FORCE / 10) * 10  # of 2 s and more
    blank = np.where(np.append(False, np.diff(steps) == 0), np.nan, steps)
    silent, told = rig(), rig(blank_means="unchanged")
    with pytest.raises(LogError, match=r'blank in \d+ % of the rows; .* write blank_means = "unchanged"'):
        read(silent, table(silent, force=np.where(T % 1 < 0.5, FORCE, np.nan)))
    values, notes = read(told, table(told, force=blank))
    assert values["torque"] == pytest.approx(steps)
    assert "hold the value before" in notes


def test_a_few_blank_cells_are_named_with_what_to_do() -> None:
    few = np.where(np.arange(N) % 50 == 7, np.nan, FORCE)
    _, notes = read(rig(), table(rig(), force=few))
    column = next(s.column for s in rig().machine.sensor if s.kind == "torque")
    assert f"interpolated ({int(np.isnan(few).sum())} in {column}); if the logger writes" in notes
    assert 'write blank_means = "unchanged"' in notes


def test_channels_with_times_of_their_own_have_no_cells_to_fill() -> None:
    """As in CAN logs and files with a clock per channel: every other row has one of the two."""
    other = np.arange(N) % 2 == 1
    _, notes = read(rig(), table(rig(), np.where(other, np.nan, POSITION), np.where(other, FORCE, np.nan)))
    assert "channels with times of their own" in notes
    assert "blank_means" not in notes


@pytest.mark.parametrize("on", [np.ones(N), ["true"] * N, [True] * N, ["enabled"] * N])
def test_rows_that_are_not_enabled_are_left_out(on: object) -> None:
    model = rig(enabled_column="drive_on")
    enabled = pd.Series(on, dtype=object)
    enabled[:300] = {float: 0.0, str: "false", bool: False}[type(enabled[500])]
    values, notes = read(model, table(model, force=np.where(T < 3, 1e4, FORCE), drive_on=enabled))
    assert values["torque"] == pytest.approx(FORCE[300:])
    assert "300 rows are not enabled (drive_on)" in notes


def test_an_enabled_column_that_is_missing_is_said() -> None:
    model = rig(enabled_column="drive_on")
    with pytest.raises(LogError, match="no column drive_on, which the machine file names as enabled_column"):
        read(model, table(model))


@pytest.mark.parametrize("word", ["falsch", "Switched on", "aus"])
def test_an_enabled_column_with_other_words_is_refused(word: str) -> None:
    model = rig(enabled_column="drive_on")
    with pytest.raises(LogError, match=f"'{word}' says neither on nor off"):
        read(model, table(model, drive_on=[word] * 300 + ["true"] * (N - 300)))


def test_a_register_of_sign_and_magnitude() -> None:
    """As servos give their load: ten bits of it, the eleventh is the sign."""
    model = rig({"sign_bit": 10})
    register = np.where(np.round(FORCE) < 0, 1024 - np.round(FORCE), np.round(FORCE))
    values, _ = read(model, table(model, force=register.astype(int)))
    assert values["torque"] == pytest.approx(np.round(FORCE))
    with pytest.raises(LogError, match="4000 has bits above its sign_bit 10"):
        read(model, table(model, force=np.where(T == 5, 4000, register)))
    with pytest.raises(LogError, match="is negative, but a register with a sign_bit is not"):
        read(model, table(model, force=register.astype(np.int16) - 2000))


def test_stamps_of_arrival_are_taken_for_an_even_clock() -> None:
    late = np.random.default_rng(0).exponential(0.003, N)
    arrival = np.maximum.accumulate(T + late) + 1e-9 * np.arange(N)
    model = rig(stamps="arrival")
    values, notes = read(model, table(model, t=arrival))
    assert values["angle"] == pytest.approx(POSITION, abs=1e-12)  # as they were sampled, not interpolated
    assert np.diff(values["t"]) == pytest.approx(0.01, rel=1e-2)
    assert "stamps of arrival" in notes


def test_stamps_of_arrival_with_lost_rows_are_refused() -> None:
    model = rig(stamps="arrival")
    kept = (T < 4) | (T > 6)
    with pytest.raises(LogError, match=r"leave an even clock by .* rows are lost"):
        read(model, table(model, POSITION[kept], FORCE[kept], T[kept]))

"""Rows at their own times: even ones stay as they are, others are brought onto a grid."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from excite.errors import LogError
from excite.logs import from_table, prepare
from excite.logs.resampling import held_every
from excite.logs.time_axis import order_rows
from excite.logs.times import seconds
from excite.model import Model
from excite.simulation import Motion, measure


@pytest.fixture(scope="module")
def table(straight: Model, straight_motion: Motion) -> pd.DataFrame:
    return measure(straight, straight_motion, seed=1)


def test_even_rows_stay_as_they_are(straight: Model, table: pd.DataFrame) -> None:
    """To the last bit, whatever the rate; the model's own rate is the log's."""
    ready = prepare(straight, [table])
    plain = from_table(table, straight.machine)
    assert ready.model is straight
    assert ready.notes == []
    for name, values in plain.values.items():
        np.testing.assert_array_equal(ready.logs[0].values[name], values)
    slow = prepare(straight, [table.assign(t_s=table["t_s"] * 1.25)])
    assert float(slow.model.machine.sampling_hz) == pytest.approx(80)
    np.testing.assert_array_equal(slow.logs[0].values["u1"], plain.values["u1"])


@pytest.mark.parametrize("form", ["iso", "clock", "ns", "words"])
def test_times_are_read_in_any_notation(form: str, straight: Model, table: pd.DataFrame) -> None:
    when = pd.Timestamp("2026-11-22T23:59:50") + pd.to_timedelta((table["t_s"] * 100).round().astype(int) * 10, "ms")
    written = {
        "iso": [w.isoformat() for w in when],
        "clock": [w.strftime("%H:%M:%S:%f")[:-3] for w in when],
        "ns": when.astype("datetime64[ns]"),
        "words": [f"{t:.2f} sec" for t in table["t_s"]],
    }[form]
    ready = prepare(straight, [table.assign(t_s=written)])
    assert ready.model is straight
    assert len(ready.logs[0]) == len(table)


def test_a_full_cell_is_quoted(straight: Model, table: pd.DataFrame) -> None:
    cells = [f"{t:.2f} sec" for t in table["t_s"]]
    cells[7] = "later"
    with pytest.raises(LogError, match=r"row 8, column t_s: is 'later', which is not understood as a time"):
        seconds(table.assign(t_s=cells), straight.machine, "log")


def test_what_order_can_not_be_known_is_refused(table: pd.DataFrame) -> None:
    rng = np.random.default_rng(0)
    t = rng.permutation(rng.uniform(0, 40, len(table)))
    with pytest.raises(LogError, match="no order of the rows is even"):
        order_rows(t, table, "t_s", "log")


def test_shuffled_rows_are_sorted(straight: Model, table: pd.DataFrame) -> None:
    order = np.arange(len(table))
    order[100:110] = order[100:110][::-1]
    ready = prepare(straight, [table.iloc[order]])
    np.testing.assert_array_equal(ready.logs[0].values["u1"], from_table(table, straight.machine).values["u1"])


def test_interpolation_keeps_noise_and_angles(straight: Model, straight_motion: Motion) -> None:
    """Jitter of a fifth of a step: angles to a count, torque noise to a tenth of its size."""
    rng = np.random.default_rng(0)
    table = measure(straight, straight_motion, seed=2)
    exact = measure(straight, straight_motion, noise=False)
    t = table["t_s"].to_numpy()
    own = t + rng.uniform(-0.002, 0.002, len(t))
    own[[0, -1]] = t[[0, -1]]
    moved = {c: np.interp(own, t, exact[c]) + (table[c] - exact[c]) for c in table if c != "t_s"}
    one = prepare(straight, [pd.DataFrame({"t_s": own, **moved})]).logs[0]
    true = from_table(exact, straight.machine).values
    n = min(len(one), len(t)) - 10
    assert np.std((one.values["u1"] - true["u1"])[10:n]) == pytest.approx(40, rel=0.1)
    assert np.abs(one.values["theta1"] - true["theta1"])[10:n].max() < 2 * 2 * np.pi / 8192 + 1e-4


@pytest.mark.parametrize("every", [1, 2, 5])
def test_held_rows_are_told(every: int) -> None:
    x = np.random.default_rng(0).normal(size=400)
    assert held_every(np.repeat(x, every)) == every

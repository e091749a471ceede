"""Clocks that disagree, begin anew, wrap, drift or are rounded; channels too slow; dates and units that contradict."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

from excite.errors import LogError
from excite.identification import identify
from excite.logs import inspect, prepare, read_table
from excite.logs.clocks import is_clock
from excite.logs.files.common import merged
from excite.model import Model, prediction
from excite.model.machine import Machine
from excite.simulation import measure, simulate

T_END_S = 4.0
NEEDS = ("q1", "u1")


@pytest.fixture(scope="module")
def table(emps: Model) -> pd.DataFrame:
    t = np.arange(round(1000 * T_END_S) + 1) / 1000
    force = 60 * np.sin(2 * np.pi * 1.1 * t) + 40 * np.sin(2 * np.pi * 2.7 * t)
    return measure(emps, simulate(emps, force[:, None]), seed=1)


def sampled(table: pd.DataFrame, rate: float) -> pd.DataFrame:
    """The log of even rows at another rate."""
    t = np.arange(round(T_END_S * rate)) / rate
    return pd.DataFrame({"t": t, **{c: np.interp(t, table["t"], table[c]) for c in ("qm", "vir")}})


def with_clock(model: Model, clock: str, unit: str | None = None) -> Model:
    """The machine whose torque was recorded by a logger with a clock of its own."""
    changed = {"time_column": clock, "time_unit": unit}
    own = tuple(s.model_copy(update=changed) if s.name == "u1" else s for s in model.machine.sensor)
    return prediction.build(model.machine.model_copy(update={"sensor": own}))


def faults(table: pd.DataFrame, machine: Machine) -> str:
    return " ".join(inspect(table, machine).faults)


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e9], ids=["s", "ms", "ns"])
def test_a_second_clock_that_drifts_makes_an_estimate_doubtful(emps: Model, table: pd.DataFrame, unit: float) -> None:
    ready = prepare(emps, [table.assign(timestamp=1.01 * unit * table["t"])], NEEDS)
    words = "column timestamp: a second clock, whose lead over column t changes by 0.039"
    assert any(words in note for note in ready.notes)
    estimate = identify(ready.model, ready.logs)
    assert estimate.status == "doubtful"
    assert words in estimate.doubt


@pytest.mark.parametrize(
    "clock",
    [
        lambda t: t + 1000,
        lambda t: np.floor(t * 20) / 20,
        lambda t: np.round(1e3 * t),
        lambda t: np.round(1e3 * t) % 1000,
        lambda t: (pd.Timestamp("2026-11-22") + pd.to_timedelta(t, unit="s")).dt.strftime("%Y-%m-%dT%H:%M:%S.%f"),
    ],
    ids=["another origin", "coarse", "ms", "ms of a second", "dates"],
)
def test_a_second_clock_that_agrees_is_no_doubt(
    emps: Model, table: pd.DataFrame, clock: Callable[[pd.Series], pd.Series]
) -> None:
    assert prepare(emps, [table.assign(timestamp=clock(table["t"]))], NEEDS).logs[0].doubts == ()


def test_a_second_clock_between_channels_that_is_shifted_is_a_doubt(emps: Model, table: pd.DataFrame) -> None:
    """The channels to its right may be of another logger."""
    both = table[["t", "qm"]].assign(timestamp=table["t"] + 0.005, vir=table["vir"])
    words = "column timestamp: a second clock, 0.005 s ahead of column t"
    assert any(words in line for line in inspect(both, emps.machine).doubts)
    assert any(words in line for line in prepare(emps, [both], NEEDS).logs[0].doubts)
    before = table[["t"]].assign(timestamp=table["t"] + 0.005, qm=table["qm"], vir=table["vir"])
    assert prepare(emps, [before], NEEDS).logs[0].doubts == ()


def anew(table: pd.DataFrame) -> np.ndarray:
    """Times that begin anew in row 2001."""
    t = table["t"].to_numpy().copy()
    t[2000:] -= t[2000]
    return t


def test_a_second_clock_that_begins_anew_is_a_doubt(emps: Model, table: pd.DataFrame) -> None:
    for other in (table, table.assign(t=table["t"] + 5).iloc[:1500]):  # also where the machine's does so somewhere
        logs = prepare(emps, [pd.concat([table.assign(time=anew(table)), other.assign(time=other["t"])])], NEEDS).logs
        assert "column time: a second clock, whose lead over column t changes by 2 s in" in logs[0].doubts[0]


def test_a_clock_of_one_logger_that_begins_anew_is_refused(emps: Model, table: pd.DataFrame, tmp_path: Path) -> None:
    table[["t", "qm"]].to_csv(tmp_path / "q.csv", index=False)
    table[["vir"]].assign(t=anew(table)).to_csv(tmp_path / "u.csv", index=False)
    with pytest.raises(LogError, match=r"u\.csv: row 2001, column t: time begins anew"):
        prepare(emps, [tmp_path / "q.csv", tmp_path / "u.csv"], NEEDS)
    own, both = with_clock(emps, "t2"), table.assign(t2=anew(table))
    with pytest.raises(LogError, match="row 2001, column t2: time begins anew"):
        prepare(own, [both], NEEDS)
    assert "row 2001, column t2: time begins anew" in faults(both, own.machine)


def test_a_clock_in_another_unit_than_the_others_is_refused(emps: Model, table: pd.DataFrame) -> None:
    own, both = with_clock(emps, "t2"), table.assign(t2=1e3 * table["t"])
    with pytest.raises(LogError, match="column t2: lasts 4000 s, 1000 times as long as column t"):
        prepare(own, [both], NEEDS)
    assert "column t2: lasts 4000 s" in faults(both, own.machine)
    (one,) = prepare(with_clock(emps, "t2", "ms"), [both], NEEDS).logs
    assert len(one) == len(table)


def test_the_log_check_uses_a_sensors_own_clock(emps: Model, table: pd.DataFrame) -> None:
    own, both = with_clock(emps, "t2"), table.assign(t2=table["t"] + 0.5)
    found = inspect(both, own.machine)
    (_, one, _), (used,) = found.used[0], prepare(own, [both], NEEDS).logs
    assert found.usable
    assert (len(one), len(used)) == (len(table) - 500, len(table) - 500)
    assert not any("not used" in line for line in found.remarks)


def test_one_clock_that_is_not_the_machines_is_used(emps: Model, table: pd.DataFrame) -> None:
    """Also where all sensors share it and a column of the machine's time is there too."""
    own = tuple(s.model_copy(update={"time_column": "t2"}) for s in emps.machine.sensor)
    model = prediction.build(emps.machine.model_copy(update={"sensor": own}))
    (one,) = prepare(model, [table.assign(t2=1.25 * table["t"])], NEEDS).logs
    assert one.t[-1] == pytest.approx(1.25 * T_END_S)


def test_a_temperature_that_rises_is_no_clock(table: pd.DataFrame, emps: Model) -> None:
    warm = pd.Series(20 + 0.001 * np.arange(100) + 1e-4 * np.sin(np.arange(100)))
    even, ticks = pd.Series(np.arange(100) / 100), pd.Series(np.arange(100) // 3)
    for name in ("T_motor", "T_oil", "oil T", "T1", "t_oil", "Temp", "torque"):
        assert not is_clock(name, warm), name
    for name in ("t", "t_s", "T_ms", "time", "GPS time", "logger_timestamp", "t [s]", "UTC clock"):
        assert is_clock(name, even), name
    assert is_clock("t_front", even)
    assert not is_clock("T_motor", even)
    assert not is_clock("t_oil", even, "degC")
    assert is_clock("T_motor", even, "s")
    assert not is_clock("time", ticks)
    heated = table.rename(columns={"t": "t_s"})
    heated.insert(2, "T_motor", 0.001 * np.arange(len(table)))
    with pytest.raises(LogError, match="no column t "):
        prepare(emps, [heated], NEEDS)


@pytest.mark.parametrize("rate", [800.0, 300.0, 700.0])
def test_rounded_times_are_those_of_an_even_clock(emps: Model, table: pd.DataFrame, rate: float) -> None:
    log = sampled(table, rate)
    log["t"] = np.round(log["t"], 3)
    ready = prepare(emps, [log], NEEDS)
    assert float(ready.model.machine.sampling_hz) == pytest.approx(rate, rel=1e-5)
    assert not ready.logs[0].interpolated
    np.testing.assert_array_equal(ready.logs[0].values["q1"], log["qm"])
    note = f"times are rounded to 1 ms: an even clock of {rate:g} Hz explains all of them and is used"
    assert [line for line in ready.notes if "encoder that slipped" not in line] == [f"log: {note}"]
    assert note in inspect(log, emps.machine).remarks


def test_rounded_times_with_lost_rows_and_a_gap(emps: Model, table: pd.DataFrame) -> None:
    log = sampled(table, 300)
    log["t"] = np.round(log["t"], 3)
    log = log.drop(index=[100, 350, 351, 900]).reset_index(drop=True)
    log.loc[500:, "t"] += 5
    ready = prepare(emps, [log], NEEDS)
    assert any("an even clock of 300 Hz" in line for line in ready.notes)
    assert any("rows are lost in 3 places" in line for line in ready.notes)


def test_every_fifth_row_lost_is_not_rounding(emps: Model, table: pd.DataFrame) -> None:
    """The stamps are those of 800 Hz rounded; the positions tell."""
    holed = table[table.index % 5 != 4].reset_index(drop=True)
    ready = prepare(emps, [holed], NEEDS)
    assert ready.notes == ["log: rows are lost in 800 places, interpolated"]
    assert float(ready.model.machine.sampling_hz) == 1000


def test_steps_that_drift_are_not_even(emps: Model, table: pd.DataFrame) -> None:
    t = np.cumsum(np.linspace(0.985, 1.015, len(table))) / 1000
    truth = np.interp(t, table["t"], table["qm"])
    (one,) = (ready := prepare(emps, [table.assign(t=t, qm=truth)], NEEDS)).logs
    assert any("and the steps drift" in note for note in ready.notes)
    wrong = np.abs(one.values["q1"] - np.interp(t[0] + one.t, table["t"], table["qm"])).max()
    assert wrong < 0.02 * np.ptp(truth) / 10


@pytest.mark.parametrize(
    ("period", "unit", "said"),
    [
        (1.0, "s", "1 s"),
        (60.0, "s", "60 s"),
        (2**16 * 1e-3, "s", "65.536 s"),
        (2**16 * 1e-3, "ms", "65.536 s"),
        (2**16 * 1e-6, "us", "0.065536 s"),
        (2**32 * 1e-6, "us", "4294.97 s"),
    ],
)
def test_a_clock_that_wraps_is_read_on(emps: Model, table: pd.DataFrame, period: float, unit: str, said: str) -> None:
    one = {"s": 1.0, "ms": 1e-3, "us": 1e-6}[unit]
    model = prediction.build(emps.machine.model_copy(update={"time_unit": unit}))
    wrapped = table.assign(t=((table["t"] - 1.3) % period) / one)
    ready = prepare(model, [wrapped], NEEDS)
    assert [len(log) for log in ready.logs] == [len(table)]
    assert any(f"the clock begins anew every {said}, read on" in note for note in ready.notes)


def test_logs_one_after_the_other_are_no_clock_that_wraps(emps: Model, table: pd.DataFrame) -> None:
    one = table.iloc[:1000]
    other = one.assign(qm=table["qm"].to_numpy()[2500:3500])
    ready = prepare(emps, [pd.concat([one, other], ignore_index=True)], NEEDS)
    assert len(ready.logs) == 2


@pytest.mark.parametrize("held", [False, True])
def test_a_channel_too_slow_for_the_filter(emps: Model, table: pd.DataFrame, held: bool) -> None:
    def slower(every: int) -> pd.DataFrame:
        slow = table["vir"].where(table.index % every == 0)
        return table.assign(vir=slow.ffill() if held else slow)

    with pytest.raises(LogError, match=r"column vir: sampled at 50 Hz, and the filter's .* needs more than 200 Hz"):
        prepare(emps, [slower(20)], NEEDS)
    assert "column vir: sampled at 50 Hz" in faults(slower(20), emps.machine)
    ready = prepare(emps, [slower(4)], NEEDS)
    words = "column vir: sampled at 250 Hz, and the filter's cutoff_hz = 100 needs more than 1000 Hz"
    assert any(words in note for note in ready.notes)
    assert any(words in line for line in ready.logs[0].doubts)
    assert any(words in line for line in inspect(slower(4), emps.machine).doubts)


@pytest.fixture(scope="module")
def short(table: pd.DataFrame) -> pd.DataFrame:
    return table.iloc[1500:2500].reset_index(drop=True)


def dated(table: pd.DataFrame, form: str, start: str = "2026-11-12 23:59:58") -> pd.Series:
    return (pd.Timestamp(start) + pd.to_timedelta(table["t"], unit="s")).dt.strftime(form)


def test_day_and_month_swapped_in_some_dates_are_refused(emps: Model, short: pd.DataFrame) -> None:
    right, wrong = dated(short, "%Y-%m-%d %H:%M:%S.%f"), dated(short, "%Y-%d-%m %H:%M:%S.%f")
    swapped = right.where(right.str.contains("-13 "), wrong)
    words = "row 501, column t: the date goes from 2026-12-11 to 2026-11-13: are day and month swapped"
    for times in (swapped, pd.to_datetime(swapped)):
        with pytest.raises(LogError, match=words):
            prepare(emps, [short.assign(t=times)], NEEDS)
        assert words in faults(short.assign(t=times), emps.machine)
    later = dated(short, "%d/%m/%Y %H:%M:%S.%f"), dated(short, "%m/%d/%Y %H:%M:%S.%f")
    with pytest.raises(LogError, match=r"rows 501 and 502, column t: dates with the day first and with the month"):
        prepare(emps, [short.assign(t=later[0].where(short.index % 2 == 0, later[1]))], NEEDS)


def test_durations_of_more_than_a_day_are_no_dates(emps: Model, table: pd.DataFrame) -> None:
    times = pd.to_timedelta(table["t"], unit="s").astype(str)
    times[2500:] = times[2500:].str.replace("0 days", "2 days")
    (one,) = prepare(emps, [table.assign(t=times)], NEEDS).logs
    assert len(one) == 2500


@pytest.mark.parametrize("form", ["%d/%m/%Y", "%m/%d/%Y", "%d-%m-%y", "%d.%m.%Y"])
@pytest.mark.parametrize("start", ["2026-11-12 23:59:58", "2026-04-03 23:59:58"])
def test_all_dates_have_the_day_in_one_place(emps: Model, short: pd.DataFrame, form: str, start: str) -> None:
    ready = prepare(emps, [short.assign(t=dated(short, f"{form} %H:%M:%S.%f", start))], NEEDS)
    assert [len(one) for one in ready.logs] == [len(short)]


def test_rows_before_the_first_of_data_are_named(emps: Model, table: pd.DataFrame, tmp_path: Path) -> None:
    lines = table.to_csv(index=False).split("\n")
    invalid = [f"{line.partition(',')[0]},invalid,invalid" for line in lines[1:6]]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([lines[0], *invalid, *lines[6:]]))
    assert read_table(path).attrs["notes"] == ["lines 2 to 6: no row of data yet, left out"]
    late = table.assign(vir=table["vir"].where(table.index > 20))
    assert any("not all channels last as long: used are 3.979 of 4 s" in n for n in prepare(emps, [late], NEEDS).notes)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("qm [mm]", "the file says mm in column qm, the machine file m"),
        ("qm (cm)", "the file says cm in column qm, the machine file m"),
        ("qm [furlong]", "the file says furlong in column qm, which is not a known unit, the machine file m"),
        ("vir [mV]", "the file says mV in column vir, the machine file V: which is right?"),
        ("vir (kV)", "the file says kV in column vir, the machine file V: which is right?"),
        ("qm [meter]", ""),
        ("qm (filtered)", ""),
        ("vir [V]", ""),
        ("t [sec]", ""),
        ("vir [-]", ""),
    ],
)
def test_units_in_the_header_are_compared(
    emps: Model, table: pd.DataFrame, name: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    table.rename(columns={name.partition(" ")[0]: name}).to_csv(path, index=False)
    (one,) = prepare(emps, [path], NEEDS).logs
    assert any(said in line for line in one.doubts) if said else one.doubts == ()


def test_a_contradiction_is_shown_by_identify(excite: Excite, table: pd.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    table.rename(columns={"vir": "vir [mV]"}).to_csv(path, index=False)
    code, out, err = excite("identify", "emps", path, "--out", tmp_path / "out")
    assert code == 0
    assert "95 % intervals do not hold" in out
    assert "the file says mV in column vir" in " ".join((out + err).split())


def test_samples_of_a_group_whose_clock_begins_anew_are_not_mixed(tmp_path: Path) -> None:
    """Messages that are a little late are put in order."""
    t, x = np.array([0.0, 0.01, 0.02, 0.015, 0.03]), np.arange(5.0)
    other = np.arange(7) / 200, {"b": np.arange(7.0)}
    late = merged(tmp_path / "log.mf4", [(t, {"a": x}), other])
    assert late["a"].dropna().tolist() == [0, 1, 3, 2, 4]
    with pytest.raises(
        LogError, match=r"log\.mf4: the times of a go back by 5 s after sample 5: its clock begins anew"
    ):
        merged(tmp_path / "log.mf4", [(np.arange(10) % 5 * 1.25, {"a": np.arange(10.0)}), other])


@pytest.mark.parametrize("first", [0, 300], ids=["whole", "part of a tick"])
@pytest.mark.parametrize("rate", [1000.0, 970.0])
def test_rows_of_a_clock_in_whole_seconds_are_as_far_apart_as_its_ticks_say(
    emps: Model, table: pd.DataFrame, first: int, rate: float
) -> None:
    """The first and the last tick hold part of their rows; the machine file's rate counts if the ticks allow it."""
    one = sampled(table, rate).iloc[first:]
    ready = prepare(emps, [one.assign(t=np.floor(one["t"]))], NEEDS)
    own = float(ready.model.machine.sampling_hz)
    assert own == rate if rate == 1000 else abs(own / rate - 1) < 1 / (3 * rate)
    assert any("which the ticks allow" in note for note in ready.notes) == (rate == 1000)

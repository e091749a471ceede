"""`excite log check`: everything that is wrong with a log at once, and nothing that is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

from excite.errors import LogError
from excite.logs import inspection, log, refusal, tables
from excite.model import Model
from excite.model.machine import Machine, Quantity
from excite.simulation import Motion, sensors


@pytest.fixture(scope="module")
def table(va12: Model, va12_motion: Motion) -> pd.DataFrame:
    return sensors.measure(va12, va12_motion, seed=2)


def test_a_good_log_has_nothing_wrong(
    va12: Model, straight: Model, table: pd.DataFrame, straight_motion: Motion
) -> None:
    found = inspection.inspect(table, va12.machine)
    assert found.faults == ()
    assert found.doubts == ()
    assert found.remarks == ()
    assert (found.rows, found.duration_s, found.rate_hz) == (6001, 60, pytest.approx(100))
    by_name = {c.name: c for c in found.columns}
    assert by_name["u1_Nm"].what == "torque of front roll"
    assert by_name["u1_Nm"].high == table["u1_Nm"].max()
    assert len(found.signals) == len(va12.machine.sensors("full"))
    assert inspection.inspect(sensors.measure(straight, straight_motion), straight.machine).usable


def edit(name: str, row: int, value: object) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def change(table: pd.DataFrame) -> pd.DataFrame:
        column = table[name].astype(object)
        column.iloc[row] = value
        return table.assign(**{name: column})

    return change


@pytest.mark.parametrize(
    ("change", "faults", "remarks"),
    [
        (edit("u1_Nm", 40, None), [], ["1 empty cell, interpolated"]),
        (edit("u1_Nm", 40, "error"), ["row 41, column u1_Nm: is 'error', not a finite number"], []),
        (lambda t: t.drop(columns="u4_Nm"), ["no column u4_Nm (torque of rear roll); no method does without it"], []),
        (
            lambda t: t.rename(columns={"theta4_rad": "theta_4"}),
            ['theta4_rad (angle of rear roll): is theta_4 this column? rename it, or write column = "theta_4" in'],
            ["not used: theta_4"],
        ),
        (lambda t: t.drop(columns="vy_m_s"), [], ["no column vy_m_s (lateral speed of front chassis); optional"]),
        (lambda t: t.drop(columns="t_s"), ["no column t_s (time)"], []),
        (lambda t: t.drop(index=range(100, 150)), [], ["1 gap: used are 1 of 2 stretches between, 58.5 of 60 s"]),
        (
            lambda t: t.drop(index=[*range(400, 450), *range(3000, 3100)]),
            [],
            ["2 gaps: used are 3 of 3 stretches between"],
        ),
        (lambda t: t.iloc[::4], [], []),
        (
            lambda t: t.assign(t_s=1e3 * t["t_s"]),
            ['t_s: sampled at 0.1 Hz, the machine file says 100 Hz: is it in ms? then write time_unit = "ms" in a'],
            [],
        ),
        (lambda t: t.assign(t_s=1e6 * t["t_s"]), ['write time_unit = "us"'], []),
        (
            lambda t: pd.concat([t.iloc[:50], t.iloc[20:]]),
            [],
            ["time begins anew in row 51: read as 2 logs in one file"],
        ),
        (lambda t: t.assign(theta2_rad=np.rad2deg(t["theta2_rad"])), ["theta2_rad", "degrees"], []),
        (lambda t: t.assign(theta4_rad=-t["theta4_rad"]), ["theta4_rad: front roll and rear roll turn against"], []),
        (lambda t: t.assign(u2_Nm=3.0), [], ["column u2_Nm: never changes (3)"]),
        (lambda t: t.assign(u1_Nm=t["u1_Nm"].clip(-700, 700)), [], ["u1_Nm: stands at its highest value"]),
        (
            edit("vy_m_s", 3000, 4.0),
            [],
            ["column vy_m_s: 1 spike of up to 4.01 m/s replaced by the mean of the neighbours (row 3001)"],
        ),
        (lambda t: t.assign(comment=1.0), [], ["not used: comment"]),
        (lambda t: t.head(60), ["only 60 rows"], []),
    ],
)
def test_what_is_wrong_is_said(
    va12: Model,
    table: pd.DataFrame,
    change: Callable[[pd.DataFrame], pd.DataFrame],
    faults: list[str],
    remarks: list[str],
) -> None:
    found = inspection.inspect(change(table), va12.machine)
    for words in faults:
        assert any(words in line for line in found.faults), found.faults
    for words in remarks:
        assert any(words in line for line in (*found.doubts, *found.remarks)), found
    assert found.usable == (not faults)
    assert all(len(t) == len(values) for t, values, _ in found.signals.values())


def test_a_column_of_another_name_is_found_by_every_command(
    va12: Model, table: pd.DataFrame, tmp_path: Path, excite: Excite
) -> None:
    path = tmp_path / "log.csv"
    table.rename(columns={"theta4_rad": "theta_4", "u1_Nm": "Nm_u1"}).to_csv(path, index=False)
    for command in ("identify", "diagnose"):
        code, _, stderr = excite(command, "va12", path, "--out", tmp_path / command)
        assert (code, stderr.count("\n")) == (2, 1)
        assert "no column theta4_rad (angle of rear roll): is theta_4 this column?" in stderr
        assert "u1_Nm (torque of front roll)" in stderr
        assert "--like va12" in stderr


def test_a_speed_for_an_angle_is_told_from_degrees(
    va12: Model, table: pd.DataFrame, tmp_path: Path, excite: Excite
) -> None:
    """By its torque: a speed changes with it. In degrees, not unwrapped: as before."""
    noise = 0.15 * np.random.default_rng(0).standard_normal(len(table))
    rpm = np.convolve(np.gradient(table["theta1_rad"], 0.01) * 60 / (2 * np.pi), np.ones(5) / 5, "same") + noise
    (line,) = inspection.inspect(table.assign(theta1_rad=rpm), va12.machine).faults
    assert "column theta1_rad: changes faster than the joint can turn, as its speed would" in line
    assert 'write unit = "rpm"' in line
    table.assign(theta1_rad=rpm).to_csv(tmp_path / "log.csv", index=False)
    code, _, stderr = excite("identify", "va12", tmp_path / "log.csv", "--out", tmp_path / "out")
    assert (code, stderr.count("\n"), 'unit = "rpm"' in stderr) == (2, 1, True)
    for name in ("theta1_rad", "theta2_rad", "theta4_rad"):
        faults = inspection.inspect(table.assign(**{name: np.rad2deg(table[name])}), va12.machine).faults
        assert any("degrees" in line for line in faults), faults
        assert not any("speed" in line for line in faults), faults
    wrapped = table.assign(theta1_rad=(table["theta1_rad"] + 3) % (2 * np.pi))
    assert "unwrap" in inspection.inspect(wrapped, va12.machine).faults[0]


def test_a_column_of_another_joint_is_no_lookalike(va12: Model, table: pd.DataFrame) -> None:
    lacking = table.drop(columns="theta1_rad").rename(columns={"theta4_rad": "theta_4"})
    assert refusal.lookalike(["theta1_rad"], lacking, va12.machine) == ""
    assert "theta_4" in refusal.lookalike(["theta4_rad"], lacking, va12.machine)


@pytest.mark.parametrize("options", [{}, {"sep": ";", "decimal": ","}])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda rows: [*rows[:41], rows[0].replace("theta4", " theta4"), *rows[41:]],
            "row 41: is the header once more, not data; cut it",
        ),
        (lambda rows: [*rows[:41], "# stopped here", *rows[41:]], "row 41: is a comment ('# stopped here'), not data"),
    ],
)
def test_a_row_that_is_no_data_is_named(
    va12: Model,
    table: pd.DataFrame,
    options: dict[str, str],
    change: Callable[[list[str]], list[str]],
    words: str,
    tmp_path: Path,
) -> None:
    """By one line, and not as a log of another machine; by the other commands as well."""
    path = tmp_path / "log.csv"
    path.write_text("\n".join(change(table.to_csv(index=False, **options).splitlines())))  # type: ignore[call-overload]
    read = tables.read_table(path)
    (line,) = inspection.inspect(read, va12.machine).faults
    assert words in line
    with pytest.raises(LogError, match="row 41"):
        refusal.accept(read, va12.machine)


def test_only_a_log_without_the_machines_columns_is_anothers(va12: Model, table: pd.DataFrame) -> None:
    unread = table.assign(**{name: "?" for name in table if name != "t_s"})
    assert not any("none of the columns" in line for line in inspection.inspect(unread, va12.machine).faults)
    other = table[["t_s"]].assign(speed=1.0)
    assert any("none of the columns of va12" in line for line in inspection.inspect(other, va12.machine).faults)


@pytest.mark.parametrize(
    ("units", "doubtful", "remark"),
    [
        (
            "ms;N m;;deg",
            [
                "says ms in column t_s, the machine file s: if the file is right, write time_unit",
                "deg in column theta2_rad, the machine file rad",
            ],
            "",
        ),
        ("s;Nm;;[rad]", [], ""),
        (
            "s;kNm;-;mm",
            ["kNm in column u1_Nm, the machine file N m", "mm in column theta2_rad, the machine file rad: which"],
            "",
        ),
        ("s;N m;;Grad", [], "units are not known, those of the machine file are taken: Grad for theta2_rad"),
    ],
)
def test_units_in_the_file_that_are_not_the_machine_files(
    va12: Model, table: pd.DataFrame, units: str, doubtful: list[str], remark: str, tmp_path: Path
) -> None:
    names = ["t_s", "u1_Nm", "u4_Nm", "theta2_rad"]
    table = table[[*names, *(c for c in table if c not in names)]]
    head, _, rest = table.to_csv(index=False, sep=";").partition("\n")
    (tmp_path / "log.csv").write_text(f"{head}\n{units}{';' * (len(table.columns) - 4)}\n{rest}")
    found = inspection.inspect(log.table_of(tmp_path / "log.csv", va12.machine), va12.machine)
    assert found.faults == ()
    assert len(found.doubts) == len(doubtful)
    for words, line in zip(doubtful, found.doubts, strict=True):
        assert words in line
    assert remark in " ".join(found.remarks)
    assert bool(found.remarks) == bool(remark)


def _with(model: Model, name: str, **changed: object) -> Machine:
    """The machine with one of its sensors changed."""
    own = tuple(s.model_copy(update=changed) if s.name == name else s for s in model.machine.sensor)
    return model.machine.model_copy(update={"sensor": own})


def test_a_factor_says_what_unit_a_column_is_in(va12: Model, table: pd.DataFrame) -> None:
    """Whatever the unit is called: a negative factor turns a sign around, pi / 180 says degrees."""
    table = table.copy()
    for factor, unit, right in ((-1.0, "rad", True), (np.pi / 180, "deg", True), (-1.0, "deg", False)):
        table.attrs["units"] = {"theta2_rad": unit}
        found = inspection.inspect(table, _with(va12, "theta2", factor=Quantity(value=factor, source="assumed")))
        assert any("theta2_rad, the machine file" in line for line in found.doubts) != right, (factor, unit)


def test_dates_are_time(va12: Model, table: pd.DataFrame) -> None:
    dated = table.assign(t_s=pd.Timestamp("2024-03-05") + pd.to_timedelta(table["t_s"], unit="s"))
    found = inspection.inspect(dated, va12.machine)
    assert found.faults == ()
    assert found.columns[0].what == "time (dates)"


def test_a_pressure_that_lacks_its_return(va12: Model, table: pd.DataFrame) -> None:
    """A speed for an angle is judged by the torques that are there."""
    litres = Quantity(value=8e-3, source="assumed")
    machine = _with(va12, "u1", column="p1 a", return_column="p1 b", unit="bar", displacement=litres)
    rpm = np.gradient(table["theta1_rad"], 0.01) * 60 / (2 * np.pi)
    half = table.rename(columns={"u1_Nm": "p1 a"}).assign(theta1_rad=rpm)
    faults = inspection.inspect(half, machine).faults
    assert any("no column p1 b" in line for line in faults), faults


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_log_of_a_row_is_too_short(rows: int, va12: Model, table: pd.DataFrame) -> None:
    faults = inspection.inspect(table.head(rows), va12.machine).faults
    assert any(f"only {rows} row{'s' * (rows != 1)}," in line for line in faults), faults
    refusal.accept(table.head(rows), va12.machine)


def test_every_fault_at_once(va12: Model, table: pd.DataFrame) -> None:
    bad = edit("u1_Nm", 40, "error")(table).assign(theta4_rad=lambda t: -t["theta4_rad"])
    bad = bad.assign(theta2_rad=np.rad2deg(bad["theta2_rad"]))
    faults = inspection.inspect(bad, va12.machine).faults
    assert len(faults) == 3, faults


def test_the_machine_is_guessed(table: pd.DataFrame, straight: Model, straight_motion: Motion) -> None:
    assert inspection.guess_machine(table).name == "va12"  # type: ignore[union-attr]
    assert inspection.guess_machine(sensors.measure(straight, straight_motion)).name == "va12_straight"  # type: ignore[union-attr]
    assert inspection.guess_machine(pd.DataFrame({"a": [1.0], "b": [2.0]})) is None


def test_log_check_command(excite: Excite, table: pd.DataFrame, tmp_path: Path) -> None:
    table.to_csv(tmp_path / "good.csv", index=False, sep=";", decimal=",")
    table.assign(theta2_rad=np.rad2deg(table["theta2_rad"])).to_csv(tmp_path / "bad.csv", index=False)
    code, stdout, _ = excite("log", "check", tmp_path / "good.csv", "--out", tmp_path / "g", "--json")
    assert code == 0
    assert json.loads(stdout)["usable"] is True
    assert (tmp_path / "g" / "log.png").stat().st_size > 20_000
    assert "is a usable log of va12: 6001 rows, 60 s at 100 Hz" in (tmp_path / "g" / "report.html").read_text()
    code, stdout, _ = excite("log", "check", tmp_path / "bad.csv", "--machine", "va12", "--out", tmp_path / "b")
    assert code == 1
    assert "column theta2_rad: turns at" in " ".join(stdout.split())
    assert "One thing is wrong" in (tmp_path / "b" / "report.html").read_text()
    code, _, stderr = excite("log", "check", tmp_path / "nothing.csv", "--out", tmp_path / "n")
    assert (code, stderr.count("\n")) == (2, 1)
    assert "no such file" in stderr
    assert not (tmp_path / "n").exists()


def test_readings_too_large_to_draw_are_left_out(straight: Model, straight_motion: Motion) -> None:
    table = sensors.measure(straight, straight_motion)
    signs = np.where(np.arange(len(table)) % 2, 1e308, -1e308)
    found = inspection.inspect(table.assign(u1_Nm=signs), straight.machine)
    assert not found.usable
    for _, x, _ in found.signals.values():
        assert np.nanmax(np.abs(x), initial=0.0) <= log.LARGEST


@pytest.mark.parametrize(("times", "asked"), [(1e-3, True), (1e-300, False)])
def test_another_unit_is_asked_about_where_one_would_do(
    straight: Model, straight_motion: Motion, times: float, asked: bool
) -> None:
    table = sensors.measure(straight, straight_motion)
    line = refusal.wrong_time_unit(times * table["t_s"].to_numpy(), straight.machine)
    assert "rows span" in line
    assert ("such as min" in line) == asked

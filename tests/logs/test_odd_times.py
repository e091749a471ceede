"""Odd clocks and rates: read rightly, or refused in one line."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

N = 3000


def rig_log() -> pd.DataFrame:
    """A log of the machine `emps` at 1 kHz."""
    t = np.arange(N) / 1000
    return pd.DataFrame({"t": t, "qm": 0.05 * np.sin(4 * t), "vir": np.cos(4 * t) + 0.01 * np.sin(90 * t)})


def identify(excite: Excite, tmp_path: Path, table: pd.DataFrame, machine: str | Path = "emps") -> tuple[int, str]:
    path = tmp_path / "log.csv"
    table.to_csv(path, index=False)
    code, _, err = excite("identify", machine, path, "--out", tmp_path / "out")
    return code, err


def said_by_log_check(excite: Excite, tmp_path: Path) -> str:
    code, out, err = excite("log", "check", tmp_path / "log.csv", "--machine", "emps", "--out", tmp_path / "out")
    assert code == 1
    return " ".join((out + err).split())


def test_rate_too_low_for_the_filter_is_said(excite: Excite, tmp_path: Path) -> None:
    code, err = identify(excite, tmp_path, rig_log()[::10])
    assert code == 2
    words = "sampled at 100 Hz, and the filter's cutoff_hz = 100 needs more than 200 Hz"
    assert words in " ".join(err.split())
    assert words in said_by_log_check(excite, tmp_path)


@pytest.mark.parametrize(
    ("per_second", "words"),
    [
        (
            1000 / 1.7,
            "rows are 0.5882 s apart (1.7 Hz), the machine file has 1000 Hz: is it a row number",
        ),
        (1 / 3600, "3000 rows span 0.0008331 s only"),
        (1 / 604800, "3000 rows span 4.959e-06 s only"),
    ],
    ids=["row number", "hours", "weeks"],
)
def test_numbers_that_are_no_seconds_are_said(excite: Excite, tmp_path: Path, per_second: float, words: str) -> None:
    table = rig_log()
    code, err = identify(excite, tmp_path, table.assign(t=table["t"] * per_second))
    assert code == 2
    assert words in " ".join(err.split())
    assert words in said_by_log_check(excite, tmp_path)


def test_first_time_that_is_blank_is_named(excite: Excite, tmp_path: Path) -> None:
    table = rig_log()
    table["t"] = pd.to_datetime(table.t, unit="s", origin="2026-11-26").dt.strftime("%Y-%m-%dT%H:%M:%S.%f")
    table.loc[0, "t"] = ""
    code, err = identify(excite, tmp_path, table)
    assert (code, "column t" in err) == (2, True)


def test_quoted_decimal_commas_are_no_dates(excite: Excite, tmp_path: Path) -> None:
    table = rig_log().map(lambda x: f"{x:.9f}".replace(".", ","))
    code, err = identify(excite, tmp_path, table)
    assert code == 2
    assert "not a finite number" in err


@pytest.mark.parametrize(("unit", "per_second"), [("ns", 1e9), ("day", 1 / 86400)])
def test_advised_time_units_are_allowed(excite: Excite, tmp_path: Path, unit: str, per_second: float) -> None:
    machine = tmp_path / "own.toml"
    machine.write_text(f'extends = "emps"\nname = "own"\ntime_unit = "{unit}"\n')
    table = rig_log()
    table["t"] = table.t * per_second
    code, err = identify(excite, tmp_path, table, machine)
    assert code != 2, err


def test_an_angle_that_never_changes_gives_no_estimate(excite: Excite, tmp_path: Path) -> None:
    code, err = identify(excite, tmp_path, rig_log().assign(qm=0.1))
    assert code == 1
    assert "no angle ever changes" in err


def test_a_unit_in_brackets_that_is_not_the_machines_is_said(excite: Excite, tmp_path: Path) -> None:
    table = rig_log().rename(columns={"qm": "qm [mm]"})
    path = tmp_path / "log.csv"
    table.to_csv(path, index=False)
    _, out, err = excite("log", "check", path, "--machine", "emps", "--out", tmp_path / "out")
    assert "the file says mm in column qm, the machine file m" in " ".join((out + err).split())

"""Small inputs that failed once, with the right behaviour (../shared/cases); skipped where they are not there."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.files import case

import excite
from excite.errors import ExciteError, LogError
from excite.logs import inspect, prepare, read_table
from excite.model import Model

# file: (rate [Hz], stretches, words of a note)
READ: dict[str, tuple[float, int, str]] = {
    "T1_rate/rate1008.csv": (100.8, 1, ""),
    "T1_rate/rate995.csv": (99.5, 1, ""),
    "T2_jitter/j1_jitter2ms.csv": (100, 1, "rows are 6 to 14 ms apart"),
    "T2_jitter/j2_walk.csv": (100, 1, "rows are 9 to 11 ms apart"),
    "T3_iso_whole_seconds/iso_py.csv": (100, 1, ""),
    "T4_text_times/sec_suffix.csv": (100, 1, ""),
    "T4_text_times/pandas_timedelta.csv": (100, 1, ""),
    "T4_text_times/tod_colon_ms.csv": (100, 1, ""),
    "T5_coarse_clock/coarse_clock.csv": (100, 1, "the clock ticks every 0.0156 s"),
    "T5_coarse_clock/j11_tenths.csv": (100, 1, "the clock ticks every 0.1 s"),
    "T5_coarse_clock/j6_twice.csv": (100, 1, "every row is there twice"),
    "T6_no_time_hint/date_and_time.csv": (100, 1, ""),
    "T6_no_time_hint/index.parquet": (100, 1, ""),
    "T6_no_time_hint/dtindex.parquet": (100, 1, ""),
    "T6_no_time_hint/j8_own_times.csv": (100, 1, "channels with times of their own"),
    "T8_restart/dst.csv": (100, 1, "the clock is set back an hour"),
    "T8_restart/tod_midnight.csv": (100, 1, "time of day passes midnight"),
    "T8_restart/w_concat.csv": (100, 2, "time begins anew in row 6002"),
    "T9_nanoseconds/timedelta.parquet": (100, 1, ""),
    "F1_commented_header/savetxt.csv": (100, 1, "the header was taken from a comment"),
    "F2_whitespace/spaces.txt": (100, 1, ""),
    "F2_whitespace/aligned.txt": (100, 1, ""),
    "F3_nul_tail/nul_tail.csv": (100, 1, "ends in 4096 zero bytes"),
    "F5_mat_extra/plus_gains.mat": (100, 1, "variables of another length are not used: gear"),
    "F7_merged_nan/j7_merged_nan.csv": (100, 1, "channels with times of their own"),
    "F7_merged_nan/j5_dropped1pct.csv": (100, 1, "rows are lost in"),
    "L1_check_says_usable/j1b_jitter1ms.csv": (100, 1, "rows are 8 to 12 ms apart"),
    "R2_held_channel/j9_torque_held5.csv": (100, 1, "changes in every fifth row only"),
}


@pytest.mark.parametrize("name", READ)
def test_log_is_read_at_its_own_times(name: str, va12: Model) -> None:
    rate, stretches, words = READ[name]
    ready = prepare(va12, [case(name)])
    assert float(ready.model.machine.sampling_hz) == pytest.approx(rate, rel=1e-3)
    assert len(ready.logs) == stretches
    assert all(np.isfinite(v).all() for one in ready.logs for v in one.values.values())
    assert words in " ".join(ready.notes)
    assert inspect(read_table(case(name)), va12.machine).faults == () or "T6" in name


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("T6_no_time_hint/notime.csv", "no column t_s"),
        ("T9_nanoseconds/epoch_ns.csv", "is it in ns"),
        ("R1_encoder_reset/e_reset_theta1.csv", "row 3001, column theta1_rad: jumps by 1.5 rad in one sample"),
        ("R1_encoder_reset/e_reset_theta2.csv", "row 3001, column theta2_rad: jumps by 0.176 rad in one sample"),
        ("R1_encoder_reset/e_slip_count_wheel.csv", "row 3001, column thetal_rad: jumps by"),
    ],
)
def test_log_is_refused_with_advice(name: str, words: str, va12: Model) -> None:
    with pytest.raises(LogError) as refused:
        prepare(va12, [case(name)])
    assert words in str(refused.value)
    assert "--method joint" not in str(refused.value)


def test_a_held_channel_is_a_doubt(va12: Model) -> None:
    found = inspect(read_table(case("R2_held_channel/j9_imu_held5.csv")), va12.machine)
    assert any("yaw_rate_rad_s: changes in every fifth row only" in line for line in found.doubts)


@pytest.mark.parametrize(
    ("name", "inside", "worst"),
    [
        ("T1_rate/rate1008.csv", 21, 1.0),
        ("T2_jitter/j2_walk.csv", 20, 3.5),
        pytest.param("R2_held_channel/j9_imu_held5.csv", 20, 1.0, marks=pytest.mark.slow),
        pytest.param("R2_held_channel/j9_torque_held5.csv", 20, 5.0, marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_at_the_logs_own_times(name: str, inside: int, worst: float, va12: Model) -> None:
    estimate = excite.identify(va12, case(name))
    low, high = estimate.interval95
    assert ((low <= va12.nominal) & (va12.nominal <= high)).sum() >= inside
    error, std = (100 * x / va12.scale for x in (np.abs(estimate.value - va12.nominal), estimate.std))
    assert (error < np.maximum(worst, 3 * std)).all()
    assert std.max() < 2 * max(worst, 1.0)


def test_emps_follows_its_clock(emps: Model) -> None:
    """Times x 0.992: a mass x 0.992**2, by every method; every fifth row +- 1: within half a per cent of even rows."""
    slow, fast = (case(f"T1_rate/{name}.csv") for name in ("emps", "emps_rate"))
    np.testing.assert_allclose(excite.identify(emps, fast, "ols").value[:3], [93.5915, 201.898, 20.3907], rtol=1e-4)
    before, after = (excite.identify(emps, log).value for log in (slow, fast))
    np.testing.assert_allclose(after / before, [0.992**2, 0.992, 1, 1], rtol=1e-4)
    folder = case("T2_jitter/emps200.toml").parent
    uneven, even = (
        excite.identify(folder / "emps200.toml", folder / f) for f in ("emps200_jit1.csv", "emps200_even.csv")
    )
    assert uneven.value[0] == pytest.approx(even.value[0], rel=5e-3)


@pytest.mark.slow
def test_standing_still_makes_nothing_less_sure(va12: Model, tmp_path: Path) -> None:
    """30 s of rest before and after a drive: deviations as without, nothing withheld."""
    profile = case("S1_standstill/still30_profile.csv")
    whole = pd.read_csv(profile)
    drive = whole[(whole["t_s"] >= 30) & (whole["t_s"] <= 90)].reset_index(drop=True)
    drive["t_s"] -= 30
    drive.to_csv(tmp_path / "drive.csv", index=False)
    alone = excite.identify(va12, excite.simulate(va12, tmp_path / "drive.csv", seed=3))
    rests = excite.identify(va12, excite.simulate(va12, profile, seed=3))
    np.testing.assert_allclose(rests.std, alone.std, rtol=0.1)
    assert any("the machine stands still for" in note for note in rests.notes)


@pytest.mark.slow
def test_a_kilohertz_is_reduced(va12: Model) -> None:
    folder = case("H1_1khz/va12_1k.toml").parent
    log = excite.simulate(folder / "va12_1k.toml", folder / "profile1k_u.csv", seed=3)
    estimate = excite.identify(folder / "va12_1k.toml", log)
    low, high = estimate.interval95
    assert ((low <= va12.nominal) & (va12.nominal <= high)).sum() >= 20
    assert any("is faster than the machine: reduced to 142.9 Hz" in note for note in estimate.notes)


@pytest.mark.parametrize(
    ("machine", "log"),
    [
        ("G08_lvm/rlvm.toml", "G08_lvm/lvm_tab.txt"),
        ("G08_lvm/rlvm.toml", "G08_lvm/lvm2_multi.txt"),  # its force is stamped 3 ms later
        ("G09_twincat/rtc.toml", "G09_twincat/tc.csv"),
        ("G12_candump/rcan.toml", "G12_candump/cd_zero.log"),
    ],
)
def test_an_export_gives_the_mass(machine: str, log: str) -> None:
    """Every export holds one drive of a slide of 95.1 kg."""
    estimate = excite.identify(case(machine), case(log))
    assert estimate.value[0] == pytest.approx(95.1, abs=0.2)
    assert abs(estimate.value[0] - 95.1) < 3 * estimate.std[0] < 0.5


def test_the_order_of_joints_may_change() -> None:
    model = excite.load(str(case("G02_joint_states/jn.toml")))
    right, swapped = (prepare(model, [case(f"G02_joint_states/js_{kind}.mcap")]).logs[0] for kind in ("ok", "swap"))
    for name, values in right.values.items():
        assert np.array_equal(swapped.values[name], values)


def test_blank_cells_that_mean_no_change_lead_to_the_key(tmp_path: Path) -> None:
    machine, log = case("G11_on_change/rig.toml"), case("G11_on_change/chg_blank_1e-05.csv")
    with pytest.raises(LogError, match=r'column u_N is blank .* write blank_means = "unchanged"'):
        excite.identify(machine, log)
    (tmp_path / "rig.toml").write_text('blank_means = "unchanged"\n' + machine.read_text())
    found = excite.identify(tmp_path / "rig.toml", log, "inverse")
    assert abs(found.value[0] - 95.1) < 2 * found.std[0] < 0.01 * 95.1


def test_a_joint_that_moves_with_another_need_not_be_logged() -> None:
    file, log = case("G05_mimic/par_mw.toml"), case("G05_mimic/par_without_level.csv")
    found = excite.identify(file, log, "ols")
    assert abs(found.value[found.names.index("MX3")] - 0.1) < 0.03
    (line,) = (x for x in inspect(read_table(log), excite.load(file).machine).remarks if x.startswith("no column"))
    assert line.endswith("; optional")


def test_denormal_torques_are_as_none() -> None:
    with pytest.raises(ExciteError, match="every torque is zero all along"):
        excite.identify(case("G07_denormal/rig.toml"), case("G07_denormal/scale_denormal.csv"))


@pytest.mark.parametrize("column", ["q_m", "u_N"])
@pytest.mark.parametrize("factor", [1e-200, 1e-28, 1e12, 1e20, 1e300])
def test_readings_of_any_size_end_in_an_estimate_or_one_line(column: str, factor: float) -> None:
    log = pd.read_csv(case("G11_on_change/chg_blank_1e-05.csv")).ffill()
    log[column] *= factor
    with suppress(ExciteError):  # any other error is a defect
        excite.identify(case("G11_on_change/rig.toml"), log)

"""Prediction along other logs and drives: bands that hold the truth as often as they say, and refusals in one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite
from support.drives import drive

import excite as program
from excite.errors import EstimateFolderError, NoEstimateError, UsageError
from excite.identification import Estimate, read_estimate
from excite.logs import is_profile, lowpass, profile_of
from excite.model import Model
from excite.simulation import Motion, exact_readings, measure, simulate

SEEDS = 6
NOISY_RIG = """extends = "emps"
name = "noisy_rig"
[sensor.q1]
noise = { value = 1e-6, source = "assumed" }
noise_unit = "SI"
[sensor.u1]
noise = { value = 3, source = "assumed" }
noise_unit = "SI"
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """The bench rig with sensors that have noise."""
    path = tmp_path_factory.mktemp("rig") / "noisy_rig.toml"
    path.write_text(NOISY_RIG)
    return program.load(path)


def swing(rig: Model, first_hz: float, second_hz: float) -> Motion:
    t = np.arange(0, 5, 1e-3)
    return simulate(rig, (60 * np.sin(2 * np.pi * first_hz * t) + 40 * np.sin(2 * np.pi * second_hz * t))[:, None])


@pytest.fixture(scope="module")
def other(straight: Model) -> Motion:
    """Another drive than the one that the parameters come from."""
    return simulate(straight, drive(straight, 30, 7, {"u1": 1000, "u4": 1400}))


@pytest.fixture(scope="module")
def estimate(straight: Model, straight_motion: Motion) -> Estimate:
    return program.identify(straight, measure(straight, straight_motion, seed=100))


def true_torques(model: Model, motion: Motion) -> np.ndarray:
    """Compute the low-passed readings (n_u, N) of torque sensors without noise."""
    exact = exact_readings(model, motion)
    each = np.array([exact[s.name] for s in model.machine.sensors("full") if s.kind == "torque"])
    return lowpass(each, float(model.machine.sampling_hz), model.machine.filter)


def covered(model: Model, fitted: Motion, target: Motion, seed: int) -> tuple[float, float, float]:
    """Shares of cells within 95 %: true torque along a log, its readings, and true signals along a drive.

    The machine is its file's, so that bands are of noise alone: tolerances would widen them for errors that it hasn't.
    """
    estimate = replace(program.identify(model, measure(model, fitted, seed=seed)), tolerated={})
    along_log = program.predict(model, estimate, measure(model, target, seed=1000 + seed))
    assert along_log.outside is not None
    rows = np.rint(along_log.t * float(model.machine.sampling_hz)).astype(int)  # without the filter's transients
    torque = np.abs(along_log.value - true_torques(model, target)[:, rows]) <= along_log.band
    along_drive = program.predict(model, estimate, target)
    true = np.concatenate([*([] if model.slips else [target.u.T]), target.nu.T, target.q.T])
    motion = np.abs(along_drive.value - true)[:, 1:] <= along_drive.band[:, 1:]  # the first row is given
    return float(torque.mean()), float(1 - along_log.outside.mean()), float(motion.mean())


@pytest.mark.slow
def test_bands_hold_the_truth_on_a_rig(rig: Model) -> None:
    """Torques along a log, and along a drive the torque that the motion needs, speed and position.

    Errors along a drive are those of six estimates, each inside or outside nearly all along.
    """
    fitted, target = swing(rig, 0.8, 1.7), swing(rig, 0.6, 2.1)
    shares = np.mean([covered(rig, fitted, target, seed) for seed in range(SEEDS)], axis=0)
    assert (shares >= 0.90).all(), shares
    assert (shares[:2] <= 0.99).all(), shares


@pytest.mark.slow
def test_bands_hold_the_truth_on_a_roller(straight: Model, straight_motion: Motion, other: Motion) -> None:
    shares = np.mean([covered(straight, straight_motion, other, seed) for seed in range(SEEDS)], axis=0)
    assert (shares >= 0.90).all(), shares
    assert (shares <= 0.99).all(), shares


def test_known_parameters_have_no_band(straight: Model, estimate: Estimate, other: Motion) -> None:
    known = replace(estimate, covariance=np.zeros_like(estimate.covariance), value=straight.nominal, tolerated={})
    along_drive = program.predict(straight, known, other)
    assert not along_drive.band.any()
    assert np.abs(along_drive.value - np.concatenate([other.nu.T, other.q.T])).max() < 1e-9
    along_log = program.predict(straight, known, measure(straight, other, seed=5))
    assert not along_log.parameters.any()
    assert (along_log.band == along_log.noise).all()


def test_band_of_a_planned_torque_is_that_of_the_regressor(rig: Model) -> None:
    """Offsets are left out: a profile has the torque that the motor delivers, not what its sensor reads."""
    estimate = program.identify(rig, measure(rig, swing(rig, 0.8, 1.7), seed=1))
    target = swing(rig, 0.6, 2.1)
    found = program.predict(rig, estimate, target)
    assert (found.names, found.units) == (("u1_N", "dq1_m_s", "q1_m"), ("N", "m/s", "m"))
    a = np.gradient(target.nu[:, 0], 1e-3)[None]
    W = rig.stacked_regressor(target.q.T, target.nu.T, a)[:, 0, :3]
    variance = np.einsum("ni,ij,nj->n", W, estimate.total_covariance[:3, :3], W)
    inner = slice(1, -1)  # ends are differentiated in another way
    assert found.parameters[0, inner] == pytest.approx(estimate.quantile95 * np.sqrt(variance)[inner], rel=1e-6)
    assert found.value[0, inner] == pytest.approx((W @ estimate.value[:3])[inner], rel=1e-9)


def test_open_loop_position_is_named_and_its_band_grows(straight: Model, estimate: Estimate, other: Motion) -> None:
    found = program.predict(straight, estimate, other)
    assert found.free == ("x0_m", "theta1_rad", "theta4_rad")
    place, speed = (found.band[found.names.index(n)] for n in ("x0_m", "v_m_s"))
    assert place[-1] > 1.5 * place[len(place) // 4]
    assert speed[-1] < 1.5 * speed.max()


def test_a_steered_joint_is_not_free(va12: Model) -> None:
    """Its angle changes the machine; the pose on the ground does not."""
    n = len(va12.nominal)
    covariance = np.diag((0.01 * va12.scale) ** 2)
    names, units = va12.base.names, va12.base.units
    estimate = Estimate("joint", names, units, va12.nominal, covariance, 1, 1, 1, np.empty((0, 0)), 1000, {}, ())
    found = program.predict(va12, estimate, drive(va12, 4, 0, {"u1": 1200, "u2": 4500, "u4": 1200}))
    assert set(found.free) == {"x0_m", "y0_m", "theta0_rad", "theta1_rad", "theta4_rad"}
    assert n == 22
    assert found.band[found.names.index("theta2_rad"), -1] > 0


def test_readings_of_another_machine_leave_the_band(straight: Model, estimate: Estimate, other: Motion) -> None:
    log = measure(straight, other, seed=5)
    right = program.predict(straight, estimate, log)
    wrong = program.predict(straight, estimate, log.assign(u1_Nm=1.15 * log.u1_Nm))
    assert right.outside is not None
    assert wrong.outside is not None
    assert right.worst == ()
    assert right.outside.mean() < 0.1
    assert "u1_Nm" in [name for name, *_ in wrong.worst]
    assert wrong.outside[0].mean() > 0.3


def test_unidentified_parameters_are_the_machine_files(straight: Model, estimate: Estimate, other: Motion) -> None:
    lost = np.arange(len(estimate.names)) == estimate.names.index("Fs1")
    value = np.where(lost, np.nan, straight.nominal)
    covariance = np.where(lost | lost[:, None], np.nan, 0.0)
    found = program.predict(straight, replace(estimate, value=value, covariance=covariance), other)
    assert found.assumed == ("Fs1",)
    assert np.abs(found.value - np.concatenate([other.nu.T, other.q.T])).max() < 1e-9


def test_stretches_of_a_log_follow_each_other(straight: Model, estimate: Estimate, other: Motion) -> None:
    log = measure(straight, other, seed=5)
    found = program.predict(straight, estimate, pd.concat([log[:1000], log[1500:]], ignore_index=True))
    assert len(found.t) == 2501
    assert np.allclose(np.diff(found.t), 0.01)


@pytest.mark.parametrize("name", ["straight", "va12", "emps"])
def test_a_profile_is_told_from_a_log(name: str, request: pytest.FixtureRequest) -> None:
    model: Model = request.getfixturevalue(name)
    torque = drive(model, 4, 0, dict.fromkeys(model.inputs, 50.0))
    motion = simulate(model, torque)
    profile, log = profile_of(model, motion), measure(model, motion, seed=0)
    assert is_profile(profile, model)
    assert is_profile(profile[["t_s", *(c for c in profile if c.startswith("u"))]], model)
    assert not is_profile(log, model)
    lacking = next(s.column for s in model.machine.sensors("paper") if s.kind == "torque")
    assert not is_profile(log.drop(columns=lacking), model)


def test_an_estimate_of_another_machine_is_refused(va12: Model, estimate: Estimate, other: Motion) -> None:
    with pytest.raises(UsageError, match="give the machine that it was identified for"):
        program.predict(va12, estimate, other)


def test_an_invalid_estimate_predicts_nothing(straight: Model, estimate: Estimate, other: Motion) -> None:
    with pytest.raises(NoEstimateError, match="nothing is predicted"):
        program.predict(straight, replace(estimate, status="invalid", doubt="a sign"), other)


# ------------------------------------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def place(straight: Model, straight_motion: Motion, other: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an estimate `found`, another log `log.csv` and another drive `profile.csv`."""
    from excite import workflows

    path = tmp_path_factory.mktemp("predict")
    measure(straight, straight_motion, seed=100).to_csv(path / "first.csv", index=False)
    measure(straight, other, seed=5).to_csv(path / "log.csv", index=False)
    profile_of(straight, other).to_csv(path / "profile.csv", index=False)
    (path / "found").mkdir()
    workflows.identify(path / "found", "va12_straight", [path / "first.csv"])
    return path


def test_what_is_saved_is_the_estimate(place: Path, straight: Model, straight_motion: Motion) -> None:
    saved = read_estimate(place / "found")
    made = program.identify(straight, measure(straight, straight_motion, seed=100))
    assert saved.model.machine == straight.machine
    assert saved.estimate.names == made.names
    assert saved.estimate.value == pytest.approx(made.value, rel=1e-9)
    assert saved.estimate.covariance == pytest.approx(made.covariance, rel=1e-6)
    assert saved.estimate.quantile95 == pytest.approx(made.quantile95)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["log.csv", "profile.csv"])
def test_the_command_writes_summary_table_and_figure(target: str, place: Path, tmp_path: Path, excite: Excite) -> None:
    out = tmp_path / "p"
    code, stdout, stderr = excite("predict", place / "found", place / target, "--out", out, "--json")
    assert (code, stderr) == (0, "")
    told = json.loads(stdout)
    table = pd.read_csv(out / "prediction.csv")
    is_log = target == "log.csv"
    assert told["along"] == target.partition(".")[0]
    assert next(iter(told["signals"])) == ("u1_Nm" if is_log else "v_m_s")
    for name, row in told["signals"].items():
        half = (table[f"{name}_high95"] - table[f"{name}_low95"]) / 2
        assert row["rms_band"] == pytest.approx(np.sqrt(np.mean(half**2)), rel=1e-6)
        assert row["at_end"] == pytest.approx(half.iloc[-1], rel=1e-5)
        assert ("share_outside" in row) == is_log == (f"{name}_measured" in table)
    assert (out / "prediction.png").stat().st_size > 10_000
    code, stdout, _ = excite("predict", place / "found", place / target, "--out", out)
    assert code == 0
    words = ("inverse dynamics", "readings are outside") if is_log else ("open loop", "add up", "no fair measure")
    page = (out / "report.html").read_text()
    for word in words:
        assert word in stdout
        assert word in page


@pytest.mark.parametrize(
    ("result", "target", "words"),
    [
        ("nowhere", "log.csv", "not an estimate"),
        ("found", "nothing.csv", "no such file"),
        ("found", "empty.csv", "the file is empty"),
        ("found", "found", "is a folder"),
        ("found", "alien.csv", "theta1_rad"),
        ("found", "half.csv", "no column u4_Nm"),
    ],
)
def test_bad_folders_and_targets_are_one_line(
    result: str, target: str, words: str, place: Path, tmp_path: Path, excite: Excite
) -> None:
    (place / "empty.csv").write_text("")
    (place / "alien.csv").write_text("t_s,x\n" + "".join(f"{k / 100},{k}\n" for k in range(500)))
    pd.read_csv(place / "profile.csv").drop(columns="u4_Nm").to_csv(place / "half.csv", index=False)
    code, _, stderr = excite("predict", place / result, place / target, "--out", tmp_path / "p")
    assert code == 2
    assert words in stderr
    assert stderr.count("\n") == 1
    assert not (tmp_path / "p").exists()


def changed_summary(change: Callable[[dict[str, object]], object]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        path = folder / "summary.json"
        told = json.loads(path.read_text())
        change(told)
        path.write_text(json.dumps(told))

    return spoil


def changed_covariance(change: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        path = folder / "covariance.csv"
        change(pd.read_csv(path, index_col="parameter")).to_csv(path)

    return spoil


@pytest.mark.parametrize(
    "spoil",
    [
        lambda folder: (folder / "summary.json").write_text("{"),
        lambda folder: (folder / "summary.json").write_text("[]"),
        lambda folder: (folder / "machine.json").unlink(),
        lambda folder: (folder / "machine.json").write_text("{}"),
        lambda folder: (folder / "covariance.csv").unlink(),
        lambda folder: (folder / "covariance.csv").write_bytes(b"\xff\x00"),
        changed_summary(lambda told: told.pop("degrees")),
        changed_summary(lambda told: told.update(parameters=[1, 2])),
        changed_summary(lambda told: told.update(parameters={"M": 3})),
        changed_summary(lambda told: told.update(cond_w="wide")),
        changed_covariance(lambda table: table.drop(columns="M")),
        changed_covariance(lambda table: table.iloc[::-1]),
        changed_covariance(lambda table: table.assign(M="x")),
        changed_covariance(lambda table: table.assign(M=3.0)),
    ],
)
def test_a_damaged_estimate_is_one_line(spoil: Callable[[Path], object], place: Path, tmp_path: Path) -> None:
    folder = tmp_path / "found"
    shutil.copytree(place / "found", folder)
    spoil(folder)
    with pytest.raises(EstimateFolderError, match=r"identify") as err:
        read_estimate(folder)
    assert "\n" not in str(err.value)


def test_a_covariance_changed_by_hand_says_where(place: Path, tmp_path: Path) -> None:
    """Whoever changed it by hand wants it undone, not identified again."""
    folder = tmp_path / "found"
    shutil.copytree(place / "found", folder)
    changed_covariance(lambda table: table.assign(M=table["M"].where(table.index != "Kx1", 3 * table["M"])))(folder)
    with pytest.raises(EstimateFolderError, match=r"covariance.csv: M, Kx1: is not the number of Kx1, M; undo what"):
        read_estimate(folder)


def test_an_invalid_estimate_ends_with_1(place: Path, tmp_path: Path, excite: Excite) -> None:
    folder = tmp_path / "found"
    shutil.copytree(place / "found", folder)
    changed_summary(lambda told: told.update(status="invalid", doubt="M is negative"))(folder)
    code, stdout, stderr = excite("predict", folder, place / "log.csv", "--out", tmp_path / "p")
    assert (code, stdout) == (1, "")
    assert "nothing is predicted, as the estimate is invalid: M is negative" in stderr
    assert not (tmp_path / "p").exists()


def test_a_doubtful_estimate_says_that_bands_do_not_hold(place: Path, tmp_path: Path, excite: Excite) -> None:
    folder = tmp_path / "found"
    shutil.copytree(place / "found", folder)
    changed_summary(lambda told: told.update(status="doubtful", doubt="residuals are correlated"))(folder)
    code, stdout, _ = excite("predict", folder, place / "profile.csv", "--out", tmp_path / "p")
    assert code == 0
    assert "The 95 % bands do not hold, as the estimate is doubtful: residuals are correlated." in stdout

"""Diagnosis by the torques of driven joints: hidden truth in inverse dynamics written here, and real robots."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.signal
from support.drives import arm_motion
from support.files import SHARED

from excite.diagnosis import count_false_alarms, explain, machine_file, summarise
from excite.diagnosis.deadline import Deadline
from excite.diagnosis.findings import assess_torques
from excite.diagnosis.torque_fit import Whitening, course_gains, find_whitening, innovations
from excite.diagnosis.torque_regression import TorqueDiagnosis, diagnose_torques
from excite.errors import NotIdentifiableError
from excite.identification import identify, needed_sensors
from excite.logs import Log, prepare
from excite.model import Model, build
from excite.model.machine import load_machine

Hidden = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
TWO_JOINTS = Path(__file__).parents[1] / "support" / "two_joints.toml"
SECONDS, VOLTS_PER_NEWTON = 25.0, 1 / 35.1507


def rig_log(seed: int, hidden: Hidden | None = None, error: float = 2.0) -> pd.DataFrame:
    """A log of the EMPS rig from Newton's law along a given motion.

    hidden: further force [N] of position, speed and force. error [N]: size of a slow error that the model does not
    have, correlated over 0.2 s.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0, SECONDS, 1e-3)
    x = np.clip(np.minimum(t, SECONDS - t) / 3, 0, 1)
    q = sum(
        rng.uniform(0.1, 0.25) / k * np.sin(2 * np.pi * 0.11 * k * t + rng.uniform(0, 2 * np.pi)) for k in range(1, 7)
    ) * (6 * x**5 - 15 * x**4 + 10 * x**3)
    v = np.gradient(q, t)
    force = 95.1 * np.gradient(v, t) + 203.5 * v + 20.4 * np.sign(v) - 3.2
    if hidden is not None:
        force = force + hidden(q, v, force)
    slow = scipy.signal.lfilter([1.0], [1.0, -0.995], rng.standard_normal(len(t)))
    force = force + error * slow / slow.std() + 0.2 * rng.standard_normal(len(t))
    return pd.DataFrame({"t": t, "qm": q + 5e-8 * rng.standard_normal(len(t)), "vir": VOLTS_PER_NEWTON * force})


def diagnosed(model: Model, log: pd.DataFrame) -> TorqueDiagnosis:
    ready = prepare(model, [log], needed_sensors(model, "ols"))
    return diagnose_torques(ready.model, ready.logs, ready.model.machine.filter)[0]


def test_a_slow_error_of_the_model_gets_no_name(emps: Model) -> None:
    """It is far beyond the noise of the sensors, but nothing that the state of the machine tells."""
    found = diagnosed(emps, rig_log(1))
    assert found.verdict == "unexplained"
    assert not found.findings
    assert not found.curves
    assert "times its noise" in found.located[0]


HIDDEN: dict[str, tuple[Hidden, float]] = {
    "asymmetric_viscous": (lambda q, v, F: -20 * np.abs(v), -20.0),
    "stribeck_friction": (lambda q, v, F: 8 * np.sign(v) * np.exp(-np.abs(v) / 0.03), 8.0),
    "load_dependent_friction": (lambda q, v, F: 0.08 * np.abs(F) * np.sign(v), 0.08),
}


@pytest.mark.parametrize("effect", HIDDEN)
def test_what_is_hidden_under_a_slow_error_is_a_correction(emps: Model, effect: str) -> None:
    """With its size inside three of its standard deviations."""
    hidden, size = HIDDEN[effect]
    found = diagnosed(emps, rig_log(0, hidden))
    assert found.verdict == "unexplained"
    assert [(f.effect, f.kind) for f in found.findings] == [(effect, "correction")]
    assert found.findings[0].magnitude == pytest.approx(size, abs=3 * found.findings[0].magnitude_std)
    assert found.findings[0].magnitude_std < 0.3 * abs(size)


@pytest.mark.slow
def test_what_takes_nearly_all_of_the_misfit_is_the_cause_and_the_rest_is_said(emps: Model) -> None:
    found = diagnosed(emps, rig_log(0, lambda q, v, F: -80 * np.abs(v)))
    assert found.verdict == "named"
    assert [(f.effect, f.kind) for f in found.findings] == [("asymmetric_viscous", "cause")]
    assert 0.85 < found.share < 1
    assert "times its noise" in found.located[0]
    two = diagnosed(emps, rig_log(0, lambda q, v, F: -80 * np.abs(v) - 30 * np.sign(v) * np.exp(-np.abs(v) / 0.05)))
    assert two.verdict == "unexplained"
    assert {f.kind for f in two.findings} == {"correction"}


@pytest.mark.parametrize(("late", "seed"), [(0.01, 0), (0.03, 1)])
def test_a_late_channel_is_no_friction(emps: Model, late: float, seed: int) -> None:
    """It moves the step of the force at every reversal, as friction near rest would."""
    log = rig_log(seed)
    log["vir"] = np.interp(log["t"] - late, log["t"], log["vir"])
    (f,) = diagnosed(emps, log).findings
    assert f.effect == "channel_delay"
    assert f.magnitude == pytest.approx(late, abs=3 * f.magnitude_std)


def arm_log(model: Model, misread: Callable[[np.ndarray, np.ndarray], np.ndarray], more: Hidden | None = None) -> Log:
    """A log of an arm of two joints along given motions.

    misread: what the encoders read (2, N) of the angles and torques. more: further torques (2, N) of q, nu, a.
    """
    rng = np.random.default_rng(5)
    t = np.arange(0, 40, 1 / float(model.machine.sampling_hz))
    q, nu, a = arm_motion(t, 0.7)
    u = model.predict(q, nu, a, model.expand @ model.nominal).full()
    u = u + (0 if more is None else more(q, nu, a))
    read = misread(q, u) + 1e-5 * rng.standard_normal(q.shape)
    u = u + 0.02 * rng.standard_normal(u.shape)
    angles, torques = ([s.name for s in model.machine.sensor if s.kind == kind] for kind in ("angle", "torque"))
    return Log("made", t, dict(zip([*angles, *torques], [*read, *u], strict=True)))


@pytest.mark.parametrize(
    ("cause", "size", "misread", "more"),
    [
        ("encoder_scale@forearm", 0.02, lambda q, u: q * np.array([[1.0], [1.02]]), None),
        (
            "torque_ripple@forearm",
            0.3,
            lambda q, u: q,
            lambda q, nu, a: np.array([[0.0], [-0.3]]) * np.sin(7 * q + 0.4),
        ),
    ],
)
def test_errors_of_encoders_and_ripple_are_found_in_torques(
    cause: str,
    size: float,
    misread: Callable[[np.ndarray, np.ndarray], np.ndarray],
    more: Hidden | None,
) -> None:
    model = build(load_machine(str(TWO_JOINTS)))
    log = arm_log(model, misread, more)
    (found,) = diagnose_torques(model, [log], model.machine.filter)[0].findings
    assert cause in (found.name, *found.tied_with)
    if found.name == cause:
        assert found.magnitude == pytest.approx(size, abs=2.5 * found.magnitude_std)


def test_rest_hides_nothing(emps: Model) -> None:
    """Four seconds at rest, in which the sign of a noisy speed turns over, are no measure of the noise."""
    log = rig_log(0, HIDDEN["asymmetric_viscous"][0])
    rest = pd.concat([log.iloc[[-1]]] * 4000, ignore_index=True)
    rng = np.random.default_rng(5)
    rest["t"] = log["t"].iloc[-1] + 1e-3 * np.arange(1, 4001)
    rest["qm"] += 5e-8 * rng.standard_normal(4000)
    rest["vir"] = 0.2 * VOLTS_PER_NEWTON * rng.standard_normal(4000)
    found = diagnosed(emps, pd.concat([log, rest], ignore_index=True))
    assert [f.effect for f in found.findings] == ["asymmetric_viscous"]
    assert found.before.lowest.max() < 0.2


def test_joints_that_hardly_move_are_refused(emps: Model) -> None:
    log = rig_log(0)
    machine = emps.machine.model_copy(update={"filter": emps.machine.filter.model_copy(update={"decimation": 100})})
    ready = prepare(emps.for_machine(machine), [log.iloc[:6000]], needed_sensors(emps, "ols"))
    with pytest.raises(NotIdentifiableError, match="carriage in motion are too few"):
        diagnose_torques(ready.model, ready.logs, machine.filter)


def test_a_curve_over_speed_leaves_out_what_friction_explains(emps: Model) -> None:
    """Splines contain a constant and the speed itself, which belong to the offset and to viscous friction."""
    found = diagnosed(emps, rig_log(0, lambda q, v, F: 3 * np.sin(2 * np.pi * v / 0.5)))
    (curve,) = found.curves
    assert "speed" in curve.signal[0]
    assert np.abs(curve.value).max() < 5


def test_a_force_that_no_effect_has_is_drawn_as_a_curve(emps: Model) -> None:
    """A force of the position comes out as one, inside a band of three standard deviations nearly everywhere."""
    found = diagnosed(emps, rig_log(0, lambda q, v, F: 4 * np.sin(2 * np.pi * q / 0.4)))
    assert not found.findings
    (curve,) = found.curves
    assert curve.signal == ("the position of carriage", "m")
    assert curve.interval[0] > 10
    true = 4 * np.sin(2 * np.pi * curve.at / 0.4)
    off = curve.value - true - np.mean(curve.value - true)
    assert np.mean(np.abs(off) < 3 * curve.std) > 0.85
    assert np.ptp(curve.value) == pytest.approx(8.0, rel=0.3)


def test_a_curve_alone_gives_the_findings_no_gain(emps: Model) -> None:
    """Its own gain is told with it: that of no finding would be 0 %, which nobody measured."""
    ready = prepare(emps, [rig_log(0, lambda q, v, F: 4 * np.sin(2 * np.pi * q / 0.4))], needed_sensors(emps, "ols"))
    summary = summarise(assess_torques(*diagnose_torques(ready.model, ready.logs, ready.model.machine.filter)))
    assert not summary["findings"]
    assert (summary["gain_percent"], summary["gain_ci95"]) == (None, None)


def test_a_curve_goes_into_the_machine_file_and_holds_on_another_log(emps: Model, tmp_path: Path) -> None:
    """As a table that identification takes: the error of a log that it was not found on falls by a quarter."""

    def force(q: np.ndarray, v: np.ndarray, F: np.ndarray) -> np.ndarray:
        return 4 * np.sin(2 * np.pi * q / 0.4)

    text = machine_file("emps", emps.machine, diagnosed(emps, rig_log(0, force)))
    assert text is not None
    (tmp_path / "machine.toml").write_text(text)
    ready = prepare(emps, [rig_log(1, force)], needed_sensors(emps, "ols"))
    plain = identify(ready.model, ready.logs, "ols")
    mapped = identify(build(load_machine(str(tmp_path / "machine.toml"))), ready.logs, "ols")
    assert mapped.relative_error_percent < 0.75 * plain.relative_error_percent
    assert mapped.value[mapped.names.index("torque_map@carriage")] == pytest.approx(1.0, abs=0.5)


@pytest.mark.slow
def test_names_and_sizes_over_many_logs(emps: Model) -> None:
    """Eight logs of each kind: no name where nothing is hidden, hardly a wrong one, and sizes that hold.

    Measured on 24 others of each kind: 71 of 72 named, none wrongly; of 30 with nothing hidden none.
    """
    none = [diagnosed(emps, rig_log(seed)) for seed in range(100, 108)]
    assert not any(d.findings or d.curves for d in none)
    named = wrong = 0
    for effect, (hidden, size) in HIDDEN.items():
        findings = [f for seed in range(100, 108) for f in diagnosed(emps, rig_log(seed, hidden)).findings]
        right = [f for f in findings if f.effect == effect]
        named += len(right)
        wrong += sum(f"{effect}@carriage" not in (f.name, *f.tied_with) for f in findings)
        z = np.array([(f.magnitude - size) / f.magnitude_std for f in right])
        assert 0.4 < np.mean(z**2) < 2.5, effect
    assert named >= 20
    assert wrong <= 1


def run_command(machine: Path | str, log: Path, out: Path, *more: str) -> dict[str, object]:
    command = [sys.executable, "-m", "excite", "diagnose", str(machine), str(log), "--out", str(out), "--json", *more]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    summary: dict[str, object] = json.loads(done.stdout)
    return summary


@pytest.mark.slow
def test_emps_is_corrected_as_published(tmp_path: Path) -> None:
    """Friction that depends on the direction; the error of the published model with more terms is 3.11 % (A. Janot,
    M. Gautier, M. Brunot, 2019)."""
    data = SHARED / "emps" / "DATA_EMPS.mat"
    if not data.is_file():
        pytest.skip(f"{data} is missing")
    summary = run_command("emps", data, tmp_path / "diagnosis")
    assert summary["verdict"] == "unexplained"
    first = summary["findings"][0]  # type: ignore[index]
    assert (first["effect"], first["kind"]) == ("asymmetric_viscous", "correction")
    assert -60 < first["amount"] < -20
    low, high = summary["gain_ci95"]  # type: ignore[misc]
    assert low > 20
    assert high < 80
    command = [sys.executable, "-m", "excite", "identify", str(tmp_path / "diagnosis" / "machine.toml"), str(data)]
    done = subprocess.run(
        [*command, "--method", "ols", "--out", str(tmp_path / "i"), "--json"], capture_output=True, text=True
    )
    assert json.loads(done.stdout)["relative_error_percent"] < 3.15, done.stderr


@pytest.mark.slow
def test_a_six_joint_robot_has_corrections_that_pay(tmp_path: Path) -> None:
    data = SHARED / "ur10e" / "20_02_19_14harm50sec.csv"
    if not data.is_file():
        pytest.skip(f"{data} is missing")
    summary = run_command("ur10e", data, tmp_path / "diagnosis")
    assert summary["verdict"] == "unexplained"
    assert summary["findings"]
    assert all(f["kind"] == "correction" for f in summary["findings"])  # type: ignore[attr-defined]
    assert summary["gain_ci95"][0] > 5  # type: ignore[index]
    assert (tmp_path / "diagnosis" / "misfit.png").is_file()
    assert (tmp_path / "diagnosis" / "machine.toml").is_file()


def test_a_deadline_ends_the_search_with_the_best_so_far(emps: Model) -> None:
    """No effect is begun after it."""
    ready = prepare(emps, [rig_log(0, HIDDEN["asymmetric_viscous"][0])], needed_sensors(emps, "ols"))
    over = Deadline(0.0)
    found, _ = diagnose_torques(ready.model, ready.logs, ready.model.machine.filter, deadline=over)
    assert over.reached
    assert found.verdict == "unexplained"
    assert not found.findings
    assert not Deadline(None).is_over()


@pytest.mark.slow
def test_a_search_that_a_budget_ends_says_so(tmp_path: Path) -> None:
    """And calls nothing clean that it did not look at."""
    rig_log(0, HIDDEN["asymmetric_viscous"][0]).to_csv(tmp_path / "log.csv", index=False)
    summary = run_command("emps", tmp_path / "log.csv", tmp_path / "diagnosis", "--budget", "0.01")
    assert summary["verdict"] == "unexplained"
    assert summary["findings"] == []
    assert "ended by its budget" in str(summary["answer"])
    assert any("best answer so far" in note for note in summary["notes"])  # type: ignore[attr-defined]


def friction(q: np.ndarray, v: np.ndarray, F: np.ndarray) -> np.ndarray:
    return -30 * np.abs(v) + 10 * np.sign(v) * np.exp(-np.abs(v) / 0.03)


def test_two_effects_in_the_noise_of_a_sensor_are_named(emps: Model, tmp_path: Path) -> None:
    """And none else; with them in the machine file, another log shows nothing, and what is new there gets its name."""
    found = diagnosed(emps, rig_log(2, friction, error=0.0))
    sizes = {f.effect: f.magnitude for f in found.findings}
    assert found.verdict == "named"
    assert sizes == {
        "asymmetric_viscous": pytest.approx(-30, rel=0.05),
        "stribeck_friction": pytest.approx(10, rel=0.1),
    }
    text = machine_file("emps", emps.machine, found)
    assert text is not None
    (tmp_path / "machine.toml").write_text(text)
    extended = build(load_machine(str(tmp_path / "machine.toml")))
    assert diagnosed(extended, rig_log(3, friction, error=0.0)).verdict == "clean"
    more = diagnosed(extended, rig_log(3, lambda q, v, F: friction(q, v, F) + 60 * v * np.abs(v), error=0.0))
    assert [f.effect for f in more.findings] == ["quadratic_drag"]


def test_logs_of_a_rig_that_differ_are_told(emps: Model, tmp_path: Path) -> None:
    """Dry friction of 10 N more on another day is no effect that the model lacks."""
    paths = [tmp_path / "before.csv", tmp_path / "after.csv"]
    for seed, path in enumerate(paths):
        rig_log(seed, lambda q, v, F, more=10 * seed: more * np.sign(v), error=0.0).to_csv(path, index=False)
    ready = prepare(emps, paths, needed_sensors(emps, "ols"))
    found = explain(ready.model, ready.logs, ready.model.machine.filter)
    assert found.differences is not None
    (changed,) = found.differences.changed
    assert changed.name == "Fc"
    assert changed.value == pytest.approx([20.4, 30.4], abs=0.1)


def test_clean_torques_of_the_fitted_rig_get_no_name(emps: Model) -> None:
    """With the slow error that the log leaves."""
    found = count_false_alarms(diagnosed(emps, rig_log(0, HIDDEN["asymmetric_viscous"][0])), 5)
    assert found.verdicts == {"clean": 5}


def test_innovations_are_those_of_the_covariance() -> None:
    """By a Cholesky factor of the covariance of the rows that are used, with gaps."""
    rng = np.random.default_rng(3)
    n, stay, share = 60, 0.9, 0.2
    used = rng.random(n) > 0.3
    used[20:30] = False
    values = rng.standard_normal((n, 2))
    covariance = (1 - share) * stay ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) + share * np.eye(n)
    expected = np.linalg.solve(np.linalg.cholesky(covariance[np.ix_(used, used)]), values[used])
    variance, gain = course_gains(used, np.array([stay]), np.array([share]))
    found = innovations(values, used, stay, variance[:, 0], gain[:, 0])
    assert found[used] == pytest.approx(expected)
    assert not found[~used].any()


def test_the_course_of_residuals_is_found() -> None:
    """Size, correlation and the share of white noise, to what 20 000 rows tell."""
    made = Whitening(float(np.exp(-1 / 20)), 0.05, 3.0)
    series = made.simulate(20_000, np.random.default_rng(1))
    found = find_whitening([(series, np.ones(len(series), bool))], 1e-9)
    assert found.size == pytest.approx(3.0, rel=0.1)
    assert np.log(found.stay) == pytest.approx(-1 / 20, rel=0.6)
    white = found(series, np.ones(len(series), bool))
    assert white.std() == pytest.approx(1.0, rel=0.02)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.1

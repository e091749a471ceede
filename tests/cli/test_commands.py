"""Commands as people and scripts use them: exit codes, one clear line, JSON and nothing else, nothing half written."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

import excite as package
from excite.cli import terminal
from excite.errors import StoppedError, UsageError
from excite.logs import profile as profiles
from excite.model import Model
from excite.simulation import Motion


@pytest.fixture
def profile(straight: Model, straight_motion: Motion, tmp_path: Path) -> Path:
    path = tmp_path / "profile.csv"
    profiles.profile_of(straight, straight_motion).to_csv(path, index=False)
    return path


def test_help_needs_no_heavy_import() -> None:
    heavy = "[m for m in ('casadi', 'numpy', 'pandas') if m in sys.modules]"
    code = f"import sys; from excite.__main__ import app; print({heavy})"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "[]"


def test_without_a_command_help_is_shown(excite: Excite) -> None:
    code, stdout, _ = excite()
    assert code == 0
    for command in ("machines", "design", "verify", "run", "simulate", "identify"):
        assert command in stdout


@pytest.mark.slow
def test_a_result_that_is_replaced_is_said(excite: Excite, tmp_path: Path) -> None:
    asked = ("design", "va12_straight", "--duration", 8, "--starts", 1, "--out", tmp_path / "d")
    _, first, _ = excite(*asked, "--seed", 3)
    assert "will be replaced" not in first
    code, second, _ = excite(*asked, "--seed", 4)
    assert code == 0
    said, *_ = second.splitlines()
    assert said.startswith(f"{tmp_path / 'd'}/ will be replaced")
    assert "(objective cond, duration 8 s, starts 1, seed 3)" in said
    _, third, _ = excite(*asked, "--json")
    json.loads(third)


def test_the_version_is_told(excite: Excite) -> None:
    assert excite("--version") == (0, f"excite {version('excite')}\n", "")


def test_machines_are_listed(excite: Excite) -> None:
    code, stdout, _ = excite("machines", "--json")
    rows = {row["machine"]: row for row in json.loads(stdout)["machines"]}
    assert code == 0
    assert {n: len(rows[n]["parameters"]) for n in ("va12", "va12_straight", "emps")} == {
        "va12": 22,
        "va12_straight": 11,
        "emps": 4,
    }
    assert rows["va12"]["groupings"]["MX0R"] == {"MX0": 1, "M2": -1.45, "M4": -1.45}
    code, stdout, _ = excite("machines")
    assert code == 0
    assert "va12_straight" in stdout


@pytest.mark.parametrize(
    ("effect", "doubts"),
    [
        ("rolling_resistance@rear_roll=30", []),
        (
            "rolling_resistance@rear_roll=40000",
            ["--effect rolling_resistance@rear_roll: 40000 N, usual are about 200"],
        ),
        ("shear_saturation@rear_roll=0.2", []),
        ("shear_saturation@rear_roll=0.002", ["--effect shear_saturation@rear_roll: 0.002, usual are about 0.3"]),
    ],
)
def test_an_effect_as_large_as_none_is_said(
    effect: str, doubts: list[str], profile: Path, tmp_path: Path, excite: Excite
) -> None:
    """It may be meant in another unit; it is simulated all the same."""
    out = tmp_path / "log.csv"
    _, stdout, _ = excite("simulate", "va12_straight", profile, "--effect", effect, "--out", out, "--json")
    assert [line.split(":")[0:2] for line in json.loads(stdout)["doubts"]] == [x.split(":") for x in doubts]
    assert out.exists()


def test_simulate_then_identify(profile: Path, tmp_path: Path, excite: Excite, straight: Model) -> None:
    """The loop through files: exact signals give the truth back."""
    out = tmp_path / "log.csv"
    code, stdout, stderr = excite("simulate", "va12_straight", profile, "--noise", "off", "--out", out, "--json")
    assert (code, stderr) == (0, "")
    assert json.loads(stdout)["rows"] == 4001
    code, stdout, _ = excite("identify", "va12_straight", out, "--method", "ols", "--out", tmp_path / "i", "--json")
    assert stdout == (tmp_path / "i" / "summary.json").read_text()
    assert json.loads(stdout)["command"].startswith("excite identify va12_straight ")
    assert code == 0
    found = json.loads(stdout)["parameters"]
    assert found["M"]["unit"] == "kg"
    assert found["M"]["value"] == pytest.approx(11000, rel=0.05)
    assert (tmp_path / "i" / "fit.png").stat().st_size > 10_000


def test_same_seed_same_bytes(profile: Path, tmp_path: Path, excite: Excite) -> None:
    logs = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        excite("simulate", "va12_straight", profile, "--seed", seed, "--out", tmp_path / f"{name}.csv")
        logs.append((tmp_path / f"{name}.csv").read_bytes())
    assert logs[0] == logs[1] != logs[2]


def test_simulated_joints_stick_on_request(profile: Path, tmp_path: Path, excite: Excite) -> None:
    """Command and function write the same log, in which rolls rest; by default they never quite do."""
    logs = {}
    for friction in ("set-valued", "smoothed"):
        out = tmp_path / f"{friction}.csv"
        code, stdout, stderr = excite(
            *("simulate", "va12_straight", profile, "--noise", "off", "--friction", friction, "--out", out, "--json")
        )
        assert (code, stderr) == (0, "")
        assert json.loads(stdout)["friction"] == friction
        logs[friction] = pd.read_csv(out)
    table = package.simulate("va12_straight", profile, noise=False, friction="set-valued")
    np.testing.assert_allclose(logs["set-valued"].to_numpy(), table.to_numpy(), atol=1e-6)
    still = {name: int((log["theta1_rad"].diff()[1:] == 0).sum()) for name, log in logs.items()}
    assert still["set-valued"] > 10 > still["smoothed"]
    with pytest.raises(UsageError, match="friction: sticky is unknown, allowed: smoothed, set-valued"):
        package.simulate("va12_straight", profile, friction="sticky")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["explode"], ["explode"]),
        (["design"], ["MACHINE"]),
        (["design", "va13"], ["va13", "allowed", "va12"]),
        (["design", "nothing.toml"], ["nothing.toml", "no such file"]),
        (["design", "va12", "--problem", "R61"], ["R61", "allowed: R60"]),
        (["design", "va12", "--objective", "beauty"], ["beauty", "allowed", "cond"]),
        (["design", "va12", "--duration", "-3"], ["--duration", "-3"]),
        (["design", "va12", "--duration", "nan"], ["--duration", "nan"]),
        (["design", "va12", "--starts", "0"], ["--starts"]),
        (["design", "va12", "--starts", "many"], ["--starts", "integer"]),
        *(
            ([*command, "--budget", value], ["--budget: must be > 0 s", value])
            for command in (["design", "va12"], ["run", "va12"], ["compare", "va12"], ["diagnose", "va12", "PROFILE"])
            for value in ("0", "-1", "nan", "inf")
        ),
        (["design", "emps"], ["emps", "problem"]),
        (["design", "va12", "--speed", "3"], ["--speed"]),
        (["verify", "nowhere"], ["nowhere", "excite design"]),
        (["simulate", "va12", "nothing.csv", "--out", "log.csv"], ["nothing.csv", "no such file"]),
        (["simulate", "va12_straight", "PROFILE", "--out", "log.csv", "--noise", "loud"], ["loud", "on, off"]),
        (["simulate", "va12_straight", "PROFILE", "--out", "log.doc"], [".doc", ".csv"]),
        (["simulate", "va12_straight", "PROFILE", "--out", "log.csv", "--kit", "gold"], ["gold", "paper, full"]),
        (
            ["simulate", "va12_straight", "PROFILE", "--out", "log.csv", "--friction", "dry"],
            ["--friction", "smoothed, set-valued"],
        ),
        (
            [
                *("simulate", "va12_straight", "PROFILE", "--out", "log.csv", "--friction", "set-valued"),
                *("--effect", "friction_transition@front_roll=0.5"),
            ],
            ["friction_transition@front_roll", "never sticks"],
        ),
        (["simulate", "va12_straight", "PROFILE"], ["--out"]),
        (["simulate", "va12", "PROFILE", "--out", "log.csv"], ["u2_Nm", "va12"]),
        (["identify", "va12"], ["LOG"]),
        (["identify", "va12", "nothing.csv"], ["nothing.csv", "no such file"]),
        (["identify", "va12_straight", "PROFILE", "--method", "guess"], ["guess", "allowed", "ols"]),
        (["identify", "va12_straight", "PROFILE", "--out", "PROFILE"], ["is a file"]),
        (["simulate", "va12_straight", "PROFILE", "--out", "PROFILE"], ["is what the log is made from"]),
        (["run", "va12_straight", "--kit", "gold"], ["gold", "paper, full"]),
        (["run", "va12_straight", "--method", "guess"], ["guess", "allowed", "ols"]),
    ],
)
def test_bad_usage_is_one_clear_line(
    arguments: list[str],
    words: list[str],
    profile: Path,
    tmp_path: Path,
    excite: Excite,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    empty = tmp_path / "work"
    empty.mkdir()
    monkeypatch.chdir(empty)
    code, stdout, stderr = excite(*(str(profile) if a == "PROFILE" else a for a in arguments))
    assert (code, stdout) == (2, "")
    assert stderr.startswith("excite: ")
    assert stderr.count("\n") == 1
    for word in words:
        assert word in stderr
    assert list(empty.iterdir()) == []


def test_what_is_not_ours_is_not_overwritten(profile: Path, tmp_path: Path, excite: Excite) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    code, _, stderr = excite("identify", "va12_straight", profile, "--out", mine)
    assert code == 2
    assert "choose another" in stderr
    assert (mine / "thesis.txt").read_text() == "years of work"


def test_a_machine_file_is_kept(profile: Path, tmp_path: Path, excite: Excite) -> None:
    """One that stands in a result of ours, as `excite diagnose` writes it."""
    own, log = tmp_path / "o" / "machine.toml", tmp_path / "log.csv"
    own.parent.mkdir()
    own.write_text('extends = "va12_straight"\nname = "mine"\n')
    (own.parent / "summary.json").write_text("{}")
    excite("simulate", own, profile, "--out", log)
    code, _, stderr = excite("identify", own, log, "--method", "ols", "--out", own.parent)
    assert (code, "machine.toml, choose another --out" in stderr) == (2, True)
    code, _, stderr = excite("simulate", own, profile, "--out", own.with_suffix(".csv"))
    assert (code, stderr) == (0, "")
    assert own.read_text().startswith("extends")


@pytest.mark.slow
def test_a_second_run_replaces_the_first(profile: Path, tmp_path: Path, excite: Excite) -> None:
    excite("simulate", "va12_straight", profile, "--out", tmp_path / "log.csv")
    for _ in range(2):
        code, _, _ = excite(
            "identify", "va12_straight", tmp_path / "log.csv", "--method", "ols", "--out", tmp_path / "o"
        )
        assert code == 0
    assert {p.name for p in tmp_path.iterdir()} == {"profile.csv", "log.csv", "o"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.drop(columns="u4_Nm"), ["u4_Nm"]),
        (lambda t: t.drop(columns="t_s"), ["t_s"]),
        (lambda t: t.assign(u1_Nm=t["u1_Nm"].where(t.index != 40)), ["row 41", "u1_Nm", "NaN"]),
        (lambda t: t.iloc[::-1], ["t_s", "goes back"]),
        (lambda t: t.drop(index=range(50, 70)), ["gap"]),
        (lambda t: t.iloc[::4], ["25 Hz"]),
        (lambda t: t.head(1), ["only 1 row"]),
        (lambda t: t.assign(u1_Nm=1e6), ["u1_Nm", "unit"]),
    ],
)
def test_broken_profiles_are_one_clear_line(
    change: object, words: list[str], profile: Path, tmp_path: Path, excite: Excite
) -> None:
    assert callable(change)
    broken = tmp_path / "broken.csv"
    table: pd.DataFrame = change(pd.read_csv(profile))
    table.to_csv(broken, index=False)
    code, stdout, stderr = excite("simulate", "va12_straight", broken, "--out", tmp_path / "log.csv")
    assert (code, stdout) == (2, "")
    assert stderr.count("\n") == 1
    for word in [*words, str(broken)]:
        assert word in stderr
    assert not (tmp_path / "log.csv").exists()


def test_killed_run_leaves_nothing_that_looks_finished(profile: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    for delay in (0.2, 0.9, 1.4):
        run = subprocess.Popen(
            [sys.executable, "-m", "excite", "design", "va12_straight", "--out", out],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(delay)
        run.kill()
        run.wait()
        assert not out.exists()


ENDING = """
import signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)
from excite import __main__ as program

def app(**_):
    threading.Thread(target=sys.stdin.read).start()  # as the processes of a design, which are waited for
    raise KeyboardInterrupt

program.app = app
program.main()
"""


def test_a_second_ctrl_c_does_not_disturb_the_end_of_the_first() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", ENDING], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stderr is not None
        said = run.stderr.readline()
        for _ in range(3):
            time.sleep(0.1)
            run.send_signal(signal.SIGINT)
        _, more = run.communicate("", timeout=60)
    assert said.startswith("excite: interrupted, nothing was written: the machine was being read")
    assert (more, run.returncode) == ("", 130)


@pytest.mark.parametrize(
    ("reason", "said"), [("slip 3.6 % over", "slip 3.6 % over"), ("", "verifying was at step 3 of 8")]
)
def test_a_stop_ends_with_a_reason_in_words(reason: str, said: str) -> None:
    def stopped_work() -> None:
        with terminal.bar("verifying") as advance:
            advance(3, 8, None)
            raise KeyboardInterrupt(*([reason] if reason else []))

    with pytest.raises(StoppedError, match=f"interrupted, nothing was written: {said}"):
        stopped_work()


def test_a_function_refuses_counts_and_torques_that_are_none(straight: Model) -> None:
    for call in (
        lambda: package.design(straight, starts=0),
        lambda: package.compare(straight, samples=0),
        lambda: package.verify(straight, "a.csv", runs=1.5),  # type: ignore[arg-type]
        lambda: package.simulate(straight, "a.csv", seed=-1),
    ):
        with pytest.raises(UsageError, match=r"(starts|samples|runs|seed): must be a whole number of at least [01]"):
            call()
    with pytest.raises(UsageError, match=r"drive: torques need shape \(N >= 2, 2\) for u1, u4 \(got \(5, 5\)\)"):
        package.simulate(straight, np.zeros((5, 5)))

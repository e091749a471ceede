"""One declaration, one file or one function each: effects, machines, objectives, limits, methods, usual drives.

What is added in one place is there for every command, in help, errors, pages and studies, without any other change.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest
import test_effects
from support.commands import Excite
from support.drives import drive
from trajectories.test_design import test_objective_slope_and_curvature as slope_and_curvature

from excite.cli import app, reference
from excite.diagnosis import score_test
from excite.errors import MachineError
from excite.identification import Estimate, linear_methods, methods
from excite.logs import Log, inspection, log, profile as profiles
from excite.model import Model, build
from excite.model.effects import CATALOGUE, Effect, placing
from excite.model.machine import Filter, Problem, machine
from excite.simulation import simulate
from excite.trajectories import Manoeuvre, baselines, collocation, compose_objective, limits, objective
from excite.trajectories.continuation import STAGES, run_stages, start_from_multisine
from excite.trajectories.excitation import knot_times
from excite.trajectories.limits import LimitKind, SampleSymbols
from excite.trajectories.objective import Objective
from excite.workflows import Study, machine_check, requests, study_plan

ROOT = Path(__file__).parents[1]
STICKY = Effect(
    "sticky_spot",
    ("contacts",),
    "N m",
    "a torque against the motion in one half of a turn",
    "a torque error in half of every turn",
    "made up for this test",
    lambda site: 80.0,
    torque=lambda s, k, p: -p["A"] * s.sign(k) * (1 + ca.tanh(ca.sin(s.q[k]) / 0.1)) / 2,
)


def spread(variances: ca.SX, sharp: ca.SX) -> ca.SX:
    """log of the mean relative standard deviation."""
    return ca.logsumexp(ca.log(variances) / 2)


def wheelspin(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[limits.BoundedExpression]:
    """How much faster the front roll turns than the rear one."""
    front, rear = (s.nu[model.coordinates.index(c)] for c in ("theta1", "theta4"))
    yield "wheelspin", front - rear, -0.02, 0.02, "rad/s"


def halves(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Half of what least squares finds."""
    found = linear_methods.ols(model, logs, filter)
    return Estimate(**{**vars(found), "method": "halves", "value": found.value / 2})


def stamp(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    """Forward and back, once."""
    t = knot_times(problem)
    wave = np.sin(2 * np.pi * t / t[-1])
    return Manoeuvre(t, np.outer(wave, [2000.0] * len(model.inputs)))


@pytest.fixture
def problem(straight: Model) -> Problem:
    whole = straight.machine.problems["S40"]
    return whole.model_copy(update={"duration_s": whole.duration_s.model_copy(update={"value": 6.0})})


@pytest.fixture
def profile(straight: Model, tmp_path: Path) -> Path:
    torque = drive(straight, 12, 1, {"u1": 1500, "u4": 1500})
    path = tmp_path / "profile.csv"
    profiles.profile_of(straight, simulate(straight, torque)).to_csv(path, index=False)
    return path


def study(**axes: object) -> Study:
    return Study.model_validate({"name": "one", "grid": {"machine": "va12_straight", **axes}})


def test_a_new_effect_is_one_declaration(
    monkeypatch: pytest.MonkeyPatch, excite: Excite, va12: Model, profile: Path, tmp_path: Path
) -> None:
    """Simulated, a parameter of the regressor, estimated, a candidate of the diagnosis, documented, tested."""
    monkeypatch.setitem(CATALOGUE, STICKY.name, STICKY)
    wanted = "sticky_spot@rear_roll=80"
    logs = []
    for effect in ((), ("--effect", wanted)):
        logs.append(tmp_path / f"log{len(effect)}.csv")
        code, _, err = excite("simulate", "va12_straight", profile, *effect, "--out", logs[-1])
        assert code == 0, err
    without, sticky = (pd.read_csv(path)["theta4_rad"].to_numpy() for path in logs)
    assert np.abs(without - sticky).max() > 0.05
    # the regressor
    model = build(placing.with_effects(va12.machine, placing.parse_effect(wanted, va12.machine, 10.0)))
    assert model.base.names[-1] == "sticky_spot@rear_roll"
    q, nu, a, u, z = test_effects.samples(model)
    assert np.abs(model.stacked_regressor(q, nu, a, u, z)[:, 5, -1]).max() > 0.9
    # estimated with the other parameters, by a machine file that holds it
    own = tmp_path / "own.toml"
    amount = '{ value = 40, source = "assumed" }'
    own.write_text(
        'extends = "va12_straight"\nname = "own"\n[[effect]]\nname = "sticky_spot"\nwhere = "rear_roll"\n'
        f"amount = {amount}\n"
    )
    known = build(machine.load_machine(own))
    found = methods.identify(known, [log.read_log(logs[1], known.machine)], "joint")
    at = found.names.index("sticky_spot@rear_roll")
    assert abs(found.value[at] - 80) < 4 * found.std[at] < 40
    # looked for
    names = {c.name for c in score_test.candidates(va12.machine, [s.name for s in va12.machine.sensors("full")], 60.0)}
    assert {"sticky_spot@front_roll", "sticky_spot@rear_roll"} <= names
    # documented, offered, named in errors, allowed in studies
    assert "## sticky_spot" in reference.effects_page()
    assert "sticky_spot" in requests.choices("effect")
    with pytest.raises(MachineError, match=r"is sticky_spot meant[?]"):
        placing.parse_effect("sticky_spots=1", va12.machine, 10.0)
    assert study_plan.plan_study(study(effects=[[], wanted])).total == 2
    # tested by the same tests as every other
    for test in (
        test_effects.test_what_an_effect_predicts_is_what_it_does,
        test_effects.test_an_effect_of_no_size_changes_nothing,
        test_effects.test_a_signature_is_what_the_extended_model_has_more,
    ):
        (mark,) = (m for m in test.pytestmark if m.name == "parametrize")
        assert STICKY in mark.args[1]
    test_effects.test_what_an_effect_predicts_is_what_it_does(STICKY)
    test_effects.test_a_signature_is_what_the_extended_model_has_more(STICKY, va12)


def test_a_new_machine_is_one_file(
    monkeypatch: pytest.MonkeyPatch, excite: Excite, profile: Path, tmp_path: Path
) -> None:
    """Beside the shipped ones, or anywhere."""
    folder = tmp_path / "machines"
    folder.mkdir()
    for name in ("va12", "va12_straight"):
        shutil.copy(machine.MACHINES / f"{name}.toml", folder)
    new = 'extends = "va12_straight"\nname = "heavy"\ntitle = "A heavy one"\ntime_column = "seconds"\n'
    (folder / "heavy.toml").write_text(new)
    monkeypatch.setattr(machine, "MACHINES", folder)
    code, shown, _ = excite("machines", "--json")
    assert code == 0
    assert [m["machine"] for m in json.loads(shown)["machines"]] == ["heavy", "va12", "va12_straight"]
    code, _, err = excite("design", "light", "--out", tmp_path / "d")
    assert (code, "allowed: heavy, va12, va12_straight" in err) == (2, True)
    assert "| heavy | full |" in reference.choices_page()
    assert study_plan.plan_study(study(machine="heavy")).total == 1
    (tmp_path / "mine.toml").write_text(new.replace("heavy", "mine"))
    for name in ("heavy", tmp_path / "mine.toml"):
        path = tmp_path / f"{Path(name).stem}.log.csv"
        code, _, err = excite("simulate", name, profile, "--out", path)
        assert code == 0, err
        assert log.read_log(path, machine.load_machine(name)).t[-1] == 12
    guessed = inspection.guess_machine(pd.read_csv(path))
    assert guessed is not None
    assert guessed.name == "heavy"
    assert machine_check.check_file(folder / "heavy.toml").model is not None


LAST = "three_wheel"  # the machine that came last


def test_the_last_machine_is_known_by_its_file_alone() -> None:
    """No line of the program names it, nor anything of it: its bodies, places, sensors and columns."""
    last, others = (
        machine.load_machine(LAST),
        [machine.load_machine(n) for n in machine.shipped_machines() if n != LAST],
    )

    def names(m: machine.Machine) -> set[str]:
        return {m.name, *(b.name for b in m.body), *(b.where for b in m.body), *(s.column for s in m.sensor)}

    own = {n for n in names(last) if "_" in n} - {n for m in others for n in names(m)}
    assert {LAST, "left_roll", "right_roll_Nm"} <= own
    for path in [*(ROOT / "excite").rglob("*.*"), *(ROOT / "model").glob("*.py")]:
        if path.suffix in (".py", ".html", ".toml"):
            words = set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
            assert not words & own, path


@pytest.mark.slow
def test_a_machine_of_another_kind_is_one_file(excite: Excite, tmp_path: Path) -> None:
    """The last machine's table under names that nothing has ever heard of, from check to the cab, by the commands."""
    text = (machine.MACHINES / f"{LAST}.toml").read_text(encoding="utf-8")
    for word, other in (("three_wheel", "tricycle"), ("roll", "tyre"), ("fork", "stem"), ("steering", "handlebar")):
        text = text.replace(word, other)
    path, d = tmp_path / "tricycle.toml", tmp_path / "d"
    path.write_text(text, encoding="utf-8")

    def run(*command: object) -> dict[str, Any]:
        code, shown, err = excite(*command, "--json")
        assert code == 0, err
        return dict(json.loads(shown))

    run("machine", "check", path, "--out", tmp_path / "c")
    assert run("design", path, "--duration", 8, "--starts", 1, "--budget", 60, "--out", d)["max_violation"] <= 1e-3
    code, _, err = excite("simulate", path, d / "profile.csv", "--out", tmp_path / "log.csv")
    assert code == 0, err
    found = run("identify", path, tmp_path / "log.csv", "--out", tmp_path / "i")
    assert found["parameters"]["M"]["std_percent"] < 5
    assert "handlebar_rad" in run("drive", d, "--phases", 3, "--out", tmp_path / "cab")["phases"][0]


def test_a_new_objective_is_one_function(
    monkeypatch: pytest.MonkeyPatch, excite: Excite, straight: Model, problem: Problem, tmp_path: Path
) -> None:
    monkeypatch.setitem(objective.OBJECTIVES, "spread", Objective(spread, "variances", True))
    goal = compose_objective(straight, "spread")
    begun = start_from_multisine(straight, problem, goal, 0, 1)
    found = run_stages(straight, problem, goal, begun, STAGES[:1], lambda: False)
    assert found.latest.score < begun.latest.score
    slope_and_curvature()
    offered(excite, "design", "objective", "spread")
    assert "| spread | log of the mean relative standard deviation. | variances | yes |" in reference.choices_page()
    assert study_plan.plan_study(study(objective=["cond", "spread"])).total == 2
    assert objective.describe_value("spread", objective.reported_value("spread", 1.5)) == "objective spread 1.5"


def test_a_new_limit_is_one_function(monkeypatch: pytest.MonkeyPatch, straight: Model, problem: Problem) -> None:
    """In the program that designs, in the check of what was designed, in studies where the machine file states it."""
    monkeypatch.setitem(limits.LIMITS, "wheelspin", LimitKind(wheelspin, ("body.limit.rim_speed",)))
    torque = drive(straight, 6, 1, {"u1": 3000, "u4": -3000})
    assert limits.check_limits(straight, problem, simulate(straight, torque))["wheelspin"] > 0.01
    still = simulate(straight, 0 * torque)
    assert limits.check_limits(straight, problem, still)["wheelspin"] == 0
    sizes = dict.fromkeys(straight.coordinates, 1.0) | {c + "'": 1.0 for c in straight.coordinates}
    assert "wheelspin" in collocation.transcribe(straight, problem, sizes, 10, still).limit_names
    assert "| wheelspin | How much faster the front roll turns than the rear one. |" in reference.choices_page()
    assert study_plan.plan_study(study(limits=[{"wheelspin": 0.5}])).total == 1
    with pytest.raises(ValueError, match=r"allowed: torque.*wheelspin"):
        study(limits=[{"charm": 2}])


def test_a_new_method_is_one_function(
    monkeypatch: pytest.MonkeyPatch, excite: Excite, straight: Model, profile: Path, tmp_path: Path
) -> None:
    monkeypatch.setitem(methods.METHODS, "halves", methods.Method(halves))
    excite("simulate", "va12_straight", profile, "--out", tmp_path / "log.csv")
    out, one = tmp_path / "found", log.read_log(tmp_path / "log.csv", straight.machine)
    code, shown, err = excite("identify", "va12_straight", one.source, "--method", "halves", "--out", out, "--json")
    assert code == 0, err
    assert json.loads(shown)["method"] == "halves"
    # half a machine explains no log; tolerances of the file take a part of the blame
    assert json.loads(shown)["parameters"]["M"]["value"] == methods.identify(straight, [one], "halves").value[0]
    half = linear_methods.ols(straight, [one], straight.machine.filter).value[0] / 2
    assert json.loads(shown)["parameters"]["M"]["value"] == pytest.approx(half, rel=0.05)
    assert json.loads(shown)["status"] == "doubtful"
    for command in ("identify", "verify", "run"):
        offered(excite, command, "method", "halves")
    assert "| halves | Half of what least squares finds. | none | yes |" in reference.choices_page()
    assert study_plan.plan_study(study(method=["ols", "halves"])).total == 2
    sloping = build(
        placing.with_effects(straight.machine, placing.parse_effect("ground_slope=0.01", straight.machine, 9.0))
    )
    with pytest.raises(MachineError, match="method halves doesn't know effects, use ols or joint"):
        methods.identify(sloping, [one], "halves")


def test_a_new_usual_drive_is_one_function(
    monkeypatch: pytest.MonkeyPatch, excite: Excite, straight: Model, problem: Problem
) -> None:
    monkeypatch.setitem(baselines.BASELINES, "stamp", baselines.Baseline(stamp))
    made = baselines.BASELINES["stamp"].make(straight, problem, 0, 1.0)
    found, _ = baselines.score_drive(straight, problem, baselines.scale_into_limits(straight, problem, made))
    assert all(v == 0 for name, v in found.violations.items() if not name.startswith(("rest", "lane")))
    offered(excite, "compare", "against", "stamp")
    assert "| stamp | Forward and back, once. | no |" in reference.choices_page()
    code, _, err = excite("compare", "va12_straight", "--against", "waltz")
    assert (code, err.endswith("hand-made, stamp\n")) == (2, True)


def offered(excite: Excite, command: str, option: str, name: str) -> None:
    """In the command's help, in the page of commands, in the shell's completion."""
    code, shown, _ = excite(command, "--help")
    assert code == 0
    assert name in " ".join(shown.split())
    page = reference.commands_page(app).split(f"## excite {command}\n")[1].split("\n## ")[0]
    (line,) = (line for line in page.splitlines() if line.startswith(f"| `--{option}` |"))
    assert line.endswith(f"{name} |")
    assert name in requests.choices(option)


ADDED = {
    "excite/trajectories/objective.py": """

def spread(variances: ca.SX, sharp: ca.SX) -> ca.SX:
    return ca.logsumexp(ca.log(variances) / 2)


OBJECTIVES["spread"] = Objective(spread, "variances", True)
""",
    "excite/trajectories/limits.py": """

def _wheelspin(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    a, b = (s.nu[model.coordinates.index(c)] for c in ("theta1", "theta4"))
    yield "wheelspin", a - b, -0.02, 0.02, "rad/s"


LIMITS["wheelspin"] = LimitKind(_wheelspin)
""",
    "excite/trajectories/baselines.py": """

def stamp(model: Model, problem: Problem, seed: int, seconds: float) -> Manoeuvre:
    t = excitation.knot_times(problem)
    return Manoeuvre(t, np.outer(np.sin(2 * np.pi * t / t[-1]), [2000.0] * len(model.inputs)))


BASELINES["stamp"] = Baseline(stamp)
""",
    "excite/identification/methods.py": """

METHODS["twice"] = Method(lambda model, logs, filter: ols(model, logs, filter))
""",
    "model/machines/heavy.toml": 'extends = "va12_straight"\nname = "heavy"\ntitle = "A heavy one"\n'
    '[problems.S40]\nduration_s = { value = 8, source = "definition" }\n',
}


@pytest.mark.slow
def test_the_same_written_into_a_copy_of_the_program(tmp_path: Path) -> None:
    """By the real commands and their processes: the new machine's drive for the new objective, in the new limit."""
    for package in ("excite", "model"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"), symlinks=True)
    for name, text in ADDED.items():
        with (tmp_path / name).open("a", encoding="utf-8") as file:
            file.write(text)

    def run(*command: object) -> dict[str, object]:
        done = subprocess.run(
            [sys.executable, "-m", "excite", *map(str, command), "--json"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            capture_output=True,
            text=True,
            check=False,
            timeout=900,
        )
        assert done.returncode == 0, done.stderr
        return dict(json.loads(done.stdout))

    said = run("design", "heavy", "--objective", "spread", "--starts", 1, "--out", "d")
    assert said["violations"]["wheelspin"] <= 1e-3  # type: ignore[index]
    assert run("verify", "d", "--runs", 2, "--method", "twice", "--out", "v")["method"] == "twice"
    found = run("compare", "heavy", "--against", "stamp", "--budget", 90, "--out", "c")
    assert [d["name"] for d in found["designs"]] == ["designed", "stamp"]  # type: ignore[attr-defined]

"""A machine file to start from, what is wrong or doubtful in one, and the machine from above."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from support.commands import Excite

from excite.cli import machine_template
from excite.errors import MachineError
from excite.logs import log
from excite.model import Model, build
from excite.model.machine import MEANINGS, Machine, load_machine, machine_tables, shipped_machines
from excite.model.mechanics import tree
from excite.reports import top_view
from excite.simulation import Motion, sensors
from excite.workflows import machine_check, machine_units

FRESH = machine_template.fresh("mine", Path("mine.toml"))


def spoilt(tmp_path: Path, *changes: tuple[str, Any]) -> Path:
    """The file to start from with some keys changed: "body.1.limit.torque.value" and what is written there."""
    raw = tomllib.loads(FRESH)
    for key, value in changes:
        *way, last = key.split(".")
        at: Any = raw
        for step in way:
            at = at[int(step)] if isinstance(at, list) else at[step]
        if value is None:
            del at[int(last) if isinstance(at, list) else last]
        else:
            at[int(last) if isinstance(at, list) else last] = value
    path = tmp_path / "mine.toml"
    path.write_text(tomli_w.dumps(raw), encoding="utf-8")
    return path


def assumed(value: float) -> dict[str, Any]:
    return {"value": value, "source": "assumed"}


# ---------------------------------------------------------------------------------------------------- to start from
def test_the_file_to_start_from_is_beyond_doubt(tmp_path: Path) -> None:
    found = machine_check.check_file(spoilt(tmp_path))
    assert (found.faults, found.doubts) == ((), ())
    assert found.model is not None
    assert set(found.sigma_percent) == set(found.model.base.names)
    assert 0 < max(found.sigma_percent.values()) < machine_check.POORLY_IDENTIFIABLE


@pytest.mark.parametrize("name", ["", "2wd", "my machine", "va12", "../x", "röller"])
def test_a_name_that_cannot_be_one_is_refused(name: str) -> None:
    with pytest.raises(MachineError):
        machine_template.fresh(name, Path("x.toml"))


@pytest.mark.parametrize("name", shipped_machines())
def test_a_shipped_machine_is_copied_whole_with_its_keys_explained(name: str) -> None:
    text = machine_template.whole("mine", Path("mine.toml"), name)
    _, tables, _ = machine_tables(name)
    assert tomllib.loads(text) == tables | {"name": "mine"}
    known = {key for record in MEANINGS.values() for key in record}
    for line in text.splitlines():
        key = re.match(r"(\w+) = ", line)
        assert key is None or key[1] not in known or " # " in line, line
    if name == "tandem":
        assert 'mass = { value = 5200, source = "assumed" } # [kg]' in text.splitlines()


# ------------------------------------------------------------------------------------------------- wrong, doubtful
WRONG = {
    "negative inertia": ([("body.0.inertia.ZZ.value", -5)], "must be >= 0 (got -5)"),
    "no spin inertia": (
        [("body.1.inertia.ZZ.value", 0), ("scale.ZZ1", assumed(80))],
        "theta1: neither mass nor inertia",
    ),
    "no such body": (
        [("body.0.inertia.XX", assumed(100)), ("body.0.inertia.YY", assumed(100))],
        "front_frame: inertia: principal moments 100, 100, 1800",
    ),
    "negative moment": (
        [("body.0.inertia.XY", assumed(3000))],
        "front_frame: inertia: has a negative principal moment",
    ),
    "weaker than friction": ([("body.1.limit.torque.value", 90)], "front_axle: limit.torque: 90 is not above"),
    "too slow to move": ([("body.2.limit.torque_rate.value", 10)], "rear_frame: limit.torque_rate: in 30 s"),
    "lane too small": ([("problems.T30.lane_m", [1.0, 1.0])], "problems.T30.lane_m: lane_points 2.4 m apart"),
    "no torque measured": ([("sensor.5", None)], "sensor: none of kind torque on joint 1 (front_axle)"),
    "rolls the wrong way": ([("body.1.alpha.value", "pi/2")], "front_axle: contact: must turn about y"),
    "one length of a lane": ([("problems.T30.lane_m", [60.0])], "problems.T30.lane_m[1]: is missing"),
    "a lane without lengths": ([("problems.T30.lane_m", [])], "problems.T30.lane_m[0]: is missing"),
    "gravity on a plane": ([("gravity", [0.0, 0.0])], "gravity[2]: is missing"),
    "a place of one coordinate": (
        [("body.0.inertia.com.value", [0.2])],
        "front_frame: inertia.com.value[2]: is missing",
    ),
    "two wheels in one place, no gyro": (
        [("sensor.4.lateral.value", 1.1), ("sensor.8", None)],
        "two measuring wheels apart",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said(case: str, tmp_path: Path) -> None:
    changes, says = WRONG[case]
    found = machine_check.check_file(spoilt(tmp_path, *changes))
    assert [line for line in found.faults if says in line], found.faults
    assert found.sigma_percent == {}


def test_wrong_names_of_a_file_that_extends_another_are_all_said_with_their_lines(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    wrong = ("[body.front_rol.friction]", "[body.rear_roll.frictoin]", "[sensor.yawrate]", "[senso.u1]")
    file.write_text(
        f'extends = "va12"\nname = "mine"\n{wrong[0]}\nFv = 3\n' + "\nx = 1\n".join(wrong[1:]) + "\nx = 1\n"
    )
    found = machine_check.check_file(file).faults
    for line, said in (
        (3, "body.front_rol: no such body, allowed: front_chassis, .*did you mean front_roll"),
        (5, "rear_roll: frictoin: no such key.*did you mean friction"),
        (7, "sensor.yawrate: no such sensor.*did you mean yaw_rate"),
        (9, "senso: no such key.*did you mean sensor"),
    ):
        assert [one for one in found if re.search(rf"^line {line}: {said}", one)], (line, found)
    assert any(one.startswith("front_roll: friction.Fv: ") for one in found)  # read as probably meant
    with pytest.raises(MachineError, match=r"mine.toml: body.front_rol: no such body.*did you mean front_roll"):
        load_machine(str(file))


DOUBTFUL = {
    "no traction": (
        [("body.1.contact.Kx.value", -260), ("body.3.contact.Kx.value", -310)],
        "contacts: with all slip that is allowed they push 85.5 N",
    ),
    "stiff as rock": ([("body.1.contact.Ky.value", -5e7)], "front_axle: contact.Ky: 5e+07 N per slip"),
    "a speed never reached": (
        [("body.1.friction.Fv.value", 2000)],
        "front_axle: limit.rim_speed: 2 m/s is never reached",
    ),
    "degrees": ([("body.2.limit.position.value", 35)], "rear_frame: limit.position: 35 rad is beyond a turn"),
    "no limit": ([("body.2.limit.torque", None)], "rear_frame: limit: torque not given"),
    "millimetres": ([("body.0.inertia.com.value", [200.0, 0.0, 0.0])], "front_frame: inertia.com: 200 m"),
    "more than a disc": ([("body.1.inertia.ZZ.value", 900)], "more than a flat disc"),
    "a scale in vain": ([("scale.MX0", assumed(5))], "scale.MX0: does nothing, the base parameter is called MX0R"),
    "nearly zero": ([("body.0.inertia.com.value", [0.2, 0.001, 0.0]), ("scale.MY0", None)], "MY0: 2 kg m"),
    "a measuring wheel in millimetres": (
        [("sensor.3.radius.value", 330)],
        "sensor wheel_left: radius: 330 m, usual are 0.02 to 2: in mm",
    ),
    "a measuring wheel like a pea": ([("sensor.3.radius.value", 0.01)], "sensor wheel_left: radius: 0.01 m, usual"),
    "a measuring wheel far away": (
        [("sensor.4.lateral.value", -1100)],
        "sensor wheel_right: lateral: -1100 m, usual are 10 at most: in mm?",
    ),
    "a roll in millimetres": (
        [("body.1.contact.radius.value", 550), ("body.1.limit.rim_speed.value", 2000)],
        "front_axle: contact.radius: 550 m, usual are 5 at most: in mm?",
    ),
    "a width in millimetres": ([("body.3.contact.width.value", 2400)], "rear_axle: contact.width: 2400 m, usual"),
    "slip in per cent": (
        [("body.1.contact.slip_limit.value", 15)],
        "front_axle: contact.slip_limit: 15, the linear law holds to about 0.15: in per cent?",
    ),
    "a rate in degrees": (
        [("body.2.limit.rate.value", 20)],
        "rear_frame: limit.rate: 20 rad/s, steered joints turn by less than 3.5: in deg/s?",
    ),
    "a drive in milliseconds": (
        [("problems.T30.duration_s.value", 30000)],
        "problems.T30.duration_s: 30000 s, usual are 3600 at most: in ms?",
    ),
    "samples in kilohertz": ([("sampling_hz.value", 1e5)], "sampling_hz: 100000 Hz, usual are 10000 at most"),
    "a decimation that undoes the filter": (
        [("filter.decimation", 50)],
        "filter.decimation: one row in 50 at 100 Hz shows motion up to 1 Hz, below filter.cutoff_hz 3: at most 16",
    ),
    "a root that turns without inertia": ([("body.0.inertia.ZZ", None)], "front_frame: inertia.ZZ: 0 kg m2 with 2000"),
    "a frame that turns without inertia": (
        [("body.2.inertia.ZZ", None), ("scale.ZZ2", assumed(2000))],
        "rear_frame: inertia.ZZ: 0 kg m2 with 2600 kg, a body that turns has one",
    ),
    "a slope in per cent": (
        [("effect", [{"name": "ground_slope", "amount": assumed(3.0)}])],
        "effect ground_slope@machine: 3 rad, usual are about 0.005: in another unit?",
    ),
    "no noise": ([("sensor.5.noise", None)], "sensor u_front: neither noise nor counts_per_turn"),
}


@pytest.mark.parametrize("case", DOUBTFUL)
def test_what_is_doubtful_is_said(case: str, tmp_path: Path) -> None:
    changes, says = DOUBTFUL[case]
    model = build(load_machine(spoilt(tmp_path, *changes)))
    lines = [line for rule in machine_check.DOUBTS for line in rule(model)]
    assert [line for line in lines if says in line], lines
    assert [line for rule in machine_check.FAULTS for line in rule(model)] == []


def test_a_parameter_that_no_drive_shows_well_is_doubtful(tmp_path: Path) -> None:
    """Friction of a hundredth of a newton metre beside noise of 30."""
    found = machine_check.check_file(spoilt(tmp_path, ("body.1.friction.Fs.value", 0.01)))
    assert [line for line in found.doubts if line.startswith("Fs1: random drives leave it uncertain")] == list(
        found.doubts
    )


def test_everything_wrong_is_said_at_once(tmp_path: Path) -> None:
    """Keys, names, signs, physics and doubts together, each with its line, and what was meant by what is misspelt."""
    text = machine_template.whole("mine", Path("mine.toml"), "tandem")
    changes = {
        "mass = { value = 5200": "mass = { value = -5200",  # 1
        "sampling_hz =": "samplig_hz =",  # 2
        'kind = "wheel"': 'kind = "wheal"',  # 3
        "ZZ = { value = 370": "ZZ = { value = 2",  # a doubt
        'problem = "R30"': 'problem = "R3O"',
        "torque = { value = 4000": "torque = { value = 50",  # below the friction Fs
        "rim_speed = { value = 2,": "rim_speed = { value = 7.2,",  # a doubt
    }
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    lines = text.splitlines()

    def at(part: str) -> int:
        return next(k for k, line in enumerate(lines, start=1) if line.startswith(part))

    wheal = 'kind = "wheal'
    found = machine_check.check_file(path)
    expected = (
        f"line {at('mass = { value = -')}: frame: inertia.mass: must be > 0 (got -5200)",
        f"line {at('samplig_hz')}: samplig_hz: no such key here",
        f"line {at(wheal)}: sensor measuring_left: kind: must be",
        f"line {at('problem = ')}: problem: no problem R3O, allowed: R30 (did you mean R30?)",
        f"line {at('torque = { value = 50')}: front_drum: limit.torque: 50 is not above its own friction",
    )
    for says in expected:
        assert sum(line.startswith(says) for line in found.faults) == 1, (says, found.faults)
    assert len(found.faults) == len(expected)
    for says in ("(did you mean sampling_hz?)", "(did you mean wheel?)"):
        assert sum(says in line for line in found.faults) == 1
    doubts = [line for line in found.doubts if line.startswith(f"line {at('rim_speed = { value = 7.2')}: front_drum")]
    assert any("in km/h" in line for line in doubts)


def test_a_fault_in_what_a_file_extends_has_its_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'extends = "va12"\nname = "mine"\n\n[body.front_roll.inertia]\nZZ = { value = -1, source = "asumed" }\n'
    )
    faults = machine_check.check_file(path).faults
    assert [f for f in faults if f.startswith("line 5: front_roll: inertia.ZZ: must be >= 0 (got -1)")]
    assert [f for f in faults if "inertia.ZZ.source" in f and "(did you mean assumed?)" in f]
    path.write_text(
        'extends = "va12"\nname = "mine"\n[body.front_rol.inertia]\nZZ = { value = 1, source = "assumed" }\n'
    )
    assert [f for f in machine_check.check_file(path).faults if re.search(r"^line 3: .*did you mean front_roll\?", f)]


HYDRAULIC = {
    "name": "u_front",
    "kind": "torque",
    "body": 2,
    "column": "p1",
    "return_column": "p2",
    "unit": "V",
    "factor": {"value": 4e6, "source": "assumed"},
    "displacement": {"value": 1.0e-3, "source": "assumed"},
    "noise": {"value": 35, "source": "assumed"},
    "noise_unit": "SI",
}
SLIPS: dict[str, tuple[str, float | list[float], str]] = {  # key, its value in another unit, what is said
    "cc": ("sensor.7.displacement.value", 1000.0, "in cc?"),
    "a tenth of the pressure": ("sensor.7.factor.value", 4e5, "a tenth or ten times the pressure"),
    "ten times the pressure": ("sensor.7.factor.value", 4e7, "a tenth or ten times the pressure"),
    "km/h": ("body.2.limit.rim_speed.value", 7.2, "in km/h?"),
    "mm of the table": ("body.1.d.value", 1700.0, "in mm?"),
    "degrees of the table": ("body.2.alpha.value", -90.0, "in degrees?"),
    "degrees of a gyro": ("sensor.10.noise.value", 0.115 * 57.3, "in degrees?"),
    "rpm": ("body.2.limit.rate", 31.8, "in rpm?"),
    "tonnes": ("mass", 1e-3, "in t?"),
    "grams": ("mass", 1e3, "in g?"),
    "kW": ("power_limit.value", 0.03, "in kW?"),
    "g": ("gravity", [0.0, 0.0, -1.0], "in another unit?"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_value_in_another_unit_is_doubted(slip: str) -> None:
    """One change of an otherwise undoubted machine, its drums driven by motors of 1000 cc a turn, 251 bar at most."""
    _, raw, _ = machine_tables("tandem")
    raw["sensor"][7] = copy.deepcopy(HYDRAULIC)
    key, value, says = SLIPS[slip]
    assert [line for rule in machine_units.UNIT_DOUBTS for line in rule(Machine.model_validate(raw))] == []
    at: Any = raw
    for step in key.split(".")[:-1]:
        at = at[int(step)] if isinstance(at, list) else at[step]
    last = key.split(".")[-1]
    if key == "mass":
        for body in raw["body"]:
            body["inertia"]["mass"]["value"] *= value
    else:
        at[last] = assumed(float(value)) if last == "rate" else value  # type: ignore[arg-type]
    said = [line for rule in machine_units.UNIT_DOUBTS for line in rule(Machine.model_validate(raw))]
    assert any(says in line for line in said), said


@pytest.mark.parametrize("name", shipped_machines())
def test_nothing_is_wrong_with_what_ships(name: str) -> None:
    model = build(load_machine(name))
    assert [line for rule in machine_check.FAULTS for line in rule(model)] == []


@pytest.mark.parametrize("name", shipped_machines())
def test_no_unit_is_doubtful_in_what_ships(name: str) -> None:
    assert [line for rule in machine_units.UNIT_DOUBTS for line in rule(load_machine(name))] == []


@pytest.mark.parametrize("name", shipped_machines())
def test_nothing_is_doubtful_in_what_ships(name: str) -> None:
    """But for robots and rigs, whose published descriptions have neither noise nor every limit."""
    model = build(load_machine(name))
    lines = [line for rule in machine_check.DOUBTS for line in rule(model)]
    assert not (lines and model.machine.planar), lines
    assert all("not given" in line or "neither noise nor counts" in line for line in lines)


def test_no_drive_is_tried_at_a_rate_that_no_logger_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slip of the keyboard must not take minutes."""
    monkeypatch.setattr(machine_check.trajectories, "multisine", lambda *given, **more: pytest.fail("a drive is tried"))
    found = machine_check.check_file(spoilt(tmp_path, ("sampling_hz.value", 1e6)))
    assert found.faults == ()
    assert [line for line in found.doubts if "no random drive is tried at such a rate" in line]


def test_a_pendulum_on_the_plane_is_said_to_be_unseen() -> None:
    lines = list(machine_check.describe_invisible(build(load_machine("pendulum_loader"))))
    assert lines[0] == ("pendulum: theta3 is held at zero, no drive reveals what belongs to it alone: Fv3, Fs3")
    assert "XX4" in lines[1]
    assert "YY4" in lines[1]


# ----------------------------------------------------------------------------------------------------- from above
def test_a_machine_held_on_a_line_is_said_to_be() -> None:
    lines = list(machine_check.describe_invisible(build(load_machine("va12_straight"))))
    assert lines[0] == "y0, theta0: held at zero, the machine keeps to a line"


def test_poses_are_where_the_table_puts_the_bodies() -> None:
    """The tandem's yokes turned by hand; the robot's wheels at the corners of its wheelbase and track."""
    poses = tree.body_poses(load_machine("tandem"), {"theta1": 0.3, "theta3": -0.2})
    assert poses[2][1] == pytest.approx([1.7, 0, 0])
    assert poses[1][0] @ [1, 0, 0] == pytest.approx([np.cos(0.3), np.sin(0.3), 0])
    assert poses[3][0] @ [1, 0, 0] == pytest.approx([np.cos(0.2), -np.sin(0.2), 0])
    robot = tree.body_poses(load_machine("skid_robot"), {})
    assert robot[3][1] == pytest.approx([-0.249, 0.29153, 0])
    assert robot[3][0][:, 2] == pytest.approx([0, 1, 0])


def test_the_drawing_has_every_wheel_where_it_stands() -> None:
    ax = top_view.top_view_figure(load_machine("single_drum")).axes[0]
    boxes = {tuple(np.round(p.get_xy()[:4].mean(axis=0), 3)) for p in ax.patches}  # type: ignore[attr-defined]
    assert {(0.0, 0.8), (0.0, -0.8), (2.95, 0.0), (0.0, 1.3), (0.0, -1.3)} <= boxes
    words = {t.get_text() for t in ax.texts}
    assert words == {"left wheel", "right wheel", "drum", "articulation"}
    held = {t.get_text() for t in top_view.top_view_figure(load_machine("pendulum_loader")).axes[0].texts}
    assert {"pendulum (held)", "articulation"} <= held


def test_only_vertical_driven_joints_are_steered() -> None:
    def names(machine: Machine) -> list[str]:
        return [b.where for b in top_view.steered_joints(machine)]

    assert names(load_machine("tandem")) == ["front_steering", "rear_steering"]
    assert names(load_machine("pendulum_loader")) == ["articulation"]
    assert names(load_machine("skid_robot")) == []


# ---------------------------------------------------------------------------------------------------- the commands
def test_new_then_check(tmp_path: Path, excite: Excite) -> None:
    path, out = tmp_path / "my_loader.toml", tmp_path / "out"
    code, stdout, stderr = excite("machine", "new", "my_loader", "--out", path)
    assert (code, stderr) == (0, "")
    assert str(path) in stdout
    assert load_machine(path).name == "my_loader"
    code, stdout, _ = excite("machine", "check", path, "--out", out, "--json")
    summary = json.loads(stdout)
    assert code == 0
    assert summary["usable"] is True
    assert summary["parameters"]["MX0R"]["what"] == "regrouped first moment x, front frame"
    assert summary["parameters"]["MX0R"]["stands_for"] == {"MX0": 1, "M2": -1.2, "M3": -1.2}
    tables = {"wiring.csv", "log_template.csv"}
    assert {p.name for p in out.iterdir()} == {"machine.png", "report.html", "summary.json", *tables}
    code, _, stderr = excite("machine", "new", "my_loader", "--out", path)
    assert code == 2
    assert "exists already" in stderr


def test_a_copied_roller_is_led_to_a_logger_in_rpm_and_bar(tmp_path: Path, excite: Excite) -> None:
    """Each message says what to write, and the file that follows them is right."""
    path = tmp_path / "my_roller.toml"
    assert excite("machine", "new", "my_roller", "--from", "tandem", "--out", path)[0] == 0
    text = path.read_text()
    assert "near zero; of parameters" not in text
    for old, new in (("front_drum_rad", "rpm"), ("front_drum_Nm", "bar")):
        text = re.sub(rf'(column = "{old}".*\nunit = )"[^"]*"', rf'\1"{new}"', text)
    path.write_text(text)
    code, stdout, _ = excite("machine", "check", path, "--out", tmp_path / "out")
    said = " ".join(stdout.split())
    assert code == 2
    assert "counts_per_turn: is for a column that counts, not for a rate; give its noise instead" in said
    assert "unit: 'bar' is a pressure: a torque of pressures needs return_column" in said
    rate = r'(column = "front_drum_rad".*\nunit = .*\n)counts_per_turn.*\n'
    text = re.sub(rate, r'\1noise = { value = 0.01, source = "data sheet" }\n', text)
    pressures = 'return_column = "return_bar"\ndisplacement = { value = 0.00126, source = "data sheet" }\n'
    path.write_text(text.replace('column = "front_drum_Nm"', f'{pressures}column = "front_drum_Nm"'))
    code, stdout, _ = excite("machine", "check", path, "--out", tmp_path / "out")
    assert code == 0, stdout


def test_a_faulty_file_ends_with_2_and_a_missing_one_too(tmp_path: Path, excite: Excite) -> None:
    path = spoilt(tmp_path, ("body.1.limit.torque.value", 90))
    code, stdout, _ = excite("machine", "check", path, "--out", tmp_path / "out")
    assert code == 2
    assert ": front_axle: limit.torque: 90 is not above" in " ".join(stdout.split())
    code, _, stderr = excite("machine", "check", tmp_path / "nowhere.toml", "--out", tmp_path / "no")
    assert code == 2
    assert "no such file" in stderr


def test_a_logger_of_its_own(excite: Excite, straight: Model, straight_motion: Motion, tmp_path: Path) -> None:
    """A shipped machine with other columns and units: the file is written, the columns are changed, the log is read."""
    path = tmp_path / "own.toml"
    code, _, err = excite("machine", "new", "own", "--like", "va12_straight", "--out", path)
    assert code == 0, err
    assert load_machine(path).sensors("full") == straight.machine.sensors("full")
    table = sensors.measure(straight, straight_motion, seed=1)
    odd = table.rename(columns={"t_s": "Time [ms]", "theta1_rad": "Front roll [deg]"})
    odd["Time [ms]"] *= 1000
    odd["Front roll [deg]"] = np.rad2deg(odd["Front roll [deg]"])
    odd.to_csv(tmp_path / "odd.csv", index=False, sep=";", decimal=",")
    code, shown, _ = excite("log", "check", tmp_path / "odd.csv", "--machine", "va12_straight", "--out", tmp_path / "a")
    assert code == 1
    assert "Front roll [deg]" in shown  # brackets are no markup
    code, _, err = excite("identify", "va12_straight", tmp_path / "odd.csv", "--out", tmp_path / "b")
    assert (code, "excite machine new NAME --like va12_straight" in err) == (2, True)
    text = (
        path.read_text(encoding="utf-8").replace('"t_s"', '"Time [ms]"').replace('time_unit = "s"', 'time_unit = "ms"')
    )
    path.write_text(text.replace('"theta1_rad"\nunit = "rad"', '"Front roll [deg]"\nunit = "deg"'), encoding="utf-8")
    read = log.read_log(tmp_path / "odd.csv", load_machine(path))
    assert read.values["theta1"] == pytest.approx(table["theta1_rad"].to_numpy(), abs=1e-9)
    assert 'For a speed instead of an angle (unit = "rpm")' in text
    assert "delete counts_per_turn and give its noise [rad/s]" in text
    speed = text.replace(
        '"theta1_rad"\nunit = "rad"\ncounts_per_turn = { value = 8192.0', '"rpm"\nunit = "rpm"\nnoise = { value = 0.01'
    )
    path.write_text(speed, encoding="utf-8")
    assert load_machine(path).sensor[0].is_rate
    code, _, err = excite("machine", "new", "other", "--like", "va13", "--out", tmp_path / "other.toml")
    assert (code, "--like: va13 is unknown, allowed: double_loader" in err) == (2, True)


def test_zeros_that_no_motion_shows_are_named() -> None:
    table: Any = tomllib.loads((Path(__file__).parents[1] / "support" / "two_joints.toml").read_text())
    for sensor in table["sensor"]:
        if sensor["kind"] == "angle":
            sensor["zero"] = "sought"
    upright = build(Machine.model_validate(table | {"gravity": [0.0, 0.0, -9.81]}))
    first, second = list(machine_check.describe_invisible(upright))[-2:]
    assert first.startswith("q10: no motion shows the encoder zero of upper_arm")
    assert second.startswith("q20: the encoder zero of forearm shows only together with MX2, MY2")
    hanging = list(machine_check.describe_invisible(build(Machine.model_validate(table))))
    assert [line[:4] for line in hanging if line.startswith("q")] == ["q20:"]

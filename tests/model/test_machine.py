"""Machine files: what ships, what a file may leave out, and one clear line for every kind of broken one."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from excite.errors import MachineError
from excite.model import build, standard_parameters
from excite.model.machine import MACHINES, Body, Machine, extends, load_machine, machine_files, shipped_machines

VA12 = (MACHINES / "va12.toml").read_text(encoding="utf-8")
EMPS = (MACHINES / "emps.toml").read_text(encoding="utf-8")


# -------------------------------------------------------------------------------------------------- what ships
def test_the_contracts_machines_ship() -> None:
    assert {"va12", "va12_straight", "emps"} <= set(shipped_machines())


@pytest.mark.parametrize("name", shipped_machines())
def test_shipped_machines_load_and_build(name: str) -> None:
    machine = load_machine(name)
    assert machine.name == name
    assert len(build(machine).base.names) > 0


@pytest.mark.parametrize("name", shipped_machines())
def test_every_number_says_where_it_comes_from(name: str) -> None:
    """A number stands in a table with its source. Labels, counts of a filter and a lane's size are no data."""
    labels = {"index", "body", "antecedent", "lane_points", "order", "decimation", "drop", "lane_m", "gravity"}
    labels.add("time_offset")  # of a logger's clock
    labels.add("ends")  # of a shape, whose radius says where both come from

    def bare(node: Any, key: str, where: str) -> list[str]:
        if isinstance(node, dict):
            known = {"value"} if "source" in node else set()
            return [w for k, v in node.items() if k not in known for w in bare(v, k, f"{where}.{k}")]
        if isinstance(node, list):
            return [w for k, v in enumerate(node) for w in bare(v, key, f"{where}[{k}]")]
        return [where] if isinstance(node, int | float) and not isinstance(node, bool) and key not in labels else []

    raw = tomllib.loads((MACHINES / f"{name}.toml").read_text(encoding="utf-8"))
    assert bare(raw, "", name) == []


REFERENCE = {  # the contract's table, section 1
    "0.inertia.mass": 2600,
    "0.inertia.com": (-0.55, 0.10, 0.0),
    "0.inertia.ZZ": 2900,
    "1.inertia.mass": 1900,
    "1.inertia.ZZ": 556.32,
    "1.inertia.XX": 976,
    "1.alpha": -1.5707963267948966,
    "1.contact.radius": 0.65,
    "1.contact.width": 2.10,
    "1.contact.Kx": -1.0e5,
    "1.contact.Ky": -0.9e5,
    "1.contact.v_eps": 0.05,
    "1.contact.slip_limit": 0.15,
    "1.friction.Fv": 64.75,
    "1.friction.Fs": 174.74,
    "1.friction.u0": -183.14,
    "1.friction.smoothing": 0.02,
    "1.limit.torque": 5000,
    "1.limit.torque_rate": 10000,
    "1.limit.rim_speed": 2,
    "2.d": -1.45,
    "2.inertia.mass": 4300,
    "2.inertia.com": (-0.95, -0.10, 0.0),
    "2.inertia.ZZ": 5200,
    "2.friction.Fv": 4000,
    "2.friction.Fs": 800,
    "2.friction.u0": -150,
    "2.friction.smoothing": 0.005,
    "2.limit.torque": 15000,
    "2.limit.torque_rate": 40000,
    "2.limit.position": 0.6,
    "2.limit.rate": 0.35,
    "3.d": -1.75,
    "4.alpha": -1.5707963267948966,
    "4.inertia.mass": 2200,
    "4.inertia.ZZ": 671.33,
    "4.inertia.XX": 1144,
    "4.contact.radius": 0.65,
    "4.contact.width": 2.10,
    "4.contact.Kx": -1.2e5,
    "4.contact.Ky": -1.1e5,
    "4.friction.Fv": 82.84,
    "4.friction.Fs": 142.73,
    "4.friction.u0": -181.94,
}


@pytest.mark.parametrize("key", REFERENCE)
def test_va12_is_the_contracts_reference_machine(key: str) -> None:
    index, *path = key.split(".")
    value: Any = load_machine("va12").find(int(index))
    for step in path:
        value = getattr(value, step)
    assert value.value == REFERENCE[key]


def test_va12_is_the_contracts_tree() -> None:
    rows = [(b.index, b.antecedent, b.joint, b.actuated, b.where) for b in load_machine("va12").body]
    assert rows == [
        (0, "ground", "planar", False, "front_chassis"),
        (1, 0, "revolute", True, "front_roll"),
        (2, 0, "revolute", True, "articulation"),
        (3, 2, "fixed", False, "rear_axle_frame"),
        (4, 3, "revolute", True, "rear_roll"),
    ]
    assert load_machine("va12").coordinates == ("x0", "y0", "theta0", "theta1", "theta2", "theta4")


def test_va12_has_the_contracts_sensors() -> None:
    machine = load_machine("va12")
    paper = ["theta1_rad", "theta4_rad", "theta2_rad", "thetal_rad", "thetar_rad", "u1_Nm", "u2_Nm", "u4_Nm"]
    assert [s.column for s in machine.sensors("paper")] == paper
    assert [s.column for s in machine.sensors("full")] == [*paper, "yaw_rate_rad_s", "vy_m_s"]
    counts = {s.name: float(s.counts_per_turn) for s in machine.sensor if s.counts_per_turn}
    assert counts == {"theta1": 8192, "theta4": 8192, "theta2": 16384, "thetal": 16384, "thetar": 16384}
    noise = {s.name: float(s.noise) for s in machine.sensor if s.noise}
    assert noise == {"u1": 40, "u2": 100, "u4": 40, "yaw_rate": 0.002, "vy": 0.01}
    wheels = {s.name: (float(s.radius), float(s.lateral)) for s in machine.sensor if s.radius and s.lateral}
    assert wheels == {"thetal": (0.33, 1.25), "thetar": (0.33, -1.25)}
    assert machine.sampling_hz.value == 100


def test_resolution_of_an_encoder_is_one_count() -> None:
    theta1, u1 = (next(s for s in load_machine("va12").sensor if s.name == n) for n in ("theta1", "u1"))
    assert theta1.resolution == pytest.approx(6.283185307 / 8192)
    assert u1.resolution is None


def test_the_straight_line_is_va12_held() -> None:
    """`extends` gives everything else; what is held is neither a coordinate nor measured."""
    free, held = load_machine("va12"), load_machine("va12_straight")
    assert held.locked == ("y0", "theta0", "theta2")
    assert held.coordinates == ("x0", "theta1", "theta4")
    assert held.body == free.body
    assert [b.index for b in held.actuated] == [1, 4]
    kept = [s.column for s in held.sensors("full")]
    assert kept == ["theta1_rad", "theta4_rad", "thetal_rad", "thetar_rad", "u1_Nm", "u4_Nm"]
    assert (free.problem, held.problem) == ("R60", "S40")
    assert set(held.problems) == {"R60", "S40"}


def test_records_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        load_machine("va12").name = "other"  # type: ignore[misc]


# -------------------------------------------------------------------------------------- files beside the shipped
def write(folder: Path, text: str | bytes, name: str = "mine.toml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_file_may_extend_a_shipped_machine(tmp_path: Path) -> None:
    """Tables merge, values and lists replace."""
    path = write(
        tmp_path, 'extends = "va12"\nname = "mine"\n[filter]\ncutoff_hz = { value = 0.5, source = "measured" }\n'
    )
    machine, parent = load_machine(path), load_machine("va12")
    assert machine.name == "mine"
    assert machine.filter.cutoff_hz.value == 0.5
    assert machine.filter == parent.filter.model_copy(update={"cutoff_hz": machine.filter.cutoff_hz})
    assert machine.body == parent.body


def test_one_sensor_and_one_body_may_be_changed(tmp_path: Path) -> None:
    """By tables of their names; the rest, of them too, stays as it was, but for the note on a value that is gone."""
    own = write(
        tmp_path,
        'extends = "va12"\nname = "mine"\n[sensor.u1]\nnoise = { value = 15, source = "measured" }\n'
        '[body.front_roll.contact]\nKx = { value = -2e5, source = "assumed" }\n',
    )
    mine, plain = load_machine(own), load_machine("va12")
    for old, new in zip(plain.sensors("full"), mine.sensors("full"), strict=True):
        assert (new.model_copy(update={"noise": old.noise}) if new.name == "u1" else new) == old
        assert new.name != "u1" or float(new.noise) == 15
    for was, now in zip(plain.body, mine.body, strict=True):
        if now.name != "front_roll":
            assert now == was
            continue
        assert (float(now.contact.Kx), now.contact.Kx.note) == (-2e5, "")
        assert was.contact.Kx.note
        assert now.model_copy(update={"contact": was.contact}) == was
        assert now.contact.model_copy(update={"Kx": was.contact.Kx}) == was.contact


def test_a_file_may_extend_a_file_beside_it(tmp_path: Path) -> None:
    write(tmp_path, 'extends = "va12"\nname = "first"\nlocked = ["y0", "theta0", "theta2"]\n', "first.toml")
    machine = load_machine(write(tmp_path, 'extends = "first.toml"\nname = "second"\n', "second.toml"))
    assert machine.name == "second"
    assert machine.coordinates == ("x0", "theta1", "theta4")


@pytest.mark.parametrize(
    ("text", "value"),
    [("pi", 3.141592653589793), ("-pi/2", -1.5707963267948966), ("2*pi/3", 2.0943951023931953), ("0.5*pi", 1.5707963)],
)
def test_an_angle_may_be_a_multiple_of_pi(tmp_path: Path, text: str, value: float) -> None:
    machine = load_machine(
        write(tmp_path, VA12.replace('alpha = { value = "-pi/2"', f'alpha = {{ value = "{text}"', 1))
    )
    assert machine.find(1).alpha.value == pytest.approx(value)


def test_a_name_is_taken_for_a_shipped_machine_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, "nonsense", "va12")
    monkeypatch.chdir(tmp_path)
    assert load_machine("va12").name == "va12"


# ----------------------------------------------------------------------------------------------- broken machines
def edit(old: str, new: str, nth: int = 1, text: str = VA12) -> str:
    """The shipped file with the nth occurrence of `old` replaced."""
    parts = text.split(old)
    assert len(parts) > nth, f"{old!r} is not in the file {nth} times"
    return old.join(parts[:nth]) + new + old.join(parts[nth:])


def drop(line: str, nth: int = 1, text: str = VA12) -> str:
    """The shipped file without the nth line that starts so."""
    starts = [m.start() for m in re.finditer(rf"^{re.escape(line)}", text, re.M)]
    end = text.index("\n", starts[nth - 1])
    return text[: starts[nth - 1]] + text[end + 1 :]


def put(line: str, text: str = VA12) -> str:
    """The shipped file with another value for the one key of this line, whatever stood there."""
    key = line.split(" = ")[0]
    return re.sub(rf"^{key} = .*$", line, text, count=1, flags=re.M)


def top(line: str, text: str = VA12) -> str:
    """The shipped file with one more line above its first table."""
    return text.replace("[[body]]", f"{line}\n[[body]]", 1)


CONTACT = "\n".join(
    f"{key} = {{ value = {value}, source = 'assumed' }}"
    for key, value in {"radius": 1, "width": 1, "Kx": -1, "Ky": -1, "v_eps": 1}.items()
)

# Each: the file's text, the key that must be named, and what must be said about it (what is wrong, what is allowed).
BROKEN: dict[str, tuple[str | bytes, str, str]] = {
    # the file as such
    "not TOML": ("name = \n", "", "not a TOML file.*line 1"),
    "a bracket left open": (VA12 + "\n[problems.R61\n", "", "not a TOML file.*line"),
    "a key twice": (top('name = "again"'), "", "not a TOML file.*line"),
    "Latin-1": (
        edit("Albaret VA12", "Albaret VA12 à", text=VA12).encode("latin-1"),
        "",
        "not a TOML file.*line 1 is not UTF-8",
    ),
    "binary": (b"\x93NUMPY\x01\x00\xff", "", "not a TOML file"),
    "empty": ("", "", "missing"),
    # keys
    "missing sampling rate": (drop("sampling_hz"), "sampling_hz", "is missing"),
    "missing mass": (drop("mass"), "body[0].inertia.mass", "is missing"),
    "missing stiffness": (drop("Kx"), "body[1].contact.Kx", "is missing"),
    "missing filter": (edit("[filter]", "[problems.extra]"), "filter", "is missing"),
    "misspelt key at the top": (top('sampling = "fast"'), "sampling", "allowed: .*sampling_hz"),
    "misspelt key in a body": (edit("alpha =", "alfa =", 1), "body[1].alfa", "allowed: index, .*alpha"),
    "misspelt key in a contact": (
        edit("slip_limit", "sliplimit"),
        "body[1].contact.sliplimit",
        "allowed: .*slip_limit",
    ),
    "one key too many in an inertia": (
        edit("ZZ =", "Zz = { value = 1, source = 'assumed' }\nZZ =", 2),
        "body[1].inertia.Zz",
        "allowed: mass, com, XX",
    ),
    "one key too many in a problem": (
        edit("lane_m", "pace = 3\nlane_m"),
        "problems.R60.pace",
        "allowed: source, duration_s, knot_s",
    ),
    # numbers
    "negative mass": (edit("value = 2600", "value = -2600"), "body[0].inertia.mass", "must be > 0 .got -2600"),
    "mass of a galaxy": (
        edit("value = 2600", "value = 2e41"),
        "body[0].inertia.mass.value",
        "1e-12 and 1e12.*got 2e.41",
    ),
    "zero mass": (edit("value = 1900", "value = 0"), "body[1].inertia.mass", "must be > 0 .got 0"),
    "mass as text": (edit("value = 2600", 'value = "heavy"'), "body[0].inertia.mass.value", "must be a number"),
    "mass as true": (edit("value = 2600", "value = true"), "body[0].inertia.mass.value", "must be a number, not true"),
    "mass without source": (
        edit('{ value = 2600, source = "assumed" }', "2600"),
        "body[0].inertia.mass",
        "must be a table { value = ..., source = .* }.*got 2600",
    ),
    "NaN": (edit("value = 2900", "value = nan"), "body[0].inertia.ZZ.value", "finite.*nan"),
    "infinite": (edit("value = 2900", "value = inf"), "body[0].inertia.ZZ.value", "finite.*inf"),
    "pi over zero": (edit('"-pi/2"', '"pi/0"'), "body[1].alpha.value", "finite"),
    "negative inertia": (edit("value = 976", "value = -976"), "body[1].inertia.XX", "must be >= 0 .got -976"),
    "negative friction": (edit("value = 64.75", "value = -64.75"), "body[1].friction.Fv", "must be >= 0 .got -64.75"),
    "zero smoothing": (edit("value = 0.02,", "value = 0,"), "body[1].friction.smoothing", "must be > 0"),
    "soil that pushes": (
        edit("value = -1.0e5", "value = 1.0e5"),
        "body[1].contact.Kx",
        "must be < 0 .got 100000.*soil resists",
    ),
    "zero radius": (edit("value = 0.65", "value = 0"), "body[1].contact.radius", "must be > 0"),
    "zero counts": (edit("value = 8192", "value = 0"), "sensor[0].counts_per_turn", "must be > 0"),
    "two centres of mass": (edit("[-0.55, 0.10, 0.0]", "[-0.55, 0.10]"), "body[0].inertia.com.value[2]", "is missing"),
    "centre of mass as text": (
        edit("[-0.55, 0.10, 0.0]", '"left"'),
        "body[0].inertia.com.value",
        "list in brackets.*got 'left'",
    ),
    "unknown source": (
        edit('source = "paper"', 'source = "rumour"'),
        "body[1].alpha.source",
        "'paper', 'data sheet'.*got 'rumour'",
    ),
    "a number from nowhere": (edit(', source = "paper"', ""), "body[1].alpha.source", "is missing"),
    # the tree
    "unknown joint": (edit('"revolute"', '"sliding"'), "body[1].joint", "'revolute', 'prismatic'.*got 'sliding'"),
    "no bodies": (
        re.sub(r"\[\[body\]\].*?(?=\[\[sensor\]\])", "", "body = []\n" + VA12, flags=re.S),
        "body",
        "at least 1 .got 0",
    ),
    "carried by nothing": (
        edit("antecedent = 2", "antecedent = 7"),
        "body[3].antecedent",
        "7 is not a body above it, allowed: 0, 1, 2",
    ),
    "carried in a loop": (
        edit("antecedent = 0", "antecedent = 4", 2),
        "body[2].antecedent",
        "4 is not a body above it, allowed: 0, 1",
    ),
    "carried by itself": (edit("antecedent = 3", "antecedent = 4"), "body[4].antecedent", "4 is not a body above it"),
    "carried by a name": (
        edit("antecedent = 2", 'antecedent = "rear"'),
        "body[3].antecedent",
        "ground.*index.*got 'rear'",
    ),
    "carried by true": (edit("antecedent = 2", "antecedent = true"), "body[3].antecedent", "ground.*index.*got True"),
    "root in the air": (
        edit('antecedent = "ground"', "antecedent = 1"),
        "body[0].antecedent",
        "must stand on .ground. .got 1",
    ),
    "index twice": (edit("index = 3", "index = 2"), "body[3].index", "2 is given twice"),
    "index as a fraction": (edit("index = 3", "index = 3.5"), "body[3].index", "integer.*got 3.5"),
    "negative index": (edit("index = 3", "index = -3"), "body[3].index", "greater than or equal to 0.*got -3"),
    "one name for two bodies": (
        edit('name = "rear_roll"', 'name = "front_roll"'),
        "body[4].name",
        "front_roll is given twice",
    ),
    "name with a blank": (edit('name = "rear_roll"', 'name = "rear roll"'), "body[4].name", "pattern.*got 'rear roll'"),
    "contact on a prismatic joint": (
        edit('"revolute"', '"prismatic"'),
        "body[1].contact",
        "a revolute joint .got prismatic",
    ),
    "contact without chassis": (
        edit("[[sensor]]", f"[body.contact]\n{CONTACT}\n[[sensor]]", text=EMPS.replace("prismatic", "revolute")),
        "body[0].contact",
        "chassis on a planar root",
    ),
    "a driven fixed joint": (
        edit('joint = "fixed"', 'joint = "fixed"\nactuated = true'),
        "body[3].actuated",
        "fixed joint can't be actuated",
    ),
    "driven by perhaps": (
        edit("actuated = true", 'actuated = "perhaps"'),
        "body[1].actuated",
        "boolean.*got 'perhaps'",
    ),
    "driven without friction": (
        re.sub(r"\[body\.friction\].*?(?=\[body)", "", VA12, count=1, flags=re.S),
        "body[1].friction",
        "an actuated joint needs",
    ),
    "an angle where the coordinate stands": (
        edit("d = { value = -1.45", "theta = { value = 0.1, source = 'assumed' }\nd = { value = -1.45"),
        "body[2].theta",
        "revolute joint's coordinate takes its place",
    ),
    "nothing drives it": (re.sub(r"actuated = true\n", "", VA12), "body", "no joint is actuated"),
    "off-axis roll": (
        edit("axisymmetric = true", "axisymmetric = true\ncom = { value = [0.1, 0, 0], source = 'assumed' }"),
        "body[1].inertia.com",
        "axisymmetric.*frame's origin",
    ),
    "exponential law without its slip": (
        edit("width =", 'law = "exponential"\nwidth ='),
        "body[1].contact.saturation_slip",
        "exponential. needs it",
    ),
    "unknown law": (
        edit("width =", 'law = "sticky"\nwidth ='),
        "body[1].contact.law",
        "'linear' or 'exponential'.*got 'sticky'",
    ),
    # held coordinates
    "locked unknown": (top('locked = ["theta9"]'), "locked", "no coordinate theta9, allowed: x0, y0, theta0, theta1"),
    "everything locked": (top('locked = ["q1"]', EMPS), "locked", "nothing is left to move"),
    "a side held while the heading turns": (top('locked = ["y0"]'), "locked", "only be held where theta0"),
    "a roll held on the soil": (top('locked = ["theta1"]'), "locked", "theta1 has a contact that must turn"),
    # sensors
    "sensor on an unknown body": (edit("body = 4", "body = 9"), "sensor[1].body", "no body 9, allowed: .0, 1, 2, 3, 4"),
    "encoder on a fixed frame": (
        edit("body = 4", "body = 3"),
        "sensor[1].body",
        "body 3 has no joint.*allowed: .1, 2, 4",
    ),
    "encoder on the chassis": (
        edit("body = 4", "body = 0"),
        "sensor[1].body",
        "body 0 has no joint.*allowed: .1, 2, 4",
    ),
    "torque of a free joint": (
        edit("body = 1", "body = 0", 2),
        "sensor[5].body",
        "joint 0 isn't actuated, allowed: .1, 2, 4",
    ),
    "yaw of a machine on rails": (
        edit('kind = "torque"', 'kind = "yaw_rate"', text=EMPS),
        "sensor[1].kind",
        "planar root, allowed here: angle, torque",
    ),
    "two sensors with one column": (
        edit('"theta4_rad"', '"theta1_rad"'),
        "sensor[1].column",
        "theta1_rad is used twice",
    ),
    "a sensor in the time column": (edit('"theta4_rad"', '"t_s"'), "sensor[1].column", "t_s is used twice"),
    "sensor without noise at all": (
        edit("value = 0.002", "value = 0"),
        "sensor[8]",
        "noise: must be > 0 .*leave it out",
    ),
    "gyro on the rear chassis": (
        edit('kind = "yaw_rate"\nbody = 0', 'kind = "yaw_rate"\nbody = 2'),
        "sensor[8].body",
        "yaw_rate is measured on the first chassis alone, body 0 .got 2",
    ),
    "sensor of the small kit alone": (
        edit('kits = ["full"]', 'kits = ["paper"]'),
        "sensor[8].kits",
        '"full" has every sensor, add it',
    ),
    "two sensors with one name": (edit('name = "theta4"', 'name = "theta1"'), "sensor[1].name", "theta1 is used twice"),
    "unknown kind of sensor": (
        edit('kind = "angle"', 'kind = "smell"'),
        "sensor[0].kind",
        "'angle', 'wheel'.*got 'smell'",
    ),
    "unknown kit": (edit('["full"]', '["luxury"]'), "sensor[8].kits[0]", "'paper' or 'full'.*got 'luxury'"),
    "measuring wheel without radius": (drop("radius", 3), "sensor[3].radius", "needs radius and lateral"),
    "radius of an encoder": (
        edit('unit = "rad"', "unit = \"rad\"\nradius = { value = 1, source = 'assumed' }"),
        "sensor[0].radius",
        "for kind wheel only",
    ),
    "factor zero": (edit("value = 35.1507", "value = 0", text=EMPS), "sensor[1].factor", "must not be 0"),
    # processing and problems
    "cut-off above Nyquist": (
        put('cutoff_hz = { value = 50, source = "assumed" }'),
        "filter.cutoff_hz",
        "below half the sampling rate, 50 Hz .got 50",
    ),
    "filter of order 0": (put("order = 0"), "filter.order", "greater than or equal to 1.*got 0"),
    "decimation by half": (put("decimation = 2.5"), "filter.decimation", "integer.*got 2.5"),
    "unknown problem": (edit('problem = "R60"', 'problem = "R61"'), "problem", "no problem R61, allowed: R60"),
    "lane without width": (edit("[40.0, 20.0]", "[40.0, 0.0]"), "problems.R60.lane_m", "must be > 0.*got 0"),
    "lane of one number": (edit("[40.0, 20.0]", "40.0"), "problems.R60.lane_m", "list in brackets.*got 40"),
    "lane for an unknown body": (
        edit("lane_points = [0, 4]", "lane_points = [0, 5]"),
        "problems.R60.lane_points",
        "no body 5, allowed",
    ),
    "a problem shorter than its knots": (
        edit("duration_s = { value = 60", "duration_s = { value = 0.5"),
        "problems.R60.duration_s",
        "at least 4 knots long, 0.8 s .got 0.5",
    ),
    "zero scale": (edit("value = 1000,", "value = 0,"), "scale.MY0", "must be > 0 .got 0"),
    # inheritance
    "unknown extends": ('extends = "va13"\nname = "x"\n', "extends", "no machine va13, allowed: .*emps, .*va12"),
    "extends a number": ('extends = 12\nname = "x"\n', "extends", "shipped name or a file name"),
    "extends itself": ('extends = "mine.toml"\nname = "x"\n', "extends", "loop"),
    "extends, with a sensor's column alone": (
        'extends = "va12"\nname = "x"\n[[sensor]]\nname = "u1"\ncolumn = "Moment"\n',
        "sensor",
        "a list replaces that of va12.*.sensor.NAME. changes one.*machine new NAME --like",
    ),
    "extends, with a value that nobody answers for": (
        'extends = "va12"\nname = "x"\n[body.front_roll.contact]\nKx = { value = -2e5 }\n',
        "body[1].contact.Kx.source",
        "missing",
    ),
    "extends, with a sensor that there is none of": (
        'extends = "va12"\nname = "x"\n[sensor.u9]\nnoise = { value = 1, source = "assumed" }\n',
        "sensor.u9",
        "no such sensor, allowed: .*u1",
    ),
    "extends, with a number for a body": (
        'extends = "va12"\nname = "x"\n[body]\nfront_roll = 3\n',
        "body.front_roll",
        "must be a table of the keys that differ .got 3",
    ),
    "extends, with a key of a body that there is none of": (
        'extends = "va12"\nname = "x"\n[body.front_roll.limit]\ntorqe = 3\n',
        "body[1].limit.torqe",
        "no such key",
    ),
    "extends, then breaks": (
        'extends = "va12"\nname = "x"\nsampling_hz = { value = -1, source = "assumed" }\n',
        "sampling_hz",
        "must be > 0 .got -1",
    ),
}


def complaint(call: Callable[[], object], kind: type[ValueError]) -> str:
    with pytest.raises(kind) as caught:
        call()
    message = str(caught.value)
    assert len(message.splitlines()) == 1, message
    assert "Traceback" not in message
    assert "pydantic" not in message
    assert "Value error" not in message
    return message


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_gets_one_clear_line(case: str, tmp_path: Path) -> None:
    """File, key, what is wrong and what is allowed."""
    text, key, says = BROKEN[case]
    path = write(tmp_path, text)
    message = complaint(lambda: load_machine(path), MachineError)
    assert message.startswith(f"{path}: {key}"), message
    assert re.search(says, message[len(str(path)) :]), message
    assert len(message) - len(str(path)) < 320, message


def test_a_byte_order_mark_is_no_harm(tmp_path: Path) -> None:
    assert load_machine(write(tmp_path, b"\xef\xbb\xbf" + VA12.encode())) == load_machine("va12")


def test_files_that_extend_each_other_are_refused(tmp_path: Path) -> None:
    write(tmp_path, 'extends = "mine.toml"\n', "other.toml")
    path = write(tmp_path, 'extends = "other.toml"\n')
    assert "extends: more than 4 files deep, a loop?" in complaint(lambda: load_machine(path), MachineError)


def test_so_many_files_may_extend_one_another_and_no_more(tmp_path: Path) -> None:
    path = write(tmp_path, 'extends = "va12"\n', "deep1.toml")
    for k in range(2, extends.MAX_DEPTH + 1):
        path = write(tmp_path, f'extends = "deep{k - 1}.toml"\n', f"deep{k}.toml")
    assert load_machine(path) == load_machine("va12")
    assert len(machine_files(path)) == extends.MAX_DEPTH
    path = write(tmp_path, f'extends = "{path.name}"\n', "deeper.toml")
    for read in (load_machine, machine_files):
        assert "extends: more than 4 files deep" in complaint(lambda read=read: read(path), MachineError)


def test_own_files_are_those_that_a_machine_is_made_of(tmp_path: Path) -> None:
    other = write(tmp_path, 'extends = "va12"\n', "other.toml")
    path = write(tmp_path, 'extends = "other.toml"\n')
    assert machine_files(path) == [path, other]
    assert machine_files("va12") == []
    assert machine_files(MACHINES / "va12.toml") == [MACHINES / "va12.toml"], "given as a file it is one"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("va13", f"va13: no such machine, allowed: {', '.join(shipped_machines())}, or a path to a .toml file"),
        ("nowhere.toml", "nowhere.toml: no such file"),
        ("", ": no such machine"),
        (".", "no such machine"),
    ],
)
def test_a_name_that_is_no_machine(name: str, says: str) -> None:
    assert says in complaint(lambda: load_machine(name), MachineError)


def test_a_file_without_its_ending_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, 'extends = "va12"\n', "mine.toml")
    assert f"for the file beside it write {path}" in complaint(lambda: load_machine(tmp_path / "mine"), MachineError)


def test_a_folder_is_no_machine(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    assert "no such file" in complaint(lambda: load_machine(tmp_path / "folder.toml"), MachineError)


LINES = [k for k, line in enumerate(VA12.splitlines()) if line and not line.startswith("#")]
WRONG = ["nan", "-inf", "-1", "0", "1e300", "1e-300", "10" * 200, "true", "''", "'x'", "'pi/0'", "[]", "[[1]]", "{}"]


def refusal(path: Path) -> str:
    """What is said against a machine file, nothing if it is one. Any other exception comes through."""
    try:
        build(load_machine(path))
    except ValueError as err:
        return str(err)
    return ""


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(line=st.sampled_from(LINES), wrong=st.sampled_from(["", *WRONG]), inside=st.booleans())
def test_any_line_gone_or_wrong_is_a_machine_or_one_clear_line(
    line: int, wrong: str, inside: bool, tmp_path: Path
) -> None:
    """Nothing else comes out, whatever is written after a key or its `value`."""
    lines = VA12.splitlines()
    if not wrong:
        del lines[line]
    elif inside:
        lines[line] = re.sub(r"(value = )(\[.*?\]|[^,}]+)", lambda m: m[1] + wrong + " ", lines[line])
    else:
        lines[line] = re.sub(r"= .*", f"= {wrong}", lines[line])
    path = write(tmp_path, "\n".join(lines))
    message = refusal(path)
    if message:
        assert len(message.splitlines()) == 1
        assert message.startswith((f"{path}: ", "va12: "))


# What only the equations can tell: found when the machine is built.
UNBUILDABLE: dict[str, tuple[str, str]] = {
    "two parameters with one name": (edit('M0 = "M"', 'M0 = "M"\nFv1 = "M"'), "parameter_names: two .* same name: M$"),
    "name for no parameter": (edit('M0 = "M"', 'M9 = "M"'), "parameter_names.M9: no such parameter, allowed: M0, MX0"),
    "scale of no parameter": (edit("u20 =", "u30 ="), "scale.u30: no such parameter, allowed: M0, .*u40"),
}


@pytest.mark.parametrize("case", UNBUILDABLE)
def test_a_machine_that_cannot_be_built_gets_one_clear_line(case: str, tmp_path: Path) -> None:
    text, says = UNBUILDABLE[case]
    machine = load_machine(write(tmp_path, text))
    message = complaint(lambda: build(machine), ValueError)
    assert message.startswith("va12: ")
    assert re.search(says, message), message


# ------------------------------------------------------------------------------------------------ small promises
def test_every_body_is_found_by_its_index() -> None:
    machine = load_machine("va12")
    assert all(isinstance(machine.find(b.index), Body) for b in machine.body)
    with pytest.raises(KeyError):
        machine.find(9)


def test_another_table_is_another_machine(tmp_path: Path) -> None:
    """A third roll on the rear chassis is rows of a table, not code."""
    roll = VA12[VA12.index("[[body]]\nindex = 4") : VA12.index("[[sensor]]")]
    third = roll
    for old, new in {"index = 4": "index = 5", "rear_roll": "third_roll", "antecedent = 3": "antecedent = 2"}.items():
        third = third.replace(old, new)
    machine = load_machine(write(tmp_path, VA12.replace(roll, roll + third)))
    model = build(machine)
    assert machine.coordinates[-1] == "theta5"
    assert {"ZZ5", "Fv5", "Fs5", "Kx5", "Ky5", "u50"} < set(model.base.names)
    assert set(standard_parameters(machine)) > {"M5", "XX5"}


def test_a_machine_is_also_built_from_data() -> None:
    machine = load_machine("va12")
    assert Machine.model_validate(machine.model_dump()) == machine


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: "".join(f"k{k} = 1\n" for k in range(60_000)) + text, "holds more than 50000 keys"),
        (lambda text: f"{'a.' * 20_000}a = 1\n" + text, "nested too deeply"),
        (lambda text: f"{text}\n[{'a.' * 20_000}a]\n", "nested too deeply"),
        (lambda text: f"x = {{ {'a.' * 20_000}a = 1 }}\n" + text, "nested too deeply"),
        (lambda text: "".join(f"k{k} = 1\n" for k in range(500)) + text, r"no such key here.*\(and 499 more\)"),
        (lambda text: text + "\nreference_number = " + "9" * 5000, "holds an integer of thousands of digits"),
        (lambda text: text + "\nreference_number = 0x" + "f" * 5000, "holds an integer of 20000 bits"),
        (lambda text: text + f"\n{'k' * 5000} = 1", "is a key of 5000 characters, at most 200"),
        (lambda text: text + f'\ntitle = "{"x" * 20_000}"', "is a text of 20000 characters"),
        (lambda text: text + "\nx = " + "[" * 3000 + "]" * 3000, "are nested too deeply"),
        (lambda text: "sampling_hz = { value = " + "9" * 4000 + ', source = "assumed" }\n' + text, "size between"),
    ],
)
def test_a_flood_of_keys_or_digits_is_one_line(change: Callable[[str], str], words: str, tmp_path: Path) -> None:
    path = tmp_path / "flood.toml"
    path.write_text(change('extends = "emps"\nname = "flood"\n'))
    with pytest.raises(MachineError, match=words) as err:
        load_machine(path)
    assert len(str(err.value)) < 2000


def test_a_misspelt_machine_suggests_a_machine_file_or_a_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_rig.toml").write_text('extends = "emps"\n')
    Path("my_rigs.toml").write_text("[study]\n")  # no machine
    Path("other").mkdir()
    Path("other/my_rig.toml").write_text("[[body]]\n")
    for wrong, right in {
        "my_rgi.toml": r"my_rig\.toml",
        "my_rgi": r"my_rig\.toml",
        "my_rigss": r"my_rig\.toml",
        "MY_RIG.tml": r"my_rig\.toml",
        "other/my_rgi.toml": r"other/my_rig\.toml",
        "va12x": "va12",
        "VA12": "va12",
        "va12.toml": "va12",
    }.items():
        with pytest.raises(MachineError, match=rf"did you mean {right}\?"):
            load_machine(wrong)
    with pytest.raises(MachineError, match=r"allowed: .*, or a path to a \.toml file$"):
        load_machine("qqq")

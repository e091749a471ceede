"""Ten public robots and odd ones: the same dynamics as pinocchio reads, in and out again; damaged files."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from support import robots
from support.commands import Excite
from support.files import SHARED

from excite.cli import machine_template
from excite.errors import MachineError
from excite.identification import Estimate
from excite.model import Model, build, standard_parameters
from excite.model.machine import Machine, load_machine
from excite.workflows import urdf_with_estimate
from excite.workflows.urdf import read_robot

CASES = SHARED.parent / "cases"
RIGID = ("M", "X", "Y", "Z")  # initials of inertial parameters


@dataclass(frozen=True)
class Twin:
    """A model beside pinocchio's: S, shift: its joints' positions are S q + shift of the model's coordinates q."""

    model: Model
    pin: pin.Model
    S: np.ndarray
    shift: np.ndarray

    def torque(self, q: np.ndarray, nu: np.ndarray, a: np.ndarray) -> np.ndarray:
        tau = pin.rnea(self.pin, self.pin.createData(), self.place(q), self.S @ nu, self.S @ a)
        return np.asarray(self.S.T @ tau)

    def place(self, q: np.ndarray) -> np.ndarray:
        return np.asarray(pin.integrate(self.pin, pin.neutral(self.pin), self.S @ q + self.shift))

    def regressor(self, q: np.ndarray, nu: np.ndarray, a: np.ndarray) -> np.ndarray:
        data = self.pin.createData()
        return np.asarray(
            self.S.T @ pin.computeJointTorqueRegressor(self.pin, data, self.place(q), self.S @ nu, self.S @ a)
        )


def read(file: Path, place: Path, read_by_pinocchio: Path | None = None) -> Twin:
    out = place / f"{file.stem}.toml"
    machine_template.start("robot", out, origin=str(file))
    machine = load_machine(out)
    return beside(build(machine), read_by_pinocchio or file)


def beside(model: Model, file: Path) -> Twin:
    """Match joints by the link that each one carries, which names the body."""
    twin = pin.buildModelFromUrdf(str(file))
    machine = model.machine
    joints = ElementTree.parse(file).getroot().findall("joint")
    carries = {j.find("child").get("link").lower().replace("-", "_"): j.get("name") for j in joints}
    S, shift = np.zeros((twin.nv, len(model.coordinates))), np.zeros(twin.nv)
    for body in machine.body:
        row = twin.joints[twin.getJointId(carries[body.name])].idx_v
        S[row, model.coordinates.index(machine.coordinate(body))] = machine.ratio(body)
        shift[row] = machine.offset(body)
    return Twin(model, twin, S, shift)


def rigid(model: Model) -> np.ndarray:
    table = standard_parameters(model.machine)
    return np.array([v if n.startswith(RIGID) else 0.0 for n, (v, _) in table.items()])


def assert_same(twin: Twin, p: np.ndarray, share: float, n: int = 30) -> None:
    """Torques at random states differ by less than a share of their size, joint by joint."""
    motions = np.random.default_rng(0).uniform(-2, 2, (n, 3, len(twin.model.coordinates)))
    ours = np.array([twin.model.predict(*m, p).full()[:, 0] for m in motions])
    theirs = np.array([twin.torque(*m) for m in motions])
    assert (np.abs(ours - theirs).max(0) <= share * np.abs(theirs).max(0)).all()


@pytest.mark.parametrize("name", robots.NAMES)
def test_a_public_robot_is_the_same_for_pinocchio(name: str, tmp_path: Path) -> None:
    """Inverse dynamics, number of base parameters, and the URDF with other bodies identified."""
    file, exact = tmp_path / f"{name}.urdf", tmp_path / "exact.urdf"
    file.write_text(robots.urdf(name))
    exact.write_text(robots.urdf(name, rounded=False))
    twin = read(file, tmp_path, exact)
    model = twin.model
    assert_same(twin, rigid(model), 1e-8)
    rng = np.random.default_rng(1)
    rows = [twin.regressor(*rng.uniform(-2, 2, (3, len(model.coordinates)))) for _ in range(120)]
    A = np.concatenate(rows)
    size = np.linalg.norm(A, axis=0)
    seen = size > 1e-12 * size.max()
    values = np.linalg.svd(A[:, seen] / size[seen], compute_uv=False)
    assert sum(n.startswith(RIGID) for n in model.base.names) == (values > 1e-9 * values[0]).sum()

    table = {n: v for n, (v, _) in standard_parameters(model.machine).items()}
    hidden = {n: v * rng.uniform(1.0, 1.3) if n[0] in "MF" else v * 1.6 for n, v in table.items()}
    X = model.base_values(hidden)
    known = estimate(model, X)
    text, notes = urdf_with_estimate(file, model, known)
    assert not notes
    written = tmp_path / "written.urdf"
    written.write_text(text)
    p = model.expand @ X
    p[[not n.startswith(RIGID) for n in model.base.standard]] = 0.0
    again = Twin(model, pin.buildModelFromUrdf(str(written)), twin.S, twin.shift)
    assert_same(again, p, 1e-3)


def estimate(model: Model, X: np.ndarray) -> Estimate:
    spread = np.diag((0.01 * np.abs(model.scale)) ** 2)
    return Estimate("inverse", model.base.names, model.base.units, X, spread, 1, 1, 0, np.zeros((len(X), 1)), 9, {}, ())


def test_impossible_values_are_written_with_how_far_the_nearest_machine_is(tmp_path: Path) -> None:
    """The last link's inertia about its axis is negative: no body has it."""
    file = tmp_path / "arm.urdf"
    file.write_text(robots.urdf("ur5"))
    model = read(file, tmp_path).model
    X = model.nominal.copy()
    k = model.base.names.index("ZZ6")
    X[k] = -50 * model.scale[k]
    text, notes = urdf_with_estimate(file, model, estimate(model, X))
    (note,) = (n for n in notes if "the nearest possible one is written" in n)
    assert re.search(r"standard deviations away; its torques differ by .* % in theta6", note)
    written = tmp_path / "written.urdf"
    written.write_text(text)
    bodies = list(pin.buildModelFromUrdf(str(written)).inertias)[1:]
    assert all(np.linalg.eigvalsh(i.toPseudoInertia().toMatrix()).min() > 0 for i in bodies)


@pytest.mark.parametrize("name", ["ur5", "bolt"])
def test_a_rough_estimate_is_written_with_possible_bodies(name: str, tmp_path: Path) -> None:
    """Every value is off by 30 %, so many bodies lie on the edge of what is possible."""
    file, written = tmp_path / "robot.urdf", tmp_path / "written.urdf"
    file.write_text(robots.urdf(name))
    model = read(file, tmp_path).model
    errors = np.random.default_rng(5).standard_normal(len(model.scale))
    rough = estimate(model, model.nominal + 0.3 * np.abs(model.scale) * errors)
    text, notes = urdf_with_estimate(file, model, rough)
    assert any("the nearest possible one is written" in n for n in notes)
    written.write_text(text)
    bodies = list(pin.buildModelFromUrdf(str(written)).inertias)[1:]
    assert all(np.linalg.eigvalsh(i.toPseudoInertia().toMatrix()).min() > 0 for i in bodies)


def assert_written_as_identified(file: Path, model: Model, X: np.ndarray) -> None:
    """Assert that the robot written with base parameters X (n_base,) has their torques of bodies, without a note."""
    text, notes = urdf_with_estimate(file, model, estimate(model, X))
    assert not notes
    written = file.with_name("written.urdf")
    written.write_text(text)
    p = model.expand @ X
    p[[not n.startswith(RIGID) for n in model.base.standard]] = 0.0
    assert_same(beside(model, written), p, 1e-3)


def test_a_light_last_link_is_written_as_it_was_identified(tmp_path: Path) -> None:
    """The flange turns with 1e-7 kg m2, far below what is known of it: its own joint shows it all the same."""
    file = tmp_path / "light.urdf"
    light = '<mass value="0.0075"/><inertia ixx="6.4e-7" iyy="6.6e-7" izz="7.2e-7" ixy="0" ixz="0" iyz="0"/>'
    before, flange, after = robots.urdf("scara").partition('<link name="flange"')
    assert flange
    file.write_text(before + flange + re.sub(r"<mass.*?<inertia.*?/>", light, after, count=1, flags=re.DOTALL))
    model = read(file, tmp_path).model
    hidden = {n: 1.6 * v for n, (v, _) in standard_parameters(model.machine).items()}
    X = model.base_values(hidden)
    assert_written_as_identified(file, model, X)


@pytest.mark.parametrize("last", ["1e-12", "0"])
def test_a_residue_in_the_file_does_not_pin_what_was_identified(last: str, tmp_path: Path) -> None:
    """A centre of mass 1e-12 m beside the axis is one on the axis: the identified one is written whole."""
    file = tmp_path / "arm.urdf"
    file.write_text(robots.urdf("z1").replace('rpy="0,0,0"', f'rpy="0,{last},0"'))
    model = read(file, tmp_path).model
    table = {n: v for n, (v, _) in standard_parameters(model.machine).items()}
    moved = {n: v + 0.05 * table[f"M{n[2:]}"] if n[:2] in ("MX", "MY") else v for n, v in table.items()}
    moved |= {n: v + 0.02 for n, v in table.items() if n[:2] in ("XX", "YY", "ZZ")}
    X = model.base_values(moved)
    assert_written_as_identified(file, model, X)


# ---------------------------------------------------------------------------------------- what real files hold


TENSOR = '<inertia ixx=".02" iyy=".03" izz=".04" ixy=".001" ixz="0" iyz="0"/>'
WEIGHTLESS = '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'


def arm(*joints: str, links: str = "") -> str:
    """Return a URDF of joints; each link gets a body."""
    names = sorted({n for j in joints for n in re.findall(r'link="([^"]+)"', j)} - {"world"})
    body = f'<inertial><origin xyz="0.1 0.02 0"/><mass value="2"/>{TENSOR}</inertial>'
    return (
        f'<robot name="r">{links}{"".join(f"<link name={n!r}>{body}</link>" for n in names)}{"".join(joints)}</robot>'
    )


def joint(name: str, parent: str, child: str, more: str = "", kind: str = "revolute", at: str = "0.3 0 0.1") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="0 1 0"/><limit effort="50" velocity="2" lower="-1" upper="1"/>{more}</joint>'
    )


def test_several_joints_on_the_base_are_one_machine(tmp_path: Path) -> None:
    file = tmp_path / "two.urdf"
    file.write_text(arm(joint("left", "b", "l"), joint("right", "b", "r"), joint("knee", "r", "k")))
    twin = read(file, tmp_path)
    assert [b.antecedent for b in twin.model.machine.body] == ["ground", "ground", 2]
    assert_same(twin, rigid(twin.model), 1e-9)


@pytest.mark.parametrize("beside", ["9e-9", "2e-5", "0.29999"])
def test_an_axis_slightly_beside_a_line_stays_there(beside: str, tmp_path: Path) -> None:
    """Directions of lengths near multiples of pi/4 are no rounded angles."""
    file = tmp_path / "beside.urdf"
    at = f"0.3 0.1 {beside}"
    file.write_text(arm(*(joint(f"j{k}", f"l{k}", f"l{k + 1}", at=at) for k in range(3)), joint("j3", "l3", "l4")))
    twin = read(file, tmp_path)
    assert_same(twin, rigid(twin.model), 1e-9)


@pytest.mark.parametrize(("multiplier", "offset"), [(-1.0, 0.0), (0.5, 0.3), (1.0, -0.7)])
def test_a_joint_that_mimics_moves_with_the_other_one(multiplier: float, offset: float, tmp_path: Path) -> None:
    said = f'<mimic joint="lift" multiplier="{multiplier}" offset="{offset}"/>'
    file = tmp_path / "level.urdf"
    file.write_text(arm(joint("lift", "b", "a"), joint("level", "a", "h", said), joint("wrist", "h", "t")))
    twin = read(file, tmp_path)
    assert twin.model.coordinates == ("theta1", "theta3")
    level = twin.model.machine.body[1]
    assert twin.model.machine.ratio(level) == multiplier
    assert twin.model.machine.offset(level) == offset
    assert_same(twin, rigid(twin.model), 1e-9)


def test_a_mimic_of_a_mimic_and_one_by_zero(tmp_path: Path) -> None:
    file = tmp_path / "chain.urdf"
    first = '<mimic joint="lift" multiplier="2" offset="0.1"/>'
    second = '<mimic joint="level" multiplier="-0.5" offset="0.2"/>'
    still = '<mimic joint="lift" multiplier="0" offset="0.4"/>'
    joints = (
        joint("lift", "b", "a"),
        joint("level", "a", "h", first),
        joint("tip", "h", "t", second),
        joint("held", "t", "e", still),
    )
    file.write_text(arm(*joints))
    twin = read(file, tmp_path)
    bodies, machine = twin.model.machine.body, twin.model.machine
    assert [machine.ratio(b) for b in bodies] == [1, 2, -1]
    assert [machine.offset(b) for b in bodies] == pytest.approx([0, 0.1, 0.15])
    assert len(bodies) == 3


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (
            (joint("lift", "b", "a", kind="fixed"), joint("tip", "a", "h", '<mimic joint="lift"/>')),
            "joint tip: mimic: joint lift is fixed, name one that moves$",
        ),
        ((joint("lift", "b", "a"), joint("tip", "c", "h")), "links b, c have no joint above them; a robot has one"),
        ((joint("free", "world", "b", kind="floating"), joint("lift", "b", "a")), r"fixed \(if the base does not move"),
        ((joint("lift", "b", "a", kind="ball"),), "type ball .* allowed: fixed, revolute, continuous, prismatic$"),
    ],
    ids=["fixed leader", "two bases", "floating", "ball"],
)
def test_refusals_of_a_urdf_say_what_to_change(joints: tuple[str, ...], words: str, tmp_path: Path) -> None:
    file = tmp_path / "odd.urdf"
    file.write_text(arm(*joints))
    with pytest.raises(MachineError, match=words):
        read_robot(file)


@pytest.mark.parametrize(
    ("limit", "range_read"),
    [('lower="1" upper="-1"', (None, None)), ("", (None, None)), ('upper="1.5"', (0, 1.5)), ('lower="-2"', (-2, 0))],
)
def test_limits_without_a_range_are_dropped_with_a_note(
    limit: str, range_read: tuple[float | None, float | None], tmp_path: Path
) -> None:
    """URDF takes 0 for an end that is not given."""
    file = tmp_path / "limits.urdf"
    file.write_text(arm(joint("lift", "b", "a").replace('lower="-1" upper="1"', limit)))
    robot = read_robot(file)
    assert (robot.joints[0].joint.low, robot.joints[0].joint.high) == range_read
    assert any("the joint has no limits" in line for line in robot.urdf.notes) == (range_read == (None, None))


def test_a_mass_without_inertia_is_noted_as_a_point_mass(tmp_path: Path) -> None:
    file = tmp_path / "point.urdf"
    body = "<link name='t'><inertial><mass value='2'/></inertial></link>"
    text = arm(joint("lift", "b", "a"), joint("tip", "a", "t"))
    start = text.index("<link name='t'>")
    file.write_text(text[:start] + body + text[text.index("</link>", start) + len("</link>") :])
    assert "link t: has a mass but no inertia in the URDF, so it is a point mass here" in read_robot(file).urdf.notes


def test_world_need_not_be_a_link(tmp_path: Path) -> None:
    file = tmp_path / "world.urdf"
    file.write_text(arm(joint("mount", "world", "b", kind="fixed"), joint("lift", "b", "a")))
    assert read_machine(file, tmp_path).body[0].name == "a"
    file.write_text(arm(joint("lift", "basis", "a")).replace("<link name='basis'>", "<link name='base'>"))
    with pytest.raises(MachineError, match=r"joint lift: no link basis \(did you mean base\?\)"):
        read_machine(file, tmp_path, "other")
    file.write_text('<robot name="r" xmlns:xacro="http://wiki.ros.org/xacro"/>')
    with pytest.raises(MachineError, match="has no links; a xacro file must be expanded first"):
        read_machine(file, tmp_path, "empty")


def read_machine(file: Path, place: Path, name: str = "m") -> Machine:
    machine_template.start(name, place / f"{name}.toml", origin=str(file))
    return load_machine(place / f"{name}.toml")


@pytest.mark.parametrize("given", ["", WEIGHTLESS])
def test_a_link_without_mass_has_none_and_is_named(given: str, excite: Excite, tmp_path: Path) -> None:
    file = tmp_path / "light.urdf"
    text = arm(joint("lift", "b", "a"), joint("turn", "a", "c"), joint("tip", "c", "t"))
    body = text[text.index("<link name='c'>") :].partition("</link>")[0]
    file.write_text(text.replace(body, f"<link name='c'>{given}"))
    code, said, _ = excite("machine", "new", "light", "--from", file, "--out", tmp_path / "light.toml")
    assert code == 0
    assert "link c: has no mass" in said
    machine = load_machine(tmp_path / "light.toml")
    assert float(machine.body[1].inertia.mass) == 0
    assert_same(beside(build(machine), file), rigid(build(machine)), 1e-9)
    code, said, _ = excite("machine", "check", tmp_path / "light.toml", "--out", tmp_path / "check")
    assert code == 0
    assert "c: inertia.mass: 0 kg" in " ".join(said.split())


@pytest.mark.parametrize("digits", [4, 5, 6, 8])
def test_rounded_angles_give_the_parameters_of_exact_ones(digits: int, tmp_path: Path) -> None:
    """Iiwa has six right angles between its axes; the URDF and the machine file alike may round them."""
    exact, rounded = tmp_path / "exact.urdf", tmp_path / "rounded.urdf"
    exact.write_text(robots.urdf("iiwa", rounded=False))
    half, whole = repr(np.pi / 2), repr(np.pi)
    text = exact.read_text().replace(half, str(round(np.pi / 2, digits))).replace(whole, str(round(np.pi, digits)))
    rounded.write_text(text)
    one, other = read(exact, tmp_path).model, read(rounded, tmp_path).model
    assert one.base.names == other.base.names
    assert np.allclose(one.base.matrix, other.base.matrix, atol=1e-9)
    table = (tmp_path / "exact.toml").read_text()
    typed = tmp_path / "typed.toml"
    typed.write_text(re.sub(r"(?<=value = )-?(1\.5707|3\.1415)\d+", lambda m: str(round(float(m[0]), digits)), table))
    assert typed.read_text() != table
    assert build(load_machine(typed)).base.names == one.base.names


def test_robots_of_the_shared_cases_are_read_as_they_say(tmp_path: Path) -> None:
    if not CASES.is_dir():
        pytest.skip(f"the shared cases are not here ({CASES})")
    for case in ("G15_urdf/missing", "G15_urdf/tworoots", "G05_mimic/par", "G16_rounded_angles/exact"):
        twin = read(CASES / f"{case}.urdf", tmp_path)
        assert_same(twin, rigid(twin.model), 1e-9)
    rounded = read(CASES / "G16_rounded_angles" / "rounded.urdf", tmp_path).model
    assert rounded.base.names == twin.model.base.names
    assert len(rounded.base.names) == 34


# ------------------------------------------------------------------------------------------------ damaged files


def damage(first: int, last: int, place: Path) -> None:
    read = 0
    for seed in range(first, last):
        file, out = place / f"{seed}.urdf", place / f"{seed}.toml"
        file.write_bytes(robots.damaged(seed))
        begin, said = time.process_time(), ""
        try:
            machine_template.start("robot", out, origin=str(file))
            load_machine(out)
            read += 1
        except MachineError as err:
            said = str(err)
        assert "\n" not in said, seed
        assert len(said) < 2000, seed
        assert time.process_time() - begin < 20, seed
    assert read > (last - first) // 15


def test_damaged_urdfs_are_read_or_refused_in_a_line(tmp_path: Path) -> None:
    damage(0, 60, tmp_path)


@pytest.mark.slow
def test_many_damaged_urdfs_are_read_or_refused_in_a_line(tmp_path: Path) -> None:
    damage(60, 400, tmp_path)


def test_a_robot_with_too_many_joints_is_refused_in_a_line(tmp_path: Path) -> None:
    file = tmp_path / "many.urdf"
    file.write_text(arm(*(joint(f"j{k}", f"l{k}", f"l{k + 1}") for k in range(40))))
    with pytest.raises(MachineError, match="has 40 moving joints, at most 30"):
        read_machine(file, tmp_path)

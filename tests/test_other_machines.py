"""Other machines by another table: their parameters, their dynamics against pinocchio, from design to estimate.

A machine of the list is its file in model/machines and an entry in CASES; nothing else here knows it. Its dynamics are
compared from its file alone.
"""

from __future__ import annotations

import io
import json
import re
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from support.logs import make_log
from test_tree import TOLERANCE, Case, relative

from excite.diagnosis import Diagnosis, diagnosis as diagnose, residuals, separating_run
from excite.errors import InfeasibleError
from excite.identification import identifiability, methods, recommend_method
from excite.logs import inspection, log
from excite.model import Model, build, standard_parameters
from excite.model.effects import Site, catalogue, placing, sizes
from excite.model.machine import Machine, Problem, Quantity, load_machine, shipped_machines
from excite.operator import sheet
from excite.reports import top_view
from excite.simulation import Motion, sensors, simulate
from excite.trajectories import baselines, excitation, limits, multistart

ROOT = Path(__file__).parents[1]
NEVER = ("MZ", "XX", "XY", "XZ", "YY", "YZ")  # of a chassis: what motion on the plane can't show


@dataclass(frozen=True)
class Expected:
    """What a machine's parameters must be, worked out by hand from its table; `share` of full torque that it can take.

    groups: the base parameters that stand for several, in standard parameters, with moments of inertia carried over by
    Steiner. plain: the others. unseen: standard parameters that no motion on the plane shows.
    """

    groups: dict[str, dict[str, float]]
    plain: str
    unseen: tuple[str, ...]
    share: float
    locked: tuple[str, ...] = field(default=())


def _chassis(*bodies: int) -> tuple[str, ...]:
    return tuple(f"{name}{k}" for k in bodies for name in NEVER)


H, T = 0.249, 0.29153  # half of the robot's wheelbase and of its track
CASES = {
    "single_drum": Expected(
        {
            "M": {"M0": 1, "M1": 1, "M2": 1, "M3": 1, "M5": 1},
            "MX0R": {"MX0": 1, "M3": 1.45, "M5": 1.45},
            "MY0R": {"MY0": 1, "M1": 0.8, "M2": -0.8},
            "ZZ0R": {"ZZ0": 1, "M1": 0.64, "XX1": 1, "M2": 0.64, "XX2": 1, "M3": 1.45**2, "M5": 1.45**2},
            "MX3R": {"MX3": 1, "M5": 1.5},
            "ZZ3R": {"ZZ3": 1, "M5": 2.25, "XX5": 1},
        },
        "MY3 ZZ1 Fv1 Fs1 Kx1 Ky1 u10 ZZ2 Fv2 Fs2 Kx2 Ky2 u20 Fv3 Fs3 u30 ZZ5 Fv5 Fs5 Kx5 Ky5 u50",
        _chassis(0, 3),
        0.5,
    ),
    "tandem": Expected(
        {
            "M": {"M0": 1, "M1": 1, "M2": 1, "M3": 1, "M4": 1},
            "MX0R": {"MX0": 1, "M1": 1.7, "M2": 1.7, "M3": -1.7, "M4": -1.7},
            "ZZ0R": {"ZZ0": 1, "M1": 2.89, "M2": 2.89, "M3": 2.89, "M4": 2.89},
            "ZZ1R": {"ZZ1": 1, "XX2": 1},
            "ZZ3R": {"ZZ3": 1, "XX4": 1},
        },
        "MY0 Fv1 Fs1 u10 ZZ2 Fv2 Fs2 Kx2 Ky2 u20 Fv3 Fs3 u30 ZZ4 Fv4 Fs4 Kx4 Ky4 u40",
        (*_chassis(0), "XX1", "XX3"),
        0.6,
    ),
    "double_loader": Expected(
        {
            "M": {"M0": 1, "M1": 1, "M2": 1, "M3": 1, "M4": 1},
            "MX0R": {"MX0": 1, "M2": -1.15, "M3": -1.15, "M4": -1.15},
            "ZZ0R": {"ZZ0": 1, "XX1": 1, "M2": 1.15**2, "M3": 1.15**2, "M4": 1.15**2},
            "MX2R": {"MX2": 1, "M3": -1.1, "M4": -1.1},
            "ZZ2R": {"ZZ2": 1, "M3": 1.21, "M4": 1.21},
            "ZZ3R": {"ZZ3": 1, "XX4": 1},
        },
        "MY0 MY2 ZZ1 Fv1 Fs1 Kx1 Ky1 u10 Fv2 Fs2 u20 Fv3 Fs3 u30 ZZ4 Fv4 Fs4 Kx4 Ky4 u40",
        (*_chassis(0, 2), "XX3"),
        0.4,
    ),
    "pendulum_loader": Expected(
        {
            "M": {"M0": 1, "M1": 1, "M2": 1, "M4": 1, "M5": 1},
            "MX0R": {"MX0": 1, "M2": -1, "M4": -1, "M5": -1},
            "ZZ0R": {"ZZ0": 1, "XX1": 1, "M2": 1, "M4": 1, "M5": 1},
            "MX2R": {"MX2": 1, "MX4": 1, "M5": -1},
            "MY2R": {"MY2": 1, "MY4": 1},
            "ZZ2R": {"ZZ2": 1, "ZZ4": 1, "XX5": 1, "M5": 1},
        },
        "MY0 ZZ1 Fv1 Fs1 Kx1 Ky1 u10 Fv2 Fs2 u20 ZZ5 Fv5 Fs5 Kx5 Ky5 u50",
        (*_chassis(0, 2, 4), "Fv3", "Fs3", "u30"),
        0.6,
        ("theta3",),
    ),
    "skid_robot": Expected(
        {
            "M": {"M0": 1, "M1": 1, "M2": 1, "M3": 1, "M4": 1},
            "MX0R": {"MX0": 1, "M1": H, "M2": H, "M3": -H, "M4": -H},
            "MY0R": {"MY0": 1, "M1": T, "M2": -T, "M3": T, "M4": -T},
            "ZZ0R": {"ZZ0": 1} | {f"M{k}": H**2 + T**2 for k in (1, 2, 3, 4)} | {f"XX{k}": 1 for k in (1, 2, 3, 4)},
        },
        " ".join(f"ZZ{k} Fv{k} Fs{k} Kx{k} Ky{k} u{k}0" for k in (1, 2, 3, 4)),
        _chassis(0),
        0.8,
    ),
}


@lru_cache
def model_of(name: str) -> Model:
    return build(load_machine(name))


@pytest.fixture(params=CASES)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def model(name: str) -> Model:
    return model_of(name)


def short(machine: Machine, seconds: float) -> Problem:
    problem = machine.problems[machine.problem or ""]
    return problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": seconds})})


# --------------------------------------------------------------------------------------------- base parameters
def test_base_parameters_are_those_worked_out_by_hand(name: str, model: Model) -> None:
    want = CASES[name]
    assert set(model.base.names) == set(want.groups) | set(want.plain.split())
    for group, parts in want.groups.items():
        assert model.base.grouping(group) == pytest.approx(parts, rel=1e-9), group
    for plain in want.plain.split():
        assert model.base.grouping(plain) == {plain: 1}


def test_what_no_motion_on_the_plane_shows_is_said(name: str, model: Model) -> None:
    """Of the pendulum: that the joint is there, what belongs to it alone, and the rear frame's rolling inertia."""
    assert set(model.base.invisible) == set(CASES[name].unseen)
    assert not set(CASES[name].locked) & set(model.coordinates)


def test_rank_of_the_standard_regressor_is_the_number_of_base_parameters(model: Model) -> None:
    """By singular values over fresh random motions: neither more nor fewer can be told apart."""
    rng = np.random.default_rng(7)
    n, p = 200, [v for v, _ in standard_parameters(model.machine).values()]
    W = model.standard_regressor(*rng.normal(size=(3, len(model.coordinates), n)), p).full()
    W = W.reshape(-1, n, len(p)).transpose(1, 0, 2).reshape(-1, len(p))
    size = np.linalg.norm(W, axis=0)
    kept = size > 1e-9 * size.max()
    s = np.linalg.svd(W[:, kept] / size[kept], compute_uv=False)
    assert int((s > 1e-8 * s[0]).sum()) == len(model.base.names)


# ------------------------------------------------------------------------------------------------- rigid bodies
MACHINES = [load_machine(name) for name in shipped_machines()]
# Held on a line, a machine has no bias to compare.
FREE = [m.name for m in MACHINES if m.planar and not set(m.body[0].coordinates) & set(m.locked)]


@pytest.mark.parametrize("name", FREE)
def test_dynamics_are_pinocchios(name: str) -> None:
    """Mass matrix, bias and inverse dynamics; locked joints held at zero in pinocchio's tree, which has them all.

    Of every shipped machine that is free on the plane: the next one comes in by its file.
    """
    model = model_of(name)
    one = Quantity(value=1, source="assumed")
    scale = {n + end: one for n in standard_parameters(model.machine) for end in ("", "R")}
    case = Case(model.machine.model_copy(update={"locked": (), "scale": scale}))
    every, free = case.machine.coordinates, model.coordinates
    rows = [every.index(c) for c in free]
    table = standard_parameters(model.machine)
    p = ca.DM([0.0 if n.startswith(("Fv", "Fs", "Kx", "Ky", "u")) else v for n, (v, _) in table.items()])
    qs, nus, accels = model.symbols()
    Y = model.predict(qs, nus, accels, p)
    mass = ca.Function("mass", [qs], [ca.jacobian(Y, accels)])
    for at, rate, accel in zip(*(x.T for x in case.states(100)), strict=True):
        for c in model.machine.locked:
            at[every.index(c)] = rate[every.index(c)] = accel[every.index(c)] = 0.0
        M, bias, inverse = case.reference(at, rate, accel)
        q, nu, a = at[rows], rate[rows], accel[rows]
        assert relative(mass(q).full(), M[np.ix_(rows, rows)]) <= TOLERANCE
        assert relative(model.predict(q, nu, 0, p).full()[:, 0], bias[rows]) <= TOLERANCE
        assert relative(model.predict(q, nu, a, p).full()[:, 0], inverse[rows]) <= TOLERANCE


def test_an_axle_is_a_roll_as_wide_as_sqrt_3_times_its_track() -> None:
    """What the loaders' files say: two wheels that turn together, and the roll that stands for them, push alike."""
    one = load_machine("pendulum_loader")
    track, spin = 1.35, 1.7
    body = one.find(1)
    assert body.contact is not None
    width = body.contact.width.model_copy(update={"value": float(np.sqrt(3) * track)})
    roll = build(_contact(one, 1, {"width": width}))
    q = np.zeros(6)
    for Vx, Vy, yaw in ((1.0, 0.05, 0.2), (0.8, -0.02, -0.4), (-0.9, 0.1, 0.3)):
        nu = np.array([Vx, Vy, yaw, spin, 0, 0])
        got = _of_soil(roll, 1, q, nu)
        want = np.zeros(6)
        R, Kx, Ky = (float(x) for x in (body.contact.radius, body.contact.Kx, body.contact.Ky))
        vn = np.hypot(R * spin, float(body.contact.v_eps))
        for y in (track / 2, -track / 2):
            push = Kx / 2 * (Vx - y * yaw - R * spin) / vn
            side = Ky / 2 * Vy / vn
            want += [push, side, -y * push, -R * push, 0, 0]
        assert got == pytest.approx(want, rel=1e-9)


def _contact(machine: Machine, index: int, update: dict[str, object]) -> Machine:
    bodies = tuple(
        b.model_copy(update={"contact": b.contact.model_copy(update=update)}) if b.index == index and b.contact else b
        for b in machine.body
    )
    return machine.model_copy(update={"body": bodies})


def _of_soil(model: Model, index: int, q: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Generalised force of one contact: the prediction's part with its Kx, Ky, taken off."""
    table = {n: v for n, (v, _) in standard_parameters(model.machine).items()}
    none = [0.0] * len(table)
    own = [v if n in (f"Kx{index}", f"Ky{index}") else 0.0 for n, v in table.items()]
    a = np.zeros(len(q))
    return -(model.predict(q, nu, a, own).full() - model.predict(q, nu, a, none).full())[:, 0]


# --------------------------------------------------------------------------------- design, simulation, estimate
def test_a_log_gives_the_true_parameters_back(name: str, model: Model) -> None:
    """A random drive of twelve seconds with every sensor's flaws: no parameter four of its own deviations off."""
    drive = excitation.scale_torques(
        excitation.multisine(model, short(model.machine, 12.0), 1, top=0.4), CASES[name].share
    )
    motion = simulate(model, drive.sample(float(model.machine.sampling_hz)))
    table = sensors.measure(model, motion, kit="full", seed=1)
    estimate = methods.identify(model, [log.from_table(table, model.machine)], recommend_method(model))
    assert estimate.unidentifiable == {}
    z = (estimate.value - model.nominal) / estimate.std
    assert np.abs(z).max() < 4, dict(zip(model.base.names, z.round(1), strict=True))
    assert 0.3 < float(np.mean(z**2)) < 2.5
    size = np.maximum(np.abs(model.nominal), model.scale)
    assert np.median(estimate.std / size) < 0.05


def test_a_drum_that_nothing_drives_is_found_as_well() -> None:
    """The single-drum roller pulled along by its wheels: the drum's row says that no torque acts on it."""
    pulled = load_machine("single_drum")
    body = tuple(b.model_copy(update={"actuated": False}) if b.name == "drum" else b for b in pulled.body)
    sensor = tuple(s for s in pulled.sensor if s.name != "u_drum")
    model = build(pulled.model_copy(update={"body": body, "sensor": sensor}))
    assert model.inputs == ("u1", "u2", "u3")
    assert "u50" in model.base.invisible
    drive = excitation.scale_torques(excitation.multisine(model, short(model.machine, 12.0), 1, top=0.4), 0.5)
    motion = simulate(model, drive.sample(float(model.machine.sampling_hz)))
    measured = make_log(model, motion, seed=1)
    estimate = methods.identify(model, [measured], "joint")
    z = (estimate.value - model.nominal) / estimate.std
    assert np.nanmax(np.abs(z)) < 4
    drum = [k for k, n in enumerate(model.base.names) if n in ("ZZ5", "Fs5", "Kx5", "Ky5")]
    assert (estimate.std[drum] < 0.1 * np.abs(model.nominal[drum])).all()


def test_design_ends_with_a_drive_or_with_the_limit_that_it_misses(model: Model) -> None:
    """With hardly any time: a drive that keeps every limit in a fresh simulation, or one clear line."""
    problem = short(model.machine, 6.0)
    excess, said = 0.0, "no drive found"
    try:
        found = multistart.design(model, problem, starts=1, seed=1, budget_s=0.1)
        excess = max(limits.check_limits(model, problem, found.motion).values())
    except InfeasibleError as missed:
        said = str(missed)
    assert excess <= 1e-3
    assert said.startswith("no drive found")


# ------------------------------------------------------------------------- what once knew that it is a compactor
def turned(model: Model) -> float:
    """How far the hand-made drive turns the machine, the range of its heading [rad]."""
    drive = baselines.hand_made(model, short(model.machine, 20.0), 0, 0.0)
    motion = simulate(model, drive.sample(float(model.machine.sampling_hz)))
    return float(np.ptp(motion.q[:, model.coordinates.index("theta0")]))


@pytest.mark.parametrize("name", ["tandem", "skid_robot"])
def test_a_hand_made_drive_turns_whatever_it_steers_with(name: str) -> None:
    """Steering joints at both ends turn against each other (alike, they would only move it sideways), and where there
    is no joint the sides are driven apart."""
    assert turned(model_of(name)) > 0.1


def test_sides_of_a_skid_steered_robot_may_turn_against_each_other() -> None:
    """On the spot the sides do; two wheels of one side that do are wired wrongly."""
    robot = load_machine("skid_robot")
    t = np.arange(500) / 100
    way = np.sin(2 * t) + 0.3 * np.sin(5 * t)
    signs = {"front_left": -1, "rear_left": -1, "front_right": 1, "rear_right": 1}

    def wired() -> list[str]:
        table = pd.DataFrame({"t_s": t} | {f"{n}_rad": sign * way for n, sign in signs.items()})
        return [r for r in inspection.inspect(table, robot).faults if "against each other" in r]

    assert wired() == []
    signs["rear_left"] = 1
    assert len(wired()) == 1
    assert wired()[0].startswith("columns front_left_rad, rear_left_rad: front left and rear left turn against")


FOREIGN = re.compile(r"(?i)\b(compactors?|drums?|rollers?|rolls?)\b")
KINDS = re.compile(r"(?i)\brolls?( or|,? and|, a|, or a| or a) wheels?\b")  # what a contact may be


def said(path: Path) -> Iterator[tuple[int, str]]:
    """What a file of the program says in code and in words, line by line; comments only explain. Names of effects and
    what other packages call theirs are no words of ours."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        yield from enumerate(text.splitlines(), 1)
        return
    before = ""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type != tokenize.COMMENT and before != ".":
            yield token.start[0], token.string.replace("_", " ") if token.type == tokenize.NAME else token.string
        before = token.string


SPOKEN = [
    path
    for folder, pattern in (("model", "*.py"), ("excite", "*.py"), ("excite/templates", "*.html"))
    for path in sorted((ROOT / folder).glob(pattern))
]


@pytest.mark.parametrize("path", SPOKEN, ids=lambda path: path.name)
def test_no_code_and_no_message_speaks_of_one_kind_of_machine(path: Path) -> None:
    """Contacts have the machine file's names; what steers, too: an articulation is but a place of some effects."""
    steering = re.compile(r"(?i)\barticulations?\b")
    found = []
    for line, text in said(path):
        for name in catalogue.CATALOGUE:
            text = text.replace(name, "")
        words = FOREIGN.findall(KINDS.sub("", text))
        if path.parent.name == "excite" and text != '"articulation"':
            words += steering.findall(text)
        found += [(line, word) for word in words]
    assert found == []


def test_words_of_one_kind_of_machine_would_be_found(tmp_path: Path) -> None:
    """In a message, a name, a docstring; not in a comment, not as one of two kinds, not as what numpy does."""
    path = tmp_path / "x.py"
    text = '"the rolls turn"\ndrum_speed = 1\n"""A roller."""\n# a roll\n"roll or wheel"\nnp.roll(x)\nenroll\n'
    path.write_text(text, encoding="utf-8")
    found = {line for line, text in said(path) if FOREIGN.search(KINDS.sub("", text))}
    assert found == {1, 2, 3}


@pytest.mark.parametrize("name", [*FREE, "emps"])
def test_torques_that_effects_take_are_of_the_machines_own_size(name: str) -> None:
    """At full torque a dead band takes its amount, a valve half of what is beyond it, friction its share, whether the
    motor gives 15 N m or 15 kN m."""
    plain = model_of(name)
    still, p = np.zeros(len(plain.coordinates)), plain.expand @ plain.nominal
    for k, (row, body) in enumerate(zip(plain.actuated, plain.machine.actuated, strict=True)):
        full, nu = sizes.large_torque(plain.machine, body), np.zeros(len(still))
        u, nu[row] = full * np.eye(len(plain.inputs))[k], 1.0
        for cause, share in (("torque_deadband", 1.0), ("relief_valve", 0.4 * full), ("load_dependent_friction", full)):
            effect = catalogue.CATALOGUE[cause]
            if body.where not in placing.allowed_places(plain.machine, effect):
                continue
            amount = effect.typical_magnitude(Site(plain.machine, body, 10.0))
            entry = placing.parse_effect(f"{cause}@{body.where}={amount}", plain.machine, 10.0)
            model = build(placing.with_effects(plain.machine, entry))
            more = model.balance(still, nu, still, model.expand @ model.nominal, u, [])
            assert 0.01 * full < amount * share < 0.5 * full
            assert float((more - plain.balance(still, nu, still, p))[row]) == pytest.approx(amount * share, rel=0.02)


@pytest.mark.parametrize("own", ["skid_robot", "double_loader"])
def test_what_is_advised_has_the_machines_names(own: str) -> None:
    """A robot and a loader have no rolls: neither in what a log hides, nor in what separates causes, nor in the cab."""
    model = model_of(own)
    texts = [c.text for c in identifiability.list_manoeuvres(model, np.zeros(len(model.coordinates), bool))]
    texts += [separating_run._describe_change(run, model.machine) for run in separating_run.DRIVE_CHANGES]
    texts += sheet.set_up_lines(model.machine)
    contacts = [b.where.replace("_", " ") for b in model.machine.contacts]
    assert any(f"drive {contacts[0]}" in text and contacts[-1] in text for text in texts)
    assert [text for text in texts if FOREIGN.search(text)] == []


def test_what_a_straight_log_of_a_skid_steered_robot_hides_is_seen_by_turning() -> None:
    model = model_of("skid_robot")
    texts = [c.text for c in identifiability.list_manoeuvres(model, np.zeros(len(model.coordinates), bool))]
    assert "turn (drive its sides at different speeds)" in texts
    assert not any("sides" in c.text for c in identifiability.list_manoeuvres(model_of("tandem"), np.zeros(7, bool)))


@pytest.fixture(scope="module")
def biased() -> tuple[Motion, Diagnosis]:
    """The robot on its designed drive, with a gyro that reads too much; and what the log shows."""
    model = model_of("skid_robot")
    drawn = json.loads((ROOT / "results" / "machines" / "skid_robot" / "drive.json").read_text())
    torque = excitation.Manoeuvre(np.array(drawn["times_s"]), np.array(drawn["torque"])).sample(100.0)[:801]
    effect = placing.parse_effect("yaw_rate_bias=0.01", model.machine, 8.0)
    wrong = build(placing.with_effects(model.machine, effect))
    motion = simulate(wrong, torque)
    measured = make_log(wrong, motion, seed=3, known=model)
    return motion, diagnose.diagnose(model, [measured], model.machine.filter)


@pytest.mark.slow
def test_a_diagnosis_names_what_a_robot_has(biased: tuple[Motion, Diagnosis]) -> None:
    """Its slips are each wheel's own: the inner ones' and the outer ones' differ in a turn."""
    motion, found = biased
    assert (found.verdict, [f.name for f in found.findings]) == ("named", ["yaw_rate_bias@yaw_rate"])
    (bias,) = found.findings
    assert abs(bias.magnitude - 0.01) < 4 * bias.magnitude_std
    (course,) = residuals.residuals_of_logs(found.after)
    machine = model_of("skid_robot").machine
    (Vx, _, yaw, *spins), slips = motion.nu.T, course.quantities["slip"][1]
    for body, spin in zip(machine.contacts, spins, strict=True):
        assert body.contact is not None
        rim = float(body.contact.radius) * spin
        slip = (Vx - float(body.r) * yaw - rim) / np.hypot(rim, float(body.contact.v_eps))
        (own,) = (x for row, x in slips.items() if row.endswith(body.where.replace("_", " ")))
        assert np.quantile(np.abs(own - slip), 0.99) < 0.1 * np.ptp(slip)  # not at rest, where a log says little


@pytest.mark.parametrize(
    "cause",
    [
        pytest.param("rolling_resistance@front_roll=300", marks=pytest.mark.slow),
        pytest.param("shear_saturation@front_roll=0.2", marks=pytest.mark.slow),
    ],
)
def test_a_diagnosis_names_what_a_roll_has_that_nothing_drives(cause: str) -> None:
    """On the three-wheel roller's designed drive, by the right name, place and amount."""
    model = model_of("three_wheel")
    drawn = json.loads((ROOT / "results" / "machines" / "three_wheel" / "drive.json").read_text())
    torque = excitation.Manoeuvre(np.array(drawn["times_s"]), np.array(drawn["torque"])).sample(100.0)
    wrong = build(placing.with_effects(model.machine, placing.parse_effect(cause, model.machine, 20.0)))
    motion = simulate(wrong, torque, q0=np.array(drawn["start"]))
    found = diagnose.diagnose(model, [make_log(wrong, motion, seed=1, known=model)], model.machine.filter)
    name, _, amount = cause.partition("=")
    assert (found.verdict, [f.name for f in found.findings]) == ("named", [name])
    assert abs(found.findings[0].magnitude - float(amount)) < 2 * found.findings[0].magnitude_std < 0.15 * float(amount)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cause", "rival", "said"),
    [
        ("rolling_resistance@front_left", "rolling_resistance@rear_left", None),
        ("rolling_resistance@front_left", "rolling_resistance@front_right", "tight turns to both sides"),
        ("torque_gain@front_left", "torque_gain@rear_left", "pull with front left alone, then with rear left alone"),
    ],
)
def test_the_run_that_separates_has_the_machines_names(
    biased: tuple[Motion, Diagnosis], cause: str, rival: str, said: str | None
) -> None:
    """No drive tells which of two wheels of one side resists: both push along the same line."""
    effect, _, where = cause.partition("@")
    machine = biased[1].before.machine
    tied = (placing.parse_effect(f"{rival}=1", machine, 8.0),)
    found = replace(biased[1].findings[0], effect=effect, where=where, rivals=tied)
    diagnosis = replace(biased[1], findings=(found,))
    assert separating_run.recommend_run(diagnosis) == said
    pairs = separating_run.rival_pairs(diagnosis)
    assert [(p.machine, p.between) for p in pairs] == ([] if said is None else [(machine, (found.entry, tied[0]))])


def test_footprints_stand_where_the_wheels_do() -> None:
    """The robot turned by a quarter and moved: its front left wheel is now ahead on the left of where it stood."""
    shapes = top_view.footprints(load_machine("skid_robot"), {"x0": 5.0, "y0": 1.0, "theta0": np.pi / 2})
    assert shapes[0].mean(axis=0) == pytest.approx([5 - 0.29153, 1 + 0.249])
    assert np.ptp(shapes[0], axis=0) == pytest.approx([top_view.POINT_WIDTH * 0.16459, 2 * 0.16459])

"""Effects: one declaration each, which prediction, simulation, sensors and signatures all follow from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.drives import designed, gentle
from support.logs import make_log

from excite.diagnosis import fits, score_test, selection
from excite.diagnosis.diagnosis import opposite_phase
from excite.errors import MachineError
from excite.identification import identify
from excite.logs import log, passes
from excite.model import Model, build, signatures, standard_parameters
from excite.model.effects import (
    CATALOGUE,
    DEFAULT_DURATION,
    MAP_NODES,
    Effect,
    PlacedEffect,
    Site,
    ground_map,
    placing,
    soil_table,
    torque_table,
)
from excite.model.machine import EffectEntry, Quantity, machine
from excite.model.mechanics import tree
from excite.simulation import Motion, sensors, simulate
from excite.smoothing import innovations
from excite.trajectories.collocation import transcribe

CONTRACT = (  # CONTRACT.md section 4: the names that others rely on, and their units
    ("stribeck_friction", "N m"),
    ("load_dependent_friction", "-"),
    ("asymmetric_coulomb", "N m"),
    ("asymmetric_viscous", "N m s"),
    ("quadratic_drag", "N m s2"),
    ("friction_warm_up", "-"),
    ("actuator_lag", "s"),
    ("channel_delay", "s"),
    ("torque_gain", "-"),
    ("torque_offset_drift", "N m/s"),
    ("torque_deadband", "N m"),
    ("pump_coupling", "-"),
    ("roll_unbalance", "N m"),
    ("encoder_eccentricity", "rad"),
    ("torque_ripple", "N m"),
    ("shear_saturation", "-"),
    ("lateral_saturation", "-"),
    ("drive_brake_asymmetry", "-"),
    ("compaction_per_pass", "-"),
    ("slip_relaxation", "m"),
    ("rolling_resistance", "N"),
    ("ground_slope", "rad"),
    ("measuring_wheel_radius", "-"),
    ("articulation_backlash", "rad"),
    ("articulation_compliance", "rad/(N m)"),
    ("articulation_stop_spring", "N m/rad"),
    ("vibration_on", "-"),
    ("payload_shift", "kg m"),
)
VA12 = machine.load_machine("va12")


TWO_JOINTS = str(Path(__file__).parents[1] / "support" / "two_joints.toml")


def where(effect: Effect) -> str:
    places = placing.allowed_places(VA12, effect)
    if not places:
        pytest.skip(f"{effect.name} has no place on a roller; it has tests of its own")
    return next(iter(places))


def typical(effect: Effect) -> float:
    bodies, _ = placing.allowed_places(VA12, effect)[where(effect)]
    return effect.typical_magnitude(Site.of(VA12, bodies))


def shaped(text: str, shapes: Mapping[str, float], known: machine.Machine = VA12) -> EffectEntry:
    """`NAME@WHERE=AMOUNT` with these shapes."""
    told = {name: Quantity(value=value, source="assumed") for name, value in shapes.items()}
    return placing.parse_effect(text, known, DEFAULT_DURATION).model_copy(update={"shape": told})


def there(effect: Effect, amount: float, shapes: Mapping[str, float]) -> EffectEntry:
    """At the first place that it may have."""
    return shaped(f"{effect.name}@{where(effect)}={amount!r}", shapes)


def extended(effect: Effect, amount: float, shapes: Mapping[str, float] = MappingProxyType({})) -> Model:
    return build(placing.with_effects(VA12, there(effect, amount, shapes)))


CIRCULAR = {e.name: (e, s) for e in CATALOGUE.values() for s, shape in e.shapes.items() if shape.circular}


@pytest.mark.parametrize(("effect", "circular"), CIRCULAR.values(), ids=list(CIRCULAR))
def test_a_negative_amount_is_a_positive_one_half_a_turn_on(effect: Effect, circular: str) -> None:
    """So that a fit which came to a negative one is given as a positive one."""
    size, told = typical(effect), []
    for amount, phase in ((-size, 0.7), (size, opposite_phase(0.7))):
        model = extended(effect, amount, {circular: phase})
        q, nu, _, u, z = samples(model)
        wheels = np.linspace(-3, 3, q.shape[1]) * np.ones((2, 1))
        read = model.read(q, nu, wheels, u, z, model.nominal).full()
        told.append(np.vstack([model.acceleration(q, nu, u, z, model.nominal).full(), read]))
    np.testing.assert_allclose(told[0], told[1], rtol=1e-9, atol=1e-9)
    assert abs(opposite_phase(0.7)) <= np.pi


def test_both_measuring_wheels_further_out_turn_further_apart(va12: Model) -> None:
    """Turned on the spot, the left one rolls -(D_l + A) angle / R_l, the right one (D_r + A) angle / R_r."""
    model = build(placing.with_effects(VA12, shaped("measuring_wheel_position@measuring_wheels=0.01", {})))
    turned = np.array([0.3, -1.2])
    z = np.zeros((len(model.memory), 2))
    z[model.memory.index("measuring_wheel_position@measuring_wheels.turned")] = turned
    q, u, rolled = np.zeros((6, 2)), np.zeros((3, 2)), np.zeros((2, 2))
    read = model.read(q, q, rolled, u, z, model.nominal).full()
    change = read - va12.read(q, q, rolled, u, np.zeros((0, 2)), va12.nominal).full()
    sensors = [s.name for s in VA12.sensors("full") if s.kind != "torque"]
    np.testing.assert_allclose(change[sensors.index("thetal")], -0.01 * turned / 0.33)
    np.testing.assert_allclose(change[sensors.index("thetar")], 0.01 * turned / 0.33)
    assert np.count_nonzero(change.any(axis=1)) == 2


def moved(model: Model) -> list[np.ndarray]:
    """Coordinates, rates and accelerations (n_q, 50) of a lively motion."""
    rng = np.random.default_rng(0)
    return [size * rng.standard_normal((len(model.coordinates), 50)) for size in (1.0, 1.5, 4.0)]


def torques(model: Model, motion: list[np.ndarray]) -> np.ndarray:
    """Torques (n_q, 50) that a motion needs with all parameters of the machine file, the effect's included."""
    beside = () if model.plain else (np.zeros((len(model.inputs), 50)), np.zeros((len(model.memory), 50)))
    known = {n: value for n, (value, _) in standard_parameters(model.machine).items()}
    known |= {e.name: e.values["A"] for e in model.effects}
    return np.asarray(model.predict(*motion, [known[n] for n in model.base.standard], *beside).full())


@pytest.mark.parametrize("known", [TWO_JOINTS, "ur10"], ids=["two_joints", "ur10"])
def test_a_longer_link_is_that_of_another_machine_file(known: str) -> None:
    """The torques of a file with that length, whose inertia about the joints is the same."""
    one = machine.load_machine(known)
    links = placing.allowed_places(one, CATALOGUE["link_length"])
    assert links
    for place, ((index,), _) in links.items():
        body = one.find(index)
        factor = 1 + 0.02 / np.hypot(float(body.d), float(body.r))
        stretched = {n: Quantity(value=factor * float(getattr(body, n)), source="assumed") for n in ("d", "r")}
        longer = body.model_copy(update=stretched)
        other = one.model_copy(update={"body": tuple(longer if b.index == index else b for b in one.body)})
        with_effect = build(placing.with_effects(one, shaped(f"link_length@{place}=0.02", {}, one)))
        motion = moved(with_effect)
        expected, plain = (torques(build(m), motion) for m in (other, one))
        assert np.abs(expected - plain).max() > 1e-4 * np.abs(plain).max()
        assert np.abs(torques(with_effect, motion) - expected).max() < 1e-9 * np.abs(expected).max()


def test_contacts_that_are_all_larger_roll_like_each_larger_one(va12: Model) -> None:
    together = build(placing.with_effects(VA12, shaped("contact_radius@contacts=0.003", {})))
    rolls = [shaped(f"contact_radius@{roll}=0.003", {}) for roll in ("front_roll", "rear_roll")]
    apart = build(placing.with_effects(VA12, *rolls))
    motion = moved(va12)
    assert np.abs(torques(together, motion) - torques(va12, motion)).max() > 1
    np.testing.assert_allclose(torques(together, motion), torques(apart, motion), rtol=1e-9)


def test_an_arm_off_level_feels_gravity_turned() -> None:
    one = machine.load_machine(TWO_JOINTS)
    tilted = one.model_copy(update={"gravity": (9.81 * 0.01, -9.81, 0.0)})
    model = build(placing.with_effects(one, shaped("ground_slope@machine=0.01", {}, one)))
    motion = moved(model)
    expected, plain = (torques(build(m), motion) for m in (tilted, one))
    assert np.abs(torques(model, motion) - expected).max() < 1e-9 * np.abs(plain).max()
    assert np.abs(expected - plain).max() > 1e-3 * np.abs(plain).max()


def test_effects_have_places_at_every_joint_where_they_make_sense(emps: Model) -> None:
    arm = machine.load_machine("ur10")
    joints = {b.where for b in arm.actuated}
    for name in ("encoder_scale", "encoder_eccentricity", "encoder_delay", "torque_ripple", "torque_deadband"):
        assert set(placing.allowed_places(arm, CATALOGUE[name])) == joints, name
    for name in ("articulation_backlash", "articulation_compliance"):
        assert set(placing.allowed_places(arm, CATALOGUE[name])) == joints, name
        assert placing.allowed_places(emps.machine, CATALOGUE[name])
    for name in ("encoder_eccentricity", "torque_ripple"):  # a slide has no turns
        assert not placing.allowed_places(emps.machine, CATALOGUE[name])
    assert not placing.allowed_places(VA12, CATALOGUE["link_length"])


def test_a_torque_map_is_a_table_between_its_nodes(va12: Model) -> None:
    """Against numpy's interpolation: a torque of the articulation by the front roll's speed, constant beyond."""
    x, f = np.array([-2, -1.5, -1, -0.5, -0.1, 0, 0.3, 0.5, 1, 1.2, 2]), np.arange(11) ** 2 - 30.0
    shapes = torque_table("speed", 1, x.tolist(), f.tolist())
    model = build(placing.with_effects(VA12, shaped("torque_map@articulation=2", shapes)))
    w = np.linspace(-3, 3, 50)
    q, a, nu, u, z = (np.zeros((n, len(w))) for n in (6, 6, 6, 3, 0))
    nu[3] = w
    with_it = model.predict(q, nu, a, model.expand @ model.nominal, u, z).full()
    without = va12.predict(q, nu, a, va12.expand @ va12.nominal).full()
    more = np.zeros_like(with_it)
    more[4] = 2 * np.interp(w, x, f)
    np.testing.assert_allclose(with_it - without, more, atol=1e-6)
    for wrong, said in (({"x3": 5.0}, "x1 to x11 must increase"), ({"of": 9.0}, "of must be the number of a joint")):
        with pytest.raises(MachineError, match=said):
            build(placing.with_effects(VA12, shaped("torque_map@articulation=2", shapes | wrong)))


@pytest.mark.parametrize("changes", ["force", "stiffness"])
@pytest.mark.parametrize("axis", ["lengthwise", "lateral"])
def test_a_map_of_the_soil_adds_a_force_or_a_share_of_a_stiffness(va12: Model, axis: str, changes: str) -> None:
    """From the linear law and numpy's interpolation: forces on the machine going straight on with the front roll."""
    x, f = np.linspace(-0.1, 0.1, MAP_NODES), np.arange(MAP_NODES) / 20 - 0.2
    slip = "lengthwise slip" if axis == "lengthwise" else "lateral slip"
    table = soil_table(slip, x.tolist(), f.tolist(), changes)
    model = build(placing.with_effects(VA12, shaped(f"{axis}_map@front_roll=2", table)))
    n, R, eps = 30, 0.65, 0.05
    q, a, nu, u, z = (np.zeros((k, n)) for k in (6, 6, 6, 3, 0))
    rim, off = 0.8, np.linspace(-0.12, 0.12, n)
    nu[0], nu[1], nu[3], nu[5] = rim, 0.0, rim / R, rim / R
    nu[0 if axis == "lengthwise" else 1] += off
    g = off / np.hypot(rim, eps)
    K = dict(zip(va12.base.standard, va12.expand @ va12.nominal, strict=True))
    law = K["Kx1" if axis == "lengthwise" else "Ky1"] * g
    force = 2 * np.interp(g, x, f) * (1.0 if changes == "force" else law)
    more = model.balance(q, nu, a, model.expand @ model.nominal, u, z).full()
    more -= va12.balance(q, nu, a, va12.expand @ va12.nominal).full()
    row = 0 if axis == "lengthwise" else 1
    np.testing.assert_allclose(more[row], -force, atol=1e-6)
    np.testing.assert_allclose(more[3], R * force if axis == "lengthwise" else 0.0, atol=1e-6)


@pytest.mark.parametrize("begin", [-6.0, 1.0, 50.0])
def test_a_map_of_the_rolled_distance_needs_the_rolls_angle_wherever_it_begins(begin: float) -> None:
    x = begin + np.arange(MAP_NODES)
    table = soil_table("rolled distance", x.tolist(), np.sin(x).tolist(), "stiffness")
    straight = machine.load_machine("va12_straight")
    model = build(placing.with_effects(straight, shaped("lengthwise_map@front_roll=1", table, straight)))
    assert model.active_coordinates == ("theta1",)


@pytest.mark.parametrize("slow", [0.0, 0.6])
def test_dry_friction_may_turn_more_suddenly(va12: Model, slow: float) -> None:
    """From the formula: at rates from far within to far beyond the one over which it turns."""
    k, ws, Fs = 3, 0.02, 174.74
    w = np.array([-0.1, -0.02, -0.004, 0.001, 0.01, 0.3])
    model = build(placing.with_effects(VA12, shaped("friction_transition@front_roll=0.7", {"slow": slow})))
    nu = np.zeros((6, len(w)))
    nu[k] = w
    q, a, u, z = np.zeros((6, len(w))), np.zeros((6, len(w))), np.zeros((3, len(w))), np.zeros((0, len(w)))
    with_it = model.predict(q, nu, a, model.expand @ model.nominal, u, z).full()[k]
    without = va12.predict(q, nu, a, va12.expand @ va12.nominal).full()[k]
    x = 2.0137527 * w / ws  # exp(0.7)
    sign = (1 - slow) * np.tanh(x) + slow * np.arctan(np.pi / 2 * x) / (np.pi / 2)
    np.testing.assert_allclose(with_it - without, Fs * (sign - np.tanh(w / ws)), rtol=1e-6, atol=1e-4)


def test_a_roll_out_of_round_rolls_as_far_as_it_reaches_and_climbs(va12: Model) -> None:
    """Its weight is held by the slope of its outline; where its centre goes as fast as the ground under it the soil
    does nothing; what the soil does acts at the distance of the ground."""
    shapes = {"phase": 0.4, "load": 5e4}
    model = build(placing.with_effects(VA12, shaped("roll_out_of_round@front_roll=0.01", shapes)))
    angle = np.linspace(0, 2 * np.pi, 9)
    distance = 0.65 + 0.01 * np.sin(angle + 0.4)
    q, still, u = (np.zeros((n, 9)) for n in (6, 6, 3))
    q[3] = angle

    def held(on: Model, turns: np.ndarray, soil: float = 1.0) -> np.ndarray:
        """What motors must deliver at 0.8 m/s with the front roll so fast, on soil so stiff."""
        nu = np.zeros((6, 9))
        nu[0], nu[3], nu[5] = 0.8, turns, 0.8 / 0.65
        p = on.expand @ on.nominal * np.where([n.startswith("K") for n in on.base.standard], soil, 1.0)
        rest = (u, np.zeros((0, 9))) if on.effects else ()
        return np.asarray(on.balance(q, nu, still, p, *rest).full())

    rolling = 0.8 / distance
    climbs = np.zeros((6, 9))
    climbs[3] = 5e4 * 0.01 * np.cos(angle + 0.4)
    np.testing.assert_allclose(held(model, rolling) - held(va12, rolling, 0.0), climbs, atol=1e-6)
    slipping = held(model, 1.1 * rolling) - held(model, 1.1 * rolling, 0.0)
    assert np.abs(slipping[0]).min() > 5000
    np.testing.assert_allclose(slipping[3], -distance * slipping[0])


@pytest.mark.parametrize("other", ["slip_relaxation@front_roll=0.03", "drive_brake_asymmetry@front_roll=0.3"])
def test_the_order_of_effects_at_one_roll_does_not_count(other: str) -> None:
    """All see the contact as a roll that is out of round makes it."""
    entries = [shaped("roll_out_of_round@front_roll=0.01", {"phase": 0.4, "load": 5e4}), shaped(other, {})]
    told = []
    for order in (entries, entries[::-1]):
        model = build(placing.with_effects(VA12, *order))
        q, nu, a, u, z = samples(model)
        values = dict(zip(model.base.names, model.nominal, strict=True))
        assert len(values) == len(model.nominal)
        flow = model.flow(q, nu, u, z, model.nominal).full()
        told.append(np.vstack([model.balance(q, nu, a, model.expand @ model.nominal, u, z).full(), flow]))
    np.testing.assert_allclose(told[0], told[1], rtol=1e-12, atol=1e-9)


def test_an_actuator_in_its_play_waits_for_a_push() -> None:
    """Pushed ahead it lies at the front of its play and reads half of it too much; let go, it is still nearer the front
    after some tenths of a second; pushed back by less than its own friction it creeps, to that share of its play if one
    waits; pushed back by more it goes to the rear at once."""
    shapes = {"rubs": 1.0, "damping": 3.0, "breakaway": 400.0}
    model = build(placing.with_effects(VA12, shaped("articulation_backlash=0.004", shapes)))
    t = np.arange(400) / 100
    torque = np.zeros((400, 3))
    torque[:, 1] = np.interp(
        t, [0, 0.2, 1.0, 1.2, 1.7, 1.8, 2.3, 2.5, 4.0], [0, 3e3, 3e3, 0, 0, -200, -200, -3e3, -3e3]
    )
    motion = simulate(model, torque)
    play = (sensors.exact_readings(model, motion)["theta2"] - motion.q[:, 4]) / 0.002
    assert model.memory == ("articulation_backlash@articulation.play",)
    assert play[90] == pytest.approx(1.0, abs=0.02)
    assert play[140] > 0.6
    assert play[170] > play[225] > -200 / 400
    assert play[270] == pytest.approx(-1.0, abs=0.02)


def test_a_pump_is_felt_through_a_hose(va12: Model) -> None:
    """A step of one roll's torque comes to the other by the share A, as a first-order lag has it; at once without."""
    hose: dict[str, float] = {"hose": 1.0, "lag": 0.2}
    model, at_once = (build(placing.with_effects(VA12, shaped("pump_coupling=0.1", x))) for x in (hose, {}))
    t = np.arange(100) / 100
    torque = np.column_stack([1000 * (t >= 0.3), 0 * t, 0 * t])
    motion = simulate(model, torque)
    names = ["pump_coupling@drive.late1", "pump_coupling@drive.late4"]
    assert list(model.memory) == names
    z = motion.memory[:, model.memory.index(names[0])]
    lagged = 1000 * (1 - np.exp(-np.maximum(t - 0.295, 0) / 0.2))
    np.testing.assert_allclose(z, lagged, atol=3.0)
    still, u = np.zeros((6, 1)), torque[-1:].T
    p = va12.expand @ va12.nominal
    felt = [
        (
            va12.balance(still, still, still, p)
            - m.balance(still, still, still, m.expand @ m.nominal, u, motion.memory[-1, : len(m.memory)])
        ).full()
        for m in (model, at_once)
    ]
    assert felt[0][5, 0] == pytest.approx(0.1 * z[-1], abs=1e-6)
    assert felt[1][5, 0] == pytest.approx(100.0, abs=1e-6)


def test_bristles_bend_before_a_joint_slides(va12: Model) -> None:
    """LuGre: from rest friction grows with the angle as a spring does, (Fs + A) / presliding; sliding steadily it is
    Stribeck's, Fs + A exp(-(w / decay)^2) against the motion either way (Canudas de Wit et al. 1995, (1) to (4))."""
    shapes = {"decay": 0.3, "power": 2.0, "bristles": 1.0, "presliding": 0.004}
    model = build(placing.with_effects(VA12, shaped("stribeck_friction@rear_roll=250", shapes)))
    p, still, u = model.expand @ model.nominal, np.zeros(6), np.zeros(3)
    Fs, Fv = (float(p[model.base.standard.index(n)]) for n in ("Fs4", "Fv4"))

    def bends(w: float, z: float) -> float:
        return float(model.flow(still, w * np.eye(6)[5], u, [z], model.nominal)[0])

    def rubs(w: float, z: float) -> float:
        nu = w * np.eye(6)[5]
        soft = np.where([n.startswith("K") for n in model.base.standard], 0, p)
        return float(model.balance(still, nu, still, soft, u, [z])[5])

    assert bends(0.01, 0.0) == pytest.approx(0.01 / 0.004)
    assert rubs(0.0, 0.3) == pytest.approx(0.3 * (Fs + 250))
    for w in (0.15, -0.6, 1.5):
        steady = bends(w, 0.0) / (bends(w, 0.0) - bends(w, 1.0))
        slides = Fs + 250 * np.exp(-((w / 0.3) ** 2))
        assert rubs(w, steady) == pytest.approx(np.sign(w) * slides + Fv * w, rel=1e-3)


def test_friction_builds_up_over_the_presliding_angle(va12: Model) -> None:
    """Dahl: x after a reversal from steady sliding friction is Fs (1 - 2 exp(-x / A)) against the motion."""
    angle = 0.004
    model = build(placing.with_effects(VA12, shaped(f"presliding@rear_roll={angle}", {})))
    p, still, u = model.expand @ model.nominal, np.zeros(6), np.zeros(3)
    Fs, Fv = (float(p[model.base.standard.index(n)]) for n in ("Fs4", "Fv4"))
    soft = np.where([n.startswith("K") for n in model.base.standard], 0, p)
    for w in (0.05, -2.0):
        nu, far = w * np.eye(6)[5], np.linspace(0, 5 * angle, 9)
        bent = solve_ivp(
            lambda t, z, nu=nu: [float(model.flow(still, nu, u, z, model.nominal)[0])],
            (0.0, far[-1] / abs(w)),
            [-np.sign(w)],
            t_eval=far / abs(w),
            rtol=1e-8,
            atol=1e-8,
        ).y[0]
        rubs = [float(model.balance(still, nu, still, soft, u, [z])[5]) for z in bent]
        want = np.sign(w) * Fs * (1 - 2 * np.exp(-far / angle)) + Fv * w
        np.testing.assert_allclose(rubs, want, atol=2e-3 * Fs)


@pytest.mark.parametrize(("second", "share"), [(0.0, 0.0), (1.0, 0.5), (2.0, 1.0), (3.0, 0.5), (4.0, 0.0)])
def test_a_brake_drags_between_its_instants(second: float, share: float, va12: Model) -> None:
    """Dry friction larger by its amount, against the motion either way."""
    model = build(placing.with_effects(VA12, shaped("brake_drag@rear_roll=300", {"begin": 1.0, "end": 3.0})))
    nu = np.zeros((6, 2))
    nu[5] = 1.0, -1.0
    q, a, u = np.zeros((6, 2)), np.zeros((6, 2)), np.zeros((3, 2))
    with_it = model.predict(q, nu, a, model.expand @ model.nominal, u, np.full((1, 2), second)).full()
    without = va12.predict(q, nu, a, va12.expand @ va12.nominal).full()
    want = np.zeros((6, 2))
    want[5] = 300.0 * share, -300.0 * share
    np.testing.assert_allclose(with_it - without, want, atol=0.1)


def samples(model: Model, count: int = 40, seed: int = 0) -> list[np.ndarray]:
    """q, nu, a, u, z of states a roller may be in."""
    rng = np.random.default_rng(seed)
    n = len(model.coordinates)
    q, nu, a = (rng.uniform(-1, 1, (n, count)) for _ in range(3))
    nu[3] = nu[0] / 0.65 + rng.uniform(-0.1, 0.1, count)
    nu[5] = nu[0] / 0.65 + rng.uniform(-0.1, 0.1, count)
    z = rng.uniform(0, 0.5, (len(model.memory), count))
    return [q, nu, a, rng.uniform(-3000, 3000, (3, count)), z]


def test_the_contract_is_in_the_catalogue() -> None:
    assert {(name, CATALOGUE[name].unit) for name, _ in CONTRACT} == set(CONTRACT)


def forms(effect: Effect) -> list[dict[str, float]]:
    """The shapes of every form that an effect has, the plain one first: the first of each that is tried."""
    bodies, _ = placing.allowed_places(VA12, effect)[where(effect)]
    found: dict[tuple[tuple[str, float], ...], dict[str, float]] = {(): {}}
    for shapes in effect.extra_trials(Site.of(VA12, bodies)):
        form = tuple((n, x) for n, x in shapes.items() if n != "A" and effect.shapes[n].only)
        found.setdefault(form, {n: x for n, x in shapes.items() if n != "A"})
    return list(found.values())


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=list(CATALOGUE))
def test_what_an_effect_predicts_is_what_it_does(effect: Effect) -> None:
    """Forward dynamics put into the prediction give the torques that the sensors read, and the regressor is the exact
    slope of the prediction, by differences."""
    for shapes in forms(effect):
        model = extended(effect, typical(effect), shapes)
        q, nu, _, u, z = samples(model)
        X = model.nominal
        a = model.acceleration(q, nu, u, z, X).full()
        Y = model.predict(q, nu, a, model.expand @ X, u, z).full()
        time = z[[model.memory.index("time")]] if "time" in model.memory else np.zeros((1, q.shape[1]))
        gain, offset, _ = (x.full() for x in model.channels(time, X))
        measured = np.zeros_like(Y)
        measured[list(model.actuated)] = gain * u + offset
        assert np.abs(Y - measured).max() < 1e-7 * np.abs(measured).max()
        W = model.stacked_regressor(q, nu, a, u, z)
        for k in range(len(X)):
            step = 1e-5 * model.scale[k] * np.eye(len(X))[k]
            up, down = (model.predict(q, nu, a, model.expand @ (X + s * step), u, z).full() for s in (1, -1))
            slope = ((up - down) / (2e-5 * model.scale[k])).T
            assert (
                np.abs(W[:, :, k] - slope).max() <= 1e-4 * np.abs(slope).max() + 1e-6 * np.abs(Y).max() / model.scale[k]
            )


FORMED = {
    f"{e.name}-{k}": (e, shapes)
    for e in CATALOGUE.values()
    if any(x.form for x in (*e.shapes.values(), *e.memory.values()))
    for k, shapes in enumerate(forms(e))
}


@pytest.mark.parametrize(("effect", "shapes"), FORMED.values(), ids=list(FORMED))
def test_an_effect_has_the_parameters_and_the_memory_of_its_form(effect: Effect, shapes: dict[str, float]) -> None:
    """Every shape that is a parameter changes torques, readings or what is remembered; what other forms remember is
    not there."""
    model = build(placing.with_effects(VA12, there(effect, typical(effect), shapes)), fit_shapes=True)
    q, nu, a, u, z = samples(model)
    wheels = np.ones((2, q.shape[1]))

    def told(X: np.ndarray) -> np.ndarray:
        force = model.predict(q, nu, a, model.expand @ X, u, z).full()
        flow = model.flow(q, nu, u, z, X).full()
        return np.vstack([force, model.read(q, nu, wheels, u, z, X).full(), flow])

    own = model.effects[0].parameters
    for k, name in enumerate(model.base.names):
        if name in own:
            moved = np.abs(
                told(model.nominal + 0.1 * model.scale[k] * np.eye(len(model.nominal))[k]) - told(model.nominal)
            )
            assert moved.max() > 0, name

    def has(form: tuple[str, float] | None) -> bool:
        return form is not None and shapes.get(form[0], effect.shapes[form[0]].default) == form[1]

    assert bool(model.n_dynamic_memory) == any(has(m.form) for m in effect.memory.values())
    assert bool(model.map_inputs) == has(effect.map_form)


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=list(CATALOGUE))
def test_an_effect_of_no_size_changes_nothing(effect: Effect, va12: Model) -> None:
    """A motion of a few seconds, and what all sensors read of it: as without; with a typical amount it differs."""
    t = np.arange(400) / 100
    torque = np.column_stack([1500 * np.sin(1.5 * t), 4000 * np.sin(0.8 * t), 1500 * np.sin(1.5 * t)])
    without = va12
    if effect.name == "presliding":  # friction that builds up over no angle turns at once
        without = build(placing.with_effects(VA12, shaped(f"friction_transition@{where(effect)}=6", {})))
    plain = sensors.exact_readings(without, simulate(without, torque))

    def change(amount: float) -> float:
        model = extended(effect, amount, WITHIN.get(effect.name, {}))
        read = sensors.exact_readings(model, simulate(model, torque))
        return max(float(np.abs(read[n] - x).max() / np.abs(x).max()) for n, x in plain.items())

    size = typical(effect)
    assert change(size * 1e4 if effect.inverse else max(size * 1e-6, 1e-12)) < 1e-4
    assert change(size) > 1e-5 or effect.name in FAR


# Within these seconds; that one shakes the torque channel is a shape.
WITHIN = {"vibration_on": {"begin": 1.0, "length": 2.0, "shake": 0.0}, "brake_drag": {"begin": 1.0, "end": 3.0}}
# Beyond what these seconds hold: a moment late in the log, an angle or a torque that isn't reached.
FAR = ("payload_shift", "articulation_stop_spring", "relief_valve")


@pytest.mark.parametrize("effect", CATALOGUE.values(), ids=list(CATALOGUE))
def test_a_signature_is_what_the_extended_model_has_more(effect: Effect, va12: Model) -> None:
    """The force of a signature is the difference of the two balances, and so is its reading."""
    for shapes in forms(effect):
        model = extended(effect, typical(effect), shapes)
        e = model.effects[0]
        q, nu, a, u, z = samples(model)
        count = q.shape[1]
        t = z[model.memory.index("time")] if "time" in model.memory else np.full(count, 3.0)
        own = z[[k for k, m in enumerate(model.memory) if m != "time"]]
        exact = va12.read(q, nu, np.ones((2, count)), u, np.zeros((0, count)), va12.nominal).full()
        made = signatures(VA12, va12.base.standard, [e])
        p = va12.expand @ va12.nominal
        force = made.force(q, nu, a, u, t[None], own, exact, p).full()
        difference = (
            va12.balance(q, nu, a, p).full() - model.balance(q, nu, a, model.expand @ model.nominal, u, z).full()
        )
        assert np.abs(force - difference).max() < 1e-8 * max(np.abs(va12.balance(q, nu, a, p).full()).max(), 1.0)
        reading = made.reading(q, nu, a, u, t[None], own, exact, p).full()
        read = model.read(q, nu, np.ones((2, count)), u, z, model.nominal).full()
        assert np.abs(reading - (read - exact)).max() < 1e-12


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("no_such_thing=1", "effect no_such_thing: unknown: `excite docs` lists all"),
        ("backlash=0.01", "is articulation_backlash meant[?]"),
        ("torque_ripples@front_roll=1", "unknown, is torque_ripple .*meant[?]"),
        ("shear_saturation=0.2", "where must be one of front_roll, rear_roll"),
        ("shear_saturation@articulation=0.2", "where must be one of front_roll, rear_roll"),
        ("torque_deadband@rear_roll=-3", "amount must be > 0"),
        ("ground_slope", "NAME\\[@WHERE\\]=AMOUNT"),
        ("ground_slope=nan", "NAME\\[@WHERE\\]=AMOUNT"),
        ("../x@y=1", "NAME\\[@WHERE\\]=AMOUNT"),
    ],
)
def test_a_wrong_effect_is_one_clear_line(text: str, said: str) -> None:
    with pytest.raises(MachineError, match=said) as caught:
        placing.parse_effect(text, VA12, 60.0)
    assert "\n" not in str(caught.value)


def test_an_effect_twice_at_one_place_is_refused() -> None:
    entry = placing.parse_effect("ground_slope=0.01", VA12, 60.0)
    with pytest.raises(MachineError, match="twice"):
        build(placing.with_effects(VA12, entry, entry))


def test_phases_and_places_follow_the_machine() -> None:
    """The straight machine has no articulation and no gyro; a machine without contacts has joints only."""
    straight, bench = machine.load_machine("va12_straight"), machine.load_machine("emps")
    assert not placing.allowed_places(straight, CATALOGUE["articulation_backlash"])
    assert not placing.allowed_places(straight, CATALOGUE["yaw_rate_bias"])
    assert set(placing.allowed_places(bench, CATALOGUE["asymmetric_viscous"])) == {"carriage"}
    assert not placing.allowed_places(bench, CATALOGUE["ground_slope"])
    assert isinstance(placing.place_effect(bench, placing.parse_effect("torque_gain=0.1", bench, 10.0)), PlacedEffect)


LOADED = {
    "va12": 2,
    "single_drum": 3,
    "tandem": 0,
    "double_loader": 2,
    "pendulum_loader": 4,
    "skid_robot": 0,
    "three_wheel": 0,
}


@pytest.mark.parametrize(("name", "body"), LOADED.items())
def test_a_load_slides_on_the_last_chassis(name: str, body: int) -> None:
    """Long after, the machine is one whose first moment is larger by the amount; no chassis that turns, no place."""
    known = machine.load_machine(name)
    plain, amount = build(known), 3.0
    shifted = build(placing.with_effects(known, placing.parse_effect(f"payload_shift={amount}", known, 10.0)))
    n, rng = len(plain.coordinates), np.random.default_rng(0)
    q, nu, a = rng.uniform(-1, 1, (3, n))
    u, late = np.zeros(len(plain.inputs)), np.full(len(shifted.memory), 1e3)
    p = plain.expand @ plain.nominal
    moved = p.copy()
    moved[plain.base.standard.index(f"MX{body}")] += amount
    want = plain.balance(q, nu, a, moved).full()
    assert shifted.balance(q, nu, a, shifted.expand @ shifted.nominal, u, late).full() == pytest.approx(want, rel=1e-9)
    assert np.abs(want - plain.balance(q, nu, a, p).full()).max() > 0.1


@pytest.mark.parametrize(("name", "body"), LOADED.items())
def test_a_load_is_put_on(name: str, body: int) -> None:
    """Long after, the machine is one with another mass there: a point's mass, first moment and inertia."""
    known = machine.load_machine(name)
    plain, mass, x = build(known), 30.0, -1.5
    told = {"instant": 5.0, "takes": 0.5, "arm": x, "mass": 1 / x, "recoil": 0.0}
    loaded = build(placing.with_effects(known, shaped(f"payload_shift={mass * x}", told, known)))
    n, rng = len(plain.coordinates), np.random.default_rng(1)
    q, nu, a = rng.uniform(-1, 1, (3, n))
    u, late = np.zeros(len(plain.inputs)), np.full(len(loaded.memory), 1e3)
    p = plain.expand @ plain.nominal
    moved = p.copy()
    for letter, change in (("M", mass), ("MX", mass * x), ("ZZ", mass * x**2)):
        moved[plain.base.standard.index(f"{letter}{body}")] += change
    want = plain.balance(q, nu, a, moved).full()
    assert loaded.balance(q, nu, a, loaded.expand @ loaded.nominal, u, late).full() == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize("V", [-1.5, -0.02, 0.01, 1.2])
def test_what_resists_rolling_may_grow_with_speed(va12: Model, V: float) -> None:
    """A (1 + rise V^2) against the motion, fully so from a speed on that the file tells."""
    model = build(placing.with_effects(VA12, shaped("rolling_resistance@front_roll=200", {"rise": 0.2, "soft": 0.05})))
    still, nu = np.zeros(6), np.array([V, 0, 0, V / 0.65, 0, V / 0.65])
    u, z = np.zeros(len(model.inputs)), np.zeros(len(model.memory))
    plain = va12.balance(still, nu, still, va12.expand @ va12.nominal).full()[:, 0]
    felt = plain - model.balance(still, nu, still, model.expand @ model.nominal, u, z).full()[:, 0]
    assert felt == pytest.approx([-200 * (1 + 0.2 * V**2) * np.tanh(V / 0.05), 0, 0, 0, 0, 0], abs=1e-6)


def compacting(known: machine.Machine, counted: float) -> Model:
    entry = placing.parse_effect("compaction_per_pass=0.3", known, 24.0)
    told = {**entry.shape, "counted": Quantity(value=counted, source="assumed")}
    return build(placing.with_effects(known, entry.model_copy(update={"shape": told})))


def with_and_without_soil(model: Model, nu: np.ndarray) -> tuple[np.ndarray, ...]:
    """Forces (n_q,) at these velocities, as the machine file has the soil and with none."""
    still, hard = np.zeros(len(model.coordinates)), model.expand @ model.nominal
    soft = np.where([name.startswith("K") for name in model.base.standard], 0, hard)
    return tuple(model.balance(still, nu, still, p).full()[:, 0] for p in (hard, soft))


def to_and_fro(model: Model) -> Motion:
    """Six ways forth and back, with five reversals between them."""
    t = np.arange(0, 24, 1 / 100)
    return simulate(model, np.column_stack([1500 * np.sign(np.sin(2 * np.pi * t / 8 + 0.7))] * 2))


def test_compaction_counts_the_way_or_reversals(straight: Model) -> None:
    for counted, name in ((0.0, "distance"), (1.0, "reversals")):
        model = compacting(straight.machine, counted)
        motion = to_and_fro(model)
        speed = motion.nu[:, 0]
        assert np.count_nonzero(np.diff(np.sign(speed[np.abs(speed) > 0.05]))) == 5
        way = np.trapezoid(np.abs(speed), motion.t)
        told = motion.memory[-1, model.memory.index(f"compaction_per_pass@drive.{name}")]
        assert told == (pytest.approx(way, rel=0.02) if counted == 0 else pytest.approx(5, abs=0.1))


@pytest.mark.parametrize(
    ("counted", "told"), [(0.0, {"distance": 15.0}), (1.0, {"reversals": 1.5, "facing": 0.3}), (2.0, {})]
)
def test_soil_is_as_stiff_as_what_is_counted_says(straight: Model, counted: float, told: dict[str, float]) -> None:
    """The way 15 m, or one and a half reversals of ten metres each, make 1 - 1/e of what comes; two passes over the
    front roll's whole width and a third over half of it, and one over the rear roll's, what each of these has."""
    model = compacting(straight.machine, counted)
    n = len(model.coordinates)
    nu = np.array([1.0, *[1.02 / 0.65] * (n - 1)])
    over = {"over1.1": 1.0, "over1.2": 1.0, "over1.3": 0.5, "over4.1": 1.0}

    def push(known: dict[str, float]) -> np.ndarray:
        z = np.array([known.get(m if m in over else m.rpartition(".")[2], 0.0) for m in model.memory])
        p = model.expand @ model.nominal
        return model.balance(np.zeros(n), nu, np.zeros(n), p, np.zeros(2), z).full()[:, 0]

    bare, free = with_and_without_soil(straight, nu)
    assert push({}) == pytest.approx(bare, rel=1e-9)
    front, rear = (
        [1 - np.exp(-1)] * 2 if told else (1 - (np.exp(-20 / 15) + np.exp(-30 / 15)) / 2, 1 - np.exp(-10 / 15))
    )
    felt = (push(told or over) - free) / (bare - free) - 1
    assert felt[1:] == pytest.approx(0.3 * np.array([front, rear]), rel=1e-6)


def test_passes_are_counted_place_by_place(straight: Model) -> None:
    """Against a map of the lane in cells of 5 cm, which every roll enters: two ways forth and two back, half a way,
    then on to where none has been."""
    model = compacting(straight.machine, 2.0)
    N = 6001
    way = np.interp(np.arange(N) / 100, [0, 10, 20, 30, 40, 45, 60], [0, 10, 0, 10, 0, 5, 20])
    nu = np.zeros((N, 3))
    nu[:, 0] = np.gradient(way, 0.01)
    told = passes(model, np.zeros((N, 3)), nu, 0.01).reshape(N, 2, ground_map.MAX_PASSES).sum(axis=2)

    cells, under = np.zeros(1000, int), [-1, -1]
    places = [tree.body_poses(straight.machine, {})[b.index][1][0] for b in straight.machine.contacts]
    counted = np.zeros((N, 2))
    for k, at in enumerate(way):
        for roll, x in enumerate(places):
            cell = int(np.floor((at + x + 25) / 0.05))
            if cell != under[roll]:
                cells[cell] += 1
                under[roll] = cell
            counted[k, roll] = cells[cell] - 1
    error = np.abs(told - counted)
    assert counted.max() == 9
    assert np.mean(error < 0.05) > 0.85  # all but where another ground begins
    assert error.mean() < 0.1


def test_a_map_of_the_ground_sees_tracks_that_part_cross_and_overlap() -> None:
    """Of a roll two metres wide: half of it on the track of the last pass, all of it, across it, and beside it."""
    ground, width = ground_map.GroundMap([2.0]), 2.0

    def along(x: float, y: float, turned: float = 0.0) -> float:
        """How often was passed over what is under the roll in the middle of ten metres, ahead from there."""
        on = np.arange(-5, 5, 0.01)[:, None] * [np.cos(turned), np.sin(turned)] + [x, y]
        across = width * np.array([-np.sin(turned), np.cos(turned)])
        return float([ground.update(np.concatenate([at, across])[None]).sum() for at in on][500])

    assert along(0.013, 0.017) == 0
    assert along(0.013, 1.017) == pytest.approx(0.5, abs=0.08)
    assert along(0.013, 0.517) == pytest.approx(1.5, abs=0.1)  # once all of it, the half again
    assert along(0.013, 0.017, np.pi / 2) == pytest.approx(2.0, abs=0.25)  # in the middle of the two tracks' three
    assert along(20.0, 0.017) == 0


@pytest.mark.parametrize(("swing", "often"), [(0.0, 0), (1e-4, 0), (0.025, 0), (1.0, 11)])
def test_who_swings_about_a_place_does_not_pass_over_it(swing: float, often: int) -> None:
    """On the very border of two cells; to a metre and back is a pass each time, the last of which has just begun."""
    ground = ground_map.GroundMap([2.1])
    for x in swing * np.sin(np.arange(0, 2 * np.pi * 6 + 0.01, np.pi / 200)):
        told = ground.update(np.array([[x, 0.0, 0.0, 2.1]]))
    assert told.sum() == pytest.approx(often, abs=0.05)


def test_what_is_nowhere_is_on_no_map() -> None:
    ground = ground_map.GroundMap([2.1])
    for x in (0.013, np.nan, np.inf, 1.013, 0.013):
        told = ground.update(np.array([[x, 0.0, 0.0, 2.1]]))
    assert told.sum() == pytest.approx(1, abs=0.01)


def test_a_simulation_and_a_smoothed_motion_look_at_the_same_map(va12: Model) -> None:
    """In a bend, to and fro: the pose that follows from velocities is the one that was integrated."""
    model = compacting(va12.machine, 2.0)
    t = np.arange(0, 20, 0.01)
    push, steer = 2500 * np.sin(2 * np.pi * t / 10), 2000 * np.sin(2 * np.pi * t / 20)
    motion = simulate(model, np.column_stack([push, steer, push]))
    told = passes(model, motion.q, motion.nu, 0.01)
    kept = motion.memory[:, model.n_dynamic_memory :]
    assert kept.max() > 0.9
    assert np.abs(motion.q[:, 2]).max() > 0.2
    assert np.mean(np.abs(told - kept)) < 0.002


def test_what_a_map_tells_is_identified_and_designed_with(straight: Model) -> None:
    """The amount comes out of a log of three ways to and fro; and the program that designs takes from a motion nearby
    what the map tells, at every node."""
    model = compacting(straight.machine, 2.0)
    motion = to_and_fro(model)
    table = sensors.measure(model, motion, kit="full", seed=2)
    estimate = identify(model, [log.from_table(table, model.machine)], "joint")
    k = estimate.names.index("compaction_per_pass@drive")
    assert abs(estimate.value[k] - 0.3) < 3 * estimate.std[k]
    assert estimate.std[k] < 0.02
    sizes = dict.fromkeys(model.coordinates, 1.0) | {c + "'": 1.0 for c in model.coordinates}
    problem = model.machine.problems["S40"].model_copy(update={"duration_s": Quantity(value=24.0, source="assumed")})
    tr = transcribe(model, problem, sizes, 48, motion)
    assert not set(tr.state_names) & set(model.map_inputs)
    told = motion.memory[:, model.n_dynamic_memory :]
    assert tr.map_values[2:-1:3] == pytest.approx(told[50::50], abs=0.1)
    entries = tr.values(np.full((48 * tr.nodes, tr.n_s), 0.3), tr.map_values)[2]
    amount = np.array([len(model.scale) - 1 in (a, b) for a, b in zip(tr.rows, tr.columns, strict=True)])
    assert np.abs(entries[-3:, amount]).max() > 100 * np.abs(entries[:3, amount]).max()


@pytest.mark.slow
def test_every_log_begins_on_ground_of_its_own(straight: Model) -> None:
    """Two logs of the same ways tell the amount as two of one map each; put onto one map, the second would begin on
    what the first has left, and tell another one."""
    model = compacting(straight.machine, 2.0)
    motion = to_and_fro(model)
    logs = [make_log(model, motion, kit="full", seed=k) for k in (2, 5)]
    one, two = (identify(model, some, "joint") for some in (logs[:1], logs))
    k = two.names.index("compaction_per_pass@drive")
    assert abs(two.value[k] - 0.3) < 3 * two.std[k]
    assert 0.5 < two.std[k] / one.std[k] < 0.85


def test_wheels_beside_each_other_pass_over_ground_of_their_own() -> None:
    """Of two alike on one axle each counts its own passes, as one alone does; of one that overlaps half of it, what
    that did there before and does now."""

    def often(*across: float) -> float:
        """How often the first was on the ground that it comes back to."""
        ground = ground_map.GroundMap([1.0] * len(across))
        for x in [*np.arange(0.013, 8, 0.01), *np.arange(8, 4, -0.01)]:
            told = ground.update(np.array([[x, y + 0.017, 0.0, 1.0] for y in across]))
        return float(told[: ground_map.MAX_PASSES].sum())

    assert often(0.0) == pytest.approx(1)
    assert often(0.0, 1.2) == pytest.approx(1)
    assert often(0.0, 0.5) == pytest.approx(1 + 0.5 * 2, abs=0.2)
    assert often(0.0, 0.0) == pytest.approx(3, abs=0.2)


def test_a_shape_is_as_unsure_as_where_it_begins(straight: Model) -> None:
    """A quarter of that, or of its usual size where that is more: 15 m a pass."""
    for each, unsure in ((5.0, 3.75), (60.0, 15.0)):
        entry = placing.parse_effect("compaction_per_pass=0.3", straight.machine, 24.0)
        entry = entry.model_copy(update={"shape": entry.shape | {"pass": Quantity(value=each, source="assumed")}})
        model = build(placing.with_effects(straight.machine, entry), fit_shapes=True)
        assert model.scale[model.base.names.index("compaction_per_pass@drive.pass")] == unsure


def test_a_way_of_counting_that_there_is_not(straight: Model) -> None:
    with pytest.raises(MachineError, match=r"shape counted must be one of 0, 1, 2 \(got 3\)"):
        compacting(straight.machine, 3.0)


def test_points_between_the_grids_are_tried_for_every_way_of_counting(straight: Model) -> None:
    found = score_test.candidates(straight.machine, ("theta1", "theta4"), 40.0)
    passes = [x for x in found if x.name == "compaction_per_pass@drive" and x.placed.values["pass"] == 15.0]
    assert len({x.variant for x in passes}) == 3
    for one in passes:
        near = score_test.refine_candidates([one], straight.machine, 40.0)
        assert {x.variant for x in near} == {one.variant}
        tried = sorted({x.placed.values["pass"] for x in near})
        assert len(tried) == 5
        assert tried[0] < 9
        assert tried[-1] > 35


@pytest.mark.parametrize(
    ("hardening", "power", "pressed", "further"),
    [(0.0, 2.0, 1e3, 2e3), (0.2, 2.0, 1.2e3, 3.6e3), (0.2, 1.0, 1.2e3, 2.8e3)],
)
def test_stops_may_be_out_of_the_middle_and_harden(
    hardening: float, power: float, pressed: float, further: float
) -> None:
    """A stop that only one side reaches pushes back there alone, from where it is reached on, and the more so the
    further it is pressed."""
    entry = shaped(
        "articulation_stop_spring=10000", {"stop": 0.4, "centre": -0.2, "hardening": hardening, "power": power}
    )
    plain, sprung = build(VA12), build(placing.with_effects(VA12, entry))
    still = np.zeros(len(plain.coordinates))

    def more(angle: float) -> float:
        q = still.copy()
        q[4] = angle
        u = np.zeros(3)
        own = sprung.balance(q, still, still, sprung.expand @ sprung.nominal, u, []).full()
        return float((own - plain.balance(q, still, still, plain.expand @ plain.nominal).full())[4, 0])

    assert more(0.3) == pytest.approx(pressed, rel=0.01)
    assert more(0.4) == pytest.approx(further, rel=0.01)
    assert abs(more(0.19)) < 5
    assert abs(more(-0.3)) < 5


def test_a_rate_has_no_errors_of_an_angle() -> None:
    """The front roll, the articulation and the left measuring wheel logged as rates: no encoder that is eccentric, no
    play beside it; what a wrong radius does stays."""
    rates = ("theta1", "theta2", "thetal")
    rated = [
        s.model_copy(update={"unit": "rpm", "counts_per_turn": None}) if s.name in rates else s for s in VA12.sensor
    ]
    known = VA12.model_copy(update={"sensor": tuple(rated)})

    def offered(name: str) -> set[str]:
        return set(placing.allowed_places(known, CATALOGUE[name]))

    assert offered("encoder_eccentricity") == {"rear_roll", "measuring_wheel_right"}
    assert not offered("articulation_backlash") | offered("articulation_compliance")
    assert offered("articulation_stop_spring") == {"articulation"}
    wheels = {"measuring_wheel_left", "measuring_wheel_right", "measuring_wheels"}
    assert offered("measuring_wheel_radius") == wheels
    names = {c.name for c in score_test.candidates(known, [s.name for s in known.sensors("full")], 60.0)}
    assert "encoder_eccentricity@rear_roll" in names
    assert not names & {"encoder_eccentricity@front_roll", "articulation_backlash@articulation"}
    with pytest.raises(MachineError, match="where must be one of rear_roll, measuring_wheel_right"):
        placing.parse_effect("encoder_eccentricity@front_roll=0.01", known, 60.0)


def test_effects_of_one_contact_on_others_need_a_drive() -> None:
    """Of the three-wheel roller the steered front roll is driven by nothing: nothing couples to it."""
    known = machine.load_machine("three_wheel")
    assert placing.allowed_places(known, CATALOGUE["pump_coupling"]) == {"drive": ((1, 2), ())}
    model = build(placing.with_effects(known, placing.parse_effect("pump_coupling=0.1", known, 10.0)))
    still, torque = np.zeros(len(model.coordinates)), np.array([100.0, 200.0, 0.0])
    more = model.balance(still, still, still, model.expand @ model.nominal, torque, []).full()
    assert more[list(model.actuated), 0] == pytest.approx([-20, -10, 0])
    assert not placing.allowed_places(machine.load_machine("va12_straight"), CATALOGUE["payload_shift"])


THREE = machine.load_machine("three_wheel")
TOWED = {
    e.name: e for e in CATALOGUE.values() if any(4 in bodies for bodies, _ in placing.allowed_places(THREE, e).values())
}


def test_what_needs_no_motor_may_sit_at_a_contact_that_has_none() -> None:
    """The steered front roll of the three-wheel roller: its soil, its bearing, its encoder, but no motor's torque."""
    needing = {e.name for e in CATALOGUE.values() if {"drives", "driven_contacts"} & set(e.places)} | {"pump_coupling"}
    possible = {e.name for e in CATALOGUE.values() if {"joints", "contacts"} & set(e.places)}
    assert set(TOWED) == possible | {"compaction_per_pass"}
    assert not set(TOWED) & needing
    assert {e.name for e in CATALOGUE.values() if e.soil or e.push} <= set(TOWED)
    assert placing.allowed_places(THREE, CATALOGUE["compaction_per_pass"]) == {"drive": ((1, 2, 4), ())}
    with pytest.raises(MachineError, match="where must be one of left_roll, right_roll"):
        placing.parse_effect("torque_deadband@front_roll=100", THREE, 10.0)


@pytest.mark.parametrize("effect", TOWED.values(), ids=list(TOWED))
def test_at_a_towed_contact_prediction_is_dynamics(effect: Effect) -> None:
    """No torque acts on its joint, whatever the effect does there; and the effect does something."""
    place = next(w for w, (bodies, _) in placing.allowed_places(THREE, effect).items() if 4 in bodies)
    amount = effect.typical_magnitude(Site.of(THREE, (4,), 10.0))
    model = build(placing.with_effects(THREE, placing.parse_effect(f"{effect.name}@{place}={amount}", THREE, 10.0)))
    plain, rng, n = build(THREE), np.random.default_rng(2), 40
    q, nu = rng.uniform(-1, 1, (2, len(model.coordinates), n))
    u, z = rng.uniform(-2000, 2000, (3, n)), rng.uniform(0.1, 0.5, (len(model.memory), n))
    z[[m == "time" for m in model.memory]] = 5.0
    X = model.nominal
    a = model.acceleration(q, nu, u, z, X).full()
    Y = model.predict(q, nu, a, model.expand @ X, u, z).full()
    towed = model.coordinates.index("theta4")
    assert np.abs(Y[towed]).max() < 1e-7 * np.abs(Y).max()
    read = [m.read(q, nu, np.ones((2, n)), u, *x).full() for m, x in ((model, (z, X)), (plain, (z[:0], plain.nominal)))]
    moved = np.abs(a - plain.acceleration(q, nu, u, plain.nominal).full()).max()
    assert moved > 1e-6 or np.abs(read[0] - read[1]).max() > 1e-6


# ------------------------------------------------------------------------------------------------ noise is no effect


@pytest.mark.slow
def test_noise_of_torques_is_no_gain_and_no_delay() -> None:
    """Along a drive that asks little of the articulation, whose torque sensor's noise is a good part of its reading:
    taken from noisy torques, what a gain or a delay would do follows that noise (z of 5.7, gain of 27 on this log)."""
    known = build(VA12)
    measured = log.from_table(sensors.measure(known, designed("R60", known), seed=3), VA12)
    plain = fits.fit_machine(VA12, [measured], VA12.filter)
    entry = EffectEntry(name="torque_gain", where="articulation", amount=Quantity(value=0.005, source="assumed"))
    found = fits.refit(placing.with_effects(VA12, entry), plain)
    at = found.model.base.names.index("torque_gain@articulation")
    assert abs(found.fit.X[at]) < 3.5 * found.fit.std[at]
    assert found.fit.cost < plain.fit.cost + 1  # both are found to so much
    delays = [x for x in selection.candidates_of(plain) if x.name == "channel_delay@articulation"]
    form = plain.form(delays).reduced()
    own = np.arange(len(form.group), len(form.right_side))
    assert len(own) == len(delays) > 0
    assert (form.right_side[own] ** 2 / np.diag(form.information)[own]).max() < 12


@pytest.mark.parametrize("samples", [350, 1001, 1201, 2001, 2137])
def test_stretch_by_stretch_tells_what_the_whole_log_does(
    samples: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is left over at its end."""
    way, known = _along(straight, samples)
    found = score_test.SignatureColumns(way, known).products()
    monkeypatch.setattr(innovations, "BATCH_SIZE", 10**9)
    once, _ = _along(straight, samples)
    for name in ("E", "start_response", "transitions"):
        np.testing.assert_allclose(getattr(way.white, name), getattr(once.white, name), rtol=1e-5, atol=1e-5)
    off = found - score_test.SignatureColumns(once, known).products()
    size = np.sqrt(np.diag(found))
    assert (np.abs(off) <= 1e-4 * np.outer(size, size)).all()


@pytest.mark.parametrize("far", [1e30, np.inf, np.nan])
def test_what_has_no_bounds_tells_nothing_and_spoils_nothing(far: float, straight: Model) -> None:
    """From wherever on it has none."""
    way, known = _along(straight, 2137)
    whole = score_test.SignatureColumns(way, known).products()
    made = score_test.SignatureColumns(way, known)
    bounded = made.reading

    def reading(*held: np.ndarray) -> list[np.ndarray]:
        told = bounded(*held)[0].copy()
        told[held[4][:, 0] > 15.0, :, 1] = far
        return [told]

    made.reading = cast(Any, reading)
    form, own = made.products(), way.white.E.shape[2]
    assert not form[own + 1].any()
    assert not form[:, own + 1].any()
    rest = np.delete(np.arange(len(form)), own + 1)
    np.testing.assert_array_equal(form[np.ix_(rest, rest)], whole[np.ix_(rest, rest)])


def _along(model: Model, samples: int) -> tuple[score_test.FittedLog, list[score_test.Candidate]]:
    """A fitted log without anything hidden, and some candidates."""
    one = make_log(model, gentle(model, (samples - 1) / 100), seed=3)
    stage = fits.fit_machine(model.machine, [one], model.machine.filter)
    names = "ground_slope", "torque_gain", "measuring_wheel_radius"
    every = score_test.candidates(model.machine, [s.name for s in stage.data.space.sensors], samples / 100)
    return stage.fitted_logs[0], score_test.renumber_columns([x for x in every if x.placed.effect.name in names])


@pytest.mark.parametrize("duration", [2.0, 5.0, 7.0, 10.0, 12.0, 15.0, 60.0])
def test_every_candidate_can_be_tried_closer(duration: float) -> None:
    """Also in logs so short that there is one point to try."""
    every = score_test.candidates(VA12, [s.name for s in VA12.sensors("full")], duration)
    assert len(every) > 100
    for x in every:
        nearby = score_test.refine_candidates([x], VA12, duration)
        assert all(y.name == x.name for y in nearby)


def test_what_acts_between_two_instants_begins_before_it_ends() -> None:
    """On the grid and about its points; and instants come so near to one that a fit finds it, in logs of any length."""
    for duration in (60.0, 600.0):
        found = [x for x in score_test.candidates(VA12, [], duration) if "begin" in x.placed.values]
        assert {x.placed.effect.name for x in found} == {"brake_drag", "vibration_on"}
        tried = found
        reaches = [*selection.REFINEMENT_REACHES]
        while reaches[-1] * duration / selection.TIME_TRIAL_SHARE > selection.INSTANT_ACCURACY_S:
            reaches.append(reaches[-1] * selection.REFINEMENT_REACHES[-1])
        for reach in reaches:
            found = score_test.refine_candidates(tried, VA12, duration, reach)
            for values in (x.placed.values for x in found):
                end = values.get("end", values["begin"] + values.get("length", 0.0))
                assert 0 <= values["begin"] < end <= duration
        ends = sorted({x.placed.values["end"] for x in found if x.placed.effect.name == "brake_drag"})
        assert np.diff(ends).min() < 1.0

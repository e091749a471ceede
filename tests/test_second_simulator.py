"""The second roller against the program, and each hidden cause against its physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, replace

import casadi as ca
import numpy as np
import pytest
from support import causes, plant
from support.causes import CAUSES
from support.plant import Machine, Motion, Scene, System
from support.surprises import SURPRISES, surprise

from excite.model import Model, build
from excite.model.effects import placing
from excite.model.machine import EffectEntry, Quantity
from excite.simulation import simulate

EVERYWHERE = [(name, place) for name, cause in CAUSES.items() for place in cause.places]
ONCE = [(name, cause.places[k % len(cause.places)]) for k, (name, cause) in enumerate(CAUSES.items())]


def hiding(name: str, place: str, amount: float, seed: int = 0) -> System:
    scene = Scene()
    causes.hide(scene, name, place, amount, seed)
    return scene.assemble()


def surprised(name: str, size: float, seed: int = 0) -> System:
    scene = Scene()
    surprise(scene, name, size, seed)
    return scene.assemble()


@pytest.fixture(scope="module")
def driven() -> Motion:
    """Twenty seconds forth and back, weaving."""
    return plant.drive(plant.bare(), Machine(), plant.plan("slalom", 20, 4), 4)


# ------------------------------------------------------------------------------------------------- two machines
@pytest.mark.parametrize(("seed", "manoeuvre"), [(None, "slalom"), (1, "stop_and_go"), (2, "circles")])
def test_the_second_roller_moves_as_the_program_says(va12: Model, seed: int | None, manoeuvre: str) -> None:
    machine = Machine() if seed is None else plant.vary(seed)
    motion = plant.drive(plant.bare(), machine, plant.plan(manoeuvre, 25, 7), 7)
    base = plant.base(machine)
    theirs = simulate(va12, motion.u, np.array([base[n] for n in va12.base.names]))
    values = plant.ideal(plant.bare(), machine, motion)
    for k in range(6):
        scale = np.abs(theirs.q[:, k]).max()
        assert np.abs(motion.x[:, k] - theirs.q[:, k]).max() < 1e-5 * scale, va12.coordinates[k]
        if k > 1:  # theirs is in chassis axes for the first two
            assert np.abs(motion.x[:, 6 + k] - theirs.nu[:, k]).max() < 1e-5 * np.abs(theirs.nu[:, k]).max()
    wheels = np.column_stack([values["thetal_rad"], values["thetar_rad"]])
    assert np.abs(wheels - theirs.wheels).max() < 1e-5 * np.abs(wheels).max()
    assert np.abs(values["vy_m_s"] - theirs.nu[:, 1]).max() < 1e-5


def test_base_parameters_by_hand_are_the_programs(va12: Model) -> None:
    base = plant.base(Machine())
    assert set(base) == set(va12.base.names)
    np.testing.assert_allclose([base[n] for n in va12.base.names], va12.nominal, rtol=1e-9, atol=1e-9)


def test_coarse_steps_are_fine_enough(driven: Motion) -> None:
    scene = Scene()
    scene.stiff = True
    fine = plant.play(scene.assemble(), Machine(), driven.u)
    assert np.abs(fine.x - driven.x).max(axis=0) == pytest.approx(0, abs=1e-6)


def test_what_goes_in_as_work_is_motion_or_heat() -> None:
    """Without friction and with a soil that hardly slips, the torques' work is the kinetic energy."""
    machine = replace(Machine(), Fv1=0, Fs1=0, Fv2=0, Fs2=0, Fv4=0, Fs4=0, Kx1=-5e6, Ky1=-5e6, Kx4=-5e6, Ky4=-5e6)
    torque = np.zeros((301, 3))
    torque[:, 0] = torque[:, 2] = 900 * np.minimum(np.arange(301) / 100, 1)
    scene = Scene()
    scene.stiff = True
    motion = plant.play(scene.assemble(), replace(machine, v_eps=2.0), torque)
    work = np.trapezoid(np.sum(motion.u * motion.x[:, 9:12], axis=1), motion.t)
    v, w = np.hypot(motion.x[-1, 6], motion.x[-1, 7]), motion.x[-1, 9:12]
    energy = 11000 * v**2 / 2 + (machine.ZZ1 * w[0] ** 2 + machine.ZZ4 * w[2] ** 2) / 2
    assert energy == pytest.approx(work, rel=0.02)


# ------------------------------------------------------------------------------------------- people and sensors
@pytest.mark.parametrize("manoeuvre", plant.MANOEUVRES)
def test_people_keep_the_machine_within_its_limits(manoeuvre: str) -> None:
    machine = plant.vary(6)
    motion = plant.drive(plant.bare(), machine, plant.plan(manoeuvre, 30, 8), 8)
    assert (np.abs(motion.u).max(axis=0) <= plant.TORQUE).all()
    assert (np.abs(np.diff(motion.u, axis=0)).max(axis=0) <= np.array(plant.TORQUE_RATE) / 100 * 1.000001).all()
    assert np.abs(plant.slips(plant.bare(), machine, motion)).max() < 0.15
    assert np.abs(motion.x[:, 4]).max() < 0.6
    assert np.abs(motion.x[:, [9, 11]]).max() * machine.R < 2.2
    assert np.ptp(motion.x[:, 3]) > 2  # it does drive


def test_a_log_has_whole_counts_noise_and_the_kits_columns(driven: Motion) -> None:
    exact = plant.ideal(plant.bare(), Machine(), driven)
    for kit, columns in plant.KITS.items():
        log = plant.measure(plant.bare(), Machine(), driven, kit, 3)
        assert tuple(log) == ("t_s", *columns)
        assert log.equals(plant.measure(plant.bare(), Machine(), driven, kit, 3))
    for column, counts in plant.ENCODERS.items():
        step = 2 * np.pi / counts
        assert np.abs(log[column] / step - np.round(log[column] / step)).max() < 1e-6
        assert np.abs(log[column] - exact[column]).max() <= step * 1.000001
    for column, sigma in plant.NOISE.items():
        assert np.std(log[column] - exact[column]) == pytest.approx(sigma, rel=0.06)
    assert exact["u1_Nm"][0] == pytest.approx(Machine().u01)


def test_machines_differ_and_stay_possible() -> None:
    machines = np.array([astuple(plant.vary(seed)) for seed in range(50)]) / np.array(astuple(Machine()))
    free = [k for k, name in enumerate(Machine.__dataclass_fields__) if name not in plant.GEOMETRY]
    assert np.ptp(machines[:, free], axis=0).min() > 0.3
    assert machines.min() > 0.8
    assert machines.max() < 1.2
    np.testing.assert_array_equal(np.delete(machines, free, axis=1), 1)


# ------------------------------------------------------------------------------------- what nothing and much do
@pytest.mark.parametrize(("name", "place"), ONCE)
def test_nothing_of_a_cause_changes_nothing_and_much_is_seen(name: str, place: str, driven: Motion) -> None:
    plain = plant.ideal(plant.bare(), Machine(), driven)
    none = hiding(name, place, CAUSES[name].none)
    played = plant.ideal(none, Machine(), plant.play(none, Machine(), driven.u))
    for column, values in plain.items():
        assert np.abs(played[column] - values).max() <= 1e-6 * np.abs(values).max(), column
    if name in ("payload_shift", "vibration_on"):
        return  # may begin later than this drive ends
    much = hiding(name, place, CAUSES[name].between(place)[1])
    played = plant.ideal(much, Machine(), plant.play(much, Machine(), driven.u))
    noise = {c: 2 * np.pi / n for c, n in plant.ENCODERS.items()} | plant.NOISE
    assert max(np.abs(played[c] - plain[c]).max() / noise[c] for c in plain) > 1


@pytest.mark.parametrize("name", SURPRISES)
def test_a_surprise_of_no_size_is_none_and_a_big_one_is_seen(name: str, driven: Motion) -> None:
    def log(system: System) -> np.ndarray:
        return plant.measure(system, Machine(), plant.play(system, Machine(), driven.u), "full", 1).to_numpy()

    plain = plant.measure(plant.bare(), Machine(), driven, "full", 1)
    noise = np.array([2 * np.pi / n for n in plant.ENCODERS.values()] + list(plant.NOISE.values()))
    assert np.abs(log(surprised(name, 0.0)) - plain.to_numpy())[:, 1:].max() < 1e-9
    assert (np.abs(log(surprised(name, 1.0, 8)) - plain.to_numpy())[:, 1:] / noise).max() > 2


# --------------------------------------------------------------------------------------------- sharp: what it is
Torque = Callable[..., float]


def felt(name: str, place: str, amount: float, seed: int = 0, machine: Machine | None = None) -> Torque:
    """What the cause changes at a roll's joint [N m], at one state: the spins are coupled through the soil alone."""
    machine = machine or Machine()
    with_it, k = hiding(name, place, amount, seed), plant.TURNING[place]
    spin = machine.ZZ1 if place == "front_roll" else machine.ZZ4

    def change(
        w: float = 0.0, U: float = 0.0, t: float = 0.0, angle: float = 0.0, V: float | None = None, vy: float = 0.0
    ) -> float:
        x = np.zeros(len(with_it.start))
        x[[3, 5]], x[[9, 11]], x[6], x[7] = angle, w, machine.R * w if V is None else V, vy
        u = np.full(3, U)
        p = np.array(astuple(machine))
        a, b = (
            s.rate(x[: len(s.start)], t, u, p, np.ones(len(s.held))).full()[6 + k, 0] for s in (with_it, plant.bare())
        )
        return float((a - b) * spin)

    return change


def test_friction_causes_resist_as_they_should() -> None:
    stribeck = felt("stribeck_friction", "front_roll", 100)
    assert -100 < stribeck(0.06) < -50
    assert stribeck(-0.06) == pytest.approx(-stribeck(0.06))
    assert abs(stribeck(2.5)) < 2
    load = felt("load_dependent_friction", "rear_roll", 0.05)
    assert load(1.0, 3000) == pytest.approx(-150, rel=0.05)
    assert load(1.0, -3000) == pytest.approx(load(1.0, 3000))
    assert load(-1.0, 3000) == pytest.approx(-load(1.0, 3000))
    coulomb = felt("asymmetric_coulomb", "front_roll", 40)
    assert coulomb(1.0) == pytest.approx(-40, rel=1e-3)
    assert coulomb(-1.0) == pytest.approx(-40, rel=1e-3)
    viscous = felt("asymmetric_viscous", "front_roll", 20)
    assert viscous(2.0) == pytest.approx(-40, rel=0.05)
    assert viscous(-2.0) == pytest.approx(-40, rel=0.05)
    drag = felt("quadratic_drag", "rear_roll", 10)
    assert drag(2.0) == pytest.approx(-40, rel=0.01)
    assert drag(-1.0) == pytest.approx(10, rel=0.15)
    warm = felt("friction_warm_up", "front_roll", 0.5)
    assert warm(1.0) == pytest.approx(-0.5 * (64.75 + 174.74), rel=1e-3)
    assert abs(warm(1.0, t=500)) < 0.01
    turning = felt("friction_transition", "front_roll", 1.0)
    assert -110 < turning(0.01) < -50  # of 174.74 N m, 46 % of which resist there without it
    assert turning(-0.01) == pytest.approx(-turning(0.01))
    assert turning(0.5) == pytest.approx(0, abs=1e-3)
    lazy = felt("friction_transition", "front_roll", -3.0)
    assert 0 < lazy(0.1) < 174.74  # less than without it, and it still resists
    assert lazy(3.0) == pytest.approx(0, abs=5)


def test_torque_causes_change_what_is_delivered() -> None:
    band = felt("torque_deadband", "front_roll", 100)
    assert [band(0.5, U) for U in (-800, -60, 60, 800)] == pytest.approx([100, 60, -60, -100])
    heavy = felt("roll_unbalance", "front_roll", 50)
    turn = np.array([heavy(angle=a) for a in np.linspace(0, 2 * np.pi, 36, endpoint=False)])
    content = np.abs(np.fft.rfft(turn)) / 18
    assert content[1] == pytest.approx(50, rel=1e-6)
    assert content[[0, *range(2, 18)]].max() < 1e-6
    climbs = []
    for place in plant.ROLLS:
        oval = felt("roll_out_of_round", place, 0.002)
        turn = np.array([oval(angle=a) for a in np.linspace(0, 2 * np.pi, 36, endpoint=False)])
        climbs.append(np.abs(np.fft.rfft(turn))[1] / 18)
    m = Machine()
    assert sum(climbs) == pytest.approx(0.002 * plant.G * (m.m0 + m.m1 + m.m2 + m.m4), rel=1e-6)
    assert 0.4 < climbs[0] / sum(climbs) < 0.6
    ripple = felt("torque_ripple", "rear_roll", 50)
    content = np.abs(np.fft.rfft([ripple(angle=a) for a in np.linspace(0, 2 * np.pi, 128, endpoint=False)])) / 64
    assert content.max() == pytest.approx(50, rel=0.01)
    assert 5 <= np.argmax(content) <= 18
    assert content[:5].max() < 1e-6


def test_a_lag_costs_as_much_motion_as_it_lasts() -> None:
    machine = replace(Machine(), Fv1=0, Fs1=0, Kx1=-1e-6, Ky1=-1e-6)
    torque = np.zeros((301, 3))
    torque[1:, 0] = 100.0
    system = hiding("actuator_lag", "front_roll", 0.12)
    slow, quick = plant.play(system, machine, torque), plant.play(plant.bare(), machine, torque)
    assert (quick.x[-1, 9] - slow.x[-1, 9]) / (100 / machine.ZZ1) == pytest.approx(0.12, rel=1e-3)
    other = plant.play(hiding("pump_coupling", "drive", 0.05), replace(machine, Fs4=0, Fv4=0, Kx4=-1e-6), torque)
    assert other.x[-1, 11] == pytest.approx(0.05 * 100 / machine.ZZ4 * 3, rel=0.02)


def test_channel_causes_change_what_is_read(driven: Motion) -> None:
    def read(name: str, place: str, amount: float) -> dict[str, np.ndarray]:
        system = hiding(name, place, amount)
        return plant.ideal(system, Machine(), plant.play(system, Machine(), driven.u))

    plain, t = plant.ideal(plant.bare(), Machine(), driven), driven.t
    u = driven.u[:, 0]
    late = read("channel_delay", "front_roll", 0.05)["u1_Nm"]
    np.testing.assert_allclose(late[5:], plain["u1_Nm"][:-5], atol=1e-6)
    np.testing.assert_allclose(read("torque_gain", "front_roll", 0.04)["u1_Nm"], 1.04 * u + Machine().u01)
    drift = read("torque_offset_drift", "front_roll", 2.0)["u1_Nm"] - plain["u1_Nm"]
    assert drift[-1] > 2.0 * t[-1]
    assert (np.diff(drift) > 0).all()
    wheel = read("measuring_wheel_radius", "measuring_wheel_right", 0.01)
    np.testing.assert_allclose(wheel["thetar_rad"] * 1.01, plain["thetar_rad"], atol=1e-9)
    np.testing.assert_array_equal(wheel["thetal_rad"], plain["thetal_rad"])
    error = read("encoder_eccentricity", "rear_roll", 0.005)["theta4_rad"] - plain["theta4_rad"]
    assert np.abs(error).max() == pytest.approx(0.005, rel=0.1)


@pytest.mark.parametrize("slip", [0.02, 0.12])
def test_the_integral_over_the_patch_is_the_exponential_law(slip: float) -> None:
    A, z = 0.2, slip / 0.2
    share = 2 / z * (1 - (1 - np.exp(-z)) / z)
    machine, vn = Machine(), np.hypot(0.65, 0.05)
    saturated = felt("shear_saturation", "front_roll", A)
    S = machine.Kx1 * slip
    assert saturated(1.0, V=0.65 + slip * vn) == pytest.approx(-machine.R * S * (share - 1), rel=2e-3)
    lateral = felt("lateral_saturation", "front_roll", A)
    assert lateral(1.0, V=0.65 + slip * vn, vy=0.1) == pytest.approx(0, abs=1e-6)


def test_soil_causes_change_the_grip() -> None:
    machine, vn = Machine(), np.hypot(0.65, 0.05)
    V, S = 0.65 + 0.03 * vn, machine.Kx1 * 0.03
    brake = felt("drive_brake_asymmetry", "front_roll", 0.2)
    assert brake(1.0, V=V) == pytest.approx(-machine.R * 0.2 * S, rel=1e-3)
    assert brake(-1.0, V=-V) == pytest.approx(machine.R * 0.2 * S, rel=1e-3)
    assert abs(brake(1.0, V=1.3 - V)) < 0.01 * abs(0.2 * S)
    shaken = felt("vibration_on", "front_roll", 0.2)
    change = np.array([shaken(1.0, V=V, t=t) for t in np.arange(0, 60, 0.5)])
    assert change[np.abs(change).argmax()] == pytest.approx(machine.R * 0.2 * S, rel=1e-3)
    assert abs(change[0]) < 1e-3
    assert abs(change[-1]) < 1e-3


def test_soil_stiffens_from_pass_to_pass() -> None:
    system = hiding("compaction_per_pass", "drive", 0.4)
    look = system.held[0]
    x, seen = np.zeros(12), []
    way = np.concatenate([np.arange(0, 8, 0.02), np.arange(8, 0, -0.02), np.arange(0, 8, 0.02)])
    for k, at in enumerate(way):
        x[0] = at
        seen.append(look(k / 100, x))
    mid = [seen[200], seen[600], seen[1000]]
    assert mid[0] == pytest.approx(1, abs=1e-9)
    assert 1.05 < mid[1] < mid[2] < 1.4
    rear = hiding("compaction_per_pass", "drive", 0.4)
    values = []
    for k, at in enumerate(np.arange(0, 8, 0.02)):
        x[0] = at
        rear.held[0](k / 100, x)
        values.append(rear.held[1](k / 100, x))
    assert values[50] == pytest.approx(1, abs=1e-9)  # nothing has been there yet
    assert values[-1] > 1.05  # the front roll has


def test_relaxed_soil_ends_at_the_same_slip_but_later() -> None:
    torque = np.zeros((601, 3))
    torque[:, [0, 2]] = 700.0 * np.minimum(np.arange(601) / 10, 1)[:, None]
    system = hiding("slip_relaxation", "front_roll", 0.06)
    soft, hard = (plant.play(s, Machine(), torque) for s in (system, plant.bare()))
    g_soft, g_hard = (plant.slips(plant.bare(), Machine(), m.__class__(m.t, m.x[:, :14], m.u)) for m in (soft, hard))
    assert g_soft[-1, 0] == pytest.approx(g_hard[-1, 0], rel=0.02)
    assert np.abs(g_soft[:60, 0] - g_hard[:60, 0]).max() > 0.3 * np.abs(g_hard[:60, 0]).max()


def test_gravity_and_resistance_push_as_hard_as_they_say() -> None:
    free = replace(Machine(), Fv1=0, Fs1=0, Fv2=0, Fs2=0, Fv4=0, Fs4=0)
    down = np.random.default_rng([5, 15]).uniform(0, 2 * np.pi)
    motion = plant.play(hiding("ground_slope", "machine", 0.01, 5), free, np.zeros((301, 3)))
    inertia = 11000 + (free.ZZ1 + free.ZZ4) / free.R**2
    assert motion.x[-1, 6] == pytest.approx(11000 * 9.81 * 0.01 * np.cos(down) / inertia * 3, rel=0.03)
    start = plant.play(plant.bare(), free, np.tile([500.0, 0.0, 500.0], (501, 1)))
    held = plant.play(hiding("rolling_resistance", "front_roll", 300), free, np.tile([500.0, 0.0, 500.0], (501, 1)))
    force = (start.x[-1, 6] - held.x[-1, 6]) * inertia / 5
    assert force == pytest.approx(300, rel=0.1)


def test_the_actuator_of_a_loose_articulation_moves_on_its_own(driven: Motion) -> None:
    loose = hiding("articulation_backlash", "articulation", 0.004)
    twist = np.diff(plant.play(loose, Machine(), driven.u).x[:, [4, 14]], axis=1)
    assert -0.0045 < twist.min() < -0.0019
    assert 0.0019 < twist.max() < 0.0045
    soft = hiding("articulation_compliance", "articulation", 3e-7)
    played = plant.play(soft, Machine(), driven.u)
    twist = played.x[:, 14] - played.x[:, 4]
    assert np.polyfit(driven.u[:, 1], twist, 1)[0] == pytest.approx(3e-7, rel=0.05)


def test_stops_push_back_only_beyond_their_angle() -> None:
    stop = hiding("articulation_stop_spring", "articulation", 20000, 2)

    def push(angle: float) -> float:
        x = np.zeros(14)
        x[4] = angle
        a, b = (
            s.rate(x, 0, np.zeros(3), np.array(astuple(Machine())), np.zeros(0)).full()[10, 0]
            for s in (stop, plant.bare())
        )
        return float(a - b)

    assert push(0.1) == 0
    assert push(-0.1) == 0
    assert (push(0.4) < 0) or (push(-0.4) > 0)
    assert push(0.4) <= 0 <= push(-0.4)


def test_a_load_that_slides_pushes_the_machine_the_other_way() -> None:
    """Nothing outside acts: the common centre of mass stays, so the machine gives way by A over the whole mass."""
    loose = replace(Machine(), Kx1=-1e-9, Ky1=-1e-9, Kx4=-1e-9, Ky4=-1e-9, y0=0, y2=0)
    motion = plant.play(hiding("payload_shift", "machine", 800), loose, np.zeros((4501, 3)))
    assert motion.x[-1, 0] == pytest.approx(-800 / 11000, rel=1e-6)
    assert abs(motion.x[100, 0]) < 1e-6


def test_the_catalogues_sliding_load_moves_the_machine_as_this_one_does(va12: Model) -> None:
    """80 kg slide by 10 cm while the machine weaves; short of the recoil the catalogue's load is far off."""
    mass, way, rho, when, takes = 80.0, 0.1, -0.95, 9.0, 0.4
    scene = Scene()
    there = rho + way * (1 + ca.tanh((scene.t - when) / takes)) / 2
    scene.point(mass, "rear", there, 0.0)
    scene.point(-mass, "rear", rho, 0.0)
    torque = plant.drive(plant.bare(), Machine(), plant.plan("eight", 14, 4), 4).u
    plain = plant.play(plant.bare(), Machine(), torque)
    slid = plant.play(scene.assemble(), Machine(), torque)
    base = plant.base(Machine())

    def moved(recoil: float) -> np.ndarray:
        shapes = {"instant": when, "takes": np.sqrt(takes**2 - 0.05**2), "arm": 2 * rho + way, "recoil": recoil}
        told = {n: Quantity(value=float(x), source="assumed") for n, x in shapes.items()}
        amount = Quantity(value=mass * way, source="assumed")
        entry = EffectEntry(name="payload_shift", where="machine", amount=amount, shape=told)
        model = build(placing.with_effects(va12.machine, entry))
        X = np.array([base.get(n, x) for n, x in zip(model.base.names, model.nominal, strict=True)])
        return simulate(model, torque, X).q

    want = slid.x[:, 2:5] - plain.x[:, 2:5]
    own = simulate(va12, torque, np.array([base[n] for n in va12.base.names])).q[:, 2:5]
    size = np.abs(want).max(axis=0)
    assert (np.abs(moved(1.0)[:, 2:5] - own - want).max(axis=0) < 0.05 * size).all()
    assert (np.abs(moved(0.0)[:, 2:5] - own - want).max(axis=0) > 0.3 * size).any()

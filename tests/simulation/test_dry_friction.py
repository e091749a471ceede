"""Set-valued dry friction: closed forms, an independent event simulator, the definition of the law, and energy."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from support.drives import drive
from support.sticking import advance

from excite.errors import ExciteError, MachineError, SimulationError
from excite.model import Model, build
from excite.model.effects import placing
from excite.model.machine import machine
from excite.simulation import Motion, respond, simulate


def sticking(model: Model, torque: np.ndarray, *args: object, **how: np.ndarray) -> Motion:
    """The motion with set-valued friction."""
    return simulate(model, torque, *args, friction="set-valued", **how)  # type: ignore[arg-type]


def resampled(model: Model, rate: float) -> Model:
    """Change the sampling rate [Hz] of a machine."""
    hz = model.machine.sampling_hz.model_copy(update={"value": float(rate)})
    return build(model.machine.model_copy(update={"sampling_hz": hz}))


def sharper(model: Model, factor: float) -> Model:
    """Smooth the friction of a machine over `factor` times the rate."""
    bodies = []
    for b in model.machine.body:
        if b.friction is not None:
            smoothing = b.friction.smoothing.model_copy(update={"value": factor * float(b.friction.smoothing)})
            b = b.model_copy(update={"friction": b.friction.model_copy(update={"smoothing": smoothing})})
        bodies.append(b)
    return build(model.machine.model_copy(update={"body": tuple(bodies)}))


def with_effects(model: Model, *texts: str) -> Model:
    entries = [placing.parse_effect(text, model.machine, 60.0) for text in texts]
    return build(placing.with_effects(model.machine, *entries))


def rig_motion(force: np.ndarray, rate: float, X: np.ndarray, x: float, v: float, parts: int) -> np.ndarray:
    """Position and speed (N, 2) of the rig of `support.sticking`, each sample in `parts` of constant force."""
    M, Fv, Fc, _ = (float(p) for p in X)
    history = [(x, v)]
    for u0, u1 in pairwise(force):
        for share in (np.arange(parts) + 0.5) / parts:
            x, v = advance(x, v, float(u0 + share * (u1 - u0)), 1 / (rate * parts), M, Fv, Fc)
        history.append((x, v))
    return np.array(history)


def dry_friction(model: Model, motion: Motion) -> np.ndarray:
    """Friction torques (N, n_rubbing) that the motion needs in its joints beside Fv w, from the balance without Fs."""
    rubbing = [b.index for b in model.machine.rubbing]
    X = model.base_values()
    X[[model.base.names.index(f"Fs{k}") for k in rubbing]] = 0.0
    p = model.expand @ X
    need = model.balance(motion.q.T, motion.nu.T, motion.a.T, p).full().T
    need[:, list(model.actuated)] -= motion.u
    return -need[:, list(model.rubbing)]


def other_rows(model: Model, motion: Motion) -> np.ndarray:
    """Residuals of the equations of coordinates without dry friction, (N, n)."""
    need = model.balance(motion.q.T, motion.nu.T, motion.a.T, model.expand @ model.nominal).full().T
    return need[:, [k for k in range(len(model.coordinates)) if k not in model.rubbing]]


def coulomb(model: Model) -> np.ndarray:
    """Fs (n_rubbing,)."""
    return np.array([float(b.friction.Fs) for b in model.machine.rubbing if b.friction is not None])


def assert_in_set(model: Model, motion: Motion, slack: float = 1e-8) -> None:
    """Hold the definition of set-valued friction at every sample: the friction that the motion needs is in its set."""
    f, Fs = dry_friction(model, motion), coulomb(model)
    w, a = (x[:, list(model.rubbing)] for x in (motion.nu, motion.a))
    tolerance = slack * np.abs(motion.u).max()
    assert np.abs(other_rows(model, motion)).max() < tolerance
    assert (np.abs(f) <= Fs + tolerance).all()
    slips = w != 0
    assert np.abs(f - Fs * np.sign(w))[slips].max(initial=0) < tolerance
    starts = ~slips & (a != 0)
    assert np.abs(f - Fs * np.sign(a))[starts].max(initial=0) < tolerance


# ---------------------------------------------------------------- one mass


def test_motion_is_that_of_an_independent_event_simulator(emps: Model) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(8001) / 1000
    force = sum(20 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.4, 0.9, 1.7))
    force = np.asarray(force) * np.minimum(t, 1)
    motion = sticking(emps, force[:, None])
    truth = rig_motion(force, 1000, emps.nominal, 0.0, 0.0, 20)
    rests = truth[:, 1] == 0
    assert 0.1 < rests.mean() < 0.9
    assert np.abs(np.diff(rests)).sum() >= 10
    np.testing.assert_array_equal(motion.nu[:, 0] == 0, rests)
    assert np.abs(motion.nu[:, 0] - truth[:, 1]).max() < 1e-8
    assert np.abs(motion.q[:, 0] - truth[:, 0]).max() < 1e-8


def test_block_sticks_below_its_friction(emps: Model) -> None:
    t = np.arange(3001) / 1000
    motion = sticking(emps, 0.999 * emps.nominal[2] * np.sin(3 * t)[:, None], q0=np.array([0.2]))
    assert (motion.q == 0.2).all()
    assert (motion.nu == 0).all()
    assert (motion.a == 0).all()


def test_block_breaks_away_where_the_force_exceeds_its_friction(emps: Model) -> None:
    """A force r t: at rest until Fc / r, then M v' = r s - Fv v with s the time since."""
    (M, Fv, Fc, _), r = emps.nominal, 7.3
    t = np.arange(5001) / 1000
    motion = sticking(emps, r * t[:, None])
    s, tau = np.maximum(t - Fc / r, 0), M / Fv
    v = r / Fv * (s - tau * (1 - np.exp(-s / tau)))
    x = r / Fv * (s**2 / 2 - tau * s + tau**2 * (1 - np.exp(-s / tau)))
    assert (motion.q[t < Fc / r] == 0).all()
    assert (motion.nu[t > Fc / r] > 0).all()
    assert np.abs(motion.nu[:, 0] - v).max() < 1e-9
    assert np.abs(motion.q[:, 0] - x).max() < 1e-9


@pytest.mark.parametrize("speed", [0.3, -0.3])
@pytest.mark.parametrize("rate", [1000, 10])
def test_block_coasts_to_rest_in_closed_form(emps: Model, speed: float, rate: float) -> None:
    """Time tau ln(1 + v Fv / Fc) and distance tau (v - Fc / Fv ln(1 + v Fv / Fc)), then exactly at rest."""
    M, Fv, Fc, _ = emps.nominal
    model = resampled(emps, rate)
    motion = sticking(model, np.zeros((round(2 * rate) + 1, 1)), nu0=np.array([speed]))
    tau, log = M / Fv, np.log(1 + abs(speed) * Fv / Fc)
    distance = np.sign(speed) * tau * (abs(speed) - Fc / Fv * log)
    moving = motion.t < tau * log
    np.testing.assert_array_equal(motion.nu[:, 0] != 0, moving)
    end = motion.q[~moving, 0]
    assert (end == end[0]).all()
    assert end[0] == pytest.approx(distance, rel=1e-6)


@pytest.mark.parametrize(
    ("speed", "start", "end"), [(0.0012, -60, 120), (-0.0012, 60, -120), (0.0017, -60, 120), (0.001, -60, 60)]
)
def test_stop_and_start_within_one_step_are_seen(emps: Model, speed: float, start: float, end: float) -> None:
    """A rate that passes zero and comes back between two samples of 0.01 s: at its end nothing shows it."""
    model = resampled(emps, 100)
    force = np.array([start, end, end], float)
    motion = sticking(model, force[:, None], nu0=np.array([speed]))
    truth = rig_motion(force, 100, emps.nominal, 0.0, speed, 20000)
    assert np.abs(np.column_stack([motion.q, motion.nu]) - truth).max() < 1e-7


def test_feedback_meets_friction_that_sticks(emps: Model) -> None:
    """A spring to a slow target: stick and slip. The forces that it gave make the same motion without feedback."""
    motion = respond(emps, 6001, lambda k, state: np.array([900 * (0.02 * k / 1000 - state[0])]), friction="set-valued")
    still = motion.nu[:, 0] == 0
    assert 0.02 < still.mean() < 0.98
    again = sticking(emps, motion.u)
    np.testing.assert_array_equal(motion.q, again.q)


# ---------------------------------------------------------------- several joints


@pytest.mark.parametrize("share", [0.5, 0.999])
def test_roller_does_not_move_under_small_torques(va12: Model, share: float) -> None:
    t = np.arange(1001) / 100
    torque = share * coulomb(va12) * np.sin(np.outer(t, [2.0, 3.1, 4.3]))
    start = np.array([1.0, -2.0, 0.3, 0.7, 0.2, -0.4])
    motion = sticking(va12, torque, q0=start)
    assert (motion.q == start).all()
    assert (motion.nu == 0).all()
    assert (motion.wheels == 0).all()
    assert np.abs(simulate(va12, torque, q0=start).q - start).max() > 1e-4


@pytest.mark.parametrize("name", ["va12", "va12_straight", "skid_robot", "tandem", "double_loader"])
def test_friction_is_in_its_set_all_along(name: str) -> None:
    """Torques around Fs: joints stick and slip one by one and together; some are held while others move."""
    model = build(machine.load_machine(name))
    each = dict(zip((b.index for b in model.machine.rubbing), coulomb(model), strict=True))
    amplitude = {u: 1.5 * each[b.index] for u, b in zip(model.inputs, model.machine.actuated, strict=True)}
    motion = sticking(model, drive(model, 20, 3, amplitude))
    assert_in_set(model, motion)
    still = motion.nu[:, list(model.rubbing)] == 0
    assert (still.any(axis=0) & ~still.all(axis=0)).all()
    assert {0, 1, 2} <= set(still.sum(axis=1))


@pytest.mark.parametrize("name", ["va12", "tandem", "double_loader", "skid_robot"])
def test_joints_at_rest_start_consistently(name: str) -> None:
    """Torques at once on a machine at rest: which joints start, and where to, depends on all others."""
    model = build(machine.load_machine(name))
    rng = np.random.default_rng(1)
    q0 = np.array([0.3 * (c in model.active_coordinates) for c in model.coordinates])
    largest, patterns = 3 * coulomb(model)[[model.rubbing.index(r) for r in model.actuated]], set()
    for _ in range(40):
        torque = np.tile(rng.uniform(-1, 1, len(largest)) * largest, (2, 1))
        motion = sticking(model, torque, q0=q0)
        assert_in_set(model, motion)
        patterns.add(tuple(np.sign(motion.a[0, list(model.rubbing)])))
    assert len(patterns) > 8


def test_joints_that_are_alike_break_away_together() -> None:
    """The robot with the same friction in all four wheels runs ahead from the instant its torques exceed it."""
    model = build(machine.load_machine("skid_robot"))
    X = model.nominal.copy()
    fs = [k for k, n in enumerate(model.base.names) if n.startswith("Fs")]
    fv = [k for k, n in enumerate(model.base.names) if n.startswith("Fv")]
    X[fs], X[fv] = 1.0, X[fv].mean()
    t = np.arange(201) / float(model.machine.sampling_hz)
    motion = sticking(model, np.tile(2 * t[:, None], (1, 4)), X)
    w = motion.nu[:, list(model.rubbing)]
    assert (w[t < 0.5] == 0).all()
    assert (w[t > 0.5] > 0).all()


@pytest.mark.slow
def test_energy_balance_of_the_roller(va12: Model) -> None:
    """Kinetic energy = work of the motors - friction (Fv w^2 + Fs |w|) + work of the contacts (11, 17)."""
    model = resampled(va12, 2000)
    n, k = 20 * 2000 + 1, 20
    coarse = drive(va12, 20, 3, {"u1": 900, "u2": 3000, "u4": 900})
    torque = np.column_stack([np.interp(np.arange(n) / k, np.arange(len(coarse)), c) for c in coarse.T])
    motion = sticking(model, torque)
    q, nu = motion.q.T, motion.nu.T
    at = [0, n // 3, n // 2, n - 1]
    masses = [model.equations(q[:, i], nu[:, i], model.nominal)[0] for i in at]
    energy = [nu[:, i] @ np.array(ca.DM(M)) @ nu[:, i] / 2 for i, M in zip(at, masses, strict=True)]
    w, rubbing = nu[list(model.rubbing)], model.machine.rubbing
    Fv = np.array([float(b.friction.Fv) for b in rubbing if b.friction is not None])
    lost = Fv @ w**2 + coulomb(model) @ np.abs(w)
    work = (motion.u * motion.nu[:, list(model.actuated)]).sum(axis=1)
    slips = dict(zip(model.slips, model.kinematics(q, nu)[1].full(), strict=True))
    yaw = {1: nu[2], 4: nu[2] + nu[4]}
    contacts = np.zeros(n)
    for index, roll, spin in ((1, "Kx1 Ky1", 3), (4, "Kx4 Ky4", 5)):
        Kx, Ky = (model.nominal[model.base.names.index(x)] for x in roll.split())
        v_n = np.hypot(0.65 * nu[spin], 0.05)
        contacts += Kx * slips[f"gx{index}"] ** 2 * v_n + Ky * slips[f"gy{index}"] ** 2 * v_n
        contacts += Kx * 2.1**2 / 12 * yaw[index] ** 2 / v_n
    power = work - lost + contacts
    stored = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2)]) / 2000
    turnover = np.abs(work).sum() / 2000
    assert np.abs(np.array(energy) - stored[at]).max() < 1e-5 * turnover
    assert lost.sum() / 2000 > 0.1 * turnover


def test_smoothed_friction_tends_to_the_set_valued(straight: Model) -> None:
    """The difference falls in proportion to the rate over which friction is smoothed."""
    torque = drive(straight, 20, 3, {"u1": 600, "u4": 600})
    exact = sticking(straight, torque)
    far = [np.abs(simulate(sharper(straight, x), torque).q - exact.q).max() for x in (1, 0.1, 0.01, 0.001)]
    assert far[0] > 0.01
    assert (np.array(far[1:]) < 0.2 * np.array(far[:-1])).all()
    assert far[-1] < 1e-3


@pytest.mark.slow
def test_accuracy_does_not_depend_on_the_samples(va12: Model) -> None:
    """Events are located within a step: the same torques in ten times as many samples move the roller the same way."""
    torque = drive(va12, 20, 3, {"u1": 900, "u2": 3000, "u4": 900})
    n = len(torque)
    fine = np.column_stack([np.interp(np.arange(10 * n - 9) / 10, np.arange(n), c) for c in torque.T])
    motion, finer = sticking(va12, torque), sticking(resampled(va12, 1000), fine)
    assert np.abs(motion.q - finer.q[::10]).max() < 1e-6
    assert np.abs(motion.nu - finer.nu[::10]).max() < 1e-6
    np.testing.assert_array_equal(motion.nu == 0, finer.nu[::10] == 0)


# ---------------------------------------------------------------- effects and requests


def on_rig(emps: Model, name: str, amount: float) -> Model:
    """The rig with an effect at its one joint."""
    (place,) = placing.allowed_places(emps.machine, placing.CATALOGUE[name])
    return with_effects(emps, f"{name}@{place}={amount}")


@pytest.mark.parametrize(
    ("name", "forward", "backward"), [("stribeck_friction", 6.0, 6.0), ("asymmetric_coulomb", 6.0, -6.0)]
)
def test_effects_shift_the_breakaway(emps: Model, name: str, forward: float, backward: float) -> None:
    model, t, Fc = on_rig(emps, name, 6.0), np.arange(4001) / 1000, emps.nominal[2]
    for side, shift in ((1, forward), (-1, backward)):
        motion = sticking(model, side * 10 * t[:, None])
        np.testing.assert_array_equal(motion.nu[:, 0] != 0, t > (Fc + shift) / 10 * (1 - 1e-4))
        assert (side * motion.nu[:, 0] >= 0).all()


def test_friction_that_fades_lets_go(emps: Model) -> None:
    """Warm-up Fc (1 + A exp(-t / fade)) against a constant force: at rest until fade ln(A Fc / (u - Fc))."""
    model = on_rig(emps, "friction_warm_up", 0.5)
    fade, Fc = model.effects[0].values["fade"], emps.nominal[2]
    u = Fc * (1 + 0.5 * np.exp(-2.5 / fade))
    motion = sticking(model, np.full((5001, 1), u))
    np.testing.assert_array_equal(motion.nu[:, 0] != 0, motion.t > 2.5 + 1e-6)


def test_friction_that_grows_with_the_load_holds_more(emps: Model) -> None:
    model = on_rig(emps, "load_dependent_friction", 0.2)
    t = np.arange(4001) / 1000
    motion = sticking(model, 10 * t[:, None])
    first = motion.t[np.argmax(motion.nu[:, 0] != 0)]
    assert first == pytest.approx(emps.nominal[2] / 0.8 / 10, rel=2e-3)


def test_ground_map_and_memory_go_with_sticking(va12: Model) -> None:
    hidden = "compaction_per_pass@drive=0.3", "actuator_lag@front_roll=0.05"
    model = with_effects(va12, *hidden)
    torque = drive(va12, 10, 3, {"u1": 900, "u2": 3000, "u4": 900})
    motion = sticking(model, torque)
    near = simulate(with_effects(sharper(va12, 1e-4), *hidden), torque)
    assert np.abs(motion.q - near.q).max() < 1e-4
    assert (motion.nu[:, list(model.rubbing)] == 0).any(axis=0).all()


def bristles(model: Model) -> Model:
    entry = placing.parse_effect("stribeck_friction@front_roll=50", model.machine, 60.0)
    shape = {"bristles": model.machine.sampling_hz.model_copy(update={"value": 1.0})}
    return build(placing.with_effects(model.machine, entry.model_copy(update={"shape": shape})))


@pytest.mark.parametrize("make", [bristles, lambda m: with_effects(m, "friction_transition@front_roll=0.5")])
def test_friction_that_never_sticks_is_refused(va12: Model, make: object) -> None:
    with pytest.raises(MachineError, match="@front_roll replaces dry friction by a law that never sticks"):
        sticking(make(va12), np.zeros((5, 3)))  # type: ignore[operator]


@pytest.mark.parametrize("nu1", [0.0, 1.0])
def test_negative_friction_is_refused(straight: Model, nu1: float) -> None:
    X = straight.nominal.copy()
    X[straight.base.names.index("Fs1")] *= -1
    with pytest.raises(SimulationError, match=r"front_roll: dry friction is negative at t = "):
        sticking(straight, np.zeros((500, 2)), X, nu0=np.array([0.65 * nu1, nu1, nu1]))


@pytest.mark.parametrize("name", ["ZZ1", "M"])
def test_impossible_inertia_is_never_a_sticking_motion(va12: Model, name: str) -> None:
    X = va12.nominal.copy()
    X[va12.base.names.index(name)] *= -1
    with pytest.raises(SimulationError, match="positive definite"):
        sticking(va12, np.full((101, 3), 1000.0), X)


def test_joint_without_dry_friction_never_sticks(straight: Model) -> None:
    """The front roll with Fs = 0 moves under the least torque, while the rear one holds."""
    X = straight.nominal.copy()
    X[straight.base.names.index("Fs1")] = 0.0
    t = np.arange(301) / 100
    motion = sticking(straight, np.column_stack([30 * np.sin(4 * t), 0 * t]), X)
    names = straight.coordinates
    w1, w4 = (motion.nu[:, names.index(c)] for c in ("theta1", "theta4"))
    assert (w1[1:] != 0).all()
    assert (w1 > 0).any()
    assert (w1 < 0).any()
    assert (w4 == 0).all()


def test_smoothed_friction_is_the_default(straight: Model) -> None:
    torque = drive(straight, 3, 1, {"u1": 900, "u4": 900})
    np.testing.assert_array_equal(simulate(straight, torque).q, simulate(straight, torque, friction="smoothed").q)


def test_unknown_friction_is_refused(straight: Model) -> None:
    with pytest.raises(ValueError, match="friction: sticky is unknown, allowed: smoothed, set-valued") as found:
        simulate(straight, np.zeros((5, 2)), friction="sticky")
    assert not isinstance(found.value, ExciteError)

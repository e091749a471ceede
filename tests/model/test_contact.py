"""Roll and soil against the contract's formulas, written again in plain numpy from hand-derived velocities of va12."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import dblquad, quad

from excite.model import Model, build, standard_parameters
from excite.model.machine import Contact, Machine, load_machine
from excite.model.mechanics import contact

# The contract's reference machine.
D2, D3, RC, LC, V_EPS = 1.45, 1.75, 0.65, 2.10, 0.05
STIFFNESS = {1: (-1.0e5, -0.9e5), 4: (-1.2e5, -1.1e5)}
VX, VY, YAW, SPIN1, YAW2, SPIN4 = range(6)
ROLL = load_machine("va12").find(1).contact
assert ROLL is not None


# ------------------------------------------------------------------------- the contract's formulas, by hand
@dataclass(frozen=True)
class Motion:
    """A roll's centre [m/s] in the axes of its chassis, spin and yaw rate of the chassis [rad/s]."""

    Vx: float
    Vy: float
    spin: float
    yaw: float


def motion(roll: int, theta2: float, nu: np.ndarray) -> Motion:
    """The front roll's centre is O0. The rear one's: along the front chassis to the articulation, turn, and back."""
    if roll == 1:
        return Motion(nu[VX], nu[VY], nu[SPIN1], nu[YAW])
    c, s = math.cos(theta2), math.sin(theta2)
    x, y = nu[VX], nu[VY] - D2 * nu[YAW]
    yaw = nu[YAW] + nu[YAW2]
    return Motion(c * x + s * y, -s * x + c * y - D3 * yaw, nu[SPIN4], yaw)


def linear(m: Motion, Kx: float, Ky: float) -> tuple[float, float, float]:
    v_n = math.sqrt((RC * m.spin) ** 2 + V_EPS**2)
    return Kx * (m.Vx - RC * m.spin) / v_n, Ky * m.Vy / v_n, Kx * LC**2 / 12 * (-m.yaw) / v_n


def exponential(m: Motion, Kx: float, Ky: float, g_K: float) -> tuple[float, float, float]:
    """(18): shear stress tau_max (1 - exp(-j/K)) against the slip, j = |g| xi, over the patch under uniform pressure.

    zeta = xi / xi_s runs along the patch, y across it; g_K = K / xi_s. At small slip the mean stress is
    tau_max |g| / (2 g_K), which must be |K_x g|: so tau_max times the area is 2 |K_x| g_K.
    """
    v_n = math.sqrt((RC * m.spin) ** 2 + V_EPS**2)
    gy = m.Vy / v_n

    def mean(part: str) -> float:
        def stress(zeta: float, y: float) -> float:
            gx = (m.Vx - m.yaw * y - RC * m.spin) / v_n
            g = math.hypot(gx, gy)
            if g == 0:
                return 0.0
            mobilised = -2 * g_K * math.expm1(-g * zeta / g_K) / g
            return mobilised * {"x": Kx * gx, "y": Ky * gy, "z": Kx * gx * y}[part]

        # where g_x changes its sign the integrand has a kink for g_y = 0: integrate on both sides of it
        kink = (m.Vx - RC * m.spin) / m.yaw if m.yaw else LC
        edges = sorted({-LC / 2, LC / 2, *([kink] if abs(kink) < LC / 2 else [])})
        pieces = [dblquad(stress, a, b, 0, 1, epsabs=1e-4, epsrel=1e-9)[0] for a, b in pairwise(edges)]
        return sum(pieces) / LC

    return mean("x"), mean("y"), mean("z")


def by_virtual_work(theta2: float, roll: int, wrench: tuple[float, float, float]) -> np.ndarray:
    """Generalised force: power of the wrench, moment -R_c S_x on the spin and -T_z about z, in each unit velocity."""
    Sx, Sy, Tz = wrench
    unit = [motion(roll, theta2, e) for e in np.eye(6)]
    return np.array([Sx * m.Vx + Sy * m.Vy - RC * Sx * m.spin - Tz * m.yaw for m in unit])


def of_the_middle(m: Motion, Kx: float, Ky: float, g_K: float) -> tuple[float, float, float]:
    """(18) over the length of the patch alone, at the slip of its middle, as a share of the linear law."""
    v_n = math.sqrt((RC * m.spin) ** 2 + V_EPS**2)
    g = math.hypot((m.Vx - RC * m.spin) / v_n, m.Vy / v_n)
    share = quad(lambda zeta: -2 * g_K * math.expm1(-g * zeta / g_K) / g, 0, 1)[0] if g > 0 else 1.0
    Sx, Sy, Tz = linear(m, Kx, Ky)
    return share * Sx, share * Sy, share * Tz


# ------------------------------------------------------------------------------------------------ the model
def with_contacts(machine: Machine, **changes: Any) -> Machine:
    raw = machine.model_dump()
    for body in raw["body"]:
        if body["contact"]:
            body["contact"] |= changes
    return Machine.model_validate(raw)


def quantity(value: float) -> dict[str, Any]:
    return {"value": value, "source": "assumed"}


def parameters(model: Model, **changes: float) -> np.ndarray:
    """Standard parameters, changed by name or first letters."""
    table = {name: value for name, (value, _) in standard_parameters(model.machine).items()}
    for start, value in changes.items():
        table |= {name: value for name in table if name.startswith(start)}
    return np.array(list(table.values()))


def soil_force(model: Model, q: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """What the soil does in each row: the prediction without contact less the one with it."""
    a = np.zeros_like(q)
    without = model.predict(q, nu, a, parameters(model, Kx=0.0, Ky=0.0)).full()
    return without - model.predict(q, nu, a, parameters(model)).full()


def states(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses anywhere, articulation to 0.6 rad, speeds to 2 m/s with slips of all sizes."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-3, 3, (6, n))
    q[4] = rng.uniform(-0.6, 0.6, n)
    nu = rng.uniform(-1, 1, (6, n)) * np.array([[2.0], [0.3], [0.35], [3.0], [0.35], [3.0]])
    return q, nu


def wrench_of(roll: Contact, m: Motion, g_K: float | None = None, **how: float) -> tuple[float, float, float]:
    s = contact.slip(roll, ca.SX(m.Vx), ca.SX(m.Vy), ca.SX(m.spin))
    saturation = None if g_K is None else contact.Saturation(ca.SX(g_K), **how)
    w = contact.wrench(roll, s, ca.SX(m.yaw), ca.SX(STIFFNESS[1][0]), ca.SX(STIFFNESS[1][1]), saturation)
    return float(ca.DM(w.Sx)), float(ca.DM(w.Sy)), float(ca.DM(w.Tz))


speeds = st.floats(-2, 2)
motions = st.builds(Motion, speeds, st.floats(-0.5, 0.5), st.floats(-3, 3), st.floats(-0.7, 0.7))
laws = st.sampled_from([None, 0.05, 0.15, 1.0])


# ------------------------------------------------------------------------------------------------- the force
def test_forces_on_the_machine_are_the_contracts(va12: Model) -> None:
    q, nu = states(300, seed=0)
    got = soil_force(va12, q, nu)
    for k in range(300):
        want = np.zeros(6)
        for roll, K in STIFFNESS.items():
            want += by_virtual_work(q[4, k], roll, linear(motion(roll, q[4, k], nu[:, k]), *K))
        assert np.linalg.norm(got[:, k] - want) <= 1e-9 * np.linalg.norm(want)


def test_exponential_forces_on_the_machine_are_the_patch_integral() -> None:
    model = build(with_contacts(load_machine("va12"), law="exponential", saturation_slip=quantity(0.15)))
    q, nu = states(4, seed=1)
    got = soil_force(model, q, nu)
    for k in range(4):
        want = np.zeros(6)
        for roll, K in STIFFNESS.items():
            want += by_virtual_work(q[4, k], roll, exponential(motion(roll, q[4, k], nu[:, k]), *K, 0.15))
        assert np.linalg.norm(got[:, k] - want) <= 1e-5 * np.linalg.norm(want)


def test_slips_are_the_contracts(va12: Model) -> None:
    q, nu = states(100, seed=2)
    assert va12.slips == ("gx1", "gy1", "gx4", "gy4")
    got = va12.kinematics(q, nu)[1].full()
    for k in range(100):
        for row, roll in ((0, 1), (2, 4)):
            gx, gy, _ = linear(motion(roll, q[4, k], nu[:, k]), 1.0, 1.0)
            assert got[row : row + 2, k] == pytest.approx([gx, gy], rel=1e-12, abs=1e-13)


def test_edges_slip_as_their_own_points_move(va12: Model) -> None:
    """(17) at y = -L_c/2 and L_c/2: the edge's own forward speed counts, and no place between them slips more."""
    q, nu = states(100, seed=4)
    assert va12.edges == ((1, "right"), (1, "left"), (4, "right"), (4, "left"))
    got = va12.edge_slips(q, nu).full().reshape(2, 100, 4)
    for k in range(100):
        for place, (roll, _) in enumerate(va12.edges):
            m = motion(roll, q[4, k], nu[:, k])

            def slip_at(y: float, m: Motion = m) -> tuple[float, float]:
                vn = math.hypot(RC * m.spin, V_EPS)
                return (m.Vx - y * m.yaw - RC * m.spin) / vn, m.Vy / vn

            assert got[:, k, place] == pytest.approx(slip_at((-1) ** (place + 1) * LC / 2), rel=1e-12, abs=1e-13)
            edges = np.hypot(*got[:, k, 2 * (place // 2) : 2 * (place // 2) + 2]).max()
            assert all(math.hypot(*slip_at(y)) <= edges * (1 + 1e-12) for y in np.linspace(-LC / 2, LC / 2, 21))


def test_contacts_that_slip_alike_all_over_have_one_place(va12: Model, straight: Model) -> None:
    assert straight.edges == ((1, ""), (4, ""))
    thin = build(with_contacts(load_machine("va12"), width=quantity(0.0)))
    assert thin.edges == ((1, ""), (4, ""))
    q, nu = states(20, seed=4)
    np.testing.assert_array_equal(
        thin.edge_slips(q, nu).full().reshape(2, 20, 2).transpose(2, 0, 1).reshape(4, 20), thin.kinematics(q, nu)[1]
    )


def test_pure_rolling_forward_has_no_longitudinal_force(va12: Model) -> None:
    """V_x = R_c theta': the spin is about +y of the chassis."""
    nu = np.array([1.3, 0.0, 0.0, 1.3 / RC, 0.0, 1.3 / RC])
    assert np.abs(soil_force(va12, np.zeros(6), nu)).max() <= 1e-9


def test_a_turning_roll_that_does_not_slip_at_its_middle_only_resists_the_turn() -> None:
    """The front roll in pure rolling while the chassis yaws: a moment -T_z against the yaw and no force."""
    m = Motion(1.0, 0.0, 1.0 / RC, 0.3)
    Sx, Sy, Tz = wrench_of(ROLL, m)
    assert Sx == pytest.approx(0, abs=1e-9)
    assert Sy == 0
    assert -Tz == pytest.approx(-1.0e5 * LC**2 / 12 * 0.3 / math.hypot(1.0, V_EPS))


# ------------------------------------------------------------------------------------- the exponential law
@pytest.mark.parametrize(("g_K", "tolerance"), [(0.05, 2e-4), (0.15, 1e-5), (0.5, 1e-5)])
@pytest.mark.parametrize(
    "m",
    [
        Motion(1.0, 0.0, 1.0, 0.0),
        Motion(1.0, 0.1, 1.4, 0.0),
        Motion(-1.2, 0.2, -1.6, 0.1),
        Motion(0.65, 0.05, 1.0, 0.3),
        Motion(0.9, -0.03, 1.0, -0.3),
    ],
    ids=["straight", "drift", "reverse", "turn", "turn and slip"],
)
def test_exponential_law_is_the_integral_over_the_patch(m: Motion, g_K: float, tolerance: float) -> None:
    want = exponential(m, *STIFFNESS[1], g_K)
    size = math.hypot(*linear(m, *STIFFNESS[1]))
    assert wrench_of(ROLL, m, g_K) == pytest.approx(want, rel=0, abs=tolerance * size)


@pytest.mark.parametrize(
    "m", [Motion(1.0, 0.1, 1.4, 0.0), Motion(-0.9, -0.03, -1.2, -0.3), Motion(0.65, 0.0, 1.0, 0.5)]
)
@pytest.mark.parametrize("linear_moment", [0.0, 1.0])
def test_simpler_readings_of_the_law_go_by_the_middle(m: Motion, linear_moment: float) -> None:
    Sx, Sy, Tz = of_the_middle(m, *STIFFNESS[1], 0.15)
    want = Sx, Sy, linear(m, *STIFFNESS[1])[2] if linear_moment else Tz
    assert wrench_of(ROLL, m, 0.15, by_strip=0.0, linear_moment=linear_moment) == pytest.approx(
        want, rel=1e-5, abs=1e-5
    )
    if m.yaw:
        assert abs(wrench_of(ROLL, m, 0.15)[2]) < 0.99 * abs(Tz)  # the ends slip more, and give way first


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0.6, 0.8, 0), (0.5, 0.2, 0.4)])
def test_linear_law_is_the_limit_of_the_exponential_one(direction: tuple[float, float, float]) -> None:
    """Ten times less slip, ten times less difference: to first order the force lacks |g| / (3 g_K) of itself."""
    dx, dy, dyaw = direction
    lack = []
    for slip in (1e-2, 1e-3, 1e-4):
        m = Motion(0.65 + slip * dx, slip * dy, 1.0, slip * dyaw)
        line, bent = np.array(wrench_of(ROLL, m)), np.array(wrench_of(ROLL, m, 0.15))
        lack.append(np.linalg.norm(line - bent) / np.linalg.norm(line))
    assert lack[2] < 4e-4
    assert lack[0] / lack[1] == pytest.approx(10, rel=0.05)
    assert lack[1] / lack[2] == pytest.approx(10, rel=0.01)
    if dyaw == 0:
        slip = 1e-4 * math.hypot(dx, dy) / math.hypot(0.65, V_EPS)
        assert lack[2] == pytest.approx(slip / (3 * 0.15), rel=0.01)


@pytest.mark.parametrize("x", [1e-9, 1e-3, 0.0499999, 0.05, 0.0500001, 0.3, 1.0, 5.0, 50.0])
def test_mobilised_share_is_the_mean_along_the_patch(x: float) -> None:
    """Mean over zeta in 0..1 of (1 - exp(-x zeta)) against that of x zeta, by midpoint sums; no step at x = 0.05."""
    zeta = (np.arange(200_000) + 0.5) / 200_000
    want = np.mean(-np.expm1(-x * zeta)) / (x / 2)
    assert float(ca.DM(contact.mobilised_share(ca.SX(x)))) == pytest.approx(want, rel=1e-8)


@pytest.mark.parametrize("x", [1e-3, 0.3, 5.0])
def test_a_hyperbola_has_the_same_slope_and_half_as_much_again_at_its_end(x: float) -> None:
    """A force as x / (a + b x): 1 / (1 + x/3) of the linear law, 3 in the limit, where the exponential one has 2."""
    bent = float(ca.DM(contact.mobilised_share(ca.SX(x), 1.0)))
    assert bent == pytest.approx(1 / (1 + x / 3), rel=1e-8)
    assert bent >= float(ca.DM(contact.mobilised_share(ca.SX(x))))
    assert 1e9 * float(ca.DM(contact.mobilised_share(ca.SX(1e9), 1.0))) == pytest.approx(3.0, rel=1e-6)


def test_a_wheel_without_width_only_slips_at_its_middle() -> None:
    thin = ROLL.model_copy(update={"width": ROLL.width.model_copy(update={"value": 0.0})})
    m = Motion(0.9, 0.1, 1.0, 0.3)
    Sx, Sy, Tz = wrench_of(thin, m, 0.15)
    assert (Sx, Sy, Tz) == pytest.approx((*wrench_of(ROLL, Motion(m.Vx, m.Vy, m.spin, 0.0), 0.15)[:2], 0.0), rel=1e-12)


@given(m=motions, g_K=st.sampled_from([0.05, 0.15, 1.0]))
def test_exponential_law_never_exceeds_the_linear_one_nor_the_soils_strength(m: Motion, g_K: float) -> None:
    """Within the patch the stress is below both; its sum is at most 2 |K| g_K."""
    Sx, Sy, Tz = wrench_of(ROLL, m, g_K)
    assert abs(Sx) <= 2 * 1.0e5 * g_K
    assert abs(Sy) <= min(2 * 0.9e5 * g_K, abs(linear(m, *STIFFNESS[1])[1])) + 1e-9
    assert abs(Tz) <= 2 * 1.0e5 * g_K * LC / 4 * 1.05


# --------------------------------------------------------------------------- energy, rest, and both directions
@given(m=motions, g_K=laws)
def test_the_soil_only_takes_energy(m: Motion, g_K: float | None) -> None:
    """Power of force, spin moment and yaw moment on the moving roll is never positive."""
    Sx, Sy, Tz = wrench_of(ROLL, m, g_K)
    assert Sx * m.Vx + Sy * m.Vy - RC * Sx * m.spin - Tz * m.yaw <= 1e-9


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31))
def test_the_soil_only_takes_energy_from_the_machine(seed: int, va12: Model) -> None:
    q, nu = states(20, seed)
    assert (np.sum(soil_force(va12, q, nu) * nu, axis=0) <= 1e-6).all()


@pytest.mark.slow
@given(m=motions, g_K=laws)
def test_driving_backward_mirrors_driving_forward(m: Motion, g_K: float | None) -> None:
    """Seen in a mirror across the roll's axle, x and with it spin and yaw change sign: so do S_x and T_z, exactly."""
    Sx, Sy, Tz = wrench_of(ROLL, m, g_K)
    assert wrench_of(ROLL, Motion(-m.Vx, m.Vy, -m.spin, -m.yaw), g_K) == (-Sx, Sy, -Tz)


@pytest.mark.slow
@given(m=motions, g_K=laws)
def test_left_mirrors_right(m: Motion, g_K: float | None) -> None:
    """Seen in a mirror along the chassis, y and yaw change sign: so do S_y and T_z."""
    Sx, Sy, Tz = wrench_of(ROLL, m, g_K)
    mirrored = wrench_of(ROLL, Motion(m.Vx, -m.Vy, m.spin, -m.yaw), g_K)
    assert mirrored == pytest.approx((Sx, -Sy, -Tz), rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("law", ["linear", "exponential"])
def test_the_machine_built_back_to_front_drives_backward_as_va12_drives_forward(law: str) -> None:
    """A mirror across the axle as a whole machine: table and centres of mass mirrored in x, motion mirrored in x.

    Mirrored: V_x, spins, and (as turns about z) yaw and articulation; so are the rows of the prediction, offsets too.
    """
    changes: dict[str, Any] = {"law": law, "saturation_slip": quantity(0.15)}
    here = with_contacts(load_machine("va12"), **changes)
    raw = here.model_dump()
    for body in raw["body"]:
        body["d"]["value"] *= -1
        if body["inertia"]:
            x, y, z = body["inertia"]["com"]["value"]
            body["inertia"]["com"]["value"] = (-x, y, z)
        if body["friction"]:
            body["friction"]["u0"]["value"] *= -1
    there = Machine.model_validate(raw)
    mirror = np.array([[-1], [1], [-1], [-1], [-1], [-1]])
    q, nu = states(200, seed=3)
    a = np.random.default_rng(4).normal(size=(6, 200))
    forward = build(here).predict(q, nu, a, parameters(build(here))).full()
    backward = build(there).predict(mirror * q, mirror * nu, mirror * a, parameters(build(there))).full()
    assert np.allclose(backward, mirror * forward, rtol=1e-12, atol=1e-12 * np.abs(forward).max())


def test_the_straight_line_driven_backward_is_the_one_driven_forward_exactly() -> None:
    """To the last bit: torques and speeds reversed, accelerations reversed."""
    model = build(load_machine("va12_straight"))
    rng = np.random.default_rng(6)
    q, nu = rng.normal(size=(3, 200)), rng.normal(size=(3, 200))
    u = rng.uniform(-5000, 5000, (2, 200))
    forward = model.acceleration(q, nu, u, model.nominal).full()
    assert np.array_equal(model.acceleration(-q, -nu, -u, model.nominal).full(), -forward)


def test_reversing_time_reverses_soil_and_friction_and_nothing_else(va12: Model) -> None:
    """Without offsets: inertia forces are even in the velocities, what dissipates is odd."""
    q, nu = states(100, seed=7)
    a = np.random.default_rng(8).normal(size=(6, 100))
    p = parameters(va12, u=0.0)
    rigid = parameters(va12, u=0.0, F=0.0, K=0.0)
    inertia = va12.predict(q, nu, a, rigid).full()
    lossy = va12.predict(q, nu, a, p).full() - inertia
    assert np.allclose(va12.predict(q, -nu, a, rigid).full(), inertia, rtol=1e-12, atol=1e-8)
    assert np.allclose(va12.predict(q, -nu, a, p).full() - inertia, -lossy, rtol=1e-10, atol=1e-7)


def test_va12_balanced_about_its_axis_turns_left_as_it_turns_right(va12: Model) -> None:
    p = parameters(va12, MY0=0.0, MY2=0.0, u20=0.0)
    mirror = np.array([[1], [-1], [-1], [1], [-1], [1]])
    q, nu = states(100, seed=9)
    a = np.random.default_rng(10).normal(size=(6, 100))
    right = va12.predict(q, nu, a, p).full()
    left = va12.predict(mirror * q, mirror * nu, mirror * a, p).full()
    assert np.allclose(left, mirror * right, rtol=1e-12, atol=1e-8)


@pytest.mark.parametrize("g_K", [None, 0.15])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_roll_at_rest_is_resisted_either_way(direction: int, g_K: float | None) -> None:
    """The paper's (17) divides by R_c w, which is zero here and negative in reverse."""
    slow = 1e-6 * direction
    Sx, _, _ = wrench_of(ROLL, Motion(slow, 0.0, 0.0, 0.0), g_K)
    assert Sx * slow < 0, "pushed along x"
    _, Sy, _ = wrench_of(ROLL, Motion(0.0, slow, 0.0, 0.0), g_K)
    assert Sy * slow < 0, "pushed along y"
    Sx, _, _ = wrench_of(ROLL, Motion(0.0, 0.0, slow, 0.0), g_K)
    assert -RC * Sx * slow < 0, "spun by its motor"
    _, _, Tz = wrench_of(ROLL, Motion(0.0, 0.0, 0.0, slow), g_K)
    assert -Tz * slow < 0, "turned about z"
    assert wrench_of(ROLL, Motion(0.0, 0.0, 0.0, 0.0), g_K) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("law", ["linear", "exponential"])
def test_nothing_is_singular_at_rest(law: str) -> None:
    """Force and stiffness stay finite: the slope at rest is K / v_eps."""
    model = build(with_contacts(load_machine("va12"), law=law, saturation_slip=quantity(0.15)))
    q, nu, _ = model.symbols()
    row = model.predict(q, nu, 0, ca.DM(parameters(model, F=0.0, u=0.0)))
    f = ca.Function("f", [q, nu], [row, ca.jacobian(row, nu)])
    force, slope = (x.full() for x in f(np.zeros(6), np.zeros(6)))
    assert np.array_equal(force, np.zeros((6, 1)))
    assert np.isfinite(slope).all()
    assert slope[0, 0] == pytest.approx((1.0e5 + 1.2e5) / V_EPS, rel=1e-4)
    assert slope[1, 1] == pytest.approx((0.9e5 + 1.1e5) / V_EPS, rel=1e-4)
    assert slope[3, 3] == pytest.approx(1.0e5 * RC**2 / V_EPS, rel=1e-4)


@given(m=motions)
def test_forward_rolling_agrees_with_the_papers_slip_when_fast(m: Motion) -> None:
    """(17) as printed, (V_x - R_c w) / (R_c w), is met within (v_eps / R_c w)^2 / 2 where the roll turns forward."""
    rim = RC * abs(m.spin)
    if rim < 0.2:
        return
    s = contact.slip(ROLL, ca.SX(m.Vx), ca.SX(m.Vy), ca.SX(abs(m.spin)))
    printed = (m.Vx - rim) / rim
    assert abs(float(ca.DM(s.gx)) - printed) <= (V_EPS / rim) ** 2 / 2 * abs(printed) + 1e-12

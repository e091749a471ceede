"""Motion against a much tighter integration by another method; sensors against their definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.drives import drive

from excite.errors import MachineError, SimulationError
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine import Quantity, machine
from excite.model.machine.records import Source
from excite.simulation import Motion, sensors, simulate


def tight(model: Model, torque: np.ndarray, q0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """q, nu (N, n_q) by LSODA at rtol 1e-11, one call per sample so that every kink of the torque is met."""
    n, h = len(q0), 1 / float(model.machine.sampling_hz)
    state = np.concatenate([q0, np.zeros(n)])
    history = [state]
    for k in range(len(torque) - 1):
        rise = (torque[k + 1] - torque[k]) / h

        def rate(t: float, y: np.ndarray, k: int = k, rise: np.ndarray = rise) -> np.ndarray:
            dq = model.kinematics(y[:n], y[n:])[0].full().ravel()
            a = model.acceleration(y[:n], y[n:], torque[k] + rise * t, model.nominal).full().ravel()
            return np.concatenate([dq, a])

        state = solve_ivp(rate, (0, h), state, "LSODA", rtol=1e-11, atol=1e-13).y[:, -1]
        history.append(state)
    full = np.array(history)
    return full[:, :n], full[:, n:]


def worst(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference of each signal relative to its largest value."""
    return float((np.abs(a - b).max(axis=0) / np.abs(b).max(axis=0)).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "duration", "size"), [("va12", 8, 2500), ("va12", 20, 1200), ("va12_straight", 8, 2500)]
)
def test_motion_agrees_with_a_tight_integration(name: str, duration: float, size: float) -> None:
    model = prediction.build(machine.load_machine(name))
    torque = drive(model, duration, 3, {"u1": size, "u2": 3.5 * size, "u4": size})
    motion = simulate(model, torque)
    q, nu = tight(model, torque, motion.q[0])
    assert worst(motion.q, q) < 1e-6
    assert worst(motion.nu, nu) < 1e-6


def test_motion_continues_from_any_state(va12: Model, va12_motion: Motion) -> None:
    k = 2345
    rest = simulate(va12, va12_motion.u[k:], q0=va12_motion.q[k], nu0=va12_motion.nu[k])
    assert worst(rest.q, va12_motion.q[k:]) < 1e-6
    assert worst(rest.nu, va12_motion.nu[k:]) < 1e-6


def test_turned_lane_turns_the_path(va12: Model, va12_motion: Motion) -> None:
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)
    moved = simulate(va12, va12_motion.u[:2001], q0=np.array([3, -2, turn, 0, 0, 0]))
    expected = np.array([[c, -s], [s, c]]) @ va12_motion.q[:2001, :2].T + [[3], [-2]]
    assert np.abs(moved.q[:, :2].T - expected).max() < 1e-7
    assert np.abs(moved.nu - va12_motion.nu[:2001]).max() < 1e-7


def test_acceleration_is_the_derivative_of_speed(va12_motion: Motion) -> None:
    nu, a, h = va12_motion.nu, va12_motion.a, 0.01
    simpson = h / 6 * (a[:-2:2] + 4 * a[1:-1:2] + a[2::2]) * 2
    # fourth-order quadrature at 100 Hz: exact to 1e-3 where the stiff contact turns, far better elsewhere
    assert np.median(np.abs(nu[2::2] - nu[:-2:2] - simpson)) < 1e-6


def test_machine_rests_where_nothing_drives_it(va12: Model) -> None:
    motion = simulate(va12, np.zeros((501, 3)))
    assert np.abs(motion.nu).max() == 0


def test_coasts_to_rest(va12: Model) -> None:
    moving = np.array([1.0, 0, 0, 1 / 0.65, 0, 1 / 0.65])
    motion = simulate(va12, np.zeros((6001, 3)), nu0=moving)
    energy = np.abs(motion.nu[:, 0])
    assert energy[-1] < 0.05
    assert (np.diff(energy[:2000]) < 1e-12).all()


def test_emps_moves_as_an_inertia_with_sign_friction(emps: Model) -> None:
    """Constant force above Coulomb friction: the closed form of M v' = F - Fv v - Fc."""
    force, (M, Fv, Fc, _) = 80.0, emps.nominal
    motion = simulate(emps, np.full((1001, 1), force))
    v = (force - Fc) / Fv * (1 - np.exp(-Fv / M * motion.t))
    assert np.abs(motion.nu[:, 0] - v).max() < 1e-5


@pytest.mark.parametrize("name", ["ZZ1", "ZZ2", "M"])
def test_impossible_inertia_is_never_a_motion(va12: Model, name: str) -> None:
    X = va12.nominal.copy()
    X[va12.base.names.index(name)] *= -1
    with pytest.raises(SimulationError, match="positive definite"):
        simulate(va12, np.full((101, 3), 1000.0), X)


def test_divergence_is_said(va12: Model) -> None:
    X = va12.nominal.copy()
    X[va12.base.names.index("Fv1")] = -1e7
    with pytest.raises(SimulationError, match="diverges at t = "):
        simulate(va12, np.full((6001, 3), 1000.0), X)


def test_what_an_effect_remembers_is_a_number_as_well(va12: Model) -> None:
    """0 / 0 in one state of many, which the largest of their errors overlooks. A file that says so is refused."""

    def rubbing(source: Source) -> Model:
        entry = placing.parse_effect("articulation_backlash=0.005", va12.machine, 60.0)
        own = {"rubs": 1.0, "damping": 0.0, "breakaway": 0.0}
        shape = {name: Quantity(value=x, source=source) for name, x in own.items()}
        return prediction.build(placing.with_effects(va12.machine, entry.model_copy(update={"shape": shape})))

    with pytest.raises(SimulationError, match="not finite at t = "):
        simulate(rubbing("identified"), np.full((20, 3), 1000.0))
    with pytest.raises(MachineError, match="articulation_backlash: shape damping must be > 0"):
        rubbing("assumed")


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        (np.zeros((10, 2)), "needs shape"),
        (np.zeros(10), "needs shape"),
        (np.array([[0.0, 0, 0], [0, np.nan, 0]]), "row 1"),
    ],
)
def test_bad_torques_are_refused(va12: Model, torque: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        simulate(va12, torque)


# ---------------------------------------------------------------- sensors


def test_exact_sensors_read_the_motion(va12: Model, va12_motion: Motion) -> None:
    log = sensors.measure(va12, va12_motion, noise=False)
    assert np.array_equal(log["theta1_rad"], va12_motion.q[:, 3])
    assert np.array_equal(log["u1_Nm"], va12_motion.u[:, 0] - 183.14)
    assert np.array_equal(log["vy_m_s"], va12_motion.nu[:, 1])
    assert np.array_equal(log["yaw_rate_rad_s"], va12_motion.nu[:, 2])


def test_measuring_wheels_roll_without_slip_on_the_front_axis(va12: Model, va12_motion: Motion) -> None:
    """(32): the mean of the two gives the way of O0, their difference the heading."""
    log = sensors.measure(va12, va12_motion, noise=False)
    left, right = 0.33 * log["thetal_rad"].to_numpy(), 0.33 * log["thetar_rad"].to_numpy()
    way = np.concatenate([[0], np.cumsum((va12_motion.nu[1:, 0] + va12_motion.nu[:-1, 0]) / 2 * 0.01)])
    assert np.abs((left + right) / 2 - way).max() < 1e-3
    assert np.abs((right - left) / 2.5 - va12_motion.q[:, 2]).max() < 1e-7


def test_flaws_are_those_of_the_machine_file(va12: Model, va12_motion: Motion) -> None:
    exact = sensors.measure(va12, va12_motion, noise=False)
    log = sensors.measure(va12, va12_motion, seed=5)
    step = 2 * np.pi / 8192
    counts = log["theta1_rad"] / step
    assert np.abs(counts - counts.round()).max() < 1e-6
    assert (log["theta1_rad"] - exact["theta1_rad"]).abs().max() <= step
    for column, std in {"u1_Nm": 40, "u2_Nm": 100, "u4_Nm": 40, "yaw_rate_rad_s": 0.002, "vy_m_s": 0.01}.items():
        error = (log[column] - exact[column]).to_numpy()
        assert error.std() == pytest.approx(std, rel=0.05)
        assert abs(error.mean()) < 4 * std / np.sqrt(len(error))
        assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.06


def test_same_seed_same_log(va12: Model, va12_motion: Motion) -> None:
    assert sensors.measure(va12, va12_motion, seed=1).equals(sensors.measure(va12, va12_motion, seed=1))
    assert not sensors.measure(va12, va12_motion, seed=1).equals(sensors.measure(va12, va12_motion, seed=2))


@pytest.mark.parametrize(
    ("fixture", "kit", "columns"),
    [
        ("va12", "paper", "t_s theta1_rad theta4_rad theta2_rad thetal_rad thetar_rad u1_Nm u2_Nm u4_Nm"),
        (
            "va12",
            "full",
            "t_s theta1_rad theta4_rad theta2_rad thetal_rad thetar_rad u1_Nm u2_Nm u4_Nm yaw_rate_rad_s vy_m_s",
        ),
        ("straight", "paper", "t_s theta1_rad theta4_rad thetal_rad thetar_rad u1_Nm u4_Nm"),
        ("straight", "full", "t_s theta1_rad theta4_rad thetal_rad thetar_rad u1_Nm u4_Nm"),
    ],
)
def test_kits_have_the_contracts_columns(request: pytest.FixtureRequest, fixture: str, kit: str, columns: str) -> None:
    model = request.getfixturevalue(fixture)
    motion = simulate(model, np.zeros((10, len(model.inputs))))
    assert list(sensors.measure(model, motion, kit=kit)) == columns.split()


def test_unknown_kit_is_refused(va12: Model, va12_motion: Motion) -> None:
    with pytest.raises(ValueError, match="allowed: paper, full"):
        sensors.measure(va12, va12_motion, kit="deluxe")


def test_true_torque_offset_follows_the_parameters(va12: Model, va12_motion: Motion) -> None:
    X = va12.nominal.copy()
    X[va12.base.names.index("u10")] = 77.0
    log = sensors.measure(va12, va12_motion, X, noise=False)
    assert np.allclose(log["u1_Nm"] - va12_motion.u[:, 0], 77.0)


def test_sensor_factor_turns_si_into_the_columns_unit(emps: Model) -> None:
    motion = simulate(emps, np.full((200, 1), 50.0))
    log = sensors.measure(emps, motion, noise=False)
    assert np.allclose(log["vir"] * 35.1507, 50.0 - 3.1648)


def test_quantisation_can_be_made_coarse(straight: Model, straight_motion: Motion) -> None:
    coarse = tuple(
        s.model_copy(update={"counts_per_turn": Quantity(value=64, source="assumed")}) if s.name == "theta1" else s
        for s in straight.machine.sensor
    )
    model = prediction.build(straight.machine.model_copy(update={"sensor": coarse}))
    log = sensors.measure(model, straight_motion)
    assert len(np.unique(np.diff(log["theta1_rad"]).round(9))) <= 3


def test_encoder_edges_lie_anywhere_from_log_to_log(straight: Model, straight_motion: Motion) -> None:
    """An encoder is switched on within a count: its edges of several logs fall on all parts of one, evenly."""
    sensor = next(s for s in straight.machine.sensors("full") if s.name == "theta1")
    turned = straight_motion.q[:, straight.coordinates.index("theta1")]
    step = float(sensor.resolution or 0)
    parts = []
    for seed in range(60):
        counts = np.round(sensors.measure(straight, straight_motion, seed=seed)[sensor.column].to_numpy() / step)
        at = np.flatnonzero(np.diff(counts) == 1)[:50]  # one count forward from one row to the next
        low, high = turned[at] / step, turned[at + 1] / step
        # The edge lies between both rows for every such pair, at the same part of a count.
        grid = np.arange(0.01, 1, 0.02)
        fits = np.array([np.mean(np.ceil(low - g) + g <= high) for g in grid])
        best = grid[fits > fits.max() - 1e-9]
        parts.append(np.angle(np.exp(2j * np.pi * best).mean()) / (2 * np.pi) % 1)
    quarters = np.histogram(parts, bins=4, range=(0, 1))[0]
    assert (quarters >= 5).all(), quarters

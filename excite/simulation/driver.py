"""A driver model: a person who follows given speed and steering angles with preview, delay and slow errors.

A driver sets a speed lever and a steering lever. The hydrostatic drive then produces the torques that bring the driven
contacts to that speed and the steered joints to that rate, within the machine's limits.

Preview: the trace is visible ahead, so the hand moves early by about its own delay (MacAdam, "Application of an optimal
preview control for simulation of closed-loop automobile driving", IEEE Trans. SMC 11(6), 1981; Sheridan, 1966).
Feedback: deviations from the response that the driver expects, the usual lag of the machine included, are corrected
after a reaction time. Hand: a second-order low-pass (McRuer and Jex, 1967) that every command and slow error passes.
Neutral: errors and corrections fade as the lever nears its detent. Attention: a driver who steers several joints
corrects each deviation more slowly, and the variance of the slow errors grows by the same share (Levison, Elkind and
Ward, "Studies of multivariable manual control systems: a model for task interference", NASA CR-1746, 1971).
Left out: fatigue, learning within a drive, coupling of speed and steering, position on the lane.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy

from excite.model import Model
from excite.model.machine import Body, Machine, Quantity
from excite.simulation.integrator import Motion, respond

DRIVER_STREAM = 2  # stream of random numbers, independent of the sensors'
RESPONSE_TIME = 0.3  # s, time constant of speed under a hydrostatic drive; chosen
WALKING_SPEED = 1.0  # m/s, speed at which the resistance to steering is evaluated; chosen
HOLDING_RATE = 5.0  # 1/s, rate at which the angle error of a steered joint is corrected; chosen
WANDER_TIME = 2.0  # s, both time constants of the slow errors; chosen
WATCHED_SIGNALS = 2  # speed and one angle, for which the numbers of `Driver` hold
NEUTRAL_SPEED = 0.2  # m/s, below which errors and corrections fade with the lever; chosen


@dataclass(frozen=True)
class Driver:
    """Parameters of the driver model; the defaults are those of a practised operator.

    delay_s: reaction time, usually 0.2-0.4 s in manual tracking (McRuer and Jex, 1967).
    bandwidth_hz: of hand and lever, usually below 1 Hz.
    speed_error_m_s, angle_error_rad: standard deviations of the slow errors.
    attention: rate at which a visible deviation is corrected [1/s].
    preview_s: lead of the hand; 0.6 s compensates reaction and hand.
    hydraulics_hz: bandwidth of the drive's torque control; swash plates of pumps settle in 0.05-0.2 s.
    """

    delay_s: float = 0.3
    bandwidth_hz: float = 0.8
    speed_error_m_s: float = 0.03
    angle_error_rad: float = 0.01
    attention: float = 0.8
    preview_s: float = 0.6
    hydraulics_hz: float = 3.0


STEADY_DRIVER = Driver(speed_error_m_s=0.0, angle_error_rad=0.0)  # a driver without slow errors


def follow(
    model: Model,
    speed: np.ndarray,
    angles: np.ndarray,
    driver: Driver | None = None,
    X: np.ndarray | None = None,
    seed: int = 0,
    q0: np.ndarray | None = None,
) -> Motion:
    """Simulate a driver who follows speed (N,) [m/s] and joint angles (N, n) [rad]; return the motion (N samples).

    angles: of the driven joints without contact, in the order of the machine file. X (n_base,): the true machine.
    Torque and torque-rate limits hold. Raises SimulationError, and ValueError for shapes that don't fit.
    """
    driver = driver or Driver()
    machine, rate = model.machine, float(model.machine.sampling_hz)
    rolling = [k for k, b in enumerate(machine.actuated) if b.contact is not None]
    joints = [k for k, b in enumerate(machine.actuated) if b.contact is None]
    n = len(speed)
    if angles.shape != (n, len(joints)):
        raise ValueError(f"angles: needs shape ({n}, {len(joints)}), got {angles.shape}")
    rng = np.random.default_rng([seed, DRIVER_STREAM])
    foreseen = _previewed(np.asarray(speed, float), driver, rate)
    detent = np.minimum(np.abs(foreseen) / NEUTRAL_SPEED, 1.0)
    share = min(WATCHED_SIGNALS / (1 + len(joints)), 1.0)
    attention, blur = driver.attention * share, share**-0.5
    pushed = foreseen + blur * driver.speed_error_m_s * detent * _slow_errors(n, rate, rng)
    aimed = [_previewed(np.asarray(a, float), driver, rate) for a in angles.T]
    wandered = [a + blur * driver.angle_error_rad * _slow_errors(n, rate, rng) for a in aimed]
    turned = [np.gradient(a) * rate for a in wandered]
    # lists, as they are faster than arrays in a loop over samples
    expected = [_expected_response(x, driver, rate).tolist() for x in (foreseen, *aimed)]
    commands = [x.tolist() for x in (pushed, *turned)]
    hands = [_Hand(driver.bandwidth_hz, rate) for _ in commands]
    late = round(driver.delay_s * rate)

    n_q = len(model.coordinates)
    rows = list(model.actuated)
    radius = [float(b.contact.radius) if b.contact is not None else 1.0 for b in machine.actuated]
    fastest, top, climb = _drive_limits(machine)
    climb = climb / rate
    gain = drive_gains(model).tolist()
    settled = 1 - np.exp(-2 * np.pi * driver.hydraulics_hz / rate)
    seen: list[list[float]] = []
    watched = [rows[j] for j in joints]
    last = np.zeros(len(rows))
    start = np.zeros(n_q) if q0 is None else np.asarray(q0, float)
    trim = 0.0
    held = [float(start[r]) for r in watched]

    def torque(k: int, state: np.ndarray) -> np.ndarray:
        nonlocal trim
        seen.append([state[n_q], *(state[r] for r in watched)])
        then = max(k - late, 0)
        off = [e[then] - s for e, s in zip(expected, seen[then], strict=True)]
        trim += attention * off[0] * float(detent[k]) / rate
        lever = hands[0].moved(commands[0][k] + trim * float(detent[k]))
        target = np.empty(len(rows))
        for j in rolling:
            asked = min(max(lever / radius[j], -fastest[j]), fastest[j])
            target[j] = gain[j] * (asked - state[n_q + rows[j]])
        for i, j in enumerate(joints, 1):
            turn = hands[i].moved(commands[i][k] + attention * off[i])
            turn = min(max(turn, -fastest[j]), fastest[j])
            relief = top[j] / (gain[j] * HOLDING_RATE)  # a relief valve opens before the oil is pressed further
            away = held[i - 1] + turn / rate - state[rows[j]]
            held[i - 1] = min(max(away, -relief), relief) + state[rows[j]]
            target[j] = gain[j] * (turn - state[n_q + rows[j]] + HOLDING_RATE * (held[i - 1] - state[rows[j]]))
        wish = last + settled * (np.minimum(np.maximum(target, -top), top) - last)
        if k > 0:
            last[:] += np.minimum(np.maximum(wish - last, -climb), climb)
        return last.copy()

    return respond(model, n, torque, X, q0)


class _Hand:
    """Second-order Butterworth low-pass, sample by sample, initially at rest."""

    def __init__(self, bandwidth: float, rate: float) -> None:
        b, a = _hand_filter(bandwidth, rate)
        self._b, self._a, self._z = b.tolist(), a.tolist(), (0.0, 0.0)

    def moved(self, x: float) -> float:
        """Return the output for the next input."""
        y = self._b[0] * x + self._z[0]
        self._z = (self._b[1] * x - self._a[1] * y + self._z[1], self._b[2] * x - self._a[2] * y)
        return y


def _hand_filter(bandwidth: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients b, a of the hand's low-pass."""
    b, a = scipy.signal.butter(2, bandwidth / (rate / 2))
    return np.asarray(b), np.asarray(a)


def _previewed(wanted: np.ndarray, driver: Driver, rate: float) -> np.ndarray:
    """Shift a trace by preview minus reaction time, its ends held: the aim of the hand."""
    at = np.arange(len(wanted)) + round((driver.preview_s - driver.delay_s) * rate)
    return np.asarray(wanted[np.clip(at, 0, len(wanted) - 1)])


def _expected_response(aimed: np.ndarray, driver: Driver, rate: float) -> np.ndarray:
    """Return the response that the driver expects: the aim, delayed by hand and drive."""
    keep = np.exp(-1 / (RESPONSE_TIME * rate))
    slow = scipy.signal.lfilter(*_hand_filter(driver.bandwidth_hz, rate), aimed - aimed[0])
    return np.asarray(scipy.signal.lfilter([1 - keep], [1, -keep], slow) + aimed[0])


def _slow_errors(n: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """Draw slow errors (n,) of standard deviation 1 that fade in the first and the last two seconds."""
    keep = np.exp(-1 / (WANDER_TIME * rate))
    shape = [1, -2 * keep, keep**2]
    size = np.sqrt((1 + keep**2) / (1 - keep**2) ** 3)  # standard deviation of filtered white noise
    before = round(5 * WANDER_TIME * rate)  # makes the errors stationary from the first sample on
    noise = scipy.signal.lfilter([1 / size], shape, rng.standard_normal(before + n))[before:]
    fade = np.clip(np.minimum(np.arange(n), np.arange(n)[::-1]) / rate / 2, 0, 1)
    return np.asarray(noise * fade)


def _drive_limits(machine: Machine) -> tuple[list[float], np.ndarray, np.ndarray]:
    """Return limits of each drive's rate [rad/s, m/s], torque [N m, N] and torque rate; infinite without one."""

    def of(limit: Quantity | None) -> float:
        return np.inf if limit is None else float(limit)

    driven = machine.actuated
    fastest = [
        of(b.limit.rate) if b.contact is None else of(b.limit.rim_speed) / float(b.contact.radius) for b in driven
    ]
    return fastest, np.array([of(b.limit.torque) for b in driven]), np.array([of(b.limit.torque_rate) for b in driven])


def drive_gains(model: Model) -> np.ndarray:
    """Return torque per rate error (n_u,) [N m s/rad] of each drive: its reflected inertia over RESPONSE_TIME.

    For a steered joint it is at least the resistance to turning at WALKING_SPEED, as the oil flow enforces its rate.
    """
    q, nu, _ = model.symbols()
    dry = [f"Fs{b.index}" for b in model.machine.body]  # independent of speed
    mass, force = model.equations(q, nu, ca.DM(np.where(np.isin(model.base.names, dry), 0.0, model.nominal)))
    at = ca.Function("at", [q, nu], [mass, ca.jacobian(force, nu)])
    names, still = model.coordinates, np.zeros(len(model.coordinates))
    rolling = still.copy()
    rolling[0] = WALKING_SPEED
    for b in model.machine.contacts:
        assert b.contact is not None
        spin = WALKING_SPEED / float(b.contact.radius) / model.machine.ratio(b)
        rolling[names.index(model.machine.coordinate(b))] = spin
    M, D = at(still, still)[0].full(), at(still, rolling)[1].full()
    aside = [names.index(c) for c in model.machine.body[0].coordinates[1:] if c in names]  # the chassis gives way
    D -= D[:, aside] @ np.linalg.solve(D[np.ix_(aside, aside)], D[aside])
    driven = sum(b.contact is not None for b in model.machine.actuated)
    gain = np.zeros(len(model.inputs))
    for j, (row, body) in enumerate(zip(model.actuated, model.machine.actuated, strict=True)):
        if body.contact is None:
            gain[j] = max(M[row, row] / RESPONSE_TIME, D[row, row])
        else:
            gain[j] = (M[0, 0] * float(body.contact.radius) ** 2 / driven + M[row, row]) / RESPONSE_TIME
    return gain


def left_turn_sign(model: Model, body: Body) -> int:
    """Return the sign of a joint's angle that, alone, turns the machine left when rolling forward.

    From pure rolling: the lateral speeds of all contacts vanish, which is linear in the chassis' speeds.
    """
    names = model.coordinates
    q = np.zeros(len(names))
    q[names.index(body.coordinates[0])] = 0.1
    rows = [k for k, s in enumerate(model.slips) if s.startswith("gy")]

    def lateral(k: int) -> np.ndarray:
        nu = np.zeros(len(names))
        nu[k] = 1e-3
        return np.asarray(model.kinematics(q, nu)[1].full())[rows, 0]

    forward, sideways, yaw = (lateral(k) for k in range(3))
    turn = np.linalg.lstsq(np.column_stack([sideways, yaw]), -forward, rcond=None)[0][1]
    return 1 if turn > 0 else -1

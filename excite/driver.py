"""A person at the levers: follows speed and articulation late, slowly and not quite.

People do not play back torques. They set a speed lever and a steering wheel; the hydrostatic drive makes the torques
that bring the rolls to that speed and the articulation to that rate, within the machine's limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.signal

from excite.simulate import Motion, respond
from model.prediction import Model

DRIVER = 2  # stream of random numbers, apart from the sensors'


@dataclass(frozen=True)
class Driver:
    """delay [s] of reaction, bandwidth [Hz] of hand and lever, slow errors of speed [m/s] and angle [rad].

    `attention` [1/s]: how fast a deviation seen is corrected. The values are of a practised operator; delays of
    0.2-0.4 s and bandwidths below 1 Hz are usual in manual tracking (McRuer and Jex, 1967).
    """

    delay_s: float = 0.3
    bandwidth_hz: float = 0.8
    speed_error_m_s: float = 0.03
    angle_error_rad: float = 0.01
    attention: float = 0.8


def follow(
    model: Model,
    speed: np.ndarray,
    angles: np.ndarray,
    driver: Driver | None = None,
    X: np.ndarray | None = None,
    seed: int = 0,
    q0: np.ndarray | None = None,
) -> Motion:
    """The motion (N samples) of a machine whose driver follows speed (N,) [m/s] and joint angles (N, n) [rad].

    `angles` belong to the driven joints without a contact, in the order of the machine file. X (n_base,): the true
    machine. Torque and torque-rate limits hold. Raises SimulationError, and ValueError for shapes that don't fit.
    """
    driver = driver or Driver()
    machine, rate = model.machine, float(model.machine.sampling_hz)
    rolls = [k for k, b in enumerate(machine.actuated) if b.contact is not None]
    joints = [k for k, b in enumerate(machine.actuated) if b.contact is None]
    n = len(speed)
    if angles.shape != (n, len(joints)):
        raise ValueError(f"angles: needs shape ({n}, {len(joints)}), got {angles.shape}")
    rng = np.random.default_rng([seed, DRIVER])
    wanted_speed = _by_hand(speed, driver.speed_error_m_s, driver, rate, rng)
    wanted_angle = np.array(angles, float)
    for i in range(len(joints)):
        wanted_angle[:, i] = _by_hand(angles[:, i], driver.angle_error_rad, driver, rate, rng)
    late = round(driver.delay_s * rate)

    n_q = len(model.coordinates)
    rows = list(model.actuated)
    radius = [float(b.contact.radius) if b.contact is not None else 0.0 for b in machine.actuated]
    gain = gains(model)
    top = np.array([float(b.limit.torque) if b.limit.torque is not None else np.inf for b in machine.actuated])
    climb = np.array(
        [float(b.limit.torque_rate) if b.limit.torque_rate is not None else np.inf for b in machine.actuated]
    )
    rim = [float(b.limit.rim_speed) if b.limit.rim_speed is not None else np.inf for b in machine.actuated]
    swing = [float(b.limit.rate) if b.limit.rate is not None else np.inf for b in machine.actuated]
    seen = np.zeros((n, 1 + len(joints)))
    last = np.zeros(len(rows))

    def torque(k: int, state: np.ndarray) -> np.ndarray:
        q, nu = state[:n_q], state[n_q : 2 * n_q]
        seen[k] = [nu[0], *(q[rows[j]] for j in joints)]
        past = seen[max(k - late, 0)]
        target = last.copy()
        lever = wanted_speed[k] + driver.attention * driver.delay_s * (wanted_speed[max(k - late, 0)] - past[0])
        for j in rolls:
            asked = np.clip(lever, -rim[j], rim[j]) / radius[j]
            target[j] = gain[j] * (asked - nu[rows[j]])
        for i, j in enumerate(joints):
            turn = np.clip(2.0 * (wanted_angle[k, i] - q[rows[j]]), -swing[j], swing[j])
            target[j] = gain[j] * (turn - nu[rows[j]])
        target = np.clip(target, -top, top)
        last[:] = last + np.clip(target - last, -climb / rate, climb / rate)
        if k == 0:
            last[:] = 0.0
        return last.copy()

    return respond(model, n, torque, X, q0)


def _by_hand(wanted: np.ndarray, error: float, driver: Driver, rate: float, rng: np.random.Generator) -> np.ndarray:
    """What the lever is set to: late, smoothed by the hand, with a slow error (2 s) that fades at rest."""
    late = round(driver.delay_s * rate)
    delayed = np.concatenate([np.full(late, wanted[0]), wanted[: len(wanted) - late]])
    b, a = scipy.signal.butter(2, driver.bandwidth_hz / (rate / 2))
    smooth = scipy.signal.lfilter(b, a, delayed - wanted[0]) + wanted[0]
    keep = np.exp(-1 / (2.0 * rate))
    noise = scipy.signal.lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal(len(wanted)))
    fade = np.clip(np.minimum(np.arange(len(wanted)), np.arange(len(wanted))[::-1]) / rate / 2, 0, 1)
    return np.asarray(smooth + error * noise * fade)


def gains(model: Model) -> np.ndarray:
    """(n_u,) torque per speed error [N m s/rad] of each drive: its reflected inertia to speed in about 0.3 s."""
    q, nu, _ = model.symbols()
    mass = ca.Function("mass", [q], [model.equations(q, nu, ca.DM(model.nominal))[0]])
    M = mass(np.zeros(len(model.coordinates))).full()
    rolls = sum(b.contact is not None for b in model.machine.actuated)
    gain = np.zeros(len(model.inputs))
    for j, (row, body) in enumerate(zip(model.actuated, model.machine.actuated, strict=True)):
        share = M[0, 0] * float(body.contact.radius) ** 2 / rolls if body.contact is not None else 0.0
        gain[j] = (share + M[row, row]) / 0.3
    return gain

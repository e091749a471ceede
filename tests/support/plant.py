"""A second road roller, written apart from the program, for tests that hide something in it.

The machine of CONTRACT.md section 1 once more: Lagrange's equations of its kinetic energy in ground coordinates by
automatic differentiation, classical Runge-Kutta steps of half a millisecond, a person at the levers, and the sensors.
Nothing here comes from `model` or `excite`. What is hidden (`causes`, `surprises`) adds its own physics to a `Scene`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, fields, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import scipy.signal

RATE = 100  # samples per second
FINE, COARSE = 20, 4  # steps per sample: the contact is stiff near standstill, about 1500 1/s, and mild at speed
ROLLING = 0.4  # rim speed [m/s] above which coarse steps do
JOINTS = {"front_roll": 0, "articulation": 1, "rear_roll": 2}  # place in u and in friction
ROLLS = ("front_roll", "rear_roll")
TURNING = {"front_roll": 3, "articulation": 4, "rear_roll": 5}  # place in q
ENCODERS = {  # column: counts per turn
    "theta1_rad": 8192,
    "theta4_rad": 8192,
    "theta2_rad": 16384,
    "thetal_rad": 16384,
    "thetar_rad": 16384,
}
NOISE = {"u1_Nm": 40.0, "u2_Nm": 100.0, "u4_Nm": 40.0, "yaw_rate_rad_s": 0.002, "vy_m_s": 0.01}
KITS = {"paper": (*ENCODERS, "u1_Nm", "u2_Nm", "u4_Nm"), "full": (*ENCODERS, *NOISE)}
TORQUE, TORQUE_RATE = (5000.0, 15000.0, 5000.0), (1.0e4, 4.0e4, 1.0e4)
G = 9.81


@dataclass(frozen=True)
class Machine:
    """Bodies, joints and contacts of the VA12 DV, SI units; the geometry is known exactly, the rest may vary."""

    D2: float = 1.45
    D3: float = 1.75
    R: float = 0.65
    L: float = 2.10
    v_eps: float = 0.05
    R_wheel: float = 0.33
    D_l: float = 1.25
    D_r: float = 1.25
    m0: float = 2600.0
    x0: float = -0.55
    y0: float = 0.10
    I0: float = 2900.0
    m1: float = 1900.0
    ZZ1: float = 556.32
    XX1: float = 976.0
    m2: float = 4300.0
    x2: float = -0.95
    y2: float = -0.10
    I2: float = 5200.0
    m4: float = 2200.0
    ZZ4: float = 671.33
    XX4: float = 1144.0
    Kx1: float = -1.0e5
    Ky1: float = -0.9e5
    Kx4: float = -1.2e5
    Ky4: float = -1.1e5
    Fv1: float = 64.75
    Fs1: float = 174.74
    u01: float = -183.14
    Fv2: float = 4000.0
    Fs2: float = 800.0
    u02: float = -150.0
    Fv4: float = 82.84
    Fs4: float = 142.73
    u04: float = -181.94


GEOMETRY = ("D2", "D3", "R", "L", "v_eps", "R_wheel", "D_l", "D_r")


def vary(seed: int, spread: float = 0.2) -> Machine:
    """A machine whose bodies, frictions, offsets and soils differ from the nominal ones by up to `spread` each."""
    rng = np.random.default_rng([seed, 11])
    nominal = Machine()
    values = {f.name: getattr(nominal, f.name) * rng.uniform(1 - spread, 1 + spread) for f in fields(Machine)}
    return replace(nominal, **{name: v for name, v in values.items() if name not in GEOMETRY})


# ---------------------------------------------------------------------------------------------------- equations
class Scene:
    """The machine's equations while they are being put together, open to additions.

    Symbols: `t`, coordinates `q` = x, y, heading, front spin, articulation, rear spin and their rates `qd`, `u` the
    three torques that the sensors see, `m` the machine. What is hidden may
      transform a torque on its way to the joint      torque[j]: callables u -> u
      add friction                                    friction[j]: callables (w, delivered torque) -> torque
      scale the machine's own friction                wear[j]: factors
      turn its dry part otherwise                     sign[j]: rate over the smoothing one -> -1 to 1
      change soil (c.Kx, c.Ky) or the law itself      soil[roll]: callables c -> None; law[roll]: c -> Sx, Sy, Mz
      push, or add moving mass                        `push`, `point`
      have states and slow memory of its own          `state`, `rates`, `hold`
      change what sensors see or write                read[column], sensed, written: callables (t, columns, rng)
    """

    def __init__(self) -> None:
        self.parameters = ca.SX.sym("m", len(fields(Machine)))
        self.m = SimpleNamespace(**{f.name: self.parameters[k] for k, f in enumerate(fields(Machine))})
        self.t, self.q, self.qd, self.u = (ca.SX.sym(n, k) for n, k in (("t", 1), ("q", 6), ("qd", 6), ("u", 3)))
        self.own: list[tuple[ca.SX, float]] = []
        self.rates: dict[ca.SX, ca.SX] = {}
        self.held: list[tuple[ca.SX, Callable[[float, np.ndarray], float]]] = []
        self.torque: list[list[Callable[[ca.SX], ca.SX]]] = [[], [], []]
        self.friction: list[list[Callable[[ca.SX, ca.SX], ca.SX]]] = [[], [], []]
        self.wear: list[ca.SX] = [ca.SX(1), ca.SX(1), ca.SX(1)]
        self.sign: list[Callable[[ca.SX], ca.SX]] = [ca.tanh, ca.tanh, ca.tanh]
        self.soil: dict[str, list[Callable[[Any], None]]] = {r: [] for r in ROLLS}
        self.law: dict[str, Callable[[Any], tuple[ca.SX, ca.SX, ca.SX]]] = dict.fromkeys(ROLLS, linear)
        self.stiff = False  # whether something stiff was added, so that fine steps are needed at any speed
        self.pushes = ca.SX(6, 1)
        self.energy = ca.SX(0)
        self.sensed: list[Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], None]] = []
        self.written: list[Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], None]] = []
        yaw = self.qd[2]
        self.contact = {"front_roll": self._contact("front", 0.0, yaw), "rear_roll": self._contact("rear", -1.0, yaw)}
        self.read: dict[str, ca.SX] = {
            "theta1_rad": self.q[3],
            "theta4_rad": self.q[5],
            "theta2_rad": self.q[4],
            "u1_Nm": self.u[0],
            "u2_Nm": self.u[1],
            "u4_Nm": self.u[2],
            "yaw_rate_rad_s": yaw,
            "vy_m_s": self.contact["front_roll"].Vy,
        }
        self.wheel_speed = {
            "thetal_rad": (self.contact["front_roll"].Vx - self.m.D_l * yaw) / self.m.R_wheel,
            "thetar_rad": (self.contact["front_roll"].Vx + self.m.D_r * yaw) / self.m.R_wheel,
        }
        for column, rate in self.wheel_speed.items():
            self.read[column] = self.state(rate)

    def state(self, rate: ca.SX | None = None, start: float = 0.0) -> ca.SX:
        """A state of one's own; its rate may be given later in `rates`."""
        symbol = ca.SX.sym(f"z{len(self.own)}")
        self.own.append((symbol, start))
        if rate is not None:
            self.rates[symbol] = rate
        return symbol

    def hold(self, update: Callable[[float, np.ndarray], float]) -> ca.SX:
        """A value that update(t, q) gives afresh at each sample: for what remembers the place."""
        symbol = ca.SX.sym(f"h{len(self.held)}")
        self.held.append((symbol, update))
        return symbol

    def heading(self, chassis: str) -> ca.SX:
        return self.q[2] if chassis == "front" else self.q[2] + self.q[4]

    def place(self, chassis: str, x: Any, y: Any) -> ca.SX:
        """Ground position of a point given in the axes of the front chassis or of the rear one (R2)."""
        at = self.q[:2]
        if chassis == "rear":
            at = at + turn(self.q[2], -self.m.D2, 0.0)
        return at + turn(self.heading(chassis), x, y)

    def velocity(self, position: ca.SX) -> ca.SX:
        return ca.jtimes(position, self.q, self.qd) + ca.jacobian(position, self.t)

    def push(self, chassis: str, x: Any, y: Any, force: ca.SX) -> None:
        """A force (2,) in ground axes at a point of a chassis: by virtual work."""
        self.pushes = self.pushes + ca.jacobian(self.place(chassis, x, y), self.q).T @ force

    def point(self, mass: Any, chassis: str, x: Any, y: Any) -> None:
        """Kinetic energy of a point mass on a chassis; x, y may move in time."""
        v = self.velocity(self.place(chassis, x, y))
        self.energy = self.energy + mass * ca.dot(v, v) / 2

    def bodies(self) -> list[tuple[ca.SX, str, ca.SX, ca.SX]]:
        """Mass, chassis and centre of mass of the four bodies."""
        m = self.m
        return [
            (m.m0, "front", m.x0, m.y0),
            (m.m1, "front", ca.SX(0), ca.SX(0)),
            (m.m2, "rear", m.x2, m.y2),
            (m.m4, "rear", -m.D3, ca.SX(0)),
        ]

    def _contact(self, chassis: str, side: float, yaw: ca.SX) -> Any:
        roll, m = ("front_roll" if chassis == "front" else "rear_roll"), self.m
        position = self.place(chassis, side * m.D3, 0.0)
        v = turn(-self.heading(chassis), *ca.vertsplit(self.velocity(position)))
        w = self.qd[TURNING[roll]]
        return SimpleNamespace(
            roll=roll,
            chassis=chassis,
            position=position,
            Vx=v[0],
            Vy=v[1],
            w=w,
            rim=m.R * w,
            yaw=yaw if chassis == "front" else yaw + self.qd[4],
            vn=ca.sqrt((m.R * w) ** 2 + m.v_eps**2),
            Kx=m.Kx1 if chassis == "front" else m.Kx4,
            Ky=m.Ky1 if chassis == "front" else m.Ky4,
            L=m.L,
            R=m.R,
        )

    def assemble(self) -> System:
        """The equations with all that was added, compiled."""
        m, q, qd, t = self.m, self.q, self.qd, self.t
        for mass, chassis, x, y in self.bodies():
            self.point(mass, chassis, x, y)
        rear = qd[2] + qd[4]
        spin = m.ZZ1 * qd[3] ** 2 + m.ZZ4 * qd[5] ** 2
        T = self.energy + ((m.I0 + m.XX1) * qd[2] ** 2 + (m.I2 + m.XX4) * rear**2 + spin) / 2
        momentum = ca.gradient(T, qd)
        mass = ca.jacobian(momentum, qd)
        bias = ca.jtimes(momentum, q, qd) + ca.jacobian(momentum, t) - ca.gradient(T, q)

        Q = self.pushes
        smooth = (0.02, 0.005, 0.02)
        viscous, dry = (m.Fv1, m.Fv2, m.Fv4), (m.Fs1, m.Fs2, m.Fs4)
        for joint, j in JOINTS.items():
            k, U = TURNING[joint], self.u[j]
            for step in self.torque[j]:
                U = step(U)
            w = qd[k]
            U_friction = self.wear[j] * (viscous[j] * w + dry[j] * self.sign[j](w / smooth[j]))
            for more in self.friction[j]:
                U_friction = U_friction + more(w, U)
            Q[k] += U - U_friction
        for roll, c in self.contact.items():
            for change in self.soil[roll]:
                change(c)
            Sx, Sy, Mz = self.law[roll](c)
            Q = Q + ca.jacobian(c.position, q).T @ turn(self.heading(c.chassis), Sx, Sy)
            Q[TURNING[roll]] -= c.R * Sx
            Q = Q + ca.jacobian(c.yaw, qd).T * Mz

        planar = [0, 1, 2, 4]  # the spins are coupled to the rest by the soil alone
        acceleration = ca.SX(6, 1)
        force = Q - bias
        acceleration[planar] = _solve(mass[planar, planar], force[planar])
        for k in (3, 5):
            acceleration[k] = force[k] / mass[k, k]
        own = ca.vertcat(*[s for s, _ in self.own])
        x = ca.vertcat(q, qd, own)
        held = ca.vertcat(*[s for s, _ in self.held]) if self.held else ca.SX(0, 1)
        rates = {s.name(): r for s, r in self.rates.items()}
        dx = ca.vertcat(qd, acceleration, *[rates[s.name()] for s, _ in self.own])
        rate = ca.Function("rate", [x, t, self.u, self.parameters, held], [dx], {"cse": True})
        read = ca.Function("read", [x, t, self.u, self.parameters], list(self.read.values()), {"cse": True})
        slips = [g for c in self.contact.values() for g in ((c.Vx - c.rim) / c.vn, c.Vy / c.vn)]
        slip = ca.Function("slip", [x, self.parameters], [ca.vertcat(*slips)])
        start = np.array([0.0] * 12 + [s for _, s in self.own])
        return System(
            rate,
            _sample(rate, len(start), len(self.held), FINE),
            _sample(rate, len(start), len(self.held), FINE if self.stiff else COARSE),
            read,
            slip,
            start,
            tuple(self.read),
            tuple(update for _, update in self.held),
            tuple(self.sensed),
            tuple(self.written),
        )


def linear(c: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Forces and the moment about z on the chassis, the linear shear law over the width of the roll (17, 24, 25)."""
    return c.Kx * (c.Vx - c.rim) / c.vn, c.Ky * c.Vy / c.vn, c.Kx * c.L**2 / 12 * c.yaw / c.vn


def turn(angle: Any, x: Any, y: Any) -> ca.SX:
    return ca.vertcat(ca.cos(angle) * x - ca.sin(angle) * y, ca.sin(angle) * x + ca.cos(angle) * y)


def _solve(A: ca.SX, b: ca.SX) -> ca.SX:
    """Cholesky without roots; a mass matrix needs no pivoting."""
    n = A.shape[0]
    L, d = ca.SX.eye(n), [ca.SX(0)] * n
    for j in range(n):
        d[j] = A[j, j] - sum((L[j, k] ** 2 * d[k] for k in range(j)), ca.SX(0))
        for i in range(j + 1, n):
            L[i, j] = (A[i, j] - sum((L[i, k] * L[j, k] * d[k] for k in range(j)), ca.SX(0))) / d[j]
    y = ca.solve(ca.tril(L), b)
    return ca.solve(L.T, y / ca.vertcat(*d))


def _sample(rate: ca.Function, n: int, n_held: int, steps: int) -> ca.Function:
    """State after one sample: Runge-Kutta, the torques linear in between."""
    x, t, p = ca.MX.sym("x", n), ca.MX.sym("t"), ca.MX.sym("p", len(fields(Machine)))
    left, right, held = ca.MX.sym("l", 3), ca.MX.sym("r", 3), ca.MX.sym("h", n_held)
    h = 1 / RATE / steps
    z = x
    for k in range(steps):
        u = [left + (right - left) * ((k + s) / steps) for s in (0.0, 0.5, 1.0)]
        at = t + k * h
        a = rate(z, at, u[0], p, held)
        b = rate(z + h / 2 * a, at + h / 2, u[1], p, held)
        c = rate(z + h / 2 * b, at + h / 2, u[1], p, held)
        d = rate(z + h * c, at + h, u[2], p, held)
        z = z + h / 6 * (a + 2 * b + 2 * c + d)
    return ca.Function("sample", [x, t, left, right, p, held], [z])


@dataclass(frozen=True)
class System:
    """Compiled equations: rates, one sample ahead in fine steps or coarse ones, what ideal sensors read, slips.

    `held`, `sensed`, `written`: a scene's slow memory, and what happens to the columns before and after the sensors.
    """

    rate: ca.Function
    fine: ca.Function
    coarse: ca.Function
    read: ca.Function
    slip: ca.Function
    start: np.ndarray
    columns: tuple[str, ...]
    held: tuple[Callable[[float, np.ndarray], float], ...]
    sensed: tuple[Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], None], ...]
    written: tuple[Callable[[np.ndarray, dict[str, np.ndarray], np.random.Generator], None], ...]


@lru_cache(maxsize=1)
def bare() -> System:
    """The machine with nothing hidden in it."""
    return Scene().assemble()


@dataclass(frozen=True)
class Motion:
    """t (N,) [s], states x (N, n): q, q', then a scene's own; u (N, 3) [N m] the torques that the sensors see."""

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray


def respond(system: System, machine: Machine, samples: int, control: Callable[[int, np.ndarray], np.ndarray]) -> Motion:
    """The motion from rest under torques that answer to it: control(k, state one sample before) gives (3,) [N m].

    Raises RuntimeError where the motion leaves the finite numbers.
    """
    p, x = np.array(astuple(machine)), system.start.copy()
    t = np.arange(samples) / RATE
    states, torques = np.empty((samples, len(x))), np.empty((samples, 3))
    (fine_buffer, fine), (coarse_buffer, coarse) = system.fine.buffer(), system.coarse.buffer()
    end, held = np.zeros_like(x), np.zeros(max(len(system.held), 1))
    left, right, now = np.zeros(3), np.zeros(3), np.zeros(1)
    for buffer in (fine_buffer, coarse_buffer):
        for k, array in enumerate((x, now, left, right, p, held)):
            buffer.set_arg(k, array.data)
        buffer.set_res(0, end.data)
    states[0], torques[0] = x, control(0, x)
    for k in range(samples - 1):
        torques[k + 1] = control(k + 1, x)
        left[:], right[:], now[0] = torques[k], torques[k + 1], t[k]
        for i, update in enumerate(system.held):
            held[i] = update(t[k], x)
        (coarse if machine.R * min(abs(x[9]), abs(x[11])) > ROLLING else fine)()
        x[:] = end
        states[k + 1] = x
        if k % 100 == 0 and not np.isfinite(x).all():
            break
    if not np.isfinite(states).all():
        raise RuntimeError(f"the motion diverges before t = {t[k]:.2f} s")
    return Motion(t, states, torques)


def play(system: System, machine: Machine, torque: np.ndarray) -> Motion:
    """The motion under given torques (N, 3) [N m]."""
    return respond(system, machine, len(torque), lambda k, x: torque[k])


# ------------------------------------------------------------------------------------------------------- people
@dataclass(frozen=True)
class Plan:
    """What the driver is asked for: speed (N,) [m/s] and articulation (N,) [rad]."""

    name: str
    speed: np.ndarray
    angle: np.ndarray


def slalom(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Forth and back with stops, weaving on the way."""
    speed = _lanes(t, rng, rng.uniform(7, 13), (0.7, 1.6))
    period = rng.uniform(6, 11)
    return speed, rng.uniform(0.18, 0.42) * np.sin(2 * np.pi * t / period + rng.uniform(0, 6))


def eight(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Left turn, right turn, forward all the time with changing speed."""
    half = rng.uniform(12, 20)
    angle = rng.uniform(0.25, 0.45) * np.where((t // half) % 2 == 0, 1, -1) * rng.choice([-1, 1])
    speed = rng.uniform(0.8, 1.3) + 0.35 * np.sign(np.sin(2 * np.pi * t / rng.uniform(7, 10)))
    return _arrive(t, speed), angle


def stop_and_go(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Short moves with standstill between, either way, the wheel turned now and then."""
    speed, angle = np.zeros_like(t), np.zeros_like(t)
    at, way = 1.0, 1.0
    while at < t[-1]:
        go, stop = rng.uniform(3, 6), rng.uniform(1, 2.5)
        speed[(t >= at) & (t < at + go)] = way * rng.uniform(0.5, 1.5)
        angle[(t >= at) & (t < at + go + stop)] = rng.uniform(-0.35, 0.35) if rng.uniform() < 0.7 else 0.0
        way = -way if rng.uniform() < 0.6 else way
        at += go + stop
    return _arrive(t, speed), angle


def one_way(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One pass in one direction at several speeds, correcting left and right."""
    speed = np.interp(t, np.arange(0, t[-1] + 8, 8), rng.uniform(0.4, 1.6, len(np.arange(0, t[-1] + 8, 8))))
    return _arrive(t, speed), rng.uniform(0.08, 0.25) * np.sin(2 * np.pi * t / rng.uniform(8, 14))


def circles(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Circles forward and the same way back, then to the other side."""
    leg = rng.uniform(9, 14)
    angle = rng.uniform(0.3, 0.45) * np.where((t // (2 * leg)) % 2 == 0, 1, -1)
    return _lanes(t, rng, leg, (0.6, 1.3)), angle * np.clip(t / 3, 0, 1)


MANOEUVRES = {f.__name__: f for f in (slalom, eight, stop_and_go, one_way, circles)}


def _lanes(t: np.ndarray, rng: np.random.Generator, leg: float, between: tuple[float, float]) -> np.ndarray:
    speed = np.zeros_like(t)
    for k in range(int(t[-1] / leg) + 1):
        speed[(t >= k * leg + 0.5) & (t < (k + 1) * leg - 0.8)] = (-1) ** k * rng.uniform(*between)
    return _arrive(t, speed)


def _arrive(t: np.ndarray, speed: np.ndarray) -> np.ndarray:
    return np.where((t < 0.5) | (t > t[-1] - 4), 0.0, speed)


def plan(name: str, duration: float, seed: int) -> Plan:
    """One of MANOEUVRES with random speeds, angles and times."""
    t = np.arange(round(duration * RATE) + 1) / RATE
    speed, angle = MANOEUVRES[name](t, np.random.default_rng([seed, 12]))
    return Plan(name, speed, np.where(t > t[-1] - 5, 0.0, angle))


def drive(system: System, machine: Machine, wanted: Plan, seed: int) -> Motion:
    """A person drives the plan: late, with a slow hand, never quite; hydraulics within the limits of torque and rate.

    The speed lever sets an oil flow for both rolls: each motor pulls towards the speed of the flow, a common pressure
    makes up what is missing. The steering valve does the same for the articulation's rate.
    """
    rng = np.random.default_rng([seed, 13])
    n = len(wanted.speed)
    late = round(rng.uniform(0.2, 0.45) * RATE)
    b, a = scipy.signal.butter(2, rng.uniform(0.3, 0.6) / (RATE / 2))
    rest = np.clip(np.minimum(np.arange(n), np.arange(n)[::-1]) / RATE, 0, 1)

    def hand(target: np.ndarray, shake: float) -> np.ndarray:
        delayed = np.concatenate([np.full(late, target[0]), target[:-late]])
        keep = np.exp(-1 / (rng.uniform(0.5, 2) * RATE))
        slow = scipy.signal.lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal(n))
        return np.asarray(scipy.signal.lfilter(b, a, delayed + shake * slow * rest))

    lever = np.clip(hand(wanted.speed, 0.04), -1.9, 1.9) / machine.R
    wheel = np.clip(hand(wanted.angle, 0.012), -0.55, 0.55)
    stiff = np.array([4500.0, 6.0e4, 4500.0]) * rng.uniform(0.8, 1.2, 3)
    restore, oil = rng.uniform(1.0, 2.0), rng.uniform(0.8, 1.6)
    b1, a1 = scipy.signal.butter(1, 4.0 / (RATE / 2))
    pulse = scipy.signal.lfilter(b1, a1, rng.standard_normal((n, 3)), axis=0) * (120.0, 300.0, 120.0) * rest[:, None]
    top, climb = np.array(TORQUE), np.array(TORQUE_RATE) / RATE
    last, seen = np.zeros(3), np.zeros(n)
    pressure = [0.0, 0.0]

    def control(k: int, x: np.ndarray) -> np.ndarray:
        if k == 0:
            return last.copy()
        seen[k] = x[4]
        turn_rate = min(max(restore * (wheel[k] - seen[max(k - 5, 0)]), -0.33), 0.33)
        error = (lever[k] - x[9], turn_rate - x[10], lever[k] - x[11])
        free = (abs(last) < top).tolist()  # no winding up against the relief valves
        pressure[0] += oil * (error[0] + error[2]) / 2 / RATE * (free[0] and free[2])
        pressure[1] += oil * error[1] / RATE * free[1]
        target = stiff * (error[0] + pressure[0], error[1] + pressure[1], error[2] + pressure[0]) + pulse[k]
        target = np.minimum(np.maximum(target, -top), top)
        last[:] = last + np.minimum(np.maximum(target - last, -climb), climb)
        return last.copy()

    return respond(system, machine, n, control)


# ------------------------------------------------------------------------------------------------------ sensors
def ideal(system: System, machine: Machine, motion: Motion) -> dict[str, np.ndarray]:
    """What perfect sensors read, (N,) by column: the torque offsets and what is hidden in the sensing included."""
    n = len(motion.t)
    p = np.tile(np.array(astuple(machine))[:, None], n)
    values = system.read(motion.x.T, motion.t[None], motion.u.T, p)
    columns = {c: v.full().ravel() for c, v in zip(system.columns, values, strict=True)}
    for change in system.sensed:
        change(motion.t, columns, np.random.default_rng(0))
    for column, offset in zip(("u1_Nm", "u2_Nm", "u4_Nm"), (machine.u01, machine.u02, machine.u04), strict=True):
        columns[column] = columns[column] + offset
    return columns


def measure(system: System, machine: Machine, motion: Motion, kit: str, seed: int) -> pd.DataFrame:
    """The log that the sensors of a kit write: whole counts from a random place between two edges, white noise."""
    rng = np.random.default_rng([seed, 14])
    columns = ideal(system, machine, motion)
    for column, counts in ENCODERS.items():
        step = 2 * np.pi / counts
        whole = np.floor(columns[column] / step + rng.uniform())
        columns[column] = (whole - whole[0]) * step
    for column, sigma in NOISE.items():
        columns[column] = columns[column] + sigma * rng.standard_normal(len(motion.t))
    for change in system.written:
        change(motion.t, columns, rng)
    return pd.DataFrame({"t_s": motion.t} | {c: columns[c] for c in KITS[kit]})


def slips(system: System, machine: Machine, motion: Motion) -> np.ndarray:
    """(N, 4): g_x, g_y of the front roll, then of the rear one."""
    p = np.tile(np.array(astuple(machine))[:, None], len(motion.t))
    return np.asarray(system.slip(motion.x.T, p).full().T)


def base(machine: Machine) -> dict[str, float]:
    """The 22 base parameters by hand: the rear masses seen from the front, the rolls' transverse inertias regrouped."""
    m = machine
    rear, first = m.m2 + m.m4, m.m2 * m.x2 - m.m4 * m.D3
    return {
        "M": m.m0 + m.m1 + rear,
        "MX0R": m.m0 * m.x0 - m.D2 * rear,
        "MY0": m.m0 * m.y0,
        "ZZ0R": m.I0 + m.m0 * (m.x0**2 + m.y0**2) + m.XX1 + m.D2**2 * rear,
        "MX2": first,
        "MY2": m.m2 * m.y2,
        "ZZ2": m.I2 + m.m2 * (m.x2**2 + m.y2**2) + m.XX4 + m.m4 * m.D3**2,
        **{n: getattr(m, n) for n in ("ZZ1", "Fv1", "Fs1", "Kx1", "Ky1")},
        "u10": m.u01,
        **{n: getattr(m, n) for n in ("Fv2", "Fs2")},
        "u20": m.u02,
        **{n: getattr(m, n) for n in ("ZZ4", "Fv4", "Fs4", "Kx4", "Ky4")},
        "u40": m.u04,
    }

"""Scenarios for robust design: the nominal machine with every value changed by some per cent.

The parameters are unknown while a drive is designed. A scenario changes masses, centres of mass, inertias, friction and
contacts one by one; these are values of bodies, not base parameters, so the machine stays physically possible.
"""

from __future__ import annotations

import numpy as np

from excite.model import JOINT_KEYS, Model
from excite.model.machine import Body, Machine, Quantity
from excite.simulation.driver import HOLDING_RATE, drive_gains
from excite.simulation.integrator import Motion, respond

SCENARIO_STREAM = 3  # stream of random numbers, independent of the others
GAIN_FACTOR = 5.0  # feedback gain over that of the driver model's drive; chosen


def perturbed_machines(model: Model, count: int, spread: float = 0.2, seed: int = 0) -> tuple[Model, ...]:
    """Return the nominal machine and count - 1 others at random corners of the box of +-`spread` around it.

    Raises ValueError for a count below 2 or a spread that is not between 0 and 0.9.
    """
    if count < 2:
        raise ValueError(f"a robust design needs at least 2 machines (got {count})")
    rng = np.random.default_rng([seed, SCENARIO_STREAM])
    machines = [vary_machine(model.machine, spread, rng, corner=True) for _ in range(count - 1)]
    return model, *(model.for_machine(m) for m in machines)


def vary_machine(machine: Machine, spread: float, rng: np.random.Generator, corner: bool = False) -> Machine:
    """Multiply values of bodies, friction and contacts by 1 +- spread, drawn uniformly, or at a corner of the box.

    Raises ValueError for a spread that is not between 0 and 0.9.
    """
    if not 0 < spread <= 0.9:
        raise ValueError(f"spread: must be above 0 and at most 0.9 (got {spread:g})")

    def factor() -> float:
        x = float(rng.uniform(-1, 1))
        return 1 + spread * (float(np.sign(x)) if corner else x)

    def changed(q: Quantity) -> Quantity:
        return q.model_copy(update={"value": float(q) * factor()})

    def body(b: Body) -> Body:
        update: dict[str, object] = {}
        if b.inertia is not None:
            parts: dict[str, object] = {}
            for name in ("mass", "XX", "YY", "ZZ"):
                value = getattr(b.inertia, name, None)
                if isinstance(value, Quantity) and float(value) != 0:
                    parts[name] = changed(value)
            if b.inertia.com is not None and any(b.inertia.com.value):
                moved = tuple(x * factor() if x else 0.0 for x in b.inertia.com.value)
                parts["com"] = b.inertia.com.model_copy(update={"value": moved})
            update["inertia"] = b.inertia.model_copy(update=parts)
        for table, names in JOINT_KEYS.items():
            record = getattr(b, table)
            if record is not None:
                update[table] = record.model_copy(update={n: changed(getattr(record, n)) for n in names})
        if b.spring is not None:
            keys = [n for n in ("stiffness", "damping") if getattr(b.spring, n) is not None]
            update["spring"] = b.spring.model_copy(update={n: changed(getattr(b.spring, n)) for n in keys})
        return b.model_copy(update=update)

    return machine.model_copy(update={"body": tuple(body(b) for b in machine.body)})


def track_motion(machine: Model, nominal: Model, motion: Motion) -> Motion:
    """Simulate another machine under the nominal torques and feedback that tracks the nominal motion.

    The feedback corrects rates and angles of the driven joints within torque and torque-rate limits: an attentive
    driver without delay. Raises SimulationError.
    """
    rate, rows = float(nominal.machine.sampling_hz), list(nominal.actuated)
    n_q = len(nominal.coordinates)
    limited = [b.limit for b in nominal.machine.actuated]
    top = np.array([float(x.torque) if x.torque is not None else np.inf for x in limited])
    climb = np.array([float(x.torque_rate) if x.torque_rate is not None else np.inf for x in limited])
    held = np.array([0.0 if b.contact is not None else HOLDING_RATE for b in nominal.machine.actuated])
    gain = GAIN_FACTOR * drive_gains(nominal)
    last = np.zeros(len(rows))

    def torque(k: int, state: np.ndarray) -> np.ndarray:
        at = max(k - 1, 0)  # the state is that of the previous sample
        off = motion.nu[at, rows] - state[n_q:][rows] + held * (motion.q[at, rows] - state[rows])
        wish = np.clip(motion.u[k] + gain * off, -top, top)
        last[:] += np.clip(wish - last, -climb / rate, climb / rate)
        return last.copy()

    return respond(machine, len(motion.t), torque, None, motion.q[0], motion.nu[0])

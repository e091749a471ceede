"""Doubts about a log in which every value is possible: a sign turned around, a torque a thousand times off, a
speed for an angle, other counts than the machine file's.

The drive of a joint that steers does more work with the joint's motion than against it, since friction takes some. A
contact may well brake while another one pulls; but whatever the others do, more torque makes the machine faster. All
contacts turn about as fast, and angles that are counted move in whole counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from excite.errors import NoEstimateError
from excite.model import mechanics
from excite.model.machine import Body, Machine, Sensor, shipped_machines
from excite.text import format_number

SPAN = 0.5  # s: half of what accelerations and torques are taken over, so that counts and noise don't matter
LEAST = 10  # independent spans that a sign is judged by
CLEAR = 2.5  # standard deviations
AGAINST = 0.3  # correlation, or share of the acceleration that the machine file's masses promise, below zero
OPPOSED = -0.5  # correlation of two speeds that says that one is counted the other way round
ALIKE = 0.1  # of the largest singular value: torques that differ by less can't be told apart
FRICTION = 2.0  # times that of the joints: in a bend contacts rub on the ground as well
SAME = 1e-6  # of the largest singular value: no direction of its own
RATES = ("rpm", "rad/s")
CLEARER = 0.8  # times what is left of the torques otherwise: beyond doubt a speed
FAST, SLOWLY = 0.95, 0.7  # correlation with another one's speed, of a speed and of what is none
SEVERAL = 50  # steps that counts are judged by
STILL = 1e-6  # of a count: no step
STEP_ROUNDING = 1e-9  # of the largest reading: smaller steps are rounding of the numbers; chosen
OFF, MOSTLY = 0.1, 0.9  # of a count, and share of the steps, by which steps are whole ones
VARYING = 0.05  # share of the steps that differ from the one before, of rounded readings; chosen
ONE = 0.03  # by which the smallest step may differ from one count, as numbers in a file are rounded
SHARE = 0.1  # of the highest speed: below, dry friction fades
SLOW = 0.1  # rad/s: below, friction fades in an average over a span
MOVED = 0.05  # rad or m: a joint that moves less says nothing of its drive
RARELY = 0.02  # share of the time with a torque of the other sign, below which it never changes; chosen
SMALL, LARGE, REFUSED = 0.01, 3.0, 10.0  # times the drive's limit; more than the last `log.check` refuses
THOUSAND = {"N m": "kN m", "Nm": "kNm", "N": "kN", "Pa": "kPa", "kPa": "MPa"}


@dataclass(frozen=True)
class Doubt:
    """What is doubtful about sensors, and the name of the check that says so (see LOG_CHECKS)."""

    check: str
    sensors: tuple[str, ...]
    text: str


def doubts(machine: Machine, values: Mapping[str, np.ndarray], interpolated: bool = False) -> tuple[str, ...]:
    """Return a line for everything that is doubtful about readings (N,) by sensor name [SI], evenly sampled.

    interpolated: readings that stand between counts are expected. Checks that a sensor's `checks_off` names are left
    out.
    """
    off = {(check, s.name) for s in machine.sensor for check in s.checks_off}
    found = _find_doubts(machine, values, interpolated)
    return tuple(d.text for d in found if not any((d.check, name) in off for name in d.sensors))


def _find_doubts(machine: Machine, values: Mapping[str, np.ndarray], interpolated: bool) -> Iterator[Doubt]:
    rate = float(machine.sampling_hz)
    found = {(s.kind, s.body): s for s in machine.sensors("full") if s.name in values}
    driven = [b for b in machine.actuated if ("angle", b.index) in found and ("torque", b.index) in found]
    angles = {b.index: found["angle", b.index] for b in driven}
    torques = {b.index: found["torque", b.index] for b in driven}
    position = {i: np.cumsum(values[s.name]) / rate if s.is_rate else values[s.name] for i, s in angles.items()}
    moving = [b for b in driven if np.ptp(position[b.index]) > MOVED]
    yield from _dead(machine, values)
    speeds = _speeds(machine, values, rate)
    for s in machine.sensors("full"):
        counted = s.name in values and s.resolution and not interpolated and all(s is not r for r, _ in speeds)
        if counted and (line := _counts(s, machine, values[s.name])):
            yield Doubt("counts", (s.name,), line)
    scaled = [(torques[b.index], _scale(torques[b.index], b, machine, values[torques[b.index].name])) for b in moving]
    if any(line for _, line in scaled):
        # With a torque that is too small the others seem to move the machine alone.
        yield from (Doubt("limits", (s.name,), line) for s, line in scaled if line)
        return
    for s, other in speeds:
        text = (
            f"column {s.column}: goes as the speed of {other.column} does, not as its angle: is it a speed? then"
            f" {as_speed(RATES, machine)}"
        )
        yield Doubt("speed", (s.name,), text)
    half = max(1, round(SPAN * rate))
    accused: set[str] = set()
    for b in moving:
        if len(position[b.index]) < 2 * half * LEAST or (speeds and b.contact):
            continue
        motion = _motion(position[b.index], half, rate)
        means = {c.index: _mean(values[torques[c.index].name], half) for c in driven}
        if not b.contact and _one_sided(means[b.index]):
            continue  # a load, gravity say, moves the joint back
        turned = _pulls(machine, b, driven, motion, means, half) if b.contact else _works(motion, means[b.index], half)
        if turned:
            torque, angle = " - ".join(torques[b.index].columns), angles[b.index].column
            what = (
                f"the more torque {torque} tells, the less the machine speeds up as {angle} counts"
                if b.contact
                else f"the torque {torque} does more work against {angle}'s motion than with it"
            )
            text = (
                f"{what}: is the sign of one of them turned around? (right if something else moves this joint: a slope,"
                " a tow, another drive)"
            )
            yield Doubt("sign", (torques[b.index].name, angles[b.index].name), text)
            accused.add(angles[b.index].name)
    yield from _backward(machine, values)
    yield from _swapped_wheels(machine, values, rate, accused)


def _one_sided(torque: np.ndarray) -> bool:
    """Whether a torque (N,) hardly ever changes its sign."""
    return min(float(np.mean(torque > 0)), float(np.mean(torque < 0))) < RARELY


def against(machine: Machine, values: Mapping[str, np.ndarray]) -> list[str]:
    """A line for every two contacts that turn against each other: the sensor of one of them counts the wrong way."""
    contacts = _contacts(machine, values)
    sides = _sides(machine, contacts)
    found = []
    for one, other in itertools.pairwise(sorted(contacts, key=lambda s: sides[s.name])):
        if sides[one.name] == sides[other.name] and _opposed(one, other, values):
            first, second = (machine.find(s.body).where.replace("_", " ") for s in (one, other))
            found.append(
                f"columns {one.column}, {other.column}: {first} and {second} turn against each other; give one a"
                " negative factor"
            )
    return found


def _backward(machine: Machine, values: Mapping[str, np.ndarray]) -> list[Doubt]:
    """Doubt every measuring wheel that turns against all contacts beside it."""
    wheels = [s for s in machine.sensors("full") if s.name in values and s.kind == "wheel"]
    contacts = _contacts(machine, values)
    sides = _sides(machine, [*contacts, *wheels])
    found = []
    for wheel in wheels:
        beside = [s for s in contacts if sides[s.name] == sides[wheel.name]]
        if beside and all(_opposed(wheel, s, values) for s in beside):
            text = f"column {wheel.column}: turns against {', '.join(s.column for s in beside)}: is its sign right?"
            found.append(Doubt("sign", (wheel.name,), text))
    return found


def _swapped_wheels(
    machine: Machine, values: Mapping[str, np.ndarray], rate: float, accused: Collection[str] = ()
) -> Iterator[Doubt]:
    """Doubt two measuring wheels whose difference turns the machine the other way than its yaw rate or, if its sign is
    not doubtful (accused), its steering joint."""
    wheels = [s for s in machine.sensors("full") if s.kind == "wheel" and s.name in values and not s.is_rate]
    half = max(1, round(SPAN * rate))
    if len(wheels) != 2 or len(values[wheels[0].name]) < 2 * half * LEAST or _backward(machine, values):
        return
    left, right = sorted(wheels, key=lambda s: -float(s.lateral or 0.0))
    across = float(left.lateral or 0.0) - float(right.lateral or 0.0)
    if not across:
        return
    speed = {s.name: float(s.radius or 0.0) * _motion(values[s.name], half, rate)[0] for s in wheels}
    yaw = (speed[right.name] - speed[left.name]) / across
    known = next((s for s in machine.sensors("full") if s.kind == "yaw_rate" and s.name in values), None)
    if known is not None and np.ptp(values[known.name]) > 0:
        told, other = _mean(values[known.name], half), f"{known.column}: are left and right swapped?"
    else:
        steering = _steering(machine, values)
        if steering is None or steering[0].name in accused:
            return
        joint, curvature = steering
        forward = sum(speed.values()) / 2
        told = forward * curvature * _mean(values[joint.name], half)
        other = f"{joint.column}: are left and right swapped, or is its sign turned around?"
    if min(np.ptp(yaw), np.ptp(told)) == 0:
        return
    r = float(np.corrcoef(yaw, told)[0, 1])
    if r < OPPOSED and r * np.sqrt(len(yaw) / (2 * half)) < -CLEAR:
        text = f"columns {left.column}, {right.column}: their difference turns the machine the other way than {other}"
        yield Doubt("swapped", (left.name, right.name), text)


def _steering(machine: Machine, values: Mapping[str, np.ndarray]) -> tuple[Sensor, float] | None:
    """The angle of the only joint that steers, and the curvature [1/m] of the path per radian of it if contacts roll
    without slipping sideways; None where the machine steers otherwise."""
    joints = [b for b in machine.actuated if b.contact is None and b.joint == "revolute"]
    if len(joints) != 1 or len(machine.contacts) < 2:
        return None
    angle = next((s for s in machine.sensors("full") if s.kind == "angle" and s.body == joints[0].index), None)
    if angle is None or angle.name not in values or angle.is_rate:
        return None
    bent = 0.1
    places = mechanics.body_poses(machine, {joints[0].coordinates[0]: bent})
    sideways, known = [], []
    for b in machine.contacts:
        rotation, place = places[b.index]
        axle = rotation[:2, 2] / np.linalg.norm(rotation[:2, 2])  # nothing moves along it
        sideways.append([axle[1], axle[1] * place[0] - axle[0] * place[1]])
        known.append(-axle[0])
    (_, turning), *_ = np.linalg.lstsq(np.array(sideways), np.array(known), rcond=None)
    return angle, float(turning) / bent


def rated_speed(sensor: Sensor, machine: Machine) -> float | None:
    """The rate [rad/s or m/s] that limits allow an angle or a position, None where they don't say."""
    limit, contact = machine.find(sensor.body).limit, machine.find(sensor.body).contact
    if sensor.kind != "angle":
        return None
    if limit.rim_speed is not None and contact is not None:
        return float(limit.rim_speed) / float(contact.radius)
    return None if limit.rate is None else float(limit.rate)


def _contacts(machine: Machine, values: Mapping[str, np.ndarray]) -> list[Sensor]:
    """The sensors of contacts' angles."""
    known = [s for s in machine.sensors("full") if s.name in values and s.kind == "angle"]
    return [s for s in known if machine.find(s.body).contact is not None]


def _sides(machine: Machine, sensors: Sequence[Sensor]) -> dict[str, float]:
    """Left or right, of sensors on a machine with no joint to steer with, which turns its sides against each other."""
    if any(b.contact is None for b in machine.actuated):
        return {s.name: 0.0 for s in sensors}
    places = mechanics.body_poses(machine, {})
    across = {s.name: float(s.lateral) if s.lateral is not None else places[s.body][1][1] for s in sensors}
    return {name: float(np.sign(round(y, 6))) for name, y in across.items()}


def _opposed(one: Sensor, other: Sensor, values: Mapping[str, np.ndarray]) -> bool:
    """Tell if two contacts or measuring wheels turn against each other."""
    a, b = (values[s.name][::10] if s.is_rate else np.diff(values[s.name][::10]) for s in (one, other))
    a, b = a[: len(b)], b[: len(a)]
    return len(a) > 10 and np.ptp(a) > 0 and np.ptp(b) > 0 and bool(np.corrcoef(a, b)[0, 1] < OPPOSED)


def unchanging(sensor: Sensor, values: np.ndarray) -> str:
    """Return a line for a channel that always reads the same, "" otherwise or for a drive that may be off."""
    if sensor.zero_if_absent and not values.any():
        return ""
    name = " - ".join(sensor.columns)
    return f"column {name}: never changes ({values[0]:g}): is the sensor connected?" if np.ptp(values) == 0 else ""


def _dead(machine: Machine, values: Mapping[str, np.ndarray]) -> list[Doubt]:
    """Channels of torques, contacts and measuring wheels that never change while something turns."""
    there = [s for s in machine.sensors("full") if s.name in values]
    rolling = [*_contacts(machine, values), *(s for s in there if s.kind == "wheel")]
    if not any(np.ptp(values[s.name]) > MOVED for s in rolling):
        return []
    found = [(s, unchanging(s, values[s.name])) for s in there if s.kind == "torque" or s in rolling]
    return [Doubt("constant", (s.name,), line) for s, line in found if line]


def _speeds(machine: Machine, values: Mapping[str, np.ndarray], rate: float) -> list[tuple[Sensor, Sensor]]:
    """Angles of contacts and measuring wheels that are rather speeds, each with another one that tells so: all go over
    the same ground, and about as fast."""
    half = max(1, round(SPAN * rate))
    angles = [
        s
        for s in machine.sensors("full")
        if s.kind == "wheel" or (s.kind == "angle" and machine.find(s.body).contact is not None)
    ]
    angles = [s for s in angles if s.name in values and not s.is_rate and len(values[s.name]) >= 2 * half * LEAST]
    own = {s.name: _mean(values[s.name], half) for s in angles}
    turning = {s.name: _motion(values[s.name], half, rate)[0] for s in angles}
    found = []
    for s in angles:
        others = [r for r in angles if r is not s and _alike(own[s.name], turning[r.name]) > FAST]
        if others and _alike(turning[s.name], turning[others[0].name]) < SLOWLY:
            found.append((s, others[0]))
    return found


def _alike(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation, of either sign."""
    return abs(float(np.corrcoef(x, y)[0, 1])) if min(np.ptp(x), np.ptp(y)) > 0 else 0.0


def is_speed(values: np.ndarray, torques: Sequence[np.ndarray], rate: float) -> bool:
    """Tell if readings (N,) of an angle, in any unit, are rather its speed: what they do goes with the torques (N,), by
    inertia and friction, better if they are taken for one."""
    half = max(1, round(SPAN * rate))
    moving = [u for u in torques if np.ptp(u) > 0]
    if not moving or len(values) < 2 * half * LEAST:
        return False
    u = np.column_stack([_mean(u, half) for u in moving])
    first, second = _motion(values, half, rate)
    return _unexplained(u, _mean(values, half), first) < CLEARER * _unexplained(u, first, second)


def as_speed(units: Sequence[str], machine: Machine) -> str:
    """Advise what to write for a column that holds a speed in one of these units."""
    line = " or ".join(f'unit = "{unit}"' for unit in units)
    noise = 'its noise [rad/s] and noise_unit = "SI"'
    return f"write {line} for it in {own_file(machine)}, with {noise} instead of counts_per_turn"


def _unexplained(torques: np.ndarray, speed: np.ndarray, acceleration: np.ndarray) -> float:
    """Return the share that a speed (N,) and its change leave of the combination of torques (N, k) that goes best with
    them, as a share: one less the largest canonical correlation squared."""
    dry = np.tanh(speed / (SHARE * np.abs(speed).max() or 1.0))
    both = _directions(torques).T @ _directions(np.column_stack([speed, acceleration, dry]))
    return max(1 - float(np.linalg.norm(both, 2)) ** 2, 1e-300)


def _directions(A: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span the columns of A (N, k) but for their means."""
    A = A - A.mean(axis=0)
    U, sizes, _ = np.linalg.svd(A / np.maximum(A.std(axis=0), 1e-300), full_matrices=False)
    found: np.ndarray = U[:, sizes > SAME * sizes[0]]
    return found


@contextmanager
def doubts_in_errors(lines: Sequence[str]) -> Iterator[None]:
    """Add what is doubtful about the logs to the message of an estimate that fails."""
    try:
        yield
    except NoEstimateError as err:
        if lines:
            err.args = ("; ".join((str(err), *lines)),)
        raise


def own_file(machine: Machine) -> str:
    """The machine file that a line can be written in, as a message calls it."""
    if machine.name not in shipped_machines():
        return "the machine file"
    return f"a machine file (`excite machine new NAME --like {machine.name}` makes one)"


def _motion(x: np.ndarray, half: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Speed and acceleration (N - 2 half,) of a position (N,), averages over a span."""
    step = half / rate
    first, middle, last = x[: -2 * half], x[half:-half], x[2 * half :]
    return (last - first) / (2 * step), (last - 2 * middle + first) / step**2


def _mean(x: np.ndarray, half: int) -> np.ndarray:
    """The average (N - 2 half,) of a signal (N,) that goes with an acceleration: weighted by a triangle."""
    weights = np.concatenate([np.arange(1, half), np.arange(half, 0, -1)]) / half**2
    return np.convolve(x, weights, "same")[half:-half]


def _works(motion: tuple[np.ndarray, np.ndarray], torque: np.ndarray, half: int) -> bool:
    """Tell if a torque, but for its offset, goes clearly against the speed."""
    speed, _ = motion
    if np.ptp(torque) == 0 or np.ptp(speed) == 0:
        return False
    r = float(np.corrcoef(torque, speed)[0, 1])
    return r < -AGAINST and r * np.sqrt(len(speed) / (2 * half)) < -CLEAR


def _pulls(
    machine: Machine,
    body: Body,
    driven: Sequence[Body],
    motion: tuple[np.ndarray, np.ndarray],
    means: Mapping[int, np.ndarray],
    half: int,
) -> bool:
    """Tell if a contact turns slower for more torque, by least squares over the torques of all contacts and friction.

    As a share of what the machine's mass at the rims makes of a force. Torques that go together all along share the
    effect equally: of one half of them turned around that half is found.
    """
    speed, acceleration = motion
    rolling = [(b, float(b.contact.radius)) for b in driven if b.contact is not None]
    columns = [means[b.index] / radius for b, radius in rolling]
    rubbed = [(b.friction, radius) for b, radius in rolling if b.friction is not None]
    columns.append(FRICTION * sum(float(f.Fs) / radius for f, radius in rubbed) * np.tanh(speed / SLOW))
    columns.append(FRICTION * sum(float(f.Fv) / radius for f, radius in rubbed) * speed)
    A = np.column_stack(columns)
    A -= A.mean(axis=0)
    k = next(k for k, (b, _) in enumerate(rolling) if b.index == body.index)
    y = rolling[k][1] * (acceleration - acceleration.mean())
    inverse = np.linalg.pinv(A, rcond=ALIKE)
    x = inverse @ y
    left = y - A @ x
    deviation = float(np.sqrt(left @ left / len(y) * (inverse[k] @ inverse[k]) * 2 * half))
    mass = sum(float(b.inertia.mass) for b in machine.body if b.inertia is not None)
    mass += sum(
        float(b.inertia.ZZ) / float(b.contact.radius) ** 2
        for b in machine.contacts
        if b.inertia is not None and b.contact is not None
    )
    return float(x[k]) * mass < -AGAINST and float(x[k]) < -CLEAR * deviation


def _counts(sensor: Sensor, machine: Machine, values: np.ndarray) -> str:
    """An angle that moves in other steps than those of its counts, "" where it doesn't."""
    assert sensor.resolution is not None
    every = np.abs(np.diff(values)) / sensor.resolution
    steps = every[every > STILL]
    if len(steps) < SEVERAL:
        return ""
    off = OFF + float(np.finfo(np.float32).eps * np.abs(values).max() / sensor.resolution)
    least, turn = float(np.quantile(steps, 0.01)), float(sensor.counts_per_turn or 0)
    if _whole(steps / least, off * min(1, 1 / least)) and abs(least - 1) > ONE and _vary(every / least):
        return (
            f"column {sensor.column}: moves in steps of {format_number(least, 3)} counts of {turn:g} per turn: is it"
            f" filtered or rounded, or is it counts_per_turn = {round(turn / least)}? then write that for it in"
            f" {own_file(machine)}"
        )
    if _whole(steps, off):
        return ""
    return (
        f"column {sensor.column}: does not move in whole counts of {turn:g} per turn: is it exact, filtered, rounded or"
        " resampled? deviations are stated for counts as they come"
    )


def step_of(values: np.ndarray) -> float:
    """Return the step [SI] in whole numbers of which readings (N,) move, 0 if there is none."""
    every = np.abs(np.diff(values))
    steps = every[every > STEP_ROUNDING * float(np.abs(values).max(initial=0.0))]
    if len(steps) < SEVERAL:
        return 0.0
    least = float(np.quantile(steps, 0.01))
    return least if _whole(steps / least, OFF) and _vary(every / least) else 0.0


def _vary(steps: np.ndarray) -> bool:
    """Tell rounded readings from those at a constant speed by their steps (N,) [counts]: rounded ones differ."""
    counts = np.round(steps)
    return bool(np.count_nonzero(np.diff(counts)) >= VARYING * np.count_nonzero(counts))


def _whole(steps: np.ndarray, off: float) -> bool:
    return bool(np.mean(np.abs(steps - np.round(steps)) < off) > MOSTLY)


def _scale(sensor: Sensor, body: Body, machine: Machine, torque: np.ndarray) -> str:
    """A torque far below or above what its drive can do, "" where it isn't."""
    if body.limit.torque is None:
        return ""
    top, most, name = float(np.abs(torque).max()), float(body.limit.torque), " - ".join(sensor.columns)
    said = (
        f"column {name}: the largest torque is {format_number(top, 3)} {machine.si_unit(sensor)}, the drive's limit"
        f" {most:g}"
    )
    if 0 < top < SMALL * most:
        larger = THOUSAND.get(sensor.unit) if sensor.factor is None and top > SMALL * most / 1000 else None
        if larger is None:
            return f"{said}: is its {'unit' if sensor.factor is None else 'factor'} in the machine file right?"
        return f'{said}: is it in {larger}? then write unit = "{larger}" for it in {own_file(machine)}'
    if LARGE * most < top <= REFUSED * most:
        return f"{said}: is its {'unit' if sensor.factor is None else 'factor'} right?"
    return ""

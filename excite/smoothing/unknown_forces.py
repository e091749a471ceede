"""What a model lacks, as unknown forces, torques and reading errors beside it, and how large they are.

Each contact and joint carries shapes with unknown coefficients: functions of the state (friction by direction, soil by
slip), slow courses over the log, first-order signatures of lags, slopes, radii. A group of coefficients has one
standard deviation, its size, found by marginal likelihood (MacKay, "Bayesian interpolation", Neural Computation 4,
1992). Where the model is right, all sizes are zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from excite.logs import integrate_pose
from excite.model import Model
from excite.model.machine import Body
from excite.simulation import smooth_part
from excite.smoothing.linearisation import SLOPES, StateSpace, feature_names
from excite.smoothing.measurements import Measurements, Trajectory

Form = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Term:
    """Shapes of some coefficients in one input or reading.

    columns (K,): places of the coefficients among those of the log. at: index of the input or the sensor. course (N,
    K): the shapes over the log, or form: functions of the features (N, n_features) -> (N, K), times `unit`.
    """

    columns: np.ndarray
    at: int
    unit: float
    course: np.ndarray | None = None
    form: Form | None = None

    def values(self, features: np.ndarray) -> np.ndarray:
        """Return the shapes (N, K) along a log."""
        if self.form is not None:
            return self.unit * self.form(features)
        assert self.course is not None
        return self.course


@dataclass(frozen=True)
class Lacking:
    """What the model lacks along one log of N samples.

    inputs, readings: terms of torques and forces, and of sensors. count: number of coefficients. force_std
    (n_forces,): standard deviation of white forces on `StateSpace.forces`, from sample to sample.
    """

    inputs: tuple[Term, ...]
    readings: tuple[Term, ...]
    count: int
    force_std: np.ndarray

    def added_inputs(self, coefficients: np.ndarray, features: np.ndarray, n_in: int) -> np.ndarray:
        """Return the change of the inputs (N, n_in) by the coefficients (count,)."""
        found = np.zeros((len(features), n_in))
        for term in self.inputs:
            found[:, term.at] += term.values(features) @ coefficients[term.columns]
        return found

    def reading_errors(self, coefficients: np.ndarray, features: np.ndarray, m: int) -> np.ndarray:
        """Return the errors of the readings (N, m) by the coefficients (count,)."""
        found = np.zeros((len(features), m))
        for term in self.readings:
            found[:, term.at] += term.values(features) @ coefficients[term.columns]
        return found

    def feedback(self, coefficients: np.ndarray, features: np.ndarray, n_in: int) -> np.ndarray | None:
        """Return the slopes (N, n_in, n_features) of the inputs by the features, None if there are none."""
        if not any(t.form for t in self.inputs) or not coefficients.any():
            return None
        slopes = np.zeros((len(features), n_in, features.shape[1]))
        for term, feature, by in self._slopes(features):
            slopes[:, term.at, feature] += by @ coefficients[term.columns]
        return slopes

    def along_slopes(self, weights: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Return the sums (count,) of weights (N, n_in, n_features) on the slopes that unit coefficients make."""
        found = np.zeros(self.count)
        for term, feature, by in self._slopes(features):
            found[term.columns] += weights[:, term.at, feature] @ by
        return found

    def _slopes(self, features: np.ndarray) -> Iterator[tuple[Term, int, np.ndarray]]:
        """Yield the slopes (N, K) of each term by each feature that it follows."""
        for term in self.inputs:
            for k in range(features.shape[1] if term.form else 0):
                step = np.zeros(features.shape[1])
                step[k] = FEATURE_STEP * max(float(np.abs(features[:, k]).max()), 1e-9)
                by = (term.values(features + step) - term.values(features - step)) / (2 * step[k])
                if by.any():
                    yield term, k, by


FEATURE_STEP = 1e-3  # of a feature's largest value, for its difference quotient


@dataclass(frozen=True)
class Group:
    """Coefficients that share one size.

    name: input or sensor, and what it depends on. unit: of the coefficients. typical: usual size [unit] where a
    machine lacks something. index: for each log, the places of the coefficients among those of all logs. period: of the
    fastest course [s], 0 for what follows no time.
    """

    name: str
    unit: str
    typical: float
    index: tuple[np.ndarray, ...]
    period: float = 0.0

    @property
    def every(self) -> np.ndarray:
        """Places of the coefficients of all logs."""
        return np.unique(np.concatenate(self.index))


@dataclass(frozen=True)
class _Entry:
    """One group in one log: name, unit, typical size, whether logs share its coefficients, terms as (at, shapes).

    period: of the fastest course [s], 0 for what follows no time.
    """

    name: str
    unit: str
    typical: float
    shared: bool
    inputs: tuple[tuple[int, np.ndarray | Form], ...]
    count: int
    reading: bool = False
    period: float = 0.0


# Ends of the names of groups whose shapes effects of the catalogue have.
NAMED = ("late", "with angle", "in braking", "resistance", "scale", "once a turn", "slope")
SLOWEST_PERIOD_S = 8.0  # of a slow course [s]: longer than a manoeuvre


def hats(x: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return linear B-splines (N, K) of x (N,), constant outside the knots (K,)."""
    return np.column_stack([np.interp(x, knots, unit) for unit in np.eye(len(knots))])


def ramps(x: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Return the integrals (N, K) of steps between knots (K + 1,): increments of a curve that begins at zero."""
    return np.asarray(np.clip((x[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0))


def friction_curves(
    features: np.ndarray, rate: int, knots: np.ndarray, smoothing: float, mix: np.ndarray
) -> np.ndarray:
    """Return friction curves over speed (N, 2 K), independent for both directions, with correlated coefficients."""
    w = features[:, rate]
    forward = (1 + np.tanh(w / smoothing))[:, None] / 2
    curve = hats(np.abs(w), knots) @ mix
    return np.concatenate([curve * forward, curve * (forward - 1)], axis=1)


def soil_curves(features: np.ndarray, along: int, across: int, stiffness: float, knots: np.ndarray) -> np.ndarray:
    """Return relative changes (N, K) of a soil's stiffness along one axis that grow with the resultant slip."""
    g = np.hypot(features[:, along], features[:, across])
    return np.asarray(-stiffness * features[:, along, None] * ramps(g, knots))


def braking(features: np.ndarray, gx: int, rate: int, stiffness: float) -> np.ndarray:
    """Return a soil's force (N, 1) whose stiffness differs between driving and braking."""
    turn = np.tanh(features[:, gx] * features[:, rate] / BRAKING_SMOOTHING)
    return np.asarray((-stiffness * features[:, gx] * turn)[:, None])


BRAKING_SMOOTHING = 0.025  # of slip times rate [rad/s] over which braking turns into driving


def resistance(features: np.ndarray, rate: int) -> np.ndarray:
    """Return a unit force (N, 1) against the motion of a roll."""
    return np.asarray(-np.tanh(features[:, rate] / RESISTANCE_SMOOTHING)[:, None])


RESISTANCE_SMOOTHING = 0.05  # of the roll's rate [rad/s]


def catalogue(
    space: StateSpace,
    logs: Sequence[tuple[Measurements, Trajectory]],
    X: np.ndarray,
    force_std: np.ndarray,
    named: bool | None = None,
) -> UnknownForces:
    """Return what each log may lack beside white forces of force_std (n_forces,), with the typical sizes.

    named: only groups whose shapes effects of the catalogue have, or only the others.
    """
    speeds, slips = _ranges(space, logs)
    entries = [_entries(space, data, trajectory, X, speeds, slips) for data, trajectory in logs]
    groups, lacking = dict[str, Group](), list[Lacking]()
    total = 0
    for own in entries:
        inputs, readings, at = list[Term](), list[Term](), 0
        for e in own:
            if named is not None and e.name.endswith(NAMED) is not named:
                continue
            known = groups.get(e.name)
            columns = np.arange(at, at + e.count)
            if known is not None and e.shared:
                index = known.index[-1]
            else:
                index = np.arange(total, total + e.count)
                total += e.count
            before, largest = (known.index, known.typical) if known is not None else ((), 0.0)
            groups[e.name] = Group(e.name, e.unit, max(e.typical, largest), (*before, index), e.period)
            for place, shapes in e.inputs:
                form, course = (shapes, None) if callable(shapes) else (None, e.typical * shapes)
                (readings if e.reading else inputs).append(Term(columns, place, e.typical, course, form))
            at += e.count
        lacking.append(Lacking(tuple(inputs), tuple(readings), at, force_std))
    errors = _constant_errors(space.model, groups, speeds)
    return UnknownForces(tuple(lacking), tuple(groups.values()), np.ones(len(groups)), errors)


def _constant_errors(model: Model, groups: Mapping[str, Group], speeds: Mapping[int, float]) -> np.ndarray:
    """Return the typical constant error (n_base,) [SI] of offsets, frictions and stiffnesses: as their slow changes."""
    found = dict[str, float]()
    stiffness = {"Kx{}": "lengthwise stiffness", "Ky{}": "lateral stiffness"}
    kinds = {"u{}0": "torque", "Fs{}": "friction", "Fv{}": "friction", **stiffness}
    for body in model.machine.body:
        for name, kind in kinds.items():
            if group := groups.get(f"{body.where}: {kind}, slow"):
                found[name.format(body.index)] = group.typical
    own = [model.base.standard[k] for k in model.base.independent]  # whatever the base parameters are called
    units = {f"Fv{k}": 1 / fast for k, fast in speeds.items()}
    units |= {n: abs(x) for n, x in zip(own, model.nominal, strict=True) if n[:2] in ("Kx", "Ky")}
    return np.array([found.get(n, 0.0) * units.get(n, 1.0) for n in own])


def _ranges(
    space: StateSpace, logs: Sequence[tuple[Measurements, Trajectory]]
) -> tuple[dict[int, float], dict[tuple[str, int], float]]:
    """Return the fast speed of each driven joint and the large slips of each contact, over all logs."""
    names = feature_names(space.model)
    seen = np.abs(np.concatenate([space.features(t.state)[0][:, :, 0] for _, t in logs])) if names else np.zeros((1, 0))
    large = np.maximum(np.quantile(seen, LARGE_QUANTILE, axis=0), 1e-6) if names else np.zeros(0)
    rates = {k: float(x) for (kind, k), x in zip(names, large, strict=True) if kind == "rate"}
    return rates, {n: float(x) for n, x in zip(names, large, strict=True) if n[0] != "rate"}


SLOW_SPEED = 0.3  # of a rim [m/s], below which a force that is late by a distance is not late by distance over speed
LARGE_QUANTILE = 0.998  # of a speed or slip, at which its curves end
FRICTION_KNOTS = np.array([0.0, 0.03, 0.12, 0.35, 1.0])  # of the fast speed; dense where Stribeck friction is
FRICTION_CORRELATION = 0.8  # of a friction curve between neighbouring knots
SOIL_KNOTS = np.linspace(0.0, 1.0, 6)  # of the large slip
SLOW_COURSES = 2  # of a friction or stiffness that changes with time; see `UnknownForces.constant_errors`


def _entries(
    space: StateSpace,
    data: Measurements,
    trajectory: Trajectory,
    X: np.ndarray,
    speeds: Mapping[int, float],
    slips: Mapping[tuple[str, int], float],
) -> list[_Entry]:
    """Return the groups of one log."""
    model = space.model
    machine, rate = model.machine, float(model.machine.sampling_hz)
    t = np.arange(len(trajectory.state)) / rate
    duration = float(t[-1])
    slow = np.cos(np.pi * np.arange(1, max(2, int(2 * t[-1] / SLOWEST_PERIOD_S)) + 1) * (t[:, None] / t[-1]))
    q, nu, _ = space.unpack(trajectory.state)
    u = space.delivered_torques(data.torque, X)[0] + trajectory.sampled_torque_error
    names = feature_names(model)
    features = space.features(trajectory.state)[0][:, :, 0]
    found = list[_Entry]()

    def add(
        name: str, unit: str, typical: float, shapes: np.ndarray | Form, at: int, count: int, period: float = 0.0
    ) -> None:
        found.append(_Entry(name, unit, typical, period == 0, ((at, shapes),), count, False, period))

    mix = np.linalg.cholesky(FRICTION_CORRELATION ** np.abs(np.subtract.outer(*[np.arange(len(FRICTION_KNOTS))] * 2)))
    for k, body in enumerate(machine.actuated):
        large = float(np.quantile(np.abs(u[:, k]), 0.99))
        where, unit = body.where, "N m" if body.joint == "revolute" else "N"
        smoothing = float(body.friction.smoothing) if body.friction is not None else 1e-3 * speeds[body.index]
        own, fast = names.index(("rate", body.index)), speeds[body.index]
        knots = FRICTION_KNOTS * fast
        curves = partial(friction_curves, rate=own, knots=knots, smoothing=smoothing, mix=mix)
        lacking = 0.02 * large
        usual = lacking if body.friction is None else max(lacking, 0.3 * float(body.friction.Fs))
        add(f"{where}: torque with speed", unit, usual, curves, k, 2 * len(FRICTION_KNOTS))
        half = slow[:, : slow.shape[1] // 2]
        add(f"{where}: torque, slow", unit, 0.005 * large, half, k, half.shape[1], 2 * duration / half.shape[1])
        gentle = smooth_part(u[:, k])
        w, course = features[:, own, None], slow[:, :SLOW_COURSES]
        warming = np.hstack([w / fast * course, np.tanh(w / smoothing) * course])
        add(f"{where}: friction, slow", unit, lacking, warming, k, warming.shape[1], 2 * duration / SLOW_COURSES)
        rise = np.gradient(gentle) * rate
        add(f"{where}: torque late", "s", 0.01, -rise[:, None], k, 1)
        if body.contact is not None:
            turned = q[:, model.coordinates.index(machine.coordinate(body))]
            harmonics = np.column_stack([f(h * turned) for h in (1, 2) for f in (np.sin, np.cos)])
            add(f"{where}: torque with angle", unit, 0.005 * large, harmonics, k, 4)
    for body in machine.contacts:
        found += _contact_entries(space, body, features, slips, slow, rate)
    found += _slope_entries(space, q, nu, rate)
    for j, sensor in enumerate(space.sensors):
        if sensor.kind == "wheel":
            turn = np.column_stack([np.sin(data.reading[:, j]), np.cos(data.reading[:, j]) - 1])
            found.append(_Entry(f"{sensor.name}: once a turn", "rad", 1e-3, True, ((j, turn),), 2, True))
    return found


def _contact_entries(
    space: StateSpace,
    body: Body,
    features: np.ndarray,
    slips: Mapping[tuple[str, int], float],
    slow: np.ndarray,
    rate: float,
) -> list[_Entry]:
    """Return the groups of one contact in one log."""
    model, k, where = space.model, body.index, body.where
    assert body.contact is not None
    first = space.n_inputs - len(space.forces)
    place = {kind: first + i for i, (owner, kind) in enumerate(space.forces) if owner == k}
    feature = {kind: feature_names(model).index((kind, k)) for kind in ("gx", "gy", "turn")}
    rates = dict(zip(feature_names(model), features.T, strict=True))
    rim = float(body.contact.radius) * rates.get(("rate", k), np.zeros(len(features)))
    speed = np.hypot(rim, SLOW_SPEED)
    # Not the estimate: shapes that grow with it would let both grow without end.
    standard = dict(zip(model.base.standard, model.expand @ model.nominal, strict=True))
    Kx, Ky = abs(standard[f"Kx{k}"]), abs(standard[f"Ky{k}"])
    largest = float(np.hypot(slips["gx", k], slips["gy", k]))
    found, duration = list[_Entry](), (len(slow) - 1) / rate

    def add(
        name: str, unit: str, typical: float, shapes: Mapping[str, np.ndarray | Form], count: int, period: float = 0.0
    ) -> None:
        every = tuple((place[kind], own) for kind, own in shapes.items())
        found.append(_Entry(f"{where}: {name}", unit, typical, period == 0, every, count, False, period))

    # The lengthwise stiffness makes the turning moment as well: forces, by what they are proportional to.
    laws = {"lengthwise": {"lengthwise": ("gx", -Kx)}, "lateral": {"lateral": ("gy", -Ky)}}
    if "turning" in place:
        assert body.contact.width is not None
        laws["lengthwise"]["turning"] = ("turn", -Kx * float(body.contact.width) / 6)
    for stiffness, law in laws.items():
        if stiffness not in place:
            continue
        changing = {kind: f * features[:, [feature[x]]] * slow[:, :SLOW_COURSES] for kind, (x, f) in law.items()}
        add(f"{stiffness} stiffness, slow", "-", 0.05, changing, SLOW_COURSES, 2 * duration / SLOW_COURSES)
        add(f"{stiffness} force, slow", "N", 50.0, {stiffness: slow}, slow.shape[1], 2 * duration / slow.shape[1])
        for kind, (x, factor) in law.items():
            across = {"gx": "gy", "gy": "gx"}.get(x, x)
            end = np.sqrt(2) * max(slips["turn", k], 1e-6) if x == "turn" else largest
            curves = partial(
                soil_curves, along=feature[x], across=feature[across], stiffness=-factor, knots=SOIL_KNOTS * end
            )
            changed, force = (f"{kind} stiffness", f"{kind} force") if x != "turn" else ("turning moment",) * 2
            add(f"{changed} with slip", "-", 0.1, {kind: curves}, len(SOIL_KNOTS) - 1)
            relaxing = -factor * np.gradient(smooth_part(features[:, feature[x]])) * rate / speed
            add(f"{force} late", "m", 0.02, {kind: relaxing[:, None]}, 1)
    if ("rate", k) in feature_names(model):
        at = feature_names(model).index(("rate", k))
        if "lengthwise" in place:
            driven = partial(braking, gx=feature["gx"], rate=at, stiffness=Kx)
            add("stiffness in braking", "-", 0.05, {"lengthwise": driven}, 1)
        if "resistance" in place:
            add("resistance", "N", 150.0, {"resistance": partial(resistance, rate=at)}, 1)
    return found


def _slope_entries(space: StateSpace, q: np.ndarray, nu: np.ndarray, rate: float) -> list[_Entry]:
    """Return the slope of the ground in one log, whose heading at the start is unknown."""
    first = space.n_inputs - len(space.forces)
    at = {kind: first + i for i, (_, kind) in enumerate(space.forces) if kind in SLOPES}
    if not at:
        return []
    turn = space.model.heading
    if len(at) == 1 or turn is None:
        return [_Entry("slope", "m/s2", 0.02, False, tuple((k, np.ones((len(nu), 1))) for k in at.values()), 1)]
    heading = integrate_pose(space.model, q, nu, 1 / rate)[:, turn]
    c, s = np.cos(heading), np.sin(heading)
    shapes = ((at[SLOPES[0]], np.column_stack([c, s])), (at[SLOPES[1]], np.column_stack([-s, c])))
    return [_Entry("slope", "m/s2", 0.02, False, shapes, 2)]


@dataclass(frozen=True)
class UnknownForces:
    """What the model lacks along several logs, with the size of each group.

    lacking: of each log; their shapes are per unit of the typical size. size (n_groups,): standard deviation of the
    coefficients of each group, over its typical size. constant_errors (n_base,): typical size [SI] of what acts as
    another value of a parameter all the time, which no log can tell from the parameter.
    """

    lacking: tuple[Lacking, ...]
    groups: tuple[Group, ...] = ()
    size: np.ndarray = field(default_factory=lambda: np.zeros(0))
    constant_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def count(self) -> int:
        """Number of coefficients of all logs."""
        return sum(len(g.every) for g in self.groups)

    @property
    def index(self) -> list[np.ndarray]:
        """Of each log, the places of its coefficients among those of all logs."""
        none = np.zeros(0, int)
        return [np.concatenate([none, *(g.index[k] for g in self.groups)]) for k in range(len(self.lacking))]

    @property
    def precision(self) -> np.ndarray:
        """Prior information (count,) about the coefficients."""
        found = np.zeros(self.count)
        for group, size in zip(self.groups, self.size, strict=True):
            found[group.every] = max(size, LEAST_SIZE) ** -2
        return found

    def coefficients(self, trajectories: Sequence[Trajectory]) -> np.ndarray:
        """Return the coefficients (count,) that trajectories have."""
        found = np.zeros(self.count)
        for trajectory, index in zip(trajectories, self.index, strict=True):
            found[index] = trajectory.lacking
        return found


LEAST_SIZE = 1e-4  # of a group, over its typical size: as good as none


def no_unknown_forces(space: StateSpace, logs: int) -> UnknownForces:
    """Return that nothing is lacking along some logs."""
    return UnknownForces((Lacking((), (), 0, np.zeros(len(space.forces))),) * logs)


@dataclass(frozen=True)
class Missing:
    """One thing that a model lacks: rms along the logs [unit], by its place and what it follows.

    rms: of white forces their standard deviation. scale: period [s] of the fastest course, 0 for what follows no time.
    """

    place: str
    follows: str
    rms: float
    unit: str
    scale: float = 0.0

    @property
    def name(self) -> str:
        """Place and what it follows."""
        return f"{self.place}: {self.follows}" if self.follows else self.place


def describe_missing(
    space: StateSpace, unknown: UnknownForces, trajectories: Sequence[Trajectory]
) -> tuple[Missing, ...]:
    """Return what a fit lacks, beyond LEAST_TOLD of the largest in its unit, by unit and size; then white forces."""
    units = _input_units(space)
    square, samples = dict[tuple[str, str], float](), 0
    for trajectory, lacking, index in zip(trajectories, unknown.lacking, unknown.index, strict=True):
        features = space.features(trajectory.state)[0][:, :, 0]
        samples += len(features)
        for group in unknown.groups:
            columns = np.flatnonzero(np.isin(index, group.every))
            for terms, of_inputs in ((lacking.inputs, True), (lacking.readings, False)):
                for term in terms:
                    if not np.isin(term.columns, columns).all():
                        continue
                    unit = units[term.at] if of_inputs else "rad"
                    course = term.values(features) @ trajectory.lacking[term.columns]
                    square[group.name, unit] = square.get((group.name, unit), 0.0) + float(course @ course)
    found, periods = list[Missing](), {group.name: group.period for group in unknown.groups}
    for (name, unit), x in square.items():
        place, _, follows = name.partition(": ")
        found.append(Missing(place, follows, float(np.sqrt(x / samples)), unit, periods[name]))
    largest = {m.unit: max(x.rms for x in found if x.unit == m.unit) for m in found}
    found = sorted((m for m in found if m.rms > LEAST_TOLD * largest[m.unit]), key=lambda m: (m.unit, -m.rms))
    bodies = {b.index: b.where for b in space.model.machine.body}
    first, sample = space.n_inputs - len(space.forces), 1 / float(space.model.machine.sampling_hz)
    for k, std in enumerate(unknown.lacking[0].force_std):
        if std > 0:
            body, kind = space.forces[k]
            text = f"{kind} force, from sample to sample"
            found.append(Missing(bodies[body], text, float(std), units[first + k], sample))
    return tuple(found)


LEAST_TOLD = 0.1  # share of the largest force in its unit, below which a missing one is not told


def _input_units(space: StateSpace) -> list[str]:
    """Return the unit of every input."""
    machine = space.model.machine
    torques = ["N m" if b.joint == "revolute" else "N" for b in machine.actuated]
    forces = ["m/s2" if kind in SLOPES else "N m" if kind == "turning" else "N" for _, kind in space.forces]
    return [*torques, *["-"] * len(space.model.map_inputs), *forces]

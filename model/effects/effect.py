"""Records that declare an effect: its places, magnitude and shapes, its hooks, and the sample that hooks see."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from excite.model import mechanics
from excite.model.machine import Body, Contact, Machine

OF_STRAIGHT_JOINTS = {
    "N m": "N",
    "N m s": "N s/m",
    "N m s2": "N s2/m2",
    "N m/s": "N/s",
    "N m/rad": "N/m",
    "rad": "m",
    "rad/s": "m/s",
    "rad/(N m)": "m/N",
}  # units of a sliding joint for those of one that turns
EDGE_TIME = 0.2  # s, duration of the start and end of a temporary effect; chosen
DEFAULT_DURATION = 60.0  # s, length of a log if none is given; chosen
Values = Mapping[str, ca.SX]  # magnitude "A" and shapes by name
Form = tuple[str, float]  # name of a shape that selects one form of an effect, and its value


@dataclass(frozen=True)
class ContactMotion:
    """Motion of a contact, a roll or a wheel.

    Vx, Vy [m/s]: velocity of its centre along and across its chassis; spin, yaw [rad/s]: rates of turn.
    extra_radius [m]: distance from axle to ground, minus the radius.
    """

    contact: Contact
    Vx: ca.SX
    Vy: ca.SX
    spin: ca.SX
    yaw: ca.SX
    extra_radius: ca.SX | float = 0.0

    @property
    def rim(self) -> ca.SX:
        """Speed of the rim at the ground [m/s]."""
        return mechanics.rim_speed(self.contact, self.spin, self.extra_radius)

    @property
    def slip(self) -> mechanics.Slip:
        """Slips at the middle of the contact."""
        return mechanics.slip(self.contact, self.Vx, self.Vy, self.spin, self.extra_radius)


@dataclass(frozen=True)
class Soil:
    """Arguments of a contact's force law: slips, yaw rate [rad/s], Kx, Ky [N], saturations (None: linear).

    ahead [m]: the force acts so far ahead of the contact's place in the machine file. turned [rad]: its axes are turned
    by so much against its chassis. added [N]: forces along and across beside the law.
    """

    slip: mechanics.Slip
    yaw: ca.SX
    Kx: ca.SX
    Ky: ca.SX
    saturation: mechanics.Saturation | None = None
    lateral: mechanics.Saturation | None = None
    ahead: ca.SX | float = 0.0
    turned: ca.SX | float = 0.0
    added: tuple[ca.SX | float, ca.SX | float] = (0.0, 0.0)

    def wrench(self, on: Contact) -> mechanics.Wrench:
        """Return forces and moment on a contact."""
        law = mechanics.wrench(on, self.slip, self.yaw, self.Kx, self.Ky, self.saturation, self.lateral)
        return replace(law, Sx=law.Sx + self.added[0], Sy=law.Sy + self.added[1])


@dataclass(frozen=True)
class SampleView:
    """One sample as an effect's hooks see it; mappings are by index of the body, or of the joint that moves it.

    q [rad], w [rad/s]: angle and rate of a joint.
    u [N m]: delivered torque, before gain, offset and delay of its sensor.
    friction [N m]: Fv w + Fs sgn w; coulomb [N m]: Fs.
    friction_smoothing [rad/s]: rate over which sgn turns; sgn: sgn of a joint's rate in its friction.
    large_torque [N m]: see `sizes.large_torque`.
    contacts: motion of each contact.
    forward_speed [m/s]: V_x of a body's origin in its own axes. yaw_rate [rad/s]: of a body.
    wheel_radius [m]: of the measuring wheel that is read, 1 for others. outwards: 1, or -1 for a wheel to the right of
        an effect that acts on several.
    time [s]: since the log began.
    z: memory states of this effect by name; zero for those of a form that it does not have.
    passes (MAX_PASSES,): shares of a contact's width passed over at least 1, 2, ... times (`GroundMap`); zero for an
        effect that uses no map.
    """

    q: Mapping[int, ca.SX]
    w: Mapping[int, ca.SX]
    u: Mapping[int, ca.SX]
    friction: Mapping[int, ca.SX]
    coulomb: Mapping[int, ca.SX]
    friction_smoothing: Mapping[int, float]
    sgn: Mapping[int, ca.SX]
    large_torque: Mapping[int, float]
    contacts: Mapping[int, ContactMotion]
    forward_speed: Mapping[int, ca.SX]
    yaw_rate: Mapping[int, ca.SX]
    time: ca.SX
    wheel_radius: float = 1.0
    outwards: float = 1.0
    z: Mapping[str, ca.SX] = field(default_factory=dict)
    passes: Mapping[int, ca.SX] = field(default_factory=dict)

    def sign(self, k: int) -> ca.SX:
        """Return sgn of a joint's rate as in its friction: smoothed, or set-valued."""
        return self.sgn[k]

    def others(self, k: int) -> list[int]:
        """Return the other driven contacts."""
        return [j for j in self.contacts if j != k and j in self.u]


@dataclass(frozen=True)
class Channel:
    """A torque sensor: u_measured(t) = gain u(t - delay) + offset."""

    gain: ca.SX | float = 1.0
    offset: ca.SX | float = 0.0
    delay: ca.SX | float = 0.0


@dataclass(frozen=True)
class Site:
    """A place for an effect: a body (the first of several) of a machine, and the length [s] of the log."""

    machine: Machine
    body: Body
    duration: float

    @classmethod
    def of(cls, machine: Machine, bodies: Sequence[int], duration: float = DEFAULT_DURATION) -> Site:
        """Return the site of an effect on these bodies."""
        return cls(machine, machine.find(bodies[0]), duration)


def unit_size(site: Site) -> float:
    """Return 1, the size of a shape given in its unit."""
    return 1.0


def no_trials(site: Site) -> list[dict[str, float]]:
    """Return no trials beyond the grids of the shapes."""
    return []


@dataclass(frozen=True)
class Shape:
    """A further unknown of an effect, such as a decay speed or a phase.

    default, grid: value for simulation and trial values for diagnosis, in units of `size` at the site.
    circular: a phase, fitted by its sine and cosine.
    whole: never refined by a fit.
    either_sign: it may be negative.
    only: the allowed values, if they are few.
    meaning: explanation, if the name needs one.
    form: the form of the effect that has this shape, None for all.
    within: range in units of `size`; a fit outside of it means that something else acts.
    """

    unit: str
    default: float
    grid: tuple[float, ...]
    size: Callable[[Site], float] = unit_size
    circular: bool = False
    whole: bool = False
    either_sign: bool = False
    only: tuple[float, ...] = ()
    meaning: str = ""
    form: Form | None = None
    within: tuple[float, float] | None = None

    @property
    def signed(self) -> bool:
        """True if it may have either sign: a phase, zero by default, or declared so."""
        return self.circular or self.default == 0 or self.either_sign


PHASE = Shape("rad", 0.0, (0.0, math.pi / 2), circular=True)


def form_choice(meaning: str, only: tuple[float, ...] = (0.0, 1.0), grid: tuple[float, ...] = (0.0,)) -> Shape:
    """Declare a shape that selects one of several forms of an effect."""
    return Shape("-", 0.0, grid, whole=True, only=only, meaning=meaning)


def between(t: ca.SX, begin: ca.SX, end: ca.SX) -> ca.SX:
    """Return 1 between two instants, 0 outside, with edges of EDGE_TIME."""
    return (ca.tanh((t - begin) / EDGE_TIME) - ca.tanh((t - end) / EDGE_TIME)) / 2


@dataclass(frozen=True)
class Memory:
    """A state that an effect adds to the model.

    rate: hook that gives its time derivative.
    initial_std: standard deviation from zero at the start of a log.
    per_body: one state for each body that the effect acts on, its name followed by the body's index.
    form: the form of the effect that has this state, None for all.
    """

    rate: Callable[[SampleView, int, Values], ca.SX]
    initial_std: float
    per_body: bool = False
    form: Form | None = None


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    places: joints (with friction), drives (driven joints), contacts, driven_contacts, drive (all driven contacts
        together, or all contacts for an effect on the soil), contact_group (all contacts), articulation (driven joints
        without contact), free_drives (those of a machine that touches no ground), links (its joints away from the one
        before), wheels (measuring ones), wheel_pair (all measuring ones), yaw_rate, lateral_speed, machine. A periodic
        effect has no place at a sliding joint.
    unit, meaning, signature, source: unit of the magnitude A; formula; symptom in a log; reference.
    typical_magnitude: a typical magnitude [unit] at a site.
    grid: multiples of it to try; several if the signature is not proportional to the magnitude.
    extra_trials: sets of shapes [unit] to try in addition to their grids, with "A" if it is not the typical one.
    positive: negative magnitudes are never tried. largest: magnitude beyond which there is no such effect.
    formula_error: relative error of a formula that is known to be rough, 0 for others.
    opposes_motion: a negative fitted magnitude means that something else is the cause.
    inverse: a smaller magnitude is a larger effect.
    timed: the effect depends on time.
    angle_only: a reading error of angle sensors, not of rate sensors.
    memory: states that the effect adds.
    map_form: the form in which it uses a map of the ground.
    unsticking: the form in which it replaces the joint's dry friction by a law that never sticks; True for all.

    Hooks take the sample, the body they act on and the values A and shapes, and return what the effect adds:
    torque [N m]; extra_radius [m], which all effects see; soil; push: forces [N] along and across a contact;
    gravity [m/s2] along the ground; link [m]: what the link to the joint before is longer;
    inertia: changes of standard parameters of the payload body;
    reading: error of a sensor; channel: of a torque sensor over time.
    simpler: in the form that never sticks, the effect that it comes to where A is zero.
    recoil: the shape that gives the share of `inertia` due to a load that slides along x and pushes its body back.
    shaking: 0 to 1 over time, while the torque sensor shakes; without shaking something else acts.
    file_value: the value of the machine file that the magnitude corrects, for an effect that is an error of the file.
    """

    name: str
    places: tuple[str, ...]
    unit: str
    meaning: str
    signature: str
    source: str
    typical_magnitude: Callable[[Site], float]
    shapes: Mapping[str, Shape] = field(default_factory=dict)
    grid: tuple[float, ...] = (1.0,)
    extra_trials: Callable[[Site], list[dict[str, float]]] = no_trials
    positive: bool = False
    largest: float = math.inf
    formula_error: float = 0.0
    opposes_motion: bool = False
    inverse: bool = False
    torque: Callable[[SampleView, int, Values], ca.SX] | None = None
    extra_radius: Callable[[SampleView, int, Values], ca.SX] | None = None
    soil: Callable[[SampleView, int, Values, Soil], Soil] | None = None
    push: Callable[[SampleView, int, Values], tuple[ca.SX, ca.SX]] | None = None
    gravity: Callable[[SampleView, Values], tuple[ca.SX, ca.SX]] | None = None
    link: Callable[[Values], ca.SX] | None = None
    inertia: Callable[[SampleView, Values], dict[str, ca.SX]] | None = None
    recoil: str | None = None
    reading: Callable[[SampleView, ca.SX, int, Values], ca.SX] | None = None
    channel: Callable[[ca.SX, Values], Channel] | None = None
    shaking: Callable[[ca.SX, Values], ca.SX] | None = None
    memory: Mapping[str, Memory] = field(default_factory=dict)
    map_form: Form | None = None
    unsticking: Form | bool = False
    simpler: str | None = None
    timed: bool = False
    angle_only: bool = False
    file_value: Callable[[Body], float] | None = None

    @property
    def sensor_only(self) -> bool:
        """True if only a sensor shows it, no equation of motion."""
        felt = (
            self.torque
            or self.extra_radius
            or self.soil
            or self.push
            or self.gravity
            or self.link
            or self.inertia
            or self.channel
        )
        return not felt


@dataclass(frozen=True)
class PlacedEffect:
    """An effect at a place: the bodies it acts on, the sensors it sits in, values of "A" and shapes [unit].

    straight: it acts on a sliding joint, whose angles are positions and whose torques are forces.
    """

    effect: Effect
    where: str
    bodies: tuple[int, ...]
    sensors: tuple[str, ...]
    values: Mapping[str, float]
    straight: bool = False

    @property
    def unit(self) -> str:
        """Unit of the magnitude at its place."""
        return self._unit_here(self.effect.unit)

    def shape_unit(self, name: str) -> str:
        """Unit of a shape at its place."""
        return self._unit_here(self.effect.shapes[name].unit)

    def _unit_here(self, unit: str) -> str:
        return OF_STRAIGHT_JOINTS.get(unit, unit) if self.straight else unit

    def file_value(self, machine: Machine) -> float | None:
        """Return the value of the machine file that the magnitude corrects, None if there is not one alone."""
        known = self.effect.file_value
        return known(machine.find(self.bodies[0])) if known is not None and len(self.bodies) == 1 else None

    @property
    def name(self) -> str:
        """Name with place: effect@where."""
        return f"{self.effect.name}@{self.where}"

    @property
    def parameters(self) -> dict[str, tuple[str, str]]:
        """Key of the value and unit, by name of the model's parameter: magnitude first, then shapes."""
        named = {self.name: ("A", self.unit)}
        return named | {f"{self.name}.{s}": (s, self.shape_unit(s)) for s in self.shapes}

    @property
    def shapes(self) -> dict[str, Shape]:
        """Shapes of the effect in its form here."""
        return {name: shape for name, shape in self.effect.shapes.items() if self._in_form(shape.form)}

    def _in_form(self, form: Form | None) -> bool:
        return form is None or self.values[form[0]] == form[1]

    @property
    def memory(self) -> dict[str, tuple[int, Memory]]:
        """Memory states in its form here, by name, each with its body."""
        return {name: (k, own) for name, (k, own) in self.memories.items() if self._in_form(own.form)}

    @property
    def memories(self) -> dict[str, tuple[int, Memory]]:
        """Memory states of all forms, by name, each with its body."""
        found: dict[str, tuple[int, Memory]] = {}
        for name, own in self.effect.memory.items():
            found |= {f"{name}{k}": (k, own) for k in self.bodies} if own.per_body else {name: (self.bodies[0], own)}
        return found

    def extra_trials(self, site: Site) -> list[dict[str, float]]:
        """Return the extra trials of its form here."""
        whole = {n: x for n, x in self.values.items() if n != "A" and self.effect.shapes[n].whole}
        return [b for b in self.effect.extra_trials(site) if all(whole.get(n, x) == x for n, x in b.items())]

    @property
    def uses_map(self) -> bool:
        """True if its form here uses a map of the ground."""
        return self.effect.map_form is not None and self._in_form(self.effect.map_form)

    @property
    def unsticking(self) -> bool:
        """True if its form here replaces the joint's dry friction by a law that never sticks."""
        form = self.effect.unsticking
        return form if isinstance(form, bool) else self._in_form(form)

    @property
    def simpler(self) -> str | None:
        """Name, with its place, of the effect that this one comes to at zero; None if there is none."""
        return f"{self.effect.simpler}@{self.where}" if self.effect.simpler and self.unsticking else None

    def shaking(self, t: np.ndarray) -> np.ndarray:
        """Return how much the effect shakes a torque sensor (N,), 0 to 1, at times t (N,) [s]."""
        hook = self.effect.shaking
        assert hook is not None
        (felt,) = self._evaluate(t, lambda time, values: [hook(time, values)])
        return felt

    def channel(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return gain, offset and delay [s], (N,) each, of a torque sensor with the effect at times t (N,) [s]."""
        hook = self.effect.channel
        assert hook is not None

        def expressions(time: ca.SX, values: Values) -> list[ca.SX]:
            own = hook(time, values)
            return [ca.SX(x) for x in (own.gain, own.offset, own.delay)]

        gain, offset, delay = self._evaluate(t, expressions)
        return gain, offset, delay

    def _evaluate(self, t: np.ndarray, hook: Callable[[ca.SX, Values], list[ca.SX]]) -> list[np.ndarray]:
        """Evaluate a hook's expressions, each (N,), at times t (N,) [s]."""
        time = ca.SX.sym("t")
        results = hook(time, {k: ca.SX(v) for k, v in self.values.items()})
        read = ca.Function("over", [time], results)
        at = t[None] if ca.depends_on(ca.vertcat(*results), time) else 0.0
        return [np.broadcast_to(x.full()[0], t.shape) for x in read.call([ca.DM(at)])]

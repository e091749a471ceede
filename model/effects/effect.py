"""What an effect is: what it sees of a sample, where it can sit, what its amount and shapes mean, what it does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from excite.model import mechanics
from excite.model.machine import Body, Contact, Machine

DEFAULT_DURATION = 60.0  # [s] of a log, where nobody says
Values = Mapping[str, ca.SX]  # the amount "A" and the shapes by name
Form = tuple[str, float]  # a shape that an effect's way of acting is chosen by, and its value


@dataclass(frozen=True)
class ContactMotion:
    """How a contact, a roll or a wheel, moves: its centre's velocity along and across its chassis [m/s], spin and yaw
    rate [rad/s]; further: by how much the ground is further from its axle than its radius [m]."""

    contact: Contact
    Vx: ca.SX
    Vy: ca.SX
    spin: ca.SX
    yaw: ca.SX
    further: ca.SX | float = 0.0

    @property
    def rim(self) -> ca.SX:
        """Speed of the rim at the ground [m/s]."""
        return mechanics.rim_speed(self.contact, self.spin, self.further)

    @property
    def slip(self) -> mechanics.Slip:
        return mechanics.slip(self.contact, self.Vx, self.Vy, self.spin, self.further)


@dataclass(frozen=True)
class Soil:
    """What a contact's wrench is made from: slips, yaw rate, stiffnesses Kx, Ky [N], saturations (None: linear)."""

    slip: mechanics.Slip
    yaw: ca.SX
    Kx: ca.SX
    Ky: ca.SX
    saturation: mechanics.Saturation | None = None
    lateral: mechanics.Saturation | None = None

    def wrench(self, on: Contact) -> mechanics.Wrench:
        """What it does to a contact."""
        return mechanics.wrench(on, self.slip, self.yaw, self.Kx, self.Ky, self.saturation, self.lateral)


@dataclass(frozen=True)
class SampleView:
    """One sample as an effect sees it.

    q, w: angle and rate of a joint [rad, rad/s] by body; u: torque that its sensor feels, flaws aside [N m]; friction:
    Fv w + Fs sgn w [N m]; coulomb: Fs [N m]; smooth: the rate over which sgn turns [rad/s]; full: what counts as a
    large torque [N m]; rolling: of contacts; ahead: V_x of each body's origin in its own axes [m/s]; time [s] since the
    log began; z: what this effect remembers, by name; zero what it does in another form only; over: the shares of each
    contact's width that were passed over before, at least once, twice and so on, as a map of the ground has them
    (`lane.Ground`); zero for an effect that doesn't look at it.
    """

    q: Mapping[int, ca.SX]
    w: Mapping[int, ca.SX]
    u: Mapping[int, ca.SX]
    friction: Mapping[int, ca.SX]
    coulomb: Mapping[int, ca.SX]
    smooth: Mapping[int, float]
    full: Mapping[int, float]
    rolling: Mapping[int, ContactMotion]
    ahead: Mapping[int, ca.SX]
    time: ca.SX
    z: Mapping[str, ca.SX] = field(default_factory=dict)
    over: Mapping[int, ca.SX] = field(default_factory=dict)

    def sign(self, k: int) -> ca.SX:
        """sgn of a joint's rate, smoothed as its friction is."""
        return ca.tanh(self.w[k] / self.smooth[k])

    def others(self, k: int) -> list[int]:
        """The other driven contacts."""
        return [j for j in self.rolling if j != k and j in self.u]


@dataclass(frozen=True)
class Channel:
    """A torque sensor: u_measured(t) = gain u(t - delay) + offset."""

    gain: ca.SX | float = 1.0
    offset: ca.SX | float = 0.0
    delay: ca.SX | float = 0.0


@dataclass(frozen=True)
class Site:
    """Where an effect is looked for: a body (the joint or the first of several), the log's length [s]."""

    machine: Machine
    body: Body
    duration: float

    @classmethod
    def of(cls, machine: Machine, bodies: Sequence[int], duration: float = DEFAULT_DURATION) -> Site:
        """Where an effect acts on these bodies."""
        return cls(machine, machine.find(bodies[0]), duration)


def unit_size(site: Site) -> float:
    return 1.0


def no_trials(site: Site) -> list[dict[str, float]]:
    return []


@dataclass(frozen=True)
class Shape:
    """What an effect's amount leaves open: default and grid in units of `size`, which belongs to the site.

    `circular`: a phase, found by its sine and cosine; `whole`: not refined; `only`: the values that there are, if these
    are few; `meaning`: what a name leaves open; `form`: the shape and its value with which alone it means anything;
    `within`: what it can be, in units of `size`: where a fit finds less or more, something else acts.
    What is zero by default may have either sign.
    """

    unit: str
    default: float
    grid: tuple[float, ...]
    size: Callable[[Site], float] = unit_size
    circular: bool = False
    whole: bool = False
    only: tuple[float, ...] = ()
    meaning: str = ""
    form: Form | None = None
    within: tuple[float, float] | None = None

    @property
    def signed(self) -> bool:
        return self.circular or self.default == 0


@dataclass(frozen=True)
class Memory:
    """A state of its own that an effect has: its rate of change, and how far it may be from zero when a log begins.
    each: one for each body that the effect acts on, named by the name and the body's index; form: the shape and its
    value with which alone there is one, or None."""

    rate: Callable[[SampleView, int, Values], ca.SX]
    spread: float
    each: bool = False
    form: Form | None = None


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    `places`: joints (with friction), drives (driven joints), contacts, driven_contacts, drive (all of these together,
    of soil all contacts), articulation (driven joints without contact), wheels (measuring ones), yaw_rate,
    lateral_speed, machine. `amount`: a typical one [unit] at a site, `grid`: shares of it, of either sign, that are
    tried where the signature isn't proportional to the amount; `beside`: shapes [unit] that are tried beside their
    grids, and an amount "A" where it isn't the typical one. `positive`: a negative amount is never tried; `resisting`:
    where a fit finds one, something else is the cause; `inverse`: the smaller the amount, the larger the effect;
    `angular`: a reading's error that only a sensor of an angle has, none of a rate. `recoil`: the shape that says which
    share of a changing `inertia`, of MX and ZZ, comes of a load that slides along x on its body and pushes it back.
    `shaking`: while it acts, 0 to 1 over time [s], the torque sensor shakes as well; where it doesn't, something else
    acts. `ground`: the shape and its value with which alone it sees a map of the ground.
    Hooks take the scene, the body they act on, and the values; `further` [m] changes the contacts of the scene that all
    effects see.
    """

    name: str
    places: tuple[str, ...]
    unit: str
    meaning: str
    signature: str
    source: str
    amount: Callable[[Site], float]
    shapes: Mapping[str, Shape] = field(default_factory=dict)
    grid: tuple[float, ...] = (1.0,)
    beside: Callable[[Site], list[dict[str, float]]] = no_trials
    positive: bool = False
    resisting: bool = False
    inverse: bool = False
    torque: Callable[[SampleView, int, Values], ca.SX] | None = None
    further: Callable[[SampleView, int, Values], ca.SX] | None = None
    soil: Callable[[SampleView, int, Values, Soil], Soil] | None = None
    push: Callable[[SampleView, int, Values], tuple[ca.SX, ca.SX]] | None = None
    gravity: Callable[[SampleView, Values], tuple[ca.SX, ca.SX]] | None = None
    inertia: Callable[[SampleView, Values], dict[str, ca.SX]] | None = None
    recoil: str | None = None
    reading: Callable[[SampleView, ca.SX, int, Values], ca.SX] | None = None
    channel: Callable[[ca.SX, Values], Channel] | None = None
    shaking: Callable[[ca.SX, Values], ca.SX] | None = None
    memory: Mapping[str, Memory] = field(default_factory=dict)
    ground: Form | None = None
    timed: bool = False
    angular: bool = False

    @property
    def sensed(self) -> bool:
        """Whether it sits in a sensor only, so that no equation of motion shows it."""
        felt = self.torque or self.further or self.soil or self.push or self.gravity or self.inertia or self.channel
        return not felt


@dataclass(frozen=True)
class PlacedEffect:
    """An effect at a place: `bodies` it acts on, the sensor it sits in, values of amount and shapes."""

    effect: Effect
    where: str
    bodies: tuple[int, ...]
    sensor: str | None
    values: Mapping[str, float]

    @property
    def name(self) -> str:
        return f"{self.effect.name}@{self.where}"

    @property
    def parameters(self) -> dict[str, tuple[str, str]]:
        """Names as parameters of the model -> (value's key, unit): the amount first, then the shapes."""
        named = {self.name: ("A", self.effect.unit)}
        return named | {f"{self.name}.{s}": (s, shape.unit) for s, shape in self.shapes.items()}

    @property
    def shapes(self) -> dict[str, Shape]:
        """Those shapes of the effect that mean something in the form that it has here."""
        return {name: shape for name, shape in self.effect.shapes.items() if self._has(shape.form)}

    def _has(self, form: Form | None) -> bool:
        return form is None or self.values[form[0]] == form[1]

    @property
    def memory(self) -> dict[str, tuple[int, Memory]]:
        """What it remembers in the form that it has here, by name, each with the body that it is remembered of."""
        return {name: (k, own) for name, (k, own) in self.memories.items() if self._has(own.form)}

    @property
    def memories(self) -> dict[str, tuple[int, Memory]]:
        """The same of all forms."""
        found: dict[str, tuple[int, Memory]] = {}
        for name, own in self.effect.memory.items():
            found |= {f"{name}{k}": (k, own) for k in self.bodies} if own.each else {name: (self.bodies[0], own)}
        return found

    def beside(self, site: Site) -> list[dict[str, float]]:
        """Of what is tried beside the effect's grid, that of the form that it has here."""
        whole = {n: x for n, x in self.values.items() if n != "A" and self.effect.shapes[n].whole}
        return [b for b in self.effect.beside(site) if all(whole.get(n, x) == x for n, x in b.items())]

    @property
    def mapped(self) -> bool:
        """Whether it sees a map of the ground in the form that it has here."""
        return self.effect.ground is not None and self._has(self.effect.ground)

    def shaking(self, t: np.ndarray) -> np.ndarray:
        """How much the effect shakes a torque sensor, 0 to 1, at times t (N,) [s]."""
        hook = self.effect.shaking
        assert hook is not None
        (felt,) = self._over(t, lambda time, values: [hook(time, values)])
        return felt

    def channel(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gain, offset and delay (N,) that the effect gives a torque sensor at times t (N,) [s]."""
        hook = self.effect.channel
        assert hook is not None

        def told(time: ca.SX, values: Values) -> list[ca.SX]:
            own = hook(time, values)
            return [ca.SX(x) for x in (own.gain, own.offset, own.delay)]

        gain, offset, delay = self._over(t, told)
        return gain, offset, delay

    def _over(self, t: np.ndarray, hook: Callable[[ca.SX, Values], list[ca.SX]]) -> list[np.ndarray]:
        """What a hook gives, each (N,), at times t (N,) [s]."""
        time = ca.SX.sym("t")
        told = hook(time, {k: ca.SX(v) for k, v in self.values.items()})
        read = ca.Function("over", [time], told)
        at = t[None] if ca.depends_on(ca.vertcat(*told), time) else 0.0
        return [np.broadcast_to(x.full()[0], t.shape) for x in read.call([ca.DM(at)])]

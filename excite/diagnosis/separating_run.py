"""Which ordinary run would separate causes that a log can't tell apart.

Not a table of pairs: each effect is asked what it does. Along the log as it was driven, and as it would be in the other
direction, at rest, towed, faster, straight ahead, with quicker torques or later, its hooks say what it adds. Where two
causes answer differently to such a change, and the log doesn't hold it yet, the run that makes it is the one to drive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from excite.diagnosis.diagnosis import Diagnosis
from excite.diagnosis.fits import ExtendedFit
from excite.diagnosis.score_test import integrate_memory
from excite.logs import passes
from excite.model import SignatureFunctions, effects, signatures
from excite.model.effects import PlacedEffect, Site
from excite.model.machine import EffectEntry, Machine
from excite.smoothing import smoothed_motion

MIN_RESPONSE_DIFFERENCE = 0.4  # relative difference of two answers from which they are told apart
MAX_SIGNATURE_DIFFERENCE = 1e-6  # share of two signatures that isn't in common, below which no drive tells them apart
MAX_SAMPLES = 3000  # of the log that effects are asked along, at most
STANDSTILL_SPEED = 0.05  # [m/s, rad/s] below which a machine or joint stands
LOADED_TORQUE_SHARE = 0.05  # of the largest torque, from which a torque counts
MIN_SPEED_RATIO = 2.0  # fast over slow stretches' speed, from which a log has both
TURNED_AROUND_RAD = 2.5  # [rad] of heading from which a log has been driven both ways along the lane
MIN_TURN = 0.05  # [rad] of a steered joint, or without one [rad/s] of yaw, from which a log turns


@dataclass(frozen=True)
class SampledMotion:
    """A motion as effects see it: coordinates, velocities, accelerations (N, n_q), torques (N, n_u), time (N,)."""

    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    u: np.ndarray
    t: np.ndarray


@dataclass(frozen=True)
class DriveChange:
    """A change of the drive: what to do, on a machine that drives and on one that stands on a bench; what becomes of a
    motion; whether a motion holds it already. In `text` {against} stands for the machine's driven contacts at work
    against each other, or against a wall."""

    text: str
    bench: str | None
    change: Callable[[Machine, SampledMotion], SampledMotion]
    held: Callable[[Machine, SampledMotion], bool]


def recommend_run(d: Diagnosis) -> str | None:
    """The simplest run that separates what is tied, in words; None where nothing is, or where it is not a matter of
    the drive, as no drive tells which of two wheels of one side resists."""
    said: list[str] = []
    for f in d.findings:
        if f.tied_with:
            text = _describe_separation(d.after, [f.name, *f.tied_with])
            if text is not None and text not in said:
                said.append(text)
    return "; then ".join(said) or None


@dataclass(frozen=True)
class RivalPair:
    """Two causes that are tied, as the logs have them, and the machine with what else was found."""

    machine: Machine
    between: tuple[EffectEntry, EffectEntry]


def rival_pairs(d: Diagnosis) -> list[RivalPair]:
    """The pairs of tied causes that do not the same whatever is driven, the likeliest first."""
    found: list[RivalPair] = []
    for f in d.findings:
        if not f.rivals:
            continue
        tied = [_placed_effect(d.after, name) for name in (f.name, *f.tied_with)]
        pairs = [(0, k) for k in range(1, len(tied))]
        apart = set(pairs) - _equivalent_pairs(
            _EffectResponses(d.after, tied)(_perturb(_longest_motion(d.after))), pairs
        )
        machine = effects.with_effects(d.before.machine, *(x.entry for x in d.findings if x is not f))
        found += [RivalPair(machine, (f.entry, f.rivals[k - 1])) for _, k in sorted(apart)]
    return found


def _describe_separation(stage: ExtendedFit, names: Sequence[str]) -> str | None:
    machine = stage.machine
    tied = [_placed_effect(stage, name) for name in names]
    motion = _longest_motion(stage)
    asked = _EffectResponses(stage, tied)
    here = asked(motion)
    pairs = list(combinations(range(len(tied)), 2))
    open_ = {p for p in pairs if tied[p[0]].effect is not tied[p[1]].effect or tied[p[0]].where != tied[p[1]].where}
    chosen: list[DriveChange] = []
    # Each run takes the pairs that it separates; the one that separates most comes first, the simplest of equals.
    options = [
        (r, _separated_pairs(here, asked(r.change(machine, motion)), pairs))
        for r in DRIVE_CHANGES
        if _is_possible(r, machine)
    ]
    fresh = [(r, s) for r, s in options if not r.held(machine, motion)]
    for group in (fresh, options):
        while open_:
            r, split = max(group, key=lambda x: len(x[1] & open_), default=(None, set()))
            if r is None or not split & open_:
                break
            chosen.append(r)
            open_ -= split
    texts = [_describe_change(r, machine) for r in dict.fromkeys(chosen)]
    # A machine that its file holds on a line turns where it is let go.
    held = set(machine.body[0].coordinates) & set(machine.locked)
    same = set() if held else _equivalent_pairs(asked(_perturb(motion)), pairs)
    rest = [(tied[i], tied[j]) for i, j in sorted(open_ - same)]
    for a, b in rest:
        more = _separate_by_place(machine, a, b)
        if more is not None and more not in texts:
            texts.append(more)
    return ", and ".join(texts) if texts else None


def _describe_change(r: DriveChange, machine: Machine) -> str:
    """What to do, with the machine's own names."""
    if not machine.planar:
        return r.bench or r.text
    driven = [_spaced(b.where) for b in machine.actuated if b.contact is not None]
    each = f"{driven[0]} against {driven[1]}" if len(driven) == 2 else f"{', '.join(driven)} against each other"
    wall = "against a wall"
    return r.text.format(against=f"{each}, or {wall}" if len(driven) > 1 else wall)


def _spaced(where: str) -> str:
    return where.replace("_", " ")


def _placed_effect(stage: ExtendedFit, name: str) -> PlacedEffect:
    """A tied effect with the amount and shapes that it was found with, or the catalogue's."""
    known = next((e for e in stage.model.effects if e.name == name), None)
    if known is not None:
        return known
    name, _, where = name.partition("@")
    effect = effects.CATALOGUE[name]
    bodies, sensor = effects.allowed_places(stage.machine, effect)[where]
    log = stage.data.logs[0]
    site = Site.of(stage.machine, bodies, float(log.t[-1] - log.t[0]))
    shapes = {n: s.default * s.size(site) for n, s in effect.shapes.items()}
    return PlacedEffect(effect, where, bodies, sensor, {"A": effect.typical_magnitude(site), **shapes})


def _longest_motion(stage: ExtendedFit) -> SampledMotion:
    """The longest log's smoothed motion, from its start, thinned to SAMPLES."""
    c, fit = stage.data.space, stage.fit
    k = int(np.argmax([len(log) for log in stage.data.logs]))
    p, r = fit.trajectories[k], stage.data.measurements[k]
    q, nu, _, u, a = smoothed_motion(c, r, p, fit.X)
    root = stage.machine.body[0].coordinates
    if stage.machine.planar and root[2] in stage.model.coordinates:
        heading = stage.model.coordinates.index(root[2])
        q[:, heading] = np.cumsum(nu[:, heading]) / float(stage.machine.sampling_hz)
    t = np.arange(len(u)) / float(stage.machine.sampling_hz)
    step = max(1, len(u) // MAX_SAMPLES)
    return SampledMotion(*(x[::step] for x in (q, nu, a, u, t)))


class _EffectResponses:
    """What effects add along a motion: (C, K), forces and readings each in units of their size."""

    def __init__(self, stage: ExtendedFit, placed: Sequence[PlacedEffect]) -> None:
        model = stage.model
        standard = tuple(n for n in model.base.standard if "@" not in n)
        self.model, self.machine, self.placed = model, stage.machine, placed
        self.made: SignatureFunctions = signatures(stage.machine, standard, placed)
        self.p = (model.expand @ stage.fit.X)[: len(standard)]
        self.rows = {b.index: k for b, k in zip(stage.machine.actuated, model.actuated, strict=True)}
        self.readings = self.made.reading.size1_out(0)

    def __call__(self, m: SampledMotion) -> np.ndarray:
        N, C = len(m.t), len(self.placed)
        over = passes(self.model, m.q, m.nu, float(m.t[1] - m.t[0])) if self.made.n_map_inputs else np.zeros((N, 0))
        z = integrate_memory(self.made, m.q, m.nu, m.u, m.t, self.p, over)
        exact = np.broadcast_to(np.abs(m.t)[:, None], (N, self.readings)) * 0.1
        exact = exact * np.sign(m.nu.sum() or 1.0)
        given = [x.T for x in (m.q, m.nu, m.a, m.u, m.t[:, None], z, exact)]
        p = np.repeat(self.p[:, None], N, axis=1)
        force = self.made.force.map(N)(*given, p).full().reshape(-1, N, C).copy()
        reading = self.made.reading.map(N)(*given, p).full().reshape(self.readings, N, C)
        for k, e in enumerate(self.placed):
            if e.effect.channel is not None:
                force[:, :, k] += self._misread(e, m)
        return np.concatenate([force, reading]).transpose(2, 0, 1).reshape(C, -1)

    def _misread(self, e: PlacedEffect, m: SampledMotion) -> np.ndarray:
        """What a torque channel reads beside the torque (n_q, N)."""
        gain, offset, delay = e.channel(m.t)
        added = np.zeros((m.q.shape[1], len(m.t)))
        for k, body in enumerate(self.machine.actuated):
            if body.index in e.bodies:
                rate = np.gradient(m.u[:, k], m.t)
                added[self.rows[body.index]] = (gain - 1) * m.u[:, k] + offset - delay * rate
        return added


def _separated_pairs(here: np.ndarray, there: np.ndarray, pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
    """Pairs of effects whose signatures answer differently to a change: by their sign and size along the motion."""
    size = np.maximum((here**2).sum(axis=1), 1e-300)
    answer = (there * here).sum(axis=1) / size
    return {
        (i, j)
        for i, j in pairs
        if abs(answer[i] - answer[j]) > MIN_RESPONSE_DIFFERENCE * max(1.0, min(abs(answer[i]), abs(answer[j])))
    }


def _perturb(m: SampledMotion) -> SampledMotion:
    """A motion about this one in which everything moves, each at a frequency of its own."""

    def stir(x: np.ndarray, first: float) -> np.ndarray:
        size = np.maximum(np.abs(x).max(axis=0), 0.1)
        return x + size * np.sin(m.t[:, None] * (first + 0.37 * np.arange(x.shape[1])) + np.arange(x.shape[1]))

    return replace(m, q=stir(m.q, 0.5), nu=stir(m.nu, 0.7), u=stir(m.u, 0.9))


def _equivalent_pairs(signature: np.ndarray, pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
    """Pairs of effects that do the same along a motion (C, K), but for their size: wheels of one side resist alike."""
    unit = signature / np.maximum(np.linalg.norm(signature, axis=1, keepdims=True), 1e-300)
    return {(i, j) for i, j in pairs if abs(unit[i] @ unit[j]) > 1 - MAX_SIGNATURE_DIFFERENCE}


def _separate_by_place(machine: Machine, a: PlacedEffect, b: PlacedEffect) -> str | None:
    """What separates two causes that answer alike because they differ in place alone, or not even in that."""
    if a.where != b.where and machine.planar:
        pulling = {x.index for x in machine.actuated if x.contact is not None}
        pulls = [bool(e.effect.torque or e.effect.soil or e.effect.channel) for e in (a, b)]
        if not all(pulls) or not {*a.bodies, *b.bodies} <= pulling:
            return "tight turns to both sides"
        first, second = sorted((a, b), key=lambda e: len(e.bodies))
        other = "the others" if len(second.bodies) > 1 else f"{_spaced(second.where)} alone"
        return f"pull with {_spaced(first.where)} alone, then with {other}"
    if (a.effect.channel is None) != (b.effect.channel is None):
        return "the same drive with a known ballast on the machine"
    return None


# ------------------------------------------------------------------------------------------------ the runs


def _is_possible(r: DriveChange, machine: Machine) -> bool:
    return machine.planar or r.bench is not None


def _forward_speed(machine: Machine, m: SampledMotion) -> np.ndarray:
    """The speed that counts as forward (N,): of the root along its axis, or of the first joint."""
    return m.nu[:, 0]


def _has_torque(m: SampledMotion) -> np.ndarray:
    top = np.abs(m.u).max(axis=0, initial=1e-9)
    return (np.abs(m.u) > LOADED_TORQUE_SHARE * np.maximum(top, 1e-9)).any(axis=1)


def _heading_index(machine: Machine) -> int | None:
    root = machine.body[0].coordinates
    return machine.coordinates.index(root[2]) if machine.planar and root[2] in machine.coordinates else None


def _turn_around(machine: Machine, m: SampledMotion) -> SampledMotion:
    k = _heading_index(machine)
    q = m.q.copy()
    if k is None:
        # Held straight: turned around, the ground's fixed direction comes from the other side, as in reverse.
        return m
    q[:, k] += np.pi
    return replace(m, q=q)


def _has_turned_around(machine: Machine, m: SampledMotion) -> bool:
    k = _heading_index(machine)
    return k is not None and bool(np.ptp(m.q[:, k]) > TURNED_AROUND_RAD)


def _has_both_directions(machine: Machine, m: SampledMotion) -> bool:
    v = _forward_speed(machine, m)
    return bool((v > STANDSTILL_SPEED).mean() > 0.1 and (v < -STANDSTILL_SPEED).mean() > 0.1)


def _has_stood_with_torque(machine: Machine, m: SampledMotion) -> bool:
    still = (np.abs(m.nu) < STANDSTILL_SPEED).all(axis=1)
    return bool((still & _has_torque(m)).mean() > 0.05)


def _has_two_speeds(machine: Machine, m: SampledMotion) -> bool:
    v = np.abs(_forward_speed(machine, m))
    v = v[v > STANDSTILL_SPEED]
    return len(v) > 0 and bool(np.quantile(v, 0.9) > MIN_SPEED_RATIO * np.quantile(v, 0.3))


def _turning_coordinates(machine: Machine) -> list[int]:
    """Coordinates that are zero straight ahead: sideways, yaw and steered joints."""
    across = machine.body[0].coordinates[1:] if machine.planar else ()
    joints = [b.coordinates[0] for b in machine.actuated if b.contact is None] if machine.planar else []
    return [machine.coordinates.index(c) for c in (*across, *joints) if c in machine.coordinates]


def _straighten(machine: Machine, m: SampledMotion) -> SampledMotion:
    q, nu, a, k = m.q.copy(), m.nu.copy(), m.a.copy(), _turning_coordinates(machine)
    heading = _heading_index(machine)
    q[:, [i for i in k if i != heading]] = 0
    nu[:, k], a[:, k] = 0, 0
    return replace(m, q=q, nu=nu, a=a)


def _has_straight_and_turns(machine: Machine, m: SampledMotion) -> bool:
    joints = [machine.coordinates.index(b.coordinates[0]) for b in machine.actuated if b.contact is None]
    heading = _heading_index(machine)
    if not machine.planar or heading is None:
        return True
    turn = np.abs(m.q[:, joints] if joints else m.nu[:, heading, None]).max(axis=1)
    return bool((turn < MIN_TURN / 2).mean() > 0.2 and (turn > MIN_TURN).mean() > 0.2)


def _is_never_held(machine: Machine, m: SampledMotion) -> bool:
    return False


DRIVE_CHANGES = (
    DriveChange(
        "the same lane driven in the other direction (machine turned around)",
        None,
        _turn_around,
        _has_turned_around,
    ),
    DriveChange(
        "the same lane driven backward as well as forward",
        "the same motion in the other direction",
        lambda machine, m: replace(m, nu=-m.nu, u=-m.u),
        _has_both_directions,
    ),
    DriveChange(
        "standing still with torque: {against}",
        "standing still with torque, against a stop",
        lambda machine, m: replace(m, nu=0 * m.nu, a=0 * m.a),
        _has_stood_with_torque,
    ),
    DriveChange(
        "towed with the motors off",
        "moved by something else with the motor off",
        lambda machine, m: replace(m, u=0 * m.u),
        _is_never_held,
    ),
    DriveChange(
        "the same drive at twice or half the speed",
        "the same motion at twice or half the speed",
        lambda machine, m: replace(m, nu=2 * m.nu),
        _has_two_speeds,
    ),
    DriveChange("stretches straight ahead and tight turns", None, _straighten, _has_straight_and_turns),
    DriveChange(
        "torques that change quickly: steps, and short reversals",
        "torques that change quickly: steps, and short reversals",
        lambda machine, m: replace(m, u=np.gradient(m.u, m.t, axis=0) * 0.2 + m.u),
        _is_never_held,
    ),
    DriveChange(
        "a longer drive: the same again for as long",
        "a longer drive: the same again for as long",
        lambda machine, m: replace(m, t=m.t + m.t[-1]),
        _is_never_held,
    ),
)

"""Find the ordinary run that would separate causes that a log cannot tell apart.

Each effect's response is computed along the log as driven and with the drive changed: the other direction, at rest,
towed, faster, straight ahead, with quicker torques or longer. If two causes respond differently to a change that the
log does not contain yet, that run is recommended.
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

MIN_RESPONSE_DIFFERENCE = 0.4  # relative difference of two responses that separates effects; chosen
MAX_SIGNATURE_DIFFERENCE = 1e-6  # 1 - cosine of two signatures below which no run separates effects; rounding
MAX_SAMPLES = 3000  # samples of the log along which responses are computed; chosen
STANDSTILL_SPEED = 0.05  # speed [m/s, rad/s] below which a machine or joint stands; chosen
LOADED_TORQUE_SHARE = 0.05  # share of the largest torque above which a joint is loaded; chosen
MIN_STANDSTILL_SHARE = 0.05  # share of a log at standstill under load that makes a run of it; chosen
MIN_DIRECTION_SHARE = 0.1  # share of a log in either direction that makes it a run in both; chosen
MIN_SPEED_RATIO = 2.0  # 90 % over 30 % quantile of the speed above which a log has two speeds; chosen
TURNED_AROUND_RAD = 2.5  # range of the heading [rad] above which the lane was driven both ways; chosen
MIN_TURN = 0.05  # steering angle [rad], or yaw rate [rad/s] without one, above which a machine turns; chosen
MIN_TURN_SHARE = 0.2  # share of a log straight ahead, and in turns, that makes a run of both; chosen


@dataclass(frozen=True)
class SampledMotion:
    """A motion as effects see it: coordinates, velocities, accelerations (N, n_q), torques (N, n_u), time (N,) [s]."""

    q: np.ndarray
    nu: np.ndarray
    a: np.ndarray
    u: np.ndarray
    t: np.ndarray


@dataclass(frozen=True)
class DriveChange:
    """A change of the drive.

    text, bench: instructions for a machine that drives and one on a bench; {against} stands for the machine's driven
    contacts working against each other or a wall. apply: changes a motion. held: tells if a motion contains it
    already.
    """

    text: str
    bench: str | None
    apply: Callable[[Machine, SampledMotion], SampledMotion]
    held: Callable[[Machine, SampledMotion], bool]


def recommend_run(d: Diagnosis) -> str | None:
    """Describe the simplest run that separates tied causes; None without ties, or if no run separates them."""
    texts: list[str] = []
    for f in d.findings:
        if f.tied_with:
            text = _describe_separation(d.after, [f.name, *f.tied_with])
            if text is not None and text not in texts:
                texts.append(text)
    return "; then ".join(texts) or None


@dataclass(frozen=True)
class RivalPair:
    """Two tied causes with the magnitudes and shapes found, and the machine with the other findings."""

    machine: Machine
    between: tuple[EffectEntry, EffectEntry]


def rival_pairs(d: Diagnosis) -> list[RivalPair]:
    """List the pairs of tied causes that some run can separate, the likeliest first."""
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
    responses = _EffectResponses(stage, tied)
    here = responses(motion)
    pairs = list(combinations(range(len(tied)), 2))
    unseparated = {
        p for p in pairs if tied[p[0]].effect is not tied[p[1]].effect or tied[p[0]].where != tied[p[1]].where
    }
    chosen: list[DriveChange] = []
    # Greedy: take the run that separates most pairs, the simplest of equals, as long as pairs are left.
    options = [
        (change, _separated_pairs(here, responses(change.apply(machine, motion)), pairs))
        for change in DRIVE_CHANGES
        if _is_possible(change, machine)
    ]
    not_held = [(change, s) for change, s in options if not change.held(machine, motion)]
    for group in (not_held, options):
        while unseparated:
            change, split = max(group, key=lambda x: len(x[1] & unseparated), default=(None, set()))
            if change is None or not split & unseparated:
                break
            chosen.append(change)
            unseparated -= split
    texts = [_describe_change(change, machine) for change in dict.fromkeys(chosen)]
    # A machine whose file locks it to a line could turn if released.
    locked = set(machine.body[0].coordinates) & set(machine.locked)
    same = set() if locked else _equivalent_pairs(responses(_perturb(motion)), pairs)
    rest = [(tied[i], tied[j]) for i, j in sorted(unseparated - same)]
    for a, b in rest:
        more = _separate_by_place(machine, a, b)
        if more is not None and more not in texts:
            texts.append(more)
    return ", and ".join(texts) if texts else None


def _describe_change(change: DriveChange, machine: Machine) -> str:
    """Return the instructions of a change with the machine's own names."""
    if not machine.planar:
        return change.bench or change.text
    driven = [_spaced(b.where) for b in machine.actuated if b.contact is not None]
    each = f"{driven[0]} against {driven[1]}" if len(driven) == 2 else f"{', '.join(driven)} against each other"
    wall = "against a wall"
    return change.text.format(against=f"{each}, or {wall}" if len(driven) > 1 else wall)


def _spaced(where: str) -> str:
    return where.replace("_", " ")


def _placed_effect(stage: ExtendedFit, name: str) -> PlacedEffect:
    """Return a tied effect with the magnitude and shapes found, or with the catalogue's defaults."""
    known = next((e for e in stage.model.effects if e.name == name), None)
    if known is not None:
        return known
    name, _, where = name.partition("@")
    effect = effects.CATALOGUE[name]
    bodies, sensors = effects.allowed_places(stage.machine, effect)[where]
    log = stage.data.logs[0]
    site = Site.of(stage.machine, bodies, float(log.t[-1] - log.t[0]))
    shapes = {n: s.default * s.size(site) for n, s in effect.shapes.items()}
    values = {"A": effect.typical_magnitude(site), **shapes}
    return PlacedEffect(effect, where, bodies, sensors, values, effects.is_straight(site.machine, bodies))


def _longest_motion(stage: ExtendedFit) -> SampledMotion:
    """Return the longest log's smoothed motion from its start, thinned to MAX_SAMPLES."""
    space, fit = stage.data.space, stage.fit
    k = int(np.argmax([len(log) for log in stage.data.logs]))
    p, change = fit.trajectories[k], stage.data.measurements[k]
    q, nu, _, u, a = smoothed_motion(space, change, p, fit.X)
    t = np.arange(len(u)) / float(stage.machine.sampling_hz)
    step = max(1, len(u) // MAX_SAMPLES)
    return SampledMotion(*(x[::step] for x in (q, nu, a, u, t)))


class _EffectResponses:
    """Forces and readings that effects add along a motion (C, K), each scaled by its size."""

    def __init__(self, stage: ExtendedFit, placed: Sequence[PlacedEffect]) -> None:
        model = stage.model
        standard = tuple(n for n in model.base.standard if "@" not in n)
        self.model, self.machine, self.placed = model, stage.machine, placed
        self.made: SignatureFunctions = signatures(stage.machine, standard, placed)
        self.p = (model.expand @ stage.fit.X)[: len(standard)]
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
        """Return the torque that a channel reads beside the true one (n_q, N)."""
        gain, offset, delay = e.channel(m.t)
        added = np.zeros((m.q.shape[1], len(m.t)))
        for k, body in enumerate(self.machine.actuated):
            if body.index in e.bodies:
                rate = np.gradient(m.u[:, k], m.t)
                misread = (gain - 1) * m.u[:, k] + offset - delay * rate
                added += self.machine.input_matrix[:, k : k + 1] * misread
        return added


def _separated_pairs(here: np.ndarray, there: np.ndarray, pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs of effects whose responses to a change differ, by sign and size along the motion."""
    size = np.maximum((here**2).sum(axis=1), 1e-300)
    answer = (there * here).sum(axis=1) / size
    return {
        (i, j)
        for i, j in pairs
        if abs(answer[i] - answer[j]) > MIN_RESPONSE_DIFFERENCE * max(1.0, min(abs(answer[i]), abs(answer[j])))
    }


def _perturb(m: SampledMotion) -> SampledMotion:
    """Add motion to every coordinate, velocity and torque, each at its own frequency."""

    def stir(x: np.ndarray, first: float) -> np.ndarray:
        size = np.maximum(np.abs(x).max(axis=0), 0.1)
        return x + size * np.sin(m.t[:, None] * (first + 0.37 * np.arange(x.shape[1])) + np.arange(x.shape[1]))

    return replace(m, q=stir(m.q, 0.5), nu=stir(m.nu, 0.7), u=stir(m.u, 0.9))


def _equivalent_pairs(signature: np.ndarray, pairs: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs of effects with proportional signatures (C, K), such as resistance of two wheels of one side."""
    unit = signature / np.maximum(np.linalg.norm(signature, axis=1, keepdims=True), 1e-300)
    return {(i, j) for i, j in pairs if abs(unit[i] @ unit[j]) > 1 - MAX_SIGNATURE_DIFFERENCE}


def _separate_by_place(machine: Machine, a: PlacedEffect, b: PlacedEffect) -> str | None:
    """Describe what separates two causes that respond alike, by their places."""
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


# ------------------------------------------------------------------------------------------------ changes of the drive


def _is_possible(change: DriveChange, machine: Machine) -> bool:
    return machine.planar or change.bench is not None


def _forward_speed(machine: Machine, m: SampledMotion) -> np.ndarray:
    """Return the speed that counts as forward (N,): of the root along its axis, or of the first joint."""
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
        # Locked straight: turning around changes nothing here; driving in reverse covers it.
        return m
    q[:, k] += np.pi
    return replace(m, q=q)


def _has_turned_around(machine: Machine, m: SampledMotion) -> bool:
    k = _heading_index(machine)
    return k is not None and bool(np.ptp(m.q[:, k]) > TURNED_AROUND_RAD)


def _has_both_directions(machine: Machine, m: SampledMotion) -> bool:
    v = _forward_speed(machine, m)
    return bool(
        (v > STANDSTILL_SPEED).mean() > MIN_DIRECTION_SHARE and (v < -STANDSTILL_SPEED).mean() > MIN_DIRECTION_SHARE
    )


def _has_stood_with_torque(machine: Machine, m: SampledMotion) -> bool:
    still = (np.abs(m.nu) < STANDSTILL_SPEED).all(axis=1)
    return bool((still & _has_torque(m)).mean() > MIN_STANDSTILL_SHARE)


def _has_two_speeds(machine: Machine, m: SampledMotion) -> bool:
    v = np.abs(_forward_speed(machine, m))
    v = v[v > STANDSTILL_SPEED]
    return len(v) > 0 and bool(np.quantile(v, 0.9) > MIN_SPEED_RATIO * np.quantile(v, 0.3))


def _turning_coordinates(machine: Machine) -> list[int]:
    """Return the coordinates that are zero straight ahead: sideways, yaw and steered joints."""
    across = machine.body[0].coordinates[1:] if machine.planar else ()
    joints = [b.coordinates[0] for b in machine.actuated if b.contact is None] if machine.planar else []
    return [machine.coordinates.index(space) for space in (*across, *joints) if space in machine.coordinates]


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
    return bool((turn < MIN_TURN / 2).mean() > MIN_TURN_SHARE and (turn > MIN_TURN).mean() > MIN_TURN_SHARE)


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

"""Search for the most likely parameters of a fully driven machine, and for the sizes of noise and discrepancy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from excite.logs import Log, white_noise
from excite.model import Model, with_least_smoothing
from excite.smoothing.block_tridiagonal import backward
from excite.smoothing.discrepancy import Basis, Component, Sizes, build_basis, find_sizes
from excite.smoothing.inverse import (
    Design,
    NoiseSizes,
    Point,
    Problem,
    Reduced,
    cost_of,
    extra_torque,
    reduce_problem,
    torque_parts,
)
from excite.smoothing.inverse_chain import Chain, TorqueModel, build_chain, torque_sensors
from excite.smoothing.inverse_sizes import correlation_factor, update_sizes
from excite.smoothing.log_fit import HELD_STD, NotConvergedError, held_in_turn, prior_information, prior_terms
from excite.smoothing.measurements import LEAST_TORQUE_SHARE, root_mean_square
from excite.smoothing.motion_readings import (
    JointMotion,
    Readings,
    choose_knots,
    least_intensity,
    read_motion,
    speed_std,
)

EXACT_PASSES = 15  # for the model alone, before discrepancies are tried; fewer if it settles; chosen
ADMITTING = (0, 3, 6)  # passes after these in which discrepancies of zero size are tried
SHOWN_SHARE = 0.6  # of the noise by third differences, to which a lively torque adds


Beside = Sequence[tuple[np.ndarray, ...]]


@dataclass(frozen=True)
class InverseSettings:
    """How the most likely parameters are sought.

    passes: most of them. settled: largest last step [standard deviations]. settled_size: largest relative last change
    of a size. damping: first of Levenberg's damping after a refused step, and its growth. refusals: most refused steps
    of a pass. discrepancy: seek forces that the model lacks. alignment: standard deviation of each torque channel's
    time shift [rows].
    """

    passes: int = 60
    settled: float = 0.02
    settled_size: float = 0.03
    damping: tuple[float, float] = (1e-3, 10.0)
    refusals: int = 8
    discrepancy: bool = True
    alignment: float = 0.5


@dataclass(frozen=True)
class InverseFit:
    """Most likely parameters of logs, and what they leave.

    status: "converged", "stalled" (no step lowers the cost any more, short of convergence) or "passes" (out of them).
    X (n_base,), covariance (n_base, n_base) [SI], held (n_base,): parameters that the logs do not show. costs: before
    and after each step. motion: q, q', q'' (N, 3, n) of each log; residual: of torque (N, n), without discrepancies,
    and its std; extra: discrepancies and alignment (N, n) [N m]. components: of discrepancy, with their sizes and rms
    [N m].
    shift, shift_std (n,) [s]: of the torque channels.
    """

    status: str
    X: np.ndarray
    covariance: np.ndarray
    held: np.ndarray
    costs: tuple[tuple[float, float], ...]
    sizes: NoiseSizes
    motion: tuple[np.ndarray, ...]
    residual: tuple[np.ndarray, ...]
    std: tuple[np.ndarray, ...]
    extra: tuple[np.ndarray, ...]
    components: tuple[tuple[Component, float, float], ...]
    shift: np.ndarray
    shift_std: np.ndarray
    last_step: float


@dataclass(frozen=True)
class State:
    """State of the search: point, standardised discrepancy z, sizes, designs, and the slope of the log determinant.

    pull (n_base,), curve_pull (n_nodes,): the slope by parameters, and by the discrepancy's values at the nodes.
    """

    point: Point
    z: np.ndarray
    sizes: NoiseSizes
    curve_sizes: np.ndarray
    designs: tuple[Design, ...]
    pull: np.ndarray
    problem: Problem
    basis: Basis | None
    curve_pull: np.ndarray


def fit_inverse(
    model: Model, logs: Sequence[Log], settings: InverseSettings | None = None, beside: Beside = ()
) -> InverseFit:
    """Find the most likely parameters of a fully driven machine from its logs.

    beside: of each log, what effects depend on besides the motion, (N, n_u) and (N, n_z).
    """
    settings = settings or InverseSettings()
    state = first_state(model, logs, settings, beside)
    costs: list[tuple[float, float]] = []
    held = np.zeros(len(model.nominal), bool)
    status, step = "passes", np.inf
    first_try = EXACT_PASSES if settings.discrepancy else settings.passes
    for k in range(settings.passes):
        admit, moving = k - first_try in ADMITTING, k <= first_try + max(ADMITTING)
        state = with_designs(moved_channels(state) if k > 0 and moving else state, settings, admit, moving)
        if state.basis is not None and not admit and not (state.curve_sizes > 0).any():
            state = without_curves(state)
        reduced = reduce_problem(state.problem, state.designs, state.basis, state.sizes, state.point)
        if reduced is None:
            status = "stalled"
            break
        held = find_held(state, reduced)
        state = replace(state, problem=with_prior(state.problem, held, state.point.X))
        if state.basis is not None and settings.discrepancy:
            found = curve_sizes(state, reduced, admit)
            curve_change = _change(state.curve_sizes, found.size)
            state = replace(state, curve_sizes=found.size)
        else:
            curve_change = 0.0
        state = with_best_curve(with_bounded_pull(state, reduced), reduced)
        moved, before, after, step = descend(state, reduced, settings)
        if moved is None:
            if k < first_try < settings.passes:
                first_try = k + 1
                continue
            status = "converged" if step < 10 * settings.settled and k > 3 else "stalled"
            break
        costs.append((before, after))
        state = moved
        sizes, pull = new_sizes(state, reduced, first=k < 2)
        change = _sizes_change(state.sizes, sizes)
        state = replace(state, sizes=sizes, pull=pull)
        little = 0 <= before - after < settings.settled
        if k > 4 and (step < settings.settled or little) and max(change, curve_change) < settings.settled_size:
            if k < first_try < settings.passes:
                first_try = k + 1
            elif not moving or not (state.curve_sizes > 0).any():
                status = "converged"
                break
    return conclude(state, held, status, tuple(costs), float(step))


def first_state(model: Model, logs: Sequence[Log], settings: InverseSettings, beside: Beside) -> State:
    """Begin with motions by encoders alone, and least squares along them."""
    readings = [read_motion(model, log) for log in logs]
    knots, motions = choose_knots(logs, readings)
    model = with_visible_friction(model, readings, motions)
    chains = tuple(
        build_chain(model, log, own, k, [m.white for m in motions], beside[n] if beside else ())
        for n, (log, own, k) in enumerate(zip(logs, readings, knots, strict=True))
    )
    n, level = len(motions), {name: x for m in motions for name, x in m.level.items()}
    least = [least_intensity([c.prior[j] for c in chains], [c.sights[j] for c in chains], level) for j in range(n)]
    coefficients = tuple(np.column_stack([m.coefficients[k] for m in motions]) for k in range(len(logs)))
    sample = min(float(log.t[1] - log.t[0]) for log in logs)
    problem = Problem(
        TorqueModel(model),
        chains,
        prior_information(model, np.zeros(len(model.nominal), bool), model.nominal),
        max(settings.alignment, 1e-6) * sample,
        least_noise(model, logs),
        np.array(least),
    )
    sizes = NoiseSizes(
        np.array([m.intensity for m in motions]),
        100 * problem.least_noise,
        np.full(n, np.inf),
        level,
        tuple(np.ones((k.count, n)) for k in knots),
    )
    point = Point(coefficients, model.nominal.copy(), np.zeros(n), np.zeros(0))
    none = [np.zeros_like(c.torque) for c in chains]
    designs = tuple(Design(x, (x[:, :0],) * n, x) for x in none)
    state = State(
        point, np.zeros(0), sizes, np.zeros(0), designs, np.zeros(len(model.nominal)), problem, None, np.zeros(0)
    )
    for _ in range(3):
        reduced = fixed_terms(state)
        state = least_squares(state, reduced)
    return state


def with_visible_friction(
    model: Model, readings: Sequence[Sequence[Sequence[Readings]]], motions: Sequence[JointMotion]
) -> Model:
    """Return the model with dry friction that turns no faster than encoders show speeds.

    Where a joint nearly rests, a friction that turns within less than their errors has slopes that lead nowhere.
    readings: by log and joint.
    """
    least = {}
    for j, motion in enumerate(motions):
        std = speed_std([own[j] for own in readings], motion)
        body = next((b for b in model.machine.body if model.coordinates[j] in b.coordinates), None)
        if body is not None and std is not None:
            least[body.index] = TURNING_SHARE * std
    return with_least_smoothing(model, least)


TURNING_SHARE = 0.2  # of the speed's standard deviation within which dry friction turns at the fastest; chosen


def least_noise(model: Model, logs: Sequence[Log]) -> np.ndarray:
    """Return the noise (n,) [N m] that torque channels have at least.

    A motion with as many unknowns as readings could explain every torque; third differences show noise by themselves.
    """
    found = []
    for sensor in torque_sensors(model):
        shown = np.median([white_noise(log.readings(sensor.name)) for log in logs])
        found.append(max(LEAST_TORQUE_SHARE * root_mean_square(logs, sensor), SHOWN_SHARE * shown, 1e-12))
    return np.array(found)


def fixed_terms(state: State) -> Reduced:
    """Information and slope of the parameters with motions fixed. Raises NotConvergedError for readings of no size."""
    found = reduce_problem(state.problem, state.designs, state.basis, state.sizes, state.point)
    if found is None:
        raise NotConvergedError("no motion of the machine follows the log: check the unit of every column")
    return found


def least_squares(state: State, reduced: Reduced) -> State:
    """InverseFit the parameters along fixed motions, and the noise of each channel."""
    model, X = state.problem.model, state.point.X
    p = len(X)
    information, slope, _ = prior_terms(model, state.problem.prior, X)
    move = np.linalg.solve(information + reduced.fixed_information[:p, :p], reduced.fixed_slope[:p] - slope)
    point = replace(state.point, X=X + move * model.scale)
    square = np.zeros(state.problem.channels)
    number = np.zeros(state.problem.channels)
    for n, (chain, design) in enumerate(zip(state.problem.chains, state.designs, strict=True)):
        residual = chain.average(torque_parts(state.problem, chain, design, None, point, n))
        square += (chain.count * residual**2).sum(axis=0)
        number += (chain.count > 0).sum(axis=0)
    noise = np.maximum(np.sqrt(square / np.maximum(number, 1)), state.problem.least_noise)
    return replace(state, point=point, sizes=replace(state.sizes, noise=noise))


def with_designs(state: State, settings: InverseSettings, admit: bool, moving: bool) -> State:
    """Refresh the columns that follow the motion: alignment, discrepancy's nodes, and how encoders read edges.

    admit: begin with discrepancies of zero size. moving: nodes and delays still follow the motion.
    """
    problem = state.problem
    chains = []
    for n, chain in enumerate(problem.chains):
        sights = tuple(
            tuple(s.along(state.point.coefficients[n][: chain.knots.size, j]) for s in own)
            for j, own in enumerate(chain.sights)
        )
        chains.append(replace(chain, sights=sights))
    problem = replace(problem, chains=tuple(chains))
    motions = [c.motion(x) for c, x in zip(chains, state.point.coefficients, strict=True)]
    basis, point = state.basis, state.point
    if basis is None and admit:
        basis = build_basis(
            [m[:, 1] for m in motions], [m[:, 0] for m in motions], [c.t for c in chains], problem.channels
        )
        point = replace(point, curve=np.zeros(int(sum(basis.count))))
        state = replace(state, curve_sizes=np.zeros(len(basis.components)))
    if not moving:
        return replace(state, problem=problem)
    designs = []
    for n, (chain, motion) in enumerate(zip(chains, motions, strict=True)):
        y = problem.torque.prediction(chain, motion, point.X)
        delay = -np.gradient(y, chain.t, axis=0) if settings.alignment else np.zeros_like(y)
        nodes = tuple(
            basis.rows(j, n, motion[:, 1, j], motion[:, 0, j], chain.t) if basis is not None else np.zeros((len(y), 0))
            for j in range(problem.channels)
        )
        designs.append(Design(delay, nodes, unresolved_variance(problem, chain, motion, y, point.X)))
    return replace(state, problem=problem, basis=basis, point=point, designs=tuple(designs))


def unresolved_variance(problem: Problem, chain: Chain, motion: np.ndarray, y: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return the variance (N, n) [N2 m2] of torques y (N, n) that bend with the speed within a row, as friction does.

    A smooth motion (N, 3, n) rounds the corner that they make in it: an error, taken as uniform, up to the torque's
    second difference over the speeds of a row before and after, of the row or one beside it.
    """
    row = np.zeros_like(motion)
    row[:, 1] = motion[:, 2] * np.gradient(chain.t)[:, None]
    before, after = (problem.torque.prediction(chain, motion + step, X) for step in (-row, row))
    return np.asarray(scipy.ndimage.maximum_filter1d(np.abs(after - 2 * y + before), 3, axis=0) ** 2 / 3)


def moved_channels(state: State) -> State:
    """Move the torques of channels that are late or early by more than a row, by whole rows.

    The column of the alignment is linear in the time, which holds for a share of a row: a shift found from further off
    overshoots up to twofold, and would come back the same way, so half of it counts.
    """
    chains, shift = [], state.point.shift.copy()
    for chain in state.problem.chains:
        sample = float(chain.t[1] - chain.t[0])
        off = state.point.shift / sample - chain.moved
        rows = np.where(np.abs(off) > MOST_OFF, np.sign(off) * np.ceil(np.abs(off) / 2), 0).astype(int)
        shift = np.clip(shift, (chain.moved + rows - MOST_OFF) * sample, (chain.moved + rows + MOST_OFF) * sample)
        if not rows.any():
            chains.append(chain)
            continue
        torque, used = chain.torque.copy(), chain.used.copy()
        for j in np.flatnonzero(rows):
            torque[:, j] = np.roll(torque[:, j], -rows[j])
            used[:, j] = np.roll(used[:, j], -rows[j])
            lost = slice(-rows[j], None) if rows[j] > 0 else slice(0, -rows[j])
            used[lost, j] = 0
        chains.append(replace(chain, torque=torque, used=used, moved=chain.moved + rows))
    problem, point = replace(state.problem, chains=tuple(chains)), replace(state.point, shift=shift)
    return replace(state, problem=problem, point=point)


MOST_OFF = 0.75  # of a row, until which a channel stays: at half a row it would go to and fro; chosen


def without_curves(state: State) -> State:
    """Return the state without the columns of discrepancies, which are all of size zero."""
    designs = tuple(replace(d, nodes=tuple(x[:, :0] for x in d.nodes)) for d in state.designs)
    return replace(
        state,
        designs=designs,
        basis=None,
        z=np.zeros(0),
        point=replace(state.point, curve=np.zeros(0)),
        curve_pull=np.zeros(0),
    )


def with_prior(problem: Problem, held: np.ndarray, X: np.ndarray) -> Problem:
    """Return the problem with the prior of parameters at X, of which some are held."""
    return replace(problem, prior=prior_information(problem.model, held, X))


def _root(state: State) -> np.ndarray:
    """Map (n_nodes, k) from standardised coefficients of the active components to the nodes."""
    basis = state.basis
    if basis is None:
        return np.zeros((0, 0))
    active = [k for k in range(len(basis.components)) if state.curve_sizes[k] > 0]
    if not active:
        return np.zeros((len(basis.root), 0))
    return np.concatenate([basis.root[:, basis.components[k].columns] * state.curve_sizes[k] for k in active], axis=1)


def _split(state: State, matrix: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return information (n, n) and slope (n,) of steps of X, steps of shifts, and all of z; and the map from nodes.

    The slope of z is that at zero discrepancy, as z is solved for as a whole.
    """
    p = len(state.point.X) + state.problem.channels
    root = _root(state)
    T = np.zeros((len(slope), p + root.shape[1]))
    T[:p, :p] = np.eye(p)
    T[p:, p:] = root
    at_zero = slope.copy()
    at_zero += matrix[:, p:] @ state.point.curve
    return T.T @ matrix @ T, T.T @ at_zero, T


def _priors(state: State, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Information (n, n) and slope (n,) of the priors of X, shifts and z at the state's point."""
    X, shift = state.point.X, state.point.shift
    p, n = len(X), state.problem.channels
    information, slope = np.eye(size), np.zeros(size)
    own, pull, _ = prior_terms(state.problem.model, state.problem.prior, X)
    information[:p, :p] = own
    slope[:p] = pull + state.pull
    slope[p : p + n] = shift / state.problem.shift_std
    return information, slope


def find_held(state: State, reduced: Reduced) -> np.ndarray:
    """Find the parameters (n_base,) that the logs do not show: known less well than their size."""
    model, X = state.problem.model, state.point.X
    free = replace(state, problem=with_prior(state.problem, np.zeros(len(X), bool), X))
    p = len(X) + state.problem.channels  # what only a discrepancy hides is poorly known, and not held
    information = reduced.information[:p, :p]
    prior, _ = _priors(free, p)
    covariance = np.linalg.inv(information + prior)[: len(X), : len(X)]
    size = np.maximum(np.abs(X) / model.scale, 1.0)
    return held_in_turn(covariance, size, np.zeros(len(X), bool))


def curve_sizes(state: State, reduced: Reduced, admit: bool) -> Sizes:
    """Find the sizes of the discrepancy's components, parameters and shifts integrated out.

    Without the slope of the log determinant, which curves have as well: it would count as evidence for those that
    parameters can make.
    """
    assert state.basis is not None
    if not admit and not (state.curve_sizes > 0).any():
        return Sizes(state.curve_sizes, state.curve_sizes)
    p = len(state.point.X) + state.problem.channels
    S, h = reduced.information, reduced.slope.copy()
    h += S[:, p:] @ state.point.curve
    prior, slope = _priors(replace(state, pull=np.zeros(len(state.pull))), p)
    outer = S[:p, :p] + prior
    gain = np.linalg.solve(outer, np.column_stack([S[:p, p:], h[:p] - slope]))
    information = S[p:, p:] - S[p:, :p] @ gain[:, :-1]
    return find_sizes(
        state.basis, (information + information.T) / 2, h[p:] - S[p:, :p] @ gain[:, -1], state.curve_sizes, admit
    )


def with_best_curve(state: State, reduced: Reduced) -> State:
    """Return the state with the most likely discrepancy along fixed motions and at fixed parameters."""
    if state.basis is None:
        return state
    p = len(state.point.X) + state.problem.channels
    root = _root(state)
    C = reduced.fixed_information[p:, p:]
    h = reduced.fixed_slope[p:] + C @ state.point.curve - state.curve_pull
    z = np.linalg.solve(root.T @ C @ root + np.eye(root.shape[1]), root.T @ h)
    return replace(state, z=z, point=replace(state.point, curve=root @ z))


def with_bounded_pull(state: State, reduced: Reduced) -> State:
    """Return the state with a slope of the log determinant that moves no parameter by more than its deviation.

    The slope holds near the state only. It moves parameters as it does without discrepancies, which keep their values:
    these have slopes as well, and parameters that they hide would be pulled without end.
    """
    p, n = len(state.pull), len(state.pull) + state.problem.channels
    information = reduced.information[:n, :n] + _priors(state, n)[0]
    step = np.linalg.solve(information, np.concatenate([state.pull, np.zeros(n - p)]))
    share = 1 / max(float(np.sqrt(np.maximum(state.pull @ step[:p], 0.0))), 1.0)
    curve_pull: np.ndarray = share * (reduced.information[n:, :n] @ step)
    return replace(state, pull=share * state.pull, curve_pull=curve_pull)


def descend(state: State, reduced: Reduced, settings: InverseSettings) -> tuple[State | None, float, float, float]:
    """Take a step that lowers the cost; return the state, the costs before and after, and the undamped step [std]."""

    def cost(point: Point, z: np.ndarray) -> float:
        cost = cost_of(state.problem, state.designs, state.basis, state.sizes, state.pull, point, z)
        return cost + 2 * float(state.curve_pull @ point.curve)

    before = cost(state.point, state.z)
    damping, growth = 0.0, settings.damping[1]
    largest = np.inf
    for refused in range(settings.refusals + 1):
        if refused == 1:  # the discrepancy has moved since: slopes at its new values
            found = reduce_problem(state.problem, state.designs, state.basis, state.sizes, state.point)
        elif refused:
            damping = settings.damping[0] if not damping else damping * growth
            found = reduce_problem(state.problem, state.designs, state.basis, state.sizes, state.point, damping)
        else:
            found = reduced
        if found is None:
            continue
        point, z, step = propose(state, found, damping)
        largest = step if refused < 2 else largest
        for share in (1.0, 0.5, 0.2, 0.05) if refused else (1.0,):
            moved = _between(state, point, z, share)
            after = cost(*moved)
            if np.isfinite(after) and after <= before + 1e-9 * abs(before):
                return replace(state, point=moved[0], z=moved[1]), before, after, largest
    return None, before, before, largest


def _between(state: State, point: Point, z: np.ndarray, share: float) -> tuple[Point, np.ndarray]:
    """Return the point and z after a share of a step."""
    old = state.point

    def mix(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a + share * (b - a)

    coefficients = tuple(mix(a, b) for a, b in zip(old.coefficients, point.coefficients, strict=True))
    between = Point(coefficients, mix(old.X, point.X), mix(old.shift, point.shift), mix(old.curve, point.curve))
    return between, mix(state.z, z)


def propose(state: State, reduced: Reduced, damping: float) -> tuple[Point, np.ndarray, float]:
    """Return the point and z after a step, and the largest step of a parameter [standard deviations]."""
    model, point = state.problem.model, state.point
    p, n = len(point.X), state.problem.channels
    information, slope, T = _split(state, reduced.information, reduced.slope)
    prior, pull = _priors(state, len(slope))
    pull[p + n :] = T[p + n :, p + n :].T @ state.curve_pull
    total = information + prior
    size = np.sqrt(np.diag(total))
    std = np.sqrt(np.maximum(np.diag(np.linalg.inv(total / np.outer(size, size))), 0.0))[:p] / size[:p]
    damped = total + damping * np.diag(np.concatenate([np.diag(total)[:p], np.zeros(len(slope) - p)]))
    move = np.linalg.solve(damped, slope - pull)
    step = T @ move
    step[p + n :] -= point.curve
    free = state.problem.prior < HELD_STD**-2
    largest = float(np.abs(move[:p] / np.maximum(std, 1e-300))[free].max(initial=0.0))
    coefficients = []
    for old, one in zip(point.coefficients, reduced.linear, strict=True):
        half = one.half[:, :, -1] - one.half[:, :, :-1] @ step
        x = backward(one.factor, half[:, :, None]).reshape(-1, old.shape[1])[: len(old)]
        coefficients.append(old + x)
    moved = Point(
        tuple(coefficients),
        point.X + step[:p] * model.scale,
        point.shift + step[p : p + n] * state.problem.shift_std,
        point.curve + step[p + n :],
    )
    return moved, move[p + n :], largest


def new_sizes(state: State, reduced: Reduced, first: bool) -> tuple[NoiseSizes, np.ndarray]:
    """Return the sizes of noise and motion after a step, and the slope of the motions' log determinant."""
    p = len(state.point.X) + state.problem.channels
    information = reduced.information[:p, :p]
    prior, _ = _priors(state, p)
    freedom = float(np.trace(np.linalg.solve(information + prior, information)))
    return update_sizes(state.problem, state.designs, state.basis, state.sizes, state.point, reduced, freedom, first)


def _change(old: np.ndarray, new: np.ndarray) -> float:
    """Largest change of sizes, relative to the largest one."""
    largest = float(max(old.max(initial=0.0), new.max(initial=0.0)))
    return float(np.abs(old - new).max(initial=0.0)) / largest if largest else 0.0


def _sizes_change(old: NoiseSizes, new: NoiseSizes) -> float:
    """Largest relative change of noise and motion; that of the motion counts little."""
    noise = float(np.abs(np.log(new.noise / old.noise)).max())
    intensity = float(np.abs(np.log(new.intensity / old.intensity)).max()) / 4
    level = max((abs(np.log(new.level[n] / old.level[n])) for n in new.level), default=0.0)
    return max(noise, intensity, level, float((old.tails != new.tails).any()))


def conclude(
    state: State, held: np.ndarray, status: str, costs: tuple[tuple[float, float], ...], step: float
) -> InverseFit:
    """Return the fit with the covariance of its parameters."""
    problem, model, point = state.problem, state.problem.model, state.point
    p, n = len(point.X), problem.channels
    reduced = reduce_problem(problem, state.designs, state.basis, state.sizes, point)
    covariance = np.full((p + n, p + n), np.nan)
    if reduced is not None:
        information, slope, T = _split(state, reduced.information, reduced.slope)
        prior, _ = _priors(state, len(slope))
        whole = np.linalg.inv(information + prior)
        factor = correlation_factor(problem, state.designs, state.basis, state.sizes, point, whole[: p + n] @ T.T)
        covariance = whole[: p + n, : p + n] * np.outer(factor, factor)
    motions = tuple(c.motion(x) for c, x in zip(problem.chains, point.coefficients, strict=True))
    residual, extra = [], []
    for m, (chain, design) in enumerate(zip(problem.chains, state.designs, strict=True)):
        extra.append(extra_torque(chain, design, state.basis, point))
        residual.append(torque_parts(problem, chain, design, state.basis, point, m))
    components = []
    if state.basis is not None:
        at = 0
        for k, one in enumerate(state.basis.components):
            if state.curve_sizes[k] > 0:
                count = len(one.columns)
                curve = state.basis.root[:, one.columns] @ state.z[at : at + count] * state.curve_sizes[k]
                at += count
                start = int(state.basis.start[one.channel])
                own = curve[start : start + state.basis.count[one.channel]]
                force = np.concatenate([d.nodes[one.channel] @ own for d in state.designs])
                components.append((one, float(state.curve_sizes[k]), float(np.sqrt(np.mean(force**2)))))
    return InverseFit(
        status,
        point.X,
        covariance[:p, :p] * np.outer(model.scale, model.scale),
        held,
        costs,
        state.sizes,
        motions,
        tuple(residual),
        tuple(np.sqrt(state.sizes.noise**2 + d.unresolved) for d in state.designs),
        tuple(extra),
        tuple(components),
        point.shift,
        np.sqrt(np.diag(covariance)[p:]) * problem.shift_std,
        step,
    )

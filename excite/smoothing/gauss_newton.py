"""Most likely parameters and trajectories of logs: Gauss-Newton with multiple shooting.

Each pass linearises every log about its trajectory and integrates out the states with the parallel smoother, which
leaves a quadratic form in the parameters. The step of the parameters then moves the states (`apply_step`). Source:
Bock, "Recent advances in parameter identification techniques for O.D.E.", 1983.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite.errors import NoEstimateError
from excite.model import Model
from excite.smoothing import parallel_smoother
from excite.smoothing.innovations import LinearisedLog
from excite.smoothing.linearisation import BATCH_SIZE, StateSpace, advance, differentiate
from excite.smoothing.measurements import Measurements, Trajectory, ground_inputs, offset_scale, predict_readings
from excite.text import format_number

# Prior of the parameters, relative to each parameter's scale. All values are chosen.
PRIOR_STD = 3.0  # prior standard deviation; a value further off than this counts as its own prior
MAX_IDENTIFIABLE_STD = 1.0  # a parameter known less well than this is held at the machine file's value
HELD_STD = 1e-6  # prior standard deviation of a held parameter
HELD_TOLERANCE = 1e-3  # distance from the held value at which a parameter has not arrived there yet

# Course of the iteration. Steps are the largest of all parameters, in standard deviations; values are chosen.
MAX_PASSES = 15
SETTLING_PASSES = 3  # until the states fit the dynamics well enough to judge which parameters are identifiable
INITIAL_DAMPING = 25.0  # information added to each parameter in its scale (Levenberg), in the first pass
DAMPING_DECAY = 0.1  # damping of a pass relative to the pass before
RESUMED_DAMPING = INITIAL_DAMPING * DAMPING_DECAY**2  # of a fit that continues another one
CONVERGED_STEP = 0.02  # expected sum of all steps to come at which the iteration ends
SUFFICIENT_STEP = 0.2  # ends a fit whose intervals are not reported
ACCEPTABLE_STEP = 1.0  # a fit that runs out of passes is accepted below this step

# When a fit is given up; chosen.
HOPELESS_PASSES = 8  # after this many passes the step must be below HOPELESS_STEP
HOPELESS_STEP = 10.0  # [standard deviations]
LOST_PASSES = 4  # after more than this many passes a step above LOST_STEP must shrink
LOST_STEP = 30.0  # [standard deviations]
LOST_RATIO = 0.9  # largest ratio of such a step to the one two passes before
SHRINK_RATE_PASSES = 4  # passes from which the shrinking of the steps is extrapolated
STAGNATION_RATIO_NEAR = 0.5  # ratio of a step to the one two passes before: an acceptable step that stagnates
STAGNATION_RATIO_FAR = 0.8  # the same ratio for a larger step
MIN_COST_DECREASE = 0.01  # smallest relative decrease of the cost in two passes
MIN_DOWNHILL_DECREASE = 1.0  # decrease of the cost in one pass that one parameter's standard deviation makes
MAX_SWING_COST_RANGE = 0.05  # relative range of the costs between which steps oscillate
CLOSE_FIT_COST_RATIO = 1.3  # cost over its expectation from noise; above it first-order gains are rough
MAX_HALVINGS = 8  # of a step to a point that cannot be integrated
MAX_REJECTED_POINTS = 4  # points in all that cannot be integrated, in a fit that is not patient

# Length of the steps; chosen.
OSCILLATION_FACTOR = 0.7  # shortens a step that turns back and hardly shrinks
MIN_STEP_FRACTION = 0.3  # of a shortened step
RECOVERY_FACTOR = 1.15  # lengthens the other steps, up to the full step
FAST_SHRINK_RATIO = 0.3  # ratio of two steps below which an oscillation needs no shortening
CREEP_RATIO = 0.7  # ratio of two steps in one direction above which they are not extrapolated
SAME_DIRECTION_COSINE = 0.9  # cosine between two steps that have the same direction
MAX_RELATIVE_STEP = 0.5  # of a parameter in one pass, relative to its size
MAX_RELATIVE_DECREASE = 0.8  # of a positive parameter in one pass, relative to its value
HARDLY_KNOWN_STEP = 0.05  # relative last step of a parameter that the logs hardly determine
# If a step was cut and the next pass asks for the rest of it, to within REPEATED_STEP_TOLERANCE of the part taken, the
# path is straight and the limit grows by LIMIT_GROWTH.
LIMIT_GROWTH = 3.0
REPEATED_STEP_TOLERANCE = 0.3

# Process noise of level 1, white from sample to sample, as acceleration [m/s2, rad/s2]: 500 N on a roller of 11 t.
PROCESS_NOISE_UNIT = 0.045
PART_SIZE = 200  # samples whose chain stays in the processor's cache; measured
# Standard deviations of the first state about the filtered log; chosen. A wider prior lets the iteration oscillate: at
# standstill on a stiff contact, nothing shows the first speeds, which decay within milliseconds.
INITIAL_SPEED_STD = 0.05  # [m/s, rad/s]
INITIAL_ANGLE_STD = 0.1  # [rad, m]


class NotConvergedError(NoEstimateError):
    """Joint smoothing found no estimate.

    fit: the last fit, or the best one that is acceptable. step: the next step from there [standard deviations].
    oscillates: the last steps moved to and fro between equal costs.
    """

    def __init__(self, message: str, fit: Fit | None = None, step: float = np.inf, oscillates: bool = False) -> None:
        super().__init__(message)
        self.fit, self.step, self.oscillates = fit, step, oscillates

    @property
    def acceptable_fit(self) -> Fit | None:
        """The fit, if its next step is small enough to accept it."""
        return self.fit if self.step <= ACCEPTABLE_STEP else None

    @property
    def oscillating_fit(self) -> Fit | None:
        """The fit, if steps oscillate between equal costs and process noise is allowed; its intervals do not hold."""
        if self.fit is None or self.fit.process_noise == 0 or self.step > HOPELESS_STEP:
            return None
        return self.fit if self.oscillates else None


@dataclass(frozen=True)
class Fit:
    """Parameters and trajectories that explain logs best.

    X (n_base,) [SI], covariance (n_base, n_base) [SI]. unidentifiable (n_base,): parameters held at the machine file's
    values. prior (n_base,): information about these values, scaled. cost: twice the negative log-likelihood.
    process_noise: level, in units of PROCESS_NOISE_UNIT.
    """

    X: np.ndarray
    covariance: np.ndarray
    unidentifiable: np.ndarray
    prior: np.ndarray
    trajectories: tuple[Trajectory, ...]
    linear: tuple[LinearisedLog, ...]
    cost: float
    process_noise: float

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))


def prior_information(model: Model, held: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Return the information (n_base,) about the machine file's values, scaled, at parameters X (n_base,).

    A value far from the estimate must not attract it, as the error would be taken for another cause. Parameters of
    effects have no value in the machine file.
    """
    effect_parameters = {name for e in model.effects for name in e.parameters}
    from_file = np.array([n not in effect_parameters for n in model.base.names])
    return np.where(held, HELD_STD**-2, np.maximum(from_file * np.abs(X) / model.scale, PRIOR_STD) ** -2)


def prior_terms(model: Model, prior: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return information (n_base, n_base), slope (n_base,) and cost at X (n_base,) without any log, scaled.

    They are those of `prior` (n_base,), about the nominal values, and of what the machine file calls known.
    """
    deviation, known = (X - model.nominal) / model.scale, model.known
    misfit = known.rows @ X - known.values
    return (
        np.diag(prior) + known.information(model.scale),
        prior * deviation + (known.rows * model.scale).T @ misfit,
        float(prior @ deviation**2 + misfit @ misfit),
    )


def linearise_log(
    space: StateSpace,
    data: Measurements,
    trajectory: Trajectory,
    initial_guess: np.ndarray,
    X: np.ndarray,
    process_noise: float,
    exact: bool = False,
) -> LinearisedLog | None:
    """Linearise a log about a trajectory; return None if the motion cannot be integrated.

    initial_guess (n,): prior mean of the first state. exact: the trajectory is a motion of the model and needs no
    integration.
    """
    delivered, behind = space.delivered_torques(data.torque, X, trajectory.sampled_torque_error)
    noise = space.delivered_noise(data.noise.torque, X)
    if data.extra_torque_noise is None:
        noise = np.broadcast_to(noise, trajectory.torque_error.shape)
    else:
        noise = np.hypot(noise, data.extra_torque_noise)
    left, right = (
        space.inputs(d + trajectory.torque_error, o)
        for d, o in ((delivered[:-1], trajectory.ground_inputs[:-1]), (delivered[1:], trajectory.ground_inputs[1:]))
    )
    if exact:
        defect = np.zeros_like(trajectory.state[1:])
    else:
        defect = advance(space, trajectory.state[:-1], left, right, X) - trajectory.state[1:]
        if not np.isfinite(defect).all():
            return None
    u = delivered + trajectory.sampled_torque_error
    if not data.unbiased:
        inputs = space.inputs(u, trajectory.ground_inputs)
        left, right = inputs[:-1], inputs[1:]
    h, H, weight, D, reading_slopes, beat_inflation = predict_readings(space, data, trajectory, u, X)
    residual = np.zeros_like(h) if exact else np.where(data.used > 0, data.reading - h, 0.0)
    reading_slopes = reading_slopes * space.model.scale[list(space.reading_parameters)]
    scale, n_p, n_o = state_scale(space), len(X), len(data.offset_sensors)
    S, offset_unit = H * scale, offset_scale(space, data)
    sections, stages, gains = [_initial_state_section(space, trajectory, initial_guess, 1 + n_p + n_o)], [], []
    N = len(trajectory.state)
    for begin in range(0, N - 1, BATCH_SIZE):
        end = min(begin + BATCH_SIZE, N - 1)
        jacobians = differentiate(
            space, trajectory.state[begin : end + 1], left[begin:end], right[begin:end], X, process_noise > 0
        )
        gain = jacobians.B * noise[begin:end, None, :] / scale[:, None]
        C = gain @ gain.transpose(0, 2, 1)
        if process_noise > 0:
            process = jacobians.F * (process_noise * PROCESS_NOISE_UNIT * space.forced_inertia) / scale[:, None]
            C += process @ process.transpose(0, 2, 1)
        A = jacobians.A * (scale / scale[:, None])
        b = np.zeros((end - begin, space.n, 1 + n_p + n_o))
        relative_error = trajectory.torque_error[begin:end] / noise[begin:end]
        b[:, :, 0] = defect[begin:end] / scale - (gain @ relative_error[:, :, None])[:, :, 0]
        b[:, :, 1 : 1 + n_p] = (jacobians.X + jacobians.B @ behind[begin:end]) * (space.model.scale / scale[:, None])
        gains.append(gain)
        for k in range(begin, end, PART_SIZE):
            part_end = min(k + PART_SIZE, end)
            J, eta = _reading_information(
                space,
                S[k:part_end],
                weight[k:part_end],
                residual[k:part_end],
                D * offset_unit,
                reading_slopes[k:part_end],
            )
            inside = slice(k - begin, part_end - begin)
            stages.append(parallel_smoother.Elements(A[inside], b[inside], C[inside], eta, J))
            sections.append(parallel_smoother.combine(stages[-1]))
    # The last sample has no transition.
    J, eta = _reading_information(space, S[-1:], weight[-1:], residual[-1:], D * offset_unit, reading_slopes[-1:])
    zero = np.zeros_like(J)
    stages.append(parallel_smoother.Elements(zero, np.zeros_like(eta), zero, eta, J))
    sections.append(parallel_smoother.combine(stages[-1]))
    chain = parallel_smoother.smooth_chain(sections)
    # Offsets and sensor effects act on readings directly; the other parameters act through the states alone.
    direct = np.concatenate([reading_slopes, np.broadcast_to(D * offset_unit, (*residual.shape, n_o))], axis=2)
    flat = np.concatenate([residual[:, :, None], -direct], axis=2) * np.sqrt(weight)[:, :, None]
    flat = flat.reshape(-1, flat.shape[2])
    Z = chain.Z.copy()
    columns = np.concatenate([[0], 1 + np.array(space.reading_parameters, int), np.arange(1 + n_p, 1 + n_p + n_o)])
    Z[np.ix_(columns, columns)] += flat.T @ flat
    return LinearisedLog(
        chain, Z, np.concatenate(gains), tuple(stages), S, weight, residual, direct, noise, beat_inflation
    )


def _initial_state_section(
    space: StateSpace, trajectory: Trajectory, guess: np.ndarray, columns: int
) -> parallel_smoother.CombinedElements:
    """The prior of the first state, as a chain element without predecessor."""
    n, scale = space.n, state_scale(space)
    zero = np.zeros((1, n, n))
    b = np.zeros((1, n, columns))
    b[0, :, 0] = (guess - trajectory.state[0]) / scale
    std = np.where(
        np.isfinite(space.initial_std),
        space.initial_std,
        np.where(_is_speed(space), INITIAL_SPEED_STD, INITIAL_ANGLE_STD),
    )
    return parallel_smoother.combine(
        parallel_smoother.Elements(zero, b, np.diag((std / scale) ** 2)[None], np.zeros_like(b), zero)
    )


def _reading_information(
    space: StateSpace,
    H: np.ndarray,
    weight: np.ndarray,
    residual: np.ndarray,
    D: np.ndarray,
    reading_slopes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Information of the readings about the states: J (K, n, n) and eta (K, n, 1 + n_p + n_o)."""
    n_p = len(space.model.scale)
    weighted = (H * weight[:, :, None]).transpose(0, 2, 1)
    eta = np.zeros((len(H), H.shape[2], 1 + n_p + D.shape[1]))
    eta[:, :, :1] = weighted @ residual[:, :, None]
    if space.reading_parameters:
        eta[:, :, 1 + np.array(space.reading_parameters)] = -(weighted @ reading_slopes)
    eta[:, :, 1 + n_p :] = -(weighted @ D)
    return weighted @ H, eta


def _is_speed(space: StateSpace) -> np.ndarray:
    n_q = len(space.model.coordinates)
    return (space.index >= n_q) & (space.index < 2 * n_q)


def state_scale(space: StateSpace) -> np.ndarray:
    """Typical error of each state (n,), in its unit."""
    return np.where(_is_speed(space), 1e-2, 1e-3)


def fit_logs(
    space: StateSpace,
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    starts: Sequence[Trajectory],
    process_noise: float,
    held: np.ndarray,
    damping: float = INITIAL_DAMPING,
    passes: int = MAX_PASSES,
    sufficient_step: float | None = None,
    cost_limit: float = np.inf,
    patient: bool = True,
    stalled_cost_limit: float = np.inf,
    initially_held: np.ndarray | None = None,
) -> Fit:
    """Find the most likely parameters and trajectories of logs.

    space, measurements: state space of the model, and the logs in it.
    trajectories, X (n_base,): where the iteration starts.
    starts: trajectories whose first states are the prior means of the first states.
    process_noise: level, in units of PROCESS_NOISE_UNIT; 0 for exact dynamics.
    held (n_base,): parameters that stay at the machine file's values.
    damping: information added to every parameter in the first pass (Levenberg).
    passes: largest number of passes.
    sufficient_step: step [standard deviations] that ends the fit early; by default SUFFICIENT_STEP with process noise
        and no early end without.
    cost_limit: cost above which the fit is given up once the states fit the dynamics.
    patient: if False, end when steps stagnate; with process noise and a cost far above the noise, accept
    ACCEPTABLE_STEP. stalled_cost_limit: cost above which the fit is given up as soon as costs stagnate.
    initially_held (n_base,): parameters not identifiable in the fit that this one continues; held at first, then judged
        like the others.

    As long as steps keep their direction and the cost falls close to the logs, the fit is not given up for the size of
    its steps.

    Raises NotConvergedError.
    """
    model = space.model
    if sufficient_step is None:
        sufficient_step = SUFFICIENT_STEP if process_noise > 0 else 0.0
    step, before = np.inf, np.inf
    steps, costs = list[float](), list[float]()
    halvings, rejected, current = 0, 0, (list(trajectories), X)
    proposed = current
    noise = sum(float(data.used.sum()) / data.noise_inflation**2 for data in measurements)
    latest, best, best_step, stalled = None, None, ACCEPTABLE_STEP, False
    fraction, last_direction = 1.0, np.zeros(len(X))
    limit_factor, taken, remaining = np.ones(len(X)), np.zeros(len(X)), np.zeros(len(X))
    unidentifiable = held.copy() if initially_held is None else held | initially_held
    for k in range(passes):
        linear = linearise_logs(space, measurements, proposed[0], starts, proposed[1], process_noise)
        if linear is None:
            # The step was too long: a mass matrix is not positive or a motion cannot be integrated.
            halvings, rejected = halvings + 1, rejected + 1
            if halvings > MAX_HALVINGS or current is proposed or (rejected > MAX_REJECTED_POINTS and not patient):
                break
            proposed = _interpolate(current, proposed, 0.5)
            continue
        current, halvings = proposed, 0
        trajectories, X = current
        prior = prior_information(model, unidentifiable, X)
        covariance, moves, undamped_step, cost = newton_step(
            space, measurements, linear, trajectories, X, prior, damping
        )
        if k == SETTLING_PASSES:
            unidentifiable = _find_unidentifiable(
                space, measurements, linear, trajectories, X, held, unidentifiable, covariance
            )
            if unidentifiable.any():
                # Free, they would drift and make the mass matrix or the slips meaningless.
                prior = prior_information(model, unidentifiable, X)
                covariance, moves, undamped_step, cost = newton_step(
                    space, measurements, linear, trajectories, X, prior, damping
                )
        damping *= DAMPING_DECAY
        before, step = step, undamped_step
        latest = X, covariance, unidentifiable, prior, trajectories, cost
        not_arrived = bool((np.abs(X - model.nominal) > HELD_TOLERANCE * model.scale)[unidentifiable].any())
        costs.append(cost)
        direction = np.where(unidentifiable, 0.0, moves[0][: len(X)] / np.sqrt(np.diag(covariance))[: len(X)])
        lengths = np.linalg.norm(direction), np.linalg.norm(last_direction)
        same_direction = direction @ last_direction > SAME_DIRECTION_COSINE * lengths[0] * lengths[1]
        downhill = (
            same_direction
            and len(costs) > 1
            and cost < min(costs[-2] - MIN_DOWNHILL_DECREASE, CLOSE_FIT_COST_RATIO * noise)
        )
        if downhill and step > before:
            best, best_step = None, ACCEPTABLE_STEP  # the minimum is further than it seemed
        if k >= SETTLING_PASSES and step <= best_step and not not_arrived:
            best, best_step = latest, step
        steps.append(step)
        if len(steps) > LOST_PASSES and step > max(LOST_STEP, LOST_RATIO * steps[-3]):
            break
        if k >= HOPELESS_PASSES:
            shrinking = (
                min((step / steps[-1 - SHRINK_RATE_PASSES]) ** (1 / SHRINK_RATE_PASSES), 1.0)
                if len(steps) > SHRINK_RATE_PASSES
                else 0.0
            )
            if step > HOPELESS_STEP or (step * shrinking ** (passes - 1 - k) > ACCEPTABLE_STEP and not downhill):
                break
        if k >= SETTLING_PASSES and cost > cost_limit and step > ACCEPTABLE_STEP:
            break
        if k >= SETTLING_PASSES and cost > stalled_cost_limit and _cost_stagnates(costs):
            break
        if not patient and _stagnates(steps, costs) and not downhill:
            stalled = True
            break
        # Shorter steps end an oscillation of Gauss-Newton about the minimum.
        oscillates = direction @ last_direction < 0 and step > FAST_SHRINK_RATIO * before
        fraction = (
            max(OSCILLATION_FACTOR * min(fraction, 1.0), MIN_STEP_FRACTION)
            if oscillates
            else min(RECOVERY_FACTOR * fraction, 1.0)
        )
        creeps = same_direction and step < 1.0
        if creeps and FAST_SHRINK_RATIO * before < step < CREEP_RATIO * before:
            fraction = 1 / (1 - step / before)  # Aitken: the sum of all steps to come
        last_direction = direction
        wanted = moves[0][: len(X)].copy()
        straight = (remaining != 0) & (np.abs(wanted - remaining) < REPEATED_STEP_TOLERANCE * np.abs(taken))
        limit_factor = np.where(straight, LIMIT_GROWTH * limit_factor, 1.0)
        limit = limit_factor * MAX_RELATIVE_STEP * np.maximum(np.abs(X) / model.scale, 1.0)
        share, lowest = 1.0 if not_arrived else fraction, _lower_step_bound(model, X)
        for m in moves:
            # A newly held parameter returns to its value at once; the others move along within their limits.
            own = np.clip(share * m[: len(X)], -limit, limit)
            # A lengthened or rounded step may fall below the bound it was computed for.
            m[: len(X)] = np.where(unidentifiable, m[: len(X)], np.maximum(own, lowest))
        taken = moves[0][: len(X)]
        remaining = np.where(np.abs(share * wanted) > limit, wanted - taken, 0.0)
        moved = X + taken * model.scale
        proposed = (
            [
                apply_step(space, data, trajectory, found, m, moved)
                for data, trajectory, found, m in zip(measurements, trajectories, linear, moves, strict=True)
            ],
            moved,
        )
        # Sum of the steps to come, if they shrink at the present rate.
        ratio = min(max(step / before, 1 - fraction), 0.9)
        done = step < 10 * CONVERGED_STEP and step * ratio / (1 - ratio) < CONVERGED_STEP
        rough = not patient and process_noise > 0 and cost > CLOSE_FIT_COST_RATIO * noise
        if not not_arrived and (done or step < (ACCEPTABLE_STEP if rough else sufficient_step)):
            if k < SETTLING_PASSES and (unidentifiable != held).any():
                before_check = unidentifiable
                unidentifiable = _find_unidentifiable(
                    space, measurements, linear, trajectories, X, held, unidentifiable, covariance
                )
                if (unidentifiable != before_check).any():
                    continue
            # A hardly known parameter may have left the range of possible motions, and other fits continue from here.
            moved_far = (np.abs(proposed[1] - X) > HARDLY_KNOWN_STEP * np.maximum(np.abs(X), model.scale)).any()
            if (
                moved_far
                and linearise_logs(space, measurements, proposed[0], starts, proposed[1], process_noise) is None
            ):
                proposed = current
            return Fit(
                proposed[1],
                covariance_in_si(space, covariance),
                unidentifiable,
                prior,
                tuple(proposed[0]),
                tuple(linear),
                cost,
                process_noise,
            )
    else:
        stalled = True
    final = None
    if best is not None and (linear is None or best is not latest):
        X, covariance, unidentifiable, prior, trajectories, cost = best
        # Linearisations are large, so none but the last is kept.
        linear = linearise_logs(space, measurements, trajectories, starts, X, process_noise)
    if linear is not None:
        final = Fit(
            X,
            covariance_in_si(space, covariance),
            unidentifiable,
            prior,
            tuple(trajectories),
            tuple(linear),
            cost,
            process_noise,
        )
    raise NotConvergedError(
        f"joint smoothing found no estimate in {k + 1} passes (last step {format_number(step, 3)} standard"
        " deviations): check the log with `excite log check` and `excite diagnose`, or start from better values in"
        " the machine file",
        final,
        float(step if best is None else best_step),
        stalled and len(costs) > SETTLING_PASSES + 2 and np.ptp(costs[-3:]) < MAX_SWING_COST_RANGE * costs[-1],
    )


def _find_unidentifiable(
    space: StateSpace,
    measurements: Sequence[Measurements],
    linear: Sequence[LinearisedLog],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    held: np.ndarray,
    unidentifiable: np.ndarray,
    covariance: np.ndarray,
) -> np.ndarray:
    """Find the parameters (n_base,) to hold, besides `held`, so that no other's standard deviation exceeds its size.

    The one that exceeds its size most is held first, then the next given that: of parameters that the logs show only
    together, such as dry friction and offset in one direction, one is held. covariance: of a step with `unidentifiable`
    held. The size is that of the estimate or the scale, whichever is larger, as the machine file's value may be far too
    small.
    """
    if (unidentifiable != held).any():
        covariance, *_ = newton_step(
            space, measurements, linear, trajectories, X, prior_information(space.model, held, X), 0.0
        )
    size = np.maximum(np.abs(X) / space.model.scale, 1.0)
    found, left = held.copy(), covariance[: len(X), : len(X)].copy()
    while True:
        excess = np.where(found, 0.0, np.sqrt(np.maximum(np.diag(left), 0.0)) / size)
        k = int(np.argmax(excess))
        if not excess[k] > MAX_IDENTIFIABLE_STD:
            return found
        found[k] = True
        left -= np.outer(left[:, k], left[k]) / left[k, k]


def _stagnates(steps: Sequence[float], costs: Sequence[float]) -> bool:
    """True if acceptable steps no longer shrink, or if larger steps and the cost no longer do."""
    if len(steps) <= SETTLING_PASSES + 1:
        return False
    if steps[-1] <= ACCEPTABLE_STEP:
        return steps[-1] > STAGNATION_RATIO_NEAR * steps[-3]
    stagnant = steps[-1] > STAGNATION_RATIO_FAR * steps[-3] and steps[-2] > STAGNATION_RATIO_FAR * steps[-4]
    return len(steps) > SETTLING_PASSES + 2 and stagnant and _cost_stagnates(costs)


def _cost_stagnates(costs: Sequence[float]) -> bool:
    """True if the cost has not fallen in two passes."""
    return len(costs) > 2 and costs[-1] > (1 - MIN_COST_DECREASE) * costs[-3]


def linearise_logs(
    space: StateSpace,
    measurements: Sequence[Measurements],
    trajectories: Sequence[Trajectory],
    starts: Sequence[Trajectory],
    X: np.ndarray,
    process_noise: float,
) -> list[LinearisedLog] | None:
    """Linearise every log; return None if a mass matrix is not positive or a motion cannot be integrated."""
    linear: list[LinearisedLog] = []
    for data, trajectory, start in zip(measurements, trajectories, starts, strict=True):
        if not (space.pivots(trajectory.state[::10], X)[0] > 0).all():
            return None
        try:
            found = linearise_log(space, data, trajectory, start.state[0], X, process_noise)
        except np.linalg.LinAlgError:  # the chain is numerically singular this far off
            found = None
        if found is None:
            return None
        linear.append(found)
    return linear


def newton_step(
    space: StateSpace,
    measurements: Sequence[Measurements],
    linear: Sequence[LinearisedLog],
    trajectories: Sequence[Trajectory],
    X: np.ndarray,
    prior: np.ndarray,
    damping: float,
    fixed: np.ndarray | None = None,
) -> tuple[np.ndarray, list[np.ndarray], float, float]:
    """Compute one damped Gauss-Newton step of parameters and offsets, from linearised logs.

    prior (n_base,): information about the nominal values, scaled. What the machine file calls known is added to it.
    damping: information added to every parameter; poorly known ones then move little while the others converge.
    fixed (n_base,): parameters that stay at their values, also in the covariance; the others are unbounded then.

    Returns the scaled covariance of all parameters and offsets (without damping and bounds), each log's step, the
    largest undamped step of a free parameter [standard deviations], and the predicted cost after the undamped step. A
    positive parameter decreases by MAX_RELATIVE_DECREASE at most; the others take their optimum given such a bound.

    Raises NotConvergedError if the covariance is not positive.
    """
    n, indices = len(X), parameter_indices(space, measurements)
    size = n + sum(len(data.offset_sensors) for data in measurements)
    information, slope = np.zeros((size, size)), np.zeros(size)
    information[:n, :n], slope[:n], cost = prior_terms(space.model, prior, X)
    if fixed is not None:
        information[range(n), range(n)] += fixed * HELD_STD**-2
    for log, data, trajectory, own in zip(linear, measurements, trajectories, indices, strict=True):
        information[np.ix_(own, own)] += log.Z[1:, 1:]
        slope[own] += log.Z[1:, 0]
        offsets = own[n:]
        information[offsets, offsets] += 1.0
        offset_deviation = trajectory.offset / offset_scale(space, data) - 0.5
        slope[offsets] += offset_deviation
        cost += float(log.Z[0, 0] + offset_deviation @ offset_deviation)
    try:
        covariance = np.linalg.inv(information)
    except np.linalg.LinAlgError:  # far off, readings may tell nothing of a parameter
        covariance = np.zeros_like(information)
    if not (np.diag(covariance) > 0).all():
        raise NotConvergedError(
            "joint smoothing: the parameters' covariance is not positive: check the log with `excite log check`"
        )
    sigma, free = np.sqrt(np.diag(covariance))[:n], prior < HELD_STD**-2
    lowest = np.full(size, -np.inf)
    if fixed is None:
        lowest[:n] = np.where(free, _lower_step_bound(space.model, X), -np.inf)
    undamped = _bounded_step(lowest, -covariance @ slope, information, slope)
    largest = float(np.abs(undamped[:n] / sigma)[free if free.any() else slice(None)].max())
    cost += float(2 * slope @ undamped + undamped @ information @ undamped)
    information[range(n), range(n)] += damping
    step = _bounded_step(lowest, -np.linalg.solve(information, slope), information, slope)
    return covariance, [step[own] for own in indices], largest, cost


def _lower_step_bound(model: Model, X: np.ndarray) -> np.ndarray:
    """Lower bounds (n_base,) of the scaled steps, which keep positive parameters positive."""
    return np.where(model.positive, -MAX_RELATIVE_DECREASE * X / model.scale, -np.inf)


def _bounded_step(lowest: np.ndarray, free: np.ndarray, information: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Minimise a quadratic cost with information (n, n) and slope (n,) under lower bounds on the step (n,).

    free (n,): the unbounded minimum, returned if it satisfies the bounds. It is clipped if the information is not
    positive definite.
    """
    if (free >= lowest).all() or not np.isfinite(free).all():
        return free
    if not (np.diag(information) > 0).all():
        return np.maximum(free, lowest)
    size = np.sqrt(np.diag(information))
    try:
        root = np.linalg.cholesky(information / np.outer(size, size))
    except np.linalg.LinAlgError:
        return np.maximum(free, lowest)
    target = -scipy.linalg.solve_triangular(root, slope / size, lower=True)
    found = scipy.optimize.lsq_linear(root.T, target, (lowest * size, np.inf), method="bvls", tol=1e-12)
    return np.asarray(found.x / size)


def parameter_indices(space: StateSpace, measurements: Sequence[Measurements]) -> list[np.ndarray]:
    """Return, for each log, the indices of the parameters and of its own offsets among those of all logs."""
    n = len(space.model.scale)
    ends = n + np.cumsum([len(data.offset_sensors) for data in measurements])
    return [np.r_[0:n, end - len(data.offset_sensors) : end] for data, end in zip(measurements, ends, strict=True)]


def covariance_in_si(space: StateSpace, covariance: np.ndarray) -> np.ndarray:
    """Extract the base parameters' covariance (n_base, n_base) [SI] from a scaled one of parameters and offsets."""
    scale = space.model.scale
    return np.asarray(covariance[: len(scale), : len(scale)] * np.outer(scale, scale))


def apply_step(
    space: StateSpace,
    data: Measurements,
    trajectory: Trajectory,
    linear: LinearisedLog,
    move: np.ndarray,
    X: np.ndarray,
) -> Trajectory:
    """Return the trajectory after a scaled step of parameters and offsets to X, with its most likely states."""
    x, slope = linear.chain.states(move)
    torque_error = (linear.gain.transpose(0, 2, 1) @ slope[1:, :, None])[:, :, 0] * linear.noise
    offset = move[len(move) - len(data.offset_sensors) :]
    state = trajectory.state + x * state_scale(space)
    return Trajectory(
        state, torque_error, trajectory.offset + offset * offset_scale(space, data), ground_inputs(space, state, X)
    )


def _interpolate(
    current: tuple[list[Trajectory], np.ndarray], proposed: tuple[list[Trajectory], np.ndarray], fraction: float
) -> tuple[list[Trajectory], np.ndarray]:
    def mix(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a + fraction * (b - a)

    trajectories = [
        Trajectory(
            mix(a.state, b.state),
            mix(a.torque_error, b.torque_error),
            mix(a.offset, b.offset),
            mix(a.ground_inputs, b.ground_inputs),
        )
        for a, b in zip(current[0], proposed[0], strict=True)
    ]
    return trajectories, mix(current[1], proposed[1])

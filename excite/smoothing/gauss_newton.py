"""The most likely parameters and trajectories of logs: Gauss-Newton by multiple shooting.

A log is linearised about a point (`linearise`), its states are integrated out by `chain`, which leaves a small
quadratic form in the parameters; a step of these takes the states along (`moved`). Source: Bock, "Recent advances in
parameter identification techniques for O.D.E.", 1983.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from excite.errors import NoEstimateError
from excite.model import Model
from excite.smoothing import parallel_smoother
from excite.smoothing.innovations import Linear
from excite.smoothing.linearisation import BATCH, Chart, advance, differentiate
from excite.smoothing.measurements import Point, Record, driven_over, one_count, readings

PRIOR = 3.0  # standard deviation of a parameter before any data, in its scale; of one that is further off, its size
PASSES = 15  # at most
UNSEEN = 1.0  # a parameter that a log tells less than this well, in its scale, stays at the machine file's value
HELD = 1e-6  # standard deviation of such a parameter, in its scale
AWAY = 1e-3  # of its scale, from which it isn't where it is held yet
SETTLED = 3  # passes until the states fit the dynamics well enough to tell which these are
DAMPING = 25.0, 0.1  # of the first step, as information in each parameter's scale, and its share from pass to pass
RESUMED = DAMPING[0] * DAMPING[1] ** 2  # damping of a fit that goes on from another
HOPELESS = (8, 10.0)  # after so many passes with a step still so large, in standard deviations
LOST = (4, 30.0, 0.9)  # after more than so many with one so large that is more than a share of that two passes earlier
LATELY = 4  # passes whose steps tell how small the last one will be
IDLE = 0.5, 0.8  # share of a step two passes earlier above which it hardly shrinks: near an answer, far from any
FALLING = 0.01  # of a cost, in two passes
FELL = 1.0  # of a cost, in one pass: a parameter's way of one standard deviation
ALIKE = 0.05  # of a cost: what swinging steps change
NEARLY = 1.0  # a step, in standard deviations, at which a fit that runs out of passes is as good as found
CONVERGED = 0.02  # left undone at the end of the iteration, in standard deviations
ENOUGH = 0.2  # a step, in standard deviations, at which a fit is found whose deviations are no promise
# Steps that turn back and hardly shrink are shortened by TURNED; others grow by SHARE up to the whole.
TURNED, SHARE, SLOW = 0.7, 1.15, 0.3
STRONG = 1.3  # misfit over what noise makes of it from which a fit isn't near the logs, and first-order gains are rough
FREE = 0.05  # of a parameter's size, in the last step: it is hardly known
DOWN = 0.8  # of a parameter that makes sense above zero only, by which it goes down in one pass at most
ALONG = 0.9  # cosine between two steps that go the same way
LARGEST_STEP = 0.5  # of a parameter in one pass, relative to its size
# Where a step was cut short and the next pass asks for the rest of it, but for a share AGAIN of what was gone, the way
# is straight, and the limit FURTHER times as far.
FURTHER, AGAIN = 3.0, 0.3
# Disturbing forces where the model is not trusted, white from sample to sample, as accelerations [m/s2, rad/s2]: on a
# roller of 11 t they are 500 N.
DISTURBANCE = 0.045
SHORTER = 8  # times that a step is halved
REJECTED = 4  # points in all that can't be integrated, of a fit on which no more passes are spent than it is worth
PART = 200  # samples at a time: their chain stays in the processor's cache
# Of the first state about the filtered log. Not wider: where the contact is stiff, at standstill, nothing is seen of
# the first speeds, which are gone within milliseconds, and an iteration would play with them for ever.
SPREAD_SPEED, SPREAD_ANGLE = 0.05, 0.1


class NotConverged(NoEstimateError):
    """Joint smoothing found no estimate; the message says how far it came and what to do, `fit` where it stood, last or
    as good as found, and `step` the step from there, in standard deviations. swung: the last steps led to and fro
    between what costs alike."""

    def __init__(self, message: str, fit: Fit | None = None, step: float = np.inf, swung: bool = False) -> None:
        super().__init__(message)
        self.fit, self.step, self.swung = fit, step, swung

    @property
    def nearly(self) -> Fit | None:
        """The fit where it stood, if that is as good as found."""
        return self.fit if self.step <= NEARLY else None

    @property
    def swinging(self) -> Fit | None:
        """The fit where it stood, if steps swing without end between what costs alike, under disturbing forces, whose
        deviations are no promise."""
        if self.fit is None or self.fit.disturbed == 0 or self.step > HOPELESS[1]:
            return None
        return self.fit if self.swung else None


@dataclass(frozen=True)
class Fit:
    """Base parameters X (n_base,), their covariance, which were held because nothing shows them, the prior information
    about the machine file's values (n_base,), and the trajectories of the logs; twice the negative log-likelihood
    `cost`, and the disturbing forces in units of DISTURBANCE."""

    X: np.ndarray
    covariance: np.ndarray
    unseen: np.ndarray
    prior: np.ndarray
    points: tuple[Point, ...]
    linear: tuple[Linear, ...]
    cost: float
    disturbed: float

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))


def prior_information(model: Model, held: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Information (n_base,) about the machine file's values that stands before any data, where parameters are X. A file
    that is far off must not pull: its error would be evidence of another cause. Effects have no such values."""
    added = {name for e in model.effects for name in e.parameters}
    own = np.array([n not in added for n in model.base.names])
    return np.where(held, HELD**-2, np.maximum(own * np.abs(X) / model.scale, PRIOR) ** -2)


def linearise_fit(
    c: Chart,
    r: Record,
    p: Point,
    first: np.ndarray,
    X: np.ndarray,
    disturbed: float,
    exact: bool = False,
) -> Linear | None:
    """The chain of a log about a point; None where the motion can't be integrated. first (n,): guess of s[0].

    `exact`: the point is a motion of the machine, which needs no integration.
    """
    delivered, behind = c.delivered(r.torque, X, p.errors)
    noise = c.felt(r.noise.torque, X)
    left, right = (c.inputs(d + p.w, o) for d, o in ((delivered[:-1], p.over[:-1]), (delivered[1:], p.over[1:])))
    if exact:
        defect = np.zeros_like(p.s[1:])
    else:
        defect = advance(c, p.s[:-1], left, right, X) - p.s[1:]
        if not np.isfinite(defect).all():
            return None
    u = delivered + p.errors
    if not r.unbiased:
        both = c.inputs(u, p.over)
        left, right = both[:-1], both[1:]
    h, H, weight, D, flaws, beats = readings(c, r, p, u, X)
    residual = np.zeros_like(h) if exact else np.where(r.used > 0, r.reading - h, 0.0)
    flaws = flaws * c.model.scale[list(c.flawed)]
    scale, n_p, n_o = state_scale(c), len(X), len(r.origin)
    S, unit = H * scale, one_count(c, r)
    parts, stages, gains = [_known_before(c, p, first, 1 + n_p + n_o)], [], []
    N = len(p.s)
    for at in range(0, N - 1, BATCH):
        until = min(at + BATCH, N - 1)
        by = differentiate(c, p.s[at : until + 1], left[at:until], right[at:until], X, disturbed > 0)
        gain = by.B * noise / scale[:, None]
        C = gain @ gain.transpose(0, 2, 1)
        if disturbed > 0:
            push = by.F * (disturbed * DISTURBANCE * c.inertia) / scale[:, None]
            C += push @ push.transpose(0, 2, 1)
        A = by.A * (scale / scale[:, None])
        b = np.zeros((until - at, c.n, 1 + n_p + n_o))
        b[:, :, 0] = defect[at:until] / scale - (gain @ (p.w[at:until] / noise)[:, :, None])[:, :, 0]
        b[:, :, 1 : 1 + n_p] = (by.X + by.B @ behind[at:until]) * (c.model.scale / scale[:, None])
        gains.append(gain)
        for k in range(at, until, PART):
            end = min(k + PART, until)
            J, eta = _seen(c, S[k:end], weight[k:end], residual[k:end], D * unit, flaws[k:end])
            own = slice(k - at, end - at)
            stages.append(parallel_smoother.Stages(A[own], b[own], C[own], eta, J))
            parts.append(parallel_smoother.section(stages[-1]))
    # From the last sample nothing leads on.
    J, eta = _seen(c, S[-1:], weight[-1:], residual[-1:], D * unit, flaws[-1:])
    none = np.zeros_like(J)
    stages.append(parallel_smoother.Stages(none, np.zeros_like(eta), none, eta, J))
    parts.append(parallel_smoother.section(stages[-1]))
    solved = parallel_smoother.solve(parts)
    # What the readings say directly of offsets and of flaws of sensors; other parameters act through the states alone.
    direct = np.concatenate([flaws, np.broadcast_to(D * unit, (*residual.shape, n_o))], axis=2)
    flat = np.concatenate([residual[:, :, None], -direct], axis=2) * np.sqrt(weight)[:, :, None]
    flat = flat.reshape(-1, flat.shape[2])
    Z = solved.Z.copy()
    place = np.concatenate([[0], 1 + np.array(c.flawed, int), np.arange(1 + n_p, 1 + n_p + n_o)])
    Z[np.ix_(place, place)] += flat.T @ flat
    return Linear(solved, Z, np.concatenate(gains), tuple(stages), S, weight, residual, direct, noise, beats)


def _known_before(c: Chart, p: Point, first: np.ndarray, columns: int) -> parallel_smoother.Section:
    """A stage that leads to the first state, from nothing: a guess and how far it may be off."""
    n, scale = c.n, state_scale(c)
    none = np.zeros((1, n, n))
    b = np.zeros((1, n, columns))
    b[0, :, 0] = (first - p.s[0]) / scale
    spread = np.where(np.isfinite(c.known), c.known, np.where(_speeds(c), SPREAD_SPEED, SPREAD_ANGLE))
    return parallel_smoother.section(
        parallel_smoother.Stages(none, b, np.diag((spread / scale) ** 2)[None], np.zeros_like(b), none)
    )


def _seen(
    c: Chart, H: np.ndarray, weight: np.ndarray, residual: np.ndarray, D: np.ndarray, flaws: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What readings tell of the states: J (K, n, n), eta (K, n, 1 + n_p + n_o)."""
    n_p = len(c.model.scale)
    weighted = (H * weight[:, :, None]).transpose(0, 2, 1)
    eta = np.zeros((len(H), H.shape[2], 1 + n_p + D.shape[1]))
    eta[:, :, :1] = weighted @ residual[:, :, None]
    if c.flawed:
        eta[:, :, 1 + np.array(c.flawed)] = -(weighted @ flaws)
    eta[:, :, 1 + n_p :] = -(weighted @ D)
    return weighted @ H, eta


def _speeds(c: Chart) -> np.ndarray:
    n_q = len(c.model.coordinates)
    return (c.index >= n_q) & (c.index < 2 * n_q)


def state_scale(c: Chart) -> np.ndarray:
    """Typical size of an error of each state (n,)."""
    return np.where(_speeds(c), 1e-2, 1e-3)


def iterate(
    c: Chart,
    records: Sequence[Record],
    points: Sequence[Point],
    X: np.ndarray,
    starts: Sequence[Point],
    disturbed: float,
    held: np.ndarray,
    damping: float = DAMPING[0],
    passes: int = PASSES,
    enough: float | None = None,
    most: float = np.inf,
    patient: bool = True,
    worth: float = np.inf,
    untold: np.ndarray | None = None,
) -> Fit:
    """Gauss-Newton from points and X; the prior stands about the machine file's values and the states of `starts`.
    Parameters `held` (n_base,) stay at the file's values. damping: of the first step; passes: at most; enough: a step,
    in standard deviations, at which a fit is found, however much is left undone: ENOUGH with disturbing forces, none
    without, if not given; most: cost above which a fit is given up once the states fit the dynamics; worth: cost above
    which it is given up as soon as costs fall no more. Not `patient`: no passes are spent on steps that have ceased to
    shrink, and far from the logs a step of NEARLY is small enough under disturbing forces, whatever is asked for. No
    fit is given up for its steps, nor found where they grow again, as long as they lead on downhill near the logs.
    untold (n_base,): parameters that start held, as they weren't seen in the fit that this one goes on from,
    and are judged like the others.

    Raises NotConverged.
    """
    model = c.model
    if enough is None:
        enough = ENOUGH if disturbed > 0 else 0.0
    step, before = np.inf, np.inf
    sizes, costs = list[float](), list[float]()
    shorter, rejected, here = 0, 0, (list(points), X)
    there = here
    noise = sum(float(r.used.sum()) / r.coarse**2 for r in records)
    latest, best, nearest, waited = None, None, NEARLY, False
    whole, last = 1.0, np.zeros(len(X))
    reach, gone, rest = np.ones(len(X)), np.zeros(len(X)), np.zeros(len(X))
    unseen = held.copy() if untold is None else held | untold
    for k in range(passes):
        linear = linearised(c, records, there[0], starts, there[1], disturbed)
        if linear is None:
            # Too far: the mass matrix is not positive or a motion can't be integrated.
            shorter, rejected = shorter + 1, rejected + 1
            if shorter > SHORTER or here is there or (rejected > REJECTED and not patient):
                break
            there = _between(here, there, 0.5)
            continue
        here, shorter = there, 0
        points, X = here
        known = prior_information(model, unseen, X)
        covariance, move, left, cost = newton_step(c, records, linear, points, X, known, damping)
        if k == SETTLED:
            unseen = _unseen(c, records, linear, points, X, held, unseen, covariance)
            if unseen.any():
                # Left free they would go anywhere, and take the mass matrix and the slips with them.
                known = prior_information(model, unseen, X)
                covariance, move, left, cost = newton_step(c, records, linear, points, X, known, damping)
        damping *= DAMPING[1]
        before, step = step, left
        latest = X, covariance, unseen, known, points, cost
        away = bool((np.abs(X - model.nominal) > AWAY * model.scale)[unseen].any())
        costs.append(cost)
        turned = np.where(unseen, 0.0, move[0][: len(X)] / np.sqrt(np.diag(covariance))[: len(X)])
        along = turned @ last > ALONG * np.linalg.norm(turned) * np.linalg.norm(last)
        downhill = along and len(costs) > 1 and cost < min(costs[-2] - FELL, STRONG * noise)
        if downhill and step > before:
            best, nearest = None, NEARLY  # the way was longer than it seemed
        if k >= SETTLED and step <= nearest and not away:
            best, nearest = latest, step
        sizes.append(step)
        if len(sizes) > LOST[0] and step > max(LOST[1], LOST[2] * sizes[-3]):
            break
        if k >= HOPELESS[0]:
            shrinking = min((step / sizes[-1 - LATELY]) ** (1 / LATELY), 1.0) if len(sizes) > LATELY else 0.0
            if step > HOPELESS[1] or (step * shrinking ** (passes - 1 - k) > NEARLY and not downhill):
                break
        if k >= SETTLED and cost > most and step > NEARLY:
            break
        if k >= SETTLED and cost > worth and _level(costs):
            break
        if not patient and _idle(sizes, costs) and not downhill:
            waited = True
            break
        # Where Gauss-Newton swings about the answer, shorter steps end it.
        swings = turned @ last < 0 and step > SLOW * before
        whole = max(TURNED * min(whole, 1.0), 0.3) if swings else min(SHARE * whole, 1.0)
        creeps = along and step < 1.0
        if creeps and SLOW * before < step < 0.7 * before:
            whole = 1 / (1 - step / before)  # Aitken: all the steps to come at once
        last = turned
        wanted = move[0][: len(X)].copy()
        straight = (rest != 0) & (np.abs(wanted - rest) < AGAIN * np.abs(gone))
        reach = np.where(straight, FURTHER * reach, 1.0)
        limit = reach * LARGEST_STEP * np.maximum(np.abs(X) / model.scale, 1.0)
        share, lowest = 1.0 if away else whole, _lowest(model, X)
        for m in move:
            # What is held from now on goes back to its value at once, and the others along as far as they may.
            own = np.clip(share * m[: len(X)], -limit, limit)
            # A lengthened step, or a rounded one, may go below the lowest that it was computed for.
            m[: len(X)] = np.where(unseen, m[: len(X)], np.maximum(own, lowest))
        gone = move[0][: len(X)]
        rest = np.where(np.abs(share * wanted) > limit, wanted - gone, 0.0)
        there = (
            [moved(c, r, p, f, m) for r, p, f, m in zip(records, points, linear, move, strict=True)],
            X + move[0][: len(X)] * model.scale,
        )
        # What this step will have left undone, if steps go on shrinking as they do.
        ratio = min(max(step / before, 1 - whole), 0.9)
        done = step < 10 * CONVERGED and step * ratio / (1 - ratio) < CONVERGED
        rough = not patient and disturbed > 0 and cost > STRONG * noise
        if not away and (done or step < (NEARLY if rough else enough)):
            if k < SETTLED and (unseen != held).any():
                started, unseen = unseen, _unseen(c, records, linear, points, X, held, unseen, covariance)
                if (unseen != started).any():
                    continue
            # What is hardly known may have gone where no motion is: other fits must be able to go on from here.
            far = (np.abs(there[1] - X) > FREE * np.maximum(np.abs(X), model.scale)).any()
            if far and linearised(c, records, there[0], starts, there[1], disturbed) is None:
                there = here
            return Fit(there[1], in_si(c, covariance), unseen, known, tuple(there[0]), tuple(linear), cost, disturbed)
    else:
        waited = True
    stood = None
    if best is not None and (linear is None or best is not latest):
        X, covariance, unseen, known, points, cost = best
        linear = linearised(c, records, points, starts, X, disturbed)  # large: none is kept on the way
    if linear is not None:
        stood = Fit(X, in_si(c, covariance), unseen, known, tuple(points), tuple(linear), cost, disturbed)
    raise NotConverged(
        f"joint smoothing found no estimate in {k + 1} passes (last step {step:.3g} standard deviations): check the"
        " log with `excite log check` and `excite diagnose`, or start from better values in the machine file",
        stood,
        float(step if best is None else nearest),
        waited and len(costs) > SETTLED + 2 and np.ptp(costs[-3:]) < ALIKE * costs[-1],
    )


def _unseen(
    c: Chart,
    records: Sequence[Record],
    linear: Sequence[Linear],
    points: Sequence[Point],
    X: np.ndarray,
    held: np.ndarray,
    unseen: np.ndarray,
    covariance: np.ndarray,
) -> np.ndarray:
    """Parameters (n_base,) that the logs don't show, by their deviations were all free but those that must be held,
    and these. covariance: of a step with `unseen` held. Against the estimate as well: a file's value that is far too
    small must not make a parameter unseen."""
    if (unseen != held).any():
        covariance, *_ = newton_step(c, records, linear, points, X, prior_information(c.model, held, X), 0.0)
    sigma = np.sqrt(np.diag(covariance))[: len(X)]
    found: np.ndarray = held | (sigma > UNSEEN * np.maximum(np.abs(X) / c.model.scale, 1.0))
    return found


def _idle(steps: Sequence[float], costs: Sequence[float]) -> bool:
    """Whether steps have ceased to shrink: swing about an answer as good as found, or far from any while costs have
    ceased to fall."""
    if len(steps) <= SETTLED + 1:
        return False
    if steps[-1] <= NEARLY:
        return steps[-1] > IDLE[0] * steps[-3]
    still = steps[-1] > IDLE[1] * steps[-3] and steps[-2] > IDLE[1] * steps[-4]
    return len(steps) > SETTLED + 2 and still and _level(costs)


def _level(costs: Sequence[float]) -> bool:
    """Whether costs have ceased to fall."""
    return len(costs) > 2 and costs[-1] > (1 - FALLING) * costs[-3]


def linearised(
    c: Chart,
    records: Sequence[Record],
    points: Sequence[Point],
    starts: Sequence[Point],
    X: np.ndarray,
    disturbed: float,
) -> list[Linear] | None:
    """Every log linearised; None where the mass matrix isn't positive or a motion can't be integrated."""
    linear: list[Linear] = []
    for r, p, begin in zip(records, points, starts, strict=True):
        if not (c.pivots(p.s[::10], X)[0] > 0).all():
            return None
        try:
            found = linearise_fit(c, r, p, begin.s[0], X, disturbed)
        except np.linalg.LinAlgError:  # so far off that the chain has no numbers any more
            found = None
        if found is None:
            return None
        linear.append(found)
    return linear


def newton_step(
    c: Chart,
    records: Sequence[Record],
    linear: Sequence[Linear],
    points: Sequence[Point],
    X: np.ndarray,
    prior: np.ndarray,
    damping: float,
    still: np.ndarray | None = None,
) -> tuple[np.ndarray, list[np.ndarray], float, float]:
    """Covariance of all parameters and offsets (scaled), the step of those of each log, the largest of a parameter in
    standard deviations as it would be undamped, of one that isn't held where there is one, and the cost behind that
    step. Damping (Levenberg): what a log shows badly moves in small steps while the rest is still wrong. Parameters
    that make sense above zero only go down by DOWN at most, and the others where they are best beside them; the
    covariance knows no such ends. prior (n_base,): information about nominal. still (n_base,): parameters that stay
    where they are, also as far as the covariance knows; the others go anywhere then."""
    n, found_at = len(X), places(c, records)
    size = n + sum(len(r.origin) for r in records)
    information, slope = np.zeros((size, size)), np.zeros(size)
    information[range(n), range(n)] = prior
    off = (X - c.model.nominal) / c.model.scale
    slope[:n] = prior * off
    cost = float(prior @ off**2)
    if still is not None:
        information[range(n), range(n)] += still * HELD**-2
    for found, r, p, place in zip(linear, records, points, found_at, strict=True):
        information[np.ix_(place, place)] += found.Z[1:, 1:]
        slope[place] += found.Z[1:, 0]
        own = place[n:]
        information[own, own] += 1.0
        away = p.offset / one_count(c, r) - 0.5
        slope[own] += away
        cost += float(found.Z[0, 0] + away @ away)
    covariance = np.linalg.inv(information)
    if not (np.diag(covariance) > 0).all():
        raise NotConverged("joint smoothing lost its numbers: check the log with `excite log check`")
    sigma, told = np.sqrt(np.diag(covariance))[:n], prior < HELD**-2
    lowest = np.full(size, -np.inf)
    if still is None:
        lowest[:n] = np.where(told, _lowest(c.model, X), -np.inf)
    undamped = _above(lowest, -covariance @ slope, information, slope)
    left = float(np.abs(undamped[:n] / sigma)[told if told.any() else slice(None)].max())
    cost += float(2 * slope @ undamped + undamped @ information @ undamped)
    information[range(n), range(n)] += damping
    step = _above(lowest, -np.linalg.solve(information, slope), information, slope)
    return covariance, [step[place] for place in found_at], left, cost


def _lowest(model: Model, X: np.ndarray) -> np.ndarray:
    """Steps (n_base,), scaled, below which no parameter goes in one pass: what makes sense above zero only stays
    there."""
    return np.where(model.positive, -DOWN * X / model.scale, -np.inf)


def _above(lowest: np.ndarray, free: np.ndarray, information: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """The step (n,) to the lowest place that a cost of such information (n, n) and slope (n,) has where no step is
    below its lowest: the free one, where that is nowhere below. That clipped, where information has no root."""
    if (free >= lowest).all() or not np.isfinite(free).all():
        return free
    size = np.sqrt(np.diag(information))
    try:
        root = np.linalg.cholesky(information / np.outer(size, size))
    except np.linalg.LinAlgError:
        return np.maximum(free, lowest)
    target = -scipy.linalg.solve_triangular(root, slope / size, lower=True)
    found = scipy.optimize.lsq_linear(root.T, target, (lowest * size, np.inf), method="bvls", tol=1e-12)
    return np.asarray(found.x / size)


def places(c: Chart, records: Sequence[Record]) -> list[np.ndarray]:
    """Where the parameters and each log's offsets stand among those of all logs."""
    n = len(c.model.scale)
    ends = n + np.cumsum([len(r.origin) for r in records])
    return [np.r_[0:n, end - len(r.origin) : end] for r, end in zip(records, ends, strict=True)]


def in_si(c: Chart, covariance: np.ndarray) -> np.ndarray:
    """The base parameters' part (n_base, n_base) [SI] of a scaled covariance of them and of offsets."""
    scale = c.model.scale
    return np.asarray(covariance[: len(scale), : len(scale)] * np.outer(scale, scale))


def moved(c: Chart, r: Record, p: Point, linear: Linear, move: np.ndarray) -> Point:
    """The point after a step of parameters and offsets, with the states that go with it."""
    x, slope = linear.solved.states(move)
    w = (linear.gain.transpose(0, 2, 1) @ slope[1:, :, None])[:, :, 0] * linear.noise
    offset = move[len(move) - len(r.origin) :]
    s = p.s + x * state_scale(c)
    return Point(s, w, p.offset + offset * one_count(c, r), driven_over(c, s))


def _between(
    here: tuple[list[Point], np.ndarray], there: tuple[list[Point], np.ndarray], share: float
) -> tuple[list[Point], np.ndarray]:
    def mixed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a + share * (b - a)

    points = [
        Point(mixed(a.s, b.s), mixed(a.w, b.w), mixed(a.offset, b.offset), mixed(a.over, b.over))
        for a, b in zip(here[0], there[0], strict=True)
    ]
    return points, mixed(here[1], there[1])

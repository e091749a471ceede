"""Joint smoothing: states, true torques and parameters of a log estimated together (errors in variables).

Maximum likelihood of everything at once: the machine's dynamics hold exactly between samples, the delivered torques are
linear between samples and differ from the measured ones by white noise and an offset, and every sensor has a noise of
its own. Gauss-Newton by multiple shooting: the chain of linearised samples is integrated out (`chain`), which leaves a
small quadratic form in the parameters; its inverse is their covariance, and with no measurement at all, along a motion
alone, the Cramer-Rao bound. Sources: Bryson and Ho, "Applied Optimal Control", ch. 13 (smoothing as a two-point
problem); Bock, "Recent advances in parameter identification techniques for O.D.E.", 1983 (multiple shooting).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from excite import chain, hidden
from excite.estimate import Estimate, NoEstimate, NotIdentifiable
from excite.innovations import Step, excess, innovation_sizes, innovations, sensitivity, steps
from excite.linearise import BATCH, Chart, advance, chart, differentiate
from excite.log import Log
from excite.processing import decimate, derivative
from excite.record import (
    Noise,
    Point,
    Record,
    common_sensors,
    expected,
    first_point,
    noise_notes,
    one_count,
    origins,
    readings,
    record,
    smoothed,
    torque_sensor,
)
from excite.simulate import Motion
from model.machine import Filter
from model.prediction import Model

PRIOR = 3.0  # standard deviation of a parameter before any data, in its scale
PASSES = 15  # at most
HELD = 1e-6  # standard deviation of such a parameter, in its scale
SETTLED = 3  # passes until the states fit the dynamics well enough to tell which these are
UNSEEN = 1.0  # a parameter that a log tells less than this well, in its scale, stays at the machine file's value
DAMPING = 25.0, 0.1  # of the first step, as information in each parameter's scale, and its share from pass to pass
RESUMED = DAMPING[0] * DAMPING[1] ** 2  # damping of a fit that goes on from another
HOPELESS = (8, 10.0)  # after so many passes with a step still so large, in standard deviations
LATELY = 4  # passes whose steps tell how small the last one will be
NEARLY = 1.0  # a step, in standard deviations, at which a fit that runs out of passes is as good as found
TOLERABLE = 0.1  # a step, in standard deviations, at which a fit that runs out of passes is an estimate
CONVERGED = 0.02  # left undone at the end of the iteration, in standard deviations
ENOUGH = 0.2  # likewise with disturbing forces, whose deviations are no promise
# Steps that turn back and hardly shrink are shortened by TURNED; others grow by SHARE up to the whole.
TURNED, SHARE, SLOW = 0.7, 1.15, 0.3
ALONG = 0.9  # cosine between two steps that go the same way
LARGEST_STEP = 0.5  # of a parameter in one pass, relative to its size
# Disturbing forces where the model is not trusted, white from sample to sample, as accelerations [m/s2, rad/s2]: on a
# roller of 11 t they are 500 N. Four and sixteen times that until the innovations are what they should be.
DISTURBANCE = 0.045
DISTURBED = (1.0, 4.0, 16.0)
SUSPECT = 2.5  # mean square of innovations, all or slow ones, that the model can't explain; null logs stay below 1.6
SHORTER = 8  # times that a step is halved
DOUBT = (
    "the log shows something that the model doesn't know, so the intervals do not hold: these values allow for"
    " disturbing forces, and are right as far as it is forces that disturb; run `excite diagnose`"
)
DRAWN = (
    "what this log shows poorly may be off by a deviation more than its interval says, as no estimate without that bias"
    " was found: a drive that moves more tells more"
)
PART = 200  # samples at a time: their chain stays in the processor's cache
# Of the first state about the filtered log. Not wider: where the contact is stiff, at standstill, nothing is seen of
# the first speeds, which are gone within milliseconds, and an iteration would play with them for ever.
SPREAD_SPEED, SPREAD_ANGLE = 0.05, 0.1


class NotConverged(NoEstimate):
    """Joint smoothing found no estimate; the message says how far it came and what to do, `fit` where it stood and
    `step` the next step, in standard deviations."""

    def __init__(self, message: str, fit: Fit | None = None, step: float = np.inf) -> None:
        super().__init__(message)
        self.fit, self.step = fit, step

    @property
    def nearly(self) -> Fit | None:
        """The fit where it stood, if that is as good as found."""
        return self.fit if self.step <= NEARLY else None


@dataclass(frozen=True)
class Linear:
    """One log linearised about a point: its chain in scaled states, and what it reduces to.

    Z: twice the negative log-likelihood is [1 p]' Z [1 p] for steps p of parameters and offsets, scaled. gain
    (N - 1, n, n_u): what a torque error of one standard deviation does to the scaled state. stages: by part of the
    log. H (N, m, n), weight, residual (N, m): the readings; direct (N, m, n_f + n_o): how they move with flaws of
    sensors and offsets. noise (n_u,): standard deviation of the delivered torques' errors [N m]. beats (N, m): how many
    times larger than their weights say the readings' variance is.
    """

    solved: chain.Solved
    Z: np.ndarray
    gain: np.ndarray
    stages: tuple[chain.Stages, ...]
    H: np.ndarray
    weight: np.ndarray
    residual: np.ndarray
    direct: np.ndarray
    noise: np.ndarray
    beats: np.ndarray

    @cached_property
    def innovations(self) -> np.ndarray:
        """Of every reading (N, m), normalised; NaN where unused."""
        return innovations(self)

    @cached_property
    def filter(self) -> list[Step]:
        """The Kalman filter's steps along the log."""
        return steps(self)


@dataclass(frozen=True)
class Fit:
    """Base parameters X (n_base,), their covariance, which were held because nothing shows them, and the trajectories
    of the logs; twice the negative log-likelihood `cost`, and the disturbing forces in units of DISTURBANCE."""

    X: np.ndarray
    covariance: np.ndarray
    unseen: np.ndarray
    points: tuple[Point, ...]
    linear: tuple[Linear, ...]
    cost: float
    disturbed: float

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))


def joint(model: Model, logs: Sequence[Log], filter: Filter) -> Estimate:
    """Base parameters by joint smoothing of all logs, from the machine file's values.

    Encoders that beat with the clock weigh as others do, which keeps the estimate unbiased, and widen its intervals. A
    log that tells too little for that has an estimate that is drawn in, with a note.
    Where the innovations say that the machine does something that the model doesn't know, or the exact dynamics find
    no estimate, the answer is that of a model with white disturbing forces, as large as it takes, with a note. Raises
    NotConverged where that fails too, NotIdentifiable where a torque is missing.
    """
    c = chart(model, common_sensors(model, logs))
    records = [record(c, log, unbiased=True) for log in logs]
    steady = [replace(r, unbiased=False) for r in records]
    starts = [first_point(c, r, log, filter) for r, log in zip(records, logs, strict=True)]
    notes = noise_notes(c, records)
    held = hidden.unmoved(model, logs, filter, slow=False)

    def ways() -> Iterator[tuple[np.ndarray, bool]]:
        yield held, False
        still = held | hidden.unmoved(model, logs, filter, slow=True)
        less = (still & ~held).any()
        if less:
            yield still, False
        # The model with disturbing forces finds its way from further off.
        yield held, True
        if less:
            yield still, True

    trouble: NotConverged | None = None
    loose: Fit | None = None
    doubted: tuple[tuple[bool, float], Fit, np.ndarray, list[str]] | None = None
    for free, further in ways():
        try:
            if further:
                loose = loosely(c, logs, steady, starts, model.nominal, starts, free)
            points, X = (starts, model.nominal) if loose is None else (loose.points, loose.X)
            fit, drawn = _exact(c, records, steady, points, X, starts, free)
        except NotConverged as failed:
            trouble = trouble or failed
            continue
        found = suspects(c, logs, fit)
        if not found:
            return _estimate(c, records, fit, filter, (*notes, *drawn))
        rank = bool(drawn), fit.cost  # costs of one kind of records can be compared
        if doubted is None or rank < doubted[0]:
            doubted = rank, fit, free, found
        if free is held:
            break  # nothing was held back: it is the machine, not the way to it
    said = str(trouble)
    if doubted is not None:
        _, fit, free, found = doubted
        said = "; ".join(found)
        try:
            loose = loosely(c, logs, steady, fit.points, fit.X, starts, free)
        except NotConverged as failed:
            trouble = failed
    if loose is None:
        assert trouble is not None
        raise trouble
    return _estimate(c, records, loose, filter, (*notes, said, DOUBT))


def _exact(
    c: Chart,
    records: Sequence[Record],
    steady: Sequence[Record],
    points: Sequence[Point],
    X: np.ndarray,
    starts: Sequence[Point],
    held: np.ndarray,
) -> tuple[Fit, tuple[str, ...]]:
    """The fit with exact dynamics, unbiased where the log determines it, and what to say of it. Raises NotConverged."""
    trouble: NotConverged | None = None
    for own, said in ((records, ()), (steady, (DRAWN,))):
        try:
            return iterate(c, own, points, X, starts, 0.0, held), said
        except NotConverged as failed:
            if failed.fit is not None and failed.step < TOLERABLE:
                return failed.fit, said
            trouble = trouble or failed
    assert trouble is not None
    raise trouble


def loosely(
    c: Chart,
    logs: Sequence[Log],
    records: Sequence[Record],
    points: Sequence[Point],
    X: np.ndarray,
    starts: Sequence[Point],
    held: np.ndarray,
) -> Fit:
    """The fit with disturbing forces as large as the innovations ask for. Raises NotConverged."""
    trouble: NotConverged | None = None
    fit: Fit | None = None
    for times in DISTURBED:
        try:
            fit = iterate(c, records, points, X, starts, times, held)
        except NotConverged as failed:
            trouble = failed
            continue
        if not suspects(c, logs, fit):
            return fit
        points, X = fit.points, fit.X
    if fit is None:
        assert trouble is not None
        raise trouble
    return fit


def _estimate(c: Chart, records: Sequence[Record], fit: Fit, filter: Filter, notes: tuple[str, ...]) -> Estimate:
    """The answer as `identify` gives it: regressor along the smoothed states, residual of the torques."""
    model = c.model
    weak = fit.unseen | (fit.std > UNSEEN * np.maximum(np.abs(fit.X), model.scale))
    if weak.all():
        raise NotIdentifiable("the log says nothing of any parameter: does the machine move in it?")
    if fit.unseen.any():
        held = ", ".join(n for n, yes in zip(model.base.names, fit.unseen, strict=True) if yes)
        notes = (*notes, f"held at the machine file's value: {held}; the other deviations hold if that value does")
    reasons = {
        name: "this log hardly moves with it: what is known of it is the machine file's value"
        for name, yes in zip(model.base.names, weak, strict=True)
        if yes
    }
    W, Y, errors = [], [], []
    for r, p in zip(records, fit.points, strict=True):
        q, nu, z, u, a = smoothed(c, r, p, fit.X)
        beside = () if model.plain else (u.T, z.T)
        forced = fit.disturbed > 0 and model.plain
        if forced:  # what the forces do is not the model's
            a = derivative(nu.T, float(model.machine.sampling_hz)).T
        rows = model.stacked(q.T, nu.T, a.T, *beside)
        W.append(rows.reshape(-1, len(fit.X)))
        measured, error = np.zeros((2, len(model.rows), len(u)))
        measured[list(model.actuated)], error[list(model.actuated)] = r.torque.T, -p.errors.T
        if forced:
            error = measured - (rows @ fit.X).T
        Y.append(decimate(measured, filter.decimation))
        errors.append(decimate(error, filter.decimation))
    # In blocks that fit the cache: ten times faster than all rows at once.
    R = np.linalg.qr(np.concatenate([np.linalg.qr(w, mode="r") for rows in W for w in np.array_split(rows, 40)]), "r")
    residual = np.concatenate(errors, axis=1)
    covariance = fit.covariance.copy()
    covariance[weak], covariance[:, weak] = np.nan, np.nan
    return Estimate(
        "joint",
        model.base.names,
        model.base.units,
        np.where(weak, np.nan, fit.X),
        covariance,
        float(np.linalg.cond(R)),
        float(
            np.linalg.cond(
                R * np.maximum(np.abs(fit.X), [float(model.machine.scale.get(n, 0.0)) for n in model.base.names])
            )
        ),
        100 * float(np.linalg.norm(residual) / np.linalg.norm(np.concatenate(Y, axis=1))),
        residual,
        int(sum(r.used.sum() for r in records)) - len(fit.X),
        reasons,
        notes,
    )


def cramer_rao(model: Model, motion: Motion, kit: str = "full", X: np.ndarray | None = None) -> np.ndarray:
    """The covariance (n_base, n_base) that a kit's sensors make attainable along a motion: the Cramer-Rao bound of a
    model of them in which every noise is normal.

    The machine file's noise; an encoder tells something as often as it counts, and its edges are off by a tenth of a
    count at least (a perfect encoder on a slow machine tells more than that). A weak prior (300 % of each scale) stays
    in, so that a parameter which the drive doesn't show has a large deviation and not an infinite one.
    Raises ValueError where a sensor has neither noise nor counts.
    """
    X = model.nominal if X is None else np.asarray(X, float)
    sensors = [s for s in model.machine.sensors(kit) if s.kind not in ("x", "y")]
    for s in sensors:
        if s.noise is None and s.counts_per_turn is None:
            raise ValueError(
                f"{model.machine.name}: sensor {s.name}: give noise or counts_per_turn in the machine file"
            )
    c = chart(model, tuple(s.name for s in model.machine.sensors("full") if s in sensors))
    state = np.hstack([motion.q, motion.nu, motion.wheels, motion.memory])[:, c.index]
    counts = np.array([s.resolution is not None for s in c.sensors])
    noise = Noise(
        np.array([float(torque_sensor(model, b.index).noise or 0) for b in model.machine.actuated]),
        np.array([s.resolution or float(s.noise or 0) for s in c.sensors]),
    )
    none = np.zeros((len(state), len(c.sensors)))
    r = Record(c.measured(motion.u, X), none, none, counts, origins(c, counts), noise)
    p = Point(state, np.zeros_like(motion.u[1:]), np.zeros(len(r.origin)))
    linear = linearise(c, expected(c, r, p, motion.u, X), p, state[0], X, 0.0, exact=True)
    assert linear is not None
    information = linear.Z[1:, 1:].copy()
    information[np.diag_indices(len(information))] += np.concatenate(
        [np.full(len(X), PRIOR**-2), np.ones(len(r.origin))]
    )
    return _base(c, np.linalg.inv(information))


def linearise(
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
    left, right = delivered[:-1] + p.w, delivered[1:] + p.w
    if exact:
        defect = np.zeros_like(p.s[1:])
    else:
        defect = advance(c, p.s[:-1], left, right, X) - p.s[1:]
        if not np.isfinite(defect).all():
            return None
    u = delivered + p.errors
    if not r.unbiased:
        left, right = u[:-1], u[1:]
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
            stages.append(chain.Stages(A[own], b[own], C[own], eta, J))
            parts.append(chain.section(stages[-1]))
    # From the last sample nothing leads on.
    J, eta = _seen(c, S[-1:], weight[-1:], residual[-1:], D * unit, flaws[-1:])
    none = np.zeros_like(J)
    stages.append(chain.Stages(none, np.zeros_like(eta), none, eta, J))
    parts.append(chain.section(stages[-1]))
    solved = chain.solve(parts)
    # What the readings say directly of offsets and of flaws of sensors; other parameters act through the states alone.
    direct = np.concatenate([flaws, np.broadcast_to(D * unit, (*residual.shape, n_o))], axis=2)
    flat = np.concatenate([residual[:, :, None], -direct], axis=2) * np.sqrt(weight)[:, :, None]
    flat = flat.reshape(-1, flat.shape[2])
    Z = solved.Z.copy()
    place = np.concatenate([[0], 1 + np.array(c.flawed, int), np.arange(1 + n_p, 1 + n_p + n_o)])
    Z[np.ix_(place, place)] += flat.T @ flat
    return Linear(solved, Z, np.concatenate(gains), tuple(stages), S, weight, residual, direct, noise, beats)


def _known_before(c: Chart, p: Point, first: np.ndarray, columns: int) -> chain.Section:
    """A stage that leads to the first state, from nothing: a guess and how far it may be off."""
    n, scale = c.n, state_scale(c)
    none = np.zeros((1, n, n))
    b = np.zeros((1, n, columns))
    b[0, :, 0] = (first - p.s[0]) / scale
    spread = np.where(np.isfinite(c.known), c.known, np.where(_speeds(c), SPREAD_SPEED, SPREAD_ANGLE))
    return chain.section(chain.Stages(none, b, np.diag((spread / scale) ** 2)[None], np.zeros_like(b), none))


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
    enough: float = ENOUGH,
) -> Fit:
    """Gauss-Newton from points and X; the prior stands about the machine file's values and the states of `starts`.
    Parameters `held` (n_base,) stay at their values. damping: of the first step; passes: at most; enough: a step, in
    standard deviations, at which a fit with disturbing forces is found.

    Raises NotConverged.
    """
    model = c.model
    step, before = np.inf, np.inf
    sizes: list[float] = []
    shorter, here = 0, (list(points), X)
    there = here
    whole, last = 1.0, np.zeros(len(X))
    prior = np.where(held, HELD**-2, PRIOR**-2)
    unseen = held.copy()
    for k in range(passes):
        linear = _all_linear(c, records, there[0], starts, there[1], disturbed)
        if linear is None:
            # Too far: the mass matrix is not positive or a motion can't be integrated.
            shorter += 1
            if shorter > SHORTER or here is there:
                break
            there = _between(here, there, 0.5)
            continue
        here, shorter = there, 0
        points, X = here
        covariance, move, left, cost = _parameters(c, records, linear, points, X, prior, damping)
        if k == SETTLED:
            # Against the estimate as well: a file's value that is far too small must not make a parameter unseen.
            sigma = np.sqrt(np.diag(covariance))[: len(X)]
            unseen |= sigma > UNSEEN * np.maximum(np.abs(X) / model.scale, 1.0)
            if unseen.any():
                # Left free they would go anywhere, and take the mass matrix and the slips with them.
                prior[unseen] = HELD**-2
                covariance, move, left, cost = _parameters(c, records, linear, points, X, prior, damping)
        damping *= DAMPING[1]
        before, step = step, left
        sizes.append(step)
        if k >= HOPELESS[0]:
            shrinking = min((step / sizes[-1 - LATELY]) ** (1 / LATELY), 1.0) if len(sizes) > LATELY else 0.0
            if step > HOPELESS[1] or step * shrinking ** (passes - 1 - k) > NEARLY:
                break
        # Where Gauss-Newton swings about the answer, shorter steps end it.
        turned = move[0][: len(X)] / np.sqrt(np.diag(covariance))[: len(X)]
        swings = turned @ last < 0 and step > SLOW * before
        whole = max(TURNED * min(whole, 1.0), 0.3) if swings else min(SHARE * whole, 1.0)
        creeps = turned @ last > ALONG * np.linalg.norm(turned) * np.linalg.norm(last) and step < 1.0
        if creeps and SLOW * before < step < 0.7 * before:
            whole = 1 / (1 - step / before)  # Aitken: all the steps to come at once
        last = turned
        limit = LARGEST_STEP * np.maximum(np.abs(X) / model.scale, 1.0)
        for m in move:
            m[: len(X)] = np.clip(whole * m[: len(X)], -limit, limit)
            # Amounts that make sense above zero only stay there.
            low = -0.8 * X[model.positive] / model.scale[model.positive]
            m[: len(X)][model.positive] = np.maximum(m[: len(X)][model.positive], low)
        there = (
            [_moved(c, r, p, f, m) for r, p, f, m in zip(records, points, linear, move, strict=True)],
            X + move[0][: len(X)] * model.scale,
        )
        # What this step will have left undone, if steps go on shrinking as they do.
        ratio = min(max(step / before, 1 - whole), 0.9)
        if (step < 10 * CONVERGED and step * ratio / (1 - ratio) < CONVERGED) or (disturbed > 0 and step < enough):
            base = _base(c, _widened(c, records, linear, covariance))
            return Fit(there[1], base, unseen, tuple(there[0]), tuple(linear), cost, disturbed)
    stood = None
    if linear is not None:
        if step < NEARLY:
            covariance = _widened(c, records, linear, covariance)
        stood = Fit(X, _base(c, covariance), unseen, tuple(points), tuple(linear), cost, disturbed)
    raise NotConverged(
        f"joint smoothing found no estimate in {k + 1} passes (last step {step:.3g} standard deviations): check the"
        " log with `excite diagnose`, or start from better values in the machine file",
        stood,
        float(step),
    )


def _all_linear(
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
            found = linearise(c, r, p, begin.s[0], X, disturbed)
        except np.linalg.LinAlgError:  # so far off that the chain has no numbers any more
            found = None
        if found is None:
            return None
        linear.append(found)
    return linear


def _parameters(
    c: Chart,
    records: Sequence[Record],
    linear: Sequence[Linear],
    points: Sequence[Point],
    X: np.ndarray,
    prior: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, list[np.ndarray], float, float]:
    """Covariance of all parameters and offsets (scaled), the step of those of each log, the largest of a parameter in
    standard deviations as it would be undamped, and the cost behind that step. Damping (Levenberg): what a log shows
    badly moves in small steps while the rest is still wrong. prior (n_base,): information about nominal."""
    n, places = len(X), _places(c, records)
    size = n + sum(len(r.origin) for r in records)
    information, slope = np.zeros((size, size)), np.zeros(size)
    information[range(n), range(n)] = prior
    off = (X - c.model.nominal) / c.model.scale
    slope[:n] = prior * off
    cost = float(prior @ off**2)
    for found, r, p, place in zip(linear, records, points, places, strict=True):
        information[np.ix_(place, place)] += found.Z[1:, 1:]
        slope[place] += found.Z[1:, 0]
        own = place[n:]
        information[own, own] += 1.0
        away = p.offset / one_count(c, r) - 0.5
        slope[own] += away
        cost += float(found.Z[0, 0] + away @ away)
    covariance = np.linalg.inv(information)
    if not (np.diag(covariance) > 0).all():
        raise NotConverged("joint smoothing lost its numbers: check the log with `excite diagnose`")
    sigma = np.sqrt(np.diag(covariance))[:n]
    left = float(np.abs((covariance @ slope)[:n] / sigma).max())
    cost -= float(slope @ covariance @ slope)
    information[range(n), range(n)] += damping
    step = -np.linalg.solve(information, slope)
    return covariance, [step[place] for place in places], left, cost


def _places(c: Chart, records: Sequence[Record]) -> list[np.ndarray]:
    """Where the parameters and each log's offsets stand among those of all logs."""
    n = len(c.model.scale)
    ends = n + np.cumsum([len(r.origin) for r in records])
    return [np.r_[0:n, end - len(r.origin) : end] for r, end in zip(records, ends, strict=True)]


def _widened(c: Chart, records: Sequence[Record], linear: Sequence[Linear], covariance: np.ndarray) -> np.ndarray:
    """Covariance of all parameters and offsets (scaled) with what the weights don't count.

    What beats add to the noise goes through the estimate as it was weighed (the sandwich of White, Econometrica 48
    (1980) 817), every innovation on its own. Beats are slow and add more to what only slow motion shows than white
    noise as large would: taken through the filter as white they are too few for mass and inertia. On its own each is
    about right there; friction and offsets on steady drives come out too wide.
    """
    added = np.zeros_like(covariance)
    for found, r, place in zip(linear, records, _places(c, records), strict=True):
        if r.unbiased:
            E = sensitivity(found, c.flawed)
            added[np.ix_(place, place)] += E.T @ (E * excess(found).reshape(-1, 1))
    return np.asarray(covariance + covariance @ added @ covariance)


def _base(c: Chart, covariance: np.ndarray) -> np.ndarray:
    """The base parameters' part (n_base, n_base) [SI] of a scaled covariance of them and of offsets."""
    scale = c.model.scale
    return np.asarray(covariance[: len(scale), : len(scale)] * np.outer(scale, scale))


def _moved(c: Chart, r: Record, p: Point, linear: Linear, move: np.ndarray) -> Point:
    """The point after a step of parameters and offsets, with the states that go with it."""
    x, slope = linear.solved.states(move)
    w = (linear.gain.transpose(0, 2, 1) @ slope[1:, :, None])[:, :, 0] * linear.noise
    offset = move[len(move) - len(r.origin) :]
    return Point(p.s + x * state_scale(c), w, p.offset + offset * one_count(c, r))


def _between(
    here: tuple[list[Point], np.ndarray], there: tuple[list[Point], np.ndarray], share: float
) -> tuple[list[Point], np.ndarray]:
    def mixed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a + share * (b - a)

    points = [
        Point(mixed(a.s, b.s), mixed(a.w, b.w), mixed(a.offset, b.offset))
        for a, b in zip(here[0], there[0], strict=True)
    ]
    return points, mixed(here[1], there[1])


def suspects(c: Chart, logs: Sequence[Log], fit: Fit) -> list[str]:
    """Sensors whose innovations are not what the model and their noise say, each as a line for the report."""
    texts = []
    for log, linear in zip(logs, fit.linear, strict=True):
        for sensor, (size, slow, blocks) in zip(c.sensors, innovation_sizes(linear), strict=True):
            if max(size, slow) > max(SUSPECT, 1 + 6 * np.sqrt(2 / max(blocks, 1.0))):
                texts.append(
                    f"{log.source}: {sensor.name}: innovations are {np.sqrt(size):.2f} times, slow ones"
                    f" {np.sqrt(slow):.2f} times what noise gives"
                )
    return texts

"""The nonlinear program of a test drive: torques that make every parameter speak, under every limit.

Each start goes through a continuation: wide friction and slip transitions and far-apart torque knots first, where the
problem is smooth, then ever closer to the machine as it is. The answer is simulated afresh by the accurate integrator
at the machine's sampling rate; its score and its limits are those of that motion, never the optimiser's own.
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import joblib
import numpy as np

from excite import interior
from excite import objective as _objective
from excite.collocation import Transcription, UnsettledError, settle, transcribe
from excite.limit import InfeasibleError, check, placed
from excite.manoeuvre import Manoeuvre, multisine, scaled
from excite.objective import OBJECTIVES
from excite.simulate import Motion, SimulationError, simulate
from model import prediction
from model.machine import Machine, Problem
from model.prediction import Model

TOLERANCE = 1e-3  # of a limit's range: what the fresh simulation may exceed
MARGIN = 2e-3  # of half a range: what the program keeps from every limit

Report = Callable[[int, int, float], None]


@dataclass(frozen=True)
class Stage:
    """One solve of the continuation: transitions and knots wider by these factors, and the levels that follow."""

    friction: float
    slip: float
    coarse: int
    sharp: float
    barrier: float
    levels: int
    iterations: int


PLAN = (
    Stage(10, 3, 4, 8, 1e-3, 2, 20),
    Stage(10, 3, 2, 16, 3e-4, 1, 15),
    Stage(4, 1.7, 2, 20, 1e-4, 2, 20),
    Stage(2, 1.2, 2, 40, 3e-5, 2, 20),
    Stage(1, 1, 2, 80, 1e-5, 2, 20),
    Stage(1, 1, 1, 100, 1e-5, 4, 20),
)


@dataclass(frozen=True)
class Design:
    """A test drive and what the fresh simulation says of it.

    cond_phi, cond_w: condition numbers over every sample of `motion`; cond_phi_start: the best starting guess's.
    violations: by limit, the excess as a fraction of its range, 0 where kept. scores: the objective of every start as
    it is reported (cond: of Phi), inf where it ended infeasible. complete: False where it was interrupted or cut short
    by its budget.
    """

    objective: str
    manoeuvre: Manoeuvre
    motion: Motion
    cond_phi: float
    cond_w: float
    cond_phi_start: float
    violations: dict[str, float]
    max_violation: float
    scores: tuple[float, ...]
    complete: bool


@dataclass(frozen=True)
class Candidate:
    """What one start came to: torques at the knots (K, n_u) [N m] and the fresh simulation's verdict."""

    manoeuvre: Manoeuvre
    start: np.ndarray
    score: float
    violations: Mapping[str, float]
    guess: float
    complete: bool

    @property
    def excess(self) -> float:
        return max(self.violations.values(), default=0.0)


class Stopped(Exception):
    """The search was asked to stop before anything feasible was found."""


def design(
    model: Model,
    problem: Problem,
    objective: str = "cond",
    starts: int = 2,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Report | None = None,
) -> Design:
    """The best drive of several starts, each from its own random multisine, in parallel processes.

    progress(done, total, best score so far) is called as starts finish. budget_s [s] ends the search early with the
    best feasible drive so far, and so does Ctrl-C. The same seed gives the same design where neither cuts in.
    Raises InfeasibleError with the limit that can't be met and by how much; KeyError for an unknown objective.
    """
    if objective not in OBJECTIVES:
        raise KeyError(f"no objective {objective}, allowed: {', '.join(OBJECTIVES)}")
    if starts < 1:
        raise ValueError(f"starts must be at least 1, got {starts}")
    deadline = None if budget_s is None else time.time() + budget_s
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(starts)]
    best: Candidate | None = None
    scores = [float("inf")] * starts
    guess = float("inf")
    complete = True
    with _interruptible() as stop:
        workers = min(starts, os.cpu_count() or 1)
        run = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")
        tasks = (joblib.delayed(_start)(model, problem, objective, k, s, deadline, stop) for k, s in enumerate(seeds))
        for done, (k, found) in enumerate(run(tasks), 1):
            if found is not None:
                if found.excess <= TOLERANCE:
                    scores[k] = _objective.reported(objective, found.score)
                guess = min(guess, found.guess)
                complete &= found.complete
                if best is None or _rank(found, k) < _rank(best, -1):
                    best = found
            else:
                complete = False
            if progress is not None:
                progress(done, starts, min(scores))
        interrupted = stop.exists()
    if best is None:
        if interrupted:
            raise KeyboardInterrupt
        raise Stopped("nothing feasible was found in the time given: give more time")
    if best.excess > TOLERANCE:
        worst = max(best.violations, key=lambda name: best.violations[name])
        raise InfeasibleError(
            f"no drive found that keeps every limit: {worst} is exceeded by {100 * best.excess:.2f} % of its range"
            f" in the best attempt; widen it, or give another duration or more starts",
            worst,
            best.excess,
        )
    return finish(model, problem, objective, best, guess, tuple(scores), complete)


def finish(
    model: Model,
    problem: Problem,
    objective: str,
    best: Candidate,
    guess: float,
    scores: tuple[float, ...],
    complete: bool,
) -> Design:
    """The design of a candidate: its motion simulated once more, scored and checked."""
    motion = simulate(model, best.manoeuvre.sample(float(model.machine.sampling_hz)), q0=best.start)
    violations = check(model, problem, motion)
    return Design(
        objective,
        best.manoeuvre,
        motion,
        _objective.cond_phi(model, motion),
        _objective.cond_w(model, motion),
        guess,
        violations,
        max(violations.values(), default=0.0),
        scores,
        complete,
    )


def _rank(c: Candidate, k: int) -> tuple[float, float]:
    return (0.0, c.score) if c.excess <= TOLERANCE else (1.0, c.excess)


@contextmanager
def _interruptible() -> Iterator[Path]:
    """A file that appears when Ctrl-C is pressed; the searches look for it and end with what they have."""
    with tempfile.TemporaryDirectory(prefix="excite-") as folder:
        stop = Path(folder) / "stop"
        if threading.current_thread() is not threading.main_thread():
            yield stop
            return
        before = signal.signal(signal.SIGINT, lambda *_: stop.touch())
        try:
            yield stop
        finally:
            signal.signal(signal.SIGINT, before)


def _start(
    model: Model, problem: Problem, name: str, number: int, seed: int, deadline: float | None, stop: Path
) -> tuple[int, Candidate | None]:
    if threading.current_thread() is threading.main_thread() and os.getpid() != os.getppid():
        signal.signal(signal.SIGINT, lambda *_: stop.touch() if stop.parent.exists() else None)

    def over() -> bool:
        return stop.exists() or (deadline is not None and time.time() > deadline)

    return number, None if over() else search(model, problem, name, seed, over)


def search(model: Model, problem: Problem, name: str, seed: int, over: Callable[[], bool]) -> Candidate | None:
    """One start through the continuation; `over` tells when to stop. None where nothing could be simulated."""
    guess, motion = _guess(model, problem, seed)
    first = _objective.cond_phi(model, motion)
    sizes = _sizes(model, problem, motion)
    torque, times = guess.torque, guess.times
    states: np.ndarray | None = None
    nodes: np.ndarray | None = None
    best: Candidate | None = None
    pose: np.ndarray | None = None
    full = len(guess.times) - 1
    for number, stage in enumerate(PLAN):
        softer = soften(model, stage.friction, stage.slip)
        intervals = max(4, round(full / stage.coarse))
        tr = transcribe(softer, problem, sizes, intervals, with_pose=pose is not None)
        knots = np.linspace(0, float(problem.duration_s), intervals + 1)
        at = (np.arange(intervals)[:, None] + tr.place) * tr.knot
        U = Manoeuvre(times, torque).at(knots) / tr.torque_scale
        U[0] = U[-1] = 0.0
        start = _origin(tr, pose, model)
        if states is None or nodes is None or states.shape[1] != tr.n_z:
            Z = _read(tr, model, motion, at, start)
        else:
            Z = np.stack([np.interp(at, nodes, states[:, i]) for i in range(tr.n_z)], axis=-1)
        try:
            Z = settle(tr, start, U, Z)
        except UnsettledError:
            return best
        task = interior.Task(
            name,
            np.full((intervals, tr.nodes, len(tr.limit_names)), MARGIN),
            np.full((intervals, len(tr.control_names)), 1e-4),
            np.array([name.startswith("lane") for name in tr.limit_names], bool),
        )
        watch = _watch(over)
        if number == 0:
            Z, U = _project(tr, task, start, Z, U, watch)
        point = interior.begin(tr, task, start, Z, U, stage.barrier, 0.05 if number == 0 else 1e-3)
        levels = tuple(
            interior.Level(stage.sharp * 2**i, stage.barrier / 3**i, 0.2 / (stage.sharp * 2**i), stage.iterations)
            for i in range(stage.levels)
        )
        point, _ = interior.minimise(tr, task, point, levels, watch)
        torque, times = point.U * tr.torque_scale, knots
        nodes, states = at.ravel(), point.Z.reshape(-1, tr.n_z)
        try:
            found, motion = _verdict(model, problem, name, Manoeuvre(times, torque), first, number + 1 == len(PLAN))
        except SimulationError:
            return best
        if best is None or _rank(found, 0) <= _rank(best, 0) or found.complete:
            best = found if best is None or found.excess <= max(TOLERANCE, best.excess) else best
        if over():
            return best
        lane = max((v for limit, v in found.violations.items() if limit.startswith("lane")), default=0.0)
        if pose is not None or (stage.friction <= 4 and lane > 0):
            pose = found.start
    return best


def _verdict(
    model: Model, problem: Problem, name: str, manoeuvre: Manoeuvre, guess: float, complete: bool
) -> tuple[Candidate, Motion]:
    """The fresh simulation of a manoeuvre, placed on the lane as well as can be."""
    torque = manoeuvre.sample(float(model.machine.sampling_hz))
    motion = simulate(model, torque)
    start = placed(model, problem, motion)
    motion = simulate(model, torque, q0=start)
    P = _objective.phi(model, motion)
    score = _objective.value(name, P.T @ P)
    return Candidate(manoeuvre, start, score, check(model, problem, motion), guess, complete), motion


def _project(
    tr: Transcription, task: interior.Task, start: np.ndarray, Z: np.ndarray, U: np.ndarray, watch: interior.Watch
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest torques that keep every limit and come to rest."""
    near = replace(task, objective=None, pull=1.0, goal=U)
    point = interior.begin(tr, near, start, Z, U, 1e-3, 0.05)
    point, _ = interior.minimise(tr, near, point, (interior.Level(1.0, 1e-3, 1e-3, 40),), watch)
    return point.Z, point.U


def _watch(over: Callable[[], bool]) -> interior.Watch:
    def watch(progress: interior.Progress, point: interior.Point, state: interior.State) -> bool:
        return over()

    return watch


def _guess(model: Model, problem: Problem, seed: int) -> tuple[Manoeuvre, Motion]:
    """A random multisine, as large as the limits on the motion allow."""
    wish = multisine(model, problem, seed)
    rate = float(model.machine.sampling_hz)
    for factor in 0.85 ** np.arange(30):
        tried = scaled(wish, float(factor))
        try:
            motion = simulate(model, tried.sample(rate))
        except SimulationError:
            continue
        excess = check(model, problem, motion)
        if all(v == 0 for k, v in excess.items() if not k.startswith(("rest", "lane"))):
            break
    return tried, motion


def _sizes(model: Model, problem: Problem, motion: Motion) -> dict[str, float]:
    """Typical size of every coordinate and velocity (c and c') in a motion; of the pose, half the lane."""
    sizes = {}
    for k, c in enumerate(model.coordinates):
        sizes[c] = max(1e-3, 2 * float(np.sqrt((motion.q[:, k] ** 2).mean())))
        sizes[c + "'"] = max(1e-3, 2 * float(np.sqrt((motion.nu[:, k] ** 2).mean())))
    if model.machine.planar:
        x, y, heading = model.machine.body[0].coordinates
        sizes |= {x: problem.lane_m[0] / 2, y: problem.lane_m[1] / 2, heading: 1.0}
    return sizes


def _origin(tr: Transcription, pose: np.ndarray | None, model: Model) -> np.ndarray:
    start = np.zeros(tr.n_z)
    if pose is not None:
        for k, c in enumerate(tr.state_names):
            if c in model.coordinates:
                start[k] = pose[model.coordinates.index(c)] / tr.state_scale[k]
    return start


def _read(tr: Transcription, model: Model, motion: Motion, at: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Scaled node states (K, J, n_z) of a simulated motion."""
    names = [*model.coordinates, *[c + "'" for c in model.coordinates]]
    every = np.hstack([motion.q, motion.nu])
    columns = [every[:, names.index(s)] for s in tr.state_names]
    return np.stack([np.interp(at, motion.t, x) for x in columns], axis=-1) / tr.state_scale


def soften(model: Model, friction: float, slip: float) -> Model:
    """The same model with transitions of friction and slip at standstill wider by these factors."""
    if friction == 1 and slip == 1:
        return model
    bodies = []
    for body in model.machine.body:
        changed: dict[str, object] = {}
        if body.friction is not None:
            wider = body.friction.smoothing.model_copy(update={"value": friction * float(body.friction.smoothing)})
            changed["friction"] = body.friction.model_copy(update={"smoothing": wider})
        if body.contact is not None:
            wider = body.contact.v_eps.model_copy(update={"value": slip * float(body.contact.v_eps)})
            changed["contact"] = body.contact.model_copy(update={"v_eps": wider})
        bodies.append(body.model_copy(update=changed))
    machine: Machine = model.machine.model_copy(update={"body": tuple(bodies)})
    return replace(prediction.build(machine), nominal=model.nominal, scale=model.scale)

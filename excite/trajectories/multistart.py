"""Search for an excitation trajectory from several random starts in parallel processes.

Every start goes through the first stages of `continuation`, the best of them through the others.
"""

from __future__ import annotations

import itertools
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import joblib
import numpy as np

from excite.errors import InfeasibleError, MachineError, SolverError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, simulate
from excite.text import format_percent
from excite.trajectories import composite_objective, objective as objectives
from excite.trajectories.clearance import random_poses
from excite.trajectories.composite_objective import SIGMA_MAX, CompositeObjective
from excite.trajectories.continuation import (
    SCREENING_STAGES,
    SOLVERS,
    STAGES,
    SearchState,
    rank,
    refine,
    repair,
    run_stages,
    selection_score,
    start_from_drive,
    start_from_multisine,
)
from excite.trajectories.excitation import Manoeuvre
from excite.trajectories.lane import move_motion, place_along_lane
from excite.trajectories.limits import LIGHTEN, TOLERANCE, describe_excess, describe_overload, end_poses


class BestSoFar(float):
    """The best score so far, inf without a drive within all limits; `doing`: what is tried, and what is wrong."""

    doing: str

    def __new__(cls, score: float, doing: str = "") -> Self:
        made = super().__new__(cls, score)
        made.doing = doing
        return made


Report = Callable[[int, int, BestSoFar], None]
NO_START_YET = "no start has come through its first stage yet"
OVERLOAD_POSES = 1000  # random poses in which gravity is looked at where a drive exceeds a torque limit
MIN_LATER_STEPS = len(STAGES) - SCREENING_STAGES + 1  # progress reports of a selected start, at least


@dataclass(frozen=True)
class Design:
    """An excitation trajectory and the results of its fresh simulation.

    cond_phi, cond_w: condition numbers over every sample of `motion`. cond_phi_start: of the best random start.
    violations: excess by limit, as a fraction of its range, 0 where kept. scores: the objective of every start as
    reported, inf for an infeasible one. random: the drives that the search began from. complete: False if stopped or
    cut short by the budget; stopped: by Ctrl-C. solver: a name in SOLVERS; iterations: of the solver, from the start
    that won to this drive. trajectory: kind of joint motion, a name in TRAJECTORIES, None for torques; limits of a
    joint motion are also judged between samples. followed: excess over them where a position controller follows the
    motion, None if that was not simulated.
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
    solver: str = "own"
    iterations: int = 0
    trajectory: str | None = None
    followed: dict[str, float] | None = None
    random: tuple[Manoeuvre | Motion, ...] = ()
    stopped: bool = False

    @property
    def drive(self) -> Manoeuvre | Motion:
        """What a later search goes on from: the torques, of an arm its motion."""
        return self.manoeuvre if self.trajectory is None else self.motion


def design(
    model: Model,
    problem: Problem,
    objective: str | CompositeObjective = "cond",
    starts: int = 2,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Report | None = None,
    warm: Sequence[Manoeuvre] = (),
    solver: str = "own",
) -> Design:
    """Design an excitation trajectory: the best of several random starts.

    objective: a name in OBJECTIVES or the result of `compose_objective`.
    starts: random multisines to start from; the best third (two at least) goes through all stages.
    budget_s [s]: ends the search with the best feasible drive so far; half of it is for the first stages. Ctrl-C does
        so too, and raises KeyboardInterrupt if there is no such drive yet; it says why.
    progress(done, total, best score): called as stages finish; the score is a `BestSoFar`.
    warm: drives that start at the last stages; `starts` may then be 0.
    solver: a name in SOLVERS.

    The same seed gives the same design unless the search is cut short.

    Raises InfeasibleError with the limit and its excess, SolverError if the solver ended without an optimum from every
    start, KeyError for an unknown objective or solver, MachineError for a machine whose drives do not hold its weight.
    """
    if solver not in SOLVERS:
        raise KeyError(f"no solver {solver}, allowed: {', '.join(SOLVERS)}")
    composite = composite_objective.compose_objective(model, objective) if isinstance(objective, str) else objective
    if starts < (0 if warm else 1):
        raise ValueError(f"starts must be at least 1, got {starts}")
    overload = "" if model.follows_positions else describe_overload(model, np.array(end_poses(model, problem)))
    if overload:
        raise MachineError(f"{model.machine.name}: no drive can hold it: {overload}; {LIGHTEN}")
    now = time.time()
    half, deadline = (None, None) if budget_s is None else (now + budget_s / 2, now + budget_s)
    seeds = np.random.SeedSequence(seed).generate_state(starts)
    kept = min(starts, max(2, -(-starts // 3))) + len(warm)
    guesses: list[int | Manoeuvre] = [*(int(s) for s in seeds), *warm]
    states: dict[int, SearchState] = {}
    with (
        stop_file() as stop,
        progress_reports(stop.parent, progress, starts * SCREENING_STAGES + kept * MIN_LATER_STEPS, len(guesses)),
        joblib.parallel_config("loky", inner_max_num_threads=1),
    ):
        # loky even for one start: only its workers can limit the threads of the linear algebra
        run = joblib.Parallel(n_jobs=process_count(), return_as="generator_unordered")
        call = joblib.delayed(_run_start)

        def gather(calls: Iterator[Any]) -> None:
            with ignore_killed_workers(stop):
                for state in run(calls):
                    if state is not None:
                        states[state.number] = state

        gather(call(model, problem, composite, solver, k, g, None, half, stop) for k, g in enumerate(guesses))
        ranked = sorted(states.values(), key=lambda t: (t.number < starts, *_screening_order(t)))
        chosen = ranked[:kept]
        gather(call(model, problem, composite, solver, t.number, 0, t, deadline, stop) for t in chosen)
        interrupted = stop.exists()
    if not states:
        raise KeyboardInterrupt(NO_START_YET)
    best = min(states.values(), key=lambda t: (t.failure is not None, *rank(t.best), t.number))
    complete = len(states) == len(guesses) and all(states[t.number].complete for t in chosen)
    if not best.best.feasible and interrupted:
        raise KeyboardInterrupt(no_drive_yet(model, best.best.violations))
    if best.failure is not None:
        raise _no_optimum(model, solver, best, len(guesses))
    if not best.best.feasible:
        raise infeasible_error(model, composite, best.best.violations, complete)
    drive = best.best
    reported = {k: reported_score(composite, t.best.score, t.best.excess) for k, t in states.items()}
    motion = simulate(model, drive.manoeuvre.sample(float(model.machine.sampling_hz)), q0=drive.start)
    along = place_along_lane(model, problem, [motion])
    motion = motion if along is None else move_motion(model, motion, along)
    return Design(
        composite.name,
        drive.manoeuvre,
        motion,
        objectives.cond_phi(model, motion),
        objectives.cond_w(model, motion),
        min(t.start_cond_phi for t in states.values()),
        dict(drive.violations),
        drive.excess,
        tuple(reported.get(k, float("inf")) for k in range(len(guesses))),
        complete,
        solver,
        best.iterations,
        random=tuple(states[k].begun_from for k in range(starts) if k in states),
        stopped=interrupted,
    )


@contextmanager
def ignore_killed_workers(stop: Path) -> Iterator[None]:
    """Ignore workers that Ctrl-C kills before they handle it."""
    try:
        yield
    except BrokenProcessPool:
        if not stop.exists():
            raise


def process_count() -> int:
    """Return the number of parallel processes: one per core that a container may use, two at least."""
    return max(2, joblib.cpu_count())


def _screening_order(state: SearchState) -> tuple[bool, float, int]:
    """Order screened starts: those whose solver found its optima first, then by score and excess."""
    return state.failure is not None, selection_score(state.latest), state.number


def _no_optimum(model: Model, solver: str, best: SearchState, starts: int) -> SolverError:
    """Build the error of a solver that ended without an optimum from every start."""
    name = max(best.latest.violations, key=lambda limit: best.latest.violations[limit])
    excess = best.latest.excess
    where = f", where {describe_excess(model, name, excess)}" if not best.latest.feasible else ""
    return SolverError(
        f"{solver} found no optimum from any of the starts ({starts}), the best ended with {best.failure}{where};"
        " give more starts or another seed, or take the other solver"
    )


def no_drive_yet(model: Model, violations: Mapping[str, float]) -> str:
    """Say why there is no drive yet: the limit that is exceeded most, and by how much."""
    name = max(violations, key=lambda limit: violations[limit])
    return f"no drive within all limits yet: {describe_excess(model, name, violations[name])}"


def infeasible_error(
    model: Model, objective: CompositeObjective, violations: Mapping[str, float], complete: bool
) -> InfeasibleError:
    """Build the error that names the limit with the largest excess."""
    name = max(violations, key=lambda limit: violations[limit])
    excess = violations[name]
    cut = "the search was cut short, give more time"
    said = f"no drive found that keeps every limit: {describe_excess(model, name, excess)} in the best attempt"
    more = "give another duration or more starts"
    change = more if name.startswith("rest ") else f"widen it, or {more}"
    overload = describe_overload(model, random_poses(model, OVERLOAD_POSES)) if name.startswith("torque u") else ""
    if name == SIGMA_MAX and objective.sigma_max is not None:
        said = (
            f"no drive found that is accurate enough: {name} {objective.sigma_max:g} % is exceeded by"
            f" {format_percent(100 * excess)}, the worst parameter comes out at"
            f" {format_percent(objective.sigma_max * (1 + excess), 3)} in the best attempt"
        )
        change = "allow more, or give a longer duration or more starts"
    elif overload:
        said += f": {overload}"
        change = cut = f"narrow position_low and position_high to poses that it can hold, or {LIGHTEN}"
    return InfeasibleError(f"{said}; {change if complete else cut}", name, excess)


def reported_score(objective: CompositeObjective, score: float, excess: float) -> float:
    """Return a score as people read it, inf for a drive that exceeds a limit."""
    return objectives.reported_value(objective.name, score) if excess <= TOLERANCE else float("inf")


@contextmanager
def stop_file() -> Iterator[Path]:
    """Yield the path of a file that appears on Ctrl-C; searches look for it and stop."""
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


@contextmanager
def progress_reports(folder: Path, progress: Report | None, total: int, starts: int) -> Iterator[None]:
    """Call `progress` as workers write files START-STAGE with their best score and what exceeds a limit."""
    if progress is None:
        yield
        return
    ended = threading.Event()
    scores: dict[str, tuple[float, float, str]] = {}  # score, largest excess, and what it is

    def look() -> None:
        for path in folder.glob("*-*"):
            if path.name not in scores:
                score, excess, over = path.read_text(encoding="utf-8").split("\n")
                scores[path.name] = float(score), float(excess), over
                best, _, over = min(scores.values())
                number, _, stage = path.name.partition("-")
                doing = f"start {int(number) + 1} of {starts}, stage {int(stage) + 1} done"
                note = doing if np.isfinite(best) else f"{doing}; {over}"
                progress(min(len(scores), total), total, BestSoFar(best, note))

    def watch() -> None:
        while not ended.wait(0.2):
            look()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        look()


def begin_worker(stop: Path, deadline: float | None) -> Callable[[], bool]:
    """Let Ctrl-C make the stop file; return a function that tells if a worker must stop, also past a deadline."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, lambda *_: stop.touch() if stop.parent.exists() else None)
    return lambda: stop.exists() or (deadline is not None and time.time() > deadline)


def write_stage(
    model: Model, stop: Path, number: int, stage: int, score: float, violations: Mapping[str, float]
) -> None:
    """Write the best score of a start after a stage beside the stop file, for `progress_reports`.

    violations: of the drive that has this score.
    """
    excess, over = max(violations.values(), default=0.0), no_drive_yet(model, violations) if violations else ""
    fresh = stop.parent / f".{number}"
    fresh.write_text(f"{score!r}\n{excess!r}\n{over}", encoding="utf-8")
    fresh.replace(stop.parent / f"{number}-{stage}")


def _run_start(
    model: Model,
    problem: Problem,
    objective: CompositeObjective,
    solver: str,
    number: int,
    guess: int | Manoeuvre,
    state: SearchState | None,
    deadline: float | None,
    stop: Path,
) -> SearchState | None:
    """Run the first stages from a seed or a drive, or the later ones from `state`, in a worker process.

    Returns None if time is up before the start begins; start 0 always runs.
    """
    should_stop = begin_worker(stop, deadline)
    stages = itertools.count(0 if state is None else SCREENING_STAGES)

    def report_stage(state: SearchState) -> None:
        score = reported_score(objective, state.best.score, state.best.excess)
        write_stage(model, stop, number, next(stages), score, state.best.violations)

    if state is None:
        if number > 0 and should_stop():
            return None
        if isinstance(guess, Manoeuvre):
            return start_from_drive(model, problem, objective, number, guess, solver)
        return run_stages(
            model,
            problem,
            objective,
            start_from_multisine(model, problem, objective, number, guess, solver),
            STAGES[:SCREENING_STAGES],
            should_stop,
            report_stage,
        )
    state = run_stages(model, problem, objective, state, STAGES[SCREENING_STAGES:], should_stop, report_stage)
    if not should_stop():
        state = refine(model, problem, objective, state, should_stop, report_stage)
    if not should_stop():
        state = replace(repair(model, problem, objective, state, should_stop), complete=not should_stop())
    report_stage(state)
    return state

"""The search for a test drive: torques that make every parameter speak, under every limit.

Many starts, each carried through the continuation (`continuation`) in a process of its own: all of them through the
first stages, the most promising to the end.
"""

from __future__ import annotations

import itertools
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from excite.errors import InfeasibleError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, simulate
from excite.text import format_percent
from excite.trajectories import composite_objective as aims, objective as objectives
from excite.trajectories.composite_objective import SIGMA_MAX, Aim
from excite.trajectories.continuation import (
    PLAN,
    SCOUTS,
    Candidate,
    Track,
    depart,
    promise,
    rank,
    refine,
    repair,
    resume,
    search,
)
from excite.trajectories.excitation import Manoeuvre

Report = Callable[[int, int, float], None]
LATER = len(PLAN) - SCOUTS + 1  # pieces of work of a start that is chosen, at least


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


def design(
    model: Model,
    problem: Problem,
    objective: str | Aim = "cond",
    starts: int = 2,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Report | None = None,
    warm: Sequence[Manoeuvre] = (),
) -> Design:
    """The best drive of several starts, each from its own random multisine, in parallel processes.

    Every start goes through the first stages, the most promising third (two at least) to the end. objective: a name, or
    an `aim` that puts it together with an accuracy to keep, what is known before, or other machines. warm: drives to
    start from as well, which go straight to the last stages; starts may be 0 then.
    progress(done, total, best score so far) is called as stages finish. budget_s [s], half of it for the
    first stages, ends the search early with the best feasible drive so far, and so does Ctrl-C (KeyboardInterrupt
    where there is none yet). The same seed gives the same design where neither cuts in.

    Raises InfeasibleError with the limit that can't be met and by how much, KeyError for an unknown objective.
    """
    aim = aims.aim(model, objective) if isinstance(objective, str) else objective
    if starts < (0 if warm else 1):
        raise ValueError(f"starts must be at least 1, got {starts}")
    now = time.time()
    half, deadline = (None, None) if budget_s is None else (now + budget_s / 2, now + budget_s)
    seeds = np.random.SeedSequence(seed).generate_state(starts)
    kept = min(starts, max(2, -(-starts // 3))) + len(warm)
    guesses: list[int | Manoeuvre] = [*(int(s) for s in seeds), *warm]
    tracks: dict[int, Track] = {}
    with (
        _interruptible() as stop,
        _watching(stop.parent, progress, starts * SCOUTS + kept * LATER),
        joblib.parallel_config("loky", inner_max_num_threads=1),
    ):
        # loky even for one start: only there can the number of threads of the linear algebra be set
        run = joblib.Parallel(n_jobs=processes(), return_as="generator_unordered")
        call = joblib.delayed(_carry)

        def gather(calls: Iterator[Any]) -> None:
            with _broken_off(stop):
                for track in run(calls):
                    if track is not None:
                        tracks[track.number] = track

        gather(call(model, problem, aim, k, g, None, half, stop) for k, g in enumerate(guesses))
        ranked = sorted(tracks.values(), key=lambda t: (t.number < starts, promise(t.latest), t.number))
        chosen = ranked[:kept]
        gather(call(model, problem, aim, t.number, 0, t, deadline, stop) for t in chosen)
        interrupted = stop.exists()
    if not tracks:
        raise KeyboardInterrupt
    best = min(tracks.values(), key=lambda t: (*rank(t.best), t.number))
    complete = len(tracks) == len(guesses) and all(tracks[t.number].complete for t in chosen)
    if not best.best.feasible:
        if interrupted:
            raise KeyboardInterrupt
        raise _infeasible(aim, best.best, complete)
    drive = best.best
    motion = simulate(model, drive.manoeuvre.sample(float(model.machine.sampling_hz)), q0=drive.start)
    return Design(
        aim.name,
        drive.manoeuvre,
        motion,
        objectives.cond_phi(model, motion),
        objectives.cond_w(model, motion),
        min(t.guess for t in tracks.values()),
        dict(drive.violations),
        drive.excess,
        tuple(_score(aim, tracks[k].best) if k in tracks else float("inf") for k in range(len(guesses))),
        complete,
    )


@contextmanager
def _broken_off(stop: Path) -> Iterator[None]:
    """Workers that Ctrl-C kills before they listen to it are no error."""
    try:
        yield
    except BrokenProcessPool:
        if not stop.exists():
            raise


def processes() -> int:
    """In how many processes drives are sought: one on every core, two at least."""
    return max(2, os.cpu_count() or 1)


def _infeasible(aim: Aim, best: Candidate, complete: bool) -> InfeasibleError:
    """What to say where no start ended inside the limits: which one can't be met, and by how much."""
    name = max(best.violations, key=lambda limit: best.violations[limit])
    excess = best.excess
    cut = "the search was cut short, give more time"
    if name == SIGMA_MAX and aim.sigma_max is not None:
        return InfeasibleError(
            f"no drive found that is accurate enough: {name} {aim.sigma_max:g} % is exceeded by"
            f" {format_percent(100 * excess)}, the worst parameter comes out at"
            f" {format_percent(aim.sigma_max * (1 + excess), 3)} in the best attempt;"
            f" {'allow more, or give a longer duration or more starts' if complete else cut}",
            name,
            excess,
        )
    return InfeasibleError(
        f"no drive found that keeps every limit: {name} is exceeded by {100 * excess:.2f} % of its range in the"
        f" best attempt; {'widen it, or give another duration or more starts' if complete else cut}",
        name,
        excess,
    )


def _score(aim: Aim, c: Candidate) -> float:
    return objectives.reported(aim.name, c.score) if c.feasible else float("inf")


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


@contextmanager
def _watching(folder: Path, progress: Report | None, total: int) -> Iterator[None]:
    """Reports as the searches leave word of a stage that is done: a file START-STAGE with the best score so far."""
    if progress is None:
        yield
        return
    ended = threading.Event()
    scores: dict[str, float] = {}

    def look() -> None:
        for path in folder.glob("*-*"):
            if path.name not in scores:
                scores[path.name] = float(path.read_text(encoding="ascii"))
                progress(min(len(scores), total), total, min(scores.values()))

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


def _carry(
    model: Model,
    problem: Problem,
    aim: Aim,
    number: int,
    guess: int | Manoeuvre,
    track: Track | None,
    deadline: float | None,
    stop: Path,
) -> Track | None:
    """In a worker: a start (a seed or a drive) through the first stages, or one that was chosen through the others.

    None for a start that comes too late; the first one never does.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, lambda *_: stop.touch() if stop.parent.exists() else None)
    stages = itertools.count(0 if track is None else SCOUTS)

    def over() -> bool:
        return stop.exists() or (deadline is not None and time.time() > deadline)

    def tell(track: Track) -> None:
        fresh = stop.parent / f".{number}"
        fresh.write_text(repr(_score(aim, track.best)), encoding="ascii")
        fresh.replace(stop.parent / f"{number}-{next(stages)}")

    if track is None:
        if number > 0 and over():
            return None
        if isinstance(guess, Manoeuvre):
            return resume(model, problem, aim, number, guess)
        return search(model, problem, aim, depart(model, problem, aim, number, guess), PLAN[:SCOUTS], over, tell)
    track = search(model, problem, aim, track, PLAN[SCOUTS:], over, tell)
    if not over():
        track = refine(model, problem, aim, track, over, tell)
    if not over():
        track = replace(repair(model, problem, aim, track, over), complete=not over())
    tell(track)
    return track

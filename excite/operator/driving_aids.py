"""Turn a design into the driver's sheet, the driver's page and their numbers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from excite import trajectories
from excite.errors import SimulationError, UndrivableError
from excite.model import Model
from excite.model.machine import Problem
from excite.operator import ground, page, sheet
from excite.operator.ground import PEOPLE, DriveQuality, Trace
from excite.operator.server import GrowingLog, serve_page
from excite.operator.sheet import Sheet
from excite.simulation import Motion
from excite.text import format_number, format_percent
from excite.trajectories import SavedDesign

PAGE = "driver.html"
SECONDS_PER_PHASE = (4.0, 3.0, 2.5)  # mean lengths of phases to try if no number of phases is given [s]; chosen
MAX_LOSS_RATIO = 1.2  # error product over the best one, up to which fewer phases are preferred; chosen
NEAR_STOP = 0.8  # share of a steered joint's stop from which the sheet warns; chosen
SLOWER_SHARES = (0.95, 0.9, 0.8)  # of a trace's speeds, to try if people exceed limits; chosen
Progress = Callable[[int, int, float | None], None]

PLAYED_BACK, TRACED, PHASED = "torques played back", "a person on the design's own trace", "a person on these phases"


def prepare(
    design: SavedDesign,
    most: int | None = None,
    shortest: float = 2.0,
    seed: int = 0,
    progress: Progress | None = None,
    needed: float | None = None,
) -> Sheet:
    """Make the sheet of a design: phases, paths, ground, warnings, and the accuracy that a person keeps.

    most: largest number of phases, None to choose. shortest [s]: shortest phase. needed [%]: largest standard deviation
    of any parameter that is good enough, the design's `sigma_max` if it has one.
    Raises UndrivableError for a machine that nobody drives, SimulationError if no person can follow the phases.
    """
    model, motion, problem = design.model, design.motion, design.problem
    if design.summary.get("trajectory"):
        raise UndrivableError(
            f"{model.machine.name}: an arm follows the joint positions in profile.csv, no person drives it"
        )
    if problem is None:
        raise UndrivableError(f"{model.machine.name}: has no problem {design.summary.get('problem')}, design again")
    made = design.summary.get("driver") if most is None else None  # of `excite design --driver`: phases already
    if made is not None:
        choices = [ground.trace_from_table(model, made["phases"])]
        free = made["played_back"]
        played = DriveQuality(free["cond_phi"], free["worst_percent"], free["worst_parameter"], free["median_percent"])
    else:
        counts = [most] if most is not None else [round(motion.t[-1] / pace) for pace in SECONDS_PER_PHASE]
        choices = [ground.trace_from_motion(model, motion, shortest, max(2, n)) for n in counts]
        choices = [c for k, c in enumerate(choices) if len(c) not in [len(b) for b in choices[:k]]]
        played = ground.rate_motion(model, motion)
    done, total = 0, (1 if made is not None else 2) * PEOPLE + len(choices)

    def person(way: Trace, who: int) -> Motion:
        nonlocal done
        driven = ground.follow_trace(model, way, None, seed + who, motion.q[0])
        done += 1
        if progress is not None:
            progress(done, total, None)
        return driven

    def people(way: Trace) -> tuple[Motion, ...]:
        return tuple(person(way, k) for k in range(PEOPLE))

    trace = choices[0]
    if len(choices) > 1:  # the fewest phases with about the best accuracy
        lost = [_error_product(ground.rate_motion(model, person(c, 0))) for c in choices]
        trace = next(c for c, x in zip(choices, lost, strict=True) if x <= MAX_LOSS_RATIO * min(lost))

    scores: list[tuple[str, DriveQuality]] = [(PLAYED_BACK, played)]
    if made is None:
        try:
            own = ground.trace_as_designed(model, motion)
            scores.append((TRACED, ground.middle_quality([ground.rate_motion(model, m) for m in people(own)])))
        except SimulationError:  # nobody can follow the unsmoothed trace; the phases may still work
            done = PEOPLE
    motions = ground.place_in_lane(model, problem, people(trace))
    scores.append((PHASED, ground.middle_quality([ground.rate_motion(model, m) for m in motions])))
    room = ground.touched_ground(model, motions)
    lane = problem.lane
    over = _exceeded_limits(model, problem, motions)
    said = verdict(
        scores[0][1],
        scores[-1][1],
        str(design.summary.get("objective")),
        by_hand=design.summary.get("driver") is not None,
        fewer=most is not None,
        over=over,
        slower=_slower_drive(model, problem, trace, motion.q[0], seed) if over else None,
        asked=design.summary.get("sigma_max") if needed is None else needed,
    )
    return Sheet(
        design.title,
        model,
        trace,
        motions,
        room,
        lane,
        tuple(_warnings(model, trace, motions, room, lane)),
        tuple(scores),
        said,
    )


def _error_product(score: DriveQuality) -> float:
    """Return the product of worst and median error."""
    return score.worst_percent * score.median_percent


def verdict(
    played: DriveQuality,
    person: DriveQuality,
    objective: str = "accuracy",
    *,
    by_hand: bool = False,
    fewer: bool = False,
    over: Mapping[str, float] | None = None,
    slower: tuple[float, DriveQuality] | None = None,
    asked: float | None = None,
) -> str:
    """Say in a sentence what a person keeps of a design, and what to do if that is too little.

    by_hand: the design was made with `--driver`. fewer: `--phases` replaced its phases. over: limits that people
    exceed, as shares of their range. slower: share of the speeds at which simulated people keep them, and what they
    attain then. asked [%]: largest standard deviation that is good enough; without it the torques played back are the
    measure. Advice that nothing has simulated is called untried.
    """
    worst, median = person.worst_percent / played.worst_percent, person.median_percent / played.median_percent
    ratio = max(worst, median)
    again = _what_to_ask(trajectories.is_condition_number(objective), by_hand, fewer)
    if asked is not None:
        reached = f"the worst parameter comes to {format_percent(person.worst_percent)}, needed are {asked:g} %"
        enough = person.worst_percent <= asked
        said = f"accurate enough, {reached}" if enough else f"not accurate enough, {reached}; {again} (untried)"
    elif ratio <= 1.1:
        said = "nothing that counts is lost"
    elif ratio <= ground.MAX_ERROR_RATIO:
        said = "good enough to drive"
    else:
        said = f"too much is lost; play back the torques, or {again} (untried)"
    text = f"A person on these phases {_attained_words(median, worst)}: {said}."
    if not over:
        return text
    named = ", ".join(f"{n.replace('_', ' ')} by {100 * v:.0f} %" for n, v in over.items())
    if slower is not None:
        share, then = slower
        keep = (
            f"stay {100 * (1 - share):.0f} % below all speeds, with which simulated people keep them and identify the"
            f" worst parameter to {format_percent(then.worst_percent)}"
        )
    elif by_hand:
        keep = f"{again if fewer else 'design again with them so much tighter in the machine file'} (untried)"
    else:
        keep = "slower driving doesn't keep them, design again with --driver (untried)"
    return f"{text} But a person exceeds limits, {named} of {'its' if len(over) == 1 else 'their'} range: {keep}."


def _attained_words(median: float, worst: float) -> str:
    """Describe errors as multiples of those with torques played back."""
    exact = "torques played back exactly"
    factors = {name: f"{format_number(x, 2)}" for name, x in (("median", median), ("worst", worst))}
    more = [f"{x} times the {name} error" for name, x in factors.items() if x != "1"]
    same = [name for name, x in factors.items() if x == "1"]
    if not more:
        return f"is as good as {exact}"
    return f"attains {' and '.join(more)} of {exact}" + "".join(f" and is as good in the {n} parameter" for n in same)


def _what_to_ask(conditions: bool, by_hand: bool, fewer: bool) -> str:
    """Say which options of `excite design` help, without those that were used."""
    if not by_hand:
        return "design again with " + ("--objective accuracy --driver" if conditions else "--driver, or a longer drive")
    if fewer:
        return "leave out --phases, the design has phases for people already"
    first = "--objective accuracy, " if conditions else ""
    return f"design again with {first}a longer --duration, more --starts or, where there was one, a larger --budget"


def _exceeded_limits(model: Model, problem: Problem, motions: tuple[Motion, ...]) -> dict[str, float]:
    """Return the limits that any drive exceeds, with the largest excess as a share of their range."""
    over: dict[str, float] = {}
    for m in motions:
        for name, value in ground.broken_limits(model, problem, m).items():
            over[name] = max(over.get(name, 0.0), value)
    return over


def _slower_drive(
    model: Model, problem: Problem, trace: Trace, start: np.ndarray, seed: int
) -> tuple[float, DriveQuality] | None:
    """Return the largest share of the speeds at which simulated people keep every limit, and what they attain.

    None if no share helps.
    """
    for share in SLOWER_SHARES:
        slow = replace(trace, speed=share * trace.speed)
        with contextlib.suppress(SimulationError):
            motions = tuple(ground.follow_trace(model, slow, None, seed + k, start) for k in range(PEOPLE))
            if not _exceeded_limits(model, problem, ground.place_in_lane(model, problem, motions)):
                return share, ground.middle_quality([ground.rate_motion(model, m) for m in motions])
    return None


def _warnings(
    model: Model, trace: Trace, motions: tuple[Motion, ...], room: ground.TouchedGround, lane: tuple[float, float]
) -> list[str]:
    free, said = room.free, room.words(lane)
    lines = [
        f"Keep everybody off {free[0]:.0f} m x {free[1]:.0f} m: the machine touches {room.length:.1f} m x"
        f" {room.width:.1f} m of ground, {ground.FREE_MARGIN_M:g} m are left all around for overhangs and for stopping."
        f"{' ' * bool(said)}{said} Stop at once if anybody comes near.",
        "Engine speed and drive settings the same all along, whatever else shakes or moves off; ground level and firm.",
    ]
    turns = len(ground.reversal_times(trace))
    if turns:
        times = "once" if turns == 1 else f"{turns} times"
        lines.append(f"The machine changes direction {times}: somebody must see the ground behind it.")
    ends = np.array([ground.contact_edges(model, m)[0].mean(axis=0)[-1] for m in motions])
    spread = float(np.hypot(*(ends.max(axis=0) - ends.min(axis=0))))
    *others, last = ("speed", *(lever.name for lever in trace.levers))
    followed = f"{', '.join(others)} and {last}" if others else "the speed"
    lines.append(
        f"People drift: between {len(motions)} simulated drives the ends lie {spread:.1f} m apart. Follow"
        f" {followed}, not the place; don't correct the place before the end."
    )
    if len(trace.levers) > 1:
        lines.append(
            "Left, of every joint, is what turns the machine to the left when it goes forward: joints to one side turn"
            " it tightly, to different sides they move it sideways."
        )
    for lever, angle in zip(trace.levers, trace.angle.T, strict=True):
        stop = lever.body.limit.reach
        if stop is not None and (top := float(np.abs(angle).max()) / stop) > NEAR_STOP:
            lines.append(f"The {lever.name} goes to {100 * top:.0f} % of its stop: hands and feet away from the joint.")
    return lines


def summarise_sheet(made: Sheet) -> dict[str, Any]:
    """Summarise a sheet: phases, ground, accuracy by way of driving, warnings."""
    trace = made.trace
    return {
        "duration_s": trace.duration,
        "start": ground.start_words(made.model, made.motions[0], trace),
        "phases": ground.trace_table(trace),
        "direction_changes_s": ground.reversal_times(trace),
        **made.room.summary(made.lane),
        "tolerance": {
            "speed_m_s": ground.BAND_SPEED,
            "angle_rad": float(ground.BAND_ANGLE),
            "time_s": ground.BAND_S,
        },
        "scores": {
            name: {
                "cond_phi": s.cond_phi,
                "worst_percent": s.worst_percent,
                "worst": s.worst,
                "median_percent": s.median_percent,
            }
            for name, s in made.scores
        },
        "verdict": made.verdict,
        "warnings": list(made.warnings),
    }


def write(made: Sheet, place: Path) -> dict[str, Any]:
    """Write sheet.pdf, driver.html and phases.csv into a folder; return the summary."""
    sheet.save_sheet(made, place / "sheet.pdf")
    said = summarise_sheet(made)
    text = page.driver_page(made.model, made.trace, made.title, said["start"])
    (place / PAGE).write_text(text, encoding="utf-8")
    t = made.trace.times
    angles = {lever.column: angle for lever, angle in zip(made.trace.levers, made.trace.angle.T, strict=True)}
    knots = pd.DataFrame({"t_s": t, "v_m_s": made.trace.speed, **angles})
    knots.to_csv(place / "phases.csv", index=False)
    return said


def serve(out: Path, made: Sheet, host: str, port: int, live: Path | None, ready: Callable[[str], None]) -> None:
    """Serve the page of a folder with live values until Ctrl-C; `ready` gets its addresses. Raises ServeError."""
    text = (out / PAGE).read_text(encoding="utf-8")
    levers = made.trace.levers
    tail = GrowingLog(live, made.model.machine, levers) if live is not None else None
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(serve_page(text, [lever.column for lever in levers], host, port, tail, ready))

"""What is asked of a design, and what is said of the answer.

A brief puts an objective together with an accuracy to keep (`sigma_max`), the machines that it could be (`robust`) and
what earlier logs tell (`after`). The answer states its condition number and the accuracy that it makes attainable side
by side, and says so where the one hides the other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from excite import identification, logs, operator, simulation, text as wording, trajectories
from excite.errors import MachineError
from excite.model import Model, build, effects
from excite.model.machine import EffectEntry, Problem
from excite.operator import Phased
from excite.trajectories import Aim, Design, design

POOR = 5.0  # attainable standard deviation [%] beyond which a design says what to do
SCENARIOS, SPREAD = 5, 0.2  # machines of a robust design, and how far their values are from the nominal ones


@dataclass(frozen=True)
class Brief:
    """objective: a name of the table. sigma_max [%]. robust: for every machine within SPREAD. after: logs. between: two
    effects that the drive is to tell apart. driver: for people, in phases of phase_min_s [s] or more."""

    objective: str = "cond"
    sigma_max: float | None = None
    robust: bool = False
    after: tuple[Path, ...] = ()
    starts: int = 2
    seed: int = 0
    budget_s: float | None = None
    between: tuple[str, ...] = ()
    driver: bool = False
    phase_min_s: float = 3.0


@dataclass(frozen=True)
class Answer:
    """A design, the model that it was made for (with `after`, the estimate is its nominal) and the aim.

    phased: where it is for people, its phases and what they keep; the design is then what a steady person drives.
    """

    model: Model
    aim: Aim
    design: Design
    phased: Phased | None = None


def rivals(model: Model, between: tuple[str, ...], duration: float) -> Model:
    """A model with two effects more, NAME[@WHERE]=AMOUNT each, that a drive of duration [s] is to tell apart.

    Raises MachineError for an effect that is unknown, that the machine can't have, or that driving doesn't show.
    """
    return beside(model, [effects.parse_effect(text, model.machine, duration) for text in between])


def beside(model: Model, rivals: Sequence[EffectEntry]) -> Model:
    """The same for effects as a machine file has them. What they can be mistaken for may have any shape, so shapes of
    effects are parameters too, unless they are times of a log. Raises MachineError."""
    machine = effects.with_effects(model.machine, *rivals)
    times = any(effects.CATALOGUE[e.name].timed for e in machine.effect)
    both = build(machine, model.flaws, shapes=not times)
    for e in both.effects[-2:]:
        if e.name not in both.base.names:
            raise MachineError(
                f"effect {e.name}: no equation of motion shows its amount at once (it sits in a sensor, or acts through"
                " what it remembers), so no drive can be designed for it by the regressor"
            )
    return both


def graded(model: Model) -> None:
    """Refuses sensors of unknown noise, whose accuracy can't be stated. Raises MachineError."""
    for s in model.machine.sensors("full"):
        if s.kind not in ("x", "y") and not s.graded:
            raise MachineError(
                f"{model.machine.name}: sensor {s.name}: give noise or counts_per_turn in the machine file, a design"
                " states the accuracy that it makes attainable"
            )


def unmoved(problem: str) -> str:
    """What is said where a design's information is singular, of a problem by its name."""
    return f"some parameter moves nothing in problem {problem}, so no drive shows it"


def answer(
    model: Model, problem: Problem, brief: Brief, progress: Callable[[int, int, float], None] | None = None
) -> Answer:
    """The design that a brief asks for.

    Raises MachineError for sensors of unknown noise, whose accuracy can't be stated, DriveError for a drive that people
    can't be asked for, and what `design`, `log.read` and `identify` raise.
    """
    if brief.driver:
        operator.check(model, problem, brief.phase_min_s)
    graded(model)
    prior = None
    if brief.after:
        needs = identification.needed_sensors(model, "joint")
        known = identification.known_before(model, [logs.read_log(path, model.machine, needs) for path in brief.after])
        model, prior = known.model, known.information
    machines = simulation.perturbed_machines(model, SCENARIOS, SPREAD, brief.seed) if brief.robust else ()
    aim = trajectories.aim(model, brief.objective, brief.sigma_max, prior, machines)
    if not brief.driver:
        return Answer(model, aim, design(model, problem, aim, brief.starts, brief.seed, brief.budget_s, progress))
    begin = time.time()
    half = None if brief.budget_s is None else brief.budget_s / 2
    free = design(model, problem, aim, brief.starts, brief.seed, half, progress)

    def over() -> bool:
        return brief.budget_s is not None and time.time() > begin + brief.budget_s

    made = operator.phased(model, problem, aim, free.motion, brief.phase_min_s, brief.seed, over, progress)
    return Answer(model, aim, operator.as_design(model, problem, free, made), made)


def summary(brief: Brief, a: Answer) -> dict[str, Any]:
    """What there is to say of an answer: the brief, the scores, the accuracy, the limits."""
    names, d = a.model.base.names, a.design
    sigma = dict(zip(names, trajectories.sigma_percent(a.aim, a.model, d.motion).tolist(), strict=True))
    worst = max(sigma, key=lambda n: sigma[n])
    said: dict[str, Any] = {
        "objective": brief.objective,
        "cond_phi": d.cond_phi,
        "cond_w": d.cond_w,
        "cond_phi_start": d.cond_phi_start,
        "sigma_percent": sigma,
        "worst_parameter": worst,
        "worst_percent": sigma[worst],
        "median_percent": float(np.median(list(sigma.values()))),
        "hides_poor_accuracy": sigma[worst] > POOR,
        "advice": advice(brief, worst, sigma[worst]),
        "complete": d.complete,
        "max_violation": d.max_violation,
        "violations": dict(d.violations),
        "scores": list(d.scores),
        "starts": brief.starts,
        "seed": brief.seed,
    }
    if a.phased is not None:
        said["driver"] = _by_hand(brief, a.aim, a.phased)
    if brief.sigma_max is not None:
        said["sigma_max"] = brief.sigma_max
    if brief.between:
        said["between"] = list(brief.between)
    if brief.robust:
        said["robust"] = {"machines": SCENARIOS, "spread": SPREAD}
    if brief.after:
        said["after"] = [str(p) for p in brief.after]
        said["nominal"] = dict(zip(names, a.model.nominal.tolist(), strict=True))
    return said


def _by_hand(brief: Brief, aim: Aim, made: Phased) -> dict[str, Any]:
    """What people keep of a design: phases, the score by three ways of driving, limits that they break."""
    ways = ("played_back", "smoothed", "by_hand")
    scores = {
        way: {
            "score": trajectories.reported(aim.name, score),
            "cond_phi": attained.cond_phi,
            "worst_parameter": attained.worst,
            "worst_percent": attained.worst_percent,
            "median_percent": attained.median_percent,
        }
        for way, score, attained in zip(ways, made.scores, made.attained, strict=True)
    }
    return {
        "phase_min_s": brief.phase_min_s,
        "people": len(made.people),
        **scores,
        "limits_broken": made.over,
        "complete": made.complete,
        "phases": operator.trace_table(made.trace),
    }


def advice(brief: Brief, worst: str, percent: float) -> str | None:
    """What to do where a design lets one know some parameter poorly, None where all is well."""
    if percent <= POOR:
        return None
    blind = trajectories.conditions(brief.objective) and brief.sigma_max is None
    poor = f"{worst} can't be found better than {wording.format_percent(percent)}"
    if not blind:
        return f"poor accuracy: {poor}; drive longer, or on more room"
    return (
        f"cond(Phi) says nothing of accuracy here: {poor}; --objective accuracy designs for small errors"
        " (run it to see how small), --sigma-max PERCENT for the lowest cond(Phi) among drives that are accurate enough"
    )

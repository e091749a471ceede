"""Design the fewest and shortest drives that reach a stated accuracy together.

Information matrices of drives add up. Each drive is designed with the information of the others as prior, one after
the other and then once more around; where repeating one of them is better, it is repeated. The number of drives grows
until the target is reached at the longest duration; then all become shorter together, as long as the target is kept.
Every length is a design of its own, so an accuracy that is not reached is one that this search does not find: no bound.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from excite.errors import InfeasibleError, SolverError
from excite.model import Model
from excite.model.machine import Problem
from excite.trajectories import composite_objective, objective as objectives
from excite.trajectories.drive_search import design_drive
from excite.trajectories.multistart import Design

MAX_LENGTHS = 6  # durations that are tried for one number of drives; chosen
LENGTH_RESOLUTION = 0.04  # relative difference of a duration that is too short from one that is not; chosen
IMPROVABLE = 1.25  # drives that miss the target by more than this factor are not designed once more; chosen
USUAL_EXPONENT = 1.0  # error ~ duration^-exponent, until two durations are tried; chosen
EXPONENTS = (0.5, 3.0)  # least and greatest exponent: 0.5 is repetition; chosen


@dataclass(frozen=True)
class CampaignTrial:
    """The accuracy [%] that drives of one duration [s] attain together; inf if no drive keeps the limits."""

    drives: int
    duration_s: float
    percent: float


@dataclass(frozen=True)
class Campaign:
    """Drives designed together, and what they attain.

    percent: value of the objective after all drives [%], to compare with target. duration_s [s]: of each drive.
    alone_percent: value after each drive alone [%]. sigma_percent: attainable relative standard deviation [%] by
    parameter after all drives. trials: all numbers and durations that were tried. complete: False if interrupted or cut
    short by the budget.
    """

    objective: str
    target: float
    percent: float
    duration_s: float
    drives: tuple[Design, ...]
    alone_percent: tuple[float, ...]
    sigma_percent: dict[str, float]
    trials: tuple[CampaignTrial, ...]
    complete: bool

    @property
    def reached(self) -> bool:
        """True if all drives together are as accurate as the target."""
        return self.percent <= self.target

    @property
    def total_s(self) -> float:
        """Time of driving [s]."""
        return len(self.drives) * self.duration_s


def design_campaign(
    model: Model,
    problem: Problem,
    target: float,
    most: int = 1,
    within_s: float | None = None,
    objective: str = "worst",
    contrasts: np.ndarray | None = None,
    prior: np.ndarray | None = None,
    starts: int = 2,
    seed: int = 0,
    budget_s: float | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    solver: str = "own",
    trajectory: str | None = None,
    machines: Sequence[Model] = (),
) -> Campaign:
    """Design the fewest drives, then the shortest, that attain a target together; the best found if none do.

    target [%]: of the objective's reported value, by default the worst parameter's relative standard deviation.
    most: largest number of drives. within_s [s]: longest time of driving. The problem's duration is the longest one of
    a single drive. objective: a name in OBJECTIVES that is shown in per cent.
    contrasts, prior: as in `compose_objective`. machines: those whose limits an arm keeps (`CompositeObjective`). The
    other arguments: as in `design_drive`.

    Raises ValueError for an objective that is not shown in per cent, and what `design` raises if no drive of the
    longest duration keeps the limits.
    """
    if objectives.OBJECTIVES[objective].shown_as != "percent":
        raise ValueError(f"objective {objective}: a target needs one in per cent")
    search = _CampaignSearch(
        model,
        problem,
        objective,
        contrasts,
        prior,
        starts,
        seed,
        solver,
        trajectory,
        tuple(machines),
        budget_s,
        progress,
    )
    best: _Found | None = None
    longest = float(problem.duration_s)
    for count in range(1, most + 1):
        seconds = longest if within_s is None else min(longest, within_s / count)
        one = problem.lasting(seconds)
        begun = best.drives if best is not None and best.seconds == float(one.duration_s) else ()
        found = search.attempt(count, one, target, begun, fatal=best is None)
        best = found if found is not None and (best is None or found.percent < best.percent) else best
        if search.cut or (best is not None and best.percent <= target):
            break
    assert best is not None
    if best.percent <= target:
        best = _shorten(search, best, target)
    return search.campaign(best, target)


@dataclass(frozen=True)
class _Found:
    """Drives of one duration [s] and what they attain together [%]."""

    seconds: float
    drives: tuple[Design, ...]
    percent: float


def _shorten(search: _CampaignSearch, best: _Found, target: float) -> _Found:
    """Shorten all drives together as long as they attain the target."""
    count, shortest = len(best.drives), 4 * float(search.problem.knot_s)
    short = (shortest, np.inf)
    for _ in range(MAX_LENGTHS - 1):
        exponent = USUAL_EXPONENT
        if np.isfinite(short[1]):
            exponent = float(np.clip(np.log(short[1] / best.percent) / np.log(best.seconds / short[0]), *EXPONENTS))
        guess = best.seconds * (best.percent / target) ** (1 / exponent)
        room = best.seconds - short[0]
        one = search.problem.lasting(float(np.clip(guess, short[0] + room / 5, best.seconds - room / 10)))
        seconds = float(one.duration_s)
        if room <= LENGTH_RESOLUTION * best.seconds or not short[0] < seconds < best.seconds or search.cut:
            break
        found = search.attempt(count, one, target)
        if found is not None and found.percent <= target:
            best = found
        else:
            short = (seconds, np.inf if found is None else found.percent)
    return best


class _CampaignSearch:
    """Designs drives together and keeps a record of what was tried. cut: True if the last attempt was cut short."""

    def __init__(
        self,
        model: Model,
        problem: Problem,
        objective: str,
        contrasts: np.ndarray | None,
        prior: np.ndarray | None,
        starts: int,
        seed: int,
        solver: str,
        trajectory: str | None,
        machines: tuple[Model, ...],
        budget_s: float | None,
        progress: Callable[[int, int, float], None] | None,
    ) -> None:
        self.model, self.problem, self.objective, self.contrasts = model, problem, objective, contrasts
        n = len(model.scale)
        self.prior = np.zeros((n, n)) if prior is None else prior
        self.starts, self.seed, self.solver, self.progress = starts, seed, solver, progress
        self.trajectory, self.machines = trajectory, machines
        self.deadline = None if budget_s is None else time.time() + budget_s
        self.trials: list[CampaignTrial] = []
        self.cut = False

    def attempt(
        self, count: int, problem: Problem, target: float, begun: tuple[Design, ...] = (), fatal: bool = False
    ) -> _Found | None:
        """Design drives for a problem together; None if no drive keeps the limits, unless that is fatal."""
        seconds = float(problem.duration_s)
        drives = list(begun)
        try:
            while len(drives) < count and not self.cut:
                made = self._design(problem, drives, self.starts, self.seed + len(drives))
                drives.append(min((made, *drives), key=lambda d: self.attained([*drives, d])))  # or one repeated
        except (InfeasibleError, SolverError):
            if fatal:
                raise
        if len(drives) < count:
            self.trials.append(CampaignTrial(count, seconds, float("inf")))
            return None
        percent = self.attained(drives)
        for k in range(count - 1) if target < percent <= IMPROVABLE * target else ():
            others = drives[:k] + drives[k + 1 :]
            try:
                again = self._design(problem, others, 0, self.seed, drives[k])
            except (InfeasibleError, SolverError):
                continue
            now = self.attained([*others, again])
            if now < percent:
                drives[k], percent = again, now
            if self.cut or percent <= target:
                break
        self.trials.append(CampaignTrial(count, seconds, percent))
        if self.progress is not None:
            self.progress(len(self.trials), len(self.trials) + 1, min(t.percent for t in self.trials))
        return _Found(seconds, tuple(drives), percent)

    def _design(
        self, problem: Problem, others: list[Design], starts: int, seed: int, warm: Design | None = None
    ) -> Design:
        left = None if self.deadline is None else max(1.0, self.deadline - time.time())
        known = [] if warm is None else [warm.drive]
        aim = composite_objective.compose_objective(
            self.model, self.objective, prior=self._information(others), contrasts=self.contrasts
        )
        aim = replace(aim, machines=self.machines)
        made = design_drive(self.model, problem, aim, starts, seed, left, None, known, self.solver, self.trajectory)
        self.cut = self.cut or not made.complete
        return made

    def _information(self, drives: list[Design]) -> np.ndarray:
        """Return the information (n_base, n_base) [1/SI^2] of the prior and of drives."""
        by = np.outer(self.model.scale, self.model.scale)
        total = self.prior * by
        for d in drives:
            total = total + np.linalg.inv(composite_objective.motion_bound(self.model, d.motion) / by)
            total = total - self.model.known.information(self.model.scale)  # counts once, with the last drive
        return np.asarray(total / by)

    def attained(self, drives: list[Design]) -> float:
        """Return the value of the objective [%] after drives."""
        *before, last = drives
        aim = composite_objective.compose_objective(
            self.model, self.objective, prior=self._information(before), contrasts=self.contrasts
        )
        score = composite_objective.score_motions(aim, [(self.model, last.motion)]).score
        return objectives.reported_value(self.objective, score)

    def campaign(self, found: _Found, target: float) -> Campaign:
        """Return the drives with what they attain, each with its violations of limits alone."""
        aim = composite_objective.compose_objective(
            self.model, "worst", prior=self._information(list(found.drives[:-1]))
        )
        sigma = composite_objective.sigma_percent(aim, self.model, found.drives[-1].motion)
        names = self.model.base.names
        return Campaign(
            self.objective,
            target,
            found.percent,
            found.seconds,
            tuple(replace(d, objective=self.objective) for d in found.drives),
            tuple(self.attained([d]) for d in found.drives),
            dict(zip(names, sigma.tolist(), strict=True)),
            tuple(self.trials),
            not self.cut,
        )

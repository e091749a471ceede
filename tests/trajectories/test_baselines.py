"""Every drive of a comparison keeps the limits or says which it breaks, and scores what it drives."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.commands import Excite

from excite.errors import CollocationError
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import simulate
from excite.trajectories import (
    BASELINES,
    DESIGNED,
    TOLERANCE,
    Manoeuvre,
    check_limits,
    compare,
    multisine,
    objective,
    process_count,
)
from excite.trajectories.baselines import (
    CONTINUATION,
    Comparison,
    _BaselineDrive,
    _time_to_equal_score,
    bring_within_limits,
    scale_into_limits,
    score_drive,
)
from excite.trajectories.collocation import Transcription, solve_states

KINDS = ("multisine", "hand-made", "Fourier SLSQP")


@pytest.fixture(scope="module")
def problem(straight: Model) -> Problem:
    whole = straight.machine.problems["S40"]
    return whole.model_copy(update={"duration_s": whole.duration_s.model_copy(update={"value": 16.0})})


@pytest.fixture(scope="module")
def result(straight: Model, problem: Problem) -> Comparison:
    return compare(straight, problem, samples=3, seed=1, budget_s=60.0, baselines=KINDS)


@pytest.mark.slow
def test_every_kind_has_its_rows(result: Comparison) -> None:
    assert [r.name for r in result.rows] == [
        DESIGNED,
        "multisine, best of 3",
        "multisine, median of 3",
        "hand-made",
        "Fourier SLSQP",
    ]


@pytest.mark.slow
def test_the_designed_drive_beats_the_usual_ones(result: Comparison) -> None:
    ours, *others = result.rows
    assert ours.breaks is None
    assert all(ours.cond_phi < r.cond_phi for r in others)
    assert result.ratio_equal_time > 1


@pytest.mark.slow
def test_every_score_is_that_of_a_fresh_simulation(straight: Model, problem: Problem, result: Comparison) -> None:
    for r in result.rows:
        motion = simulate(straight, r.manoeuvre.sample(100.0), q0=r.start)
        assert objective.cond_phi(straight, motion) == pytest.approx(r.cond_phi, rel=1e-9)
        over = check_limits(straight, problem, motion)
        assert max(over.values()) == pytest.approx(r.max_violation, abs=1e-9)
        assert (r.breaks is None) == (r.max_violation <= TOLERANCE)
        assert 0 < r.median_std_percent <= r.worst_std_percent


@pytest.mark.slow
def test_time_to_an_equal_score(result: Comparison, straight: Model, problem: Problem) -> None:
    """Samples count one after the other, shared among the processes; infeasible ones take time and don't count."""
    ours, *others = result.rows
    assert ours.equal_s == ours.wall_s
    assert all(r.equal_s is None for r in others)
    found, _ = score_drive(straight, problem, scale_into_limits(straight, problem, multisine(straight, problem, 0)))
    kept = replace(found, violations={}, score=2 * np.log(100.0))
    samples = [
        _BaselineDrive("x", k, c, 10.0) for k, c in enumerate([replace(kept, violations={"power": 1.0}), kept, kept])
    ]
    shared = min(process_count(), 3)
    assert _time_to_equal_score(samples, 101.0) == pytest.approx(20.0 / shared)
    assert _time_to_equal_score(samples, 99.0) is None


def test_what_cannot_be_brought_inside_says_what_it_breaks(straight: Model, problem: Problem) -> None:
    shorter = problem.duration_s.model_copy(update={"value": 8.0})
    lane = (3.0, 20.0)  # the rolls alone are 3.2 m apart
    short = problem.model_copy(update={"lane_m": lane, "duration_s": shorter})
    found = bring_within_limits(straight, short, multisine(straight, short, 0))
    assert not found.feasible
    assert max(found.violations, key=lambda name: found.violations[name]).startswith("lane x")


@pytest.mark.slow
def test_a_drive_that_ends_far_from_rest_is_brought_inside(va12: Model) -> None:
    whole = va12.machine.problems["R60"]
    wish = multisine(va12, whole, 2)
    small = scale_into_limits(va12, whole, wish)
    before, _ = score_drive(va12, whole, small)
    assert before.excess > 20
    found = bring_within_limits(va12, whole, wish)
    assert found.feasible
    full = [float(b.limit.torque or 1.0) for b in va12.machine.actuated]
    moved = (found.manoeuvre.torque - small.torque) / full
    assert np.sqrt((moved**2).mean()) < 0.05


def test_soft_machines_that_do_not_follow_leave_it_to_the_sharp_one(
    straight: Model, problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    def settled(tr: Transcription, *args: np.ndarray) -> np.ndarray:
        asked.append(tr.intervals)
        if len(asked) <= refused:
            raise CollocationError("no motion follows")
        return solve_states(tr, *args)

    wish = multisine(straight, problem, 2)
    before, _ = score_drive(straight, problem, scale_into_limits(straight, problem, wish))
    assert not before.feasible
    asked: list[int] = []
    monkeypatch.setattr("excite.trajectories.baselines.solve_states", settled)
    refused = len(CONTINUATION) - 1
    assert bring_within_limits(straight, problem, wish).feasible
    asked.clear()
    refused = len(CONTINUATION)
    assert bring_within_limits(straight, problem, wish).violations == before.violations
    assert len(asked) == len(CONTINUATION)


def test_scaling_down_keeps_shape_and_limits(straight: Model, problem: Problem) -> None:
    wish = multisine(straight, problem, 2)
    small = scale_into_limits(straight, problem, wish)
    ratio = small.torque[5:-5] / wish.torque[5:-5]
    assert np.ptp(ratio) < 1e-9
    found, _ = score_drive(straight, problem, small)
    assert all(v == 0 for name, v in found.violations.items() if not name.startswith(("rest", "lane")))


@pytest.mark.parametrize("kind", BASELINES)
def test_every_kind_makes_a_drive_for_every_machine(emps: Model, straight: Model, va12: Model, kind: str) -> None:
    for model in (emps, straight, va12):
        problem = next(iter(model.machine.problems.values()), None)
        if problem is None:
            continue
        problem = problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": 12.0})})
        drive = BASELINES[kind].make(model, problem, 0, 0.0)
        assert drive.duration == pytest.approx(float(problem.duration_s))
        assert np.isfinite(drive.torque).all()
        assert np.abs(drive.torque[[0, -1]]).max() < 1e-9
        assert np.diff(drive.times).min() >= float(problem.knot_s) - 1e-9


def test_an_unknown_kind_is_refused(straight: Model, problem: Problem) -> None:
    with pytest.raises(KeyError, match="no usual drive waltz"):
        compare(straight, problem, baselines=("waltz",))


@pytest.mark.slow
def test_the_command_writes_drives_that_score_what_it_says(tmp_path: Path, excite: Excite, straight: Model) -> None:
    out = tmp_path / "compared"
    usual = ("--against", "chirp", "--against", "hand-made")
    code, shown, err = excite(
        "compare", "va12_straight", *usual, "--samples", 2, "--budget", 60, "--out", out, "--json"
    )
    assert code == 0, err
    summary = json.loads(shown)
    assert summary == json.loads((out / "summary.json").read_text())
    assert (out / "compare.png").stat().st_size > 10_000
    for row in summary["designs"]:
        knots = pd.read_csv(out / row["knots"]).to_numpy()
        start = [row["start"][c] for c in straight.coordinates]
        motion = simulate(straight, Manoeuvre(knots[:, 0], knots[:, 1:]).sample(100.0), q0=np.array(start))
        assert objective.cond_phi(straight, motion) == pytest.approx(row["cond_phi"], rel=1e-5)

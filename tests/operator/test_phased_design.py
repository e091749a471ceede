"""A design that people can follow: phases long enough, levels of a dial, better than what only follows the torques."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.commands import Excite

from excite.errors import UndrivableError
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.operator import Trace, ground, phased_design
from excite.operator.ground import ANGLE_STEP, GRID_S, SPEED_STEP
from excite.simulation import STEADY_DRIVER, Motion
from excite.trajectories import composite_objective, limits, saved_design


@lru_cache
def model_of(name: str) -> Model:
    return build(load_machine(name))


def task_of(model: Model, duration: float, shortest: float) -> phased_design.PhaseSearch:
    problem = next(iter(model.machine.problems.values()))
    return phased_design.PhaseSearch(
        model,
        problem,
        composite_objective.compose_objective(model, "cond"),
        duration,
        shortest,
        *ground.trace_bounds(model),
    )


def fits(task: phased_design.PhaseSearch, trace: Trace) -> bool:
    """Whether a trace is one that was asked for."""
    turn = np.abs(np.diff(trace.angle, axis=0)) / np.diff(trace.times)[:, None]
    return bool(
        np.diff(trace.times).min() >= task.shortest - 1e-9
        and trace.times[0] == 0
        and trace.times[-1] == task.duration
        and np.abs(trace.speed).max() <= task.fastest + 1e-9
        and (np.abs(trace.angle) <= task.widest + 1e-9).all()
        and (turn <= task.swing + 1e-9).all()
        and not trace.speed[[0, -2, -1]].any()
        and not trace.angle[[0, -2, -1]].any()
    )


@settings(max_examples=30, deadline=None)
@given(
    name=st.sampled_from(["va12", "va12_straight", "tandem"]),
    seed=st.integers(0, 10**6),
    shortest=st.sampled_from([1.5, 3.0, 5.0]),
    duration=st.sampled_from([20.0, 60.0]),
)
def test_random_drives_and_their_rounding_are_what_was_asked_for(
    name: str, seed: int, shortest: float, duration: float
) -> None:
    model = model_of(name)
    task, levers = task_of(model, duration, shortest), ground.find_levers(model)
    like = Trace(np.array([0.0, duration]), np.zeros(2), np.zeros((2, len(levers))), levers)
    for trace in phased_design.random_traces(task, like, seed)[:2]:
        assert fits(task, trace)
        dial = phased_design.snap_levels(task, trace)
        assert fits(task, dial)
        assert dial.times / GRID_S == pytest.approx(np.round(dial.times / GRID_S))
        assert dial.speed / SPEED_STEP == pytest.approx(np.round(dial.speed / SPEED_STEP), abs=1e-9)


def test_a_design_as_phases_stands_still_at_its_end(va12: Model, va12_motion: Motion) -> None:
    task = task_of(va12, float(va12_motion.t[-1]), 3.0)
    trace = phased_design.initial_trace(task, va12_motion)
    assert fits(task, trace)
    assert trace.times[-1] - trace.times[-2] >= 3.0
    speed, angle = trace.at(va12_motion.t)
    share = 1 - 3.0 / task.duration
    assert np.corrcoef(speed, np.interp(va12_motion.t / share, va12_motion.t, va12_motion.nu[:, 0]))[0, 1] > 0.8
    assert np.abs(angle).max() > 2 * ANGLE_STEP


@pytest.mark.parametrize("shortest", [0.0, 0.4, 16.0, float("nan")])
def test_phases_that_do_not_fit_are_refused(va12: Model, shortest: float) -> None:
    with pytest.raises(UndrivableError, match=r"--phase-min.: must be between 0.5 and 15 s"):
        phased_design.check_phase_length(va12, va12.machine.problems["R60"], shortest)


def test_a_machine_without_wheels_has_nobody_to_drive_it(emps: Model, va12: Model) -> None:
    with pytest.raises(UndrivableError, match="emps"):
        phased_design.check_phase_length(emps, va12.machine.problems["R60"], 3.0)


@pytest.mark.slow
def test_the_command_designs_for_people_and_says_what_they_keep(
    excite: Excite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short drive on a straight lane, the search cut short: both scores in summary and report, every limit kept or
    named, the driver's sheet of these phases; driven afresh it is what was said."""
    for name, few in {"N_RANDOM": 4, "ROUNDS": 2, "LEVELS": 1, "POLISHES": 1}.items():
        monkeypatch.setattr(phased_design, name, few)
    out = tmp_path / "d"
    asked = "design va12_straight --driver --phase-min 1.5 --duration 12 --starts 1 --seed 3 --json --out"
    code, shown, err = excite(*asked.split(), out)
    assert code == 0, err
    by_hand = json.loads(shown)["driver"]
    assert by_hand["played_back"]["score"] <= by_hand["by_hand"]["score"] < by_hand["smoothed"]["score"]
    assert by_hand["by_hand"]["score"] == pytest.approx(by_hand["by_hand"]["cond_phi"], rel=1e-6)
    report = (out / "report.html").read_text()
    assert f"{by_hand['by_hand']['score']:.4g}" in report
    assert f"{by_hand['played_back']['score']:.4g}" in report
    assert ("every limit is kept" in report) == (not by_hand["limits_broken"])

    found = saved_design.read_design(out)
    trace = ground.trace_from_table(found.model, by_hand["phases"])
    assert np.diff(trace.times).min() >= 1.5
    assert (trace.speed[-2:] == 0).all()
    assert found.problem is not None
    ways = [ground.follow_trace(found.model, trace, None, 3 + k) for k in range(by_hand["people"])]
    assert ground.middle_quality([ground.rate_motion(found.model, m) for m in ways]).cond_phi == pytest.approx(
        by_hand["by_hand"]["cond_phi"], rel=1e-6
    )
    steady = ground.follow_trace(found.model, trace, STEADY_DRIVER, 0)
    for m in ground.place_in_lane(found.model, found.problem, (steady, *ways)):
        over = limits.check_limits(found.model, found.problem, m)
        assert {n for n, x in over.items() if x > 1e-3} <= set(by_hand["limits_broken"])
    assert found.motion.nu == pytest.approx(steady.nu, abs=1e-6)  # the profile is what a steady person does

    code, shown, err = excite("drive", out, "--out", tmp_path / "cab", "--json")
    assert code == 0, err
    said = json.loads(shown)
    assert said["phases"] == by_hand["phases"]
    assert said["scores"]["torques played back"]["cond_phi"] == by_hand["played_back"]["cond_phi"]


def test_a_damaged_table_of_phases_is_one_clear_line(straight: Model) -> None:
    for rows in ([{"end_s": 3.0}], [], [{"end_s": -1, "speed_m_s": [0, 1]}]):
        with pytest.raises(UndrivableError, match="design again"):
            ground.trace_from_table(straight, rows)


def test_one_step_improves_a_poor_drive(straight: Model) -> None:
    """From one slow pass forward a step of the search must gain, and stay what was asked for."""
    import joblib

    task = task_of(straight, 16.0, 2.0)
    times = np.array([0.0, 3, 6, 9, 12, 16])
    poor = Trace(times, np.array([0.0, 0.5, 0.5, 0.5, 0, 0]), np.zeros((6, 0)), ())
    run = joblib.Parallel(n_jobs=1)
    first = phased_design.try_traces(task, [poor], run)[0]
    assert first is not None
    room = np.full(len(first.over), phased_design.MIN_MARGIN)
    best, reach = phased_design.improve_by_program(task, first, room, 1.0, 20.0, True, run)
    assert phased_design.merit(task, best, room) < phased_design.merit(task, first, room) - 0.1
    assert reach > 0.1
    assert fits(task, phased_design.snap_times(task, best.trace))
    assert phased_design.merit(task, replace(best, over=best.over + 1.0), room) > phased_design.merit(task, best, room)


def test_differences_at_a_lower_rate_are_those_at_the_machine_s(straight: Model) -> None:
    """A faster phase changes the information matrix and every limit alike at both rates."""
    import joblib

    task = task_of(straight, 16.0, 2.0)
    assert task.coarser.stride * float(task.coarser.model.machine.sampling_hz) == float(straight.machine.sampling_hz)
    assert float(task.coarser.model.machine.sampling_hz) == phased_design.TRIAL_HZ
    times = np.array([0.0, 3, 6, 9, 12, 16])
    one = Trace(times, np.array([0.0, 0.5, -0.4, 0.5, 0, 0]), np.zeros((6, 0)), ())
    two = replace(one, speed=one.speed * [1, 1.1, 1, 1, 1, 1])
    run = joblib.Parallel(n_jobs=1)
    changes = []
    for coarse in (False, True):
        first, second = phased_design.try_traces(task, [one, two], run, coarse)
        assert first is not None
        assert second is not None
        changes.append((second.A[0] - first.A[0], second.over - first.over))
    (exact, limits_exact), (near, limits_near) = changes
    assert np.linalg.norm(near - exact) < 0.1 * np.linalg.norm(exact)
    assert np.abs(limits_near - limits_exact).max() < 0.1 * np.abs(limits_exact).max()


def test_levels_are_reduced_until_people_keep_the_limits(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing changes for a slow drive; of one that is too long for the lane the speeds fall, not the phases."""
    task = task_of(straight, 16.0, 2.0)
    short = task.problem.model_copy(update={"lane_m": (15.0, 20.0), "lane_points": (0, 4)})
    task = replace(task, problem=short)
    times = np.array([0.0, 3, 6, 9, 12, 16])
    slow = Trace(times, np.array([0.0, 0.5, 0.6, 0.4, 0, 0]), np.zeros((6, 0)), ground.find_levers(straight))
    kept = phased_design.reduce_levels(task, slow, 0)
    assert not kept.over
    assert kept.trace.speed == pytest.approx(slow.speed)
    assert len(kept.motions) == 1 + phased_design.PEOPLE
    monkeypatch.setattr(phased_design, "PEOPLE", 1)
    fast = replace(slow, speed=np.array([0.0, 1.0, 1.0, 0.6, 0, 0]) * task.fastest)
    assert phased_design.drive_way(task, fast, 0).over
    reduced = phased_design.reduce_levels(task, fast, 0)
    assert max(reduced.over.values(), default=0) < max(phased_design.drive_way(task, fast, 0).over.values())
    assert reduced.trace.speed.max() < fast.speed.max()
    assert reduced.trace.times[-1] == 16.0


def test_the_lane_has_room_for_the_whole_contact(va12: Model) -> None:
    """Half a roll, 1.05 m, is kept free at every side of the lane, as shares of 40 m and 20 m."""
    task = task_of(va12, 60.0, 3.0)
    width = max(float(b.contact.width) for b in va12.machine.contacts if b.contact is not None)
    shares = sorted(set(phased_design.contact_overhang(task)))
    assert shares == pytest.approx([0.0, width / 2 / 40, width / 2 / 20])

"""Slips at the edges of contacts: what lies outside the linear law, and designs that stay inside it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.commands import Excite

import excite as program
from excite.logs import profile_of
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, outside_law, resultant_slips, share_outside_law, simulate
from excite.trajectories import LIMITS, check_limits, compose_objective, continuation
from excite.trajectories.limits import BoundedExpression, LimitKind, SampleSymbols


def steer_at_standstill(model: Model) -> Motion:
    """The articulation pushed to and fro while the rolls stand: the chassis yaw, and their rolls' edges shear."""
    return simulate(model, np.outer(np.sin(np.linspace(0, 2 * np.pi, 1201)) ** 3, [0.0, 9000.0, 0.0]))


def test_edges_are_outside_the_law_where_the_middle_is_not(va12: Model) -> None:
    motion = steer_at_standstill(va12)
    middle = np.abs(va12.kinematics(motion.q.T, motion.nu.T)[1].full()).reshape(2, 2, -1)
    edges = resultant_slips(va12, motion.q, motion.nu, va12.nominal)
    assert np.hypot(middle[:, 0], middle[:, 1]).max() < 0.15 < edges.max()
    beyond = edges.max(axis=1) > 0.15
    np.testing.assert_array_equal(outside_law(va12, motion.q, motion.nu, va12.nominal), beyond)
    assert 0.01 < share_outside_law(va12, motion) == beyond.mean() < 0.9
    excess = check_limits(va12, va12.machine.problems["R60"], motion)
    for k, name in enumerate(("front_roll right", "front_roll left", "rear_roll right", "rear_roll left")):
        assert excess[f"slip {name}"] == pytest.approx(max(0.0, edges[:, k].max() / 0.15 - 1), rel=5e-3)


def test_contacts_of_another_law_are_never_outside_it(va12: Model) -> None:
    motion = steer_at_standstill(va12)
    contact = {"law": "exponential", "saturation_slip": va12.machine.find(1).contact.v_eps}  # type: ignore[union-attr]
    bodies = tuple(
        b if b.contact is None else b.model_copy(update={"contact": b.contact.model_copy(update=contact)})
        for b in va12.machine.body
    )
    other = va12.for_machine(va12.machine.model_copy(update={"body": bodies}))
    assert share_outside_law(va12, motion) > 0
    assert share_outside_law(other, motion) == 0


def _middles(model: Model, problem: Problem, s: SampleSymbols) -> Iterator[BoundedExpression]:
    slips = model.kinematics(s.q, s.nu)[1]
    for k, name in enumerate(model.slips):
        yield f"slip {name}", slips[k], -0.15, 0.15, "-"


@pytest.mark.slow
def test_a_design_keeps_its_edges_within_the_law(va12: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """With limits on the middle alone the same search ends at edges that slip far more."""
    problem = va12.machine.problems["R60"]
    problem = problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": 20.0})})
    aim = compose_objective(va12, "accuracy")

    def largest_slip() -> float:
        state = continuation.start_from_multisine(va12, problem, aim, 0, 3)
        state = continuation.run_stages(va12, problem, aim, state, continuation.STAGES, lambda: False, lambda s: None)
        state = continuation.repair(va12, problem, aim, state, lambda: False)
        assert state.best.feasible
        motion = simulate(va12, state.best.manoeuvre.sample(100.0), q0=state.best.start)
        return float(resultant_slips(va12, motion.q, motion.nu, va12.nominal).max())

    assert 0.1 < largest_slip() <= 0.15 * 1.001
    monkeypatch.setitem(LIMITS, "slip", LimitKind(_middles))
    assert largest_slip() > 0.2


def test_the_share_outside_the_law_is_told(excite: Excite, va12: Model, tmp_path: Path) -> None:
    """By a simulation, and by an identification from its log."""
    motion = steer_at_standstill(va12)
    share = share_outside_law(va12, motion)
    profile_of(va12, motion).to_csv(tmp_path / "p.csv", index=False)
    asked = ("simulate", "va12", tmp_path / "p.csv", "--noise", "off", "--out", tmp_path / "log.csv")
    _, stdout, _ = excite(*asked)
    assert f"In {100 * share:.2g} % of the samples a contact slips more" in stdout
    assert json.loads(excite(*asked, "--json")[1])["share_outside_law"] == share
    log = program.read_log(va12, tmp_path / "log.csv")
    assert program.identify(va12, log, "ols").share_outside_law == pytest.approx(share, abs=0.03)

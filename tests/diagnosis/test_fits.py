"""How fits to logs are found, gone on with and given up."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.drives import gentle
from support.logs import calm, make_log, slope

from excite import smoothing
from excite.diagnosis import fits as stages, residuals_of_logs
from excite.diagnosis.parallel import run_in_turn
from excite.logs import log
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.simulation import Motion
from excite.smoothing import Settings


def test_what_a_process_found_can_be_sent_back(straight: Model, straight_motion: Motion) -> None:
    """An answer that can't be sent would be computed again in silence."""

    def sent(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        return (pickle.loads(pickle.dumps(call())) for call in calls)

    one = make_log(straight, straight_motion, seed=3)
    stage = stages.fit_machine(straight.machine, [one], straight.machine.filter)
    sloped = placing.with_effects(straight.machine, placing.parse_effect("ground_slope=0.001", straight.machine, 10.0))
    (found,) = stages.refit_all([sloped], stage, sent)
    (here,) = stages.refit_all([sloped], stage, run_in_turn)
    assert found is not None
    assert here is not None
    np.testing.assert_array_equal(found.fit.X, here.fit.X)


@pytest.mark.parametrize("effect", ["torque_deadband@front_roll=20", "torque_deadband@front_roll=0.001"])
def test_what_makes_sense_above_zero_only_ends_there(straight: Model, effect: str) -> None:
    """A log that would like an amount best below zero has it near zero, all others where they are without it."""
    stage = calm(straight)
    machine = placing.with_effects(straight.machine, placing.parse_effect(effect, straight.machine, 10.0))
    data = stages.adapt_data(machine, stage)
    fit, without = (
        smoothing.fit_logs(x.space, x.measurements, x.starts, x.space.model.nominal, x.starts, x.held)
        for x in (data, stage.data)
    )
    (amount,) = (k for k, name in enumerate(data.space.model.base.names) if name not in straight.base.names)
    assert 0 < fit.X[amount] < Settings().tolerance * fit.std[amount]
    assert abs(fit.cost - without.cost) < 0.05
    assert (np.abs(np.delete(fit.X, amount) - without.X) < 0.05 * without.std).all()


def test_an_amount_that_began_near_zero_leaves_it(straight: Model) -> None:
    """Where the log wants it: what is at its end is asked anew in every pass."""
    effect = placing.parse_effect("torque_deadband@front_roll=60", straight.machine, 10.0)
    hidden = prediction.build(placing.with_effects(straight.machine, effect))
    one = make_log(hidden, gentle(hidden, 12.0), seed=3, known=straight)
    effect = placing.parse_effect("torque_deadband@front_roll=0.001", straight.machine, 10.0)
    stage = stages.fit_machine(placing.with_effects(straight.machine, effect), [one], straight.machine.filter)
    fit, amount = stage.fit, hidden.base.names.index("torque_deadband@front_roll")
    assert abs(fit.X[amount] - 60) < 3 * fit.std[amount] < 30


@pytest.mark.parametrize("scales", [-20, 20])
def test_a_far_offset_is_found(scales: int, straight: Model) -> None:
    """A torque offset twenty times its scale off is found."""
    stage = calm(straight)
    p, k = stage.data, stage.model.base.names.index("u10")
    off = scales * stage.model.scale * (np.arange(len(stage.fit.X)) == k)
    shifted = [replace(r, torque=r.torque + np.array([off[k], 0.0])) for r in p.measurements]
    found = smoothing.fit_logs(p.space, shifted, stage.fit.trajectories, stage.fit.X, p.starts, p.held)
    assert found.status == "converged"
    assert (np.abs(found.X - stage.fit.X - off) < stage.fit.std).all()


def test_what_was_not_seen_is_judged_again(straight: Model) -> None:
    """What the log shows after all is let go. What it doesn't show is at the file's value in the end."""
    stage = calm(straight)
    p, names = stage.data, stage.model.base.names
    k = names.index("u10")
    assert not stage.fit.unidentifiable[k]
    start = np.where(np.arange(len(names)) == k, stage.model.nominal, stage.fit.X)
    resumed = Settings(damping=stages.RESUMED.damping)
    found = smoothing.fit_logs(
        p.space, p.measurements, stage.fit.trajectories, start, p.starts, p.held, settings=resumed
    )
    assert not found.unidentifiable[k]
    assert abs(found.X[k] - stage.fit.X[k]) < 0.1 * stage.fit.std[k]
    one = make_log(straight, gentle(straight, 8.0), seed=3)
    stage = stages.fit_machine(straight.machine, [one], straight.machine.filter)
    p, k = stage.data, names.index("Fv1")
    far = stage.fit.X + 3 * stage.model.scale * (np.arange(len(names)) == k)
    held = smoothing.fit_logs(p.space, p.measurements, stage.fit.trajectories, far, p.starts, p.held)
    assert held.status == "converged"
    (k,) = np.flatnonzero(held.unidentifiable)
    assert names[k] in ("Fv1", "Fv4")  # the log shows only what both do together
    assert held.X[k] == pytest.approx(stage.model.nominal[k], abs=1e-3 * stage.model.scale[k])


@pytest.mark.parametrize(
    ("status", "step", "misfit", "found"),
    [
        ("converged", 0.01, 1.0, True),
        ("converged", 0.01, 2.4, True),
        ("converged", 0.01, 5.0, False),  # exact dynamics do not follow the logs
        ("stalled", 0.9, 2.4, True),
        ("stalled", 3.0, 1.2, True),  # near the logs
        ("stalled", 3.0, 1.4, False),
        ("stopped", 3.0, 1.2, False),
        ("out of range", np.inf, np.inf, False),
    ],
)
def test_a_fit_that_came_near_the_log_is_gone_on_with(
    status: Any, step: float, misfit: float, found: bool, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though its steps were still large; far from the log it is given up."""
    stage = calm(straight)
    ended = replace(stage.fit, status=status, step=step, cost=misfit * stage.data.n_readings)
    monkeypatch.setattr(smoothing, "fit_logs", lambda *given, **more: ended)
    (tried,) = stages.refit_all([stage.machine], stage, run_in_turn)
    assert (tried is not None) == found


@pytest.mark.slow
def test_what_exact_dynamics_do_not_follow_is_fitted_beside_unknown_forces(straight: Model, sloping: Path) -> None:
    """Its residuals are then noise but for what these forces take, which is told with its place."""
    one = log.read_log(sloping, straight.machine)
    stage = stages.fit_machine(straight.machine, [one], straight.machine.filter)
    assert not stage.exact
    assert stage.fit.cost < stages.TRACKING_COST_RATIO * stage.data.n_readings
    (course,) = residuals_of_logs(stage)
    assert any(x.any() for label, (x, _, _) in course.missing.items() if not label.startswith("torque"))
    assert list(stages.refit_all([straight.machine], stage, run_in_turn)) == [None]
    sloped = placing.with_effects(straight.machine, slope(straight))
    (found,) = stages.refit_all([sloped], stage, run_in_turn)
    assert found is not None
    assert found.exact
    assert found.is_close

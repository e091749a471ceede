"""How fits to logs are found, gone on with and given up."""

from __future__ import annotations

import multiprocessing
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
from excite.diagnosis import fits as stages, run_forked, selection
from excite.diagnosis.parallel import run_in_turn
from excite.logs import log
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.simulation import Motion, simulate
from excite.smoothing import ACCEPTABLE_STEP, Fit, NotConvergedError, Settings


def test_what_a_process_found_can_be_sent_back(straight: Model, straight_motion: Motion) -> None:
    """An answer that can't be sent would be computed again in silence."""

    def sent(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        return (pickle.loads(pickle.dumps(call())) for call in calls)

    one = make_log(straight, straight_motion, seed=3)
    stage = stages.fit_machine(straight.machine, [one], straight.machine.filter)
    sloped = placing.with_effects(straight.machine, placing.parse_effect("ground_slope=0.001", straight.machine, 10.0))
    for run in (stages.refit_all, stages.fit_all_from_start):
        for disturbed in (0.0, 1.0):
            (found,) = run([(sloped, stage, disturbed)], sent)
            assert found is not None
            assert found.fit.process_noise == disturbed


@pytest.mark.parametrize(
    ("close", "without", "chosen"), [(True, True, True), (True, False, True), (False, True, False), (True, None, False)]
)
def test_a_first_effect_may_begin_anew(
    close: bool, without: bool | None, chosen: bool, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Choose an effect by an exact fit from the start that comes near the log, and is better than the one without the
    effect if the model has one after all (None: that is as good)."""
    stage = replace(calm(straight), estimated=False)
    machines = list[Any]()

    def begin(requests: Any, runner: Any) -> list[stages.ExtendedFit | None]:
        made = list[stages.ExtendedFit | None]()
        for m, of, noise in requests:
            assert noise == 0
            machines.append(m)
            found = stages.refit(m, of, 0.0)
            made.append(found if close else replace(found, fit=replace(found.fit, cost=9 * found.expected_cost)))
        return made

    score = next(s for s in selection.score_effects(stage, run_in_turn) if s.candidate.name == "ground_slope@machine")
    monkeypatch.setattr(selection, "_refined_shortlist", lambda *asked: [score])
    monkeypatch.setattr(selection, "fit_all_from_start", begin)
    monkeypatch.setattr(selection, "wald_statistic", lambda name, of: 1e4)
    true = selection.refit

    def refit(machine: Any, of: stages.ExtendedFit, noise: float) -> stages.ExtendedFit:
        if without is False:
            raise NotConvergedError("no fit")
        found = true(machine, of, noise)
        return replace(found, fit=replace(found.fit, cost=of.fit.cost + 5000.0)) if without else found

    monkeypatch.setattr(selection, "refit", refit)
    before, choices = selection.choose_from_start(stage, run_in_turn)
    assert [x.name for x in choices] == (["ground_slope@machine"] if chosen else [])
    assert before.estimated == (close and without is not False)
    assert len(machines) == 1


def test_a_tie_is_a_tie_however_small_the_gain(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """With process noise a rival that chance may put first is refitted without it like the best."""
    stage, trials = calm(straight), []
    scores = {s.candidate.name: s for s in selection.score_effects(stage, run_in_turn)}
    for behind, text in ((0.0, "ground_slope=0.009"), (8.0, "rolling_resistance@rear_roll=200")):
        extended = placing.with_effects(straight.machine, placing.parse_effect(text, straight.machine, 40.0))
        found = stages.refit(extended, stage, 1.0)
        fit = replace(found.fit, cost=stage.expected_cost + behind)
        trials.append((scores[found.model.effects[0].name], replace(found, fit=fit)))

    def freed(found: Sequence[Any], runner: Any) -> Any:
        return (replace(x, fit=replace(x.fit, process_noise=0.0, cost=x.expected_cost)) for x in found)

    monkeypatch.setattr(selection, "drop_process_noise", freed)
    choice = selection._make_choice(trials, 25.0, 100, run_in_turn)
    assert [e.label for e in choice.rivals] == [trials[1][0].candidate.name]


def test_ways_that_are_not_needed_are_given_up(straight: Model) -> None:
    """Of the ways to a fit the first one is enough for a clean log, whatever has been begun beside it."""
    one = make_log(straight, gentle(straight, 12.0), seed=3)
    carried: list[int] = []

    def counted(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        for k, call in enumerate(calls):
            carried.append(k)
            yield call()

    others = multiprocessing.active_children()
    there = stages.fit_machine(straight.machine, [one], straight.machine.filter, run_forked)
    assert set(multiprocessing.active_children()) <= set(others)
    here = stages.fit_machine(straight.machine, [one], straight.machine.filter, counted)
    assert carried == [0]
    np.testing.assert_array_equal(there.fit.X, here.fit.X)


def test_small_forces_are_fitted_as_closely_as_none(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """What they leave out is compared with small gains; of large ones nobody asks so much."""
    stage, asked = calm(straight), dict[float, float]()

    def noted(*given: Any) -> Fit:
        asked[given[6]] = given[7].tolerance
        return stage.fit

    monkeypatch.setattr(smoothing, "fit_logs", noted)
    for disturbed in (0.0, stages.MIN_PROCESS_NOISE, 1.0):
        stages.refit(straight.machine, stage, disturbed)
    assert asked == {
        0.0: stages.SUFFICIENT_STEP,
        stages.MIN_PROCESS_NOISE: stages.SUFFICIENT_STEP,
        1.0: ACCEPTABLE_STEP,
    }


def test_smaller_forces_side_by_side_are_the_smallest_that_do(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is done at once, the first of them counts with which there is a fit."""
    stage, asked = calm(straight), list[float]()
    loose = replace(stage, fit=replace(stage.fit, process_noise=1.0))

    def at_once(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        return (x for x in [call() for call in calls])

    def resumable(prepared: Any, of: stages.ExtendedFit, disturbed: float, *given: Any) -> Fit:
        asked.append(disturbed)
        if disturbed < least:
            raise NotConvergedError("no fit")
        return replace(stage.fit, process_noise=disturbed)

    monkeypatch.setattr(stages, "resume_fit", resumable)
    known = replace(stage, process_noise_fit=loose)
    wanted = [x for x in stages.PROCESS_NOISE_REDUCTIONS if x >= stages.MIN_PROCESS_NOISE]
    for k, least in enumerate(wanted):
        for together, tried in ((run_in_turn, wanted[: k + 1]), (at_once, wanted)):
            asked.clear()
            less = stages.fit_with_process_noise(known, together)
            assert (less.fit.process_noise, asked[: len(tried)]) == (least, tried)
            assert max(asked[len(tried) :]) < least
    asked.clear()
    least = np.inf
    assert stages.fit_with_process_noise(known, at_once).fit is loose.fit
    assert asked == [*wanted, 0.0]


@pytest.mark.parametrize("effect", ["torque_deadband@front_roll=20", "torque_deadband@front_roll=0.001"])
def test_what_makes_sense_above_zero_only_ends_there(straight: Model, effect: str) -> None:
    """A log that would like an amount best below zero has it near zero, all others where they are without it."""
    stage = calm(straight)
    machine = placing.with_effects(straight.machine, placing.parse_effect(effect, straight.machine, 10.0))
    p, without = stages.adapt_data(machine, stage), stage.fit
    fit = stages.iterate(p, p.starts, p.space.model.nominal, 0.0, patient=True)
    (amount,) = (k for k, name in enumerate(p.space.model.base.names) if name not in straight.base.names)
    assert 0 < fit.X[amount] < stages.FULL_STEP * fit.std[amount]
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


@pytest.mark.parametrize(
    ("forces", "asked", "coarse", "settled", "held"),
    [
        (0.0, 0.0, 1.0, True, True),
        (0.1, 0.1, 1.0, True, True),
        (0.1, 1.0, 1.0, True, True),
        (1.0, 0.1, 1.0, True, False),  # smaller forces may show it
        (0.1, 0.0, 1.0, True, False),
        (1.0, 1.0, 10.0, True, False),  # and so may finer sensors
        (0.0, 0.0, 1.0, False, False),
    ],
)
def test_what_was_not_seen_begins_anew(
    forces: float,
    asked: float,
    coarse: float,
    settled: bool,
    held: bool,
    straight: Model,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = calm(straight)
    names, unseen = stage.model.base.names, stage.fit.unidentifiable.copy()
    unseen[names.index("u10")] = True
    of = replace(stage, estimated=settled, fit=replace(stage.fit, unidentifiable=unseen, process_noise=forces))
    of = replace(of, data=stages.inflate_sensor_noise(of.data, coarse))
    more = stages.inflate_sensor_noise(
        stages.adapt_data(placing.with_effects(straight.machine, slope(straight)), stage), 1.0
    )
    told = list[np.ndarray]()

    def noted(*given: Any) -> Fit:
        told.append(given[3])
        return stage.fit

    monkeypatch.setattr(smoothing, "fit_logs", noted)
    stages.resume_fit(more, of, asked)
    begins = dict(zip(more.space.model.base.names, told[0] == more.space.model.nominal, strict=True))
    assert [n for n in names if begins[n]] == (["u10"] if held else [])


def test_what_was_not_seen_is_judged_again(straight: Model) -> None:
    """What the log shows after all is let go. What it doesn't show is at the file's value in the end."""
    stage = calm(straight)
    p, names = stage.data, stage.model.base.names
    k = names.index("u10")
    assert not stage.fit.unidentifiable[k]
    start = np.where(np.arange(len(names)) == k, stage.model.nominal, stage.fit.X)
    resumed = Settings(damping=stages.RESUMED_DAMPING)
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
    ("slope", "seconds", "forces", "near", "settled"),
    [
        (0.0005, 12.0, 0.0, True, True),
        (0.002, 12.0, stages.PROCESS_NOISE_REDUCTIONS[0] * stages.PROCESS_NOISE_LEVELS[1], True, True),
        (0.03, 40.0, stages.PROCESS_NOISE_LEVELS[1], False, True),
        (0.1, 12.0, stages.PROCESS_NOISE_LEVELS[0], False, False),
    ],
)
def test_smaller_forces_are_tried_where_the_model_is_near(
    slope: float, seconds: float, forces: float, near: bool, settled: bool, straight: Model, straight_motion: Motion
) -> None:
    """They leave more. Where large ones leave it far off, the file's parameters show where to look."""
    effect = placing.parse_effect(f"ground_slope={slope}", straight.machine, seconds)
    hidden = prediction.build(placing.with_effects(straight.machine, effect))
    drive = straight_motion if seconds == 40 else gentle(straight, seconds)
    one = make_log(hidden, simulate(hidden, drive.u), seed=7, known=straight)
    stage = stages.fit_machine(straight.machine, [one], straight.machine.filter)
    told = stages.fit_with_process_noise(replace(stage, process_noise_fit=None), run_in_turn)
    assert (told.fit.process_noise, told.is_close, told.estimated) == (pytest.approx(forces), near, settled)
    if not settled:
        np.testing.assert_allclose(told.fit.X, straight.nominal, rtol=1e-3)


@pytest.mark.parametrize(
    ("status", "step", "misfit", "limit", "found"),
    [
        ("converged", 0.01, 1.0, np.inf, True),
        ("converged", 0.01, 5.0, np.inf, True),
        ("stalled", 0.9, 5.0, np.inf, True),
        ("stalled", 3.0, 1.2, np.inf, True),  # near the logs
        ("stalled", 3.0, 1.4, np.inf, False),
        ("stalled", 3.0, 1.2, 1.1, False),
        ("stopped", 3.0, 1.2, np.inf, False),
        ("out of range", np.inf, np.inf, np.inf, False),
    ],
)
def test_a_fit_that_came_near_the_log_is_gone_on_with(
    status: Any,
    step: float,
    misfit: float,
    limit: float,
    found: bool,
    straight: Model,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Though its steps were still large; far from the log, or behind what was found already, it is given up."""
    stage = calm(straight)
    ended = replace(stage.fit, status=status, step=step, cost=misfit * stage.expected_cost)
    monkeypatch.setattr(smoothing, "fit_logs", lambda *given: ended)
    wished = [(stage.machine, stage, 0.0)]
    (tried,) = stages.refit_all(wished, run_in_turn, limit * stage.expected_cost)
    assert (tried is not None) == found
    if tried is None:
        with pytest.raises(NotConvergedError, match=status):
            stages.resume_fit(stage.data, stage, 0.0, limit * stage.expected_cost)


@pytest.mark.slow
def test_who_gains_too_little_with_coarse_sensors_is_given_up(
    straight: Model, sloping: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first candidate on; the right one isn't."""
    stage = stages.fit_machine(straight.machine, [log.read_log(sloping, straight.machine)], straight.machine.filter)
    true, bars = selection.refit_all, list[float]()

    def noted(wishes: Any, together: Any, most: float) -> Any:
        bars.append(most)
        return true(wishes, together, most)

    monkeypatch.setattr(selection, "refit_all", noted)
    found = selection.choose_with_inflated_noise(stage, run_in_turn)
    assert found is not None
    assert [x.name for x in found[1]] == ["ground_slope@machine"]
    assert (
        bars[0]
        == stage.fit.cost - selection.CANDIDATE_PROGRESS_SHARE * selection.MIN_EXCESS_SHARE[1] * stage.excess_cost
    )
    assert stage.data.noise_inflation > 1


@pytest.mark.slow
def test_who_stays_behind_is_given_up(straight: Model, sloping: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where forces leave much a candidate is fitted as long as it comes to half of what it must gain, and where those
    that were fitted first gained that, the others as long as they come to half of what these did."""
    iterate = smoothing.fit_logs
    bars: list[tuple[str, float]] = []

    def noted(c: Any, *args: Any, **more: Any) -> Fit:
        if len(args) > 6 and c.model.effects:
            bars.append((c.model.effects[0].name, args[6].cost_limit))
        return iterate(c, *args, **more)

    monkeypatch.setattr(smoothing, "fit_logs", noted)
    stage = stages.fit_machine(straight.machine, [log.read_log(sloping, straight.machine)], straight.machine.filter)
    assert not stage.exact
    assert not stage.is_close
    scores = selection.score_effects(stage, run_in_turn)
    best = {s.candidate.name: s for s in reversed(scores) if s.values["A"] != 0}
    likely = sorted(best.values(), key=lambda s: -s.likelihood_ratio)[:3]
    assert selection.FIRST_BATCH == 2
    alike = [replace(s, likelihood_ratio=likely[0].likelihood_ratio - k) for k, s in enumerate(likely)]
    choice = selection.choose_effect(stage, alike, (), run_in_turn, lambda share, what: None, 0.0)
    assert choice is not None
    assert choice.name == "ground_slope@machine"
    first = (
        stage.fit.cost - selection.CANDIDATE_PROGRESS_SHARE * selection.MIN_EXCESS_SHARE_OF_FIRST * stage.excess_cost
    )
    bar = stage.fit.cost - selection.CANDIDATE_PROGRESS_SHARE * choice.likelihood_ratio
    assert bars[:3] == [
        (s.candidate.name, pytest.approx(most)) for s, most in zip(likely, (first, first, bar), strict=True)
    ]
    texts = ("ground_slope=0.009", "roll_unbalance@rear_roll=500")
    machines = [placing.with_effects(straight.machine, placing.parse_effect(t, straight.machine, 40.0)) for t in texts]
    for most, found in ((np.inf, [True, True]), (bar, [True, False])):
        tried = stages.refit_all([(m, stage, stage.fit.process_noise) for m in machines], run_in_turn, most)
        assert [x is not None for x in tried] == found

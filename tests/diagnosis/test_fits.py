"""How fits to logs are found, gone on with and given up."""

from __future__ import annotations

import itertools
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

from excite import identification, smoothing
from excite.diagnosis import fits as stages, run_forked, selection
from excite.diagnosis.parallel import run_in_turn
from excite.logs import log
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.simulation import Motion, simulate
from excite.smoothing import gauss_newton


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
            raise gauss_newton.NotConvergedError("no fit")
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


def test_coarse_sensors_are_no_measure_of_how_near_sharp_ones_come(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit that goes on from one with coarse sensors, and comes near the logs, is gone on with; from one with sensors
    as they are it must come nearer by far than that."""
    stage = calm(straight)
    calls = list[float]()

    def nearly(*given: Any) -> gauss_newton.Fit:
        calls.append(given[5])
        if len(calls) == 1:
            raise gauss_newton.NotConvergedError("no fit", replace(stage.fit, cost=1.1 * stage.expected_cost), 5.0)
        return stage.fit

    monkeypatch.setattr(smoothing, "fit_logs", nearly)
    coarse = replace(stage, data=stages.inflate_sensor_noise(stage.data, 10.0))
    coarse = replace(coarse, fit=replace(stage.fit, cost=coarse.expected_cost))
    assert coarse.is_close
    assert stages.resume_fit(stage.data, coarse, 0.0).cost == stage.fit.cost
    assert calls == [0.0, 0.0]
    calls.clear()
    with pytest.raises(gauss_newton.NotConvergedError):
        stages.resume_fit(stage.data, stage, 0.0)


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


def test_a_fit_whose_steps_cease_to_shrink_ends(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Near an answer as one that is as good as found, far from any without; whoever is patient goes on for longer."""
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    steps: list[float] = []

    def scripted(*args: Any) -> Any:
        covariance, move, _, cost = true(*args)
        return covariance, move, steps.pop(0), cost

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    for end, spent, found in ((0.3, 7, True), (30.0, 8, False)):
        for patient, passes in ((True, 14), (False, spent)):
            steps[:] = [500.0, 90.0, 80.0, 40.0, *[end] * 10]
            with pytest.raises(gauss_newton.NotConvergedError) as failed:
                gauss_newton.fit_logs(
                    p.space,
                    p.measurements,
                    stage.fit.trajectories,
                    stage.fit.X,
                    p.starts,
                    0.0,
                    p.held,
                    passes=14,
                    patient=patient,
                )
            hopeless = gauss_newton.HOPELESS_PASSES + 1 if patient and not found else passes
            assert 14 - len(steps) == hopeless
            assert (failed.value.acceptable_fit is not None) == found


def test_a_fit_is_found_where_its_steps_are_small_enough(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """With disturbing forces, whose deviations are no promise, sooner than without, unless that is asked for."""
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    steps: list[float] = []

    def scripted(*args: Any) -> Any:
        covariance, move, _, cost = true(*args)
        return covariance, move, steps.pop(0), cost

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    for disturbed, enough, spent in (
        (0.0, None, 5),
        (0.1, None, 4),
        (0.0, gauss_newton.SUFFICIENT_STEP, 4),
        (0.1, gauss_newton.ACCEPTABLE_STEP, 3),
    ):
        steps[:] = [5.0, 1.5, 0.5, 0.15, 1e-4, 1e-4]
        gauss_newton.fit_logs(
            p.space,
            p.measurements,
            stage.fit.trajectories,
            stage.fit.X,
            p.starts,
            disturbed,
            p.held,
            passes=6,
            sufficient_step=enough,
        )
        assert 6 - len(steps) == spent


@pytest.mark.parametrize(("falling", "misfit", "found"), [(5.0, 1.1, True), (0.0, 1.1, False), (5.0, 2.0, False)])
def test_a_fit_that_goes_downhill_goes_on(
    falling: float, misfit: float, found: bool, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A parameter that must become many times as large takes many passes, whose steps grow first: near the logs, as
    long as costs fall, that is no swing about an answer."""
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    steps, costs = list[float](), list[float]()

    def scripted(*args: Any) -> Any:
        covariance, move, *_ = true(*args)
        ahead = [np.full_like(m, 1e-6) for m in move]
        costs.append(misfit * stage.expected_cost - falling * len(costs))
        return covariance, ahead, steps.pop(0), costs[-1]

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    steps[:] = [500.0, 90.0, 3.0, 0.9, 1.0, 1.4, 1.8, 2.1, 1.9, 1.2, 0.3, 0.1, 0.01, 1e-4]
    given = p.space, p.measurements, stage.fit.trajectories, stage.fit.X, p.starts, 0.0, p.held
    if found:
        told = steps.copy()
        fit = gauss_newton.fit_logs(*given, passes=14, patient=False)
        assert fit.cost == costs[-1]
        assert len(costs) >= 13
        # Where passes run out on the way, what was passed is not as good as found.
        steps[:], costs[:] = told, []
        with pytest.raises(gauss_newton.NotConvergedError) as failed:
            gauss_newton.fit_logs(*given, passes=8, patient=False)
        assert (failed.value.step, failed.value.acceptable_fit) == (2.1, None)
    else:
        with pytest.raises(gauss_newton.NotConvergedError) as failed:
            gauss_newton.fit_logs(*given, passes=14, patient=False)
        assert failed.value.step == 0.9
        assert len(costs) < 9


@pytest.mark.parametrize(
    ("misfit", "patient", "spent"), [(1.1, False, 4), (2.0, False, 3), (2.0, True, 4)], ids=["near", "far", "patient"]
)
def test_far_from_the_logs_forces_need_no_more_than_nearly(
    misfit: float, patient: bool, spent: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Near them costs are compared that hardly differ."""
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    steps: list[float] = [5.0, 1.5, 0.5, 0.15, 1e-4]

    def scripted(*args: Any) -> Any:
        covariance, move, *_ = true(*args)
        return covariance, move, steps.pop(0), misfit * stage.expected_cost

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    given = p.space, p.measurements, stage.fit.trajectories, stage.fit.X, p.starts, 0.1, p.held
    gauss_newton.fit_logs(*given, passes=5, patient=patient)
    assert 5 - len(steps) == spent


def test_small_forces_are_fitted_as_closely_as_none(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """What they leave out is compared with small gains; of large ones nobody asks so much."""
    stage, asked = calm(straight), dict[float, float]()

    def noted(*given: Any) -> gauss_newton.Fit:
        asked[given[5]] = given[9]
        return stage.fit

    monkeypatch.setattr(smoothing, "fit_logs", noted)
    for disturbed in (0.0, stages.MIN_PROCESS_NOISE, 1.0):
        stages.refit(straight.machine, stage, disturbed)
    assert asked == {
        0.0: gauss_newton.SUFFICIENT_STEP,
        stages.MIN_PROCESS_NOISE: gauss_newton.SUFFICIENT_STEP,
        1.0: gauss_newton.ACCEPTABLE_STEP,
    }


def test_smaller_forces_side_by_side_are_the_smallest_that_do(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is done at once, the first of them counts with which there is a fit."""
    stage, asked = calm(straight), list[float]()
    loose = replace(stage, fit=replace(stage.fit, process_noise=1.0))

    def at_once(calls: Sequence[Callable[[], Any]]) -> Generator[Any, None, None]:
        return (x for x in [call() for call in calls])

    def resumable(prepared: Any, of: stages.ExtendedFit, disturbed: float, *given: Any) -> gauss_newton.Fit:
        asked.append(disturbed)
        if disturbed < least:
            raise gauss_newton.NotConvergedError("no fit")
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


def test_a_fit_that_is_not_worth_more_passes_is_given_up(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as its cost doesn't fall in two passes, from the fourth on; not while it falls, nor where it costs no
    more."""
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    seen: list[Any] = []

    def scripted(c: Any, records: Any, linear: Any, *asked: Any) -> Any:
        covariance, move, *_ = true(c, records, linear, *asked)
        if not any(linear is x for x in seen):  # one pass is computed twice
            seen.append(linear)
        return covariance, move, 25.0, costs[min(len(seen), len(costs)) - 1]

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    for costs, spent in (
        ([900.0, 900.0], 4),
        ([900.0, 800.0, 700.0, 600.0, 550.0, 549.0, 548.0], 7),
        ([900.0, 400.0, 300.0, 450.0], 8),
        ([900.0, 400.0, 300.0, 600.0], 4),
    ):
        seen.clear()
        with pytest.raises(gauss_newton.NotConvergedError) as failed:
            gauss_newton.fit_logs(
                p.space,
                p.measurements,
                stage.fit.trajectories,
                stage.fit.X,
                p.starts,
                0.0,
                p.held,
                passes=8,
                stalled_cost_limit=500.0,
            )
        assert len(seen) == spent
        assert failed.value.fit is not None
        assert failed.value.fit.cost == costs[-1]


@pytest.mark.parametrize(
    ("steps", "spent"),
    [
        ([400.0, 300.0, 200.0, 100.0, 190.0], 5),  # hardly less than two passes before
        ([400.0, 300.0, 200.0, 100.0, 170.0, 91.0], 6),
        ([400.0, 300.0, 200.0, 100.0, 170.0, 80.0, 29.0, 29.0], 8),  # large no more
        ([400.0, 300.0, 200.0, 100.0, 170.0, 80.0, 140.0, 70.0], 8),
    ],
)
def test_steps_that_stay_large_end_a_fit(
    steps: list[float], spent: int, straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    seen: list[Any] = []

    def scripted(c: Any, records: Any, linear: Any, *asked: Any) -> Any:
        covariance, move, *_ = true(c, records, linear, *asked)
        if not any(linear is x for x in seen):
            seen.append(linear)
        return covariance, move, steps[min(len(seen), len(steps)) - 1], 500.0

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    with pytest.raises(gauss_newton.NotConvergedError):
        gauss_newton.fit_logs(
            p.space, p.measurements, stage.fit.trajectories, stage.fit.X, p.starts, 0.0, p.held, passes=8
        )
    assert len(seen) == spent


def test_what_is_held_is_where_it_is_held_a_pass_later(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """However far it went until the log was known not to show it, and however much it makes sense above zero only; how
    far it is from there is no step, but nothing is found, not even nearly, before it is there."""
    stage = calm(straight)
    p, true, scale = stage.data, gauss_newton.newton_step, stage.model.scale
    nominal = stage.model.nominal
    sure = stage.fit.std / np.maximum(np.abs(stage.fit.X), scale)
    worst = int(np.argmax(np.where(p.held, 0.0, sure)))
    seen: list[tuple[float, float]] = []
    steps: list[float] = []

    def blind(c: Any, records: Any, linear: Any, points: Any, X: np.ndarray, prior: np.ndarray, damping: float) -> Any:
        covariance, move, step, cost = true(c, records, linear, points, X, prior, damping)
        for m in move:  # the others only creep
            m[np.arange(len(X)) != worst] *= 0.01
        if prior[worst] < gauss_newton.HELD_STD**-2:
            covariance[worst, worst] = 1e6
            for m in move:
                m[worst] *= 0.01
        seen.append((X[worst], step))
        return covariance, move, steps.pop(0) if steps else step, cost

    monkeypatch.setattr(gauss_newton, "newton_step", blind)
    monkeypatch.setitem(vars(p.space.model), "positive", np.arange(len(scale)) == worst)
    X = stage.fit.X + 30 * scale * (np.arange(len(scale)) == worst)
    for told, disturbed in (([], 0.0), ([50.0, 50.0, 50.0, 50.0, 0.005], 0.0), ([50.0, 50.0, 50.0, 50.0, 0.1], 0.1)):
        seen.clear()
        steps[:] = [*told, *[50.0 for _ in told]]
        with pytest.raises(gauss_newton.NotConvergedError) as failed:
            gauss_newton.fit_logs(
                p.space, p.measurements, stage.fit.trajectories, X, p.starts, disturbed, p.held, 0.0, passes=7
            )
        assert abs(seen[gauss_newton.SETTLING_PASSES][0] - nominal[worst]) > 20 * scale[worst]
        # The pass in which it is held is computed twice.
        assert seen[gauss_newton.SETTLING_PASSES + 2][0] == pytest.approx(
            nominal[worst], abs=gauss_newton.HELD_TOLERANCE * scale[worst]
        )
        assert max(step for _, step in seen[gauss_newton.SETTLING_PASSES + 1 :]) < 1e4
        assert failed.value.fit is not None
        assert failed.value.fit.unidentifiable[worst]
        assert failed.value.acceptable_fit is None or not told


@pytest.mark.parametrize("effect", ["torque_deadband@front_roll=20", "torque_deadband@front_roll=0.001"])
def test_what_makes_sense_above_zero_only_ends_there(straight: Model, effect: str) -> None:
    """A log that would like an amount best below zero has it near zero, all others where they are without it."""
    stage = calm(straight)
    machine = placing.with_effects(straight.machine, placing.parse_effect(effect, straight.machine, 10.0))
    p, without = stages.adapt_data(machine, stage), stage.fit
    fit = stages.iterate(p, p.starts, p.space.model.nominal, 0.0, patient=True)
    (amount,) = (k for k, name in enumerate(p.space.model.base.names) if name not in straight.base.names)
    assert 0 < fit.X[amount] < gauss_newton.CONVERGED_STEP * fit.std[amount]
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


@pytest.mark.parametrize("alike", [-0.9, 0.9])
def test_steps_within_bounds_are_the_best_there_are(alike: float) -> None:
    """Of two parameters that would both go below, one may go up beside the other; and one that would go up may go below
    beside another: against all four ways of holding them."""
    information = np.array([[1.0, alike, 0.1], [alike, 1.0, 0.0], [0.1, 0.0, 2.0]])
    lowest = np.array([-0.1, -0.2, -np.inf])
    for wanted in ((-10.0, -5.0, 1.0), (-1.0, 0.5, 3.0), (2.0, -3.0, 0.0)):
        slope = -information @ wanted
        best, least = np.array(wanted), np.inf
        for held in itertools.product((False, True), (False, True), (False,)):
            free = ~np.array(held)
            step = np.where(free, 0.0, lowest)
            rest = slope + information[:, ~free] @ step[~free]
            step[free] = -np.linalg.solve(information[np.ix_(free, free)], rest[free])
            cost = 2 * slope @ step + step @ information @ step
            if (step >= lowest - 1e-12).all() and cost < least:
                best, least = step, cost
        found = gauss_newton._bounded_step(lowest, -np.linalg.solve(information, slope), information, slope)
        np.testing.assert_allclose(found, best, atol=1e-9)
    unknown = np.full(3, np.nan)
    np.testing.assert_array_equal(gauss_newton._bounded_step(lowest, unknown, information, unknown), unknown)
    without_root = np.eye(3) + 2 * (np.eye(3, k=1) + np.eye(3, k=-1))
    np.testing.assert_array_equal(
        gauss_newton._bounded_step(lowest, np.full(3, -1.0), without_root, slope), [-0.1, -0.2, -1.0]
    )


@pytest.mark.parametrize("scales", [-20, 20])
def test_a_step_that_was_cut_short_goes_further_when_it_is_told_again(scales: int, straight: Model) -> None:
    """A torque offset twenty times its scale off is found. In steps of half its size the fit would be given up."""
    stage = calm(straight)
    p, k = stage.data, stage.model.base.names.index("u10")
    off = scales * stage.model.scale * (np.arange(len(stage.fit.X)) == k)
    shifted = [replace(r, torque=r.torque + np.array([off[k], 0.0])) for r in p.measurements]
    found = gauss_newton.fit_logs(p.space, shifted, stage.fit.trajectories, stage.fit.X, p.starts, 0.0, p.held, 0.0)
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
def test_a_fit_goes_on_without_what_was_not_seen(
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

    def noted(*given: Any) -> gauss_newton.Fit:
        told.append(given[13])
        return stage.fit

    monkeypatch.setattr(smoothing, "fit_logs", noted)
    stages.resume_fit(more, of, asked)
    assert [n for n, yes in zip(more.space.model.base.names, told[0], strict=True) if yes] == (["u10"] if held else [])


def test_what_was_not_seen_is_judged_again(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the log shows after all is let go: before a fit is found, however soon that is. What it doesn't show never
    leaves the file's value."""
    stage = calm(straight)
    p, names = stage.data, stage.model.base.names
    k = names.index("u10")
    assert not stage.fit.unidentifiable[k]
    untold = np.arange(len(names)) == k
    start = np.where(untold, stage.model.nominal, stage.fit.X)
    true, passes = gauss_newton.linearise_log, list[float]()

    def noted(c: Any, r: Any, point: Any, first: Any, X: np.ndarray, *asked: Any) -> Any:
        passes.append(float(X[k]))
        return true(c, r, point, first, X, *asked)

    monkeypatch.setattr(gauss_newton, "linearise_log", noted)
    asked = p.space, p.measurements, stage.fit.trajectories, start, p.starts, 0.0, p.held, gauss_newton.RESUMED_DAMPING
    found = gauss_newton.fit_logs(*asked, initially_held=untold)
    assert not found.unidentifiable[k]
    assert abs(found.X[k] - stage.fit.X[k]) < 0.1 * stage.fit.std[k]
    one = make_log(straight, gentle(straight, 8.0), seed=3)
    stage = stages.fit_machine(straight.machine, [one], straight.machine.filter)
    p, k = stage.data, names.index("Fv1")
    untold = np.arange(len(names)) == k
    passes.clear()
    held = gauss_newton.fit_logs(
        p.space, p.measurements, stage.fit.trajectories, stage.fit.X, p.starts, 0.0, p.held, initially_held=untold
    )
    assert held.unidentifiable[k]
    assert passes == pytest.approx(
        [stage.model.nominal[k]] * len(passes), abs=gauss_newton.HELD_TOLERANCE * stage.model.scale[k]
    )


@pytest.mark.parametrize(
    ("slope", "seconds", "forces", "near", "settled"),
    [
        (0.0005, 12.0, 0.0, True, True),
        (0.002, 12.0, stages.PROCESS_NOISE_REDUCTIONS[0] * identification.PROCESS_NOISE_LEVELS[1], True, True),
        (0.03, 40.0, identification.PROCESS_NOISE_LEVELS[1], False, True),
        (0.1, 12.0, identification.PROCESS_NOISE_LEVELS[0], False, False),
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


def test_a_fit_that_fails_stands_where_it_was_as_good_as_found(
    straight: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise where it was last. Steps that swing between what costs alike end a fit under disturbing forces as well:
    none by exact dynamics, none whose costs rise or still fall."""
    stage = calm(straight)
    p, true = stage.data, gauss_newton.newton_step
    seen: list[np.ndarray] = []
    far = [500.0, 90.0, 80.0]

    def failed(sizes: list[float], costs: list[float], disturbed: float) -> gauss_newton.NotConvergedError:
        steps = iter(zip(sizes, costs, strict=True))
        seen.clear()

        def scripted(*args: Any) -> Any:
            covariance, move, *_ = true(*args)
            seen.append(args[4])
            return covariance, move, *next(steps)

        monkeypatch.setattr(gauss_newton, "newton_step", scripted)
        points, X = stage.fit.trajectories, stage.fit.X * 1.01
        with pytest.raises(gauss_newton.NotConvergedError) as raised:
            gauss_newton.fit_logs(
                p.space, p.measurements, points, X, p.starts, disturbed, p.held, passes=10, patient=False
            )
        return raised.value

    end = failed([*far, 4.0, 0.6, 0.8, 5.0, 4.0, 6.0, 20.0], [1000.0] * 10, 0.0)
    assert end.acceptable_fit is not None
    assert (end.step, end.acceptable_fit.X.tolist()) == (0.6, seen[4].tolist())
    for costs, disturbed, swung in (
        ([1000.0, 1010.0] * 5, 0.1, True),
        ([1000.0, 1010.0] * 5, 0.0, False),
        ([1000.0 * 2**k for k in range(10)], 0.1, False),
        ([1000.0 / 1.2**k for k in range(10)], 0.1, False),
    ):
        end = failed([*far, *[5.0] * 7], costs, disturbed)
        assert (end.acceptable_fit, end.step) == (None, 5.0)
        assert end.fit is not None
        assert end.fit.X.tolist() == seen[-1].tolist()
        assert (end.oscillating_fit is end.fit) == swung


def test_a_fit_that_came_near_the_log_is_gone_on_with(straight: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """By exact dynamics: with disturbing forces every fit comes near, unless they are none larger than those with which
    a stage didn't. Far from the log it is given up, behind what was found already as well, and where a stage was near
    before."""
    stage = calm(straight)
    true, steps, times = gauss_newton.newton_step, list[float](), [1.0]

    def scripted(*args: Any) -> Any:
        covariance, move, _, cost = true(*args)
        return covariance, move, steps.pop(0), times[0] * cost

    monkeypatch.setattr(gauss_newton, "newton_step", scripted)
    lost = [500.0, 90.0, 80.0, 40.0, *[30.0] * 4]
    off = replace(stage, fit=replace(stage.fit, cost=2 * stage.expected_cost))
    loose = replace(off, fit=replace(off.fit, process_noise=0.1))
    for of, disturbed, far, most, found in (
        (off, 0.0, 1.0, np.inf, True),
        (off, 0.0, 2.0, np.inf, False),
        (off, 0.1, 1.0, np.inf, False),
        (loose, 0.1, 1.0, np.inf, True),
        (loose, 0.1, 2.0, np.inf, False),
        (loose, 0.1, 1.0, stage.fit.cost / 2, False),
        (loose, 0.2, 1.0, np.inf, False),
        (replace(loose, fit=replace(loose.fit, cost=stage.expected_cost)), 0.1, 1.0, np.inf, False),
        (off, 0.0, 1.0, stage.fit.cost / 2, False),
        (stage, 0.0, 1.0, np.inf, False),
    ):
        steps[:], times[0] = [*lost, 1.0, 0.01, 1e-4, 1e-6], far
        (tried,) = stages.refit_all([(stage.machine, of, disturbed)], run_in_turn, most)
        assert (tried is not None) == found
        if tried is None:
            assert len(steps) >= 4
        else:
            assert tried.fit.cost == pytest.approx(stage.fit.cost, abs=20 if disturbed else 1)


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
    iterate = gauss_newton.fit_logs
    bars: list[tuple[str, float]] = []

    def noted(c: Any, *args: Any, **more: Any) -> gauss_newton.Fit:
        if len(args) > 9 and c.model.effects:
            bars.append((c.model.effects[0].name, args[9]))
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

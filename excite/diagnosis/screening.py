"""Fit machines with other effects from initial trajectories, most of them only to the beginning of the logs.

Most such fits fail. A fit to the first part of each log shows it in a fraction of the time; only machines that pass are
fitted to the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from excite import smoothing
from excite.diagnosis.fits import (
    COST_TOLERANCE,
    LOST_COST_RATIO,
    MIN_PROCESS_NOISE,
    ExtendedFit,
    FitData,
    FitPair,
    adapt_data,
    assemble_fit,
    fit_from_start,
    fit_reducing_process_noise,
    inflate_sensor_noise,
    iterate,
    resume_fit,
)
from excite.diagnosis.parallel import CallRunner
from excite.model.machine import Machine
from excite.smoothing import NotConvergedError, Trajectory

MIN_BEGINNING_S = 30.0  # shortest beginning of a log [s]; chosen
BRIEF_PASSES = 2  # passes after which a useless effect is recognised; chosen
MIN_BRIEF_REDUCTION = 0.1  # share by which an effect must reduce the cost by then; chosen
BEGINNING_SHARES = 0.25, 0.33, 0.4, 0.5  # shares of the logs that are tried as their beginning, in turn; chosen
MIN_EXCESS_SHARE_OF_BEGINNING = 0.15  # share of the excess cost that the beginning must contain; chosen
CANDIDATE_PROGRESS_SHARE = 0.5  # share of the required gain that is asked of a few passes or the beginning; chosen


@dataclass(frozen=True)
class ScreeningTest:
    """A test of a fit to the beginning of each log.

    samples: number of samples of each log. cost_limit: largest cost there of a fit that is worth the whole logs.
    accept_converged: a nearly converged fit passes as well. full_iteration: judge the converged fit, not a few passes.
    cost_without: cost there of the model without a further effect, after BRIEF_PASSES.
    """

    samples: tuple[int, ...]
    cost_limit: float
    accept_converged: bool = False
    full_iteration: bool = False
    cost_without: float = np.inf


def fit_screened(
    machines: Sequence[Machine],
    previous: ExtendedFit,
    process_noise: float,
    runner: CallRunner,
    max_cost: float = np.inf,
    enough: Callable[[int, ExtendedFit], bool] = lambda k, stage: False,
    min_beginning_s: float = MIN_BEGINNING_S,
) -> Iterator[ExtendedFit | None]:
    """Fit machines with other effects to the logs of a previous fit, side by side; None for each that fails.

    process_noise: level of the fits, reduced where it gives a close fit. With noise, a fit that is not close fails.
        With exact dynamics, a fit fails that costs more than max_cost or is LOST_COST_RATIO off; one that is not close
        gets a little process noise if that brings it close or if it does not track the logs.
    enough: tells, by the number of a machine and its fit, that only close fits are of use from there on.
    min_beginning_s: shortest beginning of a log that is fitted first [s]; none if it is above half of all logs.

    Fits whose beginning shows that they will fail are not continued.
    """
    lengths, at = _beginning_lengths(previous.data, min_beginning_s), 0
    tests = [_screening_test(previous, lengths, process_noise, max_cost)]
    close_test = _test_of_close_fit(previous, lengths)
    while at < len(machines):
        calls = [partial(_fit_if_promising, m, previous, tuple(tests), process_noise, max_cost) for m in machines[at:]]
        with closing(runner(calls)) as results:
            for fits in results:
                machine, at = machines[at], at + 1
                stage = assemble_fit(machine, _restart_data(machine, previous), *fits) if fits else None
                yield stage
                if close_test is not None and len(tests) == 1 and stage is not None and enough(at - 1, stage):
                    tests.append(replace(close_test, full_iteration=True))
                    break


def _beginning_lengths(data: FitData, min_beginning_s: float) -> list[tuple[int, ...]]:
    """Return possible lengths of the beginning, samples of each log, shortest first; none above half of all samples."""
    rate, lengths = float(data.space.model.machine.sampling_hz), [len(r.used) for r in data.measurements]
    lengths_by_share = (
        tuple(min(n, max(round(min_beginning_s * rate), int(share * n))) for n in lengths) for share in BEGINNING_SHARES
    )
    return [samples for samples in dict.fromkeys(lengths_by_share) if 2 * sum(samples) <= sum(lengths)]


def _cut_data(data: FitData, samples: Sequence[int]) -> FitData:
    """Keep the first samples of each log."""
    measurements = tuple(r.until(n) for r, n in zip(data.measurements, samples, strict=True))
    return replace(data, measurements=measurements, starts=tuple(map(Trajectory.until, data.starts, samples)))


def _screening_test(
    previous: ExtendedFit, lengths: Sequence[tuple[int, ...]], process_noise: float, max_cost: float
) -> ScreeningTest | None:
    """Choose the test that shows early which fits fail; None if no half of the logs shows it.

    lengths: possible lengths of the beginning, samples of each log, shortest first.
    """
    if process_noise > 0:
        test = _test_of_close_fit(previous, lengths)
    elif np.isinf(max_cost):
        test = _test_of_tracking(previous, lengths)
    else:
        test = _test_of_gain(previous, lengths, max_cost) if previous.estimated and previous.exact else None
    if test is None:
        return None
    cost, _ = _fit_beginning(
        _cut_data(inflate_sensor_noise(previous.data, 1.0), test.samples), process_noise, np.inf, BRIEF_PASSES
    )
    return replace(test, cost_without=cost or np.inf)


def _test_of_close_fit(previous: ExtendedFit, lengths: Sequence[tuple[int, ...]]) -> ScreeningTest | None:
    """Use the shortest beginning: it must not cost more beyond noise than a close fit of the whole logs may."""
    if not lengths:
        return None
    return ScreeningTest(
        lengths[0],
        _cut_data(previous.data, lengths[0]).n_readings
        + (smoothing.CLOSE_FIT_COST_RATIO - 1) * previous.data.n_readings,
    )


def _test_of_tracking(previous: ExtendedFit, lengths: Sequence[tuple[int, ...]]) -> ScreeningTest | None:
    """Use the shortest beginning on which the model without a further effect is lost, else the shortest."""
    tests = [ScreeningTest(x, LOST_COST_RATIO * _cut_data(previous.data, x).n_readings, True) for x in lengths]
    true_noise = inflate_sensor_noise(previous.data, 1.0)
    return next((x for x in tests if not _passes_screening(true_noise, x, 0.0)), tests[0] if tests else None)


def _test_of_gain(previous: ExtendedFit, lengths: Sequence[tuple[int, ...]], max_cost: float) -> ScreeningTest | None:
    """Use the shortest beginning with a fair part of the excess cost, which a fit must reduce as well as the whole."""
    part = CANDIDATE_PROGRESS_SHARE * (previous.fit.cost - max_cost) / max(previous.excess_cost, 1e-9)
    squares = [np.square(log.white.E[:, :, 0]).sum(axis=1, dtype=float) for log in previous.fitted_logs]
    for samples in lengths:
        beginning = _cut_data(previous.data, samples)
        cost = sum(float(x[:n].sum()) for x, n in zip(squares, samples, strict=True))
        if (
            cost - (1 + COST_TOLERANCE) * beginning.expected_cost
            >= MIN_EXCESS_SHARE_OF_BEGINNING * previous.excess_cost
        ):
            cost = _fit_beginning(beginning, 0.0, np.inf)[0] or cost  # after the same few passes as the others
            return ScreeningTest(samples, cost - part * max(0.0, cost - (1 + COST_TOLERANCE) * beginning.expected_cost))
    return None


def _passes_screening(data: FitData, test: ScreeningTest | None, process_noise: float) -> bool:
    """Tell if a fit to the beginning of the logs may come to what is asked."""
    if test is None:
        return True
    beginning = _cut_data(data, test.samples)
    brief = max(test.cost_limit, (1 - MIN_BRIEF_REDUCTION) * test.cost_without)
    if not np.isinf(brief) and _fit_beginning(beginning, process_noise, np.inf, BRIEF_PASSES)[0] > brief:
        return False
    if test.full_iteration:
        cost, found = _fit_beginning(beginning, process_noise, np.inf, smoothing.MAX_PASSES)
    else:
        cost, found = _fit_beginning(beginning, process_noise, test.cost_limit)
    return cost <= test.cost_limit or (found and test.accept_converged)


def _fit_beginning(
    beginning: FitData, process_noise: float, cost_limit: float, passes: int = smoothing.SETTLING_PASSES + 1
) -> tuple[float, bool]:
    """Return the cost of a fit to the beginning after a few passes, and whether it nearly converged.

    cost_limit: cost above which the fit is given up. The cost is 0 if there is no fit.
    """
    X = beginning.space.model.nominal
    try:
        return iterate(beginning, beginning.starts, X, process_noise, passes=passes, cost_limit=cost_limit).cost, True
    except NotConvergedError as failed:
        return (0.0 if failed.fit is None else failed.fit.cost), failed.acceptable_fit is not None


def _fit_if_promising(
    machine: Machine,
    previous: ExtendedFit,
    tests: Sequence[ScreeningTest | None],
    process_noise: float,
    max_cost: float,
) -> FitPair | None:
    """Fit from initial trajectories, as in `fit_screened`; None if the fit fails the tests or is not found."""
    data = _restart_data(machine, previous)
    if not all(_passes_screening(data, test, process_noise) for test in tests):
        return None
    if process_noise > 0:
        return fit_reducing_process_noise(
            machine, data, process_noise, smoothing.CLOSE_FIT_COST_RATIO * data.expected_cost
        )
    return _fit_exact(machine, data, max_cost)


def _fit_exact(machine: Machine, data: FitData, max_cost: float) -> FitPair | None:
    """Fit exact dynamics, adding a little process noise if the fit is not close; None above max_cost."""
    fit = fit_from_start(data, 0.0, LOST_COST_RATIO * data.n_readings, max_cost)
    if fit is None or fit.cost > max_cost:
        return None
    stage = assemble_fit(machine, data, fit)
    if stage.is_close:
        return fit, None
    try:
        process_noise_fit = resume_fit(data, stage, MIN_PROCESS_NOISE)
    except NotConvergedError:
        return fit, None
    return (
        fit if stage.tracks_logs and not replace(stage, fit=process_noise_fit).is_close else process_noise_fit
    ), None


def _restart_data(machine: Machine, previous: ExtendedFit) -> FitData:
    """Prepare the logs of a previous fit for a machine with other effects, with the true sensor noise."""
    return inflate_sensor_noise(adapt_data(machine, previous), 1.0)

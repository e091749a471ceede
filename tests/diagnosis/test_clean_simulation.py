"""The misfit that a fit leaves beyond what clean logs of the fitted machine leave."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.attacks import attack, simulate as attacked
from support.blind import ask, blind, case
from support.drives import designed
from support.logs import logged, make_log

from excite.diagnosis import count_false_alarms, diagnose, run_forked
from excite.diagnosis.clean_simulation import MIN_STDS, RUNS, measure_remainder
from excite.diagnosis.fits import fit_machine
from excite.logs import Log, from_table, read_log
from excite.model import Model
from excite.simulation import Motion
from excite.smoothing import Lacking, UnknownForces, solver


@pytest.fixture(scope="module")
def clean(straight: Model, straight_motion: Motion) -> Log:
    return make_log(straight, straight_motion, seed=5)


def test_a_clean_log_leaves_nothing(straight: Model, clean: Log) -> None:
    stage = fit_machine(straight.machine, [clean], straight.machine.filter)
    found = measure_remainder(stage)
    assert found is not None
    assert found.chi2 == 0.0
    # the cost is far from one for each reading, and as far in the simulated logs
    assert abs(stage.fit.cost - stage.data.n_readings) > found.std


def test_an_error_of_one_sensor_is_found_in_that_sensor(straight: Model, clean: Log) -> None:
    """Vibration of a measuring wheel, too small for any test of anomalies, is stated with its sensor."""
    shaken = clean.values["thetal"] + 2e-4 * np.random.default_rng(0).standard_normal(len(clean))
    log = replace(clean, values={**clean.values, "thetal": shaken})
    stage = fit_machine(straight.machine, [log], straight.machine.filter)
    found = measure_remainder(stage)
    assert found is not None
    assert found.chi2 > MIN_STDS * found.std
    assert found.signal == "thetal"
    assert found.ratio > 1.05
    assert "thetal" in str(found)


def test_simulated_logs_are_fitted_from_their_motions_in_few_passes(
    straight: Model, clean: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, passes, true = fit_machine(straight.machine, [clean], straight.machine.filter), [], solver.Quadratic.step

    def counted(quadratic: solver.Quadratic, damping: float) -> np.ndarray:
        passes.append(quadratic)
        return true(quadratic, damping)

    monkeypatch.setattr(solver.Quadratic, "step", counted)
    assert measure_remainder(stage) is not None
    assert len({id(x) for x in passes}) <= 3 * RUNS


def test_unknown_forces_hide_what_is_left(straight: Model, clean: Log) -> None:
    stage = fit_machine(straight.machine, [clean], straight.machine.filter)
    white = Lacking((), (), 0, np.full(len(stage.data.space.forces), 300.0))
    beside = replace(stage, fit=replace(stage.fit, unknown=UnknownForces((white,))))
    assert measure_remainder(beside) is None


@pytest.mark.slow
def test_a_clean_log_of_the_second_roller_leaves_nothing(va12: Model) -> None:
    log = from_table(blind(case("nothing", "", 5003)).log, va12.machine)
    found = measure_remainder(fit_machine(va12.machine, [log], va12.machine.filter))
    assert found is not None
    assert found.chi2 == 0.0


@pytest.mark.slow
def test_what_grows_with_torque_has_a_name() -> None:
    said = ask(attacked(attack("pressure_leakage", 601)).log)
    assert said["verdict"] == "named"
    assert [f"{f['effect']}@{f['where']}" for f in said["findings"]] == ["torque_nonlinearity@front_roll"]


@pytest.mark.slow
def test_a_cause_whose_refit_fails_does_not_lose_to_one_whose_refit_succeeds(straight: Model, tmp_path: Path) -> None:
    """On a straight line front and rear rolling resistance are the same; a radius explains nearly as much."""
    log = logged(straight, designed("S40", straight), tmp_path / "log.csv", 4, "rolling_resistance@front_roll=200")
    d = diagnose(straight, [read_log(log, straight.machine)], straight.machine.filter, runner=run_forked)
    assert d.verdict == "tied"
    (found,) = d.findings
    assert {found.name, *found.tied_with} == {"rolling_resistance@front_roll", "rolling_resistance@rear_roll"}


@pytest.mark.slow
def test_false_alarms_are_counted_on_clean_logs_of_the_fitted_machine(straight: Model, clean: Log) -> None:
    d = diagnose(straight, [clean], straight.machine.filter, runner=run_forked)
    found = count_false_alarms(d, 2, runner=run_forked)
    assert found.summary() == {"runs": 2, "named": 0, "failed": 0, "verdicts": {"clean": 2}, "names": {}}
    assert str(found).endswith("none got a name.")

"""Least squares as in the paper: published figures on real data, exact parameters from exact signals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import Excite
from support.drives import designed
from support.logs import make_log

from excite.errors import MachineError, NotIdentifiableError
from excite.identification import linear_methods, methods, recommend_method
from excite.logs import log
from excite.model import Model, prediction
from excite.simulation import Motion, sensors, simulate

# Janot, Gautier, Brunot (2019): estimate, standard deviation
PUBLISHED = {"M": (95.1089, 0.1085), "Fv": (203.5034, 1.1460), "Fc": (20.3935, 0.1012), "offset": (-3.1648, 0.0444)}


def test_emps_gives_the_published_figures(emps: Model, emps_data: Path) -> None:
    estimate = methods.identify(emps, [log.read_log(emps_data, emps.machine)], "ols")
    for name, value, std in zip(estimate.names, estimate.value, estimate.std, strict=True):
        published, deviation = PUBLISHED[name]
        assert value == pytest.approx(published, abs=5e-4)
        assert std == pytest.approx(deviation, rel=2e-3)
    assert estimate.cond_w == pytest.approx(25.9883, abs=1e-3)
    assert estimate.relative_error_percent == pytest.approx(4.0834, abs=1e-3)
    assert np.linalg.norm(estimate.residual) == pytest.approx(108.7569, abs=1e-2)


def test_emps_from_the_command_line(emps_data: Path, tmp_path: Path, excite: Excite) -> None:
    code, stdout, stderr = excite("identify", "emps", emps_data, "--method", "ols", "--out", tmp_path / "o", "--json")
    assert (code, stderr) == (0, "")
    summary = json.loads(stdout)
    assert summary == json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["parameters"]["M"]["value"] == pytest.approx(95.109, abs=0.1)
    row = summary["parameters"]["M"]
    assert row["std_percent"] == pytest.approx(0.114, abs=0.002)
    assert row["high95"] - row["value"] == pytest.approx(1.96 * row["std_total"], rel=0.01)
    assert row["value"] - row["low95"] == pytest.approx(1.96 * row["std_total"], rel=0.01)
    assert summary["unidentifiable"] == []


def test_exact_signals_give_exact_parameters(va12: Model, va12_motion: Motion) -> None:
    """W X = Y on the simulated motion itself."""
    W = va12.stacked_regressor(va12_motion.q.T, va12_motion.nu.T, va12_motion.a.T).transpose(1, 0, 2)
    Y = np.zeros(W.shape[:2])
    Y[list(va12.actuated)] = (
        va12_motion.u.T + va12.nominal[[va12.base.names.index(f"{u}0") for u in va12.inputs]][:, None]
    )
    assert np.abs(np.einsum("rnp,p->rn", W, va12.nominal) - Y).max() < 1e-9 * np.abs(Y).max()
    estimate = linear_methods.least_squares(va12, W, Y, "ols")
    assert np.abs(estimate.value / va12.nominal - 1).max() < 1e-9
    assert estimate.relative_error_percent < 1e-9


@pytest.mark.parametrize("fixture", ["va12", "straight"])
def test_log_without_noise_gives_the_truth(request: pytest.FixtureRequest, fixture: str) -> None:
    """Only filtering and differences stand between the log and the truth: half a per cent."""
    model: Model = request.getfixturevalue(fixture)
    motion: Motion = request.getfixturevalue(f"{fixture}_motion")
    table = sensors.measure(model, motion, noise=False)
    filter = model.machine.filter
    wide = filter.model_copy(update={"cutoff_hz": filter.cutoff_hz.model_copy(update={"value": 10.0}), "decimation": 5})
    estimate = methods.identify(model, [log.from_table(table, model.machine)], "ols", wide)
    assert (np.abs(estimate.value - model.nominal) / model.scale).max() < 0.005


def test_several_logs_are_one_estimate(straight: Model, straight_motion: Motion) -> None:
    one = make_log(straight, straight_motion, seed=1)
    two = make_log(straight, straight_motion, seed=2)
    single = methods.identify(straight, [one], "ols")
    both = methods.identify(straight, [one, two], "ols")
    assert both.degrees == 2 * (single.degrees + 11) - 11
    assert (both.std < single.std).all()


def test_what_a_log_does_not_show_is_named(va12: Model) -> None:
    """Standing still with exact sensors: nothing but the offsets shows."""
    motion = simulate(va12, np.zeros((3001, 3)))
    table = sensors.measure(va12, motion, noise=False)
    estimate = methods.identify(va12, [log.from_table(table, va12.machine)], "ols")
    assert set(va12.base.names) - set(estimate.unidentifiable) == {"u10", "u20", "u40"}
    assert np.isnan(estimate.value[va12.base.names.index("M")])
    assert "M" in estimate.unidentifiable
    k = va12.base.names.index("u10")
    assert estimate.value[k] == pytest.approx(-183.14)


@pytest.mark.parametrize(("times", "out", "kept"), [(0.5, "Kx1", "M"), (50.0, "M", "Kx1")])
def test_dependent_columns_are_named(
    straight: Model, straight_motion: Motion, times: float, out: str, kept: str
) -> None:
    """The later of two is left out, unless it counts for far more."""
    W = (
        straight.stacked_regressor(straight_motion.q.T, straight_motion.nu.T, straight_motion.a.T)
        .transpose(1, 0, 2)
        .copy()
    )
    Y = np.einsum("rnp,p->rn", W, straight.nominal)
    W[:, :, 4] = times * W[:, :, 0]
    estimate = linear_methods.least_squares(straight, W, Y, "ols")
    assert list(estimate.unidentifiable) == [out]
    assert f"only together with others: {kept} + " in estimate.unidentifiable[out]


def test_nothing_to_identify_is_said(straight: Model) -> None:
    with pytest.raises(NotIdentifiableError, match="does the machine move"):
        linear_methods.least_squares(straight, np.zeros((3, 50, 11)), np.ones((3, 50)), "ols")
    with pytest.raises(NotIdentifiableError, match="too short"):
        linear_methods.least_squares(straight, np.ones((3, 3, 11)), np.ones((3, 3)), "ols")


def test_textbook_deviations_are_right_for_white_noise(straight: Model, straight_motion: Motion) -> None:
    """(33) holds where it says it does: white noise on Y alone. 95 % intervals over 300 draws, 11 parameters."""
    W = straight.stacked_regressor(straight_motion.q.T, straight_motion.nu.T, straight_motion.a.T).transpose(1, 0, 2)[
        :, ::40
    ]
    Y = np.einsum("rnp,p->rn", W, straight.nominal)
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(300):
        estimate = linear_methods.least_squares(straight, W, Y + 20 * rng.standard_normal(Y.shape), "ols")
        low, high = estimate.interval95
        inside.append((low < straight.nominal) & (straight.nominal < high))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)
    assert np.mean(inside, axis=0).min() > 0.90


def test_condition_numbers_are_those_of_the_stacked_regressor(straight: Model, straight_motion: Motion) -> None:
    W = straight.stacked_regressor(straight_motion.q.T, straight_motion.nu.T, straight_motion.a.T).transpose(1, 0, 2)
    Y = np.einsum("rnp,p->rn", W, straight.nominal)
    estimate = linear_methods.least_squares(straight, W, Y, "ols")
    flat = W.reshape(-1, 11)
    assert estimate.cond_w == pytest.approx(np.linalg.cond(flat), rel=1e-6)
    assert estimate.cond_phi == pytest.approx(np.linalg.cond(flat * straight.nominal), rel=1e-6)


def test_unknown_method_is_refused(straight: Model) -> None:
    with pytest.raises(ValueError, match=r"magic is unknown, allowed: .*ols"):
        methods.identify(straight, [], "magic")


def test_recommended_method_follows_the_machine(va12: Model, straight: Model, emps: Model) -> None:
    assert [recommend_method(m) for m in (va12, straight, emps)] == ["joint", "joint", "inverse"]


def test_sensors_that_are_missing_are_named(va12: Model, va12_motion: Motion) -> None:
    """Without a torque or a wheel the equations would be fed zeros: refused, not answered."""
    measured = make_log(va12, va12_motion)
    for gone, words in (
        (["u2"], "torque on joint 2"),
        (["theta4"], "angle on joint 4"),
        (["thetal", "yaw_rate"], "measuring wheels"),
    ):
        kept = tuple(s for s in va12.machine.sensor if s.name not in gone)
        model = prediction.build(va12.machine.model_copy(update={"sensor": kept}))
        with pytest.raises(MachineError, match=words):
            methods.identify(model, [measured], "ols")


def test_an_empty_log_is_not_an_estimate(straight: Model, straight_motion: Motion) -> None:
    table = sensors.measure(straight, straight_motion) * 0
    table["t_s"] = straight_motion.t
    for method in ("ols", "joint"):
        with pytest.raises(NotIdentifiableError, match="every signal is zero"):
            methods.identify(straight, [log.from_table(table, straight.machine)], method)


def test_a_machine_file_far_off_in_one_value_does_not_mislead(straight: Model) -> None:
    """The S40 design goes one way, so friction and offset are hard to tell apart; the file says Fs4 = 20, not 143."""
    motion = designed("S40", straight)
    bodies = []
    for body in straight.machine.body:
        if body.index == 4 and body.friction is not None:
            low = body.friction.Fs.model_copy(update={"value": 20.0})
            body = body.model_copy(update={"friction": body.friction.model_copy(update={"Fs": low})})
        bodies.append(body)
    wrong = prediction.build(straight.machine.model_copy(update={"body": tuple(bodies)}))
    measured = make_log(straight, motion, seed=2)
    estimate = methods.identify(wrong, [measured], "joint")
    known = np.isfinite(estimate.value)
    errors = (estimate.value - straight.nominal)[known] / estimate.std[known]
    assert np.abs(errors).max() < 4


@pytest.mark.parametrize("method", ["ols", "joint"])
def test_condition_number_is_that_of_the_estimate(straight: Model, straight_motion: Motion, method: str) -> None:
    """cond(W diag(X)) with X as identified (34), not as the machine file has it."""
    one = make_log(straight, straight_motion, seed=1)
    known = replace(straight, nominal=straight.nominal * np.where(np.arange(11) % 2, 0.6, 1.5))
    by_truth = methods.identify(straight, [one], method)
    by_other_file = methods.identify(known, [one], method)
    np.testing.assert_allclose(by_other_file.value, by_truth.value, rtol=2e-3)
    assert by_other_file.cond_phi == pytest.approx(by_truth.cond_phi, rel=5e-3)

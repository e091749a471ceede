"""Aims: put together from objectives, with what is known before, ceilings and other machines; judged by the bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.drives import drive

from excite.errors import InfeasibleError
from excite.identification import Estimate, methods, prior as sequential
from excite.logs import log
from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, resultant_slips, scenarios, sensors, simulate
from excite.smoothing import cramer_rao
from excite.trajectories import composite_objective as aims, design, multisine, objective, scale_torques
from excite.trajectories.continuation import evaluate_drive


def shorter(model: Model, seconds: float) -> Problem:
    problem = model.machine.problems[model.machine.problem or ""]
    return problem.model_copy(update={"duration_s": problem.duration_s.model_copy(update={"value": seconds})})


@pytest.fixture(scope="module")
def motion(straight: Model) -> Motion:
    wish = scale_torques(multisine(straight, shorter(straight, 20.0), 2), 0.3)
    return simulate(straight, wish.sample(100.0))


def test_one_term_is_the_plain_objective(straight: Model, motion: Motion) -> None:
    for name in ("cond", "D", "A", "E", "weighted-cond"):
        aim = aims.compose_objective(straight, name)
        P = objective.phi(straight, motion, name)
        (A,) = aims.information_matrices(aim, straight, motion)
        assert aims.score_matrices(aim, [A]) == pytest.approx(objective.score_matrix(name, P.T @ P), rel=1e-6, abs=1e-6)
    assert aims.score_motions(aims.compose_objective(straight, "cond"), [(straight, motion)]).score == pytest.approx(
        2 * np.log(objective.cond_phi(straight, motion)), rel=1e-6
    )


def test_accuracy_is_judged_by_the_bound(straight: Model, motion: Motion) -> None:
    spread = np.sqrt(np.diag(cramer_rao(straight, motion))) / np.abs(straight.nominal)
    judged = aims.score_motions(aims.compose_objective(straight, "worst"), [(straight, motion)])
    assert objective.reported_value("worst", judged.score) == pytest.approx(100 * spread.max(), rel=1e-6)
    assert judged.worst_percent == pytest.approx(100 * spread.max())


def test_calibrated_surrogates_give_the_bound(straight: Model, motion: Motion) -> None:
    aim = aims.compose_objective(straight, "worst")
    optimism = aims.surrogate_ratio(aim, straight, motion)
    assert optimism is not None
    off, on = (
        aims.score_matrices(a, aims.information_matrices(a, straight, motion))
        for a in (aim, aims.calibrate_surrogates(aim, optimism))
    )
    true = aims.score_motions(aim, [(straight, motion)]).score
    assert on == pytest.approx(true, abs=1e-6)
    assert abs(off - true) > 0.01


def test_prior_information_adds(straight: Model, motion: Motion) -> None:
    """The same drive again halves every variance; D-optimality then falls by log 2."""
    plain = aims.compose_objective(straight, "D")
    (A,) = aims.information_matrices(plain, straight, motion)
    prior = A / np.outer(straight.scale, straight.scale)
    after = aims.compose_objective(straight, "D", prior=prior)
    assert aims.score_matrices(after, [A]) == pytest.approx(aims.score_matrices(plain, [A]) - np.log(2), rel=1e-9)
    C = cramer_rao(straight, motion)
    twice = aims.compose_objective(straight, "accuracy", prior=np.linalg.inv(C))
    assert np.allclose(aims.covariance_bound(twice, straight, motion), C / 2, rtol=1e-5)


@pytest.mark.parametrize("what", ["plain", "ceiling", "prior", "machines"])
def test_slope_and_curvature(straight: Model, motion: Motion, what: str) -> None:
    rng = np.random.default_rng(0)
    (A,) = aims.information_matrices(aims.compose_objective(straight, "D"), straight, motion)
    prior = np.diag(1 / straight.scale**2) if what == "prior" else None
    machines = scenarios.perturbed_machines(straight, 3) if what == "machines" else ()
    level = None
    if what == "ceiling":  # half way up its hinge
        worst = aims.score_matrices(
            aims.compose_objective(straight, "worst"),
            aims.information_matrices(aims.compose_objective(straight, "worst"), straight, motion),
            6,
        )
        level = 100 * float(np.exp(worst / 2))
    aim = aims.compose_objective(straight, "cond", level, prior, machines)
    blocks = np.stack(aims.information_matrices(aim, straight, motion))
    rows, columns = np.triu_indices(len(A))
    here = aims.local_model(aim, blocks, rows, columns, 6.0)
    steps = (
        1e-6
        * rng.standard_normal((len(blocks), len(rows)))
        * np.sqrt(blocks[:, rows, rows] * blocks[:, columns, columns])
    )

    def at(share: float) -> float:
        moved = blocks.copy()
        moved[:, rows, columns] += share * steps
        moved[:, columns, rows] = moved[:, rows, columns]
        return aims.score_matrices(aim, moved, 6.0)

    slope = (at(1.0) - at(-1.0)) / 2
    assert slope == pytest.approx(float(here.slope @ steps.ravel()), rel=1e-3)
    assert here.value == pytest.approx(at(0.0))
    assert ((here.factor.T @ steps.ravel()) ** 2).sum() >= 0.9 * (at(1.0) + at(-1.0) - 2 * here.value)


@pytest.mark.slow
def test_a_ceiling_is_kept_or_named(straight: Model) -> None:
    """An accuracy between what cond gives and what can be had is kept, at a higher cond; an impossible one is named."""
    problem = shorter(straight, 12.0)
    free = design(straight, problem, "cond", starts=1, seed=3)
    reached = aims.sigma_percent(aims.compose_objective(straight, "cond"), straight, free.motion).max()
    asked = 0.6 * float(reached)
    kept = design(straight, problem, aims.compose_objective(straight, "cond", sigma_max=asked), starts=1, seed=3)
    spread = np.sqrt(np.diag(cramer_rao(straight, kept.motion))) / np.abs(straight.nominal)
    assert 100 * spread.max() <= asked * 1.001
    assert free.cond_phi < kept.cond_phi
    assert kept.max_violation <= 1e-3
    with pytest.raises(InfeasibleError, match=r"sigma-max 0\.01 % is exceeded by") as caught:
        design(straight, problem, aims.compose_objective(straight, "cond", sigma_max=0.01), starts=1, seed=3)
    assert caught.value.limit == "sigma-max"
    assert caught.value.excess > 1


def test_other_machines_are_possible_and_within_the_box(va12: Model) -> None:
    first, *others = scenarios.perturbed_machines(va12, 4, 0.2, seed=1)
    assert first is va12
    q = np.zeros((6, 61))
    q[4] = np.linspace(-0.6, 0.6, 61)
    for m in others:
        assert m.base.names == va12.base.names
        assert (m.pivots(q, m.nominal).full() > 0).all()
        for name in ("Fv1", "Kx4", "ZZ4", "Fs2"):
            k = m.base.names.index(name)
            assert abs(m.nominal[k] / va12.nominal[k] - 1) == pytest.approx(0.2)
    assert not np.allclose(others[0].nominal, others[1].nominal)


def test_another_machine_follows_the_nominal_motion(va12: Model) -> None:
    wanted = simulate(va12, drive(va12, 30, 1, {"u1": 800, "u2": 2500, "u4": 800}))
    other = scenarios.perturbed_machines(va12, 2, 0.2, seed=3)[1]
    played = simulate(other, wanted.u)
    driven = scenarios.track_motion(other, va12, wanted)

    def off(m: Motion) -> np.ndarray:
        return np.sqrt(((m.nu[:, [0, 3, 5]] - wanted.nu[:, [0, 3, 5]]) ** 2).mean(axis=0))

    assert (off(driven) < 0.5 * off(played)).all()
    assert np.abs(driven.q[:, 4] - wanted.q[:, 4]).max() < 0.05
    same = scenarios.track_motion(va12, va12, wanted)
    assert np.abs(same.nu - wanted.nu).max() < 1e-6


@pytest.mark.slow
def test_limits_hold_for_every_machine_of_a_robust_design(straight: Model) -> None:
    problem = shorter(straight, 12.0)
    aim = aims.compose_objective(straight, "cond", machines=scenarios.perturbed_machines(straight, 3, 0.2))
    d = design(straight, problem, aim, starts=1, seed=3)
    found, motion = evaluate_drive(straight, problem, aim, d.manoeuvre)
    assert found.feasible
    for m in aim.machines[1:]:
        driven = scenarios.track_motion(m, straight, motion)
        assert resultant_slips(m, driven.q, driven.nu, m.nominal).max() <= 0.15 * (1 + 3e-3)
        assert np.abs(0.65 * driven.nu[:, 1:]).max() <= 2.0 * (1 + 3e-3)


def test_after_a_log_its_information_is_there(straight: Model, motion: Motion) -> None:
    table = sensors.measure(straight, motion, seed=4)
    one = log.from_table(table, straight.machine, methods.needed_sensors(straight, "joint"))
    known = sequential.prior_from_logs(straight, [one])
    assert known.share == 1.0
    assert np.array_equal(known.model.nominal, known.estimate.value)
    C = np.linalg.inv(known.information)
    assert np.allclose(np.sqrt(np.diag(C)), known.estimate.std, rtol=1e-6)


def test_signs_are_known_whatever_a_machine_calls_its_parameters(emps: Model) -> None:
    """Dry friction of the rig is Fc, that of the roller Fs1: neither drives."""
    at = emps.base.names.index("Fc")
    for sign in (1, -1):
        value = emps.nominal * np.where(np.arange(len(emps.nominal)) == at, sign, 1)
        covariance = np.diag(emps.scale**2)
        found = Estimate(
            "ols", emps.base.names, emps.base.units, value, covariance, 1, 1, 1, np.empty((0, 0)), 99, {}, ()
        )
        known = sequential.prior_from_estimate(emps, found)
        assert known.model.nominal[at] >= 0
        assert (known.share == 1) == (sign == 1)


def test_an_impossible_estimate_is_not_designed_for(straight: Model, motion: Motion) -> None:
    table = sensors.measure(straight, motion, seed=4)
    one = log.from_table(table, straight.machine, methods.needed_sensors(straight, "joint"))
    found = methods.identify(straight, [one], "joint")
    wrong = found.value.copy()
    wrong[straight.base.names.index("M")] = -3000.0
    known = sequential.prior_from_estimate(straight, replace(found, value=wrong))
    assert 0 < known.share < 1
    assert known.model.nominal[straight.base.names.index("M")] > 0

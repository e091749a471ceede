"""The bound on cond(Phi) lies below every drive, its certificate holds, and it says what it can't do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import files

from excite.model import Model
from excite.model.machine import Problem
from excite.simulation import Motion, simulate
from excite.trajectories import multisine, objective
from excite.trajectories.baselines import scale_into_limits

study = files.study("bound_R60", "bound")


@pytest.fixture(scope="module")
def problem(straight: Model) -> Problem:
    return straight.machine.problems["S40"]


@pytest.fixture(scope="module")
def drives(straight: Model, problem: Problem) -> list[Motion]:
    made = [scale_into_limits(straight, problem, multisine(straight, problem, k)) for k in range(3)]
    return [simulate(straight, m.sample(100.0)) for m in made]


@pytest.fixture(scope="module")
def loose(straight: Model, problem: Problem, drives: list[Motion]) -> Any:
    return study.bound(straight, problem, drives[:1], degree=0, rounds=40, population=3000, polished=6, gap=0.05)


@pytest.mark.slow
def test_the_bound_closes_and_lies_below_every_drive(straight: Model, drives: list[Motion], loose: Any) -> None:
    assert loose.certified > 0.95 * loose.mixture
    assert loose.mixture < min(objective.cond_phi(straight, m) for m in drives)
    assert loose.certified < 23.31  # the best design of S40 that is known


@pytest.mark.slow
def test_what_drives_must_obey_raises_the_bound(
    straight: Model, problem: Problem, drives: list[Motion], loose: Any
) -> None:
    tight = study.bound(straight, problem, drives[:1], degree=1, rounds=40, population=3000, polished=6, gap=0.05)
    assert tight.mixture > 0.99 * loose.certified
    assert tight.certified < 23.31


def test_no_sample_of_a_drive_violates_the_certificate_by_more_than_it_says(
    straight: Model, problem: Problem, drives: list[Motion], loose: Any
) -> None:
    assert loose.certificate is not None
    states = study._state_space(straight, problem, loose.degree)
    Phi, drift, _ = states.columns(study._feasible_samples(states, [drives[0]], 1))
    assert study._violation(Phi, drift, loose.certificate).max(initial=0.0) <= loose.violation * (1 + 1e-9)
    assert loose.certified == pytest.approx(np.sqrt(loose.certificate.proven_bound(loose.violation)))


def test_the_same_seed_gives_the_same_bound(straight: Model, problem: Problem, drives: list[Motion]) -> None:
    few = {"degree": 1, "rounds": 2, "population": 500, "polished": 2}
    assert study.bound(straight, problem, drives[:1], **few) == study.bound(straight, problem, drives[:1], **few)


def test_mixture_and_certificate_agree() -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((40, 2, 4)) * [1.0, 2.0, 3.0, 10.0]
    A = np.einsum("kri,krj->kij", rows, rows)
    c = rng.standard_normal((40, 2))
    t, w, x = study._best_mixture(A, c)
    mixed = np.einsum("k,kij->ij", w, A)
    assert np.linalg.cond(mixed) == pytest.approx(t, rel=1e-4)
    assert np.abs(w @ c).max() < 1e-4 * w.sum()
    assert np.trace(x.U) == pytest.approx(t, rel=1e-4)  # no gap
    assert np.trace(x.V) == pytest.approx(1)
    gain = np.einsum("kij,ij->k", A, x.U - x.V) - c @ x.m
    assert gain.max() < 1e-4 * t
    e = float((gain / np.einsum("kij,ij->k", A, x.gauge)).max())
    assert x.proven_bound(max(e, 0.0)) <= t * (1 + 1e-6)


def test_a_violated_certificate_still_proves_something() -> None:
    """Against all mixtures of many states, from the certificate of a few."""
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((60, 2, 3)) * [1.0, 2.0, 5.0]
    A = np.einsum("kri,krj->kij", rows, rows)
    none = np.zeros((60, 0))
    t, _, _ = study._best_mixture(A, none)
    few, _, x = study._best_mixture(A[:12], none[:12])
    e = float((np.einsum("kij,ij->k", A, x.U - x.V) / np.einsum("kij,ij->k", A, x.gauge)).max())
    assert e > 0
    assert x.proven_bound(e) <= t <= few


def test_a_drive_outside_the_limits_is_refused(straight: Model, problem: Problem, drives: list[Motion]) -> None:
    wild = replace(drives[0], nu=drives[0].nu + 100.0)
    with pytest.raises(ValueError, match="keep the limits nowhere"):
        study.bound(straight, problem, [wild])

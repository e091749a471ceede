"""Drives designed together, drives for a purpose, and what sensors buy, each against an independent computation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.commands import Excite

import excite as program
from excite.errors import InfeasibleError
from excite.model import Model, prediction
from excite.model.machine import load_machine
from excite.simulation import Motion, simulate
from excite.smoothing import cramer_rao
from excite.trajectories import campaign, objective, prediction_contrasts, read_design, rival_contrasts, value_sensors
from excite.trajectories.campaign import design_campaign
from excite.trajectories.composite_objective import compose_objective, score_motions
from excite.trajectories.multistart import Design


def information(model: Model, motion: Motion) -> np.ndarray:
    return np.linalg.inv(cramer_rao(model, motion) / np.outer(model.nominal, model.nominal))


@pytest.mark.parametrize("name", ["worst", "prediction", "prediction-max"])
def test_derivatives_with_contrasts(name: str) -> None:
    """Slope and curvature of variances of three combinations of five parameters, by differences of inverses."""
    rng = np.random.default_rng(4)
    B, G, n = rng.normal(size=(20, 5)), rng.normal(size=(5, 3)), 5
    A, (rows, columns) = B.T @ B, np.triu_indices(n)
    value, slope, curvature = objective.exact_derivatives(name, A, rows, columns, 5.0, G)

    def at(h: float, d: np.ndarray) -> float:
        H = np.zeros((n, n))
        H[rows, columns] = H[columns, rows] = h * d
        v = np.diag(G.T @ np.linalg.inv(A + H) @ G)
        return float(np.log(v.mean()) if name == "prediction" else np.log((v**5).sum()) / 5)

    assert value == pytest.approx(at(0.0, np.zeros(len(rows))))
    for _ in range(4):
        d = rng.normal(size=len(rows))
        assert slope @ d == pytest.approx((at(1e-5, d) - at(-1e-5, d)) / 2e-5, rel=1e-5, abs=1e-8)
        assert d @ curvature @ d == pytest.approx((at(1e-3, d) + at(-1e-3, d) - 2 * at(0, d)) / 1e-6, rel=1e-3)


def test_prediction_variance_is_that_of_perturbed_machines(straight: Model, straight_motion: Motion) -> None:
    """The mean variance along another drive equals that of simulated machines drawn from the covariance."""
    other = simulate(straight, 0.5 * straight_motion.u[:800])
    C = cramer_rao(straight, straight_motion)
    score = score_motions(
        compose_objective(straight, "prediction", contrasts=prediction_contrasts(straight, other)),
        [(straight, straight_motion)],
    ).score
    draws = np.random.default_rng(1).multivariate_normal(straight.nominal, C, size=60)
    size = np.sqrt(np.mean(other.nu**2, axis=0))
    change = [(simulate(straight, other.u, X, other.q[0], other.nu[0]).nu - other.nu) / size for X in draws]
    assert objective.reported_value("prediction", score) == pytest.approx(
        100 * np.sqrt(np.mean(np.square(change))), rel=0.25
    )


@pytest.fixture
def scripted(straight: Model, straight_motion: Motion, monkeypatch: pytest.MonkeyPatch) -> Model:
    """A design that is always the same drive, cut to the duration asked for, and infeasible below 4 s."""

    def cut(model: Model, problem: object, aim: object, *rest: object) -> Design:
        seconds = float(problem.duration_s)  # type: ignore[attr-defined]
        if seconds < 4:
            raise InfeasibleError("too short", "speed", 0.1)
        motion = simulate(model, straight_motion.u[: round(100 * seconds) + 1])
        return Design("worst", None, motion, 1, 1, 1, {}, 0, (1.0,), True)  # type: ignore[arg-type]

    monkeypatch.setattr(campaign, "design_drive", cut)
    return straight


@pytest.mark.slow
def test_information_adds_and_the_shortest_is_found(scripted: Model, straight_motion: Motion) -> None:
    """With a drive that is only repeated, the number and duration follow from the sum of information matrices."""
    problem = scripted.machine.problems["S40"].lasting(16)

    def worst(n: int, seconds: float) -> float:
        motion = simulate(scripted, straight_motion.u[: round(100 * seconds) + 1])
        C = np.linalg.inv(n * information(scripted, motion))
        return 100 * float(np.sqrt(np.diag(C).max()))

    target = 1.02 * worst(3, 12.0)
    need = next(n for n in range(1, 9) if worst(n, 16) <= target)
    found = design_campaign(scripted, problem, target, 8)
    assert (found.reached, len(found.drives)) == (True, need)
    assert found.percent == pytest.approx(worst(need, found.duration_s), rel=1e-4)
    assert found.duration_s < 16
    assert worst(need, found.duration_s - 0.1 * found.duration_s) > target
    assert max(found.sigma_percent.values()) == pytest.approx(found.percent, rel=1e-6)
    few = design_campaign(scripted, problem, target, need - 1)
    assert not few.reached
    assert few.percent == pytest.approx(worst(need - 1, 16), rel=1e-4)
    hurried = design_campaign(scripted, problem, target, 8, within_s=10.0)
    assert not hurried.reached
    assert hurried.total_s <= 10


@pytest.mark.slow
def test_a_campaign_on_the_command_line(excite: Excite, tmp_path: Path) -> None:
    """Two short drives together are as accurate as is said; what can't be reached ends with 1 and the best found."""
    options = "va12_straight", "--duration", 8, "--starts", 1, "--seed", 3, "--budget", 40, "--json"
    targets = "--target", 0.1, "--target", "M=0.01", "--drives", 2
    code, shown, err = excite("design", *options, *targets, "--out", tmp_path / "c")
    assert code == 1, err
    told = json.loads(shown)
    assert not told["reached"]
    assert told["within_s"] is None
    found = [read_design(tmp_path / "c" / d["folder"]) for d in told["drives"]]
    C = np.linalg.inv(sum(information(d.model, d.motion) for d in found))
    sigma = dict(zip(found[0].model.base.names, 100 * np.sqrt(np.diag(C)), strict=True))
    assert told["sigma_percent"] == pytest.approx(sigma, rel=1e-3)
    shares = {n: s * (1.0 if n == "M" else 0.1) for n, s in sigma.items()}  # in units of the tightest target
    assert told["attained_percent"] == pytest.approx(max(shares.values()), rel=1e-3)
    code, _, err = excite("design", *options, "--target", 1, "--objective", "D")
    assert (code, "--target: needs an --objective in per cent" in err) == (2, True)


def test_more_than_two_rivals(straight: Model, straight_motion: Motion) -> None:
    """Three rivals: the worst of their variances with all others free, and never less than with two."""
    from excite.workflows.design_request import add_rival_effects

    texts = ("ground_slope=0.01", "rolling_resistance@front_roll=30", "rolling_resistance@rear_roll=30")
    scores = []
    for n in (2, 3):
        both = add_rival_effects(straight, texts[:n], 40.0)
        G = rival_contrasts(both, [e.name for e in both.effects[-n:]])
        assert G.shape == (len(both.nominal), n)
        motion = simulate(both, straight_motion.u)
        scores.append(score_motions(compose_objective(both, "discrimination", contrasts=G), [(both, motion)]).score)
        sigma = np.sqrt(np.diag(cramer_rao(both, motion))) / objective.reference_values(both)
        assert objective.reported_value("discrimination", scores[-1]) == pytest.approx(
            100 * max(sigma[both.base.names.index(e.name)] for e in both.effects[-n:]), rel=1e-6
        )
    assert scores[1] >= scores[0]


@pytest.mark.slow
def test_sensors_are_worth_what_another_machine_file_says(va12: Model, va12_motion: Motion) -> None:
    """Machine files with half the noise, twice the counts or without a sensor give the same bounds."""
    motion = simulate(va12, va12_motion.u[:1500])
    rows = {(v.sensor, v.change): v for v in value_sensors(va12, motion, "full", ("thetal",))}
    assert ("thetal", "left out") not in rows
    assert ("u1", "left out") not in rows
    sensors = {s.name: s for s in va12.machine.sensor}

    def bound(name: str, key: str, factor: float) -> list[float]:
        number = getattr(sensors[name], key)
        other = sensors[name].model_copy(update={key: number.model_copy(update={"value": factor * float(number)})})
        kept = tuple({**sensors, name: other}.values())
        model = prediction.build(va12.machine.model_copy(update={"sensor": kept}))
        sigma = 100 * np.sqrt(np.diag(cramer_rao(model, motion))) / objective.reference_values(model)
        return [float(sigma.max()), float(np.median(sigma))]

    for name, key, factor, change in (
        ("u2", "noise", 0.5, "half the noise"),
        ("theta2", "counts_per_turn", 2, "twice the counts"),
        ("yaw_rate", "noise", 1e6, "left out"),
    ):
        row = rows[name, change]
        assert [row.worst_percent, row.median_percent] == pytest.approx(bound(name, key, factor), rel=1e-3)
        assert (row.error_ratio < 1) == (change != "left out")
    paper = value_sensors(va12, motion, "paper")
    sigma = np.sqrt(np.diag(cramer_rao(va12, motion, "paper"))) / objective.reference_values(va12)
    assert paper[0].worst_percent == pytest.approx(100 * sigma.max())
    assert {v.sensor for v in paper if v.change == "added"} == {"yaw_rate", "vy"}
    assert all(v.error_ratio <= 1 + 1e-6 for v in paper if v.change != "left out")


@pytest.mark.parametrize("way", ["compare", "campaign"])
def test_zeros_that_no_torque_shows_are_named(way: str) -> None:
    """The zero of a level slide changes no force: drives are judged without it, and the summary says so."""
    rig = prediction.build(load_machine(Path(__file__).parents[1] / "support" / "rig.toml"))
    sensors = tuple(s.model_copy(update={"zero": "sought"}) if s.kind == "angle" else s for s in rig.machine.sensor)
    sought = rig.for_machine(rig.machine.model_copy(update={"sensor": sensors}))
    found = (
        program.compare(sought, against=["multisine"], samples=1, budget=20)
        if way == "compare"
        else program.campaign(sought, 50.0, duration=5.0, starts=1, budget=20)
    )
    assert found.summary["given_zeros"] == ["q10"]
    assert "No torque shows the encoder zeros q10" in str(found)

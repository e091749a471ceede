"""The printed table of 1999: its algebra against regressions, its simulated tests, and the figures of the page."""

from __future__ import annotations

import json
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from support import files

FOLDER = files.RESULTS / "1999"


@pytest.fixture(scope="module")
def study() -> ModuleType:
    return files.study("1999")


@pytest.fixture(scope="module")
def summary() -> dict[str, Any]:
    return json.loads((FOLDER / "summary.json").read_text(encoding="utf-8"))


def percent(study: ModuleType, W: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Deviations (10,) [%] by (33) with the exact residual level 1, by inversion."""
    return 100 * np.sqrt(np.diag(np.linalg.inv(W.T @ W))) / np.abs(x)


def columns(one_way: float, share: float, N: int = 40_000) -> np.ndarray:
    """W (2 N, 10) of a drive whose mean sign is `one_way`; slips have the share `share` of the acceleration."""
    rng = np.random.default_rng(3)
    leg = np.arange(N // 2) * (2 * np.pi / 500)  # one leg in each direction, sped up to the second half's length
    speed = 2.2 * np.tanh(3 * np.abs(np.sin(leg)))
    sign = np.where(np.arange(N) % 1000 < 500 * (1 + one_way), 1.0, -1.0)
    w = np.resize(speed, N) * sign
    acceleration = rng.normal(size=N)
    for other in (np.ones(N), w, sign):
        acceleration -= other * (acceleration @ other) / (other @ other)
    rolls = []
    for scale in (1.0, 1.3):
        slip = 0.02 * scale * (share * acceleration + np.sqrt(1 - share**2) * rng.normal(size=N))
        rolls.append(np.column_stack([acceleration, w, sign, slip, np.ones(N)]))
    none = np.zeros((N, 5))
    return np.vstack([np.hstack([rolls[0], none]), np.hstack([none, rolls[1]])])


@pytest.mark.parametrize(("one_way", "share"), [(0.0, 0.0), (0.5, 0.0), (0.0, 0.6)])
def test_deviations_give_the_condition_numbers_and_the_drive(study: ModuleType, one_way: float, share: float) -> None:
    W = columns(one_way, share)
    found = study.implied(study.X, percent(study, W, study.X), one_way, share)
    assert found["cond_w"] == pytest.approx(np.linalg.cond(W), rel=0.03)
    assert found["cond_phi"] == pytest.approx(np.linalg.cond(W * study.X), rel=0.03)
    assert found["rms acceleration 1 [rad/s2]"] == pytest.approx(1, rel=0.03)
    assert found["rms slip 4"] == pytest.approx(0.026 / study.RADIUS, rel=0.03)
    own = W[: len(W) // 2, 1]
    assert found["rms rim speed 1 [m/s]"] == pytest.approx(study.RADIUS * np.sqrt(np.mean(own**2)), rel=0.03)
    assert found["mean over rms speed 1"] == pytest.approx(np.abs(own).mean() / np.sqrt(np.mean(own**2)), rel=0.03)


def test_printed_deviations_give_the_known_figures(study: ModuleType) -> None:
    found = study.implied(study.X, study.PERCENT)
    assert found["cond_w"] == pytest.approx(83.2, abs=0.05)
    assert found["cond_phi"] == pytest.approx(91.9, abs=0.05)
    assert found["cond_w"] == pytest.approx(study.COND_W, rel=0.03)
    assert found["cond_phi"] == pytest.approx(study.COND_PHI, rel=0.03)
    known = {"Fs1 over u0": 2.7, "Fs4 over u0": 2.7, "ZZ1 over u0": 0.9, "ZZ4 over u0": 1.2}
    for name, ratio in known.items():
        assert found[name] == pytest.approx(ratio, abs=0.05)
    assert found["Kx1 over u0"] == pytest.approx(40, abs=0.5)
    assert found["Kx4 over u0"] == pytest.approx(31, abs=0.5)
    assert found["rms acceleration 1 [rad/s2]"] == pytest.approx(1.08, abs=0.005)
    assert found["rms acceleration 4 [rad/s2]"] == pytest.approx(0.86, abs=0.005)


def test_no_column_is_more_correlated_than_the_bound(study: ModuleType) -> None:
    """Of any matrix, whatever its rows."""
    rng = np.random.default_rng(0)
    x = np.exp(rng.normal(size=6))
    for k in range(20):
        W = rng.normal(size=(50, 6)) @ rng.normal(size=(6, 6))
        bound = study.largest_correlation(percent(study, W, x), np.linalg.cond(W * x))
        for j in range(6):
            others = np.delete(W, j, axis=1)
            left = W[:, j] - others @ np.linalg.lstsq(others, W[:, j], rcond=None)[0]
            assert np.sqrt(1 - left @ left / (W[:, j] @ W[:, j])) <= bound[j] * (1 + 1e-9), (k, j)
    W = rng.normal(size=(50, 2)) @ np.array([[1000.0, 0.0], [400.0, 1.0]])
    first, second = W.T
    share = abs(first @ second) / np.sqrt((first @ first) * (second @ second))
    bound = study.largest_correlation(percent(study, W, np.ones(2)), np.linalg.cond(W))
    assert bound[0] == pytest.approx(share, rel=1e-3)  # where the columns' sizes differ much, the bound is attained


def test_least_squares_agrees_with_the_library(study: ModuleType) -> None:
    """On a machine whose file is exact: tolerances move values within them."""
    from excite.identification import identify
    from excite.model import build
    from excite.model.machine import Machine

    measured = study.measured(study.Plant((30.0, 5.0, 1.2, 1.2)), 1)
    own = study.solve(*study.equations(measured, study.Recipe()), "all")
    none = dict.fromkeys(("alignment", "length", "radius", "gain", "level"), 0.0)
    exact = Machine.model_validate(study.reference().machine.model_dump() | {"tolerance": none})
    library = identify(build(exact), [measured], "ols")
    np.testing.assert_allclose(list(own.value.values()), library.value, rtol=1e-6)
    np.testing.assert_allclose(list(own.std.values()), library.std, rtol=1e-6)
    assert own.cond_phi == pytest.approx(library.cond_phi, rel=1e-6)


def number(x: float) -> str:
    return f"{x:.0f}" if abs(x) >= 300 else f"{x:.3g}"


def table_rows(study: ModuleType, summary: dict[str, Any]) -> list[str]:
    """Rows of the README's tables, from the summary."""
    search = summary["search"]
    cells = [("2 and 3", "v_n", 0), ("2 and 3", "R_c w", 0), ("all", "v_n", 0), ("2 and 3", "v_n", 1)]
    near = [search[study.cell_name(*c)] for c in cells]
    rows = []
    for n, x, p in zip(study.NAMES, study.X, study.PERCENT, strict=True):
        found = [f"{number(c['median'][n])} ({c['median'][f'{n} std_percent']:.2g})" for c in near]
        rows.append([n, f"{x:g} ({p:.2g})", *found])
    for name, key, printed in (("cond(W)", "cond_w", study.COND_W), ("cond(Phi)", "cond_phi", study.COND_PHI)):
        rows.append([name, f"{printed}", *("{:.0f} to {:.0f}".format(*c["range"][key]) for c in near)])
    for group in ("values", "deviations", "conds"):
        rows.append([f"typical factor, {group}", "-", *(f"{c['typical_factor'][group]:.2f}" for c in near)])
    for name, own in summary["single_changes"].items():
        m = own["median"]
        values = [f"{number(m[n])} ({m[f'{n} std_percent']:.2g})" for n in ("ZZ1", "Kx1", "Kx4")]
        rows.append(
            [name, *values, f"{m['cond_w']:.0f}", f"{m['cond_phi']:.0f}", f"{own['typical_factor']['all']:.2f}"]
        )
    ols, joint = (summary["instead"][k]["parameters"] for k in ("ols", "joint"))
    for n, p in joint.items():
        told = [
            f"{q['bias_percent']:.1f} / {q['std_percent']:.1f} / {q['predicted_std_percent']:.1f}" for q in (ols[n], p)
        ]
        rows.append([n, f"{p['true']:g}", told[0], told[1], f"{100 * p['coverage95']:.0f} %"])
    return [f"| {' | '.join(row)} |" for row in rows]


@pytest.fixture(scope="module")
def cell(study: ModuleType, summary: dict[str, Any]) -> tuple[Any, Any]:
    """The cell of rows 2 and 3, slip over v_n, that comes nearest to the printed table."""
    near = summary["search"][study.cell_name("2 and 3", "v_n", 0)]
    return (
        study.Plant(**{**near["plant"], "drive": tuple(near["plant"]["drive"])}),
        study.Recipe(**near["recipe"]),
    )


def test_exact_signals_give_the_truth_from_rows_2_and_3(study: ModuleType, cell: tuple[Any, Any]) -> None:
    plant, recipe = cell
    found = study.identified(replace(plant, counts=np.inf), replace(recipe, law="v_n"), 1)
    model = study.true_model(plant)
    assert "M" not in found
    for name, true in zip(model.base.names[1:], model.nominal[1:], strict=True):
        assert plant.factor * found[name] == pytest.approx(true, rel=0.05), name


def test_measured_slips_shrink_the_contact_and_put_the_machine_into_the_inertias(
    study: ModuleType, cell: tuple[Any, Any]
) -> None:
    plant, recipe = cell
    found = study.identified(plant, recipe, 1)
    true = dict(zip(study.true_model(plant).base.names, study.true_model(plant).nominal, strict=True))
    whole = true["ZZ1"] + true["ZZ4"] + study.RADIUS**2 * true["M"]
    assert plant.factor * (found["ZZ1"] + found["ZZ4"]) == pytest.approx(whole, rel=0.15)
    for name in ("Kx1", "Kx4"):
        assert plant.factor * abs(found[name]) < 0.05 * abs(true[name])
        assert found[f"{name} std_percent"] < 100
    for name in ("ZZ1", "ZZ4"):
        assert found[f"{name} std_percent"] < 1


def test_rows_2_and_3_alone_reproduce_the_summary(
    study: ModuleType, summary: dict[str, Any], cell: tuple[Any, Any]
) -> None:
    near = summary["search"][study.cell_name("2 and 3", "v_n", 0)]
    low, high = near["range"]["cond_w"]
    found = study.identified(*cell, study.FRESH_SEEDS[0])
    assert 0.999 * low <= found["cond_w"] <= 1.001 * high


def test_the_readme_says_what_the_summary_holds(study: ModuleType, summary: dict[str, Any]) -> None:
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert set(summary) >= {"command", "seed", "versions", "commit"}
    for row in table_rows(study, summary):
        assert row in text
    algebra = summary["algebra"]
    for name, low_high in (("cond_w", "81.0 to 85.6"), ("cond_phi", "90.2 to 93.6")):
        assert "{:.1f} to {:.1f}".format(*algebra["range_by_rounding"][name]) == low_high
        assert low_high in text
    for value, said in (
        (algebra["implied"]["cond_w"], "83.2"),
        (algebra["implied"]["cond_phi"], "91.9"),
        (algebra["largest_correlation_of_acceleration"][0], "0.23"),
        (algebra["torque_factor"], "4.79"),
    ):
        assert f"{value:.{len(said.split('.')[1])}f}" == said
        assert said in text

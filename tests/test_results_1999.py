"""Why the first identification failed: the mechanism that results/1999 rests on, on one drive each."""

from __future__ import annotations

import json
from types import ModuleType

import numpy as np
import pytest
from support import files


@pytest.fixture(scope="module")
def study() -> ModuleType:
    return files.study("1999")


def truth(study: ModuleType) -> dict[str, float]:
    model = study.reference()
    return dict(zip(model.base.names, model.nominal, strict=True))


def identified(study: ModuleType, counts: float, law: str = "v_n", rows: str = "all", cutoff: float = 10.0):
    """The slow drive forward and backward, identified as then."""
    plant = study.Plant(drive="slow", counts=counts)
    return study.fits(plant, 0, [study.Recipe(law, cutoff, rows)], None)[0]


def test_exact_signals_give_the_truth(study: ModuleType) -> None:
    fit = identified(study, np.inf)
    for name, true in truth(study).items():
        assert fit.value[name] == pytest.approx(true, rel=0.05), name


@pytest.mark.parametrize("cutoff", [3.0, 10.0])
def test_measured_slips_shrink_the_contact_and_look_sure(study: ModuleType, cutoff: float) -> None:
    fit, true = identified(study, 1.0, cutoff=cutoff), truth(study)
    for name in ("Kx1", "Kx4"):
        assert abs(fit.value[name]) < 0.1 * abs(true[name])
        assert abs(fit.value[name] - true[name]) > 20 * fit.std[name]
    assert fit.value["M"] < 0.1 * true["M"]
    for name in ("ZZ1", "ZZ4"):
        assert fit.percent(name) < 1
        assert fit.value[name] > 4 * true[name]


def test_the_sum_of_inertias_is_kept(study: ModuleType) -> None:
    true = truth(study)
    whole = true["ZZ1"] + true["ZZ4"] + study.RADIUS**2 * true["M"]
    for counts in (1.0, np.inf):
        assert study.conserved(identified(study, counts)) == pytest.approx(whole, rel=0.04)
    assert pytest.approx(whole / (study.PAPER["ZZ1"] + study.PAPER["ZZ4"]), rel=1e-3) == study.SCALE


def test_division_by_the_signed_rim_speed_ruins_exact_signals(study: ModuleType) -> None:
    fit, true = identified(study, np.inf, law="R_c w"), truth(study)
    assert abs(fit.value["Kx1"]) < 0.01 * abs(true["Kx1"])


def test_the_homogeneous_row_without_mass_ruins_exact_signals(study: ModuleType) -> None:
    fit, true = identified(study, np.inf, rows="row 1, M dropped"), truth(study)
    assert abs(fit.value["Kx1"]) < 0.2 * abs(true["Kx1"])
    kept = identified(study, np.inf, rows="no row 1")
    assert kept.value["Kx1"] == pytest.approx(true["Kx1"], rel=0.05)


def test_least_squares_agrees_with_the_library(study: ModuleType) -> None:
    from excite.identification import identify

    plant = study.Plant(drive="slow")
    measured = study.measured(plant, study.motion(plant, 0), 1)
    own = study.solve(*study.equations(measured, 3.0)["v_n"], "all")
    library = identify(study.reference(), [measured], "ols")
    np.testing.assert_allclose(list(own.value.values()), library.value, rtol=1e-6)
    np.testing.assert_allclose(list(own.std.values()), library.std, rtol=1e-6)
    assert own.cond == pytest.approx(library.cond_phi, rel=1e-6)


def test_written_results_hold_what_the_readme_says(study: ModuleType) -> None:
    result = json.loads((files.RESULTS / "1999" / "summary.json").read_text())
    assert result["grid"]["fits_with_pattern"] > 0
    assert result["grid"]["fits_with_all"] == 0
    assert result["grid"]["scaled_fits_with_all"] == 3
    assert result["physics"]["acceleration_m_s2"] < 0.01
    best = result["instead"]["joint, S40 D"]["parameters"]
    assert abs(best["M"]["bias_percent"]) < 1
    assert abs(best["Kx1"]["bias_percent"]) < 1

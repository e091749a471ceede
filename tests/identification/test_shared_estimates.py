"""Logs on which estimates were wrong or surer than they could be, in ../shared/cases."""

from __future__ import annotations

import numpy as np
import pytest
from support.files import case

import excite

RIG = np.array([95.1, 203.5, 20.4, -3.16])  # M, Fv, Fc, offset of every rig here [SI]


@pytest.mark.parametrize("method", [None, "ols", "joint"])
@pytest.mark.parametrize("log", ["abs_0.3", "shift_-0.05"])
def test_no_method_is_valid_over_a_misfit(log: str, method: str | None) -> None:
    """Signs lost in 30 % of the negative rows; a force 50 ms late."""
    folder = case("G01_valid_over_misfit/rig.toml").parent
    assert excite.identify(folder / "rig.toml", folder / f"{log}.csv", method).status != "valid"


@pytest.mark.parametrize("log", ["G01_valid_over_misfit/rig", "G03_clean_but_biased/rig"])
def test_a_clean_log_of_a_rig_is_valid_and_right(log: str) -> None:
    estimate = excite.identify(case(log + ".toml"), case(log + ".csv"))
    assert estimate.status == "valid"
    assert (np.abs(estimate.value - RIG) < 2 * np.minimum(estimate.std_total, [1.1, 2.5, 0.25, 0.05])).all()


def test_a_clean_log_of_two_joints_is_valid_and_right() -> None:
    machine = case("G03_clean_but_biased/two_joints.toml")
    estimate = excite.identify(machine, case("G03_clean_but_biased/two4.csv"))
    assert estimate.status == "valid"
    assert (np.abs(estimate.value - excite.load(machine).nominal) < 2.5 * estimate.std_total).all()


def test_no_answer_depends_on_the_edges_that_a_file_drops() -> None:
    """A log that begins and ends in motion; by a file that drops edges and by one that doesn't."""
    log = case("G04_moving_at_edges/pend_moving_edges.csv")
    found = [excite.identify(m, log) for m in ("pendulum", case("G04_moving_at_edges/pend_drop.toml"))]
    np.testing.assert_allclose(found[0].value, found[1].value, rtol=1e-6)
    assert found[0]["ZZ1"]["value"] == pytest.approx(0.1474, rel=2e-3)


def test_plateaus_show_friction_and_no_mass() -> None:
    """Eight constant speeds, the ramps cut away."""
    estimate = excite.identify(case("G06_plateaus/rig.toml"), case("G06_plateaus/cv_plateaus.csv"))
    assert "M" in estimate.unidentifiable
    assert (np.abs(estimate.value - RIG)[1:] < 2 * estimate.std_total[1:]).all()
    assert not any("round" in note for note in (*estimate.notes, estimate.doubt))


@pytest.mark.slow
@pytest.mark.parametrize("log", ["front", "both"])
def test_late_torques_are_no_valid_inertias(log: str) -> None:
    """By 30 ms, where 5 ms is the tolerance; the front one alone is named."""
    estimate = excite.identify("va12_straight", case(f"G17_late_torque/{log}_30ms.csv.gz"))
    assert estimate.status != "valid"
    assert log == "both" or "alignment of front roll is off by" in estimate.doubt

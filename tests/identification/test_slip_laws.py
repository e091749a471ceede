"""Contact laws of single-wheel tests: hidden laws found again, ties said, units and signs of tables, a file that is
accepted; the soil's constants against the stress of (18) integrated over the patch."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from support.commands import Excite
from support.files import SHARED

import excite as interface
from excite.errors import LogError, NotIdentifiableError
from excite.logs import read_slip_table
from excite.model import build
from excite.model.machine import load_machine
from excite.model.mechanics import SoilConstants

SLIPS = np.repeat([-0.4, -0.3, -0.2, -0.1, -0.05, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5], 3)
NOISE = 0.4  # N
CMU = SHARED / "cmu_single_wheel" / "smooth_wheel.csv"


def exponential(slip: np.ndarray, Kx: float, at: float) -> np.ndarray:
    """(18) by hand: the mean of 1 - exp(-j/K) over the patch, of slope -Kx at zero."""
    per_rim = np.where(slip >= 0, slip, slip / (1 + slip))
    return np.array(
        [np.sign(g) * 2 * -Kx * at * quad(lambda s, g=g: 1 - np.exp(-abs(g) * s / at), 0, 1)[0] for g in per_rim]
    )


def wheel(force: np.ndarray, seed: int = 0, noise: float = NOISE) -> pd.DataFrame:
    return pd.DataFrame(
        {"slip [%]": 100 * SLIPS, "Fx (N)": force + noise * np.random.default_rng(seed).standard_normal(len(force))}
    )


def test_a_hidden_exponential_law_is_supported_and_the_linear_one_ruled_out() -> None:
    fit = interface.slip(wheel(exponential(SLIPS, -120.0, 0.25)))
    found = next(law for law in fit.laws if law.name == "exponential (18)")
    assert found in fit.supported
    assert next(law for law in fit.laws if law.name == "linear").chance < 1e-3
    for name, true in (("Kx", -120.0), ("shear_saturation", 0.25)):
        value, std = found.parameters[name]
        assert std is not None
        assert abs(value - true) < 4 * std < 0.2 * abs(true)
    assert fit.repeatability["traction"] == pytest.approx(NOISE, rel=0.35)
    assert found.rms_left_out < NOISE


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 6))])
def test_nothing_is_added_to_a_linear_law(seed: int) -> None:
    per_rim = np.where(SLIPS >= 0, SLIPS, SLIPS / (1 + SLIPS))
    fit = interface.slip(wheel(80.0 * per_rim, seed))
    assert fit.named is not None
    assert fit.named.name == "linear"
    assert "one law: linear" in repr(fit)


def test_laws_that_noise_hides_are_a_tie() -> None:
    """Exponential and hyperbola of the same slope differ by less than the noise."""
    fit = interface.slip(wheel(exponential(SLIPS, -120.0, 0.25), noise=2.0))
    assert fit.named is None
    assert "can't tell" in repr(fit)


def test_forces_that_do_not_grow_with_slip_are_no_contact_law() -> None:
    """As of a column that is not the traction: no law, no contact to paste."""
    with pytest.raises(NotIdentifiableError, match=r"does not grow with slip.*traction from Fx"):
        interface.slip(wheel(5.0 - SLIPS, noise=1.0))


def test_side_forces_and_slip_angles() -> None:
    """Both stiffnesses, from a speed in km/h, a rate in rpm and an angle in degrees."""
    rng = np.random.default_rng(1)
    slips, angles = (x.ravel() for x in np.meshgrid([0.02, 0.06, 0.1, 0.15], [0.0, 4.0, 8.0]))
    rim, beta = 2.0 / (1 - slips), np.radians(angles)
    traction = -5e4 * (2.0 * np.cos(beta) - rim) / rim
    side = -3e4 * 2.0 * np.sin(beta) / rim
    table = pd.DataFrame(
        {
            "speed [km/h]": np.full(12, 7.2),
            "omega [rpm]": rim / 0.5 * 30 / np.pi,
            "beta [deg]": angles,
            "traction [kN]": traction / 1e3 + 0.02 * rng.standard_normal(12),
            "Fy [kN]": side / 1e3 + 0.02 * rng.standard_normal(12),
        }
    )
    law = interface.slip(table, radius=0.5).supported[0]
    assert law.parameters["Kx"][0] == pytest.approx(-5e4, rel=0.02)
    assert law.parameters["Ky"][0] == pytest.approx(-3e4, rel=0.02)


SETTINGS = np.arange(-7, 8) / 50  # 0.02 apart


@pytest.mark.parametrize(
    ("slips", "settings"),
    [
        (np.repeat(SETTINGS, 3), 15),
        (np.repeat(SETTINGS, 3) + np.tile([0, 3e-4, -5e-4], 15), 15),
        (np.repeat([0.01, 0.02, 0.03, 0.2, 0.4, 0.6], 3), 6),
        (SETTINGS, 15),
        (np.repeat(10 * SETTINGS[4:], 3) / 2 + np.random.default_rng(0).normal(0, 4e-3, 33), 11),
        (np.linspace(-0.2, 0.3, 400), 12),  # a sweep
    ],
)
def test_repeats_are_known_by_the_spacing_of_settings(slips: np.ndarray, settings: int) -> None:
    table = read_slip_table(pd.DataFrame({"slip": slips, "Fx [N]": 3e4 * slips}))
    assert table.level.max() + 1 == settings
    assert (np.diff(table.level[np.argsort(table.slip)]) >= 0).all()


def test_repeats_of_a_speed_differ_by_their_noise() -> None:
    noise = 20 * np.random.default_rng(0).standard_normal(45)
    slips = np.repeat(SETTINGS, 3)
    forces = pd.DataFrame({"rim_speed": 0.5, "speed": 0.5 - 0.5 * slips, "Fx [N]": 3e4 * slips + noise})
    assert interface.slip(forces).repeatability["traction"] == pytest.approx(20, rel=0.3)


@pytest.mark.parametrize("role", ["traction", "side"])
def test_forces_of_zero_are_no_contact_law(role: str) -> None:
    slips, angles = (x.ravel() for x in np.meshgrid([0.02, 0.06, 0.1, 0.15], [0.0, 4.0, 8.0]))
    table = pd.DataFrame({"slip": slips, "angle [deg]": angles, "traction": 1e4 * slips, "side": -300 * angles})
    with pytest.raises(NotIdentifiableError, match=r"is 0 in every row.*right column \(" + role):
        interface.slip(table.assign(**{role: 0.0}))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"Fx (N)": "Fz (N)"}, "no column is traction"),
        ({"slip [%]": "slip"}, "per cent"),
        ({"slip [%]": "slip [kg]"}, "kg is no unit of slip"),
    ],
)
def test_tables_that_are_refused(change: dict[str, str], words: str) -> None:
    with pytest.raises(LogError, match=words):
        read_slip_table(wheel(100 * SLIPS).rename(columns=change))


def test_words_in_a_column_are_refused_unless_it_is_not_needed() -> None:
    table = wheel(100 * SLIPS)
    table["slip [%]"] = table["slip [%]"].astype(object)
    table.loc[4, "slip [%]"] = "low"
    with pytest.raises(LogError, match=r"row 5, column slip \[%\]: is 'low', not a number; correct"):
        read_slip_table(table)
    known = read_slip_table(table.assign(speed=1 - SLIPS, rim_speed=1.0))
    assert known.slip == pytest.approx(SLIPS)
    with pytest.raises(LogError, match="no row has numbers in all of these columns: slip"):
        read_slip_table(wheel(100 * SLIPS).assign(**{"slip [%]": np.nan}))


def test_a_force_of_the_wrong_sign_is_refused_and_turned() -> None:
    table = wheel(-100 * SLIPS)
    with pytest.raises(LogError, match="traction=-COLUMN"):
        read_slip_table(table)
    assert read_slip_table(table, {"traction": "-Fx (N)"}).forces["traction"][-1] > 0


def test_the_contact_is_accepted_by_a_machine(tmp_path: Path, excite: Excite) -> None:
    """The written file loads, checks, and its force along the front roll is the fitted law's."""
    rows = wheel(2000 * exponential(SLIPS, -60.0, 0.3), noise=100.0)
    rows.to_csv(tmp_path / "wheel.csv", index=False)
    code, _, said = excite(
        "slip", tmp_path / "wheel.csv", "--machine", "va12", "--where", "front_roll", "--out", tmp_path / "out"
    )
    assert (code, said) == (0, "")
    contact = tmp_path / "out" / "contact.toml"
    machine = load_machine(contact)
    assert build(machine).machine.find(4).contact == load_machine("va12").find(4).contact
    kept = machine.find(1).contact
    assert kept is not None
    assert float(kept.Kx) == pytest.approx(-1.2e5, rel=0.1)
    code, _, said = excite("slip", tmp_path / "wheel.csv", "--column", "side=Fq", "--out", tmp_path / "no")
    assert (code, "no column Fq for side" in said, said.count("\n")) == (2, True, 1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--machine", "emps"), "emps has no contact"),
        (("--where", "front_roll"), "give --machine as well"),
        (("--machine", "va12", "--where", "roof"), "--where: roof"),
        (("--radius", "nan"), "--radius: must be > 0 m"),
        (("--radius", "-1"), "--radius: must be > 0 m"),
    ],
)
def test_options_that_are_refused(options: tuple[str, ...], words: str, tmp_path: Path, excite: Excite) -> None:
    wheel(100 * SLIPS).to_csv(tmp_path / "wheel.csv", index=False)
    code, _, said = excite("slip", tmp_path / "wheel.csv", *options, "--out", tmp_path / "out")
    assert (code, words in said, said.count("\n")) == (2, True, 1), said
    assert not (tmp_path / "out").exists()


def test_an_earlier_result_is_replaced_but_only_by_a_new_one(tmp_path: Path, excite: Excite) -> None:
    wheel(100 * SLIPS).to_csv(tmp_path / "wheel.csv", index=False)
    wheel(0 * SLIPS, noise=0).to_csv(tmp_path / "zero.csv", index=False)
    out = tmp_path / "out"
    assert excite("slip", tmp_path / "wheel.csv", "--out", out)[0] == 0
    code, shown, _ = excite("slip", tmp_path / "zero.csv", "--out", out)
    assert (code, shown, (out / "contact.toml").is_file()) == (1, "", True)
    code, shown, said = excite("slip", tmp_path / "wheel.csv", "--out", out)
    assert (code, said, shown.count("will be replaced")) == (0, "", 1)


def test_the_result_says_what_slips_were_divided_by(excite: Excite) -> None:
    notes = " ".join(read_slip_table(wheel(100 * SLIPS), per="larger").notes)
    assert "divided by the larger of rim and forward speed" in notes
    assert "The laws divide it by the larger speed" in notes
    _, shown, _ = excite("slip", "--help")
    assert "taken as divided by the larger" in " ".join(shown.split())


def test_stiffness_of_a_soil() -> None:
    """The shear stress of (18), small slips, integrated along the patch; its limit is the soil's strength."""
    soil = SoilConstants(2000.0, np.radians(30), 0.012, 0.15, 0.5, 4000.0)
    stress = 2000.0 + 4000.0 / (0.15 * 0.5) * np.tan(np.radians(30))

    def force(g: float) -> float:
        return 0.5 * quad(lambda xi: stress * (1 - np.exp(-g * xi / 0.012)), 0, 0.15)[0]

    assert -soil.stiffness == pytest.approx(force(1e-6) / 1e-6, rel=1e-4)
    assert soil.strength == pytest.approx(force(1e3), rel=1e-4)
    Kx, at = -soil.stiffness, soil.saturation_slip
    assert exponential(np.array([0.2]), -Kx, at)[0] == pytest.approx(force(0.2), rel=1e-9)


def test_a_soil_alone_makes_a_contact(tmp_path: Path, excite: Excite) -> None:
    constants = "--cohesion 2000 --friction-angle 30 --shear-modulus 0.012 --contact-length 0.15 --width 0.5".split()
    code, *_ = excite("slip", *constants, "--load", 4000, "--out", tmp_path / "out")
    assert code == 0
    written = tomllib.loads((tmp_path / "out" / "contact.toml").read_text())["body"]["contact"]
    assert (written["law"], written["saturation_slip"]["value"]) == ("exponential", 0.08)
    code, _, said = excite("slip", *constants, "--out", tmp_path / "no")
    assert (code, "all six or none" in said) == (2, True)


@pytest.mark.skipif(not CMU.is_file(), reason="no measurements in ../shared/data")
def test_the_published_study_of_a_wheel_on_sand() -> None:
    raw = pd.read_csv(CMU)
    columns = {"speed": "avg_Vx_mm_s", "rim_speed": "avg_Vry_mm_s", "traction": "-avg_Fy_N", "load": "-avg_Fz_N"}
    straight = raw[raw["beta_deg"] == 0].reset_index(drop=True)
    fit = interface.slip(straight, columns=columns, per="larger")
    assert fit.named is not None
    assert fit.named.name == "linear + drive-brake asymmetry"
    assert fit.named.parameters["drive_brake_asymmetry"][0] == pytest.approx(22.7, abs=0.2)
    assert fit.repeatability["traction"] == pytest.approx(0.338, abs=0.001)

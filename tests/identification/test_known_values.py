"""Values that the machine file calls known: used by every method, by designs, and checked against the log."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import excite
from excite.errors import MachineError
from excite.identification import METHODS
from excite.model import Model, build
from excite.model.machine import load_machine
from excite.simulation import measure, simulate
from excite.smoothing import cramer_rao


def machine_file(tmp_path: Path, text: str, base: str = "emps") -> Path:
    path = tmp_path / "known.toml"
    path.write_text(f'extends = "{base}"\nname = "known"\n{text}')
    return path


def model_of(tmp_path: Path, text: str, base: str = "emps") -> Model:
    return build(load_machine(machine_file(tmp_path, text, base)))


@pytest.fixture(scope="module")
def one_way() -> pd.DataFrame:
    """A drive in one direction: the log shows only the sum of dry friction and offset."""
    emps = build(load_machine("emps"))
    t = np.arange(0, 4, 1e-3)
    return measure(emps, simulate(emps, (60 + 40 * np.sin(2 * np.pi * 1.3 * t))[:, None]), seed=1)


@pytest.fixture(scope="module")
def both_ways() -> pd.DataFrame:
    emps = build(load_machine("emps"))
    t = np.arange(0, 6, 1e-3)
    force = 60 * np.sin(2 * np.pi * 0.8 * t) + 40 * np.sin(2 * np.pi * 1.7 * t)
    return measure(emps, simulate(emps, force[:, None]), seed=2)


OFFSET = '[body.carriage.friction]\nu0 = { value = -3.1648, source = "measured", known = true }\n'


@pytest.mark.parametrize("method", ["ols", "joint", "inverse"])
def test_known_offset_makes_dry_friction_identifiable(tmp_path: Path, one_way: pd.DataFrame, method: str) -> None:
    emps = build(load_machine("emps"))
    without = excite.identify("emps", one_way, method)
    if method == "inverse" and not without.unidentifiable:  # told by where the drive begins, on some processors
        force, variance = without.value[2:].sum(), without.covariance[2:, 2:].sum()
        assert abs(force - emps.nominal[2:].sum()) < max(3 * np.sqrt(variance), 0.05)
    else:
        assert {"Fc", "offset"} & set(without.unidentifiable)
    found = excite.identify(machine_file(tmp_path, OFFSET), one_way, method)
    assert not found.unidentifiable
    k = found.names.index("Fc")
    assert abs(found.value[k] - emps.nominal[k]) < 4 * found.std[k]
    assert found.std[k] < 0.05 * emps.nominal[k]
    assert found.value[3] == pytest.approx(-3.1648, rel=1e-4)
    assert found.prior_std is not None
    assert np.isfinite(found.prior_std).tolist() == [False, False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("method", [m for m in METHODS if m != "joint"])  # known to 0.3 ppm: where it ends makes more
def test_known_mass_is_averaged_by_its_accuracy(tmp_path: Path, both_ways: pd.DataFrame, method: str) -> None:
    """As sure as the log and two standard deviations off: the result lies half way, 1 / sqrt(2) as uncertain."""
    alone = excite.identify("emps", both_ways, method)
    mass, std = float(alone.value[0]), float(alone.std[0])
    given = mass + 2 * std
    text = f'[body.carriage.inertia]\nmass = {{ value = {given!r}, source = "measured", known = {std!r} }}\n'
    found = excite.identify(machine_file(tmp_path, text), both_ways, method)
    assert found.value[0] == pytest.approx(mass + std, abs=0.1 * std)
    assert found.std[0] == pytest.approx(std / np.sqrt(2), rel=0.1)
    assert found.status == alone.status


@pytest.mark.parametrize("method", ["inverse", "joint"])
def test_contradicted_value_is_named(tmp_path: Path, both_ways: pd.DataFrame, method: str) -> None:
    text = (
        '[body.carriage.inertia]\nmass = { value = 90, source = "measured", known = 0.5 }\n'
        '[body.carriage.friction]\nFv = { value = 203.5, source = "measured", known = 5.0 }\n'
    )
    found = excite.identify(machine_file(tmp_path, text), both_ways, method)
    assert found.status == "doubtful"
    assert "body.carriage.inertia.mass" in found.doubt


def test_unknown_quantities_leave_their_combinations_free(tmp_path: Path) -> None:
    """Only m2 and m4 known: MX0R = MX0 - D2 (m2 + m4) and M stay free, but not what they share with nothing free."""
    text = (
        "[body.rear_chassis.inertia]\nmass = { value = 4300, source = 'measured', known = 10.0 }\n"
        "com = { value = [-0.95, -0.10, 0], source = 'measured', known = true }\n"
        "[body.rear_roll.inertia]\nmass = { value = 2200, source = 'measured', known = 20.0 }\n"
    )
    known = model_of(tmp_path, text, "va12").known
    names = build(load_machine("va12")).base.names
    found = {n: s for n, s in zip(names, known.std, strict=True) if np.isfinite(s)}
    assert set(found) == {"MX2", "MY2"}
    # MX2 holds the rear roll at -D3; the exact centre of mass turns the mass's uncertainty into the moment's.
    assert found["MX2"] == pytest.approx(np.hypot(0.95 * 10, 1.75 * 20), rel=1e-3)
    assert found["MY2"] == pytest.approx(0.10 * 10, rel=0.02)


def test_deviation_of_one_is_no_flag(tmp_path: Path) -> None:
    """In Python 1.0 == True, which stands for an exact value."""
    model = model_of(tmp_path, '[known]\nM = { value = 95, source = "measured", known = 1.0 }\n')
    assert model.known.std[0] == pytest.approx(1.0)


def test_weighed_machine_is_known_as_a_base_parameter(tmp_path: Path) -> None:
    model = model_of(tmp_path, '[known]\nM = { value = 11010, source = "measured", known = 20 }\n', "va12")
    k = model.base.names.index("M")
    assert model.known.std[k] == pytest.approx(20)
    assert model.known.values / model.known.rows[:, k] == pytest.approx(11010)
    with pytest.raises(MachineError, match=r"known.Mass: no base parameter, allowed: M, "):
        model_of(tmp_path, '[known]\nMass = { value = 1, source = "measured", known = 1 }\n', "va12")


@pytest.mark.parametrize("value", ["0", "-1", "nan", '"yes"'])
def test_bad_deviation_is_refused(tmp_path: Path, value: str) -> None:
    with pytest.raises(MachineError, match=r"known: must be true \(known exactly\) or a standard deviation > 0"):
        model_of(tmp_path, f'[known]\nM = {{ value = 95, source = "measured", known = {value} }}\n')


def test_attainable_accuracy_counts_known_values(tmp_path: Path) -> None:
    plain = build(load_machine("va12_straight"))
    text = '[body.front_roll.friction]\nu0 = { value = -183.14, source = "measured", known = 1.0 }\n'
    known = model_of(tmp_path, text, "va12_straight")
    t = np.arange(0, 10, 1e-2)
    motion = simulate(plain, np.column_stack([1500 + 700 * np.sin(t), 1500 - 500 * np.sin(0.7 * t)]))
    k, offset = (plain.base.names.index(n) for n in ("Fs1", "u10"))
    before, after = (np.sqrt(np.diag(cramer_rao(m, motion))) for m in (plain, known))
    assert after[offset] <= 1.0
    assert after[k] < 0.3 * before[k]


def test_nothing_known_changes_nothing(both_ways: pd.DataFrame, tmp_path: Path) -> None:
    plain = excite.identify("emps", both_ways, "ols")
    text = '[body.carriage.inertia]\nmass = { value = 95.1089, source = "measured", known = false }\n'
    same = excite.identify(machine_file(tmp_path, text), both_ways, "ols")
    assert (plain.value == same.value).all()

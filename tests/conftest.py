"""Machines and drives that many tests share."""

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import importlib
import pkgutil
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from support.commands import Excite
from support.drives import drive
from support.files import SHARED
from support.logs import logged

import excite
from excite.model import Model, prediction
from excite.model.machine import Problem, machine
from excite.simulation import Motion, simulate
from excite.workflows import choose_problem

# A package keeps a public name when it is first used: one that a test has replaced in its module would stay.
for _module in pkgutil.walk_packages(excite.__path__, "excite."):
    if _module.ispkg:
        _package = importlib.import_module(_module.name)
        for _name in getattr(_package, "__all__", ()):
            getattr(_package, _name)

TWO_JOINTS = Path(__file__).parent / "support" / "two_joints.toml"

settings.register_profile("calm", deadline=None)  # other work on the machine is no fault of the code
settings.load_profile("calm")


@pytest.fixture(scope="session")
def va12() -> Model:
    return prediction.build(machine.load_machine("va12"))


@pytest.fixture(scope="session")
def straight() -> Model:
    return prediction.build(machine.load_machine("va12_straight"))


@pytest.fixture(scope="session")
def emps() -> Model:
    return prediction.build(machine.load_machine("emps"))


@pytest.fixture(scope="session")
def arm() -> Model:
    return prediction.build(machine.load_machine(str(TWO_JOINTS)))


@pytest.fixture(scope="session")
def problem(arm: Model) -> Problem:
    """The arm's design problem."""
    return choose_problem(arm.machine, None, None)[1]


@pytest.fixture(scope="session")
def va12_motion(va12: Model) -> Motion:
    return simulate(va12, drive(va12, 60, 0, {"u1": 1200, "u2": 4500, "u4": 1200}))


@pytest.fixture(scope="session")
def straight_motion(straight: Model) -> Motion:
    return simulate(straight, drive(straight, 40, 1, {"u1": 1200, "u4": 1200}))


@pytest.fixture(scope="session")
def sloping(straight: Model, straight_motion: Motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a straight drive up a slope that the model doesn't know."""
    place = tmp_path_factory.mktemp("sloping")
    return logged(straight, straight_motion, place / "sloping.csv", 7, "ground_slope=0.01")


@pytest.fixture(scope="session")
def emps_data() -> Path:
    path = SHARED / "emps" / "DATA_EMPS.mat"
    if not path.is_file():
        pytest.skip(f"the real EMPS measurements are not here ({path})")
    return path


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless Chromium, the system's own."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium on this machine (Debian: apt install chromium)")
    with api.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def excite(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Excite:
    from excite.__main__ import main

    def run(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["excite", *map(str, args)])
        monkeypatch.setattr("excite.interrupt.ignore_interrupts", lambda: None)  # the tests go on
        with pytest.raises(SystemExit) as end:
            main()
        shown = capsys.readouterr()
        return int(end.value.code or 0), shown.out, shown.err

    return run

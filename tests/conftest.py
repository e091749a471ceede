"""Machines and drives that many tests share."""

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import importlib.util
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import pytest
from hypothesis import settings

from excite.diagnosis import fits
from excite.logs import log, profile
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine import EffectEntry, machine
from excite.simulation import Motion, sensors, simulate

settings.register_profile("calm", deadline=None)  # other work on the machine is no fault of the code
settings.load_profile("calm")

SHARED = Path(__file__).parents[2] / "shared" / "data"
RESULTS = Path(__file__).parents[1] / "results"


def drive(model: Model, duration: float, seed: int, amplitude: dict[str, float]) -> np.ndarray:
    """A lively drive (N, n_u) [N m] from rest to about rest: a few sines of each torque, faded in and out."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * float(model.machine.sampling_hz)) + 1) / float(model.machine.sampling_hz)
    torque = np.zeros((len(t), len(model.inputs)))
    for k, name in enumerate(model.inputs):
        for frequency in (0.05, 0.08, 0.13, 0.2, 0.3):
            torque[:, k] += amplitude[name] * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 2 * np.pi))
    return torque * np.minimum(1, np.minimum(t, duration - t) / 2)[:, None]


def designed(name: str, model: Model) -> Motion:
    """A committed design, its torques on a machine."""
    torque, q0, nu0 = profile.read_profile(RESULTS / name / "design" / "profile.csv", model)
    return simulate(model, torque, q0=q0, nu0=nu0)


def study(name: str) -> ModuleType:
    """The script of a study in results/, as a module."""
    spec = importlib.util.spec_from_file_location(f"study_{name}", RESULTS / name / "study.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def logged(model: Model, motion: Motion, path: Path, seed: int, *texts: str) -> Path:
    """The log of a motion's torques on a machine with effects, as the sensors write it."""
    entries = [placing.parse(text, model.machine, float(motion.t[-1])) for text in texts]
    extended = prediction.build(placing.extended(model.machine, *entries)) if entries else model
    driven = simulate(extended, motion.u, q0=motion.q[0], nu0=motion.nu[0])
    sensors.measure(extended, driven, seed=seed).to_csv(path, index=False)
    return path


def gentle(model: Model, seconds: float) -> Motion:
    """Little torque for a short time."""
    t = np.arange(0, seconds + 0.01, 0.01)
    slow = np.minimum(1, np.minimum(t, seconds - t) / 2)
    return simulate(model, np.column_stack([1500 * np.sin(1.7 * t) * slow, 1200 * np.sin(2.6 * t) * slow]))


def calm(model: Model) -> fits.Stage:
    """The model fitted to a log of that without anything hidden."""
    one = log.from_table(sensors.measure(model, gentle(model, 12.0), seed=3), model.machine)
    return fits.fitted(model.machine, [one], model.machine.filter)


def slope(straight: Model) -> EffectEntry:
    """What `sloping` has hidden."""
    return placing.parse("ground_slope=0.01", straight.machine, 40.0)


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


class Excite(Protocol):
    """Runs a command in this process: exit code, stdout, stderr."""

    def __call__(self, *args: object) -> tuple[int, str, str]: ...


@pytest.fixture
def excite(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Excite:
    from excite.__main__ import main

    def run(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["excite", *map(str, args)])
        monkeypatch.setattr("excite.interrupt.deaf", lambda: None)  # the tests go on
        with pytest.raises(SystemExit) as end:
            main()
        shown = capsys.readouterr()
        return int(end.value.code or 0), shown.out, shown.err

    return run

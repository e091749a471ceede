"""Bad input at scale: mutated logs, machine files, profiles, studies, designs, messages and command lines.

Whatever comes in, one clear line or a right result comes out: no traceback, no hang, no number that is silently none,
no file outside the place that was asked for. INPUTS says how many of each kind, and with which seeds: a failure names
its own and can be had again. `pytest tests/cli/test_bad_input.py -m slow -s` says what came of each kind.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import given, settings, strategies as st
from support.commands import Excite

from excite import workflows
from excite.errors import (
    DesignFolderError,
    EstimateFolderError,
    InfeasibleError,
    LogError,
    MachineError,
    NoEstimateError,
    SimulationError,
    StudyError,
)
from excite.identification import methods, saved_estimate
from excite.logs import inspection, log, profile as profiles, tables
from excite.model import Model, prediction
from excite.model.effects import placing
from excite.model.machine import machine
from excite.operator import server
from excite.simulation import sensors, simulate
from excite.trajectories import saved_design
from excite.workflows import study_plan

T = TypeVar("T")
TIMES = int(os.environ.get("MUTATED_INPUTS", "1"))  # 3 of them and -m slow: more than ten thousand inputs
INPUTS = {  # mutated inputs: how many in the fast suite (seeds from 1) and in the slow one, whose seeds are from
    "logs": (60, 1200, 1000),
    "machine files": (60, 1000, 1000),
    "profiles": (30, 500, 1000),
    "studies": (40, 500, 1000),
    "command lines": (40, 200, 1000),
    "command lines as processes": (0, 20, 50_000),
    "design folders": (20, 200, 1000),
    "estimates": (20, 200, 1000),
}
PATIENCE = 120.0  # s for one input, on a machine that is busy
LONGEST = 800  # characters of a message
VALUES = (
    '0 -1 1 2 1e-300 1e300 1e999 -1e999 nan inf -inf true false "" "x" "../../etc/passwd" "$(touch_gone)" [] {} [[]]'
    ' [1,2] {a=1} 9999999999999999999999 -0.0 "pi" "-pi/0" 1e-13 "\\u0000" 0x10 1979-05-27 "va12" "ground" 99 "é" "\\n"'
).split()
CELLS = [
    "",
    "nan",
    "inf",
    "-inf",
    "1e999",
    "1e308",
    "0x1",
    "1,5",
    "NULL",
    "None",
    '"',
    "=1+1",
    "é",
    "\x00",
    " ",
    "1_000",
    "true",
    "1e-320",
]


@contextmanager
def patience(what: str, faults: list[str]) -> Iterator[None]:
    """One input: what it raises, or that it takes for ever, is a fault."""

    def late(*_: object) -> None:
        raise TimeoutError(f"more than {PATIENCE} s: {what}")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    except Exception as err:
        at = traceback.extract_tb(err.__traceback__)[-1]
        faults.append(f"{what}: {type(err).__name__}: {str(err)[:200]} ({Path(at.filename).name}:{at.lineno})")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def spoilt(data: bytes, rng: random.Random) -> bytes:
    """Bytes changed, cut, doubled, moved or put in."""
    data = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        if not data:
            break
        at = rng.randrange(len(data))
        how = rng.randrange(6)
        if how == 0:
            data[at] = rng.randrange(256)
        elif how == 1:
            del data[at : at + rng.choice((1, 4, 50, len(data)))]
        elif how == 2:
            data[at:at] = bytes(rng.randrange(256) for _ in range(rng.choice((1, 3, 9))))
        elif how == 3:
            data[at:at] = data[at : at + rng.choice((1, 10, 200))]
        elif how == 4:
            data[at] ^= 1 << rng.randrange(8)
        else:
            data[at:at] = rng.choice((b"\n", b",", b"-", b"\x00", b"\xef\xbb\xbf", b'"', b"\r", b"e999", b"="))
    return bytes(data)


def spoilt_csv(text: str, rng: random.Random) -> bytes:
    """A table whose cells, rows or columns are wrong."""
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if len(rows) < 2 or not rows[0]:
            break
        r, c = rng.randrange(len(rows)), rng.randrange(len(rows[0]))
        how = rng.randrange(14)
        if how >= 9 and r and c < len(rows[r]):
            rows[r][c] = scaled(rows[r][c], rng)
        elif how == 0 and c < len(rows[r]):
            rows[r][c] = rng.choice(CELLS)
        elif how == 1:
            del rows[r]
        elif how == 2:
            rows.insert(r, rows[rng.randrange(len(rows))][:])
        elif how == 3:
            for row in rows:
                del row[c : c + 1]
        elif how == 4:
            rows[r] = rows[r][: rng.randrange(len(rows[r]) + 1)]
        elif how == 5:
            factor = rng.choice((-1.0, 0.0, 1e3, 1e-3, 57.3, 1e12, 1e300))
            for row in rows[1:]:
                if c < len(row):
                    with suppress(ValueError):
                        row[c] = repr(float(row[c]) * factor)
        elif how == 6:
            rows[0][min(c, len(rows[0]) - 1)] = rng.choice((*rows[0], "", "x", "Unnamed: 0"))
        elif how == 7:
            rows[r].append(rng.choice(CELLS))
        else:
            rows = rows[: rng.randrange(len(rows)) + 1]
    return ("\n".join(",".join(row) for row in rows) + "\n").encode("utf-8", "surrogateescape")


def scaled(text: str, rng: random.Random) -> str:
    """One of the numbers in a text times something."""
    found = list(re.finditer(r"(?<![\w.])-?\d+(\.\d+)?([eE][-+]?\d+)?(?![\w.])", text))
    if not found:
        return text
    m = rng.choice(found)
    value = float(m[0]) * rng.choice((-1, 0, 0.5, 1.001, 1.01, 2, 10, 1e3, 1e-3))
    return (
        text[: m.start()]
        + (repr(value) if "." in m[0] or not math.isfinite(value) else str(round(value)))
        + text[m.end() :]
    )


def spoilt_toml(text: str, rng: random.Random) -> bytes:
    """A file whose keys, values, lines or tables are wrong, or its bytes."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not lines:
            break
        k = rng.randrange(len(lines))
        how = rng.randrange(12)
        key, equals, value = lines[k].partition("=")
        if how <= 2 and equals:
            inner = value.find("value = ")
            if inner >= 0 and rng.random() < 0.7:
                end = value.find(",", inner)
                lines[k] = f"{key}={value[:inner]}value = {rng.choice(VALUES)}{value[end:]}"
            else:
                lines[k] = f"{key}= {rng.choice(VALUES)}"
        elif how >= 7 or not equals:
            lines[k] = scaled(lines[k], rng)
        elif how == 3:
            del lines[k]
        elif how == 4:
            lines.insert(k, lines[rng.randrange(len(lines))])
        elif how == 5:
            lines[k] = f"{rng.choice(('x', 'name', 'index', 'value', 'extends', 'machine', ''))} ={value}"
        else:
            return spoilt("\n".join(lines).encode(), rng)
    return "\n".join(lines).encode()


def spoilt_json(data: bytes, rng: random.Random) -> bytes:
    """A value that is of another kind or size."""
    values = ("null", "-1", "1e999", "NaN", '"x"', "[]", "{}", "true", "0", "9" * 400, "[" * 100_000)
    parts = data.decode().split(":")
    at = rng.randrange(1, len(parts))
    value, comma, rest = parts[at].partition(",")
    parts[at] = rng.choice(values) + comma + rest if "{" not in value and "[" not in value else parts[at]
    return ":".join(parts).encode()


def changed(good: T, spoil: Callable[[random.Random], T], rng: random.Random) -> T:
    """What `spoil` makes of a good input, never that itself: some changes change nothing."""
    while (made := spoil(rng)) == good:
        pass
    return made


def one_line(err: Exception, path: Path | None = None) -> None:
    """A message is one line of bearable length that names the file."""
    text = " ".join(str(err).split())  # as the command line shows it
    assert path is None or str(path) in text
    assert text.strip(), "an error without a word"
    assert "\n" not in text, text
    assert len(text) <= LONGEST, text
    assert "Traceback" not in text


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory, straight: Model) -> dict[str, Any]:
    """Good inputs: a motion of 2.4 s, its profile, logs, machine files, a study, a design folder."""
    t = np.arange(241) / 100
    motion = simulate(straight, np.column_stack([1500 * np.sin(8 * t), 1200 * np.sin(11 * t)]))
    place = tmp_path_factory.mktemp("ground")
    table = sensors.measure(straight, motion, seed=1)
    table.to_parquet(place / "log.parquet", index=False)
    scipy.io.savemat(place / "log.mat", {c: table[c].to_numpy()[:, None] for c in table})
    profile = profiles.profile_of(straight, motion).to_csv(index=False)
    (place / "found").mkdir()
    workflows.identify(place / "found", "va12_straight", [place / "log.parquet"], "ols")
    design = place / "design"
    design.mkdir()
    (design / "profile.csv").write_text(profile)
    (design / "machine.json").write_text(straight.machine.model_dump_json())
    (design / "summary.json").write_text(json.dumps({"machine": "va12_straight", "problem": "S40", "duration_s": 2.4}))
    study = (
        'name = "s"\nruns = 2\nsteps = ["verify"]\n[grid]\nmachine = ["va12_straight"]\nobjective = ["cond", "D"]\n'
        'duration_s = [20, 30]\nlimits = [{}, { torque = 0.5 }]\nkit = ["full"]\nmethod = ["ols"]\nseed = [0, 1]\n'
        'effects = [[], "rolling_resistance@front_roll=30"]\n'
        '[sample]\ncount = 3\nmachine = "va12_straight"\nmethod = "ols"\n'
    )
    return {
        "place": place,
        "table": table,
        "csv": table.to_csv(index=False),
        "parquet": (place / "log.parquet").read_bytes(),
        "mat": (place / "log.mat").read_bytes(),
        "profile": profile,
        "design": design,
        "found": place / "found",
        "study": study,
        "machines": [(machine.MACHINES / f"{n}.toml").read_text() for n in ("va12", "emps", "va12_straight")],
    }


Told = Counter[str]
TESTED: set[str] = set()


def many(kind: str) -> Callable[[Any], Any]:
    """How many inputs of this kind: few in the fast suite, many in the slow one, with other seeds."""
    few, slow, seed = INPUTS[kind]
    TESTED.add(kind)
    sizes = [(few, 1)] if few else []
    cases = [*sizes, pytest.param(TIMES * slow, seed, marks=pytest.mark.slow)]
    return pytest.mark.parametrize(("count", "seed"), cases, ids=[f"few-{few}"] * len(sizes) + [f"many-{slow}"])


def test_every_kind_of_input_is_mutated() -> None:
    assert set(INPUTS) == TESTED
    assert 3 * sum(slow for kind, (_, slow, _) in INPUTS.items() if "folders" not in kind) >= 10_000


def show(what: str, told: Told, count: int, seed: int, faults: list[str]) -> None:
    print(f"\n{what}: {count} mutated inputs, seeds from {seed}: {dict(told)}")
    assert not faults, f"{len(faults)} faults\n" + "\n".join(faults[:40])


@many("logs")
def test_logs(ground: dict[str, Any], straight: Model, tmp_path: Path, count: int, seed: int) -> None:
    """A spoilt log is refused in a line, or read as finite numbers; an estimate from what was read is finite."""
    told: Told = Counter()
    faults: list[str] = []
    for k in range(count):
        rng = random.Random(seed + k)
        kind = rng.choice(("csv", "csv", "csv", "bytes", "parquet", "mat"))
        good = ground["csv"].encode() if kind in ("csv", "bytes") else ground[kind]
        data = changed(good, partial(spoilt_csv, ground["csv"]) if kind == "csv" else partial(spoilt, good), rng)
        path = tmp_path / f"log.{kind.replace('bytes', 'csv')}"
        path.write_bytes(data)
        with patience(f"log {kind} {seed + k}", faults), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                needs = rng.choice(((), methods.needed_sensors(straight, "ols")))
                read = log.read_log(path, straight.machine, needs)
            except LogError as err:
                one_line(err, path)
                told["refused"] += 1
            else:
                assert all(np.isfinite(v).all() and len(v) == len(read.t) for v in read.values.values())
                told["read"] += 1
                if needs and rng.random() < 0.2:
                    told[estimated(straight, read)] += 1
            if k % 7 == 0:
                try:
                    inspection.inspect(tables.read_table(path), straight.machine, str(path))
                except LogError as err:
                    one_line(err)
    show("logs", told, count, seed, faults)
    assert min(told["refused"], told["read"]) > count / 20, "the mutations no longer test both"


def estimated(model: Model, read: log.Log) -> str:
    try:
        found = methods.identify(model, [read], "ols")
    except (NoEstimateError, LogError) as err:
        one_line(err)
        return "no estimate"
    known = [n not in dict(found.unidentifiable) for n in found.names]
    assert np.isfinite(found.value[known]).all()
    assert np.isfinite(found.std[known]).all()
    return "estimate"


@many("machine files")
def test_machine_files(ground: dict[str, Any], tmp_path: Path, count: int, seed: int) -> None:
    """A spoilt machine file is refused in a line that names it, or is a machine whose model has finite numbers."""
    told: Told = Counter()
    faults: list[str] = []
    for k in range(count):
        rng = random.Random(seed + k)
        path = tmp_path / "roller.toml"
        good = rng.choice(ground["machines"])
        path.write_bytes(changed("\n".join(good.splitlines()).encode(), partial(spoilt_toml, good), rng))
        with patience(f"machine {seed + k}", faults):
            try:
                loaded = machine.load_machine(path)
            except MachineError as err:
                one_line(err, path)
                told["refused"] += 1
                continue
            told["read"] += 1
            if rng.random() < 0.25:
                try:
                    model = prediction.build(loaded)
                except MachineError as err:
                    one_line(err)
                    told["no model"] += 1
                else:
                    assert np.isfinite(model.nominal).all()
                    told["model"] += 1
    show("machine files", told, count, seed, faults)
    assert min(told["refused"], told["read"]) > count / 20
    assert [p.name for p in tmp_path.iterdir()] == ["roller.toml"]


@many("profiles")
def test_profiles(ground: dict[str, Any], straight: Model, tmp_path: Path, count: int, seed: int) -> None:
    """A spoilt profile is refused, or drives a motion of finite numbers, or can't be driven, which is said."""
    told: Told = Counter()
    faults: list[str] = []
    path = tmp_path / "profile.csv"
    for k in range(count):
        rng = random.Random(seed + k)
        good = ground["profile"].encode()
        spoil = partial(spoilt_csv, ground["profile"]) if rng.random() < 0.8 else partial(spoilt, good)
        path.write_bytes(changed(good, spoil, rng))
        with patience(f"profile {seed + k}", faults), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                torque, q0, nu0 = profiles.read_profile(path, straight)
                assert np.isfinite(torque).all()
                motion = simulate(straight, torque, q0=q0, nu0=nu0)
                assert np.isfinite(motion.q).all()
                assert np.isfinite(motion.nu).all()
                told["driven"] += 1
            except LogError as err:
                one_line(err, path)
                told["refused"] += 1
            except SimulationError as err:
                one_line(err)
                told["not driven"] += 1
    show("profiles", told, count, seed, faults)
    assert min(told["refused"], told["driven"]) > count / 20


@many("studies")
def test_studies(ground: dict[str, Any], tmp_path: Path, count: int, seed: int) -> None:
    """A spoilt study is refused in a line that names it, or has cells; nothing is computed and nothing written."""
    told: Told = Counter()
    faults: list[str] = []
    for k in range(count):
        rng = random.Random(seed + k)
        path = tmp_path / "study.toml"
        good = "\n".join(ground["study"].splitlines()).encode()
        path.write_bytes(changed(good, partial(spoilt_toml, ground["study"]), rng))
        with patience(f"study {seed + k}", faults):
            try:
                found = study_plan.read_study(path)
                assert found.total >= 1
                assert Path(found.study.name).name == found.study.name
                told["read"] += 1
            except (StudyError, MachineError, LogError) as err:
                one_line(err, path)
                told["refused"] += 1
    show("studies", told, count, seed, faults)
    assert min(told["refused"], told["read"]) > count / 20
    assert [p.name for p in tmp_path.iterdir()] == ["study.toml"]


@many("design folders")
def test_design_folders(ground: dict[str, Any], tmp_path: Path, count: int, seed: int) -> None:
    """A spoilt design folder is refused in a line, or read as finite numbers."""
    told: Told = Counter()
    faults: list[str] = []
    for k in range(count):
        rng = random.Random(seed + k)
        for name in ("profile.csv", "machine.json", "summary.json"):
            (tmp_path / name).write_bytes((ground["design"] / name).read_bytes())
        name = rng.choice(("profile.csv", "machine.json", "summary.json"))
        good = (tmp_path / name).read_bytes()
        spoil = spoilt_json if name != "profile.csv" and rng.random() < 0.7 else spoilt
        (tmp_path / name).write_bytes(changed(good, partial(spoil, good), rng))
        with patience(f"design {seed + k}", faults), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = saved_design.read_design(tmp_path)
                assert np.isfinite(found.motion.q).all()
                told["read"] += 1
            except (DesignFolderError, LogError, SimulationError, MachineError) as err:
                one_line(err)
                told["refused"] += 1
    show("design folders", told, count, seed, faults)
    assert told["refused"] > count / 10


@many("estimates")
def test_estimates(ground: dict[str, Any], tmp_path: Path, count: int, seed: int) -> None:
    """A spoilt folder of an estimate is refused in a line, or predicts finite numbers with finite bands."""
    told: Told = Counter()
    faults: list[str] = []
    names = ("summary.json", "machine.json", "covariance.csv", "tolerances.csv")
    for k in range(count):
        rng = random.Random(seed + k)
        for name in names:
            (tmp_path / name).write_bytes((ground["found"] / name).read_bytes())
        name = rng.choice(names)
        good = (tmp_path / name).read_bytes()
        spoil = spoilt_json if name.endswith("json") else lambda data, rng: spoilt_csv(data.decode(), rng)
        spoil = spoil if rng.random() < 0.8 else spoilt
        (tmp_path / name).write_bytes(changed(good, partial(spoil, good), rng))
        with patience(f"estimate {seed + k}", faults), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = saved_estimate.read_estimate(tmp_path)
            except EstimateFolderError as err:
                one_line(err)
                told["refused"] += 1
            else:
                assert np.isfinite(found.estimate.value).all()
                assert np.isfinite(found.estimate.std_total).all()
                told["read"] += 1
    show("estimates", told, count, seed, faults)
    assert min(told["refused"], told["read"]) > count / 20


WORDS = [
    *("--out", "--json", "--seed", "--kit", "--method", "--noise", "--effect", "--runs", "--problem", "--duration"),
    *("--objective", "--starts", "--budget", "--samples", "--validate", "--jobs", "--cluster", "--help"),
    *("--sigma-max", "--robust", "--after", "--phases", "--shortest", "--live", "--port", "-1", "0", "1e999", "nan"),
    *(
        "",
        " ",
        "é",
        "\x07",
        "x" * 5000,
        "../..",
        "/",
        ".",
        "~",
        "$HOME",
        "`id`",
        "; touch gone",
        "--",
        "-",
        "%s",
        "{0}",
    ),
    *("full", "paper", "ols", "joint", "S40", "R60", "cond", "va12", "va12_straight", "emps", "log.csv", "profile.csv"),
    *(
        "rolling_resistance@front_roll=30",
        "ground_slope=nan",
        "=",
        "@=",
        "ground_slope=1e400",
        "nowhere.toml",
        "spoilt.toml",
    ),
    *("spoilt.csv", "design", "study.toml", "tcp://127.0.0.1:1", "\u202e", "a\nb", "$\\frac{$"),
]
GOOD = [
    "machines",
    "simulate va12_straight profile.csv --seed 3 --out made.csv",
    "simulate va12_straight profile.csv --noise off --effect ground_slope=0.001 --out made.parquet",
    "identify va12_straight log.csv --method ols --out made",
    "predict found profile.csv --out made",
    "predict found log.csv --out made",
    "verify design --runs 1 --method ols --kit full --out made",
    "design va12_straight --duration 8 --starts 1 --out made",
    "run va12_straight --duration 8 --starts 1 --runs 1 --out made",
    "compare va12_straight --samples 1 --budget 1 --out made",
    "study study.toml --jobs 1 --out made",
    "drive design --out made",
    "log check log.csv --machine va12_straight --out made",
    "diagnose va12_straight log.csv --out made",
]
TRACES = ("Traceback", "Error:", "site-packages")


def spoilt_line(rng: random.Random) -> list[str]:
    """A good command line with words put in, taken out, replaced or spoilt."""
    good = shlex.split(rng.choice(GOOD))
    return changed(good, partial(_spoilt_words, good), rng)


def _spoilt_words(good: list[str], rng: random.Random) -> list[str]:
    line = good[:]
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(len(line) + 1)
        how = rng.randrange(4)
        if how == 0:
            line.insert(at, rng.choice(WORDS))
        elif how == 1 and line:
            del line[min(at, len(line) - 1)]
        elif how == 2 and line:
            line[min(at, len(line) - 1)] = rng.choice(WORDS)
        elif line:
            line[min(at, len(line) - 1)] = spoilt(line[min(at, len(line) - 1)].encode(), rng).decode("utf-8", "replace")
    return [word.replace("\x00", "") for word in line]


def laid_out(ground: dict[str, Any], place: Path) -> set[str]:
    """A folder to be in, with good and spoilt files; the names in it."""
    for name in ("csv", "profile", "study"):
        (place / {"csv": "log.csv", "profile": "profile.csv", "study": "study.toml"}[name]).write_text(ground[name])
    rng = random.Random(0)
    (place / "spoilt.csv").write_bytes(spoilt_csv(ground["csv"], rng))
    (place / "spoilt.toml").write_text('extends = "va12_straight"\ntitle = "a $\\\\frac{$ <b>&"\nname = "odd"\n')
    for name in ("design", "found"):
        shutil.copytree(ground[name], place / name)
    return {p.name for p in place.iterdir()}


@many("command lines")
def test_command_lines(
    ground: dict[str, Any],
    tmp_path: Path,
    excite: Excite,
    monkeypatch: pytest.MonkeyPatch,
    count: int,
    seed: int,
) -> None:
    """Any words behind `excite`: exit 0, 1 or 2, one clear line where it isn't 0, no file but the one asked for.

    Searches and studies are cut out: what is tested is what leads to them.
    """
    from excite import diagnosis, identification, operator, trajectories
    from excite.workflows import design_request

    def cut(*_: Any, **__: Any) -> Any:
        raise InfeasibleError("cut out", "none", 1.0)

    assert workflows.design_from is design_request.design_from  # the face has it before it is replaced
    monkeypatch.setattr(design_request, "design_from", cut)
    # Faces load a name once: replaced there, it is put back there as well.
    for package, names_cut in (
        (workflows, ("run_study",)),
        (trajectories, ("compare",)),
        (diagnosis, ("diagnose",)),
        (identification, ("verify",)),
        (operator, ("serve", "prepare")),
    ):
        for name in names_cut:
            monkeypatch.setattr(package, name, cut)
    cwd = tmp_path / "here"
    cwd.mkdir()
    monkeypatch.chdir(cwd)
    names = laid_out(ground, cwd)
    told: Told = Counter()
    faults: list[str] = []
    for k in range(count):
        line = spoilt_line(random.Random(seed + k))
        asked = [line[i + 1] for i, w in enumerate(line[:-1]) if w == "--out"]
        asked += [w.partition("=")[2] for w in line if w.startswith("--out=")]
        with patience(f"command {seed + k} {line}", faults), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code, stdout, stderr = excite(*line)
            told[f"exit {code}"] += 1
            assert code in (0, 1, 2)
            if code:
                assert len(stderr.strip().splitlines()) == 1, stderr
                assert stderr.isprintable() or stderr[:-1].isprintable(), stderr
                assert not any(t in stderr for t in TRACES), stderr
            elif "--json" in line and "--help" not in line:
                assert numbers(stdout) == []
        clean(cwd, names, asked, line)
    show("command lines", told, count, seed, faults)
    assert told["exit 2"] > count / 4
    assert {p.name for p in tmp_path.iterdir()} == {"here"}, "a file outside the folder"


def numbers(text: str) -> list[float]:
    """Constants of a JSON text that strict JSON doesn't have, as NaN."""
    found: list[float] = []
    json.loads(text, parse_constant=lambda name: found.append(math.nan))
    return found


def clean(cwd: Path, names: set[str], asked: list[str], line: list[str]) -> None:
    """Removes what a command was asked to write; anything else that is new is a fault."""
    roots = {Path(a).parts[0] for a in asked if Path(a).parts} | {"results"}
    for path in cwd.iterdir():
        if path.name in names:
            continue
        assert path.name in roots, (line, path)
        subprocess.run(["rm", "-rf", str(path)], check=True)


@many("command lines as processes")
def test_command_lines_as_people_type_them(ground: dict[str, Any], tmp_path: Path, count: int, seed: int) -> None:
    """Some of them as processes of their own: nothing of Python's is shown, and nothing is run from a name."""
    cwd = tmp_path / "here"
    cwd.mkdir()
    names = laid_out(ground, cwd)
    heavy = {"design", "run", "compare", "study", "diagnose", "drive", "docs"}
    told: Told = Counter()
    light = (line for k in itertools.count(seed) if not heavy & set(line := spoilt_line(random.Random(k))))
    for line in itertools.islice(light, count):
        done = subprocess.run(
            [sys.executable, "-m", "excite", *line], cwd=cwd, capture_output=True, text=True, timeout=120
        )
        assert done.returncode in (0, 1, 2), (line, done.stderr)
        assert "Traceback" not in done.stderr, (line, done.stderr)
        told[f"exit {done.returncode}"] += 1
    show("command lines as processes", told, count, seed, [])
    assert "gone" not in {p.name for p in cwd.rglob("*")}
    assert {p.name for p in tmp_path.iterdir()} == {"here"}
    assert names <= {p.name for p in cwd.iterdir()}


# ------------------------------------------------------------------------------------------------ names and paths


@pytest.mark.parametrize(
    "line",
    [
        'name = "../../away"',
        'name = "/etc/away"',
        'name = "a/b"',
        'name = ""',
        'extends = "../secret.toml"',
        'extends = "/etc/passwd"',
        'problem = "../../away"',
    ],
)
def test_a_machine_file_leads_nowhere(line: str, tmp_path: Path) -> None:
    """Neither its name nor what it extends reaches outside its own folder."""
    (tmp_path / "secret.toml").write_text('extends = "va12"\n')
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "roller.toml"
    path.write_text(f"{line}\n" if "extends" in line else f'extends = "va12_straight"\n{line}\n')
    with pytest.raises(MachineError) as err:
        machine.load_machine(path)
    one_line(err.value)


LONG = "x" * 5000


@pytest.mark.parametrize(
    "line",
    [
        *(f"identify va12 {LONG}.csv", f"identify {LONG} a.csv", f"diagnose va12 {LONG}.mat", f"verify {LONG}"),
        *(f"study {LONG}.toml", f"drive {LONG}", f"simulate va12 {LONG} --out a.csv", f"machine new {LONG}"),
        *(f"design va12 --after {LONG}", f"docs --out {LONG}", f"docs --out {LONG[:250]}", f"docs --out {'x/' * 3000}"),
    ],
    ids=lambda line: line[:20],
)
def test_too_long_a_name_is_one_clear_line(
    line: str, tmp_path: Path, excite: Excite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, stdout, stderr = excite(*line.split())
    assert (code, stdout) == (2, "")
    assert re.search("is too long a name|File name too long|no such machine", stderr)
    assert len(stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_titles_and_paths_are_text_in_figures_and_reports(
    ground: dict[str, Any], tmp_path: Path, excite: Excite
) -> None:
    """A title with a formula's dollar or a tag in it is shown as it is: no crash, no script in the report."""
    path = tmp_path / "odd.toml"
    title = "$\\\\frac{$ <script>alert(1)</script>"
    path.write_text(f'extends = "va12_straight"\nname = "odd"\ntitle = "{title}"\n')
    source = tmp_path / "a $x_{ <b>.csv"
    source.write_text(ground["csv"])
    code, _, stderr = excite("identify", path, source, "--method", "ols", "--out", tmp_path / "o")
    assert (code, stderr) == (0, "")
    report = (tmp_path / "o" / "report.html").read_text()
    assert "<script>alert(1)" not in report
    assert "<b>.csv" not in report


# ------------------------------------------------------------------------------------------------ properties


@settings(max_examples=200, derandomize=True)
@given(st.text(max_size=60))
def test_any_text_is_an_effect_or_is_refused(text: str) -> None:
    try:
        entry = placing.parse_effect(text, VA12, 60.0)
    except MachineError as err:
        one_line(err)
    else:
        assert math.isfinite(float(entry.amount))


VA12 = machine.load_machine("va12")
KEYS = (server.TIME, server.SPEED, "articulation_rad")
FLOATS = st.floats(allow_nan=True, allow_infinity=True)
JSON = st.recursive(
    st.none() | st.booleans() | FLOATS | st.integers() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from((*KEYS, "x")), inner, max_size=4),
    max_leaves=6,
)


@settings(max_examples=500, derandomize=True)
@given(JSON | st.binary(max_size=40) | st.text(max_size=40))
def test_a_message_is_numbers_or_is_refused(message: Any) -> None:
    """What the driver's page shows is finite numbers under known keys, whatever is sent."""
    said = server.parse_message(message if isinstance(message, str | bytes) else json.dumps(message), KEYS)
    if said is not None:
        assert set(said) <= set(KEYS)
        assert all(isinstance(v, float) and math.isfinite(v) for v in said.values())


@pytest.mark.parametrize("value", ["9" * 400, "[" * 100_000, "1e999", "NaN"], ids=["long", "deep", "inf", "nan"])
def test_a_message_that_no_number_holds_is_refused(value: str) -> None:
    assert server.parse_message(f'{{"{server.TIME}": 0, "{server.SPEED}": {value}}}', KEYS) is None


@settings(max_examples=25, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1.0, 1e4]), st.sampled_from(["u1", "u4"]))
def test_what_is_written_is_what_is_read(seed: int, size: float, name: str) -> None:
    """Any torques go through a CSV file as they are, to the last bit."""
    values = size * np.random.default_rng(seed).uniform(-1, 1, 230)
    sensor = next(s for s in STRAIGHT.machine.sensor if s.name == name)
    columns = {s.column: np.zeros(230) for s in STRAIGHT.machine.sensors("full")} | {sensor.column: values}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        pd.DataFrame({"t_s": np.arange(230) / 100} | columns).to_csv(path, index=False)
        assert np.array_equal(log.read_log(path, STRAIGHT.machine).values[name], values)


STRAIGHT = prediction.build(machine.load_machine("va12_straight"))

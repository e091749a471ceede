"""Documents that can't go stale: the tutorial is run, the README's lines too, reference pages come from the code."""

from __future__ import annotations

import argparse
import contextlib
import doctest
import importlib
import inspect
import itertools
import json
import os
import pty
import re
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import typer
from support import studies
from support.commands import Excite

import excite as interface
from excite import output, trajectories, workflows
from excite.cli import app, reference, reference_html
from excite.model.effects import catalogue
from excite.model.machine import shipped_machines, units

ROOT = Path(__file__).parents[1]
ENVIRONMENT = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}


STUDIES = sorted((ROOT / "results").glob("*/study.py"))


def named(script: Path) -> str:
    return f"{script.parent.name}-{script.stem}"


def blocks(path: Path) -> list[tuple[str, str]]:
    """Code blocks of a page in order: language, text."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_one_version_everywhere() -> None:
    """In the package, in the changelog's newest entry, in what is cited; dates too."""
    own = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cited = dict(re.findall(r"^([\w-]+): (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE))
    newest = re.search(r"^## \[([\d.]+)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert newest is not None
    assert newest.groups() == (own["version"], cited["date-released"])
    assert (cited["title"], cited["version"]) == (own["name"], own["version"])
    assert cited["license"] == own["license"]["text"]


def test_links_lead_somewhere() -> None:
    pages = [ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md"), ROOT / "results" / "README.md"]
    pages += (ROOT / "results").glob("*/README.md")
    for page in pages:
        for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert link.startswith("https://") or (page.parent / link).exists(), f"{page.name}: {link}"


PARAMETERS = {
    name: number
    for names, numbers in re.findall(
        r"^\| (`[^|]*`) \| [^|]* \| ([\d, ]+) \|$", (ROOT / "docs" / "machines.md").read_text(encoding="utf-8"), re.M
    )
    for name, number in zip(re.findall("`(.*?)`", names), itertools.cycle(map(int, numbers.split(","))), strict=False)
}


def test_the_page_on_machines_lists_every_machine() -> None:
    assert set(PARAMETERS) == set(shipped_machines())


@pytest.mark.slow
@pytest.mark.parametrize("name", PARAMETERS)
def test_the_page_on_machines_counts_parameters_as_the_model_does(name: str) -> None:
    assert len(interface.load(name).base.names) == PARAMETERS[name]


def test_the_page_on_sensors_has_the_study_s_table() -> None:
    table = (ROOT / "results" / "sensors" / "table.md").read_text(encoding="utf-8")
    assert table in (ROOT / "docs" / "measuring.md").read_text(encoding="utf-8")


SCRIPTS = sorted((ROOT / "results").glob("*/*.py"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "scripts",
    [
        [p for p in SCRIPTS if p.parent.name != "duel"],  # at once, which is much faster
        *([p] for p in SCRIPTS if p.parent.name == "duel"),  # whose study imports its neighbour
    ],
    ids=lambda scripts: scripts[0].parent.name if len(scripts) == 1 else "others",
)
def test_a_study_calls_the_program_as_it_is(scripts: list[Path], tmp_path: Path) -> None:
    """Names that are gone, arguments that are missing: what would stop a study that nobody has run for long."""
    (tmp_path / "mypy.ini").write_text(
        "[mypy]\ncheck_untyped_defs = true\nignore_missing_imports = true\n[mypy-mujoco.*]\nfollow_imports = skip\n"
    )
    vague = "arg-type assignment index misc operator return-value str-format var-annotated".split()
    told = [x for code in vague for x in ("--disable-error-code", code)]
    told += ["--config-file", str(tmp_path / "mypy.ini"), "--follow-imports", "silent"]
    if len(scripts) > 1:  # many are called study.py
        told += ["--namespace-packages", "--explicit-package-bases"]
    ran = subprocess.run(
        [sys.executable, "-m", "mypy", *told, *map(str, scripts)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=ENVIRONMENT | {"MYPYPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
    )
    assert ran.returncode == 0, ran.stdout


@pytest.mark.parametrize("study", [p for p in STUDIES if p.parent.name not in ("duel", "machines")], ids=named)
def test_a_study_writes_where_it_is_told(study: Path) -> None:
    """Its options come with `--out`, and its own folder is only read."""
    text = study.read_text(encoding="utf-8")
    assert "studies.parse(parser, __file__" in text
    assert "parse_args" not in text
    writing = r"(?:save|new_file|open|mkdir|write_\w+)\("
    assert not re.findall(rf"{writing}[^\n]*HERE|HERE[^\n]*\.{writing}", text)


def test_a_study_leaves_published_results_alone_by_default(tmp_path: Path) -> None:
    script = str(ROOT / "results" / "cost" / "study.py")
    assert studies.default_out(script) == ROOT / "results" / "cost-rebuilt"
    assert "/results/*-*/" in (ROOT / ".gitignore").read_text(encoding="utf-8").split()
    given = studies.parse(argparse.ArgumentParser(), script, ["--out", str(tmp_path / "a" / "b")])
    assert given.out == tmp_path / "a" / "b"
    assert given.out.is_dir()


def test_a_study_s_summary_says_how_it_was_made() -> None:
    made = studies.origin(str(ROOT / "results" / "cost" / "study.py"), 3)
    assert made["command"].startswith("python results/cost/study.py")
    assert made["seed"] == 3
    assert made["versions"]["excite"] == interface.__version__
    assert re.fullmatch(r"[0-9a-f]{7,}(-dirty)?|None", str(made["commit"]))  # None outside a repository


def test_every_command_of_a_study_says_what_it_writes() -> None:
    page = (ROOT / "results" / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"`(python results/[^`]+|excite [^`]+)`", page.split("## Rebuild")[1])
    assert len(commands) > 18
    for command in commands:
        if not command.startswith("python results/machines/"):
            assert re.search(r" --out results/\w+", command), command


def test_a_study_can_be_rebuilt_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """No command of the list would refuse its folder for what is in it."""
    monkeypatch.chdir(ROOT)
    places = re.findall(
        r"`excite [^`]*--out (results/[^ `]+)", (ROOT / "results" / "README.md").read_text(encoding="utf-8")
    )
    assert len(places) > 8
    for place in places:
        output.check_out_folder(Path(place))
        assert (ROOT / place / "summary.json").is_file() or (ROOT / place / "design" / "summary.json").is_file()


@pytest.mark.slow
def test_tutorial_runs_as_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands and lines, with fewer runs of a study and in Python, and less time for the design."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    shell = "excite() { " + f'"{sys.executable}" -m excite "$@"; ' + "}\nset -eu\n"
    fewer = {"runs = 5": "runs = 1", "runs=3": "runs=1", "--budget 60": "--budget 30"}
    for language, text in blocks(ROOT / "docs" / "tutorial.md"):
        for written in [w for w in fewer if w in text]:
            text = text.replace(written, fewer.pop(written))
        if language == "python":
            exec(compile(text, "tutorial.md", "exec"), names)
        else:
            subprocess.run(["bash", "-c", shell + text], check=True, env=ENVIRONMENT, timeout=1800)
    assert not fewer
    files = "design/report.html cab/sheet.pdf cab/driver.html checked/log.png found/report.html my_logger.toml"
    for written in (
        *files.split(),
        "along_log/prediction.csv",
        "along_drive/prediction.png",
        "diagnosed/report.html",
        "two/runs.parquet",
    ):
        assert (tmp_path / written).is_file()


@pytest.mark.slow
def test_readme_lines_of_python_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (text,) = [text for language, text in blocks(ROOT / "README.md") if language == "python"]
    assert len([line for line in text.splitlines() if line and not line.startswith(("from", "import"))]) <= 5
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    text = text.replace("starts=2", "starts=1, duration=15")
    exec(compile(text, "README.md", "exec"), names)
    assert len(names["estimate"].names) == 22


def test_every_public_function_has_an_example() -> None:
    """A section of its own in docs/python.md, whose code calls it."""
    _, *sections = (ROOT / "docs" / "python.md").read_text(encoding="utf-8").split("\n## ")
    codes = {text.partition("\n")[0]: "".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)) for text in sections}
    functions = [name for name in interface.__all__ if name != "__version__"]
    for name in functions:
        assert f"excite.{name}(" in codes[name]
        compile(codes[name], "python.md", "exec")
    assert set(codes) - {*functions} == {"Results", "Errors"}


@pytest.mark.parametrize("name", [name for name in interface.__all__ if name != "__version__"])
def test_a_docstring_names_every_argument(name: str) -> None:
    """And says what comes back, what is raised, and how the function is called."""
    function = getattr(interface, name)
    text = inspect.cleandoc(function.__doc__)
    parts = re.split(r"^(Parameters|Returns|Raises|Example):\n", text, flags=re.MULTILINE)
    assert parts[1::2] == ["Parameters", "Returns", "Raises", "Example"]
    told = ", ".join(re.findall(r"^    (\S[^:]*): ", parts[2], re.MULTILINE))
    assert sorted(told.split(", ")) == sorted(inspect.signature(function).parameters)
    assert f"excite.{name}(" in parts[8]


@pytest.mark.slow
def test_examples_of_docstrings_run() -> None:
    names = {"excite": interface, "np": np, "pd": pd}
    for name in interface.__all__:
        for one in doctest.DocTestFinder().find(getattr(interface, name), name, globs=names):
            assert doctest.DocTestRunner().run(one).failed == 0, name


@pytest.mark.slow
def test_examples_in_python_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their output differs from the page in numbers at most."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    printed, shown = "", 0
    for language, text in blocks(ROOT / "docs" / "python.md"):
        if language == "python":
            exec(compile(text, "python.md", "exec"), names)
            printed = capsys.readouterr().out
        else:
            words, said = (re.findall(r"[^\W\d_]{3,}", x) for x in (text, printed))
            assert (language, words) == ("text", said)
            shown += 1
    assert shown
    assert {f.name for f in tmp_path.iterdir()} == {"design", "sines.png", "log.csv", "misfit.png", "diagnosed"}
    assert (tmp_path / "diagnosed" / "machine.toml").is_file()
    assert len(names["estimate"].names) == 11


def test_every_effect_is_in_its_page() -> None:
    page = reference.effects_page()
    for name, effect in catalogue.CATALOGUE.items():
        section = page.split(f"## {name}\n")[1].split("\n## ")[0]
        assert " ".join(effect.source.split())[1:40] in " ".join(section.split())
        for shape in effect.shapes:
            assert f"| {shape} |" in section
    assert "`stribeck_friction@front_roll=" in page


def test_reference_pages_hold_what_the_code_has(excite: Excite, tmp_path: Path) -> None:
    code, stdout, _ = excite("docs", "--out", tmp_path / "d", "--json")
    assert code == 0
    assert json.loads(stdout)["pages"] == [reference_html.NAME, "commands.md", *reference.PAGES]
    read = {name: (tmp_path / "d" / name).read_text() for name in ("commands.md", *reference.PAGES)}
    assert (tmp_path / "d" / reference_html.NAME).read_text() == reference_html.page(read)
    assert "### excite.load" in read["python.md"]
    assert "### excite.identification.identify" in read["python.md"]
    assert not re.search(r"0x[0-9a-f]{6}", "".join(read.values()))  # the same code gives the same bytes
    for unit in units.UNITS:
        assert f"| {unit} |" in read["machine-file.md"]
    assert "| `--phases` |" in read["commands.md"]
    assert "| `--seed` | 0 |" in read["commands.md"]
    for noise in ("Annotated", "FieldInfo", "typing.", "<class", "Validator"):
        assert noise not in read["machine-file.md"] + read["study-file.md"] + read["choices.md"]
    assert "| pin | [Pin](#pin) | - |" in read["machine-file.md"]
    assert '| antecedent | whole number or "ground" | needed |' in read["machine-file.md"]


def test_every_place_of_an_effect_is_explained() -> None:
    assert {p for e in catalogue.CATALOGUE.values() for p in e.places} == set(reference.PLACES)


def test_the_handbook_is_whole() -> None:
    """Every heading of every page, links that lead somewhere, and nothing left as it was written."""
    pages = {"commands.md": reference.commands_page(app)}
    pages |= {name: page() for name, page in reference.PAGES.items() if name != "python.md"}
    text = reference_html.page(
        pages | {"python.md": "# Python\n\n## m\n\n```python\ndef f(x: a < b)\n```\n\n*x* | y <i>\n"}
    )
    anchors = re.findall(r'<h[123] id="([^"]+)"', text)
    assert len(set(anchors)) == len(anchors) == 2 + sum(len(re.findall("^#+ ", p, re.M)) for p in pages.values())
    assert set(re.findall(r'href="#([^"]+)"', text)) <= set(anchors)
    assert {"effects-pump_coupling", "commands-excite-log-check", "machine-file-units"} <= set(anchors)
    assert "<pre>def f(x: a &lt; b)</pre>" in text
    assert "<p>*x* | y &lt;i&gt;</p>" in text
    shown = re.sub("<pre>.*?</pre>", "", text.partition("<main>")[2], flags=re.DOTALL)
    assert not re.search(r"^\||```|^#|`", shown, re.MULTILINE)


def test_public_functions_have_docstrings() -> None:
    """A page of bare names helps nobody: all but a few have a text."""
    page = reference.python_page()
    entries = re.findall(r"^### ([\w.]+)\n\n```python\n.*?^```\n\n(.*?)\n", page, re.MULTILINE | re.DOTALL)
    bare = [name for name, text in entries if not text.strip()]
    assert len(entries) > 200
    assert len(bare) < 0.12 * len(entries), bare


def test_every_command_has_an_example() -> None:
    """In its help, and the example names the command itself."""
    for name, command in reference._commands(typer.main.get_command(app), "excite"):
        assert f"Example: {name} " in (command.help or ""), name


def test_the_help_of_studies_lists_every_key_and_its_names(excite: Excite) -> None:
    text = " ".join(excite("study", "--help")[1].split())
    for record in (workflows.Study, workflows.Study.model_fields["grid"].annotation.__args__[0]):  # type: ignore[union-attr]
        assert all(f" {key} " in text for key in record.model_fields)
    assert all(name in text for name in trajectories.OBJECTIVES)


def test_every_command_has_json() -> None:
    for name, command in reference._commands(typer.main.get_command(app), "excite"):
        assert "--json" in [o for p in command.params for o in p.opts], name


def test_shell_completes_commands_and_machines() -> None:
    def complete(words: str) -> list[str]:
        count = len(words.split()) - (not words.endswith(" "))
        asked = {"_EXCITE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(count)}
        code = "import sys; sys.argv = ['excite']; from excite.__main__ import main; main()"
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env={**ENVIRONMENT, **asked}, check=False
        )
        return run.stdout.split()

    assert complete("excite ver") == ["verify"]
    assert complete("excite design va12") == ["va12", "va12_straight"]


@pytest.mark.slow
def test_progress_does_not_spoil_what_is_piped(tmp_path: Path) -> None:
    """stderr on a terminal, stdout in a pipe: a bar there, pure JSON here."""
    design = ROOT / "results" / "S40" / "design"
    command = [sys.executable, "-m", "excite", "drive", str(design), "--phases", "4", "--json", "--out"]
    command.append(str(tmp_path / "a"))
    master, slave = pty.openpty()
    shown: list[bytes] = []

    def drain() -> None:  # a terminal that nobody reads would stop who writes to it
        with contextlib.suppress(OSError):
            while piece := os.read(master, 4096):
                shown.append(piece)

    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave, env={**ENVIRONMENT, "TERM": "xterm"}) as run:
        os.close(slave)
        reader = threading.Thread(target=drain, daemon=True)
        reader.start()
        stdout, _ = run.communicate(timeout=600)
        reader.join(5)
    os.close(master)
    assert run.returncode == 0
    assert json.loads(stdout)["machine"] == "va12_straight"
    assert b"driving" in b"".join(shown)


def test_piped_output_has_no_control_characters(excite: Excite, tmp_path: Path) -> None:
    code, stdout, stderr = excite("machines")
    assert code == 0
    assert "\x1b" not in stdout + stderr


def test_theory_names_things_that_exist() -> None:
    """Every dotted name and every file in docs/theory.md."""
    text = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
    names = re.findall(r"`(excite(?:\.\w+)+)`", text)
    assert len(names) > 8
    for name in names:
        module, _, last = name.rpartition(".")
        try:
            importlib.import_module(name)
        except ModuleNotFoundError:
            assert hasattr(importlib.import_module(module), last), name
    for path in re.findall(r"`((?:tests|model|results)/[\w./]+)`", text):
        assert (ROOT / path).exists(), path

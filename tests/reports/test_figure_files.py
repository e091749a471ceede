"""Figures are written in the formats and at the width in print that are asked for, with letters that can be read."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
import typer
from matplotlib.figure import Figure
from support.commands import Excite

import excite as package
from excite.cli import app, options
from excite.errors import UsageError
from excite.reports import FigureFiles, read_formats, read_width, save, sigma_figure, writing_figures

PT_PER_MM = 72 / 25.4


def figure() -> Figure:
    return sigma_figure({f"Kx{k}": v for k, v in enumerate(np.geomspace(0.01, 10, 6))}, "A title " * 6)


def svg_width_mm(path: Path) -> float:
    found = re.search(r'<svg [^>]*?\bwidth="([\d.]+)pt"', path.read_text(encoding="utf-8"))
    assert found
    return float(found[1]) / PT_PER_MM


def pdf_width_mm(path: Path) -> float:
    found = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ", path.read_bytes())
    assert found
    return float(found[1]) / PT_PER_MM


@pytest.mark.parametrize("width_mm", [88.0, 180.0, 300.0])
def test_files_have_the_stated_width(tmp_path: Path, width_mm: float) -> None:
    with writing_figures(FigureFiles(("png", "svg", "pdf"), width_mm)):
        save(figure(), tmp_path / "sigma.png")
    assert svg_width_mm(tmp_path / "sigma.svg") == pytest.approx(width_mm, rel=1e-3)
    assert pdf_width_mm(tmp_path / "sigma.pdf") == pytest.approx(width_mm, rel=1e-3)
    pixels = matplotlib.image.imread(tmp_path / "sigma.png").shape[1]
    assert pixels == pytest.approx(width_mm / 25.4 * 300, abs=2)


def test_letters_stay_readable_or_it_is_said(tmp_path: Path) -> None:
    said: list[str] = []
    with writing_figures(FigureFiles(("svg",), 88.0, said.append)):
        save(figure(), tmp_path / "sigma.png")
        assert said == []
        crowded = Figure(figsize=(12, 4))
        crowded.text(0.0, 0.5, "a line that takes almost all of the width of a wide figure " * 2, fontsize=8)
        save(crowded, tmp_path / "crowded.png")
    assert len(said) == 1
    assert said[0].startswith("crowded: letters of ")
    assert "6 pt need" in said[0]


def test_outside_the_block_figures_are_as_they_are(tmp_path: Path) -> None:
    save(figure(), tmp_path / "sigma.png")
    assert [p.name for p in tmp_path.iterdir()] == ["sigma.png"]
    assert matplotlib.image.imread(tmp_path / "sigma.png").shape[1] == 7.5 * 160


@pytest.mark.parametrize("kind", ["svg", "pdf"])
@pytest.mark.parametrize("width_mm", [None, 120.0])
def test_same_figure_gives_same_bytes(tmp_path: Path, kind: str, width_mm: float | None) -> None:
    with writing_figures(FigureFiles(("png", kind), width_mm)):
        for name in ("one", "two"):
            save(figure(), tmp_path / f"{name}.png")
    assert (tmp_path / f"one.{kind}").read_bytes() == (tmp_path / f"two.{kind}").read_bytes()


def test_formats_and_widths_are_read() -> None:
    assert read_formats("--figures", "pdf, .SVG") == ("png", "svg", "pdf")
    assert read_width("--figure-width", "8.8cm") == pytest.approx(88.0)
    assert read_width("--figure-width", "88 mm") == pytest.approx(88.0)
    with pytest.raises(UsageError, match="with its unit"):
        read_width("figure_width", 88)  # type: ignore[arg-type]
    for wrong, why in (("88", "with its unit, such as 88mm or 8.8cm"), ("5mm", "60 to 420 mm"), ("3in", "unit")):
        with pytest.raises(UsageError, match=why):
            read_width("--figure-width", wrong)
    with pytest.raises(UsageError, match="--figures: jpg is unknown, allowed: png, svg, pdf"):
        read_formats("--figures", "png,jpg")


def commands(command: Any, name: str = "") -> dict[str, Any]:
    if not hasattr(command, "commands"):
        return {name.strip(): command}
    return {k: v for key, inner in command.commands.items() for k, v in commands(inner, f"{name} {key}").items()}


def test_every_command_that_draws_takes_the_options() -> None:
    found = {name for name, c in commands(typer.main.get_command(app)).items() if isinstance(c, options.DrawingCommand)}
    without = {*"machines drive simulate handover app docs".split(), "log convert"}
    without |= {f"machine {name}" for name in ("new", "around", "urdf", "model")}
    assert found == set(commands(typer.main.get_command(app))) - without


def test_a_command_writes_the_formats(excite: Excite, tmp_path: Path) -> None:
    out = tmp_path / "checked"
    machine = tmp_path / "rig.toml"
    assert excite("machine", "new", "rig", "--from", "va12_straight", "--out", machine)[0] == 0
    command = ("machine", "check", machine, "--out", out)
    code, _, error = excite(*command, "--figures", "svg,pdf", "--figure-width", "8.8cm")
    assert (code, error) == (0, "")
    assert {p.name for p in out.glob("machine.*")} == {"machine.png", "machine.svg", "machine.pdf"}
    assert svg_width_mm(out / "machine.svg") == pytest.approx(88.0, rel=1e-3)
    assert excite(*command)[0] == 0  # a folder with such files is replaced
    assert not (out / "machine.svg").exists()
    code, _, error = excite(*command, "--figure-width", "88")
    assert code == 2
    assert "such as 88mm or 8.8cm" in error


def test_python_writes_them_too(tmp_path: Path) -> None:
    log = package.simulate("emps", 20.0 * np.sin(np.arange(3000) / 100.0)[:, None], seed=1)
    read = package.read_log("emps", log)
    out = read.save(tmp_path / "log", figures="pdf", figure_width="120mm")
    assert pdf_width_mm(out / "log.pdf") == pytest.approx(120, rel=1e-3)
    read.plot(file=tmp_path / "own.svg", figure_width="12cm")
    assert svg_width_mm(tmp_path / "own.svg") == pytest.approx(120, rel=1e-3)
    with pytest.raises(UsageError, match="file: jpg is unknown"):
        read.plot(file=tmp_path / "own.jpg")
    with pytest.raises(UsageError, match="figure_width"):
        read.plot(figure_width="12cm")

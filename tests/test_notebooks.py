"""The notebooks of the documentation run as they stand, show what they promise, and are kept without outputs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))
HANGS_S = 1200  # after which a cell has come to a stop; a notebook takes 30 s on two quiet cores
SAYS = {
    "test_day": ("11 parameters are identified", "torque deadband (rear roll)", "intervals hold the truth"),
    "compare_designs": ("worst parameter [%]", "Score of the drive"),
}


def test_there_are_notebooks() -> None:
    assert {path.stem for path in NOTEBOOKS} == set(SAYS)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert [c for c in cells if c.get("outputs") or c.get("execution_count")] == []


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason="nbclient is in the extra `test`")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook: Any = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=HANGS_S, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [out for cell in notebook.cells if cell.cell_type == "code" for out in cell.outputs]
    said = "".join(str(out.get("data", {}).get("text/plain", "")) + str(out.get("text", "")) for out in shown)
    for words in SAYS[path.stem]:
        assert words in said
    assert sum("image/png" in out.get("data", {}) for out in shown) >= 2
    assert sum("text/html" in out.get("data", {}) for out in shown) >= 2
    assert [out for out in shown if out.output_type == "error"] == []

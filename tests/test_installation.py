"""The README's Python example beside a user's own model.py, from an editable install and from a wheel."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run_readme_example(place: Path, library: Path | None) -> str:
    """Run the example, shortened, in a folder with a model.py of its own; return the folder excite was loaded from."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (example,) = (code for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "import excite" in code)
    example = example.replace('"va12"', '"va12_straight"').replace("starts=2", "starts=1, duration=8")
    (place / "model.py").write_text("raise SystemExit('excite imported model.py of the user')\n")
    (place / "script.py").write_text(f"{example}\nprint(len(estimate.names))\nprint(excite.__file__)\n")
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    if library is not None:
        env["PYTHONPATH"] = str(library)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=place, env=env, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr
    count, file = done.stdout.split()
    assert count == "11"
    return str(Path(file).parents[1])


@pytest.mark.slow
def test_example_runs_beside_an_own_model_py(tmp_path: Path) -> None:
    run_readme_example(tmp_path, None)


@pytest.mark.slow
def test_example_runs_from_a_wheel(tmp_path: Path) -> None:
    library, place, source = tmp_path / "library", tmp_path / "place", tmp_path / "source"
    place.mkdir()
    for package in ("excite", "model"):
        shutil.copytree(ROOT / package, source / package, symlinks=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(library), str(source)]
    subprocess.run(pip, check=True, capture_output=True)
    assert run_readme_example(place, library) == str(library)
    assert (library / "excite" / "model" / "machines" / "va12.toml").is_file()

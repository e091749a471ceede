"""Make pages of the site that are kept elsewhere: front page, changes, notebooks, and the reference from the code."""

from __future__ import annotations

import json
import re
import tempfile
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

from excite.cli import app, reference

ROOT = Path(__file__).parents[1]
OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)*(?:results|CITATION)[^)]*\)")  # links to files that are no pages


def on_files(files: Files, config: Any) -> Files:
    """Add generated pages to the files in docs/."""
    with tempfile.TemporaryDirectory() as place:
        names = [name for name in reference.write(Path(place), app) if name.endswith(".md")]
        made = {f"reference/{name}": Path(place, name).read_text(encoding="utf-8") for name in names}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    made["index.md"] = readme.replace("](docs/", "](").replace("](CHANGELOG.md)", "](changelog.md)")
    made["changelog.md"] = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](")
    for notebook in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        made[f"notebooks/{notebook.stem}.md"] = notebook_page(notebook)
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    for picture in re.findall(r"!\[[^\]]*\]\((results/[^)]+)\)", readme):
        files.append(File.generated(config, picture, abs_src_path=str(ROOT / picture)))
    section = next(part["Reference"] for part in config.nav if isinstance(part, dict) and "Reference" in part)
    section[:] = [f"reference/{name}" for name in sorted(names)]
    return files


def notebook_page(notebook: Path) -> str:
    """Return a notebook as a page: its words, and its code without what it prints."""
    parts = []
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
    parts.append(f"This page is [a notebook to run]({notebook.name}).")
    page = "\n\n".join(parts) + "\n"
    return re.sub(rf"\]\((?!{notebook.stem}\.)(\w+)\.ipynb\)", r"](\1.md)", page)


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Keep the words of links that lead out of the documentation, but for pictures."""
    return re.sub(rf"(?<!!){OUTSIDE.pattern}", r"\1", markdown)

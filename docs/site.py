"""Make pages of the site that are kept elsewhere: front page, changes, notebooks, and the reference from the code.

Notebooks are shown as they run, formulas as MathML: a page needs neither a network nor a script.
"""

from __future__ import annotations

import hashlib
import html
import json
import re
import tempfile
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

from excite.cli import app, reference

ROOT = Path(__file__).parents[1]
OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)*(?:results|CITATION)[^)]*\)")  # links to files that are no pages

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


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


def executed(notebook: Path) -> Any:
    """Return the content of a notebook with what it prints and draws; kept in .cache/ until it or the program changes.

    Without nbclient (extra `test`) it has no outputs.
    """
    source = notebook.read_text(encoding="utf-8")
    try:
        import nbclient
        import nbformat
    except ImportError:
        return json.loads(source)
    program = [p.read_bytes() for p in sorted((ROOT / "excite").rglob("*.py"))]
    key = hashlib.sha256(b"".join([source.encode(), *program])).hexdigest()[:16]
    kept = ROOT / ".cache" / "notebooks" / f"{notebook.stem}-{key}.ipynb"
    if not kept.is_file():
        content = nbformat.reads(source, as_version=4)
        with tempfile.TemporaryDirectory() as place:
            nbclient.NotebookClient(content, timeout=600, resources={"metadata": {"path": place}}).execute()
        kept.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(content, kept)
    return json.loads(kept.read_text(encoding="utf-8"))


def output_text(output: dict[str, Any]) -> str:
    """Return what a cell shows, as a part of a page: a table, a picture, or text."""
    shown = output.get("data", {})
    if "image/png" in shown:
        return f'<img alt="figure" src="data:image/png;base64,{shown["image/png"].strip()}">'
    if "text/html" in shown:
        return "<div>" + re.sub(r"\n\s*\n", "\n", "".join(shown["text/html"])) + "</div>"
    text = "".join(shown.get("text/plain", output.get("text", "")))
    return f"```text\n{text.rstrip()}\n```" if text.strip() else ""


def notebook_page(notebook: Path) -> str:
    """Return a notebook as a page: its words, its code, and what that shows."""
    parts = []
    for cell in executed(notebook)["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
        parts += [text for output in cell.get("outputs", []) if (text := output_text(output))]
    parts.append(f"This page is [a notebook to run]({notebook.name}).")
    page = "\n\n".join(parts) + "\n"
    return re.sub(rf"\]\((?!{notebook.stem}\.)(\w+)\.ipynb\)", r"](\1.md)", page)


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Keep the words of links that lead out of the documentation, but for pictures."""
    return re.sub(rf"(?<!!){OUTSIDE.pattern}", r"\1", markdown)


def on_page_content(content: str, **kwargs: Any) -> str:
    """Write formulas as MathML, which browsers show by themselves."""
    return FORMULA.sub(
        lambda found: convert(html.unescape(found[2]), display="block" if found[1] == "div" else "inline"), content
    )

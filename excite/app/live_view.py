"""A machine from above while its file is written: the drawing of a text that may not be right yet."""

from __future__ import annotations

import base64
import io
import tempfile
from pathlib import Path

from excite import reports
from excite.errors import MachineError
from excite.model.machine import load_machine

DPI = 80  # of the drawing; chosen


def draw_text(text: str, path: Path) -> tuple[str, str]:
    """Return the drawing of a machine file's text as a data URL, and what is wrong with the text; "" for none of each.

    path: of the file, beside which other files that the text extends are looked for.
    """
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", dir=path.parent, prefix=".", suffix=".toml") as draft:
        draft.write(text)
        draft.flush()
        try:
            machine = load_machine(draft.name)
        except MachineError as err:
            return "", str(err).replace(draft.name, path.name).replace(Path(draft.name).name, path.name)
    if not machine.planar:
        return "", ""
    picture = io.BytesIO()
    reports.top_view_figure(machine).savefig(picture, format="png", dpi=DPI)
    return f"data:image/png;base64,{base64.b64encode(picture.getvalue()).decode('ascii')}", ""

"""Readers of log files, one module for each library: each makes a table of columns, whatever the format."""

from __future__ import annotations

import importlib

from excite.logs.files.common import Reader, guarded
from excite.logs.formats import FORMATS

__all__ = ["reader_of"]


def reader_of(suffix: str) -> Reader | None:
    """Return the reader of files with an ending, None where no format has it."""
    form = next((f for f in FORMATS if suffix.lower() in f.suffixes), None)
    if form is None:
        return None
    module, name = form.reader.split(".")
    return guarded(getattr(importlib.import_module(f"{__name__}.{module}"), name), form.kind, form.extra)

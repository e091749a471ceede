"""Files of figures: their formats, and a stated width in print with letters that stay readable.

A command or `save` sets the files once (`writing_figures`), for every figure that is drawn inside. A figure asks
`layout_width` how wide it is to be drawn: so it is laid out for its width in print, and then scaled as a whole.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends import backend_mixed, backend_pdf
from matplotlib.figure import Figure
from matplotlib.text import Text

from excite.errors import UsageError
from excite.text import format_number

FORMATS = ("png", "svg", "pdf")
MM_PER_INCH = 25.4  # definition
UNITS_MM = {"mm": 1.0, "cm": 10.0}
WIDTH = re.compile(r"(\d+(?:\.\d*)?)\s*(mm|cm)")
MIN_WIDTH_MM, MAX_WIDTH_MM = 60.0, 420.0  # narrower than a column of any paper; long side of A3
MAX_HEIGHT_MM = 240.0  # of a figure in print: the text of an A4 page
SCREEN_DPI, PRINT_DPI = 160, 300  # of a PNG without and with a stated width; chosen
MIN_LETTERS_PT = 6.0  # smallest letters that journals print; chosen from guides that ask for 5 to 8 pt
SMALLEST_PT = 8.0  # smallest letters of a figure on the screen, which are scaled to MIN_LETTERS_PT in print
LEAST_SAID = 0.98  # share of MIN_LETTERS_PT below which a figure's letters are said to be small; chosen
TITLE_LETTER = 0.58  # width of a letter of the title as a share of its size, on average
POINTS_PER_INCH = 72  # pt/in, definition
# without dates and random names: the same data give the same bytes
METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}


@dataclass(frozen=True)
class FigureFiles:
    """Formats of the figures that are written, and their width in print [mm]; None for each figure's own width.

    The PNG is always written: reports and the window show it. tell: takes a line on a figure whose letters can't be as
    large as `MIN_LETTERS_PT` at that width.
    """

    formats: tuple[str, ...] = ("png",)
    width_mm: float | None = None
    tell: Callable[[str], None] = lambda line: None


_files: ContextVar[FigureFiles | None] = ContextVar("figure files", default=None)


def read_formats(option: str, given: str | Sequence[str]) -> tuple[str, ...]:
    """Return the formats of figures, PNG first. given: names, or a text with commas. Raises UsageError."""
    names = given.split(",") if isinstance(given, str) else list(given)
    cleaned = [name.strip().lower().removeprefix(".") for name in names]
    for name in cleaned:
        if name not in FORMATS:
            raise UsageError(f"{option}: {name or 'an empty name'} is unknown, allowed: {', '.join(FORMATS)}")
    return tuple(name for name in FORMATS if name == "png" or name in cleaned)


def read_width(option: str, given: str) -> float:
    """Return a width [mm] from a number with its unit, such as 88mm or 8.8cm. Raises UsageError."""
    found = WIDTH.fullmatch(str(given).strip().lower())  # a number without a unit, too
    if found is None:
        raise UsageError(f"{option}: must be a number with its unit, such as 88mm or 8.8cm (got {given})")
    width = float(found[1]) * UNITS_MM[found[2]]
    if not MIN_WIDTH_MM <= width <= MAX_WIDTH_MM:
        raise UsageError(f"{option}: must be {MIN_WIDTH_MM:g} to {MAX_WIDTH_MM:g} mm (got {width:g} mm)")
    return width


@contextmanager
def writing_figures(files: FigureFiles) -> Iterator[None]:
    """Write every figure that is saved inside the block into these files."""
    before = _files.set(files)
    try:
        yield
    finally:
        _files.reset(before)


def layout_width(own: float) -> float:
    """Return the width [in] at which a figure is drawn: its own on the screen, otherwise what its width in print asks.

    Letters of SMALLEST_PT at that width are MIN_LETTERS_PT in print.
    """
    width_mm = (_files.get() or FigureFiles()).width_mm
    return own if width_mm is None else width_mm / MM_PER_INCH * SMALLEST_PT / MIN_LETTERS_PT


def layout_height(own: float, least: float = 0.0) -> float:
    """Return the height [in] at which a figure is drawn: its own on the screen, in print at most that of a page.

    least [in]: that its texts need.
    """
    page = MAX_HEIGHT_MM / MM_PER_INCH * SMALLEST_PT / MIN_LETTERS_PT
    return own if (_files.get() or FigureFiles()).width_mm is None else min(own, max(page, least))


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG at `path` and in the other formats beside it, as `writing_figures` states."""
    files = _files.get() or FigureFiles()
    for kind in files.formats:
        write_file(figure, path.with_suffix(f".{kind}"), _print_scale(figure, path.stem))


def write_alone(figure: Figure, path: Path) -> None:
    """Write a figure into a file (.png, .svg, .pdf), at the width that `writing_figures` states. Raises UsageError."""
    read_formats("file", [path.suffix])
    write_file(figure, path, _print_scale(figure, path.stem))


def write_file(figure: Figure, path: Path, scale: float | None = None) -> None:
    """Write a figure into a file (.png, .svg, .pdf), scaled as a whole for print; None for the screen."""
    kind = path.suffix.lower().removeprefix(".")
    if kind == "pdf":
        _write_pdf(figure, path, scale or 1.0)
    elif kind == "svg":
        with mpl.rc_context({"svg.hashsalt": "excite"}):
            figure.savefig(path, metadata=METADATA["svg"])
        _scale_svg(path, figure, scale or 1.0)
    elif scale is None:
        figure.savefig(path, dpi=SCREEN_DPI, metadata=METADATA["png"])
    else:
        density = {"dpi": (PRINT_DPI, PRINT_DPI)}
        figure.savefig(path, dpi=PRINT_DPI * scale, metadata=METADATA["png"], pil_kwargs=density)


def wrap_title(figure: Figure, text: str, size: float) -> str:
    """Return a title in as many lines as the width of the figure asks for. size [pt]."""
    letters = int(figure.get_figwidth() * POINTS_PER_INCH / (TITLE_LETTER * size))
    return "\n".join(textwrap.wrap(text, letters))


def _print_scale(figure: Figure, name: str) -> float | None:
    """Return the scale that gives a figure its width in print, None without a stated one.

    Tells of a figure whose smallest letters are below `MIN_LETTERS_PT`; name: what it is called then.
    """
    files = _files.get() or FigureFiles()
    if files.width_mm is None:
        return None
    scale = files.width_mm / MM_PER_INCH / float(figure.get_figwidth())
    letters = smallest_letters(figure) * scale
    if letters < LEAST_SAID * MIN_LETTERS_PT:
        enough = files.width_mm * MIN_LETTERS_PT / letters
        files.tell(
            f"{name}: letters of {format_number(letters, 2)} pt at {files.width_mm:g} mm; {MIN_LETTERS_PT:g} pt need"
            f" {enough:.0f} mm"
        )
    return scale


def smallest_letters(figure: Figure) -> float:
    """Return the size [pt] of the smallest visible letters of a figure; SMALLEST_PT without any."""
    texts = [t for t in figure.findobj(Text) if isinstance(t, Text) and t.get_visible() and t.get_text().strip()]
    return min((float(t.get_fontsize()) for t in texts), default=SMALLEST_PT)


def _scale_svg(path: Path, figure: Figure, scale: float) -> None:
    """Scale an SVG as a whole: its stated size changes, its coordinates don't."""
    width, height = (POINTS_PER_INCH * scale * float(x) for x in figure.get_size_inches())
    text = path.read_text(encoding="utf-8")
    head, rest = text.split("<svg ", 1)
    tag, rest = rest.split(">", 1)
    for name, value in (("width", width), ("height", height)):
        tag = re.sub(rf'\b{name}="[\d.]+pt"', f'{name}="{value:.6g}pt"', tag)
    path.write_text(f"{head}<svg {tag}>{rest}", encoding="utf-8")


def _write_pdf(figure: Figure, path: Path, scale: float) -> None:
    """Write a PDF scaled as a whole; matplotlib has no scale of its own."""
    if scale == 1.0:
        figure.savefig(path, metadata=METADATA["pdf"])
        return
    pdf: Any = backend_pdf  # it has no types
    mixed: Any = backend_mixed
    pdf.FigureCanvasPdf(figure)
    dpi = figure.dpi
    figure.dpi = POINTS_PER_INCH  # a PDF's coordinates
    width, height = (float(x) for x in figure.get_size_inches())
    file = pdf.PdfFile(path, metadata=METADATA["pdf"])
    try:
        file.newPage(width * scale, height * scale)
        file.width, file.height = width, height  # paths are clipped to it before they are scaled
        file.output(scale, 0, 0, scale, 0, 0, pdf.Op.concat_matrix)
        inner = pdf.RendererPdf(file, PRINT_DPI, height, width)
        renderer = mixed.MixedModeRenderer(figure, width, height, PRINT_DPI, inner)
        figure.draw(renderer)
        renderer.finalize()
        file.finalize()
    finally:
        file.close()
        figure.dpi = dpi

"""Descriptions as text: on the terminal, in a pipe, and as the `repr` of a result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from excite.reports.description import Description, Table, as_sentence
from excite.text import count

# Rich is imported inside, so that --help is there at once.
if TYPE_CHECKING:
    from rich.console import Console

MAX_ROWS = 40  # of a table; chosen
MIN_WORD_WIDTH = 4  # of a column of words on a narrow terminal; chosen
PIPE_WIDTH = 200  # columns of a line in a pipe or file, which has no width; chosen


def text_parts(description: Description, console: Console, whole: str) -> Iterator[object]:
    """Yield the lines and tables of a description: title, headline, tables, remarks, verdict.

    whole: where a table is that is left out or cut here.
    """
    yield f"{description.title}\n{as_sentence(description.headline)}"
    for one in description.tables:
        if one.grey and description.status == "invalid":
            yield f"\n{one.caption} See {whole}."
            continue
        yield f"\n{one.caption}"
        yield _fitted_table(one, console)
        if len(one.rows) > MAX_ROWS:
            yield f"... and {count(len(one.rows) - MAX_ROWS, 'row')} more, see {whole}"
    for remark in description.remarks:
        yield f"- {as_sentence(remark)}"
    if description.verdict:
        yield description.closing[-1]


def render(description: Description) -> str:
    """Return a description as plain text, as wide as the terminal."""
    from rich.console import Console

    here = Console()
    console = Console(
        highlight=False,
        markup=False,
        no_color=True,
        color_system=None,
        width=here.width if here.is_terminal else PIPE_WIDTH,
        force_terminal=here.is_terminal,
        force_jupyter=False,
    )
    with console.capture() as taken:
        for one in text_parts(description, console, "report.html after save(folder)"):
            console.print(one, soft_wrap=not here.is_terminal)
    return "\n".join(line.rstrip() for line in taken.get().splitlines())


def text_table(*names: str, words: tuple[int, ...] = (0,)) -> Any:
    """Return an empty table with these columns; `words` (indices) are aligned left and may wrap."""
    from rich import box
    from rich.table import Table

    made = Table(box=box.SIMPLE_HEAD)
    for k, name in enumerate(names):
        made.add_column(
            name,
            justify="left" if k in words else "right",
            no_wrap=k not in words,
            min_width=MIN_WORD_WIDTH if k in words else None,
        )
    return made


def _fitted_table(described: Table, console: Console) -> Any:
    """Return a table for the terminal; a narrow one gets stacked headings and no optional columns."""
    every = tuple(range(len(described.columns)))
    needed = tuple(k for k in every if k not in described.optional)
    made = _rich_table(described, every, stacked=False)
    if not console.is_terminal:
        return made
    for columns, stacked in ((every, False), (every, True), (needed, False), (needed, True)):
        made = _rich_table(described, columns, stacked)
        if console.measure(made, options=console.options.update(max_width=PIPE_WIDTH)).maximum <= console.width:
            break
    return made


def _rich_table(described: Table, columns: tuple[int, ...], stacked: bool) -> Any:
    words = tuple(place for place, k in enumerate(columns) if k in described.text_columns)
    names = [described.columns[k].replace(" ", "\n") if stacked else described.columns[k] for k in columns]
    made = text_table(*names, words=words)
    for k, row in enumerate(described.rows[:MAX_ROWS]):
        made.add_row(*(row[i] for i in columns), style="bold" if k in described.marked else None)
    return made

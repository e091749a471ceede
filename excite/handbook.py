"""The reference pages as one file that opens in a browser, without a network.

Of Markdown it reads what the pages are written in: headings, paragraphs, tables, code, `names` and links.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from markupsafe import Markup, escape

from excite.page import templates

NAME = "index.html"
MARKS = re.compile(r"`([^`]+)`|\[([^\]]+)\]\(#([^)]+)\)")
BAR = re.compile(r"(?<!\\)\|")


@dataclass(frozen=True)
class Part:
    """A heading of level 1, 2 or 3 and what stands below it, up to the next."""

    level: int
    title: str
    anchor: str
    body: Markup


def page(texts: Mapping[str, str]) -> str:
    """Pages by name (`commands.md`) -> Markdown, as one page with its list of contents."""
    parts = [part for name, text in texts.items() for part in parts_of(name.removesuffix(".md"), text)]
    return templates().get_template("handbook.html").render(parts=parts)


def parts_of(name: str, text: str) -> Iterator[Part]:
    """A page's headings with what is below; anchors begin with the page's name, so that pages don't clash."""
    title, level, lines, fenced = "", 0, list[str](), False
    for line in [*text.splitlines(), "# "]:
        fenced ^= line.startswith("```")
        head = None if fenced else re.match(r"(#{1,3}) (.*)", line)
        if head is None:
            lines.append(line)
            continue
        if level:
            anchor = name if level == 1 else f"{name}-{title.lower() if level < 3 else title}"
            yield Part(level, title, anchor.replace(" ", "-"), Markup("\n").join(_blocks(name, lines)))
        level, title, lines = len(head[1]), head[2], []


def _blocks(name: str, lines: list[str]) -> Iterator[Markup]:
    """What stands between blank lines: a table, code (fenced or set in by four), a paragraph."""
    k = 0
    while k < len(lines):
        kind, begin = _kind(lines[k]), k
        k = lines.index("```", k + 1) + 1 if kind == "fence" else k + 1
        while k < len(lines) and kind != "fence" and _goes_on(kind, lines[k:]):
            k += 1
        block = lines[begin:k]
        if kind == "table":
            yield _table(name, block)
        elif kind in ("code", "fence"):
            code = block[1:-1] if kind == "fence" else [line[4:] for line in block]
            yield Markup("<pre>{}</pre>").format("\n".join(code))
        elif kind == "text":
            yield Markup("<p>{}</p>").format(_line(name, " ".join(block)))


def _goes_on(kind: str, lines: list[str]) -> bool:
    """Whether the first of the lines left still belongs to a block; blank lines within code do."""
    after = next((_kind(line) for line in lines if line.strip()), "blank")
    return _kind(lines[0]) == kind or (kind == after == "code" and _kind(lines[0]) == "blank")


def _kind(line: str) -> str:
    if not line.strip():
        return "blank"
    for start, kind in (("```", "fence"), ("| ", "table"), ("|-", "table"), ("    ", "code")):
        if line.startswith(start):
            return kind
    return "text"


def _table(name: str, lines: list[str]) -> Markup:
    rows = [[cell.strip().replace("\\|", "|") for cell in BAR.split(line)[1:-1]] for line in lines]

    def row(cells: list[str], tag: str) -> Markup:
        inner = Markup("").join(Markup(f"<{tag}>{{}}</{tag}>").format(_line(name, cell)) for cell in cells)
        return Markup("<tr>{}</tr>").format(inner)

    body = Markup("\n").join(row(cells, "td") for cells in rows[2:])
    return Markup("<table><thead>{}</thead><tbody>{}</tbody></table>").format(row(rows[0], "th"), body)


def _line(name: str, text: str) -> Markup:
    """Text with `names` set off and links within the page."""
    made, at = Markup(""), 0
    for m in MARKS.finditer(text):
        made += escape(text[at : m.start()])
        made += (
            Markup("<code>{}</code>").format(m[1])
            if m[1]
            else Markup('<a href="#{}-{}">{}</a>').format(name, m[3], m[2])
        )
        at = m.end()
    return made + escape(text[at:])

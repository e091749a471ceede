"""The reference pages as one HTML file that needs no network.

It reads the part of Markdown that the pages use: headings, paragraphs, tables, code, `names` and links.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from markdown_it import MarkdownIt
from markdown_it.renderer import RendererHTML
from markdown_it.token import Token
from markupsafe import Markup

from excite.reports import templates

NAME = "index.html"
READ = ("heading", "table", "fence", "code", "backticks", "link")


@dataclass(frozen=True)
class Part:
    """A heading of level 1, 2 or 3 with the text up to the next heading."""

    level: int
    title: str
    anchor: str
    body: Markup


def page(texts: Mapping[str, str]) -> str:
    """Render pages, name (`commands.md`) -> Markdown, as one page with a table of contents."""
    parts = [part for name, text in texts.items() for part in parts_of(name.removesuffix(".md"), text)]
    return templates().get_template("handbook.html").render(title="excite: reference", parts=parts)


def parts_of(name: str, text: str) -> Iterator[Part]:
    """Yield the parts of a page; anchors begin with the page's name, so that pages don't clash."""
    tokens = _reader().parse(text)
    starts = [k for k, token in enumerate(tokens) if token.type == "heading_open"]
    for start, end in zip(starts, [*starts[1:], len(tokens)], strict=True):
        level, title = int(tokens[start].tag[1]), tokens[start + 1].content
        anchor = name if level == 1 else f"{name}-{title.lower() if level < 3 else title}"
        body = tokens[start + 3 : end]  # behind the heading's opening, text and closing
        for token in body:
            _lead(name, token.children or ())
        html = _reader().renderer.render(body, _reader().options, {})
        yield Part(level, title, anchor.replace(" ", "-"), Markup(html.rstrip("\n")))


def _lead(name: str, tokens: Sequence[Token]) -> None:
    """Redirect links within a page to its anchors in the whole."""
    for token in tokens:
        href = str(token.attrGet("href") or "")
        if href.startswith("#"):
            token.attrSet("href", f"#{name}-{href[1:]}")


@lru_cache(maxsize=1)
def _reader() -> MarkdownIt:
    made = MarkdownIt("zero").enable(READ)
    for kind in ("fence", "code_block"):
        made.add_render_rule(kind, _code)
    return made


def _code(self: RendererHTML, tokens: Sequence[Token], at: int, options: Any, env: Any) -> str:
    return str(Markup("<pre>{}</pre>\n").format(tokens[at].content.rstrip("\n")))

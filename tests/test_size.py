"""The size of the program, counted: what was reached is kept, and lowered here as the program shrinks."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOST = {
    "lines": 59_005,
    "named constants": 816,
    "files over 600 lines": 0,
    "functions over 80 lines": 4,
    "functions with more than 8 parameters": 15,
    "functions of complexity over 25": 27,
    "circles of imports": 0,
}
BRANCHES = (ast.If, ast.For, ast.While, ast.IfExp, ast.ExceptHandler, ast.comprehension, ast.Assert)
Function = ast.FunctionDef | ast.AsyncFunctionDef


@lru_cache
def modules() -> dict[str, tuple[str, ast.Module]]:
    """Return text and tree of every module of the program by its name."""
    found = {}
    for top, package in (("excite", ()), ("model", ("excite",))):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = (*package, *path.relative_to(ROOT).with_suffix("").parts)
            if "model" in parts[1:2] and top == "excite":
                continue  # a link to model/
            text = path.read_text(encoding="utf-8")
            found[".".join(parts).removesuffix(".__init__")] = text, ast.parse(text)
    return found


def functions() -> Iterator[tuple[str, Function]]:
    """Yield every function and method with the name of its module."""
    for name, (_, tree) in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, Function):
                yield name, node


def length(f: Function) -> int:
    """Return the number of lines of a function."""
    return (f.end_lineno or f.lineno) - f.lineno + 1


def parameters(f: Function) -> int:
    """Return the number of named parameters of a function."""
    return len(f.args.posonlyargs) + len(f.args.args) + len(f.args.kwonlyargs)


def complexity(f: Function) -> int:
    """Return 1 + branches + further operands of `and` and `or`, as McCabe counts them."""
    nodes = list(ast.walk(f))
    operands = sum(len(n.values) - 1 for n in nodes if isinstance(n, ast.BoolOp))
    return 1 + sum(isinstance(n, BRANCHES) for n in nodes) + operands


def constants(tree: ast.Module) -> Iterator[str]:
    """Yield the names of a module that are numbers."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            value = node.value.operand if isinstance(node.value, ast.UnaryOp) else node.value
            number = isinstance(value, ast.Constant) and type(value.value) in (int, float)
            if number and isinstance(target, ast.Name) and target.id.lstrip("_").isupper():
                yield target.id


def imports() -> dict[str, set[str]]:
    """Return the modules of the program that each module imports, also those for its types alone."""
    known = modules()
    found: dict[str, set[str]] = {name: set() for name in known}
    for name, (_, tree) in known.items():
        for node in ast.walk(tree):
            named: list[str] = []
            if isinstance(node, ast.ImportFrom) and node.module:
                named = [f"{node.module}.{a.name}" for a in node.names]
                named = [n if n in known else node.module for n in named]
            elif isinstance(node, ast.Import):
                named = [a.name for a in node.names]
            found[name] |= set(named) & known.keys() - {name}
    return found


def circles() -> list[str]:
    """Return the modules that import themselves by way of others."""
    edges = imports()

    def behind(start: str) -> set[str]:
        seen: set[str] = set()
        todo = [start]
        while todo:
            new = edges[todo.pop()] - seen
            seen |= new
            todo += new
        return seen

    return [name for name in edges if name in behind(name)]


@lru_cache
def counts() -> dict[str, list[str]]:
    """Return what is counted, the largest first; lines as empty names."""
    whole = {name: text.count("\n") for name, (text, _) in modules().items()}
    every = [(f"{name}.{f.name}", f) for name, f in functions()]
    large = sorted(((n, name) for name, n in whole.items() if n > 600), reverse=True)
    long = sorted(((length(f), name) for name, f in every if length(f) > 80), reverse=True)
    wide = sorted(
        ((parameters(f), name) for name, f in every if parameters(f) > 8 and ".cli." not in name), reverse=True
    )
    tangled = sorted(((complexity(f), name) for name, f in every if complexity(f) > 25), reverse=True)
    return {
        "lines": [""] * sum(whole.values()),
        "named constants": [f"{name}.{c}" for name, (_, tree) in modules().items() for c in constants(tree)],
        "files over 600 lines": [f"{name} ({n})" for n, name in large],
        "functions over 80 lines": [f"{name} ({n})" for n, name in long],
        "functions with more than 8 parameters": [f"{name} ({n})" for n, name in wide],
        "functions of complexity over 25": [f"{name} ({n})" for n, name in tangled],
        "circles of imports": circles(),
    }


@pytest.mark.parametrize("what", MOST)
def test_the_program_does_not_grow(what: str) -> None:
    """`pytest tests/test_size.py -s` shows the counts and the largest of each kind."""
    found = counts()[what]
    print(f"\n{what}: {len(found)} of at most {MOST[what]}; {', '.join(found[:6])}")
    assert len(found) <= MOST[what], found[:40]


def test_counts_are_those_of_a_small_program() -> None:
    tree = ast.parse(
        "A = 1\n_B = -2.0\nC = 'x'\nD = True\ndef f(a, *, b=1):\n    return a if a and b else [x for x in a]\n"
    )
    (f,) = (n for n in ast.walk(tree) if isinstance(n, Function))
    assert list(constants(tree)) == ["A", "_B"]
    assert (length(f), parameters(f), complexity(f)) == (2, 2, 4)

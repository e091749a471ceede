"""Robots as URDF files: ten public ones in numbers, and files that are damaged on purpose."""

from __future__ import annotations

import random
import re
from pathlib import Path

import numpy as np

TABLE = Path(__file__).with_name("robots.txt")
NAMES = tuple(re.findall(r"^robot (\S+)$", TABLE.read_text(), re.MULTILINE))


def urdf(name: str, rounded: bool = True) -> str:
    """Return the URDF of a robot of the table; rounded: with angles as they are published, else multiples of pi/4."""
    text = TABLE.read_text().partition(f"robot {name}\n")[2].partition("\nrobot ")[0]
    lines = [f'<robot name="{name}">']
    for row in (line.split() for line in text.splitlines() if line):
        lines += _link(row, rounded) if row[0] == "link" else _joint(row, rounded)
    return "\n".join([*lines, "</robot>"]) + "\n"


def _origin(xyz: str, rpy: str, rounded: bool) -> str:
    angles = rpy.split(",")
    if not rounded:
        quarter = np.pi / 4
        near = [round(float(a) / quarter) * quarter for a in angles]
        angles = [repr(n) if abs(float(a) - n) < 1e-4 else a for a, n in zip(angles, near, strict=True)]
    return f'<origin xyz="{xyz.replace(",", " ")}" rpy="{" ".join(angles)}"/>'


def _link(row: list[str], rounded: bool) -> list[str]:
    if len(row) == 2:
        return [f'<link name="{row[1]}"/>']
    _, name, mass, xyz, rpy, inertia = row
    axes = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), inertia.split(","), strict=True)
    tensor = " ".join(f'{key}="{value}"' for key, value in axes)
    body = f'<inertial>{_origin(xyz, rpy, rounded)}<mass value="{mass}"/><inertia {tensor}/></inertial>'
    return [f'<link name="{name}">{body}</link>']


def _joint(row: list[str], rounded: bool) -> list[str]:
    _, name, kind, parent, child, xyz, rpy, axis, *more = row
    inside = [f'<parent link="{parent}"/><child link="{child}"/>', _origin(xyz, rpy, rounded)]
    inside.append(f'<axis xyz="{axis.replace(",", " ")}"/>')
    if more:
        low, high, effort, velocity = more[0].split(",")
        inside.append(f'<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{velocity}"/>')
    if len(more) > 1:
        leader, multiplier, offset = more[1].split(",")
        inside.append(f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>')
    return [f'<joint name="{name}" type="{kind}">{"".join(inside)}</joint>']


NUMBERS = ("0", "-1", "1e300", "-1e300", "1e-300", "nan", "inf", "-inf", "", "x", "1,5", "3.1416", "1e9", "٣", "0x10")
WORDS = ("", "world", "base", "joint1", "fixed", "floating", "planar", "prismatic", "continuous", "a" * 5000, "&#10;")


def damaged(seed: int) -> bytes:
    """Return a URDF with one to four damages, of the kinds that hands, exporters and disks make."""
    rng = random.Random(seed)
    text = urdf(rng.choice(NAMES))
    for _ in range(rng.randint(1, 4)):
        text = rng.choice(DAMAGES)(text, rng)
    raw = text.encode()
    if rng.random() < 0.1:
        at = rng.randrange(len(raw) or 1)
        raw = raw[:at] + bytes(rng.randrange(256) for _ in range(rng.randint(1, 40))) + raw[at + 1 :]
    return raw


def _attribute(text: str, rng: random.Random, values: tuple[str, ...], pattern: str) -> str:
    found = list(re.finditer(pattern, text))
    if not found:
        return text
    one = rng.choice(found)
    return text[: one.start(1)] + rng.choice(values) + text[one.end(1) :]


def _number(text: str, rng: random.Random) -> str:
    return _attribute(text, rng, NUMBERS, r'[" ](-?[\d.]+(?:[eE][-+]?\d+)?)[" ]')


def _word(text: str, rng: random.Random) -> str:
    names = tuple(re.findall(r'name="([^"]*)"', text))
    return _attribute(text, rng, WORDS + names, r'(?:name|link|type|joint)="([^"]*)"')


def _vector(text: str, rng: random.Random) -> str:
    return _attribute(text, rng, ("", "0", "0 0 0", "1 2", "0 0 0 0", "a b c"), r'(?:xyz|rpy)="([^"]*)"')


def _line(text: str, rng: random.Random) -> str:
    lines = text.splitlines()
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[at : at + 1] = rng.choice([[], [lines[at]] * 2, [lines[other]]])
    return "\n".join(lines)


def _element(text: str, rng: random.Random) -> str:
    found = list(re.finditer(r"<(\w+)[^<>]*/>", text))
    if not found:
        return text
    one = rng.choice(found)
    return text[: one.start()] + rng.choice(["", one[0] * 2, "<mimic/>", "<inertia/>", "<limit/>"]) + text[one.end() :]


def _cut(text: str, rng: random.Random) -> str:
    at = rng.randrange(len(text) or 1)
    return text[:at] + rng.choice(["", text[at + rng.randint(1, 300) :], "</robot>", "<!--", "&x;", "<a:b/>"])


def _doctype(text: str, rng: random.Random) -> str:
    entities = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 9))
    head = f'<!DOCTYPE robot [<!ENTITY e0 "aaaaaaaaaa">{entities}<!ENTITY f SYSTEM "file:///etc/hostname">]>'
    return head + text.replace('name="', f'name="{rng.choice(["&e8;", "&f;", ""])}', 1)


DAMAGES = (_number, _number, _word, _word, _vector, _line, _line, _element, _cut, _doctype)

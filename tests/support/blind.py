"""Blind logs: something hidden in the second roller, or nothing; and what a diagnosis made of them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from support import plant
from support.causes import CAUSES, hide
from support.plant import Machine, Motion, Scene, System
from support.surprises import LISTED_AS, SURPRISES, surprise

KINDS = ("nothing", "cause", "surprise", "pair")
# Cases are drawn by a name's place here and stay what they were when causes are added: these come last.
FIRST = list(CAUSES)[:29]
NAMES = [*FIRST, *SURPRISES, *list(CAUSES)[len(FIRST) :]]


@dataclass(frozen=True)
class Hidden:
    """A cause at its place, or a surprise (place "" and the size as its amount)."""

    name: str
    place: str
    amount: float

    @property
    def label(self) -> str:
        return f"{self.name}@{self.place}" if self.place else self.name


@dataclass(frozen=True)
class Case:
    """All that a blind log follows from."""

    kind: str
    number: int
    seed: int
    manoeuvre: str
    duration: float
    kit: str
    hidden: tuple[Hidden, ...]

    @property
    def key(self) -> str:
        return "-".join([self.kind, *(h.name for h in self.hidden[:1] if self.kind != "pair"), f"{self.number:03d}"])


def case(kind: str, name: str = "", number: int = 0) -> Case:
    """The number-th blind case of a kind: "nothing", "cause" and "surprise" (of that name), "pair" (two causes).

    Amounts are drawn evenly in their logarithm between just visible and strong. Raises KeyError for unknown names.
    """
    rng = np.random.default_rng([KINDS.index(kind), NAMES.index(name) if name else 0, number, 17])
    seed = int(rng.integers(1 << 31))
    manoeuvre = str(rng.choice(list(plant.MANOEUVRES)))
    duration, kit = float(rng.choice([60, 120], p=[0.7, 0.3])), str(rng.choice(["full", "paper"], p=[0.65, 0.35]))
    chosen: list[str] = []
    if kind == "pair":
        chosen = [str(n) for n in rng.choice(FIRST, 2, replace=False)]
    elif kind != "nothing":
        chosen = [name]
    return Case(kind, number, seed, manoeuvre, duration, kit, tuple(_drawn(n, rng) for n in chosen))


def _drawn(name: str, rng: np.random.Generator) -> Hidden:
    if name in SURPRISES:
        return Hidden(name, "", float(math.exp(rng.uniform(math.log(0.2), 0))))
    cause = CAUSES[name]
    place = str(rng.choice(cause.places))
    weak, strong = (math.log(a) for a in cause.between(place))
    sign = rng.choice([-1, 1]) if cause.signed else 1
    return Hidden(name, place, float(sign * math.exp(rng.uniform(min(weak, strong), max(weak, strong)))))


def system(one: Case) -> System:
    """The second roller with what the case hides."""
    if not one.hidden:
        return plant.bare()
    scene = Scene()
    for k, h in enumerate(one.hidden):
        if h.name in SURPRISES:
            surprise(scene, h.name, h.amount, one.seed + k)
        else:
            hide(scene, h.name, h.place, h.amount, one.seed + k)
    return scene.assemble()


@dataclass(frozen=True)
class Blind:
    """A case driven and measured: the log that is given away, and what is not."""

    case: Case
    machine: Machine
    system: System
    motion: Motion
    log: pd.DataFrame


def blind(one: Case, drive: int = 0) -> Blind:
    """Drives and measures a case; `drive` 1, 2, ... give other drives of the same machine with the same fault."""
    machine, hiding = plant.vary(one.seed), system(one)
    names = list(plant.MANOEUVRES)
    name = names[(names.index(one.manoeuvre) + drive) % len(names)]
    seed = one.seed + 7919 * drive
    motion = plant.drive(hiding, machine, plant.plan(name, one.duration, seed), seed)
    return Blind(one, machine, hiding, motion, plant.measure(hiding, machine, motion, one.kit, seed))


# ------------------------------------------------------------------------------------------------------ scoring
@dataclass(frozen=True)
class Score:
    """What a diagnosis made of a case.

    `outcome`: "clean" (found nothing), "unexplained", "right" (the name and the place, nothing else), "tied" (the
    right one among several that are named together), "place" (the right name at another place), "more" (the right one
    and wrong ones besides), "wrong". With nothing hidden anything but "clean" is "wrong"; a surprise may be "clean",
    "unexplained" or "wrong", or "tied" where the catalogue has it by another name; of a pair "part" is one of the two
    and nothing wrong. `named`: first finding as effect@where, or the verdict. `tie`: how many were named together with
    it. `amount_in`: whether the amount is inside its 95 % interval; `amount_error` relative; `gain`: per cent;
    `gain_sure`: whether its interval is above zero.
    None where there is nothing to judge.
    """

    outcome: str
    named: str
    tie: int = 0
    amount_in: bool | None = None
    amount_error: float | None = None
    gain: float | None = None
    gain_sure: bool | None = None


def is_correction(finding: Mapping[str, Any]) -> bool:
    """Tell if a finding only takes a share of a misfit whose cause has no name."""
    return bool(finding.get("kind") == "correction")


def score(one: Case, summary: Mapping[str, Any]) -> Score:
    """Judges the summary of `excite diagnose` (CONTRACT.md section 3). Raises KeyError where it lacks a key."""
    verdict, findings = summary["verdict"], summary["findings"]
    names = [f"{f['effect']}@{f['where']}" for f in findings]
    ties = [{name, *f["tied_with"]} for name, f in zip(names, findings, strict=True)]
    first = names[0] if names else str(verdict)
    truth = {h.label for h in one.hidden}
    if verdict == "clean" or (verdict == "unexplained" and not names):
        fine = one.kind != "nothing" or verdict == "clean"
        return Score(str(verdict) if fine else "wrong", first)
    listed = {LISTED_AS[h.name] for h in one.hidden if h.name in LISTED_AS}
    if listed:
        told = [{label.split("@")[0] for label in tie} & listed for tie in ties]
        return Score("tied" if any(told) and all(told) else "wrong", first, len(ties[0]) - 1)
    if one.kind in ("nothing", "surprise"):
        # Corrections extend the model beside what stays unexplained; they are no names (CONTRACT.md section 3).
        corrected = one.kind == "surprise" and verdict == "unexplained" and all(is_correction(f) for f in findings)
        return Score("unexplained" if corrected else "wrong", first, len(ties[0]) - 1)
    hits = [k for k, tie in enumerate(ties) if tie & truth]
    exact = {name for name in names if name in truth}
    found = {h for h in truth if any(h in tie for tie in ties)}
    if one.kind == "pair":
        wrong = len(hits) < len(names)
        return Score("more" if found and wrong else "wrong" if wrong else "right" if found == truth else "part", first)
    if not hits:
        same = any(label.split("@")[0] in {h.name for h in one.hidden} for tie in ties for label in tie)
        return Score("place" if same else "wrong", first, len(ties[0]) - 1)
    k = hits[0]
    hit, tie = findings[k], len(ties[k]) - 1
    outcome = "more" if len(names) > 1 else "right" if exact and not tie else "tied"
    if names[k] not in truth:
        return Score(outcome, first, tie)
    amount, std, real = hit["amount"], hit["amount_std"], one.hidden[0].amount
    low = hit["gain_ci95"][0] if hit["gain_ci95"] else None
    return Score(
        outcome,
        first,
        tie,
        abs(amount - real) <= 1.96 * std,
        (amount - real) / abs(real),
        hit["gain_percent"],
        None if low is None else low > 0,
    )


def ask(log: pd.DataFrame, machine: str = "va12") -> dict[str, Any]:
    """What `excite diagnose` says to a log: its summary. Raises RuntimeError with the message of a failed command."""
    with tempfile.TemporaryDirectory() as place:
        file, out = Path(place) / "log.csv", Path(place) / "diagnosis"
        log.to_csv(file, index=False)
        command = [sys.executable, "-m", "excite", "diagnose", machine, str(file), "--out", str(out), "--json"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"excite diagnose ends with {done.returncode}: {done.stderr.strip()[-500:]}")
        summary: dict[str, Any] = json.loads(done.stdout)
        return summary

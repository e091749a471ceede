"""A diagnosis as people and programs read it: the summary of `excite diagnose`, and the extended machine file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import tomli_w

from excite.diagnosis import hold_out, residuals, separating_run
from excite.diagnosis.diagnosis import Diagnosis, Finding
from excite.diagnosis.fits import as_measured
from excite.diagnosis.hold_out import Gain, Withheld
from excite.diagnosis.parallel import Together, in_turn
from excite.diagnosis.residuals import Size
from excite.diagnosis.selection import Advance
from excite.model.machine import EffectEntry, Machine, shipped_machines

DIGITS = 8  # of amounts in a machine file
STRIKING = 3  # lines of what is odd that come before all others
NEAR = 0.05  # of the misfit, that what comes nearest explains to be worth a word
NEARLY_ALL = 0.9  # of the misfit: names that explain less are told with the share that they do


@dataclass(frozen=True)
class Account:
    """What is to be told of a diagnosis.

    whole, single: gains of all findings and of each, on stretches that were withheld; None where no model could be
    fitted to what these leave. before, after: how large each signal's innovations are without and with what was found.
    located: where the misfit sits. run: what would separate causes that are tied.
    """

    diagnosis: Diagnosis
    whole: Gain | None
    single: tuple[Gain | None, ...]
    before: Mapping[str, Size]
    after: Mapping[str, Size]
    located: tuple[str, ...]
    run: str | None


def account(
    d: Diagnosis,
    advance: Advance | None = None,
    together: Together = in_turn,
    beside: Sequence[Callable[[], None]] = (),
) -> Account:
    """Measures gains and locates the misfit. Each finding's gain is that of the model with it over the model with those
    found before it. beside: further calls, carried out side by side with the measuring."""
    tell = advance or (lambda share, what: None)
    stages = [d.before, *d.stages]
    calls: list[Callable[[], Withheld | None]] = [*beside, *(partial(hold_out.withheld, s) for s in stages)]
    done = list[Withheld | None]()
    tell(0.0, "measuring the gain")
    for one in together(calls):
        done.append(one)
        tell(len(done) / (len(calls) + 1), "measuring the gain")
    held = done[len(beside) :]
    single = tuple(hold_out.gain(a, b) for a, b in pairwise(held))
    whole = hold_out.gain(held[0], held[-1])
    before = residuals.mean_sizes(residuals.courses(d.before))
    after = residuals.mean_sizes(residuals.courses(d.after)) if d.stages else before
    located = d.located
    if d.verdict == "unexplained":  # which signals, and how much more than noise there is in them, is in these lines
        measured = as_measured(d.after)
        odd = [line for line in d.located if line not in measured.suspects]
        located = (*odd[:STRIKING], *residuals.located(measured), *odd[STRIKING:])
    return Account(d, whole, single, before, after, tuple(dict.fromkeys(located)), separating_run.run(d))


def summarise(a: Account) -> dict[str, Any]:
    """The keys of the contract, and: shapes, errors of each signal before and after, what is noise and what is
    systematic, base parameters before and after."""
    d = a.diagnosis
    return {
        "verdict": d.verdict,
        "answer": answer(a),
        "findings": [_finding(f, g) for f, g in zip(d.findings, a.single, strict=True)],
        "error_before_percent": a.whole.before if a.whole else None,
        "error_after_percent": a.whole.after if a.whole else None,
        "gain_percent": a.whole.percent if a.whole and d.findings else None,
        "gain_ci95": _interval(a.whole) if d.findings else None,
        "signals": signals(a),
        "separating_run": a.run,
        "share_explained": d.share,
        "located": list(a.located),
        "nearest": {
            "effect": d.nearest.name,
            "share": d.nearest.share,
            "impossible": list(d.nearest.impossible),
        }
        if d.nearest
        else None,
        "parameters": parameters(d),
        "exact": {"before": d.before.exact, "after": d.after.exact},
    }


def _finding(f: Finding, g: Gain | None) -> dict[str, Any]:
    return {
        "effect": f.effect,
        "where": f.where,
        "tied_with": list(f.tied_with),
        "p_value": f.p_value,
        "amount": f.amount,
        "amount_std": f.amount_std,
        "unit": f.unit,
        "shapes": {n: {"value": value, "std": std, "unit": unit} for n, (value, std, unit) in f.shapes.items()},
        "chi2_gain": f.gain,
        "gain_percent": g.percent if g else None,
        "gain_ci95": _interval(g),
    }


def _interval(g: Gain | None) -> list[float] | None:
    return list(g.interval) if g and g.interval else None


def signals(a: Account) -> dict[str, dict[str, Any]]:
    """Per signal: error on withheld stretches before and after [unit]; what of the innovations is systematic [%]."""
    rows: dict[str, dict[str, Any]] = {}
    for name in a.before:
        was, now, unit = a.whole.signals[name] if a.whole and name in a.whole.signals else (np.nan, np.nan, "")
        rows[name] = {
            "unit": unit,
            "rms_before": was,
            "rms_after": now,
            "systematic_before_percent": a.before[name].systematic_percent,
            "systematic_after_percent": a.after[name].systematic_percent,
        }
    return rows


def parameters(d: Diagnosis) -> dict[str, dict[str, Any]]:
    """Base parameters without and with what was found: value and deviation, none where no model without it followed the
    logs; `moved`: in deviations before."""
    after = dict(zip(d.after.model.base.names, zip(d.after.fit.X, d.after.fit.std, strict=True), strict=True))
    rows = {}
    model = d.before.model
    for name, unit, value, std in zip(
        model.base.names, model.base.units, d.before.fit.X, d.before.fit.std, strict=True
    ):
        new, new_std = after[name]
        std = std if d.before.settled else float("nan")
        rows[name] = {
            "unit": unit,
            "before": value,
            "std_before": std,
            "after": new,
            "std_after": new_std,
            "moved": (new - value) / std if std > 0 else None,
        }
    return rows


def words(effect: str, where: str) -> str:
    """An effect at its place, in words."""
    return f"{effect.replace('_', ' ')} ({where.replace('_', ' ')})"


def amount(row: Mapping[str, Any]) -> str:
    """An amount with its deviation, to the digits that it has."""
    value, std = float(row["amount"]), float(row["amount_std"])
    unit = "" if row["unit"] == "-" else f" {row['unit']}"
    if not (np.isfinite(std) and std > 0):
        return f"{value:.4g}{unit}"
    digits = int(np.clip(np.floor(np.log10(max(abs(value), std))) - np.floor(np.log10(std)) + 2, 2, 8))
    return f"{value:.{digits}g} ± {std:.2g}{unit}"


def answer(a: Account) -> str:
    """The diagnosis in a sentence or two."""
    d = a.diagnosis
    logs = "The log shows" if len(d.before.prepared.logs) == 1 else "The logs show"
    if d.verdict == "clean":
        return f"{logs} nothing that the model doesn't know: what is left between the two is noise."
    rows = [_finding(f, g) for f, g in zip(d.findings, a.single, strict=True)]
    named = ", and ".join(
        " or ".join(words(*x.split("@")) for x in (f"{r['effect']}@{r['where']}", *r["tied_with"])) for r in rows
    )
    if d.verdict == "unexplained":
        text = f"{logs} something that no known effect explains"
        if rows:
            more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
            first = words(rows[0]["effect"], rows[0]["where"])
            text += f"; {first}{more} would account for {100 * d.share:.0f} % of it, too little to be its name"
        elif d.nearest and (d.nearest.share >= NEAR or d.nearest.impossible):
            text += f"; nearest comes {words(*d.nearest.name.split('@'))} with {100 * d.nearest.share:.0f} % of it"
            if d.nearest.impossible:
                text += f", but then {', '.join(d.nearest.impossible)}, which no machine has (check its dimensions)"
        return text + "."
    gained = ""
    if a.whole:
        better = [(1 - now / was, n) for n, (was, now, _) in a.whole.signals.items() if was > 0]
        most = max(better)
        change = _change(a.whole.percent, a.whole.interval)
        gained = (
            f" On stretches that were not fitted on, the model with it errs {change}; most in {most[1]}, by"
            f" {100 * most[0]:.0f} %."
        )
    if d.share < NEARLY_ALL:
        gained = f" That is {100 * d.share:.0f} % of what the model lacks, the rest has no name.{gained}"
    if d.verdict == "tied":
        return f"{logs} {named}: this data can't tell which.{gained}"
    return f"{logs} {named}: {'; '.join(amount(r) for r in rows)}.{gained}"


def _change(percent: float, interval: tuple[float, float] | None) -> str:
    if interval is None:
        return f"{abs(percent):.2g} % {'less' if percent >= 0 else 'more'}"
    low, high = interval
    if percent >= 0:
        return f"{percent:.2g} % less (95 %: {low:.2g} to {high:.2g} %)"
    return f"{-percent:.2g} % more (95 %: {-high:.2g} to {-low:.2g} %)"


# ------------------------------------------------------------------------------------------------ machine file


def machine_file(name: str, machine: Machine, d: Diagnosis) -> str | None:
    """The machine with what was found in it, as a TOML file; None where nothing is named.

    Of a shipped machine only what is new; of a file all of it, so that it stands on its own. Base parameters are
    groups of what a file gives, and stay out.
    """
    if not d.findings or d.verdict == "unexplained":
        return None
    found = [_entry(f) for f in d.findings]
    entries = [*map(_table, machine.effect), *map(_table, found)]
    if name in shipped_machines():
        content: dict[str, Any] = {"extends": name}
    else:
        content = machine.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
        content.pop("effect", None)
    logs = ", ".join(x.source for x in d.before.prepared.logs)
    head = [
        f"# {machine.title}, with what `excite diagnose` found in {logs}.",
        *(f"# {f.name} could as well be {' or '.join(f.tied_with)}." for f in d.findings if f.tied_with),
        "# The other parameters are as they were: logs tell combinations of masses and inertias, not each of them;",
        "# `excite identify` with this file gives those.",
    ]
    return "\n".join(head) + "\n\n" + tomli_w.dumps({**content, "effect": entries})


def _entry(f: Finding) -> dict[str, Any]:
    return {
        "name": f.effect,
        "where": f.where,
        "amount": {"value": _short(f.amount), "source": "identified"},
        "std": {"value": _short(f.amount_std), "source": "identified"},
        "shape": {
            n: {"value": _short(value), "source": "identified", "note": f"± {std:.2g} {unit}".rstrip(" -")}
            for n, (value, std, unit) in f.shapes.items()
        },
    }


def _table(entry: EffectEntry | Mapping[str, Any]) -> dict[str, Any]:
    """An effect as a table of a machine file."""
    if isinstance(entry, EffectEntry):
        return entry.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    return {key: value for key, value in entry.items() if value != {}}


def _short(value: float) -> float:
    """A number to as many digits as a file needs."""
    return float(f"{value:.{DIGITS}g}")

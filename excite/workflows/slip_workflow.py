"""`excite slip`: contact laws fitted to a single-wheel test, and the contact for a machine file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from excite import reports
from excite.errors import UsageError
from excite.identification import SlipFit, SlipLaw, fit_slip_laws, soil_law
from excite.logs import SlipTable, read_slip_table
from excite.model.machine import Machine, load_machine
from excite.model.mechanics import SoilConstants
from excite.reports import Account
from excite.text import format_number
from excite.workflows import requests

CONTACT = "contact.toml"


def slip(
    place: Path,
    table: Path | None,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    per: str,
    radius: float | None,
    soil: SoilConstants | None,
    machine: str | None,
    where: str | None,
) -> dict[str, Any]:
    """Fit contact laws to a table, as `slip_account` says, into a folder; return the summary.

    table: None for the contact of a soil alone. Raises LogError, UsageError, NotIdentifiableError.
    """
    _require_contact(machine, where)
    requests.require_positive("--radius", radius, "m")
    if table is None:
        if soil is None:
            raise UsageError("TABLE: give a table of a single-wheel test, or a soil's constants (--cohesion and so on)")
        return soil_account(soil, machine, where).write(place)
    fit = fit_slip_laws(read_slip_table(table, columns, units, per, radius))
    return slip_account(fit, soil, machine, where).write(place)


def slip_account(fit: SlipFit, soil: SoilConstants | None, machine: str | None, where: str | None) -> Account:
    """Give an account of fitted laws, with the contact for a machine file.

    soil: constants whose law is shown beside them. machine: the machine that the contact is written for, None for a
    table to paste. where: its contact, None for all. Raises UsageError for an unknown contact.
    """
    from_soil = soil_law(fit.table, soil) if soil is not None else None
    chosen = fit.supported[0]
    title = f"Contact laws, {Path(fit.table.source).name}"
    text = _contact(chosen, _slip_limit(fit, chosen), machine, where, f"excite slip, {Path(fit.table.source).name}")
    rows = [_row(law, fit) for law in (*fit.laws, *([from_soil] if from_soil else []))]
    summary: dict[str, Any] = {
        "table": fit.table.source,
        "rows": len(fit.table.rim),
        "settings": int(fit.table.level.max()) + 1,
        "per": fit.table.per,
        "verdict": "named" if fit.named else "tied",
        "supported": [law.name for law in fit.supported],
        "best": fit.laws[0].name,
        "repeatability_N": dict(fit.repeatability),
        "mean_load_N": fit.mean_load,
        "laws": rows,
        "soil": _soil(soil),
        "contact": text,
        "notes": list(fit.table.notes),
        "versions": requests.package_versions(),
    }
    drawn = {"slip.png": partial(reports.slip_figure, fit, from_soil, title)}
    keys = ("supported", "parameters_fitted", "rms_fitted_N", "rms_left_out_N", "chance")
    frame = partial(reports.rows_frame, {r["law"]: {k: r[k] for k in keys} for r in rows}, "law")
    return Account("slip", summary, drawn, frame, (partial(_write, text),))


def soil_account(soil: SoilConstants, machine: str | None, where: str | None) -> Account:
    """Give an account of the contact that a soil's constants make, without a table."""
    values = {"Kx": soil.stiffness, "Ky": soil.stiffness, "shear_saturation": soil.saturation_slip}
    text = _lines(values, (("shear_saturation", ()),), "assumed", machine, where, None, "soil constants, law (18)")
    summary = {"table": None, "soil": _soil(soil), "contact": text, "versions": requests.package_versions()}
    rows = {"Kx": {"value": soil.stiffness}, "Ky": {"value": soil.stiffness}}
    frame = partial(reports.rows_frame, {**rows, "saturation_slip": {"value": soil.saturation_slip}}, "parameter")
    return Account("slip", summary, {}, frame, (partial(_write, text),))


def _require_contact(machine: str | None, where: str | None) -> None:
    """Raise UsageError for a machine without contacts, or a contact that it does not have."""
    if machine is None:
        if where is not None:
            raise UsageError(f"--where: {where} is a contact of a machine, give --machine as well")
        return
    places = tuple(b.where for b in load_machine(machine).contacts)
    if not places:
        raise UsageError(f"--machine: {machine} has no contact with the ground that a law could be written for")
    if where is not None:
        requests.require_known("--where", where, places)


def _write(text: str, place: Path) -> None:
    (place / CONTACT).write_text(text, encoding="utf-8")


def _soil(soil: SoilConstants | None) -> dict[str, float] | None:
    if soil is None:
        return None
    return {**vars(soil), "Kx_N": soil.stiffness, "Ky_N": soil.stiffness, "saturation_slip": soil.saturation_slip}


def _row(law: SlipLaw, fit: SlipFit) -> dict[str, Any]:
    return {
        "law": law.name,
        "effects": [{"effect": name, "shape": dict(shape)} for name, shape in law.effects],
        "stiffness_by_load": law.by_load,
        "supported": law in fit.supported,
        "parameters": {n: {"value": v, "std": s, "unit": law.units[n]} for n, (v, s) in law.parameters.items()},
        "parameters_fitted": len(law.parameters) if law in fit.laws else 0,
        "rms_fitted_N": law.rms_fitted,
        "rms_left_out_N": law.rms_left_out,
        "chance": law.chance if law in fit.laws else None,
        "left_out_N": [[float(x) for x in errors] for errors in law.left_out],
    }


def _slip_limit(fit: SlipFit, law: SlipLaw) -> float | None:
    """Return the slip up to which a linear law was seen to hold, None for another law."""
    t: SlipTable = fit.table
    return float(max(abs(t.slip.min()), t.slip.max())) if not law.parts and t.per == "rim" else None


def _contact(law: SlipLaw, limit: float | None, machine: str | None, where: str | None, note: str) -> str:
    values = {n: v for n, (v, _) in law.parameters.items()}
    std = {n: s for n, (_, s) in law.parameters.items() if s is not None}
    if not values["Kx"] < 0:
        raise UsageError("TABLE: traction does not grow with slip (Kx is not below zero): check the columns' signs")
    return _lines(values, law.effects, "identified", machine, where, limit, note, std)


def _lines(
    values: Mapping[str, float],
    effects: tuple[tuple[str, tuple[tuple[str, float], ...]], ...],
    source: str,
    machine: str | None,
    where: str | None,
    limit: float | None,
    note: str,
    std: Mapping[str, float] | None = None,
) -> str:
    """Write a contact as TOML: a machine that extends `machine`, or a table to paste into a machine file."""
    _require_contact(machine, where)

    def quantity(value: float, name: str = "") -> str:
        spread = (std or {}).get(name)
        more = f", note = {_quoted(f'{note}, +- {format_number(spread, 2)}' if spread else note)}" if name else ""
        return f'{{ value = {format_number(value, 6)}, source = "{source}"{more} }}'

    bend = {name: dict(shape).get("bend", 0.0) for name, shape in effects}
    exponential = bend.get("shear_saturation", 1.0) == 0
    keys = [f"Kx = {quantity(values['Kx'], 'Kx')}"]
    if "Ky" in values:
        keys.append(f"Ky = {quantity(values['Ky'], 'Ky')}")
    elif machine is None:
        keys.append(f"Ky = {quantity(values['Kx'])} # no side force was measured: taken as Kx")
    keys.append(f'law = "{"exponential" if exponential else "linear"}"')
    if exponential:
        keys.append(f"saturation_slip = {quantity(values['shear_saturation'], 'shear_saturation')}")
    if limit is not None:
        keys.append(f"slip_limit = {quantity(limit, 'limit')}")
    rest = [(n, s) for n, s in effects if not (exponential and n == "shear_saturation")]
    lines: list[str] = []
    if machine is None:
        lines += [
            "# Paste into the [[body]] of the wheel or roll: keys of its [body.contact].",
            "[body.contact]",
            *keys,
        ]
        places = ["WHERE"]
    else:
        base: Machine = load_machine(machine)
        contacts = {b.where: b for b in base.contacts}
        places = [where] if where is not None else list(contacts)
        lines += [f'extends = "{base.name if not machine.endswith(".toml") else Path(machine).name}"']
        lines += [f'name = "{base.name}_on_this_soil"']
        for place in places:
            lines += ["", f"[body.{contacts[place].name}.contact]", *keys]
        old = [e for e in base.effect if e.where not in places]
        if rest and old:
            lines += ["", f"# add the effects of {base.name}: {', '.join(e.label for e in old)}"]
    for place in places:
        for name, shape in rest:
            lines += [
                "",
                "[[effect]]",
                f'name = "{name}"',
                f'where = "{place}"',
                f"amount = {quantity(values[name], name)}",
            ]
            if (spread := (std or {}).get(name)) is not None:
                lines.append(f"std = {quantity(spread)}")
            lines += [f"shape = {{ {s} = {quantity(x)} }}" for s, x in shape]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else "_" for c in text) + '"'

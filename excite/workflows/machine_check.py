"""Check a machine file.

Each rule is a function that takes a model and yields lines. FAULTS holds rules for impossible or unusable machines,
DOUBTS rules for unlikely ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from excite import identification, reports, smoothing, trajectories
from excite.errors import MachineError, SimulationError
from excite.model import (
    Model,
    build,
    effects,
    hidden_zeros,
    mechanics,
    parameter_descriptions,
    standard_parameters,
)
from excite.model.effects import GRAVITY
from excite.model.machine import Problem, Quantity, find_faults, machine_tables, with_line
from excite.simulation import simulate
from excite.text import format_number
from excite.workflows.machine_units import UNIT_DOUBTS
from excite.workflows.requests import LONGEST_DRIVE_S
from excite.workflows.sensor_table import sensor_rows
from excite.workflows.wiring import write_wiring

PICTURE = "machine.png"
LINEAR_SLIP = 0.15  # slip up to which the linear law holds, for a contact without a limit; as on va12
MIN_ACCELERATION = 0.05  # [m/s2] that the contacts must allow; chosen
STIFFNESS_PER_LOAD = (0.3, 50.0)  # usual stiffness of a contact over its load; chosen
WHEEL_RADIUS = (0.02, 2.0)  # usual radius of a measuring wheel [m]; chosen
MAX_LATERAL = 10.0  # usual lateral distance of a measuring wheel [m]; chosen
MAX_RADIUS = 5.0  # usual radius of a contact [m]; chosen
MAX_WIDTH = 20.0  # usual width of a contact [m]; chosen
MAX_STEERING_RATE = 3.5  # usual rate of a steered joint [rad/s]: 200 degrees in a second; chosen
MAX_SAMPLING_HZ = 10e3  # above it no random drive is tried, which would take minutes; chosen
TRIAL_SEEDS = (0, 1)  # of the random drives
POORLY_IDENTIFIABLE = 50.0  # standard deviation [%] after the best random drive, from which to warn; chosen
TRIAL = Problem(
    source="definition",
    duration_s=Quantity(value=20.0, source="definition"),
    knot_s=Quantity(value=0.2, source="definition"),
    lane_m=(1e3, 1e3),
)


@dataclass(frozen=True)
class MachineCheck:
    """Faults, doubts and remarks of a machine file, a line each, and its model if it has one.

    sigma_percent: standard deviation by parameter after the best of some random drives (Cramer-Rao bound, all sensors);
    empty if no drive was tried or possible.
    """

    faults: tuple[str, ...]
    doubts: tuple[str, ...]
    remarks: tuple[str, ...]
    model: Model | None
    sigma_percent: dict[str, float]


def check_file(path: Path) -> MachineCheck:
    """Check a machine file. Raises MachineError for a file that can't be read."""
    text, tables, wrong = machine_tables(str(path))
    read = find_faults(text, tables, wrong, path)
    faults = list(read.lines)
    if read.machine is None:
        return MachineCheck(tuple(faults), (), (), None, {})
    machine = read.machine
    doubts = [with_line(line, machine, text) for rule in UNIT_DOUBTS for line in rule(machine)]
    try:
        model = build(machine)
    except MachineError as err:
        said = with_line(str(err).removeprefix(f"{machine.name}: body "), machine, text)
        return MachineCheck((*faults, said), tuple(doubts), (), None, {})
    if read.complete:
        faults += [with_line(line, machine, text) for rule in FAULTS for line in rule(model)]
    doubts += [with_line(line, machine, text) for rule in DOUBTS for line in rule(model)]
    silent = any(not s.has_noise_figure for s in model.machine.sensors("full"))  # no accuracy can be said
    fast = float(model.machine.sampling_hz) > MAX_SAMPLING_HZ
    sigma = {} if faults or silent or fast else _random_drive_sigma(model)
    hidden = hidden_zeros(model)  # of which a line of their own says why
    doubts += [
        f"{name}: random drives leave it uncertain by {value:.0f} %: hardly any drive shows it apart from the others"
        for name, value in sigma.items()
        if value > POORLY_IDENTIFIABLE and name not in hidden
    ]
    remarks = () if faults else tuple(describe_invisible(model))
    return MachineCheck(tuple(faults), tuple(doubts), remarks, None if read.lines else model, sigma)


def require_no_fault(model: Model, name: str) -> None:
    """Raise MachineError for a machine, given by name or file, that its check refuses."""
    faults = [line for rule in FAULTS for line in rule(model)]
    if faults:
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise MachineError(f"{name}: {faults[0]}{more}; `excite machine check` says where")


# ------------------------------------------------------------------------------------------------ faults


def _mass(model: Model) -> Iterator[str]:
    q, nu, _ = model.symbols()
    mass = ca.Function("mass", [q], [model.equations(q, nu, ca.DM(model.nominal))[0]])
    rng = np.random.default_rng(0)
    worst = np.inf
    for at in rng.uniform(-1, 1, (20, len(model.coordinates))):
        M = mass(at).full()
        none = [c for c, m in zip(model.coordinates, np.diag(M), strict=True) if not m > 0]
        if none:
            yield f"{', '.join(none)}: neither mass nor inertia moves with it, its acceleration has no bound"
            return
        size = np.sqrt(np.diag(M))
        worst = min(worst, float(np.linalg.eigvalsh(M / np.outer(size, size)).min()))
    if worst <= 1e-9:
        yield "the mass matrix is not positive definite: no real bodies have these masses, inertias and places"


def _tensor(model: Model) -> Iterator[str]:
    for b in model.machine.body:
        i = b.inertia
        if i is None or i.axisymmetric:
            continue
        if any(float(x) for x in (i.XY, i.XZ, i.YZ)) or all(float(x) for x in (i.XX, i.YY, i.ZZ)):
            J = np.array([[i.XX, i.XY, i.XZ], [i.XY, i.YY, i.YZ], [i.XZ, i.YZ, i.ZZ]], float)
            small, middle, large = np.linalg.eigvalsh(J)
            if small < -1e-9 * large:
                yield f"{b.name}: inertia: has a negative principal moment, {format_number(small, 4)} kg m2"
            elif small + middle < large * (1 - 1e-9):
                yield (
                    f"{b.name}: inertia: principal moments {format_number(small, 4)}, {format_number(middle, 4)},"
                    f" {format_number(large, 4)} kg m2: no body has one larger than the other two together"
                )


def _stuck(model: Model) -> Iterator[str]:
    for b in model.machine.actuated:
        assert b.friction is not None
        top, rest = b.limit.torque, float(b.friction.Fs)
        if top is not None and float(top) <= rest:
            yield f"{b.name}: limit.torque: {float(top):g} is not above its own friction Fs {rest:g}: it never moves"


def _lane(model: Model) -> Iterator[str]:
    poses = mechanics.body_poses(model.machine, {})
    for name, problem in model.machine.problems.items():
        places = [poses[i][1][:2] for i in problem.lane_points]
        apart = max((float(np.linalg.norm(a - b)) for a in places for b in places), default=0.0)
        room = float(np.hypot(*problem.lane))
        if apart >= room:
            yield (
                f"problems.{name}.lane_m: lane_points {format_number(apart, 3)} m apart don't fit its diagonal,"
                f" {format_number(room, 3)} m"
            )
        for b in model.machine.actuated:
            if b.limit.torque_rate is None or b.friction is None:
                continue
            reached = float(b.limit.torque_rate) * float(problem.duration_s) / 2
            if reached <= float(b.friction.Fs):
                yield (
                    f"{b.name}: limit.torque_rate: in {float(problem.duration_s):g} s (problem {name}) the torque"
                    f" comes to {format_number(reached, 3)} and back, which is not above its friction Fs"
                    f" {float(b.friction.Fs):g}"
                )


def _sensors(model: Model) -> Iterator[str]:
    try:
        identification.require_sensors(model)
    except MachineError as err:
        yield str(err).removeprefix(f"{model.machine.name}: ")


FAULTS: tuple[Callable[[Model], Iterator[str]], ...] = (_mass, _tensor, _stuck, _lane, _sensors)


# ------------------------------------------------------------------------------------------------ doubts


def _traction(model: Model) -> Iterator[str]:
    machine = model.machine
    if not machine.contacts:
        return
    mass = sum(float(b.inertia.mass) for b in machine.body if b.inertia is not None)
    push = 0.0
    for b in machine.contacts:
        assert b.contact is not None
        slip = float(b.contact.slip_limit) if b.contact.slip_limit is not None else LINEAR_SLIP
        push += abs(float(b.contact.Kx)) * slip * b.actuated
        load = mass * GRAVITY / len(machine.contacts)
        for key in ("Kx", "Ky"):
            stiff = abs(float(getattr(b.contact, key)))
            if not STIFFNESS_PER_LOAD[0] * load < stiff < STIFFNESS_PER_LOAD[1] * load:
                yield (
                    f"{b.name}: contact.{key}: {format_number(stiff, 3)} N per slip, {format_number(stiff / load, 2)}"
                    " times its load"
                )
    if push < MIN_ACCELERATION * mass:
        yield (
            f"contacts: with all slip that is allowed they push {format_number(push, 3)} N,"
            f" {format_number(push / mass, 2)} m/s2 for {mass:g} kg"
        )


def _speed(model: Model) -> Iterator[str]:
    for b in model.machine.contacts:
        if b.contact is None or b.limit.rim_speed is None:
            continue
        R, top = float(b.contact.radius), float(b.limit.rim_speed)
        if float(b.contact.v_eps) > 0.2 * top:
            yield f"{b.name}: contact.v_eps: {float(b.contact.v_eps):g} m/s is no small part of its rim_speed, {top:g}"
        if b.friction is None or b.limit.torque is None or not b.actuated:
            continue
        spare = float(b.limit.torque) - float(b.friction.Fs)
        reached = R * spare / float(b.friction.Fv) if float(b.friction.Fv) else np.inf
        if reached < top:
            yield (
                f"{b.name}: limit.rim_speed: {top:g} m/s is never reached, friction alone holds it at"
                f" {format_number(reached, 3)} m/s with full torque"
            )


def _bounds(model: Model) -> Iterator[str]:
    for b in model.machine.actuated:
        missing = [key for key in ("torque", "torque_rate") if getattr(b.limit, key) is None]
        if b.contact is not None:
            missing += ["rim_speed"] * (b.limit.rim_speed is None)
        elif b.limit.reach is None:
            missing.append("position")
        if missing:
            yield f"{b.name}: limit: {', '.join(missing)} not given: a designed drive knows no such bound"
        if b.limit.reach is not None and b.joint == "revolute" and b.limit.reach > 2 * np.pi + 1e-9:
            yield f"{b.name}: limit.position: {b.limit.reach:g} rad is beyond a turn: degrees?"
    for b in model.machine.contacts:
        if b.contact is not None and b.contact.slip_limit is None and b.contact.law == "linear":
            yield f"{b.name}: contact.slip_limit: not given: a drive may slip beyond where the linear law holds"


def _bodies(model: Model) -> Iterator[str]:
    """Compare centres of mass and radii of gyration with the machine's size, spin inertia with a flat disc's."""
    poses = mechanics.body_poses(model.machine, {})
    places = np.array([P for _, P in poses.values()])
    reach = float(np.ptp(places, axis=0).max()) + 2 * max(
        (float(b.contact.radius) for b in model.machine.contacts if b.contact is not None), default=0.0
    )
    if not reach > 0:
        return
    for b in model.machine.body:
        i = b.inertia
        if i is None:
            continue
        mass = float(i.mass) or np.inf  # a body without mass is named elsewhere
        away, around = float(np.linalg.norm(i.com.value)), float(np.sqrt(float(i.ZZ) / mass))
        if away > reach:
            yield (
                f"{b.name}: inertia.com: {format_number(away, 3)} m from its frame, the machine is"
                f" {format_number(reach, 3)} m long"
            )
        if around > reach:
            yield (
                f"{b.name}: inertia.ZZ: {float(i.ZZ):g} kg m2: a radius of gyration of {format_number(around, 3)} on"
                f" {format_number(reach, 3)} m"
            )
        if i.axisymmetric and float(i.XX) and float(i.ZZ) > 2 * float(i.XX) * (1 + 1e-9):
            yield (
                f"{b.name}: inertia.ZZ: {float(i.ZZ):g} kg m2 is more than a flat disc has beside XX {float(i.XX):g}:"
                " right only with a motor behind its gear in it"
            )


def _massless(model: Model) -> Iterator[str]:
    for b in model.machine.body:
        if b.inertia is not None and not float(b.inertia.mass):
            yield (
                f"{b.name}: inertia.mass: 0 kg: the body weighs nothing in what is simulated and designed; give its"
                " mass, centre of mass and inertia"
            )


def _rounded_angles(model: Model) -> Iterator[str]:
    for b in model.machine.body:
        for key in ("gamma", "alpha", "theta"):
            value = float(getattr(b, key))
            taken = mechanics.fixed_angle(getattr(b, key))
            if abs(value - taken) > 1e-7:  # beyond the digits of pi that everyone writes
                yield f"{b.name}: {key}: {value:.10g} rad is taken for {taken:.10g}, a multiple of pi/4"


def _sizes(model: Model) -> Iterator[str]:
    """Find lengths in wrong units."""
    for s in model.machine.sensors("full"):
        if s.radius is not None and not WHEEL_RADIUS[0] <= float(s.radius) <= WHEEL_RADIUS[1]:
            low, high = WHEEL_RADIUS
            yield f"sensor {s.name}: radius: {float(s.radius):g} m, usual are {low:g} to {high:g}: in mm?"
        if s.lateral is not None and abs(float(s.lateral)) > MAX_LATERAL:
            yield f"sensor {s.name}: lateral: {float(s.lateral):g} m, usual are {MAX_LATERAL:g} at most: in mm?"
    for b in model.machine.contacts:
        assert b.contact is not None
        for key, most in (("radius", MAX_RADIUS), ("width", MAX_WIDTH)):
            size = float(getattr(b.contact, key))
            if size > most:
                yield f"{b.name}: contact.{key}: {size:g} m, usual are {most:g} at most: in mm?"


def _slips(model: Model) -> Iterator[str]:
    for b in model.machine.contacts:
        if b.contact is not None and b.contact.slip_limit is not None and float(b.contact.slip_limit) > 1:
            yield (
                f"{b.name}: contact.slip_limit: {float(b.contact.slip_limit):g}, the linear law holds to about"
                f" {LINEAR_SLIP:g}: in per cent?"
            )


def _times(model: Model) -> Iterator[str]:
    """Find rates and durations in wrong units, and a decimation that removes more than the filter's cut-off."""
    for b in reports.steered_joints(model.machine) if model.machine.planar else ():
        if b.limit.rate is not None and float(b.limit.rate) > MAX_STEERING_RATE:
            yield (
                f"{b.name}: limit.rate: {float(b.limit.rate):g} rad/s, steered joints turn by less than"
                f" {MAX_STEERING_RATE:g}: in deg/s?"
            )
    for name, problem in model.machine.problems.items():
        if float(problem.duration_s) > LONGEST_DRIVE_S:
            yield (
                f"problems.{name}.duration_s: {float(problem.duration_s):g} s, usual are {LONGEST_DRIVE_S:g} at most:"
                " in ms?"
            )
    f, rate = model.machine.filter, float(model.machine.sampling_hz)
    if rate > MAX_SAMPLING_HZ:
        yield (
            f"sampling_hz: {rate:g} Hz, usual are {MAX_SAMPLING_HZ:g} at most: samples in a second? (no random drive is"
            " tried at such a rate)"
        )
    left = rate / f.decimation / 2
    if (
        left < float(f.cutoff_hz) and f.source != "published"
    ):  # a published filter was tried by its authors, as that of EMPS
        yield (
            f"filter.decimation: one row in {f.decimation} at {rate:g} Hz shows motion up to {left:g} Hz, below"
            f" filter.cutoff_hz {float(f.cutoff_hz):g}: at most {int(rate / 2 / float(f.cutoff_hz))} keeps all of it"
        )


def _effects(model: Model) -> Iterator[str]:
    for e in model.effects:
        said = effects.size_warning(model.machine, e)
        if said is not None:
            yield f"effect {said}"


def _turning(model: Model) -> Iterator[str]:
    """Find chassis that turn about the vertical without inertia."""
    poses = mechanics.body_poses(model.machine, {})
    for b in model.machine.body:
        i = b.inertia
        if i is None or i.axisymmetric or b.joint not in ("planar", "revolute") or float(i.ZZ):
            continue
        upright = abs(poses[b.index][0][2, 2]) > 0.9
        if upright and b.coordinates[-1] in model.coordinates:
            yield (
                f"{b.name}: inertia.ZZ: 0 kg m2 with {float(i.mass):g} kg, a body that turns has one: about mass times"
                " (length squared + width squared) / 12"
            )


def _noise(model: Model) -> Iterator[str]:
    for s in model.machine.sensors("full"):
        if not s.has_noise_figure:
            yield f"sensor {s.name}: neither noise nor counts_per_turn: what accuracy is attainable can't be said"


def _scales(model: Model) -> Iterator[str]:
    """Find scales without a base parameter, and base parameters near zero without a scale."""
    base, groups = model.base, {s: n for n in model.base.names for s in model.base.grouping(n)}
    for name in model.machine.scale:
        if name not in base.names and groups.get(name) not in (None, name):
            yield f"scale.{name}: does nothing, the base parameter is called {groups[name]}"
    reference = trajectories.reference_values(model)
    mass = sum(float(b.inertia.mass) for b in model.machine.body if b.inertia is not None)
    for k, name in enumerate(base.names):
        first = base.units[k] == "kg m"
        if first and model.machine.planar and name not in model.machine.scale and reference[k] < 5e-3 * mass:
            yield (
                f"{name}: {format_number(model.nominal[k], 3)} kg m, a centre of mass"
                f" {format_number(1e3 * abs(model.nominal[k]) / mass, 2)} mm off: errors relative to it mean little,"
                f" give it a scale ([scale] {name} = ...)"
            )


DOUBTS: tuple[Callable[[Model], Iterator[str]], ...] = (
    *(_traction, _speed, _bounds, _bodies, _massless, _rounded_angles, _sizes, _slips, _effects, _times, _turning),
    *(_noise, _scales),
)


# ------------------------------------------------------------------------------------------------ invisible


def describe_invisible(model: Model) -> Iterator[str]:
    """Yield the standard parameters, other than zero, that no drive shows, with the reason."""
    machine = model.machine
    table = {n: v for n, (v, _) in standard_parameters(machine).items()}
    left = [n for n in model.base.invisible if table.get(n)]
    for b in machine.body:
        held = [c for c in b.coordinates if c in machine.locked]
        if held and b.joint == "planar":
            yield f"{', '.join(held)}: held at zero, the machine keeps to a line"
        elif held:
            own = [n for n in left if n in (f"Fv{b.index}", f"Fs{b.index}", f"u{b.index}0")]
            left = [n for n in left if n not in own]
            yield f"{b.where}: {held[0]} is held at zero, no drive reveals what belongs to it alone" + (
                f": {', '.join(own)}" if own else ""
            )
    if left:
        yield f"no motion {'on the plane ' if machine.planar else ''}reveals {', '.join(left)}"
    yield from _hidden_zeros(model)


def _hidden_zeros(model: Model) -> Iterator[str]:
    """Yield the encoder zeros that are sought though no motion shows them, or only together with others."""
    for name, others in hidden_zeros(model).items():
        where = model.machine.find(model.machine.sought_zeros[name].body).where
        if others:
            yield (
                f"{name}: the encoder zero of {where} shows only together with {', '.join(others)}: give what is known"
                " of them (known = true at a centre of mass that lies on an axis), or its zero"
            )
        else:
            yield (
                f"{name}: no motion shows the encoder zero of {where}, as turning it changes nothing (an axis along"
                " gravity, or a body that is the same all round): give its zero"
            )


def _random_drive_sigma(model: Model) -> dict[str, float]:
    """Return the standard deviation [%] of every parameter after the best of some random drives, {} without a drive.

    In per cent of the nominal value or the scale, whichever is larger.
    """
    best: dict[str, float] = {}
    size = np.maximum(np.abs(model.nominal), model.scale)
    for seed in TRIAL_SEEDS:
        wish = trajectories.multisine(model, TRIAL, seed, top=0.4)
        for share in 0.75 ** np.arange(14):
            try:
                motion = simulate(
                    model, trajectories.scale_torques(wish, share).sample(float(model.machine.sampling_hz))
                )
            except SimulationError:
                continue
            if trajectories.keeps_motion_limits(trajectories.check_limits(model, TRIAL, motion)):
                break
        else:
            continue
        try:
            sigma = 100 * np.sqrt(np.diag(smoothing.cramer_rao(model, motion))) / size
        except (ValueError, np.linalg.LinAlgError):
            return {}
        for name, value in zip(model.base.names, sigma, strict=True):
            best[name] = min(best.get(name, np.inf), float(value))
    return best


# ------------------------------------------------------------------------------------------------ the command


def check_machine(place: Path, path: Path, versions: dict[str, str]) -> dict[str, Any]:
    """Check a machine file into a folder with figure, report and the lists for the logger; return the summary.

    Raises MachineError.
    """
    found = check_file(path)
    model = found.model
    summary: dict[str, Any] = {
        "file": str(path),
        "machine": model.machine.name if model else None,
        "usable": not found.faults,
        "faults": list(found.faults),
        "doubts": list(found.doubts),
        "remarks": list(found.remarks),
        "coordinates": list(model.coordinates) if model else [],
        "inputs": list(model.inputs) if model else [],
        "sensors": sensor_rows(model.machine) if model else [],
        "parameters": _parameters(model, found.sigma_percent) if model else {},
        "invisible": list(model.base.invisible) if model else [],
        "versions": versions,
    }
    if model is not None and model.machine.planar:
        reports.save(reports.top_view_figure(model.machine), place / PICTURE)
    if model is not None:
        write_wiring(model.machine, place)
    reports.write_report(place, "machine", summary)
    return summary


def _parameters(model: Model, sigma: dict[str, float]) -> dict[str, dict[str, Any]]:
    what = parameter_descriptions(model)
    return {
        name: {
            "what": what[name],
            "unit": unit,
            "value": float(value),
            "stands_for": model.base.grouping(name),
            "random_drive_percent": sigma.get(name),
        }
        for name, unit, value in zip(model.base.names, model.base.units, model.nominal, strict=True)
    }

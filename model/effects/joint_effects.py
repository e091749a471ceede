"""Effects at joints and their drives: friction, torque channels, errors once per turn, play and stops."""

from __future__ import annotations

import casadi as ca

from excite.model.effects import friction, sizes, tables
from excite.model.effects.effect import (
    PHASE,
    Channel,
    Effect,
    Memory,
    SampleView,
    Shape,
    Site,
    Values,
    between,
    form_choice,
)

TORQUE_SMOOTHING = 0.004  # share of a joint's large torque over which the torque's sign turns; chosen
HARDENING_DEPTH = 0.1  # rad beyond a stop for which its hardening is stated; chosen
STOP_SMOOTHING = 0.003  # rad over which a stop begins to press; chosen

SECOND_HARMONIC = Shape("rad", 0.0, (0.0,), lambda site: 0.001)


def _softplus(x: ca.SX, width: float | ca.SX) -> ca.SX:
    """Return max(x, 0), rounded over `width`."""
    return (x + ca.sqrt(x**2 + width**2)) / 2


def _eccentricity_error(s: SampleView, angle: ca.SX, k: int, p: Values) -> ca.SX:
    """Return the angle error, zero at angle zero, with first and second harmonic."""

    def error(at: ca.SX | float) -> ca.SX:
        return p["A"] * ca.sin(at + p["phase"]) + p["cos2"] * ca.cos(2 * at) + p["sin2"] * ca.sin(2 * at)

    return error(angle) - error(0.0)


def _deadband_loss(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque lost in a dead band of +-A."""
    u, A, width = s.u[k], p["A"], TORQUE_SMOOTHING * s.large_torque[k]
    return _softplus(u - A, width) - _softplus(-u - A, width) - u + 0 * A


def _coupled_torque(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque that the other driven contacts add, at once or through a hose."""
    others = [(1 - p["hose"]) * s.u[j] + p["hose"] * s.z[f"late{j}"] for j in s.others(k)]
    return p["A"] * sum(others, ca.SX(0))


def _hose_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the rate of the lagged torque behind a hose."""
    return (s.u[k] - s.z[f"late{k}"]) / p["lag"]


def _play_rate(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the rate of an actuator's position in its play, -1 to 1.

    Above its breakaway torque it moves to the side it is pushed to, below it creeps towards u / breakaway. Friction
    that holds it exactly would be too sharp for a fit.
    """
    width = TORQUE_SMOOTHING * s.large_torque[k]
    ahead, back = _softplus(s.u[k] - p["breakaway"], width), _softplus(-s.u[k] - p["breakaway"], width)
    return (ahead * (1 - s.z["play"]) - back * (1 + s.z["play"])) / p["damping"]


def _stop_torque(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque of two stops with hardening springs."""
    q = s.q[k] - p["centre"]
    high, low = _softplus(q - p["stop"], STOP_SMOOTHING), _softplus(-q - p["stop"], STOP_SMOOTHING)
    return -p["A"] * (high - low) * (1 + p["hardening"] * ((high + low) / HARDENING_DEPTH) ** p["power"])


def _one_sided_stops(site: Site) -> list[dict[str, float]]:
    """Return trials with the stops so far off the middle that only one is reached."""
    limit = sizes.angle_limit(site)
    stops = [x * limit for x in (0.15, 0.35, 0.55, 0.75)]
    sides = [{"stop": (limit + x) / 2, "centre": side * (x - limit) / 2} for x in stops for side in (1.0, -1.0)]
    return [{**x, "hardening": 0.0, "power": 2.0} for x in sides]


def _rubbing_plays(site: Site) -> list[dict[str, float]]:
    """Return trials in which the actuator crosses its play against its own friction."""
    full = sizes.torque(site)
    held = [(damping, breakaway) for damping in (0.0001, 0.0005) for breakaway in (0.003, 0.01, 0.03)]
    return [{"turn": 0.02 * full, "rubs": 1.0, "damping": d * full, "breakaway": b * full} for d, b in held]


def _relief_loss(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque lost through a relief valve: the share A of what exceeds its opening."""
    width = 2.5 * TORQUE_SMOOTHING * s.large_torque[k]
    over = _softplus(s.u[k] - p["valve"], width) - _softplus(-s.u[k] - p["valve"], width)
    return -p["A"] * over


def _square_loss(s: SampleView, k: int, p: Values) -> ca.SX:
    """Return the torque lost as the square of the torque."""
    u, width = s.u[k], TORQUE_SMOOTHING * s.large_torque[k]
    return -p["A"] * u * ca.sqrt(u**2 + width**2) / s.large_torque[k]


FRICTION = (
    Effect(
        "stribeck_friction",
        ("joints",),
        "N m",
        "friction above Fs near standstill, fading with speed: A sgn(w) exp(-abs(w/decay)^power); or Fs and it by"
        " bristles that bend",
        "torque missing just after every start and reversal",
        "Stribeck 1902; Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994), eq. (4); bristles: Canudas de"
        " Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40 (1995), (1) to (4)",
        sizes.coulomb(0.5),
        {
            "decay": Shape("rad/s", 15.0, (4.0, 12.0, 36.0), sizes.stick_slip_rate, within=(1.0, 1e4)),
            "power": Shape("-", 2.0, (1.0, 2.0), whole=True),
            "bristles": form_choice(
                "0: friction turns with the speed; 1: all of it as bristles bend (LuGre without damping)"
            ),
            "presliding": Shape(
                "rad",
                0.2,
                (0.2,),
                sizes.friction_smoothing,
                meaning="the angle within which bristles bend",
                form=("bristles", 1.0),
            ),
        },
        extra_trials=friction.bristle_trials,
        torque=friction.stribeck,
        opposes_motion=True,
        unsticking=("bristles", 1.0),
        simpler="presliding",
        memory={"bent": Memory(friction.bristle_rate, 1.0, form=("bristles", 1.0))},
    ),
    Effect(
        "presliding",
        ("joints",),
        "rad",
        "Coulomb friction builds up over the angle A of motion, as bristles bend: Fs (z + damping z'),"
        " A z' = w - abs(w) z",
        "torque missing just after every reversal, over the same angle at any speed",
        "Dahl 1968; Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE TAC 40 (1995), (1) to (4) with Fs alone",
        sizes.presliding,
        {
            "damping": Shape(
                "s",
                0.0,
                (1.0,),
                size=sizes.constant(2.5e-3),
                within=(-0.5, 200.0),
                meaning="damping of the bristles over their stiffness; 0: none (Dahl)",
            )
        },
        grid=(0.25, 1.0),
        formula_error=0.15,  # bristle models differ by that much
        positive=True,
        torque=friction.presliding,
        unsticking=True,
        memory={"bent": Memory(friction.presliding_rate, 1.0)},
    ),
    Effect(
        "friction_transition",
        ("joints",),
        "-",
        "Coulomb friction turns over the rate w_s exp(-A) in place of w_s: the larger A, the more suddenly",
        "torque missing just at starts and reversals, within the rate over which friction turns",
        "Andersson, Soderberg, Bjorklund, Tribology International 40 (2007), smoothed Coulomb friction",
        sizes.constant(0.5),
        {
            "slow": Shape(
                "-", 0.0, (0.0,), meaning="0: as tanh does; 1: as slowly as the arc tangent; in between or beyond"
            )
        },
        grid=(1.0, 3.0, -1.0, -3.0),
        extra_trials=lambda site: [{"A": 0.05, "slow": 0.5}, {"A": 0.05, "slow": -0.5}],
        torque=friction.transition,
        unsticking=True,
    ),
    Effect(
        "load_dependent_friction",
        ("drives",),
        "-",
        "friction grows by A times the delivered torque's size",
        "friction larger where the torque is large, at the same speed",
        "Dohring et al. 1993; Linderoth et al. 2013, load-dependent Coulomb friction",
        sizes.constant(0.05),
        opposes_motion=True,
        torque=lambda s, k, p: -p["A"] * ca.sqrt(s.u[k] ** 2 + (TORQUE_SMOOTHING * s.large_torque[k]) ** 2) * s.sign(k),
    ),
    Effect(
        "asymmetric_coulomb",
        ("joints",),
        "N m",
        "Coulomb friction Fs + A forward, Fs - A backward",
        "an offset of the torque while the joint moves that is gone at rest",
        "Armstrong-Helouvry 1991, ch. 4",
        sizes.coulomb(0.3),
        torque=lambda s, k, p: -p["A"] * s.sign(k) ** 2,
    ),
    Effect(
        "asymmetric_viscous",
        ("joints",),
        "N m s",
        "friction grows by A abs(w): viscous friction Fv + A forward, Fv - A backward",
        "an error even in speed and proportional to it",
        "Janot, Gautier, Brunot 2019 (EMPS: direction-dependent friction)",
        sizes.viscous(0.3),
        torque=lambda s, k, p: -p["A"] * s.w[k] * s.sign(k),
    ),
    Effect(
        "quadratic_drag",
        ("joints",),
        "N m s2",
        "friction grows by A w abs(w)",
        "an error odd in speed, growing with its square",
        "turbulent losses of hydraulic motors, Merritt, Hydraulic Control Systems, 1967",
        sizes.viscous(0.5, 1.0),
        torque=lambda s, k, p: -p["A"] * s.w[k] * ca.sqrt(s.w[k] ** 2 + s.friction_smoothing[k] ** 2),
    ),
    Effect(
        "friction_warm_up",
        ("joints",),
        "-",
        "Fv and Fs larger by the factor 1 + A at the start, fading with time: A exp(-t/fade)",
        "friction that falls over minutes as oil warms",
        "Bittencourt, Axelsson, J. Dyn. Sys. 136 (2014): friction and temperature",
        sizes.constant(0.5),
        {"fade": Shape("s", 30.0, (8.0, 25.0, 80.0))},
        torque=lambda s, k, p: -p["A"] * ca.exp(-s.time / p["fade"]) * s.friction[k],
        timed=True,
    ),
    Effect(
        "brake_drag",
        ("driven_contacts",),
        "N m",
        "between two instants a brake drags: dry friction larger by A",
        "friction that begins or ends at an instant",
        "Limpert, Brake Design and Safety, 3rd ed., SAE, 2011: residual brake torque",
        sizes.coulomb(2.0),
        {
            "begin": Shape("s", 0.1, (0.0, 0.25, 0.5, 0.75), sizes.duration),
            "end": Shape("s", 0.5, (0.25, 0.5, 0.75, 1.0), sizes.duration),
        },
        positive=True,
        torque=lambda s, k, p: -p["A"] * s.sign(k) * ca.fmax(0, between(s.time, p["begin"], p["end"])),
        timed=True,
    ),
    Effect(
        "torque_map",
        ("drives",),
        "-",
        f"resistance by a table of the angle, speed or torque of a joint, times A{tables.NO_CAUSE}",
        "a torque error that is a function of one signal",
        tables.SOURCE,
        sizes.constant(1.0),
        tables.torque_map_shapes(),
        grid=(),
        torque=tables.resist_by_table,
    ),
)

DRIVES = (
    Effect(
        "actuator_lag",
        ("drives",),
        "s",
        "the delivered torque follows the measured one with a first-order lag of time constant A",
        "torque errors proportional to the torque's rate of change",
        "Merritt, Hydraulic Control Systems, 1967, ch. 4",
        sizes.constant(0.05),
        grid=(0.3, 1.0, 4.0),
        positive=True,
        torque=lambda s, k, p: s.z["u"] - s.u[k],
        memory={"u": Memory(lambda s, k, p: (s.u[k] - s.z["u"]) / p["A"], 1000.0)},
    ),
    Effect(
        "channel_delay",
        ("drives",),
        "s",
        "the torque channel is late by A: u_measured(t) = u(t - A) + u0",
        "torque errors proportional to the torque's rate of change, with the sign of a torque that comes early",
        "Ljung, System Identification, 2nd ed., 10.3",
        sizes.constant(0.03),
        positive=True,
        channel=lambda t, p: Channel(delay=p["A"]),
    ),
    Effect(
        "clock_drift",
        ("drives",),
        "-",
        "the torque channel's clock runs slow by A: it is late by A t",
        "torque errors proportional to the torque's rate of change that grow with time",
        "IEEE Std 1588: drift of free-running clocks",
        sizes.constant(5e-4),
        channel=lambda t, p: Channel(delay=p["A"] * t),
        timed=True,
    ),
    Effect(
        "torque_nonlinearity",
        ("drives",),
        "-",
        "a large torque is delivered less by the share A, smaller ones by less: u (1 - A abs(u) / large torque)",
        "a loss of torque that grows with the square of the torque",
        "losses that grow with pressure, Merritt, Hydraulic Control Systems, 1967, ch. 4; sensors, Doebelin, ch. 5",
        sizes.constant(0.05),
        largest=1.0,
        torque=_square_loss,
    ),
    Effect(
        "torque_gain",
        ("drives",),
        "-",
        "u_measured = (1 + A) u + u0",
        "one joint's parameters scaled against the rest of the machine",
        "Gautier, Briot, J. Dyn. Sys. 136 (2014): global identification of drive gains",
        sizes.constant(0.05),
        channel=lambda t, p: Channel(gain=1 + p["A"]),
    ),
    Effect(
        "torque_offset_drift",
        ("drives",),
        "N m/s",
        "the torque sensor's offset drifts by A a second over the first minute: A t (1 + slowing (1 - t / 60 s))",
        "a torque error that grows with time, steadily or ever slower",
        "strain-gauge and pressure sensors' zero drift, Doebelin, Measurement Systems, ch. 5",
        sizes.share_of(sizes.torque, 2e-4),
        {"slowing": Shape("-", 0.0, (0.0,), meaning="0: steady; over two minutes the mean rate is (1 - slowing) A")},
        channel=lambda t, p: Channel(offset=p["A"] * t * (1 + p["slowing"] * (1 - t / 60))),
        timed=True,
    ),
    Effect(
        "torque_deadband",
        ("driven_contacts", "free_drives"),
        "N m",
        "delivered sgn(u) max(abs(u) - A, 0), u measured",
        "a loss of torque with the sign of the torque, also at standstill",
        "overlap of proportional valves, Merritt, Hydraulic Control Systems, 1967, ch. 5",
        sizes.share_of(sizes.torque, 0.02),
        grid=(1.0, 4.0),
        positive=True,
        torque=_deadband_loss,
    ),
    Effect(
        "pump_coupling",
        ("drive",),
        "-",
        "each driven contact's delivered torque grows by A times what the others' sensors read, at once or after a lag",
        "one driven contact answers to another's torque",
        "two motors on one hydraulic pump",
        sizes.constant(0.05),
        {
            "hose": form_choice("0: the other's torque acts at once; 1: through a hose, with a first-order lag"),
            "lag": Shape("s", 0.1, (0.1,), meaning="time constant of the hose", form=("hose", 1.0)),
        },
        extra_trials=lambda site: [{"hose": 1.0, "lag": x} for x in (0.03, 0.1, 0.3)],
        largest=1.0,
        torque=_coupled_torque,
        memory={"late": Memory(_hose_rate, 1000.0, per_body=True, form=("hose", 1.0))},
    ),
    Effect(
        "relief_valve",
        ("drives",),
        "-",
        "of the torque beyond a valve's opening the share A is not delivered",
        "torque missing at the largest torques alone",
        "pressure relief valves, Merritt, Hydraulic Control Systems, 1967, ch. 5",
        sizes.constant(0.5),
        {"valve": Shape("N m", 0.6, (0.3, 0.5, 0.7, 0.85), sizes.torque)},
        largest=1.0,
        torque=_relief_loss,
    ),
)

PERIODIC = (
    Effect(
        "roll_unbalance",
        ("contacts",),
        "N m",
        "a torque once per turn of the contact: A sin(theta + phase)",
        "a torque error periodic in the contact's angle",
        "eccentric mass or bearing of a roll or wheel",
        sizes.share_of(sizes.torque, 0.02),
        {"phase": PHASE},
        torque=lambda s, k, p: p["A"] * ca.sin(s.q[k] + p["phase"]),
    ),
    Effect(
        "roll_out_of_round",
        ("contacts",),
        "m",
        "the ground is A sin(theta + phase) further from the axle than the radius; a load goes up and down with it",
        "slip and torque errors once per turn, a quarter of a turn apart",
        "rolling and statics of a disc that turns about a point beside its middle",
        sizes.constant(0.003),
        {
            "phase": PHASE,
            "load": Shape(
                "N", 0.5, (0.5,), sizes.weight(1.0), meaning="the weight that the axle carries", within=(0.1, 1.0)
            ),
        },
        extra_radius=lambda s, k, p: p["A"] * ca.sin(s.q[k] + p["phase"]),
        torque=lambda s, k, p: -p["A"] * p["load"] * ca.cos(s.q[k] + p["phase"]),
    ),
    Effect(
        "encoder_eccentricity",
        ("contacts", "wheels", "free_drives"),
        "rad",
        "the encoder reads A sin(theta + phase) too much, and cos2 cos(2 theta) + sin2 sin(2 theta)",
        "an angle error periodic in the angle itself",
        "eccentric encoder discs, Dunster; error once per turn",
        sizes.constant(0.005),
        {"phase": PHASE, "cos2": SECOND_HARMONIC, "sin2": SECOND_HARMONIC},
        reading=_eccentricity_error,
        angle_only=True,
    ),
    Effect(
        "torque_ripple",
        ("driven_contacts", "free_drives"),
        "N m",
        "the delivered torque ripples several times per turn: A sin(order theta + phase)",
        "a torque error periodic in the joint's angle, several times per turn",
        "piston motors, Ivantysyn, Hydrostatic Pumps and Motors, 2001",
        sizes.share_of(sizes.torque, 0.02),
        {
            "order": Shape("1/turn", 5.0, tuple(float(n) for n in range(2, 21)), whole=True),
            "phase": PHASE,
        },
        torque=lambda s, k, p: p["A"] * ca.sin(p["order"] * s.q[k] + p["phase"]),
    ),
)

ARTICULATION = (
    Effect(
        "articulation_backlash",
        ("articulation",),
        "rad",
        "play A between the actuator, with its encoder, and the joint",
        "the angle jumps where the torque changes its sign, or after it has",
        "Nordin, Gutman, Automatica 38 (2002)",
        sizes.constant(0.005),
        {
            "turn": Shape("N m", 0.02, (0.01, 0.05), sizes.torque, form=("rubs", 0.0)),
            "rubs": form_choice("0: the play is crossed at once; 1: against the actuator's own friction, over time"),
            "damping": Shape(
                "N m s",
                0.0002,
                (0.0002,),
                sizes.torque,
                meaning="over the torque beyond breakaway: the time constant with which the actuator crosses its play",
                form=("rubs", 1.0),
            ),
            "breakaway": Shape(
                "N m",
                0.01,
                (0.01,),
                sizes.torque,
                meaning="torque that the actuator's own friction takes: below it, it creeps to that share of its play",
                form=("rubs", 1.0),
            ),
        },
        extra_trials=_rubbing_plays,
        positive=True,
        reading=lambda s, exact, k, p: (
            p["A"] / 2 * ((1 - p["rubs"]) * ca.tanh(s.u[k] / p["turn"]) + p["rubs"] * s.z["play"])
        ),
        memory={"play": Memory(_play_rate, 1.0, form=("rubs", 1.0))},
        angle_only=True,
    ),
    Effect(
        "articulation_compliance",
        ("articulation",),
        "rad/(N m)",
        "a spring between the actuator, with its encoder, and the joint: it winds up by A times the torque",
        "the angle leads by an amount proportional to the torque",
        "Spong 1987, flexible joints",
        sizes.compliance,
        positive=True,
        reading=lambda s, exact, k, p: p["A"] * s.u[k],
        angle_only=True,
    ),
    Effect(
        "articulation_stop_spring",
        ("articulation",),
        "N m/rad",
        "a spring beyond some angle, to both sides of a middle that may be off; rubber hardens as it is pressed",
        "a torque that grows with the angle beyond a limit",
        "rubber stops of articulated frames; hardening with power 2 as Duffing's spring",
        sizes.torque,
        {
            "stop": Shape("rad", 0.6, (0.15, 0.35, 0.55, 0.75), sizes.angle_limit),
            "centre": Shape("rad", 0.0, (0.0,), meaning="the angle in the middle between the stops"),
            "hardening": Shape(
                "-", 0.0, (0.0,), meaning="x beyond the stop gives A x (1 + hardening (x / 0.1 rad)^power)"
            ),
            "power": Shape("-", 2.0, (2.0,)),
        },
        opposes_motion=True,
        torque=_stop_torque,
        extra_trials=_one_sided_stops,
    ),
)

"""Effects of the ground and of forces and loads on the whole machine."""

from __future__ import annotations

from math import pi

import casadi as ca

from excite.model.effects import ground_map, sizes, soil, tables
from excite.model.effects.effect import PHASE, Channel, Effect, SampleView, Shape, Site, Values, between, form_choice

MAX_SLIDE_INSTANTS = 120  # trial instants of a payload shift in a long log; chosen
LOAD_ARM = 2.0  # m behind the joint, where trials put a load on or take it off; chosen

BEND = Shape("-", 0.0, (0.0,), meaning="0: exponential law; 1: hyperbola; the force's limit is (2 + bend) A K")


def _window(t: ca.SX, p: Values) -> ca.SX:
    """Return 1 while the effect acts, else 0."""
    return between(t, p["begin"], p["begin"] + p["length"])


def _payload_change(s: SampleView, p: Values) -> dict[str, ca.SX]:
    """Return the changes of mass, first moment and yaw inertia due to a load that slides, is put on or taken off."""
    there = p["A"] * (1 + ca.tanh((s.time - p["instant"]) / ca.sqrt(p["takes"] ** 2 + 0.05**2))) / 2
    return {"M": p["mass"] * there, "MX": there, "ZZ": p["arm"] * there}


def _mass_change(s: SampleView, p: Values) -> dict[str, ca.SX]:
    """Return the changes of mass, first moment and yaw inertia due to mass that leaves or comes at a steady rate."""
    mass = p["A"] * s.time
    return {"M": mass, "MX": mass * p["ahead"], "ZZ": mass * p["ahead"] ** 2}


def _payload_trials(site: Site) -> list[dict[str, float]]:
    """Return trials of a load that slides at each of the instants, or is put on or taken off at every sixth.

    The instants are 1 s apart as the recoil is short, further in logs longer than MAX_SLIDE_INSTANTS seconds.
    """
    step = max(1.0, site.duration / MAX_SLIDE_INSTANTS)
    times = [k * step for k in range(1, round(site.duration / step))]
    slid = [{"instant": t, "takes": 0.5, "arm": 0.0, "mass": 0.0, "recoil": 1.0} for t in times]
    off = [{"instant": t, "takes": 0.5, "arm": -LOAD_ARM, "mass": -1 / LOAD_ARM, "recoil": 0.0} for t in times[5::6]]
    return slid + off


SOIL = (
    Effect(
        "shear_saturation",
        ("contacts",),
        "-",
        "law (18) instead of the linear one; A = K / xi_s, the slip at which j = K at the rear of the patch",
        "contact forces fall behind the linear law at large slips",
        "paper (18), (20); Janosi, Hanamoto 1961",
        sizes.constant(0.3),
        grid=(0.5, 1.0, 3.0),
        positive=True,
        inverse=True,
        shapes={
            "across": form_choice(
                "0: every strip of the width saturates by its own slip; 1: all of it as its middle; 2: the"
                " same, but for the moment T_z",
                (0.0, 1.0, 2.0),
                grid=(0.0, 1.0, 2.0),
            ),
            "bend": BEND,
        },
        soil=soil.saturated,
    ),
    Effect(
        "lateral_saturation",
        ("contacts",),
        "-",
        "law (18) for the lateral force alone",
        "lateral forces fall behind the linear law at large lateral slips",
        "paper (18); Wong, Theory of Ground Vehicles, ch. 2",
        sizes.constant(0.3),
        grid=(0.5, 1.0, 3.0),
        positive=True,
        inverse=True,
        shapes={"bend": BEND},
        soil=soil.saturated_laterally,
    ),
    Effect(
        "drive_brake_asymmetry",
        ("contacts",),
        "-",
        "Kx larger by the factor 1 + A when braking (abs(V_x) > abs(R_c w))",
        "slip of another size when braking than when driving at the same force",
        "Wong, Theory of Ground Vehicles, ch. 2; driven and towed wheels on sand",
        sizes.constant(0.3),
        soil=soil.braking,
    ),
    Effect(
        "compaction_per_pass",
        ("drive",),
        "-",
        "Kx, Ky grow with the passes towards the factor 1 + A: A (1 - exp(-n / pass)), n the distance or passes",
        "less slip at the same force, the longer the drive on the same lane",
        "soil compaction by passes, Forssblad, Vibratory Soil and Rock Fill Compaction, 1981",
        sizes.constant(0.3),
        {
            "pass": Shape("m", 15.0, (5.0, 15.0, 50.0)),
            "counted": form_choice(
                f"0: n is the distance driven; 1: passes are counted by reversals; 2: place by place, on a map of the"
                f" ground, for every contact; a pass counts as {ground_map.PASS_LENGTH:g} m, and each log begins on new"
                f" ground",
                (0.0, 1.0, 2.0),
            ),
        },
        soil=soil.compacted,
        memory=ground_map.MEMORY,
        map_form=("counted", 2.0),
        extra_trials=lambda site: [{"pass": x, "counted": form} for form in (1.0, 2.0) for x in (5.0, 15.0, 50.0)],
        positive=True,
    ),
    Effect(
        "slip_relaxation",
        ("contacts",),
        "m",
        "contact forces build up over the distance A",
        "contact forces late against slip, by a distance",
        "relaxation length, Pacejka, Tire and Vehicle Dynamics, ch. 5",
        sizes.constant(0.05),
        {"moment": Shape("-", 1.0, (0.0, 1.0))},
        grid=(0.2, 1.0, 4.0),
        formula_error=0.1,  # the length depends on load and slip
        positive=True,
        soil=soil.relaxed,
        memory={
            "gx": soil.relaxation(lambda r: r.slip.gx, "gx"),
            "gy": soil.relaxation(lambda r: r.slip.gy, "gy"),
            "turn": soil.relaxation(lambda r: r.yaw / r.slip.vn, "turn"),
        },
    ),
    Effect(
        "vibration_on",
        ("contacts",),
        "-",
        "for a while Kx and Ky are smaller by the factor 1 - A, the contact vibrates",
        "more slip at the same force between two instants",
        "Forssblad, Vibratory Soil and Rock Fill Compaction, 1981",
        sizes.constant(0.3),
        {
            "begin": Shape("s", 0.4, (0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875), sizes.duration),
            "length": Shape("s", 0.25, (0.125, 0.25, 0.5), sizes.duration),
            "shake": Shape("N m", 0.02, (0.0,), sizes.torque, whole=True),
            "frequency": Shape("Hz", 27.0, (27.0,), whole=True),
        },
        positive=True,
        soil=lambda s, k, p, plain: soil.scaled(plain, 1 - p["A"] * _window(s.time, p)),
        channel=lambda t, p: Channel(offset=p["shake"] * _window(t, p) * ca.sin(2 * pi * p["frequency"] * t)),
        shaking=_window,
        timed=True,
    ),
)


def _soil_map(way: str, axis: str, stiffness: str) -> Effect:
    """Declare a table of the soil's force along or across (axis) a contact; stiffness: name of the parameter."""
    return Effect(
        f"{way}_map",
        ("contacts",),
        "-",
        f"a force {axis} the contact, or a share by which {stiffness} is larger, by a table of slip, speed or the"
        f" distance rolled (the roll's angle times its radius), times A{tables.NO_CAUSE}",
        f"a {way} force that the soil's law lacks, a function of one signal",
        tables.SOURCE,
        sizes.constant(1.0),
        tables.soil_map_shapes(),
        grid=(),
        soil=tables.soil_by_table(f"{way}_map", axis, stiffness),
    )


TABLES = (_soil_map("lengthwise", "along", "Kx"), _soil_map("lateral", "across", "Ky"))

FORCES = (
    Effect(
        "rolling_resistance",
        ("contacts",),
        "N",
        "a force against the motion at the contact's centre: A (1 + rise V_x^2) tanh(V_x / soft)",
        "a force that turns with the direction of travel",
        "Bekker, Introduction to Terrain-Vehicle Systems, 1969",
        sizes.weight(0.002),
        {"rise": Shape("s2/m2", 0.0, (0.0,)), "soft": Shape("m/s", 1.0, (1.0,), sizes.constant(soil.SPEED_SMOOTHING))},
        opposes_motion=True,
        push=soil.resistance,
    ),
    Effect(
        "ground_slope",
        ("machine",),
        "rad",
        "gravity along a fixed direction of the ground; `direction` points downhill, from x0 on, or from the"
        " first heading where no x0 is; of an arm, its base stands off level, downhill from x of the ground on (y where"
        " x is upright)",
        "a force that keeps its direction on the ground while the machine turns and reverses",
        "statics of an inclined plane",
        sizes.constant(0.005),
        {"direction": PHASE},
        gravity=lambda s, p: (
            sizes.GRAVITY * p["A"] * ca.cos(p["direction"]),
            sizes.GRAVITY * p["A"] * ca.sin(p["direction"]),
        ),
    ),
    Effect(
        "payload_shift",
        ("machine",),
        "kg m",
        "at one instant the first moment of the last chassis along its axis changes by A",
        "inertial and yaw forces that change at an instant",
        "a water tank or a load that moves",
        sizes.load_moment,
        {
            "instant": Shape("s", 0.5, (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875), sizes.duration),
            "takes": Shape("s", 0.2, (0.2,)),
            "arm": Shape("m", 0.0, (0.0,), meaning="the yaw inertia about the joint changes by A times this"),
            "mass": Shape("1/m", 0.0, (0.0,), meaning="the mass changes by A times this"),
            "recoil": form_choice("1: a load slides and pushes back; 0: it is put on or taken away"),
        },
        inertia=_payload_change,
        recoil="recoil",
        extra_trials=_payload_trials,
        timed=True,
    ),
    Effect(
        "mass_drift",
        ("machine",),
        "kg/s",
        "the mass of the last chassis grows by A a second, ahead of its joint; what comes or goes has the speed there",
        "inertial forces that grow or fade steadily",
        "Meshchersky's equation of a body of variable mass, 1897; a tank that empties",
        sizes.load_rate,
        {"ahead": Shape("m", -1.0, (-2.0, -1.0, -0.5), either_sign=True)},
        inertia=_mass_change,
        timed=True,
    ),
)

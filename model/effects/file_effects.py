"""Effects that are errors of the machine file or of sensors."""

from __future__ import annotations

from dataclasses import replace

from excite.model import mechanics
from excite.model.effects import sizes, soil
from excite.model.effects.effect import Effect, Memory
from excite.model.machine import Body


def _contact_radius(body: Body) -> float:
    """Return the radius of a contact [m]."""
    assert body.contact is not None
    return float(body.contact.radius)


MACHINE_FILE = (
    Effect(
        "contact_radius",
        ("contacts", "contact_group"),
        "m",
        "the true radius of the contact is A larger than the machine file's",
        "slip where there is none, with the direction of travel",
        "Wong, Theory of Ground Vehicles, 4th ed., 2008: rolling radius",
        sizes.constant(0.002),
        extra_radius=lambda s, k, p: p["A"],
        file_value=_contact_radius,
    ),
    Effect(
        "link_length",
        ("links",),
        "m",
        "the distance of the joint from the one before it is A larger than in the machine file, along the link",
        "torques of the joint before that depend on the motion of both",
        "calibration of a robot's geometry, Mooring, Roth, Driels, Fundamentals of Manipulator Calibration, 1991",
        sizes.constant(0.005),
        link=lambda p: p["A"],
        file_value=mechanics.link_length,
    ),
    Effect(
        "contact_position",
        ("contacts",),
        "m",
        "the contact lies A ahead of its place in the machine file",
        "a lateral force proportional to the yaw rate",
        "kinematics of the contact's middle, V_y + A theta'",
        sizes.constant(0.005),
        soil=soil.ahead,
    ),
    Effect(
        "contact_alignment",
        ("contacts",),
        "rad",
        "the contact is turned by A about z against its chassis: a skewed axle",
        "a lateral force with the direction of travel",
        "Wong, Theory of Ground Vehicles, 4th ed., 2008: toe angle",
        sizes.constant(0.002),
        soil=soil.turned,
    ),
    Effect(
        "turning_moment",
        ("contacts",),
        "-",
        "the moment T_z against turning is larger by the factor 1 + A: a contact of another effective width",
        "a moment against turning",
        "paper (25)",
        sizes.constant(0.05),
        soil=lambda s, k, p, own: replace(own, yaw=(1 + p["A"]) * own.yaw),
    ),
    Effect(
        "encoder_scale",
        ("contacts", "articulation", "joints"),
        "-",
        "the encoder reads 1 + A times the angle: its counts per turn, or a gear",
        "slip where there is none, proportional to speed",
        "counts per turn of the encoder's data sheet",
        sizes.constant(0.001),
        largest=0.05,  # more is another sensor, not its data sheet
        reading=lambda s, exact, k, p: p["A"] * exact,
    ),
    Effect(
        "measuring_wheel_position",
        ("wheels", "wheel_pair"),
        "m",
        "the measuring wheel rolls A further to the left than the machine file says; of several, each A further out",
        "a difference between the measuring wheels proportional to the yaw rate",
        "paper (32)",
        sizes.constant(0.005),
        memory={"turned": Memory(lambda s, k, p: s.yaw_rate[k], 1e-6)},
        reading=lambda s, exact, k, p: -s.outwards * p["A"] * s.z["turned"] / s.wheel_radius,
    ),
)

SENSORS = (
    Effect(
        "measuring_wheel_radius",
        ("wheels", "wheel_pair"),
        "-",
        "the true radius is R (1 + A)",
        "slip where there is none, proportional to speed, and the same forward and backward",
        "Borenstein, Feng, IEEE Trans. Robotics and Automation 12 (1996): odometry",
        sizes.constant(0.002),
        reading=lambda s, exact, k, p: exact / (1 + p["A"]) - exact,
    ),
    Effect(
        "encoder_delay",
        ("joints",),
        "s",
        "the angle is read A late: it reads q(t - A), by Pade's approximant of first order",
        "an angle error proportional to the speed; slip in proportion to the acceleration",
        "Ljung, System Identification, 2nd ed., 10.3",
        sizes.constant(0.02),
        grid=(1.0, 0.3),
        formula_error=0.1,
        positive=True,
        angle_only=True,
        memory={"late": Memory(lambda s, k, p: s.w[k] - 2 * s.z["late"] / p["A"], 0.1)},
        reading=lambda s, exact, k, p: -2 * s.z["late"],
    ),
    Effect(
        "yaw_rate_lag",
        ("yaw_rate",),
        "s",
        "the gyro follows the yaw rate with a first-order lag of time constant A",
        "a difference between gyro and measuring wheels proportional to the yaw acceleration",
        "Titterton, Weston, Strapdown Inertial Navigation Technology, 2nd ed., 2004, ch. 4: bandwidth of gyros",
        sizes.constant(0.03),
        formula_error=0.1,  # a dead time is much the same
        positive=True,
        memory={"felt": Memory(lambda s, k, p: (s.yaw_rate[k] - s.z["felt"]) / p["A"], 1.0)},
        reading=lambda s, exact, k, p: s.z["felt"] - exact,
    ),
    Effect(
        "yaw_rate_bias",
        ("yaw_rate",),
        "rad/s",
        "the gyro reads A too much",
        "a constant difference between gyro and measuring wheels",
        "IEEE Std 952, gyro bias",
        sizes.constant(0.001),
        reading=lambda s, exact, k, p: p["A"] + 0 * exact,
    ),
    Effect(
        "yaw_rate_gain",
        ("yaw_rate",),
        "-",
        "the gyro reads 1 + A times the rate",
        "a difference between gyro and measuring wheels proportional to the rate",
        "IEEE Std 952, scale factor",
        sizes.constant(0.02),
        reading=lambda s, exact, k, p: p["A"] * exact,
    ),
    Effect(
        "lateral_speed_bias",
        ("lateral_speed",),
        "m/s",
        "the lateral speed sensor reads A too much",
        "a lateral speed that stays at rest",
        "optical speed sensors' zero",
        sizes.constant(0.005),
        reading=lambda s, exact, k, p: p["A"] + 0 * exact,
    ),
    Effect(
        "lateral_speed_misalignment",
        ("lateral_speed",),
        "rad",
        "the lateral speed sensor is turned by A and reads a share of the forward speed",
        "a lateral speed proportional to the forward speed",
        "mounting angle of optical speed sensors",
        sizes.constant(0.01),
        reading=lambda s, exact, k, p: p["A"] * s.forward_speed[k],
    ),
)

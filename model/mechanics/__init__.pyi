from .angles import fixed_angle as fixed_angle, round_angle as round_angle
from .contact import (
    Saturation as Saturation,
    Slip as Slip,
    SoilConstants as SoilConstants,
    Wrench as Wrench,
    rim_speed as rim_speed,
    slip as slip,
    slips_across as slips_across,
    wrench as wrench,
)
from .rank import independent_columns as independent_columns
from .tree import (
    INERTIAL as INERTIAL,
    NONE_LONGER as NONE_LONGER,
    Frame as Frame,
    body_motions as body_motions,
    body_poses as body_poses,
    generalised_forces as generalised_forces,
    inertial_vector as inertial_vector,
    joint_transform as joint_transform,
    link_length as link_length,
    rot_z as rot_z,
    standard_inertia as standard_inertia,
)

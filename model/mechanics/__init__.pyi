from .contact import (
    Saturation as Saturation,
    Slip as Slip,
    Wrench as Wrench,
    rim as rim,
    slip as slip,
    wrench as wrench,
)
from .rank import independent as independent
from .tree import (
    INERTIAL as INERTIAL,
    Frame as Frame,
    generalised_forces as generalised_forces,
    inertial_vector as inertial_vector,
    motion as motion,
    place as place,
    poses as poses,
    rot_z as rot_z,
    standard_inertia as standard_inertia,
)

from .body import Body as Body, Contact as Contact, Drive as Drive, Spring as Spring
from .faults import find_faults as find_faults, with_line as with_line
from .force_loop import ForceLoop as ForceLoop, before_loop as before_loop, behind_loop as behind_loop
from .hydraulics import torque_per_pressure as torque_per_pressure
from .machine import (
    MACHINES as MACHINES,
    EffectEntry as EffectEntry,
    Filter as Filter,
    Machine as Machine,
    Tolerances as Tolerances,
    is_machine_file as is_machine_file,
    load_machine as load_machine,
    machine_files as machine_files,
    machine_tables as machine_tables,
    require_right_names as require_right_names,
    shipped_machines as shipped_machines,
)
from .meanings import MEANINGS as MEANINGS
from .noise import noise_of as noise_of, si_per_number as si_per_number
from .places import key_lines as key_lines, named as named
from .problem import Problem as Problem
from .records import (
    FileRecord as FileRecord,
    Number as Number,
    Quantity as Quantity,
    error_line as error_line,
    error_lines as error_lines,
    read_toml as read_toml,
)
from .sensor import LOG_CHECKS as LOG_CHECKS, TIME_UNITS as TIME_UNITS, Sensor as Sensor
from .surroundings import Box as Box, Plane as Plane, Shape as Shape, Tool as Tool, World as World
from .units import (
    DRIVEN_BY as DRIVEN_BY,
    PER_FORCE_CONSTANT as PER_FORCE_CONSTANT,
    PER_TORQUE_CONSTANT as PER_TORQUE_CONSTANT,
    TURN as TURN,
    UNITS as UNITS,
)

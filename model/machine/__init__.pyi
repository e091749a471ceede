from .faults import find_faults as find_faults, with_line as with_line
from .force_loop import ForceLoop as ForceLoop, before_loop as before_loop, behind_loop as behind_loop
from .hydraulics import torque_per_pressure as torque_per_pressure
from .machine import (
    LOG_CHECKS as LOG_CHECKS,
    MACHINES as MACHINES,
    TIME_UNITS as TIME_UNITS,
    Body as Body,
    Contact as Contact,
    Drive as Drive,
    EffectEntry as EffectEntry,
    Filter as Filter,
    Machine as Machine,
    Problem as Problem,
    Sensor as Sensor,
    Spring as Spring,
    load_machine as load_machine,
    machine_files as machine_files,
    machine_tables as machine_tables,
    require_right_names as require_right_names,
    shipped_machines as shipped_machines,
)
from .meanings import MEANINGS as MEANINGS
from .places import key_lines as key_lines, named as named
from .records import (
    FileRecord as FileRecord,
    Number as Number,
    Quantity as Quantity,
    error_line as error_line,
    error_lines as error_lines,
    read_toml as read_toml,
)
from .units import (
    PER_FORCE_CONSTANT as PER_FORCE_CONSTANT,
    PER_TORQUE_CONSTANT as PER_TORQUE_CONSTANT,
    TURN as TURN,
    UNITS as UNITS,
)

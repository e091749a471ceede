from .hydraulics import arms as arms
from .machine import (
    MACHINES as MACHINES,
    Body as Body,
    Contact as Contact,
    EffectEntry as EffectEntry,
    Filter as Filter,
    Machine as Machine,
    Problem as Problem,
    Sensor as Sensor,
    load_machine as load_machine,
    own_files as own_files,
    shipped_machines as shipped_machines,
)
from .records import (
    Number as Number,
    Quantity as Quantity,
    Record as Record,
    complaints as complaints,
    one_line as one_line,
    read_toml as read_toml,
)
from .units import TURN as TURN, UNITS as UNITS

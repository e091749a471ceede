from .driving_aids import prepare as prepare, serve as serve, write as write
from .ground import (
    BAND_ANGLE as BAND_ANGLE,
    BAND_S as BAND_S,
    BAND_SPEED as BAND_SPEED,
    Trace as Trace,
    phase_parts as phase_parts,
    trace_table as trace_table,
)
from .phased_design import (
    PhasedDrive as PhasedDrive,
    as_design as as_design,
    check_phase_length as check_phase_length,
    design_phases as design_phases,
)

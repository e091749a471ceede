from .driving_aids import prepare as prepare, serve as serve, write as write
from .ground import (
    BAND_ANGLE as BAND_ANGLE,
    BAND_S as BAND_S,
    BAND_SPEED as BAND_SPEED,
    Trace as Trace,
    trace_parts as trace_parts,
    trace_table as trace_table,
)
from .phased_design import Phased as Phased, as_design as as_design, check as check, phased as phased

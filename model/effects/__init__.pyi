from .catalogue import CATALOGUE as CATALOGUE
from .effect import (
    DEFAULT_DURATION as DEFAULT_DURATION,
    ContactMotion as ContactMotion,
    Effect as Effect,
    PlacedEffect as PlacedEffect,
    SampleView as SampleView,
    Shape as Shape,
    Site as Site,
    Soil as Soil,
    Values as Values,
    unit_size as unit_size,
)
from .ground_map import MAX_PASSES as MAX_PASSES, GroundMap as GroundMap
from .placing import (
    allowed_places as allowed_places,
    is_straight as is_straight,
    parse_effect as parse_effect,
    payload_body as payload_body,
    payload_change as payload_change,
    place_effect as place_effect,
    shapes_possible as shapes_possible,
    size_warning as size_warning,
    with_effects as with_effects,
    without_effect as without_effect,
)
from .sizes import GRAVITY as GRAVITY, duration as duration, large_torque as large_torque
from .tables import (
    MAP_NODES as MAP_NODES,
    SOIL_SIGNALS as SOIL_SIGNALS,
    soil_table as soil_table,
    table_angles as table_angles,
    torque_table as torque_table,
)

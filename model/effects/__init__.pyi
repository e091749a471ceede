from .catalogue import CATALOGUE as CATALOGUE
from .effect import (
    DURATION as DURATION,
    Effect as Effect,
    Placed as Placed,
    Rolling as Rolling,
    Scene as Scene,
    Shape as Shape,
    Site as Site,
    Soil as Soil,
    Values as Values,
    one as one,
)
from .ground_map import MOST as MOST, Ground as Ground
from .placing import (
    doubtful as doubtful,
    extended as extended,
    parse as parse,
    placed as placed,
    places as places,
    possible as possible,
    shifted as shifted,
    shifting as shifting,
    without as without,
)
from .sizes import GRAVITY as GRAVITY, duration as duration, full_torque as full_torque

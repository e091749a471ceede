from .bias import SURE as SURE
from .delays import late_channels as late_channels
from .estimate import Estimate as Estimate
from .filter_choice import FILTERS as FILTERS
from .identifiability import unmoved as unmoved
from .joint import DISTURBED as DISTURBED, suspects as suspects
from .methods import (
    METHODS as METHODS,
    identify as identify,
    measurable as measurable,
    needed_sensors as needed_sensors,
    recommended as recommended,
    with_bias as with_bias,
)
from .monte_carlo import (
    Verification as Verification,
    biased as biased,
    summarise_runs as summarise_runs,
    verify as verify,
)
from .prior import known_before as known_before
from .validation import (
    Comparison as Comparison,
    far_from_nominal as far_from_nominal,
    motions as motions,
    torques as torques,
)

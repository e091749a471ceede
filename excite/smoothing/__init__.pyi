from .cramer_rao import cramer_rao as cramer_rao
from .gauss_newton import (
    DAMPING as DAMPING,
    ENOUGH as ENOUGH,
    NEARLY as NEARLY,
    PASSES as PASSES,
    PRIOR as PRIOR,
    RESUMED as RESUMED,
    SETTLED as SETTLED,
    STRONG as STRONG,
    UNSEEN as UNSEEN,
    Fit as Fit,
    NotConverged as NotConverged,
    in_si as in_si,
    iterate as iterate,
    linearise_fit as linearise_fit,
    linearised as linearised,
    prior_information as prior_information,
    state_scale as state_scale,
)
from .innovations import (
    Linear as Linear,
    White as White,
    innovation_sizes as innovation_sizes,
    whitened as whitened,
    whitened_signatures as whitened_signatures,
)
from .linearisation import (
    BATCH as BATCH,
    Batch as Batch,
    Chart as Chart,
    advance as advance,
    chart as chart,
    differentiate as differentiate,
)
from .measurements import (
    Noise as Noise,
    Point as Point,
    Record as Record,
    carried as carried,
    common_sensors as common_sensors,
    expected as expected,
    first_point as first_point,
    noise_notes as noise_notes,
    origins as origins,
    readings as readings,
    record as record,
    smoothed as smoothed,
    torque_sensor as torque_sensor,
)
from .uncertainty import sure as sure

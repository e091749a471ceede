from .cramer_rao import cramer_rao as cramer_rao
from .discrepancy import build_basis as build_basis
from .forward import (
    interpolate as interpolate,
    state_scale as state_scale,
)
from .innovations import (
    LinearisedLog as LinearisedLog,
    WhitenedInnovations as WhitenedInnovations,
    innovation_statistics as innovation_statistics,
    log_variance as log_variance,
    whiten as whiten,
    whiten_signatures as whiten_signatures,
)
from .inverse_chain import torque_sensors as torque_sensors
from .inverse_fit import InverseFit as InverseFit, InverseSettings as InverseSettings, fit_inverse as fit_inverse
from .linearisation import (
    BATCH_SIZE as BATCH_SIZE,
    SLOPES as SLOPES,
    BatchedFunction as BatchedFunction,
    StateSpace as StateSpace,
    build_state_space as build_state_space,
    feature_names as feature_names,
)
from .log_fit import (
    ACCEPTABLE_STEP as ACCEPTABLE_STEP,
    MAX_IDENTIFIABLE_STD as MAX_IDENTIFIABLE_STD,
    PRIOR_STD as PRIOR_STD,
    Fit as Fit,
    NotConvergedError as NotConvergedError,
    apply_step as apply_step,
    fit_logs as fit_logs,
    linearise_logs as linearise_logs,
    linearise_with as linearise_with,
    newton_step as newton_step,
    prior_information as prior_information,
    prior_terms as prior_terms,
)
from .measurements import (
    Measurements as Measurements,
    SensorNoise as SensorNoise,
    Trajectory as Trajectory,
    common_sensors as common_sensors,
    describe_noise as describe_noise,
    encoders_with_offset as encoders_with_offset,
    initial_trajectory as initial_trajectory,
    predict_readings as predict_readings,
    prepare_logs as prepare_logs,
    prepare_measurements as prepare_measurements,
    root_mean_square as root_mean_square,
    smoothed_motion as smoothed_motion,
    torque_sensor as torque_sensor,
    transfer_trajectory as transfer_trajectory,
)
from .sizes import (
    SIZE_SCATTER as SIZE_SCATTER,
    FitBeside as FitBeside,
    average_over_sizes as average_over_sizes,
    fit_unknown_forces as fit_unknown_forces,
    lacks_forces as lacks_forces,
    sizes_step as sizes_step,
)
from .solver import Settings as Settings
from .tails import (
    has_heavy_tails as has_heavy_tails,
    normal_scores as normal_scores,
)
from .transitions import (
    Transitions as Transitions,
    differentiate as differentiate,
    integrate as integrate,
)
from .uncertainty import quantify_uncertainty as quantify_uncertainty
from .unknown_forces import (
    Group as Group,
    Lacking as Lacking,
    Missing as Missing,
    UnknownForces as UnknownForces,
    catalogue as catalogue,
    describe_missing as describe_missing,
)

from .cramer_rao import cramer_rao as cramer_rao
from .gauss_newton import (
    ACCEPTABLE_STEP as ACCEPTABLE_STEP,
    CLOSE_FIT_COST_RATIO as CLOSE_FIT_COST_RATIO,
    INITIAL_DAMPING as INITIAL_DAMPING,
    MAX_IDENTIFIABLE_STD as MAX_IDENTIFIABLE_STD,
    MAX_PASSES as MAX_PASSES,
    PRIOR_STD as PRIOR_STD,
    RESUMED_DAMPING as RESUMED_DAMPING,
    SETTLING_PASSES as SETTLING_PASSES,
    SUFFICIENT_STEP as SUFFICIENT_STEP,
    Fit as Fit,
    NotConvergedError as NotConvergedError,
    apply_step as apply_step,
    covariance_in_si as covariance_in_si,
    fit_logs as fit_logs,
    linearise_log as linearise_log,
    linearise_logs as linearise_logs,
    prior_information as prior_information,
    prior_terms as prior_terms,
    state_scale as state_scale,
)
from .innovations import (
    LinearisedLog as LinearisedLog,
    WhitenedInnovations as WhitenedInnovations,
    innovation_statistics as innovation_statistics,
    whiten as whiten,
    whiten_signatures as whiten_signatures,
)
from .linearisation import (
    BATCH_SIZE as BATCH_SIZE,
    BatchedFunction as BatchedFunction,
    StateSpace as StateSpace,
    advance as advance,
    build_state_space as build_state_space,
    differentiate as differentiate,
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
    smoothed_motion as smoothed_motion,
    torque_sensor as torque_sensor,
    transfer_trajectory as transfer_trajectory,
    with_mean_edge_rates as with_mean_edge_rates,
)
from .uncertainty import quantify_uncertainty as quantify_uncertainty

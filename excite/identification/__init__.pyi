from .agreement import (
    Agreement as Agreement,
    compare_logs as compare_logs,
    compare_sources as compare_sources,
    describe_agreement as describe_agreement,
    describe_changes as describe_changes,
    group_by_file as group_by_file,
    summarise_agreement as summarise_agreement,
)
from .bias import (
    SIGNIFICANT_BIAS as SIGNIFICANT_BIAS,
    measured_again as measured_again,
    simulate_along_log as simulate_along_log,
)
from .consistency import possible_standard as possible_standard
from .delays import describe_late_channels as describe_late_channels
from .estimate import Discrepancy as Discrepancy, Estimate as Estimate, FitTest as FitTest, widen as widen
from .identifiability import parameters_at_rest as parameters_at_rest
from .inverse_estimate import recommend_method as recommend_method
from .joint import (
    find_suspect_sensors as find_suspect_sensors,
    shows_sticking as shows_sticking,
)
from .least_squares import Solution as Solution
from .linear_methods import (
    filtered_blocks as filtered_blocks,
    fit_rows as fit_rows,
    restore_tied_parameters as restore_tied_parameters,
    solve_blocks as solve_blocks,
)
from .methods import (
    METHODS as METHODS,
    add_bias as add_bias,
    corrected_logs as corrected_logs,
    identify as identify,
    needed_sensors as needed_sensors,
    require_sensors as require_sensors,
    unused_sensors as unused_sensors,
)
from .monte_carlo import (
    Verification as Verification,
    biased_parameters as biased_parameters,
    identify_table as identify_table,
    summarise_runs as summarise_runs,
    verify as verify,
)
from .near_rest import moving_rows as moving_rows, sticking as sticking, with_soft_friction as with_soft_friction
from .noise_propagation import row_errors as row_errors, row_levels as row_levels
from .payload import (
    Payload as Payload,
    payload_change as payload_change,
    payload_parameters as payload_parameters,
    rigid_parameters as rigid_parameters,
    told_apart as told_apart,
)
from .prediction import Prediction as Prediction, predict_motion as predict_motion, predict_torques as predict_torques
from .prior import prior_from_estimate as prior_from_estimate, prior_from_logs as prior_from_logs
from .saved_estimate import (
    SavedEstimate as SavedEstimate,
    read_estimate as read_estimate,
    write_estimate as write_estimate,
)
from .slip_laws import SlipFit as SlipFit, SlipLaw as SlipLaw, fit_slip_laws as fit_slip_laws, soil_law as soil_law
from .status import add_consistent as add_consistent
from .torque_constant import TorqueConstant as TorqueConstant, torque_constant as torque_constant
from .validation import (
    SignalComparison as SignalComparison,
    compare_motions as compare_motions,
    compare_torques as compare_torques,
    far_from_nominal as far_from_nominal,
    torque_errors as torque_errors,
    validate_torques as validate_torques,
)

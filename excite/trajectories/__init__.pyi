from .accuracy_bound import (
    AccuracyBound as AccuracyBound,
    bound_accuracy as bound_accuracy,
    bound_refusal as bound_refusal,
)
from .baselines import (
    BASELINES as BASELINES,
    DESIGNED as DESIGNED,
    Comparison as Comparison,
    ComparisonRow as ComparisonRow,
    compare as compare,
)
from .campaign import Campaign as Campaign, CampaignTrial as CampaignTrial, design_campaign as design_campaign
from .clearance import (
    body_frames as body_frames,
    has_shapes as has_shapes,
    pairs_left_out as pairs_left_out,
    placed_shapes as placed_shapes,
    random_poses as random_poses,
    tool_point as tool_point,
)
from .composite_objective import (
    COND_MAX as COND_MAX,
    SIGMA_MAX as SIGMA_MAX,
    CompositeObjective as CompositeObjective,
    calibrate_surrogates as calibrate_surrogates,
    compose_objective as compose_objective,
    covariance_bound as covariance_bound,
    information_matrices as information_matrices,
    local_model as local_model,
    motion_bound as motion_bound,
    rival_contrasts as rival_contrasts,
    score_matrices as score_matrices,
    score_motions as score_motions,
    sigma_percent as sigma_percent,
    surrogate_ratio as surrogate_ratio,
)
from .continuation import SOLVERS as SOLVERS
from .drive_search import design_drive as design_drive
from .excitation import Manoeuvre as Manoeuvre, multisine as multisine, scale_torques as scale_torques
from .joint_motion import JointMotion as JointMotion, MotionProgram as MotionProgram, between_samples as between_samples
from .joint_search import (
    TRAJECTORIES as TRAJECTORIES,
    check_joint_motion as check_joint_motion,
    design_joint_motion as design_joint_motion,
)
from .lane import (
    move_motion as move_motion,
    place_along_lane as place_along_lane,
    place_on_lane as place_on_lane,
    simulate_on_lane as simulate_on_lane,
)
from .limits import (
    DURATION_LIMIT as DURATION_LIMIT,
    LIMITS as LIMITS,
    MOTION_LIMITS as MOTION_LIMITS,
    REST_POSITION as REST_POSITION,
    REVERSALS_LIMIT as REVERSALS_LIMIT,
    TOLERANCE as TOLERANCE,
    Limit as Limit,
    check_limits as check_limits,
    describe_excess as describe_excess,
    excesses_in_units as excesses_in_units,
    is_lane_limit as is_lane_limit,
    is_rest_limit as is_rest_limit,
    keeps_motion_limits as keeps_motion_limits,
    lane_excess as lane_excess,
    machine_limits as machine_limits,
    rest_tolerances as rest_tolerances,
    resting_coordinates as resting_coordinates,
    stack_limits as stack_limits,
)
from .multistart import (
    BestSoFar as BestSoFar,
    Design as Design,
    Report as Report,
    design as design,
    process_count as process_count,
)
from .objective import (
    OBJECTIVES as OBJECTIVES,
    cond_phi as cond_phi,
    cond_w as cond_w,
    contrast_variances as contrast_variances,
    describe_value as describe_value,
    is_condition_number as is_condition_number,
    reference_values as reference_values,
    relative_std_percent as relative_std_percent,
    reported_value as reported_value,
    row_noise as row_noise,
)
from .prediction_contrasts import prediction_contrasts as prediction_contrasts
from .rehearsal import (
    JointCourse as JointCourse,
    PlannedMotion as PlannedMotion,
    Rehearsal as Rehearsal,
    clearances as clearances,
    planned_motion as planned_motion,
    rehearse as rehearse,
)
from .saved_design import (
    SavedDesign as SavedDesign,
    read_design as read_design,
    read_design_model as read_design_model,
    read_design_summary as read_design_summary,
)
from .scoring import Score as Score, score as score, score_motion as score_motion
from .sensor_value import SensorValue as SensorValue, value_sensors as value_sensors

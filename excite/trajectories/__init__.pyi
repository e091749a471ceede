from .baselines import OURS as OURS, USUAL as USUAL, Comparison as Comparison, Row as Row, compare as compare
from .composite_objective import (
    Aim as Aim,
    aim as aim,
    calibrated as calibrated,
    information as information,
    judge as judge,
    local as local,
    optimism as optimism,
    sigma_percent as sigma_percent,
    value as value,
)
from .excitation import Manoeuvre as Manoeuvre, multisine as multisine, scaled as scaled
from .limits import (
    KINDS as KINDS,
    REST_POSITION as REST_POSITION,
    REVERSALS as REVERSALS,
    TOLERANCE as TOLERANCE,
    WHOLE as WHOLE,
    check_limits as check_limits,
    kept_between as kept_between,
    lane_excess as lane_excess,
    machine_limits as machine_limits,
    of_rest as of_rest,
    placed as placed,
    rest_tolerances as rest_tolerances,
    resting as resting,
    stacked as stacked,
)
from .multistart import Design as Design, design as design, processes as processes
from .objective import (
    OBJECTIVES as OBJECTIVES,
    cond_phi as cond_phi,
    cond_w as cond_w,
    conditions as conditions,
    percent as percent,
    reported as reported,
    titled as titled,
)
from .saved_design import Stored as Stored, read_design as read_design, read_design_summary as read_design_summary

from .driver import STEADY_DRIVER as STEADY_DRIVER, Driver as Driver, follow as follow, left_turn_sign as left_turn_sign
from .integrator import (
    FRICTION_LAWS as FRICTION_LAWS,
    Motion as Motion,
    effect_inputs as effect_inputs,
    respond as respond,
    simulate as simulate,
)
from .position_control import (
    follow_positions as follow_positions,
    inverse_dynamics as inverse_dynamics,
    motion_along as motion_along,
    play_back as play_back,
)
from .scenarios import perturbed_machines as perturbed_machines, track_motion as track_motion
from .sensors import (
    KITS as KITS,
    delivered_torque as delivered_torque,
    delivered_torques as delivered_torques,
    exact_readings as exact_readings,
    measure as measure,
    measured_torque as measured_torque,
    measured_torques as measured_torques,
    smooth_part as smooth_part,
)
from .slip import (
    outside_law as outside_law,
    resultant_slips as resultant_slips,
    share_outside_law as share_outside_law,
)

from .driver import STEADY as STEADY, Driver as Driver, follow as follow, turns_left as turns_left
from .integrator import Motion as Motion, beside as beside, respond as respond, simulate as simulate
from .rosenbrock import (
    A_ROWS as A_ROWS,
    C_ROWS as C_ROWS,
    GAMMA as GAMMA,
    SLOPES as SLOPES,
    TIMES as TIMES,
    lu as lu,
    lu_solve as lu_solve,
)
from .scenarios import followed as followed, perturbed_machines as perturbed_machines
from .sensors import (
    KITS as KITS,
    measure as measure,
    signals as signals,
    torque_behind as torque_behind,
    torques_behind as torques_behind,
    torques_read as torques_read,
)

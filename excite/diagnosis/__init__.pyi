from .curves import Curve as Curve
from .diagnosis import Diagnosis as Diagnosis, diagnose as diagnose
from .false_alarms import FalseAlarms as FalseAlarms, count_false_alarms as count_false_alarms
from .findings import (
    Assessment as Assessment,
    assess as assess,
    explain as explain,
    machine_file as machine_file,
    summarise as summarise,
)
from .parallel import run_forked as run_forked
from .residuals import (
    BLOCK_S as BLOCK_S,
    MIN_BIN_SAMPLES as MIN_BIN_SAMPLES,
    LogResiduals as LogResiduals,
    amplitude_spectrum as amplitude_spectrum,
    bin_means as bin_means,
    dependence_strength as dependence_strength,
    innovation_levels_over_time as innovation_levels_over_time,
    residuals_of_logs as residuals_of_logs,
)
from .separating_run import RivalPair as RivalPair, rival_pairs as rival_pairs
from .torque_regression import TorqueDiagnosis as TorqueDiagnosis

from .diagnosis import Diagnosis as Diagnosis, diagnose as diagnose
from .findings import Account as Account, account as account, machine_file as machine_file, summarise as summarise
from .parallel import forked as forked
from .residuals import (
    BLOCK_S as BLOCK_S,
    FEWEST as FEWEST,
    Course as Course,
    binned as binned,
    courses as courses,
    loosened as loosened,
    over_time as over_time,
    spectrum as spectrum,
    strength as strength,
)
from .separating_run import Rivals as Rivals, rivals as rivals

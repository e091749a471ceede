from .conversion import convert as convert, table_from as table_from
from .filtered import (
    BLOCK as BLOCK,
    Samples as Samples,
    decimate as decimate,
    derivative as derivative,
    filtered_regression as filtered_regression,
    implicit as implicit,
    integrate_pose as integrate_pose,
    kept_samples as kept_samples,
    lowpass as lowpass,
    passes as passes,
    planar_speed_sensors as planar_speed_sensors,
    regression as regression,
    remember as remember,
    samples as samples,
    unmeasured as unmeasured,
)
from .formats import ENDINGS as ENDINGS, FORMATS as FORMATS, SUFFIXES as SUFFIXES, Format as Format
from .inspection import Inspection as Inspection, guess_machine as guess_machine, inspect as inspect
from .log import (
    Log as Log,
    from_table as from_table,
    read_log as read_log,
    table_of as table_of,
    white_noise as white_noise,
)
from .outliers import stretches as stretches
from .plausibility import doubts_in_errors as doubts_in_errors
from .preparation import Prepared as Prepared, prepare as prepare, read_stretches as read_stretches
from .profile import (
    PlannedDrive as PlannedDrive,
    drive_file as drive_file,
    is_profile as is_profile,
    motion_columns as motion_columns,
    profile_of as profile_of,
    read_drive as read_drive,
    read_profile as read_profile,
    torque_column as torque_column,
)
from .repair import examine as examine, is_needed as is_needed, moves as moves
from .slip_table import (
    SLIP_PER as SLIP_PER,
    SLIP_ROLES as SLIP_ROLES,
    SlipTable as SlipTable,
    read_slip_table as read_slip_table,
)
from .tables import read_table as read_table

from .campaign_workflow import (
    CampaignRequest as CampaignRequest,
    campaign as campaign,
    campaign_account as campaign_account,
    campaign_from as campaign_from,
    check_campaign as check_campaign,
    read_targets as read_targets,
)
from .collision_shapes import add_shapes as add_shapes, things_around as things_around
from .design_request import (
    DesignRequest as DesignRequest,
    design_from as design_from,
    require_noise_figures as require_noise_figures,
    without_hidden_zeros as without_hidden_zeros,
)
from .design_workflow import (
    compare as compare,
    compare_from as compare_from,
    design as design,
    design_account as design_account,
    is_own_drive as is_own_drive,
    prepare_design as prepare_design,
    read_rivals as read_rivals,
)
from .diagnose_workflow import (
    DiagnoseResult as DiagnoseResult,
    diagnose as diagnose,
    diagnose_account as diagnose_account,
    diagnose_from as diagnose_from,
    rivals as rivals,
    separating_drive as separating_drive,
)
from .fmi_model import MODEL_WRITERS as MODEL_WRITERS
from .handover_workflow import hand_over as hand_over
from .identify_workflow import (
    identify as identify,
    identify_account as identify_account,
    identify_from as identify_from,
)
from .machine_check import check_machine as check_machine
from .predict_workflow import predict as predict, predict_account as predict_account, predict_from as predict_from
from .progress import PROGRESS_VARIABLE as PROGRESS_VARIABLE, Advance as Advance
from .requests import (
    arm_problems as arm_problems,
    build_model as build_model,
    choices as choices,
    choose_method as choose_method,
    choose_problem as choose_problem,
    help_with_choices as help_with_choices,
    machine_stem as machine_stem,
    package_versions as package_versions,
    require_known as require_known,
    require_objective as require_objective,
    require_positive as require_positive,
)
from .score_workflow import (
    excesses as excesses,
    judge_limits as judge_limits,
    score as score,
    score_from as score_from,
)
from .simulate_workflow import doubtful_effects as doubtful_effects, with_effects as with_effects
from .slip_workflow import slip as slip, slip_account as slip_account
from .study_plan import Study as Study, read_study as read_study
from .study_runner import run_study as run_study
from .urdf import machine_from_urdf as machine_from_urdf, urdf_with_estimate as urdf_with_estimate
from .verify_workflow import verify as verify, verify_account as verify_account

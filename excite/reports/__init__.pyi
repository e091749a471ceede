from .charts import Explorable as Explorable
from .description import (
    Description as Description,
    Table as Table,
    as_sentence as as_sentence,
    describe_drive_faults as describe_drive_faults,
    format_sum as format_sum,
)
from .descriptions import describe as describe, with_sentences as with_sentences
from .design_figures import (
    campaign_figure as campaign_figure,
    compare_figure as compare_figure,
    design_figure as design_figure,
    draw_campaign as draw_campaign,
    sensors_figure as sensors_figure,
    sigma_figure as sigma_figure,
)
from .diagnosis_figures import (
    figure_calls as figure_calls,
    figures_by_file as figures_by_file,
    signals_figure as signals_figure,
)
from .figure_files import (
    FigureFiles as FigureFiles,
    read_formats as read_formats,
    read_width as read_width,
    writing_figures as writing_figures,
)
from .figures import (
    COLOURS as COLOURS,
    budget_figure as budget_figure,
    comparison_figure as comparison_figure,
    correlation_figure as correlation_figure,
    is_narrow as is_narrow,
    legend_above as legend_above,
    legend_below as legend_below,
    new_figure as new_figure,
    prediction_figure as prediction_figure,
    prior_figure as prior_figure,
    save as save,
    set_title as set_title,
    verify_figure as verify_figure,
    wrap_label as wrap_label,
)
from .handover_descriptions import rehearsal_words as rehearsal_words
from .html import (
    Picture as Picture,
    report_page as report_page,
    result_fragment as result_fragment,
    templates as templates,
)
from .log_check import check_log as check_log, log_account as log_account, log_frame as log_frame
from .motion_view import (
    MOTION_PAGE as MOTION_PAGE,
    motion_scene as motion_scene,
    write_motion_page as write_motion_page,
)
from .pages import (
    REPORT as REPORT,
    folder_pictures as folder_pictures,
    provenance as provenance,
    write_report as write_report,
)
from .plain_text import PIPE_WIDTH as PIPE_WIDTH, text_parts as text_parts, text_table as text_table
from .results import (
    Account as Account,
    Shown as Shown,
    ShownAssessment as ShownAssessment,
    ShownCampaign as ShownCampaign,
    ShownComparison as ShownComparison,
    ShownDesign as ShownDesign,
    ShownDrive as ShownDrive,
    ShownEstimate as ShownEstimate,
    ShownLog as ShownLog,
    ShownPrediction as ShownPrediction,
    ShownScore as ShownScore,
    ShownSlip as ShownSlip,
    ShownVerification as ShownVerification,
    drive_frame as drive_frame,
    joints_frame as joints_frame,
    rows_frame as rows_frame,
)
from .slip_figure import slip_figure as slip_figure
from .top_view import footprints as footprints, steered_joints as steered_joints, top_view_figure as top_view_figure

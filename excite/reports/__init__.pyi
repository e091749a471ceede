from .descriptions import (
    Description as Description,
    Table as Table,
    as_sentence as as_sentence,
    describe as describe,
    describe_drive_faults as describe_drive_faults,
    format_sum as format_sum,
)
from .diagnosis_figures import figure_calls as figure_calls, signals_figure as signals_figure
from .figures import (
    COLOURS as COLOURS,
    compare_figure as compare_figure,
    comparison_figure as comparison_figure,
    design_figure as design_figure,
    escape_dollar as escape_dollar,
    prediction_figure as prediction_figure,
    save as save,
    sigma_figure as sigma_figure,
    verify_figure as verify_figure,
)
from .html import Picture as Picture, report_page as report_page, templates as templates
from .pages import REPORT as REPORT, check_log as check_log, write_report as write_report
from .top_view import footprints as footprints, steered_joints as steered_joints, top_view_figure as top_view_figure

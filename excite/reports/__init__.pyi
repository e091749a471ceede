from .diagnosis_figures import drawings as drawings, signals_figure as signals_figure
from .figures import (
    COLOURS as COLOURS,
    compare_figure as compare_figure,
    comparison_figure as comparison_figure,
    design_figure as design_figure,
    plain as plain,
    save as save,
    sigma_figure as sigma_figure,
    verify_figure as verify_figure,
)
from .html import Picture as Picture, Table as Table, report_page as report_page, templates as templates
from .pages import (
    ESTIMATE as ESTIMATE,
    REPORT as REPORT,
    check_log as check_log,
    how as how,
    write_report as write_report,
)
from .top_view import footprints as footprints, steered as steered, top_view_figure as top_view_figure

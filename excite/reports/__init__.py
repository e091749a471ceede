"""Results for people: figures, and one description of each kind of summary for the terminal and report.html.

- `describe` turns a summary into a `Description`: title, headline, tables, remarks.
- `write_report` writes report.html (with the figures of the folder) and summary.json; `report_page` renders any page.
- `design_figure`, `verify_figure`, `comparison_figure` and others draw figures; `save` writes them without a date, so
  that the same data give the same bytes.
- `check_log` checks a log into a folder.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

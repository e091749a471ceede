"""The work of the commands: each step reads its input, computes, and fills a folder with files, figures and a report.

- `design`, `compare`, `verify`, `identify`, `predict`, `diagnose`, `check_machine` are the steps. Each takes the
  folder, what to work on, options and a progress bar, and returns the summary that it wrote to summary.json.
- `design_from`, `identify_from`, `predict_from`, `diagnose_from` do the same computation without files, for
  `excite.interface`; `design_account` and its like give an account of the result, which the steps write.
- `read_study` checks a study file, `run_study` carries it out on all cores or a cluster and resumes it.
- `build_model`, `choose_problem`, `choose_method` and `require_...` check what was asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

"""The command line: `app` holds the commands, which call `excite.workflows` and describe the result.

A command prints a description of its result, or with --json its summary and nothing else. Errors are one line on
stderr (`fail`); exit codes are those of the errors' classes. Reference pages (`excite docs`) are made from the code.
Modules load without numpy or CasADi, so that help and completion take no time.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

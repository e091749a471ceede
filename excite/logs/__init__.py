"""Logs and profiles: from files as loggers write them to checked measurements on an even grid of time.

`prepare` is the way in for every command: it reads files, tables or logs (`tables`), understands their times in any
notation (`times`), orders the rows (`time_axis`), brings them onto an even grid and cuts them at gaps (`resampling`),
and returns checked `Log` records with the model at their rate (`preparation`). `from_table` is the strict version for
rows that are even already, such as simulated ones.

`inspect` lists everything that is wrong or doubtful in a log; `examine` repairs spikes and notes drop-outs before an
estimate. `regression` and `samples` give the filtered, decimated rows of the linear methods; `read_profile`,
`read_drive` and `profile_of` read and write drives, `is_profile` tells one from a log.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

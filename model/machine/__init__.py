"""The machine file: a TOML file read into frozen, checked records.

`load_machine` takes the name of a shipped machine or a path and returns a `Machine`: bodies with joints, inertia,
friction and contacts (`Body`, `Contact`), sensors and their log columns (`Sensor`), the default filter (`Filter`),
design problems (`Problem`) and effects (`EffectEntry`). A file may extend another and give only what differs.

Every number is a `Quantity` with its source, in SI units; columns of logs may be in any of `UNITS`. Other files of the
program build on the same strict `FileRecord`; `error_line` and `error_lines` turn its validation errors into messages.
`torque_per_pressure` converts hydraulic pressures to torque.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

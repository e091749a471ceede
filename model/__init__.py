"""The model of a machine: from a machine file to equations, parameters and their regressor.

    machine = load_machine("va12")   # excite.model.machine
    model = build(machine)

A `Model` predicts every row of the equations of motion. Its regressor is the exact Jacobian of that prediction to the
base parameters X, which `build` finds numerically (Gautier, 1991): Y = W X. The same equations, solved for the
accelerations, serve simulation, design and smoothing. `build_cached` keeps models in a process,
`parameter_descriptions` explains parameters in words, `required_signs` gives the signs they must have, and `signatures`
gives the contribution of single effects for diagnosis.

Packages: `machine` (the machine file), `mechanics` (rigid bodies and contacts), `effects` (what real machines have
beyond the plain model).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

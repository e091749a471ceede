"""Effects: what real machines have beyond the plain model, each declared once.

`CATALOGUE` holds one `Effect` per name. It declares the places where the effect may sit, its magnitude A and `Shape`s,
and hooks for its action on one sample, a `SampleView`: torque, soil, gravity, inertia, sensor readings or torque
channels, with memory states if it needs them. Simulation, regressor, smoothing, diagnosis and documentation all use
that declaration.

`allowed_places` lists the places on a machine, and `place_effect` checks an entry of a machine file and returns a
`PlacedEffect`. `parse_effect` reads `NAME[@WHERE]=AMOUNT`; `with_effects` and `without_effect` change a machine.
`GroundMap` counts passes over the ground for effects that depend on them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

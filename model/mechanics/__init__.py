"""Mechanics as CasADi expressions: trees of rigid bodies and contacts with the soil.

`body_motions` computes the motion of every body (forward recursion of Newton-Euler), `generalised_forces` the forces
behind it (backward recursion), linear in the standard inertial parameters `INERTIAL`. `joint_transform` and
`body_poses` give the geometry, `standard_inertia` and `inertial_vector` the parameters of a body.

`slip` and `wrench` are the contact law of the paper, linear (24, 25) or with a `Saturation` such as the exponential one
(18). `slips_across` gives the slips at the edges of a contact, where the linear law ends first. `independent_columns`
finds the independent columns of a regressor.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

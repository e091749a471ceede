"""Simulation: motions from torques or from a driver, and the logs that sensors make of them.

`simulate` integrates a model under given torques and returns a `Motion`; `respond` does so under feedback. Dry friction
follows one of `FRICTION_LAWS`: smoothed at reversals, or set-valued, so that joints stick. `follow` puts a person at
the levers, a `Driver` with preview, delay and slow errors. `measure` turns a motion into the log of a sensor kit
(`KITS`) with quantisation, noise and offsets; `exact_readings` leaves these out. `measured_torques` and
`delivered_torques` convert between the motors' torques and the readings of their channels (`smooth_part`: without
most of their noise). `share_outside_law` says how
much of a motion lies beyond the linear soil law.

`play_back` simulates a drive as its machine follows it: arms under gravity follow positions (`follow_positions`,
`inverse_dynamics`, `motion_along`), others torques.

For robust design, `perturbed_machines` draws machines around the nominal one, and `track_motion` simulates how each
follows a nominal motion. The integrator is the Rosenbrock method RODAS.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

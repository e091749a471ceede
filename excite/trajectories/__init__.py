"""Excitation trajectories: torque profiles that make every parameter of a machine identifiable within its limits.

- `design` searches for a profile (`Manoeuvre`) from several random starts and returns a `Design`: the profile, its
  simulated motion and scores, and the excess over every limit.
- OBJECTIVES holds the scores to minimise, functions of the information matrix. `compose_objective` combines one with an
  accuracy to reach, information from earlier logs, or several possible machines (`CompositeObjective`).
- LIMITS holds the limits of a motion; `check_limits` gives the excess over each.
- `compare` sets a design against the usual drives in BASELINES: multisines, Fourier series, a hand-made drive.
- `score` judges any drive as a design is (`Score`): condition numbers, attainable accuracy, excess over every limit.
- `read_design` reads the folder of a design back (`SavedDesign`).
- `bound_accuracy` bounds the accuracy of every drive of a machine with one driven joint.
- `design_joint_motion` designs arms under gravity, as motions of their joints (`TRAJECTORIES`).

A design is a direct collocation (`collocation`), solved by an interior-point method (`interior_point`) in stages from a
smooth problem to the real machine (`continuation`). Every score is that of a fresh simulation.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

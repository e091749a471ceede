"""Trajectories, parameters and their uncertainty from logs: maximum likelihood by smoothing.

A log is explained by states, torque errors and parameters at once (errors in variables). The package holds the
numerical method; `excite.identification` and `excite.diagnosis` decide what to fit.

- `build_state_space` turns a model and its sensors into a `StateSpace`: states, readings and their derivatives.
- `prepare_measurements` and `initial_trajectory` turn a log into `Measurements` and a first `Trajectory`.
- `fit_logs` finds the most likely parameters and trajectories by Levenberg-Marquardt and returns a `Fit` with a status.
  Each pass linearises every log (`LinearisedLog`) and smooths it with the parallel smoother.
- `fit_unknown_forces` does so beside forces that the model lacks, whose sizes it finds by marginal likelihood.
- `fit_inverse` fits machines whose joints are all driven: the motion is a smooth process, the torque
  read is the model's along it.
- `quantify_uncertainty` adds encoder errors and profile likelihood to a fit's covariance.
- `innovation_statistics` says whether model and noise explain a log; `whiten` and `whiten_signatures` give the
  innovations with which other effects are tested.
- `cramer_rao` gives the covariance that a motion and its sensors allow, without any log.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

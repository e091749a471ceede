"""Parameters of a machine from its logs, with their uncertainty.

- `identify` estimates the base parameters from logs by one of `METHODS` and returns an `Estimate`: maximum likelihood
  (inverse for fully driven machines, joint for others), least squares (ols, the paper's method), and inverse or ols
  restricted to physically possible machines (`inverse+consistent`, `ols+consistent`). `recommend_method` names the
  method for a machine, `needed_sensors` what it must have measured.
- `verify` simulates a motion with sensor noise many times and identifies from each log (`Verification`), which shows
  bias, dispersion and coverage of the intervals.
- `add_bias` estimates the bias of a method on given logs from simulated ones.
- `compare_sources` and `compare_logs` test whether one set of parameters explains several logs, and name what changed
  (`Agreement`).
- `compare_torques` and `compare_motions` test an estimate on another log (`SignalComparison`).
- `predict_torques` and `predict_motion` predict signals along a log or a profile, with 95 % bands (`Prediction`);
  `write_estimate` and `read_estimate` keep an estimate in a folder for that.
- `prior_from_logs` makes an estimate the prior of the next design.
- `describe_late_channels`, `far_from_nominal` and `parameters_at_rest` find faults of logs that spoil an estimate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

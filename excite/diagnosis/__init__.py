"""Causes of what a model gets wrong, named from logs.

- `explain` asks for the causes of logs, by the torques where all joints are driven, else by joint smoothing
  (`Assessment`).
- `diagnose` fits a machine's model to logs, tests every effect that the model lacks, and adds the ones that explain the
  logs: a `Diagnosis` with a verdict, findings, anomalies and causes that the logs cannot tell apart.
- `assess` measures what the findings gain, signal by signal and on withheld data (`Assessment`); `summarise` gives the
  summary and `machine_file` the extended machine file.
- `rival_pairs` names the run that would separate causes that explain the logs about as well (`RivalPair`).
- `residuals_of_logs` gives the torques, forces and innovations that the model does not explain (`LogResiduals`), and
  `dependence_strength`, `bin_means` and `amplitude_spectrum` show on what they depend.
- `TorqueDiagnosis` is what torques tell: rows and columns of effects (`torque_rows`), fits and their whitening
  (`torque_fit`), the choice of effects (`torque_search`), smooth curves of what is left (`torque_curves`). Both kinds
  of diagnosis choose by `evidence`; the curves of a machine on soil are in `soil_curves`.
- `run_forked` runs independent fits side by side.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

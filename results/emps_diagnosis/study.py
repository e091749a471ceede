"""Measure the gain of friction effects on EMPS on data withheld from the fit.

python results/emps_diagnosis/study.py [DATA_EMPS.mat] [--out FOLDER] writes heldout.json. With the published
processing, each model is fitted by least squares to one half of the log and predicts the force of the other half, both
ways round. Intervals come from a bootstrap over stretches of one second.
"""

from __future__ import annotations

# ruff: noqa: E402  (the folder of shared helpers comes first)
import argparse
import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import numpy as np
from support import studies

from excite.logs import filtered_regression, log
from excite.model import build
from excite.model.effects import placing
from excite.model.machine import machine

DATA = HERE.parents[2] / "shared" / "data" / "emps" / "DATA_EMPS.mat"
MODELS = {
    "symmetric": (),
    "asymmetric_viscous": ("asymmetric_viscous=-30",),
    "asymmetric_viscous + asymmetric_coulomb": ("asymmetric_viscous=-30", "asymmetric_coulomb=0.5"),
    "asymmetric_viscous + quadratic_drag": ("asymmetric_viscous=-30", "quadratic_drag=-100"),
}
SECOND = 100  # rows of one second after decimation
DRAWS = 2000  # bootstrap draws; chosen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, nargs="?", default=DATA)
    options = studies.parse(parser, __file__)
    plain = machine.load_machine("emps")
    found = {}
    errors = {}
    for name, texts in MODELS.items():
        model = build(placing.with_effects(plain, *(placing.parse_effect(t, plain, 25.0) for t in texts)))
        W, Y = filtered_regression(model, log.read_log(options.data, plain), plain.filter)
        W, Y = W[0], Y[0]
        X = np.linalg.lstsq(W, Y, rcond=None)[0]
        half = len(Y) // 2
        first, second = slice(0, half), slice(half, len(Y))
        out = np.empty_like(Y)
        for fit, ask in ((first, second), (second, first)):
            out[ask] = Y[ask] - W[ask] @ np.linalg.lstsq(W[fit], Y[fit], rcond=None)[0]
        errors[name] = out
        found[name] = {
            "parameters": dict(zip(model.base.names, X.tolist(), strict=True)),
            "relative_error_percent": 100 * float(np.linalg.norm(Y - W @ X) / np.linalg.norm(Y)),
            "held_out_error_percent": 100 * float(np.linalg.norm(out) / np.linalg.norm(Y)),
            "held_out_rms_N": float(np.sqrt(np.mean(out**2))),
        }
    rng = np.random.default_rng(0)
    for name in list(MODELS)[1:]:
        blocks = [
            (errors["symmetric"][k : k + SECOND] ** 2, errors[name][k : k + SECOND] ** 2)
            for k in range(0, len(Y) - SECOND, SECOND)
        ]
        sums = np.array([[b.sum(), a.sum()] for b, a in blocks])
        draws = [sums[rng.integers(0, len(sums), len(sums))].sum(axis=0) for _ in range(DRAWS)]
        gains = [100 * (1 - np.sqrt(a / b)) for b, a in draws]
        whole = sums.sum(axis=0)
        found[name]["gain_percent"] = 100 * (1 - float(np.sqrt(whole[1] / whole[0])))
        found[name]["gain_ci95"] = [float(v) for v in np.quantile(gains, (0.025, 0.975))]
    (options.out / "heldout.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    for name, row in found.items():
        print(name, {k: v for k, v in row.items() if k != "parameters"}, row["parameters"])


if __name__ == "__main__":
    main()

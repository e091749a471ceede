"""Measure what each sensor buys: the accuracy that a drive allows with some sensors left out.

python results/sensors/study.py [--out FOLDER] writes summary.json and table.md in seconds.
The drive is results/R60_accuracy, the accuracy the Cramer-Rao bound of the sensors that are left.
"""

from __future__ import annotations

# ruff: noqa: E402  (the folder of shared helpers comes first)
import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

import numpy as np
from support import studies

from excite import __file__ as package, output, smoothing, trajectories
from excite.model import build
from excite.model.machine import Sensor
from excite.text import format_number

DRIVE = Path(package).parents[1] / "results" / "R60_accuracy" / "design"
LEFT_OUT: dict[str, Sequence[str]] = {
    "all sensors": (),
    "without lateral speed": ("vy",),
    "without yaw rate": ("yaw_rate",),
    "without yaw rate and lateral speed (kit `paper`)": ("yaw_rate", "vy"),
    "without one measuring wheel": ("thetal",),
    "without both measuring wheels": ("thetal", "thetar"),
    "without measuring wheels, yaw rate and lateral speed": ("thetal", "thetar", "yaw_rate", "vy"),
    "without the articulation's angle": ("theta2",),
    "without the front roll's angle": ("theta1",),
}
NOISIER = 3.0  # times as much noise of every torque
COARSER = 8.0  # times fewer counts of every encoder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    place = studies.parse(parser, __file__).out
    made = trajectories.read_design(DRIVE)
    machine = made.model.machine
    rows: list[dict[str, Any]] = []
    kits = {n: tuple(s for s in machine.sensor if s.name not in left_out) for n, left_out in LEFT_OUT.items()}
    kits |= {
        f"torques {NOISIER:g} times as noisy": tuple(_scaled(s, "noise", NOISIER) for s in machine.sensor),
        f"encoders with 1/{COARSER:g} of the counts": tuple(
            _scaled(s, "counts_per_turn", 1 / COARSER) for s in machine.sensor
        ),
    }
    for name, sensors in kits.items():
        model = build(machine.model_copy(update={"sensor": sensors}))
        covariance = smoothing.cramer_rao(model, made.motion)
        sigma = 100 * np.sqrt(np.diag(covariance)) / np.abs(model.scale)
        k = int(np.argmax(sigma))
        rows.append(
            {
                "sensors": name,
                "worst_parameter": model.base.names[k],
                "worst_percent": float(sigma[k]),
                "median_percent": float(np.median(sigma)),
                "sigma_percent": dict(zip(model.base.names, sigma.tolist(), strict=True)),
            }
        )
    best = rows[0]["sigma_percent"]
    lines = ["| sensors | worst parameter | median | loses most |", "|---|---|---|---|"]
    for row in rows:
        ratio = {n: s / best[n] for n, s in row["sigma_percent"].items()}
        most = sorted(ratio, key=lambda n: -ratio[n])[:3]
        row["times_larger"] = {n: ratio[n] for n in most}
        loses = ", ".join(f"{n} {format_number(ratio[n], 2)} times" for n in most if ratio[n] > 1.05) or "-"
        worst = f"{format_number(row['worst_percent'], 2)} % ({row['worst_parameter']})"
        lines.append(f"| {row['sensors']} | {worst} | {format_number(row['median_percent'], 2)} % | {loses} |")
    (place / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    output.write_summary(place, studies.origin(__file__, 0) | {"drive": "results/R60_accuracy", "rows": rows})


def _scaled(sensor: Sensor, key: str, factor: float) -> Sensor:
    """Return a torque sensor with more noise, or an encoder with fewer counts; another one as it is."""
    given = getattr(sensor, key)
    if given is None or (key == "noise" and sensor.kind != "torque"):
        return sensor
    return sensor.model_copy(update={key: given.model_copy(update={"value": factor * given.value})})


if __name__ == "__main__":
    main()

"""Accuracy along a drive without each sensor, with it, and with half its noise."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np

from excite.model import Model
from excite.simulation import Motion
from excite.trajectories.composite_objective import motion_bound
from excite.trajectories.objective import relative_std_percent

Change = Literal["none", "left out", "added", "half the noise", "twice the counts"]


@dataclass(frozen=True)
class SensorValue:
    """Attainable accuracy (Cramer-Rao bound) after one change of the sensors.

    sensor: its name, "" for no change. error_ratio: geometric mean over the parameters of the standard deviation over
    that without the change.
    """

    sensor: str
    change: Change
    worst_parameter: str
    worst_percent: float
    median_percent: float
    error_ratio: float


def value_sensors(
    model: Model, motion: Motion, kit: str = "full", needed: Collection[str] = ()
) -> tuple[SensorValue, ...]:
    """Return what changing each sensor of a kit does to the accuracy along a motion: no change first, then best first.

    Each sensor is left out, unless identification needs it, and made twice as accurate: half the noise, or for an
    encoder twice the counts. Sensors of kit `full` that the kit lacks are added.
    needed: names of sensors that can't be left out; torque sensors never can.
    Raises ValueError for a sensor without noise or counts.
    """
    own = model.machine.sensors(kit)
    more = [s for s in model.machine.sensors("full") if s not in own]
    fixed = {*needed, *(s.name for s in own if s.kind == "torque")}
    lacking = {s.name: np.inf for s in more}
    changes: list[tuple[str, Change, dict[str, float]]] = [("", "none", {})]
    changes += [(s.name, "left out", {s.name: np.inf}) for s in own if s.name not in fixed]
    for s in own:
        changes.append((s.name, "half the noise" if s.resolution is None else "twice the counts", {s.name: 0.5}))
    changes += [(s.name, "added", {s.name: 1.0}) for s in more]
    rows: list[SensorValue] = []
    before = np.ones(len(model.scale))
    for name, change, factors in changes:
        sigma = relative_std_percent(model, motion_bound(model, motion, {**lacking, **factors}))
        before = sigma if change == "none" else before
        worst = int(np.argmax(sigma))
        rows.append(
            SensorValue(
                name,
                change,
                model.base.names[worst],
                float(sigma[worst]),
                float(np.median(sigma)),
                float(np.exp(np.mean(np.log(sigma / before)))),
            )
        )
    return (rows[0], *sorted(rows[1:], key=lambda r: r.error_ratio))

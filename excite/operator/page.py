"""The driver's page: one HTML file that shows the trace to follow, for a phone in the cab."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from excite.model import Model
from excite.model.machine import UNITS
from excite.operator.ground import BAND_ANGLE, BAND_S, BAND_SPEED, Trace, phase_parts
from excite.reports import templates

TIMES = re.compile(r" (in|for) [\d.]+ s| at \d+:[\d.]+")  # the page counts down: its words need no times


def driver_page(model: Model, trace: Trace, title: str, start: str = "") -> str:
    """Render the page: a moving reference of speed and steering with a countdown to the next phase.

    It also shows and scores what was driven, from a log in the machine's columns or live values of `serve`.
    start: where to place the machine, shown until the drive begins.
    """
    return templates().get_template("driver.html").render(data={**driver_data(model, trace, title), "start": start})


def driver_data(model: Model, trace: Trace, title: str) -> dict[str, Any]:
    """Return the page's data: trace (angles in degrees, positive left), phases in words, tolerances, log columns."""
    machine = model.machine
    by_body = {s.body: s for s in machine.sensors("full") if s.kind == "angle"}
    rims = [
        {
            "column": by_body[b.index].column,
            "gain": float(b.contact.radius) * by_body[b.index].gain,
            "rate": by_body[b.index].is_rate,
        }
        for b in machine.contacts
        if b.contact is not None and b.index in by_body
    ]
    levers = []
    for lever, degrees in zip(trace.levers, trace.degrees.T, strict=True):
        sensor, degree = by_body.get(lever.body.index), lever.left * 180 / np.pi
        levers.append(
            {
                "name": lever.name,
                "said": lever.column,
                "column": sensor.column if sensor else "",
                "gain": degree * sensor.gain if sensor else 0.0,
                "shift": degree * sensor.shift if sensor else 0.0,
                "rate": sensor is not None and sensor.is_rate,
                "degrees": degree,
                "values": degrees.tolist(),
            }
        )
    words = [phase_parts(trace, k) for k in range(len(trace))]
    words = [(TIMES.sub("", go), steer) for go, steer in words]
    return {
        "title": title,
        "times": trace.times.tolist(),
        "speed": trace.speed.tolist(),
        "levers": levers,
        "phases": [
            {"start": float(t), "go": go, "steer": list(steer)}
            for t, (go, steer) in zip(trace.times[:-1], words, strict=True)
        ],
        "band": {
            "speed": BAND_SPEED,
            "angle": float(np.rad2deg(BAND_ANGLE)),
            "time": BAND_S,
        },
        "log": {"time": machine.time_column, "second": UNITS[machine.time_unit][1], "rims": rims},
    }

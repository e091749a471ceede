"""A drive whose log holds the force that it was commanded: its known loop turns the command into what it delivers.

The loop is a first-order lag with dead time, T u'(t) + u(t) = command(t - dead time). Source: Åström and Hägglund, "PID
Controllers", 2nd ed., 1995, ch. 2 (models of first order with dead time).
"""

from __future__ import annotations

import numpy as np
import scipy
from pydantic import model_validator

from excite.model.machine.records import FileRecord, NotNegative

SETTLING_LAGS = 5.0  # time constants; chosen


class ForceLoop(FileRecord):
    """Loop between a command and the delivered torque or force; both values [s] count as exact.

    time_constant: of its lag, 1 / (2 pi bandwidth [Hz]). dead_time: from a command to the first response.
    """

    time_constant: NotNegative | None = None
    dead_time: NotNegative | None = None

    @model_validator(mode="after")
    def _consistent(self) -> ForceLoop:
        if self.time_constant is None and self.dead_time is None:
            raise ValueError("time_constant: give it [s], or dead_time, or both")
        return self

    @property
    def settling_s(self) -> float:
        """Time [s] after which what was commanded before a log's first row no longer shows, to 0.7 %."""
        return float(self.dead_time or 0.0) + SETTLING_LAGS * float(self.time_constant or 0.0)


def behind_loop(loop: ForceLoop, command: np.ndarray, step: float) -> np.ndarray:
    """Return the delivered torque (N,) from the command (N,) at samples `step` [s] apart, linear between them.

    The first command is taken to have lasted for long.
    """
    t, lag = step * np.arange(len(command)), float(loop.time_constant or 0.0)
    late = np.interp(t - float(loop.dead_time or 0.0), t, command)
    if lag == 0:
        return late
    fading = np.exp(-step / lag)
    mean = (1 - fading) * lag / step
    now, before = 1 - mean, mean - fading  # exact response to a ramp from one sample to the next
    delivered, _ = scipy.signal.lfilter([now, before], [1.0, -fading], late, zi=[(1 - now) * late[0]])
    return np.asarray(delivered)


def before_loop(loop: ForceLoop, delivered: np.ndarray, step: float) -> np.ndarray:
    """Return the command (N,) that a delivered torque (N,) takes; its slope by central differences."""
    t = step * np.arange(len(delivered))
    ahead = delivered + float(loop.time_constant or 0.0) * np.gradient(delivered, step)
    return np.asarray(np.interp(t + float(loop.dead_time or 0.0), t, ahead))

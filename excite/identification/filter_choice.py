"""Low-pass filter of the linear methods: the machine file's, or chosen from the spectra of the logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from excite.logs import Log
from excite.model import Model
from excite.model.machine import Filter
from excite.text import format_number

FLOOR_RATIO = 4.0  # power over the noise floor up to which a spectrum counts as noise; chosen
PASSED_SHARE = 0.8  # share of the Nyquist frequency that decimation passes (see `decimate`)


def noise_floor_frequency(x: np.ndarray, rate: float) -> float:
    """Find the frequency [Hz] above which a signal (N,) is white noise only, from Welch's spectrum."""
    length = min(len(x), max(256, int(8 * rate)))
    f, p = scipy.signal.welch(scipy.signal.detrend(x), rate, nperseg=length)
    floor = float(np.median(p[f > 0.6 * f[-1]]))
    smooth = np.convolve(np.pad(p, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    above = np.flatnonzero(smooth[1:] > FLOOR_RATIO * floor) + 1
    # The first gap ends the band: a line at a high frequency must not let in the noise below it.
    gaps = np.flatnonzero(np.diff(above) > max(3, len(f) // 100))
    last = above[gaps[0]] if len(gaps) else (above[-1] if len(above) else 1)
    return float(f[last])


def choose_from_spectra(model: Model, logs: Sequence[Log]) -> tuple[Filter, str]:
    """Choose cut-off and decimation from the logs' spectra; return the filter and the reason in a sentence.

    The cut-off is where the fastest angle or speed falls to the noise floor of its sensor. Beyond it, derivatives
    amplify noise only. Rows are kept as dense as the pass band needs. Order and dropped ends are those of the machine
    file.
    """
    machine = model.machine
    rate = float(machine.sampling_hz)
    edges: dict[str, float] = {}
    for sensor in machine.sensors("full"):
        if sensor.kind in ("torque", "x", "y"):
            continue
        edges_of_logs = [
            noise_floor_frequency(log.values[sensor.name], rate) for log in logs if sensor.name in log.values
        ]
        if edges_of_logs:
            edges[sensor.name] = max(edges_of_logs)
    fastest = max(edges, key=lambda name: edges[name])
    cutoff = float(np.clip(edges[fastest], 0.5, rate / 5))
    factor = max(1, int(PASSED_SHARE * rate / (2 * cutoff)))
    quantity = machine.filter.cutoff_hz.model_copy(
        update={"value": cutoff, "source": "measured", "note": f"{fastest} sinks into its noise floor there"}
    )
    listed = ", ".join(f"{name} {format_number(f, 2)}" for name, f in edges.items())
    reason = (
        f"filter: cut-off {format_number(cutoff, 2)} Hz, where {fastest}, the liveliest signal, sinks into its"
        f" sensor's noise floor (Hz: {listed}); one row in {factor} kept, which passes"
        f" {format_number(PASSED_SHARE * rate / 2 / factor, 2)} Hz"
    )
    return machine.filter.model_copy(update={"cutoff_hz": quantity, "decimation": factor}), reason


def use_machine_filter(model: Model, logs: Sequence[Log]) -> tuple[Filter, str]:
    """Return the machine file's filter, without a reason."""
    return model.machine.filter, ""


# Ways to choose the filter, by the values of `--filter`; each returns the filter and the reason in a sentence.
FILTERS: dict[str, Callable[[Model, Sequence[Log]], tuple[Filter, str]]] = {
    "machine": use_machine_filter,
    "auto": choose_from_spectra,
}

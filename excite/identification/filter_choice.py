"""The low-pass filter of the linear methods: the machine file's, or chosen by the spectra of the logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from excite.logs import Log
from excite.model import Model
from excite.model.machine import Filter

FLOOR_RATIO = 4.0  # times the noise floor where a spectrum counts as sunk


PASSED_SHARE = 0.8  # of the Nyquist frequency after decimation is passed (see `decimate`)


def noise_floor_frequency(x: np.ndarray, rate: float) -> float:
    """Frequency [Hz] above which a signal (N,) is nothing but its white noise floor: from Welch's spectrum."""
    length = min(len(x), max(256, int(8 * rate)))
    f, p = scipy.signal.welch(scipy.signal.detrend(x), rate, nperseg=length)
    floor = float(np.median(p[f > 0.6 * f[-1]]))
    smooth = np.convolve(np.pad(p, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    above = np.flatnonzero(smooth[1:] > FLOOR_RATIO * floor) + 1
    # The first gap ends it: a line at some high frequency is no reason to let noise in below it.
    gaps = np.flatnonzero(np.diff(above) > max(3, len(f) // 100))
    last = above[gaps[0]] if len(gaps) else (above[-1] if len(above) else 1)
    return float(f[last])


def choose_from_spectra(model: Model, logs: Sequence[Log]) -> tuple[Filter, str]:
    """Cut-off and decimation by the logs' spectra, with the reason in a sentence.

    Motion is kept up to where the liveliest angle or speed sinks into the floor of its own sensor; beyond, derivatives
    amplify noise alone. Rows are kept as dense as the pass band needs. Order and dropped ends stay the machine file's.
    """
    machine = model.machine
    rate = float(machine.sampling_hz)
    found: dict[str, float] = {}
    for sensor in machine.sensors("full"):
        if sensor.kind in ("torque", "x", "y"):
            continue
        own = [noise_floor_frequency(log.values[sensor.name], rate) for log in logs if sensor.name in log.values]
        if own:
            found[sensor.name] = max(own)
    liveliest = max(found, key=lambda name: found[name])
    cutoff = float(np.clip(found[liveliest], 0.5, rate / 5))
    factor = max(1, int(PASSED_SHARE * rate / (2 * cutoff)))
    quantity = machine.filter.cutoff_hz.model_copy(
        update={"value": cutoff, "source": "measured", "note": f"{liveliest} sinks into its noise floor there"}
    )
    listed = ", ".join(f"{name} {f:.2g}" for name, f in found.items())
    reason = (
        f"filter: cut-off {cutoff:.2g} Hz, where {liveliest}, the liveliest signal, sinks into its sensor's noise floor"
        f" (Hz: {listed}); one row in {factor} kept, which passes {PASSED_SHARE * rate / 2 / factor:.2g} Hz"
    )
    return machine.filter.model_copy(update={"cutoff_hz": quantity, "decimation": factor}), reason


def use_machine_filter(model: Model, logs: Sequence[Log]) -> tuple[Filter, str]:
    """The machine file's own, for which there is nothing to say."""
    return model.machine.filter, ""


# How a filter is chosen, by what `--filter` calls it: the filter and the reason in a sentence.
FILTERS: dict[str, Callable[[Model, Sequence[Log]], tuple[Filter, str]]] = {
    "machine": use_machine_filter,
    "auto": choose_from_spectra,
}

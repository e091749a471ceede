"""Result of every identification method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

NOTHING_MOVES_MESSAGE = "no parameter is identifiable from this log: does the machine move in it?"


def held_note(names: Sequence[str]) -> str:
    """Note for parameters that are held at the machine file's value."""
    return f"held at the machine file's value: {', '.join(names)}; the other values depend on these"


@dataclass(frozen=True)
class Estimate:
    """Base parameters identified from logs.

    method; names, units: of the n parameters.
    value (n,), covariance (n, n) [SI]: NaN for unidentifiable parameters, whose reason is in `unidentifiable`.
    cond_w, cond_phi: condition numbers of W and of W diag(value).
    relative_error_percent: 100 |Y - W X| / |Y|. residual (rows, N): filtered and decimated.
    degrees: degrees of freedom of the residual.
    bias, bias_std (n,) [SI]: mean error of the method on simulated logs, and its standard deviation, if computed.
    one_sided_std (2, n) [SI]: standard deviations below and above if the likelihood is skewed; std lies between them.
    doubt: why the 95 % intervals do not hold, "" if they do. understated: factor by which standard deviations are known
        to be too small. status: valid, doubtful or invalid (see `status.assess`).
    possible (n,): False for values that no machine has. consistent (n,) [SI]: values of the nearest possible machine,
        if some value is not possible. prior_std (n,) [SI]: standard deviations by what the machine file calls known,
        before any log; NaN for parameters that it does not determine.
    share_outside_law: of the logs' samples in which a contact slips more than its linear law allows, None if unknown.
    """

    method: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray
    cond_w: float
    cond_phi: float
    relative_error_percent: float
    residual: np.ndarray
    degrees: int
    unidentifiable: Mapping[str, str]
    notes: tuple[str, ...]
    bias: np.ndarray | None = None
    bias_std: np.ndarray | None = None
    one_sided_std: np.ndarray | None = None
    doubt: str = ""
    understated: float = 1.0
    status: str = "valid"
    possible: np.ndarray | None = None
    consistent: np.ndarray | None = None
    prior_std: np.ndarray | None = None
    share_outside_law: float | None = None

    def value_or(self, nominal: np.ndarray) -> np.ndarray:
        """Return the values (n,), those of the machine file for unidentified parameters; nominal (n,) [SI]."""
        return np.where(np.isfinite(self.value), self.value, nominal)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (n,) [SI]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def std_percent(self) -> np.ndarray:
        """Relative standard deviation [%]; NaN for a value of zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.value == 0, np.nan, 100 * self.std / np.abs(self.value))

    @property
    def quantile95(self) -> float:
        """Half width of a 95 % interval in standard deviations."""
        return float(scipy.stats.t.ppf(0.975, max(self.degrees, 1)))

    @property
    def interval95(self) -> np.ndarray:
        """Ends of the 95 % intervals (2, n) [SI]."""
        below, above = (self.std, self.std) if self.one_sided_std is None else self.one_sided_std
        return np.array([self.value - self.quantile95 * below, self.value + self.quantile95 * above])


def add_notes(estimate: Estimate, *notes: str) -> Estimate:
    """Return the estimate with notes for the report appended."""
    return replace(estimate, notes=estimate.notes + notes)

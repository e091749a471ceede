"""What every method of identification hands back, and why it can't."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

NOTHING_MOVES_MESSAGE = "the log says nothing of any parameter: does the machine move in it?"


def held_note(names: Sequence[str]) -> str:
    """What an estimate says of parameters that it took from the machine file."""
    return f"held at the machine file's value: {', '.join(names)}; the others hold if the file is right there"


@dataclass(frozen=True)
class Estimate:
    """Base parameters of a log, by method.

    value, std (n,) [SI] by `names`; an unidentifiable parameter has NaN in both and its reason in `unidentifiable`.
    covariance (n, n). cond_w, cond_phi: condition numbers of W and W diag(value). residual (rows, N): filtered,
    decimated. degrees: of freedom of the residual. bias, bias_std (n,) [SI]: mean error of the method on simulated logs
    of the identified machine and how well it is known, where somebody asked for it. sides (2, n) [SI]: standard
    deviations below and above where the likelihood is lopsided; std lies between them.
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
    sides: np.ndarray | None = None

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))

    @property
    def std_percent(self) -> np.ndarray:
        """Relative standard deviation [%]; infinite for a value of zero."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100 * self.std / np.abs(self.value)

    @property
    def quantile95(self) -> float:
        """From the value to an end of its 95 % interval, in standard deviations to that side."""
        return float(scipy.stats.t.ppf(0.975, max(self.degrees, 1)))

    @property
    def interval95(self) -> np.ndarray:
        """Ends of the 95 % intervals (2, n) [SI]."""
        below, above = (self.std, self.std) if self.sides is None else self.sides
        return np.array([self.value - self.quantile95 * below, self.value + self.quantile95 * above])


def add_notes(estimate: Estimate, *notes: str) -> Estimate:
    """The estimate with remarks for the report added."""
    return replace(estimate, notes=estimate.notes + notes)

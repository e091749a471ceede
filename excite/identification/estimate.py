"""Result of every identification method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from excite.smoothing import StateSpace, Trajectory

MIN_SHARE = 1e-4  # of a variance below which a source is left out of a budget; chosen
NOTHING_MOVES_MESSAGE = "no parameter is identifiable from this log: does the machine move in it?"


def held_note(names: Sequence[str]) -> str:
    """Note for parameters that are held at the machine file's value."""
    return f"held at the machine file's value: {', '.join(names)}; the other values depend on these"


@dataclass(frozen=True)
class FitTest:
    """A test of what an estimate leaves in its logs.

    signal: column, drive or quantity of the machine file. what: kind of departure. text: a line for the user.
    level: p-value below which the test fails. contained: whether what is left hardly moves any value.
    """

    signal: str
    what: str
    p_value: float
    text: str
    level: float = 0.0
    contained: bool = False

    @property
    def fails(self) -> bool:
        """Tell if noise, and tolerances that hold, hardly leave so much, and values may be wrong for it."""
        return self.p_value < self.level and not self.contained


@dataclass(frozen=True)
class Discrepancy:
    """A force that the model lacks: rms along the logs [unit: N m, N, m/s2 or rad].

    signal: torque channel, or place on the machine. kind: what it follows, in words, such as "with speed" or "slow".
    scale: of the variable that it changes with [SI].
    """

    signal: str
    kind: str
    rms: float
    unit: str
    scale: float


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
    discrepancy: forces that the model lacks; the covariance contains them. innovations (rows, N): residuals beyond
        them, over the noise found, None if the method has none. alignments {sensor: (shift, standard deviation)} [s]:
        of torque channels, if the method finds them; its covariance contains their tolerance. lacking (n_u, N) [SI]:
        what these and the discrepancy explain of the torques read.
    share_outside_law: of the logs' samples in which a contact slips more than its linear law allows, None if unknown.
    tolerated {source: (n,)} [SI]: shift of the parameters by one standard deviation of each tolerance of the machine
        file, as far as the logs leave it open. tests: of what the estimate leaves in its logs.
    smoothed: state space and trajectory of each log, if the method finds them by the model alone.
    spread: how much more several logs differ than their covariances say, at least 1 (Birge's ratio); it is in the
        covariance.
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
    tolerated: Mapping[str, np.ndarray] = field(default_factory=dict)
    tests: tuple[FitTest, ...] = ()
    spread: float = 1.0
    discrepancy: tuple[Discrepancy, ...] = ()
    innovations: np.ndarray | None = None
    alignments: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    lacking: np.ndarray | None = None
    smoothed: tuple[tuple[StateSpace, Trajectory], ...] = ()

    def value_or(self, nominal: np.ndarray) -> np.ndarray:
        """Return the values (n,), those of the machine file for unidentified parameters; nominal (n,) [SI]."""
        return np.where(np.isfinite(self.value), self.value, nominal)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (n,) [SI] by noise and by what the model lacks."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def total_covariance(self) -> np.ndarray:
        """Covariance (n, n) [SI] with the tolerances."""
        return np.asarray(self.covariance + sum((np.outer(s, s) for s in self.tolerated.values()), np.zeros(())))

    @property
    def std_total(self) -> np.ndarray:
        """Standard deviations (n,) [SI] with the tolerances."""
        return np.sqrt(np.diag(self.total_covariance))

    @property
    def budget(self) -> dict[str, dict[str, float]]:
        """Share of each parameter's variance by source: noise, then the tolerances that matter, largest first."""
        table: dict[str, dict[str, float]] = {}
        for k, name in enumerate(self.names):
            total = self.std_total[k] ** 2
            if not np.isfinite(total) or not total > 0:
                continue
            noise = float(self.covariance[k, k] / total)
            shares = {source: float(s[k] ** 2 / total) for source, s in self.tolerated.items()}
            shares["differences between logs"] = noise * (1 - self.spread**-2)
            ranked = sorted(shares.items(), key=lambda x: -x[1])
            table[name] = {"noise": noise / self.spread**2, **{n: x for n, x in ranked if x >= MIN_SHARE}}
        return table

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
        """Ends of the 95 % intervals (2, n) [SI], with the tolerances."""
        return self._interval(self.std_total)

    @property
    def noise_interval95(self) -> np.ndarray:
        """Ends of the 95 % intervals (2, n) [SI] if the machine file is exact, as in simulated runs."""
        return self._interval(self.std)

    def _interval(self, std: np.ndarray) -> np.ndarray:
        """Ends (2, n) [SI]; a skewed likelihood keeps its shape."""
        below, above = (std, std)
        if self.one_sided_std is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                below, above = self.one_sided_std * np.where(self.std > 0, std / self.std, 1.0)
        return np.array([self.value - self.quantile95 * below, self.value + self.quantile95 * above])


def widen(estimate: Estimate, factor: float) -> Estimate:
    """Return the estimate with standard deviations by noise a factor larger, for logs that differ by so much more."""
    one_sided = estimate.one_sided_std
    return replace(
        estimate,
        covariance=estimate.covariance * factor**2,
        one_sided_std=None if one_sided is None else one_sided * factor,
        spread=estimate.spread * factor,
    )


def add_notes(estimate: Estimate, *notes: str) -> Estimate:
    """Return the estimate with notes for the report appended."""
    return replace(estimate, notes=estimate.notes + notes)

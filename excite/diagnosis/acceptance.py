"""Accept a finding that predicts withheld data, is significant and has a possible sign."""

from __future__ import annotations

from excite.diagnosis.diagnosis import Finding
from excite.diagnosis.fits import ExtendedFit
from excite.diagnosis.hold_out import HoldOutErrors, hold_out_gain, predictive_gain
from excite.text import format_uncertain

MIN_STDS = 2.0  # magnitude over its standard deviation given the shapes, of a finding; chosen


def reason_against(
    finding: Finding, stage: ExtendedFit, before: HoldOutErrors | None, after: HoldOutErrors | None
) -> str:
    """Say why a finding is not given, "" if it is."""
    effect = stage.placed(finding.name).effect
    if effect.opposes_motion and finding.magnitude < 0:
        return "its sign is impossible"
    if not abs(finding.magnitude) > MIN_STDS * finding.std_at_shapes:
        amount = format_uncertain(finding.magnitude, finding.magnitude_std, finding.unit)
        return f"its size is uncertain ({amount})"
    shown = hold_out_gain(before, after)
    sure = None if shown is None else shown.interval
    if finding.kind == "cause":
        gain = predictive_gain(before, after, stage.dispersion)
        # Without a gain in likelihood, exact dynamics do not follow the logs without the finding.
        better = sure is None or sure[0] > 0 if gain is None else gain.low > 0 and (sure is None or sure[1] >= 0)
        return "" if better else "it does not predict withheld data better"
    if sure is None:
        return "no data could be withheld to test it"
    return "" if sure[0] > 0 else "it does not predict withheld data better"

"""Results in words and tables: one description of each kind of summary, shown by the terminal and by report.html."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from excite.reports.check_descriptions import describe_log, describe_machine
from excite.reports.description import Description, Summary
from excite.reports.design_descriptions import (
    describe_campaign,
    describe_compare,
    describe_design,
    describe_drive,
    describe_score,
)
from excite.reports.diagnosis_descriptions import describe_diagnose, describe_study
from excite.reports.estimate_descriptions import describe_identify, describe_predict, describe_slip, describe_verify
from excite.reports.handover_descriptions import describe_handover


def describe(kind: str, summary: Summary) -> Description:
    """Describe a summary. Raises KeyError for an unknown kind."""
    return DESCRIPTIONS[kind](summary)


def with_sentences(kind: str, summary: Summary) -> dict[str, Any]:
    """Return a summary with its `headline`, and its `verdict` where it has none: sentences for people."""
    told = describe(kind, summary)
    return {**({"verdict": told.verdict} if told.verdict else {}), **summary, "headline": told.headline}


DESCRIPTIONS: dict[str, Callable[[Summary], Description]] = {
    "design": describe_design,
    "campaign": describe_campaign,
    "drive": describe_drive,
    "handover": describe_handover,
    "score": describe_score,
    "compare": describe_compare,
    "verify": describe_verify,
    "identify": describe_identify,
    "predict": describe_predict,
    "log": describe_log,
    "machine": describe_machine,
    "diagnose": describe_diagnose,
    "slip": describe_slip,
    "study": describe_study,
}

"""Findings: the comparison of a measured value with the expected one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from robot_ik.errors import distinct_texts
from robot_ik.script.state import StepFailed, StepResult


@dataclass(frozen=True)
class Finding:
    """A measured value and the expected one.

    Attributes:
        ok: Whether the measured value is as expected.
        measured: Text of the measured value.
        expected: Text of the expected value.
        numbers: The measured values for programs, by their key in the report.
    """

    ok: bool
    measured: str
    expected: str
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.measured if self.ok else f"{self.measured} instead of {self.expected}"


def error_finding(error: float, allowed: float, unit: str, what: str, key: str) -> Finding:
    """Return the finding about an error that must be within a tolerance.

    Args:
        error: Measured error, in ``unit``.
        allowed: Largest allowed error, in ``unit``.
        unit: Unit as it follows a number, such as ``" mm"`` or ``"°"``.
        what: Name of the measured frame, joint or object.
        key: Key of the error in the report.
    """
    measured, permitted = distinct_texts(error, allowed, digits=2)
    return Finding(
        ok=error <= allowed,
        measured=f"{what} {measured}{unit} off",
        expected=f"at most {permitted}{unit}",
        numbers={key: round(error, 4)},
    )


def report_findings(findings: Sequence[Finding], result: StepResult, failure: str = "") -> None:
    """Write the findings into ``result``.

    Args:
        findings: The findings.
        result: Result of the step.
        failure: Start of the message if a finding is not ok.

    Raises:
        StepFailed: A finding is not ok.
    """
    for finding in findings:
        result.numbers.update(finding.numbers)
    result.found = "; ".join(str(finding) for finding in findings)
    failed = [str(finding) for finding in findings if not finding.ok]
    if failed:
        raise StepFailed(failure + "; ".join(failed))

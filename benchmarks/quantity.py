"""A measured number and its limit: a row in the tables of camera, figure and page."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Quantity:
    """One measured number, and what is wanted of it.

    Attributes:
        quantity: What was measured.
        value: NaN where it was not.
        unit: Of value and bounds.
        most, least: The bounds that are wanted; None where there is none.
        missing: Why it was not measured.
    """

    quantity: str
    value: float
    unit: str = ""
    most: float | None = None
    least: float | None = None
    missing: str = ""

    @property
    def passed(self) -> bool | None:
        """Whether the value is as wanted; None where nothing is wanted, or nothing was measured."""
        if self.missing or (self.most is None and self.least is None):
            return None
        return (self.most is None or self.value <= self.most) and (
            self.least is None or self.value >= self.least
        )

    def facts(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"passed": self.passed}

    @property
    def measured_text(self) -> str:
        """Value and unit: whole numbers as they are, others with three figures."""
        if self.missing:
            return f"not measured: {self.missing}"
        whole = abs(self.value) >= 1000.0 or (not self.unit and self.value == round(self.value))
        return f"{self.value:{'.0f' if whole else '.3g'}} {self.unit}".strip()

    @property
    def wanted_text(self) -> str:
        """The bounds with sign and unit; empty where there are none."""
        if self.most is not None and self.least is not None:
            return f"{self.least:g} … {self.most:g} {self.unit}".strip()
        bound = self.least if self.most is None else self.most
        return (
            ""
            if bound is None
            else f"{'≥' if self.most is None else '≤'} {bound:g} {self.unit}".strip()
        )

"""A measured number and its limit: a row in the tables of camera, figure and page."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Quantity:
    """One measured number and its limits.

    Attributes:
        quantity: What was measured.
        value: NaN if it was not measured.
        unit: Unit of the value and the limits.
        most: Upper limit. None: no limit.
        least: Lower limit. None: no limit.
        missing: Reason why it was not measured.
    """

    quantity: str
    value: float
    unit: str = ""
    most: float | None = None
    least: float | None = None
    missing: str = ""

    @property
    def passed(self) -> bool | None:
        """Whether the value is within its limits. None without limits or without a value."""
        if self.missing or (self.most is None and self.least is None):
            return None
        return (self.most is None or self.value <= self.most) and (
            self.least is None or self.value >= self.least
        )

    def facts(self) -> dict[str, Any]:
        """The fields and ``passed`` for JSON."""
        return asdict(self) | {"passed": self.passed}

    @property
    def measured_text(self) -> str:
        """Value and unit: integers in full, other numbers with three digits."""
        if self.missing:
            return f"not measured: {self.missing}"
        is_integer = not self.unit and self.value == round(self.value)
        format_code = ".0f" if is_integer or abs(self.value) >= 1000.0 else ".3g"
        return f"{self.value:{format_code}} {self.unit}".strip()

    @property
    def wanted_text(self) -> str:
        """The limits with sign and unit. Empty without limits."""
        if self.most is not None and self.least is not None:
            return f"{self.least:g} … {self.most:g} {self.unit}".strip()
        bound = self.least if self.most is None else self.most
        return (
            ""
            if bound is None
            else f"{'≥' if self.most is None else '≤'} {bound:g} {self.unit}".strip()
        )

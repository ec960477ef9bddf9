"""Whole jobs built from the parts: what the commands run.

Jobs that look and move (``reach``, ``arm_camera.handeye``, ``arm_camera.verify``, ``ar.job``) have one shape.
A frozen request says what to do. ``run_…`` opens what all of it needs and runs the phases, methods of one
class: each takes what those before it gave, and gives a frozen dataclass. The report keeps their fields, so
that it says how far a run got; samples on file are judged by the last phase alone. Ctrl-C, files and exit
codes are the command's, which is handed samples and report.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import TypeVar

#: Called with the phase ("looking", "moving", …) and the share of it that is done.
Progress = Callable[[str, float], None]

Phase = TypeVar("Phase")


class JobReport:
    """What happened in a job, as far as it got; a dataclass whose fields are also those of its phases."""

    def keep(self, phase: Phase) -> Phase:
        """Takes over what a phase has found; its fields have the names of the report's."""
        for one in fields(phase):  # type: ignore[arg-type]
            setattr(self, one.name, getattr(phase, one.name))
        return phase

"""Whole jobs built from the parts: what the commands run.

Jobs that look (``reach``, ``locate``, ``ar.job``, those of ``arm_camera``) have one shape.
A frozen request says what to do. ``run_…`` opens what all of it needs and runs the phases, each of which
fills in its part of the report, so that the report says how far a run got; samples on file are judged by the
last phase alone. Files and exit codes are the command's, which is handed samples and report; ``ar`` writes
its film itself.
"""

from collections.abc import Callable

#: Called with the phase ("looking", "moving", …) and the share of it that is done.
Progress = Callable[[str, float], None]


def share_of(progress: Progress, phase: str, done: int, parts: int) -> Callable[[float], None]:
    """Takes the share of one part that is done, of a job of so many alike; ``done``: those before it."""
    return lambda share: progress(phase, (done + share) / parts)

"""Whole jobs built from the parts: what the commands run.

Jobs with a camera (``locate``, ``ar.job``, those of ``arm_camera``) have one shape. A frozen request
has the inputs. ``run_…`` opens robot, arm and camera and runs the phases. Each phase fills in its part
of the report, so the report shows how far a run got. The last phase alone can judge samples on file.
Files and exit codes belong to the command. ``ar`` writes its film itself.
"""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with the phase ("looking", "moving") and the share of the phase that is done."""


def share_of(progress: Progress, phase: str, done: int, parts: int) -> Callable[[float], None]:
    """Return a progress function for one of several equal parts of a phase.

    Args:
        progress: Progress of the job.
        phase: The phase.
        done: Number of parts before this one.
        parts: Number of parts.
    """
    return lambda share: progress(phase, (done + share) / parts)

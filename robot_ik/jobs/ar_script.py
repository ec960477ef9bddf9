"""A script's motion for the drawn robot: the script runs on simulated servos, their shafts are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_ik.errors import ConfigError
from robot_ik.files import read_text, read_toml
from robot_ik.jobs.script import ScriptRequest, ScriptRun, find_script, load_script, shipped
from robot_ik.jobs.script.run import seen_from
from robot_ik.motion.record import RecorderSink
from robot_ik.motion.trajectory import Trajectory
from robot_ik.ports import Clock
from robot_ik.robot import Robot

Array = NDArray[np.float64]


class _Witnessed:
    """A clock whose sleepers are seen: each time somebody waited, the joints are recorded."""

    def __init__(self, clock: Clock, run: ScriptRun, recorder: RecorderSink) -> None:
        self._clock, self._run, self._recorder = clock, run, recorder

    def now(self) -> float:
        """Of the clock."""
        return self._clock.now()

    def sleep_until(self, deadline: float) -> None:
        """Of the clock."""
        self._clock.sleep_until(deadline)
        self._recorder.send(self._run.limbs.true_q(), self._clock.now())


def is_script(text: str) -> bool:
    """Whether this is a script: the name of one that comes along, or a TOML file with steps."""
    if text in shipped():
        return True
    path = Path(text).expanduser()
    try:
        return path.suffix == ".toml" and "steps" in read_toml(path, "the script")
    except ConfigError:
        return False


def robot_of(text: str) -> str:
    """The robot that a motion is made for: a script's or an arm file's; empty where it is for any.

    Raises:
        ConfigError: The script or the arm file is wrong.
    """
    if is_script(text):
        script = load_script(find_script(text))
        return seen_from(script, script.content.robot)
    path = Path(text.partition("@")[0])
    if path.suffix != ".toml":
        return ""
    read_text(path, "the script or arm file")
    from robot_ik.hardware.config import ArmConfig

    return ArmConfig.load(path).robot


def play_script(text: str, robot: Robot) -> tuple[Trajectory, str]:
    """Runs it; how the joints moved, where the shafts truly were, and what went wrong in one line.

    Args:
        text: As for ``is_script``.
        robot: The one that is drawn; joints that the script's servos do not turn stay at home.

    Raises:
        ConfigError: The script is of another robot, or it is wrong.
        RobotIkError: Of the simulated arm.
    """
    file = find_script(text)
    run = ScriptRun(load_script(file), ScriptRequest())
    limbs, report = run.limbs, run.report
    if report.robot != robot.name:
        raise ConfigError(
            f"is a script of {report.robot}, and {robot.name} is drawn",
            file=file, key="robot", allowed=f"--robot {report.robot}",
        )  # fmt: skip
    recorder = RecorderSink(limbs.robot.joints)
    recorder.send(limbs.true_q(), limbs.clock.now())  # of a script that waits nowhere, this is all
    limbs.clock = _Witnessed(limbs.clock, run, recorder)
    run.run()
    moved = recorder.trajectory()
    q = np.tile(robot.home, (len(moved), 1))
    for column, joint in enumerate(moved.joints):
        q[:, robot.joints.index(joint)] = moved.q[:, column]
    failed = next((step for step in report.steps if step.outcome == "failed"), None)
    notice = "" if failed is None else f"the script failed at {failed.name!r}: {failed.found}"
    return Trajectory(moved.times, q, robot.joints), notice

"""Play the motion of a scripted test run with the drawn robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robot_ik.config import read_toml
from robot_ik.errors import ConfigError
from robot_ik.motion.trajectory import RecorderSink, Trajectory
from robot_ik.ports import Clock
from robot_ik.robot import Robot
from robot_ik.script import ScriptRequest, ScriptRun, load_script, shipped


class _RecordingClock:
    """A clock that records the true joint angles after each wait."""

    def __init__(self, clock: Clock, run: ScriptRun, recorder: RecorderSink) -> None:
        self._clock = clock
        self._run = run
        self._recorder = recorder

    def now(self) -> float:
        return self._clock.now()

    def sleep_until(self, deadline: float) -> None:
        self._clock.sleep_until(deadline)
        self._recorder.send(self._run.setup.true_q(), self._clock.now())


def is_script(text: str) -> bool:
    """Return whether ``text`` is the name of a bundled script or a TOML file with steps."""
    if text in shipped():
        return True
    path = Path(text).expanduser()
    try:
        return path.suffix == ".toml" and "steps" in read_toml(path, "the script")
    except ConfigError:
        return False


def play_script(text: str, robot: Robot) -> tuple[Trajectory, str]:
    """Run a script on simulated servos and record the angles of their shafts.

    Args:
        text: Name of a bundled script, or a TOML file.
        robot: Robot of the trajectory. Joints without a servo in the script stay at home.

    Returns:
        The trajectory of the shafts, and one line about the first failed step (empty if none
        failed).

    Raises:
        ConfigError: The script is wrong, or for another robot.
        RobotIkError: The simulated arm failed.
    """
    script = load_script(text)
    run = ScriptRun(script, ScriptRequest())
    setup = run.setup
    report = run.report
    if report.robot != robot.name:
        raise ConfigError(
            f"is a script of {report.robot}, and {robot.name} is drawn",
            file=script.file,
            key="robot",
            allowed=f"--robot {report.robot}",
        )
    recorder = RecorderSink(setup.robot.joints)
    # A script without any wait records this sample alone.
    recorder.send(setup.true_q(), setup.clock.now())
    setup.clock = _RecordingClock(setup.clock, run, recorder)
    run.run()

    recorded = recorder.trajectory()
    q = np.tile(robot.home, (len(recorded), 1))
    for column, joint in enumerate(recorded.joints):
        q[:, robot.joints.index(joint)] = recorded.q[:, column]
    failed = next((step for step in report.steps if step.outcome == "failed"), None)
    notice = "" if failed is None else f"the script failed at {failed.name!r}: {failed.found}"
    return Trajectory(recorded.times, q, robot.joints), notice

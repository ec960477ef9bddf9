"""Where a run stands: the arm, what was sent to it last, and what the last step left behind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robot_ik import errors
from robot_ik.errors import ConfigError, apart
from robot_ik.execution import START_TOLERANCE, execute
from robot_ik.hardware.arm import ArmState
from robot_ik.jobs.robot_setup import LastCommand, RobotSetup
from robot_ik.jobs.script.report import StepResult
from robot_ik.motion.trajectory import Trajectory

if TYPE_CHECKING:
    from robot_ik.errors import RobotIkError
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.jobs.script.file import ScriptFile
    from robot_ik.jobs.script.steps import ScriptStep
    from robot_ik.jobs.vision import Vision
    from robot_ik.ports import Array, JointSink
    from robot_ik.robot import Robot


GRACE = 2.0
"""s beyond the planned time in which servos must have arrived where a step names no time limit."""

STATES_OF_MOTION = (ArmState.ENABLED, ArmState.HOLD)


class StepFailed(Exception):
    """A step did not do what it should; the message says what was found."""


def error_classes() -> Mapping[str, type[RobotIkError]]:
    """Name -> class of every error that ``raises`` and ``error`` may name."""
    return {
        name: kind
        for name, kind in vars(errors).items()
        if isinstance(kind, type) and issubclass(kind, errors.RobotIkError)
    }


@dataclass(frozen=True)
class Script:
    """A script and where it came from.

    Attributes:
        content: What it says.
        file: For messages.
        folder: From where paths in it are seen; None: the current one.
    """

    content: ScriptFile
    file: str
    folder: Path | None = None

    @property
    def name(self) -> str:
        """What it is called."""
        return self.content.name

    @property
    def steps(self) -> tuple[ScriptStep, ...]:
        """In order."""
        return self.content.steps

    def wrong(self, problem: str, key: str, allowed: str = "") -> ConfigError:
        """The error for something in this script."""
        return ConfigError(problem, file=self.file, key=key, allowed=allowed)


@dataclass(frozen=True)
class Context:
    """What a step is checked against.

    Attributes:
        robot: Inside the limits of model and arm file together.
        config: The arm.
        simulated: Its servos are; else they are behind a real port.
    """

    robot: Robot
    config: ArmConfig
    simulated: bool


@dataclass
class RunState:
    """Where a run stands.

    Attributes:
        setup: Robot, servos, clock.
        solver: Name of a method.
        seed: Of restarts.
        vision: None where no step looks.
        error: The last error of a step; ``status``: of the last solve; ``seconds``: of the last action.
        begin: When the run began, on its clock.
    """

    script: Script
    setup: RobotSetup
    solver: str
    seed: int
    vision: Vision | None = None
    error: RobotIkError | None = None
    status: str = ""
    seconds: float = 0.0
    begin: float = 0.0
    command: LastCommand = field(init=False)

    def __post_init__(self) -> None:
        self.command = LastCommand(self.setup.robot.home)

    @property
    def robot(self) -> Robot:
        """Inside the limits of model and arm file together."""
        return self.setup.robot

    @property
    def arm(self) -> Arm:
        """The servos; a script never runs without."""
        assert self.setup.arm is not None
        return self.setup.arm

    @property
    def servos(self) -> VirtualBus:
        """The simulated servos; no step that wants them runs on a real port."""
        assert self.arm.virtual_bus is not None
        return self.arm.virtual_bus

    @property
    def config(self) -> ArmConfig:
        """Of the arm."""
        assert self.setup.config is not None
        return self.setup.config

    @property
    def sinks(self) -> list[JointSink]:
        """Who takes commands."""
        return [self.arm, self.command, *self.setup.recorder]

    @property
    def movable(self) -> bool:
        """Whether the arm takes commands."""
        return self.arm.state in STATES_OF_MOTION

    def now(self) -> float:
        """Seconds since the run began."""
        return self.setup.clock.now() - self.begin

    def stand(self) -> None:
        """From here on the arm is taken to have been sent to where it is."""
        self.command.q = self.arm.read().q

    def start(self) -> Array:
        """(nq,) where the next move begins: at the last command, or where the arm is if that is far off.

        From the last command, so that ticks of the servos and the time they take change no plan.
        """
        measured = self.arm.read().q
        near = np.abs(measured - self.command.q).max() <= START_TOLERANCE
        return (self.command.q if near else measured).copy()

    def play(
        self,
        trajectory: Trajectory,
        limit: float | None,
        arrived: Callable[[], bool],
        result: StepResult,
    ) -> None:
        """Sends a trajectory, then waits at its end until ``arrived`` or the time is over.

        Args:
            trajectory: Starts where ``start`` is.
            limit: Seconds for both; None: what was planned and ``GRACE``.
            arrived: Asked after every tick of waiting.
            result: Keeps the trajectory.

        Raises:
            StepFailed: Planned or took longer than ``limit``.
            RobotIkError: Of the arm.
        """
        result.trajectory = trajectory
        result.numbers["planned_s"] = round(trajectory.duration, 6)
        if limit is not None and trajectory.duration > limit:
            planned, permitted = apart(trajectory.duration, limit, digits=2)
            raise StepFailed(f"planned {planned} s, allowed {permitted} s; nothing was sent")
        allowed = trajectory.duration + GRACE if limit is None else limit
        end = self.setup.clock.now() + allowed

        def in_time(tick: object) -> None:
            if self.setup.clock.now() > end + 0.5 * self.arm.config.rate_hz**-1:
                raise StepFailed(f"not there after {allowed:.2f} s")

        execute(trajectory, self.sinks, source=self.arm, clock=self.setup.clock, on_tick=in_time)
        if not arrived():
            self.repeat(end - self.setup.clock.now(), arrived)

    def repeat(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Sends the last command again and again, for ``seconds`` or ``until`` it says so."""
        clock, period = self.setup.clock, 1.0 / self.config.rate_hz
        begin, tick = clock.now(), 1
        while tick * period <= seconds + 1e-9:
            clock.sleep_until(begin + tick * period)
            now = clock.now()
            self.arm.send(self.command.q, now)
            for sink in self.setup.recorder:
                sink.send(self.command.q, now)
            if until():
                return
            tick = max(tick + 1, int((now - begin) / period))
        self.setup.clock.sleep_until(begin + seconds)

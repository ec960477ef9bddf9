"""State of a run: the arm, the last command, and the values that the last step left."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik import errors
from robot_ik.errors import RobotIkError, distinct_texts
from robot_ik.execution import START_TOLERANCE, execute
from robot_ik.hardware import virtual_servos
from robot_ik.motion.trajectory import Trajectory
from robot_ik.workcell.robot_setup import RobotSetup

if TYPE_CHECKING:
    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.virtual.bus import VirtualBus
    from robot_ik.ports import Array
    from robot_ik.robot import Robot
    from robot_ik.script.file import Script
    from robot_ik.workcell.vision import Vision

#: Time after the planned end in which the servos must arrive if a step has no time limit, seconds.
GRACE = 2.0

#: Outcome of a step that did what it should.
PASSED = "passed"
#: Outcome of a step that did not do what it should.
FAILED = "failed"
#: Outcome of the steps after a failed step.
NOT_RUN = "not run"


class StepFailed(Exception):
    """A step failed. The message describes what was measured."""


def error_classes() -> Mapping[str, type[RobotIkError]]:
    """Return the errors that the keys ``raises`` and ``error`` may name, by name."""
    return {
        name: value
        for name, value in vars(errors).items()
        if not name.startswith("_") and isinstance(value, type) and issubclass(value, RobotIkError)
    }


@dataclass
class StepResult:
    """The result of one step.

    Attributes:
        name: Title of the step.
        do: Kind of the step.
        outcome: ``passed``, ``failed`` or ``not run``.
        seconds: Duration on the run's clock.
        found: One line with the measured values, or with the problem.
        numbers: The measured values for programs.
        trajectory: The planned trajectory. None if the step planned none.
    """

    name: str
    do: str
    outcome: str = NOT_RUN
    seconds: float = 0.0
    found: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)
    trajectory: Trajectory | None = field(default=None, repr=False)


@dataclass
class RunState:
    """State of a run.

    Attributes:
        script: The script.
        setup: Robot, arm and clock.
        solver: Name of the solver.
        seed: Random seed of the run.
        vision: The synthetic camera. None if no step needs it.
        error: The last error of a step.
        status: Status of the last solve. Empty before the first one.
        seconds: Duration of the last action, seconds.
        begin: Time on the run's clock at which the steps began, seconds.
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

    @property
    def robot(self) -> Robot:
        """The robot, with the limits of the model and the arm file."""
        return self.setup.robot

    @property
    def arm(self) -> Arm:
        """The arm. Every script has one."""
        if self.setup.arm is None:
            raise RuntimeError("a script needs an arm")
        return self.setup.arm

    @property
    def simulated(self) -> bool:
        """Whether the servos are simulated. Otherwise they are on a real port."""
        return not self.arm.bus.real

    @property
    def servos(self) -> VirtualBus:
        """The simulated servos. Steps that need them do not run on a real port."""
        servos = virtual_servos(self.arm.bus)
        if servos is None:
            raise RuntimeError("this step needs simulated servos")
        return servos

    @property
    def config(self) -> ArmConfig:
        """The arm file."""
        return self.arm.config

    def now(self) -> float:
        """Return the time since the steps began, seconds."""
        return self.setup.clock.now() - self.begin

    def start(self) -> Array:
        """Return the start of the next move, (nq,) joint values in rad and m.

        It is the last command if the arm is near it, and the measured position otherwise. With the
        last command, the resolution and the delay of the servos do not change the plan.
        """
        measured = self.setup.q
        commanded = self.setup.commanded
        is_near = np.abs(measured - commanded).max() <= START_TOLERANCE
        return (commanded if is_near else measured).copy()

    def play(
        self,
        trajectory: Trajectory,
        limit: float | None,
        arrived: Callable[[], bool],
        result: StepResult,
    ) -> None:
        """Send a trajectory and wait until the arm arrived. Write the trajectory into ``result``.

        Args:
            trajectory: The planned motion.
            limit: Longest duration of motion and waiting, seconds. None: the planned duration and
                ``GRACE``.
            arrived: Return whether the arm is at the end of the trajectory.
            result: Result of the step. Its trajectory and its planned duration are set.

        Raises:
            StepFailed: The plan or the motion took longer than ``limit``.
            RobotIkError: The arm failed.
        """
        result.trajectory = trajectory
        result.numbers["planned_s"] = round(trajectory.duration, 6)
        if limit is not None and trajectory.duration > limit:
            planned, permitted = distinct_texts(trajectory.duration, limit, digits=2)
            raise StepFailed(f"planned {planned} s, allowed {permitted} s; nothing was sent")

        clock = self.setup.clock
        allowed = trajectory.duration + GRACE if limit is None else limit
        deadline = clock.now() + allowed
        # A tick at the deadline may be late by rounding, so half a period is tolerated.
        latest_tick = deadline + 0.5 / self.config.rate_hz

        def check_deadline(_tick: object) -> None:
            if clock.now() > latest_tick:
                raise StepFailed(f"not arrived after {allowed:.2f} s")

        execute(
            trajectory,
            self.setup.sinks,
            source=self.setup.opened,
            clock=clock,
            on_tick=check_deadline,
        )
        if not arrived():
            self.setup.repeat(deadline - clock.now(), arrived)

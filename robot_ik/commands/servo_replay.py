"""``robot-ik servo replay``: repeat a recording with an arm."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.arms import ServoReport, driving, load_arm, open_arm_on
from robot_ik.commands.options import (
    ExitPolicy,
    JsonOption,
    MovingBusOptions,
    OverwriteOption,
    RecordFile,
    Speed,
)
from robot_ik.commands.servo_move import joint_text
from robot_ik.commands.terminal import QUIET, Terminal

if TYPE_CHECKING:
    from robot_ik.motion import Trajectory
    from robot_ik.ports import JointSink
    from robot_ik.workcell.replay import ReplayResult


@dataclass(frozen=True)
class ServoReplay(MovingBusOptions, OverwriteOption, JsonOption):
    """Repeat a recording: slowly to its start, then as recorded, within limits and speed caps.

        robot-ik servo replay wave.csv --bus /dev/ttyUSB0 --arm my_arm.toml

    A recording that leaves the limits of the arm file is refused. A recording that is too fast is
    replayed slower. A recording without the joints of the gripper, such as reach writes it, moves
    the arm and holds the gripper. If the arm file has a table [collisions], a recording that would
    touch is refused. At the end, and on Ctrl-C, --on-exit applies: with torque_off the arm falls.

    Exit code 1: the arm did not reach the end of the recording.
    """

    file: Annotated[Path, Parameter(name="FILE.csv", required=True)]
    """Recording of `robot-ik servo record`."""
    speed: Speed = field(default=1.0, kw_only=True)
    """Share of the recorded speed, above 0 and at most 1."""
    record: RecordFile = field(default=None, kw_only=True)
    on_exit: ExitPolicy = field(default=None, kw_only=True)

    def run(self, terminal: Terminal = QUIET) -> ServoReplayReport:
        """Move to the start of the recording and repeat it."""
        from robot_ik.workcell.arm_guard import guard_of
        from robot_ik.workcell.guided_recording import load_playable
        from robot_ik.workcell.replay import replay

        config = load_arm(self.arm)
        part, motion, stretch = load_playable(self.file, config, self.speed)
        held = [name for name in config.names if name not in part.names]
        guard = guard_of(config)
        arm = open_arm_on(self.bus, config, self.on_exit)
        report = ServoReplayReport(motion, stretch, held)
        with contextlib.ExitStack() as stack:
            sinks: list[JointSink] = []
            if self.record is not None:
                from robot_ik.motion.recording import RecordingSink, open_recording

                recording = stack.enter_context(open_recording(self.record, part.names))
                sinks.append(RecordingSink(recording, part.names, arm.positions))
            stack.enter_context(driving(arm, report, terminal))
            report.result = replay(arm, motion, sinks, terminal.busy, guard)
            report.result.require_arrived()
        return report


@dataclass(eq=False)
class ServoReplayReport(ServoReport):
    """A recording that was repeated.

    Attributes:
        motion: The motion within the limits of the arm.
        stretch: Its duration over that of the recording.
        held: Joints that the recording does not have. They are held.
        result: Errors of the joints. None: the motion did not end.
    """

    motion: Trajectory
    stretch: float
    held: Sequence[str]
    result: ReplayResult | None = None

    @property
    def notes(self) -> list[str]:
        if not self.held:
            return []
        return [f"the recording has no {', '.join(self.held)}: held at the present value"]

    def tables(self) -> Iterable[str]:
        if self.result is None:
            return
        error = joint_text(self.result.lagging_joint, self.result.tracking_error)
        yield (
            f"replayed {len(self.motion)} samples in {self.motion.duration:.2f} s "
            f"({self.stretch:.2f} x the recorded time); largest tracking error {error}"
        )

    def facts(self) -> dict[str, Any]:
        facts: dict[str, Any] = {
            "samples": len(self.motion),
            "seconds": self.motion.duration,
            "stretch": self.stretch,
            "held": list(self.held),
        }
        if self.result is not None:
            facts["tracking_error"] = self.result.tracking_error
            facts["final_error"] = self.result.final_error
        return facts

"""``robot-ik servo record``: record an arm while a person guides it by hand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.arms import ServoReport, keeping_error, load_arm, open_arm_on
from robot_ik.commands.options import (
    OUTPUT,
    JsonOption,
    MovingBusOptions,
    OverwriteOption,
    SampleRate,
    Seconds,
)
from robot_ik.commands.prompts import Prompts
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import HardwareError, OptionError, RobotIkError

if TYPE_CHECKING:
    from robot_ik.hardware.config import ArmConfig
    from robot_ik.hardware.servo import Joint
    from robot_ik.motion import Trajectory


@dataclass(frozen=True)
class ServoRecord(MovingBusOptions, OverwriteOption, JsonOption):
    """Record an arm while a person guides it by hand, torque off, until Enter or for --seconds.

        robot-ik servo record wave.csv --bus /dev/ttyUSB0 --arm my_arm.toml

    Ctrl-C ends it too. The samples are kept, and the exit code is 130.

    Exit code 1: no position could be read.
    """

    file: Annotated[Path, Parameter(name="FILE.csv", required=True), OUTPUT]
    """File to write: the measured positions, in rad."""
    seconds: Seconds | None = field(default=None, kw_only=True)
    """Duration, in s. Default: until Enter."""
    rate: SampleRate = field(default=50.0, kw_only=True)

    def run(self, terminal: Terminal = QUIET) -> ServoRecordReport:
        """Record and write the file."""
        from robot_ik.workcell.guided_recording import GuidedRecording

        if self.file.suffix != ".csv":
            raise OptionError("FILE.csv", f"{self.file}", "a name that ends in .csv")
        config = load_arm(self.arm)
        arm = open_arm_on(self.bus, config, None)
        # The prompts may raise an error, so they come before the arm is connected.
        prompts = Prompts(
            terminal, arm.clock, self.seconds, 1.0 / self.rate, alternative="--seconds S"
        )
        report = ServoRecordReport(self.file)
        terminal.end_progress()
        with arm:
            recording = GuidedRecording(arm)
            with keeping_error(report):
                try:
                    prompts.step("recording: guide the arm by hand", recording.sample)
                except BaseException as error:
                    report.save(recording.motion(), config)
                    if not isinstance(error, Exception):  # Ctrl-C, SIGTERM
                        terminal.show(report)
                    raise
                report.save(recording.motion(), config)
        return report


@dataclass(eq=False)
class ServoRecordReport(ServoReport):
    """A recording.

    Attributes:
        file: CSV file.
        motion: The samples. None: no position could be read.
        beyond: Joints that left their limits, and by how much at most, rad (slides: m).
    """

    file: Path
    motion: Trajectory | None = None
    beyond: list[tuple[Joint, float]] = field(default_factory=list)

    def save(self, motion: Trajectory | None, config: ArmConfig) -> None:
        """Write the file, if there are samples."""
        from robot_ik.files import write_atomically
        from robot_ik.workcell.guided_recording import measured_table, outside

        self.motion = motion
        if motion is not None:
            write_atomically(self.file, measured_table(motion))
            self.beyond = outside(motion, config)

    @property
    def ok(self) -> bool:
        return self.error is None and self.motion is not None

    @property
    def failure(self) -> RobotIkError | None:
        if self.error is None and self.motion is None:
            return HardwareError("no servo position could be read")
        return self.error

    @property
    def notes(self) -> list[str]:
        return [
            f"{joint.name} was {joint.text(excess)} beyond its limits, so servo replay rejects it"
            for joint, excess in self.beyond
        ]

    def tables(self) -> Iterable[str]:
        if self.motion is not None:
            yield f"{self.file}: {len(self.motion)} samples, {self.motion.duration:.2f} s"

    def facts(self) -> dict[str, Any]:
        samples = 0 if self.motion is None else len(self.motion)
        duration = 0.0 if self.motion is None else self.motion.duration
        return {"file": str(self.file), "samples": samples, "seconds": duration}

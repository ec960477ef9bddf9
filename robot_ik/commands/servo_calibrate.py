"""``robot-ik servo calibrate``: measure ranges, zeros and directions by hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.arms import ServoReport, keeping_error, load_arm, open_arm_on
from robot_ik.commands.options import OUTPUT_GROUP, BusOptions, JsonOption, OverwriteOption
from robot_ik.commands.prompts import Prompts
from robot_ik.commands.servo_move import parse_angles
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.hardware.arm import Arm
    from robot_ik.hardware.calibration_file import Calibration
    from robot_ik.hardware.config import ArmConfig

COLUMNS = ("joint", "id", "swept ticks", "zero", "direction", "limits", "limits before")
"""Columns of the table of a calibration."""


@dataclass(frozen=True)
class ServoCalibrate(BusOptions, OverwriteOption, JsonOption):
    """Calibrate an arm by hand, torque off: sweep all joints, hold a pose, turn each joint.

        robot-ik servo calibrate my_arm.toml --arm koch_v11

    --arm gives names, ids, models, modes and limits. OUT.toml becomes the calibrated arm file, and
    OUT.calibration.toml beside it holds the measurements. From then on use --arm OUT.toml. The
    commands that move the arm compare both files with the servos, and refuse an arm that differs.
    Enter ends each step.

    Exit code 1: a step failed.
    """

    out: Annotated[Path, Parameter(name="OUT.toml", required=True)]
    """The calibrated arm file."""
    pose: Annotated[
        tuple[str, ...],
        Parameter(metavar="JOINT=DEG …", consume_multiple=True, allow_repeating=True),
    ] = field(default=(), kw_only=True)
    """Pose in which the zeros are taken. Default: all joints at 0."""
    from_lerobot: Annotated[Path | None, Parameter(metavar="FILE.json")] = field(
        default=None, kw_only=True
    )
    """Use a calibration of LeRobot instead. Its 0 degrees is the middle of a range."""
    to_lerobot: Annotated[Path | None, Parameter(metavar="FILE.json", group=OUTPUT_GROUP)] = field(
        default=None, kw_only=True
    )
    """Also write the calibration as LeRobot's file."""
    check: bool = field(default=False, kw_only=True)
    """Only compare an existing OUT.toml and its calibration with the servos."""

    def run(self, terminal: Terminal = QUIET) -> ServoCalibrateReport:
        """Measure, check, and write both files."""
        from robot_ik.hardware.calibration_file import calibration_beside
        from robot_ik.workcell.results import claimed

        if self.out.suffix != ".toml" or self.out.name.endswith(".calibration.toml"):
            raise OptionError("OUT.toml", f"{self.out}", "a name that ends in .toml")
        if self.check:
            return self._check()
        # Without its file: an earlier calibration may be wrong, which is a reason to calibrate.
        config = replace(load_arm(self.arm), file=None)
        pose = dict.fromkeys(config.names, 0.0)
        if self.pose:
            pose |= parse_angles(self.pose, config)
        beside = calibration_beside(self.out)
        with claimed(self.out, beside, self.to_lerobot, overwrite=self.overwrite):
            return self._calibrate(config, pose, terminal)

    def _calibrate(
        self, config: ArmConfig, pose: Mapping[str, float], terminal: Terminal
    ) -> ServoCalibrateReport:
        from robot_ik.workcell.hand_calibration import require_limp, save_calibrated

        arm = open_arm_on(self.bus, config, None)
        measure = self._measurement(arm, pose, terminal)
        report = ServoCalibrateReport(self.out)
        terminal.end_progress()
        with arm:
            require_limp(arm)
            with keeping_error(report):
                calibration = measure()
                report.after = save_calibrated(arm, calibration, self.out, self.to_lerobot)
                report.before = arm.config
                report.calibration = calibration
        return report

    def _measurement(
        self, arm: Arm, pose: Mapping[str, float], terminal: Terminal
    ) -> Callable[[], Calibration]:
        """Return the function that measures, or reads the file of LeRobot."""
        from robot_ik.hardware.lerobot_calibration import load_lerobot
        from robot_ik.hardware.model_check import model_limits
        from robot_ik.workcell.hand_calibration import calibrate_by_hand

        limits = model_limits(arm.config)
        if self.from_lerobot is not None:
            return partial(load_lerobot, self.from_lerobot, arm.config, limits)
        # The prompts may raise an error, so they come before the arm is connected.
        prompts = Prompts(terminal, arm.clock)
        return partial(calibrate_by_hand, arm, prompts, pose, limits)

    def _check(self) -> ServoCalibrateReport:
        from robot_ik.hardware.calibration import check_calibration
        from robot_ik.hardware.calibration_file import Calibration, calibration_beside
        from robot_ik.hardware.lerobot_calibration import save_lerobot
        from robot_ik.workcell.results import claimed

        calibration = Calibration.load(calibration_beside(self.out))
        config = load_arm(self.out)
        with claimed(self.to_lerobot, overwrite=self.overwrite):
            with open_arm_on(self.bus, config, None) as arm:  # compares calibration and model
                check_calibration(arm.bus, config, calibration)
            if self.to_lerobot is not None:
                save_lerobot(self.to_lerobot, calibration)
        return ServoCalibrateReport(self.out, checked=True)


@dataclass(eq=False)
class ServoCalibrateReport(ServoReport):
    """A calibration, and the arm file before and after it.

    Attributes:
        out: The calibrated arm file.
        checked: An existing calibration was compared with the servos, and agrees.
        calibration: The measurements. None: nothing was measured.
        before: Arm file before.
        after: Arm file after.
    """

    out: Path
    checked: bool = False
    calibration: Calibration | None = None
    before: ArmConfig | None = None
    after: ArmConfig | None = None

    def tables(self) -> Iterable[Table | str]:
        if self.checked:
            yield f"{self.out}, its calibration, model and servos agree"
        if self.calibration is not None:
            yield table(*COLUMNS, rows=self._rows())
            beside = self.out.with_suffix(".calibration.toml")
            yield f"wrote {self.out} and {beside}; from here on: --arm {self.out}"

    def facts(self) -> dict[str, Any]:
        rows = () if self.calibration is None else self.calibration.rows
        servos = [
            {
                "joint": row.name,
                "id": row.id,
                "range_ticks": [row.range_min, row.range_max],
                "zero_ticks": row.zero_ticks,
                "direction": row.direction,
            }
            for row in rows
        ]
        return {"file": str(self.out), "checked": self.checked, "servos": servos}

    def _rows(self) -> Sequence[tuple[object, ...]]:
        if self.calibration is None or self.before is None or self.after is None:
            return ()
        rows = []
        drives = zip(self.before.drives, self.after.drives, self.calibration.rows, strict=True)
        for old, new, row in drives:
            limits, old_limits = (
                f"{joint.lower / joint.per_unit:.1f} .. {joint.text(joint.upper)}"
                for joint in (new.joint, old.joint)
            )
            swept = f"{row.range_min} .. {row.range_max}"
            direction = f"{row.direction:+d}"
            rows.append((row.name, row.id, swept, row.zero_ticks, direction, limits, old_limits))
        return rows

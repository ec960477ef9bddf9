"""``robot-ik camera verify``: measure the errors of an arm, and the zero offsets of its joints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.camera_arm import (
    ArmCameraOptions,
    Views,
    found_numbers,
    measure,
    plan_facts,
    plan_table,
)
from robot_ik.commands.options import (
    OUTPUT,
    OUTPUT_GROUP,
    BoardPose,
    ExtrinsicsFile,
    ResultFile,
    Seed,
    parse_pairs,
    parse_pose,
)
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from robot_ik.camera.calibration.kinematic import PoseError, ZeroOffsets
    from robot_ik.camera.calibration.observability import Unobservable
    from robot_ik.ports import Array
    from robot_ik.workcell.arm_camera.verify import VerifyReport, VerifyRequest

FAULT_FORM = "zero-offset:JOINT=DEG"
"""Form of ``--fault``."""

NAMED_SHARE = 0.25
"""Parts of a direction smaller than this share of its largest part are not named."""

NAMED_LEVER = 0.02
"""m/rad. A shift that goes with a rotation of the joints is named from this length on."""

ALONG_AXIS = 0.98
"""Cosine of the angle to an axis from which a direction counts as along the axis."""


@dataclass(frozen=True, kw_only=True)
class CameraVerify(ArmCameraOptions):
    """Measure how far an arm is from where its joints say, with a board that the arm carries.

    The camera stands beside the arm. Its pose must come from a board on the table (`camera
    locate`), not from the arm. By default everything is simulated. With --fit the zero offsets of
    the joints are estimated. After a confirmation they are written to the file of --arm. The old
    file is kept, and servos are never changed. Ctrl-C keeps the samples; --samples evaluates them.

        robot-ik camera verify --fault zero-offset:joint2=1.5

    Exit code 1: with the zeros that are now on file, a pose has an error above --tolerance-mm.
    """

    extrinsics: ExtrinsicsFile = None
    board_pose: BoardPose = ()
    views: Views = 30
    tolerance_mm: Annotated[float, Parameter(metavar="MM", validator=Number(gt=0, lt=math.inf))] = (
        5.0
    )
    """Largest error of a pose with which the arm passes, in mm."""
    fit: bool = False
    """Estimate the zero offsets of the joints."""
    yes: bool = False
    """Skip the confirmation."""
    fault: Annotated[
        tuple[str, ...],
        Parameter(
            metavar=f"{FAULT_FORM} …",
            consume_multiple=True,
            allow_repeating=True,
            help="Faults to inject. Only zero offsets: the shaft is ahead of the registers.",
        ),
    ] = ()
    seed: Seed = 0
    out: ResultFile = Path("verify.samples.json")
    plot: Annotated[Path | None, Parameter(metavar="FILE.png", group=OUTPUT_GROUP), OUTPUT] = None
    """Draw plots of the results (extra `plots`)."""

    def written_files(self) -> list[Path]:
        """Return the files that this run writes."""
        if self.dry_run:
            return []
        files = [self.out] if self.samples is None else []
        return files if self.plot is None else [*files, self.plot]

    def run(self, terminal: Terminal = QUIET) -> CameraVerifyReport:
        """Measure, or evaluate earlier samples, and write the zeros after a confirmation."""
        from robot_ik.files import make_folder, write_atomically
        from robot_ik.workcell.arm_camera import verify
        from robot_ik.workcell.arm_camera.error_map import error_picture
        from robot_ik.workcell.arm_camera.samples import VerifySamples
        from robot_ik.workcell.results import require_plots

        request = self.request()
        if self.plot is not None:
            require_plots("the plot of the errors")
        if self.fit and self.arm:
            make_folder(Path(self.arm).parent)  # the zeros are written there at the end
        if self.samples is not None:
            measured = verify.verify_from_samples(VerifySamples.load(self.samples), request)
        else:
            job = partial(verify.run_verify, request)
            command = "robot-ik camera verify --fit" if self.fit else "robot-ik camera verify"
            measured = measure(job, self.out, command, terminal)
        report = CameraVerifyReport(self, measured)
        if self.dry_run:
            return report
        if self.plot is not None:
            write_atomically(self.plot, error_picture(measured.error_maps()))
            terminal.say(f"wrote {self.plot}", "green")
        if not self.json:
            terminal.show(report)
        report.written = self._write_zeros(measured, terminal)
        return report

    def request(self) -> VerifyRequest:
        """Return the request of the options.

        Raises:
            OptionError: An option is invalid.
            CameraError: The board is invalid.
        """
        from robot_ik.workcell.arm_camera.verify import VerifyRequest
        from robot_ik.workcell.robot_setup import Rehearsal

        if self.plot is not None and self.plot.suffix.lower() != ".png":
            problem = f"no plot is written as {self.plot}"
            raise OptionError("--plot", problem, "a name that ends in .png")
        if self.yes and not (self.fit and self.arm):
            raise OptionError("--yes", "there is nothing to write", "with --fit and --arm FILE")
        return VerifyRequest(
            **self.request_values("zeros"),
            views=self.views,
            seed=self.seed,
            fit=self.fit,
            extrinsics=self.extrinsics,
            pose_other_board=parse_pose("--board-pose", self.board_pose),
            rehearsal=Rehearsal(parse_zero_offsets(self.fault)),
        )

    def _write_zeros(self, measured: VerifyReport, terminal: Terminal) -> bool:
        """Write the zeros to the arm file after a confirmation. Return whether it was written."""
        from robot_ik.hardware.calibration_file import write_zeros

        offsets = measured.offsets()
        config = measured.config
        changed = measured.zero_ticks()
        if not offsets:
            return False
        if config is not None and not changed:
            terminal.say("no zero changes by a tick: the arm file is right")
            return False
        arm = Path(self.arm).expanduser()
        if config is None or not self.arm or config.file != arm:
            # The arm file of a bundled robot is never changed.
            text = "nothing is written: to keep these zeros, give your arm file with --arm"
            terminal.say(text, "yellow")
            return False
        if not measured.better:
            terminal.say("with these zeros the arm is no better: nothing is written", "yellow")
            return False
        zeros = (f"{name} {before} -> {after}" for name, (before, after) in changed.items())
        terminal.say(f"zero_ticks: {', '.join(zeros)}")
        if not self.yes and not terminal.confirm(f"write them to {self.arm}?"):
            terminal.say(f"{self.arm} is not changed", "yellow")
            return False
        backups = write_zeros(arm, config, offsets)
        terminal.say(f"wrote {self.arm}; before: {', '.join(map(str, backups))}", "green")
        return True


@dataclass(eq=False)
class CameraVerifyReport(Report):
    """The errors of the arm, or the planned poses.

    Attributes:
        command: The options.
        measured: The measurement. A dry run has no errors.
        written: Whether the zeros were written to the arm file.
    """

    command: CameraVerify
    measured: VerifyReport
    written: bool = field(default=False, init=False)

    @property
    def ok(self) -> bool:
        if self.command.dry_run:
            return True
        tolerance = 1e-3 * self.command.tolerance_mm
        return self.measured.passed(tolerance, corrected=self.written)

    def tables(self) -> Iterable[RenderableType]:
        measured = self.measured
        if self.command.dry_run:
            yield plan_table("pose", measured.robot.joints, measured.stations)
            return
        yield self._pose_table()
        yield region_table("the arm with its current zeros", measured.judged(corrected=False))
        if measured.samples.by_arm:
            yield (
                "The camera's pose was measured with this arm, so it contains the error that all "
                "poses share.\nOnly errors that differ between poses show; see robot-ik camera "
                "locate."
            )
        if measured.fit is not None:
            yield offset_table(measured.fit, measured.samples.true_offsets)
            for row in measured.fit.unobservable:
                yield f"{unobservable_text(row, measured.samples.frame)}: {row.joint} is held"
            title = "with the new zeros: each pose by the fit to all others"
            yield region_table(title, measured.judged(corrected=True))
        if measured.unseen:
            yield "board not seen at " + ", ".join(str(k + 1) for k in measured.unseen)
        yield self._verdict("with the current zeros", corrected=False)
        if measured.fit is not None:
            yield self._verdict("with the new zeros", corrected=True)

    def _verdict(self, label: str, *, corrected: bool) -> str:
        largest = 1e3 * max(error.distance for error in self.measured.judged(corrected=corrected))
        tolerance = self.command.tolerance_mm
        verdict = "within" if largest <= tolerance else "beyond"
        return (
            f"largest error {label}: {largest:.2f} mm, {verdict} the tolerance of {tolerance:g} mm"
        )

    def _pose_table(self) -> Table:
        measured = self.measured
        columns = ["pose", "x", "y", "z", "error: mm", "sigma", "deg", "sigma"]
        if measured.fit is not None:
            columns += ["new zeros: mm", "sigma"]
        numbers = found_numbers(len(measured.errors), measured.unseen)
        rows = []
        for index, error in enumerate(measured.errors):
            row: list[object] = [numbers[index]]
            row += [f"{1e3 * value:z.0f}" for value in error.position]
            row += [f"{1e3 * error.distance:.2f}", f"{1e3 * error.sigma:.2f}"]
            row += [f"{math.degrees(error.angle):.3f}", f"{math.degrees(error.sigma_angle):.3f}"]
            if measured.fit is not None:
                fitted = measured.fit.errors[index]
                row += [f"{1e3 * fitted.distance:.2f}", f"{1e3 * fitted.sigma:.2f}"]
            rows.append([*row, self._remark(index)])
        return table(*columns, "", rows=rows, title="poses, mm")

    def _remark(self, index: int) -> str:
        fit = self.measured.fit
        if fit is not None and index in fit.outliers:
            return "contradicts the others: does not count"
        return "measured badly: does not count" if index in self.measured.excluded else ""

    def facts(self) -> dict[str, Any]:
        from robot_ik.workcell.arm_camera.error_map import regions

        measured = self.measured
        facts = plan_facts(measured, "verify")
        if self.command.dry_run:
            return facts
        samples = measured.samples
        facts |= {
            "tolerance_mm": self.command.tolerance_mm,
            "passed": self.ok,
            "written": self.written,
            "extrinsics_by_arm": samples.by_arm,
            "poses": [
                {**error_facts(error), "q": q}
                for error, q in zip(measured.errors, samples.q, strict=True)
            ],
            "excluded": measured.excluded,
            "regions": regions(measured.judged(corrected=False)),
        }
        if measured.fit is not None:
            facts["fit"] = self._fit_facts(measured.fit)
        return facts

    def _fit_facts(self, fit: ZeroOffsets) -> dict[str, Any]:
        import numpy as np

        from robot_ik.workcell.arm_camera.error_map import regions

        samples = self.measured.samples
        sigmas = zip(fit.joints, np.asarray(fit.sigma).tolist(), strict=True)
        return {
            "offsets_rad": fit.offsets,
            "sigma_rad": [sigma if name in fit.determined else None for name, sigma in sigmas],
            "true_rad": samples.true_offsets,
            "held": [
                {"joint": row.joint, "why": unobservable_text(row, samples.frame)}
                for row in fit.unobservable
            ],
            "singular_values": fit.singular_values,
            "joint_noise_rad": fit.joint_noise,
            "residual_px": fit.residual_px,
            "outliers": fit.outliers,
            "poses": [error_facts(error) for error in fit.errors],
            "regions": regions(self.measured.judged(corrected=True)),
        }


def parse_zero_offsets(items: Iterable[str]) -> dict[str, float]:
    """Return joint -> degrees of ``--fault``.

    Raises:
        OptionError: An item has another form.
    """
    offsets = []
    for item in items:
        kind, _, offset = item.partition(":")
        if kind.replace("_", "-") != "zero-offset":
            raise OptionError("--fault", f"cannot use {item!r}", FAULT_FORM)
        offsets.append(offset)
    return parse_pairs("--fault", offsets, FAULT_FORM)


def region_table(title: str, errors: Sequence[PoseError]) -> Table:
    """Return statistics over all poses and over the halves of the workspace."""
    from robot_ik.workcell.arm_camera.error_map import regions

    columns = ("board at", "poses", "RMS mm", "median", "max", "RMS deg", "sigma mm")
    rows = [
        (
            region.name,
            region.poses,
            f"{1e3 * region.rms_m:.2f}",
            f"{1e3 * region.median_m:.2f}",
            f"{1e3 * region.largest_m:.2f}",
            f"{math.degrees(region.rms_rad):.3f}",
            f"{1e3 * region.sigma_m:.2f}",
        )
        for region in regions(errors)
    ]
    return table(*columns, rows=rows, title=title)


def offset_table(fit: ZeroOffsets, true_offsets: Array | None) -> Table:
    """Return the zero offsets of the joints, and the true ones if they are known."""
    columns = ["joint", "offset: deg", "sigma"]
    if true_offsets is not None:
        columns.append("true")
    rows = []
    for index, name in enumerate(fit.joints):
        sigma = f"{math.degrees(fit.sigma[index]):.3f}" if name in fit.determined else "held"
        row = [name, f"{math.degrees(fit.offsets[index]):z.3f}", sigma]
        if true_offsets is not None:
            row.append(f"{math.degrees(true_offsets[index]):z.3f}")
        rows.append(row)
    return table(*columns, rows=rows, title="joint zeros")


def error_facts(error: PoseError) -> dict[str, Any]:
    """Return the error of a pose in metres and rad."""
    return {
        "position_m": error.position,
        "off_m": error.vector,
        "off_rad": error.angle,
        "sigma_m": error.sigma,
        "sigma_rad": error.sigma_angle,
    }


def unobservable_text(unobservable: Unobservable, frame: str) -> str:
    """Return what the views cannot distinguish, in one sentence.

    Args:
        unobservable: The combination of joint offsets.
        frame: Frame of the robot that carries the board.
    """
    import numpy as np

    direction = unobservable.direction
    largest = np.abs(direction).max()
    order = np.argsort(-np.abs(direction), kind="stable").tolist()
    parts = [
        f"the offset of {unobservable.joints[k]}"
        for k in order
        if abs(direction[k]) >= NAMED_SHARE * largest
    ]
    twists = (
        ("camera", "the world", unobservable.poses[:6]),
        ("board", frame, unobservable.poses[6:]),
    )
    for name, parent, twist in twists:
        if np.linalg.norm(twist[3:]) >= NAMED_SHARE:
            axis = axis_text(twist[3:])
            parts.append(f"the rotation of the {name} about {axis} of {parent}")
        elif np.linalg.norm(twist[:3]) >= NAMED_LEVER:
            axis = axis_text(twist[:3])
            parts.append(f"the shift of the {name} along {axis} of {parent}")
    if len(parts) == 1:
        return f"{parts[0]} does not show in these views"
    return f"{', '.join(parts[:-1])} and {parts[-1]} look the same"


def axis_text(vector: Array) -> str:
    """Return ``z``, or the components of a direction that is along no axis."""
    import numpy as np

    unit = vector / np.linalg.norm(vector)
    index = int(np.argmax(np.abs(unit)))
    if abs(unit[index]) > ALONG_AXIS:
        return "xyz"[index]
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in unit) + ")"

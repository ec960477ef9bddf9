"""``robot-ik figure``: let a humanoid see a ball, decide, and reach, bend, jump or walk."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from robot_ik.commands.options import (
    BoardName,
    CameraSource,
    Dictionary,
    DrawnScale,
    DrawnVideo,
    IntrinsicsFile,
    JsonOption,
    MarkerSize,
    OverwriteOption,
    RecordFile,
    RobotName,
    RobotPose,
    Seconds,
    Seed,
    TargetMarker,
    parse_robot_pose,
)
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from robot_ik.commands.figure_runs import Performance
    from robot_ik.figure.abilities import Abilities
    from robot_ik.figure.figure import Figure as Humanoid
    from robot_ik.figure.lion import Lion
    from robot_ik.figure.session import FigureFrame
    from robot_ik.robot import Robot
    from robot_ik.testbed.ar.overlay import ArRequest

# MuJoCo, Numba and OpenCV take 1.1 s to import, --help takes 0.1 s: the methods import them.

BALLS = (
    (0.45, -0.25, 1.45),
    (0.5, -0.2, 0.2),
    (2.2, 0.8, 1.2),
    (2.6, 0.9, 2.35),
)
"""Balls without --ball, m: one to reach, one to bend for, one to walk to, one to jump for."""

LION_BALLS = (
    (0.9, -0.2, 0.6),
    (0.7, 0.4, 0.5),
)
"""Balls for a lion without --ball, m: one for each front paw."""

UNSEEN_SIZE = (640, 360)
"""px. Synthetic pictures without --video. The ball is located to 4 mm in a quarter of the time."""


@dataclass(frozen=True, kw_only=True)
class Figure(OverwriteOption, JsonOption):
    """Let a figure see a ball, decide what to do, and do it: reach, bend, jump, walk, or nothing.

    By default the figure is shown four balls, one after the other. With --camera the ball is a
    printed marker, seen above the board on which the figure stands, and --video draws the figure
    into the pictures. Frames are 60 a second.

        robot-ik figure --ball 0.5 -0.2 0.2 --video bend.mp4
        robot-ik figure --camera 0 --intrinsics camera.yaml --video ar.mp4

    Exit code 0: every hand reached its ball within 5 mm. 1: a hand did not, or cannot.
    """

    robot: RobotName = "humanoid"
    ball: Annotated[tuple[float, float, float] | None, Parameter(metavar="X Y Z")] = None
    """Position of the ball, in metres."""
    path: Annotated[Literal["circle", "random"] | None, Parameter(metavar="circle|random")] = None
    """Motion of the ball, instead of --ball."""
    robot_pose: RobotPose = ()
    camera: Annotated[CameraSource, Parameter(help="Image source. Default: no camera.")] = ""
    intrinsics: IntrinsicsFile = None
    board: BoardName = "grid:2x2:50:12.5"
    dictionary: Dictionary = ""
    marker: TargetMarker = 9
    marker_size: MarkerSize = 0.05
    scale: DrawnScale = None
    seconds: Annotated[
        Seconds, Parameter(help="Duration, in s. Of a ball that moves, or of the pictures.")
    ] = 12.0
    seed: Seed = 0
    viewer: bool = False
    """Show the motion live. A MuJoCo window, which stays open until you close it."""
    video: DrawnVideo = None
    record: RecordFile = None

    def run(self, terminal: Terminal = QUIET) -> FigureReport:
        """Show the balls to the figure, and write the files."""
        self._require_possible()
        from robot_ik.figure.lion import Lion, is_lion
        from robot_ik.motion.recording import require_recording
        from robot_ik.robot import load_robot

        if self.record is not None:
            require_recording(self.record)
        terminal.progress("loading")
        robot = load_robot(self.robot)
        if robot.file.figure is None and is_lion(robot):
            if self.path or self.camera:
                option = "--path" if self.path else "--camera"
                raise OptionError(option, f"{robot.name} does not walk", "with --ball")
            lion = Lion(robot)
            report = self._run_lion(lion, terminal)
        else:
            report = self._run_figure(make_abilities(robot, terminal), terminal)
        if self.video is not None and not self.camera:
            from robot_ik.commands.figure_film import save_film

            terminal.progress(f"drawing {self.video}")
            frames = report.performance.frames
            progress = terminal.counting("picture")
            save_film(robot, frames, self.video, progress, overwrite=self.overwrite)
        return report

    def _require_possible(self) -> None:
        """Check the options that exclude each other.

        Raises:
            OptionError: Two options cannot be used together, or a number is not finite.
        """
        given = [name for name in ("ball", "path", "camera") if getattr(self, name)]
        if len(given) > 1:
            problem = f"--{given[0]} is given, too"
            raise OptionError(f"--{given[1]}", problem, "one of --ball, --path and --camera")
        if self.ball is not None and not all(map(math.isfinite, self.ball)):
            raise OptionError("--ball", f"{self.ball}", "three finite numbers, in metres")
        if self.camera and self.video is not None and self.viewer:
            raise OptionError("--viewer", "--video draws into the pictures", "one of both")
        self._stance()

    def _stance(self) -> tuple[float, float, float]:
        """Return x, y (m) and heading (rad) of the figure at the start.

        Raises:
            OptionError: The numbers are not a pose on the floor.
        """
        x, y, z, yaw = parse_robot_pose(self.robot_pose)
        if z != 0.0:
            problem = f"a figure starts on the floor, not at z = {z:g} m"
            raise OptionError("--robot-pose", problem, "X Y 0 [YAW_DEG]: metres, degrees")
        return x, y, math.radians(yaw)

    def _balls(self) -> tuple[tuple[float, float, float], ...]:
        """Return the balls that do not move."""
        if self.ball is not None:
            return (self.ball,)
        return () if self.path or self.camera else BALLS

    def _run_lion(self, lion: Lion, terminal: Terminal) -> FigureReport:
        from robot_ik.commands.figure_runs import run_lion

        balls = LION_BALLS if self.ball is None else (self.ball,)
        paws = {paw: paw for paw in lion.paws}
        performance = self._watch(lion.robot, paws, run_lion(lion, balls), terminal)
        self._save_recording(lion.robot, None, performance)
        return FigureReport(self, performance)

    def _run_figure(self, abilities: Abilities, terminal: Terminal) -> FigureReport:
        from robot_ik.commands.figure_runs import FigureRequest, run_figure, run_marker

        stance = self._stance()
        figure = abilities.figure
        notes: list[str] = []
        if not self.camera:
            request = FigureRequest(self._balls(), self.path, self.seconds, stance, self.seed)
            frames = run_figure(abilities, request)
        elif self.video is None:
            from robot_ik.testbed.ar.overlay import marker_positions

            positions = marker_positions(self._drawing(), figure.robot)
            frames = run_marker(abilities, stance, positions)
        else:
            frames = self._draw(abilities, stance, notes, terminal)
        performance = self._watch(figure.robot, figure.hands, frames, terminal)
        self._save_recording(figure.robot, figure, performance)
        return FigureReport(self, performance, notes)

    def _save_recording(
        self, robot: Robot, humanoid: Humanoid | None, performance: Performance
    ) -> None:
        """Write the file of ``--record``, if it is given."""
        if self.record is None:
            return
        from robot_ik.commands.figure_recording import save_recording

        save_recording(robot, humanoid, performance.frames, self.record, self.seed)

    def _drawing(self) -> ArRequest:
        """Return the pictures of the camera, and what is drawn into them."""
        from robot_ik.testbed.ar.overlay import ArRequest

        is_unseen = self.camera == "synthetic" and self.video is None
        return ArRequest(
            robot=self.robot,
            camera=self.camera,
            intrinsics=self.intrinsics,
            board=self.board,
            dictionary=self.dictionary,
            scale=self.scale or 0.0,
            motion="follow",
            marker=(self.marker, self.marker_size or 0.05),
            out=self.video or Path("ar.mp4"),
            overwrite=self.overwrite,
            seconds=self.seconds,
            size=UNSEEN_SIZE if is_unseen else None,
            seed=self.seed,
        )

    def _draw(
        self,
        abilities: Abilities,
        stance: tuple[float, float, float],
        notes: list[str],
        terminal: Terminal,
    ) -> Iterator[FigureFrame]:
        """Draw the figure into the pictures of the camera. Append to ``notes``."""
        from robot_ik.commands.figure_runs import draw_on_camera

        progress = terminal.counting("picture")
        drawing, frames = draw_on_camera(abilities, stance, self._drawing(), progress)
        if drawing.notice:
            notes.append(drawing.notice)
        notes.append(f"{drawing.pictures} pictures, the figure in {drawing.drawn}: {drawing.file}")
        if drawing.interrupted:
            terminal.say(notes[-1], "yellow")
            raise KeyboardInterrupt
        return iter(frames)

    def _watch(
        self,
        robot: Robot,
        hands: Mapping[str, str],
        frames: Iterator[FigureFrame],
        terminal: Terminal,
    ) -> Performance:
        """Run through the frames, in a window with ``--viewer``."""
        from robot_ik.commands.figure_runs import watch

        if not self.viewer:

            def show_progress(frame: FigureFrame) -> None:
                share = frame.t / self.seconds if self.path else 0.0
                terminal.progress(f"{frame.t:.1f} s {frame.action}", share)

            return watch(robot, hands, frames, show_progress)
        return self._watch_in_window(robot, hands, frames)

    def _watch_in_window(
        self, robot: Robot, hands: Mapping[str, str], frames: Iterator[FigureFrame]
    ) -> Performance:
        import numpy as np

        from robot_ik.commands.figure_film import BALL_RADIUS, TILES
        from robot_ik.commands.figure_runs import watch
        from robot_ik.geometry import Pose
        from robot_ik.ports import RealClock
        from robot_ik.schedule import Schedule
        from robot_ik.testbed.frontends.window import Solid, WindowSink

        floor = [Solid(Pose(position), half, rgba) for position, half, rgba in TILES]
        x, y, _ = self._stance()
        see = np.array([(x, y, 0.0), *self._balls()])
        hint = "run it without --viewer, or film it with --video"
        window = WindowSink(robot, ball=BALL_RADIUS, see=see, solids=floor, instead=hint)
        with window:
            ticks = Schedule(RealClock()).ticks((frame.t, frame) for frame in frames)

            def show(frame: FigureFrame) -> None:
                window.show_ball(frame.ball)
                window.show_text(frame.action, frame.decision.reason)
                window.send(frame.q, frame.t)

            performance = watch(robot, hands, (frame for _, frame in ticks), show)
            window.wait()
        return performance


@dataclass(frozen=True, eq=False)
class FigureReport(Report):
    """What the figure decided, and how near its hands came to the balls.

    Attributes:
        command: The options.
        performance: Frames, decisions and errors.
        remarks: What happened to the pictures of the camera.
    """

    command: Figure
    performance: Performance
    remarks: Sequence[str] = ()

    @property
    def ok(self) -> bool:
        """Whether every hand came to its ball, and the given ball was tried at all."""
        tried = bool(self.performance.errors) or self.command.ball is None
        return tried and self.performance.arrived

    @property
    def notes(self) -> Sequence[str]:
        """Return what happened to the pictures of the camera."""
        return self.remarks

    def facts(self) -> dict[str, Any]:
        """Return the JSON object."""
        performance = self.performance
        return {
            "decisions": [{"t": t, **asdict(decision)} for t, decision in performance.decisions],
            "errors": [
                {"action": action, "error_m": error} for action, error in performance.errors
            ],
            "frames": len(performance.frames),
        }

    def tables(self) -> Iterable[Any]:
        """Return the decisions, and the errors of the hands."""
        performance = self.performance
        rows: list[tuple[str, ...]] = []
        for t, decision in performance.decisions:
            row = (decision.action, decision.arm or "", decision.reason)
            if not rows or rows[-1][1:] != row:  # a moving ball repeats decisions
                rows.append((f"{t:.2f}", *row))
        yield table("s", "decision", "hand", "why", rows=rows)
        errors = [f"{action} {1000 * error:.2f} mm" for action, error in performance.errors]
        count = len(performance.frames)
        touches = ", ".join(errors) or "no touch"
        yield f"{count} frames, {count / 60.0:.1f} s; hand from the ball: {touches}"


def make_abilities(robot: Robot, terminal: Terminal) -> Abilities:
    """Return what a figure can do. It is computed once for each model.

    Raises:
        RobotIkError: The robot is no figure.
    """
    from robot_ik.figure.abilities import load_abilities
    from robot_ik.figure.figure import load_figure

    return load_abilities(load_figure(robot), progress=terminal.counting("point"))

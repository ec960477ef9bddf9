"""``robot-ik reach``: the main job on the terminal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.text import Text
from tyro.conf import arg

from robot_ik.catalogue import SERVO_ROBOT, SHOWN_ROBOT
from robot_ik.cli import console
from robot_ik.cli.arguments import wrong
from robot_ik.cli.bus_argument import bus_argument, robot_meant
from robot_ik.cli.solve_command import make_goal
from robot_ik.environment import import_mujoco
from robot_ik.errors import InvalidGoalError

if TYPE_CHECKING:
    from robot_ik.geometry import Pose
    from robot_ik.jobs.reach_report import ReachReport
    from robot_ik.jobs.reach_request import ReachRequest, Rehearsal


@dataclass(frozen=True)
class RehearseOptions:
    """What shall go wrong, to see that it is noticed (simulated servos, synthetic camera)."""

    zero_offset: Annotated[tuple[str, ...], arg(metavar="JOINT=DEG …", help_behavior_hint="")] = ()
    """Servos whose shaft is some degrees ahead of what their registers say, e.g. joint2=2."""
    stuck: Annotated[tuple[str, ...], arg(metavar="JOINT …", help_behavior_hint="")] = ()
    """Servos whose shaft does not move."""
    cover_gripper: bool = False
    """Hide the gripper's markers when the camera looks again."""
    blank_marker: bool = False
    """Leave the target's paper white."""
    marker_at: Annotated[tuple[float, ...], arg(metavar="X Y Z [YAW_DEG]", help_behavior_hint="")] = ()
    """Put the printed marker elsewhere: metres in the world, and degrees about the vertical."""


_DEFAULT_ROBOT = f"(default: the arm file's, else {SHOWN_ROBOT}; at a port {SERVO_ROBOT})"


@dataclass(frozen=True)
class ReachOptions:
    """Sees a marker, moves the arm's gripper above it, and lets a camera judge how far off it is.

    With no options everything is simulated, on real parts: a synthetic camera with exact optics, the PUMA
    560, and six virtual servos behind a real serial line (a pty), driven as real ones are.

    Exit code 0: servos and camera agree that the goal is reached. 1: it is not reached, or not proven.
    2: wrong input or environment; nothing was sent to a servo.
    """

    robot: Annotated[str, arg(metavar="NAME|PATH", help_behavior_hint=_DEFAULT_ROBOT)] = ""
    """A name of `robot-ik robots`, or any MJCF or URDF file."""
    solver: Annotated[str, arg(help_behavior_hint="(default: the robot's own)")] = ""
    """Method: see `robot-ik solvers`."""
    goal: Annotated[
        tuple[float, ...], arg(metavar="X Y Z [W X Y Z]", help_behavior_hint="(default: by camera)")
    ] = ()
    """Go there instead of to a marker: metres in the world, and an orientation as a quaternion."""
    frame: Annotated[str, arg(help_behavior_hint="(default: the robot's tool)")] = ""
    """What shall get there: a tool, site or body of the robot."""
    camera: Annotated[str, arg(metavar="synthetic|INDEX|FILE|FOLDER|URL")] = "synthetic"
    """Where the pictures come from."""
    intrinsics: Annotated[str, arg(metavar="FILE", help_behavior_hint="(needed for a real camera)")] = ""
    """Calibration of a real camera: OpenCV or ROS YAML."""
    camera_pose: Annotated[
        tuple[float, ...],
        arg(metavar="X Y Z W X Y Z", help_behavior_hint="(default: where the synthetic one stands)"),
    ] = ()
    """Where a real camera stands: OpenCV axes (z forward, y down) in the world."""
    camera_place: Annotated[str, arg(metavar="FILE.toml", help_behavior_hint="(default: --camera-pose)")] = ""
    """The same from a file of `robot-ik camera locate` or `camera handeye`."""
    marker: Annotated[int | None, arg(metavar="ID", help_behavior_hint="(default: the scene's)")] = None
    """Which marker to reach; no other ever becomes a goal."""
    marker_size: Annotated[float | None, arg(metavar="M", help_behavior_hint="(default: the scene's)")] = None
    """Side of its black square, metres; needed for a real camera."""
    dictionary: Annotated[str, arg(metavar="NAME", help_behavior_hint="(default: the scene's)")] = ""
    """OpenCV's name of its dictionary, e.g. DICT_5X5_50."""
    bus: Annotated[str, bus_argument(none=True)] = "pty"
    arm: Annotated[str, arg(metavar="FILE.toml", help_behavior_hint="(default: beside the model)")] = ""
    """Servo ids, signs, zeros and limits."""
    speed: float = 1.0
    """Share of the joints' speed limits, above 0 and up to 1."""
    line: bool = False
    """Move the tool on a straight line."""
    follow: bool = False
    """Then go on following the marker (the synthetic one is pushed about)."""
    seconds: float = 10.0
    """How long to follow."""
    when_lost: Literal["hold", "park", "stop"] = "hold"
    """While following, when the marker stays out of sight: hold there, park at home, or stop."""
    lost_after: Annotated[float, arg(metavar="S")] = 2.0
    """Out of sight for so many seconds; until then the arm holds."""
    lead: Annotated[float, arg(metavar="S")] = 0.0
    """Predict the marker's motion so far beyond each tick: the lag of the servos."""
    view: bool = False
    """Mirror the motion in MuJoCo's window; it stays until you close it."""
    film: bool = False
    """Also write reach.mp4: the motion as the stage's camera sees it (extra `video`)."""
    out: Annotated[str, arg(metavar="DIR", help_behavior_hint="(default: runs/<time>-reach)")] = ""
    """Where reach.png, trajectory.csv and summary.json go."""
    overwrite: bool = False
    """That folder may hold files of an earlier run: they are replaced."""
    seed: int = 0
    """Of random restarts and of the synthetic camera's noise."""
    json: bool = False
    """Print the summary as JSON on stdout instead of the table."""
    rehearse: RehearseOptions = field(default_factory=RehearseOptions)


def run(options: ReachOptions) -> int:
    """Runs the job; 0 reached, 1 not."""
    import_mujoco()
    request = make_request(options)
    from robot_ik.cli.results import results_folder
    from robot_ik.jobs.reach import run_reach
    from robot_ik.jobs.reach_files import FILES

    if options.film:
        from robot_ik.jobs.reach_window import require_films

        require_films()
    # Before anything moves: a run whose results cannot be kept is not started.
    with (
        results_folder(options.out, "reach", FILES, overwrite=options.overwrite) as folder,
        console.progress() as bar,
    ):
        task = bar.add_task("opening", total=1.0, note="")

        def progress(stage: str, share: float) -> None:
            bar.update(task, description=stage, completed=share)

        def done(report: ReachReport) -> None:
            bar.stop()
            _save_and_tell(report, folder, options)

        report = run_reach(request, progress, done)
    return console.DONE if report.reached else console.NOT_ACHIEVED


def _save_and_tell(report: ReachReport, folder: Path, options: ReachOptions) -> None:
    from robot_ik.jobs.reach_files import reach_summary, save_reach

    files = save_reach(report, folder)
    if options.film:
        from robot_ik.jobs.reach_window import save_film

        with console.busy("drawing the film"):
            film = save_film(report, folder / "reach.mp4")
        files += [] if film is None else [film]
    if options.json:
        console.print_json({**reach_summary(report), "folder": str(folder)})
    else:
        from robot_ik.cli.reach_table import print_report

        print_report(report)
        names = "  ".join(file.name for file in files)
        console.out().print(Text(f"files in {folder}: {names}"), soft_wrap=True)
    if report.problem is not None:
        console.show_error(report.problem)
    if options.view:
        console.say("close the window to end", "dim")


def make_request(options: ReachOptions) -> ReachRequest:
    """The job's request; everything that can be wrong without looking is found here.

    Raises:
        InvalidGoalError, ConfigError: A malformed option.
    """
    from robot_ik.jobs.reach_request import ReachRequest

    if not 0.0 < options.speed <= 1.0:
        raise wrong("--speed", f"{options.speed:g} is no share of the speed limits", "above 0, at most 1")
    if not 0.0 < options.seconds < math.inf:
        raise wrong("--seconds", f"{options.seconds:g} s", "above 0")
    if options.film and options.follow:
        raise wrong("--film", "it shows the way to a goal that stands still", "without --follow")
    if not 0.0 <= options.lost_after < math.inf:
        raise wrong("--lost-after", f"{options.lost_after:g} s", "0 or more")
    if not 0.0 <= options.lead <= 0.2:
        raise wrong("--lead", f"{options.lead:g} s cannot be predicted", "0 to 0.2")
    return ReachRequest(
        robot=options.robot or robot_meant(options.arm, options.bus),
        solver=options.solver,
        goal=make_goal(options.goal, options.frame) if options.goal else None,
        frame=options.frame or None,
        camera=options.camera,
        intrinsics=Path(options.intrinsics) if options.intrinsics else None,
        pose_world_camera=_camera_pose(options),
        marker_id=options.marker,
        marker_size=options.marker_size,
        dictionary=options.dictionary or None,
        bus=options.bus,
        arm_file=Path(options.arm) if options.arm else None,
        speed=options.speed,
        line=options.line,
        follow=options.seconds if options.follow else 0.0,
        when_lost=options.when_lost,
        lost_after=options.lost_after,
        lead=options.lead,
        view=options.view,
        seed=options.seed,
        rehearsal=_rehearsal(options.rehearse),
    )


def _camera_pose(options: ReachOptions) -> Pose | None:
    from robot_ik.geometry import Pose

    numbers = options.camera_pose
    if options.camera_place:
        if numbers or not options.intrinsics:
            what = "a place file and a pose" if numbers else "a place file without its calibration"
            raise wrong("--camera-place", what, "with --intrinsics FILE and without --camera-pose")
        from robot_ik.camera.handeye.places import CameraPlace
        from robot_ik.camera.intrinsics import CameraIntrinsics

        place = CameraPlace.load(options.camera_place, CameraIntrinsics.load(options.intrinsics))
        place.require_parent("world")
        return place.pose_parent_camera
    if not numbers:
        return None
    if len(numbers) != 7:
        raise wrong("--camera-pose", f"{len(numbers)} numbers", "7: x y z in metres, then w x y z")
    try:
        return Pose(numbers[:3], numbers[3:])
    except ValueError as error:
        raise InvalidGoalError(f"--camera-pose: {error}") from error


def _rehearsal(options: RehearseOptions) -> Rehearsal:
    from robot_ik.jobs.reach_request import Rehearsal

    offsets = {}
    for item in options.zero_offset:
        joint, _, degrees = item.partition("=")
        try:
            offsets[joint] = float(degrees)
        except ValueError:
            offsets[joint] = math.nan
        if not math.isfinite(offsets[joint]):
            raise wrong("--rehearse.zero-offset", f"{item!r}", "JOINT=DEGREES, e.g. joint2=2")
    place = options.marker_at
    if place and len(place) not in (3, 4):
        allowed = "3 or 4: x y z in metres, yaw in degrees"
        raise wrong("--rehearse.marker-at", f"{len(place)} numbers", allowed)
    marker_at = (place[0], place[1], place[2], place[3] if len(place) == 4 else 0.0) if place else None
    return Rehearsal(
        zero_offset_deg=offsets,
        stuck=options.stuck,
        cover_gripper=options.cover_gripper,
        blank_marker=options.blank_marker,
        marker_at=marker_at,
    )

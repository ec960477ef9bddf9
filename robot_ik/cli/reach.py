"""``robot-ik reach``: the main job on the terminal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.text import Text
from tyro.conf import arg

from robot_ik.cli import console
from robot_ik.cli.arguments import (
    XYZ_WXYZ,
    ArmFile,
    Json,
    Lens,
    Overwrite,
    Range,
    RecordFile,
    Speed,
    joint_degrees,
    make_goal,
    pose_option,
    positive,
    request_of,
    require,
    robot_argument,
    several,
    single,
    wrong,
)
from robot_ik.cli.connection import bus_argument, resolved_robot
from robot_ik.errors import distinct_texts
from robot_ik.jobs.results import claimed
from robot_ik.robot_file import SERVO_ROBOT, SHOWN_ROBOT

if TYPE_CHECKING:
    from robot_ik.geometry import Pose
    from robot_ik.jobs.reach import ReachReport, ReachRequest
    from robot_ik.jobs.robot_setup import JointLimits


@dataclass(frozen=True)
class RehearseOptions:
    """What shall go wrong, to see that it is noticed (simulated servos, synthetic camera)."""

    zero_offset: Annotated[tuple[str, ...], several("JOINT=DEG")] = ()
    """Servos whose shaft is some degrees ahead of what their registers say, e.g. joint2=2."""
    stuck: Annotated[tuple[str, ...], several("JOINT")] = ()
    """Servos whose shaft does not move."""
    cover_gripper: bool = False
    """Hide the gripper's markers when the camera looks again."""
    blank_marker: bool = False
    """Leave the target's paper white."""
    marker_at: Annotated[tuple[float, ...], single("X Y Z [YAW_DEG]")] = ()
    """Put the printed marker elsewhere: metres in the world, and degrees about the vertical."""


_DEFAULT_ROBOT = f"the arm file's, else {SHOWN_ROBOT}; at a port {SERVO_ROBOT}"


@dataclass(frozen=True)
class ReachOptions:
    """Sees a marker, moves the arm's gripper above it, and lets a camera judge how far off it is.

    With no options everything is simulated, on real parts: a synthetic camera with exact optics, the PUMA
    560, and six virtual servos behind a real serial line (a pty), driven as real ones are.

    Exit code 0: servos and camera agree that the goal is reached. 1: it is not reached, or not proven.
    2: wrong input or environment; nothing was sent to a servo.
    """

    robot: Annotated[str, robot_argument(_DEFAULT_ROBOT)] = ""
    solver: Annotated[str, single(None, "the robot's own")] = ""
    """Method: see `robot-ik solvers`."""
    goal: Annotated[tuple[float, ...], single(XYZ_WXYZ, "by camera")] = ()
    """Go there instead of to a marker: metres in the world, and an orientation as a quaternion."""
    frame: Annotated[str | None, single("STR", "the robot's tool")] = None
    """What shall get there: a tool, site or body of the robot."""
    camera: Annotated[str, arg(metavar="synthetic|INDEX|FILE|FOLDER|URL")] = "synthetic"
    """Where the pictures come from."""
    intrinsics: Lens = None
    camera_pose: Annotated[tuple[float, ...], single("X Y Z W X Y Z", "where the synthetic one stands")] = ()
    """Where a real camera stands: OpenCV axes (z forward, y down) in the world."""
    camera_extrinsics: Annotated[Path | None, single("FILE.toml", "--camera-pose")] = None
    """The same from a file of `robot-ik camera locate` or `camera handeye`."""
    marker: Annotated[int | None, single("ID", "the scene's")] = None
    """Which marker to reach; no other ever becomes a goal."""
    marker_size: Annotated[float | None, single("M", "the scene's")] = None
    """Side of its black square, metres; needed for a real camera."""
    dictionary: Annotated[str | None, single("NAME", "the scene's")] = None
    """OpenCV's name of its dictionary, e.g. DICT_5X5_50."""
    bus: Annotated[str, bus_argument(none=True)] = "pty"
    arm: ArmFile = None
    speed: Speed = 1.0
    line: bool = False
    """Move the tool on a straight line."""
    scene: Annotated[Path | None, single("FILE.xml", "none")] = None
    """Refuse a motion that would touch these obstacles: an MJCF file without joints."""
    avoid: bool = False
    """Plan a motion around the robot itself and the obstacles of --scene, or of the arm file."""
    follow: bool = False
    """Then go on following the marker (the synthetic one is pushed about)."""
    seconds: Annotated[float, arg(metavar="S"), positive(what=" s")] = 10.0
    """How long to follow, seconds."""
    when_lost: Literal["hold", "park", "stop"] = "hold"
    """While following, when the marker stays unseen: hold there, park at home, or stop."""
    lost_after: Annotated[float, arg(metavar="S"), Range(0.0, what=" s")] = 2.0
    """Unseen for so many seconds; until then the arm holds."""
    lead: Annotated[float, arg(metavar="S"), Range(0.0, 0.2, " s cannot be predicted")] = 0.0
    """Predict the marker so many seconds beyond each tick, to make up for the lag of the servos."""
    view: bool = False
    """Mirror the motion in MuJoCo's window; it stays until you close it."""
    film: bool = False
    """Also write reach.mp4: the motion as the scene's camera sees it (extra `video`)."""
    out: Annotated[str, single("DIR", "runs/<time>-reach")] = ""
    """Where reach.png, trajectory.csv and summary.json go."""
    overwrite: Overwrite = False
    record: RecordFile = None
    seed: int = 0
    """Of random restarts and of the synthetic camera's noise."""
    json: Json = False
    rehearse: RehearseOptions = field(default_factory=RehearseOptions)


def run(options: ReachOptions) -> int:
    """Runs the job; 0 reached, 1 not."""
    request = make_request(options)
    from robot_ik.jobs.films import require_films
    from robot_ik.jobs.reach import run_reach
    from robot_ik.jobs.reach_files import FILES
    from robot_ik.jobs.results import results_folder

    if options.film:
        require_films("a film of the reach")
    # Before anything moves: a run whose results cannot be kept is not started.
    with (
        results_folder(options.out, "reach", FILES, overwrite=options.overwrite) as folder,
        claimed(options.record, overwrite=options.overwrite),
        console.progress() as bar,
    ):

        def done(report: ReachReport) -> None:
            bar.stop()
            _save_and_print(report, folder, options)

        report = run_reach(request, console.shares_on(bar, "reach"), done)
    return console.DONE if report.reached else console.NOT_ACHIEVED


def _save_and_print(report: ReachReport, folder: Path, options: ReachOptions) -> None:
    from robot_ik.jobs.reach_files import reach_summary, save_film, save_reach

    files = save_reach(report, folder)
    if options.film:
        with console.busy("drawing the film"):
            film = save_film(report, folder / "reach.mp4")
        files += [] if film is None else [film]
    if options.json:
        console.print_json({**reach_summary(report), "folder": str(folder)})
    else:
        print_report(report)
        names = "  ".join(file.name for file in files)
        console.result(f"files in {folder}: {names}")
    if report.problem is not None:
        console.show_error(report.problem)
    if options.view:
        console.say("close the window to end", "dim")


def make_request(options: ReachOptions) -> ReachRequest:
    """The job's request.

    Raises:
        InvalidGoalError, ConfigError: All that can be wrong without looking.
    """
    from robot_ik.jobs.reach import ReachRequest
    from robot_ik.jobs.robot_setup import Rehearsal

    still = "it shows the way to a goal that stands still"
    require(not (options.film and options.follow), "--film", still, "without --follow")
    streams = "following does not use the obstacles"
    require(not ((options.scene or options.avoid) and options.follow), "--follow", streams, "without --scene")
    require(
        not (options.avoid and options.line), "--line", "a planned motion is not straight", "without --avoid"
    )
    for name in ("intrinsics", "camera_pose", "camera_extrinsics") if options.camera == "synthetic" else ():
        knows = "the synthetic camera has the lens and the place of the robot's scene"
        require(not getattr(options, name), f"--{name.replace('_', '-')}", knows, "with a real --camera")
    rehearse, at = options.rehearse, options.rehearse.marker_at
    allowed = "3 or 4 finite numbers: x y z in metres, yaw in degrees"
    right = len(at) in (0, 3, 4) and all(map(math.isfinite, at))
    require(right, "--rehearse.marker-at", " ".join(map(str, at)), allowed)
    rehearsal = request_of(
        Rehearsal,
        rehearse,
        zero_offset_deg=joint_degrees("--rehearse.zero-offset", rehearse.zero_offset),
        marker_at=at or None,
    )
    return request_of(
        ReachRequest,
        options,
        robot=options.robot or resolved_robot(options.arm, options.bus),
        goal=make_goal(options.goal, options.frame) if options.goal else None,
        pose_world_camera=_camera_pose(options),
        marker_id=options.marker,
        arm_file=options.arm,
        follow=options.seconds if options.follow else 0.0,
        rehearsal=rehearsal,
    )


def _camera_pose(options: ReachOptions) -> Pose | None:
    numbers, file = options.camera_pose, options.camera_extrinsics
    if file is None:
        seven = "7: x y z in metres, then w x y z"
        require(len(numbers) in (0, 7), "--camera-pose", f"{len(numbers)} numbers", seven)
        return pose_option(numbers, "--camera-pose")
    what = "an extrinsics file " + ("and a pose" if numbers else "without its calibration")
    allowed = "with --intrinsics FILE and without --camera-pose"
    if options.intrinsics is None or numbers:
        raise wrong("--camera-extrinsics", what, allowed)
    from robot_ik.camera.calibration.extrinsics import CameraExtrinsics
    from robot_ik.camera.intrinsics import CameraIntrinsics

    extrinsics = CameraExtrinsics.load(file, CameraIntrinsics.load(options.intrinsics))
    extrinsics.require_parent("world")
    return extrinsics.pose_parent_camera


# ------------------------------------------------------------------------------------------
# The compact table of a reach on the terminal.


def print_report(report: ReachReport) -> None:
    """The compact table of a reach."""
    limits = [
        (one.joint, " … ".join(_limit(v, one.unit) for v in one.used), _narrowed(one))
        for one in report.setup.limits
    ]
    outcome = ("REACHED", "bold green") if report.reached else ("NOT REACHED", "bold red")
    result = Text.assemble(outcome, f"  {report.verdict}" if report.verdict else "")
    parts = (_goal_rows, _solve_rows, _motion_rows, _judgement_rows)
    rows = [*(row for part in parts for row in part(report)), ("result", result)]
    console.show(
        console.table("joint", "limits used", "narrowed by", rows=limits),
        "",
        console.table("reach", report.robot.file.title or report.robot.name, rows=rows),
    )


def _goal_rows(report: ReachReport) -> list[tuple[str, str]]:
    rows = []
    seen = report.seen
    if seen is not None:
        rows.append(
            (f"marker {seen.observation.ids[0]}", f"seen at {_mm(seen.pose_world_marker.position)} mm")
        )
        if seen.true_pose is not None:
            metres, radians = seen.pose_world_marker.distance(seen.true_pose)
            off = f"seen {1e3 * metres:.2f} mm, {math.degrees(radians):.2f}° off"
            rows.append(("", f"true at {_mm(seen.true_pose.position)} mm; {off}"))
        elif report.vision is not None:
            pose = seen.observation.pose
            quaternion = " ".join(f"{v:z.4f}" for v in pose.wxyz)
            rows.append(("", f"in the camera's frame {_mm(pose.position)} mm, wxyz {quaternion}"))
    if report.target is not None:
        free = getattr(report.goal, "free_axis", None)
        axis = f", {free} axis as seen, free to turn about it" if free else ""
        rows.append(("goal", f"{report.frame} at {_mm(report.target.position)} mm{axis}"))
    return rows


def _solve_rows(report: ReachReport) -> list[tuple[str, str]]:
    solution = report.solution
    if solution is None:
        return []
    steps = console.count_of(solution.iterations, "iteration")
    restarts = f", {console.count_of(solution.restarts, 'restart')}" if solution.restarts else ""
    took = f", {report.microseconds:.0f} µs" if report.microseconds is not None else ""
    error = solution.error
    return [
        ("solver", f"{solution.solver}: {solution.status.name.lower()}, {steps}{restarts}{took}"),
        ("its error", f"{1e3 * error.position:.4f} mm, {math.degrees(error.angle):.4f}°  (by MuJoCo)"),
    ]


def _motion_rows(report: ReachReport) -> list[tuple[str, str]]:
    rows = []
    run, following = report.execution, report.following
    if run is not None:
        text = f"{run.duration:.2f} s at {run.rate:.1f} Hz"
        if run.tracking_error is not None:
            worst = int(run.tracking_error.argmax())
            error = math.degrees(float(run.tracking_error[worst]))
            text += f"; largest tracking error {error:.2f}° ({run.joints[worst]})"
        if report.trajectory is not None and report.trajectory.certified:
            text += "; proven free of collisions"
        rows.append(("motion", text))
    if following is not None:
        text = f"{following.duration:.1f} s at {following.rate:.1f} Hz"
        rows.append(("following", f"{text}; {following.held} of {following.ticks} ticks without a goal"))
    if report.behind is not None:
        median, largest = (1e3 * metres for metres in report.behind)
        rows.append(("", f"tool from the goal seen: median {median:.1f} mm, largest {largest:.1f} mm"))
    delays = None if report.vision is None else report.vision.delays
    if delays is not None and delays[1].count:
        made, used = delays
        ready = f"goal after {made}; " if made.count else ""
        rows.append(("delay", f"{ready}age of the picture at a tick {used}"))
    if report.counters:
        names = ("cycles", "timeouts", "corrupt", "retries", "alerts")
        counts = ", ".join(f"{report.counters[name]} {name}" for name in names)
        port = report.request.bus.rsplit("/", 1)[-1]  # the column of names stays narrow
        rows.append((f"bus {port}", counts))
    return rows


def _judgement_rows(report: ReachReport) -> list[tuple[str, str]]:
    rows, servos = [], report.setup.arm is not None
    if (judged := report.read_back) is not None:
        why = "servo ticks" if servos else "tolerance of the solver"
        if judged.sigma.position > 0.0:
            why = f"3 σ of the goal + {why}"
        rows.append(("read back", f"{_judged(judged)} ({why})"))
    if (judged := report.by_camera) is not None:
        ticks = "ticks" if servos else "tolerance"
        sigma = f"σ {1e3 * judged.sigma.position:.2f} mm {math.degrees(judged.sigma.angle):.2f}°"
        rows.append(("camera", f"{_judged(judged)} (3 σ + {ticks}, {sigma})"))
    return rows


def _narrowed(limit: JointLimits) -> str:
    """Which side gave way to what, and what the model alone would allow."""
    sides = []
    file = limit.arm_file or (math.nan, math.nan)
    for name, model, said, used in zip(("lower", "upper"), limit.model, file, limit.used, strict=True):
        if abs(model - used) > 1e-9:
            by = "the arm file" if abs(said - used) < 1e-9 else "the servo's mode"
            sides.append(f"{name} end by {by} (model: {_limit(model, limit.unit)})")
    return ", ".join(sides) or ("-" if limit.servo is not None else "")


def _limit(value: float, unit: str) -> str:
    if math.isinf(value):
        return "free"
    return f"{value:.3f} m" if unit == "m" else f"{math.degrees(value):.1f}°"


def _mm(position: Any) -> str:
    return " ".join(f"{1e3 * float(v):z.1f}" for v in position)


def _judged(judged: Any) -> str:
    mm, most_mm = distinct_texts(1e3 * judged.position, 1e3 * judged.allowed.position, digits=2)
    deg, most_deg = distinct_texts(math.degrees(judged.angle), math.degrees(judged.allowed.angle), digits=2)
    return f"{mm} mm, {deg}°; allowed {most_mm} mm, {most_deg}°"

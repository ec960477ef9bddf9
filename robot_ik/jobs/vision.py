"""The camera's side of a job: what it looks at, where it stands, and what it may be asked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_ik.camera.delays import Delays
from robot_ik.camera.detection import MarkerDetector
from robot_ik.camera.goals import worst_sigmas
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.latest_goals import SYNTHETIC_RATE_HZ, LatestGoals
from robot_ik.camera.lost_policy import WhenLost
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.motion_filter import FilterOptions
from robot_ik.camera.sources import Frame, FrameSource, ImageSource, open_source
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import MarkerTarget, Observation, marker
from robot_ik.errors import (
    CalibrationError,
    CameraError,
    ConfigError,
    FrameTimeoutError,
    MarkerNotFoundError,
)
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal, PostureGoal
from robot_ik.jobs.scene import Scene, scene_for
from robot_ik.jobs.verdict import Bound
from robot_ik.ports import Array, Clock

if TYPE_CHECKING:
    from robot_ik.jobs.reach import ReachRequest
    from robot_ik.jobs.robot_setup import RobotSetup


# ------------------------------------------------------------------------------------------
# A printed marker that somebody pushes about.


# The synthetic marker that is followed lies still for a while in the end.
REST_SECONDS = 1.5


def wandering(home: Pose, begin: float, seconds: float, size: float, now: float) -> Pose:
    """Pose at ``now`` of a marker that is pushed about on its table: rests, wanders, rests somewhere else."""
    share = np.clip((now - begin) / max(seconds - REST_SECONDS, 0.1), 0.0, 1.0)
    smooth = share * share * (3.0 - 2.0 * share)
    x = size * np.sin(2.0 * np.pi * smooth)
    y = size * (0.5 * np.sin(4.0 * np.pi * smooth) + 0.8 * smooth)
    return home.compose(Pose((x, y, 0.0), rotation_exp([0.0, 0.0, 0.4 * smooth])))


# How often a camera or a film is asked again before a marker counts as not there.
_LIVE_TRIES = 20
_SYNTHETIC_TRIES = 2
# With fewer degrees of freedom a full pose is out of reach in general.  With five the position and the tool's
# z axis are asked for, its rotation about that axis is free; with fewer only the position.
POSE_DOF, AXIS_DOF = 6, 5
# While it is followed the synthetic marker wanders this far, in hovers, and then lies still for a while.
_WANDER = 0.4


@dataclass(frozen=True)
class SeenTarget:
    """The target marker in one picture: the tool's goal in front of it, and where it was seen.

    ``true_pose`` is where it really is, world; None where it is unknown (every real camera).
    """

    goal: PoseGoal | PositionGoal
    observation: Observation
    pose_world_marker: Pose
    true_pose: Pose | None

    def uncertainty(self, point: Array) -> Bound:
        """Standard deviation of a point ``point`` (3,), seen from the marker, in the worst direction."""
        pose = self.observation.pose
        return Bound(*worst_sigmas(self.observation.covariance, pose.rotation @ point))


@dataclass(eq=False)
class Vision:
    """A camera and what it is for in a reach.

    Attributes:
        scene: What stands round the arm, the camera where it really stands and with its own lens.
        why_blind: Why its pictures do not show the arm, so that it cannot judge; empty: they do.
        synthetic: ``source``, where it is synthetic; its marker wanders while it is followed.
        when_lost, lead: For following.
        last_image: The last picture that was taken; None before the first.
        cover_gripper: From the first picture of the gripper on its markers are hidden (a rehearsal).
        delays: After following: from grab to goal, and the age of the picture at each tick.
    """

    scene: Scene
    source: FrameSource
    setup: RobotSetup
    _: KW_ONLY
    why_blind: str = ""
    synthetic: SyntheticSource | None = None
    when_lost: WhenLost = WhenLost()  # noqa: RUF009 - frozen
    lead: float = 0.0
    cover_gripper: bool = False
    delays: tuple[Delays, Delays] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        # Films are followed at their own speed, cameras at theirs, scenes in numbers at a usual one.
        self._rate = SYNTHETIC_RATE_HZ if self.synthetic else getattr(self.source, "rate_hz", None)
        self.last_image: Any = None
        self._cube = MarkerTarget(self.scene.cube, self.scene.dictionary, "cube on the gripper")
        self._goals = _ArmGoals(self)
        self._followed: SeenTarget | None = None

    def picture(self) -> Frame:
        """Takes a picture, without its truth, and looks for nothing."""
        frame = self.source.read().without_truth()
        self.last_image = frame.image
        return frame

    def find_target(self) -> SeenTarget:
        """The target marker in the next pictures.

        Raises:
            MarkerNotFoundError: Not there, or not told apart from its mirror image; says what is there.
        """
        tries = _SYNTHETIC_TRIES if self.synthetic is not None else _LIVE_TRIES
        # A recording is searched to its end: there is no hurry, and nothing else to see.
        while tries > 0 or not self.source.live:
            try:
                goal = self._goals.poll(self.setup.clock.now())
            except FrameTimeoutError:
                break
            if isinstance(goal, PoseGoal | PositionGoal) and self._goals.seen is not None:
                return self._goals.seen
            if self.source.exhausted:
                break
            tries -= 1
        raise self._not_found()

    def find_target_again(self) -> SeenTarget:
        """The target where it is now: after following, the last one of a recording, else in a new picture.

        Raises:
            MarkerNotFoundError: As ``find_target``.
        """
        if not self.source.live and self._followed is not None:
            return self._followed
        return self.find_target()

    def true_target(self, time: float) -> Pose | None:
        """Where the synthetic target marker is, world; None before a real camera."""
        if self.synthetic is None:
            return None
        pose = next(m.pose for m in self.synthetic.scene.markers if m.id == self.scene.marker_id)
        return pose(time) if callable(pose) else pose

    def find_gripper(self) -> Observation | None:
        """The gripper's markers in a new picture; None when none is in view."""
        if self.cover_gripper and self.synthetic is not None:
            self.synthetic.scene = self.synthetic.scene.with_marker(*self.scene.cube, condition="covered")
        return self._cube.find(self.picture(), self.scene.intrinsics)

    def pose_body_tool(self, q: Array) -> Pose:
        """The tool seen from the marker body, at ``q`` (nq,): constant, as both sit on the hand."""
        robot = self.setup.robot
        body = robot.forward(q, self.scene.cube_frame).compose(self.scene.cube_offset)
        return body.inverse().compose(robot.forward(q, self.setup.frame))

    @contextlib.contextmanager
    def following(self, clock: Clock, seconds: float) -> Iterator[LatestGoals]:
        """A goal source that goes on looking; the synthetic marker wanders meanwhile."""
        synthetic, id, goals = self.synthetic, self.scene.marker_id, _ArmGoals(self, follow=True)
        home = self.true_target(clock.now())
        if synthetic is not None and home is not None:
            begin, size = clock.now() + REST_SECONDS, _WANDER * self.scene.hover
            path = partial(wandering, home, begin, seconds - REST_SECONDS, size)
            synthetic.scene = synthetic.scene.with_marker(id, pose=path)
        with LatestGoals(goals, clock, self._rate) as latest:
            yield latest
        self.delays = goals.goal_delays.summary(), goals.picture_ages.summary()
        if synthetic is None:
            self._followed = goals.seen
        else:
            synthetic.scene = synthetic.scene.with_marker(id, pose=self.true_target(clock.now()))

    def for_arm(self, goal: Any) -> Any:
        """``goal`` as this arm can have it: with five joints position and axis, with fewer the position."""
        if not isinstance(goal, PoseGoal) or self.setup.dof >= POSE_DOF:
            return goal
        if self.setup.dof >= AXIS_DOF:
            return replace(goal, free_axis="z")
        return PositionGoal(self.setup.frame, goal.position, weight=goal.position_weight)

    def _not_found(self) -> MarkerNotFoundError:
        wanted = f"marker {self.scene.marker_id} of {self.scene.dictionary}"
        image = self.last_image
        if self._goals.last is not None:
            return MarkerNotFoundError(
                f"{wanted} is in view, but its two possible orientations cannot be told apart",
                hint="show it larger, sharper or more from the side",
            )
        found = [] if image is None else MarkerDetector(self.scene.dictionary).detect(image)
        others = ", ".join(str(id) for id in sorted({detection.id for detection in found}))
        there = f"in view: {others}" if others else "no marker of that dictionary is in view"
        return MarkerNotFoundError(
            f"{wanted} was not found; {there}",
            hint="check id (--marker), dictionary (--dictionary), light, focus and the white margin round it",
        )


class _ArmGoals(MarkerGoalSource):
    """Goals as the arm of a ``vision`` can have them; ``seen`` is the last sighting that gave one.

    Each picture for itself, unless to ``follow``.
    """

    def __init__(self, vision: Vision, *, follow: bool = False) -> None:
        scene = vision.scene
        super().__init__(
            vision.source,
            scene.intrinsics,
            marker(scene.marker_id, scene.marker_size, scene.dictionary),
            scene.pose_world_camera,
            scene.pose_marker_tool,
            vision.setup.frame,
            motion=FilterOptions() if follow else None,
            predict=None if follow else False,
            lead=vision.lead if follow else 0.0,
            when_lost=vision.when_lost if follow else WhenLost(),
            clock=vision.setup.clock,
        )
        self._vision = vision
        self.seen: SeenTarget | None = None

    def observe(self, now: float, *, wait: bool = False) -> None:
        super().observe(now, wait=True)  # every look is at a new picture, for which a camera is waited for
        vision, goal, last, frame = self._vision, self.measured, self.last, self.last_frame
        if frame is None:
            return
        vision.last_image = frame.image
        if goal is not None and last is not None:
            pose = vision.scene.pose_world_camera.compose(last.pose)
            self.seen = SeenTarget(vision.for_arm(goal), last, pose, vision.true_target(frame.time))

    def goal_at(self, now: float) -> Any:
        return self._vision.for_arm(super().goal_at(now))


# ------------------------------------------------------------------------------------------
# Opens the camera that a request asks for, with its calibration.


def open_vision(request: ReachRequest, setup: RobotSetup, stack: contextlib.ExitStack) -> Vision | None:
    """Opens the camera of a request; None when a goal was given and no camera can watch.

    Raises:
        CameraError, CalibrationError: It cannot be opened, or not be used without a calibration.
    """
    synthetic: SyntheticSource | None = None
    if request.camera != "synthetic":
        if request.goal is not None:
            return None
        scene, source, why = _real_camera(request, setup, stack)
    else:
        try:
            scene = _scene(request, setup)
        except CameraError:
            if request.goal is None:
                raise
            return None  # a goal was given, and nothing can be seen: the read-back must do
        pictured = scene.synthetic(setup.robot)
        if request.rehearsal.blank_marker:
            pictured = pictured.with_marker(scene.marker_id, condition="blank")
        synthetic = SyntheticSource(pictured, setup.true_q, seed=request.seed, clock=setup.clock)
        source = stack.enter_context(synthetic)
        why = "the synthetic camera cannot see real servos" if setup.has_real_servos else ""
    park = PostureGoal(q=setup.robot.home) if request.when_lost == "park" else None
    return Vision(
        scene, source, setup, why_blind=why, synthetic=synthetic, lead=request.lead,
        when_lost=WhenLost(request.when_lost, request.lost_after, park),
        cover_gripper=request.rehearsal.cover_gripper,
    )  # fmt: skip


def _real_camera(
    request: ReachRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> tuple[Scene, FrameSource, str]:
    """The scene with the camera's place and lens, the camera, and why it cannot judge the arm."""
    rehearsal = request.rehearsal
    if rehearsal.blank_marker or rehearsal.cover_gripper or rehearsal.marker_at is not None:
        raise ConfigError(
            "what a camera sees can be rehearsed with the synthetic camera only",
            file="command line", key="--rehearse", allowed="--camera synthetic",
        )  # fmt: skip
    if request.marker_size is None:
        raise CameraError(
            "the size of the printed marker is not given, so its distance cannot be known",
            hint="give the side of its black square in metres: --marker-size 0.05",
        )
    source, intrinsics = open_calibrated(request.camera, request.intrinsics, stack)
    scene = replace(_scene(request, setup), intrinsics=intrinsics)
    if request.pose_world_camera is not None:
        scene = replace(scene, pose_world_camera=request.pose_world_camera)
    if request.follow > 0.0 and isinstance(source, ImageSource):
        raise ConfigError(
            "a photograph does not go on, so there is nothing to follow",
            file="command line", key="--follow", allowed="a camera, stream, film or folder of pictures",
        )  # fmt: skip
    why = ""
    if not source.live:
        why = "the pictures are recorded, so nothing looked at the arm afterwards"
    elif not setup.has_real_servos:
        why = "the arm is simulated, so a real camera cannot see it"
    elif scene.generated:
        why = "robot.toml says of no marker on this robot's gripper"
    return scene, source, why


def _scene(request: ReachRequest, setup: RobotSetup) -> Scene:
    """The robot's scene, with what the request says about the target marker."""
    scene = scene_for(setup.robot, setup.frame, upright=setup.dof < AXIS_DOF)
    asked = {name: getattr(request, name) for name in ("marker_id", "marker_size", "dictionary")}
    changes: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    scene = replace(scene, **changes)
    place = request.rehearsal.marker_at
    return scene if place is None else scene.with_marker_at(*place)


def open_calibrated(
    camera: str,
    intrinsics: Path | None,
    stack: contextlib.ExitStack,
    *,
    size: tuple[int, int] | None = None,
    scaled: bool = False,
) -> tuple[FrameSource, CameraIntrinsics]:
    """A camera that can measure, asked for pictures of ``size``; ``stack`` closes it.

    ``scaled``: a calibration for the same picture at another size will do.

    Raises:
        CalibrationError: There is no calibration, or it is for other pictures.
        CameraError: The camera cannot be opened.
    """
    if intrinsics is None:
        raise CalibrationError(
            f"the camera {camera!r} has no calibration, so nothing can be measured in its pictures",
            hint="give its calibration file (OpenCV or ROS YAML): --intrinsics FILE; "
            "make one with: robot-ik camera calibrate",
        )
    lens = CameraIntrinsics.load(intrinsics)
    source = stack.enter_context(open_source(camera, size=size))
    delivered = tuple(getattr(source, "size", lens.size))
    if scaled and delivered != lens.size:
        return source, lens.scaled(*delivered)
    lens.require_size(*delivered)
    return source, lens

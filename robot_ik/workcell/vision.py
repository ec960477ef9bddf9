"""The camera of a job: its scene, its pose, and the detection of target and gripper."""

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
from robot_ik.camera.lost_policy import LostPolicy, WhenLost
from robot_ik.camera.marker_goals import MarkerGoalSource
from robot_ik.camera.motion_filter import FilterOptions
from robot_ik.camera.sources import Frame, FrameSource, ImageSource, open_source
from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.camera.targets import MarkerTarget, Observation, marker
from robot_ik.errors import (
    CalibrationError,
    CameraError,
    FrameTimeoutError,
    MarkerNotFoundError,
    OptionError,
)
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import BEST, Goal, PoseGoal, PositionGoal, PostureGoal
from robot_ik.ports import Array, Clock
from robot_ik.workcell.scene import Scene, scene_for
from robot_ik.workcell.verdict import Bound

if TYPE_CHECKING:
    from robot_ik.workcell.robot_setup import Rehearsal, RobotSetup


# Time for which the synthetic marker rests before and after it wanders, s.
REST_SECONDS = 1.5
# Pictures of a camera or a recording in which a marker is searched for before it counts as lost.
_LIVE_TRIES = 20
# The same for a synthetic camera, whose pictures differ in noise only.
_SYNTHETIC_TRIES = 2
# Degrees of freedom that a full pose needs.
POSE_DOF = 6
# Degrees of freedom for a position and the direction of the tool's z axis, with free rotation about
# it. An arm with fewer gets position goals.
AXIS_DOF = 5
# How far the synthetic marker wanders, as a multiple of the hover distance.
_WANDER = 0.4


def wandering(home: Pose, begin: float, seconds: float, size: float, now: float) -> Pose:
    """Return the pose at ``now`` of a marker that wanders on its table from one rest to another.

    Args:
        home: Pose at the beginning.
        begin: When it begins to move, s.
        seconds: Length of the motion and the rest after it, s.
        size: How far it wanders, metres.
        now: Time of the pose, s.
    """
    share = np.clip((now - begin) / max(seconds - REST_SECONDS, 0.1), 0.0, 1.0)
    smooth = share * share * (3.0 - 2.0 * share)
    x = size * np.sin(2.0 * np.pi * smooth)
    y = size * (0.5 * np.sin(4.0 * np.pi * smooth) + 0.8 * smooth)
    return home.compose(Pose((x, y, 0.0), rotation_exp([0.0, 0.0, 0.4 * smooth])))


@dataclass(frozen=True, kw_only=True)
class CameraRequest:
    """A camera and its target marker.

    Attributes:
        rehearsal: Faults to simulate.
        camera: ``synthetic``, or a source for ``open_source``.
        goal: Goal that is given instead of a marker.
        intrinsics: Calibration file of a real camera.
        pose_world_camera: Pose of a real camera. None: the pose in the robot's scene.
        marker_id: Id of the target marker. None: the scene's.
        marker_size: Side of its black square, metres. None: the scene's.
        dictionary: Its dictionary. None: the scene's.
        follow: Time to follow the marker, s. 0: not at all.
        when_lost: Policy when the marker is lost while it is followed.
        lost_after: Time after which the marker counts as lost, s.
        lead: Prediction beyond the present while the marker is followed, s.
        seed: Random seed of the synthetic camera.
    """

    rehearsal: Rehearsal
    camera: str = "synthetic"
    goal: Goal | None = None
    intrinsics: Path | None = None
    pose_world_camera: Pose | None = None
    marker_id: int | None = None
    marker_size: float | None = None
    dictionary: str | None = None
    follow: float = 0.0
    when_lost: LostPolicy = "hold"
    lost_after: float = 2.0
    lead: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class SeenTarget:
    """The target marker in one picture.

    Attributes:
        goal: Goal of the tool in front of the marker.
        observation: What the picture shows of the marker.
        pose_world_marker: Measured pose.
        true_pose: True pose, world. None with a real camera, where it is unknown.
    """

    goal: PoseGoal | PositionGoal
    observation: Observation
    pose_world_marker: Pose
    true_pose: Pose | None

    def uncertainty(self, point: Array) -> Bound:
        """Return the largest standard deviation of a ``point`` (3,) in the frame of the marker."""
        pose = self.observation.pose
        return Bound(*worst_sigmas(self.observation.covariance, pose.rotation @ point))


@dataclass(eq=False)
class Vision:
    """The camera of a reach, which detects the target and verifies the result.

    Attributes:
        scene: Surroundings of the arm, with the pose and the intrinsics of the camera.
        source: Where the pictures come from.
        setup: The robot and its arm.
        why_blind: Why the pictures do not show the arm, so that they cannot verify it. Empty if
            they show it.
        synthetic: ``source`` if it is synthetic. Its marker wanders while it is followed.
        when_lost: Policy when the marker is lost while it is followed.
        lead: Prediction beyond the present while the marker is followed, s.
        cover_gripper: Whether the markers of the gripper are hidden from their first picture on.
        delays: After following: from grab to goal, and the age of the picture at each tick.
        last_image: The last picture. None before the first.
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
        # Recordings and cameras have a rate of their own.
        self._rate = SYNTHETIC_RATE_HZ if self.synthetic else getattr(self.source, "rate_hz", None)
        self.last_image: Any = None
        self._cube = MarkerTarget(self.scene.cube, self.scene.dictionary, "cube on the gripper")
        self._goals = _ArmGoals(self)
        self._followed: SeenTarget | None = None

    def picture(self) -> Frame:
        """Return the next picture, without its truth."""
        frame = self.source.read().without_truth()
        self.last_image = frame.image
        return frame

    def find_target(self) -> SeenTarget:
        """Return the target marker in the next pictures.

        Raises:
            MarkerNotFoundError: The marker is not in view, or its orientation is ambiguous. The
                message names the markers in view.
        """
        tries = _SYNTHETIC_TRIES if self.synthetic is not None else _LIVE_TRIES
        # A recording is searched to its end.
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
        """Return the target as in a new picture, or after a recording its last observation.

        Raises:
            MarkerNotFoundError: As ``find_target``.
        """
        if not self.source.live and self._followed is not None:
            return self._followed
        return self.find_target()

    def true_target(self, time: float) -> Pose | None:
        """Return the true pose of the synthetic target, world. None with a real camera."""
        if self.synthetic is None:
            return None
        pose = next(m.pose for m in self.synthetic.scene.markers if m.id == self.scene.marker_id)
        return pose(time) if callable(pose) else pose

    def find_gripper(self) -> Observation | None:
        """Return the gripper's markers in a new picture. None if none is in view."""
        if self.cover_gripper and self.synthetic is not None:
            self.synthetic.scene = self.synthetic.scene.with_marker(
                *self.scene.cube, condition="covered"
            )
        return self._cube.find(self.picture(), self.scene.intrinsics)

    def pose_body_tool(self, q: Array) -> Pose:
        """Return the tool in the frame of the gripper's marker body at ``q`` (nq,)."""
        robot = self.setup.robot
        body = robot.forward(q, self.scene.cube_frame).compose(self.scene.cube_offset)
        return body.inverse().compose(robot.forward(q, self.setup.frame))

    @contextlib.contextmanager
    def following(self, clock: Clock, seconds: float) -> Iterator[LatestGoals]:
        """Provide a source of goals that follow the marker. The synthetic marker wanders."""
        synthetic = self.synthetic
        id = self.scene.marker_id
        goals = _ArmGoals(self, follow=True)
        home = self.true_target(clock.now())
        if synthetic is not None and home is not None:
            begin = clock.now() + REST_SECONDS
            size = _WANDER * self.scene.hover
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
        """Return the part of ``goal`` that the arm can reach with its degrees of freedom."""
        if not isinstance(goal, PoseGoal) or self.setup.dof >= POSE_DOF:
            return goal
        if self.setup.dof >= AXIS_DOF:
            return replace(goal, free_axis="z", orientation=BEST)
        return PositionGoal(self.setup.frame, goal.position, weight=goal.position_weight)

    def _not_found(self) -> MarkerNotFoundError:
        target = f"marker {self.scene.marker_id} of {self.scene.dictionary}"
        image = self.last_image
        if self._goals.last is not None:
            return MarkerNotFoundError(
                f"{target} is in view, but its two possible orientations cannot be told apart",
                hint="show it larger, sharper or more from the side",
            )
        detections = [] if image is None else MarkerDetector(self.scene.dictionary).detect(image)
        others = ", ".join(str(id) for id in sorted({detection.id for detection in detections}))
        in_view = f"in view: {others}" if others else "no marker of that dictionary is in view"
        return MarkerNotFoundError(
            f"{target} was not found; {in_view}",
            hint="check id (--marker), dictionary (--dictionary), light, focus "
            "and the white margin around it",
        )


class _ArmGoals(MarkerGoalSource):
    """Goals that the arm of a ``Vision`` can reach.

    Each picture is used alone, without a motion filter, unless ``follow`` is set.

    Attributes:
        seen: The last observation that gave a goal.
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
        del wait  # Each goal needs a new picture, so this always waits.
        super().observe(now, wait=True)
        vision = self._vision
        goal = self.measured
        last = self.last
        frame = self.last_frame
        if frame is None:
            return
        vision.last_image = frame.image
        if goal is not None and last is not None:
            pose = vision.scene.pose_world_camera.compose(last.pose)
            self.seen = SeenTarget(vision.for_arm(goal), last, pose, vision.true_target(frame.time))

    def goal_at(self, now: float) -> Any:
        return self._vision.for_arm(super().goal_at(now))


def open_vision(
    request: CameraRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> Vision | None:
    """Open the camera of a request. Return None if a goal is given and no camera can watch.

    Raises:
        CameraError: The camera cannot be opened.
        CalibrationError: The camera needs a calibration.
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
            # The goal is known and the camera sees nothing: the servos alone verify the result.
            return None
        pictured = scene.synthetic(setup.robot)
        if request.rehearsal.blank_marker:
            pictured = pictured.with_marker(scene.marker_id, condition="blank")
        synthetic = SyntheticSource(pictured, setup.true_q, seed=request.seed, clock=setup.clock)
        source = stack.enter_context(synthetic)
        why = "the synthetic camera cannot see real servos" if setup.has_real_servos else ""
    park = PostureGoal(q=setup.robot.home) if request.when_lost == "park" else None
    return Vision(
        scene,
        source,
        setup,
        why_blind=why,
        synthetic=synthetic,
        lead=request.lead,
        when_lost=WhenLost(request.when_lost, request.lost_after, park),
        cover_gripper=request.rehearsal.cover_gripper,
    )


def _real_camera(
    request: CameraRequest, setup: RobotSetup, stack: contextlib.ExitStack
) -> tuple[Scene, FrameSource, str]:
    """Return the scene with the camera's pose and lens, the camera, and why it cannot verify."""
    rehearsal = request.rehearsal
    if rehearsal.blank_marker or rehearsal.cover_gripper or rehearsal.marker_at is not None:
        problem = "faults of pictures are simulated by the synthetic camera only"
        raise OptionError("--fault", problem, "--camera synthetic")
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
        allowed = "a camera, stream, film or folder of pictures"
        raise OptionError("--follow", "a photograph shows no motion", allowed)
    why = ""
    if not source.live:
        why = "the pictures are recorded, so nothing looked at the arm afterwards"
    elif not setup.has_real_servos:
        why = "the arm is simulated, so a real camera cannot see it"
    elif scene.generated:
        why = "robot.toml describes no marker on the gripper of this robot"
    return scene, source, why


def _scene(request: CameraRequest, setup: RobotSetup) -> Scene:
    """Return the robot's scene with the target marker of the request."""
    scene = scene_for(setup.robot, setup.frame, upright=setup.dof < AXIS_DOF)
    given = {name: getattr(request, name) for name in ("marker_id", "marker_size", "dictionary")}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
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
    """Open a camera with its calibration.

    Args:
        camera: See ``open_source``.
        intrinsics: File of the calibration.
        stack: Closes the camera.
        size: Size of the pictures that the camera is set to, px.
        scaled: Whether a calibration for another size of the same picture is scaled.

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

"""The camera's side of a job: what it looks at, where it stands, and what it may be asked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect import MarkerDetector
from robot_ik.camera.goals import MarkerGoalSource
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.latest import LatestFrame
from robot_ik.camera.pose import BodyObservation, MarkerObservation
from robot_ik.camera.sources import ClosingSource, Frame, FrameSource, open_source
from robot_ik.camera.synthetic import SyntheticSource
from robot_ik.camera.track import MarkerTracker
from robot_ik.errors import CalibrationError, CameraError, ConfigError, FrameTimeoutError, MarkerNotFoundError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.jobs.stage import Stage, stage_for
from robot_ik.ports import Clock

if TYPE_CHECKING:
    from robot_ik.jobs.limbs import Limbs
    from robot_ik.jobs.reach import ReachRequest

Array = NDArray[np.float64]

# How often a live camera is asked again before a marker counts as not there.
_LIVE_TRIES = 20
_SYNTHETIC_TRIES = 2
# With fewer degrees of freedom a full pose is out of reach in general, so only the place is asked for.
_FREEDOMS_OF_A_POSE = 6
# While it is followed the synthetic marker wanders this far, in hovers, and then lies still for a while.
_WANDER, _REST_SECONDS = 0.6, 1.5


@dataclass(frozen=True)
class Seen:
    """The target marker in one picture.

    Attributes:
        goal: The tool in front of it.
        observation: Of the marker, camera frame.
        pose_world_marker: In the world.
        true_pose: Where it really is, world; None where nobody knows (every real camera).
    """

    goal: PoseGoal | PositionGoal
    observation: MarkerObservation
    pose_world_marker: Pose
    true_pose: Pose | None


class Blindfold(ClosingSource):
    """A source whose pictures come without their truth; the truth is kept aside for the report."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self.live = source.live
        self.truth: Any = None
        self.image: Any = None

    def read(self) -> Frame:
        """The next picture, without truth."""
        frame = self._source.read()
        self.truth, self.image = frame.truth, frame.image
        return frame.without_truth()

    def close(self) -> None:
        """Closes the source."""
        self._source.close()


@dataclass(frozen=True)
class Wandering:
    """Pose of a marker that is pushed about on its table: rests, wanders, rests somewhere else."""

    home: Pose
    begin: float
    seconds: float
    size: float

    def __call__(self, now: float) -> Pose:
        """``pose_world_marker`` at ``now`` seconds."""
        share = np.clip((now - self.begin) / max(self.seconds - _REST_SECONDS, 0.1), 0.0, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        x = self.size * np.sin(2.0 * np.pi * smooth)
        y = self.size * (0.5 * np.sin(4.0 * np.pi * smooth) + 0.8 * smooth)
        return self.home.compose(Pose((x, y, 0.0), rotation_exp([0.0, 0.0, 0.4 * smooth])))


class Eyes:
    """A camera and what it is for in a reach.

    Attributes:
        pose_world_camera: Where it stands.
        live: It can look again.
        sees_arm: Its pictures show the arm, so it can judge; ``why_blind`` says why not.
        last_image: The last picture taken.
    """

    def __init__(
        self,
        stage: Stage,
        source: FrameSource,
        intrinsics: CameraIntrinsics,
        pose_world_camera: Pose,
        limbs: Limbs,
        frame: str,
        *,
        why_blind: str = "",
        synthetic: SyntheticSource | None = None,
    ) -> None:
        self.stage, self.intrinsics, self.pose_world_camera = stage, intrinsics, pose_world_camera
        self.live = source.live
        self.sees_arm, self.why_blind = not why_blind, why_blind
        self._limbs, self._frame, self._synthetic = limbs, frame, synthetic
        self._source = Blindfold(source)
        self._targets = MarkerTracker(
            intrinsics, stage.dictionary, {stage.marker_id: stage.marker_size}, [stage.marker_id]
        )
        self._cubes = MarkerTracker(intrinsics, stage.dictionary, {id: side for id, (side, _) in stage.cube.items()})
        self._goals = self._goal_source(self._source)
        self._cover_gripper = False

    @property
    def last_image(self) -> Any:
        """The last picture, BGR, or None."""
        return self._source.image

    def cover_gripper_later(self) -> None:
        """From the first look at the gripper on, its markers are hidden (a rehearsal)."""
        self._cover_gripper = True

    def picture(self) -> Any:
        """Takes a picture and looks for nothing."""
        return self._source.read().image

    def find_target(self) -> Seen:
        """The target marker in the next pictures.

        Raises:
            MarkerNotFoundError: Not there, or not told apart from its mirror image; says what is there.
        """
        tries = _SYNTHETIC_TRIES if self._synthetic is not None else _LIVE_TRIES
        k = 0
        while k < tries or not self.live:
            try:
                goal = self._goals.poll(self._limbs.clock.now())
            except FrameTimeoutError:
                break  # the film is over
            if goal is not None and self._goals.last is not None:
                return self._seen(goal, self._goals.last)
            k += 1
            if not self.live and self._goals.last_frame is not None and getattr(self._source, "exhausted", False):
                break
        raise self._not_found()

    def find_gripper(self) -> BodyObservation | None:
        """The gripper's markers in a new picture; None when none is in view."""
        if self._cover_gripper and self._synthetic is not None:
            self._synthetic.scene = self._synthetic.scene.cover(*self.stage.cube)
        return self._cubes.observe_body(self._source.read(), dict(self.stage.cube))

    def pose_body_tool(self, q: Array) -> Pose:
        """The tool seen from the marker body, at ``q`` (nq,): constant, as both sit on the hand."""
        robot = self._limbs.robot
        body = robot.forward(q, self.stage.cube_frame).compose(self.stage.cube_offset)
        return body.inverse().compose(robot.forward(q, self._frame))

    @contextlib.contextmanager
    def following(self, clock: Clock, seconds: float) -> Iterator[Any]:
        """A goal source that goes on looking; the synthetic marker wanders meanwhile."""
        if self._synthetic is None:
            yield _Patient(self._goals)
            return
        scene = self._synthetic.scene
        home = next(m.pose for m in scene.markers if m.id == self.stage.marker_id)
        assert isinstance(home, Pose)
        path = Wandering(home, clock.now() + 1.0, seconds - 1.0, _WANDER * self.stage.hover)
        moving = SyntheticSource(
            scene.with_marker(self.stage.marker_id, pose=path), self._limbs.true_q, clock=clock, quality="fast"
        )
        with LatestFrame(moving, clock) as latest:
            goals = self._goal_source(latest)
            yield _Patient(goals)
        self._synthetic.scene = scene.with_marker(self.stage.marker_id, pose=path(clock.now()))

    def _goal_source(self, source: Any) -> MarkerGoalSource:
        return MarkerGoalSource(
            source,
            self._targets,
            self.pose_world_camera,
            self.stage.marker_id,
            self.stage.pose_marker_tool,
            self._frame,
        )

    def _seen(self, goal: PoseGoal | PositionGoal, observation: MarkerObservation) -> Seen:
        if self._limbs.robot.nv < _FREEDOMS_OF_A_POSE:
            goal = PositionGoal(self._frame, goal.position)
        truth = self._source.truth or {}
        true_pose = truth.get("pose_world_marker", {}).get(self.stage.marker_id)
        return Seen(goal, observation, self.pose_world_camera.compose(observation.pose), true_pose)

    def _not_found(self) -> MarkerNotFoundError:
        wanted = f"marker {self.stage.marker_id} of {self.stage.dictionary}"
        image = self.last_image
        if self._goals.last is not None:
            return MarkerNotFoundError(
                f"{wanted} is in view, but its two possible orientations cannot be told apart",
                hint="show it larger, sharper or more from the side",
            )
        others = [] if image is None else sorted({d.id for d in MarkerDetector(self.stage.dictionary).detect(image)})
        there = f"in view: {', '.join(map(str, others))}" if others else "no marker of that dictionary is in view"
        return MarkerNotFoundError(
            f"{wanted} was not found; {there}",
            hint="check id (--marker), dictionary (--dictionary), light, focus and the white margin round it",
        )


class _Patient:
    """Holds where a film ends: a goal source on top of another."""

    def __init__(self, goals: MarkerGoalSource) -> None:
        self._goals = goals

    def poll(self, now: float) -> Any:
        try:
            return self._goals.poll(now)
        except FrameTimeoutError:
            return None


def open_eyes(request: ReachRequest, limbs: Limbs, frame: str, stack: contextlib.ExitStack) -> Eyes | None:
    """Opens the camera of a request; None when a goal was given and no camera can watch.

    Raises:
        CameraError, CalibrationError: It cannot be opened, or not be used without a calibration.
    """
    synthetic = request.camera == "synthetic"
    if not synthetic:
        return None if request.goal is not None else _real_eyes(request, limbs, frame, stack)
    try:
        stage = _adapted(stage_for(limbs.robot, frame), request)
    except CameraError:
        if request.goal is None:
            raise
        return None  # a goal was given, and nothing can be seen: the read-back must do
    scene = stage.scene(limbs.robot)
    if request.rehearsal.blank_marker:
        scene = scene.blank(stage.marker_id)
    source = stack.enter_context(SyntheticSource(scene, limbs.true_q, seed=request.seed, clock=limbs.clock))
    metal = limbs.arm is not None and limbs.arm.virtual_bus is None
    eyes = Eyes(
        stage, source, stage.intrinsics, stage.pose_world_camera, limbs, frame, synthetic=source,
        why_blind="the synthetic camera cannot see real servos" if metal else "",
    )  # fmt: skip
    if request.rehearsal.cover_gripper:
        eyes.cover_gripper_later()
    return eyes


def _real_eyes(request: ReachRequest, limbs: Limbs, frame: str, stack: contextlib.ExitStack) -> Eyes:
    rehearsal = request.rehearsal
    if rehearsal.blank_marker or rehearsal.cover_gripper or rehearsal.marker_at is not None:
        raise ConfigError(
            "what a camera sees can be rehearsed with the synthetic camera only",
            file="command line", key="--rehearse", allowed="--camera synthetic",
        )  # fmt: skip
    if request.intrinsics is None:
        raise CalibrationError(
            f"the camera {request.camera!r} has no calibration, so nothing can be measured in its pictures",
            hint="give its calibration file: --intrinsics FILE (OpenCV or ROS YAML)",
        )
    if request.marker_size is None:
        raise CameraError(
            "the size of the printed marker is not given, so its distance cannot be known",
            hint="give the side of its black square in metres: --marker-size 0.05",
        )
    intrinsics = CameraIntrinsics.load(request.intrinsics)
    source = stack.enter_context(open_source(request.camera))
    size = getattr(source, "size", None)
    if size is not None:
        intrinsics.require_size(*size)
    stage = _adapted(stage_for(limbs.robot, frame), request)
    pose = request.pose_world_camera or stage.pose_world_camera
    why = ""
    if not source.live:
        why = "the pictures are recorded, so nothing looked at the arm afterwards"
    elif limbs.arm is None or limbs.arm.virtual_bus is not None:
        why = "the arm is simulated, so a real camera cannot see it"
    elif stage.made_up:
        why = "robot.toml says of no marker on this robot's gripper"
    return Eyes(stage, source, intrinsics, pose, limbs, frame, why_blind=why)


def _adapted(stage: Stage, request: ReachRequest) -> Stage:
    """The stage with what the request says about the target marker."""
    changes: dict[str, Any] = {}
    if request.marker_id is not None:
        changes["marker_id"] = request.marker_id
    if request.marker_size is not None:
        changes["marker_size"] = request.marker_size
    if request.dictionary is not None:
        changes["dictionary"] = request.dictionary
    if request.rehearsal.marker_at is not None:
        x, y, z, yaw = request.rehearsal.marker_at
        changes["pose_world_marker"] = Pose((x, y, z), rotation_exp([0.0, 0.0, np.deg2rad(yaw)]))
    return replace(stage, **changes)

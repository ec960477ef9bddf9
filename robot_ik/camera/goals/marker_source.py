"""A marker, or a body that carries several, in front of a camera as a source of goals."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.camera.filter import FilterOptions, MotionFilter, Update
from robot_ik.camera.goals.latency import DelayMeter
from robot_ik.camera.goals.lost import WhenLost
from robot_ik.camera.goals.one_euro import OneEuro
from robot_ik.camera.goals.sight import Choice, Sight, goal_weight, sigmas_at
from robot_ik.camera.pose import BodyObservation, MarkerObservation
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.track import MarkerTracker
from robot_ik.errors import MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.ports import Clock, RealClock, VirtualClock

if TYPE_CHECKING:
    from robot_ik.goals import Goal, PoseGoal, PositionGoal

_log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Layout = Mapping[int, tuple[float, Pose]]

# Without a new picture for this long the last goal is history.
_MAX_AGE_S = 0.5


class MarkerGoalSource:
    """Goals that follow a marker or body: a pose of the tool, fixed relative to it, at the time asked for.

    What comes out:

    * seen, orientation certain: a ``PoseGoal``;
    * orientation uncertain (``ambiguity`` above 0.6), but both possible poses put the tool in the same
      place to 2 mm: a ``PositionGoal`` there;
    * orientation uncertain otherwise, not seen, seen twice, or no new picture for half a second: None,
      which means hold where you are; after a while what ``when_lost`` says.

    Only ``marker`` can become a goal, whatever else is in view.  Each picture counts for the time it was
    grabbed at (``Frame.time``, on the run's clock); a ``MotionFilter`` tells from them where the marker is at
    the time asked for.  Goals weigh less where that is uncertain: min(1, ``trusted`` / σ) for the metres
    and for the radians, at least 0.05.

    ``poll`` looks and tells.  Where a picture takes longer than a tick, ``look`` may be called by a thread
    of its own and ``goal_at`` by the loop (``LatestGoals`` does so).

    Args:
        source: Gives the frames; their truth is removed before anything looks at them.
        tracker: Knows the optics, the dictionary and the sizes.
        pose_world_camera: Where the camera is; a callable is asked with the time of each picture (a camera
            on the arm).
        marker: Id of the marker to follow; or a body: its layout, id -> (side in metres,
            ``pose_body_marker``), or anything with such ``markers``.
        pose_marker_tool: The wanted pose of the frame, seen from the marker (x right, y up, z out of the
            printed face) or from the body.
        frame: Name of the robot's frame that shall go there.
        normal: World direction (3,) of the marker's z axis where it is known, for example (0, 0, 1) on a
            table.  The branch nearer to it is taken, and no orientation is uncertain any more.
        motion: What the filter assumes; None: no filter, each picture is for itself.
        predict: Goals for the time asked for, not for that of the picture.  None: where pictures are live.
        lead: Seconds to predict beyond the time asked for: the servos' own lag.
        trusted: Standard deviations (m, rad) up to which a goal weighs 1.
        calm: Smooths what is given while the marker rests.
        when_lost: What to do after a while without a goal.
        clock: The run's, which also stamps the pictures; None: the machine's.

    Attributes:
        last: Observation of the marker in the last frame; None when it was not seen.
        last_frame: The last frame looked at, without its truth; None before the first.
        made: Delays from grab to goal.
        used: Age of the pictures from which the goals were that were asked for.
    """

    def __init__(
        self,
        source: FrameSource,
        tracker: MarkerTracker,
        pose_world_camera: Pose | Callable[[float], Pose],
        marker: int | Layout | Any,
        pose_marker_tool: Pose,
        frame: str = "gripper",
        *,
        normal: ArrayLike | None = None,
        motion: FilterOptions | None = FilterOptions(),  # noqa: B008 - frozen
        predict: bool | None = None,
        lead: float = 0.0,
        trusted: tuple[float, float] = (1e-3, np.deg2rad(0.5)),
        calm: OneEuro | None = None,
        when_lost: WhenLost = WhenLost(),  # noqa: B008 - frozen
        clock: Clock | None = None,
    ) -> None:
        self.source, self.tracker, self.tool = source, tracker, frame
        self.pose_world_camera, self.pose_marker_tool = pose_world_camera, pose_marker_tool
        self.marker = marker if isinstance(marker, int) else dict(getattr(marker, "markers", marker))
        self.lead, self.trusted, self.when_lost = lead, trusted, when_lost
        self.last: MarkerObservation | BodyObservation | None = None
        self.last_frame: Frame | None = None
        self.made, self.used = DelayMeter(), DelayMeter()
        self._choice = Choice(pose_marker_tool, normal)
        self._filter, self._each_alone = MotionFilter(motion), motion is None
        self._predict = source.live if predict is None else predict
        self._calm, self._calm_pose = calm, Pose()
        self._clock = clock
        self._lock = threading.Lock()
        self._sight: Sight | None = None
        self._resting: PoseGoal | PositionGoal | None = None
        self._fresh_at = self._goal_at = -np.inf
        self._begun = np.nan

    def poll(self, now: float) -> Goal | None:
        """Looks, and gives the goal for the time ``now`` (seconds on the run's clock); None means hold.

        Cameras are not waited for: between two pictures the marker goes on as it did, or rests.

        Raises:
            FrameTimeoutError: The source has ended or stopped.
            CalibrationError: The frames have not the size of the calibration.
            MarkerNotFoundError: No goal for as long as ``when_lost`` allows, and it says stop.
        """
        self.look(now)
        return self.goal_at(now)

    def look(self, now: float, *, wait: bool = False) -> None:
        """Looks at the newest picture, if there is a new one; ``wait``: when there is.

        Raises:
            FrameTimeoutError: The source has ended or stopped.
            CalibrationError: The frames have not the size of the calibration.
        """
        newest = None if wait else getattr(self.source, "newest", None)
        frame: Frame | None = newest() if newest is not None else self.source.read()
        if frame is None:
            return
        if self.last_frame is not None and frame.sequence == self.last_frame.sequence:
            if not self.source.live:  # a photograph does not grow old; a camera that repeats itself is stuck
                with self._lock:
                    self._fresh_at = now
            return
        frame = frame.without_truth()
        seen = self._find(frame)
        done = now if self._clock is None else self._clock.now()  # looking may have taken long
        with self._lock:
            self._fresh_at, self.last_frame, self.last = done, frame, seen
            self._take(frame, seen)
            made = self._sight is not None
        if made and not isinstance(self._clock, VirtualClock):
            self.made.add(frame.time, (self._clock or RealClock()).now())

    def goal_at(self, now: float) -> Goal | None:
        """The goal for the time ``now`` from the pictures looked at; takes no picture and is quick.

        Raises:
            MarkerNotFoundError: As ``poll``.
        """
        with self._lock:
            self._begun = now if np.isnan(self._begun) else self._begun
            if now - self._fresh_at > _MAX_AGE_S:
                self.last = self._sight = None
            if self._sight is None or self.last_frame is None:
                return self._absent(now)
            self._goal_at = now
            age = self.used.add(self.last_frame.time, now)
            # A stamp of another clock cannot be compared with now.
            ahead = now + self.lead if self._predict and age == age else self.last_frame.time
            return self._goal(self._sight, ahead)

    @property
    def measured(self) -> PoseGoal | PositionGoal | None:
        """The goal at the time of the last picture, not predicted; None when it gave none."""
        with self._lock:
            if self._sight is None or self.last_frame is None:
                return None
            return self._goal(self._sight, self.last_frame.time)

    # ------------------------------------------------------------------------------------ inside

    def _find(self, frame: Frame) -> MarkerObservation | BodyObservation | None:
        if not isinstance(self.marker, int):
            return self.tracker.observe_body(frame, self.marker)
        seen = [o for o in self.tracker.observe(frame) if o.id == self.marker]
        if len(seen) > 1:
            _log.warning("marker %d is in view %d times; holding", self.marker, len(seen))
        return seen[0] if len(seen) == 1 else None

    def _take(self, frame: Frame, seen: MarkerObservation | BodyObservation | None) -> None:
        camera = self.pose_world_camera
        pose = camera(frame.time) if callable(camera) else camera
        sight = None if seen is None else self._choice.of(seen, pose)
        if sight is None:
            self._sight = None
            return
        if self._each_alone:
            self._filter.reset()
        what = self._filter.update(frame.time, sight.pose, sight.covariance)
        if what is Update.LATE or (what is Update.OUTLIER and self._sight is not None):
            return
        self._sight, self._resting = sight, None
        if self._calm is not None:
            if what is not Update.TAKEN or self._filter.moving().any():
                self._calm.reset()
            self._calm_pose = self._calm.update(frame.time, self._filter.predict(frame.time).pose)

    def _goal(self, sight: Sight, time: float) -> PoseGoal | PositionGoal:
        moving = self._filter.moving().any() and time > self._filter.time
        if not moving and self._resting is not None:
            return self._resting
        pose, covariance, _ = self._filter.predict(time)
        if not moving and self._calm is not None:
            pose = self._calm_pose
        goal = self._make(sight, pose, covariance)
        self._resting = self._resting if moving else goal
        return goal

    def _make(self, sight: Sight, pose: Pose, covariance: Array) -> PoseGoal | PositionGoal:
        # Imported at the first goal: looking needs no robot.
        from robot_ik.goals import PoseGoal, PositionGoal

        if sight.place is not None:
            sigma = sigmas_at(covariance, np.zeros(3))[0]
            return PositionGoal(
                self.tool, pose.position + sight.place, weight=goal_weight(sigma, self.trusted[0])
            )
        target = pose.compose(self.pose_marker_tool)
        metres, radians = sigmas_at(covariance, target.position - pose.position)
        return PoseGoal(
            self.tool, target.position, target.wxyz,
            position_weight=goal_weight(metres, self.trusted[0]),
            angle_weight=goal_weight(radians, self.trusted[1]),
        )  # fmt: skip

    def _absent(self, now: float) -> Goal | None:
        policy = self.when_lost
        if policy.then == "hold" or now - max(self._goal_at, self._begun) < policy.seconds:
            return None
        if policy.then == "park":
            return policy.goal
        what = f"marker {self.marker}" if isinstance(self.marker, int) else f"body of {sorted(self.marker)}"
        raise MarkerNotFoundError(
            f"the {what} has given no goal for {policy.seconds:g} s",
            hint="bring it back into view, light and focus; or let the arm hold or park when it is lost",
        )

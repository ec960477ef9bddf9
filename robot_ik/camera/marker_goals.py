"""Goals that follow a target, from the pictures of a camera."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

from robot_ik.camera.delays import DelayMeter
from robot_ik.camera.goals import PlacedTarget, place_target
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lost_policy import WhenLost
from robot_ik.camera.motion_filter import FilterOptions, MotionFilter, Update
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.targets import Observation, Target
from robot_ik.camera.tracker import Tracker
from robot_ik.errors import MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.goals import Goal, PoseGoal, PositionGoal
from robot_ik.ports import Array, Clock, RealClock, VirtualClock

# A goal from an older picture is not used, s.
_MAX_AGE = 0.5
_DEFAULT_FILTER = FilterOptions()
_DEFAULT_POLICY = WhenLost()


class MarkerGoalSource:
    """Goals of a tool that keeps a pose relative to a target.

    The goal is

    * a ``PoseGoal`` if the orientation of the target is known,
    * a ``PositionGoal`` if the orientation is ambiguous (above ``MAX_AMBIGUITY``), but both
      possible poses put the tool at the same position to 2 mm,
    * None, which means hold, if the target is not visible, ambiguous otherwise, or if there was no
      new picture for half a second. After a while ``when_lost`` applies.

    A picture is valid for the time at which it was taken (``Frame.time``, on the clock of the run).
    A ``MotionFilter`` estimates the pose of the target at the time of the goal. The weights of the
    goals follow from the covariance.

    ``poll`` processes a picture and returns the goal. If a picture takes longer than a tick of the
    loop, ``LatestGoals`` calls ``observe`` in a thread and ``goal_at`` in the loop.

    Args:
        source: Source of the frames. Their truth is removed before they are used.
        intrinsics: Intrinsics of the frames.
        target: Target to follow.
        pose_world_camera: Pose of the camera. A callable gets the time of each picture: a camera on
            the arm.
        pose_target_tool: Wanted pose of the tool in the target's frame.
        frame: Frame of the robot that is the tool.
        motion: Options of the filter; None: each picture is used alone.
        predict: Whether goals are for the requested time, or for that of the picture. None: predict
            if the source is live.
        lead: Time to predict beyond the requested time, s: the lag of the servos.
        when_lost: Policy for a lost target.
        clock: Clock of the run, which also stamps the pictures; None: that of the machine.

    Attributes:
        last: Observation in the last frame; None if the target was not visible.
        last_frame: Last frame processed, without its truth; None before the first.
        goal_delays: Delays from the time of a picture to its goal.
        picture_ages: Ages of the pictures when their goals were used.
    """

    def __init__(
        self,
        source: FrameSource,
        intrinsics: CameraIntrinsics,
        target: Target,
        pose_world_camera: Pose | Callable[[float], Pose],
        pose_target_tool: Pose,
        frame: str = "gripper",
        *,
        motion: FilterOptions | None = _DEFAULT_FILTER,
        predict: bool | None = None,
        lead: float = 0.0,
        when_lost: WhenLost = _DEFAULT_POLICY,
        clock: Clock | None = None,
    ) -> None:
        self.source = source
        self.intrinsics = intrinsics
        self.target = target
        self.pose_world_camera = pose_world_camera
        self.pose_target_tool = pose_target_tool
        self.frame = frame
        self.lead = lead
        self.when_lost = when_lost
        self.last: Observation | None = None
        self.last_frame: Frame | None = None
        self.goal_delays = DelayMeter()
        self.picture_ages = DelayMeter()
        self._tracker = None if motion is None else Tracker(intrinsics, [target])
        self._filter = MotionFilter(motion)
        self._predict = source.live if predict is None else predict
        self._clock = clock
        # The observing thread and the loop share the attributes below.
        self._lock = threading.Lock()
        self._is_known = False
        self._tool_offset: Array | None = None
        self._resting_goal: PoseGoal | PositionGoal | None = None
        self._observation_time = -math.inf
        self._goal_time = -math.inf
        self._start_time = math.nan

    def poll(self, now: float) -> Goal | None:
        """Process the newest picture and return the goal for the time ``now``; None means hold.

        It does not wait for the camera.

        Args:
            now: Time on the clock of the run, s.

        Raises:
            FrameTimeoutError: The source has ended or stopped.
            CalibrationError: The frames do not have the size of the intrinsics.
            MarkerNotFoundError: The target is lost and its policy is ``stop``.
        """
        self.observe(now)
        return self.goal_at(now)

    def observe(self, now: float, *, wait: bool = False) -> None:
        """Process the newest picture if there is a new one.

        Args:
            now: Time on the clock of the run, s.
            wait: Wait for a new picture.

        Raises:
            FrameTimeoutError: The source has ended or stopped.
            CalibrationError: The frames do not have the size of the intrinsics.
        """
        frame = self.source.read() if wait else self.source.newest()
        if frame is None:
            return
        if self.last_frame is not None and frame.sequence == self.last_frame.sequence:
            # A photograph stays valid. A camera that repeats a frame is stuck.
            if not self.source.live:
                with self._lock:
                    self._observation_time = now
            return

        frame = frame.without_truth()
        observation = self._find(frame)
        # ``_find`` takes time.
        end = now if self._clock is None else self._clock.now()
        with self._lock:
            self._observation_time = end
            self.last_frame = frame
            self.last = observation
            self._update_filter(frame, observation)
            has_goal = self._is_known
        if has_goal and not isinstance(self._clock, VirtualClock):
            self.goal_delays.add(frame.time, (self._clock or RealClock()).now())

    def goal_at(self, now: float) -> Goal | None:
        """Return the goal for the time ``now``, s, from the pictures processed so far.

        Raises:
            MarkerNotFoundError: The target is lost and its policy is ``stop``.
        """
        with self._lock:
            if math.isnan(self._start_time):
                self._start_time = now
            if now - self._observation_time > _MAX_AGE:
                self.last = None
                self._is_known = False
            if not self._is_known or self.last_frame is None:
                return self._goal_when_lost(now)
            self._goal_time = now
            age = self.picture_ages.add(self.last_frame.time, now)
            # The age is NaN if another clock stamped the picture. Then prediction is impossible.
            if self._predict and math.isfinite(age):
                return self._goal(now + self.lead)
            return self._goal(self.last_frame.time)

    @property
    def measured(self) -> PoseGoal | PositionGoal | None:
        """Goal for the time of the last picture, without prediction; None if the target is lost."""
        with self._lock:
            if not self._is_known or self.last_frame is None:
                return None
            return self._goal(self.last_frame.time)

    def _find(self, frame: Frame) -> Observation | None:
        if self._tracker is None:
            return self.target.find(frame, self.intrinsics)
        observations = self._tracker.observe(frame)
        return observations[0] if observations else None

    def _update_filter(self, frame: Frame, observation: Observation | None) -> None:
        placed = None if observation is None else self._place(observation, frame.time)
        if placed is None:
            self._is_known = False
            return
        if self._tracker is None:
            self._filter.reset()
        update = self._filter.update(frame.time, placed.pose, placed.covariance)
        if update is Update.LATE or (update is Update.OUTLIER and self._is_known):
            return
        self._is_known = True
        self._tool_offset = placed.tool_offset
        self._resting_goal = None

    def _place(self, observation: Observation, time: float) -> PlacedTarget | None:
        camera = self.pose_world_camera
        pose_world_camera = camera(time) if callable(camera) else camera
        return place_target(observation, pose_world_camera, self.pose_target_tool)

    def _goal(self, time: float) -> PoseGoal | PositionGoal:
        moving = self._filter.moving.any() and time > self._filter.time
        if not moving and self._resting_goal is not None:
            return self._resting_goal
        pose, covariance, _ = self._filter.predict(time)
        placed = PlacedTarget(pose, covariance, self._tool_offset)
        goal = placed.goal(self.pose_target_tool, self.frame)
        if not moving:
            self._resting_goal = goal
        return goal

    def _goal_when_lost(self, now: float) -> Goal | None:
        policy = self.when_lost
        last_time = max(self._goal_time, self._start_time)
        if policy.then == "hold" or now - last_time < policy.seconds:
            return None
        if policy.then == "park":
            return policy.goal
        name = getattr(self.target, "name", "target")
        raise MarkerNotFoundError(
            f"the {name} has given no goal for {policy.seconds:g} s",
            hint="bring it back into view, check light and focus, or choose to hold or park when "
            "it is lost",
        )

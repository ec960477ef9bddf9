"""Markers and bodies that are seen become a source of goals.

``MarkerGoalSource`` is the source; ``LatestGoals`` looks beside the control loop.  The filter over time is
in ``camera/motion_filter.py``.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.camera.motion_filter import FilterOptions, MotionFilter, OneEuro, Update
from robot_ik.camera.observations import BodyObservation, MarkerObservation
from robot_ik.camera.sources import Frame, FrameSource
from robot_ik.camera.tracker import Layout, MarkerTracker
from robot_ik.errors import CameraError, FrameTimeoutError, MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.ports import Array, Clock, Closing, RealClock, VirtualClock, short_switch_interval

if TYPE_CHECKING:
    from robot_ik.goals import Goal, PoseGoal, PositionGoal


# Delays kept; older ones are forgotten, so that the figures are of the last minute or so.
_KEPT = 2000
# A picture that is older than this, or of the future, was not stamped by the clock that is asked now.
LONGEST_S = 2.0
_CLOCK_SLACK_S = 1e-3


@dataclass(frozen=True)
class Delays:
    """Delays in figures, seconds; NaN where nothing was measured.

    Attributes:
        count: How many were measured.
        p50, p95: Median, and what 95 of 100 stay below.
    """

    count: int = 0
    p50: float = float("nan")
    p95: float = float("nan")

    def __str__(self) -> str:
        if not self.count:
            return "not measured"
        return f"p50 {1e3 * self.p50:.1f} ms, p95 {1e3 * self.p95:.1f} ms"


class DelayMeter:
    """Gathers delays; may be written by one thread and read by another."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: deque[float] = deque(maxlen=_KEPT)
        self._count = 0

    def add(self, grabbed: float, now: float) -> float:
        """Takes the delay from ``grabbed`` to ``now``, seconds on one clock; gives it back.

        One that cannot be (negative, or longer than two seconds) is of two different clocks: it is not
        counted, and comes back as NaN.
        """
        delay = now - grabbed
        if not -_CLOCK_SLACK_S <= delay <= LONGEST_S:
            return float("nan")
        with self._lock:
            self._kept.append(max(delay, 0.0))
            self._count += 1
        return max(delay, 0.0)

    def summary(self) -> Delays:
        """What was measured until now."""
        with self._lock:
            kept, count = list(self._kept), self._count
        if not kept:
            return Delays()
        p50, p95 = np.percentile(kept, [50.0, 95.0])
        return Delays(count, float(p50), float(p95))


# ------------------------------------------------------------------------------------------
# Looking beside the control loop: the newest goal is always at hand, and no tick waits for a picture.


_log = logging.getLogger(__name__)

# A goal older than this is history: then the arm holds.
_MAX_AGE_S = 0.5
# How often a scene that exists only in numbers is looked at, Hz: as a cheap camera would.
SYNTHETIC_RATE_HZ = 15.0


class LatestGoals(Closing):
    """Looks on a thread of its own (real time), or whenever a picture is due (virtual time).

    Taking a picture and finding a marker in it takes several periods of a control loop.  So the source
    observes there, and is asked for the goal at each tick's own time.

    Args:
        goals: The source that is asked: its ``observe`` and ``goal_at``.
        clock: The run's clock.
        rate_hz: How often to look; None, real time only: as fast as pictures come, for cameras that
            have a rate of their own.

    Attributes:
        ended: The film is over, or the camera has stopped; from then on there is no goal.
    """

    def __init__(self, goals: MarkerGoalSource, clock: Clock, rate_hz: float | None = None) -> None:
        self._goals, self._clock = goals, clock
        self._period = 0.0 if rate_hz is None else 1.0 / rate_hz
        self._virtual = isinstance(clock, VirtualClock)
        self._due = -float("inf")
        self._failure: BaseException | None = None
        self.ended = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._prompt = contextlib.ExitStack()

    def __enter__(self) -> Self:
        if not self._virtual:
            self._prompt.enter_context(short_switch_interval())
            self._thread = threading.Thread(target=self._run, daemon=True, name="looking")
            self._thread.start()
        return self

    def close(self) -> None:
        """Stops looking; the source stays open."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self._prompt.close()

    def poll(self, now: float) -> Goal | None:
        """The goal for the time ``now``; None, which means hold, when there is none.

        Raises:
            CameraError: What looking raised, except that pictures came to an end.
            MarkerNotFoundError: The source's policy for a lost marker says stop.
        """
        if self._virtual and now >= self._due and not self.ended:
            self._due = now + self._period
            self._observe(now)
        if self._failure is not None:
            raise self._failure
        return self._goals.goal_at(now)

    def _observe(self, now: float) -> None:
        try:
            self._goals.observe(now, wait=not self._virtual)
        except FrameTimeoutError as error:
            _log.info("no more pictures: %s", error)
            self.ended = True

    def _run(self) -> None:
        while not self._stop.is_set() and not self.ended:
            begin = self._clock.now()
            try:
                self._observe(begin)
            except Exception as error:  # handed to whoever asks next
                self._failure = error
                return
            self._stop.wait(max(0.0, begin + self._period - self._clock.now()))


LostPolicy = Literal["hold", "park", "stop"]


@dataclass(frozen=True)
class WhenLost:
    """First the arm holds; after ``seconds`` without a goal comes the policy.

    Attributes:
        then: ``hold`` goes on holding; ``park`` goes to ``goal``; ``stop`` raises ``MarkerNotFoundError``,
            which ends the run, and the arm's exit policy decides.
        seconds: Since the last goal from a picture, or since the first look when there was none.
        goal: Where to park, for example ``PostureGoal(q=robot.home)``.

    Raises:
        CameraError: No such policy, no time, or nowhere to park.
    """

    then: LostPolicy = "hold"
    seconds: float = 2.0
    goal: Goal | None = None

    def __post_init__(self) -> None:
        if self.then not in ("hold", "park", "stop"):
            raise CameraError(
                f"{self.then!r} is nothing to do when a marker is lost", hint="hold, park or stop"
            )
        if not (np.isfinite(self.seconds) and self.seconds >= 0.0):
            raise CameraError(
                f"a marker cannot be lost for {self.seconds} s", hint="give 0 or a finite time in seconds"
            )
        if (self.then == "park") != (self.goal is not None):
            raise CameraError(
                "a goal for a lost marker is for parking, and parking needs one",
                hint='WhenLost("park", goal=PostureGoal(q=robot.home))',
            )


# ------------------------------------------------------------------------------------------
# What one observation of a marker is worth: which of its two poses, how sure, and how much its goal weighs.


# Above this ratio of errors the two branches of a flat marker cannot be told apart: all wrong choices in our
# trials (low contrast, 1.5 m) had 0.63 or more.
AMBIGUITY_LIMIT = 0.6
# Both branches may still agree on where the tool should be, to this distance.
_SAME_POSITION = 0.002
# Standard deviation of an orientation that says nothing, rad.
_ANY_ROTATION = 10.0
# Standard deviations (m, rad) up to which a goal weighs 1.
_TRUSTED = 1e-3, np.deg2rad(0.5)
# However uncertain, a goal weighs at least this: it was seen.
LEAST_WEIGHT = 0.05


def sigmas_at(covariance: Array, lever: ArrayLike) -> tuple[float, float]:
    """Standard deviations (m, rad) in the worst direction of a point ``lever`` (3,) away from the origin.

    A small rotation ω moves that point by ω × lever.  Covariance (6, 6) and lever have the same axes.
    """
    x, y, z = np.asarray(lever, dtype=float).tolist()
    jacobian = np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]])
    both = np.stack([jacobian @ covariance @ jacobian.T, covariance[3:, 3:]])
    metres, radians = np.linalg.eigvalsh(both)[:, -1].tolist()
    return math.sqrt(max(metres, 0.0)), math.sqrt(max(radians, 0.0))


def goal_weight(sigma: float, trusted: float) -> float:
    """Weight of a goal that is known to ``sigma``: 1 up to ``trusted``, then trusted / σ, at least 0.05."""
    return max(LEAST_WEIGHT, min(1.0, trusted / sigma)) if sigma > 0.0 else 1.0


class MarkerGoalSource:
    """Goals that follow a marker or body: a pose of the tool, fixed relative to it, at the time asked for.

    What comes out:

    * seen, orientation certain: a ``PoseGoal``;
    * orientation uncertain (``ambiguity`` above 0.6), but both possible poses put the tool at the same
      position to 2 mm: a ``PositionGoal`` there;
    * orientation uncertain otherwise, not seen, seen twice, or no new picture for half a second: None,
      which means hold where you are; after a while what ``when_lost`` says.

    Only ``marker`` can become a goal, whatever else is in view.  Each picture counts for the time it was
    grabbed at (``Frame.time``, on the run's clock); from them a ``MotionFilter`` estimates where the marker
    is at the time asked for.  Where that is uncertain goals weigh less, from 1 mm and from 0.5 degrees on
    (``goal_weight``).

    ``poll`` searches a picture and gives the goal.  Where a picture takes longer than a tick, ``observe`` may
    be called by a thread of its own and ``goal_at`` by the loop (``LatestGoals`` does so).

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
        motion: What the filter assumes; None: no filter, each picture is for itself.
        predict: Goals for the time asked for, not for that of the picture.  None: where pictures are live.
        lead: Seconds to predict beyond the time asked for: the servos' own lag.
        calm: Smooths what is given while the marker rests.
        when_lost: What to do after a while without a goal.
        clock: The run's, which also stamps the pictures; None: the machine's.

    Attributes:
        last: Observation of the marker in the last frame; None when it was not seen.
        last_frame: The last frame looked at, without its truth; None before the first.
        goal_delays: From the grab of a picture to its goal.
        picture_ages: Of the pictures from which goals were made, when these were asked for.
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
        motion: FilterOptions | None = FilterOptions(),  # noqa: B008 - frozen
        predict: bool | None = None,
        lead: float = 0.0,
        calm: OneEuro | None = None,
        when_lost: WhenLost = WhenLost(),
        clock: Clock | None = None,
    ) -> None:
        self.source, self.tracker, self.tool = source, tracker, frame
        self.pose_world_camera, self.pose_marker_tool = pose_world_camera, pose_marker_tool
        self.marker = marker if isinstance(marker, int) else dict(getattr(marker, "markers", marker))
        self.lead, self.when_lost = lead, when_lost
        self.last: MarkerObservation | BodyObservation | None = None
        self.last_frame: Frame | None = None
        self.goal_delays, self.picture_ages = DelayMeter(), DelayMeter()
        self._filter, self._each_alone = MotionFilter(motion), motion is None
        self._predict = source.live if predict is None else predict
        self._calm, self._calm_pose = calm, Pose()
        self._clock = clock
        self._lock = threading.Lock()
        # Whether the filter says where the marker is; and (3,) the tool seen from there, along the world's
        # axes, where only that is sure, None where the orientation is.
        self._known = False
        self._tool_offset: Array | None = None
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
        self.observe(now)
        return self.goal_at(now)

    def observe(self, now: float, *, wait: bool = False) -> None:
        """Looks at the newest picture, if there is a new one; ``wait``: when there is.

        Raises:
            FrameTimeoutError: The source has ended or stopped.
            CalibrationError: The frames have not the size of the calibration.
        """
        frame = self.source.read() if wait else self.source.newest()
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
            self._update_filter(frame, seen)
            made = self._known
        if made and not isinstance(self._clock, VirtualClock):
            self.goal_delays.add(frame.time, (self._clock or RealClock()).now())

    def goal_at(self, now: float) -> Goal | None:
        """The goal for the time ``now`` from the pictures looked at; takes no picture and is quick.

        Raises:
            MarkerNotFoundError: As ``poll``.
        """
        with self._lock:
            self._begun = now if np.isnan(self._begun) else self._begun
            if now - self._fresh_at > _MAX_AGE_S:
                self.last, self._known = None, False
            if not self._known or self.last_frame is None:
                return self._absent(now)
            self._goal_at = now
            age = self.picture_ages.add(self.last_frame.time, now)
            # A stamp of another clock cannot be compared with now.
            target_time = now + self.lead if self._predict and age == age else self.last_frame.time
            return self._goal(target_time)

    @property
    def measured(self) -> PoseGoal | PositionGoal | None:
        """The goal at the time of the last picture, not predicted; None when it gave none."""
        with self._lock:
            return self._goal(self.last_frame.time) if self._known and self.last_frame is not None else None

    # ------------------------------------------------------------------------------------ inside

    def _find(self, frame: Frame) -> MarkerObservation | BodyObservation | None:
        if not isinstance(self.marker, int):
            return self.tracker.observe_body(frame, self.marker)
        seen = self.tracker.observe(frame, [self.marker])
        if len(seen) > 1:
            _log.warning("marker %d is in view %d times; holding", self.marker, len(seen))
        return seen[0] if len(seen) == 1 else None

    def _placed(
        self, seen: MarkerObservation | BodyObservation, pose_world_camera: Pose
    ) -> tuple[Pose, Array, Array | None] | None:
        """Pose and covariance in the world, and ``_tool_offset``; None: unknown where the tool should go."""
        own = seen.pose_camera_body if isinstance(seen, BodyObservation) else seen.pose
        pose = pose_world_camera.compose(own)
        rotation = np.zeros((6, 6))
        rotation[:3, :3] = rotation[3:, 3:] = pose_world_camera.rotation
        covariance = rotation @ seen.covariance @ rotation.T
        if seen.alternative is None or seen.ambiguity <= AMBIGUITY_LIMIT:
            return pose, covariance, None
        other = pose_world_camera.compose(seen.alternative)
        one, two = (branch.apply(self.pose_marker_tool.position) for branch in (pose, other))
        if np.linalg.norm(one - two) > _SAME_POSITION:
            return None
        unsure = np.zeros((6, 6))
        unsure[:3, :3] = covariance[:3, :3]
        unsure[3:, 3:] = _ANY_ROTATION**2 * np.eye(3)
        return pose, unsure, 0.5 * (one + two) - pose.position

    def _update_filter(self, frame: Frame, seen: MarkerObservation | BodyObservation | None) -> None:
        camera = self.pose_world_camera
        pose = camera(frame.time) if callable(camera) else camera
        placed = None if seen is None else self._placed(seen, pose)
        if placed is None:
            self._known = False
            return
        if self._each_alone:
            self._filter.reset()
        pose, covariance, tool_offset = placed
        what = self._filter.update(frame.time, pose, covariance)
        if what is Update.LATE or (what is Update.OUTLIER and self._known):
            return
        self._known, self._tool_offset, self._resting = True, tool_offset, None
        if self._calm is not None:
            if what is not Update.TAKEN or self._filter.moving.any():
                self._calm.reset()
            self._calm_pose = self._calm.update(frame.time, self._filter.predict(frame.time).pose)

    def _goal(self, time: float) -> PoseGoal | PositionGoal:
        moving = self._filter.moving.any() and time > self._filter.time
        if not moving and self._resting is not None:
            return self._resting
        pose, covariance, _ = self._filter.predict(time)
        if not moving and self._calm is not None:
            pose = self._calm_pose
        goal = self._make(pose, covariance)
        if not moving:
            self._resting = goal
        return goal

    def _make(self, pose: Pose, covariance: Array) -> PoseGoal | PositionGoal:
        # Imported at the first goal: looking needs no robot.
        from robot_ik.goals import PoseGoal, PositionGoal

        if self._tool_offset is not None:
            sigma = sigmas_at(covariance, np.zeros(3))[0]
            place = pose.position + self._tool_offset
            return PositionGoal(self.tool, place, weight=goal_weight(sigma, _TRUSTED[0]))
        target = pose.compose(self.pose_marker_tool)
        metres, radians = sigmas_at(covariance, target.position - pose.position)
        return PoseGoal(
            self.tool, target.position, target.wxyz,
            position_weight=goal_weight(metres, _TRUSTED[0]),
            angle_weight=goal_weight(radians, _TRUSTED[1]),
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

"""The camera's side of a job: what it looks at, where it stands, and what it may be asked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.detect import MarkerDetector
from robot_ik.camera.filter import FilterOptions
from robot_ik.camera.goals import MarkerGoalSource
from robot_ik.camera.goals.latency import Delays
from robot_ik.camera.goals.latest import SYNTHETIC_RATE_HZ, LatestGoals
from robot_ik.camera.goals.lost import WhenLost
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.made_up.synthetic import SyntheticSource
from robot_ik.camera.pose import BodyObservation, MarkerObservation
from robot_ik.camera.sources import FrameSource
from robot_ik.camera.track import MarkerTracker
from robot_ik.errors import FrameTimeoutError, MarkerNotFoundError
from robot_ik.geometry import Pose
from robot_ik.goals import PoseGoal, PositionGoal
from robot_ik.jobs.pictures import REST_SECONDS, Blindfold, Wandering
from robot_ik.jobs.stage import Stage
from robot_ik.jobs.verdict import Bound, sigma_at
from robot_ik.ports import Clock

if TYPE_CHECKING:
    from robot_ik.jobs.limbs import Limbs

Array = NDArray[np.float64]

# How often a camera or a film is asked again before a marker counts as not there.
_LIVE_TRIES = 20
_SYNTHETIC_TRIES = 2
# With fewer degrees of freedom a full pose is out of reach in general.  With five the place and the tool's z
# axis are asked for, its turn about that axis is free; with fewer only the place.
FREEDOMS_OF_A_POSE, FREEDOMS_OF_AN_AXIS = 6, 5
# While it is followed the synthetic marker wanders this far, in hovers, and then lies still for a while.
_WANDER = 0.4


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

    def uncertainty(self, place: Array) -> Bound:
        """Standard deviation of a point ``place`` (3,), seen from the marker, in the worst direction."""
        pose = self.observation.pose
        return sigma_at(self.observation.covariance, pose.rotation @ place)


class Eyes:
    """A camera and what it is for in a reach.

    Attributes:
        pose_world_camera: Where it stands.
        live: It can look again; False where its pictures are recorded.
        sees_arm: Its pictures show the arm, so it can judge; ``why_blind`` says why not.
        last_image: The last picture taken.
        delays: After following: from grab to goal, and the age of the picture at each tick.
        path: From following on: where the synthetic marker truly is, by time; None where nobody knows.
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
        seed: int = 0,
        when_lost: WhenLost = WhenLost(),  # noqa: B008 - frozen
        lead: float = 0.0,
    ) -> None:
        self._when_lost, self._lead = when_lost, lead
        self.delays: tuple[Delays, Delays] | None = None
        self.path: Wandering | None = None
        self.stage, self.intrinsics, self.pose_world_camera = stage, intrinsics, pose_world_camera
        self.live = source.live
        # Films are followed at their own speed, cameras at theirs, scenes in numbers at a usual one.
        self._rate = SYNTHETIC_RATE_HZ if synthetic is not None else getattr(source, "rate_hz", None)
        self._seed = seed
        self.sees_arm, self.why_blind = not why_blind, why_blind
        self._limbs, self._frame, self._synthetic = limbs, frame, synthetic
        self._source = Blindfold(source)
        sides = {id: side for id, (side, _) in stage.cube.items()}
        self._cubes = MarkerTracker(intrinsics, stage.dictionary, sides)
        self._goals = self.goal_source(self._source)
        self._followed: Seen | None = None
        self._moving: SyntheticSource | None = None
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
        # A recording is searched to its end: there is no hurry, and nothing else to see.
        while tries > 0 or not self.live:
            try:
                goal = self._goals.poll(self._limbs.clock.now())
            except FrameTimeoutError:
                break
            last = self._goals.last
            if isinstance(goal, PoseGoal | PositionGoal) and isinstance(last, MarkerObservation):
                return self.seen(goal, last, self._source.truth)
            if self._source.exhausted:
                break
            tries -= 1
        raise self._not_found()

    def find_target_again(self) -> Seen:
        """The target where it is now: after following, the last one of a recording, else a new look.

        Raises:
            MarkerNotFoundError: As ``find_target``.
        """
        if not self.live and self._followed is not None:
            return self._followed
        return self.find_target()

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

    def get_ready_to_follow(self) -> None:
        """Does what would keep an arm with torque waiting: the first picture of a stage takes longest."""
        if self._synthetic is None or self._moving is not None:
            return
        self._moving = SyntheticSource(
            self._synthetic.scene,
            self._limbs.true_q,
            seed=self._seed,
            clock=self._limbs.clock,
            quality="fast",
        )
        self._moving.read()

    @contextlib.contextmanager
    def following(self, clock: Clock, seconds: float) -> Iterator[LatestGoals]:
        """A goal source that goes on looking; the synthetic marker wanders meanwhile."""
        if self._synthetic is None:
            aimed = _Aimed(self, self._source)
            with LatestGoals(aimed, clock, self._rate) as latest:
                yield latest
            self._followed, self.delays = aimed.seen, aimed.delays
            return
        scene = self._synthetic.scene
        home = next(m.pose for m in scene.markers if m.id == self.stage.marker_id)
        assert isinstance(home, Pose)
        self.get_ready_to_follow()
        moving = self._moving
        assert moving is not None
        begin, size = clock.now() + REST_SECONDS, _WANDER * self.stage.hover
        self.path = path = Wandering(home, begin, seconds - REST_SECONDS, size)
        moving.scene = scene.with_marker(self.stage.marker_id, pose=path)
        aimed = _Aimed(self, Blindfold(moving))
        with LatestGoals(aimed, clock, self._rate) as latest:
            yield latest
        self.delays = aimed.delays
        self._synthetic.scene = scene.with_marker(self.stage.marker_id, pose=path(clock.now()))

    def goal_source(self, source: Blindfold, *, follow: bool = False) -> MarkerGoalSource:
        """Goals from the target marker; each picture of ``source`` for itself, unless to ``follow``."""
        return MarkerGoalSource(
            source,
            self._tracker(follow),
            self.pose_world_camera,
            self.stage.marker_id,
            self.stage.pose_marker_tool,
            self._frame,
            motion=FilterOptions() if follow else None,
            predict=follow and self.live,
            lead=self._lead if follow else 0.0,
            when_lost=self._when_lost if follow else WhenLost(),
            clock=self._limbs.clock,
        )

    def _tracker(self, window: bool) -> MarkerTracker:
        stage = self.stage
        return MarkerTracker(
            self.intrinsics,
            stage.dictionary,
            {stage.marker_id: stage.marker_size},
            [stage.marker_id],
            window=window,
        )

    def seen(self, goal: PoseGoal | PositionGoal, observation: MarkerObservation, truth: Any) -> Seen:
        """What an observation means for this arm."""
        true_pose = (truth or {}).get("pose_world_marker", {}).get(self.stage.marker_id)
        pose = self.pose_world_camera.compose(observation.pose)
        return Seen(self.for_arm(goal), observation, pose, true_pose)

    def for_arm(self, goal: Any) -> Any:
        """``goal`` as this arm can have it: with five joints its place and axis, with fewer its place."""
        if not isinstance(goal, PoseGoal) or self._limbs.freedoms >= FREEDOMS_OF_A_POSE:
            return goal
        if self._limbs.freedoms >= FREEDOMS_OF_AN_AXIS:
            return replace(goal, free_axis="z")
        return PositionGoal(self._frame, goal.position, weight=goal.position_weight)

    def _not_found(self) -> MarkerNotFoundError:
        wanted = f"marker {self.stage.marker_id} of {self.stage.dictionary}"
        image = self.last_image
        if self._goals.last is not None:
            return MarkerNotFoundError(
                f"{wanted} is in view, but its two possible orientations cannot be told apart",
                hint="show it larger, sharper or more from the side",
            )
        found = [] if image is None else MarkerDetector(self.stage.dictionary).detect(image)
        others = ", ".join(str(id) for id in sorted({detection.id for detection in found}))
        there = f"in view: {others}" if others else "no marker of that dictionary is in view"
        return MarkerNotFoundError(
            f"{wanted} was not found; {there}",
            hint="check id (--marker), dictionary (--dictionary), light, focus and the white margin round it",
        )


class _Aimed:
    """Goals for following one arm; remembers what was seen last."""

    def __init__(self, eyes: Eyes, source: Blindfold) -> None:
        self._eyes, self._source = eyes, source
        self._goals = eyes.goal_source(source, follow=True)
        self.seen: Seen | None = None

    @property
    def delays(self) -> tuple[Delays, Delays]:
        """From grab to goal, and the age of the picture at each tick."""
        return self._goals.made.figures(), self._goals.used.figures()

    def look(self, now: float, *, wait: bool = False) -> None:
        """Looks at the next picture."""
        self._goals.look(now, wait=wait)
        goal, last = self._goals.measured, self._goals.last
        if goal is not None and isinstance(last, MarkerObservation):
            self.seen = self._eyes.seen(goal, last, self._source.truth)

    def goal_at(self, now: float) -> Any:
        """The goal at ``now``, or None."""
        return self._eyes.for_arm(self._goals.goal_at(now))

    def poll(self, now: float) -> Any:
        """Looks, and gives the goal at ``now``, or None."""
        self.look(now)
        return self.goal_at(now)

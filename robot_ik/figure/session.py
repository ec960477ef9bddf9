"""A running figure: ``set_ball`` moves its ball, ``step`` returns frames and decisions.

*Active*: the figure follows the ball while it moves. *Passive*: ``start_passive`` freezes the ball
and the figure acts. The ball stays frozen until passive mode ends or ``reset`` (Pađen 2011).

A motion is planned in a thread (``planner``) and begins a fixed number of frames after its planning
began. ``step`` waits if the plan is not ready then, so the frames do not depend on the speed of the
machine.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.figure.abilities import Abilities
from robot_ik.figure.actions import Motion, reach_ball, return_to_rest, walk_motion
from robot_ik.figure.decide import Decider, Decision
from robot_ik.figure.figure import DT, Figure, in_stance_frame
from robot_ik.figure.footprints import prints_of, shuffle_prints, walk_prints, wrapped
from robot_ik.figure.gait import FLAT, SHUFFLE, WALK
from robot_ik.figure.jump import jump
from robot_ik.figure.planner import Planner
from robot_ik.figure.poses import BEND, REACH
from robot_ik.figure.transitions import blend_into, remaining, stop_walk
from robot_ik.figure.walk import Walk, walk
from robot_ik.geometry import vector
from robot_ik.ports import Array


@dataclass(frozen=True)
class SessionOptions:
    """Parameters of a session.

    Attributes:
        moved: Smallest motion of the ball that counts, m.
        elsewhere: The figure decides again if the ball moved by more than this while a motion is
            planned, m.
        replace_interval: Smallest number of frames between two motions.
        action_lead: Frames in which a reach, a bend or a return to rest is planned. It begins at
            the frame of the present motion at that time. Planning takes 5 to 40 ms.
        walk_lead: Frames in which a walk or a jump is planned. Planning takes 100 to 200 ms.
        stop_lead: Frames in which the end of the present walk is planned.
        at_ease: Largest joint angle from home without a return to rest, rad.
        still: Largest joint speed without a return to rest, rad/s.
        at_stance: Distance at which a stance is reached, m.
        at_heading: Difference of the headings at which a stance is reached, rad.
        near: Distance below which the steps are small, m.
        turn_in_place_deg: Change of the heading above which the figure turns on the spot, degrees.
    """

    moved: float = 0.01
    elsewhere: float = 0.3
    replace_interval: int = 6
    action_lead: int = 4
    walk_lead: int = 20
    stop_lead: int = 30
    at_ease: float = 0.25
    still: float = 0.1
    at_stance: float = 0.01
    at_heading: float = 0.02
    near: float = 1.0
    turn_in_place_deg: float = 50.0


SESSION = SessionOptions()
"""The parameters of all sessions."""


@dataclass(frozen=True, eq=False)
class FigureFrame:
    """One frame.

    Attributes:
        t: Time since the session began, s.
        q: (nq,) joint values.
        action: ``stand``, ``reach``, ``bend``, ``jump``, ``walk`` or ``rest``.
        phase: Progress of the action, 0 to 1.
        contact: (2,) state of the feet: ``gait.AIR``, ``HEEL``, ``FLAT`` or ``TOE``.
        zmp: (2,) planned zero-moment point, or NaN.
        ball: (3,) the ball on which the figure acts, or NaN.
        decision: The latest decision.
        speeds: Set of joint speed limits that holds.
    """

    t: float
    q: Array
    action: str
    phase: float
    contact: NDArray[np.int64]
    zmp: Array
    ball: Array
    decision: Decision
    speeds: str = "daily"


@dataclass(frozen=True, eq=False)
class _Pending:
    """A motion that is planned.

    Attributes:
        plan: The motion, when it is ready.
        due: Number of the frame from which the motion is shown.
        ends_walk: Whether it is the end of the present walk.
    """

    plan: Future[Motion] | Future[Walk]
    due: int
    ends_walk: bool = False


_NO_DECISION = Decision("nothing", None, "no ball has been given yet")


class FigureSession:
    """Runs one figure. One thread uses it.

    Args:
        abilities: Abilities of the figure.
        mode: ``active`` or ``passive``.
        stance: (x, y, heading) of the first stance.
    """

    def __init__(
        self,
        abilities: Abilities,
        *,
        mode: str = "active",
        stance: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.decider = Decider(abilities)
        self.mode = mode
        self._planner = Planner(abilities)
        self._start = stance
        self._frames = 0
        self._pending: _Pending | None = None
        self.reset()

    @property
    def figure(self) -> Figure:
        """The figure."""
        return self.decider.figure

    @property
    def ball(self) -> Array | None:
        """The current ball (3,), in passive mode the frozen one, or None."""
        return self._ball if self.mode == "active" else self._frozen_ball

    @property
    def busy(self) -> bool:
        """Whether the figure acts or is about to act."""
        is_moving = self._motion is not None or self._pending is not None
        has_more = self._stance_goal is not None or self._next_decision is not None
        return is_moving or has_more or self._ball_moved(SESSION.moved)

    @property
    def planning(self) -> bool:
        """Whether a motion is planned."""
        return self._pending is not None

    def reset(self) -> None:
        """Put the figure back to its first stance, at rest and without a ball."""
        self._drop_plan()
        self._q = self.figure.placed(self.figure.home, *self._start)
        self._previous_q = self._q
        self._ball: Array | None = None
        self._frozen_ball: Array | None = None
        # The motion that is shown, its next frame, and the frames since it began.
        self._motion: Motion | None = None
        self._index = 0
        self._shown = 0
        self._walk: Walk | None = None
        # A walk that is not over, and an action after the return to rest.
        self._stance_goal: Array | None = None
        self._has_walked = False
        self._next_decision: Decision | None = None
        # The ball of the latest decision.
        self._decided_ball: Array | None = None
        self.decision = _NO_DECISION

    def set_ball(self, ball: ArrayLike | None) -> None:
        """Move the ball to (3,), m. None removes it.

        Raises:
            InvalidGoalError: The ball is not three finite numbers.
        """
        self._ball = None if ball is None else vector(ball, 3, "ball")

    def set_mode(self, mode: str) -> None:
        """Set the mode, ``active`` or ``passive``. The end of passive mode releases the ball."""
        if mode != self.mode:
            self.mode = mode
            self._frozen_ball = None

    def start_passive(self) -> None:
        """Freeze the ball in passive mode and act on it."""
        self._frozen_ball = self._ball
        self._decided_ball = None

    def place(self, x: float, y: float, heading: float) -> None:
        """Put the figure at a stance (m, m, rad), at rest and without a ball."""
        self._start = (x, y, heading)
        self.reset()

    def step(self) -> FigureFrame:
        """Return the next frame."""
        self._react_to_ball()
        if self._pending is not None and self._frames >= self._pending.due:
            self._begin_planned(self._pending)
        if self._motion is None and self._pending is None:
            self._begin_next()
        self._frames += 1
        self._shown += 1
        self._previous_q = self._q
        motion = self._motion
        if motion is None:
            return self._standing_frame()

        index = self._index
        self._q = motion.q[index]
        self._index += 1
        frame = FigureFrame(
            t=self._frames * DT,
            q=self._q,
            action=motion.action,
            phase=(index + 1) / len(motion),
            contact=motion.contact[index],
            zmp=motion.zmp[index],
            ball=self._shown_ball(),
            decision=self.decision,
            speeds=motion.speeds,
        )
        if self._index == len(motion):
            self._end_motion(motion)
        return frame

    def _standing_frame(self) -> FigureFrame:
        """Return a frame without motion."""
        return FigureFrame(
            t=self._frames * DT,
            q=self._q,
            action="stand",
            phase=1.0,
            contact=np.array([FLAT, FLAT]),
            zmp=np.full(2, np.nan),
            ball=self._shown_ball(),
            decision=self.decision,
        )

    def _shown_ball(self) -> Array:
        """Return the current ball (3,), or NaN."""
        return np.full(3, np.nan) if self.ball is None else self.ball

    def _ball_moved(self, distance: float) -> bool:
        """Return whether the ball moved by more than a distance since the latest decision."""
        ball = self.ball
        if ball is None or not np.isfinite(ball).all():
            return self._decided_ball is not None
        if self._decided_ball is None:
            return True
        return float(np.linalg.norm(ball - self._decided_ball)) > distance

    def _react_to_ball(self) -> None:
        """Decide again, or end the walk early, if the ball moved."""
        motion = self._motion
        if self._pending is not None and not self._ball_moved(SESSION.elsewhere):
            return
        if motion is None:
            if self._pending is not None:
                self._decide()
            return
        if self._shown < SESSION.replace_interval or not self._ball_moved(SESSION.moved):
            return
        last = max(self._index - 1, 0)
        if motion.action == "walk" and not motion.interruptible[last]:
            self._stop_walking(motion)
        elif motion.interruptible[last:].all():
            # The motion continues while the next one is planned.
            self._decide()

    def _begin_next(self) -> None:
        """Begin the next decision, part of a walk, or action."""
        if self._ball_moved(SESSION.moved):
            self._decide()
        elif self._stance_goal is not None:
            self._walk_on(self._stance_goal)
        elif self._next_decision is not None:
            decision = self._next_decision
            self._next_decision = None
            self._act(decision)

    def _decide(self) -> None:
        """Decide, and begin the action."""
        ball = self.ball
        is_seen = ball is not None and bool(np.isfinite(ball).all())
        self._decided_ball = ball.copy() if ball is not None and is_seen else None
        stance = self.figure.stance(self._q)
        self.decision = self.decider.decide(ball, stance, self.decision)
        self._stance_goal = None
        self._has_walked = False
        self._next_decision = None
        self._drop_plan()
        self._act(self.decision)

    def _act(self, decision: Decision) -> None:
        """Begin the action of a decision, after a return to rest if the action needs it."""
        ball = self.ball
        arm = decision.arm
        if decision.action in (REACH, BEND):
            if ball is None or arm is None:
                raise RuntimeError("a reach needs a ball and an arm")
            self._plan_reach(ball, arm, decision.action)
            return
        if not self._is_at_rest():
            self._plan_from_motion(
                lambda abilities, q: return_to_rest(abilities.figure, q, gaze_target=ball)
            )
            if decision.action != "nothing":
                self._next_decision = decision
            return
        self._motion = None
        if decision.action == "walk":
            self._stance_goal = np.array(decision.stance)
            self._walk_on(self._stance_goal)
        elif decision.action == "jump":
            if ball is None or arm is None:
                raise RuntimeError("a jump needs a ball and an arm")
            self._plan_jump(ball, arm, decision.speed or 0.0)

    def _is_at_rest(self) -> bool:
        """Return whether the figure is near home and still. The base and the neck do not count."""
        figure = self.figure
        deviation = np.abs(self._q - figure.home)
        deviation[:7] = 0.0
        for joint in figure.neck:
            deviation[figure.addresses(joint)[0]] = 0.0
        change = figure.robot.difference(self._previous_q, self._q)
        speed = float(np.abs(change).max()) / DT
        return float(deviation.max()) <= SESSION.at_ease and speed <= SESSION.still

    def _plan_reach(self, ball: Array, arm: str, kind: str) -> None:
        """Plan a reach or a bend."""

        def plan(abilities: Abilities, q: Array) -> Motion:
            figure = abilities.figure
            local = in_stance_frame(figure.stance(q), ball)
            end = abilities.natural_pose(kind, local, arm).q
            return reach_ball(figure, q, ball, arm, kind, end=end)

        self._plan_from_motion(plan)

    def _plan_jump(self, ball: Array, arm: str, speed: float) -> None:
        """Plan a jump. The figure stands meanwhile."""
        q = self._q
        self._pending = _Pending(
            self._planner.submit(lambda abilities: jump(abilities.figure, q, ball, arm, speed)),
            self._frames + SESSION.walk_lead,
        )

    def _plan_from_motion(self, plan: Callable[[Abilities, Array], Motion]) -> None:
        """Plan a motion from the frame of the present motion at which the new one begins."""
        lead = SESSION.action_lead
        q = self._q
        if self._motion is not None:
            q = self._motion.q[min(self._index + lead, len(self._motion)) - 1]
        self._pending = _Pending(
            self._planner.submit(lambda abilities: plan(abilities, q)), self._frames + lead
        )

    def _drop_plan(self) -> None:
        """Cancel the motion that is planned."""
        if self._pending is not None:
            self._pending.plan.cancel()
            self._pending = None

    def _walk_on(self, goal: Array) -> None:
        """Plan the next part of the way to a stance: a turn, a curve, or small steps."""
        figure = self.figure
        q = self._q
        stance = figure.stance(q)
        prints = prints_of(figure, q)
        offset = goal[:2] - stance[:2]
        distance = float(np.linalg.norm(offset))
        course = float(np.arctan2(offset[1], offset[0]))
        turn_in_place = np.radians(SESSION.turn_in_place_deg)
        gait = SHUFFLE
        if distance < SESSION.near:
            self._stance_goal = None
            turn = abs(wrapped(goal[2] - stance[2]))
            if distance < SESSION.at_stance and turn < SESSION.at_heading:
                if self._has_walked:
                    self._decided_ball = None
                return
            steps = shuffle_prints(figure, prints, goal)
        elif abs(wrapped(course - stance[2])) > turn_in_place:
            steps = shuffle_prints(figure, prints, np.array([stance[0], stance[1], course]))
        else:
            gait = WALK
            end = goal
            if abs(wrapped(goal[2] - course)) <= turn_in_place:
                self._stance_goal = None
            else:
                end = np.array([goal[0], goal[1], course])
            steps = walk_prints(figure, prints, end, gait)
        self._pending = _Pending(
            self._planner.submit(lambda abilities: walk(abilities.figure, q, steps, gait)),
            self._frames + SESSION.walk_lead,
        )

    def _stop_walking(self, motion: Motion) -> None:
        """Plan an end of the walk after its next steps. The figure then decides again."""
        current = self._walk
        if current is None:
            return
        self._walk = None
        self._stance_goal = None
        self._next_decision = None
        frames = len(motion)
        settling = len(current.frames.q) - int(current.strikes[-1] / DT)
        if frames - self._index < 1.2 * settling:
            return  # it ends soon
        last = self._index - 1 + SESSION.stop_lead
        self._pending = _Pending(
            self._planner.submit(lambda abilities: stop_walk(abilities.figure, current, last)),
            self._frames + SESSION.stop_lead,
            ends_walk=True,
        )

    def _begin_planned(self, pending: _Pending) -> None:
        """Begin a planned motion. Wait for it if it is not ready."""
        planned = pending.plan.result()
        self._pending = None
        if isinstance(planned, Motion):
            self._begin(planned)
            return
        motion = walk_motion(planned)
        if not pending.ends_walk:
            self._begin(motion)
            self._walk = planned
            return
        motion = remaining(motion, self._index)
        if self._motion is not None and len(motion) < len(self._motion) - self._index:
            self._begin(motion)

    def _begin(self, motion: Motion) -> None:
        self._motion = blend_into(self.figure, self._previous_q, self._q, motion)
        self._index = 0
        self._shown = 0
        self._walk = None

    def _end_motion(self, motion: Motion) -> None:
        """End a motion. After a walk the figure decides again at the new place."""
        self._motion = None
        self._walk = None
        if self._pending is not None and self._pending.ends_walk:
            self._drop_plan()
        if motion.action == "walk":
            self._has_walked = True
            if self._stance_goal is None and self._pending is None:
                self._decided_ball = None

"""A figure that runs: a ball in (``set_ball``), frames and the decision out (``step``, 60 times a second).

*Active*: it follows the ball while it moves.  *Passive*: ``start_passive`` freezes the ball and the figure
acts; the ball stays frozen until passive mode is left or ``reset`` (Pađen 2011).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.figure.abilities import Abilities
from robot_ik.figure.actions import Motion, join, rest_of, rest_slices, stop_walk, take_slices, walk_motion
from robot_ik.figure.decide import Decider, Decision, Obstacle
from robot_ik.figure.figure import DT, Figure, in_stance_frame
from robot_ik.figure.frames import SLICE, Slices
from robot_ik.figure.gait import (
    FLAT,
    SHUFFLE,
    WALK,
    Walk,
    prints_of,
    shuffle_prints,
    walk_prints,
    walk_slices,
    wrapped,
)
from robot_ik.figure.jump import jump_slices
from robot_ik.figure.poses import BEND, REACH
from robot_ik.geometry import vector
from robot_ik.ports import Array


@dataclass(frozen=True, eq=False)
class FigureFrame:
    """One frame."""

    t: float  # time since the session began, s
    q: Array  # (nq,)
    action: str  # what it does: ``stand``, ``reach``, ``bend``, ``jump``, ``walk``, ``rest``
    phase: float  # 0 to 1 within the action
    contact: NDArray[np.int64]  # (2,) of the feet: ``gait.AIR``, ``HEEL``, ``FLAT``, ``TOE``
    zmp: Array  # (2,) planned zero-moment point, or NaN
    ball: Array  # (3,) what it acts on, or NaN
    decision: Decision  # the latest
    speeds: str = "daily"  # set of joint speed limits that holds


# A ball that moved by less than this is where it was, m; a motion is not replaced more often than this,
# frames.
_MOVED, _OFTEN = 0.01, 6
# A walk or a jump is planned in the frames before it, so many slices each; a ball that goes farther
# meanwhile, m, is decided upon anew.
_SLICES, _ELSEWHERE = 2, 0.3
# A reach, a bend or a rest is planned from where the motion under way will be in so many frames.
_LEAD = 4
# The end of a walk under way is planned within so many frames; so often is each frame of a walk worked on.
_LOOKAHEAD, _PASSES = 30, 11
# Nearer than this to home, rad, and slower than this, rad/s, it need not stand up first; farther than this
# from a stand point, m, it steps there.
_AT_EASE, _STILL, _AT_STAND = 0.25, 0.1, 0.01
# Below this distance, m, and beyond this change of heading, rad, steps are small ones.
_NEAR, _TURN_IN_PLACE = 1.0, np.radians(50.0)


@dataclass(eq=False)
class _Planning:
    """A motion that is being planned."""

    slices: Slices[Motion] | Slices[Walk]
    each: int = _SLICES  # in a frame
    replaces: bool = False  # it is the end of the walk under way


_WAITING = Decision("nothing", None, "nothing has been asked yet")


class FigureSession:
    """Runs one figure; one thread uses it.

    Args:
        abilities: Of the figure.
        mode: ``active`` or ``passive``.
        stance: (x, y, heading) where it stands at first.
    """

    def __init__(
        self, abilities: Abilities, *, mode: str = "active",
        stance: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:  # fmt: skip
        self.decider = Decider(abilities)
        self.mode, self._began = mode, stance
        self._count = 0
        self.reset()

    @property
    def figure(self) -> Figure:
        """Who."""
        return self.decider.figure

    @property
    def ball(self) -> Array | None:
        """(3,) the ball that counts: in passive mode the frozen one, or none before ``start_passive``."""
        return self._ball if self.mode == "active" else self._frozen

    @property
    def busy(self) -> bool:
        """Whether something is being done or about to be."""
        planned = bool(self._waypoints) or self._after is not None or self._planning is not None
        return self._motion is not None or planned or self._asked()

    @property
    def planning(self) -> bool:
        """Whether a motion is being planned, some milliseconds a frame."""
        return self._planning is not None

    def reset(self) -> None:
        """Back to where the figure began, at rest, without a ball."""
        self._q = self._before = self.figure.placed(self.figure.home, *self._began)
        self._ball: Array | None = None
        self._frozen: Array | None = None
        self._motion: Motion | None = None
        self._index, self._since = 0, 0
        self._waypoints: list[tuple[float, float, float]] = []
        self._walk: Walk | None = None
        self._planning: _Planning | None = None
        self._after: Decision | None = None
        self._served: Array | None = None
        self.decision = _WAITING

    def set_ball(self, ball: ArrayLike | None) -> None:
        """Puts the ball somewhere, (3,) m; None takes it away.

        Raises:
            InvalidGoalError: Not three finite numbers.
        """
        self._ball = None if ball is None else vector(ball, 3, "ball")

    def set_mode(self, mode: str) -> None:
        """``active`` or ``passive``; leaving passive mode frees the ball."""
        if mode != self.mode:
            self.mode, self._frozen = mode, None

    def start_passive(self) -> None:
        """Passive mode: freezes the ball where it is, and acts."""
        self._frozen, self._served = self._ball, None

    def place(self, x: float, y: float, heading: float) -> None:
        """Puts the figure somewhere, at rest and without a ball: m, m, rad."""
        self._began = (x, y, heading)
        self.reset()

    def set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """What it may not walk through."""
        self.decider.obstacles, self._served = tuple(obstacles), None
        if self._motion is None:
            self._planning = None

    def step(self) -> FigureFrame:
        """The next frame."""
        if self._motion is not None and (self._planning is None or self._asked(_ELSEWHERE)) and self._leave():
            self._choose()
        if self._planning is not None:
            self._plan_on()
        if self._motion is None and self._planning is None:
            self._next()
        self._before = self._q
        motion, k = self._motion, self._index
        self._count += 1
        self._since += 1
        t, nan = self._count * DT, np.full(3, np.nan)
        ball = nan if self.ball is None else self.ball
        if motion is None:
            flat = np.array([FLAT, FLAT])
            return FigureFrame(t, self._q, "stand", 1.0, flat, nan[:2], ball, self.decision)
        self._q = motion.q[k]
        self._index += 1
        phase = (k + 1) / len(motion)
        frame = FigureFrame(
            t, self._q, motion.action, phase, motion.contact[k], motion.zmp[k], ball, self.decision,
            motion.speeds,
        )  # fmt: skip
        if self._index == len(motion):
            self._end()
        return frame

    def _asked(self, distance: float = _MOVED) -> bool:
        """Whether the ball is not where it was when last decided upon."""
        ball = self.ball
        if ball is None or not np.isfinite(ball).all():
            return self._served is not None
        return self._served is None or float(np.linalg.norm(ball - self._served)) > distance

    def _leave(self) -> bool:
        """Whether the motion under way is to be left now for a ball that moved."""
        motion = self._motion
        if motion is None:
            raise RuntimeError("no motion is under way")
        if self._since < _OFTEN or not self._asked():
            return False
        if motion.action == "walk" and not motion.free[self._index - 1]:
            self._stop_walking()
            return False
        return bool(motion.free[max(self._index - 1, 0) :].all())  # it goes on while the next is planned

    def _stop_walking(self) -> None:
        """The walk ends with the next steps; what to do then is decided there."""
        walked = self._walk
        if walked is None:
            return
        self._walk, self._waypoints, self._after = None, [], None
        settled = len(walked.frames.q) - int(walked.strikes[-1] / DT)  # frames after the last strike
        if len(walked.frames.q) - self._index < 1.2 * settled:
            return
        slices = stop_walk(self.figure, walked, self._index - 1 + _LOOKAHEAD)
        each = max(_SLICES, -(-_PASSES * len(walked.frames.q) // (SLICE * _LOOKAHEAD)))
        self._planning = _Planning(slices, each, replaces=True)

    def _plan_on(self) -> None:
        """Some more of what is being planned; begins it when it is done."""
        planning = self._planning
        if planning is None:
            raise RuntimeError("nothing is being planned")
        if self._motion is None and self._asked(_ELSEWHERE):
            self._choose()
            return
        for _ in range(planning.each):
            try:
                next(planning.slices)
            except StopIteration as end:
                self._planning = None
                self._planned(planning, end.value)
                return

    def _planned(self, planning: _Planning, found: Motion | Walk) -> None:
        """Begins what was planned."""
        if isinstance(found, Motion):
            self._begin(found)
            return
        motion = walk_motion(found)
        if planning.replaces:
            motion = rest_of(motion, self._index)
            if self._motion is not None and len(motion) < len(self._motion) - self._index:
                self._begin(motion)
            return
        self._begin(motion)
        self._walk = found

    def _next(self) -> None:
        """What comes when nothing is under way."""
        if self._waypoints and not self._asked():
            self._step_on()
        elif self._after is not None and not self._asked():
            decision, self._after = self._after, None
            self._act(decision)
        elif self._asked():
            self._choose()

    def _choose(self) -> None:
        """Decides, and begins what it decided."""
        ball = self.ball
        seen = ball is not None and bool(np.isfinite(ball).all())
        self._served = ball.copy() if ball is not None and seen else None
        self.decision = self.decider.decide(ball, self.figure.stance(self._q), self.decision)
        self._waypoints, self._after, self._planning = [], None, None
        self._act(self.decision)

    def _act(self, decision: Decision) -> None:
        figure, q, ball = self.figure, self._q, self.ball
        away = np.abs(q - figure.home)
        away[[*range(7), *(figure.addresses(joint)[0] for joint in figure.neck)]] = 0.0
        speed = float(np.abs(figure.robot.difference(self._before, q)).max()) / DT
        away_from_home = float(away.max()) > _AT_EASE or speed > _STILL
        if decision.action in ("walk", "jump", "nothing") and away_from_home:
            self._plan(lambda q: rest_slices(figure, q, gaze_target=ball))
            self._after = None if decision.action == "nothing" else decision
        elif decision.action == "walk":
            self._waypoints = list(decision.waypoints)
            self._step_on()
        elif decision.action == "nothing":
            self._motion = None
        else:
            if ball is None or decision.arm is None:
                raise RuntimeError("an action of an arm needs a ball and an arm")
            if decision.action in (REACH, BEND):
                arm, kind = decision.arm, decision.action
                end = self.decider.abilities.pose(kind, in_stance_frame(figure.stance(q), ball), arm).q
                self._plan(lambda q: take_slices(figure, q, ball, arm, kind, end=end))
            else:
                speed = decision.speed or 0.0
                self._planning = _Planning(jump_slices(figure, q, ball, decision.arm, speed))
                self._motion = None

    def _plan(self, slices: Callable[[Array], Slices[Motion]]) -> None:
        """Plans what follows on the motion under way, which goes on meanwhile: from where it will be then."""
        motion = self._motion
        q = self._q if motion is None else motion.q[min(self._index + _LEAD, len(motion)) - 1]
        self._planning = _Planning(slices(q))

    def _step_on(self) -> None:
        """The next walk to a waypoint: a turn on the spot, a walk along a curve, or small steps."""
        figure, q = self.figure, self._q
        here, goal = figure.stance(q), np.array(self._waypoints[0])
        offset = goal[:2] - here[:2]
        distance, course = float(np.linalg.norm(offset)), float(np.arctan2(offset[1], offset[0]))
        gait, prints = SHUFFLE, prints_of(figure, q)
        if distance < _NEAR:
            self._waypoints.pop(0)
            if distance < _AT_STAND and abs(wrapped(goal[2] - here[2])) < 0.02:
                self._end()
                return
            steps = shuffle_prints(figure, prints, goal)
        elif abs(wrapped(course - here[2])) > _TURN_IN_PLACE:
            steps = shuffle_prints(figure, prints, np.array([here[0], here[1], course]))
        else:
            gait = WALK
            aligned = abs(wrapped(goal[2] - course)) <= _TURN_IN_PLACE
            if aligned:
                self._waypoints.pop(0)
            end = goal if aligned else np.array([goal[0], goal[1], course])
            steps = walk_prints(figure, prints, end, gait)
        slices = walk_slices(figure, q, steps, gait)
        self._planning, self._motion = _Planning(slices), None

    def _begin(self, motion: Motion) -> None:
        self._motion = join(self.figure, self._before, self._q, motion)
        self._index = self._since = 0
        self._walk = None

    def _end(self) -> None:
        """A motion is over: after a walk it decides anew where it came to."""
        walked = self._motion is not None and self._motion.action == "walk"
        self._motion, self._walk, self._planning = None, None, None
        if walked and not self._waypoints:
            self._served = None

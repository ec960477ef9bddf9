"""Drag any body of a robot; any others stay pinned; both may change while it runs, without a jump.

TrueSpace and Jack let one take hold of any link of a figure, and the rest follows; in A00 the support may
change during an animation.  Here pins are needed goals: whole poses, where the frames are when pinned.
The dragged frame is a soft goal that goes as far as pins and limits allow, and what is left stays as it is.
Every step keeps the joints' speed limits: where the hand is faster, the figure comes after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robot_ik.budget import Budget
from robot_ik.errors import InvalidGoalError, UnknownFrameError
from robot_ik.geometry import Pose, vector
from robot_ik.goals import CenterOfMassGoal, Goal, PoseGoal, PositionGoal, PostureGoal
from robot_ik.inverse_kinematics import solve
from robot_ik.motion.timing import minimum_jerk
from robot_ik.motion.trajectory import require_positive
from robot_ik.ports import Array
from robot_ik.robot import Robot

# The start of a solve is one tick from its solution, so restarts are not needed.
_BUDGET = Budget(iterations=20, restarts=0)
# m. Largest distance of the target from the frame: a target out of reach does not pull harder.
_LEASH = 0.06
# Joints that leave the position of their own anchor as it is.
_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
# Halvings of a step that is too fast, before the robot rests for a tick.
_HALVINGS = 8


class Drag:
    """Drags a robot by one frame while other frames are pinned.

        drag = Drag(robot, "left_forearm", pinned=["left_foot", "right_foot"])
        q = drag.step((0.4, 0.3, 1.2))          # every tick
        drag.take("head")                       # another frame from here on
        for q in drag.shift_weight("left_foot"): ...
        drag.release("right_foot")              # stands on one leg
        drag.grab("left_shin", (0, 0.02, -0.1)) # a point of a body, as a mouse picks it
        q = drag.step((0.1, 0.2, 0.4))          # every tick

    Attributes:
        robot: The robot.
        q: Current joint angles (nq,). Read-only.
        dragged: The frame that is dragged, None without one.
        pinned: Frames that do not move.
    """

    def __init__(
        self,
        robot: Robot,
        dragged: str | None = None,
        *,
        pinned: Iterable[str] = (),
        start: ArrayLike | None = None,
        rate: float = 60.0,
        speed: float = 1.0,
        balance: bool = False,
    ) -> None:
        """Start dragging.

        Args:
            robot: The robot.
            dragged: A site or body.
            pinned: Sites or bodies.
            start: Joint angles (nq,). None for the home pose.
            rate: Steps a second.
            speed: Factor of the speed limits of the joints. It may exceed 1.
            balance: Whether the centre of mass stays above its current point.

        Raises:
            UnknownFrameError: The robot has no such frame.
            InvalidGoalError: The same frame is dragged and pinned.
            TrajectoryError: ``rate`` or ``speed`` is not above zero.
        """
        require_positive("rate", rate, "Hz")
        require_positive("speed", speed, "times the limits")
        self.robot = robot
        self.rate = float(rate)
        self._most = speed * robot.velocity_limits / rate
        self._point = np.zeros(3)
        self._mass: Array | None = None
        self._pins: dict[str, PoseGoal] = {}
        self._grip: tuple[str, Array] | None = (
            None  # a frame of the grabbed body, the offset of its point
        )
        self.dragged: str | None = None
        self.place(robot.home if start is None else start)
        for frame in pinned:
            self.pin(frame)
        if dragged is not None:
            self.take(dragged)
        self.balance(balance)

    def __repr__(self) -> str:
        return f"Drag({self.robot.name!r}, {self.dragged!r}, pinned {', '.join(self._pins) or 'nowhere'})"

    @property
    def pinned(self) -> tuple[str, ...]:
        return tuple(self._pins)

    def place(self, q: ArrayLike) -> None:
        """Set the joint angles. Pins and the dragged point are taken from the new pose."""
        self.q = np.array(self.robot.check_q(q))
        self.q.flags.writeable = False
        self._pins = {
            frame: PoseGoal.at(frame, self.robot.measure(self.q, frame)) for frame in self._pins
        }
        self._moved()

    def take(self, frame: str | None) -> None:
        """Drag another frame. None stops dragging.

        Raises:
            UnknownFrameError: The robot has no such frame.
            InvalidGoalError: The frame is pinned.
        """
        if frame is not None:
            self.robot.frame(frame)
            if frame in self._pins:
                raise InvalidGoalError(f"{frame!r} is pinned", hint=f"release({frame!r}) first")
        self.dragged, self._grip = frame, None
        self._moved()

    def grab(self, body: str, grip: ArrayLike) -> None:
        """Drag a point of a body. ``step`` brings it to a position.

        Args:
            body: Name of a body.
            grip: The point (3,) in the frame of the body, m.

        Raises:
            UnknownFrameError: The robot has no such body.
            InvalidGoalError: That part is pinned.
        """
        index = mujoco.mj_name2id(self.robot.model, mujoco.mjtObj.mjOBJ_BODY, body)
        index, point = index if index >= 0 else self.robot.frame(body).body, vector(grip, 3, "grip")
        frame, origin = frame_near(self.robot, index, point)
        self.take(frame)
        own, local = _frames_of_bodies(self.robot)[index]
        self._grip = own, local.rotation.T @ (point - origin)

    def pin(self, frame: str) -> None:
        """Keeps a frame where it is now.

        Raises:
            UnknownFrameError: With the close names.
            InvalidGoalError: It is dragged.
        """
        self.robot.frame(frame)
        if frame == self.dragged:
            raise InvalidGoalError(
                f"{frame!r} is dragged", hint="take(None) or another frame first"
            )
        self._pins[frame] = PoseGoal.at(frame, self.robot.measure(self.q, frame))
        self._moved()

    def release(self, frame: str) -> None:
        """Lets a pinned frame go.

        Raises:
            UnknownFrameError: It is not pinned.
        """
        if frame not in self._pins:
            raise UnknownFrameError(frame, list(self._pins))
        del self._pins[frame]
        self._moved()

    def balance(self, on: bool) -> None:
        """Keeps the centre of mass over the point where it is now, or no longer."""
        self._mass = self.robot.center_of_mass(self.q) if on else None
        self._moved()

    def step(self, target: ArrayLike | None = None) -> Array:
        """One tick: what is dragged towards ``target`` (3,), world, metres; None: stay.

        That is the frame, or the point that was grabbed while its body is oriented as now.

        Returns:
            (nq,) the new joint vector, no farther from the last than the speed limits allow.
        """
        wanted = self._point
        if target is not None and self.dragged is not None:
            wanted = vector(target, 3, "target")
            if self._grip is not None:
                frame, lever = self._grip
                wanted = wanted - self.robot.forward(self.q, frame).rotation @ lever
            self._point = self.robot.forward(self.q, self.dragged).position
            displacement = wanted - self._point
            share = min(1.0, _LEASH / max(float(np.linalg.norm(displacement)), 1e-12))
            wanted = self._point + share * displacement
        return np.array(self._towards(wanted, self._mass))

    def shift_weight(self, onto: str | Sequence[str], seconds: float = 1.0) -> Iterator[Array]:
        """Frames in which the centre of mass goes over the middle of some pinned frames, and stays there.

        Minimum jerk; afterwards another pin can be released without a fall.

        Args:
            onto: Pinned frames.
            seconds: How long it takes; longer where the joints' speed limits say so.

        Raises:
            UnknownFrameError: One of them is not pinned.
        """
        frames = [onto] if isinstance(onto, str) else list(onto)
        for frame in frames:
            if frame not in self._pins:
                raise UnknownFrameError(frame, list(self._pins))
        require_positive("time", seconds, "s")
        return self._shift([np.asarray(self._pins[frame].position) for frame in frames], seconds)

    def _shift(self, positions: Sequence[Array], seconds: float) -> Iterator[Array]:
        begin = self.robot.center_of_mass(self.q)
        displacement = np.append((np.mean(positions, axis=0) - begin)[:2], 0.0)
        self._mass = begin
        self._moved()
        square = float(displacement @ displacement)
        share, x, pace = 0.0, np.zeros(()), 1.0 / max(1, round(seconds * self.rate))
        while share < 1.0 - 1e-9:
            x = np.minimum(1.0, x + pace)
            before = np.array(self._mass)
            q = self._towards(self._point, begin + minimum_jerk(x) * displacement)
            share = (
                float((self._mass - begin) @ displacement / max(square, 1e-12))
                if square > 0.0
                else 1.0
            )
            yield np.array(q)
            if x >= 1.0 and not np.abs(self._mass - before).max() > 0.0:
                return  # it goes no farther: pins and limits

    # --------------------------------------------------------------------------- solving

    def _moved(self) -> None:
        """What is wanted has changed: from now on the dragged point is where its frame is."""
        if self.dragged is not None:
            self._point = self.robot.measure(self.q, self.dragged).position

    def _solved(self, point: Array, mass: Array | None) -> Array | None:
        """The pose for these; None where pins would not hold."""
        goals: list[Goal] = list(self._pins.values())
        if mass is not None:
            goals.append(CenterOfMassGoal(None, mass, axes="xy"))
        if self.dragged is not None:
            goals.append(PositionGoal(self.dragged, point, soft=True))
        goals.append(PostureGoal(self.q, soft=True, priority=1))
        found = solve(self.robot, goals, solver="lm", start=self.q, budget=_BUDGET)
        holds = found.converged or all(goal.soft for goal in goals)
        return np.array(found.q) if holds and np.isfinite(found.q).all() else None

    def _towards(self, point: Array, mass: Array | None) -> Array:
        """One tick towards a dragged point and a centre of mass, as far as the speed limits allow."""
        share = 1.0
        start = self._mass if self._mass is not None else mass
        for _ in range(_HALVINGS):
            part = self._point + share * (point - self._point)
            centre = None if mass is None or start is None else start + share * (mass - start)
            q = self._solved(part, centre)
            if q is not None and (np.abs(self.robot.difference(self.q, q)) <= self._most).all():
                self.q = q
                self.q.flags.writeable = False
                self._point, self._mass = part, centre
                return self.q
            share *= 0.5
        return self.q


def _frames_of_bodies(robot: Robot) -> dict[int, tuple[str, Pose]]:
    """Return the name of the first frame on each body, and its pose in the body."""
    frames: dict[int, tuple[str, Pose]] = {}
    for name in robot.frames:
        frame = robot.frame(name)
        frames.setdefault(frame.body, (name, frame.local))
    return frames


def frame_near(robot: Robot, body: int, grip: Array) -> tuple[str, Array]:
    """The frame with its origin fixed to a body, nearest to a point of it; where that origin is in the body.

    The origin of a link often lies on the axis that moves it, where it cannot be dragged anywhere.  Where its
    joints rotate about its origin, a child's origin is as fixed to the body, and usually at its other end.

    Raises:
        UnknownFrameError: The body has no name and no frame on it.
    """
    frames, model = _frames_of_bodies(robot), robot.model
    if body not in frames:
        robot.frame(model.body(body).name or f"body {body}")
    found = [(frames[body][0], frames[body][1].position)]
    for child in map(int, np.flatnonzero(model.body_parentid == body)):
        joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] == child]
        rotates = all(
            int(model.jnt_type[j]) in _TURNING and not model.jnt_pos[j].any() for j in joints
        )
        if rotates and child in frames and not frames[child][1].position.any():
            found.append((frames[child][0], model.body_pos[child]))
    return min(found, key=lambda one: float(np.linalg.norm(one[1] - grip)))

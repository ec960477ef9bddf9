"""``Drag``: drag a body of a robot while other bodies stay pinned.

In TrueSpace and Jack the user grabs any link of a figure, and the other links follow. In Aho (2000)
the support may change during an animation. Pins are hard goals for the whole poses that the frames
had when they were pinned. The dragged frame is a soft goal, which goes as far as pins and limits
allow. The remaining freedom keeps the posture. Frames may be pinned, released and dragged at any
time without a jump. Each step keeps the speed limits of the joints, so the figure follows a fast
hand with a delay.
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
_MAX_PULL = 0.06
# MuJoCo types of the joints that do not move their own anchor.
_ROTATIONAL = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))
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
        self._largest_step = speed * robot.velocity_limits / rate
        self._point = np.zeros(3)
        self._mass: Array | None = None
        self._pins: dict[str, PoseGoal] = {}
        # A frame of the grabbed body, and the offset of the grabbed point from it.
        self._grip: tuple[str, Array] | None = None
        self.dragged: str | None = None
        self.place(robot.home if start is None else start)
        for frame in pinned:
            self.pin(frame)
        if dragged is not None:
            self.take(dragged)
        self.balance(balance)

    def __repr__(self) -> str:
        pins = ", ".join(self._pins) or "nowhere"
        return f"Drag({self.robot.name!r}, {self.dragged!r}, pinned {pins})"

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
        self._reset_point()

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
        self.dragged = frame
        self._grip = None
        self._reset_point()

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
        index = index if index >= 0 else self.robot.frame(body).body
        point = vector(grip, 3, "grip")
        frame, origin = frame_near(self.robot, index, point)
        self.take(frame)
        body_frame, local = _frames_of_bodies(self.robot)[index]
        self._grip = (body_frame, local.rotation.T @ (point - origin))

    def pin(self, frame: str) -> None:
        """Pin a frame at its current pose.

        Raises:
            UnknownFrameError: The robot has no such frame.
            InvalidGoalError: The frame is dragged.
        """
        self.robot.frame(frame)
        if frame == self.dragged:
            raise InvalidGoalError(
                f"{frame!r} is dragged", hint="take(None) or another frame first"
            )
        self._pins[frame] = PoseGoal.at(frame, self.robot.measure(self.q, frame))
        self._reset_point()

    def release(self, frame: str) -> None:
        """Release a pinned frame.

        Raises:
            UnknownFrameError: The frame is not pinned.
        """
        if frame not in self._pins:
            raise UnknownFrameError(frame, list(self._pins))
        del self._pins[frame]
        self._reset_point()

    def balance(self, on: bool) -> None:
        """Keep the centre of mass above its current point, or stop keeping it there."""
        self._mass = self.robot.center_of_mass(self.q) if on else None
        self._reset_point()

    def step(self, target: ArrayLike | None = None) -> Array:
        """Move the dragged frame, or the grabbed point, towards a target for one tick.

        Args:
            target: Position (3,) in the world, m; None to keep the current point.

        Returns:
            (nq,) the new joint angles. No joint moves faster than its speed limit.
        """
        wanted = self._point
        if target is not None and self.dragged is not None:
            wanted = vector(target, 3, "target")
            if self._grip is not None:
                frame, lever = self._grip
                wanted = wanted - self.robot.forward(self.q, frame).rotation @ lever
            self._point = self.robot.forward(self.q, self.dragged).position
            displacement = wanted - self._point
            share = min(1.0, _MAX_PULL / max(float(np.linalg.norm(displacement)), 1e-12))
            wanted = self._point + share * displacement
        return np.array(self._towards(wanted, self._mass))

    def shift_weight(self, onto: str | Sequence[str], seconds: float = 1.0) -> Iterator[Array]:
        """Yield joint angles that bring the centre of mass above the middle of pinned frames.

        The motion has minimum jerk, and the centre of mass stays there. Another pin can then be
        released without a fall.

        Args:
            onto: Pinned frames.
            seconds: Duration. The speed limits of the joints may extend it.

        Raises:
            UnknownFrameError: A frame is not pinned.
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
        self._reset_point()
        square = float(displacement @ displacement)
        share = 0.0
        x = np.zeros(())
        pace = 1.0 / max(1, round(seconds * self.rate))
        while share < 1.0 - 1e-9:
            x = np.minimum(1.0, x + pace)
            before = np.array(self._mass)
            q = self._towards(self._point, begin + minimum_jerk(x) * displacement)
            share = 1.0
            if square > 0.0:
                share = float((self._mass - begin) @ displacement / max(square, 1e-12))
            yield np.array(q)
            if x >= 1.0 and not np.abs(self._mass - before).max() > 0.0:
                return  # pins and limits allow no further motion

    def _reset_point(self) -> None:
        """Set the dragged point to the current position of its frame."""
        if self.dragged is not None:
            self._point = self.robot.measure(self.q, self.dragged).position

    def _solve(self, point: Array, mass: Array | None) -> Array | None:
        """Return joint angles for a point and a centre of mass; None if the pins do not hold."""
        goals: list[Goal] = list(self._pins.values())
        if mass is not None:
            goals.append(CenterOfMassGoal(None, mass, axes="xy"))
        if self.dragged is not None:
            goals.append(PositionGoal(self.dragged, point, soft=True))
        goals.append(PostureGoal(self.q, soft=True, priority=1))
        solution = solve(self.robot, goals, solver="lm", start=self.q, budget=_BUDGET)
        holds = solution.converged or all(goal.soft for goal in goals)
        return np.array(solution.q) if holds and np.isfinite(solution.q).all() else None

    def _towards(self, point: Array, mass: Array | None) -> Array:
        """Move for one tick towards a point and a centre of mass, within the speed limits."""
        share = 1.0
        start = self._mass if self._mass is not None else mass
        for _ in range(_HALVINGS):
            part = self._point + share * (point - self._point)
            centre = None if mass is None or start is None else start + share * (mass - start)
            q = self._solve(part, centre)
            if (
                q is not None
                and (np.abs(self.robot.difference(self.q, q)) <= self._largest_step).all()
            ):
                self.q = q
                self.q.flags.writeable = False
                self._point = part
                self._mass = centre
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
    """Return the frame nearest to a point of a body, and the origin of that frame in the body.

    The origin of a link often lies on the axis that moves it, so it cannot be dragged. The origin
    of a child whose joints rotate about it is fixed to the body too, usually at the other end.

    Raises:
        UnknownFrameError: The body has no name and no frame.
    """
    frames = _frames_of_bodies(robot)
    model = robot.model
    if body not in frames:
        robot.frame(model.body(body).name or f"body {body}")
    candidates = [(frames[body][0], frames[body][1].position)]
    for child in map(int, np.flatnonzero(model.body_parentid == body)):
        joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] == child]
        rotates = all(
            int(model.jnt_type[j]) in _ROTATIONAL and not model.jnt_pos[j].any() for j in joints
        )
        if rotates and child in frames and not frames[child][1].position.any():
            candidates.append((frames[child][0], model.body_pos[child]))
    return min(candidates, key=lambda item: float(np.linalg.norm(item[1] - grip)))

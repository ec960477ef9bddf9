"""Goals for the whole body: where its centre of mass is, and how the joints stand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.errors import InvalidGoalError, UnknownJointError
from robot_ik.geometry import Pose
from robot_ik.goals.base import Array, Goal, Rows, axes_mask, numbers, positive_number, vector
from robot_ik.kernels.partial_rows import OF_JOINTS, OF_MASS, SOME_AXES
from robot_ik.kernels.tree import FREE, HINGE, SLIDE, V_WIDTH

if TYPE_CHECKING:
    from robot_ik.robot import Robot


@dataclass(frozen=True, eq=False, repr=False)
class CenterOfMassGoal(Goal):
    """The centre of mass at ``position`` (3,), world, metres; MuJoCo's ``subtree_com``.

    Attributes:
        frame: Name of a body: of it and all that hangs on it; None means everything in the model.
        axes: Which coordinates count; ``"xy"`` balances over a place and leaves the height free.

    Raises:
        InvalidGoalError: Not three finite numbers, a negative weight, or no such axes.
    """

    position: ArrayLike = ()
    axes: str = field(default="xyz", kw_only=True)
    weight: float = field(default=1.0, kw_only=True)

    name: ClassVar[str] = "centre-of-mass goal"
    has_position: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        axes_mask(self.axes)
        self._set(
            position=vector(self.position, 3, "position"), weight=positive_number(self.weight, "weight")
        )

    @property
    def rows(self) -> Rows:
        return Rows(place=SOME_AXES, of=OF_MASS, mask=axes_mask(self.axes))

    @property
    def target(self) -> Pose:
        return Pose(self.position)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, 0.0

    def moved_to(self, target: Pose) -> CenterOfMassGoal:
        return replace(self, position=target.position)


@dataclass(frozen=True, eq=False, repr=False)
class PostureGoal(Goal):
    """The joints as near as can be to ``q`` (nq,): a rest pose, mostly of a later priority or small weight.

    Its miss is the largest way of any joint that counts: radians for turns, metres for slides.

    Attributes:
        q: (nq,) where the joints are wanted.
        joints: How much single joints count, by name; those not named count 1, or 0 if ``only``.
        only: Leave out the joints that are not named.

    Raises:
        InvalidGoalError: No finite numbers, or a negative weight.
    """

    frame: str | None = field(default=None, init=False)
    q: ArrayLike = ()
    weight: float = field(default=1.0, kw_only=True)
    joints: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    only: bool = field(default=False, kw_only=True)

    name: ClassVar[str] = "posture goal"
    has_position: ClassVar[bool] = True
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        count = numbers(self.q, "q").size
        if not count:
            raise InvalidGoalError("a posture goal needs the joints' angles q (nq,), such as robot.home")
        if not isinstance(self.joints, Mapping):
            raise InvalidGoalError(
                f"joints must say how much each counts, not {self.joints!r}", hint='such as {"elbow": 2.0}'
            )
        checked = {joint: positive_number(w, f"weight of {joint!r}") for joint, w in self.joints.items()}
        self._set(q=vector(self.q, count, "q"), weight=positive_number(self.weight, "weight"), joints=checked)

    @property
    def rows(self) -> Rows:
        return Rows(of=OF_JOINTS)

    @property
    def weights(self) -> tuple[float, float]:
        return self.weight, self.weight

    @property
    def signature(self) -> tuple[object, ...]:
        return *super().signature, tuple(self.joints.items()), self.only

    def moved_to_q(self, q: ArrayLike) -> PostureGoal:
        """The same goal with other joint angles (nq,)."""
        return replace(self, q=q)

    def heed(self, robot: Robot) -> Array:
        """(nv,) how much each degree of freedom counts.

        Raises:
            UnknownJointError: The goal names a joint that is not active.
        """
        for joint in self.joints:
            if joint not in robot.joints:
                raise UnknownJointError(joint, robot.joints)
        heed = np.empty(robot.nv)
        for k, joint in enumerate(robot.joints):
            v = int(robot.tree.vadr[k])
            heed[v : v + V_WIDTH[int(robot.tree.kind[k])]] = self.joints.get(joint, 0.0 if self.only else 1.0)
        return heed

    def miss(self, robot: Robot, q: Array, target: Pose) -> tuple[float, float]:
        if not self.weight > 0.0:
            return 0.0, 0.0
        tree, heed, way = robot.tree, self.heed(robot), robot.difference(q, np.asarray(self.q))
        led = {int(node) for node in tree.tied[:, 0]}
        metres = radians = 0.0
        for k in range(tree.size):
            v, kind = int(tree.vadr[k]), int(tree.kind[k])
            if not heed[v] > 0.0 or k in led:
                continue
            if kind in (SLIDE, FREE):
                metres = max(metres, float(np.abs(way[v : v + (3 if kind == FREE else 1)]).max()))
            if kind != SLIDE:
                first = v + 3 if kind == FREE else v
                last = first + (1 if kind == HINGE else 3)
                radians = max(radians, float(np.linalg.norm(way[first:last])))
        return metres, radians

"""Goals of the whole body: its centre of mass, its joints, how likely its pose is; ``GOALS``: all kinds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from robot_ik.direction_goals import AimGoal, HalfSpaceGoal, LineGoal, PlaneGoal
from robot_ik.errors import InvalidGoalError, ModelError, require_joints
from robot_ik.geometry import Array, Pose, numbers, vector
from robot_ik.goals import (
    Goal,
    OrientationGoal,
    PointGoal,
    PoseGoal,
    PositionGoal,
    Rows,
    WeightedGoal,
    nonnegative_number,
)
from robot_ik.kernels import residuals as codes
from robot_ik.kernels.tree import FREE, SLIDE, V_WIDTH
from robot_ik.pose_prior import PosePrior
from robot_ik.robot import Robot

# kg; a robot of less was described without masses.
_LEAST_MASS = 1e-6


def mass_table(robot: Robot, name: str | None = None) -> Array:
    """(n + 1, 4) mass and its centre, seen from the node, of what each node carries; last: what never moves.

    Only the body ``name`` (None: the whole model) and all that hangs on it count.

    Raises:
        UnknownFrameError, ModelError: There is no such body; it has no mass.
    """
    model, root = robot.model, robot.body_id(name)
    table, inside = np.zeros((robot.tree.size + 1, 4)), set()
    for body in range(root, model.nbody):
        if body == root or int(model.body_parentid[body]) in inside:
            inside.add(body)
            node, local = robot.attachment(body)  # node -1, the world, is the last row
            moment = (1.0, *(local[:3] + local[3:].reshape(3, 3) @ model.body_ipos[body]))
            table[node] += float(model.body_mass[body]) * np.array(moment)
    if not table[:, 0].sum() > _LEAST_MASS:
        raise ModelError(f"{name or robot.name!r} has no mass", hint="geoms or inertials give it some")
    carried = table[:, 0] > 0.0
    table[carried, 1:] /= table[carried, :1]
    return table


class CenterOfMassGoal(PointGoal):
    """The centre of mass at ``position`` (3,), world, metres; MuJoCo's ``subtree_com``.

    Attributes:
        frame: Name of a body: of it and all that hangs on it; None means everything in the model.
        axes: Which coordinates count; ``"xy"`` balances over a point and leaves the height free.
    """

    name: ClassVar[str] = "centre-of-mass goal"

    def _rows_of(self, mask: tuple[float, float, float]) -> Rows:
        return Rows(position=codes.SOME_AXES, of=codes.OF_MASS, mask=mask)

    def miss(self, robot: Robot, q: Array, target: Pose) -> tuple[float, float]:
        return self.off(Pose(robot.center_of_mass(q, self.frame)), target)

    def moved_nodes(self, robot: Robot) -> set[int]:
        carried = np.flatnonzero(mass_table(robot, self.frame)[:-1, 0] > 0.0)
        return {k for node in carried for k in robot.tree.ancestors(int(node))}

    def fill(self, arrays: dict[str, Any], g: int, robot: Robot) -> int:
        arrays["row_codes"][g, codes.BLOCK] = len(arrays["masses"])
        arrays["masses"] = np.concatenate([arrays["masses"], mass_table(robot, self.frame)])
        return 0


@dataclass(frozen=True, eq=False, repr=False)
class PostureGoal(WeightedGoal):
    """The joints as near as can be to ``q`` (nq,): a rest pose, mostly of a later priority or small weight.

    Its miss is the largest distance of any joint that counts: radians for hinges, metres for slides.

    Attributes:
        q: (nq,) where the joints are wanted.
        joints: How much single joints count, by name; those not named count 1, or 0 if ``only``.
        only: Leave out the joints that are not named.
    """

    frame: str | None = field(default=None, init=False)
    q: ArrayLike = ()
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
        checked = {joint: nonnegative_number(w, f"weight of {joint!r}") for joint, w in self.joints.items()}
        self._set(q=vector(self.q, count, "q"), joints=checked, rows=Rows(of=codes.OF_JOINTS))

    @property
    def signature(self) -> tuple[object, ...]:
        return *super().signature, tuple(self.joints.items()), self.only

    def joint_weights(self, robot: Robot) -> Array:
        """(nv,) how much each degree of freedom counts; raises ``UnknownJointError`` for other joints."""
        require_joints(self.joints, robot.joints)
        each = [self.joints.get(joint, 0.0 if self.only else 1.0) for joint in robot.joints]
        return np.array(each, dtype=float)[robot.tree.dof_node]

    def miss(self, robot: Robot, q: Array, target: Pose) -> tuple[float, float]:
        if not self.weight > 0.0:
            return 0.0, 0.0
        tree, joint_weights = robot.tree, self.joint_weights(robot)
        difference = robot.difference(q, np.asarray(self.q))
        metres = radians = 0.0
        for k in set(range(tree.size)) - set(tree.coupled[:, 0].tolist()):
            v, kind = int(tree.vadr[k]), int(tree.kind[k])
            if not joint_weights[v] > 0.0:
                continue
            part = difference[v : v + V_WIDTH[kind]]
            shift = {SLIDE: 1, FREE: 3}.get(kind, 0)  # how many of them are metres
            metres = max(metres, float(np.abs(part[:shift]).max(initial=0.0)))
            radians = max(radians, float(np.linalg.norm(part[shift:])))
        return metres, radians

    def moved_nodes(self, robot: Robot) -> set[int]:
        return set(robot.tree.dof_node[self.joint_weights(robot) > 0.0].tolist())

    def fill(self, arrays: dict[str, Any], g: int, robot: Robot) -> int:
        if np.shape(self.q) != (robot.nq,):
            wrong = f"a posture of {robot.name} has {robot.nq} numbers, not {np.size(self.q)}"
            raise InvalidGoalError(wrong, hint="start from robot.home and change what matters")
        arrays["posture"][g] = self.q
        arrays["joint_weight"][g] = self.joint_weights(robot)
        return len(arrays["dofs"])


@dataclass(frozen=True, eq=False, repr=False)
class PosePriorGoal(WeightedGoal):
    """A pose as likely as can be under a ``PosePrior``: that looks natural.  Always soft; one a problem.

    It is wanted, never needed: among the poses that meet all needed goals, the likeliest nearby.

    Attributes:
        prior: ``PosePrior.of(robot)``, or one that you learned.
        weight: On the rows, whose half square is the energy over its least: it counts squared.
    """

    frame: str | None = field(default=None, init=False)
    prior: PosePrior = None  # type: ignore[assignment]  # refused below
    soft: bool = field(default=True, kw_only=True)

    name: ClassVar[str] = "pose prior goal"
    has_angle: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        prior: object = self.prior
        if not isinstance(prior, PosePrior):
            wrong = f"a pose prior goal needs a PosePrior, not {self.prior!r}"
            raise InvalidGoalError(wrong, hint="PosePrior.of(robot)")
        if not self.soft:
            raise InvalidGoalError("a likely pose is wanted, never needed", hint="leave soft=True")
        self._set(rows=Rows(of=codes.OF_PRIOR))

    @property
    def signature(self) -> tuple[object, ...]:
        return *super().signature, self.prior

    def miss(self, robot: Robot, q: Array, target: Pose) -> tuple[float, float]:
        return 0.0, 0.0

    def moved_nodes(self, robot: Robot) -> set[int]:
        return set(self.prior.indices(robot)[:, 2].tolist())

    def fill(self, arrays: dict[str, Any], g: int, robot: Robot) -> int:
        if len(arrays["feature"]):
            wrong = "a problem has one pose prior at most"
            raise InvalidGoalError(wrong, hint="learn one from all the motions")
        arrays["feature"], arrays["prior"] = self.prior.indices(robot), self.prior.table()
        return len(arrays["feature"]) + 1


GOALS: tuple[type[Goal], ...] = (
    PositionGoal, OrientationGoal, PoseGoal, AimGoal, LineGoal, PlaneGoal, HalfSpaceGoal, CenterOfMassGoal,
    PostureGoal, PosePriorGoal,
)  # fmt: skip

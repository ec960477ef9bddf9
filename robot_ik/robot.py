"""``Robot``: an immutable description of what moves, read from MJCF, URDF or the catalogue.

``q`` is MuJoCo's ``qpos`` of the active joints in declared order, shape (nq,); ``dq`` its tangent,
shape (nv,).  Poses are in the world; ``jacobian`` is linear over angular velocity, world axes, at the
frame's origin.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.catalogue import RobotFile, find_robot
from robot_ik.errors import ModelError, UnknownFrameError, UnsupportedJointError
from robot_ik.geometry import Pose
from robot_ik.kernels import kinematics
from robot_ik.kernels.tree import FREE, HINGE, Q_WIDTH, SLIDE, Tree
from robot_ik.model_file import (
    Frame,
    active_joints,
    guess_tool,
    home_qpos,
    model_frames,
    motion_limits,
    read_model,
)
from robot_ik.model_tree import Attachment, build_tree, pose_row, qpos_addresses, row_pose

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Robot:
    """What a robot is.  Made by ``load_robot``; never changes.

    Attributes:
        name: Catalogue name, or the file's stem.
        path: The model file.
        model: MuJoCo's model; treat as read-only.
        joints: Names of the active joints, in declared order.
        lower, upper: (nv,) limits, rad or m; ±inf where unlimited; a ball joint has its cone angle.
        velocity, acceleration: (nv,) limits of motion, rad/s and rad/s² (m for slides).
        home: (nq,) where the robot rests.
        tool: Name of the default frame.
        tree: The same kinematics compiled.
        file: What ``robot.toml`` says beyond the model.
    """

    name: str
    path: Path
    model: mujoco.MjModel
    tree: Tree
    joints: tuple[str, ...]
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    home: Array
    tool: str
    frozen_qpos: Array
    file: RobotFile
    _frames: dict[str, Frame] = field(repr=False)
    _bodies: tuple[Attachment, ...] = field(repr=False)

    @property
    def nq(self) -> int:
        """Numbers in ``q``."""
        return self.tree.nq

    @property
    def nv(self) -> int:
        """Degrees of freedom: numbers in ``dq``."""
        return self.tree.nv

    @property
    def folder(self) -> Path:
        """Folder of the model file."""
        return self.path.parent

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames: tools first, then sites and bodies."""
        return tuple(self._frames)

    @property
    def arm_file(self) -> Path | None:
        """``arm.toml`` beside the model (servo ids, signs, zeros), if there is one."""
        file = self.folder / "arm.toml"
        return file if file.is_file() else None

    def frame(self, name: str | None = None) -> Frame:
        """The frame of that name (default: the tool).

        Raises:
            UnknownFrameError: With the close names.
        """
        try:
            return self._frames[self.tool if name is None else name]
        except KeyError:
            raise UnknownFrameError(str(name), self._frames) from None

    def check_q(self, q: ArrayLike, what: str = "q") -> Array:
        """``q`` as a float array (nq,).

        Raises:
            ModelError: Wrong length, or a number that is not finite.
        """
        array = np.asarray(q, dtype=float)
        if array.shape != (self.nq,):
            raise ModelError(
                f"{what} must have shape ({self.nq},), not {array.shape}",
                hint=f"{self.name} has these active joints: {', '.join(self.joints)}",
            )
        # The product is finite whenever all numbers are (and of a sane size), and costs a third of isfinite.
        if not math.isfinite(array.dot(array)) and not np.isfinite(array).all():
            raise ModelError(f"{what} must be finite, not {array.tolist()}")
        return array

    def attachment(self, frame: str | None = None) -> tuple[int, Array]:
        """Node that carries a frame (-1: the world) and the frame seen from it as a pose row (12,)."""
        at = self.frame(frame)
        body = self._bodies[at.body]
        return body.node, pose_row(body.local.compose(at.local))

    def forward(self, q: ArrayLike, frame: str | None = None) -> Pose:
        """Pose of a frame (default: the tool) in the world at ``q`` (nq,).

        Raises:
            UnknownFrameError, ModelError: Unknown frame; q of the wrong shape or not finite.
        """
        node, local = self.attachment(frame)
        nodes, world, scratch = self._work(node)
        out = np.empty((1, 12))
        kinematics.tree_frame(
            self.tree.handle, nodes, node, local[None, :], self.check_q(q), world, scratch, out
        )
        return row_pose(out[0])

    def jacobian(self, q: ArrayLike, frame: str | None = None) -> Array:
        """(6, nv): linear over angular velocity of a frame's origin per unit of dq, world axes."""
        node, local = self.attachment(frame)
        nodes, world, scratch = self._work(node)
        out, jacobian = np.empty((1, 12)), np.empty((6, self.nv))
        kinematics.tree_jacobian(
            self.tree.handle, nodes, node, local[None, :], self.check_q(q), world, scratch, out, jacobian
        )
        return jacobian

    def measure(self, q: ArrayLike, frame: str | None = None) -> Pose:
        """Pose of a frame by MuJoCo's own forward pass: the independent judge of every solution."""
        at = self.frame(frame)
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.qpos(q)
        mujoco.mj_kinematics(self.model, data)
        return Pose(data.xpos[at.body], data.xquat[at.body]).compose(at.local)

    def qpos(self, q: ArrayLike) -> Array:
        """(model.nq,): ``q`` at its places, the frozen joints where they stand."""
        qpos = self.frozen_qpos.copy()
        qpos[self._addresses] = self.check_q(q)
        return qpos

    def integrate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """q ⊕ dq (nq,): sums for hinges and slides, rotations for balls (``mj_integratePos``)."""
        moved = self.check_q(q).copy()
        step = np.asarray(dq, dtype=float).reshape(self.nv)
        kinematics.tree_integrate(self.tree.handle, np.arange(self.tree.size), moved, step)
        return moved

    def clip(self, q: ArrayLike) -> Array:
        """The nearest q (nq,) inside the limits, joint by joint."""
        inside = self.check_q(q).copy()
        kinematics.tree_clip(self.tree.handle, np.arange(self.tree.size), inside)
        return inside

    def outside(self, q: ArrayLike, slack: float = 1e-9) -> list[str]:
        """Names of joints beyond their limits by more than ``slack`` (rad or m)."""
        q = self.check_q(q)
        gone = np.abs(self.clip(q) - q)
        tree, names = self.tree, []
        for k, joint in enumerate(self.joints):
            width = Q_WIDTH[int(tree.kind[k])]
            if gone[tree.qadr[k] : tree.qadr[k] + width].max() > slack:
                names.append(joint)
        return names

    def sample(self, rng: np.random.Generator) -> Array:
        """A random q (nq,) inside the limits; unlimited hinges within ±pi, unlimited slides within ±1 m."""
        tree, q = self.tree, self.home.copy()
        for k in range(tree.size):
            a, v = int(tree.qadr[k]), int(tree.vadr[k])
            if tree.kind[k] in (HINGE, SLIDE):
                q[a] = rng.uniform(tree.low[v], tree.high[v])
                continue
            if tree.kind[k] == FREE:
                q[a : a + 3] = self.home[a : a + 3] + rng.uniform(-1.0, 1.0, 3)
                a, v = a + 3, v + 3
            axis = rng.normal(size=3)
            half = 0.5 * rng.uniform(0.0, min(float(tree.high[v]), np.pi))
            q[a] = np.cos(half)
            q[a + 1 : a + 4] = axis / np.linalg.norm(axis) * np.sin(half)
        return q

    def with_limits(self, lower: ArrayLike, upper: ArrayLike) -> Robot:
        """The same robot inside the intersection of its limits and these (nv,); home moves inside.

        Raises:
            ModelError: No room is left for some joint.
        """
        low = np.maximum(self.lower, np.asarray(lower, dtype=float))
        high = np.minimum(self.upper, np.asarray(upper, dtype=float))
        for v in range(self.nv):
            if low[v] > high[v]:
                joint = self.joints[int(np.searchsorted(self.tree.vadr, v, side="right")) - 1]
                raise ModelError(
                    f"no room is left for joint {joint!r}: "
                    f"the model allows {self.lower[v]:.4f} … {self.upper[v]:.4f}, "
                    f"the other side {np.asarray(lower)[v]:.4f} … {np.asarray(upper)[v]:.4f}",
                    hint="check sign, zero and range of the joint in the arm file",
                )
        narrowed = dataclasses.replace(self, tree=self.tree.with_limits(low, high), lower=low, upper=high)
        return dataclasses.replace(narrowed, home=narrowed.clip(self.home))

    def reach(self, frame: str | None = None) -> tuple[Array, float] | None:
        """A ball that the frame's origin can never leave: centre (3,) and radius in metres, or None.

        The centre is where the first joint stands; the radius adds up all offsets after it, slides at
        their longest.  None where the base floats or a slide is unlimited.
        """
        node, local = self.attachment(frame)
        return self.tree.reach(node, local)

    def _work(self, node: int) -> tuple[NDArray[np.int64], Array, Array]:
        nodes = np.array(self.tree.ancestors(node), dtype=np.int64)
        return nodes, np.empty((self.tree.size, 12)), np.empty((2, 12))

    @cached_property
    def _addresses(self) -> NDArray[np.int64]:
        return qpos_addresses(self.model, self.tree)


def load_robot(
    name: str | Path, *, joints: Sequence[str] | str | None = None, tool: str | None = None
) -> Robot:
    """Loads a robot by catalogue name, or any MJCF or MuJoCo-readable URDF by path.

    Args:
        name: ``"puma560"``, or the path of a model file or of a folder with a ``robot.toml``.
        joints: Names of the joints that may move, or the name of a joint group; the rest are frozen at
            home.  Default: the group ``arm`` of ``robot.toml`` if it has one, else all joints.
        tool: Name of the default frame.

    Raises:
        UnknownRobotError: No such name and no such file; lists the close ones.
        ModelError: The file cannot be read; carries MuJoCo's reason.
        UnknownJointError, UnknownFrameError: With the close names.
    """
    path, file = find_robot(name)
    return make_robot(read_model(path), path, file, joints, tool)


def make_robot(
    model: mujoco.MjModel,
    path: Path,
    file: RobotFile,
    joints: Sequence[str] | str | None,
    tool: str | None,
) -> Robot:
    """A robot of MuJoCo's model and of what ``robot.toml`` says; the rest as in ``load_robot``."""
    names = [model.joint(j).name or f"joint_{j}" for j in range(model.njnt)]
    active = active_joints(names, joints, file)
    rest = home_qpos(model, path, file)
    tree, bodies = build_tree(model, active, rest)
    if tree.nv == 0:
        raise UnsupportedJointError(f"{path} has no joint that may move", path=path)
    frames = model_frames(model, file)
    default_tool = tool or file.tool or guess_tool(model, frames)
    if default_tool not in frames:
        raise UnknownFrameError(default_tool, frames)
    robot = Robot(
        name=file.name,
        path=path,
        model=model,
        tree=tree,
        joints=tuple(names[j] for j in tree.joint_ids),
        lower=tree.lower.copy(),
        upper=tree.upper.copy(),
        velocity=np.empty(0),
        acceleration=np.empty(0),
        home=np.empty(0),
        tool=default_tool,
        frozen_qpos=rest,
        file=file,
        _frames=frames,
        _bodies=bodies,
    )
    speed, acceleration = motion_limits(robot.tree, robot.joints, file)
    home = robot.clip(rest[robot._addresses])
    return dataclasses.replace(robot, velocity=speed, acceleration=acceleration, home=home)

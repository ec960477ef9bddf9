"""``Robot``, an immutable description of what moves, and ``load_robot``, which reads MJCF and URDF.

``q`` is MuJoCo's ``qpos`` of the active joints in declared order, shape (nq,). ``dq`` is its
tangent, shape (nv,). Poses are in the world. A Jacobian is linear over angular velocity, in world
axes, at the origin of the frame.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import os
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik import model as mjcf
from robot_ik.chain_model import chain_model
from robot_ik.couplings import Coupling, declared_couplings, narrowed, with_couplings
from robot_ik.errors import (
    ModelError,
    UnknownFrameError,
    UnsupportedJointError,
    distinct_texts,
    require_joints,
)
from robot_ik.geometry import Array, Pose, is_real, vector
from robot_ik.kernels import kinematics
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE, Tree
from robot_ik.robot_file import CHAIN, RobotFile, chain_links, find_robot

LIMIT_SLACK = 1e-9
"""rad or m. A joint counts as outside its limits only beyond this."""

NAMES_SHOWN = 8
"""Joint names in the ``repr`` of a robot."""

_KINDS = {FREE: "free", BALL: "ball", SLIDE: "slide", HINGE: "hinge"}
"""Name of each kind of joint."""

LARGEST_STIFFNESS = 1e6
"""Ratio to a joint of stiffness 1. A joint that is stiffer hardly moves at all."""

_ARRAYS = (
    "velocity_limits",
    "acceleration_limits",
    "stiffness",
    "home",
    "frozen_qpos",
)


@dataclass(frozen=True, eq=False, repr=False)
class Robot:
    """A robot as ``load_robot`` returns it. It never changes, and its arrays are read-only.

    Attributes:
        name: Catalogue name, or the stem of the file name.
        path: The model file.
        model: MuJoCo's model. Treat it as read-only.
        tree: The compiled kinematics.
        joints: Names of the active joints, in declared order.
        velocity_limits: Speed limits (nv,), rad/s or m/s.
        acceleration_limits: Acceleration limits (nv,), rad/s² or m/s².
        stiffness: Cost (nv,) of moving a joint compared with the others.
        home: Rest configuration (nq,).
        tool: Name of the default frame.
        frozen_qpos: Values (model.nq,) of the joints that do not move.
        file: Content of ``robot.toml``.
        couplings: Joints of the model that follow another joint.
        source: What the model was read from: a file, or the text of an MJCF or URDF. None for a
            robot that was loaded from an ``MjModel``.
        missing_meshes: Mesh files of a URDF that are missing, or are neither STL nor OBJ, by their
            names in the URDF.
    """

    name: str
    path: Path
    model: mujoco.MjModel
    tree: Tree
    joints: tuple[str, ...]
    velocity_limits: Array
    acceleration_limits: Array
    stiffness: Array
    home: Array
    tool: str
    frozen_qpos: Array
    file: RobotFile
    couplings: tuple[Coupling, ...]
    source: Path | str | None
    missing_meshes: tuple[str, ...]
    _frames: dict[str, mjcf.ModelFrame] = field(repr=False)
    _bodies: tuple[mjcf.Attachment, ...] = field(repr=False)

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            array = np.array(getattr(self, name), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_thread_data"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()  # unpickled arrays are writable

    def __repr__(self) -> str:
        names = ", ".join(self.joints[:NAMES_SHOWN])
        if len(self.joints) > NAMES_SHOWN:
            names += f", … {len(self.joints) - NAMES_SHOWN} more"
        return (
            f"Robot({self.name!r}, {len(self.joints)} joints: {names}; tool {self.tool!r}, "
            f"{len(self._frames)} frames; {self.path.name})"
        )

    @property
    def joint_kinds(self) -> tuple[str, ...]:
        """Kind of each active joint, which is hinge, slide, ball or free."""
        return tuple(_KINDS[int(kind)] for kind in self.tree.kind)

    @property
    def lower(self) -> Array:
        """Lower limits (nv,), rad or m; -inf where unlimited."""
        return self.tree.lower

    @property
    def upper(self) -> Array:
        """Upper limits (nv,), rad or m; inf where unlimited; the cone angle of a ball joint."""
        return self.tree.upper

    @property
    def nq(self) -> int:
        """Size of ``q``."""
        return self.tree.nq

    @property
    def nv(self) -> int:
        """Number of degrees of freedom, the size of ``dq``."""
        return self.tree.nv

    @property
    def folder(self) -> Path:
        """Folder of the model file."""
        return self.path.parent

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, first tools, then sites, then bodies."""
        return tuple(self._frames)

    @property
    def arm_file(self) -> Path | None:
        """``arm.toml`` beside the model (ids, signs and zeros of the servos), None without one."""
        file = self.folder / "arm.toml"
        return file if file.is_file() else None

    def frame(self, name: str | None = None) -> mjcf.ModelFrame:
        """Return a frame by name, or the default frame.

        Raises:
            UnknownFrameError: The robot has no such frame. The message has close names.
        """
        try:
            return self._frames[self.tool if name is None else name]
        except (KeyError, TypeError):  # TypeError: the name is a list or an array
            raise UnknownFrameError(str(name), self._frames) from None

    def check_q(self, q: ArrayLike, what: str = "q") -> Array:
        """Return ``q`` as a new read-only array (nq,).

        Args:
            q: Joint angles (nq,).
            what: Name of the vector, for the message.

        Raises:
            ModelError: Another length, or a number that is not finite.
        """
        hint = f"{self.name} has these active joints: {', '.join(self.joints)}"
        # Joint angles may have any size: they are clipped to their limits before they are squared.
        return vector(q, self.nq, what, ModelError, hint, sys.float_info.max)

    def attachment(self, frame: str | int | None = None) -> tuple[int, Array]:
        """Return where a frame is attached.

        Args:
            frame: Name of a frame, None for the default frame, or the id of a body.

        Returns:
            The node that carries the frame (-1: the world), and the frame seen from it (12,).
        """
        if isinstance(frame, int):
            body = self._bodies[frame]
            return body.node, body.local.row
        named_frame = self.frame(frame)
        body = self._bodies[named_frame.body]
        return body.node, body.local.compose(named_frame.local).row

    def forward(self, q: ArrayLike, frame: str | None = None) -> Pose:
        """Return the world pose of a frame (default: the tool) at ``q`` (nq,).

        Raises:
            ModelError: As ``check_q``.
            UnknownFrameError: As ``frame``.
        """
        row = np.empty((1, 12))
        kinematics.tree_frame(*self._kernel_arguments(q, frame, row))
        return Pose.from_row(row[0])

    def forward_rows(self, q: Array, frame: str | None, positions: Array, wxyz: Array) -> None:
        """Write the world poses of a frame (default: the tool) at ``q`` to two arrays.

        It may be called from several threads. See ``forward_batch``, which checks ``q``.

        Args:
            q: (n, nq) joint positions, contiguous, rad or m.
            frame: Frame.
            positions: (n, 3) written, m.
            wxyz: (n, 4) written, unit quaternions with w >= 0.

        Raises:
            UnknownFrameError: As ``frame``.
        """
        row = np.empty((1, 12))
        arguments = self._kernel_arguments(self.home, frame, row)
        address, nodes, node, local, _, world, scratch, _ = arguments
        kinematics.tree_poses(address, nodes, node, local, q, world, scratch, row, positions, wxyz)

    def jacobian(self, q: ArrayLike, frame: str | None = None) -> Array:
        """Return the Jacobian (6, nv) of a frame: linear over angular velocity per unit of dq."""
        row = np.empty((1, 12))
        jacobian = np.empty((6, self.nv))
        kinematics.tree_jacobian(*self._kernel_arguments(q, frame, row, jacobian))
        return jacobian

    def measure(self, q: ArrayLike, frame: str | None = None) -> Pose:
        """Return the world pose of a frame by MuJoCo's forward kinematics.

        It does not use the compiled kinematics, so it is an independent check of a solution.
        """
        named_frame = self.frame(frame)
        data = self.data_at(q)
        return Pose(data.xpos[named_frame.body], data.xquat[named_frame.body]).compose(
            named_frame.local
        )

    def center_of_mass(self, q: ArrayLike, body: str | None = None) -> Array:
        """Return the centre of mass (3,) of a body and its subtree (None: the model), by MuJoCo."""
        data = self.data_at(q)
        mujoco.mj_comPos(self.model, data)
        return np.array(data.subtree_com[self.body_id(body)])

    def difference(self, start: ArrayLike, end: ArrayLike) -> Array:
        """Return dq (nv,) with ``integrate(start, dq) == end``, by ``mj_differentiatePos``."""
        dq = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, dq, 1.0, self.qpos(start), self.qpos(end))
        return np.asarray(dq[np.isin(self.model.dof_jntid, self.tree.joint_ids)])

    def data_at(self, q: ArrayLike) -> mujoco.MjData:
        """Return MuJoCo's data with the bodies at ``q``, valid until this thread's next call."""
        data = getattr(self._thread_data, "data", None)
        if data is None:
            data = mujoco.MjData(self.model)
            self._thread_data.data = data
        data.qpos[:] = self.qpos(q)
        mujoco.mj_kinematics(self.model, data)
        return data

    def body_id(self, name: str | None) -> int:
        """Return MuJoCo's id of a body; 0, the world, for None.

        Raises:
            UnknownFrameError: The model has no such body.
        """
        names = {self.model.body(b).name: b for b in range(self.model.nbody)}
        try:
            return 0 if name is None else names[name]
        except (KeyError, TypeError):  # TypeError: the name is a list or an array
            raise UnknownFrameError(str(name), filter(None, names)) from None

    def qpos(self, q: ArrayLike) -> Array:
        """Return MuJoCo's qpos (model.nq,) with the active joints at ``q``."""
        qpos = self.frozen_qpos.copy()
        qpos[self._addresses] = self.check_q(q)
        return qpos

    def integrate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """Return q ⊕ dq (nq,), as ``mj_integratePos``.

        Hinges and slides are added. Balls are rotated.

        Raises:
            ModelError: ``q`` is not nq finite numbers, or ``dq`` is not nv finite numbers.
        """
        result = self.check_q(q).copy()
        # A contiguous copy: numba would compile the kernel again for another memory layout.
        step = vector(dq, self.nv, "dq", ModelError, largest=sys.float_info.max).copy()
        nodes = np.arange(self.tree.size)
        kinematics.tree_integrate(self.tree.block.address, nodes, result, step)
        return result

    def clip(self, q: ArrayLike) -> Array:
        """Return the nearest ``q`` (nq,) inside the limits, joint by joint."""
        result = self.check_q(q).copy()
        if self.nq == self.nv:  # hinges and slides need no kernel, so loading compiles nothing
            return np.asarray(np.clip(result, self.tree.lower, self.tree.upper))
        kinematics.tree_clip(self.tree.block.address, np.arange(self.tree.size), result)
        return result

    def apply_couplings(self, q: ArrayLike) -> Array:
        """Return ``q`` (nq,) with each coupled joint at the value that its leader determines."""
        result = self.check_q(q).copy()
        if len(self.tree.coupled):
            kinematics.tree_follow(self.tree.block.address, result)
        return result

    def outside(self, q: ArrayLike, slack: float = LIMIT_SLACK) -> list[str]:
        """Return the names of joints beyond their limits by more than ``slack``, rad or m."""
        q = self.check_q(q)
        vector([slack], 1, "slack", ModelError)
        excess = np.abs(self.clip(q) - q)
        if not excess.max(initial=0.0) > slack:
            return []
        excess_of_joints = np.maximum.reduceat(excess, self.tree.qadr)
        pairs = zip(self.joints, excess_of_joints, strict=True)
        return [joint for joint, size in pairs if size > slack]

    def sample(self, rng: np.random.Generator) -> Array:
        """Return a random ``q`` (nq,) inside the limits.

        Unlimited hinges are within ±pi, unlimited slides within ±1 m.
        """
        given: object = rng
        if not isinstance(given, np.random.Generator):
            hint = "np.random.default_rng(1)"
            raise ModelError(f"{given!r} is not a random generator", hint=hint)
        return self.apply_couplings(mjcf.random_q(self.tree, self.home, rng))

    def with_limits(self, lower: ArrayLike, upper: ArrayLike) -> Robot:
        """Return this robot with the intersection of its limits and the given limits (nv,).

        The home pose is clipped to the new limits.

        Raises:
            ModelError: A joint has no range left, or there is not one number for each degree of
                freedom.
        """
        given_lower, given_upper = self._check_limits(lower, upper)
        new_lower = np.maximum(self.lower, given_lower)
        new_upper = np.minimum(self.upper, given_upper)
        empty = np.flatnonzero(new_lower > new_upper)
        if len(empty):
            v = int(empty[0])
            values = (self.lower[v], self.upper[v], given_lower[v], given_upper[v])
            texts = distinct_texts(*values, digits=4)
            raise ModelError(
                f"no range is left for joint {self.joints[self.tree.dof_node[v]]!r}: "
                f"the model allows {texts[0]} … {texts[1]}, the limits {texts[2]} … {texts[3]}",
                hint="check sign, zero and range of the joint in the arm file",
            )
        tree = self.tree.with_limits(new_lower, new_upper)
        if len(tree.coupled):
            tree = narrowed(tree, self.joints)
        return dataclasses.replace(self, tree=tree)._with_home_inside()

    def with_fixed(self, values: Mapping[str, float]) -> Robot:
        """Return this robot with some of its joints frozen. They leave ``q``.

        Args:
            values: Joint name -> position, rad or m, inside its limits.

        Raises:
            UnknownJointError: There is no such active joint. The message has close names.
            UnsupportedJointError: The joint is a ball or free, or no other joint is left.
            ModelError: A value is not a number inside the limits of its joint.
        """
        require_joints(values, self.joints)
        home = self.home.copy()
        kept = np.ones(self.tree.size, dtype=bool)
        for joint, value in values.items():
            node = self.joints.index(joint)
            if self.tree.kind[node] not in (HINGE, SLIDE):
                raise UnsupportedJointError(
                    f"joint {joint!r} is a ball or free joint, which has no single value",
                    path=self.path,
                    hint="fix hinges and slides only",
                )
            v = self.tree.vadr[node]
            if not is_real(value, self.lower[v] - LIMIT_SLACK, self.upper[v] + LIMIT_SLACK):
                raise ModelError(
                    f"joint {joint!r} cannot be fixed at {value!r}",
                    hint=f"give a number from {self.lower[v]:.6g} to {self.upper[v]:.6g}",
                )
            home[self.tree.qadr[node]] = value
            kept[node] = False
        if not kept.any():
            raise UnsupportedJointError(
                f"all {len(values)} joints would be fixed",
                path=self.path,
                hint="leave at least one joint out of the mapping",
            )
        return self._with_frozen(kept, home)

    def with_joints(self, joints: Sequence[str]) -> Robot:
        """Return this robot with only some of its joints active. The others stay at home.

        Args:
            joints: Names of active joints, in any order.

        Raises:
            UnknownJointError: There is no such active joint. The message has close names.
            UnsupportedJointError: No joint is named.
        """
        require_joints(joints, self.joints)
        kept = np.array([joint in set(joints) for joint in self.joints])
        if not kept.any():
            hint = f"name some of {', '.join(self.joints)}"
            raise UnsupportedJointError("no joint would be left", path=self.path, hint=hint)
        return self if kept.all() else self._with_frozen(kept, self.home)

    def with_held(self, joints: Sequence[str], q: ArrayLike) -> Robot:
        """Return this robot with joints that cannot leave their values in ``q`` (nq,).

        Unlike ``with_joints`` they stay in ``q``, as an arm with servos needs it.

        Raises:
            UnknownJointError: There is no such active joint. The message has close names.
            UnsupportedJointError: A joint is a ball or free.
            ModelError: As ``check_q``.
        """
        require_joints(joints, self.joints)
        inside = self.clip(q)
        lower = self.lower.copy()
        upper = self.upper.copy()
        for joint in joints:
            node = self.joints.index(joint)
            if self.tree.kind[node] not in (HINGE, SLIDE):
                raise UnsupportedJointError(
                    f"joint {joint!r} is a ball or free joint, which cannot be held",
                    path=self.path,
                    hint="hold hinges and slides only",
                )
            value = inside[self.tree.qadr[node]]
            lower[self.tree.vadr[node]] = value
            upper[self.tree.vadr[node]] = value
        held = dataclasses.replace(self, tree=self.tree.with_limits(lower, upper))
        return held._with_home_inside()

    def with_base(self, frame: str) -> Robot:
        """Return this robot with only the joints between a frame and the tool active.

        The body of the frame does not move any more.

        Raises:
            UnknownFrameError: The robot has no such frame.
            UnsupportedJointError: No active joint moves the tool relative to the frame.
        """
        joints = self.joints_between(frame)
        if not joints:
            raise UnsupportedJointError(
                f"no joint moves {self.tool!r} relative to {frame!r}",
                path=self.path,
                hint="choose a base that carries the tool",
            )
        return self.with_joints(joints)

    def with_parts(
        self,
        *,
        tool: str | None = None,
        base: str | None = None,
        joints: Sequence[str] = (),
    ) -> Robot:
        """Return this robot with another tool, another base and fewer active joints.

        Args:
            tool: As for ``with_tool``. None or empty: the same tool.
            base: As for ``with_base``. None or empty: the same base.
            joints: As for ``with_joints``. Empty: all joints.

        Raises:
            UnknownFrameError, UnknownJointError, UnsupportedJointError: As these methods.
        """
        robot = self.with_tool(tool) if tool else self
        if joints:
            robot = robot.with_joints(joints)
        return robot.with_base(base) if base else robot

    def joints_between(self, base: str, frame: str | None = None) -> tuple[str, ...]:
        """Return the active joints that move a frame (default: the tool) relative to its base.

        Args:
            base: A frame whose body carries the frame. Its own joints are not among the result.
            frame: The frame that moves.

        Returns:
            Names, root first. Empty if ``base`` does not carry the frame.

        Raises:
            UnknownFrameError: The robot has no such frame.
        """
        base_body = self.frame(base).body
        body = self.frame(frame).body
        names: list[str] = []
        while body not in (0, base_body):
            first = int(self.model.body_jntadr[body])
            count = int(self.model.body_jntnum[body])
            names[:0] = [self.model.joint(j).name for j in range(first, first + count)]
            body = int(self.model.body_parentid[body])
        if body != base_body:
            return ()
        return tuple(name for name in names if name in self.joints)

    def with_tool(self, frame: str) -> Robot:
        """Return this robot with another default frame.

        Raises:
            UnknownFrameError: The robot has no such frame. The message has close names.
        """
        self.frame(frame)
        return dataclasses.replace(self, tool=frame)

    def with_stiffness(self, values: Mapping[str, float]) -> Robot:
        """Return this robot with other stiffness of some joints.

        Args:
            values: Joint name -> positive cost of moving it, compared with the other joints.

        Raises:
            UnknownJointError: There is no such active joint. The message has close names.
            ModelError: A value is not a positive number.
        """
        require_joints(values, self.joints)
        stiffness = self.stiffness.copy()
        for joint, value in values.items():
            if not (is_real(value, 0.0, LARGEST_STIFFNESS) and value > 0.0):
                raise ModelError(
                    f"the stiffness of joint {joint!r} cannot be {value!r}",
                    hint=f"give a number above 0, at most {LARGEST_STIFFNESS:g}",
                )
            stiffness[self.tree.dof_node == self.joints.index(joint)] = value
        return dataclasses.replace(self, stiffness=stiffness)

    def with_optional_limits(self) -> Robot:
        """Return this robot within the optional limits of ``robot.toml``, if it has some."""
        limits = self.file.optional_limits
        if not limits:
            return self
        widths = np.full(self.nv, np.inf)
        for node, joint in enumerate(self.joints):
            for pattern, width in limits.items():
                if fnmatch.fnmatchcase(joint, pattern):
                    widths[self.tree.dof_node == node] = width
        return self.with_limits(-widths, widths)

    def _with_frozen(self, kept: NDArray[np.bool_], home: Array) -> Robot:
        """Return this robot with some of its joints frozen at ``home`` (nq,).

        Args:
            kept: (joints,) whether a joint stays active.
            home: (nq,) home of all joints.
        """
        joints = [joint for joint, keep in zip(self.tree.joint_ids, kept, strict=True) if keep]
        frozen_qpos = self.qpos(home)
        tree, bodies = mjcf.build_tree(self.model, joints, frozen_qpos)
        dofs = kept[self.tree.dof_node]
        tree = tree.with_limits(self.lower[dofs], self.upper[dofs])
        if self.couplings:
            names = mjcf.joint_names(self.model)
            addresses = self.model.jnt_qposadr
            tree = with_couplings(tree, self.couplings, frozen_qpos, addresses, names)
        fixed = dataclasses.replace(
            self,
            tree=tree,
            joints=tuple(joint for joint, keep in zip(self.joints, kept, strict=True) if keep),
            velocity_limits=self.velocity_limits[dofs],
            acceleration_limits=self.acceleration_limits[dofs],
            stiffness=self.stiffness[dofs],
            home=frozen_qpos[mjcf.qpos_addresses(self.model, tree)],
            frozen_qpos=frozen_qpos,
            _bodies=bodies,
        )
        return fixed._with_home_inside()

    def _check_limits(self, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
        """Return both limits as arrays (nv,), or raise ``ModelError``."""
        try:
            lower_array = np.broadcast_to(np.asarray(lower, dtype=float), self.nv)
            upper_array = np.broadcast_to(np.asarray(upper, dtype=float), self.nv)
        except (TypeError, ValueError, OverflowError) as error:
            problem = f"limits are {self.nv} numbers each, not {lower!r}, {upper!r}"
            raise ModelError(problem) from error
        if not (lower_array <= upper_array).all():
            given = f"{lower_array.tolist()}, {upper_array.tolist()}"
            raise ModelError(f"limits must be numbers, lower <= upper, not {given}")
        return lower_array, upper_array

    def reach(self, frame: str | None = None) -> tuple[Array, float] | None:
        """Return a ball that the origin of a frame cannot leave.

        Returns:
            Centre (3,) and radius in metres, or None if the base floats or a slide is unlimited.
            The centre is the position of the first joint. The radius is the sum of the offsets
            after it, with slides at their longest.
        """
        node, local = self.attachment(frame)
        return self.tree.reach(node, local)

    def _with_home_inside(self) -> Robot:
        return dataclasses.replace(self, home=self.apply_couplings(self.clip(self.home)))

    def _kernel_arguments(
        self, q: ArrayLike, frame: str | None, *outputs: Array
    ) -> tuple[Any, ...]:
        """Return what the kernels take for a frame at ``q``: inputs, scratch memory, outputs."""
        node, local = self.attachment(frame)
        nodes = np.array(self.tree.ancestors(node), dtype=np.int64)
        world = np.empty((self.tree.size, 12))
        scratch = np.empty((2, 12))
        address = self.tree.block.address
        # A copy: numba would compile the forward pass again for an array that is read-only.
        inputs = (address, nodes, node, local[None, :], self.check_q(q).copy())
        return *inputs, world, scratch, *outputs

    @cached_property
    def _addresses(self) -> NDArray[np.int64]:
        """Addresses (nq,) of the active joints in qpos."""
        return mjcf.qpos_addresses(self.model, self.tree)

    @cached_property
    def _thread_data(self) -> threading.local:
        """MuJoCo's data of each thread. Not pickled and not copied."""
        return threading.local()


def require_robot(robot: object) -> None:
    """Raise ``ModelError`` for other values, such as the name of a robot or MuJoCo's model."""
    if not isinstance(robot, Robot):
        hint = 'rik.load_robot("puma560")'
        raise ModelError(f"this needs a robot, not {robot!r}", hint=hint)


def load_robot(
    name: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
    *,
    joints: Sequence[str] | str | None = None,
    tool: str | None = None,
) -> Robot:
    """Load a robot from the catalogue, from an MJCF or URDF file, from text or from memory.

    Args:
        name: A catalogue name, ``"puma560"``; the path of a model file or of a folder with a
            ``robot.toml``; ``"chain:5"``, a chain of five ball joints; a name of the package
            robot_descriptions, ``"robot_descriptions:panda_mj_description"``; the text of an MJCF
            or URDF,
            ``"<mujoco>…"``; an ``MjSpec``, which is copied; or an ``MjModel``, which must not be
            changed afterwards. A robot of the last three kinds has the name of the model, and its
            ``path`` is not a file.
        joints: Names of the joints that may move, or the name of a joint group. The other joints
            are frozen at home. Default: the group ``arm`` of ``robot.toml`` if there is one, else
            all joints.
        tool: Name of the default frame.

    Raises:
        UnknownRobotError: The catalogue has no such robot. The message has close names.
        ModelError: The file is missing or cannot be read. The message has MuJoCo's reason.
        UnknownJointError: The model has no such joint. The message has close names.
        UnknownFrameError: The model has no such frame. The message has close names.
    """
    path, file, model, velocity_limits, missing_meshes = _read_model(name)
    if velocity_limits:  # of a URDF; robot.toml has priority
        merged = velocity_limits | file.velocity_limits
        file = file.model_copy(update={"velocity_limits": merged})
    names = mjcf.joint_names(model)
    home_qpos = mjcf.home_qpos(model, path, file)
    tree, bodies = mjcf.build_tree(model, mjcf.active_joints(names, joints, file), home_qpos)
    couplings: list[Coupling] = []
    if model.neq or file.couplings:
        couplings = declared_couplings(model, file, names)
        tree = with_couplings(tree, couplings, home_qpos, model.jnt_qposadr, names)
    if tree.nv == 0:
        raise UnsupportedJointError(f"{path} has no joint that may move", path=path)
    frames = mjcf.model_frames(model, file)
    active = tuple(names[j] for j in tree.joint_ids)
    limits = mjcf.motion_limits(tree, active, names, file)
    robot = Robot(
        name=file.name,
        path=path,
        model=model,
        tree=tree,
        joints=active,
        velocity_limits=limits[0],
        acceleration_limits=limits[1],
        stiffness=mjcf.joint_stiffness(tree, names, file),
        home=home_qpos[mjcf.qpos_addresses(model, tree)],
        tool=_default_frame(tool, model, file, frames),
        frozen_qpos=home_qpos,
        file=file,
        couplings=tuple(couplings),
        source=_source_of(name, path),
        missing_meshes=missing_meshes,
        _frames=frames,
        _bodies=bodies,
    )
    return robot._with_home_inside()


def _read_model(
    name: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
) -> tuple[Path, RobotFile, mujoco.MjModel, dict[str, float], tuple[str, ...]]:
    """Return path, content of robot.toml, model, and speed limits and missing meshes of a URDF."""
    if isinstance(name, str) and name.startswith(CHAIN):
        path, file = find_robot(name)
        return path, file, *mjcf.read_model(chain_model(chain_links(name)), path)
    is_text = isinstance(name, str) and name.lstrip().startswith("<")
    if not (is_text or isinstance(name, mujoco.MjSpec | mujoco.MjModel)):
        path, file = find_robot(name)
        return path, file, *mjcf.read_model(path, path)
    model, velocity_limits, missing_meshes = mjcf.read_model(name, Path("<memory>/model"))
    model_name = model.names[: model.names.index(b"\0")].decode() or "model"
    file = RobotFile(name=model_name)
    # This folder cannot exist, so MuJoCo finds no file beside the model.
    return Path(f"<memory>/{model_name}"), file, model, velocity_limits, missing_meshes


def _source_of(
    name: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel, path: Path
) -> Path | str | None:
    """Return what the model can be read from again; None for an ``MjModel``."""
    if isinstance(name, mujoco.MjModel):
        return None
    if isinstance(name, mujoco.MjSpec):
        spec = name.copy()
        mjcf.compiled(spec)
        return str(spec.to_xml())
    if isinstance(name, str) and name.lstrip().startswith("<"):
        return name
    return path


def _default_frame(
    tool: object,
    model: mujoco.MjModel,
    file: RobotFile,
    frames: dict[str, mjcf.ModelFrame],
) -> str:
    """Return the requested tool, else that of robot.toml, else a guess."""
    if tool is not None:
        name = tool
        hint = ""
    else:
        name = file.tool or mjcf.guess_tool(model, frames)
        hint = f"named by tool of {file.path}"
    if not isinstance(name, str) or name not in frames:
        raise UnknownFrameError(str(name), frames, hint=hint)
    return name

"""``load_robot``: MJCF, URDF or a catalogue name in, a ``Robot`` out: an immutable description of what moves.

``q`` is MuJoCo's ``qpos`` of the active joints in declared order, shape (nq,); ``dq`` its tangent,
shape (nv,).  Poses are in the world; ``jacobian`` is linear over angular velocity, world axes, at the
frame's origin.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik import model as mjcf
from robot_ik.errors import ModelError, UnknownFrameError, UnsupportedJointError, apart
from robot_ik.geometry import Array, Pose, vector
from robot_ik.kernels import kinematics
from robot_ik.kernels.tree import Tree
from robot_ik.robot_file import RobotFile, find_robot

if TYPE_CHECKING:
    from robot_ik.couplings import Coupling

_ARRAYS = ("velocity", "acceleration", "stiffness", "home", "frozen_qpos")


@dataclass(frozen=True, eq=False, repr=False)
class Robot:
    """What a robot is.  Made by ``load_robot``; never changes: its arrays are read-only.

    Attributes:
        name: Catalogue name, or the file's stem.
        path: The model file.
        model: MuJoCo's model; treat as read-only.
        joints: Names of the active joints, in declared order.
        velocity, acceleration: (nv,) limits of motion, rad/s and rad/s² (m for slides).
        stiffness: (nv,) what moving a joint costs beside the others.
        home: (nq,) where the robot rests.
        tool: Name of the default frame.
        tree: The same kinematics compiled.
        file: What ``robot.toml`` says beyond the model.
        couplings: Joints of the model that follow another.
        missing_meshes: Mesh files of a URDF that the model is without, by their names there: no such file,
            or neither STL nor OBJ.
    """

    name: str
    path: Path
    model: mujoco.MjModel
    tree: Tree
    joints: tuple[str, ...]
    velocity: Array
    acceleration: Array
    stiffness: Array
    home: Array
    tool: str
    frozen_qpos: Array
    file: RobotFile
    couplings: tuple[Coupling, ...]
    missing_meshes: tuple[str, ...]
    _frames: dict[str, mjcf.ModelFrame] = field(repr=False)
    _bodies: tuple[mjcf.Attachment, ...] = field(repr=False)

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            array = np.array(getattr(self, name), dtype=float)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "memory"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()  # copies of arrays can be written to

    def __repr__(self) -> str:
        shown = ", ".join(self.joints[:8]) + (f", … {len(self.joints) - 8} more" if self.nv > 8 else "")
        return (
            f"Robot({self.name!r}, {len(self.joints)} joints: {shown}; tool {self.tool!r}, "
            f"{len(self._frames)} frames; {self.path.name})"
        )

    @cached_property
    def memory(self) -> dict[str, Any]:
        """What others worked out for this robot and keep with it; copies begin without."""
        return {}

    @property
    def lower(self) -> Array:
        """(nv,) lower limits, rad or m; -inf where unlimited."""
        return self.tree.lower

    @property
    def upper(self) -> Array:
        """(nv,) upper limits, rad or m; inf where unlimited; a ball joint has its cone angle."""
        return self.tree.upper

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

    def frame(self, name: str | None = None) -> mjcf.ModelFrame:
        """The frame of that name (default: the tool); raises ``UnknownFrameError`` with the close names."""
        try:
            return self._frames[self.tool if name is None else name]
        except (KeyError, TypeError):  # a list is no key
            raise UnknownFrameError(str(name), self._frames) from None

    def check_q(self, q: ArrayLike, what: str = "q") -> Array:
        """``q`` as a new read-only array (nq,); raises ``ModelError`` unless it is nq finite numbers."""
        hint = f"{self.name} has these active joints: {', '.join(self.joints)}"
        # Of any size: joint angles are clipped to their limits, and nobody squares them before.
        return vector(q, self.nq, what, ModelError, hint, sys.float_info.max)

    def attachment(self, frame: str | int | None = None) -> tuple[int, Array]:
        """Node (-1: world) that carries a frame, or a body by its id; the frame seen from it (12,)."""
        if isinstance(frame, int):
            return self._bodies[frame].node, self._bodies[frame].local.row
        at = self.frame(frame)
        body = self._bodies[at.body]
        return body.node, body.local.compose(at.local).row

    def forward(self, q: ArrayLike, frame: str | None = None) -> Pose:
        """World pose of a frame (default: the tool) at ``q`` (nq,); raises as ``frame``, ``check_q``."""
        out = np.empty((1, 12))
        kinematics.tree_frame(*self._work(q, frame, out))
        return Pose.from_row(out[0])

    def jacobian(self, q: ArrayLike, frame: str | None = None) -> Array:
        """(6, nv): linear over angular velocity of a frame's origin per unit of dq, world axes."""
        jacobian = np.empty((6, self.nv))
        kinematics.tree_jacobian(*self._work(q, frame, np.empty((1, 12)), jacobian))
        return jacobian

    def measure(self, q: ArrayLike, frame: str | None = None) -> Pose:
        """Pose of a frame by MuJoCo's own forward pass: the independent judge of every solution."""
        at = self.frame(frame)
        data = self.data_at(q)
        return Pose(data.xpos[at.body], data.xquat[at.body]).compose(at.local)

    def center_of_mass(self, q: ArrayLike, body: str | None = None) -> Array:
        """(3,) centre of mass of a body and all that hangs on it (None: the whole model), by MuJoCo."""
        data = self.data_at(q)
        mujoco.mj_comPos(self.model, data)
        return np.array(data.subtree_com[self.body_id(body)])

    def difference(self, start: ArrayLike, end: ArrayLike) -> Array:
        """(nv,) the displacement from ``start`` to ``end`` (nq,), by MuJoCo (``mj_differentiatePos``)."""
        whole = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, whole, 1.0, self.qpos(start), self.qpos(end))
        return np.asarray(whole[np.isin(self.model.dof_jntid, self.tree.joint_ids)])

    def data_at(self, q: ArrayLike) -> mujoco.MjData:
        """MuJoCo's data with all bodies where they are at ``q``, good until this thread's next call."""
        own = self.memory.setdefault("kinematics", threading.local())
        data = getattr(own, "data", None)
        if data is None:
            data = own.data = mujoco.MjData(self.model)
        data.qpos[:] = self.qpos(q)
        mujoco.mj_kinematics(self.model, data)
        return data

    def body_id(self, name: str | None) -> int:
        """MuJoCo's number of a body (None: the world, which carries all); raises ``UnknownFrameError``."""
        names = {self.model.body(b).name: b for b in range(self.model.nbody)}
        try:
            return 0 if name is None else names[name]
        except (KeyError, TypeError):  # a list is no key
            raise UnknownFrameError(str(name), filter(None, names)) from None

    def qpos(self, q: ArrayLike) -> Array:
        """(model.nq,): ``q`` at its addresses, the frozen joints where they stand."""
        qpos = self.frozen_qpos.copy()
        qpos[self._addresses] = self.check_q(q)
        return qpos

    def integrate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """q ⊕ dq (nq,): sums for hinges and slides, rotations for balls (``mj_integratePos``).

        Raises:
            ModelError: ``q`` is not nq finite numbers, or ``dq`` not nv.
        """
        moved = self.check_q(q).copy()
        # Contiguous: for every other layout the kernel would be compiled anew.
        step = vector(dq, self.nv, "dq", ModelError, largest=sys.float_info.max).copy()
        kinematics.tree_integrate(self.tree.handle, np.arange(self.tree.size), moved, step)
        return moved

    def clip(self, q: ArrayLike) -> Array:
        """The nearest q (nq,) inside the limits, joint by joint."""
        inside = self.check_q(q).copy()
        if self.nq == self.nv:  # hinges and slides only: a new machine need not compile anything to load it
            return np.asarray(np.clip(inside, self.tree.lower, self.tree.upper))
        kinematics.tree_clip(self.tree.handle, np.arange(self.tree.size), inside)
        return inside

    def follow(self, q: ArrayLike) -> Array:
        """``q`` (nq,) with each coupled joint where its leader puts it."""
        moved = self.check_q(q).copy()
        if len(self.tree.coupled):
            kinematics.tree_follow(self.tree.handle, moved)
        return moved

    def outside(self, q: ArrayLike, slack: float = 1e-9) -> list[str]:
        """Names of joints beyond their limits by more than ``slack`` (rad or m)."""
        q = self.check_q(q)
        vector([slack], 1, "slack", ModelError)
        gone = np.abs(self.clip(q) - q)
        if not gone.max(initial=0.0) > slack:
            return []
        widest = np.maximum.reduceat(gone, self.tree.qadr)
        return [joint for joint, off in zip(self.joints, widest, strict=True) if off > slack]

    def sample(self, rng: np.random.Generator) -> Array:
        """A random q (nq,) inside the limits; unlimited hinges within ±pi, unlimited slides within ±1 m."""
        given: object = rng
        if not isinstance(given, np.random.Generator):
            raise ModelError(f"not a random generator: {given!r}", hint="np.random.default_rng(1)")
        return self.follow(mjcf.random_q(self.tree, self.home, rng))

    def with_limits(self, lower: ArrayLike, upper: ArrayLike) -> Robot:
        """The same robot inside the intersection of its limits and these (nv,); home moves inside.

        Raises:
            ModelError: No range is left for some joint, or not one number for each degree of freedom.
        """
        try:
            low, high = (np.broadcast_to(np.asarray(side, dtype=float), self.nv) for side in (lower, upper))
        except (TypeError, ValueError, OverflowError) as error:
            raise ModelError(f"limits are {self.nv} numbers each, not {lower!r}, {upper!r}") from error
        if not (low <= high).all():
            raise ModelError(f"limits must be numbers, lower <= upper, not {low.tolist()}, {high.tolist()}")
        low, high = np.maximum(self.lower, low), np.minimum(self.upper, high)
        for v in np.flatnonzero(low > high):
            other = (np.ravel(end)[v % np.size(end)] for end in (lower, upper))
            one, two, three, four = apart(self.lower[v], self.upper[v], *other, digits=4)
            raise ModelError(
                f"no range is left for joint {self.joints[self.tree.dof_node[v]]!r}: "
                f"the model allows {one} … {two}, the other side {three} … {four}",
                hint="check sign, zero and range of the joint in the arm file",
            )
        tree = self.tree.with_limits(low, high)
        if len(tree.coupled):
            from robot_ik.couplings import narrowed  # which few arms have

            tree = narrowed(tree, self.joints)
        return dataclasses.replace(self, tree=tree)._with_home_inside()

    def reach(self, frame: str | None = None) -> tuple[Array, float] | None:
        """A ball that the frame's origin can never leave: centre (3,) and radius in metres, or None.

        The centre is where the first joint stands; the radius adds up all offsets after it, slides at their
        longest.  None where the base floats or a slide is unlimited.
        """
        node, local = self.attachment(frame)
        return self.tree.reach(node, local)

    def _with_home_inside(self) -> Robot:
        return dataclasses.replace(self, home=self.follow(self.clip(self.home)))

    def _work(self, q: ArrayLike, frame: str | None, *results: Array) -> tuple[Any, ...]:
        """What the kernels take for a frame at ``q``: work space, then results."""
        node, local = self.attachment(frame)
        nodes = np.array(self.tree.ancestors(node), dtype=np.int64)
        world, scratch = np.empty((self.tree.size, 12)), np.empty((2, 12))
        return self.tree.handle, nodes, node, local[None, :], self.check_q(q), world, scratch, *results

    @cached_property
    def _addresses(self) -> NDArray[np.int64]:
        return mjcf.qpos_addresses(self.model, self.tree)


def require_robot(robot: object) -> None:
    """Raises ``ModelError`` for anything else: a name in place of a robot is a likely mistake."""
    if not hasattr(robot, "velocity"):  # MuJoCo's models have nq and joints, too
        raise ModelError(f"this needs a robot, not {robot!r}", hint='rik.load_robot("puma560")')


def load_robot(
    name: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
    *,
    joints: Sequence[str] | str | None = None,
    tool: str | None = None,
) -> Robot:
    """Loads a robot by catalogue name, or any MJCF or MuJoCo-readable URDF by path, as text or in memory.

    Args:
        name: ``"puma560"``; the path of a model file or of a folder with a ``robot.toml``;
            ``"robot_descriptions:panda_mj_description"``; the text of an MJCF or URDF (``"<mujoco>…"``);
            an ``MjSpec``, which stays as it is; or an ``MjModel``, from then on to be treated as read-only.
            The last three are named after the model, and ``path`` names no file.
        joints: Names of the joints that may move, or the name of a joint group; the rest are frozen at
            home.  Default: the group ``arm`` of ``robot.toml`` if it has one, else all joints.
        tool: Name of the default frame.

    Raises:
        UnknownRobotError: No such name; lists the close ones.
        ModelError: There is no such file, or the file cannot be read; carries MuJoCo's reason.
        UnknownJointError, UnknownFrameError: With the close names.
    """
    in_memory = isinstance(name, mujoco.MjSpec | mujoco.MjModel)
    if in_memory or (isinstance(name, str) and name.lstrip().startswith("<")):
        model, velocity, missing_meshes = mjcf.read_model(name, Path("<memory>/model"))
        file = RobotFile(name=model.names[: model.names.index(b"\0")].decode() or "model")
        # A folder that cannot exist, so that nothing is ever found beside the model.
        path = Path(f"<memory>/{file.name}")
    else:
        path, file = find_robot(name)
        model, velocity, missing_meshes = mjcf.read_model(path, path)
    if velocity:
        file = file.model_copy(update={"velocity": velocity | file.velocity})
    names = mjcf.joint_names(model)
    rest = mjcf.home_qpos(model, path, file)
    tree, bodies = mjcf.build_tree(model, mjcf.active_joints(names, joints, file), rest)
    couplings: list[Coupling] = []
    if model.neq or file.couplings:
        from robot_ik.couplings import declared_couplings, with_couplings  # which few arms have

        couplings = declared_couplings(model, file, names)
        tree = with_couplings(tree, couplings, rest, model.jnt_qposadr, names)
    if tree.nv == 0:
        raise UnsupportedJointError(f"{path} has no joint that may move", path=path)
    frames = mjcf.model_frames(model, file)
    default_tool: object = file.tool or mjcf.guess_tool(model, frames) if tool is None else tool
    if not isinstance(default_tool, str) or default_tool not in frames:
        hint = f"named by tool of {file.path}" if tool is None else ""
        raise UnknownFrameError(str(default_tool), frames, hint=hint)
    active = tuple(names[j] for j in tree.joint_ids)
    speed, acceleration = mjcf.motion_limits(tree, active, names, file)
    robot = Robot(
        name=file.name,
        path=path,
        model=model,
        tree=tree,
        joints=active,
        velocity=speed,
        acceleration=acceleration,
        stiffness=mjcf.joint_stiffness(tree, names, file),
        home=rest[mjcf.qpos_addresses(model, tree)],
        tool=default_tool,
        frozen_qpos=rest,
        file=file,
        couplings=tuple(couplings),
        missing_meshes=missing_meshes,
        _frames=frames,
        _bodies=bodies,
    )
    return robot._with_home_inside()

"""Reading a model file: MuJoCo's model, its frames, home pose and limits, and the compiled tree."""

from __future__ import annotations

import dataclasses
import logging
import math
import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.config import LARGEST_NUMBER, read_text, shown
from robot_ik.errors import (
    ConfigError,
    ModelError,
    UnknownFrameError,
    UnknownJointError,
    distinct_texts,
    require_joints,
)
from robot_ik.geometry import Array, Pose, rotation_exp, rotation_z_to
from robot_ik.kernels.tree import BALL, FREE, HINGE, Q_WIDTH, SLIDE, V_WIDTH, Tree
from robot_ik.robot_file import RobotFile

if TYPE_CHECKING:
    from robot_ik.urdf import Urdf

logger = logging.getLogger(__name__)

SMALLEST_MASS = 1e-9
"""kg. Mass of a link without ``<inertial>``: MuJoCo does not compile a moving body without mass."""

SMALLEST_INERTIA = 1e-12
"""kg m². Moments of inertia of such a link."""

LARGEST_MASS = 1e100
"""kg or kg m². Masses of a model in millimetres are 1e9 times too large, but it can be solved."""

HOME_ROUNDING = 1e-3
"""rad or m. A home pose this far beyond a limit is clipped: limits are written with few digits."""

RADIANS_MARGIN = 0.01
"""Degrees. Ranges up to 2 pi + this are suspected to be radians that are read as degrees."""

TOOL_NAMES = (
    "gripper",
    "tool",
    "tcp",
    "tool0",
    "ee",
    "end_effector",
    "attachment_site",
    "pinch",
    "grasp",
    "flange",
    "tip",
)
"""Common names of the end of an arm, in the order in which they are tried."""

DEFAULT_SPEED = {HINGE: 1.5, SLIDE: 0.25, BALL: 1.5, FREE: 0.5}
"""rad/s or m/s. Speed limit of a joint that robot.toml does not name: slow enough to watch."""

SPEED_TO_ACCELERATION = 4.0
"""1/s. Default acceleration limit per speed limit: full speed after a quarter of a second."""

_CHECKED_ARRAYS = (
    "body_pos",
    "body_quat",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "jnt_pos",
    "jnt_axis",
    "jnt_range",
    "site_pos",
    "site_quat",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "qpos0",
    "key_qpos",
)
"""Arrays of MuJoCo's model whose numbers must be finite, one row for each body, joint and so on."""

_KIND_OF = {
    int(mujoco.mjtJoint.mjJNT_HINGE): HINGE,
    int(mujoco.mjtJoint.mjJNT_SLIDE): SLIDE,
    int(mujoco.mjtJoint.mjJNT_BALL): BALL,
    int(mujoco.mjtJoint.mjJNT_FREE): FREE,
}

_warnings_lock = threading.Lock()  # the warning filters and MuJoCo's handler belong to the process


@dataclass(frozen=True)
class ModelFrame:
    """A named frame that is fixed to a body of the model.

    Attributes:
        name: Name of the frame.
        body: MuJoCo's id of the body.
        local: Pose of the frame seen from the body.
    """

    name: str
    body: int
    local: Pose


def read_model(
    source: Path | str | mujoco.MjSpec | mujoco.MjModel, path: Path
) -> tuple[mujoco.MjModel, dict[str, float], tuple[str, ...]]:
    """Read an MJCF or URDF file, such a text, or a spec.

    Joints without a name get the name ``joint_<id>``. A URDF keeps the frames of its fixed joints
    unless it sets ``fusestatic``.

    Args:
        source: The file, text or spec. An ``MjModel`` is returned as given.
        path: The file, for messages.

    Returns:
        MuJoCo's model, the speed limits of the joints of a URDF (rad/s or m/s), and the names of
        the mesh files that the URDF refers to and that are missing.

    Raises:
        ModelError: MuJoCo cannot read the source, a joint has an empty range, or a number is not
            finite or beyond ``LARGEST_NUMBER``.
    """
    if isinstance(source, mujoco.MjModel):
        return source, {}, ()
    spec, urdf = read_spec(source, path)
    with _mujoco_errors(path):
        _name_joints(spec)
        model = compiled(spec)
    _check_numbers(model, path)
    _check_ranges(model, path)
    _warn_of_radians(model, spec, path)
    if urdf is None:
        return model, {}, ()
    return model, urdf.velocity_limits, urdf.missing_meshes


def read_spec(source: Path | str | mujoco.MjSpec, path: Path) -> tuple[mujoco.MjSpec, Urdf | None]:
    """Return the spec that ``read_model`` compiles, and the URDF that it was read from, if any.

    Raises:
        ModelError: As ``read_model``.
    """
    if isinstance(source, mujoco.MjSpec):
        return source.copy(), None
    text = source if isinstance(source, str) else _model_text(source)
    folder = source.parent if isinstance(source, Path) else Path()
    urdf = None
    if "<robot" in text:
        from robot_ik.urdf import Urdf  # imported here: it takes 6 ms and MJCF does not need it

        urdf = Urdf.of_text(text, folder)
    if urdf is not None and urdf.problem[0]:
        reason, hint = urdf.problem
        raise ModelError(f"{path}: {reason}", path=path, reason=reason, hint=hint)
    with _mujoco_errors(path):
        if urdf is not None:
            return mujoco.MjSpec.from_string(urdf.text()), urdf
        if isinstance(source, Path):
            return mujoco.MjSpec.from_file(str(source)), None
        return mujoco.MjSpec.from_string(source), None


def _model_text(path: Path) -> str:
    """Return the text of a model file, or raise ``ModelError``."""
    try:
        return read_text(path, "the model", errors="replace")  # MuJoCo accepts other encodings
    except ConfigError as error:
        reason = "it cannot be read"
        raise ModelError(str(error.args[0]), path=path, reason=reason) from error


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec, also with moving bodies that have no mass or an impossible inertia.

    Kinematics needs no masses. Right masses are kept. Impossible inertias become those of a ball.
    """
    try:
        return spec.compile()
    except ValueError as error:
        if not any(word in str(error) for word in ("mjMINVAL", "balanceinertia")):
            raise
    spec.compiler.boundmass = max(spec.compiler.boundmass, SMALLEST_MASS)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, SMALLEST_INERTIA)
    spec.compiler.balanceinertia = True
    return spec.compile()


@contextmanager
def _mujoco_errors(path: Path) -> Iterator[None]:
    """Raise MuJoCo's errors as ``ModelError`` and log its warnings.

    MuJoCo's own handler would write warnings to stderr and to a file MUJOCO_LOG.TXT in the current
    folder. They name the parts of the model that were ignored. Python's warnings concern dynamics.
    """
    ignored: list[str] = []
    try:
        with _warnings_lock, warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter("always")
            handler = mujoco.get_mju_user_warning()
            mujoco.set_mju_user_warning(ignored.append)
            try:
                yield
            finally:
                mujoco.set_mju_user_warning(handler)
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        hint = "MJCF and URDF files are read; meshes must be at the paths in the file"
        if "find decoder" in reason:
            hint = "the name of a model ends with .xml or .urdf; an arm file is for --arm"
        raise ModelError(
            f"{path} is not a model that MuJoCo can read: {reason}",
            path=path,
            reason=reason,
            hint=hint,
        ) from error
    for text in ignored:
        logger.warning("%s: %s", path, " ".join(text.split()))
    for warning in noted:
        logger.info("%s: %s", path, warning.message)


def joint_names(model: mujoco.MjModel) -> list[str]:
    """Return the names of all joints by MuJoCo id; ``joint_<id>`` for joints without a name."""
    return [model.joint(j).name or f"joint_{j}" for j in range(model.njnt)]


def _name_joints(spec: mujoco.MjSpec) -> None:
    """Give a name to each joint of a spec that has none."""
    taken = {joint.name for joint in spec.joints}
    for k, joint in enumerate(spec.joints):
        if not joint.name:
            name = f"joint_{k}"
            while name in taken:
                name += "_"
            joint.name = name
            taken.add(name)


def _check_numbers(model: mujoco.MjModel, path: Path) -> None:
    """Raise ``ModelError`` for numbers that cannot be used.

    MuJoCo accepts "nan", 1e308 and axes of zero length.
    """
    for name in _CHECKED_ARRAYS:
        rows = np.asarray(getattr(model, name))
        rows = rows[:, None] if rows.ndim == 1 else rows
        largest = LARGEST_MASS if name in ("body_mass", "body_inertia") else LARGEST_NUMBER
        bad = ~(np.abs(rows) <= largest).all(axis=1)
        if name.endswith(("axis", "quat")):
            # MuJoCo normalises these; entries of 1e308 become zero.
            bad |= ~(np.linalg.norm(rows, axis=1) > 0.5)
        if bad.any():
            row = int(np.argmax(bad))
            kind, _, quantity = name.partition("_")
            access = {
                "body": model.body,
                "jnt": model.joint,
                "site": model.site,
                "geom": model.geom,
            }
            what = name
            if kind in access:
                what = f"{quantity} of {kind} {access[kind](row).name or row!r}"
            reason = f"{what} is {rows[row].tolist()}: not finite, too large or of zero length"
            hint = f"give finite numbers up to {largest:g}"
            raise ModelError(f"{path}: {reason}", path=path, reason=reason, hint=hint)


def _check_ranges(model: mujoco.MjModel, path: Path) -> None:
    """Raise ``ModelError`` for an empty joint range, which MuJoCo often reads as no limits."""
    for joint in range(model.njnt):
        lower, upper = model.jnt_range[joint].tolist()
        has_range = bool(model.jnt_limited[joint]) or lower != 0.0 or upper != 0.0
        is_free = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        if has_range and not is_free and not lower < upper:
            name = joint_names(model)[joint]
            raise ModelError(
                f"{path}: joint {name!r} has the empty range {lower:g} … {upper:g}",
                path=path,
                hint="write the lower limit first; to keep the joint still, remove it "
                '(URDF: type="fixed")',
            )


def _warn_of_radians(model: mujoco.MjModel, spec: mujoco.MjSpec, path: Path) -> None:
    """Log a hint if each hinge has a range of a few degrees, which are probably radians."""
    hinges = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & model.jnt_limited.astype(bool)
    limits = np.abs(np.rad2deg(model.jnt_range[hinges]))
    if not spec.compiler.degree or not len(limits):
        return
    largest = float(limits.max())
    if largest <= 2.0 * math.pi + RADIANS_MARGIN:
        logger.warning(
            "%s: no joint turns further than %.2f degrees; if its ranges are in radians, "
            'it needs <compiler angle="radian"/>',
            path,
            largest,
        )


def home_qpos(model: mujoco.MjModel, path: Path, file: RobotFile) -> Array:
    """Return the qpos (model.nq,) of the home pose.

    It is the numbers or the keyframe that robot.toml names, else the keyframe "home", else the
    first keyframe, else qpos0.

    Raises:
        ModelError: robot.toml names a keyframe that the model does not have.
        ConfigError: The numbers of robot.toml do not fit the joints.
    """
    home = file.home
    if isinstance(home, tuple):
        _check_home(model, file, home)
        return np.array(home, dtype=float)
    keys = {model.key(k).name: k for k in range(model.nkey)}
    if home is None:
        home = "home" if "home" in keys else next(iter(keys), None)
    elif home not in keys:
        known = ", ".join(keys) or "none"
        problem = f"{file.path}: home: {path} has no keyframe {home!r}; it has: {known}"
        raise ModelError(problem, path=path)
    return np.array(model.qpos0 if home is None else model.key_qpos[keys[home]], dtype=float)


def _check_home(model: mujoco.MjModel, file: RobotFile, home: tuple[float, ...]) -> None:
    """Raise ``ConfigError`` unless home is model.nq numbers inside the limits."""
    names = joint_names(model)
    where = file.path or file.name
    if len(home) != model.nq:
        allowed = f"{model.nq}, rad and m, for the joints {', '.join(names)}"
        problem = f"it has {len(home)} numbers"
        raise ConfigError(problem, file=where, key="home", allowed=allowed)
    units = {HINGE: "rad", SLIDE: "m"}
    for joint, name in enumerate(names):
        unit = units.get(_KIND_OF[int(model.jnt_type[joint])])
        if unit is None or not model.jnt_limited[joint]:
            continue
        value = home[model.jnt_qposadr[joint]]
        lower, upper = model.jnt_range[joint].tolist()
        if not lower - HOME_ROUNDING <= value <= upper + HOME_ROUNDING:
            given, lower_text, upper_text = distinct_texts(value, lower, upper, digits=4, form="g")
            raise ConfigError(
                f"joint {name!r} at {given} {unit} is outside its limits",
                file=where,
                key="home",
                allowed=f"{lower_text} to {upper_text} {unit}",
                hint=f"{given} degrees are {math.radians(value):.4g} rad" if unit == "rad" else "",
            )


def model_frames(model: mujoco.MjModel, file: RobotFile) -> dict[str, ModelFrame]:
    """Return all frames by name: the tools of robot.toml, then sites, then bodies.

    If several have one name, the first counts.

    Raises:
        UnknownFrameError: A tool of robot.toml names a frame that the model does not have.
    """
    sites: dict[str, ModelFrame] = {}
    for s in range(model.nsite):
        name = model.site(s).name
        if name:
            local = Pose(model.site_pos[s], model.site_quat[s])
            sites[name] = ModelFrame(name, int(model.site_bodyid[s]), local)
    bodies: dict[str, ModelFrame] = {}
    for b in range(1, model.nbody):
        name = model.body(b).name
        if name:
            bodies[name] = ModelFrame(name, b, Pose())
    frames: dict[str, ModelFrame] = {}
    for tool, target in file.tools.items():
        known = sites if target.site else bodies
        name = target.site or target.body or ""
        if name not in known:
            raise UnknownFrameError(name, known, hint=f"named by the tool {tool!r} of {file.path}")
        frames[tool] = dataclasses.replace(known[name], name=tool)
    for name, frame in (sites | bodies).items():
        frames.setdefault(name, frame)
    return frames


def guess_tool(model: mujoco.MjModel, frames: dict[str, ModelFrame]) -> str:
    """Return the default frame of a model without robot.toml.

    It is the first frame of ``TOOL_NAMES``, else the last site, else the last body.

    Raises:
        ModelError: The model has no named frame.
    """
    for tool_name in TOOL_NAMES:
        for name in frames:
            if name.lower() == tool_name:
                return name
    if model.nsite and model.site(model.nsite - 1).name:
        return str(model.site(model.nsite - 1).name)
    if not frames:
        raise ModelError(
            "the model has no named site and no named body",
            hint="give a name to the body or site of the tool",
        )
    return list(frames)[-1]


def active_joints(
    names: list[str], joints: Sequence[str] | str | None, file: RobotFile
) -> list[int]:
    """Return the MuJoCo ids of the joints that may move.

    Args:
        names: Names of all joints.
        joints: Names of joints, or the name of a group. None for the group ``arm``, or all joints
            without such a group.
        file: robot.toml.

    Raises:
        UnknownJointError: There is no such joint or group.
    """
    for name, members in file.groups.items():
        require_joints(members, names, f"groups.{name} of {file.path}")
    group = "arm" if joints is None and "arm" in file.groups else joints
    given: object = names if group is None else group
    if isinstance(given, str):
        if given not in file.groups:
            hint = "a single string names a joint group"
            raise UnknownJointError(given, file.groups, hint=hint)
        given = file.groups[given]
    if not isinstance(given, Iterable) or not all(isinstance(joint, str) for joint in given):
        hint = "joints are a list of names, or the name of a joint group"
        raise UnknownJointError(shown(joints), names, hint=hint)
    moving = set(given)
    require_joints(given, names)
    return [j for j, joint in enumerate(names) if joint in moving]


def motion_limits(
    tree: Tree, joints: Sequence[str], names: Sequence[str], file: RobotFile
) -> tuple[Array, Array]:
    """Return the velocity and acceleration limits (nv,).

    They are from robot.toml, else the defaults of the type of joint.

    Args:
        tree: The compiled tree.
        joints: Names of the active joints.
        names: Names of all joints of the model.
        file: robot.toml.

    Raises:
        UnknownJointError: robot.toml names a joint that the model does not have.
        ConfigError: robot.toml has a limit of a slide in degrees, or of a hinge in millimetres.
    """
    require_joints(file.slides, names, f"motion of {file.path}")
    velocity = []
    acceleration = []
    for joint, kind in zip(joints, tree.kind.tolist(), strict=True):
        _check_unit(joint, kind, file)
        speed = file.velocity_limits.get(joint, DEFAULT_SPEED[kind])
        velocity.append(speed)
        acceleration.append(file.acceleration_limits.get(joint, speed * SPEED_TO_ACCELERATION))
    return np.array(velocity)[tree.dof_node], np.array(acceleration)[tree.dof_node]


def _check_unit(joint: str, kind: int, file: RobotFile) -> None:
    """Raise ``ConfigError`` if robot.toml has limits of a joint in the unit of the other type."""
    where = file.path or file.name
    if kind == SLIDE and joint in file.hinges:
        raise ConfigError(
            f"joint {joint!r} slides",
            file=where,
            key="motion.velocity_deg",
            allowed="its limits in velocity_mm and acceleration_mm",
            hint=f"such as velocity_mm = {{ {joint} = 100.0 }}",
        )
    if kind != SLIDE and joint in file.slides:
        raise ConfigError(
            f"joint {joint!r} does not slide",
            file=where,
            key="motion.velocity_mm",
            allowed="its limits in velocity_deg and acceleration_deg",
        )


def joint_stiffness(tree: Tree, names: Sequence[str], file: RobotFile) -> Array:
    """Return the stiffness (nv,) of robot.toml, or 1 for joints that it does not name.

    Args:
        tree: The compiled tree.
        names: Names of all joints of the model.
        file: robot.toml.

    Raises:
        UnknownJointError: robot.toml names a joint that the model does not have.
    """
    require_joints(file.stiffness, names, f"stiffness of {file.path}")
    values = [file.stiffness.get(names[joint], 1.0) for joint in tree.joint_ids]
    return np.array(values)[tree.dof_node]


@dataclass(frozen=True)
class Attachment:
    """A pose that is fixed to a node of the tree.

    Attributes:
        node: The node, -1 for the world.
        local: The pose seen from the node.
    """

    node: int
    local: Pose


class _Builder:
    """Builds a tree from a model. It visits each body once, the root first.

    Each active joint becomes a node. Bodies without active joints, frozen joints, anchors, axes and
    reference angles become part of the constant poses between the nodes.
    """

    def __init__(self, model: mujoco.MjModel, active: set[int], qpos: Array) -> None:
        self.model = model
        self.active = active
        self.qpos = qpos
        self.joint_ids: list[int] = []
        self.nodes: list[tuple[int, int, int, int]] = []  # kind, parent, address in q and in dq
        self.constant: list[Array] = []
        self.bodies: list[Attachment] = [Attachment(-1, Pose())]
        self.nq = 0
        self.nv = 0

    def add_body(self, body: int) -> None:
        """Add the joints of a body, whose parent was added before."""
        model = self.model
        parent = self.bodies[int(model.body_parentid[body])]
        offset = Pose(model.body_pos[body], model.body_quat[body])
        place = Attachment(parent.node, parent.local.compose(offset))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            place = self._add_joint(joint, place)
        self.bodies.append(place)

    def _add_joint(self, joint: int, before: Attachment) -> Attachment:
        """Return the attachment of the body behind a joint, given that in front of it."""
        model = self.model
        moves = joint in self.active
        kind = _KIND_OF[int(model.jnt_type[joint])]
        frame = self._joint_frame(joint, kind)
        node = before.node
        place = before.local.compose(frame)
        if kind == FREE:  # its qpos is a pose in the world
            node = -1
            place = Pose()
        place = place.compose(self._joint_offset(joint, kind, moves))
        if not moves:
            return Attachment(node, place.compose(frame.inverse()))
        self.joint_ids.append(joint)
        self.nodes.append((kind, node, self.nq, self.nv))
        self.constant.append(place.row)
        self.nq += Q_WIDTH[kind]
        self.nv += V_WIDTH[kind]
        return Attachment(len(self.nodes) - 1, frame.inverse())

    def _joint_frame(self, joint: int, kind: int) -> Pose:
        """Return the frame of a joint in its body: at the anchor, z along a hinge or slide."""
        if kind == FREE:
            return Pose()
        anchor = Pose(self.model.jnt_pos[joint])
        if kind == BALL:
            return anchor
        axis = np.array(self.model.jnt_axis[joint])
        return anchor.compose(Pose.from_rotation(rotation_z_to(axis / np.linalg.norm(axis))))

    def _joint_offset(self, joint: int, kind: int, moves: bool) -> Pose:
        """Return the constant motion of a joint: its reference, and its value if it is frozen."""
        start = int(self.model.jnt_qposadr[joint])
        if kind in (HINGE, SLIDE):
            value = 0.0 if moves else self.qpos[start]
            z = np.array([0.0, 0.0, value - self.model.qpos0[start]])
            return Pose(z) if kind == SLIDE else Pose(wxyz=rotation_exp(z))
        if moves:
            return Pose()
        q = self.qpos[start : start + Q_WIDTH[kind]]
        return Pose(q[:3], q[3:]) if kind == FREE else Pose(wxyz=q)


def _limits(model: mujoco.MjModel, builder: _Builder) -> tuple[Array, Array, Array, Array]:
    """Return MuJoCo's limits (nv,), and finite ranges (nv,) for random samples."""
    lower = np.full(builder.nv, -np.inf)
    upper = np.full(builder.nv, np.inf)
    sample_lower = np.full(builder.nv, -np.pi)
    sample_upper = np.full(builder.nv, np.pi)
    for joint, (kind, _, _, v) in zip(builder.joint_ids, builder.nodes, strict=True):
        if kind in (SLIDE, FREE):  # 1 m to both sides without limits
            translation = slice(v, v + (3 if kind == FREE else 1))
            sample_lower[translation] = -1.0
            sample_upper[translation] = 1.0
        if kind == FREE or not model.jnt_limited[joint]:
            continue
        joint_lower, joint_upper = model.jnt_range[joint].tolist()
        if kind == BALL:  # the range of a ball is the angle of its cone
            lower[v : v + 3] = 0.0
            upper[v : v + 3] = joint_upper
            sample_upper[v : v + 3] = joint_upper
        else:
            lower[v] = joint_lower
            upper[v] = joint_upper
            sample_lower[v] = joint_lower
            sample_upper[v] = joint_upper
    return lower, upper, sample_lower, sample_upper


def qpos_addresses(model: mujoco.MjModel, tree: Tree) -> NDArray[np.int64]:
    """Return the addresses (nq,) of the numbers of q in MuJoCo's qpos."""
    starts = model.jnt_qposadr[list(tree.joint_ids)].tolist()
    addresses = [
        start + i
        for start, kind in zip(starts, tree.kind.tolist(), strict=True)
        for i in range(Q_WIDTH[kind])
    ]
    return np.array(addresses, dtype=np.int64)


def build_tree(
    model: mujoco.MjModel, joints: list[int], qpos: Array
) -> tuple[Tree, tuple[Attachment, ...]]:
    """Compile a model in which some joints move.

    Args:
        model: MuJoCo's model.
        joints: MuJoCo ids of the joints that move.
        qpos: Values (model.nq,) of the joints that do not move.

    Returns:
        The tree, and the attachments of all bodies.
    """
    builder = _Builder(model, set(joints), qpos)
    for body in range(1, model.nbody):
        builder.add_body(body)
    kind, parent, qadr, vadr = np.array(builder.nodes, dtype=np.int64).reshape(-1, 4).T
    tree = Tree(
        tuple(builder.joint_ids),
        kind,
        parent,
        qadr,
        vadr,
        np.array(builder.constant).reshape(-1, 12),
        *_limits(model, builder),
        builder.nq,
        builder.nv,
    )
    return tree, tuple(builder.bodies)


def random_q(tree: Tree, home: Array, rng: np.random.Generator) -> Array:
    """Return a random q (nq,) inside the limits. A floating base is within 1 m of home."""
    q = home.copy()
    for k in range(tree.size):
        a = int(tree.qadr[k])
        v = int(tree.vadr[k])
        if tree.kind[k] in (HINGE, SLIDE):
            q[a] = rng.uniform(tree.sample_lower[v], tree.sample_upper[v])
            continue
        if tree.kind[k] == FREE:
            q[a : a + 3] = home[a : a + 3] + rng.uniform(-1.0, 1.0, 3)
            a += 3
            v += 3
        axis = rng.normal(size=3)
        half_angle = 0.5 * rng.uniform(0.0, min(float(tree.sample_upper[v]), np.pi))
        q[a] = np.cos(half_angle)
        q[a + 1 : a + 4] = axis / np.linalg.norm(axis) * np.sin(half_angle)
    return q

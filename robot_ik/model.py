"""What a model file says by itself: MuJoCo's model, its frames, its home, and which frame is the tool."""

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

from robot_ik.errors import (
    ConfigError,
    ModelError,
    UnknownFrameError,
    UnknownJointError,
    apart,
    require_joints,
)
from robot_ik.geometry import Array, Pose, rotation_exp, rotation_z_to
from robot_ik.kernels.tree import BALL, FREE, HINGE, Q_WIDTH, SLIDE, V_WIDTH, Tree
from robot_ik.reading import LARGEST_NUMBER, read_text, shown
from robot_ik.robot_file import RobotFile

if TYPE_CHECKING:
    from robot_ik.urdf import Urdf

_log = logging.getLogger(__name__)

# What Python does with warnings is one setting of the whole process.
_NOTING = threading.Lock()

# Links without <inertial> weigh this much (kg, kg m²): MuJoCo compiles no moving body of nothing.
_WEIGHTLESS, _WEIGHTLESS_INERTIA = 1e-9, 1e-12
# Site and body names that people give to the end of an arm, tried in this order.
_TOOL_NAMES = (
    "gripper", "tool", "tcp", "tool0", "ee", "end_effector", "attachment_site", "pinch", "grasp", "flange",
    "tip",
)  # fmt: skip


# Motion limits of a joint whose robot.toml names none: slow enough to watch.
_DEFAULT_SPEED = {HINGE: 1.5, SLIDE: 0.25, BALL: 1.5, FREE: 0.5}  # rad/s or m/s
_SPEED_TO_ACCELERATION = 4.0  # 1/s: a quarter of a second to full speed


@dataclass(frozen=True)
class ModelFrame:
    """A named frame: rigidly fixed to a body of the model at ``local``."""

    name: str
    body: int
    local: Pose


# kg, kg m²: a model in millimetres is a billion times as heavy as it should be, and moves all the same.
_LARGEST_MASS = 1e100

# rad, m: a limit that was written with few digits is meant by a home beyond it, which is moved inside.
_ROUNDED = 1e-3

# Arrays of MuJoCo's model, one row a body, joint, …
_NUMBERS = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "body_iquat", "jnt_pos", "jnt_axis",
    "jnt_range", "site_pos", "site_quat", "geom_pos", "geom_quat", "geom_size", "qpos0", "key_qpos",
)  # fmt: skip


def read_model(
    source: Path | str | mujoco.MjSpec | mujoco.MjModel, path: Path
) -> tuple[mujoco.MjModel, dict[str, float], tuple[str, ...]]:
    """MuJoCo's model of an MJCF or URDF file, of such a text or of a spec, and what else a URDF says.

    Unnamed joints are called ``joint_<id>``.  A URDF keeps its fixed-joint frames, unless it asks for
    ``fusestatic``.  ``path`` is for messages.

    Returns:
        The model; a URDF's speed limits, joint -> rad/s or m/s; and the mesh files of a URDF that were left
        out, by their names there.  The last two are empty for anything but a URDF.

    Raises:
        ModelError: With the file and MuJoCo's reason; a joint whose lower limit is not below its upper; a
            number that is not finite or beyond ``LARGEST_NUMBER``.
    """
    if isinstance(source, mujoco.MjModel):
        return source, {}, ()
    spec, urdf = read_spec(source, path)
    with _as_model_error(path):
        _name_joints(spec)
        model = compiled(spec)
    _refuse_numbers(model, path)
    _refuse_ranges(model, path)
    _hint_at_radians(model, spec, path)
    if urdf is None:
        return model, {}, ()
    return model, urdf.velocity, urdf.missing_meshes


def read_spec(source: Path | str | mujoco.MjSpec, path: Path) -> tuple[mujoco.MjSpec, Urdf | None]:
    """What ``read_model`` compiles, for who adds to it; and the URDF that it was."""
    if isinstance(source, mujoco.MjSpec):
        return source.copy(), None
    urdf, text, folder = None, source, Path()
    if isinstance(source, Path):
        try:
            text = read_text(source, "the model", errors="replace")  # MuJoCo takes bytes that are no UTF-8
        except ConfigError as error:
            raise ModelError(str(error.args[0]), path=source, reason="it cannot be read") from error
        folder = source.parent
    if "<robot" in str(text):
        from robot_ik.urdf import Urdf  # which few robots need

        urdf = Urdf.of_text(str(text), folder)
        if urdf is not None and urdf.problem[0]:
            reason, hint = urdf.problem
            raise ModelError(f"{path}: {reason}", path=path, reason=reason, hint=hint)
    with _as_model_error(path):
        if urdf is None and isinstance(source, Path):
            return mujoco.MjSpec.from_file(str(source)), None
        return mujoco.MjSpec.from_string(str(source) if urdf is None else urdf.text()), urdf


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """MuJoCo's model, also of moving bodies without mass, or of an inertia that no body can have."""
    try:
        return spec.compile()
    except ValueError as error:
        if not any(word in str(error) for word in ("mjMINVAL", "balanceinertia")):
            raise
    # Kinematics asks for no mass; what has a right one keeps it.  Impossible inertias become those of a ball.
    spec.compiler.boundmass = max(spec.compiler.boundmass, _WEIGHTLESS)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, _WEIGHTLESS_INERTIA)
    spec.compiler.balanceinertia = True
    return spec.compile()


@contextmanager
def _as_model_error(path: Path) -> Iterator[None]:
    """Makes a ``ModelError`` of what MuJoCo refuses; logs what it warns of.

    What it would write to stderr and to a file MUJOCO_LOG.TXT in the user's folder says what of the model was
    not taken; the rest is about dynamics, for which no goal asks.
    """
    ignored: list[str] = []
    try:
        with _NOTING, warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter("always")
            before = mujoco.get_mju_user_warning()
            mujoco.set_mju_user_warning(ignored.append)
            try:
                yield
            finally:
                mujoco.set_mju_user_warning(before)
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        hint = "MJCF and URDF files are read; meshes must lie where the file says"
        if "find decoder" in reason:
            hint = "MuJoCo knows a model by the end of its name, .xml or .urdf; an arm file is one for --arm"
        raise ModelError(
            f"{path} is not a model that MuJoCo can read: {reason}",
            path=path,
            reason=reason,
            hint=hint,
        ) from error
    for text in ignored:
        _log.warning("%s: %s", path, " ".join(text.split()))
    for warning in noted:
        _log.info("%s: %s", path, warning.message)


def joint_names(model: mujoco.MjModel) -> list[str]:
    """Names of all joints, by MuJoCo id; ``joint_<id>`` where a model built in memory has none."""
    return [model.joint(j).name or f"joint_{j}" for j in range(model.njnt)]


def _name_joints(spec: mujoco.MjSpec) -> None:
    taken = {joint.name for joint in spec.joints}
    for k, joint in enumerate(spec.joints):
        if not joint.name:
            name = f"joint_{k}"
            while name in taken:
                name += "_"
            joint.name = name
            taken.add(name)


def _refuse_numbers(model: mujoco.MjModel, path: Path) -> None:
    """Raises ``ModelError`` for numbers without use; MuJoCo takes "nan", 1e308 and axes without length."""
    for name in _NUMBERS:
        rows = np.asarray(getattr(model, name))
        rows = rows[:, None] if rows.ndim == 1 else rows
        most = _LARGEST_MASS if name in ("body_mass", "body_inertia") else LARGEST_NUMBER
        wrong = ~(np.abs(rows) <= most).all(axis=1)
        if name.endswith(("axis", "quat")):
            wrong |= ~(np.linalg.norm(rows, axis=1) > 0.5)  # MuJoCo makes them 1 long; 1e308 becomes 0
        if wrong.any():
            kind, _, what = name.partition("_")
            number = int(np.argmax(wrong))
            owner = {"body": model.body, "jnt": model.joint, "site": model.site, "geom": model.geom}.get(kind)
            whose = f"{what} of {kind} {owner(number).name or number!r}" if owner else name
            reason = f"{whose} is {rows[number].tolist()}: not finite, too large or of no length"
            hint = f"finite numbers up to {most:g} are read"
            raise ModelError(f"{path}: {reason}", path=path, reason=reason, hint=hint)


def _hint_at_radians(model: mujoco.MjModel, spec: mujoco.MjSpec, path: Path) -> None:
    """Logs a hint where every hinge has a range of a few degrees: radians that were read as degrees."""
    hinges = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & model.jnt_limited.astype(bool)
    ends = np.abs(np.rad2deg(model.jnt_range[hinges]))
    if spec.compiler.degree and len(ends) and float(ends.max()) <= 2.0 * math.pi + 0.01:
        _log.warning(
            "%s: no joint turns further than %.2f degrees; if its ranges are in radians, "
            'it needs <compiler angle="radian"/>', path, float(ends.max()),
        )  # fmt: skip


def _refuse_ranges(model: mujoco.MjModel, path: Path) -> None:
    """Raises ``ModelError`` for a joint without a range; MuJoCo takes most of these for no limit at all."""
    for joint in range(model.njnt):
        low, high = model.jnt_range[joint].tolist()
        asked = bool(model.jnt_limited[joint]) or low != 0.0 or high != 0.0
        if asked and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE and not low < high:
            name = joint_names(model)[joint]
            raise ModelError(
                f"{path}: joint {name!r} has the range {low:g} … {high:g}, which leaves it no range",
                path=path,
                hint='write the lower limit first; to hold the joint still, remove it (URDF: type="fixed")',
            )


def home_qpos(model: mujoco.MjModel, path: Path, file: RobotFile) -> Array:
    """Whole qpos (model.nq,) of home: numbers or keyframe of robot.toml, "home", the first, else qpos0."""
    home = file.home
    if isinstance(home, tuple):
        _refuse_home(model, file, home)
        return np.array(home, dtype=float)
    keys = {model.key(k).name: k for k in range(model.nkey)}
    if home is None:
        home = "home" if "home" in keys else next(iter(keys), None)
    elif home not in keys:
        known = ", ".join(keys) or "none"
        raise ModelError(f"{file.path}: home: {path} has no keyframe {home!r}; it has: {known}", path=path)
    return np.array(model.qpos0 if home is None else model.key_qpos[keys[home]], dtype=float)


def _refuse_home(model: mujoco.MjModel, file: RobotFile, home: tuple[float, ...]) -> None:
    """Raises ``ConfigError`` unless it is model.nq numbers, of hinges and slides inside their limits."""
    names, where = joint_names(model), file.path or file.name
    if len(home) != model.nq:
        allowed = f"{model.nq}, rad and m, for the joints {', '.join(names)}"
        raise ConfigError(f"it has {len(home)} numbers", file=where, key="home", allowed=allowed)
    for joint, name in enumerate(names):
        unit = {HINGE: "rad", SLIDE: "m"}.get(_KIND_OF[int(model.jnt_type[joint])])
        value, (low, high) = home[model.jnt_qposadr[joint]], model.jnt_range[joint].tolist()
        if unit and model.jnt_limited[joint] and not low - _ROUNDED <= value <= high + _ROUNDED:
            asked, lower, upper = apart(value, low, high, digits=4, form="g")
            raise ConfigError(
                f"joint {name!r} at {asked} {unit} is outside its limits", file=where, key="home",
                allowed=f"{lower} to {upper} {unit}",
                hint=f"{asked} degrees are {math.radians(value):.4g} rad" if unit == "rad" else "",
            )  # fmt: skip


def model_frames(model: mujoco.MjModel, file: RobotFile) -> dict[str, ModelFrame]:
    """Every frame by name: the tools of robot.toml, then sites, then bodies; the first of a name counts."""
    sites, bodies, found = {}, {}, {}
    for s in range(model.nsite):
        if name := model.site(s).name:
            local = Pose(model.site_pos[s], model.site_quat[s])
            sites[name] = ModelFrame(name, int(model.site_bodyid[s]), local)
    for b in range(1, model.nbody):
        if name := model.body(b).name:
            bodies[name] = ModelFrame(name, b, Pose())
    for tool, target in file.tools.items():
        where = sites if target.site else bodies
        wanted = target.site or target.body or ""
        if wanted not in where:
            raise UnknownFrameError(wanted, where, hint=f"named by the tool {tool!r} of {file.path}")
        found[tool] = dataclasses.replace(where[wanted], name=tool)
    return found | {name: frame for name, frame in (sites | bodies).items() if name not in found}


def guess_tool(model: mujoco.MjModel, frames: dict[str, ModelFrame]) -> str:
    """Default frame of a model without robot.toml: a telling name, else the last site or body."""
    telling = [name for wanted in _TOOL_NAMES for name in frames if name.lower() == wanted]
    if telling:
        return telling[0]
    if model.nsite and model.site(model.nsite - 1).name:
        return str(model.site(model.nsite - 1).name)
    if not frames:
        raise ModelError("the model has neither a named site nor a named body, so nothing to aim")
    return list(frames)[-1]


def active_joints(names: list[str], joints: Sequence[str] | str | None, file: RobotFile) -> list[int]:
    """MuJoCo ids of the joints that may move: the asked ones, else the group ``arm``, else all."""
    for name, members in file.groups.items():
        require_joints(members, names, f"groups.{name} of {file.path}")
    group = joints if isinstance(joints, str) else "arm" if joints is None and "arm" in file.groups else None
    if group is not None and group not in file.groups:
        raise UnknownJointError(group, file.groups, hint="a single string names a joint group")
    wanted: object = file.groups[group] if group is not None else names if joints is None else joints
    if not isinstance(wanted, Iterable) or not all(isinstance(joint, str) for joint in wanted):
        raise UnknownJointError(shown(joints), names, hint="joints are a list of names, or a joint group")
    require_joints(wanted, names)
    return [j for j, joint in enumerate(names) if joint in set(wanted)]


def motion_limits(
    tree: Tree, joints: Sequence[str], names: Sequence[str], file: RobotFile
) -> tuple[Array, Array]:
    """Velocity and acceleration (nv,): from robot.toml where it names the joint, else by joint kind.

    ``joints`` are the active ones, ``names`` those of the model.

    Raises:
        UnknownJointError, ConfigError: robot.toml names another joint; a slide in degrees, a hinge in mm.
    """
    require_joints(file.slides, names, f"motion of {file.path}")
    kinds = dict(zip(joints, tree.kind.tolist(), strict=True))
    for joint, kind in kinds.items():
        if joint in (file.hinges if kind == SLIDE else file.slides):
            moves, unit, other = ("slides", "mm", "deg") if kind == SLIDE else ("does not slide", "deg", "mm")
            raise ConfigError(
                f"joint {joint!r} {moves}", file=file.path or file.name, key=f"motion.velocity_{other}",
                allowed=f"its limits in velocity_{unit} and acceleration_{unit}",
                hint=f"such as velocity_mm = {{ {joint} = 100.0 }}" if unit == "mm" else "",
            )  # fmt: skip
    speed = {joint: file.velocity.get(joint, _DEFAULT_SPEED[kind]) for joint, kind in kinds.items()}
    acceleration = [file.acceleration.get(joint, speed[joint] * _SPEED_TO_ACCELERATION) for joint in joints]
    return np.array(list(speed.values()))[tree.dof_node], np.array(acceleration)[tree.dof_node]


def joint_stiffness(tree: Tree, names: Sequence[str], file: RobotFile) -> Array:
    """Stiffness (nv,): from robot.toml where it names the joint, else 1; ``names`` of all joints."""
    require_joints(file.stiffness, names, f"stiffness of {file.path}")
    each = [file.stiffness.get(names[joint], 1.0) for joint in tree.joint_ids]
    return np.array(each)[tree.dof_node]


# The one place where an ``MjModel`` becomes a ``Tree``: every active joint becomes a node; bodies without
# active joints, frozen joints, anchors, axes and reference angles vanish into the constants between them.
_KIND_OF = {
    int(mujoco.mjtJoint.mjJNT_HINGE): HINGE,
    int(mujoco.mjtJoint.mjJNT_SLIDE): SLIDE,
    int(mujoco.mjtJoint.mjJNT_BALL): BALL,
    int(mujoco.mjtJoint.mjJNT_FREE): FREE,
}


@dataclass(frozen=True)
class Attachment:
    """Where something rigid sits: ``X_node · local`` (node -1 = world)."""

    node: int
    local: Pose


class _Builder:
    """Walks the bodies of a model once, root first."""

    def __init__(self, model: mujoco.MjModel, active: set[int], qpos: Array) -> None:
        self.model, self.active, self.qpos = model, active, qpos
        self.joint_ids: list[int] = []
        self.nodes: list[tuple[int, int, int, int]] = []  # kind, parent, where it begins in q and in dq
        self.constant: list[Array] = []
        self.bodies: list[Attachment] = [Attachment(-1, Pose())]
        self.nq = self.nv = 0

    def body(self, body: int) -> None:
        model = self.model
        base = self.bodies[int(model.body_parentid[body])]
        at = Attachment(base.node, base.local.compose(Pose(model.body_pos[body], model.body_quat[body])))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            at = self.joint(joint, at)
        self.bodies.append(at)

    def joint(self, joint: int, at: Attachment) -> Attachment:
        model, moves = self.model, joint in self.active
        kind, start = _KIND_OF[int(model.jnt_type[joint])], int(model.jnt_qposadr[joint])
        # The joint's own frame in its body: origin at the anchor, z of a hinge or slide along the axis.
        frame = Pose() if kind == FREE else Pose(model.jnt_pos[joint])
        if kind in (HINGE, SLIDE):
            axis = np.array(model.jnt_axis[joint])
            frame = frame.compose(Pose.from_rotation(rotation_z_to(axis / np.linalg.norm(axis))))
        node, place = (-1, Pose()) if kind == FREE else (at.node, at.local.compose(frame))
        if kind in (HINGE, SLIDE):
            z = np.array([0.0, 0.0, (0.0 if moves else self.qpos[start]) - model.qpos0[start]])
            place = place.compose(Pose(z) if kind == SLIDE else Pose(wxyz=rotation_exp(z)))
        elif not moves:
            q = self.qpos[start : start + Q_WIDTH[kind]]
            place = place.compose(Pose(q[:3], q[3:]) if kind == FREE else Pose(wxyz=q))
        if not moves:
            return Attachment(node, place.compose(frame.inverse()))
        self.joint_ids.append(joint)
        self.nodes.append((kind, node, self.nq, self.nv))
        self.constant.append(place.row)
        self.nq += Q_WIDTH[kind]
        self.nv += V_WIDTH[kind]
        return Attachment(len(self.nodes) - 1, frame.inverse())


def _limits(model: mujoco.MjModel, builder: _Builder) -> tuple[Array, Array, Array, Array]:
    """Limits (nv,) as MuJoCo has them, and finite ranges (nv,) to draw random starts from."""
    lower, upper = np.full(builder.nv, -np.inf), np.full(builder.nv, np.inf)
    low, high = np.full(builder.nv, -np.pi), np.full(builder.nv, np.pi)
    for joint, (kind, _, _, v) in zip(builder.joint_ids, builder.nodes, strict=True):
        if kind in (SLIDE, FREE):  # without limits: one metre either way
            shift = slice(v, v + (3 if kind == FREE else 1))
            low[shift], high[shift] = -1.0, 1.0
        if kind == FREE or not model.jnt_limited[joint]:
            continue
        if kind == BALL:
            lower[v : v + 3], upper[v : v + 3] = 0.0, model.jnt_range[joint, 1]
            high[v : v + 3] = model.jnt_range[joint, 1]
        else:
            lower[v], upper[v] = low[v], high[v] = model.jnt_range[joint]
    return lower, upper, low, high


def qpos_addresses(model: mujoco.MjModel, tree: Tree) -> NDArray[np.int64]:
    """(nq,): where the numbers of q stand in the model's whole qpos."""
    starts = zip(model.jnt_qposadr[list(tree.joint_ids)].tolist(), tree.kind.tolist(), strict=True)
    return np.array([start + i for start, kind in starts for i in range(Q_WIDTH[kind])], dtype=np.int64)


def build_tree(model: mujoco.MjModel, joints: list[int], qpos: Array) -> tuple[Tree, tuple[Attachment, ...]]:
    """Tree of a model in which only ``joints`` (MuJoCo ids) move; attachments of all bodies.

    The others are frozen where ``qpos`` (model.nq,) has them.
    """
    builder = _Builder(model, set(joints), qpos)
    for body in range(1, model.nbody):
        builder.body(body)
    kind, parent, qadr, vadr = np.array(builder.nodes, dtype=np.int64).reshape(-1, 4).T
    tree = Tree(
        tuple(builder.joint_ids), kind, parent, qadr, vadr,
        np.array(builder.constant).reshape(-1, 12), *_limits(model, builder), builder.nq, builder.nv,
    )  # fmt: skip
    return tree, tuple(builder.bodies)


def random_q(tree: Tree, home: Array, rng: np.random.Generator) -> Array:
    """A random q (nq,) inside the limits; a floating base within 1 m of home."""
    q = home.copy()
    for k in range(tree.size):
        a, v = int(tree.qadr[k]), int(tree.vadr[k])
        if tree.kind[k] in (HINGE, SLIDE):
            q[a] = rng.uniform(tree.low[v], tree.high[v])
            continue
        if tree.kind[k] == FREE:
            q[a : a + 3] = home[a : a + 3] + rng.uniform(-1.0, 1.0, 3)
            a, v = a + 3, v + 3
        axis = rng.normal(size=3)
        half = 0.5 * rng.uniform(0.0, min(float(tree.high[v]), np.pi))
        q[a] = np.cos(half)
        q[a + 1 : a + 4] = axis / np.linalg.norm(axis) * np.sin(half)
    return q

"""What a model file says by itself: MuJoCo's model, its frames, its home, and which frame is the tool."""

from __future__ import annotations

import dataclasses
import logging
import math
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_ik.catalogue import RobotFile
from robot_ik.errors import ConfigError, ModelError, UnknownFrameError, UnknownJointError
from robot_ik.files import LARGEST_NUMBER, read_text
from robot_ik.geometry import Pose
from robot_ik.kernels.tree import BALL, FREE, HINGE, SLIDE, V_WIDTH, Tree
from robot_ik.urdf import Urdf

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# What Python does with warnings is one setting of the whole process.
_NOTING = threading.Lock()

# Links without <inertial> weigh this much (kg, kg m²): MuJoCo compiles no moving body of nothing.
_WEIGHTLESS, _WEIGHTLESS_INERTIA = 1e-9, 1e-12
LEAST_MASS = 1e-6
"""kg; a robot of less was described without masses."""

# Site and body names that people give to the end of an arm, tried in this order.
_TOOL_NAMES = (
    "gripper", "tool", "tcp", "tool0", "ee", "end_effector", "attachment_site", "pinch", "grasp", "flange",
    "tip",
)  # fmt: skip


# Motion limits of a joint whose robot.toml names none: slow enough to watch.
_DEFAULT_SPEED = {HINGE: 1.5, SLIDE: 0.25, BALL: 1.5, FREE: 0.5}  # rad/s or m/s
_SPEED_TO_ACCELERATION = 4.0  # 1/s: a quarter of a second to full speed


@dataclass(frozen=True)
class Frame:
    """A named frame: rigidly fixed to a body of the model at ``local``."""

    name: str
    body: int
    local: Pose


_NUMBERS = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "body_iquat", "jnt_pos", "jnt_axis",
    "jnt_range", "site_pos", "site_quat", "geom_pos", "geom_quat", "geom_size", "qpos0", "key_qpos",
)  # fmt: skip
"""Arrays of MuJoCo's model, one row a body, joint, …"""


def read_model(source: Path | str | mujoco.MjSpec, path: Path) -> tuple[mujoco.MjModel, dict[str, float]]:
    """MuJoCo's model of an MJCF or URDF file, of such a text or of a spec, and a URDF's speed limits.

    Unnamed joints are called ``joint_<id>``.  A URDF keeps its fixed-joint frames, unless it asks for
    ``fusestatic``.

    Args:
        source: A file, its text, or a spec, which stays as it is.
        path: What to call it in messages.

    Returns:
        The model; and joint -> rad/s or m/s, empty for anything but a URDF.

    Raises:
        ModelError: With the file and MuJoCo's reason; a joint whose lower limit is not below its upper; a
            number that is not finite or beyond ``LARGEST_NUMBER``.
    """
    urdf = None
    if isinstance(source, Path):
        urdf = Urdf.of_text(_text_of(source), source.parent)
    elif isinstance(source, str):
        urdf = Urdf.of_text(source)
    try:
        with _warnings_noted(path):
            if isinstance(source, mujoco.MjSpec):
                spec = source.copy()
            elif urdf is not None or isinstance(source, str):
                spec = mujoco.MjSpec.from_string(source if urdf is None else urdf.text())
            else:
                spec = mujoco.MjSpec.from_file(str(source))
    except (ValueError, RuntimeError) as error:
        raise _unreadable(path, error) from error
    return compile_model(spec, path), {} if urdf is None else urdf.velocity


def _text_of(path: Path) -> str:
    try:
        return read_text(path, "the model", errors="replace")  # MuJoCo takes bytes that are no UTF-8
    except ConfigError as error:
        raise ModelError(str(error.args[0]), path=path, reason="it cannot be read") from error


def compile_model(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """The compiled model of ``spec``, which gets names for its unnamed joints.

    Raises:
        ModelError: As ``read_model``.
    """
    _name_joints(spec)
    try:
        with _warnings_noted(path):
            model = _compiled(spec)
    except (ValueError, RuntimeError) as error:
        raise _unreadable(path, error) from error
    _refuse_numbers(model, path)
    _refuse_ranges(model, path)
    _hint_at_radians(model, spec, path)
    return model


def _compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        if "mjMINVAL" not in str(error):  # a moving body without mass
            raise
    # Kinematics asks for no mass; what has one keeps it.
    spec.compiler.boundmass = max(spec.compiler.boundmass, _WEIGHTLESS)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, _WEIGHTLESS_INERTIA)
    return spec.compile()


@contextmanager
def _warnings_noted(path: Path) -> Iterator[None]:
    """Logs what MuJoCo warns of, such as masses that do not suffice for dynamics: no goal asks for them."""
    with _NOTING, warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        yield
    for warning in noted:
        _log.info("%s: %s", path, warning.message)


def _unreadable(path: Path, error: Exception) -> ModelError:
    reason = " ".join(str(error).split())
    return ModelError(
        f"{path} is not a model that MuJoCo can read: {reason}",
        path=path,
        reason=reason,
        hint="MJCF and URDF files are read; meshes must lie where the file says",
    )


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
        wrong = ~(np.abs(rows) <= LARGEST_NUMBER).all(axis=1)
        if name.endswith(("axis", "quat")):
            wrong |= ~(np.linalg.norm(rows, axis=1) > 0.5)  # MuJoCo makes them 1 long; 1e308 becomes 0
        if wrong.any():
            kind, _, what = name.partition("_")
            number = int(np.argmax(wrong))
            owner = {"body": model.body, "jnt": model.joint, "site": model.site, "geom": model.geom}.get(kind)
            whose = f"{what} of {kind} {owner(number).name or number!r}" if owner else name
            reason = f"{whose} is {rows[number].tolist()}: not finite, too large or of no length"
            hint = f"finite numbers up to {LARGEST_NUMBER:g} are read"
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
    """Raises ``ModelError`` for a joint without room; MuJoCo takes most of these for no limit at all."""
    for joint in range(model.njnt):
        low, high = model.jnt_range[joint].tolist()
        asked = bool(model.jnt_limited[joint]) or low != 0.0 or high != 0.0
        if asked and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE and not low < high:
            name = joint_names(model)[joint]
            raise ModelError(
                f"{path}: joint {name!r} has the range {low:g} … {high:g}, which leaves it no room",
                path=path,
                hint="write the lower limit first; to hold a joint still, leave it out of joints=[…]",
            )


def home_qpos(model: mujoco.MjModel, path: Path, file: RobotFile) -> Array:
    """Whole qpos (model.nq,) of the home keyframe: the named one, "home", the first, else qpos0."""
    if isinstance(file.home, tuple):
        if len(file.home) != model.nq:
            raise ModelError(f"{path}: home has {len(file.home)} numbers, the model {model.nq}", path=path)
        return np.array(file.home, dtype=float)
    keys = {model.key(k).name: k for k in range(model.nkey)}
    if file.home is not None and file.home not in keys:
        raise ModelError(
            f"{path} has no keyframe {file.home!r}; it has: {', '.join(keys) or 'none'}", path=path
        )
    chosen = file.home if file.home is not None else ("home" if "home" in keys else next(iter(keys), None))
    return np.array(model.qpos0 if chosen is None else model.key_qpos[keys[chosen]], dtype=float)


def model_frames(model: mujoco.MjModel, file: RobotFile) -> dict[str, Frame]:
    """Every frame by name: the tools of robot.toml, then sites, then bodies; the first of a name counts.

    Raises:
        UnknownFrameError: A tool names a site or body that the model does not have.
    """
    sites: dict[str, Frame] = {}
    for s in range(model.nsite):
        name = model.site(s).name
        if name:
            local = Pose(model.site_pos[s], model.site_quat[s])
            sites[name] = Frame(name, int(model.site_bodyid[s]), local)
    bodies = {
        model.body(b).name: Frame(model.body(b).name, b, Pose())
        for b in range(1, model.nbody)
        if model.body(b).name
    }
    found: dict[str, Frame] = {}
    for tool, target in file.tools.items():
        where = sites if target.site else bodies
        wanted = target.site or target.body or ""
        if wanted not in where:
            raise UnknownFrameError(wanted, where, hint=f"named by the tool {tool!r} of {file.path}")
        found[tool] = dataclasses.replace(where[wanted], name=tool)
    for name, frame in {**sites, **bodies}.items():
        found.setdefault(name, frame)
    return found


def guess_tool(model: mujoco.MjModel, frames: dict[str, Frame]) -> str:
    """Default frame of a model without robot.toml: a telling name, else the last site or body."""
    for wanted in _TOOL_NAMES:
        for name in frames:
            if name.lower() == wanted:
                return name
    if model.nsite and model.site(model.nsite - 1).name:
        return str(model.site(model.nsite - 1).name)
    if not frames:
        raise ModelError("the model has neither a named site nor a named body, so nothing to aim")
    return list(frames)[-1]


def active_joints(names: list[str], joints: Sequence[str] | str | None, file: RobotFile) -> list[int]:
    """MuJoCo ids of the joints that may move: the asked ones, else the group ``arm``, else all.

    Raises:
        UnknownJointError: With the close names.
    """
    if isinstance(joints, str):
        if joints not in file.groups:
            raise UnknownJointError(joints, file.groups, hint="a single string names a joint group")
        wanted: Sequence[str] = file.groups[joints]
    elif joints is not None:
        wanted = joints
    else:
        wanted = file.groups.get("arm", names)
    for joint in wanted:
        if joint not in names:
            raise UnknownJointError(joint, names)
    return [j for j, joint in enumerate(names) if joint in set(wanted)]


def motion_limits(tree: Tree, joints: Sequence[str], file: RobotFile) -> tuple[Array, Array]:
    """Velocity and acceleration (nv,): from robot.toml where it names the joint, else by joint kind."""
    speed, acceleration = np.empty(tree.nv), np.empty(tree.nv)
    for k, joint in enumerate(joints):
        kind, v = int(tree.kind[k]), int(tree.vadr[k])
        width = V_WIDTH[kind]
        fastest = file.velocity.get(joint, _DEFAULT_SPEED[kind])
        speed[v : v + width] = fastest
        acceleration[v : v + width] = file.acceleration.get(joint, fastest * _SPEED_TO_ACCELERATION)
    return speed, acceleration


def joint_stiffness(tree: Tree, names: Sequence[str], file: RobotFile) -> Array:
    """Stiffness (nv,) of the active joints: from robot.toml where it names the joint, else 1.

    ``names`` are those of all joints of the model.

    Raises:
        UnknownJointError: robot.toml names a joint that the model does not have.
    """
    for name in file.stiffness:
        if name not in names:
            raise UnknownJointError(name, names)
    stiffness = np.ones(tree.nv)
    for k, joint in enumerate(tree.joint_ids):
        v = int(tree.vadr[k])
        stiffness[v : v + V_WIDTH[int(tree.kind[k])]] = file.stiffness.get(names[joint], 1.0)
    return stiffness

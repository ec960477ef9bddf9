"""``load_robot``: MJCF, URDF or a catalogue name in, a ``Robot`` out (``robot_description.py``)."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from robot_ik.catalogue import RobotFile, find_robot
from robot_ik.couplings import declared_couplings, with_couplings
from robot_ik.errors import UnknownFrameError, UnsupportedJointError
from robot_ik.model_file import (
    active_joints,
    guess_tool,
    home_qpos,
    joint_names,
    joint_stiffness,
    model_frames,
    motion_limits,
    read_model,
)
from robot_ik.model_tree import build_tree
from robot_ik.robot_description import Robot

__all__ = ["Robot", "load_robot", "make_robot"]


def load_robot(
    name: str | os.PathLike[str] | mujoco.MjSpec,
    *,
    joints: Sequence[str] | str | None = None,
    tool: str | None = None,
) -> Robot:
    """Loads a robot by catalogue name, or any MJCF or MuJoCo-readable URDF by path, as text or as a spec.

    Args:
        name: ``"puma560"``; the path of a model file or of a folder with a ``robot.toml``;
            ``"robot_descriptions:panda_mj_description"``; the text of an MJCF or URDF (``"<mujoco>…"``);
            or an ``MjSpec``, which stays as it is.  The last two are named after the model.
        joints: Names of the joints that may move, or the name of a joint group; the rest are frozen at
            home.  Default: the group ``arm`` of ``robot.toml`` if it has one, else all joints.
        tool: Name of the default frame.

    Raises:
        UnknownRobotError: No such name; lists the close ones.
        ModelError: There is no such file, or the file cannot be read; carries MuJoCo's reason.
        UnknownJointError, UnknownFrameError: With the close names.
    """
    source: Path | str | mujoco.MjSpec
    if isinstance(name, mujoco.MjSpec) or (isinstance(name, str) and name.lstrip().startswith("<")):
        source, file = name, RobotFile(name="model")
        path = Path("<memory>/model")
    else:
        source, file = find_robot(name)
        path = source
    model, velocity = read_model(source, path)
    if path is not source:  # its own name
        file = dataclasses.replace(file, name=model.names[: model.names.index(b"\0")].decode() or "model")
        path = Path(f"<memory>/{file.name}")
    if velocity:
        file = dataclasses.replace(file, velocity={**velocity, **file.velocity})
    return make_robot(model, path, file, joints, tool)


def make_robot(
    model: mujoco.MjModel,
    path: Path,
    file: RobotFile,
    joints: Sequence[str] | str | None,
    tool: str | None,
) -> Robot:
    """A robot of MuJoCo's model and of what ``robot.toml`` says; the rest as in ``load_robot``."""
    names = joint_names(model)
    active = active_joints(names, joints, file)
    rest = home_qpos(model, path, file)
    tree, bodies = build_tree(model, active, rest)
    couplings = declared_couplings(model, file, names)
    tree = with_couplings(tree, couplings, rest, model.jnt_qposadr)
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
        stiffness=joint_stiffness(tree, names, file),
        home=np.empty(0),
        tool=default_tool,
        frozen_qpos=rest,
        file=file,
        couplings=tuple(couplings),
        _frames=frames,
        _bodies=bodies,
    )
    speed, acceleration = motion_limits(robot.tree, robot.joints, file)
    home = robot.follow(robot.clip(rest[robot._addresses]))
    return dataclasses.replace(robot, velocity=speed, acceleration=acceleration, home=home)

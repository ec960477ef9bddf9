"""``load_robot``: MJCF, URDF or a catalogue name in, a ``Robot`` out (``robot_description.py``)."""

from __future__ import annotations

import dataclasses
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
    joint_stiffness,
    model_frames,
    motion_limits,
    read_model,
)
from robot_ik.model_tree import build_tree
from robot_ik.robot_description import Robot

__all__ = ["Robot", "load_robot", "make_robot"]


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

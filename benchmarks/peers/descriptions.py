"""Plain descriptions of a robot, as MJCF and as URDF, for the readers of other libraries.

The readers and converters of other libraries need the plainest form: one hinge per body, which
rotates about the origin of the body. A body of our models may have several hinges with anchors.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from xml.etree import ElementTree

import mujoco
import numpy as np

from robot_ik.errors import UnsupportedJointError
from robot_ik.geometry import Pose, quat_to_matrix, rotation_z_to
from robot_ik.ports import Array
from robot_ik.robot import Robot

HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)

WHOLE_TURN = (-2 * math.pi, 2 * math.pi)
"""Range of a joint without limits, rad."""

_VERTICAL = 1e-9
"""Cosine of the pitch below which only the sum of roll and yaw counts."""


def plain_mjcf(robot: Robot, sites: Mapping[str, str]) -> str:
    """Return the MJCF text of a robot of hinges without geometry, on a free base or on none.

    The kinematics are the same. All joints stay active, in their order, so ``qpos`` means the same.

    Args:
        robot: The robot.
        sites: Frame of the robot by the name of the site. No other site is written.

    Raises:
        UnsupportedJointError: A joint is neither a hinge nor the free joint of the base.
    """
    model = robot.model
    root = ElementTree.Element("mujoco", model=robot.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    # For each body of the model: the written body that carries it, and its pose on that body.
    carriers = [(ElementTree.SubElement(root, "worldbody"), Pose())]
    for body in range(1, model.nbody):
        carrier, pose = carriers[int(model.body_parentid[body])]
        pose = pose.compose(Pose(model.body_pos[body], model.body_quat[body]))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            carrier, anchor = _joint_body(robot, joint, carrier, pose)
            pose = anchor.inverse()
        carriers.append((carrier, pose))
    for name, frame in sites.items():
        attached = robot.frame(frame)
        carrier, pose = carriers[attached.body]
        attributes = _pos_and_quat(pose.compose(attached.local))
        ElementTree.SubElement(carrier, "site", {"name": name} | attributes)
    keys = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(keys, "key", name="home", qpos=_numbers(robot.qpos(robot.home)))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _joint_body(
    robot: Robot, joint: int, carrier: ElementTree.Element, pose: Pose
) -> tuple[ElementTree.Element, Pose]:
    """Write a body with one joint at the anchor of that joint.

    Args:
        robot: The robot.
        joint: The joint.
        carrier: Written body that carries the new one.
        pose: Pose of the joint's body on the carrier.

    Returns:
        The new body, and the pose of its anchor in the joint's body.

    Raises:
        UnsupportedJointError: The joint is neither a hinge nor free, or its zero is not its
            reference.
    """
    model = robot.model
    name = model.joint(joint).name
    kind = int(model.jnt_type[joint])
    is_shifted = kind == HINGE and model.qpos0[model.jnt_qposadr[joint]] != 0.0
    if kind not in (HINGE, FREE) or is_shifted:
        raise UnsupportedJointError(
            f"joint {name!r} of {robot.name} is not a hinge with its zero at its reference",
            path=robot.path,
        )
    anchor = Pose(model.jnt_pos[joint] if kind == HINGE else np.zeros(3))
    attributes = {"name": f"at_{name}"} | _pos_and_quat(pose.compose(anchor))
    body = ElementTree.SubElement(carrier, "body", attributes)
    inertia = "0.01 0.01 0.01"
    ElementTree.SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia=inertia)
    if kind == FREE:
        ElementTree.SubElement(body, "freejoint", name=name)
        return body, anchor
    hinge = {"name": name, "type": "hinge", "axis": _numbers(model.jnt_axis[joint])}
    if model.jnt_limited[joint]:
        hinge["range"] = _numbers(model.jnt_range[joint])
    ElementTree.SubElement(body, "joint", hinge)
    return body, anchor


def _pos_and_quat(pose: Pose) -> dict[str, str]:
    """Return the attributes of a pose. A rotation by zero is left out."""
    attributes = {"pos": _numbers(pose.position)}
    if not np.array_equal(np.abs(pose.wxyz), (1.0, 0.0, 0.0, 0.0)):
        attributes["quat"] = _numbers(pose.wxyz)
    return attributes


def _numbers(values: Iterable[float]) -> str:
    """Return numbers as an XML attribute."""
    return " ".join(repr(float(value)) for value in values)


def frames_of(model: mujoco.MjModel) -> Array:
    """Return the constant transforms (n + 1, 4, 4) of a plain chain.

    They lead from the base to the first axis z, from axis to axis, and to the site.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    previous = np.eye(4)
    transforms = []
    for point, axis in zip(data.xanchor, data.xaxis, strict=True):
        frame = np.eye(4)
        frame[:3, :3] = rotation_z_to(axis)
        frame[:3, 3] = point
        transforms.append(np.linalg.inv(previous) @ frame)
        previous = frame
    site = np.eye(4)
    site[:3, :3] = data.site_xmat[0].reshape(3, 3)
    site[:3, 3] = data.site_xpos[0]
    transforms.append(np.linalg.inv(previous) @ site)
    return np.array(transforms)


def urdf_of(model: mujoco.MjModel) -> str:
    """Return the URDF text of a plain model. Sites become links.

    A robot on the ground begins at a link ``base``, a floating one at its floating body.
    """
    robot = ElementTree.Element("robot", name="plain")
    is_floating = int(model.jnt_type[0]) == FREE
    if not is_floating:
        ElementTree.SubElement(robot, "link", name="base")
    for body in range(1, model.nbody):
        name = _link_name(model, body)
        _add_link(robot, name)
        if is_floating and body == 1:
            continue
        joint = int(model.body_jntadr[body])
        parent = _link_name(model, int(model.body_parentid[body]))
        pose = Pose(model.body_pos[body], model.body_quat[body])
        element = _add_joint(robot, model.joint(joint).name, "revolute", (parent, name), pose)
        ElementTree.SubElement(element, "axis", xyz=_numbers(model.jnt_axis[joint]))
        lower, upper = model.jnt_range[joint] if model.jnt_limited[joint] else WHOLE_TURN
        limits = {"lower": repr(float(lower)), "upper": repr(float(upper))}
        ElementTree.SubElement(element, "limit", limits, effort="100", velocity="100")
    for k in range(model.nsite):
        site = model.site(k).name
        _add_link(robot, site)
        parent = _link_name(model, int(model.site_bodyid[k]))
        pose = Pose(model.site_pos[k], model.site_quat[k])
        _add_joint(robot, f"to_{site}", "fixed", (parent, site), pose)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _link_name(model: mujoco.MjModel, body: int) -> str:
    return "base" if body == 0 else str(model.body(body).name)


def _add_link(robot: ElementTree.Element, name: str) -> None:
    """Add a link of one kilogram."""
    link = ElementTree.SubElement(robot, "link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value="1")
    ElementTree.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    inertia = {"ixx": "0.01", "iyy": "0.01", "izz": "0.01"}
    zero = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ElementTree.SubElement(inertial, "inertia", inertia | zero)


def _add_joint(
    robot: ElementTree.Element, name: str, kind: str, links: tuple[str, str], pose: Pose
) -> ElementTree.Element:
    """Add a joint between two links, parent and child."""
    parent, child = links
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    rpy = _numbers(roll_pitch_yaw(pose.wxyz))
    ElementTree.SubElement(joint, "origin", xyz=_numbers(pose.position), rpy=rpy)
    return joint


def roll_pitch_yaw(wxyz: Array) -> Array:
    """Return the angles (3,) of a URDF: rotations about the fixed axes x, then y, then z."""
    r = quat_to_matrix(np.asarray(wxyz, dtype=float))
    cosine = math.hypot(r[0, 0], r[1, 0])
    pitch = math.atan2(-r[2, 0], cosine)
    if cosine < _VERTICAL:
        return np.array([0.0, pitch, math.atan2(-r[0, 1], r[1, 1])])
    return np.array([math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])])

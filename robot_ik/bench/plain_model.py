"""A robot written out in the plainest MJCF: one hinge a body, turning about the body's own origin.

Other libraries' readers and converters ask for that form; a body of ours may carry several hinges with
anchors of their own.  The kinematics are the same, which a test holds to MuJoCo.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping

import mujoco
import numpy as np

from robot_ik.errors import UnsupportedJointError
from robot_ik.geometry import Pose
from robot_ik.robot import Robot

_HINGE, _FREE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)


def plain_mjcf(robot: Robot, sites: Mapping[str, str]) -> str:
    """MJCF text of a robot of hinges, on a free base or none, without geometry.

    Args:
        robot: Whose model; all of its joints stay active, in their order, so ``qpos`` means the same.
        sites: New name -> frame of the robot; only these are written.

    Raises:
        UnsupportedJointError: A joint that is neither a hinge nor the base's free joint.
    """
    return _Writer(robot, sites).text()


class _Writer:
    def __init__(self, robot: Robot, sites: Mapping[str, str]) -> None:
        self.robot, self.sites, self.model = robot, sites, robot.model
        self.root = ElementTree.Element("mujoco", model=robot.name)
        ElementTree.SubElement(self.root, "compiler", angle="radian", autolimits="true")
        world = ElementTree.SubElement(self.root, "worldbody")
        # For each body of the model: the written body that carries it, and where it sits on that one.
        self.carriers: list[tuple[ElementTree.Element, Pose]] = [(world, Pose())]

    def text(self) -> str:
        for body in range(1, self.model.nbody):
            self.carriers.append(self.body(body))
        for name, frame in self.sites.items():
            at = self.robot.frame(frame)
            carrier, local = self.carriers[at.body]
            ElementTree.SubElement(carrier, "site", {"name": name} | _place(local.compose(at.local)))
        keys = ElementTree.SubElement(self.root, "keyframe")
        ElementTree.SubElement(keys, "key", name="home", qpos=_numbers(self.robot.qpos(self.robot.home)))
        ElementTree.indent(self.root)
        return ElementTree.tostring(self.root, encoding="unicode") + "\n"

    def body(self, body: int) -> tuple[ElementTree.Element, Pose]:
        model = self.model
        carrier, at = self.carriers[int(model.body_parentid[body])]
        at = at.compose(Pose(model.body_pos[body], model.body_quat[body]))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            name, kind = model.joint(joint).name, int(model.jnt_type[joint])
            if kind not in (_HINGE, _FREE) or (kind == _HINGE and model.qpos0[model.jnt_qposadr[joint]]):
                raise UnsupportedJointError(
                    f"joint {name!r} of {self.robot.name} is no hinge with its zero at its reference",
                    path=self.robot.path,
                )
            anchor = Pose(model.jnt_pos[joint] if kind == _HINGE else np.zeros(3))
            carrier = ElementTree.SubElement(
                carrier, "body", {"name": f"at_{name}"} | _place(at.compose(anchor))
            )
            ElementTree.SubElement(carrier, "inertial", pos="0 0 0", mass="1", diaginertia="0.01 0.01 0.01")
            if kind == _FREE:
                ElementTree.SubElement(carrier, "freejoint", name=name)
            else:
                about = {"name": name, "type": "hinge", "axis": _numbers(model.jnt_axis[joint])}
                if model.jnt_limited[joint]:
                    about["range"] = _numbers(model.jnt_range[joint])
                ElementTree.SubElement(carrier, "joint", about)
            at = anchor.inverse()
        return carrier, at


def _place(pose: Pose) -> dict[str, str]:
    place = {"pos": _numbers(pose.position)}
    if not np.array_equal(np.abs(pose.wxyz), (1.0, 0.0, 0.0, 0.0)):
        place["quat"] = _numbers(pose.wxyz)
    return place


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)

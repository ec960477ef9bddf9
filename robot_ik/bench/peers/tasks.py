"""A robot and its seeded problems, written so that any library can read them: MJCF, URDF, arrays."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from robot_ik.bench.methods.problems import ProblemSet, make_set
from robot_ik.errors import UnsupportedJointError
from robot_ik.files import make_folder, plain, write_atomically
from robot_ik.geometry import Pose, quat_to_matrix, rotation_z_to
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

#: Asked of every library, m and rad.
TIGHT = (1e-6, 1e-6)
#: The arms, and the figure with four goals; each ends in these sites.
ARMS = ("puma560", "ur5e", "panda")
FIGURE = "humanoid"
FIGURE_SITES = {
    "left_palm": "left_hand",
    "right_palm": "right_hand",
    "left_foot": "left_foot",
    "right_foot": "right_foot",
}
# Of the four goals: how far joints go, as a share of the distance to random angles, and the base, m.
_AWAY, _BASE_M, _POINTS_TOLERANCE = 0.5, 0.1, 1e-4
_FAR, _PROBES = 30, 20
_BASE = 7  # numbers of a free base in qpos
_HINGE, _FREE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)


def write_task(name: str, folder: Path, count: int, seed: int) -> Path:
    """Writes a robot (of ``ARMS``, or ``FIGURE``) and its problems, ``count`` of a kind (30 out of reach)."""
    make_folder(folder)
    robot = load_robot(name)
    figure = name == FIGURE
    model = mujoco.MjModel.from_xml_string(
        written := plain_mjcf(robot, FIGURE_SITES if figure else {"ee": robot.tool})
    )
    write_atomically(folder / "model.xml", written)
    write_atomically(folder / "model.urdf", urdf_of(model))
    base = _BASE if model.nq > model.njnt else 0
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == _HINGE]
    limits = np.where(
        model.jnt_limited[hinges][:, None], model.jnt_range[hinges], (-2 * math.pi, 2 * math.pi)
    )
    facts = {
        "robot": name,
        "joints": [model.joint(j).name for j in hinges],
        "lower": limits[:, 0],
        "upper": limits[:, 1],
        "home": robot.qpos(robot.home),
        "sites": [model.site(k).name for k in range(model.nsite)],
        "free_base": bool(base),
        "frames": [] if base else frames_of(model),
        "position": _POINTS_TOLERANCE if figure else TIGHT[0],
        "angle": TIGHT[1],
    }
    write_atomically(folder / "task.json", json.dumps(plain(facts)))
    made = load_robot(folder / "model.xml")
    arrays = _four_goals(made, count, seed) if figure else _poses(robot, count, seed)
    np.savez(folder / "problems.npz", **arrays)  # type: ignore[arg-type]
    return folder


# ------------------------------------------------------------------------------------------ problems


def _poses(robot: Robot, count: int, seed: int) -> dict[str, Array]:
    rng = np.random.default_rng([seed, 9])
    found = {"probes": np.array([robot.sample(rng) for _ in range(_PROBES)])}
    for kind, many in (("cold", count), ("warm", count), ("unreachable", _FAR)):
        problems = make_set(kind, robot, many, seed)
        found[f"{kind}_targets"], found[f"{kind}_starts"] = problems.targets, _starts(problems)
    for kind, fixed in _singular(robot).items():
        angles = np.array([robot.sample(rng) for _ in range(max(count // 10, _PROBES))])
        for joint, angle in fixed.items():
            angles[:, robot.joints.index(joint)] = angle
        found[f"{kind}_targets"] = np.array([robot.measure(q).matrix for q in angles])
        found[f"{kind}_starts"] = np.repeat(robot.home[None], len(angles), axis=0)
    return found


def _starts(problems: ProblemSet) -> Array:
    """All from home; on a path, from the joint angles of the pose before, the same for every library."""
    if problems.tracking:
        return np.concatenate([problems.first[None], problems.witnesses[:-1]])
    return np.repeat(problems.first[None], len(problems), axis=0)


def _singular(robot: Robot) -> dict[str, dict[str, float]]:
    """Joint angles at which the PUMA is exactly singular: axes 4 and 6 in line; the arm stretched."""
    if robot.name != "puma560":
        return {}

    def far(angle: float) -> float:
        q = robot.home.copy()
        q[2] = angle
        away = robot.forward(q, "flange").position - robot.forward(q, "link2").position
        return float(away @ away)

    # The distance squared is c + a cos + b sin of the angle: three values give its maximum.
    zero, quarter, half = far(0.0), far(0.5 * math.pi), far(math.pi)
    middle = 0.5 * (zero + half)
    stretched = math.atan2(quarter - middle, zero - middle)
    return {"wrist": {robot.joints[4]: 0.0}, "elbow": {robot.joints[2]: stretched}}


def site_names(robot: Robot) -> list[str]:
    """Of a plain robot: where its goals are."""
    return [robot.model.site(k).name for k in range(robot.model.nsite)]


def _four_goals(robot: Robot, count: int, seed: int) -> dict[str, Array]:
    """Positions (n, 4, 3) of a plain figure's sites at random joint angles, and along a smooth path."""
    rng, sites, home = np.random.default_rng([seed, 4]), site_names(robot), robot.home
    lower, upper = robot.lower[6:], robot.upper[6:]
    cold = np.repeat(home[None], count, axis=0)
    cold[:, _BASE:] += _AWAY * (rng.uniform(lower, upper, (count, len(lower))) - home[_BASE:])
    cold[:, :3] += rng.uniform(-_BASE_M, _BASE_M, (count, 3))
    pace, phase = rng.uniform(0.5, 1.5, len(lower)), rng.uniform(0.0, 2.0 * math.pi, len(lower))
    swing = 0.15 * np.minimum(upper - lower, 2.0)
    middle = np.clip(home[_BASE:], lower + swing, upper - swing)
    warm = np.repeat(home[None], count + 1, axis=0)
    times = 0.01 * np.arange(count + 1)[:, None]
    warm[:, _BASE:] = middle + swing * np.sin(pace * times + phase)
    return {
        "probes": np.empty((0, len(home))),
        "cold_targets": np.array([[robot.measure(q, site).position for site in sites] for q in cold]),
        "cold_starts": np.repeat(home[None], count, axis=0),
        "warm_targets": np.array([[robot.measure(q, site).position for site in sites] for q in warm[1:]]),
        "warm_starts": warm[:-1],
    }


# ------------------------------------------------------------------------------------- descriptions
#
# Other libraries' readers and converters ask for the plainest form: one hinge a body, rotating about the
# body's own origin; a body of ours may carry several hinges with anchors of their own.


def plain_mjcf(robot: Robot, sites: Mapping[str, str]) -> str:
    """MJCF text of a robot of hinges, on a free base or none, without geometry; its kinematics are the same.

    All joints stay active, in their order, so ``qpos`` means the same.  ``sites``, new name -> frame of the
    robot, are the only ones written.

    Raises:
        UnsupportedJointError: A joint that is neither a hinge nor the base's free joint.
    """
    model = robot.model
    root = ElementTree.Element("mujoco", model=robot.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    # For each body of the model: the written body that carries it, and where it sits on that one.
    carriers = [(ElementTree.SubElement(root, "worldbody"), Pose())]
    for body in range(1, model.nbody):
        carrier, at = carriers[int(model.body_parentid[body])]
        at = at.compose(Pose(model.body_pos[body], model.body_quat[body]))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            carrier, anchor = _plain_joint(robot, joint, carrier, at)
            at = anchor.inverse()
        carriers.append((carrier, at))
    for name, frame in sites.items():
        place = robot.frame(frame)
        carrier, local = carriers[place.body]
        ElementTree.SubElement(carrier, "site", {"name": name} | _pos_and_quat(local.compose(place.local)))
    keys = ElementTree.SubElement(root, "keyframe")
    ElementTree.SubElement(keys, "key", name="home", qpos=_numbers(robot.qpos(robot.home)))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _plain_joint(
    robot: Robot, joint: int, carrier: ElementTree.Element, at: Pose
) -> tuple[ElementTree.Element, Pose]:
    """A joint on a body of its own at its anchor, which hangs on ``carrier``; and that anchor."""
    model = robot.model
    name, kind = model.joint(joint).name, int(model.jnt_type[joint])
    if kind not in (_HINGE, _FREE) or (kind == _HINGE and model.qpos0[model.jnt_qposadr[joint]]):
        raise UnsupportedJointError(
            f"joint {name!r} of {robot.name} is no hinge with its zero at its reference", path=robot.path
        )
    anchor = Pose(model.jnt_pos[joint] if kind == _HINGE else np.zeros(3))
    made = ElementTree.SubElement(carrier, "body", {"name": f"at_{name}"} | _pos_and_quat(at.compose(anchor)))
    ElementTree.SubElement(made, "inertial", pos="0 0 0", mass="1", diaginertia="0.01 0.01 0.01")
    if kind == _FREE:
        ElementTree.SubElement(made, "freejoint", name=name)
        return made, anchor
    about = {"name": name, "type": "hinge", "axis": _numbers(model.jnt_axis[joint])}
    if model.jnt_limited[joint]:
        about["range"] = _numbers(model.jnt_range[joint])
    ElementTree.SubElement(made, "joint", about)
    return made, anchor


def _pos_and_quat(pose: Pose) -> dict[str, str]:
    attributes = {"pos": _numbers(pose.position)}
    if not np.array_equal(np.abs(pose.wxyz), (1.0, 0.0, 0.0, 0.0)):
        attributes["quat"] = _numbers(pose.wxyz)
    return attributes


def _numbers(values: Iterable[float]) -> str:
    """As XML has them."""
    return " ".join(repr(float(v)) for v in values)


def frames_of(model: mujoco.MjModel) -> Array:
    """(n + 1, 4, 4) transforms of a plain chain: from the base to the first axis z, …, to the site."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    before, found = np.eye(4), []
    for point, axis in zip(data.xanchor, data.xaxis, strict=True):
        here = np.eye(4)
        here[:3, :3], here[:3, 3] = rotation_z_to(axis), point
        found.append(np.linalg.inv(before) @ here)
        before = here
    end = np.eye(4)
    end[:3, :3], end[:3, 3] = data.site_xmat[0].reshape(3, 3), data.site_xpos[0]
    found.append(np.linalg.inv(before) @ end)
    return np.array(found)


def urdf_of(model: mujoco.MjModel) -> str:
    """URDF text of a plain model: one hinge a body at the body's origin; sites become links of their own.

    A robot on the ground starts at a link ``base``, one that floats at its floating body.
    """
    robot = ElementTree.Element("robot", name="plain")
    floating = int(model.jnt_type[0]) == _FREE
    if not floating:
        ElementTree.SubElement(robot, "link", name="base")

    def name_of(body: int) -> str:
        return "base" if body == 0 else str(model.body(body).name)

    for body in range(1, model.nbody):
        _link(robot, name_of(body))
        if floating and body == 1:
            continue
        joint = int(model.body_jntadr[body])
        lower, upper = model.jnt_range[joint] if model.jnt_limited[joint] else (-2 * math.pi, 2 * math.pi)
        made = _joint(
            robot, model.joint(joint).name, "revolute", name_of(int(model.body_parentid[body])),
            name_of(body), model.body_pos[body], model.body_quat[body],
        )  # fmt: skip
        ElementTree.SubElement(made, "axis", xyz=_numbers(model.jnt_axis[joint]))
        ElementTree.SubElement(
            made, "limit", lower=repr(float(lower)), upper=repr(float(upper)), effort="100", velocity="100"
        )
    for k in range(model.nsite):
        site = model.site(k).name
        _link(robot, site)
        parent = name_of(int(model.site_bodyid[k]))
        _joint(robot, f"to_{site}", "fixed", parent, site, model.site_pos[k], model.site_quat[k])
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _link(robot: ElementTree.Element, name: str) -> None:
    inertial = ElementTree.SubElement(ElementTree.SubElement(robot, "link", name=name), "inertial")
    ElementTree.SubElement(inertial, "mass", value="1")
    ElementTree.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    zero = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    ElementTree.SubElement(inertial, "inertia", {"ixx": "0.01", "iyy": "0.01", "izz": "0.01", **zero})


def _joint(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str, position: Array, wxyz: Array
) -> ElementTree.Element:
    made = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(made, "parent", link=parent)
    ElementTree.SubElement(made, "child", link=child)
    ElementTree.SubElement(made, "origin", xyz=_numbers(position), rpy=_numbers(roll_pitch_yaw(wxyz)))
    return made


def roll_pitch_yaw(wxyz: Array) -> Array:
    """(3,) of a URDF: rotations about fixed x, then y, then z."""
    r = quat_to_matrix(np.asarray(wxyz, dtype=float))
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    if math.hypot(r[0, 0], r[1, 0]) < 1e-9:  # only the sum of roll and yaw counts
        return np.array([0.0, pitch, math.atan2(-r[0, 1], r[1, 1])])
    return np.array([math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])])

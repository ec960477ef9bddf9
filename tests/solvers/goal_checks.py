"""Goals of every kind, and their errors without ``Goal.error``.

The errors are computed from the public fields of a goal and from MuJoCo's forward pass.
"""

from functools import cache

import mujoco
import numpy as np

from robot_ik.compiled_goals import length_scale
from robot_ik.goals import (
    AimGoal,
    CenterOfMassGoal,
    HalfSpaceGoal,
    LineGoal,
    OrientationGoal,
    PlaneGoal,
    PoseGoal,
    PositionGoal,
    PostureGoal,
    Tolerance,
)

TOLERANCE = Tolerance(position=1e-5, angle=1e-4)
KINDS = (
    "position",
    "height",
    "orientation",
    "axis",
    "pose",
    "drill",
    "aim",
    "line",
    "plane",
    "wall",
    "mass",
    "balance",
    "posture",
    "some joints",
)
# The frame and the axis that point, and the body whose mass counts.
LOOKS = {"humanoid": ("gaze", "x"), "puma560": (None, "z"), "srs_arm": (None, "-y")}
BODY = {"humanoid": "right_upper_arm", "puma560": None, "srs_arm": None}


def goals_met_at(robot, q):
    """Return goals of every kind and part that are met at q (nq,), by their names in the tests."""
    pose = robot.forward(q)
    (eye, axis) = LOOKS[robot.name]
    eye_pose = robot.forward(q, eye)
    body = BODY[robot.name]
    sign, letter = (-1, axis[1:]) if axis[0] == "-" else (1, axis)
    point = eye_pose.apply(0.6 * sign * np.eye(3)["xyz".index(letter)])
    slant = np.array([0.6, 0.0, 0.8])
    return {
        "position": PositionGoal(None, pose.position, weight=2.0),
        "height": PositionGoal(None, pose.position, axes="z"),
        "orientation": OrientationGoal(None, pose.wxyz),
        "axis": OrientationGoal(None, pose.wxyz, free_axis=(0, 3, 4)),
        "pose": PoseGoal.at(None, pose),
        "drill": PoseGoal(None, pose.position, pose.wxyz, free_axis="z", angle_weight=0.7),
        "aim": AimGoal(eye, point, axis=axis),
        "line": LineGoal(None, pose.position + 0.3 * slant, slant),
        "plane": PlaneGoal(None, pose.position + 0.3 * np.array([0.8, 0.0, -0.6]), slant),
        "wall": HalfSpaceGoal(None, pose.position - 0.01 * slant, slant),
        "mass": CenterOfMassGoal(body, robot.center_of_mass(q, body)),
        "balance": CenterOfMassGoal(body, robot.center_of_mass(q, body), axes="xy"),
        "posture": PostureGoal(q=q),
        "some joints": PostureGoal(
            q=q, joints={robot.joints[-1]: 3.0, robot.joints[-3]: 1.0}, only_named=True
        ),
    }


def near(robot, seed, way=0.35):
    """Return a q (nq,) inside the limits near home."""
    rng = np.random.default_rng(seed)
    return robot.clip(robot.integrate(robot.home, rng.uniform(-way, way, robot.nv)))


@cache
def goals_near(robot, seed):
    """``goals_met_at`` a q that is ``near`` home."""
    return goals_met_at(robot, near(robot, seed))


@cache
def data_of(robot):
    """One work space of MuJoCo for each robot."""
    return mujoco.MjData(robot.model)


AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


def direction(axis):
    if isinstance(axis, str):
        return np.array(AXES[axis[-1]], dtype=float) * (-1 if axis[0] == "-" else 1)
    return np.array(axis, dtype=float) / np.linalg.norm(axis)


def angle_between(a, b):
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))


def measured(robot, q, goal):
    """Return the error in metres and radians, from MuJoCo's data and the goal's public fields."""
    model = robot.model
    data = data_of(robot)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    if isinstance(goal, PostureGoal):
        return joint_errors(robot, data.qpos, goal)
    if isinstance(goal, CenterOfMassGoal):
        off = goal.position - data.subtree_com[model.body(goal.frame).id if goal.frame else 0]
        return float(np.linalg.norm([off["xyz".index(a)] for a in goal.axes])), 0.0
    site = data.site(goal.frame or robot.tool)
    here = site.xpos
    rotation = site.xmat.reshape(3, 3)
    if isinstance(goal, PositionGoal):
        off = goal.position - here
        return float(np.linalg.norm([off["xyz".index(a)] for a in goal.axes])), 0.0
    if isinstance(goal, AimGoal):
        return 0.0, angle_between(rotation @ direction(goal.axis), goal.point - here)
    if isinstance(goal, OrientationGoal | PoseGoal):
        wanted = np.zeros(9)
        mujoco.mju_quat2Mat(wanted, np.asarray(goal.wxyz))
        wanted = wanted.reshape(3, 3)
        metres = float(np.linalg.norm(goal.position - here)) if isinstance(goal, PoseGoal) else 0.0
        if goal.free_axis is not None:
            return metres, angle_between(
                rotation @ direction(goal.free_axis), wanted @ direction(goal.free_axis)
            )
        rotation_left = rotation.T @ wanted
        sine = 0.5 * np.linalg.norm(
            [
                rotation_left[2, 1] - rotation_left[1, 2],
                rotation_left[0, 2] - rotation_left[2, 0],
                rotation_left[1, 0] - rotation_left[0, 1],
            ]
        )
        return metres, float(np.arctan2(sine, 0.5 * (np.trace(rotation_left) - 1)))
    normal = direction(goal.direction)
    off = goal.point - here
    along = float(normal @ off)
    across = {
        LineGoal: np.linalg.norm(off - along * normal),
        PlaneGoal: abs(along),
        HalfSpaceGoal: max(along, 0.0),
    }
    return float(across[type(goal)]), 0.0


def joint_errors(robot, qpos, goal):
    """Return the largest distance of a joint that counts, metres and radians."""
    model = robot.model
    way = np.zeros(robot.model.nv)
    mujoco.mj_differentiatePos(model, way, 1.0, qpos, robot.qpos(goal.q))
    metres = radians = 0.0
    for name in robot.joints:
        if goal.joints.get(name, 0.0 if goal.only_named else 1.0) == 0.0:
            continue
        joint = model.joint(name)
        first = int(model.joint(name).dofadr[0])
        if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
            metres = max(metres, np.abs(way[first : first + 3]).max())
            radians = max(radians, np.linalg.norm(way[first + 3 : first + 6]))
        else:
            radians = max(radians, abs(way[first]))
    return metres, radians


def cost(problem, q):
    """Return the minimised cost in rad², measured by MuJoCo. Not for postures."""
    total = 0.0
    for goal in problem.goals:
        metres, radians = measured(problem.robot, q, goal)
        a, b = goal.weights
        total += 0.5 * ((a * metres / length_scale(problem.robot, goal)) ** 2 + (b * radians) ** 2)
    return total

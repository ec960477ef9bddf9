"""BVH: written files are read back equal, and a skeleton of other proportions is retargeted."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.errors import ConfigError, ModelError, TrajectoryError, UnsupportedJointError
from robot_ik.figure.motion.bvh import BVH_AXES, Bvh, BvhJoint, export_bvh, exported_motion
from robot_ik.figure.motion.retarget import SkeletonMap, retarget
from robot_ik.motion import Keyframes, KeyPoses

Array = NDArray[np.float64]


def some_motion(robot: rik.Robot, size: float = 0.3) -> Keyframes:
    rng = np.random.default_rng(1)
    keys = [
        robot.clip(robot.integrate(robot.home, size * rng.standard_normal(robot.nv)))
        for _ in range(3)
    ]
    return Keyframes.through(robot, keys, velocity_limits=6.0)


@pytest.fixture(scope="module")
def humanoid() -> rik.Robot:
    return rik.load_robot("humanoid")


@pytest.mark.parametrize("name", ["humanoid", "lion", "puma560"])
def test_a_motion_is_read_back_equal_and_stands_where_mujoco_says(
    name: str, tmp_path: Path
) -> None:
    robot = rik.load_robot(name)
    motion = some_motion(robot)
    made = export_bvh(motion, 30.0)
    made.save(tmp_path / "motion.bvh")
    read = Bvh.load(tmp_path / "motion.bvh")
    assert read.joints == made.joints and (read.values == made.values).all() and read.rate == 30.0
    again = exported_motion(read, robot)
    frames = motion.sampled(30.0)
    differences = [
        np.abs(robot.difference(a, b)).max() for a, b in zip(frames.q, again.q, strict=True)
    ]
    assert max(differences) < 1e-10  # degrees to 17 digits, and one tilted hinge through a matrix
    # Each BVH joint is at the MuJoCo anchor of its joints.
    positions, _ = read.poses()
    data = mujoco.MjData(robot.model)
    for k in range(0, len(frames), 9):
        data.qpos[:] = robot.qpos(frames.q[k])
        mujoco.mj_kinematics(robot.model, data)
        for j, joint in enumerate(read.joints):
            if joint.name != "base":
                body = robot.model.body(joint.name)
                anchor = data.xanchor[int(body.jntadr[0])]
                assert np.abs(BVH_AXES @ anchor - positions[k, j] / 100.0).max() < 1e-12


def test_a_robot_that_slides_has_no_bvh() -> None:
    body = "<body name='b'><joint name='s' type='slide'/><geom size='.1'/></body>"
    robot = rik.load_robot(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(UnsupportedJointError, match="slides"):
        export_bvh(Keyframes(robot, [0.0], [robot.home]))


# The studio's skeleton is a figure of 1.4 m in inches, y up. It looks along +x, so its left is -z.
# It is drawn as a T. Every part has another order of channels. The studio floor is 20 inches up,
# and the file has 120 frames a second, rounded to 0.00833.

INCH = 1.0 / 0.0254
"""Inches in a metre."""

SIDE = {"Left": -1.0, "Right": 1.0}
"""Sign of z of the sides."""

LEG = 0.35
"""Length of thigh and of shank, m."""

ARM = 0.22
"""Length of upper arm and of forearm, m."""

BEND_DEG = 30.0
"""Bend of the hips, degrees. Knees bend twice as much. Ankles bend as much and end at 35."""

ZXY, XZY, ZYX, YXZ = (
    tuple(f"{axis}rotation" for axis in order) for order in ("ZXY", "XZY", "ZYX", "YXZ")
)


def studio_skeleton() -> list[BvhJoint]:
    def at(*metres: float) -> tuple[float, float, float]:
        x, y, z = (INCH * v for v in metres)
        return x, y, z

    def leg(side: str, sign: float, first: int) -> list[BvhJoint]:
        return [
            BvhJoint(f"mixamorig:{side}UpLeg", 0, at(0, -0.02, 0.08 * sign), ZXY),
            BvhJoint(f"mixamorig:{side}Leg", first, at(0, -LEG, 0), ZXY),
            BvhJoint(f"mixamorig:{side}Foot", first + 1, at(0, -LEG, 0), XZY, at(0.12, -0.05, 0)),
        ]

    def arm(side: str, sign: float, first: int) -> list[BvhJoint]:
        return [
            BvhJoint(f"mixamorig:{side}Shoulder", 7, at(0, 0.28, 0.03 * sign), XZY),
            BvhJoint(f"mixamorig:{side}Arm", first, at(0, 0, 0.12 * sign), XZY),
            BvhJoint(f"mixamorig:{side}ForeArm", first + 1, at(0, 0, ARM * sign), ZYX),
            BvhJoint(
                f"mixamorig:{side}Hand", first + 2, at(0, 0, ARM * sign), XZY, at(0, 0, 0.1 * sign)
            ),
        ]

    return [
        BvhJoint("mixamorig:Hips", -1, at(0, 0, 0), ("Xposition", "Yposition", "Zposition", *ZYX)),
        *leg("Left", -1.0, 1),
        *leg("Right", 1.0, 4),
        BvhJoint("mixamorig:Spine", 0, at(0, 0.10, 0), ZXY),
        BvhJoint("mixamorig:Neck", 7, at(0, 0.32, 0), YXZ),
        BvhJoint("mixamorig:Head", 8, at(0.02, 0.10, 0), YXZ, at(0, 0.2, 0)),
        *arm("Left", -1.0, 10),
        *arm("Right", 1.0, 14),
    ]


def studio_take(frames: int = 61) -> Bvh:
    """Return a squat with the arms down and forward. The feet stay in place, to rounding."""
    joints = studio_skeleton()
    bvh = Bvh(
        tuple(joints), 0.00833, np.zeros((frames, sum(len(joint.channels) for joint in joints)))
    )
    bend = np.radians(BEND_DEG) * 0.5 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, frames)))
    names = [joint.name.split(":")[1] for joint in joints]

    def put(name: str, channel: str, values: Array) -> None:
        found = bvh.channel(names.index(name), channel)
        assert found is not None
        found[:] = values

    # Looking along +x, a leg swings forward about +z (right-handed), the knee back.
    for side, sign in SIDE.items():
        put(f"{side}UpLeg", "Zrotation", np.degrees(bend))
        put(f"{side}Leg", "Zrotation", -2.0 * np.degrees(bend))
        put(
            f"{side}Foot", "Zrotation", np.degrees(bend) + 360.0 * (np.arange(frames) > frames // 2)
        )
        put(f"{side}Arm", "Xrotation", np.full(frames, 70.0 * sign))
        put(f"{side}ForeArm", "Yrotation", 0.5 * sign * np.degrees(bend))
    put("Hips", "Yposition", INCH * (0.5 + 0.05 + 0.02 + 2.0 * LEG * np.cos(bend)))
    put("Hips", "Xposition", np.full(frames, INCH * 0.3))
    return bvh


def test_a_motion_of_another_figure_is_retargeted(humanoid: rik.Robot, tmp_path: Path) -> None:
    studio_take().save(tmp_path / "take.bvh")
    take = Bvh.load(tmp_path / "take.bvh")
    assert take.rate == 120.0 and take.prefix == "mixamorig:"
    found = retarget(take, humanoid, rate=30.0)
    motion = found.motion
    assert len(motion) == 16 and motion.duration == pytest.approx(0.5)
    assert not [k for k, q in enumerate(motion.q) if humanoid.outside(q)]
    # Legs decide the scale: ours are 0.859 m from hip to ankle.
    assert found.scale == pytest.approx((0.42875 + 0.4305) / (2 * LEG * INCH), rel=1e-6)
    assert found.rests.all()
    for side in ("left", "right"):
        feet = np.array([humanoid.measure(q, f"{side}_foot").position for q in motion.q])
        assert np.ptp(feet, axis=0).max() < 2e-4 and np.abs(feet[:, 2]).max() < 2e-4
    # Forward is forward, left is left.
    assert humanoid.measure(motion.q[0], "left_foot").position[1] > 0.05
    assert (
        humanoid.measure(motion.q[0], "left_toe").position[0]
        > humanoid.measure(motion.q[0], "left_heel").position[0]
    )
    # The squat: the pelvis sinks as the legs say, and stays upright.
    height = np.array([humanoid.measure(q, "pelvis").position[2] for q in motion.q])
    sunk = (0.42875 + 0.4305) * (1.0 - np.cos(np.radians(BEND_DEG)))
    assert height[0] - height[8] == pytest.approx(sunk, abs=0.02)
    assert (found.hand_error < 0.02).all()
    knees = motion.q[:, humanoid.tree.qadr[humanoid.joints.index("left_knee_pitch")]]
    assert knees[8] == pytest.approx(np.radians(2 * BEND_DEG), abs=0.1) and (knees >= 0.0).all()


def test_an_exported_file_is_retargeted_to_the_same_motion(humanoid: rik.Robot) -> None:
    home = humanoid.home
    position = humanoid.forward(home, "right_hand").position + np.array([0.25, 0.0, 0.35])
    feet = [rik.PoseGoal.at(f, humanoid.forward(home, f)) for f in ("left_foot", "right_foot")]
    found = rik.solve(
        humanoid,
        [*feet, rik.PositionGoal("right_hand", position), rik.PostureGoal(q=home, soft=True)],
    )
    motion = Keyframes.through(humanoid, [home, found.q], velocity_limits=6.0)
    again = retarget(export_bvh(motion, 20.0), humanoid)
    end = again.motion.q[-1]
    assert again.scale == pytest.approx(0.01)
    assert np.abs(humanoid.measure(end, "right_hand").position - position).max() < 5e-3
    assert np.median(again.hand_error) < 2e-3


def test_a_walk_is_retargeted_without_sliding_or_sinking(humanoid: rik.Robot) -> None:
    walk = KeyPoses.load(humanoid.folder / "poses.toml", humanoid).motion("walk")
    taken = retarget(export_bvh(walk, 30.0), humanoid)
    motion = taken.motion
    assert motion.q[-1, 0] - motion.q[0, 0] == pytest.approx(walk.q[-1, 0] - walk.q[0, 0], rel=0.05)
    assert taken.hand_error.max() < 5e-3 and taken.rests.any(axis=0).all() and not taken.rests.all()
    for k, side in enumerate(("left", "right")):
        ends = [
            [humanoid.measure(q, f"{side}_{end}").position for end in ("heel", "toe")]
            for q in motion.q
        ]
        assert np.array(ends)[..., 2].min() > -1e-3
        rest = np.flatnonzero(taken.rests[:, k])
        for one, two in pairwise(rest.tolist()):
            if two == one + 1:
                assert np.abs(np.array(ends[one]) - np.array(ends[two])).max() < 3e-4


def test_files_and_figures_outside_the_map_are_reported(
    humanoid: rik.Robot, tmp_path: Path
) -> None:
    take = studio_take(2)
    joints = list(take.joints)
    joints[9] = BvhJoint("mixamorig:Skull", 8, (0.0, 4.0, 0.0), joints[9].channels)
    with pytest.raises(
        ConfigError, match=r"roles\.head\.names: no name of head .* allowed: one of mixamorig:Hips"
    ):
        retarget(Bvh(tuple(joints), 0.01, take.values), humanoid)
    with pytest.raises(ModelError, match="has no map of joints"):
        retarget(take, rik.load_robot("puma560"))
    joints = list(take.joints)
    joints[12] = BvhJoint(joints[12].name, 11, (0.0, 0.0, 0.0), joints[12].channels)
    joints[13] = BvhJoint(joints[13].name, 12, (0.0, 0.0, 0.0), joints[13].channels)
    for k in (16, 17):
        joints[k] = BvhJoint(joints[k].name, joints[k].parent, (0.0, 0.0, 0.0), joints[k].channels)
    with pytest.raises(TrajectoryError, match="the arms of the file's rest pose have no length"):
        retarget(Bvh(tuple(joints), 0.01, take.values), humanoid)
    (tmp_path / "map.toml").write_text('schema = 1\n[roles.head]\nbody = "head"\nname = ["x"]\n')
    with pytest.raises(ConfigError, match=r"roles\.head\.name: unknown key"):
        SkeletonMap.load(tmp_path / "map.toml")
    (tmp_path / "map.toml").write_text('schema = 1\n[roles.head]\nbody = "head"\nnames = ["x"]\n')
    with pytest.raises(ConfigError, match=r"roles\.pelvis: this key is missing"):
        SkeletonMap.load(tmp_path / "map.toml")
    with pytest.raises(TrajectoryError, match="is not that of"):
        exported_motion(take, humanoid)


SMALL = (
    "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation End Site { OFFSET 0 1 0 } } "
    "MOTION Frames: 2 Frame Time: 0.1 "
)


def test_a_small_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(
        SMALL.replace("ROOT a", "root my hip").replace("Xrot", "xROT") + "1 2"
    )
    bvh = Bvh.load(tmp_path / "a.bvh")
    assert (
        bvh.joints[0].name == "my hip"
        and bvh.joints[0].channels == ("Xrotation",)
        and bvh.rate == 10.0
    )
    assert bvh.values.tolist() == [[1.0], [2.0]] and bvh.joints[0].end == (0.0, 1.0, 0.0)


DEEP = "HIERARCHY ROOT a { OFFSET 0 0 0 " + "JOINT a { OFFSET 0 0 0 " * 5000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file ends too early"),
        ("HIERARCHY MOTION", "got 'MOTION'; allowed: ROOT"),
        (SMALL + "1", "1 numbers for 2 frames; allowed: 2 times 1"),
        (SMALL + "1 2 3", "3 numbers for 2 frames"),
        (SMALL + "1 x", "got 'x'; allowed: a finite number"),
        (SMALL + "1 nan", "got 'nan'"),
        (SMALL.replace("0.1", "0") + "1 2", "a frame time of 0 s; allowed: above zero"),
        (SMALL.replace("Frames: 2", "Frames: -1"), "got -1; allowed: a whole number"),
        (SMALL.replace("1 Xrotation", "2 Xrotation Xrotation"), "a channel twice"),
        (SMALL.replace("Xrotation", "Wrotation"), "got 'Wrotation'; allowed: Xposition or"),
        ("HIERARCHY ROOT a { OFFSET 0 0 0 " * 300, "got 'HIERARCHY'; allowed: JOINT or End or }"),
        (DEEP, "the file ends too early"),
    ],
)
def test_the_error_of_a_broken_file_names_the_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(text)
    with pytest.raises(ConfigError, match=message):
        Bvh.load(tmp_path / "a.bvh")

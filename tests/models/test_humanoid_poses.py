"""The humanoid in motion: keyframes, mirror symmetry, whole-body solves, motors."""

import math
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import robot_ik as rik
from tests.models.arm_checks import extent

FOLDER = Path(__file__).parents[2] / "models" / "humanoid"
SIDES = ("left", "right")
FEET = tuple(f"{side}_{part}" for side in SIDES for part in ("foot", "heel", "toe"))
KEYS = ("home", "t_pose", "squat")
SHOULDER = 0.818 * 1.75
HIP = 0.530 * 1.75  # heights, m
TURNS_OVER = ("head_yaw", "torso_yaw", "pelvis_roll")  # change sign in the mirror


@cache
def load(name: str = "humanoid.xml") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


@cache
def figure() -> rik.Robot:
    return rik.load_robot("humanoid")


def posed(joints: dict[str, float] | None = None, key: str | None = None) -> mujoco.MjData:
    data = mujoco.MjData(load())
    if key is not None:
        data.qpos[:] = load().key(key).qpos
    for name, value in (joints or {}).items():
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(load(), data)
    return data


@pytest.mark.parametrize("key", KEYS)
def test_keyframes_stand_flat_balanced_free_and_inside_limits(key: str) -> None:
    model = load()
    data = posed(key=key)
    for name in FEET:
        assert abs(data.site(name).xpos[2]) < 1e-9
        assert data.site(name).xmat == pytest.approx(np.eye(3).ravel(), abs=1e-9)
    assert min(extent(model, data, geom)[0] for geom in range(model.ngeom)) == pytest.approx(
        0, abs=1e-9
    )
    assert data.ncon == 0
    heel = data.site("left_heel").xpos[0]
    toe = data.site("left_toe").xpos[0]
    assert heel + 0.04 < data.subtree_com[0][0] < toe - 0.08
    lower, upper = model.jnt_range[1:].T
    assert np.all(data.qpos[7:] >= lower) and np.all(data.qpos[7:] <= upper)
    assert model.key(key).ctrl == pytest.approx(data.qpos[7:], abs=1e-12)
    assert np.linalg.norm(data.qpos[3:7]) == pytest.approx(1, abs=1e-15)


def test_keyframes_match_their_names() -> None:
    arms = posed(key="t_pose")
    for side, sign in (("left", 1), ("right", -1)):
        hand = arms.site(f"{side}_hand").xpos
        assert hand[2] == pytest.approx(SHOULDER, abs=1e-12)
        assert hand[1] * sign > 0.8
        assert 0.1 < posed(key="home").joint(f"{side}_elbow_pitch").qpos[0] < 0.5
    assert posed(key="squat").site("pelvis").xpos[2] < 0.7 * HIP
    home = posed(key="home")
    assert home.site("left_hand").xpos[2] < home.site("pelvis").xpos[2]


@st.composite
def poses(draw: st.DrawFn) -> dict[str, float]:
    hinges = [load().joint(j) for j in range(1, load().njnt)]
    return {hinge.name: draw(st.floats(*map(float, hinge.range))) for hinge in hinges}


def other(name: str) -> str:
    return {"left": "right", "right": "left"}[name.split("_")[0]] + name[name.index("_") :]


def across(name: str) -> str:
    return other(name) if name.startswith(SIDES) else name


@settings(max_examples=40)
@given(pose=poses(), roll=st.floats(-0.5, 0.5), yaw=st.floats(-3, 3))
def test_mirrored_pose_has_mirrored_frames(pose: dict[str, float], roll: float, yaw: float) -> None:
    model = load()
    flip = np.array([1.0, -1.0, 1.0])
    turned = {across(n): -v if n in TURNS_OVER else v for n, v in pose.items()}
    data = posed(pose)
    image = posed(turned)
    root = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    lean = np.array([math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0])
    mujoco.mju_mulQuat(root, root.copy(), lean)
    for scene, side in ((data, 1), (image, -1)):
        scene.qpos[:7] = [0.3, side * 0.2, 1.1, *(root * [1, side, 1, side])]
        mujoco.mj_kinematics(model, scene)
    for k in range(model.nsite):
        here = data.site(k)
        there = image.site(across(data.site(k).name))
        assert np.abs(there.xpos - flip * here.xpos).max() < 1e-12
        assert (
            np.abs(there.xmat.reshape(3, 3) - np.outer(flip, flip) * here.xmat.reshape(3, 3)).max()
            < 1e-12
        )
    for k in range(1, model.nbody):
        here = data.body(k)
        there = image.body(across(data.body(k).name))
        assert np.abs(there.xipos - flip * here.xipos).max() < 1e-12


@pytest.mark.parametrize(("key", "floor"), [("home", 0.02), ("squat", 0.01), ("t_pose", 0.0)])
def test_limbs_have_six_degrees_of_freedom_as_in_the_readme(key: str, floor: float) -> None:
    """Rank 6 at home and squatting; at t_pose knees and shoulders are singular."""
    for limb, frame in (("left_leg", "left_foot"), ("left_arm", "left_hand")):
        part = rik.load_robot("humanoid", joints=limb)
        q = np.array(
            [load().key(key).qpos[load().joint(joint).qposadr[0]] for joint in part.joints]
        )
        least = np.linalg.svd(part.jacobian(q, frame), compute_uv=False)[5]
        assert least > floor if floor else least < 1e-9, limb


def pinned(*frames: str) -> list[rik.PoseGoal]:
    robot = figure()
    places = [robot.forward(robot.home, frame) for frame in frames]
    return [
        rik.PoseGoal(frame, place.position, place.wxyz)
        for frame, place in zip(frames, places, strict=True)
    ]


@pytest.mark.parametrize(
    "hands",
    [
        {"right_hand": (0.5, -0.3, 1.3)},
        {"right_hand": (0.35, -0.1, 1.9)},
        {"right_hand": (0.45, -0.2, 0.4)},
        {"left_hand": (0.15, 0.75, 1.2)},
        {"right_hand": (0.4, -0.2, 1.5), "left_hand": (0.3, 0.3, 1.0)},
    ],
)
def test_hands_reach_while_the_feet_stay(hands: dict[str, tuple[float, float, float]]) -> None:
    robot = figure()
    feet = pinned("left_foot", "right_foot")
    goals = [*feet, *(rik.PositionGoal(frame, place) for frame, place in hands.items())]
    solution = rik.solve(robot, goals, solver="lm")
    assert solution.converged and robot.outside(solution.q) == []
    for goal in goals:
        pose = robot.measure(solution.q, goal.frame)
        assert np.linalg.norm(pose.position - goal.target.position) < 1e-4
    for goal in feet:
        assert abs(robot.measure(solution.q, goal.frame).wxyz @ goal.target.wxyz) > math.cos(
            1e-3 / 2
        )


def test_the_feet_stay_flat_in_a_wide_stance() -> None:
    """Two ankle joints, one of them oblique, keep the sole flat for every leg posture."""
    robot = figure()
    wide = []
    for side, sign in (("left", 1), ("right", -1)):
        wide.append(rik.PoseGoal(f"{side}_foot", (0, sign * 0.28, 0), (1, 0, 0, 0)))
    solution = rik.solve(robot, [*wide, rik.PositionGoal("pelvis", (-0.1, 0, 0.82))], solver="lm")
    assert solution.converged and robot.outside(solution.q) == []


@pytest.mark.parametrize("key", KEYS)
def test_motors_hold_every_keyframe_on_the_floor(key: str) -> None:
    model = load("scene.xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert abs(data.qpos[2] - model.key(key).qpos[2]) < 0.03
    assert np.abs(data.qpos[7:] - model.key(key).qpos[7:]).max() < math.radians(3)

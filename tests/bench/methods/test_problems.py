"""Problem sets have their properties: seeded, reachable, singular, near limits, or unreachable."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest

from benchmarks.peers.descriptions import plain_mjcf
from robot_ik.bench.methods.problems import (
    NEAR_LIMIT,
    SETS,
    SLACK,
    WARM_METRES,
    WARM_RADIANS,
    ProblemSet,
    make_set,
)
from robot_ik.chain import make_chain
from robot_ik.errors import UnsupportedJointError
from robot_ik.robot import Robot, load_robot

ARMS = ("puma560", "ur5e", "panda")
BALLS = """<mujoco model="balls"><compiler angle="radian"/><worldbody><body pos="0 0 1">
<joint name="shoulder" type="ball" range="0 1.2" limited="true"/><geom size="0.05"/>
<body pos="0.4 0 0"><joint name="elbow" axis="0 1 0" range="-2 2" limited="true"/>
<geom size="0.05"/>
<body pos="0.3 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 0.3" limited="true"/>
<geom size="0.05"/><site name="tool" pos="0.1 0 0"/></body></body></body></worldbody></mujoco>"""


@cache
def robot(name: str) -> Robot:
    if name == "balls":
        return load_robot(BALLS, tool="tool")
    return load_robot(name)


def some(kind: str, name: str, seed: int = 3, count: int = 12) -> ProblemSet:
    return make_set(kind, robot(name), count, seed)


def mujoco_pose(robot: Robot, q: np.ndarray) -> np.ndarray:
    """The tool by MuJoCo alone: the tool of these robots is a site."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_kinematics(robot.model, data)
    pose = np.eye(4)
    site = data.site(robot.tool)
    pose[:3, 3] = site.xpos
    pose[:3, :3] = site.xmat.reshape(3, 3)
    return pose


@pytest.mark.parametrize("kind", SETS)
def test_the_same_seed_gives_the_same_problems(kind: str) -> None:
    first = some(kind, "puma560")
    again = some(kind, "puma560")
    other = some(kind, "puma560", seed=4)
    assert len(first) == 12
    np.testing.assert_array_equal(first.targets, again.targets)
    np.testing.assert_array_equal(first.witnesses, again.witnesses)
    assert np.abs(first.targets - other.targets).max() > 1e-3


@pytest.mark.parametrize("kind", ["cold", "warm", "singular", "limits"])
@pytest.mark.parametrize("name", [*ARMS, "balls"])
def test_a_witness_inside_the_limits_meets_every_target(kind: str, name: str) -> None:
    problems = some(kind, name, count=6)
    arm = robot(name)
    if kind == "singular" and name == "balls":
        return  # the robot has no such problems
    assert len(problems.witnesses) == len(problems) == 6
    for q, target in zip(problems.witnesses, problems.targets, strict=True):
        np.testing.assert_allclose(mujoco_pose(arm, q), target, atol=1e-12)
        assert arm.outside(q) == []


@pytest.mark.parametrize("name", ARMS)
def test_singular_problems_are_singular(name: str) -> None:
    arm = robot(name)
    problems = some("singular", name, count=4)
    data = mujoco.MjData(arm.model)

    def singular_values(q: np.ndarray) -> np.ndarray:
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(arm.model, data)
        mujoco.mj_comPos(arm.model, data)
        jacobian = np.zeros((6, arm.model.nv))
        mujoco.mj_jacSite(arm.model, data, jacobian[:3], jacobian[3:], data.site(arm.tool).id)
        return np.linalg.svd(jacobian, compute_uv=False)

    for q in problems.witnesses:
        sigma = singular_values(q)
        assert sigma[5] < 1e-8 * sigma[0]
    assert np.median([singular_values(q)[5] for q in some("cold", name).witnesses]) > 1e-3


def test_limit_problems_are_near_limits() -> None:
    arm = robot("puma560")
    q = some("limits", "puma560", count=40).witnesses
    span = arm.upper - arm.lower
    near = np.minimum(q - arm.lower, arm.upper - q) <= NEAR_LIMIT * span
    assert near.any(axis=1).all()
    assert 0.3 < near.mean() < 0.7
    cone = robot("balls")
    rotation = 2 * np.arccos(np.abs(some("limits", "balls", count=40).witnesses[:, 0]))
    assert (rotation <= cone.upper[0] + 1e-12).all() and (
        rotation >= (1 - NEAR_LIMIT) * cone.upper[0]
    ).any()


def test_unreachable_problems_are_out_of_reach() -> None:
    for name in (*ARMS, "balls"):
        model = robot(name)
        problems = some("unreachable", name)
        rng = np.random.default_rng(0)
        centre, _ = model.reach() or (np.zeros(3), 0.0)
        farthest = max(
            np.linalg.norm(mujoco_pose(model, model.sample(rng))[:3, 3] - centre)
            for _ in range(200)
        )
        assert len(problems) and not len(problems.witnesses)
        assert np.linalg.norm(problems.targets[:, :3, 3] - centre, axis=1).min() > farthest


@pytest.mark.parametrize("name", [*ARMS, "balls"])
def test_a_warm_path_takes_small_steps(name: str) -> None:
    problems = some("warm", name, count=40)
    before = mujoco_pose(robot(name), problems.first)
    for target in problems.targets:
        rotation = before[:3, :3].T @ target[:3, :3]
        angle = (
            np.linalg.norm(
                [
                    rotation[2, 1] - rotation[1, 2],
                    rotation[0, 2] - rotation[2, 0],
                    rotation[1, 0] - rotation[0, 1],
                ]
            )
            / 2
        )
        assert np.linalg.norm(target[:3, 3] - before[:3, 3]) <= WARM_METRES * (1 + 1e-9)
        assert np.arcsin(min(1.0, angle)) <= WARM_RADIANS * (1 + 1e-6)
        before = target


def test_a_robot_without_such_problems_gives_a_reason() -> None:
    chain = make_chain(3)
    figure = load_robot("humanoid")
    for arm, kind in ((chain, "limits"), (figure, "unreachable"), (figure, "singular")):
        problems = make_set(kind, arm, 5)
        assert len(problems) == 0 and problems.reason


def test_wrong_solutions_are_detected() -> None:
    arm = robot("puma560")
    q = arm.home
    np.testing.assert_allclose(arm.measure(q).matrix, mujoco_pose(arm, q), atol=1e-14)
    assert not arm.outside(q, SLACK)
    past = q.copy()
    past[0] = arm.upper[0] + 1e-6
    assert arm.outside(past, SLACK)
    ball = robot("balls")
    beyond = np.concatenate([[np.cos(0.61), np.sin(0.61), 0, 0], ball.home[4:]])
    assert ball.outside(beyond, SLACK) and not ball.outside(ball.clip(beyond), SLACK)


def test_a_plain_model_moves_as_the_robot_does() -> None:
    figure = load_robot("humanoid")
    sites = {"palm": "left_hand", "toe": "right_toe", "eyes": "gaze"}
    text = plain_mjcf(figure, sites)
    model = mujoco.MjModel.from_xml_string(text)
    assert model.nq == figure.nq and (model.body_jntnum[1:] == 1).all() and not model.jnt_pos.any()
    np.testing.assert_allclose(model.jnt_range, figure.model.jnt_range, atol=1e-15)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for _ in range(5):
        q = figure.sample(rng)
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for name, frame in sites.items():
            np.testing.assert_allclose(
                data.site(name).xpos, figure.measure(q, frame).position, atol=1e-12
            )
    with pytest.raises(UnsupportedJointError):
        plain_mjcf(robot("balls"), {})

"""The Gymnasium environments: Gymnasium's checker, motions, rewards and the batched environment."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import robot_ik as rik
import robot_ik.gym
from robot_ik.errors import ModelError, OptionError
from robot_ik.gym import STEP_SECONDS, THRESHOLD, TOOL_STEP

ROBOTS = ("koch_v11", "puma560", "panda")


def make(name="Reach", **options):
    return gymnasium.make(f"robot_ik/{name}-v0", **options)


def straight(observation):
    """Return the action of a policy that moves straight to the goal."""
    return (observation["desired_goal"] - observation["achieved_goal"]) / TOOL_STEP


@pytest.mark.parametrize("control", ["tool", "joints"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_checker_of_gymnasium_passes(robot, control):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("Reach", "ReachDense"):
            env = make(name, robot=robot, control=control, render_mode="rgb_array")
            check_env(env.unwrapped)
            env.close()


@pytest.mark.parametrize("control", ["tool", "joints"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_checker_of_stable_baselines3_passes(robot, control):
    """``make lerobot`` runs it: the default environment has no PyTorch."""
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker",
        reason="stable-baselines3 needs PyTorch; make lerobot runs this test",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("Reach", "ReachDense"):
            env = make(name, robot=robot, control=control, render_mode="rgb_array")
            checker.check_env(env.unwrapped, warn=True)
            env.close()


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_straight_policy_reaches_reachable_goals(robot):
    env = make(robot=robot)
    for seed in range(10):
        observation, info = env.reset(seed=seed)
        assert info["reachable"]
        for _ in range(50):
            action = np.clip(straight(observation), -1.0, 1.0).astype(np.float32)
            observation, reward, terminated, _, info = env.step(action)
            assert (reward == 0.0) == info["is_success"] and not terminated
            if info["is_success"]:
                break
        assert info["is_success"]
        last = env.unwrapped.model.robot
        tool = last.measure(observation["observation"][: last.nq]).position
        np.testing.assert_allclose(observation["achieved_goal"], tool, atol=1e-9)


def test_speed_and_joint_limits_hold():
    env = make(control="joints", robot="panda")
    robot = env.unwrapped.model.robot
    env.reset(seed=1)
    q = robot.home
    for _ in range(60):
        observation, *_ = env.unwrapped.step(np.ones(robot.nv, dtype=np.float32))
        moved = observation["observation"][: robot.nq]
        assert (np.abs(moved - q) <= robot.velocity_limits * STEP_SECONDS + 1e-12).all()
        assert (moved <= robot.upper).all()
        q = moved
    assert (q == robot.upper).any()


def test_unreachable_goals_are_beyond_the_reach_of_the_robot():
    env = make(unreachable=0.5)
    model = env.unwrapped.model
    counts = {True: 0, False: 0}
    for seed in range(40):
        observation, info = env.reset(seed=seed)
        counts[info["reachable"]] += 1
        distance = np.linalg.norm(observation["desired_goal"] - model.center)
        if not info["reachable"]:
            assert distance > model.radius + THRESHOLD
            goal = rik.PositionGoal(None, observation["desired_goal"])
            assert rik.solve(model.robot, goal).status is rik.Status.UNREACHABLE
    assert min(counts.values()) >= 10


def test_a_goal_may_be_given():
    observation, info = make().reset(options={"goal": (0.2, 0.0, 0.2)})
    assert observation["desired_goal"].tolist() == [0.2, 0.0, 0.2]
    assert info["reachable"] is None


def test_rewards_of_many_goals_equal_those_of_single_goals():
    for name in ("Reach", "ReachDense"):
        env = make(name).unwrapped
        rng = np.random.default_rng(0)
        achieved, desired = 0.1 * rng.normal(size=(2, 20, 3))
        many = env.compute_reward(achieved, desired, {})
        single = [env.compute_reward(*pair, {}) for pair in zip(achieved, desired, strict=True)]
        np.testing.assert_array_equal(many, single)


@pytest.mark.parametrize("control", ["tool", "joints"])
def test_many_arms_move_as_single_arms(control):
    count = 5
    envs = gymnasium.make_vec("robot_ik/Reach-v0", num_envs=count, control=control)
    singles = [make(control=control).unwrapped for _ in range(count)]
    observation, _ = envs.reset(seed=3)
    for k, single in enumerate(singles):
        single.reset(options={"goal": observation["desired_goal"][k]})
    rng = np.random.default_rng(4)
    size = envs.single_action_space.shape[0]
    for _ in range(20):
        actions = rng.uniform(-1.0, 1.0, (count, size)).astype(np.float32)
        observation, rewards, *_, info = envs.step(actions)
        for k, single in enumerate(singles):
            alone, reward, *_, alone_info = single.step(actions[k])
            np.testing.assert_allclose(
                observation["observation"][k], alone["observation"], atol=1e-12
            )
            assert rewards[k] == reward
            assert info["is_success"][k] == alone_info["is_success"]


def test_a_finished_arm_restarts_in_the_next_step():
    envs = gymnasium.make_vec("robot_ik/Reach-v0", num_envs=3, max_episode_steps=4)
    first, _ = envs.reset(seed=5)
    actions = np.ones((3, 3), dtype=np.float32)
    for step in range(4):
        observation, _, _, truncated, _ = envs.step(actions)
        assert truncated.all() == (step == 3)
    observation, reward, _, truncated, _ = envs.step(actions)
    assert (reward == 0.0).all() and not truncated.any()
    home = envs.unwrapped.model.robot.home
    np.testing.assert_array_equal(observation["observation"][:, : len(home)], np.tile(home, (3, 1)))
    assert (observation["desired_goal"] != first["desired_goal"]).any()


def test_wrong_options_are_refused():
    for options in ({"control": "forces"}, {"reward_type": "none"}, {"unreachable": 2.0}):
        with pytest.raises(OptionError):
            robot_ik.gym.ReachEnv(**options)
    with pytest.raises(ModelError, match="floating base"):
        robot_ik.gym.ReachEnv(robot="humanoid")


def test_the_package_does_not_import_gymnasium():
    code = "import sys, robot_ik as rik; rik.solve; assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)

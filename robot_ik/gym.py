"""Gymnasium environments: bring the tool of an arm to a goal position.

    import gymnasium
    import robot_ik.gym

    env = gymnasium.make("robot_ik/Reach-v0", robot="koch_v11")
    envs = gymnasium.make_vec("robot_ik/Reach-v0", num_envs=256, robot="panda")

``Reach-v0`` has a sparse reward, ``ReachDense-v0`` minus the distance. The robot moves without
forces: inverse kinematics, joint limits and speed limits. The environments are goal environments
in the form that hindsight experience replay (HER) needs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.batch import forward_batch, solve_batch
from robot_ik.budget import Budget
from robot_ik.errors import MissingExtraError, ModelError, OptionError
from robot_ik.geometry import Pose, is_real
from robot_ik.goals import PositionGoal, Tolerance
from robot_ik.ports import Array
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise MissingExtraError("gymnasium", "gym", "robot_ik.gym") from None

STEP_SECONDS = 0.04
"""Time of one step, s: 25 Hz, as in the Fetch environments of Gymnasium-Robotics."""

TOOL_STEP = 0.05
"""Displacement of the tool for an action of 1, m, before the speed limits."""

THRESHOLD = 0.05
"""Distance to the goal that counts as success, m."""

GOAL_RANGE = 0.15
"""Reachable goals are in a cube around the tool's home position. Half of its edge, m."""

BEYOND_REACH = (0.06, 0.14)
"""m. Unreachable goals are this much outside the ball that the tool cannot leave."""

MAX_STEPS = 50
"""Steps after which an episode is truncated."""

UNLIMITED = 2.0 * np.pi
"""Bound of the observation for joints without limits, rad or m."""

BOUND_SLACK = 1e-6
"""The observation space is larger than the limits by this, for rounding."""

IK_BUDGET = Budget(iterations=60, restarts=0)
"""Budget of one step. A step to an unreachable position must not search."""

IK_TOLERANCE = Tolerance(position=1e-3)

PICTURE = (320, 240)
"""Width and height of a rendered picture, pixels."""

BACKGROUND = 200
"""Grey value of the background of a picture."""

CAMERA_DIRECTION = np.array([0.6, -0.6, 0.4])
"""Direction from the robot to the camera. It is scaled with the reach of the robot."""

CAMERA_DISTANCE = 2.2
"""Distance of the camera, in reaches of the robot."""

Observation = dict[str, Array]


class ReachModel:
    """Spaces, goals, rewards and limits of the single and the batched environment.

    Args:
        robot: Name of a bundled robot or path of a model, with hinges and slides only.
        control: ``tool``: an action moves the tool (3 numbers). ``joints``: one number per joint.
        reward_type: ``sparse``: 0 at the goal, else -1. ``dense``: minus the distance.
        unreachable: Share of the episodes whose goal is out of reach, 0 to 1. The entry
            ``reachable`` of ``info`` is False in these episodes.

    Raises:
        OptionError: Another ``control``, ``reward_type`` or ``unreachable``.
        ModelError: The robot has ball joints or a floating base, or an unlimited reach.
    """

    def __init__(self, robot: str, control: str, reward_type: str, unreachable: float) -> None:
        if control not in ("tool", "joints"):
            raise OptionError("control", f"{control!r}", "tool, joints")
        if reward_type not in ("sparse", "dense"):
            raise OptionError("reward_type", f"{reward_type!r}", "sparse, dense")
        if not is_real(unreachable, 0.0, 1.0):
            raise OptionError("unreachable", f"{unreachable!r}", "0 to 1")
        self.robot: Robot = load_robot(robot)
        ball = self.robot.reach()
        if self.robot.nq != self.robot.nv or ball is None:
            raise ModelError(
                f"{self.robot.name} has ball joints, a floating base or no limited reach",
                hint='choose an arm, such as robot="koch_v11"',
            )
        self.center, self.radius = ball
        self.control = control
        self.reward_type = reward_type
        self.unreachable = unreachable
        self.home_position = np.array(self.robot.forward(self.robot.home).position)
        self.largest_step = self.robot.velocity_limits * STEP_SECONDS
        size = 3 if control == "tool" else self.robot.nv
        self.action_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.observation_space = self._observation_space()

    def _observation_space(self) -> spaces.Dict:
        robot = self.robot
        lower = np.where(np.isfinite(robot.lower), robot.lower, -UNLIMITED)
        upper = np.where(np.isfinite(robot.upper), robot.upper, UNLIMITED)
        near = self.center - self.radius - GOAL_RANGE
        far = self.center + self.radius + GOAL_RANGE
        lowest = np.concatenate([lower, -robot.velocity_limits, near]) - BOUND_SLACK
        highest = np.concatenate([upper, robot.velocity_limits, far]) + BOUND_SLACK
        goal = spaces.Box(near, far, dtype=np.float64)
        state = spaces.Box(lowest, highest, dtype=np.float64)
        return spaces.Dict({"observation": state, "achieved_goal": goal, "desired_goal": goal})

    def positions(self, qs: Array) -> Array:
        """Return the tool positions (n, 3) at ``qs`` (n, nq)."""
        return forward_batch(self.robot, qs).positions

    def draw_goal(self, rng: np.random.Generator) -> tuple[Array, bool]:
        """Return a goal position (3,), and whether the robot reaches it."""
        if self.unreachable > 0.0 and rng.random() < self.unreachable:
            direction = rng.normal(size=3)
            direction[2] = abs(direction[2])
            distance = self.radius + rng.uniform(*BEYOND_REACH)
            return self.center + direction * distance / np.linalg.norm(direction), False
        while True:
            position = np.array(self.robot.forward(self.robot.sample(rng)).position)
            is_near = np.abs(position - self.home_position).max() <= GOAL_RANGE
            if is_near and position[2] > 0.0:
                return position, True

    def moved(self, q: Array, wanted: Array) -> Array:
        """Return ``q`` moved towards ``wanted`` within speed and joint limits; (nq,) or (n, nq)."""
        step = np.clip(wanted - q, -self.largest_step, self.largest_step)
        return np.clip(q + step, self.robot.lower, self.robot.upper)

    def observation(self, q: Array, dq: Array, position: Array, goal: Array) -> Observation:
        """Return the observation of one arm, or of several arms row by row."""
        state = np.concatenate([q, dq, position], axis=-1)
        return {"observation": state, "achieved_goal": position.copy(), "desired_goal": goal.copy()}

    def reward(self, achieved: ArrayLike, desired: ArrayLike) -> Any:
        """Return the reward of one position (3,) or of several (n, 3)."""
        distance = np.linalg.norm(np.subtract(achieved, desired), axis=-1)
        if self.reward_type == "dense":
            return -distance
        return -(distance > THRESHOLD).astype(float)

    def success(self, achieved: ArrayLike, desired: ArrayLike) -> Any:
        """Return whether one position (3,) or each of several (n, 3) is at the goal."""
        return np.linalg.norm(np.subtract(achieved, desired), axis=-1) <= THRESHOLD


class ReachEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One arm whose tool should reach a goal.

    Args:
        robot: See ``ReachModel``.
        control: See ``ReachModel``.
        reward_type: See ``ReachModel``.
        unreachable: See ``ReachModel``.
        render_mode: ``rgb_array`` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / STEP_SECONDS)}  # noqa: RUF012

    def __init__(
        self,
        robot: str = "koch_v11",
        control: str = "tool",
        reward_type: str = "sparse",
        unreachable: float = 0.0,
        render_mode: str | None = None,
    ) -> None:
        self.model = ReachModel(robot, control, reward_type, unreachable)
        self.render_mode = render_mode
        self.action_space = self.model.action_space
        self.observation_space: Any = self.model.observation_space
        goal = PositionGoal(None, self.model.home_position)
        self._problem = Problem(self.model.robot, goal, tolerance=IK_TOLERANCE, budget=IK_BUDGET)
        self._q: Array = self.model.robot.home.copy()
        self._dq: Array = np.zeros(self.model.robot.nv)
        self._goal: Array = self.model.home_position
        self._reachable: bool | None = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start at home with a random goal.

        Args:
            seed: Seed of the goals.
            options: ``{"goal": (x, y, z)}`` sets the goal. ``reachable`` is then None in ``info``.
        """
        super().reset(seed=seed)
        given = (options or {}).get("goal")
        if given is None:
            self._goal, self._reachable = self.model.draw_goal(self.np_random)
        else:
            self._goal = np.array(given, dtype=float)
            self._reachable = None
        self._q = self.model.robot.home.copy()
        self._dq = np.zeros(self.model.robot.nv)
        return self._observe()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the arm by one action, for ``STEP_SECONDS``."""
        command = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        before = self._q
        if self.model.control == "joints":
            wanted = before + command * self.model.largest_step
        else:
            target = self.model.positions(before[None])[0] + TOOL_STEP * command
            wanted = self._problem.solve(before, target=target).q
        self._q = self.model.moved(before, wanted)
        self._dq = (self._q - before) / STEP_SECONDS
        observation, info = self._observe()
        achieved = observation["achieved_goal"]
        reward = self.compute_reward(achieved, observation["desired_goal"], info)
        return observation, float(reward), False, False, info

    def compute_reward(
        self,
        achieved_goal: ArrayLike,
        desired_goal: ArrayLike,
        info: object,  # noqa: ARG002  # of Gymnasium's interface
    ) -> Any:
        """Return the reward of one position (3,) or of several (n, 3), for HER."""
        return self.model.reward(achieved_goal, desired_goal)

    def compute_terminated(
        self,
        achieved_goal: ArrayLike,  # noqa: ARG002  # of Gymnasium's interface
        desired_goal: ArrayLike,  # noqa: ARG002
        info: object,  # noqa: ARG002
    ) -> bool:
        """Return False: an episode ends only by its length."""
        return False

    def compute_truncated(
        self,
        achieved_goal: ArrayLike,  # noqa: ARG002  # of Gymnasium's interface
        desired_goal: ArrayLike,  # noqa: ARG002
        info: object,  # noqa: ARG002
    ) -> bool:
        """Return False: the time limit is a wrapper of Gymnasium."""
        return False

    def render(self) -> Any:
        """Return an RGB picture (height, width, 3). It needs no OpenGL."""
        if self.render_mode != "rgb_array":
            return None
        # Imported here, because the camera's code is large and most environments are never drawn.
        from robot_ik.camera.drawing.overlay import draw_robot
        from robot_ik.camera.intrinsics import CameraIntrinsics

        width, height = PICTURE
        middle = (0.5 * (width - 1), 0.5 * (height - 1))
        intrinsics = CameraIntrinsics(width, height, float(width), float(width), *middle)
        eye = self.model.home_position + CAMERA_DISTANCE * self.model.radius * CAMERA_DIRECTION
        image = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
        robot = self.model.robot
        pose = Pose.look_at(eye, 0.5 * (self.model.home_position + self.model.center))
        drawn = draw_robot(image, robot.model, robot.qpos(self._q), intrinsics, pose, alpha=1.0)
        return np.ascontiguousarray(drawn[..., ::-1])

    def _observe(self) -> tuple[Observation, dict[str, Any]]:
        position = self.model.positions(self._q[None])[0]
        observation = self.model.observation(self._q, self._dq, position, self._goal)
        success = bool(self.model.success(position, self._goal))
        return observation, {"is_success": success, "reachable": self._reachable}


class ReachVectorEnv(VectorEnv[Observation, NDArray[np.float32], Any]):
    """Many arms in one process, solved by ``solve_batch``. The next step resets a finished arm.

    Args:
        num_envs: Number of arms.
        robot: See ``ReachModel``.
        control: See ``ReachModel``.
        reward_type: See ``ReachModel``.
        unreachable: See ``ReachModel``.
        max_episode_steps: Steps after which an episode is truncated.
        render_mode: None. A batch is not drawn.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        robot: str = "koch_v11",
        control: str = "tool",
        reward_type: str = "sparse",
        unreachable: float = 0.0,
        max_episode_steps: int = MAX_STEPS,
        render_mode: str | None = None,
    ) -> None:
        self.num_envs = num_envs
        self.model = ReachModel(robot, control, reward_type, unreachable)
        self.render_mode = render_mode
        self.single_action_space = self.model.action_space
        self.single_observation_space = self.model.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._max_steps = max_episode_steps
        self._q: Array = np.tile(self.model.robot.home, (num_envs, 1))
        self._dq: Array = np.zeros((num_envs, self.model.robot.nv))
        self._position: Array = np.tile(self.model.home_position, (num_envs, 1))
        self._goals: Array = np.zeros((num_envs, 3))
        self._reachable = np.ones(num_envs, dtype=bool)
        self._age = np.zeros(num_envs, dtype=int)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002  # of Gymnasium's interface
    ) -> tuple[Observation, dict[str, Any]]:
        """Start all arms at home with random goals."""
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._restart(np.ones(self.num_envs, dtype=bool))
        return self._observation(), self._info()

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, Any, Any, Any, dict[str, Any]]:
        """Move all arms by one action; reset the arms whose episode ended in the last step."""
        command = np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)
        ended = self._age >= self._max_steps
        before = self._q
        if self.model.control == "joints":
            wanted = before + command * self.model.largest_step
        else:
            wanted = solve_batch(
                self.model.robot,
                self._position + TOOL_STEP * command,
                starts=before,
                tolerance=IK_TOLERANCE,
                budget=IK_BUDGET,
            ).q
        self._q = self.model.moved(before, wanted)
        self._dq = (self._q - before) / STEP_SECONDS
        self._position = self.model.positions(self._q)
        self._age += 1
        self._restart(ended)
        reward = np.where(ended, 0.0, self.model.reward(self._position, self._goals))
        truncated = self._age >= self._max_steps
        terminated = np.zeros(self.num_envs, dtype=bool)
        return self._observation(), reward, terminated, truncated, self._info()

    def _restart(self, which: NDArray[np.bool_]) -> None:
        self._q[which] = self.model.robot.home
        self._dq[which] = 0.0
        self._position[which] = self.model.home_position
        self._age[which] = 0
        for k in np.flatnonzero(which):
            self._goals[k], self._reachable[k] = self.model.draw_goal(self.np_random)

    def _observation(self) -> Observation:
        return self.model.observation(self._q, self._dq, self._position, self._goals)

    def _info(self) -> dict[str, Any]:
        every = np.ones(self.num_envs, dtype=bool)
        return {
            "is_success": self.model.success(self._position, self._goals),
            "_is_success": every,
            "reachable": self._reachable.copy(),
            "_reachable": every.copy(),
        }


for _name, _reward in (("Reach", "sparse"), ("ReachDense", "dense")):
    gymnasium.register(
        id=f"robot_ik/{_name}-v0",
        entry_point="robot_ik.gym:ReachEnv",
        vector_entry_point="robot_ik.gym:ReachVectorEnv",
        max_episode_steps=MAX_STEPS,
        kwargs={"reward_type": _reward},
    )

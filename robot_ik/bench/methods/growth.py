"""Cost of the kinematics alone, and growth of the cost of a step with joints and goals."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import timeit
from collections.abc import Callable, Iterator
from typing import Any, Literal

import mujoco
import numpy as np

from robot_ik.batch import solve_batch, usable_cores
from robot_ik.bench.methods.problems import make_set
from robot_ik.bench.methods.results import Batch, Growth, LowerBound
from robot_ik.budget import Budget
from robot_ik.errors import GoalError, UnsupportedGoalError, UnsupportedJointError
from robot_ik.goals import Goal, PoseGoal, PositionGoal, Tolerance
from robot_ik.kernels import jit
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.kinematics import forward, frame_jacobian, frame_pose
from robot_ik.kernels.tree import open_tree
from robot_ik.problem import Problem
from robot_ik.robot import Robot, load_robot
from robot_ik.solvers.base import Solver

JOINTS = (6, 12, 25, 50, 100, 200)
"""Numbers of joints of the chains on which a step is timed."""

FIGURE = "humanoid"
"""Robot on which a step with several goals is timed."""

FIGURE_FRAMES = (
    "left_hand",
    "right_hand",
    "left_foot",
    "right_foot",
    "head",
    "pelvis",
    "left_toe",
    "right_toe",
)
"""Frames of the figure that get a position goal, in this order."""

_LOOP = 2000
"""Calls in a compiled loop."""

_ROUNDS = 15
"""Number of loops, of which the fastest counts."""

_PROBLEMS = 20
"""Problems of a measurement of growth."""

_STEPS = 40
"""Steps for each of these problems."""

_CHAIN_LENGTH = 2.0
"""Length of a chain, m."""

_CHAIN_LIMIT = 2.6
"""Limit of a joint of a chain to each side, rad."""

_BATCH_WARM_UP = 1000
"""Poses of a batch whose time does not count."""

_ORIGIN = (0.0, 0.0, 0.0)


@kernel
def loop_forward(tree, nodes, node, local, qs, q, world, scratch, out):
    """Calculate the pose of one frame for each row of ``qs`` (n, nq)."""
    tree = open_tree(tree)
    for row in range(qs.shape[0]):
        for i in range(q.shape[0]):
            q[i] = qs[row, i]
        forward(tree, nodes, q, world, scratch)
        frame_pose(world, node, local, 0, out)


@kernel
def loop_jacobian(tree, nodes, node, local, qs, q, world, scratch, out, jacobian):
    """Calculate pose and Jacobian of one frame for each row of ``qs`` (n, nq)."""
    tree = open_tree(tree)
    for row in range(qs.shape[0]):
        for i in range(q.shape[0]):
            q[i] = qs[row, i]
        frame_jacobian(tree, nodes, node, local, q, world, scratch, out, jacobian)


def lower_bound(robot: Robot, seed: int = 0) -> LowerBound:
    """Return the time of a forward pass of the tool, without and with Jacobian, µs."""
    jit.announce(loop_jacobian, "the loops of the benchmark")
    rng = np.random.default_rng(seed)
    qs = np.array([robot.sample(rng) for _ in range(_LOOP)])
    node, local = robot.attachment()
    nodes = np.array(robot.tree.ancestors(node), dtype=np.int64)
    common = (
        robot.tree.block.address,
        nodes,
        node,
        local[None, :],
        qs,
        np.empty(robot.nq),
        np.empty((robot.tree.size, 12)),
        np.empty((2, 12)),
        np.empty((1, 12)),
    )
    jacobian = np.empty((6, robot.nv))
    forward_us = round(_best(lambda: loop_forward(*common)) / _LOOP, 4)
    jacobian_us = round(_best(lambda: loop_jacobian(*common, jacobian)) / _LOOP, 4)
    return LowerBound(
        robot=robot.name, joints=len(nodes), forward_us=forward_us, jacobian_us=jacobian_us
    )


def _best(call: Callable[[], None]) -> float:
    """Return the time of the fastest of some calls, µs, without the first, which compiles."""
    call()
    return 1e6 * min(timeit.repeat(call, number=1, repeat=_ROUNDS))


def hinge_chain(n: int) -> Robot:
    """Return a chain of ``n`` hinges about x, y and z in turn, two metres long, each ±149°."""
    spec = mujoco.MjSpec()
    spec.modelname = f"hinges{n}"
    spec.compiler.degree = False
    body = spec.worldbody
    length = _CHAIN_LENGTH / n
    for i in range(n):
        body = body.add_body(name=f"link{i + 1}", pos=[0.0, 0.0, length if i else 0.0])
        axis = [float(i % 3 == k) for k in range(3)]
        body.add_joint(
            name=f"joint{i + 1}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            range=[-_CHAIN_LIMIT, _CHAIN_LIMIT],
            limited=True,
        )
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0.0, 0.0])
    body.add_site(name="tip", pos=[0.0, 0.0, length])
    return load_robot(spec.compile(), tool="tip")


def pose_problem(solver: Solver, robot: Robot, frame: str, **options: Any) -> Problem:
    """Return a problem for a pose of a frame, or for its position if the method takes no poses.

    Raises:
        UnsupportedGoalError: The method takes neither.
    """
    try:
        return Problem(robot, PoseGoal(frame, _ORIGIN), solver=solver, **options)
    except UnsupportedGoalError:
        return Problem(robot, PositionGoal(frame, _ORIGIN), solver=solver, **options)


def growth(solver: Solver, figure: Robot, seed: int = 0) -> Iterator[Growth]:
    """Yield the time of a step on chains with increasing numbers of joints, and of goals."""
    for n in JOINTS:
        robot = hinge_chain(n)
        try:
            goals: list[Goal] = list(pose_problem(solver, robot, "tip").given)
        except (GoalError, UnsupportedJointError):
            continue
        yield from _growth(solver, robot, goals, "joints", n, seed)
    for n in range(1, len(FIGURE_FRAMES) + 1):
        goals = [PositionGoal(frame, _ORIGIN) for frame in FIGURE_FRAMES[:n]]
        yield from _growth(solver, figure, goals, "goals", n, seed)


def _growth(
    solver: Solver,
    robot: Robot,
    goals: list[Goal],
    across: Literal["joints", "goals"],
    size: int,
    seed: int,
) -> Iterator[Growth]:
    """Yield the time of a step, or nothing if the method does not support the goals."""
    rng = np.random.default_rng([seed, size])
    # No solution is within this tolerance, so every solve takes all its steps.
    unattainable = Tolerance(1e-300, 1e-300)
    try:
        problem = Problem(
            robot,
            goals,
            solver=solver,
            tolerance=unattainable,
            budget=Budget(iterations=_STEPS),
            seed=seed,
        )
        problem.solve()
    except (GoalError, UnsupportedJointError):
        return
    steps = []
    for _ in range(_PROBLEMS):
        q = robot.sample(rng)
        if across == "goals":
            # Half way from home, so that the limbs reach their goals without the base.
            q = robot.clip(robot.home + 0.5 * (q - robot.home))
        for index, goal in enumerate(goals):
            problem.retarget(robot.forward(q, goal.frame), index)
        solution = problem.solve()
        if not solution.iterations:
            return  # a closed form takes no steps
        steps.append(solution.seconds / solution.iterations)
    step_us = round(1e6 * float(np.median(steps)), 3)
    yield Growth(solver=solver.name, across=across, size=size, step_us=step_us)


def batches(robot: Robot, solver: Solver, poses: int, seed: int = 0) -> Iterator[Batch]:
    """Yield the fastest of three calls of ``solve_batch``, on one core and on all."""
    targets = make_set("cold", robot, poses, seed).targets
    solve_batch(robot, targets[:_BATCH_WARM_UP], solver=solver)
    for threads in sorted({1, usable_cores()}):
        calls = [solve_batch(robot, targets, solver=solver, threads=threads) for _ in range(3)]
        fastest = min(calls, key=lambda call: call.seconds)
        yield Batch(
            solver=solver.name,
            robot=robot.name,
            poses=poses,
            threads=threads,
            per_second=round(poses / fastest.seconds),
            success=float(fastest.converged.mean()),
        )

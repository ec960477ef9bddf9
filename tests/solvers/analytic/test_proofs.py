"""Proofs of unreachable goals: sound to the tolerance, and found for most of these goals."""

import numpy as np
import pytest

from robot_ik.batch import solve_batch
from robot_ik.geometry import Pose, quat_multiply, rotation_exp
from robot_ik.goals import PoseGoal, PositionGoal, Tolerance
from robot_ik.inverse_kinematics import solve
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solution import Status
from robot_ik.solvers.analytic import form_block, form_of, limb_proof
from robot_ik.solvers.analytic.limb_proof import limb_of
from robot_ik.solvers.analytic.proofs import PROOFS
from robot_ik.solvers.analytic.subproblems import RUN

ARMS = {
    "puma560": (None, None),
    "ur5e": (None, None),
    "srs_arm": (None, None),
    "right_arm": ("right_arm", "right_hand"),
    "left_leg": ("left_leg", "left_foot"),
}
# For these the proof evaluates only the elbow.
LIMBS = ("srs_arm", "right_arm", "left_leg")
TOLERANCES = [Tolerance(1e-4, 1e-3), Tolerance(1e-2, 5e-2), Tolerance(1e-6, 1e-6)]

# Two links in a plane, offset along the axis, inside limits.
TWO_LINKS = """<mujoco><compiler angle="radian"/><worldbody><body quat="0.9 0.1 -0.3 0.2">
<joint name="a" axis="0 0.6 0.8" range="-1 2"/><geom size="0.1"/>
<body pos="0.5 0.1 0"><joint name="b" axis="0 0.6 0.8" range="-2.4 -0.3"/><geom size="0.1"/>
<site name="tool" pos="0.3 0 0.2"/></body></body></worldbody></mujoco>"""


def arm(name, tmp_path):
    if name == "two links":
        (tmp_path / "arm.xml").write_text(TWO_LINKS)
        return load_robot(tmp_path / "arm.xml", tool="tool")
    group, tool = ARMS[name]
    return load_robot(name if group is None else "humanoid", joints=group, tool=tool)


def unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def row(pose):
    return np.concatenate([pose.position, pose.rotation.ravel()])


def proven_unreachable(robot, goal, tolerance, poses):
    """Return (n,) whether the proof calls poses unreachable, without solving them."""
    problem = Problem(robot, goal, solver="lm", tolerance=tolerance)
    if limb := limb_of(problem):
        run = limb_proof.RUN.allocate(
            given={
                "goals": problem.compiled.block,
                "search": problem.search,
                "limb": limb_proof.limb_block(limb, robot.tree),
            }
        )
        prove = limb_proof.prove_limb
        target = problem.search.arrays["target"]
        rows = [pose.matrix for pose in poses]
    else:
        problem = Problem(robot, goal, solver="analytic", tolerance=tolerance)
        form = form_of(problem)
        block = form_block(form, robot.tree)
        run = RUN.allocate(
            given={
                "tree": robot.tree.block,
                "goals": problem.compiled.block,
                "search": problem.search,
                "form": block,
            }
        )
        prove = PROOFS[form.family]
        target = block.arrays["target"]
        rows = [row(pose) for pose in poses]
    found = []
    for values in rows:
        target[...] = values
        found.append(prove(run.address))
    return np.array(found)


def random_q_at_edges(robot, rng):
    """Joint angles inside the limits, many of them at a limit or with aligned axes."""
    q = robot.sample(rng)
    luck = rng.random(robot.nq)
    q = np.where((luck < 0.15) & np.isfinite(robot.upper), robot.upper, q)
    q = np.where((luck > 0.85) & np.isfinite(robot.lower), robot.lower, q)
    return np.where((luck > 0.4) & (luck < 0.5), np.clip(0.0, robot.lower, robot.upper), q)


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("name", [*ARMS, "two links"])
def test_a_goal_within_tolerance_of_a_reachable_pose_is_never_unreachable(
    name, tolerance, tmp_path
):
    robot = arm(name, tmp_path)
    rng = np.random.default_rng(1)
    poses = []
    for k in range(700):
        pose = robot.forward(random_q_at_edges(robot, rng))
        share = 0.9999 if k % 2 else rng.random()
        poses.append(
            Pose(
                pose.position + unit(rng) * tolerance.position * share,
                quat_multiply(rotation_exp(unit(rng) * tolerance.angle * share), pose.wxyz),
            )
        )
    pose = robot.forward(robot.home)
    goal = PositionGoal(None, pose.position) if name == "two links" else PoseGoal.at(None, pose)
    assert not proven_unreachable(robot, goal, tolerance, poses).any()


@pytest.mark.parametrize("name", [*ARMS, "two links"])
def test_most_unreachable_goals_are_proven(name, tmp_path):
    robot = arm(name, tmp_path)
    rng = np.random.default_rng(2)
    centre, radius = robot.reach()
    if name == "two links":
        goals = [PositionGoal(None, centre + radius * unit(rng) * rng.random()) for _ in range(120)]
    else:
        goals = [
            PoseGoal(
                None, centre + radius * unit(rng) * rng.random() ** (1 / 3), rng.normal(size=4)
            )
            for _ in range(120)
        ]
    proven = proven_unreachable(robot, goals[0], TOLERANCES[0], [g.target for g in goals])
    solver = "auto" if name in LIMBS else "analytic"
    missed = 0
    for goal, never in zip(goals, proven, strict=True):
        solution = Problem(robot, goal, solver=solver).solve()
        missed += not solution.converged
        assert not (never and solution.converged)
    assert proven.sum() >= (0.5 if name in LIMBS else 0.97) * missed > 0


def test_a_hole_in_the_workspace_is_proven_without_limits():
    robot = load_robot("puma560")
    free = robot.forward(robot.home)
    column = Pose((0.02, 0.03, free.position[2]), free.wxyz)
    for pose, never in ((column, True), (free, False)):
        assert proven_unreachable(robot, PoseGoal.at(None, free), TOLERANCES[0], [pose])[0] == never


def test_status_and_batch_report_the_proof():
    robot = load_robot("puma560")
    rng = np.random.default_rng(3)
    poses = np.array([robot.forward(robot.sample(rng)).matrix for _ in range(20)])
    poses[::2, :3, 3] *= 1.6
    batch = solve_batch(robot, poses, solver="analytic")
    one = [
        solve(robot, PoseGoal.at(None, Pose.from_matrix(p)), solver="analytic").status
        for p in poses
    ]
    assert one == [Status(int(s)) for s in batch.status] and one.count(Status.UNREACHABLE) >= 5

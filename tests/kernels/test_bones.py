"""Points and bones of a chain: triangles, and how a joint moves the frames that it carries."""

import math

import numpy as np
import pytest

from robot_ik.chain import make_chain
from robot_ik.goals import PositionGoal
from robot_ik.kernels.block import Layout
from robot_ik.kernels.bones import (
    BONES,
    find_path,
    inner_radius,
    link_points,
    locate_all,
    relocate,
    triangle_angle,
)
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.search import count_all_goals
from robot_ik.problem import Problem
from robot_ik.robot import load_robot
from robot_ik.solvers.iterative import run_layout

NO_OPTIONS = Layout("NoOptions")
RUN = run_layout("BonesRun", BONES, NO_OPTIONS)
open_run = RUN.open


@kernel
def angle_of(a, c, b):
    """Angle of a triangle."""
    return triangle_angle(a, c, b)


@kernel
def locate_points(address):
    """Locate all points of a chain at search.q; return the number of points of its path."""
    run = open_run(address)
    count_all_goals(run.goals, run.search)
    link_points(run.tree, run.goals, run.search, run.work)
    locate_all(run.tree, run.goals, run.search, run.work)
    return find_path(run.tree, run.work)


@kernel
def radius_of(address, first, end):
    """Smallest distance between the ends of some bones."""
    return inner_radius(open_run(address).work, first, end)


@kernel
def move_joint(address, k):
    """Pose of joint ``k`` at search.q, and the frame of the goal that it carries."""
    run = open_run(address)
    relocate(run.tree, run.goals, run.search, run.work, k)


class Points:
    """The points of a robot with one position goal."""

    def __init__(self, robot):
        problem = Problem(robot, PositionGoal(None, (0.0, 0.0, 0.0)), solver="recursive")
        self.search = problem.search
        self.bones = BONES.allocate(problem.sizes)
        blocks = {
            "tree": robot.tree.block,
            "goals": problem.compiled.block,
            "search": problem.search,
            "work": self.bones,
            "options": NO_OPTIONS.allocate(),
        }
        self.run = RUN.allocate(given=blocks)

    def locate(self, q):
        """Return the positions of the points on the path."""
        self.search.arrays["q"][...] = q
        count = locate_points(self.run.address)
        return self.bones.arrays["point"][self.bones.arrays["path"][:count]]


@pytest.mark.parametrize(("a", "c", "b"), [(3.0, 4.0, 5.0), (1.0, 1.0, 1.0), (0.4, 0.7, 0.35)])
def test_the_angle_of_a_triangle_is_that_of_the_law_of_cosines(a, c, b):
    assert angle_of(a, c, b) == pytest.approx(math.acos((a * a + c * c - b * b) / (2.0 * a * c)))


def test_a_triangle_that_cannot_close_is_flat():
    assert angle_of(1.0, 3.0, 1.5) == 0.0
    assert angle_of(1.0, 1.0, 2.5) == pytest.approx(math.pi)
    # The arccosine would give 0 for the first of these.
    assert angle_of(1.0, 1.0, 1e-9) == pytest.approx(1e-9)


def test_points_of_a_chain_are_its_joints_and_its_tip():
    chain = make_chain(4, 0.3)
    points = Points(chain)
    q = chain.sample(np.random.default_rng(1))
    names = [f"link{i}" for i in range(1, 5)] + ["tip"]
    expected = [chain.measure(q, name).position for name in names]
    np.testing.assert_allclose(points.locate(q), expected, atol=1e-12)
    assert radius_of(points.run.address, 0, 5) == 0.0
    assert radius_of(points.run.address, 4, 5) == pytest.approx(0.3)


def test_points_of_hinges_are_on_their_axes():
    robot = load_robot("puma560")
    points = Points(robot)
    for q in (robot.home, robot.sample(np.random.default_rng(2))):
        positions = points.locate(q)
        jacobian = robot.jacobian(q)
        tip = robot.measure(q).position
        for v, point in enumerate(positions[:-1]):
            velocity = np.cross(jacobian[3:, v], tip - point)
            np.testing.assert_allclose(velocity, jacobian[:3, v], atol=1e-12)
        np.testing.assert_allclose(positions[-1], tip, atol=1e-12)


def test_a_joint_moves_the_frame_that_it_carries_as_a_forward_pass_does():
    robot = load_robot("puma560")
    points = Points(robot)
    q = robot.sample(np.random.default_rng(3))
    points.locate(q)
    moved = q.copy()
    moved[1] = robot.home[1] + 0.3
    points.search.arrays["q"][...] = moved
    move_joint(points.run.address, 1)
    pose = robot.forward(moved)
    row = points.search.arrays["frames"][0]
    np.testing.assert_allclose(row[:3], pose.position, atol=1e-12)
    np.testing.assert_allclose(row[3:].reshape(3, 3), pose.rotation, atol=1e-12)

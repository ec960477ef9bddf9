"""Random starts: inside the limits, spread over their range, equal for equal seeds."""

import numpy as np

from robot_ik.goals import PostureGoal
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.residuals import GOALS
from robot_ik.kernels.search import SEARCH, draw
from robot_ik.kernels.tree import TREE
from robot_ik.problem import Problem

RUN = Layout("Draws", tree=TREE, goals=GOALS, search=SEARCH)
open_run = RUN.open

MIXED = """<mujoco><compiler angle="radian"/><worldbody>
<body name="a"><joint name="hinge" range="0.2 0.9"/>
 <joint name="slide" type="slide" range="-0.3 0.1"/>
 <geom size="0.1"/>
 <body name="b"><joint name="ball" type="ball" range="0 0.7" limited="true"/><geom size="0.1"/>
  <body name="c"><joint name="still" range="-1 1"/><joint name="endless"/><geom size="0.1"/></body>
 </body></body>
<body name="f"><freejoint name="free"/><geom size="0.1"/></body>
</worldbody></mujoco>"""


@kernel
def draw_many(address, out):
    """Write random starts to the rows of ``out``."""
    run = open_run(address)
    for i in range(out.shape[0]):
        draw(run.tree, run.goals, run.search)
        for j in range(out.shape[1]):
            out[i, j] = run.search.q[j]


def starts(robot, seed, count=2000, joints=None):
    """Random starts (count, nq) for a goal that some joints move, or all."""
    weights = dict.fromkeys(joints or robot.joints, 1.0)
    problem = Problem(
        robot, PostureGoal(q=robot.home, joints=weights, only_named=True), solver="lm"
    )
    blocks = {
        "tree": robot.tree.block,
        "goals": problem.compiled.block,
        "search": problem.search,
    }
    run = RUN.allocate(given=blocks)
    start = np.zeros(robot.nq)
    start[-7:] = [1, 2, 3, 1, 0, 0, 0]
    problem.search["random_state"] = seed
    problem.search.arrays["start"][:] = start
    problem.search.arrays["q"][:] = start
    out = np.empty((count, robot.nq))
    draw_many(run.address, out)
    return out


def test_starts_are_inside_the_limits_and_fill_them(load_xml):
    robot = load_xml(MIXED)
    out = starts(robot, 12345)
    for q in out[:300]:
        np.testing.assert_allclose(robot.clip(q), q, atol=1e-12)
    for column, lower, upper in [
        (0, 0.2, 0.9),
        (1, -0.3, 0.1),
        (6, -1, 1),
        (7, -np.pi, np.pi),
        (8, 0, 2),
        (10, 2, 4),
    ]:
        spread = (out[:, column] - lower) / (upper - lower)
        assert 0.0 <= spread.min() < 0.01 and 0.99 < spread.max() <= 1.0, column
        assert abs(spread.mean() - 0.5) < 0.04 and abs(spread.std() - 12**-0.5) < 0.02, column
    cone = 2 * np.arccos(np.clip(out[:, 2], -1, 1))
    assert cone.max() <= 0.7 + 1e-9 and cone.max() > 0.69
    np.testing.assert_allclose(np.linalg.norm(out[:, 2:6], axis=1), 1.0, atol=1e-12)
    assert np.abs(out[:, 3:6].mean(axis=0)).max() < 0.02  # no direction is preferred


def test_the_same_seed_gives_equal_bits_and_other_seeds_do_not(load_xml):
    robot = load_xml(MIXED)
    assert np.array_equal(starts(robot, 7, 50), starts(robot, 7, 50))
    assert not np.array_equal(starts(robot, 7, 50), starts(robot, 8, 50))


def test_joints_that_move_no_goal_keep_their_values(load_xml):
    robot = load_xml(MIXED)
    out = starts(robot, 3, 20, joints=("hinge", "ball"))
    assert not out[:, [1, 6, 7]].any() and np.array_equal(
        out[:, 8:], np.tile([1, 2, 3, 1, 0, 0, 0], (20, 1))
    )
    assert out[:, 0].std() > 0 and out[:, 3].std() > 0

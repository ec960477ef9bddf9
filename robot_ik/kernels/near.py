"""Whether a solve starts near its goal, asked before a method is chosen."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.jit import kernel
from robot_ik.kernels.kinematics import forward
from robot_ik.kernels.residuals import evaluate, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import open_run, open_work


@kernel
def starts_near(run, limit):
    """Whether half the squared residual at work.start is below ``limit``; changes work space only."""
    run = open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), open_work(run.work)
    forward(tree, work.nodes, work.start, work.world, work.scratch)
    cost, _ = evaluate(tree, goal, work)
    return cost < limit

"""Whether a solve starts near its goal, asked before a method is chosen."""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.jit import kernel
from robot_ik.kernels.kinematics import forward
from robot_ik.kernels.residuals import evaluate, open_goals
from robot_ik.kernels.tree import open_tree
from robot_ik.kernels.work import open_run, open_work

# A start with half the squared residual (rad²) below this is near its goal: ``lm`` takes a few steps.
_NEAR = 0.01


@kernel
def starts_near(run):
    """Whether work.start is near the goal; changes work space only."""
    run = open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), open_work(run.work)
    forward(tree, work.nodes, work.start, work.world, work.scratch)
    cost, _ = evaluate(tree, goal, work)
    return cost < _NEAR


@kernel
def starts_near_many(run, targets, starts, near):
    """The same for each row of targets (n, 12) of the one goal, and starts (n, nq): 1 or 0 into near (n,)."""
    run = open_run(run)
    tree, goal, work = open_tree(run.tree), open_goals(run.goals), open_work(run.work)
    for row in range(targets.shape[0]):
        same = row > 0  # as the start before it, mostly: its pose is known
        for i in range(starts.shape[1]):
            same = same and starts[row, i] == work.start[i]
            work.start[i] = starts[row, i]
        if not same:
            forward(tree, work.nodes, work.start, work.world, work.scratch)
        for i in range(12):
            goal.target[0, i] = targets[row, i]
        cost, _ = evaluate(tree, goal, work)
        near[row] = 1 if cost < _NEAR else 0

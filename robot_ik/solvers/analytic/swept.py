"""``PreparedSwept``: a free solution of an arm of seven hinges, angle by angle of the last joint.

With its last joint fixed the arm has the closed form of ``crossed_wrist.py``. The last joint is
tried at its start and then at increasing distances from it, to both sides. The first branch inside
the limits that keeps the margin is the solution. For each last angle the branches are tried in the
order of their distance from the start. If no try succeeds, nothing is proven.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.budget import Budget
from robot_ik.goals import PoseGoal
from robot_ik.kernels import jit, so3
from robot_ik.kernels.block import Block, Layout
from robot_ik.kernels.collision import FREE, verdict
from robot_ik.kernels.collision import RUN as COLLISION
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import clip
from robot_ik.kernels.residuals import GOALS
from robot_ik.kernels.search import CONVERGED, SEARCH, keep_best, measure
from robot_ik.kernels.tree import TREE
from robot_ik.solution import Solution, Status
from robot_ik.solvers.analytic import complete_goal, form_block
from robot_ik.solvers.analytic.crossed_wrist import crossed_wrist
from robot_ik.solvers.analytic.recognise import LastJoint, recognise_before_last
from robot_ik.solvers.analytic.subproblems import (
    EVERY,
    FORM,
    SOLVE,
    clear,
    image,
    measure_start,
)

if TYPE_CHECKING:
    from robot_ik.problem import Problem

# Angles of the last joint in its whole range.
_TRIES = 24

LAST = Layout(
    "LastJoint",
    column="int",  # its coordinate in q
    lower="float",  # rad, finite
    upper="float",
    axis="floats",  # (6,) direction and a point at q = 0, world
    tool="table",  # (1, 12) pose of the frame at q = 0, world
)
RUN = Layout(
    "SweptRun",
    tree=TREE,
    goals=GOALS,
    search=SEARCH,
    form=FORM,
    last=LAST,
    collision=COLLISION,
)
open_run = RUN.open


@inlined
def fix_last(form, last, angle):
    """Write form.extra of the closed form for an angle of the last joint."""
    extra = form.extra
    axis = so3.read_vector_at(last.axis, 0)
    point = so3.read_vector_at(last.axis, 3)
    c = math.cos(angle)
    s = math.sin(angle)
    x, y, z = so3.transpose(so3.read_rotation(last.tool, 0))
    # The wrist, seen from the frame: the joint is turned back, and then the frame is at q = 0.
    wrist = so3.subtract(so3.read_vector(extra, 0, 0), point)
    wrist = so3.add(so3.rotate(axis, c, -s, wrist), point)
    wrist = so3.subtract(wrist, so3.read_vector(last.tool, 0, 0))
    so3.write_row(extra, 1, (so3.dot(x, wrist), so3.dot(y, wrist), so3.dot(z, wrist)))
    columns = so3.rotate(axis, c, s, x), so3.rotate(axis, c, s, y), so3.rotate(axis, c, s, z)
    rows = so3.transpose(columns)
    so3.write_row(extra, 2, rows[0])
    so3.write_row(extra, 3, rows[1])
    so3.write_row(extra, 4, rows[2])


@inlined
def nearest_untried(form):
    """Return the row of the branch inside the limits that is nearest to the start, or -1.

    Writes its angles, moved by multiples of 2π, to form.best, and removes the branch.
    """
    branches = form.branches
    closest = math.inf
    chosen = -1
    for row in range(branches.shape[0]):
        if math.isnan(branches[row, 0]):
            continue
        fits = True
        distance = 0.0
        for j in range(form.best.shape[0]):
            angle, inside = image(branches[row, j], form.start[j], form.lower[j], form.upper[j])
            fits = fits and inside
            distance += (angle - form.start[j]) * (angle - form.start[j])
        if not fits:
            branches[row, 0] = math.nan
        elif distance < closest:
            closest = distance
            chosen = row
    if chosen >= 0:
        for j in range(form.best.shape[0]):
            angle, _ = image(branches[chosen, j], form.start[j], form.lower[j], form.upper[j])
            form.best[j] = angle
        branches[chosen, 0] = math.nan
    return chosen


@outlined
def take_free_branch(run, angle, margin):
    """Return whether a branch at an angle of the last joint is free; it is the solution then."""
    form = run.form
    search = run.search
    fix_last(form, run.last, angle)
    clear(form.branches)
    crossed_wrist(form, True)
    while nearest_untried(form) >= 0:
        for j in range(form.qadr.shape[0]):
            search.q[form.qadr[j]] = form.best[j]
        search.q[run.last.column] = angle
        clip(run.tree, run.goals.nodes, search.q)
        if verdict(run.collision, search.q, margin) != FREE:
            continue
        # At a singular pose the closed form is exact only to the square root of rounding.
        if measure(run.tree, run.goals, search):
            keep_best(search)
            search.status = CONVERGED
            return True
    return False


@kernel
def find_free(address, margin):
    """Return whether a free solution is found; it is search.best then."""
    run = open_run(address)
    last = run.last
    search = run.search
    if not measure_start(run.tree, run.goals, search, run.form, SOLVE):
        if verdict(run.collision, search.q, margin) == FREE:
            return True
        measure_start(run.tree, run.goals, search, run.form, EVERY)
    start = min(max(search.q[last.column], last.lower), last.upper)
    step = (last.upper - last.lower) / _TRIES
    for k in range(2 * _TRIES + 1):
        side = 1.0 if k % 2 == 1 else -1.0
        angle = start + side * ((k + 1) // 2) * step
        if last.lower <= angle <= last.upper and take_free_branch(run, angle, margin):
            return True
    return False


class PreparedSwept:
    """The sweep for one problem with a condition on collisions.

    Args:
        last: The last joint and the closed form of those before it.
        problem: The problem.
        collisions: Memory of collision checks, a block of ``collision.RUN``.
        margin: Smallest allowed distance, m.
    """

    def __init__(self, last: LastJoint, problem: Problem, collisions: Block, margin: float) -> None:
        tree = problem.robot.tree
        v = int(tree.vadr[last.node])
        joint = LAST.allocate(
            given={"axis": last.axis, "tool": np.ascontiguousarray(last.tool[None, :])}
        )
        joint["column"] = int(tree.qadr[last.node])
        joint["lower"] = float(tree.sample_lower[v])
        joint["upper"] = float(tree.sample_upper[v])
        self._run = RUN.allocate(
            given={
                "tree": tree.block,
                "goals": problem.compiled.block,
                "search": problem.search,
                "form": form_block(last.form, tree),
                "last": joint,
                "collision": collisions,
            }
        )
        self._margin = margin
        self._address = self._run.address
        jit.announce(find_free, "closed forms of arms with seven joints")
        self._find = jit.entry(find_free, self._address, margin)
        self._start = problem.search.arrays["start"]
        self._best = problem.search.arrays["best"]
        self._target = problem.search.arrays["target"].reshape(-1, 4, 4)

    def run(self, problem: Problem, budget: Budget) -> Solution | None:
        """Return a free solution, or None if the sweep finds none or must not be tried."""
        if problem.trace or budget.iterations < 1 or budget.seconds == 0.0:
            return None
        if not math.isfinite(sum(self._start.tolist())):
            return None
        began = time.perf_counter()
        if not self._find(self._address, self._margin):
            return None
        return Solution(
            self._best.copy(),
            Status.CONVERGED,
            problem.search["iterations"],
            0,
            time.perf_counter() - began,
            "analytic",
            problem.robot,
            problem.given,
            self._target.copy(),
            None,
        )


def last_joint_of(problem: Problem) -> LastJoint | None:
    """Return the last joint and the closed form before it, for a problem with one pose goal."""
    goal = complete_goal(problem)
    if not isinstance(goal, PoseGoal):
        return None
    node, local = problem.robot.attachment(goal.frame)
    return recognise_before_last(problem.robot.tree, node, local)

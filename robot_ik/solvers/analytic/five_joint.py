"""Arms with five joints: pan, three parallel pitch axes, roll. Exact position, best orientation.

An arm with five joints reaches a position with a one-dimensional set of orientations, which almost
never contains the target orientation. This closed form keeps the tool point at the target position
and minimises the angle to the target orientation, or of one axis. It proves a lower bound of the
angle. If the position is out of reach, it finds the nearest position.

    five_joint_pitch     the best pitch in closed form where the other parameter is fixed
    five_joint_search    branch and bound over that parameter
    five_joint_nearest   the nearest position for a target out of reach
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from robot_ik.budget import Budget
from robot_ik.geometry import Array, Pose
from robot_ik.goals import OrientationGoal, PoseGoal, PositionGoal
from robot_ik.kernels import frame_goals, jit, search, so3
from robot_ik.kernels.block import Block, Layout
from robot_ik.kernels.jit import inlined, kernel, outlined
from robot_ik.kernels.kinematics import clip, velocity_of
from robot_ik.kernels.residuals import GOALS
from robot_ik.kernels.search import CONVERGED, STALLED, copy, count_all_goals, keep_best, measure
from robot_ik.kernels.tree import HINGE, TREE, Tree
from robot_ik.solution import STATUS_OF, Solution
from robot_ik.solvers.analytic import five_joint_search as branches
from robot_ik.solvers.analytic.five_joint_nearest import (
    NEAREST,
    solve_nearest,
    solve_nearest_locally,
    tool_point,
)
from robot_ik.solvers.analytic.five_joint_pitch import ALL_AXES, ARM, ONE_AXIS, TARGET
from robot_ik.solvers.analytic.five_joint_search import (
    ANGLE,
    BOUND,
    BOX_LIMIT,
    GAP,
    ON_AXIS,
    OUTCOME,
    SEARCH,
)
from robot_ik.solvers.analytic.recognise import Family, axes_at_zero, is_five_joint
from robot_ik.solvers.base import BatchResult, FoundBranch, run_each

if TYPE_CHECKING:
    from robot_ik.problem import Problem

# rad. Angles that differ by less are equal. Then the branch of the start is taken.
_EQUAL_ANGLE = 1e-6
# m. For a target out of reach the tool may be this much farther away than the nearest position, so
# that a configuration exists that is not on the border of the workspace.
_ALLOWANCE = 1e-6

# ``close_position``: steps, m at which it ends, damping in m², and rad of the largest change.
_CLOSING_STEPS = 6
_CLOSED = 5e-7
_CLOSING_DAMPING = 1e-12
_LONGEST_CLOSING = 1e-3
# Elbow branches that ``five_joint_search`` has memory for.
_MAX_SHEETS = 4

RUN = Layout(
    "FiveJointRun",
    position_goal="int",  # goals with the position and the orientation; the same for a pose
    angle_goal="int",
    needs_angle="bool",  # the orientation decides whether the solve has converged
    angle_bound="float",  # rad; NaN if nothing is proven
    tree=TREE,
    goals=GOALS,
    search=search.SEARCH,
    arm=ARM,
    target=TARGET,
    find=SEARCH,
    nearest=NEAREST,
)
open_run = RUN.open

# Purpose of a run: the solution, the solution on the branch of the start, the optimum of every
# branch, or only the measurement of the start.
SOLVE, TRACK, EVERY, START_ONLY = range(4)


# Kernels


@inlined
def basis_vector(arm, vector):
    """Return a world vector in the axes of the basis."""
    return (
        so3.dot(so3.read_vector(arm.basis, 0, 0), vector),
        so3.dot(so3.read_vector(arm.basis, 1, 0), vector),
        so3.dot(so3.read_vector(arm.basis, 2, 0), vector),
    )


@inlined
def put_point(arm, target, local):
    """Write a position in the frame of the arm to ``target``."""
    target.range = math.sqrt(local[0] * local[0] + local[1] * local[1])
    target.azimuth = math.atan2(local[1], local[0])
    target.height = local[2]
    target.by_turn = target.range >= arm.radius


@outlined
def put_target(run):
    """Write the target in the frame of the arm to run.target."""
    arm = run.arm
    target = run.target
    point = so3.read_matrix_point(run.search.target, run.position_goal)
    put_point(
        arm, target, basis_vector(arm, so3.subtract(point, so3.read_vector_at(arm.origin, 0)))
    )
    rotation = so3.read_matrix_rotation(run.search.target, run.angle_goal)
    for j in range(3):
        column = so3.apply_inverse(rotation, so3.read_vector(arm.basis, j, 0))
        if target.kind == ONE_AXIS:
            column = (0.0, 0.0, column[2])
        for i in range(3):
            target.matrix[i, j] = so3.dot(so3.read_vector(arm.tail, i, 0), column)


@inlined
def put_start(run):
    """Write the joint angles in search.q as the start of the branches."""
    arm = run.arm
    for k in range(5):
        run.find.start[k] = arm.signs[k] * run.search.q[arm.qadr[k]]


@outlined
def take_joint_angles(run, branch):
    """Write the joint angles of a branch to search.q and measure them; return whether within."""
    arm = run.arm
    for k in range(5):
        run.search.q[arm.qadr[k]] = arm.signs[k] * run.find.qs[branch, k]
    clip(run.tree, run.goals.nodes, run.search.q)
    return measure(run.tree, run.goals, run.search)


@outlined
def close_position(run):
    """Remove a position error of some micrometres from search.q; return whether within tolerance.

    It remains where several joints are at their limits, see ``ON_BOUNDARY``. There a micrometre may
    cost some hundredths of a degree, so smaller errors are not corrected.
    """
    state = run.search
    within = measure(run.tree, run.goals, state)
    for _ in range(_CLOSING_STEPS):
        distance = state.error[run.position_goal, 0]
        if distance < _CLOSED:
            break
        copy(state.q, state.best)
        step_to_target(run)
        within = measure(run.tree, run.goals, state)
        if not state.error[run.position_goal, 0] < distance:
            copy(state.best, state.q)
            return measure(run.tree, run.goals, state)
    return within


@outlined
def step_to_target(run):
    """Take a Gauss-Newton step of the position. Joints at their limits do not move outwards."""
    state = run.search
    tree = run.tree
    arm = run.arm
    point = so3.read_vector(state.frames, run.position_goal, 0)
    error = so3.subtract(so3.read_matrix_point(state.target, run.position_goal), point)
    stopped = (False, False, False, False, False)
    for _ in range(5):
        xx = _CLOSING_DAMPING
        yy = _CLOSING_DAMPING
        zz = _CLOSING_DAMPING
        xy = 0.0
        xz = 0.0
        yz = 0.0
        for k in range(5):
            if stopped[k]:
                continue
            v, _ = velocity_of(tree, state.world, arm.vadr[k], point)
            xx += v[0] * v[0]
            yy += v[1] * v[1]
            zz += v[2] * v[2]
            xy += v[0] * v[1]
            xz += v[0] * v[2]
            yz += v[1] * v[2]
        first = (xx, xy, xz)
        second = (xy, yy, yz)
        third = (xz, yz, zz)
        normal = so3.cross(second, third)
        scale = 1.0 / so3.dot(first, normal)
        solved = (
            scale * so3.dot(error, normal),
            scale * so3.dot(error, so3.cross(third, first)),
            scale * so3.dot(error, so3.cross(first, second)),
        )
        any_blocked = False
        for k in range(5):
            v, _ = velocity_of(tree, state.world, arm.vadr[k], point)
            dq = so3.dot(v, solved)
            q = state.q[arm.qadr[k]]
            dof = arm.vadr[k]
            outwards = q + dq > tree.upper[dof] if dq > 0.0 else q + dq < tree.lower[dof]
            if outwards and not stopped[k]:
                stopped = with_stopped(stopped, k)
                any_blocked = True
        if not any_blocked:
            break
    for k in range(5):
        if not stopped[k]:
            v, _ = velocity_of(tree, state.world, arm.vadr[k], point)
            dq = so3.dot(v, solved)
            state.q[arm.qadr[k]] += max(-_LONGEST_CLOSING, min(_LONGEST_CLOSING, dq))
    clip(tree, run.goals.nodes, state.q)


@inlined
def with_stopped(stopped, joint):
    """Return the five flags with the flag of ``joint`` set."""
    return (
        stopped[0] or joint == 0,
        stopped[1] or joint == 1,
        stopped[2] or joint == 2,
        stopped[3] or joint == 3,
        stopped[4] or joint == 4,
    )


@outlined
def choose_branch(find):
    """Return the branch with the smallest angle, or -1, and whether all branches were searched.

    Among equal angles the first branch is taken, which is that of the start.
    """
    smallest = math.inf
    complete = True
    for branch in range(find.branches):
        smallest = min(smallest, find.results[branch, ANGLE])
        complete = complete and find.results[branch, OUTCOME] != BOX_LIMIT
    for branch in range(find.branches):
        angle = find.results[branch, ANGLE]
        if angle < math.inf and angle <= smallest + _EQUAL_ANGLE:
            return branch, complete
    return -1, complete


@outlined
def smallest_bound(find):
    """Return the lower bound of the angle over all branches."""
    bound = math.inf
    for branch in range(find.branches):
        bound = min(bound, find.results[branch, BOUND])
    return bound


@outlined
def move_to_nearest(run, mode):
    """Move run.target to the nearest position that the arm reaches; if tracking, from the start."""
    arm = run.arm
    target = run.target
    across = target.range
    goal = (across * math.cos(target.azimuth), across * math.sin(target.azimuth), target.height)
    if mode == TRACK:
        distance = solve_nearest_locally(arm, target, run.nearest, run.find.start)
    else:
        distance = solve_nearest(arm, target, run.nearest)
    reached = tool_point(arm, run.nearest.q)
    if distance > 0.0:
        allowance = so3.scale(_ALLOWANCE / distance, so3.subtract(reached, goal))
        put_point(arm, target, so3.add(reached, allowance))


@outlined
def solve_run(run, mode):
    """Write the best point, the status and the bound of the angle."""
    state = run.search
    count_all_goals(run.goals, state)
    state.iterations = 0
    run.angle_bound = math.nan
    copy(state.start, state.q)
    clip(run.tree, run.goals.nodes, state.q)
    within = measure(run.tree, run.goals, state)
    keep_best(state)
    state.status = CONVERGED if within else STALLED
    if within and mode != EVERY and (run.needs_angle or state.error[run.angle_goal, 1] <= GAP):
        run.angle_bound = 0.0
        return
    if mode == START_ONLY:
        return
    state.iterations = 1
    put_target(run)
    put_start(run)
    if run.target.range < ON_AXIS and run.arm.radius < ON_AXIS:
        run.find.branches = 0
        return  # the pan is free: there are two parameters
    if mode == TRACK and track(run):
        take_joint_angles(run, 0)
        within = close_position(run)
        distance = state.error[run.position_goal, 0]
        if distance <= run.goals.tolerance[run.position_goal, 0]:
            keep_best(state)
            state.status = CONVERGED if within else STALLED
            return
    branches.solve_branches(run.arm, run.target, run.find, mode == EVERY)
    branch, complete = choose_branch(run.find)
    if branch >= 0:
        run.angle_bound = smallest_bound(run.find)
        take_joint_angles(run, branch)
        within = close_position(run)
        keep_best(state)
        state.status = CONVERGED if within else STALLED
    elif complete and mode != EVERY:
        take_nearest(run, mode)


@outlined
def track(run):
    """Solve on the branch of the start: near the start, or else anywhere on the branch."""
    if branches.track(run.arm, run.target, run.find):
        return True
    return branches.solve_first_branch(run.arm, run.target, run.find)


@outlined
def take_nearest(run, mode):
    """Solve for the nearest position, with the best orientation there."""
    state = run.search
    move_to_nearest(run, mode)
    if mode == TRACK and track(run):
        within = take_joint_angles(run, 0)
        keep_best(state)
        state.status = CONVERGED if within else STALLED
        put_target(run)
        return
    branches.solve_branches(run.arm, run.target, run.find, False)
    branch, _ = choose_branch(run.find)
    if branch < 0:
        branch = 0
        for k in range(5):
            run.find.qs[0, k] = run.nearest.q[k]
    else:
        run.angle_bound = smallest_bound(run.find)
    within = take_joint_angles(run, branch)
    keep_best(state)
    state.status = CONVERGED if within else STALLED
    put_target(run)


@outlined
def prove_run(run):
    """Return whether no joint angles bring the frame within tolerance of its target."""
    distance = run.goals.tolerance[run.position_goal, 0]
    angle = run.goals.tolerance[run.angle_goal, 1] if run.needs_angle else math.inf
    put_target(run)
    if run.target.range < ON_AXIS and run.arm.radius < ON_AXIS:
        return False
    return branches.is_out_of_reach(run.arm, run.target, run.find, distance, angle)


@kernel
def five_joints(address, mode):
    """Run one solve."""
    run = open_run(address)
    solve_run(run, mode)
    if run.search.status == STALLED and mode <= TRACK and prove_run(run):
        run.search.status = search.UNREACHABLE


@kernel
def five_joints_many(address, mode, targets, starts, q, status, error, iterations, bound):
    """Run one solve for each row of targets (n, 4, 4) and starts (n, nq).

    Writes q (n, nq), status (n,), error (n, 2), iterations (n,), bound (n,).
    """
    run = open_run(address)
    state = run.search
    for row in range(targets.shape[0]):
        search.take_row(state, targets, starts, row)
        solve_run(run, mode)
        if state.status == STALLED and prove_run(run):
            state.status = search.UNREACHABLE
        for i in range(state.best.shape[0]):
            q[row, i] = state.best[i]
        status[row] = state.status
        error[row, 0] = state.error[run.position_goal, 0]
        error[row, 1] = state.error[run.angle_goal, 1]
        iterations[row] = state.iterations
        bound[row] = run.angle_bound


# The arm


@dataclass(frozen=True, eq=False)
class FiveJointForm:
    """A five-joint arm and the goal of a problem for its frame.

    Attributes:
        arm: Block of ``ARM``.
        kind: ALL_AXES or ONE_AXIS.
        position_goal: Index of the position among the parts of the problem's goals.
        angle_goal: Index of the orientation among them.
        needs_angle: Whether the orientation decides convergence.
    """

    family: ClassVar[Family] = Family.FIVE_JOINT

    arm: Block
    kind: int
    position_goal: int
    angle_goal: int
    needs_angle: bool


def five_joint_form(problem: Problem) -> FiveJointForm | None:
    """Return the closed form of a problem with a five-joint arm; None if there is none.

    The goals are a pose, or a position and an orientation that is soft or of a later priority.
    """
    places = _goal_indices(problem)
    if places is None:
        return None
    position, angle = places
    rows = problem.compiled.goal_rows
    if rows[position].position_part != frame_goals.ALL_COORDINATES:
        return None
    if not problem.parts[position].weights[0] > 0.0 or not problem.parts[angle].weights[1] > 0.0:
        return None
    if problem.features - {"soft", "priorities"}:
        return None
    goal = problem.parts[angle]
    tree = problem.robot.tree
    node, _ = problem.robot.attachment(goal.frame)
    chain = tree.ancestors(node)
    if len(chain) != 5 or any(int(tree.kind[k]) != HINGE for k in chain):
        return None
    local = problem.compiled.block.arrays["local"][angle]
    axes, tool = axes_at_zero(tree, chain, local)
    if not is_five_joint(axes):
        return None
    all_axes = rows[angle].orientation_part == frame_goals.ALL_AXES
    return FiveJointForm(
        arm=arm_block(tree, chain, axes, tool),
        kind=ALL_AXES if all_axes else ONE_AXIS,
        position_goal=position,
        angle_goal=angle,
        needs_angle=not goal.soft,
    )


def _goal_indices(problem: Problem) -> tuple[int, int] | None:
    """Return the indices of the position and orientation goal; None for other goals."""
    parts = problem.parts
    kinds = [type(part) for part in parts]
    if kinds == [PoseGoal]:
        return None if parts[0].soft else (0, 0)
    if sorted(kind.__name__ for kind in kinds) != ["OrientationGoal", "PositionGoal"]:
        return None
    position = kinds.index(PositionGoal)
    angle = kinds.index(OrientationGoal)
    robot = problem.robot
    same_frame = (parts[position].frame or robot.tool) == (parts[angle].frame or robot.tool)
    is_later = parts[angle].soft or parts[angle].priority > parts[position].priority
    return (position, angle) if same_frame and is_later and not parts[position].soft else None


def arm_block(tree: Tree, chain: list[int], axes: Array, tool: Pose) -> Block:
    """Return the numbers of an arm and its frame.

    Args:
        tree: The kinematic tree.
        chain: The five joints, root first.
        axes: (5, 6) direction and a point of each joint axis at q = 0, world.
        tool: Pose of the frame at q = 0.
    """
    pan = axes[0, :3]
    lift = axes[1, :3]
    roll = axes[4, :3]
    basis = np.array([np.cross(lift, pan), lift, pan])
    signs = np.array([1.0, 1.0, np.sign(lift @ axes[2, :3]), np.sign(lift @ axes[3, :3]), 1.0])
    points = (np.vstack([axes[:, 3:], tool.position]) - axes[0, 3:]) @ basis.T
    roll_axis = basis @ roll
    offset = points[5] - points[4]
    across = float(offset @ (basis @ np.cross(lift, roll)))
    beside = float(offset[1])
    radius = math.hypot(across, beside)
    foot = points[4] + (offset @ roll_axis) * roll_axis
    direction = _plane_point(roll_axis)
    level = np.array(
        [
            [direction.real, 0.0, -direction.imag],
            [0.0, 1.0, 0.0],
            [direction.imag, 0.0, direction.real],
        ]
    )
    lower, upper = _limits(tree, chain, signs)
    upper_link = _plane_point(points[2] - points[1])
    fore_link = _plane_point(points[3] - points[2])
    pitch_zero = float(np.angle(direction))
    ends = [
        np.exp(1j * lower[1]) * upper_link,
        np.exp(1j * upper[1]) * upper_link,
        np.exp(-1j * (pitch_zero + lower[3])) * fore_link,
        np.exp(-1j * (pitch_zero + upper[3])) * fore_link,
    ]
    bend_zero = float(np.angle(fore_link) - np.angle(upper_link))
    block = ARM.allocate(
        given={
            "ends": np.array([[end.real, end.imag] for end in ends]),
            "lower": lower,
            "upper": upper,
            "sheets": _sheets(
                abs(upper_link), abs(fore_link), lower[2] + bend_zero, upper[2] + bend_zero
            ),
            "basis": basis,
            "origin": np.ascontiguousarray(axes[0, 3:]),
            "signs": signs,
            "tail": np.ascontiguousarray(level @ basis @ tool.rotation),
            "qadr": np.ascontiguousarray(tree.qadr[chain]),
            "vadr": np.ascontiguousarray(tree.vadr[chain]),
        }
    )
    shoulder = _plane_point(points[1])
    tool_foot = _plane_point(foot - points[3]) / direction
    scalars = {
        "shoulder_x": shoulder.real,
        "shoulder_y": shoulder.imag,
        "upper_length": abs(upper_link),
        "fore_length": abs(fore_link),
        "upper_angle": float(np.angle(upper_link)),
        "fore_angle": float(np.angle(fore_link)),
        "tool_x": tool_foot.real,
        "tool_y": tool_foot.imag,
        "side": float(points[4, 1]),
        "radius": radius,
        "turn_zero": math.atan2(beside, across) if radius > 0.0 else 0.0,
        "pitch_zero": pitch_zero,
    }
    for name, value in scalars.items():
        block[name] = value
    return block


def _plane_point(vector: Array) -> complex:
    """Return a vector in the axes of the basis as a point x − iz of the arm plane."""
    return complex(vector[0], -vector[2])


def _limits(tree: Tree, chain: list[int], signs: Array) -> tuple[Array, Array]:
    """Return the limits (5,), rad, about the axes of the basis; ±π for joints without limits."""
    dofs = tree.vadr[chain]
    first = signs * tree.lower[dofs]
    second = signs * tree.upper[dofs]
    lower = np.minimum(first, second)
    upper = np.maximum(first, second)
    return np.where(np.isfinite(lower), lower, -math.pi), np.where(
        np.isfinite(upper), upper, math.pi
    )


def _sheets(upper_length: float, fore_length: float, lower: float, upper: float) -> Array:
    """Return the elbow branches (s, 3): sign, shortest and longest shoulder-wrist distance.

    Args:
        upper_length: Link from lift to elbow, metres.
        fore_length: Link from elbow to wrist, metres.
        lower: Lower limit of the elbow's bend, 0 for a stretched arm.
        upper: Upper limit.
    """
    rows = []
    for sign, first, last in ((1.0, 0.0, math.pi), (-1.0, -math.pi, 0.0)):
        for turn in (-2.0 * math.pi, 0.0, 2.0 * math.pi):
            ends = (max(first, lower + turn), min(last, upper + turn))
            if ends[1] > ends[0]:
                distances = [abs(upper_length + fore_length * np.exp(1j * bend)) for bend in ends]
                rows.append((sign, min(distances), max(distances)))
    return np.array(rows[:_MAX_SHEETS]).reshape(-1, 3)


# The method


class PreparedFiveJoint:
    """The closed form of a five-joint arm, prepared for one problem."""

    name = "analytic"
    proves_best = True

    def __init__(self, form: FiveJointForm, problem: Problem) -> None:
        self.form = form
        self.search = problem.search
        target = TARGET.allocate()
        target["kind"] = form.kind
        self._run = RUN.allocate(
            given={
                "tree": problem.robot.tree.block,
                "goals": problem.compiled.block,
                "search": problem.search,
                "arm": form.arm,
                "target": target,
                "find": SEARCH.allocate(),
                "nearest": NEAREST.allocate(),
            }
        )
        for name in ("position_goal", "angle_goal", "needs_angle"):
            self._run[name] = getattr(form, name)
        self._mode = TRACK if problem.keep_branch else SOLVE
        self._trace_requested = problem.trace
        address = self._run.address
        jit.announce(five_joints, "the closed form of five joints")
        self._solve = partial(jit.entry(five_joints, address, SOLVE), address)
        self._solve_many = partial(five_joints_many, address, self._mode)
        self._start = problem.search.arrays["start"]
        self._best = problem.search.arrays["best"]
        self._target = problem.search.arrays["target"].reshape(-1, 4, 4)
        self._outcome = problem.search.scalar_words[:2]

    @property
    def best_cost(self) -> float:
        """Cost of the last solution."""
        return float(self.search["best_cost"])

    def run(self, problem: Problem, budget: Budget) -> Solution:
        """Solve the problem."""
        began = time.perf_counter()
        only_start = budget.iterations < 1 or budget.seconds == 0.0
        self._solve(START_ONLY if only_start else self._mode)
        status, iterations = self._outcome.tolist()
        if status != CONVERGED:
            problem.require_finite()
            if only_start:
                status = search.ITERATION_LIMIT if budget.iterations < 1 else search.TIME_LIMIT
        bound = self._run["angle_bound"]
        return Solution(
            self._best.copy(),
            STATUS_OF[status],
            iterations,
            0,
            time.perf_counter() - began,
            self.name,
            problem.robot,
            problem.given,
            self._target.copy(),
            self._trace() if self._trace_requested and iterations else None,
            angle_bound=None if math.isnan(bound) else bound,
        )

    def run_many(
        self,
        problem: Problem,
        targets: Array,
        starts: Array,
        results: BatchResult,
        budget: Budget,
    ) -> None:
        """Solve row by row in compiled code."""
        if budget.iterations < 1 or budget.seconds is not None:
            run_each(self, problem, targets, starts, results, budget)
            return
        self._solve_many(
            targets,
            starts,
            results.q,
            results.status,
            results.error,
            results.iterations,
            results.angle_bound,
        )

    def branches(self) -> list[FoundBranch]:
        """Return the optimum of each branch."""
        self._solve(EVERY)
        find = self._run.nested["find"].arrays
        arm = self.form.arm.arrays
        by_turn = self._run.nested["target"]["by_turn"]
        branches = []
        for branch in range(self._run.nested["find"]["branches"]):
            _, angle, bound = find["results"][branch].tolist()
            if not math.isfinite(angle):
                continue
            back, sheet = find["order"][branch].tolist()
            title = ("front", "back")[back] if by_turn else ("roll+", "roll-")[back]
            elbow = "elbow+" if arm["sheets"][sheet, 0] > 0.0 else "elbow-"
            q = self._start.copy()
            q[arm["qadr"]] = arm["signs"] * find["qs"][branch]
            branches.append(FoundBranch(f"{title} {elbow}", q, angle, bound))
        return branches

    def _trace(self) -> Array:
        """Return the trace, which has one row."""
        arrays = self.search.arrays
        position, angle = arrays["error"].max(axis=0)
        step = float(np.linalg.norm(arrays["q"] - self._start))
        return np.array([[1.0, 0.0, self.best_cost, position, angle, 0.0, step]])

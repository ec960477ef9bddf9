"""``PreparedProof``: proves that a goal of a seven-axis limb is out of reach, without solving it.

The distance from shoulder to wrist depends on the elbow alone (Tolani, Goswami & Badler, Graphical
Models 62, 2000). If no elbow angle inside its limits gives the distance that the goal requires,
nothing within tolerance can be reached.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from robot_ik.budget import Budget
from robot_ik.geometry import Array
from robot_ik.goals import PoseGoal
from robot_ik.kernels import jit, so3
from robot_ik.kernels.block import Block, Layout
from robot_ik.kernels.jit import inlined, kernel
from robot_ik.kernels.residuals import GOALS
from robot_ik.kernels.search import SEARCH
from robot_ik.kernels.tree import Tree
from robot_ik.solution import Solution, Status
from robot_ik.solvers.analytic import complete_goal
from robot_ik.solvers.analytic.proofs import centre_error, may_fit, third_side
from robot_ik.solvers.analytic.recognise import Limb, recognise_limb
from robot_ik.solvers.analytic.subproblems import height_terms
from robot_ik.solvers.base import BatchResult

if TYPE_CHECKING:
    from robot_ik.problem import Problem

LIMB = Layout(
    "Limb",
    shoulder="floats",  # (3,) centre of the shoulder at q = 0, world
    elbow="floats",  # (6,) direction and a point of the elbow axis at q = 0, world
    wrist="floats",  # (3,) centre of the wrist at q = 0, world
    wrist_in_tool="floats",  # (3,)
    limits="floats",  # (2,) of the elbow
)
RUN = Layout("LimbProofRun", goals=GOALS, search=SEARCH, limb=LIMB)
open_run = RUN.open


def limb_of(problem: Problem) -> Limb | None:
    """Return the limb of a problem with one goal that determines its wrist; else None."""
    goal = complete_goal(problem)
    if goal is None:
        return None
    full_pose = isinstance(goal, PoseGoal)
    node, local = problem.robot.attachment(goal.frame)
    return recognise_limb(problem.robot.tree, node, local, full_pose=full_pose)


def limb_block(limb: Limb, tree: Tree) -> Block:
    """Return the memory of a limb."""
    v = int(tree.vadr[limb.elbow_node])
    arrays = {
        "shoulder": limb.shoulder,
        "elbow": limb.elbow,
        "wrist": limb.wrist,
        "wrist_in_tool": limb.wrist_in_tool,
        "limits": np.array([tree.lower[v], tree.upper[v]]),
    }
    return LIMB.allocate(
        given={name: np.ascontiguousarray(array) for name, array in arrays.items()}
    )


class PreparedProof:
    """The proof for one problem. A solve ends UNREACHABLE, or STALLED without a proof."""

    name = "proof"
    proves_best = False

    def __init__(self, limb: Limb, problem: Problem) -> None:
        blocks = {
            "goals": problem.compiled.block,
            "search": problem.search,
            "limb": limb_block(limb, problem.robot.tree),
        }
        self._run = RUN.allocate(given=blocks)
        self._address = self._run.address
        jit.announce(prove_limb, "proofs of unreachable goals")
        self._prove = jit.entry(prove_limb, self._address)
        self._best = problem.search.arrays["best"]
        self._target = problem.search.arrays["target"].reshape(-1, 4, 4)

    def run(self, problem: Problem, _budget: Budget) -> Solution:
        """Return the best point so far, UNREACHABLE if the proof succeeds."""
        began = time.perf_counter()
        status = Status.UNREACHABLE if self._prove(self._address) else Status.STALLED
        return Solution(
            self._best.copy(),
            status,
            0,
            0,
            time.perf_counter() - began,
            self.name,
            problem.robot,
            problem.given,
            self._target.copy(),
            None,
        )

    def run_many(
        self,
        _problem: Problem,
        targets: Array,
        _starts: Array,
        results: BatchResult,
        _budget: Budget,
    ) -> None:
        """Write the status of each row, and an infinite error, because a proof finds no point."""
        results.error[...] = np.inf
        for row in range(len(targets)):
            self._target[0] = targets[row]
            proven = self._prove(self._address)
            results.status[row] = Status.UNREACHABLE if proven else Status.STALLED


@kernel
def prove_limb(address):
    """Return whether no joint angles bring the frame within tolerance of its target."""
    run = open_run(address)
    limb = run.limb
    shoulder = so3.read_vector_at(limb.shoulder, 0)
    axis = so3.read_vector_at(limb.elbow, 0)
    elbow = so3.read_vector_at(limb.elbow, 3)
    wrist_in_tool = so3.read_vector_at(limb.wrist_in_tool, 0)
    wrist = wanted_wrist(run.search, wrist_in_tool)
    distance = so3.norm(so3.subtract(wrist, shoulder))
    error = centre_error(run.goals.tolerance, so3.norm(wrist_in_tool))

    to_shoulder = so3.subtract(shoulder, elbow)
    to_wrist = so3.subtract(so3.read_vector_at(limb.wrist, 0), elbow)
    constant, amplitude, middle = height_terms(to_shoulder, axis, to_wrist)
    squares = so3.dot(to_wrist, to_wrist) + so3.dot(to_shoulder, to_shoulder)
    half, radius, possible = third_side(squares - 2.0 * constant, distance, error, amplitude)
    if not possible:
        return True
    lower = limb.limits[0]
    upper = limb.limits[1]
    return not (
        may_fit(middle + half, radius, lower, upper) or may_fit(middle - half, radius, lower, upper)
    )


@inlined
def wanted_wrist(search, wrist_in_tool):
    """Return the position of the wrist's centre (3,), world, m, at the target."""
    rotated = so3.apply(so3.read_matrix_rotation(search.target, 0), wrist_in_tool)
    return so3.add(so3.read_matrix_point(search.target, 0), rotated)

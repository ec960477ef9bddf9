"""The recipes of docs/how-to/extend.md for a solver, a goal and a command, in a copy."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "how-to" / "extend.md").read_text(encoding="utf-8")

# An editable install has a finder that comes before sys.path.
USE_COPY = """
import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
import numpy as np
import robot_ik as rik
assert rik.__file__.startswith(sys.argv[1])
robot = rik.load_robot("puma560")
"""

SOLVER = """
from robot_ik.solvers import SOLVERS

goal = rik.PoseGoal("gripper", (-0.45, -0.10, 0.80), (0, 1, 0, 0))
solution = rik.solve(robot, goal, solver="gradient", gain=0.9).require()
assert solution.solver == "gradient" and solution.iterations > 0
assert solution.error.position <= 1e-4 and solution.error.angle <= 1e-3
assert SOLVERS["gradient"].title == "steepest descent"
try:
    rik.solve(robot, goal, solver="gradient", gain=5.0)
except rik.RobotIkError as error:
    assert "0.01 to 1.99" in str(error)
else:
    raise AssertionError("a gain out of range was accepted")
"""

GOAL = """
import mujoco
from robot_ik.goals import GOALS, PerpendicularGoal
from robot_ik.kernels.block import Layout
from robot_ik.kernels.jit import kernel
from robot_ik.kernels.residuals import GOALS as GOAL_ARRAYS, goal_jacobian
from robot_ik.kernels.search import SEARCH, count_all_goals, measure
from robot_ik.kernels.tree import TREE

assert GOALS[-1] is PerpendicularGoal
direction = np.array([0.6, 0.0, 0.8])
goal = PerpendicularGoal("gripper", direction, weight=3.0)
position = robot.forward(robot.home).position + (0.05, 0.1, 0.0)
data = mujoco.MjData(robot.model)


def angle_at(q):
    data.qpos[:] = robot.qpos(q)
    mujoco.mj_kinematics(robot.model, data)
    return np.arcsin(data.site("gripper").xmat.reshape(3, 3)[:, 2] @ direction)


for goals in ([goal], [goal, rik.PositionGoal(None, position)]):
    for solver in ("lm", "dls", "sdls"):
        solution = rik.solve(robot, goals, solver=solver).require()
        assert abs(angle_at(solution.q)) <= 1e-3
        assert abs(solution.errors[0].angle - abs(angle_at(solution.q))) < 1e-9

problem = rik.Problem(robot, goal, solver="lm")
problem.retarget(PerpendicularGoal("gripper", "x"))
assert abs(problem.solve().require().goals[0].direction[0] - 1.0) < 1e-12

RUN = Layout("Rows", jacobian="table m u", tree=TREE, goals=GOAL_ARRAYS, search=SEARCH)
open_run = RUN.open


@kernel
def measure_rows(address):
    run = open_run(address)
    count_all_goals(run.goals, run.search)
    measure(run.tree, run.goals, run.search)
    goal_jacobian(run.tree, run.goals, run.search, False, run.jacobian)


problem = rik.Problem(robot, goal, solver="lm")
blocks = {"tree": robot.tree.block, "goals": problem.compiled.block, "search": problem.search}
run = RUN.allocate(problem.sizes, blocks)
rng = np.random.default_rng(0)
STEP = 1e-6
for _ in range(20):
    q = robot.sample(rng)
    problem.search.arrays["q"][:] = q
    measure_rows(run.address)
    assert run.arrays["jacobian"].shape == (1, robot.nv)
    assert abs(problem.search.arrays["residual"][0] + 3.0 * angle_at(q)) < 1e-9
    steps = STEP * np.eye(robot.nv)
    slopes = [(angle_at(q + step) - angle_at(q - step)) / (2.0 * STEP) for step in steps]
    assert np.allclose(run.arrays["jacobian"][0], 3.0 * np.array(slopes), atol=1e-5)
"""


def block(note: str, text: str) -> str:
    """Return the only block with this first line that contains ``text``."""
    codes = re.findall(rf"^```{re.escape(note)}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    (code,) = [code for code in codes if text in code]
    return code


def insert(file: Path, before: str, text: str) -> None:
    """Insert a text before the only occurrence of ``before`` in a file."""
    source = file.read_text(encoding="utf-8")
    assert source.count(before) == 1, f"{file.name}: {before!r}"
    file.write_text(source.replace(before, text + before), encoding="utf-8")


def indented(text: str) -> str:
    """Return a text whose lines are indented by eight spaces, as a case of ``residuals.py``."""
    return "".join(f"        {line}" for line in text.splitlines(keepends=True))


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a copy of the package, with the bundled models and the hardware."""
    copy = tmp_path / "robot_ik"
    shutil.copytree(ROOT / "robot_ik", copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "models").symlink_to(ROOT / "models")
    (copy / "hardware").symlink_to(ROOT / "hardware")
    return copy


def run(package: Path, code: str) -> None:
    """Run code in a process that imports the copy."""
    script = package.parent / "recipe.py"
    script.write_text(USE_COPY + code, encoding="utf-8")
    command = [sys.executable, str(script), str(package.parent)]
    completed = subprocess.run(command, capture_output=True, text=True)
    assert completed.returncode == 0, completed.stderr


def test_a_solver_is_one_file_and_one_row(package: Path) -> None:
    solvers = package / "solvers"
    (solvers / "gradient.py").write_text(block("python", "class GradientDescent"), "utf-8")
    row = block("text", '"gradient": (')
    insert(solvers / "__init__.py", '    "transpose": (', f"    {row}")
    run(package, SOLVER)


def test_a_goal_is_one_class_and_one_pair_of_kernel_functions(package: Path) -> None:
    kernels = package / "kernels"
    with (kernels / "frame_goals.py").open("a", encoding="utf-8") as stream:
        stream.write("\n\n" + block("python append=robot_ik/kernels/frame_goals.py", "def "))
    residuals = kernels / "residuals.py"
    names = "ON_PERPENDICULAR, perpendicular_jacobian, perpendicular_residual"
    imports = f"from robot_ik.kernels.frame_goals import {names}\n"
    insert(residuals, "from robot_ik.kernels.jit import", imports)
    insert(residuals, "        else:\n            continue\n", indented(block("text", "within =")))
    case = indented(block("text", "perpendicular_jacobian(tree"))
    insert(residuals, "\n\n@inlined\ndef rows_end", case)

    goals = package / "goals.py"
    insert(goals, "from robot_ik.kernels.tree import", imports.partition(",")[0] + "\n")
    code = block("python append=robot_ik/goals.py", "class PerpendicularGoal")
    insert(goals, "GOALS: tuple[type[Goal], ...]", code + "\n\n")
    insert(goals, ")\n\n\n# Checks and conversions", "    PerpendicularGoal,\n")
    run(package, GOAL)


COMMAND = """
import contextlib, io, json
from robot_ik.commands.main import main
from robot_ik.commands.reachable import Reachable, ReachableReport

# The solves of ``run`` would compile the kernels of the copy, which takes 40 s.
Reachable.run = lambda command, terminal: ReachableReport(1, command.count)
with contextlib.redirect_stdout(io.StringIO()) as out:
    assert main(["reachable", "--count", "3", "--json"]) == 0
assert json.loads(out.getvalue()) == {"schema": 1, "reached": 1, "count": 3}
with contextlib.redirect_stdout(io.StringIO()) as out:
    assert main(["reachable", "--help"]) == 0
assert "Number of random points" in out.getvalue()
assert main(["reachable", "--count", "0"]) == 2
"""


def test_a_command_is_one_file_and_one_row(package: Path) -> None:
    commands = package / "commands"
    (commands / "reachable.py").write_text(block("python", "class Reachable(JsonOption)"), "utf-8")
    insert(commands / "main.py", '        Row("solve", ', f"        {block('text', 'Row(')}")
    run(package, COMMAND)

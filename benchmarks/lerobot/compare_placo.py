"""Compare ``robot_ik.lerobot.Kinematics`` with LeRobot's kinematics on placo, on the SO-101.

    python -m venv ENV && ENV/bin/pip install placo
    python benchmarks/lerobot/compare_placo.py ENV/bin/python
    python benchmarks/lerobot/compare_placo.py ENV/bin/python --write

Both get the same targets and starts. MuJoCo measures the pose of every answer. A time is that of
all calls for a target. A second table has the solve alone. ``--write`` puts the tables into
docs/how-to/lerobot.md. The calls of placo are those of LeRobot, see ``placo_worker.py``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.lerobot import Kinematics

Array = NDArray[np.float64]

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "lerobot.md"
BEGIN = "<!-- placo -->"
END = "<!-- end -->"

POSES = 100
NEAR_DEG = 5.0
"""Standard deviation of the distance from a start to its target, degrees in each joint."""

STEPS = 150
"""Targets of a path: 5 s at LeRobot's 30 Hz."""

CIRCLE = 0.06
"""Radius of the circle, m."""

PULL = 0.30
"""Distance by which the target leaves the workspace, m."""

BESIDE_AXIS = 0.002
"""Distance of the line from the axis of the shoulder pan, m."""

PATH_START = np.array([0.0, -0.6, 0.6, 1.3, 0.0])
"""rad. Joint angles at which the circle and the pull begin."""

HIT_MM = 1.0
HIT_DEG = 1.0
"""A pose is met if position and orientation are nearer than these."""

SAME_FORWARD = 1e-9
"""m. Largest allowed difference between the forward kinematics of placo and MuJoCo."""


@dataclass(frozen=True)
class Case:
    """Targets with starts. A start of None is the answer to the target before.

    Attributes:
        title: For the table.
        starts: Joint angles, rad, or None.
        targets: Poses (4, 4).
        calls: Numbers of calls in a row that placo gets.
    """

    title: str
    starts: list[Array | None]
    targets: list[Array]
    calls: tuple[int, ...]


def cases(robot: rik.Robot) -> dict[str, Case]:
    """Return all cases by name."""
    rng = np.random.default_rng(0)
    goals = rng.uniform(robot.lower, robot.upper, (POSES, robot.nq))
    near = goals + np.radians(rng.normal(0.0, NEAR_DEG, goals.shape))
    near = np.clip(near, robot.lower, robot.upper)
    poses = [robot.measure(q).matrix for q in goals]
    first = robot.measure(PATH_START).matrix
    on_path: list[Array | None] = [PATH_START, *[None] * (STEPS - 1)]
    phases = np.linspace(0.0, 1.0, STEPS)

    circle = []
    pull = []
    line = []
    for phase in phases:
        angle = 2.0 * np.pi * phase
        target = first.copy()
        target[1, 3] += CIRCLE * np.sin(angle)
        target[2, 3] += CIRCLE * (np.cos(angle) - 1.0)
        circle.append(target)
        target = first.copy()
        target[0, 3] += PULL * np.sin(np.pi * phase)
        pull.append(target)
        target = first.copy()
        axis_x = float(robot.model.body("shoulder").pos[0])
        target[:3, 3] = [axis_x + BESIDE_AXIS, 0.2 * phase - 0.1, 0.20]
        line.append(target)
    start = rik.solve(robot, rik.PositionGoal(None, line[0][:3, 3]), start=PATH_START).q
    on_line: list[Array | None] = [start, *[None] * (STEPS - 1)]
    middle: list[Array | None] = [np.zeros(robot.nq)] * POSES
    return {
        "near": Case("reachable pose, start 5° away", list(near), poses, (1, 5)),
        "far": Case("reachable pose, start in mid-range", middle, poses, (1, 100)),
        "circle": Case("circle, orientation cannot be kept", on_path, circle, (1, 10)),
        "pull": Case("pull past the end of the workspace", on_path, pull, (1, 10)),
        "line": Case("line 2 mm beside the pan axis", on_line, line, (1, 10)),
    }


def urdf_of(robot: rik.Robot) -> str:
    """Return a URDF of the chain. All link frames are parallel to the world at q = 0."""
    model = robot.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts = ['<robot name="arm"><link name="base"/>']
    before = np.zeros(3)
    parent = "base"
    for name in robot.joints:
        joint = model.joint(name)
        anchor = data.xanchor[joint.id]
        lower, upper = joint.range.tolist()
        parts.append(
            f'<link name="link_{name}"/><joint name="{name}" type="revolute">'
            f'<parent link="{parent}"/><child link="link_{name}"/>'
            f'<origin xyz="{numbers(anchor - before)}"/>'
            f'<axis xyz="{numbers(data.xaxis[joint.id])}"/>'
            f'<limit lower="{lower!r}" upper="{upper!r}" effort="10" velocity="10"/></joint>'
        )
        parent = f"link_{name}"
        before = anchor.copy()
    pose = robot.measure(np.zeros(robot.nq))
    roll, pitch, yaw = roll_pitch_yaw(pose.matrix[:3, :3])
    parts.append(
        f'<link name="tool"/><joint name="to_tool" type="fixed"><parent link="{parent}"/>'
        f'<child link="tool"/><origin xyz="{numbers(pose.position - before)}" '
        f'rpy="{roll!r} {pitch!r} {yaw!r}"/></joint></robot>'
    )
    return "".join(parts)


def numbers(vector: Array) -> str:
    """Return three numbers as text, exact."""
    return " ".join(repr(float(value)) for value in vector)


def roll_pitch_yaw(rotation: Array) -> tuple[float, float, float]:
    """Return the angles of a URDF: rotations about fixed x, then y, then z."""
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return float(roll), float(pitch), float(yaw)


def ask_placo(python: str, robot: rik.Robot, rows: dict[str, Case]) -> dict[str, Any]:
    """Return the answers of placo, by case and number of calls.

    Raises:
        SystemExit: The forward kinematics of placo differ from MuJoCo's.
    """
    rng = np.random.default_rng(1)
    check = rng.uniform(robot.lower, robot.upper, (20, robot.nq))
    content = {
        "joints": list(robot.joints),
        "check": check.tolist(),
        "cases": {
            name: {
                "starts": [None if q is None else q.tolist() for q in case.starts],
                "targets": [target.tolist() for target in case.targets],
                "calls": case.calls,
            }
            for name, case in rows.items()
        },
    }
    worker = Path(__file__).with_name("placo_worker.py")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.urdf").write_text(urdf_of(robot))
        (Path(folder) / "cases.json").write_text(json.dumps(content))
        subprocess.run([python, str(worker), folder], check=True)
        answers: dict[str, Any] = json.loads((Path(folder) / "answers.json").read_text())
    expected = np.array([robot.measure(q).matrix for q in check])
    difference = float(np.abs(expected - np.array(answers["poses"])).max())
    if difference > SAME_FORWARD:
        raise SystemExit(f"placo's forward kinematics differ from MuJoCo's by {difference:.2g}")
    return answers


def ask_ours(kinematics: Kinematics, case: Case) -> dict[str, Any]:
    """Return our answers, one call for each target."""
    q = np.zeros(len(kinematics.joint_names))
    rows = []
    seconds = []
    for start, target in zip(case.starts, case.targets, strict=True):
        degrees = np.degrees(q if start is None else start)
        begin = time.perf_counter()
        answer = kinematics.inverse_kinematics(degrees, target)
        seconds.append(time.perf_counter() - begin)
        q = np.radians(answer)
        rows.append(q.tolist())
    return {"q": rows, "seconds": seconds}


def ask_problem(problem: rik.Problem, case: Case) -> dict[str, Any]:
    """Return the answers of ``Problem.solve`` to a case whose starts are given."""
    rows = []
    seconds = []
    for start, target in zip(case.starts, case.targets, strict=True):
        begin = time.perf_counter()
        solution = problem.solve(start, target=target)
        seconds.append(time.perf_counter() - begin)
        rows.append(solution.q.tolist())
    return {"q": rows, "seconds": seconds}


def solves_alone(robot: rik.Robot, kinematics: Kinematics, case: Case) -> list[str]:
    """Return a table of the solve inside a call of ``Kinematics``, and of a numeric search."""
    pose = rik.Pose.identity()
    best = rik.PoseGoal(kinematics.frame, pose.position, pose.wxyz, orientation="best")
    exact = rik.PoseGoal(kinematics.frame, pose.position, pose.wxyz)
    near = rik.Budget(restarts=0)
    closed_form = rik.Problem(robot, best, keep_branch=True)
    numeric = rik.Problem(robot, exact, solver="lm", budget=near)
    answers = {
        "`Problem.solve`: closed form on the branch of the start": ask_problem(closed_form, case),
        "`Problem.solve`, `lm`: search from the start": ask_problem(numeric, case),
    }
    rows = [f"| {title} | {cell(robot, case, answer)} |" for title, answer in answers.items()]
    return ["", f"| {case.title}: the solve alone | poses met, time |", "|---|---:|", *rows]


def cell(robot: rik.Robot, case: Case, answer: dict[str, Any]) -> str:
    """Return one cell: share of poses met or position error and largest jump, and time."""
    poses = [robot.measure(np.array(q)) for q in answer["q"]]
    errors = [
        pose.distance(rik.Pose.from_matrix(target))
        for pose, target in zip(poses, case.targets, strict=True)
    ]
    millimetres = np.array([1e3 * position for position, _ in errors])
    degrees = np.array([np.degrees(angle) for _, angle in errors])
    microseconds = 1e6 * float(np.median(answer["seconds"]))
    if case.starts[1] is not None:
        met = int(((millimetres < HIT_MM) & (degrees < HIT_DEG)).sum())
        return f"{met} of {len(errors)}, {microseconds:.0f} µs"
    jumps = np.degrees(np.abs(np.diff(np.array(answer["q"]), axis=0)).max(axis=1))
    return f"{millimetres.max():.2f} mm, {np.median(degrees):.1f}°, jump {jumps.max():.0f}°"


def lines(python: str) -> list[str]:
    """Return the tables."""
    robot = rik.load_robot("so101")
    kinematics = Kinematics(robot)
    rows = cases(robot)
    answers = ask_placo(python, robot, rows)
    for case in rows.values():  # loads the kernels
        ask_ours(kinematics, case)
    table = [
        "| targets | robot_ik, 1 call | placo, 1 call | placo, more calls |",
        "|---|---:|---:|---:|",
    ]
    for name, case in rows.items():
        ours = cell(robot, case, ask_ours(kinematics, case))
        one, several = (cell(robot, case, answers[f"{name}/{calls}"]) for calls in case.calls)
        table.append(f"| {case.title} | {ours} | {one} | {case.calls[1]}: {several} |")
    for _ in range(2):  # the first table loads the kernels
        parts = solves_alone(robot, kinematics, rows["near"])
    return [*table, *parts]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("python", help="interpreter of an environment that has placo")
    parser.add_argument("--write", action="store_true", help="put the tables into the page")
    options = parser.parse_args()
    table = lines(options.python)
    print("\n".join(table))
    if options.write:
        page = PAGE.read_text(encoding="utf-8")
        head, rest = page.split(BEGIN)
        tail = rest[rest.index(END) :]
        PAGE.write_text(f"{head}{BEGIN}\n" + "\n".join(table) + f"\n{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()

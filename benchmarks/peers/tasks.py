"""A robot and its seeded problems, written so that every library can read them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.peers.descriptions import HINGE, WHOLE_TURN, frames_of, plain_mjcf, urdf_of
from robot_ik.bench.methods.problems import ProblemSet, make_set
from robot_ik.files import make_folder, plain, write_atomically
from robot_ik.ports import Array
from robot_ik.robot import Robot, load_robot

POSITION_TOLERANCE = 1e-6
"""Position tolerance of a pose that every library gets, m."""

ANGLE_TOLERANCE = 1e-6
"""Angle tolerance that every library gets, rad."""

POINTS_TOLERANCE = 1e-4
"""Tolerance of the four positions of the figure, m."""

ARMS = ("puma560", "ur5e", "panda")
"""Arms of the comparison."""

FIGURE = "humanoid"
"""The figure of the comparison."""

FIGURE_SITES = {
    "left_palm": "left_hand",
    "right_palm": "right_hand",
    "left_foot": "left_foot",
    "right_foot": "right_foot",
}
"""Frames of the figure with goals, by site."""

_UNREACHABLE = 30
"""Number of poses out of reach."""

_PROBES = 20
"""Number of compared forward kinematics, and smallest number of singular problems."""

_BASE = 7
"""Numbers of a free base in qpos."""

_JOINT_SHARE = 0.5
"""Motion of the joints towards random angles in the figure's problems, as a share."""

_BASE_WAY = 0.1
"""Largest motion of the figure's base along each axis, m."""


def write_task(name: str, folder: Path, count: int, seed: int) -> Path:
    """Write a robot and its problems.

    Args:
        name: One of ``ARMS``, or ``FIGURE``.
        folder: Folder of the files.
        count: Problems of each kind. There are 30 out of reach.
        seed: Seed of the problems.
    """
    make_folder(folder)
    robot = load_robot(name)
    is_figure = name == FIGURE
    text = plain_mjcf(robot, FIGURE_SITES if is_figure else {"ee": robot.tool})
    model = mujoco.MjModel.from_xml_string(text)
    write_atomically(folder / "model.xml", text)
    write_atomically(folder / "model.urdf", urdf_of(model))
    has_free_base = model.nq > model.njnt
    hinges = [j for j in range(model.njnt) if model.jnt_type[j] == HINGE]
    is_limited = model.jnt_limited[hinges][:, None]
    limits = np.where(is_limited, model.jnt_range[hinges], WHOLE_TURN)
    facts = {
        "robot": name,
        "joints": [model.joint(j).name for j in hinges],
        "lower": limits[:, 0],
        "upper": limits[:, 1],
        "home": robot.qpos(robot.home),
        "sites": [model.site(k).name for k in range(model.nsite)],
        "free_base": has_free_base,
        "frames": [] if has_free_base else frames_of(model),
        "position": POINTS_TOLERANCE if is_figure else POSITION_TOLERANCE,
        "angle": ANGLE_TOLERANCE,
    }
    write_atomically(folder / "task.json", json.dumps(plain(facts)))
    if is_figure:
        arrays = _four_positions(load_robot(folder / "model.xml"), count, seed)
    else:
        arrays = _poses(robot, count, seed)
    np.savez(folder / "problems.npz", **arrays)  # type: ignore[arg-type]
    return folder


def site_names(robot: Robot) -> list[str]:
    """Return the sites of a plain robot. Its goals are there."""
    return [robot.model.site(k).name for k in range(robot.model.nsite)]


def _poses(robot: Robot, count: int, seed: int) -> dict[str, Array]:
    """Return targets (n, 4, 4) and starts (n, nq) of an arm, by kind of problem."""
    rng = np.random.default_rng([seed, 9])
    arrays = {"probes": np.array([robot.sample(rng) for _ in range(_PROBES)])}
    for kind, number in (("cold", count), ("warm", count), ("unreachable", _UNREACHABLE)):
        problems = make_set(kind, robot, number, seed)
        arrays[f"{kind}_targets"] = problems.targets
        arrays[f"{kind}_starts"] = _starts(problems)
    for kind, angles in _singular_angles(robot).items():
        number = max(count // 10, _PROBES)
        q = np.array([robot.sample(rng) for _ in range(number)])
        for joint, angle in angles.items():
            q[:, robot.joints.index(joint)] = angle
        arrays[f"{kind}_targets"] = np.array([robot.measure(row).matrix for row in q])
        arrays[f"{kind}_starts"] = np.repeat(robot.home[None], number, axis=0)
    return arrays


def _starts(problems: ProblemSet) -> Array:
    """Return the starts (n, nq): home, or on a path the joint angles of the pose before."""
    if problems.tracking:
        return np.concatenate([problems.first[None], problems.witnesses[:-1]])
    return np.repeat(problems.first[None], len(problems), axis=0)


def _singular_angles(robot: Robot) -> dict[str, dict[str, float]]:
    """Return joint angles at which the PUMA is exactly singular, by kind.

    At the wrist singularity axes 4 and 6 are in line. At the elbow singularity the arm is straight.
    """
    if robot.name != "puma560":
        return {}

    def squared_distance(angle: float) -> float:
        q = robot.home.copy()
        q[2] = angle
        offset = robot.forward(q, "flange").position - robot.forward(q, "link2").position
        return float(offset @ offset)

    # The squared distance is c + a cos + b sin of the angle. Three values give its maximum.
    zero = squared_distance(0.0)
    quarter = squared_distance(0.5 * math.pi)
    half = squared_distance(math.pi)
    middle = 0.5 * (zero + half)
    stretched = math.atan2(quarter - middle, zero - middle)
    return {"wrist": {robot.joints[4]: 0.0}, "elbow": {robot.joints[2]: stretched}}


def _four_positions(robot: Robot, count: int, seed: int) -> dict[str, Array]:
    """Return positions (n, 4, 3) of a figure's sites at random angles and on a smooth path."""
    rng = np.random.default_rng([seed, 4])
    home = robot.home
    lower = robot.lower[6:]
    upper = robot.upper[6:]
    cold = np.repeat(home[None], count, axis=0)
    random_angles = rng.uniform(lower, upper, (count, len(lower)))
    cold[:, _BASE:] += _JOINT_SHARE * (random_angles - home[_BASE:])
    cold[:, :3] += rng.uniform(-_BASE_WAY, _BASE_WAY, (count, 3))

    speed = rng.uniform(0.5, 1.5, len(lower))
    phase = rng.uniform(0.0, 2.0 * math.pi, len(lower))
    amplitude = 0.15 * np.minimum(upper - lower, 2.0)
    middle = np.clip(home[_BASE:], lower + amplitude, upper - amplitude)
    warm = np.repeat(home[None], count + 1, axis=0)
    times = 0.01 * np.arange(count + 1)[:, None]
    warm[:, _BASE:] = middle + amplitude * np.sin(speed * times + phase)
    return {
        "probes": np.empty((0, len(home))),
        "cold_targets": _site_positions(robot, cold),
        "cold_starts": np.repeat(home[None], count, axis=0),
        "warm_targets": _site_positions(robot, warm[1:]),
        "warm_starts": warm[:-1],
    }


def _site_positions(robot: Robot, q: Array) -> Array:
    """Return the positions (n, sites, 3) of the sites at ``q`` (n, nq)."""
    sites = site_names(robot)
    return np.array([[robot.measure(row, site).position for site in sites] for row in q])

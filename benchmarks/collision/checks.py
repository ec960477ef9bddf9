"""Cost of a collision check and of a clearance, beside MuJoCo's C code, on one core.

    taskset -c 0 python benchmarks/collision/checks.py [ROBOT ...]

Both sides run compiled from end to end: MuJoCo's functions are called from compiled code, without
Python in between. The postures are small joint steps between random postures. Ten obstacles stand
around the robot in the second row of each robot. Each number is the smallest of several rounds.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numba
import numpy as np

import robot_ik as rik
from robot_ik.collision.scene import Scene
from robot_ik.kernels import collision

ROBOTS = ("puma560", "panda", "ur5e", "humanoid", "koch_v11", "vx300s", "lion")
POSTURES = 300
DISTANCE_POSTURES = 40
ROUNDS = 12
REACH = 0.1

_library = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco*"))))
_pointer = ctypes.c_void_p


def _function(name: str, result: object, *arguments: object) -> Callable[..., object]:
    function = getattr(_library, name)
    function.restype = result
    function.argtypes = arguments
    return function


_kinematics = _function("mj_kinematics", None, _pointer, _pointer)
_com = _function("mj_comPos", None, _pointer, _pointer)
_collision = _function("mj_collision", None, _pointer, _pointer)
_distance = _function(
    "mj_geomDistance",
    ctypes.c_double,
    _pointer,
    _pointer,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_double,
    _pointer,
)


@numba.njit
def mujoco_checks(model, data, qpos, rows):
    """Run kinematics and collision detection for each row."""
    for row in range(rows.shape[0]):
        qpos[:] = rows[row]
        _kinematics(model, data)
        _com(model, data)
        _collision(model, data)


@numba.njit
def mujoco_distances(model, data, qpos, rows, first, second, reach, segment, out):
    """Write the smallest distance of all pairs of each row to ``out``."""
    for row in range(rows.shape[0]):
        qpos[:] = rows[row]
        _kinematics(model, data)
        smallest = reach
        for pair in range(first.shape[0]):
            distance = _distance(model, data, first[pair], second[pair], reach, segment.ctypes)
            smallest = min(smallest, distance)
        out[row] = smallest


def obstacles(rng: np.random.Generator) -> list[rik.Box | rik.Capsule]:
    """Return five boxes and five capsules around a robot."""
    shapes: list[rik.Box | rik.Capsule] = []
    for k in range(10):
        direction = rng.normal(size=3)
        position = 0.7 * direction / np.linalg.norm(direction) + (0.0, 0.0, 0.4)
        pose = rik.Pose(position, rng.normal(size=4))
        if k % 2:
            shapes.append(rik.Capsule(f"capsule {k}", radius=0.04, length=0.3, pose=pose))
        else:
            shapes.append(rik.Box(f"box {k}", size=(0.3, 0.2, 0.1), pose=pose))
    return shapes


def postures(robot: rik.Robot, rng: np.random.Generator) -> np.ndarray:
    """Small steps between random postures (n, nq)."""
    rows = []
    for _ in range(POSTURES // 50):
        first = robot.sample(rng)
        change = robot.difference(first, robot.sample(rng))
        rows += [robot.integrate(first, s * change) for s in np.linspace(0.0, 1.0, 50)]
    return np.array(rows)


def smallest_times(functions: list[Callable[[], object]]) -> list[float]:
    """Return the smallest time of each function, s. Their rounds alternate."""
    best = [np.inf] * len(functions)
    for function in functions:
        function()
    for _ in range(ROUNDS):
        for k, function in enumerate(functions):
            began = time.perf_counter()
            function()
            best[k] = min(best[k], time.perf_counter() - began)
    return best


def measure(scene: Scene, rows: np.ndarray) -> tuple[float, float, float, float]:
    """Microseconds a posture: MuJoCo's check, ours, MuJoCo's distances, ours."""
    model = scene.model
    data = scene.data_at(rows[0])
    qpos = np.array([scene.robot.qpos(row) for row in rows])
    few = qpos[:DISTANCE_POSTURES].copy()
    first, second = scene.pairs.astype(np.int32).T.copy()
    memory = scene.memory(scene.pair_tables(scene.pairs))
    verdicts = np.zeros(len(rows), dtype=np.int64)
    out = np.zeros(len(rows))
    nearest = np.zeros(len(rows), dtype=np.int64)
    segment = np.zeros(6)
    addresses = model._address, data._address
    times = smallest_times(
        [
            lambda: mujoco_checks(*addresses, data.qpos, qpos),
            lambda: collision.verdicts(memory.address, rows, 0.0, verdicts),
            lambda: mujoco_distances(
                *addresses, data.qpos, few, first, second, REACH, segment, out
            ),
            lambda: collision.smallest_distances(memory.address, rows, REACH, out, nearest),
        ]
    )
    counts = (len(rows), len(rows), len(few), len(rows))
    return tuple(1e6 * t / n for t, n in zip(times, counts, strict=True))


def main() -> None:
    """Print the table."""
    names = sys.argv[1:] or ROBOTS
    print("| robot | obstacles | pairs | check, µs: MuJoCo / ours | distance, µs: MuJoCo / ours |")
    print("|---|---:|---:|---:|---:|")
    for name in names:
        robot = rik.load_robot(name)
        for count in (0, 10):
            rng = np.random.default_rng(1)
            scene = Scene(robot, obstacles(rng)[:count])
            a, b, c, d = measure(scene, postures(robot, rng))
            print(
                f"| {name} | {count} | {len(scene.pairs)} "
                f"| {a:.1f} / {b:.2f} = **{a / b:.1f}** | {c:.0f} / {d:.2f} = **{c / d:.0f}** |",
                flush=True,
            )


if __name__ == "__main__":
    main()

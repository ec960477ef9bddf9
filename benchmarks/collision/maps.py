"""Cost of a reachability map: a random hundredth of its cells, on one core.

    taskset -c 0 python -m benchmarks.collision.maps [ROBOT ...]

The map has cells of 50 mm, 200 directions and 12 rolls: 1.5e8 poses for the PUMA. The cells are
drawn with a seed from those inside the ball that the frame cannot leave. With a number of obstacles
every branch inside the limits is compared with the robot's own parts and with them. The time is
that of the processor, so other programs on the machine do not count.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import robot_ik as rik
from benchmarks.collision.checks import obstacles
from robot_ik.reachability.grid import Grid
from robot_ik.reachability.sweep import Sweep, SweepMemory, arm_form

ROBOTS = ("puma560", "ur5e", "panda")
CELL = 0.05
DIRECTIONS = 200
ROLLS = 12
SHARE = 0.01
MARGIN = 0.002
# The Panda is swept over 24 values of its last joint: a thousandth is enough.
SHARES = {"panda": 0.001}


def measure(robot: rik.Robot, count: int | None) -> str:
    """Return a row of the table: size of the map, and cost and result of a random share.

    Args:
        robot: The robot.
        count: Number of obstacles; None for a map without a condition on collisions.
    """
    collisions = None
    if count is not None:
        scene = rik.Scene(robot, obstacles(np.random.default_rng(1))[:count])
        collisions = rik.CollisionAvoidance(scene, margin=MARGIN)
    arm = arm_form(robot, None)
    reach = robot.reach()
    if reach is None:
        raise SystemExit(f"{robot.name}: the reach is not bounded")
    grid = Grid.around(*reach, CELL, DIRECTIONS, ROLLS)
    sweep = Sweep(robot, None, grid, arm, collisions)
    share = SHARES.get(robot.name, SHARE)
    axes = [grid.centers(axis) for axis in range(3)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = centers[np.linalg.norm(centers - reach[0], axis=1) <= reach[1]]
    poses = len(inside) * grid.orientations
    rng = np.random.default_rng(0)
    positions = rng.choice(inside, round(share * len(inside)), replace=False)
    status = np.zeros((len(positions), grid.orientations), dtype=np.uint8)
    branches = np.zeros_like(status)
    values = [np.zeros(len(positions), dtype=np.float32) for _ in range(2)]
    memory = SweepMemory(sweep, arm)
    memory.sweep(positions[:1], status[:1], branches[:1], *(value[:1] for value in values))
    began = time.thread_time()
    memory.sweep(positions, status, branches, *values)
    each = (time.thread_time() - began) / status.size
    reached = np.mean(status == rik.ReachStatus.REACHED)
    touching = np.mean(status == rik.ReachStatus.TOUCHING)
    kind = "-" if count is None else str(count)
    return (
        f"| {robot.name} | {kind} | {poses:.3g} | {status.size:.3g} "
        f"| {100 * reached:.1f} / {100 * touching:.1f} | {1e6 * each:.2f} "
        f"| {each * poses / 60:.1f} |"
    )


def main() -> None:
    """Print the table."""
    print(
        "| robot | obstacles | poses | measured | % reached / touching | µs a pose "
        "| core-minutes of the map |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in sys.argv[1:] or ROBOTS:
        robot = rik.load_robot(name)
        for count in (None, 0, 10):
            print(measure(robot, count), flush=True)


if __name__ == "__main__":
    main()

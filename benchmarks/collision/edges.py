"""Certified edges among thin plates and slots, sampled densely by MuJoCo.

    nice -n 5 python -m benchmarks.collision.edges [EDGES]

Random short lines in joint space, between plates of 0.5 mm and slots of 2 to 20 mm, are certified
until the given number is proven free. Each proven line is sampled at steps of 0.001 rad or m, and
``mj_collision`` judges every sample. A contact ends the program with an error. Refuted lines
are judged too: MuJoCo must find a part nearer than the margin at the place that is named.
"""

from __future__ import annotations

import itertools
import sys
import time

import mujoco
import numpy as np

import robot_ik as rik
from robot_ik.errors import MotionBlockedError
from robot_ik.motion.certificate import certify

ROBOTS = ("puma560", "ur5e", "panda", "omx_f", "humanoid")
EDGES = 10_000
STEP = 1e-3
"""rad or m. Distance of the samples that judge a certificate."""

MARGIN = 1e-4
"""m. Smaller than the motion between two samples, so that a wrong proof shows as a contact."""

LENGTHS = (0.02, 0.1, 0.4)
"""rad. Typical change of a joint along an edge."""

EDGES_PER_HALL = 200
PLATES = 10
MAX_TRIES = 60
"""Places that are tried for plates."""

THICKNESS = 5e-4
"""m."""

FREE_SHARE = 0.5
"""Plates stay only if all together leave this share of the free postures free."""

NEAR = 0.05
"""m. Typical distance of a plate from a place where a part of the robot can be."""


def hall(robot: rik.Robot, rng: np.random.Generator) -> list[rik.Box]:
    """Return thin plates, some of them in parallel pairs with a slot between them."""
    samples = np.array([robot.sample(rng) for _ in range(200)])
    samples = samples[rik.Scene(robot).free(samples)]
    plates: list[rik.Box] = []
    for k in itertools.count():
        if len(plates) >= PLATES or k >= MAX_TRIES:
            return plates
        data = robot.data_at(robot.sample(rng))
        position = data.geom_xpos[rng.integers(robot.model.ngeom)] + NEAR * rng.normal(size=3)
        pose = rik.Pose(position, rng.normal(size=4))
        size = (THICKNESS, *rng.uniform(0.1, 0.5, 2))
        trial = [rik.Box(f"plate {len(plates)}", size=size, pose=pose)]
        if rng.random() < 0.5:
            slot = rik.Pose((rng.uniform(2e-3, 2e-2), 0.0, 0.0))
            trial.append(rik.Box(f"plate {len(plates) + 1}", size=size, pose=pose.compose(slot)))
        if rik.Scene(robot, [*plates, *trial]).free(samples).mean() > FREE_SHARE:
            plates += trial


def has_contact(scene: rik.Scene, pairs: set[tuple[int, int]], q: np.ndarray) -> bool:
    """Return whether MuJoCo finds two parts of a pair in contact."""
    data = scene.data_at(q)
    mujoco.mj_comPos(scene.model, data)
    mujoco.mj_collision(scene.model, data)
    for contact in data.contact[: data.ncon]:
        pair = tuple(sorted((int(contact.geom1), int(contact.geom2))))
        if contact.dist < 0.0 and pair in pairs:
            return True
    return False


def judge(robot: rik.Robot, rng: np.random.Generator, wanted: int) -> dict[str, int]:
    """Certify edges in one hall until ``wanted`` are proven; return the counts."""
    scene = rik.Scene(robot, hall(robot, rng))
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    pairs = {tuple(sorted(pair)) for pair in scene.pairs.tolist()}
    counts = {"proven": 0, "refuted": 0, "open": 0, "samples": 0}
    while counts["proven"] < wanted:
        first = robot.sample(rng)
        if not avoid.free(first):
            continue
        last = robot.integrate(first, rng.normal(size=robot.nv) * rng.choice(LENGTHS))
        try:
            certified = certify([first, last], avoid).certified
        except MotionBlockedError as error:
            counts["refuted"] += 1
            if scene.clearance(error.q).distance >= MARGIN:
                raise SystemExit(f"{robot.name}: refuted without a reason: {error}") from error
            continue
        if not certified:
            counts["open"] += 1
            continue
        change = robot.difference(first, last)
        for share in np.linspace(0.0, 1.0, int(np.linalg.norm(change) / STEP) + 2):
            q = robot.integrate(first, share * change)
            counts["samples"] += 1
            if has_contact(scene, pairs, q):
                clearance = scene.clearance(q)
                raise SystemExit(f"{robot.name}: a proven edge touches at {share}: {clearance}")
        counts["proven"] += 1
    return counts


def main() -> None:
    """Print the table."""
    edges = int(sys.argv[1]) if len(sys.argv) > 1 else EDGES
    each = -(-edges // len(ROBOTS))
    print("| robot | proven | refuted | open | samples | contacts | s |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in ROBOTS:
        robot = rik.load_robot(name)
        rng = np.random.default_rng(11)
        began = time.perf_counter()
        total = {"proven": 0, "refuted": 0, "open": 0, "samples": 0}
        while total["proven"] < each:
            wanted = min(EDGES_PER_HALL, each - total["proven"])
            for key, count in judge(robot, rng, wanted).items():
                total[key] += count
        seconds = time.perf_counter() - began
        print(
            f"| {name} | {total['proven']} | {total['refuted']} | {total['open']} "
            f"| {total['samples']:.3g} | 0 | {seconds:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()

"""Certified edges among thin plates and slots, sampled densely by MuJoCo.

    nice -n 5 python -m benchmarks.collision.edges [EDGES] [--state FILE]

Random short lines in joint space, between plates of 0.5 mm and slots of 2 to 20 mm, are certified
until the given number is proven free. Each proven line is sampled at steps of 0.001 rad or m, and
``mj_collision`` judges every sample. A contact ends the program with an error. Refuted lines
are judged too: MuJoCo must find a part nearer than the margin at the place that is named. With
``--state`` an interrupted run continues after the last finished hall.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

import numpy as np

import robot_ik as rik
from benchmarks.collision.scenes import has_contact, pairs_of
from robot_ik.errors import MotionBlockedError
from robot_ik.motion.certificate import certify

ROBOTS = ("puma560", "ur5e", "panda", "omx_f", "humanoid")
SEED = 11
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
"""Number of positions that are tried for plates."""

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


def judge(robot: rik.Robot, rng: np.random.Generator, wanted: int) -> dict[str, int]:
    """Certify edges in one hall until ``wanted`` are proven; return the counts."""
    scene = rik.Scene(robot, hall(robot, rng))
    avoid = rik.CollisionAvoidance(scene, margin=MARGIN)
    pairs = pairs_of(scene)
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


def hall_results(robot: rik.Robot, hall_number: int, wanted: int) -> dict[str, int]:
    """Return the counts of one hall. They depend on its number only."""
    return judge(robot, np.random.default_rng((SEED, hall_number)), wanted)


def read_state(file: Path | None) -> dict[str, list[dict[str, float]]]:
    """Return the results of the halls that an earlier run has finished, by robot."""
    halls: dict[str, list[dict[str, float]]] = {name: [] for name in ROBOTS}
    if file is not None and file.exists():
        for line in file.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            halls[row.pop("robot")].append(row)
    return halls


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("edges", type=int, nargs="?", default=EDGES)
    parser.add_argument("--state", type=Path, help="results so far; the next run continues there")
    options = parser.parse_args()
    each = -(-options.edges // len(ROBOTS))
    halls = read_state(options.state)
    print("| robot | proven | refuted | open | samples | contacts | s |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name in ROBOTS:
        robot = rik.load_robot(name)
        rows = halls[name]
        while (proven := sum(row["proven"] for row in rows)) < each:
            began = time.perf_counter()
            wanted = min(EDGES_PER_HALL, int(each - proven))
            row: dict[str, float] = dict(hall_results(robot, len(rows), wanted))
            row["seconds"] = time.perf_counter() - began
            rows.append(row)
            if options.state is not None:
                with options.state.open("a", encoding="utf-8") as out:
                    out.write(json.dumps({"robot": name, **row}) + "\n")
            done = int(proven + row["proven"])
            print(f"{name}: {done} of {each} edges proven", file=sys.stderr, flush=True)
        total = {key: sum(row[key] for row in rows) for key in rows[0]}
        print(
            f"| {name} | {total['proven']:.0f} | {total['refuted']:.0f} | {total['open']:.0f} "
            f"| {total['samples']:.3g} | 0 | {total['seconds']:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()

"""Measure how long the first use of a method compiles, and how long later processes load it.

Usage: python docs/make/measure_first_compile.py [METHOD | marker ...]

Each method solves one goal in a process with an empty cache, then in another process. ``marker``
detects the markers of a photograph. The times are wall-clock and processor seconds. The first time
includes everything that the method compiles on a new machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

CASES = {
    "auto": ("puma560", "solver='auto'"),
    "lm": ("puma560", "solver='lm'"),
    "lm, two priorities": ("puma560", "solver='lm'"),
    "dls": ("puma560", "solver='dls'"),
    "sdls": ("puma560", "solver='sdls'"),
    "bfgs": ("puma560", "solver='bfgs'"),
    "ccd": ("puma560", "solver='ccd'"),
    "fabrik": ("puma560", "solver='fabrik'"),
    "triangulation": ("puma560", "solver='triangulation'"),
    "recursive": ("puma560", "solver='recursive'"),
}

CHILD = """
import time
import robot_ik as rik
robot = rik.load_robot({robot!r})
goals = [rik.PositionGoal(None, robot.forward(robot.home).position + [0.05, 0.05, -0.05])]
if {two}:
    goals.append(rik.PositionGoal(robot.frames[0], goals[0].position, priority=1))
before = time.perf_counter(), time.process_time()
rik.solve(robot, goals, {options})
print(time.perf_counter() - before[0], time.process_time() - before[1])
"""

PHOTOGRAPH = (
    Path(__file__).resolve().parents[2] / "tests" / "data" / "opencv" / "singlemarkersoriginal.jpg"
)

MARKER = f"""
import time
import cv2
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.sources import Frame
from robot_ik.camera.targets import find_corners
image = cv2.imread({str(PHOTOGRAPH)!r})
height, width = image.shape[:2]
camera = CameraIntrinsics(width, height, 600.0, 600.0, width / 2, height / 2)
before = time.perf_counter(), time.process_time()
assert len(find_corners(Frame(image, 0.0, 0), camera, "DICT_6X6_250")) == 6
print(time.perf_counter() - before[0], time.process_time() - before[1])
"""


def main() -> None:
    """Print the table."""
    print("| method | first use, s | processor, s | later processes, s |")
    print("| --- | ---: | ---: | ---: |")
    for name in sys.argv[1:] or [*CASES, "marker"]:
        robot, options = CASES.get(name, ("", ""))
        code = CHILD.format(robot=robot, options=options, two="two" in name) if robot else MARKER
        with tempfile.TemporaryDirectory() as cache:
            environment = os.environ | {"XDG_CACHE_HOME": cache}
            times = [
                [
                    float(token)
                    for token in subprocess.check_output(
                        [sys.executable, "-c", code], env=environment, text=True
                    ).split()
                ]
                for _ in range(2)
            ]
        print(f"| {name} | {times[0][0]:.1f} | {times[0][1]:.1f} | {times[1][0]:.2f} |", flush=True)


if __name__ == "__main__":
    main()

"""Draw robots at home and while they reach: one picture each, and all on one sheet.

    python docs/make/gallery.py [ROBOT ...] [--out FOLDER] [--seed N]

ROBOT is a name of the catalogue, or an MJCF or URDF file. By default all bundled robots are drawn.
Exit code 1: a goal in a picture is out of reach.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from robot_ik.files import make_folder
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue
from robot_ik.testbed.gallery import draw_gallery


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the robots of a command line. Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", metavar="ROBOT", default=[])
    parser.add_argument("--out", type=Path, default=Path("runs/gallery"), metavar="FOLDER")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    options = parser.parse_args(arguments)
    robots = [load_robot(name) for name in options.robots or catalogue()]
    portraits, files = draw_gallery(robots, make_folder(options.out), options.seed)
    for portrait, file in zip(portraits, files, strict=False):
        print(f"{portrait.robot.name}: {portrait.solution.status.name}, {file}")
    print(f"all on one sheet: {files[-1]}")
    return 0 if all(portrait.solution.converged for portrait in portraits) else 1


if __name__ == "__main__":
    sys.exit(main())

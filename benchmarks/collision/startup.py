"""Cost of the scene of an arm file at the start of a command.

    taskset -c 0 python benchmarks/collision/startup.py [ROBOT]

It prepares the arm of ``reach`` with and without a table ``[collisions]`` in turn, each time in a
new process, with compiled kernels in the cache. The table has a scene of ten boxes and a floor.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from robot_ik.hardware.config import ArmConfig

REPEATS = 7
BOXES = 10

_PREPARE = """
import sys, time
began = time.process_time()
from pathlib import Path
from robot_ik.workcell.robot_setup import ArmRequest
from robot_ik.workcell.robot_setup import prepare_robot
imported = time.process_time()
prepare_robot(ArmRequest(robot=sys.argv[1], bus="sim", arm_file=Path(sys.argv[2])))
print(imported - began, time.process_time() - imported)
"""


def write_files(robot: str, folder: Path) -> dict[str, Path]:
    """Write the arm file without and with a table ``[collisions]``."""
    text = Path(ArmConfig.load(robot).file or "").read_text(encoding="utf-8")
    boxes = "".join(
        f'<geom type="box" size=".05 .05 .05" pos="{x:.3f} {y:.3f} .1"/>'
        for x, y in zip(
            np.cos(np.linspace(0.0, 6.0, BOXES)), np.sin(np.linspace(0.0, 6.0, BOXES)), strict=True
        )
    )
    scene = folder / "cell.xml"
    scene.write_text(f"<mujoco><worldbody>{boxes}</worldbody></mujoco>", encoding="utf-8")
    table = '[collisions]\nscene = "cell.xml"\nmargin = 0.002\nground = -0.2\n\n[bus]'
    files = {"without": folder / "without.toml", "with": folder / "with.toml"}
    files["without"].write_text(text, encoding="utf-8")
    files["with"].write_text(text.replace("[bus]", table, 1), encoding="utf-8")
    return files


def main() -> None:
    """Print the medians in milliseconds of processor time."""
    robot = sys.argv[1] if len(sys.argv) > 1 else "tabletop_puma"
    with tempfile.TemporaryDirectory() as folder:
        files = write_files(robot, Path(folder))
        times: dict[str, list[tuple[float, float]]] = {key: [] for key in files}
        for repeat in range(REPEATS + 1):
            for key, file in files.items():
                command = [sys.executable, "-c", _PREPARE, robot, str(file)]
                process = subprocess.run(command, capture_output=True, text=True, check=True)
                imported, prepared = map(float, process.stdout.split())
                if repeat:  # the first process may compile
                    times[key].append((1e3 * imported, 1e3 * prepared))
    print(f"{robot}, medians of {REPEATS} processes, ms of processor time")
    print("| `[collisions]` | import | prepare |")
    print("|---|---:|---:|")
    for key, rows in times.items():
        imported, prepared = np.median(rows, axis=0)
        print(f"| {key} | {imported:.0f} | {prepared:.0f} |")


if __name__ == "__main__":
    main()

"""How large each package is, which small modules have one importer, and what one solve loads.

    python docs/make/measure_structure.py

Needs the development environment (import-linter brings grimp).  That imports run in no circle is a contract
of ``make check``.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import grimp
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
SMALL = 80
# Packages whose files are found by a table, one each.
LISTED = ("robot_ik.solvers", "robot_ik.cli")
SOLVE = """
import sys
import robot_ik as rik
pose = rik.PoseGoal("gripper", position=(0.4, 0.1, 0.3), wxyz=(0, 1, 0, 0))
rik.solve(rik.load_robot("puma560"), pose, solver="lm")
for name, module in sys.modules.items():
    if name.partition(".")[0] == "robot_ik":
        print(module.__file__)
"""


def size(path: Path) -> int:
    """Lines of a file."""
    return len(path.read_text("utf-8").splitlines())


def module_name(path: Path) -> str:
    """As it is imported: ``hardware/`` is ``robot_ik.hardware``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "robot_ik" else ("robot_ik", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_table(files: list[Path]) -> Table:
    """Files and lines of each folder that holds files."""
    table = Table("package", "files", "lines")
    for column in table.columns[1:]:
        column.justify = "right"
    count, lines = Counter[str](), Counter[str]()
    for path in files:
        folder = str(path.parent.relative_to(ROOT))
        count[folder] += 1
        lines[folder] += size(path)
    for folder in sorted(count):
        table.add_row(folder, str(count[folder]), f"{lines[folder]:,}")
    table.add_section()
    table.add_row("all", str(len(files)), f"{lines.total():,}")
    return table


def small_with_one_importer(files: list[Path]) -> list[tuple[str, int, str]]:
    """Module, lines and importer of small files that one other imports."""
    with tempfile.TemporaryDirectory() as folder:  # one folder in which hardware lies inside robot_ik
        subprocess.run([sys.executable, ROOT / ".ci" / "link_typed.py", folder], check=True)
        sys.path.insert(0, folder)
        graph = grimp.build_graph("robot_ik", cache_dir=None)
        sys.path.remove(folder)
    found = []
    for path in files:
        name, lines = module_name(path), size(path)
        if lines >= SMALL or path.name == "__init__.py" or name.startswith(LISTED):
            continue
        importers = graph.find_modules_that_directly_import(name)
        if len(importers) == 1:
            found.append((name, lines, *importers))
    return found


def main() -> None:
    """Prints all of it."""
    console = Console()
    files = sorted(path for top in ("robot_ik", "hardware") for path in (ROOT / top).rglob("*.py"))
    console.print(package_table(files))
    small = small_with_one_importer(files)
    console.print(f"files below {SMALL} lines with one importer, solvers and commands aside: {len(small)}")
    for name, lines, importer in small:
        console.print(f"  {name} ({lines}), imported by {importer}")
    loaded = subprocess.run([sys.executable, "-c", SOLVE], capture_output=True, text=True, check=True)
    paths = [Path(line) for line in loaded.stdout.split("\n") if line]
    console.print(f"one solve by lm loads {len(paths)} modules, {sum(map(size, paths)):,} lines")


if __name__ == "__main__":
    main()

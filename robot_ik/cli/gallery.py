"""``robot-ik robots --gallery``: pictures of the robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from robot_ik.cli import console
from robot_ik.errors import ConfigError

if TYPE_CHECKING:
    from robot_ik.jobs.gallery import Portrait

#: Version of the JSON object; raised when a field changes its meaning.
SCHEMA = 1


def gallery_folder(words: Sequence[str]) -> str:
    """Where the pictures go; empty: to a new folder.

    Args:
        words: What stood after ``--gallery``: nothing, or a folder.

    Raises:
        ConfigError: More than one word, or a robot's name, which belongs before the option.
    """
    from robot_ik.catalogue import catalogue

    if len(words) > 1:
        raise ConfigError(
            f"{len(words)} words after --gallery: {' '.join(words)}", file="robot-ik robots", key="--gallery",
            allowed="one folder, or nothing", hint="one robot alone: robot-ik robots NAME --gallery [FOLDER]",
        )  # fmt: skip
    if words and words[0] in catalogue() and not Path(words[0]).exists():
        raise ConfigError(
            f"{words[0]!r} is a robot, not a folder", file="robot-ik robots", key="--gallery",
            allowed="a folder, or nothing",
            hint=f"this robot alone: robot-ik robots {words[0]} --gallery; a folder so named: ./{words[0]}",
        )  # fmt: skip
    return words[0] if words else ""


def run_gallery(robot: str, words: Sequence[str], seed: int, *, json: bool, overwrite: bool) -> int:
    """Draws one robot, or all; 0 done, 1 some robot does not reach what it is drawn reaching for."""
    folder = gallery_folder(words)
    from robot_ik.catalogue import catalogue
    from robot_ik.cli.results import results_folder
    from robot_ik.jobs.gallery import draw_gallery
    from robot_ik.robot import load_robot

    robots = [load_robot(name) for name in ([robot] if robot else catalogue())]
    own = [f"{one.name}.png" for one in robots] + ["gallery.png"]
    with results_folder(folder, "gallery", own, overwrite=overwrite) as place, console.progress() as bar:
        task = bar.add_task("drawing", total=len(robots), note="")
        portraits, files = draw_gallery(
            robots, place, seed, tell=lambda name, k: bar.update(task, completed=k, note=name)
        )
    if json:
        rows = [_facts(portrait, file) for portrait, file in zip(portraits, files, strict=False)]
        console.print_json({"schema": SCHEMA, "robots": rows, "sheet": str(files[-1])})
    else:
        _print(portraits, files)
    return console.DONE if all(p.solution.converged for p in portraits) else console.NOT_ACHIEVED


def _facts(portrait: Portrait, file: Path) -> dict[str, object]:
    solution = portrait.solution
    return {
        "name": portrait.robot.name,
        "poses": list(portrait.captions),
        "status": solution.status.name,
        "solver": solution.solver,
        "miss_m": solution.miss.position,
        "miss_rad": solution.miss.angle,
        "file": str(file),
    }


def _print(portraits: Sequence[Portrait], files: Sequence[Path]) -> None:
    shown = console.table("name", "at home", "at work", "goals", "solver", "file")
    for portrait, file in zip(portraits, files, strict=False):
        solution = portrait.solution
        met = "met" if solution.converged else f"missed: {solution.status.name}"
        shown.add_row(portrait.robot.name, *portrait.captions, met, solution.solver, str(file))
    console.out().print(shown)
    console.out().print(f"all on one sheet: {files[-1]}", markup=False, soft_wrap=True)

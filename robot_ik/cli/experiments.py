"""``robot-ik experiments``: what the theses tried, tried again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.text import Text
from tyro.conf import Positional, arg

from robot_ik.cli import console
from robot_ik.cli.arguments import wrong

if TYPE_CHECKING:
    from robot_ik.jobs.experiments.a00 import A00Report
    from robot_ik.jobs.experiments.s12 import S12Report

    Report = A00Report | S12Report
    Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class ExperimentsOptions:
    """Repeats the experiments of two theses, harder: every goal can be met, and MuJoCo judges.

    a00: thirteen courses of chains of ball joints (Aho 2000), every frame to 0.1 mm and 1 mrad; lm, dls, bfgs
    and auto have to meet all. s12: four methods on an arm of seven segments (Simunic 2012), beside his
    numbers; lm and auto have to reach all targets. Ctrl-C keeps what is done.

    Exit code 0: what has to pass passes. 1: it does not. 2: wrong input or environment.
    """

    experiment: Positional[Literal["a00", "s12"]]
    """Which thesis."""
    tests: Annotated[tuple[int, ...], arg(metavar="N …", help_behavior_hint="(default: 1 … 13)")] = ()
    """a00: only these tests."""
    solvers: Annotated[tuple[str, ...], arg(metavar="NAME …", help_behavior_hint="(default: all)")] = ()
    """a00: only these methods."""
    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: whole; 1000)")] = None
    """a00: no more than so many frames of each course; s12: frames of each case."""
    plot: bool = False
    """s12: draw the table, too (needs matplotlib)."""
    out: Annotated[str, arg(metavar="DIR", help_behavior_hint="(default: runs/<time>-<experiment>)")] = ""
    """Where the JSON and CSV files go."""
    overwrite: bool = False
    """That folder may hold files of an earlier run: they are replaced."""
    seed: int = 0
    """Of the random targets and of restarts."""


def run(options: ExperimentsOptions) -> int:
    """Runs an experiment; 0 when all that has to pass passes."""
    _check(options)
    from robot_ik.cli.results import results_folder

    prepare = _a00 if options.experiment == "a00" else _s12
    report, work, save, show = prepare(options)
    own = [f"{options.experiment}.{kind}" for kind in ("json", "csv", "png")]
    with results_folder(options.out, options.experiment, own, overwrite=options.overwrite) as folder:
        try:
            with console.progress() as bar:
                task = bar.add_task(options.experiment, total=1.0, note="")

                def progress(stage: str, share: float) -> None:
                    bar.update(task, completed=share, note=stage)

                work(progress)
        finally:  # Ctrl-C and SIGTERM as well: what is done is kept, and told
            files = save(folder)
            show()
            names = "  ".join(file.name for file in files)
            console.out().print(Text(f"files in {folder}: {names}"), soft_wrap=True)
    return console.DONE if report.passed else console.NOT_ACHIEVED


_Prepared = tuple["Report", "Callable[[Progress], Any]", "Callable[[Path], list[Path]]", "Callable[[], None]"]


def _a00(options: ExperimentsOptions) -> _Prepared:
    from robot_ik.cli.experiments_table import print_a00
    from robot_ik.jobs.experiments.a00 import ask_a00, run_a00
    from robot_ik.jobs.experiments.results import save_a00

    report = ask_a00(options.tests, options.solvers, options.frames, options.seed)
    return (
        report,
        lambda progress: run_a00(report, progress),
        lambda folder: save_a00(report, folder),
        lambda: print_a00(report),
    )


def _s12(options: ExperimentsOptions) -> _Prepared:
    from robot_ik.cli.experiments_table import print_s12
    from robot_ik.jobs.experiments.plot import require_plots
    from robot_ik.jobs.experiments.results import save_s12
    from robot_ik.jobs.experiments.s12 import FRAMES, S12Report, run_s12

    if options.plot:
        require_plots()
    report = S12Report(options.frames or FRAMES, options.seed)
    return (
        report,
        lambda progress: run_s12(report, progress),
        lambda folder: save_s12(report, folder, plot=options.plot),
        lambda: print_s12(report),
    )


def _check(options: ExperimentsOptions) -> None:
    """Raises ``ConfigError`` for what makes no sense before anything is built."""
    if options.frames is not None and options.frames < 1:
        raise wrong("--frames", str(options.frames), "1 or more")
    if options.seed < 0:
        raise wrong("--seed", str(options.seed), "0 or more")
    if options.experiment == "s12" and (options.tests or options.solvers):
        raise wrong("--tests" if options.tests else "--solvers", "s12 has neither", "with a00 alone")
    if options.experiment == "a00" and options.plot:
        raise wrong("--plot", "a00 has no picture", "with s12 alone")

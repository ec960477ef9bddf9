"""``robot-ik bench``: compare the solvers, and repeat the experiments of the theses."""

from __future__ import annotations

import shlex
import sys
from contextlib import suppress
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from robot_ik.commands.options import FolderOption, JsonOption, Seconds
from robot_ik.commands.terminal import QUIET, Terminal
from robot_ik.errors import OptionError

if TYPE_CHECKING:
    from robot_ik.commands.bench_methods import MethodsReport
    from robot_ik.commands.bench_theses import ThesisReport

MAX_COUNT = 100_000
"""Largest ``--count``. A batch of this size needs 2 GB."""

PROBLEMS = 200
"""Problems of each set, by default."""

POSITION_TOLERANCE = 1e-4
"""m. It is fixed, so that results can be compared."""

ANGLE_TOLERANCE = 1e-3
"""rad. It is fixed, so that results can be compared."""

ProblemSetName = Literal["cold", "warm", "singular", "limits", "unreachable", "kernels", "batch"]

EXPERIMENTS_OF = {
    "test": ("a00",),
    "solver": ("methods", "a00"),
    "robot": ("methods",),
    "problems": ("methods",),
    "seconds": ("methods",),
    "plot": ("methods", "s12"),
}
"""Option -> experiments that have it. All others have every option."""


@dataclass(frozen=True)
class Bench(FolderOption, JsonOption):
    """Compare the solvers on seeded problems, or repeat the experiments of two theses.

    methods: time and success on each robot. MuJoCo judges the solutions. A time is that of the
    whole Python call: 4×4 matrix in, joint angles out, limits obeyed, kernels compiled before.

    a00: thirteen courses of chains of ball joints (Aho 2000), every frame to 0.1 mm and 1 mrad.
    lm, dls, bfgs and auto must meet all frames. s12: four methods on an arm of seven segments
    (Simunic 2012), beside the numbers of the thesis. lm and auto must reach all targets.

        robot-ik bench --solver auto lm --robot puma560 --problems cold warm
        robot-ik bench a00

    Exit code 1: a required method of a00 or s12 failed. Ctrl-C keeps the finished part.
    """

    FILES: ClassVar[tuple[str, ...]] = (
        "bench.json",
        "success-*.png",
        "convergence-*.png",
        "growth.png",
        "a00.json",
        "s12.json",
        "s12.png",
    )

    experiment: Annotated[
        Literal["methods", "a00", "s12"],
        Parameter(name="EXPERIMENT", help="What to run."),
    ] = "methods"
    solver: Annotated[
        tuple[str, ...],
        Parameter(
            metavar="NAME …",
            consume_multiple=True,
            allow_repeating=True,
            help="Solver (see `robot-ik solvers`). methods and a00. Default: all.",
        ),
    ] = field(default=(), kw_only=True)
    robot: Annotated[
        tuple[str, ...],
        Parameter(
            metavar="NAME|FILE …",
            consume_multiple=True,
            allow_repeating=True,
            help="Robot name (see `robot-ik robots`), MJCF or URDF file. methods.",
        ),
    ] = field(default=("puma560", "ur5e", "panda"), kw_only=True)
    problems: Annotated[
        tuple[ProblemSetName, ...],
        Parameter(
            metavar="SET …",
            consume_multiple=True,
            allow_repeating=True,
            help="Problem sets of methods. kernels: cost of the kinematics, and its growth with "
            "joints and goals. batch: solve_batch.",
        ),
    ] = field(default=("cold", "warm", "singular", "limits", "unreachable"), kw_only=True)
    test: Annotated[
        tuple[int, ...],
        Parameter(metavar="N …", consume_multiple=True, allow_repeating=True),
    ] = field(default=(), kw_only=True)
    """Tests of a00, from 1 to 13. Default: all."""
    count: Annotated[
        int | None,
        Parameter(
            metavar="N",
            validator=Number(gte=1, lte=MAX_COUNT),
            help="Number of samples. methods: problems of each set, by default 200; a batch has "
            "500 times as many. a00: largest number of frames of a course, by default all. s12: "
            "frames of each case, by default 1000.",
        ),
    ] = field(default=None, kw_only=True)
    seconds: Annotated[
        Seconds,
        Parameter(
            help="Duration, in s. methods: the longest of a solver on a set. The remaining "
            "problems are not tried."
        ),
    ] = field(default=3.0, kw_only=True)
    seed: Annotated[
        int,
        Parameter(
            metavar="N",
            validator=Number(gte=0),
            help="Random seed. The same seed gives the same result.",
        ),
    ] = field(default=0, kw_only=True)
    plot: bool = field(default=False, kw_only=True)
    """Draw plots of the results (extra `plots`). methods and s12."""

    def run(self, terminal: Terminal = QUIET) -> MethodsReport | ThesisReport:
        """Run the experiment, and write its results, also after Ctrl-C."""
        self._require_possible()
        if self.plot:
            from robot_ik.workcell.results import require_plots  # matplotlib

            require_plots("drawing the plots")
        if self.experiment == "methods":
            return self._run_methods(terminal)
        return self._run_thesis(terminal)

    def _require_possible(self) -> None:
        """Check that the experiment has the options.

        Raises:
            OptionError: An option belongs to another experiment.
        """
        defaults = {item.name: item.default for item in fields(self)}
        for name, experiments in EXPERIMENTS_OF.items():
            if self.experiment not in experiments and getattr(self, name) != defaults[name]:
                allowed = f"with bench {' and bench '.join(experiments)}"
                problem = f"bench {self.experiment} has no such option"
                raise OptionError(f"--{name}", problem, allowed)

    def _run_methods(self, terminal: Terminal) -> MethodsReport:
        from robot_ik.bench.methods.results import Results, Settings, this_machine
        from robot_ik.bench.methods.runner import Campaign
        from robot_ik.commands.bench_methods import MethodsReport
        from robot_ik.robot import load_robot
        from robot_ik.solvers import SOLVERS, make_solver

        solvers = [make_solver(name) for name in dict.fromkeys(self.solver or SOLVERS)]
        robots = [load_robot(name) for name in dict.fromkeys(self.robot)]
        settings = Settings(
            command=command_line(),
            count=self.count or PROBLEMS,
            seed=self.seed,
            position_tolerance=POSITION_TOLERANCE,
            angle_tolerance=ANGLE_TOLERANCE,
            seconds=self.seconds,
        )
        campaign = Campaign(solvers, robots, tuple(dict.fromkeys(self.problems)), settings)
        results = Results(machine=this_machine(), settings=settings)
        report = MethodsReport(results, self.result_folder(terminal), plot=self.plot)
        machine = results.machine
        terminal.say(
            f"on {machine.processor}, {machine.cores} cores, Python {machine.python}", "dim"
        )
        try:
            benches = campaign.prepare(terminal.progress)
            terminal.say("kernels are ready; Ctrl-C keeps what is done", "dim")
            for note in campaign.measure(benches, results, terminal.progress):
                terminal.say(note, "dim")
            results.complete = True
        finally:  # Ctrl-C and SIGTERM, too
            if report.has_begun:
                report.save()
                terminal.show(report)
        return report

    def _run_thesis(self, terminal: Terminal) -> ThesisReport:
        from robot_ik.bench.theses import a00, s12
        from robot_ik.commands.bench_theses import AhoReport, SimunicReport

        folder = self.result_folder(terminal)
        report: AhoReport | SimunicReport
        if self.experiment == "a00":
            aho = a00.ask_a00(self.test, self.solver, self.count, self.seed)
            report = AhoReport(folder, results=aho)
        else:
            simunic = s12.S12Report(self.count or s12.FRAMES, self.seed)
            report = SimunicReport(folder, results=simunic, plot=self.plot)
        try:
            report.measure(terminal.progress)
        finally:  # Ctrl-C and SIGTERM, too
            report.save()
            terminal.show(report)
        return report


def command_line() -> str:
    """Return the command line of this process, for the settings in the result file."""
    with suppress(ValueError):
        start = sys.argv.index("bench", 1)
        return shlex.join(["robot-ik", *sys.argv[start:]])
    return "robot-ik bench"

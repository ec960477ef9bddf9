"""Runs a script: one step after another on one arm, until a step fails or all have passed."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from robot_ik.config import KeyProblem
from robot_ik.errors import OutputError, RobotIkError, distinct_texts
from robot_ik.goals import PoseGoal
from robot_ik.hardware import SIMULATED, bus_row
from robot_ik.inverse_kinematics import solve
from robot_ik.motion.keyframes import column_names
from robot_ik.motion.recording import open_recording
from robot_ik.script.environment import open_camera, with_objects
from robot_ik.script.file import Script
from robot_ik.script.report import ScriptReport
from robot_ik.script.state import (
    FAILED,
    PASSED,
    RunState,
    StepFailed,
    StepResult,
    error_classes,
)
from robot_ik.script.steps import Action, ScriptStep
from robot_ik.solvers import solver_name
from robot_ik.workcell.progress import Progress
from robot_ik.workcell.robot_setup import ArmRequest, prepare_robot


@dataclass(frozen=True)
class ScriptRequest:
    """The bus of a run, and values that replace those of the script.

    Attributes:
        bus: ``sim``, ``pty`` or a serial port.
        robot: Name in the catalogue or path of a model. Empty: the script's robot.
        arm_file: Arm file. None: the script's arm file, unless ``robot`` is given.
        seed: Random seed. None: the script's seed.
        record: File of all commands and measurements, .csv or .mcap. None: no recording.
    """

    bus: str = "sim"
    robot: str = ""
    arm_file: Path | None = None
    seed: int | None = None
    record: Path | None = None


def run_script(
    script: Script,
    request: ScriptRequest | None = None,
    progress: Progress = lambda _name, _share: None,
) -> ScriptReport:
    """Run a script and return its report. A failed step is no exception.

    Args:
        script: The script.
        request: Bus and replaced values. None: the defaults.
        progress: Called with the name of the next step and the share of finished steps.

    Raises:
        RobotIkError: The script or the environment is wrong. No step was run.
    """
    return ScriptRun(script, request or ScriptRequest()).run(progress)


class ScriptRun(RunState):
    """One run of a script.

    Attributes:
        report: The report. However the run ends, it is complete up to the last step that ran. Its
            seconds are those of the clock in ``setup``.
    """

    def __init__(self, script: Script, request: ScriptRequest) -> None:
        """Load robot and arm and check every step against them. Open nothing.

        Raises:
            ConfigError: The script or the arm file is wrong, or does not fit the robot or the bus.
            ModelError: The model of the robot cannot be loaded.
        """
        seed = script.seed if request.seed is None else request.seed
        if seed < 0:
            raise script.wrong(f"not {seed}", "seed", "0, 1, 2, …")

        robot = request.robot or script.resolved(script.robot)
        arm_file = request.arm_file
        if arm_file is None and script.arm is not None and not request.robot:
            arm_file = Path(script.resolved(script.arm))
        setup = prepare_robot(ArmRequest(robot, bus=request.bus, arm_file=arm_file))
        super().__init__(script, setup, solver_name("", setup.robot.file), seed)
        self._record = request.record

        if script.physics and not self.simulated:
            problem = "servos on a real port cannot be moved by a simulated world"
            raise script.wrong(problem, "physics", f"false, or {SIMULATED}")
        for index, step in enumerate(script.steps):
            try:
                step.check(self)
            except KeyProblem as error:
                raise error.within(("steps", index)).in_file(script.file) from None

        rows = [StepResult(step.title, step.do) for step in script.steps]
        rows.append(StepResult("leave the arm", "leave"))
        self.report = ScriptReport(
            script=script.name,
            file=script.file,
            robot=self.robot.name,
            bus=request.bus,
            seed=seed,
            virtual_time=bus_row(request.bus).virtual_time,
            steps=rows,
        )

    def run(self, progress: Progress = lambda _name, _share: None) -> ScriptReport:
        """Run the steps up to the first that fails, and leave the arm by its exit policy.

        Args:
            progress: Called with the name of the next step and the share of finished steps.

        Raises:
            RobotIkError: The arm cannot be connected or enabled. No step was run.
            OutputError: The recording cannot be written. The run ends at that step.
        """
        try:
            with contextlib.ExitStack() as stack:
                self._prepare(stack, progress)
                if self._record is not None:
                    recording = open_recording(self._record, column_names(self.robot))
                    self.setup.record(stack.enter_context(recording))
                stack.enter_context(self.setup.connected())
                self.setup.enable_torque()
                self.begin = self.setup.clock.now()
                try:
                    self._run_steps(progress)
                except BaseException:
                    self.report.interrupted = True
                    raise
                finally:
                    self.report.seconds = self.now()
        finally:
            self._report_exit()
        return self.report

    def _report_exit(self) -> None:
        """Write into the last row of the report how the arm was left, if it was connected."""
        exit_report = self.arm.exit_report
        if exit_report is None:
            return
        row = self.report.steps[-1]
        row.outcome = PASSED if exit_report.ok else FAILED
        confirmed = ", ".join(exit_report.verified) or "no servo"
        row.found = f"{exit_report.done}, confirmed by {confirmed}"
        if exit_report.unverified:
            row.found += f"; {exit_report.doubt}"

    def _prepare(self, stack: contextlib.ExitStack, progress: Progress) -> None:
        """Compile the solver and render the scene. Both take long, so no servo has torque yet."""
        if self.simulated:
            self.servos.reseed(self.seed)
            if self.script.physics:
                self._add_world()
        progress("getting ready", 0.0)
        frame = self.setup.frame
        home = self.robot.forward(self.robot.home, frame)
        solve(self.robot, PoseGoal.at(frame, home), solver=self.solver)
        if any(step.needs_camera for step in self.script.steps):
            self.vision = open_camera(self.setup, self.script.marker_at, self.seed, stack)

    def _add_world(self) -> None:
        """Let the robot's MuJoCo model move the simulated shafts."""
        # Only scripts with physics need this import. It loads the simulated world.
        from robot_ik.hardware.virtual.world import World

        objects = self.script.objects
        model = with_objects(self.robot, objects) if objects else self.robot.model
        World(model, self.config, self.servos, contacts=bool(objects))

    def _run_steps(self, progress: Progress) -> None:
        """Run the steps up to the first that fails, and add up the counters of the bus."""
        steps = self.script.steps
        counters: Counter[str] = Counter()
        # The report has one more row, for leaving the arm.
        for index, (step, result) in enumerate(zip(steps, self.report.steps, strict=False)):
            progress(result.name, index / len(steps))
            before = Counter(self.setup.counters())
            self._run_step(step, result)
            after = self.setup.counters()
            counters.update({key: count - before[key] for key, count in after.items()})
            self.report.counters = dict(counters)
            if result.outcome == FAILED:
                return

    def _run_step(self, step: ScriptStep, result: StepResult) -> None:
        """Run one step and write its outcome, time and error into ``result``."""
        expected = step.raises if isinstance(step, Action) else None
        begin = self.setup.clock.now()
        result.outcome = FAILED
        try:
            step.run(self, result)
            if expected is None:
                result.outcome = PASSED
            else:
                result.found = f"no error came; {expected} was expected"
        except StepFailed as failure:
            result.found = str(failure)
        except OutputError as error:  # An error of the recording is no error of the arm.
            result.found = str(error.args[0])
            raise
        except RobotIkError as error:
            self._report_error(error, expected, result)
        except BaseException:
            result.found = "interrupted"
            raise
        finally:
            result.seconds = self.setup.clock.now() - begin

        if isinstance(step, Action):
            self.seconds = result.seconds
            self._check_time_limit(step, result)

    def _report_error(self, error: RobotIkError, expected: str | None, result: StepResult) -> None:
        """Write an error of a step into ``result``. The step passes if the error was expected."""
        self.error = error
        name = type(error).__name__
        message = str(error.args[0]) if error.args else ""
        result.found = f"{name}: {message}".replace("\n", " ")
        result.numbers["error"] = name
        if expected is None:
            return
        if isinstance(error, error_classes()[expected]):
            result.outcome = PASSED
        else:
            result.found += f" ({expected} was expected)"

    def _check_time_limit(self, step: Action, result: StepResult) -> None:
        """Write a failure into ``result`` if a step that passed took too long."""
        limit = step.time_limit_s
        if limit is None or result.outcome != PASSED:
            return
        # A step ends at a tick, so half a period is tolerated.
        if result.seconds <= limit + 0.5 / self.config.rate_hz:
            return
        result.outcome = FAILED
        taken, permitted = distinct_texts(result.seconds, limit, digits=2)
        problem = f"took {taken} s, allowed {permitted} s"
        result.found = f"{problem}; {result.found}" if result.found else problem

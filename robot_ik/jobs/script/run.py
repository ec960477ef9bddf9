"""Runs a script: step after step on one arm, until one fails or all have passed."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from robot_ik.camera.synthetic.camera import SyntheticSource
from robot_ik.errors import OutputError, RobotIkError, apart
from robot_ik.goals import PoseGoal
from robot_ik.hardware import SIMULATED, bus_row
from robot_ik.inverse_kinematics import solve
from robot_ik.jobs import Progress
from robot_ik.jobs.recording import open_recording
from robot_ik.jobs.robot_setup import ArmRequest, RobotSetup, prepare_robot
from robot_ik.jobs.scene import scene_for
from robot_ik.jobs.script.file import ObjectTable, Script
from robot_ik.jobs.script.report import ScriptReport
from robot_ik.jobs.script.state import FAILED, PASSED, RunState, StepFailed, StepResult, error_classes
from robot_ik.jobs.script.steps import Action, ScriptStep
from robot_ik.jobs.vision import AXIS_DOF, Vision
from robot_ik.motion.keyframes import column_names
from robot_ik.reading import WrongKey
from robot_ik.robot import Robot
from robot_ik.solvers import solver_name

# ------------------------------------------------------------------------------------------
# The world of a script: its synthetic camera, and objects that lie about.


SMALLER = 2
"""A script looks often, and pictures take longer than all else: half the size is a quarter of the work."""


def open_camera(
    setup: RobotSetup, marker_at: Sequence[float] | None, seed: int, stack: contextlib.ExitStack
) -> Vision:
    """The camera of the robot's scene, ready: the first picture, which takes longest, has been taken.

    ``marker_at``: as for ``Scene.with_marker_at``; None: the scene's own.

    Raises:
        CameraError: The robot's model has no scene, and none can be generated.
    """
    scene = scene_for(setup.robot, setup.frame, upright=setup.dof < AXIS_DOF)
    width, height = scene.intrinsics.size
    scene = replace(scene, intrinsics=scene.intrinsics.scaled(width // SMALLER, height // SMALLER))
    if marker_at is not None:
        scene = scene.with_marker_at(*marker_at)
    synthetic = replace(scene, cube={}).synthetic(setup.robot)  # the gripper's markers are not judged here
    source = SyntheticSource(synthetic, setup.true_q, seed=seed, clock=setup.clock, quality="fast")
    stack.enter_context(source)
    vision = Vision(scene, source, setup, synthetic=source)
    vision.picture()
    return vision


def with_objects(robot: Robot, objects: Sequence[ObjectTable]) -> mujoco.MjModel:
    """The robot's model with objects on the plane z = 0."""
    from robot_ik.hardware.virtual.world import WorldObject, model_with

    boxes = []
    for one in objects:
        (x, y, z), half = one.position, 0.5 * float(np.radians(one.yaw_deg))
        wide, deep, high = (1e-3 * edge for edge in one.size_mm)
        wxyz = (float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))
        boxes.append(WorldObject(one.name, (x, y, z), (wide, deep, high), 1e-3 * one.mass_g, wxyz))
    return model_with(robot.path, boxes, floor=0.0)


@dataclass(frozen=True)
class ScriptRequest:
    """On what a script shall run: ``sim``, ``pty`` or a serial port; the rest is instead of the script's own.

    ``record``: file of all commands and measurements, .csv or .mcap.
    """

    bus: str = "sim"
    robot: str = ""
    arm_file: Path | None = None
    seed: int | None = None
    record: Path | None = None


def run_script(
    script: Script, request: ScriptRequest | None = None, progress: Progress = lambda name, share: None
) -> ScriptReport:
    """Runs a script; whether it passed is in the report, never an exception.

    Raises:
        RobotIkError: Wrong script or environment: no step was run.
    """
    return ScriptRun(script, request or ScriptRequest()).run(progress)


class ScriptRun(RunState):
    """One run of one script.

    ``report`` is whole as far as it goes whenever the run ends; the clock of ``setup`` is the run's.
    """

    def __init__(self, script: Script, request: ScriptRequest) -> None:
        """Loads robot and arm and checks every step against them; nothing is opened.

        Raises:
            ConfigError, ModelError: The script asks for what is not there.
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
            problem = "servos on a real port move by themselves"
            raise script.wrong(problem, "physics", f"false, or {SIMULATED}")
        for k, step in enumerate(script.steps):
            try:
                step.check(self)
            except WrongKey as wrong:
                raise wrong.within(("steps", k)).in_file(script.file) from None
        rows = [StepResult(step.title, step.do) for step in script.steps]
        virtual = bus_row(request.bus).virtual_time
        self.report = ScriptReport(
            script.name, script.file, self.robot.name, request.bus, seed, virtual,
            [*rows, StepResult("leave the arm", "leave")],
        )  # fmt: skip

    def run(self, progress: Progress = lambda name, share: None) -> ScriptReport:
        """Runs all steps, or up to the first that fails, and leaves the arm as its file says.

        Raises:
            RobotIkError: The arm cannot be connected or switched on: no step was run.
        """
        setup, report = self.setup, self.report
        try:
            with contextlib.ExitStack() as stack:
                self._prepare(stack, progress)
                if self._record is not None:
                    setup.record(stack.enter_context(open_recording(self._record, column_names(self.robot))))
                stack.enter_context(setup.connected())
                setup.enable_torque()
                self.begin = setup.clock.now()
                try:
                    self._steps(progress)
                except BaseException:
                    report.interrupted = True
                    raise
                finally:
                    report.seconds = self.now()
        finally:
            left, row = self.arm.exit_report, report.steps[-1]
            if left is not None:  # it was connected
                row.outcome = PASSED if left.ok else FAILED
                row.found = f"{left.done}, confirmed by {', '.join(left.verified) or 'no servo'}"
                row.found += f"; {left.doubt}" if left.unverified else ""
        return report

    def _prepare(self, stack: contextlib.ExitStack, progress: Progress) -> None:
        """Does what takes long while no servo has torque: compiles the solver, paints the scene."""
        setup, robot, script = self.setup, self.robot, self.script
        if self.simulated:
            self.servos.reseed(self.seed)
            if script.physics:
                from robot_ik.hardware.virtual.world import World

                model = with_objects(robot, script.objects) if script.objects else robot.model
                World(model, self.config, self.servos, contacts=bool(script.objects))
        progress("getting ready", 0.0)
        solve(robot, PoseGoal.at(setup.frame, robot.forward(robot.home, setup.frame)), solver=self.solver)
        if any(step.needs_camera for step in script.steps):
            self.vision = open_camera(setup, script.marker_at, self.seed, stack)
            if any(step.do == "follow" for step in script.steps):
                self.vision.get_ready_to_follow()

    def _steps(self, progress: Progress) -> None:
        steps = self.script.steps
        counters: Counter[str] = Counter()
        for k, (step, result) in enumerate(zip(steps, self.report.steps, strict=False)):
            progress(result.name, k / len(steps))
            before = Counter(self.setup.counters())
            self._step(step, result)
            counters.update({key: n - before[key] for key, n in self.setup.counters().items()})
            self.report.counters = dict(counters)
            if result.outcome == FAILED:
                return

    def _step(self, step: ScriptStep, result: StepResult) -> None:
        """One step; how it went is in ``result``."""
        begin = self.setup.clock.now()
        wanted, limit = (step.raises, step.time_limit_s) if isinstance(step, Action) else (None, None)
        result.outcome = FAILED
        try:
            step.run(self, result)
            if wanted is None:
                result.outcome = PASSED
            else:
                result.found = f"no error came; {wanted} was expected"
        except StepFailed as failure:
            result.found = str(failure)
        except OutputError as error:  # of the recording: it says nothing of the arm
            result.found = str(error.args[0])
            raise
        except RobotIkError as error:
            self.error = error
            name, text = type(error).__name__, str(error.args[0]) if error.args else ""
            result.found = f"{name}: {text}".replace("\n", " ")
            result.numbers["error"] = name
            if wanted is not None and isinstance(error, error_classes()[wanted]):
                result.outcome = PASSED
            elif wanted is not None:
                result.found += f" ({wanted} was expected)"
        except BaseException:
            result.found = "interrupted"
            raise
        finally:
            result.seconds = self.setup.clock.now() - begin
        if isinstance(step, Action):
            self.seconds = result.seconds
        late = limit is not None and result.seconds > limit + 0.5 / self.config.rate_hz
        if late and result.outcome == PASSED:
            result.outcome = FAILED
            took, permitted = apart(result.seconds, limit or 0.0, digits=2)
            result.found = "; ".join(filter(None, (f"took {took} s, allowed {permitted} s", result.found)))

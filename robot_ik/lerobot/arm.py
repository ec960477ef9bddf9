"""The LeRobot robot ``robot_ik_arm``: any arm file, simulated or real, behind the arm's limiter."""

from __future__ import annotations

import logging
import select
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from robot_ik.errors import ArmStateError, UnsafeCommandError
from robot_ik.geometry import Pose, rotation_exp, rotation_log
from robot_ik.hardware import bus_row, open_bus
from robot_ik.hardware.arm import Arm, ArmState
from robot_ik.hardware.bus import ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.model_check import model_limits
from robot_ik.lerobot import calibration as calibrations
from robot_ik.lerobot.bus_view import BusView
from robot_ik.lerobot.config_arm import RobotIkArmConfig
from robot_ik.lerobot.config_scene_camera import SceneCameraConfig
from robot_ik.lerobot.kinematics import Kinematics
from robot_ik.lerobot.scene_camera import SceneCamera
from robot_ik.lerobot.units import Units
from robot_ik.ports import Array, RealClock
from robot_ik.robot import load_robot
from robot_ik.robot_arm import RobotArm, open_robot, robot_of_arm

log = logging.getLogger(__name__)

TOOL_KEYS = ("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz")
"""Tool position in m and rotation vector in rad, base frame. LeRobot's names."""

TOOL_GRIPPER = "ee.gripper_pos"
"""Gripper opening of a tool action, 0 to 100."""

MAX_STEP = 0.8
"""rad. A joint that moves farther than this in one action means another branch, such as elbow down
instead of elbow up."""

NEARBY = 0.05
"""m. A tool action nearer than this to the last command must not change the branch."""


class RobotIkArm(Robot):
    """An arm of servos with limits, caps and an exit policy, driven by LeRobot.

    A simulated arm has the zeros of its arm file. A real arm has the zeros of LeRobot's calibration
    file, or of its arm file if there is no calibration file.

    Args:
        config: Options.

    Attributes:
        config: Options.
        arm: The servos; None while disconnected.
        kinematics: Kinematics of the tool. ``kinematics.last`` is the last solution of a tool
            action.
        bus: Motors and positions for programs that use ``robot.bus``.
        refused: Number of refused tool actions since ``connect``.

    Raises:
        ConfigError: There is no such arm file, or the calibration file does not fit it.
    """

    config_class = RobotIkArmConfig
    name = "robot_ik_arm"

    def __init__(self, config: RobotIkArmConfig) -> None:
        # LeRobot's __del__ reads these, also after an error below.
        self.arm: Arm | None = None
        self._calibration_bus: ServoBus | None = None
        self.cameras: dict[str, Camera] = {}
        self._sent: dict[str, float] = {}
        super().__init__(config)
        self.config = config
        self._is_virtual = bus_row(config.port).virtual
        arm_file = replace(ArmConfig.load(config.arm), rate_hz=config.fps)
        self._robot = robot_of_arm(load_robot(arm_file.robot), arm_file, arm_file.robot)
        self._arm_file = self._calibrated(arm_file)
        self._units = Units(self._arm_file)
        self.kinematics = Kinematics(self._robot)
        self.bus = BusView(self._arm_file, self._positions, self.send_action)
        self.refused = 0
        self.cameras = self._make_cameras()

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Keys of ``get_observation``: floats, and the shapes of pictures."""
        velocities = self._units.velocity_features if self.config.observe_velocity else {}
        tool = dict.fromkeys(TOOL_KEYS, float) if self.config.observe_tool else {}
        pictures = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**self._units.features, **velocities, **tool, **pictures}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Keys of ``send_action``, all floats."""
        if self.config.control == "joints":
            return self._units.features
        gripper = [TOOL_GRIPPER] if self._units.grippers else []
        return dict.fromkeys([*TOOL_KEYS, *gripper], float)

    @property
    def is_connected(self) -> bool:
        """Whether the bus is open."""
        return self._calibration_bus is not None or (
            self.arm is not None and self.arm.state is not ArmState.DISCONNECTED
        )

    @property
    def is_calibrated(self) -> bool:
        """Whether the zeros of the joints are known."""
        return self._is_virtual or not self._arm_file.uncalibrated

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Open the bus, check the servos, and switch torque on.

        Args:
            calibrate: True: calibrate an arm that is not calibrated, then switch torque on.
                False: wait for no input and switch no torque on. An arm that is not calibrated is
                then open for ``calibrate`` only.
        """
        try:
            if not self.is_calibrated:
                self._calibration_bus = open_bus(self.config.port, self._arm_file)
                if not calibrate:
                    return
                self.calibrate()
                self._close_calibration_bus()
            self._open_arm()
            if calibrate:
                self.configure()
            for camera in self.cameras.values():
                camera.connect()
        except BaseException:
            self.disconnect()
            raise
        self.refused = 0
        log.info("%s connected", self)

    def configure(self) -> None:
        """Switch torque on at the current pose. ``connect`` has set the servos up before."""
        self._require_arm().enable(handle_signals=False)

    def calibrate(self) -> None:
        """Write the calibration file: by hand, or from the arm file of a simulated arm."""
        if self._is_virtual:
            calibrations.save(self.calibration_fpath, calibrations.nominal(self._arm_file))
        else:
            bus = self._calibration_bus or self._require_arm().bus
            motors = calibrations.calibrate_by_hand(bus, self._arm_file, _wait_for_enter)
            calibrations.save(self.calibration_fpath, motors)
        self._load_calibration()
        self._arm_file = self._calibrated(self._arm_file)
        self._units = Units(self._arm_file)
        print(f"Calibration saved to {self.calibration_fpath}")

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        """Return the measured positions and one picture per camera.

        The velocities and the tool pose are added on request.
        """
        observation: dict[str, Any] = self._positions()
        if self.config.observe_velocity:
            observation |= self._units.rates(self._require_arm().velocities())
        if self.config.observe_tool:
            observation |= self._tool_pose(self._require_arm().positions())
        for name, camera in self.cameras.items():
            observation[name] = camera.read_latest()
        return observation

    @check_if_not_connected
    def send_action(self, action: Mapping[str, Any]) -> dict[str, float]:
        """Send one command through the limiter and return the command that was sent.

        Args:
            action: ``<joint>.pos`` of any joints (the others stay), or a tool pose.

        Raises:
            UnsafeCommandError: An unknown joint, an incomplete tool pose, or NaN. Nothing was sent.
            HardwareError: A servo or the bus failed. The other joints hold.
        """
        arm = self._require_arm()
        is_tool = any(key in action for key in TOOL_KEYS)
        values = self._solve(action) if is_tool else self._units.values(action)
        vector = arm.send(values, arm.clock.now())
        self._sent = dict(zip(arm.joints, vector.tolist(), strict=True))
        if not is_tool:
            return self._units.numbers(self._sent)
        pose = self._tool_pose(self._sent)
        for name in self._units.grippers[:1]:
            pose[TOOL_GRIPPER] = self._units.number(name, self._sent[name])
        return pose

    def disconnect(self) -> None:
        """Apply the exit policy of the arm, and close the bus and the cameras.

        It may be called any number of times.
        """
        arm = self.arm
        self.arm = None
        try:
            if arm is not None:
                arm.close()
        finally:
            self._close_calibration_bus()
            for camera in self.cameras.values():
                if camera.is_connected:
                    camera.disconnect()

    def _calibrated(self, arm_file: ArmConfig) -> ArmConfig:
        """Return the arm file of a real arm with the zeros of the calibration file."""
        if self._is_virtual or not self.calibration:
            return arm_file
        return calibrations.with_calibration(
            arm_file, self.calibration_fpath, model_limits(arm_file)
        )

    def _open_arm(self) -> None:
        on_exit = None if self.config.disable_torque_on_disconnect else "hold"
        clock = RealClock() if self._is_virtual else None
        opened: RobotArm = open_robot(
            self._robot, self._arm_file, self.config.port, on_exit=on_exit, clock=clock
        )
        self.arm = opened.arm
        self.arm.connect()
        if self.calibration and not self._is_virtual:
            offsets = {name: row.homing_offset for name, row in self.calibration.items()}
            calibrations.check_offsets(self.arm.bus, self._arm_file, offsets)
        self.arm.read()
        self._sent = self.arm.positions()

    def _close_calibration_bus(self) -> None:
        bus = self._calibration_bus
        self._calibration_bus = None
        if bus is not None:
            bus.close()

    def _require_arm(self) -> Arm:
        """Return the servos.

        Raises:
            ArmStateError: The arm is not connected, or only for its calibration.
        """
        if self._calibration_bus is not None:
            raise ArmStateError(
                "the arm is connected for its calibration only",
                hint="call calibrate() and disconnect(), then connect()",
            )
        if self.arm is None:
            raise ArmStateError("the arm is not connected", hint="call connect()")
        return self.arm

    def _make_cameras(self) -> dict[str, Camera]:
        cameras: dict[str, Camera] = {}
        for name, camera in self.config.cameras.items():
            if isinstance(camera, SceneCameraConfig):
                cameras[name] = SceneCamera(camera, self._robot, self._measured_qpos)
            else:
                cameras |= make_cameras_from_configs({name: camera})
        return cameras

    def _positions(self) -> dict[str, float]:
        arm = self._require_arm()
        arm.read()
        return self._units.numbers(arm.positions())

    def _measured_qpos(self) -> Array:
        """Return the configuration of the whole model, grippers included."""
        positions = self._require_arm().positions()
        qpos = self._robot.qpos(self._q(positions))
        for name, value in positions.items():
            address = self._robot.model.joint(name).qposadr[0]
            qpos[address] = value
        return qpos

    def _q(self, positions: Mapping[str, float]) -> Array:
        """Return the joint values (nq,) of the robot."""
        return np.array([positions[joint] for joint in self._robot.joints])

    def _tool_pose(self, positions: Mapping[str, float]) -> dict[str, float]:
        pose = self._robot.forward(self._q(positions))
        numbers = [*pose.position.tolist(), *rotation_log(pose.wxyz).tolist()]
        return dict(zip(TOOL_KEYS, numbers, strict=True))

    def _solve(self, action: Mapping[str, Any]) -> dict[str, float]:
        """Return joint values for a tool action; those of the last command if it is refused."""
        missing = [key for key in TOOL_KEYS if key not in action]
        if missing:
            raise UnsafeCommandError(
                f"a tool action without {', '.join(missing)}", ", ".join(TOOL_KEYS)
            )
        numbers = np.array([float(action[key]) for key in TOOL_KEYS])
        if not np.isfinite(numbers).all():
            raise UnsafeCommandError(f"a tool action of {numbers.tolist()}", "finite numbers")
        last = self._q(self._sent)
        last_numbers = [self._units.number(name, self._sent[name]) for name in self._robot.joints]
        target = Pose(numbers[:3], rotation_exp(numbers[3:]))
        solved = self.kinematics.inverse_kinematics(last_numbers, target.matrix)
        values = {
            joint: self._units.value(joint, number)
            for joint, number in zip(self._robot.joints, solved.tolist(), strict=True)
        }
        is_near = self._robot.forward(last).distance(target)[0] < NEARBY
        joint_step = float(np.abs(self._q(values) - last).max())
        if is_near and joint_step > MAX_STEP:
            self.refused += 1
            if self.refused == 1:
                log.warning(
                    "tool action refused: a step of the tool below %g m needs a joint step of "
                    "%.2f rad (at most %g rad); move the tool farther, or to another side",
                    NEARBY,
                    joint_step,
                    MAX_STEP,
                )
            values = dict(zip(self._robot.joints, last.tolist(), strict=True))
        if TOOL_GRIPPER in action:
            opening = action[TOOL_GRIPPER]
            values |= {name: self._units.value(name, opening) for name in self._units.grippers}
        return values


def _wait_for_enter(text: str, meanwhile: Callable[[], None]) -> None:
    """Show a text and call ``meanwhile`` repeatedly until standard input has a line."""
    print(text, flush=True)
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        meanwhile()
    sys.stdin.readline()

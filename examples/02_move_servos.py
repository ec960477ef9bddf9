"""Moves an arm of servos along a planned joint move, and says where its shafts ended.

    python examples/02_move_servos.py                             six simulated servos, virtual time
    python examples/02_move_servos.py /dev/ttyUSB0 my_arm.toml    yours: no load, a hand on the power switch

Every joint turns by 8 degrees, at a fifth of the speed limits.  Prints, for each joint, the start, the target
and what the servo reports at the end, then how the arm was left.
"""

import sys

import numpy as np

import robot_ik as rik
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig

STEP = np.radians(8.0)


def main(bus: str = "sim", arm_file: str = "") -> None:
    robot = rik.load_robot("puma560")
    config = ArmConfig.load(arm_file or robot.arm_file)
    if arm_file:
        robot = rik.load_robot(config.robot, joints=config.names)
    robot = robot.with_limits(config.lower, config.upper)  # model, servo mode and arm file together
    start = {"start": robot.home} if bus in ("sim", "pty") else {}

    with open_arm(config, bus, **start) as arm:  # checks servos, models, supply; torque stays as it is
        arm.enable()  # torque on where the arm stands; from here the exit policy holds
        begin = arm.read().q
        target = begin + np.where(robot.upper - begin > STEP, STEP, -STEP)  # down near the upper limit
        move = rik.joint_move(
            robot, begin, target, speed=0.2, rate=config.rate_hz,
            velocity_limits=config.velocity, acceleration_limits=config.acceleration,
        )  # fmt: skip
        run = rik.execute(move, [arm], source=arm, clock=arm.clock, settle=0.4)
        lag = np.degrees(run.tracking_error.max())
        print(f"{run.duration:.2f} s at {run.rate:.1f} Hz, largest lag {lag:.2f} deg")
        for name, *angles in zip(arm.joints, begin, target, arm.read().q, strict=True):
            at, to, read = np.degrees(angles)
            print(f"{name:8} start {at:8.2f}  target {to:8.2f}  read back {read:8.2f} deg")
    left = arm.exit_report
    print(f"left with {left.done}, confirmed by {len(left.verified)} of {len(arm.joints)} servos")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""LeRobot sets id and rate of a new STS3215 (id 1). Argument: PORT."""

import sys

import stand_ins  # noqa: F401
from lerobot.motors import Motor, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus


def one_motor() -> FeetechMotorsBus:
    return FeetechMotorsBus(
        sys.argv[1], {"gripper": Motor(6, "sts3215", MotorNormMode.RANGE_0_100)}
    )


bus = one_motor()
bus.setup_motor("gripper")  # looks for it at every rate
bus.port_handler.closePort()

bus = one_motor()
bus.connect()  # with its handshake: id, model number and firmware
assert bus.ping("gripper") == 777
assert bus.get_baudrate() == 1_000_000
bus.disconnect()
print("good")

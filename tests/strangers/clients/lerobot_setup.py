"""LeRobot sets id and rate of a new motor (id 1, 57 600 baud). Run by check_clients.py: PORT."""

import sys

import stand_ins  # noqa: F401
from lerobot.motors import Motor, MotorNormMode
from lerobot.motors.dynamixel import DynamixelMotorsBus

bus = DynamixelMotorsBus(
    sys.argv[1], {"gripper": Motor(6, "xl330-m288", MotorNormMode.RANGE_0_100)}
)
bus.setup_motor("gripper")  # looks for it at every rate
bus.port_handler.closePort()

bus = DynamixelMotorsBus(
    sys.argv[1], {"gripper": Motor(6, "xl330-m288", MotorNormMode.RANGE_0_100)}
)
bus.connect()  # with its handshake: id and model number
assert bus.ping("gripper") == 1200 and bus.get_baudrate() == 1_000_000
bus.disconnect()
print("good")

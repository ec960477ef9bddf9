"""LeRobot connects to a Koch, calibrates, drives and disconnects. Run by check_clients.py: PORT."""

import os
import sys
import threading
import time

import stand_ins  # noqa: F401
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.dynamixel import DynamixelMotorsBus, OperatingMode

MODELS = ["xl430-w250"] * 2 + ["xl330-m288"] * 4
NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
motors = {
    n: Motor(k, m, MotorNormMode.DEGREES)
    for k, (n, m) in enumerate(zip(NAMES, MODELS, strict=True), 1)
}
bus = DynamixelMotorsBus(sys.argv[1], motors)
bus.connect()
bus.disable_torque()
bus.configure_motors()  # return delay 0
for name in NAMES:
    bus.write("Operating_Mode", name, OperatingMode.EXTENDED_POSITION.value)
    bus.write("Drive_Mode", name, 0)

offsets = bus.set_half_turn_homings()
# Enter comes after four seconds. Until then a hand turns the joints.
reader, writer = os.pipe()
sys.stdin = os.fdopen(reader)
threading.Timer(4.0, lambda: os.write(writer, b"\n")).start()
mins, maxes = bus.record_ranges_of_motion(display_values=False)
for name in NAMES:
    assert 600 < maxes[name] - mins[name] < 2800, (name, mins[name], maxes[name])
calibration = {
    name: MotorCalibration(motor.id, 0, offsets[name], max(0, mins[name]), min(4095, maxes[name]))
    for name, motor in motors.items()
}
bus.write_calibration(calibration)
assert bus.is_calibrated and bus.read_calibration() == calibration

time.sleep(0.2)
bus.enable_torque()
goals = {name: 10.0 for name in NAMES}
bus.sync_write("Goal_Position", goals)
time.sleep(2.0)
found = bus.sync_read("Present_Position")
assert all(abs(found[name] - 10.0) < 0.3 for name in NAMES), found
bus.write("Goal_Position", "gripper", -10.0)
time.sleep(1.5)
assert abs(bus.read("Present_Position", "gripper") + 10.0) < 0.3
assert all(t > 15 for t in bus.sync_read("Present_Temperature", normalize=False).values())
bus.disconnect()  # with torque off
print("good")

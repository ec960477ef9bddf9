"""LeRobot with an SO-101 follower: connect, calibrate, drive, leave. Argument: PORT."""

import os
import sys
import threading
import time

import stand_ins  # noqa: F401
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus, OperatingMode

NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]

motors = {name: Motor(id, "sts3215", MotorNormMode.DEGREES) for id, name in enumerate(NAMES, 1)}
bus = FeetechMotorsBus(sys.argv[1], motors)
bus.connect()  # its handshake: ids, model numbers, equal firmware
assert bus.broadcast_ping() == {id: 777 for id in range(1, 7)}
bus.disable_torque()
bus.configure_motors()
for name in NAMES:
    bus.write("Operating_Mode", name, OperatingMode.POSITION.value)
    bus.write("P_Coefficient", name, 16)
    bus.write("I_Coefficient", name, 0)
    bus.write("D_Coefficient", name, 32)
    assert bus.read("Return_Delay_Time", name) == 0
    assert bus.read("Maximum_Acceleration", name, normalize=False) == 254
bus.write("Max_Torque_Limit", "gripper", 500)
bus.write("Protection_Current", "gripper", 250)
bus.write("Overload_Torque", "gripper", 25)

offsets = bus.set_half_turn_homings()
middle = bus.sync_read("Present_Position", normalize=False)
assert all(abs(ticks - 2047) <= 1 for ticks in middle.values()), middle

# Enter comes after four seconds. Until then the faults of the server turn the joints.
reader, writer = os.pipe()
sys.stdin = os.fdopen(reader)
threading.Timer(4.0, lambda: os.write(writer, b"\n")).start()
minima, maxima = bus.record_ranges_of_motion(display_values=False)
for name in NAMES:
    assert 600 < maxima[name] - minima[name] < 2800, (name, minima[name], maxima[name])
calibration = {
    name: MotorCalibration(motor.id, 0, offsets[name], minima[name], maxima[name])
    for name, motor in motors.items()
}
bus.write_calibration(calibration)
assert bus.is_calibrated
assert bus.read_calibration() == calibration

time.sleep(0.2)
bus.enable_torque()
assert all(value == 1 for value in bus.sync_read("Lock", normalize=False).values())
bus.sync_write("Goal_Position", {name: 10.0 for name in NAMES})
time.sleep(2.0)
present = bus.sync_read("Present_Position")
assert all(abs(present[name] - 10.0) < 0.3 for name in NAMES), present
bus.write("Goal_Position", "gripper", -10.0)
time.sleep(1.5)
assert abs(bus.read("Present_Position", "gripper") + 10.0) < 0.3
temperatures = bus.sync_read("Present_Temperature", normalize=False)
assert all(15 < value < 60 for value in temperatures.values())
bus.disconnect()  # with torque off

bus = FeetechMotorsBus(sys.argv[1], motors)
bus.connect()
assert all(value == 0 for value in bus.sync_read("Torque_Enable", normalize=False).values())
bus.disconnect()
print("good")

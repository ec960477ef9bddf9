"""rustypot's STS3215 controller and its Bus, which LeRobot uses. Argument: PORT."""

import sys
import time

from rustypot import Bus, Sts3215PyController

IDS = [1, 2, 3]
BAUD = 1_000_000
TIMEOUT = 0.5
ACCEPTED_TICK = 2e-3
"""rad; a tick is 1.5e-3 rad."""

controller = Sts3215PyController(sys.argv[1], BAUD, TIMEOUT)
assert all(controller.ping(id) for id in IDS)
assert not controller.ping(77)
assert controller.sync_read_raw_present_position(IDS) == [2048] * 3
for register in Sts3215PyController.registers():
    values, error = controller.read_raw_data_with_error(1, register.addr, register.size)
    assert len(values) == register.size, register.name
    assert error == 0, register.name
controller.sync_write_torque_enable(IDS, [True] * 3)
goals = [0.1, 0.2, -0.3]
controller.sync_write_goal_position(IDS, goals)
time.sleep(1.0)
present = controller.sync_read_present_position(IDS)
assert all(abs(p - goal) < ACCEPTED_TICK for p, goal in zip(present, goals, strict=True)), present
start = time.monotonic()
for _ in range(200):
    controller.sync_write_goal_position(IDS, goals)
    controller.sync_read_present_position(IDS)
print(f"{1e6 * (time.monotonic() - start) / 200:.0f} us a cycle of three")
controller.write_torque_enable(1, False)
controller.close()

definition = Sts3215PyController.definition()
bus = Bus(sys.argv[1], BAUD, TIMEOUT, dict.fromkeys(IDS, definition))
assert bus.scan(definition, [1, 2, 3, 9]) == dict.fromkeys(IDS, 777)
assert bus.broadcast_scan(definition, IDS) == dict.fromkeys(IDS, 777)
assert bus.set_torque(IDS, True) == {}
assert bus.sync_read_register(IDS, "lock") == [1] * 3  # the lock follows the torque
bus.write_register(2, "goal_position", 2300)
time.sleep(1.0)
assert abs(bus.read_register(2, "present_position") - 2300) <= 1
assert bus.set_torque(IDS, False) == {}
assert bus.sync_read_register(IDS, "lock") == [0] * 3
bus.change_id(definition, 3, 8)
assert bus.scan(definition, [3, 8]) == {8: 777}
bus.change_baudrate(definition, 8, 500_000)
bus.set_baudrate(500_000)
assert bus.scan(definition, [8]) == {8: 777}
bus.close()
print("good")

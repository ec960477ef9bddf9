"""rustypot's XL330 controller. Run by check_clients.py: rustypot_client.py PORT."""

import sys
import time

from rustypot import Xl330PyController

IDS = [1, 2, 3]
io = Xl330PyController(sys.argv[1], 1_000_000, 0.5)
assert all(io.ping(id) for id in IDS) and not io.ping(77)
assert io.sync_read_raw_present_position(IDS) == [2048] * 3
assert [io.read_register(id, "model_number") for id in IDS] == [1200] * 3
# All its registers exist, except two kinds: Indirect Data moved in firmware 52, and
# Acceleration Limit is not in the manual's table of this model.
for register in Xl330PyController.registers():
    if not register.name.startswith(("indirect_data", "acceleration_limit")):
        values, error = io.read_raw_data_with_error(1, register.addr, register.size)
        assert len(values) == register.size and error == 0, register.name
io.sync_write_torque_enable(IDS, [True] * 3)
io.sync_write_goal_position(IDS, [0.1, 0.2, -0.3])
time.sleep(1.0)
found = io.sync_read_present_position(IDS)
assert all(abs(f - w) < 2e-3 for f, w in zip(found, [0.1, 0.2, -0.3], strict=True)), found
assert io.read_raw_data_with_error(1, 150, 1) is not None
start = time.monotonic()
for _ in range(200):
    io.sync_write_goal_position(IDS, [0.1, 0.2, -0.3])
    io.sync_read_present_position(IDS)
print(f"{1e6 * (time.monotonic() - start) / 200:.0f} us a cycle of three")
io.write_torque_enable(1, False)
assert io.reboot(1)
print("good")

"""dynamixel-python (module dxl2), Protocol 2.0.

Run by check_clients.py: dynamixel_python_client.py PORT.
"""

import sys
import time

from dxl2 import v2

IDS = [1, 2, 3]
bus = v2.MotorBus(sys.argv[1], 1_000_000, timeout=0.2)
bus.connect()
pong = bus.ping(1)
assert pong.ok and pong.data["model_number"] == 1220, pong
assert bus.ping(77).timeout
everyone = bus.broadcast_ping()
assert everyone.ok and len(everyone.data) == 3, everyone
assert bus.read(1, 132, 4, True).data == 2048
for id in IDS:
    assert bus.write(id, 64, 1, 1).ok
assert bus.write(1, 9, 1, 0).error == 7  # EEPROM is locked

goals = v2.SyncParams(116, 4)
for id in IDS:
    goals.add_value(id, 2000 + 10 * id)
bus.sync_write(goals)
time.sleep(1.0)
asked = v2.SyncParams(132, 4)
for id in IDS:
    asked.add_motor(id)
slow = bus.sync_read(asked)
fast = bus.fast_sync_read(asked)
assert slow.ok and [r.data if hasattr(r, "data") else r for r in slow.data] == [2010, 2020, 2030], (
    slow
)
assert fast.ok and list(fast.data) == [2010, 2020, 2030], fast
several = v2.BulkParams()
several.add_address(1, 132, 4, True)
several.add_address(3, 146, 1)
quick = bus.fast_bulk_read(several)
assert quick.ok and quick.data[0] == 2010, quick

assert bus.control_table_backup(1).error == 1  # not with torque
assert bus.write(1, 64, 1, 0).ok and bus.write(1, 84, 2, 777).ok
assert bus.control_table_backup(1).ok and bus.read(1, 147, 1).data == 1
assert bus.write(1, 9, 1, 33).ok
assert bus.control_table_restore(1).ok and bus.read(1, 9, 1).data == 250
assert bus.clear_position(1).ok and bus.reboot(1).ok
assert bus.reg_write(2, 65, 1, 1).ok and bus.action(2).ok and bus.read(2, 65, 1).data == 1
assert bus.factory_reset_except_id_baudrate(3).ok
bus.disconnect()
print("good")

"""All instructions of the official SDK. Run by check_clients.py: sdk.py PORT."""

import sys
import time

from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

OK = (COMM_SUCCESS, 0)
TORQUE = 64
GOAL = 116
PRESENT = 132
PROFILE = 112
IDS = (1, 2, 3)
sdk = PacketHandler(2.0)
port = PortHandler(sys.argv[1])


def bytes_of(value: int, size: int = 4) -> list:
    return list(value.to_bytes(size, "little", signed=value < 0))


def settled(id: int, goal: int) -> bool:
    for _ in range(200):
        if abs(sdk.read4ByteTxRx(port, id, PRESENT)[0] - goal) <= 1:
            return True
        time.sleep(0.02)
    return False


assert port.openPort() and port.setBaudRate(57_600)
assert sdk.ping(port, 1)[1] == COMM_RX_TIMEOUT  # the servos use 1 Mbaud
assert port.setBaudRate(1_000_000)
assert [sdk.ping(port, id) for id in IDS] == [(1020, COMM_SUCCESS, 0)] * 3
found, result = sdk.broadcastPing(port)
assert result == COMM_SUCCESS and sorted(found) == list(IDS)

for id in IDS:
    assert sdk.write1ByteTxRx(port, id, 9, 0) == OK  # return delay
    assert sdk.write1ByteTxRx(port, id, TORQUE, 1) == OK
assert sdk.write1ByteTxRx(port, 1, 9, 10) == (COMM_SUCCESS, 7)  # EEPROM is locked now
assert sdk.write4ByteTxRx(port, 1, GOAL, 2300) == OK and settled(1, 2300)

assert sdk.regWriteTxRx(port, 2, GOAL, 4, bytes_of(2400)) == OK
assert sdk.read1ByteTxRx(port, 2, 69) == (1, COMM_SUCCESS, 0)
sdk.action(port, 254)
assert settled(2, 2400)

writer = GroupSyncWrite(port, sdk, GOAL, 4)
for id in IDS:
    assert writer.addParam(id, bytes_of(1900 + id))
assert writer.txPacket() == COMM_SUCCESS
assert all(settled(id, 1900 + id) for id in IDS)
for fast in (False, True):
    reader = GroupSyncRead(port, sdk, PRESENT, 4)
    for id in IDS:
        assert reader.addParam(id)
    assert (reader.fastSyncRead() if fast else reader.txRxPacket()) == COMM_SUCCESS
    assert [reader.getData(id, PRESENT, 4) for id in IDS] == [1901, 1902, 1903]
    bulk = GroupBulkRead(port, sdk)
    assert bulk.addParam(1, PRESENT, 4) and bulk.addParam(3, 144, 2)
    assert (bulk.fastBulkRead() if fast else bulk.txRxPacket()) == COMM_SUCCESS
    assert (bulk.getData(1, PRESENT, 4), bulk.getData(3, 144, 2)) == (1901, 120)
orders = GroupBulkWrite(port, sdk)
assert orders.addParam(1, PROFILE, 4, bytes_of(77)) and orders.addParam(2, 65, 1, [1])
assert orders.txPacket() == COMM_SUCCESS
assert sdk.read4ByteTxRx(port, 1, PROFILE)[0] == 77 and sdk.read1ByteTxRx(port, 2, 65)[0] == 1

assert sdk.write4ByteTxRx(port, 3, GOAL, 10_000) == OK and settled(3, 10_000)
assert sdk.write1ByteTxRx(port, 3, TORQUE, 0) == OK
assert sdk.clearMultiTurn(port, 3) == OK
assert sdk.read4ByteTxRx(port, 3, PRESENT)[0] == 10_000 % 4096
assert sdk.reboot(port, 1) == OK
assert sdk.read1ByteTxRx(port, 1, TORQUE)[0] == 0
assert sdk.factoryReset(port, 2, 2) == OK  # all but id and baud rate
assert sdk.read1ByteTxRx(port, 2, 9)[0] == 250
port.closePort()
print("good")

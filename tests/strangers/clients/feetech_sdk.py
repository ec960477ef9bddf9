"""Feetech's SDK (feetech-servo-sdk 1.0.0). Argument: PORT."""

import sys
import time

import scservo_sdk as scs

IDS = (1, 2, 3)
TORQUE_ENABLE = 40
GOAL_POSITION = 42
PRESENT_POSITION = 56
MODEL_NUMBER = 3
LOCK = 55
MAX_POSITION_LIMIT = 11

port = scs.PortHandler(sys.argv[1])
assert port.openPort()
assert port.setBaudRate(1_000_000)
packet = scs.PacketHandler(0)

for id in IDS:
    model, result, error = packet.ping(port, id)
    assert (model, result, error) == (777, scs.COMM_SUCCESS, 0), (id, model, result, error)
    value, result, error = packet.read2ByteTxRx(port, id, MODEL_NUMBER)
    assert (value, result, error) == (777, scs.COMM_SUCCESS, 0)
assert packet.ping(port, 77)[1] == scs.COMM_RX_TIMEOUT

assert packet.write1ByteTxRx(port, 1, LOCK, 0) == (scs.COMM_SUCCESS, 0)
assert packet.write2ByteTxRx(port, 1, MAX_POSITION_LIMIT, 4000) == (scs.COMM_SUCCESS, 0)
assert packet.read2ByteTxRx(port, 1, MAX_POSITION_LIMIT)[0] == 4000

assert packet.regWriteTxRx(port, 1, GOAL_POSITION, 2, [0, 9]) == (scs.COMM_SUCCESS, 0)
assert packet.action(port, scs.BROADCAST_ID) == scs.COMM_SUCCESS

write = scs.GroupSyncWrite(port, packet, GOAL_POSITION, 2)
read = scs.GroupSyncRead(port, packet, PRESENT_POSITION, 2)
goals = {1: 2304, 2: 2000, 3: 2100}
for id, goal in goals.items():
    assert write.addParam(id, [goal & 0xFF, goal >> 8])
    assert read.addParam(id)
assert write.txPacket() == scs.COMM_SUCCESS
time.sleep(1.0)
assert read.txRxPacket() == scs.COMM_SUCCESS
for id, goal in goals.items():
    assert abs(read.getData(id, PRESENT_POSITION, 2) - goal) <= 1, id
    assert packet.write1ByteTxRx(port, id, TORQUE_ENABLE, 0) == (scs.COMM_SUCCESS, 0)
port.closePort()
print("good")

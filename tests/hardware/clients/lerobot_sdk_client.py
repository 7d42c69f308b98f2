"""Drive a bus with feetech-servo-sdk, which LeRobot uses; what it saw, as JSON. It runs in an environment of its own."""

import json
import sys
import time

from scservo_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

IDS = [1, 2, 3, 4, 5, 6]
port = PortHandler(sys.argv[1])
assert port.openPort()
assert port.setBaudRate(1_000_000)
bus = PacketHandler(0)
seen = {"models": [bus.ping(port, servo)[0] for servo in IDS], "missing": bus.ping(port, 9)[1] != COMM_SUCCESS}


def positions():
    group = GroupSyncRead(port, bus, 56, 2)
    for servo in IDS:
        assert group.addParam(servo)
    assert group.txRxPacket() == COMM_SUCCESS
    return [group.getData(servo, 56, 2) for servo in IDS]


seen["before"] = positions()
seen["one"] = bus.read2ByteTxRx(port, 1, 56)[0]
for address, value in ((41, 100),):
    assert bus.write1ByteTxRx(port, 1, address, value)[0] == COMM_SUCCESS
group = GroupSyncWrite(port, bus, 42, 2)
for servo, goal in ((1, 2300), (2, 1900), (3, 1900)):
    assert group.addParam(servo, [goal & 0xFF, goal >> 8])
assert group.txPacket() == COMM_SUCCESS
time.sleep(2)
seen["after"] = positions()
bus.write1ByteTxRx(port, 1, 55, 0)
bus.write1ByteTxRx(port, 1, 21, 16)
bus.write1ByteTxRx(port, 1, 55, 1)
seen["p"] = bus.read1ByteTxRx(port, 1, 21)[0]
port.closePort()
print(json.dumps(seen))

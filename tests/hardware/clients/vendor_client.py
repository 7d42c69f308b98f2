"""Drive a bus with the vendor's ftservo-python-sdk; what it saw, as JSON. It runs in an environment of its own."""

import json
import sys
import time

from scservo_sdk import COMM_SUCCESS, GroupSyncRead, PortHandler, sms_sts

IDS = [1, 2, 3, 4, 5, 6]
port = PortHandler(sys.argv[1])
assert port.openPort()
assert port.setBaudRate(1_000_000)
bus = sms_sts(port)
seen = {"models": [bus.ping(servo)[0] for servo in IDS], "missing": bus.ping(9)[1] != COMM_SUCCESS}


def positions():
    group = GroupSyncRead(bus, 56, 2)
    for servo in IDS:
        assert group.addParam(servo)
    group.txRxPacket()
    assert all(group.isAvailable(servo, 56, 2)[0] for servo in IDS)
    return [group.getData(servo, 56, 2) for servo in IDS]


seen["before"] = positions()
seen["one"] = bus.ReadPos(1)[0]
assert bus.WritePosEx(1, 2300, 1500, 100)[0] == COMM_SUCCESS
for servo in (2, 3):
    assert bus.SyncWritePosEx(servo, 1900, 1500, 100)
assert bus.groupSyncWrite.txPacket() == COMM_SUCCESS
time.sleep(2)
seen["after"] = positions()
bus.unLockEprom(1)
bus.write1ByteTxRx(1, 21, 16)
bus.LockEprom(1)
seen["p"] = bus.read1ByteTxRx(1, 21)[0]
port.closePort()
print(json.dumps(seen))

"""Drive a bus with rustypot, which is written in Rust; what it saw, as JSON. It runs in an environment of its own."""

import json
import sys
import time

import rustypot

IDS = [1, 2, 3, 4, 5, 6]
bus = rustypot.Sts3215PyController(sys.argv[1], 1_000_000, 0.5)
found = bus.broadcast_scan()
seen = {"models": [found[servo] for servo in IDS], "missing": not bus.ping(9)}
seen["before"] = bus.sync_read_raw_present_position(IDS)
seen["one"] = bus.read_raw_present_position(1)[0]
bus.write_acceleration(1, 100)
bus.sync_write_raw_goal_position([1, 2, 3], [2300, 1900, 1900])
time.sleep(2)
seen["after"] = bus.sync_read_raw_present_position(IDS)
bus.write_lock(1, False)
bus.write_p_coefficient(1, 16)
bus.write_lock(1, True)
seen["p"] = bus.read_p_coefficient(1)[0]
print(json.dumps(seen))

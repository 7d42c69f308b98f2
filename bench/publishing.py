"""What showing a session costs the session: how late a 60 ms beat comes, and how long a beat takes, with and without a publisher.

python bench/publishing.py seconds=30 calibration=runs/calibration/twin folder=/dev/shm/live

The beat does what a session's thread does in a motion: it looks at the stop every 4 ms, notes the joints of all arms every 60 ms, and
hands over a picture of 1280x720 at 30 a second, four times more than the publisher takes. Nothing is moved.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
from common import parse, table

from marl_handover import policies
from marl_handover.cli import main as command_line
from marl_handover.control.closed_loop import make_loop
from marl_handover.control.events import Event
from marl_handover.control.hardware_backend import HardwareBackend
from marl_handover.control.session import Session
from marl_handover.control.settings import twin_workcell
from marl_handover.control.telemetry import Publisher
from marl_handover.hardware.safety_filter import JointCommand

DEFAULTS = {"seconds": 30.0, "calibration": "", "folder": ""}
PERIOD_S, POLL_S, FRAME_S = 0.06, 0.004, 1 / 30
POSES = np.array([[-60.0, 20.0, 0.7], [50.0, 25.0, 1.3]])


def beat(backend: HardwareBackend, seconds: float, publishing: bool) -> dict[str, float]:
    """Lateness and work of each beat in ms, and the share of a core that the process used."""
    driver, pose_monitor, log = backend.workcell.driver, backend.workcell.pose_monitor, backend.log
    frame = backend.workcell.camera.read()
    seen = pose_monitor.tracker.update(frame)
    late, work = [], []
    begun, cpu, drawn_s = time.perf_counter(), time.process_time(), 0.0
    for number in range(int(seconds / PERIOD_S)):
        due = begun + number * PERIOD_S
        while (now := time.perf_counter()) < due:
            driver.latch.is_set()
            if publishing and now - drawn_s > FRAME_S and pose_monitor.shown is not None:
                drawn_s = now
                frame = frame._replace(number=frame.number + 1)
                pose_monitor.shown(frame, seen._replace(number=frame.number))
            time.sleep(min(POLL_S, max(due - now, 0.0)))
        woken = time.perf_counter()
        for arm in (0, 1):
            driver.safety_filter.check([JointCommand(arm, driver.parked_rad, driver.gripper_mm(arm))], PERIOD_S, 1.0, 1.0)
        log.add(Event.STATE, joints_rad=np.round(driver.joints_rad(), 4), gripper_mm=[0.0, 0.0])
        if number % 50 == 0:  # a decision every 3 s
            log.add(Event.SEEN, pose=POSES[number // 50 % 2], goal=None)
        late.append(1e3 * (woken - due))
        work.append(1e3 * (time.perf_counter() - woken))
    share = (time.process_time() - cpu) / (time.perf_counter() - begun)
    return {
        **{f"late {name}": float(np.percentile(late, level)) for name, level in (("p50", 50), ("p99", 99), ("max", 100))},
        **{f"work {name}": float(np.percentile(work, level)) for name, level in (("p50", 50), ("p99", 99))},
        "core %": 100 * share,
    }


def main(arguments: list[str]) -> None:
    """Measure off, on, off, on: whatever else the machine does changes as well."""
    options = parse(arguments, DEFAULTS)
    with tempfile.TemporaryDirectory() as scratch:
        calibration, folder = options["calibration"] or f"{scratch}/calibration", options["folder"] or f"{scratch}/live"
        stop = f"hardware.stop_file={scratch}/stop"
        if not options["calibration"] and command_line(["calibrate", "hardware=twin", f"calibration={calibration}", "postures=24", stop]):
            raise SystemExit("calibration failed")
        rows = []
        for name in ("off", "on", "off", "on"):
            config = twin_workcell()
            config.calibration, config.hardware.stop_file = calibration, f"{scratch}/stop"
            with (
                Publisher(folder if name == "on" else "") as publisher,
                make_loop(policies.adapted("pretrained_b"), "hardware", config=config) as loop,
            ):
                publisher.attach(loop)
                session = Session(loop, {"policy": "pretrained_b"}, publisher.command_queue)
                session.backend.player.ready()
                session.log.add(Event.EPISODE, seed=0)
                session.log.add(Event.GOAL, goal=np.array([120.0, 60.0, 1.0]))
                measured = beat(session.backend, float(options["seconds"]), name == "on")
            rows.append([name, *(f"{value:.2f}" for value in measured.values())])
            if name == "on":
                print(f"{publisher._number} states, {publisher._pictures} pictures, {publisher.failures} failures", flush=True)
        print(table(["publishing", *(f"{key}{'' if '%' in key else ' [ms]'}" for key in measured)], rows))


if __name__ == "__main__":
    main(sys.argv[1:])

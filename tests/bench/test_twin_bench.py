from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import twin as bench
import twin_limits
import twin_work

from marl_handover.cell import build_cell, cell_config
from marl_handover.config import MotionConfig
from marl_handover.control.settings import twin_workcell
from marl_handover.control.twin import Twin
from marl_handover.hardware.driver import ArmDriver
from marl_handover.hardware.estop import StopLatch
from tests.canonical_arms import PARKED_DEG

PARKED = np.radians(PARKED_DEG)


def row(number: int, **more: Any) -> dict[str, Any]:
    return {"number": number, "robot": number % 2, "end": True, "first": True, "hang": False, **more}


@pytest.fixture
def armed(tmp_path: Path) -> Any:
    model = build_cell(cell_config("paper"))
    config = twin_workcell()
    config.hardware.arms["left"].pulse_limits_us = [[600, 2400]] * 5
    twin = Twin(model, MotionConfig(), config)
    driver = ArmDriver(twin.hardware, model, MotionConfig(), clock=twin.clock, latch=StopLatch(tmp_path / "stop"), confirm=twin.confirm)
    driver.connect()
    driver.configure()
    driver.arm()
    yield twin, driver, twin_limits.LimitWatch(twin, driver)
    driver.close()
    twin.close()


@pytest.mark.parametrize("noise", [0.0, 1.0, 2.0])
def test_settings_of_every_robot_are_allowed(noise: float) -> None:
    for robot in range(20):
        config = twin_work.changed(twin_work.robot_changes(0, robot, noise))
        config.hardware.validate()
        config.twin.validate()


def test_an_ordinary_motion_is_within_limits_and_close_to_them_is_said(armed: Any) -> None:
    _, driver, watch = armed
    driver.drive(0, PARKED + np.radians([25.0, 0, 0, 0, 0]), driver.gripper_mm(0), 60.0)
    found = watch.taken()
    assert found["violations"] == {}
    share = 60.0 / np.degrees(driver.safety_filter.speed_rad_s[0])
    assert found["worst"]["sent speed, share"] == pytest.approx(share, rel=0.1)
    assert watch.taken()["worst"] == {}, "it begins anew"


def test_what_goes_round_the_gate_is_noticed(armed: Any) -> None:
    twin, _, watch = armed
    wiring = twin.hardware.arms["left"]
    device = twin.electronics.devices[wiring.board]
    device.write(f"#{wiring.channels[0]}P2450T40\r".encode(), twin.clock.now_s())
    twin.clock.sleep_s(0.3)
    found = watch.taken()["violations"]
    assert found["sent speed, share"] > 0
    assert found["sent pulse, us"] > 0
    assert found["sent joint, rounded pulses"] > 0


def test_a_hand_in_the_table_is_noticed(armed: Any) -> None:
    *_, watch = armed
    deep = np.array([0.0, np.radians(20.0), np.radians(-60.0), 0.0, 0.0])
    watch._room("true", np.stack([deep, PARKED]), 0.0, 0.0)
    assert watch.taken()["violations"] == {"true plane, mm below": 1}


def test_what_is_finished_is_not_done_again(tmp_path: Path) -> None:
    values = {**bench.DEFAULTS, "episodes": 5, "drills": 0, "robots": 2}
    bench.claim(tmp_path, values)
    (tmp_path / "robot_00").mkdir()
    twin_work.append(tmp_path / "robot_00" / "episode.jsonl", row(2))
    with (tmp_path / "robot_00" / "episode.jsonl").open("a") as file:
        file.write('{"number": 4, "en')
    assert [task.numbers for task in bench.tasks(tmp_path, values)] == [(0, 4), (1, 3)]
    bench.claim(tmp_path, values | {"jobs": 1})
    with pytest.raises(SystemExit, match="other settings"):
        bench.claim(tmp_path, values | {"noise": 2.0})


def test_an_episode_that_breaks_off_is_a_failed_one(tmp_path: Path, twin_calibration: Path) -> None:
    shutil.copytree(twin_calibration, tmp_path / "robot_00" / "calibration")
    twin_work.work(twin_work.Work("episode", 0, (0, 2), 4), {**bench.DEFAULTS, "policy": "nobody"}, str(tmp_path))
    found = bench.gathered(tmp_path, {**bench.DEFAULTS, "robots": 1})["episodes"]
    assert (found["count"], found["first_time"], found["in_the_end"], found["failed"]) == (2, 0.0, 0.0, [0, 2])
    assert "nobody" in found["exceptions"][0]


def test_only_mishaps_that_happened_count(tmp_path: Path) -> None:
    lines = [
        row(
            0, kind="nudge", happened=True, felt=True, limits={"violations": {"sent speed, share": 2}, "worst": {"sent speed, share": 1.2}}
        ),
        row(1, kind="nudge", happened=False, felt=False),
        row(2, kind="nudge", happened=True, felt=False, end=False, latency_ms=[10.0, 30.0]),
        row(3, end=False, error="TimeoutError: no end", hang=True),
    ]
    (tmp_path / "robot_00").mkdir()
    for line in lines:
        twin_work.append(tmp_path / "robot_00" / "drill.jsonl", line)
    found = bench.gathered(tmp_path, {**bench.DEFAULTS, "robots": 1})["drills"]
    assert found["kinds"]["nudge"] == {"drills": 3, "happened": 2, "felt": 1, "reached": 1}
    assert (found["reached"], found["happened"], found["hangs"]) == (pytest.approx(1 / 3), 3, 1)
    assert found["violations"] == {"sent speed, share": 2}
    assert found["goal_to_wire_ms"]["p50"] == 20.0
    assert "33.3 %" in bench.shown({"drills": found})


def test_the_soak_is_told_in_parts() -> None:
    lines = [
        {"transfers": 80, "episodes": 20, "solved": 20, "first": 19, "violations": 0, "hangs": 0, "process": 1}
        | {"rss_mb": 300.0 + n, "files": 12, "virtual_s": 1.0}
        for n in range(10)
    ]
    found = bench.soaked(lines)
    assert found["transfers"] == sum(part["transfers"] for part in found["parts"]) == 800
    assert found["parts"][0]["rss_mb"][0] == 300.0
    assert found["parts"][-1]["rss_mb"][1] == 309.0


def test_noise_multiplies_all_that_is_drawn_and_robots_differ() -> None:
    one, same, other, loud = (twin_work.robot_changes(0, *it) for it in ((1, 1.0), (1, 1.0), (2, 1.0), (1, 2.0)))
    assert one == same
    assert one["hardware.emulator.seed"] != other["hardware.emulator.seed"]
    assert one["mount.eye_mm"] != other["mount.eye_mm"]
    for name in twin_work.NOISES:
        assert loud[name] == pytest.approx(2 * one[name])
    assert json.loads(json.dumps(one)) == one


def test_what_takes_too_long_is_broken_off() -> None:
    with pytest.raises(TimeoutError), twin_work.time_limit(0.05):
        time.sleep(5)

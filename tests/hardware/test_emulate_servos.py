"""``emulate hardware=so101``: two buses behind real serial ports, as other people's programs see them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from marl_handover.cli import main
from marl_handover.hardware.clock import RealClock
from marl_handover.hardware.feetech import FeetechBus
from marl_handover.hardware.settings import BoardConfig, TimeoutConfig

IDS = [1, 2, 3, 4, 5, 6]
PARKED = [2048, 1320, 2517, 1226, 1056, 1724]
"""Counts of the parked pose, to within what zeros are off: 140, -115 and 130 degrees of shoulder, elbow and wrist, the hand open."""


@pytest.fixture
def served(tmp_path):
    """Paths of both buses, served by the command itself."""
    link = tmp_path / "so101"
    command = [sys.executable, "-m", "marl_handover.cli", "emulate", "hardware=so101", f"link={link}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    first = [process.stdout.readline() for _ in range(2)]
    yield link, link.with_name("so101_right"), first
    process.send_signal(signal.SIGTERM)
    assert process.wait(20) == 0
    assert not link.is_symlink()


def test_both_arms_answer_on_ports_of_their_own(served):
    *paths, said = served
    assert said[0].startswith("STS3215 servos 1, 2, 3, 4, 5, 6 at ")
    for path in paths:
        bus = FeetechBus("arm", BoardConfig(str(path), 1_000_000), TimeoutConfig(reply_s=0.3), RealClock())
        assert bus.open(IDS) == dict.fromkeys(IDS, 777)
        stands = bus.read_all("present_position", IDS)
        assert all(abs(count - stands_at) < 40 for count, stands_at in zip(stands.values(), PARKED, strict=True))
        bus.write(1, "acceleration", 100)
        bus.write(1, "goal_speed", 2000)
        bus.write_all(("goal_position",), {1: (stands[1] + 200,)})
        ends = time.monotonic() + 20
        while abs(bus.read(1, "present_position") - stands[1] - 200) > 20 and time.monotonic() < ends:
            time.sleep(0.05)
        assert abs(bus.read(1, "present_position") - stands[1] - 200) <= 20
        bus.write(1, "torque_enable", 0)
        bus.close()


CLIENTS = {"vendor": "ftservo-python-sdk", "lerobot_sdk": "feetech-servo-sdk", "rustypot": "rustypot"}


@pytest.mark.clients
@pytest.mark.parametrize("client", CLIENTS)
def test_other_peoples_programs_drive_the_bus(client, served):
    """Ping, scan, read, write, configure, sync read and sync write; each program in its own environment, made by ``make test-clients``."""
    python = Path(os.environ.get("CLIENTS", ".venv-clients")) / client / "bin" / "python"
    script = Path(__file__).parent / "clients" / f"{client}_client.py"
    for path in served[:2]:
        said = subprocess.run([python, script, path], capture_output=True, text=True, timeout=120, check=False)
        assert said.returncode == 0, said.stderr
        seen = json.loads(said.stdout)
        assert (seen["models"], seen["missing"], seen["p"]) == ([777] * 6, True, 16)
        assert all(abs(count - stands_at) < 40 for count, stands_at in zip(seen["before"], PARKED, strict=True))
        assert seen["one"] == seen["before"][0]
        assert all(abs(count - goal) < 20 for count, goal in zip(seen["after"], [2300, 1900, 1900], strict=False))
        assert seen["after"][3:] == seen["before"][3:]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["faults=frozen"], "frozen"),
        (["board=main"], "left, right"),
        (["hardware.arms.left.channels=[1,2,3,4,4]"], "used once"),
        (["hardware.protocol=dynamixel"], "ssc32, feetech"),
    ],
)
def test_what_cannot_be_emulated_is_one_line(arguments, words, tmp_path, capsys):
    assert main(["emulate", "hardware=so101", f"link={tmp_path / 'port'}", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())

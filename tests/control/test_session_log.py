"""A session whose log has no room goes on to where its arms are parked, ends there, and says so."""

from __future__ import annotations

import json
import resource

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.cli import main
from marl_handover.control.closed_loop import make_loop
from marl_handover.control.session import GivenGoal, Session
from marl_handover.control.settings import twin_workcell
from marl_handover.errors import CannotWrite

START, FAR = [-60.0, 20.0, 0.7], [50.0, 25.0, -2.0]


def test_a_disk_that_fills_up_while_an_arm_moves_ends_the_session_when_it_is_parked(twin_calibration, tmp_path):
    config, path = twin_workcell(), tmp_path / "log.jsonl"
    config.calibration, config.hardware.stop_file = str(twin_calibration), str(tmp_path / "stop")
    usual, moved = resource.getrlimit(resource.RLIMIT_FSIZE), []

    def starve(row):
        if row["event"] == "motion":
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, usual[1]))
        moved.append(row["event"])

    with make_loop(policies.adapted("exact"), "hardware", config=config, log_path=str(path)) as loop:
        session = Session(loop, {})
        session.log.show(starve)
        try:
            with pytest.raises(CannotWrite, match="log.jsonl cannot be written: File too large") as full:
                session.play(START, GivenGoal(FAR))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        np.testing.assert_allclose(loop.backend.joints_rad(), loop.backend.check.homes_rad, atol=1e-6)
    assert full.value.exit_status == 1
    assert moved.count("motion") == 1, "no second one began"
    assert moved.index("motion") < moved.index("transfer") or "ended" in moved, "the first one was played to its end"
    content = path.read_bytes()
    assert content.endswith(b"\n")
    assert [json.loads(line)["event"] for line in content.splitlines()][-1] == "state"


def test_a_log_that_is_full_from_the_beginning_moves_nothing(twin_calibration, tmp_path, capsys):
    usual = [f"calibration={twin_calibration}", f"hardware.stop_file={tmp_path / 'stop'}", "policy=exact"]
    assert main(["run", "hardware=twin", "log=/dev/full", *usual]) == 1
    said = capsys.readouterr()
    assert "/dev/full cannot be written: No space left on device" in said.err
    assert said.err.count("\n") == 1
    assert "episode" not in said.out

"""``marl-handover run`` and ``evaluate backend=twin``, end to end through bytes and pixels."""

from __future__ import annotations

import json

import numpy as np
import pytest

from marl_handover.cli import main

ONE = ["start=[-60,20,40]", "goal=[50,25,76]", "policy=exact"]


def test_the_twin_runs_episodes_and_keeps_a_log(tmp_path, twin_calibration, capsys):
    log, stop = tmp_path / "log.jsonl", f"hardware.stop_file={tmp_path / 'stop'}"
    assert main(["run", "hardware=twin", f"calibration={twin_calibration}", f"log={log}", stop, *ONE]) == 0
    assert "1 of 1 at the goal" in capsys.readouterr().out
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    assert rows[0]["event"] == "session"
    assert rows[0]["hardware"] == "twin"
    transfers = [row for row in rows if row["event"] == "transfer"]
    assert transfers
    np.testing.assert_allclose(transfers[-1]["next_state"][:2], [50, 25], atol=5)


def test_a_latched_stop_keeps_arms_still_and_is_said(tmp_path, twin_calibration, capsys):
    stop = f"hardware.stop_file={tmp_path / 'stop'}"
    assert main(["stop", stop, "wait_s=0", "reason=fire"]) == 0
    arguments = ["run", "hardware=twin", f"calibration={twin_calibration}", stop, *ONE]
    assert main(arguments) == 1
    assert "stopped: fire" in capsys.readouterr().err
    assert main(["stop", stop, "clear=true"]) == 0
    assert main([*arguments, "dry_run=true"]) == 0
    assert "dry run: nothing moved" in capsys.readouterr().out


def test_evaluate_on_the_twin_reports_true_poses(tmp_path, twin_calibration):
    result, trace = tmp_path / "result.json", tmp_path / "trace.jsonl"
    arguments = ["policy=exact", "backend=twin", "episodes=2", "seed=1", "progress=false"]
    assert main(["evaluate", *arguments, f"calibration={twin_calibration}", f"json={result}", f"trace={trace}"]) == 0
    report = json.loads(result.read_text(), parse_constant=pytest.fail)
    assert report["backend"] == "twin"
    assert report["success_in_the_end"] == 1.0
    assert 0 < report["position_error_mm"]["p99"] < 5
    assert report["chart_inset"] < 1
    assert all(row["outcome"] in (None, "success") for row in map(json.loads, trace.read_text().splitlines()))


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["hardware=twin", "calibration=nowhere"], "calibrate"),
        (["hardware=twin", "episodes=0"], "episodes"),
        (["hardware=twin", "goal=[900,0,0]"], "reach"),
        (["hardware=twin", "goal=[1,2]"], "goal"),
        (["hardware=twin", "log=/nowhere/log"], "folder"),
        (["hardware=lynxmotion", "camera.path=/dev/null/cam", "start=[0,0,0]"], "start"),
        (["hardware=lynxmotion", "camera.path=/dev/null/cam", "printed=true"], "printed"),
        (["hardware=twin", "watch.steady_frames=1"], "steady_frames"),
        (["hardware=nonsense"], "nonsense"),
        (["hardware=lynxmotion", "camera.path=/dev/no-camera"], "/dev/no-camera is not there"),
    ],
)
def test_bad_input_is_one_line(capsys, twin_calibration, arguments, word):
    usual = [f"calibration={twin_calibration}"] if not any("calibration" in argument for argument in arguments) else []
    assert main(["run", *arguments, *usual]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert word in error


@pytest.mark.parametrize("given", ["task.noise.position_mm=1", "grasp=friction", "missed_grasps=0.1"])
def test_what_physics_decides_is_refused_on_the_twin(capsys, given):
    assert main(["evaluate", "policy=exact", "backend=twin", given]) == 2
    assert "backend=" in capsys.readouterr().err

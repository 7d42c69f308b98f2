from __future__ import annotations

import json

import motion
import motion_peers
import numpy as np
import pytest
import transfers
from ompl_planner import STEP_RAD

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.path_optimizer import NoPath
from marl_handover.motion.planner import MotionPlanner


@pytest.fixture(scope="module")
def planner() -> MotionPlanner:
    return MotionPlanner(build_cell(cell_config("paper")))


def test_the_committed_transfers_can_be_begun_and_ended(planner):
    """1,000 of them, half blocked; both ends of every 40th keep all demands."""
    rows = transfers.read()
    assert len(rows) == 1000
    assert sum(row["blocked"] for row in rows) == 500
    for row in rows[::40]:
        segment = planner.carrying(*motion_peers.arguments(row))[0]
        assert min(segment.check(q[None])[0].worst for q in segment.ends) >= 0.0
        assert row["best_mm"] is None or row["best_mm"] >= segment.lower_bound_mm - 0.05


def test_transfers_counts_what_it_finds(planner):
    rows = transfers.read()[:6]
    blocked = {**rows[0], "other_rad": planner.grasp_joints(1 - rows[0]["arm"], "hold", np.zeros(2)).tolist(), "place_mm": [0.0, 0.0]}
    summary, found = motion.transfers(planner, [*rows, blocked])
    assert summary["success"] == pytest.approx(6 / 7)
    assert summary["refused"] == {"end: the clearance to the other arm": 1}
    lengths = [path.length_mm / row["best_mm"] for path, row in zip(found, rows, strict=True)]
    assert summary["length_over_best"]["median"] == pytest.approx(np.median(lengths), abs=1e-4)
    assert summary["length_over_best"]["rows"] == 6
    assert summary["least_clearance_mm"]["arm"] >= planner.motion.arm_clearance_mm
    assert summary["least_clearance_mm"]["ground"] >= planner.motion.ground_clearance_mm


def test_peers_solve_the_same_transfers(planner):
    rows = transfers.read()[:100:50]
    paper = motion_peers.against_paper(planner, rows)
    assert paper["times_faster"] == pytest.approx(paper["paper_ms"]["median"] / paper["ours_ms"]["median"], rel=0.01)
    assert 0 <= paper["paper_found_without_tolerance"] <= paper["paper_found_within_1_mm"] <= 2
    pytest.importorskip("ompl")
    ompl = motion_peers.against_ompl(planner, rows)
    assert ompl is not None
    assert ompl["found"] == 2
    assert ompl["ompl_length_over_ours"]["median"] > 1.0


def test_toppra_times_the_same_path(planner):
    pytest.importorskip("toppra")
    path = planner.transfer(*motion_peers.arguments(transfers.read()[0])).points
    found = motion_peers.against_toppra(planner, [path])
    assert 0.97 < found["duration_over_toppra_500"]["median"] < 1.03


def test_dense_keeps_to_the_corners_and_to_the_step():
    corners = np.random.default_rng(0).normal(size=(5, 4))
    samples = motion_peers.dense(corners)
    assert np.linalg.norm(np.diff(samples, axis=0), axis=1).max() <= STEP_RAD + 1e-12
    assert np.linalg.norm(np.diff(samples, axis=0), axis=1).sum() == pytest.approx(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    assert np.isclose(samples[:, None], corners).all(-1).any(0).all()
    np.testing.assert_array_equal(motion_peers.dense(corners[[0, 0]])[-1], corners[0])


def test_a_refusal_is_timed_too_and_an_error_is_not_hidden():
    def refuse() -> None:
        raise NoPath("path", "nothing", 1.0, 3)

    assert isinstance(motion_peers.timed(refuse).found, NoPath)
    with pytest.raises(ZeroDivisionError):
        motion_peers.timed(lambda: 1 // 0)


@pytest.mark.slow
def test_the_report_is_written_with_its_settings_and_printed(planner, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(motion, "ROOT", tmp_path)
    motion.main(["rows=3", "every=2", "cycles=2", "costs=5", "starts=false", "many=2", "results=here"])
    (file,) = tmp_path.glob("here/*/motion.json")
    found = json.loads(file.read_text())
    given = {"rows": 3, "every": 2, "cycles": 2, "costs": 5, "starts": False, "many": 2, "results": "here"}
    assert found["settings"] == {**motion.DEFAULTS, **given}
    assert [found["cells"][name]["arms"] for name in motion.CELLS] == [2, 3, 6]
    assert found["cells"]["ring6"]["times_the_pair"] > 0
    assert (found["transfers"]["rows"], found["paper"]["rows"], found["path_costs"]["transfers"]) == (3, 2, 5)
    assert {"commit", "machine"} <= found.keys()
    text = capsys.readouterr().out
    assert "transfer, 3 rows, ms" in text
    assert "2 random ones" in text
    assert "among 6 arms, ring6" in text

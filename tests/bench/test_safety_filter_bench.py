"""The judge of bench/safety_filter.py against the gate's own geometry, and a slice of what it judges."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import safety_filter as bench

from marl_handover.hardware.clearance import FAR_MM, alone_mm, arm_shapes, between_mm, still
from marl_handover.hardware.safety_filter import JointCommand


@pytest.fixture(scope="module")
def court():
    return bench.Court(3)


@pytest.mark.slow
@pytest.mark.parametrize("holding", [(False, False), (True, False), (True, True)])
def test_two_geometries_agree(court, holding):
    """Written apart from each other; the judge works out nothing beyond 12 mm."""
    shapes = [arm_shapes(court.model, it) for it in holding]
    bases = [np.array([base.x_mm, base.y_mm, base.facing_rad]) for base in court.model.cell.bases]
    met = 0
    for _ in range(300):
        joints, seen, gaps = np.stack([court.draw.place(), court.draw.place()]), np.empty(4), np.empty((2, 3))
        bench.least_mm(joints[None], court.bases, court.bodies, np.array(holding), np.ones(2, bool), -FAR_MM, seen)
        for arm in range(2):
            alone_mm(still(joints[arm]), shapes[arm], np.full(3, FAR_MM), gaps[arm])
        apart = between_mm(still(joints[0]), still(joints[1]), True, *shapes, *bases, FAR_MM)
        expected = np.array([gaps[:, 0].min(), gaps[:, 1].min(), apart, gaps[:, 2].min()])
        near = np.minimum(expected, seen) < bench.FAR_MM - 1e-6
        np.testing.assert_allclose(seen[near], expected[near], atol=1e-6)
        met += near.sum()
    assert met > 100


def test_the_judge_sees_what_happens_between_looks(court):
    """Two arms that are apart in eleven postures and pass through each other in between; and a start from which all stays clear."""
    ways = np.radians(
        [
            [[-1.1, 84.0, -131.2, 12.4, -44.6], [18.7, 103.7, -111.7, 21.2, -64.5]],
            [[-18.6, 146.8, -123.4, 7.2, -25.3], [-0.1, 127.3, -143.3, -10.2, -43.0]],
        ]
    )
    commands = [JointCommand(arm, ways[arm, 1], 12.0) for arm in range(2)]
    found = {}
    for samples in (11, 1000):
        drawn, least = bench.Drawn(ways[:, 0], (12.0, 12.0), {}, commands, 0.1), np.empty(4)
        Q = bench.postures(drawn, samples, np.random.default_rng(0))
        bench.least_mm(Q, court.bases, court.bodies, np.zeros(2, bool), np.ones(2, bool), -FAR_MM, least)
        found[samples] = least[2]
    assert found[11] > 3.0
    assert found[1000] < -12.0


def check_commands(commands, samples, seed):
    found = bench.judged(commands, samples, seed)
    assert found["broken"] == []
    kinds = found["kinds"]
    for name, it in kinds.items():
        assert it["needless"] <= 0.05 * it["keep_5_mm"], name
        assert it["keep_5_mm"] > 0.2 * it["count"], "most of these are no test of what is refused for nothing"
        assert it["passed_within_2_mm"] > 0.01 * it["count"], "nor those of what passes"
    assert {"passed", "table", "itself", "other arm"} == set(found["reasons"])
    assert min(it["count"] for it in kinds.values()) > 0.2 * commands


def test_what_passes_keeps_what_is_promised(court):
    check_commands(400, 250, seed=1)


@pytest.mark.slow
def test_what_passes_keeps_what_is_promised_of_ten_thousand(court):
    check_commands(10_000, 1000, seed=2)


def test_a_streamed_transfer_is_timed(tmp_path, monkeypatch, capsys):
    """As the program that is run at both commits does it."""
    track = bench.streamed()
    assert track.shape[1] == 6
    assert np.degrees(np.abs(np.diff(track[:, :5], axis=0)).max()) <= 20.0
    assert {0.0, bench.OPEN_MM} <= set(track[:, 5].round(6))
    np.save(tmp_path / "track.npy", track)
    monkeypatch.setattr(sys, "argv", ["-c", str(tmp_path / "track.npy")])
    exec(bench.TIMER, {})
    median, high = map(float, capsys.readouterr().out.split())
    assert 0.0 < median <= high

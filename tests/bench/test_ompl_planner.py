"""The sampling planner finds ways that are valid, and says when there is none."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from ompl_planner import STEP_RAD, OmplMissing, rrt_connect

from marl_handover.errors import InvalidSetting, NotFinite, WorkFailed

pytest.importorskip("ompl")

Floats = NDArray[np.float64]

LOWER, UPPER = np.full(5, -2.0), np.full(5, 2.0)
START, GOAL = np.array([-1.0, 0.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.2, 0.0, -0.3, 0.0])


def around_a_wall(q: Floats) -> bool:
    """Joint 0 passes its middle only where joint 1 is high."""
    return abs(q[0]) > 0.3 or q[1] > 1.0


def through_no_wall(q: Floats) -> bool:
    return bool(abs(q[0]) > 0.3)


def samples(way: Floats, step: float) -> Floats:
    """Joint vectors along a polyline, at most ``step`` apart."""
    pieces = [np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / step), endpoint=False) for a, b in itertools.pairwise(way)]
    return np.concatenate([*pieces, way[-1:]])


@pytest.mark.parametrize("seed", range(8))
def test_the_way_is_valid_and_within_the_limits(seed: int) -> None:
    way = rrt_connect(START, GOAL, around_a_wall, LOWER, UPPER, seconds=5.0, seed=seed)
    assert way is not None
    np.testing.assert_array_equal(way[[0, -1]], [START, GOAL])
    assert (way >= LOWER).all()
    assert (way <= UPPER).all()
    # Between two checked joint vectors a corner of the wall may be cut by no more than their distance.
    dense = samples(way, STEP_RAD / 4)
    assert ((np.abs(dense[:, 0]) > 0.3 - STEP_RAD) | (dense[:, 1] > 1.0 - STEP_RAD)).all()


def test_corners_are_cut() -> None:
    """The shortest way is 2.9 rad long; RRT-Connect's own are 7.5 on the average, these 4.3."""
    ways = [rrt_connect(START, GOAL, around_a_wall, LOWER, UPPER, seconds=5.0, seed=seed) for seed in range(8)]
    assert np.mean([np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in ways if way is not None]) < 5.0


def test_one_seed_one_way() -> None:
    ways = [rrt_connect(START, GOAL, around_a_wall, LOWER, UPPER, seconds=5.0, seed=seed) for seed in (4, 0, 5, 4, 0)]
    assert all(way is not None for way in ways)
    np.testing.assert_array_equal(ways[0], ways[3])
    np.testing.assert_array_equal(ways[1], ways[4])
    assert not np.array_equal(ways[0], ways[2])


def test_a_free_way_is_straight() -> None:
    way = rrt_connect(START, GOAL, lambda q: True, LOWER, UPPER, seconds=5.0, seed=0)
    np.testing.assert_array_equal(way, [START, GOAL])


def test_without_a_way_it_gives_up() -> None:
    assert rrt_connect(START, GOAL, through_no_wall, LOWER, UPPER, seconds=0.3, seed=0) is None


@pytest.mark.parametrize("invalid", [START, GOAL])
def test_an_invalid_end_has_no_way(invalid: Floats) -> None:
    assert rrt_connect(START, GOAL, lambda q: not np.array_equal(q, invalid), LOWER, UPPER, seconds=5.0, seed=0) is None


def test_a_joint_with_equal_limits_stays() -> None:
    low, high = LOWER.copy(), UPPER.copy()
    low[4] = high[4] = 0.0
    way = rrt_connect(START, GOAL, around_a_wall, low, high, seconds=5.0, seed=1)
    assert way is not None
    assert (way[:, 4] == 0.0).all()
    still = rrt_connect(START, START, around_a_wall, START, START, seconds=1.0, seed=1)
    np.testing.assert_array_equal(still, [START, START])


def test_an_error_of_the_check_is_not_swallowed() -> None:
    calls = []

    def broken(q: Floats) -> bool:
        calls.append(q)
        if len(calls) > 10:
            raise ZeroDivisionError("a bug")
        return around_a_wall(q)

    with pytest.raises(ZeroDivisionError, match="a bug"):
        rrt_connect(START, GOAL, broken, LOWER, UPPER, seconds=1.0, seed=0)


def test_missing_ompl_is_named_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ompl", None)
    with pytest.raises(OmplMissing, match=r"pip install 'ompl>=") as caught:
        rrt_connect(START, GOAL, around_a_wall, LOWER, UPPER, seconds=1.0, seed=0)
    assert isinstance(caught.value, WorkFailed)


def test_bad_input_is_named() -> None:
    good = {"start_q": START, "goal_q": GOAL, "lower": LOWER, "upper": UPPER, "seconds": 1.0, "seed": 0}
    for change, name, error in (
        ({"start_q": START * np.nan}, "start_q", NotFinite),
        ({"goal_q": GOAL + 5.0}, "goal_q", InvalidSetting),
        ({"goal_q": GOAL[:4]}, "goal_q", InvalidSetting),
        ({"lower": UPPER + 1.0}, "lower", InvalidSetting),
        ({"seconds": 0.0}, "seconds", InvalidSetting),
        ({"seed": -1}, "seed", InvalidSetting),
    ):
        with pytest.raises(error, match=name):
            rrt_connect(is_valid=around_a_wall, **{**good, **change})

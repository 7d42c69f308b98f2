import math

import numpy as np
import pytest

from marl_handover.geometry.se3 import flat_pose
from marl_handover.perception.camera import Frame
from marl_handover.perception.detector import Detector
from marl_handover.perception.settings import TrackerConfig
from marl_handover.perception.tracker import Tracker

PERIOD_S = 1 / 30


@pytest.fixture
def show(painter, calibration, model):
    """``show(block, goal)``: what a tracker of its own makes of the next picture; each is 1/30 s after the one before."""
    tracker = Tracker(Detector(calibration, model.cell.config.block))
    shown = []

    def next_picture(block, goal=None, image=None, wait_s=PERIOD_S):
        image = painter.picture(None if block is None else flat_pose(*block), goal=goal) if image is None else image
        before_s = shown[-1].t_s if shown else 0.0
        shown.append(Frame(image, before_s + wait_s, len(shown) + 1))
        return tracker.update(shown[-1])

    next_picture.tracker, next_picture.shown = tracker, shown
    return next_picture


def test_nothing_is_known_before_anything_is_seen(show):
    seen = show(None)
    assert seen.block.pose is None
    assert seen.block.hidden
    assert math.isinf(seen.block.age_s)
    assert not seen.frozen


def test_a_block_that_moves_is_followed(show):
    for step in range(6):
        pose = (10 + 8 * step, -50, 0.1 * step)
        seen = show(pose, goal=(120, 60, 1.0))
        assert seen.block.seen
        assert seen.block.age_s == 0
        np.testing.assert_allclose(seen.block.pose, pose, atol=0.5)
        np.testing.assert_allclose(seen.goal.pose, (120, 60, 1.0), atol=0.5)


def test_a_jump_is_doubted_until_it_is_confirmed(show):
    here, there = np.array([0.0, 0.0, 0.0]), np.array([120.0, 80.0, 2.0])
    show(here)
    for _ in range(2):
        seen = show(there)
        np.testing.assert_allclose(seen.block.pose, here, atol=0.5)
        assert not seen.block.seen
        np.testing.assert_allclose(seen.block.doubted.pose, there, atol=0.5)
    seen = show(there)
    assert seen.block.seen
    assert seen.block.doubted is None
    np.testing.assert_allclose(seen.block.pose, there, atol=0.5)


def test_sightings_here_and_there_confirm_nothing(show):
    show((0.0, 0.0, 0.0))
    for place in ((120, 80), (-120, 60), (120, -80), (-120, -80)):
        seen = show((*place, 1.0))
        assert seen.block.doubted is not None
        np.testing.assert_allclose(seen.block.pose, 0, atol=0.5)


def test_a_turn_on_the_spot_is_a_jump_too(show):
    show((50.0, 0.0, 0.0))
    assert show((50.0, 0.0, 1.0)).block.doubted is not None


def test_what_was_long_out_of_sight_may_be_anywhere(show):
    show((0.0, 0.0, 0.0))
    show(None, wait_s=1.0)
    assert show((120.0, 80.0, 2.0)).block.seen


def test_a_hidden_block_and_a_covered_goal_keep_their_places(show):
    show((0.0, 0.0, 0.3), goal=(100, 50, 1.0))
    for step in range(4):
        seen = show(None, wait_s=0.2)
        assert not seen.block.seen
        assert seen.block.age_s == pytest.approx(0.2 * (step + 1))
        assert seen.block.hidden == (0.2 * (step + 1) > 0.5)
        np.testing.assert_allclose(seen.block.pose, (0, 0, 0.3), atol=0.5)
        np.testing.assert_allclose(seen.goal.pose, (100, 50, 1.0), atol=0.5)
    assert show((0.0, 0.0, 0.3), wait_s=0.2).block.seen


def test_a_goal_laid_elsewhere_is_found_within_so_many_pictures(show):
    show((0.0, 0.0, 0.3), goal=(100, 50, 1.0))
    moved = (-120, 60, -1.0)
    found = [show((0.0, 0.0, 0.3), goal=moved) for _ in range(13)]
    np.testing.assert_allclose(found[-1].goal.pose, moved, atol=0.5)


def test_a_camera_that_repeats_one_picture_is_frozen_and_nothing_of_it_is_seen(show):
    fresh = show((0.0, 0.0, 0.3))
    image = show.shown[-1].image
    states = [show(None, image=image) for _ in range(5)]
    assert [state.frozen for state in states] == [False, False, True, True, True]
    assert not states[-1].block.seen
    assert states[-1].block.age_s == pytest.approx(3 * PERIOD_S)
    again = show((0.0, 0.0, 0.3))
    assert not again.frozen
    assert again.block.seen
    assert fresh.number == 1


def test_a_frame_seen_before_counts_as_frozen(show):
    show((0.0, 0.0, 0.3))
    show((0.0, 0.0, 0.3))
    old = show.tracker.update(show.shown[0])
    assert old.frozen
    assert not old.block.seen
    assert not show((0.0, 0.0, 0.3)).frozen


def test_pictures_without_noise_can_be_told_from_a_frozen_camera_by_a_setting(painter, calibration, model):
    tracker = Tracker(Detector(calibration, model.cell.config.block), TrackerConfig(frozen_frames=0))
    image = painter.picture(flat_pose(0, 0, 0))
    assert not any(tracker.update(Frame(image, 0.1 * number, number)).frozen for number in range(1, 8))
    tracker.reset()
    assert tracker.update(Frame(image, 0.0, 1)).block.seen

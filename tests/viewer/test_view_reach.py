from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cell import load_cell
from marl_handover.task.problems import sample_positions
from marl_handover.viewer.handles import within_reach

CELL = load_cell("paper")
far = st.floats(-900, 900)


def reachable(count=4000):
    import torch

    return sample_positions(CELL, count, torch.Generator().manual_seed(1)).numpy()


PLACES = reachable()


@given(far, far, st.floats(-3, 3))
def test_the_place_is_reached_and_none_is_nearer(x, y, yaw):
    moved = within_reach(CELL, np.array([x, y, yaw]))
    assert CELL.reaches(moved[:2]).any()
    assert moved[2] == yaw
    distance = np.hypot(*(moved[:2] - (x, y)))
    assert distance <= np.hypot(*(PLACES - (x, y)).T).min() + 1e-6


def test_what_is_reached_stays_where_it_is():
    for place in PLACES[:100]:
        pose = np.array([*place, 0.3])
        np.testing.assert_array_equal(within_reach(CELL, pose), pose)


def test_a_base_is_moved_to_the_other_arms_reach_or_to_the_inner_circle():
    base = CELL.bases[0]
    moved = within_reach(CELL, np.array([base.x_mm, base.y_mm, 0.0]))
    assert np.hypot(*(moved[:2] - (base.x_mm, base.y_mm))) <= CELL.r_min_mm + 1e-6

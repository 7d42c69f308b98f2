from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from places import edge_mm

from marl_handover.cell import build_cell, cell_config

CELL = build_cell(cell_config("paper")).cell
INNER = st.floats(-0.999, 0.999)


@given(INNER, INNER)
def test_a_place_of_the_shared_space_is_so_far_from_what_bounds_it(alpha, beta):
    """Every step that is shorter stays inside, and one a little longer, in some direction, leads out."""
    place = CELL.chart.to_table(np.array(alpha), np.array(beta))
    edge = edge_mm(CELL, place[None])[0]
    assert edge >= 0
    turns = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    around = place + edge * np.stack([np.cos(turns), np.sin(turns)], -1)
    assert edge_mm(CELL, place + 0.999 * (around - place)).min() >= -1e-9
    assert edge_mm(CELL, place + 1.01 * (around - place)).min() <= 1e-3


def test_the_chart_ends_at_the_edge():
    alpha = np.linspace(-1, 1, 41)
    for beta in (-1.0, 1.0):
        np.testing.assert_allclose(edge_mm(CELL, CELL.chart.to_table(alpha, np.full(41, beta))), 0, atol=1e-6)

from __future__ import annotations

import math

import numpy as np
import pytest

from marl_handover.viewer.table import TableNodes, chart_lines, sector_outline, shared_mesh

INNER = 0.999  # a little off the edges, where floats decide


@pytest.mark.parametrize("arm", [0, 1])
def test_the_outline_of_an_arm_is_the_edge_of_what_it_reaches(paper, arm):
    outline = sector_outline(paper, arm)
    np.testing.assert_allclose(outline[0], outline[-1])
    base = np.array([paper.bases[arm].x_mm, paper.bases[arm].y_mm])
    radii = np.hypot(*(outline - base).T)
    assert radii.min() == pytest.approx(paper.r_min_mm)
    assert radii.max() == pytest.approx(paper.r_max_mm)
    middle = outline.mean(0)
    assert paper.reaches(outline + 1e-6 * (middle - outline)).shape == (len(outline), 2)
    outside = base + (outline - base) * np.where(radii > 0.5 * (paper.r_min_mm + paper.r_max_mm), 1.01, 0.99)[:, None]
    assert not paper.reaches(outside)[:, arm].any()


def test_the_shaded_mesh_covers_the_shared_space(paper):
    vertices, faces = shared_mesh(paper)
    assert paper.reaches(INNER * vertices[:, :2]).all()
    a, b, c = (vertices[faces[:, corner], :2] for corner in range(3))
    area = 0.5 * abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
    x = np.linspace(-paper.chart.x_max_mm, paper.chart.x_max_mm, 20001)
    exact = 2 * np.trapezoid(paper.chart.y_max_mm(x), x)
    assert area == pytest.approx(exact, rel=0.01)


def test_chart_lines_stay_in_the_shared_space(paper):
    lines = chart_lines(paper)
    assert all(paper.reaches(INNER * line).all() for line in lines)
    assert any(np.abs(line[:, 1]).max() < 1e-9 for line in lines)  # beta = 0, the axis


def test_the_table_is_under_everything_an_arm_reaches(server, paper):
    TableNodes(server).show(paper)
    table = server.scene.get_handle_by_name("/table")
    half = 500 * np.asarray(table.dimensions)
    for arm in range(2):
        assert (np.abs(sector_outline(paper, arm)) < half[:2]).all()
    assert 1e3 * table.position[2] + half[2] == pytest.approx(0.0)
    assert server.scene.get_handle_by_name("/name_0").text == "left arm"
    assert not math.isclose(server.scene.get_handle_by_name("/name_0").position[1], 0.0)

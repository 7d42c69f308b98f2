"""The motion figure shows what the motions are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.errors import CorruptFile, InvalidSetting
from marl_handover.motion.planner import MotionPlanner
from marl_handover.report.figure_style import save_figure
from marl_handover.report.motion import SHOWN_MM, motion_figure, motion_row, plan_motions, read_motions, require_fit


@pytest.fixture(scope="module")
def planned():
    planner = MotionPlanner(build_cell(cell_config("paper")))
    orders = [(0, np.array([-120.0, 60.0]), np.array([60.0, 0.0])), (1, np.array([60.0, 0.0]), np.array([-150.0, -90.0]))]
    return planner, plan_motions(planner, orders)


@pytest.fixture(scope="module")
def panels(planned):
    planner, motions = planned
    figure = motion_figure(motions, planner.model, planner.motion)
    return {axes.get_ylabel().split(" ")[0]: axes for axes in figure.axes}, figure


def test_time_runs_on_over_the_transfers(planned, panels):
    _, motions = planned
    for name in ("joint", "clearance,"):
        low, high = panels[0][name].get_xlim()
        assert (low, high) == pytest.approx((0.0, sum(motion.duration_s for motion in motions)))


def test_paths_go_over_pick_and_place(planned, panels):
    _, motions = planned
    for name, columns in (("y", (0, 1)), ("z", (1, 2))):
        lines = [np.stack(line.get_data(), -1) for line in panels[0][name].lines if len(line.get_xdata()) > 5]
        points = np.concatenate(lines)
        for motion in motions:
            for place in (motion.from_mm, motion.to_mm):
                at = np.array([*place, 45.0])[list(columns)]
                assert np.linalg.norm(points - at, axis=1).min() < 0.1


def test_drawn_clearances_are_not_below_the_planners(planned, panels):
    _, motions = planned
    lines = [line.get_ydata() for line in panels[0]["clearance,"].lines if line.get_linestyle() == "-" and len(line.get_ydata()) > 5]
    assert len(lines) == len(motions)
    for drawn, motion in zip(lines, motions, strict=True):
        assert min(drawn) == pytest.approx(min(motion.min_clearance_mm, SHOWN_MM), abs=2.0)


def test_it_is_a_picture_in_every_format(panels, tmp_path):
    for suffix, start in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        save_figure(panels[1], tmp_path / f"motion{suffix}")
        assert (tmp_path / f"motion{suffix}").read_bytes().startswith(start)


FILE = Path("motion.json")


def content(motions):
    """The file of some motions, read back."""
    return json.loads(json.dumps({"transfers": [motion_row(motion) for motion in motions]}))


def test_a_file_of_motions_gives_the_same_figure(planned, panels, assert_tidy):
    planner, motions = planned
    again = read_motions(content(motions), FILE)
    require_fit(again, planner.model)
    figure = motion_figure(again, planner.model, planner.motion)
    assert_tidy(figure)
    for drawn, first in zip(figure.axes, panels[1].axes, strict=True):
        for line, same in zip(drawn.lines, first.lines, strict=True):
            np.testing.assert_allclose(np.stack(line.get_data()), np.stack(same.get_data()), atol=1e-9)


def test_motions_of_another_cell_are_refused(planned):
    with pytest.raises(InvalidSetting, match="the cell of the motions"):
        require_fit(read_motions(content(planned[1]), FILE), build_cell(cell_config("al5a")))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda row: row.pop("phases"), "it lacks 'phases'"),
        (lambda row: row.update(arm="X"), "not in"),
        (lambda row: row.update(to=[1, None]), "finite"),
        (lambda row: row["phases"][0].update(name="dance"), "'dance' is no phase"),
        (lambda row: row["phases"][2]["joints_rad"].pop(), "finite numbers"),
        (lambda row: row.update(phases=row["phases"][:2]), "no phase in which the block is carried"),
    ],
)
def test_broken_files_are_named(planned, change, said):
    broken = content(planned[1])
    change(broken["transfers"][0])
    with pytest.raises(CorruptFile, match=said):
        read_motions(broken, FILE)
    for nothing in ({}, {"transfers": []}, {"transfers": 3}):
        with pytest.raises(CorruptFile, match=r"motion\.json"):
            read_motions(nothing, FILE)

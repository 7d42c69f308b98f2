"""The motion figure shows what the motions are."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner
from marl_handover.report.files import save_figure
from marl_handover.report.motion import SHOWN_MM, motion_figure
from marl_handover.runtime.motions import plan_motions


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

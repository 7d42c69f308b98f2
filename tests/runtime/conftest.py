"""The paper's cell with its planner, built once."""

from __future__ import annotations

import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner


@pytest.fixture(scope="session")
def planner():
    return MotionPlanner(build_cell(cell_config("paper")))


@pytest.fixture(scope="session")
def model(planner):
    return planner.model

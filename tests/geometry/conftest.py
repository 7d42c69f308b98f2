"""A cell and its planner, whose packed shapes the compiled functions are tested on."""

from __future__ import annotations

import pytest

from marl_handover.cell.build import CellModel, build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner


@pytest.fixture(scope="session")
def model() -> CellModel:
    return build_cell(cell_config("paper"))


@pytest.fixture(scope="session")
def planner(model: CellModel) -> MotionPlanner:
    return MotionPlanner(model)

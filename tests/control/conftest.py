"""The paper's cell with its planner, built once."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from marl_handover.cell import build_cell, cell_config
from marl_handover.motion.planner import MotionPlanner

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))


@pytest.fixture(scope="session")
def planner():
    return MotionPlanner(build_cell(cell_config("paper")))


@pytest.fixture(scope="session")
def model(planner):
    return planner.model

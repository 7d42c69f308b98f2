"""Robot descriptions for tests that lie beside the checkout; what needs them is skipped where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

CASES = Path(os.environ.get("MARL_CASES", Path(__file__).parents[1] / ".." / "shared" / "cases")).resolve()
CASES = CASES if CASES.is_dir() else Path(__file__).resolve().parents[3] / "shared" / "cases"
SMALL, PUBLIC = CASES / "urdf", CASES / "urdf-public"

needs_cases = pytest.mark.skipif(not PUBLIC.is_dir(), reason="no robot descriptions beside the checkout")

RINGS_MM = {
    "so101": (60, 269, 434),
    "so100": (60, 240, 432),
    "px100": (60, 180, 316),
    "wx250": (80, 252, 662),
    "open_manipulator_x": (45, 183, 379),
    "lite6": (100, 284, 566),
}
"""Public arms: pick height and level-hand ring by independent kinematics."""

"""Build the table of path costs that is shipped for the paper cell: python scripts/build_motion_cost.py."""

from pathlib import Path

import marl_handover
from marl_handover.cell import load_cell
from marl_handover.config import MotionConfig
from marl_handover.motion.path_length_table import SHIPPED, build_table

if __name__ == "__main__":
    build_table(load_cell("paper"), MotionConfig()).save(Path(marl_handover.__file__).parent / SHIPPED)

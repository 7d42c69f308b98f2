"""What every figure has to be, and traces to draw."""

from __future__ import annotations

import itertools
import json

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text


@pytest.fixture(scope="session")
def assert_tidy():
    """``assert_tidy(figure)``: all texts lie on the page and apart."""

    def check(figure):
        """All texts lie on the page and apart."""
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer = canvas.get_renderer()
        # A tick beyond the end of its axis is there, but not drawn.
        unseen = set()
        for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks():
                if not low - 1e-9 <= tick.get_loc() <= high + 1e-9:
                    unseen |= {tick.label1, tick.label2}
        boxes = [
            (text.get_text(), text.get_window_extent(renderer))
            for text in figure.findobj(Text)
            if text not in unseen and text.get_visible() and text.get_text().strip()
        ]
        for text, box in boxes:
            assert box.x0 >= -1, text
            assert box.y0 >= -1, text
            assert box.x1 <= figure.bbox.x1 + 1, text
            assert box.y1 <= figure.bbox.y1 + 1, text
        for (first, box), (second, other) in itertools.combinations(boxes, 2):
            # Neighbours may touch, by a pixel of the line height.
            across = min(box.x1, other.x1) - max(box.x0, other.x0)
            along = min(box.y1, other.y1) - max(box.y0, other.y0)
            assert across <= 1 or along <= 2, (first, second)

    return check


@pytest.fixture
def write_trace(tmp_path):
    """``write_trace(steps)``: the file of a trace, a line for each dictionary put over a plain step."""

    def write(*steps, name="trace.jsonl"):
        plain = {
            "episode": 0, "state": [-120.0, -60.0, 0.0], "goal": [150.0, 60.0, 1.0], "arm": "R", "final": False,
            "place": [0.0, 0.0], "next_state": [0.0, 0.0, 0.5], "outcome": None, "epsilon_rad": 0.0873,
        }  # fmt: skip
        (tmp_path / name).write_text("".join(json.dumps(plain | step) + "\n" for step in steps))
        return tmp_path / name

    return write

"""How figures look and are written: colours, marks, whole files in the format of their suffix.

Colour never stands alone: the arms also differ in line style, outcomes in their labels.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from marl_handover.errors import InvalidSetting
from marl_handover.files import make_folder, write_whole, writing
from marl_handover.palette import ARMS, BLUE, FAINT, GOAL, GREY, INK, OUTCOMES, PAPER, RED, SHARED, YELLOW, arm_colour

PICTURES = (".png", ".pdf", ".svg")
DOTS_PER_INCH = 150


def require_picture(name: str, path: Path | str) -> Path:
    """``path`` as a :class:`Path`; raises :class:`InvalidSetting` for a suffix that is no picture format. ``name`` is the setting's."""
    path = Path(path)
    if path.suffix.lower() not in PICTURES:
        raise InvalidSetting(name, str(path), f"a file that ends in {', '.join(PICTURES[:-1])} or {PICTURES[-1]}")
    return path


def save_figure(figure: Figure, path: Path, name: str = "out") -> None:
    """Write a figure in the format of the path's suffix; a reader sees the old file or the new one. ``name`` is the setting's."""
    suffix = require_picture(name, path).suffix.lower()
    FigureCanvasAgg(figure)
    make_folder(path.parent)
    # Without a date, the same picture is the same file.
    metadata = {".png": None, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}[suffix]
    # In this type text stays text, in a font that editors and publishers take.
    # A user's text.usetex, made for notebooks, would need LaTeX here, and take our text for its markup.
    for text in figure.findobj(Text):
        text.set_usetex(False)
        text.set_text(text.get_text().encode("utf-8", "replace").decode())  # a path of other bytes has letters that no font draws
    with matplotlib.rc_context({"pdf.fonttype": 42, "text.usetex": False}), writing(path) as stream:
        figure.savefig(stream, format=suffix[1:], dpi=DOTS_PER_INCH, metadata=metadata)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file as a whole."""
    make_folder(path.parent)
    write_whole(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


__all__ = [
    "ARMS",
    "ARM_LINES",
    "BLUE",
    "FAINT",
    "GOAL",
    "GREY",
    "HATCHES",
    "INK",
    "OUTCOMES",
    "PAPER",
    "RED",
    "SERIES",
    "SERIES_LINES",
    "SERIES_MARKERS",
    "SHARED",
    "YELLOW",
    "arm_colour",
    "arm_line",
    "series_marker",
    "series_style",
]

ARM_LINES = ("-", "--", "-.", ":")
"""Line style of each arm, by its index."""


def arm_line(index: int) -> str:
    """Line style of an arm; further arms start over."""
    return ARM_LINES[index % len(ARM_LINES)]


HATCHES = {"success": "", "wrong_orientation": "//", "wrong_position": "xx", "timeout": ".."}
"""Hatching of each way an episode ends."""

SERIES = ("#4477AA", "#EE6677", "#228833", "#CCBB44", "#66CCEE", "#AA3377", "#555555")
SERIES_LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)))
"""Paul Tol's bright colours for many curves in one picture, and the line styles that go with them; 35 differ."""


def series_style(index: int) -> dict[str, object]:
    """Colour and line style of the curve of that index: no two neighbours share either."""
    return {"color": SERIES[index % len(SERIES)], "linestyle": SERIES_LINES[index % len(SERIES_LINES)]}


SERIES_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""What tells curves apart where they are printed in grey and too short for their line style."""


def series_marker(index: int) -> str:
    """Marker of the curve of that index."""
    return SERIES_MARKERS[index % len(SERIES_MARKERS)]


def ruled(axes: Any, axis: str = "y") -> None:
    """Faint lines behind what is drawn, at the ticks of ``axis``, and no frame above or to the right."""
    axes.grid(axis=axis, color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)

"""Writing results as whole files and reading them back, with errors that name the file."""

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

"""Writing results as whole files and reading them back, with errors that name the file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from marl_handover.errors import InvalidSetting
from marl_handover.files import temporary_of, write_whole

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
    with _writable(path, name) as temporary:
        # Without a date, the same picture is the same file.
        metadata = {".png": None, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}[suffix]
        with matplotlib.rc_context({"pdf.fonttype": 42}):  # text stays text, in a font that editors and publishers take
            figure.savefig(temporary, format=suffix[1:], dpi=DOTS_PER_INCH, metadata=metadata)
        temporary.replace(path)


def write_json(path: Path, content: dict[str, Any], name: str) -> None:
    """Write a JSON file as a whole. ``name`` is the setting that named it."""
    with _writable(path, name):
        write_whole(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


@contextmanager
def _writable(path: Path, name: str) -> Iterator[Path]:
    """Make the folder of ``path``, give the temporary file's path, and leave no temporary file behind, whatever happens."""
    temporary = temporary_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(None, "it is a folder")
        yield temporary
    except OSError as error:
        raise InvalidSetting(name, str(path), f"a file that can be written ({error.strerror or error})") from error
    finally:
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)

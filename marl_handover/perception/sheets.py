"""Sheets to print: the calibration board, the block's top, goals, markers for the table. True to scale at 508 dpi: 20 px are 1 mm.

Print at 100 % ("actual size", not "fit to page"), then lay a ruler on the line at each sheet's foot: it must be 100 mm long, to 0.3 mm.
If it is not, print again: with a board printed at 99 % every length on the table comes out 1 % wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from marl_handover.config import BlockConfig, require_choice
from marl_handover.errors import InvalidSetting
from marl_handover.files import make_folder, writing
from marl_handover.perception.boards import Sheet, block_top, charuco_sheet, marker_sheet
from marl_handover.perception.settings import BoardConfig, TargetConfig

PX_PER_MM = 20
DPI = PX_PER_MM * 25.4
PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "letter": (279.4, 215.9)}
RULER_MM = 100
TABLE_MARKERS = (10, 11, 12, 13)
TABLE_MARKER_MM = 50.0

_FOOT_MM = 15.0
_TEXT_MM = 3.0
_LINE_PX = 3


def write_sheets(
    folder: Path | str, block: BlockConfig, target: TargetConfig | None = None, board: BoardConfig | None = None, paper: str = "a4"
) -> list[Path]:
    """Write every sheet as PNG and as PDF; gives the files.

    Args:
        folder: where to; made if need be.
        block: its size and its marker's.
        target: which markers.
        board: the calibration board.
        paper: one of :data:`PAPERS_MM`, landscape.

    Raises:
        UnknownChoice, InvalidSetting: another paper, or one on which a sheet has no room.
    """
    require_choice("paper", paper, tuple(PAPERS_MM))
    target, board = target or TargetConfig(), board or BoardConfig()
    target.validate()
    folder = Path(folder)
    make_folder(folder)
    tops = [block_top(block, target, PX_PER_MM)] * 6
    goals = [marker_sheet(target.dictionary, target.goal_id, target.goal_mm, target.goal_mm + 10, PX_PER_MM)] * 2
    table = [marker_sheet(target.dictionary, number, TABLE_MARKER_MM, TABLE_MARKER_MM + 14, PX_PER_MM) for number in TABLE_MARKERS]
    pages = {
        "board": page([charuco_sheet(board, PX_PER_MM)], paper, "calibration board", _board_words(board), arrows=True),
        "block": page(tops, paper, "block tops", "cut out, glue on with the pin through the middle", pierced=True),
        "goal": page(goals, paper, "goal", f"marker {target.goal_id}: lay it where the block is to go, as it is to be turned"),
        "table": page(
            table, paper, "table markers", f"numbers {', '.join(map(str, TABLE_MARKERS))}, left to right: their centres at known places"
        ),
    }
    files = []
    for name, image in pages.items():
        for suffix in (".png", ".pdf"):
            path = folder / f"{name}{suffix}"
            save_sheet(image, path)
            files.append(path)
    return files


def save_sheet(image: Image.Image, path: Path) -> None:
    """Write a page, in its true size, as PNG or PDF. Raises :class:`~marl_handover.errors.CannotWrite`."""
    kind: dict[str, Any] = {"format": "PDF", "resolution": DPI} if path.suffix == ".pdf" else {"format": "PNG", "dpi": (DPI, DPI)}
    with writing(path) as stream:
        image.save(stream, **kind)


def page(sheets: list[Sheet], paper: str, title: str, words: str, *, arrows: bool = False, pierced: bool = False) -> Image.Image:
    """A page, black and white, with sheets in rows, cutting lines around them, and a ruler at its foot.

    ``arrows``: x and y axes of a single sheet's frame, for laying it on the table; ``pierced``: a dot where the pin goes through.
    """
    width, height = (round(edge * PX_PER_MM) for edge in PAPERS_MM[paper])
    image = Image.new("L", (width, height), 255)
    draw = ImageDraw.Draw(image)
    gap = 0 if len(sheets) == 1 else round(8 * PX_PER_MM)
    edge_x, edge_y = sheets[0].pixels.shape[1], sheets[0].pixels.shape[0]
    across = max(1, (width + gap) // (edge_x + gap))
    rows = -(-len(sheets) // across)
    room = height - round(_FOOT_MM * PX_PER_MM)
    if edge_x > width or rows * (edge_y + gap) - gap > room:
        raise InvalidSetting(
            "paper", paper, f"larger: {title} needs {edge_x / PX_PER_MM:g} x {edge_y / PX_PER_MM:g} mm and {_FOOT_MM:g} mm below it"
        )
    left = (width - min(across, len(sheets)) * (edge_x + gap) + gap) // 2
    top = (room - rows * (edge_y + gap) + gap) // 2
    for index, sheet in enumerate(sheets):
        x, y = left + index % across * (edge_x + gap), top + index // across * (edge_y + gap)
        image.paste(Image.fromarray(np.ascontiguousarray(sheet.pixels)), (x, y))
        if gap:
            draw.rectangle([x - _LINE_PX, y - _LINE_PX, x + edge_x + _LINE_PX - 1, y + edge_y + _LINE_PX - 1], outline=0, width=1)
        if pierced:
            draw.ellipse([x + edge_x // 2 - 8, y + edge_y // 2 - 8, x + edge_x // 2 + 8, y + edge_y // 2 + 8], fill=255, outline=0, width=2)
    if arrows:
        _axes(draw, left, top, edge_x, edge_y)
    _foot(draw, width, height, f"marl_handover - {title}: {words}")
    return image.convert("1", dither=Image.Dither.NONE)


def _board_words(board: BoardConfig) -> str:
    squares = f"{board.columns} x {board.rows} squares of {board.square_mm:g} mm"
    return f"{squares}, markers {board.dictionary} of {board.marker_mm:g} mm; glue it on something flat"


def _axes(draw: ImageDraw.ImageDraw, left: int, top: int, width: int, height: int) -> None:
    """Marks at the middle of each edge; the board's x goes from the left mark to the right one, y from the lower to the upper."""
    mark, font = round(4 * PX_PER_MM), ImageFont.load_default(_TEXT_MM * PX_PER_MM)
    x, y = left + width // 2, top + height // 2
    for begin, end in (
        ((left - mark, y), (left - mark // 4, y)),
        ((left + width + mark // 4, y), (left + width + mark, y)),
        ((x, top - mark), (x, top - mark // 4)),
        ((x, top + height + mark // 4), (x, top + height + mark)),
    ):
        draw.line([begin, end], fill=0, width=2 * _LINE_PX)
    draw.text((left + width + mark // 2, y + mark // 4), "x", fill=0, font=font)
    draw.text((x + mark // 4, top - mark), "y", fill=0, font=font)


def _foot(draw: ImageDraw.ImageDraw, width: int, height: int, words: str) -> None:
    font = ImageFont.load_default(_TEXT_MM * PX_PER_MM)
    left, y, tick = round(10 * PX_PER_MM), height - round(6 * PX_PER_MM), round(1.5 * PX_PER_MM)
    draw.line([(left, y), (left + RULER_MM * PX_PER_MM, y)], fill=0, width=_LINE_PX)
    for mm in range(0, RULER_MM + 1, 10):
        x = left + mm * PX_PER_MM
        draw.line([(x, y - (tick if mm % 50 else 2 * tick)), (x, y)], fill=0, width=_LINE_PX)
    draw.text((left + (RULER_MM + 3) * PX_PER_MM, y - tick), f"{RULER_MM} mm: check with a ruler.", fill=0, font=font)
    draw.text((left, y - round(8 * PX_PER_MM)), words, fill=0, font=font)

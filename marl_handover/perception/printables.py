"""Sheets to print: the calibration board, the block's top, goals, markers for the table. True to scale at 508 dpi: 20 px are 1 mm.

Print at 100 % ("actual size", not "fit to page"), then lay a ruler on the line at each sheet's foot: it must be 100 mm long, to 0.3 mm.
If it is not, print again: with a board printed at 99 % every length on the table comes out 1 % wrong.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from marl_handover.arrays import Floats
from marl_handover.config import BlockConfig, require_choice
from marl_handover.errors import HandoverError, InvalidSetting, install_line
from marl_handover.files import make_folder, writing
from marl_handover.perception.settings import BoardConfig, TargetConfig

Pixels = NDArray[np.uint8]

_NAMES = {"16h5": "DICT_APRILTAG_16h5", "25h9": "DICT_APRILTAG_25h9", "36h11": "DICT_APRILTAG_36h11"}
WHITE, BLACK = 255, 0
TRUE_CORNERS = (4, 14)
"""The first OpenCV that counts the middle of a pixel alike when it finds a board's corners and when it projects them."""


class Sheet(NamedTuple):
    """A flat grey picture of a known size: pixels (height, width), and the edges in mm. Its frame: origin in the middle, y up, z out."""

    pixels: Pixels
    width_mm: float
    height_mm: float


class OldOpenCV(HandoverError):
    """An OpenCV that puts the printed corners of a board half a pixel off: cameras calibrated with it would be off in silence."""

    def __init__(self, version: str) -> None:
        super().__init__(f"OpenCV {version} finds corners half a pixel off; run: {install_line(only=['opencv-python-headless'])}")


@lru_cache(maxsize=8)
def dictionary(name: str) -> Any:
    """OpenCV's marker dictionary of one of ``settings.DICTIONARIES``.

    Raises:
        OldOpenCV: another package may have brought its own OpenCV, which then takes the place of the one that is asked for.
    """
    if tuple(map(int, cv2.__version__.split(".")[:2])) < TRUE_CORNERS:
        raise OldOpenCV(cv2.__version__)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _NAMES.get(name, "DICT_" + name.upper())))


def marker_cells(name: str, number: int) -> Pixels:
    """A marker, one pixel a cell, its black border included: (n, n) of 0 and 255. Raises :class:`InvalidSetting` for a number too high."""
    words = dictionary(name)
    if not 0 <= number < len(words.bytesList):
        raise InvalidSetting("marker", number, f"0 to {len(words.bytesList) - 1} in dictionary {name}")
    cells = int(words.markerSize) + 2
    return np.asarray(cv2.aruco.generateImageMarker(words, number, cells), dtype=np.uint8)


def marker_sheet(name: str, number: int, marker_mm: float, sheet_mm: float, px_per_mm: float = 8.0) -> Sheet:
    """A marker in the middle of a white square with edges of ``sheet_mm``."""
    cells = marker_cells(name, number)
    count, edge = len(cells), round(sheet_mm * px_per_mm)
    scale, middle = count / marker_mm / px_per_mm, (edge - 1) / 2
    # From a pixel of the sheet to the cell it shows; sampling the nearest cell keeps edges where they are to half a pixel.
    inverse = np.array([[scale, 0, (count - 1) / 2 - scale * middle], [0, scale, (count - 1) / 2 - scale * middle]])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    pixels = cv2.warpAffine(cells, inverse, (edge, edge), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=WHITE)
    return Sheet(np.asarray(pixels, dtype=np.uint8), edge / px_per_mm, edge / px_per_mm)


def block_top(block: BlockConfig, target: TargetConfig, px_per_mm: float = 8.0) -> Sheet:
    """The block's upper face with its marker."""
    return marker_sheet(target.dictionary, target.block_id, block.marker_mm, block.side_mm, px_per_mm)


def charuco_board(config: BoardConfig) -> Any:
    """OpenCV's board; its corners' coordinates are in mm from its upper left corner, y down."""
    config.validate()
    return cv2.aruco.CharucoBoard((config.columns, config.rows), config.square_mm, config.marker_mm, dictionary(config.dictionary))


def board_corners_mm(config: BoardConfig) -> Floats:
    """The inner corners (n, 3) of the board in its sheet's frame: origin in its middle, x to the right, y up, z out."""
    corners = np.array(charuco_board(config).getChessboardCorners(), dtype=float)
    middle = np.array([config.columns, config.rows]) * config.square_mm / 2
    return np.column_stack([corners[:, 0] - middle[0], middle[1] - corners[:, 1], np.zeros(len(corners))])


def charuco_sheet(config: BoardConfig, px_per_mm: float = 6.0, margin_mm: float = 0.0) -> Sheet:
    """The board, with a white margin around it."""
    square = round(config.square_mm * px_per_mm)
    margin = round(margin_mm * px_per_mm)
    size = (config.columns * square + 2 * margin, config.rows * square + 2 * margin)
    pixels = np.asarray(charuco_board(config).generateImage(size, marginSize=margin, borderBits=1), dtype=np.uint8)
    scale = config.square_mm / square
    return Sheet(pixels, size[0] * scale, size[1] * scale)


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

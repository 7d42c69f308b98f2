import re

import numpy as np
import pytest
from PIL import Image

from marl_handover.config import BlockConfig
from marl_handover.errors import InvalidSetting
from marl_handover.perception.calibration import BoardFinder
from marl_handover.perception.detector import MarkerFinder
from marl_handover.perception.printables import PX_PER_MM, TABLE_MARKERS, write_sheets
from marl_handover.perception.settings import BoardConfig


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheets")
    write_sheets(folder, BlockConfig())
    return folder


def pixels(folder, name):
    with Image.open(folder / f"{name}.png") as image:
        return np.asarray(image.convert("L"))


def test_every_pdf_is_one_page_of_its_paper_in_true_size(folder):
    pages = sorted(folder.glob("*.pdf"))
    assert [page.stem for page in pages] == ["block", "board", "goal", "table"]
    for page in pages:
        boxes = re.findall(rb"/MediaBox\s*\[\s*([\d.\s]+)\]", page.read_bytes())
        assert len(boxes) == 1
        size_mm = np.array(boxes[0].split(), float)[2:] * 25.4 / 72
        np.testing.assert_allclose(size_mm, (297, 210), atol=0.05)


def test_pngs_say_their_resolution(folder):
    with Image.open(folder / "board.png") as image:
        np.testing.assert_allclose(image.info["dpi"], PX_PER_MM * 25.4, atol=0.1)


def test_the_printed_board_has_squares_of_the_size_it_says(folder):
    view = BoardFinder(BoardConfig()).find(pixels(folder, "board"))
    design = np.column_stack([view.board_mm[:, 0], -view.board_mm[:, 1]]) * PX_PER_MM
    offset = view.pixels - design
    np.testing.assert_allclose(offset, offset.mean(axis=0) + np.zeros_like(offset), atol=1.0)


def test_the_ruler_at_the_foot_is_100_mm_long(folder):
    page = pixels(folder, "board")
    dark = np.flatnonzero(page[page.shape[0] - 6 * PX_PER_MM] == 0)
    pieces = np.split(dark, np.flatnonzero(np.diff(dark) > 1) + 1)
    assert max(len(piece) for piece in pieces) == pytest.approx(100 * PX_PER_MM, abs=3)


def test_the_other_sheets_carry_their_markers_in_true_size(folder):
    for name, numbers, edge_mm in (("block", (0,), 30), ("goal", (1,), 30), ("table", TABLE_MARKERS, 50)):
        small = pixels(folder, name)[::4, ::4]
        found = MarkerFinder("36h11", edge_mm * PX_PER_MM / 4, 3).find(np.ascontiguousarray(small), numbers)
        assert sorted(found) == sorted(numbers)
        for corners in found.values():
            edges = np.linalg.norm(np.roll(corners.pixels, 1, axis=0) - corners.pixels, axis=1)
            np.testing.assert_allclose(edges * 4 / PX_PER_MM, edge_mm, atol=0.4)


def test_a_board_too_large_for_the_paper_is_refused(tmp_path):
    with pytest.raises(InvalidSetting, match="paper.*calibration board needs 360 x 240 mm"):
        write_sheets(tmp_path, BlockConfig(), board=BoardConfig(square_mm=40, marker_mm=30))

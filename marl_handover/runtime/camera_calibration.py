"""``calibrate what=camera``: the lens from a board that is held up, the camera's place from the same board on the table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from marl_handover.hardware.clock import Clock
from marl_handover.perception.calibration import CameraCalibration, Pixels
from marl_handover.perception.camera import Camera
from marl_handover.perception.intrinsics import calibrate_lens
from marl_handover.perception.plane import BoardOnTable, locate_by_board
from marl_handover.perception.settings import BoardConfig
from marl_handover.perception.sheets import Sheet, charuco_sheet

PLACES = ((0.0, 0.0, 0.0), (-90.0, 20.0, math.pi / 2), (90.0, -20.0, -math.pi / 2))
"""Where the board is laid, x_mm, y_mm, yaw_rad of its middle: between them they cover the shared part of the table."""

VIEWS = 20
_MARGIN_MM = 10.0
_NEW_PICTURE_S = 0.1


class Assistant(Protocol):
    """Somebody with hands: the twin, or a person who is told what to do."""

    def hold_board(self, sheet: Sheet, number: int, count: int) -> None:
        """Hold the board before the camera, slanted, every time elsewhere."""

    def lay_board(self, sheet: Sheet, place: Sequence[float]) -> None:
        """Lay it flat on the table at ``place`` (3,): x_mm, y_mm, yaw_rad."""

    def take_board_away(self) -> None:
        """Clear the table."""

    def glue_cards(self) -> None:
        """Fix the marker cards on the hands."""

    def take_cards_off(self) -> None:
        """Take them off again."""

    def stand_block(self, place: Sequence[float]) -> None:
        """Stand the block at ``place`` (3,): x_mm, y_mm, theta_rad."""


def calibrate_camera(
    camera: Camera, clock: Clock, board: BoardConfig, assistant: Assistant, name: str, views: int = VIEWS
) -> CameraCalibration:
    """The calibration of ``camera`` from ``views`` pictures of the board held up, and one at each of :data:`PLACES`.

    Raises:
        CalibrationFailed: the pictures do not give one.
        StaleFrame: the camera gives no new pictures.
    """
    sheet = charuco_sheet(board, margin_mm=_MARGIN_MM)

    def picture() -> Pixels:
        clock.sleep_s(_NEW_PICTURE_S)
        return camera.read().image

    held = []
    for number in range(views):
        assistant.hold_board(sheet, number, views)
        held.append(picture())
    lens = calibrate_lens(held, board)
    laid = []
    for place in PLACES:
        assistant.lay_board(sheet, place)
        laid.append(BoardOnTable(picture(), *place))
    assistant.take_board_away()
    return locate_by_board(lens, laid, board, name)

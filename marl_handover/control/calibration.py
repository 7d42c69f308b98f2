"""``calibrate what=camera`` and ``what=grippers``: the camera's lens and place, and the pulses at which fingers hold the pin.

The lens comes from a board that is held up, the camera's place from the same board on the table.

Nobody sees from above to a tenth of a millimetre how far fingers are open, and a servo's zero that is a millimetre off eats up the whole
preload, or presses as much too hard. So each hand is told to close a little further every time, from where it cannot touch the pin, until
it carries the block; it is never closed further than it needs.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.cell import Cell
from marl_handover.cell.build import CellModel
from marl_handover.control.hardware_backend import BlockNotSeen, HardwareBackend
from marl_handover.control.servo_calibration import card_place
from marl_handover.control.settings import CardConfig
from marl_handover.errors import WorkFailed
from marl_handover.hardware.calibration import CalibrationProblem
from marl_handover.hardware.clock import Clock
from marl_handover.hardware.gripper import GripperMap
from marl_handover.hardware.settings import ARMS, GripperConfig
from marl_handover.motion.planner import MotionPlanner
from marl_handover.perception.calibration import CameraCalibration, Pixels, calibrate_lens
from marl_handover.perception.camera import Camera
from marl_handover.perception.plane import BoardOnTable, locate_by_board
from marl_handover.perception.printables import Sheet, charuco_sheet
from marl_handover.perception.settings import BoardConfig

PLACES = ((0.0, 0.0, 0.0), (-90.0, 20.0, math.pi / 2), (90.0, -20.0, -math.pi / 2))
"""Where the board is laid, x_mm, y_mm, yaw_rad of its middle: between them they cover the shared part of the table."""

VIEWS = 20
_MARGIN_MM = 10.0
_NEW_PICTURE_S = 0.1

RANGE_MM = 1.6
"""How far the settings may be off, either way, for each finger."""

STEP_MM = 0.2
SURE_MM = 0.5
"""So much further than where the block was first carried: that grip may have been a lucky one."""

_ALPHA = 0.7
"""Far apart: over a short way a hand lifts little, and fingers that are not closed drag the block along by its pin."""


class Operator(Protocol):
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


class NobodyThere(WorkFailed):
    """A question for a person, and no terminal to ask it on."""


def confirmed(question: str) -> bool:
    """Ask, and take nothing but a whole yes for one. Without a terminal: False, nobody is there."""
    if not sys.stdin.isatty():
        return False
    return input(f"{question} Type yes: ").strip().lower() == "yes"


def laid_anew() -> None:
    """Wait until somebody has laid block and goal for the next episode. Without a terminal: they stay as they are."""
    if sys.stdin.isatty():
        input("lay the block, and the goal's marker, where the next episode is to find them, hands off the table; then press Enter ")


class TerminalOperator:
    """A person at a terminal, who is told what to do and presses Enter when it is done."""

    def __init__(self, cards: CardConfig, model: CellModel, arms: Sequence[str] = ARMS) -> None:
        self._cards, self._arms, self._place_mm = cards, arms, card_place(model.arm, cards)

    def hold_board(self, sheet: Sheet, number: int, count: int) -> None:
        """See the protocol."""
        _wait(
            f"{number + 1} of {count}: hold the board before the camera, slanted by 20 to 40 degrees, every time elsewhere in the picture"
        )

    def lay_board(self, sheet: Sheet, place: Sequence[float]) -> None:
        """See the protocol."""
        _wait(
            f"lay the board flat, its middle at x = {place[0]:g} mm, y = {place[1]:g} mm, its rows turned by {math.degrees(place[2]):z.0f} "
            "degrees from +x"
        )

    def take_board_away(self) -> None:
        """See the protocol."""
        _wait("take the board away")

    def glue_cards(self) -> None:
        """See the protocol."""
        x, y, z = self._place_mm
        (first, marker), *others = zip(self._arms, self._cards.numbers(len(self._arms)), strict=True)
        where = "".join(f", {number} on the {arm} one" for arm, number in others)
        _wait(
            f"fix marker {marker} flat on the {first} hand{where}: middle {-x:g} mm "
            f"behind the grip, {y:g} mm to its left, {z:g} mm above it, its upper edge to the left"
        )

    def take_cards_off(self) -> None:
        """See the protocol."""
        _wait("take the markers off the hands")

    def stand_block(self, place: Sequence[float]) -> None:
        """See the protocol."""
        _wait(f"stand the block, its marker up, at about x = {place[0]:g} mm, y = {place[1]:g} mm, hands off the table")


def _wait(text: str) -> None:
    if not sys.stdin.isatty():
        raise NobodyThere(f"this needs a person at a terminal: {text}")
    input(f"{text}; then press Enter ")


def calibrate_camera(
    camera: Camera, clock: Clock, board: BoardConfig, operator: Operator, name: str, views: int = VIEWS
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
        operator.hold_board(sheet, number, views)
        held.append(picture())
    lens = calibrate_lens(held, board)
    laid = []
    for place in PLACES:
        operator.lay_board(sheet, place)
        laid.append(BoardOnTable(picture(), *place))
    operator.take_board_away()
    return locate_by_board(lens, laid, board, name)


def places(cell: Cell, arm: int = 0) -> tuple[tuple[float, float, float], ...]:
    """Between these, x_mm, y_mm, theta_rad, ``arm`` carries the block; the other arm of :func:`partners` reaches them, too."""
    table = cell.graph.edges[partners(cell, arm)].to_table(np.array([-_ALPHA, _ALPHA]), np.zeros(2))
    return tuple((float(x), float(y), 0.0) for x, y in table)


def partners(cell: Cell, arm: int) -> tuple[int, int]:
    """Of the pairs that share a place with ``arm`` the one with the longest way between two of its places."""

    def shorter(pair: tuple[int, int]) -> float:
        return -math.dist(*cell.graph.edges[pair].to_table(np.array([-_ALPHA, _ALPHA]), np.zeros(2)))

    return min((pair for pair in sorted(cell.graph.edges) if arm in pair), key=shorter)


class Grip(NamedTuple):
    """What came of a hand: its settings as they should be, how far they were off for each finger, and how often it tried."""

    gripper: GripperConfig
    off_mm: float
    tries: int


class GripperCalibration:
    """Calibrates the hands of a cell whose camera and servos are calibrated.

    Args:
        backend: of the cell.
        planner: of the arms' motions.
        operator: puts the block back when it has fallen.
        progress: is told of each try: the arm, how far it closed beyond the settings in mm, whether it held.
    """

    def __init__(
        self,
        backend: HardwareBackend,
        planner: MotionPlanner,
        operator: Operator,
        progress: Callable[[int, float, bool], object] = lambda arm, further_mm, held: None,
    ) -> None:
        self.backend, self.planner, self.operator, self.progress = backend, planner, operator, progress
        self._names = tuple(backend.workcell.driver.config.arms)

    def arm(self, arm: int) -> Grip:
        """Calibrate one hand; the cell goes on with what was found.

        Raises:
            CalibrationProblem: it never carried the block, or did so where it should not have touched it.
            Stopped, DeviceError, BlockNotSeen: as :meth:`HardwareBackend.execute`.
        """
        name = self._names[arm]
        wiring = self.backend.workcell.driver.config.arms[name]
        hardware = self.backend.workcell.config.hardware
        asked, pulses = hardware.arms[name].gripper, GripperMap(hardware, name, self.backend.model.arm.description.gripper)
        tries = np.arange(-RANGE_MM, RANGE_MM + STEP_MM / 2, STEP_MM)
        for number, further_mm in enumerate(tries, start=1):
            wiring.gripper = pulses.shifted(float(further_mm))
            held = self._carries(arm)
            self.progress(arm, float(further_mm), held)
            if held and number == 1:
                raise CalibrationProblem(f"the {name} gripper", self._words(asked, f"it holds the pin {RANGE_MM:g} mm too early"))
            if held:
                off_mm = float(further_mm) + SURE_MM
                wiring.gripper = pulses.shifted(off_mm)
                return Grip(wiring.gripper, off_mm, number)
        raise CalibrationProblem(f"the {name} gripper", self._words(asked, f"it does not hold the pin, {RANGE_MM:g} mm further"))

    def _words(self, asked: GripperConfig, what: str) -> str:
        return (
            f"{what} than the settings say (open_us={asked.open_us}, closed_us={asked.closed_us}, open_mm={asked.open_mm:g}): set them anew"
        )

    def _carries(self, arm: int) -> bool:
        """Whether the hand, as it is set now, takes the block to the other place."""
        pose = self._block(arm)
        place = max((np.asarray(place[:2]) for place in places(self.backend.model.cell, arm)), key=lambda place: math.dist(place, pose[:2]))
        joints = self.backend.joints_rad()
        motion = self.planner.plan_paths(arm, pose[:2], place, joints[arm], np.delete(joints, arm, axis=0))
        refusal = self.backend.execute(arm, motion.paths).refusal
        return refusal is None

    def _block(self, arm: int) -> Floats:
        """Where the block stands; where nobody sees it, or ``arm`` or its partner does not reach it, it is put back."""
        cell = self.backend.model.cell
        try:
            pose = self.backend.watch()
        except BlockNotSeen as lost:
            if not lost.camera_works:
                raise
            pose = None
        if pose is not None and bool(cell.reaches(pose[:2])[list(partners(cell, arm))].all()):
            return pose
        first = places(cell, arm)[0]
        self.operator.stand_block(first)
        return self.backend.reset(np.asarray(first), 0)

"""The twin of a cell: emulated boards and servos behind a serial port, physics that follows them, a rendered camera; one virtual clock.

What stands above it - driver, gate, detector, loop - is the code that runs the real cell, byte for byte and pixel for pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig
from marl_handover.control.servo_calibration import T_grip_hand, card_place
from marl_handover.control.settings import WorkcellConfig
from marl_handover.errors import InvalidSetting
from marl_handover.geometry.arm_model import Bools
from marl_handover.geometry.se3 import flat_pose, transform
from marl_handover.hardware.clock import VirtualClock
from marl_handover.hardware.emulator.device import EmulatedCell, Fault
from marl_handover.hardware.emulator.servo_bus import EmulatedServoCell
from marl_handover.motion.home import parked_poses
from marl_handover.perception.calibration import Pixels, hung_camera
from marl_handover.perception.camera import Frame, RenderedCamera
from marl_handover.perception.printables import Sheet, marker_sheet
from marl_handover.perception.scene import CellPainter, held_boards
from marl_handover.perception.settings import USUAL_EYE_MM, CameraConfig, MountConfig
from marl_handover.simulation.arm import SERVO_S
from marl_handover.simulation.effort import holding_n_m
from marl_handover.simulation.follower import ServoFollower, ServoState
from marl_handover.simulation.world import SimulatedCell

_BOOTED_S = 1.0
_HAND_STEP_S, _HAND_S = 0.02, 1.0
_LIFTED_MM, _LEANING_RAD = 3.0, math.radians(3.0)
_EDGE_MM = 1e4
_RIM_PX = 25
"""What is kept free around all that arms reach, since no camera hangs straight."""

_GOOD_MARKER_PX, _LEAST_MARKER_PX = 24.0, 16.0
"""Edge of a marker whose turn is seen to a degree, and of one that is found at all."""

_FINE_PX = (1920, 1080)


def camera_over(model: CellModel, config: WorkcellConfig) -> tuple[MountConfig, tuple[int, int]]:
    """How the camera of ``config`` hangs over a cell, and width and height of its pictures: as it says, else as over a pair.

    Over more arms it sees all that these reach: it hangs high enough, is turned by a right angle if the cell is longer along x, and has
    pictures of more pixels, of the same lens, where a block's marker would have few of them and nobody has said how many there are.

    Raises:
        InvalidSetting: pictures are too small for so large a table; a marker would not be found in them.
    """
    mount, size_px = config.mount, (config.camera.width_px, config.camera.height_px)
    if mount.eye_mm is not None or model.cell.num_arms <= 2:
        return mount, size_px
    marker_mm = model.cell.config.block.marker_mm
    turned_deg, mm_per_px, middle_mm = _framed(model, size_px)
    if marker_mm / mm_per_px < _GOOD_MARKER_PX and size_px == (CameraConfig.width_px, CameraConfig.height_px):
        mount = replace(mount, focal_px=mount.focal_px * _FINE_PX[0] / size_px[0])
        size_px = _FINE_PX
        turned_deg, mm_per_px, middle_mm = _framed(model, size_px)
    if marker_mm / mm_per_px < _LEAST_MARKER_PX:
        larger = math.ceil(size_px[1] * _LEAST_MARKER_PX * mm_per_px / marker_mm)
        limit = f"at least {larger}, width_px as much larger, to see all of the cell"
        raise InvalidSetting("camera.height_px", size_px[1], limit)
    x, y, z = USUAL_EYE_MM
    above = math.ceil((mount.focal_px * mm_per_px + model.cell.config.block.height_mm) / 10) * 10
    eye = [float(middle_mm[0]) + x, float(middle_mm[1]) + y, above + z % 10]
    return replace(mount, eye_mm=eye, turn_deg=mount.turn_deg + turned_deg), size_px


def _framed(model: CellModel, size_px: tuple[int, int]) -> tuple[float, float, Floats]:
    """By how much a camera is best turned, in degrees, to see all that arms reach; mm a pixel is then; and its middle (2,) in mm."""
    reached: Bools = np.any(model.grid.masks, axis=0)
    x_mm, y_mm = model.grid.x_mm[reached.any(axis=1)], model.grid.y_mm[reached.any(axis=0)]
    sides, room_px = np.array([np.ptp(y_mm), np.ptp(x_mm)]), np.array(size_px) - 2 * _RIM_PX
    ways = {0.0: float(max(sides / room_px)), 90.0: float(max(sides[::-1] / room_px))}  # world x is up in the picture, or to its right
    turned_deg = min(ways, key=lambda way: ways[way])
    return turned_deg, ways[turned_deg], np.array([x_mm.min() + x_mm.max(), y_mm.min() + y_mm.max()]) / 2


class Twin:
    """A cell that exists only here.

    Args:
        model: the cell.
        motion: the parked pose, in which the arms stand at first.
        config: servos, camera, people.
    """

    def __init__(self, model: CellModel, motion: MotionConfig, config: WorkcellConfig) -> None:
        self.model, self.motion, self.config = model, motion, config
        self._random = np.random.default_rng(config.twin.seed)
        self.clock = VirtualClock()
        self._parked = parked_poses(model, motion)[0]
        wired = config.hardware.for_arms(model.cell.names)
        self.electronics: EmulatedCell | EmulatedServoCell
        if wired.protocol == "ssc32":
            self.electronics = EmulatedCell(wired, model.arm, self._parked, motion.finger_travel_mm)
        else:
            weight = partial(holding_n_m, model.arm)
            self.electronics = EmulatedServoCell(wired, model.arm, self._parked, motion.finger_travel_mm, weight)
        ports = self.electronics.mount(self.clock)
        self.hardware = replace(
            wired,
            boards={name: replace(board, port=ports.get(name, board.port), scan=False) for name, board in wired.boards.items()},
        )
        """The electronics' settings, of the cell's arms alone, their ports those of the emulated boards."""
        self.cell = SimulatedCell(model, motion, engine=config.twin.engine)
        self.follower = ServoFollower(self.cell, self._servos)
        self.painter = self._painter(config.twin.seed)
        self.camera = RenderedCamera(self._picture, config.camera.max_age_s, self.clock.now_s)
        self.goal: Floats | None = None
        """Where a printed goal lies (3,); None: there is none."""
        self.hidden_until_s = self.frozen_until_s = -1.0
        """Until when a hand covers the block, and until when the camera gives its last picture again."""
        self._sheets: list[tuple[Sheet, Floats]] = []
        self._cards: list[tuple[Sheet, Floats]] = []
        self._last: Pixels | None = None
        self._onlooker: CellPainter | None = None
        self._number = 0
        self.clock.at(SERVO_S, self._tick)
        self.clock.until(_BOOTED_S)

    def close(self) -> None:
        """Let the physics go; again is fine."""
        self.cell.close()

    def true_pose(self) -> Floats:
        """Where the block is (3,): x_mm, y_mm, theta_rad."""
        return self.cell.object_pose()

    def true_joints_rad(self) -> Floats:
        """Where the joints are (num_arms, 5)."""
        return self.cell.joints_rad()

    def set_object_pose(self, pose: ArrayLike) -> None:
        """Somebody puts the block at ``pose`` (3,), standing."""
        self.cell.block.place(np.asarray(pose, float))
        self.follower.disturbed()

    def watched(self) -> Pixels:
        """What the camera shows now, BGR, for who only watches: with noise of its own, so that the session's pictures stay as they are."""
        now_s = self.clock.now_s()
        if self._last is not None and now_s < self.frozen_until_s:
            return self._last
        self._onlooker = self._onlooker or self._painter(self.config.twin.seed + 1)
        return self._painted(now_s, self._onlooker)

    def hide(self, duration_s: float) -> None:
        """Somebody holds a hand over the block."""
        self.hidden_until_s = self.clock.now_s() + duration_s

    def freeze(self, duration_s: float) -> None:
        """The camera gives its last picture again and again."""
        self.frozen_until_s = self.clock.now_s() + duration_s

    def add_faults(self, faults: Sequence[Fault], board: str | None = None) -> None:
        """Faults of the electronics, on one ``board`` or on every one; times are the clock's."""
        for name, device in self.electronics.devices.items():
            if board in (None, name):
                device.add_faults(faults)

    def confirm(self, question: str) -> bool:
        """The twin's operator: does what is asked, and says so.

        Whoever is asked whether the arms stand parked puts those there that are limp: opens the hand, sets the block down, turns the joints
        by hand. For arms that are held there is nothing to do.
        """
        now_s = self.clock.now_s()
        limp = self.electronics.limp_arms(now_s)
        if limp and np.abs(self.electronics.joints_rad(now_s)[limp] - self._parked).max() > math.radians(2.0):
            self._tidy_up(limp)
        return True

    def hold_board(self, sheet: Sheet, number: int, count: int) -> None:
        """Somebody holds the calibration board before the camera, for the ``number``-th of ``count`` times."""
        poses = held_boards(self.painter.renderer.calibration, count, self.config.twin.seed)
        self._sheets = [(sheet, poses[number])]

    def lay_board(self, sheet: Sheet, place: Sequence[float]) -> None:
        """Somebody lays the board onto its marks at ``place`` (3,): x_mm, y_mm, yaw_rad; as exactly as people do."""
        people = self.config.twin
        off = self._random.normal(size=3) * (people.board_sd_mm, people.board_sd_mm, math.radians(people.board_sd_deg))
        self._sheets = [(sheet, flat_pose(*(np.asarray(place) + off)))]

    def take_board_away(self) -> None:
        """The table is free."""
        self._sheets = []

    def glue_cards(self) -> None:
        """Somebody glues the marker cards onto the hands, as exactly as people do."""
        cards, people = self.config.hand_markers, self.config.twin
        self._cards = []
        for number in cards.numbers(self.model.cell.num_arms):
            off = self._random.normal(size=3) * (people.card_sd_mm, people.card_sd_mm, math.radians(people.card_sd_deg))
            place = card_place(self.model.arm, cards) + (off[0], off[1], 0.0)
            sheet = marker_sheet(self.config.target.dictionary, number, cards.marker_mm, cards.marker_mm * 4 / 3)
            self._cards.append((sheet, T_grip_hand(self.model.arm) @ transform(tuple(place), (0.0, 0.0, float(off[2])))))

    def take_cards_off(self) -> None:
        """The hands are free."""
        self._cards = []

    def stand_block(self, place: Sequence[float]) -> None:
        """Somebody stands the block at ``place`` (3,): x_mm, y_mm, theta_rad."""
        self.set_object_pose(place)

    def _servos(self, t_s: float) -> ServoState:
        return ServoState(self.electronics.joints_rad(t_s), self.electronics.gripper_mm(t_s))

    def _tick(self) -> None:
        now_s = self.clock.now_s()
        self.follower.advance(now_s)
        self.clock.at(now_s + SERVO_S, self._tick)

    def _picture(self) -> Frame:
        now_s = self.clock.now_s()
        self._number += 1
        if self._last is None or now_s >= self.frozen_until_s:
            self._last = self._painted(now_s, self.painter)
        return Frame(self._last, now_s, self._number)

    def _painter(self, seed: int) -> CellPainter:
        truth = hung_camera(*camera_over(self.model, self.config))
        return CellPainter(self.model, truth, self.config.target, self.config.look, seed)

    def _painted(self, now_s: float, painter: CellPainter) -> Pixels:
        joints = self.true_joints_rad()
        fingers = [arm.gripper_mm() for arm in self.cell.arms]
        sheets = list(self._sheets)
        for base, q, (card, T_grip_card) in zip(self.model.cell.bases, joints, self._cards, strict=False):
            sheets.append((card, base.matrix() @ self.model.arm.fk(q) @ T_grip_card))
        block = None if now_s < self.hidden_until_s or self._sheets else self.cell.block.transform()
        return painter.picture(block, joints, self.goal, fingers, sheets)

    def _tidy_up(self, arms: Sequence[int]) -> None:
        """Open the hands, set the block down, turn ``arms`` to the parked pose: raised first, then the rest."""
        for arm in arms:
            self.electronics.put_hand(arm, self.motion.finger_travel_mm, self.clock.now_s())
        self.clock.sleep_s(_HAND_S)
        pose = self.true_pose()
        if self.cell.block.height_mm() > _LIFTED_MM or self.cell.tilt_rad() > _LEANING_RAD or not self.model.cell.reaches(pose[:2]).any():
            self.set_object_pose(self.model.cell.clamp_to_workspace(pose, _EDGE_MM))
        start = self.electronics.joints_rad(self.clock.now_s())
        raised = start.copy()
        raised[:, 1] = self._parked[1]
        for begin, end in ((start, raised), (raised, np.tile(self._parked, (len(start), 1)))):
            for share in np.arange(_HAND_STEP_S, _HAND_S + 1e-9, _HAND_STEP_S) / _HAND_S:
                for arm in arms:
                    self.electronics.put(arm, begin[arm] + share * (end[arm] - begin[arm]), self.clock.now_s())
                self.clock.sleep_s(_HAND_STEP_S)

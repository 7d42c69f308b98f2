"""``calibrate what=grippers``: at which pulse the fingers hold the pin, found by carrying the block with them.

Nobody sees from above to a tenth of a millimetre how far fingers are open, and a servo's zero that is a millimetre off eats up the whole
preload, or presses as much too hard. So each hand is told to close a little further every time, from where it cannot touch the pin, until
it carries the block; it is never closed further than it needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell import Cell
from marl_handover.hardware.calibration import CalibrationProblem
from marl_handover.hardware.settings import ARMS, GripperConfig
from marl_handover.motion.planner import MotionPlanner
from marl_handover.runtime.camera_calibration import Assistant
from marl_handover.runtime.gripper_file import shifted
from marl_handover.runtime.hardware_backend import BlockNotSeen, HardwareBackend

Floats = NDArray[np.float64]

RANGE_MM = 1.6
"""How far the settings may be off, either way, for each finger."""

STEP_MM = 0.2
SURE_MM = 0.5
"""So much further than where the block was first carried: that grip may have been a lucky one."""

_ALPHA = 0.7
"""Far apart: over a short way a hand lifts little, and fingers that are not closed drag the block along by its pin."""


def places(cell: Cell) -> tuple[tuple[float, float, float], ...]:
    """Between these, x_mm, y_mm, theta_rad, the block is carried; both arms of ``cell`` reach them."""
    return tuple((float(x), float(y), 0.0) for x, y in cell.chart.to_table(np.array([-_ALPHA, _ALPHA]), np.zeros(2)))


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
        assistant: puts the block back when it has fallen.
        progress: is told of each try: the arm, how far it closed beyond the settings in mm, whether it held.
    """

    def __init__(
        self,
        backend: HardwareBackend,
        planner: MotionPlanner,
        assistant: Assistant,
        progress: Callable[[int, float, bool], object] = lambda arm, further_mm, held: None,
    ) -> None:
        self.backend, self.planner, self.assistant, self.progress = backend, planner, assistant, progress
        self.places = places(backend.model.cell)

    def arm(self, arm: int) -> Grip:
        """Calibrate one hand; the cell goes on with what was found.

        Raises:
            CalibrationProblem: it never carried the block, or did so where it should not have touched it.
            Stopped, DeviceError, BlockNotSeen: as :meth:`HardwareBackend.execute`.
        """
        wiring = self.backend.lab.driver.config.arms[ARMS[arm]]
        asked = self.backend.lab.config.hardware.arms[ARMS[arm]].gripper
        tries = np.arange(-RANGE_MM, RANGE_MM + STEP_MM / 2, STEP_MM)
        for number, further_mm in enumerate(tries, start=1):
            wiring.gripper = shifted(asked, float(further_mm))
            held = self._carries(arm)
            self.progress(arm, float(further_mm), held)
            if held and number == 1:
                raise CalibrationProblem(f"the {ARMS[arm]} gripper", self._words(asked, f"it holds the pin {RANGE_MM:g} mm too early"))
            if held:
                off_mm = float(further_mm) + SURE_MM
                wiring.gripper = shifted(asked, off_mm)
                return Grip(wiring.gripper, off_mm, number)
        raise CalibrationProblem(f"the {ARMS[arm]} gripper", self._words(asked, f"it does not hold the pin, {RANGE_MM:g} mm further"))

    def _words(self, asked: GripperConfig, what: str) -> str:
        return (
            f"{what} than the settings say (open_us={asked.open_us}, closed_us={asked.closed_us}, open_mm={asked.open_mm:g}): set them anew"
        )

    def _carries(self, arm: int) -> bool:
        """Whether the hand, as it is set now, takes the block to the other place."""
        pose = self._block()
        place = max((np.asarray(place[:2]) for place in self.places), key=lambda place: math.dist(place, pose[:2]))
        joints = self.backend.joints_rad()
        motion = self.planner.plan_paths(arm, pose[:2], place, joints[arm], np.delete(joints, arm, axis=0))
        refusal = self.backend.execute(arm, motion.paths).refusal
        return refusal is None

    def _block(self) -> Floats:
        """Where the block stands; where nobody sees it, or an arm does not reach it, it is put back."""
        try:
            pose = self.backend.watch()
        except BlockNotSeen as lost:
            if not lost.camera_works:
                raise
            pose = None
        if pose is not None and bool(self.backend.model.cell.reaches(pose[:2]).all()):
            return pose
        self.assistant.stand_block(self.places[0])
        return self.backend.reset(np.asarray(self.places[0]), 0)

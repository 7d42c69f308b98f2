"""The play of hobby servos, and how to take it out.

A servo rests half its dead band short of where it is sent, on the side it came from: 4 us, or 0.4 degrees, that put a hand 2 mm off. It
is play, and play has an exact inverse: aim half the band further in the direction of motion, and let the aim jump by the whole band when
the direction turns. The width of each servo's band is found by :mod:`~marl_handover.runtime.servo_calibration`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.config import require_between
from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import ArmCalibration
from marl_handover.hardware.settings import ARMS
from marl_handover.motion.trajectory import Phase
from marl_handover.parsing import read_json

Floats = NDArray[np.float64]

VERSION = 2
FILE = "play.json"
AGAIN = "run: marl-handover calibrate what=servos hardware=NAME, with the name you run"
MOST_US = 20.0
_STILL_RAD = 1e-6


class Play:
    """Takes the play out of the motions of all arms, remembering which way each joint came last.

    Args:
        half_band_rad: (num_arms, 5) half the dead band of each joint's servo.
        lower_rad: (5,) lower limits that the aims keep to.
        upper_rad: (5,) upper ones.
    """

    def __init__(self, half_band_rad: Floats, lower_rad: Floats, upper_rad: Floats) -> None:
        self._half, self._lower, self._upper = half_band_rad, lower_rad, upper_rad
        self.lead_rad = np.zeros_like(half_band_rad)
        """(num_arms, 5): how far beyond where it is wanted each joint was aimed last."""

    def reset(self) -> None:
        """The arms were moved by something else: nobody knows on which side of its band a servo rests."""
        self.lead_rad[:] = 0.0

    def led(self, arm: int, phases: Sequence[Phase]) -> tuple[Phase, ...]:
        """``phases`` of ``arm`` as they have to be aimed; each begins with the last sample of the one before, as it was."""
        joined = np.concatenate([phase.joints_rad for phase in phases])
        aims = np.clip(joined + self._leads(arm, joined), self._lower, self._upper)
        ends = np.cumsum([len(phase.t_s) for phase in phases])[:-1]
        return tuple(replace(phase, joints_rad=part) for phase, part in zip(phases, np.split(aims, ends), strict=True))

    def done(self, arm: int, wanted_rad: Floats, aimed_rad: Floats) -> None:
        """The arm stands where it was aimed, which is where it was wanted."""
        self.lead_rad[arm] = aimed_rad - wanted_rad

    def _leads(self, arm: int, joints_rad: Floats) -> Floats:
        """(n, 5): half a band in the direction of the last motion up to each sample."""
        steps = np.diff(joints_rad, axis=0)
        way = np.zeros_like(joints_rad)
        way[0] = np.sign(self.lead_rad[arm])
        for index, step in enumerate(steps):
            way[index + 1] = np.where(np.abs(step) > _STILL_RAD, np.sign(step), way[index])
        return way * self._half[arm]


def half_bands_rad(half_us: Mapping[str, ArrayLike], calibrations: Sequence[ArmCalibration]) -> Floats:
    """(num_arms, 5) in rad of half dead bands (5,) given in us, arm by arm."""
    scales = np.array([[servo.us_per_rad() for servo in calibration.maps] for calibration in calibrations])
    return np.array([half_us[arm] for arm in ARMS], float) / scales


def play_text(half_us: Mapping[str, ArrayLike], sd_us: Mapping[str, ArrayLike]) -> str:
    """What the file holds: half the dead bands (5,) in us of each arm's servos, and their standard deviations (5,)."""

    def listed(values: Mapping[str, ArrayLike]) -> dict[str, dict[str, float]]:
        rows = {arm: np.round(np.asarray(values[arm], float), 3).tolist() for arm in ARMS}
        return {arm: dict(zip(ARM_JOINTS, row, strict=True)) for arm, row in rows.items()}

    content = {"version": VERSION, "half_band_us": listed(half_us), "half_band_sd_us": listed(sd_us)}
    return json.dumps(content, indent=1) + "\n"


def load_play(folder: Path) -> dict[str, Floats]:
    """Half the dead bands (5,) in us, by arm. Raises :class:`MissingFile`, :class:`CorruptFile` or :class:`InvalidSetting`."""
    path = folder / FILE
    if not path.is_file():
        raise MissingFile("play of the servos", path, AGAIN)
    try:
        content = read_json(path, "play of the servos")
        if content["version"] != VERSION:
            why = f"it has version {content['version']!r}, this program reads {VERSION}, a band for each joint"
            raise CorruptFile("play of the servos", path, f"{why}; {AGAIN}")
        found = {arm: np.array([float(content["half_band_us"][arm][joint]) for joint in ARM_JOINTS]) for arm in ARMS}
        for arm, values in found.items():
            for joint, value in zip(ARM_JOINTS, values, strict=True):
                require_between(f"half_band_us.{arm}.{joint}", float(value), 0.0, MOST_US)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CorruptFile("play of the servos", path, f"{type(error).__name__}: {error}") from error
    return found

"""Settings of cameras, printed sheets, the detector, the tracker and the rendered picture, each default once."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from marl_handover.config import require_at_least, require_between, require_choice, require_positive
from marl_handover.errors import InvalidSetting

SOURCES = ("uvc", "realsense", "video", "folder", "rendered")
OBJECTS = ("marker", "square")
MARKERS = {"4x4_50": 50, "5x5_100": 100, "6x6_250": 250, "16h5": 30, "25h9": 35, "36h11": 587}
"""How many markers each dictionary has."""

DICTIONARIES = tuple(MARKERS)


@dataclass
class CameraConfig:
    """Where pictures come from."""

    source: str = "uvc"
    path: str = ""  # uvc: /dev/v4l/by-id/..., realsense: serial number or empty, video: file, folder: folder of pictures
    width_px: int = 1280
    height_px: int = 720
    frames_per_s: float = 30.0
    fourcc: str = "YUYV"  # uvc: pixel format asked for; compressed ones blur marker edges
    warm_up_s: float = 1.0  # pictures thrown away until exposure and white balance have settled
    max_age_s: float = 0.2  # an older picture is refused
    timeout_s: float = 2.0  # wait this long for a first, or a new, picture

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        require_choice("camera.source", self.source, SOURCES)
        require_between("camera.width_px", self.width_px, 160, 8192)
        require_between("camera.height_px", self.height_px, 120, 8192)
        require_positive("camera.frames_per_s", self.frames_per_s)
        require_at_least("camera.warm_up_s", self.warm_up_s, 0)
        require_positive("camera.max_age_s", self.max_age_s)
        require_positive("camera.timeout_s", self.timeout_s)
        if len(self.fourcc) != 4:
            raise InvalidSetting("camera.fourcc", self.fourcc, "four letters, such as YUYV or MJPG")
        if self.source in ("uvc", "video", "folder") and not self.path:
            raise InvalidSetting("camera.path", self.path, f"named for camera.source={self.source}")


@dataclass
class BoardConfig:
    """The ChArUco board for calibration; the default fits A4 paper, landscape."""

    columns: int = 9
    rows: int = 6
    square_mm: float = 30.0
    marker_mm: float = 22.5  # six cells of 3.75 mm: whole pixels on the print
    dictionary: str = "4x4_50"  # another than the block's, so that no marker of the board is taken for the block

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        require_choice("board.dictionary", self.dictionary, DICTIONARIES)
        require_between("board.columns", self.columns, 3, 20)
        require_between("board.rows", self.rows, 3, 20)
        require_positive("board.square_mm", self.square_mm)
        require_between("board.marker_mm", self.marker_mm, 0.4 * self.square_mm, 0.9 * self.square_mm)


@dataclass
class TargetConfig:
    """What is looked for: the block, and a printed goal. The size of the block's marker is ``cell.block.marker_mm``."""

    object: str = "marker"  # marker, or square: a block without marker whose top has one colour
    dictionary: str = "36h11"
    block_id: int = 0
    goal_id: int = 1
    block_offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])  # marker's x_mm, y_mm, yaw_deg on the block, if glued askew
    goal_mm: float = 30.0  # edge of the goal's marker, black to black
    goal_height_mm: float = 0.0  # 0: printed on paper on the table
    colour_hue_deg: float = 0.0  # square: hue of its top, 0 red, 120 green, 240 blue
    colour_width_deg: float = 25.0  # square: hues this far from it belong to it

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        require_choice("target.object", self.object, OBJECTS)
        require_choice("target.dictionary", self.dictionary, DICTIONARIES)
        require_between("target.block_id", self.block_id, 0, MARKERS[self.dictionary] - 1)
        require_between("target.goal_id", self.goal_id, 0, MARKERS[self.dictionary] - 1)
        if self.block_id == self.goal_id:
            raise InvalidSetting("target.goal_id", self.goal_id, "another marker than target.block_id")
        require_positive("target.goal_mm", self.goal_mm)
        require_between("target.goal_height_mm", self.goal_height_mm, 0, 200)
        require_between("target.colour_hue_deg", self.colour_hue_deg, 0, 360)
        require_between("target.colour_width_deg", self.colour_width_deg, 5, 90)
        if len(self.block_offset) != 3 or not all(math.isfinite(value) for value in self.block_offset):
            raise InvalidSetting("target.block_offset", self.block_offset, "three finite numbers: x_mm, y_mm, yaw_deg")


@dataclass
class DetectorConfig:
    """How markers are found."""

    opening_px: int = 0  # kernel of the grey opening that takes the pin out of a picture; 0: from the sizes of pin, marker and picture
    window_mm: float = 40.0  # tracking: look this far around the block's last place first
    least_confidence: float = 0.3  # a sighting with less is none

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        require_between("detector.opening_px", self.opening_px, 0, 99)
        require_between("detector.window_mm", self.window_mm, 10, 500)
        require_between("detector.least_confidence", self.least_confidence, 0, 1)


@dataclass
class TrackerConfig:
    """Which sightings are believed."""

    jump_mm: float = 15.0  # a sighting farther than this, or ...
    jump_deg: float = 20.0  # ... turned by more than this, is believed once it has been confirmed
    speed_mm_s: float = 300.0  # what a carried block may do on top of that since it was last seen
    turn_deg_s: float = 180.0
    confirmations: int = 3  # sightings in a row that agree with each other, the first included
    agreement_mm: float = 3.0
    agreement_deg: float = 5.0
    hidden_s: float = 0.5  # not seen for this long: hidden
    search_every: int = 10  # a goal that is not where it was is looked for in the whole of every so manieth picture
    frozen_frames: int = 4  # as many pictures in a row, alike to the last bit: a frozen camera; 0: never, for pictures without noise

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        for name in ("jump_mm", "jump_deg", "agreement_mm", "agreement_deg", "hidden_s"):
            require_positive(f"tracker.{name}", getattr(self, name))
        require_at_least("tracker.speed_mm_s", self.speed_mm_s, 0)
        require_at_least("tracker.turn_deg_s", self.turn_deg_s, 0)
        require_between("tracker.confirmations", self.confirmations, 1, 20)
        require_at_least("tracker.search_every", self.search_every, 1)
        require_between("tracker.frozen_frames", self.frozen_frames, 0, 1000)


@dataclass
class MountConfig:
    """How a rendered camera truly hangs: 700 mm above the table, as centred and as straight as a mechanic gets it."""

    eye_mm: list[float] = field(default_factory=lambda: [3.0, -4.0, 702.0])
    tilt_deg: list[float] = field(default_factory=lambda: [0.3, -0.2])  # about its own x and y axis
    turn_deg: float = 0.4  # about its line of sight; 0: world x is up in the picture, world y points left
    focal_px: float = 917.0

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        for name, count in (("eye_mm", 3), ("tilt_deg", 2)):
            values = getattr(self, name)
            if len(values) != count or not all(math.isfinite(value) for value in values):
                raise InvalidSetting(f"mount.{name}", values, f"{count} finite numbers")
        require_between("mount.eye_mm[2]", self.eye_mm[2], 100, 5000)
        require_between("mount.turn_deg", self.turn_deg, -180, 180)
        require_positive("mount.focal_px", self.focal_px)


@dataclass
class LookConfig:
    """What a rendered picture suffers from."""

    blur_px: float = 0.8  # standard deviation of the lens's blur
    noise: float = 3.0  # standard deviation, of 255
    gradient: float = 0.25  # loss of light from the brightest corner to the opposite one
    light: float = 1.0  # brightness of it all

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        require_between("look.blur_px", self.blur_px, 0, 10)
        require_between("look.noise", self.noise, 0, 50)
        require_between("look.gradient", self.gradient, 0, 0.9)
        require_between("look.light", self.light, 0.05, 2)

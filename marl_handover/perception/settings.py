"""Settings of cameras, printed sheets, the detector, the tracker and the rendered picture, each default once."""

from __future__ import annotations

from dataclasses import dataclass

from marl_handover.config import bounded, check_bounds, chosen, path_field, require_between
from marl_handover.errors import InvalidSetting

SOURCES = ("uvc", "realsense", "video", "folder", "rendered")
OBJECTS = ("marker", "square")
MARKERS = {"4x4_50": 50, "5x5_100": 100, "6x6_250": 250, "16h5": 30, "25h9": 35, "36h11": 587}
"""How many markers each dictionary has."""

DICTIONARIES = tuple(MARKERS)


@dataclass
class CameraConfig:
    """Where pictures come from."""

    source: str = chosen("uvc", SOURCES)
    path: str = path_field()  # uvc: /dev/v4l/by-id/..., realsense: serial number or empty, video: file, folder: folder of pictures
    width_px: int = bounded(1280, 160, 8192)
    height_px: int = bounded(720, 120, 8192)
    frames_per_s: float = bounded(30.0, 0.1, 1000.0)
    fourcc: str = "YUYV"  # uvc: pixel format asked for; compressed ones blur marker edges
    warm_up_s: float = bounded(1.0, 0.0, 60.0)  # pictures thrown away until exposure and white balance have settled
    max_age_s: float = bounded(0.2, 0.001, 60.0)  # an older picture is refused
    timeout_s: float = bounded(2.0, 0.01, 600.0)  # wait this long for a first, or a new, picture

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "camera.")
        if len(self.fourcc) != 4:
            raise InvalidSetting("camera.fourcc", self.fourcc, "four letters, such as YUYV or MJPG")
        if self.source in ("uvc", "video", "folder") and not self.path:
            raise InvalidSetting("camera.path", self.path, f"named for camera.source={self.source}")


@dataclass
class BoardConfig:
    """The ChArUco board for calibration; the default fits A4 paper, landscape."""

    columns: int = bounded(9, 3, 20)
    rows: int = bounded(6, 3, 20)
    square_mm: float = bounded(30.0, 5.0, 200.0)
    marker_mm: float = bounded(22.5, 2.0, 180.0)  # six cells of 3.75 mm: whole pixels on the print
    dictionary: str = chosen("4x4_50", DICTIONARIES)  # another than the block's, so that no marker of the board is taken for the block

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "board.")
        require_between("board.marker_mm", self.marker_mm, 0.4 * self.square_mm, 0.9 * self.square_mm)


@dataclass
class TargetConfig:
    """What is looked for: the block, and a printed goal. The size of the block's marker is ``cell.block.marker_mm``."""

    object: str = chosen("marker", OBJECTS)  # marker, or square: a block without marker whose top has one colour
    dictionary: str = chosen("36h11", DICTIONARIES)
    block_id: int = bounded(0, 0, 10_000)
    goal_id: int = bounded(1, 0, 10_000)
    block_offset: list[float] = bounded([0.0, 0.0, 0.0], -360.0, 360.0, (3, 3))  # marker's x_mm, y_mm, yaw_deg on the block
    goal_mm: float = bounded(30.0, 4.0, 200.0)  # edge of the goal's marker, black to black
    goal_height_mm: float = bounded(0.0, 0.0, 200.0)  # 0: printed on paper on the table
    colour_hue_deg: float = bounded(0.0, 0.0, 360.0)  # square: hue of its top, 0 red, 120 green, 240 blue
    colour_width_deg: float = bounded(25.0, 5.0, 90.0)  # square: hues this far from it belong to it

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "target.")
        require_between("target.block_id", self.block_id, 0, MARKERS[self.dictionary] - 1)
        require_between("target.goal_id", self.goal_id, 0, MARKERS[self.dictionary] - 1)
        if self.block_id == self.goal_id:
            raise InvalidSetting("target.goal_id", self.goal_id, "another marker than target.block_id")


@dataclass
class DetectorConfig:
    """How markers are found."""

    opening_px: int = bounded(0, 0, 99)  # kernel of the grey opening that takes the pin out of a picture; 0: from pin, marker and picture
    window_mm: float = bounded(40.0, 10.0, 500.0)  # tracking: look this far around the block's last place first
    least_confidence: float = bounded(0.3, 0.0, 1.0)  # a sighting with less is none

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "detector.")


@dataclass
class TrackerConfig:
    """Which sightings are believed."""

    jump_mm: float = bounded(15.0, 0.01, 1000.0)  # a sighting farther than this, or ...
    jump_deg: float = bounded(20.0, 0.01, 360.0)  # ... turned by more than this, is believed once it has been confirmed
    speed_mm_s: float = bounded(300.0, 0.0, 1e5)  # what a carried block may do on top of that since it was last seen
    turn_deg_s: float = bounded(180.0, 0.0, 1e5)
    confirmations: int = bounded(3, 1, 20)  # sightings in a row that agree with each other, the first included
    agreement_mm: float = bounded(3.0, 0.01, 1000.0)
    agreement_deg: float = bounded(5.0, 0.01, 360.0)
    hidden_s: float = bounded(0.5, 0.001, 600.0)  # not seen for this long: hidden
    search_every: int = bounded(10, 1, 10_000)  # a goal that is not where it was is looked for in the whole of every so manieth picture
    frozen_frames: int = bounded(4, 0, 1000)  # so many equal pictures in a row: a frozen camera; 0: never, for pictures without noise

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "tracker.")


USUAL_EYE_MM = (3.0, -4.0, 702.0)


@dataclass
class MountConfig:
    """How a rendered camera truly hangs: 700 mm above the table, as centred and as straight as a mechanic gets it."""

    eye_mm: list[float] | None = bounded(None, -5000.0, 5000.0, (3, 3))  # null: [3, -4, 702]; over more than two arms as high as it takes
    tilt_deg: list[float] = bounded([0.3, -0.2], -180.0, 180.0, (2, 2))  # about its own x and y axis
    turn_deg: float = bounded(0.4, -180.0, 180.0)  # about its line of sight; 0: world x is up in the picture, world y points left
    focal_px: float = bounded(917.0, 10.0, 1e5)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "mount.")
        if self.eye_mm is not None:
            require_between("mount.eye_mm[2]", self.eye_mm[2], 100, 5000)


@dataclass
class LookConfig:
    """What a rendered picture suffers from."""

    blur_px: float = bounded(0.8, 0.0, 10.0)  # standard deviation of the lens's blur
    noise: float = bounded(3.0, 0.0, 50.0)  # standard deviation, of 255
    gradient: float = bounded(0.25, 0.0, 0.9)  # loss of light from the brightest corner to the opposite one
    light: float = bounded(1.0, 0.05, 2.0)  # brightness of it all

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "look.")

"""Settings of a cell with arms and a camera, real or its twin, and of how the loop watches it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from marl_handover.compose import from_yaml
from marl_handover.config import require_at_least, require_between, require_positive
from marl_handover.errors import InvalidSetting
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.perception.settings import (
    BoardConfig,
    CameraConfig,
    DetectorConfig,
    LookConfig,
    MountConfig,
    TargetConfig,
    TrackerConfig,
)
from marl_handover.resources import resource_path

TWIN = "twin"


@dataclass
class WatchConfig:
    """When a sighting is taken for where the block lies, and how long anything is waited for."""

    frame_s: float = 1 / 30  # between two looks
    steady_frames: int = 4  # sightings in a row that agree; so many that a frozen camera has shown itself by then
    steady_mm: float = 0.6
    steady_deg: float = 0.8
    hidden_s: float = 1.0  # arms parked and no steady sighting for this long: something is wrong, and said
    glance_s: float = 0.25  # between two glances at the block while a hand comes near
    patience_s: float = 15.0  # how long a camera, a block or a person is waited for
    moved_mm: float = 4.0  # nearer than this, or ...
    moved_deg: float = 5.0  # ... turned by less, the block has not been moved
    missed_mm: float = 12.0  # a block this far from where it was to be put down was lost on the way
    failures: int = 3  # transfers of one arm in a row that did not move the block: the arm is stalled

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        for name in ("frame_s", "steady_mm", "steady_deg", "hidden_s", "glance_s", "moved_mm", "moved_deg", "missed_mm"):
            require_positive(f"watch.{name}", getattr(self, name))
        require_between("watch.steady_frames", self.steady_frames, 1, 100)
        require_between("watch.patience_s", self.patience_s, self.hidden_s, 3600)
        require_at_least("watch.failures", self.failures, 1)


@dataclass
class TwinConfig:
    """What the twin's people and glue are like, beside its servos (``hardware.emulator``) and its camera (``mount``, ``look``)."""

    seed: int = 0  # of the camera's noise and of what people do
    card_sd_mm: float = 0.3  # how exactly the marker cards are glued onto the hands
    card_sd_deg: float = 0.5
    board_sd_mm: float = 0.3  # how exactly the calibration board is laid onto its marks
    board_sd_deg: float = 0.1

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        for name in ("card_sd_mm", "card_sd_deg", "board_sd_mm", "board_sd_deg"):
            require_at_least(f"twin.{name}", getattr(self, name), 0)


@dataclass
class CardConfig:
    """The printed markers that are glued onto the hands while servos are calibrated: which, how large, and where in the grip's frame."""

    ids: list[int] = field(default_factory=lambda: [2, 3])  # left arm's, right arm's; of target.dictionary
    marker_mm: float = 30.0
    place_mm: list[float] = field(default_factory=lambda: [-47.0, 0.0, 13.2])  # its middle: flat on the hand, x along the fingers


@dataclass
class LabConfig:
    """A cell: electronics, camera, what is looked for, and where its calibration is kept."""

    hardware: HardwareConfig = field(default_factory=HardwareConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    calibration: str = ""  # folder of what calibrate writes; empty: runs/calibration/<name of the hardware>
    chart_inset: float = 0.99  # hand-overs keep to this part of the chart; 0.95 with a policy that was trained with it
    board: BoardConfig = field(default_factory=BoardConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    watch: WatchConfig = field(default_factory=WatchConfig)
    cards: CardConfig = field(default_factory=CardConfig)
    mount: MountConfig = field(default_factory=MountConfig)  # of the twin
    look: LookConfig = field(default_factory=LookConfig)  # of the twin
    twin: TwinConfig = field(default_factory=TwinConfig)

    @property
    def emulated(self) -> bool:
        """Whether this is the twin."""
        return self.hardware.name == TWIN

    def folder(self) -> Path:
        """Where the calibration is kept."""
        return Path(self.calibration or f"runs/calibration/{self.hardware.name}")

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        for part in (self.hardware, self.board, self.target, self.detector, self.tracker, self.watch, self.mount, self.look, self.twin):
            part.validate()
        require_between("chart_inset", self.chart_inset, 0.1, 1)
        if self.watch.steady_frames < self.tracker.frozen_frames:
            raise InvalidSetting(
                "watch.steady_frames", self.watch.steady_frames, f"at least tracker.frozen_frames = {self.tracker.frozen_frames}"
            )
        if not self.emulated:
            self.camera.validate()


def twin_lab() -> LabConfig:
    """The twin as it is shipped."""
    return LabConfig(from_yaml(HardwareConfig, resource_path("configs/hardware/twin.yaml")))

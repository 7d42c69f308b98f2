"""Settings of a cell with arms and a camera, real or its twin, and of how the loop watches it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from marl_handover.compose import from_yaml
from marl_handover.config import ENGINES, bounded, check_bounds, chosen, path_field, require_between, seed_field
from marl_handover.errors import InvalidSetting
from marl_handover.files import resource_path
from marl_handover.hardware.settings import HardwareConfig, twin_of
from marl_handover.perception.settings import (
    MARKERS,
    BoardConfig,
    CameraConfig,
    DetectorConfig,
    LookConfig,
    MountConfig,
    TargetConfig,
    TrackerConfig,
)

_RENDERED = ("width_px", "height_px", "max_age_s")
"""What a drawn picture has of a camera's settings."""


@dataclass
class WatchConfig:
    """When a sighting is taken for where the block lies, and how long anything is waited for."""

    frame_s: float = bounded(1 / 30, 1e-3, 10.0)  # between two looks
    picture_s: float = bounded(0.5, 0.01, 600.0)  # no new picture for this long: the camera gives none
    steady_frames: int = bounded(4, 1, 100)  # sightings in a row that agree; so many that a frozen camera has shown itself by then
    steady_mm: float = bounded(0.6, 1e-3, 1000.0)
    steady_deg: float = bounded(0.8, 1e-3, 360.0)
    hidden_s: float = bounded(1.0, 0.001, 600.0)  # arms parked and no steady sighting for this long: something is wrong, and said
    poll_period_s: float = bounded(0.25, 1e-3, 60.0)  # between two glances at the block while a hand comes near
    timeout_s: float = bounded(15.0, 0.001, 3600.0)  # how long a camera, a block or a person is waited for
    moved_mm: float = bounded(4.0, 1e-3, 1000.0)  # nearer than this, or ...
    moved_deg: float = bounded(5.0, 1e-3, 360.0)  # ... turned by less, the block has not been moved
    lost_threshold_mm: float = bounded(12.0, 1e-3, 1000.0)  # a block this far from where it was to be put down was lost on the way
    failures: int = bounded(3, 1, 1000)  # transfers of one arm in a row that did not move the block: the arm is stalled

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "watch.")
        require_between("watch.timeout_s", self.timeout_s, self.hidden_s, 3600)


@dataclass
class TwinConfig:
    """What the twin's people and glue are like, beside its servos (``hardware.emulator``) and its camera (``mount``, ``look``)."""

    seed: int = seed_field()  # of the camera's noise and of what people do
    engine: str | None = chosen(None, ENGINES)  # its physics, bullet or mujoco; null: bullet where it is installed
    card_sd_mm: float = bounded(0.3, 0.0, 20.0)  # how exactly the marker cards are glued onto the hands
    card_sd_deg: float = bounded(0.5, 0.0, 45.0)
    board_sd_mm: float = bounded(0.3, 0.0, 20.0)  # how exactly the calibration board is laid onto its marks
    board_sd_deg: float = bounded(0.1, 0.0, 45.0)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "twin.")


@dataclass
class CardConfig:
    """The printed markers that are glued onto the hands while servos are calibrated: which, how large, and where."""

    ids: list[int] | None = bounded(None, 0, 10_000, (1, 32))  # of target.dictionary, one an arm, in order; null: 2, 3 and so on
    marker_mm: float = bounded(30.0, 4.0, 200.0)
    place_mm: list[float] | None = bounded(None, -500.0, 500.0, (3, 3))  # its middle from the grip, x along the fingers; null: on the palm

    def numbers(self, arms: int) -> list[int]:
        """The markers of so many arms."""
        return list(range(2, 2 + arms)) if self.ids is None else self.ids

    def validate(self, target: TargetConfig, arms: int) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits, or a marker that means something else in ``target``."""
        check_bounds(self, "hand_markers.")
        count, taken, ids = MARKERS[target.dictionary], {target.block_id, target.goal_id}, self.numbers(arms)
        if len(ids) != arms or len({*ids} - taken) != arms or not all(0 <= number < count for number in ids):
            wanted = f"{arms} different numbers from 0 to {count - 1}, one an arm, that are neither target.block_id nor target.goal_id"
            raise InvalidSetting("hand_markers.ids", ids, wanted)


@dataclass
class WorkcellConfig:
    """A cell: electronics, camera, what is looked for, and where its calibration is kept."""

    hardware: HardwareConfig = field(default_factory=HardwareConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    calibration: str = path_field()  # folder of what calibrate writes; empty: runs/calibration/<name of the hardware>
    chart_inset: float = bounded(0.99, 0.1, 1.0)  # hand-overs keep to this part of the chart; 0.95 with a policy that was trained with it
    board: BoardConfig = field(default_factory=BoardConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    watch: WatchConfig = field(default_factory=WatchConfig)
    hand_markers: CardConfig = field(default_factory=CardConfig)
    mount: MountConfig = field(default_factory=MountConfig)  # of the twin
    look: LookConfig = field(default_factory=LookConfig)  # of the twin
    twin: TwinConfig = field(default_factory=TwinConfig)

    @property
    def emulated(self) -> bool:
        """Whether this is the twin."""
        return self.hardware.emulated

    def folder(self) -> Path:
        """Where the calibration is kept."""
        return Path(self.calibration or f"runs/calibration/{self.hardware.name}")

    def validate(self, arms: Sequence[str] | None = None) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits, or one that this cell does not use.

        ``arms`` are those of the cell, by name; None: those that ``hardware`` has wiring for.
        """
        check_bounds(self)
        for part in (self.hardware, self.board, self.target, self.detector, self.tracker, self.watch, self.mount, self.look, self.twin):
            part.validate()
        self.hand_markers.validate(self.target, len(self.hardware.for_arms(arms).arms))
        if self.watch.steady_frames < self.tracker.frozen_frames:
            raise InvalidSetting(
                "watch.steady_frames", self.watch.steady_frames, f"at least tracker.frozen_frames = {self.tracker.frozen_frames}"
            )
        if self.emulated:
            replace(self.camera, source="rendered").validate()
            used = _RENDERED if self.camera.source != "rendered" else (*_RENDERED, "source")
            _require_unused("camera", self.camera, CameraConfig(), used, "the twin: its pictures are drawn")
        else:
            self.camera.validate()
            for name, usual in (("mount", MountConfig()), ("look", LookConfig()), ("twin", TwinConfig())):
                _require_unused(name, getattr(self, name), usual, (), "a real cell: it is of the twin")


def _require_unused(name: str, given: Any, usual: Any, used: Sequence[str], by: str) -> None:
    """Raise :class:`InvalidSetting` for a setting of ``given``, apart from those ``used``, that is not as ``usual``."""
    for part in fields(given):
        value = getattr(given, part.name)
        if part.name not in used and value != getattr(usual, part.name):
            raise InvalidSetting(f"{name}.{part.name}", value, f"left out with {by}")


def twin_workcell(hardware: HardwareConfig | None = None) -> WorkcellConfig:
    """The twin of ``hardware``, None: of the pair as it is shipped."""
    if hardware is None:
        return WorkcellConfig(from_yaml(HardwareConfig, resource_path("configs/hardware/twin.yaml")))
    return WorkcellConfig(replace(hardware, name=twin_of(hardware.name)))

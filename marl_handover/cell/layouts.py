"""Cells of arms that are known by where they stand and what they reach, without a robot: as problem files give them, and random ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from marl_handover.cell.arm import Arm
from marl_handover.cell.cell import Cell
from marl_handover.config import MOST_ARMS, ArmConfig, CellConfig, ObstacleConfig
from marl_handover.errors import InvalidSetting, NotFinite
from marl_handover.geometry.se2 import SE2

ARM_NUMBERS = ("x_mm", "y_mm", "facing_rad", "r_min_mm", "r_max_mm")
OBSTACLE_NUMBERS = ("x_mm", "y_mm", "radius_mm")
LEAST_BASE_DISTANCE_MM = 30.0
"""Bases nearer than this touch each other."""

_FARTHEST_MM = 10_000.0


def layout_cell(arms: Sequence[Mapping[str, Any]], obstacles: Sequence[Mapping[str, Any]] = (), config: CellConfig | None = None) -> Cell:
    """The cell of arms and obstacles as ``workspace.json`` and lines of problem files have them; other keys are ignored.

    Args:
        arms: ``name``, ``x_mm``, ``y_mm``, ``facing_rad``, ``r_min_mm``, ``r_max_mm``, ``yaw_range_rad`` (two numbers, about the facing).
        obstacles: ``x_mm``, ``y_mm``, ``radius_mm``, and, if it is known, ``height_mm``.
        config: what the arms do not say, as the block; the defaults if None.

    Raises:
        InvalidSetting, NotFinite: a record is not as it has to be, or bases touch.
        NoSharedSpace, UnconnectedArms: some arms cannot pass anything to the others.
    """
    _require_list("arms", arms, 2, MOST_ARMS)
    listed: list[Arm] = []
    for number, record in enumerate(arms):
        arm = _arm(f"arms[{number}]", record)
        for other in listed:
            if arm.name == other.name:
                raise InvalidSetting(f"arms[{number}].name", arm.name, "a name that no other arm has")
            apart = math.dist(arm.base.position_mm, other.base.position_mm)
            if apart < LEAST_BASE_DISTANCE_MM:
                limit = f"at least {LEAST_BASE_DISTANCE_MM:g} mm from that of {other.name!r}, whose base stands there"
                raise InvalidSetting(f"the base of arm {arm.name!r}, {apart:.1f} mm away,", arm.base.position_mm.tolist(), limit)
        listed.append(arm)
    discs = obstacle_configs(obstacles)
    named = [ArmConfig(arm.name, arm.base.x_mm, arm.base.y_mm, math.degrees(arm.base.facing_rad)) for arm in listed]
    base = CellConfig() if config is None else config
    chart = "angle" if base.chart == "angle" else None
    return Cell(tuple(listed), replace(base, name="layout", arms=named, enabled=None, obstacles=discs, chart=chart, base_distance_mm=None))


def obstacle_configs(records: Sequence[Mapping[str, Any]]) -> list[ObstacleConfig]:
    """Settings of obstacles as :func:`layout_cell` takes them. Raises :class:`InvalidSetting`, :class:`NotFinite`."""
    _require_list("obstacles", records, 0, 64)
    return [_obstacle(f"obstacles[{number}]", record) for number, record in enumerate(records)]


def _require_list(what: str, records: Any, least: int, most: int) -> None:
    if not isinstance(records, Sequence) or isinstance(records, str) or not least <= len(records) <= most:
        value = len(records) if isinstance(records, Sequence) and not isinstance(records, str) else records
        raise InvalidSetting(what, value, f"a list of {least} to {most}")


def _arm(what: str, record: Any) -> Arm:
    x_mm, y_mm, facing_rad, r_min_mm, r_max_mm = _numbers(what, record, ARM_NUMBERS)
    name = record.get("name")
    if not isinstance(name, str) or not name:
        raise InvalidSetting(f"{what}.name", name, "a name that no other arm has")
    yaws = record.get("yaw_range_rad")
    if not isinstance(yaws, Sequence) or isinstance(yaws, str) or len(yaws) != 2:
        raise InvalidSetting(f"{what}.yaw_range_rad", yaws, "two numbers in rad, about the arm's facing")
    low, high = (_finite(f"{what}.yaw_range_rad", yaw) for yaw in yaws)
    if not low < high or high - low > 2 * math.pi + 1e-6:
        raise InvalidSetting(f"{what}.yaw_range_rad", [low, high], "the lower first, not more than a full turn apart")
    if not 0 < r_min_mm < r_max_mm <= _FARTHEST_MM:
        raise InvalidSetting(f"{what}.r_min_mm, r_max_mm", [r_min_mm, r_max_mm], f"above 0, the smaller first, up to {_FARTHEST_MM:g}")
    if max(abs(x_mm), abs(y_mm)) > _FARTHEST_MM:
        raise InvalidSetting(f"{what}.x_mm, y_mm", [x_mm, y_mm], f"within {_FARTHEST_MM:g} mm of the origin")
    if max(-low, high) > math.pi:  # yaw is seen between half a turn to either side: turn the frame to the middle of the range
        middle = (low + high) / 2
        facing_rad, low, high = facing_rad + middle, low - middle, high - middle
    base = SE2.facing_deg(x_mm, y_mm, math.degrees(facing_rad))
    return Arm(name, base, r_min_mm, r_max_mm, (max(low, -math.pi), min(high, math.pi)))


def _obstacle(what: str, record: Any) -> ObstacleConfig:
    x_mm, y_mm, radius_mm = _numbers(what, record, OBSTACLE_NUMBERS)
    if record.get("shape", "disc") != "disc":
        raise InvalidSetting(f"{what}.shape", record["shape"], "'disc'")
    if not 0 < radius_mm <= _FARTHEST_MM:
        raise InvalidSetting(f"{what}.radius_mm", radius_mm, f"above 0, up to {_FARTHEST_MM:g}")
    height_mm = _finite(f"{what}.height_mm", record.get("height_mm", ObstacleConfig().height_mm))
    return ObstacleConfig(x_mm, y_mm, radius_mm, height_mm)


def _numbers(what: str, record: Any, keys: Sequence[str]) -> list[float]:
    if not isinstance(record, Mapping):
        raise InvalidSetting(what, record, f"a mapping with {', '.join(keys)}")
    return [_finite(f"{what}.{key}", record.get(key)) for key in keys]


def _finite(what: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InvalidSetting(what, value, "a number")
    if not math.isfinite(value):
        raise NotFinite(what, value)
    return float(value)

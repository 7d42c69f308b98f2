"""Edits of a cell's settings: arms and keep-out discs that are put somewhere, added, taken away, switched off. Each gives new settings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats, wrap
from marl_handover.cell import CellModel
from marl_handover.compose import changed_yaml
from marl_handover.config import MOST_ARMS, ArmConfig, CellConfig, ObstacleConfig
from marl_handover.errors import HandoverError, InvalidSetting
from marl_handover.files import expanded

FARTHEST_MM = 5_000.0
"""From the origin: nothing is put farther out."""

DISC_MM = 20.0
"""Radius of a new disc."""

NAMES = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
"""Of new arms: one of these is free as long as there may be one more."""

_SPACING = 1.4
"""Distance from an arm to one that is put next to it, in outer radii."""

_ROOM_MM = 30.0
"""A new disc is put so much farther from block and goal than it has to be, if there is such a place."""


def placed_arms(config: CellConfig, model: CellModel) -> CellConfig:
    """The same cell, in which every arm says where it stands: ``model``, its own, knows."""
    if config.arms and any(arm.x_mm or arm.y_mm or arm.facing_deg for arm in config.arms):
        return config
    robots = [arm.robot for arm in config.arms] or [""] * model.cell.num_arms
    arms = [
        ArmConfig(name, *_rounded(base.x_mm, base.y_mm, base.facing_rad), robot)
        for name, base, robot in zip(model.cell.names, model.cell.bases, robots, strict=True)
    ]
    return replace(config, arms=arms, base_distance_mm=None)


def with_base(config: CellConfig, name: str, pose: ArrayLike) -> CellConfig:
    """Arm ``name`` stands at ``pose`` (3,): x_mm, y_mm, facing_rad."""
    x_mm, y_mm, facing_deg = _rounded(*np.asarray(pose, float))
    moved = [replace(arm, x_mm=x_mm, y_mm=y_mm, facing_deg=facing_deg) if arm.name == name else arm for arm in config.arms]
    return replace(config, arms=moved)


def with_arm(config: CellConfig, model: CellModel) -> CellConfig:
    """One more arm, of the last arm's robot: where it stands clear of all others and can pass to one, as near to the middle as may be.

    Raises:
        InvalidSetting: there are as many as there can be, or there is no such place.
    """
    if len(config.arms) >= MOST_ARMS:
        raise InvalidSetting("cell.arms", len(config.arms) + 1, f"at most {MOST_ARMS}")
    taken = {arm.name for arm in config.arms}
    name = next(name for name in NAMES if name not in taken)
    spacing_mm = _SPACING * max(arm.r_max_mm for arm in model.cell.arms)
    for x_mm, y_mm, facing_rad in _places_beside(model, spacing_mm):
        new = ArmConfig(name, *_rounded(x_mm, y_mm, facing_rad), config.arms[-1].robot)
        enabled = None if config.enabled is None else [*config.enabled, name]
        wider = replace(config, arms=[*config.arms, new], enabled=enabled)
        try:
            graph = model.relaid(wider).cell.graph
        except HandoverError:
            continue
        if graph.neighbours(len(config.arms)):
            return wider
    raise InvalidSetting("cell.arms", len(config.arms) + 1, "arms that leave room for one more; move one away")


def _places_beside(model: CellModel, spacing_mm: float) -> list[tuple[float, float, float]]:
    """Bases (x_mm, y_mm, facing_rad) so far from an arm, and hardly nearer to any, that face it; the nearest to the middle first."""
    bases = np.array([base.position_mm for base in model.cell.bases])
    middle, found = bases.mean(0), []
    for base in bases:
        for turn in np.linspace(0.0, 2 * math.pi, 24, endpoint=False):
            place = base + spacing_mm * np.array([math.cos(turn), math.sin(turn)])
            if np.hypot(*(bases - place).T).min() > 0.9 * spacing_mm:
                found.append((float(np.hypot(*(place - middle))), (float(place[0]), float(place[1]), turn + math.pi)))
    return [place for _, place in sorted(found)]


def without_arm(config: CellConfig, name: str) -> CellConfig:
    """Arm ``name`` is taken away. Raises :class:`InvalidSetting` where only two are left, or no other one is in order."""
    arms = [arm for arm in config.arms if arm.name != name]
    if len(arms) < 2:
        raise InvalidSetting("cell.arms", len(arms), "two arms at least: switch one off to have it out of the way")
    return _in_order(replace(config, arms=arms), [each for each in _enabled(config) if each != name])


def switched(config: CellConfig, name: str) -> CellConfig:
    """Arm ``name`` goes out of order, or is in order again. Raises :class:`InvalidSetting` where no other one is."""
    on = _enabled(config)
    return _in_order(config, [arm.name for arm in config.arms if (arm.name in on) != (arm.name == name)])


def _enabled(config: CellConfig) -> list[str]:
    return [arm.name for arm in config.arms] if config.enabled is None else config.enabled


def _in_order(config: CellConfig, names: list[str]) -> CellConfig:
    if not names:
        raise InvalidSetting("cell.enabled", [], "at least one arm that is in order")
    return replace(config, enabled=None if len(names) == len(config.arms) else names)


def with_disc(config: CellConfig, model: CellModel, spared: ArrayLike = ()) -> CellConfig:
    """One more keep-out disc: in what two arms share, off the places ``spared`` (n, 2), where all arms can still pass to each other.

    Raises :class:`InvalidSetting` where there is none.
    """
    apart_mm = DISC_MM + model.cell.config.block.side_mm / math.sqrt(2)
    kept = np.reshape(np.asarray(spared, float), (-1, 2))
    groups = len(model.cell.graph.components)
    for room_mm in (_ROOM_MM, 0.0):
        for place in _shared_places(model):
            if len(kept) and np.hypot(*(kept - place).T).min() < apart_mm + room_mm:
                continue
            wider = replace(
                config, obstacles=[*config.obstacles, ObstacleConfig(float(round(place[0], 1)), float(round(place[1], 1)), DISC_MM)]
            )
            if len(model.relaid(wider).cell.graph.components) == groups:
                return wider
    raise InvalidSetting("cell.obstacles", len(config.obstacles) + 1, "room for one more in what arms share; take one away")


def _shared_places(model: CellModel) -> Iterator[Floats]:
    """Places (2,) that two arms share, the middles first, of one pair after the other."""
    for beta in (0.0, 0.5, -0.5):
        for alpha in (0.0, 0.4, -0.4, 0.8, -0.8):
            for space in model.cell.graph.edges.values():
                yield space.to_table(np.array(alpha), np.array(beta))


def with_disc_at(config: CellConfig, number: int, place_mm: ArrayLike) -> CellConfig:
    """Disc ``number``, from 0, lies at a place (2,)."""
    x_mm, y_mm, _ = _rounded(*np.append(np.asarray(place_mm, float)[:2], 0.0))
    return _with_obstacle(config, number, replace(config.obstacles[number], x_mm=x_mm, y_mm=y_mm))


def with_radius(config: CellConfig, number: int, radius_mm: float) -> CellConfig:
    """Disc ``number``, from 0, has another radius."""
    return _with_obstacle(config, number, replace(config.obstacles[number], radius_mm=radius_mm))


def _with_obstacle(config: CellConfig, number: int, disc: ObstacleConfig) -> CellConfig:
    return replace(config, obstacles=[disc if index == number else each for index, each in enumerate(config.obstacles)])


def without_disc(config: CellConfig, number: int) -> CellConfig:
    """Disc ``number``, from 0, is taken away."""
    return replace(config, obstacles=[disc for index, disc in enumerate(config.obstacles) if index != number])


def file_text(config: CellConfig, name: str) -> str:
    """The cell as a YAML file that ``cell=FILE`` reads, whatever folder it is in: robots that are files are named by their whole path."""
    arms = [replace(arm, robot=_whole_path(arm.robot)) for arm in config.arms]
    return changed_yaml(replace(config, name=name, robot=_whole_path(config.robot), arms=arms))


def _whole_path(robot: str) -> str:
    path = expanded(robot)
    return str(path.resolve()) if robot and (path.suffix or path.parent != Path()) else robot


def _rounded(x_mm: float, y_mm: float, facing_rad: float) -> tuple[float, float, float]:
    """As a person would write it: to a tenth of a mm and of a degree."""
    at = np.clip([x_mm, y_mm], -FARTHEST_MM, FARTHEST_MM)
    return round(float(at[0]), 1), round(float(at[1]), 1), round(math.degrees(float(wrap(facing_rad))), 1)

"""The path cost of eq. (3) for thousands of transfers at once: a table of what the optimiser finds, interpolated.

An arm turns about its base, so that, with the other arm parked clear of all paths, the length of a transfer depends on no more than both
radii and the yaw between the two places, and is the same either way. Arms that are alike share a table. No path is shorter than a string
pulled over the lift-over profile, which depends on the distance alone; the table holds what the arm adds to it: 0.3 mm for short ways, up
to 50 mm for half a turn.

Each node is the shortest path of all the starts the planner has. Against the planner itself, which stops at its second path, on 1,000
random transfers of the paper cell: median 0.1 mm (0.07 %), 95th percentile 2.4 mm (0.75 %), largest 67 mm (15 %). The large ones are
turns of more than 120 degrees, where the ways around the base that are locally shortest differ by that much.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from marl_handover.arrays import Array, namespace, select, wrap
from marl_handover.cell import Cell, build_cell
from marl_handover.cell.arm import REACH_TOLERANCE_MM, Arm
from marl_handover.cell.build import robot_of
from marl_handover.config import CellConfig, MotionConfig, RobotConfig, TaskConfig
from marl_handover.errors import CannotWrite, CorruptFile, HandoverError, MissingFile
from marl_handover.files import MEGABYTE, cache_folder, package_path, read_arrays, writing
from marl_handover.geometry.robot import read_robot
from marl_handover.motion.home import parked_deg
from marl_handover.progress import Bar
from marl_handover.task.rules import MotionCost, straight_line_mm

Floats = NDArray[np.float64]

LARGEST_BYTES = 64 * MEGABYTE
SHIPPED = "pretrained/motion_cost.npz"
ROBOT_SETTINGS = ("pitch_deg", "joints", "locked", "approach", "shapes")
"""Of a robot, that lengths depend on, besides its tip, limits and pick height."""
RADII, YAWS, DISTANCES = 9, 25, 257
"""Nodes of the table along both radii, along the yaw between the places, and of the string along the distance."""


class StaleTable(HandoverError):
    """A table of path costs belongs to another cell, other motion settings or another URDF than the ones asked for."""

    def __init__(self, path: Path, stored: str, wanted: str) -> None:
        super().__init__(f"path costs {path} are those of settings {stored}, but {wanted} was asked for; build them again")
        self.path, self.stored, self.wanted = path, stored, wanted


@dataclass(frozen=True, eq=False)
class PathLengthTable:
    """A :data:`~marl_handover.task.rules.MotionCost`: lengths in mm of the grip's way, numpy or torch, float32 or float64.

    Attributes:
        key: :func:`settings_key` of what it was built for.
        radii_mm: (2,) least and greatest.
        span_rad: greatest yaw between two places.
        string_mm: (DISTANCES,) length of the string, from 0 to twice the greatest radius.
        excess_mm: (RADII, RADII, YAWS) what the path is longer than the string; symmetric in the radii.
    """

    key: str
    radii_mm: Floats
    span_rad: float
    string_mm: Floats
    excess_mm: Floats

    def __call__(self, cell: Cell, arm: Array, start_mm: Array, end_mm: Array) -> Array:
        """Length (...) of the transfers of ``arm`` (...) from ``start_mm`` (..., 2) to ``end_mm`` (..., 2); 0 for one that stays there."""
        xp = namespace(start_mm)
        radii, yaws = zip(*(self._seen(cell, arm, place) for place in (start_mm, end_mm)), strict=True)
        least, most = (float(radius) for radius in self.radii_mm)
        step = (most - least) / (RADII - 1)
        # The nearer first: either way gives the same bits.
        near, far = xp.minimum(*radii), xp.maximum(*radii)
        places = [(near - least) / step, (far - least) / step, abs(wrap(yaws[1] - yaws[0])) / self._yaw_step]
        string, excess = self._tables(start_mm)
        distance = straight_line_mm(cell, arm, start_mm, end_mm)
        length = interpolated(string, [distance / self._distance_step]) + interpolated(excess, places)
        return xp.where(distance > REACH_TOLERANCE_MM, length, 0 * length)

    def save(self, path: Path) -> None:
        """Write it whole, then rename."""
        with writing(path) as stream:
            np.savez_compressed(stream, **asdict(self))

    @staticmethod
    def _seen(cell: Cell, arm: Array, place_mm: Array) -> tuple[Array, Array]:
        """Radius and base yaw (...) of a place, seen from the arm that goes there."""
        square, yaw = cell.polar(place_mm)
        return namespace(place_mm).sqrt(select(square, arm)), select(yaw, arm)

    @property
    def _yaw_step(self) -> float:
        return self.span_rad / (YAWS - 1)

    @property
    def _distance_step(self) -> float:
        return 2 * float(self.radii_mm[1]) / (DISTANCES - 1)

    def _tables(self, like: Array) -> tuple[Array, Array]:
        """String and excess as arrays of the kind of ``like``; made once for each kind."""
        key = (like.dtype, getattr(like, "device", None))
        if key not in self._kinds:
            xp = namespace(like)
            self._kinds[key] = tuple(xp.asarray(table, dtype=like.dtype, device=key[1]) for table in (self.string_mm, self.excess_mm))
        return self._kinds[key]

    @cached_property
    def _kinds(self) -> dict[Any, tuple[Array, Array]]:
        return {}


@dataclass(frozen=True, eq=False)
class TablePerArm:
    """A :data:`~marl_handover.task.rules.MotionCost` for arms that differ: each has a table of its own."""

    tables: tuple[PathLengthTable, ...]

    def __call__(self, cell: Cell, arm: Array, start_mm: Array, end_mm: Array) -> Array:
        """As :meth:`PathLengthTable.__call__`."""
        xp = namespace(start_mm)
        length = self.tables[0](cell, arm, start_mm, end_mm)
        for index, table in enumerate(self.tables[1:], 1):
            length = xp.where(arm == index, table(cell, arm, start_mm, end_mm), length)
        return length


def interpolated(table: Array, places: list[Array]) -> Array:
    """A table of n dimensions, linear between its nodes and constant beyond them, at n ``places`` (...) counted in nodes: (...)."""
    xp, flat = namespace(table), table.reshape(-1)
    corners: list[tuple[Array, Array]] = [(0, 1.0)]
    for count, place in zip(table.shape, places, strict=True):
        inside = xp.clip(place, 0, count - 1)
        low = xp.clip(xp.floor(inside), 0, count - 2)
        node, share = _integers(low), inside - low
        corners = [(index * count + node + up, weight * (share if up else 1 - share)) for index, weight in corners for up in (0, 1)]
    return sum(weight * flat[index] for index, weight in corners)


def _integers(x: Array) -> Array:
    return np.asarray(x, np.int64) if namespace(x) is np else x.long()


def motion_cost(cell: Cell, task: TaskConfig, motion: MotionConfig | None = None) -> MotionCost:
    """The path cost that ``task.reward.motion_weight`` weighs: the cell's table, or the straight line where the weight is 0.

    A cell other than the shipped one has its table built at first use, in about a minute, and kept in the user's cache folder.
    """
    if task.reward.motion_weight == 0:
        return straight_line_mm
    motion = motion or MotionConfig()
    if _alike(cell):
        return path_length_table(cell, motion)
    return TablePerArm(tuple(path_length_table(cell, motion, arm) for arm in range(cell.num_arms)))


_TABLES: dict[str, PathLengthTable] = {}


def path_length_table(cell: Cell, motion: MotionConfig, arm: int = 0) -> PathLengthTable:
    """The table of a cell's arm: the shipped one, one kept from before, or a new one."""
    key = settings_key(cell, motion, arm)
    if key not in _TABLES:
        _TABLES[key] = _found(key) or _kept(cell, motion, key, arm)
    return _TABLES[key]


def known_table(cell: Cell, motion: MotionConfig) -> PathLengthTable | None:
    """The table of a pair of arms that are alike, if it is shipped or was kept from before; nothing is built."""
    return _found(settings_key(cell, motion)) if cell.num_arms == 2 and _alike(cell) else None


def _alike(cell: Cell) -> bool:
    """Whether all arms are of one robot and reach alike."""
    first = cell.arms[0]
    return all((arm.robot, arm.r_min_mm, arm.r_max_mm) == (first.robot, first.r_min_mm, first.r_max_mm) for arm in cell.arms)


def settings_key(cell: Cell, motion: MotionConfig, arm: int = 0) -> str:
    """A short name of all that the path lengths of an arm depend on: 16 hexadecimal digits.

    The name of a cell and the part of its chart in use do not count, nor what concerns only the timing; and a table holds what the
    optimiser finds, whatever method plans.
    """
    untimed = {"method", "velocity_scale", "acceleration_deg_s2", "sample_s", "grasp_s", "release_s"}
    older = {"num_initial_guesses": "starts"}  # keys of tables that are kept were made with this name
    cell.require_pair("a table of path lengths")
    robot = robot_of(cell.config, cell.arms[0].robot)
    parked = parked_deg(cell, motion, 0, robot, read_robot(robot))
    settings = sorted(
        (older.get(name, name), value) for name, value in asdict(replace(motion, parked_deg=parked)).items() if name not in untimed
    )
    shape = _shape(cell.config, robot)
    digest = hashlib.sha256(repr((RADII, YAWS, DISTANCES, shape, settings)).encode())
    digest.update(Path(robot.urdf).read_bytes())
    if not _alike(cell):
        digest.update(repr((arm, [Path(robot_of(cell.config, each.robot).urdf).read_bytes() for each in cell.arms])).encode())
    return digest.hexdigest()[:16]


def _shape(config: CellConfig, robot: RobotConfig) -> str:
    """What the lengths depend on of a pair and its robot, written as it was when cells had no robots: keys of kept tables stay valid."""
    usual = RobotConfig()
    told: dict[str, Any] = {"name": "", "urdf": "", "grasp_link": robot.tip, "base_distance_mm": config.base_distance_mm}
    told |= {"pick_height_mm": robot.pick_height_mm, "joint_limits_deg": robot.joint_limits_deg}
    told |= {name: getattr(config, name) for name in ("grid_mm", "fit_rounding_mm")} | {"chart_inset": 1.0, "block": asdict(config.block)}
    told |= {name: value for name in ROBOT_SETTINGS if (value := getattr(robot, name)) != getattr(usual, name)}
    return yaml.safe_dump(told, sort_keys=False)


def read_table(path: Path, key: str) -> PathLengthTable:
    """The table stored in ``path``, if it is the one of settings ``key``.

    Raises:
        MissingFile, CorruptFile, StaleTable: if there is none, it is not whole, or it is another one.
    """
    try:
        file = read_arrays(path, LARGEST_BYTES, "path costs")
        stored = str(file["key"])
        radii, string, excess = (np.asarray(file[name], float) for name in ("radii_mm", "string_mm", "excess_mm"))
        table = PathLengthTable(stored, radii, float(file["span_rad"]), string, excess)
    except (CorruptFile, KeyError, TypeError, ValueError) as error:
        raise CorruptFile("path costs", path, "damaged, or no such table; delete it and it is built again") from error
    if stored != key:
        raise StaleTable(path, stored, key)
    shapes = (radii.shape, string.shape, excess.shape)
    if shapes != ((2,), (DISTANCES,), (RADII, RADII, YAWS)) or not all(np.isfinite(part).all() for part in (radii, string, excess)):
        raise CorruptFile("path costs", path, f"its parts have shapes {shapes} or numbers that are not finite")
    return table


def build_table(cell: Cell, motion: MotionConfig, arm: int = 0, *, progress: bool = True) -> PathLengthTable:
    """Plan a transfer of ``arm`` for every node, both places symmetric about the middle of the yaw range, the other arm parked.

    A node without a path gets the largest excess found at all: it is to be dear, not free.

    Raises:
        InvalidSetting: on a motion setting out of its limits.
    """
    from marl_handover.motion.planner import MotionPlanner

    planner = MotionPlanner(build_cell(cell.config), motion)
    ring = cell.arms[arm]
    middle, span = sum(ring.yaw_rad) / 2, min(ring.yaw_rad[1] - ring.yaw_rad[0], math.pi)
    radii, yaws = np.linspace(ring.r_min_mm, ring.r_max_mm, RADII), np.linspace(0.0, span, YAWS)
    excess = np.zeros((RADII, RADII, YAWS))
    nodes: Iterable[tuple[int, int]] = [(i, j) for i in range(RADII) for j in range(i, RADII)]
    for i, j in Bar(nodes, desc="path costs", unit=f"x{YAWS} paths", shown=progress):
        for k in range(1 if i == j else 0, YAWS):  # no way at all: what is near it adds nothing to the string either
            ends = _places(ring, middle, radii[i], radii[j], yaws[k])
            excess[i, j, k] = excess[j, i, k] = _excess_mm(planner, arm, *ends)
    excess[np.isnan(excess)] = np.nanmax(excess)
    distances = np.linspace(0.0, 2 * ring.r_max_mm, DISTANCES)
    turns = 2 * np.arcsin(np.minimum(distances / (2 * ring.r_max_mm), math.sin(span / 2)))
    chords = [_places(ring, middle, ring.r_max_mm, ring.r_max_mm, turn) for turn in turns]
    string = np.array([planner.carrying(arm, *ends, planner.others_home_rad(arm))[0].lower_bound_mm for ends in chords])
    return PathLengthTable(settings_key(cell, motion, arm), np.array([ring.r_min_mm, ring.r_max_mm]), span, string, excess)


def _places(ring: Arm, middle_rad: float, first_mm: float, second_mm: float, between_rad: float) -> tuple[Floats, Floats]:
    """World positions (2,) of two places at these radii of an arm, symmetric about ``middle_rad`` of its yaw."""
    first, second = ring.at((first_mm, second_mm), middle_rad + np.array([-0.5, 0.5]) * between_rad)
    return first, second


def _excess_mm(planner: Any, arm: int, pick_mm: Floats, place_mm: Floats) -> float:
    """What the shortest path found from all starts is longer than the string; NaN without a path."""
    from marl_handover.motion.path_optimizer import NoPath, find_path

    motion = planner.motion
    segment, guesses = planner.carrying(arm, pick_mm, place_mm, planner.others_home_rad(arm))
    try:
        found = find_path(segment, guesses, motion.control_points, motion.degree, motion.num_initial_guesses, thorough=True)
    except NoPath:
        return math.nan
    return found.length_mm - segment.lower_bound_mm


def _found(key: str) -> PathLengthTable | None:
    """The shipped table, or one in the cache folder."""
    for path in (package_path(SHIPPED), cache_file(key)):
        try:
            return read_table(path, key)
        except (MissingFile, StaleTable):
            continue
    return None


def _kept(cell: Cell, motion: MotionConfig, key: str, arm: int) -> PathLengthTable:
    """A new table, kept in the cache folder if that can be written."""
    table, path = build_table(cell, motion, arm), cache_file(key)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        table.save(path)
    except (OSError, CannotWrite) as error:
        print(f"path costs are not kept for the next time: {error}")
    return table


def cache_file(key: str) -> Path:
    """Where a table of these settings is kept, see :func:`marl_handover.files.cache_folder`."""
    return cache_folder() / f"motion_cost_{key}.npz"

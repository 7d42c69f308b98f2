"""The table of a cell: what each arm reaches, what two share and at which angles, where nothing may be put."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from marl_handover.arrays import Floats
from marl_handover.cell import Cell
from marl_handover.cell.arm import Arm
from marl_handover.cell.chart import PaperChart
from marl_handover.cell.shared_space import SharedSpace
from marl_handover.palette import ALERT, GREY, INK, SHARED, arm_colour
from marl_handover.viewer.words import arm_words, metres, rgb

WOOD = (240, 238, 233)
MARGIN_MM = 45.0
"""Table beyond the last place that an arm reaches."""

# Heights in mm: what is drawn on the table lies in layers, so that no two fight for the same pixels.
_SHADE_MM, _CHART_MM, _OUTLINE_MM, _DISC_MM, _DIAL_MM = 0.4, 0.8, 1.2, 2.0, 2.6
_CHART_LINES = 5
_POINTS = 61
_NAME_MM = 35.0
"""From a base to its name, behind it."""

_DIAL_RADIUS_MM = 42.0

RAYS, RINGS, HALVINGS = 121, 48, 14
"""How finely a shared space is looked for: directions from a base, radii in each, and how often an edge between two radii is halved."""


class TableNodes:
    """What lies on the table; moved, added and taken away as the cell changes.

    Args:
        server: of the page.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self._table = server.scene.add_box("/table", color=WOOD, dimensions=(1.0, 1.0, 0.015), position=metres([0, 0, -7.5]))
        self._lines: dict[str, viser.LineSegmentsHandle] = {}
        self._names: list[viser.LabelHandle] = []
        self._discs: list[DiscNodes] = []
        self._dials: list[viser.LabelHandle] = []
        self._shared: viser.MeshHandle | None = None
        self._drawn: dict[str, object] = {}

    @property
    def discs(self) -> list[str]:
        """Names of the nodes that discs can be dragged by."""
        return [disc.body for disc in self._discs]

    def show(self, cell: Cell, in_order: Cell | None = None, dials: bool = False) -> None:
        """Everything of a cell; what is shared, of the arms ``in_order``. ``dials``: also the hand-over angles that each two offer."""
        working = cell if in_order is None else in_order
        self.show_arms(cell.arms, cell.labels)
        self._show_shared(working)
        self._show_discs(cell)
        self._show_dials(working if dials else None)

    def show_arms(self, arms: Sequence[Arm], labels: Sequence[str], allowed: bool = True) -> None:
        """What each arm reaches, and its name; in red if they cannot stand like this."""
        outlines = [outline_of(arm) for arm in arms]
        corners = np.concatenate([*outlines, [arm.base.position_mm for arm in arms]])
        half = np.abs(corners).max(0) + MARGIN_MM
        self._table.dimensions = tuple((metres([2 * half[0], 2 * half[1], 15.0])).tolist())
        for index, (arm, label, outline) in enumerate(zip(arms, labels, outlines, strict=True)):
            self._line(f"/reach_{index}", _polyline(outline, _OUTLINE_MM), arm_colour(index) if allowed else ALERT, 1.6)
            at = metres([*arm.base.around(-_NAME_MM, 0.0), 0.0])
            if index == len(self._names):
                self._names.append(self.server.scene.add_label(f"/name_{index}", "", position=at, anchor="center-center"))
            name = self._names[index]
            name.position, name.visible = at, True
            if name.text != arm_words(label):
                name.text = arm_words(label)
        for index in range(len(arms), len(self._names)):
            self._names[index].visible = self._lines[f"/reach_{index}"].visible = False

    def _show_shared(self, cell: Cell) -> None:
        """The shade on every space that two arms share, and the lines of a pair's chart."""
        meshes = [shared_mesh(cell, space) for space in cell.graph.edges.values()]
        if meshes:
            starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
            vertices = np.concatenate([vertices for vertices, _ in meshes])
            faces = np.concatenate([start + faces for start, (_, faces) in zip(starts, meshes, strict=False)]).astype(np.uint32)
            self._shared = self.server.scene.add_mesh_simple(
                "/shared", metres(vertices), faces, color=rgb(SHARED), opacity=0.45, side="double", cast_shadow=False, receive_shadow=False
            )
        elif self._shared is not None:
            self._shared.visible = False
        lines = chart_lines(cell) if cell.num_arms == 2 and cell.graph.edges else []
        for number, line in enumerate(lines):
            self._line(f"/chart_{number}", _polyline(line, _CHART_MM), SHARED, 0.7)
        for name, handle in self._lines.items():
            if name.startswith("/chart_") and int(name.removeprefix("/chart_")) >= len(lines):
                handle.visible = False

    def _show_discs(self, cell: Cell) -> None:
        """Obstacles, and around each of them what the middle of a block keeps off."""
        for number, (obstacle, edge) in enumerate(zip(cell.config.obstacles, cell.keep_out, strict=True)):
            if number == len(self._discs):
                self._discs.append(DiscNodes(self.server, number))
            self._discs[number].show((obstacle.x_mm, obstacle.y_mm), obstacle.radius_mm, edge.radius_mm)
        for disc in self._discs[len(cell.keep_out) :]:
            disc.hide()

    def _show_dials(self, cell: Cell | None) -> None:
        """A circle of all angles on each shared space, 0 deg to +x of the table; those that the two offer are thick."""
        spaces = list(cell.graph.edges.values()) if cell is not None else []
        thin, thick = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3))]
        for number, space in enumerate(spaces):
            middle, arcs = dial(space)
            thin.append(_polyline(middle + _DIAL_RADIUS_MM * _circle(0.0, 2 * math.pi), _DIAL_MM))
            thick.extend(_polyline(middle + _DIAL_RADIUS_MM * _circle(*arc), _DIAL_MM) for arc in arcs)
            text = ", ".join(f"{math.degrees(low):.0f}–{math.degrees(high):.0f}°" for low, high in arcs)
            at = metres([middle[0] - 1.2 * _DIAL_RADIUS_MM, middle[1], _DIAL_MM])
            if number == len(self._dials):
                self._dials.append(self.server.scene.add_label(f"/dial_{number}", "", position=at, anchor="top-center"))
            label = self._dials[number]
            label.position, label.text, label.visible = at, text, True
        for label in self._dials[len(spaces) :]:
            label.visible = False
        self._line("/dials", np.concatenate(thin), GREY, 1.0)
        self._line("/dial_arcs", np.concatenate(thick), INK, 4.0)

    def _line(self, name: str, segments: Floats, colour: str, width_px: float) -> None:
        """Segments (n, 2, 3) in mm; none at all are not seen."""
        handle = self._lines.get(name)
        if handle is None:
            if not len(segments):
                return
            self._lines[name] = handle = self.server.scene.add_line_segments(
                name, metres(segments), colors=rgb(colour), thickness=width_px, thickness_units="screen"
            )
        drawn = segments.tobytes(), colour
        if len(segments) and self._drawn.get(name) != drawn:
            handle.points, handle.colors = metres(segments).astype(np.float32), np.array(rgb(colour), np.uint8)
            self._drawn[name] = drawn
        handle.visible = len(segments) > 0


class DiscNodes:
    """A keep-out disc: the obstacle, and a line around where the middle of a block may not be."""

    def __init__(self, server: viser.ViserServer, number: int) -> None:
        self.name = f"/disc_{number}"
        self._frame = server.scene.add_frame(self.name, show_axes=False, visible=False)
        self._body = server.scene.add_cylinder(f"{self.name}/body", radius=1.0, height=_DISC_MM / 1000, color=rgb(ALERT), opacity=0.55)
        edge = _polyline(_circle(0.0, 2 * math.pi), _DIAL_MM)
        self._edge = server.scene.add_line_segments(
            f"{self.name}/edge", metres(edge), colors=rgb(ALERT), thickness=1.2, thickness_units="screen"
        )

    @property
    def body(self) -> str:
        """Name of the node to be dragged."""
        return f"{self.name}/body"

    def show(self, place_mm: ArrayLike, radius_mm: float, edge_mm: float) -> None:
        """The obstacle lies at a place (2,)."""
        x_mm, y_mm = np.asarray(place_mm, float)
        self._frame.position, self._frame.visible = metres([x_mm, y_mm, _DISC_MM / 2]), True
        radius_m = float(metres(radius_mm))
        if self._body.radius != radius_m:
            self._body.radius = radius_m
            self._edge.points = metres(_polyline(edge_mm * _circle(0.0, 2 * math.pi), 0.0)).astype(np.float32)

    def hide(self) -> None:
        """It is not there."""
        self._frame.visible = False


def outline_of(arm: Arm) -> Floats:
    """The closed outline (n, 2) in mm of the annulus sector where an arm can pick and place."""
    yaw = np.linspace(*arm.yaw_rad, _POINTS)
    return np.concatenate([arm.at(arm.r_max_mm, yaw), arm.at(arm.r_min_mm, yaw[::-1]), arm.at(arm.r_max_mm, yaw[:1])])


def sector_outline(cell: Cell, arm: int) -> Floats:
    """:func:`outline_of` of an arm's index."""
    return outline_of(cell.arms[arm])


def shared_mesh(cell: Cell, space: SharedSpace | None = None) -> tuple[Floats, NDArray[np.uint32]]:
    """Vertices (n, 3) in mm and triangles (m, 3) of a space that two arms share; None: that of a pair."""
    space = cell.shared if space is None else space
    if cell.num_arms == 2 and isinstance(space.chart, PaperChart):
        alpha = np.linspace(-1.0, 1.0, _POINTS)
        sides = np.stack([space.to_table(alpha, np.full(_POINTS, beta)) for beta in (-1.0, 1.0)], 1).reshape(-1, 2)
        first = 2 * np.arange(_POINTS - 1)[:, None]
        faces = np.concatenate([first + [0, 2, 1], first + [1, 2, 3]])
    else:
        sides, faces = _strips(cell, space)
    return np.concatenate([sides, np.full((len(sides), 1), _SHADE_MM)], -1), faces.astype(np.uint32)


def _strips(cell: Cell, space: SharedSpace) -> tuple[Floats, NDArray[np.int64]]:
    """The same of any space: (n, 2) and (m, 3). On each ray from the first base it is some intervals, joined with the next."""
    first = space.first
    radius = np.linspace(first.r_min_mm, first.r_max_mm, RINGS)

    def shared(r: Floats, at: Floats) -> NDArray[np.bool_]:
        place = first.at(r, at)
        return space.second.reaches(place) & np.asarray(cell.is_clear(place), bool)

    def seen(yaw: Floats) -> NDArray[np.bool_]:
        return shared(np.tile(radius, (len(yaw), 1)), np.tile(yaw[:, None], (1, RINGS)))

    yaw = np.linspace(*first.yaw_rad, RAYS)
    found = np.flatnonzero(seen(yaw).any(1))
    if len(found):
        yaw = np.linspace(yaw[max(found[0] - 1, 0)], yaw[min(found[-1] + 1, RAYS - 1)], RAYS)
    inside = np.zeros((RAYS, RINGS + 2), np.int8)
    inside[:, 1:-1] = seen(yaw)
    step = np.diff(inside, axis=1)
    begins, ends = np.argwhere(step == 1), np.argwhere(step == -1)  # in step with each other: ray by ray, from the inside outwards
    lows = _edges(shared, radius, yaw, begins[:, 0], begins[:, 1] - 1, begins[:, 1])
    highs = _edges(shared, radius, yaw, ends[:, 0], ends[:, 1], ends[:, 1] - 1)
    rays = begins[:, 0]
    sides = np.stack([first.at(lows, yaw[rays]), first.at(highs, yaw[rays])], 1).reshape(-1, 2)
    joined = [
        (one, other)
        for one in range(len(rays))
        for other in range(int(np.searchsorted(rays, rays[one] + 1)), int(np.searchsorted(rays, rays[one] + 2)))
        if lows[one] <= highs[other] and lows[other] <= highs[one]
    ]
    one, other = 2 * np.array(joined, np.int64).reshape(-1, 2).T
    return sides, np.concatenate([np.stack([one, other, one + 1], -1), np.stack([other, other + 1, one + 1], -1)])


def _edges(
    shared: object, radius: Floats, yaw: Floats, rays: NDArray[np.int64], outside: NDArray[np.int64], inside: NDArray[np.int64]
) -> Floats:
    """Radii (n,) at which rays cross the edge between two of ``radius``, one ``outside`` and one ``inside``; beyond all, the last one."""
    assert callable(shared)
    ends = (outside < 0) | (outside >= len(radius))
    good, bad = radius[inside], radius[np.clip(outside, 0, len(radius) - 1)]
    for _ in range(HALVINGS):
        middle = (good + bad) / 2
        within = shared(middle, yaw[rays])
        good, bad = np.where(within, middle, good), np.where(within, bad, middle)
    return np.where(ends, radius[inside], good)


def dial(space: SharedSpace) -> tuple[Floats, list[tuple[float, float]]]:
    """A place (2,) in a shared space, and the hand-over angles from its first arm to its second that it offers, as intervals in rad."""
    arcs = [(arc.low_rad, arc.low_rad + arc.width_rad) for arc in space.chart.arcs]
    widest = max(arcs, key=lambda arc: arc[1] - arc[0])
    return np.asarray(space.in_world(space.chart.at_angle(np.array(sum(widest) / 2)))), arcs


def _circle(low_rad: float, high_rad: float) -> Floats:
    """Points (n, 2) on a circle of radius 1."""
    angle = np.linspace(low_rad, high_rad, max(2, math.ceil(_POINTS * (high_rad - low_rad) / (2 * math.pi))))
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _polyline(points_mm: Floats, height_mm: float) -> Floats:
    """Segments (n, 2, 3) in mm of a line through points (n + 1, 2)."""
    points = np.concatenate([points_mm, np.full((len(points_mm), 1), height_mm)], -1)
    return np.stack([points[:-1], points[1:]], 1)


def chart_lines(cell: Cell) -> list[Floats]:
    """Lines (n, 2) in mm of constant alpha and of constant beta."""
    values, along = np.linspace(-1.0, 1.0, _CHART_LINES), np.linspace(-1.0, 1.0, _POINTS)
    across = np.array([-1.0, 1.0])
    lines = [cell.shared.to_table(along, np.full(_POINTS, beta)) for beta in values]
    return lines + [cell.shared.to_table(np.full(2, alpha), across) for alpha in values[1:-1]]

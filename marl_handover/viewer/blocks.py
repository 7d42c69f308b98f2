"""Blocks in the scene: the real one, the ghost at the goal, the numbered ghosts of a plan. An arrow on top shows the yaw."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from marl_handover.config import BlockConfig
from marl_handover.palette import GREY, INK
from marl_handover.viewer.units import Colour, flat, metres, rgb, turned

Floats = NDArray[np.float64]

BEECH = (214, 170, 110)

# The arrow in shares of the block's side: tail and head, left and right.
_ARROW = np.array([[-0.36, 0.07], [0.08, 0.07], [0.08, 0.24], [0.4, 0.0], [0.08, -0.24], [0.08, -0.07], [-0.36, -0.07]])
_ARROW_FACES = np.array([[0, 6, 1], [1, 6, 5], [2, 4, 3]], np.uint32)
_ABOVE_MM = 0.5


class BlockNodes:
    """One block; its frame has the origin in the middle of the lower face.

    Args:
        server: of the page.
        name: of the frame.
        block: sizes.
        colour: of the body.
        opacity: below 1 for a ghost, which has edges and no pin.
        height_mm: of the body; None: the block's own.
        arrow: colour of the arrow.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        block: BlockConfig,
        colour: Colour,
        opacity: float | None = None,
        height_mm: float | None = None,
        arrow: Colour | None = None,
    ) -> None:
        side, high = block.side_mm, block.height_mm if height_mm is None else height_mm
        ghost = opacity is not None
        self._placed: tuple[bytes, ...] | None = None
        self.frame = server.scene.add_frame(name, show_axes=False, visible=False)
        self._body = server.scene.add_box(
            f"{name}/body",
            color=colour,
            dimensions=metres([side, side, high]),
            position=metres([0, 0, high / 2]),
            opacity=opacity,
            cast_shadow=not ghost,
            receive_shadow=not ghost,
        )
        points = np.concatenate([side * _ARROW, np.full((len(_ARROW), 1), high + _ABOVE_MM)], -1)
        server.scene.add_mesh_simple(
            f"{name}/arrow", metres(points), _ARROW_FACES, color=arrow or rgb(INK), side="double", cast_shadow=False, receive_shadow=False
        )
        self._edges = _add_edges(server, f"{name}/edges", side, high, colour) if ghost else None
        if not ghost:
            long = block.pin_top_mm - high
            pin, at = metres([block.pin_diameter_mm / 2, long]), metres([0, 0, high + long / 2])
            server.scene.add_cylinder(f"{name}/pin", radius=float(pin[0]), height=float(pin[1]), color=rgb(GREY), position=at)

    def show(self, where: ArrayLike | None, height_mm: float = 0.0) -> None:
        """Put it at a pose (3,) at a height above the table, or at ``T_world_block`` (4, 4) in mm; None hides it."""
        if where is not None:
            array = np.asarray(where, float)
            wxyz, position = (turned(array[:3, :3]), metres(array[:3, 3])) if array.shape == (4, 4) else flat(array, height_mm)
            placed = (wxyz.tobytes(), position.tobytes())
            if placed != self._placed:
                self._placed = placed
                self.frame.wxyz, self.frame.position = wxyz, position
        self.frame.visible = where is not None

    def paint(self, colour: Colour) -> None:
        """Give body and edges another colour."""
        if tuple(self._body.color) != colour:
            self._body.color = colour
            if self._edges is not None:
                self._edges.colors = np.array(colour, np.uint8)


def _add_edges(server: viser.ViserServer, name: str, side_mm: float, high_mm: float, colour: Colour) -> viser.LineSegmentsHandle:
    half = side_mm / 2
    corners = np.array([[half, half], [-half, half], [-half, -half], [half, -half]])
    low, high = (np.concatenate([corners, np.full((4, 1), z)], -1) for z in (0.0, high_mm))
    around = [np.stack([ring, np.roll(ring, -1, 0)], 1) for ring in (low, high)]
    segments = np.concatenate([*around, np.stack([low, high], 1)])
    return server.scene.add_line_segments(name, metres(segments), colors=colour, thickness=1.5, thickness_units="screen")

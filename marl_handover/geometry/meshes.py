"""Meshes as boxes: what clearances and physics know of a link's STL, OBJ or DAE file.

The boxes stand around the mesh's hull. A long mesh that fills its one box badly is cut along its longest side, and each piece gets a box.
What came out is kept in the user's cache folder, under the content of the file.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import re
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.errors import CannotWrite, CorruptFile, HandoverError, MissingExtra, MissingFile
from marl_handover.files import MEGABYTE, cache_folder, read_arrays, read_bounded, writing
from marl_handover.geometry.se3 import rpy_of, transform
from marl_handover.geometry.urdf import Mesh, Primitive

LARGEST_FILE = 64 * MEGABYTE
FORMATS = (".stl", ".obj", ".dae")
MOST_BOXES, ENOUGH = 4, 1.15
"""A mesh gets the fewest boxes, up to so many, that take no more room than this times what the most take."""

THINNEST_MM, LONGEST_MM = 1.0, 1e5
_VERSION = b"1"
_COLLADA_UNIT = re.compile(rb"<unit\b[^>]*\bmeter=[\"']([^\"']+)")


def mesh_boxes(mesh: Mesh, link: str) -> tuple[tuple[Primitive, ...], bool]:
    """Boxes in the frame of ``link`` that cover its mesh, and whether the mesh is watertight.

    Raises:
        MissingFile: there is no such file; the error names the link and what to do without one.
        CorruptFile, MissingExtra: it is no mesh, or one that needs a package more.
    """
    if not mesh.path.is_file():
        fix = "put it there, or set shapes=links (capsules along the links) or shapes=none"
        raise MissingFile(f"mesh of link {link!r},", mesh.path, fix)
    boxes, watertight = _boxes(mesh.path, mesh.path.stat().st_mtime_ns, mesh.scale)
    T_link_mesh = transform(mesh.xyz_mm, mesh.rpy_rad)
    primitives = []
    for row in boxes:
        T = T_link_mesh @ transform(row[:3], row[3:6])
        x, y, z = (float(value) for value in T[:3, 3])
        primitives.append(Primitive("box", tuple(float(edge) for edge in row[6:]), (x, y, z), rpy_of(T[:3, :3])))
    return tuple(primitives), watertight


@lru_cache(maxsize=256)
def _boxes(path: Path, changed_ns: int, scale: tuple[float, float, float]) -> tuple[Floats, bool]:
    """Boxes (n, 9) of a file: centre in mm, roll, pitch and yaw, edges in mm, all in the mesh's frame; ``changed_ns``: of which time."""
    content = read_bounded(path, LARGEST_FILE, "mesh")
    key = hashlib.sha256(b"".join((_VERSION, path.suffix.lower().encode(), repr(scale).encode(), content))).hexdigest()
    kept = cache_folder() / f"mesh_{key[:32]}.npz"
    with suppress(HandoverError, KeyError):
        arrays = read_arrays(kept, MEGABYTE, "kept mesh")
        if arrays["boxes"].shape[1:] == (9,) and np.isfinite(arrays["boxes"]).all():
            return arrays["boxes"], bool(arrays["watertight"])
    vertices, edges, watertight = _read(path, content, scale)
    boxes = _around(vertices, edges)
    with suppress(OSError, CannotWrite):  # a cache that cannot be written costs time only
        kept.parent.mkdir(parents=True, exist_ok=True)
        with writing(kept) as stream:
            np.savez(stream, boxes=boxes, watertight=np.array(watertight))
    return boxes, watertight


def _read(path: Path, content: bytes, scale: tuple[float, float, float]) -> tuple[Floats, Any, bool]:
    """Vertices (n, 3) in mm, edges (m, 2) as indices of them, and whether the mesh is watertight."""
    import trimesh  # here: most cells have no meshes

    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise CorruptFile("mesh", path, f"it is no {', '.join(FORMATS)} file")
    try:
        loaded: Any = trimesh.load(io.BytesIO(content), file_type=kind[1:], force="mesh", process=True)
        vertices, edges, watertight = np.asarray(loaded.vertices, float), loaded.edges_unique, bool(loaded.is_watertight)
        unit = _COLLADA_UNIT.search(content) if kind == ".dae" else None
        metres = float(unit.group(1)) if unit else 1.0
    except ImportError as error:
        raise MissingExtra(f"the mesh {path.name}", "pycollada", "collada") from error
    except Exception as error:  # its readers raise many kinds
        raise CorruptFile("mesh", path, f"it cannot be read: {str(error)[:80]}") from error
    vertices = vertices * (1000.0 * metres * np.asarray(scale))
    if len(vertices) < 3 or not np.isfinite(vertices).all() or np.abs(vertices).max() > LONGEST_MM:
        raise CorruptFile("mesh", path, "it has no triangles, or numbers that are none or too large")
    return vertices, edges, watertight


def _around(vertices: Floats, edges: Any) -> Floats:
    """The boxes (n, 9) around a mesh: the fewest that fill the room nearly as well as :data:`MOST_BOXES` do."""
    import trimesh

    try:
        to_box, _ = trimesh.bounds.oriented_bounds(vertices)
    except Exception:  # a flat one has no hull
        to_box = np.eye(4)
    local = vertices @ to_box[:3, :3].T + to_box[:3, 3]
    T_mesh_box = np.linalg.inv(to_box)
    candidates = [_pieces(local, edges, count) for count in range(1, MOST_BOXES + 1)]
    rooms = [float(np.prod(piece[:, 3:], axis=1).sum()) for piece in candidates]
    chosen = next(piece for piece, room in zip(candidates, rooms, strict=True) if room <= ENOUGH * min(rooms))
    turn = rpy_of(T_mesh_box[:3, :3])
    centres = chosen[:, :3] @ T_mesh_box[:3, :3].T + T_mesh_box[:3, 3]
    return np.concatenate([centres, np.tile(turn, (len(chosen), 1)), chosen[:, 3:]], axis=1)


def _pieces(points: Floats, edges: Any, count: int) -> Floats:
    """Centres and edges (n, 6) of upright boxes around ``count`` slices of a mesh, cut across its longest side; empty slices have none."""
    axis = int(np.argmax(np.ptp(points, axis=0)))
    cuts = np.linspace(points[:, axis].min(), points[:, axis].max(), count + 1)
    start, end = points[edges[:, 0]], points[edges[:, 1]]
    crossings = []
    for cut in cuts[1:-1]:
        low, high = start[:, axis] - cut, end[:, axis] - cut
        through = low * high < 0
        share = (low[through] / (low[through] - high[through]))[:, None]
        crossings.append(start[through] + share * (end[through] - start[through]))
    around = np.concatenate([points, *crossings])
    boxes = []
    for low, high in itertools.pairwise(cuts):
        inside = around[(around[:, axis] >= low - 1e-9) & (around[:, axis] <= high + 1e-9)]
        if len(inside):
            least, most = inside.min(axis=0), inside.max(axis=0)
            boxes.append([*((least + most) / 2), *np.maximum(most - least, THINNEST_MM)])
    return np.array(boxes)

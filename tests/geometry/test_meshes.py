"""Meshes as boxes, against the mesh's own points."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from marl_handover.errors import CorruptFile, MissingFile
from marl_handover.files import cache_folder
from marl_handover.geometry import meshes
from marl_handover.geometry.meshes import MOST_BOXES, mesh_boxes
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import Mesh

MM = (0.001, 0.001, 0.001)
ORIGIN = ((5.0, -3.0, 2.0), (0.3, -0.5, 1.0))


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    meshes._boxes.cache_clear()


BOX, BALL = trimesh.creation.box((60.0, 40.0, 20.0)), trimesh.creation.icosphere(radius=30.0)


def bent_arm():
    """An L of two boxes: its one box would be mostly empty."""
    one, other = trimesh.creation.box((200.0, 20.0, 20.0)), trimesh.creation.box((20.0, 20.0, 100.0))
    other.apply_translation((90.0, 0.0, 60.0))
    return trimesh.util.concatenate([one, other])


def written(shape, path):
    shape.export(path)
    return Mesh(path, MM, *ORIGIN)


def outside_mm(boxes, mesh: Mesh, points):
    """How far points of the mesh's file, in mm, are outside of all boxes."""
    T = transform(mesh.xyz_mm, mesh.rpy_rad)
    points = points @ T[:3, :3].T + T[:3, 3]
    gaps = []
    for box in boxes:
        T_box = transform(box.xyz_mm, box.rpy_rad)
        local = np.abs((points - T_box[:3, 3]) @ T_box[:3, :3]) - np.asarray(box.size_mm) / 2
        gaps.append(local.max(axis=1))
    return np.min(gaps, axis=0)


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
@pytest.mark.parametrize("shape", [BOX, BALL, trimesh.creation.capsule(100.0, 15.0), bent_arm()])
def test_every_point_of_a_mesh_is_in_its_boxes(tmp_path, shape, suffix):
    mesh = written(shape, tmp_path / f"part{suffix}")
    boxes, _ = mesh_boxes(mesh, "forearm")
    points, _ = trimesh.sample.sample_surface(shape, 2000, seed=0)
    assert 1 <= len(boxes) <= MOST_BOXES
    assert outside_mm(boxes, mesh, np.concatenate([points, shape.vertices])).max() < 1e-3


def test_a_box_stays_one_box_and_what_is_bent_becomes_several(tmp_path):
    boxes, watertight = mesh_boxes(written(BOX, tmp_path / "box.stl"), "forearm")
    assert len(boxes) == 1
    assert watertight
    assert sorted(boxes[0].size_mm) == pytest.approx([20.0, 40.0, 60.0], abs=1e-3)
    several, _ = mesh_boxes(written(bent_arm(), tmp_path / "bent.stl"), "forearm")
    room = sum(np.prod(box.size_mm) for box in several)
    assert len(several) > 1
    assert room < 0.7 * 200.0 * 20.0 * 120.0


def test_scale_and_units(tmp_path):
    shape = trimesh.creation.box((0.06, 0.04, 0.02))
    path = tmp_path / "metres.stl"
    shape.export(path)
    (box,), _ = mesh_boxes(Mesh(path, (1.0, 1.0, 2.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "forearm")
    assert sorted(box.size_mm) == pytest.approx([40.0, 40.0, 60.0], abs=1e-3)


def test_what_is_not_watertight_is_covered_and_told(tmp_path):
    shape = trimesh.creation.box((60.0, 40.0, 20.0))
    shape.update_faces(np.arange(len(shape.faces)) > 1)
    boxes, watertight = mesh_boxes(written(shape, tmp_path / "open.stl"), "forearm")
    assert not watertight
    assert sorted(boxes[0].size_mm) == pytest.approx([20.0, 40.0, 60.0], abs=1e-3)


def test_a_flat_mesh_gets_a_thin_box(tmp_path):
    flat = trimesh.Trimesh(vertices=[[0, 0, 0], [50, 0, 0], [50, 30, 0], [0, 30, 0]], faces=[[0, 1, 2], [0, 2, 3]])
    boxes, _ = mesh_boxes(written(flat, tmp_path / "flat.stl"), "forearm")
    assert min(boxes[0].size_mm) == pytest.approx(1.0)


def test_boxes_are_kept_by_the_content_of_the_file(tmp_path, monkeypatch):
    mesh = written(trimesh.creation.icosphere(radius=30.0), tmp_path / "ball.stl")
    first, _ = mesh_boxes(mesh, "forearm")
    assert len(list(cache_folder().glob("mesh_*.npz"))) == 1
    meshes._boxes.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(meshes, "_read", lambda *_: pytest.fail("the mesh was read again"))
        assert mesh_boxes(mesh, "forearm")[0] == first
    written(trimesh.creation.icosphere(radius=40.0), mesh.path)
    meshes._boxes.cache_clear()
    larger, _ = mesh_boxes(mesh, "forearm")
    assert max(larger[0].size_mm) > max(first[0].size_mm)


def test_missing_and_broken_meshes_are_named(tmp_path):
    with pytest.raises(MissingFile, match=r"link 'forearm'.*away\.stl.*shapes=links"):
        mesh_boxes(Mesh(tmp_path / "away.stl", MM, *ORIGIN), "forearm")
    broken = {"torn.stl": b"solid but not", "empty.obj": b"", "odd.step": b"ISO-10303-21;", "nan.obj": b"v nan 0 0\nf 1 1 1\n"}
    for name, content in broken.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(CorruptFile, match=name.replace(".", r"\.")):
            mesh_boxes(Mesh(path, MM, *ORIGIN), "forearm")

"""What a robot's shapes are taken from: its file, its links, or nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from marl_handover.cell import build_cell
from marl_handover.config import CellConfig
from marl_handover.errors import MissingFile, UrdfError
from marl_handover.files import resource_path
from marl_handover.geometry.capsules import capsule_pairs, segment_distance
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.link_shapes import with_shapes
from marl_handover.geometry.robot import read_robot, robot_config
from marl_handover.geometry.se3 import apply
from marl_handover.geometry.urdf import Mesh, Primitive, Visual, read_urdf
from marl_handover.motion.planner import MotionPlanner

ARM = read_robot(robot_config("al5a"))


def changed(**links):
    """The shipped arm with other content of some links."""
    description = ARM.description
    return ClosedFormArm(replace(description, links=tuple(replace(link, **links.get(link.name, {})) for link in description.links)))


def test_primitives_of_the_file_stay_as_they_are():
    assert with_shapes(ARM, "file") is ARM.description


def test_shapes_along_the_links_follow_the_arm():
    """Shoulder, elbow, wrist and the way to the hand are inside the shapes, in any posture, and the grip is free."""
    arm = ClosedFormArm(with_shapes(ARM, "links"))
    capsules = capsule_pairs(arm.description)[0]
    assert {capsule.link for capsule in capsules} == {
        *("base_link", "turret", "upper_arm", "forearm", "wrist", "hand"),
    }
    for q in np.random.default_rng(0).uniform(arm.lower_rad, arm.upper_rad, (20, 5)):
        frames = arm.link_transforms(q)
        ends = [(apply(frames[c.link], c.start_mm), apply(frames[c.link], c.end_mm), c.radius_mm) for c in capsules]

        def depth(point, ends=ends):
            return min(float(segment_distance(point, point, start, end)) - radius for start, end, radius in ends)

        for link in ("upper_arm", "forearm", "wrist"):
            assert depth(frames[link][:3, 3]) < 0.0
        assert depth((frames["upper_arm"][:3, 3] + frames["forearm"][:3, 3]) / 2) < -5.0
        assert depth(arm.fk(q)[:3, 3]) > 5.0


def test_an_arm_without_shapes_collides_with_nothing_and_asks_before_it_moves():
    free = build_cell(CellConfig(robot="al5a", shapes="none", base_distance_mm=440.0))
    shaped = build_cell(CellConfig(robot="al5a", base_distance_mm=440.0))
    assert free.fit.r_min_mm <= shaped.fit.r_min_mm
    assert (free.grid.masks | ~shaped.grid.masks).all()
    with pytest.raises(UrdfError, match="shapes=links"):
        MotionPlanner(free)


def test_an_arm_with_shapes_along_its_links_plans_motions():
    model = build_cell(CellConfig(robot="al5a", shapes="links", base_distance_mm=440.0))
    planner, base, fit = MotionPlanner(model), model.cell.bases[0], model.fit
    assert any("shapes" in note for note in model.arm.description.assumed)
    for radius in (fit.r_min_mm, fit.r_max_mm):
        motion = planner.plan_paths(0, base.around(radius, -0.4), base.around(radius, 0.5), planner.home_rad, planner.home_rad)
        assert motion.path_length_mm > 0.0


def test_meshes_become_boxes_and_are_told(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trimesh.creation.box((0.09, 0.02, 0.016)).export(tmp_path / "forearm.stl")
    mesh = Mesh(tmp_path / "forearm.stl", (1.0, 1.0, 1.0), (51.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    arm = changed(forearm={"collisions": (), "meshes": (mesh,)})
    shaped = with_shapes(arm, "file")
    link = next(link for link in shaped.links if link.name == "forearm")
    assert link.meshes == ()
    assert [shape.kind for shape in link.collisions] == ["box"]
    assert any("forearm.stl" in note for note in shaped.assumed)
    missing = changed(forearm={"collisions": (), "meshes": (replace(mesh, path=tmp_path / "away.stl"),)})
    with pytest.raises(MissingFile, match="shapes=links"):
        with_shapes(missing, "file")
    assert with_shapes(missing, "links").links[3].collisions


def test_a_link_that_is_only_seen_is_taken_as_it_looks():
    seen = Primitive("box", (90.0, 20.0, 16.0), (51.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    shaped = with_shapes(changed(forearm={"collisions": (), "visuals": (Visual(seen),)}), "file")
    assert next(link for link in shaped.links if link.name == "forearm").collisions == (seen,)
    assert any("'forearm' has no collision shape" in note for note in shaped.assumed)


def test_too_many_shapes_are_refused():
    many = tuple(Primitive("sphere", (5.0,), (float(k), 0.0, 0.0), (0.0, 0.0, 0.0)) for k in range(300))
    with pytest.raises(UrdfError, match="may have 200"):
        with_shapes(changed(forearm={"collisions": many}), "file")
    assert read_urdf(resource_path("urdf/al5a.urdf")).links

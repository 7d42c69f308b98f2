"""Robot descriptions that differ from one that works in their shapes alone: they work like it, or say in one line what to do."""

from __future__ import annotations

import numpy as np
import pytest
from cases import PUBLIC, RINGS_MM, SMALL

from marl_handover import cli
from marl_handover.cell import build_cell
from marl_handover.config import BlockConfig, CellConfig
from marl_handover.errors import HandoverError
from marl_handover.motion.planner import MotionPlanner

LIMITS = {
    "base_yaw": [-120.0, 120.0],
    "shoulder": [-34.4, 177.6],
    "elbow": [-160.4, 45.8],
    "wrist_pitch": [-120.3, 97.4],
    "wrist_roll": [-177.0, 177.0],
}
pytestmark = pytest.mark.skipif(not SMALL.is_dir(), reason="the cases are not here")


def cell_of(name, **settings):
    return build_cell(CellConfig(robot=str(SMALL / f"{name}.urdf"), base_distance_mm=460.0, joint_limits_deg=LIMITS, **settings))


def require_motions(model, count):
    """Motions between places of the ring, its edges first, are all found."""
    planner, fit, base, generator = MotionPlanner(model), model.fit, model.cell.bases[0], np.random.default_rng(0)
    for number in range(count):
        radii = (fit.r_min_mm, fit.r_max_mm) if number == 0 else generator.uniform(fit.r_min_mm, fit.r_max_mm, 2)
        pick, place = (base.around(radius, yaw) for radius, yaw in zip(radii, generator.uniform(0.1, 1.2, 2) * [-1, 1], strict=True))
        planner.plan_paths(0, pick, place, planner.homes_rad[0], planner.homes_rad[1:])


# The base of `real_base` is wide but low: as boxes, base and upper arm meet in no grasp.
@pytest.mark.parametrize("name", ["base_plate", "base_foot", "chunky_hand", "visual_mesh", "real_base"])
def test_plates_feet_tall_hands_and_pictures_work_like_the_base(name):
    base, model = cell_of("base"), cell_of(name)
    assert model.fit == base.fit
    np.testing.assert_array_equal(model.grid.masks, base.grid.masks)
    require_motions(model, 6)


@pytest.mark.parametrize("name", ["mesh", "no_collision"])
def test_capsules_along_the_links_stand_in_for_what_is_not_there(name):
    model = cell_of(name, shapes="links")
    assert model.fit == cell_of("base").fit
    require_motions(model, 6)


@pytest.mark.parametrize(("name", "said"), [("mesh", "forearm.stl"), ("no_collision", "no link has a collision shape")])
def test_what_is_missing_is_one_line_with_the_fix(name, said, capsys, tmp_path):
    limits = ",".join(f"{joint}:[{low},{high}]" for joint, (low, high) in LIMITS.items())
    keys = [f"robot={SMALL / name}.urdf", "cell.base_distance_mm=460", f"cell.joint_limits_deg={{{limits}}}"]
    assert cli.main(["plan", *keys, "start=[-150,-60,0]", "goal=[150,60,90]", f"motion={tmp_path / 'motion.json'}"]) == 2
    line = capsys.readouterr().err.strip()
    assert said in line
    assert "shapes=links" in line
    assert len(line.splitlines()) == 1
    assert len(line) <= 300


# The published ring of the Lite 6 begins 16 mm farther out than what its joint limits give here, whatever the shapes.
@pytest.mark.parametrize("name", sorted(set(RINGS_MM) - {"lite6"}))
def test_public_robots_without_their_meshes_reach_their_rings(name):
    path = PUBLIC / f"{name}.urdf"
    if not path.is_file():
        pytest.skip("the public files are not here")
    height, low, high = RINGS_MM[name]
    block = BlockConfig(pin_top_mm=height + 20.0)
    distance = 10.0 * round(0.156 * high)
    model = build_cell(CellConfig(robot=str(path), shapes="links", pick_height_mm=height, base_distance_mm=distance, block=block))
    assert (model.fit.r_min_mm, model.fit.r_max_mm) == pytest.approx((low, high), abs=5.0)
    require_motions(model, 3)
    with pytest.raises(HandoverError, match=r"mesh of link .*shapes=links"):
        build_cell(CellConfig(robot=str(path), pick_height_mm=height, base_distance_mm=distance, block=block))

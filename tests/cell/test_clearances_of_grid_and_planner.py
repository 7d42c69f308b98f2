"""The grid and the motion planner ask for the same clearances: what the ring promises, an arm can do."""

from __future__ import annotations

import numpy as np
import pytest

from marl_handover.cell import CellModel, build_cell
from marl_handover.cell.reach import bound_by, grasps
from marl_handover.config import BlockConfig, CellConfig, MotionConfig
from marl_handover.errors import HandoverError
from marl_handover.files import resource_path
from marl_handover.geometry.capsules import block_capsules, grasp_margins_mm
from marl_handover.motion.objective import dense_margins
from marl_handover.motion.planner import MotionPlanner

LIMITS = {
    "base_yaw": [-95.0, 95.0],
    "shoulder": [-14.0, 150.0],
    "elbow": [-167.0, 0.0],
    "wrist_pitch": [-95.0, 100.0],
    "wrist_roll": [-90.0, 90.0],
}
PLATE = ("base_link", "-0.03 0 0.002", "0.1 0.1 0.004")
FOOT = ("base_link", "-0.04 0 0.002", "0.05 0.006 0.004")
TALL_HAND = ("hand", "0.017 0 0", "0.028 0.05 0.05")
PLINTH = ("base_link", "0 0 0.015", "0.1 0.1 0.03")
SHELLS = [("base_link", "0 0 0.06", "0.05 0.05 0.05"), ("upper_arm", "0.01 0 0", "0.05 0.05 0.05")]
ADDED = {"none": (), "plate": (PLATE,), "foot": (FOOT,), "tall hand": (TALL_HAND,), "plinth": (PLINTH,)}


def cell_with(shapes, folder, **settings) -> CellModel:
    """The shipped arm with more boxes on its links."""
    text = resource_path("urdf/al5a.urdf").read_text()
    for link, xyz, size in shapes:
        box = f'<collision><origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry></collision>'
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{box}')
    path = folder / "arm.urdf"
    path.write_text(text)
    return build_cell(CellConfig(robot=str(path), base_distance_mm=440.0, joint_limits_deg=LIMITS, **settings))


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    return {name: cell_with(shapes, tmp_path_factory.mktemp("arm")) for name, shapes in ADDED.items()}


def planned_margins(planner: MotionPlanner, q, holding: bool):
    """What the planner leaves at a posture (4,) to the arm itself and to the table."""
    out = np.empty(6)
    dense_margins(np.stack([q, q]), planner._scene(0, holding, np.zeros((0, 9)), 0, np.zeros(8)), out)
    return out[2], out[3]


@pytest.mark.parametrize("name", ADDED)
def test_margins_of_a_grasp_are_those_of_the_planner(cells, name):
    model = cells[name]
    planner, generator = MotionPlanner(model), np.random.default_rng(1)
    polar = np.stack([generator.uniform(100.0, 330.0, 200), generator.uniform(-1.6, 1.6, 200)], axis=-1)
    q, good = grasps(model.arm, polar[:, :1] * np.stack([np.cos(polar[:, 1]), np.sin(polar[:, 1])], axis=-1), 45.0)
    block = block_capsules(model.cell.config.block, 45.0)
    for joints in q[good][:40]:
        for holding in (False, True):
            margins = grasp_margins_mm(model.arm, joints, planner.motion, block if holding else ())
            hand = ("wrist", "hand", "finger_left_link", "finger_right_link")
            itself = min(float(value) for (one, other), value in margins.items() if other != "the table" and other not in ("block", "pin"))
            held = [float(value) for (one, other), value in margins.items() if other in ("block", "pin") and one not in hand]
            ground = min(float(value) for (_, other), value in margins.items() if other == "the table")
            expected_self, expected_ground = planned_margins(planner, joints[:4], holding)
            mine = min([itself, *held])
            # The planner leaves out pairs that it proved to be farther apart than 3 mm over what is demanded.
            assert expected_self == pytest.approx(mine, abs=1e-6) or (expected_self > mine >= 3.0)
            assert expected_ground == pytest.approx(ground, abs=1e-6)


@pytest.mark.parametrize("name", ADDED)
def test_every_place_of_the_ring_can_be_picked_from(cells, name):
    model = cells[name]
    planner, fit = MotionPlanner(model), model.fit
    generator, base = np.random.default_rng(2), model.cell.bases[0]
    for radius in (fit.r_min_mm, fit.r_max_mm, *generator.uniform(fit.r_min_mm, fit.r_max_mm, 3)):
        pick = base.around(radius, generator.uniform(-1.2, -0.2))
        place = base.around(generator.uniform(fit.r_min_mm, fit.r_max_mm), generator.uniform(0.2, 1.2))
        motion = planner.plan_paths(0, pick, place, planner.home_rad, planner.home_rad)
        assert motion.path_length_mm > 0.0


@pytest.mark.parametrize("name", ["plate", "foot", "tall hand"])
def test_flat_feet_and_tall_hands_keep_the_ring(cells, name):
    assert cells[name].fit == cells["none"].fit


def test_a_plinth_ends_the_ring_and_is_named(cells):
    model, free = cells["plinth"], cells["none"]
    assert model.fit.r_min_mm > free.fit.r_min_mm + 5.0
    assert model.fit.r_max_mm == free.fit.r_max_mm
    reason = bound_by(model.arm, model.fit.r_min_mm - 5.0, 45.0, BlockConfig())
    assert "base_link" in reason
    assert bound_by(free.arm, free.fit.r_max_mm + 5.0, 45.0, BlockConfig()) in ("the length of the arm", "the limits of elbow")
    assert bound_by(free.arm, (free.fit.r_min_mm + free.fit.r_max_mm) / 2, 45.0, BlockConfig()) == ""


def test_hands_clear_of_the_block_keep_what_is_demanded(cells):
    body = MotionPlanner(cells["none"]).collision_model
    assert (body.block_clearance_mm == MotionConfig().block_clearance_mm).all()


def test_a_hand_in_the_block_reaches_nothing(tmp_path):
    """Capsules may stand out of hand and block and overlap; the hand itself may not be where the block is."""
    with pytest.raises(HandoverError, match="'hand' and 'block'"):
        cell_with([("hand", "0.064 0 -0.035", "0.06 0.01 0.01")], tmp_path)


def test_links_that_always_touch_are_ignored_and_listed(tmp_path, cells):
    shells = cell_with(SHELLS, tmp_path)
    assert shells.arm.description.ignored == (("base_link", "upper_arm"),)
    assert any("'base_link' and 'upper_arm' touch" in note for note in shells.arm.description.assumed)
    assert all(cell.arm.description.ignored == () for cell in cells.values())


def test_a_base_in_the_way_of_every_grasp_is_named(tmp_path):
    """It is not in the way of the arm stretched up, so the two are no neighbouring shells."""
    with pytest.raises(HandoverError, match="'base_link' and"):
        cell_with([("base_link", "0 0 0.04", "0.24 0.24 0.08")], tmp_path)

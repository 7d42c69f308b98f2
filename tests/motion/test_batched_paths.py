"""The batched check against the compiled one, row by row; what numbers mean; the mirror laws."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_handover.cell import build_cell, cell_config
from marl_handover.config import CentralisedConfig, MotionConfig
from marl_handover.geometry.capsules import segment_distance
from marl_handover.motion.batched_paths import CROWDING, JOINTS, ROUNDING_MM, MotionCheck, MotionNumbers, ends_of
from marl_handover.motion.planner import MotionPlanner, grasp_joints
from marl_handover.motion.trajectory import basis, sample_places
from tests.symmetries import flips_x, mirror

SAMPLES = 33
BAND_MM = 0.02
"""Verdicts may differ where a margin is this near to its bound: one check is in single precision."""


class Kit:
    """A cell with its compiled planner and both batched parts."""

    def __init__(self, name, parked_deg=None):
        self.model = build_cell(cell_config(name))
        self.motion = MotionConfig() if parked_deg is None else MotionConfig(parked_deg=parked_deg)
        self.cell = self.model.cell
        self.planner = MotionPlanner(self.model, self.motion)
        self.settings = {kind: CentralisedConfig(motion=kind, samples=SAMPLES) for kind in ("flat", "offset")}
        self.check = MotionCheck(self.model, self.motion, self.settings["offset"])
        self.numbers = {kind: MotionNumbers(self.model, self.motion, own) for kind, own in self.settings.items()}

    def margins(self, arm, from_mm, to_mm, points):
        """Smallest of the compiled margins (n,) and which of arm, itself, ground, edge it is, at the same samples."""
        B = basis(sample_places(SAMPLES, CROWDING), 7, 5)
        rows = []
        for number in range(len(arm)):
            ends = (part[number].double().numpy() for part in (from_mm, to_mm))
            segment, _ = self.planner.carrying(int(arm[number]), *ends, self.planner.home_rad)
            margins, _ = segment.check(B @ points[number].double().numpy())
            rows.append([margins.arm, margins.itself, margins.ground, margins.edge + ROUNDING_MM])
        return np.min(rows, axis=1), np.argmin(rows, axis=1)


KITS = {}


@pytest.fixture(scope="module", params=["paper", "al5a"])
def kit(request):
    if request.param not in KITS:
        KITS[request.param] = Kit(request.param)
    return KITS[request.param]


def ways(cell, count, seed=0):
    """Arms (n,), and places (n, 2), (n, 2) that they reach, half of each in the shared space."""
    random = np.random.default_rng(seed)
    arm = torch.tensor(random.integers(0, 2, count))
    places = []
    for _ in range(2):
        radius = np.sqrt(random.uniform(cell.r_min_mm**2, cell.r_max_mm**2, count))
        base = [cell.bases[index] for index in arm.tolist()]
        angle = random.uniform(*cell.yaw_rad, count) + np.array([part.facing_rad for part in base])
        own = np.array([(part.x_mm, part.y_mm) for part in base]) + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        shared = cell.chart.to_table(*random.uniform(-1, 1, (2, count)))
        places.append(torch.tensor(np.where(random.random((count, 1)) < 0.5, shared, own), dtype=torch.float32))
    return arm, *places


def uniform(count, size, seed=1):
    return torch.rand(count, size, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def assert_same_verdicts(kit, arm, from_mm, to_mm, points):
    """Both checks agree; the compiled one's worst margins are returned."""
    found = kit.check.passes(arm, points, ends_of(kit.cell, arm, from_mm, to_mm)).numpy()
    worst, field = kit.margins(arm, from_mm, to_mm, points)
    sure = abs(worst) > BAND_MM
    np.testing.assert_array_equal(found[sure], worst[sure] >= 0)
    return worst, field


@pytest.mark.parametrize(("kind", "size"), [("offset", 0.0), ("offset", 0.1), ("offset", 1.0), ("flat", 1.0)])
def test_agrees_with_the_compiled_check_on_random_splines(kit, kind, size):
    arm, from_mm, to_mm = ways(kit.cell, 100)
    numbers = kit.numbers[kind]
    points = numbers.points(ends_of(kit.cell, arm, from_mm, to_mm), size * uniform(100, numbers.count))
    worst, _ = assert_same_verdicts(kit, arm, from_mm, to_mm, points)
    if kind == "offset" and size == 0.1:
        assert 0.1 < (worst >= 0).mean() < 0.9


def test_agrees_with_the_compiled_check_on_random_postures():
    """Arms that hold still anywhere, the other one leaning in: every kind of collision is the tightest somewhere."""
    kit = Kit("paper", [10.0, 60.0, -109.0, 40.0, 0.0])
    arm, from_mm, to_mm = ways(kit.cell, 800, seed=2)
    low, high = torch.tensor(kit.planner.collision_model.limits, dtype=torch.float32).unbind(-1)
    share = (uniform(800, JOINTS) + 1) / 2
    share[400:, 0] = 0.5 + 0.4 * (share[400:, 0] - 0.5)  # half of them towards the other arm
    points = (low + share * (high - low))[:, None].expand(-1, 7, -1)
    worst, field = assert_same_verdicts(kit, arm, from_mm, to_mm, points)
    assert set(field[worst < -BAND_MM]) == {0, 1, 2, 3}
    assert (worst > BAND_MM).sum() > 20


def test_a_joint_past_its_limit_is_refused(kit):
    arm, from_mm, to_mm = ways(kit.cell, 50, seed=3)
    ends = ends_of(kit.cell, arm, from_mm, to_mm)
    numbers = kit.numbers["offset"]
    points = numbers.points(ends, torch.zeros(50, numbers.count))
    good = kit.check.passes(arm, points, ends)
    assert good.sum() > 30
    for joint, (low, high) in enumerate(kit.planner.collision_model.limits):
        for past in (low - 0.01, high + 0.01):
            outside = points.clone()
            outside[:, 3, joint] = past
            assert not kit.check.passes(arm, outside, ends).any()


def test_rows_do_not_depend_on_their_company(kit):
    arm, from_mm, to_mm = ways(kit.cell, 1500, seed=4)
    ends = ends_of(kit.cell, arm, from_mm, to_mm)
    numbers = kit.numbers["offset"]
    points = numbers.points(ends, 0.1 * uniform(1500, numbers.count))
    together = kit.check.passes(arm, points, ends)
    for rows in (slice(0, 1), slice(1020, 1030), slice(1499, 1500), slice(0, 0)):
        alone = kit.check.passes(arm[rows], points[rows], type(ends)(*(part[rows] for part in ends)))
        assert torch.equal(alone, together[rows])


def test_segment_distance_is_the_same_in_torch():
    random = np.random.default_rng(5)
    ends = random.normal(size=(4, 500, 3))
    ends[1, :50] = ends[0, :50]  # points
    ends[3, 25:75] = ends[2, 25:75]
    ends[3, 100:200] = ends[2, 100:200] + random.normal(size=(100, 1)) * (ends[1] - ends[0])[100:200]  # parallel
    found = segment_distance(*(torch.tensor(end) for end in ends)).numpy()
    np.testing.assert_allclose(found, segment_distance(*ends), atol=1e-9)


def test_ends_are_the_executors_grasps(kit):
    arm, from_mm, to_mm = ways(kit.cell, 200, seed=6)
    found = kit.numbers["flat"].end_joints(ends_of(kit.cell, arm, from_mm, to_mm)).numpy()
    for number in range(200):
        for end, place in enumerate((from_mm, to_mm)):
            expected = grasp_joints(kit.model, int(arm[number]), "grasp", place[number].double().numpy())
            np.testing.assert_allclose(found[number, end], expected[:JOINTS], atol=2e-5)
            assert expected[4] == 0.0


@pytest.mark.parametrize("kind", ["flat", "offset"])
def test_a_path_goes_from_pick_to_place_within_the_limits(kit, kind):
    arm, from_mm, to_mm = ways(kit.cell, 300, seed=7)
    numbers, ends = kit.numbers[kind], ends_of(kit.cell, arm, from_mm, to_mm)
    points = numbers.points(ends, uniform(300, numbers.count))
    low, high = torch.tensor(kit.planner.collision_model.limits, dtype=torch.float32).unbind(-1)
    assert points.shape == (300, 7, JOINTS)
    assert ((points >= low) & (points <= high)).all()
    assert torch.equal(points[:, [0, -1]], numbers.end_joints(ends))


def test_flat_numbers_span_the_limits(kit):
    arm, from_mm, to_mm = ways(kit.cell, 2, seed=8)
    numbers, ends = kit.numbers["flat"], ends_of(kit.cell, arm, from_mm, to_mm)
    limits = torch.tensor(kit.planner.collision_model.limits, dtype=torch.float32)
    for value, expected in ((-1.0, limits[:, 0]), (1.0, limits[:, 1]), (0.0, limits.mean(-1))):
        inner = numbers.points(ends, torch.full((2, numbers.count), value))[:, 1:-1]
        torch.testing.assert_close(inner, expected.expand_as(inner), atol=1e-6, rtol=0)


def test_an_offset_is_added_to_the_straight_guess(kit):
    arm, from_mm, to_mm = ways(kit.cell, 100, seed=9)
    numbers, ends = kit.numbers["offset"], ends_of(kit.cell, arm, from_mm, to_mm)
    guess = numbers.points(ends, torch.zeros(100, numbers.count))
    low, high = torch.tensor(kit.planner.collision_model.limits, dtype=torch.float32).unbind(-1)
    for index in range(0, numbers.count, 3):
        one = torch.zeros(100, numbers.count)
        one[:, index] = 0.2
        moved = numbers.points(ends, one)
        expected = guess.clone()
        point, joint = 1 + index // JOINTS, index % JOINTS
        raw = numbers.straight(ends, numbers.end_joints(ends))[:, point - 1, joint] + 0.2 * kit.settings["offset"].offset_rad
        expected[:, point, joint] = raw.clamp(low[joint], high[joint])
        torch.testing.assert_close(moved, expected, atol=1e-6, rtol=0)


def test_most_straight_guesses_pass_and_no_flat_zero_does():
    kit = KITS.get("paper") or Kit("paper")
    arm, from_mm, to_mm = ways(kit.cell, 2000, seed=10)
    ends = ends_of(kit.cell, arm, from_mm, to_mm)
    share = {}
    for kind, numbers in kit.numbers.items():
        share[kind] = kit.check.passes(arm, numbers.points(ends, torch.zeros(2000, numbers.count)), ends).float().mean()
    assert share["offset"] > 0.85
    assert share["flat"] == 0.0


@pytest.mark.parametrize("kind", ["flat", "offset"])
@pytest.mark.parametrize("symmetry", [mirror(x=True), mirror(y=True), mirror(x=True, y=True)])
def test_mirror_laws(kit, kind, symmetry):
    """One mirror turns base yaws round, in the same arm's frame or in the other's; both are half a turn, which changes no joint."""
    arm, from_mm, to_mm = ways(kit.cell, 400, seed=11)
    numbers = kit.numbers[kind]
    given = (0.1 if kind == "offset" else 1.0) * uniform(400, numbers.count)
    image = given.clone().unflatten(-1, (-1, JOINTS))
    turned = -1.0 if flips_x(symmetry) != symmetry.swaps else 1.0
    image[..., 0] *= turned
    mirrored = [symmetry.pose(torch.cat([place, place[:, :1] * 0], -1))[:, :2] for place in (from_mm, to_mm)]
    other = symmetry.arm(arm)
    ends, ends_image = ends_of(kit.cell, arm, from_mm, to_mm), ends_of(kit.cell, other, *mirrored)
    points, points_image = numbers.points(ends, given), numbers.points(ends_image, image.flatten(1))
    expected = points.clone()
    expected[..., 0] *= turned
    torch.testing.assert_close(points_image, expected, atol=1e-4, rtol=0)
    same = kit.check.passes(arm, points, ends) == kit.check.passes(other, points_image, ends_image)
    assert same.float().mean() > 0.99

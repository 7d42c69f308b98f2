"""What backends do with a cycle: the rule book's formula, refusals by name, noise of the set size."""

from __future__ import annotations

import math
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from marl_handover.arrays import wrap
from marl_handover.cell import build_cell, cell_config
from marl_handover.config import MotionConfig, NoiseConfig, TaskConfig
from marl_handover.envs.backends import Correctable, KinematicBackend, NoisyBackend, Refusal, make_backend
from marl_handover.envs.collision_check import CollisionFinder
from marl_handover.envs.cycle_check import JOIN_TOLERANCE_RAD, CycleCheck, welded
from marl_handover.envs.spaces import read_cycle
from marl_handover.envs.top_view import BLOCK, GOAL, PLACE, TopView
from marl_handover.errors import InvalidSetting, UnknownChoice
from marl_handover.motion.executor import ExecutorAgent
from marl_handover.motion.pick_place import timed_phases
from marl_handover.motion.planner import MotionPlanner
from marl_handover.motion.trajectory import PickPlacePaths
from marl_handover.task.rules import Command, Rules
from tests.canonical_arms import PARKED_DEG

MOTION = MotionConfig()
PARKED = np.radians(PARKED_DEG)
START, PLACE_MM = np.array([120.0, 60.0, 0.7]), np.array([30.0, -20.0])  # both in reach of the left arm


@pytest.fixture(scope="module", params=["paper", "al5a"])
def model(request):
    return build_cell(cell_config(request.param))


@pytest.fixture(scope="module")
def paper_model():
    return build_cell(cell_config("paper"))


def cycle(model, arm, pick_mm, place_mm, joints=PARKED):
    """A direct cycle in float64, made without the agent: straight lines in joint space between the ends."""
    base = model.cell.bases[arm]
    ends = [joints]
    for x, y in (pick_mm, place_mm):
        dx, dy, angle = x - base.x_mm, y - base.y_mm, base.facing_rad
        local = [math.cos(angle) * dx + math.sin(angle) * dy, math.cos(angle) * dy - math.sin(angle) * dx, model.cell.pick_height_mm]
        ends.append(model.arm.ik(local)[0])
    ends.append(PARKED)
    return PickPlacePaths(*(np.linspace(*pair, MOTION.control_points) for pair in pairwise(ends)))


def good(model):
    return cycle(model, 0, START[:2], PLACE_MM)


def changed(paths, path, point, joint, value):
    """The same cycle with one number of one control point replaced."""
    arrays = {name: array.copy() for name, array in paths._asdict().items()}
    arrays[path][point, joint] = value
    return PickPlacePaths(**arrays)


def started(backend_class, model, **options):
    backend = backend_class(model, MOTION, **options)
    backend.reset(START, 0)
    return backend


@pytest.mark.parametrize("arm", [0, 1])
def test_the_grip_is_where_forward_kinematics_put_it(model, arm):
    joints = np.random.default_rng(arm).uniform(model.arm.lower_rad, model.arm.upper_rad, (500, 5))
    base, T = model.cell.bases[arm], model.arm.fk(joints)
    cosine, sine = math.cos(base.facing_rad), math.sin(base.facing_rad)
    x, y, z = T[:, 0, 3], T[:, 1, 3], T[:, 2, 3]
    expected = np.stack([base.x_mm + cosine * x - sine * y, base.y_mm + sine * x + cosine * y, z], -1)
    np.testing.assert_allclose(CycleCheck(model, MOTION).grip_mm(arm, joints), expected, atol=1e-9)


def test_an_exact_transfer_is_the_rule_books(model, draw):
    """For every transfer that the rules allow, arms' reach included."""
    rules, backend = Rules(model.cell, TaskConfig()), KinematicBackend(model, MOTION)
    done = 0
    for pose, goal, arm in zip(*draw(model.cell, 300, 0)[:2], np.arange(300) % 2, strict=True):
        planned, feasible = rules.transfer(pose, goal, Command(np.bool_(True), np.int64(arm), goal[:2]))
        if not feasible:
            continue
        backend.reset(pose, 0)
        execution = backend.execute(int(arm), cycle(model, int(arm), pose[:2], goal[:2]))
        assert execution.refusal is None
        np.testing.assert_allclose(execution.pose[:2], planned[:2], atol=1e-9)
        assert abs(wrap(execution.pose[2] - planned[2])) < 1e-9
        np.testing.assert_array_equal(execution.joints_rad, [PARKED, PARKED])
        done += 1
    assert done > 40


def test_the_path_of_a_pure_turn_is_an_arc(paper_model):
    """200 mm from the base, through 60 degrees."""
    joints = paper_model.arm.ik([200.0, 0.0, 45.0])[0]
    turned = joints + [math.radians(60), 0, 0, 0, 0]
    length = CycleCheck(paper_model, MOTION).path_mm(1, np.linspace(joints, turned, MOTION.control_points))
    assert length == pytest.approx(200 * math.radians(60), rel=1e-4)


def test_the_path_is_no_shorter_than_the_way(paper_model):
    execution = started(KinematicBackend, paper_model).execute(0, good(paper_model))
    way = math.dist(START[:2], PLACE_MM)
    assert way <= execution.path_mm < 2 * way


WRONG = {
    "NaN": (lambda m: changed(good(m), "transfer", 3, 1, math.nan), Refusal.NOT_FINITE),
    "infinite": (lambda m: changed(good(m), "retreat", 3, 1, math.inf), Refusal.NOT_FINITE),
    "above a limit": (lambda m: changed(good(m), "approach", 4, 2, m.arm.upper_rad[2] + 0.01), Refusal.JOINT_LIMITS),
    "below a limit": (lambda m: changed(good(m), "transfer", 4, 0, m.arm.lower_rad[0] - 0.01), Refusal.JOINT_LIMITS),
    "starts elsewhere": (lambda m: changed(good(m), "approach", 0, 0, PARKED[0] + 0.03), Refusal.NOT_CONTINUOUS),
    "jumps before the grasp": (lambda m: good(m)._replace(approach=good(m).retreat), Refusal.NOT_CONTINUOUS),
    "jumps after the release": (lambda m: good(m)._replace(retreat=good(m).approach), Refusal.NOT_CONTINUOUS),
    "grasps beside the pin": (lambda m: cycle(m, 0, START[:2] + [0.0, 1.1], PLACE_MM), Refusal.OBJECT_ELSEWHERE),
    "never parks": (lambda m: changed(good(m), "retreat", -1, 0, 0.3), Refusal.CANNOT_PARK),
}


@pytest.mark.parametrize(("paths_of", "reason"), WRONG.values(), ids=WRONG)
def test_a_wrong_cycle_is_refused_and_moves_nothing(paper_model, paths_of, reason):
    backend = started(KinematicBackend, paper_model)
    execution = backend.execute(0, paths_of(paper_model))
    assert (execution.refusal, execution.path_mm) == (reason, 0.0)
    np.testing.assert_array_equal(execution.pose, START)
    np.testing.assert_array_equal(backend.joints_rad(), [PARKED, PARKED])
    assert backend.execute(0, good(paper_model)).refusal is None


@pytest.mark.parametrize("joint", [3, 4])
@pytest.mark.parametrize(("end", "reason"), [(0, Refusal.OBJECT_ELSEWHERE), (-1, Refusal.WRONG_PLACE)])
def test_the_hand_is_level_at_both_ends(paper_model, joint, end, reason):
    """Pitch and roll; rolling does not even move the grip."""
    paths = good(paper_model)
    for path, point in (("approach", -1), ("transfer", 0)) if end == 0 else (("transfer", -1), ("retreat", 0)):
        paths = changed(paths, path, point, joint, getattr(paths, path)[point, joint] + 0.02)
    assert started(KinematicBackend, paper_model).execute(0, paths).refusal == reason


def test_a_commanded_place_is_held_against_the_paths(paper_model):
    check = CycleCheck(paper_model, MOTION)
    paths = good(paper_model)
    assert check(0, paths, PARKED, START[:2], PLACE_MM + [0.6, 0.6]) is None
    assert check(0, paths, PARKED, START[:2], PLACE_MM + [0.8, 0.8]) == Refusal.WRONG_PLACE
    assert check(1, paths, PARKED, START[:2], PLACE_MM) == Refusal.OBJECT_ELSEWHERE  # the other arm's base


def test_a_collision_check_has_the_last_word(paper_model):
    """Here one that keeps the left arm still; it is shown the joints of all arms."""
    backend = started(KinematicBackend, paper_model, check_collisions=lambda arm, paths, joints: arm == 0 and joints.shape == (2, 5))
    execution = backend.execute(0, good(paper_model))
    assert execution.refusal == Refusal.COLLISION
    np.testing.assert_array_equal(execution.pose, START)
    backend.reset(np.array([0.0, 0.0, 0.0]), 0)
    assert backend.execute(1, cycle(paper_model, 1, (0.0, 0.0), (20.0, 10.0))).refusal is None


@pytest.fixture(scope="module")
def careful(paper_model):
    return KinematicBackend(paper_model, MOTION, check_collisions=True)


def bent(paths, path, joint, angle_rad):
    """The same cycle with the middle control points of one path turned at one joint."""
    points = getattr(paths, path).copy()
    points[3:-3, joint] += angle_rad
    return paths._replace(**{path: points})


@pytest.mark.parametrize(
    ("path", "joint", "angle_deg"),
    [("transfer", 1, -20.0), ("approach", 1, -60.0), ("retreat", 1, -60.0), ("transfer", 4, 60.0)],
    ids=["the block into the table", "the hand on its way there", "the hand on its way back", "the block on its side"],
)
def test_a_path_through_the_table_is_refused_when_that_is_looked_for(paper_model, careful, path, joint, angle_deg):
    planned = MotionPlanner(paper_model, MOTION).plan_paths(0, START[:2], PLACE_MM, PARKED, PARKED).paths
    diving = bent(planned, path, joint, math.radians(angle_deg))
    careful.reset(START, 0)
    execution = careful.execute(0, diving)
    assert execution.refusal == Refusal.COLLISION
    np.testing.assert_array_equal(execution.pose, START)
    assert careful.execute(0, planned).refusal is None
    assert started(KinematicBackend, paper_model).execute(0, diving).refusal is None


def test_a_path_through_the_other_arm_is_refused_when_that_is_looked_for(paper_model):
    planned = MotionPlanner(paper_model, MOTION).plan_paths(0, START[:2], PLACE_MM, PARKED, PARKED).paths
    finder = CollisionFinder(paper_model, MOTION)
    assert not finder(0, planned, np.array([PARKED, PARKED]))
    over_the_place = cycle(paper_model, 1, PLACE_MM, PLACE_MM).transfer[0]
    assert finder(0, planned, np.array([PARKED, over_the_place]))


def test_what_the_executor_plans_touches_nothing(paper_model, careful, draw):
    """Of all transfers within reach, what its float32 action says; straight lines in joint space drag the block over the table."""
    agents = {method: ExecutorAgent("arm_left", paper_model, method) for method in ("optimised", "direct")}
    came = {method: [] for method in agents}
    for pose, goal in zip(*draw(paper_model.cell, 100, 0)[:2], strict=True):
        if not paper_model.cell.reaches(np.stack([pose, goal]))[:, 0].all():
            continue
        observation = {"object": pose, "target": goal[:2], "joints": PARKED, "other_joints": PARKED}
        for method, agent in agents.items():
            action = agent.act(observation)
            if action["grasp"]:
                careful.reset(pose, 0)
                came[method].append(careful.execute(0, read_cycle(action, MOTION.control_points, paper_model.arm)).refusal)
    assert len(came["optimised"]) > 20
    assert set(came["optimised"]) == {None}
    assert Refusal.COLLISION in came["direct"]


def test_a_grip_just_outside_the_annulus_is_judged_too(paper_model, careful):
    """The cycle check lets a grip be a millimetre off."""
    cell, base = paper_model.cell, paper_model.cell.bases[0]
    way = np.array([math.cos(base.facing_rad + 0.3), math.sin(base.facing_rad + 0.3)])
    edge = base.position_mm + cell.r_max_mm * way
    paths = cycle(paper_model, 0, edge, PLACE_MM)
    for name, point in (("approach", -1), ("transfer", 0)):
        paths = changed(paths, name, point, 2, min(getattr(paths, name)[point, 2] + 0.002, paper_model.arm.upper_rad[2]))
    careful.reset(np.array([*edge, 0.0]), 0)
    assert careful.execute(0, paths).refusal in (None, Refusal.COLLISION)


def nearly_joined(paths, gap_rad):
    """The same cycle with a gap before its second and third path, in the direction that keeps within the limits."""
    transfer, retreat = paths.transfer.copy(), paths.retreat.copy()
    transfer[0, 0] += gap_rad
    retreat[0, 0] -= gap_rad
    return paths._replace(transfer=transfer, retreat=retreat)


def test_what_the_check_lets_pass_is_joined_for_those_who_are_stricter(paper_model):
    """The timing of motions takes no gap at all."""
    gaps = nearly_joined(good(paper_model), 0.9 * JOIN_TOLERANCE_RAD)
    assert CycleCheck(paper_model, MOTION)(0, gaps, PARKED, START[:2], PLACE_MM) is None
    with pytest.raises(InvalidSetting, match="gap"):
        timed_phases(gaps, paper_model.arm, MOTION, 45.0)
    joined = welded(gaps)
    phases = timed_phases(joined, paper_model.arm, MOTION, 45.0)
    np.testing.assert_array_equal(phases[-1].joints_rad[-1], PARKED)
    np.testing.assert_array_equal(joined.approach, gaps.approach)
    for one, other in zip(joined, gaps, strict=True):
        np.testing.assert_array_equal(one[1:], other[1:])
        assert abs(one[0] - other[0]).max() <= JOIN_TOLERANCE_RAD


def test_an_object_put_elsewhere_is_found_there(paper_model):
    backend = started(KinematicBackend, paper_model)
    assert isinstance(backend, Correctable)
    backend.put(np.array([30.0, -20.0, 1.0]))
    assert backend.execute(0, good(paper_model)).refusal == Refusal.OBJECT_ELSEWHERE
    assert backend.execute(0, cycle(paper_model, 0, PLACE_MM, START[:2])).refusal is None


def noisy_offsets(model, seed, count=3000, **options):
    """Errors (n, 3) of the placements that took place, and the share that did not."""
    backend, exact = NoisyBackend(model, MOTION, **options), started(KinematicBackend, model)
    expected = exact.execute(0, good(model)).pose
    offsets = []
    backend.reset(START, seed)
    for _ in range(count):
        backend.put(START)
        execution = backend.execute(0, good(model))
        if execution.refusal is None:
            offsets.append([*(execution.pose[:2] - expected[:2]), wrap(execution.pose[2] - expected[2])])
        else:
            assert execution.refusal == Refusal.MISSED_GRASP
            np.testing.assert_array_equal(execution.pose, START)
    return np.array(offsets), 1 - len(offsets) / count


def test_noise_and_missed_grasps_are_as_often_as_set(paper_model):
    offsets, missed = noisy_offsets(paper_model, 5, noise=NoiseConfig(position_mm=2.0, yaw_deg=3.0), missed_grasps=0.2)
    np.testing.assert_allclose(offsets.std(0), [2.0, 2.0, math.radians(3.0)], rtol=0.05)
    assert (abs(offsets.mean(0)) < [0.15, 0.15, 0.004]).all()
    assert missed == pytest.approx(0.2, abs=0.03)


def test_the_seed_decides_the_noise(paper_model):
    first, again, other = (noisy_offsets(paper_model, seed, 20)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[:5], other[:5])


def test_no_noise_is_exact(paper_model):
    offsets, missed = noisy_offsets(paper_model, 0, 20, noise=NoiseConfig(), missed_grasps=0.0)
    assert missed == 0
    np.testing.assert_allclose(offsets, 0, atol=1e-12)


def test_backends_by_name(paper_model):
    task = TaskConfig(noise=NoiseConfig(position_mm=3.0))
    exact, noisy = (make_backend(name, paper_model, task, MOTION) for name in ("kinematic", "noisy"))
    assert (exact.exact, noisy.exact) == (True, False)
    assert noisy.noise == task.noise
    assert make_backend("noisy", paper_model, TaskConfig(), MOTION, missed_grasps=0.5).missed_grasps == 0.5
    with pytest.raises(UnknownChoice, match="kinematic, noisy, bullet"):
        make_backend("gazebo", paper_model, task, MOTION)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda m: NoisyBackend(m, MOTION, missed_grasps=1.1), "missed_grasps"),
        (lambda m: NoisyBackend(m, MOTION, noise=NoiseConfig(position_mm=math.nan)), "noise.position_mm"),
        (lambda m: NoisyBackend(m, MOTION, noise=NoiseConfig(yaw_deg=-1.0)), "noise.yaw_deg"),
        (lambda m: KinematicBackend(m, MotionConfig(parked_deg=[0.0, 140.0, -20.0, 70.0, 0.0])), "motion.parked_deg"),
        (lambda m: KinematicBackend(m, MotionConfig(parked_deg=[0.0, 140.0])), "motion.parked_deg"),
        (lambda m: KinematicBackend(m, MotionConfig(control_points=5, degree=5)), "control_points"),
    ],
)
def test_settings_out_of_their_limits_are_named(paper_model, make, name):
    with pytest.raises(InvalidSetting, match=name):
        make(paper_model)


def test_environments_need_no_simulator_and_no_compiler():
    code = "import sys, marl_handover.envs; print([name for name in ('pybullet', 'numba', 'matplotlib') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_the_picture_shows_block_goal_and_place(paper_model):
    """Each colour's pixels lie around its own point; x to the right, y up."""
    backend, goal = started(KinematicBackend, paper_model), np.array([-150.0, -90.0, 0.3])
    picture = backend.render(goal, np.array([0.0, 100.0]))
    size, half = picture.shape[0], TopView(paper_model.cell).half_mm
    for colour, (x, y) in ((BLOCK, START[:2]), (GOAL, goal[:2]), (PLACE, (0.0, 100.0))):
        rows, columns = np.nonzero((picture == colour).all(-1))
        assert len(rows) > 20
        centre = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2 * 2 * half / (size - 1) - half
        np.testing.assert_allclose(centre * [1, -1], [x, y], atol=4)
    assert not (backend.render() == GOAL).all(-1).any()


def test_an_agents_direct_cycle_is_carried_out(paper_model):
    """The float32 numbers of the agent's action are exact enough."""
    backend = started(KinematicBackend, paper_model)
    observation = {"object": START, "target": PLACE_MM, "joints": PARKED, "other_joints": PARKED}
    action = ExecutorAgent("arm_left", paper_model, "direct").act(observation)
    execution = backend.execute(0, PickPlacePaths(*action["paths"].astype(float)))
    assert execution.refusal is None
    np.testing.assert_allclose(execution.pose[:2], PLACE_MM, atol=1e-3)

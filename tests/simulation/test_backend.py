"""The backend's protocol: what an execution says, and why it fails."""

import math

import numpy as np
import pytest

from marl_handover.config import TaskConfig
from marl_handover.envs.backends import make_backend
from marl_handover.envs.cycle_check import Refusal
from marl_handover.motion.planner import MotionPlanner
from marl_handover.simulation.backend import PhysicsBackend
from marl_handover.simulation.world import CONTROL_S
from tests.canonical_arms import PARKED_DEG


@pytest.fixture
def backend(model, motion, engine):
    backend = make_backend(engine, model, TaskConfig(), motion)
    yield backend
    backend.close()


@pytest.fixture(scope="module")
def planner(model, motion):
    return MotionPlanner(model, motion)


def test_planned_transfers_succeed_one_after_the_other(backend, planner, motion, expected):
    parked = np.radians(PARKED_DEG)
    pose = backend.reset(np.array([30.0, -15.0, 0.3]), 0)
    for arm, place in ((0, (-70.0, 10.0)), (1, (60.0, -30.0))):
        joints = backend.joints_rad()[arm] * (1, 1, 1, 1, 0)
        plan = planner.pick_place(arm, pose[:2], place, joints, parked)
        done = backend.execute(arm, plan.paths)
        wanted = expected(arm, pose, place)
        assert done.refusal is None
        assert np.hypot(*(done.pose - wanted)[:2]) < 2
        assert abs(math.remainder(done.pose[2] - wanted[2], 2 * math.pi)) < math.radians(1.2)
        assert done.path_mm == pytest.approx(plan.path_length_mm, rel=0.02)
        np.testing.assert_allclose(done.joints_rad, np.tile(parked, (2, 1)), atol=math.radians(0.2))
        pose = done.pose


def test_senseless_cycles_are_refused_and_nothing_moves(backend, planner, motion):
    parked = np.radians(PARKED_DEG)
    pose = backend.reset(np.array([30.0, -15.0, 0.3]), 0)
    paths = planner.pick_place(0, (40.0, -15.0), (-70.0, 10.0), parked, parked).paths
    assert backend.execute(0, paths).refusal == Refusal.OBJECT_ELSEWHERE
    broken = paths._replace(transfer=np.full_like(paths.transfer, np.nan))
    assert backend.execute(0, broken).refusal == Refusal.NOT_FINITE
    assert np.array_equal(backend.cell.object_pose(), pose)


def test_a_missed_grasp_is_named_and_the_arm_parks(backend, cycle, motion):
    backend.reset(np.array([100.0, -120.0, 0.0]), 0)
    done = backend.carry_out(0, cycle(0, (-30.0, -25.0), (60.0, -10.0)))
    assert done.refusal == Refusal.MISSED_GRASP
    np.testing.assert_allclose(done.joints_rad[0], np.radians(PARKED_DEG), atol=math.radians(0.2))


def test_a_block_let_go_on_the_way_is_dropped(backend, cycle):
    backend.reset(np.array([30.0, -15.0, 0.0]), 0)
    phases = list(cycle(0, (30.0, -15.0), (-60.0, -5.0)))
    opening = np.linspace(0, 12, len(phases[3].t_s))
    phases[3] = phases[3].__class__("transfer", phases[3].t_s, phases[3].joints_rad, opening)
    phases[4] = phases[4].__class__("lower", phases[4].t_s, phases[4].joints_rad, np.full(len(phases[4].t_s), 12.0))
    done = backend.carry_out(0, tuple(phases))
    assert done.refusal == Refusal.DROPPED
    assert math.dist(done.pose[:2], (30.0, -15.0)) < math.dist(done.pose[:2], (-60.0, -5.0))  # the fingers let go early


def test_a_cycle_that_is_nearly_joined_is_carried_out(backend, planner, motion):
    """Within what the check lets pass; the timing takes no gap."""
    parked = np.radians(PARKED_DEG)
    pose = backend.reset(np.array([30.0, -15.0, 0.3]), 0)
    paths = planner.pick_place(0, pose[:2], (-70.0, 10.0), parked, parked).paths
    for later in paths[1:]:
        later[0, 0] += 5e-5
    done = backend.execute(0, paths)
    assert done.refusal is None
    assert np.hypot(*(done.pose[:2] - (-70.0, 10.0))) < 2


def lay_down(backend, pose, tilt_deg):
    """The block on its side, nothing else changed."""
    backend.cell.engine.put_block((pose[0], pose[1] + 10.0, 20.0), (math.radians(tilt_deg), 0.0, 0.0))
    backend.cell.settle()


@pytest.mark.parametrize("fails", ["the grasp", "nothing else"])
def test_a_block_that_lies_has_tipped_whatever_else_went_wrong(backend, cycle, fails):
    """Beside where the fingers close, or laid down while the arm retreats."""
    backend.reset(np.array([100.0, -120.0, 0.0]) if fails == "the grasp" else np.array([-30.0, -25.0, 0.0]), 0)
    phases = cycle(0, (-30.0, -25.0), (60.0, -10.0))
    if fails == "the grasp":
        lay_down(backend, (100.0, -120.0), 90.0)
    else:
        end_s = phases[-1].t_s[-1]
        calls = iter(range(int(end_s / CONTROL_S) + 2))
        backend.on_step = lambda: lay_down(backend, (60.0, -10.0), 90.0) if next(calls) == int(end_s / CONTROL_S) - 5 else None
    done = backend.carry_out(0, phases)
    assert backend.last.arms[0].grasped == (fails == "nothing else")
    assert done.refusal == Refusal.TIPPED


def test_it_is_found_by_name(model, motion, engine):
    backend = make_backend(engine, model, TaskConfig(), motion, grasp="constraint", size=(64, 36))
    assert isinstance(backend, PhysicsBackend)
    assert type(backend.cell.engine).__name__.lower() == f"{engine}engine"
    assert not backend.exact
    backend.reset(np.zeros(3), 3)
    assert backend.render().shape == (36, 64, 3)
    backend.close()

"""The closed loop on the calibrated twin, bytes and pixels and all; and every event with its reaction."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from fault_injection import FaultInjector

from marl_handover import policies
from marl_handover.arrays import wrap
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.config import MotionConfig, TaskConfig
from marl_handover.control.closed_loop import make_loop
from marl_handover.control.evaluation import truly_solved
from marl_handover.control.events import FAULTS, Event
from marl_handover.control.session import GivenGoal, NoGoal, Session
from marl_handover.control.settings import WatchConfig, twin_workcell
from marl_handover.envs.backends import make_backend
from marl_handover.errors import MissingFile
from marl_handover.hardware import estop, session_registry, settings
from marl_handover.hardware.connection import State
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import DeviceError, PulseMismatch, Stopped
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.settings import ARMS

START, PLACE_MM = np.array([-60.0, 20.0, 0.7]), np.array([50.0, 25.0])
"""A problem that the left arm solves in one transfer."""


def one_transfer(cell, start=START, place_mm=PLACE_MM, arm=0):
    turn = cell.polar(np.asarray(place_mm))[1][arm] - cell.polar(start[:2])[1][arm]
    return np.array([*place_mm, float(wrap(start[2] + turn))])


def lab_config(folder, stop, **hardware):
    config = twin_workcell()
    config.calibration, config.watch = str(folder), WatchConfig(timeout_s=4.0)
    config.hardware.stop_file = str(stop)
    config.hardware.timeouts.reconnect_s = 4.0
    for name, value in hardware.items():
        setattr(config.hardware.gate, name, value)
    return config


@pytest.fixture
def start(twin_calibration, tmp_path):
    """``start(...)``: session on a fresh twin, its twin, its one-transfer problem; closed afterwards."""
    opened = []

    def make(dry_run=False, **hardware):
        config = lab_config(twin_calibration, tmp_path / "stop", **hardware)
        log = tmp_path / "log.jsonl"
        loop = make_loop(policies.adapted("exact"), "hardware", config=config, dry_run=dry_run, log_path=str(log))
        opened.append(loop)
        session = Session(loop, {"policy": "exact"})
        goal = one_transfer(loop.rules.cell)
        twin = session.backend.workcell.twin
        return SimpleNamespace(
            session=session,
            twin=twin,
            clock=twin.clock,
            log=log,
            goal=GivenGoal(goal),
            goal_pose=goal,
            loop=loop,
            counts=session.log.counts,
        )

    yield make
    for loop in opened:
        loop.backend.close()


def lines(path):
    return [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]


def when(workcell, condition, act, every_s=0.02):
    """Do ``act`` once, as soon as ``condition`` holds."""

    def look():
        if condition():
            act()
        else:
            workcell.clock.at(workcell.clock.now_s() + every_s, look)

    workcell.clock.at(workcell.clock.now_s(), look)


def carried_high(workcell):
    return workcell.twin.cell.block.height_mm() > 15.0


def solved(workcell, episode):
    true = workcell.twin.true_pose()
    assert episode.solved
    assert truly_solved(episode, workcell.loop.rules)
    assert math.dist(true[:2], episode.goal[:2]) < 5.0
    assert abs(float(wrap(true[2] - episode.goal[2]))) < workcell.loop.rules.epsilon_rad
    return True


def told_as_it_was(workcell, episode):
    """What each transfer was refused for. A hand that does not close may drag the pin along: then it was dropped, else missed."""
    least, told = workcell.session.backend.config.moved_mm, [str(transfer.result.refusal) for transfer in episode.transfers]
    lay = np.array([START, *(transfer.result.truth for transfer in episode.transfers)])
    for refusal, way_mm in zip(told, np.hypot(*np.diff(lay[:, :2], axis=0).T), strict=True):
        if abs(way_mm - least) > 1.5 and refusal in ("missed_grasp", "dropped"):  # the camera is not exact
            assert refusal == ("dropped" if way_mm > least else "missed_grasp")
    return told


def test_a_transfer_through_bytes_and_pixels_is_exact_to_some_mm(start):
    workcell = start()
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert len(episode.transfers) == 1
    done = episode.transfers[0].result
    assert math.dist(done.truth[:2], workcell.goal_pose[:2]) < 3.0
    assert abs(float(wrap(done.truth[2] - workcell.goal_pose[2]))) < math.radians(2.0)
    assert math.dist(done.truth[:2], done.pose[:2]) < 1.5, "what the camera says is where it is"
    assert not FAULTS & set(workcell.counts)
    rows = lines(workcell.log)
    kinds = [row["event"] for row in rows]
    assert kinds[:5] == ["session", "episode", "armed", "seen", "goal"]
    assert [row["symmetry_order"] for row in rows if row["event"] in ("session", "transfer")] == [1, 1]
    assert kinds[-2:] == ["transfer", "ended"]
    states = [row for row in rows if row["event"] == "state"]
    assert len(states) > 20
    assert np.shape(states[0]["joints_rad"]) == (2, 5)
    assert all(later["t_s"] >= row["t_s"] for row, later in pairwise(rows))


def test_a_failed_grasp_is_seen_and_tried_again(start):
    workcell = start()
    FaultInjector(workcell.twin, workcell.loop.rules).arrange("missed_grasp", 0.3, workcell.goal)
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    first, *later = told_as_it_was(workcell, episode)
    assert first in ("missed_grasp", "dropped")
    assert set(later) == {"None"}
    assert workcell.counts[Event.FAILED_GRASP] + workcell.counts[Event.DROPPED] == 1


def test_a_dropped_block_is_picked_up_where_it_lies(start):
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: workcell.twin.set_object_pose([0.0, -20.0, 2.0]))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.DROPPED] == 1


def test_a_block_moved_while_a_hand_comes_near_calls_the_hand_back(start):
    workcell = start()
    workcell.clock.at(workcell.clock.now_s() + 0.75, lambda: workcell.twin.set_object_pose(START + (18.0, 0.0, 0.2)))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.BLOCK_MOVED] == 1
    assert episode.transfers[0].result.refusal == "missed_grasp"
    assert not workcell.twin.follower.collisions


def test_a_goal_that_changes_in_mid_motion_is_reached_after_the_transfer(start):
    workcell = start()
    new = one_transfer(workcell.loop.rules.cell, workcell.goal_pose, [-30.0, -5.0])
    when(workcell, lambda: carried_high(workcell), lambda: workcell.goal.set(new))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.GOAL_CHANGED] == 1
    np.testing.assert_array_equal(episode.goal, new)
    first = episode.transfers[0]
    assert math.dist(first.result.truth[:2], workcell.goal_pose[:2]) < 5.0, "the transfer that was under way was finished"


def test_the_printed_goal_is_gone_for(start):
    workcell = start()
    workcell.twin.goal = workcell.goal_pose
    episode = workcell.session.play(START, workcell.session.printed)
    assert math.dist(episode.goal[:2], workcell.goal_pose[:2]) < 1.0
    assert solved(workcell, episode)


def test_a_printed_goal_that_the_block_covers_is_the_one_before(start):
    """A second episode on a real cell begins with the block where the first one put it: on the marker."""
    workcell = start()
    workcell.twin.goal = workcell.goal_pose
    with pytest.raises(NoGoal):
        workcell.session.play(workcell.goal_pose, workcell.session.printed)
    assert solved(workcell, workcell.session.play(START, workcell.session.printed))
    for _ in range(2):
        episode = workcell.session.play(workcell.twin.true_pose(), workcell.session.printed)
        assert math.dist(episode.goal[:2], workcell.goal_pose[:2]) < 1.0
        assert solved(workcell, episode)
    workcell.session.printed.forget()
    with pytest.raises(NoGoal):
        workcell.session.play(workcell.goal_pose, workcell.session.printed)


def test_a_block_outside_all_reach_is_waited_for(start):
    workcell = start()
    outside = np.array([230.0, 0.0, 0.0])
    workcell.clock.at(workcell.clock.now_s() + 2.0, lambda: workcell.twin.set_object_pose(START))
    episode = workcell.session.play(outside, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.BLOCK_OUTSIDE] == 1
    assert workcell.counts[Event.RECOVERED] == 1
    begun_s = workcell.clock.now_s()
    episode = workcell.session.play(outside, workcell.goal)
    assert episode.ended == "stuck"
    assert workcell.clock.now_s() - begun_s < 30.0


def test_a_hidden_marker_and_a_frozen_camera_are_waited_for(start):
    workcell = start()
    workcell.clock.at(workcell.clock.now_s() + 3.5, lambda: workcell.twin.hide(4.0))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.MARKER_HIDDEN] == 1
    workcell.clock.at(workcell.clock.now_s() + 3.5, lambda: workcell.twin.freeze(3.0))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.CAMERA_FROZEN] == 1


@pytest.mark.slow
def test_a_block_out_of_sight_after_a_motion_is_not_taken_for_a_fallen_one(start):
    """A hand over it for longer than there is patience: it is waited for once more, and the episode goes on."""
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: workcell.twin.hide(8.0))
    episode = workcell.session.play(START, workcell.goal)
    assert episode.transfers[0].result.refusal == "unseen"
    assert solved(workcell, episode)
    assert workcell.counts[Event.MARKER_HIDDEN] >= 1


@pytest.mark.slow
def test_a_block_that_stays_out_of_sight_ends_the_episode_not_the_session(start):
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: workcell.twin.hide(30.0))
    begun_s = workcell.clock.now_s()
    episode = workcell.session.play(START, workcell.goal)
    assert (episode.ended, [str(transfer.result.refusal) for transfer in episode.transfers]) == ("stuck", ["unseen"])
    assert workcell.clock.now_s() - begun_s < 25.0
    workcell.clock.sleep_s(30.0)
    assert solved(workcell, workcell.session.play(START, workcell.goal))


def test_after_a_question_that_found_no_good_answer_the_motion_goes_on_where_it_was(start):
    """Answers get lost by lot until one question has gone without any, three times asked, of a board that is there otherwise."""
    workcell = start()

    def lose():
        if workcell.counts[Event.BAD_REPLY] == 0:
            workcell.twin.add_faults([make_fault("drop", workcell.clock.now_s(), 0.02, 0.45)])
            workcell.clock.at(workcell.clock.now_s() + 0.02, lose)

    when(workcell, lambda: carried_high(workcell), lose)
    episode = workcell.session.play(START, workcell.goal)
    assert workcell.counts[Event.BAD_REPLY] == 1
    assert len(episode.transfers) == 1
    assert solved(workcell, episode)


def test_a_host_that_was_late_goes_on_where_it_was(start):
    workcell = start()
    stalled = []

    def stall(row):
        if row["event"] == "state" and carried_high(workcell) and not stalled:
            stalled.append(workcell.clock.now_s())
            workcell.clock.sleep_s(1.0)

    workcell.session.log.show(stall)
    episode = workcell.session.play(START, workcell.goal)
    assert stalled
    assert workcell.counts[Event.HOST_LATE] == 1
    assert len(episode.transfers) == 1
    assert solved(workcell, episode)


def test_after_a_lost_cable_the_motion_goes_on_where_it_was(start):
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: workcell.twin.add_faults([make_fault("unplug", workcell.clock.now_s(), 1.0)]))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert len(episode.transfers) == 1
    assert workcell.counts[Event.SERIAL_LOST] == 1
    assert workcell.counts[Event.RECOVERED] == 1


def test_a_cable_that_stays_out_ends_the_session_in_time(start):
    workcell = start()
    workcell.twin.add_faults([make_fault("unplug", workcell.clock.now_s() + 2.0, 1e6)])
    with pytest.raises(DeviceError):
        workcell.session.play(START, workcell.goal)
    assert workcell.clock.now_s() < 20.0


def test_after_a_brown_out_somebody_parks_the_arms_and_the_loop_goes_on(start):
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: workcell.twin.add_faults([make_fault("brownout", workcell.clock.now_s(), 0.3)]))
    episode = workcell.session.play(START, workcell.goal)
    assert solved(workcell, episode)
    assert workcell.counts[Event.CONTROLLER_RESET] == 1
    assert workcell.counts[Event.ARMED] == 2
    assert episode.transfers[0].result.refusal in ("dropped", "missed_grasp")


def test_an_arm_that_does_nothing_time_and_again_ends_the_episode(start):
    workcell = start()
    channel = workcell.twin.hardware.arms[ARMS[0]].gripper.channel
    workcell.twin.add_faults([make_fault("jam", workcell.clock.now_s(), None, channel)])
    episode = workcell.session.play(START, workcell.goal)
    assert episode.ended == "stuck"
    assert workcell.counts[Event.ARM_STALLED] == 1
    assert told_as_it_was(workcell, episode)[-3:] == ["missed_grasp", "missed_grasp", "stalled"]


def test_what_the_gate_refuses_is_not_sent_and_the_arm_goes_home(start):
    workcell = start(step_deg=2.0)
    episode = workcell.session.play(START, workcell.goal)
    assert not episode.solved
    assert workcell.counts[Event.GATE_REFUSED] >= 1
    assert math.dist(workcell.twin.true_pose()[:2], START[:2]) < 1.0
    assert np.degrees(np.abs(workcell.twin.true_joints_rad() - workcell.session.backend.check.homes_rad)).max() < 6.0


def test_the_latched_stop_ends_the_session_where_it_is(start, tmp_path):
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: StopLatch(tmp_path / "stop").latch("test"))
    with pytest.raises(Stopped, match="test"):
        workcell.session.play(START, workcell.goal)
    assert lines(workcell.log)[-1]["event"] == "stopped"
    workcell.clock.sleep_s(0.2)
    before = workcell.twin.true_joints_rad()
    workcell.clock.sleep_s(1.0)
    np.testing.assert_allclose(workcell.twin.true_joints_rad(), before, atol=math.radians(0.2))
    assert StopLatch(tmp_path / "stop").obeyed_by() is not None


@pytest.mark.parametrize("why", ["hidden", "outside"])
def test_the_latched_stop_is_obeyed_while_nothing_moves(start, tmp_path, why):
    """Looking for a block, and waiting for one to be put back, last far longer than a stop may take."""
    workcell = start()
    pose = START if why == "hidden" else np.array([230.0, 0.0, 0.0])
    workcell.twin.hide(1e6 if why == "hidden" else 0.0)
    latched_s = workcell.clock.now_s() + 2.0
    workcell.clock.at(latched_s, lambda: StopLatch(tmp_path / "stop").latch("test"))
    with pytest.raises(Stopped, match="test"):
        workcell.session.play(pose, workcell.goal)
    assert workcell.clock.now_s() - latched_s < 0.1
    assert lines(workcell.log)[-1]["event"] == "stopped"
    assert StopLatch(tmp_path / "stop").obeyed_by() is not None
    workcell.clock.sleep_s(0.1)
    for device in workcell.twin.electronics.devices.values():
        assert [t_s for t_s, line in device.lines if b"STOP" in line and t_s >= latched_s]


def test_a_dry_run_does_everything_and_moves_nothing(start):
    workcell = start(dry_run=True)
    joints = workcell.twin.true_joints_rad()
    episode = workcell.session.play(START, workcell.goal)
    assert episode.solved
    np.testing.assert_allclose(workcell.twin.true_joints_rad(), joints, atol=1e-3)
    assert math.dist(workcell.twin.true_pose()[:2], START[:2]) < 0.5
    assert not any(b"#" in line for device in workcell.twin.electronics.devices.values() for _, line in device.lines)


def test_without_a_calibration_there_is_no_twin(model, tmp_path):
    with pytest.raises(MissingFile, match="calibrate"):
        make_backend("twin", model, policies.adapted("exact").rules.config, MotionConfig(), calibration=str(tmp_path))


@pytest.mark.parametrize("kind", ["ignore", "random", "frozen"])
def test_a_board_that_disobeys_ends_the_session_by_name(start, kind):
    workcell = start()
    when(workcell, lambda: carried_high(workcell), lambda: workcell.twin.add_faults([make_fault(kind, workcell.clock.now_s())]))
    with pytest.raises(PulseMismatch, match="board main"):
        workcell.session.play(START, workcell.goal)
    assert workcell.counts[Event.PULSE_MISMATCH] == 1
    assert workcell.session.backend.workcell.driver.state is State.STOPPED


def test_evaluations_on_the_twin_obey_no_stop_and_the_interactive_twin_its_own(twin_calibration, tmp_path, monkeypatch):
    for module in (session_registry, settings, estop):
        monkeypatch.setattr(module, "user_path", lambda suffix: tmp_path / f"user{suffix}")
    real, twins = (StopLatch(settings.HardwareConfig(name=name).stop_path()) for name in ("lynxmotion", "twin"))
    model, motion = build_cell(cell_config("paper")), MotionConfig()
    config = lab_config(twin_calibration, "")
    interactive = make_backend("hardware", model, TaskConfig(), motion, config=config)
    real.latch("real arms")
    interactive.reset(START, 0)
    twins.latch("the twin")
    with pytest.raises(Stopped, match="the twin"):
        interactive.reset(START, 0)
    evaluated = make_backend("twin", model, TaskConfig(), motion, calibration=str(twin_calibration))
    evaluated.reset(START, 0)
    twins.clear()
    real.clear()
    evaluated.workcell.driver.stop("an evaluation's own")
    assert [it.is_set() for it in (real, twins)] == [False, False]
    evaluated.close()
    interactive.close()
    assert not list(tmp_path.glob("user*stop"))

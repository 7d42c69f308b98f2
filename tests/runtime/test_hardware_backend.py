"""The closed loop on the calibrated twin, bytes and pixels and all; and every event with its reaction."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from marl_handover import policies
from marl_handover.arrays import wrap
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.config import MotionConfig, TaskConfig
from marl_handover.envs.backends import make_backend
from marl_handover.errors import MissingFile
from marl_handover.hardware import estop, session_registry, settings
from marl_handover.hardware.connection import State
from marl_handover.hardware.emulator.device import make_fault
from marl_handover.hardware.errors import DeviceError, PulseMismatch, Stopped
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.settings import ARMS
from marl_handover.runtime.evaluation import truly_solved
from marl_handover.runtime.events import FAULTS, Event
from marl_handover.runtime.loop import make_loop
from marl_handover.runtime.mishaps import Mishaps
from marl_handover.runtime.session import GivenGoal, NoGoal, Session
from marl_handover.runtime.settings import WatchConfig, twin_lab

START, PLACE_MM = np.array([-60.0, 20.0, 0.7]), np.array([50.0, 25.0])
"""A problem that the left arm solves in one transfer."""


def one_transfer(cell, start=START, place_mm=PLACE_MM, arm=0):
    turn = cell.polar(np.asarray(place_mm))[1][arm] - cell.polar(start[:2])[1][arm]
    return np.array([*place_mm, float(wrap(start[2] + turn))])


def lab_config(folder, stop, **hardware):
    config = twin_lab()
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
        twin = session.backend.lab.twin
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


def when(lab, condition, act, every_s=0.02):
    """Do ``act`` once, as soon as ``condition`` holds."""

    def look():
        if condition():
            act()
        else:
            lab.clock.at(lab.clock.now_s() + every_s, look)

    lab.clock.at(lab.clock.now_s(), look)


def carried_high(lab):
    return lab.twin.cell.block.height_mm() > 15.0


def solved(lab, episode):
    true = lab.twin.true_pose()
    assert episode.solved
    assert truly_solved(episode, lab.loop.rules)
    assert math.dist(true[:2], episode.goal[:2]) < 5.0
    assert abs(float(wrap(true[2] - episode.goal[2]))) < lab.loop.rules.epsilon_rad
    return True


def test_a_transfer_through_bytes_and_pixels_is_exact_to_some_mm(start):
    lab = start()
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert len(episode.transfers) == 1
    done = episode.transfers[0].done
    assert math.dist(done.truth[:2], lab.goal_pose[:2]) < 3.0
    assert abs(float(wrap(done.truth[2] - lab.goal_pose[2]))) < math.radians(2.0)
    assert math.dist(done.truth[:2], done.pose[:2]) < 1.5, "what the camera says is where it is"
    assert not FAULTS & set(lab.counts)
    rows = lines(lab.log)
    kinds = [row["event"] for row in rows]
    assert kinds[:5] == ["session", "episode", "armed", "seen", "goal"]
    assert [row["symmetry_order"] for row in rows if row["event"] in ("session", "transfer")] == [1, 1]
    assert kinds[-2:] == ["transfer", "ended"]
    states = [row for row in rows if row["event"] == "state"]
    assert len(states) > 20
    assert np.shape(states[0]["joints_rad"]) == (2, 5)
    assert all(later["t_s"] >= row["t_s"] for row, later in pairwise(rows))


def test_a_failed_grasp_is_seen_and_tried_again(start):
    lab = start()
    Mishaps(lab.twin, lab.loop.rules).arrange("missed_grasp", 0.3, lab.goal)
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.FAILED_GRASP] == 1
    assert [str(transfer.done.refusal) for transfer in episode.transfers] == ["missed_grasp", "None"]


def test_a_dropped_block_is_picked_up_where_it_lies(start):
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: lab.twin.nudge([0.0, -20.0, 2.0]))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.DROPPED] == 1


def test_a_block_moved_while_a_hand_comes_near_calls_the_hand_back(start):
    lab = start()
    lab.clock.at(lab.clock.now_s() + 0.75, lambda: lab.twin.nudge(START + (18.0, 0.0, 0.2)))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.BLOCK_MOVED] == 1
    assert episode.transfers[0].done.refusal == "missed_grasp"
    assert not lab.twin.follower.collisions


def test_a_goal_that_changes_in_mid_motion_is_reached_after_the_transfer(start):
    lab = start()
    new = one_transfer(lab.loop.rules.cell, lab.goal_pose, [-30.0, -5.0])
    when(lab, lambda: carried_high(lab), lambda: lab.goal.set(new))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.GOAL_CHANGED] == 1
    np.testing.assert_array_equal(episode.goal, new)
    first = episode.transfers[0]
    assert math.dist(first.done.truth[:2], lab.goal_pose[:2]) < 5.0, "the transfer that was under way was finished"


def test_the_printed_goal_is_gone_for(start):
    lab = start()
    lab.twin.goal = lab.goal_pose
    episode = lab.session.play(START, lab.session.printed)
    assert math.dist(episode.goal[:2], lab.goal_pose[:2]) < 1.0
    assert solved(lab, episode)


def test_a_printed_goal_that_the_block_covers_is_the_one_before(start):
    """A second episode on a real cell begins with the block where the first one put it: on the marker."""
    lab = start()
    lab.twin.goal = lab.goal_pose
    with pytest.raises(NoGoal):
        lab.session.play(lab.goal_pose, lab.session.printed)
    assert solved(lab, lab.session.play(START, lab.session.printed))
    for _ in range(2):
        episode = lab.session.play(lab.twin.true_pose(), lab.session.printed)
        assert math.dist(episode.goal[:2], lab.goal_pose[:2]) < 1.0
        assert solved(lab, episode)
    lab.session.printed.forget()
    with pytest.raises(NoGoal):
        lab.session.play(lab.goal_pose, lab.session.printed)


def test_a_block_outside_all_reach_is_waited_for(start):
    lab = start()
    outside = np.array([230.0, 0.0, 0.0])
    lab.clock.at(lab.clock.now_s() + 2.0, lambda: lab.twin.nudge(START))
    episode = lab.session.play(outside, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.BLOCK_OUTSIDE] == 1
    assert lab.counts[Event.RECOVERED] == 1
    begun_s = lab.clock.now_s()
    episode = lab.session.play(outside, lab.goal)
    assert episode.ended == "stuck"
    assert lab.clock.now_s() - begun_s < 30.0


def test_a_hidden_marker_and_a_frozen_camera_are_waited_for(start):
    lab = start()
    lab.clock.at(lab.clock.now_s() + 3.5, lambda: lab.twin.hide(4.0))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.MARKER_HIDDEN] == 1
    lab.clock.at(lab.clock.now_s() + 3.5, lambda: lab.twin.freeze(3.0))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.CAMERA_FROZEN] == 1


@pytest.mark.slow
def test_a_block_out_of_sight_after_a_motion_is_not_taken_for_a_fallen_one(start):
    """A hand over it for longer than there is patience: it is waited for once more, and the episode goes on."""
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: lab.twin.hide(8.0))
    episode = lab.session.play(START, lab.goal)
    assert episode.transfers[0].done.refusal == "unseen"
    assert solved(lab, episode)
    assert lab.counts[Event.MARKER_HIDDEN] >= 1


@pytest.mark.slow
def test_a_block_that_stays_out_of_sight_ends_the_episode_not_the_session(start):
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: lab.twin.hide(30.0))
    begun_s = lab.clock.now_s()
    episode = lab.session.play(START, lab.goal)
    assert (episode.ended, [str(transfer.done.refusal) for transfer in episode.transfers]) == ("stuck", ["unseen"])
    assert lab.clock.now_s() - begun_s < 25.0
    lab.clock.sleep_s(30.0)
    assert solved(lab, lab.session.play(START, lab.goal))


def test_after_a_question_that_found_no_good_answer_the_motion_goes_on_where_it_was(start):
    """Answers get lost by lot until one question has gone without any, three times asked, of a board that is there otherwise."""
    lab = start()

    def lose():
        if lab.counts[Event.BAD_REPLY] == 0:
            lab.twin.add_faults([make_fault("drop", lab.clock.now_s(), 0.02, 0.45)])
            lab.clock.at(lab.clock.now_s() + 0.02, lose)

    when(lab, lambda: carried_high(lab), lose)
    episode = lab.session.play(START, lab.goal)
    assert lab.counts[Event.BAD_REPLY] == 1
    assert len(episode.transfers) == 1
    assert solved(lab, episode)


def test_a_host_that_was_late_goes_on_where_it_was(start):
    lab = start()
    stalled = []

    def stall(row):
        if row["event"] == "state" and carried_high(lab) and not stalled:
            stalled.append(lab.clock.now_s())
            lab.clock.sleep_s(1.0)

    lab.session.log.show(stall)
    episode = lab.session.play(START, lab.goal)
    assert stalled
    assert lab.counts[Event.HOST_LATE] == 1
    assert len(episode.transfers) == 1
    assert solved(lab, episode)


def test_after_a_lost_cable_the_motion_goes_on_where_it_was(start):
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: lab.twin.add_faults([make_fault("unplug", lab.clock.now_s(), 1.0)]))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert len(episode.transfers) == 1
    assert lab.counts[Event.SERIAL_LOST] == 1
    assert lab.counts[Event.RECOVERED] == 1


def test_a_cable_that_stays_out_ends_the_session_in_time(start):
    lab = start()
    lab.twin.add_faults([make_fault("unplug", lab.clock.now_s() + 2.0, 1e6)])
    with pytest.raises(DeviceError):
        lab.session.play(START, lab.goal)
    assert lab.clock.now_s() < 20.0


def test_after_a_brown_out_somebody_parks_the_arms_and_the_loop_goes_on(start):
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: lab.twin.add_faults([make_fault("brownout", lab.clock.now_s(), 0.3)]))
    episode = lab.session.play(START, lab.goal)
    assert solved(lab, episode)
    assert lab.counts[Event.CONTROLLER_RESET] == 1
    assert lab.counts[Event.ARMED] == 2
    assert episode.transfers[0].done.refusal in ("dropped", "missed_grasp")


def test_an_arm_that_does_nothing_time_and_again_ends_the_episode(start):
    lab = start()
    channel = lab.twin.hardware.arms[ARMS[0]].gripper.channel
    lab.twin.add_faults([make_fault("jam", lab.clock.now_s(), None, channel)])
    episode = lab.session.play(START, lab.goal)
    assert episode.ended == "stuck"
    assert lab.counts[Event.ARM_STALLED] == 1
    assert [str(transfer.done.refusal) for transfer in episode.transfers] == ["missed_grasp", "missed_grasp", "stalled"]


def test_what_the_gate_refuses_is_not_sent_and_the_arm_goes_home(start):
    lab = start(step_deg=2.0)
    episode = lab.session.play(START, lab.goal)
    assert not episode.solved
    assert lab.counts[Event.GATE_REFUSED] >= 1
    assert math.dist(lab.twin.true_pose()[:2], START[:2]) < 1.0
    assert np.degrees(np.abs(lab.twin.true_joints_rad() - lab.session.backend.check.home_rad)).max() < 6.0


def test_the_latched_stop_ends_the_session_where_it_is(start, tmp_path):
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: StopLatch(tmp_path / "stop").latch("test"))
    with pytest.raises(Stopped, match="test"):
        lab.session.play(START, lab.goal)
    assert lines(lab.log)[-1]["event"] == "stopped"
    lab.clock.sleep_s(0.2)
    before = lab.twin.true_joints_rad()
    lab.clock.sleep_s(1.0)
    np.testing.assert_allclose(lab.twin.true_joints_rad(), before, atol=math.radians(0.2))
    assert StopLatch(tmp_path / "stop").obeyed_by() is not None


@pytest.mark.parametrize("why", ["hidden", "outside"])
def test_the_latched_stop_is_obeyed_while_nothing_moves(start, tmp_path, why):
    """Looking for a block, and waiting for one to be put back, last far longer than a stop may take."""
    lab = start()
    pose = START if why == "hidden" else np.array([230.0, 0.0, 0.0])
    lab.twin.hide(1e6 if why == "hidden" else 0.0)
    latched_s = lab.clock.now_s() + 2.0
    lab.clock.at(latched_s, lambda: StopLatch(tmp_path / "stop").latch("test"))
    with pytest.raises(Stopped, match="test"):
        lab.session.play(pose, lab.goal)
    assert lab.clock.now_s() - latched_s < 0.1
    assert lines(lab.log)[-1]["event"] == "stopped"
    assert StopLatch(tmp_path / "stop").obeyed_by() is not None
    lab.clock.sleep_s(0.1)
    for device in lab.twin.electronics.devices.values():
        assert [t_s for t_s, line in device.lines if b"STOP" in line and t_s >= latched_s]


def test_a_dry_run_does_everything_and_moves_nothing(start):
    lab = start(dry_run=True)
    joints = lab.twin.true_joints_rad()
    episode = lab.session.play(START, lab.goal)
    assert episode.solved
    np.testing.assert_allclose(lab.twin.true_joints_rad(), joints, atol=1e-3)
    assert math.dist(lab.twin.true_pose()[:2], START[:2]) < 0.5
    assert not any(b"#" in line for device in lab.twin.electronics.devices.values() for _, line in device.lines)


def test_without_a_calibration_there_is_no_twin(model, tmp_path):
    with pytest.raises(MissingFile, match="calibrate"):
        make_backend("twin", model, policies.adapted("exact").rules.config, MotionConfig(), calibration=str(tmp_path))


@pytest.mark.parametrize("kind", ["ignore", "random", "frozen"])
def test_a_board_that_disobeys_ends_the_session_by_name(start, kind):
    lab = start()
    when(lab, lambda: carried_high(lab), lambda: lab.twin.add_faults([make_fault(kind, lab.clock.now_s())]))
    with pytest.raises(PulseMismatch, match="board main"):
        lab.session.play(START, lab.goal)
    assert lab.counts[Event.PULSE_MISMATCH] == 1
    assert lab.session.backend.lab.driver.state is State.STOPPED


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
    evaluated.lab.driver.stop("an evaluation's own")
    assert [it.is_set() for it in (real, twins)] == [False, False]
    evaluated.close()
    interactive.close()
    assert not list(tmp_path.glob("user*stop"))

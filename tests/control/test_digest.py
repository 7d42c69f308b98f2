"""What a session does is told from its events, also when something goes wrong in between."""

from __future__ import annotations

import pytest

from marl_handover.control.events import BETWEEN, DECIDING, FAULTS, LOOKING, MOVING, PAUSED, STARTING, Event, SessionDigest

PHASES = [["approach", 0.0, 1.0], ["grasp", 1.0, 1.5], ["transfer", 1.5, 3.0], ["retreat", 3.0, 4.0]]


def transfer(arm="L", refusal=None):
    return {"event": "transfer", "arm": arm, "next_state": [1.0, 2.0, 3.0], "refusal": refusal}


def taken(*rows):
    digest = SessionDigest()
    for row in rows:
        digest.take(row)
    return digest


BEGUN = ({"event": "session"}, {"event": "episode"}, {"event": "armed"}, {"event": "seen", "pose": [0.0, 0.0, 0.0]})
MOVED = ({"event": "goal", "goal": [9.0, 9.0, 0.0]}, {"event": "motion", "arm": 1, "phases": PHASES}, {"event": "state"})


def test_an_episode_step_by_step():
    digest, told = SessionDigest(), []
    for row in (
        *BEGUN,
        *MOVED,
        {"event": "seen", "pose": [5.0, 5.0, 1.0]},
        transfer("R"),
        {"event": "ended", "ended": "success", "transfers": 1},
    ):
        digest.take(row)
        told.append(digest.doing)
    assert told == [STARTING, STARTING, LOOKING, DECIDING, DECIDING, MOVING, MOVING, DECIDING, DECIDING, BETWEEN]
    assert (digest.episode, digest.transfers, digest.ended, digest.solved, digest.previous_arm) == (0, 1, 1, 1, 1)
    assert (digest.pose, digest.goal) == ([1.0, 2.0, 3.0], [9.0, 9.0, 0.0])


@pytest.mark.parametrize(("reached_s", "phase"), [(0.5, "approach"), (1.2, "grasp"), (2.9, "transfer"), (3.5, "retreat"), (4.0, "retreat")])
def test_phases_follow_the_motion_s_time_once_it_has_begun(reached_s, phase):
    assert taken(*BEGUN, *MOVED).phase(reached_s) == phase
    assert taken(*BEGUN, *MOVED[:2]).phase(reached_s) == "", "nothing was sent yet"
    assert taken(*BEGUN, *MOVED, {"event": "seen", "pose": [0.0, 0.0, 0.0]}).phase(reached_s) == ""


@pytest.mark.parametrize("event", ["serial_lost", "bad_reply", "host_late"])
def test_a_motion_that_is_taken_up_again_is_still_that_motion(event):
    digest = taken(*BEGUN, *MOVED, {"event": event, "text": "cable"})
    assert digest.arm == 1
    assert "cable" in digest.text
    digest.take({"event": "state"})
    assert (digest.doing, digest.phase(2.0)) == (MOVING, "transfer")


@pytest.mark.parametrize("event", sorted(FAULTS))
def test_every_fault_is_counted_and_told(event):
    digest = taken(*BEGUN, {"event": str(event), "arm": 0, "reason": "why", "pose": [0.0] * 3, "goal": [0.0] * 3})
    assert digest.faults == {event: 1}
    assert str(event).replace("_", " ") in digest.text


@pytest.mark.parametrize("event", ["marker_hidden", "camera_frozen", "block_outside", "controller_reset", "serial_lost"])
def test_what_is_waited_for_is_said_until_it_is_over(event):
    digest = taken(*BEGUN, {"event": event})
    assert digest.doing.startswith("waiting")
    digest.take({"event": "recovered", "what": event})
    assert digest.doing == LOOKING
    assert digest.text.endswith("is over")


def test_an_arm_that_stalled_is_told_until_it_moves_the_block_again():
    digest = taken(*BEGUN, {"event": "arm_stalled", "arm": 1}, transfer("R", "declined"))
    assert digest.stalled == {1}
    digest.take(transfer("R"))
    assert digest.stalled == set()


def test_pauses_and_stops():
    digest = taken(*BEGUN, {"event": "paused"})
    assert digest.doing == PAUSED
    digest.take({"event": "resumed"})
    assert digest.doing == DECIDING
    digest.take({"event": "stopped", "reason": "fire"})
    assert digest.stopped == "fire"


def test_every_event_can_be_taken():
    row = {
        "arm": 0,
        "reason": "",
        "pose": [0.0] * 3,
        "goal": [0.0] * 3,
        "phases": PHASES,
        "what": "dropped",
        "ended": "stuck",
        "transfers": 1,
    }
    for event in Event:
        taken(*BEGUN, {**row, "event": str(event), **(transfer() if event is Event.TRANSFER else {})})

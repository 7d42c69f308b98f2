"""The log: each line whole and at once, strict JSON, counted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from marl_handover.control.events import FAULTS, NOTES, Event, EventLog
from marl_handover.errors import CannotWrite


def test_a_line_is_in_the_file_as_soon_as_it_is_added(tmp_path):
    path, now = tmp_path / "log.jsonl", [1.25]
    with EventLog(lambda: now[0], str(path)) as log:
        log.add(Event.SEEN, pose=np.array([1.0, 2.0, np.nan]), goal=None, works=np.bool_(True), count=np.int64(3))
        row = json.loads(path.read_text())
        assert row == {"t_s": 1.25, "event": "seen", "pose": [1.0, 2.0, None], "goal": None, "works": True, "count": 3}
        now[0] = 2.0
        log.add(Event.SERIAL_LOST, text=ValueError("cable"), what=Event.SEEN, nested={"a": (np.float32(0.5), "b")})
        rows = [json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines()]
    assert rows[1] == {"t_s": 2.0, "event": "serial_lost", "text": "cable", "what": "seen", "nested": {"a": [0.5, "b"]}}
    assert log.counts == {Event.SEEN: 1, Event.SERIAL_LOST: 1}


def test_without_a_file_events_are_counted_and_shown_to_a_listener():
    shown = []
    log = EventLog(lambda: 0.0, listener=shown.append)
    log.add(Event.DROPPED, arm=1)
    assert shown == [{"t_s": 0.0, "event": "dropped", "arm": 1}]
    assert not EventLog(lambda: 0.0).verbose


def test_a_log_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(CannotWrite, match="nowhere/log cannot be written"):
        EventLog(lambda: 0.0, str(tmp_path / "nowhere" / "log"))


def test_a_full_disk_interrupts_nothing_and_is_told_when_asked():
    shown = []
    log = EventLog(lambda: 0.0, "/dev/full", shown.append)
    log.require_written()
    log.add(Event.SEEN)
    log.add(Event.DROPPED, arm=1)
    assert len(shown) == 2
    assert log.counts.total() == 2
    with pytest.raises(CannotWrite, match="/dev/full cannot be written: No space"):
        log.require_written()
    log.close()


def test_every_event_is_a_note_or_a_fault():
    assert NOTES.isdisjoint(FAULTS)
    assert set(Event) == NOTES | FAULTS

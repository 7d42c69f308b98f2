"""Several viewers, a long trace, half a minute; bench/viewer.py measures the same for longer."""

from __future__ import annotations

import json
from functools import partial

import pytest
from viewer import drags, memory_mb, page, scrubbed, updates, watched

pytestmark = pytest.mark.slow

VIEWERS, LEAST_HZ, MOST_MB = 4, 20.0, 30.0


def test_four_viewers_of_ten_thousand_steps_are_kept_up_to_date(tmp_path):
    path = tmp_path / "trace.jsonl"
    place = [[-160.0, 90.0, 0.5], [-60.0, 0.0, 1.2], [60.0, 0.0, 0.2], [100.0, 100.0, 2.0]]
    line = {"final": False, "outcome": None, "epsilon_rad": 0.09, "goal": place[3]}
    rows = (
        {**line, "episode": number // 3, "arm": "LRL"[number % 3], "state": place[number % 3], "next_state": place[number % 3 + 1]}
        for number in range(10_000)
    )
    path.write_text("".join(json.dumps({**row, "place": row["next_state"][:2]}) + "\n" for row in rows))
    with page(f"trace={path}") as (address, pid), watched(address, VIEWERS) as viewers:
        scrub = partial(scrubbed, viewers[0])
        assert min(updates(viewers, 10.0, scrub)) >= LEAST_HZ
        memory = memory_mb(pid)
        assert min(updates(viewers, 10.0, scrub)) >= LEAST_HZ
        assert memory_mb(pid) - memory < MOST_MB


def test_four_viewers_of_a_cell_that_is_played_with_are_kept_up_to_date():
    with page("policy=exact") as (address, pid), watched(address, VIEWERS) as viewers:
        assert min(updates(viewers, 5.0)) >= LEAST_HZ
        drags(viewers[0], 10, 0)
        memory = memory_mb(pid)
        drags(viewers[0], 10, 1)
        assert memory_mb(pid) - memory < MOST_MB

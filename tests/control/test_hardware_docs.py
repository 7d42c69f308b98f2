"""docs/hardware.md: its commands exist and know their keys, its tables name every event."""

from __future__ import annotations

import importlib
import json
import re
import shlex
from pathlib import Path

import pytest

from marl_handover.cli import COMMANDS
from marl_handover.compose import compose
from marl_handover.control.events import Event

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "hardware.md").read_text(encoding="utf-8")
LINES = re.findall(r"^marl-handover (.+)$", TEXT, re.MULTILINE)


@pytest.mark.parametrize("line", LINES)
def test_commands_exist_and_know_their_keys(line):
    command, *arguments = shlex.split(line)
    module = importlib.import_module(COMMANDS[command].module)
    given = [argument for argument in arguments if argument != "--help"]
    assert isinstance(compose(module.SCHEMA, given, groups=module.GROUPS, aliases=module.ALIASES), module.SCHEMA)


@pytest.mark.parametrize("event", list(Event))
def test_every_event_is_explained(event):
    rows = [row for row in TEXT.splitlines() if row.startswith("|")]
    assert any(f"`{event}`" in row for row in rows)


def test_what_the_twin_came_to_is_what_is_stored():
    root = Path(__file__).resolve().parents[2]
    result = json.loads((root / "bench/results/2026-11-22/twin.json").read_text(encoding="utf-8"))
    plain, drills, settings = result["episodes"], result["drills"], result["settings"]
    assert (settings["noise"], settings["robots"], settings["policy"]) == (1.0, 10, "pretrained_twin")
    cells = " | ".join(f"{plain['transfer_mm'][p]:.2f} mm, {plain['transfer_deg'][p]:.2f}°" for p in ("p50", "p95"))
    assert f"| calibrated, dead band taken out | {cells} |" in TEXT
    assert (plain["count"], plain["first_time"], drills["count"], drills["in_the_end"]) == (200, 1.0, 200, 1.0)
    for part in (plain, drills):
        assert (part["violations"], part["hangs"], part["exceptions"]) == ({}, 0, [])
    twice = json.loads((root / "bench/results/2026-11-22/twin_noise2.json").read_text(encoding="utf-8"))
    assert (twice["settings"]["noise"], twice["episodes"]["count"], twice["episodes"]["first_time"]) == (2.0, 100, 1.0)
    assert "100 of 100 were solved at the first final placement" in " ".join(TEXT.split())
    soak = json.loads((root / "bench/results/2026-11-22/twin_soak.json").read_text(encoding="utf-8"))["soak"]
    assert (soak["transfers"], soak["processes"]) == (5001, 1)
    assert sum(part["episodes"] for part in soak["parts"]) == sum(part["first"] for part in soak["parts"]) == 1654
    assert {(round(mb), part["files"]) for part in soak["parts"] for mb in part["rss_mb"]} == {(816, 12)}
    assert "5,001 transfers in one process, 1,654 problems one after another, solved every one" in " ".join(TEXT.split())
    for text in (TEXT, (root / "README.md").read_text(encoding="utf-8")):
        assert "200 of 200 in the end" in " ".join(text.split())


def test_what_the_twin_of_three_arms_came_to_is_what_is_stored():
    stored = Path(__file__).resolve().parents[2] / "bench/results/2026-11-30/twin_triangle.json"
    result = json.loads(stored.read_text(encoding="utf-8"))
    drills, settings = result["drills"], result["settings"]
    assert (settings["cell"], settings["hardware"], settings["policy"], settings["robots"]) == ("triangle", "triangle_twin", "exact", 2)
    assert (drills["count"], drills["happened"], drills["reached"]) == (50, 50, 1.0)
    assert (drills["violations"], drills["hangs"], drills["exceptions"]) == ({}, 0, [])
    assert "50 of 50 random problems were solved in the end by `exact`" in " ".join(TEXT.split())


def test_what_many_arms_came_to_in_physics_is_what_is_stored():
    root = Path(__file__).resolve().parents[2]
    rows = json.loads((root / "bench/results/2026-11-30/many_arms_physics.json").read_text(encoding="utf-8"))["rows"]
    assert all(row["report"]["success_rate"] == row["report"]["success_in_the_end"] == 1.0 for row in rows)
    played = {tuple(word.partition("=")[2] for word in row["command"].split()[1:]) for row in rows}
    for engine in ("bullet", "mujoco"):
        for cell in ("triangle", "line4"):
            assert {(policy, cell, engine, "100", "0") for policy in ("exact", "pretrained_any")} <= played
        assert ("exact", "mixed.yaml", engine, "50", "0") in played
    text = (root / "docs/howto/cells.md").read_text(encoding="utf-8")
    assert "every one of 100 random problems of `triangle` and of `line4`, in either engine" in " ".join(text.split())

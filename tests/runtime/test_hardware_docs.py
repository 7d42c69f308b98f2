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
from marl_handover.runtime.events import Event

BENCHES = {1: "twin", 2: "twin_noise2"}
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
    runs = {noise: json.loads((root / "bench/results/2026-11-22" / f"{name}.json").read_text()) for noise, name in BENCHES.items()}
    for noise, label in ((1, "calibrated, dead band taken out"), (2, "the last with everything twice as bad")):
        assert runs[noise]["settings"]["noise"] == noise
        assert runs[noise]["settings"]["robots"] == 10
        mm, deg = (runs[noise]["episodes"][f"transfer_{unit}"] for unit in ("mm", "deg"))
        cells = " | ".join(f"{mm[p]:.2f} mm, {deg[p]:.2f}°" for p in ("p50", "p95"))
        assert f"| {label} | {cells} |" in TEXT
    plain, drills = runs[1]["episodes"], runs[1]["drills"]
    assert (plain["count"], plain["first_time"], drills["count"], drills["in_the_end"]) == (200, 1.0, 200, 1.0)
    for part in (plain, drills):
        assert (part["violations"], part["hangs"], part["exceptions"]) == ({}, 0, [])
    for text in (TEXT, (root / "README.md").read_text(encoding="utf-8")):
        assert "200 of 200 in the end" in " ".join(text.split())

"""docs/hardware.md: its commands exist and know their keys, its tables name every event."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from marl_handover.cli import COMMANDS
from marl_handover.compose import compose
from marl_handover.runtime.events import Event

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

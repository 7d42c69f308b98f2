"""A slice of ``make fuzz``: hostile command lines end in one short line, valid ones work."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz_command_lines import Generator, hostile_files

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("lines", ["100", pytest.param("500", marks=pytest.mark.slow)])
def test_random_command_lines(lines):
    """In a process of their own, whose memory is theirs alone; another seed than ``make fuzz`` has."""
    script = ROOT / "tests" / "fuzz_command_lines.py"
    done = subprocess.run([sys.executable, str(script), lines, "1"], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "0 wrong" in done.stdout.splitlines()[-1]


@pytest.fixture
def generator(tmp_path):
    return Generator(3, hostile_files(tmp_path))


def test_the_lines_reach_every_command_and_every_section(generator):
    lines = [generator.line() for _ in range(20_000)]
    keys = {(line[0], argument.partition("=")[0]) for line in lines for argument in line[1:]}
    for command, known in generator.keys.items():
        missed = [key.name for key in known if (command, key.name) not in keys]
        assert len(missed) <= 0.05 * len(known), (command, missed)


def test_the_same_seed_makes_the_same_lines(tmp_path):
    files = hostile_files(tmp_path)
    first, second = (Generator(5, files) for _ in range(2))
    assert [first.line() for _ in range(200)] == [second.line() for _ in range(200)]

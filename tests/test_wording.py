"""How sentences are written, everywhere: one spelling, "1 transfer", no minus before 0."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.errors import CorruptFile, counted
from marl_handover.viewer.words import degrees_words, place_words

SOURCES = sorted((Path(__file__).resolve().parents[1] / "marl_handover").rglob("*.py"))
NOT_SO = {
    "a file that was written is told as written: PATH": r"""["']wrote """,
    "a count and its noun are put together by counted()": (
        r"(?<!of )\{(?![A-Z_]+\})[^{}]*\} (transfers|episodes|problems|pictures|trials|threads)\b"
    ),
    "a coordinate is written with z, so that -0.04 is 0.0": r"\(\{[^{}]*:[+]?[0-9]*\.\d+f\}, ",
}


@pytest.mark.parametrize(("pattern"), NOT_SO.values(), ids=NOT_SO)
def test_all_messages_are_written_so(pattern):
    found = {f"{path.name}: {hit[0]}" for path in SOURCES for hit in re.finditer(pattern, path.read_text(encoding="utf-8"))}
    assert not found


def test_one_is_not_many():
    assert [counted(count, "transfer") for count in (0, 1, 2, 1000)] == ["0 transfers", "1 transfer", "2 transfers", "1,000 transfers"]


@given(st.floats(-0.49, 0.49), st.floats(-0.008, 0.008))
def test_nothing_is_minus_nothing(length_mm, angle_rad):
    assert place_words((length_mm, -length_mm)) == "(0, 0) mm"
    assert degrees_words(angle_rad) == "0°"


def test_an_error_of_another_process_says_the_same_and_keeps_its_attributes():
    error = CorruptFile("plugin", Path("mine.py"), "SyntaxError")
    other = pickle.loads(pickle.dumps(error))
    assert (type(other), str(other), vars(other)) == (CorruptFile, str(error), vars(error))

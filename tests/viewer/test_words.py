from __future__ import annotations

import html
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.control.interactive.cell import Placement, Snapshot
from marl_handover.viewer.words import decision_words, error_words, place_words, plain, score_words, state_words


def snapshot(**changes):
    values = dict.fromkeys(Snapshot._fields, 0) | {"state": "moving", "arm": 1, "phase": "transfer", "ratio": math.nan, "message": ""}
    return Snapshot(**(values | changes))


@given(st.text())
def test_plain_text_is_shown_as_it_is_and_is_no_markup(text):
    shown = plain(text)
    assert html.unescape(shown) == " ".join(text.split())
    assert not set(re.sub(r"&#\d+;", "", shown)) & set("<>&[]*_`~|\\\n")


def test_places_are_whole_millimetres_without_a_minus_before_zero():
    assert place_words((-0.2, 12.6, 1.0)) == "(0, 13) mm"


def test_an_error_goes_the_short_way_round_and_by_the_blocks_symmetry(rules_of, paper):
    pose, goal = (3.0, 4.0, math.radians(179)), (0.0, 0.0, math.radians(-179))
    assert error_words(rules_of(paper), pose, goal) == "5.0 mm, 2.0°"
    assert error_words(rules_of(paper, symmetry_order=4), (0, 0, math.pi / 2), (0, 0, 0)) == "0.0 mm, 0.0°"


def test_a_decision_tells_the_arm_the_place_and_what_is_foreseen(rules_of, paper):
    rules = rules_of(paper, epsilon_deg=5.0)
    plan = (Placement(np.array([12.0, -34.0, 0.0]), 1, False), Placement(np.array([100.0, 0.0, 0.02]), 0, True))
    text = decision_words(rules, plan, (100.0, 0.0, 0.0))
    assert text == "right arm to a hand-over at (12, -34) mm; foreseen: 0.0 mm, 1.1° from the goal after 2 transfers, 5° allowed"
    assert decision_words(rules, plan[1:], (100.0, 0.0, 0.0)).startswith(
        "left arm to the goal; foreseen: 0.0 mm, 1.1° from the goal after 1 tr"
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "The right arm carries the block."),
        ({"phase": "retreat", "arm": 0}, "The left arm goes home."),
        ({"state": "done", "arm": -1}, "at its goal"),
        ({"state": "stopped", "arm": 1}, "STOPPED"),
        ({"state": "paused"}, "Paused"),
        ({"state": "stuck", "arm": -1}, "no way"),
    ],
)
def test_every_state_has_its_words(changes, words):
    assert words in state_words(snapshot(**changes))


def test_the_score_has_no_ratio_before_the_first_solved_problem():
    text = score_words(snapshot(transfers=2, optimal=3, solved=0, episodes=1))
    assert "| transfers so far | 2 |" in text
    assert "| problems solved | 0 of 1 (0%) |" in text
    assert "| transfers ÷ fewest | – |" in text
    assert "| transfers ÷ fewest | 1.25 |" in score_words(snapshot(ratio=1.25))

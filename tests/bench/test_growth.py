"""The model of what more arms cost: it finds a growth that is of its kind, and the page says what was stored."""

from __future__ import annotations

import json
from pathlib import Path

import growth
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marl_handover import policies
from marl_handover.config import LayoutConfig, TaskConfig
from marl_handover.learning.evaluation import problems_in_cells

ROOT = Path(__file__).resolve().parents[2]
STORED = json.loads((ROOT / "bench/results/2026-11-30/growth.json").read_text())
ARMS = range(2, 9)
COEFFICIENT = st.floats(0.01, 10.0)


@given(COEFFICIENT, COEFFICIENT, COEFFICIENT)
def test_a_growth_of_the_models_kind_is_found_and_continued(a, b, c):
    costs = [a + b * arms + c * arms**2 for arms in ARMS]
    fitted = growth.growth(ARMS, costs)
    for arms in (*ARMS, *growth.BEYOND):
        assert growth.modelled(fitted, arms) == pytest.approx(a + b * arms + c * arms**2, rel=1e-3)


@given(st.lists(st.floats(0.1, 100.0), min_size=7, max_size=7))
def test_the_model_never_falls(costs):
    fitted = growth.growth(ARMS, costs)
    assert min(fitted) >= 0
    assert growth.modelled(fitted, 32) >= growth.modelled(fitted, 16) >= growth.modelled(fitted, 8)


def test_the_stored_models_are_those_of_the_stored_costs():
    assert [int(arms) for arms in STORED["arms"]] == list(ARMS)
    for name, about in growth.models(STORED["arms"]).items():
        assert about["coefficients_ms"] == pytest.approx(STORED["models"][name]["coefficients_ms"], abs=1e-9)
        assert about["beyond_ms"] == pytest.approx(STORED["models"][name]["beyond_ms"])


def test_the_page_says_what_was_stored():
    page = (ROOT / "docs/concepts/many-arms.md").read_text(encoding="utf-8")
    assert f"{growth.BEGIN}\n{growth.page_text(STORED)}\n{growth.END}" in page


@pytest.mark.slow
def test_both_costs_can_be_measured():
    (posed,) = problems_in_cells(LayoutConfig(arms=[2, 2]), 2, TaskConfig(), 8, 0).values()
    assert growth.decision_ms(policies.load("pretrained_any"), posed, 3) > 0
    assert growth.gradient_step_ms(2, 1) > 0

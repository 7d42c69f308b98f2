"""A cell with some of its arms out of order: it is the cell that the others make, also where they cannot pass to each other any more."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from marl_handover import policies
from marl_handover.cell import Cell, build_cell, layout_cell, load_cell
from marl_handover.cell.batch import LayoutPool
from marl_handover.cli import main
from marl_handover.config import CellConfig, LayoutConfig, TaskConfig
from marl_handover.errors import InvalidSetting, TwoArmsOnly, UnconnectedArms, UnknownChoice
from marl_handover.task.episode import play
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules

TASK = TaskConfig(layout="graph")


def drawn(seed: int, arms: int, obstacles: int) -> Cell:
    config = LayoutConfig(arms=[arms, arms], obstacles=[obstacles, obstacles])
    return LayoutPool.random(config, 1, np.random.default_rng(seed)).cell(0)


def records(cell: Cell, names: tuple[str, ...]) -> tuple[list[dict], list[dict]]:
    """Arms and obstacles as a file without the other arms has them."""
    arms = [
        {"name": arm.name, "x_mm": arm.base.x_mm, "y_mm": arm.base.y_mm, "facing_rad": arm.base.facing_rad}
        | {"r_min_mm": arm.r_min_mm, "r_max_mm": arm.r_max_mm, "yaw_range_rad": list(arm.yaw_rad)}
        for arm in cell.arms
        if arm.name in names
    ]
    return arms, [{"x_mm": each.x_mm, "y_mm": each.y_mm, "radius_mm": each.radius_mm} for each in cell.config.obstacles]


def problems(cell: Cell, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    start, goal = sample_problems(cell, count, torch.Generator().manual_seed(0))
    return start.numpy(), goal.numpy()


def optimum(cell: Cell, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return ExactPlanner(Rules(cell, TASK)).plan(start, goal).transfers


@st.composite
def some_arms(draw) -> tuple[Cell, tuple[str, ...]]:
    cell = drawn(draw(st.integers(0, 10_000)), draw(st.integers(3, 6)), draw(st.integers(0, 2)))
    return cell, tuple(draw(st.lists(st.sampled_from(cell.names), min_size=1, max_size=cell.num_arms - 1, unique=True)))


@settings(max_examples=40)
@given(some_arms())
def test_it_is_the_cell_of_a_file_without_them(drawn_arms):
    """Group by group of arms that can pass to each other: an object cannot leave its group."""
    cell, names = drawn_arms
    left = cell.with_arms(names)
    assert left.names == tuple(name for name in cell.names if name in names)
    assert [cell.arms[arm] for arm in cell.numbered(range(left.num_arms), left)] == list(left.arms)
    here = left.numbered([-1, *range(cell.num_arms)], cell)
    assert [name if arm < 0 else left.names[arm] for name, arm in zip(cell.names, here[1:], strict=True)] == list(cell.names)
    assert here[0] == -1
    assert (here >= 0).sum() == left.num_arms
    named = {frozenset((left.names[i], left.names[j])): space for (i, j), space in left.graph.edges.items()}
    whole = {frozenset((cell.names[i], cell.names[j])) for i, j in cell.graph.edges}
    assert set(named) == {edge for edge in whole if edge <= set(names)}
    start, goal = problems(cell)
    best = np.where(Rules(left, TASK).can_finish(start, goal).any(-1), 1, 0)
    for group in left.graph.components:
        if len(group) == 1:
            continue
        filed = layout_cell(*records(cell, tuple(left.names[arm] for arm in group)))
        for (i, j), space in filed.graph.edges.items():
            of_rest = named[frozenset((filed.names[i], filed.names[j]))]
            np.testing.assert_allclose(of_rest.chart.arcs, space.chart.arcs, rtol=0, atol=1e-9)  # the file's angles are rounded
        found = optimum(filed, start, goal)
        best = np.where((found > 0) & ((best == 0) | (found < best)), found, best)
    np.testing.assert_array_equal(optimum(left, start, goal), best)


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.data())
def test_the_order_in_which_they_fail_does_not_matter(seed, data):
    cell = drawn(seed, 5, 1)
    out = data.draw(st.lists(st.sampled_from(cell.names), min_size=2, max_size=3, unique=True))
    results = []
    for order in permutations(out):
        left = cell
        for name in order:
            left = left.with_arms([each for each in left.names if each != name])
        results.append(left)
    assert all(left == results[0] for left in results)
    assert results[0] == cell.with_arms([name for name in reversed(cell.names) if name not in out])
    assert cell.with_arms(cell.names) is cell


@pytest.mark.parametrize("architecture", ["A", "B"])
@pytest.mark.parametrize(
    ("cell", "names"), [("paper", ["right"]), ("line4", ["first", "fourth"]), ("ring6", ["one", "three", "five"]), ("line4", ["third"])]
)
def test_arms_that_share_nothing_do_what_each_can_alone(cell, names, architecture):
    """The exact policy solves what one transfer solves, and nobody sees a number that is none."""
    left = load_cell(cell).with_arms(names)
    assert not left.graph.edges
    rules = Rules(left, TaskConfig(architecture=architecture, layout="graph"))
    start, goal = problems(left, 2000)
    able = rules.can_finish(start, goal).any(-1)
    assert 0 < able.sum() < 200
    np.testing.assert_array_equal(ExactPlanner(rules).plan(start, goal).transfers, able)
    for name in ("exact", "greedy", "random", "shielded:random", "pretrained_any", "shielded:pretrained_any"):
        policy = policies.load(name, left, rules.config)
        played = play(rules, policy.act, start, goal)
        assert policy.alternatives(policy.act(start, goal, np.full(2000, -1)), start, goal, np.full(2000, -1)).ndim == 3
        solved = played.outcome == int(Outcome.SUCCESS)
        assert not (solved & ~able).any()
        assert name == "random" or (solved == able).all()
    seen = observe(rules, "graph", start, goal, np.full(len(start), -1))
    assert seen.shape == (len(start), observation_size("graph", left.num_arms))
    assert np.isfinite(seen).all()


def test_what_needs_a_pair_that_shares_something_says_so():
    apart = load_cell("line4").with_arms(["first", "fourth"])
    with pytest.raises(UnconnectedArms, match=r"\(first\) and \(fourth\)"):
        _ = apart.chart
    with pytest.raises(UnconnectedArms):
        policies.load("pretrained_b", apart)
    with pytest.raises(TwoArmsOnly, match="this cell has 1: left"):
        policies.load("pretrained_b", load_cell("paper").with_arms(["left"]))


@pytest.mark.parametrize("name", ["paper", "triangle", "line4"])
def test_settings_name_the_arms_that_are_in_order(name):
    whole = build_cell(load_cell(name).config)
    names = whole.cell.names[1:]
    left = build_cell(CellConfig(**{**vars(load_cell(name).config), "enabled": list(reversed(names))}))
    assert left.cell == load_cell(left.cell.config) == whole.cell.with_arms(names)
    assert left.cell.labels == whole.cell.labels[1:]
    assert whole.with_arms(names).arms == whole.arms[1:]
    assert len(left.arms) == len(left.fits) == len(left.robots) == len(left.grid.masks) == len(names)
    np.testing.assert_array_equal(left.grid.masks, whole.grid.masks[1:])


def test_names_that_cannot_be():
    cell = load_cell("triangle")
    with pytest.raises(UnknownChoice, match="south"):
        cell.with_arms(["north", "south"])
    with pytest.raises(InvalidSetting, match="'north' comes twice"):
        cell.with_arms(["north", "east", "north"])
    with pytest.raises(InvalidSetting, match="at least one of: north, west, east"):
        cell.with_arms([])
    with pytest.raises(UnknownChoice, match="north"):
        cell.with_arms(["east", "west"]).with_arms(["north"])


@pytest.mark.parametrize("command", ["evaluate", "plan", "simulate", "run"])
@pytest.mark.parametrize(("text", "said"), [("[norht]", "norht"), ("[]", "1"), ("[left,left]", "twice")])
def test_the_command_line_says_so_in_one_line(command, text, said, capsys):
    assert main([command, f"arms.enabled={text}"]) == 2
    line = capsys.readouterr().err.strip()
    assert said in line
    assert "\n" not in line
    assert len(line) <= 300


def test_a_policy_of_pairs_wants_two_arms(capsys):
    assert main(["evaluate", "policy=pretrained_b", "arms.enabled=[left]"]) == 2
    assert "a trained policy is for two arms; this cell has 1: left" in capsys.readouterr().err


def test_plan_says_what_cannot_be_reached_any_more(capsys):
    across = ["start=[-220,60,0]", "goal=[220,60,90]", "cell=triangle", "epsilon_deg=5"]
    assert main(["plan", *across, "arms.enabled=[west,east]"]) == 0
    capsys.readouterr()
    assert main(["plan", *across, "arms.enabled=[west]"]) == 2
    assert "goal (220, 60) mm is out of every arm's reach" in capsys.readouterr().err
    assert main(["plan", "start=[-150,120,0]", "goal=[150,120,90]", "arms.enabled=[left]"]) == 1
    said = capsys.readouterr()
    assert "unsolvable: no sequence of up to 20 transfers turns the object by 90 deg" in said.out

"""Cells of any number of arms: who can pass to whom, symmetries, the rule book and the exact planner; and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs.utils import check_env_specs

from marl_handover.cell import build_cell, load_cell
from marl_handover.cell.shared_space import SharedSpace
from marl_handover.cli import main
from marl_handover.compose import to_yaml
from marl_handover.config import ArmConfig, CellConfig, TaskConfig
from marl_handover.envs.goal_env import SupervisorGoalEnv
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.errors import InvalidSetting, TwoArmsOnly, UnconnectedArms, UnequalArms
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules

SIDE_MM = 360.0


def ring(count: int, side_mm: float = SIDE_MM) -> list[ArmConfig]:
    """Arms on a regular polygon, each facing its middle."""
    radius = side_mm / (2 * math.sin(math.pi / count))
    angles = 90.0 + 360.0 / count * np.arange(count)
    return [
        ArmConfig(f"arm{k}", float(radius * math.cos(math.radians(a))), float(radius * math.sin(math.radians(a))), float(a + 180.0) % 360.0)
        for k, a in enumerate(angles)
    ]


def config(arms: list[ArmConfig], **settings: float) -> CellConfig:
    return replace(CellConfig(name="test", grid_mm=10.0), arms=arms, **settings)


@pytest.fixture(scope="module")
def triangle():
    return load_cell(config(ring(3)))


@pytest.fixture(scope="module")
def line():
    """Three arms in a bent row: the outer ones face the one in the middle and are out of each other's reach."""
    x, y = 350.0 * math.cos(math.radians(49.0)), 350.0 * math.sin(math.radians(49.0))
    return load_cell(config([ArmConfig("west", x, y, 229.0), ArmConfig("middle"), ArmConfig("east", x, -y, 131.0)]))


def test_the_pair_is_one_instance_of_many(paper):
    """Two arms given one by one are the mirrored pair."""
    given = load_cell(replace(paper.config, arms=[ArmConfig("l", 0.0, 180.0, -90.0), ArmConfig("r", 0.0, -180.0, 90.0)]))
    points = np.random.default_rng(0).uniform(-400, 400, (2000, 2))
    np.testing.assert_array_equal(given.reaches(points), paper.reaches(points))
    assert len(given.symmetries) == len(paper.symmetries) == 4
    assert (given.labels, paper.labels) == (("l", "r"), ("L", "R"))


def test_who_shares_a_place_with_whom(triangle, line):
    assert set(triangle.graph.edges) == {(0, 1), (0, 2), (1, 2)}
    assert set(line.graph.edges) == {(0, 1), (1, 2)}
    assert line.graph.neighbours(1) == (0, 2)
    assert line.graph.is_connected


def test_an_empty_shared_space_is_one_that_no_point_is_in(line, triangle):
    points = np.random.default_rng(1).uniform(-700, 700, (200_000, 2))
    for cell in (line, triangle):
        reach = cell.reaches(points)
        for i in range(3):
            for j in range(i):
                assert SharedSpace(cell.arms[j], cell.arms[i]).is_empty != (reach[:, i] & reach[:, j]).any()


@pytest.mark.parametrize(("count", "expected"), [(3, 6), (4, 8)])
def test_a_regular_ring_has_all_the_symmetries_of_its_polygon(count, expected):
    cell = load_cell(config(ring(count)))
    assert len(cell.symmetries) == expected
    assert cell.symmetries[0].arms == tuple(range(count))
    points = np.random.default_rng(2).uniform(-500, 500, (3000, 3))
    for element in cell.symmetries:
        image = cell.reaches(element.pose(points))
        np.testing.assert_array_equal(image[:, list(element.arms)], cell.reaches(points))
        for other in cell.symmetries:
            product = element.then(other)
            known = next(each for each in cell.symmetries if each.arms == product.arms)
            np.testing.assert_allclose(product.matrix, known.matrix, atol=1e-9)
            assert product.chart_signs == known.chart_signs


def test_a_symmetry_of_the_cell_is_one_of_the_rules(triangle):
    rules, draw = Rules(triangle, TaskConfig(layout="raw")), np.random.default_rng(3)
    start, goal = (part.numpy() for part in sample_problems(triangle, 300, torch.Generator().manual_seed(0)))
    action, previous = draw.uniform(-1, 1, (300, rules.action_size)), draw.integers(-1, 3, 300)
    plain = rules.step(start, goal, previous, action)
    for element in triangle.symmetries:
        image = rules.step(element.pose(start), element.pose(goal), element.arm(previous), element.action(action))
        np.testing.assert_array_equal(image.feasible, plain.feasible)
        np.testing.assert_array_equal(image.outcome, plain.outcome)
        moved = plain.feasible
        assert moved.any()
        np.testing.assert_allclose(image.pose[moved, :2], element.pose(plain.pose)[moved, :2], atol=1e-6)


def test_arms_are_chosen_by_score_and_places_lie_where_both_reach(triangle):
    rules, draw = Rules(triangle, TaskConfig(layout="raw")), np.random.default_rng(4)
    action = draw.uniform(-1, 1, (500, rules.action_size))
    command = rules.decode(action)
    arm, receiver = action[:, 1:4].argmax(-1), action[:, 4:7].argmax(-1)
    np.testing.assert_array_equal(command.arm, arm)
    reach, rows = triangle.reaches(np.nan_to_num(command.place_mm, nan=1e6)), np.arange(500)
    np.testing.assert_array_equal(reach[rows, arm] & reach[rows, receiver], arm != receiver)
    torch_place = rules.decode(torch.tensor(action)).place_mm.numpy()
    np.testing.assert_allclose(torch_place, command.place_mm, atol=1e-9)


@pytest.mark.parametrize("name", ["triangle", "line"])
def test_exact_plans_come_true_and_no_shorter_one_is_known(name, request):
    cell = request.getfixturevalue(name)
    rules = Rules(cell, TaskConfig(layout="raw"))
    planner = ExactPlanner(rules)
    pose, goal = (part.numpy() for part in sample_problems(cell, 400, torch.Generator().manual_seed(1)))
    plan = planner.plan(pose, goal)
    solved = plan.transfers > 0
    assert solved.mean() > 0.99
    previous, left = np.full(400, -1), plan.transfers.copy()
    for _ in range(int(left.max())):
        going = left > 0
        result = rules.step(pose, goal, previous, planner.act(pose, goal))
        assert result.feasible[going & solved].all()
        assert (result.outcome[going & (left == 1)] == Outcome.SUCCESS).all()
        pose, previous = np.where(going[:, None], result.pose, pose), np.where(going, result.previous_arm, previous)
        left -= going
        assert (planner.plan(pose, goal).transfers[left > 0] == left[left > 0]).all()


def test_plans_of_three_arms_against_random_search(triangle):
    """No sequence of random hand-overs solves a problem with fewer transfers than the plan has."""
    rules, draw = Rules(triangle, TaskConfig(layout="raw")), np.random.default_rng(5)
    start, goal = (part.numpy() for part in sample_problems(triangle, 40, torch.Generator().manual_seed(2)))
    best = ExactPlanner(rules).plan(start, goal).transfers
    pose = np.repeat(start, 4000, 0)
    target = np.repeat(goal, 4000, 0)
    for transfers in (1, 2):
        solved = rules.can_finish(pose, target).any(-1).reshape(40, -1).any(-1)
        assert (best[solved] <= transfers).all()
        result = rules.step(
            pose, target, np.full(len(pose), -1), np.r_["1", np.full((len(pose), 1), -1.0), draw.uniform(-1, 1, (len(pose), 8))]
        )
        pose = np.where(result.feasible[:, None], result.pose, pose)


def test_walks_follow_the_graph(line):
    planner = ExactPlanner(Rules(line, TaskConfig(layout="raw", max_steps=5)))
    for walk in planner.walks:
        for giver, receiver in pairwise(walk):
            assert (min(giver, receiver), max(giver, receiver)) in line.graph.edges


def test_the_raw_layout_shows_which_of_three_arms_moved_last(triangle):
    rules = Rules(triangle, TaskConfig(layout="raw"))
    start, goal = (part.numpy() for part in sample_problems(triangle, 4, torch.Generator().manual_seed(0)))
    seen = observe(rules, "raw", start, goal, np.array([-1, 0, 1, 2]))
    assert seen.shape[-1] == observation_size("raw", 3) == 9
    np.testing.assert_array_equal(seen[:, 6:], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def test_arms_of_two_kinds_have_a_reach_each():
    arms = [ArmConfig("small", 0.0, 220.0, -90.0), ArmConfig("large", 0.0, -180.0, 90.0, "./urdf/al5a.urdf")]
    model = build_cell(config([*arms, ArmConfig("third", 440.0, -80.0, 180.0, "./urdf/al5a.urdf")]))
    reach = {arm.name: (arm.r_min_mm, arm.r_max_mm) for arm in model.cell.arms}
    assert reach["small"] == (150.0, 230.0)
    assert reach["large"] == reach["third"]
    assert reach["large"][1] > 300
    with pytest.raises(UnequalArms, match="all arms must have the same robot for this; they have: small al5a_paper, large"):
        _ = model.arm
    with pytest.raises(UnequalArms, match="r_max_mm"):
        _ = model.cell.r_max_mm


def test_what_is_made_for_two_arms_says_so(triangle):
    rules = Rules(triangle, TaskConfig())
    start, goal = sample_problems(triangle, 3, torch.Generator())
    with pytest.raises(TwoArmsOnly, match=r"task\.layout=relative is for two arms; this cell has 3: arm0, arm1, arm2"):
        observe(rules, "relative", start, goal, torch.full((3,), -1))
    with pytest.raises(TwoArmsOnly, match="the one chart of a cell"):
        _ = triangle.chart


@pytest.mark.parametrize("architecture", ["A", "B"])
def test_the_batched_and_the_goal_environment_take_three_arms(triangle, architecture):
    env = SupervisorEnv(64, triangle, TaskConfig(layout="raw", architecture=architecture), seed=0)
    check_env_specs(env, seed=0)
    assert env.rollout(5)["next", "feasible"].any()
    goal_env = SupervisorGoalEnv(architecture, triangle)
    check_env(goal_env, skip_render_check=True)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["train", "steps=64"], "training is for two arms; this cell has 3: arm0, arm1, arm2"),
        (["train", "steps=64", "variant=decentralised"], "training is for two arms"),
        (["train", "steps=64", "variant=decentralised"], "variant=decentralised take no others; train preset=one_cell"),
        (["train", "steps=64", "variant=centralised"], "variant=centralised take no others; train preset=one_cell"),
        (["train", "steps=64", "preset=dqn_b"], "algorithm=dqn and variant=hierarchical take no others"),
        (["evaluate", "policy=pretrained_b", "episodes=1"], "is for two arms; this cell has 3: arm0, arm1, arm2"),
        (["evaluate", "policy=pretrained_b", "episodes=1"], "policy=pretrained_any, exact and greedy take any cell"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_three_arms_given_to_a_learner_for_two_are_refused_in_one_line(command, words, tmp_path, capsys):
    path = tmp_path / "three.yaml"
    path.write_text(to_yaml(config(ring(3))))
    out = [f"out={tmp_path / 'run'}"] if command[0] == "train" else []
    assert main([command[0], f"cell={path}", *command[1:], *out]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
    assert not (tmp_path / "run" / "checkpoint.pt").exists()


@pytest.mark.parametrize(
    ("arms", "error", "words"),
    [
        ([ArmConfig("a"), ArmConfig("a", 400.0)], InvalidSetting, r"cell\.arms\[1\]\.name = 'a': must be a name that no other arm has"),
        ([ArmConfig("a"), ArmConfig("", 400.0)], InvalidSetting, r"cell\.arms\[1\]\.name"),
        ([ArmConfig("a")], InvalidSetting, r"cell\.arms = 1: must be two arms at least"),
        ([ArmConfig("a"), ArmConfig("b", 30.0)], InvalidSetting, r"the base of arm 'b', 30\.0 mm away"),
        ([*ring(3), ArmConfig("far", 2000.0, 0.0, 180.0)], UnconnectedArms, r"share no place: \(arm0, arm1, arm2\) and \(far\)"),
    ],
    ids=["one name twice", "no name", "one arm", "base inside base", "out of everybody's reach"],
)
def test_cells_that_cannot_be_are_refused_in_one_line(arms, error, words):
    with pytest.raises(error, match=words) as caught:
        build_cell(config(arms))
    assert "\n" not in str(caught.value)

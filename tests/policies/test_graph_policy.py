"""Laws of the policy for every cell, of random weights: places move with the table, are mirrored with it, and know no numbers of arms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from marl_handover import policies
from marl_handover.cell import build_cell, load_cell
from marl_handover.cell.batch import CellBatch, LayoutPool, random_layout
from marl_handover.cell.chart import PaperChart
from marl_handover.cell.sectors import chart_alpha
from marl_handover.config import BlockConfig, LayoutConfig, TaskConfig
from marl_handover.envs.handover_aec import HandoverEnv
from marl_handover.learning.graph_network import HandoverGraphs, branches, chosen
from marl_handover.policies import ShieldedPolicy
from marl_handover.task.episode import play
from marl_handover.task.observations import observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules
from tests.graph_policies import lead, random_policy
from tests.layouts import line, model_of, moved, ring
from tests.oracles.layouts import Layout

RINGS = {"r_min_mm": [120.0, 160.0], "r_max_mm": [215.0, 260.0]}  # of equal arms two pieces of a curve are equally long: any may be taken
MIXED = LayoutConfig(arms=[2, 6], **RINGS, yaw_deg=[60.0, 132.0], obstacles=[0, 4])
CLOSE = LayoutConfig(arms=[2, 4], **RINGS, spacing_mm=[60.0, 250.0], apart_mm=60.0, obstacles=[0, 2], radius_mm=[5.0, 20.0])
FEW = [MIXED, CLOSE]
COUNT = 60


def drawn(seed):
    """A random layout and problems in it: arms (N, 8), discs, starts, goals, arms that moved last."""
    draw = np.random.default_rng(seed)
    arms, discs = random_layout(FEW[seed % 2], draw, BlockConfig())
    cell = CellBatch(LayoutPool([(arms, discs)]), np.zeros(COUNT, np.int64))
    start, goal = (poses.numpy() for poses in sample_problems(cell, COUNT, torch.Generator().manual_seed(seed)))
    return arms, discs, start, goal, draw.integers(-1, len(arms), COUNT)


def rules_of(arms, discs, **task):
    """The rule book of a layout, one row for each problem."""
    return Rules(CellBatch(LayoutPool([(arms, discs)]), np.zeros(COUNT, np.int64)), TaskConfig(**task))


def decided(policy, *problem):
    """What the policy does on problems where no other branch is nearly as good: rows, final, arm, receiver, place in the world."""
    command = policy.rules.decode(policy.act(*problem))
    return lead(policy, *problem) > 3e-3, command.final, command.arm, command.receiver, command.place_mm


def assert_alike(one, other, renamed=lambda arm: arm, again=lambda place: place):
    """Decisions of ``other`` are those of ``one``, with arms and places called otherwise."""
    rows = one[0] & other[0]
    assert rows.mean() > 0.5
    passing = rows & ~one[1]
    assert passing.any()
    np.testing.assert_array_equal(one[1][rows], other[1][rows])
    np.testing.assert_array_equal(renamed(one[2])[rows], other[2][rows])
    np.testing.assert_array_equal(renamed(one[3])[passing], other[3][passing])
    away = np.hypot(*(again(one[4]) - other[4])[passing].T)
    assert np.quantile(away, 0.95) < 0.05  # mm; where two pieces of a curve are as long, rounding decides which
    assert np.median(away) < 5e-3


seeds = pytest.mark.parametrize("seed", range(4))


@seeds
@pytest.mark.parametrize("flip", [False, True])
def test_decisions_move_with_the_table_and_are_mirrored_with_it(seed, flip):
    arms, discs, start, goal, previous = drawn(seed)
    draw = np.random.default_rng(seed)
    angle, shift = draw.uniform(-3, 3), draw.uniform(-400, 400, 2)
    arms_there, discs_there, (start_there, goal_there) = moved(arms, discs, [start, goal], angle, shift, flip)
    here = random_policy(rules_of(arms, discs), start, goal, seed)
    there = here.under(rules_of(arms_there, discs_there))
    place = lambda at: moved(arms, discs, [np.append(at, np.zeros((len(at), 1)), -1)], angle, shift, flip)[2][0][:, :2]  # noqa: E731
    assert_alike(decided(here, start, goal, previous), decided(there, start_there, goal_there, previous), again=place)


@seeds
def test_decisions_do_not_depend_on_how_arms_are_numbered(seed):
    arms, discs, start, goal, previous = drawn(seed)
    order = np.random.default_rng(seed).permutation(len(arms))
    number = np.append(np.argsort(order), -1)  # what an arm is called then; -1 stays no arm
    here = random_policy(rules_of(arms, discs), start, goal, seed)
    there = here.under(rules_of(arms[order], discs))
    found = decided(there, start, goal, number[previous])
    assert_alike(decided(here, start, goal, previous), found, renamed=lambda arm: number[arm])


@seeds
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_one_problem_is_a_batch_of_one_and_a_cell_is_a_batch_of_one_cell(seed, architecture):
    arms, discs, start, goal, previous = drawn(seed)
    pool = LayoutPool([(arms, discs)])
    cell, task = pool.cell(0), TaskConfig(architecture=architecture)
    many = random_policy(rules_of(arms, discs, architecture=architecture), start, goal, seed)
    single = many.under(Rules(cell, task))
    batch = decided(many, start, goal, previous)
    assert_alike(batch, decided(single, start, goal, previous))
    rows = [single.rules.decode(single.act(*problem)) for problem in zip(start, goal, previous, strict=True)]
    final, arm, place = (np.array([getattr(row, name) for row in rows]) for name in ("final", "arm", "place_mm"))
    receiver = np.array([row.receiver for row in rows])
    assert_alike(batch, (batch[0], final, arm, receiver, place))
    assert not (final.any() and architecture == "A")


def test_rows_of_a_batch_of_cells_do_not_see_each_other():
    pool = LayoutPool.random(FEW, 30, np.random.default_rng(5))
    layout = np.random.default_rng(6).integers(30, size=90)
    cells = CellBatch(pool, layout)
    start, goal = (poses.numpy() for poses in sample_problems(cells, 90, torch.Generator().manual_seed(7)))
    policy, previous = random_policy(Rules(cells, TaskConfig()), start, goal), np.full(90, -1)
    whole = policy.act(start, goal, previous)
    rows = np.random.default_rng(8).permutation(90)[:40]
    part = policy.under(policy.rules.of_rows(rows)).act(start[rows], goal[rows], previous[rows])
    same = lead(policy, start, goal, previous)[rows] > 3e-3
    assert same.mean() > 0.5
    np.testing.assert_allclose(part[same], whole[rows][same], atol=1e-3)


@pytest.mark.parametrize("order", [1, 2, 4])
@seeds
def test_a_turn_that_brings_the_block_back_onto_itself_changes_nothing(seed, order):
    arms, discs, start, goal, previous = drawn(seed)
    policy = random_policy(rules_of(arms, discs, symmetry_order=order), start, goal, seed)
    expected = decided(policy, start, goal, previous)
    draw = np.random.default_rng(seed)
    turned = [pose + np.append([0.0, 0.0], 1.0) * (2 * math.pi / order * draw.integers(-5, 6, COUNT))[:, None] for pose in (start, goal)]
    assert_alike(expected, decided(policy, *turned, previous))
    if order > 1:
        half = [start, goal + np.array([0.0, 0.0, math.pi / order])]
        others = decided(policy, *half, previous)
        assert not np.array_equal(expected[4], others[4], equal_nan=True)


def asked(policy, start, goal, previous):
    """Of hand-overs: rows, givers, receivers, and the hand-over angle psi_giver - psi_receiver that the network asks for."""
    rules, order = policy.rules, policy.rules.config.symmetry_order
    seen = observe(rules, "graph", start, goal, previous).astype(np.float32)
    graph = HandoverGraphs(seen, rules.cell.num_arms)
    choice = chosen(graph, *branches(policy.layers, policy.shape, graph))
    rows = np.flatnonzero(~choice.final & np.isfinite(choice.value))
    edge = choice.edge[rows]
    facing = rules.cell.gripper_yaw(np.zeros((len(seen), rules.cell.num_arms)))
    giver, receiver = graph.arm[graph.giver[edge]], graph.arm[graph.receiver[edge]]
    angle = order * (facing[rows, giver] - facing[rows, receiver]) + graph.middle[edge] + graph.half[edge] * choice.place[rows]
    return rows, giver, receiver, angle


@pytest.mark.parametrize("order", [1, 2, 4])
@seeds
def test_the_place_lies_in_what_both_reach_and_has_the_angle_that_was_asked_for(seed, order):
    """By an oracle that shares no code with the package. Of a block of symmetry order k it is k times the angle that is asked for."""
    arms, discs, start, goal, previous = drawn(seed)
    policy = random_policy(rules_of(arms, discs, symmetry_order=order), start, goal, seed)
    rows, giver, receiver, angle = asked(policy, start, goal, previous)
    assert len(rows) > 10
    command = policy.rules.decode(policy.act(start, goal, previous))
    np.testing.assert_array_equal(command.arm[rows], giver)
    np.testing.assert_array_equal(command.receiver[rows], receiver)
    names = ("x_mm", "y_mm", "facing_rad", "r_min_mm", "r_max_mm")
    records = [dict(zip(names, arm[:5], strict=True)) | {"yaw_range_rad": [arm[5], arm[6]]} for arm in arms]
    block = BlockConfig().side_mm / math.sqrt(2)
    oracle = Layout(records, [{"x_mm": x, "y_mm": y, "radius_mm": r - block} for x, y, r in discs])
    for row, i, j, wanted in zip(rows, giver, receiver, angle, strict=True):
        place = command.place_mm[row]
        assert oracle.margin(place, [i, j]).min() > -2e-3
        off = math.remainder(order * float(oracle.hand_over_angle(place, i, j)) - wanted, 2 * math.pi)
        assert abs(off) < 1e-4
    result = policy.rules.step(start, goal, previous, policy.act(start, goal, previous))
    able = policy.rules.cell.reaches(start)[rows, giver]
    assert result.feasible[rows][able].all()


@pytest.mark.parametrize("name", ["paper", "al5a"])
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_of_the_paper_s_pair_too(name, architecture):
    """Whose chart is another one, with its own way to the place of an angle."""
    cell = load_cell(name)
    assert isinstance(cell.chart, PaperChart)
    start, goal = (poses.numpy() for poses in sample_problems(cell, 200, torch.Generator().manual_seed(0)))
    policy = random_policy(Rules(cell, TaskConfig(architecture=architecture)), start, goal)
    previous = np.random.default_rng(0).integers(-1, 2, 200)
    action = policy.act(start, goal, previous)
    assert action.shape == (200, 4)
    command = policy.rules.decode(action)
    rows, giver, receiver, angle = asked(policy, start, goal, previous)
    if architecture == "B":
        passing = ~command.final[rows]
        assert passing.all()
        np.testing.assert_array_equal(command.arm[rows], giver)
        place = command.place_mm[rows]
        assert cell.reaches(place).all()
        psi = cell.gripper_yaw(cell.polar(place)[1])
        off = psi[np.arange(len(rows)), giver] - psi[np.arange(len(rows)), receiver] - angle
        assert abs(np.remainder(off + math.pi, 2 * math.pi) - math.pi).max() < 1e-4
    else:
        assert not command.final.any()
        result = policy.rules.step(start, goal, previous, action)
        assert (result.feasible | (result.external_arm >= 0)).all()


def test_the_pair_s_two_charts_make_one_policy():
    """The paper's pair with its own chart, with the angle chart, and as a batch of cells: the same places."""
    own = load_cell("paper")
    angle = build_cell(replace(own.config, chart="angle")).cell
    start, goal = (poses.numpy() for poses in sample_problems(own, COUNT, torch.Generator().manual_seed(2)))
    previous = np.full(COUNT, -1)
    batch = CellBatch(LayoutPool.of_cell(own), np.zeros(COUNT, np.int64))
    policy = random_policy(Rules(own, TaskConfig()), start, goal)
    first, *others = (decided(policy.under(Rules(cell, TaskConfig())), start, goal, previous) for cell in (own, angle, batch))
    for other in others:
        assert_alike(first, other)


def test_alpha_of_a_place_is_what_the_chart_says():
    """What training says of a place, :func:`chart_alpha`, and what acting does: to the angle, to its place, to the coordinates of it."""
    pool = LayoutPool.random(FEW, 60, np.random.default_rng(9))
    cells, draw = CellBatch(pool, np.arange(60)), np.random.default_rng(10)
    middle, half = pool.arcs
    cases = np.argwhere(half >= 0)
    cases = cases[draw.permutation(len(cases))[:600]]
    layout, giver, receiver, arc = cases.T
    assert (arc > 0).any()
    place = draw.uniform(-1.0, 1.0, len(cases))
    place[:100] = draw.choice([-1.0, 1.0], 100)
    own = cells.take(layout)
    angle = middle[layout, giver, receiver, arc] + half[layout, giver, receiver, arc] * place
    at = own.at_angle(giver, receiver, angle)
    assert own.reaches(at)[np.arange(len(cases)), giver].all()
    assert own.reaches(at)[np.arange(len(cases)), receiver].all()
    said = chart_alpha(half[layout, giver, receiver], arc, np.where(giver < receiver, place, -place))
    np.testing.assert_allclose(own.coordinates(giver, receiver, at)[:, 0], said, atol=1e-6)
    psi = own.gripper_yaw(own.polar(at)[1])
    found = psi[np.arange(len(cases)), giver] - psi[np.arange(len(cases)), receiver]
    np.testing.assert_allclose(np.remainder(found - angle + math.pi, 2 * math.pi) - math.pi, 0.0, atol=1e-7)


cells = pytest.mark.parametrize(("count", "layout"), [(2, ring), (3, ring), (4, line), (6, ring), (8, line)])


@cells
@pytest.mark.parametrize("architecture", ["A", "B"])
def test_a_shield_over_it_ends_no_episode_wrong(count, layout, architecture):
    cell = model_of(count, layout).cell
    problems = [part.numpy() for part in sample_problems(cell, 20, torch.Generator().manual_seed(count))]
    policy = ShieldedPolicy(random_policy(Rules(cell, TaskConfig(architecture=architecture)), *problems))
    outcome = play(policy.rules, policy.act, *problems).outcome
    assert np.isin(outcome, [Outcome.SUCCESS, Outcome.TIMEOUT]).all()


@cells
def test_alternatives_are_all_branches_of_arms_that_may_move(count, layout):
    cell = model_of(count, layout).cell
    start, goal = (part.numpy() for part in sample_problems(cell, 50, torch.Generator().manual_seed(count)))
    policy = random_policy(Rules(cell, TaskConfig()), start, goal)
    previous = np.random.default_rng(0).integers(-1, count, 50)
    action = policy.act(start, goal, previous)
    ranked = policy.alternatives(action, start, goal, previous)
    np.testing.assert_array_equal(ranked[:, 0], action)
    reach = cell.reaches(start)
    for row in range(50):
        able = reach[row] & (np.arange(count) != previous[row])
        able = able if able.any() else reach[row]
        offers = [(cell.hand_over_arcs(np.zeros((count, count)))[1][arm] >= 0).sum() for arm in np.flatnonzero(able)]
        real = ranked[row][~np.isnan(ranked[row]).any(-1)]
        assert len(real) == 2 * policy.shape.components * sum(offers) + able.sum()
        command = policy.rules.decode(real)
        assert able[command.arm].all()
        assert cell.reaches(command.place_mm[~command.final]).any(-1).all()
    one = policy.alternatives(action[0], start[0], goal[0], previous[0])
    finite = ~np.isnan(one).any(-1)
    assert finite.sum() == (~np.isnan(ranked[0]).any(-1)).sum()


def test_under_a_it_hands_over_alone_and_does_what_it_would_do_under_b_without_its_ends():
    cell = model_of(4, line).cell
    start, goal = (part.numpy() for part in sample_problems(cell, 200, torch.Generator().manual_seed(1)))
    b = random_policy(Rules(cell, TaskConfig()), start, goal)
    a = b.under(Rules(cell, TaskConfig(architecture="A")))
    previous = np.full(200, -1)
    under_a, under_b = a.act(start, goal, previous), b.act(start, goal, previous)
    assert (under_a[:, 0] == -1).all()
    hands = under_b[:, 0] < 0
    assert 0 < hands.sum() < 200
    np.testing.assert_array_equal(under_a[hands], under_b[hands])


def test_where_no_arm_reaches_the_object_none_is_to_move():
    cell = model_of(3).cell
    far = np.array([[5000.0, 0.0, 0.0], [*cell.arms[0].at(200.0, 0.0), 0.0]])
    policy = random_policy(Rules(cell, TaskConfig()), far[1:], far[1:])
    action = policy.act(far, far[[1, 1]], np.full(2, -1))
    assert np.isnan(action[0]).all()
    assert np.isfinite(action[1]).all()


def test_where_no_arm_that_reaches_the_goal_can_be_handed_the_object_none_is_to_move():
    config = LayoutConfig(arms=[4, 5])
    said = 0
    for seed in range(20):
        whole = LayoutPool.random(config, 1, np.random.default_rng(seed)).cell(0)
        graph = whole.graph
        centre = next((arm for arm in range(whole.num_arms) if len(graph.neighbours(arm)) > 1), 0)
        cell = whole.with_arms([name for name in whole.names if name != whole.names[centre]])
        start, goal = (part.numpy() for part in sample_problems(cell, 40, torch.Generator().manual_seed(seed)))
        policy = random_policy(Rules(whole, TaskConfig()), start, goal).under(Rules(cell, TaskConfig()))
        silent = np.isnan(policy.act(start, goal, np.full(40, -1))).all(-1)
        parts = list(range(cell.num_arms))  # of the graph, by hand: arms that can pass to each other have the same
        for _ in parts:
            for i, j in cell.graph.edges:
                parts[i] = parts[j] = min(parts[i], parts[j])
        for row in range(40):
            ends = [{parts[arm] for arm in np.flatnonzero(cell.reaches(pose[row]))} for pose in (start, goal)]
            assert silent[row] == (not ends[0] & ends[1])
        said += silent.sum()
    assert said > 0


def test_it_answers_observations_of_the_aec_environment():
    for name in ("paper", "triangle"):
        env = HandoverEnv(cell=name)
        env.reset(seed=3)
        policy = random_policy(env.rules, *(part.numpy() for part in sample_problems(env.rules.cell, 20, torch.Generator().manual_seed(0))))
        action = policy(env.observe("supervisor"))
        assert env.action_space("supervisor").contains({**action, "place": np.asarray(action["place"], np.float32)})


def test_the_shipped_one_knows_the_paper_s_pair_and_a_ring():
    """A coarse mark: what it reaches is told by the reports."""
    for cell in (load_cell("paper"), model_of(4).cell):
        policy = policies.load("pretrained_any", cell, TaskConfig(epsilon_deg=10.0))
        problems = [part.numpy() for part in sample_problems(cell, 200, torch.Generator().manual_seed(0))]
        outcome = play(policy.rules, policy.act, *problems).outcome
        assert (outcome == Outcome.SUCCESS).mean() > 0.8

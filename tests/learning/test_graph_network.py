"""Laws of the network over hand-over graphs: torch as numpy, sums as loops, choices as a search of all branches, mirror images alike."""

from __future__ import annotations

import math
from copy import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_handover.cell.batch import CellBatch, LayoutPool
from marl_handover.config import LayoutConfig, TaskConfig
from marl_handover.learning.graph_network import (
    GraphShape,
    HandoverGraphs,
    arm_features,
    arrival,
    best_places,
    branches,
    chosen,
    embedded,
    finish_value,
    hand_over_value,
    layer_sizes,
    onward,
    stored_shape,
)
from marl_handover.task.observations import observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Rules
from tests.graph_policies import SHAPE, random_weights

MANY = [
    LayoutConfig(arms=[2, 8], r_min_mm=[120.0, 160.0], r_max_mm=[215.0, 260.0], yaw_deg=[60.0, 132.0], obstacles=[0, 4]),
    LayoutConfig(arms=[2, 4], spacing_mm=[60.0, 250.0], apart_mm=60.0, obstacles=[0, 3], radius_mm=[5.0, 20.0]),
]
SHAPES = [SHAPE, GraphShape(width=32, rounds=0, components=1, slack=True), GraphShape(width=16, rounds=2, components=3, slack=False)]


@pytest.fixture(scope="module")
def seen():
    """Rules of 300 cells of 2 to 8 arms, many with discs, and observations (300, size) of a problem in each, float32."""
    pool = LayoutPool.random(MANY, 60, np.random.default_rng(1))
    layout = np.repeat(np.arange(60), 5)
    rules = Rules(CellBatch(pool, layout), TaskConfig(layout="graph", epsilon_deg=5.0))
    start, goal = (poses.numpy() for poses in sample_problems(rules.cell, 300, torch.Generator().manual_seed(3)))
    previous = np.random.default_rng(4).integers(-1, pool.n_arms[layout])
    observation = observe(rules, "graph", start, goal, previous).astype(np.float32)
    assert pool.n_arms.min() == 2
    assert pool.n_arms.max() == 8
    assert ((pool.arcs[1] >= 0).sum(-1) > 1).any()  # some pairs offer several intervals
    return rules, observation


def mirrored(graph):
    """The graphs of the mirrored problems."""
    other = copy(graph)
    other.angle, other.goal_angle, other.middle = -graph.angle, -graph.goal_angle, -graph.middle
    return other


def in_numpy(shape, seed=0):
    weights = random_weights(shape, seed)
    return {name: lambda x, layer=layer: x @ layer[0] + layer[1] for name, layer in weights.items()}


def in_torch(shape, seed=0):
    weights = {name: tuple(map(torch.from_numpy, layer)) for name, layer in random_weights(shape, seed).items()}
    return {name: lambda x, layer=layer: x @ layer[0] + layer[1] for name, layer in weights.items()}


@pytest.mark.parametrize("shape", SHAPES)
def test_torch_and_numpy_say_and_choose_the_same(seen, shape):
    rules, observation = seen
    count = rules.cell.num_arms
    one, other = HandoverGraphs(observation, count), HandoverGraphs(torch.from_numpy(observation), count)
    for name, values in vars(one).items():
        np.testing.assert_allclose(np.asarray(getattr(other, name)), values, atol=1e-6, err_msg=name)
    found = branches(in_numpy(shape), shape, one)
    expected = branches(in_torch(shape), shape, other)
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.dtype == np.float32
        np.testing.assert_allclose(mine, theirs.numpy(), atol=2e-3)
        assert np.quantile(abs(mine - theirs.numpy()), 0.99) < 2e-5
    for most in (None, 5):
        mine, theirs = chosen(one, *found, most), chosen(other, *(torch.from_numpy(part) for part in found), most)
        for name in mine._fields:
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name).numpy(), err_msg=name)


def test_a_sum_over_intervals_is_a_loop(seen):
    rules, observation = seen
    one, other = (HandoverGraphs(kind(observation), rules.cell.num_arms) for kind in (np.asarray, torch.from_numpy))
    values = np.random.default_rng(0).normal(size=(len(one.giver), 3)).astype(np.float32)
    expected = np.zeros((len(one.arm), 3))
    for edge, arm in enumerate(one.giver):
        expected[arm] += values[edge]
    assert (np.bincount(one.giver, minlength=len(one.arm)) == 0).sum() == 0  # every arm of a connected cell gives to some other
    np.testing.assert_allclose(one.summed(values), expected, atol=1e-5)
    np.testing.assert_allclose(other.summed(torch.from_numpy(values)).numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(one.summed(values[:, 0]), expected[:, 0], atol=1e-5)


def searched(graph, value, place, finish, problem):
    """All branches of one problem that may be chosen, the best first: (value, arm, edge, place), the edge -1 to finish."""
    rows = np.flatnonzero(graph.problem == problem)
    able = [row for row in rows if graph.reaches_object[row]]
    fresh = [row for row in able if not graph.was_previous[row]]
    found = []
    for row in fresh or able:
        found.append((finish[row], graph.arm[row], -1, 0.0))
        for edge in np.flatnonzero(graph.giver == row):
            found += [(value[edge, k], graph.arm[row], edge, place[edge, k]) for k in range(value.shape[1])]
    return sorted((branch for branch in found if branch[0] > -math.inf), key=lambda branch: -branch[0])


@pytest.mark.parametrize("refused", [0.0, 0.3])
def test_what_is_chosen_is_the_best_of_all_branches(seen, refused):
    """With values that are all different; some are minus infinite, as what is impossible is."""
    rules, observation = seen
    graph, draw = HandoverGraphs(observation, rules.cell.num_arms), np.random.default_rng(2)
    value, place = draw.normal(size=(2, len(graph.giver), 4))
    finish = draw.normal(size=len(graph.arm))
    value[draw.random(value.shape) < refused] = -math.inf
    finish[draw.random(len(finish)) < refused] = -math.inf
    best, ranked = chosen(graph, value, place, finish), chosen(graph, value, place, finish, 1 << 20)
    for whole, several in zip(best, ranked, strict=True):
        np.testing.assert_array_equal(whole, several[:, 0])
    again = 0
    for problem in range(graph.count):
        expected = searched(graph, value, place, finish, problem)
        assert np.isfinite(ranked.value[problem]).sum() == len(expected)
        for number, (worth, arm, edge, at) in enumerate(expected):
            said = [part[problem, number] for part in ranked]
            assert said[:2] == [edge < 0, arm]
            assert said[4] == worth
            assert edge < 0 or said[2:4] == [edge, at]
        if not expected:
            assert best.value[problem] == -math.inf
            continue
        row = np.flatnonzero((graph.problem == problem) & (graph.arm == best.arm[problem]))[0]
        if graph.was_previous[row]:
            again += 1
            assert graph.reaches_object[graph.problem == problem].sum() == 1
    assert again > 0


@pytest.mark.parametrize("shape", SHAPES)
def test_of_a_mirror_image_the_mirrored_is_chosen(seen, shape):
    rules, observation = seen
    graph, layers = HandoverGraphs(observation, rules.cell.num_arms), in_numpy(shape)
    value, place, finish = branches(layers, shape, graph)
    value_there, place_there, finish_there = branches(layers, shape, mirrored(graph))
    half = shape.components  # the actor's places of either image are said one after the other
    np.testing.assert_allclose(np.roll(place_there, half, -1), -place, atol=1e-6)
    np.testing.assert_allclose(np.roll(value_there, half, -1), value, atol=1e-4)
    np.testing.assert_allclose(finish_there, finish, atol=1e-6)


def test_what_an_arm_is_told_does_not_depend_on_where_the_object_is(seen):
    """Goal, epsilon and layout alone: so an arm's value as a function of the angle is one function a cell and goal."""
    rules, observation = seen
    shape = SHAPE
    graph = HandoverGraphs(observation, rules.cell.num_arms)
    before = embedded(in_numpy(shape), shape, graph)
    graph.angle = graph.angle + 1.0
    graph.reaches_object, graph.was_previous = ~graph.reaches_object, ~graph.was_previous
    np.testing.assert_array_equal(embedded(in_numpy(shape), shape, graph), before)


def test_full_turns_of_any_angle_change_nothing(seen):
    rules, observation = seen
    shape, layers = SHAPE, in_numpy(SHAPE)
    graph, draw = HandoverGraphs(observation.astype(float), rules.cell.num_arms), np.random.default_rng(0)
    expected = branches(layers, shape, graph)
    for name in ("angle", "goal_angle", "middle"):
        angles = getattr(graph, name)
        setattr(graph, name, angles + 2 * math.pi * draw.integers(-2, 3, angles.shape))
    for found, before in zip(branches(layers, shape, graph), expected, strict=True):
        np.testing.assert_allclose(found, before, atol=1e-6)


def test_slack_is_that_of_the_nearest_interval_to_an_arm_that_finishes(seen):
    rules, observation = seen
    graph, draw = HandoverGraphs(observation.astype(float), rules.cell.num_arms), np.random.default_rng(1)
    arm = np.arange(len(graph.arm))
    angle = draw.uniform(-math.pi, math.pi, len(arm))
    slack, change = onward(graph, arm, angle)
    none = 0
    for row in arm:
        offers = [edge for edge in np.flatnonzero(graph.giver == row) if graph.reaches_goal[graph.receiver[edge]]]
        if not offers:
            none += 1
            assert (slack[row], change[row]) == (pytest.approx(-math.pi), 0.0)
            continue
        missing = [graph.goal_angle[graph.receiver[edge]] - angle[row] - graph.middle[edge] for edge in offers]
        away = [abs(math.remainder(angle, 2 * math.pi)) for angle in missing]
        assert slack[row] == pytest.approx(max(graph.half[edge] - off for edge, off in zip(offers, away, strict=True)))
        assert abs(change[row]) == pytest.approx(max(0.0, -slack[row]))
        if slack[row] > -math.pi + 1e-9:
            assert onward(graph, row, angle[row] + 1.0001 * change[row])[0] >= -1e-3  # after that change it can
    assert 0 < none < len(arm)


def test_places_are_means_of_both_images_and_values_the_mean_of_the_lower_twins(seen):
    """:func:`branches` again, from its parts."""
    rules, observation = seen
    shape, layers = SHAPES[2], in_numpy(SHAPES[2])
    graph = HandoverGraphs(observation, rules.cell.num_arms)
    images = [(graph, 1.0), (mirrored(graph), -1.0)]
    value, place, finish = branches(layers, shape, graph)
    said, worth, ends = [], [], []
    for view, sign in images:
        embedding = embedded(layers, shape, view)
        features = arm_features(view, np.arange(len(view.arm)), view.angle, shape.slack)
        mean, log_std = best_places(layers, shape, view, embedding, features)
        assert (log_std >= -6).all()
        assert (log_std <= 1).all()
        said.append(sign * np.tanh(mean))
        there = arrival(view, view.angle[view.giver], sign * place, np.arange(len(view.giver)))
        receiver = np.broadcast_to(view.receiver[:, None], there.shape)
        worth.append(np.minimum(*hand_over_value(layers, shape, view, embedding, receiver, there)))
        ends.append(finish_value(layers, features))
    np.testing.assert_allclose(place, np.concatenate(said, -1), atol=1e-6)
    np.testing.assert_allclose(value, sum(worth) / 2, atol=1e-5)
    np.testing.assert_allclose(finish, sum(ends) / 2, atol=1e-5)


@given(st.sampled_from([16, 32, 64, 128]), st.integers(0, 64), st.integers(1, 64), st.booleans())
def test_a_stored_shape_is_what_was_stored(width, rounds, components, slack):
    shape = GraphShape(width, rounds, components, slack)
    assert stored_shape(shape._asdict()) == shape
    sizes = layer_sizes(shape)
    assert sizes["place_out"][1] == 2 * components
    assert sizes["message_out"] == (width, width + 1)


@pytest.mark.parametrize(
    "lie",
    [{"width": 8}, {"width": 65}, {"width": 64.0}, {"width": True}, {"rounds": -1}, {"rounds": "6"}, {"components": 0}, {"components": 65}]
    + [{"slack": 1}, {"slack": None}, {"depth": 3}],
)
def test_a_shape_that_cannot_be_is_refused(lie):
    with pytest.raises((ValueError, TypeError)):
        stored_shape({**SHAPE._asdict(), **lie})


@pytest.mark.parametrize("kept", [1.0, 0.4])
def test_hopeless_is_where_no_chain_of_arms_leads_to_one_that_reaches_the_goal(seen, kept):
    """Followed arm by arm, in graphs that have lost many of their intervals as well."""
    rules, observation = seen
    draw, graph = np.random.default_rng(3), HandoverGraphs(observation, rules.cell.num_arms)
    left = draw.random(len(graph.giver)) < kept
    graph.giver, graph.receiver = graph.giver[left], graph.receiver[left]
    graph.reaches_goal = graph.reaches_goal * (draw.random(len(graph.arm)) < max(kept, 0.6))
    expected = []
    for problem in range(graph.count):
        carry = [row for row in np.flatnonzero(graph.problem == problem) if graph.reaches_object[row]]
        met = set(carry)
        while carry:
            row = carry.pop()
            onward_to = {int(each) for each in graph.receiver[graph.giver == row]} - met
            met |= onward_to
            carry += onward_to
        expected.append(not any(graph.reaches_goal[row] for row in met))
    np.testing.assert_array_equal(graph.hopeless(), expected)
    assert (kept == 1.0) is not any(expected)

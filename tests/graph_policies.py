"""Policies over hand-over graphs whose weights are random: whatever is a law holds of them too."""

from __future__ import annotations

import math

import numpy as np

from marl_handover.learning.graph_network import GraphShape, HandoverGraphs, branches, chosen, layer_sizes
from marl_handover.policies.graph_policy import GraphPolicy
from marl_handover.task.observations import observe

SHAPE = GraphShape(width=64, rounds=6, components=2, slack=True)


def random_weights(shape=None, seed=0, gain=1.5):
    """Layers by name: weights (inputs, outputs) and biases (outputs,), float32."""
    draw = np.random.default_rng(seed)
    sizes = layer_sizes(shape or SHAPE)
    made = {name: (draw.normal(size=size) * gain / np.sqrt(size[0]), 0.1 * draw.normal(size=size[1])) for name, size in sizes.items()}
    return {name: (weight.astype(np.float32), bias.astype(np.float32)) for name, (weight, bias) in made.items()}


def stored(shape, weights):
    """The arrays of a policy file of such layers, without ``about``, and what it says of them."""
    arrays = {}
    for number, (weight, bias) in enumerate(weights.values()):
        arrays[f"weight_{number}"], arrays[f"bias_{number}"] = weight, bias
    return arrays, {"kind": "graph", "variant": "hierarchical", "layout": "graph", "layers": len(weights), "shape": shape._asdict()}


def balanced_weights(rules, start, goal, seed=0, shape=None):
    """Random layers that want to finish about two in five of the problems (n, 3), (n, 3)."""
    shape, weights = shape or SHAPE, random_weights(shape, seed)
    policy = GraphPolicy(rules, "random weights", *stored(shape, weights))
    seen = observe(rules, "graph", start, goal, np.full(len(start), -1)).astype(np.float32)
    graph = HandoverGraphs(seen, rules.cell.num_arms)
    value, place, finish = branches(policy.layers, shape, graph)
    ahead = chosen(graph, value, place, 0 * finish - math.inf).value - chosen(graph, 0 * value - math.inf, place, finish).value
    weight, bias = weights["finish_out"]
    weights["finish_out"] = weight, bias + np.quantile(ahead, 0.4).astype(np.float32)
    return weights


def random_policy(rules, start, goal, seed=0, shape=None):
    """A policy of such weights under a rule book."""
    shape = shape or SHAPE
    return GraphPolicy(rules, "random weights", *stored(shape, balanced_weights(rules, start, goal, seed, shape)))


def lead(policy, start, goal, previous):
    """By how much (n,) the best branch is better than the best one that does something else; places that nearly coincide are one."""
    rules = policy.rules
    seen = observe(rules, "graph", start, goal, previous).astype(np.float32)
    graph = HandoverGraphs(seen, rules.cell.num_arms)
    every = chosen(graph, *branches(policy.layers, policy.shape, graph), 1 << 20)
    same = (every.edge == every.edge[:, :1]) & (every.arm == every.arm[:, :1]) & (abs(every.place - every.place[:, :1]) < 1e-3)
    return every.value[:, 0] - np.where(same, -math.inf, every.value).max(-1)

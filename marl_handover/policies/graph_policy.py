"""A trained policy for every cell, evaluated in numpy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.learning.graph_network import Choice, HandoverGraphs, branches, chosen, layer_sizes, stored_shape
from marl_handover.policies.files import network_layers
from marl_handover.policies.policy import Floats, SupervisorPolicy
from marl_handover.task.actions import action_of
from marl_handover.task.graph_observation import shown_arcs
from marl_handover.task.observations import observe
from marl_handover.task.rules import Rules


class GraphPolicy(SupervisorPolicy):
    """A network over hand-over graphs: it acts in any cell, under either architecture, once it is under its rule book.

    Args:
        rules: the rule book to act under.
        name: what it was loaded as.
        arrays: weights, from a policy file.
        about: what the file says of them.
    """

    any_cell = batch_of_cells = True

    def __init__(self, rules: Rules, name: str, arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> None:
        super().__init__(rules, name)
        self.about |= about
        self.shape = stored_shape(about["shape"])
        weights = network_layers(arrays, about)
        self.layers = {key: _layer(*weight) for key, weight in zip(layer_sizes(self.shape), weights, strict=True)}

    def act(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """The best branch; not a number where no arm reaches the object, or none that reaches the goal can ever be handed it."""
        return self._answer(pose, goal, previous_arm, None)

    def alternatives(self, action: Floats, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        """All branches, the best first; not a number where there are no more."""
        return self._answer(pose, goal, previous_arm, 1 << 20)

    def _answer(self, pose: Floats, goal: Floats, previous_arm: NDArray[np.int64], most: int | None) -> Floats:
        rules, lead = self.rules, np.shape(pose)[:-1]
        seen = observe(rules, "graph", pose, goal, previous_arm).astype(np.float32)
        seen = seen.reshape(-1, seen.shape[-1])
        graph = HandoverGraphs(seen, rules.cell.num_arms)
        if not len(graph.giver):
            return self._alone(pose, goal, most)
        value, place, finish = branches(self.layers, self.shape, graph)
        if rules.external_finish:  # the final transfer is not the supervisor's
            finish = np.full_like(finish, -math.inf)
        choice = chosen(graph, value, place, finish, most)
        hopeless = graph.hopeless().reshape(-1, *[1] * (choice.value.ndim - 1))
        choice = choice._replace(value=np.where(hopeless, -math.inf, choice.value))
        return self._action(graph, choice).reshape(*lead, *choice.final.shape[1:], -1)

    def _alone(self, pose: Floats, goal: Floats, most: int | None) -> Floats:
        """The answer where no two arms share a place, as others are out of order: an arm finishes, or none moves."""
        able = self.rules.can_finish(pose, goal) & (not self.rules.external_finish)
        arm = able.argmax(-1)
        action = action_of(arm >= 0, arm, arm, np.zeros((*arm.shape, 2)), self.rules.cell.num_arms)
        action = np.where(able.any(-1)[..., None], action, math.nan)
        return action if most is None else action[..., None, :]

    def _action(self, graph: HandoverGraphs, choice: Choice) -> Floats:
        """Actions (n, ..., size) of choices (n, ...)."""
        rules, count = self.rules, self.rules.cell.num_arms
        arm, receiver = choice.arm, np.zeros_like(choice.arm)
        coordinates = np.zeros((*arm.shape, 2))
        passing = ~choice.final & np.isfinite(choice.value)
        if passing.any():
            edge = choice.edge[passing]
            receiver[passing] = graph.arm[graph.receiver[edge]]
            order = rules.config.symmetry_order
            offset = graph.half[edge].astype(float) * choice.place[passing] / order
            row = np.nonzero(passing)[0]
            middle, _ = shown_arcs(rules, np.zeros((graph.count, count, count)))
            angle = middle[row, arm[passing], receiver[passing], graph.arc[edge]] + offset
            at = rules.cell.take(row)
            place_mm = at.at_angle(arm[passing], receiver[passing], angle)
            coordinates[passing] = np.clip(at.coordinates(arm[passing], receiver[passing], place_mm), -1.0, 1.0)
        action = action_of(choice.final, arm, receiver, coordinates, count)
        return np.where(np.isfinite(choice.value)[..., None], action, math.nan)


def _layer(weight: NDArray[np.float32], bias: NDArray[np.float32]) -> Callable[[Floats], Floats]:
    return lambda x: x @ weight + bias

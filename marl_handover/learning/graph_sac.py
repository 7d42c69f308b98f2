"""Hybrid SAC over hand-over graphs: one policy for every cell.

What follows a hand-over is known from kinematics: another arm carries the object at another angle. So a value that an arm moves next, as a
function of that angle, is all there is to learn (an afterstate critic), and every state that is sampled teaches all arms of its cell at
once. Which arm hands over to which, over which interval of angles, or finishes, is a soft choice by those values; where within an interval
is a tanh-Gaussian, one network for all. Hindsight gives the states their goals (:mod:`marl_handover.learning.replay`).
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from marl_handover.arrays import wrap
from marl_handover.cell.sectors import chart_alpha
from marl_handover.learning.algorithm import Algorithm, register_algorithm, stepped
from marl_handover.learning.graph_network import (
    Choice,
    GraphShape,
    HandoverGraphs,
    Layers,
    arm_features,
    arrival,
    best_places,
    branches,
    chosen,
    embedded,
    finish_value,
    hand_over_value,
    layer_sizes,
)
from marl_handover.learning.hybrid_sac import averaging
from marl_handover.learning.networks import squashed
from marl_handover.learning.settings import GraphSacConfig, TrainConfig
from marl_handover.task.graph_observation import ARCS, ARM_FIELDS
from marl_handover.task.rules import Rules

GRADIENT_NORM = 20.0
"""Gradients of the critic are cut to this length."""


class GraphNetwork(nn.ModuleDict):
    """The layers of critic and actor, by name."""

    def __init__(self, shape: GraphShape) -> None:
        super().__init__({name: nn.Linear(*size) for name, size in layer_sizes(shape).items()})
        bias = self["place_out"].bias
        assert isinstance(bias, nn.Parameter)
        free = max(shape.components - 2, 0)
        with torch.no_grad():  # components that start from nowhere start apart, so that they do not learn the same thing
            bias[: shape.components] = 0.0
            bias[shape.components - free : shape.components] = torch.linspace(-1.0, 1.0, free) if free > 1 else 0.0

    @property
    def layers(self) -> Layers:
        """The layers as what :mod:`~marl_handover.learning.graph_network` asks for."""
        return cast(Layers, self)

    def parts(self, of_actor: bool) -> list[nn.Parameter]:
        """Parameters of the actor, or of the critic, which owns what both know of the graph."""
        return [value for name, layer in self.items() if name.startswith("place") == of_actor for value in layer.parameters()]


class Sampled(NamedTuple):
    """Places (E, components) that an actor drew, their log-densities, and its means, all in (-1, 1)."""

    place: Tensor
    log_prob: Tensor
    mean: Tensor


@register_algorithm(GraphSacConfig)
class GraphSac(Algorithm):
    """Networks, their average, which is target and judged policy in one, and optimisers.

    Args:
        rules: of a batch of cells; architecture B (one policy serves both, see :func:`marl_handover.learning.graph_network.branches`).
        config: settings of training.
        generator: of all that is drawn.
    """

    kind = "graph"
    stored = ("network", "average", "actor_optimizer", "critic_optimizer")
    config: GraphSacConfig

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        own = self.config
        self.shape = GraphShape(own.width, own.rounds, own.mixture_components, own.slack)
        self.network = GraphNetwork(self.shape).to(self.device)
        self.average: GraphNetwork = averaging(self.network)
        rate = own.learning_rate
        self.actor_optimizer = torch.optim.Adam(self.network.parts(of_actor=True), lr=rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(self.network.parts(of_actor=False), lr=rate, fused=True)

    def actor(self) -> nn.Module:
        """The average of the networks over the last steps, which is judged and kept."""
        return self.average

    def trained(self) -> nn.Module:
        """The networks that are trained, and explore."""
        return self.network

    def exported(self) -> list[list[nn.Linear]]:
        """All layers, in the order of :func:`layer_sizes`."""
        return [[layer for layer in self.average.values() if isinstance(layer, nn.Linear)]]

    def about(self) -> dict[str, Any]:
        """The form of the network."""
        return {"shape": self.shape._asdict()}

    @property
    def temperature(self) -> float:
        """Of the choice between branches; it falls linearly in the course of training."""
        own = self.config
        return own.temperature_start + self.progress * (own.temperature_end - own.temperature_start)

    def graphs(self, observation: Tensor) -> HandoverGraphs:
        """The graphs of observations (n, size)."""
        return HandoverGraphs(observation, self.rules.cell.num_arms)

    def random_action(self, observation: Tensor) -> Tensor:
        """Any branch that is possible, at any place."""
        graph = self.graphs(observation)
        place = self._anywhere((len(graph.giver), 1))
        return self._action(observation, graph, chosen(graph, self._gumbel(place.shape), place, self._gumbel(graph.angle.shape) - 3.0))

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """A branch and a place drawn from the policy."""
        graph = self.graphs(observation)
        embedding = embedded(self.network.layers, self.shape, graph)
        features = arm_features(graph, self._arms(graph), graph.angle, self.shape.slack)
        sampled = self._sampled(graph, embedding, features)
        place = torch.where(
            self._uniform(sampled.place.shape) < self.config.random_place, self._anywhere(sampled.place.shape), sampled.place
        )
        value = self._value(self.network.layers, graph, embedding, place)
        finish = finish_value(self.network.layers, features)
        noise = self._gumbel(value.shape), self._gumbel(finish.shape)
        # Some cells follow the likeliest branch: where that goes in circles, its states must get into the memory.
        steady = torch.arange(graph.count, device=self.device) < int(self.config.deterministic_env_fraction * graph.count)
        exploring = torch.where(steady, 0.0, self.temperature)[graph.problem]
        value, finish = value + exploring[graph.giver, None] * noise[0], finish + exploring * noise[1]
        return self._action(observation, graph, chosen(graph, value, place, finish))

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The best branch of both mirror images."""
        graph = self.graphs(observation)
        value, place, finish = branches(self.average.layers, self.shape, graph)
        return self._action(observation, graph, chosen(graph, value, place, finish))

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of critic and actor, on the states that sampled transitions led to; on those they began with where they ended it."""
        over = batch["next", "terminated"]
        graph = self.graphs(torch.where(over, batch["observation"], batch["next", "observation"]))
        embedding = embedded(self.network.layers, self.shape, graph)
        arm = self._arms(graph)
        features = arm_features(graph, arm, graph.angle, self.shape.slack)
        sampled = self._sampled(graph, embedding.detach(), features)
        with torch.no_grad():
            target, share = self._soft_value(graph, features, sampled)
        value = hand_over_value(self.network.layers, self.shape, graph, embedding, arm, graph.angle)
        finish = finish_value(self.network.layers, features)
        loss_place = (value - target).square().mean(1).sum()
        loss_finish = (finish - self._finish_reward(graph)).square().mean()
        self.critic_optimizer.zero_grad()
        (loss_place + self.config.finish_weight * loss_finish).backward()
        torch.nn.utils.clip_grad_norm_(self.network.parts(of_actor=False), GRADIENT_NORM)
        self.critic_optimizer.step()
        loss_actor = self._actor_loss(graph, embedding.detach(), sampled, share)
        stepped(self.actor_optimizer, loss_actor)
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), self.config.tau)
        return {"loss_critic": loss_place.detach(), "loss_finish": loss_finish.detach(), "loss_actor": loss_actor.detach()}

    def _soft_value(self, graph: HandoverGraphs, features: Tensor, sampled: Sampled) -> tuple[Tensor, Tensor]:
        """What handing over to each arm is worth by what it can do next, (A,), and the share (E, components) of each branch of it."""
        own, scale = self.config, self.config.reward_scale
        embedding = embedded(self.average.layers, self.shape, graph)
        value = self._value(self.average.layers, graph, embedding, sampled.place)
        value = value - own.place_temperature * sampled.log_prob.clamp(-3.0, 6.0)
        finish = finish_value(self.average.layers, features)
        best = value.new_full(finish.shape, -torch.inf).scatter_reduce(0, graph.giver, value.amax(-1), "amax").maximum(finish)
        weight = ((value - best[graph.giver, None]) / self.temperature).exp()
        weight_finish = ((finish - best) / self.temperature).exp()
        total = graph.summed(weight.sum(-1)) + weight_finish
        share, share_finish = weight / total[graph.giver, None], weight_finish / total
        future = graph.summed((share * value).sum(-1)) + share_finish * finish
        return scale * self.rules.config.reward.step + own.gamma * future, share

    def _finish_reward(self, graph: HandoverGraphs) -> Tensor:
        """What the rule book gives (A,) for finishing with each arm now."""
        reward = self.rules.config.reward
        there = (graph.reaches_goal > 0) & (wrap(graph.angle - graph.goal_angle).abs() <= graph.epsilon)
        return self.config.reward_scale * torch.where(there, reward.success, reward.failure)

    def _actor_loss(self, graph: HandoverGraphs, embedding: Tensor, sampled: Sampled, share: Tensor) -> Tensor:
        """The soft gradient of the places drawn, and a pull of the best mean to the nearest of some places that beat it by a margin."""
        own = self.config
        for parameter in self.network.parts(of_actor=False):
            parameter.requires_grad_(False)
        value = self._value(self.network.layers, graph, embedding, sampled.place)
        loss = ((0.1 + share) * (own.place_temperature * sampled.log_prob - value)).mean()
        some = torch.arange(int(own.candidate_share * len(graph.giver)), device=self.device)
        loss = loss + own.candidate_weight * self._pull(graph, embedding, sampled.mean[some], some) if len(some) else loss
        for parameter in self.network.parts(of_actor=False):
            parameter.requires_grad_(True)
        return loss

    def _pull(self, graph: HandoverGraphs, embedding: Tensor, mean: Tensor, edge: Tensor) -> Tensor:
        """Squared distance of the best mean (m, components) of rows of intervals (m,) to the *nearest* of some places that beat it.

        The nearest, not the best: between two equally good regions the mean would be left in the bad middle.
        """
        own, components = self.config, mean.shape[-1]
        with torch.no_grad():
            component = torch.randint(components, (own.candidates,), generator=self.generator, device=self.device)
            beside = (mean[:, component] + self._nearby((len(edge), own.candidates))).clamp(-1.0, 1.0)
            tried = torch.cat([mean, self._anywhere((len(edge), own.candidates)), beside], -1)
            worth = self._value(self.network.layers, graph, embedding, tried, edge)
            best, taken = worth[:, :components].max(-1, keepdim=True)
            gain = worth[:, components:] - best - own.candidate_margin
        distance = (mean.gather(1, taken) - tried[:, components:]).square()
        nearest = torch.where(gain > 0, distance.detach(), torch.inf).argmin(-1, keepdim=True)
        return (gain.gather(1, nearest).clamp(0.0, 1.0) * distance.gather(1, nearest)).mean()

    def _arms(self, graph: HandoverGraphs) -> Tensor:
        return torch.arange(len(graph.arm), device=self.device)

    def _sampled(self, graph: HandoverGraphs, embedding: Tensor, features: Tensor) -> Sampled:
        mean, log_std = best_places(self.network.layers, self.shape, graph, embedding, features)
        place, log_prob = squashed(mean, log_std, self._gaussian(mean.shape))
        return Sampled(place, log_prob, mean.tanh())

    def _value(self, layers: Layers, graph: HandoverGraphs, embedding: Tensor, place: Tensor, edge: Tensor | None = None) -> Tensor:
        """The lower twin values (m, k) of handing over at ``place`` (m, k) in the rows ``edge`` (m,) of intervals, or in all."""
        rows = torch.arange(len(graph.giver), device=self.device) if edge is None else edge
        there = arrival(graph, graph.angle[graph.giver[rows]], place, rows)
        value: Tensor = hand_over_value(layers, self.shape, graph, embedding, graph.receiver[rows, None].expand_as(there), there).amin(0)
        return value

    def _action(self, observation: Tensor, graph: HandoverGraphs, choice: Choice) -> Tensor:
        """Actions (n, 2 N + 3), in the angle chart of each pair."""
        count, edge = self.rules.cell.num_arms, choice.edge
        receiver = graph.arm[graph.receiver[edge]]
        halves = observation[:, count * len(ARM_FIELDS) :].reshape(-1, count, count, ARCS, 2)[..., 1]
        offered = halves[graph.problem[graph.giver[edge]], graph.arm[graph.giver[edge]], receiver]
        upward = torch.where(graph.arm[graph.giver[edge]] < receiver, choice.place, -choice.place)
        alpha = chart_alpha(offered, graph.arc[edge], upward)
        who = [2.0 * nn.functional.one_hot(arm, count) - 1.0 for arm in (choice.arm, receiver)]
        return torch.cat([torch.where(choice.final, 1.0, -1.0)[:, None], *who, torch.stack([alpha, 0 * alpha], -1)], -1)

    def _nearby(self, shape: tuple[int, ...]) -> Tensor:
        """Offsets of sizes from a hundredth to a third."""
        return 10 ** -(0.5 + 1.5 * self._uniform(shape)) * self._gaussian(shape)

    def _gumbel(self, shape: tuple[int, ...]) -> Tensor:
        return -(-self._uniform(shape).clamp_min(1e-20).log()).clamp_min(1e-20).log()

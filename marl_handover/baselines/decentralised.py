"""``variant=decentralised``: no supervisor; the arms take turns and each decides for itself.

They learn by hybrid SAC, with an exact expectation over what *one* arm can choose, pass, finish or place.

The discount is applied once a decision, whoever decides. Three kinds of learners:

``independent``: two, one an arm, that share neither weights nor data. From an arm's turn to its next one; what the other did in between,
and earned, is part of the environment.
``shared``: one for both arms, which see the same problem mirrored; the same transitions.
``ctde``: the actor of ``shared``; its critic sees both arms' blocks, and looks one decision ahead, through the other arm's turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from marl_handover.arrays import one_where
from marl_handover.baselines.turn_replay import TurnReplay
from marl_handover.cell import NO_ARM, Cell, load_cell
from marl_handover.config import TaskConfig
from marl_handover.envs.decentralised import DecentralisedEnv, TurnRules, own_view
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.algorithm import Algorithm, compiled, stepped
from marl_handover.learning.collector import BatchedCollector, Collector
from marl_handover.learning.hybrid_sac import HybridSac, HybridSacLoss, SoftValue
from marl_handover.learning.networks import (
    LOG_STD_RANGE,
    ActionDistribution,
    AfterstateCritic,
    AngleFeatures,
    Canonicalize,
    TwinMLP,
    arm_blocks,
    mlp,
    squashed_sample,
)
from marl_handover.learning.settings import SacConfig, TrainConfig
from marl_handover.learning.variant import Variant
from marl_handover.task.episode import Act
from marl_handover.task.observations import ARM_FIELDS, observe
from marl_handover.task.rules import Rules

FINISH, PASS, PLACE = 0, 1, 2
"""An arm's branches; its mixture components come from ``PLACE`` on."""


class TurnActor(nn.Module):
    """The policy of an arm, for its turn.

    Args:
        hidden: widths.
        components: mixture components.
        canonical: fold the symmetry M_x.
        harmonics: see :class:`~marl_handover.learning.networks.AngleFeatures`.
    """

    def __init__(self, hidden: Sequence[int], components: int, canonical: bool, harmonics: int) -> None:
        super().__init__()
        self.components = components
        self.canonicalize, self.features = Canonicalize(canonical), AngleFeatures(harmonics)
        self.net = mlp(self.features.width, hidden, PLACE + 5 * components)
        last = self.net[-1]
        if components > 1 and isinstance(last, nn.Linear):  # start the components apart, so that they do not learn the same thing
            with torch.no_grad():
                last.bias[PLACE + components : PLACE + 3 * components : 2] = torch.linspace(-0.8, 0.8, components)

    def forward(self, block: Tensor) -> ActionDistribution:
        """ActionDistribution of own blocks (n, fields): logits (n, 1, 2 + components), places (n, 1, components, 2) in the arm's frame."""
        blocks, sign = self.canonicalize(block.unsqueeze(-2))
        out = self.net(self.features(blocks))
        components, split = self.components, PLACE + self.components
        mean = out[..., split : split + 2 * components].unflatten(-1, (components, 2))
        log_std = out[..., split + 2 * components :].unflatten(-1, (components, 2)).clamp(*LOG_STD_RANGE)
        alpha_sign = sign[..., None, None].expand(*mean.shape[:-1], 1)
        return ActionDistribution(out[..., :split], mean * torch.cat([alpha_sign, torch.ones_like(alpha_sign)], -1), log_std)


class TurnCritic(AfterstateCritic):
    """Twin values of an arm's branches. As kinematics says where an arm puts the object, placing is judged by what follows, and a pass as a
    placement that leaves the object where it is and is marked as such.

    Args:
        place_hidden: widths for placing and passing.
        final_hidden: widths for finishing.
        canonical: fold the symmetry M_x.
        harmonics: see :class:`~marl_handover.learning.networks.AngleFeatures`.
        seen: 1: it knows what its arm knows; 2: it sees the blocks of both arms, the acting one's first.
    """

    def __init__(self, place_hidden: Sequence[int], final_hidden: Sequence[int], canonical: bool, harmonics: int, seen: int) -> None:
        super().__init__(place_hidden, final_hidden, canonical, harmonics)
        self.seen = seen
        self.place = TwinMLP(seen * self.features.width + 1, place_hidden)

    def value_place(self, following: Tensor, passed: Tensor | None = None) -> Tensor:
        """Values (2, ...) of afterstates (..., 2, fields): the acting arm's block, then the other's; ``passed`` (...) marks passes."""
        blocks, _ = self.canonicalize(following[..., : self.seen, :])
        features = self.features(blocks).flatten(-2)
        mark = torch.zeros_like(features[..., 0]) if passed is None else passed.to(features.dtype)
        return self.place(torch.cat([features, mark[..., None]], -1).flatten(0, -2)).unflatten(-1, following.shape[:-2])


def turn_action(logits: Tensor, place: Tensor, noise: Tensor | None = None) -> Tensor:
    """Actions (n, 3) of the branch with the largest logit, after adding ``noise`` to the logits.

    ``logits`` (n, 1, 2 + components); ``place`` (n, 1, components, 2).
    """
    flat = logits.flatten(1) if noise is None else logits.flatten(1) + noise
    branch = flat.argmax(-1)
    rows = torch.arange(len(logits), device=logits.device)
    where = place[rows, 0, (branch - PLACE).clamp_min(0)]
    choice = torch.where(branch == FINISH, 1.0, torch.where(branch == PASS, -1.0, 0.0))
    return torch.cat([choice[:, None], where], -1)


REACHES = ARM_FIELDS.index("reaches_object")
OWN = len(ARM_FIELDS)
"""Numbers of a view that an arm's networks see."""


class BranchValues(NamedTuple):
    """Of each branch (n, 2 + components): log-probability and value, a place's with its entropy.

    And ``place_log_prob`` (n, components), ``mean``.
    """

    log_probability: Tensor
    value: Tensor
    place_log_prob: Tensor
    mean: Tensor  # (n, 1, components, 2), of places, in (-1, 1)


class TurnSacLoss(HybridSacLoss):
    """The three losses of one learner; the axis of the arms that its base has is the acting arm's alone."""

    rules: TurnRules
    actor: TurnActor  # type: ignore[assignment]
    critic: TurnCritic
    target: TurnCritic

    def __init__(self, rules: TurnRules, actor: TurnActor, critic: TurnCritic, target: TurnCritic, config: SacConfig) -> None:
        super().__init__(rules, actor, critic, target, config)  # type: ignore[arg-type]

    def blocks(self, pose: Tensor, goal: Tensor, turn: Tensor, epsilon: Tensor) -> Tensor:
        """Blocks (..., 2, fields) of objects (..., 3): of arm ``turn`` (...), then of the other."""
        both = arm_blocks(observe(self.rules, "relative", pose, goal, torch.full_like(turn, NO_ARM), epsilon))
        return torch.where((turn == 1)[..., None, None], both.flip(-2), both)

    def afterstates(self, batch: dict[str, Tensor], place: Tensor) -> tuple[Tensor, Tensor]:
        """As the base class, if the arm whose turn it is placed at ``place`` (n, 1, m, 2), in its own frame."""
        shape = place.shape[:-1]
        pose, goal = (batch[key][:, None, None].expand(*shape, 3) for key in ("pose", "goal"))
        turn, epsilon = (batch[key][:, None, None].expand(shape) for key in ("turn", "epsilon"))
        command = self.rules.command(torch.cat([torch.zeros_like(place[..., :1]), place], -1), turn)
        placed, _ = self.rules.transfer(pose, goal, command)
        penalty = self.config.reward_scale * self.rules.motion_penalty(turn, pose, placed)
        return self.blocks(placed, goal, turn, epsilon), penalty

    def branch_values(self, critic: TurnCritic, batch: dict[str, Tensor], noise: Tensor) -> BranchValues:
        """What the acting arm's present policy says of its branches, and what ``critic`` does."""
        branches = self.actor(batch["observation"])
        place, place_log_prob = squashed_sample(branches, noise)
        following, penalty = self.afterstates(batch, place)
        place_value = critic.value_place(following).amin(0) - penalty - self.log_temperatures.detach()[0].exp() * place_log_prob
        final_value = critic.value_final(batch["observation"]).amin(0)
        pass_value = critic.value_place(batch["blocks"], torch.ones_like(final_value)).amin(0)
        value = torch.cat([torch.stack([final_value, pass_value], -1), place_value[:, 0]], -1)
        return BranchValues(branches.logits[:, 0].log_softmax(-1), value, place_log_prob[:, 0], branches.mean.tanh())

    def soft_value(self, critic: TurnCritic, batch: dict[str, Tensor], noise: Tensor) -> SoftValue:  # type: ignore[override]
        """Soft value of the present policy on its turn.

        ``probability`` (n, 2 + components) and ``place_log_prob`` (n, components) have no arms.
        """
        log_probability, value, place_log_prob, mean = self.branch_values(critic, batch, noise)
        probability = log_probability.exp()
        branch_entropy = -(probability * log_probability).sum(-1)
        total = (probability * value).sum(-1) + self.log_temperatures.detach()[1].exp() * branch_entropy
        return SoftValue(total, probability, branch_entropy, place_log_prob, mean)

    def actor_loss(self, batch: dict[str, Tensor], noise: Tensor, candidates: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As the base class; besides, a branch that is clearly better than the policy is made likelier, however unlikely it is.

        The gradient of an expected value vanishes with the probability of a branch, and passing, the safest choice of a beginner, would
        stay the only one long after the critic knows better.
        """
        log_probability, value, place_log_prob, mean = self.branch_values(self.critic, batch, noise)
        probability, temperature = log_probability.exp(), self.log_temperatures.detach().exp()[1]
        expected, branch_entropy = (probability * value).sum(-1), -(probability * log_probability).sum(-1)
        best, branch = value.detach().max(-1)
        gain = (best - expected.detach()).clamp(0.0, 1.0)
        missed = (gain * log_probability.gather(-1, branch[:, None])[:, 0]).mean()
        loss = -(expected + temperature * branch_entropy).mean() - missed
        if candidates.numel():
            some = {key: tensor[: len(candidates)] for key, tensor in batch.items()}
            loss = loss + self.config.candidate_weight * self._candidate_loss(some, mean[: len(candidates)], candidates, offsets)
        weight = probability[:, PLACE:].detach()
        place_entropy = -(weight * place_log_prob).sum() / weight.sum().clamp_min(1e-6)
        return loss, branch_entropy.mean().detach(), place_entropy.detach()

    def critic_loss(self, batch: dict[str, Tensor], following: dict[str, Tensor], noise: Tensor) -> Tensor:
        """Squared error of both critics on the branch that was taken, summed over the two."""
        with torch.no_grad():
            future = self.soft_value(self.target, following, noise).value
            target = self.config.reward_scale * following["reward"] + following["discount"] * future
        moved = self.critic.value_place(batch["after"], batch["passed"])
        penalty = self.config.reward_scale * self.rules.motion_penalty(batch["turn"], batch["pose"], batch["placed"])
        moved = moved - torch.where(batch["passed"], 0.0, penalty)
        value = torch.where(batch["final"], self.critic.value_final(batch["observation"]), moved)
        return (value - target).square().mean(1).sum()

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """``loss_qvalue`` and ``loss_actor`` of a batch of :class:`TurnReplay`, TorchRL style; training uses the parts above."""
        batch, following = self.unpacked(tensordict)
        noise = torch.randn(2, len(tensordict), 1, self.actor.components, 2, device=tensordict.device)
        none = torch.zeros(0, 1, 0, 2, device=tensordict.device)
        critic = self.critic_loss(batch, following, noise[0])
        actor, branch, place = self.actor_loss(batch, noise[1], none, none)
        return TensorDict({"loss_qvalue": critic, "loss_actor": actor, "entropy_branch": branch, "entropy_place": place})

    def unpacked(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Plain dictionaries, cheap to compile over: the decision, and the turn from which values are taken.

        That is the other arm's, or, where the batch says what this one did, the same arm's after it.
        """
        goal, turn, epsilon, action, first = (batch[key] for key in ("goal", "turn", "epsilon", "action", "next"))
        passed = self.rules.passes(action)
        present = {
            **self._state(batch["pose"], goal, turn, epsilon),
            "passed": passed,
            "final": self.rules.command(action, turn).final,
            "placed": first["pose"],
            "after": self.blocks(first["pose"], goal, turn, epsilon),
        }
        gamma = self.config.gamma
        discount = gamma * (~first["terminated"]).float()
        if "later" not in batch:
            following = self._state(first["pose"], goal, 1 - turn, epsilon)
            return present, {**following, "reward": first["reward"], "discount": discount}
        second = batch["later"]
        following = self._state(second["pose"], goal, turn, epsilon)
        reward = first["reward"] + discount * second["reward"]
        return present, {**following, "reward": reward, "discount": gamma * discount * (~second["terminated"]).float()}

    def _state(self, pose: Tensor, goal: Tensor, turn: Tensor, epsilon: Tensor) -> dict[str, Tensor]:
        blocks = self.blocks(pose, goal, turn, epsilon)
        return {"pose": pose, "goal": goal, "turn": turn, "epsilon": epsilon, "blocks": blocks, "observation": blocks[:, 0]}


class DecentralisedSac(HybridSac):
    """Networks, optimisers and temperatures of one learner for both arms, or of one each.

    An optimiser holds the parameters of all learners; as Adam treats every number by itself, that is one optimiser each. A gradient step
    steps them all: of independent learners each one, on its own half of the batch.
    """

    kind = "turns"
    stored = ("losses", "average", "actor_optimizer", "critic_optimizer", "temperature_optimizer")

    def __init__(self, rules: Rules, config: TrainConfig, generator: torch.Generator) -> None:
        Algorithm.__init__(self, rules, config, generator)  # the base class would make a supervisor's networks
        assert isinstance(rules, TurnRules)
        self.learners = rules.settings.learners
        arms = rules.cell.num_arms if self.learners == "independent" else 1
        self.losses = nn.ModuleList([self._learner(rules) for _ in range(arms)]).to(self.device)
        parts = [loss for loss in self.losses if isinstance(loss, TurnSacLoss)]
        self.actors = nn.ModuleList([loss.actor for loss in parts])
        self.critics = nn.ModuleList([loss.critic for loss in parts])
        self._optimise(self.actors, self.critics, [loss.log_temperatures for loss in parts])
        self.parts = [(loss, compiled(loss.critic_loss, config.compile), compiled(loss.actor_loss, config.compile)) for loss in parts]

    def _learner(self, rules: TurnRules) -> TurnSacLoss:
        own, seen = self.config, 2 if self.learners == "ctde" else 1
        actor = TurnActor(own.actor_hidden, own.mixture_components, self.folds, own.harmonics)
        critic, target = (TurnCritic(own.critic_hidden, own.final_hidden, self.folds, own.harmonics, seen) for _ in range(2))
        target.load_state_dict(critic.state_dict())
        return TurnSacLoss(rules, actor, critic, target.requires_grad_(False), own)

    def trained(self) -> nn.Module:
        """The policy network, or the arms' two."""
        return self.actors

    def exported(self) -> list[list[nn.Linear]]:
        """The layers of each actor."""
        return [[module for module in actor.modules() if isinstance(module, nn.Linear)] for actor in self.average.children()]

    def about(self) -> dict[str, Any]:
        """As the base class, and what kind of learners."""
        return {**super().about(), "learners": self.learners}

    def _branches(self, actors: nn.Module, observation: Tensor) -> ActionDistribution:
        """What the arms whose turn it is say, by ``actors``, of :func:`~marl_handover.envs.decentralised.own_view` (n, VIEW_SIZE)."""
        said = [actor(observation[:, :OWN]) for actor in actors.children()]
        right = observation[:, OWN] > 0
        left, other = said[0], said[-1]
        return ActionDistribution(*(torch.where(right.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(left, other, strict=True)))

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """A branch and a place drawn from the policy. An arm that reaches the object does not pass when the other one just did.

        Policies that know little find waiting safest, and the memory would fill with episodes in which nothing happens.
        """
        branches = self._branches(self.actors, observation)
        # Some cells follow the deterministic policy: where that goes in circles, its states must get into the memory.
        exploring = torch.arange(len(observation), device=self.device) >= int(self.config.deterministic_env_fraction * len(observation))
        needed = (observation[:, REACHES] > 0) & (observation[:, OWN + 1] > 0)
        branches.logits[:, 0, PASS] -= torch.where(needed, torch.inf, 0.0)
        place, _ = squashed_sample(branches, self._gaussian(branches.mean.shape) * exploring[:, None, None, None])
        uniform = self._uniform(branches.logits.flatten(1).shape)
        gumbel = -(-uniform.clamp_min(1e-20).log()).log()
        anywhere = self._uniform(place.shape[:-1]) < self.config.random_place
        anywhere &= exploring[:, None, None]
        place = torch.where(anywhere[..., None], self._anywhere(place.shape), place)
        return turn_action(branches.logits, place, gumbel * exploring[:, None])

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The likeliest branch and its mean place."""
        branches = self._branches(self.average, observation)
        return turn_action(branches.logits, branches.mean.tanh())

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of all learners' critics, actors, temperatures and targets."""
        stride = len(self.parts)
        rows = [loss.unpacked(batch[number::stride]) for number, (loss, _, _) in enumerate(self.parts)]
        count = len(batch) // stride
        shape = (count, 1, self.config.mixture_components, 2)
        critic = [lossy(*both, self._gaussian(shape)) for (_, lossy, _), both in zip(self.parts, rows, strict=True)]
        critic_loss = torch.stack(critic).sum()
        stepped(self.critic_optimizer, critic_loss)
        tried = (int(count * self.config.candidate_share), 1, self.config.candidates, 2)
        self.critics.requires_grad_(False)
        acted = [
            lossy(present, self._gaussian(shape), self._anywhere(tried), self._nearby(tried))
            for (_, _, lossy), (present, _) in zip(self.parts, rows, strict=True)
        ]
        actor_loss = torch.stack([loss for loss, _, _ in acted]).sum()
        stepped(self.actor_optimizer, actor_loss)
        self.critics.requires_grad_(True)
        heat = [part[0].temperature_loss(branch, place, self.targets) for part, (_, branch, place) in zip(self.parts, acted, strict=True)]
        stepped(self.temperature_optimizer, torch.stack(heat).sum())
        with torch.no_grad():
            for loss, _, _ in self.parts:
                torch._foreach_lerp_(list(loss.target.parameters()), list(loss.critic.parameters()), self.config.tau)
            self._average()
        return self._logged(critic_loss, actor_loss, acted)

    def _logged(self, critic_loss: Tensor, actor_loss: Tensor, acted: list[tuple[Tensor, ...]]) -> dict[str, Tensor]:
        """What is logged: sums of losses, means of the rest over the learners."""
        temperature = torch.stack([loss.log_temperatures.detach().exp() for loss, _, _ in self.parts]).mean(0)
        return {
            "loss_critic": critic_loss.detach(),
            "loss_actor": actor_loss.detach(),
            "entropy_branch": torch.stack([branch for _, branch, _ in acted]).mean(),
            "entropy_place": torch.stack([place for _, _, place in acted]).mean(),
            "temperature_place": temperature[0],
            "temperature_branch": temperature[1],
        }


class Decentralised(Variant):
    """Arms that take turns (see :mod:`marl_handover.envs.decentralised`) and learn as ``decentralised.learners`` says."""

    algorithms: ClassVar[dict[str, type[Algorithm]]] = {"sac": DecentralisedSac}

    def rules(self, cell: Cell, task: TaskConfig, config: TrainConfig) -> TurnRules:
        """The rule book with its skin for turns."""
        return TurnRules(cell, task, config.decentralised)

    def env(self, config: TrainConfig, device: torch.device) -> DecentralisedEnv:
        """The batch of cells to train in."""
        return DecentralisedEnv(config.num_envs, load_cell(config.cell), config.task, device, config.seed + 1, config.decentralised)

    def collector(self, env: SupervisorEnv, config: TrainConfig) -> Collector:
        """Steps of all cells, of which only transfers count as steps."""
        return BatchedCollector(env, max_decisions=_turn_rules(env.rules).max_decisions)

    def replay(self, env: SupervisorEnv, config: TrainConfig, generator: torch.Generator) -> TurnReplay:
        """From turn to turn, or for a centralised critic from decision to decision."""
        learners = config.decentralised.learners
        return TurnReplay(_turn_rules(env.rules), config.replay, env, generator, learners != "ctde", learners == "independent")

    def policy(self, algorithm: Algorithm, rules: Rules | None = None) -> Act:
        """The deterministic policies as one supervisor, L first. Two passes in a row: no arm moves."""
        rules = _turn_rules(rules or algorithm.rules)

        def asked(pose: Tensor, goal: Tensor, turn: Tensor) -> Tensor:
            both = observe(rules, "relative", pose, goal, torch.full_like(turn, NO_ARM))
            return algorithm.act(own_view(both, turn, torch.zeros_like(turn)))

        def act(pose: Tensor, goal: Tensor, previous: Tensor) -> Tensor:
            """What the arm whose turn it is answers, or, if it passes, the other one."""
            first = rules.turn_of(previous)
            answer = asked(pose, goal, first)
            passed = rules.passes(answer)
            turn = torch.where(passed, 1 - first, first)
            answer = one_where(passed, asked(pose, goal, 1 - first), answer)
            return one_where(rules.passes(answer), torch.full_like(pose[:, :1], torch.nan), rules.supervisor_action(answer, turn))

        return act


def _turn_rules(rules: object) -> TurnRules:
    """The rule book as what it is here."""
    assert isinstance(rules, TurnRules)
    return rules

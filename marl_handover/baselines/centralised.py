"""``variant=centralised``: one policy decides and moves, and its motions are judged like the executors'.

Hybrid SAC in which every branch has a tanh-Gaussian motion, given where the branch goes.

V = sum_i p_i [Q_i - a_place log pi_i(place) - a_motion log pi_i(motion)] - a_branch sum_i p_i log p_i, exact over the branches i, with
three temperatures. Q_i = (1 - r) V_i + r failure: V_i is the hierarchical critic's value of the branch if its motion can be made, r the
chance that it is refused. V_i learns from transfers that were made, r from all that kinematics alone would have allowed.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from marl_handover.baselines.flat_sac import FlatSac
from marl_handover.cell import Cell, load_cell
from marl_handover.config import CentralisedConfig, TaskConfig
from marl_handover.envs.centralised import CentralisedRules
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.algorithm import Algorithm, compiled, stepped
from marl_handover.learning.hybrid_sac import HybridSac, HybridSacLoss, unpacked
from marl_handover.learning.networks import LOG_STD_RANGE, AfterstateCritic, HybridActor, arm_blocks, chosen_action, mlp, squashed_sample
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import SacConfig, TrainConfig
from marl_handover.learning.variant import Variant
from marl_handover.motion.batched_paths import FIELDS, mirrored_numbers, transfer_features
from marl_handover.task.observations import ARM_FIELDS
from marl_handover.task.rules import Rules


class MotionActor(HybridActor):
    """Decides as :class:`HybridActor` does, and draws the motion of a branch from the way it goes.

    All that a motion earns is not to be refused, and that depends on both its ends in the acting arm's frame: its network sees no more.

    Args:
        cell: the cell.
        config: of the learner.
        count: numbers of a motion.
    """

    scale: Tensor

    def __init__(self, cell: Cell, config: SacConfig, count: int) -> None:
        super().__init__(cell, config.actor_hidden, config.mixture_components, True, config.canonical, config.harmonics)
        self.cell, self.canonical, self.count = cell, config.canonical, count
        self.move = mlp(len(FIELDS), config.actor_hidden, 2 * count)
        last = self.move[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():  # all zeros to begin with: with offsets, the executors' first guess
            last.weight.mul_(0.01)
            last.bias.zero_()
        self.places = [ARM_FIELDS.index(name) for name in ("x", "y", "goal_x", "goal_y")]
        self.register_buffer("scale", torch.tensor([*cell.views[0]] * 2) * cell.r_max_mm, persistent=False)

    def positions(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """World positions (n, 2) in mm of object and goal, as observations (n, size) show them."""
        seen = arm_blocks(observation)[..., 0, :][..., self.places] * self.scale
        return seen[..., :2], seen[..., 2:]

    def way(self, arm: Tensor, from_mm: Tensor, to_mm: Tensor) -> tuple[Tensor, Tensor]:
        """Features (..., fields) and sign (...) of ways; see :func:`transfer_features`."""
        return transfer_features(self.cell, arm, from_mm, to_mm, self.canonical)

    def motion(self, way: Tensor) -> tuple[Tensor, Tensor]:
        """Mean before the tanh and log of the deviation, (..., M), of the motions for ways (..., fields), folded as they are."""
        mean, log_std = self.move(way).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD_RANGE)

    def with_motion(self, observation: Tensor, decision: Tensor, noise: Tensor) -> Tensor:
        """Actions (n, 4 + M) of decisions (n, 4); ``noise`` (n, M) in deviations."""
        arm, final = (decision[:, 1] > 0).long(), decision[:, :1] > 0
        start, goal = self.positions(observation)
        place = self.cell.shared.to_table(decision[:, 2], decision[:, 3])
        way, sign = self.way(arm, start, torch.where(final, goal, place))
        mean, log_std = self.motion(way)
        return torch.cat([decision, mirrored_numbers((mean + log_std.exp() * noise).tanh(), sign)], -1)


class MotionCritic(AfterstateCritic):
    """Twin values of the branches if their motions are made, and how likely those are to be refused.

    What a refusal costs is known, and that it ends the episode; so the value of a branch is (1 - p) V + p failure. V is the
    hierarchical critic; p is learned from what was refused.
    """

    def __init__(self, config: SacConfig, centralised: CentralisedConfig, count: int) -> None:
        super().__init__(config.critic_hidden, config.final_hidden, config.canonical, config.harmonics)
        self.refusal = mlp(len(FIELDS) + count, centralised.refusal_hidden, 1)

    def refused_logit(self, way: Tensor, numbers: Tensor) -> Tensor:
        """Log-odds (...) that motions (..., M) on ways (..., fields) are refused, both folded."""
        logit: Tensor = self.refusal(torch.cat([way, numbers], -1))
        return logit[..., 0]


class Drawn(NamedTuple):
    """What the policy would do in every branch, and what comes of it.

    The soft value is (n,), the others are (n, arms, 1 + components), or without final.
    """

    value: Tensor
    probability: Tensor
    branch_entropy: Tensor
    place_log_prob: Tensor
    motion_log_prob: Tensor
    mean: Tensor  # of places, in (-1, 1)


class CentralisedSacLoss(HybridSacLoss):
    """The losses of :class:`HybridSacLoss`, motions included. ``rules`` are those without motions: what kinematics alone would do."""

    actor: MotionActor
    critic: MotionCritic
    target: MotionCritic

    def __init__(
        self, rules: Rules, actor: MotionActor, critic: MotionCritic, target: MotionCritic, config: SacConfig, start: list[float]
    ) -> None:
        LossModule.__init__(self)
        self.rules, self.config = rules, config
        self.actor, self.critic, self.target = actor, critic, target
        self.log_temperatures = nn.Parameter(torch.tensor(start).log())  # of places, of branches, of motions
        self.noise_width = rules.cell.num_arms * (2 * actor.components + (1 + actor.components) * actor.count)
        self.failure = config.reward_scale * rules.config.reward.failure

    def drawn(self, critic: MotionCritic, batch: dict[str, Tensor], noise: Tensor) -> Drawn:
        """What the present policy would do and its soft value under ``critic``; ``noise`` (n, noise_width) of places, then of motions."""
        branches = self.actor(batch["observation"])
        places = branches.mean.numel() // len(branches.mean)
        place_noise = noise[:, :places].reshape(branches.mean.shape)
        place, place_log_prob = squashed_sample(branches, place_noise)
        way = self._ways(batch["observation"], place)
        mean, log_std = self.actor.motion(way)
        motion_noise = noise[:, places:].reshape(mean.shape)
        numbers, motion_log_prob = squashed_sample(branches._replace(mean=mean, log_std=log_std), motion_noise)
        following, _ = self.afterstates(batch, place)
        final_value = critic.value_final(arm_blocks(batch["observation"])).amin(0)
        value = torch.cat([final_value[..., None], critic.value_place(following).amin(0)], -1)
        refused = critic.refused_logit(way, numbers).sigmoid()
        worth = (1 - refused) * value + refused * self.failure
        temperature = self.log_temperatures.detach().exp()
        log_probability = branches.logits.flatten(1).log_softmax(-1).view_as(branches.logits)
        probability = log_probability.exp()
        branch_entropy = -(probability * log_probability).sum((-2, -1))
        soft = (
            (probability * (worth - temperature[2] * motion_log_prob)).sum((-2, -1))
            - temperature[0] * (probability[..., 1:] * place_log_prob).sum((-2, -1))
            + temperature[1] * branch_entropy
        )
        return Drawn(soft, probability, branch_entropy, place_log_prob, motion_log_prob, branches.mean.tanh())

    def _ways(self, observation: Tensor, place: Tensor) -> Tensor:
        """Features (n, arms, 1 + components, fields) of the ways of all branches, final ones first."""
        start, goal = self.actor.positions(observation)
        table = self.rules.cell.shared.to_table(place[..., 0], place[..., 1])
        to = torch.cat([goal[:, None, None].expand(*place.shape[:2], 1, 2), table], 2)
        arm = torch.arange(to.shape[1], device=to.device)[:, None].expand(to.shape[:-1])
        return self.actor.way(arm, start[:, None, None].expand_as(to), to)[0]

    def critic_loss(self, batch: dict[str, Tensor], following: dict[str, Tensor], noise: Tensor) -> Tensor:
        """Squared error of both values of transfers that no motion spoilt, and cross-entropy of the refusals among the possible ones."""
        with torch.no_grad():
            future = self.drawn(self.target, following, noise).value
            alive = torch.where(following["terminated"], 0.0, 1.0)
            target = self.config.reward_scale * following["reward"] + self.config.gamma * alive * future
            place = self.rules.cell.shared.to_table(batch["action"][:, 2], batch["action"][:, 3])
            to = torch.where(batch["final"][:, None], batch["goal"][:, :2], place)
            reach = self.rules.cell.reaches(batch["pose"]) & self.rules.cell.reaches(to)
            possible = reach.gather(1, batch["arm"][:, None])[:, 0]
            refused = possible & ~batch["feasible"]
            way, sign = self.actor.way(batch["arm"], batch["pose"][:, :2], to)
            numbers = mirrored_numbers(batch["action"][:, Rules.action_size :], sign)
        blocks, after = arm_blocks(batch["observation"]), arm_blocks(following["observation"])
        second = batch["arm"][:, None, None] == 1
        own = torch.where(second, blocks.flip(-2), blocks)[:, 0]
        after = torch.where(second, after.flip(-2), after)
        value = torch.where(batch["final"], self.critic.value_final(own), self.critic.value_place(after))
        error = (~refused * (value - target).square()).mean(1).sum()
        surprise = F.binary_cross_entropy_with_logits(self.critic.refused_logit(way, numbers), refused.float(), reduction="none")
        return error + (possible * surprise).mean()

    def motion_actor_loss(
        self, batch: dict[str, Tensor], noise: Tensor, candidates: Tensor, offsets: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Loss of the actor, then the mean entropies of branches, places and motions, for the temperatures."""
        drawn = self.drawn(self.critic, batch, noise)
        weight = drawn.probability.detach()
        places = weight[..., 1:]
        place_entropy = -(places * drawn.place_log_prob).sum() / places.sum().clamp_min(1e-6)
        motion_entropy = -(weight * drawn.motion_log_prob).sum() / weight.sum()
        loss = -drawn.value.mean()
        if candidates.numel():
            some = {key: value[: len(candidates)] for key, value in batch.items()}
            loss = loss + self.config.candidate_weight * self._candidate_loss(some, drawn.mean[: len(candidates)], candidates, offsets)
        return loss, drawn.branch_entropy.mean().detach(), place_entropy.detach(), motion_entropy.detach()

    def _place_value(self, batch: dict[str, Tensor], places: Tensor) -> Tensor:
        """The lower of both critics' values (n, arms, m) of places (n, arms, m, 2), taken there by the mean motion."""
        following, _ = self.afterstates(batch, places)
        way = self._ways(batch["observation"], places)[:, :, 1:]
        refused = self.critic.refused_logit(way, self.actor.motion(way)[0].tanh()).sigmoid()
        return (1 - refused) * self.critic.value_place(following).amin(0) + refused * self.failure

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """``loss_qvalue`` and ``loss_actor`` of a sampled batch, TorchRL style; training uses the parts above."""
        batch, following = with_actions(tensordict)
        noise = torch.randn(2, len(tensordict), self.noise_width, device=tensordict.device)
        none = torch.zeros(0, self.rules.cell.num_arms, 0, 2, device=tensordict.device)
        critic = self.critic_loss(batch, following, noise[0])
        actor, branch, place, motion = self.motion_actor_loss(batch, noise[1], none, none)
        entropies = {"entropy_branch": branch, "entropy_place": place, "entropy_motion": motion}
        return TensorDict({"loss_qvalue": critic, "loss_actor": actor, **entropies})

    def temperature_losses(self, entropies: Tensor, targets: Tensor) -> Tensor:
        """Raises a temperature whose entropy (of places, of branches, of motions) is below its target."""
        return (self.log_temperatures.exp() * (entropies - targets)).sum()


def with_actions(batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """As :func:`unpacked`, and what was done and whether the arm did it."""
    present, following = unpacked(batch)
    return present | {"action": batch["action"], "feasible": batch["feasible"][:, 0]}, following


class CentralisedSac(HybridSac):
    """Networks, optimisers and temperatures around :class:`CentralisedSacLoss`."""

    kind = "centralised"
    rules: CentralisedRules

    def __init__(self, rules: CentralisedRules, config: TrainConfig, generator: torch.Generator) -> None:
        Algorithm.__init__(self, rules, config, generator)
        own, self.centralised, self.count = self.config, config.centralised, rules.numbers.count
        actor = MotionActor(rules.cell, own, self.count).to(self.device)
        critic, target = (MotionCritic(own, self.centralised, self.count).to(self.device) for _ in range(2))
        target.requires_grad_(False).load_state_dict(critic.state_dict())
        start = [own.initial_temperature, own.initial_temperature, self.centralised.motion_temperature]
        self.loss = CentralisedSacLoss(Rules(rules.cell, rules.config), actor, critic, target, own, start).to(self.device)
        self._optimise(actor, critic, [self.loss.log_temperatures])
        self._critic_loss = compiled(self.loss.critic_loss, config.compile)
        self._actor_loss = compiled(self.loss.motion_actor_loss, config.compile)
        self.motion_target = self._motion_target(0.0)

    def schedule(self, fraction: float) -> None:
        """Learning rate and target entropies."""
        super().schedule(fraction)
        self.motion_target = self._motion_target(fraction)

    def _motion_target(self, fraction: float) -> float:
        """Target entropy of a motion; falls as that of places."""
        own, done = self.centralised, min(1.0, fraction / self.config.entropy_until)
        return self.count * (own.motion_entropy_start + done * (own.motion_entropy_end - own.motion_entropy_start))

    def exported(self) -> list[list[nn.Linear]]:
        """The layers of the network that decides and of the one that moves."""
        actor = self._kept()
        networks = (actor.net, actor.move)
        return [[module for module in network.modules() if isinstance(module, nn.Linear)] for network in networks]

    def _kept(self) -> MotionActor:
        assert isinstance(self.average, MotionActor)
        return self.average

    def about(self) -> dict[str, Any]:
        """How the actor reads its blocks, and what its motions mean."""
        return {**super().about(), **about_motions(self.centralised)}

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """A branch, a place and a motion drawn from the policy."""
        decision = super().explore(observation)
        exploring = torch.arange(len(observation), device=self.device) >= int(self.config.deterministic_env_fraction * len(observation))
        noise = self._gaussian((len(observation), self.count)) * exploring[:, None]
        return self.loss.actor.with_motion(observation, decision, noise)

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The likeliest branch, its mean place and the mean motion there."""
        branches = self.average(observation)
        decision = chosen_action(branches.logits, branches.mean.tanh())
        return self._kept().with_motion(observation, decision, decision.new_zeros(len(decision), self.count))

    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One step of the critics, the actor, the temperatures and the target."""
        present, following = with_actions(batch)
        shape = (len(batch), self.loss.noise_width)
        critic_loss = self._critic_loss(present, following, self._gaussian(shape))
        stepped(self.critic_optimizer, critic_loss)
        tried = (int(len(batch) * self.config.candidate_share), self.rules.cell.num_arms, self.config.candidates, 2)
        self.loss.critic.requires_grad_(False)
        actor_loss, branch, place, motion = self._actor_loss(present, self._gaussian(shape), self._anywhere(tried), self._nearby(tried))
        stepped(self.actor_optimizer, actor_loss)
        self.loss.critic.requires_grad_(True)
        targets = torch.tensor([*self.targets, self.motion_target], device=self.device)
        stepped(self.temperature_optimizer, self.loss.temperature_losses(torch.stack([place, branch, motion]), targets))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.loss.target.parameters()), list(self.loss.critic.parameters()), self.config.tau)
            self._average()
        temperatures = self.loss.log_temperatures.detach().exp()
        return {
            "loss_critic": critic_loss.detach(),
            "loss_actor": actor_loss.detach(),
            "entropy_branch": branch,
            "entropy_place": place,
            "entropy_motion": motion / self.count,
            "temperature_place": temperatures[0],
            "temperature_branch": temperatures[1],
            "temperature_motion": temperatures[2],
        }


class CentralisedFlatSac(FlatSac):
    """The literal formulation: one flat vector of all numbers, decision and motion, in one squashed Gaussian."""

    kind = "centralised_box"

    def __init__(self, rules: CentralisedRules, config: TrainConfig, generator: torch.Generator) -> None:
        super().__init__(rules, config, generator)
        self.centralised = config.centralised

    def about(self) -> dict[str, Any]:
        """What the motions mean."""
        return about_motions(self.centralised)


def about_motions(settings: CentralisedConfig) -> dict[str, Any]:
    """The part of a policy file that says what its motions mean."""
    return {"centralised": vars(settings).copy()}


class MotionReplayBuffer(HindsightReplayBuffer):
    """Hindsight whose batches also say ``feasible``: a critic is to tell refusals from misses.

    Goals change as ever. A motion that was allowed stays so, since the hand-over that becomes final goes the same way; a refused
    transfer keeps its goal.
    """

    def _assembled(self, batch: TensorDictBase, reward: Tensor, terminated: Tensor) -> TensorDict:
        assembled = super()._assembled(batch, reward, terminated)
        assembled["feasible"] = batch["feasible"]
        return assembled


class Centralised(Variant):
    """The centralised formulation; architecture B."""

    algorithms: ClassVar[dict[str, Any]] = {"sac": CentralisedSac, "flat_sac": CentralisedFlatSac}

    def rules(self, cell: Cell, task: TaskConfig, config: TrainConfig) -> CentralisedRules:
        """The rule book with motions."""
        return CentralisedRules(cell, task, config.centralised)

    def env(self, config: TrainConfig, device: torch.device) -> SupervisorEnv:
        """The batch of cells; their actions are decision and motion."""
        cell = load_cell(config.cell)
        rules = self.rules(cell, config.task, config)
        return SupervisorEnv(config.num_envs, cell, config.task, device, seed=config.seed + 1, rules=rules)

    def replay(self, env: SupervisorEnv, config: TrainConfig, generator: torch.Generator) -> MotionReplayBuffer:
        """The memory that the learners draw from."""
        return MotionReplayBuffer(env.rules, config.replay, env, generator)

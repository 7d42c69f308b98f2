"""Hindsight replay that is right for this problem.

TorchRL's :class:`HERReplayBuffer` relabels goal and reward. Here the end flag, the final flag and the observations change
with the goal too: a hand-over by arm b that was to leave the object at s' is exactly what the *final* action of b would have done
had the goal been s'. So this subclass stores what does not depend on the goal, and derives the rest from the rule book at
sampling time, at the present epsilon.

Where placements are not exact, s' is where the command would have put the object on exact arms, not where it was measured: that
action aimed at s' and missed it by the noise, or by a missed grasp, and the relabelled one is judged by just that.
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import HERReplayBuffer, LazyTensorStorage

from marl_handover.arrays import one_where, wrap
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.settings import ReplayConfig
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Command, Rules, carried

logging.getLogger("torchrl").setLevel(logging.WARNING)  # which its import sets to tell of every memory that is made

STORED = ("achieved_goal", "desired_goal", "previous_arm", "action", "placed", "feasible", "epsilon", "terminated")


class EpisodeWriter:
    """Holds the running episode of every cell and hands over whole ones, contiguous, as TorchRL's hindsight needs them.

    Each row of a finished episode knows how many rows of its episode follow (``remaining``) and precede it (``elapsed``).
    """

    def __init__(self, num_envs: int, max_steps: int, device: torch.device) -> None:
        self.length = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.max_steps = max_steps
        self.rows: TensorDict | None = None

    def add(self, transition: TensorDictBase) -> TensorDict | None:
        """Take one step of all cells, (num_envs,); return the rows of the episodes it ended, or None."""
        step = TensorDict({key: transition[key] for key in STORED[:4]}, transition.batch_size, device=transition.device)
        if "layout" in transition.keys():  # noqa: SIM118 - a TensorDict
            step["layout"] = transition["layout"]
        step.update({key: transition["next", key] for key in STORED[4:]})
        if self.rows is None:
            self.rows = step.unsqueeze(1).expand(len(self.length), self.max_steps).clone().zero_()
        cells = torch.arange(len(self.length), device=self.length.device)
        for key, value in step.items():
            self.rows[key][cells, self.length] = value
        self.length += 1
        ended = transition["next", "done"][:, 0].nonzero()[:, 0]
        if len(ended) == 0:
            return None
        length = self.length[ended, None]
        position = torch.arange(self.max_steps, device=self.length.device)[None]
        kept = position < length
        finished = self.rows[ended][kept]
        finished["remaining"] = (length - 1 - position)[kept][:, None]
        finished["elapsed"] = position.expand_as(kept)[kept][:, None]
        self.length[ended] = 0
        return finished

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors."""
        rows = None if self.rows is None else self.rows.to_dict()
        return {"length": self.length.clone(), "rows": rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self.length.copy_(state["length"])
        rows = state["rows"]
        self.rows = None if rows is None else TensorDict(rows, [len(self.length), self.max_steps], device=self.length.device)


class HindsightReplayBuffer(HERReplayBuffer):
    """Replay memory of whole episodes that answers :meth:`sample` with relabelled, re-judged transitions.

    A sampled batch holds ``observation``, ``action``, ``achieved_goal``, ``desired_goal``, ``epsilon``, ``arm``, ``final``
    and, under ``next``, ``observation``, ``achieved_goal`` (the pose after the commanded transfer), ``reward``,
    ``terminated``, ``done``.
    """

    def __init__(self, rules: Rules, config: ReplayConfig, env: SupervisorEnv, generator: torch.Generator) -> None:
        super().__init__(
            reward_fn=self._reward,
            her_ratio=config.hindsight.ratio if config.hindsight.strategy != "none" else 0.0,
            strategy=config.hindsight.strategy if config.hindsight.strategy != "none" else "future",
            achieved_goal_key="placed",
            storage=LazyTensorStorage(config.capacity, device=env.device),
            batch_size=1,
            generator=generator,
        )
        self.rules, self.config, self.env = rules, config, env
        self.draw = generator

    def _reward(self, batch: TensorDictBase) -> Tensor:
        """Reward of relabelled rows, (n, 1): the rule book's, never the stored one."""
        return self._judge(batch)[0]

    def _judge(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        placed, goal, epsilon = batch["placed"], batch["desired_goal"], batch["epsilon"][:, 0]
        verdict = self.rules.judge(placed, goal, batch["final"], batch["feasible"][:, 0], epsilon)
        if self.rules.external_finish and self.rules.noisy:  # the transfer that ends it may miss
            external = self.rules.external(placed, goal, epsilon_rad=epsilon)
            left = one_where(external.arm >= 0, self._landed(external.pose), placed)
            verdict = self.rules.external_verdict(left, goal, external.arm, epsilon)
        arm = self.rules.decode(batch["action"]).arm
        reward = verdict.reward - self.rules.motion_penalty(arm, batch["achieved_goal"], batch["placed"])
        return reward[:, None], verdict.terminated[:, None]

    def sample(self, batch_size: int | None = None, return_info: bool = False) -> TensorDict:
        """``batch_size`` transitions drawn uniformly, relabelled, mirrored if the settings say so, and judged at the present epsilon."""
        count = batch_size or 1
        index = torch.randint(len(self), (count,), generator=self.draw, device=self.draw.device)
        batch = self._storage.get(index)
        self.rules = self.env.rules_of(batch)
        batch["final"] = self.rules.decode(batch["action"]).final
        batch["epsilon"] = self.env.draw_epsilon(count)[:, None]
        own = batch["desired_goal"]
        self._relabel_hindsight(batch, index)
        self._relabel_random(batch, index)
        self._finish_externally(batch)
        if self.config.symmetry:
            self._mirror(batch)
        reward, terminated = self._judge(batch)
        if not self.config.correct_terminated:
            changed = (batch["desired_goal"] != own).any(-1, keepdim=True)
            terminated = torch.where(changed, batch["terminated"], terminated)
        return self._assembled(batch, reward, terminated)

    def _relabel_hindsight(self, batch: TensorDictBase, index: Tensor) -> None:
        """Goal := a pose of the same episode. The transition's own result makes the action final (architecture B)."""
        count = len(index)
        chosen = self._chance(count, self.her_ratio)
        uniform = torch.rand(count, generator=self.draw, device=index.device)
        remaining, elapsed = batch["remaining"][:, 0], batch["elapsed"][:, 0]
        if self.strategy == "final":
            offset = remaining
        elif self.strategy == "episode":
            offset = (uniform * (remaining + elapsed + 1)).long() - elapsed
        else:
            offset = (uniform * (remaining + 1)).long()
        source = self._storage.get((index + offset) % self.config.capacity)
        own = offset == 0
        # A final placement depends on its goal: it can only be told what it did itself. A refused one did nothing.
        true = batch["feasible"][:, 0] & source["feasible"][:, 0] & (own | ~batch["final"])
        chosen &= true & self._still_stored(index, offset)
        goal = self._near_miss(self._aim(source), batch["epsilon"][:, 0])
        batch["desired_goal"] = one_where(chosen, goal, batch["desired_goal"])
        if self.rules.noisy:
            # A later goal knows where this row's noise took the object: from there it was reached. Without that knowledge it is any draw.
            batch["placed"] = one_where(chosen & ~own, self._landed(self._aim(batch)), batch["placed"])
        if not self.rules.external_finish:
            batch["final"] = batch["final"] | (chosen & own)
        batch["hindsight"] = chosen[:, None]

    def _aim(self, rows: TensorDictBase) -> Tensor:
        """Where the stored commands (n,), all of them carried out, would have put the object on exact arms: (n, 3)."""
        if not self.rules.measured:
            return rows["placed"]
        # The plain kinematics: whether a motion is allowed was judged when it was made.
        return Rules.transfer(self.rules, rows["achieved_goal"], rows["desired_goal"], self._command(rows))[0]

    def _command(self, rows: TensorDictBase) -> Command:
        """The commands (n,) of stored rows."""
        return self.rules.decode(rows["action"])

    def _landed(self, pose: Tensor) -> Tensor:
        """Where objects that are put at ``pose`` (n, 3) come to lie: displaced by noise, where the task has that."""
        if not self.rules.noisy:
            return pose
        noise = self.rules.config.noise
        offset = self.env._normal(len(pose), noise.position_mm, noise.yaw_deg)
        return carried(pose, pose[:, :2] + offset[:, :2], offset[:, 2])

    def _finish_externally(self, batch: TensorDictBase) -> None:
        """Architecture A: whether the command was ignored, because the episode was solved at its start, depends on goal and epsilon.

        A command that was ignored when it was stored is executed now if it would be; one that would be ignored leaves the object.
        What an arm refused it refuses again. Rows of the rule book need not say which was which: it refuses by the kinematics alone.
        """
        if not self.rules.external_finish:
            return
        pose, goal = batch["achieved_goal"], batch["desired_goal"]
        moved, feasible = self.rules.transfer(pose, goal, self.rules.decode(batch["action"]))
        idle = batch["ignored"][:, 0] if "ignored" in batch.keys() else ~batch["feasible"][:, 0]  # noqa: SIM118 - a TensorDict
        solved = self.rules.can_finish(pose, goal, batch["epsilon"][:, 0]).any(-1)
        batch["feasible"] = ((batch["feasible"][:, 0] | (idle & feasible)) & ~solved)[:, None]
        batch["placed"] = one_where(solved, pose, one_where(idle & feasible, self._landed(moved), batch["placed"]))

    def _near_miss(self, goal: Tensor, epsilon: Tensor) -> Tensor:
        """Some goals turned a little. What was achieved then misses them, or just not: exact hindsight alone only ever shows
        an error of 0.
        """
        count, settings = len(goal), self.config.hindsight
        turn = torch.rand(count, generator=self.draw, device=goal.device) * 2 - 1
        turn = turn * settings.near_miss_epsilons * epsilon * self._chance(count, settings.near_miss_ratio)
        return torch.cat([goal[:, :2], wrap(goal[:, 2] + turn)[:, None]], -1)

    def _still_stored(self, index: Tensor, offset: Tensor) -> Tensor:
        """Whether the row ``offset`` away was not overwritten since: only rows *before* a row can be gone."""
        if len(self) < self.config.capacity:
            return torch.ones_like(index, dtype=torch.bool)
        cursor = self._writer._cursor % self.config.capacity
        age = (index - cursor) % self.config.capacity
        return age + offset >= 0

    def _relabel_random(self, batch: TensorDictBase, index: Tensor) -> None:
        """Goal := another row's goal, for hand-overs, which do not depend on the goal. Where each row has its own cell, a new one there."""
        count = len(index)
        share = self.config.hindsight.random_ratio if self.config.hindsight.strategy != "none" else 0.0
        chosen = self._chance(count, share) & ~batch["hindsight"][:, 0] & ~batch["final"]
        if self.env.layouts is None:
            goals = self._storage.get(torch.randint(len(self), (count,), generator=self.draw, device=index.device))["desired_goal"]
        else:
            goals = sample_problems(self.rules.cell, count, self.draw, torch.float32)[1]
        batch["desired_goal"] = one_where(chosen & batch["feasible"][:, 0], goals, batch["desired_goal"])

    def _mirror(self, batch: TensorDictBase) -> None:
        group = self.rules.cell.symmetries
        element = torch.randint(len(group), (len(batch),), generator=self.draw, device=batch.device)
        for number, symmetry in enumerate(group[1:], start=1):
            rows = element == number
            for key in ("achieved_goal", "desired_goal", "placed"):
                batch[key] = one_where(rows, symmetry.pose(batch[key]), batch[key])
            batch["action"] = one_where(rows, symmetry.action(batch["action"]), batch["action"])
            batch["previous_arm"] = one_where(rows, symmetry.arm(batch["previous_arm"]), batch["previous_arm"])

    def _assembled(self, batch: TensorDictBase, reward: Tensor, terminated: Tensor) -> TensorDict:
        arm = self.rules.decode(batch["action"]).arm
        epsilon = batch["epsilon"][:, 0]
        previous = batch["previous_arm"][:, 0]
        after = torch.where(batch["feasible"][:, 0], arm, previous)
        goal, pose, placed = batch["desired_goal"], batch["achieved_goal"], batch["placed"]
        final = torch.where(batch["final"], 1.0, -1.0)
        action = torch.cat([final[:, None], batch["action"][:, 1:]], -1) if not self.rules.external_finish else batch["action"]
        following = {
            "observation": self.env.observe(placed, goal, after, epsilon, self.rules),
            "achieved_goal": placed,
            "previous_arm": after[:, None],
            "reward": reward,
            "terminated": terminated,
            "done": terminated,
        }
        return TensorDict(
            {
                "observation": self.env.observe(pose, goal, previous, epsilon, self.rules),
                "achieved_goal": pose,
                "desired_goal": goal,
                "epsilon": batch["epsilon"],
                "previous_arm": batch["previous_arm"],
                "action": action,
                "arm": arm[:, None],
                "final": batch["final"][:, None],
                "hindsight": batch["hindsight"],
                "next": following,
            },
            batch.batch_size,
            device=batch.device,
        )

    def _chance(self, count: int, share: float) -> Tensor:
        return torch.rand(count, generator=self.draw, device=self.draw.device) < share

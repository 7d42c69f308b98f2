"""Hindsight for arms that take turns: what the other arm did in between is judged anew as well.

Rows are decisions, whole episodes contiguous, so the row after a row is the other arm's turn. That is all a learner needs that goes from
an arm's turn to its next one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_handover.arrays import one_where
from marl_handover.envs.decentralised import DecentralisedEnv, TurnRules
from marl_handover.learning.replay import HindsightReplayBuffer
from marl_handover.learning.settings import ReplayConfig
from marl_handover.task.rules import Command


class _Choice(NamedTuple):
    """What arms did: bool (n,), bool (n,), and whose turn it was (n,)."""

    passed: Tensor
    final: Tensor
    turn: Tensor


class TurnReplay(HindsightReplayBuffer):
    """Replay memory that answers :meth:`sample` with true decisions of one arm and, if asked, of the other right after.

    A sampled batch holds ``pose``, ``goal`` (n, 3), ``epsilon``, ``turn`` (n,), ``action`` (n, 3), ``hindsight`` (n,), and under ``next``:
    ``pose``, ``reward``, ``terminated`` after the decision; under ``later``, with ``to_next_turn``: ``action``, ``pose``, ``reward``,
    ``terminated`` of what the other arm did then. Where the first decision ended the episode, ``later`` means nothing.

    Args:
        rules: the rule book.
        config: settings of the memory.
        env: draws epsilon.
        generator: decides what is drawn.
        to_next_turn: whether transitions go on to the arm's next turn. Decisions after which an episode was cut off are left out then.
        separate: rows alternate between turns of L and of R, and no symmetry that swaps the arms is applied. Needs ``to_next_turn``.
    """

    rules: TurnRules

    def __init__(
        self,
        rules: TurnRules,
        config: ReplayConfig,
        env: DecentralisedEnv,
        generator: torch.Generator,
        to_next_turn: bool = True,
        separate: bool = False,
    ) -> None:
        super().__init__(rules, config, env, generator)
        self.to_next_turn, self.separate = to_next_turn, separate
        self.group = [element for element in rules.cell.symmetries if not (separate and element.swaps)]

    def sample(self, batch_size: int | None = None, return_info: bool = False) -> TensorDict:
        """``batch_size`` decisions drawn uniformly, relabelled, mirrored if the settings say so, and judged at the present epsilon."""
        index = self._drawn(batch_size or 1)
        batch = self._storage.get(index)
        later = self._storage.get((index + (batch["remaining"][:, 0] > 0)) % self.config.capacity)
        count = len(index)
        batch["epsilon"] = later["epsilon"] = self.env.draw_epsilon(count)[:, None]
        # A final placement that is stored depends on the goal that it was made for; so does a row whose answer is one.
        batch["answered"] = (batch["remaining"] > 0) & self._choice(later).final[:, None] & self.to_next_turn
        batch["final"] = self._choice(batch).final | batch["answered"][:, 0]
        self._relabel_hindsight(batch, index)
        self._relabel_random(batch, index)
        later["desired_goal"] = batch["desired_goal"]
        if self.config.symmetry:
            element = torch.randint(len(self.group), (count,), generator=self.draw, device=batch.device)
            self._mirror_by(element, batch)
            self._mirror_by(element, later)
        return self._turns(batch, later)

    def _drawn(self, count: int) -> Tensor:
        """Row numbers, drawn uniformly from those that can be used."""
        if not self.to_next_turn:
            return torch.randint(len(self), (count,), generator=self.draw, device=self.draw.device)
        rows = self._storage.get(slice(0, len(self)))
        usable = rows["terminated"][:, 0] | (rows["remaining"][:, 0] > 0)
        if not self.separate:
            return self._among(usable.nonzero()[:, 0], count)
        turn = self.rules.turn_of(rows["previous_arm"][:, 0])
        kept = [self._among((usable & (turn == arm)).nonzero()[:, 0], count // 2) for arm in range(self.rules.cell.num_arms)]
        return torch.stack(kept, 1).flatten()

    def _among(self, rows: Tensor, count: int) -> Tensor:
        return rows[torch.randint(len(rows), (count,), generator=self.draw, device=self.draw.device)]

    def _choice(self, batch: TensorDictBase) -> _Choice:
        turn = self.rules.turn_of(batch["previous_arm"][:, 0])
        return _Choice(self.rules.passes(batch["action"]), self.rules.command(batch["action"], turn).final, turn)

    def _relabel_hindsight(self, batch: TensorDictBase, index: Tensor) -> None:
        """Goal := a pose of the same episode. A placement's own result makes it final.

        Told about another goal, a final placement would have gone elsewhere, so a stored one keeps its goal, or gets the place where it
        went. This holds for the other arm's answer too.
        """
        chosen = self._chance(len(index), self.her_ratio)
        offset = self._offset(batch)
        source = self._storage.get((index + offset) % self.config.capacity)
        passed, final, _ = self._choice(batch)
        own = (source["placed"] == batch["placed"]).all(-1)  # also if nothing but passes followed
        free = torch.where(own, ~passed, ~final & (~batch["answered"][:, 0] | (offset == 1)))
        aim = one_where(own, self._aim(batch), self._aim(source))
        elsewhere = (aim != batch["achieved_goal"]).any(-1)  # or the object would lie at its goal already
        true = batch["feasible"][:, 0] & source["feasible"][:, 0] & free & elsewhere
        chosen &= true & self._still_stored(index, offset)
        goal = self._near_miss(aim, batch["epsilon"][:, 0])
        batch["desired_goal"] = one_where(chosen, goal, batch["desired_goal"])
        number = torch.where(chosen & own, 1.0, batch["action"][:, 0])
        batch["action"] = torch.cat([number[:, None], batch["action"][:, 1:]], -1)
        batch["hindsight"] = chosen[:, None]

    def _aim(self, rows: TensorDictBase) -> Tensor:
        passed = self.rules.passes(rows["action"])
        return one_where(passed, rows["achieved_goal"], super()._aim(rows))

    def _command(self, rows: TensorDictBase) -> Command:
        return self.rules.command(rows["action"], self.rules.turn_of(rows["previous_arm"][:, 0]))

    def _offset(self, batch: TensorDictBase) -> Tensor:
        """How many rows on, within its episode, each row's new goal is."""
        remaining, elapsed = batch["remaining"][:, 0], batch["elapsed"][:, 0]
        uniform = torch.rand(len(remaining), generator=self.draw, device=remaining.device)
        if self.strategy == "final":
            return remaining
        if self.strategy == "episode":
            return (uniform * (remaining + elapsed + 1)).long() - elapsed
        return (uniform * (remaining + 1)).long()

    def _mirror_by(self, element: Tensor, batch: TensorDictBase) -> None:
        """In an arm's own frame, swapping the arms changes no action; mirroring along the base line turns alpha."""
        for number, symmetry in enumerate(self.group[1:], start=1):
            rows = element == number
            for key in ("achieved_goal", "desired_goal", "placed"):
                batch[key] = one_where(rows, symmetry.pose(batch[key]), batch[key])
            batch["previous_arm"] = one_where(rows, symmetry.arm(batch["previous_arm"]), batch["previous_arm"])
            if symmetry.chart_signs[(0, 1)][0] < 0:
                turned = batch["action"] * batch["action"].new_tensor([1.0, -1.0, 1.0])
                batch["action"] = one_where(rows, turned, batch["action"])

    def _judge(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        passed, final, turn = self._choice(batch)
        pose, placed, goal = batch["achieved_goal"], batch["placed"], batch["desired_goal"]
        feasible, epsilon = batch["feasible"][:, 0], batch["epsilon"][:, 0]
        verdict = self.rules.judge_turn(turn, pose, placed, goal, (passed, final), feasible, epsilon)
        return verdict.reward[:, None], verdict.terminated[:, None]

    def _turns(self, batch: TensorDictBase, later: TensorDictBase) -> TensorDict:
        found = {
            "pose": batch["achieved_goal"],
            "goal": batch["desired_goal"],
            "epsilon": batch["epsilon"][:, 0],
            "turn": self.rules.turn_of(batch["previous_arm"][:, 0]),
            "action": batch["action"],
            "hindsight": batch["hindsight"][:, 0],
            "next": self._came_of(batch),
        }
        if self.to_next_turn:
            found["later"] = {"action": later["action"], **self._came_of(later)}
        return TensorDict(found, batch.batch_size, device=batch.device)

    def _came_of(self, row: TensorDictBase) -> dict[str, Tensor]:
        reward, terminated = self._judge(row)
        return {"pose": row["placed"], "reward": reward[:, 0], "terminated": terminated[:, 0]}

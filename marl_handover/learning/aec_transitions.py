"""From the steps of a turn-based environment to one agent's transitions, turn to turn.

TorchRL plays a PettingZoo AEC environment one agent's turn a step. Of such a roll-out, ``("next", agent, "observation")`` beside an agent's
action is what it would see in the middle of another agent's turn, and ``("next", agent, "reward")`` what it was given by then: mostly
nothing. What it learns from is its *own* next turn: the observation there, and all that it was given on the way.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

FLAGS = ("mask", "done", "terminated", "truncated")


class TransitionReader:
    """Reads one agent's transitions out of consecutive batches of steps of the same environments.

    A decision begins at a step in which it is the agent's turn (its ``mask``). It ends with the first step, that one included, after which
    it is its turn again, or after which it or the environment is done; its reward is the sum of what those steps gave it. A decision that
    is open at the end of a batch is carried over. One whose trajectory is cut off without an end (the collector's ``traj_ids`` change) has
    no next state and is dropped, and so are rewards from before an agent's first turn.

    The environment's ``rewards`` must be those of the last step, as PettingZoo asks.

    Args:
        agent: group of the agent in TorchRL's wrapper: its name, unless a ``group_map`` was given.
        index: which agent of its group.
    """

    def __init__(self, agent: str, index: int = 0) -> None:
        self.agent, self.index = agent, index
        self._open: TensorDict | None = None

    def read(self, rollout: TensorDictBase) -> TensorDict:
        """Transitions that end in this batch.

        Args:
            rollout: (..., time) steps as TorchRL's collectors and ``rollout`` give them, with ``use_mask=True``. Leading dimensions are
                environments, the same and in the same order at each call.

        Returns:
            (n,) transitions, those of an environment in their order in time, environment by environment. At the root ``observation``,
            ``action`` and what else the roll-out has of the agent, all as of its turn, and ``cell``, the environment's number in the flat
            order of the leading dimensions; under ``next`` ``observation``, ``info`` and so on as of the agent's next turn, or of the end,
            ``reward`` (n, 1), ``terminated``, ``truncated`` and ``done`` (n, 1).
        """
        steps = self._steps(rollout)
        time = torch.arange(steps.shape[1], device=steps.device).expand(steps.shape)
        over = steps["closes"] | steps["cut"]
        start = torch.where(steps["acts"], time, -1).cummax(1).values
        last_over = torch.where(over, time, -1).cummax(1).values
        before = torch.cat([torch.full_like(time[:, :1], -1), last_over[:, :-1]], 1)
        cell, end = (steps["closes"] & (start > before)).nonzero(as_tuple=True)
        begin = start[cell, end]
        earned = steps["reward"].double().cumsum(1)
        self._carry(steps, start[:, -1], last_over[:, -1], earned)
        result: TensorDict = steps["root"][cell, begin]
        following: TensorDict = steps["following"][cell, end]
        reward = earned[cell, end] - earned[cell, begin] + steps["reward"][cell, begin]
        following["reward"] = reward.to(torch.float32)[:, None]
        for flag in ("terminated", "truncated"):
            following[flag] = steps[flag][cell, end][:, None]
        following["done"] = following["terminated"] | following["truncated"]
        return result.update({"cell": cell, "next": following})

    def _steps(self, rollout: TensorDictBase) -> TensorDict:
        """What matters of each step, (environments, time), after what was carried over."""
        shape = rollout.shape
        flat = rollout.reshape(-1, shape[-1])
        root, following = (_of_agent(part, self.agent, self.index) for part in (flat, flat["next"]))
        ends = {}
        for flag in ("terminated", "truncated"):
            whole = flat["next"].get(flag, None)
            ends[flag] = following[flag][..., 0] | (False if whole is None else whole[..., 0])
        done = following["done"][..., 0] | flat["next", "done"][..., 0]
        again = following["mask"]
        steps = TensorDict(
            {
                "root": root.exclude(*FLAGS, "reward"),
                "following": following.exclude(*FLAGS, "reward"),
                "acts": root["mask"],
                "closes": again | done,
                "cut": torch.zeros_like(done),
                "reward": following["reward"][..., 0],
                **ends,
            },
            flat.shape,
        )
        trajectory = flat.get(("collector", "traj_ids"), None)
        if trajectory is not None:
            steps["trajectory"] = trajectory
        if self._open is not None:
            steps = torch.cat([self._open, steps], 1)
        if trajectory is not None:
            known = steps["trajectory"]
            steps["cut"][:, :-1] = (known[:, 1:] != known[:, :-1]) & ~steps["closes"][:, :-1]
        return steps

    def _carry(self, steps: TensorDict, start: Tensor, over: Tensor, earned: Tensor) -> None:
        """Keep each environment's open decision as one step that goes before the next batch."""
        cells = torch.arange(len(start), device=start.device)
        begin = start.clamp_min(0)
        kept = steps[cells, begin].clone()
        kept["acts"] = start > over
        kept["closes"] = torch.zeros_like(kept["acts"])
        kept["reward"] = (earned[:, -1] - earned[cells, begin]).to(torch.float32) + steps["reward"][cells, begin]
        if kept.get("trajectory", None) is not None:
            kept["trajectory"] = steps["trajectory"][:, -1].clone()
        self._open = kept[:, None]


def _of_agent(steps: TensorDictBase, agent: str, index: int) -> TensorDict:
    """One agent's part of steps, without the dimension of its group."""
    part: TensorDict = steps[agent][..., index]
    return part

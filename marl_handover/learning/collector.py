"""Where training's transitions come from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_handover.cell.batch import LayoutPool, random_layouts
from marl_handover.config import LayoutConfig
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.replay import EpisodeWriter
from marl_handover.progress import working
from marl_handover.task.rules import Outcome

Explore = Callable[[Tensor], Tensor]
"""Observations (n, size) -> actions (n, width)."""


class Collected(NamedTuple):
    """What one call brought.

    ``steps``: transfers that were commanded. ``rows``: the decisions of the episodes that ended, contiguous, as
    :class:`EpisodeWriter` hands them over, or None. ``transition``: one step of all cells, for learners without a memory.
    ``ended``: float (3,), the number of episodes that ended, of those that were solved, and the transfers they took.
    """

    steps: int
    rows: TensorDict | None
    transition: TensorDictBase | None
    ended: Tensor


class Collector(ABC):
    """A source of transitions that a checkpoint can hold."""

    @abstractmethod
    def collect(self, explore: Explore) -> Collected:
        """Let ``explore`` act for a while."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Plain tensors and numbers from which it goes on exactly, or as exactly as its environment allows."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""

    def close(self) -> None:  # noqa: B027 - most have none
        """Let go of processes, if it has any."""


class LayoutStream:
    """Random cells that are drawn anew in the course of training.

    Args:
        pool: takes the layouts, from the first ones on.
        kinds: of layouts.
        interval: environment steps after which as many new ones take the place of those that are drawn from.
        generator: of layouts.
    """

    def __init__(self, pool: LayoutPool, kinds: Sequence[LayoutConfig], interval: int, generator: np.random.Generator) -> None:
        self.pool, self.kinds, self.interval, self.generator = pool, kinds, interval, generator
        self.at_once, self.since = len(pool), 0

    def follow(self, steps: int) -> None:
        """So many environment steps are about to be made."""
        if self.since >= self.interval:
            self.since = 0
            with working("drawing new cells"):
                self.pool.extend(random_layouts(self.kinds, self.at_once, self.generator))
        self.since += steps

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors, numbers and text."""
        layouts = [[torch.from_numpy(arms), torch.from_numpy(discs)] for arms, discs in self.pool.layouts]
        return {"layouts": layouts, "since": self.since, "random": dict(self.generator.bit_generator.state)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`, for a pool that still has its first layouts only."""
        self.pool.extend([(arms.numpy(), discs.numpy()) for arms, discs in state["layouts"][len(self.pool) :]])
        self.since = state["since"]
        self.generator.bit_generator.state = state["random"]


class BatchedCollector(Collector):
    """One step of every cell of a batched environment.

    Args:
        env: the cells.
        keep_episodes: hand over whole episodes, for a replay memory.
        max_decisions: of an episode; the task's transfers if None.
        layouts: where new cells come from, for an environment that draws them.
    """

    def __init__(
        self, env: SupervisorEnv, keep_episodes: bool = True, max_decisions: int | None = None, layouts: LayoutStream | None = None
    ) -> None:
        self.env, self.keep_episodes, self.layouts = env, keep_episodes, layouts
        self.writer = EpisodeWriter(env.batch_size[0], max_decisions or env.rules.config.max_steps, env.device)
        self.current: TensorDictBase | None = None

    def collect(self, explore: Explore) -> Collected:
        """One step of all cells."""
        if self.layouts is not None:
            self.layouts.follow(self.env.batch_size[0])
        if self.current is None:
            self.current = self.env.reset()
        self.current["action"] = explore(self.current["observation"])
        transition, self.current = self.env.step_and_maybe_reset(self.current)
        following = transition["next"]
        done = following["done"]
        solved = (following["outcome"] == int(Outcome.SUCCESS)) & done
        ended = torch.stack([done.sum(), solved.sum(), following["transfers"][done].sum()]).cpu()
        executed = following.get("executed", None)
        steps = self.env.batch_size[0] if executed is None else int(executed.sum())
        return Collected(steps, self.writer.add(transition) if self.keep_episodes else None, transition, ended.float())

    def state_dict(self) -> dict[str, Any]:
        """The running episodes, and the random state of problems and noise."""
        current = None if self.current is None else self.current.to_dict()
        state = {"writer": self.writer.state_dict(), "current": current, "random": self.env.generator.get_state()}
        return state if self.layouts is None else {**state, "layouts": self.layouts.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        if self.layouts is not None:
            self.layouts.load_state_dict(state["layouts"])
        self.writer.load_state_dict(state["writer"])
        if state["current"] is not None:
            self.current = TensorDict(state["current"], self.env.batch_size, device=self.env.device)
        self.env.generator.set_state(state["random"].cpu())


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

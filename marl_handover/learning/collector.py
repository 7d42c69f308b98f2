"""Where training's transitions come from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.learning.replay import EpisodeWriter
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


class BatchedCollector(Collector):
    """One step of every cell of a batched environment.

    Args:
        env: the cells.
        keep_episodes: hand over whole episodes, for a replay memory.
        max_decisions: of an episode; the task's transfers if None.
    """

    def __init__(self, env: SupervisorEnv, keep_episodes: bool = True, max_decisions: int | None = None) -> None:
        self.env, self.keep_episodes = env, keep_episodes
        self.writer = EpisodeWriter(env.batch_size[0], max_decisions or env.rules.config.max_steps, env.device)
        self.current: TensorDictBase | None = None

    def collect(self, explore: Explore) -> Collected:
        """One step of all cells."""
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
        return {"writer": self.writer.state_dict(), "current": current, "random": self.env.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self.writer.load_state_dict(state["writer"])
        if state["current"] is not None:
            self.current = TensorDict(state["current"], self.env.batch_size, device=self.env.device)
        self.env.generator.set_state(state["random"].cpu())

"""The AEC environment with vectors for observations and actions, and what TorchRL needs to play it at speed."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from gymnasium.spaces import Dict as DictSpace
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils.wrappers import BaseWrapper
from torchrl.envs.libs.pettingzoo import PettingZooWrapper

from marl_handover.envs.cycle_check import FAILURES
from marl_handover.envs.spaces import SUPERVISOR
from marl_handover.task.actions import choices_of

Vector = NDArray[np.float32]


class FlatAEC(BaseWrapper):
    """One vector for each observation and action, fields in the order of the space; the supervisor's action is the rule book's.

    The supervisor acts with what :meth:`Rules.decode` reads, in [-1, 1]: of a pair (4,), final, arm, alpha, beta. ``infos`` of
    the supervisor are numbers, there from the reset on, so that TorchRL's wrapper hands them on: ``transfers`` so far, and of the last
    command ``placed`` (3,), the pose it left, before architecture A's external transfer, ``feasible``, 0 where the arm refused or the
    command was ignored because the episode was solved at its start, and ``ignored``, 1 in the latter case. Infos of arms are left out.

    Args:
        env: the environment, wrapped or not.
    """

    def __init__(self, env: AECEnv) -> None:
        super().__init__(env)
        self.fields = {agent: fields_of(env.observation_space(agent)) for agent in env.possible_agents}
        self._acts = {agent: fields_of(env.action_space(agent)) for agent in env.possible_agents}
        self._observed = {agent: _vector_space(env.observation_space(agent)) for agent in env.possible_agents}
        self._acted = {agent: _vector_space(env.action_space(agent)) for agent in env.possible_agents}
        self._acted[SUPERVISOR] = Box(-1.0, 1.0, (env.unwrapped.rules.action_size,))
        self._commanded = False
        self.infos: dict[str, dict[str, Any]] = {}

    def observation_space(self, agent: str) -> Box:
        """A box with the bounds of the fields."""
        return self._observed[agent]

    def action_space(self, agent: str) -> Box:
        """A box with the bounds of the fields."""
        return self._acted[agent]

    def observe(self, agent: str) -> Vector:
        """What ``agent`` sees now."""
        return np.concatenate([np.reshape(value, -1) for value in self.env.observe(agent).values()], dtype=np.float32)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """As the environment; no command was given yet."""
        super().reset(seed, options)
        self._commanded = False
        self._tell(0, self._pose(), False)

    def step(self, action: Vector | None) -> None:
        """The turn of ``agent_selection``, with a vector."""
        agent = self.env.agent_selection
        if action is None:
            self.env.step(None)
            self.infos = {living: self.infos[living] for living in self.env.agents}
        elif agent == SUPERVISOR:
            self.env.step(choices_of(np.asarray(action, np.float32), self.env.unwrapped.rules.cell.num_arms))
            self._commanded = True
            if self.env.agent_selection == SUPERVISOR:  # refused at once: no arm was asked
                self._tell(self.infos[SUPERVISOR]["transfers"] + 1, self._pose(), False)
                self._commanded = False
        else:
            external = self.env.unwrapped.rules.external_finish and bool(self.env.observe(agent)["final"])
            before = self._pose()
            self.env.step({name: np.reshape(action[part], shape) for name, (part, shape) in self._acts[agent].items()})
            self._learn_what_came(agent, before, external)

    def _learn_what_came(self, arm: str, before: Vector, external: bool) -> None:
        """Note the result of a command; of architecture A's external transfer only that there was one."""
        made = self.infos[SUPERVISOR]["transfers"] + 1
        if self._commanded and external:
            self._tell(made, before, False, ignored=True)
        elif self._commanded:
            refusal = self.env.infos[arm]["refusal"]
            self._tell(made, self._pose(), refusal is None or refusal in FAILURES)
        else:
            self.infos[SUPERVISOR]["transfers"] = made
        self._commanded = False

    def _tell(self, transfers: int, placed: Vector, feasible: bool, ignored: bool = False) -> None:
        self.infos = {agent: {} for agent in self.env.possible_agents}
        self.infos[SUPERVISOR] = {"transfers": transfers, "placed": placed, "feasible": float(feasible), "ignored": float(ignored)}

    def _pose(self) -> Vector:
        pose: Vector = self.env.observe(SUPERVISOR)["state"]
        return pose


class FlatHandover(PettingZooWrapper):
    """TorchRL's view of :class:`FlatAEC`: TorchRL's own wrapper, but for three detours, which cost a third of its time.

    It looks up attributes of the environment through ``dir()``, copies observations deeply to take action masks out of them, of which there
    are none here, and warns of versions of PettingZoo it was not tested with.

    Args:
        env: the environment.
        seed: of its problems and of what its backend draws.
    """

    def __init__(self, env: FlatAEC, seed: int) -> None:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested")
            super().__init__(env, use_mask=True)
        self.set_seed(seed)

    @property
    def agent_selection(self) -> str:
        """Whose turn it is."""
        return str(self._env.agent_selection)

    @property
    def possible_agents(self) -> list[str]:
        """All agents."""
        return list(self._env.possible_agents)

    def _update_action_mask(self, td: Any, observation_dict: Any, info_dict: Any) -> tuple[Any, Any]:
        return observation_dict, info_dict


def fields_of(space: DictSpace) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Where each field of a space stands in its vector, and its shape."""
    fields, start = {}, 0
    for name, part in space.items():
        shape = tuple(part.shape or ())
        size = math.prod(shape)
        fields[name] = (slice(start, start + size), shape)
        start += size
    return fields


def _vector_space(space: DictSpace) -> Box:
    low, high = zip(*(_bounds(part) for part in space.values()), strict=True)
    return Box(np.concatenate(low, dtype=np.float32), np.concatenate(high, dtype=np.float32))


def _bounds(part: Space) -> tuple[NDArray[Any], NDArray[Any]]:
    """The least and greatest numbers of one field, flat."""
    if isinstance(part, Box):
        return part.low.reshape(-1), part.high.reshape(-1)
    if isinstance(part, Discrete):
        return np.array([part.start]), np.array([part.start + part.n - 1])
    size = math.prod(part.shape or ())  # as many bits
    return np.zeros(size), np.ones(size)

"""Who plays the AEC environment while the supervisor learns: its exploration, and an executor for each arm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from marl_handover.cell import CellModel, build_cell
from marl_handover.config import MotionConfig
from marl_handover.envs import handover_aec
from marl_handover.envs.flat_aec import FlatAEC, FlatHandover, fields_of
from marl_handover.envs.spaces import SUPERVISOR, Spaces
from marl_handover.learning.algorithm import Algorithm
from marl_handover.learning.experience import Explore
from marl_handover.learning.settings import TrainConfig
from marl_handover.learning.variants import make_variant
from marl_handover.motion.executor import ARM_AGENTS, ExecutorAgent
from marl_handover.task.observations import observe
from marl_handover.task.rules import Rules

MODES = ("blind", "explore")
"""Methods of an algorithm that training lets act."""


def make_env(config: TrainConfig, seed: int, model: CellModel | None = None) -> FlatHandover:
    """The environment that a run asks for, as TorchRL plays it; ``seed`` decides its problems and its backend's noise."""
    env = handover_aec.env(backend=config.backend, cell=model or build_cell(config.cell), task=config.task)
    return FlatHandover(FlatAEC(env), seed)


def supervisor_fields(observation: NDArray[np.float32], fields: Mapping[str, tuple[slice, Any]]) -> tuple[Any, Any, Any]:
    """Pose (..., 3), goal (..., 3) and previous arm int (...), -1 for none, of flat observations (..., size) of the supervisor."""
    previous = observation[..., fields["previous_arm"][0]][..., 0]
    return observation[..., fields["state"][0]], observation[..., fields["goal"][0]], previous - 1


class AecPolicy(TensorDictModuleBase):
    """Actions of whichever agent's turn it is, in one environment (no batch dimension).

    Each episode's epsilon is drawn log-uniformly from ``epsilon_range_rad`` and shown to the supervisor. The environment does not know it
    and judges at the task's; replay judges again, at the epsilon it draws. In architecture B an episode's course does not depend on it.

    Exploration may treat the cells of a batch differently, so that some follow the deterministic policy for whole episodes. Each episode
    therefore takes the place of a cell in a batch of ``num_envs``: of the one that has decided least so far, for in a batch all decide
    equally often, be their episodes long or short.

    Args:
        rules: rule book that observations are made by.
        model: the cell, for the executors.
        config: the run.
        explore: the supervisor's actions.
        seed: of the epsilons.
    """

    def __init__(self, rules: Rules, model: CellModel, config: TrainConfig, explore: Explore, seed: int) -> None:
        super().__init__()
        motion = MotionConfig()
        spaces = Spaces(model, motion)
        self.in_keys = [(agent, key) for agent in (SUPERVISOR, *ARM_AGENTS) for key in ("mask", "observation")] + [(SUPERVISOR, "info")]
        self.out_keys = [(SUPERVISOR, "action"), (SUPERVISOR, "epsilon"), *((arm, "action") for arm in ARM_AGENTS)]
        self.rules, self.explore = rules, explore
        self.device_of_learner = torch.device(config.device)
        self.epsilon_range_rad = (rules.epsilon_rad, rules.epsilon_rad)
        self._fields = {agent: fields_of(space) for agent, space in spaces.observation.items()}
        self._arms = {agent: ExecutorAgent(agent, model, config.executor, motion) for agent in ARM_AGENTS}
        self._random = np.random.default_rng(seed)
        self._played = np.zeros(config.num_envs, int)
        self._cell, self._epsilon = 0, rules.epsilon_rad
        self._idle = {key: torch.zeros(1, 4 if key[0] == SUPERVISOR else _width(spaces.action[key[0]])) for key in self.out_keys}
        self._idle[SUPERVISOR, "epsilon"] = torch.zeros(1, 1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the actions of all agents, zeros for those whose turn it is not, and the ``epsilon`` the supervisor acted for."""
        actions = dict(self._idle)
        if tensordict[SUPERVISOR, "mask"]:
            actions[SUPERVISOR, "action"] = self._command(tensordict[SUPERVISOR])
            actions[SUPERVISOR, "epsilon"] = torch.full((1, 1), self._epsilon)
        for agent in ARM_AGENTS:
            if tensordict[agent, "mask"]:
                actions[agent, "action"] = self._answer(agent, tensordict[agent, "observation"])
        for key, value in actions.items():
            tensordict.set(key, value)
        return tensordict

    def _command(self, seen: TensorDictBase) -> Tensor:
        if not seen["info", "transfers"]:
            self._begin()
        self._played[self._cell] += 1
        pose, goal, previous = supervisor_fields(seen["observation"].numpy(), self._fields[SUPERVISOR])
        observation = observe(self.rules, self.rules.config.layout, pose, goal, previous, np.array([self._epsilon]))
        rows = torch.from_numpy(observation.astype(np.float32)).to(self.device_of_learner).expand(len(self._played), -1)
        return self.explore(rows)[self._cell, None].cpu()

    def _begin(self) -> None:
        """An episode."""
        self._cell = int(self._played.argmin())
        low, high = self.epsilon_range_rad
        self._epsilon = math.exp(self._random.uniform(math.log(low), math.log(high)))

    def _answer(self, agent: str, observation: Tensor) -> Tensor:
        numbers = observation[0].numpy()
        action = self._arms[agent].act({name: numbers[part] for name, (part, _) in self._fields[agent].items()})
        return torch.from_numpy(np.concatenate([np.reshape(value, -1) for value in action.values()], dtype=np.float32))[None]


class WorkerPolicy(AecPolicy):
    """The same in another process, with a learner of its own that is told the trained one's weights and no more.

    Its two parameters are what TorchRL keeps the same as the trainer's (:func:`message`).

    Args:
        config: the run.
        seed: of exploration, and of the epsilons.
    """

    def __init__(self, config: TrainConfig, seed: int) -> None:
        config.device, config.compile = "cpu", "off"
        torch.set_num_threads(config.threads)
        variant = make_variant(config.variant)
        rules = variant.env(config, torch.device("cpu")).rules
        self._learner = variant.algorithm(rules, config, torch.Generator().manual_seed(seed))
        super().__init__(rules, build_cell(config.cell), config, self._learner.blind, seed)
        told = message(self._learner.blind, self.epsilon_range_rad)
        self.weights = nn.Parameter(told["weights"], requires_grad=False)
        self.orders = nn.Parameter(told["orders"], requires_grad=False)
        self._obeyed = torch.empty(0)

    def _command(self, seen: TensorDictBase) -> Tensor:
        if not torch.equal(self._obeyed, self.weights):
            self._obeyed = self.weights.detach().clone()
            nn.utils.vector_to_parameters(self._obeyed, self._learner.actor().parameters())
        mode, *bounds = self.orders.tolist()
        self.explore = getattr(self._learner, MODES[int(mode)])
        self.epsilon_range_rad = (bounds[0], bounds[1])
        return super()._command(seen)


def message(explore: Explore, epsilon_range_rad: tuple[float, float]) -> dict[str, Tensor]:
    """What workers are told: ``weights`` of the learner's actor, and ``orders``: number of the method in :data:`MODES`, epsilon's range.

    Raises:
        TypeError: ``explore`` is none of these methods; other functions stay in the process they are in.
    """
    learner, name = getattr(explore, "__self__", None), getattr(explore, "__name__", "")
    if not isinstance(learner, Algorithm) or name not in MODES:
        raise TypeError(f"workers explore by an algorithm's {' or '.join(MODES)}, not by {explore!r}")
    weights = nn.utils.parameters_to_vector(learner.actor().parameters()).detach().cpu().clone()
    return {"weights": weights, "orders": torch.tensor([MODES.index(name), *epsilon_range_rad])}


def _width(space: Any) -> int:
    return sum(part.stop - part.start for part, _ in fields_of(space).values())

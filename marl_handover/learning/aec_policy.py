"""Who plays the AEC environment while the supervisor learns: its exploration, and an executor for each arm."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import SerialEnv

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

ACTIONS = 4
"""Numbers in the supervisor's action."""

MODES = ("blind", "explore")
"""Methods of an algorithm that training lets act."""


def make_env(config: TrainConfig, seeds: Sequence[int], model: CellModel | None = None) -> SerialEnv:
    """Environments (n,) that a run asks for, as TorchRL plays them; ``seeds`` (n) decide their problems and their backends' noise."""
    model = model or build_cell(config.cell)

    def one(seed: int) -> FlatHandover:
        return FlatHandover(FlatAEC(handover_aec.env(backend=config.backend, cell=model, task=config.task)), seed)

    return SerialEnv(len(seeds), [partial(one, seed) for seed in seeds])


def supervisor_fields(observation: Any, fields: Mapping[str, tuple[slice, Any]]) -> tuple[Any, Any, Any]:
    """Pose (..., 3), goal (..., 3) and previous arm (...), -1 for none, of flat observations (..., size) of the supervisor."""
    previous = observation[..., fields["previous_arm"][0]][..., 0]
    return observation[..., fields["state"][0]], observation[..., fields["goal"][0]], previous - 1


class AecPolicy(TensorDictModuleBase):
    """Actions of whichever agent's turn it is, in a batch of environments (n,).

    Each episode's epsilon is drawn log-uniformly from ``epsilon_range_rad`` and shown to the supervisor. The environment does not know it
    and judges at the task's; replay judges again, at the epsilon it draws. In architecture B an episode's course does not depend on it.

    Exploration is always asked for all environments at once, each in its own row, because some algorithms treat rows differently.

    Args:
        rules: rule book that observations are made by.
        model: the cell, for the executors.
        config: the run.
        count: number of environments, n.
        explore: the supervisor's actions.
        seed: of the epsilons.
    """

    def __init__(self, rules: Rules, model: CellModel, config: TrainConfig, count: int, explore: Explore, seed: int) -> None:
        super().__init__()
        motion = MotionConfig()
        spaces = Spaces(model, motion)
        self.in_keys = [(agent, key) for agent in (SUPERVISOR, *ARM_AGENTS) for key in ("mask", "observation")] + [(SUPERVISOR, "info")]
        self.out_keys = [(SUPERVISOR, "action"), (SUPERVISOR, "epsilon"), *((arm, "action") for arm in ARM_AGENTS)]
        self.rules, self.explore = rules, explore
        self.device_of_learner = torch.device(config.device)
        self.epsilon_range_rad = (rules.epsilon_rad, rules.epsilon_rad)
        self._fields = {agent: fields_of(space) for agent, space in spaces.observation.items()}
        self._widths = {agent: width(space) for agent, space in spaces.action.items()}
        self._arms = {agent: ExecutorAgent(agent, model, config.executor, motion) for agent in ARM_AGENTS}
        self._random = np.random.default_rng(seed)
        self._epsilon = np.full(count, rules.epsilon_rad)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets the actions of all agents, zeros for those whose turn it is not, and the ``epsilon`` the supervisor acts for."""
        turn = tensordict[SUPERVISOR, "mask"]
        action = torch.zeros(len(turn), 1, ACTIONS)
        if turn.any():
            action[turn] = self._commands(tensordict[SUPERVISOR], turn[:, 0].numpy())[turn[:, 0]]
        tensordict.set((SUPERVISOR, "action"), action)
        tensordict.set((SUPERVISOR, "epsilon"), torch.from_numpy(self._epsilon.astype(np.float32))[:, None, None])
        for agent in ARM_AGENTS:
            answers = torch.zeros(len(turn), 1, self._widths[agent])
            for row in tensordict[agent, "mask"][:, 0].nonzero()[:, 0].tolist():
                answers[row, 0] = self._answer(agent, tensordict[agent, "observation"][row, 0])
            tensordict.set((agent, "action"), answers)
        return tensordict

    def _commands(self, seen: TensorDictBase, turn: NDArray[np.bool_]) -> Tensor:
        """Actions (n, 4); ``turn`` (n,) says whose are wanted."""
        begins = turn & (seen["info", "transfers"][:, 0].numpy() == 0)
        low, high = self.epsilon_range_rad
        self._epsilon[begins] = np.exp(self._random.uniform(math.log(low), math.log(high), begins.sum()))
        pose, goal, previous = supervisor_fields(seen["observation"][:, 0].numpy(), self._fields[SUPERVISOR])
        observation = observe(self.rules, self.rules.config.layout, pose, goal, previous, self._epsilon)
        return self.explore(torch.from_numpy(observation.astype(np.float32)).to(self.device_of_learner)).cpu()

    def _answer(self, agent: str, observation: Tensor) -> Tensor:
        numbers = observation.numpy()
        action = self._arms[agent].act({name: numbers[part] for name, (part, _) in self._fields[agent].items()})
        return torch.from_numpy(np.concatenate([np.reshape(value, -1) for value in action.values()], dtype=np.float32))


class WorkerPolicy(AecPolicy):
    """The same in another process, with a learner of its own that is told the trained one's weights, how far training is, and no more.

    Its two parameters are what TorchRL keeps the same as the trainer's (:func:`message`).

    Args:
        config: the run.
        count: number of environments.
        seed: of exploration, and of the epsilons.
    """

    def __init__(self, config: TrainConfig, count: int, seed: int) -> None:
        config.device, config.compile = "cpu", "off"
        torch.set_num_threads(config.threads)
        variant = make_variant(config.variant)
        rules = variant.env(config, torch.device("cpu")).rules
        self._learner = variant.algorithm(rules, config, torch.Generator().manual_seed(seed))
        super().__init__(rules, build_cell(config.cell), config, count, self._learner.blind, seed)
        told = message(self._learner.blind, self.epsilon_range_rad)
        self.weights = nn.Parameter(told["weights"], requires_grad=False)
        self.orders = nn.Parameter(told["orders"], requires_grad=False)
        self._obeyed = torch.empty(0)

    def _commands(self, seen: TensorDictBase, turn: NDArray[np.bool_]) -> Tensor:
        if not torch.equal(self._obeyed, self.weights):
            self._obeyed = self.weights.detach().clone()
            nn.utils.vector_to_parameters(self._obeyed, self._learner.actor().parameters())
        mode, progress, *bounds = self.orders.tolist()
        if progress != self._learner.progress:
            self._learner.schedule(progress)
        self.explore = getattr(self._learner, MODES[int(mode)])
        self.epsilon_range_rad = (bounds[0], bounds[1])
        return super()._commands(seen, turn)


def message(explore: Explore, epsilon_range_rad: tuple[float, float]) -> dict[str, Tensor]:
    """What workers are told: ``weights`` of the learner's actor, and ``orders``: number of the method in :data:`MODES`, how much of the
    training is done, and epsilon's range.

    Raises:
        TypeError: ``explore`` is none of these methods; other functions stay in the process they are in.
    """
    learner, name = getattr(explore, "__self__", None), getattr(explore, "__name__", "")
    if not isinstance(learner, Algorithm) or name not in MODES:
        raise TypeError(f"workers explore by an algorithm's {' or '.join(MODES)}, not by {explore!r}")
    weights = nn.utils.parameters_to_vector(learner.actor().parameters()).detach().cpu().clone()
    return {"weights": weights, "orders": torch.tensor([MODES.index(name), learner.progress, *epsilon_range_rad])}


def width(space: Any) -> int:
    """Length of a space's vector."""
    return sum(part.stop - part.start for part, _ in fields_of(space).values())

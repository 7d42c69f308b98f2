"""Cells without a supervisor: the arms take turns, and the one whose turn it is passes, places or finishes.

An action is three numbers: the choice, then the place (alpha, beta) in the arm's *own* frame, where beta is mirrored as the arm is. After
any decision it is the other arm's turn. A pass leaves the object where it is. The rest is the rule book's.

What an arm sees is its own block of the ``relative`` layout: object and goal in its own frame, and what follows from them and from where
the two bases stand, a constant that every arm knows: also whether the other one reaches them, and what error it would leave. These are the
fields that the supervisor's networks see of this arm, so a comparison is about who decides and not about features. An arm does not see the
other one's joints, choices or networks; nor who moved last (the two fields that say so are 0), nor that the other has just passed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Unbounded

from marl_handover.arrays import Array, namespace, one_where
from marl_handover.cell import NO_ARM, Cell, load_cell
from marl_handover.config import DecentralisedConfig, TaskConfig
from marl_handover.envs.supervisor_env import SupervisorEnv
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.task.observations import ARM_FIELDS
from marl_handover.task.rules import Command, Outcome, Rules, Verdict, straight_line_mm

CHOICE_EDGE = 1 / 3
"""A choice above it means finish, below its negative pass, between them place: uniform choices take each as often."""


class Turn(NamedTuple):
    """Result of one arm's decision: ``placed`` (..., 3), and bool, float, bool, int (...)."""

    placed: Array
    feasible: Array
    reward: Array
    terminated: Array
    outcome: Array


class TurnRules(Rules):
    """The rule book, with a skin for arms that take turns. All that is not said here is as in :class:`Rules`.

    Args:
        cell: the cell.
        config: the task; of architecture B, where finishing is a decision.
        settings: what a pass earns, and how many decisions an episode may have.
        motion_cost: prices of motions.
    """

    action_size = 3

    def __init__(self, cell: Cell, config: TaskConfig, settings: DecentralisedConfig, motion_cost: Any = straight_line_mm) -> None:
        super().__init__(cell, config, motion_cost)
        settings.validate_task(config)
        self.settings = settings
        self.max_decisions = settings.decisions_per_transfer * config.max_steps

    def turn_of(self, previous_arm: Array) -> Array:
        """Whose turn it is, int (...), after ``previous_arm`` decided or moved; L's if that was nobody."""
        return namespace(previous_arm).where(previous_arm == 0, 1, 0)

    def passes(self, action: Array) -> Array:
        """Whether actions (..., 3) are passes: bool (...)."""
        return action[..., 0] < -CHOICE_EDGE

    def supervisor_action(self, action: Array, turn: Array) -> Array:
        """What a supervisor would say, (..., 4), to have arm ``turn`` (...) do what its action (..., 3) says; nonsense for a pass."""
        xp = namespace(action)
        one = xp.ones_like(action[..., 0])
        final = xp.where(action[..., 0] > CHOICE_EDGE, one, -one)
        right = xp.where(turn == 1, one, -one)
        across, along = self.view_signs(turn, one)
        return xp.stack([final, right, action[..., 1] * across, action[..., 2] * along], -1)

    def view_signs(self, turn: Array, like: Array) -> tuple[Array, Array]:
        """Signs of alpha and beta in the view of arm ``turn`` (...), each in the kind of ``like`` (...)."""
        xp, (left, right) = namespace(like), self.cell.views
        across, along = (xp.where(turn == 1, right[axis] * xp.ones_like(like), left[axis] * xp.ones_like(like)) for axis in range(2))
        return across, along

    def command(self, action: Array, turn: Array) -> Command:
        """The command of a decision; for a pass, one that must not be carried out."""
        return self.decode(self.supervisor_action(action, turn))

    def judge_turn(
        self, turn: Array, pose: Array, placed: Array, goal: Array, choice: tuple[Array, Array], feasible: Array, epsilon_rad: Array | None
    ) -> Verdict:
        """As :meth:`Rules.judge`, less the price of the motion, of a decision that left the object at ``placed``.

        ``choice`` are two bool (...): passed, and final.
        """
        xp, (passed, final) = namespace(placed), choice
        verdict = self.judge(placed, goal, final, feasible, epsilon_rad)
        earned = verdict.reward - self.motion_penalty(turn, pose, placed)
        waited = self.settings.pass_reward * xp.ones_like(earned)
        none = 0 * verdict.outcome + int(Outcome.NONE)
        return Verdict(xp.where(passed, waited, earned), verdict.terminated & ~passed, xp.where(passed, none, verdict.outcome))

    def take_turn(
        self, pose: Array, goal: Array, turn: Array, action: Array, epsilon_rad: Array | None = None, noise: Array | None = None
    ) -> Turn:
        """Apply the decisions (..., 3) of arms ``turn`` (...) to objects (..., 3). A pass is always feasible.

        Args:
            pose: (..., 3).
            goal: (..., 3).
            turn: int (...).
            action: choice, alpha, beta.
            epsilon_rad: (...); the setting's value if None.
            noise: (..., 3) offset of what is placed: mm, mm, rad.
        """
        passed, command = self.passes(action), self.command(action, turn)
        placed, able = self.transfer(pose, goal, command)
        if noise is not None:
            placed = self._displaced(placed, one_where(able, noise, 0 * noise))
        placed, feasible = one_where(passed, pose, placed), able | passed
        return Turn(placed, feasible, *self.judge_turn(turn, pose, placed, goal, (passed, command.final), feasible, epsilon_rad))


VIEW_SIZE = len(ARM_FIELDS) + 2


def own_view(relative: Tensor, turn: Tensor, waited: Tensor) -> Tensor:
    """What arm ``turn`` (n,) sees, (n, VIEW_SIZE), of ``relative`` observations (n, 2 fields): its block, and two numbers for no network.

    Whose it is, -1 for L and 1 for R; and 1 where the other arm has just ``waited`` (n,), which only exploration minds.
    """
    blocks = relative.unflatten(-1, (-1, len(ARM_FIELDS)))
    own = one_where(turn == 1, blocks[..., 1, :], blocks[..., 0, :])
    side = torch.where(turn == 1, 1.0, -1.0)
    return torch.cat([own, torch.stack([side, waited.float()], -1).to(own.dtype)], -1)


class DecentralisedEnv(SupervisorEnv):
    """A batch of cells in which two arms take turns, a random one first.

    As :class:`SupervisorEnv`, but ``observation`` is :func:`own_view` of the arm whose turn it is, ``action`` is that arm's, and
    ``previous_arm`` is the arm that decided last, so that the turn is the other one's. Besides, there are ``decisions`` so far and, under
    ``next``, ``executed``: whether the decision was a transfer. Too many decisions end an episode like too many transfers.

    Args:
        num_envs: number of cells.
        cell: the cell; the shipped ``paper`` cell if None.
        task: the task's settings; the defaults if None.
        device: device of all tensors.
        seed: seed of problems, first turns and noise.
        settings: of the variant; the defaults if None.
    """

    rules: TurnRules

    def __init__(
        self,
        num_envs: int = 1,
        cell: Cell | None = None,
        task: TaskConfig | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
        settings: DecentralisedConfig | None = None,
    ) -> None:
        cell, task = cell or load_cell(), task or TaskConfig()
        rules = TurnRules(cell, task, settings or DecentralisedConfig(), motion_cost(cell, task))
        super().__init__(num_envs, cell, task, device, seed, rules)

    def _make_specs(self) -> None:
        super()._make_specs()
        count, device = self.batch_size[0], self.device
        self.observation_spec["observation"] = Unbounded(shape=(count, VIEW_SIZE), device=device)
        self.observation_spec["decisions"] = Unbounded(shape=(count, 1), dtype=torch.int64, device=device)
        self.observation_spec["executed"] = Binary(shape=(count, 1), dtype=torch.bool, device=device)

    def view(self, pose: Tensor, goal: Tensor, turn: Tensor, epsilon_rad: Tensor, waited: Tensor) -> Tensor:
        """What arms ``turn`` (n,) see of objects at ``pose`` (n, 3), displaced by noise where the task has that."""
        return own_view(self.observe(pose, goal, torch.full_like(turn, NO_ARM), epsilon_rad), turn, waited)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        new = super()._reset(tensordict)
        shape = (self.batch_size[0], 1)
        new["previous_arm"] = torch.randint(0, self.rules.cell.num_arms, shape, generator=self.generator, device=self.device)
        new["decisions"] = torch.zeros(shape, dtype=torch.int64, device=self.device)
        new["executed"] = torch.ones(shape, dtype=torch.bool, device=self.device)
        epsilon = new["epsilon"][:, 0].clamp_min(torch.finfo(torch.float32).tiny)  # rows that are not reset hold zeros
        turn = self.rules.turn_of(new["previous_arm"][:, 0])
        new["observation"] = self.view(new["achieved_goal"], new["desired_goal"], turn, epsilon, torch.zeros_like(epsilon))
        return new

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        pose, goal, epsilon = tensordict["achieved_goal"], tensordict["desired_goal"], tensordict["epsilon"][:, 0]
        turn = self.rules.turn_of(tensordict["previous_arm"][:, 0])
        result = self.rules.take_turn(pose, goal, turn, tensordict["action"], epsilon, self._noise())
        executed = ~self.rules.passes(tensordict["action"])[:, None]
        transfers, decisions = tensordict["transfers"] + executed, tensordict["decisions"] + 1
        terminated = result.terminated[:, None]
        spent = (transfers >= self.rules.config.max_steps) | (decisions >= self.rules.max_decisions)
        truncated = spent & ~terminated
        return TensorDict(
            {
                "observation": self.view(result.placed, goal, 1 - turn, epsilon, ~executed[:, 0]),
                "achieved_goal": result.placed,
                "desired_goal": goal,
                "previous_arm": turn[:, None],
                "epsilon": tensordict["epsilon"],
                "transfers": transfers,
                "decisions": decisions,
                "executed": executed,
                "placed": result.placed,
                "feasible": result.feasible[:, None],
                "outcome": torch.where(truncated, int(Outcome.TIMEOUT), result.outcome[:, None]),
                "reward": result.reward[:, None],
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            self.batch_size,
            device=self.device,
        )

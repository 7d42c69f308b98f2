"""Thousands of cells at once: the supervisor's problem as a batch-locked TorchRL environment."""

from __future__ import annotations

import math

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from marl_handover.cell import Cell, load_cell
from marl_handover.cell.batch import CellBatch, LayoutPool
from marl_handover.config import TaskConfig, require_at_least, require_positive
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.task.episode import advance
from marl_handover.task.ladder import RungSource
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules, carried


class SupervisorEnv(EnvBase):
    """A batch of independent cells under one rule book.

    Besides ``observation`` (the named layout), the tensordict carries the problem itself, so that hindsight can relabel it:
    ``achieved_goal`` and ``desired_goal`` (num_envs, 3) in mm, mm, rad, ``previous_arm`` (-1 none, 0 L, 1 R), ``epsilon`` in
    rad, ``transfers`` so far; and under ``next``: ``placed`` (the pose after the commanded transfer), ``feasible``,
    ``outcome``.

    Args:
        num_envs: number of cells.
        cell: the cell; the shipped ``paper`` cell if None.
        task: the task's settings; the defaults if None.
        device: device of all tensors.
        seed: seed of problems and noise.
        rules: another rule book than that of cell and task.
        layouts: draw each episode's cell from these, instead of one for all; the tensordict then carries its number, ``layout``.
            Layouts that are added to the pool later are drawn instead of as many of the first ones.
        problems: of a rung of the ladder, whose cell and task are to be given as well, instead of random ones. Cells that are reset get
            the next ones in order, and the tensordict carries the fewest transfers of each, ``optimum`` (num_envs, 1).
    """

    batch_locked = True

    def __init__(
        self,
        num_envs: int = 1,
        cell: Cell | None = None,
        task: TaskConfig | None = None,
        device: torch.device | str = "cpu",
        seed: int | None = None,
        rules: Rules | None = None,
        layouts: LayoutPool | None = None,
        problems: RungSource | None = None,
    ) -> None:
        require_at_least("num_envs", num_envs, 1)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        task = task or TaskConfig()
        self.layouts, self.drawn_layouts = layouts, 0 if layouts is None else len(layouts)
        if layouts is None:
            cell = cell or load_cell()
            self.rules = rules or Rules(cell, task, motion_cost(cell, task))
        else:
            self.rules = rules or Rules(CellBatch(layouts, np.zeros(num_envs, np.int64)), task)
        self.problems = problems
        # What the tensordict carries from an episode's start to its end.
        self._kept = [key for key, source in (("layout", layouts), ("optimum", problems)) if source is not None]
        self.generator = torch.Generator(device=self.device)
        self.epsilon_range_rad = (self.rules.epsilon_rad, self.rules.epsilon_rad)
        self._make_specs()
        self.set_seed(seed)

    def _make_specs(self) -> None:
        count, device = self.batch_size[0], self.device
        width = observation_size(self.rules.config.layout, self.rules.cell.num_arms)
        pose = Unbounded(shape=(count, 3), device=device)
        problem = {
            "observation": Unbounded(shape=(count, width), device=device),
            "achieved_goal": pose,
            "desired_goal": pose.clone(),
            "previous_arm": Bounded(-1, self.rules.cell.num_arms - 1, shape=(count, 1), dtype=torch.int64, device=device),
            "epsilon": Unbounded(shape=(count, 1), device=device),
            "transfers": Unbounded(shape=(count, 1), dtype=torch.int64, device=device),
            "placed": pose.clone(),
            "feasible": Binary(shape=(count, 1), dtype=torch.bool, device=device),
            "outcome": Bounded(0, max(Outcome), shape=(count, 1), dtype=torch.int64, device=device),
        }
        for key in self._kept:
            problem[key] = Unbounded(shape=(count, 1), dtype=torch.int64, device=device)
        self.observation_spec = Composite(problem, shape=self.batch_size, device=device)
        self.action_spec = Bounded(-1.0, 1.0, shape=(count, self.rules.action_size), device=device)
        self.reward_spec = Unbounded(shape=(count, 1), device=device)
        flag = Binary(shape=(count, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=self.batch_size, device=device)

    def __repr__(self) -> str:
        """What it is, and the settings that matter most."""
        config, cell = self.rules.config, "random" if self.layouts is not None else self.rules.cell.config.name
        low, high = (math.degrees(value) for value in self.epsilon_range_rad)
        return (
            f"SupervisorEnv(num_envs={self.batch_size[0]}, architecture={config.architecture!r}, cell={cell!r}, "
            f"epsilon_deg={f'{low:g}' if low == high else f'{low:g} to {high:g}'}, max_steps={config.max_steps}, "
            f"layout={config.layout!r}, device={str(self.device)!r})"
        )

    def set_epsilon_range(self, low_deg: float, high_deg: float) -> None:
        """Draw each new episode's epsilon log-uniformly from this range, in degrees."""
        require_positive("epsilon low", low_deg)
        require_at_least("epsilon high", high_deg, low_deg)
        self.epsilon_range_rad = (math.radians(low_deg), math.radians(high_deg))

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self.generator.seed()
        else:
            self.generator.manual_seed(seed)
        if self.problems is not None:
            self.problems.clear()

    def draw_epsilon(self, count: int) -> Tensor:
        """``count`` values of epsilon in rad, as new episodes get them."""
        low, high = self.epsilon_range_rad
        if low == high:
            return torch.full((count,), low, device=self.device)
        return torch.empty(count, device=self.device).uniform_(math.log(low), math.log(high), generator=self.generator).exp_()

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = None if mask is None else mask.reshape(-1).nonzero()[:, 0]
        # TorchRL takes only the rows that are reset. Where these are many, drawing for all cells costs less than putting some in place.
        everyone = rows is None or (len(rows) * 4 >= self.batch_size[0] and self.problems is None)
        fresh = self.batch_size[0] if everyone or rows is None else len(rows)
        rules, pose, goal, also = self._posed(fresh)
        epsilon = self.draw_epsilon(fresh)
        previous = torch.full((fresh,), -1, device=self.device)
        observation = self.observe(pose, goal, previous, epsilon, rules)
        zero = torch.zeros(fresh, 1, dtype=torch.int64, device=self.device)
        new = {
            "observation": observation,
            "achieved_goal": pose,
            "desired_goal": goal,
            "previous_arm": zero - 1,
            "epsilon": epsilon[:, None],
            "transfers": zero,
            "placed": pose.clone(),
            "feasible": torch.ones_like(zero, dtype=torch.bool),
            "outcome": zero,
            **also,
        }
        if rows is not None and not everyone:
            for key, value in new.items():
                new[key] = value.new_zeros(self.batch_size + value.shape[1:])
                new[key][rows] = value
        return TensorDict(new, self.batch_size, device=self.device)

    def _posed(self, count: int) -> tuple[Rules, Tensor, Tensor, dict[str, Tensor]]:
        """Rules of ``count`` new episodes, starts and goals (count, 3), and what the tensordict carries besides, each (count, 1)."""
        if self.problems is not None:
            posed = self.problems.take(count, self._draw_seed)
            pose, goal = (torch.as_tensor(poses, dtype=torch.float32, device=self.device) for poses in (posed.start, posed.goal))
            return self.rules, pose, goal, {"optimum": torch.as_tensor(posed.optimum, device=self.device)[:, None]}
        rules, also = self.rules, {}
        if self.layouts is not None:
            last = len(self.layouts)
            layout = torch.randint(last - self.drawn_layouts, last, (count,), generator=self.generator, device=self.device)
            rules, also = self.rules.on(CellBatch(self.layouts, layout.cpu().numpy())), {"layout": layout[:, None]}
        return rules, *sample_problems(rules.cell, count, self.generator, torch.float32), also

    def _draw_seed(self) -> int:
        return int(torch.randint(2**31 - 1, (), generator=self.generator, device=self.device))

    def _noise(self) -> Tensor | None:
        if not self.rules.noisy:
            return None
        noise = self.rules.config.noise
        return self._normal(self.batch_size[0], noise.position_mm, noise.yaw_deg)

    def _normal(self, count: int, position_mm: float, angle_deg: float) -> Tensor:
        """Offsets (count, 3) of poses."""
        scale = torch.tensor([position_mm, position_mm, math.radians(angle_deg)], device=self.device)
        return torch.randn(count, 3, generator=self.generator, device=self.device) * scale

    def rules_of(self, tensordict: TensorDictBase) -> Rules:
        """The rules of the cells that rows are in."""
        if self.layouts is None:
            return self.rules
        layout = tensordict["layout"][:, 0].cpu().numpy()
        if not np.array_equal(layout, self.rules.cell.layout):
            self.rules = self.rules.on(CellBatch(self.layouts, layout))
        return self.rules

    def observe(self, pose: Tensor, goal: Tensor, previous_arm: Tensor, epsilon_rad: Tensor, rules: Rules | None = None) -> Tensor:
        """What the supervisor sees of objects at ``pose`` (n, 3): displaced by noise, where the task has that."""
        noise = self.rules.config.noise
        if noise.observed:
            offset = self._normal(len(pose), noise.observed_mm, noise.observed_deg)
            pose = carried(pose, pose[:, :2] + offset[:, :2], offset[:, 2])
        return observe(rules or self.rules, self.rules.config.layout, pose, goal, previous_arm, epsilon_rad)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        pose, goal = tensordict["achieved_goal"], tensordict["desired_goal"]
        epsilon, made = tensordict["epsilon"][:, 0], tensordict["transfers"][:, 0]
        previous, action = tensordict["previous_arm"][:, 0], tensordict["action"]
        noise, final_noise, rules = self._noise(), self._noise(), self.rules_of(tensordict)
        stepped = advance(rules, pose, goal, previous, action, made, epsilon_rad=epsilon, noise=noise, final_noise=final_noise)
        result, terminated, truncated = stepped.result, stepped.result.terminated[:, None], stepped.truncated[:, None]
        observation = self.observe(result.pose, goal, result.previous_arm, epsilon, rules)
        kept = {key: tensordict[key] for key in self._kept}
        return TensorDict(
            kept
            | {
                "observation": observation,
                "achieved_goal": result.pose,
                "desired_goal": goal,
                "previous_arm": result.previous_arm[:, None],
                "epsilon": tensordict["epsilon"],
                "transfers": stepped.transfers[:, None],
                "placed": result.placed,
                "feasible": result.feasible[:, None],
                "outcome": stepped.outcome[:, None],
                "reward": result.reward[:, None],
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            self.batch_size,
            device=self.device,
        )

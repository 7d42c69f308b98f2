"""Many cells at once as one Gymnasium vector environment: ``gymnasium.make_vec(ID, num_envs=64)``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from marl_handover.cell import NO_ARM
from marl_handover.config import require_at_least, require_choice
from marl_handover.envs.goal_env import SupervisorGoalEnv, of_command
from marl_handover.errors import NotFinite
from marl_handover.task.episode import advance
from marl_handover.task.observations import observe
from marl_handover.task.problems import ProblemSource
from marl_handover.task.rules import Outcome

Observation = dict[str, NDArray[np.float32]]


class SupervisorVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """``num_envs`` cells under one rule book, all of them stepped in one call.

    Observations, actions, rewards and ``info`` are those of :class:`~marl_handover.envs.goal_env.SupervisorGoalEnv`, with a leading axis.
    As Gymnasium has it by default, the step after an episode's end begins the next one: its action is not looked at, its reward is 0.

    Args:
        num_envs: number of cells.
        max_episode_steps: what Gymnasium's registry knows of the step limit; the task's ``max_steps`` counts.
        settings: those of :class:`~marl_handover.envs.goal_env.SupervisorGoalEnv`.

    Raises:
        InvalidSetting, UnknownKey, UnknownChoice, GoalInObservation: as there.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as the base class has it
        "render_modes": ["rgb_array"],
        "render_fps": 2,
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, num_envs: int = 1, max_episode_steps: int | None = None, **settings: Any) -> None:
        require_at_least("num_envs", num_envs, 1)
        if settings.get("render_mode") is not None:
            require_choice("render_mode", settings["render_mode"], self.metadata["render_modes"])
        self.num_envs, self.single = num_envs, SupervisorGoalEnv(**settings)
        self.rules, self.render_mode = self.single.rules, self.single.render_mode
        self.single_observation_space, self.single_action_space = self.single.observation_space, self.single.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._problems = ProblemSource(self.rules.cell)
        self._pose, self._goal = np.zeros((num_envs, 3)), np.zeros((num_envs, 3))
        self._previous, self._transfers = np.full(num_envs, NO_ARM), np.zeros(num_envs, np.int64)
        self._over = np.ones(num_envs, bool)

    def __repr__(self) -> str:
        """What it is, how many, and the settings that matter most."""
        return f"SupervisorVectorEnv(num_envs={self.num_envs}, {repr(self.single).partition('(')[2]}"

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in every cell. ``options`` set the problem of all, as in one cell.

        Raises:
            UnknownKey, InvalidSetting, OutOfReach, NotFinite: for options, a state or a goal that cannot be.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._problems.clear()
        self._begin(np.ones(self.num_envs, bool), options)
        return self._observation(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One command in every cell, or a new episode where one is over; (num_envs,) of each.

        ``info`` has every key of one cell's as an array, and as Gymnasium has it ``_KEY`` (num_envs,): where there was a command.
        """
        numbers, begun = np.asarray(actions, np.float64), self._over
        if not np.isfinite(numbers).all():
            raise NotFinite("actions", list(numbers[~np.isfinite(numbers).all(-1)][0]))
        start, made, shape = self._pose, self._transfers, (self.num_envs,)
        noise, final_noise = (self._noise() for _ in range(2))
        stepped = advance(self.rules, start, self._goal, self._previous, numbers, made, noise=noise, final_noise=final_noise)
        result, acted = stepped.result, ~begun
        self._pose, self._previous, self._transfers = result.pose, result.previous_arm, stepped.transfers
        info = of_command(self.rules, stepped, start, made) | {
            "transfers": stepped.transfers,
            "outcome": np.array([Outcome(each).name.lower() for each in stepped.outcome], object),
            "is_success": stepped.outcome == int(Outcome.SUCCESS),
        }
        info = {key: np.broadcast_to(value, (*shape, *np.shape(value)[1:])).copy() for key, value in info.items()}
        info |= {f"_{key}": acted.copy() for key in tuple(info)}
        terminated, truncated = np.asarray(result.terminated & acted), np.asarray(stepped.truncated & acted)
        self._over = terminated | truncated
        self._begin(begun, None)
        return self._observation(), np.where(acted, result.reward, 0.0), terminated, truncated, info

    def compute_reward(self, achieved_goal: NDArray[np.float32], desired_goal: NDArray[np.float32], info: Any) -> Any:
        """As one cell has it; ``info`` may be that of :meth:`step`."""
        return self.single.compute_reward(achieved_goal, desired_goal, info)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each cell; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self.single.picture(*each) for each in zip(self._pose, self._goal, self._previous, strict=True))

    def _begin(self, rows: NDArray[np.bool_], options: Mapping[str, Any] | None) -> None:
        """New problems in some cells."""
        for row in np.nonzero(rows)[0]:
            self._pose[row], self._goal[row] = self._problems.next(self.np_random, options)
        self._previous[rows], self._transfers[rows], self._over[rows] = NO_ARM, 0, False

    def _observation(self) -> Observation:
        vector = observe(self.rules, self.rules.config.layout, self._pose, self._goal, self._previous)
        return self.single.shown(vector, self._pose, self._goal)

    def _noise(self) -> NDArray[np.float64] | None:
        if not self.rules.noisy:
            return None
        noise = self.rules.config.noise
        scale = np.array([noise.position_mm, noise.position_mm, math.radians(noise.yaw_deg)])
        return self.np_random.normal(size=(self.num_envs, 3)) * scale

"""The supervisor's problem as a Gymnasium goal environment: one cell, numpy, ready for any hindsight replay."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from marl_handover.cell import Cell, load_cell
from marl_handover.config import CellConfig, TaskConfig, require_choice
from marl_handover.envs.backends import TopView
from marl_handover.errors import InvalidSetting, NotFinite, UnknownKey
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.schema import closest_first
from marl_handover.task.episode import advance
from marl_handover.task.observations import observation_size, observe
from marl_handover.task.problems import ProblemSource
from marl_handover.task.rules import Outcome, Rules

Observation = dict[str, NDArray[np.float32]]


LAYOUT, RENDER_MODES = "object", ("rgb_array",)


class SupervisorGoalEnv(gymnasium.Env[Any, Any]):
    """One cell.

    ``observation`` is the layout ``object``, the one without the goal: a hindsight buffer swaps only ``desired_goal``, and would train
    on features of the old goal; ``achieved_goal`` and ``desired_goal`` are poses in mm, mm, rad. Actions are float32[4] =
    (final, arm, alpha, beta). ``info`` carries ``feasible``, ``final``, ``transfers``, ``outcome`` and ``is_success``.

    Args:
        architecture: ``"A"`` or ``"B"``; replaces the task's.
        cell: the cell, or what :func:`marl_handover.cell.load_cell` takes; the shipped ``paper`` cell if None.
        task: the task's settings; the defaults, with layout ``object``, if None.
        render_mode: ``"rgb_array"``: :meth:`render` draws the table from above.
        problems: where problems of the cell come from; random ones if None. Where their optimum is known, ``info`` carries it, as
            ``optimum``, and when the episode is over ``regret`` (:func:`marl_handover.task.problems.regret`).
        settings: single settings of the task, such as ``epsilon_deg=1.0``, put over ``task``.

    Raises:
        UnknownKey, InvalidSetting, UnknownChoice: for settings that cannot be, and for a layout that contains the goal.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 2}  # noqa: RUF012  # as the base class has it

    def __init__(
        self,
        architecture: str = "B",
        cell: Cell | CellConfig | str | None = None,
        task: TaskConfig | None = None,
        render_mode: str | None = None,
        problems: ProblemSource | None = None,
        **settings: Any,
    ) -> None:
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        task = _with(task or TaskConfig(layout=LAYOUT), {"architecture": architecture, **settings})
        cell = cell if isinstance(cell, Cell) else load_cell(cell or CellConfig())
        self.rules = Rules(cell, task, motion_cost(cell, task))
        self.render_mode = render_mode
        self._view: TopView | None = None
        reach_x, reach_y = cell.extent_mm
        high = np.array([reach_x + 1.0, reach_y + 1.0, math.pi], dtype=np.float32)
        pose_space = gymnasium.spaces.Box(-high, high, dtype=np.float32)
        width = observation_size(task.layout, cell.num_arms)
        self.observation_space = gymnasium.spaces.Dict(
            observation=gymnasium.spaces.Box(-4.0, 4.0, (width,), dtype=np.float32),
            achieved_goal=pose_space,
            desired_goal=gymnasium.spaces.Box(-high, high, dtype=np.float32),
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.rules.action_size,), dtype=np.float32)
        self._pose = self._goal = np.zeros(3)
        self._previous = np.int64(-1)
        self._transfers = 0
        self._problems = problems or ProblemSource(self.rules.cell)

    _spec: EnvSpec | None = None  # of an environment that was made without gymnasium.make

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's description of this environment, which :func:`gymnasium.make` sets; its step limit is the task's."""
        return self._spec

    @spec.setter
    def spec(self, given: EnvSpec | None) -> None:
        self._spec = None if given is None else replace(given, max_episode_steps=self.rules.config.max_steps)

    def render(self) -> NDArray[np.uint8] | None:
        """The table from above with the block, and the goal's outline, (height, width, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        self._view = self._view or TopView(self.rules.cell)
        return self._view.draw(self._pose, self._goal)

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode. ``options={"state": [x_mm, y_mm, theta_rad], "goal": [...]}`` sets the problem, else it is random.

        Raises:
            UnknownKey, InvalidSetting, OutOfReach, NotFinite: for options, a state or a goal that cannot be.
        """
        if seed is None and self._np_random is None:
            seed = self._problems.seed
        super().reset(seed=seed)
        if seed is not None:
            self._problems.clear()
        self._pose, self._goal = self._problems.next(self.np_random, options)
        self._previous, self._transfers = np.int64(-1), 0
        return self._observation(), self._info(True, False, Outcome.NONE, 0.0, over=False)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute one command; see :class:`marl_handover.task.rules.Rules`."""
        if not np.isfinite(action).all():
            raise NotFinite("action", list(action))
        made, numbers = np.asarray(self._transfers), np.asarray(action, np.float64)
        noise, final_noise = self._noise(), self._noise()
        stepped = advance(self.rules, self._pose, self._goal, self._previous, numbers, made, noise=noise, final_noise=final_noise)
        result, room = stepped.result, bool(made < self.rules.config.max_steps - 1)
        penalty = self.rules.motion_penalty(result.command.arm, self._pose, result.placed)
        self._pose, self._previous = result.pose, result.previous_arm
        self._transfers = int(stepped.transfers)
        terminated, truncated = bool(result.terminated), bool(stepped.truncated)
        outcome, over = Outcome(int(stepped.outcome)), terminated or truncated
        info = self._info(bool(result.feasible), bool(result.command.final), outcome, float(penalty), over=over)
        info["room"] = room or (int(result.transfers) == 1 and int(result.external_arm) >= 0)
        return self._observation(), float(result.reward), terminated, truncated, info

    def compute_reward(
        self, achieved_goal: NDArray[np.float32], desired_goal: NDArray[np.float32], info: Mapping[str, Any] | Sequence[Mapping[str, Any]]
    ) -> Any:
        """Reward of having achieved one pose when another was desired; vectorised over leading dimensions.

        Args:
            achieved_goal: (3,) or (n, 3).
            desired_goal: (3,) or (n, 3).
            info: one mapping or one a row, read for ``feasible`` (True if absent), ``final`` (False if absent), ``motion_penalty``
                (0 if absent) and, in architecture A, ``room``: whether the step limit leaves room for the external transfer
                (True if absent).

        Returns:
            A float, or (n,) rewards.
        """
        final, feasible = self._flags(info, np.shape(achieved_goal)[:-1])
        achieved, desired = np.asarray(achieved_goal, np.float64), np.asarray(desired_goal, np.float64)
        reward = self.rules.judge(achieved, desired, final, feasible).reward
        if self.rules.external_finish:
            reward = np.where(self._read(info, "room", True, final.shape), reward, -1.0)
        reward = reward - self._read(info, "motion_penalty", 0.0, final.shape)
        return float(reward) if np.ndim(reward) == 0 else reward

    def compute_terminated(
        self, achieved_goal: NDArray[np.float32], desired_goal: NDArray[np.float32], info: Mapping[str, Any] | Sequence[Mapping[str, Any]]
    ) -> Any:
        """Whether the episode ends there; arguments as in :meth:`compute_reward`. A relabelled transition needs both."""
        final, feasible = self._flags(info, np.shape(achieved_goal)[:-1])
        achieved, desired = np.asarray(achieved_goal, np.float64), np.asarray(desired_goal, np.float64)
        terminated = self.rules.judge(achieved, desired, final, feasible).terminated
        return terminated & self._read(info, "room", True, final.shape) if self.rules.external_finish else terminated

    @staticmethod
    def _read(info: Any, key: str, absent: Any, shape: tuple[int, ...]) -> NDArray[Any]:
        """One value of one info, or of one info a row, as an array of ``shape``."""
        rows = [info] if isinstance(info, Mapping) else list(info)
        values = np.array([row.get(key, absent) for row in rows])
        return np.broadcast_to(values.reshape(-1)[0] if values.size == 1 else values, shape).copy()

    def _flags(self, info: Any, shape: tuple[int, ...]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        return self._read(info, "final", False, shape).astype(bool), self._read(info, "feasible", True, shape).astype(bool)

    def _noise(self) -> NDArray[np.float64] | None:
        if not self.rules.noisy:
            return None
        noise = self.rules.config.noise
        return self.np_random.normal(size=3) * np.array([noise.position_mm, noise.position_mm, math.radians(noise.yaw_deg)])

    def _observation(self) -> Observation:
        vector = observe(self.rules, self.rules.config.layout, self._pose, self._goal, self._previous)
        return {
            "observation": np.asarray(vector, np.float32),
            "achieved_goal": self._pose.astype(np.float32),
            "desired_goal": self._goal.astype(np.float32),
        }

    def _info(self, feasible: bool, final: bool, outcome: Outcome, motion_penalty: float, *, over: bool) -> dict[str, Any]:
        return {
            **self._problems.told(outcome, self._transfers, over, self.rules.config.max_steps),
            "motion_penalty": motion_penalty,
            "feasible": feasible,
            "final": final,
            "transfers": self._transfers,
            "outcome": outcome.name.lower(),
            "is_success": outcome is Outcome.SUCCESS,
        }


def _with(task: TaskConfig, settings: Mapping[str, Any]) -> TaskConfig:
    """``task`` with single settings changed, checked."""
    names = [item.name for item in fields(TaskConfig)]
    for name in settings:
        if name not in names:
            raise UnknownKey(name, closest_first(name, names))
    task = replace(task, **settings)
    task.validate()
    if task.layout != LAYOUT:
        raise InvalidSetting(
            "layout", task.layout, f"{LAYOUT!r} here: others contain the goal, which hindsight replaces in desired_goal only"
        )
    return task

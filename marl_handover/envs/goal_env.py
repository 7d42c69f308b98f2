"""The supervisor's problem as a Gymnasium goal environment: one cell, numpy, ready for any hindsight replay."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from marl_handover.arrays import Array, as_kind, one_where
from marl_handover.cell import NO_ARM, Cell, load_cell
from marl_handover.config import CellConfig, TaskConfig, require_choice
from marl_handover.envs.top_view import TopView, Window, no_window_because
from marl_handover.errors import GoalInObservation, InvalidSetting, NotFinite
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.schema import with_settings
from marl_handover.task.episode import Stepped, advance
from marl_handover.task.observations import last_arm, observation_size, observe
from marl_handover.task.problems import ProblemSource, sample_poses
from marl_handover.task.rules import Command, Outcome, Rules, Verdict

Observation = dict[str, NDArray[np.float32]]


LAYOUT, RENDER_MODES = "object", ("rgb_array", "human")

NEVER_RAD = -1.0
"""An accuracy that nothing has."""

PROBES = 32
"""Objects that a layout is tried out on."""


class SupervisorGoalEnv(gymnasium.Env[Any, Any]):
    """One cell.

    ``observation`` is a layout without the goal, ``object`` unless told otherwise: a hindsight buffer swaps only ``desired_goal``, and
    would train on features of the old goal. Better features follow the swap where the learner computes them: :meth:`features`.
    ``achieved_goal`` and ``desired_goal`` are poses in mm, mm, rad. Actions are float32[4] = (final, arm, alpha, beta).

    ``info`` carries ``feasible``, ``final``, ``transfers``, ``outcome`` and ``is_success``, and of the command ``arm`` and ``start``,
    the pose it found. With these :meth:`compute_reward` knows what the command would have done under another goal, and in architecture B
    no end of an episode depends on the goal: a stock hindsight buffer, which keeps ``done`` as it was, is right.

    Args:
        architecture: ``"A"`` or ``"B"``; replaces the task's.
        cell: the cell, or what :func:`marl_handover.cell.load_cell` takes; the shipped ``paper`` cell if None.
        task: the task's settings; the defaults, with layout ``object``, if None.
        render_mode: ``"rgb_array"``: :meth:`render` draws the table from above. ``"human"``: each step does, into a window.
        problems: where problems of the cell come from; random ones if None. Where their optimum is known, ``info`` carries it, as
            ``optimum``, and when the episode is over ``regret`` (:func:`marl_handover.task.problems.regret`).
        scale_goals: divide poses by the cell's extent and pi, so that both goals are in about [-1, 1], as ``observation`` is.
        settings: single settings of the task, such as ``epsilon_deg=1.0`` or ``reward={"step": -0.1}``, put over ``task``.

    Raises:
        UnknownKey, InvalidSetting, UnknownChoice: for settings that cannot be.
        GoalInObservation: for a layout that depends on the goal.
        NoWindow: ``render_mode="human"`` on a machine without a display.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 2}  # noqa: RUF012  # as the base class has it

    def __init__(
        self,
        architecture: str = "B",
        cell: Cell | CellConfig | str | None = None,
        task: TaskConfig | None = None,
        render_mode: str | None = None,
        problems: ProblemSource | None = None,
        scale_goals: bool = False,
        **settings: Any,
    ) -> None:
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        task = with_settings(task or TaskConfig(layout=LAYOUT), {"architecture": architecture, **settings})
        task.validate()
        cell = cell if isinstance(cell, Cell) else load_cell(cell or CellConfig())
        self.rules = Rules(cell, task, motion_cost(cell, task))
        _require_no_goal(self.rules)
        if no_window_because():  # then it is no mode of this one; the class has it, so that Gymnasium asks and is told why not
            self.metadata = {**self.metadata, "render_modes": list(RENDER_MODES[:1])}
        self.render_mode = render_mode
        self._view: TopView | None = None
        self._window = Window(self.metadata["render_fps"]) if render_mode == "human" else None
        reach_x, reach_y = cell.extent_mm
        self._unit = np.array([reach_x, reach_y, math.pi]) if scale_goals else np.ones(3)
        high = (np.array([reach_x + 1.0, reach_y + 1.0, math.pi]) / self._unit).astype(np.float32)
        limit = 4.0 if task.layout == LAYOUT else math.inf
        self.observation_space = gymnasium.spaces.Dict(
            observation=gymnasium.spaces.Box(-limit, limit, (observation_size(task.layout, cell.num_arms),), dtype=np.float32),
            achieved_goal=gymnasium.spaces.Box(-high, high, dtype=np.float32),
            desired_goal=gymnasium.spaces.Box(-high, high, dtype=np.float32),
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.rules.action_size,), dtype=np.float32)
        self._pose = self._goal = np.zeros(3)
        self._previous = np.int64(NO_ARM)
        self._transfers = 0
        self._problems = problems or ProblemSource(self.rules.cell)

    def __repr__(self) -> str:
        """What it is, and the settings that matter most."""
        config = self.rules.config
        return (
            f"{type(self).__name__}(architecture={config.architecture!r}, cell={self.rules.cell.config.name!r}, "
            f"epsilon_deg={config.epsilon_deg:g}, max_steps={config.max_steps}, layout={config.layout!r})"
        )

    def __str__(self) -> str:
        """As Gymnasium shows environments."""
        return f"<{self!r}>" if self.spec is None else f"<{self!r}<{self.spec.id}>>"

    _spec: EnvSpec | None = None  # of an environment that was made without gymnasium.make

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's description of this environment, which :func:`gymnasium.make` sets; its step limit is the task's."""
        return self._spec

    @spec.setter
    def spec(self, given: EnvSpec | None) -> None:
        self._spec = None if given is None else replace(given, max_episode_steps=self.rules.config.max_steps)

    def render(self) -> NDArray[np.uint8] | None:
        """The table from above with arms, block and goal (height, width, 3); None without a mode, and where a window shows it."""
        if self.render_mode is None:
            return None
        picture = self.picture(self._pose, self._goal, self._previous)
        if self._window is None:
            return picture
        self._window.show(picture)
        return None

    def picture(self, pose: NDArray[np.float64], goal: NDArray[np.float64], previous_arm: Any) -> NDArray[np.uint8]:
        """The table from above (height, width, 3): the block at ``pose`` (3,) with the hand of the arm that moved last, if one did."""
        self._view = self._view or TopView(self.rules.cell)
        return self._view.draw(pose, goal, hands_mm=self._view.hands_mm(pose, int(previous_arm)))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

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
        self._previous, self._transfers = np.int64(NO_ARM), 0
        self._show()
        return self._observation(), self._info(Outcome.NONE, over=False)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Execute one command; see :class:`marl_handover.task.rules.Rules`."""
        if not np.isfinite(action).all():
            raise NotFinite("action", list(action))
        made, numbers, start = np.asarray(self._transfers), np.asarray(action, np.float64), self._pose
        noise, final_noise = self._noise(), self._noise()
        stepped = advance(self.rules, start, self._goal, self._previous, numbers, made, noise=noise, final_noise=final_noise)
        result = stepped.result
        self._pose, self._previous = result.pose, result.previous_arm
        self._transfers = int(stepped.transfers)
        terminated, truncated = bool(result.terminated), bool(stepped.truncated)
        told = {key: value.item() for key, value in of_command(self.rules, stepped, start, made).items() if key != "start"}
        info = self._info(Outcome(int(stepped.outcome)), over=terminated or truncated) | told | {"start": tuple(start.tolist())}
        self._show()
        return self._observation(), float(result.reward), terminated, truncated, info

    def compute_reward(
        self, achieved_goal: NDArray[np.float32], desired_goal: NDArray[np.float32], info: Mapping[str, Any] | Sequence[Mapping[str, Any]]
    ) -> Any:
        """Reward of having achieved one pose when another was desired; vectorised over leading dimensions.

        Of a command that ``info`` tells of with ``arm`` and ``start``, as :meth:`step` does, it is the reward of that command under the
        other goal. In architecture B a final one would have gone to that goal, wherever it went (on exact arms); one that is not final
        has finished nothing, even if the object now lies at the goal, and a final one is to follow.

        Args:
            achieved_goal: (3,) or (n, 3).
            desired_goal: (3,) or (n, 3).
            info: one mapping, one a row, or one of arrays (n,), read for ``feasible`` (True if absent), ``final`` (False if absent),
                ``motion_penalty`` (0 if absent), ``arm`` and ``start`` and, in architecture A, ``room``: whether the step limit leaves room
                for the external transfer (True if absent).

        Returns:
            A float, or (n,) rewards.
        """
        verdict = self._judged(achieved_goal, desired_goal, info)
        reward = verdict.reward
        if self.rules.external_finish:
            reward = np.where(self._read(info, "room", True, reward.shape), reward, -1.0)
        reward = reward - self._read(info, "motion_penalty", 0.0, reward.shape)
        return float(reward) if np.ndim(reward) == 0 else reward

    def compute_terminated(
        self, achieved_goal: NDArray[np.float32], desired_goal: NDArray[np.float32], info: Mapping[str, Any] | Sequence[Mapping[str, Any]]
    ) -> Any:
        """Whether the episode ends there; arguments as in :meth:`compute_reward`. Where ``info`` has no ``arm``, a relabelled transition
        needs both.
        """
        terminated = self._judged(achieved_goal, desired_goal, info).terminated
        return terminated & self._read(info, "room", True, terminated.shape) if self.rules.external_finish else terminated

    def features(self, observation: Mapping[str, Array], layout: str = "relative") -> Array:
        """A layout computed from observations of this environment, so that it follows a goal that a hindsight buffer swapped.

        Args:
            observation: ``observation`` in the layout ``object``, ``achieved_goal`` and ``desired_goal``; (...) of each, numpy or torch.
            layout: its name, such as ``relative``, whose fields are :data:`marl_handover.task.observations.ARM_FIELDS`, one block an arm.

        Returns:
            (..., size), where :func:`marl_handover.task.observations.observation_size` knows the size.

        Raises:
            InvalidSetting: the environment shows another layout than ``object``, which does not say which arm moved last.
        """
        if self.rules.config.layout != LAYOUT:
            raise InvalidSetting("layout", self.rules.config.layout, f"{LAYOUT!r} to compute features from")
        unit = as_kind(self._unit, observation["achieved_goal"])
        pose, goal = observation["achieved_goal"] * unit, observation["desired_goal"] * unit
        return observe(self.rules, layout, pose, goal, last_arm(observation["observation"]))

    def _judged(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Verdict:
        """The verdict (...) on transfers that ``info`` tells of, had ``desired_goal`` (..., 3) been the goal."""
        achieved, desired = np.asarray(achieved_goal, np.float64) * self._unit, np.asarray(desired_goal, np.float64) * self._unit
        shape = achieved.shape[:-1]
        final, feasible = self._read(info, "final", False, shape).astype(bool), self._read(info, "feasible", True, shape).astype(bool)
        arm = self._read(info, "arm", NO_ARM, shape).astype(np.int64)
        if self.rules.external_finish or (arm == NO_ARM).all():
            return self.rules.judge(achieved, desired, final, feasible)
        told = (arm != NO_ARM) & final
        if not self.rules.measured:
            start = self._read(info, "start", (0.0, 0.0, 0.0), (*shape, 3)).astype(float)
            command = Command(np.ones_like(final), np.maximum(arm, 0), desired[..., :2])
            placed, able = self.rules.transfer(start, desired, command)
            achieved, feasible = one_where(told, placed, achieved), np.where(told, able, feasible)
        goes_on = (arm != NO_ARM) & ~final & feasible
        return self.rules.judge(achieved, desired, final, feasible, np.where(goes_on, NEVER_RAD, self.rules.epsilon_rad))

    @staticmethod
    def _read(info: Any, key: str, absent: Any, shape: tuple[int, ...]) -> NDArray[Any]:
        """One value of one info, of one of arrays, or of one info a row, as an array of ``shape``."""
        if isinstance(info, Mapping):
            return np.broadcast_to(np.asarray(info.get(key, absent)), shape).copy()
        values = np.array([row.get(key, absent) for row in info])
        return np.broadcast_to(values[0] if len(values) == 1 else values, shape).copy()

    def _noise(self) -> NDArray[np.float64] | None:
        if not self.rules.noisy:
            return None
        noise = self.rules.config.noise
        return self.np_random.normal(size=3) * np.array([noise.position_mm, noise.position_mm, math.radians(noise.yaw_deg)])

    def shown(self, vector: Any, pose: NDArray[np.float64], goal: NDArray[np.float64]) -> Observation:
        """The observation of objects at ``pose`` (..., 3) that are to go to ``goal`` (..., 3), whose layout is ``vector`` (..., size)."""
        return {
            "observation": np.asarray(vector, np.float32),
            "achieved_goal": (pose / self._unit).astype(np.float32),
            "desired_goal": (goal / self._unit).astype(np.float32),
        }

    def _observation(self) -> Observation:
        return self.shown(observe(self.rules, self.rules.config.layout, self._pose, self._goal, self._previous), self._pose, self._goal)

    def _info(self, outcome: Outcome, *, over: bool) -> dict[str, Any]:
        """What is told at any time; at a start there was no command."""
        return {
            **self._problems.told(outcome, self._transfers, over, self.rules.config.max_steps),
            "motion_penalty": 0.0,
            "feasible": True,
            "final": False,
            "arm": NO_ARM,
            "start": tuple(self._pose.tolist()),
            "transfers": self._transfers,
            "outcome": outcome.name.lower(),
            "is_success": outcome is Outcome.SUCCESS,
        }

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()


def of_command(rules: Rules, stepped: Stepped, start: NDArray[np.float64], made: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """What ``info`` tells of commands (...) that found objects at ``start`` (..., 3) after ``made`` (...) transfers."""
    result = stepped.result
    room = (made < rules.config.max_steps - 1) | ((result.transfers == 1) & (result.external_arm >= 0))
    return {
        "feasible": np.asarray(result.feasible),
        "final": np.asarray(result.command.final),
        "arm": np.asarray(result.command.arm),
        "start": start,
        "motion_penalty": np.asarray(rules.motion_penalty(result.command.arm, start, result.placed)),
        "room": np.asarray(room),
    }


def _require_no_goal(rules: Rules) -> None:
    """Raise :class:`GoalInObservation` if what the task's layout shows of a few objects changes with the goal."""
    if rules.config.layout == LAYOUT:
        return
    poses = sample_poses(rules.cell, 2 * PROBES, torch.Generator().manual_seed(0)).numpy()
    previous = np.arange(PROBES) % (rules.cell.num_arms + 1) - 1
    shown = [observe(rules, rules.config.layout, poses[:PROBES], goal, previous) for goal in (poses[PROBES:], poses[:PROBES])]
    if not np.array_equal(*shown):
        raise GoalInObservation(rules.config.layout, LAYOUT)

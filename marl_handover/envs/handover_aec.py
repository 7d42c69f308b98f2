"""The whole hierarchy as a PettingZoo AEC environment: a supervisor, and the arms it queries.

A supervisor's turn is followed by the turn of the one arm it names; in architecture A, an object that an arm can then finish with gets
that arm's turn too. The object moves in a backend, the rule book judges. Whatever an agent sends, the environment goes on: a transfer
that cannot be is refused with a named reason, which the supervisor finds in its ``infos``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import turn_based_aec_to_parallel_wrapper

from marl_handover.arrays import Floats
from marl_handover.cell import CellModel, build_whole_cell, cell_config
from marl_handover.config import CellConfig, LoopConfig, MotionConfig, NoiseConfig, TaskConfig, require_between, require_choice
from marl_handover.envs.backends import Backend, Correctable, KinematicBackend, make_backend
from marl_handover.envs.cycle_check import FAILURES, CycleCheck, Refusal
from marl_handover.envs.spaces import SUPERVISOR, Spaces, read_command, read_cycle
from marl_handover.motion.executor import arm_agents
from marl_handover.motion.path_length_table import motion_cost
from marl_handover.task.episode import conclude, final_transfer, measured_verdict
from marl_handover.task.problems import ProblemSource
from marl_handover.task.rules import Command, Outcome, Rules, Verdict

Observation = dict[str, Any]

RENDER_MODES = ("rgb_array", "human")


TIPPED_OVER = Verdict(np.float64(-1.0), np.bool_(True), np.int64(Outcome.WRONG_POSITION))
"""Architecture A's verdict on an object that no arm can grip any more; architecture B's is that of an infeasible command."""


class Turn(NamedTuple):
    """What an arm is asked to do: take the object to ``target_mm`` (2,); ``planned`` (3,) is where the rule book says it is then."""

    arm: int
    target_mm: Floats
    planned: Floats
    feasible: bool
    command: Command | None  # None: architecture A's external final transfer

    @property
    def final(self) -> bool:
        """Whether it is to put the object at the goal."""
        return self.command is None or bool(self.command.final)


class HandoverEnv(AECEnv):
    """Agents ``supervisor``, then ``arm_NAME`` of each arm; spaces in :mod:`marl_handover.envs.spaces`.

    Those of a mirrored pair are ``supervisor``, ``arm_left``, ``arm_right``.

    Rewards: the supervisor's are r_A or r_B of the rule book, given when the transfers of its decision are over. The arm that acted gets
    ``-path_mm / 100``, or ``refused_reward`` for a transfer that was refused or failed; the other arms 0.

    ``infos["supervisor"]`` has, from the first decision on, ``refusal`` (a value of :class:`Refusal` or None), ``transfers`` so far and
    ``outcome``; the infos of an arm that acted have ``refusal`` and ``path_mm``. All are empty at reset: TorchRL's wrapper takes infos for
    numbers if it finds some there.

    A command that is none (wrong shape, not finite) asks no arm and is refused at once, and so is one to an arm and a receiver that share
    no place. One that an arm cannot carry out does ask it; its answer is then ignored. A refused transfer counts as an infeasible one; one
    that failed on the way (:data:`FAILURES`) is judged by where it left the object.

    ``kinematic`` and ``noisy`` arms look at a path's ends and joint limits only: **nothing is checked for collision**, and one through the
    table or the other arm is carried out, unless ``backend_options={"check_collisions": True}`` (some milliseconds a transfer).

    On arms that are not exact, hand-overs keep to ``LoopConfig.chart_inset`` of the chart, as in the closed loop.

    Args:
        backend: ``kinematic``, ``noisy``, ``bullet``, ``mujoco``, or one of your own.
        cell: a shipped cell's name, a YAML path, settings, or a cell that is built already.
        enabled: names of the arms that are in order, if settings do not say so; the others stand still. Arms are counted without them.
        task: the task's settings. Its noise is that of the ``noisy`` backend; the others have their own or none.
        motion: how the arms move.
        architecture: ``"A"`` or ``"B"``; replaces the task's.
        render_mode: ``"rgb_array"`` or ``"human"``: one line of text a turn.
        refused_reward: an arm's reward for a refused or failed transfer.
        backend_options: for the backend's class, if it is named.
        problems: where problems of the cell come from; random ones if None. Where their optimum is known, ``infos["supervisor"]`` has
            ``optimum``, and when the episode is over ``regret`` (:func:`marl_handover.task.problems.regret`).
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "name": "handover_v0", "is_parallelizable": False, "render_fps": 2}  # noqa: RUF012

    def __init__(
        self,
        *,
        backend: str | Backend = "kinematic",
        cell: str | CellConfig | CellModel = "paper",
        task: TaskConfig | None = None,
        motion: MotionConfig | None = None,
        architecture: str | None = None,
        render_mode: str | None = None,
        refused_reward: float = -10.0,
        backend_options: Mapping[str, Any] | None = None,
        enabled: Sequence[str] | None = None,
        problems: ProblemSource | None = None,
    ) -> None:
        super().__init__()
        if render_mode is not None:
            require_choice("render_mode", render_mode, RENDER_MODES)
        require_between("refused_reward", refused_reward, -1e6, 0)
        task, motion = task or TaskConfig(), motion or MotionConfig()
        task = task if architecture is None else replace(task, architecture=architecture)
        self.render_mode, self.refused_reward = render_mode, refused_reward
        config = cell.cell.config if isinstance(cell, CellModel) else cell_config(cell) if isinstance(cell, str) else cell
        self.model = cell if isinstance(cell, CellModel) else build_whole_cell(config)
        enabled = config.enabled if enabled is None else enabled
        if isinstance(backend, str):
            backend = make_backend(backend, self.model, task, motion, **(backend_options or {}))
        self.backend = backend
        # On arms that are not exact, hand-overs keep to the part of the chart that the closed loop keeps to.
        own = self.model.cell.config.chart_inset
        played = self.model.cell.with_inset(own if self.backend.exact else min(own, LoopConfig().chart_inset))
        played = played if enabled is None else played.with_arms(enabled)
        cost = motion_cost(played, task, motion)
        self.arm_agents = arm_agents(played)
        self._number = self.model.cell.numbered(range(played.num_arms), played)
        self.rules = Rules(played, replace(task, noise=NoiseConfig()), cost, physical=not self.backend.exact)
        self.check = CycleCheck(self.model, motion)
        self.problems = problems or ProblemSource(played)
        self.spaces = Spaces(self.model, motion, played)
        self.possible_agents = list(self.spaces.action)
        self.agents: list[str] = []
        self._random: np.random.Generator | None = None

    def __repr__(self) -> str:
        """What it is, and the settings that matter most."""
        config, backend = self.rules.config, type(self.backend).__name__
        return (
            f"HandoverEnv(architecture={config.architecture!r}, cell={self.rules.cell.config.name!r}, backend={backend}, "
            f"epsilon_deg={config.epsilon_deg:g}, agents={self.possible_agents})"
        )

    def __str__(self) -> str:
        """Its name, as PettingZoo has it."""
        return str(self.metadata["name"])

    def observation_space(self, agent: str) -> gymnasium.spaces.Dict:
        """What ``agent`` sees."""
        return self.spaces.observation[agent]

    def action_space(self, agent: str) -> gymnasium.spaces.Dict:
        """What ``agent`` says."""
        return self.spaces.action[agent]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> None:
        """Start an episode. ``options={"state": [x_mm, y_mm, theta_rad], "goal": [...]}`` sets the problem, else it is random.

        Raises:
            UnknownKey, InvalidSetting: for another option, or a pose that is not three numbers.
            OutOfReach, NotFinite: for a state or goal that cannot be.
        """
        if seed is None and self._random is None:
            seed = self.problems.seed
        if seed is not None or self._random is None:
            self._random, _ = seeding.np_random(seed)
            self.problems.clear()
        start, self._goal = self.problems.next(self._random, options)
        self._pose = self.backend.reset(start, int(self._random.integers(2**31)))
        self._previous, self._transfers, self._penalty = np.int64(-1), 0, 0.0
        self._turn: Turn | None = None
        self._outcome = Outcome.NONE
        self._place_mm: Floats | None = None
        # Solved at its start: the supervisor's first action is ignored.
        self._early = self._external()
        self.agents = self.possible_agents[:]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations, self.truncations = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        self.agent_selection = SUPERVISOR
        self._skip_agent_selection = None

    def observe(self, agent: str) -> Observation:
        """What ``agent`` sees now, whether or not it is its turn."""
        if agent == SUPERVISOR:
            return self.spaces.supervisor_sees(self.rules, self._pose, self._goal, self._previous)
        arm = self.arm_agents.index(agent)
        turn = self._turn if self._turn is not None and self._turn.arm == arm else None
        target_mm, final = (self._pose[:2], False) if turn is None else (turn.target_mm, turn.final)
        return self.spaces.arm_sees(int(self._number[arm]), turn is not None, target_mm, final, self._pose, self.backend.joints_rad())

    def step(self, action: Any) -> None:
        """The turn of ``agent_selection``."""
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        self._cumulative_rewards[agent] = 0.0
        self._clear_rewards()
        if self._turn is None:
            self._command(action)
        else:
            self._answer(self._turn, action)
        self._accumulate_rewards()
        if self.render_mode == "human":
            self.render()

    def render(self) -> NDArray[np.uint8] | None:
        """The table from above (height, width, 3), or None and a line of text in ``human`` mode."""
        if self.render_mode == "human":
            pose, goal, outcome = self._pose.round(3).tolist(), self._goal.round(3).tolist(), self._outcome.name.lower()
            print(f"transfers {self._transfers}, object {pose}, goal {goal}, outcome {outcome}, next {self.agent_selection}")
            return None
        if isinstance(self.backend, KinematicBackend):
            return self.backend.render(self._goal, self._place_mm)
        return self.backend.render()

    def close(self) -> None:
        """Close the backend."""
        self.backend.close()

    def _command(self, action: Any) -> None:
        """The supervisor's turn."""
        if self._early is not None:
            self._ask(self._early)
            return
        numbers = read_command(action, self.rules.cell.num_arms)
        if isinstance(numbers, Refusal):
            self._refuse(numbers)
            return
        command = self.rules.decode(numbers)
        target_mm = self._goal[:2] if command.final else command.place_mm
        if np.isnan(target_mm).any():
            self._refuse(Refusal.OUT_OF_REACH)
            return
        planned, feasible = self.rules.transfer(self._pose, self._goal, command)
        self._ask(Turn(int(command.arm), target_mm, planned, bool(feasible), command))

    def _refuse(self, refusal: Refusal) -> None:
        """A command that no arm is asked to carry out."""
        none = Command(np.bool_(False), np.int64(0), self._pose[:2])
        self._settle(Turn(0, self._pose[:2], self._pose, False, none), self._pose, refusal)

    def _ask(self, turn: Turn) -> None:
        self._turn, self._place_mm = turn, turn.target_mm
        self.agent_selection = self.arm_agents[turn.arm]

    def _answer(self, turn: Turn, action: Any) -> None:
        """An arm's turn: carry out what it says, then judge."""
        self._turn, self._early = None, None
        refusal, placed, path_mm = self._carry_out(turn, action)
        arm = self.arm_agents[turn.arm]
        self.rewards[arm] = -path_mm / 100 if refusal is None else self.refused_reward
        self.infos[arm] = {"refusal": refusal, "path_mm": path_mm}
        if turn.command is None:
            self._finish(turn, placed, refusal)
        else:
            self._settle(turn, placed, refusal)

    def _carry_out(self, turn: Turn, action: Any) -> tuple[str | None, Floats, float]:
        """Why it was refused or failed, the object's pose afterwards, and the length of the path."""
        if not turn.feasible:
            return Refusal.OUT_OF_REACH, self._pose, 0.0
        arm = int(self._number[turn.arm])
        paths = read_cycle(action, self.spaces.control_points, self.model.arms[arm])
        if isinstance(paths, Refusal):
            return paths, self._pose, 0.0
        joints = self.backend.joints_rad()[arm]
        refusal = self.check(arm, paths, joints, self._pose[:2], turn.target_mm)
        if refusal is not None:
            return refusal, self._pose, 0.0
        done = self.backend.execute(arm, paths)
        if self.backend.exact and done.refusal is None and isinstance(self.backend, Correctable):
            # The grip may end up to a millimetre off; exact hardware does what the rule book says.
            self.backend.put(turn.planned)
            return None, turn.planned, done.path_mm
        return done.refusal, done.pose, done.path_mm

    def _settle(self, turn: Turn, placed: Floats, refusal: str | None) -> None:
        """Judge a commanded transfer, or in architecture A hand on to the arm that can finish."""
        command, rules = turn.command, self.rules
        assert command is not None
        feasible = np.bool_(refusal is None or refusal in FAILURES)
        self._penalty = float(rules.motion_penalty(command.arm, self._pose, placed))
        self._moved(placed, command.arm if feasible else self._previous)
        tipped = refusal == Refusal.TIPPED
        external = self._external() if not tipped and self._transfers < rules.config.max_steps else None
        if external is not None:
            self._ask(external)
        elif rules.external_finish and tipped:
            self._conclude(TIPPED_OVER, refusal)
        else:
            self._conclude(measured_verdict(rules, placed, self._goal, command.final, feasible), refusal)

    def _external(self) -> Turn | None:
        """Architecture A's final transfer of the object as it lies, if an arm can do it."""
        external = final_transfer(self.rules, self._pose, self._goal)
        return None if external is None else Turn(int(external.arm), self._goal[:2], external.pose, True, None)

    def _finish(self, turn: Turn, placed: Floats, refusal: str | None) -> None:
        """Judge architecture A's final transfer."""
        self._moved(placed, np.int64(turn.arm))
        verdict = self.rules.external_verdict(placed, self._goal, self._previous)
        self._conclude(TIPPED_OVER if refusal == Refusal.TIPPED else verdict, refusal)

    def _moved(self, pose: Floats, previous: Any) -> None:
        self._pose, self._previous = pose, np.int64(previous)
        self._transfers += 1

    def _conclude(self, verdict: Verdict, refusal: str | None) -> None:
        """End the supervisor's decision, and the episode if that is due."""
        truncated, outcome = conclude(verdict.terminated, verdict.outcome, self._transfers, self.rules.config.max_steps)
        self._outcome = Outcome(int(outcome))
        self.rewards[SUPERVISOR] = float(verdict.reward) - self._penalty
        self._penalty = 0.0
        self.terminations = dict.fromkeys(self.agents, bool(verdict.terminated))
        self.truncations = dict.fromkeys(self.agents, bool(truncated))
        told = self.problems.told(self._outcome, self._transfers, bool(verdict.terminated or truncated), self.rules.config.max_steps)
        self.infos[SUPERVISOR] = {"refusal": refusal, "transfers": self._transfers, "outcome": self._outcome.name.lower(), **told}
        self.agent_selection = SUPERVISOR


def raw_env(**settings: Any) -> HandoverEnv:
    """The bare environment; settings as :class:`HandoverEnv` has them."""
    return HandoverEnv(**settings)


def env(**settings: Any) -> AECEnv:
    """The environment as PettingZoo ships its own: steps out of order raise. Settings as :class:`HandoverEnv` has them."""
    return wrappers.OrderEnforcingWrapper(HandoverEnv(**settings))


def parallel_env(**settings: Any) -> ParallelEnv:
    """The same for learners that step all agents at once: of the actions, that of the agent whose turn it is counts.

    Whose that is, ``infos[agent]["active_agent"]`` says after every step; after a reset it is the supervisor's. Settings as
    :class:`HandoverEnv` has them.
    """
    return turn_based_aec_to_parallel_wrapper(env(**settings))

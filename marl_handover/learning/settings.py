"""Settings of training, one home for each default, and the curriculum that follows from them."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from marl_handover.config import (
    BACKENDS,
    EPSILON_DEG,
    EXPLORATIONS,
    HINDSIGHT,
    LAYOUTS,
    PHYSICS,
    CellConfig,
    CentralisedConfig,
    DecentralisedConfig,
    LayoutConfig,
    TaskConfig,
    bounded,
    changed,
    check_bounds,
    chosen,
    path_field,
    require_at_least,
    require_choice,
    seed_field,
    sized,
)
from marl_handover.errors import InvalidSetting
from marl_handover.plugins import Registry

if TYPE_CHECKING:
    from marl_handover.envs.supervisor_env import SupervisorEnv


@dataclass
class StageConfig:
    """One stage of the curriculum: each episode's epsilon is drawn log-uniformly from [low, high]."""

    epsilon_low_deg: float = bounded(5.0, *EPSILON_DEG)
    epsilon_high_deg: float = bounded(5.0, *EPSILON_DEG)
    until_step: int = bounded(0, 0, 10**9)  # environment step that ends the stage; 0 = the end of training
    until_success: float = bounded(1.0, 0.0, 1.0)  # a success rate in evaluation that ends it earlier; 1 = never


def wide_first() -> list[StageConfig]:
    """Ranges of epsilon that end lower and lower.

    At a small epsilon a place that takes a transfer more than another is a sharp peak of the value, and a policy that is at it stays; at a
    large one the peaks are wide and it moves to the best. A step from 3 to 0.7 degrees at once is too large: in one run of five the policy
    forgets the larger epsilons as well, and has not learned them again by the end.
    """
    wide = [StageConfig(8.0, 15.0, until_step=8_000), StageConfig(3.0, 12.0, until_step=12_000)]
    return [*wide, StageConfig(1.5, 12.0, until_step=16_000), StageConfig(0.7, 12.0)]


def down_to(epsilon_deg: float, stages: Sequence[StageConfig]) -> list[StageConfig]:
    """The same stages for one accuracy: the last one goes down to it, and none goes below.

    The wider epsilons stay: at a small one alone nearly nothing is solved, so nearly nothing is learned.
    """
    lows = [*(max(stage.epsilon_low_deg, epsilon_deg) for stage in stages[:-1]), epsilon_deg]
    highs = (max(stage.epsilon_high_deg, epsilon_deg) for stage in stages)
    return [replace(stage, epsilon_low_deg=low, epsilon_high_deg=high) for stage, low, high in zip(stages, lows, highs, strict=True)]


class Curriculum:
    """Any number of stages; a stage ends at an environment step or at a measured success rate, whichever comes first."""

    def __init__(self, stages: Sequence[StageConfig], env: SupervisorEnv) -> None:
        self.stages, self.env = list(stages), env
        self.label = ""

    def enter(self, stage: int) -> None:
        """Set the environment's range; stored transitions are re-judged at it when they are sampled."""
        config = self.stages[stage]
        self.env.set_epsilon_range(config.epsilon_low_deg, config.epsilon_high_deg)
        low, high = config.epsilon_low_deg, config.epsilon_high_deg
        self.label = f"{low:g}°" if low == high else f"{low:g}-{high:g}°"

    def stage_after(self, stage: int, step: int, success_rate: float) -> int:
        """The stage to be in, given where training stands."""
        while stage < len(self.stages) - 1:
            config = self.stages[stage]
            out_of_time = 0 < config.until_step <= step
            if not (out_of_time or success_rate >= config.until_success):
                break
            stage += 1
            success_rate = 0.0  # one success ends one stage
        return stage


@dataclass
class AlgorithmConfig:
    """What every algorithm has."""

    name: str = ""
    layout: str = chosen("relative", LAYOUTS)  # observation layout
    previous_arm: bool = True  # whether observations say which arm moved last
    learning_rate: float = bounded(1e-3, 1e-8, 10.0)
    lr_decay_start: float = bounded(0.5, 0.0, 1.0)  # fraction of training after which the learning rate falls linearly to zero
    gamma: float = bounded(0.95, 1e-3, 1.0)
    reward_scale: float = bounded(0.5, 1e-6, 1e6)
    batch_size: int = bounded(256, 1, 65_536)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        check_bounds(self, "algorithm.")
        if self.layout == "object":
            raise InvalidSetting("algorithm.layout", self.layout, "'raw' or 'relative'; 'object' hides the goal")


@dataclass
class OffPolicyConfig(AlgorithmConfig):
    """What every algorithm with a replay memory has."""

    learning_starts: int = bounded(1000, 0, 10**9)  # environment steps with uniform actions, before the first update
    exploration: str = chosen("chart", EXPLORATIONS)  # what uniform places are uniform in: chart (alpha and beta), or area (of the table)
    env_steps_per_gradient_step: float = bounded(8.0, 0.01, 1e6)  # environment steps for each gradient step
    tau: float = bounded(0.01, 0.0, 1.0)  # target smoothing


@dataclass
class OnPolicyConfig(AlgorithmConfig):
    """What every algorithm without a memory has: it learns from whole roll-outs."""

    rollout_steps: int = bounded(32, 1, 4096)  # environment steps a cell between updates
    epochs: int = bounded(4, 1, 1000)


@dataclass
class SacConfig(OffPolicyConfig):
    """Hybrid SAC: exact expectation over (arm, final, mixture component), tanh-Gaussian places, two temperatures."""

    name: str = "sac"
    actor_hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))  # places are harder to say than to judge
    critic_hidden: list[int] = bounded([128, 128], 1, 4096, (0, 8))
    final_hidden: list[int] = bounded([64, 64], 1, 4096, (0, 8))  # of the critic of finishing
    actor_tau: float = bounded(0.005, 0.0, 1.0)  # smoothing of the actor that is judged and kept; 1: none
    mixture_components: int = bounded(1, 1, 64)  # place distributions an arm, chosen between like the other discrete branches
    canonical: bool = True  # fold the mirror symmetry M_x into the networks
    harmonics: int = bounded(2, 0, 16)  # doublings of the angles that the networks see
    candidates: int = bounded(3, 0, 256)  # places an arm tried anywhere, and as many nearby; the actor is drawn to the nearest better one
    candidate_share: float = bounded(0.5, 0.0, 1.0)  # of the batch
    candidate_weight: float = bounded(1.0, 0.0, 1e6)
    candidate_margin: float = bounded(0.25, -1e6, 1e6)  # in units of scaled reward
    deterministic_env_fraction: float = bounded(0.25, 0.0, 1.0)  # of the cells, which act without noise
    random_place: float = bounded(0.1, 0.0, 1.0)  # share of exploration's places that are drawn anywhere
    place_entropy_start: float = bounded(-2.0, -100.0, 100.0)  # target entropies fall from start (linearly / geometrically) ...
    place_entropy_end: float = bounded(-5.0, -100.0, 100.0)
    branch_entropy_start: float = bounded(0.1, 1e-9, 10.0)
    branch_entropy_end: float = bounded(0.01, 1e-9, 10.0)
    entropy_until: float = bounded(0.75, 1e-6, 1000.0)  # ... to end at this fraction of training
    temperature_rate: float = bounded(3e-3, 1e-9, 10.0)
    initial_temperature: float = bounded(0.1, 1e-9, 1e3)


@dataclass
class GraphSacConfig(OffPolicyConfig):
    """Hybrid SAC over hand-over graphs, for cells of any number of arms: a soft choice by values, tanh-Gaussian places."""

    name: str = "graph_sac"
    layout: str = chosen("graph", LAYOUTS)  # observation layout
    learning_starts: int = bounded(2000, 0, 10**9)
    env_steps_per_gradient_step: float = bounded(16.0, 0.01, 1e6)
    batch_size: int = bounded(128, 1, 65_536)
    lr_decay_start: float = bounded(0.6, 0.0, 1.0)
    width: int = bounded(64, 16, 1024)  # of what the network keeps of an arm; a multiple of 16
    rounds: int = bounded(6, 0, 64)  # of messages between arms, all by the same layers; 0: every arm for itself
    slack: bool = True  # whether it is told how far an angle is inside what lets the next arm finish
    mixture_components: int = bounded(4, 1, 64)  # places an interval of hand-over angles, chosen between like the other branches
    candidates: int = bounded(
        6, 1, 256
    )  # places an interval tried anywhere, and as many nearby; the actor is drawn to the nearest better one
    candidate_share: float = bounded(1.0, 0.0, 1.0)  # of the intervals of a batch
    candidate_weight: float = bounded(2.0, 0.0, 1e6)
    candidate_margin: float = bounded(0.15, -1e6, 1e6)  # in units of scaled reward
    finish_weight: float = bounded(0.2, 0.0, 1e6)  # of the critic of finishing beside that of handing over
    temperature_start: float = bounded(0.3, 1e-9, 1e3)  # of the choice between branches, in units of scaled reward; falls linearly ...
    temperature_end: float = bounded(0.03, 1e-9, 1e3)
    place_temperature: float = bounded(0.02, 0.0, 1e3)
    random_place: float = bounded(0.1, 0.0, 1.0)  # share of exploration's places that are drawn anywhere
    deterministic_env_fraction: float = bounded(0.25, 0.0, 1.0)  # of the cells, which follow the likeliest branch
    layouts_at_once: int = bounded(1024, 1, 10**6)  # random cells that episodes are drawn from ...
    layouts_interval: int = bounded(16_384, 1, 10**9)  # ... and environment steps after which as many others take their place

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        super().validate()
        if self.width % 16:
            raise InvalidSetting("algorithm.width", self.width, "a multiple of 16")
        if self.layout != "graph":
            raise InvalidSetting("algorithm.layout", self.layout, "'graph' for algorithm=graph_sac")


@dataclass
class HindsightConfig:
    """Relabelling of sampled transitions; every relabelled transition is a true one of the problem, under noise as often as it would be.

    But for goals from later in an episode where noise is not the task's own (physics), or arms take turns: these know where it went.
    """

    strategy: str = chosen("future", HINDSIGHT)  # none, final, future or episode: which later poses of the episode become goals
    ratio: float = bounded(0.5, 0.0, 1.0)  # share of transitions that get a hindsight goal
    near_miss_ratio: float = bounded(0.25, 0.0, 1.0)  # share of the hindsight goals that are turned, to show where success ends
    near_miss_epsilons: float = bounded(1.5, 0.0, 1000.0)  # by up to so many epsilons either way
    random_ratio: float = bounded(0.15, 0.0, 1.0)  # share that get another transition's goal; true: a hand-over does not depend on the goal


@dataclass
class ReplayConfig:
    """Replay memory."""

    capacity: int = bounded(100_000, 1, 10**7)
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    symmetry: bool = False  # mirror sampled transitions by a random element of the group of four
    correct_terminated: bool = True  # False keeps the stored end flag when relabelling, as Stable-Baselines3 does


ALGORITHMS: Registry[type[AlgorithmConfig]] = Registry(
    "algorithm",
    {
        "sac": "marl_handover.learning.hybrid_sac:SacConfig",
        "graph_sac": "marl_handover.learning.graph_sac:GraphSacConfig",
        "flat_sac": "marl_handover.baselines.flat_sac:FlatSacConfig",
        "td3": "marl_handover.baselines.td3:Td3Config",
        "ppo": "marl_handover.baselines.ppo:PpoConfig",
        "dqn": "marl_handover.baselines.dqn:DqnConfig",
    },
)
"""Settings of each algorithm by name; :func:`marl_handover.learning.algorithm.register_algorithm` adds one, with its learner."""

VARIANTS: dict[str, Collection[str]] = {"hierarchical": ALGORITHMS, "centralised": ("sac", "flat_sac"), "decentralised": ("sac",)}
"""Formulations, and the algorithms that each has learners for."""

SOURCES = ("batched", "aec")
EXECUTORS = ("direct", "optimised")
COLLECTORS = ("local", "multiprocess", "ray")

MOST_BYTES, MOST_WEIGHTS, MOST_ACTIVATIONS = 500 * 10**6, 8 * 10**6, 64 * 10**6
"""Of a replay memory, of one network, and of one layer's output for one batch; a training takes several times each."""


@dataclass
class TrainConfig:
    """A training run."""

    cell: CellConfig = field(default_factory=CellConfig)
    layouts: list[LayoutConfig] = sized(list, 0, 100)  # of algorithm=graph_sac: random cells of these kinds instead of the one cell
    task: TaskConfig = field(default_factory=TaskConfig)
    algorithm: AlgorithmConfig = field(default_factory=SacConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    epsilon_deg: float | None = bounded(None, *EPSILON_DEG)  # train down to this accuracy and validate at it; null: as the stages have it
    curriculum: list[StageConfig] = sized(wide_first, 1, 100)
    variant: str = chosen("hierarchical", tuple(VARIANTS))  # hierarchical, centralised or decentralised
    centralised: CentralisedConfig = field(default_factory=CentralisedConfig)
    decentralised: DecentralisedConfig = field(default_factory=DecentralisedConfig)
    source: str = chosen("batched", SOURCES)  # of transitions: batched (the rule book itself), or aec (the PettingZoo environment)
    backend: str = chosen("kinematic", BACKENDS.without("twin", "hardware"))  # of source=aec: kinematic, noisy, bullet or mujoco
    executor: str = chosen("direct", EXECUTORS)  # of source=aec: direct (straight in joint space), or optimised (collision-free)
    collector: str = chosen("local", COLLECTORS)  # of source=aec: local, multiprocess or ray
    workers: int = bounded(2, 1, 256)  # of collector=multiprocess and ray
    steps: int = bounded(32_000, 1, 10**9)  # commanded transfers, over all cells
    num_envs: int = bounded(64, 1, 65_536)
    seed: int = seed_field()
    device: str = "cpu"  # cpu, cuda, cuda:N
    threads: int = bounded(1, 1, 256)  # of torch on the CPU; networks this small gain nothing from more
    compile: str = chosen("auto", ("auto", "on", "off"))  # auto, on, off: torch.compile of the losses
    out: str = path_field()  # run directory; runs/<date>-<time> if empty
    resume: str = path_field()  # run directory to continue
    evaluation_interval: int = bounded(4_000, 1, 10**9)  # environment steps
    evaluation_episodes: int = bounded(2_000, 1, 10**6)
    checkpoint_interval: int = bounded(8_000, 1, 10**9)  # environment steps
    progress: bool = True

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self)
        if self.epsilon_deg is not None:
            if self.task.epsilon_deg not in (TaskConfig().epsilon_deg, self.epsilon_deg):
                raise InvalidSetting("task.epsilon_deg", self.task.epsilon_deg, f"left out, or epsilon_deg = {self.epsilon_deg:g}")
            self.task.epsilon_deg = self.epsilon_deg
            self.curriculum = down_to(self.epsilon_deg, self.curriculum)
        if self.task.layout not in (TaskConfig().layout, self.algorithm.layout):
            raise InvalidSetting("task.layout", self.task.layout, "left alone in training; the learner's layout is algorithm.layout")
        self.task.layout = self.algorithm.layout
        if self.task.previous_arm not in (TaskConfig().previous_arm, self.algorithm.previous_arm):
            raise InvalidSetting("task.previous_arm", self.task.previous_arm, "left alone in training; use algorithm.previous_arm")
        self.task.previous_arm = self.algorithm.previous_arm
        self.task.validate()
        require_choice(f"algorithm of variant={self.variant}", self.algorithm.name, tuple(VARIANTS[self.variant]))
        require_at_least("replay.capacity", self.replay.capacity, self.task.max_steps * self.num_envs)
        for index, stage in enumerate(self.curriculum):
            require_at_least(f"curriculum[{index}].epsilon_high_deg", stage.epsilon_high_deg, stage.epsilon_low_deg)
        self.algorithm.validate()
        if self.algorithm.name == "sac" and self.algorithm.layout != "relative":
            raise InvalidSetting("algorithm.layout", self.algorithm.layout, "'relative' for algorithm=sac; flat_sac takes any layout")
        self.centralised.validate()
        if self.variant == "centralised":
            self._validate_centralised()
        self.decentralised.validate()
        if self.variant == "decentralised":
            self._validate_decentralised()
        self._validate_layouts()
        self._validate_source()
        self._refuse_idle()
        self._refuse_large()

    def _validate_layouts(self) -> None:
        """What a learner of any cell cannot do, and what no other does."""
        for layouts in self.layouts:
            layouts.validate()
        if not isinstance(self.algorithm, GraphSacConfig):
            if self.layouts:
                raise InvalidSetting("layouts", len(self.layouts), "left out, or algorithm=graph_sac")
            return
        noise = self.task.noise
        limits: tuple[tuple[str, Any, Any, str], ...] = (
            ("task.architecture", self.task.architecture, "B", "whose policy acts under A, too"),
            ("task.symmetry_order", self.task.symmetry_order, 1, "whose policy takes blocks of any symmetry"),
            ("source", self.source, "batched", "the rule book itself"),
            ("replay.symmetry", self.replay.symmetry, False, "whose cells have no mirror image of their own"),
            ("replay.correct_terminated", self.replay.correct_terminated, True, "which derives it"),
            ("task.reward.motion_weight", self.task.reward.motion_weight, 0.0, "whose paths have no price"),
            ("task.noise", noise.observed or noise.position_mm > 0 or noise.yaw_deg > 0, False, "which learns on exact arms"),
        )
        for name, value, only, reason in limits:
            if value != only:
                raise InvalidSetting(name, value, f"{only} with algorithm=graph_sac, {reason}")

    def _refuse_large(self) -> None:
        """Raise :class:`InvalidSetting` for settings that are moderate each, and together take more memory than a training needs."""
        numbers = 30 + (16 * self.centralised.control_points if self.variant == "centralised" else 0)
        rows = MOST_BYTES // (4 * numbers)
        if self.replay.capacity > rows:
            raise InvalidSetting("replay.capacity", self.replay.capacity, f"at most {rows}, which take {MOST_BYTES // 10**6} MB")
        for key, widths in vars(self.algorithm).items():
            if not isinstance(widths, list):
                continue
            weights = sum(a * b for a, b in itertools.pairwise(widths))
            if weights > MOST_WEIGHTS:
                raise InvalidSetting(f"algorithm.{key}", widths, f"smaller: {weights} weights between its layers, at most {MOST_WEIGHTS}")
            tried = 1 + 2 * getattr(self.algorithm, "candidates", 0)
            for name, count in (
                ("algorithm.batch_size", tried * self.algorithm.batch_size),
                ("evaluation_episodes", self.evaluation_episodes),
            ):
                if count * max(widths, default=1) > MOST_ACTIVATIONS:
                    limit = f"smaller: {count} rows through algorithm.{key} = {widths} are more than {MOST_ACTIVATIONS} numbers"
                    raise InvalidSetting(name, count, limit)

    def _validate_centralised(self) -> None:
        """What that variant cannot do."""
        limits = (
            ("task.architecture", self.task.architecture, "B", "whose policy moves the last time too"),
            ("task.reward.motion_weight", self.task.reward.motion_weight, 0.0, "whose paths have no price"),
            ("replay.symmetry", self.replay.symmetry, False, "whose memory does not mirror motions"),
        )
        for name, value, only, reason in limits:
            if value != only:
                raise InvalidSetting(name, value, f"{only} with variant=centralised, {reason}")

    def _refuse_idle(self) -> None:
        """Raise :class:`InvalidSetting` for a setting that was changed where nothing reads it."""
        for name, own in (("centralised", self.centralised), ("decentralised", self.decentralised)):
            if self.variant != name:
                for key, value in changed(name, own):
                    raise InvalidSetting(key, value, f"left out without variant={name}")
        if self.collector == "local" and self.workers != TrainConfig().workers:
            raise InvalidSetting("workers", self.workers, "left out without collector=multiprocess or ray")

    def _validate_decentralised(self) -> None:
        """What that variant cannot do, or does not need."""
        self.decentralised.validate_task(self.task)
        noise = self.task.noise
        limits: tuple[tuple[str, Any, Any], ...] = (
            ("source", self.source, "batched"),
            ("replay.correct_terminated", self.replay.correct_terminated, True),
            ("task.noise.observed_mm", noise.observed_mm, 0.0),  # its learners see the memory's poses as they are
            ("task.noise.observed_deg", noise.observed_deg, 0.0),
        )
        for name, value, only in limits:
            if value != only:
                raise InvalidSetting(name, value, f"{only} with variant=decentralised")
        decisions = self.decentralised.decisions_per_transfer * self.task.max_steps
        require_at_least("replay.capacity", self.replay.capacity, decisions * self.num_envs)
        if self.decentralised.learners == "independent" and self.algorithm.batch_size % 2:
            raise InvalidSetting("algorithm.batch_size", self.algorithm.batch_size, "even, half for each of two independent learners")

    def _validate_source(self) -> None:
        """What the AEC environment cannot do, and what nothing else does."""
        if self.source == "batched":
            usual = TrainConfig()
            for name in ("backend", "executor", "collector"):
                if getattr(self, name) != getattr(usual, name):
                    raise InvalidSetting(name, getattr(self, name), f"{getattr(usual, name)}, unless source=aec")
            return
        if self.variant != "hierarchical":
            raise InvalidSetting("source", self.source, f"batched with variant={self.variant}")
        if not isinstance(self.algorithm, OffPolicyConfig):
            raise InvalidSetting("source", self.source, f"batched with algorithm={self.algorithm.name}, which has no replay memory")
        noise = self.task.noise
        if noise.observed or (self.backend != "noisy" and (noise.position_mm > 0 or noise.yaw_deg > 0)):
            raise InvalidSetting("task.noise", noise, "none with source=aec, but for that of placements with backend=noisy")
        if self.backend in PHYSICS and self.executor == "direct":
            raise InvalidSetting("executor", self.executor, f"optimised with backend={self.backend}, where arms touch things")

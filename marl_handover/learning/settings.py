"""Settings of training, one home for each default. Names of settings are names of modules: ``hindsight`` is ``replay.py``'s, and so on."""

from __future__ import annotations

from dataclasses import dataclass, field

from marl_handover.config import (
    HINDSIGHT,
    CellConfig,
    TaskConfig,
    require_at_least,
    require_between,
    require_choice,
    require_positive,
    require_seed,
)
from marl_handover.errors import InvalidSetting


@dataclass
class HindsightConfig:
    """Relabelling of sampled transitions; every relabelled transition is a true one of the problem."""

    strategy: str = "future"  # none, final, future or episode: which later poses of the episode become goals
    ratio: float = 0.5  # share of transitions that get a hindsight goal
    near_miss_ratio: float = 0.25  # share of the hindsight goals that are turned, to show where success ends
    near_miss_epsilons: float = 1.5  # by up to so many epsilons either way
    random_ratio: float = 0.15  # share that get another transition's goal; true because a hand-over does not depend on the goal


@dataclass
class ReplayConfig:
    """Replay memory."""

    capacity: int = 100_000
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)
    symmetry: bool = False  # mirror sampled transitions by a random element of the group of four
    correct_terminated: bool = True  # False keeps the stored end flag when relabelling, as Stable-Baselines3 does


@dataclass
class StageConfig:
    """One stage of the curriculum: each episode's epsilon is drawn log-uniformly from [low, high]."""

    epsilon_low_deg: float = 5.0
    epsilon_high_deg: float = 5.0
    until_step: int = 0  # environment step that ends the stage; 0 = the end of training
    until_success: float = 1.0  # a success rate in evaluation that ends it earlier; 1 = never


@dataclass
class AlgorithmConfig:
    """What every algorithm has."""

    name: str = ""
    layout: str = "relative"  # observation layout
    learning_rate: float = 1e-3
    decay_from: float = 0.5  # fraction of training after which the learning rate falls linearly to zero
    gamma: float = 0.95
    reward_scale: float = 0.5
    batch_size: int = 256

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits."""
        for name in ("learning_rate", "gamma", "reward_scale", "batch_size"):
            require_positive(f"algorithm.{name}", getattr(self, name))
        for name in ("gamma", "decay_from"):
            require_between(f"algorithm.{name}", getattr(self, name), 0, 1)
        for name in ("hidden", "actor_hidden", "critic_hidden", "final_hidden"):
            for width in getattr(self, name, []):
                require_at_least(f"algorithm.{name}", width, 1)
        if self.layout == "object":
            raise InvalidSetting("algorithm.layout", self.layout, "'raw' or 'relative'; 'object' hides the goal")


@dataclass
class OffPolicyConfig(AlgorithmConfig):
    """What every algorithm with a replay memory has."""

    learning_starts: int = 1000  # environment steps with uniform actions, before the first update
    steps_per_update: float = 8.0  # environment steps for each gradient step
    tau: float = 0.01  # target smoothing

    def validate(self) -> None:
        """As the base class, and the replay's pace."""
        super().validate()
        require_positive("algorithm.steps_per_update", self.steps_per_update)
        require_at_least("algorithm.learning_starts", self.learning_starts, 0)
        require_between("algorithm.tau", self.tau, 0, 1)


@dataclass
class SacConfig(OffPolicyConfig):
    """Hybrid SAC: exact expectation over (arm, final, place mode), tanh-Gaussian places, two temperatures."""

    name: str = "sac"
    actor_hidden: list[int] = field(default_factory=lambda: [128, 128])
    critic_hidden: list[int] = field(default_factory=lambda: [128, 128])
    final_hidden: list[int] = field(default_factory=lambda: [64, 64])  # of the critic of finishing
    modes: int = 1  # place distributions an arm, chosen between like the other discrete branches
    canonical: bool = True  # fold the mirror symmetry M_x into the networks
    harmonics: int = 2  # doublings of the angles that the networks see
    candidates: int = 3  # places an arm tried anywhere, and as many nearby; the actor's mean is drawn to the nearest clearly better one
    candidate_share: float = 0.5  # of the batch
    candidate_weight: float = 1.0
    candidate_margin: float = 0.25  # in units of scaled reward
    greedy_share: float = 0.25  # of the cells, which act without noise
    random_place: float = 0.1  # share of exploration's places that are drawn anywhere
    place_entropy_start: float = -2.0  # target entropies fall from start (linearly / geometrically) ...
    place_entropy_end: float = -5.0
    branch_entropy_start: float = 0.1
    branch_entropy_end: float = 0.01
    entropy_until: float = 0.75  # ... to end at this fraction of training
    temperature_rate: float = 3e-3
    initial_temperature: float = 0.1

    def validate(self) -> None:
        """As the base class, and what only this algorithm has."""
        super().validate()
        require_at_least("algorithm.modes", self.modes, 1)
        for name in ("harmonics", "candidates", "candidate_weight"):
            require_at_least(f"algorithm.{name}", getattr(self, name), 0)
        for name in ("candidate_share", "greedy_share", "random_place"):
            require_between(f"algorithm.{name}", getattr(self, name), 0, 1)
        for name in ("branch_entropy_start", "branch_entropy_end", "entropy_until", "temperature_rate", "initial_temperature"):
            require_positive(f"algorithm.{name}", getattr(self, name))


@dataclass
class BoxSacConfig(OffPolicyConfig):
    """SAC with all four action numbers in one squashed Gaussian, thresholded by the environment, as in the paper."""

    name: str = "box_sac"
    learning_rate: float = 5e-4
    hidden: list[int] = field(default_factory=lambda: [256, 256])


@dataclass
class Td3Config(OffPolicyConfig):
    """TD3 on the boxed action."""

    name: str = "td3"
    learning_rate: float = 5e-4
    hidden: list[int] = field(default_factory=lambda: [256, 256])
    policy_delay: int = 2
    exploration_std: float = 0.3
    random_action: float = 0.2  # share of exploration actions drawn uniformly
    target_noise: float = 0.1

    def validate(self) -> None:
        """As the base class, and what only this algorithm has."""
        super().validate()
        require_at_least("algorithm.policy_delay", self.policy_delay, 1)
        require_between("algorithm.random_action", self.random_action, 0, 1)
        for name in ("exploration_std", "target_noise"):
            require_at_least(f"algorithm.{name}", getattr(self, name), 0)


@dataclass
class PpoConfig(AlgorithmConfig):
    """PPO with a clipped objective on the boxed action; on-policy, so no replay and no hindsight."""

    name: str = "ppo"
    learning_rate: float = 5e-4
    batch_size: int = 512
    rollout_steps: int = 32  # environment steps a cell between updates
    epochs: int = 4
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.003
    max_grad_norm: float = 0.5
    hidden: list[int] = field(default_factory=lambda: [256, 256])

    def validate(self) -> None:
        """As the base class, and what only this algorithm has."""
        super().validate()
        for name in ("rollout_steps", "epochs"):
            require_at_least(f"algorithm.{name}", getattr(self, name), 1)
        for name in ("clip", "max_grad_norm"):
            require_positive(f"algorithm.{name}", getattr(self, name))
        require_between("algorithm.gae_lambda", self.gae_lambda, 0, 1)
        require_at_least("algorithm.entropy", self.entropy, 0)


VARIANTS = ("hierarchical", "centralised", "decentralised")
SOURCES = ("batched", "aec")
COLLECTORS = ("local", "multiprocess", "ray")
ALGORITHMS: dict[str, type[AlgorithmConfig]] = {"sac": SacConfig, "box_sac": BoxSacConfig, "td3": Td3Config, "ppo": PpoConfig}


@dataclass
class TrainConfig:
    """A training run."""

    cell: CellConfig = field(default_factory=CellConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    algorithm: AlgorithmConfig = field(default_factory=SacConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    curriculum: list[StageConfig] = field(default_factory=lambda: [StageConfig(0.7, 12.0)])
    variant: str = "hierarchical"  # hierarchical, centralised or decentralised
    source: str = "batched"  # of transitions: batched (the rule book itself), or aec (the PettingZoo environment, executors and all)
    backend: str = "kinematic"  # of source=aec: kinematic, noisy or bullet
    collector: str = "local"  # of source=aec: local, multiprocess or ray
    workers: int = 2  # of collector=multiprocess and ray
    steps: int = 48_000  # commanded transfers, over all cells
    num_envs: int = 64
    seed: int = 0
    device: str = "cpu"  # cpu, cuda, cuda:N
    threads: int = 1  # of torch on the CPU; networks this small gain nothing from more
    compile: str = "auto"  # auto, on, off: torch.compile of the losses
    out: str = ""  # run directory; runs/<date>-<time> if empty
    resume: str = ""  # run directory to continue
    evaluation_interval: int = 4_000  # environment steps
    evaluation_episodes: int = 2_000
    checkpoint_interval: int = 8_000  # environment steps
    progress: bool = True

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        if self.task.layout not in (TaskConfig().layout, self.algorithm.layout):
            raise InvalidSetting("task.layout", self.task.layout, "left alone in training; the learner's layout is algorithm.layout")
        self.task.layout = self.algorithm.layout
        self.task.validate()
        require_choice("variant", self.variant, VARIANTS)
        require_choice("source", self.source, SOURCES)
        require_choice("collector", self.collector, COLLECTORS)
        require_choice("compile", self.compile, ("auto", "on", "off"))
        require_choice("replay.hindsight.strategy", self.replay.hindsight.strategy, HINDSIGHT)
        require_between("replay.hindsight.ratio", self.replay.hindsight.ratio, 0, 1)
        require_between("replay.hindsight.near_miss_ratio", self.replay.hindsight.near_miss_ratio, 0, 1)
        require_at_least("replay.hindsight.near_miss_epsilons", self.replay.hindsight.near_miss_epsilons, 0)
        require_between("replay.hindsight.random_ratio", self.replay.hindsight.random_ratio, 0, 1)
        for name in ("steps", "num_envs", "workers", "threads", "evaluation_interval", "evaluation_episodes", "checkpoint_interval"):
            require_at_least(name, getattr(self, name), 1)
        require_at_least("replay.capacity", self.replay.capacity, self.task.max_steps * self.num_envs)
        require_at_least("curriculum (number of stages)", len(self.curriculum), 1)
        for index, stage in enumerate(self.curriculum):
            require_positive(f"curriculum[{index}].epsilon_low_deg", stage.epsilon_low_deg)
            require_at_least(f"curriculum[{index}].epsilon_high_deg", stage.epsilon_high_deg, stage.epsilon_low_deg)
        require_seed(self.seed)
        self.algorithm.validate()

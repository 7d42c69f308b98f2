"""Settings of the algorithms, one home for each default."""

from __future__ import annotations

from dataclasses import dataclass, field

from marl_handover.config import EXPLORATIONS, require_at_least, require_between, require_choice, require_positive
from marl_handover.errors import InvalidSetting


@dataclass
class AlgorithmConfig:
    """What every algorithm has."""

    name: str = ""
    layout: str = "relative"  # observation layout
    previous_arm: bool = True  # whether observations say which arm moved last
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
    exploration: str = "chart"  # what uniform places are uniform in: chart (alpha and beta), or area (of the table)
    steps_per_update: float = 8.0  # environment steps for each gradient step
    tau: float = 0.01  # target smoothing

    def validate(self) -> None:
        """As the base class, and the replay's pace."""
        super().validate()
        require_choice("algorithm.exploration", self.exploration, EXPLORATIONS)
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


@dataclass
class DqnConfig(OffPolicyConfig):
    """Double DQN over a grid of places: the discretised predecessor, reconstructed from the paper's few words about it."""

    name: str = "dqn"
    layout: str = "raw"
    learning_rate: float = 5e-4
    hidden: list[int] = field(default_factory=lambda: [256, 256])
    grid_mm: float = 20.0  # spacing of the places
    random_start: float = 1.0  # share of random decisions, falling linearly from start ...
    random_end: float = 0.05
    random_until: float = 0.5  # ... to end at this fraction of training
    shaping: float = 0.0  # reward for coming half a turn nearer to an orientation that an arm can finish with; potential-based
    finishing_first: int = 0  # of architecture B: gradient steps that only train when to finish, before all others

    def validate(self) -> None:
        """As the base class, and what only this algorithm has."""
        super().validate()
        require_positive("algorithm.grid_mm", self.grid_mm)
        require_positive("algorithm.random_until", self.random_until)
        for name in ("random_start", "random_end"):
            require_between(f"algorithm.{name}", getattr(self, name), 0, 1)
        for name in ("shaping", "finishing_first"):
            require_at_least(f"algorithm.{name}", getattr(self, name), 0)
        if self.exploration != "chart":
            raise InvalidSetting("algorithm.exploration", self.exploration, "'chart' for algorithm=dqn, whose grid is even on the table")


ALGORITHMS: dict[str, type[AlgorithmConfig]] = {
    "sac": SacConfig,
    "box_sac": BoxSacConfig,
    "td3": Td3Config,
    "ppo": PpoConfig,
    "dqn": DqnConfig,
}

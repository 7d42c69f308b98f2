"""Settings of the algorithms, one home for each default."""

from __future__ import annotations

from dataclasses import dataclass

from marl_handover.config import EXPLORATIONS, LAYOUTS, bounded, check_bounds, chosen
from marl_handover.errors import InvalidSetting


@dataclass
class AlgorithmConfig:
    """What every algorithm has."""

    name: str = ""
    layout: str = chosen("relative", LAYOUTS)  # observation layout
    previous_arm: bool = True  # whether observations say which arm moved last
    learning_rate: float = bounded(1e-3, 1e-8, 10.0)
    decay_from: float = bounded(0.5, 0.0, 1.0)  # fraction of training after which the learning rate falls linearly to zero
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
    steps_per_update: float = bounded(8.0, 0.01, 1e6)  # environment steps for each gradient step
    tau: float = bounded(0.01, 0.0, 1.0)  # target smoothing


@dataclass
class SacConfig(OffPolicyConfig):
    """Hybrid SAC: exact expectation over (arm, final, place mode), tanh-Gaussian places, two temperatures."""

    name: str = "sac"
    actor_hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))  # places are harder to say than to judge
    critic_hidden: list[int] = bounded([128, 128], 1, 4096, (0, 8))
    final_hidden: list[int] = bounded([64, 64], 1, 4096, (0, 8))  # of the critic of finishing
    actor_tau: float = bounded(0.005, 0.0, 1.0)  # smoothing of the actor that is judged and kept; 1: none
    modes: int = bounded(1, 1, 64)  # place distributions an arm, chosen between like the other discrete branches
    canonical: bool = True  # fold the mirror symmetry M_x into the networks
    harmonics: int = bounded(2, 0, 16)  # doublings of the angles that the networks see
    candidates: int = bounded(3, 0, 256)  # places an arm tried anywhere, and as many nearby; the actor is drawn to the nearest better one
    candidate_share: float = bounded(0.5, 0.0, 1.0)  # of the batch
    candidate_weight: float = bounded(1.0, 0.0, 1e6)
    candidate_margin: float = bounded(0.25, -1e6, 1e6)  # in units of scaled reward
    greedy_share: float = bounded(0.25, 0.0, 1.0)  # of the cells, which act without noise
    random_place: float = bounded(0.1, 0.0, 1.0)  # share of exploration's places that are drawn anywhere
    place_entropy_start: float = bounded(-2.0, -100.0, 100.0)  # target entropies fall from start (linearly / geometrically) ...
    place_entropy_end: float = bounded(-5.0, -100.0, 100.0)
    branch_entropy_start: float = bounded(0.1, 1e-9, 10.0)
    branch_entropy_end: float = bounded(0.01, 1e-9, 10.0)
    entropy_until: float = bounded(0.75, 1e-6, 1000.0)  # ... to end at this fraction of training
    temperature_rate: float = bounded(3e-3, 1e-9, 10.0)
    initial_temperature: float = bounded(0.1, 1e-9, 1e3)


@dataclass
class BoxSacConfig(OffPolicyConfig):
    """SAC with all four action numbers in one squashed Gaussian, thresholded by the environment, as in the paper."""

    name: str = "box_sac"
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))


@dataclass
class Td3Config(OffPolicyConfig):
    """TD3 on the boxed action."""

    name: str = "td3"
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))
    policy_delay: int = bounded(2, 1, 1000)
    exploration_std: float = bounded(0.3, 0.0, 10.0)
    random_action: float = bounded(0.2, 0.0, 1.0)  # share of exploration actions drawn uniformly
    target_noise: float = bounded(0.1, 0.0, 10.0)


@dataclass
class PpoConfig(AlgorithmConfig):
    """PPO with a clipped objective on the boxed action; on-policy, so no replay and no hindsight."""

    name: str = "ppo"
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    batch_size: int = bounded(512, 1, 65_536)
    rollout_steps: int = bounded(32, 1, 4096)  # environment steps a cell between updates
    epochs: int = bounded(4, 1, 1000)
    gae_lambda: float = bounded(0.95, 0.0, 1.0)
    clip: float = bounded(0.2, 1e-6, 1e3)
    entropy: float = bounded(0.003, 0.0, 1e3)
    max_grad_norm: float = bounded(0.5, 1e-9, 1e9)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))


@dataclass
class DqnConfig(OffPolicyConfig):
    """Double DQN over a grid of places: the discretised predecessor, reconstructed from the paper's few words about it."""

    name: str = "dqn"
    layout: str = chosen("raw", LAYOUTS)
    learning_rate: float = bounded(5e-4, 1e-8, 10.0)
    hidden: list[int] = bounded([256, 256], 1, 4096, (0, 8))
    grid_mm: float = bounded(20.0, 2.0, 200.0)  # spacing of the places
    random_start: float = bounded(1.0, 0.0, 1.0)  # share of random decisions, falling linearly from start ...
    random_end: float = bounded(0.05, 0.0, 1.0)
    random_until: float = bounded(0.5, 1e-6, 1000.0)  # ... to end at this fraction of training
    shaping: float = bounded(0.0, 0.0, 1e6)  # potential-based reward for half a turn towards an orientation an arm can finish with
    finishing_first: int = bounded(0, 0, 10**9)  # of architecture B: gradient steps that only train when to finish, before all others

    def validate(self) -> None:
        """As the base class, and what only this algorithm has."""
        super().validate()
        if self.exploration != "chart":
            raise InvalidSetting("algorithm.exploration", self.exploration, "'chart' for algorithm=dqn, whose grid is even on the table")


ALGORITHMS: dict[str, type[AlgorithmConfig]] = {
    "sac": SacConfig,
    "box_sac": BoxSacConfig,
    "td3": Td3Config,
    "ppo": PpoConfig,
    "dqn": DqnConfig,
}

"""Typed settings. Every default of the package lives here, once; ``configs/*.yaml`` hold named differences only.

Lengths are in mm, angles in the unit of the name's suffix.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from marl_handover.errors import InvalidSetting, UnknownChoice

ARCHITECTURES = ("A", "B")
LAYOUTS = ("raw", "relative", "object")
MOTION_METHODS = ("optimised", "paper")
EXPLORATIONS = ("chart", "area")
LEARNERS = ("independent", "shared", "ctde")
CENTRALISED_MOTIONS = ("flat", "offset")
HINDSIGHT = ("none", "final", "future", "episode")


@dataclass
class BlockConfig:
    """The object: a square block with an upright pin in its centre, by which it is held."""

    side_mm: float = 40.0
    height_mm: float = 15.0
    pin_diameter_mm: float = 2.5
    pin_top_mm: float = 65.0
    marker_mm: float = 30.0


def _paper_limits() -> dict[str, list[float]]:
    """Joint limits for which the 5 mm grid fits the paper's annulus: the elbow's upper stop gives r_max, the wrist's r_min."""
    return {
        "base_yaw": [-90.0, 90.0],
        "shoulder": [-14.0, 150.0],
        "elbow": [-168.0, -108.5],
        "wrist_pitch": [-95.0, 95.0],
        "wrist_roll": [-90.0, 90.0],
    }


@dataclass
class CellConfig:
    """Two mirrored arms of one URDF around a shared piece of table; the defaults are the paper's cell."""

    name: str = "paper"
    urdf: str = "al5a.urdf"  # a path, or the name of a file in urdf/
    grasp_link: str = "grip"
    base_distance_mm: float = 360.0
    pick_height_mm: float = 45.0
    joint_limits_deg: dict[str, list[float]] = field(default_factory=_paper_limits)  # replace the URDF's own, joint by joint
    grid_mm: float = 5.0
    fit_rounding_mm: float = 1.0  # the fitted radii are rounded inwards to a multiple of this; 0 keeps them as they are
    chart_inset: float = 1.0  # part of the chart that is used: 1 = all, 0.95 leaves room for placement noise
    block: BlockConfig = field(default_factory=BlockConfig)


@dataclass
class RewardConfig:
    """Rewards of architecture B (the paper's r_B), and the weight of the coupled motion reward of its eq. (3)."""

    success: float = 20.0
    step: float = -1.0
    failure: float = -30.0
    motion_weight: float = 0.0  # reward -= motion_weight * path cost [mm] / 100


@dataclass
class NoiseConfig:
    """Noise of the batched rules, standard deviations per axis: of every placement, and of where the supervisor sees the object."""

    position_mm: float = 0.0
    yaw_deg: float = 0.0
    observed_mm: float = 0.0  # the supervisor sees the object displaced by so much; what is done and judged is the truth
    observed_deg: float = 0.0

    @property
    def observed(self) -> bool:
        """Whether the supervisor sees anything but the truth."""
        return self.observed_mm > 0 or self.observed_deg > 0

    def report(self) -> dict[str, float]:
        """For results: the noise of placements, and that of observations where there is any."""
        return {name: value for name, value in asdict(self).items() if self.observed or not name.startswith("observed")}


@dataclass
class TaskConfig:
    """The decision problem."""

    architecture: str = "B"
    epsilon_deg: float = 5.0  # allowed orientation error
    max_steps: int = 20
    symmetry_order: int = 1  # k: the block looks the same when turned by 360/k degrees
    layout: str = "relative"
    previous_arm: bool = True  # whether observations say which arm moved last
    position_tolerance_mm: float = 5.0  # "at the goal" after a noisy final placement
    reward: RewardConfig = field(default_factory=RewardConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        require_choice("architecture", self.architecture, ARCHITECTURES)
        require_choice("layout", self.layout, LAYOUTS)
        require_positive("epsilon_deg", self.epsilon_deg)
        require_positive("position_tolerance_mm", self.position_tolerance_mm)
        require_at_least("max_steps", self.max_steps, 1)
        require_at_least("symmetry_order", self.symmetry_order, 1)
        for name, value in asdict(self.noise).items():
            require_at_least(f"noise.{name}", value, 0)
        require_at_least("reward.motion_weight", self.reward.motion_weight, 0)
        for name in ("success", "step", "failure"):
            require_between(f"reward.{name}", getattr(self.reward, name), -1e6, 1e6)


@dataclass
class MotionConfig:
    """How an arm moves: clearances, the way over the table, limits of speed. Facts and reasons: docs of ``marl_handover.motion``."""

    parked_deg: list[float] = field(default_factory=lambda: [0.0, 140.0, -115.0, 70.0, 0.0])  # upright, clear of the shared space
    arm_clearance_mm: float = 5.0  # between the moving arm, with what it carries, and the other one
    ground_clearance_mm: float = 2.0
    self_clearance_mm: float = 2.0  # between bodies of one arm that are not neighbours, and what it carries
    block_clearance_mm: float = 1.0  # between an empty hand and the block or its pin
    lift_mm: float = 40.0  # how high the block travels above the pick height, far from both ends
    lift_scale_mm: float = 25.0  # how fast, in horizontal distance from an end, that height is asked for; shorter ways: all in scale
    approach_scale_mm: float = 10.0  # the same for an empty hand that comes to the pin or leaves it
    method: str = "optimised"  # of the loaded hand's path: optimised, or paper: its literal formulation with SLSQP, for comparison
    control_points: int = 11  # of each path's spline
    degree: int = 5
    starts: int = 16  # first guesses tried at most
    velocity_share: float = 0.8  # of the URDF's joint velocities
    acceleration_deg_s2: float = 800.0
    sample_s: float = 0.02  # a timed trajectory is written at this interval
    finger_travel_mm: float = 12.0  # how far each finger opens before it closes on the pin
    grasp_s: float = 0.4  # closing the fingers
    release_s: float = 0.3  # opening them

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        for name in ("arm_clearance_mm", "ground_clearance_mm", "self_clearance_mm", "block_clearance_mm", "lift_mm"):
            require_at_least(f"motion.{name}", getattr(self, name), 0)
        for name in ("lift_scale_mm", "approach_scale_mm", "acceleration_deg_s2", "grasp_s", "release_s", "finger_travel_mm"):
            require_positive(f"motion.{name}", getattr(self, name))
        require_choice("motion.method", self.method, MOTION_METHODS)
        require_between("motion.sample_s", self.sample_s, 1e-3, 0.02)
        require_between("motion.velocity_share", self.velocity_share, 0.01, 1)
        require_between("motion.degree", self.degree, 3, 7)
        if self.method == "paper" and self.degree != 5:
            raise InvalidSetting("motion.degree", self.degree, "5 with motion.method=paper, as the paper has it")
        require_between("motion.control_points", self.control_points, self.degree + 2, 25)
        require_at_least("motion.starts", self.starts, 1)
        angles = self.parked_deg
        if len(angles) != 5 or not all(math.isfinite(angle) for angle in angles) or angles[4] != 0:
            raise InvalidSetting("motion.parked_deg", angles, "five finite angles in degrees, the last one, of the wrist roll, 0")


@dataclass
class CentralisedConfig:
    """The motions that a centralised policy makes itself: the paper's splines, their inner control points given by numbers."""

    motion: str = "offset"  # flat: a number is a joint value within its limits; offset: it is added to the executors' straight first guess
    offset_rad: float = 1.2  # of motion=offset: what a number of 1 adds; 0.5 does not reach the drawn-in postures of wide turns
    control_points: int = 7  # N = m + d - 1 with the paper's (m, d) = (3, 5)
    degree: int = 5
    samples: int = 33  # of a path, at which it is judged
    refusal_hidden: list[int] = field(default_factory=lambda: [128, 128])  # of algorithm=sac: of the network that foresees refusals
    motion_temperature: float = 0.01  # of algorithm=sac: to start with
    motion_entropy_start: float = -2.0  # of algorithm=sac: target entropy of each number, falling from start ...
    motion_entropy_end: float = -3.5  # ... to end, as that of places does

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        require_choice("centralised.motion", self.motion, CENTRALISED_MOTIONS)
        require_between("centralised.offset_rad", self.offset_rad, 0.01, math.pi)
        require_between("centralised.degree", self.degree, 1, 7)
        require_between("centralised.control_points", self.control_points, self.degree + 1, 25)
        require_between("centralised.samples", self.samples, 9, 1001)
        require_positive("centralised.motion_temperature", self.motion_temperature)
        for width in self.refusal_hidden:
            require_at_least("centralised.refusal_hidden", width, 1)
        for name in ("motion_entropy_start", "motion_entropy_end"):
            require_between(f"centralised.{name}", getattr(self, name), -10, 0.69)


@dataclass
class TaskChanges:
    """What to put over a policy's own task; None leaves a setting as the policy brought it."""

    architecture: str | None = None  # A or B
    epsilon_deg: float | None = None  # allowed orientation error
    max_steps: int | None = None  # transfers allowed an episode
    symmetry_order: int | None = None  # the block looks the same when turned by 360/k degrees
    position_tolerance_mm: float | None = None  # "at the goal" after a noisy final placement
    reward: RewardConfig | None = None
    noise: NoiseConfig | None = None


def require_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """Raise :class:`UnknownChoice` unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise UnknownChoice(name, value, choices)


def require_positive(name: str, value: float) -> None:
    """Raise :class:`InvalidSetting` unless ``value`` is a finite number above zero."""
    if not (math.isfinite(value) and value > 0):
        raise InvalidSetting(name, value, "a finite number above 0")


def require_at_least(name: str, value: float, least: float) -> None:
    """Raise :class:`InvalidSetting` unless ``value`` is a finite number not below ``least``."""
    if not (math.isfinite(value) and value >= least):
        raise InvalidSetting(name, value, f"a finite number, at least {least:g}")


MAX_SEED = 10**9 - 2
"""Seeds above are kept for the problems of reports and of validation."""


def require_seed(seed: int) -> None:
    """Raise :class:`InvalidSetting` unless ``seed`` is one that every generator takes."""
    require_between("seed", seed, 0, MAX_SEED)


def require_between(name: str, value: float, low: float, high: float) -> None:
    """Raise :class:`InvalidSetting` unless ``low <= value <= high``."""
    if not (math.isfinite(value) and low <= value <= high):
        raise InvalidSetting(name, value, f"between {low:g} and {high:g}")


@dataclass
class LoopConfig:
    """The closed loop on arms that are not exact."""

    transfers: int = 30  # allowed an episode, picking up again after a miss included; not fewer than task.max_steps
    chart_inset: float = 0.99  # hand-overs keep to this part of the chart, or to the cell's own part if that is smaller
    edge_mm: float = 1.0  # an object this far outside all reach is taken for one at the edge: the fingers close on its pin all the same

    def validate(self, max_steps: int = 1) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits; ``max_steps``: transfers that the task allows up to its verdict."""
        require_at_least("loop.transfers", self.transfers, 1)
        if self.transfers < max_steps:
            raise InvalidSetting("loop.transfers", self.transfers, f"at least task.max_steps = {max_steps}")
        require_between("loop.chart_inset", self.chart_inset, 0.1, 1)
        require_between("loop.edge_mm", self.edge_mm, 0, 1)  # an arm refuses to close its fingers farther than that from the pin


@dataclass
class DecentralisedConfig:
    """variant=decentralised: two arms that take turns, without a supervisor.

    A pass costs half of what a transfer does. To pass for ever then earns -10 at the usual discount, less than any solution, so it does not
    pay. As the discount counts decisions, delay included, a pass costs about three quarters of a transfer: waiting for the arm that can
    finish, or that had better begin, is cheaper than a transfer too many.
    """

    learners: str = "ctde"  # independent (nothing shared), shared (one learner for both), ctde (shared actor, centralised critic)
    pass_reward: float = -0.5
    decisions_per_transfer: int = 3  # an episode has at most so many times task.max_steps decisions, passes included

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        require_choice("decentralised.learners", self.learners, LEARNERS)
        require_between("decentralised.pass_reward", self.pass_reward, -1e6, 0)
        require_at_least("decentralised.decisions_per_transfer", self.decisions_per_transfer, 1)

    def validate_task(self, task: TaskConfig) -> None:
        """As :meth:`validate`; raise :class:`InvalidSetting` also on architecture A, where nobody decides to finish."""
        self.validate()
        if task.architecture != "B":
            raise InvalidSetting("architecture", task.architecture, "B with variant=decentralised, where finishing is a decision")


def changed(name: str, settings: LoopConfig | MotionConfig | CentralisedConfig | DecentralisedConfig) -> list[tuple[str, Any]]:
    """Key and value of every setting of group ``name`` that is not the default."""
    usual = asdict(type(settings)())
    return [(f"{name}.{key}", value) for key, value in asdict(settings).items() if value != usual[key]]

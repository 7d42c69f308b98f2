"""Typed settings. Every default of the package lives here, once; ``configs/*.yaml`` hold named differences only.

A field says beside its default what it may be (:mod:`marl_handover.bounds`). Lengths are in mm, angles in the unit of the name's suffix.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from marl_handover.bounds import (
    MAX_SEED,
    bounded,
    check_bounds,
    chosen,
    name_field,
    path_field,
    require_at_least,
    require_between,
    require_choice,
    require_positive,
    require_seed,
    seed_field,
    sized,
)
from marl_handover.errors import InvalidSetting
from marl_handover.plugins import Registry

__all__ = [
    "BACKENDS",
    "CELL_ALIASES",
    "ENGINES",
    "LAYOUTS",
    "MAX_SEED",
    "PHYSICS",
    "REWARDS",
    "ArmConfig",
    "BlockConfig",
    "CellConfig",
    "CentralisedConfig",
    "DecentralisedConfig",
    "LayoutConfig",
    "LoopConfig",
    "MotionConfig",
    "NoiseConfig",
    "OutageConfig",
    "RewardConfig",
    "RobotConfig",
    "TaskChanges",
    "TaskConfig",
    "bounded",
    "changed",
    "check_bounds",
    "chosen",
    "name_field",
    "path_field",
    "require_at_least",
    "require_between",
    "require_choice",
    "require_positive",
    "require_seed",
    "seed_field",
    "sized",
]

ARCHITECTURES = ("A", "B")
LAYOUTS: Registry[Any] = Registry(
    "layout",
    {name: f"marl_handover.task.observations:{name.upper()}" for name in ("raw", "relative", "object")}
    | {"graph": "marl_handover.task.graph_observation:GRAPH"},
)
"""Observation layouts, each a :class:`~marl_handover.task.observations.Layout`."""
REWARDS: Registry[Any] = Registry("reward")
"""Rewards of one's own: functions of (rules, verdict, placed (..., 3), goal (..., 3)) that return (...) rewards, numpy and torch alike."""
BACKENDS: Registry[Any] = Registry(
    "backend",
    {
        "kinematic": "marl_handover.envs.backends:KinematicBackend",
        "noisy": "marl_handover.envs.backends:NoisyBackend",
        "bullet": "marl_handover.simulation.backend:BulletBackend",
        "mujoco": "marl_handover.simulation.backend:MujocoBackend",
        "twin": "marl_handover.control.hardware_backend:TwinBackend",
        "hardware": "marl_handover.control.hardware_backend:HardwareBackend",
    },
)
"""Classes with the methods of :class:`~marl_handover.envs.backends.Backend`, called with a model, motion settings and own options."""
ENGINES: Registry[Any] = Registry(
    "engine", {"bullet": "marl_handover.simulation.bullet:BulletEngine", "mujoco": "marl_handover.simulation.mujoco:MujocoEngine"}
)
"""Physics engines: classes with the methods of :class:`~marl_handover.simulation.engine.Engine`."""
PHYSICS = ("bullet", "mujoco")
"""Backends that are nothing but one of them."""
SHAPES = ("file", "links", "none")
APPROACHES = ("", "+x", "-x", "+y", "-y", "+z", "-z")
CHARTS = ("paper", "angle")
SHAPES_OF_OBSTACLES = ("disc",)
MOST_ARMS = 8
MOTION_METHODS = ("optimised", "paper")
EXPLORATIONS = ("chart", "area")
LEARNERS = ("independent", "shared", "ctde")
CENTRALISED_MOTIONS = ("flat", "offset")
HINDSIGHT = ("none", "final", "future", "episode")

POSE = (-1e6, 1e6, (3, 3), None, "numbers: x [mm], y [mm], orientation [deg]")
"""Bounds of a pose; what is out of reach is told by the cell."""
EPSILON_DEG, MAX_STEPS, SYMMETRY_ORDER, TOLERANCE_MM = (1e-4, 180.0), (1, 1000), (1, 360), (1e-3, 100.0)
"""Bounds of settings that have a second home: in a task, and in what is put over a policy's own task."""
PICK_HEIGHT_MM, PITCH_DEG = (0.1, 1000.0), (-90.0, 90.0)
"""Bounds of a robot's settings, which a cell may override."""


@dataclass
class BlockConfig:
    """The object: a square block with an upright pin in its centre, by which it is held."""

    side_mm: float = bounded(40.0, 5.0, 300.0)
    height_mm: float = bounded(15.0, 2.0, 200.0)
    pin_diameter_mm: float = bounded(2.5, 0.5, 20.0)
    pin_top_mm: float = bounded(65.0, 5.0, 400.0)
    marker_mm: float = bounded(30.0, 4.0, 200.0)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits, or parts that do not fit each other."""
        check_bounds(self, "cell.block.")
        fits = {
            "pin_top_mm": (
                self.pin_top_mm > self.height_mm,
                f"above cell.block.height_mm = {self.height_mm:g}: it stands on the block",
            ),
            "pin_diameter_mm": (self.pin_diameter_mm < self.side_mm, f"below cell.block.side_mm = {self.side_mm:g}"),
            "marker_mm": (self.marker_mm <= self.side_mm, f"up to cell.block.side_mm = {self.side_mm:g}: the marker lies on the block"),
        }
        for name, (fit, limit) in fits.items():
            if not fit:
                raise InvalidSetting(f"cell.block.{name}", getattr(self, name), limit)


@dataclass
class RobotConfig:
    """One kind of robot: its URDF, and what is not to be found out from it.

    Roles of joints: ``base_yaw``, ``shoulder``, ``elbow``, ``wrist_pitch``, ``wrist_roll``. What is empty or null is found by geometry.
    """

    name: str = ""
    urdf: str = path_field("")  # a path, which counts from the folder of this robot's YAML file, or the name of a file in urdf/
    tip: str = ""  # link in whose origin things are held
    joints: dict[str, str] = sized(dict, 0, 5)  # role -> joint of the URDF
    locked: dict[str, float] = bounded(dict, -360.0, 360.0, (0, 64))  # joint of the URDF -> the angle [deg] at which it is held
    approach: str = chosen("", APPROACHES)  # where the hand points, in the tip's frame
    gripper: list[str] = sized(list, 0, 2)  # its joints; [none]: things stick to the tip
    joint_limits_deg: dict[str, list[float]] = bounded(dict, -360.0, 360.0, (0, 64), (2, 2))  # role -> limits in place of the URDF's
    pitch_deg: float = bounded(0.0, *PITCH_DEG)  # of the hand where it picks and places: 0 level, -60 steeply down
    pick_height_mm: float = bounded(45.0, *PICK_HEIGHT_MM)  # of the grip over the table
    parked_deg: list[float] | None = bounded(None, -360.0, 360.0, (5, 5))  # joints by role while another arm moves; null: found
    shapes: str = chosen("file", SHAPES)  # file: the URDF's; links: capsules along the links; none

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "robot.")


@dataclass
class ArmConfig:
    """Where one arm of a cell stands, and which robot it is."""

    name: str = ""
    x_mm: float = bounded(0.0, -10_000.0, 10_000.0)
    y_mm: float = bounded(0.0, -10_000.0, 10_000.0)
    facing_deg: float = bounded(0.0, -360.0, 360.0)  # world direction of zero yaw
    robot: str = path_field("")  # as cell.robot; empty: the cell's


@dataclass
class ObstacleConfig:
    """Something that stands on the table: where nothing may be put."""

    x_mm: float = bounded(0.0, -10_000.0, 10_000.0)
    y_mm: float = bounded(0.0, -10_000.0, 10_000.0)
    radius_mm: float = bounded(10.0, 0.1, 10_000.0)  # the block's centre keeps this and half the block's diagonal away
    height_mm: float = bounded(50.0, 0.1, 10_000.0)
    shape: str = chosen("disc", SHAPES_OF_OBSTACLES)


@dataclass
class CellConfig:
    """Arms around a shared piece of table; the defaults are the paper's cell, two mirrored arms of one robot.

    What robots have, too, is put over every arm's own; null, or empty, leaves it.
    """

    name: str = "paper"
    robot: str = path_field("al5a_paper")  # the name of a file in configs/robot, or the path of a robot's YAML file or URDF
    arms: list[ArmConfig] = sized(
        list, 0, MOST_ARMS
    )  # one entry an arm; empty, or two that are not placed: face to face, base_distance_mm apart
    enabled: list[str] | None = sized(None, 1, MOST_ARMS)  # names of the arms that are in order; null: all of them
    obstacles: list[ObstacleConfig] = sized(list, 0, 64)  # discs on which nothing may be put: x_mm, y_mm, radius_mm, height_mm
    base_distance_mm: float | None = bounded(None, 10.0, 10_000.0)  # null: 0.78 of the sum of the outer radii, if that gives a shared space
    grasp_link: str = ""  # the robots' tip
    pick_height_mm: float | None = bounded(None, *PICK_HEIGHT_MM)
    pitch_deg: float | None = bounded(None, *PITCH_DEG)
    joint_limits_deg: dict[str, list[float]] = bounded(dict, -360.0, 360.0, (0, 64), (2, 2))  # joint by joint
    shapes: str | None = chosen(None, SHAPES)
    grid_mm: float = bounded(5.0, 1.0, 200.0)
    fit_rounding_mm: float = bounded(1.0, 0.0, 100.0)  # fitted radii are rounded inwards to a multiple of this; 0 keeps them
    r_min_mm: float | None = bounded(None, 1.0, 10_000.0)  # rings begin no nearer than this ...
    r_max_mm: float | None = bounded(None, 1.0, 10_000.0)  # ... and end no farther; null: what the arms reach
    chart: str | None = chosen(None, CHARTS)  # paper or angle; null: paper for two equal rings face to face without obstacles, else angle
    chart_inset: float = bounded(1.0, 0.1, 1.0)  # part of the chart that is used: 1 = all, 0.95 leaves room for placement noise
    block: BlockConfig = field(default_factory=BlockConfig)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits, or parts that do not fit each other."""
        check_bounds(self, "cell.")
        self.block.validate()


@dataclass
class LayoutConfig:
    """Random cells: arms that stand anywhere, as long as every one can pass to every other, by way of others if need be.

    Two numbers are the least and the greatest; each is drawn uniformly, for every arm anew unless it says otherwise.
    """

    arms: list[int] = bounded(lambda: [2, 5], 2, MOST_ARMS, (2, 2))
    r_min_mm: list[float] = bounded(lambda: [150.0, 150.0], 1.0, 10_000.0, (2, 2))
    r_max_mm: list[float] = bounded(lambda: [230.0, 230.0], 1.0, 10_000.0, (2, 2))
    yaw_deg: list[float] = bounded(lambda: [90.0, 90.0], 1.0, 180.0, (2, 2))  # to either side of the facing
    spacing_mm: list[float] = bounded(lambda: [305.0, 440.0], 30.0, 10_000.0, (2, 2))  # from an arm that stands to the next one
    apart_mm: float = bounded(300.0, 30.0, 10_000.0)  # between any two bases
    obstacles: list[int] = bounded(lambda: [0, 0], 0, 8, (2, 2))  # keep-out discs
    radius_mm: list[float] = bounded(lambda: [10.0, 40.0], 0.1, 10_000.0, (2, 2))  # of obstacles

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits, or a least that is above its greatest."""
        check_bounds(self, "layouts.")
        for name in ("arms", "r_min_mm", "r_max_mm", "yaw_deg", "spacing_mm", "obstacles", "radius_mm"):
            low, high = getattr(self, name)
            if low > high:
                raise InvalidSetting(f"layouts.{name}", [low, high], "the least first")
        if self.r_min_mm[1] >= self.r_max_mm[0]:
            raise InvalidSetting("layouts.r_min_mm", self.r_min_mm, f"below layouts.r_max_mm = {self.r_max_mm}")


CELL_ALIASES = {key: f"cell.{key}" for key in ("robot", "shapes")} | {"arms.enabled": "cell.enabled"}
"""Short keys of commands that have a cell."""


@dataclass
class RewardConfig:
    """Rewards of architecture B (the paper's r_B), and the weight of the coupled motion reward of its eq. (3)."""

    success: float = bounded(20.0, -1e6, 1e6)
    step: float = bounded(-1.0, -1e6, 1e6)
    failure: float = bounded(-30.0, -1e6, 1e6)
    motion_weight: float = bounded(0.0, 0.0, 1e6)  # reward -= motion_weight * path cost [mm] / 100
    function: str = ""  # of a plugin: what it makes of the three above, in architecture B


@dataclass
class NoiseConfig:
    """Noise of the batched rules, standard deviations per axis: of every placement, and of where the supervisor sees the object."""

    position_mm: float = bounded(0.0, 0.0, 1000.0)
    yaw_deg: float = bounded(0.0, 0.0, 180.0)
    observed_mm: float = bounded(0.0, 0.0, 1000.0)  # of where the supervisor sees the object; the truth is moved and judged
    observed_deg: float = bounded(0.0, 0.0, 180.0)

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

    architecture: str = chosen("B", ARCHITECTURES)
    epsilon_deg: float = bounded(5.0, *EPSILON_DEG)  # allowed orientation error
    max_steps: int = bounded(20, *MAX_STEPS)
    symmetry_order: int = bounded(1, *SYMMETRY_ORDER)  # k: the block looks the same when turned by 360/k degrees
    layout: str = chosen("relative", LAYOUTS)
    previous_arm: bool = True  # whether observations say which arm moved last
    position_tolerance_mm: float = bounded(5.0, *TOLERANCE_MM)  # "at the goal" after a noisy final placement
    reward: RewardConfig = field(default_factory=RewardConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self)
        if self.reward.function:
            require_choice("task.reward.function", self.reward.function, REWARDS)
            if self.architecture != "B":
                raise InvalidSetting("task.reward.function", self.reward.function, "left out in architecture A, which ends by kinematics")


@dataclass
class MotionConfig:
    """How an arm moves: clearances, the way over the table, limits of speed. Facts and reasons: docs of ``marl_handover.motion``."""

    parked_deg: list[float] | None = bounded(None, -360.0, 360.0, (1, 32))  # of every arm; null: each robot's own, or one that is found
    arm_clearance_mm: float = bounded(5.0, 0.0, 100.0)  # between the moving arm, with what it carries, and the other one
    ground_clearance_mm: float = bounded(2.0, 0.0, 100.0)
    self_clearance_mm: float = bounded(2.0, 0.0, 100.0)  # between bodies of one arm that are not neighbours, and what it carries
    block_clearance_mm: float = bounded(1.0, 0.0, 100.0)  # between an empty hand and the block or its pin
    lift_mm: float = bounded(40.0, 0.0, 500.0)  # how high the block travels above the pick height, far from both ends
    lift_scale_mm: float = bounded(25.0, 0.1, 1000.0)  # distance from an end at which that height is asked for; shorter ways scale it
    approach_scale_mm: float = bounded(10.0, 0.1, 1000.0)  # the same for an empty hand that comes to the pin or leaves it
    method: str = chosen("optimised", MOTION_METHODS)  # of loaded paths: optimised, or paper (its formulation, with SLSQP)
    control_points: int = bounded(11, 5, 25)  # of each path's spline
    degree: int = bounded(5, 3, 7)
    num_initial_guesses: int = bounded(16, 1, 1000)  # first guesses tried at most
    velocity_scale: float = bounded(0.8, 0.01, 1.0)  # of the URDF's joint velocities
    acceleration_deg_s2: float = bounded(800.0, 1.0, 1e5)  # of arms that reach 315 mm; in proportion less of those that reach farther
    sample_s: float = bounded(0.02, 1e-3, 0.02)  # a timed trajectory is written at this interval
    finger_travel_mm: float = bounded(12.0, 0.1, 50.0)  # how far each finger opens before it closes on the pin
    grasp_s: float = bounded(0.4, 0.01, 60.0)  # closing the fingers
    release_s: float = bounded(0.3, 0.01, 60.0)  # opening them

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "motion.")
        if self.method == "paper" and self.degree != 5:
            raise InvalidSetting("motion.degree", self.degree, "5 with motion.method=paper, as the paper has it")
        require_between("motion.control_points", self.control_points, self.degree + 2, 25)
        angles = self.parked_deg
        if angles is not None and (len(angles) != 5 or angles[4] != 0):
            raise InvalidSetting("motion.parked_deg", angles, "five finite angles in degrees, the last one, of the wrist roll, 0")


@dataclass
class CentralisedConfig:
    """The motions that a centralised policy makes itself: the paper's splines, their inner control points given by numbers."""

    motion: str = chosen("offset", CENTRALISED_MOTIONS)  # flat: numbers are joint values; offset: added to the straight first guess
    offset_rad: float = bounded(1.2, 0.01, math.pi)  # of motion=offset: what 1 adds; 0.5 is too little for wide turns
    control_points: int = bounded(7, 2, 25)  # N = m + d - 1 with the paper's (m, d) = (3, 5)
    degree: int = bounded(5, 1, 7)
    samples: int = bounded(33, 9, 1001)  # of a path, at which it is judged
    refusal_hidden: list[int] = bounded([128, 128], 1, 4096, (0, 8))  # of algorithm=sac: of the network that foresees refusals
    motion_temperature: float = bounded(0.01, 1e-9, 1e3)  # of algorithm=sac: to start with
    motion_entropy_start: float = bounded(-2.0, -10.0, 0.69)  # of algorithm=sac: target entropy of each number, falling from start ...
    motion_entropy_end: float = bounded(-3.5, -10.0, 0.69)  # ... to end, as that of places does

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "centralised.")
        require_between("centralised.control_points", self.control_points, self.degree + 1, 25)


@dataclass
class TaskChanges:
    """What to put over a policy's own task; None leaves a setting as the policy brought it."""

    architecture: str | None = chosen(None, ARCHITECTURES)  # A or B
    epsilon_deg: float | None = bounded(None, *EPSILON_DEG)  # allowed orientation error
    max_steps: int | None = bounded(None, *MAX_STEPS)  # transfers allowed an episode
    symmetry_order: int | None = bounded(None, *SYMMETRY_ORDER)  # the block looks the same when turned by 360/k degrees
    position_tolerance_mm: float | None = bounded(None, *TOLERANCE_MM)  # "at the goal" after a noisy final placement
    reward: RewardConfig | None = None
    noise: NoiseConfig | None = None


@dataclass
class LoopConfig:
    """The closed loop on arms that are not exact."""

    transfers: int = bounded(30, 1, 10_000)  # allowed an episode, picking up again after a miss included; not fewer than task.max_steps
    chart_inset: float = bounded(0.99, 0.1, 1.0)  # hand-overs keep to this part of the chart, or to the cell's own part if that is smaller
    reach_slack_mm: float = bounded(1.0, 0.0, 1.0)  # an object this far outside all reach counts as one at its edge

    def validate(self, max_steps: int = 1) -> None:
        """Raise :class:`InvalidSetting` on a value out of its limits; ``max_steps``: transfers that the task allows up to its verdict."""
        check_bounds(self, "loop.")
        if self.transfers < max_steps:
            raise InvalidSetting("loop.transfers", self.transfers, f"at least task.max_steps = {max_steps}")


@dataclass
class OutageConfig:
    """An arm that goes out of order in the middle of each episode: from the next decision on, the cell is that of the other arms."""

    arm: str = "random"  # its name; random: any, drawn for each problem
    after: int | None = bounded(
        None, 0, 1000
    )  # transfers that are made before; null: drawn, from 1 up to before the last of a shortest plan
    seed: int = seed_field()


@dataclass
class DecentralisedConfig:
    """variant=decentralised: two arms that take turns, without a supervisor.

    A pass costs half of what a transfer does. To pass for ever then earns -10 at the usual discount, less than any solution, so it does not
    pay. As the discount counts decisions, delay included, a pass costs about three quarters of a transfer: waiting for the arm that can
    finish, or that had better begin, is cheaper than a transfer too many.
    """

    learners: str = chosen("ctde", LEARNERS)  # independent, shared (one learner for both), ctde (shared actor, central critic)
    pass_reward: float = bounded(-0.5, -1e6, 0.0)
    decisions_per_transfer: int = bounded(3, 1, 100)  # an episode has at most so many times task.max_steps decisions, passes included

    def validate(self) -> None:
        """Raise :class:`InvalidSetting` or :class:`UnknownChoice` on a value out of its limits."""
        check_bounds(self, "decentralised.")

    def validate_task(self, task: TaskConfig) -> None:
        """As :meth:`validate`; raise :class:`InvalidSetting` also on architecture A, where nobody decides to finish."""
        self.validate()
        if task.architecture != "B":
            raise InvalidSetting("architecture", task.architecture, "B with variant=decentralised, where finishing is a decision")


def changed(name: str, settings: LoopConfig | MotionConfig | CentralisedConfig | DecentralisedConfig) -> list[tuple[str, Any]]:
    """Key and value of every setting of group ``name`` that is not the default."""
    usual = asdict(type(settings)())
    return [(f"{name}.{key}", value) for key, value in asdict(settings).items() if value != usual[key]]

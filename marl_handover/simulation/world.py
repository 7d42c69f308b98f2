"""The simulated cell: two arms, a block and a table, and the running of timed cycles in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.cell.build import CellModel
from marl_handover.config import MotionConfig, require_at_least, require_choice
from marl_handover.geometry.se3 import apply, flat_pose
from marl_handover.motion.home import parked_poses
from marl_handover.motion.trajectory import Phase
from marl_handover.simulation.arm import SERVO_S, SimulatedArm, grips_by_friction
from marl_handover.simulation.arm_file import whole
from marl_handover.simulation.block import BAR_RGB, GOAL_RGB, mass_properties
from marl_handover.simulation.camera import TOP, Camera, Pixels
from marl_handover.simulation.effort import require_effort
from marl_handover.simulation.engine import BLOCK, TABLE, Engine, Scene, Touch, open_engine


class Block:
    """The block in an :class:`Engine`. Its frame: origin in the middle of its lower face, z along the pin, x through the red bar."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def place(self, pose: Floats) -> None:
        """Stand it on the table at ``pose`` (3,): x_mm, y_mm, theta_rad; at rest."""
        x_mm, y_mm, theta_rad = (float(value) for value in pose)
        self._engine.put_block((x_mm, y_mm, 0.0), (0.0, 0.0, theta_rad))

    def transform(self) -> Floats:
        """T_world_block (4, 4) in mm, wherever it is, upright or not."""
        return self._engine.block_transform()

    def pose(self) -> Floats:
        """Where the middle of the lower face is, and the yaw: (3,) mm, mm, rad."""
        T = self.transform()
        return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])

    def height_mm(self) -> float:
        """Height of the middle of the lower face above the table."""
        return float(self.transform()[2, 3])

    def tilt_rad(self) -> float:
        """Angle between the pin and the vertical."""
        return math.acos(min(1.0, max(-1.0, float(self.transform()[2, 2]))))


GRASPS = ("friction", "constraint")
"""How a pin is held: between two pads, or by a rigid joint. Hands without two sliding pads that have shapes always take the joint."""

LEVER_MM = 42.0
"""How far below the pads a block's centre may hang that friction holds; the solver lets a lower one creep while the hand turns."""

NEAR_MM = 4.0
"""So near to the pin the grip of a hand without such pads has to be, for the block to stick to it."""

CONTROL_S = 0.02
"""How often a run looks at contacts and calls back."""

_CONTROL_STEPS = round(CONTROL_S / SERVO_S)
_SETTLE_S = 0.2


@dataclass
class ArmReport:
    """What happened to one arm's cycle.

    ``grasped``: both fingers held the pin when they had closed. ``kept``: they still did just before they opened. ``trace_rad`` (n, 5):
    where the joints were every :data:`CONTROL_S`, from grasp to release.
    """

    grasped: bool = False
    kept: bool = False
    trace_rad: list[Floats] = field(default_factory=list)


class RunReport(NamedTuple):
    """What happened in a run: per arm, and the first touch of each two bodies that must not (names such as "arm 0 - table")."""

    arms: dict[int, ArmReport]
    collisions: dict[str, Touch]
    duration_s: float


class _Track:
    """An arm's phases as set-points."""

    def __init__(self, phases: Sequence[Phase]) -> None:
        t_s = np.concatenate([phase.t_s for phase in phases])
        joints = np.concatenate([phase.joints_rad for phase in phases])
        gripper = np.concatenate([phase.gripper_mm for phase in phases])
        self.steps = max(1, math.ceil((t_s[-1] - t_s[0]) / SERVO_S - 1e-9))
        times = t_s[0] + SERVO_S * np.arange(self.steps + 1)
        self.joints_rad = np.stack([np.interp(times, t_s, column) for column in joints.T], axis=1)
        self.velocity_rad_s = np.diff(self.joints_rad, axis=0, prepend=self.joints_rad[:1]) / SERVO_S
        self.gripper_mm = np.interp(times, t_s, gripper)
        spans = {phase.name: (phase.t_s[[0, -1]] - t_s[0]) / SERVO_S + 1e-9 for phase in phases}
        never = np.array([np.inf, np.inf])
        self.closes_at, self.closed_at = np.floor(spans.get("grasp", never))
        self.opens_at, self.open_at = np.floor(spans.get("release", never))

    def touches_pin(self, step: int) -> bool:
        """Whether fingers move on the pin or hold it in this step."""
        return bool(self.closes_at < step <= self.open_at)


class SimulatedCell:
    """The arms, the block with its pin and the table in a world of their own.

    Deterministic: equal calls after :meth:`reset` give bit-identical states. A context manager.

    Args:
        model: the cell.
        motion: where the arms park, and how far the fingers open.
        engine: by name; None: PyBullet where it is installed, else MuJoCo.
        grasp: "friction" (finger contact alone) or "constraint" (a rigid joint while both fingers are on the pin); None: friction for a
            block that hangs less than :data:`LEVER_MM` below two pads that slide. To a hand that has no pads, or none with shapes, and
            to a hinged jaw unless friction is asked for, the block sticks, and passes through it otherwise.
        gui: open the engine's window.

    Attributes:
        notes: what was made up for physics, in words.

    Raises:
        UnknownChoice: for another ``grasp`` or ``engine``.
        MissingExtra: the engine is not installed.
        UrdfError: an arm is too weak to hold itself up.
        NoWindow: if ``gui`` and there is no display.
    """

    def __init__(
        self, model: CellModel, motion: MotionConfig, *, engine: str | None = None, grasp: str | None = None, gui: bool = False
    ) -> None:
        if grasp is not None:
            require_choice("grasp", grasp, GRASPS)
        model.cell.require_grip(motion.finger_travel_mm)
        self.model, self.motion = model, motion
        self.homes_rad = parked_poses(model, motion)
        require_effort(model, motion, self.homes_rad)
        levers_mm = np.asarray(model.cell.pick_heights_mm) - mass_properties(model.cell.config.block)[1]
        self._bonded = [bool(lever > LEVER_MM) if grasp is None else grasp == "constraint" for lever in levers_mm]
        self._sticky = [not grips_by_friction(arm.description, hinged=grasp == "friction") for arm in model.arms]
        self.notes = _notes(model, self._sticky, self._bonded if grasp is None else [False] * len(levers_mm))
        wide = 2.0 if model.cell.num_arms > 2 else 1.0  # films of many arms look at it from far away
        table_mm = max(1000.0, *(wide * side + 200.0 for side in model.cell.extent_mm))
        scene = Scene(model.arms, model.cell.bases, model.cell.config.block, self._sticky, table_mm)
        self.engine: Engine = open_engine(engine, scene, gui)
        self.reset((0.0, 0.0, 0.0))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Let the world go; a second call does nothing."""
        self.engine.close()

    def reset(self, pose: ArrayLike) -> None:
        """Both arms parked with open fingers, the block standing at ``pose`` (3,): x_mm, y_mm, theta_rad; settled, at time 0."""
        self.engine.reset()
        self.arms = [SimulatedArm(self.engine, index, arm) for index, arm in enumerate(self.model.arms)]
        self.block = Block(self.engine)
        self._bonds: set[int] = set()
        self._holding: set[int] = set()
        for arm, home_rad in zip(self.arms, self.homes_rad, strict=True):
            arm.place(home_rad, self.motion.finger_travel_mm)
        self.block.place(np.asarray(pose, dtype=float))
        self.settle()
        self.engine.time_s = 0.0

    def save(self) -> Any:
        """All that the future depends on, for :meth:`restore` of this cell until its next reset."""
        return self.engine.save(), [arm.save() for arm in self.arms], set(self._bonds), set(self._holding)

    def restore(self, state: Any) -> None:
        """Go back to what :meth:`save` gave."""
        engine, arms, bonds, holding = state
        self.engine.restore(engine)
        for arm, saved in zip(self.arms, arms, strict=True):
            arm.restore(saved)
        self._bonds, self._holding = set(bonds), set(holding)

    def settle(self, seconds: float = _SETTLE_S) -> None:
        """Let time pass while every servo holds its last set-point."""
        self.engine.advance(seconds)

    def show_goal(self, pose: ArrayLike) -> None:
        """Draw where the block is to go, until the next reset: a flat green square with a red bar, which nothing can touch."""
        block, T = self.model.cell.config.block, flat_pose(*(float(value) for value in np.asarray(pose)))
        half, bar = block.side_mm / 2, block.marker_mm / 2
        for middle, x, y, height_mm, rgb in ((0.0, half, half, 0.6, GOAL_RGB), (bar * 0.6, bar * 0.25, bar * 0.8, 0.9, BAR_RGB)):
            right, left = (apply(T, [[middle - x, side, 0.0], [middle + x, side, 0.0]])[:, :2] for side in (-y, y))
            self.engine.lay(right, left, height_mm, rgb)

    def object_pose(self) -> Floats:
        """The block's true pose (3,): x_mm, y_mm, theta_rad."""
        return self.block.pose()

    def joints_rad(self) -> Floats:
        """Where the joints are: (num_arms, 5)."""
        return np.stack([arm.joints_rad() for arm in self.arms])

    def tilt_rad(self) -> float:
        """Angle between the pin and the vertical."""
        return self.block.tilt_rad()

    def grasp(self, arm: int) -> bool:
        """The fingers of ``arm`` have closed: whether it holds the pin; rigidly, from now on, where friction alone does not do."""
        if not self.held(arm):
            return False
        if (self._bonded[arm] or self._sticky[arm]) and arm not in self._bonds:
            self.engine.bond(arm)
            self._bonds.add(arm)
        return True

    def release(self, arm: int) -> None:
        """The fingers of ``arm`` open: nothing holds the pin rigidly any more."""
        if arm in self._bonds:
            self._bonds.discard(arm)
            self.engine.release(arm)

    def held(self, arm: int) -> bool:
        """Whether both fingers of ``arm`` press on the block or its pin; of a hand to which it sticks, whether it does."""
        if self._sticky[arm]:
            return arm in self._bonds or self._over_pin(arm)
        return all(any(touch.force_n > 0 for touch in self.engine.touches(arm, BLOCK, finger)) for finger in self.arms[arm].fingers)

    def collisions(self, holding: set[int] | None = None) -> dict[str, Touch]:
        """The deepest touch of each two that must not touch: arms, an arm and the table (its base apart), a held block and another arm.

        ``holding``: the arms that hold the block; those of the run that is going on if None.
        """
        holding = self._holding if holding is None else holding
        found: dict[str, Touch] = {}
        for index, arm in enumerate(self.arms):
            self._note(found, f"arm {index} - table", [t for t in self.engine.touches(index, TABLE) if t.first in arm.above])
            for other in range(index):
                self._note(found, f"arm {other} - arm {index}", self.engine.touches(index, other))
            carrier = next((other for other in range(len(self.arms)) if other != index and other in holding), None)
            if carrier is not None:
                self._note(found, f"block - arm {index}", self.engine.touches(index, BLOCK))
        return found

    def camera_image(self, width: int = TOP.width_px, height: int = TOP.height_px, camera: Camera = TOP) -> Pixels:
        """What ``camera`` sees now: RGB (height, width, 3). Raises :class:`InvalidSetting` for a size below 1."""
        require_at_least("width", width, 1)
        require_at_least("height", height, 1)
        return self.engine.picture(camera, width, height)

    def run(self, arm: int, phases: Sequence[Phase], on_step: Callable[[], None] | None = None) -> RunReport:
        """Carry out a timed cycle with ``arm``, the others holding still; see :meth:`run_together`."""
        return self.run_together({arm: phases}, on_step)

    def run_together(self, cycles: Mapping[int, Sequence[Phase]], on_step: Callable[[], None] | None = None) -> RunReport:
        """Carry out timed cycles, arm -> phases, on one clock that starts with each one's first sample; then settle.

        ``on_step`` is called every :data:`CONTROL_S`, for pictures and records.
        """
        tracks = {arm: _Track(phases) for arm, phases in cycles.items()}
        report = RunReport({arm: ArmReport() for arm in cycles}, {}, max(track.steps for track in tracks.values()) * SERVO_S)
        fine = False
        for step in range(1, max(track.steps for track in tracks.values()) + 1):
            for arm, track in tracks.items():
                if step <= track.steps:
                    self.arms[arm].aim(track.joints_rad[step - 1], track.velocity_rad_s[step], track.gripper_mm[step])
                elif step == track.steps + 1:
                    self._hold(arm, track)
            if fine != (bool(self._holding) or any(track.touches_pin(step) for track in tracks.values())):
                fine = not fine
                self.engine.fine(fine)
            self.engine.advance(SERVO_S)
            for arm, track in tracks.items():
                self._watch_grasp(arm, track, step, report.arms[arm])
            if step % _CONTROL_STEPS == 0:
                self._observe(report, on_step)
        for arm, track in tracks.items():
            self._hold(arm, track)
        self.settle()
        return report

    def _hold(self, arm: int, track: _Track) -> None:
        self.arms[arm].aim(track.joints_rad[-1], np.zeros(5), track.gripper_mm[-1])

    def _watch_grasp(self, arm: int, track: _Track, step: int, report: ArmReport) -> None:
        if step == track.closed_at:
            report.grasped = self.grasp(arm)
            if report.grasped:
                self._holding.add(arm)
        elif step == track.opens_at:
            report.kept = self.held(arm)
            self._holding.discard(arm)
            self.release(arm)

    def _over_pin(self, arm: int) -> bool:
        """Whether the grip of an arm is at the pin."""
        T, grip = self.block.transform(), self.arms[arm].grip_mm()
        along, across = float((grip - T[:3, 3]) @ T[:3, 2]), np.cross(grip - T[:3, 3], T[:3, 2])
        block = self.model.cell.config.block
        return block.height_mm <= along <= block.pin_top_mm and float(np.linalg.norm(across)) <= NEAR_MM

    def _observe(self, report: RunReport, on_step: Callable[[], None] | None) -> None:
        for arm in self._holding:
            report.arms[arm].trace_rad.append(self.arms[arm].joints_rad())
        for name, touch in self.collisions().items():
            report.collisions.setdefault(name, touch)
        if on_step is not None:
            on_step()

    @staticmethod
    def _note(found: dict[str, Touch], name: str, touches: Sequence[Touch]) -> None:
        real = [touch for touch in touches if touch.distance_mm <= 0]
        if real:
            found[name] = min(real, key=lambda touch: touch.distance_mm)


def _notes(model: CellModel, sticky: Sequence[bool], bonded: Sequence[bool]) -> tuple[str, ...]:
    """What is made up about the cell's robots, one line each."""
    notes = {}
    for arm, sticks, stiff in zip(model.arms, sticky, bonded, strict=True):
        description = arm.description
        made_up = list(whole(description).assumed[len(description.assumed) :])
        if sticks:
            made_up.append("the block sticks to its hand: there are no two sliding pads with shapes")
        elif stiff:
            made_up.append("a rigid joint holds the pin once both pads are on it: the block hangs low (grasp=friction: pads alone)")
        notes[description.name] = f"physics of {description.name}: {'; '.join(made_up)}" if made_up else ""
    return tuple(filter(None, notes.values()))

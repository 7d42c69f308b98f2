"""The simulated cell: two arms, a block and a table, and the running of timed cycles in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.cell.build import CellModel
from marl_handover.config import BlockConfig, MotionConfig, require_choice
from marl_handover.motion.home import parked_poses
from marl_handover.motion.trajectory import Phase
from marl_handover.simulation.arm import SERVO_S, SimulatedArm, grips_by_friction
from marl_handover.simulation.arm_file import whole
from marl_handover.simulation.camera import TOP, Camera, Pixels, picture
from marl_handover.simulation.effort import require_effort
from marl_handover.simulation.engine import COARSE, FINE, Engine, Floats, Surface, Touch, inertia, length, pybullet, tilt_of, to_mm

_BEAD_SPACING_MM = 6.0
_WOOD_KG_MM3 = 650e-9
_SURFACE = Surface(lateral=1.0)


class Block:
    """The block in an :class:`Engine`. Its frame: origin in the middle of its lower face, z along the pin, x through the red bar."""

    def __init__(self, engine: Engine, config: BlockConfig) -> None:
        self._engine, self._config = engine, config
        mass, self._centre_mm, moments = _mass_properties(config)
        body, pin = _shapes(config)
        beads = _beads_mm(config)
        collision = pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] + [pybullet.GEOM_SPHERE] * len(beads),
            halfExtents=[body["halfExtents"]] + [[0, 0, 0]] * len(beads),
            radii=[0] + [pin["radius"]] * len(beads),
            collisionFramePositions=[body["at"]] + [[0, 0, length(z)] for z in beads],
            physicsClientId=self._client,
        )
        self.body = int(
            pybullet.createMultiBody(
                baseMass=mass,
                baseCollisionShapeIndex=collision,
                baseVisualShapeIndex=self._visual(),
                baseInertialFramePosition=[0, 0, length(self._centre_mm)],
                physicsClientId=self._client,
            )
        )
        engine.coat(self.body, [-1], _SURFACE)
        engine.dynamics(
            self.body,
            -1,
            localInertiaDiagonal=[inertia(moment) for moment in moments],
            linearDamping=0.0,
            angularDamping=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )

    def _visual(self) -> int:
        """Wood, a white marker with a red bar towards +x and a blue dot towards +y, the pin."""
        body, pin = _shapes(self._config)
        marker, top = self._config.marker_mm / 2, self._config.height_mm
        patches = [
            (marker, marker, 0.0, 0.0),
            (marker * 0.25, marker * 0.8, marker * 0.6, 0.0),
            (marker * 0.25, marker * 0.25, -marker * 0.4, marker * 0.5),
        ]
        return int(
            pybullet.createVisualShapeArray(
                shapeTypes=[pybullet.GEOM_BOX] * 4 + [pybullet.GEOM_CYLINDER],
                halfExtents=[body["halfExtents"]]
                + [[length(half_x), length(half_y), length(0.2 * layer)] for layer, (half_x, half_y, _, _) in enumerate(patches, 1)]
                + [[0, 0, 0]],
                radii=[0, 0, 0, 0, pin["radius"]],
                lengths=[0, 0, 0, 0, pin["length"]],
                visualFramePositions=[body["at"]] + [[length(x), length(y), length(top)] for _, _, x, y in patches] + [pin["at"]],
                rgbaColors=[
                    [0.76, 0.60, 0.42, 1],
                    [0.97, 0.97, 0.97, 1],
                    [0.84, 0.15, 0.16, 1],
                    [0.12, 0.35, 0.75, 1],
                    [0.88, 0.78, 0.58, 1],
                ],
                physicsClientId=self._client,
            )
        )

    @property
    def _client(self) -> int:
        return self._engine.client

    def place(self, pose: Floats) -> None:
        """Stand it on the table at ``pose`` (3,): x_mm, y_mm, theta_rad; at rest."""
        x_mm, y_mm, theta_rad = (float(value) for value in pose)
        at = [length(x_mm), length(y_mm), length(self._centre_mm)]
        pybullet.resetBasePositionAndOrientation(
            self.body, at, pybullet.getQuaternionFromEuler([0, 0, theta_rad]), physicsClientId=self._client
        )
        pybullet.resetBaseVelocity(self.body, [0, 0, 0], [0, 0, 0], physicsClientId=self._client)

    def transform(self) -> Floats:
        """T_world_block (4, 4) in mm, wherever it is, upright or not."""
        at, quaternion = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        T = np.eye(4)
        T[:3, :3] = np.reshape(pybullet.getMatrixFromQuaternion(quaternion), (3, 3))
        T[:3, 3] = to_mm(at) - self._centre_mm * T[:3, 2]
        return T

    def pose(self) -> Floats:
        """Where the middle of the lower face is, and the yaw: (3,) mm, mm, rad."""
        T = self.transform()
        return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])

    def height_mm(self) -> float:
        """Height of the middle of the lower face above the table."""
        at, quaternion = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        return float(to_mm(at)[2] - self._centre_mm * math.cos(tilt_of(quaternion)))

    def tilt_rad(self) -> float:
        """Angle between the pin and the vertical."""
        return tilt_of(pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)[1])


def _shapes(config: BlockConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    half, up, pin_up = config.side_mm / 2, config.height_mm, config.pin_top_mm
    body = {"halfExtents": [length(half), length(half), length(up / 2)], "at": [0, 0, length(up / 2)]}
    pin = {"radius": length(config.pin_diameter_mm / 2), "length": length(pin_up - up), "at": [0, 0, length((up + pin_up) / 2)]}
    return body, pin


def _beads_mm(config: BlockConfig) -> Floats:
    """Heights of the beads that make up the pin's collision shape.

    Between a thin cylinder and a flat finger Bullet finds the points of a line contact anew at each step, here and there along the line,
    and the pin works itself loose. A string of beads touches a flat finger in the same places all the time.
    """
    radius = config.pin_diameter_mm / 2
    lowest, highest = config.height_mm + radius, config.pin_top_mm - radius
    return np.linspace(highest, lowest, max(2, math.ceil((highest - lowest) / _BEAD_SPACING_MM) + 1))


def draw_goal(engine: Engine, config: BlockConfig, pose: Floats) -> None:
    """A flat square with a red bar towards +x at ``pose`` (3,), to be seen only."""
    half, bar = config.side_mm / 2, config.marker_mm / 2
    thin = length(0.3)
    shape = pybullet.createVisualShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] * 2,
        halfExtents=[[length(half), length(half), thin], [length(bar * 0.25), length(bar * 0.8), 1.5 * thin]],
        visualFramePositions=[[0, 0, 0], [length(bar * 0.6), 0, 0]],
        rgbaColors=[[0.45, 0.75, 0.45, 1], [0.84, 0.15, 0.16, 1]],
        physicsClientId=engine.client,
    )
    pybullet.createMultiBody(
        baseMass=0,
        baseVisualShapeIndex=shape,
        basePosition=[length(pose[0]), length(pose[1]), thin],
        baseOrientation=pybullet.getQuaternionFromEuler([0.0, 0.0, float(pose[2])]),
        physicsClientId=engine.client,
    )


def _mass_properties(config: BlockConfig) -> tuple[float, float, tuple[float, float, float]]:
    """Mass in kg, height of the centre of mass in mm, and the principal moments in kg mm^2 about it, of solid wood."""
    side, height, radius, pin = config.side_mm, config.height_mm, config.pin_diameter_mm / 2, config.pin_top_mm - config.height_mm
    m_body, m_pin = _WOOD_KG_MM3 * side**2 * height, _WOOD_KG_MM3 * math.pi * radius**2 * pin
    z_body, z_pin = height / 2, height + pin / 2
    centre = (m_body * z_body + m_pin * z_pin) / (m_body + m_pin)
    across = m_body * ((side**2 + height**2) / 12 + (z_body - centre) ** 2) + m_pin * (
        (3 * radius**2 + pin**2) / 12 + (z_pin - centre) ** 2
    )
    along = m_body * side**2 / 6 + m_pin * radius**2 / 2
    return m_body + m_pin, centre, (across, across, along)


GRASPS = ("friction", "constraint")
"""How a pin is held: between two pads, or by a rigid joint. Hands without two sliding pads that have shapes always take the joint."""

LEVER_MM = 42.0
"""How far below the pads a block's centre may hang that friction holds; the solver lets a lower one creep while the hand turns."""

NEAR_MM = 4.0
"""So near to the pin the grip of a hand without such pads has to be, for the block to stick to it."""

CONTROL_S = 0.02
"""How often a run looks at contacts and calls back."""

_CONTROL_STEPS = round(CONTROL_S / SERVO_S)
_TABLE = Surface(lateral=0.3)  # paper on wood; below block half-width / pick height, so that a nudged block slides and does not tip
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


class BulletCell:
    """Both arms, the block with its pin and the table in a PyBullet world of their own.

    Deterministic: equal calls after :meth:`reset` give bit-identical states. A context manager.

    Args:
        model: the cell.
        motion: where the arms park, and how far the fingers open.
        grasp: "friction" (finger contact alone) or "constraint" (a rigid joint while both fingers are on the pin); None: friction for a
            block that hangs less than :data:`LEVER_MM` below two pads that slide. To a hand that has no pads, or none with shapes, and
            to a hinged jaw unless friction is asked for, the block sticks, and passes through it otherwise.
        gui: open PyBullet's window.

    Attributes:
        notes: what was made up for physics, in words.

    Raises:
        UnknownChoice: for another ``grasp``.
        UrdfError: an arm is too weak to hold itself up.
        NoWindow: if ``gui`` and there is no display.
    """

    def __init__(self, model: CellModel, motion: MotionConfig, *, grasp: str | None = None, gui: bool = False) -> None:
        if grasp is not None:
            require_choice("grasp", grasp, GRASPS)
        model.cell.require_grip(motion.finger_travel_mm)
        self.model, self.motion = model, motion
        self.homes_rad = parked_poses(model, motion)
        require_effort(model, motion, self.homes_rad)
        levers_mm = np.asarray(model.cell.pick_heights_mm) - _mass_properties(model.cell.config.block)[1]
        self._bonded = [bool(lever > LEVER_MM) if grasp is None else grasp == "constraint" for lever in levers_mm]
        self._sticky = [not grips_by_friction(arm.description, hinged=grasp == "friction") for arm in model.arms]
        self.notes = _notes(model, self._sticky, self._bonded if grasp is None else [False] * len(levers_mm))
        self.engine = Engine(gui)
        self.reset((0.0, 0.0, 0.0))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Let the physics client go; a second call does nothing."""
        self.engine.close()

    def reset(self, pose: ArrayLike) -> None:
        """Both arms parked with open fingers, the block standing at ``pose`` (3,): x_mm, y_mm, theta_rad; settled, at time 0."""
        self.engine.clear()
        self._table = _table(self.engine, max(1000.0, *(side + 200.0 for side in self.model.cell.extent_mm)))
        self.arms = [SimulatedArm(self.engine, arm, base) for arm, base in zip(self.model.arms, self.model.cell.bases, strict=True)]
        self.block = Block(self.engine, self.model.cell.config.block)
        for arm, sticky in zip(self.arms, self._sticky, strict=True):
            if sticky:
                arm.pass_through(self.block.body, [-1])
        self._bonds: dict[int, int] = {}
        self._holding: set[int] = set()
        for arm, home_rad in zip(self.arms, self.homes_rad, strict=True):
            arm.place(home_rad, self.motion.finger_travel_mm)
        self.block.place(np.asarray(pose, dtype=float))
        self.settle()
        self.engine.time_s = 0.0

    def settle(self, seconds: float = _SETTLE_S) -> None:
        """Let time pass while every servo holds its last set-point."""
        self.engine.advance(seconds)

    def show_goal(self, pose: ArrayLike) -> None:
        """Draw where the block is to go, until the next reset: a flat green square with a red bar, which nothing can touch."""
        draw_goal(self.engine, self.model.cell.config.block, np.asarray(pose, dtype=float))

    def object_pose(self) -> Floats:
        """The block's true pose (3,): x_mm, y_mm, theta_rad."""
        return self.block.pose()

    def joints_rad(self) -> Floats:
        """Where the joints are: (num_arms, 5)."""
        return np.stack([arm.joints_rad() for arm in self.arms])

    def tilt_rad(self) -> float:
        """Angle between the pin and the vertical."""
        return self.block.tilt_rad()

    def held(self, arm: int) -> bool:
        """Whether both fingers of ``arm`` press on the block or its pin; of a hand to which it sticks, whether it does."""
        if self._sticky[arm]:
            return arm in self._bonds or self._over_pin(arm)
        return all(
            any(touch.force_n > 0 for touch in self.engine.touches(self.arms[arm].body, self.block.body, finger))
            for finger in self.arms[arm].fingers
        )

    def collisions(self, holding: set[int] | None = None) -> dict[str, Touch]:
        """The deepest touch of each two that must not touch: arms, an arm and the table (its base apart), a held block and another arm.

        ``holding``: the arms that hold the block; those of the run that is going on if None.
        """
        holding = self._holding if holding is None else holding
        found: dict[str, Touch] = {}
        for index, arm in enumerate(self.arms):
            self._note(found, f"arm {index} - table", [t for t in self.engine.touches(arm.body, self._table) if t.first[1] in arm.above])
            for other in range(index):
                self._note(found, f"arm {other} - arm {index}", self.engine.touches(arm.body, self.arms[other].body))
            carrier = next((other for other in range(len(self.arms)) if other != index and other in holding), None)
            if carrier is not None:
                self._note(found, f"block - arm {index}", self.engine.touches(arm.body, self.block.body))
        return found

    def camera_image(self, width: int = TOP.width_px, height: int = TOP.height_px, camera: Camera = TOP) -> Pixels:
        """What ``camera`` sees now: RGB (height, width, 3)."""
        return picture(self.engine, camera, width, height)

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
                self.engine.pace(FINE if fine else COARSE)
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
            report.grasped = self.held(arm)
            if report.grasped:
                self._holding.add(arm)
                if self._bonded[arm] or self._sticky[arm]:
                    self._bonds[arm] = self._bond(arm)
        elif step == track.opens_at:
            report.kept = self.held(arm)
            self._holding.discard(arm)
            if arm in self._bonds:
                pybullet.removeConstraint(self._bonds.pop(arm), physicsClientId=self.engine.client)

    def _over_pin(self, arm: int) -> bool:
        """Whether the grip of an arm is at the pin."""
        T, grip = self.block.transform(), self.arms[arm].grip_mm()
        along, across = float((grip - T[:3, 3]) @ T[:3, 2]), np.cross(grip - T[:3, 3], T[:3, 2])
        block = self.model.cell.config.block
        return block.height_mm <= along <= block.pin_top_mm and float(np.linalg.norm(across)) <= NEAR_MM

    def _bond(self, arm: int) -> int:
        """A rigid joint between the hand and the block as they are now."""
        client, hand = self.engine.client, self.arms[arm].hand
        at, turned = pybullet.getLinkState(self.arms[arm].body, hand, physicsClientId=client)[:2]
        block = pybullet.getBasePositionAndOrientation(self.block.body, physicsClientId=client)
        in_hand = pybullet.multiplyTransforms(*pybullet.invertTransform(at, turned), *block)
        return int(
            pybullet.createConstraint(
                self.arms[arm].body,
                hand,
                self.block.body,
                -1,
                pybullet.JOINT_FIXED,
                [0, 0, 0],
                in_hand[0],
                [0, 0, 0],
                in_hand[1],
                physicsClientId=client,
            )
        )

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


def _table(engine: Engine, side_mm: float) -> int:
    half, thick = length(side_mm), length(50.0)
    client = engine.client
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[half, half, thick], physicsClientId=client)
    look = pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=[half, half, thick], rgbaColor=[0.93, 0.93, 0.91, 1], physicsClientId=client
    )
    body = int(pybullet.createMultiBody(0, shape, look, [0, 0, -thick], physicsClientId=client))
    engine.coat(body, [-1], _TABLE)
    return body

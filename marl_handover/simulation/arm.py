"""One arm of the simulated cell: its servos and its gripper."""

from __future__ import annotations

from typing import Any

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.capsules import joints_before
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Gripper, Joint
from marl_handover.simulation.engine import Engine, Servo

GRIP_FORCE_N = 2.0
"""What each finger closes with: plenty for a block of 16 g. The servo could ten times as much, and would bend the pin."""

SERVO_S = 0.004
"""How often servos get a set-point."""

_SERVO_GAIN = 0.05  # part of a position error that a servo removes within one step, speed and torque permitting
_GRIP_GAIN = 0.25  # high, so that fingers stopped by the pin press with all their force
_UNLIMITED = 1e9
_HAND_LEVEL = 4  # arm joints before the wrist's link


def grips_by_friction(description: ArmDescription, *, hinged: bool = False) -> bool:
    """Whether a hand has two sliding pads with shapes, between which friction holds a pin; ``hinged``: or a jaw, whose pads tilt."""
    shaped = {link.name for link in description.links if link.collisions}
    fingers = finger_links(description)
    kind = description.gripper.kind
    return bool(fingers) and shaped.issuperset(fingers) and (len(fingers) > 1 if kind == "fingers" else hinged and kind == "jaw")


def turning_roles(description: ArmDescription) -> list[int]:
    """Which of :data:`ARM_JOINTS` an arm has."""
    has = [source.joint is not None for source in description.sources]
    return [role for role, name in enumerate(ARM_JOINTS) if has[role] and description.joint(name).kind != "fixed"]


def finger_links(description: ArmDescription) -> tuple[str, ...]:
    """The pads that move, in the order of the gripper's joints."""
    return tuple(description.joint(name).child for name in description.gripper.joints)


def wrist_links(description: ArmDescription) -> tuple[str, ...]:
    """Links of the wrist and the hand."""
    return tuple(link for link, level in joints_before(description).items() if level >= _HAND_LEVEL)


def fingers_coupled(gripper: Gripper) -> tuple[float, float] | None:
    """``(ratio, offset_mm)`` of two sliding fingers, which one servo drives: first + ratio * second = offset. None of other hands."""
    if gripper.kind != "fingers" or len(gripper.joints) != 2:
        return None
    closed, moved = (_values_mm(gripper, pad_mm) for pad_mm in (0.0, 1.0))
    ratio = -(moved[0] - closed[0]) / (moved[1] - closed[1])
    return ratio, closed[0] + ratio * closed[1]


def _values_mm(gripper: Gripper, pad_mm: float) -> list[float]:
    """Values of the gripper's joints, mm or rad."""
    values = gripper.joint_values(pad_mm)
    return [values[name] for name in gripper.joints]


class SimulatedArm:
    """The arm of number ``index`` in an :class:`Engine`.

    Attributes:
        fingers: the pads that move, by name.
        above: links that do not stand on the table, by name.
    """

    def __init__(self, engine: Engine, index: int, model: ArmModel) -> None:
        self._engine, self._index, description = engine, index, model.description
        self._gripper = description.gripper
        self._turning = turning_roles(description)
        self._joints = [self._servo(description.joint(ARM_JOINTS[role])) for role in self._turning]
        self._grippers = [self._finger(description.joint(name)) for name in self._gripper.joints]
        self._indices = [servo.joint for servo in self._joints]
        self._finger_indices = [servo.joint for servo in self._grippers]
        self.fingers = finger_links(description)
        self.above = frozenset(link for link, level in joints_before(description).items() if level > 1)

    def _servo(self, joint: Joint) -> Servo:
        return Servo(self._engine.joint(self._index, joint.name), self._engine.units.torque(joint.effort), joint.velocity)

    def _finger(self, joint: Joint) -> Servo:
        """A gripper's servo; its speed in the world's lengths, a jaw's at its pad."""
        units, number = self._engine.units, self._engine.joint(self._index, joint.name)
        if self._gripper.kind == "fingers":
            return Servo(number, units.force(GRIP_FORCE_N), units.length(joint.velocity))
        lever_mm = self._gripper.lever_mm
        return Servo(number, units.torque(GRIP_FORCE_N * lever_mm / 1000), units.length(joint.velocity * lever_mm))

    def _finger_values(self, aim: float) -> list[float]:
        """Values of the gripper's joints in the world's units, of pads ``aim`` of its lengths from closed."""
        units = self._engine.units
        if self._gripper.kind != "fingers":
            return _values_mm(self._gripper, float(units.to_mm([aim])[0]))
        closed, opened = (_values_mm(self._gripper, pad_mm) for pad_mm in (0.0, 1.0))
        return [units.length(at) + (there - at) * aim for at, there in zip(closed, opened, strict=True)]

    def place(self, joints_rad: Floats, gripper_mm: float) -> None:
        """Put the joints (5,) there at rest, without moving through the room, and hold them."""
        for servo, role in zip(self._joints, self._turning, strict=True):
            self._engine.set_joint(self._index, servo.joint, float(joints_rad[role]))
        self._finger_aim = self._engine.units.length(gripper_mm)
        for servo, value in zip(self._grippers, self._finger_values(self._finger_aim), strict=True):
            self._engine.set_joint(self._index, servo.joint, value)
        self.aim(joints_rad, np.zeros(5), gripper_mm)

    def aim(self, joints_rad: Floats, velocity_rad_s: Floats, gripper_mm: float) -> None:
        """Set-points: where the joints (5,) should be now, their speed from here (5,), how far each finger is to be from closed."""
        if self._grippers:
            # Fingers have the limit of their speed in the set-point: a limit in the servo would take force from fingers that the pin stops.
            furthest = self._grippers[0].velocity * SERVO_S
            self._finger_aim += min(furthest, max(-furthest, self._engine.units.length(gripper_mm) - self._finger_aim))
        self._set_points = (joints_rad, velocity_rad_s)
        self._drive()

    def _drive(self) -> None:
        engine, (joints_rad, velocity_rad_s) = self._engine, self._set_points
        for servo, role in zip(self._joints, self._turning, strict=True):
            engine.drive(self._index, servo, float(joints_rad[role]), float(velocity_rad_s[role]), _SERVO_GAIN)
        for servo, value in zip(self._grippers, self._finger_values(self._finger_aim) if self._grippers else (), strict=True):
            engine.drive(self._index, servo._replace(velocity=_UNLIMITED), value, 0.0, _GRIP_GAIN)

    def joints_rad(self) -> Floats:
        """Where the joints are: (5,)."""
        q = np.zeros(len(ARM_JOINTS))
        q[self._turning] = self._engine.joint_values(self._index, self._indices)
        return q

    def gripper_mm(self) -> float:
        """How far the fingers are from closed, each, on average."""
        states = self._engine.joint_values(self._index, self._finger_indices)
        return self._gripper.gripper_mm(self._engine.units.to_mm(states).tolist() if self._gripper.kind == "fingers" else states)

    def grip_mm(self) -> Floats:
        """Where the grasp frame is in the world (3,)."""
        return self._engine.grip_mm(self._index)

    def save(self) -> Any:
        """Its set-points."""
        return self._set_points, self._finger_aim

    def restore(self, state: Any) -> None:
        """Go back to what :meth:`save` gave."""
        self._set_points, self._finger_aim = state
        self._drive()

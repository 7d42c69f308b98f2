"""One arm of the simulated cell: its servos and its gripper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.capsules import joints_before
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Joint
from marl_handover.simulation.arm_file import arm_file, is_canonical
from marl_handover.simulation.engine import Engine, Surface, force, length, pybullet, to_mm, torque

GRIP_FORCE_N = 2.0
"""What each finger closes with: plenty for a block of 16 g. The servo could ten times as much, and would bend the pin."""

SERVO_S = 0.004
"""How often servos get a set-point."""

_PADS = Surface(lateral=1.0, patch_mm=2.0)  # rubber
_SHELL = Surface(lateral=0.4)
_SERVO_GAIN = 0.05  # part of a position error that a servo removes within one step, speed and torque permitting
_GRIP_GAIN = 0.25  # high, so that fingers stopped by the pin press with all their force
_GEAR_FORCE_N = 200.0
_UNLIMITED = 1e9
_HAND_LEVEL = 4  # arm joints before the wrist's link


class _Servo(NamedTuple):
    link: int
    effort: float
    velocity: float


def grips_by_friction(description: ArmDescription, *, hinged: bool = False) -> bool:
    """Whether a hand has two sliding pads with shapes, between which friction holds a pin; ``hinged``: or a jaw, whose pads tilt."""
    shaped = {link.name for link in description.links if link.collisions}
    fingers = [joint.child for joint in description.joints if joint.name in description.gripper.joints]
    kind = description.gripper.kind
    return bool(fingers) and shaped.issuperset(fingers) and (len(fingers) > 1 if kind == "fingers" else hinged and kind == "jaw")


class SimulatedArm:
    """An arm in an :class:`Engine`.

    Attributes:
        body: its number there; the others are link numbers.
        hand: what the roll joint turns.
        grip: the grasp frame.
        fingers: the pads that move.
        above: links that do not stand on the table.
        wrist: links of the wrist and the hand.
    """

    def __init__(self, engine: Engine, model: ArmModel, base: SE2) -> None:
        self._engine, self._gripper = engine, model.description.gripper
        description = model.description
        with arm_file(description) as path:
            self.body = engine.load_arm(path, base.x_mm, base.y_mm, base.facing_rad, touches_itself=is_canonical(description))
        count = pybullet.getNumJoints(self.body, physicsClientId=self._client)
        info = [pybullet.getJointInfo(self.body, link, physicsClientId=self._client) for link in range(count)]
        links, children = ({entry[column].decode(): entry[0] for entry in info} for column in (1, 12))
        turning = [name for name in ARM_JOINTS if info[links[name]][2] != pybullet.JOINT_FIXED]
        self._turning = [ARM_JOINTS.index(name) for name in turning]
        joint = description.joint
        self._joints = [_Servo(links[name], torque(joint(name).effort), joint(name).velocity) for name in turning]
        self._grippers = [self._finger(links[name], joint(name)) for name in self._gripper.joints]
        self.fingers = tuple(servo.link for servo in self._grippers)
        self.hand, self.grip = links[ARM_JOINTS[-1]], children[description.grasp_link]
        levels = joints_before(description)
        self.above = frozenset(link for name, link in children.items() if levels[name] > 1)
        self.wrist = tuple(link for name, link in children.items() if levels[name] >= _HAND_LEVEL)
        self._indices = [servo.link for servo in self._joints]
        for servo, role in zip(self._joints, self._turning, strict=True):
            engine.dynamics(self.body, servo.link, jointLowerLimit=model.lower_rad[role], jointUpperLimit=model.upper_rad[role])
        engine.coat(self.body, range(-1, count), _SHELL)
        engine.coat(self.body, self.fingers, _PADS)
        self._gear()

    @property
    def _client(self) -> int:
        return self._engine.client

    def _finger(self, link: int, joint: Joint) -> _Servo:
        """A gripper's servo; its speed in the world's lengths, a jaw's at its pad."""
        if self._gripper.kind == "fingers":
            return _Servo(link, force(GRIP_FORCE_N), length(joint.velocity))
        return _Servo(link, torque(GRIP_FORCE_N * self._gripper.lever_mm / 1000), length(joint.velocity * self._gripper.lever_mm))

    def _gear(self) -> None:
        """Couple two fingers, which one servo drives: else a sideways push would shift both, and the pin between them."""
        if self._gripper.kind != "fingers" or len(self.fingers) != 2:
            return
        (left, right), (closed, moved) = self.fingers, (self._values_mm(pad_mm) for pad_mm in (0.0, 1.0))
        ratio = -(moved[0] - closed[0]) / (moved[1] - closed[1])
        gear = pybullet.createConstraint(
            self.body, left, self.body, right, pybullet.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0], physicsClientId=self._client
        )
        pybullet.changeConstraint(
            gear,
            gearRatio=ratio,
            erp=0.5,
            relativePositionTarget=length(closed[0] + ratio * closed[1]),
            maxForce=force(_GEAR_FORCE_N),
            physicsClientId=self._client,
        )

    def _values_mm(self, pad_mm: float) -> list[float]:
        """Values of the gripper's joints, mm or rad."""
        values = self._gripper.joint_values(pad_mm)
        return [values[name] for name in self._gripper.joints]

    def _finger_values(self, aim: float) -> list[float]:
        """The same in the world's units, of pads ``aim`` of its lengths from closed."""
        if self._gripper.kind != "fingers":
            return self._values_mm(float(to_mm([aim])[0]))
        return [length(at) + (there - at) * aim for at, there in zip(self._values_mm(0.0), self._values_mm(1.0), strict=True)]

    def place(self, joints_rad: Floats, gripper_mm: float) -> None:
        """Put the joints (5,) there at rest, without moving through the room, and hold them."""
        for servo, role in zip(self._joints, self._turning, strict=True):
            pybullet.resetJointState(self.body, servo.link, float(joints_rad[role]), 0.0, physicsClientId=self._client)
        self._finger_aim = length(gripper_mm)
        for servo, value in zip(self._grippers, self._finger_values(self._finger_aim), strict=True):
            pybullet.resetJointState(self.body, servo.link, value, 0.0, physicsClientId=self._client)
        self.aim(joints_rad, np.zeros(5), gripper_mm)

    def aim(self, joints_rad: Floats, velocity_rad_s: Floats, gripper_mm: float) -> None:
        """Set-points: where the joints (5,) should be now, their speed from here (5,), how far each finger is to be from closed."""
        for servo, role in zip(self._joints, self._turning, strict=True):
            self._drive(servo, float(joints_rad[role]), float(velocity_rad_s[role]), _SERVO_GAIN)
        if not self._grippers:
            return
        # Fingers have the limit of their speed in the set-point: a limit in the servo would take force from fingers that the pin stops.
        furthest = self._grippers[0].velocity * SERVO_S
        self._finger_aim += min(furthest, max(-furthest, length(gripper_mm) - self._finger_aim))
        for servo, value in zip(self._grippers, self._finger_values(self._finger_aim), strict=True):
            self._drive(servo._replace(velocity=_UNLIMITED), value, 0.0, _GRIP_GAIN)

    def _drive(self, servo: _Servo, position: float, velocity: float, gain: float) -> None:
        pybullet.setJointMotorControl2(
            self.body,
            servo.link,
            pybullet.POSITION_CONTROL,
            targetPosition=position,
            targetVelocity=velocity,
            force=servo.effort,
            positionGain=gain,
            velocityGain=1.0,
            maxVelocity=servo.velocity,
            physicsClientId=self._client,
        )

    def joints_rad(self) -> Floats:
        """Where the joints are: (5,)."""
        q = np.zeros(len(ARM_JOINTS))
        q[self._turning] = [state[0] for state in pybullet.getJointStates(self.body, self._indices, physicsClientId=self._client)]
        return q

    def gripper_mm(self) -> float:
        """How far the fingers are from closed, each, on average."""
        states = [state[0] for state in pybullet.getJointStates(self.body, list(self.fingers), physicsClientId=self._client)]
        return self._gripper.gripper_mm(to_mm(states).tolist() if self._gripper.kind == "fingers" else states)

    def pass_through(self, body: int, links: Sequence[int]) -> None:
        """Let nothing come of touches between the hand and ``links`` of another body."""
        for own in self.wrist:
            for link in links:
                pybullet.setCollisionFilterPair(self.body, body, own, link, 0, physicsClientId=self._client)

    def grip_mm(self) -> Floats:
        """Where the grasp frame is in the world (3,)."""
        return to_mm(pybullet.getLinkState(self.body, self.grip, computeForwardKinematics=1, physicsClientId=self._client)[4])

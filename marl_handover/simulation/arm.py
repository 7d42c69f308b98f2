"""One arm of the simulated cell: five servos and a gripper."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.simulation.engine import Engine, Floats, Surface, force, length, pybullet, to_mm, torque

GRIP_FORCE_N = 2.0
"""What each finger closes with: plenty for a block of 16 g. The servo could ten times as much, and would bend the pin."""

SERVO_S = 0.004
"""How often servos get a set-point."""

_FINGERS = ("finger_left", "finger_right")
_PADS = Surface(lateral=1.0, patch_mm=2.0)  # rubber
_SHELL = Surface(lateral=0.4)
_SERVO_GAIN = 0.05  # part of a position error that a servo removes within one step, speed and torque permitting
_GRIP_GAIN = 0.25  # high, so that fingers stopped by the pin press with all their force
_GEAR_FORCE_N = 200.0
_UNLIMITED = 1e9


class _Servo(NamedTuple):
    link: int
    effort: float
    velocity: float


class SimulatedArm:
    """An arm in an :class:`Engine`. ``body`` is its number there, ``hand`` and ``fingers`` are link numbers."""

    def __init__(self, engine: Engine, model: ArmModel, base: SE2) -> None:
        self._engine = engine
        self.body = engine.load_arm(model.description.path, base.x_mm, base.y_mm, base.facing_rad)
        count = pybullet.getNumJoints(self.body, physicsClientId=self._client)
        info = [pybullet.getJointInfo(self.body, link, physicsClientId=self._client) for link in range(count)]
        links = {entry[1].decode(): entry[0] for entry in info}
        joint = model.description.joint
        self._joints = [_Servo(links[name], torque(joint(name).effort), joint(name).velocity) for name in ARM_JOINTS]
        self._grippers = [_Servo(links[name], force(GRIP_FORCE_N), length(joint(name).velocity)) for name in _FINGERS]
        self.fingers = tuple(servo.link for servo in self._grippers)
        self.hand = self._joints[-1].link
        self._indices = [servo.link for servo in self._joints]
        for servo, lower, upper in zip(self._joints, model.lower_rad, model.upper_rad, strict=True):
            engine.dynamics(self.body, servo.link, jointLowerLimit=lower, jointUpperLimit=upper)
        engine.coat(self.body, range(-1, count), _SHELL)
        engine.coat(self.body, self.fingers, _PADS)
        self._gear()

    @property
    def _client(self) -> int:
        return self._engine.client

    def _gear(self) -> None:
        """Couple the fingers, which one servo drives: else a sideways push would shift both, and the pin between them."""
        left, right = self.fingers
        gear = pybullet.createConstraint(
            self.body, left, self.body, right, pybullet.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0], physicsClientId=self._client
        )
        pybullet.changeConstraint(
            gear, gearRatio=-1.0, erp=0.5, relativePositionTarget=0.0, maxForce=force(_GEAR_FORCE_N), physicsClientId=self._client
        )

    def place(self, joints_rad: Floats, gripper_mm: float) -> None:
        """Put the joints (5,) there at rest, without moving through the room, and hold them."""
        for servo, angle in zip(self._joints, joints_rad, strict=True):
            pybullet.resetJointState(self.body, servo.link, float(angle), 0.0, physicsClientId=self._client)
        for servo in self._grippers:
            pybullet.resetJointState(self.body, servo.link, length(gripper_mm), 0.0, physicsClientId=self._client)
        self._finger_aim = length(gripper_mm)
        self.aim(joints_rad, np.zeros(5), gripper_mm)

    def aim(self, joints_rad: Floats, velocity_rad_s: Floats, gripper_mm: float) -> None:
        """Set-points: where the joints (5,) should be now, their speed from here (5,), how far each finger is to be from closed."""
        for servo, angle, speed in zip(self._joints, joints_rad, velocity_rad_s, strict=True):
            self._drive(servo, float(angle), float(speed), _SERVO_GAIN)
        # Fingers have the limit of their speed in the set-point: a limit in the servo would take force from fingers that the pin stops.
        furthest = self._grippers[0].velocity * SERVO_S
        self._finger_aim += min(furthest, max(-furthest, length(gripper_mm) - self._finger_aim))
        for servo in self._grippers:
            self._drive(servo._replace(velocity=_UNLIMITED), self._finger_aim, 0.0, _GRIP_GAIN)

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
        return np.array([state[0] for state in pybullet.getJointStates(self.body, self._indices, physicsClientId=self._client)])

    def gripper_mm(self) -> float:
        """How far the fingers are from closed, each, on average."""
        states = pybullet.getJointStates(self.body, list(self.fingers), physicsClientId=self._client)
        return float(np.mean(to_mm(state[0] for state in states)))

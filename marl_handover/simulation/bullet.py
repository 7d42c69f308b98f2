"""The cell's world in PyBullet.

The world is blown up by :data:`SCALE`: Bullet's collision tolerances are made for bodies of decimetres, and a pin 2.5 mm thick is finer
than they are.
"""

from __future__ import annotations

import ctypes
import os
import sys
import weakref
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Floats
from marl_handover.errors import UrdfError
from marl_handover.geometry.arm_model import ArmModel
from marl_handover.geometry.se2 import SE2
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.simulation.arm import finger_links, fingers_coupled, turning_roles, wrist_links
from marl_handover.simulation.arm_file import arm_file, is_canonical
from marl_handover.simulation.block import TABLE_MM, TABLE_RGB, beads_mm, block_look, mass_properties
from marl_handover.simulation.camera import LIGHT, NEAR_MM, Camera, Pixels, far_mm, frustum_mm, strip_triangles
from marl_handover.simulation.engine import (
    BLOCK,
    TABLE,
    NotCopied,
    NoWindow,
    Scene,
    Servo,
    Touch,
    Units,
    WorldClosed,
    missing_engine,
    require_display,
)


@contextmanager
def _silent() -> Iterator[None]:
    """Nothing that C code prints in this block comes out; what was printed before does, and in its order."""
    try:
        kept = {number: os.dup(number) for number in (1, 2)}
    except OSError:  # no standard streams, nothing to silence
        yield
        return
    _flush()
    try:
        with open(os.devnull, "wb") as nowhere:
            for number in kept:
                os.dup2(nowhere.fileno(), number)
        yield
    finally:
        _flush()
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)


def _flush() -> None:
    """Empty the buffers of Python's streams and of C's."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    with suppress(OSError, TypeError, AttributeError):  # a system without a C library in the process
        ctypes.CDLL(None).fflush(None)


try:
    with _silent():  # it prints when it was built
        import pybullet
except ModuleNotFoundError as error:
    raise missing_engine("bullet", "pybullet") from error

SCALE = 10.0
UNITS = Units(SCALE)
length, to_mm, inertia = UNITS.length, UNITS.to_mm, UNITS.inertia


class Pace(NamedTuple):
    """How finely time is cut, and how long the solver works on each piece."""

    step_s: float
    iterations: int


COARSE = Pace(1 / 250, 50)
FINE = Pace(1 / 1000, 300)
"""With less, the solver's leftover forces turn the block in the grip when the hand pitches on the way."""

_GRAVITY_M_S2 = 9.81
_GEAR_FORCE_N = 200.0


class Surface(NamedTuple):
    """Friction of a body's surface; Bullet multiplies the lateral values of two that touch.

    ``patch_mm`` stands for the radius of a soft contact patch, which resists rolling and spinning.
    """

    lateral: float
    patch_mm: float = 0.0


_PADS = Surface(lateral=1.0, patch_mm=2.0)  # rubber
_SHELL = Surface(lateral=0.4)
_WOOD = Surface(lateral=1.0)
_TABLE = Surface(lateral=0.3)  # paper on wood; below block half-width / pick height, so that a nudged block slides and does not tip


class _Arm(NamedTuple):
    """An arm's number in PyBullet; its joints and links by name; of a link's number, its name."""

    body: int
    joints: dict[str, int]
    links: dict[str, int]
    names: dict[int, str]
    grip: int


class BulletEngine(NotCopied):
    """A physics client: an :class:`~marl_handover.simulation.engine.Engine`. Each call to PyBullet names its own."""

    units = UNITS

    def __init__(self, scene: Scene, gui: bool = False) -> None:
        if gui:  # without a display PyBullet does not fail, it ends the process
            require_display("PyBullet")
        try:
            client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        except pybullet.error as error:
            raise NoWindow("PyBullet") from error
        if client < 0:
            raise NoWindow("PyBullet")
        self.scene = scene
        self._client = client
        self._connection = weakref.finalize(self, _disconnect, client)
        self.time_s = 0.0

    @property
    def client(self) -> int:
        """The number by which PyBullet knows this world. It gives the number to another world later.

        Raises:
            WorldClosed: after :meth:`close`.
        """
        if not self._connection.alive:
            raise WorldClosed()
        return self._client

    def reset(self) -> None:
        """An empty world, filled again."""
        pybullet.resetSimulation(physicsClientId=self.client)
        pybullet.setGravity(0, 0, -_GRAVITY_M_S2 * SCALE, physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(numSubSteps=0, deterministicOverlappingPairs=1, physicsClientId=self.client)
        self.fine(False)
        self.time_s = 0.0
        self._bonds: dict[int, tuple[int, Any]] = {}
        self._table = self._make_table()
        self.arms = [self._load(arm, base) for arm, base in zip(self.scene.arms, self.scene.bases, strict=True)]
        self.block = self._make_block()
        for index, passes in enumerate(self.scene.passes):
            if passes:
                self._pass_through(index)

    def fine(self, fine: bool) -> None:
        """Cut time finely, or coarsely."""
        pace = FINE if fine else COARSE
        self._pace = pace
        pybullet.setPhysicsEngineParameter(fixedTimeStep=pace.step_s, numSolverIterations=pace.iterations, physicsClientId=self.client)

    def advance(self, seconds: float) -> None:
        """Let time pass, in whole steps."""
        steps = round(seconds / self._pace.step_s)
        client = self.client
        for _ in range(steps):
            pybullet.stepSimulation(physicsClientId=client)
        self.time_s += steps * self._pace.step_s

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        self._connection()

    def joint(self, arm: int, name: str) -> int:
        """A link's number: that of the link that the joint moves."""
        return self.arms[arm].joints[name]

    def set_joint(self, arm: int, joint: int, value: float) -> None:
        """Put a joint there at rest."""
        pybullet.resetJointState(self.arms[arm].body, joint, value, 0.0, physicsClientId=self.client)

    def drive(self, arm: int, servo: Servo, position: float, velocity: float, gain: float) -> None:
        """A set-point of a servo."""
        pybullet.setJointMotorControl2(
            self.arms[arm].body,
            servo.joint,
            pybullet.POSITION_CONTROL,
            targetPosition=position,
            targetVelocity=velocity,
            force=servo.effort,
            positionGain=gain,
            velocityGain=1.0,
            maxVelocity=servo.velocity,
            physicsClientId=self.client,
        )

    def joint_values(self, arm: int, joints: Sequence[int]) -> list[float]:
        """Where joints are."""
        return [state[0] for state in pybullet.getJointStates(self.arms[arm].body, joints, physicsClientId=self.client)]

    def grip_mm(self, arm: int) -> Floats:
        """Where an arm's grasp frame is (3,)."""
        body, grip = self.arms[arm].body, self.arms[arm].grip
        return to_mm(pybullet.getLinkState(body, grip, computeForwardKinematics=1, physicsClientId=self.client)[4])

    def put_block(self, xyz_mm: Sequence[float], rpy_rad: Sequence[float]) -> None:
        """Put the block's frame there, at rest."""
        T = transform(xyz_mm, rpy_rad)
        at = [length(value) for value in T[:3, 3] + self._centre_mm * T[:3, 2]]
        turned = pybullet.getQuaternionFromEuler(list(rpy_rad))
        pybullet.resetBasePositionAndOrientation(self.block, at, turned, physicsClientId=self.client)
        pybullet.resetBaseVelocity(self.block, [0, 0, 0], [0, 0, 0], physicsClientId=self.client)

    def block_transform(self) -> Floats:
        """T_world_block (4, 4) in mm."""
        at, quaternion = pybullet.getBasePositionAndOrientation(self.block, physicsClientId=self.client)
        T = np.eye(4)
        T[:3, :3] = np.reshape(pybullet.getMatrixFromQuaternion(quaternion), (3, 3))
        T[:3, 3] = to_mm(at) - self._centre_mm * T[:3, 2]
        return T

    def touches(self, first: int, second: int, link: str | None = None) -> list[Touch]:
        """Where two bodies touched in the last step."""
        only = {} if link is None else {"linkIndexA": self.arms[first].links[link]}
        found = pybullet.getContactPoints(bodyA=self._body(first), bodyB=self._body(second), physicsClientId=self.client, **only) or ()
        return [Touch(self._link(first, hit[3]), self._link(second, hit[4]), to_mm([hit[8]])[0], hit[9] / SCALE) for hit in found]

    def _body(self, number: int) -> int:
        return {TABLE: self._table, BLOCK: self.block}[number] if number < 0 else self.arms[number].body

    def _link(self, number: int, link: int) -> str:
        return "" if number < 0 else self.arms[number].names[link]

    def bond(self, arm: int) -> None:
        """A rigid joint between an arm's hand and the block as they are now."""
        hand = self.arms[arm].joints[ARM_JOINTS[-1]]
        at, turned = pybullet.getLinkState(self.arms[arm].body, hand, physicsClientId=self.client)[:2]
        block = pybullet.getBasePositionAndOrientation(self.block, physicsClientId=self.client)
        self._tie(arm, pybullet.multiplyTransforms(*pybullet.invertTransform(at, turned), *block))

    def _tie(self, arm: int, in_hand: Any) -> None:
        body, hand = self.arms[arm].body, self.arms[arm].joints[ARM_JOINTS[-1]]
        zero = [0, 0, 0]
        tie = pybullet.createConstraint(
            body, hand, self.block, -1, pybullet.JOINT_FIXED, zero, in_hand[0], zero, in_hand[1], physicsClientId=self.client
        )
        self._bonds[arm] = (int(tie), in_hand)

    def release(self, arm: int) -> None:
        """Take the rigid joint away."""
        pybullet.removeConstraint(self._bonds.pop(arm)[0], physicsClientId=self.client)

    def picture(self, camera: Camera, width: int, height: int) -> Pixels:
        """What ``camera`` sees now, drawn by PyBullet's software renderer, which needs no display."""
        eye, target = ([length(value) for value in point] for point in (camera.eye_mm, camera.target_mm))
        half_width, half_height = (length(half) for half in frustum_mm(camera, width, height))
        _, _, pixels, _, _ = pybullet.getCameraImage(
            width,
            height,
            viewMatrix=pybullet.computeViewMatrix(eye, target, camera.up),
            projectionMatrix=pybullet.computeProjectionMatrix(
                -half_width, half_width, -half_height, half_height, length(NEAR_MM), length(far_mm(camera))
            ),
            lightDirection=LIGHT,
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        return np.ascontiguousarray(np.reshape(np.asarray(pixels, dtype=np.uint8), (height, width, 4))[..., :3])

    def lay(self, one_mm: Floats, other_mm: Floats, height_mm: float, rgb: ArrayLike) -> None:
        """A flat strip between two edges, seen from both sides."""
        edges = np.concatenate([one_mm, other_mm])
        vertices = [[length(x), length(y), 0.0] for x, y in edges]
        corners = strip_triangles(len(one_mm))
        shape = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            indices=np.concatenate([corners, corners[:, ::-1]]).ravel().tolist(),
            normals=[[0, 0, 1]] * len(vertices),
            rgbaColor=[*np.asarray(rgb, float), 1.0],
            physicsClientId=self.client,
        )
        pybullet.createMultiBody(
            baseMass=0, baseVisualShapeIndex=shape, basePosition=[0, 0, length(height_mm)], physicsClientId=self.client
        )

    def paint_base(self, arm: int, rgb: ArrayLike) -> None:
        """Colour an arm's base and what turns on it."""
        for link in (-1, 0):
            pybullet.changeVisualShape(self.arms[arm].body, link, rgbaColor=[*np.asarray(rgb, float), 1.0], physicsClientId=self.client)

    def save(self) -> Any:
        """A number by which PyBullet knows the state, and what it forgets."""
        number = pybullet.saveState(physicsClientId=self.client)
        return number, self.time_s, self._pace is FINE, {arm: in_hand for arm, (_, in_hand) in self._bonds.items()}

    def restore(self, state: Any) -> None:
        """Go back to what :meth:`save` gave."""
        number, self.time_s, fine, bonds = state
        for arm in list(self._bonds):
            self.release(arm)
        for arm, in_hand in bonds.items():
            self._tie(arm, in_hand)
        self.fine(fine)
        pybullet.restoreState(number, physicsClientId=self.client)

    def _load(self, arm: ArmModel, base: SE2) -> _Arm:
        """The arm's URDF, its base fixed to the table."""
        description = arm.description
        touches_itself = is_canonical(description)
        with arm_file(description) as path:
            try:
                body = pybullet.loadURDF(
                    str(path),
                    basePosition=[length(base.x_mm), length(base.y_mm), 0.0],
                    baseOrientation=pybullet.getQuaternionFromEuler([0.0, 0.0, base.facing_rad]),
                    useFixedBase=True,
                    globalScaling=SCALE,
                    flags=pybullet.URDF_USE_INERTIA_FROM_FILE | (pybullet.URDF_USE_SELF_COLLISION if touches_itself else 0),
                    physicsClientId=self.client,
                )
            except pybullet.error as error:
                raise UrdfError(path, "PyBullet cannot load it; every mesh it names has to be there, as .obj, .stl or .dae") from error
        count = pybullet.getNumJoints(body, physicsClientId=self.client)
        for link in range(count):
            # globalScaling leaves inertias as the file has them.
            moments = pybullet.getDynamicsInfo(body, link, physicsClientId=self.client)[2]
            self._change(body, link, localInertiaDiagonal=[SCALE**2 * value for value in moments], linearDamping=0.0, angularDamping=0.0)
        info = [pybullet.getJointInfo(body, link, physicsClientId=self.client) for link in range(count)]
        joints, links = ({entry[column].decode(): entry[0] for entry in info} for column in (1, 12))
        for role in turning_roles(description):
            limits = {"jointLowerLimit": arm.lower_rad[role], "jointUpperLimit": arm.upper_rad[role]}
            self._change(body, joints[ARM_JOINTS[role]], **limits)
        self._coat(body, range(-1, count), _SHELL)
        self._coat(body, [links[name] for name in finger_links(description)], _PADS)
        if coupling := fingers_coupled(description.gripper):
            self._gear(body, [joints[name] for name in description.gripper.joints], *coupling)
        return _Arm(
            int(body), joints, links, {-1: description.root} | {link: name for name, link in links.items()}, links[description.grasp_link]
        )

    def _gear(self, body: int, fingers: Sequence[int], ratio: float, offset_mm: float) -> None:
        gear = pybullet.createConstraint(
            body, fingers[0], body, fingers[1], pybullet.JOINT_GEAR, [0, 1, 0], [0, 0, 0], [0, 0, 0], physicsClientId=self.client
        )
        pybullet.changeConstraint(
            gear,
            gearRatio=ratio,
            erp=0.5,
            relativePositionTarget=length(offset_mm),
            maxForce=UNITS.force(_GEAR_FORCE_N),
            physicsClientId=self.client,
        )

    def _pass_through(self, arm: int) -> None:
        """Let nothing come of touches between a hand and the block."""
        for name in wrist_links(self.scene.arms[arm].description):
            link = self.arms[arm].links[name]
            pybullet.setCollisionFilterPair(self.arms[arm].body, self.block, link, -1, 0, physicsClientId=self.client)

    def _make_table(self) -> int:
        half, thick = length(self.scene.table_mm), length(TABLE_MM)
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[half, half, thick], physicsClientId=self.client)
        look = pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=[half, half, thick], rgbaColor=[*TABLE_RGB, 1], physicsClientId=self.client
        )
        body = int(pybullet.createMultiBody(0, shape, look, [0, 0, -thick], physicsClientId=self.client))
        self._coat(body, [-1], _TABLE)
        return body

    def _make_block(self) -> int:
        config = self.scene.block
        mass, self._centre_mm, moments = mass_properties(config)
        beads, up = beads_mm(config), config.height_mm
        collision = pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] + [pybullet.GEOM_SPHERE] * len(beads),
            halfExtents=[[length(config.side_mm / 2), length(config.side_mm / 2), length(up / 2)]] + [[0, 0, 0]] * len(beads),
            radii=[0] + [length(config.pin_diameter_mm / 2)] * len(beads),
            collisionFramePositions=[[0, 0, length(up / 2)]] + [[0, 0, length(z)] for z in beads],
            physicsClientId=self.client,
        )
        body = int(
            pybullet.createMultiBody(
                baseMass=mass,
                baseCollisionShapeIndex=collision,
                baseVisualShapeIndex=self._block_visual(),
                baseInertialFramePosition=[0, 0, length(self._centre_mm)],
                physicsClientId=self.client,
            )
        )
        self._coat(body, [-1], _WOOD)
        self._change(
            body,
            -1,
            localInertiaDiagonal=[inertia(moment) for moment in moments],
            linearDamping=0.0,
            angularDamping=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        return body

    def _block_visual(self) -> int:
        parts = block_look(self.scene.block)
        return int(
            pybullet.createVisualShapeArray(
                shapeTypes=[pybullet.GEOM_BOX if part.kind == "box" else pybullet.GEOM_CYLINDER for part in parts],
                halfExtents=[[length(half) for half in part.half_mm] if part.kind == "box" else [0, 0, 0] for part in parts],
                radii=[0 if part.kind == "box" else length(part.half_mm[0]) for part in parts],
                lengths=[0 if part.kind == "box" else length(2 * part.half_mm[2]) for part in parts],
                visualFramePositions=[[length(value) for value in part.at_mm] for part in parts],
                rgbaColors=[[*part.rgb, 1] for part in parts],
                physicsClientId=self.client,
            )
        )

    def _change(self, body: int, link: int, **changes: Any) -> None:
        pybullet.changeDynamics(body, link, physicsClientId=self.client, **changes)

    def _coat(self, body: int, links: Iterable[int], surface: Surface) -> None:
        for link in links:
            self._change(
                body,
                link,
                lateralFriction=surface.lateral,
                spinningFriction=length(surface.patch_mm),
                rollingFriction=length(surface.patch_mm),
            )


def _disconnect(client: int) -> None:
    with suppress(pybullet.error):  # whose window was closed by hand
        pybullet.disconnect(physicsClientId=client)

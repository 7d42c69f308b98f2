"""The block with its upright pin as one rigid body."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from marl_handover.config import BlockConfig
from marl_handover.simulation.engine import Engine, Floats, Surface, inertia, length, pybullet, tilt_of, to_mm

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

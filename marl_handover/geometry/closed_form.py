"""Arms of the class yaw + planar 3R + roll: their kinematics in closed form.

A joint vector is q = (base_yaw, shoulder, elbow, wrist_pitch, wrist_roll) in rad. Frames: ``base`` lies on the table under the yaw axis,
``grip`` is the grasp frame. Below the class: the same kinematics in the arm's own vertical plane for numpy and torch, whole batches at
once. There a point is (r, z): forward of the yaw axis and up from the table; ``planar`` (9,) holds the shoulder's (r, z), the vectors
shoulder-elbow, elbow-wrist and wrist-grip at zero, and how far to the left of the plane the grip is. For compiled loops:
:mod:`marl_handover.geometry.kernels`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from marl_handover.arrays import Array, namespace, wrap
from marl_handover.errors import InvalidSetting, UnknownKey, UnsupportedKinematics
from marl_handover.geometry.arm_model import LIMIT_TOLERANCE_RAD, Bools, Floats
from marl_handover.geometry.se3 import rotation, transform
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Joint, Vector

_GEOMETRY_TOLERANCE = 1e-6  # mm or a unit vector's components: well below any machining, well above float rounding
_RING_STEP_MM = 1.0
_AXES: dict[str, Vector] = {
    "base_yaw": (0.0, 0.0, 1.0),
    "shoulder": (0.0, -1.0, 0.0),
    "elbow": (0.0, -1.0, 0.0),
    "wrist_pitch": (0.0, -1.0, 0.0),
    "wrist_roll": (1.0, 0.0, 0.0),
}


class ClosedFormArm:
    """An :class:`~marl_handover.geometry.arm_model.ArmModel` whose geometry is read off the URDF.

    Public attributes, arrays read-only: ``description``; ``lower_rad`` and ``upper_rad`` (5,); ``shoulder_mm`` (2,), the shoulder axis in
    the arm's vertical plane (forward of the yaw axis, up from the table); ``upper_arm_mm``, ``forearm_mm`` and ``tool_mm`` (2,), the
    vectors shoulder-elbow, elbow-wrist and wrist-grip at zero; ``lateral_mm``, how far to the left of that plane the grip is at wrist roll
    0; ``planar`` (9,), all five after each other; ``reach_mm``, a bound on the grip's distance from the yaw axis.
    """

    def __init__(self, description: ArmDescription, limits_deg: Mapping[str, Sequence[float]] | None = None) -> None:
        """Build the model; ``limits_deg`` (joint -> [lower, upper] in degrees) replaces the URDF's own limits.

        Raises :class:`UnsupportedKinematics` if the arm is of another class, :class:`UnknownKey` for a joint that is none of the five and
        :class:`InvalidSetting` for limits that are no two finite, ordered numbers.
        """
        self.description = description
        origins, grip_mm = _check_class(description)
        limits = _limits(description, limits_deg or {})
        self.lower_rad, self.upper_rad = _frozen(limits[:, 0]), _frozen(limits[:, 1])
        self.shoulder_mm = _frozen(origins[1])
        self.upper_arm_mm, self.forearm_mm = _frozen(origins[2] - origins[1]), _frozen(origins[3] - origins[2])
        self.tool_mm, self.lateral_mm = _frozen(grip_mm[[0, 2]] - origins[3]), float(grip_mm[1])
        vectors = (self.upper_arm_mm, self.forearm_mm, self.tool_mm)
        self.planar = _frozen(np.concatenate([self.shoulder_mm, *vectors, [self.lateral_mm]]))
        self.reach_mm = math.hypot(abs(float(self.shoulder_mm[0])) + sum(math.hypot(*vector) for vector in vectors), self.lateral_mm)
        self._roll_axis = description.joint("wrist_roll").axis
        self._origins = {joint.name: transform(joint.xyz_mm, joint.rpy_rad) for joint in description.joints}
        self._beside_roll_mm = _frozen(_off_axis(description, grip_mm))

    def fk(self, q: ArrayLike) -> Floats:
        """Grasp frames T_base_grip (..., 4, 4) in mm of joint vectors ``q`` (..., 5) in rad."""
        q = np.asarray(q, dtype=float)
        T = np.eye(4)
        for joint in self.description.chain():
            T = self._after(joint, T, q, None)
        return np.broadcast_to(T, (*q.shape[:-1], 4, 4)).copy()

    def grip_mm(self, q: ArrayLike) -> Floats:
        """Grip positions (..., 3) in mm of joint vectors ``q`` (..., >= 4) in rad: those of :meth:`fk`, without its matrices."""
        q = np.asarray(q, dtype=float)
        r, z = grip_in_plane(self.planar, q)
        return np.stack([*out_of_plane(self.planar, r, q[..., 0]), z], axis=-1)

    def jacobian(self, q: ArrayLike) -> Floats:
        """Geometric Jacobians (..., 6, 5) of the grip in the base frame: mm/rad, then rad/rad, for joint vectors ``q`` (..., 5) in rad."""
        q = np.asarray(q, dtype=float)
        T, axes, origins = np.eye(4), [], []
        for joint in self.description.chain():
            T = self._after(joint, T, q, None)
            if joint.kind != "fixed":
                shape = (*q.shape[:-1], 3)
                axes.append(np.broadcast_to(T[..., :3, :3] @ np.asarray(joint.axis), shape))
                origins.append(np.broadcast_to(T[..., :3, 3], shape))
        columns = [np.concatenate([np.cross(axis, T[..., :3, 3] - at), axis], axis=-1) for axis, at in zip(axes, origins, strict=True)]
        return np.stack(columns, axis=-1)

    def link_transforms(self, q: ArrayLike, gripper_mm: float | None = None) -> dict[str, Floats]:
        """Link name -> T_base_link (..., 4, 4) in mm, for joint vectors ``q`` (..., 5) in rad.

        ``gripper_mm`` is how far each pad is from where it is when the hand is closed; None means fully open, the widest the hand can be.
        """
        q = np.asarray(q, dtype=float)
        frames = {self.description.root: np.eye(4)}
        for joint in self.description.joints:
            frames[joint.child] = self._after(joint, frames[joint.parent], q, gripper_mm)
        return {name: np.broadcast_to(T, (*q.shape[:-1], 4, 4)) for name, T in frames.items()}

    def ik(self, position_mm: ArrayLike, pitch_rad: ArrayLike = 0.0, roll_rad: ArrayLike = 0.0) -> Floats:
        """Joint vectors (..., 2, 5) in rad that put the grip at ``position_mm`` (..., 3), base frame, turned to face that point.

        A grip beside the arm's plane passes over the point: yaw = atan2(y, x) - asin(lateral / distance). ``pitch_rad``, counted from
        the pick pitch, and ``roll_rad`` broadcast against the leading dimensions. Branch 0 bends the forearm down (elbow
        up), branch 1 bends it up. A row is NaN where the point is out of reach; joint limits are left to :meth:`within_limits`.
        """
        position = np.asarray(position_mm, dtype=float)
        shape = np.broadcast_shapes(position.shape[:-1], np.shape(pitch_rad), np.shape(roll_rad))
        pitch, roll = np.broadcast_to(np.asarray(pitch_rad, dtype=float), shape), np.broadcast_to(np.asarray(roll_rad, dtype=float), shape)
        x, y, z = (np.broadcast_to(position[..., axis], shape) for axis in range(3))
        radius, yaw, planar = np.hypot(x, y), np.arctan2(y, x), self.planar
        if self._beside_roll_mm.any() and np.any(roll != 0.0):
            # The roll moves the grip: a planar arm without tool reaches for where the wrist has to be.
            tool_r, left, tool_z = self._rolled_tool_mm(roll)
            share = left / np.where(radius >= np.abs(left), radius, math.nan)
            radius, yaw = radius * np.sqrt(1 - share * share) - (np.cos(pitch) * tool_r - np.sin(pitch) * tool_z), yaw - np.arcsin(share)
            planar, z = np.concatenate([planar[:6], np.zeros(3)]), z - (np.sin(pitch) * tool_r + np.cos(pitch) * tool_z)
        else:
            radius, yaw = into_plane(planar, radius, yaw)
        branches = []
        for elbow in (-1, 1):
            pitches = planar_ik(planar, radius, z, pitch, elbow)
            branches.append(self._nearest_turn(np.concatenate([yaw[..., None], pitches, roll[..., None]], axis=-1)))
        return np.stack(branches, axis=-2)

    def ring_mm(self, height_mm: float, pitch_rad: float = 0.0) -> tuple[float, float] | None:
        """Least and greatest distance from the yaw axis of the grip at a height, by joint limits alone; None where there is no such ring.

        ``pitch_rad`` is counted from the pick pitch. Of several rings the widest.
        """
        return ring_by_limits_mm(self.planar, np.stack([self.lower_rad, self.upper_rad], axis=1), height_mm, pitch_rad)

    def _rolled_tool_mm(self, roll: Floats) -> tuple[Floats, Floats, Floats]:
        """The grip from the wrist, ahead, to the left of the plane and up (...), with the hand rolled; the other joints at zero."""
        moved = rotation(roll, self._roll_axis) @ self._beside_roll_mm - self._beside_roll_mm
        return self.tool_mm[0] + moved[..., 0], self.lateral_mm + moved[..., 1], self.tool_mm[1] + moved[..., 2]

    def within_limits(self, q: ArrayLike) -> Bools:
        """Whether joint vectors ``q`` (..., 5) are within the joint limits, up to :data:`LIMIT_TOLERANCE_RAD`; shape (...). NaN is not."""
        q = np.asarray(q, dtype=float)
        inside = (q >= self.lower_rad - LIMIT_TOLERANCE_RAD) & (q <= self.upper_rad + LIMIT_TOLERANCE_RAD)
        return np.asarray(inside.all(axis=-1))

    def _nearest_turn(self, q: Floats) -> Floats:
        """Joint vectors with each joint turned by whole turns to where it is within its limits, if it can be; NaN where one of them is."""
        q = wrap(q)
        for turn in (2 * math.pi, -2 * math.pi):  # limits may reach past half a turn
            outside = (q < self.lower_rad - LIMIT_TOLERANCE_RAD) | (q > self.upper_rad + LIMIT_TOLERANCE_RAD)
            fits = (q + turn >= self.lower_rad - LIMIT_TOLERANCE_RAD) & (q + turn <= self.upper_rad + LIMIT_TOLERANCE_RAD)
            q = np.where(outside & fits, q + turn, q)
        return np.where(np.isnan(q).any(axis=-1, keepdims=True), np.nan, q)

    def _after(self, joint: Joint, T_base_parent: Floats, q: Floats, gripper_mm: float | None) -> Floats:
        """T_base_child of one joint."""
        T = T_base_parent @ self._origins[joint.name]
        if joint.kind == "fixed":
            return T
        if joint.name in ARM_JOINTS:
            value = q[..., ARM_JOINTS.index(joint.name)]
        else:  # what is no part of the gripper stays at 0, or at the stop that is nearest to it
            still = min(max(0.0, joint.lower), joint.upper)
            value = np.asarray(self.description.gripper.joint_values(gripper_mm).get(joint.name, still))
        if joint.kind == "prismatic":
            return np.asarray(T @ transform([float(value) * component for component in joint.axis], (0.0, 0.0, 0.0)))
        R_joint = rotation(value, joint.axis)
        out = np.broadcast_to(T, np.broadcast_shapes(T.shape, (*R_joint.shape[:-2], 4, 4))).copy()
        out[..., :3, :3] = T[..., :3, :3] @ R_joint
        return out


def pitch_frames(planar: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """Where shoulder, elbow and wrist are, and how what each carries is pitched, of joints ``q`` (..., >= 4).

    Returns:
        r and z in mm, and the cosine and sine of the pitch, each (..., 3).
    """
    xp = namespace(q)
    angle = xp.cumsum(q[..., 1:4], -1)
    cos, sin = xp.cos(angle), xp.sin(angle)
    vectors = [float(value) for value in planar[:6]]
    zero = 0 * cos[..., 0]
    r, z = [zero + vectors[0]], [zero + vectors[1]]
    for link in range(2):
        x, y = vectors[2 + 2 * link], vectors[3 + 2 * link]
        r.append(r[-1] + cos[..., link] * x - sin[..., link] * y)
        z.append(z[-1] + sin[..., link] * x + cos[..., link] * y)
    return xp.stack(r, -1), xp.stack(z, -1), cos, sin


def grip_in_plane(planar: Array, q: Array) -> tuple[Array, Array]:
    """The grip's (r, z) in mm, each (...), of joints ``q`` (..., >= 4)."""
    r, z, cos, sin = (part[..., 2] for part in pitch_frames(planar, q))
    x, y = float(planar[6]), float(planar[7])
    return r + cos * x - sin * y, z + sin * x + cos * y


def into_plane(planar: Array, distance: Array, angle: Array) -> tuple[Array, Array]:
    """How far along its plane an arm reaches, in mm, and its base yaw, with the grip at polar coordinates (mm, rad), each (...).

    A grip that lies ``planar[8]`` to the left of the plane is seen under a greater angle than the plane's, by its asin over the distance.
    NaN for places nearer to the yaw axis than that.
    """
    xp, aside = namespace(distance), float(planar[8])
    if aside == 0.0:
        return distance, angle
    share = aside / xp.where(distance >= abs(aside), distance, math.nan)
    return distance * xp.sqrt(1 - share * share), angle - xp.arcsin(share)


def out_of_plane(planar: Array, r: Array, yaw: Array) -> tuple[Array, Array]:
    """Where (x, y) in mm a grip is that reaches ``r`` (...) along the plane at a base yaw (...): the inverse of :func:`into_plane`."""
    xp, aside = namespace(r), float(planar[8])
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    return (r * cos, r * sin) if aside == 0.0 else (r * cos - aside * sin, r * sin + aside * cos)


def grip_speed(planar: Array, q: Array, rates: Array) -> Array:
    """Speed (...) of the grip in mm per unit, of joints ``q`` (..., >= 4) that change by ``rates`` (..., >= 4) a unit."""
    xp = namespace(q)
    r, z, _, _ = pitch_frames(planar, q)
    grip_r, grip_z = grip_in_plane(planar, q)
    outward = ((z - grip_z[..., None]) * rates[..., 1:4]).sum(-1) - float(planar[8]) * rates[..., 0]
    upward = ((grip_r[..., None] - r) * rates[..., 1:4]).sum(-1)
    return xp.sqrt((grip_r * rates[..., 0]) ** 2 + outward**2 + upward**2)


def planar_ik(planar: Array, r: Array, z: Array, pitch: Array, elbow: int) -> Array:
    """Shoulder, elbow and wrist pitch (..., 3) with the grip at (r, z) mm and this pitch, each (...); NaN out of reach, not wrapped.

    ``elbow``: -1 bends the forearm down (elbow up), 1 bends it up.
    """
    xp = namespace(r)
    r_0, z_0, upper_r, upper_z, fore_r, fore_z, tool_r, tool_z = (float(value) for value in planar[:8])
    upper, fore = math.hypot(upper_r, upper_z), math.hypot(fore_r, fore_z)
    slope_1, slope_2 = math.atan2(upper_z, upper_r), math.atan2(fore_z, fore_r)
    forward = r - (xp.cos(pitch) * tool_r - xp.sin(pitch) * tool_z) - r_0
    up = z - (xp.sin(pitch) * tool_r + xp.cos(pitch) * tool_z) - z_0
    cosine = (forward**2 + up**2 - upper**2 - fore**2) / (2 * upper * fore)
    # A stretched arm's cosine may come out at 1 + rounding; it is reachable.
    bend = elbow * xp.arccos(xp.where(abs(cosine) > 1 + 1e-12, math.nan, xp.clip(cosine, -1.0, 1.0)))
    shoulder = xp.atan2(up, forward) - xp.atan2(fore * xp.sin(bend), upper + fore * xp.cos(bend)) - slope_1
    bent = bend + slope_1 - slope_2
    return xp.stack([shoulder, bent, pitch - shoulder - bent], -1)


def ring_by_limits_mm(planar: Floats, limits_rad: Floats, height_mm: float, pitch_rad: float) -> tuple[float, float] | None:
    """Least and greatest distance from the yaw axis of a grip at one height and pitch, joints within ``limits_rad`` (5, 2).

    The elbow bends one way all over the ring, and the wrist is in front of the yaw axis. Of several rings the widest, to 0.01 mm; None
    where there is none.
    """
    cos, sin = math.cos(pitch_rad), math.sin(pitch_rad)
    nearest = max(0.0, cos * float(planar[6]) - sin * float(planar[7]))
    farthest = abs(float(planar[0])) + sum(math.hypot(*planar[k : k + 2]) for k in (2, 4, 6))
    coarse = np.arange(nearest, max(farthest, nearest) + _RING_STEP_MM, _RING_STEP_MM)
    best: tuple[float, float] | None = None
    for elbow in (-1, 1):
        good = _in_limits(planar, limits_rad, coarse, height_mm, pitch_rad, elbow)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]]))).reshape(-1, 2)
        for first, last in edges:
            ends = []
            for inside, outside in ((first, max(first - 1, 0)), (last - 1, min(last, len(coarse) - 1))):
                fine = np.linspace(coarse[inside], coarse[outside], round(_RING_STEP_MM / 0.01) + 1)
                held = _in_limits(planar, limits_rad, fine, height_mm, pitch_rad, elbow)
                ends.append(float(fine[-1] if held.all() else fine[int(np.argmin(held)) - 1]))
            if best is None or ends[1] - ends[0] > best[1] - best[0] + _RING_STEP_MM:
                best = (ends[0], ends[1])
    return None if best is None else (math.hypot(best[0], planar[8]), math.hypot(best[1], planar[8]))


def _in_limits(planar: Floats, limits_rad: Floats, r_mm: Floats, height_mm: float, pitch_rad: float, elbow: int) -> Bools:
    """Whether an elbow bent that way reaches (r_mm (n,), height) within the limits (5, 2) of the pitch joints: (n,)."""
    q = wrap(planar_ik(planar, r_mm, np.full_like(r_mm, height_mm), np.full_like(r_mm, pitch_rad), elbow))
    low, high = (limits_rad[1:4, side] + slack for side, slack in ((0, -LIMIT_TOLERANCE_RAD), (1, LIMIT_TOLERANCE_RAD)))
    return np.asarray(np.any([(q + turn >= low) & (q + turn <= high) for turn in (0.0, 2 * math.pi, -2 * math.pi)], axis=0).all(axis=-1))


def _frozen(values: Floats) -> Floats:
    values = np.array(values, dtype=float)
    values.setflags(write=False)
    return values


def _limits(description: ArmDescription, limits_deg: Mapping[str, Sequence[float]]) -> Floats:
    """Joint limits (5, 2) in rad."""
    for name in limits_deg:
        if name not in ARM_JOINTS:
            raise UnknownKey(f"joint_limits_deg.{name}", [f"joint_limits_deg.{joint}" for joint in ARM_JOINTS])
    rows = []
    for name in ARM_JOINTS:
        joint = description.joint(name)
        pair = limits_deg.get(name)
        if pair is None:
            rows.append((joint.lower, joint.upper))
            continue
        if len(pair) != 2 or not all(math.isfinite(value) for value in pair) or pair[0] > pair[1]:
            raise InvalidSetting(f"joint_limits_deg.{name}", list(pair), "two finite numbers in degrees, [lower, upper], lower first")
        rows.append((math.radians(pair[0]), math.radians(pair[1])))
    return np.array(rows)


def _check_class(description: ArmDescription) -> tuple[list[Floats], Floats]:
    """In-plane origins (x, z) in mm at zero of the five joints, and the grip's (3,).

    Raises :class:`UnsupportedKinematics` unless yaw, three parallel pitch joints in one plane and roll follow each other, frames unturned.
    """
    T = np.eye(4)
    origins: list[Floats] = []
    for joint in description.chain():
        T = T @ transform(joint.xyz_mm, joint.rpy_rad)
        where = f"joint {joint.name!r}"
        if joint.kind == "fixed":
            continue
        if not np.allclose(T[:3, :3], np.eye(3), atol=_GEOMETRY_TOLERANCE):
            _unsupported(description, f"{where} turns its frame by rpy = {joint.rpy_rad} rad; at zero all frames must be parallel")
        if joint.kind == "prismatic":
            _unsupported(description, f"{where} is prismatic; it must be revolute")
        rolls = joint.name == "wrist_roll" and joint.axis[0] > 0 and abs(joint.axis[1]) < _GEOMETRY_TOLERANCE  # along a hand that may tilt
        if not rolls and not np.allclose(joint.axis, _AXES[joint.name], atol=_GEOMETRY_TOLERANCE):
            _unsupported(description, f"{where} has axis {joint.axis}; it must be {_AXES[joint.name]}")
        if not rolls and abs(T[1, 3]) > _GEOMETRY_TOLERANCE:
            _unsupported(description, f"{where} is {T[1, 3]:g} mm off the arm's plane y = 0")
        origins.append(T[[0, 2], 3])
    if abs(origins[0][0]) > _GEOMETRY_TOLERANCE:
        _unsupported(description, f"joint 'base_yaw' is {origins[0][0]:g} mm off the base frame's z axis")
    if not np.allclose(T[:3, :3], np.eye(3), atol=_GEOMETRY_TOLERANCE):
        _unsupported(description, f"link {description.grasp_link!r} is turned; at zero all frames must be parallel")
    for name, vector in (("shoulder to elbow", origins[2] - origins[1]), ("elbow to wrist_pitch", origins[3] - origins[2])):
        if math.hypot(*vector) < _GEOMETRY_TOLERANCE:
            _unsupported(description, f"the link from {name} has no length")
    return origins, T[:3, 3]


def _off_axis(description: ArmDescription, grip_mm: Floats) -> Floats:
    """How far the grip is off the roll axis at zero: (3,) mm, square to the axis; zeros where rolling does not move it."""
    T, roll = np.eye(4), description.joint("wrist_roll")
    for joint in description.chain():
        T = T @ transform(joint.xyz_mm, joint.rpy_rad)
        if joint is roll:
            break
    axis, beside = np.asarray(roll.axis), grip_mm - T[:3, 3]
    beside = beside - axis * float(beside @ axis)
    return np.zeros(3) if math.hypot(*beside) < _GEOMETRY_TOLERANCE else beside


def _unsupported(description: ArmDescription, what: str) -> None:
    raise UnsupportedKinematics(description.path, f"inverse kinematics need base yaw, a planar 3R arm and wrist roll, but {what}")

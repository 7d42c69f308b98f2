"""The canonical arm: any robot of the class with its joints named, counted and zeroed in one way.

Base frame: on the table (z = 0 of the URDF's root) under the yaw axis, +x where the hand points at the URDF's yaw 0. Axes at zero: yaw
+z, pitches -y (a positive value lifts), roll along the hand. Zero: links straight along +x, the hand at the pick pitch, its jaw opening
sideways. The grip frame, that of what is held, is level there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.config import RobotConfig
from marl_handover.errors import UrdfError, listed
from marl_handover.geometry.closed_form import ring_by_limits_mm
from marl_handover.geometry.hand import Hand, find_hand
from marl_handover.geometry.roles import Roles, find_roles, joint_range, nearest_turn_rad, require_pitch
from marl_handover.geometry.se3 import rpy_of, transform
from marl_handover.geometry.skeleton import Skeleton
from marl_handover.geometry.urdf import ARM_JOINTS, ArmDescription, Joint, JointSource, Link, Mesh, Primitive, UrdfTree, Vector

_EXACT_MM = 1e-9
_AHEAD_MM = 20.0
LEAST_RING_MM = 20.0
"""A ring that is narrower is none: no two arms share anything of it."""
PITCHES_DEG = (-15.0, -30.0, -45.0, -60.0, -75.0, -85.0, 0.0, 15.0, 30.0)
"""Of a hand, that are tried where the asked one has no ring."""


@dataclass(frozen=True)
class _Reading:
    """A robot read with one side of it as its front."""

    roles: Roles
    hand: Hand
    T_root_base: Floats
    sources: tuple[JointSource, ...]
    limits: Floats
    planar: Floats
    ring_mm: tuple[float, float] | None
    ahead_mm: float

    def has_ring(self, config: RobotConfig) -> bool:
        """Whether it has one at any pitch of the hand."""
        pitches = [math.radians(pitch - config.pitch_deg) for pitch in (config.pitch_deg, *PITCHES_DEG)]
        return any(ring_by_limits_mm(self.planar, self.limits, config.pick_height_mm, pitch) is not None for pitch in pitches)

    @property
    def width_mm(self) -> float:
        """Of its ring."""
        return 0.0 if self.ring_mm is None else self.ring_mm[1] - self.ring_mm[0]


def canonical_arm(tree: UrdfTree, config: RobotConfig) -> ArmDescription:
    """The canonical arm of a robot.

    Raises:
        UrdfError, UnsupportedKinematics, UnknownChoice: of a robot that is none, or not of the class; see
            :func:`~marl_handover.geometry.roles.find_roles` and :func:`~marl_handover.geometry.hand.find_hand`.
        InvalidSetting: for a hand that points straight down and can roll.
    """
    skeleton = Skeleton(tree)
    readings = []
    for roles in find_roles(skeleton, config):
        hand = find_hand(skeleton, roles, config)
        require_pitch(config, len(roles.joints) == 5)
        readings.append(_front([_read(skeleton, roles, hand, config, side) for side in (1.0, -1.0)], config))
        if readings[-1].width_mm >= LEAST_RING_MM:
            break
    reading = next((each for each in readings if each.width_mm >= LEAST_RING_MM), readings[0])
    notes = (
        tuple(f"locked: {name} at {math.degrees(reading.roles.locked[name]):.4g} deg" for name in reading.roles.proposed)
        + reading.hand.assumed
        + tree.assumed
        + _without_effort(reading.roles)
    )
    if _is_canonical(skeleton, reading, config):
        joints = tuple(replace(joint, mimic=None) if joint.name in ARM_JOINTS else joint for joint in tree.joints)
        made = ArmDescription(tree.path, tree.name, tree.root, reading.hand.tip, tree.links, joints, reading.hand.gripper)
        return replace(made, tip=made.grasp_link, assumed=notes)
    return _description(skeleton, reading, config, notes)


def _front(both: list[_Reading], config: RobotConfig) -> _Reading:
    """The side that is the front: where the grip is at the URDF's zero, else that of the wider ring, or of the root's +x."""
    sides = sorted(both, key=lambda each: (-round(each.width_mm), -round(float(each.T_root_base[0, 0]), 6)))
    clear = [each for each in sides if each.ahead_mm > _AHEAD_MM and each.has_ring(config)]
    return (clear or sides)[0]


def _read(skeleton: Skeleton, roles: Roles, hand: Hand, config: RobotConfig, side: float) -> _Reading:
    """The robot with the one or the other side of its arm's plane as its front."""
    frames = skeleton.frames(roles.locked)
    axes = [skeleton.axis(joint, frames) for joint in roles.joints]
    up = axes[0] if axes[0][2] > -1e-3 else -axes[0]
    left = side * (axes[1] - up * float(axes[1] @ up))
    left = left / np.linalg.norm(left)
    T_root_base = np.eye(4)
    T_root_base[:3, :3] = np.stack([np.cross(left, up), left, up], axis=1)
    on_axis = frames[roles.joints[0].child][:3, 3]
    T_root_base[:3, 3] = on_axis - up * float(on_axis @ up)
    T_base_root = np.linalg.inv(T_root_base)
    shoulder, elbow, wrist = (T_base_root @ frames[joint.child][:, 3] for joint in roles.joints[1:4])
    grip, ahead = T_base_root @ np.append(hand.grip_mm, 1.0), T_base_root[:3, :3] @ hand.approach
    ahead_mm = float(grip[0])
    slopes = [math.atan2(to[2] - start[2], to[0] - start[0]) for start, to in ((shoulder, elbow), (elbow, wrist))]
    slopes += [math.atan2(ahead[2], ahead[0]) - math.radians(config.pitch_deg)]
    at_zero = [0.0, slopes[0], slopes[1] - slopes[0], slopes[2] - slopes[1]]
    signs = [1 if float(axes[0] @ up) > 0 else -1, *(1 if float(axis @ left) < 0 else -1 for axis in axes[1:4])]
    sources = [JointSource(joint.name, sign, -sign * q) for joint, sign, q in zip(roles.joints[:4], signs, at_zero, strict=True)]
    sources.append(_roll_source(roles, hand, axes, left))
    limits = []
    for index, source in enumerate(sources):
        if index >= len(roles.joints):
            limits.append((0.0, 0.0))
            continue
        if index:
            sources[index] = replace(source, offset_rad=nearest_turn_rad(roles.joints[index], source.sign, source.offset_rad))
        limits.append(joint_range(roles.joints[index], source.sign, sources[index].offset_rad))
    zero = skeleton.frames({**roles.locked, **{s.joint: s.offset_rad for s in sources if s.joint is not None}})
    there = [(T_base_root @ zero[joint.child][:, 3])[[0, 2]] for joint in roles.joints[1:4]]
    grip = T_base_root @ zero[roles.hand] @ np.linalg.inv(frames[roles.hand]) @ np.append(hand.grip_mm, 1.0)
    planar = np.concatenate([there[0], there[1] - there[0], there[2] - there[1], grip[[0, 2]] - there[2], grip[[1]]])
    table = np.array(limits)
    ring = ring_by_limits_mm(planar, table, config.pick_height_mm, 0.0)
    return _Reading(roles, hand, T_root_base, tuple(sources), table, planar, ring, ahead_mm)


def _roll_source(roles: Roles, hand: Hand, axes: list[Floats], left: Floats) -> JointSource:
    """The roll at which the jaw opens sideways: of the two, the one nearer to the joint's own zero that it can take."""
    if len(roles.joints) < 5:
        return JointSource(None)
    joint, sign = roles.joints[4], 1 if float(axes[4] @ hand.approach) > 0 else -1
    if hand.opening is None:
        return JointSource(joint.name, sign, min(max(0.0, joint.lower), joint.upper))
    turn = math.atan2(float(hand.approach @ np.cross(hand.opening, left)), float(hand.opening @ left))
    values = [sign * turn + half * math.pi for half in range(-3, 4)]
    free = [value for value in values if joint.kind == "continuous" or joint.lower - 1e-9 <= value <= joint.upper + 1e-9]
    middle = (joint.lower + joint.upper) / 2
    return JointSource(
        joint.name, sign, min(free or values, key=lambda value: (round(abs(value), 6) if free else abs(value - middle), -value))
    )


def _is_canonical(skeleton: Skeleton, reading: _Reading, config: RobotConfig) -> bool:
    """Whether the URDF is written in the canonical way already, to the last bit: then it is taken as it is."""
    roles, hand = reading.roles, reading.hand
    if config.pitch_deg or roles.locked or not hand.tip or tuple(joint.name for joint in roles.joints) != ARM_JOINTS:
        return False
    frames = skeleton.frames({})
    axes = [(0.0, 0.0, 1.0), *[(0.0, -1.0, 0.0)] * 3, (1.0, 0.0, 0.0)]
    upright = all(np.array_equal(frames[joint.child][:3, :3], np.eye(3)) for joint in roles.joints)
    along = all(joint.axis == axis and joint.kind == "revolute" for joint, axis in zip(roles.joints, axes, strict=True))
    points = [frames[joint.child][:3, 3] for joint in roles.joints] + [frames[hand.tip][:3, 3]]
    flat = all(point[1] == 0.0 for point in points) and points[0][0] == 0.0
    straight = all(abs(point[2] - points[1][2]) < _EXACT_MM for point in points[2:])
    level = np.array_equal(frames[hand.tip][:3, :3], np.eye(3)) and np.array_equal(hand.grip_mm, frames[hand.tip][:3, 3])
    unturned = all(abs(source.offset_rad) < _EXACT_MM and source.sign == 1 for source in reading.sources)
    return bool(upright and along and flat and straight and level and unturned)


def _description(skeleton: Skeleton, reading: _Reading, config: RobotConfig, notes: tuple[str, ...]) -> ArmDescription:
    tree, roles = skeleton.tree, reading.roles
    still = {joint.name: 0.0 for joint in skeleton.above.values()}
    zero = {**still, **roles.locked, **{s.joint: s.offset_rad for s in reading.sources if s.joint is not None}}
    T_base_root = np.linalg.inv(reading.T_root_base)
    file = {link: T_base_root @ T for link, T in skeleton.frames(zero).items()}
    role_of = {joint.name: role for joint, role in zip(roles.joints, ARM_JOINTS, strict=False)}
    frames, joints = {tree.root: np.eye(4)}, []
    speed = min((joint.velocity for joint in roles.joints if math.isfinite(joint.velocity)), default=math.pi)
    for joint in tree.joints:
        role = role_of.get(joint.name)
        frames[joint.child] = file[joint.child] if role is None else _pivot(reading, role, file[joint.child])
        xyz_mm, rpy_rad = _pose(np.linalg.inv(frames[joint.parent]) @ frames[joint.child])
        moved = replace(joint, name=_apart(joint.name), xyz_mm=xyz_mm, rpy_rad=rpy_rad)
        if role is not None:
            lower, upper = reading.limits[ARM_JOINTS.index(role)]
            velocity, effort = (each if math.isfinite(each) else usual for each, usual in ((joint.velocity, speed), (joint.effort, 1.0)))
            moved = replace(moved, name=role, kind="revolute", axis=_axis(role, config), lower=float(lower), upper=float(upper))
            moved = replace(moved, velocity=velocity, effort=effort, mimic=None)
        elif joint.name in roles.locked:
            moved = replace(moved, kind="fixed")
        joints.append(moved)
    links = [_moved(link, np.linalg.inv(frames[link.name]) @ file[link.name]) for link in tree.links]
    last = roles.joints[-1].child
    if len(roles.joints) == 4:
        last, below = _free_name("hand", skeleton), last
        links.append(Link(last))
        hand_joint = Joint("wrist_roll", "revolute", below, last, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), _axis("wrist_roll", config))
        joints.append(replace(hand_joint, velocity=speed, effort=1.0))
        frames[last] = frames[below]
    grip = _free_name("grip", skeleton)
    at = np.array([reading.planar[[0, 2, 4, 6]].sum(), reading.planar[8], reading.planar[[1, 3, 5, 7]].sum()]) - frames[last][:3, 3]
    links.append(Link(grip))
    joints.append(Joint(_free_name("grasp", skeleton), "fixed", last, grip, _vector(at), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    gripper = replace(reading.hand.gripper, joints=tuple(_apart(name) for name in reading.hand.gripper.joints))
    made = ArmDescription(tree.path, tree.name, tree.root, grip, tuple(links), tuple(joints), gripper, reading.sources)
    return replace(made, locked=tuple(roles.locked.items()), tip=reading.hand.tip, assumed=notes)


def _pivot(reading: _Reading, role: str, T_base_file: Floats) -> Floats:
    """T_base_link of the link that a role's joint moves, at zero: unturned, at a point of the joint's axis."""
    T = np.eye(4)
    T[:3, 3] = T_base_file[:3, 3]
    if role == "base_yaw":
        T[:2, 3] = 0.0
    elif role != "wrist_roll":
        T[1, 3] = 0.0
        count = 2 * ARM_JOINTS.index(role)
        T[[0, 2], 3] = reading.planar[0:count:2].sum(), reading.planar[1:count:2].sum()
    return T


def _axis(role: str, config: RobotConfig) -> Vector:
    if role == "wrist_roll":
        pitch = math.radians(config.pitch_deg)
        return (math.cos(pitch), 0.0, math.sin(pitch))
    return (0.0, 0.0, 1.0) if role == "base_yaw" else (0.0, -1.0, 0.0)


def _apart(name: str) -> str:
    """A joint's name, kept apart from those of roles."""
    return f"{name}_of_file" if name in ARM_JOINTS else name


def _free_name(name: str, skeleton: Skeleton) -> str:
    taken = {*skeleton.links, *skeleton.joints}
    while name in taken:
        name += "_frame"
    return name


def _vector(values: Floats) -> Vector:
    return (float(values[0]), float(values[1]), float(values[2]))


def _pose(T: Floats) -> tuple[Vector, Vector]:
    return _vector(T[:3, 3]), rpy_of(T[:3, :3])


def _moved(link: Link, T: Floats) -> Link:
    """A link's content in a frame in which its own frame is at ``T`` (4, 4)."""
    if np.array_equal(T, np.eye(4)):
        return link

    def shape(each: Primitive | Mesh) -> Primitive | Mesh:
        xyz_mm, rpy_rad = _pose(T @ transform(each.xyz_mm, each.rpy_rad))
        return replace(each, xyz_mm=xyz_mm, rpy_rad=rpy_rad)

    inertial = link.inertial
    if inertial is not None:
        xyz_mm, rpy_rad = _pose(T @ transform(inertial.xyz_mm, inertial.rpy_rad))
        inertial = replace(inertial, xyz_mm=xyz_mm, rpy_rad=rpy_rad)
    own_xyz_mm, own_rpy_rad = _pose(T)
    return Link(
        link.name,
        tuple(each for each in map(shape, link.collisions) if isinstance(each, Primitive)),
        tuple(each for each in map(shape, link.meshes) if isinstance(each, Mesh)),
        tuple(replace(visual, shape=shape(visual.shape)) for visual in link.visuals),
        inertial,
        own_xyz_mm,
        own_rpy_rad,
    )


def _without_effort(roles: Roles) -> tuple[str, ...]:
    lacking = [joint.name for joint in roles.joints if joint.effort == 0]
    return (f"effort 0 of {listed(lacking, 80)}: the URDF does not say how strong they are; physics asks for it",) if lacking else ()


def require_moving(description: ArmDescription, needs_speed: bool = True) -> None:
    """Raise :class:`UrdfError` for an arm joint without speed; the file and the joint are named.

    ``needs_speed`` False: for kinematics alone, a joint is refused only where it has no effort, either.
    """
    for role, source in zip(ARM_JOINTS, description.sources, strict=True):
        joint = description.joint(role)
        lacking = [name for name in ("velocity", "effort") if getattr(joint, name) <= 0]
        if source.joint is not None and "velocity" in lacking and (needs_speed or len(lacking) == 2):
            problem = f"joint {source.joint!r} has {' and '.join(f'{name} 0' for name in lacking)} in its <limit>; it must be above 0"
            raise UrdfError(description.path, problem)

"""A robot's hand: where it grips, where it points, how it opens. All found by geometry, unless the settings say it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marl_handover.arrays import Floats
from marl_handover.config import RobotConfig
from marl_handover.errors import UrdfError
from marl_handover.geometry.roles import Roles, finger_joints, hand_point
from marl_handover.geometry.skeleton import Skeleton
from marl_handover.geometry.urdf import Gripper, Joint

_PAD_MM = 10.0
"""A finger grips so far from its end."""
_BESIDE_MM = 60.0
"""A frame farther from where the fingers meet is no grasp frame: cameras have frames, too."""
_SMALL_MM = 1.0
_NEAR_MM = 10.0
"""The middle of fingers this near to the roll axis is on it: masses are not that exact."""
_FINGER_MM = 50.0
"""Of a hinged finger about which the file tells nothing."""


@dataclass(frozen=True)
class Hand:
    """A hand with the joints of the arm at 0 and those that are locked at their angles; vectors in the root's frame.

    Attributes:
        grip_mm: where things are held (3,).
        tip: the link in whose origin that is; empty if there is none.
        approach: unit vector (3,) along which the hand points.
        opening: unit vector (3,) along which its fingers part; None where things stick to it.
        gripper: how it opens.
        assumed: what was guessed, in words.
    """

    grip_mm: Floats
    tip: str
    approach: Floats
    opening: Floats | None
    gripper: Gripper
    assumed: tuple[str, ...]


def find_hand(skeleton: Skeleton, roles: Roles, config: RobotConfig) -> Hand:
    """The hand of an arm. Raises :class:`UrdfError` for fingers that cannot be told apart, or a hand that points along a pitch axis."""
    frames = skeleton.frames(roles.locked)
    fingers = finger_joints(skeleton, roles.hand, config)
    wrist = frames[roles.joints[3].child][:3, 3]
    pitch = skeleton.axis(roles.joints[3], frames)
    approach, notes = _approach(skeleton, roles, config, frames, pitch, wrist)
    tip, grip, found = _grip(skeleton, roles, config, frames, fingers, approach)
    notes += found
    gripper, opening, found = _gripper(skeleton, roles, frames, fingers, grip, approach)
    return Hand(grip, tip, approach, opening, gripper, tuple(notes + found))


def _flat(vector: Floats, normal: Floats) -> Floats:
    """A vector less its part along a unit vector."""
    return vector - normal * float(vector @ normal)


def _approach(
    skeleton: Skeleton, roles: Roles, config: RobotConfig, frames: Mapping[str, Floats], pitch: Floats, wrist: Floats
) -> tuple[Floats, list[str]]:
    """Where the hand points."""
    at_tip = frames[config.tip or roles.hand]
    if config.approach:
        direction = (1.0 if config.approach[0] == "+" else -1.0) * at_tip[:3, "xyz".index(config.approach[1])]
        if abs(float(direction @ pitch)) > 0.1:
            raise UrdfError(
                skeleton.tree.path, f"approach {config.approach} of the tip is along a pitch axis; the hand can then not be level"
            )
        return direction, []
    ahead = (at_tip[:3, 3] if config.tip else hand_point(skeleton, roles.hand, frames)) - wrist
    if len(roles.joints) == 5:
        axis = skeleton.axis(roles.joints[4], frames)
        return (axis if float(axis @ ahead) > -_SMALL_MM else -axis), []
    ahead = _flat(ahead, pitch)
    if np.linalg.norm(ahead) < _SMALL_MM:
        raise UrdfError(skeleton.tree.path, "nothing tells where the hand points; set tip and approach in the robot's YAML file")
    ahead = ahead / np.linalg.norm(ahead)
    leaves = [config.tip] if config.tip else [*_leaves(skeleton, roles.hand), roles.hand]
    axes = [sign * frames[link][:3, column] for link in leaves for column in range(3) for sign in (1.0, -1.0)]
    axes = [axis for axis in axes if abs(float(axis @ pitch)) < 0.01]
    nearest = max(axes, key=lambda axis: round(float(axis @ ahead), 6), default=ahead)
    if float(nearest @ ahead) < 0.9:
        return ahead, ["the hand points from the wrist to where its fingers are; else set approach"]
    return nearest, []


def _leaves(skeleton: Skeleton, hand: str) -> list[str]:
    """The links of a hand that carry nothing and have no solid shape: frames."""
    carrying = {joint.parent for joint in skeleton.tree.joints}
    links = [skeleton.links[name] for name in skeleton.members[hand] if name not in carrying]
    return [link.name for link in links if not link.collisions and not link.meshes]


def _grip(
    skeleton: Skeleton,
    roles: Roles,
    config: RobotConfig,
    frames: Mapping[str, Floats],
    fingers: Sequence[Joint],
    approach: Floats,
) -> tuple[str, Floats, list[str]]:
    """The tip, the point where things are held, and what was assumed of it."""
    if config.tip:
        return config.tip, frames[config.tip][:3, 3], []
    start = frames[roles.hand][:3, 3]
    along = {name: float(approach @ (frames[name][:3, 3] - start)) for name in skeleton.members[roles.hand]}
    if not fingers:
        tip = max(along, key=lambda name: round(along[name], 6))
        notes = [f"tip: link {tip!r}, the farthest along the hand", "gripper: none; things stick to the tip"]
        return tip, frames[tip][:3, 3], notes
    bases = max(float(approach @ (frames[joint.child][:3, 3] - start)) for joint in fingers)
    middle, rolls = _pads(skeleton, frames, fingers), len(roles.joints) == 5
    one_jaw = rolls and len(fingers) == 1 and fingers[0].kind != "prismatic"
    if one_jaw or (rolls and np.linalg.norm(_flat(middle - start, approach)) < _NEAR_MM):
        middle = start + approach * float(approach @ (middle - start))
    beside = {name: float(np.linalg.norm(_flat(frames[name][:3, 3] - middle, approach))) for name in _leaves(skeleton, roles.hand)}
    ahead = [name for name in beside if along[name] > bases - _SMALL_MM and beside[name] < _BESIDE_MM]
    tip = max(ahead, key=lambda name: round(along[name], 6), default="")
    if tip and not one_jaw:
        return tip, frames[tip][:3, 3], [f"tip: link {tip!r}, a frame beyond the fingers' joints"]
    if tip:
        notes = [f"tip: on the roll axis, as far as link {tip!r}: there the jaw closes"]
        return tip, start + approach * along[tip], notes
    depth = max(_reach_mm(skeleton, frames, joint, approach) for joint in fingers)
    if depth < _SMALL_MM and fingers[0].kind != "prismatic":
        depth = _FINGER_MM
    where = "on the roll axis" if one_jaw else "midway between the fingers"
    notes = [f"tip: {where}, {depth:.0f} mm from the fingers' joints, guessed from their mass and shape; else set tip"]
    return "", middle + approach * (bases + depth - float(approach @ (middle - start))), notes


def _pads(skeleton: Skeleton, frames: Mapping[str, Floats], fingers: Sequence[Joint]) -> Floats:
    """The middle (3,) of the fingers, each in the middle of its way."""
    return np.mean([_pad(skeleton, frames, joint) for joint in fingers], axis=0)


def _pad(skeleton: Skeleton, frames: Mapping[str, Floats], joint: Joint) -> Floats:
    """Where the bulk of a finger is (3,), a sliding one in the middle of its way."""
    T = frames[joint.child]
    shift = skeleton.axis(joint, frames) * (joint.lower + joint.upper) / 2 if joint.kind == "prismatic" else np.zeros(3)
    return np.asarray(T[:3, 3] + T[:3, :3] @ skeleton.centre(joint.child) + shift)


def _reach_mm(skeleton: Skeleton, frames: Mapping[str, Floats], joint: Joint, approach: Floats) -> float:
    """How far ahead of its joint a finger grips: the middle of its solid shapes, else a pad's half before where its mass ends."""
    start = frames[joint.child][:3, 3]
    depths = [0.0]
    for link in [joint.child, *(below.child for below in skeleton.below(joint.child))]:
        T = frames[link]
        middle_mm = float(approach @ (T[:3, :3] @ skeleton.centre(link)))
        away_mm = float(np.linalg.norm(skeleton.centre(link)))
        # Mass tells how far a finger reaches where it is ahead of the joint; else the joint's frame is at the finger's end.
        tells = not skeleton.links[link].collisions and middle_mm > 0.5 * away_mm
        ahead_mm = max(skeleton.far_end_mm(link) - _PAD_MM, middle_mm) if tells else middle_mm
        depths.append(float(approach @ (T[:3, 3] - start)) + ahead_mm)
    return max(depths)


def _gripper(
    skeleton: Skeleton,
    roles: Roles,
    frames: Mapping[str, Floats],
    fingers: Sequence[Joint],
    grip: Floats,
    approach: Floats,
) -> tuple[Gripper, Floats | None, list[str]]:
    """How the hand opens, and along which unit vector (3,)."""
    if not fingers:
        return Gripper(), None, []
    sliding = fingers[0].kind == "prismatic"
    if len(fingers) > 2 and sliding:
        raise UrdfError(skeleton.tree.path, f"link {roles.hand!r} carries {len(fingers)} sliding fingers; name two with gripper")
    fingers = sorted(fingers, key=lambda joint: joint.mimic is not None)
    leader = fingers[0]
    ways = [skeleton.axis(joint, frames) if sliding else np.cross(skeleton.axis(joint, frames), approach) for joint in fingers]
    size = float(np.linalg.norm(ways[0]))
    if size < 0.5:
        return Gripper(), None, [f"gripper: none; joint {leader.name!r} turns about the way the hand points"]
    if sliding:
        outward = _pad(skeleton, frames, leader) - (_pad(skeleton, frames, fingers[1]) if len(fingers) > 1 else grip)
    else:
        outward = _flat(frames[leader.child][:3, 3] - grip, approach)
    side = float(ways[0] @ outward)
    notes = [] if abs(side) > 0.1 else [f"gripper: joint {leader.name!r} opens as its value grows"]
    rates = [1.0 if side > -0.1 else -1.0]
    for joint, way in zip(fingers[1:], ways[1:], strict=True):  # the other pad goes the other way, unless it is coupled
        along = _coupling(skeleton, leader, joint)
        rates.append(along[0] * rates[0] if along else -math.copysign(1.0, float(way @ ways[0])) * rates[0])
    lever = max(float(approach @ (grip - frames[leader.child][:3, 3])), _SMALL_MM)
    return _record(skeleton, roles, fingers, rates, 0.0 if sliding else lever), ways[0] / size, notes


def _coupling(skeleton: Skeleton, leader: Joint, joint: Joint) -> tuple[float, float] | None:
    """(factor, offset) with which a joint follows the leader, or what the leader follows; None where it is free."""
    (root, factor, offset), (other, own, shift) = (_followed(skeleton, each) for each in (leader, joint))
    return (own / factor, shift - own / factor * offset) if root == other and factor else None


def _followed(skeleton: Skeleton, joint: Joint) -> tuple[str, float, float]:
    """The joint that another mimics in the end, with factor and offset; a free one: itself."""
    if joint.mimic is None:
        return joint.name, 1.0, 0.0
    root, factor, offset = _followed(skeleton, skeleton.joints[joint.mimic.joint])
    return root, joint.mimic.multiplier * factor, joint.mimic.multiplier * offset + joint.mimic.offset


def _record(skeleton: Skeleton, roles: Roles, fingers: Sequence[Joint], rates: Sequence[float], lever: float) -> Gripper:
    """The gripper of ``fingers``, the leading one first, and of the bars of a linkage that move along; ``lever``: 0 of sliding ones."""
    leader = fingers[0]
    shut = leader.lower if rates[0] > 0 else leader.upper
    closed = [shut]
    for joint, rate in zip(fingers[1:], rates[1:], strict=True):
        along = _coupling(skeleton, leader, joint)
        closed.append(along[0] * shut + along[1] if along else joint.lower if rate > 0 else joint.upper)
    names, opening = [joint.name for joint in fingers], list(rates)
    for joint in skeleton.below(roles.hand):
        along = _coupling(skeleton, leader, joint)
        if along and joint.name not in names:
            names.append(joint.name)
            closed.append(along[0] * shut + along[1])
            opening.append(along[0] * rates[0])
    free = [joint for joint in fingers if joint is leader or not _coupling(skeleton, leader, joint)]
    way = min(joint.upper - joint.lower for joint in free)
    whole = 2 * lever * math.sin(min(way, math.pi / 2) / 2) if lever else way
    pads = min(len(fingers), 2)
    return Gripper("jaw" if lever else "fingers", tuple(names), tuple(closed), tuple(opening), pads, lever, whole / (2 if pads == 1 else 1))

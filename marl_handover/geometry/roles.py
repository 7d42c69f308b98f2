"""Which joints of a robot play which role, found by geometry: names, order in the file, signs, zeros and frames say nothing.

An arm of the class has a base yaw, three pitches with axes parallel to each other and perpendicular to the yaw's, and mostly a wrist roll,
perpendicular to the pitches. Joints between and beyond them are locked.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marl_handover.arrays import Floats, wrap
from marl_handover.config import RobotConfig
from marl_handover.errors import InvalidSetting, UnknownChoice, UnsupportedKinematics, UrdfError, listed
from marl_handover.geometry.skeleton import Skeleton
from marl_handover.geometry.urdf import ARM_JOINTS, Joint

PARALLEL_RAD = 1e-3
"""Axes that differ by less are parallel: files round their angles."""
MOST_LOCKS, MOST_MOVING = 2, 60
_MOST_ANGLES = 4
_TURNS_RAD = 3.5
"""A hinge that turns farther moves no finger."""
_LEAST_LINK_MM = 1.0
_BESIDE_MM = 5.0
_ALONG = 0.5
"""What a roll carries is ahead of it: least cosine between its axis and the way there from the wrist."""


@dataclass(frozen=True)
class Roles:
    """What a robot's joints do.

    Attributes:
        joints: by role, of :data:`~marl_handover.geometry.urdf.ARM_JOINTS`; four of an arm without wrist roll.
        locked: joint -> the angle in rad at which it is held.
        hand: the first link of the body that holds things.
        proposed: the locks that nobody asked for.
    """

    joints: tuple[Joint, ...]
    locked: dict[str, float]
    hand: str
    proposed: tuple[str, ...] = ()


def find_roles(skeleton: Skeleton, config: RobotConfig) -> list[Roles]:
    """The ways to read a robot as an arm of the class, the most plausible first; at least one.

    Raises:
        UrdfError: it has two arms or hands, and the settings do not tell which is meant.
        UnsupportedKinematics: no way; it says what is missing.
        UnknownChoice: a setting names a joint or link that is not there.
    """
    if len(skeleton.above) > MOST_MOVING:
        what = f"it has {len(skeleton.above)} moving joints; an arm and its hand may have {MOST_MOVING}: cut them out of the rest"
        raise UrdfError(skeleton.tree.path, what)
    _require_known(skeleton, config)
    hands = [_hand_of_tip(skeleton, config)] if config.tip or _named_gripper(config) else list(_bodies(skeleton, config))
    ranked = []
    for order, hand in enumerate(hands):
        grips = _grip_strength(skeleton, hand, config)
        for roles in _readings(skeleton, hand, config):
            if roles.proposed and len(roles.joints) == 4 and not grips and not config.tip:
                continue  # the last pitch would be a finger, or the like
            last = skeleton.path(hand)[-1].name
            turned = sum(abs(roles.locked[name]) for name in roles.proposed)
            key = (-(grips > 1), len(roles.proposed), -len(roles.joints), -grips, last in roles.locked, turned, order)
            ranked.append((key, roles))
    sliding = [hand for hand in hands if any(joint.kind == "prismatic" for joint in finger_joints(skeleton, hand, config))]
    if sliding and not any(roles.hand in sliding for _, roles in ranked):
        _explain(skeleton, sliding, config)
    if not ranked:
        _explain(skeleton, hands, config)
    ranked.sort(key=lambda entry: entry[0])
    best = ranked[0]
    rivals = [roles.hand for key, roles in ranked if key[:4] == best[0][:4] and _apart(skeleton, roles.hand, best[1].hand)]
    if rivals:
        names = listed(sorted({best[1].hand, *rivals}), 80)
        raise UrdfError(skeleton.tree.path, f"it has more than one hand ({names}); say which with tip: LINK in the robot's YAML file")
    return [roles for key, roles in ranked if key[:5] == best[0][:5] and roles.hand == best[1].hand]


def _require_known(skeleton: Skeleton, config: RobotConfig) -> None:
    names = [joint.name for joint in skeleton.tree.joints if joint.kind != "fixed"]
    asked = {f"robot.joints.{role}": name for role, name in config.joints.items()}
    asked |= {f"robot.locked.{name}": name for name in config.locked}
    asked |= {f"robot.gripper[{index}]": name for index, name in enumerate(config.gripper) if name != "none"}
    for role in config.joints:
        if role not in ARM_JOINTS:
            raise UnknownChoice("a key of robot.joints", role, ARM_JOINTS)
    for key, name in asked.items():
        if name not in names:
            raise UnknownChoice(key, name, names)
    if config.tip and config.tip not in skeleton.links:
        raise UrdfError(skeleton.tree.path, f"link {config.tip!r}, the tip, is missing; it has: {listed(skeleton.links, 120)}")


def _named_gripper(config: RobotConfig) -> bool:
    return bool(config.gripper) and config.gripper != ["none"]


def _bodies(skeleton: Skeleton, config: RobotConfig) -> Iterator[str]:
    """The bodies that can be hands: those behind four joints or more that carry fingers, or nothing that moves but spinning ornaments."""
    for body in skeleton.moving:
        fingers = finger_joints(skeleton, body, config)
        if len(skeleton.path(body)) >= 4 and (fingers or all(_is_ornament(skeleton, joint) for joint in skeleton.moving[body])):
            yield body


def _is_ornament(skeleton: Skeleton, joint: Joint) -> bool:
    return joint.kind == "continuous" and not skeleton.moving[joint.child]


def _hand_of_tip(skeleton: Skeleton, config: RobotConfig) -> str:
    """The body that carries the tip, or the named gripper; of a tip on a finger, the body that carries the finger."""
    if _named_gripper(config):
        return skeleton.body[skeleton.joints[config.gripper[0]].parent]
    body = skeleton.body[config.tip]
    while body in skeleton.above and (skeleton.above[body].kind == "prismatic" or skeleton.above[body].mimic is not None):
        body = skeleton.body[skeleton.above[body].parent]
    return body


def finger_joints(skeleton: Skeleton, hand: str, config: RobotConfig) -> list[Joint]:
    """The joints that move the fingers which ``hand`` carries, mimicking ones too; none where things stick to it."""
    if config.gripper == ["none"]:
        return []
    if config.gripper:
        return [skeleton.joints[name] for name in config.gripper]
    sliding = [joint for joint in skeleton.moving[hand] if joint.kind == "prismatic"]
    if sliding:
        return sliding
    hinges = [joint for joint in skeleton.moving[hand] if joint.kind == "revolute"]
    return hinges if len(hinges) > 1 else [joint for joint in skeleton.moving[hand] if _is_jaw(skeleton, joint)]


def _is_jaw(skeleton: Skeleton, joint: Joint) -> bool:
    """Whether a hinge moves a finger: another mimics it, or what it carries is beside its axis, not on it, and moves nothing by itself."""
    if joint.kind == "prismatic" or any(below.mimic is None for below in skeleton.below(joint.child)):
        return False
    if joint.mimic is not None or any(other.mimic is not None and other.mimic.joint == joint.name for other in skeleton.above.values()):
        return True
    if joint.kind == "revolute" and joint.upper - joint.lower > _TURNS_RAD:
        return False
    frames = skeleton.frames({})
    axis, way = skeleton.axis(joint, frames), hand_point(skeleton, joint.child, frames) - frames[joint.child][:3, 3]
    if np.linalg.norm(way) < _LEAST_LINK_MM:  # nothing is known of it: hinges of fingers are beside the axis before them
        before = skeleton.path(skeleton.body[joint.parent])
        return joint.kind == "revolute" and bool(before) and _apart_mm(skeleton, joint, before[-1], frames) > _BESIDE_MM
    return bool(np.linalg.norm(way - axis * float(axis @ way)) > abs(float(axis @ way)))


def _apart_mm(skeleton: Skeleton, one: Joint, other: Joint, frames: Mapping[str, Floats]) -> float:
    """Distance between the axes of two joints."""
    axes = [skeleton.axis(joint, frames) for joint in (one, other)]
    gap = frames[one.child][:3, 3] - frames[other.child][:3, 3]
    across = np.cross(axes[0], axes[1])
    if np.linalg.norm(across) < PARALLEL_RAD:
        return float(np.linalg.norm(gap - axes[0] * float(gap @ axes[0])))
    return abs(float(gap @ across)) / float(np.linalg.norm(across))


def _grip_strength(skeleton: Skeleton, hand: str, config: RobotConfig) -> int:
    """How sure it is that a body is a hand: 2 with sliding or coupled fingers, 1 with one hinge, 0 with none."""
    fingers = finger_joints(skeleton, hand, config)
    if any(joint.kind == "prismatic" for joint in fingers) or config.gripper:
        return 2
    if any(joint.mimic for joint in skeleton.below(hand)) or len(fingers) > 1:
        return 2
    return len(fingers)


def _apart(skeleton: Skeleton, one: str, other: str) -> bool:
    """Whether neither of two bodies carries the other."""
    ways = [{joint.name for joint in skeleton.path(body)} for body in (one, other)]
    return not (ways[0] <= ways[1] or ways[1] <= ways[0])


def _readings(skeleton: Skeleton, hand: str, config: RobotConfig) -> Iterator[Roles]:
    """The ways in which the joints on the way to a hand are an arm of the class, with as few locks as it takes."""
    chain = skeleton.path(hand)
    if any(joint.kind == "prismatic" or joint.mimic for joint in chain):
        return
    given = {name: math.radians(angle) for name, angle in config.locked.items()}
    wanted = set(config.joints.values())
    free = [joint for joint in chain if joint.name not in given]
    for count in range(min(MOST_LOCKS, len(free) - 4) + 1):
        if len(free) - count > 5:
            continue
        found = []
        for proposed in itertools.combinations([joint for joint in free if joint.name not in wanted], count):
            joints = tuple(joint for joint in free if joint not in proposed)
            played = dict(zip(ARM_JOINTS, [joint.name for joint in joints], strict=False))
            if not config.joints.items() <= played.items() or not _may_be(skeleton, chain, joints):
                continue
            held = {name: angle for name, angle in given.items() if skeleton.joints[name] in chain}
            names = tuple(joint.name for joint in proposed)
            found += [Roles(joints, locked, hand, names) for locked in _lock_angles(skeleton, hand, joints, proposed, held)]
        if found:
            yield from found
            return


def _may_be(skeleton: Skeleton, chain: Sequence[Joint], joints: Sequence[Joint]) -> bool:
    """Whether roles that follow each other without a lock between them have axes as they should: no lock changes those."""
    frames = skeleton.frames({}, skeleton.way_to(joints[-1].child))
    places = {joint.name: index for index, joint in enumerate(chain)}
    for index, (one, other) in enumerate(itertools.pairwise(joints)):
        if places[other.name] == places[one.name] + 1:
            axes = skeleton.axis(one, frames), skeleton.axis(other, frames)
            parallel = index in (1, 2)
            off = float(np.linalg.norm(np.cross(axes[0], axes[1]))) if parallel else abs(float(axes[0] @ axes[1]))
            if off > PARALLEL_RAD:
                return False
    return True


def _lock_angles(
    skeleton: Skeleton, hand: str, joints: Sequence[Joint], proposed: Sequence[Joint], given: Mapping[str, float]
) -> list[dict[str, float]]:
    """Angles of all locked joints with which ``joints`` are an arm of the class, the nearest to 0 first; not more than a few."""
    choices = [_candidates(skeleton, joint, joints, given) for joint in proposed]
    way = skeleton.way_to(hand)
    found: list[dict[str, float]] = []
    for angles in sorted(itertools.product(*choices), key=lambda each: sum(map(abs, each))):
        locked = {**given, **{joint.name: angle for joint, angle in zip(proposed, angles, strict=True)}}
        if is_of_class(skeleton, hand, joints, skeleton.frames(locked, way)):
            found.append(locked)
        if len(found) == _MOST_ANGLES:
            break
    return found


def _candidates(skeleton: Skeleton, lock: Joint, joints: Sequence[Joint], given: Mapping[str, float]) -> list[float]:
    """Angles within a joint's limits: quarter turns, and those that bring a later axis in line with the pitches' or square to it."""
    frames = skeleton.frames(given)
    axis, pitch = skeleton.axis(lock, frames), skeleton.axis(joints[1], frames)
    quarters = [0.0, math.pi / 2, -math.pi / 2, math.pi]
    angles = list(quarters)
    for joint in joints[2:]:
        other = skeleton.axis(joint, frames)
        flat = [vector - axis * float(vector @ axis) for vector in (other, pitch)]
        if min(np.linalg.norm(vector) for vector in flat) > 0.1:
            turn = math.atan2(float(axis @ np.cross(flat[0], flat[1])), float(flat[0] @ flat[1]))
            angles += [float(wrap(turn + quarter)) for quarter in quarters]
    kept: list[float] = []
    for angle in angles:
        at = next((round(value, 12) for value in (angle, angle + 2 * math.pi, angle - 2 * math.pi) if _within(lock, value)), None)
        if at is not None and all(abs(at - other) > PARALLEL_RAD for other in kept):
            kept.append(at)
    return kept or [(lock.lower + lock.upper) / 2]


def _within(joint: Joint, angle: float) -> bool:
    return joint.kind == "continuous" or joint.lower - PARALLEL_RAD <= angle <= joint.upper + PARALLEL_RAD


def is_of_class(skeleton: Skeleton, hand: str, joints: Sequence[Joint], frames: Mapping[str, Floats]) -> bool:
    """Whether four or five joints are yaw, three pitches and a roll, with the frames (4, 4) of all links in one posture."""
    axes = [skeleton.axis(joint, frames) for joint in joints]
    at = [frames[joint.child][:3, 3] for joint in joints]
    pitch = axes[1]
    if abs(float(axes[0] @ pitch)) > PARALLEL_RAD or any(np.linalg.norm(np.cross(pitch, axis)) > PARALLEL_RAD for axis in axes[2:4]):
        return False
    if any(np.linalg.norm(np.cross(pitch, at[k + 1] - at[k])) < _LEAST_LINK_MM for k in (1, 2)):
        return False
    if len(joints) == 4:
        return True
    ahead = hand_point(skeleton, hand, frames) - at[3]
    if np.linalg.norm(hand_point(skeleton, hand, frames) - frames[hand][:3, 3]) < _LEAST_LINK_MM:
        ahead = np.zeros(3)  # nothing tells where the hand points
    ahead = ahead - pitch * float(pitch @ ahead)
    length = float(np.linalg.norm(ahead))
    carries = length < _LEAST_LINK_MM or abs(float(axes[4] @ ahead)) > _ALONG * length
    return abs(float(axes[4] @ pitch)) < PARALLEL_RAD and carries


def hand_point(skeleton: Skeleton, hand: str, frames: Mapping[str, Floats]) -> Floats:
    """A point (3,) of the root's frame about where a hand's fingers are, or, if it has none, where its last part is."""
    fingers = [joint.child for joint in skeleton.moving[hand] if joint.kind != "continuous"]
    if fingers:
        return np.mean([frames[link][:3, :3] @ skeleton.centre(link) + frames[link][:3, 3] for link in fingers], axis=0)
    points = [frames[link][:3, 3] for link in skeleton.members[hand]]
    points += [frames[hand][:3, :3] @ skeleton.centre(hand) + frames[hand][:3, 3]]
    return np.asarray(max(points, key=lambda point: float(np.linalg.norm(point - frames[hand][:3, 3]))))


def _explain(skeleton: Skeleton, hands: Sequence[str], config: RobotConfig) -> None:
    """Raise :class:`UnsupportedKinematics`, which says what keeps the robot out of the class."""
    path = skeleton.tree.path
    ways = [skeleton.path(body) for body in (hands or skeleton.moving)]
    chain = max(ways, key=len, default=[])
    while chain and chain[-1].kind == "prismatic":  # a finger
        chain = chain[:-1]
    names = listed([joint.name for joint in chain], 100)
    sliding = [joint.name for joint in chain[:4] if joint.kind == "prismatic"]
    if sliding:
        raise UnsupportedKinematics(path, f"joint {sliding[0]!r} slides; the joints of an arm must turn, up to its fingers")
    if len(chain) < 4:
        raise UnsupportedKinematics(
            path, f"there are not enough joints: {names or 'none'}; an arm needs a base yaw and three parallel pitches, and takes a roll"
        )
    free = [joint for joint in chain if joint.name not in config.locked and joint.mimic is None]
    frames = skeleton.frames({name: math.radians(angle) for name, angle in config.locked.items()})
    yaw = skeleton.axis(free[0], frames)
    square = [joint for joint in free[1:] if abs(float(yaw @ skeleton.axis(joint, frames))) < PARALLEL_RAD]
    axes = [skeleton.axis(joint, frames) for joint in square]
    groups = [[o.name for o, a in zip(square, axes, strict=True) if np.linalg.norm(np.cross(a, axis)) < PARALLEL_RAD] for axis in axes]
    pitches = max(groups, key=len, default=[])
    if len(pitches) >= 3 and any(joint.mimic for joint in chain):
        raise UnsupportedKinematics(path, f"joint {next(joint.name for joint in chain if joint.mimic)!r} of the arm mimics another")
    what = "no pitch" if not pitches else "no wrist pitch" if len(pitches) < 3 else "no posture of the others in which these suffice"
    found = f"{len(pitches)} of {names} are parallel pitches square to the base yaw ({listed(pitches, 60) or 'none'})"
    raise UnsupportedKinematics(path, f"there is {what}: {found}; three are needed, and the others locked")


def joint_range(joint: Joint, sign: int, offset_rad: float) -> tuple[float, float]:
    """Limits of q where the joint's value is ``sign * q + offset_rad``, about 0; a joint that turns all the way round has (-pi, pi)."""
    ends = sorted(sign * (limit - offset_rad) for limit in (joint.lower, joint.upper))
    if joint.kind == "continuous" or ends[1] - ends[0] >= 2 * math.pi - 1e-4:
        return -math.pi, math.pi
    return ends[0], ends[1]


def nearest_turn_rad(joint: Joint, sign: int, offset_rad: float) -> float:
    """``offset_rad``, changed by whole turns so that the middle of the joint's range is within half a turn of q = 0."""
    middle = sign * ((joint.lower + joint.upper) / 2 - offset_rad)
    return offset_rad + sign * 2 * math.pi * round(middle / (2 * math.pi))


def require_pitch(config: RobotConfig, has_roll: bool) -> None:
    """Raise :class:`InvalidSetting` for a hand that points straight down and can roll: any arm then turns anything by any angle."""
    if has_roll and abs(config.pitch_deg) > 85.0:
        limit = "between -85 and 85: straight down, the wrist roll alone turns the object by any angle, and there is no problem to learn"
        raise InvalidSetting("robot.pitch_deg", config.pitch_deg, limit)

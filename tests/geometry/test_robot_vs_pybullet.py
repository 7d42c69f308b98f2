"""PyBullet's own kinematics of the file as it was published judge the canonical arm: frames of all links, inverse kinematics, yaw law."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cases import PUBLIC, RINGS_MM, SMALL

from marl_handover.arrays import wrap
from marl_handover.config import RobotConfig
from marl_handover.files import resource_path
from marl_handover.geometry.closed_form import ClosedFormArm
from marl_handover.geometry.robot import describe, robot_config
from marl_handover.geometry.se3 import transform

pybullet = pytest.importorskip("pybullet")

FEW, MANY = 200, 10_000
TOLERANCE_MM, TOLERANCE_DEG = 0.01, 0.01
SHIPPED = sorted(path.stem for path in resource_path("configs/robot").glob("*.yaml"))
CONVENTIONS = ("grip_side", "grip_offset", "jaw", "lateral_label", "no_roll", "tiny_rpy", "upright_zero", "world")


def settings() -> Iterator[tuple[str, RobotConfig]]:
    for name in SHIPPED:
        yield name, robot_config(name)
    for name, (height, _, _) in RINGS_MM.items():
        for pitch in (0.0, -45.0):
            yield f"{name}{pitch:g}", RobotConfig(name, str(PUBLIC / f"{name}.urdf"), pick_height_mm=float(height), pitch_deg=pitch)
    for name in CONVENTIONS:
        yield name, RobotConfig(name, str(SMALL / f"{name}.urdf"))


class Oracle:
    """A URDF in PyBullet, bare of shapes and masses; lengths in mm."""

    def __init__(self, urdf: Path, folder: Path) -> None:
        robot = ET.parse(urdf).getroot()
        for link in robot.findall("link"):
            for part in list(link):
                link.remove(part)
        copy = folder / "bare.urdf"
        copy.write_text(ET.tostring(robot, encoding="unicode"))
        self.client = pybullet.connect(pybullet.DIRECT)
        self.body = pybullet.loadURDF(str(copy), useFixedBase=True, physicsClientId=self.client)
        about = [pybullet.getJointInfo(self.body, index, self.client) for index in range(pybullet.getNumJoints(self.body, self.client))]
        self.joints = {info[1].decode(): info[0] for info in about}
        self.links = {info[12].decode(): info[0] for info in about}

    def frames(self, values: dict[str, float]) -> dict[str, np.ndarray]:
        for name, value in values.items():
            pybullet.resetJointState(self.body, self.joints[name], value, physicsClientId=self.client)
        states = pybullet.getLinkStates(self.body, list(self.links.values()), computeForwardKinematics=1, physicsClientId=self.client)
        frames = {}
        for name, state in zip(self.links, states, strict=True):
            frames[name] = np.eye(4)
            frames[name][:3, :3] = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
            frames[name][:3, 3] = 1000.0 * np.array(state[4])
        return frames


def file_values(arm: ClosedFormArm, q: np.ndarray) -> dict[str, float]:
    sources = zip(arm.description.sources, q, strict=True)
    return dict(arm.description.locked) | {s.joint: s.sign * float(value) + s.offset_rad for s, value in sources if s.joint is not None}


def apart_deg(R: np.ndarray, S: np.ndarray) -> float:
    return math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(R - S)) / (2 * math.sqrt(2)))))


def judge(config: RobotConfig, folder: Path, count: int) -> None:
    arm = ClosedFormArm(describe(config), config.joint_limits_deg)
    description, random = arm.description, np.random.default_rng(3)
    oracle = Oracle(Path(config.urdf), folder)
    own = {link.name: transform(link.file_xyz_mm, link.file_rpy_rad) for link in description.links}
    q = random.uniform(arm.lower_rad, arm.upper_rad, (count, 5))
    # Every other posture holds something: the hand at the pick pitch, the roll at rest, the grip before the yaw axis.
    q[::2, 3], q[::2, 4] = -q[::2, 1] - q[::2, 2], 0.0
    ours = {name: T @ own[name] for name, T in arm.link_transforms(q).items()}
    links = list(oracle.links)
    kinds = {joint.name: joint.kind for joint in description.joints}
    fingers = {
        name: value / (1000.0 if kinds[name] == "prismatic" else 1.0) for name, value in description.gripper.joint_values(None).items()
    }
    hand = description.chain()[-2].child if description.sources[4].joint else description.joint("wrist_pitch").child
    zero = arm.link_transforms(np.zeros(5))
    T_hand_grip = np.linalg.inv(zero[hand] @ own[hand]) @ arm.fk(np.zeros(5))
    back = arm.ik(arm.fk(q)[:, :3, 3])
    for index in range(count):
        theirs = oracle.frames({**file_values(arm, q[index]), **fingers})
        for name in links:
            T = np.linalg.inv(own[description.root]) @ ours[name][index]
            assert np.abs(T[:3, 3] - theirs[name][:3, 3]).max() <= TOLERANCE_MM, name
            assert apart_deg(T[:3, :3], theirs[name][:3, :3]) <= TOLERANCE_DEG, name
        if index % 2 == 0:
            _judge_grasp(arm, q[index], own[description.root] @ theirs[hand] @ T_hand_grip, back[index])


def _judge_grasp(arm: ClosedFormArm, q: np.ndarray, T_base_grip: np.ndarray, back: np.ndarray) -> None:
    """The yaw law and inverse kinematics, for a grip that is before the yaw axis."""
    x, y, _ = T_base_grip[:3, 3]
    ahead = math.cos(q[0]) * x + math.sin(q[0]) * y
    if ahead < 1.0:
        return
    psi = math.atan2(T_base_grip[1, 0], T_base_grip[0, 0])
    law = math.atan2(y, x) - math.asin(arm.lateral_mm / math.hypot(x, y))
    assert abs(math.degrees(float(wrap(psi - law)))) <= TOLERANCE_DEG * max(1.0, 100.0 / ahead)  # near the axis 0.01 mm is a wide angle
    assert np.abs(T_base_grip[:3, 2] - [0.0, 0.0, 1.0]).max() <= math.radians(TOLERANCE_DEG)
    assert np.isfinite(back).all()
    assert np.abs(wrap(back - q)).max(axis=-1).min() <= 1e-4  # one of the elbows is the posture it came from


NAMED = dict(settings())


@pytest.mark.parametrize("name", NAMED)
def test_frames_inverse_kinematics_and_yaw_law(name: str, tmp_path: Path) -> None:
    if not Path(NAMED[name].urdf).is_file():
        pytest.skip("no robot descriptions beside the checkout")
    judge(NAMED[name], tmp_path, FEW)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED)
def test_frames_inverse_kinematics_and_yaw_law_in_ten_thousand_postures(name: str, tmp_path: Path) -> None:
    if not Path(NAMED[name].urdf).is_file():
        pytest.skip("no robot descriptions beside the checkout")
    judge(NAMED[name], tmp_path, MANY)

"""An independent check of ``plan … motion=FILE``: PyBullet's own kinematics and closest points on the URDF judge what was written.

Nothing of this package's kinematics or collision functions is used here; the numbers asked for are the published ones.
"""

from __future__ import annotations

import itertools
import json
import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from marl_handover.cell import cell_config, load_cell
from marl_handover.cli import main
from marl_handover.geometry.robot import robot_config

pybullet = pytest.importorskip("pybullet")

JOINTS = ("base_yaw", "shoulder", "elbow", "wrist_pitch", "wrist_roll")
PHASES = ("approach", "grasp", "lift", "transfer", "lower", "release", "retreat")
HELD = ("lift", "transfer", "lower")
STANDING = ("base_link", "turret")
SIDE_M, HEIGHT_M, PICK_M, OPEN_M = 0.040, 0.015, 0.045, 0.012

PROBLEMS = {
    "default": [],
    "far": ["start=[-225,170,0]", "goal=[-222,-175,60]"],
    "inner": ["start=[0,30.5,0]", "goal=[0,-30.5,180]"],
    "short": ["start=[100,20,0]", "goal=[103,18,0]"],
    "al5a": ["cell=al5a", "start=[-250,-60,0]", "goal=[120,40,90]"],
    "A": ["architecture=A", "start=[150,-80,20]", "goal=[-130,70,-100]"],
}


class BulletCheck:
    """Both arms and the held block in PyBullet; lengths in m."""

    def __init__(self, cell_name):
        config, cell = cell_config(cell_name), load_cell(cell_name)
        self.client = pybullet.connect(pybullet.DIRECT)
        self.urdf = robot_config(config.robot).urdf
        self.bases = {"LR"[index]: base for index, base in enumerate(cell.bases)}
        self.arms = {letter: self._arm(base) for letter, base in self.bases.items()}
        names = [pybullet.getJointInfo(self.arms["L"], joint, self.client) for joint in range(self._count())]
        self.joints = {info[1].decode(): info[0] for info in names}
        self.links = {info[12].decode(): info[0] for info in names} | {"base_link": -1}
        self.limits = np.radians([robot_config(config.robot).joint_limits_deg[name] for name in JOINTS])
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=self.client)
        self.table = pybullet.createMultiBody(0, plane, physicsClientId=self.client)
        halves = [SIDE_M / 2, SIDE_M / 2, HEIGHT_M / 2]
        box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=halves, physicsClientId=self.client)
        self.block = pybullet.createMultiBody(0, box, physicsClientId=self.client)
        root = ET.parse(self.urdf).getroot()
        self.speed = np.array([float(root.find(f"joint[@name='{name}']/limit").get("velocity")) for name in JOINTS])

    def _arm(self, base):
        turn = pybullet.getQuaternionFromEuler([0, 0, math.atan2(base.facing[1], base.facing[0])])
        at = [base.x_mm / 1000, base.y_mm / 1000, 0]
        return pybullet.loadURDF(self.urdf, at, turn, useFixedBase=True, physicsClientId=self.client)

    def _count(self):
        return pybullet.getNumJoints(self.arms["L"], self.client)

    def pose(self, letter, joints_rad, fingers_m=OPEN_M):
        values = dict(zip(JOINTS, joints_rad, strict=True)) | {"finger_left": fingers_m, "finger_right": fingers_m}
        for name, value in values.items():
            pybullet.resetJointState(self.arms[letter], self.joints[name], value, physicsClientId=self.client)

    def grip(self, letter):
        """Position (3,) in m and rotation (3, 3) in the world."""
        state = pybullet.getLinkState(self.arms[letter], self.links["grip"], computeForwardKinematics=1, physicsClientId=self.client)
        return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)

    def hold(self, letter):
        """Put the block where the hand holds it; its turn about the pin does not matter to what is asked."""
        at, turn = self.grip(letter)
        centre = at - turn[:, 2] * (PICK_M - HEIGHT_M / 2)
        # Roll is 0 all the way: pitch and yaw are what is left.
        quaternion = pybullet.getQuaternionFromEuler([0.0, math.asin(np.clip(-turn[2, 0], -1, 1)), math.atan2(turn[1, 0], turn[0, 0])])
        pybullet.resetBasePositionAndOrientation(self.block, centre, quaternion, physicsClientId=self.client)

    def away(self):
        pybullet.resetBasePositionAndOrientation(self.block, [5, 5, 5], [0, 0, 0, 1], physicsClientId=self.client)

    def gap(self, one, other, skip_one=(), far=0.5):
        """Least distance in m between two bodies."""
        points = pybullet.getClosestPoints(one, other, far, physicsClientId=self.client)
        return min((point[8] for point in points if point[3] not in skip_one), default=far)

    def close(self):
        pybullet.disconnect(self.client)


@pytest.fixture(scope="module", params=PROBLEMS)
def judged(request, tmp_path_factory):
    """The check and the transfers of one plan."""
    path = tmp_path_factory.mktemp("motion") / "motion.json"
    arguments = PROBLEMS[request.param]
    assert main(["plan", *arguments, f"motion={path}"]) == 0
    check = BulletCheck("al5a" if "cell=al5a" in arguments else "paper")
    yield check, json.loads(path.read_text())["transfers"]
    check.close()


def samples(transfer):
    """All times (n,), joints (n, 5) and phase names (n,) of a transfer."""
    phases = transfer["phases"]
    names = [phase["name"] for phase in phases for _ in phase["t_s"]]
    return np.concatenate([p["t_s"] for p in phases]), np.concatenate([p["joints_rad"] for p in phases]), names


def test_phases_are_whole_and_in_order(judged):
    _, transfers = judged
    assert transfers
    for transfer in transfers:
        names = [phase["name"] for phase in transfer["phases"]]
        assert names == [name for name in PHASES if name in names]
        assert set(PHASES) - set(names) <= {"lift", "lower"}
        assert {"arm", "from", "to", "phases", "parked_other_rad", "path_length_mm", "min_clearance_mm", "planning_ms"} <= set(transfer)


def test_the_grip_is_level_at_pick_and_place(judged):
    check, transfers = judged
    for transfer in transfers:
        phases = {phase["name"]: phase["joints_rad"] for phase in transfer["phases"]}
        for joints, place in ((phases["grasp"][-1], transfer["from"]), (phases["release"][0], transfer["to"])):
            check.pose(transfer["arm"], joints)
            at, turn = check.grip(transfer["arm"])
            assert np.linalg.norm(1000 * at - [*place, 1000 * PICK_M]) <= 1.0
            np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-3)  # pitch = roll = 0


def test_times_limits_and_speeds(judged):
    check, transfers = judged
    for transfer in transfers:
        t_s, joints, _ = samples(transfer)
        for phase in transfer["phases"]:
            steps = np.diff(phase["t_s"])
            assert (steps > 0).all()
            assert steps.max() <= 0.02 + 1e-9
        assert (np.diff(t_s) >= -1e-12).all()
        assert (joints >= check.limits[:, 0] - 1e-6).all()
        assert (joints <= check.limits[:, 1] + 1e-6).all()
        assert (abs(np.diff(joints, axis=0)) <= check.speed * np.diff(t_s)[:, None] + 1e-6).all()


def test_every_transfer_begins_and_ends_parked(judged):
    _, transfers = judged
    for transfer in transfers:
        _, joints, _ = samples(transfer)
        np.testing.assert_allclose(joints[[0, -1]], [transfer["parked_other_rad"]] * 2, atol=1e-6)
    for before, after in itertools.pairwise(transfers):
        np.testing.assert_allclose(before["to"], after["from"])


def test_nothing_touches_table_or_arm(judged):
    """At every sample: the moving arm against the other one and the table, the held block against the other arm and the table."""
    check, transfers = judged
    standing = {check.links[name] for name in STANDING}
    for transfer in transfers:
        own, other = transfer["arm"], "R" if transfer["arm"] == "L" else "L"
        check.pose(other, transfer["parked_other_rad"])
        least = math.inf
        for joints, name in zip(*samples(transfer)[1:], strict=True):
            check.pose(own, joints)
            check.away()
            assert check.gap(check.arms[own], check.table, standing) >= 0.0018, name  # 2 mm are kept, PyBullet rounds its hulls
            least = min(least, check.gap(check.arms[own], check.arms[other]))
            if name in HELD:
                check.hold(own)
                assert check.gap(check.block, check.table) >= -1e-4, name
                least = min(least, check.gap(check.block, check.arms[other]))
        assert least >= 0.005
        # The planner's shapes enclose the URDF's: it may see less room than there is, never more.
        assert 1000 * least >= transfer["min_clearance_mm"] - 1.0


def test_the_carried_path_is_as_long_as_it_says(judged):
    check, transfers = judged
    for transfer in transfers:
        points = []
        for joints, name in zip(*samples(transfer)[1:], strict=True):
            if name in HELD:
                check.pose(transfer["arm"], joints)
                points.append(1000 * check.grip(transfer["arm"])[0])
        length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        assert length == pytest.approx(transfer["path_length_mm"], rel=0.01, abs=0.2)
        assert length >= math.dist(transfer["from"], transfer["to"])

"""What is to be shown of a session, ready to be written. Reads what the session's thread leaves lying, and changes nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.errors import HandoverError
from marl_handover.hardware.settings import ARMS
from marl_handover.motion.trajectory import LOADED_PHASES
from marl_handover.palette import FAINT, PAPER, YELLOW
from marl_handover.perception.camera import Frame
from marl_handover.perception.overlay import Mark
from marl_handover.perception.tracker import Believed, Seen
from marl_handover.runtime.digest import Digest
from marl_handover.runtime.foresight import Placement, foresee
from marl_handover.runtime.hardware_backend import HardwareBackend
from marl_handover.runtime.loop import ClosedLoop
from marl_handover.runtime.reach import drawn_in
from marl_handover.runtime.steering import Desk

Floats = NDArray[np.float64]

_JOINT_DIGITS, _SEEN_DIGITS = 4, 3


class Portrait:
    """Puts the state together.

    Args:
        loop: the session's.
        backend: the loop's.
        desk: where wishes lie.
    """

    def __init__(self, loop: ClosedLoop, backend: HardwareBackend, desk: Desk) -> None:
        self.digest, self.backend, self._desk = Digest(), backend, desk
        self._policy = deepcopy(loop.policy)
        """Of its own: asking the session's would change what one that draws lots does next."""
        self._edge_mm = loop.settings.reach_slack_mm
        self._about: dict[str, Any] = {"architecture": loop.rules.config.architecture}
        self._armed = False
        self._foreseen_for: Any = None
        self._plan: list[Placement] = []

    def take(self, rows: Iterable[dict[str, Any]]) -> None:
        """Take in events."""
        for row in rows:
            if row["event"] == "session":
                self._about |= {name: value for name, value in row.items() if name not in ("t_s", "event")}
            self._armed = self._armed or row["event"] == "armed"
            if row["event"] == "motion":
                self._look_ahead()
            self.digest.take(row)

    def state(self, seen: Seen | None) -> dict[str, Any]:
        """What does not change while nothing happens; ``seen``: the newest sighting."""
        digest, driver = self.digest, self.backend.lab.driver
        phase = digest.phase(self.backend.mover.reached_s)
        self._look_ahead()
        return {
            **self._about,
            "doing": "stopped" if digest.stopped else digest.doing,
            "text": digest.stopped or digest.text,
            "pausing": self._desk.paused,
            "driver": str(driver.state),
            "armed": self._armed,
            "arms": self._arms(phase),
            "phase": phase,
            "block": _block(digest.pose, seen),
            "goal": None if (goal := self.goal()) is None else goal.tolist(),
            "camera": {"seen": seen is not None, "frozen": seen is not None and seen.frozen},
            "plan": [{"pose": step.pose.round(2).tolist(), "arm": step.arm, "final": step.final} for step in self._plan],
            "episode": {"number": digest.episode, "transfers": digest.transfers},
            "totals": {"episodes": digest.ended, "solved": digest.solved, "transfers": digest.moved},
            "faults": {str(event): count for event, count in sorted(digest.faults.items())},
            "latch": {"set": driver.latch.is_set(), "reason": driver.latch.reason()},
            "stop_file": str(driver.latch.path),
        }

    def moment(self, pictured_s: float | None) -> dict[str, Any]:
        """What changes all the time; ``pictured_s``: when the newest picture was taken, by the session's clock."""
        now_s = self.backend.clock.now_s()
        return {"t_s": round(now_s, 3), "picture_s_ago": None if pictured_s is None else round(max(now_s - pictured_s, 0.0), 2)}

    def goal(self) -> Floats | None:
        """Where the block is to go (3,): what was asked for on the page, else what the session goes by."""
        wanted = self._desk.goal
        if wanted is not None:
            return wanted
        return None if self.digest.goal is None else np.array(self.digest.goal, float)

    def marks(self, frame: Frame, seen: Seen) -> list[Mark]:
        """What to draw into a picture: the block as it was seen last, and the goal."""
        block = self.backend.model.cell.config.block
        drawn = []
        if (goal := self.goal()) is not None and np.isfinite(goal).all():
            drawn.append(Mark(goal, block.side_mm, 0.0, PAPER, "goal"))
        if seen.block.pose is not None:
            here = seen.block.seen and seen.number == frame.number
            text = f"block {seen.block.confidence:.2f}" if here else f"block {frame.t_s - seen.t_s + seen.block.age_s:.1f} s ago"
            drawn.append(Mark(seen.block.pose, block.side_mm, block.height_mm, YELLOW if here else FAINT, text))
        return drawn

    def _arms(self, phase: str) -> list[dict[str, Any]]:
        joints = np.round(self.backend.joints_rad(), _JOINT_DIGITS)
        digest, driver, rows = self.digest, self.backend.lab.driver, []
        for arm, name in enumerate(ARMS):
            known = bool(np.isfinite(joints[arm]).all())
            fingers = driver.gripper_mm(arm)
            rows.append(
                {
                    "name": name,
                    "letter": ARM_LETTERS[arm],
                    "joints_rad": joints[arm].tolist() if known else None,
                    "gripper_mm": round(fingers, 2) if math.isfinite(fingers) else None,
                    "moving": digest.begun and digest.arm == arm,
                    "holding": digest.arm == arm and phase in LOADED_PHASES,
                    "stalled": arm in digest.stalled,
                }
            )
        return rows

    def _look_ahead(self) -> None:
        """What is planned; while an arm moves, what was when it set out."""
        digest, goal = self.digest, self.goal()
        if digest.arm >= 0:
            return
        wanted = (digest.pose, None if goal is None else goal.tolist(), digest.previous_arm)
        if wanted == self._foreseen_for:
            return
        self._foreseen_for, self._plan = wanted, []
        if digest.pose is None or goal is None or self._there(digest.pose, goal):
            return
        try:
            start = drawn_in(self._policy.rules.cell, np.array(digest.pose, float), self._edge_mm)
            self._plan = foresee(self._policy, start, goal, digest.previous_arm)
        except HandoverError:
            return  # a policy that has nothing to say of this will say so in the session

    def _there(self, pose: list[float], goal: Floats) -> bool:
        rules = self._policy.rules
        near = math.dist(pose[:2], goal[:2]) <= rules.tolerance_mm
        return near and abs(float(rules.orientation_error(np.float64(pose[2]), np.float64(goal[2])))) <= rules.epsilon_rad


def _block(pose: list[float] | None, seen: Seen | None) -> dict[str, Any]:
    """Where the block was seen last, in a picture or, without one that shows it, by the session."""
    believed: Believed | None = None if seen is None else seen.block
    if believed is None or believed.pose is None:
        return {"pose": pose, "seen": False, "confidence": None, "hidden": False}
    return {
        "pose": [round(float(value), _SEEN_DIGITS) for value in believed.pose],
        "seen": believed.seen,
        "confidence": round(believed.confidence, 3),
        "hidden": believed.hidden,
    }

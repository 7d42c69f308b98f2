"""Programs of the interactive cell: pieces of motion that carry out an order, from the parked pose or from the midst of another program."""

from __future__ import annotations

from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from marl_handover.errors import WorkFailed
from marl_handover.motion.trajectory import JointTrajectory, still
from marl_handover.runtime.episode import Order
from marl_handover.runtime.interactive.body import Body, Piece
from marl_handover.runtime.interactive.paths import FreePaths
from marl_handover.runtime.interactive.tracks import STEP_S, joined, stopped

Floats = NDArray[np.float64]


class Programs:
    """Makes programs. Only what an arm in motion goes on with is planned at once; what comes later is planned when it is asked for.

    Planning raises :class:`WorkFailed` where there is no collision-free motion.

    Args:
        paths: of the arms.
    """

    def __init__(self, paths: FreePaths) -> None:
        self.paths, self.motion = paths, paths.motion

    def cycle(self, order: Order, pose: Floats) -> list[Piece]:
        """The whole transfer of a block lying at ``pose`` (3,), all arms being parked."""
        arm, pin = order.arm, pose[:2].copy()
        approach = Piece("approach", arm, 1.0, 1.0, None, lambda: self.paths.to_pin(arm, self.paths.home_rad, pin))
        return [approach, *self._from_grasp(order, pose)]

    def home(self, arm: int, joints_rad: Floats, pose: Floats) -> Piece:
        """An empty hand goes from ``joints_rad`` (5,), where it rests, to the parked pose, past a block lying at ``pose`` (3,)."""
        start, block = joints_rad.copy(), pose[:2].copy()
        return Piece("retreat", arm, 1.0, 1.0, None, lambda: self.paths.home(arm, start, block))

    def redirected(self, body: Body, order: Order | None, moved: bool) -> list[Piece]:
        """What an empty hand under way is to do now; without an order, it parks. ``moved``: the block is not where it was."""
        piece, pose = body.program[0], body.pose
        rest = self._rest(body)
        ours = order if order is not None and order.arm == piece.arm else None
        theirs = self.cycle(order, pose) if order is not None and ours is None else []
        if not moved:
            if piece.kind in ("approach", "grasp") and ours is not None:
                kept = takewhile(lambda it: it.kind in ("approach", "grasp"), list(body.program)[1:])
                return [rest, *kept, *self._from_carry(ours, pose)]
            if piece.kind == "release":
                return [rest, *([self._leave(piece.arm, pose[:2]), *theirs] if ours is None else self._from_grasp(ours, pose))]
            if piece.kind == "grasp":
                opening = self._fingers("release", piece.arm, body.joints_rad[piece.arm], rest.open_from, 1.0)
                return [opening, self._leave(piece.arm, pose[:2]), *theirs]
        if piece.kind == "retreat" and ours is None and self._passes(body, rest):
            return [rest, *theirs]
        if ours is not None:
            try:
                return [self._onward(body, "approach"), *self._from_grasp(ours, pose)]
            except WorkFailed:
                theirs = self.cycle(ours, pose)
        return [self._onward(body, "retreat"), *theirs]

    def diverted(self, body: Body, order: Order) -> list[Piece]:
        """The block in the hand goes to another place."""
        piece, stop = body.program[0], self.stop(body)
        onward = self.paths.carry_on(piece.arm, stop.end_rad, order.place_mm)
        carry = self._joined(piece.arm, stop, onward, None)
        return [Piece("carry", piece.arm, 0.0, 0.0, carry), *self._from_carry(order, body.pose)[1:]]

    def stop(self, body: Body) -> JointTrajectory:
        """The quickest stop of what is under way."""
        piece = body.program[0]
        if piece.track is None:
            return still(body.joints_rad[piece.arm].copy(), STEP_S)
        return stopped(piece.track, body.clock_s, self.paths.acceleration_rad_s2)

    def _onward(self, body: Body, kind: str) -> Piece:
        """From where the empty hand is to the pin (approach) or home (retreat)."""
        piece, stop, block = body.program[0], self.stop(body), body.pose[:2]
        ways = {"approach": self.paths.to_pin, "retreat": self.paths.home}
        onward = ways[kind](piece.arm, stop.end_rad, block)
        return Piece(kind, piece.arm, float(body.opened[piece.arm]), 1.0, self._joined(piece.arm, stop, onward, block))

    def _joined(self, arm: int, stop: JointTrajectory, onward: JointTrajectory, block_mm: Floats | None) -> JointTrajectory:
        limits = self.paths.velocity_rad_s, self.paths.acceleration_rad_s2
        return joined(stop, onward, *limits, lambda joints: self.paths.allows(arm, joints, block_mm))

    def _from_grasp(self, order: Order, pose: Floats) -> list[Piece]:
        """From the open hand at the pin on."""
        joints = self.paths.planner.grasp_joints(order.arm, "pick up", pose[:2])
        return [self._fingers("grasp", order.arm, joints, 1.0, 0.0), *self._from_carry(order, pose)]

    def _from_carry(self, order: Order, pose: Floats) -> list[Piece]:
        """From the closed hand on, which has taken the block from ``pose`` (3,)."""
        arm, pick, place = order.arm, pose[:2].copy(), order.place_mm.copy()
        joints = self.paths.planner.grasp_joints(arm, "place", place)
        carry = Piece("carry", arm, 0.0, 0.0, None, lambda: self.paths.carry(arm, pick, place))
        return [carry, self._fingers("release", arm, joints, 0.0, 1.0), self._leave(arm, place)]

    def _leave(self, arm: int, pin_mm: Floats) -> Piece:
        """From a pin to the parked pose."""
        pin = pin_mm.copy()
        return Piece("retreat", arm, 1.0, 1.0, None, lambda: self.paths.from_pin(arm, pin))

    def _fingers(self, kind: str, arm: int, joints_rad: Floats, open_from: float, open_to: float) -> Piece:
        whole_s = self.motion.grasp_s if kind == "grasp" else self.motion.release_s
        track = still(joints_rad.copy(), max(whole_s * abs(open_to - open_from), STEP_S))
        return Piece(kind, arm, open_from, open_to, track)

    def _passes(self, body: Body, rest: Piece) -> bool:
        """Whether the rest of a retreat keeps off the block where it lies now."""
        return rest.track is not None and self.paths.clear_of_block(rest.arm, rest.track.joints_rad, body.pose[:2])

    @staticmethod
    def _rest(body: Body) -> Piece:
        """What is left of the piece under way."""
        piece = body.program[0]
        track = None if piece.track is None else piece.track.rest(body.clock_s)
        return piece._replace(track=track, open_from=float(body.opened[piece.arm]))

"""The safety filter judged from outside: what it lets through, what it refuses for nothing, and what it costs against another commit.

python bench/safety_filter.py commands=100000 samples=1000 seed=0 against=ca43d75

Random commands of one and of two arms, of arms that stand or are in an earlier move, in half of them with the block in a hand that moves.
Whatever the gate says, each is judged at ``samples`` postures of its way by kinematics and distances that are written here, from the URDF's
numbers. ``against=COMMIT`` checks the commands of one streamed transfer with the gate of this folder and with that of the commit, in turn.
"""

from __future__ import annotations

import datetime
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
import numpy as np
from common import ROOT, commit, machine, parse, table
from numpy.typing import NDArray

from marl_handover.cell.build import CellModel, build_cell, cell_config
from marl_handover.compiled import compiled
from marl_handover.geometry.capsules import block_capsules, capsule_pairs
from marl_handover.geometry.se3 import transform
from marl_handover.geometry.urdf import ARM_JOINTS
from marl_handover.hardware.calibration import nominal_calibration
from marl_handover.hardware.safety_filter import LAG_S, CommandRejected, JointCommand, Reason, SafetyFilter
from marl_handover.hardware.settings import ARMS, HardwareConfig
from marl_handover.motion.planner import MotionPlanner

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DEFAULTS = {"commands": 2000, "samples": 1000, "seed": 0, "rounds": 5, "against": "", "results": "bench/results"}
SLACK_MM = 0.1
"""A command that passed may be nearer than what is promised by this much."""
KEEPS_MM = 5.0
"""To refuse one that keeps so much of everything is needless."""
FAR_MM = 12.0
"""Distances beyond this are not worked out."""
OPEN_MM = 12.0


class Bodies(NamedTuple):
    """An arm for the judge: ``joints`` (5, 4, 4) the fixed transform before each joint, ``axes`` (5, 3), and its shapes.

    ``shapes`` (K, 8): body (0 to 5), two ends in its frame, radius; those from row ``bare`` on are the pin's and the block's. ``halves``
    (K,): half their lengths. ``disc`` (6,): centre of the grip, radius of the disc around the block, its lower and upper face from there.
    """

    joints: Floats
    axes: Floats
    shapes: Floats
    halves: Floats
    bare: int
    disc: Floats


def bodies_of(model: CellModel) -> Bodies:
    """The URDF's capsules, by the body they belong to, fingers open; and the planner's of the block."""
    description, frames = model.arm.description, model.arm.link_transforms(np.zeros(5))
    moved = [description.joint(name).child for name in ARM_JOINTS]
    joints = np.array([transform(description.joint(name).xyz_mm, description.joint(name).rpy_rad) for name in ARM_JOINTS])
    rows = []
    for capsule in capsule_pairs(description)[0]:
        body = number_of_body(description, capsule.link)
        inside = np.eye(4) if body == 0 else np.linalg.inv(frames[moved[body - 1]])
        ends = [(inside @ frames[capsule.link] @ np.append(end, 1.0))[:3] for end in (capsule.start_mm, capsule.end_mm)]
        rows.append([body, *ends[0], *ends[1], capsule.radius_mm])
    bare, block, drop = len(rows), model.cell.config.block, model.cell.pick_height_mm
    grip = (np.linalg.inv(frames[moved[4]]) @ frames[description.grasp_link])[:3, 3]
    capsules = block_capsules(block, drop)
    for capsule in [*capsules[-1:], *capsules[:-1]]:
        rows.append([5, *(grip + capsule.start_mm), *(grip + capsule.end_mm), capsule.radius_mm])
    disc = np.array([*grip, block.side_mm / math.sqrt(2), -drop, block.height_mm - drop])
    shapes, axes = np.array(rows), np.array([description.joint(name).axis for name in ARM_JOINTS], float)
    return Bodies(joints, axes, shapes, np.linalg.norm(shapes[:, 4:7] - shapes[:, 1:4], axis=1) / 2, bare, disc)


def number_of_body(description: Any, link: str) -> int:
    """How many arm joints lie between a link and the base."""
    parents = {joint.child: joint for joint in description.joints}
    count = 0
    while link in parents:
        count += parents[link].name in ARM_JOINTS
        link = parents[link].parent
    return count


@compiled
def times(A: Floats, B: Floats, out: Floats) -> None:
    """The product of two transforms, into ``out`` (4, 4)."""
    for row in range(4):
        for column in range(4):
            out[row, column] = A[row, 0] * B[0, column] + A[row, 1] * B[1, column] + A[row, 2] * B[2, column] + A[row, 3] * B[3, column]


@compiled
def placed(q: Floats, base: Floats, arm: Bodies, shapes: int, frames: Floats, ends: Floats, middles: Floats) -> None:
    """Frames (6, 4, 4) of the bodies in the world; ends (K, 2, 3), middles (K, 3) of the first ``shapes`` capsules; joints ``q`` (5,)."""
    frames[0] = base
    turn, fixed = np.eye(4), np.empty((4, 4))
    for joint in range(5):
        x, y, z = arm.axes[joint]
        c, s = math.cos(q[joint]), math.sin(q[joint])
        for row, column, value in (
            (0, 0, c + x * x * (1 - c)), (0, 1, x * y * (1 - c) - z * s), (0, 2, x * z * (1 - c) + y * s),
            (1, 0, y * x * (1 - c) + z * s), (1, 1, c + y * y * (1 - c)), (1, 2, y * z * (1 - c) - x * s),
            (2, 0, z * x * (1 - c) - y * s), (2, 1, z * y * (1 - c) + x * s), (2, 2, c + z * z * (1 - c)),
        ):  # fmt: skip
            turn[row, column] = value
        times(frames[joint], arm.joints[joint], fixed)
        times(fixed, turn, frames[joint + 1])
    for k in range(shapes):
        T = frames[int(arm.shapes[k, 0])]
        for e in range(2):
            for row in range(3):
                ends[k, e, row] = T[row, 3]
                for axis in range(3):
                    ends[k, e, row] += T[row, axis] * arm.shapes[k, 1 + 3 * e + axis]
        for row in range(3):
            middles[k, row] = 0.5 * (ends[k, 0, row] + ends[k, 1, row])


@compiled
def to_segment(px: float, py: float, pz: float, a: Floats, b: Floats) -> float:
    """Squared distance of a point and the segment from a to b."""
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    t = ((px - a[0]) * x + (py - a[1]) * y + (pz - a[2]) * z) / max(x * x + y * y + z * z, 1e-12)
    t = min(max(t, 0.0), 1.0)
    x, y, z = px - a[0] - t * x, py - a[1] - t * y, pz - a[2] - t * z
    return x * x + y * y + z * z


@compiled
def segments(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """Distance of two segments: of the lines if their nearest points are inside both, else of an end."""
    best = min(to_segment(a[0], a[1], a[2], c, d), to_segment(b[0], b[1], b[2], c, d))
    best = min(best, min(to_segment(c[0], c[1], c[2], a, b), to_segment(d[0], d[1], d[2], a, b)))
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = d[0] - c[0], d[1] - c[1], d[2] - c[2]
    wx, wy, wz = a[0] - c[0], a[1] - c[1], a[2] - c[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    square, uu, vv = nx * nx + ny * ny + nz * nz, ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    if square > 1e-9 * uu * vv:
        uv, uw, vw = ux * vx + uy * vy + uz * vz, ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
        if 0.0 <= uv * vw - vv * uw <= square and 0.0 <= uu * vw - uv * uw <= square:
            best = min(best, (nx * wx + ny * wy + nz * wz) ** 2 / square)
    return math.sqrt(best)


@compiled
def nearer(best: float, ends: Floats, middles: Floats, it: int, a: int, other: int, b: int, arm: Bodies) -> float:
    """The lesser of ``best`` and the distance of capsule ``a`` of arm ``it`` and ``b`` of ``other``."""
    x, y, z = middles[it, a, 0] - middles[other, b, 0], middles[it, a, 1] - middles[other, b, 1], middles[it, a, 2] - middles[other, b, 2]
    radii = arm.shapes[a, 7] + arm.shapes[b, 7]
    away = arm.halves[a] + arm.halves[b] + radii + best
    if x * x + y * y + z * z > away * away:
        return best
    return min(best, segments(ends[it, a, 0], ends[it, a, 1], ends[other, b, 0], ends[other, b, 1]) - radii)


@compiled
def heights(ends: Floats, frames: Floats, it: int, arm: Bodies, holding: bool, out: Floats) -> None:
    """Lower ``out[0]`` to the height of an arm, with the pin in its hand, and ``out[3]`` to that of the disc around the block."""
    for k in range(arm.bare + 1 if holding else arm.bare):
        if arm.shapes[k, 0] >= 2:
            out[0] = min(out[0], min(ends[it, k, 0, 2], ends[it, k, 1, 2]) - arm.shapes[k, 7])
    if holding:
        T, disc = frames[it, 5], arm.disc
        for level in range(4, 6):
            centre = T[2, 3] + T[2, 0] * disc[0] + T[2, 1] * disc[1] + T[2, 2] * (disc[2] + disc[level])
            out[3] = min(out[3], centre - disc[3] * math.hypot(T[2, 0], T[2, 1]))


@compiled
def least_mm(Q: Floats, bases: Floats, arm: Bodies, holding: Bools, moving: Bools, enough_mm: float, out: Floats) -> None:
    """Fill ``out`` (4,): least height, distance to itself, to the other arm, height of the block; of arms that move, over Q (S, 2, 5).

    No more is looked at once one is below ``enough_mm``.
    """
    K = arm.shapes.shape[0]
    frames, ends, middles = np.empty((2, 6, 4, 4)), np.empty((2, K, 2, 3)), np.empty((2, K, 3))
    counts = [K if holding[it] else arm.bare for it in range(2)]
    out[:] = FAR_MM
    for i in range(Q.shape[0]):
        for it in range(2):
            if i > 0 and (Q[i, it] == Q[i - 1, it]).all():
                continue
            placed(Q[i, it], bases[it], arm, counts[it], frames[it], ends[it], middles[it])
            if moving[it]:
                heights(ends, frames, it, arm, holding[it], out)
                for a in range(counts[it]):
                    for b in range(a):
                        one, other = arm.shapes[a, 0], arm.shapes[b, 0]
                        if abs(one - other) > 1.5 and not (a >= arm.bare and other > 3.5):
                            out[1] = nearer(out[1], ends, middles, it, a, it, b, arm)
        for a in range(counts[0]):
            for b in range(counts[1]):
                out[2] = nearer(out[2], ends, middles, 0, a, 1, b, arm)
        if out.min() < enough_mm:
            return


class Drawn(NamedTuple):
    """A random command: moves before it (arm -> (start, target, seconds, since)), where arms stand (2, 5), fingers, and itself."""

    stand: Floats
    fingers: tuple[float, float]
    earlier: dict[int, tuple[Floats, float, float]]
    commands: list[JointCommand]
    duration_s: float


class Draw:
    """Draws commands between places where arms meet each other, the table and themselves."""

    def __init__(self, model: CellModel, config: HardwareConfig, seed: int) -> None:
        self.random, self.arm = np.random.default_rng(seed), model.arm
        self.speed = config.gate.speed_share * np.array([model.arm.description.joint(name).velocity for name in ARM_JOINTS])
        self.step = math.radians(config.gate.step_deg)
        random, n = self.random, 40_000
        self.anywhere = random.uniform(model.arm.lower_rad, model.arm.upper_rad, (n, 5))
        across = np.stack([random.uniform(140.0, 260.0, n), random.uniform(-70.0, 70.0, n), random.uniform(25.0, 150.0, n)], axis=1)
        pitch, roll = random.uniform(-0.9, 0.9, n), random.uniform(-1.0, 1.0, n) * (random.random(n) < 0.5)
        meeting = model.arm.ik(across, pitch, roll)[:, 0]
        self.meeting = meeting[model.arm.within_limits(meeting)]

    def place(self) -> Floats:
        """Joints (5,): anywhere, or where the arms meet."""
        pool = self.meeting if self.random.random() < 0.7 else self.anywhere
        return pool[self.random.integers(len(pool))]

    def towards(self, start: Floats, duration_s: float) -> Floats:
        """As far from ``start`` to another place as the limits let an arm go, or some of it."""
        most = np.minimum(self.speed * duration_s, self.step) * 0.999
        way = (self.place() - start) if self.random.random() < 0.5 else self.random.uniform(-1.0, 1.0, 5) * 10.0
        aim = start + np.clip(way, -most, most) * (1.0 if self.random.random() < 0.6 else self.random.random())
        return np.clip(aim, self.arm.lower_rad, self.arm.upper_rad)

    def command(self, held: bool) -> Drawn:
        """One command; ``held``: a hand that moves holds the block, and the other one in some."""
        random = self.random
        stand = np.stack([self.place(), self.place()])
        moving = [0, 1] if random.random() < 0.5 else [int(random.integers(2))]
        fingers = [OPEN_MM, OPEN_MM]
        if held:
            fingers[moving[0]] = 0.0
            if random.random() < 0.3:
                fingers[1 - moving[0]] = 0.0
        earlier = {}
        for arm in range(2):
            if random.random() < 0.2:
                seconds = float(random.choice([0.06, 0.2, 0.5]))
                earlier[arm] = (self.towards(stand[arm], seconds), seconds, float(random.uniform(0.0, 1.2) * seconds))
        duration_s = float(random.choice([0.06, 0.1, 0.3]))
        rows = {arm: where(stand[arm], earlier.get(arm), 0.0) for arm in moving}
        commands = [JointCommand(arm, self.towards(row, duration_s), fingers[arm]) for arm, row in rows.items()]
        return Drawn(stand, (fingers[0], fingers[1]), earlier, commands, duration_s)


def where(stand: Floats, move: tuple[Floats, float, float] | None, ago_s: float) -> Floats:
    """Joints (5,) of an arm ``ago_s`` before the command."""
    if move is None:
        return stand
    target, seconds, since_s = move
    return stand + min(max((since_s - ago_s) / seconds, 0.0), 1.0) * (target - stand)


def postures(drawn: Drawn, samples: int, random: np.random.Generator) -> Floats:
    """Postures (S, 2, 5) of both arms that the command may lead to.

    Of arms that stood before: evenly on its way. Else arms of the command go together, from where they are or were up to a lag ago, and
    one in an earlier move is anywhere on the rest of it.
    """
    aims = {command.arm: command.joints_rad for command in drawn.commands}
    share, late = np.linspace(0.0, 1.0, samples), np.zeros(samples)
    if drawn.earlier:
        share, late = random.random(samples), random.choice([0.0, 0.0, 1.0, 1.0, 0.5, 0.25], samples)
        share[: samples // 8], share[samples // 8 : samples // 4] = 0.0, 1.0
    both = []
    for arm in range(2):
        move = drawn.earlier.get(arm)
        if arm in aims:
            now, before = where(drawn.stand[arm], move, 0.0), where(drawn.stand[arm], move, LAG_S)
            start = now + late[:, None] * (before - now)
            both.append(start + share[:, None] * (aims[arm] - start))
        elif move is None:
            both.append(np.tile(drawn.stand[arm], (samples, 1)))
        else:
            ago_s = move[2] - move[1] * random.uniform(max((move[2] - LAG_S) / move[1], 0.0), max(1.0, move[2] / move[1]), samples)
            both.append(np.array([where(drawn.stand[arm], move, float(ago)) for ago in ago_s]))
    return np.stack(both, axis=1)


class Judged(NamedTuple):
    """What the gate said, and the least (4,) of height, distance to itself, to the other arm, height of the block, that is allowed more."""

    refusal: Reason | None
    least_mm: Floats
    promised_mm: Floats
    moving: int
    held: bool
    earlier: bool

    def broken(self) -> bool:
        return self.refusal is None and bool((self.least_mm < self.promised_mm - SLACK_MM).any())

    def keeps(self) -> bool:
        return bool((self.least_mm >= KEEPS_MM).all())


class Court:
    """A gate and its judge."""

    def __init__(self, seed: int, cell: str = "paper") -> None:
        self.model, self.config = build_cell(cell_config(cell)), HardwareConfig()
        limits = self.config.gate
        self.gate = SafetyFilter(self.model, self.config, [nominal_calibration(self.config, arm, self.model.arm) for arm in ARMS])
        self.bodies, self.draw = bodies_of(self.model), Draw(self.model, self.config, seed)
        self.bases = np.array([transform((b.x_mm, b.y_mm, 0.0), (0.0, 0.0, b.facing_rad)) for b in self.model.cell.bases])
        self.promised = np.array([limits.table_clearance_mm, limits.self_clearance_mm, limits.arm_clearance_mm, -limits.block_dip_mm])

    def judge(self, drawn: Drawn, samples: int) -> Judged:
        """Give a command to the gate, and look for oneself."""
        now_s = 100.0
        for arm in range(2):
            self.gate.refer(arm, drawn.stand[arm], drawn.fingers[arm])
        for arm, (target, seconds, since_s) in drawn.earlier.items():
            self.gate.accept([JointCommand(arm, target, drawn.fingers[arm])], seconds, now_s - since_s)
        refusal = None
        try:
            self.gate.check(drawn.commands, drawn.duration_s, now_s, now_s)
        except CommandRejected as rejection:
            refusal = rejection.reason
        moving = np.array([any(command.arm == arm for command in drawn.commands) for arm in range(2)])
        holding, least = np.array(drawn.fingers) < OPEN_MM, np.empty(4)
        Q = postures(drawn, samples, self.draw.random)
        least_mm(Q, self.bases, self.bodies, holding, moving, -FAR_MM if refusal is None else KEEPS_MM, least)
        return Judged(refusal, least, self.promised, int(moving.sum()), bool(holding.any()), bool(drawn.earlier))


def judged(commands: int, samples: int, seed: int, progress: bool = False) -> dict[str, Any]:
    """All commands judged. A start that is too near already is drawn again: what moves away from there is refused, and should be."""
    court, reasons, broken, found = Court(seed), Counter[str](), [], []
    number = 0
    while number < commands:
        drawn = court.draw.command(number % 2 == 0)
        start, moving = np.empty(4), np.ones(2, bool)
        least_mm(drawn.stand[None], court.bases, court.bodies, np.array(drawn.fingers) < OPEN_MM, moving, -FAR_MM, start)
        if (start < court.promised).any():
            continue
        it = court.judge(drawn, samples)
        number += 1
        reasons[str(it.refusal or "passed")] += 1
        found.append(it)
        if it.broken():
            broken.append({"number": number, "least_mm": it.least_mm.round(3).tolist()})
        if progress and number % 5000 == 0:
            print(f"{number} judged: {dict(reasons)}, {len(broken)} nearer than promised", flush=True)
    return {"reasons": dict(reasons), "broken": broken, **summed(found)}


def summed(found: list[Judged]) -> dict[str, Any]:
    """Shares of what was refused for nothing, and how near those that passed came to what is promised; by kind of command."""
    kinds = {
        "all": found,
        "one arm": [it for it in found if it.moving == 1],
        "two arms": [it for it in found if it.moving == 2],
        "block held": [it for it in found if it.held],
        "from standing": [it for it in found if not it.earlier],
        "in earlier moves": [it for it in found if it.earlier],
    }
    rows = {}
    for name, some in kinds.items():
        keeping, passed = [it for it in some if it.keeps()], [it for it in some if it.refusal is None]
        needless = sum(it.refusal is not None for it in keeping)
        over = np.min([it.least_mm - it.promised_mm for it in passed], axis=0).round(3).tolist() if passed else None
        near = sum(bool((it.least_mm < it.promised_mm + 2.0).any()) for it in passed)
        rows[name] = {
            "count": len(some),
            "passed": len(passed),
            "passed_within_2_mm": near,
            "keep_5_mm": len(keeping),
            "needless": needless,
        }
        rows[name] |= {"needless_share": needless / len(keeping) if keeping else None, "least_over_promised_mm": over}
    return {"kinds": rows}


TIMER = """
import sys, time
import numpy as np
from marl_handover.cell.build import build_cell, cell_config
from marl_handover.hardware.calibration import nominal_calibration
from marl_handover.hardware.safety_filter import JointCommand, SafetyFilter
from marl_handover.hardware.settings import ARMS, HardwareConfig

track = np.load(sys.argv[1])
model, config = build_cell(cell_config("paper")), HardwareConfig()
gate = SafetyFilter(model, config, [nominal_calibration(config, arm, model.arm) for arm in ARMS])
parked, costs, now_s = np.radians([0.0, 140.0, -115.0, 70.0, 0.0]), [], 1.0
for _ in range(20):
    for arm in range(2):
        gate.refer(arm, parked, 12.0)
    for row in track:
        command = [JointCommand(0, row[:5], float(row[5]))]
        begun = time.perf_counter()
        gate.check(command, 0.06, now_s, now_s)
        costs.append(time.perf_counter() - begun)
        gate.accept(command, 0.06, now_s)
        now_s += 0.06
print(*np.percentile(costs, [50, 95]))
"""


def costs(against: str, rounds: int) -> dict[str, Any]:
    """Median and p95 in us of one streamed command checked, here and at the commit, the least of ``rounds`` in turn; and their ratio."""
    with tempfile.TemporaryDirectory() as folder:
        packed = subprocess.run(["git", "archive", against, "marl_handover", "urdf", "configs"], cwd=ROOT, capture_output=True, check=False)
        if packed.returncode:
            sys.exit(f"safety_filter.py: cannot use against={against!r}: {packed.stderr.decode().strip()}")
        subprocess.run(["tar", "x", "-C", folder], input=packed.stdout, check=True)
        track = Path(folder) / "track.npy"
        np.save(track, streamed())
        places = {"here": str(ROOT), "there": folder}
        found: dict[str, list[list[float]]] = {name: [] for name in places}
        for _ in range(rounds + 1):
            for name, path in places.items():
                work = subprocess.run(
                    [sys.executable, "-c", TIMER, str(track)],
                    cwd=path,
                    env=os.environ | {"PYTHONPATH": path},
                    capture_output=True,
                    check=True,
                )
                found[name].append([1e6 * float(word) for word in work.stdout.split()])
    medians = {name: np.array(rows[1:]).min(axis=0) for name, rows in found.items()}  # the first one compiles
    return {
        "against": against,
        "us": {name: row.round(1).tolist() for name, row in medians.items()},
        "ratio": (medians["here"] / medians["there"]).round(2).tolist(),
    }


def streamed() -> Floats:
    """Joints and fingers (n, 6) of a planned transfer, a row every 60 ms."""
    planner = MotionPlanner(build_cell(cell_config("paper")))
    motion = planner.pick_place(0, [0.0, 0.0], [30.0, -10.0], planner.home_rad, planner.home_rad)
    t_s = np.concatenate([phase.t_s for phase in motion.phases])
    columns = [
        *np.concatenate([phase.joints_rad for phase in motion.phases]).T,
        np.concatenate([phase.gripper_mm for phase in motion.phases]),
    ]
    return np.stack([np.interp(np.arange(0.06, t_s[-1] + 0.06, 0.06), t_s, column) for column in columns], axis=1)


def shown(found: dict[str, Any]) -> str:
    """The results as a table."""
    rows = [["nearer than promised, less 0.1 mm (0)", str(len(found["broken"]))]]
    for name, it in found["kinds"].items():
        share = "-" if it["needless_share"] is None else f"{100 * it['needless_share']:.2f} %"
        passed = f"{it['passed']} of {it['count']}, {it['passed_within_2_mm']} within 2 mm of a limit"
        rows.append([f"{name}: passed; needless of {it['keep_5_mm']} that keep 5 mm (5 %)", f"{passed}; {share}"])
        rows.append(["  least over table, itself, other arm, block's dip, mm", str(it["least_over_promised_mm"])])
    rows.append(["said", json.dumps(found["reasons"])])
    if it := found.get("cost"):
        rows.append([f"a streamed command checked, median and p95, against {it['against']} (2 x)", f"{it['ratio']} x, {it['us']} us"])
    return table(["what (bar)", "result"], rows)


def main(arguments: list[str]) -> None:
    values = parse(arguments, DEFAULTS)
    begun = time.perf_counter()
    found = judged(values["commands"], values["samples"], values["seed"], progress=True)
    if values["against"]:
        found["cost"] = costs(values["against"], values["rounds"])
    print("\n" + shown(found))
    folder = ROOT / values["results"] / datetime.date.today().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    about = {"settings": values, "commit": commit(), "machine": machine(1), "wall_s": time.perf_counter() - begun}
    (folder / "gate.json").write_text(json.dumps({**about, **found}, indent=1) + "\n")
    print(f"-> {folder / 'gate.json'}")


if __name__ == "__main__":
    main(sys.argv[1:])

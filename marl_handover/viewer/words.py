"""What pages say, and how their inputs and viser's lengths (m), turns (quaternions) and colours become the package's."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike
from viser.transforms import SO3

from marl_handover.arrays import Floats
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.control.interactive.cell import Placement, Snapshot
from marl_handover.errors import counted
from marl_handover.task.rules import Rules

Colour = tuple[int, int, int]

UPWARDS = (0.0, 0.0, 1.0)


def metres(length_mm: ArrayLike) -> Floats:
    """Lengths or points of any shape."""
    return np.asarray(length_mm, float) / 1000.0


def rgb(colour: str) -> Colour:
    """Of ``#RRGGBB``."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def quaternion(axis: Sequence[float], angle_rad: float) -> Floats:
    """The turn (4,) by ``angle_rad`` about a unit vector."""
    return np.asarray(SO3.exp(angle_rad * np.asarray(axis, float)).wxyz, float)


def product(first: Floats, second: Floats) -> Floats:
    """The turn (4,) that makes ``second`` and then ``first``."""
    return np.asarray((SO3(first) @ SO3(second)).wxyz, float)


def turned(R: Floats) -> Floats:
    """The quaternion (4,) of a rotation matrix (3, 3)."""
    return np.asarray(SO3.from_matrix(R).wxyz, float)


def yaw_of(wxyz: Floats) -> float:
    """The turn in rad about the vertical of a quaternion (4,) that is one about the vertical."""
    return 2 * math.atan2(wxyz[3], wxyz[0]) if wxyz[0] >= 0 else 2 * math.atan2(-wxyz[3], -wxyz[0])


def flat(pose: ArrayLike, height_mm: float = 0.0) -> tuple[Floats, Floats]:
    """Quaternion (4,) and position (3,) in m of a pose (x_mm, y_mm, yaw_rad) at a height above the table."""
    x_mm, y_mm, yaw_rad = np.asarray(pose, float)
    return quaternion(UPWARDS, float(yaw_rad)), metres([x_mm, y_mm, height_mm])


def by_hand(event: viser.GuiEvent[Any]) -> bool:
    """Whether somebody changed an input, not this program."""
    return event.client_id is not None


def number(handle: Any, low: float, high: float) -> float:
    """What an input says, between ``low`` and ``high``: a viewer may send anything."""
    value = float(handle.value)
    return min(max(value, low), high) if math.isfinite(value) else low


def write(handle: Any, value: object) -> None:
    """Set an input to ``value``; typed loosely, as type checkers take viser's ``value`` for read-only."""
    handle.value = value


def at_once(act: Callable[[], object]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """A callback that calls ``act`` in the server's own thread: it waits for no other callback. ``act`` has to be quick."""

    async def act_now(_: object) -> None:
        act()

    return act_now


ARM_NAMES = {"L": "left arm", "R": "right arm", "left": "left arm", "right": "right arm"}

DOING = {
    "approach": "goes to the block",
    "grasp": "closes its hand",
    "lift": "lifts the block",
    "transfer": "carries the block",
    "lower": "puts the block down",
    "release": "opens its hand",
    "retreat": "goes home",
}
"""What an arm does, by the phase of its motion."""

STATES = {
    "waiting": "Waiting.",
    "paused": "Paused.",
    "stopped": "STOPPED. Nothing moves until the stop is cleared.",
    "done": "Done: the block is at its goal.",
    "stuck": "Stuck: there is no way to the goal, or the policy knows none.",
    "broken": "The arms wait: the cell cannot be like this.",
}

_MARKUP = frozenset("<>&[]*_`~|\\#!+-.)")
"""Has a meaning in Markdown or HTML, the last ones after a number that begins a line."""


def plain(text: str) -> str:
    """``text`` on one line, as Markdown that shows it as it is: what comes from files and viewers may be a script or a picture."""
    return " ".join("".join(f"&#{ord(sign)};" if sign in _MARKUP else sign for sign in text).split())


def arm_words(label: str) -> str:
    """An arm, by what traces and pictures call it."""
    return ARM_NAMES.get(label, f"arm {label}")


def degrees_words(angle_rad: float) -> str:
    """An angle to a whole degree."""
    return f"{math.degrees(angle_rad):z.0f}°"


def place_words(position_mm: ArrayLike) -> str:
    """A place on the table to a whole mm, without a minus before 0."""
    x_mm, y_mm = np.asarray(position_mm, float)[:2]
    return f"({x_mm:z.0f}, {y_mm:z.0f}) mm"


def error_words(rules: Rules, pose: ArrayLike, goal: ArrayLike) -> str:
    """How far a pose (3,) is from the goal (3,)."""
    here, there = np.asarray(pose, float), np.asarray(goal, float)
    turned = abs(math.degrees(float(rules.orientation_error(here[2], there[2]))))
    return f"{math.hypot(*(here[:2] - there[:2])):.1f} mm, {turned:.1f}°"


def state_words(snapshot: Snapshot, labels: Sequence[str] = ARM_LETTERS) -> str:
    """What is going on; ``labels``: of the arms."""
    if snapshot.state == "moving" and snapshot.arm >= 0:
        doing, label = DOING.get(snapshot.phase, "moves"), labels[snapshot.arm]
        who = f"The {arm_words(label)}" if label in ARM_NAMES else f"Arm {plain(label)}"
        return f"**{who} {doing}.**"
    return f"**{STATES.get(snapshot.state, snapshot.state)}**"


def decision_words(rules: Rules, plan: Sequence[Placement], goal: ArrayLike, labels: Sequence[str] = ARM_LETTERS) -> str:
    """The next placement, and what the policy expects of its plan in the end; ``labels``: of the arms."""
    first, last = plan[0], plan[-1]
    where = "to the goal" if first.final else f"to a hand-over at {place_words(first.pose)}"
    foreseen = f"{error_words(rules, last.pose, goal)} from the goal after {counted(len(plan), 'transfer')}"
    return f"{plain(arm_words(labels[first.arm]))} {where}; foreseen: {foreseen}, {degrees_words(rules.epsilon_rad)} allowed"


def score_words(snapshot: Snapshot) -> str:
    """Transfers against the optimum, in this episode and in all."""
    ratio = "–" if math.isnan(snapshot.ratio) else f"{snapshot.ratio:.2f}"
    rate = f" ({snapshot.solved / snapshot.episodes:.0%})" if snapshot.episodes else ""
    return (
        f"| | |\n|---|---|\n| transfers so far | {snapshot.transfers} |\n| the fewest possible | {snapshot.optimal} |\n"
        f"| problems solved | {snapshot.solved} of {snapshot.episodes}{rate} |\n| transfers ÷ fewest | {ratio} |"
    )

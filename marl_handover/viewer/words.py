"""What the pages say: short lines of Markdown about a block, an arm, a decision."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.runtime.interactive.cell import Placement, Snapshot
from marl_handover.task.rules import Rules
from marl_handover.wording import counted

Floats = NDArray[np.float64]

ARM_NAMES = {"L": "left arm", "R": "right arm"}

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
    "stuck": "Stuck: the policy knows no way to the goal.",
}

_MARKUP = frozenset("<>&[]*_`~|\\#!+-.)")
"""Has a meaning in Markdown or HTML, the last ones after a number that begins a line."""


def plain(text: str) -> str:
    """``text`` on one line, as Markdown that shows it as it is: what comes from files and viewers may be a script or a picture."""
    return " ".join("".join(f"&#{ord(sign)};" if sign in _MARKUP else sign for sign in text).split())


def arm_name(arm: int) -> str:
    """Of an index."""
    letter = ARM_LETTERS[arm]
    return ARM_NAMES.get(letter, f"arm {letter}")


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


def state_words(snapshot: Snapshot) -> str:
    """What is going on."""
    if snapshot.state == "moving" and snapshot.arm >= 0:
        doing = DOING.get(snapshot.phase, "moves")
        return f"**The {arm_name(snapshot.arm)} {doing}.**"
    return f"**{STATES.get(snapshot.state, snapshot.state)}**"


def decision_words(rules: Rules, plan: Sequence[Placement], goal: ArrayLike) -> str:
    """The next placement, and what the policy expects of its plan in the end."""
    first, last = plan[0], plan[-1]
    where = "to the goal" if first.final else f"to a hand-over at {place_words(first.pose)}"
    foreseen = f"{error_words(rules, last.pose, goal)} from the goal after {counted(len(plan), 'transfer')}"
    return f"{arm_name(first.arm)} {where}; foreseen: {foreseen}, {degrees_words(rules.epsilon_rad)} allowed"


def score_words(snapshot: Snapshot) -> str:
    """Transfers against the optimum, in this episode and in all."""
    ratio = "–" if math.isnan(snapshot.ratio) else f"{snapshot.ratio:.2f}"
    rate = f" ({snapshot.solved / snapshot.episodes:.0%})" if snapshot.episodes else ""
    return (
        f"| | |\n|---|---|\n| transfers so far | {snapshot.transfers} |\n| the fewest possible | {snapshot.optimal} |\n"
        f"| problems solved | {snapshot.solved} of {snapshot.episodes}{rate} |\n| transfers ÷ fewest | {ratio} |"
    )

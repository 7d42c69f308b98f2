"""Traces of the closed loop: one JSON object a transfer, as ``evaluate trace=FILE`` writes them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.learning.evaluation import judged_by
from marl_handover.runtime.episode import Episode, Transfer
from marl_handover.task.rules import Outcome, Rules


def trace_text(episodes: Sequence[Episode], rules: Rules) -> str:
    """All lines, episode by episode; what came after the first verdict has an ``attempt`` above 0."""
    rows = [
        {"episode": number, "step": step, **transfer_row(transfer, rules)}
        for number, episode in enumerate(episodes)
        for step, transfer in enumerate(episode.transfers)
    ]
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)


def transfer_row(transfer: Transfer, rules: Rules) -> dict[str, Any]:
    """One line: the fields of a kinematic trace with measured poses, and what only a motion has."""
    order, done = transfer.order, transfer.done
    return {
        "state": transfer.before.tolist(),
        "goal": transfer.goal.tolist(),
        "previous_arm": ARM_LETTERS[transfer.previous_arm] if transfer.previous_arm >= 0 else None,
        "arm": ARM_LETTERS[order.arm],
        "final": order.final,
        "place": order.place_mm.tolist(),
        "alpha": float(order.chart[0]),
        "beta": float(order.chart[1]),
        "next_state": done.pose.tolist(),
        "reward": transfer.reward,
        "terminated": transfer.terminated,
        "truncated": transfer.truncated,
        "outcome": None if transfer.outcome is Outcome.NONE else transfer.outcome.name.lower(),
        **judged_by(rules),
        "attempt": transfer.attempt,
        "refusal": done.refusal and str(done.refusal),
        "detail": done.detail,
        "planning_ms": done.planning_ms,
        "duration_s": done.duration_s,
        "path_mm": done.path_mm,
    }

"""Traces: every transfer of every episode, one JSON object a line, as ``evaluate trace=FILE`` writes them."""

from __future__ import annotations

import json
from typing import Any

from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.task.episode import Decision
from marl_handover.task.rules import Outcome, Rules


def judged_by(rules: Rules) -> dict[str, Any]:
    """What a line says of the rules that its transfer was judged by."""
    return {
        "epsilon_rad": rules.epsilon_rad,
        "symmetry_order": rules.config.symmetry_order,
        "architecture": rules.config.architecture,
    }


class Trace:
    """An observer of roll-outs. Architecture A's external last transfer becomes a line of its own, with ``"final": true``."""

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self.episodes: dict[int, list[dict[str, Any]]] = {}

    def __call__(self, decision: Decision) -> None:
        """Take in one decision of the running episodes."""
        alpha, beta = self.rules.cell.chart.from_table(decision.result.command.place_mm)
        for row, episode in enumerate(decision.episode):
            lines = self.episodes.setdefault(int(episode), [])
            commanded, external = self._commanded(decision, row, float(alpha[row]), float(beta[row])), self._external(decision, row)
            for line in (commanded, external):
                if line is not None:
                    lines.append({"episode": int(episode), "step": len(lines), **line})

    def text(self) -> str:
        """All lines, episode by episode."""
        return "".join(json.dumps(line) + "\n" for _, lines in sorted(self.episodes.items()) for line in lines)

    def _commanded(self, decision: Decision, row: int, alpha: float, beta: float) -> dict[str, Any] | None:
        """The policy's own transfer; None where it was ignored because the episode was solved at its start."""
        result = decision.result
        external = int(result.external_arm[row]) >= 0
        if int(result.transfers[row]) == external:
            return None
        final = bool(result.command.final[row])
        place = decision.goal[row, :2] if final else result.command.place_mm[row]
        terminated = bool(result.terminated[row])
        truncated = not terminated and int(decision.made[row] + result.transfers[row]) >= self.rules.config.max_steps
        outcome = Outcome.TIMEOUT if truncated else Outcome(int(result.outcome[row]))
        return {
            **self._problem(decision, row, decision.pose[row], int(decision.previous_arm[row])),
            "arm": ARM_LETTERS[int(result.command.arm[row])],
            "final": final,
            "place": place.tolist(),
            "alpha": alpha,
            "beta": beta,
            "next_state": result.placed[row].tolist(),
            "reward": float(result.reward[row]),
            "terminated": terminated and not external,
            "truncated": truncated,
            "outcome": None if external or outcome is Outcome.NONE else outcome.name.lower(),
            **judged_by(self.rules),
        }

    def _external(self, decision: Decision, row: int) -> dict[str, Any] | None:
        """The external final transfer of architecture A; None where there was none. The reward stands with the command, if
        there was one.
        """
        result = decision.result
        arm = int(result.external_arm[row])
        if arm < 0:
            return None
        commanded = int(result.transfers[row]) > 1
        previous = int(result.command.arm[row]) if commanded and bool(result.feasible[row]) else int(decision.previous_arm[row])
        return {
            **self._problem(decision, row, result.placed[row], previous),
            "arm": ARM_LETTERS[arm],
            "final": True,
            "place": decision.goal[row, :2].tolist(),
            "alpha": 0.0,
            "beta": 0.0,
            "next_state": result.pose[row].tolist(),
            "reward": 0.0 if commanded else float(result.reward[row]),
            "terminated": True,
            "truncated": False,
            "outcome": Outcome(int(result.outcome[row])).name.lower(),
            **judged_by(self.rules),
        }

    @staticmethod
    def _problem(decision: Decision, row: int, pose: Any, previous: int) -> dict[str, Any]:
        return {
            "state": pose.tolist(),
            "goal": decision.goal[row].tolist(),
            "previous_arm": ARM_LETTERS[previous] if previous >= 0 else None,
        }

"""An entry of the ladder, checked: its trace is replayed by the rule book, and what the report says has to come out again.

The actions are the trace's, all else is computed anew: where they take the object, what the verdict is, how many transfers it took.
On rungs with noise the placements are the trace's, too, and may be no farther from where they should be than that noise explains.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from marl_handover.arrays import Floats, wrap
from marl_handover.errors import CorruptFile, HandoverError, WorkFailed
from marl_handover.parsing import read_json, read_rows
from marl_handover.report.arm_labels import arm_index
from marl_handover.task.actions import action_of
from marl_handover.task.episode import advance
from marl_handover.task.ladder import Rung, rung
from marl_handover.task.problems import regret
from marl_handover.task.rules import Outcome, Rules

EXACT_MM, EXACT_RAD = 1e-6, 1e-7
"""A replayed pose may be so far from the trace's: chart coordinates are rounded."""

SIGMAS = 6.0
"""A placement with noise may be so many standard deviations beside, per axis: one of 10^8 is farther."""

Line = Mapping[str, Any]


class Replayed(NamedTuple):
    """What came of a trace: which rung it is of, and the ``regret`` and ``solved`` of each problem (n,)."""

    rung: Rung
    regret: NDArray[np.int64]
    solved: NDArray[np.bool_]


class UnfitEntry(WorkFailed):
    """A report or a trace that is not what it says."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.path, self.reason = path, reason


def check_entry(report_path: Path, trace_path: Path) -> Replayed:
    """Replay a trace that ``evaluate ladder=RUNG json=REPORT trace=TRACE`` wrote, and compare the result with the report.

    Raises:
        MissingFile, CorruptFile: a file is not there or cannot be read.
        UnfitEntry: it is not of all problems of the rung as it is now, a step is not what the rule book says, or the report says otherwise.
    """
    report = read_json(report_path, "report")
    try:
        of, said = rung(str(report["ladder"]["rung"])), (float(report["regret"]), float(report["success_rate"]))
        about = report["ladder"]["sha256"], report["architecture"], report["backend"], int(report["episodes"])
    except (KeyError, TypeError, ValueError) as error:
        raise CorruptFile("report", report_path, "it is none of evaluate ladder=RUNG") from error
    for what, value, wanted in zip(
        ("problems of the SHA-256", "architecture", "backend", "number of problems"),
        about,
        (of.sha256, "B", "kinematic", of.problems),
        strict=True,
    ):
        if value != wanted:
            raise UnfitEntry(report_path, f"{what} {value}, and an entry for {of.name} has {wanted}")
    found = replay(of, trace_path)
    for what, value, replayed in zip(("regret", "success_rate"), said, (found.regret.mean(), found.solved.mean()), strict=True):
        if not math.isclose(value, replayed, abs_tol=1e-9):
            raise UnfitEntry(report_path, f"{what} = {value}, but the trace has {replayed:.6f}")
    return found


def replay(of: Rung, path: Path) -> Replayed:
    """Play what a trace says on all problems of a rung. One without a line for its next decision was given up there, and has failed.

    Raises:
        MissingFile, CorruptFile, UnfitEntry: as :func:`check_entry`.
    """
    rules, lines = Rules(of.load_cell(), of.task()), _lines_of(of, path)
    start, goal, optimum = of.fixed
    pose, previous, made = start.copy(), np.full(len(start), -1), np.zeros(len(start), int)
    outcome = np.full(len(start), int(Outcome.NONE))
    for step in range(max(map(len, lines), default=0)):
        told = np.array([number for number, each in enumerate(lines) if len(each) > step])
        if (outcome[told] != int(Outcome.NONE)).any():
            raise UnfitEntry(path, f"episode {told[outcome[told] != int(Outcome.NONE)][0]} goes on after its end")
        rows = [lines[number][step] for number in told]
        _require_there(path, rows, told, pose[told], goal[told])
        action = np.stack([_action(rules, row, path) for row in rows])
        expected = rules.step(pose[told], goal[told], previous[told], action)
        beside = np.array([row["next_state"] for row in rows], float) - expected.placed
        beside[:, 2] = wrap(beside[:, 2])
        _require_near(of, path, told, beside, np.asarray(expected.feasible))
        stepped = advance(rules, pose[told], goal[told], previous[told], action, made[told], noise=beside)
        pose[told], previous[told] = stepped.result.pose, stepped.result.previous_arm
        made[told], outcome[told] = stepped.transfers, stepped.outcome
    left = regret(outcome, made, optimum, rules.config.max_steps)
    return Replayed(of, np.asarray(left), outcome == int(Outcome.SUCCESS))


def _lines_of(of: Rung, path: Path) -> list[list[Line]]:
    """The lines of each problem, in order."""
    lines: list[list[Line]] = [[] for _ in range(of.problems)]
    for number, row in read_rows(path, "trace"):
        episode, step = row.get("episode"), row.get("step")
        if not isinstance(episode, int) or not 0 <= episode < len(lines) or step != len(lines[episode]):
            raise CorruptFile("trace", path, f"line {number}: episode {episode}, step {step} is no next step of {of.problems} episodes")
        lines[episode].append(row)
    return lines


def _require_there(path: Path, rows: list[Line], told: NDArray[np.int64], pose: Floats, goal: Floats) -> None:
    """Raise if lines do not begin where the object is, or are about other goals."""
    for key, there in (("state", pose), ("goal", goal)):
        try:
            apart = np.array([row[key] for row in rows], float).reshape(-1, 3) - there
        except (KeyError, TypeError, ValueError) as error:
            raise CorruptFile("trace", path, f"a line has no {key} of three numbers") from error
        apart[:, 2] = wrap(apart[:, 2])
        off = ~(abs(apart) <= [EXACT_MM, EXACT_MM, EXACT_RAD]).all(-1)
        if off.any():
            raise UnfitEntry(
                path, f"episode {told[off][0]} has the {key} {rows[int(off.argmax())][key]}, where it is {there[off][0].tolist()}"
            )


def _action(rules: Rules, row: Line, path: Path) -> Floats:
    """The numbers of a line's command."""
    try:
        final, arm = bool(row["final"]), arm_index(rules.cell, str(row["arm"]))
        named = row.get("receiver")
        receiver = 1 - arm if rules.cell.num_arms == 2 else arm if named is None else arm_index(rules.cell, str(named))
        place = [0.0 if row[key] is None else float(row[key]) for key in ("alpha", "beta")]
    except (KeyError, TypeError, ValueError, HandoverError) as error:
        raise CorruptFile("trace", path, f"episode {row.get('episode')}, step {row.get('step')} is no command: {error}") from error
    return action_of(np.bool_(final), np.int64(arm), np.int64(receiver), np.array(place), rules.cell.num_arms)


def _require_near(of: Rung, path: Path, told: NDArray[np.int64], beside: Floats, feasible: NDArray[np.bool_]) -> None:
    """Raise if an object is not where its transfer leaves it, ``beside`` (n, 3) that, but for the noise of one that took place."""
    noise = np.array([of.noise.position_mm, of.noise.position_mm, math.radians(of.noise.yaw_deg)])
    most = np.where(feasible[:, None], SIGMAS * noise, 0.0) + [EXACT_MM, EXACT_MM, EXACT_RAD]
    off = ~(abs(beside) <= most).all(-1)
    if off.any():
        raise UnfitEntry(
            path, f"episode {told[off][0]} leaves the object {beside[off][0].tolist()} (mm, mm, rad) beside where its command does"
        )

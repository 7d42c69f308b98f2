"""Judging a policy on the batched rules: the numbers, file formats, traces and confidence intervals of ``evaluate``."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from marl_handover.arrays import Floats, wrap
from marl_handover.cell.symmetry import ARM_LETTERS
from marl_handover.errors import CorruptFile, NotFinite
from marl_handover.files import read_bounded
from marl_handover.parsing import LINES_BYTES, parse_object
from marl_handover.task.episode import Act, Decision, Episodes, Noise, Observer, conclude, play
from marl_handover.task.planner import ExactPlanner
from marl_handover.task.problems import sample_problems
from marl_handover.task.rules import Outcome, Rules, carried

EVALUATION_SEED = 1_000_000_000
"""Problems of reports come from seeds from here on; training and its validation use others, so these are never seen."""

TIMED_DECISIONS = 1000
CHUNK = 1000


def random_problems(rules: Rules, count: int, seed: int) -> tuple[Floats, Floats]:
    """Starts and goals (count, 3) of evaluation seed ``seed``."""
    generator = torch.Generator().manual_seed(EVALUATION_SEED + seed)
    start, goal = sample_problems(rules.cell, count, generator)
    return start.numpy(), goal.numpy()


def read_problems(rules: Rules, path: Path) -> tuple[Floats, Floats]:
    """Problems of a JSON Lines file of ``{"state": [x_mm, y_mm, theta_rad], "goal": [...]}``, all lines, in order.

    Raises:
        MissingFile, CorruptFile, NotFinite, OutOfReach: with the line's number.
    """
    poses: dict[str, list[Floats]] = {"state": [], "goal": []}
    try:
        text = read_bounded(path, LINES_BYTES, "problems file").decode("utf-8")
    except UnicodeDecodeError as error:
        raise CorruptFile("problems file", path, str(error)) from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = parse_object(line, finite=False)
            values = {key: np.array(row[key], float).reshape(3) for key in poses}
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise CorruptFile("problems file", path, f"line {number} is not {{'state': [3 numbers], 'goal': [3 numbers]}}") from error
        for key, value in values.items():
            what = f"{key} in line {number} of {path}"
            if not np.isfinite(value).all():
                raise NotFinite(what, value.tolist())
            rules.cell.require_reached(what, value)
            poses[key].append(np.concatenate([value[:2], np.atleast_1d(wrap(value[2]))]))
    if not poses["state"]:
        raise CorruptFile("problems file", path, "it holds no problem")
    return np.stack(poses["state"]), np.stack(poses["goal"])


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a proportion, 95 % by default."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    # At the ends the bound is the share itself; rounding must not put it on the wrong side.
    return (0.0 if successes == 0 else centre - half), (1.0 if successes == trials else centre + half)


@dataclass
class Evaluation:
    """A policy's result on a set of problems. ``optimal`` is 0 where no plan exists within the step limit."""

    episodes: Episodes
    optimal: NDArray[np.int64]
    decision_us: tuple[float, float]
    wall_s: float

    def report(self) -> dict[str, Any]:
        """The counts and statistics of ``evaluate json=FILE``."""
        outcome, steps = self.episodes.outcome, self.episodes.transfers
        solved = outcome == int(Outcome.SUCCESS)
        count, successes = len(outcome), int(solved.sum())
        low, high = wilson_interval(successes, count)
        known = solved & (self.optimal > 0)
        return {
            "episodes": count,
            "success_rate": successes / count,
            "success_ci95": [low, high],
            "mean_steps": float(steps.mean()),
            "mean_steps_success": float(steps[solved].mean()) if successes else None,
            "optimal_mean_steps": float(self.optimal[self.optimal > 0].mean()) if (self.optimal > 0).any() else None,
            "steps_ratio": float((steps[known] / self.optimal[known]).mean()) if known.any() else None,
            "outcomes": {kind.name.lower(): int((outcome == int(kind)).sum()) for kind in Outcome if kind is not Outcome.NONE},
            "decision_us": {"p50": self.decision_us[0], "p99": self.decision_us[1]},
            "wall_s": self.wall_s,
        }


def evaluate(
    rules: Rules,
    act: Act,
    problems: tuple[Floats, Floats],
    seed: int = 0,
    observer: Observer | None = None,
    progress: Callable[[int], object] = lambda done: None,
    timed: Act | None = None,
) -> Evaluation:
    """Play all problems (n, 3), (n, 3) with a batched numpy policy, in chunks, and time single decisions.

    Args:
        rules: the rule book to be judged by.
        act: the policy.
        problems: starts and goals.
        seed: of noise.
        observer: sees every decision, with episode numbers over all problems.
        progress: called with the number of problems a chunk finished.
        timed: what is timed instead of ``act``, for one that counts its decisions.
    """
    started = time.perf_counter()
    noise, seeing = placement_noise(rules, seed), mistaken(rules, act, seed)
    parts = []
    for first in range(0, len(problems[0]), CHUNK):
        start, goal = problems[0][first : first + CHUNK], problems[1][first : first + CHUNK]
        shifted = None if observer is None else _shifted(observer, first)
        parts.append(play(rules, seeing, start, goal, noise=noise, observer=shifted))
        progress(len(start))
    episodes = Episodes(*(np.concatenate([part[index] for part in parts]) for index in range(3)))
    optimal = ExactPlanner(rules).plan(*problems).transfers
    return Evaluation(episodes, optimal, decision_time(timed or act, problems), time.perf_counter() - started)


def _shifted(observer: Observer, first: int) -> Observer:
    return lambda decision: observer(decision._replace(episode=decision.episode + first))


def placement_noise(rules: Rules, seed: int) -> Noise | None:
    """Gaussian placement noise as the task's settings say, or None on exact hardware."""
    if not rules.noisy:
        return None
    settings = rules.config.noise
    scale = np.array([settings.position_mm, settings.position_mm, math.radians(settings.yaw_deg)])
    generator = np.random.default_rng(seed)
    return lambda count: generator.normal(size=(count, 3)) * scale


def mistaken(rules: Rules, act: Act, seed: int) -> Act:
    """``act`` as it decides about an object that it sees displaced, as the task's settings say; or itself."""
    settings = rules.config.noise
    if not settings.observed:
        return act
    scale = np.array([settings.observed_mm, settings.observed_mm, math.radians(settings.observed_deg)])
    generator = np.random.default_rng([seed, 1])  # other draws than those of placements

    def seeing(pose: Floats, goal: Floats, previous_arm: NDArray[np.int64]) -> Floats:
        offset = generator.normal(size=pose.shape) * scale
        seen: Floats = act(carried(pose, pose[..., :2] + offset[..., :2], offset[..., 2]), goal, previous_arm)
        return seen

    return seeing


def decision_time(act: Act, problems: tuple[Floats, Floats]) -> tuple[float, float]:
    """Median and 99th percentile, in microseconds, of one decision for one problem: pose in, action out."""
    elapsed = []
    none = np.int64(-1)
    for index in range(-20, min(TIMED_DECISIONS, max(len(problems[0]), 100))):
        row = index % len(problems[0])
        begun = time.perf_counter_ns()
        act(problems[0][row], problems[1][row], none)
        if index >= 0:  # the first ones warm up
            elapsed.append(time.perf_counter_ns() - begun)
    p50, p99 = np.percentile(elapsed, [50, 99]) / 1e3
    return float(p50), float(p99)


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
        alpha, beta = self.rules.cell.shared.from_table(decision.result.command.place_mm)
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
        terminated, made = bool(result.terminated[row]), decision.made[row] + result.transfers[row]
        truncated, ended = conclude(result.terminated[row], result.outcome[row], made, self.rules.config.max_steps)
        outcome = Outcome(int(ended))
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
            "truncated": bool(truncated),
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

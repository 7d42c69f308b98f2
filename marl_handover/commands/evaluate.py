"""``marl-handover evaluate``: episodes of a policy against the exact optimum."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_handover.config import CELL_ALIASES, bounded, path_field
from marl_handover.control.evaluation import AssessmentConfig, assess
from marl_handover.errors import InvalidSetting, MissingFile, counted
from marl_handover.experiments.provenance import commit
from marl_handover.files import write_whole
from marl_handover.learning.evaluation import Evaluation
from marl_handover.learning.recorder import machine
from marl_handover.task.rules import Outcome

if TYPE_CHECKING:
    from marl_handover.control.recording import Recorder


@dataclass
class EvaluateCommand(AssessmentConfig):
    """Settings of ``evaluate``."""

    json: str = path_field()  # file for the result
    trace: str = path_field()  # file for every transfer
    record: str = path_field()  # of twin: folder that is made for a LeRobotDataset of the episodes
    record_fps: int = bounded(10, 1, 50)  # its frames a second
    progress: bool = True


SCHEMA = EvaluateCommand
ALIASES = CELL_ALIASES | {key: f"task.{key}" for key in ("epsilon_deg", "architecture", "max_steps")}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: EvaluateCommand) -> int:
    """Play, print the table, write the files."""
    evaluated(config, print)
    return 0


def evaluated(config: EvaluateCommand, say: Callable[[str], None]) -> dict[str, Any]:
    """Play, say the table, write the files, and return what ``json=FILE`` gets."""
    for name, path in (("json", config.json), ("trace", config.trace)):
        if path and not Path(path).parent.is_dir():
            raise MissingFile("folder", Path(path).parent, "make it first")
        if path and Path(path).is_dir():
            raise InvalidSetting(name, path, "a file, not a folder")
    with _recording(config) as recorder:
        done = assess(config, traced=bool(config.trace), progress=config.progress, recorder=recorder)
    say(table(done.report, done.result))
    if recorder is not None:
        say(f"\n{recorder.told()}")
    if config.json:
        if config.ladder:  # what an entry of the ladder has to say besides
            done.report.update(commit=commit(), machine=machine())
        write_whole(Path(config.json), json.dumps(done.report, indent=2) + "\n")
    if config.trace:
        write_whole(Path(config.trace), done.trace_text())
    return done.report


def _recording(config: EvaluateCommand) -> AbstractContextManager[Recorder | None]:
    """What records the episodes, if that is asked for."""
    if not config.record:
        return nullcontext()
    if config.backend != "twin":
        raise InvalidSetting("record", config.record, "left out, or backend=twin, whose camera shows the arms")
    from marl_handover.control.recording import recording

    return recording(config.record, config.record_fps)


def table(report: dict[str, Any], result: Evaluation) -> str:
    """The result beside the optimum, for people."""
    low, high = report["success_ci95"]
    outcomes = "  ".join(f"{name} {count}" for name, count in report["outcomes"].items())
    lines = [
        f"{report['policy']}: architecture {report['architecture']}, backend {report['backend']}, "
        f"epsilon {report['epsilon_deg']:g} deg, {counted(report['episodes'], 'episode')}, seed {report['seed']}",
        "",
        f"{'':22}{'policy':>12}{'optimum':>12}",
        f"{'success':22}{100 * report['success_rate']:>11.2f}%{100 * (result.optimal > 0).mean():>11.2f}%",
        f"{'  95 % interval':22}{100 * low:>11.2f}%{100 * high:>11.2f}%",
        f"{'mean steps':22}{report['mean_steps']:>12.3f}{_number(report['optimal_mean_steps'], 3)}",
        f"{'mean steps, success':22}{_number(report['mean_steps_success'], 3)}",
        f"{'steps / optimum':22}{_number(report['steps_ratio'], 4)}",
        "",
        f"{'optimal steps':22}{'episodes':>12}{'success':>12}{'mean steps':>12}",
    ]
    solved = result.episodes.outcome == int(Outcome.SUCCESS)
    for steps in np.unique(result.optimal[result.optimal > 0]):
        rows = result.optimal == steps
        lines.append(f"{steps:<22}{rows.sum():>12}{100 * solved[rows].mean():>11.2f}%{result.episodes.transfers[rows].mean():>12.3f}")
    lines += _ladder_lines(report) if "ladder" in report else []
    lines += _lines_by_arms(report) if "by_arms" in report else []
    lines += ["", outcomes, f"one decision: p50 {report['decision_us']['p50']:.0f} us, p99 {report['decision_us']['p99']:.0f} us"]
    lines += _outage_lines(report["outage"]) if "outage" in report else []
    return "\n".join(lines + (_loop_lines(report) if "success_in_the_end" in report else []))


def _ladder_lines(report: dict[str, Any]) -> list[str]:
    """What only a rung of the ladder has."""
    low, high = report["regret_ci95"]
    about = report["ladder"]
    return [
        "",
        f"ladder {about['rung']}, {about['id']}: regret of a problem {report['regret']:.4f} [{low:.4f}, {high:.4f}], "
        f"of a failed one {about['max_steps']} less its optimum",
    ]


def _lines_by_arms(report: dict[str, Any]) -> list[str]:
    """What only random cells have."""
    lines = ["", f"{'arms':22}{'episodes':>12}{'success':>12}{'steps/opt.':>12}{'p50 us':>12}"]
    for arms, part in report["by_arms"].items():
        success, ratio = f"{100 * part['success_rate']:>11.2f}%", _number(part["steps_ratio"], 4)
        lines.append(f"{arms:22}{part['episodes']:>12}{success}{ratio}{part['decision_us']['p50']:>12.0f}")
    drawn = counted(report["layouts"], "random cell")
    return [*lines, "", f"{drawn}; problems that no plan solves, left out: {report['unsolvable']}"]


def _outage_lines(outage: dict[str, Any]) -> list[str]:
    """What became of episodes in which an arm went out of order."""
    share = "" if outage["solved_share"] is None else f" ({100 * outage['solved_share']:.2f} %)"
    return [
        "",
        f"an arm went out of order in {counted(outage['episodes'], 'episode')}: {outage['solvable']} stayed solvable, "
        f"{outage['solved']} of these were solved{share}; the goals of the other {outage['unreachable']} cannot be reached any more",
    ]


def _loop_lines(report: dict[str, Any]) -> list[str]:
    """What only the closed loop has."""

    def pair(key: str, unit: str) -> str:
        (low, p), (high, q) = list(report[key].items())[:2]
        return f"{low} {_number(p, 2).strip()} {unit}, {high} {_number(q, 2).strip()} {unit}"

    refused = "  ".join(f"{name} {count}" for name, count in report["refusals"].items()) or "none"
    return [
        "",
        f"success in the end: {100 * report['success_in_the_end']:.2f} %, after {counted(report['transfers'], 'transfer')} in all",
        f"at the goal:  {pair('position_error_mm', 'mm')}; {pair('orientation_error_deg', 'deg')}",
        f"one transfer: {pair('transfer_error_mm', 'mm')}; {pair('transfer_error_deg', 'deg')}",
        f"refused or failed: {refused}",
        f"one motion: planned in {pair('planning_ms', 'ms')}; an episode: {pair('episode_s', 's')}",
    ]


def _number(value: float | None, digits: int) -> str:
    return f"{'none' if value is None else f'{value:.{digits}f}':>12}"

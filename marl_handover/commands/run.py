"""``marl-handover run``: the closed loop on hardware or on its twin."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from marl_handover import policies
from marl_handover.arrays import Floats
from marl_handover.config import (
    CELL_ALIASES,
    POSE,
    CellConfig,
    LoopConfig,
    MotionConfig,
    TaskChanges,
    bounded,
    check_bounds,
    path_field,
    seed_field,
)
from marl_handover.control.settings import WorkcellConfig
from marl_handover.errors import InvalidSetting, MissingFile, counted

if TYPE_CHECKING:
    from marl_handover.control.closed_loop import ClosedLoop
    from marl_handover.control.session import Session
    from marl_handover.control.transfers import Episode
    from marl_handover.task.rules import Rules


@dataclass
class RunCommand(WorkcellConfig):
    """Settings of ``run``."""

    policy: str = path_field("pretrained_twin")  # exact, random, greedy, pretrained_a or _b or _twin, a run directory or a policy file
    episodes: int = bounded(1, 1, 10**6)  # before each but the first of a real cell somebody lays the block anew and presses Enter
    seed: int = seed_field()  # of the twin's problems
    start: list[float] | None = bounded(None, *POSE)  # of the twin's block: x [mm], y [mm], orientation [deg]; null: random
    goal: list[float] | None = bounded(None, *POSE)  # the same; null: of the twin random, of a real cell the printed marker
    printed: bool = False  # of the twin: the goal is a printed marker that the camera has to see
    dry_run: bool = False  # everything but the last write: nothing moves
    log: str = path_field()  # file for every event, JSON Lines
    record: str = path_field()  # folder that is made for a LeRobotDataset of the episodes: joints, hands, camera, task, success
    record_fps: int = bounded(10, 1, 50)  # its frames a second
    publish: str = path_field()  # folder in which the session shows itself to marl-handover view live=FOLDER; empty: it does not
    view_control: bool = False  # whether that folder's pages may pause the session and give it goals; they may always stop it
    paused: bool = False  # with view_control: nothing moves before somebody presses start
    real_time: bool = False  # of the twin: no faster than the arms would be
    cell: CellConfig | None = None  # single keys change the paper cell
    task: TaskChanges = field(default_factory=TaskChanges)
    motion: MotionConfig = field(default_factory=MotionConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    progress: bool = True  # of what takes long, on stderr


SCHEMA: type = RunCommand
ALIASES = CELL_ALIASES | {key: f"task.{key}" for key in ("epsilon_deg", "architecture", "max_steps")}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: RunCommand) -> int:
    """Play and print. 0 if every episode ended at its goal, else 1."""
    from marl_handover.control.calibration import confirmed, laid_anew
    from marl_handover.control.closed_loop import make_loop
    from marl_handover.control.recording import recording
    from marl_handover.control.session import Session
    from marl_handover.control.telemetry import Publisher
    from marl_handover.hardware.clock import follow_real_time

    _check(config)
    policy = policies.adapted(config.policy, config.cell, config.seed, motion=config.motion, **vars(config.task))
    options: dict[str, Any] = {"config": config, "confirm": confirmed, "dry_run": config.dry_run, "log_path": config.log}
    about = {"policy": config.policy, "hardware": config.hardware.name, "seed": config.seed, "dry_run": config.dry_run}
    with (
        Publisher(config.publish, view_control=config.view_control, paused=config.paused, log_path=config.log) as publisher,
        recording(config.record, config.record_fps) as recorder,
        make_loop(policy, "hardware", config.motion, config.loop, **options) as loop,
    ):
        publisher.attach(loop)
        if recorder is not None:
            recorder.attach(loop)
        session = Session(loop, about, publisher.command_queue)
        if config.real_time:
            follow_real_time(session.backend.clock)
        solved = 0
        for number, (start, goal) in enumerate(_problems(config, loop.rules)):
            if number and not config.emulated:
                laid_anew()
            begun = time.perf_counter()
            episode = _play(config, session, loop, start, goal, config.seed + number)
            solved += episode.solved
            _tell(number, episode, time.perf_counter() - begun, loop.rules.cell.labels)
        faults = {str(event): count for event, count in sorted(session.log.counts.items()) if event in _faults()}
    where = "would be at the goal (dry run: nothing moved)" if config.dry_run else "at the goal"
    print(f"{solved} of {config.episodes} {where}; what went wrong: {', '.join(f'{n} {c}' for n, c in faults.items()) or 'nothing'}")
    if recorder is not None:
        print(recorder.told())
    return 0 if solved == config.episodes else 1


def _check(config: RunCommand) -> None:
    check_bounds(config)
    if config.start is not None and not config.emulated:
        raise InvalidSetting("start", config.start, "left out with a real cell: its block lies where it lies")
    if config.printed and not config.emulated:
        raise InvalidSetting("printed", config.printed, "left out with a real cell: without goal=[x,y,deg] its goal is the printed one")
    if config.real_time and not config.emulated:
        raise InvalidSetting("real_time", config.real_time, "left out with a real cell: it knows no other time")
    if config.record and config.dry_run:
        raise InvalidSetting("record", config.record, "left out with dry_run=true, in which no arm moves")
    if config.log and not Path(config.log).parent.is_dir():
        raise MissingFile("folder", Path(config.log).parent, "make it first")


def _problems(config: RunCommand, rules: Rules) -> Iterator[tuple[Floats, Floats | None]]:
    """Starts and goals (3,); None: the goal is printed."""
    from marl_handover.learning.evaluation import random_problems

    drawn = random_problems(rules, config.episodes, config.seed)
    for start, goal in zip(*drawn, strict=True):
        given = [_pose(name, value, rules) for name, value in (("start", config.start), ("goal", config.goal))]
        goal_now = goal if given[1] is None else given[1]
        yield start if given[0] is None else given[0], goal_now if config.emulated or given[1] is not None else None


def _pose(name: str, value: list[float] | None, rules: Rules) -> Floats | None:
    if value is None:
        return None
    pose = np.array([value[0], value[1], np.radians(value[2])])
    rules.cell.require_reached(name, pose)
    return pose


def _play(config: RunCommand, session: Session, loop: ClosedLoop, start: Floats, goal: Floats | None, seed: int) -> Episode:
    from marl_handover.control.session import GivenGoal

    twin = session.backend.workcell.twin
    if goal is not None and not (config.printed and twin is not None):
        return session.play(start, GivenGoal(goal), seed)
    if twin is not None:
        twin.goal = goal
        session.printed.forget()
    return session.play(start, session.printed, seed)


def _tell(number: int, episode: Episode, wall_s: float, labels: Sequence[str]) -> None:
    from marl_handover.control.session import transfer_line

    print(f"episode {number}: {episode.ended} after {counted(len(episode.transfers), 'transfer')}, {wall_s:.1f} s", flush=True)
    for transfer in episode.transfers:
        print(transfer_line(transfer, labels))


def _faults() -> frozenset[Any]:
    from marl_handover.control.events import FAULTS

    return FAULTS

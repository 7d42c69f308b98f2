"""What one process of bench/twin.py does: calibrate a robot, play its episodes and drills or the soak, and write each down when it is over.

A robot is a twin with servos, camera, glue and paper of its own. Every finished episode is a line of ``robot_NN/<part>.jsonl``; what is
there is not played again.
"""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fault_injection import FaultInjector, InjectedFault
from twin_limits import LimitWatch

from marl_handover import policies
from marl_handover.arrays import wrap
from marl_handover.bounds import MAX_SEED
from marl_handover.cell import build_cell, cell_config
from marl_handover.cli import main as command_line
from marl_handover.compose import from_yaml
from marl_handover.control.closed_loop import ClosedLoop, make_loop
from marl_handover.control.evaluation import true_outcome, truly_solved
from marl_handover.control.events import FAULTS, Event
from marl_handover.control.session import GivenGoal, Session
from marl_handover.control.settings import WorkcellConfig, twin_workcell
from marl_handover.control.transfers import Episode
from marl_handover.control.twin import camera_over
from marl_handover.control.workcell import is_calibrated
from marl_handover.errors import WorkFailed
from marl_handover.files import resource_path
from marl_handover.hardware.settings import HardwareConfig
from marl_handover.learning.evaluation import random_problems
from marl_handover.perception.settings import USUAL_EYE_MM, CameraConfig
from marl_handover.task.rules import Outcome, Rules

HANG_WALL_S, HANG_VIRTUAL_S = 900.0, 600.0
NOISES = (
    *(f"hardware.emulator.{name}" for name in ("dead_band_us", "dead_band_sd_us", "settle_sd_us", "scale_sd", "offset_sd_us")),
    *(f"hardware.emulator.{name}" for name in ("bus_zero_deg", "bus_stiffness_share")),
    *(f"twin.{name}" for name in ("card_sd_mm", "card_sd_deg", "board_sd_mm", "board_sd_deg")),
    *("look.noise", "look.blur_px"),
)
SOAK_EVERY = 20
_MOVE = re.compile(rb"#\d+P\d|\xff\xff\xfe.\x83\x2a", re.DOTALL)


class Work(NamedTuple):
    """``numbers`` of ``count`` of a part, ``episode`` or ``drill``, that a robot plays; or ``count`` transfers of the ``soak``.

    A ``calibration`` is all that has to be there before.
    """

    part: str
    robot: int
    numbers: tuple[int, ...]
    count: int


def usual(values: dict[str, Any]) -> WorkcellConfig:
    """The twin of the bench's hardware as it is shipped, its camera over the middle of the bench's cell."""
    config = WorkcellConfig(from_yaml(HardwareConfig, resource_path(f"configs/hardware/{values['hardware']}.yaml")))
    config.mount = replace(config.mount, tilt_deg=[0.0, 0.0], turn_deg=0.0)
    hung, (config.camera.width_px, config.camera.height_px) = camera_over(build_cell(cell_config(values["cell"])), config)
    x, y, z = (0.0, 0.0, 700.0) if hung.eye_mm is None else np.subtract(hung.eye_mm, USUAL_EYE_MM) + (0.0, 0.0, 700.0)
    config.mount = replace(hung, eye_mm=[float(x), float(y), float(z)])
    return config


def robot_changes(seed: int, robot: int, noise: float, config: WorkcellConfig | None = None) -> dict[str, Any]:
    """Settings of a robot: all its seeds, its camera as somebody hung it, its errors multiplied by ``noise``.

    ``config`` is the twin of which they are, as :func:`usual` gives it; None: of the shipped pair.
    """
    random = np.random.default_rng([seed, robot])
    drawn, config = int(random.integers(2**31)) % (MAX_SEED + 1), config or usual({"cell": "paper", "hardware": "twin"})
    changes = {"hardware.emulator.seed": drawn, "twin.seed": drawn}
    changes["mount.eye_mm"] = (np.array(config.mount.eye_mm) + random.uniform(-4, 4, 3)).round(2).tolist()
    changes["mount.tilt_deg"] = random.uniform(-0.35, 0.35, 2).round(3).tolist()
    changes["mount.turn_deg"] = round(config.mount.turn_deg + float(random.uniform(-1, 1)), 3)
    finer = config.camera.width_px / CameraConfig.width_px
    changes["mount.focal_px"] = round(float(random.uniform(912, 922)) * finer, 2)
    if finer != 1.0:
        changes |= {"camera.width_px": config.camera.width_px, "camera.height_px": config.camera.height_px}
    return changes | {name: round(noise * read(config, name), 6) for name in NOISES}


def read(config: Any, name: str) -> float:
    """A setting by its dotted name."""
    for part in name.split("."):
        config = getattr(config, part)
    return float(config)


def changed(changes: dict[str, Any], config: WorkcellConfig | None = None) -> WorkcellConfig:
    """The twin ``config``, None: as it is shipped, but for ``changes`` by their dotted names."""
    config = config or twin_workcell()
    for name, value in changes.items():
        *path, last = name.split(".")
        part: Any = config
        for step in path:
            part = getattr(part, step)
        setattr(part, last, value)
    return config


def calibrated(folder: Path, values: dict[str, Any], robot: int) -> WorkcellConfig:
    """The robot's settings, once `calibrate` has been run on it; its files are kept."""
    shipped = usual(values)
    changes, kept = robot_changes(int(values["seed"]), robot, float(values["noise"]), shipped), folder / "calibration"
    changes["hardware.stop_file"], changes["twin.engine"] = str(folder / "stop"), values["engine"]
    config = changed(changes, shipped)
    config.calibration = str(kept)
    cell, hardware = values["cell"], values["hardware"]
    if not is_calibrated(kept, tuple(config.hardware.for_arms().arms)):
        folder.mkdir(parents=True, exist_ok=True)
        words = [f"{name}={value}" for name, value in changes.items()]
        if command_line(["calibrate", f"cell={cell}", f"hardware={hardware}", f"calibration={kept}", f"seed={robot}", *words]) != 0:
            raise WorkFailed(f"calibration of robot {robot} failed")
    return config


class Stage:
    """An open twin with a policy at work, and all that measures it."""

    def __init__(self, config: WorkcellConfig, policy: str, seed: int, cell: str = "paper") -> None:
        own = None if cell == "paper" else cell_config(cell)
        self.loop: ClosedLoop = make_loop(policies.adapted(policy, own), "hardware", config=config)
        self.session = Session(self.loop, {"policy": policy})
        workcell = self.session.backend.workcell
        assert workcell.twin is not None
        self.twin = workcell.twin
        self.limits = LimitWatch(self.twin, workcell.driver)
        self.mishaps = FaultInjector(self.twin, self.loop.rules, seed)
        self.latencies_ms: list[float] = []
        self._asked_s, self._drawing_s = -1.0, 0.0
        self.session.log.show(self._note)
        self._listen()

    def close(self) -> None:
        """Let it go."""
        self.loop.backend.close()

    def play(self, start: Any, goal: GivenGoal, seed: int) -> tuple[Episode, dict[str, Any]]:
        """An episode, and its line."""
        before, begun_s = self.session.log.counts.copy(), self.twin.clock.now_s()
        begun, used = time.perf_counter(), time.process_time()
        self.latencies_ms = []
        with time_limit(HANG_WALL_S):
            episode = self.session.play(start, goal, seed)
        virtual_s = self.twin.clock.now_s() - begun_s
        self.mishaps.finish()
        faults = {str(event): number for event, number in (self.session.log.counts - before).items() if event in FAULTS}
        row = {"end": truly_solved(episode, self.loop.rules), "ended": episode.ended, "transfers": len(episode.transfers)}
        row |= {"hang": virtual_s > HANG_VIRTUAL_S, "virtual_s": round(virtual_s, 2)}
        row |= {"wall_s": round(time.perf_counter() - begun, 2), "cpu_s": round(time.process_time() - used, 2)}
        return episode, row | {"events": faults, "limits": self.limits.taken(), "latency_ms": self.latencies_ms}

    def _note(self, row: dict[str, Any]) -> None:
        self.mishaps.note(row)
        if row["event"] == Event.GOAL_CHANGED:
            self._asked_s, self._drawing_s = time.process_time(), 0.0

    def _listen(self) -> None:
        """Time from a changed goal to the next move on the wire, without what drawing pictures and physics take: those are the twin's."""
        picture, follow = self.twin.painter.picture, self.twin.follower.advance

        def apart(work: Any) -> Any:
            def timed(*arguments: Any) -> Any:
                begun = time.process_time()
                try:
                    return work(*arguments)
                finally:
                    self._drawing_s += time.process_time() - begun

            return timed

        self.twin.painter.picture, self.twin.follower.advance = apart(picture), apart(follow)  # type: ignore[method-assign]
        for device in self.twin.electronics.devices.values():
            device.write = self._heard(device.write)  # type: ignore[method-assign]

    def _heard(self, write: Any) -> Any:
        def heard(data: bytes, t_s: float) -> None:
            if self._asked_s >= 0 and _MOVE.search(data):
                self.latencies_ms.append(round(1e3 * (time.process_time() - self._asked_s - self._drawing_s), 2))
                self._asked_s = -1.0
            write(data, t_s)

        return heard


@contextmanager
def time_limit(wall_s: float) -> Iterator[None]:
    """Raise :class:`TimeoutError` in what takes longer."""

    def late(*_: Any) -> None:
        raise TimeoutError(f"no end after {wall_s:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, wall_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def work(task: Work, values: dict[str, Any], root: str) -> None:
    """Do ``task``; an episode that ends in an exception is a failed one, and the next has a fresh twin."""
    folder = Path(root) / f"robot_{task.robot:02d}"
    if task.part == "calibration":
        calibrated(folder, values, task.robot)
        return
    if task.part == "soak":
        soak(calibrated(folder, values, task.robot), values, folder / "soak.jsonl", task.count)
        return
    stage: Stage | None = None
    for number in task.numbers:
        try:
            config = calibrated(folder, values, task.robot)
            stage = stage or Stage(config, values["policy"], int(values["seed"]) * 1000 + number, values["cell"])
            row = one(stage, task.part, number, task.count, int(values["seed"]))
        except Exception as failure:  # whatever it is, it is a failed episode
            row = {"end": False, "first": False, "hang": isinstance(failure, TimeoutError), "error": f"{type(failure).__name__}: {failure}"}
            if stage is not None:
                stage.close()
            stage = None
        append(folder / f"{task.part}.jsonl", {"number": number, "robot": task.robot} | row)
        progress(Path(root), task.part, task.count)
    if stage is not None:
        stage.close()


def one(stage: Stage, part: str, number: int, count: int, seed: int) -> dict[str, Any]:
    """The line of an episode or a drill."""
    starts, goals = random_problems(stage.loop.rules, count, seed)
    goal, mishap = GivenGoal(goals[number]), None
    if part == "drill":
        random, kinds = np.random.default_rng([seed, number]), stage.mishaps.kinds
        motion = int(random.random() < 0.4)
        mishap = stage.mishaps.arrange_in(kinds[(number + number // len(kinds)) % len(kinds)], motion, float(random.random()), goal)
    episode, row = stage.play(starts[number], goal, seed + number)
    row |= {"first": true_outcome(episode, stage.loop.rules) is Outcome.SUCCESS, **errors(episode, stage.loop.rules)}
    return row if mishap is None else row | about(mishap)


def about(mishap: InjectedFault) -> dict[str, Any]:
    """Of a mishap: its kind, whether it happened in the episode, and left its sign in the log."""
    return {"kind": mishap.kind, "happened": mishap.happened, "felt": mishap.felt, "noted": sorted(str(event) for event in mishap.noted)}


def errors(episode: Episode, rules: Rules) -> dict[str, Any]:
    """In mm and deg: of every transfer that was carried out, against exact arms; of the first final placement, against the goal."""
    carried = [transfer for transfer in episode.transfers if transfer.result.refusal is None]
    off = [away(transfer.result.true, transfer.command.predicted) for transfer in carried]
    last = episode.first[-1]
    final = None
    if last.command.final and last.result.refusal is None:
        turned = float(np.degrees(np.abs(rules.orientation_error(last.result.true[2], last.goal[2]))))
        final = (away(last.result.true, last.goal)[0], round(turned, 3))
    return {"transfer_off": off, "final_off": final}


def away(one: Any, other: Any) -> tuple[float, float]:
    """Of two poses (3,): mm and deg."""
    return round(float(np.hypot(*(one[:2] - other[:2]))), 3), round(abs(float(np.degrees(wrap(one[2] - other[2])))), 3)


def soak(config: WorkcellConfig, values: dict[str, Any], path: Path, transfers: int) -> None:
    """Episodes until so many transfers are done, a line for every :data:`SOAK_EVERY`; memory starts anew with each process."""
    done = rows(path)
    count, spent = sum(row["episodes"] for row in done), sum(row["transfers"] for row in done)
    stage = Stage(config, values["policy"], int(values["seed"]), values["cell"])
    starts, goals = random_problems(stage.loop.rules, transfers, int(values["seed"]))
    part = {"episodes": 0, "transfers": 0, "solved": 0, "first": 0, "violations": 0, "hangs": 0}
    try:
        while spent < transfers:
            episode, row = stage.play(starts[count], GivenGoal(goals[count]), count)
            found = {"episodes": 1, "transfers": row["transfers"], "solved": int(row["end"]), "hangs": int(row["hang"])}
            found["first"] = int(true_outcome(episode, stage.loop.rules) is Outcome.SUCCESS)
            found["violations"] = sum(row["limits"]["violations"].values())
            part = {key: value + found[key] for key, value in part.items()}
            count, spent = count + 1, spent + row["transfers"]
            if count % SOAK_EVERY == 0 or spent >= transfers:
                files = len(os.listdir("/proc/self/fd"))
                append(path, part | {"rss_mb": rss_mb(), "files": files, "process": os.getpid(), "virtual_s": stage.twin.clock.now_s()})
                part = dict.fromkeys(part, 0)
                print(f"soak: {spent} of {transfers} transfers, {rss_mb()} MB, {files} files", flush=True)
    finally:
        stage.close()


def rss_mb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


def rows(path: Path) -> list[dict[str, Any]]:
    """The lines of a file; a last one that was cut off is left out."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return found


def append(path: Path, row: dict[str, Any]) -> None:
    """One line more."""
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


def progress(root: Path, part: str, count: int) -> None:
    """A line for every ten episodes of all robots."""
    found = [row for path in sorted(root.glob(f"robot_*/{part}.jsonl")) for row in rows(path)]
    if len(found) % 10 == 0 or len(found) == count:
        good = sum(row["end"] for row in found)
        print(f"{part} {len(found)} of {count}: {good} reached the goal, {sum(row['hang'] for row in found)} hangs", flush=True)

"""``marl-handover view``: the cell in a browser, to play with, to look through a trace, to watch a session."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from marl_handover.config import (
    CELL_ALIASES,
    CellConfig,
    MotionConfig,
    TaskChanges,
    TaskConfig,
    bounded,
    check_bounds,
    chosen,
    path_field,
    require_between,
    require_choice,
    seed_field,
)
from marl_handover.errors import InvalidSetting, MissingFile

if TYPE_CHECKING:
    from marl_handover.policies import SupervisorPolicy

MODES = ("play", "trace", "live")
ANYWHERE = ("exact", "pretrained_any", "greedy", "random")
"""Policies of any cell."""

SHIPPED = ("exact", "pretrained_b", "pretrained_a", "pretrained_any")
LIVE_HZ = 30.0
UNUSED: dict[str, tuple[str, ...]] = {"play": (), "trace": ("policy", "seed"), "live": ("policy", "seed", "speed", "task", "motion")}
"""Keys that mean nothing in a mode."""

Server = Any
"""viser's, which only :mod:`marl_handover.viewer` imports."""


class Page(NamedTuple):
    """What keeps a page up to date: ``update``, with the wall time in s since the call before, so often, and at once on ``hurry``."""

    update: Callable[[float], None]
    rate_hz: float
    hurry: threading.Event | None = None


@dataclass
class ViewCommand:
    """Settings of ``view``. The page is served to this machine only; from elsewhere: ssh -L 8080:localhost:8080 HOST."""

    mode: str | None = chosen(None, MODES)  # play, trace or live; null: trace with trace=FILE, live with live=FOLDER, else play
    trace: str = path_field()  # what evaluate wrote with trace=FILE, or run with log=FILE
    live: str = path_field()  # the folder of a session that runs with publish=FOLDER
    port: int = bounded(8080, 0, 65535)  # 0: any that is free
    policy: str = path_field("exact")  # of play: exact, random, greedy, pretrained_a or _b or _twin, a run directory or a policy file
    seed: int = seed_field()  # of the problems to play
    speed: float = bounded(1.0, 0.25, 20.0)  # simulated seconds in one second
    cell: CellConfig | None = None  # single keys change the paper cell, or the one that the session's log names
    task: TaskChanges = field(default_factory=TaskChanges)
    motion: MotionConfig = field(default_factory=MotionConfig)
    progress: bool = True  # of what takes long, on stderr


SCHEMA: type = ViewCommand
ALIASES = CELL_ALIASES | {key: f"task.{key}" for key in ("epsilon_deg", "architecture", "max_steps")}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: ViewCommand) -> int:
    """Serve the page until Ctrl-C, which is a good end."""
    ended = threading.Event()
    with _ended_by_ctrl_c(ended):
        serve(config, ended)
    print("closed")
    return 0


@contextlib.contextmanager
def _ended_by_ctrl_c(ended: threading.Event) -> Iterator[None]:
    """The first Ctrl-C sets ``ended``, and a second one interrupts as ever: compiled code that is interrupted breaks."""

    def end(number: int, _: object) -> None:
        ended.set()
        signal.signal(number, usual)

    usual = signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)


def serve(config: ViewCommand, ended: threading.Event, ready: Callable[[str], None] | None = None) -> None:
    """Serve the page until ``ended`` is set; ``ready`` is told the address.

    Raises:
        MissingExtra: viser is not installed.
        PortTaken, and whatever is wrong with the settings or the files.
    """
    mode = mode_of(config)
    _check(config, mode)
    from marl_handover.viewer.server import address, keep_updating, open_server

    with open_server(config.port, "arms that hand over a block") as server, _PAGES[mode](config, server) as page:
        print(f"open {address(server)} in a browser on this machine; Ctrl-C ends", flush=True)
        if ready is not None:
            ready(address(server))
        keep_updating(page.update, page.rate_hz, ended, page.hurry)


def mode_of(config: ViewCommand) -> str:
    """The mode that is asked for or follows from the other keys. Raises :class:`InvalidSetting` if they do not fit each other."""
    given = [name for name in ("trace", "live") if getattr(config, name)]
    if len(given) > 1:
        raise InvalidSetting("live", config.live, "left out with trace=FILE: a page shows one of them")
    mode = config.mode or (given[0] if given else "play")
    require_choice("mode", mode, MODES)
    if given and mode != given[0]:
        raise InvalidSetting("mode", mode, f"{given[0]}, or left out, with {given[0]}=...")
    if mode != "play" and not given:
        raise InvalidSetting(mode, "", "a file: mode=trace trace=FILE" if mode == "trace" else "a folder: mode=live live=FOLDER")
    return mode


def _check(config: ViewCommand, mode: str) -> None:
    changed = _changed("", {key: getattr(config, key) for key in UNUSED[mode]}, vars(ViewCommand()))
    for name, value in changed:
        raise InvalidSetting(name, value, f"left out with {mode}=..., which makes no use of it")
    check_bounds(config)
    config.motion.validate()


def _changed(group: str, values: Mapping[str, Any], usual: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Name and value of each key that is not as usual."""
    for key, value in values.items():
        if is_dataclass(value):
            section = usual[key] if is_dataclass(usual[key]) else type(value)()  # type: ignore[misc]  # a section that is usually left out
            yield from _changed(f"{group}{key}.", vars(value), vars(section))
        elif value != usual[key]:
            yield f"{group}{key}", value


@contextlib.contextmanager
def _play(config: ViewCommand, server: Server) -> Iterator[Page]:
    from marl_handover import policies
    from marl_handover.cell import build_whole_cell
    from marl_handover.control.interactive.cell import InteractiveCell
    from marl_handover.viewer.play import RATE_HZ, SPEEDS, PlayPage

    require_between("speed", config.speed, *SPEEDS)

    def load(name: str) -> SupervisorPolicy:
        return policies.adapted(name, config.cell, config.seed, motion=config.motion, **vars(config.task))

    policy = load(config.policy)
    model = build_whole_cell(policy.rules.cell.config)
    cell = InteractiveCell(policy, model, config.motion, config.seed)
    shipped = SHIPPED if model.cell.num_arms == 2 else ANYWHERE
    names = tuple(dict.fromkeys((config.policy, *shipped)))
    page = PlayPage(server, cell, policy, load, names, config.speed)
    yield Page(page.update, RATE_HZ, page.dragged)


@contextlib.contextmanager
def _trace(config: ViewCommand, server: Server) -> Iterator[Page]:
    from marl_handover.cell import build_whole_cell
    from marl_handover.viewer.play import RATE_HZ
    from marl_handover.viewer.trace import SPEEDS, TracePage
    from marl_handover.viewer.trace_file import read_trace, recorded_cell

    require_between("speed", config.speed, *SPEEDS)
    model = build_whole_cell(_cell(config, recorded_cell(Path(config.trace))))
    trace = read_trace(Path(config.trace), model.cell.labels)
    changes: dict[str, Any] = {key: value for key, value in vars(config.task).items() if value is not None}
    changes["symmetry_order"] = trace.symmetry(config.task.symmetry_order)
    page = TracePage(server, model, trace, replace(TaskConfig(), **changes), config.motion, config.speed)
    with contextlib.closing(page):
        yield Page(page.update, RATE_HZ)


def _cell(config: ViewCommand, recorded: dict[str, Any] | None) -> CellConfig:
    """The cell that is asked for, else that of the log, else the paper's."""
    from marl_handover.compose import from_text

    if config.cell is not None or recorded is None:
        return config.cell or CellConfig()
    settings: CellConfig = from_text(CellConfig, json.dumps(recorded), Path(config.trace))
    return settings


@contextlib.contextmanager
def _live(config: ViewCommand, server: Server) -> Iterator[Page]:
    from marl_handover.cell import build_cell
    from marl_handover.control.telemetry import TelemetryReader
    from marl_handover.viewer.live import LivePage
    from marl_handover.viewer.scene import CellScene

    folder = Path(config.live)
    if not folder.is_dir():
        raise MissingFile("folder", folder, "give the one that the session runs with as publish=FOLDER")
    scene = CellScene(server, build_cell(config.cell or CellConfig()))  # until the session says which cell it has
    page = LivePage(server, scene, TelemetryReader(folder))
    yield Page(page.update, LIVE_HZ)


_PAGES = {"play": _play, "trace": _trace, "live": _live}

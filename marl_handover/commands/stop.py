"""``marl-handover stop``: the latched stop of every session of this user."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from marl_handover.commands.stop_now import REASON, Ordered, order
from marl_handover.config import bounded, check_bounds
from marl_handover.errors import InvalidSetting, WorkFailed
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRecord, SessionRegistry, suspended
from marl_handover.hardware.settings import TWIN, HardwareConfig

_POLL_S = 0.01
POWER = "if arms move, CUT THE POWER"


class NotStopped(WorkFailed):
    """A stop that did not reach everybody."""

    def __init__(self, troubles: Sequence[str]) -> None:
        super().__init__(f"{'; '.join(troubles)}: {POWER}")


@dataclass
class StopCommand:
    """Keys of ``stop``."""

    reason: str = REASON  # is shown by whoever is stopped
    clear: bool = False  # allow motion again; nothing moves by itself
    wait_s: float = bounded(1.0, 0.0, 3600.0)  # for every session to say that it has stopped
    hardware: HardwareConfig = field(default_factory=HardwareConfig)  # with a stop_file: stop only what looks at that one


SCHEMA: type = StopCommand
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: StopCommand, ordered: Ordered | None = None) -> int:
    """Latch the stop, unless it was ``ordered`` already, or clear it.

    0 if every session that runs has stopped, also if there is none: the stop holds for those to come.

    Raises:
        NotStopped: a session did not answer in time, another user's was not reached, or a stop file cannot be written.
        NotCleared: a stop file cannot be taken away.
    """
    check_bounds(config)
    given = config.hardware.stop_file
    path = Path(config.hardware.stop_path())
    if given and not path.is_absolute():
        raise InvalidSetting("hardware.stop_file", given, "an absolute path")
    if config.clear:
        return _clear([path] if given else [path, Path(HardwareConfig(name=TWIN).stop_path())], only=bool(given))
    done = ordered or order(path, config.reason, only=bool(given))
    troubles = [*done.troubles, *_wait(done.waiting, config.wait_s), *(_beyond(session) for session in done.beyond)]
    if troubles:
        raise NotStopped(troubles)
    if not done.waiting:
        print(f"no session runs; {POWER}")
    print("allow motion again: marl-handover stop clear=true")
    return 0


def _clear(paths: Sequence[Path], only: bool) -> int:
    running = [] if only else [session.stop_file for session in SessionRegistry().registered() if session.stop_file]
    for each in dict.fromkeys([*paths, *running]):
        StopLatch(each).clear()
        print(f"cleared {each}; arms may move again")
    return 0


def _wait(running: Sequence[SessionRecord], wait_s: float) -> list[str]:
    """Wait until all have obeyed or signed off; what is wrong with those that have not."""
    registry, waiting = SessionRegistry(), {session.entry: session for session in running}
    end_s = time.monotonic() + wait_s
    while True:
        now = {session.entry: session.obeyed for session in [*registry.registered(), *registry.others()]} if waiting else {}
        for entry in [entry for entry in waiting if now.get(entry, True)]:
            what = "has stopped its arms" if entry in now else "is over"
            print(f"{_called(waiting.pop(entry))} {what}", flush=True)
        if not waiting:
            return []
        if time.monotonic() >= end_s:
            return [f"{_called(session)} did not answer within {wait_s:g} s{_held(session.pid)}" for session in waiting.values()]
        time.sleep(_POLL_S)


def _called(session: SessionRecord) -> str:
    return f"process {session.pid}" + (f" of {session.owner}" if session.owner else "")


def _held(pid: int) -> str:
    """Why a process does not answer, if that shows."""
    return " (it is suspended: it stops its arms once it goes on)" if suspended(pid) else ""


def _beyond(session: SessionRecord) -> str:
    """Words on a session that this user's stop does not reach."""
    who = session.owner
    how = f"only {who} can stop it here: sudo -u {who} marl-handover stop" if " " not in who else f"only {who} can stop it here"
    if session.stop_file is None:
        return f"{who} may be running a session (process {session.pid}; {session.entry} cannot be read), and {how}"
    return f"process {session.pid} of {who} runs a session, and {how}"

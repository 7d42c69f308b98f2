"""``marl-handover stop``: the latched stop of every session of this user."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from marl_handover.config import bounded, check_bounds
from marl_handover.errors import InvalidSetting, WorkFailed
from marl_handover.hardware.settings import HardwareConfig

if TYPE_CHECKING:
    from marl_handover.hardware.latch import StopLatch
    from marl_handover.hardware.roll import Roll, Signed

_POLL_S = 0.01
POWER = "if arms move, CUT THE POWER"


class NotStopped(WorkFailed):
    """A stop that did not reach everybody."""

    def __init__(self, troubles: Sequence[str]) -> None:
        super().__init__(f"{'; '.join(troubles)}: {POWER}")


@dataclass
class StopCommand:
    """Keys of ``stop``."""

    reason: str = "marl-handover stop"  # is shown by whoever is stopped
    clear: bool = False  # allow motion again; nothing moves by itself
    wait_s: float = bounded(1.0, 0.0, 3600.0)  # for every session to say that it has stopped
    hardware: HardwareConfig = field(default_factory=HardwareConfig)  # with a stop_file: stop only what looks at that one


SCHEMA: type = StopCommand
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: StopCommand) -> int:
    """Latch the stop, or clear it. 0 if every session that runs has stopped, also if there is none: the stop holds for those to come.

    Raises:
        NotStopped: a session did not answer in time, or a stop file cannot be written.
    """
    from marl_handover.hardware.latch import StopLatch
    from marl_handover.hardware.roll import Roll

    check_bounds(config)
    given, roll = config.hardware.stop_file, Roll()
    path = Path(config.hardware.stop_path())
    if given and not path.is_absolute():
        raise InvalidSetting("hardware.stop_file", given, "an absolute path")
    running = roll.signed(path if given else None)
    paths = list(dict.fromkeys([path, *(session.stop_file for session in running)]))
    if config.clear:
        for each in paths:
            StopLatch(each).clear()
            print(f"cleared {each}; arms may move again")
        return 0
    troubles = [trouble for each in paths if (trouble := _latched(StopLatch(each), config.reason))]
    troubles += _wait(roll, running, config.wait_s)
    if troubles:
        raise NotStopped(troubles)
    if not running:
        print(f"no session runs; {POWER}")
    print("allow motion again: marl-handover stop clear=true")
    return 0


def _latched(latch: StopLatch, reason: str) -> str:
    """Latch; what went wrong, empty if nothing did."""
    try:
        latch.latch(reason)
    except OSError as error:
        return f"the stop file {latch.path} cannot be written ({error.strerror or error})"
    print(f"stop latched in {latch.path}", flush=True)
    return ""


def _wait(roll: Roll, running: Sequence[Signed], wait_s: float) -> list[str]:
    """Wait until all have obeyed or signed off; what is wrong with those that have not."""
    waiting = {session.entry: session.pid for session in running}
    end_s = time.monotonic() + wait_s
    while True:
        now = {session.entry: session.obeyed for session in roll.signed()}
        for entry in [entry for entry in waiting if now.get(entry, True)]:
            what = "has stopped its arms" if entry in now else "is over"
            print(f"process {waiting.pop(entry)} {what}", flush=True)
        if not waiting:
            return []
        if time.monotonic() >= end_s:
            return [f"process {pid} did not answer within {wait_s:g} s" for pid in waiting.values()]
        time.sleep(_POLL_S)

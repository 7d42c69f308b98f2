"""``marl-handover stop``: the latched stop of every session of this user."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from marl_handover.config import require_at_least
from marl_handover.hardware.settings import HardwareConfig

if TYPE_CHECKING:
    from marl_handover.hardware.latch import StopLatch

_POLL_S = 0.01


@dataclass
class StopCommand:
    """Keys of ``stop``."""

    reason: str = "marl-handover stop"  # is shown by whoever is stopped
    clear: bool = False  # allow motion again; nothing moves by itself
    wait_s: float = 1.0  # for a session to say that it has stopped
    hardware: HardwareConfig = field(default_factory=HardwareConfig)  # its stop_file


SCHEMA: type = StopCommand
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: StopCommand) -> int:
    """Latch the stop, or clear it; 0 either way: the stop holds for sessions to come as well."""
    from marl_handover.hardware.latch import StopLatch

    require_at_least("wait_s", config.wait_s, 0)
    latch = StopLatch(config.hardware.stop_path())
    if config.clear:
        latch.clear()
        print(f"cleared {latch.path}; arms may move again")
        return 0
    latch.latch(config.reason)
    pid = _obeyed(latch, config.wait_s)
    said = f"process {pid} has stopped its arms" if pid is not None else "no running session answered: if arms move, CUT THE POWER"
    print(f"stop latched in {latch.path}; {said}; allow motion again: marl-handover stop clear=true")
    return 0


def _obeyed(latch: StopLatch, wait_s: float) -> int | None:
    end_s = time.monotonic() + wait_s
    while True:
        pid = latch.obeyed_by()
        if pid is not None or time.monotonic() >= end_s:
            return pid
        time.sleep(_POLL_S)

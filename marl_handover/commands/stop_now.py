"""What ``marl-handover stop`` does first: latch. It imports nothing heavy: arms stop before the command line is read in full."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from marl_handover.hardware import session_registry
from marl_handover.hardware.estop import StopLatch
from marl_handover.hardware.session_registry import SessionRecord, SessionRegistry

REASON = "marl-handover stop"
_PLAIN = {
    "reason": r"(?!['\"]).{0,4000}",
    "hardware.stop_file": r"/.{0,4000}",
    "wait_s": r"\d{1,3}(\.\d{1,9})?",
    "clear": r"(?i:false)",
}
"""Keys and values that need no grammar to be understood. Anything else is read in full first, and then latches or is refused."""


class Ordered(NamedTuple):
    """A stop that was latched.

    ``waiting``: the sessions that look at one of its files; ``beyond``: those of other users that do not; ``troubles``: files that could
    not be written.
    """

    waiting: list[SessionRecord]
    beyond: list[SessionRecord]
    troubles: list[str]


def at_once(arguments: Sequence[str]) -> Ordered | None:
    """Latch, if the arguments of the command line plainly ask for that; None if they have to be read first."""
    given: dict[str, str] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals or key not in _PLAIN or not value.isprintable() or re.fullmatch(_PLAIN[key], value) is None:
            return None
        given[key] = value
    stop_file = given.get("hardware.stop_file", "")
    return order(Path(stop_file) if stop_file else session_registry.user_path(".stop"), given.get("reason", REASON), only=bool(stop_file))


def order(path: Path, reason: str, only: bool) -> Ordered:
    """Latch in ``path`` and, unless ``only`` that is asked for, in the stop file of every session of this user that runs."""
    registry = SessionRegistry()
    running = registry.registered(path if only else None)
    paths = list(dict.fromkeys([path, *(session.stop_file for session in running if session.stop_file)]))
    troubles = [trouble for each in paths if (trouble := _latched(StopLatch(each, registry), reason))]
    others = registry.others()
    reached = [session for session in others if session.stop_file in paths]
    return Ordered(running + reached, [] if only else [session for session in others if session not in reached], troubles)


def _latched(latch: StopLatch, reason: str) -> str:
    """Latch; what went wrong, empty if nothing did."""
    try:
        latch.latch(reason)
    except OSError as error:
        return f"the stop file {latch.path} cannot be written ({error.strerror or error})"
    print(f"stop latched in {latch.path}", flush=True)
    return ""

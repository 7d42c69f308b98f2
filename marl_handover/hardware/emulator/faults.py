"""What goes wrong, and when: ``unplug@5:1.5,brownout@9,late@12:3=0.2``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from marl_handover.config import require_choice
from marl_handover.errors import BadOverride

KINDS = {
    "unplug": "the USB cable is out",
    "brownout": "the supply breaks down: the board forgets everything (an instant; the duration is how long it is off)",
    "silent": "no supply for the controller: the port is there, nothing answers, nothing moves",
    "drop": "replies get lost, each with the given probability (1)",
    "corrupt": "reply bytes change, each with the given probability (0.5)",
    "late": "replies come the given time late (0.25 s)",
    "stuck": "Q says that a move goes on, for ever",
    "ignore": "moves are not carried out, each with the given probability (1)",
    "random": "QP answers pulses at random, each with the given probability (1)",
    "frozen": "QP answers what it did when the fault began",
    "jam": "the servo of the given channel (0) is held fast",
}
_USUAL = {"drop": 1.0, "corrupt": 0.5, "late": 0.25, "jam": 0.0, "ignore": 1.0, "random": 1.0}


@dataclass(frozen=True)
class Fault:
    """A fault of a kind from ``start_s`` on the device's clock, for ``duration_s``. What ``amount`` means depends on the kind."""

    kind: str
    start_s: float
    duration_s: float = math.inf
    amount: float = 0.0

    @property
    def end_s(self) -> float:
        """When it is over."""
        return self.start_s + self.duration_s

    def active(self, t_s: float) -> bool:
        """Whether it is in force."""
        return self.start_s <= t_s < self.end_s


def make_fault(kind: str, start_s: float, duration_s: float | None = None, amount: float | None = None) -> Fault:
    """A fault, with the kind's usual amount and duration where none is given. Raises :class:`UnknownChoice` for an unknown kind."""
    require_choice("fault", kind, tuple(KINDS))
    lasting = (0.0 if kind == "brownout" else math.inf) if duration_s is None else duration_s
    return Fault(kind, start_s, lasting, _USUAL.get(kind, 0.0) if amount is None else amount)


def parse_faults(text: str) -> list[Fault]:
    """Faults of a text ``kind@start[:duration][=amount]``, separated by commas; times in s.

    Raises :class:`UnknownChoice` for an unknown kind and :class:`BadOverride` for what cannot be read.
    """
    faults = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        head, _, amount = item.partition("=")
        kind, at, times = head.partition("@")
        start, _, duration = times.partition(":")
        try:
            numbers = [float(number) if number else None for number in (start if at else "0", duration, amount)]
        except ValueError:
            raise BadOverride(f"faults={item}", "expected kind@start[:duration][=amount], such as unplug@5:1.5") from None
        if any(number is not None and not (math.isfinite(number) and number >= 0) for number in numbers):
            raise BadOverride(f"faults={item}", "times and amounts are finite and not negative")
        faults.append(make_fault(kind, numbers[0] or 0.0, numbers[1], numbers[2]))
    return faults

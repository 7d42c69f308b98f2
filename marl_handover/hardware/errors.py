"""What can go wrong between a command and a servo. Messages say what to look at on the bench."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from marl_handover.errors import HandoverError, WorkFailed

try:
    from termios import error as FlushFailed
except ImportError:  # a system without terminals of that kind; its ports raise OSError

    class FlushFailed(Exception):  # type: ignore[no-redef]
        """Never raised there."""


class BadCommand(HandoverError):
    """A command that the board's language cannot carry, or that must not be sent."""

    def __init__(self, name: str, value: Any, limit: str) -> None:
        super().__init__(f"{name} = {value!r}: must be {limit}")
        self.name, self.value, self.limit = name, value, limit


class DuplicateChannel(BadCommand):
    """One line addresses a channel twice."""

    def __init__(self, channel: int) -> None:
        super().__init__("channel", channel, "addressed once in a line")
        self.channel = channel


class MixedCommands(BadCommand):
    """One line holds commands of different types, which the board does not take."""

    def __init__(self, kinds: Iterable[str]) -> None:
        super().__init__("the commands of a line", sorted(kinds), "of one type")


class LineTooLong(BadCommand):
    """A line is longer than what the board's buffer is trusted with."""

    def __init__(self, length: int, limit: int) -> None:
        super().__init__("the length of a line", length, f"at most {limit} bytes; send several lines")


class DeviceError(WorkFailed):
    """A port or a board does not do what it should."""


class PortNotFound(DeviceError):
    """No such port, or not exactly one to choose from."""

    def __init__(self, port: str, reason: str, found: Iterable[str]) -> None:
        self.port, self.found = port, tuple(found)
        listing = ", ".join(self.found) or "none"
        super().__init__(f"serial port {port or '(not set)'}: {reason}; ports found: {listing}; set hardware.boards.<name>.port")


class ConnectionLost(DeviceError):
    """What drives the arms is out of reach. They hold, or finish the move that they are in, until it is connected again."""


class ArmingLost(DeviceError):
    """Some servos hold no more, or will not: the arms have to be armed again."""


class PortLost(ConnectionLost):
    """The port failed while in use: a cable came out, or another program has it open as well."""

    def __init__(self, port: str, what: str, reason: str) -> None:
        self.port, self.reason = port, reason
        super().__init__(
            f"{port} was lost while {what}: {reason}; check the USB cable and that no other program has the port open. "
            "The arms hold, or finish the move they are in"
        )


class BoardSilent(DeviceError):
    """The port opens but nothing answers."""

    def __init__(self, port: str, bauds: Iterable[int]) -> None:
        self.port, self.bauds = port, tuple(bauds)
        tried = ", ".join(str(baud) for baud in self.bauds)
        super().__init__(
            f"{port} opens but no board answers at {tried} baud: is the controller's own supply on? (The USB chip is fed by the "
            "computer, the controller is not: its LED must light up.) Then check the baud rate and that this port is the board's"
        )


class UnsuitableFirmware(DeviceError):
    """A board answers, but not one whose commands are known."""

    def __init__(self, port: str, version: str, reason: str) -> None:
        self.port, self.version = port, version
        super().__init__(f"{port}: firmware {version!r} cannot be used: {reason}")


class BadReply(DeviceError):
    """A reply is missing, too short or cannot be what was asked for."""

    def __init__(self, asked: str, reply: bytes, wanted: str) -> None:
        self.asked, self.reply = asked, reply
        super().__init__(f"{asked} was answered by {reply[:32]!r}: expected {wanted}")


class ServoMissing(ConnectionLost):
    """Servos on a bus do not answer."""

    def __init__(self, bus: str, servos: Iterable[int], present: Iterable[int] | None = None) -> None:
        self.bus, self.servos = bus, tuple(servos)
        found = "" if present is None else f"; answering: {', '.join(map(str, present)) or 'none'}"
        super().__init__(
            f"bus {bus}: no answer from servo {', '.join(map(str, self.servos))}{found}; check the supply, the cable between the servo and "
            "the one before it, its id and its baud rate"
        )


class DuplicateServo(DeviceError):
    """Two servos on one bus have one id."""

    def __init__(self, asked: str, servo: int) -> None:
        self.servo = servo
        super().__init__(f"{asked}: servo {servo} answered twice: two servos on this bus have that id; give one of them another")


class ServoFault(ArmingLost):
    """A servo answers, and reports trouble."""

    def __init__(self, bus: str, servo: int, what: str) -> None:
        self.bus, self.servo, self.what = bus, servo, what
        super().__init__(f"bus {bus}: servo {servo} reports {what}; its arm has to be armed again, which ends an overload")


class BoardReset(ArmingLost):
    """The board has forgotten its servos: it was reset, most likely by a supply that broke down under load."""

    def __init__(self, board: str, channels: Iterable[int]) -> None:
        self.board, self.channels = board, tuple(channels)
        super().__init__(
            f"board {board} has no pulse on channels {', '.join(map(str, self.channels))}: it was reset, and its next move would be a jump "
            "at full speed. Most likely the supply broke down (give the logic its own 9 V, remove the VS=VL jumper). Put the arms into the "
            "parked pose and arm again"
        )


class TorqueLost(ArmingLost):
    """Bus servos hold no more: their supply broke down, or another program let them go."""

    def __init__(self, bus: str, servos: Iterable[int]) -> None:
        self.bus, self.servos = bus, tuple(servos)
        super().__init__(
            f"bus {bus}: servo {', '.join(map(str, self.servos))} does not hold, and its arm has sunk: most likely the supply broke down. "
            "Fold the arm by hand, and arm again"
        )


class PulseMismatch(DeviceError):
    """A board puts out another pulse than it was sent: it does not carry out its moves, or answers anything."""

    def __init__(self, board: str, channel: int, pulse_us: int, wanted_us: tuple[float, float], tolerance_us: float) -> None:
        self.board, self.channel, self.pulse_us, self.wanted_us = board, channel, pulse_us, wanted_us
        lower, upper = (f"{end:.0f}" for end in wanted_us)
        wanted = f"{lower} us" if lower == upper else f"{lower} to {upper} us"
        super().__init__(
            f"board {board}, channel {channel} puts out {pulse_us} us, where it was sent {wanted} (tolerance {tolerance_us:g} us): the "
            "board does not do what it is told, or does not say what it does. Every channel was told to stop; check the board, its supply "
            "and its cable, then arm again"
        )


class ServoAstray(PulseMismatch):
    """A bus servo does not stand where it was sent: something holds it, or it is too weak."""

    def __init__(self, bus: str, servo: int, counts: int, wanted: tuple[float, float], tolerance: float) -> None:
        self.board, self.channel, self.pulse_us, self.wanted_us = bus, servo, counts, wanted
        off_deg = 360 / 4096 * max(wanted[0] - counts, counts - wanted[1])
        DeviceError.__init__(
            self,
            f"bus {bus}: servo {servo} stands {off_deg:.0f} degrees from where it was sent (tolerance {360 / 4096 * tolerance:.0f}): "
            "something holds it, or it is too weak. Every servo was told to hold; clear the way, then arm again",
        )


class TooSlow(DeviceError):
    """A board's line is too slow to stop its arms in time."""

    def __init__(self, board: str, baud: int, takes_s: float, limit_s: float) -> None:
        self.board, self.baud, self.takes_s = board, baud, takes_s
        super().__init__(
            f"board {board} talks at {baud} baud: a stop would take {1e3 * takes_s:.0f} ms to reach its last channel; allowed: "
            f"{1e3 * limit_s:.0f} ms. Set it to 115200 (SSC-32U: press its button until green and red are lit; SSC-32: both baud jumpers)"
        )


class HalfHeld(DeviceError):
    """Some channels have a pulse and others have none."""

    def __init__(self) -> None:
        super().__init__(
            "the boards hold some servos, and have forgotten others: those would jump at full speed while the rest is in their way. "
            "Let all go limp, put the arms into the parked pose, and arm again"
        )


class NoReference(DeviceError):
    """A move was asked of a channel whose position the board does not know."""

    def __init__(self, board: str, channels: Iterable[int]) -> None:
        self.board, self.channels = board, tuple(channels)
        super().__init__(
            f"board {board}, channels {', '.join(map(str, self.channels))}: the first move after power-up is a jump at full speed, so only "
            "the parked pose is allowed; arm first"
        )


class WrongState(DeviceError):
    """A step of the life cycle was asked for out of its order."""

    def __init__(self, what: str, state: str, needs: str) -> None:
        self.what, self.state, self.needs = what, state, needs
        super().__init__(f"cannot {what} while {state}: needs to be {needs}")


class NotConfirmed(DeviceError):
    """Nobody confirmed that the arms are in the parked pose."""

    def __init__(self) -> None:
        super().__init__("nobody confirmed that the arms are in the parked pose, so nothing was moved")


class Stopped(DeviceError):
    """The stop is latched: nothing moves until it is cleared."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(f"stopped: {reason}; nothing moves until the stop is cleared")


class Stalled(DeviceError):
    """The host was late by more than the watchdog allows."""

    def __init__(self, late_s: float, limit_s: float) -> None:
        self.late_s, self.limit_s = late_s, limit_s
        super().__init__(
            f"the motion was {1e3 * late_s:.0f} ms late, more than {1e3 * limit_s:.0f} ms: the host could not keep pace; arms hold"
        )

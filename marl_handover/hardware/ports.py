"""Which serial ports there are, by names that do not change when something else is plugged in."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from serial.tools import list_ports

from marl_handover.hardware.errors import PortNotFound

FTDI = (0x0403, 0x6001)
"""Vendor and product of the USB chip on an SSC-32U, and in most cables of an SSC-32."""

_BY_ID = Path("/dev/serial/by-id")
_USB_SERIAL = Path("/sys/bus/usb-serial/devices")


class PortInfo(NamedTuple):
    """A port: the name to use, what it says about itself, and whether its USB chip is of the kind the boards have."""

    path: str
    description: str
    likely: bool


def list_serial_ports() -> list[PortInfo]:
    """All ports, likely ones first; nothing is opened."""
    stable = {str(link.resolve()): str(link) for link in sorted(_BY_ID.glob("*"))} if _BY_ID.is_dir() else {}
    found = [
        PortInfo(stable.get(str(Path(port.device).resolve()), port.device), port.description or "", (port.vid, port.pid) == FTDI)
        for port in list_ports.comports()
    ]
    return sorted(found, key=lambda port: (not port.likely, port.path))


def choose_port(port: str) -> str:
    """``port`` itself if it is set, else the one port that is likely a board's. Raises :class:`PortNotFound`."""
    if port:
        return port
    ports = list_serial_ports()
    likely = [found.path for found in ports if found.likely]
    if len(likely) != 1:
        reason = "none looks like a controller board" if not likely else "more than one could be the board"
        raise PortNotFound("", reason, [found.path for found in ports])
    return likely[0]


def latency_ms(path: str) -> int | None:
    """How long a USB serial chip keeps bytes back before it hands them over; None where the system does not say."""
    try:
        return int((_USB_SERIAL / Path(path).resolve().name / "latency_timer").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None

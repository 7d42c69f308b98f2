"""The web server of the browser pages: on this machine only, for pages of this machine only."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import viser
import websockets.asyncio.server

from marl_handover.config import require_between
from marl_handover.errors import HandoverError

HOST = "127.0.0.1"
"""There is no login, so nobody but this machine's users gets in; from elsewhere: an SSH tunnel."""

PAGES = re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?")
"""Origins that may talk to the server. Any web page can reach this machine's ports from the browser of somebody who sits at it."""

LAGGING_S = 0.1
"""A loop that is later than this goes on from there; it does not catch up."""


class PortTaken(HandoverError):
    """The page cannot be served at that port."""

    def __init__(self, port: int, reason: str) -> None:
        super().__init__(f"port = {port} of {HOST} cannot be used ({reason}); choose another one, or port=0 for any that is free")
        self.port, self.reason = port, reason


class LocalServer(viser.ViserServer):
    """A server that never publishes itself: viser's pages may otherwise ask it for a public address."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refused."""


@contextlib.contextmanager
def open_server(port: int, label: str) -> Iterator[viser.ViserServer]:
    """A running server, stopped at the end.

    Args:
        port: 0 for any that is free.
        label: above the panel of the page.

    Raises:
        InvalidSetting: there is no such port.
        PortTaken: it is in use, or not for this user.
    """
    require_between("port", port, 0, 65535)
    _require_free(port)
    # Browsers open spare connections and close them unused, of which this logger would tell with a traceback.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    server = _started(port, label)
    try:
        if port and server.get_port() != port:  # somebody took it since; viser goes on to the next one
            raise PortTaken(port, "it is in use")
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        yield server
    finally:
        with _quiet():
            server.stop()


def address(server: viser.ViserServer) -> str:
    """Where a browser on this machine finds the page."""
    return f"http://{HOST}:{server.get_port()}"


def keep_updating(update: Callable[[float], None], rate_hz: float, ended: threading.Event, hurry: threading.Event | None = None) -> None:
    """Call ``update`` with the wall time in s since the call before, ``rate_hz`` times a second, until ``ended`` is set.

    Whoever sets ``hurry`` is attended to at once.
    """
    period_s, pause = 1.0 / rate_hz, hurry or ended
    before = due = time.perf_counter()
    while not ended.is_set():
        if hurry is not None:
            hurry.clear()
        now = time.perf_counter()
        update(min(now - before, LAGGING_S))
        before = now
        due = min(max(due + period_s, now + period_s - LAGGING_S), now + period_s)
        pause.wait(max(0.0, due - time.perf_counter()))


def _require_free(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
            probe.listen()
        except OSError as error:
            raise PortTaken(port, error.strerror or str(error)) from error


def _started(port: int, label: str) -> viser.ViserServer:
    """There is no setting for who may connect: it is put in where viser opens its socket, which the constructor waits for."""
    module: Any = websockets.asyncio.server
    serve = module.serve
    module.serve = partial(serve, origins=[None, PAGES])
    try:
        with _quiet():
            return LocalServer(host=HOST, port=port, label=label, verbose=False)
    finally:
        module.serve = serve


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Without the tables that viser prints."""
    return contextlib.redirect_stdout(io.StringIO())

"""The web server of the browser pages: on this machine only, for pages of this machine only."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from viser.infra import _infra
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from marl_handover.config import require_between
from marl_handover.errors import HandoverError

MAX_VIEWERS = 32
"""Pages that are looked at at once. Every one of them costs a few per cent of a core."""

MAX_CONNECTIONS = 128
"""Open connections of any kind, those included that have not said yet what they want."""

MAX_MESSAGE_BYTES = 2**20
STALLED_S = 10.0
"""A viewer that takes nothing for so long is let go; a browser connects again by itself."""

UNREAD_BYTES = 2**18
"""What the system keeps for a client that does not read; it would let that grow to some MB."""

PING_S = 5.0
MESSAGES_HZ, BURST = 150.0, 300.0
"""What one viewer may send. A hand that drags sends 60 a second; what is sent faster waits in the sender's own buffers."""

_AUTHORITY = re.compile(r"(?P<name>localhost|127\.0\.0\.1|\[::1\])(?::(?P<port>\d{1,5}))?", re.IGNORECASE)
_ORIGIN = re.compile(r"https?://" + _AUTHORITY.pattern, re.IGNORECASE)

HEADERS = {
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; media-src 'self' data: blob:; manifest-src 'self' data:; "
    "connect-src 'self' ws://{host} wss://{host} data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""viser's page is one file with its script, its styles and its compiled workers inside; it needs nothing from anywhere else."""


def refusal(host: str | None, origin: str | None) -> str:
    """Why a request is not answered; empty if it is.

    Args:
        host: the Host header. Under another name than this machine's own, a stranger's page could pass for this one (DNS rebinding).
        origin: the Origin header, which browsers send with every WebSocket; None: a program, not a page. A page of another port of this
            machine is a stranger's too. Through a tunnel, port and page have the tunnel's port, both.
    """
    asked = _AUTHORITY.fullmatch(host or "")
    if asked is None:
        return "this page is served to http://localhost and http://127.0.0.1 only"
    if origin is None:
        return ""
    page = _ORIGIN.fullmatch(origin)
    if page is None or page["port"] != asked["port"]:
        return "only the page of this very address may connect"
    return ""


def speaks(request: Request) -> bool:
    """Whether the other end of a WebSocket has this viser's version. viser itself prints a line about each that has not."""
    offered = ",".join(request.headers.get_all("Sec-WebSocket-Protocol")).split(",")
    return f"viser-v{viser.__version__}" in (protocol.strip() for protocol in offered)


class Connection(ServerConnection):
    """One client: how much it sends is limited, and if it takes nothing any more, it is let go."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._tokens, self._counted_s = BURST, 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, unless too many are here."""
        crowded = len(self.server.handlers) >= MAX_CONNECTIONS
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, UNREAD_BYTES)
        super().connection_made(transport)
        if crowded:
            self.transport.abort()

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message, not sooner than it may come."""
        now_s = self.loop.time()
        self._tokens = min(self._tokens + MESSAGES_HZ * (now_s - self._counted_s), BURST) - 1.0
        self._counted_s = now_s
        if self._tokens < 0.0:
            await asyncio.sleep(-self._tokens / MESSAGES_HZ)
        return await super().recv(decode)

    async def send(self, message: Any, text: bool | None = None) -> None:
        """Send a message; a client that does not take it in time is gone."""
        try:
            async with asyncio.timeout(STALLED_S):
                await super().send(message, text)
        except TimeoutError:
            self.transport.abort()
            await self.wait_closed()


def guarded(serve: Callable[..., Any]) -> Callable[..., Any]:
    """``serve`` of websockets, for local pages only, with limits and headers."""

    def open_socket(*args: Any, **options: Any) -> Any:
        """``serve`` with the limits."""
        page = options.pop("process_request")

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            """A page, a refusal, or None: the socket is opened."""
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            wrong = refusal(", ".join(hosts), ", ".join(origins) if origins else None)
            if wrong:
                return connection.respond(403, f"{wrong}\n")
            answered: Response | None = page(connection, request)
            if answered is None and not speaks(request):
                return connection.respond(400, f"only pages of viser {viser.__version__} are understood; reload the page\n")
            if answered is None and len(connection.server.connections) >= MAX_VIEWERS:
                return connection.respond(503, f"{MAX_VIEWERS} viewers look at this page already; close one\n")
            return answered

        def seal(_: ServerConnection, request: Request, response: Response) -> Response:
            """A response with the headers that keep a page to itself."""
            for name, value in HEADERS.items():
                response.headers[name] = value
            if not refusal(", ".join(request.headers.get_all("Host")), None):  # else it holds what the client likes
                response.headers["Content-Security-Policy"] = _POLICY.format(host=request.headers["Host"])
            else:
                response.headers["Content-Security-Policy"] = "default-src 'none'; frame-ancestors 'none'"
            return response

        limits: dict[str, Any] = {"max_size": MAX_MESSAGE_BYTES, "ping_interval": PING_S, "ping_timeout": STALLED_S, "close_timeout": 2.0}
        return serve(*args, **options | limits, process_request=answer, process_response=seal, create_connection=Connection)

    return open_socket


class _LoopEvent(asyncio.Event):
    """Set by the thread of its loop only.

    viser sets it from the thread that draws, too, while the loop's thread may walk through those who wait: with some hundred viewers that
    raises "deque mutated during iteration". It has the loop set it as well, which is all that is needed.
    """

    def set(self) -> None:
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return
        super().set()


class Buffer(AsyncMessageBuffer):
    """What viewers have still to be sent; may be filled from any thread."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.message_event = _LoopEvent()


HOST = "127.0.0.1"
"""There is no login, so nobody but this machine's users gets in; from elsewhere: an SSH tunnel."""

LOG = logging.getLogger(__name__)

LAGGING_S = 0.1
"""A loop that is later than this goes on from there; it does not catch up."""

REPEATED_S = 60.0
"""The same error is written in full once; how often it came again, once in so many seconds."""


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


class Failures:
    """Writes to the log what goes wrong again and again, without filling it."""

    def __init__(self, what: str) -> None:
        self._what, self._last, self._again, self._written_s = what, "", 0, 0.0

    def note(self, error: Exception) -> None:
        """An error that is not to end anything."""
        text, now_s = f"{type(error).__name__}: {error}", time.monotonic()
        if text != self._last:
            LOG.error("%s failed and goes on: %s", self._what, text, exc_info=error)
            self._last, self._again, self._written_s = text, 0, now_s
            return
        self._again += 1
        if now_s - self._written_s >= REPEATED_S:
            LOG.error("%s failed %d times more: %s", self._what, self._again, text)
            self._again, self._written_s = 0, now_s


def keep_updating(update: Callable[[float], None], rate_hz: float, ended: threading.Event, hurry: threading.Event | None = None) -> None:
    """Call ``update`` with the wall time in s since the call before, ``rate_hz`` times a second, until ``ended`` is set.

    Whoever sets ``hurry`` is attended to at once. An update that raises is written to the log, and the next one comes all the same: a page
    with a STOP button has to stay.
    """
    period_s, pause, failures = 1.0 / rate_hz, hurry or ended, Failures("an update of the page")
    before = due = time.perf_counter()
    while not ended.is_set():
        if hurry is not None:
            hurry.clear()
        now = time.perf_counter()
        try:
            update(min(now - before, LAGGING_S))
        except Exception as error:
            failures.note(error)
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
    """The guard is put in where viser opens its socket and makes its buffers; the constructor waits for both."""
    sockets: Any = websockets.asyncio.server
    infra: Any = _infra
    serve = sockets.serve
    infra.AsyncMessageBuffer = Buffer  # for good: every viewer that connects gets one, too
    sockets.serve = guarded(serve)
    try:
        with _quiet():
            server = LocalServer(host=HOST, port=port, label=label, verbose=False)
    finally:
        sockets.serve = serve
    server.get_event_loop().call_soon_threadsafe(_log_failures, server.get_event_loop())
    return server


def _log_failures(loop: asyncio.AbstractEventLoop) -> None:
    """What viewers send may be nonsense, as often as they like: it is written once."""
    failures = Failures("a message from a viewer")
    loop.set_exception_handler(lambda _, context: failures.note(context.get("exception") or RuntimeError(context["message"])))


def _quiet() -> contextlib.redirect_stdout[io.StringIO]:
    """Without the tables that viser prints."""
    return contextlib.redirect_stdout(io.StringIO())

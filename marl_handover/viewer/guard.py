"""Who may talk to the page's web server, and how much of it one client may take.

viser has no settings for this: :func:`guarded` wraps the function with which it opens its socket, and :class:`Buffer` takes the place of
the message buffer that it fills from the thread that draws.
"""

from __future__ import annotations

import asyncio
import re
import socket
from collections.abc import Callable
from typing import Any

import viser
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

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
        page = options.pop("process_request")

        def answer(connection: ServerConnection, request: Request) -> Response | None:
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

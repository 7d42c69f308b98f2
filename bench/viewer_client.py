"""A viewer without a browser: speaks viser's protocol over a WebSocket, keeps what it is shown, and can do what a person's hand does."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import msgspec
import viser
import zstandard
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

SEEN_S = 600.0
LOOK_S = 0.05


class Client:
    """One connected viewer.

    Attributes:
        nodes: newest pose and properties of every scene node, by name.
        panel: newest properties of every input and text of the panel, by uuid; ``kind`` and ``value`` among them.
        frames: times at which something came.
        bytes: received.

    Args:
        address: of the page, http://...
        origin: to claim, as a browser does for the page it shows; None: as programs do.
    """

    def __init__(self, address: str, origin: str | None = None) -> None:
        self.nodes: dict[str, dict[str, Any]] = {}
        self.panel: dict[str, dict[str, Any]] = {}
        self.frames: list[float] = []
        self.bytes = 0
        self._changed = threading.Condition()
        options: dict[str, Any] = {"max_size": 2**26, "compression": None, "origin": origin}
        self._socket = connect(address.replace("http", "ws", 1), subprotocols=[f"viser-v{viser.__version__}"], **options)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.send(_messages.ViewerCameraMessage((1, 0, 0, 0), (-0.6, 0, 0.5), 0.7, 0.01, 100.0, 720, 1280, (0, 0, 0), (0, 0, 1)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._socket.close()
        self._reader.join()

    def send(self, message: Any) -> None:
        """One message to the server."""
        fields = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
        self._socket.send(msgspec.msgpack.encode({**fields, "type": type(message).__name__}, enc_hook=float))

    def drag(self, name: str, position_m: Sequence[float], wxyz: Sequence[float], phase: str = "update") -> None:
        """Move a transform control as a hand does; ``phase``: start, update or end."""
        if phase == "update":
            self.send(_messages.TransformControlsUpdateMessage(name, tuple(wxyz), tuple(position_m)))
        else:
            kinds = {"start": _messages.TransformControlsDragStartMessage, "end": _messages.TransformControlsDragEndMessage}
            self.send(kinds[phase](name))

    def input(self, label: str) -> str:
        """The uuid of the button, slider or choice with this label, waited for."""
        self.wait(lambda: any(item.get("label") == label for item in self.panel.values()))
        return next(uuid for uuid, item in self.panel.items() if item.get("label") == label)

    def set(self, label: str, value: Any) -> None:
        """Set an input; a button is pressed with True."""
        self.send(_messages.GuiUpdateMessage(self.input(label), {"value": value}))

    def text(self) -> str:
        """All Markdown of the panel."""
        return "\n".join(str(item["_markdown"]) for item in list(self.panel.values()) if "_markdown" in item)

    def wait(self, condition: Callable[[], bool], timeout_s: float = SEEN_S) -> float:
        """Wait until ``condition`` holds, looking whenever something comes and now and then; the time at which it did.

        Raises:
            TimeoutError: it does not.
        """
        end = time.perf_counter() + timeout_s
        with self._changed:
            while not condition():
                if time.perf_counter() >= end:
                    raise TimeoutError("the page does not show it")
                self._changed.wait(LOOK_S)
        return time.perf_counter()

    def _read(self) -> None:
        unpack = zstandard.ZstdDecompressor()
        while True:
            try:
                raw = self._socket.recv()
            except ConnectionClosed:
                return
            assert isinstance(raw, bytes)
            packed = int.from_bytes(raw[8:16], "little")
            size = int.from_bytes(raw[:8], "little")
            frame = msgspec.msgpack.decode(unpack.decompress(raw[16 : 16 + packed], max_output_size=size))
            with self._changed:
                self.frames.append(time.perf_counter())
                self.bytes += len(raw)
                for message in frame["messages"]:
                    self._take(message)
                self._changed.notify_all()

    def _take(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "GuiUpdateMessage":
            self.panel.setdefault(message["uuid"], {}).update(message["updates"])
        elif kind.startswith("Gui") and "uuid" in message and "props" in message:
            self.panel[message["uuid"]] = {**message["props"], "kind": kind, "value": message.get("value")}
        elif kind == "SceneNodeUpdateMessage":
            self.nodes.setdefault(message["name"], {}).update(message["updates"])
        elif "name" in message:
            fields = {key: value for key, value in message.items() if key in ("position", "wxyz", "visible")}
            self.nodes.setdefault(message["name"], {}).update({**(message.get("props") or {}), **fields})

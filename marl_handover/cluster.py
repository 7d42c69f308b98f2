"""The one way into a Ray cluster: nobody who is not there is waited for."""

from __future__ import annotations

import importlib
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from marl_handover.errors import InvalidSetting, MissingExtra, WorkFailed

PROBE_S = 5.0
"""How long to wait for an answer at an address. Ray itself would try for two minutes and then end the process."""

WORKER_NICENESS = "RAY_worker_niceness"
"""Ray's own setting, as an environment variable."""


class ClusterUnavailable(WorkFailed):
    """No Ray cluster can be used at an address. ``absent``: nothing answers there, so that starting one may help."""

    def __init__(self, address: str, reason: str, absent: bool = True, name: str = "address") -> None:
        advice = "; start one with: ray start --head" if absent else ""
        super().__init__(f"no Ray cluster at {name}={address}: {reason}{advice}")
        self.address, self.reason = address, reason


def require_ray(setting: str) -> Any:
    """The module ray, which ``setting`` needs. Raises :class:`MissingExtra`."""
    # Ray looks for updates of its usage statistics' settings over the network, and reports to its makers, unless told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise MissingExtra(setting, "ray", "ray") from error


@contextmanager
def connected(ray: Any, address: str, cores: int, name: str = "address") -> Iterator[Any]:
    """Ray, connected; disconnected in the end unless it was connected before.

    Args:
        ray: the module.
        address: ``auto`` (or empty) for ``RAY_ADDRESS``, or the cluster this machine belongs to; ``host:port``; ``ray://host:port``;
            ``local`` for one that is started here.
        cores: of a cluster that is started here; 0: all.
        name: of the setting that gave the address, for errors.

    Raises:
        InvalidSetting: ``address`` is none.
        ClusterUnavailable: nothing answers there, or it cannot be used.
    """
    if ray.is_initialized():
        yield ray
        return
    address = address or "auto"
    target = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    options: dict[str, Any] = {"num_cpus": cores or None, "include_dashboard": False} if target == "local" else {}
    if target == "local":
        # Workers of Ray's own choice are at nice 15. On a busy machine they are not there yet when TorchRL stops waiting, after 60 s.
        os.environ.setdefault(WORKER_NICENESS, "0")
    _probe(target, name)
    try:
        ray.init(address=target, log_to_driver=False, logging_level=logging.ERROR, **options)
    except ValueError as error:
        raise InvalidSetting(name, address, f"auto, local, host:port or ray://host:port ({' '.join(str(error).split())})") from error
    except (ConnectionError, RuntimeError, SystemExit) as error:
        alone = error.__cause__ is None and error.__context__ is None
        raise ClusterUnavailable(address, _root_cause(error), alone and isinstance(error, ConnectionError), name) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _root_cause(error: BaseException) -> str:
    """First line of the error that all others came of: Ray wraps what happened, a version that does not fit say, in advice to start Ray."""
    while (deeper := error.__cause__ or error.__context__) is not None:
        error = deeper
    lines = [" ".join(line.split()).rstrip(".") for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def _probe(address: str, name: str) -> None:
    """Raise :class:`ClusterUnavailable` at once if nobody listens at ``host:port``; other forms of address pass."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=PROBE_S).close()
    except (OSError, OverflowError) as error:
        raise ClusterUnavailable(address, getattr(error, "strerror", None) or str(error), name=name) from error

"""A joblib backend whose workers are tasks on a Ray cluster.

joblib's own Ray backend (``ray.util.joblib``) cannot be used here. It refuses to hand over results as they come; it deals the items out to
actors that nobody replaces, so that every item dealt to one that died fails, started or not; and the first of these failures ends the call
and drops what the others had done. A Ray task has no such ties: Ray finds a core for it, and when its process or machine dies only this
task fails, and is given to Ray again.
"""

from __future__ import annotations

import importlib
import logging
import os
import socket
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from typing import Any

from joblib.parallel import ParallelBackendBase

from marl_handover.compare.workers import Outcome, died, run_parallel, summary
from marl_handover.errors import InvalidSetting, MissingExtra, WorkFailed

LOG = logging.getLogger(__name__)
PROBE_S = 5.0
"""How long to wait for an answer at an address. Ray itself would try for two minutes and then end the process."""


class ClusterUnavailable(WorkFailed):
    """No Ray cluster can be used at an address. ``absent``: nothing answers there, so that starting one may help."""

    def __init__(self, address: str, reason: str, absent: bool = True) -> None:
        advice = "; start one with: ray start --head" if absent else ""
        super().__init__(f"no Ray cluster at address={address}: {reason}{advice}")
        self.address, self.reason = address, reason


def require_ray() -> Any:
    """The module ray. Raises :class:`MissingExtra`."""
    # Ray looks for updates of its usage statistics' settings over the network, and reports to its makers, unless told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise MissingExtra("launcher=ray", "ray", "ray") from error


def through_ray(
    parcels: Mapping[int, bytes], names: list[str], address: str, jobs: int, attempts: int, ready: Callable[[], None]
) -> Generator[Outcome, None, None]:
    """The outcome of each parcel as it is done, on the cluster at ``address``; see :func:`marl_handover.compare.launch.fan_out`."""
    if not parcels:
        return
    with _cluster(require_ray(), address, jobs) as ray:
        cores = int(ray.cluster_resources().get("CPU", 0))
        if not cores:
            raise ClusterUnavailable(address, "it has no cores")
        ready()
        backend = RayTasks(ray, names, attempts)
        at_once = jobs or cores
        # With a single worker joblib would do the work in this process.
        with closing(run_parallel(backend, parcels, max(2, at_once), at_once)) as outcomes:
            yield from outcomes


class RayTasks(ParallelBackendBase):
    """Every submitted call becomes a Ray task on one core. A thread for each of them waits for it, and gives it to Ray again if it dies.

    Args:
        ray: the module, connected to a cluster.
        names: of the items, for messages.
        attempts: how often an item is started at most.
    """

    supports_retrieve_callback = True

    def __init__(self, ray: Any, names: list[str], attempts: int) -> None:
        super().__init__(nesting_level=0)
        self._ray, self._names, self._attempts = ray, names, attempts
        one_thread = {name: "1" for name in self.MAX_NUM_THREADS_VARS}
        # Ray's own retries stay off: it repeats a task that runs out of memory without end.
        self._task = ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": one_thread})(_call)
        self._running: set[Any] = set()
        self._threads: ThreadPoolExecutor | None = None
        self._aborted = False

    def effective_n_jobs(self, n_jobs: int) -> int:
        """As asked: the caller knows the cluster."""
        return n_jobs

    def configure(self, n_jobs: int = 1, parallel: Any = None, **_: Any) -> int:
        """As the base class."""
        self.parallel, self._threads = parallel, ThreadPoolExecutor(n_jobs, thread_name_prefix="ray-task")
        return n_jobs

    def submit(self, func: Any, callback: Any = None) -> Future[list[Outcome]]:
        """As the base class."""
        assert self._threads is not None
        future = self._threads.submit(self._until_done, func)
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Future[list[Outcome]]) -> list[Outcome]:
        """As the base class."""
        return out.result()

    def abort_everything(self, ensure_ready: bool = True) -> None:
        """Kill the tasks that run; the backend is of no use after that."""
        self._aborted = True
        for reference in list(self._running):
            self._ray.cancel(reference, force=True)

    def terminate(self) -> None:
        """As the base class."""
        if self._threads is not None:
            self._threads.shutdown(wait=self._aborted, cancel_futures=True)

    def _until_done(self, batch: Any) -> list[Outcome]:
        _, (index, _), _ = batch.items[0]
        error: Exception | None = None
        for number in range(1, self._attempts + 1):
            if error is not None:
                reason = type(error).__name__
                LOG.warning("%s: a worker died (%s); starting it again (%d of %d)", self._names[index], reason, number, self._attempts)
            reference = self._task.remote(batch)
            self._running.add(reference)
            try:
                outcomes: list[Outcome] = self._ray.get(reference)
                return outcomes
            except self._ray.exceptions.RayTaskError as unusable:
                return [Outcome(index, None, summary(unusable.cause or unusable), str(unusable))]
            except self._ray.exceptions.RayError as death:
                error = death
                if self._aborted:
                    break
            finally:
                self._running.discard(reference)
        return [died(index, self._attempts, type(error).__name__)]


def _call(batch: Any) -> list[Outcome]:
    """What a task does."""
    outcomes: list[Outcome] = batch()
    return outcomes


@contextmanager
def _cluster(ray: Any, address: str, jobs: int) -> Iterator[Any]:
    """Ray, connected; disconnected in the end unless it was connected before."""
    if ray.is_initialized():
        yield ray
        return
    address = address or "auto"
    target = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    options: dict[str, Any] = {"num_cpus": jobs or None, "include_dashboard": False} if target == "local" else {}
    _probe(target)
    try:
        ray.init(address=target, log_to_driver=False, logging_level=logging.ERROR, **options)
    except ValueError as error:
        raise InvalidSetting("address", address, f"auto, local, host:port or ray://host:port ({summary(error)})") from error
    except (ConnectionError, RuntimeError, SystemExit) as error:
        alone = error.__cause__ is None and error.__context__ is None
        raise ClusterUnavailable(address, _root_cause(error), absent=alone and isinstance(error, ConnectionError)) from error
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


def _probe(address: str) -> None:
    """Raise :class:`ClusterUnavailable` at once if nobody listens at ``host:port``; other forms of address pass."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), timeout=PROBE_S).close()
    except (OSError, OverflowError) as error:
        raise ClusterUnavailable(address, getattr(error, "strerror", None) or str(error)) from error
